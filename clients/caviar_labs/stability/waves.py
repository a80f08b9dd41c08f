"""Frequencies, distances, grazing incidence, materials and foliage: one ray, and two over flat ground.

Edges: where meshes meet, where light and reflections end, and which edge a path goes over.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import numpy as np

from caviar_labs.stability import formulas
from caviar_labs.stability.case import Outcome, all_of, case, close, equal, worst
from caviar_labs.stability.lab import (
    CONDUCTOR,
    Lab,
    Material,
    Model,
    Plate,
    Point,
    Thing,
    antenna,
    ends,
    free_space,
    link,
    measure,
    pair_sums,
    scene,
    square,
    total,
)
from caviar_protocol.arrays import Complex128Array, Float64Array
from caviar_protocol.topics import AntennaArray, Channel, Interaction

FREQUENCIES = (0.5e9, 2.8e9, 28e9, 60e9, 100e9, 300e9)
LOSSY = Material(5.0, 0.2)
FAR_OUT = np.array([7931.37, -6112.83, 311.19])
"""10 km from the origin."""


def ground(half: float, material: Material = LOSSY) -> Plate:
    """A horizontal square of half a side [m] about the origin."""
    return Plate("ground", square(half), material)


def two_rays(heights: tuple[float, float], distance: float, frequency: float) -> complex:
    """H of vertical antennas over the lossy ground; heights and distance [m]."""
    eta = formulas.permittivity(LOSSY.permittivity, LOSSY.conductivity, frequency)
    return formulas.two_rays(heights, distance, eta, frequency)


def amplitude(channel: Channel) -> float:
    """Amplitude of the only path; 0 where there is none."""
    return abs(total(channel))


# --- frequencies ----------------------------------------------------------------------------


def _in_free_space(frequency: float, lab: Lab) -> Outcome:
    tx, rx = (3.7, -11.2, 24.0), (88.1, 61.9, 7.5)
    d = math.dist(tx, rx)
    expected = formulas.spherical_wave(d, frequency)
    # One traced model for all carriers: its paths are the same, and a warm-up takes seconds.
    models = (free_space(frequency), lab.traced(FREQUENCIES))
    carrier = FREQUENCIES.index(frequency)
    got = [total(link(model, tx, rx), number) for model, number in zip(models, (0, carrier), strict=True)]
    return all_of(*(close("(H)", expected, h, relative=1e-4) for h in got))


def _over_ground(frequency: float, lab: Lab) -> Outcome:
    heights, distance = (11.3, 1.7), 74.2
    model = lab.traced(frequency, [ground(300.0)])
    got = total(link(model, (0, 0, heights[0]), (distance, 0, heights[1])))
    free = formulas.friis(formulas.over_ground(*heights, distance)[0], frequency)
    return close("(H)", two_rays(heights, distance, frequency), got, absolute=2e-3 * free)


for _frequency in FREQUENCIES:
    _name = f"{_frequency / 1e9:g} GHz"
    case("frequency", f"free space at {_name}, free-space and siso-rt")(partial(_in_free_space, _frequency))
    case("frequency", f"two rays over ground at {_name}")(partial(_over_ground, _frequency))


# --- distances ------------------------------------------------------------------------------


def _apart(distance: float, frequency: float, traced: bool, lab: Lab) -> Outcome:
    """Friis from one wavelength on; nearer, no direct path, and the pair is counted."""
    model = lab.traced((60e9, 300e9)) if traced else free_space(frequency)
    carrier = (60e9, 300e9).index(frequency) if traced else 0
    tx = np.array([1.5, -2.25, 10.0])
    channel = link(model, tx, (tx + distance * np.array([0.6, 0.0, 0.8])).tolist())
    # The pair is too close where it is so for the longest wavelength of the model's carriers.
    slowest = 60e9 if traced else frequency
    if distance < formulas.C / slowest:
        return all_of(
            equal(0, len(channel.tau), "paths"), equal(True, bool(channel.los[0, 0]), "line of sight")
        )
    expected = formulas.spherical_wave(distance, frequency)
    got = total(channel, carrier)
    return close("(H)", expected, got, relative=1e-3)


for _distance in (1e-3, 4e-3, 6e-3, 0.02, 0.3, 1.0, 1e3, 5e4):
    _far = f"{_distance * 1e3:g} mm" if _distance < 1 else f"{_distance:g} m"
    case("distance", f"{_far} at 60 GHz, free-space", traced=False)(partial(_apart, _distance, 60e9, False))
    case("distance", f"{_far} at 60 GHz, siso-rt")(partial(_apart, _distance, 60e9, True))


@case("distance", "1 mm at 300 GHz, a wavelength of 0.9993 mm, free-space", traced=False)
def _(lab: Lab) -> Outcome:
    got = amplitude(link(free_space(300e9), (0, 0, 9), (1e-3, 0, 9)))
    return close("|H|", formulas.friis(1e-3, 300e9), got, relative=1e-9)


def _phase(frequency: float, distance: float, origin: Point, lab: Lab) -> Outcome:
    """Phase error of both rays [rad]."""
    out = np.array(origin, np.float64)
    plate = Plate("ground", [(out + corner).tolist() for corner in square(distance)], CONDUCTOR)
    model = lab.traced(frequency, [plate])
    # Places that are no round numbers in binary, so that rounding shows.
    tx, rx = np.array([-0.493, 0.0213, 0.1571]) * distance, np.array([0.507, -0.0137, 0.1193]) * distance
    channel = link(model, (out + tx).tolist(), (out + rx).tolist())
    flat = math.hypot(rx[0] - tx[0], rx[1] - tx[1])
    lengths = formulas.over_ground(tx[2], rx[2], flat)[:2]
    errors = [
        2 * math.pi * frequency * abs(tau - length / formulas.C)
        for tau, length in zip(channel.tau.tolist(), lengths, strict=False)
    ]
    return all_of(equal(2, len(channel.tau), "paths"), worst(errors, 1e-3, "rad", "phase of 2 paths"))


for _f, _d in ((60e9, 2000.0), (300e9, 1000.0)):
    for _where, _origin in (("", np.zeros(3)), (", 10 km from the origin", FAR_OUT)):
        case("distance", f"carrier phase over {_d / 1e3:g} km at {_f / 1e9:g} GHz{_where}")(
            partial(_phase, _f, _d, _origin.tolist())
        )


# --- grazing incidence ----------------------------------------------------------------------


def _grazing(heights: tuple[float, float], distance: float, lab: Lab) -> Outcome:
    """Two rays that all but cancel: relative to the direct one."""
    frequency = 2.8e9
    model = lab.traced(frequency, [ground(1.2 * distance)])
    got = total(link(model, (-distance / 2, 1.0, heights[0]), (distance / 2, 1.0, heights[1])))
    # Both rays all but cancel, so the tolerance is relative to one of them.
    free = formulas.friis(formulas.over_ground(*heights, distance)[0], frequency)
    expected = two_rays(heights, distance, frequency)
    return close("of the direct ray", abs(expected) / free, abs(got) / free, absolute=2e-3)


for _heights, _distance in (((1.5, 1.2), 100.0), ((1.5, 2.0), 2000.0), ((12.0, 1.5), 20_000.0)):
    _angle = math.degrees(math.atan(sum(_heights) / _distance))
    case("grazing", f"{_angle:.2g}° over ground, {_distance:g} m")(partial(_grazing, _heights, _distance))


@case("grazing", "antennas within the plane of a wall")
def _(lab: Lab) -> Outcome:
    """No reflection: the wall is seen edge-on, and hides nothing."""
    wall = Plate("wall", [(-5, 0, 0), (5, 0, 0), (5, 0, 9), (-5, 0, 9)], LOSSY)
    model = lab.traced(28e9, [wall])
    channel = link(model, (-30, 0, 3), (41, 0, 5))
    return close("|H|", formulas.friis(math.dist((-30, 0, 3), (41, 0, 5)), 28e9), amplitude(channel), 1e-4)


# --- materials ------------------------------------------------------------------------------


def _reflection(
    lab: Lab, material: Material, angle_deg: float, polarization: str, frequency: float = 10e9
) -> tuple[complex, float]:
    """Coefficient at flat ground, and the cosine of incidence."""
    height = 7.0
    reach = height * math.tan(math.radians(angle_deg))
    model = lab.traced(frequency, [ground(400.0, material)])
    array = AntennaArray(polarization=polarization)  # type: ignore[arg-type]
    at = scene(ends((-reach, 2, height), (reach, 2, height), array, array))
    channel = measure(model, at)
    reflected = channel.a[0, (channel.interactions == 1).any(1)].sum()
    length = 2 * math.hypot(reach, height)
    free = formulas.spherical_wave(length, frequency)
    # A horizontal element's field turns its sign between the two ends, as they face each other.
    sign = -1.0 if polarization == "H" else 1.0
    return sign * complex(reflected) / free, math.cos(math.radians(angle_deg))


def _conductor(angle_deg: float, lab: Lab) -> Outcome:
    across = _reflection(lab, CONDUCTOR, angle_deg, "H")[0]
    along = _reflection(lab, CONDUCTOR, angle_deg, "V")[0]
    return all_of(close("across", -1.0, across, absolute=0.01), close("along", 1.0, along, absolute=0.01))


def _slab(material: Material, angle_deg: float, lab: Lab) -> Outcome:
    eta = formulas.permittivity(material.permittivity, material.conductivity, 10e9)
    across, cosine = _reflection(lab, material, angle_deg, "H")
    along, _ = _reflection(lab, material, angle_deg, "V")
    expected = formulas.slab(cosine, eta, material.thickness, 10e9)
    return all_of(
        close("across", expected[0], across, absolute=2e-3), close("along", expected[1], along, absolute=2e-3)
    )


GLASS = Material(4.0, 0.0, 0.0123)
for _angle_deg in (5.0, 45.0, 85.0):
    case("material", f"perfect conductor at {_angle_deg:g}°")(partial(_conductor, _angle_deg))
    case("material", f"lossless dielectric, ε 4, 12.3 mm, at {_angle_deg:g}°")(
        partial(_slab, GLASS, _angle_deg)
    )
case("material", "lossless dielectric at Brewster's angle")(
    partial(_slab, GLASS, math.degrees(math.atan(2.0)))
)
case("material", "lossless dielectric of the permittivity of air")(
    partial(_slab, Material(1.0, 0.0, 0.1), 40.0)
)


@case("material", "energy at a lossless dielectric: what is not reflected goes through")
def _(lab: Lab) -> Outcome:
    frequency, angle = 10e9, math.radians(35.0)
    wall = Plate("wall", [(0, -90, -90), (0, 90, -90), (0, 90, 90), (0, -90, 90)], GLASS)
    model = lab.traced(frequency, [wall], refraction=True)
    tx, through = (-6.0, 0.0, 1.0), (6.0, 12 * math.tan(angle), 1.0)
    back = (-6.0, 12 * math.tan(angle), 1.0)
    length = math.dist(tx, through)
    free = formulas.friis(length, frequency)
    # Through and back under the same angle, over the same length.
    passed = amplitude(link(model, tx, through)) / free
    channel = link(model, tx, back)
    mirrored = abs(channel.a[0, (channel.interactions == 1).any(1)].sum()) / free
    return close("(|T|² + |R|²)", 1.0, float(passed**2 + mirrored**2), absolute=2e-3)


# --- foliage ---------------------------------------------------------------------------------


@case("foliage", "10 m of 1.5 dB/m on the line of sight, without a maximum and with one of 12 dB")
def _(lab: Lab) -> Outcome:
    frequency, distance = 28e9, 100.0
    hedge = {
        "attenuation_db_per_m": {"c0": 1.5, "c1": 1.5},
        "maximum_db": {"c1": 12.0},
        "source": "made up",
    }
    model = lab.traced((frequency, frequency), foliage={"hedge": hedge})
    channel = link(model, (0, 0, 2), (distance, 0, 2), Thing("hedge", (50, 0, 2), (10, 8, 6)))
    free = formulas.spherical_wave(distance, frequency)
    lost = formulas.vegetation(10.0, 1.5), formulas.vegetation(10.0, 1.5, 12.0)
    return all_of(
        *(
            close("(H)", free * 10 ** (-db / 20), total(channel, c), relative=1e-5)
            for c, db in enumerate(lost)
        ),
        equal(True, bool(channel.los.all()), "line of sight"),
    )


@case("foliage", "two crowns that overlap, on the way to the ground and back")
def _(lab: Lab) -> Outcome:
    """From (0, 20) over (50, 0) to (100, 20): each crown is 6 m wide, and 8 m are in one of them or both."""
    crowns = {"attenuation_db_per_m": {"c0": 0.5, "c1": 0.0}, "source": "made up"}
    model = lab.traced((3.5e9, 3.5e9), [ground(300.0)], foliage={"crown.*": crowns})
    boxes = [Thing(f"crown.{i}", (x, 0, 10.5), (6, 8, 19)) for i, x in enumerate((23, 25))]
    channel = link(model, (0, 0, 20), (100, 0, 20), *boxes)
    direct, bounced = (
        20 * np.log10(np.abs(channel.a[1, path] / channel.a[0, path])) for path in range(len(channel.tau))
    )
    return all_of(
        close("dB straight", 0.0, float(direct), absolute=1e-6),
        close("dB by the ground", 0.5 * 8 * math.hypot(50, 20) / 50, float(bounced), absolute=1e-6),
    )


MMWAVE = 28e9
STATION = np.array([8.0, 5.0, 3.0])
"""Sees one wall of the corner; its light ends behind the edge x = y = 0."""

ONE: list[Point] = [(0, 0, 0), (0, 40, 0), (0, 40, 9), (0, 0, 9)]
OTHER: list[Point] = [(0, 0, 0), (-40, 0, 0), (-40, 0, 9), (0, 0, 9)]
BOTH: list[Point] = [(0, 0, 0), (0, 40, 0), (0, 40, 9), (0, 0, 9), (-40, 0, 9), (-40, 0, 0)]
CORNER = [Plate("one", ONE, CONDUCTOR), Plate("other", OTHER, CONDUCTOR)]


def _corner(lab: Lab, plates: Sequence[Plate]) -> Model:
    """A model of 50,000 rays that are reflected and diffracted once each."""
    settings = {"diffraction": True, "max_depth": 2, "samples": 50_000, "receivers_at_once": 500}
    return lab.traced(MMWAVE, plates, **settings)


def _along(model: Model, places: Float64Array, *things: Thing) -> Channel:
    """The channels to receivers at these places [m], Shape ``[N, 3]``, in their order."""
    devices = [antenna(f"r{i:05d}", "rx", place) for i, place in enumerate(places.tolist())]
    return measure(model, scene([antenna("t", "tx", STATION.tolist()), *devices], things))


def around(count: int) -> Float64Array:
    """Places in light and in shadow of the corner, on a walk of 9 m about it."""
    angle = np.linspace(-3.0, 1.2, count)
    return np.column_stack([9 * np.cos(angle), 9 * np.sin(angle), np.linspace(1.4, 2.6, count)])


@case("edge", "a corner as two meshes: the same as one mesh")
def _(lab: Lab) -> Outcome:
    one, two = (
        20 * np.log10(np.abs(pair_sums(_along(_corner(lab, plates), around(24)))))
        for plates in ([Plate("both", BOTH, CONDUCTOR)], CORNER)
    )
    return worst(np.abs(two - one).tolist(), 0.01, "dB", "level at 24 places")


def _boundary(image: Float64Array, lab: Lab) -> tuple[Complex128Array, Channel, float]:
    """H in 120 steps of 1 µm across the line where the wave from an image ends, and free space's |H|."""
    # Off the boundary itself by 0.3 µm: there, either answer would be right.
    steps = (np.arange(-60, 60) + 0.3) * 1e-6
    onward = -image / np.linalg.norm(image)
    ground = 10 * onward + steps[:, None] * np.array([-onward[1], onward[0]])
    channel = _along(_corner(lab, CORNER), np.column_stack([ground, np.full(len(steps), 2.0)]))
    return pair_sums(channel), channel, formulas.friis(math.dist((*ground[0], 2.0), STATION), MMWAVE)


@case("edge", "where light ends, in steps of 1 µm: half of free space, without a jump")
def _(lab: Lab) -> Outcome:
    h, channel, free = _boundary(STATION[:2], lab)
    return all_of(
        worst((np.abs(np.diff(h)) / free).tolist(), 0.03, "of free space", "steps"),
        equal(1, int(np.count_nonzero(np.diff(channel.los[0].astype(int)))), "time that light goes out"),
        close("of free space", 0.5, float(np.abs(h[60])) / free, absolute=0.02),
    )


@case("edge", "where a reflection ends, in steps of 1 µm: no jump")
def _(lab: Lab) -> Outcome:
    h, _, free = _boundary(STATION[:2] * [-1, 1], lab)
    return worst((np.abs(np.diff(h)) / free).tolist(), 0.03, "of free space", "steps")


@case("edge", "a free edge: Sommerfeld's half-plane of a conductor, field along its edge")
def _(lab: Lab) -> Outcome:
    """Deep in the shadow; the other rims are so far that their paths are left out."""
    screen = Plate("screen", [(0, 0, -60), (0, 120, -60), (0, 120, 60), (0, 0, 60)], CONDUCTOR)
    settings = {"diffraction": True, "free_edges": True, "samples": 100_000}
    model = lab.traced(MMWAVE, [screen], **settings)
    # Angles from the face on the side of the source, which the screen is at 0 and 2π of.
    at, s_in, s_out = 1.1, 12.0, 8.0
    tx = s_in * np.array([math.sin(at), math.cos(at), 0.0])
    outcomes = []
    for angle in (5.2, 5.5, 5.8):
        rx = s_out * np.array([math.sin(angle), math.cos(angle), 0.0])
        channel = measure(model, scene(ends(tx, rx)))
        # The edge is the z axis; the screen's other rims are far from it.
        over = (channel.interactions[:, 0] == Interaction.DIFFRACTION) & (
            np.abs(channel.points[:, 0]).max(1) < 1e-6
        )
        expected = formulas.behind_half_plane(at, angle, s_in, s_out, MMWAVE)
        outcomes.append(close("|H|", expected, abs(complex(channel.a[0, over].sum())), relative=0.02))
    return all_of(*outcomes)


@case("edge", "2,000 steps about a corner and a car: ids stay with their edges")
def _(lab: Lab) -> Outcome:
    """Edges are farther apart than a point moves from one step to the next."""
    car = Thing("car", (3.0, -3.5, 0.76), quaternion=(math.cos(0.2), 0.0, 0.0, math.sin(0.2)))
    channel = _along(_corner(lab, CORNER), around(2000), car)
    lived = swapped = 0
    last: dict[int, Float64Array] = {}
    for begin, end in zip(channel.offsets[:-1].tolist(), channel.offsets[1:].tolist(), strict=True):
        rows = begin + np.flatnonzero((channel.interactions[begin:end] == Interaction.DIFFRACTION).any(1))
        now = {int(channel.id[row]): channel.points[row] for row in rows}
        both = last.keys() & now.keys()
        lived += len(both)
        swapped += sum(bool(np.abs(last[key] - now[key]).max() > 0.3) for key in both)
        last = now
    return all_of(
        equal(True, lived > 4000, "that paths live on"), equal(0, swapped, f"ids swapped of {lived}")
    )
