"""Antenna arrays as sets of uniform subarrays: the elements of one panel and one polarization.

Elements and beams of an array are both in order of its subarrays, so whatever is known of uniform arrays
holds for each of these blocks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import msgspec

from caviar_protocol.coordinates import UnitQuaternion, Vector, quaternion_from_euler, unrotated
from caviar_protocol.topics.scene import AntennaArray, Panel


@dataclass(frozen=True)
class Subarray:
    """All elements of one panel and one polarization."""

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
        """A direction in the device's axes, in those of the subarray."""
        x, y, z = direction
        return unrotated(self.orientation, (x, y, z))


@lru_cache(maxsize=256)
def subarrays(array: AntennaArray) -> tuple[Subarray, ...]:
    """The subarrays of an array: panels in their order, within each the polarizations."""
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
    """Polarizations, by their indices, that couple best between upright devices that face each other.

    Of equal ones the first. A slant of +45° is one of −45° seen from the other side, so the first
    elements of two ``cross`` arrays do not hear each other; those of two ``circular`` arrays do.
    """
    pairs = [(t, r) for t in range(len(transmit.polarizations)) for r in range(len(receive.polarizations))]

    def coupling(pair: tuple[int, int]) -> float:
        sent, taken = jones(transmit.polarizations[pair[0]]), jones(receive.polarizations[pair[1]])
        return round(abs(sent[0] * taken[0] - sent[1] * taken[1]), 9)

    return max(pairs, key=coupling)  # the first of equal ones


def jones(polarization: str) -> tuple[complex, complex]:
    """Field of an element along θ̂ and φ̂, as parts of the amplitude of its pattern.

    Linear ones are those of model 2 of 3GPP TR 38.901, section 7.3.2, (cos ζ, sin ζ) at a slant of ζ.
    Circular ones follow IEEE Std 145 for waves exp(+j2πft): looking along the wave, RHCP turns clockwise.
    """
    if polarization == "V":
        return 1.0, 0.0
    if polarization == "H":
        return 0.0, 1.0
    part = math.sqrt(0.5)
    return {"-45": (part, -part), "+45": (part, part), "RHCP": (part, -1j * part), "LHCP": (part, 1j * part)}[
        polarization
    ]
