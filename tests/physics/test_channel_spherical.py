"""The rungs above plane waves: antenna pairs of their own length and visibility, against closed forms."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from caviar_labs.stability.formulas import (
    C,
    itu_permittivity,
    mirrored,
    reflected,
    spherical_wave,
    turn,
    unit,
    vertical,
)
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
from caviar_protocol.space.coordinates import quaternion_from_euler
from caviar_protocol.topics import AntennaArray, Carrier, Channel
from caviar_services.channel.sionna.model import SionnaChannel
from caviar_services.channel.sionna.settings import SionnaSettings
from caviar_services.service import Preparation, RunInfo

pytestmark = pytest.mark.channel
LONG = pytest.mark.exhaustive

GROUND = Plate("ground", [(-90, -90, 0), (90, -90, 0), (90, 90, 0), (-90, 90, 0)])


def places(array: AntennaArray, centre: Array, angle: Array, frequency: float) -> Array:
    """Where the elements stand [m], written out."""
    grid = [
        [
            0.0,
            (c - (array.columns - 1) / 2) * array.horizontal_spacing,
            ((array.rows - 1) / 2 - r) * array.vertical_spacing,
        ]
        for c in range(array.columns)
        for r in range(array.rows)
    ]
    return centre + (np.array(grid) * C / frequency) @ turn(*angle).T


def distances(receive: Array, transmit: Array) -> Array:
    return np.linalg.norm(receive[:, None] - transmit[None], axis=-1)


def wave(length: Array, frequency: float) -> Array:
    """λ/(4πd) · exp(−j2πd/λ)."""
    return C / frequency / (4 * np.pi * length) * np.exp(-2j * np.pi * length * frequency / C)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.exhaustive) for seed in (1, 2))])
def test_line_of_sight_in_the_near_field_is_exact(seed: int) -> None:
    """Two turned planar arrays a metre apart at 28 GHz, where a plane wave is wrong by radians: every pair
    has the phase of its own distance within 1e-6 rad, and the amplitude of its distance and of the angle
    between the two elements' own polarisations within 2 %."""
    rng = np.random.default_rng(seed)
    angles = np.array([[0.7, 0, 0], [0.7 + np.pi, 0, 0]]) + rng.uniform(-0.4, 0.4, (2, 3))
    ahead = unit(turn(*angles[0]) @ [1.0, *rng.uniform(-0.4, 0.4, 2)])
    centres = [np.array([3.0, -2.0, 5.0]), np.array([3.0, -2.0, 5.0]) + ahead]
    arrays = [AntennaArray(rows=8, columns=4), AntennaArray(rows=3, columns=11, horizontal_spacing=0.9)]
    devices = [
        antenna(name, role, centre, array, orientation=quaternion_from_euler(*angle))
        for name, role, centre, array, angle in zip("tr", ("tx", "rx"), centres, arrays, angles, strict=True)
    ]
    transmit, receive = (places(a, c, g, 28e9) for a, c, g in zip(arrays, centres, angles, strict=True))
    turned = [turn(*angle) for angle in angles]
    polarisation = np.empty((len(receive), len(transmit)))
    for m, n in np.ndindex(polarisation.shape):
        k = unit(receive[m] - transmit[n])
        fields = [axes @ vertical(axes.T @ to) for axes, to in zip(turned, (k, -k), strict=True)]
        polarisation[m, n] = fields[0] @ fields[1]
    expected = wave(distances(receive, transmit), 28e9) * polarisation
    found = {
        rung: measure(sionna(28e9, samples=1000, reflection=False, rung=rung), scene(devices))
        for rung in ("siso-rt", "spherical")
    }
    assert {rung: channel.rung for rung, channel in found.items()} == {rung: rung for rung in found}
    ratio = found["spherical"].h[0].h / expected
    assert np.abs(np.angle(ratio)).max() < 1e-6
    assert np.abs(np.abs(ratio) - 1).max() < 0.02
    assert np.abs(np.angle(found["siso-rt"].h[0].h / expected)).max() > 0.3


def test_two_rays_over_ground_in_the_near_field(tmp_path: Path) -> None:
    """A metre apart and half a metre above the ground at 28 GHz: H of two upright arrays is, pair by pair,
    the closed form of two rays between these two elements, within 0.5 % of the direct one."""
    frequency = 28e9
    model = sionna(frequency, write_scenery(tmp_path, [GROUND]), max_depth=1, rung="spherical")
    tx, rx = np.array([0.3, -0.2, 0.61]), np.array([1.15, 0.33, 0.47])
    arrays = [AntennaArray(rows=4, columns=4), AntennaArray(rows=2, columns=8)]
    angles = np.array([[0.3, 0.0, 0.0], [2.7, 0.0, 0.0]])
    devices = [
        antenna(name, role, centre, array, orientation=quaternion_from_euler(*angle))
        for name, role, centre, array, angle in zip("tr", ("tx", "rx"), (tx, rx), arrays, angles, strict=True)
    ]
    channel = measure(model, scene(devices))
    assert channel.interactions.tolist() == [[0], [1]]
    transmit, receive = (places(a, c, g, frequency) for a, c, g in zip(arrays, (tx, rx), angles, strict=True))
    eta = itu_permittivity(5.24, 0.0, 0.0462, 0.7822, frequency)
    expected = np.empty((len(receive), len(transmit)), complex)
    for m, n in np.ndindex(expected.shape):
        expected[m, n] = two_rays(transmit[n], receive[m], eta, frequency)
    direct = C / frequency / (4 * np.pi * distances(receive, transmit))
    assert (np.abs(channel.h[0].h - expected) / direct).max() < 0.005


def two_rays(tx: Array, rx: Array, eta: complex, frequency: float) -> complex:
    """Direct ray and the one reflected by the ground, of upright elements."""
    up = np.array([0.0, 0.0, 1.0])
    k = unit(rx - tx)
    image = mirrored(tx, np.zeros(3), up)
    out = unit(rx - image)
    incoming = out - 2 * np.dot(out, up) * up
    arrived = reflected(vertical(incoming), incoming, up, eta)
    lengths = (float(np.linalg.norm(rx - tx)), float(np.linalg.norm(rx - image)))
    direct = (vertical(k) @ vertical(-k)) * spherical_wave(lengths[0], frequency)
    return complex(direct + (vertical(-out) @ arrived) * spherical_wave(lengths[1], frequency))


def test_diffraction_over_an_edge_has_the_shortest_way_of_each_pair(tmp_path: Path) -> None:
    """A block hides the receiver: the only paths go over its edge. Each pair's phase is that of the shortest
    way over the edge, found here by a search along it, within 1e-3 rad."""
    frequency = 10e9
    low, high = np.array([-6.0, 0.0, -4.0]), np.array([6.0, 9.0, 0.0])
    x0, y0, z0, x1, y1, z1 = *low, *high
    # One strip of two faces, folded at the edge: triangles of a fan around its first corner
    strip = [(x1, y0, z1), (x1, y1, z1), (x0, y1, z1), (x0, y0, z1), (x0, y0, z0), (x1, y0, z0)]
    model = sionna(
        frequency,
        write_scenery(tmp_path, [Plate("block", strip, "metal")]),
        max_depth=1,
        reflection=False,
        diffraction=True,
        rung="spherical",
        samples=100_000,
    )
    tx, rx = np.array([0.4, -3.0, -1.2]), np.array([-0.7, 2.5, 0.5])
    arrays = [AntennaArray(rows=3, columns=4), AntennaArray(rows=2, columns=3)]
    angles = np.array([[1.4, 0.1, 0.2], [-1.5, 0.3, -0.1]])
    devices = [
        antenna(name, role, centre, array, orientation=quaternion_from_euler(*angle))
        for name, role, centre, array, angle in zip("tr", ("tx", "rx"), (tx, rx), arrays, angles, strict=True)
    ]
    channel = measure(model, scene(devices))
    assert channel.interactions.tolist() == [[2]]
    transmit, receive = (places(a, c, g, frequency) for a, c, g in zip(arrays, (tx, rx), angles, strict=True))

    def shortest(a: Array, b: Array) -> float:
        left, right = -6.0, 6.0
        for _ in range(60):  # a third less each time, around the minimum of a convex function
            third = (right - left) / 3
            one, other = (
                np.linalg.norm(a - [x, 0, 0]) + np.linalg.norm(b - [x, 0, 0])
                for x in (left + third, right - third)
            )
            left, right = (left, right - third) if one < other else (left + third, right)
        return float(np.linalg.norm(a - [left, 0, 0]) + np.linalg.norm(b - [left, 0, 0]))

    lengths = np.array([[shortest(t, r) for t in transmit] for r in receive])
    turns = (lengths - shortest(tx, rx)) * frequency / C
    got = channel.h[0].h / channel.a[0, 0]
    assert np.abs(np.angle(got * np.exp(2j * np.pi * turns))).max() < 1e-3
    assert np.abs(np.abs(got) - 1).max() < 0.1


def test_scattering_keeps_its_points(tmp_path: Path) -> None:
    """Over rough ground, each pair's wave goes by way of the points where the paths were scattered: H from
    the product's own points and amplitudes, by 1/(d·d') and the way of each pair, within 2 %, as the
    elements' polarisations differ a little."""
    frequency = 28e9
    model = sionna(
        frequency,
        write_scenery(tmp_path, [GROUND]),
        max_depth=1,
        los=False,
        reflection=False,
        scattering=True,
        rung="spherical",
        samples=300,
        materials={"skin-ground": {"scattering_coefficient": 0.7}},
    )
    tx, rx = np.array([0.3, -0.2, 1.6]), np.array([2.1, 0.7, 1.1])
    array = AntennaArray(rows=3, columns=3)
    angles = np.array([[0.3, 0.2, 0.1], [2.7, -0.3, 0.4]])
    devices = [
        antenna(name, role, centre, array, orientation=quaternion_from_euler(*angle))
        for name, role, centre, angle in zip("tr", ("tx", "rx"), (tx, rx), angles, strict=True)
    ]
    channel = measure(model, scene(devices))
    assert len(channel.tau) > 20
    assert (channel.interactions == 3).all()
    transmit, receive = (places(array, c, g, frequency) for c, g in zip((tx, rx), angles, strict=True))
    expected = np.zeros((9, 9), complex)
    for a, (point,) in zip(channel.a[0], channel.points, strict=True):
        sent, taken = (np.linalg.norm(x - point, axis=-1) for x in (transmit, receive))
        centres = np.linalg.norm(tx - point), np.linalg.norm(rx - point)
        turns = (taken[:, None] + sent - sum(centres)) * frequency / C
        loss = centres[0] * centres[1] / (taken[:, None] * sent)
        expected += a * loss * np.exp(-2j * np.pi * turns)
    assert np.abs(channel.h[0].h - expected).max() < 0.02 * np.abs(expected).max()


@pytest.mark.parametrize("edge", [0.263, 0.237])
def test_elements_behind_a_screen_receive_nothing(tmp_path: Path, edge: float) -> None:
    """The edge of a screen stands between the arrays: of 24×20 pairs, those whose straight line passes
    beside it have their wave, the others have none, whether the arrays' centres see each other or do not.
    The lines are tested here by hand."""
    frequency = 6e9
    screen = Plate("screen", [(2, edge, -3), (2, 6, -3), (2, 6, 9), (2, edge, 9)], "metal")
    tx, rx = np.array([0.0, 0.2, 1.0]), np.array([4.0, 0.3, 1.1])
    arrays = [AntennaArray(columns=20), AntennaArray(rows=2, columns=12)]
    angles = np.array([[0.0, 0.0, 0.0], [np.pi, 0.0, 0.0]])
    devices = [
        antenna(name, role, centre, array, orientation=quaternion_from_euler(*angle))
        for name, role, centre, array, angle in zip("tr", ("tx", "rx"), (tx, rx), arrays, angles, strict=True)
    ]
    model = sionna(frequency, write_scenery(tmp_path, [screen]), reflection=False, rung="spherical")
    transmit, receive = (places(a, c, g, frequency) for a, c, g in zip(arrays, (tx, rx), angles, strict=True))
    passes = (receive[:, None, 1] + transmit[None, :, 1]) / 2 < edge
    assert passes.any()
    assert not passes.all()
    began = time.monotonic()
    channel = measure(model, scene(devices))
    assert time.monotonic() - began < 10.0, "a loop of the solver ran through all 32-bit numbers"
    h = channel.h[0].h
    assert channel.los.tolist() == [[edge > 0.25]]
    assert len(channel.tau) == int(edge > 0.25)
    assert np.array_equal(h != 0, passes)
    expected = wave(distances(receive, transmit), frequency)
    assert np.abs(np.angle(h[passes] / expected[passes])).max() < 1e-5
    assert np.abs(np.abs(h[passes] / expected[passes]) - 1).max() < 0.01


STREET = [
    Plate("ground", [(-60, -10, 0), (60, -10, 0), (60, 10, 0), (-60, 10, 0)]),
    Plate("north", [(-60, 10, 0), (60, 10, 0), (60, 10, 20), (-60, 10, 20)], "brick"),
    Plate("south", [(60, -10, 0), (-60, -10, 0), (-60, -10, 20), (60, -10, 20)], "glass"),
]
CARS = [Thing("car1", (6.0, 2.0, 0.75)), Thing("car2", (-9.0, -3.0, 0.75), quaternion=(0.0, 0.0, 0.0, 1.0))]


def test_spherical_waves_agree_with_traces_between_all_elements(tmp_path: Path) -> None:
    """A street with two cars at 28 GHz, an 8×2 array of patches 5 m above it and three receivers of four
    elements, near and far: both rungs agree to −50 dB NMSE, plane waves do not, and the products' paths are
    the same."""
    devices = [
        antenna(
            "t",
            "tx",
            (0, -9.0, 5),
            AntennaArray(rows=2, columns=8, pattern="tr38901"),
            orientation=quaternion_from_euler(1.5, 0.1, 0),
        ),
        *(
            antenna(f"r{i}", "rx", at, AntennaArray(columns=4), orientation=quaternion_from_euler(i, 0.1, 0))
            for i, at in enumerate([(1.5, -3.0, 1.6), (6.0, 2.0, 1.65), (-23.0, 4.0, 1.4)])
        ),
    ]
    at, assets = scene(devices, CARS), write_scenery(tmp_path, STREET)
    found = {
        rung: measure(sionna(28e9, assets, max_depth=2, rung=rung), at)
        for rung in ("siso-rt", "spherical", "mimo-rt")
    }
    reference = found["mimo-rt"]
    assert [len(channel.tau) for channel in found.values()] == [len(reference.tau)] * 3
    assert np.array_equal(found["spherical"].a, reference.a)

    def nmse(channel: Channel, pair: int) -> float:
        error = np.abs(channel.h[pair].h - reference.h[pair].h) ** 2
        return float(10 * np.log10(error.sum() / (np.abs(reference.h[pair].h) ** 2).sum()))

    assert max(nmse(found["spherical"], pair) for pair in range(3)) < -50
    assert nmse(found["siso-rt"], 0) > -45


@pytest.mark.parametrize("los", [True, pytest.param(False, marks=pytest.mark.exhaustive)])
def test_every_pair_traced_on_two_carriers(tmp_path: Path, los: bool) -> None:
    """Arrays are given in wavelengths, so each carrier has elements of its own: over ground at 2 and 5 GHz
    both rungs agree to 3 % on each, with and without the straight path."""
    assets = write_scenery(tmp_path, [GROUND])
    arrays = AntennaArray(columns=3), AntennaArray(rows=2)
    devices = [antenna("t", "tx", (0, 0, 3), arrays[0]), antenna("r", "rx", (7, 1, 2), arrays[1])]
    one, other = (
        measure(sionna((2e9, 5e9), assets, rung=rung, los=los), scene(devices))
        for rung in ("spherical", "mimo-rt")
    )
    assert [(h.carrier, h.h.shape) for h in other.h] == [(0, (2, 3)), (1, (2, 3))]
    for got, reference in zip(one.h, other.h, strict=True):
        assert np.abs(got.h - reference.h).max() < 10**-1.5 * np.abs(reference.h).max()
    assert len(other.tau) == 1 + los


def test_no_elements_see_anything(tmp_path: Path) -> None:
    """Behind a wall H is there, and zero."""
    wall = Plate("wall", [(5, -50, -50), (5, 50, -50), (5, 50, 50), (5, -50, 50)], "metal")
    devices = [antenna("t", "tx", (0, 0, 3), AntennaArray(columns=3)), antenna("r", "rx", (9, 1, 2))]
    for rung in ("spherical", "mimo-rt"):
        model = sionna(5e9, write_scenery(tmp_path, [wall]), rung=rung, max_depth=1)
        channel = measure(model, scene(devices))
        assert channel.h[0].h.tolist() == [[0, 0, 0]]


@pytest.mark.parametrize("rung", ["spherical", "mimo-rt"])
def test_air_absorbs_between_elements_too(rung: str) -> None:
    """At 60 GHz over 400 m every element of H loses what the path of the product loses, 6 dB or so."""
    devices = [antenna("t", "tx", (0, 0, 3), AntennaArray(columns=3)), antenna("r", "rx", (400, 1, 2))]
    clear, damped = (
        measure(sionna(60e9, reflection=False, samples=1000, rung=rung, **more), scene(devices))
        for more in ({}, {"atmosphere": {}})
    )
    loss = np.abs(damped.a[0, 0] / clear.a[0, 0])
    assert -20 * np.log10(loss) == pytest.approx(6, abs=1)
    assert np.abs(damped.h[0].h / clear.h[0].h - loss).max() < 1e-6


def test_the_memory_bound_changes_nothing_but_the_chunks(tmp_path: Path) -> None:
    """With so little memory that each receiving element is handled by itself, H is the same to the bit."""
    assets = write_scenery(tmp_path, STREET)
    devices = [
        antenna("t", "tx", (0, -9.0, 5), AntennaArray(columns=2)),
        antenna("r", "rx", (6.0, 2.0, 1.65), AntennaArray(columns=3)),
    ]
    one, other = (
        measure(sionna(28e9, assets, max_depth=2, rung="mimo-rt", memory_gib=bound), scene(devices, CARS))
        for bound in (4.0, 1e-6)
    )
    assert np.array_equal(one.h[0].h, other.h[0].h)
    assert np.abs(one.h[0].h).min() > 0


OUT = np.array([7931.37, -6112.83, 311.19])
"""[m]; 10 km from the origin, where the step of float32 is a quarter of a wavelength at 300 GHz."""


def moved(plates: list[Plate], by: Array) -> list[Plate]:
    return [replace(plate, corners=[np.array(corner) + by for corner in plate.corners]) for plate in plates]


@pytest.mark.parametrize(
    ("rung", "more"),
    [
        pytest.param("spherical", {"max_depth": 2}, marks=pytest.mark.exhaustive),
        ("spherical", {"max_depth": 2, "refraction": True}),
        ("mimo-rt", {"max_depth": 2}),
    ],
    ids=["spherical", "spherical, with transmission", "mimo-rt"],
)
def test_far_from_the_origin_matrices_are_the_same(
    tmp_path: Path, rung: str, more: dict[str, object]
) -> None:
    """The street with its cars and antennas 10 km out, at 28 GHz: the phase of every element of H is that of
    the street at the origin within 1e-3 rad."""
    array, line = AntennaArray(rows=2, columns=8), AntennaArray(columns=4)
    found = []
    for number, offset in enumerate((np.zeros(3), OUT)):
        folder = tmp_path / str(number)
        folder.mkdir()
        model = sionna(28e9, write_scenery(folder, moved(STREET, offset)), rung=rung, **more)
        at = [offset + np.array(place) for place in ((0, -9.0, 5), (1.5, -3.0, 1.6), (-23.0, 4.0, 1.4))]
        devices = [
            antenna("t", "tx", at[0], array, orientation=quaternion_from_euler(1.5, 0.1, 0)),
            antenna("r", "rx", at[1], line, orientation=quaternion_from_euler(1, 0.1, 0)),
            antenna("s", "rx", at[2], line),
        ]
        things = [replace(car, position=tuple(np.array(car.position) + offset)) for car in CARS]
        found.append(measure(model, scene(devices, things)))
    for here, there in zip(found[0].h, found[1].h, strict=True):
        assert np.abs(np.angle(there.h / here.h)).max() < 1e-3
        assert np.abs(there.h / here.h - 1).max() < 2e-3


@pytest.mark.parametrize("rung", ["spherical", "mimo-rt"])
@pytest.mark.parametrize(
    ("apart", "los"),
    [
        pytest.param(apart, los, marks=() if (apart, los) in ((1e-3, True), (0.045, False)) else LONG)
        for apart in (1e-3, 1e-2, 0.045)
        for los in (True, False)
    ],
)
def test_arrays_next_to_each_other_and_on_surfaces(
    tmp_path: Path, rung: str, los: bool, apart: float
) -> None:
    """On the ground, on the roof of a car, and millimetres from another antenna H is finite. No wave goes
    straight between elements nearer than a wavelength, nor between antennas but where each pair is traced."""
    assets = write_scenery(tmp_path, STREET)
    model = sionna(28e9, assets, max_depth=1, rung=rung, los=los, diffraction=True, refraction=True)
    array = AntennaArray(rows=2, columns=4)
    devices = [
        antenna("high", "tx", (0, 0, 3), array),
        antenna("roof", "tx", (6.0, 2.0, 1.5), array),
        antenna("above", "rx", (apart, 0, 3), array),
        antenna("ground", "rx", (2, 1, 0), array),
        antenna("there", "tx", (2, 1, 0), array),
        antenna("beside", "rx", (6.0, 2.0 + apart, 1.5), array),
    ]
    channel = measure(model, scene(devices, CARS))
    assert channel.dropped == 0
    assert all(np.isfinite(matrix.h).all() for matrix in channel.h)
    centres = [np.array([x, 0.0, 3.0]) for x in (0.0, apart)]
    transmit, receive = (places(array, centre, np.zeros(3), 28e9) for centre in centres)
    direct = wave(distances(receive, transmit), 28e9)
    far = np.abs(direct) < 1 / (4 * np.pi)
    if rung == "spherical":
        far &= apart >= C / 28e9
    (h,) = (m.h for m in channel.h if (channel.tx[m.tx], channel.rx[m.rx]) == ("high", "above"))
    assert np.abs(h[~far]).max(initial=0) < 1e-3
    if los:
        assert np.abs(np.angle(h[far] / direct[far])).max(initial=0) < 0.05
    else:
        assert np.abs(h).max() < 1e-3


@pytest.mark.parametrize("rung", ["spherical", "mimo-rt"])
def test_a_pair_of_arrays_too_near_for_the_ray_tracer_has_its_waves(rung: str) -> None:
    """Arrays 4 cm apart at 60 GHz, λ = 5 mm, side by side in front of each other: every pair of elements has
    the phase of its own distance within 1e-6 rad."""
    array = AntennaArray(columns=3)
    devices = [antenna("t", "tx", (1, 2, 3), array), antenna("r", "rx", (1.04, 2, 3), array)]
    channel = measure(sionna(60e9, reflection=False, samples=1000, rung=rung), scene(devices))
    still = np.zeros(3)
    transmit, receive = (places(array, np.array(at), still, 60e9) for at in ([1, 2, 3], [1.04, 2, 3]))
    expected = wave(distances(receive, transmit), 60e9)
    assert np.abs(np.angle(channel.h[0].h / expected)).max() < 1e-6
    assert np.abs(np.abs(channel.h[0].h / expected) - 1).max() < 0.01


@pytest.mark.parametrize("rung", ["spherical", "mimo-rt"])
def test_over_the_band_every_antenna_pair_has_the_delay_of_its_own_distance(rung: str) -> None:
    """A car two metres in front of a planar array, in line of sight: H(f) and H(t) are those of the distances
    between elements; one delay for all of them would be off by a quarter of a radian at the band's edge."""
    numerology = {"subcarriers": 9, "subcarrier_spacing_hz": 250e6, "taps": 24, "slots": 2}
    carrier = Carrier(
        name="c",
        frequency_hz=28e9,
        bandwidth_hz=2.5e9,
        slot_duration_s=3e-3,
        **numerology,  # type: ignore[arg-type]
    )
    arrays = AntennaArray(rows=2, columns=12), AntennaArray(columns=5)
    speed = np.array([4.0, -11.0, 0.0])
    car = Thing("car", (2.0, 0.6, 0.0), (0.2, 0.2, 0.1), velocity=tuple(speed.tolist()))
    devices = [
        antenna("t", "tx", (0, 0, 1), arrays[0]),
        antenna("r", "rx", (0, 0, 1.0), arrays[1], parent="car"),
    ]
    model = SionnaChannel(
        SionnaSettings(rung=rung, reflection=False, samples=1000),  # type: ignore[arg-type]
        RunInfo(name="channel", carriers=(carrier,)),
    )
    model.prepare(Preparation(demand={"channel": frozenset({"h", "hf", "taps"})}))
    channel = measure(model, scene(devices, [car]))
    transmit, receive = (
        places(array, np.array(centre), np.zeros(3), 28e9)
        for array, centre in zip(arrays, ([0, 0, 1], [2.0, 0.6, 1.0]), strict=True)
    )
    tau = distances(receive, transmit) / C
    along = receive[:, None] - transmit
    rate = -(along @ speed) / np.linalg.norm(along, axis=-1) / C
    if rung == "spherical":  # elements share the Doppler shift of the path between the arrays' centres
        rate = np.full(rate.shape, channel.doppler[0, 0] / 28e9)
        assert rate[0, 0] == pytest.approx(-unit(np.array([2.0, 0.6, 0.0])) @ speed / C, rel=1e-9)
    h, response, taps = channel.h[0].h, channel.hf[0].h, channel.taps[0]
    for s, t in enumerate((0.0, 3e-3)):
        delay = tau - rate * t
        turned = h * np.exp(2j * np.pi * 28e9 * rate * t)
        f = (np.arange(9) - 4)[:, None, None] * 250e6
        assert np.abs(response[s] - turned * np.exp(-2j * np.pi * f * delay)).max() < 1e-6 * np.abs(h).max()
        samples = taps.first + np.arange(24)[:, None, None] - 2.5e9 * delay
        assert np.abs(taps.h[s] - turned * np.sinc(samples)).max() < 1e-6 * np.abs(h).max()
    assert 2 * np.pi * 1e9 * np.abs(tau - channel.tau[0]).max() > 0.2
