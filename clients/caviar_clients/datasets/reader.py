"""The reader of a dataset: tables of its catalogue as columns, and recorded arrays a row for each user.

`caviar.dataset` opens a folder that ``caviar generate`` wrote. No knowledge of MCAP or of the wire is needed.
"""

from __future__ import annotations

import random
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from caviar_clients.datasets.catalogue import TABLES, Catalogue
from caviar_clients.datasets.remote import located
from caviar_clients.datasets.user_rows import Columns, Users
from caviar_protocol.errors import RecordingError, suggestion
from caviar_protocol.recording import Recording

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
        Dataset of data/s008: 2086 episodes, 2086 scenes
    """

    def __init__(self, path: str | Path, episodes: Iterable[int] | None = None) -> None:
        self.location = str(path)
        """Folder or address."""
        self.directory, self._remote = located(path)
        """Folder of this machine; of an address that in the cache."""
        self._catalogue = Catalogue(self.directory.catalogue)
        there = self._catalogue.episodes()
        self.episodes = tuple(there) if episodes is None else tuple(episodes)
        """Numbers of the episodes, in the order in which they are read."""
        if lacking := sorted(set(self.episodes) - set(there)):
            has = f"{there[0]} to {there[-1]}" if there else "none"
            raise RecordingError(f"{self.location} has no episode {lacking[0]}; it has {len(there)}: {has}")
        self._open = lru_cache(maxsize=KEPT_RECORDINGS)(self._opened)

    def __len__(self) -> int:
        """Number of episodes."""
        return len(self.episodes)

    def __repr__(self) -> str:
        scenes = int(self.table("episodes")["scenes"].sum()) if self.episodes else 0
        return f"Dataset of {self.location}: {len(self)} episodes, {scenes} scenes"

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
        """How it was made: ``scenario``, ``versions``, ``device``, digests of ``files``."""
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
        """
        if number not in self.episodes:
            raise RecordingError(f"{self.location} has no episode {number} here")
        return self._open(number)

    def split(self, shares: Sequence[float], *, seed: int = 0) -> tuple[Dataset, ...]:
        """Divide the episodes at random, so that no episode is in two parts.

        Args:
            shares: Of the parts, positive; they add up to 1 at most.
            seed: Of the order; the same episodes and seed give the same parts, on every machine.

        Returns:
            A dataset for each share; the last one takes what rounding leaves where they add up to 1.

        Raises:
            ValueError: A share is not positive, or they add up to more than 1.

        Example:
            >>> train, test = Dataset("data/s008").split((0.8, 0.2), seed=1)  # doctest: +SKIP
        """
        if not all(share > 0.0 for share in shares) or sum(shares) > 1.0 + 1e-9:
            raise ValueError(f"shares are {tuple(shares)}: write positive numbers that add up to 1 at most")
        order = sorted(self.episodes)
        random.Random(seed).shuffle(order)  # noqa: S311 - no secret; its algorithm is the same everywhere
        bounds = [round(len(order) * sum(shares[:at])) for at in range(len(shares) + 1)]
        return tuple(Dataset(self.location, sorted(order[low:high])) for low, high in pairwise(bounds))

    def select(self, episodes: Iterable[int]) -> Dataset:
        """These episodes only.

        Args:
            episodes: Their numbers.
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
        columns = Columns.of(cls, names, rows)
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
                    raise RecordingError(
                        f"{self.location} has no users of {column} {name!r}; "
                        f"{suggestion(name, known.tolist())}"
                    )
                mask &= table[column] == name
        return Users(self, table.where(mask))

    def query(self, sql: str, parameters: Sequence[Any] = ()) -> dict[str, NDArray[Any]]:
        """Ask the catalogue in SQL, over all episodes.

        Args:
            sql: A ``SELECT`` on the tables ``episodes``, ``scenes``, ``users``, ``products``, ``timings``.
            parameters: What its question marks stand for.

        Returns:
            A column for each name, as NumPy finds its type.

        Raises:
            RecordingError: SQLite refuses; has its words.
        """
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
        return Recording(self.directory.episode(number))
