"""Views of a scene: cameras at chosen and automatic places, what each pixel sees, and tables of pictures.

A table of pictures has one row a picture: its file, and the camera's place [m], turn [°] and horizontal field
of view [°]. Angles are those of scenarios: yaw counter-clockwise from east, a positive pitch looks down, roll
about the line of sight. So renderings and photographs whose poses are known are read the same way.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from caviar_protocol.arrays import Float32Array, Float64Array, Int32Array, Int64Array, UInt8Array
from caviar_protocol.errors import AssetError, SetupError
from caviar_protocol.host import install_command
from caviar_protocol.space.coordinates import Pose, euler_from_quaternion, quaternion_from_euler
from caviar_protocol.topics import CameraDevice
from caviar_space.meshes import Mesh, joined

if TYPE_CHECKING:
    from caviar_services.sensors.shading import View
    from caviar_space.textures import Texture

COLUMNS = ("file", "x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg", "hfov_deg")
"""Of a table of pictures."""
TABLE = "pictures.csv"
"""Name of the table that is written beside renderings."""
EYES = 1.7
"""Height of cameras on streets [m]."""
CELL = 2.0
"""Edge [m] of the squares of surfaces that viewpoints are chosen to see."""


@dataclass(frozen=True)
class Picture:
    """A picture whose camera is known; the camera's size is that of the picture."""

    file: Path
    camera: CameraDevice

    def rgb(self) -> UInt8Array:
        """Read the picture, Shape ``[H, W, 3]``."""
        return read_picture(self.file)


@dataclass(frozen=True, eq=False)
class Seen:
    """Surfaces that the pixels of a camera see, Shape ``[H, W]`` each."""

    face: Int64Array
    """Number among the faces of all meshes, from 0; −1 where nothing is."""
    owner: Int32Array
    """Number of the mesh, from 0; −1 where nothing is."""
    distance: Float32Array
    """Along the ray [m]; infinite where nothing is."""
    depth: Float32Array
    """Along the optical axis [m]; infinite where nothing is."""
    points: Float64Array
    """[m], Shape ``[H, W, 3]``; not finite where nothing is."""
    cosine: Float32Array
    """Between ray and normal, 0…1; 0 where nothing is."""


def read_picture(file: Path) -> UInt8Array:
    """Read a picture as sRGB, Shape ``[H, W, 3]``.

    Args:
        file: PNG, JPEG, or what else Pillow reads.

    Raises:
        AssetError: The file is missing or no picture.
        SetupError: Pillow is not installed.
    """
    with _opened(file) as image:
        return np.array(image.convert("RGB"))


def save_picture(file: Path, rgb: UInt8Array) -> None:
    """Write a picture, sRGB of Shape ``[H, W, 3]``; in the format of the file's ending.

    Raises:
        SetupError: Pillow is not installed.
    """
    _pillow().fromarray(rgb).save(file)


def _pillow() -> Any:
    try:
        from PIL import Image
    except ImportError as error:
        raise SetupError(f"pictures need Pillow; run: {install_command('formats')}") from error
    return Image


@contextmanager
def _opened(file: Path) -> Iterator[Any]:
    pillow = _pillow()
    try:
        with pillow.open(file) as image:
            yield image
    except (OSError, ValueError, SyntaxError, pillow.DecompressionBombError) as error:
        raise AssetError(f"picture {str(file)!r} cannot be read: {error}; give a PNG or JPEG") from error


def read_pictures(table: Path) -> list[Picture]:
    """Read a table of pictures: CSV with `COLUMNS`, or JSON, a list of objects with these keys.

    Args:
        table: The table; files stand relative to its folder.

    Raises:
        AssetError: A line is wrong, or a picture is missing or none; names table, line and value.
    """
    found = []
    for line, row in _rows(table):
        place = f"{table}:{line}"
        values = []
        for column in COLUMNS[1:]:
            try:
                value = float(row.get(column) or 0.0 if column == "roll_deg" else row[column])
            except (KeyError, TypeError, ValueError):
                value = math.nan
            if not math.isfinite(value):
                raise AssetError(f"{place}: {column} is {row.get(column)!r}; write a number")
            values.append(value)
        x, y, z, yaw, pitch, roll, fov = values
        if not 0 < fov < 180:
            raise AssetError(f"{place}: hfov_deg is {fov:g}; write one above 0 and below 180")
        name = row.get("file") or ""
        file = table.parent / str(name)
        try:
            with _opened(file) as image:
                width, height = image.size
        except AssetError as error:
            raise AssetError(f"{place}: {error}") from error
        found.append(Picture(file, camera(str(name), (x, y, z), (yaw, pitch, roll), fov, (width, height))))
    if not found:
        raise AssetError(f"{table} names no picture; write one a line: {','.join(COLUMNS)}")
    return found


def _rows(table: Path) -> list[tuple[int, dict[str, Any]]]:
    try:
        text = table.read_text("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise AssetError(f"cannot read the table of pictures {table}: {error}") from error
    if table.suffix.lower() == ".json":
        try:
            return list(enumerate(msgspec.json.decode(text, type=list[dict[str, Any]]), 1))
        except (msgspec.DecodeError, msgspec.ValidationError) as error:
            raise AssetError(
                f"{table}: {error}; write a list of objects with {', '.join(COLUMNS)}"
            ) from error
    return read_table(table, text, COLUMNS[:-2] + COLUMNS[-1:])


def read_table(table: Path, text: str, needed: Sequence[str]) -> list[tuple[int, dict[str, Any]]]:
    """Split a CSV into rows by column, with their lines; lines that begin with ``#`` are left out.

    Args:
        table: For messages.
        text: The content.
        needed: Columns that it must have.

    Raises:
        AssetError: A column is missing, or a row has more or fewer values than the head.
    """
    lines = [(n, line) for n, line in enumerate(text.splitlines(), 1) if line.strip() and line[0] != "#"]
    rows = [(n, next(csv.reader([line]))) for n, line in lines]
    head = [name.strip() for name in rows[0][1]] if rows else []
    lacking = [name for name in needed if name not in head]
    if lacking:
        raise AssetError(f"{table}:{rows[0][0] if rows else 1}: there is no column {', '.join(lacking)}")
    for number, row in rows[1:]:
        if len(row) != len(head):
            raise AssetError(f"{table}:{number}: {len(row)} values, the head has {len(head)} columns")
    return [(n, dict(zip(head, (value.strip() for value in row), strict=True))) for n, row in rows[1:]]


def camera(
    name: str,
    position: tuple[float, float, float],
    turn_deg: tuple[float, float, float],
    fov_deg: float,
    size: tuple[int, int],
) -> CameraDevice:
    """Make a camera of position [m]; yaw, pitch and roll [°]; field of view [°]; width and height [px]."""
    yaw, pitch, roll = np.radians(turn_deg).tolist()
    return CameraDevice(
        name=name,
        position=position,
        orientation=quaternion_from_euler(yaw, pitch, roll),
        field_of_view=math.radians(fov_deg),
        width=size[0],
        height=size[1],
    )


def pictures_table(cameras: Mapping[str, CameraDevice]) -> str:
    """Write a table of pictures, by the name of the file."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(COLUMNS)
    for file, device in cameras.items():
        angles = [math.degrees(angle) for angle in euler_from_quaternion(device.orientation)]
        numbers = [*device.position, *angles, math.degrees(device.field_of_view)]
        writer.writerow([file, *(f"{number:.9g}" for number in numbers)])
    return out.getvalue()


class Eye:
    """Meshes for cameras: what their pixels see, and pictures.

    Args:
        meshes: In world coordinates [m], by name.

    Raises:
        SetupError: Mitsuba, of the extra ``sensors``, is not installed.
    """

    def __init__(self, meshes: Mapping[str, Mesh]) -> None:
        try:
            import mitsuba  # noqa: F401
        except ImportError as error:
            raise SetupError(f"cameras need Mitsuba; run: {install_command('sensors')}") from error
        from caviar_services.drjit_setup import activate_llvm, choose_variant, cuda_devices, limit_threads
        from caviar_services.sensors.base import TracedScene, active_variant
        from caviar_space.meshes import object_meshes

        if not cuda_devices():
            activate_llvm()
        self._variant = choose_variant()
        limit_threads()
        self.names = tuple(meshes)
        self.mesh = joined(list(meshes.values()))
        """All meshes as one."""
        with active_variant(self._variant) as mi:
            self._traced = TracedScene(mi, self.names, list(meshes.values()), object_meshes({}), {"": 0})
        self.owner: Int32Array = self._traced.face_owner[: len(self.mesh.faces)]
        """Number of the mesh of each face, Shape ``[F]``."""
        self.normals = self._traced.face_normals()[: len(self.mesh.faces)]
        """Unit normals, Shape ``[F, 3]``."""

    def look(self, device: CameraDevice) -> Seen:
        """Find what the pixels of a camera see."""
        from caviar_services.sensors.base import active_variant
        from caviar_services.sensors.camera import first_hits, pixel_rays, ray_directions

        view = self._view(device)
        with active_variant(self._variant) as mi:
            hits = first_hits(mi, self._traced, view)
        rays = ray_directions(view).T
        found = np.isfinite(hits.distance)
        distance = np.where(found, hits.distance, np.inf)
        normals = self.normals[hits.face] if len(self.normals) else np.zeros_like(rays)
        ahead = pixel_rays(device.width, device.height, view.optics)[0]
        with np.errstate(invalid="ignore"):
            points = np.array(device.position) + distance[:, None] * rays
        return Seen(
            face=view.image(np.where(found, hits.face, -1)),
            owner=view.image(np.where(found, hits.owner, np.int32(-1))),
            distance=view.image(distance.astype(np.float32)),
            depth=view.image((distance * ahead).astype(np.float32)),
            points=view.image(points),
            cosine=view.image(np.where(found, np.abs((rays * normals).sum(1)), 0.0).astype(np.float32)),
        )

    def paint(
        self,
        device: CameraDevice,
        albedo: Float64Array,
        sun_deg: tuple[float, float] = (-55.0, 45.0),
        textures: Sequence[Texture | None] = (),
    ) -> UInt8Array:
        """Draw a picture, sRGB of Shape ``[H, W, 3]``.

        Args:
            device: The camera.
            albedo: Linear sRGB of each mesh, Shape ``[meshes, 3]``.
            sun_deg: Azimuth and elevation of the sun.
            textures: Of each mesh; they are shown as they are, since photographs have their light in them.
        """
        from caviar_services.sensors.base import active_variant
        from caviar_services.sensors.shading import Painter

        azimuth, height = np.radians(sun_deg)
        sun = np.array(
            [math.cos(height) * math.cos(azimuth), math.cos(height) * math.sin(azimuth), math.sin(height)]
        )
        colours = np.concatenate([albedo.reshape(-1, 3), np.zeros((1, 3))])  # and of the triangle of no body
        with active_variant(self._variant) as mi:
            picture = Painter(mi, self._traced, colours, sun).paint(self._view(device))
        return self._textured(device, picture, textures) if any(textures) else picture

    def _textured(
        self, device: CameraDevice, picture: UInt8Array, textures: Sequence[Texture | None]
    ) -> UInt8Array:
        """Put textures in a picture: the mean of four points of each pixel, if it is not very large."""
        from caviar_services.sensors.shading import encoded, linear

        width, height = device.width, device.height
        fine = 2 if width * height <= 1 << 22 else 1
        seen = self.look(msgspec.structs.replace(device, width=fine * width, height=fine * height))
        drawn = picture.repeat(fine, axis=0).repeat(fine, axis=1)
        for number in np.unique(seen.owner[seen.owner >= 0]).tolist():
            if (texture := textures[number]) is None:
                continue
            met = seen.owner == number
            face, first = seen.face[met], int(np.argmax(self.owner == number))
            weights = _barycentric(self.mesh.vertices[self.mesh.faces[face]], seen.points[met])
            tinted = encoded((linear(np.arange(256)[:, None] / 255) * texture.tint).astype(np.float32))
            drawn[met] = tinted[texture.texels(face - first, weights), [0, 1, 2]]
        mean = drawn.reshape(height, fine, width, fine, 3).mean(axis=(1, 3))
        result: UInt8Array = np.rint(mean).astype(np.uint8)
        return result

    @staticmethod
    def _view(device: CameraDevice) -> View:
        from caviar_services.sensors.camera import intrinsics
        from caviar_services.sensors.shading import View

        return View(device, intrinsics(device), Pose(device.position, device.orientation))


def _barycentric(corners: Float64Array, points: Float64Array) -> Float64Array:
    """Weights of the corners of triangles, Shape ``[N, 3, 3]``, at points on them, Shape ``[N, 3]``."""
    after = np.roll(corners, -1, axis=1) - points[:, None]
    opposite = np.cross(after, np.roll(after, -1, axis=1))  # of each corner: twice the area it faces
    areas = np.maximum(np.einsum("ncx,nx->nc", opposite, opposite.sum(axis=1)), 0.0)
    weights: Float64Array = areas / np.maximum(areas.sum(axis=1, keepdims=True), 1e-300)
    return weights


def viewpoints(
    eye: Eye, count: int, size: tuple[int, int] = (640, 480), fov_deg: float = 90.0, seed: int = 1
) -> list[CameraDevice]:
    """Choose cameras on streets and above roofs that together see most of a scene.

    Candidates stand at random places under the open sky, and above them. Of both in turn, that is taken which
    sees most squares of `CELL` metres that fewer than two have seen.

    Args:
        eye: The scene.
        count: Number of cameras.
        size: Width and height [px].
        fov_deg: Horizontal field of view [°].
        seed: Of the candidates.

    Raises:
        AssetError: The scene has no faces.
    """
    if not len(eye.mesh.faces):
        raise AssetError("the scene has no faces, so no camera sees any; give a scene with meshes")
    rng = np.random.default_rng(seed)
    low, high = eye.mesh.vertices.min(0), eye.mesh.vertices.max(0)
    tried = max(40, 4 * count)
    ground: list[tuple[float, float, float]] = []
    for x, y in rng.uniform(low[:2], high[:2], (20 * tried, 2)).tolist():
        top = eye.look(camera("", (x, y, high[2] + 10.0), (0.0, 90.0, 0.0), 1.0, (1, 1)))
        if np.isfinite(top.distance[0, 0]):
            ground.append((x, y, high[2] + 10.0 - float(top.distance[0, 0])))
        if len(ground) >= 4 * tried:
            break
    # Streets are what lies low: roofs of houses are above the lower half of all places.
    level = float(np.percentile([z for _, _, z in ground], 10)) + 2.0
    streets = [place for place in ground if place[2] < level][:tried] or ground[:1]
    poses = []
    for x, y, z in streets:
        turn = rng.uniform(0, 90)
        poses += [((x, y, z + EYES), (turn + 90.0 * k, -12.0, 0.0)) for k in range(4)]
        poses += [
            ((x, y, float(high[2]) + rng.uniform(5, 25)), (turn + 90.0 * k, 40.0, 0.0)) for k in range(2)
        ]
    small = (48, max(2, 48 * size[1] // size[0]))
    squares: list[Int64Array] = []
    for place, turn_deg in poses:
        seen = eye.look(camera("", place, turn_deg, fov_deg, small))
        met = seen.cosine > 0.1  # the others are too foreshortened to say much
        cells = np.column_stack([seen.face[met], np.floor(seen.points[met] / CELL).astype(np.int64)])
        squares.append(np.unique(cells, axis=0))
    every, index = np.unique(np.concatenate(squares), axis=0, return_inverse=True)
    parts = np.split(index.reshape(-1), np.cumsum([len(part) for part in squares])[:-1])
    views, chosen = np.zeros(len(every), np.int64), list[int]()
    for number in range(min(count, len(poses))):
        above = number % 2 if number < 2 * len(streets) else 0  # two of six candidates of a place
        open_to = [k for k in range(len(poses)) if k not in chosen and (k % 6 >= 4) == above]
        gains = [int((views[part] < 2).sum()) if k in open_to else -1 for k, part in enumerate(parts)]
        chosen.append(int(np.argmax(gains)))
        views[parts[chosen[-1]]] += 1
    return [camera(f"view-{number:02d}", *poses[k], fov_deg, size) for number, k in enumerate(chosen)]
