"""Uniform antenna arrays: element positions, steering vectors and DFT codebooks.

An array with dual polarization or several panels is a set of these (`caviar_protocol.space.beams`).

One phase convention holds for the channel, the link and the agents. The element at ``r`` [wavelengths] sees
a plane wave of direction k̂ (unit vector from the array *towards* the other end, device axes) with the
phase ``exp(+j2π k̂·r)``: an element nearer to the other end has the shorter path and, with exp(−j2πfτ), the
larger phase. At both ends the same vector applies, so a single path of amplitude a has ``H = a · ar · atᵀ``
(Tse and Viswanath, Fundamentals of Wireless Communication, section 7.2, with directions taken from each
array outwards).

Beam ``k`` of an array is a unit-norm vector c_k in element order. It is matched to waves from the direction
it points to: a receiver combines with ``w = c_k``, a transmitter precodes with ``f = conj(c_k)``, so that
one index means one direction at both ends. With eq. (1) of the paper, ``y = w* H f``, a single path of
amplitude a that lies on both grids gives ``|y| = sqrt(Nr·Nt)·|a|``. The codebook of an array with several
subarrays is that of each of them, block by block: a beam has the elements of one panel and one
polarization. |y| of all pairs (`space.beams.beam_gains`) is a Fourier transform, without a codebook;
`tests/unit/test_link_beam_sweep_search.py` holds the two against each other.
"""

from __future__ import annotations

import itertools
import math
from functools import lru_cache

import numpy as np

from caviar_protocol.arrays import Complex128Array, Float64Array
from caviar_protocol.errors import PayloadError
from caviar_protocol.space.beams import subarray_of
from caviar_protocol.space.coordinates import rotation_matrix
from caviar_protocol.topics.scene import AntennaArray


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
