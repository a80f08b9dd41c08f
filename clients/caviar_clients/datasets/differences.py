"""In what two datasets differ, as keys of their scenarios with both values."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

SHOWN = 8
"""Differences that an error names."""
_VALUE_CHARACTERS = 60
_ABSENT = object()


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
