"""What a user asks of a replay, and which services of the recorded run that names."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec

from caviar_protocol.errors import RunError, suggestion
from caviar_protocol.scenario import ServiceSpec
from caviar_protocol.scenario.toml import parse_toml


@dataclass(frozen=True, kw_only=True)
class Request:
    """Options of `caviar replay`; services by name."""

    replace: Mapping[str, str] = field(default_factory=dict)
    """Implementation in place of the recorded one."""
    settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Settings in place of the recorded ones, as nested tables of what was typed."""
    keep: frozenset[str] = frozenset()
    """Services that run again as recorded."""
    recorded: frozenset[str] = frozenset()
    """Services that are served as recorded, though what they take has changed."""
    again: bool = False
    """Whether everything runs again."""

    @property
    def changed(self) -> frozenset[str]:
        """Services that are not what they were."""
        return frozenset({*self.replace, *self.settings})


def request_of(
    services: Mapping[str, ServiceSpec],
    replace: Sequence[str] = (),
    settings: Sequence[str] = (),
    keep: Iterable[str] = (),
    recorded: Iterable[str] = (),
    again: bool = False,
) -> Request:
    """The options as given on the command line, with roles resolved to names.

    Raises `RunError` naming the option, what is wrong, and what there is.
    """
    found = Request(
        replace={
            service_named(services, name, f"--replace {text}"): use
            for text in replace
            for name, use in [_halves(text, "--replace", "channel=sionna-rt")]
        },
        settings=_settings(services, settings),
        keep=frozenset(service_named(services, name, f"--keep {name}") for name in keep),
        recorded=frozenset(service_named(services, name, f"--recorded {name}") for name in recorded),
        again=again,
    )
    for name in found.recorded & (found.keep | found.changed):
        raise RunError(f"{name!r} is to be served as recorded, and to run; leave out one of both")
    if again and (found.changed or found.recorded):
        raise RunError("--again runs everything as it was; leave it out, or --replace, --set and --recorded")
    return found


def service_named(services: Mapping[str, ServiceSpec], name: str, option: str) -> str:
    """The service of that name, or the only one of that role."""
    if name in services:
        return name
    of_role = [service for service, spec in services.items() if spec.role == name]
    if len(of_role) == 1:
        return of_role[0]
    if of_role:
        raise RunError(f"{option}: the recorded run has {len(of_role)} of role {name}: {', '.join(of_role)}")
    roles = {spec.role for spec in services.values()}
    hint = suggestion(name, {*services, *roles})
    raise RunError(f"{option}: the recorded run has no service {name!r}, and none of such a role; {hint}")


def _halves(text: str, option: str, example: str) -> tuple[str, str]:
    name, separator, value = text.partition("=")
    if not separator or not name.strip() or not value.strip():
        raise RunError(f"{option} {text}: write it as in {option} {example}")
    return name.strip(), value.strip()


def _settings(services: Mapping[str, ServiceSpec], texts: Sequence[str]) -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = {}
    for text in texts:
        example = "channel.rung=spherical"
        path, value = _halves(text, "--set", example)
        name, *keys = path.split(".")
        if not keys or not all(keys):
            raise RunError(f"--set {text}: write service and setting, as in --set {example}")
        table = found.setdefault(service_named(services, name, f"--set {text}"), {})
        for key in keys[:-1]:
            table = table.setdefault(key, {})
            if not isinstance(table, dict):
                raise RunError(f"--set {text}: {key!r} was given a value of its own before; leave out one")
        table[keys[-1]] = value
    return found


def _value(text: str) -> Any:
    """A value as TOML writes it; what is none is text."""
    try:
        return parse_toml(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def typed(changes: Mapping[str, Any], cls: type[msgspec.Struct]) -> dict[str, Any]:
    """What was typed, as TOML values, but where only text fits: ``1e3``, the name of a rung."""
    types = {field.encode_name: field.type for field in msgspec.structs.fields(cls)}
    return {key: _typed(value, types.get(key, Any)) for key, value in changes.items()}


def _typed(given: Any, expected: Any) -> Any:
    if isinstance(given, Mapping):
        return {key: _typed(value, Any) for key, value in given.items()}
    value = _value(given)
    return given if not _fits(value, expected) and _fits(given, expected) else value


def _fits(value: Any, expected: Any) -> bool:
    try:
        msgspec.convert(value, expected)
    except msgspec.ValidationError:
        return False
    return True


def merged(settings: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Settings with some replaced, tables within tables too."""
    found = dict(settings)
    for key, value in changes.items():
        known = found.get(key)
        both = isinstance(value, Mapping) and isinstance(known, Mapping)
        found[key] = merged(known, value) if both and known is not None else value
    return found
