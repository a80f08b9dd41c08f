"""Arrays in the body of a product: where they lie, and how they are read back safely.

Arrays follow each other in the order in which their references stand in the header, each at
the next multiple of 8 bytes; what lies between is zero.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from caviar_protocol import limits
from caviar_protocol.arrays import MAX_DIMENSIONS, WIRE_DTYPES
from caviar_protocol.errors import DecodeError, LimitError, PayloadError

ALIGNMENT = 8
"""[B] Offsets are multiples of this."""

_VIEWED = 1 << 16
"""[B] Arrays from this size on are copied once, into the body; of smaller ones a view costs more."""


_CODES = {dtype: code for code, dtype in WIRE_DTYPES.items()}


class BodyWriter:
    """Lays arrays behind each other."""

    def __init__(self) -> None:
        self._chunks: list[bytes | memoryview] = []
        self.length = 0

    def place(self, value: NDArray[Any]) -> dict[str, Any]:
        """Append an array; returns the reference that stands for it in the header."""
        code = _CODES.get(value.dtype)
        if code is None:
            dtype = value.dtype.newbyteorder("<")
            if dtype not in _CODES:
                raise PayloadError(f"dtype {dtype.str} cannot travel; one of {', '.join(WIRE_DTYPES)}")
            code, value = _CODES[dtype], value.astype(dtype)
        if value.ndim > MAX_DIMENSIONS:
            raise PayloadError(f"{value.ndim} dimensions cannot travel, at most {MAX_DIMENSIONS}")
        is_viewed = value.nbytes >= _VIEWED and value.flags.c_contiguous
        data = value.reshape(-1).view(np.uint8).data if is_viewed else value.tobytes()
        padding = -self.length % ALIGNMENT
        if padding:
            self._chunks.append(bytes(padding))
        offset = self.length + padding
        self._chunks.append(data)
        self.length = offset + len(data)
        return {"dtype": code, "shape": value.shape, "offset": offset}

    def body(self) -> bytes:
        """All arrays so far."""
        return b"".join(self._chunks)


class BodyReader:
    """Gives out read-only views into a body, each behind the one before."""

    def __init__(self, body: memoryview) -> None:
        self._body = body
        self._end = 0

    def take(self, reference: Any) -> NDArray[Any]:
        """The array that ``reference`` points to.

        Raises `DecodeError` or `LimitError` unless it is well-formed and lies in the body, behind
        the arrays taken before.
        """
        code, shape, offset = _reference(reference)
        dtype, count, room = WIRE_DTYPES[code], 1, 1
        for size in shape:
            count *= size
            room *= size or 1
        if room > limits.MAX_BODY:
            raise DecodeError(f"array shape {shape} is larger than any body")
        end = offset + count * dtype.itemsize
        if end > len(self._body):
            raise DecodeError(
                f"array of shape {shape} and dtype {code} at offset {offset} ends at byte {end} "
                f"of a body of {len(self._body)} B"
            )
        if offset < self._end:
            raise DecodeError(f"array at offset {offset} overlaps the one before, which ends at {self._end}")
        self._end = end
        array: NDArray[Any] = np.ndarray(shape, dtype, self._body, offset)
        if code == "|b1" and bytes(self._body[offset:end]).strip(b"\0\1"):
            raise DecodeError("a |b1 array holds a byte other than 0 and 1")
        return array


def _reference(reference: Any) -> tuple[str, list[int], int]:
    """Fields of an array reference, each checked by itself."""
    try:
        code, shape, offset = reference["dtype"], reference["shape"], reference["offset"]
    except (TypeError, KeyError, IndexError):
        raise DecodeError("an array is a map with dtype, shape and offset") from None
    if type(code) is not str or code not in WIRE_DTYPES:
        raise DecodeError(f"array dtype {code!r:.40} is not one of {', '.join(WIRE_DTYPES)}")
    if type(shape) is not list:
        raise DecodeError(f"array shape {shape!r:.80} is not a list of sizes")
    for size in shape:
        if type(size) is not int or not 0 <= size <= limits.MAX_BODY:
            raise DecodeError(f"array shape {shape!r:.80} is not a list of sizes")
    if len(shape) > MAX_DIMENSIONS:
        raise LimitError(f"array has {len(shape)} dimensions, at most {MAX_DIMENSIONS} are accepted")
    if type(offset) is not int or offset < 0 or offset % ALIGNMENT:
        raise DecodeError(f"array offset {offset!r:.40} is not a multiple of {ALIGNMENT}")
    return code, shape, offset
