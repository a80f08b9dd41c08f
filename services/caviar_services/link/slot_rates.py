"""What slots carry for the terminals that they serve: SINR with interference, and rate models."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_protocol.cell.rates import shannon, slot_bits
from caviar_services.link.association import Layout
from caviar_services.link.beam_scores import Scored
from caviar_services.link.interference import amplitudes

Sharing = Literal["band", "space"]


class SlotSinr:
    """SINR of T terminals in the slots of a frame, on F parts of the band.

    Args:
        snr: Of each terminal with all power of its transmitter, Shape ``[S, T, F]``; S is 1 where all slots
            have the same.
        members: Terminals of each transmitter and carrier, Shape ``[G, T]``.
        at_once: Terminals that a transmitter serves at once, at most.
        sharing: ``band``: they share its band; ``space``: all of them have the whole band, and hear each
            other's beams.
        noise_rise: Interference over noise at each terminal (row) when another one (column) is served with
            all power of its transmitter, Shape ``[S, T, T]``; None: nothing is heard of others.
    """

    def __init__(
        self,
        snr: Float64Array,
        members: BoolArray,
        at_once: int,
        sharing: Sharing,
        noise_rise: Float64Array | None,
    ) -> None:
        self.members, self.at_once, self.in_band = members, at_once, sharing == "band"
        self._snr, self._noise_rise = snr, noise_rise
        self._mean_snr = snr[..., 0] if snr.shape[-1] == 1 else snr.mean(-1)

    @property
    def varies(self) -> bool:
        """Whether the SNR of one slot is not that of all."""
        return len(self._snr) > 1

    @property
    def is_disturbed(self) -> bool:
        """Whether who is served changes the SINR of others."""
        return self._noise_rise is not None or (self.at_once > 1 and not self.in_band)

    def alone(self, slot: int) -> Float64Array:
        """SNR of each terminal over the band where it is served alone, Shape ``[T, F]``."""
        found: Float64Array = self._snr[slot if self.varies else 0]
        return found

    def mean_alone(self, slot: int) -> Float64Array:
        """Its mean over the band, Shape ``[T]``."""
        found: Float64Array = self._mean_snr[slot if self.varies else 0]
        return found

    def shares(self, served: BoolArray) -> Int64Array:
        """Number of terminals that share a transmitter and carrier in a slot, of each; at least 1."""
        if self.at_once == 1:
            return np.ones(len(served), np.int64)
        counts = (self.members & served).sum(1)
        found: Int64Array = np.maximum((self.members * counts[:, None]).sum(0), 1)
        return found

    def rise(self, slot: int, served: BoolArray, shares: Int64Array) -> Float64Array:
        """By how much interference lowers the SNR of each terminal as a factor, 1 for none; Shape ``[T]``."""
        # With the whole band, a terminal has a part of the power.
        own = np.ones(len(served)) if self.in_band else shares.astype(np.float64)
        if self._noise_rise is None:
            return own
        # Each of a transmitter's terminals gets its part of the power, of the band or of both.
        heard = self._noise_rise[slot if len(self._noise_rise) > 1 else 0] * (served / shares)
        found: Float64Array = own * (1 + heard.sum(1))
        return found


class Carried(NamedTuple):
    """What a slot carries, Shape ``[T]`` each; of terminals that it does not serve, anything."""

    bits: Int64Array
    """That come through."""
    sinr: Float64Array
    blocks: Int64Array
    """Transport blocks."""
    errors: Int64Array
    """Of these, how many are not decoded."""


class SlotRates(ABC):
    """A rate model in the slots of a frame.

    Args:
        sinr: Of the terminals.
    """

    def __init__(self, sinr: SlotSinr) -> None:
        self.sinr = sinr

    @abstractmethod
    def offered(self, slot: int) -> Int64Array:
        """Bits that a slot would carry for each terminal alone, as far as is known before, Shape ``[T]``."""

    @abstractmethod
    def carried(self, slot: int, served: BoolArray, waiting: Int64Array) -> Carried:
        """What a slot carries for the terminals that it serves; `offered` was asked for the slot before.

        Args:
            slot: Number of the slot in the frame.
            served: Which are served, Shape ``[T]``.
            waiting: Bits that wait for each, Shape ``[T]``.
        """


class ShannonRates(SlotRates):
    """log2(1 + SINR), up to that of the highest modulation and coding; the transmitter knows the SINR.

    Args:
        sinr: Of the terminals.
        bandwidth: Of each terminal's carrier [Hz], Shape ``[T]``.
        highest: Greatest spectral efficiency [bit/s/Hz]; None: no bound.
        slot_s: Length of a slot [s].
    """

    def __init__(self, sinr: SlotSinr, bandwidth: Float64Array, highest: float | None, slot_s: float) -> None:
        super().__init__(sinr)
        self._bandwidth, self._highest, self._slot_s = bandwidth, highest, slot_s
        count = len(bandwidth)
        self._one, self._none = np.ones(count, np.int64), np.zeros(count, np.int64)
        self._offered = [self._bits(sinr.mean_alone(0))]
        self._undisturbed = Carried(self._offered[0], sinr.mean_alone(0), self._one, self._none)

    def offered(self, slot: int) -> Int64Array:
        return self._bits(self.sinr.mean_alone(slot)) if self.sinr.varies else self._offered[0]

    def carried(self, slot: int, served: BoolArray, waiting: Int64Array) -> Carried:
        sinr = self.sinr
        if sinr.at_once == 1 and not sinr.varies and not sinr.is_disturbed:
            return self._undisturbed
        shares = sinr.shares(served)
        found = sinr.mean_alone(slot) / sinr.rise(slot, served, shares)
        bits = self._bits(found)
        return Carried(bits // shares if sinr.in_band else bits, found, self._one, self._none)

    def _bits(self, sinr: Float64Array) -> Int64Array:
        return slot_bits(self._bandwidth * shannon(sinr, self._highest), self._slot_s)


Gains = Callable[[Int64Array, Int64Array, Int64Array], Float64Array]
"""``gains(users, tx_beams, rx_beams)``: |y|² of these K in each slot and part of the band, Shape
``[K, S, F]``."""


def swept_gains(scored: Scored) -> Gains:
    """Gains that are the same in all slots and over the band, from the sweep of the frame."""

    def gains(users: Int64Array, tx_beams: Int64Array, rx_beams: Int64Array) -> Float64Array:
        found = amplitudes(scored.swept, len(scored.budget.users), users, tx_beams, rx_beams)
        power: Float64Array = found[:, None, None] ** 2
        return power

    return gains


def noise_rise(
    scored: Scored,
    layout: Layout,
    serving: Int64Array,
    gains: Gains,
    between_transmitters: bool,
    within_one: bool,
) -> Float64Array | None:
    """Interference over noise between terminals, on average over the band.

    Args:
        scored: The frame.
        layout: Terminals and transmitters.
        serving: Index of the user of each terminal with the transmitter that serves it, Shape ``[T]``.
        gains: Of beams.
        between_transmitters: Whether terminals hear beams of other transmitters.
        within_one: Whether terminals of one transmitter hear each other's beams.

    Returns:
        At each terminal (row) of the beam towards each other one (column), with all power of its
        transmitter, Shape ``[S, T, T]``; None where no terminal can hear another.
    """
    tx, carrier = layout.tx[serving], layout.carrier[serving]
    same = tx[:, None] == tx
    heard: BoolArray = (carrier[:, None] == carrier) & np.where(same, within_one, between_transmitters)
    np.fill_diagonal(heard, False)
    between = layout.rows[:, tx]
    tx_beam, rx_beam = scored.choices.tx_beam[serving], scored.choices.rx_beam[serving]
    heard &= (between >= 0) & (tx_beam >= 0) & (rx_beam >= 0)[:, None]
    if not heard.any():
        return None
    victims, culprits = heard.nonzero()
    rows = between[heard]
    beams = tx_beam[culprits].astype(np.int64), rx_beam[victims].astype(np.int64)
    gain = gains(rows, *beams).mean(-1)
    rise = np.zeros((gain.shape[1], *heard.shape))
    rise[:, heard] = (scored.budget.power_over_noise[rows][:, None] * gain).T
    return rise
