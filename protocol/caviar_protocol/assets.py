"""A folder of files by the SHA-256 of their content: how scenery is kept on both sides (clause 4)."""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path

from caviar_protocol.digest import geometry_digest
from caviar_protocol.errors import AssetError
from caviar_protocol.limits import MAX_ASSET_CHUNK
from caviar_protocol.messages import Asset


def default_folder() -> Path:
    """Cache of this user: ``$XDG_CACHE_HOME/caviar``, by default ``~/.cache/caviar``."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "caviar"


class AssetStore:
    """Content-addressed files below ``folder``. Safe for several processes at once: a file appears
    under its digest only when it is complete and verified."""

    def __init__(self, folder: Path | None = None) -> None:
        self.folder = folder or default_folder()
        self._files = self.folder / "assets"
        self._files.mkdir(parents=True, exist_ok=True)

    def has(self, digest: str) -> bool:
        """Whether the whole file is here."""
        return self.path(digest).is_file()

    def path(self, digest: str) -> Path:
        """Where the file with this digest is, or would be."""
        return self._files / digest

    def add(self, name: str, content: Path | bytes) -> Asset:
        """Take in a file and describe it. `AssetError` naming it where it cannot be read."""
        try:
            data = content if isinstance(content, bytes) else content.read_bytes()
        except OSError as error:
            raise AssetError(f"asset {name!r}: cannot read {content!r}: {error.strerror}") from error
        digest = hashlib.sha256(data).hexdigest()
        if not self.has(digest):
            self._place(digest, data)
        return Asset(name=name, digest=digest, size=len(data))

    def read(self, digest: str, offset: int) -> tuple[bytes, int]:
        """Up to a chunk of a file from ``offset``, and the file's size [B].

        Raises `AssetError` where there is no such file.
        """
        try:
            with self.path(digest).open("rb") as file:
                size = os.fstat(file.fileno()).st_size
                file.seek(offset)
                return file.read(MAX_ASSET_CHUNK), size
        except OSError as error:
            raise AssetError(f"asset {digest} is not here: {error.strerror}") from error

    def folder_of(self, assets: Iterable[Asset]) -> Mapping[str, Path]:
        """Local files of a manifest, all in one folder at their names as relative paths.

        The folder is kept under the manifest's digest, so that it is laid out once. Raises
        `AssetError` where a file of it is not in the store.
        """
        manifest = list(assets)
        folder = self.folder / "geometry" / (geometry_digest(manifest) or "none")
        if not folder.is_dir():
            staged = Path(tempfile.mkdtemp(dir=self.folder, prefix="staged-"))
            try:
                for asset in manifest:
                    self._lay_out(asset, staged / asset.name)
                folder.parent.mkdir(exist_ok=True)
                staged.rename(folder)
            except OSError as error:
                if not folder.is_dir():  # another process may have been first
                    raise AssetError(f"cannot lay out scenery in {folder}: {error.strerror}") from error
            finally:
                shutil.rmtree(staged, ignore_errors=True)
        return {asset.name: folder / asset.name for asset in manifest}

    def _lay_out(self, asset: Asset, target: Path) -> None:
        source = self.path(asset.digest)
        if not source.is_file():
            raise AssetError(f"asset {asset.name!r} ({asset.digest[:12]}…) was never fetched")
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(source, target)
        except OSError:  # no hard links on this file system
            shutil.copyfile(source, target)

    def _place(self, digest: str, data: bytes) -> None:
        with tempfile.NamedTemporaryFile(dir=self._files, prefix="part-", delete=False) as file:
            file.write(data)
        Path(file.name).replace(self.path(digest))


class Incoming:
    """One file on its way, chunk by chunk."""

    def __init__(self, store: AssetStore, asset: Asset) -> None:
        self.asset = asset
        self._store = store
        self._data = bytearray()

    @property
    def offset(self) -> int:
        """How much has come [B]: where the next chunk begins."""
        return len(self._data)

    def take(self, offset: int, size: int, chunk: bytes | memoryview) -> bool:
        """Append a chunk; True when the file is complete and in the store.

        Raises `AssetError` where the chunk is not the next one, or the content has another digest
        than announced.
        """
        name = self.asset.name
        if offset != self.offset or size != self.asset.size or (size and not len(chunk)):
            raise AssetError(
                f"asset {name!r}: got {len(chunk)} B at {offset} of {size} B, expected them at "
                f"{self.offset} of {self.asset.size} B"
            )
        self._data += chunk
        if self.offset < size:
            return False
        added = self._store.add(name, bytes(self._data))
        if added.digest != self.asset.digest:
            raise AssetError(f"asset {name!r} has digest {added.digest}, announced was {self.asset.digest}")
        return True
