"""The class that a format extends, the registry of formats, and the loop that writes an export in parts."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from pkgutil import resolve_name
from typing import ClassVar

import msgspec

from caviar_clients.datasets.user_rows import Users
from caviar_clients.files import writing
from caviar_protocol.errors import RunError, suggestion
from caviar_protocol.files import replace_file
from caviar_protocol.plugins import plugin_class, plugins

FORMAT_PLUGINS = "caviar.formats"
"""Group of entry points, each a subclass of `Format`, named as the format is."""

EPISODES = 64
"""Episodes of a part."""

STATE = ".export.json"
"""File in a folder that is being written: which export it is, and how many of its parts are there."""


class Format(ABC):
    """A format of datasets.

    An export is written in parts of some episodes each, in the memory of one part. A part that a kill cut off
    is written again, so that `write` replaces what is there.

    Args:
        flavour: One of `flavours`; empty: the first.

    Raises:
        RunError: There is no such flavour; names those there are.
    """

    flavours: ClassVar[Mapping[str, str]] = {}
    """Variants of the format by name, with what each is; the first is the default."""
    loses: ClassVar[str] = ""
    """Parts of a dataset that the format cannot hold, for the README of the export."""

    def __init__(self, flavour: str = "") -> None:
        if flavour and flavour not in self.flavours:
            known = suggestion(flavour, self.flavours) if self.flavours else "this format has none"
            raise RunError(f"--flavour {flavour!r}: {known}")
        self.flavour = flavour or next(iter(self.flavours), "")

    def begin(self, users: Users) -> None:  # noqa: B027 - most formats need no look
        """Look at the whole before its first part, also where an export is continued.

        Args:
            users: All users of the export.

        Raises:
            RecordingError: The dataset lacks what the format needs; names what to record.
            RunError: The format cannot hold what the dataset has; names it.
        """

    @abstractmethod
    def write(self, users: Users, folder: Path, number: int) -> None:
        """Write the files of some episodes.

        Args:
            users: Of these episodes; ``users.dataset`` has the episodes alone.
            folder: Of the export.
            number: Of the part, from 0.

        Raises:
            RecordingError, RunError: As of `begin`.
        """

    def finish(self, users: Users, folder: Path) -> None:  # noqa: B027 - parts are all there is to most
        """Write what only the whole says, once all parts are there.

        Args:
            users: All users of the export.
            folder: Of the export, with the files of all parts.
        """

    @abstractmethod
    def readme(self, users: Users) -> str:
        """Describe the files, with shapes, units, conventions, and how they are opened, in Markdown.

        Args:
            users: All users of the export.
        """


FORMATS: Mapping[str, str] = {
    "huggingface": "caviar_formats.huggingface:HuggingFace",
    "itu": "caviar_formats.itu:Itu",
    "npz": "caviar_formats.npz:Npz",
    "parquet": "caviar_formats.parquet:Parquet",
    "sionna": "caviar_formats.sionna:Sionna",
}
"""Places of the formats that come with this distribution, by name."""


def find_format(name: str, flavour: str = "") -> Format:
    """Find a format by its name.

    Args:
        name: Of `FORMATS` or of a plug-in.
        flavour: Of the format; empty: its first.

    Raises:
        RunError: There is no such format, or it has no such flavour; names those there are.
        DeclarationError: A plug-in cannot be loaded, or is no `Format`.
    """
    if place := FORMATS.get(name):
        found: type[Format] = resolve_name(place)
        return found(flavour)
    cls = plugin_class(FORMAT_PLUGINS, name, Format)  # type: ignore[type-abstract]  # compared, never made
    if cls is None:
        known = [*FORMATS, *plugins(FORMAT_PLUGINS)]
        raise RunError(f"--to {name!r} is no format; {suggestion(name, known)}")
    return cls(flavour)


class _State(msgspec.Struct):
    """Progress of an export: what it is, and how many parts of it are written."""

    export: str
    done: int = 0


def export_users(
    users: Users, to: Format, out: Path, on_part: Callable[[int, int], None] = lambda done, of: None
) -> None:
    """Write users of a dataset in a format.

    The folder appears when it is whole; what a kill left is continued.

    Args:
        users: Of a dataset, in its order.
        to: The format.
        out: Folder that is made; it may be there, and empty.
        on_part: Called with the episodes that are written, and with all of them.

    Raises:
        RunError: The folder holds something, ``OUT.part`` is of another export, there is nothing to export,
            or a file cannot be written.
        RecordingError, RunError: As of `Format.begin`.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise RunError(f"{out} is there and not empty; choose another folder with --out")
    dataset = users.dataset
    if not len(users):
        raise RunError(f"{dataset.location} has no such users to export")
    to.begin(users)
    parts = [dataset.episodes[at : at + EPISODES] for at in range(0, len(dataset), EPISODES)]
    folder = out.with_name(f"{out.name}.part")
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        state = _continued(folder, _identity(users, to))
        for number, episodes in enumerate(parts):
            if number >= state.done:
                to.write(users.of(dataset.select(episodes)), folder, number)
                state.done = number + 1
                replace_file(folder / STATE, msgspec.json.encode(state), durable=False)
            on_part(sum(map(len, parts[: number + 1])), len(dataset))
        to.finish(users, folder)
        (folder / "README.md").write_text(_readme(users, to), encoding="utf-8")
        (folder / STATE).unlink()
        folder.replace(out)


def _identity(users: Users, to: Format) -> str:
    """Name an export by its format and content, so that no other is continued in its place."""
    keys = [users[name].tolist() for name in ("episode", "scene", "carrier", "tx", "rx")]
    digests = users.dataset.table("episodes")["digest"].tolist()
    content = hashlib.sha256(msgspec.json.encode([digests, keys])).hexdigest()
    return f"{type(to).__module__}:{type(to).__qualname__}:{to.flavour}:{content}"


def _continued(folder: Path, export: str) -> _State:
    """Read the state of an export that was begun in a folder; a new one where it is empty."""
    file = folder / STATE
    if not file.exists():
        if any(folder.iterdir()):
            raise RunError(f"{folder} is in the way, and no export that was cut off; remove it")
        return _State(export)
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


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Make a table of Markdown.

    Args:
        head: Titles of the columns.
        rows: Their cells.
    """
    lines = [head, ["---"] * len(head), *rows]
    cells = ([str(cell).replace("|", "\\|") for cell in line] for line in lines)
    return "\n".join(f"| {' | '.join(line)} |" for line in cells)
