"""Provenance of a run beside its scenario: versions of packages, and code of classes that are not ours.

A package counts where a service of the scenario computes with it (`Service.packages`): what else is installed
changes neither a product nor a reproducible recording. CAVIAR itself counts by its version.

Of a class that a scenario names ``module:Class``, or that another distribution registers, the source counts:
that of its module, and of all modules that this imports, and these in turn, as long as no other distribution
brings them. What other distributions bring of it counts by their versions. Code that is loaded in other ways
than ``import`` is not seen.
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
from caviar_protocol.plugins import plugins
from caviar_protocol.scenario.schema import REMOTE
from caviar_services.registry import BUILT_IN, load, registered
from caviar_services.world.quadrotor.airframe import PLANTS, plant_named

ALWAYS = (DISTRIBUTION, "msgspec", "numpy")
"""Distributions that every run computes with."""
OWN = frozenset(
    f"caviar{name}"
    for name in (
        "",
        "_bridges",
        "_broker",
        "_clients",
        "_formats",
        "_labs",
        "_protocol",
        "_scenarios",
        "_services",
        "_space",
    )
)
"""Packages of this distribution."""
_BY_SETTING: Mapping[tuple[str, str], tuple[str, ...]] = {
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
            if key == "engine" and value in plugins(PLANTS):
                names.update(plant_named(value).packages)
    # Distributions of which modules, or what they import, import something.
    imported = {
        _top(name)
        for module in _own_modules(scenario)
        for source, file in _sources(module).items()
        for name in _imports(source, file)
    }
    known = _distributions() if imported else {}
    return _versions({*names, *(distribution for name in imported for distribution in known.get(name, ()))})


def code_digests(scenario: Mapping[str, Any]) -> dict[str, str]:
    """SHA-256 of the source of each class of a scenario that is none of this distribution.

    Args:
        scenario: As resolved, as plain values.

    Returns:
        Digest by name of the module; one that is not here, or has no source, is left out.

    Example:
        >>> code_digests({"services": {"agent": {"role": "agent", "use": "random", "settings": {}}}})
        {}
    """
    found = {}
    for module in _own_modules(scenario):
        digest = hashlib.sha256()
        for name, file in sorted(_sources(module).items()):
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


_version = cache(metadata.version)


def _versions(names: Iterable[str]) -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in names:
        try:
            found[name] = _version(name)
        except metadata.PackageNotFoundError:
            continue
    return dict(sorted(found.items()))


# --- code that is not ours -------------------------------------------------------------------------------


def _own_modules(scenario: Mapping[str, Any]) -> list[str]:
    """Modules of classes that are none of this distribution, in order."""
    found = set[str]()
    for role, use, settings in _services(scenario):
        engines = {value for key, value in _texts(settings) if key == "engine"}
        found.update(plugins(PLANTS)[name].module for name in engines if name in plugins(PLANTS))
        if f"{role}:{use}" not in BUILT_IN:
            target = use if ":" in use else registered().get(f"{role}:{use}", "")
            found.add(target.partition(":")[0])
    return sorted(name for name in found if name and _top(name) not in OWN)


def _sources(module: str) -> dict[str, Path]:
    """File of a module, and of what it imports that no distribution brings, by the names of the modules."""
    found: dict[str, Path] = {}
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name in found or (file := _file_of(name)) is None:
            continue
        if not {"site-packages", "dist-packages"}.isdisjoint(file.parts) and _top(name) != _top(module):
            continue
        found[name] = file
        waiting += _imports(name, file)
        # The packages that are imported with a module: ``a`` and ``a.b`` of ``a.b.c``.
        parts = name.split(".")
        waiting += [".".join(parts[:count]) for count in range(1, len(parts))]
    return found


def _file_of(module: str) -> Path | None:
    """The source of a module; None where Python does not find it, or it has none. Nothing is imported."""
    loaded = getattr(sys.modules.get(module), "__file__", None)
    if loaded:
        return Path(loaded) if loaded.endswith(".py") else None
    try:
        spec = importlib.util.find_spec(_top(module))
    except (ImportError, ValueError):  # a module without a spec, as __main__
        return None
    if spec is None:
        return None
    if spec.submodule_search_locations is None:
        places = [Path(spec.origin)] if spec.origin and module == _top(module) else []
    else:
        _, *rest = module.split(".")
        inside = [Path(folder, *rest) for folder in spec.submodule_search_locations]
        places = [place for path in inside for place in (path / "__init__.py", path.with_suffix(".py"))]
    return next((place for place in places if place.suffix == ".py" and place.is_file()), None)


def _imports(module: str, file: Path) -> set[str]:
    """Modules that a source imports anywhere, without those of Python and of CAVIAR.

    Of ``from a import b`` both ``a`` and ``a.b``, which is perhaps a module.
    """
    try:
        tree = ast.parse(file.read_bytes())
    except (SyntaxError, ValueError):  # Python says so where it is imported
        return set()
    package = module.split(".") if file.name == "__init__.py" else module.split(".")[:-1]
    found = set[str]()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            found.update((base, *(f"{base}.{alias.name}" for alias in node.names)))
    return {name for name in found if _top(name) not in sys.stdlib_module_names | OWN | {""}}


# Once a process: it reads the lists of files of everything that is installed.
@cache
def _distributions() -> Mapping[str, list[str]]:
    return metadata.packages_distributions()


def _top(module: str) -> str:
    return module.partition(".")[0]
