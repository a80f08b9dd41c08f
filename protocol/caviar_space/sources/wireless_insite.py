"""Projects of Wireless InSite as scenes: geometry, materials, foliage, points and study.

The files `.city`, `.ter`, `.object`, `.veg` and `.txrx` are text with nested blocks ``begin_<TAG> TITLE`` to
``end_<TAG>``; faces are polygons whose materials have numbers that hold within a file. ``.study.xml`` says
which of these files a study uses, and on which frequencies. What a scene cannot hold is a note of it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from caviar_protocol.arrays import MAX_COORDINATE_M, Float64Array
from caviar_protocol.errors import AssetError
from caviar_protocol.space.ply import cut_polygons
from caviar_space.imported_scenes import Georeference, ImportedScene, Piece, source_of
from caviar_space.meshes import Mesh
from caviar_space.mitsuba_xml import RadioMaterial
from caviar_space.sources import Request

KINDS = {".city": "city", ".ter": "terrain", ".object": "object", ".veg": "foliage"}
"""Tag of the outermost block of a file of geometry, which is the kind of its pieces, by suffix."""

_MOST_BYTES = 1 << 28
_MOST_DEPTH = 32
# [S/m]; the largest that reflects as a perfect conductor in the ray tracer's single precision.
_PEC_CONDUCTIVITY = 1e12
# [m] Vertices farther from the plane of their face are said.
_FLAT_M = 0.05
# [°] Between the origins of files: their last digits differ.
_SAME_ORIGIN_DEG = 1e-9


@dataclass(eq=False)
class _Block:
    """A block of a file: its lines with their numbers, and the blocks within."""

    file: Path
    tag: str
    title: str
    line: int
    lines: list[tuple[int, list[str]]] = field(default_factory=list)
    blocks: list[_Block] = field(default_factory=list)

    def error(self, text: str, line: int = 0) -> AssetError:
        return AssetError(f"{self.file}:{line or self.line}: {text}")

    def named(self, tag: str) -> Iterator[_Block]:
        """Blocks of a tag, at any depth."""
        for block in self.blocks:
            if block.tag == tag:
                yield block
            yield from block.named(tag)

    def has(self, key: str) -> bool:
        return any(words[0] == key for _, words in self.lines)

    def number(self, key: str, default: float | None = None, low: float = -math.inf) -> float:
        """Number that follows a key."""
        for line, words in self.lines:
            if words[0] == key:
                return self.numbers(line, words[1:2], 1, low)[0]
        if default is None:
            raise self.error(f"begin_<{self.tag}> lacks {key}; add the line")
        return default

    def count(self, key: str, low: int) -> int:
        value = self.number(key, low=low)
        if value % 1:
            raise self.error(f"{key} is {value:g}; write a whole number")
        return int(value)

    def numbers(self, line: int, words: list[str], count: int, low: float = -math.inf) -> list[float]:
        try:
            found = [float(word) for word in words]
        except ValueError:
            found = []
        if len(found) != count or not all(low <= value < math.inf for value in found):
            least = f" from {low:g}" if low > -math.inf else ""
            raise self.error(f"{' '.join(words)[:60]!r}: write {count} finite number(s){least}", line)
        return found

    def vertices(self, least: int) -> Float64Array:
        """The points below ``nVertices`` [m], Shape ``[N, 3]``."""
        count = self.count("nVertices", least)
        begin = next(i for i, (_, words) in enumerate(self.lines) if words[0] == "nVertices") + 1
        rows = self.lines[begin:]
        # Anything after the vertices begins with a word.
        given = next((i for i, (_, words) in enumerate(rows) if words[0][0].isalpha()), len(rows))
        if given != count:
            raise self.error(
                f"nVertices is {count}, and {given} follow; correct one", self.lines[begin - 1][0]
            )
        points = np.array([self.numbers(line, words, 3) for line, words in rows[:count]])
        if np.abs(points).max() > MAX_COORDINATE_M:
            raise self.error(f"a vertex lies beyond {MAX_COORDINATE_M:g} m; write coordinates in metres")
        return points


def _read(file: Path) -> _Block:
    """Parse a file; the root has no tag."""
    try:
        if file.stat().st_size > _MOST_BYTES:
            raise AssetError(f"{file} has more than {_MOST_BYTES >> 20} MiB; export it in parts")
        data = file.read_bytes()
    except OSError as error:
        raise AssetError(f"cannot read {file}: {error.strerror}") from error
    if b"\0" in data:
        line = data[: data.index(b"\0")].count(b"\n") + 1
        raise AssetError(
            f"{file}:{line}: a zero byte: no text of Wireless InSite; export it as ASCII or UTF-8"
        )
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise AssetError(
            f"{file}:{line}: byte 0x{data[error.start]:02x} is not UTF-8; save it as UTF-8"
        ) from error
    root = _Block(file, "", "", 1)
    stack, at = [root], 1
    for at, row in enumerate(text.split("\n"), 1):
        words = row.strip()
        mark = re.match(r"(begin|end)_<([^<>]+)>(.*)", words)
        if mark is None:
            if words:
                stack[-1].lines.append((at, words.split()))
        elif mark[1] == "begin":
            stack.append(_Block(file, mark[2].strip(), mark[3].strip(), at))
            if len(stack) > _MOST_DEPTH:
                raise stack[-1].error(f"more than {_MOST_DEPTH} blocks within each other; close them")
            stack[-2].blocks.append(stack[-1])
        elif mark[2].strip() != stack[-1].tag:
            opened = f"begin_<{stack[-1].tag}> of line {stack[-1].line}" if stack[1:] else "none"
            raise root.error(f"end_<{mark[2]}> closes a block that is not open, which is: {opened}", at)
        else:
            stack.pop()
    if stack[1:]:
        opened = f"begin_<{stack[-1].tag}> of line {stack[-1].line}"
        raise root.error(f"the file is cut off within {opened}; export it again", at)
    return root


def _outermost(file: Path, tag: str) -> _Block:
    root = _read(file)
    tags = [block.tag for block in root.blocks]
    if tags != [tag]:
        holds = ", ".join(f"begin_<{each}>" for each in tags[:3]) or "no block"
        raise root.error(f"holds {holds}; a file *{file.suffix} holds one begin_<{tag}>: export or rename it")
    return root.blocks[0]


# --- materials ----------------------------------------------------------------------------------------------


def _material(block: _Block, notes: list[str]) -> RadioMaterial:
    """The slab that the channel has for a material."""
    said = f"{block.file.name}:{block.line}: material {block.title!r}"
    constants: tuple[float, float] | None
    kind = next((words[0] for _, words in block.lines if len(words) == 1), "")
    colour = next((w[1:4] for c in block.named("Color") for _, w in c.lines if w[0] == "diffuse"), None)
    rgb: tuple[float, float, float] | None = None
    if colour is not None:
        red, green, blue = (min(part, 1.0) for part in block.numbers(block.line, colour, 3, 0.0))
        rgb = red, green, blue
    scattering = block.number("fields_diffusively_scattered", 0.0, 0.0)
    cross = block.number("cross_polarized_power", 0.0, 0.0)
    if scattering > 1 or cross > 1:
        raise block.error("fields_diffusively_scattered and cross_polarized_power are shares: write 0 to 1")
    model = next(
        (words[1:] for _, words in block.lines if words[0] == "diffuse_scattering_model"), ["lambertian"]
    )
    if scattering and model != ["lambertian"]:
        notes.append(f"{said}: diffuse scattering is Lambertian here, {' '.join(model)!r} there")
    layers = list(block.named("DielectricLayer"))
    rough = max((each.number("roughness", 0.0, 0.0) for each in (block, *layers)), default=0.0)
    if rough:
        notes.append(f"{said}: its roughness of {rough:g} m is left out")
    match kind:
        case "LayeredDielectric":
            if block.count("nLayers", 1) != len(layers):
                raise block.error(
                    f"nLayers is {block.count('nLayers', 1)}, and {len(layers)} follow; correct one"
                )
            slabs = [
                (each.number("permittivity", low=1), each.number("conductivity", low=0)) for each in layers
            ]
            thickness = sum(each.number("thickness", low=0) for each in layers)
            if not thickness > 0:
                raise block.error("its layers have no thickness; write one above 0")
            if len(set(slabs)) > 1:
                notes.append(
                    f"{said}: of its {len(layers)} layers the first stands for all, as thick as they are, "
                    f"{thickness:g} m: the channel has slabs of one layer"
                )
            constants = slabs[0]
        case "PEC":
            constants, thickness = (1.0, _PEC_CONDUCTIVITY), max(block.number("thickness", 0.0, 0.0), 0.1)
            notes.append(f"{said}: a perfect conductor has {_PEC_CONDUCTIVITY:g} S/m here")
        case "Biophysical":
            constants, thickness = None, 0.1  # a volume: it has no faces for the waves
            rgb = rgb or (0.0, 0.25, 0.0)
        case _:
            raise block.error(
                f"material {block.title!r} is of type {kind!r}; give it one of these: "
                "LayeredDielectric, PEC, Biophysical"
            )
    return RadioMaterial(
        thickness_m=thickness,
        colour=rgb,
        constants=constants,
        scattering_coefficient=scattering,
        xpd_coefficient=cross,
    )


def _slug(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")


# --- geometry -----------------------------------------------------------------------------------------------


def _origin(scene: ImportedScene, root: _Block) -> None:
    """Take the origin of a file's coordinates, which is to be that of the others."""
    for reference in root.named("reference"):
        if not reference.has("cartesian"):
            raise reference.error("coordinates are not cartesian; export them so, in metres")
        latitude, longitude = reference.number("latitude"), reference.number("longitude")
        if abs(latitude) > 90 or abs(longitude) > 180:
            raise reference.error(f"latitude {latitude:g}, longitude {longitude:g} is no place; correct it")
        here, known = Georeference(latitude_deg=latitude, longitude_deg=longitude), scene.origin
        if known is None:
            scene.origin = here
        elif max(abs(latitude - known.latitude_deg), abs(longitude - known.longitude_deg)) > _SAME_ORIGIN_DEG:
            raise reference.error(
                f"origin at {latitude:g}, {longitude:g}; files before have {known.latitude_deg:g}, "
                f"{known.longitude_deg:g}: export all with one"
            )


def _add_geometry(scene: ImportedScene, file: Path) -> None:
    kind = KINDS[file.suffix.lower()]
    root = _outermost(file, kind)
    _origin(scene, root)
    materials: dict[int, str] = {}
    for block in root.named("Material"):
        number, made = block.count("Material", 0), _material(block, scene.notes)
        if number in materials:
            raise block.error(f"material {number} is there already; give it a number of its own")
        if (kind == "foliage") != (made.constants is None):
            raise block.error(
                f"material {block.title!r} is of no kind for begin_<{kind}>: foliage is Biophysical"
            )
        name = base = f"insite-{_slug(block.title) or number}"
        while scene.materials.get(name, made) != made:  # one of another file, of the same name
            name = f"{base}-{_slug(file.name)}" if name == base else f"{name}-{number}"
        scene.materials[name], materials[number] = made, name
    used = {
        words[1]
        for face in root.named("face")
        for _, words in face.lines
        if words[0] == "Material" and words[1:]
    }
    faces = 0
    for at, structure in enumerate(root.named("structure"), 1):
        by_material: dict[int, list[_Block]] = {}
        for face in structure.named("face"):
            by_material.setdefault(face.count("Material", 0), []).append(face)
        for number, blocks in by_material.items():
            if number not in materials:
                raise blocks[0].error(f"material {number} is not defined in {file.name}: define it there")
            name = f"{kind}-{_slug(structure.title) or at}" + (f"-{number}" if len(by_material) > 1 else "")
            if name in scene.pieces:
                name = f"{name}-{_slug(file.stem)}-{at}"
            mesh = _mesh(blocks, scene.notes)
            scene.pieces[name] = Piece(mesh, materials[number], kind, file.name, structure.line)
            faces += len(blocks)
    outside = sum(1 for _ in root.named("face")) - faces
    if outside or not faces:
        raise root.error(f"{faces} faces in structures, {outside} outside of any; export the file again")
    unused = sorted(str(number) for number in materials if str(number) not in used)
    if unused:
        scene.notes.append(f"{file.name}: no face is of material {', '.join(unused)}")
    scene.sources.append(source_of(file))


def _mesh(faces: list[_Block], notes: list[str]) -> Mesh:
    """Triangles of polygons; corners at one place are one."""
    polygons = [face.vertices(3) for face in faces]
    for face, points in zip(faces, polygons, strict=True):
        middle = points - points.mean(0)
        _, size, axes = np.linalg.svd(middle, full_matrices=False)
        if size[1] < 1e-6:
            raise face.error("the face has no area; remove it")
        off = float(np.abs(middle @ axes[2]).max())
        if off > _FLAT_M:
            notes.append(
                f"{face.file.name}:{face.line}: the face is not flat, by {off:.2f} m: its triangles are taken"
            )
    corners, place = np.unique(np.concatenate(polygons), axis=0, return_inverse=True)
    sizes = np.array([len(points) for points in polygons])
    triangles = cut_polygons(place.reshape(-1), sizes, corners)
    a, b, c = np.moveaxis(corners[triangles], 1, 0)
    of = np.repeat(np.arange(len(faces)), sizes - 2)
    vectors = np.cross(b - a, c - a)
    whole = np.stack([np.bincount(of, axis, len(faces)) for axis in vectors.T], axis=-1)
    covered = np.bincount(of, np.linalg.norm(vectors, axis=1), len(faces))
    # Triangles of a polygon that crosses itself overlap.
    crossing = np.flatnonzero(covered > 1.01 * np.linalg.norm(whole, axis=1) + 1e-6)
    if len(crossing):
        raise faces[crossing[0]].error(
            "the outline of the face crosses itself; mend the order of its vertices"
        )
    return Mesh(corners, triangles.astype(np.int32))


# --- points and study ---------------------------------------------------------------------------------------


def _add_points(scene: ImportedScene, file: Path) -> None:
    root = _read(file)
    for block in root.blocks:
        if block.tag != "points":
            scene.notes.append(
                f"{file.name}:{block.line}: begin_<{block.tag}> is left out: points alone are read"
            )
            continue
        if ["inactive"] in (words for _, words in block.lines):
            scene.notes.append(f"{file.name}:{block.line}: {block.title!r} is inactive: left out")
            continue
        _origin(scene, block)
        _note_transmitter(scene, file, block)
        places = [location.vertices(1) for location in block.named("location")]
        if len(places) != 1:
            raise block.error("points have one begin_<location>; export the file again")
        roles = {
            role
            for role in ("transmitter", "receiver")
            if ["is_" + role, "yes"] in (w for _, w in block.lines)
        }
        if not roles:
            raise block.error("points neither send nor receive; write is_transmitter yes or is_receiver yes")
        if len(roles) == 2:
            scene.notes.append(
                f"{file.name}:{block.line}: {block.title!r} sends and receives: a transmitter and a receiver "
                "stand at one place; give their device the role both in the scenario"
            )
        for role, known in (("transmitter", scene.transmitters_m), ("receiver", scene.receivers_m)):
            known += [(float(x), float(y), float(z)) for x, y, z in places[0]] if role in roles else []
    if not root.blocks:
        raise root.error("holds no points; export it from Wireless InSite, or remove it")
    scene.sources.append(source_of(file))


def _note_transmitter(scene: ImportedScene, file: Path, block: _Block) -> None:
    """Say what a transmitter's power and pattern are, where the scenarios have others."""
    for sender in block.named("transmitter"):
        power = sender.number("power", 0.0)
        turns = [p.number(f"rotation_{axis}", 0.0) for p in sender.named("pattern") for axis in "xyz"]
        turn = max(turns, default=0.0, key=abs)
        for what, value, key in (("power", power, "power_dbm"), ("rotation", turn, "yaw_deg")):
            if value:
                scene.notes.append(
                    f"{file.name}:{sender.line}: the {what} {value:g} is not taken: set {key} in the scenario"
                )


def _add_study(scene: ImportedScene, file: Path) -> list[str]:
    """Take frequencies and foliage's model of a study; the files of geometry that it names."""
    try:
        text = file.read_text("utf-8")
        # The document type that InSite writes names nothing; entities may expand to gigabytes.
        if "<!ENTITY" in text:
            raise AssetError(f"{file}: an entity is declared; remove it")
        root = ElementTree.fromstring(text)  # noqa: S314
    except ElementTree.ParseError as error:
        raise AssetError(f"{file}:{error.position[0]}: {error}; export the study again") from error
    except UnicodeDecodeError as error:
        raise AssetError(f"{file}: {error}; save it as UTF-8") from error
    except OSError as error:
        raise AssetError(f"cannot read {file}: {error.strerror}") from error
    if root.tag != "InSite":
        raise AssetError(f"{file}:1: <{root.tag}> is no study of Wireless InSite; name the .study.xml")
    values = {
        path: [value.get("Value", "") for value in root.iterfind(f".//{path}")]
        for path in (
            "CarrierFrequency/remcom__rxapi__Double",
            "FoliageModel/remcom__rxapi__FoliageModelEnum",
            "Geometry//remcom__rxapi__FileDescription/Filename/remcom__rxapi__String",
        )
    }
    frequencies, models, files = values.values()
    try:
        scene.frequencies_hz = sorted({float(value) for value in frequencies})
    except ValueError:
        scene.frequencies_hz = [math.nan]
    if not all(0 < frequency < math.inf for frequency in scene.frequencies_hz):
        raise AssetError(
            f"{file}: CarrierFrequency {', '.join(frequencies)[:60]}: write numbers above 0 [Hz]"
        )
    scene.without_foliage_loss = models == ["None"]
    if not files:
        raise AssetError(f"{file}: the study names no file of geometry; export it again")
    scene.sources.append(source_of(file))
    return files


def read_project(path: Path, request: Request) -> ImportedScene:
    """Read a project of Wireless InSite.

    Args:
        path: Folder of the project, with at most one ``.study.xml``, a study, or one file of geometry.
        request: Of which progress is called with the file that comes next.

    Raises:
        AssetError: A file is missing or wrong; names file, line and remedy.
    """
    folder = path if path.is_dir() else path.parent
    scene = ImportedScene(name=_slug(path.resolve().name.split(".")[0]) or "scene")
    studies = sorted(folder.glob("*.study.xml")) if path.is_dir() else [path] if path.suffix == ".xml" else []
    if len(studies) > 1:
        raise AssetError(f"{path} has studies {', '.join(s.name for s in studies)}; name one: {studies[0]}")
    there = sorted(file for file in folder.iterdir() if file.suffix.lower() in KINDS)
    if studies:
        # Windows, on which projects are made, takes names for equal whatever their case.
        known = {file.name.lower(): file.name for file in folder.iterdir()}
        listed = (Path(name.replace("\\", "/")) for name in _add_study(scene, studies[0]))
        named = [
            (folder / name.with_name(known.get(name.name.lower(), name.name))).resolve() for name in listed
        ]
        for file in named:
            if not file.is_file():
                scene.notes.append(f"{studies[0].name} names {file.name}, which is not there: left out")
        files = [file for file in named if file.is_file() and file.suffix.lower() in KINDS]
        scene.notes += [
            f"{file.name} is there, and {studies[0].name} does not name it: left out"
            for file in there
            if file.resolve() not in named
        ]
        points = [folder / f"{studies[0].name.removesuffix('.study.xml')}.txrx"]
    else:
        files, points = there if path.is_dir() else [path], sorted(folder.glob("*.txrx"))
    if not files or not all(file.suffix.lower() in KINDS for file in files):
        raise AssetError(f"{path} has no geometry of Wireless InSite: {', '.join(KINDS)}, or a .study.xml")
    points = [file for file in points if file.is_file()] if path.suffix.lower() not in KINDS else []
    sizes = [file.stat().st_size if file.is_file() else 0 for file in (*files, *points)]
    for number, file in enumerate((*files, *points)):
        request.progress(file.name, sum(sizes[:number]) / max(sum(sizes), 1))
        (_add_geometry if file.suffix.lower() in KINDS else _add_points)(scene, file)
    ground = [piece.mesh.vertices[:, 2] for piece in scene.pieces.values() if piece.kind == "terrain"]
    if ground and max(float(np.abs(z).max()) for z in ground) > 0.01:
        scene.notes.append(
            "the terrain is not level at 0: what stands on it in InSite has the heights of its file here"
        )
    request.progress("", 1.0)
    return scene
