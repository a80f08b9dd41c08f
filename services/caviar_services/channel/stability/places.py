"""Cases of places and meshes: antennas at one point, on surfaces, inside; degenerate triangles."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from caviar_protocol.errors import PayloadError
from caviar_services.channel.stability import formulas
from caviar_services.channel.stability.bench import (
    CONDUCTOR,
    Bench,
    Plate,
    Point,
    Thing,
    answer,
    antenna,
    link,
    room,
    square,
    total,
    world,
)
from caviar_services.channel.stability.case import Outcome, all_of, case, close, equal, refused
from caviar_services.channel.stability.waves import LOSSY, ground

F = 3.5e9


def two_rays(heights: tuple[float, float], distance: float) -> complex:
    """H of vertical antennas over the lossy ground."""
    eta = formulas.permittivity(LOSSY.permittivity, LOSSY.conductivity, F)
    direct, bounced, cosine = formulas.over_ground(*heights, distance)
    h = formulas.friis(direct, F) * formulas.phase(direct, F)
    return h + formulas.fresnel(cosine, eta)[1] * formulas.friis(bounced, F) * formulas.phase(bounced, F)


@case("place", "TX and RX at one point, free-space", traced=False)
def _(bench: Bench) -> Outcome:
    channel = link(bench.free_space(F), (3, 4, 5), (3, 4, 5))
    return all_of(equal(0, len(channel.tau), "paths"), equal(0.0, abs(channel.h[0].h).max(), "in H"))


@case("place", "TX and RX at one point, geometric", traced=False)
def _(bench: Bench) -> Outcome:
    return equal(0, len(link(bench.geometric(F), (3, 4, 5), (3, 4, 5)).tau), "paths")


@case("place", "TX and RX at one point over a conductor: only its reflection, straight back")
def _(bench: Bench) -> Outcome:
    """θ̂ of a vertical antenna straight down is along the ground; there the field turns over."""
    model = bench.traced(F, [ground(50.0)], {"surface": CONDUCTOR})
    got = total(link(model, (3, 4, 5), (3, 4, 5)))
    return close("|H|", formulas.friis(10.0, F), abs(got), relative=5e-3)


@case("place", "a body at UTM coordinates and no scenery: its reflection")
def _(bench: Bench) -> Outcome:
    """456 km east and 5,412 km north: length and amplitude are those of the image."""
    origin = np.array([456_789.125, 5_412_345.625, 211.5])
    tx, rx = origin + np.array([0.0, -9.0, 1.0]), origin + np.array([4.0, 8.0, -2.0])
    wall = Thing("wall", (origin + np.array([30.0, 0.0, 0.0])).tolist(), (2.0, 60.0, 60.0))
    channel = link(bench.traced(F), tx.tolist(), rx.tolist(), wall)
    image = formulas.mirrored(tx, origin + np.array([29.0, 0.0, 0.0]), np.array([-1.0, 0.0, 0.0]))
    length = float(np.linalg.norm(image - rx))
    (path,) = np.flatnonzero((channel.interactions == 1).any(1))
    return all_of(
        close("m", length, float(channel.tau[path] * formulas.C), absolute=1e-8),
        close("|a|", formulas.friis(length, F), float(abs(channel.a[0, path])), relative=5e-3),
    )


@case("place", "RX on the ground")
def _(bench: Bench) -> Outcome:
    model = bench.traced(F, [ground(300.0)], {"surface": LOSSY})
    got = total(link(model, (0, 0, 10), (20, 0, 0)))
    return close("(H)", two_rays((10, 0), 20.0), got, relative=5e-3)


@case("place", "RX 1 mm above the ground")
def _(bench: Bench) -> Outcome:
    model = bench.traced(F, [ground(300.0)], {"surface": LOSSY})
    got = total(link(model, (0, 0, 10), (20, 0, 1e-3)))
    return close("(H)", two_rays((10, 1e-3), 20.0), got, relative=5e-3)


@case("place", "TX on the ground")
def _(bench: Bench) -> Outcome:
    model = bench.traced(F, [ground(300.0)], {"surface": LOSSY})
    got = total(link(model, (-20, 0, 0), (0, 0, 10)))
    return close("(H)", two_rays((0, 10), 20.0), got, relative=5e-3)


@case("place", "TX and RX on the ground")
def _(bench: Bench) -> Outcome:
    """The two rays cancel: no field goes along a lossy surface, to this order."""
    model = bench.traced(F, [ground(300.0)], {"surface": LOSSY})
    got = abs(total(link(model, (-20, 0, 0), (20, 3, 0))))
    free = formulas.friis(math.dist((-20, 0), (20, 3)), F)
    return close("of free space", 0.0, got / free, absolute=0.02)


@case("place", "RX on a conducting façade, its field along it: none")
def _(bench: Bench) -> Outcome:
    """A field along a conductor's surface vanishes on it."""
    wall = Plate("wall", [(0, -40, -40), (0, 40, -40), (0, 40, 40), (0, -40, 40)])
    model = bench.traced(F, [wall], {"surface": CONDUCTOR})
    got = abs(total(link(model, (15, 3, 1), (0, 0, 1))))
    return close("of free space", 0.0, got / formulas.friis(math.dist((15, 3), (0, 0)), F), absolute=0.01)


@case("place", "RX on the roof of a moving box of metal: twice the field")
def _(bench: Bench) -> Outcome:
    """The field upright on a conductor is doubled; the source is low, so that it is nearly upright."""
    model = bench.traced(F, body_material="metal")
    bus = Thing("bus", (40.0, 0.0, 1.5), (30.0, 30.0, 3.0))
    ends = [antenna("t", "tx", (0, 0, 8.0)), antenna("bus/r", "rx", (0.0, 0.0, 1.5), parent="bus")]
    got = abs(total(answer(model, world(ends, [bus]))))
    return close("|H|", 2 * formulas.friis(math.hypot(40, 5), F), got, relative=0.02)


@case("place", "RX inside a closed room of metal, TX outside")
def _(bench: Bench) -> Outcome:
    model = bench.traced(F, room((5.0, 4.0, 3.0)), {"surface": CONDUCTOR}, max_depth=2)
    channel = link(model, (20, 3, 1.4), (2.2, 1.7, 1.1))
    return all_of(equal(0, len(channel.tau), "paths"), equal(False, bool(channel.los[0, 0]), "line of sight"))


@case("place", "RX inside a moving box of metal, off its middle")
def _(bench: Bench) -> Outcome:
    van = Thing("van", (10.0, 0.0, 1.0), (4.0, 2.0, 2.0))
    channel = link(bench.traced(F), (0, 0, 3), (10.7, 0.3, 1.2), van)
    return all_of(equal(0, len(channel.tau), "paths"), equal(False, bool(channel.los[0, 0]), "line of sight"))


@case("place", "antenna mounted in the very middle of a body: refused")
def _(bench: Bench) -> Outcome:
    model, van = bench.traced(F), Thing("van", (10.0, 0.0, 1.0))
    ends = [antenna("t", "tx", (0, 0, 3)), antenna("van/r", "rx", (0, 0, 0), parent="van")]
    scene = world(ends, [van])
    return refused(PayloadError, "in the middle of the body of 'van'", lambda: answer(model, scene))


@case("place", "RX underground")
def _(bench: Bench) -> Outcome:
    model = bench.traced(F, [ground(300.0)], {"surface": LOSSY}, max_depth=2)
    channel = link(model, (0, 0, 10), (20, 3, -1.5))
    return all_of(equal(0, len(channel.tau), "paths"), equal(False, bool(channel.los[0, 0]), "line of sight"))


@case("place", "TX and RX underground: the ground reflects from below")
def _(bench: Bench) -> Outcome:
    """A sheet has two sides; what is under it is air to the model."""
    plate = Plate("ground", square(300.0), "surface")
    model = bench.traced(F, [plate], {"surface": LOSSY})
    got = total(link(model, (0, 0, -10), (20, 0, -1.5)))
    return close("(H)", two_rays((10, 1.5), 20.0), got, relative=5e-3)


HALVES = (0, 1, 2), (0, 2, 3)
"""Corners of the triangles of a square."""

SPLIT = [(-300, -300, 0), (300, -300, 0), (300, 300, 0), (-300, 300, 0)]


def _ground_and(plates: list[Plate], bench: Bench, **settings: object) -> Outcome:
    """Two rays over ground, and nothing else of what is there besides."""
    model = bench.traced(F, plates, {"surface": LOSSY}, max_depth=2, **settings)
    channel = link(model, (0, 0, 10), (20, 0, 4))
    return all_of(
        equal(2, len(channel.tau), "paths"),
        close("(H)", two_rays((10, 4), 20.0), total(channel), relative=2e-3),
    )


ODD: dict[str, list[Plate]] = {
    "ground alone": [ground(300.0)],
    "a triangle without area, its corners at one point": [
        ground(300.0),
        Plate("point", [(9, 0, 5), (9, 0, 5), (9, 0, 5)]),
    ],
    "a triangle without area, its corners on a line": [
        ground(300.0),
        Plate("line", [(9, -5, 7), (9, 0, 7), (9, 5, 7)]),
    ],
    "a triangle without area within a surface": [
        Plate("ground", [(-300, -300, 0), (0, -300, 0), (300, -300, 0), (300, 300, 0), (-300, 300, 0)])
    ],
    "a surface twice, in one place": [ground(300.0), Plate("again", square(300.0))],
    "a surface three times, one of them flipped": [
        ground(300.0),
        Plate("again", square(300.0)),
        Plate("flipped", square(300.0)[::-1]),
    ],
    "a face flipped": [Plate("ground", square(300.0)[::-1])],
    "two coplanar surfaces that overlap": [
        ground(300.0),
        Plate("patch", [(x + 11, y + 3, z) for x, y, z in square(40.0)]),
    ],
}
for _name, _plates in ODD.items():
    case("mesh", _name)(partial(_ground_and, _plates))
for _name in ("a surface three times, one of them flipped", "a triangle without area within a surface"):
    case("mesh", f"{_name}, with diffraction")(partial(_ground_and, ODD[_name], diffraction=True))


_SIDE = 40
"""Squares along a side of the ground of many triangles."""


@case("mesh", f"a surface of {2 * _SIDE**2:,} triangles")
def _(bench: Bench) -> Outcome:
    """They are one plane, which reflects once."""
    x, y = np.meshgrid(*[np.linspace(-300, 300, _SIDE + 1)] * 2)
    corners = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
    i = np.arange(len(corners)).reshape(_SIDE + 1, _SIDE + 1)
    squares = i[:-1, :-1], i[:-1, 1:], i[1:, 1:], i[1:, :-1]
    faces = np.concatenate([np.stack([squares[c] for c in half], -1).reshape(-1, 3) for half in HALVES])
    return _ground_and([Plate("ground", corners.tolist(), faces=faces.tolist())], bench)


def _seam(shift: Point, bench: Bench) -> Outcome:
    """The reflection lies on the edge that the ground's two triangles share: it is one, not two or none."""
    model = bench.traced(F, [ground(300.0)], {"surface": LOSSY})
    tx, rx = np.array([-10.0, -10.0, 6.0]) + shift, np.array([10.0, 10.0, 6.0]) + shift
    channel = link(model, tx.tolist(), rx.tolist())
    flat = float(np.hypot(20, 20))
    return all_of(
        equal(2, len(channel.tau), "paths"),
        close("(H)", two_rays((6, 6), flat), total(channel), relative=2e-3),
    )


case("mesh", "a reflection on the seam of two triangles")(partial(_seam, (0.0, 0.0, 0.0)))
case("mesh", "a reflection 1 µm beside the seam")(partial(_seam, (1e-6, 0.0, 0.0)))
