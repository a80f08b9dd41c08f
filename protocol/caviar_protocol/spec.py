"""Generator of the tables and byte examples in SPEC.md, from the types and the vectors.

``python -m caviar_protocol.spec protocol/SPEC.md`` replaces what stands between markers such as
``<!-- fields: Grant -->`` and ``<!-- end -->``; a test holds that nothing else would come out.
"""

from __future__ import annotations

import ast
import inspect
import re
import sys
import textwrap
from collections.abc import Iterable, Sequence
from enum import Enum
from functools import cache
from itertools import pairwise
from pathlib import Path
from types import ModuleType, NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import msgspec
import numpy as np

from caviar_protocol import arrays, fields, messages, topics
from caviar_protocol.arrays import WIRE_DTYPES, ArrayField
from caviar_protocol.fields import PARTS_SINCE, SINCE, VALUES_SINCE
from caviar_protocol.topics import PARTS

_MARKER = re.compile(r"(<!-- (\w+)(?:: ([\w ]+))? -->\n).*?(<!-- end -->)", re.DOTALL)


def render(text: str, vectors: Path) -> str:
    """SPEC.md with every generated block made anew."""
    # Blocks are found by their markers: text between them is written by hand and stays.
    makers = {"fields": _fields_block, "types": _types_block, "limits": _limits_block,
              "elements": _elements_block, "parts": _parts_block}  # fmt: skip

    def block(match: re.Match[str]) -> str:
        kind, argument = match[2], match[3] or ""
        content = _bytes_block(argument, vectors) if kind == "bytes" else makers[kind](argument)
        return f"{match[1]}{content}\n{match[4]}"

    return _MARKER.sub(block, text)


# --- tables -----------------------------------------------------------------------------------------


def rows(cls: type[msgspec.Struct]) -> list[tuple[str, str, str, str, str, str]]:
    """(field, type, unit, default, since, meaning) of every field of a class, in wire order."""
    # `msgspec.structs.fields` gives types without annotations, in which units and meanings stand.
    hints, docs = get_type_hints(cls, include_extras=True), _attribute_docs(cls)
    found = []
    tag = cls.__struct_config__
    since = SINCE.get(cls.__name__, "1.0")
    if tag.tag_field:
        found.append((tag.tag_field, f'`"{tag.tag}"`', "", "required", since, "which of its kind this is"))
    for field in msgspec.structs.fields(cls):
        hint = hints[field.name]
        found.append(
            (
                field.name,
                type_text(hint) + _later_values(f"{cls.__name__}.{field.name}"),
                unit_of(hint),
                _default_text(field),
                SINCE.get(f"{cls.__name__}.{field.name}", since),
                docs.get(field.name) or _description(hint),
            )
        )
    return found


def _later_values(field: str) -> str:
    """Values of a closed field that a later minor version brought."""
    later = VALUES_SINCE.get(field, {})
    found = [
        ", ".join(f"`{value}`" for value, of in later.items() if of == since) + f" since {since}"
        for since in sorted(set(later.values()))
    ]
    return f" ({'; '.join(found)})" if found else ""


def type_text(hint: Any) -> str:
    """A type hint in words."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        base, *metas = get_args(hint)
        # By identity: two types may have equal bounds and mean different things.
        for meta in metas:
            if id(meta) in _aliases():
                name = _aliases()[id(meta)]
                rest = [other for other in metas if other is not meta]
                return f"[{name}](#field-types)" + "".join(f", {text}" for text in _bounds_text(rest))
        for meta in metas:
            if isinstance(meta, msgspec.Meta) and meta.extra and "array" in meta.extra:
                spec: ArrayField = meta.extra["array"]
                return f"array `{spec.dtype}` [{', '.join(map(str, spec.shape))}]"
        return ", ".join([type_text(base), *_bounds_text(metas)])
    if origin in (Union, UnionType):
        return " or ".join(type_text(member) for member in arguments if member is not NoneType)
    if origin is Literal:
        return ", ".join(f"`{value}`" if value != "" else "empty" for value in arguments)
    if origin is tuple and arguments[1:] == (...,):
        return f"list of {type_text(arguments[0])}"
    if origin is tuple:
        return f"list of {len(arguments)} {type_text(arguments[0])}"
    if origin is dict:
        return f"map, {type_text(arguments[0])} to {type_text(arguments[1])}"
    if hint is Any:
        return "plain value"
    if not isinstance(hint, type) or origin is not None:
        return re.sub(r"\b[a-z_]+\.(?=\w)", "", str(hint))
    if issubclass(hint, Enum):
        return ", ".join(f"`{member.value}`" for member in hint)
    if issubclass(hint, msgspec.Struct):
        return f"[{hint.__name__}](#{hint.__name__.lower()})"
    return str(hint.__name__)


def _bounds_text(metas: list[Any]) -> list[str]:
    found = []
    for meta in metas:
        # Bounds of 64 bits hold for every integer, and SPEC.md says so once.
        if meta.ge is not None and meta.ge != -fields.MAX_INTEGER:
            found.append(f"≥ {meta.ge}")
        if meta.gt is not None:
            found.append(f"> {meta.gt}")
        if meta.le is not None and meta.le != fields.MAX_INTEGER:
            found.append(f"≤ {meta.le}")
        if meta.max_length is not None:
            found.append(f"{meta.min_length or 0} to {meta.max_length} of them")
    return found


def unit_of(hint: Any) -> str:
    """Unit of a type hint's numbers; empty where there is none."""
    if get_origin(hint) is Annotated:
        for meta in reversed(get_args(hint)[1:]):
            if meta.extra and "unit" in meta.extra:
                return str(meta.extra["unit"])
        return unit_of(get_args(hint)[0])
    units = [unit_of(argument) for argument in get_args(hint) if argument is not ...]
    return next((unit for unit in units if unit), "")


def _description(hint: Any) -> str:
    if get_origin(hint) is Annotated:
        for meta in reversed(get_args(hint)[1:]):
            if meta.description:
                return str(meta.description)
        return _description(get_args(hint)[0])
    return next((text for text in map(_description, get_args(hint)) if text), "")


def _default_text(field: msgspec.structs.FieldInfo) -> str:
    if field.required:
        return "required"
    # Empty maps and lists have a factory, since they could be changed.
    value = field.default if field.default_factory is msgspec.NODEFAULT else field.default_factory()
    if value is None:
        return "left out"
    if isinstance(value, msgspec.Struct):
        return "all defaults"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    return str(list(value)) if isinstance(value, tuple) else str(value)


def _fields_block(name: str) -> str:
    cls = classes()[name]
    fields_table = table(("field", "type", "unit", "default", "since", "meaning"), rows(cls))
    return f"{markdown(prose(cls))}\n\n{fields_table}"


def prose(cls: type) -> str:
    """The docstring of a class up to its sections: what is written for users of Python stays out of pages.

    Args:
        cls: The class.
    """
    return re.split(r"\n\n(?:Args|Raises|Example):\n", inspect.getdoc(cls) or "", maxsplit=1)[0]


def _types_block(_: str) -> str:
    found = []
    for module in (fields, arrays):
        docs = _module_docs(module)
        for name, hint in vars(module).items():
            if get_origin(hint) is Annotated and hint.__metadata__ and id(hint.__metadata__[0]) in _aliases():
                meta = hint.__metadata__[0]
                kind = ", ".join([type_text(get_args(hint)[0]), *_shared_bounds(meta)])
                extra = docs.get(name, "")
                meaning = meta.description + (f". {extra}" if extra else "")
                found.append((name, kind, unit_of(hint), meaning))
    return table(("type", "is", "unit", "meaning"), found)


def _shared_bounds(meta: msgspec.Meta) -> list[str]:
    if meta.max_length is not None:
        return [f"{meta.min_length or 0} to {meta.max_length} characters"]
    return _bounds_text([meta])


def _limits_block(_: str) -> str:
    limits = {name: text for name, text in _module_docs(fields).items() if name.startswith("MAX_")}
    # A bound of every integer field, which stands in the sentence on integers.
    del limits["MAX_INTEGER"]
    found = [(name, f"{getattr(fields, name):,}", text) for name, text in limits.items()]
    return table(("limit", "value", "of what"), found)


def _elements_block(_: str) -> str:
    found = [(f"`{code}`", dtype.name, str(dtype.itemsize)) for code, dtype in WIRE_DTYPES.items()]
    return table(("dtype", "element", "bytes"), found)


def _parts_block(_: str) -> str:
    found = [
        (topic, f"`{part}`", PARTS_SINCE.get(f"{topic}.{part}", "1.0"))
        for topic, parts in PARTS.items()
        for part in parts
    ]
    return table(("topic", "part", "since"), found)


def _bytes_block(name: str, vectors: Path) -> str:
    data = (vectors / name).with_suffix(".msgpack").read_bytes()
    lines = [f"header, {len(data)} bytes", *_hex(data)]
    body = (vectors / name).with_suffix(".body")
    if body.exists():
        content = body.read_bytes()
        lines += ["", f"body, {len(content)} bytes", *_hex(content)]
    return "```\n" + "\n".join(lines) + "\n```"


def _hex(data: bytes) -> list[str]:
    found = []
    for start in range(0, len(data), 16):
        chunk = data[start : start + 16]
        text = "".join(chr(byte) if 32 <= byte < 127 else "." for byte in chunk)
        found.append(f"{start:04x}  {chunk.hex(' '):47}  {text}")
    return found


def table(head: Sequence[str], body: Iterable[Sequence[str]]) -> str:
    """A table in Markdown; cells may have the markup of docstrings.

    Args:
        head: Titles of the columns.
        body: Cells of each row.

    Example:
        >>> print(table(("key", "unit"), [("``frames``", "frame")]))
        | key | unit |
        | --- | --- |
        | `frames` | frame |
    """
    lines = [head, ["---"] * len(head), *body]
    return "\n".join("| " + " | ".join(_cell(cell) for cell in line) + " |" for line in lines)


def _cell(text: str) -> str:
    return markdown(" ".join(text.split())).replace("|", "\\|")


def markdown(text: str) -> str:
    """Docstring markup as Markdown.

    Args:
        text: Of a docstring.
    """
    return re.sub(r"``([^`]+)``", r"`\1`", text)


# --- where names and words come from ------------------------------------------------------------------


@cache
def classes() -> dict[str, type[msgspec.Struct]]:
    """Every struct that may stand on the wire, by name, those inside others too."""
    return {cls.__name__: cls for cls in structs_below([messages.Message, *topics.PAYLOADS.values()])}


def structs_below(hints: Iterable[Any]) -> list[type[msgspec.Struct]]:
    """Structs that type hints name, and those of their fields, however deep.

    Args:
        hints: Structs, or types of fields.

    Returns:
        Each once, after those that hold it.

    Example:
        >>> [cls.__name__ for cls in structs_below([tuple[topics.ChannelMatrix, ...] | None, topics.Camera])]
        ['Camera', 'ChannelMatrix', 'CameraImage', 'Intrinsics']
    """
    found: dict[type[msgspec.Struct], None] = {}
    queue = list(hints)
    while queue:
        hint = queue.pop(0)
        if not (isinstance(hint, type) and issubclass(hint, msgspec.Struct)):
            queue += get_args(hint)
        elif hint not in found:
            found[hint] = None
            queue += [field.type for field in msgspec.structs.fields(hint)]
    return list(found)


@cache
def _aliases() -> dict[int, str]:
    """Name of each shared field type, by the identity of its annotation."""
    found = {}
    for module in (arrays, fields):
        for name, value in vars(module).items():
            if get_origin(value) is Annotated and get_args(value)[0] is not np.ndarray:
                found[id(value.__metadata__[0])] = name
    return found


@cache
def _attribute_docs(cls: type) -> dict[str, str]:
    """Docstrings below the fields of a class and of its bases."""
    found: dict[str, str] = {}
    # A class may say more about a field than its base; the last one wins.
    for base in reversed(cls.__mro__):
        if base.__module__.startswith("caviar_"):
            # Python keeps no docstrings of attributes; the source has them.
            node = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0]
            if isinstance(node, ast.ClassDef):
                found |= _docs_in(node.body)
    return found


def _module_docs(module: ModuleType) -> dict[str, str]:
    return _docs_in(ast.parse(inspect.getsource(module)).body)


def _docs_in(body: list[ast.stmt]) -> dict[str, str]:
    """Text of the string that follows each assignment."""
    found = {}
    for statement, following in pairwise(body):
        target = getattr(statement, "target", None) or next(iter(getattr(statement, "targets", [])), None)
        if not isinstance(target, ast.Name) or not isinstance(following, ast.Expr):
            continue
        if isinstance(following.value, ast.Constant) and isinstance(following.value.value, str):
            found[target.id] = inspect.cleandoc(following.value.value)
    return found


def main(path: Path) -> None:
    """Rewrite the generated blocks of a SPEC.md that has the vectors beside it."""
    path.write_text(render(path.read_text("utf-8"), path.parent / "vectors"), "utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
