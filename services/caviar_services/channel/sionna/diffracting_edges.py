"""The edges of a scene in the ray tracer: where they are in a frame, and how rays meet them.

Sionna RT looks for edges within the mesh that a ray has hit, by vertices that faces of this mesh share. Here
they are those of `mesh_edges`: of scenery as one surface, whose meshes may share none, and of each body.

With a range (`EdgeRange`), edges out of it cost nothing: where none is in range, rays are launched without
diffraction.
"""

from __future__ import annotations

from collections.abc import Mapping
from operator import itemgetter
from typing import Any

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int32Array, Int64Array
from caviar_protocol.topics import Interaction
from caviar_services.channel.paths import PathTable
from caviar_services.channel.propagation.utd import Wedges, wedges_of
from caviar_services.channel.sionna.mesh_edges import MeshEdges, mesh_edges
from caviar_services.channel.sionna.triangle_numbering import NumberedTriangles
from caviar_services.drjit_setup import aligned_columns, aligned_indices
from caviar_space.meshes import Mesh

# [m]; corners of scenery that are nearer to each other are one.
_SAME_PLACE = 1e-3

# The same for bodies, as a part of their extent.
_SAME_IN_BODY = 1e-6

# Part of the rays that are diffracted where they could be; Sionna RT's is 0.2, so that most are left for
# reflections, for which there are other rays here.
_DIFFRACTED = 0.5

# [m] by which edges are longer for the ray tracer: what runs over their very ends is decided in float64.
_BEYOND = 2e-3


class SceneEdges:
    """All edges of a scene: first those of scenery, then those of each body.

    Args:
        scene: Whose edges.
        bodies: Unit meshes of the bodies, by asset.
        free: Whether the rims of open surfaces are edges.
    """

    def __init__(self, scene: NumberedTriangles, bodies: Mapping[str, Mesh], free: bool) -> None:
        self._scene = scene
        self._edges = _of_all_pieces(scene, bodies, free)
        owner = scene.piece_of(self._edges.triangles[:, 0])
        self.number: Int32Array = (np.arange(len(self)) - np.searchsorted(owner, owner)).astype(np.int32)
        """Of each edge within the object that its first face is of, the same in every frame."""
        self._moving = int(np.searchsorted(owner, scene.first_body_piece))
        self._piece = owner[self._moving :]
        self._on_device: tuple[int, DeviceEdges] | None = None

    def __len__(self) -> int:
        return len(self._edges)

    @property
    def triangles(self) -> Int64Array:
        """A triangle of each face of each edge, Shape ``[E, 2]``."""
        return self._edges.triangles

    @property
    def all_ends(self) -> Float64Array:
        """`ends` of all edges, Shape ``[E, 2, 3]``; those of bodies that stand for nothing have no length."""
        return self._scene.vertices[self._edges.ends]

    @property
    def of_bodies(self) -> tuple[Int64Array, Int64Array]:
        """Numbers of the edges of bodies, in ascending order, and of the piece that each is of."""
        edges = np.arange(self._moving, len(self))
        return edges, self._piece

    def ends(self, edges: Int64Array) -> Float64Array:
        """Both ends of edges as they stand [m], Shape ``[N, 2, 3]``; 0 for −1.

        Args:
            edges: Numbers, Shape ``[N]``.
        """
        return self._corners(self._edges.ends, edges)

    def faces(self, edges: Int64Array) -> tuple[Wedges, BoolArray]:
        """Faces of edges as they stand, and which edges have any: those of bodies that stand for nothing
        have none.

        Args:
            edges: Numbers, Shape ``[N]``.
        """
        return wedges_of(self.ends(edges), self._corners(self._edges.apexes, edges))

    def outward(self, edges: Int64Array) -> Float64Array:
        """Unit vectors between the normals of both faces, Shape ``[N, 3]``; 0 at free edges and for −1.

        Args:
            edges: Numbers, Shape ``[N]``.
        """
        outward, some = np.zeros((len(edges), 3)), np.flatnonzero(edges >= 0)
        between = self.faces(edges[some])[0].normals.sum(1)
        length = np.sqrt((between**2).sum(-1, keepdims=True))
        free = self._edges.is_free[edges[some], None]
        outward[some] = np.where(free, 0.0, between / np.where(length > 0, length, 1.0))
        return outward

    def _corners(self, vertices: Int64Array, edges: Int64Array) -> Float64Array:
        found, some = np.zeros((len(edges), 2, 3)), edges >= 0
        found[some] = self._scene.vertices[vertices[edges[some]]]
        return found

    @property
    def on_device(self) -> DeviceEdges:
        """The edges as they stand, in the ray tracer's arrays."""
        version = self._scene.version
        if self._on_device is None:
            made = DeviceEdges(self._edges, self._rows(0), self._scene)
        elif self._on_device[0] != version:
            made = self._on_device[1]
            # Edges of scenery stand, and stay as they were uploaded.
            made.move(self._moving, self._rows(self._moving))
        else:
            return self._on_device[1]
        self._on_device = version, made
        return made

    def _rows(self, first: int) -> Float64Array:
        """Origin, direction, length and both normals of edges from this one on, Shape ``[13, N]``; 0 where
        an edge has no faces."""
        edges = np.arange(first, len(self))
        faces, is_edge = self.faces(edges)
        ends = self.ends(edges) - self._scene.centre
        along = ((ends[:, 1] - ends[:, 0]) * faces.edge).sum(1, keepdims=True)
        origin = np.where(along < 0, ends[:, 1], ends[:, 0]) - _BEYOND * faces.edge
        normals = np.moveaxis(faces.normals, 1, 0)
        columns = np.concatenate([origin, faces.edge, np.abs(along) + 2 * _BEYOND, *normals], axis=1)
        return np.where(is_edge, columns.T, 0.0)


def _of_all_pieces(scene: NumberedTriangles, bodies: Mapping[str, Mesh], free: bool) -> MeshEdges:
    piece = scene.piece_of(np.arange(len(scene.triangle_vertices)))
    still = np.flatnonzero(piece < scene.first_body_piece)
    of_scenery = mesh_edges(
        scene.vertices,
        scene.triangle_vertices[still].astype(np.int64),
        scene.part_of[still],
        _SAME_PLACE,
        free,
    )
    of_bodies: list[tuple[int, MeshEdges]] = []
    for asset, mesh in bodies.items():
        tolerance = _SAME_IN_BODY * float(np.ptp(mesh.vertices, axis=0).max(initial=0.0))
        numbers = scene.face_numbers(asset).astype(np.int64)
        of_body = mesh_edges(mesh.vertices, mesh.faces.astype(np.int64), numbers, tolerance, free)
        of_bodies += [
            (body, of_body.shifted(*scene.begin_of(scene.first_body_piece + body)))
            for body in scene.bodies_of(asset).tolist()
        ]
    of_bodies.sort(key=itemgetter(0))
    parts = [of_scenery.renumbered(still), *(edges for _, edges in of_bodies)]
    return MeshEdges.joined(parts)


class DeviceEdges:
    """Edges in the ray tracer's arrays; `number` of them is in `WedgeGeometry.local_edge`.

    Args:
        edges: Whose triangles are numbered through all shapes.
        rows: See `SceneEdges`.
        scene: Of the triangles.
    """

    def __init__(self, edges: MeshEdges, rows: Float64Array, scene: NumberedTriangles) -> None:
        import mitsuba as mi

        triangle, edge = edges.sides
        bounds = np.searchsorted(triangle, np.arange(len(scene.triangle_vertices) + 1))
        self._shape = mi.UInt(aligned_indices(scene.offset_by_shape))
        self._first, self._count = (mi.UInt(aligned_indices(c)) for c in (bounds[:-1], np.diff(bounds)))
        self._edge = mi.UInt(aligned_indices(edge))
        self._triangles = [mi.UInt(aligned_indices(column)) for column in edges.triangles.T]
        shapes, _ = scene.shapes_of(edges.triangles)
        self._one_shape = mi.UInt(aligned_indices(shapes[:, 0] == shapes[:, 1]))
        self._rows = rows
        self._take_rows()

    def move(self, first: int, rows: Float64Array) -> None:
        """Put the edges from one on elsewhere.

        Args:
            first: Number of that edge.
            rows: As for the class, of these edges.
        """
        self._rows[:, first:] = rows
        self._take_rows()

    def _take_rows(self) -> None:
        import mitsuba as mi

        columns = [mi.Float(column) for column in aligned_columns(self._rows)]
        self._origin, self._along = mi.Point3f(*columns[:3]), mi.Vector3f(*columns[3:6])
        self._length = columns[6]
        self._normals = mi.Normal3f(*columns[7:10]), mi.Normal3f(*columns[10:])

    def drawn(self, hit: Any, came_from: Any, sample: Any, active: Any) -> tuple[Any, Any, Any]:
        """One of the edges of the triangles that rays hit, where rays came from outside of its wedge.

        Args:
            hit: `mitsuba.SurfaceInteraction3f`.
            came_from: `mitsuba.Point3f` [m].
            sample: `mitsuba.Float` from 0 to 1, to draw by.
            active: `mitsuba.Bool`.

        Returns:

        Whether there is one; the ray tracer's `WedgeGeometry`, its first face that which is lit more
        steeply; and its point nearest to where the ray hit.
        """
        import drjit as dr
        import mitsuba as mi
        from sionna.rt.constants import EPSILON_FLOAT
        from sionna.rt.utils import WedgeGeometry

        shape = dr.gather(mi.UInt, self._shape, mi.UInt(dr.reinterpret_array(mi.UInt, hit.shape)), active)
        count = dr.gather(mi.UInt, self._count, shape + hit.prim_index, active)
        active &= count > 0
        place = dr.minimum(mi.UInt(sample * mi.Float(count)), dr.maximum(count, 1) - 1)
        place += dr.gather(mi.UInt, self._first, shape + hit.prim_index, active)
        number = dr.gather(mi.UInt, self._edge, place, active)
        origin = dr.gather(mi.Point3f, self._origin, number, active)
        along = dr.gather(mi.Vector3f, self._along, number, active)
        length = dr.gather(mi.Float, self._length, number, active)
        one, other = (dr.gather(mi.Normal3f, normal, number, active) for normal in self._normals)
        point = origin + dr.clip(dr.dot(hit.p - origin, along), 0.0, length) * along
        back = came_from - point
        active &= length > 0.0
        active &= (dr.dot(back, one) > EPSILON_FLOAT) | (dr.dot(back, other) > EPSILON_FLOAT)
        offset = [dr.gather(mi.UInt, face, number, active) - shape for face in self._triangles]
        wedge = WedgeGeometry(mi.MeshPtr(hit.shape), *offset, number, origin, along, length, one, other)
        wedge.swap_faces(dr.dot(back, other) > dr.dot(back, one))
        # Where the shape that was hit has but one of both faces: the triangle that was hit, and another. The
        # ray tracer takes two triangles that are one for a free edge.
        apart = dr.gather(mi.UInt, self._one_shape, number, active) == 0
        wedge.prim0 = dr.select(apart, hit.prim_index, wedge.prim0)
        wedge.primn = dr.select(apart, hit.prim_index + 1, wedge.primn)
        return active, wedge, point


def edge_generator(edges: SceneEdges) -> Any:
    """Make a `SBCandidateGenerator` of Sionna RT whose rays are diffracted at these edges.

    Args:
        edges: Of the scene.
    """
    import drjit as dr
    from sionna.rt.constants import InteractionType
    from sionna.rt.path_solvers.sb_candidate_generator import SBCandidateGenerator

    class EdgeGenerator(SBCandidateGenerator):  # type: ignore[misc]
        def _sample_diffraction_point(
            self,
            si: Any,
            loc_en_inter: Any,
            ray_origin: Any,
            ki_world: Any,
            sample2: Any,
            edge_diffraction: bool,
            active: Any,
        ) -> tuple[Any, Any, Any, Any]:
            found, wedge, point = edges.on_device.drawn(si, ray_origin, sample2.x, active)
            only = loc_en_inter == InteractionType.DIFFRACTION
            part = dr.select(only, 1.0, _DIFFRACTED)
            diffracted = found & (sample2.y < part)
            probability = dr.select(found, dr.select(diffracted, part, 1.0 - part), 1.0)
            return diffracted, probability, point, wedge

    return EdgeGenerator()


class EdgeRange:
    """Which edges of a scene, as it stands, are within a distance of one end of a path at least.

    Args:
        edges: Of the scene; None: it has none.
        within_m: How far they may be.
    """

    def __init__(self, edges: SceneEdges | None, within_m: float) -> None:
        self._edges, self._within = edges, within_m

    def reaches(self, places: Float64Array) -> bool:
        """Whether any edge is in range of any of these places.

        Args:
            places: [m], Shape ``[N, 3]``.
        """
        if self._edges is None:
            return False
        edges = self._edges.all_ends
        begin, along = edges[:, 0], edges[:, 1] - edges[:, 0]
        square = (along**2).sum(-1)
        begin, along, square = begin[square > 0], along[square > 0], square[square > 0]
        for place in places:
            share = np.clip(((place - begin) * along).sum(-1) / square, 0.0, 1.0)
            nearest = begin + share[:, None] * along - place
            if ((nearest**2).sum(-1) <= self._within**2).any():
                return True
        return False

    def within(self, table: PathTable, start: Float64Array, end: Float64Array) -> BoolArray:
        """Which paths have no edge out of range of both ends, Shape ``[P]``.

        Args:
            table: The paths.
            start, end: Their ends [m], Shape ``[P, 3]``.
        """
        bent = table.types == Interaction.DIFFRACTION
        near = np.zeros(bent.shape, np.bool_)
        for place in (start, end):
            near |= ((table.points - place[:, None]) ** 2).sum(-1) <= self._within**2
        kept: BoolArray = (near | ~bent).all(1)
        return kept
