"""What is computed from the tables of Sionna SYS is what its own classes compute."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest

from caviar_protocol.cell.link_adaptation import BlockTable, effective_sinr, outer_loop
from caviar_services.link.nr import load_tables
from caviar_services.service import no_progress

pytestmark = [
    pytest.mark.slow,
    # Not imported here: PyTorch, which it brings, takes seconds in every process that collects tests.
    pytest.mark.skipif(
        find_spec("sionna") is None or find_spec("sionna.sys") is None, reason="Sionna SYS is not installed"
    ),
]

COUNTS = {400, 9505}
SCHEMES = np.arange(2, 28)


@pytest.fixture(scope="module")
def tables() -> dict[int, BlockTable]:
    return dict(load_tables(2, COUNTS, no_progress))


@pytest.fixture(scope="module")
def abstraction() -> Any:
    """PHYAbstraction without the inverse of its tables, which take seconds and are not compared."""
    from pathlib import Path

    import sionna.sys
    from sionna.phy.utils import SplineGriddataInterpolation

    class Forwards(SplineGriddataInterpolation):  # type: ignore[misc]
        def unstruct(self, z: Any, x: Any, y: Any, x_interp: Any, y_interp: Any, **_: Any) -> Any:
            return np.zeros((len(x_interp), len(y_interp)))

    file = Path(sionna.sys.__file__).parent / "bler_tables" / "PDSCH_table2.json"
    return sionna.sys.PHYAbstraction(Forwards(), load_bler_tables_from=str(file), device="cpu")


@pytest.mark.parametrize("count", sorted(COUNTS))
def test_blocks_fail_as_often_as_phy_abstraction_says(
    count: int, tables: dict[int, BlockTable], abstraction: Any
) -> None:
    """300 random schemes and SINRs of flat channels, and the sizes of the blocks."""
    import torch

    rng = np.random.default_rng(count)
    scheme = rng.choice(SCHEMES, 300)
    # In the middle between points of the grid, where rounding to single precision changes none.
    sinr = 10 ** ((np.rint(rng.uniform(-40, 280, 300)) / 10 + 0.02) / 10)
    decoded, feedback, _, failing, _ = abstraction(
        torch.tensor(scheme, dtype=torch.int32),
        sinr_eff=torch.tensor(sinr, dtype=torch.float32),
        num_allocated_re=torch.full((300,), count, dtype=torch.int32),
        mcs_table_index=2,
        mcs_category=1,
    )
    table = tables[count]
    np.testing.assert_allclose(table.error_of(scheme, sinr[:, None]), failing.numpy(), rtol=2e-4, atol=2e-6)
    received = feedback.numpy() == 1
    assert received.sum() > 30
    assert (decoded.numpy()[received] == table.bits[scheme[received]]).all()


def test_the_effective_sinr_is_that_of_eesm(tables: dict[int, BlockTable], abstraction: Any) -> None:
    import torch

    rng = np.random.default_rng(3)
    scheme = rng.choice(SCHEMES, 40)
    sinr = rng.uniform(0.5, 8.0, (40, 22))
    expected = abstraction._sinr_effective_fun(
        torch.tensor(sinr.T[None, :, :, None], dtype=torch.float32),
        torch.tensor(scheme, dtype=torch.int32),
        mcs_table_index=2,
    ).numpy()
    np.testing.assert_allclose(effective_sinr(sinr, tables[9505].beta[scheme]), expected, rtol=1e-4)


def test_schemes_and_offsets_are_those_of_outer_loop_link_adaptation(
    tables: dict[int, BlockTable], abstraction: Any
) -> None:
    """30 slots of ten users with random feedback."""
    import torch
    from sionna.sys import OuterLoopLinkAdaptation

    rng, users = np.random.default_rng(8), 10
    theirs = OuterLoopLinkAdaptation(abstraction, num_ut=users, bler_target=0.1, delta_up=0.7)
    elements = torch.full((users,), 9505, dtype=torch.int32)
    offset, equal = np.zeros(users), 0
    for _ in range(30):
        feedback = rng.integers(0, 2, users)
        sinr = 10 ** (rng.uniform(-3, 27, users) / 10)
        expected = theirs(
            elements,
            harq_feedback=torch.tensor(feedback, dtype=torch.int32),
            sinr_eff=torch.tensor(sinr, dtype=torch.float32),
            mcs_table_index=2,
            mcs_category=1,
        ).numpy()
        offset = outer_loop(offset, feedback, 1 - feedback, 0.7, 0.1)
        np.testing.assert_allclose(offset, theirs.offset.numpy(), rtol=0, atol=1e-5)
        found = tables[9505].choose(sinr[:, None], offset, 0.1)
        equal += int((found == expected).sum())
    # At the edge of two points of the grid single precision decides: no more than one of 300 may differ.
    assert equal >= 299
