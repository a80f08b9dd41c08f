"""What a slot carries for the terminals that are served in it, with interference among them."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_protocol.cell.rates import shannon, slot_bits
from caviar_services.link.association import Layout
from caviar_services.link.beams import Scored
from caviar_services.link.interference import amplitudes

Sharing = Literal["band", "space"]


class Carried(NamedTuple):
    """What a slot carries, Shape ``[T]`` each; of terminals that it does not serve, anything."""

    bits: Int64Array
    sinr: Float64Array


class SlotRates:
    """Rates of T terminals in the slots of a frame.

    Args:
        bandwidth: Of each terminal's carrier [Hz], Shape ``[T]``.
        highest: Greatest spectral efficiency [bit/s/Hz]; None: no bound.
        slot_s: Length of a slot [s].
        snr: Of each terminal with all power of its transmitter, Shape ``[T]``.
        members: Terminals of each transmitter and carrier, Shape ``[G, T]``.
        sharing: ``band``: terminals that a transmitter serves at once share its band; ``space``: all of them
            have the whole band, and hear each other's beams.
        noise_rise: Interference over noise at each terminal (row) when another one (column) is served with
            all power of its transmitter, Shape ``[T, T]``; None: nothing is heard of others.
    """

    def __init__(
        self,
        bandwidth: Float64Array,
        highest: float | None,
        slot_s: float,
        snr: Float64Array,
        members: BoolArray,
        sharing: Sharing,
        noise_rise: Float64Array | None,
    ) -> None:
        self._bandwidth, self._highest, self._slot_s = bandwidth, highest, slot_s
        self._snr, self._members, self._sharing, self._noise_rise = snr, members, sharing, noise_rise
        self.alone = self._bits(snr)
        """Bits of a slot that serves one terminal only, Shape ``[T]``."""
        self._undisturbed = Carried(self.alone, snr)

    def carried(self, served: BoolArray, most: int) -> Carried:
        """What a slot carries for the terminals that it serves.

        Args:
            served: Which are served, Shape ``[T]``.
            most: Terminals that a transmitter serves at once, at most.
        """
        if most == 1 and self._noise_rise is None:
            return self._undisturbed
        sinr, parts, counts = self._snr, served.astype(np.float64), None
        if most > 1:
            # Of each terminal: how many its transmitter serves on its carrier, at least itself.
            counts = np.maximum((self._members * (self._members & served).sum(1)[:, None]).sum(0), 1)
            parts = parts / counts
            if self._sharing == "space":
                sinr = sinr / counts
        if self._noise_rise is not None:
            # Each of a transmitter's terminals gets its part of the power, of the band or of both.
            sinr = sinr / (1 + (self._noise_rise * parts).sum(1))
        bits = self._bits(sinr)
        return Carried(bits if counts is None or self._sharing == "space" else bits // counts, sinr)

    def _bits(self, sinr: Float64Array) -> Int64Array:
        return slot_bits(self._bandwidth * shannon(sinr, self._highest), self._slot_s)


def noise_rise(
    scored: Scored, layout: Layout, serving: Int64Array, between_transmitters: bool, within_one: bool
) -> Float64Array | None:
    """Interference over noise between terminals.

    Args:
        scored: The frame.
        layout: Terminals and transmitters.
        serving: Index of the user of each terminal with the transmitter that serves it, Shape ``[T]``.
        between_transmitters: Whether terminals hear beams of other transmitters.
        within_one: Whether terminals of one transmitter hear each other's beams.

    Returns:
        At each terminal (row) of the beam towards each other one (column), with all power of its
        transmitter, Shape ``[T, T]``; None where no terminal can hear another.
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
    gain = amplitudes(scored.swept, len(layout.users), rows, *beams) ** 2
    rise = np.zeros(heard.shape)
    rise[heard] = scored.budget.power_over_noise[rows] * gain
    return rise
