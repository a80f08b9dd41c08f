"""Which candidates a receiver is offered."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from caviar_services.channel.sionna.candidates import first_of_each


@given(st.lists(st.integers(0, 5), max_size=40), st.integers(1, 6))
def test_each_receiver_keeps_its_first_candidates(receivers: list[int], count: int) -> None:
    """In their order, whichever others stand between them."""
    kept = first_of_each(np.array(receivers, np.int64), count)
    for receiver in range(6):
        mine = [bool(k) for r, k in zip(receivers, kept, strict=True) if r == receiver]
        assert mine == [i < count for i in range(len(mine))]
