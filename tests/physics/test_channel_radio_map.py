"""Radio maps against formulas, and against the channel at points within their cells."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caviar_labs.stability.formulas import C, turn
from caviar_labs.stability.lab import (
    Array,
    Plate,
    Thing,
    antenna,
    measure,
    scene,
    sionna,
    write_scenery,
)
from caviar_protocol.errors import RunError
from caviar_protocol.space.antenna_arrays import dft_codebook, steering_vector
from caviar_protocol.space.coordinates import quaternion_from_euler
from caviar_protocol.topics import AntennaArray, Scene
from caviar_services.channel.paths import Antenna
from caviar_services.channel.radio_map import (
    MeasurementSurface,
    RadioMap,
    draped_surface,
    level_surface,
    radio_map,
    rays_at_once,
    transmitters_of,
)
from caviar_services.channel.sionna.model import SionnaChannel

pytestmark = pytest.mark.channel

FREQUENCY = 28e9
RAYS = 400_000
PART = 100_000


@pytest.fixture(scope="module")
def nothing() -> SionnaChannel:
    """No scenery and no bodies."""
    model = sionna(FREQUENCY, samples=1000, max_depth=1, bodies=0)
    assert isinstance(model, SionnaChannel)
    return model


@pytest.fixture(scope="module")
def yard(tmp_path_factory: pytest.TempPathFactory) -> SionnaChannel:
    """Ground and one wall; a car may stand there."""
    ground = Plate("ground", [(-60, -60, 0), (60, -60, 0), (60, 60, 0), (-60, 60, 0)])
    wall = Plate("wall", [(-40, 20, 0), (40, 20, 0), (40, 20, 12), (-40, 20, 12)], "brick")
    assets = write_scenery(tmp_path_factory.mktemp("yard"), [ground, wall])
    model = sionna(FREQUENCY, assets, samples=50_000, max_depth=2, candidates="launched")
    assert isinstance(model, SionnaChannel)
    return model


def mapped(
    channel: SionnaChannel, at: Scene, surface: MeasurementSurface, samples: int = RAYS, **more: Any
) -> RadioMap:
    options = {"carrier": 0, "beam": "wide", "noise_w": 1e-12, "done": lambda part, parts: None, **more}
    return radio_map(channel, at, surface, samples, **{"part": PART, **options})


def friis(source: Array, surface: MeasurementSurface, fine: int = 8) -> Array:
    """Free-space gain (λ/4πd)² in the mean over the points of each cell."""
    steps = (np.arange(fine) + 0.5) / fine
    x = surface.x[:-1, None] + np.diff(surface.x)[:, None] * steps
    y = surface.y[:-1, None] + np.diff(surface.y)[:, None] * steps
    z = float(surface.z.flat[0]) - source[2]
    squared = (x[None, :, None, :] - source[0]) ** 2 + (y[:, None, :, None] - source[1]) ** 2 + z**2
    return ((C / FREQUENCY / (4 * np.pi)) ** 2 / squared).mean(axis=(2, 3))


def db(ratio: Array) -> Array:
    return 10 * np.log10(ratio)


def test_free_space_is_friis_in_the_mean_over_each_cell(nothing: SionnaChannel) -> None:
    """Within 0.2 dB with 150 rays and more in a cell, and 0.01 dB in the mean; in one part as in several,
    which are the same rays."""
    source = np.array([3.0, -4.0, 12.0])
    surface = level_surface((-20, -20, 20, 20), 4.0, 1.5)
    at = scene([antenna("bs", "tx", source)])
    parts, whole = mapped(nothing, at, surface), mapped(nothing, at, surface, part=RAYS)
    assert parts.rays.min() > 150
    error = db(parts.coverage.gain[0] / friis(source, surface))
    assert np.abs(error).max() < 0.2
    assert abs(error.mean()) < 0.01
    np.testing.assert_allclose(whole.coverage.gain, parts.coverage.gain, rtol=1e-4)
    assert whole.rays.sum() == parts.rays.sum()


def test_a_level_surface_beside_and_above_the_transmitter(nothing: SionnaChannel) -> None:
    """Cells may be far to one side of all, and above; an area need not be whole cells."""
    source = np.array([0.0, 0.0, 2.0])
    surface = level_surface((10.0, 5.0, 21.0, 16.5), 4.0, 9.0)
    assert surface.shape == (3, 3)
    found = mapped(nothing, scene([antenna("bs", "tx", source)]), surface)
    assert np.abs(db(found.coverage.gain[0] / friis(source, surface))).max() < 0.1


def test_sinr_of_two_equal_transmitters(nothing: SionnaChannel) -> None:
    """P·g_1/(N_0 + P·g_2) with Friis' gains, in every cell and of both; each serves its own half."""
    places = np.array([[-15.0, 0.0, 10.0], [15.0, 0.0, 10.0]])
    at = scene([antenna(f"bs{i}", "tx", place, power_dbm=20.0) for i, place in enumerate(places)])
    surface = level_surface((-30, -10, 30, 10), 4.0, 1.5)
    noise = 3e-10
    found = mapped(nothing, at, surface, noise_w=noise).coverage
    gains = np.stack([friis(place, surface) for place in places])
    expected = 0.1 * gains / (noise + 0.1 * gains[::-1])
    assert np.abs(db(found.sinr / expected)).max() < 0.2
    assert (found.best_server[:, :7] == 0).all()
    assert (found.best_server[:, 8:] == 1).all()


@pytest.mark.parametrize(
    "array",
    [
        AntennaArray(rows=2, columns=4, horizontal_spacing=0.7, pattern="tr38901"),
        AntennaArray(rows=3, pattern="dipole"),
    ],
)
def test_each_cell_is_served_by_the_beam_of_the_codebook_that_brings_most(
    nothing: SionnaChannel, array: AntennaArray
) -> None:
    """In small cells: |cᴴ a|² of the codebook and the steering vector, element pattern and Friis at their
    middle; turned about all three axes. While others are served, one element's gain interferes."""
    source, angles = np.array([0.0, 0.0, 8.0]), (0.4, 0.3, -0.2)
    device = antenna("bs", "tx", source, array, orientation=quaternion_from_euler(*angles))
    surface = level_surface((6.0, -3.0, 12.0, 3.0), 0.5, 1.5)
    found = mapped(nothing, scene([device]), surface, beam="best")
    rotation = turn(*angles)
    line = surface.centres - source
    towards = line / np.linalg.norm(line, axis=-1, keepdims=True) @ rotation
    one = replace(Antenna.of(scene([device]), device), rotation=np.eye(3))
    gains = np.abs(steering_vector(one.array, towards) @ dft_codebook(array).conj().T) ** 2
    element = found.coverage.interference_gain[0]
    assert np.abs(db(found.coverage.gain[0] / (element * gains.max(-1)))).max() < 0.1
    clear = np.diff(np.sort(gains, axis=-1)[..., -2:], axis=-1)[..., 0] > 0.1 * gains.max(-1)
    assert clear.mean() > 0.5
    np.testing.assert_array_equal(found.beam[0][clear], gains.argmax(-1)[clear])
    fixed = mapped(nothing, scene([device]), surface, beam=1)
    assert np.abs(db(fixed.coverage.gain[0] / (element * gains[..., 1]))[gains[..., 1] > 0.5]).max() < 0.3


def test_the_gain_is_that_of_the_channel_in_the_mean_over_a_cell(yard: SionnaChannel) -> None:
    """Beside a car, before a wall: the channel's path gains to 4 × 4 points in each cell, those of a vertical
    and of a horizontal receiver together, as the map takes both. What is left are how many rays pass through
    a cell and points at borders of shadows: within 0.3 dB, and 1 dB in cells that the car's shadow cuts."""
    source = antenna("bs", "tx", (-10.0, -8.0, 6.0), AntennaArray(pattern="tr38901"), power_dbm=10.0)
    car = Thing("car", (2.0, 4.0, 0.8), (4.5, 1.8, 1.6))
    surface = level_surface((-6.0, 0.0, 6.0, 12.0), 4.0, 1.2)
    found = mapped(yard, scene([source], [car]), surface, 2 * RAYS)
    steps = (np.arange(4) + 0.5) / 4 * 4.0 - 2.0
    offsets = np.stack([*np.meshgrid(steps, steps), np.zeros((4, 4))], axis=-1).reshape(-1, 3)
    points = (surface.centres[:, :, None] + offsets).reshape(-1, 3)
    receivers = [
        antenna(f"r{i:03}{p}", "rx", point, AntennaArray(polarization=p))  # type: ignore[arg-type]
        for i, point in enumerate(points)
        for p in "HV"
    ]
    channel = measure(yard, scene([source, *receivers], [car]))
    pairs = np.repeat(np.arange(len(receivers)), np.diff(channel.offsets))
    gain = np.bincount(pairs, np.abs(channel.a[0]) ** 2, minlength=len(receivers))
    expected = gain.reshape(3, 3, 16, 2).sum(-1).mean(-1)
    error = np.abs(db(found.coverage.gain[0] / expected))
    assert error.max() < 1.0
    assert np.sort(error.ravel())[:7].max() < 0.3


def test_diffraction_brings_a_signal_into_the_shadow() -> None:
    """Behind a block, of which one edge is in sight of the shadow: 1 to 6 dB above the channel, whose
    coefficients differ, also where rays are shot in parts. Draped surfaces leave it out, with a note."""
    model = sionna(
        FREQUENCY,
        samples=20_000,
        max_depth=1,
        candidates="launched",
        diffraction=True,
        body_material="concrete",
    )
    assert isinstance(model, SionnaChannel)
    block, source = (
        Thing("block", (0.0, 0.0, 4.0), (30.0, 10.0, 8.0)),
        antenna("bs", "tx", (1.0, -30.0, 14.0)),
    )
    area = (-2.0, 10.0, 2.0, 18.0)
    surface = level_surface(area, 4.0, 1.5)
    found = mapped(model, scene([source], [block]), surface)
    receivers = [antenna(f"r{i}", "rx", centre) for i, centre in enumerate(surface.centres.reshape(-1, 3))]
    channel = measure(model, scene([source, *receivers], [block]))
    assert channel.offsets.tolist() == [0, 1, 2]
    error = db(found.coverage.gain.ravel() / np.abs(channel.a[0]) ** 2)
    assert ((error > 1.0) & (error < 6.0)).all()
    slope = np.array([[(-9.0, 0.0, 1.4), (9.0, 0.0, 1.5), (0.0, 40.0, 1.6)]])
    draped = mapped(model, scene([source], [block]), draped_surface(area, 4.0, 0.1, slope))
    assert not draped.coverage.has_signal.any()
    assert "diffraction is left out" in draped.notes[0]
    assert not draped.shooting.diffraction


@pytest.mark.exhaustive  # 5 s of CPU
def test_rims_of_open_surfaces_diffract_where_the_channel_s_do(tmp_path: Path) -> None:
    """Behind a fence of one face, over its upper rim: within 4.5 dB of the channel's mean over the cell.
    Without the rim, the cell is 30 dB darker."""
    fence = Plate("fence", [(-40, 20, 0), (40, 20, 0), (40, 20, 6), (-40, 20, 6)], "metal")
    model = sionna(
        3.5e9,
        write_scenery(tmp_path, [fence]),
        max_depth=1,
        candidates="launched",
        bodies=0,
        diffraction=True,
        free_edges=True,
    )
    assert isinstance(model, SionnaChannel)
    source = antenna("bs", "tx", (1.0, 0.0, 4.0))
    surface = level_surface((-1.0, 23.0, 1.0, 25.0), 2.0, 1.5)
    gain = mapped(model, scene([source]), surface).coverage.gain[0, 0, 0]
    places = [(x, 24 + y, 1.5) for x in (-0.5, 0.5) for y in (-0.75, -0.25, 0.25, 0.75)]
    receivers = [
        antenna(f"r{i}{p}", "rx", place, AntennaArray(polarization=p))  # type: ignore[arg-type]
        for i, place in enumerate(places)
        for p in "HV"
    ]
    channel = measure(model, scene([source, *receivers]))
    expected = (np.abs(channel.a[0]) ** 2).sum() / len(places)
    assert abs(10 * np.log10(gain / expected)) < 4.5


def test_what_no_ray_reaches_has_no_signal(yard: SionnaChannel) -> None:
    """Behind the wall, which is opaque without refraction."""
    at = scene([antenna("bs", "tx", (0.0, 10.0, 6.0))])
    found = mapped(yard, at, level_surface((-10.0, 16.0, 10.0, 24.0), 4.0, 1.5))
    np.testing.assert_array_equal(found.coverage.has_signal, [[True] * 5, [False] * 5])
    assert np.isnan(found.coverage.of_server(found.coverage.sinr)[1]).all()
    assert (found.beam == -1).all()


def test_a_draped_surface_follows_the_ground(nothing: SionnaChannel) -> None:
    """Over a ramp: Friis at the middle of each cell; its tilt makes no difference to the mean gain."""
    corners = np.array([(-20.0, -20.0, 0.0), (20.0, -20.0, 10.0), (20.0, 20.0, 10.0), (-20.0, 20.0, 0.0)])
    ramp = corners[[[0, 1, 2], [0, 2, 3]]]
    surface = draped_surface((-30, -15, 15, 15), 1.5, 1.5, ramp)
    assert surface.covered.mean() == pytest.approx(35 / 45, abs=0.05)
    source = np.array([0.0, 0.0, 25.0])
    found = mapped(nothing, scene([antenna("bs", "tx", source)]), surface, 2 * RAYS)
    distance = np.linalg.norm(surface.centres - source, axis=-1)
    expected = (C / FREQUENCY / (4 * np.pi * distance)) ** 2
    there = surface.covered
    assert np.abs(db(found.coverage.gain[0][there] / expected[there])).max() < 0.6
    assert abs(db(found.coverage.gain[0][there] / expected[there]).mean()) < 0.01
    assert not found.coverage.has_signal[~there].any()


def test_air_absorbs() -> None:
    """60 GHz over the straight line to each cell, after ITU-R P.676: 14.8 dB/km."""
    source, surface = np.array([0.0, 0.0, 10.0]), level_surface((300, 0, 500, 100), 100.0, 1.5)
    air = sionna(60e9, samples=1000, max_depth=0, bodies=0, atmosphere={})
    assert isinstance(air, SionnaChannel)
    found = mapped(air, scene([antenna("bs", "tx", source)]), surface).coverage.gain[0]
    km = np.linalg.norm(surface.centres - source, axis=-1) / 1e3
    free = friis(source, surface, 40) * (28 / 60) ** 2
    np.testing.assert_allclose(db(found / free), -14.8 * km, atol=0.3)


def test_memory_that_does_not_do_names_cells_that_would(nothing: SionnaChannel) -> None:
    devices = transmitters_of(
        scene([antenna("bs", "tx", (0, 0, 10), AntennaArray(columns=64))]), "here", "mm"
    )
    fine, memory = level_surface((0, 0, 1000, 1000), 1.0, 1.5), 2**28
    with pytest.raises(RunError, match=r"1000 × 1000 cells.*64 beams.*2\.\d m"):
        rays_at_once(fine, devices, "best", RAYS, memory)
    assert rays_at_once(level_surface((0, 0, 1000, 1000), 3.0, 1.5), devices, "best", RAYS, memory) > 20_000
