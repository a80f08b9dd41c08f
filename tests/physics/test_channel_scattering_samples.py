"""Diffuse paths that have a launch of their own, beside those of one launch for all."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from same_paths import asked, model, places

from caviar_protocol.topics import Channel, Interaction
from caviar_services.channel.sionna.settings import SionnaSettings

TEN = [f"r{i}" for i in range(10)]
CANYON = "simple_street_canyon_with_cars"


def diffuse(channel: Channel) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    return (channel.interactions == Interaction.SCATTERING).any(1)


def power_db(channel: Channel, rx: int) -> float:
    """Power of a receiver's diffuse paths [dB]; −inf without any."""
    mine = slice(int(channel.offsets[rx]), int(channel.offsets[rx + 1]))
    power = float((np.abs(channel.a[0, mine]) ** 2 * diffuse(channel)[mine]).sum())
    return 10 * math.log10(power) if power else -math.inf


def test_diffuse_paths_are_those_of_their_rays_and_others_those_of_the_others() -> None:
    """Specular paths are equal bit by bit to those without scattering, and diffuse power is that of one
    launch of as many rays for both."""
    where = places(3, CANYON, 10)
    both = {"max_depth": 2, "samples": 20_000, "scattering": True, "scattering_samples": 10_000}
    own = asked(model(CANYON, **both), CANYON, where, TEN)
    mixed = asked(model(CANYON, max_depth=2, samples=10_000, scattering=True), CANYON, where, TEN)
    plain = asked(model(CANYON, max_depth=2, samples=20_000), CANYON, where, TEN)
    kept = ~diffuse(own)
    assert diffuse(own).sum() > 1000
    np.testing.assert_array_equal(own.id[kept], plain.id)
    np.testing.assert_array_equal(own.tau[kept], plain.tau)
    np.testing.assert_array_equal(own.a[:, kept], plain.a)
    powers = [power_db(own, rx) for rx in range(10)]
    assert sum(power > -math.inf for power in powers) > 4  # the others stand within houses
    assert powers == pytest.approx([power_db(mixed, rx) for rx in range(10)], abs=0.01)


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"scattering_samples": 100}, "needs scattering = true"),
        ({"scattering": True, "scattering_samples": 100, "rung": "mimo-rt"}, "leave out scattering_samples"),
        ({"scattering": True, "follow": 5}, "a launch of their own with scattering_samples"),
    ],
)
def test_settings_that_contradict_each_other_are_refused(settings: dict[str, object], reason: str) -> None:
    with pytest.raises(msgspec.ValidationError, match=reason):
        msgspec.convert(settings, SionnaSettings)


def test_diffuse_paths_of_their_own_may_stand_beside_followed_ones() -> None:
    where = places(3, CANYON, 10)
    channel = model(CANYON, max_depth=2, samples=5_000, scattering=True, scattering_samples=500, follow=5)
    found = asked(channel, CANYON, where, TEN)
    assert diffuse(found).any()
    assert not diffuse(found).all()
