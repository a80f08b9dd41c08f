"""Arguments of environments, checked: members, seeds, names and actions.

gymnasium passes on whatever a program gives. What is wrong is refused here with its value, before an array is
made of it: NumPy would round it, or take all memory.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from caviar_protocol.arrays import Int64Array
from caviar_protocol.errors import PayloadError, ScenarioError

MOST_MEMBERS = 2**16
"""Members of a vector environment at most: each takes some 10 kB, and no batch of training is larger."""
HIGHEST_SEED = 2**63 - 1
"""Of an episode, as messages carry it."""


def checked_members(num_envs: object) -> int:
    """Check the number of members of a vector environment.

    Args:
        num_envs: The argument.

    Raises:
        ScenarioError: It is no whole number from 1 to `MOST_MEMBERS`.

    Example:
        >>> checked_members(64)
        64
    """
    is_whole = isinstance(num_envs, int | np.integer) and not isinstance(num_envs, bool)
    if not (is_whole and 1 <= num_envs <= MOST_MEMBERS):  # type: ignore[operator]  # a whole number
        raise ScenarioError(f"num_envs={num_envs!r}; write a whole number from 1 to {MOST_MEMBERS}")
    return int(num_envs)  # type: ignore[call-overload,no-any-return]  # a whole number


def checked_path(name: str, value: object) -> Path:
    """Check an argument that takes one path.

    Args:
        name: Of the argument.
        value: The argument.

    Raises:
        ScenarioError: It is none.

    Example:
        >>> checked_path("scenario", "geometric")
        PosixPath('geometric')
    """
    if not isinstance(value, str | Path) or not str(value) or "\0" in str(value):
        raise ScenarioError(f"{name}={value!r}; write a path, or a name of those that caviar scenarios lists")
    return Path(value)


def checked_names(name: str, value: object) -> tuple[str, ...]:
    """Check an argument that takes several names, or paths.

    Args:
        name: Of the argument.
        value: The argument.

    Raises:
        ScenarioError: It is a text, which would be a sequence of letters, or not all of it is text.

    Example:
        >>> checked_names("observe", ["aod", "position"])
        ('aod', 'position')
    """
    if isinstance(value, str | Path):
        raise ScenarioError(f"{name} is the text {str(value)!r}; write a tuple of names: {name}=({value!r},)")
    is_list = isinstance(value, Sequence) and not isinstance(value, bytes)
    wrong = [one for one in value if not isinstance(one, str | Path)] if is_list else [value]  # type: ignore[attr-defined]
    if wrong:
        raise ScenarioError(f"{name}={value!r}: {wrong[0]!r} is no text; write a tuple of names")
    return tuple(map(str, value))  # type: ignore[call-overload]  # a sequence


def checked_patterns(name: str, value: object) -> tuple[str, ...]:
    """Check an argument that takes one name, or several.

    Args:
        name: Of the argument.
        value: The argument.

    Raises:
        ScenarioError: It is no text, and no sequence of texts.

    Example:
        >>> checked_patterns("users", "uav/*")
        ('uav/*',)
    """
    return (value,) if isinstance(value, str) else checked_names(name, value)


def checked_seeds(seed: object, members: int) -> list[int | None]:
    """Seeds of all members from what ``reset`` was given.

    Args:
        seed: Of member 0, and member i has ``seed + i``; or one for each, None for no new one; None: so for
            all.
        members: Number of them, M.

    Returns:
        M seeds.

    Raises:
        ScenarioError: They are no M whole numbers from 0 to `HIGHEST_SEED`.

    Example:
        >>> checked_seeds(7, 3)
        [7, 8, 9]
    """
    if seed is None:
        return [None] * members
    if isinstance(seed, int | np.integer) and not isinstance(seed, bool):
        seeds: list[Any] = [int(seed) + i for i in range(members)]
    elif isinstance(seed, Sequence | np.ndarray) and not isinstance(seed, str | bytes):
        seeds = list(seed)
    else:
        raise ScenarioError(f"seed={seed!r}; write a whole number, or one for each of {members} members")
    if len(seeds) != members:
        raise ScenarioError(f"seed has {len(seeds)} numbers; write {members}, one for each member")
    for one in seeds:
        is_whole = isinstance(one, int | np.integer) and not isinstance(one, bool)
        if one is not None and not (is_whole and 0 <= one <= HIGHEST_SEED):
            raise ScenarioError(f"seed {one!r}; write whole numbers from 0 to 2**63 - 1")
    return [None if one is None else int(one) for one in seeds]


def whole_numbers(given: object, *shapes: tuple[int, ...]) -> Int64Array:
    """Make an array of actions.

    Args:
        given: What ``step`` was given.
        shapes: One of which it has to have; an error names the first.

    Raises:
        PayloadError: It is no array of whole numbers of such a shape.

    Example:
        >>> whole_numbers([3, 1], (2,)).tolist()
        [3, 1]
    """
    try:
        found = np.asarray(given)
    except ValueError as error:  # rows of different lengths
        raise PayloadError(
            f"the actions are {given!r}; write whole numbers of shape {list(shapes[0])}"
        ) from error
    if found.shape not in shapes or not np.issubdtype(found.dtype, np.integer):
        raise PayloadError(
            f"the actions are {found.dtype} of shape {list(found.shape)}; write whole numbers of shape "
            f"{list(shapes[0])}"
        )
    # As it came, so that numbers beyond 64 bits are not turned into others.
    return found if found.dtype.kind == "u" else found.astype(np.int64, copy=False)
