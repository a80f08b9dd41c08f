"""Arrays of ``baseline_data``, which the ITU challenge made of its raw data for training."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from caviar_protocol.arrays import Float64Array

TRAINING = {
    "beams": ("beam_output/beams_output_{}.npz", "output_classification"),
    "coord": ("coord_input/coord_{}.npz", "coordinates"),
    "lidar": ("lidar_input/lidar_{}.npz", "input"),
    "img": ("image_input/img_input_{}_20.npz", "inputs"),
}
"""Files by what is in them, with the key of their array."""
INPUTS = (48, 81, 1)
"""Shape of the pictures of an instant: each of the three is 48 × 27."""

_GRAY = (0.299, 0.587, 0.114)  # of ITU-R BT.601


def picture_inputs(pictures: Sequence[Any]) -> Any:
    """Reduce the pictures of an instant as the challenge does: gray, means of areas, sharpened.

    Args:
        pictures: Red, green and blue, Shape ``[H, W, 3]`` each.

    Returns:
        uint8, Shape ``[48, 27·pictures, 1]``; what sharpening brings out of 0 to 255 wraps around, as in the
        challenge's own files.
    """
    found = []
    for rgb in pictures:
        gray = np.floor(rgb @ np.array(_GRAY) + 1e-9)  # libpng, through which OpenCV reads, cuts off
        means = np.round(_areas(gray.shape[0], INPUTS[0]) @ gray @ _areas(gray.shape[1], 27).T)
        beside = np.pad(means, 1)
        beside = beside[:-2, 1:-1] + beside[2:, 1:-1] + beside[1:-1, :-2] + beside[1:-1, 2:]
        found.append((2 * means - beside / 4).astype(np.int64).astype(np.uint8))
    return np.concatenate(found, axis=1)[..., None]


def _areas(pixels: int, cells: int) -> Float64Array:
    """Share of each pixel in the mean of each cell along an axis, Shape ``[cells, pixels]``."""
    edges = np.arange(cells + 1) * pixels / cells
    start, stop = edges[:-1, None], edges[1:, None]
    at = np.arange(pixels)
    shares: Float64Array = np.clip(np.minimum(stop, at + 1) - np.maximum(start, at), 0, 1)
    return shares * (cells / pixels)


def join_arrays(shards: Sequence[Path], file: Path, key: str) -> None:
    """Write the arrays of several files, one after the other along axis 0, as an archive of one.

    Args:
        shards: ``.npy`` of one type and one shape of rows.
        file: The archive.
        key: Name of its array.
    """
    arrays = [np.load(shard, mmap_mode="r") for shard in shards]
    header = {
        "descr": np.lib.format.dtype_to_descr(arrays[0].dtype),
        "fortran_order": False,
        "shape": (sum(map(len, arrays)), *arrays[0].shape[1:]),
    }
    file.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(file, "w") as archive, archive.open(f"{key}.npy", "w", force_zip64=True) as out:
        np.lib.format.write_array_header_1_0(out, header)
        for array in arrays:
            out.write(array.tobytes())
