"""Rules between several keys of a scenario, and values that follow from its keys."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import PurePosixPath
from typing import Any

import msgspec

from caviar_protocol.errors import ScenarioError, suggestion
from caviar_protocol.fields import PRINTABLE, fields_of
from caviar_protocol.scenario.conversion import Place, convert_table
from caviar_protocol.scenario.schema import DeviceSpec, Scenario, ServiceSpec
from caviar_protocol.topics import PARTS, PAYLOADS
from caviar_protocol.topics.channel import Carrier

# Without a scene there is nothing to compute, without a recorder nothing is kept.
_STRICT_ROLES = ("world", "recorder")
# Half of what 64 bits hold: sums of two instants stay within them.
LONGEST_NS = 2**62
"""[ns] Longest episode: an instant is a 64-bit integer."""
BEAM = "beam:"
"""Prefix of the actuators that steer beams; the receiver's name follows. Users may be written without."""

_KIND_KEYS = {
    "antenna": ("role", "array", "power_dbm", "carriers"),
    "lidar": ("beams", "azimuth_steps", "elevation_deg", "range_m"),
    "camera": ("size_px", "field_of_view_deg"),
}


def scenario_error(scenario: Scenario, key: str, message: str) -> ScenarioError:
    """Make an error about a key of a scenario, for a check later than the loader's.

    Args:
        scenario: The scenario.
        key: Dotted: ``services.channel.use``, ``devices[0].on``. The line is found from it.
        message: What is wrong, and what to write instead.

    Example:
        >>> from caviar_protocol.scenario import load_scenario
        >>> error = scenario_error(load_scenario("smoke"), "services.channel.use", "is not installed")
        >>> error.key, error.line is not None
        ('services.channel.use', True)
    """
    return Place(key, scenario.source).error(message)


def settings_place(scenario: Scenario, service: str) -> Place:
    """Place of the settings of a service, for `caviar_protocol.scenario.conversion.convert_settings`.

    Args:
        scenario: The scenario.
        service: Name of the service.

    Example:
        >>> from caviar_protocol.scenario import load_scenario
        >>> settings_place(load_scenario("smoke"), "channel").key
        'services.channel.settings'
    """
    return Place("services", scenario.source).at(service).at("settings")


def check_scenario(scenario: Scenario) -> None:
    """Check the rules that concern several keys of a scenario.

    Args:
        scenario: The scenario.

    Raises:
        ScenarioError: The first rule that the scenario breaks.
    """
    root = Place("", scenario.source)
    _check_duration(scenario, root.at("run"))
    _check_record(scenario, root.at("run").at("record"))
    place = root.at("timeouts")
    timeouts = scenario.timeouts
    if timeouts.heartbeat_s >= timeouts.liveness_s:
        raise place.error(
            f"heartbeat_s = {timeouts.heartbeat_s} leaves no heartbeat within liveness_s = "
            f"{timeouts.liveness_s}; write at most {timeouts.liveness_s / 2}"
        )
    _check_limits(scenario, root.at("limits"))
    _unique((carrier.name for carrier in scenario.carriers), "carrier", root.at("carriers"))
    _unique((device.name for device in scenario.devices), "device", root.at("devices"))
    _check_services(scenario, root.at("services"))
    for index, device in enumerate(scenario.devices):
        _check_device(device, root.at("devices").at(index))
        _check_carriers(device, scenario.carriers, root.at("devices").at(index).at("carriers"))
        world_of(scenario, index)
    _check_antennas(scenario, root.at("devices"))
    _check_users(scenario, root.at("services"))


def _check_duration(scenario: Scenario, place: Place) -> None:
    """Every instant is a 64-bit number of nanoseconds, also where it is doubled."""
    run = scenario.run
    if not run.instants_s and run.frames * run.sampling_period_ns > LONGEST_NS:
        raise place.at("sampling_period_ns").error(
            f"{run.frames} frames of {run.sampling_period_ns} ns are longer than {LONGEST_NS / 1e9:.3g} s; "
            "write a shorter period or fewer frames"
        )


def refuse_remote(scenario: Scenario) -> None:
    """Check that a scenario has no remote service, for a run that has no broker to connect to.

    Args:
        scenario: The scenario.

    Raises:
        ScenarioError: A service has ``use = "remote"``.
    """
    for name, spec in scenario.services.items():
        if spec.remote:
            raise scenario_error(
                scenario,
                f"services.{name}.use",
                f"is {spec.use!r}, but a run in one process has no address to connect to; "
                f"name an implementation of {spec.role}, or run it without --embedded",
            )


def world_of(scenario: Scenario, index: int) -> str:
    """Name of the world that publishes a device.

    A device belongs to the world it names, or to the only world of the run, or to the one with whose
    ``prefix`` (a setting; else its name and a dot) ``on`` begins.

    Args:
        scenario: The scenario.
        index: Place of the device in its ``devices``.

    Raises:
        ScenarioError: No world of this name, or several worlds are possible.

    Example:
        >>> from caviar_protocol.scenario import load_scenario
        >>> world_of(load_scenario("smoke"), 0)
        'world'
    """
    device = scenario.devices[index]
    worlds = [name for name, service in scenario.services.items() if service.role == "world"]
    place = Place("devices", scenario.source).at(index)
    if device.world:
        if device.world not in worlds:
            hint = suggestion(device.world, worlds)
            raise place.at("world").error(f"no world of this run is named {device.world!r}; {hint}")
        return device.world
    if len(worlds) == 1:
        return worlds[0]
    # What precedes the first wildcard is certain to be in the object's name.
    literal = device.on.partition("*")[0].partition("?")[0].partition("[")[0]
    matching = [name for name in worlds if literal.startswith(_prefix(name, scenario.services[name]))]
    if len(matching) == 1:
        return matching[0]
    where = f"on {device.on!r}" if device.on else "without `on`"
    raise place.error(
        f"device {device.name!r} {where} could belong to any of the worlds {', '.join(worlds)}; "
        f'write world = "{worlds[0]}"'
    )


def with_overrides(
    scenario: Scenario, frames: int | None = None, seed: int | None = None, pace: str | None = None
) -> Scenario:
    """The scenario with values from the command line in place of its own.

    Args:
        scenario: The scenario.
        frames: Frames of an episode; None: those of the scenario, as for the others.
        seed: Seed of the run.
        pace: ``"free"``, ``"realtime"``, or a number as text.

    Raises:
        ScenarioError: A value is out of range.

    Example:
        >>> from caviar_protocol.scenario import load_scenario
        >>> with_overrides(load_scenario("smoke"), frames=3).run.frames
        3
    """
    # Converted as if they stood in the file: the same ranges, and errors with the same words.
    given = {"frames": frames, "seed": seed, "pace": None if pace is None else _number_or_word(pace)}
    changes = {name: value for name, value in given.items() if value is not None}
    if not changes:
        return scenario
    run = type(scenario.run)
    # Fewer frames are the first instants; there are none to add.
    instants = len(scenario.run.instants_s)
    if frames is not None and 0 < instants < frames:
        raise (
            Place("run")
            .at("frames")
            .error(f"is {frames}, and the scenario has {instants} instants; write at most {instants}")
        )
    values = msgspec.structs.asdict(scenario.run) | changes
    changed = msgspec.structs.replace(scenario, run=convert_table(run, values, Place("run")))
    _check_duration(changed, Place("", scenario.source).at("run"))
    return changed


def resolved(scenario: Scenario, settings: Mapping[str, msgspec.Struct] | None = None) -> dict[str, Any]:
    """Everything that a scenario says, defaults included, as built-in types.

    Args:
        scenario: The scenario.
        settings: Settings of services after conversion, by the service's name, so that their defaults show
            too.

    Example:
        >>> from caviar_protocol.scenario import load_scenario
        >>> resolved(load_scenario("smoke"))["timeouts"]["connect_s"]
        30.0
    """
    table = plain(scenario)
    # Of the file and not of the run: two copies of a scenario are one scenario.
    del table["source"]
    for name, value in (settings or {}).items():
        table["services"][name]["settings"] = plain(value)
    return table  # type: ignore[no-any-return]  # a struct becomes a dict


def patterns_overlap(a: str, b: str) -> bool:
    """Return whether some name matches both patterns, in which ``*`` is any text and ``?`` any character.

    Args:
        a: A pattern.
        b: Another pattern.

    Example:
        >>> patterns_overlap("car.*", "*/rx"), patterns_overlap("car.*", "uav.?")
        (True, False)
    """
    # Pairs of places in both patterns, each looked at once: no backtracking, whatever the patterns are.
    reachable = {(0, 0)}
    todo = [(0, 0)]
    while todo:
        i, j = todo.pop()
        if i == len(a) and j == len(b):
            return True
        head_a, head_b = a[i : i + 1], b[j : j + 1]
        steps = set()
        if head_a == "*":
            steps |= {(i + 1, j)} | ({(i, j + 1)} if head_b else set())
        if head_b == "*":
            steps |= {(i, j + 1)} | ({(i + 1, j)} if head_a else set())
        if head_a and head_b and (head_a == head_b or "?" in (head_a, head_b)):
            steps.add((i + 1, j + 1))
        todo += steps - reachable
        reachable |= steps
    return False


def _number_or_word(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def plain(value: Any, *, defaults: bool = True) -> Any:
    """Structs as built-in types, with or without the fields that have their default.

    `msgspec.to_builtins` leaves them out as the class says, not as the caller does.

    Args:
        value: A struct, or tables and lists of such.
        defaults: Whether fields that have their default are there.

    Example:
        >>> from caviar_protocol.topics import Carrier
        >>> plain(Carrier(name="n257", frequency_hz=28e9), defaults=False)
        {'name': 'n257', 'frequency_hz': 28000000000.0}
    """
    if isinstance(value, msgspec.Struct):
        config = value.__struct_config__
        found = {config.tag_field: config.tag} if config.tag_field else {}
        for field in fields_of(type(value)):
            item = getattr(value, field.name)
            default = field.default_factory() if callable(field.default_factory) else field.default
            if defaults or (item is not None and (item != default or type(item) is not type(default))):
                found[field.name] = plain(item, defaults=defaults)
        return found
    if isinstance(value, Mapping):
        return {str(k): plain(v, defaults=defaults) for k, v in value.items() if defaults or v is not None}
    if isinstance(value, list | tuple):
        return [plain(item, defaults=defaults) for item in value]
    return msgspec.to_builtins(value)


def _prefix(name: str, world: ServiceSpec) -> str:
    """Prefix of the names of a world's objects: its setting, else its own name and a dot."""
    return str(world.settings.get("prefix") or f"{name}.")


def _unique(names: Iterable[str], what: str, place: Place) -> None:
    # By name the place of the first one, which the error about a second one names.
    first: dict[str, int] = {}
    for index, name in enumerate(names):
        here = place.at(index).at("name")
        if not name:
            raise here.error(f"a {what} needs a name")
        if not re.search(PRINTABLE, name):
            raise here.error(f"{name!r} has control characters; leave them out of the name of a {what}")
        if name in first:
            line = place.source.line(place.at(first[name]).at("name").key)
            known = f" (the first stands in line {line})" if line else ""
            raise here.error(f"a second {what} is named {name!r}{known}; give it another name")
        first[name] = index


def _check_record(scenario: Scenario, place: Place) -> None:
    for index, entry in enumerate(scenario.run.record):
        topic, dot, part = entry.partition(".")
        if topic not in PAYLOADS:
            raise place.at(index).error(f"no topic is named {topic!r}; {suggestion(topic, PAYLOADS)}")
        if dot and part not in PARTS.get(topic, ()):
            known = suggestion(part, PARTS.get(topic, ())) if topic in PARTS else f'write "{topic}"'
            raise place.at(index).error(f"topic {topic!r} has no part {part!r}; {known}")
        if topic == "channel" and (problem := undefined_part(part, scenario.carriers)):
            raise place.at(index).error(problem)
    if scenario.run.record and not any(s.role == "recorder" for s in scenario.services.values()):
        raise place.error('topics to record need a recorder; add [services.recorder] with role = "recorder"')


def _check_limits(scenario: Scenario, place: Place) -> None:
    """Check that services may take what they need to take part at all."""
    limits, heartbeat_s = scenario.limits, scenario.timeouts.heartbeat_s
    # Each service has a connection for messages and one for heartbeats.
    needed = 2 * len(scenario.services)
    for key, value in (
        ("connections", limits.connections),
        ("connections_before_hello", limits.connections_before_hello),
    ):
        if value < needed:
            raise place.at(key).error(
                f"is {value}, and each of the {len(scenario.services)} services has one and another "
                f"for its heartbeats, perhaps at the same time; write at least {needed}"
            )
    # A service whose heartbeats alone exceed its rate would be cut off in every run.
    if limits.messages_per_s < 1.0 / heartbeat_s:
        raise place.at("messages_per_s").error(
            f"is {limits.messages_per_s:g}, and a heartbeat each {heartbeat_s:g} s (timeouts.heartbeat_s) is "
            f"more; write at least {2.0 / heartbeat_s:g}"
        )
    if limits.waiting_mib <= limits.part_mib:
        raise place.at("waiting_mib").error(
            f"is {limits.waiting_mib}, so that a product of part_mib = {limits.part_mib} cannot come in; "
            f"write at least {limits.part_mib + 1}, or part_mib = {limits.waiting_mib - 1}"
        )


def _check_services(scenario: Scenario, place: Place) -> None:
    by_role: dict[str, list[str]] = {}
    for name, service in scenario.services.items():
        by_role.setdefault(service.role, []).append(name)
        _check_service(name, service, place.at(name))
    if "world" not in by_role:
        raise place.error('no service has role = "world", so nothing publishes a scene; add one')
    recorders = by_role.get("recorder", [])
    if len(recorders) > 1:
        raise place.at(recorders[1]).error(
            f"a second recorder; a run has at most one, which is {recorders[0]!r}. Remove this one"
        )
    if by_role.get("channel") and not scenario.carriers:
        raise place.at(by_role["channel"][0]).error(
            "a channel needs a carrier; add [[carriers]] with name and frequency_hz"
        )


def _check_service(name: str, service: ServiceSpec, place: Place) -> None:
    if not name or len(name) > 64 or PurePosixPath(name).name != name or not name.isprintable():
        raise place.error(f"{name!r} cannot name a service; use at most 64 letters, digits, - and _")
    if service.role in _STRICT_ROLES and service.policy not in ("wait", "abort"):
        raise place.at("policy").error(
            f"a {service.role} cannot {service.policy}: nothing in a run can do without its products "
            '(clause 9); write "wait" or "abort"'
        )
    if service.max_in_flight > 1 and service.policy != "wait":
        raise place.at("max_in_flight").error(
            f'is {service.max_in_flight}, but several grants at once need policy = "wait" (clause 7), '
            f"not {service.policy!r}; write max_in_flight = 1"
        )
    if service.users and service.role != "agent":
        raise place.at("users").error(f"only agents own users, this is a {service.role}; remove the key")


def _check_device(device: DeviceSpec, place: Place) -> None:
    # Which values are defaults: a key that is not in the file has its own.
    blank = DeviceSpec(name=device.name, kind=device.kind)
    for kind, keys in _KIND_KEYS.items():
        for key in keys:
            here = place.at(key)
            # A key that has its default value is a mistake too where the file has it.
            is_given = here.key in here.source.lines or getattr(device, key) != getattr(blank, key)
            if kind != device.kind and is_given:
                others = ", ".join(_KIND_KEYS[device.kind])
                raise here.error(f"belongs to kind {kind!r}, this is {device.kind!r}, with: {others}")
    if device.kind == "antenna" and not device.role:
        raise place.error(f'antenna {device.name!r} lacks its role; write role = "tx", "rx" or "both"')
    if device.array is not None and device.array.pattern_file:
        here = place.at("array").at("pattern")
        if device.array.pattern != type(device.array)().pattern or here.key in here.source.lines:
            raise here.error("and pattern_file both say how elements radiate; remove one of both keys")
    if device.count > 1 and not any(sign in device.on for sign in "*?["):
        raise place.at("count").error(
            f'is {device.count}, but {device.on!r} is one object; write a pattern: on = "{device.on}*"'
        )
    if device.mount != "centre" and not device.on:
        raise place.at("mount").error("only a device with `on` has a parent to be mounted at; remove the key")
    if device.keeps_heading and not device.on:
        raise place.at("keeps_heading").error(
            "only a device with `on` has an object that turns; remove the key"
        )
    _check_ascending(device.elevation_deg, place.at("elevation_deg"), -90.0, 90.0)
    _check_ascending(device.range_m, place.at("range_m"), 0.0)
    for index, size in enumerate(device.size_px):
        if not 1 <= size <= 8192:
            raise place.at("size_px").at(index).error(f"is {size}, write 1 to 8192 [px]")


def _check_carriers(device: DeviceSpec, carriers: Sequence[Carrier], place: Place) -> None:
    known = [carrier.name for carrier in carriers]
    for index, name in enumerate(device.carriers):
        if name not in known:
            raise place.at(index).error(f"no carrier is named {name!r}; {suggestion(name, known)}")


def _check_antennas(scenario: Scenario, place: Place) -> None:
    """A channel has paths only between a transmitter and a receiver."""
    roles = {device.role for device in scenario.devices if device.kind == "antenna"}
    has_channel = any(service.role == "channel" for service in scenario.services.values())
    if not has_channel or not roles or "both" in roles or roles >= {"tx", "rx"}:
        return
    lacking = ({"tx", "rx"} - roles).pop()
    raise place.error(f'no antenna has role = "{lacking}", so the channel has no path; add one')


def _check_users(scenario: Scenario, place: Place) -> None:
    """Users that an agent owns are receivers of the scenario; remote worlds may bring others."""
    # A remote world may bring devices that the scenario does not list.
    if any(service.role == "world" and service.remote for service in scenario.services.values()):
        return
    # Mounted devices have the pattern of their object in place of its name.
    there = [
        f"{device.on}/{device.name}" if device.on else device.name
        for device in scenario.devices
        if device.kind == "antenna" and device.role in ("rx", "both")
    ]
    for name, service in scenario.services.items():
        for index, text in enumerate(service.users):
            pattern = text.removeprefix(BEAM)
            if ":" in pattern or any(patterns_overlap(receiver, pattern) for receiver in there):
                continue  # another actuator (``motion:uav``), or a receiver of the scenario
            known = f"there are: {', '.join(there)}" if there else 'no antenna has role = "rx"'
            raise place.at(name).at("users").at(index).error(f"no receiver is named {pattern!r}; {known}")


def _check_ascending(
    pair: tuple[float, float], place: Place, least: float, most: float = float("inf")
) -> None:
    # Written so that a NaN fails: every comparison with it is false.
    low, high = pair
    if not least <= low < high <= most:
        upper = "" if most == float("inf") else f" and at most {most}"
        raise place.error(f"is [{low}, {high}], write two ascending numbers, at least {least}{upper}")


def undefined_part(part: str, carriers: Sequence[Carrier]) -> str:
    """Remedy where no carrier says what a wideband part of ``channel`` consists of.

    Args:
        part: Name of a part: ``hf``, ``taps``.
        carriers: Carriers of the scenario.

    Returns:
        The remedy; empty: a carrier says it, or the part needs none.

    Example:
        >>> undefined_part("taps", [Carrier(name="n257", frequency_hz=28e9, taps=64)])
        ''
    """
    if part == "hf" and not any(c.subcarriers or c.subcarrier_spacing_hz for c in carriers):
        return (
            "channel.hf needs a carrier with subcarriers; write, for instance, subcarriers = 264 and "
            "subcarrier_spacing_hz = 120e3 below [[carriers]]"
        )
    if part == "taps" and not any(c.taps for c in carriers):
        return "channel.taps needs a carrier with taps; write, for instance, taps = 64 below [[carriers]]"
    return ""
