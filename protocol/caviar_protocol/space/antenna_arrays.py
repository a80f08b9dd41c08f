"""Antenna arrays: element positions, steering vectors, and the uniform subarrays that an array is a set of.

An array is a set of uniform subarrays: the elements of one panel and one polarization. Elements and beams are
both in order of the subarrays, so whatever is known of uniform arrays holds for each of these blocks.

One phase convention holds for the channel, the link and the agents. The element at ``r`` [wavelengths] sees
a plane wave of direction k̂ (unit vector from the array *towards* the other end, device axes) with the
phase ``exp(+j2π k̂·r)``: an element nearer to the other end has the shorter path and, with exp(−j2πfτ), the
larger phase. At both ends the same vector applies, so a single path of amplitude a has ``H = a · ar · atᵀ``
(Tse and Viswanath, Fundamentals of Wireless Communication, section 7.2, with directions taken from each
array outwards).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import msgspec
import numpy as np

from caviar_protocol.arrays import Complex128Array, Float64Array
from caviar_protocol.space.coordinates import UnitQuaternion, Vector, quaternion_from_euler, unrotated
from caviar_protocol.topics.scene import AntennaArray, Panel


def element_positions(array: AntennaArray) -> Float64Array:
    """Place the elements of an array in device axes around its centre.

    Element ``i`` is row ``i % rows`` of column ``i // rows``: rows from +z to −z, columns from
    −y to +y, boresight +x.

    Args:
        array: A uniform array.

    Returns:
        Positions [wavelengths], Shape ``[N, 3]``.

    Example:
        >>> element_positions(AntennaArray(rows=1, columns=2))[:, 1].tolist()
        [-0.25, 0.25]
    """
    y, z = _grid(array)
    positions = np.zeros((array.size, 3))
    positions[:, 1] = np.repeat(y, array.rows)
    positions[:, 2] = np.tile(z, array.columns)
    return positions


def steering_vector(array: AntennaArray, directions: Float64Array) -> Complex128Array:
    """Compute the phases ``exp(+j2π k̂·r)`` of the elements. The element pattern is not part of it.

    Args:
        array: A uniform array.
        directions: Unit vectors k̂ from the array towards the other end in device axes, Shape ``[..., 3]``.

    Returns:
        Shape ``[..., N]``, each of magnitude 1.

    Example:
        >>> to_the_left = np.array([0.0, 1.0, 0.0])  # elements half a wavelength apart: opposite phases
        >>> steering_vector(AntennaArray(rows=1, columns=2), to_the_left).round(6).imag.tolist()
        [-1.0, 1.0]
    """
    return element_phases(array, directions[..., 1], directions[..., 2])


def element_phases(array: AntennaArray, y: Float64Array, z: Float64Array) -> Complex128Array:
    """Compute a `steering_vector` of direction cosines.

    Args:
        array: A uniform array.
        y: Cosines along its columns, Shape ``[...]``.
        z: Cosines along its rows, Shape ``[...]``; not looked at with a single row.

    Returns:
        Shape ``[..., N]``, each of magnitude 1.
    """
    if array.size == 1:
        return np.ones((*y.shape, 1), np.complex128)
    # k̂·r separates, so rows + columns exponentials do instead of rows · columns.
    columns = _progression(y, array.columns, array.horizontal_spacing)
    if array.rows == 1:
        return columns
    rows = _progression(z, array.rows, -array.vertical_spacing)  # from +z to −z
    vector: Complex128Array = (columns[..., :, None] * rows[..., None, :]).reshape(*y.shape, array.size)
    return vector


FINE = 8
"""Elements of a group along an axis of more than twice as many: a phase is that of the group times that
within it, and a product costs a tenth of an exponential."""


def _progression(cosines: Float64Array, size: int, spacing: float) -> Complex128Array:
    """Phases of elements along one axis, centred, with these direction cosines, Shape ``[...]`` to
    ``[..., size]``."""
    exponents, groups = _anchors(size, spacing)
    known: Complex128Array = np.exp(cosines[..., None] * exponents)
    if not groups:
        return known
    found: Complex128Array = (known[..., :groups, None] * known[..., None, groups:]).reshape(
        *cosines.shape, groups * FINE
    )
    return found if groups * FINE == size else found[..., :size]


# A scenario has few arrays, and each frame asks for them for every path.
@lru_cache(maxsize=256)
def _grid(array: AntennaArray) -> tuple[Float64Array, Float64Array]:
    """y of each column and z of each row [wavelengths]."""
    y: Float64Array = (
        np.arange(array.columns, dtype=np.float64) - (array.columns - 1) / 2
    ) * array.horizontal_spacing
    z: Float64Array = (
        (array.rows - 1) / 2 - np.arange(array.rows, dtype=np.float64)
    ) * array.vertical_spacing
    return y, z


@lru_cache(maxsize=256)
def _anchors(size: int, spacing: float) -> tuple[Complex128Array, int]:
    """j2π times places [wavelengths]: of the groups, relative to the first one, and of its elements; and the
    number of groups. Of a short axis those of all elements, and 0."""
    groups = -(-size // FINE) if size > 2 * FINE else 0
    places = (np.arange(FINE if groups else size) - (size - 1) / 2) * spacing
    steps = np.arange(groups) * (FINE * spacing)
    return np.multiply(2j * np.pi, np.concatenate([steps, places]), dtype=np.complex128), groups


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


def facing(array: AntennaArray, direction: Sequence[float], polarization: int = 0) -> tuple[int, Subarray]:
    """The subarray of one polarization that faces a direction most, and its number among all."""
    parts, ports = subarrays(array), len(array.polarizations)
    # The panel whose boresight is nearest: the first coordinate is its cosine.
    number = max(range(polarization, len(parts), ports), key=lambda n: parts[n].towards(direction)[0])
    return number, parts[number]
