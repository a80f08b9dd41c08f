"""Beams of DFT codebooks: which one points where, and its gain, for arrays of panels and polarizations.

`Link` defines the beams by their index. An array is a set of uniform subarrays: the elements of one panel and
one polarization. Elements and beams are both in order of the subarrays, so whatever is known of uniform
arrays holds for each of these blocks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_protocol.space.coordinates import (
    UnitQuaternion,
    Vector,
    quaternion_from_euler,
    rotation_matrix,
    unrotated,
)
from caviar_protocol.topics.scene import AntennaArray, Panel


def straight_beams(
    transmit: AntennaArray, towards_rx: Sequence[float], receive: AntennaArray, towards_tx: Sequence[float]
) -> tuple[int, int]:
    """Beams of two arrays along the straight line between them.

    Args:
        transmit: Array of the transmitter.
        towards_rx: Unit vector to the receiver, in the transmitter's axes.
        receive: Array of the receiver.
        towards_tx: Unit vector to the transmitter, in the receiver's axes.

    Returns:
        TX beam and RX beam; of dual polarizations those that couple best between upright devices.

    Example:
        >>> ahead = (1.0, 0.0, 0.0)
        >>> straight_beams(AntennaArray(columns=32), ahead, AntennaArray(columns=4), ahead)
        (0, 0)
    """
    sent = taken = 0
    if not (transmit.is_uniform and receive.is_uniform):
        sent, taken = coupled_polarizations(transmit, receive)
    return beam_towards(transmit, towards_rx, sent), beam_towards(receive, towards_tx, taken)


def beam_towards(array: AntennaArray, direction: Sequence[float], polarization: int = 0) -> int:
    """Beam with the greatest ``|c_k* a(k̂)|`` towards a direction.

    Along one axis of N elements with a spacing of d wavelengths, and u the direction's cosine,
    ``|c_k* a| = |sin(πNv)| / (sqrt(N)·|sin πv|)`` with ``v = d·u − k/N`` (Tse and Viswanath, section
    7.3.4). The numerator is the same for all k, so the best k is the one nearest to N·d·u, modulo N:
    wrapped beams, end-fire directions and grating lobes need no special cases.

    Args:
        array: The array.
        direction: Unit vector in device axes.
        polarization: Which of dual polarizations, by its index.

    Returns:
        Index of the beam: of several panels one of the panel that faces the direction most, of two beams with
        equal gain the one of lower index.

    Example:
        >>> beam_towards(AntennaArray(rows=1, columns=8), (1.0, 0.0, 0.0))  # boresight
        0
    """
    if array.is_uniform:
        return _uniform_beam(array, direction)
    mine = subarrays(array)[polarization :: len(array.polarizations)]
    # The panel whose boresight is nearest: the first coordinate is its cosine.
    faced = max(mine, key=lambda part: part.towards(direction)[0])
    return faced.first + _uniform_beam(faced.array, faced.towards(direction))


def _uniform_beam(array: AntennaArray, direction: Sequence[float]) -> int:
    _, y, z = direction
    column = _nearest(array.columns, array.horizontal_spacing * y)
    row = _nearest(array.rows, -array.vertical_spacing * z)  # rows count from +z to −z
    return column * array.rows + row


def _nearest(size: int, turns: float) -> int:
    """The k of 0 … size − 1 with the least ``|turns − k/size|`` modulo 1."""
    exact = size * turns
    # Half a beam rounds down, so that of two equal beams the lower index is taken; `round` would go to even.
    below = math.ceil(exact - 0.5)
    is_tie = exact - below == 0.5
    beam = below % size
    return 0 if is_tie and beam == size - 1 else beam


def beam_gain(array: AntennaArray, beam: int, directions: Float64Array) -> Float64Array:
    """Amplitude of a beam towards directions, 1 at its greatest.

    Args:
        array: The array.
        beam: Index of the beam.
        directions: Unit vectors in device axes, Shape ``[..., 3]``.

    Returns:
        The array factor ``|sin(πNv)| / (N·|sin πv|)`` of `beam_towards` over columns times that over rows,
        of the beam's own subarray, Shape ``[...]``.

    Example:
        >>> boresight = np.array([[1.0, 0.0, 0.0]])
        >>> [beam_gain(AntennaArray(columns=8), beam, boresight).round(6).item() for beam in (0, 1)]
        [1.0, 0.0]
    """
    if not array.is_uniform:
        part, beam = subarray_of(array, beam)
        turned = rotation_matrix(part.orientation)
        array, directions = part.array, directions @ turned
    column, row = divmod(beam, array.rows)
    gain: Float64Array = _factor(
        array.columns, array.horizontal_spacing * directions[..., 1] - column / array.columns
    ) * _factor(array.rows, -array.vertical_spacing * directions[..., 2] - row / array.rows)
    return gain


def subarray_of(array: AntennaArray, beam: int) -> tuple[Subarray, int]:
    """The subarray that a beam is of.

    Args:
        array: The array of a device.
        beam: Index of a beam of the whole array.

    Returns:
        The subarray, and the beam's index in the subarray's own codebook.

    Example:
        >>> part, own = subarray_of(AntennaArray(columns=8, polarization="VH"), 11)
        >>> part.array.polarization, own
        ('H', 3)
    """
    number, own = divmod(beam, array.rows * array.columns)
    return subarrays(array)[number], own


def _factor(size: int, v: Float64Array) -> Float64Array:
    v = v - np.round(v)
    sine = np.sin(np.pi * v)
    # At its maxima the array factor is 0/0.
    peak = np.abs(sine) < 1e-9
    factor: Float64Array = np.where(
        peak, 1.0, np.abs(np.sin(np.pi * size * v)) / (size * np.abs(np.where(peak, 1.0, sine)))
    )
    return factor


@dataclass(frozen=True)
class Subarray:
    """All elements of one panel and one polarization.

    Example:
        >>> vertical, horizontal = subarrays(AntennaArray(columns=8, polarization="VH"))
        >>> horizontal.elements
        slice(8, 16, None)
    """

    array: AntennaArray
    """A uniform array (`AntennaArray.is_uniform`)."""
    first: int
    """Index of its first element among those of the whole array, and of its first beam among all beams."""
    position: Vector
    """Of its centre in the device's axes [m]."""
    orientation: UnitQuaternion
    """Rotates its axes into the device's."""

    @property
    def elements(self) -> slice:
        """Its elements, or its beams, among those of the whole array."""
        return slice(self.first, self.first + self.array.size)

    def towards(self, direction: Sequence[float]) -> Vector:
        """A direction in the axes of the subarray.

        Args:
            direction: Unit vector in the device's axes.
        """
        x, y, z = direction
        return unrotated(self.orientation, (x, y, z))


# Arrays are few and frozen; link, agent and channel ask for their parts in every frame.
@lru_cache(maxsize=256)
def subarrays(array: AntennaArray) -> tuple[Subarray, ...]:
    """The subarrays of an array: panels in their order, within each the polarizations.

    Args:
        array: The array of a device.

    Example:
        >>> [part.first for part in subarrays(AntennaArray(rows=2, columns=4, polarization="VH"))]
        [0, 8]
    """
    found = []
    first = 0
    for panel in array.panels or (Panel(),):
        turned = (math.radians(panel.yaw_deg), math.radians(panel.pitch_deg), math.radians(panel.roll_deg))
        for polarization in array.polarizations:
            part = array
            if not array.is_uniform:
                part = msgspec.structs.replace(array, polarization=polarization, panels=())
            found.append(Subarray(part, first, panel.position_m, quaternion_from_euler(*turned)))
            first += part.size
    return tuple(found)


@lru_cache(maxsize=64)
def coupled_polarizations(transmit: AntennaArray, receive: AntennaArray) -> tuple[int, int]:
    """Polarizations that couple best between upright devices that face each other.

    A slant of +45° is one of −45° seen from the other side, so the first elements of two ``cross`` arrays do
    not hear each other; those of two ``circular`` arrays do.

    Args:
        transmit: Array of the transmitter.
        receive: Array of the receiver.

    Returns:
        Index among the polarizations of each array; of equal ones the first.

    Example:
        >>> coupled_polarizations(AntennaArray(polarization="cross"), AntennaArray(polarization="cross"))
        (0, 1)
    """
    pairs = [(t, r) for t in range(len(transmit.polarizations)) for r in range(len(receive.polarizations))]

    def coupling(pair: tuple[int, int]) -> float:
        sent, taken = jones(transmit.polarizations[pair[0]]), jones(receive.polarizations[pair[1]])
        return round(abs(sent[0] * taken[0] - sent[1] * taken[1]), 9)

    return max(pairs, key=coupling)  # the first of equal ones


def jones(polarization: str) -> tuple[complex, complex]:
    """Field of an element along θ̂ and φ̂, as parts of the amplitude of its pattern.

    Linear polarizations are those of model 2 of 3GPP TR 38.901, section 7.3.2, (cos ζ, sin ζ) at a slant of
    ζ. Circular ones follow IEEE Std 145 for waves exp(+j2πft): looking along the wave, RHCP turns clockwise.

    Args:
        polarization: ``V``, ``H``, ``-45``, ``+45``, ``RHCP`` or ``LHCP``.

    Example:
        >>> jones("H")
        (0.0, 1.0)
    """
    if polarization == "V":
        return 1.0, 0.0
    if polarization == "H":
        return 0.0, 1.0
    part = math.sqrt(0.5)
    return {"-45": (part, -part), "+45": (part, part), "RHCP": (part, -1j * part), "LHCP": (part, 1j * part)}[
        polarization
    ]
