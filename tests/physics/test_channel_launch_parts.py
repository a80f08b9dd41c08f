"""Launches in parts, which bound memory: the paths are those of a whole launch."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from same_paths import model
from test_channel_follow import stepped

from caviar_labs.stability.lab import Thing, antenna, scene
from caviar_protocol.topics import AntennaArray, Channel, Interaction, Scene
from caviar_services.channel.sionna.ray_launcher import RAYS_AT_ONCE, rays_within

pytestmark = pytest.mark.channel

CANYON = "simple_street_canyon_with_cars"
SAMPLES = 40_000
TEN_THOUSAND_AT_ONCE = 1e-3
"""[GiB]"""


def street(x: float) -> Scene:
    """A car that drives along the canyon, and three receivers."""
    devices = [antenna("bs", "tx", np.array((-31.0, 5.0, 12.0)), AntennaArray())]
    places = {"a": (-12.0, 0.3, 1.7), "b": (35.0, -1.1, 2.1), "c": (5.0, 4.0, 1.5)}
    devices += [antenna(name, "rx", np.array(place), AntennaArray()) for name, place in places.items()]
    return scene(devices, [Thing("car", np.array((x, -2.5, 0.8)), np.array((4.5, 1.8, 1.6)))])


def test_memory_says_how_many_rays_are_launched_together() -> None:
    assert rays_within(4.0, 3) == RAYS_AT_ONCE
    assert rays_within(TEN_THOUSAND_AT_ONCE, 3) == 10_000
    assert rays_within(0.5, 3) == int(0.5 * 2**30 / 750)


def _pairs(channel: Channel) -> list[int]:
    return np.repeat(np.arange(len(channel.offsets) - 1), np.diff(channel.offsets)).tolist()


@pytest.mark.parametrize("settings", [pytest.param({}, marks=pytest.mark.exhaustive), {"follow": 4}])
def test_reflections_of_four_parts_are_those_of_one_launch(settings: dict[str, Any]) -> None:
    settings = {"samples": SAMPLES, "candidates": "launched", **settings}
    whole, parts = model(CANYON, **settings), model(CANYON, **settings, memory_gib=TEN_THOUSAND_AT_ONCE)
    for frame in range(2 if "follow" in settings else 1):
        what = street(8.0 + frame)
        one, other = stepped(whole, frame, what), stepped(parts, frame, what)
        assert len(one.tau) > 10
        np.testing.assert_array_equal(one.id, other.id)
        np.testing.assert_allclose(one.tau, other.tau, rtol=1e-12)
        np.testing.assert_allclose(one.a, other.a, rtol=1e-4)


@pytest.mark.exhaustive
def test_edges_that_any_part_meets_diffract() -> None:
    """Whether a ray is bent or reflected is drawn, for each part anew: so a few paths differ."""
    settings = {"samples": SAMPLES, "candidates": "launched", "diffraction": True, "max_depth": 2}
    whole, parts = model(CANYON, **settings), model(CANYON, **settings, memory_gib=TEN_THOUSAND_AT_ONCE)
    one, other = (stepped(channel, 0, street(8.0)) for channel in (whole, parts))
    bent = [
        {(pair, path) for pair, path in zip(_pairs(channel), channel.id.tolist(), strict=True)}
        for channel in (one, other)
    ]
    assert (one.interactions == Interaction.DIFFRACTION).any(1).sum() > 50
    assert len(bent[0] & bent[1]) > 0.8 * max(map(len, bent))


@pytest.mark.exhaustive
def test_points_of_diffuse_paths_are_of_all_parts() -> None:
    """Their power is that of one launch, within what is left to chance."""
    settings = {"samples": SAMPLES, "candidates": "launched", "scattering": True, "max_depth": 1}
    whole, parts = model(CANYON, **settings), model(CANYON, **settings, memory_gib=TEN_THOUSAND_AT_ONCE)
    powers = []
    for channel in (whole, parts):
        found = stepped(channel, 0, street(8.0))
        diffuse = (found.interactions == Interaction.SCATTERING).any(1)
        assert diffuse.sum() > 500
        powers.append(float((np.abs(found.a[0, diffuse]) ** 2).sum()))
    assert powers[1] == pytest.approx(powers[0], rel=0.1)


def test_a_launch_into_the_scene_as_it_was_is_forgotten() -> None:
    channel: Any = model(CANYON, samples=SAMPLES, candidates="launched")
    for frame in range(3):
        stepped(channel, frame, street(2.0 * frame))
        assert len(channel._finder.tracer._last) == 1
