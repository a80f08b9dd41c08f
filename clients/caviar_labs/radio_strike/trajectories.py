"""Trajectories of the three users of Radio-Strike, and the files that hold them.

Positions are north, east, down [m] of the base station's antennas, one row each 10 ms.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from caviar_labs.radio_strike.rules import USERS, WAVELENGTH_M
from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import ScenarioError

SLOT_S = 0.01
"""Sampling interval [s]."""
FARTHEST_M = 1e5
"""A coordinate beyond this is a mistake of units."""

_EPISODE, _OUTPUT = ("obj", "pos_x", "pos_y", "pos_z"), ("x", "y", "z")
_USER_COLUMNS = ("chosen_ue", "ue_name")
"""Names of the column with the user in outputs: of the original, and of the version of its published run."""


@dataclass(frozen=True, eq=False)
class Episode:
    """Trajectories of the three users.

    Raises:
        ScenarioError: There is no row, or a user is where the base station is; names the source.

    Example:
        >>> Episode("hover", np.full((1, 3, 3), 10.0)).steps
        1
    """

    source: str
    """Where it comes from, for errors."""
    position: Float64Array
    """North, east, down of the base station [m], Shape ``[steps, 3 users, 3]``."""

    def __post_init__(self) -> None:
        position = self.position
        if position.ndim != 3 or position.shape[1:] != (len(USERS), 3) or not len(position):
            raise ScenarioError(
                f"{self.source}: positions have shape {list(position.shape)}; write [steps, {len(USERS)}, 3]"
                " with one step at least"
            )
        wrong = np.argwhere(~(np.abs(position) <= FARTHEST_M))
        if len(wrong):
            step, user, axis = wrong[0].tolist()
            raise ScenarioError(
                f"{self.source}: {'xyz'[axis]} of {USERS[user]} in step {step} is "
                f"{position[step, user, axis]}; write a number of metres up to {FARTHEST_M:g}"
            )
        near = np.argwhere((position**2).sum(2) < WAVELENGTH_M**2)
        if len(near):
            step, user = near[0].tolist()
            raise ScenarioError(
                f"{self.source}: {USERS[user]} in step {step} is where the base station is, less than a "
                "wavelength away; move it"
            )

    @property
    def steps(self) -> int:
        """Number of rows."""
        return len(self.position)


def read_episode(file: Path) -> Episode:
    """Read an episode file of Radio-Strike, or the output file of an agent.

    Args:
        file: CSV with the columns ``obj``, ``pos_x``, ``pos_y``, ``pos_z``, and a row for each object in each
            step; or with ``chosen_ue`` (or ``ue_name``), ``x``, ``y``, ``z``, and one row a step. The rows of
            an output are trajectories since the original moves only the scheduled user; they are as long as
            that of the user with the fewest.

    Raises:
        ScenarioError: The file cannot be read, breaks off, lacks a column or a user, or a position is no
            number; names file and line.
    """
    rows: dict[str, list[tuple[float, float, float]]] = {user: [] for user in USERS}
    line = 1
    try:
        with file.open(newline="", encoding="utf-8") as text:
            reader = csv.reader(text)
            header = next(reader, [])
            user, columns, is_output = _columns(file, header)
            for row in reader:
                if not row:
                    continue
                line = reader.line_num
                if len(row) != len(header):
                    raise ScenarioError(
                        f"the row has {len(row)} of {len(header)} columns; the file breaks off or is "
                        "damaged: copy it again, or remove the whole step of this row",
                        str(file),
                        line=line,
                    )
                if row[user] in rows:
                    rows[row[user]].append(_position(file, line, row, columns, header))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        why = error.strerror if isinstance(error, OSError) else str(error)
        raise ScenarioError(f"cannot be read: {why}; name a CSV file of Radio-Strike", str(file)) from error
    counts = {name: len(found) for name, found in rows.items()}
    missing = [name for name, count in counts.items() if not count]
    if missing:
        raise ScenarioError(f"has no row of {', '.join(missing)}; it needs {', '.join(USERS)}", str(file))
    if not is_output and len(set(counts.values())) > 1:
        found = ", ".join(f"{count} of {name}" for name, count in counts.items())
        raise ScenarioError(
            f"has {found}; the file breaks off within a step: copy it again, or remove the last step",
            str(file),
            line=line,
        )
    steps = min(counts.values())
    return Episode(str(file), np.array([rows[name][:steps] for name in USERS]).swapaxes(0, 1).copy())


def _columns(file: Path, header: Sequence[str]) -> tuple[int, tuple[int, ...], bool]:
    """Index of the user's column, those of the position, and whether it is the output of an agent."""
    user = next((name for name in _USER_COLUMNS if name in header), None)
    names = _EPISODE if user is None else (user, *_OUTPUT)
    missing = [name for name in names if name not in header]
    if missing:
        outputs = ",".join(("chosen_ue", *_OUTPUT))
        raise ScenarioError(
            f"has no column {', '.join(missing)}; an episode has {','.join(_EPISODE)}, an output {outputs}",
            str(file),
            line=1,
        )
    indices = [header.index(name) for name in names]
    return indices[0], tuple(indices[1:]), user is not None


def _position(
    file: Path, line: int, row: Sequence[str], columns: Sequence[int], header: Sequence[str]
) -> tuple[float, float, float]:
    values = []
    for column in columns:
        try:
            value = float(row[column])
        except ValueError:
            value = math.nan
        if not abs(value) <= FARTHEST_M:
            raise ScenarioError(
                f"{header[column]} is {row[column]!r}; write a number of metres up to {FARTHEST_M:g}",
                str(file),
                line=line,
            )
        values.append(value)
    return values[0], values[1], values[2]
