"""Speeds up to 1,000 km/h, and a vehicle that jumps."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from caviar_labs.stability import formulas
from caviar_labs.stability.case import Outcome, all_of, case, close, equal, worst
from caviar_labs.stability.lab import (
    CONDUCTOR,
    Lab,
    Plate,
    Thing,
    antenna,
    free_space,
    geometric,
    link,
    measure,
    only_reflection,
    scene,
)

F = 60e9
UNIT = np.array([0.6, 0.48, 0.64])
"""From the transmitter."""


def _shift(speed: float, traced: bool, lab: Lab) -> Outcome:
    """A receiver on a vehicle that comes straight at the transmitter: f·v/c."""
    model = lab.traced(F, without_body=["car"]) if traced else free_space(F)
    place = 80.0 * UNIT
    car = Thing("car", place.tolist(), velocity=(-speed * UNIT).tolist())
    pair = [antenna("t", "tx", (0, 0, 0)), antenna("car/r", "rx", (0, 0, 0), parent="car")]
    got = float(measure(model, scene(pair, [car])).doppler[0, 0])
    # A millionth of the shift at 300 m/s, whatever the speed: at rest a relative tolerance would be 0.
    return close("Hz", formulas.doppler(speed, F), got, absolute=1e-6 * F * 300 / formulas.C)


for _kmh in (0, 3, 120, 1000):
    for _traced, _rung in ((False, "free-space"), (True, "siso-rt")):
        case("speed", f"{_kmh} km/h, straight, {_rung}", traced=_traced)(partial(_shift, _kmh / 3.6, _traced))


@case("speed", "1,000 km/h, two that pass each other, drawn channel", traced=False)
def _(lab: Lab) -> Outcome:
    """Both ends move; the straight wave is that of the difference."""
    # One component is the straight path alone, without a draw.
    model = geometric(F, components=1)
    one = Thing("a", (0, 0, 30), velocity=(277.7777777777778, 0, 0))
    other = Thing("b", (300, 400, 30), velocity=(-277.7777777777778, 0, 0))
    pair = [
        antenna("a/t", "tx", (0, 0, 0), parent="a"),
        antenna("b/r", "rx", (0, 0, 0), parent="b"),
    ]
    got = float(measure(model, scene(pair, [one, other])).doppler[0, 0])
    return close("Hz", formulas.doppler(2 * 1000 / 3.6 * 0.6, F), got, relative=1e-9)


def _mirror(speed: float, lab: Lab) -> Outcome:
    """A wall that comes closer: its image comes twice as fast."""
    wall = Thing("wall", (30.0, 0.0, 0.0), (2.0, 60.0, 60.0), velocity=(-speed, 0.0, 0.0))
    tx, rx = np.array([0.0, -9.0, 1.0]), np.array([4.0, 8.0, -2.0])
    channel = link(lab.traced(F), tx, rx, wall)
    # The wall is 2 m thick: its near face is at x = 29 m.
    image = formulas.mirrored(tx, np.array([29.0, 0.0, 0.0]), np.array([-1.0, 0.0, 0.0]))
    along = abs((image - rx)[0]) / float(np.linalg.norm(image - rx))
    path = only_reflection(channel)
    length = float(np.linalg.norm(image - rx))
    return all_of(
        close("Hz", formulas.doppler(2 * speed * along, F), float(channel.doppler[0, path]), absolute=0.06),
        close("m", length, float(channel.tau[path] * formulas.C), absolute=1e-9),
    )


for _kmh in (0, 50, 1000):
    case("speed", f"{_kmh} km/h, reflected by a wall that comes")(partial(_mirror, _kmh / 3.6))


@case("speed", "sideways: no shift")
def _(lab: Lab) -> Outcome:
    car = Thing("car", (70.0, 0.0, 0.0), velocity=(0.0, 277.8, 0.0))
    pair = [antenna("t", "tx", (0, 0, 0)), antenna("car/r", "rx", (0, 0, 0), parent="car")]
    got = float(measure(free_space(F), scene(pair, [car])).doppler[0, 0])
    return close("Hz", 0.0, got, absolute=1e-6)


def _corner(traced: bool, lab: Lab) -> Outcome:
    """An antenna 2.5 m before the middle of a car that turns on the spot moves sideways with ω·r."""
    model = lab.traced(F, without_body=["car"]) if traced else free_space(F)
    car = Thing("car", (60.0, 0.0, 0.0), velocity=(3.0, 0.0, 0.0), turning=(0.0, 0.0, 1.2))
    pair = [antenna("t", "tx", (62.5, -40.0, 0)), antenna("car/r", "rx", (2.5, 0, 0), parent="car")]
    got = float(measure(model, scene(pair, [car])).doppler[0, 0])
    return close("Hz", -formulas.doppler(1.2 * 2.5, F), got, absolute=0.06)


for _traced, _rung in ((False, "free-space"), (True, "siso-rt")):
    case("speed", f"an antenna at the corner of a car that turns, {_rung}", traced=_traced)(
        partial(_corner, _traced)
    )


@case("speed", "reflected by a wall that turns")
def _(lab: Lab) -> Outcome:
    """The shift is that of the wall where the wave meets it: by differences of the image's distance."""
    rate, middle = 0.8, np.array([30.0, 0.0, 0.0])
    wall = Thing("wall", middle.tolist(), (2.0, 60.0, 60.0), turning=(0.0, 0.0, rate))
    tx, rx = np.array([0.0, -9.0, 1.0]), np.array([4.0, 8.0, -2.0])

    def length(t: float) -> float:
        normal = -np.array([math.cos(rate * t), math.sin(rate * t), 0.0])
        return float(np.linalg.norm(formulas.mirrored(tx, middle + normal, normal) - rx))

    channel = link(lab.traced(F), tx, rx, wall)
    path = only_reflection(channel)
    shift = -F / formulas.C * (length(1e-4) - length(-1e-4)) / 2e-4
    return close("Hz", shift, float(channel.doppler[0, path]), absolute=1.0)


@case("jump", "a vehicle that jumps into the line of sight, 700 m from frame to frame, and out again")
def _(lab: Lab) -> Outcome:
    """Check that a frame follows from its own scene: no path by way of where the vehicle was."""
    model = lab.traced(F)
    tx, rx = (-40.0, 0.0, 2.0), (40.0, 1.0, 1.5)
    there, away = (
        Thing("bus", (3.0, 0.5, 1.5), (2.0, 9.0, 9.0)),
        Thing("bus", (703.0, 44.0, 1.5), (2.0, 9.0, 9.0)),
    )
    seen = [bool(link(model, tx, rx, bus).los[0, 0]) for bus in (away, there, away, there)]
    return equal([True, False, True, False], seen, "line of sight")


@case("jump", "its reflection is where it now is, and has the shift of its velocity alone")
def _(lab: Lab) -> Outcome:
    model = lab.traced(F)
    tx, rx = np.array([0.0, -9.0, 1.0]), np.array([4.0, 8.0, -2.0])
    errors = []
    shifts = []
    # Velocities are 0 in all frames: a shift would come from positions of the frame before.
    for x in (30.0, 530.0, -420.0, 31.0):
        near = x - math.copysign(1.0, x)
        wall = Thing("wall", (x, 0.0, 0.0), (2.0, 60.0, 60.0))
        channel = link(model, tx, rx, wall)
        path = only_reflection(channel)
        image = formulas.mirrored(tx, np.array([near, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]))
        errors.append(abs(float(channel.tau[path]) * formulas.C - float(np.linalg.norm(image - rx))))
        shifts.append(abs(float(channel.doppler[0, path])))
    return all_of(worst(errors, 1e-9, "m", "length"), worst(shifts, 1e-9, "Hz", "shift of 0"))


@case("jump", "a vehicle that turns up and leaves")
def _(lab: Lab) -> Outcome:
    model = lab.traced(F)
    bus = Thing("bus", (3.0, 0.5, 1.5), (2.0, 9.0, 9.0))
    seen = [
        len(link(model, (-40.0, 0.0, 2.0), (40.0, 1.0, 1.5), *some).tau) for some in ((), (bus,), (), (bus,))
    ]
    return equal([1, 0, 1, 0], seen, "paths")


def _flush(candidates: str, lab: Lab) -> Outcome:
    """Two lorries side by side pass the point of reflection: their walls are one mirror, whose wave stays."""
    model = lab.traced(F, bodies=2, candidates=candidates)
    tx, rx = np.array([-7.0, -9.0, 2.0]), np.array([6.0, -7.0, 1.5])
    image = formulas.mirrored(tx, np.array([0.0, 1.0, 0.0]), np.array([0.0, 1.0, 0.0]))
    expected = formulas.friis(float(np.linalg.norm(image - rx)), F)
    errors, counts, ids = [], set(), set()
    # The point of reflection is at x = 0.22 m: coarse steps over it, fine ones across it.
    for seam in (*np.arange(0.12, 0.32, 0.01), *np.arange(0.216, 0.225, 0.001)):
        lorries = [
            Thing(name, (seam + side * 3.0, 2.25, 1.5), (6.0, 2.5, 3.0))
            for name, side in (("east", 1), ("west", -1))
        ]
        channel = link(model, tx, rx, *lorries)
        bounced = (channel.interactions == 1).any(1)
        counts.add(int(bounced.sum()))
        ids |= set(channel.id[bounced].tolist())
        errors += [abs(20 * math.log10(abs(a) / expected)) for a in channel.a[0, bounced]]
    return all_of(
        equal([1], sorted(counts), "paths"),
        equal(1, len(ids), "id"),
        worst(errors, 0.02, "dB", "level"),
    )


for _how in ("enumerated", "launched"):
    case("flush", f"two lorries side by side go by in steps of 1 cm and 1 mm, {_how}")(partial(_flush, _how))


@case("flush", "a box whose front is that of the wall beside it: one wall")
def _(lab: Lab) -> Outcome:
    """The receiver goes along; the point of reflection goes from the wall to the box."""
    wall = Plate("wall", [(-30, 1, 0), (-5, 1, 0), (-5, 1, 6), (-30, 1, 6)], CONDUCTOR)
    model = lab.traced(F, [wall], bodies=1, candidates="enumerated")
    box = Thing("box", (-3.5, 2.25, 1.5), (3.0, 2.5, 3.0))
    tx, counts, ids = (-7.0, -9.0, 2.0), set(), set()
    for x in np.arange(-4.0, 3.0, 0.1):
        channel = link(model, tx, (float(x), -9.0, 1.5), box)
        bounced = (channel.interactions == 1).any(1)
        counts.add(int(bounced.sum()))
        ids |= set(channel.id[bounced].tolist())
    return all_of(equal([1], sorted(counts), "paths"), equal(1, len(ids), "id"))
