"""Which candidates are paths between the outermost elements of arrays, in one kernel.

A path that the arrays' centres have may be hidden from some elements, and one that they do not have may
exist for others. Both are seen at the corners of the arrays, with the chains of planes that are
known from the launch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int32Array, Int64Array
from caviar_services.channel.sionna.scene import SionnaScene
from caviar_services.drjit_setup import aligned_columns, aligned_indices, positions, several
from caviar_space.planes import PlaneTable

# [m] that a point may lie outside the box of its plane: more than float32 and the planes' tolerance do.
_SLACK = 0.1

# The same as a part of the largest coordinate.
_RELATIVE_SLACK = 1e-5

# Sine of the angle to a plane below which the point in it is too uncertain to judge by.
_GRAZING = 0.03

# [m]; rays from face to face start this far from the first, whose points are known to some 1e-5 m. From and
# to antennas rays start at the antenna, so that nothing is off.
_OFF_SURFACE = 2e-4

# [m]; a surface this near a segment's end is what stands there.
_AT_END = 1e-2


class Planes:
    """The planes of a frame on the ray tracer's side, to mirror in and to rule out chains by.

    Args:
        table: As the planes stand.
    """

    def __init__(self, table: PlaneTable) -> None:
        import mitsuba as mi

        rows = np.concatenate([table.origin, table.normal, table.low, table.high], axis=1).T
        reach = float(np.abs(rows).max(initial=0.0))
        columns = [mi.Float(column) for column in aligned_columns(rows)]
        # In float32 what is far from the centre is known less exactly.
        self._slack = _SLACK + _RELATIVE_SLACK * reach
        self._origin, self._normal = mi.Point3f(*columns[:3]), mi.Vector3f(*columns[3:6])
        self._low, self._high = mi.Point3f(*columns[6:9]), mi.Point3f(*columns[9:12])

    def possible(
        self, chains: Int32Array, straight: BoolArray, source: Any, targets: Any
    ) -> tuple[Int64Array, Int64Array]:
        """Chain and target of each pair of them that could be a path.

        The source is mirrored at one plane after the other; from the target, the line to the last image has
        to meet the last plane between both ends and within the box around its triangles, and so on back.

        Args:
            chains: Plane at each interaction, −1 where any may be, Shape ``[C, D]``.
            straight: Which chains have reflections and transmissions alone; of others nothing is known, so
                that all could be, Shape ``[C]``.
            source: A `mitsuba.Point3f` of width 1.
            targets: A `mitsuba.Point3f`.

        Returns:
            Indices of chains and of targets.
        """
        import drjit as dr
        import mitsuba as mi

        count, receivers = len(chains), dr.width(targets)
        if not count * receivers:
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        # Opaque: a literal would be part of the kernel, which would be compiled for each number of receivers.
        per_chain = dr.opaque(mi.UInt, receivers)
        lane = dr.arange(mi.UInt, count * receivers)
        chain, target = lane // per_chain, lane % per_chain
        columns = [mi.UInt(aligned_indices(column + 1)) for column in chains.T.astype(np.int64)]
        judged = dr.gather(mi.UInt, mi.UInt(aligned_indices(straight)), chain) != 0
        plane = [dr.gather(mi.UInt, column, chain) for column in columns]
        images = self.images(mi.Point3f(source), plane)
        here, possible, unsure = dr.gather(mi.Point3f, targets, target), mi.Bool(True), ~judged
        for number, image in zip(reversed(plane), reversed(images[1:]), strict=True):
            met, grazing, meets = self._met(here, image, number)
            # The point in a plane that is met at a small angle is too uncertain: such chains go on to the
            # exact test.
            unsure |= grazing & (number > 0)
            possible &= meets | unsure | (number == 0)
            here = dr.select(number > 0, met, here)
        kept: Any = dr.compress(possible)
        lanes = kept.numpy().astype(np.int64)
        return lanes // receivers, lanes % receivers

    def images(self, source: Any, numbers: Sequence[Any]) -> list[Any]:
        """A source and its image in one plane after the other.

        Args:
            source: A `mitsuba.Point3f`.
            numbers: Of the planes, from 1; 0 is none. Each a `mitsuba.UInt`.
        """
        import drjit as dr

        images = [source]
        for number in numbers:
            origin, normal = self.plane(number)
            mirrored = images[-1] - 2 * dr.dot(images[-1] - origin, normal) * normal
            images.append(dr.select(number > 0, mirrored, images[-1]))
        return images

    def plane(self, number: Any) -> tuple[Any, Any]:
        """A point [m] and the unit normal of planes.

        Args:
            number: Counted from 1, 0 is none, a `mitsuba.UInt`.
        """
        import drjit as dr
        import mitsuba as mi

        used = number > 0
        origin = dr.gather(mi.Point3f, self._origin, number - 1, used)
        return origin, dr.gather(mi.Vector3f, self._normal, number - 1, used)

    def _met(self, here: Any, image: Any, number: Any) -> tuple[Any, Any, Any]:
        """Where the line to an image meets a plane; whether it does so at too small an angle to tell;
        whether that may be a point of a path."""
        import drjit as dr
        import mitsuba as mi

        used = number > 0
        origin, normal = self.plane(number)
        line = image - here
        length, across = dr.norm(line), dr.dot(line, normal)
        grazing = dr.abs(across) < _GRAZING * length
        along = dr.dot(origin - here, normal) / dr.select(grazing, 1.0, across)
        met = here + along * line
        low = dr.gather(mi.Point3f, self._low, number - 1, used) - self._slack
        high = dr.gather(mi.Point3f, self._high, number - 1, used) + self._slack
        margin = self._slack / dr.maximum(dr.abs(across), 1e-9)
        between = (along > -margin) & (along < 1.0 + margin)
        return met, grazing, between & dr.all((met > low) & (met < high))


class Faces:
    """What rays meet first in a scene: how far away, and which of the surfaces of its objects' faces.

    Args:
        scene: Its bodies are where they were placed last.
    """

    def __init__(self, scene: SionnaScene) -> None:
        import mitsuba as mi

        self._scene = scene
        self._offset = mi.UInt(aligned_indices(scene.offset_by_shape))
        self._surface_of = scene.surface_of
        self._surface = mi.UInt(aligned_indices(scene.surface_of))

    def _follow_scene(self) -> None:
        """Know which faces are one surface now."""
        import mitsuba as mi

        # The table is replaced where faces were joined or parted: mostly nothing is to be uploaded.
        if self._surface_of is not self._scene.surface_of:
            self._surface_of = self._scene.surface_of
            self._surface = mi.UInt(aligned_indices(self._surface_of))

    def along(self, start: Any, end: Any, active: Any) -> tuple[Any, Any]:
        """Look along segments, in a kernel.

        Args:
            start, end: `mitsuba.Point3f`.
            active: `mitsuba.Bool`.

        Returns:
            How much farther than a segment's end [m] the first surface along it is, and its number.
        """
        import drjit as dr
        import mitsuba as mi

        self._follow_scene()
        behind, triangle, hit = self._met(start, end, active)
        return behind, dr.gather(mi.UInt, self._surface, triangle, hit)

    def _met(self, start: Any, end: Any, active: Any) -> tuple[Any, Any, Any]:
        """How much farther than a segment's end [m] the first triangle along it is, its number, and whether
        there is one."""
        import drjit as dr
        import mitsuba as mi

        line = end - start
        length = dr.norm(line)
        active &= length > 0.0
        ray = mi.Ray3f(start, line / dr.select(length > 0.0, length, 1.0))
        met = self._scene.mi_scene.ray_intersect_preliminary(ray, coherent=False, active=active)
        hit = active & met.is_valid()
        offset = dr.gather(mi.UInt, self._offset, mi.UInt(dr.reinterpret_array(mi.UInt, met.shape)), hit)
        return met.t - length, offset + met.prim_index, hit

    def nearest(self, start: Float64Array, end: Float64Array) -> tuple[Float64Array, Int64Array]:
        """Look along segments.

        Args:
            start, end: [m], Shape ``[Q, 3]``.

        Returns:
            How much farther than a segment's end [m] the first surface along it is, infinite where there is
            none, and its number, anything where there is none; each of Shape ``[Q]``.
        """
        return _looked(self.along, start, end)

    def first_triangle(self, start: Float64Array, end: Float64Array) -> tuple[Float64Array, Int64Array]:
        """As `nearest`, with the number of the triangle.

        Args:
            start, end: [m], Shape ``[Q, 3]``.
        """
        return _looked(self._met, start, end)


def _looked(
    look: Callable[[Any, Any, Any], tuple[Any, ...]], start: Float64Array, end: Float64Array
) -> tuple[Float64Array, Int64Array]:
    import drjit as dr
    import mitsuba as mi

    # One lane alone would be another kernel to Dr.Jit.
    lanes = several(len(start))
    behind, number, *_ = look(
        positions(start[lanes]), positions(end[lanes]), dr.full(mi.Bool, True, len(lanes))
    )
    dr.eval(behind, number)
    behind, number = behind.numpy()[: len(start)], number.numpy()[: len(start)]
    return behind.astype(np.float64), number.astype(np.int64)


@dataclass(frozen=True, eq=False)
class Corners:
    """Outermost elements of arrays around a transmitter and its receivers [m]."""

    transmitter: Float64Array
    """Shape ``[K, 3]``."""
    receivers: Float64Array
    """Shape ``[R, L, 3]``."""

    def relative_to(self, centre: Float64Array) -> Corners:
        """The same, counted from a centre.

        Args:
            centre: [m], Shape ``[3]``.
        """
        return Corners(self.transmitter - centre, self.receivers - centre)

    def take(self, which: slice) -> Corners:
        """Those of some receivers.

        Args:
            which: Of the receivers.
        """
        return Corners(self.transmitter, self.receivers[which])


def at_corners(
    faces: Faces,
    planes: Planes,
    chains: Int32Array,
    depth: Int64Array,
    receiver: Int64Array,
    at_centres: BoolArray,
    corners: Corners | None,
) -> tuple[BoolArray, BoolArray]:
    """Look at candidates from the corners of the arrays.

    Args:
        faces: Of the scene.
        planes: Of the scene.
        chains: Plane at each interaction of P candidates, −1 where any may be, Shape ``[P, D]``.
        depth: Interactions of each, Shape ``[P]``.
        receiver: Of each, Shape ``[P]``.
        at_centres: Which of them the arrays' centres have, Shape ``[P]``.
        corners: Of the arrays; None: only the centres count.

    Returns:
        Which only other elements than the centres have, and which all corners have, each of Shape ``[P]``.
    """
    hidden, settled = np.zeros((2, len(at_centres)), np.bool_)
    if corners is not None:
        mirrors = (chains >= 0) == (np.arange(chains.shape[1]) < depth[:, None])
        # Of chains with other interactions than reflections the corners say nothing.
        some = np.flatnonzero(mirrors.all(1))
        exist = reached(faces, planes, chains[some], receiver[some], corners.transmitter, corners.receivers)
        hidden[some] = exist.any((1, 2))
        settled[some] = exist.all((1, 2))
    return hidden & ~at_centres, settled & at_centres


def reached(
    faces: Faces,
    planes: Planes,
    chains: Int32Array,
    receiver: Int64Array,
    sources: Float64Array,
    targets: Float64Array,
) -> BoolArray:
    """Whether chains of reflections are paths, Shape ``[P, L, K]``.

    Args:
        chains: Plane at each interaction, −1 past the last, Shape ``[P, D]``.
        receiver: Of each chain, Shape ``[P]``.
        sources: Corners of the transmitter's array [m], Shape ``[K, 3]``.
        targets: Corners of the receivers' arrays [m], Shape ``[R, L, 3]``.
    """
    import drjit as dr
    import mitsuba as mi

    lanes = several(len(chains))
    shape = (len(chains), targets.shape[1], len(sources))
    chains, receiver = chains[lanes], receiver[lanes]
    count, corners = len(chains), targets.shape[1]
    lane = dr.arange(mi.UInt, count * corners * len(sources))
    per_chain, per_corner = (dr.opaque(mi.UInt, n) for n in (corners * len(sources), len(sources)))
    chain, rest = lane // per_chain, lane % per_chain
    corner, source = rest // per_corner, rest % per_corner
    number = [
        dr.gather(mi.UInt, mi.UInt(aligned_indices(column + 1)), chain)
        for column in chains.T.astype(np.int64)
    ]
    first = dr.gather(mi.UInt, mi.UInt(aligned_indices(receiver * corners)), chain)
    start, here = (
        dr.gather(mi.Point3f, positions(places[several(len(places))]), index)
        for places, index in ((sources, source), (targets.reshape(-1, 3), first + corner))
    )
    found: BoolArray = _exists(faces, planes, number, start, here).numpy()
    return found.reshape(-1, *shape[1:])[: shape[0]]


def reflected(
    faces: Faces, planes: Planes, chains: Int64Array, start: Float64Array, end: Float64Array
) -> BoolArray:
    """Whether chains of reflections are paths between positions, Shape ``[Q]``.

    Args:
        faces, planes: Of the scene.
        chains: Plane at each interaction, −1 past the last, Shape ``[Q, D]``.
        start, end: [m], Shape ``[Q, 3]``.
    """
    import mitsuba as mi

    lanes = several(len(chains))
    number = [mi.UInt(aligned_indices(column + 1)) for column in chains[lanes].T]
    found: BoolArray = _exists(faces, planes, number, positions(start[lanes]), positions(end[lanes])).numpy()
    return found[: len(chains)]


def _exists(faces: Faces, planes: Planes, number: list[Any], start: Any, end: Any) -> Any:
    """The same on the ray tracer's side; planes are numbered from 1, 0 is none."""
    import drjit as dr
    import mitsuba as mi

    here = end
    images = planes.images(start, number)
    # From the receiver back to the transmitter: each image is seen through the plane that made it.
    exists, lifted = mi.Bool(True), here
    for plane, image in zip(number[::-1], images[:0:-1], strict=True):
        origin, normal = planes.plane(plane)
        used = exists & (plane > 0)
        line = image - here
        along = dr.dot(origin - here, normal) / dr.dot(line, normal)
        met = here + along * line
        exists &= ~used | ((along > 0) & (along < 1))
        used &= exists
        exists &= ~used | (faces.along(lifted, met, used)[1] == plane - 1)
        here = dr.select(used, met, here)
        lifted = dr.select(
            used, met - _OFF_SURFACE * dr.select(dr.dot(line, normal) > 0, normal, -normal), lifted
        )
    # The first segment ends at the first plane, or at the receiver where nothing reflects.
    behind, met_plane = faces.along(start, here, exists)
    exists &= (
        dr.select(number[0] > 0, met_plane == number[0] - 1, behind > -_AT_END)
        if number
        else behind > -_AT_END
    )
    return exists
