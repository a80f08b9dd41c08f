"""None, one and a thousand paths; arrays from one element to 65,536."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from caviar_protocol.arrays import Complex128Array, Float64Array
from caviar_protocol.topics import AntennaArray
from caviar_services.channel.stability import formulas
from caviar_services.channel.stability.bench import (
    CONDUCTOR,
    Bench,
    Plate,
    answer,
    antenna,
    link,
    room,
    total,
    world,
)
from caviar_services.channel.stability.case import Outcome, all_of, case, close, equal, worst

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
