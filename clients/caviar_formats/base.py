"""The class that a format extends, the registry of formats, and the loop that writes an export in parts."""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, ClassVar

import msgspec
import numpy as np

from caviar_clients.datasets.user_rows import Columns, Users
from caviar_clients.files import writing
from caviar_protocol.errors import RecordingError, RunError, SetupError, suggestion
from caviar_protocol.files import replace_file
from caviar_protocol.host import install_command
from caviar_protocol.plugins import plugin_class, plugins

if TYPE_CHECKING:
    from caviar_formats.imports import Source

FORMAT_PLUGINS = "caviar.formats"
"""Group of entry points, each a subclass of `Format`, named as the format is."""

SCENES = 64
"""Scenes of a part: its memory is that of an export of any size."""

STATE = ".export.json"
"""File in a folder that is being written: which export it is, and how many of its parts are there."""


@dataclass(frozen=True)
class Part:
    """Part of an export: some consecutive scenes."""

    number: int
    """From 0."""
    users: Users
    """Of these scenes."""
    scenes: Columns
    """Rows of the catalogue's table of scenes."""


class Format:
    """A format of datasets.

    An export is written in parts of some scenes each, in the memory of one part. A part that a kill cut off
    is written again, so that `write` replaces what is there. A format reads columns of the catalogue and
    recorded arrays (`Users`, `TopicArrays`); it decodes nothing of the wire.

    Args:
        flavour: One of `flavours`; empty: the first.

    Raises:
        RunError: There is no such flavour; names those there are.
    """

    flavours: ClassVar[Mapping[str, str]] = {}
    """Variants of the format by name, with what each is; the first is the default."""
    packages: ClassVar[Sequence[str]] = ()
    """Modules beyond the base installation that it imports."""
    extra: ClassVar[str] = "formats"
    """Extra that brings them."""
    needs: ClassVar[Sequence[str]] = ()
    """Recorded arrays without which there is no export: ``channel.a``."""
    of_all_users: ClassVar[bool] = False
    """Whether a file is of all users, so that none are chosen, or of scenes without any."""
    whole_episodes: bool = False
    """Whether no part ends within an episode, whose scenes share a file."""
    temporary: ClassVar[Sequence[str]] = ()
    """Folders of the export that are removed once `finish` has made files of them."""
    frequency_hz: float | None = None
    """Of the carrier, where the files that are read do not have it [Hz]."""
    takes_origin: ClassVar[bool] = False
    """Whether `origin` is of use."""
    origin: tuple[float, float] | None = None
    """Latitude and longitude of the origin of the world [°], where the dataset does not have them."""
    name: str = ""
    """NAME of the commands, of `find_format`."""
    loses: ClassVar[str] = ""
    """Parts of a dataset that the format cannot hold, for the README of the export."""

    def __init__(self, flavour: str = "") -> None:
        if flavour and flavour not in self.flavours:
            known = suggestion(flavour, self.flavours) if self.flavours else "this format has none"
            raise RunError(f"--flavour {flavour!r}: {known}")
        self.flavour = flavour or next(iter(self.flavours), "")

    def begin(self, users: Users) -> None:
        """Look at the whole before its first part, also where an export is continued.

        Args:
            users: All users of the export.

        Raises:
            RecordingError: The dataset lacks what the format needs; names what to record.
            RunError: The format cannot hold what the dataset has; names it.
        """

    def write(self, part: Part, folder: Path) -> None:
        """Write the files of some scenes.

        Args:
            part: The scenes.
            folder: Of the export.

        Raises:
            RecordingError, RunError: As of `begin`.
        """
        raise NotImplementedError

    def finish(self, users: Users, folder: Path) -> None:
        """Write what only the whole says, once all parts are there.

        Args:
            users: All users of the export.
            folder: Of the export, with the files of all parts.
        """

    def readme(self, users: Users) -> str:
        """Describe the files, with shapes, units, conventions, and how they are opened, in Markdown.

        Args:
            users: All users of the export.
        """
        return f"# {users.dataset.name}\n\n{type(self).__doc__ or ''}"

    def read(self, path: Path) -> Source:
        """Open files of the format, of which `import_dataset` makes a dataset.

        Args:
            path: File or folder.

        Raises:
            RunError: They are damaged, or none of the format; names file and place. So does their iterator.
        """
        raise RunError(f"datasets are exported to {self.name or type(self).__name__}, not imported from it")


FORMATS: Mapping[str, str] = {
    "deepmimo": "caviar_formats.deepmimo:DeepMimo",
    "deepsense": "caviar_formats.deepsense:DeepSense",
    "foxglove": "caviar_formats.foxglove:Foxglove",
    "huggingface": "caviar_formats.parquet:HuggingFace",
    "itu": "caviar_formats.itu:Itu",
    "minari": "caviar_formats.minari:Minari",
    "npz": "caviar_formats.npz:Npz",
    "ns3-qd": "caviar_formats.traces:Ns3Qd",
    "p2m": "caviar_formats.p2m:P2m",
    "parquet": "caviar_formats.parquet:Parquet",
    "pcd": "caviar_formats.traces:Pcd",
    "rerun": "caviar_formats.rerun:Rerun",
    "ros2": "caviar_formats.ros2:Ros2",
    "sionna": "caviar_formats.npz:Sionna",
    "viwi": "caviar_formats.viwi:ViWi",
}
"""Places of the formats that come with this distribution, by name."""


def find_format(name: str, flavour: str = "", option: str = "--to") -> Format:
    """Find a format by its name.

    Args:
        name: Of `FORMATS` or of a plug-in.
        flavour: Of the format; empty: its first.
        option: That has the name, for an error.

    Raises:
        RunError: There is no such format, or it has no such flavour; names those there are.
        DeclarationError: A plug-in cannot be loaded, or is no `Format`.
        SetupError: A package that it needs is not installed; the text has the command.
    """
    place = FORMATS.get(name)
    cls = resolve_name(place) if place else plugin_class(FORMAT_PLUGINS, name, Format)
    if cls is None:
        way = "write" if option == "--to" else "read"
        known = [
            key for key, at in FORMATS.items() if getattr(resolve_name(at), way) is not getattr(Format, way)
        ]
        raise RunError(f"{option} {name!r}: {suggestion(name, [*known, *plugins(FORMAT_PLUGINS)])}")
    if lacking := [module for module in cls.packages if find_spec(module) is None]:
        raise SetupError(f"{option} {name} needs {lacking[0]}; run: {install_command(cls.extra)}")
    found: Format = cls(flavour)
    found.name = name
    return found


class _State(msgspec.Struct):
    """Progress of an export: what it is, and how many parts of it are written."""

    export: str
    done: int = 0
    finished: bool = False
    """Whether `Format.finish` is through, which is not to run on folders that are being removed."""


def export_users(
    users: Users, to: Format, out: Path, on_part: Callable[[int, int], None] = lambda done, of: None
) -> None:
    """Write users of a dataset in a format.

    The folder appears when it is whole; what a kill left is continued.

    Args:
        users: Of a dataset, in its order.
        to: The format.
        out: Folder that is made; it may be there, and empty.
        on_part: Called with the scenes that are written, and with all of them.

    Raises:
        RunError: The folder holds something, ``OUT.part`` is of another export, there is nothing to export,
            or a file cannot be written.
        RecordingError, RunError: As of `Format.begin`.
    """
    _require_free(out)
    if type(to).write is Format.write:
        raise RunError(f"datasets are imported from {to.name or type(to).__name__}, not exported to it")
    if to.of_all_users and len(users) != len(users.dataset.users()):
        raise RunError("this format is of all users: leave --carrier, --tx and --object-class out")
    if not len(users) and not to.of_all_users:
        raise RunError(f"{users.dataset.location} has no such users to export; record scene and channel")
    if lacking := [name for name in to.needs if name not in users.recorded()]:
        users.check_names(lacking)
        topics = ", ".join(sorted({f'"{name.partition(".")[0]}"' for name in to.needs}))
        raise RecordingError(
            f"{users.dataset.location} was recorded without {lacking[0]}: write {topics} into `record` below "
            "[run] of the scenario, and generate it again"
        )
    to.begin(users)
    parts = _parts(users, to.whole_episodes)
    folder = out.with_name(f"{out.name}.part")
    with writing(folder), _held(folder, out):
        state = _continued(folder, _identity(users, to))
        scenes, of = 0, len(users.dataset.table("scenes"))
        for part in parts:
            if part.number >= state.done:
                to.write(part, folder)
                state.done = part.number + 1
                replace_file(folder / STATE, msgspec.json.encode(state), durable=False)
            scenes += len(part.scenes)
            on_part(scenes, of)
        if not state.finished:
            to.finish(users, folder)
            state.finished = True
            replace_file(folder / STATE, msgspec.json.encode(state), durable=False)
        for name in to.temporary:
            shutil.rmtree(folder / name, ignore_errors=True)
        (folder / "README.md").write_text(_readme(users, to), encoding="utf-8")
        folder.replace(out)
        (out / STATE).unlink()


def _require_free(out: Path) -> None:
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise RunError(f"{out} is there and not empty; choose another folder with --out")


@contextmanager
def _held(folder: Path, out: Path) -> Iterator[None]:
    """Make a folder and lock it, which a rename keeps, for as long as the block lasts."""
    folder.mkdir(parents=True, exist_ok=True)
    lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise RunError(
                f"another export writes {out} now: wait for it, or choose another --out"
            ) from error
        _require_free(out)  # of an export that has ended in between
        yield
    finally:
        os.close(lock)


def _parts(users: Users, whole_episodes: bool) -> Iterator[Part]:
    """Cut users into those of `SCENES` scenes each; both are sorted by episode and scene."""
    scenes = users.dataset.table("scenes")
    span = scenes["scene"].max() + 1
    of_scene, of_user = (table["episode"] * span + table["scene"] for table in (scenes, users))
    starts = np.arange(0, len(scenes), SCENES)
    if whole_episodes:
        starts = np.unique(np.searchsorted(scenes["episode"], scenes["episode"][starts]))
    for number, (start, stop) in enumerate(pairwise([*starts.tolist(), len(scenes)])):
        low, high = np.searchsorted(of_user, of_scene[[start, stop - 1]] + [0, 1]).tolist()
        yield Part(number, users[low:high], scenes.where(np.arange(start, stop)))


def _identity(users: Users, to: Format) -> str:
    """Name an export by its format and content, so that no other is continued in its place."""
    keys = [users[name].tolist() for name in ("episode", "scene", "carrier", "tx", "rx")]
    digests = users.dataset.table("episodes")["digest"].tolist()
    content = hashlib.sha256(msgspec.json.encode([digests, keys])).hexdigest()
    origin = ":{},{}".format(*to.origin) if to.origin else ""
    return f"{type(to).__module__}:{type(to).__qualname__}:{to.flavour}{origin}:{content}"


def _continued(folder: Path, export: str) -> _State:
    """Read the state of an export that was begun in a folder; a new one where it is empty."""
    file = folder / STATE
    if not file.exists():
        if any(folder.iterdir()):
            raise RunError(f"{folder} is in the way, and no export that was cut off; remove it")
        # From the first part on: a kill during that one leaves an export that can be continued.
        replace_file(file, msgspec.json.encode(_State(export)), durable=False)
    state = msgspec.json.decode(file.read_bytes(), type=_State)
    if state.export != export:
        raise RunError(
            f"{folder} is a part of another export; remove it, or choose another folder with --out"
        )
    return state


def _readme(users: Users, to: Format) -> str:
    """Complete the README of a format with what is not in it, and where the data is from."""
    dataset, text = users.dataset, to.readme(users).rstrip()
    lost = f"\n\n## Not in these files\n\n{to.loses}" if to.loses else ""
    made = ", ".join(f"{name} {version}" for name, version in dataset.settings["versions"].items())
    counts = f"{len(dataset):,} episodes, {len(users):,} users"
    return f"{text}{lost}\n\n## Origin\n\nDataset `{dataset.name}` of CAVIAR: {counts}; {made}.\n"


def only_one(users: Users, column: str) -> str:
    """Find the one carrier, or transmitter, that a format has room for.

    Args:
        users: All users of the export.
        column: ``carrier`` or ``tx``.

    Raises:
        RunError: There are several.
    """
    names: list[str] = np.unique(users[column]).tolist()
    if len(names) > 1:
        raise RunError(
            f"{users.dataset.location} has {', '.join(names)} as {column}, and this format holds one; choose "
            f"with --{column} {names[0]}"
        )
    return names[0]


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Make a table of Markdown.

    Args:
        head: Titles of the columns.
        rows: Their cells.
    """
    lines = [head, ["---"] * len(head), *rows]
    cells = ([str(cell).replace("|", "\\|") for cell in line] for line in lines)
    return "\n".join(f"| {' | '.join(line)} |" for line in cells)
