"""glTF 2.0 and GLB: triangles of all nodes of a scene, in float64, x east, y north, z up.

Khronos Group, "glTF 2.0 Specification", with the extensions of `_EXTENSIONS`. Its y is up and its z south.
"""

from __future__ import annotations

import base64
import math
import struct
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array, Int64Array
from caviar_protocol.errors import AssetError
from caviar_space.imported_scenes import ImportedScene
from caviar_space.sources import Request
from caviar_space.sources.pieces import Y_UP, Colour, SceneBuilder, at, beside, contents, moved, reading
from caviar_space.textures import Texture, picture

Index = Annotated[int, msgspec.Meta(ge=0)]
"""Of an item in a list of the document."""
_Numbers3 = tuple[float, float, float]
_Numbers4 = tuple[float, float, float, float]
# That change where triangles are, or are for cameras alone; required others are refused.
_EXTENSIONS = (
    "KHR_draco_mesh_compression", "KHR_mesh_quantization", "EXT_mesh_gpu_instancing", "CESIUM_RTC",
    "KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_", "KHR_lights_", "EXT_mesh_features",
    "EXT_structural_metadata", "EXT_instance_features", "CESIUM_primitive_outline", "KHR_xmp",
)  # fmt: skip
_MOST_UV = 1e5
_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WRAPS = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


class Part(msgspec.Struct, frozen=True, rename="camel"):
    """A part of a document; what scenes do not need is not read."""


class _Node(Part, frozen=True):
    name: str = ""
    mesh: Index | None = None
    children: list[Index] = []
    matrix: list[float] | None = None
    translation: _Numbers3 = (0.0, 0.0, 0.0)
    rotation: _Numbers4 = (0.0, 0.0, 0.0, 1.0)
    scale: _Numbers3 = (1.0, 1.0, 1.0)
    extensions: dict[str, Any] = {}


class _Primitive(Part, frozen=True):
    attributes: dict[str, Index] = {}
    indices: Index | None = None
    material: Index | None = None
    mode: int = 4
    extensions: dict[str, Any] = {}


class _Mesh(Part, frozen=True):
    primitives: list[_Primitive] = []
    name: str = ""


class _TextureTransform(Part, frozen=True):
    offset: tuple[float, float] = (0.0, 0.0)
    rotation: float = 0.0
    scale: tuple[float, float] = (1.0, 1.0)
    tex_coord: Index | None = None


class _TextureExtensions(Part, frozen=True):
    transform: _TextureTransform = msgspec.field(default=_TextureTransform(), name="KHR_texture_transform")


class _TextureOf(Part, frozen=True):
    index: Index
    tex_coord: Index = 0
    extensions: _TextureExtensions = _TextureExtensions()


class _Surface(Part, frozen=True):
    base_color_factor: _Numbers4 = (1.0, 1.0, 1.0, 1.0)
    base_color_texture: _TextureOf | None = None


class _Texture(Part, frozen=True):
    source: Index | None = None
    sampler: Index | None = None


class _Image(Part, frozen=True):
    uri: str | None = None
    buffer_view: Index | None = None


class _Sampler(Part, frozen=True):
    wrap_s: int = 10497
    wrap_t: int = 10497


class _Material(Part, frozen=True):
    name: str = ""
    pbr_metallic_roughness: _Surface | None = None


class _Accessor(Part, frozen=True):
    component_type: int
    count: Index
    type: str
    buffer_view: Index | None = None
    byte_offset: Index = 0
    normalized: bool = False
    sparse: dict[str, Any] | None = None


class View(Part, frozen=True):
    """Bytes of a buffer."""

    buffer: Index
    byte_length: Index
    byte_offset: Index = 0
    byte_stride: Index | None = None


class Buffer(Part, frozen=True):
    """Bytes of a file, or of what is appended to the document."""

    byte_length: Index
    uri: str | None = None


class _Scene(Part, frozen=True):
    nodes: list[Index] = []


class _Asset(Part, frozen=True):
    version: str


class _Rtc(Part, frozen=True):
    center: _Numbers3


class _Extensions(Part, frozen=True):
    rtc: _Rtc | None = msgspec.field(default=None, name="CESIUM_RTC")


class _Document(Part, frozen=True):
    asset: _Asset
    scene: Index = 0
    scenes: list[_Scene] = []
    nodes: list[_Node] = []
    meshes: list[_Mesh] = []
    materials: list[_Material] = []
    textures: list[_Texture] = []
    images: list[_Image] = []
    samplers: list[_Sampler] = []
    accessors: list[_Accessor] = []
    buffer_views: list[View] = []
    buffers: list[Buffer] = []
    extensions_required: list[str] = []
    extensions: _Extensions = _Extensions()


class Surface(NamedTuple):
    """Triangles of one node and one material."""

    name: str
    vertices: Float64Array
    """[m], Shape ``[V, 3]``."""
    faces: Int64Array
    material: str
    """Name; empty: none."""
    colour: Colour | None
    """Linear sRGB, 0…1."""
    texture: Texture | None
    """With the places of the vertices in its picture, Shape ``[V, 2]``."""


class Gltf:
    """An open glTF document.

    Args:
        data: Content of the file, ``.glb`` or ``.gltf``.
        folder: In which the files lie that it names.
        where: What errors call it.

    Raises:
        ValueError, msgspec.MsgspecError, struct.error: It is damaged.
        AssetError: It names a file outside of its folder.
    """

    def __init__(self, data: bytes, folder: Path, where: str) -> None:
        self.left_out: dict[str, int] = {}
        """Count of parts without triangles, by what they are."""
        self.files: list[Path] = []
        """Others that were read."""
        text, self._binary = _chunks(data) if data[:4] == b"glTF" else (data, b"")
        self._document = document = msgspec.json.decode(text, type=_Document)
        if not document.asset.version.startswith("2"):
            raise ValueError(f"it is of version {document.asset.version}: 2.0 is read")
        unknown = [name for name in document.extensions_required if not name.startswith(_EXTENSIONS)]
        if unknown:
            raise ValueError(f"it requires the extension {unknown[0]}; export it without")
        self._folder, self._where = folder, where
        self._buffers: dict[int, bytes] = {}
        self._images: dict[int, bytes] = {}

    def surfaces(self, turn: Float64Array = Y_UP) -> Iterator[Surface]:
        """Triangles of all nodes of the document's scene.

        Args:
            turn: Of its axes into those of the result, by default x east, y north, z up, Shape ``[4, 4]``.
        """
        document = self._document
        if document.scenes:
            roots = at(document.scenes, document.scene, "scene").nodes
        else:
            children = {child for node in document.nodes for child in node.children}
            roots = [index for index in range(len(document.nodes)) if index not in children]
        rtc = np.eye(4)
        if document.extensions.rtc is not None:
            rtc[:3, 3] = document.extensions.rtc.center
        left = [(index, rtc @ turn) for index in reversed(roots)]
        met: set[int] = set()
        while left:
            index, above = left.pop()
            if index in met:
                raise ValueError(f"node {index} is below two nodes, or below itself")
            met.add(index)
            node = at(document.nodes, index, "node")
            here = above @ _matrix(node)
            left += [(child, here) for child in reversed(node.children)]
            if node.mesh is None:
                continue
            mesh = at(document.meshes, node.mesh, "mesh")
            name = node.name or mesh.name or f"node-{index}"
            for primitive in mesh.primitives:
                if (read := self._triangles(primitive)) is None:
                    continue
                material = _Material()
                if primitive.material is not None:
                    material = at(document.materials, primitive.material, "material")
                pbr = material.pbr_metallic_roughness
                colour = texture = None
                vertices, faces, coordinates = read
                if pbr is not None:
                    red, green, blue = (min(max(part, 0.0), 1.0) for part in pbr.base_color_factor[:3])
                    colour = red, green, blue
                    if pbr.base_color_texture is not None:
                        try:
                            texture = self._texture(
                                pbr.base_color_texture, coordinates, len(vertices), colour
                            )
                        except (AssetError, ValueError) as error:
                            what = f"textures of surfaces ({str(error)[:200]})"
                            self.left_out[what] = self.left_out.get(what, 0) + 1
                for instance in self._instances(node):
                    placed = moved(here @ instance, vertices, faces)
                    yield Surface(name, *placed, material.name, colour, texture)

    def _texture(
        self, given: _TextureOf, coordinates: Callable[[int], Float64Array], count: int, tint: Colour
    ) -> Texture:
        """Picture of a surface of ``count`` vertices."""
        texture: _Texture = at(self._document.textures, given.index, "texture")
        if texture.source is None:
            raise ValueError("it is no PNG or JPEG")
        sampler = _Sampler()
        if texture.sampler is not None:
            sampler = at(self._document.samplers, texture.sampler, "sampler")
        wrap = _WRAPS.get(sampler.wrap_s, "repeat"), _WRAPS.get(sampler.wrap_t, "repeat")
        change = given.extensions.transform
        uv = coordinates(given.tex_coord if change.tex_coord is None else change.tex_coord)
        cosine, sine = math.cos(change.rotation), math.sin(change.rotation)
        uv = uv * change.scale @ [[cosine, -sine], [sine, cosine]] + change.offset
        if uv.shape != (count, 2) or not (np.abs(uv) <= _MOST_UV).all():
            raise ValueError(f"{len(uv)} places in it for {count} vertices, or one that is not finite")
        return Texture(self._image(texture.source), uv, wrap, tint)

    def _image(self, index: int) -> bytes:
        """PNG or JPEG of an image, which can be decoded."""
        if index not in self._images:
            given: _Image = at(self._document.images, index, "image")
            if given.buffer_view is not None:
                data = self._view(given.buffer_view)[0]
            else:
                data = self._buffer(Buffer(0, given.uri or ""))
            picture(data)
            self._images[index] = data
        return self._images[index]

    def _coordinates(self, primitive: _Primitive, number: int) -> Float64Array:
        if f"TEXCOORD_{number}" not in primitive.attributes:
            raise ValueError(f"there is no TEXCOORD_{number}")
        return self._values(primitive.attributes[f"TEXCOORD_{number}"], 2)

    def _triangles(
        self, primitive: _Primitive
    ) -> tuple[Float64Array, Int64Array, Callable[[int], Float64Array]] | None:
        """Vertices, triangles, and what gives a set of texture coordinates by its number."""
        if primitive.mode not in (4, 5, 6):
            what = "primitives of points" if primitive.mode == 0 else "primitives of lines"
            self.left_out[what] = self.left_out.get(what, 0) + 1
            return None
        if (draco := primitive.extensions.get("KHR_draco_mesh_compression")) is not None:
            import DracoPy

            decoded = DracoPy.decode(self._view(draco["bufferView"])[0])
            uv = np.zeros((0, 2)) if decoded.tex_coord is None else np.asarray(decoded.tex_coord, np.float64)
            points, corners = np.asarray(decoded.points, np.float64), np.asarray(decoded.faces, np.int64)
            return points, corners, lambda _: uv
        if "POSITION" not in primitive.attributes:
            return None
        vertices = self._values(primitive.attributes["POSITION"], 3)
        coordinates = partial(self._coordinates, primitive)
        if primitive.indices is None:
            corners = np.arange(len(vertices))
        else:
            corners = self._values(primitive.indices, 1)[:, 0].astype(np.int64)
        if primitive.mode == 4:
            return vertices, corners[: len(corners) // 3 * 3].reshape(-1, 3), coordinates
        faces = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=-1)
        if primitive.mode == 5:
            faces[1::2] = faces[1::2, [1, 0, 2]]
        else:
            faces[:, 0] = corners[0]
        return vertices, faces, coordinates

    def _instances(self, node: _Node) -> Iterator[Float64Array]:
        """Transforms of the instances of a node (EXT_mesh_gpu_instancing)."""
        attributes = node.extensions.get("EXT_mesh_gpu_instancing", {}).get("attributes")
        if not attributes:
            yield np.eye(4)
            return
        read = {
            name.lower(): self._values(attributes[name], width)
            for name, width in (("TRANSLATION", 3), ("ROTATION", 4), ("SCALE", 3))
            if name in attributes
        }
        for rows in zip(*read.values(), strict=True):
            given = {name: row.tolist() for name, row in zip(read, rows, strict=True)}
            yield _matrix(msgspec.convert(given, _Node))

    def _values(self, index: int, width: int) -> Float64Array:
        """Numbers of an accessor, Shape ``[count, width]``."""
        accessor: _Accessor = at(self._document.accessors, index, "accessor")
        if _WIDTHS.get(accessor.type) != width or accessor.component_type not in _COMPONENTS:
            raise ValueError(f"accessor {index} has {accessor.type} of type {accessor.component_type}")
        if accessor.sparse is not None or accessor.buffer_view is None:
            raise ValueError(f"accessor {index} is sparse or without data; export it without shape keys")
        kind = np.dtype(_COMPONENTS[accessor.component_type])
        data, stride = self._view(accessor.buffer_view)
        row = kind.itemsize * width
        step = stride or row
        if accessor.count and accessor.byte_offset + step * (accessor.count - 1) + row > len(data):
            raise ValueError(f"accessor {index} of {accessor.count} rows ends after its buffer view")
        shape, steps = (accessor.count, width), (step, kind.itemsize)
        values = np.ndarray(shape, kind, data, accessor.byte_offset, steps).astype(np.float64)
        if accessor.normalized and kind.kind != "f":
            values = np.maximum(values / np.iinfo(kind).max, -1.0)
        return values

    def _view(self, index: int) -> tuple[bytes, int | None]:
        """Bytes of a buffer view, and its stride."""
        view: View = at(self._document.buffer_views, index, "buffer view")
        if view.buffer not in self._buffers:
            buffer = at(self._document.buffers, view.buffer, "buffer")
            self._buffers[view.buffer] = data = self._buffer(buffer)
            if buffer.byte_length > len(data):
                raise ValueError(f"buffer {view.buffer} has {len(data)} bytes, not {buffer.byte_length}")
        data = self._buffers[view.buffer]
        end = view.byte_offset + view.byte_length
        if end > len(data):
            raise ValueError(f"buffer view {index} ends at byte {end}, its buffer at {len(data)}")
        return data[view.byte_offset : end], view.byte_stride

    def _buffer(self, buffer: Buffer) -> bytes:
        if buffer.uri is None:
            return self._binary
        if buffer.uri.startswith("data:"):
            return base64.b64decode(buffer.uri.partition(",")[2], validate=True)
        file = beside(self._folder, buffer.uri, self._where)
        data = contents(file)
        self.files.append(file)
        return data


def _chunks(data: bytes) -> tuple[bytes, bytes]:
    """JSON and binary chunks of a GLB."""
    version, length, first, kind = struct.unpack_from("<3I4s", data, 4)
    if version != 2 or kind != b"JSON":
        raise ValueError(f"a binary glTF of version {version}: 2 is read")
    if length > len(data) or 20 + first > length:
        raise ValueError(
            f"it is cut off: {length} bytes announced, with JSON of {first}, and {len(data)} there"
        )
    text, rest = data[20 : 20 + first], data[20 + first : length]
    if len(rest) < 8:
        return text, b""
    size, kind = struct.unpack_from("<I4s", rest)
    if kind != b"BIN\0":
        return text, b""
    if 8 + size > len(rest):
        raise ValueError(f"it is cut off: a binary chunk of {size} bytes announced, {len(rest) - 8} there")
    return text, rest[8 : 8 + size]


def _matrix(node: _Node) -> Float64Array:
    """Transform of a node: scale, rotation by a quaternion x, y, z, w, translation."""
    if node.matrix is not None:
        return np.reshape(node.matrix, (4, 4)).T.astype(np.float64)
    x, y, z, w = node.rotation
    norm = math.sqrt(x * x + y * y + z * z + w * w) or 1.0
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrix: Float64Array = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn * np.array(node.scale), node.translation
    return matrix


def read_gltf(path: Path, request: Request) -> ImportedScene:
    """Read a ``.glb`` or ``.gltf`` as a scene; see `caviar_space.sources.Reader`."""
    builder = SceneBuilder(path, request)
    data = builder.read(path)
    with reading(path, "glTF 2.0"):
        gltf = Gltf(data, path.parent, str(path))
        for number, surface in enumerate(gltf.surfaces(), 1):
            material = builder.material(surface.material, surface.colour)
            vertices, faces = surface.vertices, surface.faces
            builder.add(surface.name, vertices, faces, material, "object", path, number, surface.texture)
        for file in gltf.files:
            builder.read(file)
        builder.note_left_out(gltf.left_out)
    return builder.finish()
