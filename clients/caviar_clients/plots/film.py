"""Writers of video files: an animated GIF by Pillow, an MP4 by an ``ffmpeg`` of the machine.

Pictures are made while they are written, so that a video of any length takes the memory of one.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from caviar_clients.files import writing
from caviar_protocol.arrays import Int64Array, UInt8Array
from caviar_protocol.errors import RunError, SetupError


@dataclass(frozen=True, eq=False)
class Reel:
    """Pictures of a video.

    Args:
        pictures: In sRGB, Shape ``[height, width, 3]``, all of the same even size; made while they are
            written.
        count: Number of pictures.
        fps: Pictures a second.
        samples: At least one of the pictures, for their size and colours.
        keys: Colours that a palette has whatever else there is, Shape ``[K, 3]``.
    """

    pictures: Iterable[UInt8Array]
    count: int
    fps: float
    samples: Sequence[UInt8Array]
    keys: UInt8Array


Writer = Callable[[Reel, Path], None]

GIF_FPS = 50
"""Viewers slow down a GIF that is faster: its unit is 10 ms, and they take 1 for unset."""

# Colours of a palette differ from its key colours by more than this in some channel.
_APART = 8

# The best first, with what sets their quality; a build of ffmpeg has the third at least.
_ENCODERS = (
    ("libx264", ("-crf", "20", "-preset", "medium", "-tune", "animation")),
    ("libopenh264", ("-b:v", "6M")),
    ("mpeg4", ("-q:v", "3")),
)


def find_ffmpeg() -> str | None:
    """Find the machine's ``ffmpeg``, or else that of the package ``imageio-ffmpeg``; None without either."""
    found = shutil.which("ffmpeg")
    if found is None:
        try:
            found = str(import_module("imageio_ffmpeg").get_ffmpeg_exe())
        except (ModuleNotFoundError, RuntimeError):
            return None
    return found


def needed_ffmpeg(file: Path) -> str:
    """Find ``ffmpeg`` for a file.

    Raises:
        SetupError: There is none; the error has the command that installs it.
    """
    found = find_ffmpeg()
    if found is None:
        raise SetupError(
            f"{file} needs ffmpeg, which is not installed; run: apt-get install ffmpeg (or: pip install "
            f"imageio-ffmpeg), or write {file.with_suffix('.gif').name} instead"
        )
    return found


def write_gif(reel: Reel, file: Path) -> None:
    """Write an endless animated GIF with one palette for all pictures.

    Args:
        reel: The pictures.
        file: GIF that is written.

    Raises:
        RunError: The file cannot be written; then there is none.
    """
    from PIL import Image

    # One palette, without dithering: a palette for each picture makes areas of one colour flicker, and
    # dithering makes noise of them, which LZW does not compress.
    palette = _palette(reel)
    images = (
        Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE)
        for picture in reel.pictures
    )
    with _part_of(file) as part:
        next(images).save(
            part, format="GIF", save_all=True, append_images=images, loop=0,
            duration=durations_ms(reel.fps, reel.count),
        )  # fmt: skip


def _palette(reel: Reel) -> Any:
    """Make an image with a palette of the key colours and those that are most frequent in the samples."""
    from PIL import Image

    pixels = np.concatenate(reel.samples).reshape(-1, 3)
    # The background is most of a picture and would take most of the palette.
    other = pixels[~np.isin(_cells(pixels), _cells(reel.keys))]
    sheet = Image.fromarray((other if len(other) else pixels)[None])
    rest = sheet.quantize(256 - len(reel.keys), method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    found = np.array(rest.getpalette(), np.int64).reshape(-1, 3)
    # Pillow looks up colours in steps of 4: one beside a key colour would be taken in its place.
    apart = np.abs(found[:, None] - reel.keys).max(axis=2).min(axis=1) > _APART
    colours = np.concatenate([reel.keys, found[apart], np.repeat(reel.keys[:1], 256, axis=0)])[:256]
    palette = Image.new("P", (1, 1))
    palette.putpalette(colours.astype(np.uint8).tobytes())
    return palette


def _cells(colours: UInt8Array) -> Int64Array:
    """Number colours so that those that hardly differ have the same number, Shape ``[N, 3]`` to ``[N]``."""
    # Cubes of 8 levels a side, 32 of them a channel.
    cells: Int64Array = (colours >> 3).astype(np.int64) @ np.array([1 << 10, 1 << 5, 1])
    return cells


def write_mp4(reel: Reel, file: Path) -> None:
    """Write an MP4 that browsers and slides play: H.264 where ffmpeg has it, planes of 4:2:0.

    Args:
        reel: The pictures.
        file: MP4 that is written.

    Raises:
        SetupError: There is no ffmpeg.
        RunError: It fails; the error has its last line. Then there is no file.
    """
    ffmpeg = needed_ffmpeg(file)
    height, width, _ = reel.samples[0].shape
    with _part_of(file) as part, tempfile.TemporaryFile() as log:
        command = [
            ffmpeg, "-hide_banner", "-loglevel", "error", "-y",
            "-f", "rawvideo", "-pixel_format", "rgb24", "-video_size", f"{width}x{height}",
            "-framerate", f"{reel.fps:g}", "-i", "-", *_encoder(ffmpeg), "-pix_fmt", "yuv420p",
            # The index first, so that a browser plays before it has the whole file.
            "-movflags", "+faststart", "-f", "mp4", str(part.resolve()),
        ]  # fmt: skip
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=log, stderr=log)  # noqa: S603  # as above
        try:
            _feed(process, reel.pictures)
        except BaseException:
            process.kill()
            process.wait()
            raise
        if process.wait():
            log.seek(0)
            said = log.read().decode(errors="replace").strip().rpartition("\n")[2]
            raise RunError(f"ffmpeg could not write {file}: {said or f'status {process.returncode}'}")


def _feed(process: subprocess.Popen[bytes], pictures: Iterable[UInt8Array]) -> None:
    """Write all pictures to ffmpeg; if that ends early, its status says so afterwards."""
    pipe = process.stdin
    if pipe is None:
        return
    with suppress(BrokenPipeError), pipe:
        for picture in pictures:
            pipe.write(picture.tobytes())


def _encoder(ffmpeg: str) -> list[str]:
    """Choose the best encoder of a build of ffmpeg, and return its options."""
    listed = subprocess.run(  # noqa: S603  # our own arguments
        [ffmpeg, "-hide_banner", "-encoders"], capture_output=True, text=True, check=False
    ).stdout
    for name, options in _ENCODERS:
        if f" {name} " in listed:
            return ["-c:v", name, *options]
    return []


@contextmanager
def _part_of(file: Path) -> Iterator[Path]:
    """Yield a place beside ``file`` to write to; it becomes ``file`` if the block ends well."""
    # A video that is watched while it is made anew, or whose making is stopped, stays whole.
    part = file.with_name(f".{file.name}.part")
    with writing(file):
        try:
            yield part
            part.replace(file)
        finally:
            part.unlink(missing_ok=True)


def durations_ms(fps: float, count: int) -> list[int]:
    """Compute how long each picture is shown [ms], in multiples of 10 that are right on average.

    Example:
        >>> durations_ms(30.0, 3)
        [30, 40, 30]
    """
    ends = [round(100 * number / fps) for number in range(count + 1)]
    return [10 * (end - start) for start, end in pairwise(ends)]


WRITERS: dict[str, Writer] = {".mp4": write_mp4, ".gif": write_gif}
"""Writers by the suffix of the file."""
