"""Paths by way of chains of faces: their points by images, in float64, and whether anything is in the way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_services.channel.enumeration.beam_ends import ChainPairs
from caviar_services.channel.enumeration.face_rectangles import FaceRectangles
from caviar_services.channel.sionna.candidate_visibility import Faces
from caviar_services.channel.sionna.coplanar_faces import COPLANAR, COPLANAR_RELATIVE
from caviar_services.channel.sionna.planes import PlaneTable
from caviar_services.channel.sionna.scene import SionnaScene

OFF_SURFACE = 2e-4
"""[m]; rays from face to face start this far from the first."""

_PARALLEL = 1 - 1e-6
"""Cosine between the normals of planes that are parallel."""

AT_END = 1e-3
"""[m]; what stands this near the end of a segment is what it ends at: two faces meet there, or are one."""


@dataclass(frozen=True, eq=False)
class ImagePaths:
    """P paths of at most D reflections."""

    chain: Int64Array
    """Faces, −1 behind the last, Shape ``[P, D]``."""
    receiver: Int64Array
    """Shape ``[P]``."""
    points: Float64Array
    """Of the reflections, the receiver behind the last [m], Shape ``[P, D, 3]``."""

    def take(self, which: BoolArray | Int64Array) -> ImagePaths:
        """These paths."""
        return ImagePaths(self.chain[which], self.receiver[which], self.points[which])


def image_paths(
    faces: FaceRectangles, pairs: ChainPairs, transmitter: Float64Array, receivers: Float64Array
) -> ImagePaths:
    """Those of the pairs whose chains mirror the transmitter, each within a triangle of its face, so that the
    receiver may see it, sorted by receiver and chain; positions in metres."""
    chain, count = pairs.chain, (pairs.chain >= 0).sum(1)
    order = np.lexsort((*chain.T[::-1], count, pairs.receiver))
    chain, receiver = chain[order], pairs.receiver[order]
    points, good = reflection_points(
        faces, chain, np.broadcast_to(transmitter, (len(chain), 3)), receivers[receiver]
    )
    return ImagePaths(chain[good], receiver[good], points[good])


def reflection_points(
    faces: FaceRectangles, chain: Int64Array, start: Float64Array, end: Float64Array
) -> tuple[Float64Array, BoolArray]:
    """Where chains of faces reflect what goes from N starts to N ends, and which chains do.

    Parameters
    ----------
    chain
        Faces, −1 behind the last, Shape ``[N, D]``.
    start, end
        [m], Shape ``[N, 3]``.

    Returns
    -------
    Points, the end behind the last [m], Shape ``[N, D, 3]``, and which rows have each of them within a
    triangle of its face, on the side that reflects, Shape ``[N]``. Of other rows, points are anything.
    """
    depth, count = chain.shape[1], (chain >= 0).sum(1)
    images = [start]
    for d in range(depth):
        used = np.flatnonzero(count > d)
        image = images[-1].copy()
        image[used] = faces.mirrored(image[used], chain[used, d])
        images.append(image)
    here = end.copy()
    points = np.repeat(here[:, None], depth, axis=1)
    good = np.ones(len(chain), np.bool_)
    for d in reversed(range(depth)):
        rows = np.flatnonzero(good & (count > d))
        face, towards = chain[rows, d], images[d + 1][rows]
        near, far = faces.height(here[rows], face), faces.height(towards, face)
        crosses = (near * far < 0) & ((near > 0) | faces.two_sided[face])
        good[rows[~crosses]] = False
        rows, face, towards, near, far = (part[crosses] for part in (rows, face, towards, near, far))
        met = here[rows] + (near / (near - far))[:, None] * (towards - here[rows])
        within = faces.in_rectangle(met, face)
        good[rows[~within]] = False
        here[rows], points[rows, d] = met, met
    rows = np.flatnonzero(good)
    path, place = np.nonzero(chain[rows] >= 0)
    path = rows[path]
    held = faces.in_triangles(points[path, place], chain[path, place])
    good[path[~held]] = False
    return points, good


def unhidden(
    scene: SionnaScene,
    look: Faces,
    faces: FaceRectangles,
    paths: ImagePaths,
    transmitter: Float64Array,
    receivers: Float64Array,
) -> BoolArray:
    """Which paths nothing stands in the way of, Shape ``[P]``; positions in metres.

    A ray along each segment meets the surface of its end first, or something within `AT_END` of it that
    does not stand in front of it: shorter rays would lose what grazes.
    """
    count = (paths.chain >= 0).sum(1)
    end = receivers[paths.receiver]
    rows = np.arange(len(count))
    first, last, wanted, owner = [], [], [], []
    for d in range(paths.chain.shape[1] + 1):
        lane = rows[count >= d]
        before = paths.points[lane, d - 1] if d else np.broadcast_to(transmitter, (len(lane), 3))
        ends = count[lane] == d
        if d < paths.chain.shape[1]:
            arriving, face = paths.points[lane, d], paths.chain[lane, d]
        else:
            arriving, face = end[lane], np.full(len(lane), -1)
        plane = np.where(ends, -1, faces.plane[face] if len(faces) else -1)
        if d:
            # The last segment is looked along from the receiver, which is off every surface.
            mirror = paths.chain[lane, d - 1]
            normal = faces.normal[mirror]
            side = np.sign(np.einsum("nc,nc->n", arriving - before, normal))[:, None]
            lifted = before + OFF_SURFACE * side * normal
            start = np.where(ends[:, None], arriving, lifted)
            arriving = np.where(ends[:, None], before, arriving)
            plane = np.where(ends, faces.plane[mirror], plane)
        else:
            start = before
        first.append(start)
        last.append(arriving)
        wanted.append(plane)
        owner.append(lane)
    owners, planes = np.concatenate(owner), np.concatenate(wanted)
    free = np.ones(len(count), np.bool_)
    if len(owners):
        ends = np.concatenate(last)
        behind, met = look.nearest(np.concatenate(first), ends)
        other = (behind < 0) & (met != np.where(planes >= 0, scene.joined.label[planes], -1))
        hidden = other & (behind < -AT_END)
        near = np.flatnonzero(other & ~hidden & (planes >= 0))
        hidden[near] = in_front(scene.plane_table, met[near], planes[near], ends[near])
        free[owners[hidden]] = False
    return free


def in_front(table: PlaneTable, met: Int64Array, wanted: Int64Array, points: Float64Array) -> BoolArray:
    """Whether planes that rays met before points [m] of others hide these: they are parallel, and farther
    apart than rounding."""
    normal = table.normal[met]
    parallel = np.abs(np.einsum("nc,nc->n", normal, table.normal[wanted])) > _PARALLEL
    height = np.abs(np.einsum("nc,nc->n", points - table.origin[met], normal))
    hidden: BoolArray = parallel & (height > COPLANAR + COPLANAR_RELATIVE * np.abs(points).max(1))
    return hidden
