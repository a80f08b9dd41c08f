"""The plane faces of a scene: those of scenery, made once, and of moving bodies, as they stand in a frame."""

from __future__ import annotations

import numpy as np

from caviar_protocol.arrays import BoolArray, Int32Array, Int64Array
from caviar_services.channel.enumeration.face_rectangles import FaceRectangles, narrowest_sides, ranges
from caviar_services.channel.sionna.planes import two_sided_planes
from caviar_services.channel.sionna.scene import SionnaScene
from caviar_services.mesh.shapes import Mesh


class SceneFaces:
    """Faces of a scene in the coordinates of its ray tracer.

    Parameters
    ----------
    scene
        Whose faces; its bodies are where `SionnaScene.place` put them last.
    inner
        Whether waves may be inside of closed bodies, so that the inner sides of their faces reflect too.
    """

    def __init__(self, scene: SionnaScene, inner: bool = False) -> None:
        self._scene = scene
        table = scene.plane_table
        first = scene.first_moving_plane
        triangles, sizes = table.triangles_of(np.arange(len(table.triangle)))
        piece = scene.piece_of(triangles)
        self._scenery = _faces_of(scene, np.arange(first), piece != scene.parking_piece)
        self._row = np.full(first, -1)
        self._row[self._scenery.plane] = np.arange(len(self._scenery))
        body_of = piece[np.cumsum(sizes) - sizes] - scene.first_body_piece
        self._body_of = body_of[first:]
        """Number of the body that each moving plane is of."""
        self._two_sided = np.ones(len(self._body_of), np.bool_)
        self._along = np.zeros(len(self._body_of), np.int64)
        """Side of each moving plane's rectangle, the first of its triangles having the sides 0 to 2."""
        for asset, mesh in scene.unit_meshes.items():
            numbers = scene.face_numbers(asset)
            both, along = two_sided_planes(mesh, numbers), _sides_of(mesh, numbers)
            for body in scene.bodies_of(asset):
                self._two_sided[self._body_of == body] = both | inner
                self._along[self._body_of == body] = along
        self._standing: tuple[int, ...] | None = None
        self._rows: tuple[Int64Array, Int64Array, Int64Array]

    def scenery(self, planes: Int64Array) -> FaceRectangles:
        """Faces of these planes of scenery, in ascending order; planes of no area are left out."""
        rows = self._row[np.unique(planes)]
        return self._scenery.take(rows[rows >= 0])

    def bodies(self) -> tuple[FaceRectangles, Int64Array]:
        """Faces of all standing bodies, body after body, and how many each of these has."""
        scene, standing = self._scene, self._scene.standing_bodies
        if standing != self._standing:
            planes = np.flatnonzero(np.isin(self._body_of, np.array(standing, np.int64)))
            self._rows = (planes, *scene.plane_table.triangles_of(planes + scene.first_moving_plane))
            self._standing = standing
        planes, triangles, sizes = self._rows
        normal = scene.plane_table.normal[planes + scene.first_moving_plane]
        flat = np.einsum("fc,fc->f", normal, normal) > 0
        if not flat.all():
            kept = np.flatnonzero(flat)
            triangles = triangles[ranges(np.cumsum(sizes)[kept] - sizes[kept], sizes[kept])[1]]
            planes, sizes, normal = planes[kept], sizes[kept], normal[kept]
        faces = FaceRectangles.of(
            planes + scene.first_moving_plane,
            scene.corners(triangles) - scene.centre,
            sizes,
            3 * (np.cumsum(sizes) - sizes) + self._along[planes],
            normal,
            self._two_sided[planes],
        )
        _, counts = np.unique(self._body_of[planes], return_counts=True)
        return faces, counts


def _faces_of(scene: SionnaScene, planes: Int64Array, used: BoolArray) -> FaceRectangles:
    """Faces of planes of scenery; ``used`` says which of all triangles, in the order of planes, count."""
    table = scene.plane_table
    triangles, sizes = table.triangles_of(planes)
    own = np.repeat(np.arange(len(planes)), sizes)
    used = used[: len(triangles)] & (table.normal[planes] != 0).any(1)[own]
    corners = scene.corners(triangles[used]) - scene.centre
    sizes = np.bincount(own[used], minlength=len(planes))
    kept = np.flatnonzero(sizes)
    # Scenery has faces of either sense, so their order of corners says nothing.
    both = np.ones(len(kept), np.bool_)
    sizes = sizes[kept]
    along = narrowest_sides(corners, sizes)
    return FaceRectangles.of(planes[kept], corners, sizes, along, table.normal[planes[kept]], both)


def _sides_of(mesh: Mesh, numbers: Int32Array) -> Int64Array:
    """`narrowest_sides` of the planes of a mesh, by number, counted from the first triangle of each."""
    order = np.argsort(numbers, kind="stable")
    sizes = np.bincount(numbers)
    return narrowest_sides(mesh.vertices[mesh.faces[order]], sizes) - 3 * (np.cumsum(sizes) - sizes)
