"""A scenario as TOML text."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

import msgspec

from caviar_protocol.scenario import Scenario


def scenario_text(scenario: Scenario) -> str:
    """What `caviar_protocol.scenario.loader.load_scenario` reads as this scenario."""
    table = lean(scenario)
    table.pop("source", None)
    if table["run"].get("instants_s"):  # which tell the others
        table["run"].pop("frames", None)
        table["run"].pop("sampling_period_ns", None)
    lines = []
    for name, value in table.items():
        for entry in value if isinstance(value, list) else [value]:
            lines += ["", f"[[{name}]]" if isinstance(value, list) else f"[{name}]"]
            lines += [f"{_key(key)} = {_value(item)}" for key, item in entry.items()]
    return "\n".join(lines[1:]) + "\n"


def lean(value: Any) -> Any:
    """Built-in types, without what a struct's defaults say."""
    if isinstance(value, msgspec.Struct):
        tag = value.__struct_config__.tag_field
        found = {tag: value.__struct_config__.tag} if tag else {}
        for field in msgspec.structs.fields(value):
            item = getattr(value, field.name)
            default = field.default_factory() if callable(field.default_factory) else field.default
            if item is not None and (item != default or type(item) is not type(default)):
                found[field.name] = lean(item)
        return found
    if isinstance(value, Mapping):
        return {str(key): lean(item) for key, item in value.items() if item is not None}
    if isinstance(value, list | tuple):
        return [lean(item) for item in value]
    return msgspec.to_builtins(value)


def _value(value: Any) -> str:
    if isinstance(value, Mapping):
        inside = ", ".join(f"{_key(key)} = {_value(item)}" for key, item in value.items())
        return f"{{ {inside} }}" if inside else "{}"
    if isinstance(value, list):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, float):
        return repr(value)  # shortest digits that read back as the same number; inf and nan are TOML too
    return _text(value) if isinstance(value, str) else json.dumps(value)


def _key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else _text(key)


def _text(text: str) -> str:
    """JSON's escapes are those of TOML but for DEL, and for characters beyond the basic plane as they are."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007F")
