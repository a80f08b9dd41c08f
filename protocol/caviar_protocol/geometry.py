"""Meshes that worlds announce while a run goes on: their names, and what they have to be.

A mesh is named by the SHA-256 of its file, so that a name never stands for another file: not in this run,
not after a restart, not in its recording. Whether a file is a mesh is decided once, where it enters a run, so
that all consumers of geometry hold the same.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from caviar_protocol.arrays import Float64Array, Int64Array
from caviar_protocol.assets import MAX_ASSET, AssetStore
from caviar_protocol.errors import AssetError, suggestion
from caviar_protocol.fields import Asset
from caviar_protocol.space.ply import ply_comments, ply_faces, read_ply

MAX_FACES = 2_000_000
"""Triangles of a mesh at most, unless the scenario says otherwise (``run.max_faces``)."""

ITU_MATERIALS = frozenset(
    (
        "asphalt_concrete", "brick", "carpet_tile", "ceiling_board", "chipboard", "clear_acrylic", "concrete",
        "floorboard", "glass", "marble", "medium_dry_ground", "metal", "plasterboard", "plywood", "vacuum",
        "very_dry_ground", "vinyl_tile", "wet_ground", "wood",
    )
)  # fmt: skip
"""Materials of Recommendation ITU-R P.2040-3, table 3, by the names that Sionna RT has for them."""

_NAME = re.compile(r"objects/([0-9a-f]{64})\.ply")
_MATERIAL = "material"
# Files have float32, in which a half is exact; exporters that scale miss it by some rounding.
_UNIT_TOLERANCE = 1e-4


def mesh_name(content: bytes) -> str:
    """Name of a mesh that is announced while a run goes on.

    Args:
        content: The PLY file.

    Example:
        >>> mesh_name(b"ply")[:20]
        'objects/c7a41639644b'
    """
    return f"objects/{hashlib.sha256(content).hexdigest()}.ply"


def is_mesh_name(name: str) -> bool:
    """Whether a name is that of a mesh that a world announces while the run goes on.

    Args:
        name: Of an asset.

    Example:
        >>> is_mesh_name(mesh_name(b"ply")), is_mesh_name("objects/car.ply")
        (True, False)
    """
    return _NAME.fullmatch(name) is not None


def digest_in(name: str) -> str:
    """SHA-256 that a mesh name has; empty where it is none.

    Args:
        name: Of an asset.
    """
    found = _NAME.fullmatch(name)
    return found[1] if found else ""


def wrong_name(asset: Asset) -> str:
    """Error in the name of a mesh that is announced while a run goes on; empty: none.

    Args:
        asset: Its description.
    """
    if digest_in(asset.name) == asset.digest:
        return ""
    return f"its name has to be objects/{asset.digest}.ply, after the SHA-256 of the file"


def check_unit_box(vertices: Float64Array, called: str) -> None:
    """Check that vertices fill the unit box, by which an object's dimensions scale its mesh.

    Args:
        vertices: Shape ``[V, 3]``, one at least.
        called: What errors call the mesh.

    Raises:
        AssetError: Their bounding box is not −½…½ on every axis.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    if not (np.allclose(low, -0.5, atol=_UNIT_TOLERANCE) and np.allclose(high, 0.5, atol=_UNIT_TOLERANCE)):
        raise AssetError(
            f"{called}: spans {low.round(4).tolist()} to {high.round(4).tolist()}; "
            "scale and centre it to −0.5…0.5 on every axis"
        )


def material_of(file: Path) -> str:
    """Material that a mesh names in its header, ``comment material concrete``; empty where it names none.

    Args:
        file: A PLY file.

    Example:
        >>> Path("crate.ply").write_bytes(b"ply\\nformat ascii 1.0\\ncomment material wood\\nend_header\\n")
        54
        >>> material_of(Path("crate.ply"))
        'wood'
    """
    for comment in ply_comments(file):
        key, _, value = comment.partition(" ")
        if key == _MATERIAL:
            return value.strip()
    return ""


def read_unit_mesh(file: Path, called: str = "", max_faces: int = 0) -> tuple[Float64Array, Int64Array]:
    """Read the mesh of an object and check all that it has to be.

    Args:
        file: A PLY file.
        called: What errors call the file.
        max_faces: Triangles that it may have; 0: any number.

    Returns:
        Vertices, Shape ``[V, 3]``, within −½…½ on every axis, and corners of triangles, Shape ``[F, 3]``.

    Raises:
        AssetError: It cannot be read, has no face or too many, a vertex that is not finite, does not fill the
            unit box, or names a material that Recommendation ITU-R P.2040 does not have.
    """
    called = called or str(file)
    # Before the faces are read: a file of gigabytes is refused by the first line of its header.
    if max_faces and (count := ply_faces(file)) > max_faces:
        raise AssetError(_too_many(called, count, max_faces))
    vertices, faces = read_ply(file, called)
    if not len(faces):
        raise AssetError(f"{called}: has no faces; leave the mesh out, and its object is a box")
    if max_faces and len(faces) > max_faces:
        raise AssetError(_too_many(called, len(faces), max_faces))
    check_unit_box(vertices, called)
    material = material_of(file)
    if material and material not in ITU_MATERIALS:
        raise AssetError(
            f"{called}: ITU-R P.2040 has no material {material!r}; {suggestion(material, ITU_MATERIALS)}"
        )
    return vertices, faces


def recorded_meshes(folder: Path) -> dict[str, Path]:
    """Find the meshes in a recording that worlds announced while its run went on.

    Args:
        folder: With the files of scenery.

    Returns:
        Files by asset name, sorted.
    """
    found = {f"objects/{file.name}": file for file in (folder / "objects").glob("*.ply")}
    return {name: found[name] for name in sorted(found) if is_mesh_name(name)}


class MeshCheck:
    """Looks into the meshes that worlds announce, into each file once.

    Args:
        store: Where the files are.
        max_faces: Triangles that each may have.
    """

    def __init__(self, store: AssetStore, max_faces: int) -> None:
        self._store, self._max_faces = store, max_faces
        # By digest: why it is refused; empty: it is not.
        self._found: dict[str, str] = {}

    def refusals(self, assets: Iterable[Asset]) -> dict[str, str]:
        """Find out which meshes are none.

        Args:
            assets: Their descriptions. What has a wrong name is not looked into.

        Returns:
            Why it is refused, for each that is, by name.
        """
        found = {}
        for asset in assets:
            if asset.size > MAX_ASSET:
                found[asset.name] = f"it has {asset.size} B, a file may have {MAX_ASSET} B"
            elif not wrong_name(asset):
                if asset.digest not in self._found:
                    self._found[asset.digest] = self._problem(asset)
                if why := self._found[asset.digest]:
                    found[asset.name] = why
        return found

    def _problem(self, asset: Asset) -> str:
        try:
            read_unit_mesh(self._store.path(asset.digest), "the mesh", self._max_faces)
        except AssetError as error:
            return str(error)
        return ""


def _too_many(called: str, count: int, most: int) -> str:
    return f"{called}: has {count} faces, the run takes {most} (run.max_faces); give it fewer, or raise that"
