"""A receiver's paths are the same however they are asked for.

``CAVIAR_SAME_PATHS=200`` draws 200 receivers in each scene instead of 20.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from same_paths import EVERYTHING, POSITIONS, SCENES, SPECULAR, asked, digest, model, of_receiver, places

from caviar_services.channel.base import ChannelModel
from caviar_services.channel.sionna.candidates import Planes

pytestmark = pytest.mark.channel

TEN = [f"r{i}" for i in range(10)]


@pytest.fixture(scope="module", params=SCENES)
def traced(request: pytest.FixtureRequest) -> tuple[str, ChannelModel[Any]]:
    """A scene, and its channel with reflections."""
    return request.param, model(request.param, **SPECULAR)


@pytest.fixture(scope="module")
def everything() -> ChannelModel[Any]:
    """The street canyon with all kinds of interactions."""
    return model("simple_street_canyon_with_cars", **EVERYTHING)


def test_one_receiver_or_ten(traced: tuple[str, ChannelModel[Any]]) -> None:
    """Each of the random positions is asked for in a group of ten and alone: the same ids, and bit-equal
    amplitudes, delays, angles and points. Many of them have paths, of up to three interactions."""
    name, channel = traced
    paths, longest = 0, 0
    for group in range(-(-POSITIONS // 10)):
        where = places(group, name, 10)
        together = asked(channel, name, where, TEN, group)
        paths += len(together.tau)
        longest = max(longest, together.interactions.shape[1])
        for rx, place in zip(TEN, where, strict=True):
            alone = asked(channel, name, place[None], [rx], group)
            assert of_receiver(alone, rx) == of_receiver(together, rx)
    assert longest == 3
    assert paths > POSITIONS


def test_one_receiver_or_ten_with_everything(everything: ChannelModel[Any]) -> None:
    """Also with transmission, diffraction and diffuse scattering."""
    name = "simple_street_canyon_with_cars"
    kinds: set[int] = set()
    for group in range(2):
        where = places(50 + group, name, 10)
        together = asked(everything, name, where, TEN, group)
        kinds |= set(np.unique(together.interactions).tolist())
        for rx, place in zip(TEN, where, strict=True):
            alone = asked(everything, name, place[None], [rx], group)
            assert of_receiver(alone, rx) == of_receiver(together, rx)
    assert kinds == {0, 1, 2, 3, 4}


def test_order_makes_no_difference(traced: tuple[str, ChannelModel[Any]]) -> None:
    """Receivers that swap their names, and so their places in the product, keep their paths."""
    name, channel = traced
    where = places(7, name, 10)
    forth, back = asked(channel, name, where, TEN), asked(channel, name, where[::-1], TEN)
    for rx, other in zip(TEN, reversed(TEN), strict=True):
        assert of_receiver(forth, rx) == of_receiver(back, other)


def test_one_more_elsewhere_makes_no_difference(traced: tuple[str, ChannelModel[Any]]) -> None:
    """High above, underground, or a centimetre beside another."""
    name, channel = traced
    where = places(8, name, 4)
    before = asked(channel, name, where, TEN[:4])
    for extra in ((0.0, 0.0, 400.0), (3.0, 2.0, -50.0), where[2] + 0.01):
        after = asked(channel, name, np.vstack([where, extra]), TEN[:5])
        for rx in TEN[:4]:
            assert of_receiver(before, rx) == of_receiver(after, rx)


def test_batches_make_no_difference() -> None:
    """However many receivers are looked at together."""
    name = "simple_street_canyon_with_cars"
    where = places(9, name, 10)
    products = {
        digest(asked(model(name, receivers_at_once=count, **SPECULAR), name, where, TEN))
        for count in (1, 3, 10, None)
    }
    assert len(products) == 1


@pytest.mark.parametrize("settings", [pytest.param("specular", marks=pytest.mark.exhaustive), "everything"])
def test_another_process_makes_no_difference(settings: str, everything: ChannelModel[Any]) -> None:
    """The product's digest is that of a process of its own; here, other frames came before."""
    name = "simple_street_canyon_with_cars"
    channel = everything if settings == "everything" else model(name, **SPECULAR)
    asked(channel, name, places(4, name, 3), TEN[:3], seed=4)
    here = digest(asked(channel, name, places(5, name, 10), TEN, seed=5))
    script = Path(__file__).with_name("same_paths.py")
    there = subprocess.run(
        [sys.executable, str(script), name, settings], capture_output=True, text=True, timeout=120, check=True
    )
    assert there.stdout == here


def test_no_path_is_ruled_out(traced: tuple[str, ChannelModel[Any]], monkeypatch: pytest.MonkeyPatch) -> None:
    """Judging chains by the boxes around their planes spares work, and no path: nothing comes to light where
    every receiver is offered every chain, some twenty times as many."""
    name, channel = traced
    where = places(6, name, 10)
    judged = asked(channel, name, where, TEN, seed=6)
    seen: list[float] = []

    def all_of_them(planes: Planes, chains: Any, straight: Any, source: Any, targets: Any) -> tuple[Any, Any]:
        some = possible(planes, chains, straight, source, targets)
        every = possible(planes, chains, np.zeros_like(straight), source, targets)
        seen.append(len(every[0]) / len(some[0]))
        return every

    possible = Planes.possible
    monkeypatch.setattr(Planes, "possible", all_of_them)
    offered = asked(channel, name, where, TEN, seed=6)
    assert min(seen) > 5
    assert digest(offered) == digest(judged)


def test_coinciding_faces_are_told_apart() -> None:
    """Under the houses of the scene lies its ground, and their walls touch: with transmission, rays meet
    two faces in one place. Which of them a path names depends on no other pair."""
    name = "simple_street_canyon_with_cars"
    smooth = model(name, max_depth=2, refraction=True, samples=5_000, materials={})
    for group in range(2):
        where = places(50 + group, name, 10)
        together = asked(smooth, name, where, TEN, group)
        for rx, place in zip(TEN, where, strict=True):
            assert of_receiver(asked(smooth, name, place[None], [rx], group), rx) == of_receiver(together, rx)
