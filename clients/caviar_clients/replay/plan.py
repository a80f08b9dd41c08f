"""Plan of a replay: what a user asks of it, which services are served from the recording and which run again,
and the scenario that follows.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

import msgspec
from msgspec.structs import replace

from caviar_clients.replay.recorded import RecordedRun
from caviar_clients.session.prepared import declared_hello, served_from_recording, settings_type
from caviar_protocol.errors import RunError, suggestion
from caviar_protocol.messages import Hello, Input
from caviar_protocol.scenario import ReplaySpec, Scenario, ServiceSpec
from caviar_protocol.scenario.rules import plain, world_of
from caviar_protocol.scenario.toml import parse_toml, toml_text


@dataclass(frozen=True, kw_only=True)
class Request:
    """Options of ``caviar replay``, with services by their names."""

    replace: Mapping[str, str] = field(default_factory=dict)
    """Implementation in place of the recorded one."""
    settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Settings in place of the recorded ones, as nested tables of what was typed."""
    keep: frozenset[str] = frozenset()
    """Services that run again as recorded."""
    recorded: frozenset[str] = frozenset()
    """Services that are served as recorded, though what they take has changed."""
    again: bool = False
    """Whether everything runs again."""

    @property
    def changed(self) -> frozenset[str]:
        """Services that are not what they were."""
        return frozenset({*self.replace, *self.settings})


def request_of(
    services: Mapping[str, ServiceSpec],
    replace: Sequence[str] = (),
    settings: Sequence[str] = (),
    keep: Iterable[str] = (),
    recorded: Iterable[str] = (),
    again: bool = False,
) -> Request:
    """Read the options of ``caviar replay``.

    Args:
        services: Of the recorded run, by name.
        replace: ``SERVICE=IMPLEMENTATION`` each; a service by name, or by a role that it alone has.
        settings: ``SERVICE.SETTING=VALUE`` each, values as in TOML.
        keep, recorded: Services.
        again: Whether everything runs again.

    Raises:
        RunError: An option names nothing, or two exclude each other; the text has the option and what there
            is.

    Example:
        >>> spec = ServiceSpec(role="channel", use="free-space", budget_ms=10.0)
        >>> request_of({"radio": spec}, replace=["channel=geometric"]).replace
        {'radio': 'geometric'}
    """
    found = Request(
        replace={
            service_named(services, name, f"--replace {text}"): use
            for text in replace
            for name, use in [_halves(text, "--replace", "channel=sionna-rt")]
        },
        settings=_settings(services, settings),
        keep=frozenset(service_named(services, name, f"--keep {name}") for name in keep),
        recorded=frozenset(service_named(services, name, f"--recorded {name}") for name in recorded),
        again=again,
    )
    for name in found.recorded & (found.keep | found.changed):
        raise RunError(f"{name!r} is to be served as recorded, and to run; leave out one of both")
    if again and (found.changed or found.recorded):
        raise RunError("--again runs everything as it was; leave it out, or --replace, --set and --recorded")
    return found


def service_named(services: Mapping[str, ServiceSpec], name: str, option: str) -> str:
    """Find a service by its name, or by a role that it alone has.

    Args:
        services: Of the recorded run, by name.
        name: Name or role.
        option: The option as it was written, for the error.

    Raises:
        RunError: There is none, or several have the role.
    """
    if name in services:
        return name
    of_role = [service for service, spec in services.items() if spec.role == name]
    if len(of_role) == 1:
        return of_role[0]
    if of_role:
        raise RunError(f"{option}: the recorded run has {len(of_role)} of role {name}: {', '.join(of_role)}")
    roles = {spec.role for spec in services.values()}
    hint = suggestion(name, {*services, *roles})
    raise RunError(f"{option}: the recorded run has no service {name!r}, and none of such a role; {hint}")


def _halves(text: str, option: str, example: str) -> tuple[str, str]:
    # The first sign: a value may hold others.
    name, separator, value = text.partition("=")
    if not separator or not name.strip() or not value.strip():
        raise RunError(f"{option} {text}: write it as in {option} {example}")
    return name.strip(), value.strip()


def _settings(services: Mapping[str, ServiceSpec], texts: Sequence[str]) -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = {}
    for text in texts:
        example = "channel.rung=spherical"
        path, value = _halves(text, "--set", example)
        name, *keys = path.split(".")
        if not keys or not all(keys):
            raise RunError(f"--set {text}: write service and setting, as in --set {example}")
        table = found.setdefault(service_named(services, name, f"--set {text}"), {})
        for key in keys[:-1]:
            table = table.setdefault(key, {})
            # As in --set a.b=1 --set a.b.c=2.
            if not isinstance(table, dict):
                raise RunError(f"--set {text}: {key!r} was given a value of its own before; leave out one")
        table[keys[-1]] = value
    return found


def _value(text: str) -> Any:
    """Read a value as TOML; what is no TOML is text, so that names need no quotation marks."""
    try:
        return parse_toml(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def typed(changes: Mapping[str, Any], cls: type[msgspec.Struct]) -> dict[str, Any]:
    """Read settings that were typed on the command line.

    Args:
        changes: Texts by key, in nested tables.
        cls: Type of the settings: where only text fits a field, ``1e3`` stays text, as the name of a rung.
    """
    types = {field.encode_name: field.type for field in msgspec.structs.fields(cls)}
    return {key: _typed(value, types.get(key, Any)) for key, value in changes.items()}


def _typed(given: Any, expected: Any) -> Any:
    if isinstance(given, Mapping):
        return {key: _typed(value, Any) for key, value in given.items()}
    value = _value(given)
    # `1e3` is a number to TOML, and may be the name of something to the field.
    return given if not _fits(value, expected) and _fits(given, expected) else value


def _fits(value: Any, expected: Any) -> bool:
    try:
        msgspec.convert(value, expected)
    except msgspec.ValidationError:
        return False
    return True


def merged(settings: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Replace some settings, tables within tables key by key.

    Example:
        >>> merged({"a": {"b": 1, "c": 2}}, {"a": {"c": 3}})
        {'a': {'b': 1, 'c': 3}}
    """
    found = dict(settings)
    for key, value in changes.items():
        known = found.get(key)
        both = isinstance(value, Mapping) and isinstance(known, Mapping)
        found[key] = merged(known, value) if both and known is not None else value
    return found


Part: TypeAlias = Literal["recorded", "replaced", "again", "left out"]


@dataclass(frozen=True)
class Role:
    """Part of one service in a replay."""

    name: str
    part: Part
    use: str
    """The implementation that it has in the replay, or had where it is served as recorded."""
    why: str
    """For the user: what that follows from, or what is served."""


@dataclass(frozen=True)
class ReplayPlan:
    """A replay before it begins."""

    scenario: Scenario
    frames: int
    """Frames of an episode, at most."""
    roles: tuple[Role, ...]
    notes: tuple[str, ...]
    identical: bool
    """Whether the digest has to be that of the recorded run."""


def plan_replay(run: RecordedRun, request: Request, frames: int | None = None) -> ReplayPlan:
    """Plan a replay.

    Args:
        run: What was recorded.
        request: What is asked for.
        frames: Of each episode, at most; None: as many as were recorded.

    Raises:
        RunError: A service that runs needs what was not recorded and no service makes, or there are not so
            many frames; the text has the remedy.
    """
    roles = tuple(_role(name, spec, run, request) for name, spec in run.scenario.services.items())
    services = {role.name: _spec(role, run, request) for role in roles if role.part != "left out"}
    hellos = {name: _declared(name, spec, run) for name, spec in services.items()}
    _check_needs(hellos, roles, run)
    length, cut = _length(run, roles, frames)
    served = tuple(role.name for role in roles if role.part == "recorded")
    produced = {topic for hello in hellos.values() for topic in hello.outputs}
    spec = ReplaySpec(
        recording=str(run.recording.directory.resolve()),
        served=served,
        imposed=tuple(r.name for r in roles if r.part == "again" and run.hellos[r.name].role != "recorder"),
        digest=run.digest(length),
    )
    scenario = replace(
        run.scenario,
        run=replace(
            run.scenario.run,
            pace="free",  # a recorded product is there at once, and a replay has no real time to keep
            episodes=len(run.lengths),
            seed=run.recording.metadata.seed,
            record=tuple(entry for entry in run.demand if entry.partition(".")[0] in produced),
        ),
        services=services,
        # By name: a world that is left out must not make another one the default.
        devices=tuple(
            replace(device, world=world_of(run.scenario, index))
            for index, device in enumerate(run.scenario.devices)
        ),
        replay=spec,
    )
    missed = [name for name in spec.imposed if run.misses(name)]
    return ReplayPlan(
        scenario=scenario,
        frames=length,
        roles=roles,
        notes=(*cut, *_notes(run, roles, missed)),
        # Where nothing changed and nothing was late, every product has to come out as it was.
        identical=not request.changed and not missed,
    )


def _role(name: str, spec: ServiceSpec, run: RecordedRun, request: Request) -> Role:
    """Choose the part of a service, in the order of precedence: options before what follows from them."""
    if name in request.replace:
        return Role(name, "replaced", request.replace[name], f"in place of {spec.use}")
    if name in request.settings:
        return Role(name, "replaced", spec.use, "with other settings")
    if spec.role == "recorder":
        return Role(name, "again", spec.use, "records")
    if request.again and run.topics[name]:
        return Role(name, "again", spec.use, "as recorded, its decisions imposed")
    if name in request.keep:
        return Role(name, "again", spec.use, "as asked for")
    after = run.after(request.changed) - request.recorded
    if name in after:
        origin = ", ".join(sorted(other for other in request.changed if name in run.after([other])))
        return Role(name, "again", spec.use, f"it takes what follows from {origin}")
    if not run.topics[name]:
        return Role(name, "left out", spec.use, "nothing of it was recorded")
    return Role(name, "recorded", spec.use, ", ".join(run.topics[name]))


def _spec(role: Role, run: RecordedRun, request: Request) -> ServiceSpec:
    # All services wait: a replay does not depend on how fast this machine is.
    spec = replace(run.scenario.services[role.name], policy="wait")
    if role.part == "recorded":
        return served_from_recording(spec, run.topics[role.name], run.recording.directory)
    if role.part == "replaced":
        # Another implementation has other settings: those of the old one would be refused.
        same = role.use == spec.use
        given = request.settings.get(role.name, {})
        changed = merged(spec.settings if same else {}, typed(given, settings_type(spec.role, role.use)))
        return replace(spec, use=role.use, settings=changed)
    return spec


def _declared(name: str, spec: ServiceSpec, run: RecordedRun) -> Hello:
    """HELLO of a service that runs; `DeclarationError` where its implementation is not registered."""
    return run.hellos[name] if spec.remote else declared_hello(name, spec)


def _check_needs(hellos: dict[str, Hello], roles: tuple[Role, ...], run: RecordedRun) -> None:
    """Raise `RunError` where a service that runs needs what no service makes and no recording has."""
    recorded = {role.name for role in roles if role.part == "recorded"}
    for name, hello in hellos.items():
        for item in hello.inputs:
            if hello.role == "recorder":
                continue  # it takes all topics, and records those there are
            sources = [other for other, its in hellos.items() if item.topic in its.outputs]
            if not sources and item.required:
                raise RunError(_not_recorded(name, item, run))
            # Only a source that runs can make parts that were not recorded.
            if sources and run.parts_are_known and recorded.issuperset(sources):
                _check_parts(name, item, sources[0], run)


def _check_parts(name: str, item: Input, source: str, run: RecordedRun) -> None:
    for part in item.parts:
        entry = f"{item.topic}.{part}"
        if entry not in run.demand:
            raise RunError(
                f"{name!r} needs {entry}, and {item.topic} was recorded without it; add --keep {source}, or "
                f'record a run with record = […, "{entry}"]'
            )


def _not_recorded(name: str, item: Input, run: RecordedRun) -> str:
    makers = [other for other, hello in run.hellos.items() if item.topic in hello.outputs]
    text = f"{name!r} needs {item.topic}, which {run.recording.path} does not hold"
    if makers:
        return (
            f"{text}; add --keep {makers[0]}, which makes it, or record a run with "
            f'record = […, "{item.topic}"]'
        )
    known = ", ".join(sorted(run.recording.topics))
    return f"{text}, and no service of the recorded run makes; it holds {known}"


def _length(run: RecordedRun, roles: tuple[Role, ...], frames: int | None) -> tuple[int, list[str]]:
    """Frames of an episode. Replayed agents end episodes where they ended; without one, all are as short
    as the shortest."""
    agents = [r for r in roles if r.part == "recorded" and run.hellos[r.name].role == "agent"]
    shortest, longest = min(run.lengths.values()), max(run.lengths.values())
    found, notes = longest, []
    # A served product lacks beyond the end of its episode: no episode may be longer than the shortest.
    if not agents and any(role.part == "recorded" for role in roles):
        found = shortest
        if shortest < longest:
            notes.append(f"episodes have {shortest} frames, as many as the shortest recorded one")
    if not run.recording.complete:
        notes.append("the recording breaks off; what there is of it is repeated")
    if frames is not None and frames > found:
        raise RunError(f"--frames {frames}: the recording has {found} of an episode; write at most {found}")
    return frames or found, notes


def _notes(run: RecordedRun, roles: tuple[Role, ...], missed: list[str]) -> list[str]:
    runs = {role.name for role in roles if role.part in ("replaced", "again")}
    # A world that is served moves as it did, whatever the agents of this run decide.
    acts = any(run.scenario.services[name].role == "agent" for name in runs)
    notes = []
    for role in roles:
        hello = run.hellos[role.name]
        follows = hello.role == "world" and any(item.topic == "action" for item in hello.inputs)
        if role.part == "recorded" and follows and acts:
            notes.append(
                f"{role.name} is as recorded: it does not follow the actions of this run (open loop)"
            )
    for name in missed:
        notes.append(
            f"{name} missed {run.misses(name)} frames in the recorded run; it computes them now, so that the "
            "digest becomes another"
        )
    strict = [n for n, s in run.scenario.services.items() if s.policy != "wait" and n in runs]
    if strict:
        notes.append(f"nothing is late in a replay: {', '.join(strict)} wait instead of missing frames")
    return notes


def scenario_text(scenario: Scenario) -> str:
    """Write a scenario as TOML, which `caviar_protocol.scenario.load_scenario` reads as this scenario.

    Example:
        >>> from caviar_protocol.scenario import load_scenario, parse_scenario
        >>> scenario = load_scenario("smoke")
        >>> parse_scenario(scenario_text(scenario)).services == scenario.services
        True
    """
    table = plain(scenario, defaults=False)
    table.pop("source", None)
    if table["run"].get("instants_s"):  # their number and distances are those of frames
        table["run"].pop("frames", None)
        table["run"].pop("sampling_period_ns", None)
    return toml_text(table)
