"""Arrays as Dr.Jit's LLVM kernels want them in memory."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from caviar_protocol.arrays import BoolArray, Float32Array, Float64Array, Int32Array, Int64Array


def aligned_columns(rows: Float64Array) -> Float32Array:
    """Rows as float32, Shape ``[R, N]``, each at a multiple of 64 bytes, with room behind it.

    Dr.Jit computes in NumPy's memory where it can, whole vectors of up to 64 bytes at a time, and
    compiles a kernel anew for each combination of arrays that happen to be aligned or not.
    """
    columns: Float32Array = _aligned(rows, np.dtype(np.float32))
    return columns


def aligned_doubles(rows: Float64Array) -> Float64Array:
    """Rows as float64, laid out like `aligned_columns`."""
    columns: Float64Array = _aligned(rows, np.dtype(np.float64))
    return columns


def aligned_indices(values: Int64Array | Int32Array | BoolArray) -> NDArray[np.uint32]:
    """Indices as uint32, Shape ``[N]``, laid out like `aligned_columns`."""
    column: NDArray[np.uint32] = aligned_columns(np.zeros((1, len(values)))).view(np.uint32)[0]
    column[...] = values
    return column


def several(count: int) -> Int64Array:
    """Indices of so many, a single one twice: to Dr.Jit an array of one element is another kernel."""
    return np.arange(count) if count > 1 else np.zeros(2 * count, np.int64)


def _aligned(rows: Float64Array, dtype: np.dtype[Any]) -> NDArray[Any]:
    count, size = rows.shape
    of_vector = 64 // dtype.itemsize
    stride = -(-size // of_vector) * of_vector
    buffer = np.zeros(count * stride + of_vector, dtype)
    start = (-buffer.ctypes.data % 64) // dtype.itemsize
    columns = buffer[start : start + count * stride].reshape(count, stride)[:, :size]
    columns[...] = rows
    return columns
