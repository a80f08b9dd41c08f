"""Diffuse paths that are chosen among all points that rays met, and stand for the others."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from same_paths import asked, model, of_receiver, places

from caviar_protocol.topics import Channel, Interaction
from caviar_services.channel.sionna.settings import SionnaSettings

TEN = [f"r{i}" for i in range(10)]
CANYON = "simple_street_canyon_with_cars"
ROUGH = {"max_depth": 2, "samples": 3_000, "scattering": True}


def powers(channel: Channel) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Power of each receiver's diffuse paths."""
    diffuse = (channel.interactions == Interaction.SCATTERING).any(1)
    power = np.abs(channel.a[0]) ** 2 * diffuse
    return np.add.reduceat(np.append(power, 0.0), channel.offsets[:-1]) * (np.diff(channel.offsets) > 0)


@pytest.mark.exhaustive
def test_power_of_the_chosen_is_in_the_mean_that_of_all_points() -> None:
    """Over 40 choices among one launch's points, to four standard errors and 0.5 % each, and 3 % in all."""
    where = places(3, CANYON, 10)
    settings = {**ROUGH, "scattering_samples": 4_000, "launch_seed": 7}
    all_points = powers(asked(model(CANYON, **settings, scattering_paths=1_000_000), CANYON, where, TEN))
    channel = model(CANYON, **settings, scattering_paths=60)
    found = []
    for offset in np.random.default_rng(1).integers(2**32, size=40, dtype=np.uint64):
        channel._finder._diffuse._thinning._offset = offset  # type: ignore[attr-defined]
        found.append(powers(asked(channel, CANYON, where, TEN)))
    reached = all_points > 0
    assert reached.sum() > 4  # the others stand within houses
    relative = np.array(found)[:, reached] / all_points[reached]
    error = relative.std(0, ddof=1) / np.sqrt(len(found))
    assert (np.abs(relative.mean(0) - 1) < 4 * error + 0.005).all(), (relative.mean(0), error)
    assert relative.mean() == pytest.approx(1, abs=0.03)


@pytest.mark.exhaustive
def test_all_points_bring_what_those_that_are_drawn_bring() -> None:
    """A launch in which each point counts, and one in which points are drawn: ten times the rays, to 0.5 dB
    in the sum over the receivers."""
    where = places(3, CANYON, 10)
    every = powers(
        asked(model(CANYON, **ROUGH, scattering_samples=40_000, scattering_paths=2_000), CANYON, where, TEN)
    )
    drawn = powers(asked(model(CANYON, **ROUGH, scattering_samples=400_000), CANYON, where, TEN))
    assert 10 * np.log10(every.sum() / drawn.sum()) == pytest.approx(0, abs=0.5)


def test_no_more_are_found_than_are_wanted() -> None:
    """At each of ten receivers, to half as many again: also ends after a diffuse point are among them."""
    where = places(8, CANYON, 10)
    found = asked(model(CANYON, **ROUGH, scattering_samples=20_000, scattering_paths=100), CANYON, where, TEN)
    diffuse = (found.interactions == Interaction.SCATTERING).any(1)
    counts = np.add.reduceat(np.append(diffuse, False).astype(np.int64), found.offsets[:-1]) * (
        np.diff(found.offsets) > 0
    )
    assert counts.max() < 150
    assert counts.max() > 30


def test_paths_do_not_depend_on_who_else_receives() -> None:
    """Alone, in another order and among ten, at once or in parts: bit by bit the same."""
    where = places(11, CANYON, 10)
    settings = {**ROUGH, "scattering_samples": 3_000, "scattering_paths": 50}
    channel = model(CANYON, **settings)
    together = asked(channel, CANYON, where, TEN)
    turned = asked(channel, CANYON, where[::-1], TEN[::-1])
    in_parts = asked(model(CANYON, **settings, receivers_at_once=3), CANYON, where, TEN)
    for i, rx in enumerate(TEN):
        alone = of_receiver(asked(channel, CANYON, where[i : i + 1], [rx]), rx)
        assert alone == of_receiver(together, rx)
        assert alone == of_receiver(turned, rx)
        assert alone == of_receiver(in_parts, rx)
    assert (together.interactions == Interaction.SCATTERING).any()


def test_the_seed_of_the_launch_chooses() -> None:
    where = places(3, CANYON, 10)
    settings = {**ROUGH, "scattering_samples": 3_000, "scattering_paths": 50}
    one, other = (asked(model(CANYON, **settings, launch_seed=seed), CANYON, where, TEN) for seed in (1, 2))
    assert one.a.tobytes() != other.a.tobytes()


def test_choosing_needs_a_launch_of_its_own() -> None:
    with pytest.raises(msgspec.ValidationError, match="give scattering_samples"):
        msgspec.convert({"scattering": True, "scattering_paths": 100}, SionnaSettings)
