"""Frames at instants that the scenario lists, in place of a sampling period."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from decimal import Decimal, InvalidOperation
from itertools import pairwise
from pathlib import Path
from typing import Any

from caviar_protocol.errors import ScenarioError
from caviar_protocol.tables import Place

KEY = "instants_s"
NANOSECONDS = "instants_ns"
"""The same as whole nanoseconds; read into `KEY`."""
FILE = "file:"
COLUMN = "t_s"
REPLACED = ("frames", "sampling_period_ns")
"""What the instants tell, too."""

_LATEST_S = 2**63 // 10**9


def instants_ns(instants_s: Iterable[float]) -> tuple[int, ...]:
    """Instants [ns] of decimal numbers of seconds, without the error of binary fractions."""
    return tuple(int(_nanoseconds(value)) for value in instants_s)


def with_instants(table: Mapping[str, Any], place: Place, folder: Path = Path()) -> dict[str, Any]:
    """The table ``run`` of a scenario with ``frames`` and ``sampling_period_ns`` from its instants.

    They stand in ``instants_s``, or as whole numbers in ``instants_ns``, or one a line in a CSV file
    with the header ``t_s`` that ``instants_s = "file:PATH.csv"`` names, relative to ``folder``.

    The period is the greatest common divisor of the instants, so that each is a multiple of it.
    Raises `ScenarioError` for instants that are no strictly increasing whole nanoseconds, or beside
    a key that they replace. A table without instants, or with ones of a wrong type, is left alone.
    """
    if NANOSECONDS in table:
        return with_instants(_in_seconds(table, place), place, folder)
    values = table.get(KEY)
    if values is None:
        return dict(table)
    for key in REPLACED:
        if key in table:
            raise place.at(key).error(f"follows from {KEY}; remove one of both keys")
    if isinstance(values, str) and values.startswith(FILE):
        values = _from_file(folder / values.removeprefix(FILE), place.at(KEY))
        table = {**table, KEY: values}
    if not isinstance(values, list) or not all(type(value) in (int, float) for value in values):
        return {**table, "frames": 1}  # so that its own type is what is found wrong
    here = place.at(KEY)
    if not values:
        raise here.error("is empty, write the instant of each frame: [0.0, 0.1, 0.35]")
    for index, value in enumerate(values):
        if not 0 <= value < _LATEST_S or _nanoseconds(value) % 1:
            raise here.at(index).error(f"is {value}, write seconds ≥ 0 with at most 9 decimals")
    for index, (before, value) in enumerate(pairwise(values), 1):
        if value <= before:
            raise here.at(index).error(f"{value} does not come after {before}; order the instants by time")
    instants = instants_ns(values)
    period = math.gcd(*instants)
    return {**table, "frames": len(instants), **({"sampling_period_ns": period} if period else {})}


def _in_seconds(table: Mapping[str, Any], place: Place) -> dict[str, Any]:
    """The table with `KEY` for `NANOSECONDS`, checked as far as seconds would not tell."""
    here, values = place.at(NANOSECONDS), table[NANOSECONDS]
    for key in (KEY, *REPLACED):
        if key in table:
            raise place.at(key).error(f"follows from {NANOSECONDS}; remove one of both keys")
    if not isinstance(values, list) or not values:
        raise here.error(f"is {values!r}, write the instant of each frame: [0, 100_000_000, 350_000_000]")
    for index, value in enumerate(values):
        if type(value) is not int or value < 0:
            raise here.at(index).error(f"is {value!r}, write whole nanoseconds ≥ 0")
        if value >= 2**63 or instants_ns([value / 1e9]) != (value,):
            raise here.at(index).error(
                f"is {value}, so late that nanoseconds are not told apart; write at most {10**15}"
            )
        if index and value <= values[index - 1]:
            raise here.at(index).error(
                f"{value} does not come after {values[index - 1]}; order the instants by time"
            )
    rest = {key: value for key, value in table.items() if key != NANOSECONDS}
    return {**rest, KEY: [value / 1e9 for value in values]}


def _from_file(path: Path, place: Place) -> list[float]:
    """Instants [s] of a CSV file, one a line; errors name file and line."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise place.error(f"{path} cannot be read: {why}; name a CSV file") from error
    found: list[float] = []
    header = ""
    for number, text in enumerate(map(str.strip, lines), 1):
        if not text or text.startswith("#"):
            continue
        if not header:
            header = text
            if header != COLUMN:
                raise ScenarioError(f"the first line is {text!r}; write {COLUMN}", str(path), line=number)
            continue
        found.append(_instant(text, str(path), number))
        if len(found) > 1 and found[-1] <= found[-2]:
            raise ScenarioError(
                f"{found[-1]} does not come after {found[-2]}; order the instants by time",
                str(path),
                line=number,
            )
    if not found:
        raise ScenarioError(f"holds no instant; write {COLUMN}, then one a line", str(path), place.key)
    return found


def _instant(text: str, file: str, line: int) -> float:
    try:
        exact = Decimal(text)
    except InvalidOperation as error:
        raise ScenarioError(f"{text!r} is no number; write seconds", file, line=line) from error
    is_whole = exact.is_finite() and 0 <= exact < _LATEST_S and not exact.scaleb(9) % 1
    if not is_whole or instants_ns([float(exact)])[0] != exact.scaleb(9):
        raise ScenarioError(
            f"{text} is no instant; write seconds ≥ 0 with at most 9 decimals", file, line=line
        )
    return float(exact)


def _nanoseconds(seconds: float) -> Decimal:
    return Decimal(repr(seconds)).scaleb(9)
