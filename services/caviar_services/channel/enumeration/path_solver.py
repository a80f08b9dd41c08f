"""Reflected paths among bodies that move, found without a launch in each frame.

Chains of scenery are known of the place that a transmitter stands at, and chains by way of bodies are
enumerated in each frame (`scenery_chains`, `body_chains`).

In the street canyon this finds what 3e7 rays find, in about half the time that 1e5 rays take.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from caviar_protocol.arrays import Float64Array, Int64Array
from caviar_protocol.topics import Interaction
from caviar_services.channel.enumeration.beam_ends import SceneryViews
from caviar_services.channel.enumeration.body_chains import chain_pairs
from caviar_services.channel.enumeration.face_rectangles import FaceRectangles
from caviar_services.channel.enumeration.image_paths import ImagePaths, image_paths, unhidden
from caviar_services.channel.enumeration.plane_visibility import seen_planes
from caviar_services.channel.enumeration.reflection_fields import reflection_fields
from caviar_services.channel.enumeration.scene_faces import SceneFaces
from caviar_services.channel.enumeration.scenery_chains import KnownScenery
from caviar_services.channel.sionna.candidate_visibility import Faces
from caviar_services.channel.sionna.candidates import first_of_each
from caviar_services.channel.sionna.path_buffer import Traced, nothing
from caviar_services.channel.sionna.scene import SionnaScene

_NO_SHAPE = 0xFFFFFFFF

_FEW = 64
"""Faces of scenery that each receiver is taken to see; of more, it sees those that its rays meet."""

_RAYS = 8192
"""Of a receiver, to find out: 2.2° apart."""

_NEAREST = 0.01
"""[m]; pairs nearer than this have no path between them that could be traced, as in Sionna RT."""


class EnumeratedTracer:
    """Paths of reflections, and lines of sight, of a scene as it stands.

    Parameters
    ----------
    scene
        The scene; its bodies are where they were placed last.
    depth
        Reflections of a path at most.
    most
        Paths of a receiver at most; those of more reflections are lost first.
    """

    def __init__(self, scene: SionnaScene, depth: int, most: int) -> None:
        self._scene = scene
        self._depth, self._most = depth, most
        self._faces = SceneFaces(scene)
        self._look = Faces(scene)
        self._bodies: tuple[int, FaceRectangles, Int64Array] | None = None

    def trace(self, transmitter: Float64Array, receivers: Float64Array, scenery: KnownScenery) -> Traced:
        """Paths from one transmitter [3] to all receivers [R, 3], positions in metres in the world.

        ``scenery`` is what is known of it from there.
        """
        scene = self._scene
        if not len(receivers):
            return nothing(len(scene.wavelengths), self._depth, 0)
        start, ends = transmitter - scene.centre, receivers - scene.centre
        of_bodies, sizes = self._standing()
        planes, sights = scenery.chains.astype(np.int64), scenery.sights.astype(np.int64)
        of_scenery = self._faces.scenery(planes[planes >= 0])
        faces = of_scenery.and_those(of_bodies)
        planes = planes[(np.isin(planes, of_scenery.plane) | (planes < 0)).all(1)]
        chains = np.where(planes >= 0, np.searchsorted(of_scenery.plane, planes), -1)
        views = self._views(of_scenery, sights, ends)
        pairs = chain_pairs(faces, sizes, chains, views, start, ends)
        paths = self._once(faces, image_paths(faces, pairs, start, ends))
        paths = paths.take(unhidden(scene, self._look, faces, paths, start, ends))
        near = ((ends - start) ** 2).sum(1) <= _NEAREST**2
        paths = paths.take(~near[paths.receiver])
        kept = first_of_each(paths.receiver, self._most)
        traced = self._traced(faces, paths.take(kept), start, ends)
        return replace(traced, lost=len(kept) - int(kept.sum()))

    def _once(self, faces: FaceRectangles, paths: ImagePaths) -> ImagePaths:
        """Paths by way of faces that are one surface, each by way of the first of these."""
        joined = self._scene.joined
        if not joined.groups:
            return paths
        used = paths.chain >= 0
        surfaces = np.where(used, joined.label[faces.plane[paths.chain]], -1)
        keys = np.column_stack([paths.receiver, surfaces])
        return paths.take(np.sort(np.unique(keys, axis=0, return_index=True)[1]))

    def _views(self, scenery: FaceRectangles, sights: Int64Array, receivers: Float64Array) -> SceneryViews:
        """Which faces of scenery may come last: all of a few, those that receivers see of many."""
        pairs = np.searchsorted(scenery.plane, sights[np.isin(sights, scenery.plane).all(1)])
        if len(scenery) <= _FEW:
            seen = np.ones((len(receivers), len(scenery)), np.bool_)
        else:
            seen = seen_planes(self._look, receivers, scenery.plane, _RAYS)
        receiver, place = np.nonzero(seen)
        return SceneryViews(np.arange(len(scenery)), pairs, receiver, place)

    def _standing(self) -> tuple[FaceRectangles, Int64Array]:
        """Faces of bodies, which are the same for all transmitters of a frame."""
        version = self._scene.version
        if self._bodies is None or self._bodies[0] != version:
            self._bodies = (version, *self._faces.bodies())
        return self._bodies[1:]

    def _traced(
        self, faces: FaceRectangles, paths: ImagePaths, start: Float64Array, ends: Float64Array
    ) -> Traced:
        scene = self._scene
        used = paths.chain >= 0
        count, end = used.sum(1), ends[paths.receiver]
        shapes = np.full(used.shape, _NO_SHAPE, np.int64)
        primitives = np.full(used.shape, _NO_SHAPE, np.int64)
        normals = np.zeros((*used.shape, 3))
        if used.any():
            plane = faces.plane[paths.chain[used]]
            triangles = scene.plane_table.first_holding(scene.plane_table.triangle[plane], paths.points[used])
            shapes[used], primitives[used] = scene.shapes_of(triangles)
            normals[used] = faces.normal[paths.chain[used]]
        corners = np.concatenate(
            [np.broadcast_to(start, (len(count), 1, 3)), paths.points, end[:, None]], axis=1
        )
        media = scene.media(shapes)
        rest = ((0, 0), (0, self._depth - used.shape[1]))
        shapes, primitives = (
            np.pad(column, rest, constant_values=_NO_SHAPE) for column in (shapes, primitives)
        )
        types = np.pad(np.where(used, Interaction.REFLECTION, 0).astype(np.uint8), rest)
        points = np.pad(np.where(used[..., None], paths.points + scene.centre, 0.0), (*rest, (0, 0)))
        return Traced(
            receiver=paths.receiver,
            transfer=reflection_fields(corners, count, normals, media, scene.wavelengths),
            types=types,
            shapes=shapes,
            primitives=primitives,
            points=points,
            edge=np.full(len(count), -1),
            hidden=np.zeros(len(count), np.bool_),
            settled=np.zeros(len(count), np.bool_),
            lost=0,
        )


def unknown_paths(launched: Traced, enumerated: Traced, scene: SionnaScene) -> Traced:
    """Of launched paths, those that are none of the enumerated ones: of another kind, or by other planes."""
    keys = np.concatenate([_keys(enumerated, scene), _keys(launched, scene)])
    _, first = np.unique(keys, axis=0, return_index=True)
    new = np.zeros(len(keys), np.bool_)
    new[first] = True
    other = ((launched.types != 0) & (launched.types != Interaction.REFLECTION)).any(1)
    return launched.take(new[len(enumerated.types) :] | other)


def _keys(traced: Traced, scene: SionnaScene) -> Int64Array:
    """Receiver, and surface of each reflection, of paths."""
    planes = scene.surface_of[scene.triangle_numbers(traced.shapes, traced.primitives)]
    used = traced.types != 0
    return np.column_stack([traced.receiver, np.where(used, planes, -1)])
