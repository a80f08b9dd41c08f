"""Births and deaths of paths."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from caviar_protocol.multipath import changes
from caviar_protocol.topics import Carrier, Channel


def product(rx: Sequence[str], ids: Sequence[Sequence[int]]) -> Channel:
    """A product of one transmitter with these ids of paths to each receiver."""
    flat = [number for pair in ids for number in pair]
    count = len(flat)
    return Channel(
        rung="siso-rt",
        carriers=(Carrier(name="c", frequency_hz=28e9),),
        tx=("t",),
        rx=tuple(rx),
        los=np.zeros((1, len(rx)), np.bool_),
        offsets=np.cumsum([0, *(len(pair) for pair in ids)]).astype(np.int64),
        id=np.array(flat, np.uint64),
        a=np.zeros((1, count), np.complex128),
        tau=np.zeros(count),
        aod=np.zeros((count, 2)),
        aoa=np.zeros((count, 2)),
        doppler=np.zeros((1, count)),
        interactions=np.zeros((count, 0), np.uint8),
        points=np.zeros((count, 0, 3)),
        objects=np.zeros((count, 0), np.int32),
    )


def test_paths_are_born_and_die_within_their_pair() -> None:
    """An id that moves from one receiver to another is a death and a birth."""
    turnover = changes(product(["r", "s"], [[1, 2, 3], [4]]), product(["r", "s"], [[1, 3], [2, 4]]))
    assert turnover.born.tolist() == [False, False, True, False]
    assert turnover.died.tolist() == [False, True, False, False]
    assert (turnover.births, turnover.deaths) == (1, 1)


def test_a_pair_that_comes_or_leaves_takes_its_paths_along() -> None:
    turnover = changes(product(["a", "b"], [[7], [8, 9]]), product(["b", "c"], [[9, 8], [7]]))
    assert turnover.born.tolist() == [False, False, True]
    assert turnover.died.tolist() == [True, False, False]


def test_nothing_changes_between_equal_products() -> None:
    turnover = changes(product(["r"], [[5, 6]]), product(["r"], [[5, 6]]))
    assert (turnover.births, turnover.deaths) == (0, 0)


_IDS = st.lists(st.lists(st.integers(0, 2**64 - 1), unique=True, max_size=6), min_size=3, max_size=3)


@given(_IDS, _IDS)
def test_what_was_is_what_remains_with_what_died(before: list[list[int]], after: list[list[int]]) -> None:
    """Balance of each pair, and the two directions of time mirror each other."""
    names = ["r", "s", "u"]
    one, other = product(names, before), product(names, after)
    forth, back = changes(one, other), changes(other, one)
    assert len(one.id) - forth.deaths + forth.births == len(other.id)
    assert np.array_equal(forth.born, back.died)
    assert np.array_equal(forth.died, back.born)
