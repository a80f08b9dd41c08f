"""Edges: where meshes meet, where light and reflections end, and which edge a path goes over."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from caviar_protocol.arrays import Complex128Array, Float64Array
from caviar_protocol.topics import Channel, Interaction
from caviar_services.channel.stability import formulas
from caviar_services.channel.stability.bench import (
    CONDUCTOR,
    Bench,
    Model,
    Plate,
    Point,
    Thing,
    answer,
    antenna,
    world,
)
from caviar_services.channel.stability.case import Outcome, all_of, case, close, equal, worst

F = 28e9
STATION = np.array([8.0, 5.0, 3.0])
"""Sees one wall of the corner; its light ends behind the edge x = y = 0."""

ONE: list[Point] = [(0, 0, 0), (0, 40, 0), (0, 40, 9), (0, 0, 9)]
OTHER: list[Point] = [(0, 0, 0), (-40, 0, 0), (-40, 0, 9), (0, 0, 9)]
BOTH: list[Point] = [(0, 0, 0), (0, 40, 0), (0, 40, 9), (0, 0, 9), (-40, 0, 9), (-40, 0, 0)]
CORNER = [Plate("one", ONE), Plate("other", OTHER)]


def _corner(bench: Bench, plates: Sequence[Plate]) -> Model:
    """A model of 50,000 rays that are reflected and diffracted once each."""
    settings = {"diffraction": True, "max_depth": 2, "samples": 50_000, "receivers_at_once": 500}
    return bench.traced(F, plates, {"surface": CONDUCTOR}, **settings)


def _along(model: Model, places: Float64Array, *things: Thing) -> Channel:
    """The channels to receivers at these places [m], Shape ``[N, 3]``, in their order."""
    devices = [antenna(f"r{i:05d}", "rx", place) for i, place in enumerate(places.tolist())]
    return answer(model, world([antenna("t", "tx", STATION.tolist()), *devices], things))


def _sums(channel: Channel) -> Complex128Array:
    """Sum of the amplitudes of each pair."""
    return np.array([a.sum() for a in np.split(channel.a[0], channel.offsets[1:-1])])


def _around(count: int) -> Float64Array:
    """Places in light and in shadow of the corner, on a walk of 9 m about it."""
    angle = np.linspace(-3.0, 1.2, count)
    return np.column_stack([9 * np.cos(angle), 9 * np.sin(angle), np.linspace(1.4, 2.6, count)])


@case("edge", "a corner as two meshes: the same as one mesh")
def _(bench: Bench) -> Outcome:
    one, two = (
        20 * np.log10(np.abs(_sums(_along(_corner(bench, plates), _around(24)))))
        for plates in ([Plate("both", BOTH)], CORNER)
    )
    return worst(np.abs(two - one).tolist(), 0.01, "dB", "level at 24 places")


def _boundary(image: Float64Array, bench: Bench) -> tuple[Complex128Array, Channel, float]:
    """H in 120 steps of 1 µm across the line where the wave from an image ends, and free space's |H|."""
    steps = (np.arange(-60, 60) + 0.3) * 1e-6
    onward = -image / np.linalg.norm(image)
    ground = 10 * onward + steps[:, None] * np.array([-onward[1], onward[0]])
    channel = _along(_corner(bench, CORNER), np.column_stack([ground, np.full(len(steps), 2.0)]))
    return _sums(channel), channel, formulas.friis(math.dist((*ground[0], 2.0), STATION), F)


@case("edge", "where light ends, in steps of 1 µm: half of free space, without a jump")
def _(bench: Bench) -> Outcome:
    h, channel, free = _boundary(STATION[:2], bench)
    return all_of(
        worst((np.abs(np.diff(h)) / free).tolist(), 0.03, "of free space", "steps"),
        equal(1, int(np.count_nonzero(np.diff(channel.los[0].astype(int)))), "time that light goes out"),
        close("of free space", 0.5, float(np.abs(h[60])) / free, absolute=0.02),
    )


@case("edge", "where a reflection ends, in steps of 1 µm: no jump")
def _(bench: Bench) -> Outcome:
    h, _, free = _boundary(STATION[:2] * [-1, 1], bench)
    return worst((np.abs(np.diff(h)) / free).tolist(), 0.03, "of free space", "steps")


@case("edge", "a free edge: Sommerfeld's half-plane of a conductor, field along its edge")
def _(bench: Bench) -> Outcome:
    """Deep in the shadow; the other rims are so far that their paths are left out."""
    screen = Plate("screen", [(0, 0, -60), (0, 120, -60), (0, 120, 60), (0, 0, 60)])
    settings = {"diffraction": True, "free_edges": True, "samples": 100_000}
    model = bench.traced(F, [screen], {"surface": CONDUCTOR}, **settings)
    # Angles from the face on the side of the source, which the screen is at 0 and 2π of.
    at, s_in, s_out = 1.1, 12.0, 8.0
    tx = s_in * np.array([math.sin(at), math.cos(at), 0.0])
    outcomes = []
    for angle in (5.2, 5.5, 5.8):
        rx = s_out * np.array([math.sin(angle), math.cos(angle), 0.0])
        channel = answer(model, world([antenna("t", "tx", tx.tolist()), antenna("r", "rx", rx.tolist())]))
        over = (channel.interactions[:, 0] == Interaction.DIFFRACTION) & (
            np.abs(channel.points[:, 0]).max(1) < 1e-6
        )
        expected = formulas.behind_half_plane(at, angle, s_in, s_out, F)
        outcomes.append(close("|H|", expected, abs(complex(channel.a[0, over].sum())), relative=0.02))
    return all_of(*outcomes)


@case("edge", "2,000 steps about a corner and a car: ids stay with their edges")
def _(bench: Bench) -> Outcome:
    """Edges are farther apart than a point moves from one step to the next."""
    car = Thing("car", (3.0, -3.5, 0.76), quaternion=(math.cos(0.2), 0.0, 0.0, math.sin(0.2)))
    channel = _along(_corner(bench, CORNER), _around(2000), car)
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
