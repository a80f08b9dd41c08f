"""Inputs of SUMO: its options as it understands them, and its files, checked before it starts.

SUMO leaves out traffic that is out of order, draws random numbers by the clock where an option says so, and
writes and reads where a configuration or an additional file says. What of this breaks a promise of a run is
refused here, or named.
"""

from __future__ import annotations

import gzip
import math
import subprocess
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple
from xml.etree import ElementTree as ET
from xml.parsers import expat

from caviar_protocol.errors import ScenarioError, SetupError
from caviar_protocol.host import install_command

_REFUSED: Mapping[str, str] = {
    "random": "seeds SUMO by the clock, and equal seeds of a run have to give equal traffic",
    "mesosim": "moves vehicles through queues, in which they have no place on the road",
    "remote-port": "lets SUMO wait for a client of TraCI",
    "save-state.files": "lets SUMO write its state",
    "save-state.period": "lets SUMO write its state",
    "save-state.times": "lets SUMO write its state",
}
"""Options of SUMO that break a promise of a run, and why."""

_NAMED: Mapping[str, str] = {
    "no-internal-links": "vehicles jump over junctions",
    "ignore-route-errors": "vehicles without a valid route jump over its gaps",
    "max-depart-delay": "vehicles that wait longer to depart never come",
}
"""Options that a run takes, and what a user has to know of them."""

_NOWHERE = ("", "NUL", "nul", "/dev/null")
"""Files to which SUMO writes nothing."""

_WRITES = (
    *("-output", ".output", "netstate-dump", "log"),
    *("ssm.file", "toc.file", "jupedsim.wkt", "jupedsim.py"),
)
"""How options end that name a file which SUMO writes; what says more of an output ends otherwise."""

_ROOTS = {
    "net": ("net",),
    "config": ("configuration", "sumoConfiguration"),
    "routes": ("routes",),
    "additional": ("additional", "add", "routes"),
}

_OPTION_OF = {
    "config": "configuration-file",
    "net": "net-file",
    "routes": "route-files",
    "additional": "additional-files",
}

# Elements of traffic, and which attribute says when it begins.
_DEPARTS = {
    "flow": "begin",
    "personFlow": "begin",
    "vehicle": "depart",
    "trip": "depart",
    "person": "depart",
}

# Elements whose attribute `file` SUMO reads. Detectors, mean data and probes write to theirs.
_READS = frozenset({"calibrator", "rerouter", "variableSpeedSign"})


class Options(NamedTuple):
    """SUMO's options, those of a configuration and of a command line merged by SUMO itself."""

    values: Mapping[str, str]
    """By their long name, those that are set; files with absolute paths."""
    outputs: tuple[str, ...]
    """Those that name a file which SUMO would write."""

    def files(self, option: str) -> list[str]:
        """Paths that an option lists.

        Args:
            option: Its long name.
        """
        return [name for name in self.values.get(option, "").split(",") if name]


@cache  # episodes in one process have the same
def merged_options(arguments: tuple[str, ...]) -> Options:
    """Merge SUMO's options as SUMO does, without a simulation.

    Args:
        arguments: Of SUMO's command line.

    Raises:
        SetupError: SUMO is not installed, or refuses them; has its own words.
    """
    try:
        import sumo
    except ImportError as error:
        raise SetupError(f"the world `sumo` needs SUMO ({error}); run: {install_command('world')}") from error
    command = [str(Path(sumo.SUMO_HOME, "bin", "sumo")), *arguments, "--save-configuration", "/dev/stdout"]
    ran = subprocess.run(command, capture_output=True, check=False, text=True)  # noqa: S603 - SUMO itself
    if ran.returncode:
        raise SetupError(f"SUMO does not start: {one_line(ran.stderr)}; mend the file or setting it names")
    values, outputs = {}, []
    for section in ET.fromstring(ran.stdout):  # noqa: S314 - SUMO wrote it
        for option in section:
            values[option.tag] = value = option.get("value", "")
            if option.tag.endswith(_WRITES) and value not in (*_NOWHERE, "true", "false"):
                outputs.append(option.tag)
    return Options(MappingProxyType(values), tuple(outputs))


class Inputs(NamedTuple):
    """Inputs of a simulation, once they have been checked."""

    files: Mapping[str, Sequence[str]]
    """Paths by option of the command line, also those that a configuration names."""
    switched_off: Sequence[str]
    """Arguments that switch off what a configuration would have SUMO write."""
    notes: Sequence[str]
    """What the user has to know of options."""


def checked_inputs(named: Mapping[str, Sequence[str]], given: Sequence[str]) -> Inputs:
    """Check files and options before SUMO starts.

    Args:
        named: Files by setting: ``config``, ``net``, ``routes``, ``additional``.
        given: The setting ``options``.

    Raises:
        ScenarioError: A file or an option is refused; names it.
        SetupError: SUMO is not installed, or refuses the options.
    """
    for key, names in named.items():
        for name in names:
            check_file(key, name)
    words = [w for key, names in named.items() if names for w in (f"--{_OPTION_OF[key]}", ",".join(names))]
    options = merged_options((*words, *given))
    switched_off, notes = _check_options(options, given)
    files = {"--configuration-file": named["config"]} if named["config"] else {}
    for key, option in _OPTION_OF.items():
        if key == "config" or not (found := options.files(option)):
            continue
        files[f"--{option}"] = found
        if not named[key]:
            for name in found:
                check_file(key, name, "settings.config")
    return Inputs(files, switched_off, notes)


def _check_options(options: Options, given: Sequence[str]) -> tuple[list[str], list[str]]:
    """Refuse options that break a promise of a run; return arguments that switch off what a configuration
    would have SUMO write, and notes for the user."""
    for name, why in _REFUSED.items():
        if options.values.get(name, "false") not in ("", "false", "0", "-1"):
            raise ScenarioError(
                f"SUMO's option {name} {why}; leave it out of the configuration and of `options`",
                key="settings",
            )
    off, notes = [], []
    words = {word.partition("=")[0] for word in given}
    for name in options.outputs:
        if f"--{name}" in words:
            raise ScenarioError(
                f"--{name} lets SUMO write {options.values[name]}; leave it out: the recording has all",
                key="settings.options",
            )
        off += [f"--{name}", "NUL"]
    if off:
        notes.append(f"SUMO's {', '.join(options.outputs)} of the configuration are not written")
    for name, why in _NAMED.items():
        if options.values.get(name, "false") not in ("false", "-1"):
            notes.append(f"SUMO's option {name} is set: {why}")
    return off, notes


def check_file(key: str, file: str, setting: str | None = None) -> None:
    """Check that a file can be what a setting names, and the files that it includes.

    Args:
        key: What the file is: ``net``, ``config``, ``routes`` or ``additional``.
        file: Path of the file, which may be compressed with gzip.
        setting: Key of the scenario that names it; by default ``settings`` and `key`.

    Raises:
        ScenarioError: The file is missing, is no XML of this kind, has traffic out of order, declares
            entities, includes a file from outside of its own folder, or lets SUMO write one; names file, key
            and line.
    """
    setting = f"settings.{key}" if setting is None else setting
    path = Path(file)
    if not path.is_file():
        raise ScenarioError(
            f'there is no file {file}; write "file:PATH", relative to the scenario', key=setting
        )
    _FileCheck(key, path, setting).read(path)


class _FileCheck:
    """One look at a file of SUMO and at those that it includes, in SUMO's order.

    Args:
        key: What the file is.
        top: The file.
        setting: Key of the scenario, for errors.
    """

    def __init__(self, key: str, top: Path, setting: str) -> None:
        self._key, self._setting, self._folder = key, setting, top.parent.resolve()
        self._latest, self._of = -math.inf, ""
        self._open: list[Path] = []

    def read(self, path: Path) -> None:
        """Look at a file, and at those that it includes.

        Args:
            path: Of the file.
        """
        self._open.append(path.resolve())
        roots: list[str] = []
        parser = expat.ParserCreate()

        def start(tag: str, attributes: dict[str, str]) -> None:
            if not roots:
                roots.append(tag)
            else:
                self._see(path, tag, attributes, parser.CurrentLineNumber)

        def entity(name: str, *_: object) -> None:
            self._refuse(f"declares the entity {name!r}; write out what it stands for", path, parser)

        parser.StartElementHandler, parser.EntityDeclHandler = start, entity
        try:
            with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as stream:
                parser.ParseFile(stream)
        except expat.ExpatError as error:
            raise ScenarioError(
                f"not well-formed XML: {error}", str(path), self._setting, error.lineno
            ) from error
        except (EOFError, gzip.BadGzipFile) as error:
            raise ScenarioError(f"not compressed with gzip: {error}", str(path), self._setting) from error
        if len(self._open) == 1 and roots[0] not in _ROOTS[self._key]:
            raise ScenarioError(
                f"holds <{roots[0]}>, {self._key} takes a file with <{_ROOTS[self._key][0]}>",
                str(path),
                self._setting,
            )
        self._open.pop()

    def _refuse(self, text: str, path: Path, parser: expat.XMLParserType) -> None:
        raise ScenarioError(text, str(path), self._setting, parser.CurrentLineNumber)

    def _see(self, path: Path, tag: str, attributes: dict[str, str], line: int) -> None:
        """Look at one element below the root."""
        place = (str(path), self._setting, line)
        if tag == "include":
            self._include(Path(path.parent, attributes.get("href", "")), place)
        if self._key == "routes":
            self._order(tag, attributes, place)
        if self._key in ("routes", "additional"):
            written = [attributes.get(name, "") for name in ("output", "dest")]
            written += [attributes.get("file", "")] if tag not in _READS else []
            if tag == "param" and attributes.get("key", "").endswith((".file", "output")):
                written.append(attributes.get("value", ""))
            for name in written:
                if name not in _NOWHERE:
                    raise ScenarioError(
                        f'<{tag}> lets SUMO write {name!r}; write "NUL", the recording has the traffic',
                        *place,
                    )

    def _include(self, file: Path, place: tuple[str, str, int]) -> None:
        resolved = file.resolve()
        if not resolved.is_relative_to(self._folder):
            raise ScenarioError(f"includes {file}, which is outside of {self._folder}; copy it there", *place)
        if not resolved.is_file() or resolved in self._open:
            raise ScenarioError(f"includes {file}, which is no file, or includes this one", *place)
        self.read(file)

    def _order(self, tag: str, attributes: dict[str, str], place: tuple[str, str, int]) -> None:
        """Refuse traffic that departs before what stands before it: SUMO would leave it out."""
        time = attributes.get(_DEPARTS.get(tag, ""), "")
        try:
            departs = _seconds(time)
        except ValueError:
            return  # "triggered", say
        name = f"{tag} {attributes.get('id', '')!r}"
        if departs < self._latest:
            raise ScenarioError(
                f"{name} departs at {departs:g} s, after {self._of} at {self._latest:g} s: SUMO would leave "
                "it out; sort flows, vehicles and trips by departure",
                *place,
            )
        if departs > self._latest:
            self._latest, self._of = departs, name


def _seconds(time: str) -> float:
    """A time as SUMO writes it: seconds, or days, hours, minutes and seconds with colons between.

    Example:
        >>> _seconds("00:01:09.5"), _seconds("7")
        (69.5, 7.0)
    """
    *larger, seconds = time.split(":")
    weights = (60.0, 3600.0, 86400.0)
    return float(seconds) + sum(
        weight * float(part) for weight, part in zip(weights, reversed(larger), strict=False)
    )


def one_line(text: str) -> str:
    """Join what SUMO says in several lines.

    Args:
        text: Its words.
    """
    return " ".join(text.split())
