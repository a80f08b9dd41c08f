"""What a run follows from beside its scenario: versions of packages, and code of classes that are not ours.

A package counts where a service of the scenario computes with it (`Service.packages`): what else is installed
changes neither a product nor a reproducible recording. CAVIAR itself counts by its version.

Of a class that a scenario names ``module:Class``, or that another distribution registers, the source counts:
its module or all ``.py`` files of its package, and likewise what they import that no distribution brings.
What distributions bring of it counts by their versions. Code that is loaded in other ways than ``import`` is
not seen.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import platform
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from caviar_protocol.host import DISTRIBUTION
from caviar_protocol.scenario.schema import REMOTE
from caviar_services.registry import BUILT_IN, load, registered

ALWAYS = (DISTRIBUTION, "msgspec", "numpy")
"""Distributions that every run computes with."""
OWN = frozenset(
    ("caviar", "caviar_broker", "caviar_clients", "caviar_protocol", "caviar_scenarios", "caviar_services")
)
"""Packages of this distribution."""
_BY_SETTING: Mapping[tuple[str, str], tuple[str, ...]] = {
    ("engine", "mujoco"): ("mujoco",),
    ("rate_model", "nr"): ("sionna", "torch"),
}
_BUNDLED = "sionna:"


@cache
def installed_versions() -> dict[str, str]:
    """Versions of Python, of this distribution, and of its dependencies that are installed.

    Example:
        >>> installed_versions()["python"] == platform.python_version()
        True
    """
    try:
        requirements = [DISTRIBUTION, *(metadata.requires(DISTRIBUTION) or ())]
    except metadata.PackageNotFoundError:
        requirements = []
    # Tools of developers take no part in a run.
    named = [line for line in requirements if not line.endswith(('extra == "dev"', "extra == 'dev'"))]
    return _versions(re.split(r"[^A-Za-z0-9._-]", line, maxsplit=1)[0] for line in named)


def used_versions(scenario: Mapping[str, Any]) -> dict[str, str]:
    """Versions of Python and of the packages that the services of a scenario compute with.

    Args:
        scenario: As resolved, as plain values; remote services do not count.

    Raises:
        DeclarationError: A class is not here.

    Example:
        >>> service = {"role": "recorder", "use": "mcap", "settings": {}}
        >>> sorted(used_versions({"services": {"recorder": service}}).keys() - {"caviar-sim"})
        ['lz4', 'mcap', 'msgspec', 'numpy', 'python', 'zstandard']
    """
    names = {*ALWAYS}
    for role, use, settings in _services(scenario):
        names.update(load(role, use).packages)
        for key, value in _texts(settings):
            names.update(_BY_SETTING.get((key, value), ()))
            if key == "scenery" and value.startswith(_BUNDLED):
                names.add("sionna-rt")
    return _versions([*names, *_imported_distributions(_own_modules(scenario))])


def code_digests(scenario: Mapping[str, Any]) -> dict[str, str]:
    """SHA-256 of the source of each class of a scenario that is none of this distribution.

    Args:
        scenario: As resolved, as plain values.

    Returns:
        Digest by name of the top-level module or package; one that is not here, or has no source, is left
        out.

    Example:
        >>> code_digests({"services": {"agent": {"role": "agent", "use": "random", "settings": {}}}})
        {}
    """
    found = {}
    for module in _own_modules(scenario):
        digest = hashlib.sha256()
        for name, file in _sources(module):
            data = file.read_bytes()
            # Name and length go in, too: code that moves from one file to the next is other code.
            digest.update(f"{name}\0{len(data)}\0".encode())
            digest.update(data)
            found[module] = digest.hexdigest()
    return found


def _services(scenario: Mapping[str, Any]) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """Role, implementation and settings of each service, and of the models that an adaptive channel has."""
    for spec in scenario.get("services", {}).values():
        if spec.get("use", REMOTE) == REMOTE:
            continue
        settings = spec.get("settings", {})
        yield spec["role"], spec["use"], settings
        for rung in (*settings.get("ladder", ()), settings.get("reference")):
            if isinstance(rung, Mapping):
                yield "channel", rung.get("use", "sionna-rt"), rung.get("settings", {})


def _texts(value: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """Each text in settings, with its key."""
    if isinstance(value, str):
        yield key, value
    elif isinstance(value, Mapping):
        for name, item in value.items():
            yield from _texts(item, name)
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _texts(item, key)


def _versions(names: Iterable[str]) -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in names:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return dict(sorted(found.items()))


# --- code that is not ours -------------------------------------------------------------------------------


def _own_modules(scenario: Mapping[str, Any]) -> list[str]:
    """Top-level modules of classes that are none of this distribution, in order."""
    found = set()
    for role, use, _ in _services(scenario):
        if f"{role}:{use}" not in BUILT_IN:
            target = use if ":" in use else registered().get(f"{role}:{use}", "")
            found.add(target.partition(":")[0].partition(".")[0])
    return sorted(found - OWN - {""})


def _sources(module: str) -> list[tuple[str, Path]]:
    """Name and file of the source of a module, and of what it imports that no distribution brings."""
    found: dict[str, Path] = {}
    waiting, seen = [module], {module}
    while waiting:
        for name, file in _files_of(waiting.pop()):
            found[name] = file
            for imported in sorted(_imports(file) - seen):
                seen.add(imported)
                if not _distributions(imported):
                    waiting.append(imported)
    return sorted(found.items())


def _files_of(module: str) -> Iterator[tuple[str, Path]]:
    """The ``.py`` files of a top-level module or package, by name; none where Python does not find it."""
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):  # a module without a spec, as __main__
        spec = None
    if spec is None:
        return
    for folder in spec.submodule_search_locations or ():
        for file in Path(folder).rglob("*.py"):
            yield f"{module}/{file.relative_to(folder).as_posix()}", file
    if not spec.submodule_search_locations and spec.origin and Path(spec.origin).is_file():
        yield Path(spec.origin).name, Path(spec.origin)


def _imports(file: Path) -> set[str]:
    """Top-level modules that a source imports anywhere, without those of Python and of CAVIAR."""
    try:
        tree = ast.parse(file.read_bytes())
    except (SyntaxError, ValueError):  # a file of a package that is never imported, or a compiled module
        return set()
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found.update(alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found.add(node.module.partition(".")[0])
    return found - sys.stdlib_module_names - OWN


def _imported_distributions(modules: Iterable[str]) -> set[str]:
    """Distributions of which modules, or what they import, import something."""
    imported = {name for module in modules for _, file in _sources(module) for name in _imports(file)}
    return {distribution for name in imported for distribution in _distributions(name)}


def _distributions(module: str) -> tuple[str, ...]:
    """Names of the distributions that bring a top-level module."""
    return tuple(sorted(set(_all_distributions().get(module, ()))))


# Once a process: it reads the lists of files of everything that is installed.
@cache
def _all_distributions() -> Mapping[str, list[str]]:
    return metadata.packages_distributions()
