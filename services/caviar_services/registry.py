"""Implementations by role and name.

Strings, loaded late: importing this module imports no implementation, and an implementation
imports its heavy libraries only when it prepares. Other distributions, and `caviar_bridges` of this
one, add theirs through the entry-point group ``caviar.services`` (name ``role:name``, value
``module:Class``). What is not registered at all can be named by its place, ``module:Class``, as long as
Python finds the module.

`scenario_schema` makes a JSON Schema of scenario files, for editors that complete and check TOML, from
`caviar_protocol.scenario.schema.Scenario` and the ``Settings`` of every registered implementation. It has the
keys, their types, ranges, units and meanings. Rules between keys are not in it:
`caviar_protocol.scenario.rules` applies them when a scenario is loaded.
"""

from __future__ import annotations

import difflib
import inspect
import sys
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import msgspec

from caviar_protocol.errors import DeclarationError, suggestion
from caviar_protocol.messages import Input, Role
from caviar_protocol.plugins import origin, plugins
from caviar_protocol.scenario.schema import REMOTE, Run, Scenario
from caviar_services.service import NoSettings, Service

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

BUILT_IN: dict[str, str] = {
    "world:sumo": "caviar_services.world.sumo:SumoWorld",
    "world:sumo-actuated": "caviar_services.world.sumo:ActuatedSumoWorld",
    "world:trajectory": "caviar_services.world.trajectory:TrajectoryWorld",
    "world:flight": "caviar_services.world.flight:FlightWorld",
    "channel:adaptive": "caviar_services.channel.adaptive.channel:AdaptiveChannel",
    "channel:free-space": "caviar_services.channel.statistical.free_space:FreeSpaceChannel",
    "channel:geometric": "caviar_services.channel.statistical.geometric:GeometricChannel",
    "channel:sionna-rt": "caviar_services.channel.sionna.model:SionnaChannel",
    "sensors:camera": "caviar_services.sensors.camera:CameraSensors",
    "sensors:lidar": "caviar_services.sensors.lidar:LidarSensors",
    "link:beams": "caviar_services.link.beams:BeamLink",
    "link:cell": "caviar_services.link.cell:CellLink",
    "agent:los-beam": "caviar_services.agent.baselines:LosBeamAgent",
    "agent:random": "caviar_services.agent.baselines:RandomAgent",
    "agent:oracle": "caviar_services.agent.baselines:OracleAgent",
    "agent:waypoints": "caviar_services.agent.baselines:WaypointsAgent",
    "agent:exhaustive-sweep": "caviar_services.agent.sweeps:ExhaustiveSweepAgent",
    "agent:hierarchical-sweep": "caviar_services.agent.sweeps:HierarchicalSweepAgent",
    "agent:last-sweep": "caviar_services.agent.sweeps:LastSweepAgent",
    "agent:fingerprint": "caviar_services.agent.fingerprint:FingerprintAgent",
    "agent:out-of-band": "caviar_services.agent.sweeps:OutOfBandAgent",
    "agent:ucb": "caviar_services.agent.bandits:UcbAgent",
    "agent:thompson": "caviar_services.agent.bandits:ThompsonAgent",
    "agent:learner": "caviar_services.agent.learner:LearnerAgent",
    "agent:policy": "caviar_services.agent.policy:PolicyAgent",
    "recorder:mcap": "caviar_services.recorder.mcap:McapRecorder",
}
"""``role:name`` to ``module:Class``. To add an implementation: one file, one line here."""

ENTRY_POINT_GROUP = "caviar.services"


@cache
def registered() -> dict[str, str]:
    """Everything registered, built in and by entry points.

    Returns:
        ``module:Class`` by ``role:name``.

    Raises:
        DeclarationError: Two distributions register the same ``role:name``.

    Example:
        >>> registered()["agent:random"]
        'caviar_services.agent.baselines:RandomAgent'
    """
    added = plugins(ENTRY_POINT_GROUP)
    for name, point in added.items():
        if BUILT_IN.get(name, point.value) != point.value:
            raise DeclarationError(
                f"{name} is registered twice, as {BUILT_IN[name]} and as {origin(point)}; "
                "uninstall or rename one of them"
            )
    return BUILT_IN | {name: point.value for name, point in added.items()}


def with_inputs(cls: type[Service[Any]], inputs: Sequence[Input]) -> type[Service[Any]]:
    """The class with further inputs (`Service.inputs_with`); itself where there are none.

    Args:
        cls: An implementation.
        inputs: What it consumes beside its own.

    Example:
        >>> grids = (Input(topic="lidar", parts=("grid",)),)
        >>> [entry.topic for entry in with_inputs(load("agent", "policy"), grids).inputs]
        ['scene', 'link', 'lidar']
    """
    more = {"inputs": (*cls.inputs, *inputs), "__module__": cls.__module__}
    return type(cls.__name__, (cls,), more) if inputs else cls


def load(role: str, name: str) -> type[Service[Any]]:
    """Load the class of an implementation.

    Args:
        role: Role of the service.
        name: Registered name, or the place ``module:Class``.

    Returns:
        The class, a `Service` of this role that defines all it has to.

    Raises:
        DeclarationError: There is none; the text has the known names, nearest first, or what is wrong with
            the class.

    Example:
        >>> load("agent", "random").__name__
        'RandomAgent'
    """
    target = where = name if ":" in name else BUILT_IN.get(f"{role}:{name}", "")
    if not target:  # a process of a service that is built in reads no metadata
        point = _added(role, name)
        target, where = point.value, origin(point)
    module_name, _, class_name = target.partition(":")
    try:
        module = import_module(module_name)
        # A module that makes attributes says itself which there are.
        makes = "__getattr__" in vars(module)
        cls = getattr(module, class_name) if makes else getattr(module, class_name, None)
    except Exception as error:  # whatever a module that is not ours does when it is imported
        known = isinstance(error, ImportError | AttributeError)
        text = str(error) if known else f"{type(error).__name__}: {error}"
        if module_name.endswith(".py"):
            text = f"a module is named without .py: {module_name.removesuffix('.py')}:{class_name}"
        elif isinstance(error, ModuleNotFoundError) and error.name == module_name.partition(".")[0]:
            text += (
                "; modules are looked for beside the scenario, in the current folder, among what is "
                "installed and in PYTHONPATH"
            )
        raise DeclarationError(f"{role} {name!r} cannot be loaded from {where}: {text}") from error
    if cls is None:
        classes = [key for key, value in vars(module).items() if _is_of_role(value, role)]
        found = suggestion(class_name, classes) if classes else f"it has no class of role {role!r}"
        place = getattr(module, "__file__", None) or module_name
        raise DeclarationError(
            f"{role} {name!r} is {where}: {place} has no attribute {class_name!r}; {found}"
        )
    if not (isinstance(cls, type) and issubclass(cls, Service)):
        raise DeclarationError(f"{role} {name!r} is {where}, which is not a Service")
    declared = getattr(cls, "role", None)
    if declared != role:
        raise DeclarationError(f"{role} {name!r} is {where}, whose role is {declared!r}")
    if inspect.isabstract(cls):
        missing = ", ".join(sorted(cls.__abstractmethods__))
        raise DeclarationError(f"{role} {name!r} is {where}, which does not define: {missing}")
    # Abstract methods are found above; a class attribute that is not set would fail where it is first read.
    missing = ", ".join(name for name in cls.attributes_to_set if not hasattr(cls, name))
    if missing:
        raise DeclarationError(f"{role} {name!r} is {where}, which does not set: {missing}")
    if cls.checkpoints:
        missing = " and ".join(
            method for method in ("checkpoint", "restore") if getattr(cls, method) is getattr(Service, method)
        )
        if missing:
            raise DeclarationError(
                f"{role} {name!r} is {where}, which sets checkpoints = True and does not define {missing}; "
                "define checkpoint() and restore(), or leave out checkpoints if nothing outlives a frame"
            )
    # What is saved by nobody would be found out with the first service that is killed.
    own = [base for base in cls.__mro__ if base is not Service and issubclass(base, Service)]
    unsaid = not any("checkpoints" in vars(base) for base in own)
    if unsaid and any({"checkpoint", "restore"} & {*vars(base)} for base in own):
        raise DeclarationError(
            f"{role} {name!r} is {where}, which defines checkpoint() or restore() and does not say whether "
            "they are used; write checkpoints = True in the class"
        )
    for base in cls.__mro__[1:]:
        # A base reads its own settings: without them it would fail in the middle of a run.
        inherited = vars(base).get("Settings", NoSettings)
        if inherited is not NoSettings and not issubclass(cls.Settings, inherited):
            raise DeclarationError(
                f"{role} {name!r} is {where}, whose Settings is {cls.Settings.__name__}: it has to be a "
                f"subclass of {inherited.__name__}, that of {base.__name__}"
            )
    return cls


def _is_of_role(value: object, role: str) -> bool:
    if not (isinstance(value, type) and issubclass(value, Service)) or inspect.isabstract(value):
        return False
    return getattr(value, "role", None) == role


def registered_names(role: str) -> tuple[str, ...]:
    """List the names of the implementations of a role, sorted.

    Args:
        role: The role.

    Example:
        >>> registered_names("recorder")
        ('mcap',)
    """
    return tuple(sorted(key.removeprefix(f"{role}:") for key in registered() if key.startswith(f"{role}:")))


def find_modules_in(folder: Path) -> None:
    """Let Python find modules in a folder too, after all other places, so that they hide no other module.

    Args:
        folder: The folder.
    """
    text = str(folder.resolve())
    if text not in sys.path:  # several services of an embedded run may name one folder
        sys.path.append(text)


def _added(role: str, name: str) -> EntryPoint:
    """The entry point of an implementation that is not built in."""
    roles = sorted({key.split(":", 1)[0] for key in registered()})
    if role not in roles:
        raise DeclarationError(f"no service has the role {role!r}; one of {', '.join(roles)}")
    point = plugins(ENTRY_POINT_GROUP).get(f"{role}:{name}")
    if point is None:
        names = registered_names(role)
        near = difflib.get_close_matches(name, names, n=1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        text = f"no {role} is named {name!r}; {hint}known: {', '.join(names)}"
        if not near:
            module, _, cls = name.rpartition(".")
            text += f"; a class of your own is named {module or name}:{cls if module else 'CLASS'}"
        raise DeclarationError(text)
    return point


DIALECT = "https://json-schema.org/draft/2020-12/schema"
CLASS_PLACE = r"^[A-Za-z_][\w.]*:[A-Za-z_]\w*$"
"""``module:Class``, which names an implementation that is not registered."""


def settings_classes() -> dict[tuple[str, str], type[msgspec.Struct]]:
    """Load the ``Settings`` of each registered implementation.

    Returns:
        Class by role and name.

    Example:
        >>> settings_classes()["world", "sumo"].__name__
        'SumoSettings'
    """
    return {
        (role, name): load(role, name).Settings for role in get_args(Role) for name in registered_names(role)
    }


def scenario_schema() -> dict[str, Any]:
    """The JSON Schema (draft 2020-12) of scenario files, with the settings of registered implementations.

    Returns:
        The schema as plain values, to be written as JSON.

    Example:
        >>> scenario_schema()["$defs"]["Run"]["properties"]["seed"]["minimum"]
        0
    """
    # Every service reads this module at its start, and the schema's rows would take 7 ms of it.
    from caviar_protocol.spec import structs_below
    from caviar_services.sensors.noise import SENSORS, noise_models

    settings = settings_classes()
    noises = {(sensor, use): cls for sensor in SENSORS for use, cls in noise_models(sensor).items()}
    classes: list[type[msgspec.Struct]] = [Scenario, *settings.values(), *noises.values()]
    references, definitions = msgspec.json.schema_components(classes, ref_template="#/$defs/{name}")
    by_implementation = dict(zip([*settings, *noises], references[1:], strict=True))
    # msgspec has the descriptions of structs; meanings of fields are the strings below them in the source.
    for cls in structs_below(classes):
        if cls.__name__ in definitions:
            _describe(definitions[cls.__name__], cls)
    for definition in definitions.values():
        if {"use", "settings"} <= definition.get("properties", {}).keys():
            definition["allOf"] = list(_conditions(definition, by_implementation))
    _describe_noise(definitions, by_implementation, noises)
    # Add the forms of ``instants`` that a scenario may have in place of ``frames``.
    run = definitions[Run.__name__]
    properties = run["properties"]
    file = {"type": "string", "pattern": "^file:"}
    listed = {key: value for key, value in properties["instants_s"].items() if key != "description"}
    properties["instants_s"] = {
        "description": properties["instants_s"]["description"],
        "anyOf": [listed, file],
    }
    properties["instants_ns"] = {
        "description": "Instants of the frames of an episode, as whole numbers, in place of instants_s [ns]",
        "type": "array",
        "items": {"type": "integer", "minimum": 0},
    }
    run["required"] = [name for name in run["required"] if name != "frames"]
    run["anyOf"] = [{"required": [name]} for name in ("frames", "instants_s", "instants_ns")]
    del definitions[Scenario.__name__]["properties"]["source"]  # where the file was read from
    del definitions["Source"]
    head: dict[str, Any] = {"$schema": DIALECT, "title": "CAVIAR scenario"}
    return {**head, **definitions.pop(Scenario.__name__), "$defs": definitions}


def _describe(definition: dict[str, Any], cls: type[msgspec.Struct]) -> None:
    """Put meaning and unit of each field into its description."""
    from caviar_protocol.spec import rows

    definition["description"] = (cls.__doc__ or "").partition("\n")[0]
    for name, _, unit, _, _, meaning in rows(cls):
        text = " ".join(meaning.replace("``", "`").split())
        shown = f"{text} [{unit}]" if unit not in ("", "1") else text
        if shown and name in definition.get("properties", {}):
            definition["properties"][name]["description"] = shown


def _conditions(
    definition: Mapping[str, Any], by_implementation: Mapping[tuple[str, str], Any]
) -> list[dict[str, Any]]:
    """What ``use`` may name for each role, and the keys of ``settings`` for each implementation.

    A table without ``role``, such as a rung of the adaptive channel, uses channel models.
    """
    has_role = "role" in definition["properties"]
    roles = get_args(Role) if has_role else ("channel",)
    found: list[dict[str, Any]] = []
    for role in roles:
        of_role = {"properties": {"role": {"const": role}}, "required": ["role"]} if has_role else {}
        names = sorted(name for other, name in by_implementation if other == role)
        if has_role:
            names.append(REMOTE)
        use = {"anyOf": [{"enum": names}, {"pattern": CLASS_PLACE}]}
        found.append({"if": of_role, "then": {"properties": {"use": use}}})
        for name in names:
            if (role, name) not in by_implementation:
                continue
            chosen = {"properties": {"use": {"const": name}}, "required": ["use"]}
            settings = {"properties": {"settings": by_implementation[role, name]}}
            found.append({"if": {"allOf": [of_role, chosen]}, "then": settings})
    return found


def _describe_noise(
    definitions: Mapping[str, Any],
    references: Mapping[tuple[str, str], Any],
    noises: Iterable[tuple[str, str]],
) -> None:
    """Put the keys of each noise model, and ``use`` with its name, into key ``noise`` of its sensor."""
    tables: dict[str, list[Any]] = {}
    for sensor, use in noises:
        model = definitions[references[sensor, use]["$ref"].rpartition("/")[2]]
        properties = {"use": {"const": use}} | model["properties"]
        required = ["use", *model.get("required", ())]
        tables.setdefault(sensor, []).append(model | {"properties": properties, "required": required})
    for sensor, choices in tables.items():
        settings = definitions[references["sensors", sensor]["$ref"].rpartition("/")[2]]
        settings["properties"]["noise"]["anyOf"] = choices
