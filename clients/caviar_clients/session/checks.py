"""What the implementations of a scenario declare and accept, checked before its run; free airspace."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec.structs import replace

from caviar_broker.core.graph import build_graph
from caviar_clients.session.plausibility import refuse_carriers
from caviar_protocol.errors import DeclarationError, suggestion
from caviar_protocol.messages import PROTOCOL_VERSION, Hello
from caviar_protocol.scenario import REMOTE, Scenario, ServiceSpec, load_scenario
from caviar_protocol.scenario.attachments import attached
from caviar_protocol.scenario.conversion import Place, convert_settings
from caviar_protocol.scenario.rules import scenario_error, settings_place, with_overrides
from caviar_protocol.space.coordinates import Vector
from caviar_protocol.topics import topics_of
from caviar_services.registry import find_modules_in, load, registered, registered_names
from caviar_services.service import Service
from caviar_space.obstacles import Obstacles, Surfaces
from caviar_space.scenery import scenery_triangles


def checked_scenario(
    path: str | Path,
    frames: int | None = None,
    seed: int | None = None,
    pace: str | None = None,
    attachments: Sequence[str] = (),
    settings: Sequence[str] = (),
) -> Scenario:
    """Load a scenario and check it against the implementations that it uses.

    Args:
        path: The scenario's file, or the name of one that ships.
        frames, seed, pace: What replaces the scenario's; None: nothing.
        attachments: ``NAME=VALUE`` each, as of `attached`.
        settings: ``KEY=VALUE`` each, in place of what the file says.

    Raises:
        ScenarioError: An implementation or a setting does not exist, or no implementation produces a topic to
            record; the text has file, key and line.

    Example:
        >>> checked_scenario("smoke", frames=3).run.frames
        3
    """
    scenario = with_overrides(load_scenario(Path(path), settings), frames, seed, pace)
    return check_implementations(attached(scenario, attachments))


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
    """Whether a service, or a rung of its settings, is named ``module:Class``: a run imports the module."""
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


def _check_keys(spec: ServiceSpec, implementation: type[Service[Any]], place: Place) -> None:
    """Raise `ScenarioError` for a setting that the implementation lacks, naming those that have it."""
    known = _settings_of(implementation)
    for key in spec.settings:
        if key in known:
            continue
        owners = [name for name in registered_names(spec.role) if key in _settings_named(spec.role, name)]
        has = f"{spec.use!r} has: {', '.join(known)}" if known else f"{spec.use!r} has no settings"
        if owners:
            hint = f"it is a setting of {' and '.join(map(repr, owners))}; "
        else:
            near = suggestion(key, known)
            hint = f"{near} " if near.startswith("did") else ""
        raise place.at(key).error(f"unknown key {key!r}; {hint}{has}")


def _settings_named(role: str, name: str) -> tuple[str, ...]:
    """Settings of a registered implementation; none of one that cannot be loaded here."""
    try:
        return _settings_of(load(role, name))
    except DeclarationError:
        return ()


def _settings_of(implementation: type[Service[Any]]) -> tuple[str, ...]:
    return tuple(field.encode_name for field in msgspec.structs.fields(implementation.Settings))


def check_implementations(scenario: Scenario) -> Scenario:
    """Check a scenario that is loaded, as `checked_scenario` does.

    Returns:
        The scenario.

    Raises:
        ScenarioError: As of `checked_scenario`.
    """
    refuse_carriers(scenario)
    registered()  # refuses two of one name: the process of a service that is built in looks for no other
    # Before classes are loaded; the processes of services get the same folders on their command lines.
    for folder in module_folders(scenario):
        find_modules_in(folder)
    produced: set[str] = set()
    for name, spec in scenario.services.items():
        if spec.remote:  # another program, which says what it produces when it joins
            produced.update(topics_of(spec.role))
            continue
        try:
            implementation = load(spec.role, spec.use)
        except DeclarationError as error:
            raise scenario_error(scenario, f"services.{name}.use", str(error)) from error
        place = settings_place(scenario, name)
        _check_keys(spec, implementation, place)
        settings = convert_settings(implementation.Settings, spec.settings, place)
        implementation.check_settings(settings, place)
        implementation.check_scenario(settings, scenario, place)
        produced.update(implementation.outputs)
    for index, entry in enumerate(scenario.run.record):
        topic = entry.partition(".")[0]  # of a part, as channel.taps
        if topic not in produced:
            raise scenario_error(
                scenario,
                f"run.record[{index}]",
                f"no service of the run produces {topic!r}; remove it, or add a service that does",
            )
    return scenario


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


TRIES = 10_000
"""Points that are drawn at most, until one is free."""


class Airspace:
    """The points of a box that are free for an object: clear of scenery, and outside of buildings.

    Args:
        low, high: Corners [m] of the box that it keeps within.
        clearance: Least distance [m] of its centre from scenery.
        scenery: Files of the run's scenery, by asset name.
        is_allowed: Tells of a point [m] whether the object may be there.
    """

    def __init__(
        self,
        low: Vector,
        high: Vector,
        clearance: float,
        scenery: Mapping[str, Path],
        is_allowed: Callable[[Vector], bool] = lambda point: True,
    ) -> None:
        self.low, self.high = low, high
        self._is_allowed = is_allowed
        self._clearance = clearance
        triangles = scenery_triangles(scenery)
        # What ends below the box is no obstacle: an object may fly low over the ground.
        self._obstacles = Obstacles(triangles[triangles[..., 2].max(axis=1) > low[2]])
        self._surfaces = Surfaces(triangles, lambda triangle, normal: True)

    def within(self, low: Vector, high: Vector) -> Airspace:
        """Take another box [m] in the same scenery, which is not loaded again."""
        other = copy.copy(self)
        other.low, other.high = low, high
        return other

    def is_free(self, point: Vector) -> bool:
        """Tell whether the object can be at a point [m]."""
        if not all(a <= x <= b for a, x, b in zip(self.low, point, self.high, strict=True)):
            return False
        if not self._is_allowed(point):
            return False
        if self._obstacles.distance(point, self._clearance) < self._clearance:
            return False
        return not self._surfaces.encloses(np.array(point))

    def draw(
        self,
        random: np.random.Generator,
        near: Vector | None = None,
        distance: tuple[float, float] = (0.0, np.inf),
    ) -> Vector | None:
        """Draw a free point.

        Args:
            random: Generator of the draw.
            near: Point from which the distance is measured [m]; None: any distance is right.
            distance: Least and greatest distance [m].

        Returns:
            A point [m], uniform among those that fit; None where `TRIES` draws found none.
        """
        # By rejection, which needs no volume of what is free: a city leaves most of its air.
        for _ in range(TRIES):
            x, y, z = random.uniform(self.low, self.high).tolist()
            far = 0.0 if near is None else float(np.linalg.norm(np.subtract((x, y, z), near)))
            if distance[0] <= far <= distance[1] and self.is_free((x, y, z)):
                return x, y, z
        return None
