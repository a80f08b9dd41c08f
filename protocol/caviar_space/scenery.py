"""Scenery of a world: where its files come from, and its triangles.

A source finds or makes the description, Mitsuba's XML (`caviar_space.mitsuba_xml`), which travels to the
services with the meshes that it names. A new source of scenery is a function here, and a row in `SOURCES`;
one of another format writes what `mitsuba_xml.scenery_files` makes of it, and finds that.
"""

from __future__ import annotations

import difflib
import importlib.util
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path, PurePosixPath

import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import AssetError, SetupError
from caviar_protocol.host import install_command
from caviar_space.materials import ObjectMaterials
from caviar_space.mitsuba_xml import read_scenery, world_mesh


def scenery_assets(scenery: str) -> dict[str, Path]:
    """Find the files that a world's ``scenery`` setting stands for.

    Args:
        scenery: ``sionna:NAME``, the absolute path of a Mitsuba XML, or empty: no scenery.

    Returns:
        File by asset name: the XML and every file that it names.

    Raises:
        AssetError: The XML, or a file that it names, is missing or cannot travel, or the XML is wrong
            (`read_scenery`).
        SetupError: A scene of sionna-rt is asked for, and sionna-rt is not installed.

    Example:
        >>> scenery_assets("")
        {}
    """
    if not scenery:
        return {}
    xml = scenery_file(scenery)
    files = read_scenery(xml).files  # errors name the user's file, not a copy at its consumers
    for name, place in files.items():
        if not (xml.parent / name).is_file():
            raise AssetError(
                f"{place} names {name!r}, and there is no file {xml.parent / name}; put it there"
            )
    found = {f"scenery/{xml.name}": xml, **{f"scenery/{name}": xml.parent / name for name in sorted(files)}}
    about = xml.with_suffix(".json")  # of an imported scene: its place on the Earth
    return found | ({f"scenery/{about.name}": about} if about.is_file() else {})


def scenery_file(scenery: str) -> Path:
    """Find the XML that a world's ``scenery`` setting names.

    Args:
        scenery: ``sionna:NAME``, or the absolute path of a Mitsuba XML.

    Raises:
        AssetError: There is no such file, or no such scene of sionna-rt.
        SetupError: A scene of sionna-rt is asked for, and sionna-rt is not installed.
    """
    source, colon, name = scenery.partition(":")
    if colon and source in SOURCES:
        return SOURCES[source](name)
    return _of_user(scenery)


def _of_user(scenery: str) -> Path:
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


def _of_sionna(name: str) -> Path:
    # The package is located, never imported: its import loads Mitsuba and Dr.Jit, for the sake of a file.
    spec = importlib.util.find_spec("sionna")
    folders = (
        [Path(place) / "rt" / "scenes" for place in (spec.submodule_search_locations or ())] if spec else []
    )
    folder = next((place for place in folders if place.is_dir()), None)
    if folder is None:
        raise SetupError(
            f'scenery "sionna:{name}" comes with sionna-rt, which the extras `world` and `channel` bring, '
            f"and which is not installed; run: {install_command('world')}"
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


SOURCES: Mapping[str, Callable[[str], Path]] = {
    "sionna": _of_sionna,
    "file": _of_user,
}
"""Finds the description by what follows the name of the source and a colon."""


def scenery_triangles(assets: Mapping[str, Path], foliage: Iterable[str] = ()) -> Float64Array:
    """Read all triangles of a world's scenery.

    Args:
        assets: What `scenery_assets` gives.
        foliage: Names of pieces, or patterns of names with ``*``, that are left out.

    Returns:
        Corners in world coordinates [m], Shape ``[T, 3, 3]``.

    Raises:
        AssetError: A mesh cannot be read or is not finite; names it.

    Example:
        >>> scenery_triangles(scenery_assets("")).shape
        (0, 3, 3)
    """
    descriptions = [
        file for name, file in sorted(assets.items()) if PurePosixPath(name).match("scenery/*.xml")
    ]
    leaves = ObjectMaterials({key: key for key in foliage})
    shapes = (shape for xml in descriptions for shape in read_scenery(xml).shapes)
    meshes = [world_mesh(shape) for shape in shapes if not leaves.key_for(shape.name)]
    return np.concatenate([np.zeros((0, 3, 3)), *(mesh.vertices[mesh.faces] for mesh in meshes)])
