"""JSON Schema of scenario files, for editors that complete and check TOML.

The schema is made from the types that scenarios are read into: `caviar_protocol.scenario.schema.Scenario` and
the ``Settings`` of every registered implementation. It has the keys, their types, ranges, units and meanings.
Rules between keys are not in it: `caviar_protocol.scenario.rules` applies them when a scenario is loaded.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, get_args

import msgspec

from caviar_protocol.messages import Role
from caviar_protocol.scenario.schema import REMOTE, Run, Scenario
from caviar_protocol.spec import rows, structs_below
from caviar_services.registry import load, registered_names

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
    settings = settings_classes()
    classes: list[type[msgspec.Struct]] = [Scenario, *settings.values()]
    references, definitions = msgspec.json.schema_components(classes, ref_template="#/$defs/{name}")
    by_implementation = dict(zip(settings, references[1:], strict=True))
    # msgspec has the descriptions of structs; meanings of fields are the strings below them in the source.
    for cls in structs_below(classes):
        if cls.__name__ in definitions:
            _describe(definitions[cls.__name__], cls)
    for definition in definitions.values():
        if {"use", "settings"} <= definition.get("properties", {}).keys():
            definition["allOf"] = list(_conditions(definition, by_implementation))
    _accept_instants(definitions[Run.__name__])
    del definitions[Scenario.__name__]["properties"]["source"]  # where the file was read from
    del definitions["Source"]
    head: dict[str, Any] = {"$schema": DIALECT, "title": "CAVIAR scenario"}
    return {**head, **definitions.pop(Scenario.__name__), "$defs": definitions}


def _describe(definition: dict[str, Any], cls: type[msgspec.Struct]) -> None:
    """Put meaning and unit of each field into its description."""
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


def _accept_instants(run: dict[str, Any]) -> None:
    """Add the forms of ``instants`` that a scenario may have in place of ``frames``."""
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
