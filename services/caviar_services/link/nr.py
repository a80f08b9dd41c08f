"""Rate model ``nr``: transport blocks of 5G NR, from the link-level tables of Sionna SYS.

`load_tables` takes the tables of `sionna.sys.PHYAbstraction`, the sizes of transport blocks and the
parameters of the effective SINR mapping once, before the first frame; frames are computed from these in
NumPy. PHYAbstraction and OuterLoopLinkAdaptation themselves, called in each slot, would take milliseconds a
slot; the numbers are the same, which a test holds, and what has to be saved is one offset a user.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_protocol.cell.link_adaptation import BlockTable, outer_loop
from caviar_protocol.errors import SetupError
from caviar_protocol.host import install_command
from caviar_protocol.topics import Carrier
from caviar_services.link.slot_rates import Carried, SlotRates, SlotSinr

EXTRA = "system"

_FR2_HZ = 24.25e9
"""Frequency from which a carrier is one of frequency range 2 (3GPP TS 38.104, table 5.1-1)."""

_SYMBOLS, _BLOCK_SUBCARRIERS = 14, 12
"""OFDM symbols of a slot, and subcarriers of a resource block (3GPP TS 38.211)."""

_DOWNLINK = 1
"""Category of the tables of the PDSCH in `sionna.sys`."""

_UNKNOWN = 2.0
"""Error probability of a scheme that the tables do not have."""


@dataclass(frozen=True)
class Numerology:
    """Transport blocks of a slot of the link on a carrier."""

    resource_elements: int
    """Of a transport block, all subcarriers taken together."""
    blocks: int
    """Transport blocks of a slot of the link, one for each slot of NR in it; at least 1."""


def numerology(carrier: Carrier, slot_s: float) -> Numerology:
    """Work out the resource elements of a transport block.

    The carrier's ``subcarrier_spacing_hz`` counts, or 120 kHz in frequency range 2 and 30 kHz below; its
    ``subcarriers``, or as many as fit into the bandwidth. What reference signals and control channels take
    is that of 3GPP TS 38.306, section 4.1.2: 18 % in frequency range 2, 14 % below.

    Args:
        carrier: The carrier.
        slot_s: Length of a slot of the link [s]. A longer one than that of NR has several blocks; in a
            shorter one a block has as many resource elements fewer.

    Example:
        >>> mmwave = Carrier(name="n257", frequency_hz=28e9, bandwidth_hz=100e6)
        >>> numerology(mmwave, 1e-3)  # eight slots of 125 µs, 69 resource blocks
        Numerology(resource_elements=9505, blocks=8)
    """
    is_fr2 = carrier.frequency_hz >= _FR2_HZ
    spacing = carrier.subcarrier_spacing_hz or (120e3 if is_fr2 else 30e3)
    subcarriers = carrier.subcarriers or math.floor(carrier.bandwidth_hz / spacing * (1 + 1e-12))
    # A slot of 14 symbols takes 1 ms at 15 kHz.
    slot_of_nr_s = 1e-3 * 15e3 / spacing
    blocks = max(1, round(slot_s / slot_of_nr_s))
    used = subcarriers // _BLOCK_SUBCARRIERS * _BLOCK_SUBCARRIERS * _SYMBOLS * (0.82 if is_fr2 else 0.86)
    return Numerology(int(used * slot_s / (blocks * slot_of_nr_s)), blocks)


Tables = Mapping[int, BlockTable]
"""Table by the resource elements of a block."""


def load_tables(
    mcs_table: int, resource_elements: set[int], progress: Callable[[str, float], None]
) -> Tables:
    """Load the tables of Sionna SYS.

    Args:
        mcs_table: 1 (up to 64-QAM) or 2 (up to 256-QAM), of 3GPP TS 38.214, section 5.1.3.1.
        resource_elements: Of the blocks that there are.
        progress: Told what is loaded, and for how long that may take [s].

    Raises:
        SetupError: Sionna SYS is not installed; the text has the command.
    """
    progress("loading Sionna SYS", 120.0)
    try:
        import sionna.sys
        import torch
        from sionna.phy.nr.utils import MCSDecoderNR, TransportBlockNR
        from sionna.phy.utils import SplineGriddataInterpolation
    except ImportError as error:
        raise SetupError(
            f"the rate model 'nr' needs {error.name or 'sionna.sys'!r}, which is not installed; run: "
            f"{install_command(EXTRA)}"
        ) from error

    class Forwards(SplineGriddataInterpolation):  # type: ignore[misc]  # of a library without types
        """Leaves out the inverse of the tables, which nothing asks for and which takes seconds."""

        def unstruct(self, z: Any, x: Any, y: Any, x_interp: Any, y_interp: Any, **_: Any) -> Any:
            return np.zeros((len(x_interp), len(y_interp)))

    file = Path(sionna.sys.__file__).parent / "bler_tables" / f"PDSCH_table{mcs_table}.json"
    abstraction = sionna.sys.PHYAbstraction(Forwards(), load_bler_tables_from=str(file), device="cpu")
    block_errors = abstraction.bler_table_interp[_DOWNLINK, mcs_table - 1].numpy().astype(np.float64)
    beta = sionna.sys.EESM(device="cpu").beta_tensor[mcs_table - 1].numpy().astype(np.float64)
    least_db, _, step_db = abstraction.snr_db_interp_min_max_delta
    schemes = torch.arange(len(block_errors), dtype=torch.int32)
    order, rate = MCSDecoderNR(device="cpu")(schemes, mcs_table, _DOWNLINK)
    sizes = TransportBlockNR(device="cpu")
    found = {}
    for count in resource_elements:
        bits, code_block, code_blocks = sizes.transport_block_size(order, rate, order * count)
        column = abstraction.get_idx_from_grid(code_block, "cbs").numpy()
        of_size = block_errors[np.arange(len(block_errors)), column]
        # A transport block fails where one of its code blocks does.
        failing = 1 - (1 - np.minimum(of_size, 1.0)) ** code_blocks.numpy()[:, None]
        failing[~np.isfinite(of_size)] = _UNKNOWN
        found[count] = BlockTable(
            bits=bits.numpy().astype(np.int64),
            error=failing,
            least_db=least_db,
            step_db=step_db,
            beta=beta[: len(block_errors)],
        )
    return found


@dataclass(frozen=True, eq=False)
class Blocks:
    """Transport blocks on a carrier."""

    tables: tuple[BlockTable, ...]
    """For 1, 2, … terminals that share its band."""
    count: int
    """Blocks of each terminal in a slot of the link."""

    def goodput(self, snr: Float64Array, target: float) -> Float64Array:
        """Bits that come through in a slot, on average, of terminals that are served alone.

        Args:
            snr: Of each terminal, Shape ``[U]``.
            target: Share of blocks that may fail.
        """
        table, sinr = self.tables[0], snr[:, None]
        scheme = table.choose(sinr, np.zeros(len(snr)), target)
        bits: Float64Array = self.count * table.bits[scheme] * (1 - table.error_of(scheme, sinr))
        return bits


def load_blocks(
    carriers: Iterable[Carrier],
    slot_s: float,
    mcs_table: int,
    at_once: int,
    progress: Callable[[str, float], None],
) -> dict[str, Blocks]:
    """Load the transport blocks of carriers.

    Args:
        carriers: Of the run.
        slot_s: Length of a slot of the link [s].
        mcs_table: As of `load_tables`.
        at_once: Terminals that share a carrier, at most.
        progress: As of `load_tables`.

    Returns:
        By the name of the carrier.

    Raises:
        SetupError: As of `load_tables`.
    """
    found = {carrier.name: numerology(carrier, slot_s) for carrier in carriers}
    shared = {
        name: [max(1, of.resource_elements // share) for share in range(1, at_once + 1)]
        for name, of in found.items()
    }
    tables = load_tables(mcs_table, {count for counts in shared.values() for count in counts}, progress)
    return {
        name: Blocks(tuple(tables[count] for count in shared[name]), of.blocks) for name, of in found.items()
    }


class Adaptation(NamedTuple):
    """State of link adaptation for each terminal, Shape ``[T]``; changed in place."""

    offset_db: Float64Array
    """Of the outer loop."""
    rise: Float64Array
    """By how much interference lowered the SNR when the terminal was served last, as a factor."""


class NrRates(SlotRates):
    """A scheme for each block by what is known of the channel, and a draw whether it is decoded.

    The transmitter knows the SNR of the slot before, in the first slot of a frame that of the slot itself,
    and the interference of the slot in which it served the terminal last.

    Args:
        sinr: Of the terminals.
        blocks: Of each terminal's carrier, T of them.
        adaptation: What is remembered.
        target: Share of blocks that may fail.
        step_db: Of the outer loop [dB].
        random: Draws which blocks are decoded.
    """

    def __init__(
        self,
        sinr: SlotSinr,
        blocks: Sequence[Blocks],
        adaptation: Adaptation,
        target: float,
        step_db: float,
        random: np.random.Generator,
    ) -> None:
        super().__init__(sinr)
        self._adaptation, self._target, self._step_db, self._random = adaptation, target, step_db, random
        # Terminals of each carrier, by its blocks.
        of_carrier: dict[int, list[int]] = {}
        for terminal, of in enumerate(blocks):
            of_carrier.setdefault(id(of), []).append(terminal)
        self._carriers = [(np.array(found), blocks[found[0]]) for found in of_carrier.values()]
        self._scheme = np.zeros(len(blocks), np.int64)

    def offered(self, slot: int) -> Int64Array:
        known = self.sinr.alone(max(slot - 1, 0)) / self._adaptation.rise[:, None]
        bits = np.zeros(len(known), np.int64)
        for terminals, blocks in self._carriers:
            table = blocks.tables[0]
            offset = self._adaptation.offset_db[terminals]
            scheme = self._scheme[terminals] = table.choose(known[terminals], offset, self._target)
            bits[terminals] = table.bits[scheme] * blocks.count
        return bits

    def carried(self, slot: int, served: BoolArray, waiting: Int64Array) -> Carried:
        sinr, adaptation = self.sinr, self._adaptation
        shares = sinr.shares(served)
        rise = sinr.rise(slot, served, shares)
        actual = sinr.alone(slot) / rise[:, None]
        bits, count, failed = np.zeros((3, len(served)), np.int64)
        for terminals, blocks in self._carriers:
            mine = terminals[served[terminals]]
            for share in np.unique(shares[mine]).tolist():
                table = blocks.tables[share - 1 if sinr.in_band else 0]
                here = mine[shares[mine] == share]
                scheme = self._scheme[here]
                error = table.error_of(scheme, actual[here])
                size = table.bits[scheme]
                # No more blocks than what waits needs.
                count[here] = np.minimum(-(-waiting[here] // size), blocks.count)
                failed[here] = self._random.binomial(count[here], error)
                bits[here] = size * (count[here] - failed[here])
        adaptation.rise[served] = rise[served]
        moved = outer_loop(adaptation.offset_db, count - failed, failed, self._step_db, self._target)
        adaptation.offset_db[served] = moved[served]
        return Carried(bits, actual.mean(-1), count, failed)
