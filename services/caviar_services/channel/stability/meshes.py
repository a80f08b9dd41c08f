"""Meshes as they come: triangles without area, surfaces twice, faces the other way round."""

from __future__ import annotations

from functools import partial

import numpy as np

from caviar_services.channel.stability.bench import Bench, Plate, Point, link, square, total
from caviar_services.channel.stability.case import Outcome, all_of, case, close, equal
from caviar_services.channel.stability.places import F, two_rays
from caviar_services.channel.stability.waves import LOSSY, ground

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
