"""A run as a dataset: its episodes in a catalogue that lasts as long as it is read."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from caviar_clients.datasets.catalogue import Catalogue
from caviar_clients.datasets.directory import DatasetDirectory
from caviar_clients.datasets.reader import Dataset, check_level
from caviar_clients.datasets.remote import is_address
from caviar_clients.datasets.rows import rows_of, whole_recording
from caviar_clients.datasets.settings import FORMAT
from caviar_protocol.errors import RecordingError, RunError
from caviar_protocol.files import PrivateFolder
from caviar_protocol.recording import Recording
from caviar_protocol.run_directory import RunDirectory


@contextmanager
def open_source(source: str) -> Iterator[Dataset]:
    """Open a dataset, or a run as one.

    Args:
        source: Folder or address of a dataset, or folder of a run.

    Raises:
        RecordingError: It is neither, or damaged.
    """
    run = Path(source)
    if is_address(source) or not RunDirectory(run).segments():
        if not is_address(source) and not DatasetDirectory(run).catalogue.exists() and run.is_dir():
            check_level(source)
            if below := sorted(folder for folder in run.iterdir() if RunDirectory(folder).segments()):
                raise RecordingError(
                    f"{run} is no run, it holds {len(below)}: give one of them, as {below[0]}"
                )
        yield Dataset(source)
        return
    recording = whole_recording(lambda: Recording(run))
    with PrivateFolder("caviar-run-") as folder:
        directory = DatasetDirectory(folder.path / run.resolve().name)
        directory.episodes.mkdir(parents=True)
        directory.assets.symlink_to(RunDirectory(run).assets.resolve())
        catalogue = Catalogue(directory.catalogue, writable=True)
        rows, metadata = rows_of(recording), recording.metadata
        numbers = sorted({row[0] for row in rows.scenes})
        for number in numbers:
            scenes, users, products = (
                tuple(row for row in table if row[0] == number)
                for table in (rows.scenes, rows.users, rows.products)
            )
            episode = (number, len(scenes), *rows.episode[2:])
            catalogue.add(replace(rows, episode=episode, scenes=scenes, users=users, products=products), {})
            directory.episode(number).symlink_to(run.resolve())
        settings = {
            "format": FORMAT,
            "scenario": metadata.scenario,
            "files": {},
            "versions": metadata.versions,
            "device": "",
        }
        catalogue.plan(settings, len(numbers))
        catalogue.close()
        try:
            yield Dataset(directory.path)
        except (RecordingError, RunError) as error:
            raise type(error)(str(error).replace(str(directory.path), source)) from error
