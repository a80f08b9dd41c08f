"""Antenna arrays: element positions, steering vectors, and the uniform subarrays that an array is a set of.

An array is a set of uniform subarrays: the elements of one panel and one polarization. Elements and beams are
both in order of the subarrays, so whatever is known of uniform arrays holds for each of these blocks.

One phase convention holds for the channel, the link and the agents. The element at ``r`` [wavelengths] sees
a plane wave of direction k̂ (unit vector from the array *towards* the other end, device axes) with the
phase ``exp(+j2π k̂·r)``: an element nearer to the other end has the shorter path and, with exp(−j2πfτ), the
larger phase. At both ends the same vector applies, so a single path of amplitude a has ``H = a · ar · atᵀ``
(Tse and Viswanath, Fundamentals of Wireless Communication, section 7.2, with directions taken from each
array outwards).

DFT beams of an antenna array: their vectors, where they point, and their gain, each by its formula.

The codebook ``dft`` (`caviar_protocol.space.codebooks`) is made of these.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import msgspec
import numpy as np

from caviar_protocol.arrays import Complex128Array, Float64Array
from caviar_protocol.errors import PayloadError
from caviar_protocol.space.coordinates import (
    UnitQuaternion,
    Vector,
    quaternion_from_euler,
    rotation_matrix,
    unrotated,
)
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


def dft_codebook(array: AntennaArray) -> Complex128Array:
    """Compute all beams of an array.

    Of a uniform array, beam ``k`` combines row beam ``k % rows`` and column beam ``k // rows``, in the order
    of the elements: the Kronecker product of two DFT matrices with entries
    ``exp(+j2πkn/N)/sqrt(N)`` (Tse and Viswanath, section 7.3.4).

    Args:
        array: The array, uniform or of several panels or polarizations.

    Returns:
        Shape ``[N, N]``: beam ``k`` is row ``k``, of norm 1.

    Example:
        >>> dft_codebook(AntennaArray(rows=1, columns=2)).real.round(3).tolist()
        [[0.707, 0.707], [0.707, -0.707]]
    """
    columns, rows = _dft(array.columns), _dft(array.rows)
    size = array.rows * array.columns
    uniform: Complex128Array = np.einsum("ac,br->abcr", columns, rows).reshape(size, size)
    if array.is_uniform:
        return uniform
    # Block by block: a beam has the elements of one panel and one polarization, the others are silent.
    codebook = np.zeros((array.size, array.size), np.complex128)
    for begin in range(0, array.size, size):
        codebook[begin : begin + size, begin : begin + size] = uniform
    return codebook


def dft_beam(array: AntennaArray, beam: int) -> Complex128Array:
    """Compute one row of `dft_codebook` without the others: N numbers instead of N².

    Args:
        array: The array.
        beam: Index of the beam.

    Returns:
        Shape ``[N]``, of norm 1.

    Example:
        >>> dft_beam(AntennaArray(rows=1, columns=2), 1).real.round(3).tolist()
        [0.707, -0.707]
    """
    part, own = subarray_of(array, beam)
    column, row = divmod(own, array.rows)
    vector = np.zeros(array.size, np.complex128)
    vector[part.elements] = np.multiply.outer(_dft(array.columns)[column], _dft(array.rows)[row]).ravel()
    return vector


@lru_cache(maxsize=64)
def _dft(size: int) -> Complex128Array:
    """Unitary matrix with entry (k, n) = exp(+j2πkn/N)/sqrt(N)."""
    n = np.arange(size)
    # k·n is reduced modulo N first, so that the phase of large codebooks keeps full precision.
    matrix: Complex128Array = np.exp(2j * np.pi * (np.outer(n, n) % size) / size) / math.sqrt(size)
    return matrix


def pointing_directions(array: AntennaArray, beam: int) -> Float64Array:
    """Find the directions in which a beam has its full gain ``sqrt(N)``.

    Only the half space in front of the array, or of the beam's panel, (x ≥ 0) is listed; an array is blind to
    the sign of x. Along an axis with a single element the beam is a fan, of which the centre is given.
    L > 1 where there are grating lobes (spacing ≥ λ/2), nearest to boresight first; L = 0 for a
    beam without a real direction (spacing < λ/2).

    Args:
        array: The array.
        beam: Index of the beam.

    Returns:
        Unit vectors in device axes, Shape ``[L, 3]``.

    Raises:
        PayloadError: The codebook has no such beam.

    Example:
        >>> pointing_directions(AntennaArray(rows=1, columns=4), 1).round(3).tolist()
        [[0.866, 0.5, -0.0]]
    """
    if not 0 <= beam < array.size:
        raise PayloadError(f"beam {beam} does not exist, the codebook has beams 0 to {array.size - 1}")
    if not array.is_uniform:
        part, own = subarray_of(array, beam)
        return pointing_directions(part.array, own) @ rotation_matrix(part.orientation).T
    along_y = _axis_cosines(array.columns, beam // array.rows, array.horizontal_spacing)
    along_z = [-u for u in _axis_cosines(array.rows, beam % array.rows, array.vertical_spacing)]
    found = [
        (math.sqrt(max(0.0, 1 - y * y - z * z)), y, z)
        for y, z in itertools.product(along_y, along_z)
        if y * y + z * z <= 1
    ]
    found.sort(key=lambda vector: (-vector[0], vector[1], vector[2]))
    return np.array(found, dtype=np.float64).reshape(-1, 3)


def _axis_cosines(size: int, beam: int, spacing: float) -> list[float]:
    """Direction cosines u within ±1 with ``spacing·u = beam/size`` modulo 1."""
    if size == 1:
        return [0.0]
    # |u| ≤ 1 bounds the number of whole turns that the phase between two elements may have more.
    lowest = math.ceil(-spacing - beam / size)
    highest = math.floor(spacing - beam / size)
    return [(beam / size + turn) / spacing for turn in range(lowest, highest + 1)]


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
    _, faced = facing(array, direction, polarization)
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


def _factor(size: int, v: Float64Array) -> Float64Array:
    v = v - np.round(v)
    sine = np.sin(np.pi * v)
    # At its maxima the array factor is 0/0.
    peak = np.abs(sine) < 1e-9
    factor: Float64Array = np.where(
        peak, 1.0, np.abs(np.sin(np.pi * size * v)) / (size * np.abs(np.where(peak, 1.0, sine)))
    )
    return factor
