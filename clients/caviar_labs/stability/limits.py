"""Cases of counts and inputs: none, one, a thousand paths; up to 65,536 elements; NaN and infinity.

Cases of places and meshes: antennas at one point, on surfaces, inside; degenerate triangles.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from caviar_labs.stability import formulas
from caviar_labs.stability.case import Outcome, all_of, case, close, equal, refused, worst
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
    geometric,
    link,
    measure,
    only_reflection,
    room,
    scene,
    square,
    total,
)
from caviar_labs.stability.waves import LOSSY, ground, two_rays
from caviar_protocol.arrays import Complex128Array, Float64Array
from caviar_protocol.errors import AssetError, CaviarError, PayloadError, ScenarioError
from caviar_protocol.topics import AntennaArray, Scene

SUB_6 = 3.5e9


@case("place", "TX and RX at one point, free-space", traced=False)
def _(lab: Lab) -> Outcome:
    channel = link(free_space(SUB_6), (3, 4, 5), (3, 4, 5))
    return all_of(equal(0, len(channel.tau), "paths"), equal(0.0, abs(channel.h[0].h).max(), "in H"))


@case("place", "TX and RX at one point, geometric", traced=False)
def _(lab: Lab) -> Outcome:
    return equal(0, len(link(geometric(SUB_6), (3, 4, 5), (3, 4, 5)).tau), "paths")


@case("place", "TX and RX at one point over a conductor: only its reflection, straight back")
def _(lab: Lab) -> Outcome:
    """θ̂ of a vertical antenna straight down is along the ground; there the field turns over."""
    model = lab.traced(SUB_6, [ground(50.0, CONDUCTOR)])
    got = total(link(model, (3, 4, 5), (3, 4, 5)))
    return close("|H|", formulas.friis(10.0, SUB_6), abs(got), relative=5e-3)


@case("place", "a body at UTM coordinates and no scenery: its reflection")
def _(lab: Lab) -> Outcome:
    """456 km east and 5,412 km north: length and amplitude are those of the image."""
    origin = np.array([456_789.125, 5_412_345.625, 211.5])
    tx, rx = origin + np.array([0.0, -9.0, 1.0]), origin + np.array([4.0, 8.0, -2.0])
    wall = Thing("wall", (origin + np.array([30.0, 0.0, 0.0])).tolist(), (2.0, 60.0, 60.0))
    channel = link(lab.traced(SUB_6), tx, rx, wall)
    image = formulas.mirrored(tx, origin + np.array([29.0, 0.0, 0.0]), np.array([-1.0, 0.0, 0.0]))
    length = float(np.linalg.norm(image - rx))
    path = only_reflection(channel)
    return all_of(
        close("m", length, float(channel.tau[path] * formulas.C), absolute=1e-8),
        close("|a|", formulas.friis(length, SUB_6), float(abs(channel.a[0, path])), relative=5e-3),
    )


@case("place", "RX on the ground")
def _(lab: Lab) -> Outcome:
    model = lab.traced(SUB_6, [ground(300.0)])
    got = total(link(model, (0, 0, 10), (20, 0, 0)))
    return close("(H)", two_rays((10, 0), 20.0, SUB_6), got, relative=5e-3)


@case("place", "RX 1 mm above the ground")
def _(lab: Lab) -> Outcome:
    model = lab.traced(SUB_6, [ground(300.0)])
    got = total(link(model, (0, 0, 10), (20, 0, 1e-3)))
    return close("(H)", two_rays((10, 1e-3), 20.0, SUB_6), got, relative=5e-3)


@case("place", "TX on the ground")
def _(lab: Lab) -> Outcome:
    model = lab.traced(SUB_6, [ground(300.0)])
    got = total(link(model, (-20, 0, 0), (0, 0, 10)))
    return close("(H)", two_rays((0, 10), 20.0, SUB_6), got, relative=5e-3)


@case("place", "TX and RX on the ground")
def _(lab: Lab) -> Outcome:
    """The two rays cancel: no field goes along a lossy surface, to this order."""
    model = lab.traced(SUB_6, [ground(300.0)])
    # An amplitude of 0 has no phase: the level is compared with that of free space.
    got = abs(total(link(model, (-20, 0, 0), (20, 3, 0))))
    free = formulas.friis(math.dist((-20, 0), (20, 3)), SUB_6)
    return close("of free space", 0.0, got / free, absolute=0.02)


@case("place", "RX on a conducting façade, its field along it: none")
def _(lab: Lab) -> Outcome:
    """A field along a conductor's surface vanishes on it."""
    wall = Plate("wall", [(0, -40, -40), (0, 40, -40), (0, 40, 40), (0, -40, 40)], CONDUCTOR)
    model = lab.traced(SUB_6, [wall])
    got = abs(total(link(model, (15, 3, 1), (0, 0, 1))))
    return close("of free space", 0.0, got / formulas.friis(math.dist((15, 3), (0, 0)), SUB_6), absolute=0.01)


@case("place", "RX on the roof of a moving box of metal: twice the field")
def _(lab: Lab) -> Outcome:
    """The field upright on a conductor is doubled; the source is low, so that it is nearly upright."""
    model = lab.traced(SUB_6, body_material="metal")
    bus = Thing("bus", (40.0, 0.0, 1.5), (30.0, 30.0, 3.0))
    pair = [antenna("t", "tx", (0, 0, 8.0)), antenna("bus/r", "rx", (0.0, 0.0, 1.5), parent="bus")]
    got = abs(total(measure(model, scene(pair, [bus]))))
    return close("|H|", 2 * formulas.friis(math.hypot(40, 5), SUB_6), got, relative=0.02)


@case("place", "RX inside a closed room of metal, TX outside")
def _(lab: Lab) -> Outcome:
    model = lab.traced(SUB_6, room((5.0, 4.0, 3.0), CONDUCTOR), max_depth=2)
    channel = link(model, (20, 3, 1.4), (2.2, 1.7, 1.1))
    return all_of(equal(0, len(channel.tau), "paths"), equal(False, bool(channel.los[0, 0]), "line of sight"))


@case("place", "RX inside a moving box of metal, off its middle")
def _(lab: Lab) -> Outcome:
    # Off the middle: an antenna there would be taken for one that is mounted wrong.
    van = Thing("van", (10.0, 0.0, 1.0), (4.0, 2.0, 2.0))
    channel = link(lab.traced(SUB_6), (0, 0, 3), (10.7, 0.3, 1.2), van)
    return all_of(equal(0, len(channel.tau), "paths"), equal(False, bool(channel.los[0, 0]), "line of sight"))


@case("place", "antenna mounted in the very middle of a body: refused")
def _(lab: Lab) -> Outcome:
    model, van = lab.traced(SUB_6), Thing("van", (10.0, 0.0, 1.0))
    pair = [antenna("t", "tx", (0, 0, 3)), antenna("van/r", "rx", (0, 0, 0), parent="van")]
    at = scene(pair, [van])
    return refused(PayloadError, "in the middle of the body of 'van'", lambda: measure(model, at))


@case("place", "RX underground")
def _(lab: Lab) -> Outcome:
    model = lab.traced(SUB_6, [ground(300.0)], max_depth=2)
    channel = link(model, (0, 0, 10), (20, 3, -1.5))
    return all_of(equal(0, len(channel.tau), "paths"), equal(False, bool(channel.los[0, 0]), "line of sight"))


@case("place", "TX and RX underground: the ground reflects from below")
def _(lab: Lab) -> Outcome:
    """A sheet has two sides; what is under it is air to the model."""
    model = lab.traced(SUB_6, [ground(300.0)])
    got = total(link(model, (0, 0, -10), (20, 0, -1.5)))
    return close("(H)", two_rays((10, 1.5), 20.0, SUB_6), got, relative=5e-3)


HALVES = (0, 1, 2), (0, 2, 3)
"""Corners of the triangles of a square."""


def _ground_and(plates: list[Plate], lab: Lab, **settings: object) -> Outcome:
    """Two rays over ground, and nothing else of what is there besides."""
    model = lab.traced(SUB_6, plates, max_depth=2, **settings)
    channel = link(model, (0, 0, 10), (20, 0, 4))
    return all_of(
        equal(2, len(channel.tau), "paths"),
        close("(H)", two_rays((10, 4), 20.0, SUB_6), total(channel), relative=2e-3),
    )


ODD: dict[str, list[Plate]] = {
    "ground alone": [ground(300.0)],
    "a triangle without area, its corners at one point": [
        ground(300.0),
        Plate("point", [(9, 0, 5), (9, 0, 5), (9, 0, 5)], LOSSY),
    ],
    "a triangle without area, its corners on a line": [
        ground(300.0),
        Plate("line", [(9, -5, 7), (9, 0, 7), (9, 5, 7)], LOSSY),
    ],
    "a triangle without area within a surface": [
        Plate("ground", [(-300, -300, 0), (0, -300, 0), (300, -300, 0), (300, 300, 0), (-300, 300, 0)], LOSSY)
    ],
    "a surface twice, in one place": [ground(300.0), Plate("again", square(300.0), LOSSY)],
    "a surface three times, one of them flipped": [
        ground(300.0),
        Plate("again", square(300.0), LOSSY),
        Plate("flipped", square(300.0)[::-1], LOSSY),
    ],
    "a face flipped": [Plate("ground", square(300.0)[::-1], LOSSY)],
    "two coplanar surfaces that overlap": [
        ground(300.0),
        Plate("patch", [(x + 11, y + 3, z) for x, y, z in square(40.0)], LOSSY),
    ],
}
for _name, _plates in ODD.items():
    case("mesh", _name)(partial(_ground_and, _plates))
for _name in ("a surface three times, one of them flipped", "a triangle without area within a surface"):
    case("mesh", f"{_name}, with diffraction")(partial(_ground_and, ODD[_name], diffraction=True))


# Squares along a side of the ground of many triangles.
_SIDE = 40


@case("mesh", f"a surface of {2 * _SIDE**2:,} triangles")
def _(lab: Lab) -> Outcome:
    """They are one plane, which reflects once."""
    # Squares of 15 m, each of two triangles.
    x, y = np.meshgrid(*[np.linspace(-300, 300, _SIDE + 1)] * 2)
    corners = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
    i = np.arange(len(corners)).reshape(_SIDE + 1, _SIDE + 1)
    squares = i[:-1, :-1], i[:-1, 1:], i[1:, 1:], i[1:, :-1]
    faces = np.concatenate([np.stack([squares[c] for c in half], -1).reshape(-1, 3) for half in HALVES])
    return _ground_and([Plate("ground", corners.tolist(), LOSSY, faces=faces.tolist())], lab)


def _seam(shift: Point, lab: Lab) -> Outcome:
    """The reflection lies on the edge that the ground's two triangles share: it is one, not two or none."""
    model = lab.traced(SUB_6, [ground(300.0)])
    tx, rx = np.array([-10.0, -10.0, 6.0]) + shift, np.array([10.0, 10.0, 6.0]) + shift
    channel = link(model, tx, rx)
    flat = float(np.hypot(20, 20))
    return all_of(
        equal(2, len(channel.tau), "paths"),
        close("(H)", two_rays((6, 6), flat, SUB_6), total(channel), relative=2e-3),
    )


case("mesh", "a reflection on the seam of two triangles")(partial(_seam, (0.0, 0.0, 0.0)))
case("mesh", "a reflection 1 µm beside the seam")(partial(_seam, (1e-6, 0.0, 0.0)))


MMWAVE = 28e9
SCREEN = Plate("screen", [(0, -50, -50), (0, 50, -50), (0, 50, 50), (0, -50, 50)], CONDUCTOR)


@case("paths", "none: behind a screen")
def _(lab: Lab) -> Outcome:
    # The screen is so large that no wave is expected around it: the model has no diffraction here.
    model = lab.traced(MMWAVE, [SCREEN])
    channel = link(model, (-20, 0, 1), (20, 3, 2))
    return all_of(
        equal(0, len(channel.tau), "paths"),
        equal(False, bool(channel.los[0, 0]), "line of sight"),
        equal(0.0, abs(channel.h[0].h).max(), "in H"),
    )


@case("paths", "none: no transmitter")
def _(lab: Lab) -> Outcome:
    channel = measure(lab.traced(MMWAVE), scene([antenna("r", "rx", (1, 2, 3))]))
    return equal((0, 0), (len(channel.tau), len(channel.tx)), "(paths, transmitters)")


@case("paths", "one: nothing around")
def _(lab: Lab) -> Outcome:
    channel = link(lab.traced(MMWAVE), (-20, 0, 1), (20, 3, 2))
    expected = formulas.friis(math.dist((-20, 0, 1), (20, 3, 2)), MMWAVE)
    return all_of(equal(1, len(channel.tau), "paths"), close("|H|", expected, abs(total(channel)), 1e-5))


def _room(order: int, samples: int, lab: Lab, **settings: object) -> Outcome:
    """Every image of a room of a conductor, 4n² + 2 of order n, each with its length.

    The places are such that no path has a segment below 6 cm: those under 1 cm are not found.
    """
    size = (16.03, 15.04, 14.56)
    tx, rx = np.array([2.55, 4.47, 8.15]), np.array([6.66, 13.44, 12.22])
    model = lab.traced(
        2.8e9,
        room(size, CONDUCTOR),
        max_depth=order,
        samples=samples,
        receivers_at_once=1,
        **settings,
    )
    channel = link(model, tx, rx)
    # A conductor reflects with |r| = 1, so that no path is too weak to be counted.
    images = formulas.room_images(size, tx, rx, order)
    expected = sorted(length for _, length in images)
    got = sorted((channel.tau * formulas.C).tolist())
    if len(got) != len(expected):
        return equal(len(expected), len(got), "paths")
    errors = np.abs(np.subtract(got, expected)).tolist()
    return all_of(equal(len(expected), len(got), "paths"), worst(errors, 1e-9, "m", "length"))


case("paths", "25 in a room, two reflections at most")(partial(_room, 2, 20_000))
case("paths", "1,159 in a room, nine reflections at most")(partial(_room, 9, 200_000))


@case("paths", "25 in a room, of 200,000 rays of which memory holds 10,000 at once")
def _(lab: Lab) -> Outcome:
    return _room(2, 200_000, lab, candidates="launched", memory_gib=1e-3)


@case("paths", "64 at most of the drawn channel: their mean power is 1", traced=False)
def _(lab: Lab) -> Outcome:
    """Σ|a|² over 400 pairs of frames; its relative error is about 1/√(64·400) = 0.6 %."""
    model = geometric(MMWAVE, components=64, k_factor_db=-100.0)
    at = scene(ends((0, 0, 9), (40, 9, 1)))
    power = [float((np.abs(measure(model, at, n).a[0]) ** 2).sum()) for n in range(400)]
    return close("mean power", 1.0, float(np.mean(power)), absolute=0.025)


# --- arrays ---------------------------------------------------------------------------------


def _plane_wave(array: AntennaArray, direction: Float64Array) -> Complex128Array:
    """Phases of the elements, half a wavelength apart in the y–z plane, numbered down the columns."""
    column, row = np.divmod(np.arange(array.rows * array.columns), array.rows)
    y = 0.5 * (column - (array.columns - 1) / 2)
    z = -0.5 * (row - (array.rows - 1) / 2)
    phases: Complex128Array = np.exp(2j * np.pi * (y * direction[1] + z * direction[2]))
    return phases


def _array(rows: int, columns: int, receive: int, traced: bool, lab: Lab) -> Outcome:
    """H of the line of sight: outer product of two plane waves."""
    model = lab.traced(MMWAVE) if traced else free_space(MMWAVE)
    tx, rx = np.array([0.0, 0.0, 9.0]), np.array([61.0, 17.0, 2.5])
    many, few = AntennaArray(rows=rows, columns=columns), AntennaArray(columns=receive)
    h = measure(model, scene(ends(tx, rx, many, few))).h[0].h
    # 64 m off, the wave is plane to the model: arrays are applied by their phases alone.
    d = float(np.linalg.norm(rx - tx))
    along = (rx - tx) / d
    wave = formulas.spherical_wave(d, MMWAVE)
    expected = wave * np.outer(_plane_wave(few, -along), _plane_wave(many, along))
    if h.shape != expected.shape:
        return equal(expected.shape, h.shape, "elements")
    error = float(np.abs(h - expected).max() / abs(wave))
    return all_of(
        equal(expected.shape, h.shape, "elements (RX, TX)"),
        worst([error], 1e-4, "", "relative to an element"),
    )


for _rows, _columns, _receive in ((1, 1, 1), (1, 64, 1), (8, 8, 8), (64, 64, 4), (64, 1024, 1)):
    for _traced, _rung in ((False, "free-space"), (True, "siso-rt")):
        _name = f"Nt×Nr {_rows * _columns:,}×{_receive}, {_rung}"
        case("array", _name, traced=_traced)(partial(_array, _rows, _columns, _receive, _traced))


BAD = (math.nan, math.inf)

Change = Callable[[float], Scene]


def _antennas(x: float) -> Scene:
    return scene(ends((0, 0, 9), (x, 3, 1)))


def _transmitter(x: float) -> Scene:
    return scene(ends((0, x, 9), (20, 3, 1)))


def _spacing(x: float) -> Scene:
    array = AntennaArray(columns=4, horizontal_spacing=x)
    return scene([antenna("t", "tx", (0, 0, 9), array), antenna("r", "rx", (20, 3, 1))])


def _thing(field: str, x: float) -> Scene:
    value: dict[str, Any] = {
        "position": (x, 0, 0),
        "velocity": (0, x, 0),
        "size": (4, 2, x),
        "quaternion": (1, 0, 0, x),
    }
    car = Thing("car", **{"position": (9.0, 9.0, 1.0), field: value[field]})
    return scene(ends((0, 0, 9), (20, 3, 1)), [car])


SCENES: dict[str, tuple[str, Change]] = {
    "position of a receiver": ("device 'r': position", _antennas),
    "position of a transmitter": ("device 't': position", _transmitter),
    "spacing of an array": ("device 't': spacings and panels", _spacing),
    "position of an object": ("object 'car': position", partial(_thing, "position")),
    "velocity of an object": ("object 'car': velocity", partial(_thing, "velocity")),
    "dimensions of an object": ("object 'car': dimensions", partial(_thing, "size")),
    "orientation of an object": ("object 'car': orientation", partial(_thing, "quaternion")),
}


def _scene(words: str, change: Change, bad: float, rung: str, lab: Lab) -> Outcome:
    models: dict[str, Callable[[], Model]] = {
        "free-space": lambda: free_space(MMWAVE),
        "geometric": lambda: geometric(MMWAVE),
        "siso-rt": lambda: lab.traced(MMWAVE),
    }
    model = models[rung]()
    return refused(PayloadError, words, lambda: measure(model, change(bad)))


for _bad in BAD:
    for _what, (_words, _change) in SCENES.items():
        for _rung in ("free-space", "geometric", "siso-rt"):
            case("input", f"{_bad} in the {_what}, {_rung}", traced=_rung == "siso-rt")(
                partial(_scene, _words, _change, _bad, _rung)
            )


@case("input", "a speed above that of light", traced=False)
def _(lab: Lab) -> Outcome:
    car = Thing("car", (40.0, 0.0, 0.0), velocity=(2.5e8, 2.5e8, 0.0))
    words = "object 'car': velocity (2.5e+08, 2.5e+08, 0) m/s: a finite speed below light's"
    return refused(PayloadError, words, lambda: link(free_space(MMWAVE), (0, 0, 9), (20, 3, 1), car))


@case("input", "a path gain above 1: 100 MHz, both antennas 5 cm above a conductor")
def _(lab: Lab) -> Outcome:
    model = lab.traced(100e6, [ground(50.0, CONDUCTOR)])
    words = "the path from 't' to 'r' by way of ground has a gain of"
    return refused(PayloadError, words, lambda: link(model, (0, 0, 0.05), (0.02, 0, 0.05)))


def _setting(error: type[CaviarError], words: str, make: Callable[[Lab], object], lab: Lab) -> Outcome:
    return refused(error, words, lambda: make(lab))


def _mesh(bad: float, lab: Lab) -> object:
    corners = [*square(50.0)[:3], (-50.0, bad, 0.0)]
    model = lab.traced(MMWAVE, [Plate("ground", corners, CONDUCTOR)])
    return link(model, (0, 0, 9), (20, 3, 1))


def _carrier(bad: float, lab: Lab) -> object:
    return free_space(bad)


def _drawn(bad: float, lab: Lab) -> object:
    return geometric(MMWAVE, delay_spread_ns=bad)


def _permittivity(bad: float, lab: Lab) -> object:
    return lab.traced(MMWAVE, [ground(50.0, Material(bad, 0.1))])


def _conductivity(bad: float, lab: Lab) -> object:
    return lab.traced(MMWAVE, [ground(50.0, Material(3.0, bad))])


SETTINGS: dict[str, tuple[type[CaviarError], str, Callable[[float, Lab], object], bool]] = {
    "the carrier frequency": (ScenarioError, "carrier 'c0' is at", _carrier, False),
    "a setting of the drawn channel": (ScenarioError, "delay_spread_ns", _drawn, False),
    "a material's permittivity": (ScenarioError, "relative_permittivity", _permittivity, True),
    "a material's conductivity": (ScenarioError, "conductivity_s_per_m", _conductivity, True),
    "a vertex of the scenery": (AssetError, "ground.ply: vertex 3 is at", _mesh, True),
}
for _bad in BAD:
    for _what, (_error, _words, _make, _traced) in SETTINGS.items():
        case("input", f"{_bad} in {_what}", traced=_traced)(
            partial(_setting, _error, _words, partial(_make, _bad))
        )
