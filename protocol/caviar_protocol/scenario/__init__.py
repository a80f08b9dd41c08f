"""Scenario files: finding, reading and checking them.

>>> from caviar_protocol.scenario import load_scenario
>>> load_scenario("smoke").run.frames
100

`schema` has the types of the tables, `rules` what holds between keys, `instants` frames at given instants,
`conversion` the errors about a value, and `toml` the lines of keys.

Attachments: services that the command line attaches to a scenario, ``caviar run --attach NAME=VALUE``.

An installed distribution adds one by an entry point of the group ``caviar.attachments``: a function that is
given the scenario and ``VALUE``, and returns the scenario with what it attaches. The first line of its
docstring is the help of ``caviar run --NAME VALUE``. The command and the broker both call it: its module
imports nothing heavy.
"""

from __future__ import annotations

import difflib
import math
import re
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from decimal import Decimal, InvalidOperation
from functools import partial
from importlib import resources
from pathlib import Path
from types import FunctionType
from typing import Any, TypeAlias

import msgspec

from caviar_protocol.errors import DeclarationError, ScenarioError, suggestion
from caviar_protocol.fields import MAX_SUBCARRIERS
from caviar_protocol.plugins import load_plugin, origin, plugins
from caviar_protocol.run_directory import RunDirectory
from caviar_protocol.scenario.conversion import FILE, Place, Source, convert_table
from caviar_protocol.scenario.instants import instants_ns, with_instants
from caviar_protocol.scenario.rules import check_scenario, settings_place
from caviar_protocol.scenario.schema import (
    REMOTE,
    REMOTE_REJOIN_S,
    DeviceSpec,
    Limits,
    ReplaySpec,
    Run,
    Scenario,
    ServiceSpec,
    Timeouts,
    pattern_asset,
)
from caviar_protocol.scenario.toml import MAX_SIZE, dotted, key_lines, parse_toml
from caviar_protocol.space.codebooks import (
    CODEBOOKS_FOLDER,
    DFT,
    add_codebook_files,
    beam_count,
    codebook_digest,
    named_by_content,
)
from caviar_protocol.topics.channel import Carrier

SHOWN = 80
"""Letters of a line that an error shows."""
# [Hz]; beyond, numbers of noise powers and of taps overflow.
_BANDWIDTHS_HZ = (1.0, 1e12)


def shipped_scenarios() -> dict[str, Path]:
    """Files of the scenarios that ship with this installation, by their names, in order of name.

    Example:
        >>> "smoke" in shipped_scenarios()
        True
    """
    folder = Path(str(resources.files("caviar_scenarios")))
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def find_scenario(scenario: Path | str) -> Path:
    """File of a scenario that is given as a path, or as the name of one that ships.

    Args:
        scenario: ``"my/scenario.toml"`` or ``"smoke"``.

    Returns:
        The file. What is neither is returned as it is; reading it says what is wrong.

    Raises:
        ScenarioError: One that ships has the name, and so has a file in the current folder.

    Example:
        >>> find_scenario("smoke").name, str(find_scenario("my/street.toml"))
        ('smoke.toml', 'my/street.toml')
    """
    path = Path(scenario)
    shipped = shipped_scenarios().get(str(scenario))
    if shipped is None:
        return path
    for own in (path, path.with_suffix(".toml")):
        if own.is_file() and own.resolve() != shipped:
            raise ScenarioError(
                f"{path} is a scenario that ships, and {own} is a file here: write {own.resolve()} or "
                f"{shipped}"
            )
    return shipped


def load_scenario(path: Path | str, settings: Sequence[str] = ()) -> Scenario:
    """Read and check a scenario.

    Strings that begin with ``file:`` in settings of services, and in ``pattern_file`` and ``codebook`` of
    antennas, are paths relative to the file's folder; they come out as absolute paths.

    Args:
        path: A file, or the name of a scenario that ships, as of `find_scenario`.
        settings: ``KEY=VALUE`` each, in place of what the file says, as of `set_keys`.

    Raises:
        ScenarioError: The file cannot be read or breaks a rule; the text has file, line, key, value and what
            to write instead.

    Example:
        >>> scenario = load_scenario("smoke")
        >>> scenario.services["channel"].use
        'free-space'
    """
    path = find_scenario(path)
    try:
        with path.open("rb") as stream:  # no more than that shows that it is too large
            text = stream.read(4 * MAX_SIZE + 1).decode("utf-8-sig")  # some editors put a mark first
    except OSError as error:
        raise ScenarioError(f"cannot be read: {error.strerror}{_beside(path)}", str(path)) from error
    except UnicodeDecodeError as error:
        line = error.object.count(b"\n", 0, error.start) + 1
        raise ScenarioError("is not UTF-8 text here; save it as UTF-8", str(path), line=line) from error
    return parse_scenario(text, str(path), path.parent, settings)


def parse_scenario(
    text: str, file: str = "", folder: Path | None = None, settings: Sequence[str] = ()
) -> Scenario:
    """Check a scenario given as text.

    Args:
        text: TOML.
        file: What errors call it.
        folder: What its ``file:`` paths are relative to; by default the working directory.
        settings: ``KEY=VALUE`` each, as of `load_scenario`.

    Raises:
        ScenarioError: The text breaks a rule, as of `load_scenario`.

    Example:
        >>> text = find_scenario("smoke").read_text()
        >>> parse_scenario(text.replace("frames = 100", "frames = 0"), "my.toml")
        Traceback (most recent call last):
            ...
        caviar_protocol.errors.ScenarioError: my.toml:8: run.frames: is 0, write a whole number ≥ 1 [frame]
    """
    table, source = read_toml(text, file)
    set_keys(table, source, settings)
    if isinstance(table.get("run"), dict):
        table["run"] = with_instants(table["run"], Place("run", source), folder or Path())
    # Types first: rules between keys may rely on them.
    scenario = convert_table(Scenario, table, Place("", source))
    scenario = msgspec.structs.replace(scenario, source=_with_device_names(source, scenario))
    check_scenario(scenario)
    # After the rules: what follows from keys is never what an error is about.
    # The scenario with all that follows from the keys of its carriers written out.
    run, place = scenario.run, Place("carriers", scenario.source)
    # Given instants have no period, so that slots need a duration of their own.
    period = None if run.instants_s else run.sampling_period_ns
    carriers = tuple(
        with_numerology(carrier, period, place.at(index)) for index, carrier in enumerate(scenario.carriers)
    )
    scenario = msgspec.structs.replace(scenario, carriers=carriers)
    return _with_files(scenario, folder or Path())


def read_toml(text: str, file: str = "") -> tuple[dict[str, Any], Source]:
    """Parse TOML text, and find the lines of its keys, for `caviar_protocol.scenario.conversion`.

    Args:
        text: TOML.
        file: What errors call it.

    Returns:
        The document, and where its keys stand.

    Raises:
        ScenarioError: It is no TOML; the text has file, line and column.

    Example:
        >>> table, source = read_toml("[run]\\nframes = 3\\n", "my.toml")
        >>> table["run"]["frames"], source.line("run.frames")
        (3, 2)
    """
    try:
        table = parse_toml(text)
    except tomllib.TOMLDecodeError as error:
        raise _syntax_error(error, text, file) from error
    # tomllib counts CR LF as one line end, and so must the scanner.
    lines = {dotted(path): line for path, line in key_lines(text.replace("\r\n", "\n")).items()}
    return table, Source(file=file, lines=lines)


def set_keys(table: dict[str, Any], source: Source, settings: Sequence[str]) -> None:
    """Set keys of a scenario that is not checked yet, as ``--set`` of the command line does.

    Args:
        table: The document; changed in place.
        source: Where its keys stand; those that are set stand nowhere any more.
        settings: ``KEY=VALUE`` each. A key is one of the document, with the name or the number of an element
            of a list (``carriers.mm.frequency_hz``, ``carriers.0.frequency_hz``), or ``SERVICE.SETTING``. A
            value is TOML, or a text without quotation marks.

    Raises:
        ScenarioError: There is no value, no such element, or a table is needed where a value stands.

    Example:
        >>> table, source = read_toml("[services.channel]\\nuse = 'sionna-rt'\\n")
        >>> set_keys(table, source, ["channel.samples=1000", "services.channel.budget_ms=7"])
        >>> table["services"]["channel"]
        {'use': 'sionna-rt', 'settings': {'samples': 1000}, 'budget_ms': 7}
    """
    top = {field.encode_name for field in msgspec.structs.fields(Scenario)}
    for text in settings:
        path, separator, value = text.partition("=")
        keys = path.strip().replace("[", ".").replace("]", "").split(".")
        if not separator or not value.strip() or not all(keys):
            raise ScenarioError(f"--set {text}: write it as in --set services.channel.settings.samples=1000")
        if keys[0] not in top and keys[0] in table.get("services", {}):
            keys = ["services", keys[0], "settings", *keys[1:]]
        at: Any = table
        place: list[str | int] = []
        for key in keys[:-1]:
            place.append(_element(at, key, text) if isinstance(at, list) else key)
            at = at.setdefault(key, {}) if isinstance(at, dict) else at[place[-1]]
            if not isinstance(at, dict | list):
                raise ScenarioError(f"--set {text}: {dotted(tuple(place))} is a value, and has no keys")
        if isinstance(at, list):
            raise ScenarioError(
                f"--set {text}: {dotted(tuple(place))} is a list; set all of it, or a key of one"
            )
        try:
            at[keys[-1]] = parse_toml(f"value = {value}")["value"]
        except tomllib.TOMLDecodeError:
            at[keys[-1]] = value.strip()
        source.lines.pop(dotted((*place, keys[-1])), None)  # the value does not stand there


def _element(of: list[Any], key: str, text: str) -> int:
    """The place in a list of the element that has a number or a name."""
    names = [str(item.get("name", at)) if isinstance(item, dict) else str(at) for at, item in enumerate(of)]
    if key not in names and not (key.isdecimal() and int(key) < len(of)):
        raise ScenarioError(f"--set {text}: there is no {key!r}; there are: {', '.join(names)}")
    return names.index(key) if key in names else int(key)


def _with_device_names(source: Source, scenario: Scenario) -> Source:
    """The source with the lines of ``devices[2].on`` under ``devices.rx.on`` too.

    A world is given its own devices only and does not know their places in the file: its errors name them.
    """
    root = Place("devices")
    named: dict[str, int] = {}
    # The first of two devices of one name has the line; the second is an error of its own.
    for index, device in enumerate(scenario.devices):
        place, by_name = root.at(index).key, root.at(device.name).key
        for key, line in source.lines.items():
            if key == place or key.startswith((f"{place}.", f"{place}[")):
                named.setdefault(by_name + key.removeprefix(place), line)
    return msgspec.structs.replace(source, lines=named | source.lines)


def _syntax_error(error: tomllib.TOMLDecodeError, text: str, file: str) -> ScenarioError:
    # tomllib puts the place at the end of its text and nowhere else.
    found = re.fullmatch(r"(.*) \(at (?:line (\d+), column (\d+)|end of document)\)", str(error), re.DOTALL)
    if found is None:
        return ScenarioError(f"not TOML: {error}", file)
    message, line, column = found.groups()
    if line is None:
        return ScenarioError(f"not TOML: {message}, at the end of the file", file, line=text.count("\n") + 1)
    written = text.split("\n")[int(line) - 1].strip()
    shown = f"not TOML: {message}, at column {column}: {written[:SHOWN]}{_toml_remedy(written)}"
    return ScenarioError(shown, file, line=int(line))


def _toml_remedy(line: str) -> str:
    """Remedy for a line that is no TOML; empty where none is clear."""
    _, equals, value = line.partition("=")
    value = value.partition("#")[0].strip()
    if not equals:
        return ""
    if re.fullmatch(r"[-+]?[\d_.]+(e[-+]?\d+)?\s*[A-Za-zµ%°/]+", value, re.IGNORECASE):
        return "; a number has no unit: the key's name says it, and 28 GHz is 28e9"
    if re.fullmatch(r"[A-Za-z_][^\"'\[\]{}]*", value):
        return f'; a text is quoted: "{value}", and yes and no are true and false'
    return ""


def _beside(path: Path) -> str:
    """The scenarios that stand where one was looked for, or those that ship."""
    if path.is_dir():
        # Remedy for a folder: the scenarios in it, or what can be done with a run.
        run = RunDirectory(path)
        if run.record.exists() or run.manifest.exists():
            return f"; it is the directory of a run, whose world runs again with: caviar replay {path}"
        names = sorted(file.name for file in path.glob("*.toml"))
        if not names:
            return "; a scenario is a TOML file: caviar new NAME writes one"
        return f"; {path.resolve()} has {', '.join(names)}: name one of them, as {path / names[0]}"
    shipped = shipped_scenarios()
    file = path.with_name(path.name + ".toml")
    if file.is_file():
        return f"; there is a {file}"
    if not path.exists() and path.stem in shipped and path.suffix in ("", ".toml"):
        return f"; the scenario that ships is called by its name: {path.stem}"
    if path.name == str(path) and not path.suffix:
        own = {other.stem: other.name for other in Path().glob("*.toml")}
        close = difflib.get_close_matches(path.name, [*own, *shipped], n=1)
        meant = f"; did you mean {own.get(close[0], close[0])!r}?" if close else ""
        return f"{meant}; scenarios that ship: {', '.join(shipped)}"
    if not path.parent.is_dir():
        return f"; there is no folder {path.parent}"
    names = sorted(other.name for other in path.parent.glob("*.toml"))
    if not names or path.is_file():
        return ""
    close = difflib.get_close_matches(path.name, names, n=1)
    meant = f"; did you mean {path.with_name(close[0])}?" if close else ""
    return f"{meant}; {path.parent.resolve()} has {', '.join(names)}"


def with_numerology(carrier: Carrier, sampling_period_ns: int | None, place: Place) -> Carrier:
    """The carrier with the spacing, number or slot duration that follows from its other keys.

    Args:
        carrier: As the scenario has it.
        sampling_period_ns: Between frames [ns]; None where it is not the same between all of them.
        place: Where the carrier stands in the scenario.

    Raises:
        ScenarioError: The bandwidth is no carrier's, subcarriers are too many or do not fit into
            it, or slots have no duration; the text names the key.

    Example:
        >>> carrier = Carrier(name="n257", frequency_hz=28e9, subcarrier_spacing_hz=120e3)
        >>> with_numerology(carrier, 100_000_000, Place("carriers[0]")).subcarriers
        833
    """
    count, spacing, bandwidth = carrier.subcarriers, carrier.subcarrier_spacing_hz, carrier.bandwidth_hz
    least, most = _BANDWIDTHS_HZ
    if not least <= bandwidth <= most:
        raise place.at("bandwidth_hz").error(f"is {bandwidth:g} Hz, write {least:g} to {most:g}")
    if spacing > bandwidth * (1 + 1e-9):
        raise place.at("subcarrier_spacing_hz").error(
            f"is {spacing:g} Hz, wider than bandwidth_hz = {bandwidth:g}; write at most the bandwidth"
        )
    if spacing and not count:
        if bandwidth / MAX_SUBCARRIERS > spacing:
            raise place.at("subcarrier_spacing_hz").error(
                f"is {spacing:g} Hz, of which bandwidth_hz = {bandwidth:g} has more than {MAX_SUBCARRIERS}; "
                f"write at least {bandwidth / MAX_SUBCARRIERS:g}, or subcarriers"
            )
        # 100e6 / 120e3 and the like must not lose a subcarrier to rounding.
        count = math.floor(bandwidth / spacing * (1 + 1e-12))
    elif count and not spacing:
        spacing = bandwidth / count
    if count * spacing > bandwidth * (1 + 1e-9):
        raise place.at("subcarriers").error(
            f"{count} subcarriers of {spacing:g} Hz take {count * spacing:g} Hz, more than bandwidth_hz = "
            f"{bandwidth:g}; write bandwidth_hz = {count * spacing:g}, or at most "
            f"{math.floor(bandwidth / spacing)} subcarriers"
        )
    duration = carrier.slot_duration_s
    if carrier.slots > 1 and not duration:
        if sampling_period_ns is None:
            raise place.at("slots").error(
                f"are {carrier.slots}, and run.instants_s has no period that they could share; write "
                "slot_duration_s"
            )
        duration = sampling_period_ns * 1e-9 / carrier.slots
    return msgspec.structs.replace(
        carrier, subcarriers=count, subcarrier_spacing_hz=spacing, slot_duration_s=duration
    )


def _with_files(scenario: Scenario, folder: Path) -> Scenario:
    services = {
        name: msgspec.structs.replace(
            service, settings=absolute_paths(service.settings, folder, settings_place(scenario, name))
        )
        for name, service in scenario.services.items()
    }
    if scenario.replay is not None:
        add_codebook_files(RunDirectory(Path(scenario.replay.recording)).assets.glob(f"{CODEBOOKS_FOLDER}*"))
    devices = tuple(
        _with_codebook(_with_pattern(device, folder, array), folder, array)
        for index, device in enumerate(scenario.devices)
        for array in [Place("devices", scenario.source).at(index).at("array")]
    )
    _check_patterns(devices, scenario.source)
    return msgspec.structs.replace(scenario, services=services, devices=devices)


def _with_pattern(device: DeviceSpec, folder: Path, array: Place) -> DeviceSpec:
    """A device with the path of its pattern file made absolute."""
    if device.array is None or not device.array.pattern_file:
        return device
    name, place = device.array.pattern_file, array.at("pattern_file")
    if not name.startswith(FILE) and not Path(name).is_absolute():
        raise place.error(f'is {name!r}, write "file:" and a path relative to the folder of the scenario')
    path = Path(absolute_paths(name, folder, place))
    if name.startswith(FILE):
        # A link keeps its own name: its ending says what the file holds.
        link = folder / name.removeprefix(FILE)
        path = link.parent.resolve() / link.name
    found = msgspec.structs.replace(device.array, pattern_file=str(path))
    return msgspec.structs.replace(device, array=found)


def _with_codebook(device: DeviceSpec, folder: Path, array: Place) -> DeviceSpec:
    """A device whose codebook is there; that of a file with the absolute path and the SHA-256."""
    if device.array is None or device.array.codebook == DFT:
        return device
    place, found = array.at("codebook"), device.array
    try:
        if found.codebook.startswith(FILE) and not codebook_digest(found):
            path = absolute_paths(found.codebook, folder, place)
            found = msgspec.structs.replace(found, codebook=named_by_content(f"{FILE}{path}"))
        beam_count(found)
    except ScenarioError as error:
        raise place.error(error.message) from error
    except DeclarationError as error:
        raise place.error(str(error)) from error
    return msgspec.structs.replace(device, array=found)


def _check_patterns(devices: Sequence[DeviceSpec], source: Source) -> None:
    """Refuse different pattern files of one name, by which they travel."""
    first: dict[str, str] = {}
    for index, device in enumerate(devices):
        file = device.array.pattern_file if device.array is not None else ""
        # A pattern travels as ``patterns/FILE``: its folder is no part of the asset's name.
        if file and first.setdefault(pattern_asset(file), file) != file:
            place = Place("devices", source).at(index).at("array").at("pattern_file")
            raise place.error(
                f"{file} has the name of {first[pattern_asset(file)]}, which is another file; rename one"
            )


def absolute_paths(value: Any, folder: Path, place: Place) -> Any:
    """A value in which texts that begin with ``file:`` are absolute paths.

    Args:
        value: Of a file: a text, or what holds texts at any depth.
        folder: What the paths are relative to.
        place: Where the value stands, for the error.

    Raises:
        ScenarioError: There is no such file.

    Example:
        >>> absolute_paths(["geometric"], Path(), Place("scenario"))
        ['geometric']
    """
    if isinstance(value, dict):
        return {name: absolute_paths(item, folder, place.at(name)) for name, item in value.items()}
    if isinstance(value, list):
        return [absolute_paths(item, folder, place.at(index)) for index, item in enumerate(value)]
    if not (isinstance(value, str) and value.startswith(FILE)):
        return value
    path = (folder / value.removeprefix(FILE)).resolve()
    if not path.exists():
        raise place.error(f"there is no {path}; {value!r} is relative to the folder of the scenario")
    return str(path)


ATTACHMENTS = "caviar.attachments"
"""Group of entry points."""


def attached(scenario: Scenario, attachments: Sequence[str]) -> Scenario:
    """Attach services to a scenario, one after the other.

    Args:
        scenario: Checked, as it was loaded.
        attachments: ``NAME=VALUE`` each.

    Raises:
        ScenarioError: Nothing has the name, or it cannot be attached to this scenario.
        DeclarationError: What a distribution registers is no attachment.

    Example:
        >>> from caviar_protocol.scenario import load_scenario
        >>> attached(load_scenario("smoke"), ["engine"])
        Traceback (most recent call last):
            ...
        caviar_protocol.errors.ScenarioError: --attach engine: write it as NAME=VALUE
    """
    for text in attachments:
        name, separator, value = text.partition("=")
        if not separator:
            raise ScenarioError(f"--attach {text}: write it as NAME=VALUE")
        known = plugins(ATTACHMENTS)
        if name not in known:
            hint = suggestion(name, sorted(known)) if known else "nothing that is installed can be attached"
            raise ScenarioError(f"--attach {text}: {name!r} does not exist; {hint}")
        scenario = load_plugin(known[name], FunctionType)(scenario, value)
        if not isinstance(scenario, Scenario):
            raise DeclarationError(f"--attach {text}: {origin(known[name])} returns no scenario")
    return scenario


def summary(name: str) -> str:
    """First line of what an attachment says of itself; of one that cannot be loaded, why."""
    try:
        text = load_plugin(plugins(ATTACHMENTS)[name], FunctionType).__doc__ or ""
    except DeclarationError as error:
        return str(error)
    return text.strip().partition("\n")[0].rstrip(".")
