"""``caviar plot video``: a recording as a film."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TaskID, TimeRemainingColumn

from caviar_clients.cli.plot import agent_names, choose_camera, map_data, scenery
from caviar_clients.cli.shared import progress_bar
from caviar_clients.files import file_in, make_folder_of
from caviar_clients.plots.film import GIF_FPS, WRITERS, Reel, find_ffmpeg, needed_ffmpeg
from caviar_clients.plots.map import Mark, View, chosen_beam, receiver_mark, view_of
from caviar_clients.plots.moving import MovingMap, Plan, key_colours
from caviar_clients.plots.rays import rays, scale
from caviar_clients.plots.style import common_prefix
from caviar_clients.plots.user_curves import UserSeries, choose_user, series
from caviar_protocol.arrays import UInt8Array
from caviar_protocol.errors import RecordingError, SetupError
from caviar_protocol.recording import RecordedFrame, Recording
from caviar_protocol.space.scene import antennas
from caviar_protocol.topics import Camera

SLOWEST, FASTEST = 5.0, 30.0
"""Frames a second where none are asked for: simulated time, within these."""
_WIDTHS = {".mp4": 1280, ".gif": 960}
# Pictures whose colours become a GIF's palette.
_SAMPLES = 6

User = tuple[str, str, str]


@dataclass(frozen=True)
class Film:
    """A video that was written."""

    file: Path
    frames: int
    fps: float
    """Frames shown a second."""
    speed: float
    """Simulated time over playing time."""
    size: tuple[int, int]
    """Width and height [pixels]."""


def film_run(
    run: Path,
    out: Path | None = None,
    fps: float | None = None,
    frames: str | None = None,
    camera: str | None = None,
    width: int | None = None,
    user: str | None = None,
    console: Console | None = None,
) -> Film:
    """Make a video of a recording: the map, |y| of one user, and what a camera saw.

    Args:
        run: Run directory or segment.
        out: File, whose suffix says the format: ``.mp4``, which needs ffmpeg, or ``.gif``. By default
            ``video.mp4`` in the run directory where there is ffmpeg, ``video.gif`` where not.
        fps: Frames shown a second; by default as fast as simulated time, but from 5 to 30.
        frames: ``A:B``, frames A to B − 1 of the first episode, either may be left out; by default all
            frames of all episodes. Frames without a scene are left out.
        camera: Camera whose pictures are shown; by default the first, of those that are fixed if there are
            any.
        width: Pixels, even; by default 1280, and 960 of a GIF.
        user: Receiver, or its object, for |y| and the beam; by default the one that was there longest.
        console: Where progress is shown; by default nowhere.

    Raises:
        RecordingError: It is not a recording, or frames, camera or user are not in it.
        SetupError: Matplotlib or ffmpeg is missing, or format, speed and width do not go together.
        RunError: The file cannot be written; there is none then, not even half of one.
    """
    recording = Recording(run)
    file = out or recording.directory / ("video.mp4" if find_ffmpeg() else "video.gif")
    suffix = file.suffix.lower()
    rate, pixels = _format(file, suffix, fps, width, recording.metadata.sampling_period_ns)
    chosen = choose_user(recording, user or "") if "link" in recording.topics else None
    survey = _survey(recording, _indices(recording, frames), chosen, camera)
    make_folder_of(file)
    # Frames pass one by one, twice: limits and scales of the first pass hold in all pictures of the second.
    moving = MovingMap(survey.plan, pixels)
    count = len(survey.indices)
    spread = sorted({round(i) for i in np.linspace(0, count - 1, min(_SAMPLES, count))})
    samples = list(_pictures(recording, survey, moving, chosen, spread)) if suffix == ".gif" else []
    samples = samples or list(_pictures(recording, survey, moving, chosen, spread[:1]))
    columns = (MofNCompleteColumn(), TimeRemainingColumn())
    with progress_bar(console or Console(quiet=True), *columns) as bar:
        task = bar.add_task("drawing", total=count)
        drawn = _counted(_pictures(recording, survey, moving, chosen, range(count)), bar, task)
        WRITERS[suffix](Reel(drawn, count, rate, samples, key_colours()), file)
    speed = rate * recording.metadata.sampling_period_ns * 1e-9
    return Film(file, count, rate, speed, moving.size)


def _format(
    file: Path, suffix: str, fps: float | None, width: int | None, period_ns: int
) -> tuple[float, int]:
    """Frames a second and width [pixels]."""
    if suffix not in WRITERS:
        what = f"ends in {suffix!r}, which is no format of a video" if suffix else "has no suffix"
        if file.is_dir():
            raise SetupError(f"{file} {file_in(file, 'video.mp4')} or .gif")
        raise SetupError(f"{file} {what}; write .mp4 or .gif")
    if suffix == ".mp4":
        needed_ffmpeg(file)
    # A GIF that is faster is slowed down by viewers (`GIF_FPS`).
    rate = min(max(1e9 / period_ns, SLOWEST), FASTEST) if fps is None else fps
    if not 0 < rate <= (GIF_FPS if suffix == ".gif" else 240):
        raise SetupError(f"--fps is {rate:g}; write more than 0 and at most 50 for a GIF, 240 for an MP4")
    pixels = _WIDTHS[suffix] if width is None else width
    if not 320 <= pixels <= 3840 or pixels % 2:
        raise SetupError(f"--width is {pixels}; write an even number from 320 to 3840")
    return rate, pixels


def _indices(recording: Recording, frames: str | None) -> list[int]:
    """Places in the recording of the frames that are asked for."""
    if frames is None:
        return list(range(len(recording)))
    numbers = [entry.frame for i in range(len(recording)) if (entry := recording.entry(i)).episode == 0]
    has = (
        f"{recording.path} has frames {min(numbers)} to {max(numbers)} of its first episode"
        if numbers
        else (f"{recording.path} has no frame of a first episode; leave out --frames")
    )
    match = re.fullmatch(r"(\d*):(\d*)", frames)
    if match is None:
        raise RecordingError(f"--frames is {frames!r}; write A:B for frames A to B - 1; {has}")
    first, stop = int(match[1] or 0), int(match[2]) if match[2] else max(numbers, default=0) + 1
    found = [i for i, number in enumerate(numbers) if first <= number < stop]
    if not found:
        raise RecordingError(f"--frames is {frames!r}, in which there is no frame; {has}")
    return found


@dataclass(frozen=True, eq=False)
class _Survey:
    """What a first look at the frames found."""

    indices: list[int]
    plan: Plan


def _survey(recording: Recording, indices: Sequence[int], user: User | None, camera: str | None) -> _Survey:
    ground, kept = scenery(recording), []
    views: list[View] = []
    gains: list[tuple[float, float]] = []
    aspects: dict[str, float] = {}
    kinds: set[bool] = set()
    marks: set[Mark] = set()
    names: set[str] = set()
    has_ticks = has_beam = False
    for index in indices:
        frame = RecordedFrame(recording, index)
        for sensor, picture in _seen(frame).items():
            aspects.setdefault(sensor, picture.shape[0] / picture.shape[1])
        data = map_data(recording, frame, user, None)
        if data is None:
            continue
        kept.append(index)
        beam, found = chosen_beam(data), rays(data.scene, data.channel)
        views.append(view_of(data, beam))
        if len(found.all_gains):
            gains.append(scale(found.all_gains))
        # What any frame has is in the key of the film, which is drawn once.
        has_ticks |= bool(len(found.tick_gains))
        has_beam |= beam is not None
        carriers = {device.parent for device in data.scene.devices}
        marks |= {receiver_mark(data.link, device.name) for device in antennas(data.scene, "rx")}
        kinds |= {name in carriers for name in data.scene.names}
        names |= set(data.scene.names)
    if not kept:
        raise RecordingError(f"{recording.path} holds no scene in these frames, so there is no map to draw")
    shown = choose_camera(aspects, camera, f"these frames of {recording.path} hold")
    plan = Plan(
        view=_union(views),
        gains_db=scale(np.array(gains).ravel()) if gains else None,
        has_ticks=has_ticks,
        has_beam=has_beam,
        kinds=frozenset(kinds),
        receivers=frozenset(marks),
        prefix=common_prefix(sorted(names)),
        user="" if user is None else user[1].split("/")[0],
        footprints=ground,
        series=None if user is None else _cut(series(recording, user), kept),
        agent=agent_names(recording),
        camera=shown,
        aspect=aspects.get(shown or "", 0.75),
    )
    return _Survey(kept, plan)


def _seen(frame: RecordedFrame) -> dict[str, UInt8Array]:
    """Pictures by camera."""
    payloads = frame.payloads("camera", Camera).values()
    return {image.sensor: image.rgb for payload in payloads for image in payload.images}


def _union(views: Sequence[View]) -> View:
    limits = np.array(views)
    low, high = limits[..., 0].min(axis=0).tolist(), limits[..., 1].max(axis=0).tolist()
    return (low[0], high[0]), (low[1], high[1])


def _cut(data: UserSeries, indices: list[int]) -> UserSeries:
    arrays = {
        name: getattr(data, name)[indices]
        for name in ("time", "present", "has_path", "los", "abs_y", "best", "baseline", "theta")
    }
    return UserSeries(data.tx, data.rx, data.carrier, **arrays)


def _pictures(
    recording: Recording, survey: _Survey, moving: MovingMap, user: User | None, steps: Sequence[int]
) -> Iterator[UInt8Array]:
    """Pictures of some steps of the survey; a camera that saw nothing in a frame keeps its last picture."""
    # Cameras may see every n-th frame: between two pictures the earlier one stands.
    last = None
    for step in steps:
        frame = RecordedFrame(recording, survey.indices[step])
        data = map_data(recording, frame, user, None)
        if survey.plan.camera is not None:
            last = _seen(frame).get(survey.plan.camera, last)
        if data is not None:
            yield moving.draw(data, step, last)


def _counted(pictures: Iterator[UInt8Array], bar: Progress, task: TaskID) -> Iterator[UInt8Array]:
    for picture in pictures:
        yield picture
        bar.advance(task)
