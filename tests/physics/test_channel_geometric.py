"""The geometric model against free space, its stated distributions and the setting of the paper."""

from __future__ import annotations

import numpy as np
import pytest

from caviar_labs.stability.formulas import spherical_wave
from caviar_labs.stability.lab import Thing, antenna, free_space, geometric, measure, scene
from caviar_protocol.space.coordinates import quaternion_from_euler
from caviar_protocol.topics import AntennaArray, Channel, Scene

C = 299_792_458.0
BS = (3.0, -2.0, 11.0)
DFT = np.exp(-2j * np.pi * np.outer(np.arange(64), np.arange(64)) / 64) / 8


def at_azimuth(degrees: float, columns: int = 1, yaw: float = 0.0) -> Scene:
    """A base station, and a moving tilted UAV 80 m from it and 8 m higher, seen under an azimuth."""
    angle = np.radians(degrees)
    place = (BS[0] + 80 * np.cos(angle), BS[1] + 80 * np.sin(angle), BS[2] + 8)
    uav = Thing(
        "uav", place, (0.6, 0.6, 0.2), quaternion_from_euler(1.0, 0.2, -0.3), velocity=(7.0, -4.0, 2.0)
    )
    station = antenna(
        "bs", "tx", BS, AntennaArray(columns=columns), orientation=quaternion_from_euler(np.radians(yaw))
    )
    return scene([station, antenna("uav/rx", "rx", (0, 0, 0), parent="uav")], [uav])


def line_of(world: Scene) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    line: np.ndarray[tuple[int, ...], np.dtype[np.float64]] = world.position[0] - np.array(BS)
    return line


def many(world: Scene, frames: int, **settings: object) -> list[Channel]:
    model = geometric(28e9, **settings)
    return [measure(model, world, number) for number in range(frames)]


def wrapped(
    angle: np.ndarray[tuple[int, ...], np.dtype[np.float64]],
) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return (angle + np.pi) % (2 * np.pi) - np.pi


def test_the_straight_line_is_that_of_free_space() -> None:
    """Angles, delay and Doppler shift; with path-loss also the amplitude, times sqrt(K / (K + 1))."""
    world = at_azimuth(50.0)
    drawn = measure(geometric(28e9, 3.5e9, normalization="path-loss", k_factor_db=6.0), world)
    exact = measure(free_space(28e9, 3.5e9), world)
    assert drawn.los.all()
    assert drawn.tau[0] == pytest.approx(exact.tau[0], rel=1e-14)
    np.testing.assert_allclose(drawn.aod[0], exact.aod[0], atol=1e-14)
    np.testing.assert_allclose(drawn.aoa[0], exact.aoa[0], atol=1e-14)
    np.testing.assert_allclose(drawn.doppler[:, 0], exact.doppler[:, 0], rtol=1e-12)
    share = np.sqrt(10**0.6 / (10**0.6 + 1))
    for carrier, frequency in enumerate((28e9, 3.5e9)):
        wave = spherical_wave(float(np.linalg.norm(line_of(world))), frequency)
        assert drawn.a[carrier, 0] == pytest.approx(share * wave, rel=1e-8)


def test_doppler_shifts_follow_from_velocities_and_directions() -> None:
    """f/c · (v_tx · departure + v_rx · arrival), both directions outwards; the transmitter flies too."""
    things = [
        Thing("a", (0, 0, 20), velocity=(10.0, -3.0, 1.0)),
        Thing("b", (60, -25, 40), velocity=(-2.0, 8.0, -4.0)),
    ]
    ends = [antenna("a/t", "tx", (0, 0, 0), parent="a"), antenna("b/r", "rx", (0, 0, 0), parent="b")]
    channel = measure(geometric(28e9, nlos="angle", nlos_azimuth_deg=[-180, 180]), scene(ends, things))
    assert not channel.los.any()
    for p in range(3):
        out, back = (
            np.array([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)])
            for zenith, azimuth in (channel.aod[p], channel.aoa[p])
        )
        speed = np.dot(things[0].velocity, out) + np.dot(things[1].velocity, back)
        assert channel.doppler[0, p] == pytest.approx(28e9 / C * speed, rel=1e-9)


def test_reflections_are_drawn_from_the_stated_distributions() -> None:
    """Angles, power and phase of 2 · 4000 components; delays of a blocked pair, whose components are all
    drawn; bounds of five standard errors.

    A Laplacian of standard deviation σ has a mean magnitude of σ/√2, so that both are looked at.
    """
    world = at_azimuth(200.0)
    spreads = {"azimuth_spread_departure_deg": 12.0, "azimuth_spread_arrival_deg": 20.0}
    channels = many(world, 4000, k_factor_db=6.0, **spreads)
    line, five = measure(free_space(28e9), world), 5 / np.sqrt(8000)
    blocked = many(world, 3000, delay_spread_ns=50.0, nlos="angle", nlos_azimuth_deg=[190, 210])
    excess = np.concatenate([c.tau - line.tau[0] for c in blocked])
    assert excess.min() > 0
    assert excess.mean() == pytest.approx(50e-9, rel=five)
    assert np.median(excess) == pytest.approx(50e-9 * np.log(2), rel=1.5 * five)
    expected = {("aod", 0): 1.0, ("aod", 1): 12.0, ("aoa", 0): 4.0, ("aoa", 1): 20.0}
    for (end, axis), spread in expected.items():
        turn = np.concatenate([getattr(c, end)[1:, axis] for c in channels]) - getattr(line, end)[0, axis]
        off = np.degrees(wrapped(turn))
        assert off.mean() == pytest.approx(0.0, abs=five * spread)
        assert off.std() == pytest.approx(spread, rel=1.5 * five)
        assert np.abs(off).mean() == pytest.approx(spread / np.sqrt(2), rel=five)
    gain = np.concatenate([c.a[0, 1:] for c in channels])
    power = np.abs(gain) ** 2
    assert power.mean() == pytest.approx(1 / (2 * (10**0.6 + 1)), rel=five)
    assert power.std() == pytest.approx(power.mean(), rel=3 * five)  # exponential: Rayleigh amplitudes
    assert abs(np.mean(gain / np.abs(gain))) < five


@pytest.mark.parametrize("azimuth", [25.0, 31.0])
def test_the_mean_power_is_one_with_and_without_line_of_sight(azimuth: float) -> None:
    """Unit normalisation: mean of Σ|a|² over 4000 frames, within five standard errors of a blocked pair."""
    channels = many(at_azimuth(azimuth), 4000, nlos="angle", nlos_azimuth_deg=[20, 30])
    power = np.mean([(np.abs(c.a[0]) ** 2).sum() for c in channels])
    assert power == pytest.approx(1.0, abs=5 / np.sqrt(3 * 4000))


def test_the_line_is_blocked_within_the_range_and_only_there() -> None:
    """Azimuths in the station's own axes, whatever way it looks."""
    model = geometric(28e9, nlos="angle", nlos_azimuth_deg=[20, 30])
    for yaw in (0.0, -75.0):
        for azimuth in (-170.0, 19.9, 20.1, 25.0, 29.9, 30.1, 205.0):
            channel = measure(model, at_azimuth(azimuth + yaw, yaw=yaw))
            straight = channel.tau[0] == pytest.approx(np.linalg.norm(line_of(at_azimuth(azimuth))) / C)
            assert channel.los[0, 0] == straight == (not 20 < azimuth < 30)
            assert len(channel.tau) == 3


def test_without_line_of_sight_the_stated_loss_comes_on_top() -> None:
    """Path-loss: mean power of 4000 blocked frames is 13 dB below Friis."""
    world = at_azimuth(25.0)
    blocked = {"nlos": "angle", "nlos_azimuth_deg": [20, 30], "nlos_loss_db": 13.0}
    channels = many(world, 4000, normalization="path-loss", **blocked)
    power = np.mean([(np.abs(c.a[0]) ** 2).sum() for c in channels])
    friis = abs(spherical_wave(float(np.linalg.norm(line_of(world))), 28e9)) ** 2
    assert power / friis == pytest.approx(10**-1.3, rel=5 / np.sqrt(3 * 4000))


def test_matrices_are_sums_of_plane_waves() -> None:
    """H against exp(j2π k·r) of elements λ/2 apart along the turned array's y axis."""
    world = at_azimuth(-40.0, columns=64, yaw=33.0)
    channel = measure(geometric(60e9), world)
    zenith, azimuth = channel.aod.T
    y = np.sin(zenith) * np.sin(azimuth - np.radians(33.0))  # direction cosine along the row
    phases = np.exp(2j * np.pi * y[:, None] * (np.arange(64) - 31.5) / 2)
    np.testing.assert_allclose(channel.h[0].h[0], channel.a[0] @ phases, atol=1e-10)


def test_mean_of_the_optimum_in_the_setting_of_the_paper() -> None:
    """64-element ULA, DFT codebook, one antenna at RX; the paper reports a mean optimum of 6.81.

    A lone wave of power 1 loses up to 2/π between two beams, and has ∫ sinc = 0.873 of 8 on average over
    uniform spatial frequencies: 6.98. Drawn reflections move the mean by some tenths. Azimuths are
    uniform over ±60° here, 1500 frames.
    """
    model = geometric(60e9, nlos="angle", nlos_azimuth_deg=[20, 30])
    rng = np.random.default_rng(4)
    free, blocked, norm = [], [], []
    for number in range(1500):
        channel = measure(model, at_azimuth(float(rng.uniform(-60, 60)), columns=64), number)
        (free if channel.los[0, 0] else blocked).append(np.abs(channel.h[0].h @ DFT).max())
        norm.append((np.abs(channel.h[0].h) ** 2).sum())
    assert np.mean(norm) == pytest.approx(64.0, rel=0.06)
    assert np.mean(free) == pytest.approx(6.98, abs=0.4)
    assert np.mean([*free, *blocked]) == pytest.approx(6.81, abs=0.4)
    assert np.mean(blocked) < np.mean(free)


def test_element_patterns_weigh_both_ends() -> None:
    """Path-loss: a 3GPP element adds 8 dBi at boresight (TR 38.901, table 7.3-1)."""
    model = geometric(28e9, components=1, normalization="path-loss")
    heard = antenna("r", "rx", (90, 0, 5))
    iso = measure(model, scene([antenna("t", "tx", (0, 0, 5)), heard]))
    element = AntennaArray(pattern="tr38901")
    sector = measure(model, scene([antenna("t", "tx", (0, 0, 5), element), heard]))
    assert 20 * np.log10(abs(sector.a[0, 0] / iso.a[0, 0])) == pytest.approx(8.0, abs=1e-9)
