"""Fields of all messages and payloads in a compact text, which client libraries carry in their sources.

    python clients/schema.py            print the text
    python clients/schema.py FILE …     replace it in sources, between «schema: begin» and «schema: end»

Each line is a struct: its name, with ``:TAG`` where a field ``type`` says which it is, then ``field:type`` or
``field:type=default`` in the order of the wire, ``?`` for a field without a value. Types are

    i  i0  i0..64    integer, from, to       f  f0  f<0    float, from, above
    s  s1..128       text, with a length     n  p  d  D    new name, path of an asset, digest, digest or empty
    b  *             true or false; any      e(a,b)        one of these words
    l(T)  l256(T)    list, of at most        t3(T)         list of just so many
    m(T)             map of strings to T     S  S/T        struct, or one of them by its tag
    a(<f8,N,3)       array of elements, sizes and names of sizes

A line that begins with ``=`` names the size of lists: ``=Scene N:names,classes,assets``.
"""

from __future__ import annotations

import json
import sys
from enum import Enum
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import msgspec

from caviar_protocol.arrays import ArrayField
from caviar_protocol.fields import MAX_INTEGER
from caviar_protocol.spec import classes
from caviar_protocol.topics import PAYLOADS

BEGIN, END = "schema: begin", "schema: end"


def schema() -> str:
    """All structs that may stand on the wire, a line each, and the topics."""
    lines = [_struct(cls) for cls in classes().values()]
    for cls in classes().values():
        for size, lists in getattr(cls, "sizes_from", {}).items():
            lines.append(f"={cls.__name__} {size}:{','.join(lists)}")
    lines.append("@topics " + " ".join(f"{topic}:{cls.__name__}" for topic, cls in PAYLOADS.items()))
    return "\n".join(lines) + "\n"


def _struct(cls: type[msgspec.Struct]) -> str:
    hints, config = get_type_hints(cls, include_extras=True), cls.__struct_config__
    name = f"{cls.__name__}:{config.tag}" if config.tag_field else cls.__name__
    found = [
        f"{field.name}:{_type(hints[field.name])}{_default(field)}" for field in msgspec.structs.fields(cls)
    ]
    return " ".join([name, *found])


def _type(hint: Any, metas: tuple[msgspec.Meta, ...] = ()) -> str:
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _type(arguments[0], (*arguments[1:], *metas))
    for meta in metas:
        if meta.extra and "array" in meta.extra:
            spec: ArrayField = meta.extra["array"]
            return f"a({','.join([spec.dtype, *map(str, spec.shape)])})"
    if origin in (Union, UnionType):
        members = [member for member in arguments if member is not NoneType]
        return (
            _type(members[0], metas) if len(members) == 1 else "/".join(_type(member) for member in members)
        )
    if origin is Literal:
        return f"e({','.join(map(str, arguments))})"
    if origin is tuple and arguments[1:] == (...,):
        most = next((str(meta.max_length) for meta in metas if meta.max_length is not None), "")
        return f"l{most}({_type(arguments[0])})"
    if origin is tuple:
        return f"t{len(arguments)}({_type(arguments[0])})"
    if origin is dict:
        return f"m({_type(arguments[1])})"
    if hint is Any:
        return "*"
    if issubclass(hint, Enum):
        return f"e({','.join(member.value for member in hint)})"
    if issubclass(hint, msgspec.Struct):
        return str(hint.__name__)
    return _scalar(hint, metas)


def _scalar(hint: type, metas: tuple[msgspec.Meta, ...]) -> str:
    def bound(name: str) -> Any:
        return next((getattr(meta, name) for meta in metas if getattr(meta, name) is not None), None)

    if hint is bool:
        return "b"
    if hint is float:
        if bound("gt") is not None:
            return f"f<{bound('gt'):g}"
        return "f" if bound("ge") is None else f"f{bound('ge'):g}"
    if hint is int:
        low, high = bound("ge"), bound("le")
        text = "" if low is None or low == -MAX_INTEGER else str(low)
        return f"i{text}" + ("" if high is None or high == MAX_INTEGER else f"..{high}")
    # The three patterns of `caviar_protocol.fields`, each by a letter of its own.
    pattern, longest = bound("pattern"), bound("max_length")
    if pattern is not None and longest == 64:
        return "D" if "?" in pattern else "d"
    if pattern is not None:
        return "n" if longest == 128 else "p"
    return "s" if longest is None else f"s{bound('min_length') or 0}..{longest}"


def _default(field: msgspec.structs.FieldInfo) -> str:
    if field.required:
        return ""
    value = field.default if field.default_factory is msgspec.NODEFAULT else field.default_factory()
    if value is None:
        return "=?"
    if isinstance(value, msgspec.Struct):
        return "={}"
    # Single quotes need no escape in a string of another language.
    text = json.dumps(list(value) if isinstance(value, tuple) else value, separators=(",", ":"))
    return "=" + text.replace('"', "'")


def replaced(source: str) -> str:
    """A source with the schema of today between its markers."""
    before, rest = source.split(BEGIN, 1)
    end_line = rest.split(END, 1)
    return f"{before}{BEGIN}\n{schema()}{end_line[0].rsplit(chr(10), 1)[1]}{END}{end_line[1]}"


def main(paths: list[str]) -> None:
    """Print the schema, or write it into sources."""
    if not paths:
        sys.stdout.write(schema())
    for path in map(Path, paths):
        path.write_text(replaced(path.read_text("utf-8")), "utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
