"""The path solver of enumerated candidates: paths among moving bodies without a launch in each frame.

Chains of scenery are known for the place that a transmitter stands at (`scenery_chains`). Chains by way of
bodies are enumerated in each frame (`image_beams`), those over an edge likewise (`edge_beams`). The image
method decides which are paths (`image_paths`), transmitted ones among them.

In the street canyon this finds the reflections that 3e7 rays find, in a quarter of the time of 1e5 rays.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array, UInt8Array
from caviar_protocol.topics import Interaction
from caviar_services.channel.enumeration.edge_beams import EdgeTargets, edge_chains, enumerated_scenery
from caviar_services.channel.enumeration.image_beams import SceneryViews, Targets, chain_pairs
from caviar_services.channel.enumeration.image_paths import (
    ImagePaths,
    crossings,
    edge_paths,
    image_paths,
    unhidden,
)
from caviar_services.channel.enumeration.obstacle_trees import ObstacleTrees
from caviar_services.channel.enumeration.scenery_chains import KnownScenery, SceneFaces, seen_planes
from caviar_services.channel.propagation.utd import reflection_fields
from caviar_services.channel.sionna.candidates import Faces, Met, bends_of, first_of_each
from caviar_services.channel.sionna.diffracting_edges import SceneEdges
from caviar_services.channel.sionna.path_table import Traced, joined, nothing
from caviar_services.channel.sionna.ray_launcher import LaunchOptions
from caviar_services.channel.sionna.scene import SionnaScene
from caviar_space.rectangles import FaceRectangles
from caviar_space.vectors import equal_rows

_NO_SHAPE = 0xFFFFFFFF

# With so many faces of scenery at most, every receiver is taken to see each; with more, those its rays meet.
_FEW = 64

# Rays of a receiver that tell which faces it sees: 2.2° apart.
_RAYS = 8192

# [m]; nearer pairs have no path: Sionna RT drops segments below 1 cm, too.
_NEAREST = 0.01


class EnumeratedTracer:
    """Finds the paths of a scene as it stands: lines of sight and reflections; with refraction also paths
    through obstacles, with diffraction also paths over one edge of a body (`edge_beams` says which).

    Args:
        scene: The scene; its bodies are where they were placed last.
        options: Effects, interactions of a path at most, and paths of each kind that a receiver has at most;
            paths of more interactions are lost first.
    """

    def __init__(self, scene: SionnaScene, options: LaunchOptions) -> None:
        self._scene = scene
        self._options = options
        self._depth = options.max_depth
        self._edges = scene.edges if options.diffraction else None
        self._faces = SceneFaces(scene, inner=options.refraction)
        self._look = Faces(scene, still=True)
        self._bodies: tuple[int, FaceRectangles, Int64Array] | None = None
        # Of transmitters that stand, it is the same in each frame.
        self._known: WeakKeyDictionary[KnownScenery, tuple[FaceRectangles, Int64Array, Int64Array]]
        self._known = WeakKeyDictionary()

    @cached_property
    def _obstacles(self) -> ObstacleTrees:
        return ObstacleTrees(self._scene)

    def trace(
        self,
        transmitter: Float64Array,
        receivers: Float64Array,
        scenery: KnownScenery,
        over_edges: bool = True,
    ) -> Traced:
        """Paths from one transmitter to all receivers.

        Args:
            transmitter: Position in the world [m], Shape ``[3]``.
            receivers: Positions in the world [m], Shape ``[R, 3]``.
            scenery: Chains of scenery that are known from the transmitter.
            over_edges: Whether diffracted paths are wanted, too.

        Returns:
            The paths; diffracted ones have no fields yet: `path_table` computes those of all launches at
            once.
        """
        scene = self._scene
        if not len(receivers):
            return nothing(len(scene.wavelengths), self._depth, 0)
        # The ray tracer's coordinates are relative to the middle of the scene: float32 has 7 digits.
        start, ends = transmitter - scene.centre, receivers - scene.centre
        # Faces of bodies are made once for all transmitters of a frame.
        if self._bodies is None or self._bodies[0] != scene.version:
            self._bodies = (scene.version, *self._faces.bodies())
        _, of_bodies, sizes = self._bodies
        if scenery not in self._known:
            self._known[scenery] = self._numbered(scenery)
        of_scenery, chains, sights = self._known[scenery]
        faces = FaceRectangles.joined([of_scenery, of_bodies])
        views = self._views(of_scenery, ends)
        targets = Targets(faces, sizes, sights)
        pairs = chain_pairs(targets, chains, views, start, ends)
        paths = self._once(faces, image_paths(targets, pairs, start, ends))
        near = ((ends - start) ** 2).sum(1) <= _NEAREST**2
        paths = paths.take(~near[paths.receiver])
        free = unhidden(scene, self._obstacles, faces, paths, start, ends)
        seen = paths.take(free)
        mirrors = self._mirrors(faces, seen.chain, seen.points)
        found = [self._traced(seen.receiver, *mirrors, seen.points, start, ends)]
        if self._options.refraction:
            found.append(self._transmitted(faces, paths.take(~free), start, ends))
        if self._edges is not None and over_edges:
            edges = EdgeTargets(scene, self._edges, faces)
            candidates = edge_chains(targets, edges, chains, views, start, ends)
            bent = edge_paths(targets, edges, candidates, start, ends, self._depth)
            bent = bent.take(~near[bent.receiver])
            bent = bent.take(unhidden(scene, self._obstacles, faces, bent, start, ends, edges))
            types, triangles, _ = self._mirrors(faces, bent.chain, bent.points)
            rows, edge = np.arange(len(bent.edge)), edges.number[bent.edge]
            types[rows, bent.bend] = Interaction.DIFFRACTION
            triangles[rows, bent.bend] = self._edges.triangles[edge, 0]
            traced = self._traced(bent.receiver, types, triangles, None, bent.points, start, ends)
            found.append(replace(traced, edge=edge))
        parts = []
        for traced in found:
            kept = first_of_each(traced.receiver, self._options.max_paths)
            parts.append(replace(traced.take(kept), lost=len(kept) - int(kept.sum())))
        return joined(parts, len(scene.wavelengths), self._depth)

    def compile_kernels(self) -> None:
        """Have the ray tracer's kernel compiled that tells which scenery receivers see, if there is much."""
        if self._scene.first_moving_plane > _FEW:
            seen_planes(self._look, np.zeros((2, 3)), np.arange(1), rays=4)

    def _numbered(self, scenery: KnownScenery) -> tuple[FaceRectangles, Int64Array, Int64Array]:
        """Faces of scenery, and its chains and sights as numbers of these."""
        planes, sights = scenery.chains.astype(np.int64), scenery.sights.astype(np.int64)
        faces = self._faces.scenery(planes[planes >= 0])
        # A chain by way of a plane without area has no face to be mirrored in.
        planes = planes[(np.isin(planes, faces.plane) | (planes < 0)).all(1)]
        chains = np.where(planes >= 0, np.searchsorted(faces.plane, planes), -1)
        return faces, chains, np.searchsorted(faces.plane, sights[np.isin(sights, faces.plane).all(1)])

    def _once(self, faces: FaceRectangles, paths: ImagePaths) -> ImagePaths:
        """Paths of which no earlier one runs by way of the same surfaces: coplanar faces that touch are
        one."""
        joined = self._scene.joined
        if not joined.groups:
            return paths
        used = paths.chain >= 0
        surfaces = np.where(used, joined.label[faces.plane[paths.chain]], -1)
        keys = np.column_stack([paths.receiver, surfaces])
        return paths.take(equal_rows(keys)[0])

    def _views(self, scenery: FaceRectangles, receivers: Float64Array) -> SceneryViews:
        """Faces of scenery that may reflect last before each receiver."""
        if len(scenery) <= _FEW:
            seen = np.ones((len(receivers), len(scenery)), np.bool_)
        else:
            seen = seen_planes(self._look, receivers, scenery.plane, _RAYS)
        return SceneryViews(*np.nonzero(seen))

    def _transmitted(
        self, faces: FaceRectangles, paths: ImagePaths, start: Float64Array, ends: Float64Array
    ) -> Traced:
        """Hidden paths that go through their obstacles."""
        count = (paths.chain >= 0).sum(1)
        found, through = crossings(
            self._scene, self._obstacles, faces, paths, start, ends, self._depth - count
        )
        number = np.cumsum(through) - 1
        paths, count, crossing = paths.take(through), count[through], number[found.path]
        # Transmissions stand between the reflections: each moves what follows by one place.
        crossed = np.zeros((len(count), paths.chain.shape[1] + 1), np.int64)
        np.add.at(crossed, (crossing, found.segment), 1)
        before = np.cumsum(crossed, axis=1)
        rank = np.arange(len(crossing)) - np.searchsorted(crossing, crossing)
        at = crossing, rank + found.segment
        path, d = np.nonzero(paths.chain >= 0)
        mirrors = path, d + before[path, d]
        end = ends[paths.receiver]
        shape = len(count), self._depth
        types, triangles = np.zeros(shape, np.uint8), np.full(shape, -1)
        normals, points = np.zeros((*shape, 3)), np.repeat(end[:, None], self._depth, axis=1)
        _, of_faces, their_normals = self._mirrors(faces, paths.chain, paths.points)
        types[mirrors], types[at] = Interaction.REFLECTION, Interaction.TRANSMISSION
        triangles[mirrors], triangles[at] = of_faces[path, d], found.triangle
        points[mirrors], points[at] = paths.points[path, d], found.points
        normals[mirrors] = their_normals[path, d]
        normals[at] = self._scene.plane_table.normal[self._scene.plane_of[found.triangle]]
        return self._traced(paths.receiver, types, triangles, normals, points, start, ends)

    def _mirrors(
        self, faces: FaceRectangles, chain: Int64Array, points: Float64Array
    ) -> tuple[UInt8Array, Int64Array, Float64Array]:
        """Interactions at points of chains, triangles that reflect there, −1 past the last, and unit
        normals."""
        used, table = chain >= 0, self._scene.plane_table
        triangles, normals = np.full(chain.shape, -1), np.zeros((*chain.shape, 3))
        if used.any():
            plane = faces.plane[chain[used]]
            triangles[used] = table.first_holding(table.triangle[plane], points[used])
            normals[used] = faces.normal[chain[used]]
        return np.where(used, Interaction.REFLECTION, 0).astype(np.uint8), triangles, normals

    def _traced(
        self,
        receiver: Int64Array,
        types: UInt8Array,
        triangles: Int64Array,
        normals: Float64Array | None,
        points: Float64Array,
        start: Float64Array,
        ends: Float64Array,
    ) -> Traced:
        """Paths of these interactions; fields are computed where normals are given, and 0 where they are
        None."""
        scene, width = self._scene, types.shape[1]
        used = types != 0
        count = used.sum(1)
        shape = len(count), self._depth
        shapes, primitives = (np.full(shape, _NO_SHAPE, np.int64) for _ in range(2))
        at = np.nonzero(used)
        shapes[at], primitives[at] = scene.shapes_of(triangles[at])
        transfer = np.zeros((len(scene.wavelengths), len(count), 3, 3), np.complex128)
        if normals is not None:
            through = types == Interaction.TRANSMISSION
            corners = np.concatenate(
                [np.broadcast_to(start, (len(count), 1, 3)), points, ends[receiver][:, None]], axis=1
            )
            media = scene.media(shapes[:, :width])
            transfer = reflection_fields(corners, count, normals, through, media, scene.wavelengths)
        kinds, places = np.zeros(shape, np.uint8), np.zeros((*shape, 3))
        kinds[at], places[at] = types[at], points[at] + scene.centre
        return Traced(
            receiver=receiver,
            transfer=transfer,
            types=kinds,
            shapes=shapes,
            primitives=primitives,
            points=places,
            edge=np.full(len(count), -1),
            hidden=np.zeros(len(count), np.bool_),
            settled=np.zeros(len(count), np.bool_),
            lost=0,
        )

    def unknown(
        self, launched: Traced, enumerated: Traced, scenery: KnownScenery, over_edges: bool = True
    ) -> Traced:
        """Launched paths that enumeration leaves to rays.

        These are paths of kinds that are not enumerated, and reflections by way of planes that enumeration
        has not found. Of a kind whose paths are all enumerated, a path that only rays find does not exist.

        Args:
            launched: Paths of one transmitter as rays found them.
            enumerated: Paths of that transmitter as `trace` found them.
            scenery: As given to `trace`; ``over_edges`` likewise.
            over_edges: See ``scenery``.
        """
        scene = self._scene
        # A reflection that both have found is the enumerated one: of equal rows, `unique` keeps the first.
        surfaces = _surfaces(launched, scene)
        keys = np.concatenate(
            [
                np.column_stack([part.receiver, of])
                for part, of in ((enumerated, _surfaces(enumerated, scene)), (launched, surfaces))
            ]
        )
        only = np.concatenate([_only_reflected(part) for part in (enumerated, launched)])
        first, _ = equal_rows(np.column_stack([only, keys]))
        new = np.zeros(len(keys), np.bool_)
        new[first] = True
        wanted = np.where(_only_reflected(launched), new[len(enumerated.types) :], True)
        known = np.zeros(len(wanted), np.bool_)
        chains = scenery.chains.astype(np.int64)
        if self._options.refraction:
            known |= self._is_known_through(launched.types, surfaces, chains)
        if self._edges is not None and over_edges:
            known |= self._is_known_bent(
                self._edges, launched.types, launched.edge, surfaces, chains.shape[1]
            )
        known &= self._has_faces(launched.types, surfaces, chains)
        return launched.take(wanted & (launched.hidden | ~known))

    def known_bends(self, met: Met, scenery: KnownScenery) -> BoolArray:
        """Mask of launched chains over an edge whose paths `trace` finds, Shape ``[C]``.

        Args:
            met: Of a launch.
            scenery: As given to `trace`.
        """
        planes = met.chains.planes.astype(np.int64)
        if self._edges is None or self._options.refraction:
            return np.zeros(len(planes), np.bool_)
        types, edge = bends_of(met)
        known = self._is_known_bent(self._edges, types, edge, planes, scenery.chains.shape[1])
        return known & self._has_faces(types, planes, scenery.chains.astype(np.int64))

    def _has_faces(self, types: UInt8Array, surfaces: Int64Array, chains: Int64Array) -> BoolArray:
        """Mask of paths whose reflections are at bodies, and at scenery of known chains."""
        by_body = surfaces >= self._scene.first_moving_plane
        at_face = types == Interaction.REFLECTION
        known: BoolArray = (~at_face | by_body | np.isin(surfaces, chains)).all(1)
        return known

    def _is_known_through(self, types: UInt8Array, surfaces: Int64Array, chains: Int64Array) -> BoolArray:
        """Mask of paths that are transmitted, and reflected only by enumerated chains: by way of bodies,
        known chains of scenery, or none."""
        through, mirrors = types == Interaction.TRANSMISSION, types == Interaction.REFLECTION
        kind = through.any(1) & (through | mirrors | (types == 0)).all(1)
        kind &= mirrors.sum(1) <= chains.shape[1]
        # Transmissions do not bend a path: its chain is that of its reflections.
        order = np.argsort(~mirrors, axis=1, kind="stable")
        chain = np.where(np.take_along_axis(mirrors, order, 1), np.take_along_axis(surfaces, order, 1), -1)
        by_body = (chain >= self._scene.first_moving_plane).any(1)
        chain = chain[:, : chains.shape[1]]
        straight = np.full((1, chains.shape[1]), -1)
        _, of = equal_rows(np.concatenate([straight, chains, chain]))
        known: BoolArray = kind & (by_body | (of[1 + len(chains) :] <= of[: 1 + len(chains)].max()))
        return known

    def _is_known_bent(
        self, edges: SceneEdges, types: UInt8Array, edge: Int64Array, surfaces: Int64Array, depth: int
    ) -> BoolArray:
        """Mask of paths over an edge with reflections that `edge_beams` enumerates."""
        bent, mirrors = (types == kind for kind in (Interaction.DIFFRACTION, Interaction.REFLECTION))
        used = types != 0
        of_scenery = surfaces < self._scene.first_moving_plane
        # Edges of bodies stand after those of scenery.
        of_body = edge >= len(edges) - len(edges.of_bodies[0])
        if enumerated_scenery(edges):
            of_body |= (edge >= 0) & (mirrors & ~of_scenery).any(1)
        known: BoolArray = of_body & (bent | mirrors | ~used).all(1) & (used.sum(1) <= depth)
        after = np.cumsum(bent, axis=1) > 0
        for side in (mirrors & ~after, mirrors & after):
            known &= (side.sum(1) <= 2) | (of_scenery | ~side).all(1)
        return known


def _only_reflected(traced: Traced) -> BoolArray:
    """Mask of paths that have no other interaction than reflections."""
    only: BoolArray = ((traced.types == 0) | (traced.types == Interaction.REFLECTION)).all(1)
    return only


def _surfaces(traced: Traced, scene: SionnaScene) -> Int64Array:
    """Surface of each interaction of paths, −1 past the last."""
    surfaces = scene.surface_of[scene.triangle_numbers(traced.shapes, traced.primitives)]
    return np.where(traced.types != 0, surfaces, -1)
