"""Scenery as a world announces it: a scene description in XML and the meshes it names.

The description is that of Mitsuba and Sionna RT. Renderers know only the materials of their own
variant, and name no file or line of the user's in their errors, so it is read here as plain XML: which
meshes there are, where they stand, and of which material of Recommendation ITU-R P.2040 they are. The ray
tracer is given triangles, and its materials one by one (`RadioBsdf`); the description itself it never sees.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import NamedTuple
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_protocol.assets import ITU_MATERIALS as ITU_MATERIALS
from caviar_protocol.errors import AssetError, suggestion
from caviar_protocol.space.ply import read_ply
from caviar_space.meshes import Mesh, ply


class RadioBsdf(NamedTuple):
    """A material that the ray tracer has constants of."""

    name: str
    """Its id without a leading ``mat-``; without Blender's number, unless the file gives the copy other
    properties than the original."""
    xml: str
    """Mitsuba's element, without colours."""
    place: str
    """Where it stands, for messages: file, line and id."""


@dataclass(frozen=True, eq=False)
class SceneryShape:
    """One mesh of the scenery."""

    name: str
    """Id in the description without a leading ``mesh-``; unique."""
    file: Path
    """The PLY mesh."""
    to_world: Float64Array
    """Homogeneous transform of the mesh's vertices [m], Shape ``[4, 4]``."""
    material: str
    """Id of its material in the description; empty where it has none."""
    itu_material: str
    """Name of that material in ITU-R P.2040 (``concrete``); empty where it is not one of those."""
    colour: tuple[float, float, float] | None = None
    """Linear sRGB, 0…1, that the description gives its material; None where it gives none."""
    material_type: str = ""
    """Type of that material in the description (``diffuse``); empty where it has none."""
    place: str = ""
    """Where it stands, for messages: file, line and name."""
    radio: RadioBsdf | None = None
    """Its material for radio waves; None where it has no constants."""
    kind: str = "ply"
    """Type of the shape; ``rectangle`` and ``cube`` have the description in place of a mesh."""


@dataclass(frozen=True)
class Scenery:
    """Content of a description, in its order."""

    file: Path
    shapes: tuple[SceneryShape, ...]
    files: Mapping[str, str]
    """Every file that the description names, textures too, relative to its folder; with the place that names
    it, for messages."""


def world_mesh(shape: SceneryShape) -> Mesh:
    """Read the mesh of a shape.

    Args:
        shape: A shape of the scenery.

    Returns:
        Its triangles in world coordinates [m], in the precision of the file.

    Raises:
        AssetError: The file is no mesh, or a vertex is not finite; names the shape.
    """
    return transformed_mesh(shape.file, shape.to_world, f"{shape.place}: mesh {shape.file.name}")


def transformed_mesh(file: Path, to_world: Float64Array, called: str = "") -> Mesh:
    """Read a PLY mesh in world coordinates.

    Args:
        file: The mesh.
        to_world: Homogeneous transform of its vertices [m], Shape ``[4, 4]``.
        called: What errors call it; by default the file.

    Raises:
        AssetError: The file is no mesh, or a vertex is not finite.
    """
    vertices, faces = read_ply(file, called)
    return Mesh(vertices @ to_world[:3, :3].T + to_world[:3, 3], faces.astype(np.int32))


class RadioMaterial(NamedTuple):
    """A material of scenery that a world makes in memory."""

    itu_material: str = ""
    """Its name in ITU-R P.2040: ``concrete``; empty where it has ``constants``, or is for cameras alone."""
    thickness_m: float = 0.2
    """[m]"""
    colour: tuple[float, float, float] | None = None
    """Linear sRGB, 0…1, as cameras see it; None: as its material looks."""
    constants: tuple[float, float] | None = None
    """Relative permittivity and conductivity [S/m], the same on each carrier; None: those of ITU-R P.2040."""
    scattering_coefficient: float = 0.0
    """Share of the reflected amplitude that is scattered, 0…1."""
    xpd_coefficient: float = 0.0
    """Share of the scattered power in the other polarization, 0…1."""


def scenery_files(
    name: str, shapes: Mapping[str, tuple[Mesh, str]], materials: Mapping[str, RadioMaterial]
) -> dict[str, bytes]:
    """Make a scene description of meshes, and their files.

    Args:
        name: Of the description.
        shapes: Mesh in world axes [m], and name of its material, by name of the shape.
        materials: By name.

    Returns:
        Content by asset name, for `Service.scenery`.

    Raises:
        AssetError: ITU-R P.2040 has no such material, a thickness is not above 0, or a shape names a material
            that is not there.

    Example:
        >>> from caviar_space.meshes import unit_box
        >>> list(scenery_files("town", {"house": (unit_box(), "wall")}, {"wall": RadioMaterial("brick")}))
        ['scenery/town.xml', 'scenery/meshes/house.ply']
    """
    from xml.sax.saxutils import quoteattr  # with urllib, a tenth of what a world loads

    lines = ['<scene version="2.1.0">']
    for key, material in materials.items():
        cameras = material.constants is None and not material.itu_material and material.colour is not None
        if material.constants is None and not cameras and material.itu_material not in ITU_MATERIALS:
            raise AssetError(
                f"material {key!r}: ITU-R P.2040 has no material {material.itu_material!r}; "
                f"{suggestion(material.itu_material, ITU_MATERIALS)}"
            )
        if not 0 < material.thickness_m < math.inf:
            raise AssetError(
                f"material {key!r}: a thickness of {material.thickness_m:g} m; write one above 0"
            )
        permittivity, conductivity = material.constants or (1.0, 0.0)
        shares = material.scattering_coefficient, material.xpd_coefficient
        if not (
            0 < permittivity < math.inf
            and 0 <= conductivity < math.inf
            and 0 <= min(shares) <= max(shares) <= 1
        ):
            raise AssetError(
                f"material {key!r}: permittivity {permittivity:g}, conductivity {conductivity:g} S/m, shares "
                f"scattered and cross-polarised {shares}; write above 0, from 0, and from 0 to 1"
            )
        numbers = {"thickness": material.thickness_m}
        if cameras:
            lines.append(f'  <bsdf type="diffuse" id={quoteattr(key)}>')
            numbers = {}
        elif material.constants is None:
            lines.append(f'  <bsdf type="itu-radio-material" id={quoteattr(key)}>')
            lines.append(f'    <string name="type" value="{material.itu_material}"/>')
        else:
            lines.append(f'  <bsdf type="radio-material" id={quoteattr(key)}>')
            numbers["relative_permittivity"], numbers["conductivity"] = material.constants
        for number in ("scattering_coefficient", "xpd_coefficient"):
            if value := getattr(material, number):
                numbers[number] = value
        lines += [f'    <float name="{name}" value="{value:.9g}"/>' for name, value in numbers.items()]
        if material.colour is not None:
            red, green, blue = material.colour
            colour = "reflectance" if cameras else "color"
            lines.append(f'    <rgb name="{colour}" value="{red:.6f} {green:.6f} {blue:.6f}"/>')
        lines.append("  </bsdf>")
    for shape, (_, key) in shapes.items():
        if key not in materials:
            example = f'give {{{key!r}: RadioMaterial("concrete")}}'
            remedy = suggestion(key, materials) if materials else example
            raise AssetError(f"shape {shape!r}: there is no material {key!r}; {remedy}")
        lines += [
            f'  <shape type="ply" id={quoteattr(f"mesh-{shape}")}>',
            f'    <string name="filename" value={quoteattr(f"meshes/{shape}.ply")}/>',
            '    <boolean name="face_normals" value="true"/>',
            f'    <ref id={quoteattr(key)} name="bsdf"/>',
            "  </shape>",
        ]
    meshes = {f"scenery/meshes/{shape}.ply": ply(mesh) for shape, (mesh, _) in shapes.items()}
    return {f"scenery/{name}.xml": "\n".join([*lines, "</scene>", ""]).encode(), **meshes}


def find_scenery(assets: Mapping[str, Path]) -> Path | None:
    """Find the scene description among the assets of a run (``scenery/*.xml``); None where there is none.

    Args:
        assets: Files by name.

    Raises:
        AssetError: There are several; names them.

    Example:
        >>> find_scenery({"scenery/town.xml": Path("town.xml"), "objects/car.ply": Path("car.ply")}).name
        'town.xml'
    """
    found = sorted(name for name in assets if PurePosixPath(name).match("scenery/*.xml"))
    if len(found) > 1:
        raise AssetError(
            f"the run has {len(found)} scene descriptions, {', '.join(found)}; let one world bring one"
        )
    return assets[found[0]] if found else None


def asset_name(description: Path | None) -> str:
    """Name that errors give a description from another service: its file is a copy in a cache.

    Args:
        description: None: there is none.
    """
    return f"scenery/{description.name}" if description else "the empty scene"


def read_scenery(file: Path, called: str = "", kinds: Sequence[str] = ("ply",)) -> Scenery:
    """Read a scene description; every mesh it names lies in its folder or below.

    Args:
        file: The description.
        called: What errors call the file, where its path would mean nothing to the user: a copy.
        kinds: Types of shapes that are read.

    Raises:
        AssetError: The XML is broken, a shape is of another type, a mesh is missing, an id
            occurs twice, a name is that of two different materials, or ITU-R P.2040 has no such material;
            names file, line, shape or material, and the remedy.
    """
    called = called or str(file)
    root, lines = _parse(file, called)
    _check_ids(called, root, lines)
    _fill_in_defaults(called, root, lines)
    files = _files(called, root, lines)
    materials = {b.get("id", ""): b for b in root.findall("bsdf")}
    radio = _radio_bsdfs(called, root, lines)
    shapes: dict[str, SceneryShape] = {}
    for element in root.findall("shape"):
        given = element.get("id") or element.get("name") or ""
        where = f"{called}:{lines[element]}: shape {given!r}"
        shape = _shape(where, file, element, materials, radio, kinds)
        if shape.name in shapes:
            raise AssetError(
                f"{where}: another shape is named {shape.name!r}, too; give each an id of its own"
            )
        shapes[shape.name] = shape
    return Scenery(file, tuple(shapes.values()), files)


# Line of each element's start tag, from 1.
_Lines = Mapping[ElementTree.Element, int]


def _parse(file: Path, called: str) -> tuple[ElementTree.Element, _Lines]:
    """The root element; document types, and with them entities, are refused before any is expanded."""
    builder, lines = ElementTree.TreeBuilder(), dict[ElementTree.Element, int]()
    # Expat itself, because elements of ElementTree's parser do not know their lines.
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        lines[builder.start(tag, attributes)] = parser.CurrentLineNumber

    # A few nested entities expand to gigabytes.
    def doctype(name: str, *_: object) -> None:
        raise AssetError(
            f"{called}:{parser.CurrentLineNumber}: document type {name!r} is refused; remove "
            "the <!DOCTYPE …> declaration"
        )

    parser.StartElementHandler, parser.EndElementHandler = start, builder.end
    parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = builder.data, doctype
    try:
        parser.Parse(file.read_bytes(), True)
    except OSError as error:
        raise AssetError(f"{called}: cannot be read ({error.strerror}); check the scenery's path") from error
    except expat.ExpatError as error:
        raise AssetError(f"{called}:{error.lineno}: broken XML, {error}; export the scene again") from error
    root = builder.close()
    if root.tag != "scene":
        raise AssetError(f"{called}:{lines[root]}: the root element is <{root.tag}>, expected <scene>")
    return root, lines


def _check_ids(called: str, root: ElementTree.Element, lines: _Lines) -> None:
    """Refuse an id that two elements have: renderers would take one of them, or none."""
    first: dict[str, ElementTree.Element] = {}
    for element in root.iter():
        name = element.get("id", "")
        if name and element.tag != "ref" and first.setdefault(name, element) is not element:
            raise AssetError(
                f"{called}:{lines[element]}: <{element.tag}> has the id {name!r}, which line "
                f"{lines[first[name]]} has, too; give each an id of its own"
            )


def _fill_in_defaults(called: str, root: ElementTree.Element, lines: _Lines) -> None:
    """Put Mitsuba's parameters of a description in place of every ``$name``."""
    defaults = {d.get("name", ""): d.get("value", "") for d in root.iter("default")}
    for owner in root:
        for element in owner.iter():
            for key, value in element.items():
                for name in re.findall(r"\$(\w+)", value) if element.tag != "default" else ():
                    if name not in defaults:
                        raise AssetError(
                            f"{called}:{lines[element]}: {owner.tag} {owner.get('id', '')!r} uses ${name}, "
                            "for which there is no <default>; add one"
                        )
                    value = value.replace(f"${name}", defaults[name], 1)
                element.set(key, value)


def _files(called: str, root: ElementTree.Element, lines: _Lines) -> dict[str, str]:
    """Every file that a description names, with the place that names it."""
    files: dict[str, str] = {}
    for owner in root.iter():
        for named in owner.findall("string[@name='filename']"):
            where = f"{called}:{lines[named]}: <{owner.tag}> {owner.get('id', '')}".rstrip()
            name = named.get("value", "")
            path = PurePosixPath(name)
            # Other services get the files under these names, below a folder of their own.
            if not path.parts or path.is_absolute() or ".." in path.parts:
                raise AssetError(
                    f"{where} names {name!r}; files of scenery lie beside the XML or below its folder: "
                    "move the file there and write its relative path"
                )
            files.setdefault(str(path), where)
        if owner.tag == "include":
            raise AssetError(
                f"{called}:{lines[owner]}: <include> does not travel; write its content into this file"
            )
    return files


def _radio_bsdfs(
    called: str, root: ElementTree.Element, lines: _Lines
) -> dict[ElementTree.Element, RadioBsdf]:
    """The materials that have radio constants, under names of which each is that of one material."""
    found: dict[ElementTree.Element, RadioBsdf] = {}
    known: dict[str, RadioBsdf] = {}
    bsdfs = [*root.findall("bsdf"), *root.findall("shape/bsdf")]
    # Originals come before the copies that Blender numbers, which mostly differ in colour alone.
    for bsdf in sorted(bsdfs, key=lambda bsdf: _COPY.search(bsdf.get("id", "")) is not None):
        given, itu = bsdf.get("id", ""), _itu_material(bsdf)
        place = f"{called}:{lines[bsdf]}: material {given!r}"
        if itu and itu not in ITU_MATERIALS:
            raise AssetError(
                f"{place}: ITU-R P.2040 has no material {itu!r}; {suggestion(itu, ITU_MATERIALS)}"
            )
        if not itu and not bsdf.get("type", "").endswith("radio-material"):
            continue
        # Sionna RT leaves the prefix out of the names of materials, too.
        name = given.removeprefix("mat-") or (f"itu_{itu}" if itu else f"material of line {lines[bsdf]}")
        xml = _radio_xml(bsdf, itu, root.get("version", "2.1.0"))
        names = _COPY.sub("", name), name
        fits = next((n for n in names if known.setdefault(n, RadioBsdf(n, xml, place)).xml == xml), None)
        if fits is None:
            other = known[name].place.removeprefix(f"{called}:")
            raise AssetError(
                f"{place} and that of line {other} are both {name!r} to the ray tracer, with other "
                "properties; give one of them another id"
            )
        found[bsdf] = known[fits]
    return found


# The number of a copy: itu_concrete.001.
_COPY = re.compile(r"\.\d{3,}$")


def _radio_xml(bsdf: ElementTree.Element, itu: str, version: str) -> str:
    """Mitsuba's element of a material with radio constants, without id and colours."""
    kind = bsdf.get("type", "")
    made = ElementTree.Element("bsdf", version=version, type="itu-radio-material" if itu else kind)
    # Of a material for cameras, whose id says what it is made of, the thickness alone is for radio waves.
    cameras = itu and kind != "itu-radio-material"
    for part in bsdf:
        name = part.get("name")
        if name == "thickness" if cameras else part.tag != "rgb" and not (itu and name == "type"):
            made.append(part)
    if itu:
        ElementTree.SubElement(made, "string", name="type", value=itu)
    for part in made.iter():
        part.tail = part.text = None
    return ElementTree.tostring(made, "unicode")


def _shape(
    where: str,
    file: Path,
    element: ElementTree.Element,
    materials: Mapping[str, ElementTree.Element],
    radio: Mapping[ElementTree.Element, RadioBsdf],
    kinds: Sequence[str],
) -> SceneryShape:
    given, kind = element.get("id") or element.get("name") or "", element.get("type", "")
    if kind not in kinds:
        raise AssetError(f"{where} is of type {kind!r}; export it as a PLY mesh, type='ply'")
    filename = element.find("string[@name='filename']")
    if kind in ("rectangle", "cube"):
        mesh = file
    elif filename is None or not filename.get("value"):
        raise AssetError(f"{where} names no file; give it <string name='filename' value='meshes/….ply'/>")
    else:
        mesh = file.parent / PurePosixPath(filename.get("value", ""))
    if not mesh.is_file():
        raise AssetError(f"{where}: mesh {mesh} is missing; put it there, or remove the shape")
    transform = element.find("transform[@name='to_world']")
    material = _material_of(where, element, materials)
    return SceneryShape(
        # Sionna RT leaves the prefix out of the names of objects, too.
        name=(given or mesh.stem).removeprefix("mesh-"),
        file=mesh,
        to_world=np.eye(4) if transform is None else _to_world(where, transform),
        material="" if material is None else material.get("id", ""),
        itu_material="" if material is None else _itu_material(material),
        material_type="" if material is None else material.get("type", ""),
        place=where,
        colour=None if material is None else _colour(where, material),
        radio=None if material is None else radio.get(material),
        kind=kind,
    )


def _material_of(
    where: str, element: ElementTree.Element, materials: Mapping[str, ElementTree.Element]
) -> ElementTree.Element | None:
    nested = element.find("bsdf")
    if nested is not None:
        return nested
    for reference in element.findall("ref"):
        material = reference.get("id", "")
        if material in materials:
            return materials[material]
        if reference.get("name") == "bsdf":
            raise AssetError(
                f"{where} refers to material {material!r}, which is not defined; "
                f"defined are: {', '.join(sorted(materials)) or 'none'}"
            )
    return None


def _colour(where: str, bsdf: ElementTree.Element) -> tuple[float, float, float] | None:
    """The first colour of a material under a name that renderers take one by."""
    # Renderers differ in what they call the colour of a material.
    for rgb in bsdf.iter("rgb"):
        if rgb.get("name") in ("color", "reflectance", "base_color"):
            value = rgb.get("value", "")
            try:
                red, green, blue = _numbers(value, 3)
            except ValueError:
                red = green = blue = -1.0
            if not all(0 <= part <= 1 for part in (red, green, blue)):
                raise AssetError(
                    f"{where}: its material has the colour {value!r}; write three numbers from 0 to 1"
                )
            return red, green, blue
    return None


def _itu_material(bsdf: ElementTree.Element) -> str:
    """ITU name of a material, from its type, or from an id like ``mat-itu_concrete.001``."""
    given = bsdf.find("string[@name='type']")
    if bsdf.get("type") == "itu-radio-material" and given is not None:
        return given.get("value", "")
    name = re.fullmatch(r"(?:mat-)?itu[_-](.+?)(?:\.\d+)?", bsdf.get("id", ""))
    if name is None:
        return ""
    return name.group(1) if given is None else given.get("value", "")


def _to_world(where: str, transform: ElementTree.Element) -> Float64Array:
    """Product of a transform's steps; each acts after the ones above it."""
    matrix: Float64Array = np.eye(4)
    for step in transform:
        try:
            matrix = _STEPS[step.tag](step.attrib) @ matrix
        except KeyError as error:
            raise AssetError(
                f"{where}: <{step.tag}> in to_world lacks {error} or is not supported; "
                f"use {', '.join(sorted(_STEPS))}"
            ) from error
        except ValueError as error:
            raise AssetError(f"{where}: <{step.tag}> in to_world has a bad value, {error}") from error
    # A singular transform would make a mesh a plane or a line, without an inside.
    if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix[:3, :3])) < 1e-12:
        raise AssetError(f"{where}: to_world is singular or not finite; give scales other than 0")
    return matrix


def _numbers(text: str, *counts: int) -> list[float]:
    numbers = [float(word) for word in text.replace(",", " ").split()]
    if len(numbers) not in counts:
        raise ValueError(f"{text!r}: {len(numbers)} numbers, expected {' or '.join(map(str, counts))}")
    return numbers


def _vector(values: Mapping[str, str], default: float) -> list[float]:
    if "value" in values:
        numbers = _numbers(values["value"], 1, 3)
        return numbers * 3 if len(numbers) == 1 else numbers
    return [float(values.get(axis, default)) for axis in "xyz"]


def _translate(values: Mapping[str, str]) -> Float64Array:
    matrix = np.eye(4)
    matrix[:3, 3] = _vector(values, 0.0)
    return matrix


def _scale(values: Mapping[str, str]) -> Float64Array:
    return np.diag([*_vector(values, 1.0), 1.0])


def _rotate(values: Mapping[str, str]) -> Float64Array:
    """Rotation about an axis by an angle in degrees (Rodrigues' formula)."""
    axis = np.array(_vector(values, 0.0))
    norm = float(np.linalg.norm(axis))
    if norm == 0:
        raise ValueError("the axis is zero; give x, y or z")
    x, y, z = axis / norm
    angle = math.radians(float(values["angle"]))
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix = np.eye(4)
    matrix[:3, :3] += math.sin(angle) * cross + (1 - math.cos(angle)) * (cross @ cross)
    return matrix


def _matrix(values: Mapping[str, str]) -> Float64Array:
    numbers = _numbers(values["value"], 9, 16)
    # Row by row; nine numbers are the linear part.
    size = 3 if len(numbers) == 9 else 4
    matrix = np.eye(4)
    matrix[:size, :size] = np.reshape(numbers, (size, size))
    if matrix[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
        raise ValueError(f"last row {matrix[3].tolist()}, expected 0 0 0 1")
    return matrix


_STEPS = {"translate": _translate, "scale": _scale, "rotate": _rotate, "matrix": _matrix}
