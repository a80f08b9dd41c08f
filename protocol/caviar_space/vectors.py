"""Vectors in arrays: cross products, unit vectors, and numbers of ranges."""

from __future__ import annotations

import numpy as np

from caviar_protocol.arrays import Float64Array, Int64Array


def cross(one: Float64Array, other: Float64Array) -> Float64Array:
    """Cross products of vectors of one shape, ``[…, 3]``.

    Example:
        >>> cross(np.array([[1.0, 0.0, 0.0]]), np.array([[0.0, 1.0, 0.0]])).tolist()
        [[0.0, 0.0, 1.0]]
    """
    # To the bit those of `numpy.cross`, in less than half of its time.
    product = np.empty(one.shape)
    for axis in range(3):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        product[..., axis] = one[..., i] * other[..., j] - one[..., j] * other[..., i]
    return product


def unit(vectors: Float64Array) -> Float64Array:
    """Unit vectors along vectors of any length but zero, Shape ``[…, 3]``.

    Example:
        >>> unit(np.array([[0.0, 3.0, 4.0]])).tolist()
        [[0.0, 0.6, 0.8]]
    """
    units: Float64Array = vectors / np.sqrt((vectors**2).sum(-1, keepdims=True))
    return units


def ranges(begin: Int64Array, sizes: Int64Array) -> tuple[Int64Array, Int64Array]:
    """All numbers of N ranges, one range after the other.

    Args:
        begin: First number of each range, Shape ``[N]``.
        sizes: Count of numbers of each range, Shape ``[N]``.

    Returns:
        The range that each number is of, and the numbers.

    Example:
        >>> [part.tolist() for part in ranges(np.array([5, 0]), np.array([2, 3]))]
        [[0, 0, 1, 1, 1], [5, 6, 0, 1, 2]]
    """
    own = np.repeat(np.arange(len(begin)), sizes)
    return own, np.arange(len(own)) - np.repeat(np.cumsum(sizes) - sizes - begin, sizes)
