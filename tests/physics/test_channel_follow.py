"""Paths that are followed from frame to frame, beside those that each frame looks for anew."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest
from same_paths import model

from caviar_labs.stability.lab import Thing, antenna, channel_of, frame_of, scene
from caviar_protocol.errors import PayloadError
from caviar_protocol.topics import AntennaArray, Channel, Scene
from caviar_services.channel.base import ChannelModel
from caviar_services.channel.sionna.settings import SionnaSettings

CANYON = "simple_street_canyon_with_cars"
SAMPLES = 40_000

Channels = Callable[[int | None], ChannelModel[Any]]


def street(frame: int, cars: int = 6, leaving: int = 0) -> Scene:
    """Boxes that drive along the canyon, of which the first ``leaving`` have left; receivers on two."""
    x = np.linspace(-40, 40, cars) + 0.8 * frame * (-1.0) ** np.arange(cars)
    things = [
        Thing(f"car-{i}", np.array((x[i], 2.5 * (-1.0) ** i, 0.8)), np.array((4.5, 1.8, 1.6)))
        for i in range(leaving, cars)
    ]
    devices = [antenna("bs", "tx", np.array((-31.0, 5.0, 12.0)), AntennaArray())]
    places = {"near": (-12.0 + 0.5 * frame, 0.3, 1.7), "far": (35.0 - 0.4 * frame, -1.1, 2.1)}
    devices += [antenna(name, "rx", np.array(place), AntennaArray()) for name, place in places.items()]
    return scene(devices, things)


def stepped(channel: ChannelModel[Any], number: int, what: Scene, previous: int | None = None) -> Channel:
    """The product of a frame."""
    before = number - 1 if previous is None else previous
    return channel_of(channel.step(frame_of(what, number, previous=before)))


@pytest.fixture(scope="module")
def channels() -> Channels:
    """Channels of the canyon by ``follow``, made once; each is at the beginning of an episode."""
    made: dict[int | None, ChannelModel[Any]] = {}

    def channel(follow: int | None) -> ChannelModel[Any]:
        if follow not in made:
            made[follow] = model(CANYON, follow=follow, samples=SAMPLES)
        made[follow].reset(0, 0, 0)
        return made[follow]

    return channel


def share_found(followed: Channel, anew: Channel) -> float:
    """Share of the power of paths found anew, those of reflections, that following has too."""
    power = np.abs(anew.a[0]) ** 2 * (anew.interactions != 0).any(1)
    pair = np.repeat(np.arange(len(anew.offsets) - 1), np.diff(anew.offsets))
    known = np.repeat(np.arange(len(followed.offsets) - 1), np.diff(followed.offsets))
    names = set(zip(known.tolist(), followed.id.tolist(), strict=True))
    hit = [name in names for name in zip(pair.tolist(), anew.id.tolist(), strict=True)]
    return float((power * hit).sum() / power.sum())


def test_followed_paths_are_those_that_all_rays_find_and_where_they_are_now(channels: Channels) -> None:
    """Cars drive by; what both have agrees bit by bit in delay and amplitude."""
    followed, anew = channels(5), channels(None)
    shares = []
    for frame in range(12):
        known, all_rays = stepped(followed, frame, street(frame)), stepped(anew, frame, street(frame))
        shares.append(share_found(known, all_rays))
        of_known = {
            (i, t): a for i, t, a in zip(known.id.tolist(), known.tau.tolist(), known.a[0], strict=True)
        }
        both = [
            (of_known[i, t], a)
            for i, t, a in zip(all_rays.id.tolist(), all_rays.tau.tolist(), all_rays.a[0], strict=True)
            if (i, t) in of_known
        ]
        assert len(both) > 4
        np.testing.assert_allclose(*np.array(both).T, rtol=1e-5)
        np.testing.assert_array_equal(known.los, all_rays.los)
    assert shares[0] == 1.0
    assert np.percentile(shares, 5) > 0.99


def test_chains_follow_their_objects_to_other_bodies(channels: Channels) -> None:
    """Two cars leave, so that the others are given their bodies: paths off them go on."""
    followed, anew = channels(50), channels(None)
    for frame in range(2):
        stepped(followed, frame, street(frame))
    known, all_rays = stepped(followed, 2, street(2, leaving=2)), stepped(anew, 2, street(2, leaving=2))
    off_cars = [name for name in all_rays.object_names if name.startswith("car-")]
    assert off_cars
    assert set(off_cars) <= set(known.object_names)
    assert share_found(known, all_rays) > 0.99


def test_a_transmitter_that_jumps_is_looked_for_anew(channels: Channels) -> None:
    followed, anew = channels(50), channels(None)
    stepped(followed, 0, street(0))
    devices = tuple(
        msgspec.structs.replace(d, position=(30.0, -4.0, 9.0)) if d.name == "bs" else d
        for d in street(1).devices
    )
    jumped = msgspec.structs.replace(street(1), devices=devices)
    assert share_found(stepped(followed, 1, jumped), stepped(anew, 1, jumped)) == 1.0


def test_an_episode_begins_without_what_the_one_before_knew(channels: Channels) -> None:
    channel = channels(5)
    first = [stepped(channel, frame, street(frame)) for frame in range(3)]
    channel.reset(1, 0, 0)
    again = [stepped(channel, frame, street(frame)) for frame in range(3)]
    for one, other in zip(first, again, strict=True):
        assert one == other


def test_an_episode_begins_with_a_launch_also_where_nothing_moves(
    channels: Channels, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All rays of the first launch: else it would begin with what the episode before had found in time."""
    channel = channels(5)
    launched: list[Any] = []
    launcher = channel._finder.tracer._launcher  # type: ignore[attr-defined]
    each = launcher.each  # counted on its way
    monkeypatch.setattr(
        launcher,
        "each",
        lambda look, source, rays, number: (
            launched.append((rays, number)) or each(look, source, rays, number)
        ),
    )
    for _ in range(2):
        channel.reset(0, 0, 0)
        for frame in range(3):
            stepped(channel, frame, street(0))
    assert launched == [(None, 0), (None, 0)]


def test_who_was_started_again_within_an_episode_says_that_it_knows_nothing(channels: Channels) -> None:
    channel = channels(5)
    with pytest.raises(PayloadError, match=r"frame 7.*`follow`"):
        stepped(channel, 7, street(7), previous=-1)


@pytest.mark.parametrize("option", ["diffraction", "scattering"])
def test_what_cannot_be_followed_is_refused(option: str) -> None:
    with pytest.raises(msgspec.ValidationError, match=r"follow.*reflections and transmissions"):
        msgspec.convert({"follow": 5, option: True}, SionnaSettings)


def test_where_nothing_moves_but_receivers_the_rays_are_launched_once(
    channels: Channels,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Bit by bit what a new channel computes, and receivers that stand still are not traced again."""
    channel = channels(None)
    launched: list[int] = []
    launcher = channel._finder.tracer._launcher  # type: ignore[attr-defined]
    each = launcher.each  # counted on its way
    monkeypatch.setattr(launcher, "each", lambda *a: launched.append(1) or each(*a))
    still = street(0)
    first = stepped(channel, 0, still)
    assert launched == [1]
    assert stepped(channel, 1, still) == first
    devices = tuple(
        msgspec.structs.replace(d, position=(20.0, 1.0, 1.5)) if d.name == "far" else d for d in still.devices
    )
    moved = msgspec.structs.replace(still, devices=devices)
    found = stepped(channel, 2, moved)
    assert launched == [1]
    assert found == stepped(model(CANYON, samples=SAMPLES), 2, moved)
    stepped(channel, 3, street(1))
    assert launched == [1, 1]
