"""Asset store: files of scenery by the SHA-256 of their content, on both sides (contract, clause 4).

Meshes that worlds announce while a run goes on: their names, and what they have to be.

A mesh is named by the SHA-256 of its file, so that a name never stands for another file: not in this run,
not after a restart, not in its recording. Whether a file is a mesh is decided once, where it enters a run, so
that all consumers of geometry hold the same.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from uuid import uuid4

import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array, Int64Array
from caviar_protocol.digest import file_digest, geometry_digest
from caviar_protocol.errors import AssetError, SetupError, suggestion
from caviar_protocol.fields import MAX_ASSET_CHUNK, MAX_BODY, Asset, AssetName
from caviar_protocol.files import replace_file
from caviar_protocol.space.ply import ply_comments, ply_faces, read_ply

MAX_ASSET = MAX_BODY
"""[B] A file of scenery is at most this large: it is put together in memory."""


def default_folder() -> Path:
    """Cache of this user: ``$XDG_CACHE_HOME/caviar``, by default ``~/.cache/caviar``.

    Example:
        >>> default_folder().name
        'caviar'
    """
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "caviar"


class AssetStore:
    """Content-addressed files below one folder.

    Several processes may use it at once: a file appears under its digest only when it is complete and
    verified. A file that the process finds there is believed only after one look at its size and digest:
    disks fill up and machines crash while a cache is written.

    Args:
        folder: Folder of the store; by default the cache of this user (`default_folder`).

    Raises:
        SetupError: The folder cannot be made.

    Example:
        >>> store = AssetStore(Path("cache"))
        >>> wall = store.add("meshes/wall.ply", b"ply")
        >>> store.holds(wall), store.folder_of([wall])["meshes/wall.ply"].read_bytes()
        (True, b'ply')
    """

    def __init__(self, folder: Path | None = None) -> None:
        self.folder = folder or default_folder()
        self._files = self.folder / "assets"
        self._verified: set[str] = set()
        try:
            self._files.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise SetupError(
                f"cannot keep scenery in {self._files}: {error.strerror}; "
                "name a folder that can be written: export XDG_CACHE_HOME=/path"
            ) from error

    def holds(self, asset: Asset) -> bool:
        """Whether the whole file is here, with the size and content of its description.

        Args:
            asset: Description of the file.
        """
        path = self.path(asset.digest)
        try:
            if path.stat().st_size != asset.size:
                return False
            # Hashed once a process and not once a run, of which an environment has thousands.
            if asset.digest not in self._verified:
                if file_digest(path) != asset.digest:
                    return False
                self._verified.add(asset.digest)
        except OSError:
            return False
        return True

    def path(self, digest: str) -> Path:
        """Path of the file with this digest, which may not be there.

        Args:
            digest: SHA-256 of the file.
        """
        return self._files / digest

    def add(self, name: str, content: Path | bytes) -> Asset:
        """Take in a file and describe it.

        Args:
            name: Name of the asset: a relative path with forward slashes.
            content: The file, or its bytes.

        Raises:
            AssetError: It cannot be read or stored, is too large, or ``name`` could lead out of a folder.
        """
        _check_name(name)
        try:
            data = content if isinstance(content, bytes) else content.read_bytes()
        except OSError as error:
            raise AssetError(f"asset {name!r}: cannot read {content!r}: {error.strerror}") from error
        asset = Asset(name=name, digest=hashlib.sha256(data).hexdigest(), size=len(data))
        _check_size(asset)
        if not self.holds(asset):
            self._place(asset, data)
        return asset

    def read(self, digest: str, offset: int) -> tuple[bytes, int]:
        """Read a chunk of a file.

        Args:
            digest: Of the file.
            offset: First byte wanted.

        Returns:
            Up to `MAX_ASSET_CHUNK` bytes, and the file's size [B].

        Raises:
            AssetError: There is no such file, or it ends before ``offset``.
        """
        try:
            with self.path(digest).open("rb") as file:
                size = os.fstat(file.fileno()).st_size
                if offset > size:
                    raise AssetError(f"asset {digest} has {size} B, there is nothing at {offset}")
                file.seek(offset)
                return file.read(MAX_ASSET_CHUNK), size
        except OSError as error:
            raise AssetError(f"asset {digest} is not here: {error.strerror}") from error

    def folder_of(self, assets: Iterable[Asset]) -> Mapping[str, Path]:
        """Lay out the files of a manifest in one folder, at their names as relative paths.

        The folder is kept under the manifest's digest; what is in it already and intact is not laid out
        again.

        Args:
            assets: The manifest.

        Returns:
            Local file of each asset, by its name.

        Raises:
            AssetError: A file of the manifest is not in the store, or cannot be laid out.
        """
        # Gone through twice below, and an iterator lasts once.
        manifest = list(assets)
        # By digest, so that runs with the same scenery share the folder and others never touch it.
        folder = self.folder / "geometry" / (geometry_digest(manifest) or "none")
        for asset in manifest:
            _check_name(asset.name)
            if not self.holds(asset):
                raise AssetError(f"asset {asset.name!r} ({asset.digest[:12]}…) was never fetched")
            try:
                self._lay_out(asset, folder / asset.name)
            except OSError as error:
                raise AssetError(f"cannot lay out {asset.name!r} in {folder}: {error.strerror}") from error
        return {asset.name: folder / asset.name for asset in manifest}

    def _lay_out(self, asset: Asset, target: Path) -> None:
        source = self.path(asset.digest)
        # A file that is a link to the one in the store needs no second hash.
        if target.is_file() and (target.samefile(source) or file_digest(target) == asset.digest):
            return
        target.parent.mkdir(parents=True, exist_ok=True)
        staged = target.with_name(f".staged-{uuid4().hex}")
        try:
            # A link costs neither time nor space; a city in each run's folder would.
            try:
                os.link(source, staged)
            except OSError:  # no hard links on this file system
                shutil.copyfile(source, staged)
            staged.replace(target)
        finally:
            staged.unlink(missing_ok=True)  # a link to the file that target is already stays after a rename

    def _place(self, asset: Asset, data: bytes) -> None:
        try:
            replace_file(self.path(asset.digest), data, durable=False, mode=0o600, concurrent=True)
        except OSError as error:
            raise AssetError(
                f"cannot keep asset {asset.name!r} in {self._files}: {error.strerror}"
            ) from error
        self._verified.add(asset.digest)


class IncomingAsset:
    """One file on its way, chunk by chunk.

    Args:
        store: Where it goes.
        asset: Its description.

    Raises:
        AssetError: More is announced than a file may have.

    Example:
        >>> store = AssetStore(Path("cache"))
        >>> wall = AssetStore(Path("elsewhere")).add("meshes/wall.ply", b"ply")
        >>> incoming = IncomingAsset(store, wall)
        >>> incoming.add_chunk(0, 3, b"pl"), incoming.add_chunk(2, 3, b"y"), store.holds(wall)
        (False, True, True)
    """

    def __init__(self, store: AssetStore, asset: Asset) -> None:
        _check_size(asset)
        self.asset = asset
        self._store = store
        self._data = bytearray()

    @property
    def offset(self) -> int:
        """Bytes that have come: the next chunk begins there."""
        return len(self._data)

    def add_chunk(self, offset: int, size: int, chunk: bytes | memoryview) -> bool:
        """Append a chunk.

        Args:
            offset: Of the chunk in the file [B].
            size: Of the file, as the sender says [B].
            chunk: The bytes.

        Returns:
            Whether the file is complete, and then in the store.

        Raises:
            AssetError: The chunk is not the next one, or the content has another digest than announced.
        """
        name, announced = self.asset.name, self.asset
        # Chunks come in order over one connection; anything else is another sender's mistake, never a loss.
        fits = offset == self.offset and size == announced.size and offset + len(chunk) <= size
        # An empty chunk of a file that has bytes would be asked for again without end.
        if not fits or (size and not len(chunk)):
            raise AssetError(
                f"asset {name!r}: got {len(chunk)} B at {offset} of {size} B, expected them at "
                f"{self.offset} of {announced.size} B"
            )
        self._data += chunk
        if self.offset < size:
            return False
        # Hashed when it is complete: chunks of a peer may come in any size.
        digest = hashlib.sha256(self._data).hexdigest()
        if digest != announced.digest:
            raise AssetError(f"asset {name!r} has digest {digest}, announced was {announced.digest}")
        self._store.add(name, bytes(self._data))
        return True


def _check_name(name: str) -> None:
    try:
        msgspec.convert(name, AssetName)
    except msgspec.ValidationError as error:
        raise AssetError(
            f"asset name {name!r} is not a relative path with forward slashes and without '.' and '..'"
        ) from error


def _check_size(asset: Asset) -> None:
    if asset.size > MAX_ASSET:
        raise AssetError(f"asset {asset.name!r} has {asset.size} B, a file may have {MAX_ASSET} B")


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
