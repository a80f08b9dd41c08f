"""Ledger of a dataset: its catalogue against its recordings, before more is played.

The catalogue may be lost, or know of less than there is after a kill: recordings tell what they are, and are
listed anew. One that is damaged is refused by name, and nothing is removed but by the user.
"""

from __future__ import annotations

import shutil
import tempfile
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from caviar_clients.datasets.catalogue import Catalogue
from caviar_clients.datasets.directory import DatasetDirectory
from caviar_clients.datasets.episode import MEASURED, SETTINGS
from caviar_clients.datasets.plan import DatasetPlan
from caviar_clients.datasets.remote import RemoteDataset
from caviar_clients.datasets.rows import rows_of, whole_recording
from caviar_clients.datasets.settings import fingerprint, refusal
from caviar_clients.datasets.texts import counted
from caviar_protocol.errors import RecordingError, RunError
from caviar_protocol.recording import Recording
from caviar_protocol.scenario import Scenario
from caviar_protocol.scenario.rules import resolved

SHOWN = 3
"""Recordings that an error names."""


class _Measured(msgspec.Struct):
    """File beside a recording (`episode.MEASURED`), as far as the catalogue has columns for it."""

    settings: str = ""
    started: str | None = None
    host: str | None = None
    pid: int | None = None
    wall_s: float | None = None
    cpu_s: float | None = None
    memory_mib: float | None = None
    services_s: dict[str, float] = {}


class MissingEpisodes(Sequence[int]):
    """Numbers of the episodes that are not there, in order; no list of them is made.

    Args:
        there: Numbers of those that are there.
        episodes: How many there shall be.

    Example:
        >>> left = MissingEpisodes([0, 2, 3], 10**9)
        >>> len(left), left[0], left[1], left[-1]
        (999999997, 1, 4, 999999999)
    """

    def __init__(self, there: Sequence[int], episodes: int) -> None:
        self._there = sorted({number for number in there if number < episodes})
        self._episodes = episodes

    def __len__(self) -> int:
        return self._episodes - len(self._there)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[at] for at in range(*index.indices(len(self)))]
        at = index + len(self) if index < 0 else index
        if not 0 <= at < len(self):
            raise IndexError(f"{index} of {len(self)} missing episodes")
        # The k-th of those that are there has there[k] - k missing ones below it.
        return at + bisect_right(range(len(self._there)), at, key=lambda k: self._there[k] - k)


@dataclass(frozen=True)
class Ledger:
    """Recordings and catalogue of a dataset, and their place.

    Args:
        plan: What shall be there.
        settings: Of the plan (`plan.DatasetPlan.settings`).
        out: Folder or address, as the user wrote it.
        directory: Of the catalogue; of a folder that of the recordings too.
        remote: Of an address.
        catalogue: Writable.
    """

    plan: DatasetPlan
    settings: Mapping[str, Any]
    out: str
    directory: DatasetDirectory
    remote: RemoteDataset | None
    catalogue: Catalogue

    @property
    def began(self) -> bool:
        """True where anything of the dataset is there, so that its catalogue is worth keeping."""
        return any((self.catalogue.settings, self.catalogue.episodes(), self.catalogue.failures()))

    @property
    def place(self) -> str:
        """Folder or address, as every process of this machine sees it."""
        return self.out if self.remote is not None else str(self.directory.path.resolve())

    def sizes(self) -> dict[int, int | None]:
        """Size of each recording that is there [B], by the number of its episode, in order.

        Returns:
            None where a store does not tell sizes.
        """
        if self.remote is not None:
            return self.remote.sizes()
        return {number: self.directory.size_of(number) for number in self.directory.finished()}

    def keep_plan(self) -> None:
        """Keep the settings and the number of episodes, here and at the address: episodes are played now."""
        is_same = fingerprint(self.catalogue.settings) == fingerprint(self.settings)
        before = self.catalogue.planned if is_same else 0
        self.catalogue.plan(self.settings, max(self.plan.episodes, before))
        self.upload()  # so that another machine can go on where this one is lost

    def upload(self) -> None:
        """Have the catalogue of now at the address."""
        if self.remote is None or not self.catalogue.settings:
            return
        with tempfile.TemporaryDirectory(dir=self.directory.work) as folder:
            copy = Path(folder) / self.directory.catalogue.name
            self.catalogue.copy_to(copy)
            self.remote.put_catalogue(copy)

    def refuse_other_dataset(self) -> None:
        """Raise `RunError` where the catalogue is of another dataset, and episodes of it are there."""
        before = self.catalogue.settings
        if not before:
            # Recordings are compared one by one when they are listed, as they all are then.
            self.catalogue.forget(self.catalogue.episodes())
        elif fingerprint(before) != fingerprint(self.settings) and (
            self.catalogue.episodes() or self.sizes()
        ):
            what = f"{self.out} holds another dataset"
            text = refusal(what, _with_defaults(before), _with_defaults(self.settings))
            raise RunError(text or refusal(what, before, self.settings))

    def compare_with_recordings(self, note: Callable[[str], None]) -> None:
        """List recordings that are not in the catalogue, and forget those that were removed.

        Args:
            note: Called with a line for the user.

        Raises:
            RunError: A recording is of another dataset or episode, or damaged: those that are not are listed.
        """
        recorded, listed = self.sizes(), self.catalogue.sizes()
        damaged = dict[int, str]()
        unlisted = [number for number in recorded if number not in listed]
        if unlisted:
            first = f"episode {unlisted[0]} the first"
            note(f"{counted(len(unlisted), 'recording')} not in the catalogue, {first}: now listed")
        for number in unlisted:
            try:
                self._list(number)
            except RecordingError as error:
                damaged[number] = str(error)
        if gone := [number for number in listed if number not in recorded]:
            note(f"{counted(len(gone), 'recording')} removed, episode {gone[0]} the first: played again")
            self.catalogue.forget(gone)
        for number, size in recorded.items():
            if size is not None and number in listed and size != listed[number]:
                damaged[number] = f"{self._at(number)} has {size} B of {listed[number]} B"
        if damaged:
            shown = list(damaged)[:SHOWN]
            said, places = "; ".join(map(damaged.__getitem__, shown)), ", ".join(map(self._at, shown))
            more = (
                f" and others, which caviar dataset verify {self.out} names," if len(damaged) > SHOWN else ""
            )
            raise RunError(
                f"{counted(len(damaged), 'recording')} damaged: {said}; remove {places}{more} and run the "
                "same command, which plays what is missing"
            )

    def _at(self, number: int) -> str:
        if self.remote is not None:
            return f"{self.remote.address}/episodes/{self.directory.episode(number).name}"
        return str(self.directory.episode(number))

    def _list(self, number: int) -> None:
        """List a recording that is there."""
        if self.remote is not None:
            self.remote.fetch_episode(number, self.directory)
        folder = self.directory.episode(number)
        try:
            recording = whole_recording(lambda: Recording(folder))
            rows = rows_of(recording)
            if rows.episode[0] != number:
                raise RunError(
                    f"{self._at(number)} has the recording of episode {rows.episode[0]}, not of {number}: "
                    "remove it and run the same command, which plays the episode"
                )
            measured = _measured(folder)
            self._refuse_other_recording(recording, number, measured.settings)
            if not self.catalogue.settings:
                self.catalogue.plan(self.settings, 0)
            self.catalogue.add(rows, _known(measured))
        finally:
            if self.remote is not None:
                shutil.rmtree(folder, ignore_errors=True)

    def _refuse_other_recording(self, recording: Recording, number: int, settings: str) -> None:
        """Raise `RunError` where a recording follows from other settings than those of the plan.

        Args:
            recording: It holds scenario and versions, but neither the kind of device nor digests of files.
            number: Of the episode.
            settings: Digest of its settings, where one stands beside it.
        """
        if settings == fingerprint(self.settings):
            return
        found = {"scenario": recording.metadata.scenario, "versions": recording.metadata.versions}
        code = {f"code of {name}": digest[:16] for name, digest in self.settings.get("code", {}).items()}
        right = {"scenario": self.settings["scenario"], "versions": {**self.settings["versions"], **code}}
        otherwise = "the device, or the content of a file, is another one" if settings else ""
        what = f"{self._at(number)} is of another dataset"
        if text := refusal(what, _with_defaults(found), _with_defaults(right), otherwise):
            raise RunError(text)


def _with_defaults(made_from: Mapping[str, Any]) -> Mapping[str, Any]:
    """Scenario and versions in one form, whether or not defaults were left out."""
    try:
        scenario = msgspec.convert(made_from["scenario"], Scenario, strict=False)
    except msgspec.ValidationError:  # of another version, which then differs anyway
        return made_from
    # As JSON: tuples and lists are the same there.
    return {**made_from, "scenario": msgspec.json.decode(msgspec.json.encode(resolved(scenario)))}


def _measured(folder: Path) -> _Measured:
    """Read the file beside a recording; empty where it cannot be read, since nothing follows from it."""
    try:
        return msgspec.json.decode((folder / MEASURED).read_bytes(), type=_Measured)
    except (OSError, msgspec.MsgspecError):
        return _Measured()


def _known(measured: _Measured) -> dict[str, Any]:
    """The row of table `timings`; empty where the start is not known."""
    if measured.started is None:
        return {}
    return {name: value for name, value in msgspec.structs.asdict(measured).items() if name != SETTINGS}
