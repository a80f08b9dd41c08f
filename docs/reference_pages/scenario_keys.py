"""The keys of scenario files, from the types that scenarios are read into."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator, Mapping

import msgspec

from caviar_protocol.scenario.schema import Scenario
from caviar_protocol.spec import markdown, prose, rows, structs_below
from caviar_services.registry import load, settings_classes

from .markdown import table, toctree

TITLES = {"services": "[services.NAME]", "carriers": "[[carriers]]", "devices": "[[devices]]"}
"""How tables stand in a file whose field is not a single table of the same name."""

_HEAD = """\
A scenario is a TOML file. Every key stands here with type, unit, default and meaning, as the reader of
scenarios has them; a key that is not here is refused with file, line and the nearest known key.

`caviar schema --out scenario.schema.json` writes the same as JSON Schema. With the line
`#:schema scenario.schema.json` at the head of a scenario, an editor with a TOML language server completes and
checks keys.
"""

Structs = dict[str, type[msgspec.Struct]]
"""Tables that are shown on a page, or are to be, by name."""


def pages() -> Iterator[tuple[str, str]]:
    """File name and text of each page."""
    settings = settings_classes()
    roles = sorted({role for role, _ in settings})
    lines = ["# Keys of a scenario file", "", _HEAD]
    inner: Structs = {}
    for field in msgspec.structs.fields(Scenario):
        if field.name not in Scenario.not_in_file:
            cls = structs_below([field.type])[0]
            title = TITLES.get(field.name, f"[{field.name}]").replace("[", "\\[")
            lines += [f"## {title}", "", markdown(prose(cls)), "", *_keys(cls, inner)]
    lines += _nested(inner)
    lines += ["## Settings of implementations", ""]
    lines += ["`[services.NAME.settings]` has the keys of the implementation that `use` names:", ""]
    lines += toctree([f"settings-{role}" for role in roles], ":maxdepth: 2")
    yield "index.md", "\n".join(lines)
    for role in roles:
        yield f"settings-{role}.md", "\n".join(_role(role, settings))


def _role(role: str, settings: Mapping[tuple[str, str], type[msgspec.Struct]]) -> Iterator[str]:
    """Settings of the implementations of a role."""
    yield from (f"# Settings: {role}", "")
    yield f'Keys of `[services.NAME.settings]` of a service with `role = "{role}"`, by what `use` names.'
    yield ""
    inner: Structs = {}
    for other, name in settings:
        if other == role:
            docstring = inspect.cleandoc(load(role, name).__doc__ or "")
            yield from (f"## {name}", "", markdown(docstring.partition("\n\n")[0]), "")
            yield from _keys(settings[role, name], inner)
    yield from _nested(inner)


def _keys(cls: type[msgspec.Struct], inner: Structs) -> Iterator[str]:
    """The keys of a table; tables that stand inside of it are added to ``inner``."""
    hidden = getattr(cls, "not_in_file", ())
    found = [_key(*row) for row in rows(cls) if row[0] not in hidden]
    if not found:
        yield from ("It has no settings.", "")
        return
    yield from table(("key", "meaning", "type", "unit", "default"), found)
    inner |= {struct.__name__: struct for struct in structs_below([cls]) if struct is not cls}


def _key(name: str, kind: str, unit: str, default: str, _: str, meaning: str) -> tuple[str, ...]:
    kind = kind.replace("](#field-types)", "](../../../protocol/SPEC.md#field-types)")
    # Numbers of five digits and more with commas, as in prose.
    kind = re.sub(r"\b(\d{5,})(?:\.0)?\b", lambda number: f"{int(number[1]):,}", kind)
    plain = default in ("required", "left out", "all defaults")
    sentence = meaning[:1].upper() + meaning[1:] + ("" if meaning.endswith((".", ":")) else ".")
    return f"`{name}`", sentence, kind, "" if unit == "1" else unit, default if plain else f"`{default}`"


def _nested(inner: Structs) -> Iterator[str]:
    """Tables that stand inside of those that were shown, however deep."""
    shown: set[str] = set()
    while names := [name for name in inner if name not in shown]:
        shown.add(names[0])
        cls = inner[names[0]]
        yield from (f"## {cls.__name__}", "", markdown(prose(cls)), "", *_keys(cls, inner))
