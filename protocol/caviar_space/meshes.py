"""Meshes of moving objects, and the pool of bodies that stand for them in a ray tracer.

An object's mesh is a *unit* mesh: its bounding box is −½…½ on every axis, x forward, z up. It is scaled by
the object's dimensions, turned and moved. Shapes are low-poly and closed, on purpose: at the distances of a
street a ray tracer sees the large faces of a vehicle (flanks, roof, windscreen), and every face costs time
in every frame.

Ray tracers rebuild little when vertices change and much when bodies come or go, so the channel keeps a pool
of bodies, and shrinks those that stand for no object to a point. Sensors need nothing of a body but its
triangles, and hold those of the frame alone.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from caviar_protocol.arrays import Float64Array, Int32Array
from caviar_protocol.assets import check_unit_box, is_mesh_name
from caviar_protocol.errors import PayloadError
from caviar_protocol.space.coordinates import Pose, rotation_matrix
from caviar_protocol.space.ply import read_ply
from caviar_protocol.topics import Scene


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles of a surface.

    Args:
        vertices: [m], Shape ``[V, 3]``.
        faces: Vertices of each triangle, Shape ``[F, 3]``; outward normals by the right-hand rule.
    """

    vertices: Float64Array
    faces: Int32Array


def placed(mesh: Mesh, dimensions: Float64Array, pose: Pose) -> Float64Array:
    """Scale, turn and move a unit mesh.

    Args:
        mesh: Its box is −½…½ on every axis.
        dimensions: Length, width and height of the object [m], Shape ``[3]``.
        pose: Of the object in the world.

    Returns:
        World vertices [m], Shape ``[V, 3]``.

    Example:
        >>> pose = Pose((10.0, 0.0, 0.75), (1.0, 0.0, 0.0, 0.0))
        >>> placed(unit_box(), np.array([4.0, 2.0, 1.5]), pose).max(0)
        array([12. ,  1. ,  1.5])
    """
    world: Float64Array = (mesh.vertices * dimensions) @ rotation_matrix(pose.orientation).T + np.array(
        pose.position
    )
    return world


def placed_objects(units: Sequence[Mesh], scene: Scene, rows: Sequence[int]) -> list[Float64Array]:
    """`placed` for many objects of a scene.

    Args:
        units: Unit mesh of each.
        scene: The scene of a frame.
        rows: Their indices in it.

    Returns:
        World vertices of each [m], Shape ``[V, 3]``.
    """
    turns = np.ascontiguousarray(rotation_matrix(scene.orientation.T).transpose(2, 0, 1))
    return [
        (unit.vertices * scene.dimensions[i]) @ turns[i].T + scene.position[i]
        for unit, i in zip(units, rows, strict=True)
    ]


_BOX_FACES = np.array(
    [
        [0, 2, 1], [0, 3, 2],  # −z
        [4, 5, 6], [4, 6, 7],  # +z
        [0, 1, 5], [0, 5, 4],  # −y
        [2, 3, 7], [2, 7, 6],  # +y
        [0, 4, 7], [0, 7, 3],  # −x
        [1, 2, 6], [1, 6, 5],  # +x
    ],
    dtype=np.int32,
)  # fmt: skip


def box(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> Mesh:
    """Axis-aligned box between bounds [m]: 8 vertices, 12 faces.

    Args:
        x, y, z: Lowest and highest coordinate on each axis.

    Example:
        >>> box((0, 2), (0, 1), (0, 3)).vertices.max(0)
        array([2, 1, 3])
    """
    (x0, x1), (y0, y1), (z0, z1) = x, y, z
    corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    return Mesh(
        np.array([(*corner, z0) for corner in corners] + [(*corner, z1) for corner in corners]),
        _BOX_FACES.copy(),
    )


def unit_box() -> Mesh:
    """The unit mesh of an object without one of its own."""
    return box((-0.5, 0.5), (-0.5, 0.5), (-0.5, 0.5))


Body = tuple[str, int]
"""Asset (or kind: an asset and a material) and slot, from 0, of a body in a ray tracer's pool."""


def object_meshes(files: Mapping[str, Path]) -> dict[str, Mesh]:
    """Read the unit meshes that objects may have.

    Args:
        files: PLY files of meshes by asset name; others of a run's files are left out.

    Returns:
        Meshes by asset name, and the box by the empty one.

    Raises:
        AssetError: A file is no mesh, or its bounding box is not −½…½ on every axis.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder, "box.ply")
        ...     _ = file.write_bytes(ply(unit_box()))
        ...     sorted(object_meshes({"objects/box.ply": file, "scenery/street.xml": file}))
        ['', 'objects/box.ply']
    """
    meshes = {"": unit_box()}
    for name in filter(is_object_mesh, sorted(files)):
        vertices, faces = read_ply(files[name], f"mesh {name!r}")
        check_unit_box(vertices, f"mesh {name!r}")
        meshes[name] = Mesh(vertices, faces.astype(np.int32))
    return meshes


def is_object_mesh(name: str) -> bool:
    """Test whether an asset is the mesh of an object, by its name."""
    return name.startswith("objects/") and name.endswith(".ply")


def shown_asset(asset: str, meshes: Container[str]) -> str:
    """Asset whose mesh stands for an object: its own, or the box's, empty, in place of one that came while
    the run goes on and is not there.

    Args:
        asset: Asset of the object.
        meshes: Names of the meshes that there are.
    """
    return "" if is_mesh_name(asset) and asset not in meshes else asset


# [m]; a centre to count from is a multiple of it, so that a scene about the origin stays as it is.
_CENTRE_STEP = 128.0


def coarse_centre(middle: Float64Array) -> Float64Array:
    """Centre that a ray tracer in float32 counts from, near the middle of a scene [m], Shape ``[3]``; no
    negative zeros."""
    centre: Float64Array = np.round(middle / _CENTRE_STEP) * _CENTRE_STEP + 0.0
    return centre


def assign_bodies(
    objects: Iterable[tuple[str, str]],
    pool: Mapping[str, int],
    keys: Mapping[str, str] = MappingProxyType({}),
) -> dict[str, Body]:
    """Choose the body of a ray tracer that stands for each object of a scene.

    Names are assigned in sorted order, so that the assignment follows from the scene alone, also after a
    restart.

    Args:
        objects: Name and asset of each object; an empty asset is the box.
        pool: How many bodies there are of each asset.
        keys: Key of the scenario that says how many, by asset, for the error.

    Returns:
        The body of each object, by its name.

    Raises:
        PayloadError: There are more objects of an asset than bodies, or none of its bodies at all; names the
            object, the asset, and the key or how to bring the mesh.

    Example:
        >>> assign_bodies([("car.2", ""), ("car.1", "")], {"": 2})
        {'car.1': ('', 0), 'car.2': ('', 1)}
    """
    taken: dict[str, Body] = {}
    used: Counter[str] = Counter()
    for name, asset in sorted(objects):
        count = pool.get(asset)
        if count is None:
            raise PayloadError(
                f"object {name!r} has the mesh {asset!r}, which the run does not have (it has: "
                f"{', '.join(sorted(filter(None, pool))) or 'none'}); let the world bring it, or keep the "
                "meshes of a recording beside it"
            )
        if used[asset] == count:
            key = keys.get(asset, "")
            remedy = "write a larger number" if key else "raise the pool size in the service's settings"
            raise PayloadError(
                f"{key}{': ' * bool(key)}object {name!r} needs another body of {asset or 'the box'!r}, the "
                f"pool has {count}; {remedy}"
            )
        taken[name] = (asset, used[asset])
        used[asset] += 1
    return taken


def loft(sections: Float64Array) -> Mesh:
    """Closed surface through convex polygons, with flat ends.

    Args:
        sections: Corners of S polygons of K corners each, Shape ``[S, K, 3]``. Seen from the last section
            towards the first, they run counter-clockwise; then normals point outwards.
    """
    count, corners = sections.shape[:2]
    faces: list[tuple[int, int, int]] = []
    for s in range(count - 1):
        for k in range(corners):
            a, b = s * corners + k, s * corners + (k + 1) % corners
            # Both triangles of each quadrilateral between two sections.
            faces += [(a, b, b + corners), (a, b + corners, a + corners)]
    last = (count - 1) * corners
    for k in range(1, corners - 1):
        # Fans over both ends.
        faces += [(0, k + 1, k), (last, last + k, last + k + 1)]
    return Mesh(sections.reshape(-1, 3).astype(np.float64), np.array(faces, dtype=np.int32))


def joined(parts: Sequence[Mesh]) -> Mesh:
    """Several meshes as one, vertices and faces in their order; without any, a mesh of nothing."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + np.int32(start) for part, start in zip(parts, starts, strict=False)]
    return Mesh(
        np.concatenate([np.zeros((0, 3)), *(part.vertices for part in parts)]),
        np.concatenate([np.zeros((0, 3), np.int32), *faces], dtype=np.int32),
    )


def contains(mesh: Mesh, point: Float64Array) -> bool:
    """Test whether a point lies inside a closed mesh; undecided on its surface.

    Sums the solid angles of all triangles (Van Oosterom and Strackee, "The solid angle of a plane
    triangle", 1983): ±4π inside, 0 outside.

    Args:
        mesh: A closed mesh.
        point: The point, in the coordinates of the mesh, Shape ``[3]``.

    Example:
        >>> contains(unit_box(), np.array([0.4, 0.0, 0.0])), contains(unit_box(), np.array([0.6, 0.0, 0.0]))
        (True, False)
    """
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces] - point, 1, 0)
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    numerator = np.einsum("ij,ij->i", a, np.cross(b, c))
    denominator = (
        la * lb * lc
        + np.einsum("ij,ij->i", a, b) * lc
        + np.einsum("ij,ij->i", b, c) * la
        + np.einsum("ij,ij->i", c, a) * lb
    )
    angle = 2 * float(np.arctan2(numerator, denominator).sum())
    return abs(angle) > 2 * np.pi


def _along_x(stations: Sequence[tuple[float, float, float, float, float]]) -> Mesh:
    """Body from cross-sections: x, height of the waist, height of the top, half widths there."""
    return loft(
        np.array(
            [
                [
                    (x, waist_y, -0.5), (x, waist_y, waist_z), (x, top_y, top_z),
                    (x, -top_y, top_z), (x, -waist_y, waist_z), (x, -waist_y, -0.5),
                ]
                for x, waist_z, top_z, waist_y, top_y in stations
            ]
        )
    )  # fmt: skip


def _along_z(
    levels: Sequence[tuple[float, float, float]], centre: tuple[float, float] = (0.0, 0.0), corners: int = 8
) -> Mesh:
    """Body from horizontal polygons: z and the half axes along x and y."""
    around = [2 * math.pi * k / corners for k in range(corners)]
    return loft(
        np.array(
            [
                [(centre[0] + rx * math.cos(angle), centre[1] + ry * math.sin(angle), z) for angle in around]
                for z, rx, ry in levels
            ]
        )
    )


def car() -> Mesh:
    """Bonnet, windscreen, cabin and boot."""
    return _along_x(
        [
            (-0.50, 0.02, 0.10, 0.44, 0.40),
            (-0.44, 0.06, 0.16, 0.50, 0.42),
            (-0.36, 0.06, 0.20, 0.50, 0.42),
            (-0.24, 0.06, 0.48, 0.50, 0.36),
            (-0.08, 0.06, 0.50, 0.50, 0.36),
            (0.08, 0.06, 0.46, 0.50, 0.36),
            (0.24, 0.04, 0.14, 0.50, 0.42),
            (0.46, -0.02, 0.06, 0.48, 0.40),
            (0.50, -0.10, 0.00, 0.42, 0.36),
        ]
    )


def truck() -> Mesh:
    """A cab with a sloping windscreen, and a box body behind it."""
    cab = _along_x(
        [
            (0.26, 0.28, 0.34, 0.47, 0.44),
            (0.40, 0.28, 0.34, 0.47, 0.44),
            (0.48, -0.05, 0.00, 0.47, 0.45),
            (0.50, -0.15, -0.10, 0.45, 0.42),
        ]
    )
    return joined([cab, box((-0.5, 0.24), (-0.5, 0.5), (-0.5, 0.5))])


def bus() -> Mesh:
    """A long body with bevelled roof edges and a raked front."""
    return _along_x(
        [
            (-0.50, 0.40, 0.49, 0.48, 0.42),
            (-0.48, 0.42, 0.50, 0.50, 0.43),
            (0.45, 0.42, 0.50, 0.50, 0.43),
            (0.50, -0.10, 0.38, 0.48, 0.42),
        ]
    )


def pedestrian() -> Mesh:
    """Legs, shoulders and head."""
    return _along_z(
        [
            (-0.50, 0.30, 0.26),
            (-0.05, 0.36, 0.34),
            (0.10, 0.40, 0.40),
            (0.30, 0.50, 0.50),
            (0.34, 0.22, 0.16),
            (0.38, 0.40, 0.22),
            (0.46, 0.36, 0.20),
            (0.50, 0.16, 0.10),
        ]
    )


def bicycle() -> Mesh:
    """A two-wheeler as a slender frame, and its rider leaning forward."""
    frame = box((-0.5, 0.5), (-0.12, 0.12), (-0.5, -0.16))
    rider = _along_z(
        [(-0.14, 0.16, 0.36), (0.20, 0.20, 0.50), (0.30, 0.12, 0.20), (0.50, 0.08, 0.16)], (0.05, 0)
    )
    return joined([frame, rider])


def uav() -> Mesh:
    """A quadcopter: body, four arms on the diagonals, four rotors."""
    parts = [_along_z([(-0.50, 0.16, 0.16), (-0.10, 0.20, 0.20), (0.20, 0.12, 0.12)])]
    radius, reach = 0.16, 0.34
    for sx, sy in ((1, 1), (-1, 1), (-1, -1), (1, -1)):
        parts.append(_along_z([(0.42, radius, radius), (0.50, radius, radius)], (sx * reach, sy * reach)))
        arm = box((0.22, math.hypot(reach, reach)), (-0.03, 0.03), (0.24, 0.36))
        c, s = sx * math.sqrt(0.5), sy * math.sqrt(0.5)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        parts.append(Mesh(arm.vertices @ turn.T, arm.faces))
    return joined(parts)


SHAPES: dict[str, Callable[[], Mesh]] = {
    "bicycle": bicycle,
    "bus": bus,
    "car": car,
    "motorcycle": bicycle,
    "pedestrian": pedestrian,
    "truck": truck,
    "uav": uav,
}
"""Object classes that have a mesh."""


def fitted(mesh: Mesh) -> tuple[Mesh, Float64Array, Float64Array]:
    """Scale and centre a mesh to the unit box, as meshes of moving objects travel.

    Args:
        mesh: In the object's axes [m]: x forward, y left, z up.

    Returns:
        The unit mesh, the object's dimensions [m], Shape ``[3]``, and the centre of its bounding box in its
        axes [m], Shape ``[3]``, which is where `ObjectState.position` is.

    Raises:
        PayloadError: It has no vertices, or is flat along an axis.

    Example:
        >>> unit, dimensions, centre = fitted(box((0, 4), (-1, 1), (0, 1.5)))
        >>> dimensions.tolist(), centre.tolist(), unit.vertices.max(0).tolist()
        ([4.0, 2.0, 1.5], [2.0, 0.0, 0.75], [0.5, 0.5, 0.5])
    """
    if not len(mesh.vertices):
        raise PayloadError("a mesh without vertices has no size; give it some, or let its object be a box")
    low, high = mesh.vertices.min(axis=0).astype(np.float64), mesh.vertices.max(axis=0).astype(np.float64)
    dimensions, centre = high - low, (low + high) / 2
    if not (dimensions > 0).all():
        axis = "xyz"[int(np.argmin(dimensions))]
        raise PayloadError(f"the mesh is flat along {axis}: it cannot fill a box; give it a thickness")
    return Mesh((mesh.vertices - centre) / dimensions, mesh.faces), dimensions, centre


def ply(mesh: Mesh, material: str = "") -> bytes:
    """Encode a mesh as binary PLY: float32 vertices, faces as uint8 count and int32 indices.

    Args:
        mesh: Of a unit mesh, the box of its vertices is −½…½ on every axis.
        material: What it is made of, by its name in Recommendation ITU-R P.2040; empty: what the channel's
            settings say.

    Example:
        >>> ply(unit_box())[:3]
        b'ply'
    """
    comment = f"comment material {material}\n" if material else ""
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"{comment}"
        f"element vertex {len(mesh.vertices)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(mesh.faces)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    rows["count"], rows["corners"] = 3, mesh.faces
    return header.encode() + mesh.vertices.astype("<f4").tobytes() + rows.tobytes()
