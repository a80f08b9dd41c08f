"""Files of scenery: a Mitsuba XML with what it names, and the meshes of moving objects."""

from __future__ import annotations

import difflib
import importlib.util
from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from xml.parsers import expat

from caviar_protocol.errors import AssetError, ScenarioError, SetupError
from caviar_protocol.host import install_command
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.scenario.schema import pattern_asset
from caviar_services.mesh.scenery import read_scenery
from caviar_services.mesh.shapes import SHAPES, ply
from caviar_services.pattern_files import read_pattern

_BUNDLED = "sionna:"


def scenery_assets(scenery: str) -> dict[str, Path | bytes]:
    """Asset name to file of a world's ``scenery`` setting; empty for an empty setting.

    Raises:
        AssetError: The XML, or a file that it names, is missing or cannot travel, or the XML is wrong
            (`read_scenery`).
        SetupError: A scene of sionna-rt is asked for, and sionna-rt is not installed.
    """
    if not scenery:
        return {}
    xml = scenery_file(scenery)
    named = _named_in(xml)
    read_scenery(xml)  # so that an error names the user's file, not a copy at its consumers
    return {f"scenery/{xml.name}": xml, **{f"scenery/{name}": xml.parent / name for name in named}}


def scenery_file(scenery: str) -> Path:
    """The XML that a world's ``scenery`` setting names.

    Raises
    ------
    AssetError
        There is no such file, or no such scene of sionna-rt.
    SetupError
        A scene of sionna-rt is asked for, and sionna-rt is not installed.
    """
    if scenery.startswith(_BUNDLED):
        return _bundled(scenery.removeprefix(_BUNDLED))
    xml = Path(scenery)
    if not xml.is_absolute():
        raise AssetError(f'{scenery!r} is no scenery; write "sionna:NAME" or "file:PATH.xml"')
    if xml.is_dir():
        inside = sorted(file.name for file in xml.glob("*.xml"))
        hint = f"; there is {', '.join(inside[:5])}" if inside else ""
        raise AssetError(f"{xml} is a folder; name the XML file of the scenery{hint}")
    if not xml.is_file():
        raise AssetError(f"scenery {xml} is not there; correct the path")
    return xml


def object_assets(classes: Iterable[str]) -> dict[str, Path | bytes]:
    """Asset name to PLY bytes of the unit meshes of object classes."""
    return {f"objects/{name}.ply": ply(SHAPES[name]()) for name in sorted(set(classes))}


def pattern_assets(devices: Iterable[DeviceSpec]) -> dict[str, Path | bytes]:
    """Asset name to file of the element patterns that devices name.

    Raises `ScenarioError` naming the device's key where a file is wrong (`read_pattern`).
    """
    found: dict[str, Path | bytes] = {}
    for device in devices:
        if device.array is not None and device.array.pattern_file:
            file = Path(device.array.pattern_file)
            try:
                read_pattern(file)  # so that an error names the user's file, not a copy of it
            except AssetError as error:
                key = Place("devices").at(device.name).at("array").at("pattern_file").key
                raise ScenarioError(str(error), key=key) from error
            found[pattern_asset(device.array.pattern_file)] = file
    return found


def _bundled(name: str) -> Path:
    spec = importlib.util.find_spec("sionna")
    folders = (
        [Path(place) / "rt" / "scenes" for place in (spec.submodule_search_locations or ())] if spec else []
    )
    folder = next((place for place in folders if place.is_dir()), None)
    if folder is None:
        raise SetupError(
            f'scenery "{_BUNDLED}{name}" comes with sionna-rt, which is not installed; run: '
            + install_command("world")
        )
    xml = folder / name / f"{name}.xml"
    if "/" in name or not xml.is_file():
        known = sorted(
            entry.parent.name for entry in folder.glob("*/*.xml") if entry.stem == entry.parent.name
        )
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise AssetError(f"sionna-rt has no scene {name!r}; {hint}known: {', '.join(known)}")
    return xml


def _named_in(xml: Path) -> list[str]:
    """Relative names of all files that a Mitsuba XML names, checked to be there."""
    found: list[str] = []
    defaults: dict[str, str] = {}
    shape = ""

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal shape
        if tag in ("shape", "texture", "bsdf", "emitter"):
            shape = f"<{tag}> {attributes.get('id', '')}".rstrip()
        place = f"{xml}:{parser.CurrentLineNumber}: {shape or f'<{tag}>'}"
        if tag == "include":
            raise AssetError(f"{place}: <include> does not travel; write its content into this file")
        if tag == "default":
            defaults[f"${attributes.get('name', '')}"] = attributes.get("value", "")
        if tag == "string" and attributes.get("name") == "filename":
            value = attributes.get("value", "")
            found.append(_checked(defaults.get(value, value), xml.parent, place))

    parser = expat.ParserCreate()
    parser.StartElementHandler = start
    try:
        parser.Parse(xml.read_bytes(), True)
    except expat.ExpatError as error:
        raise AssetError(f"{xml}:{error.lineno}: not well-formed XML: {error}") from error
    return sorted(set(found))


def _checked(name: str, folder: Path, place: str) -> str:
    path = PurePosixPath(name)
    if not name or path.is_absolute() or ".." in path.parts:
        raise AssetError(
            f"{place} names {name!r}; files of scenery lie beside the XML or below it: move the file "
            "there and write its relative path"
        )
    if not (folder / path).is_file():
        raise AssetError(
            f"{place} names {name!r}, and there is no file {folder / path}; put it there or take the shape "
            "out of the XML"
        )
    return str(path)
