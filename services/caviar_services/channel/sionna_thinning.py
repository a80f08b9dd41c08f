"""Few diffuse paths for each receiver, chosen among every point that rays met.

Most points at which rays meet something rough bring a receiver next to nothing: they are far away, or were
met behind other reflections. So each point is kept with a probability that goes by what it is expected to
bring, and its power is divided by that probability: the mean over all choices is the power of all points
(Russian roulette; J. Arvo and D. Kirk, "Particle transport and image synthesis", SIGGRAPH 1990). What was
not chosen is not tested for occlusion, and has no field.

Points are not drawn: each point at which a ray meets a rough surface is one, whether the ray goes on
diffusely, as reflection or through it (splitting, ibid.), so that none of the rays is lost to the others.
Between neighbouring rays the choice goes by a sequence of low discrepancy, and so it falls evenly.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array, UInt64Array
from caviar_protocol.seeding import derive_seed
from caviar_services.channel.sionna_launch import Launch, LaunchOptions
from caviar_services.columns import aligned_columns, aligned_indices, several

_BEHIND_ANOTHER = 0.15
"""How much less a point brings that was met behind another interaction: about a reflection's loss."""

_GRAZING = 0.1
"""Added to the cosine of Lambert's law, so that no point that is seen at a small angle is hardly ever chosen."""

_NEAR = 1.0
"""[m²]; added to the squared distance, for the same reason and so that weights have a limit."""

_UNIT = 2.0**36
"""Weights are added up as multiples of its inverse: sums of integers do not depend on their order."""

_GOLDEN = np.uint64(2654435769)
"""2³² divided by the golden ratio: multiples of it, modulo 2³², are a sequence of low discrepancy."""

_WORD = np.uint64(0xFFFFFFFF)


class Thinning:
    """Chooses the diffuse paths of a launch, about ``options.diffuse_paths`` for each receiver at most.

    Parameters
    ----------
    mi_scene
        The Mitsuba scene, with its radio materials.
    options
        What is traced.
    """

    def __init__(self, mi_scene: Any, options: LaunchOptions) -> None:
        import drjit as dr
        import mitsuba as mi

        assert options.diffuse_paths is not None
        self.mi_scene = mi_scene
        self._wanted = options.diffuse_paths
        self._offset = np.uint64(derive_seed(options.seed, 0, "diffuse paths") & 0xFFFFFFFF)
        shapes = list(mi_scene.shapes())
        numbers = [int(dr.reinterpret_array(mi.UInt, mi.ShapePtr(shape))[0]) for shape in shapes]
        self._roughness = np.zeros(max(numbers, default=0) + 1)
        """Squared scattering coefficient S² of each process-local shape."""
        for number, shape in zip(numbers, shapes, strict=True):
            self._roughness[number] = float(shape.bsdf().scattering_coefficient[0]) ** 2

    def points(self, launch: Launch) -> Points:
        """All points at which rays of a launch met something rough."""
        rays: list[Int64Array] = [np.zeros(0, np.int64)]
        depths, parts = [np.zeros(0, np.int64)], [np.zeros((7, 0))]
        for d, bounce in enumerate(launch.bounces):
            roughness = self._roughness[bounce.shape.numpy() * (bounce.kind.numpy() != 0)]
            ray = np.flatnonzero((roughness > 0) & (bounce.kind.numpy() != 0))
            columns = [axis.numpy()[ray] for vector in (bounce.point, bounce.normal) for axis in vector]
            rays.append(ray)
            depths.append(np.full(len(ray), d + 1, np.int64))
            parts.append(np.stack([*columns, roughness[ray] * _BEHIND_ANOTHER**d]))
        return Points(self, np.concatenate(rays), np.concatenate(depths), np.concatenate(parts, axis=1))

    def chosen(self, ray: Int64Array, depth: Int64Array, weight: Float64Array) -> tuple[BoolArray, Float64Array]:
        """Which points are kept for which receivers, and with what probability, each of Shape ``[P, R]``.

        A point's place in the sequence is its ray's and depth's, whoever receives: so the choice for a
        receiver changes as little as its weights do.
        """
        total = np.rint(weight * _UNIT).astype(np.int64).sum(0) / _UNIT
        probability = weight * (self._wanted / np.maximum(total, 1 / _UNIT))
        np.minimum(probability, 1.0, out=probability)
        place = (ray.astype(np.uint64) * _GOLDEN + self._offset + _turned(depth)) & _WORD
        kept: BoolArray = place[:, None] * 2.0**-32 < probability
        return kept, probability


def _turned(depth: Int64Array) -> UInt64Array:
    """Where the sequence begins at each depth: anywhere else."""
    return depth.astype(np.uint64) * np.uint64(0x85EBCA6B)


class Points:
    """P points of a launch, in the order of depth and ray."""

    def __init__(self, thinning: Thinning, ray: Int64Array, depth: Int64Array, rows: Float64Array) -> None:
        import mitsuba as mi

        self.ray = ray
        """Shape ``[P]``."""
        self.depth = depth
        """Shape ``[P]``."""
        self._thinning = thinning
        self._brings = rows[6]
        self._all = several(len(ray))
        columns = [mi.Float(column) for column in aligned_columns(rows[:6, self._all])]
        self._point, self._normal = mi.Point3f(*columns[:3]), mi.Normal3f(*columns[3:])

    def reached(self, targets: Any) -> tuple[Int64Array, Int64Array, Float64Array]:
        """Points that were chosen for receivers that they reach, the receivers, and the probabilities.

        ``targets`` are the receivers, a `mitsuba.Point3f`.
        """
        nobody = np.zeros(0, np.int64)
        if not len(self.ray):
            return nobody, nobody, np.zeros(0)
        kept, probability = self._thinning.chosen(self.ray, self.depth, self._weights(targets))
        point, receiver = np.nonzero(kept)
        if not len(point):
            return nobody, nobody, np.zeros(0)
        free = self._free(point, receiver, targets)
        point, receiver = point[free], receiver[free]
        return point, receiver, probability[point, receiver]

    def _weights(self, targets: Any) -> Float64Array:
        """What each point is expected to bring each receiver, in any unit; 0 on the side that is not lit;
        Shape ``[P, R]``."""
        import drjit as dr
        import mitsuba as mi

        receivers = dr.width(targets)
        per_point = dr.opaque(mi.UInt, receivers)
        lane = dr.arange(mi.UInt, len(self._all) * receivers)
        point, target = lane // per_point, lane % per_point
        towards = dr.gather(mi.Point3f, targets, target) - dr.gather(mi.Point3f, self._point, point)
        apart = dr.squared_norm(towards)
        cosine = dr.dot(mi.Vector3f(dr.gather(mi.Normal3f, self._normal, point)), towards) * dr.rsqrt(apart)
        weight = dr.select(cosine > 0.0, (cosine + _GRAZING) / (apart + _NEAR), 0.0)
        found = weight.numpy().reshape(-1, receivers)[: len(self.ray)].astype(np.float64)
        return found * self._brings[:, None]

    def _free(self, point: Int64Array, receiver: Int64Array, targets: Any) -> BoolArray:
        """Whether nothing stands between these points and receivers."""
        import drjit as dr
        import mitsuba as mi

        some = several(len(point))
        of_point, of_receiver = mi.UInt(aligned_indices(point[some])), mi.UInt(aligned_indices(receiver[some]))
        hit = dr.zeros(mi.Interaction3f, len(some))
        hit.p = dr.gather(mi.Point3f, self._point, of_point)
        hit.n = dr.gather(mi.Normal3f, self._normal, of_point)
        back = hit.spawn_ray_to(dr.gather(mi.Point3f, targets, of_receiver))
        lit = dr.dot(mi.Vector3f(hit.n), back.d) > 0.0
        free: BoolArray = (lit & ~self._thinning.mi_scene.ray_test(back, active=lit)).numpy()[: len(point)]
        return free
