"""The Python API: a page for each package, with its modules as sections."""

from __future__ import annotations

import ast
import importlib.util
import pkgutil
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, get_origin

import msgspec
from sphinx.ext.napoleon import GoogleDocstring

from caviar_protocol.spec import rows

from . import markdown

PACKAGES = (
    "caviar",
    "caviar_protocol",
    "caviar_space",
    "caviar_broker",
    "caviar_services",
    "caviar_bridges",
    "caviar_clients",
    "caviar_formats",
    "caviar_scenes",
    "caviar_labs",
)
"""Import packages; those that are not installed are left out."""

_HEAD = """\
Programs and notebooks begin with [caviar](caviar.rst): `run`, `open`, `dataset`. Agents, worlds, channels and
sensors of your own subclass the bases of [caviar_services](caviar_services.rst). The other pages have every
public module, from its docstrings; [CONTRIBUTING](../../../CONTRIBUTING.md) says where contributors begin.
"""


def pages() -> Iterator[tuple[str, str]]:
    """File name and text of each page."""
    installed = [name for name in PACKAGES if importlib.util.find_spec(name)]
    packages = {name: modules for top in installed for name, modules in _packages(top).items()}
    summaries = [(f"[{name}]({name}.rst)", _summary(name)) for name in sorted(packages)]
    lines = ["# Python API", "", _HEAD, *markdown.table(("package", ""), summaries)]
    yield "index.md", "\n".join([*lines, *markdown.toctree(installed, ":hidden:")])
    for name, modules in packages.items():
        inner = [other for other in packages if other.rpartition(".")[0] == name]
        yield f"{name}.rst", "\n".join(_package_lines(name, modules, inner))


def _packages(top: str) -> dict[str, list[str]]:
    """Packages below a top-level one by name, itself included, each with its public modules."""
    spec = importlib.util.find_spec(top)
    if spec is None or spec.submodule_search_locations is None:
        raise ModuleNotFoundError(top)
    found: dict[str, list[str]] = {top: []}
    # Names alone: importing every module would load ray tracer and SUMO before autodoc does.
    for module in pkgutil.walk_packages(spec.submodule_search_locations, f"{top}."):
        if any(part.startswith("_") for part in module.name.split(".")):
            continue
        if module.ispkg:
            found[module.name] = []
        else:
            found[module.name.rpartition(".")[0]].append(module.name)
    return found


def _package_lines(name: str, modules: list[str], inner: list[str]) -> Iterator[str]:
    yield from (name, "=" * len(name), "", f".. automodule:: {name}", "")
    if inner:
        yield from (".. toctree::", "   :maxdepth: 1", "", *(f"   {child}" for child in sorted(inner)), "")
    for module in sorted(modules):
        title = module.rpartition(".")[2]
        yield from (title, "-" * len(title), "", f".. automodule:: {module}", "")


def _summary(name: str) -> str:
    """The first line of the docstring of a package."""
    spec = importlib.util.find_spec(name)
    if spec is None or spec.origin is None:
        return ""
    docstring = ast.get_docstring(ast.parse(Path(spec.origin).read_text("utf-8"))) or ""
    return docstring.partition("\n\n")[0]


# --- handlers of autodoc's events -------------------------------------------------------------------


def hide_fields(app: Any, kind: str, name: str, member: Any, skip: bool, options: Any) -> bool | None:
    """Skip fields of structs, which `finish_docstring` tabulates, and types of fields, which SPEC.md has."""
    # autodoc says which kind of owner a member has, and not which one.
    document = app.env.current_document
    owner: Any = sys.modules.get(document.autodoc_module or "")
    for part in (document.autodoc_class or "").split(".") if kind == "class" else ():
        owner = getattr(owner, part, None)
    field = _is_struct(owner) and name in owner.__struct_fields__
    return True if field or get_origin(member) is Annotated else None


def shorten_bases(app: Any, name: str, member: Any, options: Any, bases: list[Any]) -> None:
    """Show base classes without type arguments, and none that is private."""
    # `Generic[P]` and the like have no page that a link could lead to.
    plain = [get_origin(base) or base for base in bases]
    bases[:] = [base for base in plain if not base.__name__.startswith("_")] or [object]


def hide_signature(app: Any, kind: str, name: str, member: Any, *_: Any) -> tuple[str, None] | None:
    """Show a struct without its signature, which would repeat the table of fields."""
    return ("", None) if _is_struct(member) else None


def finish_docstring(app: Any, kind: str, name: str, member: Any, options: Any, lines: list[str]) -> None:
    """Make reStructuredText of a docstring: sections of parameters, and the fields of a struct as a table."""
    text = list(_with_plain_characters(lines))
    if kind not in ("attribute", "data", "property"):  # there Napoleon reads «x: y» as a type
        text = GoogleDocstring(text, app.config, app, kind, name, member, options).lines()
    if _is_struct(member) and member.__struct_fields__:
        text += ["", *_field_table(member)]
    lines[:] = text


def _is_struct(value: Any) -> bool:
    return isinstance(value, type) and issubclass(value, msgspec.Struct)


def _field_table(cls: type[msgspec.Struct]) -> Iterator[str]:
    yield from (".. list-table::", "   :header-rows: 1", "   :widths: 20 22 8 14 36", "")
    cells = [("field", "type", "unit", "default", "meaning")]
    cells += [(f"``{name}``", kind, unit, default, text) for name, kind, unit, default, _, text in rows(cls)]
    for row in cells:
        for at, cell in enumerate(row):
            text = re.sub(r"\[([^\]]+)\]\(#[^)]+\)", r"\1", " ".join(cell.split()))  # links of SPEC.md
            yield ("     - " if at else "   * - ") + _escaped(text)
    yield ""


_MARKED = re.compile(r"(``.*?``|`[^`]*`|\*\*[^*]+\*\*|(?<![\w*])\*[^\s*](?:[^*]*[^\s*])?\*(?![\w*]))")
"""Code, bold words and emphasis."""


def _with_plain_characters(lines: list[str]) -> Iterator[str]:
    """Lines with stars and bars as characters; those of examples and literal blocks stay as they are."""
    literal = False
    for line in lines:
        example = line.lstrip().startswith((">>> ", "... "))
        literal = literal and (not line or line.startswith(" "))
        yield line if example or literal else _escaped(line)
        literal = literal or line.endswith("::")


def _escaped(line: str) -> str:
    """A line in which bars, and stars that are neither bullets nor emphasis, are what they look like."""
    bullet = re.match(r"\s*(\* )?", line)
    begin = bullet.end() if bullet else 0
    parts = _MARKED.split(line[begin:])
    parts[::2] = [re.sub(r"(?<!\\)([|*]|(?<=\w)_(?!\w))", r"\\\1", part) for part in parts[::2]]
    return line[:begin] + "".join(parts)
