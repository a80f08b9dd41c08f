"""Datasets in object stores and on servers: any location that fsspec has an address for.

An address, ``s3://bucket/s008``, stands where the folder of a dataset does. Such stores have no rename: the
files of an episode are uploaded one by one, and a marker with their sizes after them; without it the episode
is not there. The catalogue lies in a folder of this machine while episodes are played, and is uploaded at the
end.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from fnmatch import fnmatch
from pathlib import Path

import msgspec

from caviar_clients.datasets.catalogue import Catalogue
from caviar_clients.datasets.directory import DatasetDirectory, rename_unless_there
from caviar_clients.datasets.settings import fingerprint
from caviar_protocol.assets import default_folder
from caviar_protocol.errors import RecordingError, RunError, SetupError
from caviar_protocol.host import install_command
from caviar_protocol.run_directory import SEGMENT_PATTERN

_CATALOGUE = DatasetDirectory(Path()).catalogue.name
MARKER = "complete.json"
"""In the folder of an episode: names and sizes of its files; it is written after them."""

# ``s3:/bucket`` of any kind; ``s3:bucket`` and ``s3//bucket`` of kinds that no folder is called.
_ALMOST = re.compile(
    r"(?:(?P<scheme>[A-Za-z][A-Za-z0-9+.-]+):/"
    r"|(?P<known>s3a?|gs|gcs|gdrive|az|abfss?|adl|s?ftp|ssh|hdfs|webhdfs|https?|file|github|smb|oci)(?::|//))"
    r"/*"
)


def is_address(location: str | Path) -> bool:
    """Check whether a location of a dataset is an address, not a folder.

    Raises:
        RunError: It is empty, or an address that lacks a colon or a slash; has the intended form.

    Example:
        >>> is_address("s3://bucket/s008"), is_address("data/s008"), is_address(Path("data"))
        (True, False, False)
    """
    text = str(location)
    if not text.strip():
        raise RunError("a dataset needs a place: give a folder, or an address as s3://bucket/name")
    if isinstance(location, str) and "://" in text:
        return True
    # A path of Python has one slash where an address has two.
    if found := _ALMOST.match(text):
        scheme = found["scheme"] or found["known"]
        rest = text[found.end() :]
        intended = f"{scheme}://{'/' if scheme == 'file' else ''}{rest}"
        raise RunError(
            f"{text!r} is no address: write {intended!r}, as text; a folder of that name is './{text}'"
        )
    return False


class RemoteDataset:
    """The files of a dataset at an address.

    Args:
        address: Of fsspec: ``s3://bucket/s008``, ``gs://…``, ``sftp://host/path``, ``file:///path``.

    Raises:
        RunError: No package for such addresses is installed, or it refuses the address.

    Example:
        >>> RemoteDataset("file:///data/s008").episodes()
        []
    """

    def __init__(self, address: str) -> None:
        try:
            import fsspec
        except ImportError as error:
            raise SetupError(f"{address} needs fsspec; run: {install_command('datasets')}") from error
        self.address = address.rstrip("/")
        # The package of a protocol says in its error which package is missing.
        with self._errors("cannot be opened"):
            # Other processes write there too: a listing that was kept may be out of date.
            self._files, self._root = fsspec.url_to_fs(self.address, use_listings_cache=False)
        if "memory" in self._files.protocol:
            raise RunError(f"{self.address}: each process has a memory of its own; give a folder, or a store")

    # --- episodes ----------------------------------------------------------------------------------

    def episodes(self) -> list[int]:
        """Numbers of the episodes that are there whole, in order.

        Raises:
            RunError: The store does not answer, or has a folder whose name is nearly that of an episode.
        """
        return list(self.sizes())

    def sizes(self) -> dict[int, int | None]:
        """Size of the recording of each episode that has its marker [B], by its number, in order.

        Returns:
            None where the store does not tell sizes.

        Raises:
            RunError: The store does not answer, or has a folder whose name is nearly that of an episode.
        """
        place = self._at("episodes")
        with self._errors("cannot be read"):
            # One listing: a question for each episode takes minutes for some thousand of them.
            try:
                found = self._files.find(place, detail=True)
            except FileNotFoundError:
                found = {}
        sizes, marked = dict[str, int | None](), list[str]()
        for path, about in found.items():
            *_, folder, file = str(path).split("/")
            if file == MARKER:
                marked.append(folder)
            elif fnmatch(file, SEGMENT_PATTERN):
                size, before = about.get("size"), sizes.get(folder, 0)
                sizes[folder] = None if size is None or before is None else before + int(size)
        numbers = sorted(DatasetDirectory.numbers_of(marked, f"{self.address}/episodes"))
        return {n: sizes.get(DatasetDirectory(Path()).episode(n).name, 0) for n in numbers}

    def put_episode(self, number: int, folder: Path) -> None:
        """Upload the recording of an episode, its marker last.

        Args:
            number: Of the episode.
            folder: Of the recording; an episode of that number that is there is replaced.

        Raises:
            RunError: The store refuses.
        """
        files = sorted(file for file in folder.iterdir() if file.is_file())
        with self._errors("cannot be written"):
            self._files.makedirs(self._at(_episode(number)), exist_ok=True)
            for file in files:
                self._files.put_file(str(file), self._at(_episode(number), file.name))
            sizes = {file.name: file.stat().st_size for file in files}
            self._files.pipe_file(self._marker(number), msgspec.json.encode(sizes) + b"\n")

    def fetch_episode(self, number: int, directory: DatasetDirectory) -> None:
        """Have the recording of an episode in a folder of this machine.

        Args:
            number: Of the episode.
            directory: Where it is kept; nothing is fetched where it is there.

        Raises:
            RecordingError: It is not at the address, or not whole.
            RunError: The store does not answer.
        """
        target = directory.episode(number)
        if target.exists():
            return
        with self._errors("cannot be read"):
            try:
                sizes = msgspec.json.decode(self._files.cat_file(self._marker(number)), type=dict[str, int])
            except FileNotFoundError:
                raise RecordingError(
                    f"{self.address} has no episode {number}: {_episode(number)}/{MARKER} is not there"
                ) from None
            except msgspec.MsgspecError as error:
                raise RecordingError(f"{self.address}/{_episode(number)}/{MARKER}: {error}") from error
            directory.work.mkdir(parents=True, exist_ok=True)
            directory.episodes.mkdir(exist_ok=True)
            work = Path(tempfile.mkdtemp(prefix=f"{number}-", dir=directory.work))
            try:
                folder = work / target.name
                folder.mkdir()
                for name, size in sizes.items():
                    file = folder / Path(name).name
                    self._files.get_file(self._at(_episode(number), file.name), str(file))
                    if file.stat().st_size != size:
                        raise RecordingError(
                            f"{self.address}/{_episode(number)}/{name} has {file.stat().st_size} B, its "
                            f"marker says {size} B: play the episode again"
                        )
                rename_unless_there(folder, target)
            finally:
                shutil.rmtree(work, ignore_errors=True)

    def remove(self) -> None:
        """Remove all episodes, catalogue and scenery; nothing where there is neither catalogue nor episode.

        Raises:
            RunError: The store refuses.
        """
        with self._errors("cannot be written"):
            has_catalogue, numbers = self._files.exists(self._at(_CATALOGUE)), self.episodes()
            for number in numbers:
                self._files.rm(self._at(_episode(number)), recursive=True)
            if (has_catalogue or numbers) and self._files.exists(self._at("assets")):
                self._files.rm(self._at("assets"), recursive=True)
            if has_catalogue:
                self._files.rm(self._at(_CATALOGUE))

    # --- the rest ----------------------------------------------------------------------------------

    def put_assets(self, folder: Path) -> None:
        """Upload the scenery, unless it is there.

        Args:
            folder: Of the scenery.

        Raises:
            RunError: The store refuses.
        """
        with self._errors("cannot be written"):
            for file in sorted(path for path in folder.rglob("*") if path.is_file()):
                target = self._at("assets", file.relative_to(folder).as_posix())
                if self._files.exists(target) and self._files.size(target) == file.stat().st_size:
                    continue
                self._files.makedirs(target.rpartition("/")[0], exist_ok=True)
                self._files.put_file(str(file), target)

    def put_catalogue(self, file: Path) -> None:
        """Upload the catalogue.

        Args:
            file: The closed database.

        Raises:
            RunError: The store refuses.
        """
        with self._errors("cannot be written"):
            self._files.makedirs(self._root, exist_ok=True)
            self._files.put_file(str(file), self._at(_CATALOGUE))

    def fetch_catalogue(self, file: Path) -> bool:
        """Have the catalogue in a file of this machine, as it is at the address now.

        Args:
            file: Which is replaced.

        Returns:
            Whether there is a catalogue.

        Raises:
            RunError: The store does not answer.
        """
        with self._errors("cannot be read"):
            if not self._files.exists(self._at(_CATALOGUE)):
                return False
            file.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=file.parent, prefix=".catalogue-") as work:
                self._files.get_file(self._at(_CATALOGUE), str(Path(work) / _CATALOGUE))
                (Path(work) / _CATALOGUE).replace(file)
            return True

    def fetch_assets(self, directory: DatasetDirectory) -> None:
        """Have the scenery in a folder of this machine; nothing is fetched where it is there.

        Args:
            directory: Where it is kept.

        Raises:
            RunError: The store does not answer.
        """
        if directory.assets.exists():
            return
        top = self._at("assets")
        with (
            self._errors("cannot be read"),
            tempfile.TemporaryDirectory(dir=directory.path, prefix=".assets-") as work,
        ):
            (Path(work) / "assets").mkdir()
            for found in self._files.find(top) if self._files.exists(top) else ():
                file = Path(work) / "assets" / str(found).removeprefix(top).lstrip("/")
                file.parent.mkdir(parents=True, exist_ok=True)
                self._files.get_file(found, str(file))
            rename_unless_there(Path(work) / "assets", directory.assets)

    def written(self) -> DatasetDirectory:
        """The folder of this machine that has the catalogue while a command writes the dataset."""
        return DatasetDirectory(default_folder() / "datasets" / f"{self._key}-written")

    def read(self) -> DatasetDirectory:
        """The folder of this machine that has what is read of the dataset, with the catalogue of now.

        Raises:
            RecordingError: There is no dataset at the address.
            RunError: The store does not answer.
        """
        top = default_folder() / "datasets"
        fetched = top / f"{self._key}-{os.getpid()}.sqlite"
        if not self.fetch_catalogue(fetched):
            raise RecordingError(
                f"{self.address} is no dataset, it has no {_CATALOGUE}; make one with: "
                f"caviar dataset generate SCENARIO --out {self.address}"
            )
        try:
            catalogue = Catalogue(fetched, name=f"{self.address}/{_CATALOGUE}")
            # A recording follows from the settings and its number: what was fetched for these stays right.
            directory = DatasetDirectory(top / f"{self._key}-{fingerprint(catalogue.settings)[:16]}")
            catalogue.close()
            with self._errors("cannot be kept"):
                directory.path.mkdir(exist_ok=True)
                fetched.replace(directory.catalogue)
        finally:
            fetched.unlink(missing_ok=True)
        self.fetch_assets(directory)
        return directory

    @property
    def _key(self) -> str:
        return hashlib.sha256(self.address.encode()).hexdigest()[:16]

    def _at(self, *parts: str) -> str:
        return "/".join((self._root.rstrip("/"), *parts))

    def _marker(self, number: int) -> str:
        return self._at(_episode(number), MARKER)

    @contextmanager
    def _errors(self, what: str) -> Iterator[None]:
        try:
            yield
        except (RecordingError, RunError):
            raise
        # Each store has errors of its own, which share no class but this one.
        except Exception as error:
            said = str(error).strip() or type(error).__name__
            raise RunError(f"{self.address} {what}: {said:.500}") from error


def located(location: str | Path) -> tuple[DatasetDirectory, RemoteDataset | None]:
    """Find a dataset that is to be read.

    Args:
        location: Its folder, or its address.

    Returns:
        The folder; of an address the one in the cache, with the catalogue of now, and what fetches episodes.

    Raises:
        RecordingError: There is no dataset at the address.
        RunError: The store does not answer.
    """
    if not is_address(location):
        return DatasetDirectory(Path(location)), None
    remote = RemoteDataset(str(location))
    return remote.read(), remote


def _episode(number: int) -> str:
    return f"episodes/{DatasetDirectory(Path()).episode(number).name}"
