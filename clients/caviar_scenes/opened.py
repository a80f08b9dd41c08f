"""Scenes that are in use: an imported folder, a Mitsuba XML, one of sionna-rt, or a scenario's; and their
changed copies."""

from __future__ import annotations

import copy
import re
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import msgspec
import numpy as np

from caviar_protocol.errors import AssetError
from caviar_space.imported_scenes import Georeference
from caviar_space.meshes import Mesh, ply
from caviar_space.mitsuba_xml import Scenery, SceneryShape, read_scenery, world_mesh
from caviar_space.scenery import SOURCES, scenery_file


@dataclass(frozen=True, eq=False)
class OpenedScene:
    """Content of a scene."""

    scenery: Scenery
    meshes: dict[str, Mesh]
    """In world coordinates [m], by name of the piece."""
    about: dict[str, Any]
    """Content of ``scene.json``; empty where there is none."""

    @property
    def name(self) -> str:
        """Name of its file, or of the folder of an imported scene."""
        file = self.scenery.file
        return file.resolve().parent.name if file.stem == "scene" else file.stem

    @cached_property
    def shapes(self) -> dict[str, SceneryShape]:
        """Pieces by name, in the order of the description."""
        return {shape.name: shape for shape in self.scenery.shapes}

    @cached_property
    def foliage(self) -> set[str]:
        """Names of pieces that waves pass through."""
        pieces = self.about.get("pieces", {})
        return {
            name
            for name, shape in self.shapes.items()
            if shape.radio is None or pieces.get(name, {}).get("kind") == "foliage"
        }

    @property
    def origin(self) -> Georeference | None:
        """Place of the scene on the Earth; None: it has none."""
        given = self.about.get("origin")
        return msgspec.convert(given, Georeference) if given else None


def texture_files(about: Mapping[str, Any]) -> set[str]:
    """Pictures and places in them that a ``scene.json`` names, relative to its folder."""
    textures = [piece["texture"] for piece in about.get("pieces", {}).values() if "texture" in piece]
    return {str(texture[key]) for texture in textures for key in ("image", "uv") if key in texture}


def open_scene(given: str) -> OpenedScene:
    """Read a scene.

    Args:
        given: Folder of an imported scene, Mitsuba XML, ``sionna:NAME``, or a scenario, by name or file.

    Raises:
        AssetError: There is none, or a file of it is wrong; names it.
        ScenarioError: The scenario is wrong.
    """
    file = _description(given)
    scenery = read_scenery(file)
    meshes = {shape.name: world_mesh(shape) for shape in scenery.shapes}
    beside = file.with_suffix(".json")
    try:
        about = msgspec.json.decode(beside.read_bytes(), type=dict[str, Any]) if beside.is_file() else {}
        scene = OpenedScene(scenery, meshes, about)
        _ = scene.origin, scene.foliage
    except (OSError, msgspec.MsgspecError, AttributeError) as error:
        raise AssetError(
            f"{beside}: is not what `caviar scene import` wrote ({error}); import again"
        ) from error
    if not any(len(mesh.faces) for mesh in meshes.values()):
        raise AssetError(f"{file} has no triangles; export the scene again")
    return scene


def _description(given: str) -> Path:
    path = Path(given)
    if given.partition(":")[0] in SOURCES and ":" in given:
        return scenery_file(given)
    if path.is_dir():
        if not (path / "scene.xml").is_file():
            raise AssetError(
                f"{given} has no scene.xml; name the folder that `caviar scene import … --out` made"
            )
        return path / "scene.xml"
    if path.suffix == ".xml":
        if not path.is_file():
            raise AssetError(f"{given} is not there; name a folder, an XML, sionna:NAME or a scenario")
        return path
    from caviar_clients.session.prepared import prepare

    scenario = prepare(path).scenario
    for service in scenario.services.values():
        if service.role == "world" and service.settings.get("scenery"):
            return scenery_file(str(service.settings["scenery"]))
    raise AssetError(f"the worlds of {given} have no scenery; name a scene")


def write_changed(
    scene: OpenedScene,
    pieces: Mapping[str, Sequence[tuple[Mesh, float | None]]],
    out: Path,
    more: Mapping[str, bytes],
    said: str,
) -> None:
    """Write a copy of a scene with other meshes; materials stay as its description has them.

    Args:
        scene: The scene.
        pieces: Meshes in world coordinates [m], each with the thickness of its walls [m] or None for that of
            its material, by name of the piece; a name without meshes is left out.
        out: Folder that is made.
        more: Content of other files, by path.
        said: What was changed, for the notes of the scene.

    Raises:
        AssetError: The folder is there or cannot be written.
    """
    if out.exists():
        raise AssetError(f"{out} is there already; name another folder, or remove it")
    source = scene.scenery.file
    tree = ElementTree.parse(source)  # noqa: S314 - read_scenery refuses document types
    root = tree.getroot()
    elements = dict(zip(scene.shapes, root.findall("shape"), strict=True))
    materials = {element.get("id", ""): element for element in root.findall("bsdf")}
    files = dict(more)
    described: dict[str, Any] = {}
    dropped = 0
    for name, element in elements.items():
        place = list(root).index(element)
        root.remove(element)
        for number, (mesh, thickness) in enumerate(pieces.get(name, ())):
            called = f"{name}-part{number}" if number else name
            while number and (called in scene.shapes or called in described):
                called += "-"
            plain = re.sub(r"[^\w.+-]", "-", called)[:100]  # ids may have any characters
            path = f"meshes/{plain}.ply"
            while path in files:
                path = path.replace(".ply", "-.ply")
            made = copy.deepcopy(element)
            made.set("id", f"mesh-{called}")
            for transform in made.findall("transform"):
                made.remove(transform)
            file = made.find("string[@name='filename']")
            if file is not None:
                file.set("value", path)
            if thickness is not None:
                _set_thickness(root, made, materials, thickness)
            root.insert(place + number, made)
            files[path] = ply(mesh)
            old = scene.about.get("pieces", {}).get(name, {"material": scene.shapes[name].material})
            described[called] = {**old, "triangles": len(mesh.faces)}
            before = scene.meshes[name]
            if number or not np.array_equal(mesh.vertices[mesh.faces], before.vertices[before.faces]):
                dropped += described[called].pop("texture", None) is not None
    # Materials that were added come before the shapes that name them.
    root[:] = [e for e in root if e.tag != "shape"] + [e for e in root if e.tag == "shape"]
    files["scene.xml"] = ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
    notes = [*scene.about.get("notes", ()), said]
    notes += [f"textures of {dropped} pieces whose faces changed: left out"] if dropped else []
    about = {"name": scene.name, **scene.about, "pieces": described, "notes": notes}
    files["scene.json"] = msgspec.json.format(msgspec.json.encode(about), indent=2)
    kept = [path for path in scene.scenery.files if (source.parent / path).suffix != ".ply"]
    if source.stem == "scene" and scene.about:  # roads and scenarios of an imported scene
        folder = source.parent
        kept += [str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file() and p.suffix != ".ply"]
        unused = texture_files(scene.about) - texture_files(about)
        kept = [path for path in kept if path not in unused]
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=out.parent) as temporary:
            folder = Path(temporary) / "scene"
            for path in kept:
                (folder / path).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(source.parent / path, folder / path)
            for path, content in files.items():
                (folder / path).parent.mkdir(parents=True, exist_ok=True)
                (folder / path).write_bytes(content)
            folder.rename(out)  # not into one that came to be meanwhile
    except OSError as error:
        raise AssetError(f"cannot write {out}: {error.strerror}; choose another folder") from error


def _set_thickness(
    root: ElementTree.Element,
    shape: ElementTree.Element,
    materials: dict[str, ElementTree.Element],
    thickness: float,
) -> None:
    """Give a shape a copy of its material of another thickness, under a name of its own."""
    reference = next((r for r in shape.findall("ref") if r.get("id") in materials), None)
    nested = shape.find("bsdf")
    if reference is None and nested is None:
        return
    key = (reference if reference is not None else nested).get("id", "")  # type: ignore[union-attr]
    name = f"{key}-{thickness * 1e3:g}mm"
    if name not in materials:
        old = materials[key] if nested is None else nested
        made = copy.deepcopy(old)
        itu = re.fullmatch(r"(?:mat-)?itu[_-](.+?)(?:\.\d+)?", key)
        if itu and not old.get("type", "").endswith("radio-material"):
            # The id says what a material for cameras is made of; one that ends in a thickness does not.
            made = ElementTree.Element("bsdf", type="itu-radio-material")
            ElementTree.SubElement(made, "string", name="type", value=itu.group(1))
            for rgb in list(old.iter("rgb"))[:1]:
                ElementTree.SubElement(made, "rgb", name="color", value=rgb.get("value", ""))
        made.set("id", name)
        for given in made.findall("float[@name='thickness']"):
            made.remove(given)
        ElementTree.SubElement(made, "float", name="thickness", value=f"{thickness:.9g}")
        materials[name] = made
        root.insert(0, made)
    if nested is not None:
        shape.remove(nested)
        reference = ElementTree.SubElement(shape, "ref", name="bsdf")
    if reference is not None:
        reference.set("id", name)
