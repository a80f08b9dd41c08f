"""With which code a run is made: what its results depend on, and what has changed since."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterator, Mapping
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import msgspec

from caviar_protocol.messages import PROTOCOL_VERSION
from caviar_protocol.scenario import Scenario
from caviar_protocol.scenario.conversion import Source

PACKAGES = ("caviar_protocol", "caviar_broker", "caviar_services")
"""Code that takes part in every run."""
LIBRARIES = ("numpy", "msgspec", "pyzmq", "mcap")
TRACING = ("sionna-rt", "mitsuba", "drjit")
TRAFFIC = ("libsumo", "eclipse-sumo")
ENTRY_POINTS = "caviar.services"
"""Group through which other distributions add services."""


def versions_of(scenario: Scenario) -> dict[str, str]:
    """Version of each part that the results of a scenario may depend on; of code and files a hash.

    Libraries for ray tracing and traffic count where a service that `caviar run` starts may use them.
    """
    read = msgspec.structs.replace(scenario, source=Source())  # a run goes on with what was read
    used = {spec.use for spec in scenario.services.values()}
    libraries = [*LIBRARIES]
    libraries += TRAFFIC if "sumo" in used else ()
    libraries += TRACING if used & _tracers() else ()
    found = {
        "python": platform.python_version(),
        "protocol": ".".join(map(str, PROTOCOL_VERSION)),
        "code": _hash_of(path for package in PACKAGES for path in _sources(package)),
    }
    found |= {name: _version(name) for name in libraries}
    for package in sorted({use.partition(".")[0].partition(":")[0] for use in used if ":" in use}):
        found[f"code of {package}"] = _hash_of(_sources(package))
    for point in metadata.entry_points(group=ENTRY_POINTS):
        if point.name.partition(":")[2] in used and point.dist is not None:
            found[point.dist.name] = point.dist.version
    for path in sorted(set(_files_in(msgspec.to_builtins(read)))):
        found[f"file {path}"] = _hash_of([path])
    return found


def changes(before: Mapping[str, str], now: Mapping[str, str]) -> str:
    """What is of another version than before; empty where nothing is."""
    return "; ".join(
        f"{name} {now.get(name, 'not used')} (was {before.get(name, 'not used')})"
        for name in sorted({*before, *now})
        if before.get(name) != now.get(name)
    )


def _tracers() -> frozenset[str]:
    """Implementations that import the ray tracer."""
    return frozenset({"sionna-rt", "adaptive", "lidar", "camera"})


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"


def _sources(package: str) -> Iterator[Path]:
    spec = find_spec(package)
    if spec is None:
        return  # a service that is not installed here does not start here
    for folder in spec.submodule_search_locations or ():
        yield from sorted(Path(folder).rglob("*.py"))
    if not spec.submodule_search_locations and spec.origin:
        yield Path(spec.origin)


def _hash_of(paths: Any) -> str:
    """A short hash of the contents of files."""
    h = hashlib.sha256()
    for path in paths:
        data = path.read_bytes()
        h.update(f"{path.name}\0{len(data)}\0".encode())
        h.update(data)
    return h.hexdigest()[:16]


def _files_in(value: Any) -> Iterator[Path]:
    """Files that a scenario names, with their absolute paths."""
    if isinstance(value, Mapping):
        value = list(value.values())
    if isinstance(value, list | tuple):
        for item in value:
            yield from _files_in(item)
    elif isinstance(value, str) and len(value) < 4096:
        path = Path(value.removeprefix("file:"))
        if path.is_absolute() and path.is_file():
            yield path
