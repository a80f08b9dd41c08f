"""A scenario made ready for a run: loaded, checked against the implementations that it uses, with these.

`prepare` is the one way of a scenario file into what runs it: `caviar run`, embedded runs, environments,
datasets, laboratories. A broker loads the file itself, since it may stand on another machine. Another process
gets the plain `Scenario`; there `implemented` finds the classes, and nothing is checked again.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec
from msgspec.structs import replace

from caviar_broker.core.graph import build_graph
from caviar_clients.session.plausibility import implausible_values, refuse_carriers
from caviar_protocol.errors import DeclarationError, suggestion
from caviar_protocol.messages import PROTOCOL_VERSION, Hello, Role
from caviar_protocol.scenario import REMOTE, Scenario, ServiceSpec, attached, load_scenario
from caviar_protocol.scenario.conversion import Place, convert_settings
from caviar_protocol.scenario.rules import scenario_error, settings_place, with_overrides
from caviar_protocol.topics import topics_of
from caviar_services.registry import find_modules_in, load, registered, registered_names
from caviar_services.service import Service


@dataclass(frozen=True, eq=False)
class PreparedService:
    """A service of a scenario that runs here. Its class is loaded, and its settings are converted, once."""

    name: str
    spec: ServiceSpec
    place: Place
    """Place of its settings in the scenario."""

    @cached_property
    def cls(self) -> type[Service[Any]]:
        """Its implementation.

        Raises:
            ScenarioError: There is none; the text has file, line and the known names.
        """
        try:
            return load(self.spec.role, self.spec.use)
        except DeclarationError as error:
            raise Place(f"services.{self.name}.use", self.place.source).error(str(error)) from error

    @cached_property
    def settings(self) -> Any:
        """Its settings as the implementation's struct.

        Raises:
            ScenarioError: One is unknown or out of range; the text has file, line, key and remedy.
        """
        return convert_settings(self.cls.Settings, self.spec.settings, self.place)


@dataclass(frozen=True, eq=False)
class PreparedScenario:
    """A scenario with the implementations of its services, as `prepare` and `implemented` make it."""

    scenario: Scenario
    services: Mapping[str, PreparedService]
    """Services that run here, by name: all but remote ones."""

    @cached_property
    def warnings(self) -> list[str]:
        """Values that the author hardly means (`plausibility.implausible_values`), a line each."""
        return implausible_values(self)

    def of_role(self, role: Role) -> list[PreparedService]:
        """List the services of a role that run here."""
        return [service for service in self.services.values() if service.spec.role == role]


def prepare(
    scenario: str | Path | Scenario,
    frames: int | None = None,
    seed: int | None = None,
    pace: str | None = None,
    attachments: Sequence[str] = (),
    settings: Sequence[str] = (),
) -> PreparedScenario:
    """Load a scenario, and check it against the implementations that it uses.

    Args:
        scenario: A scenario's file, the name of one that ships, or one that is loaded.
        frames, seed, pace: What replaces the scenario's; None: nothing.
        attachments: ``NAME=VALUE`` each, as of `attached`.
        settings: ``KEY=VALUE`` each, in place of what the file says.

    Raises:
        ScenarioError: An implementation or a setting does not exist, or no implementation produces a topic to
            record; the text has file, key and line.

    Example:
        >>> prepare("smoke", frames=3).scenario.run.frames
        3
    """
    loaded = scenario if isinstance(scenario, Scenario) else load_scenario(Path(scenario), settings)
    found = implemented(attached(with_overrides(loaded, frames, seed, pace), attachments))
    _check(found)
    return found


def implemented(scenario: Scenario | PreparedScenario) -> PreparedScenario:
    """Find the implementations of a scenario that is checked already, here or by another process.

    Args:
        scenario: Checked. One that is prepared is returned as it is.
    """
    if isinstance(scenario, PreparedScenario):
        return scenario
    # Before classes are loaded; the processes of services get the same folders on their command lines.
    for folder in module_folders(scenario):
        find_modules_in(folder)
    local = {name: spec for name, spec in scenario.services.items() if not spec.remote}
    return PreparedScenario(
        scenario,
        {name: PreparedService(name, spec, settings_place(scenario, name)) for name, spec in local.items()},
    )


def _check(prepared: PreparedScenario) -> None:
    scenario = prepared.scenario
    refuse_carriers(scenario)
    registered()  # refuses two of one name: the process of a service that is built in looks for no other
    produced: set[str] = set()
    for name, spec in scenario.services.items():
        if spec.remote:  # another program, which says what it produces when it joins
            produced.update(topics_of(spec.role))
            continue
        service = prepared.services[name]
        _check_keys(service)
        service.cls.check_settings(service.settings, service.place)
        service.cls.check_scenario(service.settings, scenario, service.place)
        produced.update(service.cls.outputs)
    for index, entry in enumerate(scenario.run.record):
        topic = entry.partition(".")[0]  # of a part, as channel.taps
        if topic not in produced:
            raise scenario_error(
                scenario,
                f"run.record[{index}]",
                f"no service of the run produces {topic!r}; remove it, or add a service that does",
            )


def _check_keys(service: PreparedService) -> None:
    """Raise `ScenarioError` for a setting that the implementation lacks, naming those that have it."""
    spec, known = service.spec, _keys(service.cls)
    key = next((key for key in spec.settings if key not in known), None)
    if key is None:
        return
    owners = [name for name in registered_names(spec.role) if key in _keys_of_registered(spec.role, name)]
    has = f"{spec.use!r} has: {', '.join(known)}" if known else f"{spec.use!r} has no settings"
    if owners:
        hint = f"it is a setting of {' and '.join(map(repr, owners))}; "
    else:
        near = suggestion(key, known)
        hint = f"{near} " if near.startswith("did") else ""
    raise service.place.at(key).error(f"unknown key {key!r}; {hint}{has}")


def _keys_of_registered(role: str, name: str) -> tuple[str, ...]:
    """Settings of a registered implementation; none of one that cannot be loaded here."""
    try:
        return _keys(load(role, name))
    except DeclarationError:
        return ()


def _keys(implementation: type[Service[Any]]) -> tuple[str, ...]:
    return tuple(field.encode_name for field in msgspec.structs.fields(implementation.Settings))


def module_folders(scenario: Scenario) -> tuple[Path, ...]:
    """List the folders of modules of services that are named ``module:Class``.

    Returns:
        The scenario's folder and the current one; empty where neither a service nor a rung of a service's
        settings is named so.
    """
    if not any(map(names_class, scenario.services.values())):
        return ()
    beside = (Path(scenario.source.file).resolve().parent,) if scenario.source.file else ()
    return (*beside, Path.cwd())


def names_class(spec: ServiceSpec) -> bool:
    """Tell whether a service, or a rung of its settings, is named ``module:Class``, which a run imports."""
    return any(":" in name for name in (spec.use, *_used_by(spec.settings)))


def _used_by(settings: object) -> Iterator[str]:
    """Implementations that tables within settings name with ``use``, as the rungs of ``adaptive`` do."""
    if isinstance(settings, Mapping):
        if isinstance(name := settings.get("use"), str):
            yield name
        settings = settings.values()
    # Rungs stand in a list of tables, a reference in a table.
    if isinstance(settings, Iterable) and not isinstance(settings, str):
        for value in settings:
            yield from _used_by(value)


def settings_type(role: str, use: str) -> type[msgspec.Struct]:
    """Find the type of an implementation's settings; of a remote service, which is not here, any.

    Raises:
        DeclarationError: There is no such implementation.
    """
    return msgspec.Struct if use == REMOTE else load(role, use).Settings


def declared_hello(name: str, spec: ServiceSpec) -> Hello:
    """Make the HELLO that a service's implementation would send.

    Args:
        name: Of the service.
        spec: Of the service, from the scenario.

    Raises:
        DeclarationError: The service is remote, or its implementation is not here.
    """
    if spec.remote:
        raise DeclarationError(f"{name!r} is started by the user, and declares itself when it joins")
    cls = load(spec.role, spec.use)
    return Hello(version=PROTOCOL_VERSION, name=name, role=spec.role, inputs=cls.inputs, outputs=cls.outputs)


def demanded(hellos: Mapping[str, Hello], record: Sequence[str]) -> set[str]:
    """Collect the topics that a run is asked for, and their parts, as entries of ``run.record``.

    Args:
        hellos: What each service of the run declares, by name.
        record: ``run.record`` of the scenario.

    Example:
        >>> hello = Hello(version=PROTOCOL_VERSION, name="world", role="world", outputs=("scene",))
        >>> demanded({"world": hello}, ["scene"])
        {'scene'}
    """
    found = set(record)
    for demands in build_graph(hellos, tuple(record)).demand.values():
        for demand in demands:
            found |= {demand.topic, *(f"{demand.topic}.{part}" for part in demand.parts)}
    return found


def served_from_recording(spec: ServiceSpec, topics: Iterable[str], directory: Path) -> ServiceSpec:
    """Make a service into one that serves what it produced in a recorded run.

    Args:
        spec: Of the service, from the scenario.
        topics: Recorded topics of the service.
        directory: The recorded run's directory.
    """
    from caviar_services.replay import use_of  # only a replay needs it, and every run loads this module

    settings = {"recording": str(directory.resolve())}
    return replace(spec, use=use_of(spec.role, topics), settings=settings, max_in_flight=1)
