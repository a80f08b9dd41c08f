"""Instants of frames that a scenario gives, in place of a sampling period: ``run.instants_s``."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from decimal import Decimal, InvalidOperation
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

from caviar_protocol.errors import ScenarioError
from caviar_protocol.scenario.conversion import FILE, Place, csv_rows

KEY = "instants_s"
NANOSECONDS = "instants_ns"
"""The same as whole nanoseconds; read into `KEY`."""
COLUMN = "t_s"
REPLACED = ("frames", "sampling_period_ns")
"""Keys that follow from the instants."""

_LATEST_S = 2**63 // 10**9
_EXAMPLES = {KEY: "[0.0, 0.1, 0.35]", NANOSECONDS: "[0, 100_000_000, 350_000_000]"}

Refuse: TypeAlias = Callable[[str], ScenarioError]
"""Makes the error about a value, with its place."""


def instants_ns(instants_s: Iterable[float]) -> tuple[int, ...]:
    """Instants of decimal numbers of seconds, without the error of binary fractions.

    Args:
        instants_s: Seconds [s], each of at most 9 decimals.

    Returns:
        Whole nanoseconds [ns].

    Example:
        >>> instants_ns([0.1, 0.35]), int(0.35 * 1e9)
        ((100000000, 350000000), 350000000)
    """
    return tuple(int(_nanoseconds(value)) for value in instants_s)


def with_instants(table: Mapping[str, Any], place: Place, folder: Path = Path()) -> dict[str, Any]:
    """The table ``run`` of a scenario with ``frames`` and ``sampling_period_ns`` from its instants.

    Instants stand in ``instants_s``, or as whole numbers in ``instants_ns``, or one a line in a CSV file
    with the header ``t_s`` that ``instants_s = "file:PATH.csv"`` names. The period is their greatest common
    divisor, so that each is a multiple of it.

    Args:
        table: As it stands in the file. Without instants, or with ones of a wrong type, it comes back as it
            is.
        place: Where it stands.
        folder: What the path of the CSV file is relative to.

    Raises:
        ScenarioError: Instants are no strictly increasing whole nanoseconds, or stand beside a key that they
            replace.

    Example:
        >>> table = with_instants({"name": "mine", "instants_s": [0.0, 0.1, 0.35]}, Place("run"))
        >>> table["frames"], table["sampling_period_ns"]
        (3, 50000000)
    """
    key = NANOSECONDS if NANOSECONDS in table else KEY
    values, here = table.get(key), place.at(key)
    if values is None:
        return dict(table)
    for other in (KEY, *REPLACED):
        if other in table and other != key:
            raise place.at(other).error(f"follows from {key}; remove one of both keys")
    if key == KEY and isinstance(values, str) and values.startswith(FILE):
        written = _lines_of(folder / values.removeprefix(FILE), here)
    elif key == KEY and (not isinstance(values, list) or any(type(v) not in (int, float) for v in values)):
        return {**table, "frames": 1}  # so that its own type is what is found wrong
    # An empty list would be a run without a frame, which nothing downstream expects.
    elif not isinstance(values, list) or not values:
        raise here.error(f"is {values!r}, write the instant of each frame: {_EXAMPLES[key]}")
    else:
        written = [(value, here.at(index).error) for index, value in enumerate(values)]
    seconds: list[float] = []
    for index, (value, refuse) in enumerate(written):
        # Seconds of an instant as it is written: a number, or a line of a file.
        if key == NANOSECONDS and (type(value) is not int or value < 0):
            raise refuse(f"is {value!r}, write whole nanoseconds ≥ 0")
        try:
            exact = Decimal(str(value)).scaleb(-9 if key == NANOSECONDS else 0)
        except InvalidOperation as error:
            raise refuse(f"{value!r} is no number; write seconds") from error
        # The range first: of 1e300 a remainder cannot be computed.
        is_whole = exact.is_finite() and 0 <= exact < _LATEST_S and not exact.scaleb(9) % 1
        if not is_whole and key == KEY:
            raise refuse(f"is {value}, write seconds ≥ 0 with at most 9 decimals")
        if not is_whole or _nanoseconds(float(exact)) != exact.scaleb(9):
            raise refuse(f"is {value}, so late that nanoseconds are not distinguished; write at most 1e6 s")
        seconds.append(float(exact))
        if index and seconds[index] <= seconds[index - 1]:
            raise refuse(f"{value} does not come after {written[index - 1][0]}; order the instants by time")
    # By their shortest decimal form, as it stands in the file: 0.1 s is 100,000,000 ns and not a bit more.
    instants = instants_ns(seconds)
    period = math.gcd(*instants)
    rest = {name: value for name, value in table.items() if name != key}
    return rest | {KEY: seconds, "frames": len(instants)} | ({"sampling_period_ns": period} if period else {})


def _lines_of(path: Path, place: Place) -> list[tuple[Any, Refuse]]:
    """Lines of a CSV file of instants, each with the error about it, which names file and line."""
    rows = csv_rows(path, place, [(COLUMN,)])
    if len(rows) < 2:
        raise ScenarioError(f"holds no instant; write {COLUMN}, then one a line", str(path), place.key)
    return [(row.text.strip(), partial(ScenarioError, file=str(path), line=row.number)) for row in rows[1:]]


def _nanoseconds(seconds: float) -> Decimal:
    return Decimal(repr(seconds)).scaleb(9)
