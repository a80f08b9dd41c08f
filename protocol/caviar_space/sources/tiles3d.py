"""3D Tiles 1.0 and 1.1: the tiles of one level of detail, from the Earth's axes into those of a scene.

Open Geospatial Consortium, "3D Tiles Specification 1.1", 22-025r4. Explicit and implicit tiling, external
tilesets, contents of b3dm, cmpt and glTF. All positions are in float64: at the Earth's radius float32 has
steps of half a metre.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import AssetError
from caviar_space.imported_scenes import Georeference, ImportedScene, box_in_metres
from caviar_space.sources import Request
from caviar_space.sources.gltf import Buffer, Gltf, Index, Part, View
from caviar_space.sources.pieces import Y_UP, SceneBuilder, at, beside, contents, moved, reading

_MOST_TILES = 20_000
# [m] from the Earth's centre, of places on it.
_EARTH_M = (6.2e6, 6.6e6)
_WGS84 = "EPSG:4979"
_ECEF = "EPSG:4978"


class _Content(Part, frozen=True):
    uri: str = ""
    url: str = ""
    """Its name before 1.0."""


class _Volume(Part, frozen=True):
    box: list[float] | None = None
    region: list[float] | None = None
    sphere: list[float] | None = None


class _Uri(Part, frozen=True):
    uri: str


class _Implicit(Part, frozen=True):
    subdivision_scheme: str
    subtree_levels: Annotated[int, msgspec.Meta(ge=1, le=20)]
    available_levels: Annotated[int, msgspec.Meta(ge=1, le=60)]
    subtrees: _Uri


class _Tile(msgspec.Struct, frozen=True, rename="camel"):
    geometric_error: float
    bounding_volume: _Volume = _Volume()
    refine: str = ""
    content: _Content | None = None
    contents: list[_Content] = []
    children: list[_Tile] = []
    transform: list[float] | None = None
    implicit_tiling: _Implicit | None = None


class _Asset(Part, frozen=True):
    version: str
    gltf_up_axis: str = "Y"


class _Tileset(Part, frozen=True):
    asset: _Asset
    root: _Tile


class _Availability(Part, frozen=True):
    constant: int | None = None
    bitstream: Index | None = None
    buffer_view: Index | None = None
    """Name of the bitstream in drafts of 1.1."""


class _SubtreeHead(msgspec.Struct, frozen=True, rename="camel"):
    tile_availability: _Availability
    child_subtree_availability: _Availability
    content_availability: list[_Availability] = []
    buffers: list[Buffer] = []
    buffer_views: list[View] = []


@dataclass(frozen=True)
class _Node:
    """A tile of explicit or implicit tiling."""

    uris: tuple[str, ...]
    error: float
    adds: bool
    """Whether its content stays beside that of its children."""
    matrix: Float64Array
    children: Callable[[], list[_Node]]
    chain: tuple[Path, ...]
    """Tilesets, from the outermost to the tile's."""
    turn: Float64Array
    """From the axes of its glTF into those of the tile, Shape ``[4, 4]``."""
    volume: _Volume

    def file(self, uri: str) -> Path:
        """Find a file that its tileset names; all lie below the folder of the outermost one."""
        return beside(self.chain[-1].parent, uri, self.chain[-1], self.chain[0].parent)

    def corners(self) -> Float64Array:
        """Corners around it, in the Earth's axes or those of the tileset [m], Shape ``[8, 3]``."""
        signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
        volume = self.volume
        if volume.region is not None:
            west, south, east, north, low, high = volume.region
            east += 2 * math.pi if east < west else 0.0
            halves = np.array([east - west, north - south, high - low]) / 2
            places = np.array([west + east, south + north, low + high]) / 2 + signs * halves
            longitudes, latitudes = np.degrees(places[:, :2].T)
            earth = _between(_WGS84, _ECEF).transform(longitudes, latitudes, places[:, 2])
            return np.stack(earth, axis=-1)
        if volume.box is not None:
            numbers = np.array(volume.box)
            corners = numbers[:3] + signs @ numbers[3:].reshape(3, 3)
        else:
            x, y, z, radius = volume.sphere or (0.0, 0.0, 0.0, math.inf)
            corners = np.array([x, y, z]) + signs * radius
        placed: Float64Array = corners @ self.matrix[:3, :3].T + self.matrix[:3, 3]
        return placed


@dataclass
class _Walk:
    """Search for the contents of one level of detail."""

    error_m: float
    within: Callable[[_Node], bool]
    """Whether something of a tile may be in what is asked for."""
    chosen: list[tuple[Path, _Node]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    tiles: int = 0

    def choose(self, node: _Node) -> bool:
        """Take the contents of a tile, or of those below it that are finer; False where a file is missing."""
        self.tiles += 1
        if self.tiles > _MOST_TILES:
            raise AssetError(
                f"{node.chain[0]} has more than {_MOST_TILES} tiles; ask for a box or a larger error"
            )
        if not self.within(node):
            return True
        files, outer = [], list[_Node]()
        for uri in node.uris:
            file = node.file(uri)
            if file.is_file() and _is_tileset(file):
                outer.append(_root(file, node))
            else:
                files.append(file)
        children = outer
        if not 0 < node.error <= self.error_m:
            children = outer + node.children()
        before = len(self.chosen)
        whole = not [child for child in children if not self.choose(child)]
        missing = [file for file in files if not file.is_file()]
        if children and whole and not node.adds:
            return True
        if children and not whole and not node.adds and files and not missing:
            del self.chosen[before:]  # tiles of two levels would overlap
            self.notes.append(f"{files[0].name} stands for finer tiles that are not there")
            whole = True
        self.chosen += [(file, node) for file in files if file not in missing]
        self.notes += [f"{node.chain[-1].name} names {file.name}, which is not there" for file in missing]
        return whole and not missing


def _is_tileset(file: Path) -> bool:
    with file.open("rb") as opened:
        return file.suffix.lower() != ".gltf" and opened.read(64).lstrip()[:1] == b"{"


_ABOVE = _Node((), 0.0, False, np.eye(4), list, (), Y_UP, _Volume())


def _root(file: Path, above: _Node) -> _Node:
    """Open a tileset."""
    if file.resolve() in (each.resolve() for each in above.chain):
        raise AssetError(
            f"{file} names itself, by way of {above.chain[-1].name}; take out the loop of tilesets"
        )
    with reading(file, "a tileset of 3D Tiles"):
        tileset = msgspec.json.decode(contents(file), type=_Tileset)
        turn = {"Y": Y_UP, "Z": np.eye(4)}[tileset.asset.gltf_up_axis.upper()]
        return _explicit(tileset.root, replace(above, chain=(*above.chain, file), turn=turn))


def _explicit(tile: _Tile, above: _Node) -> _Node:
    matrix = np.reshape(tile.transform, (4, 4)).T if tile.transform is not None else np.eye(4)
    found = [*tile.contents, *([tile.content] if tile.content else [])]
    node = replace(
        above,
        uris=tuple(each.uri or each.url for each in found),
        error=tile.geometric_error,
        adds=tile.refine.upper() == "ADD" if tile.refine else above.adds,
        matrix=above.matrix @ matrix,
        children=lambda: [_explicit(child, node) for child in tile.children],
        volume=tile.bounding_volume,
    )
    return node if tile.implicit_tiling is None else _ImplicitTiles(tile.implicit_tiling, node).root()


@dataclass(frozen=True)
class _ImplicitTiles:
    """Tiles of a quadtree or an octree, of which subtrees say which are there."""

    tiling: _Implicit
    above: _Node
    """The tile that they divide, with templates of URIs."""

    @property
    def axes(self) -> int:
        return {"QUADTREE": 2, "OCTREE": 3}[self.tiling.subdivision_scheme]

    def root(self) -> _Node:
        place = (0,) * self.axes
        return self.node(_Subtree(self, 0, place), 0, place)

    def name(self, template: str, level: int, place: tuple[int, ...]) -> str:
        """Put level and place into a template of URIs."""
        values = {"level": level, **dict(zip("xyz", place, strict=False))}
        return re.sub(r"\{(level|x|y|z)\}", lambda found: str(values[found[1]]), template)

    def part(self, level: int, place: tuple[int, ...]) -> _Volume:
        """Volume of a tile."""
        parts = np.array([2.0**level] * self.axes + [1.0] * (3 - self.axes))
        corner = np.array([*place, 0.0][:3])
        whole = self.above.volume
        if whole.region is not None:
            region = np.array(whole.region)
            low, high = region[[0, 1, 4]], region[[2, 3, 5]]
            size = (high - low) / parts
            (west, south, bottom), (east, north, top) = low + corner * size, low + (corner + 1) * size
            return _Volume(region=[west, south, east, north, bottom, top])
        if whole.box is None:
            return whole
        numbers = np.array(whole.box)
        halves = numbers[3:].reshape(3, 3)
        centre = numbers[:3] + ((2 * corner + 1) / parts - 1) @ halves
        return _Volume(box=[*centre, *(halves / parts[:, None]).reshape(-1)])

    def node(self, subtree: _Subtree, level: int, place: tuple[int, ...]) -> _Node:
        index = subtree.index(level, place)
        uris = tuple(
            self.name(template, level, place)
            for template, availability in zip(self.above.uris, subtree.head.content_availability, strict=True)
            if subtree.has(availability, index)
        )
        return replace(
            self.above,
            uris=uris,
            error=self.above.error / 2**level,
            children=lambda: self.children(subtree, level, place),
            volume=self.part(level, place),
        )

    def children(self, subtree: _Subtree, level: int, place: tuple[int, ...]) -> list[_Node]:
        below = level + 1
        if below >= self.tiling.available_levels:
            return []
        places = [
            tuple(2 * at + (number >> axis & 1) for axis, at in enumerate(place))
            for number in range(2**self.axes)
        ]
        inner = below - subtree.level < self.tiling.subtree_levels
        there = subtree.head.tile_availability if inner else subtree.head.child_subtree_availability
        first = 0 if inner else subtree.first(below)
        return [
            self.node(subtree if inner else _Subtree(self, below, each), below, each)
            for each in places
            if subtree.has(there, subtree.index(below, each) - first)
        ]


class _Subtree:
    """Bits that say which tiles, contents and subtrees are there, of some levels below a tile."""

    def __init__(self, tiles: _ImplicitTiles, level: int, place: tuple[int, ...]) -> None:
        self.level = level
        self._place, self._axes = place, tiles.axes
        file = tiles.above.file(tiles.name(tiles.tiling.subtrees.uri, level, place))
        with reading(file, "a subtree of 3D Tiles"):
            text, binary = data = contents(file), b""
            if text[:4] == b"subt":
                version, first, second = struct.unpack_from("<IQQ", data[0], 4)
                if version != 1 or 24 + first + second > len(text):
                    raise ValueError(
                        f"version {version}, JSON of {first} and binary of {second} bytes announced, "
                        f"{len(text)} there"
                    )
                text, binary = text[24 : 24 + first], text[24 + first : 24 + first + second]
            self.head, top = msgspec.json.decode(text, type=_SubtreeHead), tiles.above.chain[0].parent
            buffers = [
                contents(beside(file.parent, buffer.uri, file, top)) if buffer.uri else binary
                for buffer in self.head.buffers
            ]
            self._views = [
                at(buffers, view.buffer, "buffer")[view.byte_offset : view.byte_offset + view.byte_length]
                for view in self.head.buffer_views
            ]
            if len(self.head.content_availability) not in (0, len(tiles.above.uris)):
                raise ValueError(
                    f"contentAvailability is of {len(self.head.content_availability)} contents, the tileset "
                    f"has {len(tiles.above.uris)}"
                )
        self._where = file

    def first(self, level: int) -> int:
        """Count of tiles in the levels of the subtree above one."""
        return ((1 << self._axes * (level - self.level)) - 1) // ((1 << self._axes) - 1)

    def index(self, level: int, place: tuple[int, ...]) -> int:
        """Number of a tile in its subtree: by level, and within one in the order of G. M. Morton."""
        deep, morton = level - self.level, 0
        for bit in range(deep):
            for axis, (value, begin) in enumerate(zip(place, self._place, strict=True)):
                morton |= ((value - (begin << deep)) >> bit & 1) << (bit * self._axes + axis)
        return self.first(level) + morton

    def has(self, availability: _Availability, index: int) -> bool:
        """Whether a bit is set."""
        if availability.constant is not None:
            return availability.constant == 1
        view = availability.bitstream if availability.bitstream is not None else availability.buffer_view
        with reading(self._where, "a subtree of 3D Tiles"):
            bits = at(self._views, -1 if view is None else view, "bitstream")
            return bool(at(bits, index // 8, "byte of bits") >> index % 8 & 1)


def _models(data: bytes, left_out: dict[str, int]) -> Iterator[tuple[bytes, Float64Array]]:
    """glTF in a content, and the transform that its tile's format adds."""
    magic = data[:4]
    if magic == b"glTF" or data[:1] == b"{":
        yield data, np.eye(4)
        return
    if magic not in (b"b3dm", b"cmpt"):
        known = {b"pnts": "contents of points", b"i3dm": "contents of instances (i3dm)"}
        if magic not in known:
            raise ValueError(f"it begins with {magic!r}: b3dm, cmpt and glTF are read")
        left_out[known[magic]] = left_out.get(known[magic], 0) + 1
        return
    version, length = struct.unpack_from("<2I", data, 4)
    if version != 1 or length > len(data):
        raise ValueError(f"version {version}, {length} bytes announced, {len(data)} there")
    if magic == b"cmpt":
        (count,), begin = struct.unpack_from("<I", data, 12), 16
        for _ in range(count):
            (size,) = struct.unpack_from("<I", data, begin + 8)
            if size < 16 or begin + size > length:
                raise ValueError(f"an inner tile of {size} bytes at byte {begin} of {length}")
            yield from _models(data[begin : begin + size], left_out)
            begin += size
        return
    sizes = struct.unpack_from("<4I", data, 12)
    if 28 + sum(sizes) > length:
        raise ValueError(f"tables of {sum(sizes)} bytes announced, {length - 28} there")
    table = msgspec.json.decode(data[28 : 28 + sizes[0]] or b"{}", type=dict[str, Any])
    matrix = np.eye(4)
    if "RTC_CENTER" in table:
        matrix[:3, 3] = msgspec.convert(table["RTC_CENTER"], tuple[float, float, float])
    yield data[28 + sum(sizes) : length], matrix


def read_tileset(path: Path, request: Request) -> ImportedScene:
    """Read a tileset as a scene; see `caviar_space.sources.Reader`.

    Its origin is at the bottom of the root's volume, in its middle, and its axes are east, north and up
    there. A tileset that is not on the Earth keeps its axes.
    """
    builder = SceneBuilder(path, request)
    builder.read(path)
    left_out: dict[str, int] = {}
    with reading(path, "a tileset of 3D Tiles"):
        root = _root(path, _ABOVE)
        origin = _origin(root)
        walk = _Walk(request.error_m, _within(request, origin))
        walk.choose(root)
    builder.scene.notes += dict.fromkeys(walk.notes)
    to_scene: Callable[[Float64Array], Float64Array] | None = None
    for number, (file, node) in enumerate(walk.chosen, 1):
        request.progress(file.name, number / len(walk.chosen))
        data = builder.read(file)
        with reading(file, "a content of 3D Tiles"):
            for model, matrix in _models(data, left_out):
                gltf = Gltf(model, file.parent, str(file))
                for surface in gltf.surfaces(node.turn):
                    vertices, faces = moved(node.matrix @ matrix, surface.vertices, surface.faces)
                    to_scene = to_scene or _conversion(builder, origin, vertices)
                    material = builder.material(surface.material, surface.colour)
                    name = f"{file.stem}-{surface.name}"
                    points, texture = to_scene(vertices), surface.texture
                    builder.add(name, points, faces, material, "tile", file, number, texture)
                for what, count in gltf.left_out.items():
                    left_out[what] = left_out.get(what, 0) + count
    builder.note_left_out(left_out)
    return builder.finish()


@cache
def _between(source: str, target: str) -> Any:
    from pyproj import Transformer

    return Transformer.from_crs(source, target, always_xy=True)


def _within(request: Request, origin: Georeference | None) -> Callable[[_Node], bool]:
    """Test whether tiles reach into the box that is asked for: of a country's tiles no others are opened."""
    there = request.origin or origin
    box = request.box_m
    if request.box_deg is not None and there is not None:
        box = box_in_metres(request.box_deg, there)
    if box is None:
        return lambda node: True
    to_scene = _to_scene(there) if origin is not None and there is not None else lambda points: points
    low, high = np.array(box[:2]), np.array(box[2:])

    def within(node: _Node) -> bool:
        corners = to_scene(node.corners())[:, :2]
        # A tile without a volume may be anywhere.
        return not np.isfinite(corners).all() or bool(
            ((corners.min(0) <= high) & (corners.max(0) >= low)).all()
        )

    return within


def _to_scene(origin: Georeference) -> Callable[[Float64Array], Float64Array]:
    return lambda points: origin.places(np.stack(_between(_ECEF, _WGS84).transform(*points.T), axis=-1))


def _origin(root: _Node) -> Georeference | None:
    """Place at the bottom of the root's volume, in its middle; None: that is not on the Earth."""
    corners = root.corners()
    if root.volume.region is not None:
        west, south, east, north, low, _ = root.volume.region
        east += 2 * math.pi if east < west else 0.0
        longitude, latitude = math.degrees((west + east) / 2), math.degrees((south + north) / 2)
    elif _on_earth(centre := corners.mean(0)):
        longitude, latitude, _ = _between(_ECEF, _WGS84).transform(*centre)
        there = Georeference(latitude_deg=latitude, longitude_deg=longitude)
        low = float(_to_scene(there)(corners)[:, 2].min())
    else:
        return None
    return Georeference(
        latitude_deg=round(latitude, 7),
        longitude_deg=round((longitude + 180) % 360 - 180, 7),
        altitude_m=round(low, 3) + 0.0,
    )


def _on_earth(point: Float64Array) -> bool:
    return bool(_EARTH_M[0] < np.linalg.norm(point) < _EARTH_M[1])


def _conversion(
    builder: SceneBuilder, origin: Georeference | None, vertices: Float64Array
) -> Callable[[Float64Array], Float64Array]:
    """Conversion of the tileset's coordinates, such as these, into those of the scene; sets its origin."""
    middle = np.median(vertices, axis=0) if len(vertices) else np.zeros(3)
    if not _on_earth(middle):
        builder.scene.notes.append(
            "the tileset is not on the Earth: its axes are taken as east, north and up"
        )
        return lambda points: points
    if origin is None:  # its volume is the whole Earth's
        longitude, latitude, _ = _between(_ECEF, _WGS84).transform(*middle)
        origin = Georeference(latitude_deg=round(latitude, 7), longitude_deg=round(longitude, 7))
    builder.scene.origin = builder.request.origin or origin
    return _to_scene(builder.scene.origin)
