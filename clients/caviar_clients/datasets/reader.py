"""The reader of a dataset: tables of its catalogue as columns, and recorded arrays a row for each user.

`caviar.dataset` opens a folder that ``caviar dataset generate`` wrote. No knowledge of MCAP or of the wire is
needed.
"""

from __future__ import annotations

import operator
import random
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from caviar_clients.datasets.catalogue import TABLES, Catalogue
from caviar_clients.datasets.directory import DatasetDirectory
from caviar_clients.datasets.remote import is_address, located
from caviar_clients.datasets.texts import counted
from caviar_clients.datasets.user_rows import Columns, Users
from caviar_protocol.errors import RecordingError, suggestion
from caviar_protocol.recording import Recording
from caviar_protocol.run_directory import RunDirectory
from caviar_protocol.space.codebooks import CODEBOOKS_FOLDER, add_codebook_files

if TYPE_CHECKING:
    from caviar_clients.datasets.impulse_responses import ImpulseResponses

_READS = re.compile(r"(?:\s|--[^\n]*\n|/\*.*?\*/)*(?:select|with)\b", re.IGNORECASE | re.DOTALL)
KEPT_RECORDINGS = 16
"""Recordings that stay open: mapped into memory, not read."""


class Dataset:
    """A dataset, or some episodes of one.

    Args:
        path: Folder of the dataset, or its address (``s3://bucket/s008``): what is read of it is then kept in
            the cache of the user.
        episodes: Numbers of episodes; None: all that are there.

    Raises:
        RecordingError: The folder has no catalogue, or it cannot be read; or an episode is not there.
        RunError: The store of an address does not answer.

    Example:
        >>> data = Dataset("data/s008")  # doctest: +SKIP
        >>> data  # doctest: +SKIP
        Dataset of data/s008: 2,086 episodes, 2,086 scenes
    """

    def __init__(self, path: str | Path, episodes: Iterable[int] | None = None) -> None:
        self.location = str(path)
        """Folder or address."""
        check_level(path)
        self.directory, self._remote = located(path)
        """Folder of this machine; of an address that in the cache."""
        self._catalogue = Catalogue(self.directory.catalogue)
        add_codebook_files(self.assets.glob(f"{CODEBOOKS_FOLDER}*"))
        there = self._catalogue.episodes()
        self.episodes = tuple(there) if episodes is None else _numbers(episodes)
        """Numbers of the episodes, in the order in which they are read."""
        if lacking := sorted(set(self.episodes) - set(there)):
            raise RecordingError(f"{self.location} has no episode {lacking[0]}; it has {_range(there)}")
        self._open = lru_cache(maxsize=KEPT_RECORDINGS)(self._opened)

    def __len__(self) -> int:
        """Number of episodes."""
        return len(self.episodes)

    def __repr__(self) -> str:
        scenes = int(self.table("episodes")["scenes"].sum()) if self.episodes else 0
        counts = f"{counted(len(self), 'episode')}, {counted(scenes, 'scene')}"
        return f"Dataset of {self.location}: {counts}"

    def __getstate__(self) -> dict[str, Any]:
        # Of processes that load in parallel each opens its own files.
        return {"location": self.location, "episodes": self.episodes}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        self.__init__(state["location"], state["episodes"])  # type: ignore[misc]

    @property
    def name(self) -> str:
        """Last part of its folder or address."""
        return Path(self.location).resolve().name

    @property
    def settings(self) -> dict[str, Any]:
        """Settings that it was made with: ``scenario``, ``versions``, ``device``, digests of ``files``."""
        return self._catalogue.settings

    @property
    def assets(self) -> Path:
        """Folder of the scenery: meshes, and the file that names their materials."""
        return self.directory.assets

    def episode(self, number: int) -> Recording:
        """The recording of an episode: ``data.episode(7)["channel"].h``.

        Args:
            number: Of the episode.

        Raises:
            RecordingError: It is none of this dataset, or its recording cannot be read.
            TypeError: It is no whole number.
        """
        number = _number(number, "number is")
        if number not in self.episodes:
            raise RecordingError(
                f"{self.location} has no episode {number} here; it has {_range(sorted(self.episodes))}"
            )
        return self._open(number)

    def split(self, shares: Sequence[float], *, seed: int = 0) -> tuple[Dataset, ...]:
        """Divide the episodes at random, so that no episode is in two parts.

        Args:
            shares: Of the parts, positive; they add up to 1 at most.
            seed: Of the order; the same episodes and seed give the same parts, on every machine.

        Returns:
            A dataset for each share; the last one takes what rounding leaves where they add up to 1.

        Raises:
            ValueError: There is no share, one is not positive, they add up to more than 1, or a part gets no
                episode.
            TypeError: It is a number: a part lacks its share.

        Example:
            >>> train, test = Dataset("data/s008").split((0.8, 0.2), seed=1)  # doctest: +SKIP
        """
        if isinstance(shares, int | float):
            rest = f"{1.0 - shares:.4g}" if 0.0 < shares < 1.0 else "0.2"
            first = f"{shares:g}" if 0.0 < shares < 1.0 else "0.8"
            raise TypeError(f"shares is {shares!r}: write a share for each part, as ({first}, {rest})")
        shares = tuple(shares)
        are_numbers = all(isinstance(share, int | float) and share > 0.0 for share in shares)
        if not shares or not are_numbers or sum(shares) > 1.0 + 1e-9:
            raise ValueError(f"shares are {shares}: write positive numbers that add up to 1 at most")
        order = sorted(self.episodes)
        random.Random(seed).shuffle(order)  # noqa: S311 - no secret; its algorithm is the same everywhere
        bounds = [round(len(order) * sum(shares[:at])) for at in range(len(shares) + 1)]
        empty = next((at for at, (low, high) in enumerate(pairwise(bounds)) if low == high), None)
        if empty is not None:
            least = max(1.0 / max(len(order), 1), 0.01)
            remedy = f", or give it {least:.2g} at least" if len(order) >= len(shares) else ""
            raise ValueError(
                f"shares are {shares}: of {counted(len(order), 'episode')} part {empty + 1} gets none; "
                f"divide more episodes{remedy}"
            )
        return tuple(Dataset(self.location, sorted(order[low:high])) for low, high in pairwise(bounds))

    def select(self, episodes: Iterable[int]) -> Dataset:
        """These episodes only.

        Args:
            episodes: Their numbers, each once; they are read in this order.

        Raises:
            RecordingError: One is not there.
            ValueError: One is named twice.
            TypeError: It is no list of whole numbers.
        """
        return Dataset(self.location, episodes)

    def table(self, name: str) -> Columns:
        """A table of the catalogue, for these episodes, as columns.

        Args:
            name: ``episodes``, ``scenes``, ``users`` or ``products``.

        Returns:
            NumPy arrays by name; NaN where there is no number, −1 where there is no index.

        Raises:
            RecordingError: There is no such table.
        """
        if name not in TABLES:
            raise RecordingError(f"there is no table {name!r}; {suggestion(name, TABLES)}")
        cls, _ = TABLES[name]
        names, rows = self._catalogue.table(name)
        columns = Columns.of_rows(cls, names, rows)
        wanted = np.isin(columns["episode"], self.episodes)
        return columns if wanted.all() else columns.where(wanted)

    def users(
        self,
        *,
        valid: bool | None = None,
        los: bool | None = None,
        carrier: str | None = None,
        tx: str | None = None,
        object_class: str | None = None,
    ) -> Users:
        """The users of all scenes: receivers, for each carrier and transmitter; each argument narrows them.

        Args:
            valid: Whether a path reaches the receiver.
            los: Whether its line of sight is free.
            carrier: Name of a carrier.
            tx: Name of a transmitter.
            object_class: Of the object that carries the receiver, ``"car"``.

        Raises:
            RecordingError: There is no such carrier, transmitter or class here.

        Example:
            >>> users = Dataset("data/s008").users(valid=True)  # doctest: +SKIP
            >>> users["gain_db"].shape, users["channel.h"].shape  # doctest: +SKIP
            ((11194,), (11194, 8, 64))
        """
        table = self.table("users")
        mask = np.ones(len(table), dtype=bool)
        for column, wanted in (("valid", valid), ("los", los)):
            if wanted is not None:
                mask &= table[column] == wanted
        for column, name in (("carrier", carrier), ("tx", tx), ("object_class", object_class)):
            if name is not None:
                known = np.unique(table[column])
                if name not in known:
                    names = [each or f"'' (no {column})" for each in known.tolist()]
                    raise RecordingError(
                        f"{self.location} has no users of {column} {name!r}; {suggestion(name, names)}"
                    )
                mask &= table[column] == name
        return Users(self, table.where(mask))

    def cir(self, **narrowing: Any) -> ImpulseResponses:
        """Impulse responses of the users with a path, for Sionna's ``CIRDataset`` (`Users.cir`).

        Args:
            narrowing: As of `users`.

        Raises:
            RecordingError: As of `users` and `Users.cir`.

        Example:
            >>> cir = Dataset("data/s008").cir(tx="bs")  # doctest: +SKIP
            >>> channel = sionna.phy.channel.CIRDataset(cir, batch_size=64, **cir.shape)  # doctest: +SKIP
        """
        return self.users(**{"valid": True, **narrowing}).cir()

    def query(self, sql: str, parameters: Sequence[Any] = ()) -> dict[str, NDArray[Any]]:
        """Ask the catalogue in SQL, over all episodes; nothing is written.

        Args:
            sql: A ``SELECT``, also after ``WITH``, on the tables ``episodes``, ``scenes``, ``users``,
                ``products``, ``timings`` and ``failures``.
            parameters: What its question marks stand for.

        Returns:
            A column for each name, as NumPy finds its type.

        Raises:
            RecordingError: It is another statement, or SQLite refuses; has its words.
        """
        # The catalogue is opened for reading, but ATTACH makes files elsewhere.
        if not _READS.match(sql):
            raise RecordingError(f"query({sql[:60]!r}): write one SELECT, or WITH … SELECT, on the catalogue")
        names, rows = self._catalogue.query(sql, parameters)
        columns = zip(*rows, strict=True) if rows else ((),) * len(names)
        return {name: np.array(column) for name, column in zip(names, columns, strict=True)}

    def scenes(self) -> Iterator[tuple[int, int]]:
        """(episode, scene) of all scenes, in order."""
        table = self.table("scenes")
        yield from zip(table["episode"].tolist(), table["scene"].tolist(), strict=True)

    def finished(self) -> list[int]:
        """Numbers of the episodes whose recordings are there now, in order."""
        there = self._remote.episodes() if self._remote is not None else self.directory.finished()
        return sorted(set(there).intersection(self.episodes))

    def _opened(self, number: int) -> Recording:
        if self._remote is not None:
            self._remote.fetch_episode(number, self.directory)
        folder, there = self.directory.episode(number), self.directory.size_of(number)
        # H of one dataset and labels of another would look like a result.
        _, rows = self._catalogue.query("SELECT bytes FROM episodes WHERE episode = ?", (number,))
        if rows and there and there != (listed := rows[0][0]):
            raise RecordingError(
                f"{folder} is not the recording that the catalogue lists, which has {listed:,} B; it has "
                f"{there:,} B. Remove the folder, and the generate command plays the episode again"
            )
        return Recording(folder)


def check_level(location: str | Path) -> None:
    """Check that a folder is not one inside a dataset, or one that holds datasets.

    Args:
        location: Folder of a dataset, or its address, which is not looked at.

    Raises:
        RecordingError: It is on another level; the text has the folder of the dataset.
    """
    if is_address(location) or DatasetDirectory(path := Path(location)).catalogue.is_file():
        return
    if path.is_dir() and RunDirectory(path).segments():
        level = (
            "the recording of an episode" if DatasetDirectory.number_of(path.name) is not None else "a run"
        )
        inspect = f"caviar inspect {path} and caviar.open({str(path)!r}) read it"
        above = _dataset_above(path)
        raise RecordingError(f"{path} is {level}: {f'its dataset is {above}; ' if above else ''}{inspect}")
    if above := _dataset_above(path):
        raise RecordingError(f"{path} is a part of a dataset: give {above}")
    below = sorted(file.parent for file in path.glob(f"*/{DatasetDirectory(path).catalogue.name}"))
    if below:
        raise RecordingError(f"{path} is no dataset, it holds {len(below)}: give one of them, as {below[0]}")


def _dataset_above(path: Path) -> Path | None:
    """The dataset that a path lies in, up to the files of an episode."""
    above = path.absolute().parents[:3]
    found = next((folder for folder in above if DatasetDirectory(folder).catalogue.is_file()), None)
    here = Path.cwd()
    return found.relative_to(here) if found is not None and found.is_relative_to(here) else found


def _numbers(episodes: Iterable[int]) -> tuple[int, ...]:
    if isinstance(episodes, str | bytes) or not isinstance(episodes, Iterable):
        raise TypeError(f"episodes is {episodes!r}: write a list of numbers, as [{episodes!r}]")
    found = list[int]()
    for number in episodes:
        found.append(_number(number, "episodes has"))
    if len(set(found)) < len(found):
        twice = next(number for number in found if found.count(number) > 1)
        raise ValueError(f"episodes has {twice} {found.count(twice)} times: name each once")
    return tuple(found)


def _number(value: Any, what: str) -> int:
    """The number of an episode, which begins an error as `what`."""
    if isinstance(value, bool) or not hasattr(value, "__index__"):
        is_whole = isinstance(value, float) and value.is_integer()
        text = str(int(value) if is_whole else value).strip()
        raise TypeError(
            f"{what} {value!r}, a {type(value).__name__}: the number of an episode is an int, write "
            f"{text if text.isdecimal() else 0}"
        )
    return operator.index(value)


def _range(episodes: Sequence[int]) -> str:
    """Say which episodes there are."""
    return f"{len(episodes)}: {episodes[0]} to {episodes[-1]}" if episodes else "none"
