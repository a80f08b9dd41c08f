"""Bodies of buildings: closed meshes over footprints with courtyards, with flat and pitched roofs."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int32Array
from caviar_space.meshes import Mesh

if TYPE_CHECKING:
    from shapely import Polygon

# Corners of a footprint that are nearer to the line between their neighbours [m] are no corners of its roof.
_STRAIGHT_M = 0.3

PITCHED = ("gabled", "hipped", "pyramidal")
"""Shapes of roofs that are not flat."""


class Body(NamedTuple):
    """Mesh of a building, closed but for a `plate`."""

    mesh: Mesh
    roof: BoolArray
    """Whether a triangle is of the roof, Shape ``[F]``; others are of walls and floor."""


class Roof(NamedTuple):
    """Form of a roof."""

    shape: str = "flat"
    """One of `PITCHED`; others are flat."""
    height_m: float | None = None
    """Of the ridge over the eaves; None: a pitch of 30°, and at most half of the body's height."""
    across: bool = False
    """Whether the ridge runs along the shorter side."""
    direction_deg: float | None = None
    """Clockwise from north, in which a side of the roof falls; None: the ridge is along the longer side."""


def triangulated(polygon: Polygon) -> tuple[Float64Array, Int32Array]:
    """Triangles of a polygon with holes, whose corners they all have.

    Args:
        polygon: Valid.

    Returns:
        Corners, Shape ``[V, 2]``: the outline counter-clockwise, then holes clockwise; and triangles,
        counter-clockwise, Shape ``[F, 3]``.
    """
    import shapely

    points = np.concatenate([np.array(ring.coords)[:-1, :2] for ring in _rings(polygon)])
    # Not by ear clipping alone, which leaves out corners on a straight line: meshes would have gaps there.
    cells = shapely.get_parts(shapely.constrained_delaunay_triangles(polygon))
    corners = shapely.get_coordinates(cells).reshape(-1, 4, 2)[:, :3]
    number = {place: index for index, place in enumerate(map(tuple, points.tolist()))}
    faces = np.array([[number[tuple(at)] for at in cell] for cell in corners.tolist()], np.int32)
    a, b, c = np.moveaxis(points[faces], 1, 0)
    clockwise = (b - a)[:, 0] * (c - a)[:, 1] < (b - a)[:, 1] * (c - a)[:, 0]
    faces[clockwise] = faces[clockwise, ::-1]
    return points, faces


def prism(polygon: Polygon, low: float, high: float) -> Body:
    """Body with a flat roof.

    Args:
        polygon: Footprint, with courtyards as holes.
        low, high: Of floor and roof [m].
    """
    points, top = triangulated(polygon)
    count = len(points)
    here = np.arange(count, dtype=np.int32)
    sizes = [len(ring.coords) - 1 for ring in _rings(polygon)]
    there = np.concatenate(
        [np.roll(part, -1) for part in np.split(here, np.cumsum(sizes)[:-1])]
    )  # the next corner of the ring
    walls = np.concatenate(
        [np.stack([here, there, there + count], 1), np.stack([here, there + count, here + count], 1)]
    )
    vertices = np.concatenate([np.column_stack([points, np.full(count, z)]) for z in (low, high)])
    faces = np.concatenate([walls, top[:, ::-1], top + count]).astype(np.int32)
    return Body(Mesh(vertices, faces), np.arange(len(faces)) >= len(faces) - len(top))


def plate(polygon: Polygon, height: float) -> Body:
    """Roof without walls: level faces that look up.

    Args:
        polygon: From above.
        height: [m]
    """
    points, faces = triangulated(polygon)
    return Body(
        Mesh(np.column_stack([points, np.full(len(points), height)]), faces), np.ones(len(faces), bool)
    )


def roofed(polygon: Polygon, low: float, high: float, roof: Roof) -> Body | None:
    """Body with a pitched roof.

    Args:
        polygon: Footprint.
        low, high: Of floor and ridge [m].
        roof: Its form.

    Returns:
        None: the roof is flat, or the footprint is not one that it fits: a quadrilateral, or for
        ``pyramidal`` a convex one.
    """
    plain = polygon.simplify(_STRAIGHT_M)
    corners = np.array(_rings(plain)[0].coords)[:-1, :2] if not plain.is_empty else np.zeros((0, 2))
    convex = not polygon.interiors and plain.convex_hull.area < 1.01 * plain.area
    if not convex or roof.shape not in PITCHED:
        return None
    if roof.shape != "pyramidal" and len(corners) != 4:
        return None
    # Sides 0 and 2 are below the eaves: the ridge is along them.
    sides = np.roll(corners, -1, axis=0) - corners
    along = sides[0] - sides[2] if len(corners) == 4 else sides[0]
    beside = sides[1] - sides[3] if len(corners) == 4 else sides[0]
    turned = (np.linalg.norm(beside) > np.linalg.norm(along)) != roof.across
    if roof.direction_deg is not None:
        fall = np.array(
            [math.sin(math.radians(roof.direction_deg)), math.cos(math.radians(roof.direction_deg))]
        )
        turned = abs(beside @ fall) / np.linalg.norm(beside) < abs(along @ fall) / np.linalg.norm(along)
    if turned:
        corners = np.roll(corners, -1, axis=0)
    ends = (corners[[3, 1]] + corners[[0, 2]]) / 2 if len(corners) == 4 else np.zeros((2, 2))
    half_m = float(np.linalg.norm(corners[0] - corners[-1])) / 2
    rise = (
        roof.height_m
        if roof.height_m is not None
        else min(half_m * math.tan(math.radians(30)), (high - low) / 2)
    )
    eaves = max(high - rise, low + 0.1)
    if not eaves < high:
        return None
    count = len(corners)
    if roof.shape == "pyramidal":
        ridge = np.array(plain.centroid.coords)
    else:
        inset = 0.0 if roof.shape == "gabled" else min(half_m / np.linalg.norm(ends[1] - ends[0]), 0.45)
        ridge = ends + inset * (ends[::-1] - ends)
    here = np.arange(count, dtype=np.int32)
    there = np.roll(here, -1)
    floor = np.stack([np.zeros(count - 2, np.int32), here[2:], here[1:-1]], 1)
    walls = [np.stack([here, there, there + count], 1), np.stack([here, there + count, here + count], 1)]
    top = 2 * count
    if len(ridge) == 1:
        slopes = np.stack([here + count, there + count, np.full(count, top, np.int32)], 1)
        gables = np.zeros((0, 3), np.int32)
    else:
        slopes = np.array([[4, 5, 9], [4, 9, 8], [6, 7, 8], [6, 8, 9], [5, 6, 9], [7, 4, 8]], np.int32)
        slopes, gables = (slopes[:4], slopes[4:]) if roof.shape == "gabled" else (slopes, slopes[:0])
    vertices = np.concatenate(
        [
            np.column_stack([at, np.full(len(at), z)])
            for at, z in ((corners, low), (corners, eaves), (ridge, high))
        ]
    )
    faces = np.concatenate([floor, *walls, gables, slopes]).astype(np.int32)
    return Body(Mesh(vertices, faces), np.arange(len(faces)) >= len(faces) - len(slopes))


def crown(x: float, y: float, low: float, high: float, diameter: float) -> Mesh:
    """Hull of the crown of a tree: a double pyramid of six sides, with the volume of the ellipsoid.

    Args:
        x, y: Of the trunk [m].
        low, high: Of the crown [m].
        diameter: Of the crown [m].
    """
    # π/6·d²·h of the ellipsoid = (3√3/2·r²)·h/3 of the double pyramid.
    radius = diameter * math.sqrt(math.pi / (3 * math.sqrt(3)))
    angles = np.arange(6) * math.pi / 3
    ring = np.column_stack(
        [x + radius * np.cos(angles), y + radius * np.sin(angles), np.full(6, (low + high) / 2)]
    )
    here = np.arange(6, dtype=np.int32)
    there = np.roll(here, -1)
    upper = np.stack([here, there, np.full(6, 6)], 1)
    lower = np.stack([there, here, np.full(6, 7)], 1)
    return Mesh(np.vstack([ring, (x, y, high), (x, y, low)]), np.concatenate([upper, lower]).astype(np.int32))


def _rings(polygon: Polygon) -> list:  # type: ignore[type-arg]  # of shapely's LinearRing
    from shapely.geometry.polygon import orient

    oriented = orient(polygon)
    return [oriented.exterior, *oriented.interiors]
