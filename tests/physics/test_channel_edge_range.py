"""``edges_within_m``: far edges diffract nothing, and where none is in range diffraction is switched off."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caviar_labs.stability.lab import (
    Plate,
    Thing,
    antenna,
    channel_of,
    frame_of,
    scene,
    sionna,
    write_scenery,
)
from caviar_protocol.errors import CaviarError
from caviar_protocol.topics import Channel, Interaction
from caviar_services.channel.base import ChannelModel

pytestmark = pytest.mark.channel

NEAR = Thing("car", (4.0, 1.0, 0.76))
FAR = Thing("van", (55.0, 3.0, 1.31), (6.0, 2.0, 2.6))
SENDER = (-3.0, 0.0, 3.0)
RECEIVERS = ((9.0, 1.5, 0.9), (8.0, 3.0, 1.4), (6.0, -4.0, 2.0))


@pytest.fixture(scope="module")
def assets(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    ground = [(-300, -300, 0), (300, -300, 0), (300, 300, 0), (-300, 300, 0)]
    return write_scenery(tmp_path_factory.mktemp("open"), [Plate("ground", ground)])


def traced(model: ChannelModel[Any], things: Sequence[Thing]) -> tuple[Channel, Mapping[str, int]]:
    devices = [antenna(f"r{i}", "rx", place) for i, place in enumerate(RECEIVERS)]
    at = scene([antenna("t", "tx", SENDER), *devices], things)
    result = model.step(frame_of(at, service="channel", seed=1))
    return channel_of(result), result.counts


def model(assets: dict[str, Path], **settings: Any) -> ChannelModel[Any]:
    return sionna(28e9, assets, max_depth=2, samples=200_000, **settings)


def over(channel: Channel, name: str) -> list[int]:
    """Paths that are diffracted at this object."""
    bent = channel.interactions == int(Interaction.DIFFRACTION)
    index = channel.object_names.index(name) if name in channel.object_names else -2
    return np.flatnonzero((bent & (channel.objects == index)).any(1)).tolist()


def test_only_edges_in_range_diffract_and_the_others_hardly_matter(assets: dict[str, Path]) -> None:
    """A car beside the receivers and a van 45 m off: with a range of 30 m the car's paths stay as they are,
    bit by bit, the van's are gone, and the power of what is diffracted changes by less than 0.2 dB."""
    every, _ = traced(model(assets, diffraction=True), [NEAR, FAR])
    ranged, counts = traced(model(assets, diffraction=True, edges_within_m=30.0), [NEAR, FAR])
    assert over(every, "van")
    assert over(every, "car")
    assert not over(ranged, "van")
    assert counts["no_edge_in_range"] == 0
    kept = np.isin(every.id, ranged.id)
    assert set(np.flatnonzero(~kept)) == set(over(every, "van"))
    assert every.a[:, kept].tobytes() == ranged.a.tobytes()
    bent = [
        (np.abs(channel.a[0][(channel.interactions == int(Interaction.DIFFRACTION)).any(1)]) ** 2).sum()
        for channel in (every, ranged)
    ]
    assert abs(10 * np.log10(bent[1] / bent[0])) < 0.2


def test_where_no_edge_is_in_range_diffraction_is_switched_off(assets: dict[str, Path]) -> None:
    """The same paths as without diffraction, bit by bit, and a count that says so; in the next frame, with
    the car there, they are diffracted again."""
    ranged = model(assets, diffraction=True, edges_within_m=30.0)
    off, counts = traced(ranged, [FAR])
    without, _ = traced(model(assets), [FAR])
    assert counts["no_edge_in_range"] == 1
    assert off.a.tobytes() == without.a.tobytes()
    assert off.points.tobytes() == without.points.tobytes()
    back, counts = traced(ranged, [NEAR, FAR])
    assert counts["no_edge_in_range"] == 0
    assert over(back, "car")


def test_a_range_needs_diffraction(assets: dict[str, Path]) -> None:
    for settings in ({}, {"diffraction": True, "rung": "mimo-rt"}):
        with pytest.raises((ValueError, CaviarError), match="edges_within_m needs diffraction"):
            model(assets, edges_within_m=30.0, **settings)
