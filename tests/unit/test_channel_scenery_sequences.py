"""Sequences of faces of scenery that see one another."""

from __future__ import annotations

import numpy as np
import pytest

from caviar_services.channel import scenery_chains
from caviar_services.channel.scenery_chains import sequences

PLANES = np.array([2, 5, 7])
SIGHTS = np.array([[2, 5], [2, 7], [5, 2], [7, 2]])


def test_each_goes_on_at_faces_that_its_last_one_sees() -> None:
    found = sequences(PLANES, SIGHTS, 3)
    assert found is not None
    chains = [tuple(plane for plane in row if plane >= 0) for row in found.tolist()]
    assert chains == [
        *((2,), (5,), (7,)),
        *((2, 5), (2, 7), (5, 2), (7, 2)),
        *((2, 5, 2), (2, 7, 2), (5, 2, 5), (5, 2, 7), (7, 2, 5), (7, 2, 7)),
    ]


def test_of_too_many_there_are_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scenery_chains, "_MOST_CHAINS", 12)
    assert sequences(PLANES, SIGHTS, 3) is None
    assert sequences(PLANES, SIGHTS, 2) is not None


def test_faces_that_see_nothing_reflect_alone() -> None:
    found = sequences(PLANES, np.zeros((0, 2), np.int64), 2)
    assert found is not None
    assert found.tolist() == [[2, -1], [5, -1], [7, -1]]
