"""Cases of counts and inputs: none, one, a thousand paths; up to 65,536 elements; NaN and infinity."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np

from caviar_protocol.arrays import Complex128Array, Float64Array
from caviar_protocol.errors import AssetError, CaviarError, PayloadError, ScenarioError
from caviar_protocol.topics import AntennaArray, Scene
from caviar_services.channel.stability import formulas
from caviar_services.channel.stability.bench import (
    CONDUCTOR,
    Bench,
    Material,
    Model,
    Plate,
    Thing,
    answer,
    antenna,
    link,
    room,
    square,
    total,
    world,
)
from caviar_services.channel.stability.case import Outcome, all_of, case, close, equal, refused, worst

F = 28e9
SCREEN = Plate("screen", [(0, -50, -50), (0, 50, -50), (0, 50, 50), (0, -50, 50)])


@case("paths", "none: behind a screen")
def _(bench: Bench) -> Outcome:
    model = bench.traced(F, [SCREEN], {"surface": CONDUCTOR})
    channel = link(model, (-20, 0, 1), (20, 3, 2))
    return all_of(
        equal(0, len(channel.tau), "paths"),
        equal(False, bool(channel.los[0, 0]), "line of sight"),
        equal(0.0, abs(channel.h[0].h).max(), "in H"),
    )


@case("paths", "none: no transmitter")
def _(bench: Bench) -> Outcome:
    channel = answer(bench.traced(F), world([antenna("r", "rx", (1, 2, 3))]))
    return equal((0, 0), (len(channel.tau), len(channel.tx)), "(paths, transmitters)")


@case("paths", "one: nothing around")
def _(bench: Bench) -> Outcome:
    channel = link(bench.traced(F), (-20, 0, 1), (20, 3, 2))
    expected = formulas.friis(math.dist((-20, 0, 1), (20, 3, 2)), F)
    return all_of(equal(1, len(channel.tau), "paths"), close("|H|", expected, abs(total(channel)), 1e-5))


def _room(order: int, samples: int, bench: Bench, **settings: object) -> Outcome:
    """Every image of a room of a conductor, 4n² + 2 of order n, each with its length.

    The places are such that no path has a segment below 6 cm: those under 1 cm are not found.
    """
    size = (16.03, 15.04, 14.56)
    tx, rx = np.array([2.55, 4.47, 8.15]), np.array([6.66, 13.44, 12.22])
    model = bench.traced(
        2.8e9,
        room(size),
        {"surface": CONDUCTOR},
        max_depth=order,
        samples=samples,
        receivers_at_once=1,
        **settings,
    )
    channel = link(model, tx.tolist(), rx.tolist())
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
def _(bench: Bench) -> Outcome:
    return _room(2, 200_000, bench, candidates="launched", memory_gib=1e-3)


@case("paths", "64 at most of the drawn channel: their mean power is 1", traced=False)
def _(bench: Bench) -> Outcome:
    """Σ|a|² over 400 pairs of frames; its relative error is about 1/√(64·400) = 0.6 %."""
    model = bench.geometric(F, components=64, k_factor_db=-100.0)
    ends = [antenna("t", "tx", (0, 0, 9)), antenna("r", "rx", (40, 9, 1))]
    power = [float((np.abs(answer(model, world(ends), n).a[0]) ** 2).sum()) for n in range(400)]
    return close("mean power", 1.0, float(np.mean(power)), absolute=0.025)


# --- arrays ---------------------------------------------------------------------------------


def _plane_wave(array: AntennaArray, direction: Float64Array) -> Complex128Array:
    """Phases of the elements, half a wavelength apart in the y–z plane, numbered down the columns."""
    column, row = np.divmod(np.arange(array.rows * array.columns), array.rows)
    y = 0.5 * (column - (array.columns - 1) / 2)
    z = -0.5 * (row - (array.rows - 1) / 2)
    phases: Complex128Array = np.exp(2j * np.pi * (y * direction[1] + z * direction[2]))
    return phases


def _array(rows: int, columns: int, receive: int, traced: bool, bench: Bench) -> Outcome:
    """H of the line of sight: outer product of two plane waves."""
    model = bench.traced(F) if traced else bench.free_space(F)
    tx, rx = np.array([0.0, 0.0, 9.0]), np.array([61.0, 17.0, 2.5])
    many, few = AntennaArray(rows=rows, columns=columns), AntennaArray(columns=receive)
    ends = [antenna("t", "tx", tx.tolist(), many), antenna("r", "rx", rx.tolist(), few)]
    h = answer(model, world(ends)).h[0].h
    d = float(np.linalg.norm(rx - tx))
    along = (rx - tx) / d
    wave = formulas.friis(d, F) * formulas.phase(d, F)
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
    return world([antenna("t", "tx", (0, 0, 9)), antenna("r", "rx", (x, 3, 1))])


def _transmitter(x: float) -> Scene:
    return world([antenna("t", "tx", (0, x, 9)), antenna("r", "rx", (20, 3, 1))])


def _spacing(x: float) -> Scene:
    array = AntennaArray(columns=4, horizontal_spacing=x)
    return world([antenna("t", "tx", (0, 0, 9), array), antenna("r", "rx", (20, 3, 1))])


def _thing(field: str, x: float) -> Scene:
    value = {"position": (x, 0, 0), "velocity": (0, x, 0), "size": (4, 2, x), "quaternion": (1, 0, 0, x)}
    thing = Thing("car", **{"position": (9.0, 9.0, 1.0), field: value[field]})
    return world([antenna("t", "tx", (0, 0, 9)), antenna("r", "rx", (20, 3, 1))], [thing])


SCENES: dict[str, tuple[str, Change]] = {
    "position of a receiver": ("device 'r' has the position", _antennas),
    "position of a transmitter": ("device 't' has the position", _transmitter),
    "spacing of an array": ("device 't' has the element spacing", _spacing),
    "position of an object": ("object 'car' has the position", partial(_thing, "position")),
    "velocity of an object": ("object 'car' has the velocity", partial(_thing, "velocity")),
    "dimensions of an object": ("object 'car' has the dimensions", partial(_thing, "size")),
    "orientation of an object": ("object 'car' has the orientation", partial(_thing, "quaternion")),
}


def _scene(words: str, change: Change, bad: float, rung: str, bench: Bench) -> Outcome:
    models: dict[str, Callable[[], Model]] = {
        "free-space": lambda: bench.free_space(F),
        "geometric": lambda: bench.geometric(F),
        "siso-rt": lambda: bench.traced(F),
    }
    model = models[rung]()
    return refused(PayloadError, words, lambda: answer(model, change(bad)))


for _bad in BAD:
    for _what, (_words, _change) in SCENES.items():
        for _rung in ("free-space", "geometric", "siso-rt"):
            case("input", f"{_bad} in the {_what}, {_rung}", traced=_rung == "siso-rt")(
                partial(_scene, _words, _change, _bad, _rung)
            )


@case("input", "a speed above that of light", traced=False)
def _(bench: Bench) -> Outcome:
    car = Thing("car", (40.0, 0.0, 0.0), velocity=(2.5e8, 2.5e8, 0.0))
    words = "object 'car': velocity (2.5e+08, 2.5e+08, 0) m/s: a finite speed below light's"
    ends = [antenna("t", "tx", (0, 0, 9)), antenna("r", "rx", (20, 3, 1))]
    return refused(PayloadError, words, lambda: answer(bench.free_space(F), world(ends, [car])))


@case("input", "a path gain above 1: 100 MHz, both antennas 5 cm above a conductor")
def _(bench: Bench) -> Outcome:
    model = bench.traced(100e6, [Plate("ground", square(50.0))], {"surface": CONDUCTOR})
    words = "the path from 't' to 'r' by way of ground has a gain of"
    return refused(PayloadError, words, lambda: link(model, (0, 0, 0.05), (0.02, 0, 0.05)))


def _setting(error: type[CaviarError], words: str, make: Callable[[Bench], object], bench: Bench) -> Outcome:
    return refused(error, words, lambda: make(bench))


def _mesh(bad: float, bench: Bench) -> object:
    corners = [*square(50.0)[:3], (-50.0, bad, 0.0)]
    model = bench.traced(F, [Plate("ground", corners)], {"surface": CONDUCTOR})
    return link(model, (0, 0, 9), (20, 3, 1))


def _carrier(bad: float, bench: Bench) -> object:
    return bench.free_space(bad)


def _drawn(bad: float, bench: Bench) -> object:
    return bench.geometric(F, delay_spread_ns=bad)


def _permittivity(bad: float, bench: Bench) -> object:
    return bench.traced(F, [Plate("ground", square(50.0))], {"surface": Material(bad, 0.1)})


def _conductivity(bad: float, bench: Bench) -> object:
    return bench.traced(F, [Plate("ground", square(50.0))], {"surface": Material(3.0, bad)})


SETTINGS: dict[str, tuple[type[CaviarError], str, Callable[[float, Bench], object], bool]] = {
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
