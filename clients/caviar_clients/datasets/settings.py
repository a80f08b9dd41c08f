"""Settings of a dataset: what its catalogue has to hold of them, their digest, and in what two differ.

They are JSON in a database that comes from anywhere. Of a scenario only what readers, `verify` and `look` use
is looked at, so that datasets of other versions, with more keys or fewer, can be read.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping
from typing import Annotated, Any

import msgspec
from msgspec import Meta

FORMAT = 1
"""Version of the layout of a dataset: of its catalogue, its files and its settings."""

SHOWN = 8
"""Differences that an error names."""
_VALUE_CHARACTERS = 60
_ABSENT = object()

_Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
_Small = Annotated[int, Meta(ge=0, le=2**24)]


class _Run(msgspec.Struct, frozen=True):
    frames: Annotated[int, Meta(ge=1, le=2**63 - 1)]
    sampling_period_ns: _Count
    name: str = ""
    seed: _Count = 0
    instants_s: tuple[float, ...] = ()
    record: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        are_finite = all(map(math.isfinite, self.instants_s))
        if self.instants_s and (len(self.instants_s) < self.frames or not are_finite):
            raise ValueError(f"instants_s has {len(self.instants_s)} instants for {self.frames} scenes")


class _Carrier(msgspec.Struct, frozen=True):
    name: str = ""
    frequency_hz: Annotated[float, Meta(gt=0)] = 1.0
    bandwidth_hz: Annotated[float, Meta(gt=0)] = 1.0


class _Array(msgspec.Struct, frozen=True):
    rows: _Small = 1
    columns: _Small = 1


class _Device(msgspec.Struct, frozen=True):
    name: str = ""
    kind: str = ""
    role: str = ""
    on: str | None = None
    array: _Array | None = None
    power_dbm: float = 0.0
    size_px: tuple[_Small, _Small] = (0, 0)
    field_of_view_deg: float = 0.0
    range_m: tuple[float, float] = (0.0, 0.0)
    beams: _Small = 0
    azimuth_steps: _Small = 0
    count: _Count = 1


class _Box(msgspec.Struct, frozen=True):
    minimum_m: tuple[float, float, float]
    maximum_m: tuple[float, float, float]


class _ServiceSettings(msgspec.Struct, frozen=True):
    obstacles: tuple[_Box, ...] = ()


class _Service(msgspec.Struct, frozen=True):
    role: str = ""
    use: str = ""
    settings: _ServiceSettings = _ServiceSettings()


class _Scenario(msgspec.Struct, frozen=True):
    run: _Run
    services: dict[str, _Service]
    carriers: tuple[_Carrier, ...] = ()
    devices: tuple[_Device, ...] = ()


class _Settings(msgspec.Struct, frozen=True):
    """Settings of a dataset as far as its readers rely on them, whatever else they have."""

    format: int
    scenario: _Scenario
    files: dict[str, str]
    versions: dict[str, str]
    device: str


def check_settings(settings: Mapping[str, Any]) -> None:
    """Check that settings have what readers of a dataset rely on.

    Args:
        settings: Of a catalogue.

    Raises:
        msgspec.ValidationError: They have not; names the key.
    """
    msgspec.convert(settings, _Settings)


def fingerprint(settings: Mapping[str, Any]) -> str:
    """Digest of the settings of a dataset; the number of its episodes is none of them.

    Args:
        settings: Of `plan.DatasetPlan.settings`.

    Example:
        >>> fingerprint({"device": "llvm"}) == fingerprint({"device": "cuda"})
        False
    """
    return hashlib.sha256(msgspec.json.encode(settings, order="sorted")).hexdigest()


def differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> Iterator[str]:
    """Keys of the settings in which two datasets differ, each with both values; the scenario's name first.

    Args:
        before: Settings of one (`plan.DatasetPlan.settings`).
        now: Settings of the other.

    Example:
        >>> before = {"scenario": {"carriers": [{"frequency_hz": 28e9}]}, "code": {"my_agent": "1a"}}
        >>> now = {"scenario": {"carriers": [{"frequency_hz": 60e9}]}, "code": {"my_agent": "2b"}}
        >>> for text in differences(before, now):
        ...     print(text)
        carriers[0].frequency_hz was 28e9, is 60e9
        my_agent.py, or a module that it imports, has changed
    """
    scenarios = before.get("scenario", {}), now.get("scenario", {})
    yield from sorted(_differences("", *scenarios), key=_rank)
    for name, was, this in _changed(before.get("code", {}), now.get("code", {})):
        yield f"{name.replace('.', '/')}.py, or a module that it imports, {_of_digest(was, this)}"
    for name, was, this in _changed(before.get("files", {}), now.get("files", {})):
        yield f"{name} {_of_digest(was, this)}"
    for key in dict.fromkeys((*before, *now)):
        if key not in ("scenario", "code", "files"):
            yield from _differences(key, before.get(key, _ABSENT), now.get(key, _ABSENT))


def refusal(what: str, before: Mapping[str, Any], now: Mapping[str, Any], otherwise: str = "") -> str:
    """Say that something is of another dataset, and what the user may do.

    Args:
        what: Begins the text: ``d holds another dataset``.
        before: Settings of the one that is there.
        now: Settings of the other.
        otherwise: What differs where no setting does.

    Returns:
        One line, or one for each of the first `SHOWN` keys; empty where nothing differs.
    """
    texts = list(differences(before, now)) or [otherwise]
    remedy = "give another --out (--overwrite deletes the dataset that is there, with all its episodes)"
    if len(texts) == 1:
        return f"{what}: {texts[0]}; {remedy}" if texts[0] else ""
    more = [f"and {len(texts) - SHOWN} more"] if len(texts) > SHOWN else []
    return "\n  ".join([f"{what}:", *texts[:SHOWN], *more]) + f"\n{remedy}"


def _differences(key: str, before: Any, now: Any) -> Iterator[str]:
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        for name, was, this in _changed(before, now):
            yield from _differences(f"{key}.{name}" if key else name, was, this)
    elif isinstance(before, list | tuple) and isinstance(now, list | tuple):
        yield from _list_differences(key, before, now)
    elif before is _ABSENT:
        yield f"{key} was not there, is {_value(now)}"
    elif now is _ABSENT:
        yield f"{key} was {_value(before)}, is not there"
    elif before != now:
        yield f"{key} was {_value(before)}, is {_value(now)}"


def _rank(text: str) -> int:
    """Place of a difference by its key: what tells scenarios apart at one glance comes first."""
    starts = ("run.name ", "run.", "carriers", "services", "devices")
    return next((at for at, start in enumerate(starts) if text.startswith(start)), len(starts))


def _list_differences(key: str, before: Any, now: Any) -> Iterator[str]:
    if all(isinstance(item, str) for item in (*before, *now)) and {*before} != {*now}:
        yield from (f"{key} is without {item!r}" for item in before if item not in now)
        yield from (f"{key} has {item!r} too" for item in now if item not in before)
        return
    for at in range(max(len(before), len(now))):
        was = before[at] if at < len(before) else _ABSENT
        this = now[at] if at < len(now) else _ABSENT
        yield from _differences(f"{key}[{at}]", was, this)


def _changed(before: Mapping[str, Any], now: Mapping[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """Each key with another value, and both."""
    for name in dict.fromkeys((*before, *now)):
        was, this = before.get(name, _ABSENT), now.get(name, _ABSENT)
        if was is _ABSENT or this is _ABSENT or was != this:
            yield name, was, this


def _of_digest(before: object, now: object) -> str:
    return "is new" if before is _ABSENT else "is gone" if now is _ABSENT else "has changed"


def _value(value: Any) -> str:
    """A value as a scenario has it, shortened."""
    if isinstance(value, Mapping) and "name" in value:
        return f"that of {value['name']!r}"
    if isinstance(value, float) and math.isfinite(value) and abs(value) >= 1e5:
        power = int(math.log10(abs(value))) // 3 * 3
        text = f"{value / 10**power:.12g}e{power}"
        if float(text) == value:
            return text
    text = repr(value)
    return text if len(text) <= _VALUE_CHARACTERS else f"{text[: _VALUE_CHARACTERS - 1]}…"
