"""Decompression with a bound: a few bytes of a file from elsewhere must not take all memory."""

from __future__ import annotations

from importlib import import_module

FREE_SIZE = 64 << 20
"""[B] that compressed data may always expand to."""
EXPANSION = 1000
"""Above, how much larger than the compressed data the result may be."""


def may_expand(size: int, expanded: int) -> bool:
    """Whether data of ``size`` bytes may declare that they expand to ``expanded`` bytes."""
    return expanded <= max(FREE_SIZE, EXPANSION * size)


def expand(compression: str, data: memoryview, size: int, limit: int = 0) -> bytes:
    """Decompress, without ever holding more than was declared.

    Parameters
    ----------
    compression
        ``zstd`` or ``lz4``, as MCAP names them.
    data
        The compressed bytes.
    size
        The size that they declare [B], to be checked with `may_expand` before.
    limit
        Only so many bytes from the beginning; 0: all.

    Raises
    ------
    ValueError
        They cannot be decompressed, or not to the declared size.
    """
    wanted = min(limit, size) if limit else size + 1  # one more shows that there are more
    if compression == "zstd":
        found = _zstd(data, wanted)
    elif compression == "lz4":
        found = _lz4(data, wanted)
    else:
        raise ValueError(f"compression {compression!r} is unknown; known: zstd, lz4")
    if len(found) != (min(limit, size) if limit else size):
        raise ValueError(f"it has {len(found)} B or more, and declares {size} B")
    return found


def _zstd(data: memoryview, wanted: int) -> bytes:
    import zstandard

    try:
        # A stream, since the one-shot function allocates what the data claim.
        with zstandard.ZstdDecompressor().stream_reader(data, read_across_frames=False) as stream:
            return stream.read(wanted)
    except zstandard.ZstdError as error:
        raise ValueError(str(error)) from error


def _lz4(data: memoryview, wanted: int) -> bytes:
    try:
        found: bytes = import_module("lz4.frame").LZ4FrameDecompressor().decompress(data, max_length=wanted)
    except RuntimeError as error:
        raise ValueError(str(error)) from error
    return found
