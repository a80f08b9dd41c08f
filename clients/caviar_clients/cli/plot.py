"""``caviar plot`` and ``caviar plot video``: pictures of a recording, and a film."""

from __future__ import annotations

import difflib
import io
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import MofNCompleteColumn, TimeRemainingColumn

from caviar_clients.cli.page import opened_page
from caviar_clients.cli.shared import progress_bar
from caviar_clients.files import file_in, make_folder_of, require_folder
from caviar_clients.plots.film import GIF_FPS, WRITERS, Reel, find_ffmpeg, needed_ffmpeg
from caviar_clients.plots.map import MapData, Mark, chosen_beam, draw_map, receiver_mark, view_of
from caviar_clients.plots.moving import MovingMap, Plan, key_colours
from caviar_clients.plots.packets import draw_traffic, packet_series
from caviar_clients.plots.rays import Footprints, View, footprints, obstacle_boxes, rays, scale, with_boxes
from caviar_clients.plots.sensors import CameraView, draw_grid, draw_scan, draw_view
from caviar_clients.plots.style import common_prefix, saved_files
from caviar_clients.plots.user_curves import (
    UserSeries,
    choose_user,
    draw_dispersion,
    draw_frequency_response,
    draw_over_angle,
    draw_over_time,
    has_users,
    series,
    user_paths,
)
from caviar_protocol.arrays import Float64Array, UInt8Array
from caviar_protocol.errors import RecordingError, SetupError
from caviar_protocol.recording import RecordedFrame, Recording
from caviar_protocol.space.antenna_arrays import steering_vector
from caviar_protocol.space.codebooks import codebook_of
from caviar_protocol.space.coordinates import rotation_matrix
from caviar_protocol.space.scene import antennas
from caviar_protocol.topics import AntennaArray, Camera, Channel, Depth, Lidar, Link, Segmentation
from caviar_services.channel.propagation.patterns import element_amplitude
from caviar_space.mitsuba_xml import find_scenery, read_scenery
from caviar_view.answers import Answers
from caviar_view.frames import RecordedFrames


def plot_run(
    run: Path,
    out: Path | None = None,
    frame: int | None = None,
    user: str | None = None,
    camera: str | None = None,
) -> list[Path]:
    """Draw what a recording holds, as PNG.

    Map; |y| over time and angle of arrival; where the link has packets, throughput, delay and drops of all
    receivers over time; a user's delay spread, K-factor, coherence and frequency response; LIDAR scan; images
    of a camera.

    Args:
        run: Run directory or segment.
        out: Folder of the pictures; the run directory by default.
        frame: Frame of the first episode for map, scan and images; by default the middle of those that have
            most to show.
        user: Receiver, or its object, for |y|, the beam and its paths; by default the one that was there
            longest.
        camera: Camera whose images are drawn, in files with its name; by default the first, of those that
            are fixed if there are any.

    Returns:
        The files, in the order map, |y|, traffic, dispersion, LIDAR, camera; in `style.paper_style` those
        for papers. What was not recorded is not drawn.

    Raises:
        RecordingError: It is not a recording, it holds nothing to draw, or frame, user or camera are not in
            it.
        SetupError: Matplotlib is not installed; the text has the command.
        RunError: A file cannot be written, or ``out`` is named as a file is.

    Example:
        >>> [file.name for file in plot_run(Path("runs/smoke-20261122-101500"), Path("pictures"))][:2]
        ['map.png', 'beams-over-time.png']
    """
    if out is not None:
        require_folder("--out", out, "pictures")
    recording = Recording(run)
    folder = out or recording.directory
    make_folder_of(folder / "map.png")  # before frames are read, which takes minutes of a long run
    topics = recording.topics
    with_users = user is not None or ("link" in topics and has_users(recording))
    chosen = choose_user(recording, user or "") if "link" in topics and with_users else None
    files: list[Path] = []
    if "scene" in topics:
        files.append(folder / "map.png")
        shown = _frame(recording, frame, "channel", chosen)
        data = map_data(recording, shown, chosen, scenery(recording))
        if data is None:
            raise RecordingError(f"frame {shown.number} has no scene; choose another with --frame")
        draw_map(data, files[-1])
    if chosen is not None:
        files += [folder / "beams-over-time.png", folder / "beams-over-angle.png"]
        curves, agent = series(recording, chosen), agent_names(recording)
        draw_over_time(curves, agent, files[-2])
        draw_over_angle(curves, agent, files[-1])
    packets = packet_series(recording) if chosen is not None else None
    if packets is not None:
        files.append(folder / "traffic.png")
        draw_traffic(packets, files[-1])
    paths = user_paths(recording, chosen) if "channel" in topics else None
    if paths is not None:
        files += [folder / "dispersion.png", folder / "frequency-response.png"]
        draw_dispersion(paths, files[-2])
        shown = _frame(recording, frame, "channel", chosen)
        draw_frequency_response(paths, (shown.episode, shown.number), moment(shown), files[-1])
    if "lidar" in topics:
        files.append(folder / "lidar.png")
        at = _frame(recording, frame, "lidar", chosen)
        _scan(at if frame is not None else _frame_with_points(recording, at), files[-1])
    seen = [topic for topic in ("camera", "depth", "segmentation") if topic in topics]
    if seen:
        shown = _frame(recording, frame, seen[0], chosen)
        view = camera_view(shown, camera)
        # Pictures of a camera that was asked for stand beside those of the others.
        stem = "camera" if camera is None else f"camera-{camera.replace('/', '-')}"
        files += draw_view(view, f"camera {view.sensor}, {moment(shown)}", folder, stem)
    elif camera is not None:
        raise RecordingError(f"{run} holds no images of a camera; leave out --camera")
    if not files:
        raise RecordingError(f"{run} holds nothing to draw: neither scene, link, lidar nor camera")
    return [made for file in files for made in saved_files(file)]


def beam_amplitude(array: AntennaArray, beam: int, directions: Float64Array) -> Float64Array:
    """Work out the amplitude of a codebook beam: ``|c_k* a(k̂)| / sqrt(N)`` times that of the element pattern.

    `caviar_protocol.space.codebooks.Codebook.gain` is the array factor alone.

    A pattern that comes from a file is left out.

    Args:
        array: Of the device; the beam is of one of its subarrays, of N elements.
        beam: Number k in the codebook of the array.
        directions: Unit vectors k̂ in device axes, Shape ``[N, 3]``.

    Returns:
        Amplitudes, Shape ``[N]``.
    """
    # A codebook of several panels numbers the beams of one panel after those of the other.
    part, own = codebook_of(array).part_of(beam)
    local = directions @ rotation_matrix(part.orientation)
    response = steering_vector(part.array, local) @ codebook_of(part.array).vector(own).conj()
    element = np.ones(len(local)) if array.pattern_file else element_amplitude(array.pattern, local)
    gain: Float64Array = np.abs(response) / np.sqrt(part.array.size) * element
    return gain


def map_data(
    recording: Recording,
    frame: RecordedFrame,
    user: tuple[str, str, str] | None,
    footprints: Footprints | None,
) -> MapData | None:
    """Collect what a map shows of a frame.

    Args:
        recording: Has the frame.
        frame: Which.
        user: Transmitter, receiver and carrier of the user whose beam is drawn; None: no beam.
        footprints: Of the scenery, as `scenery` finds them; None: none is drawn.

    Returns:
        None where the frame has no scene.
    """
    scene = frame.scene()
    if scene is None:
        return None
    return MapData(
        scene=scene,
        channel=next(iter(frame.payloads("channel", Channel).values()), None),
        link=next(iter(frame.payloads("link", Link).values()), None),
        footprints=footprints,
        beam_gain=beam_amplitude,
        user=user,
        title=f"{recording.metadata.name}: {moment(frame)}",
    )


def _scan(frame: RecordedFrame, file: Path) -> None:
    lidars = frame.payloads("lidar", Lidar)
    lidar = next((lidar for _, lidar in sorted(lidars.items()) if lidar.scans), None)
    if lidar is None:
        raise RecordingError(f"frame {frame.number} has no LIDAR scan; choose another with --frame")
    scan = lidar.scans[0]
    if not len(scan.ray) and scan.grid is not None:
        draw_grid(scan.grid, f"LIDAR {scan.sensor}, recorded as a grid: {moment(frame)}", file)
        return
    draw_scan(scan, lidar, frame.scene(), f"LIDAR {scan.sensor}: {moment(frame)}", file)


def camera_view(frame: RecordedFrame, camera: str | None) -> CameraView:
    """Collect all that one camera saw in a frame.

    Args:
        frame: Which.
        camera: Its name; None: the first, of those that are fixed if there are any.

    Raises:
        RecordingError: The camera saw nothing in the frame; the text has those that did.
    """
    topics: dict[str, type[Camera] | type[Depth] | type[Segmentation]] = {
        "camera": Camera,
        "depth": Depth,
        "segmentation": Segmentation,
    }
    found: dict[str, dict[str, Any]] = {}
    for topic, cls in topics.items():
        for _, payload in sorted(frame.payloads(topic, cls).items()):
            for image in payload.images:
                found.setdefault(image.sensor, {})[topic] = (payload, image)
    sensor = choose_camera(found, camera, f"frame {frame.number} has")
    if sensor is None:
        raise RecordingError(f"frame {frame.number} has no images; choose another with --frame")
    # A camera may have any of the three: colours, depth, labels.
    seen, scene = found[sensor], frame.scene()
    _, picture = seen.get("camera", (None, None))
    _, depth = seen.get("depth", (None, None))
    named, ids = seen.get("segmentation", (None, None))
    return CameraView(
        sensor=sensor,
        rgb=None if picture is None else picture.rgb,
        depth=None if depth is None else depth.depth,
        normals=None if depth is None else depth.normals,
        objects=None if ids is None else ids.object,
        object_names=() if named is None else named.object_names,
        materials=None if ids is None else ids.material,
        material_names=() if named is None else named.material_names,
        moving=frozenset() if scene is None else frozenset(scene.names),
    )


def choose_camera(known: Iterable[str], camera: str | None, where: str) -> str | None:
    """Choose the camera that is shown.

    Args:
        known: Names of cameras.
        camera: The one asked for; None: the first, of those that are fixed if there are any.
        where: What has no images of the camera, for the error.

    Returns:
        None where none is asked for and none is known.

    Raises:
        RecordingError: The camera is not known; the text has the near name and the known ones.

    Example:
        >>> choose_camera(["car/front", "pole"], None, "frame 0 has")
        'pole'
    """
    names = sorted(known)
    if camera is None:
        # A camera on an object is called after it, as in car/front.
        return min(names, key=lambda name: ("/" in name, name), default=None)
    if camera in names:
        return camera
    without = f"{where} no images of camera {camera!r}"
    if not names:
        raise RecordingError(f"{without}, nor of any other; leave out --camera")
    near = difflib.get_close_matches(camera, names, n=1)
    hint = f"did you mean {near[0]!r}? " if near else ""
    raise RecordingError(f"{without}; {hint}known: {', '.join(names)}")


def scenery(recording: Recording) -> Footprints | None:
    """Find what stands still in a recording: footprints of the scenery, and boxes that block a drawn channel.

    Returns:
        None where there is neither.
    """
    description = find_scenery(recording.assets)
    boxes = obstacle_boxes(recording.metadata.scenario.get("services"))
    drawn = None
    if description is not None:
        drawn = footprints((shape.file, shape.to_world) for shape in read_scenery(description).shapes)
    return with_boxes(drawn, boxes) if boxes else drawn


def _frame(
    recording: Recording, number: int | None, topic: str, user: tuple[str, str, str] | None
) -> RecordedFrame:
    """The frame asked for; else the middle one of those with the topic in which the user sees most."""
    if number is not None:
        return recording.frame(0, number)
    candidates = list(recording.frames())
    for wanted in ("scene", topic):
        with_topic = [
            frame
            for frame in candidates
            if any(entry.topic == wanted and entry.status in ("fresh", "held") for entry in frame.inputs)
        ]
        candidates = with_topic or candidates
    ranks = [_worth(frame, user) for frame in candidates]
    candidates = [frame for frame, rank in zip(candidates, ranks, strict=True) if rank == max(ranks)]
    return candidates[len(candidates) // 2]  # not the first, in which users have hardly moved


def _frame_with_points(recording: Recording, frame: RecordedFrame) -> RecordedFrame:
    """The frame, or the last one before it whose LIDAR scan has points (`points_every` of the LIDAR)."""
    until = [
        other
        for other in recording.frames()
        if (other.episode, other.number) <= (frame.episode, frame.number)
    ]
    scanned = (
        other
        for other in reversed(until)
        if any(len(scan.ray) for lidar in other.payloads("lidar", Lidar).values() for scan in lidar.scans)
    )
    return next(scanned, frame)


def _worth(frame: RecordedFrame, user: tuple[str, str, str] | None) -> int:
    """3: the user has a line of sight, 2: a path, 1: is there, 0: is not."""
    for link in frame.payloads("link", Link).values() if user is not None else ():
        users = list(zip(link.tx, link.rx, link.carrier, strict=True))
        if user in users:
            index = users.index(user)
            return 1 + int(link.has_path[index]) + int(link.has_path[index] and link.los[index])
    return 0


def agent_names(recording: Recording) -> str:
    """Name the agents of a recorded run by their implementations, for a legend."""
    services = recording.metadata.scenario.get("services")
    specs = services.values() if isinstance(services, dict) else ()
    used = sorted({str(s.get("use")) for s in specs if isinstance(s, dict) and s.get("role") == "agent"})
    return ", ".join(used) or "none"


def moment(frame: RecordedFrame) -> str:
    """Name a frame by its number and simulated time, and by its episode unless that is the first."""
    episode = f"episode {frame.episode}, " if frame.episode else ""
    return f"{episode}frame {frame.number}, t = {frame.t_ns * 1e-9:.2f} s"


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
    link: str | None = None,
) -> Film:
    """Make a video of a recording: the map, |y| of one user, and what a camera saw; or the viewer's page.

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
        link: To the page of ``caviar view``, or its part from ``#`` on: the page is shown, 16:9, as the link
            has it, without ``n``; None: the map is.

    Raises:
        RecordingError: It is not a recording, or frames, camera or user are not in it.
        SetupError: Matplotlib, ffmpeg or a browser is missing, or format, speed and width do not go together.
        RunError: The file cannot be written; there is none then, not even half of one.
    """
    recording = Recording(run)
    file = out or recording.directory / ("video.mp4" if find_ffmpeg() else "video.gif")
    suffix = file.suffix.lower()
    rate, pixels = _format(file, suffix, fps, width, recording.metadata.sampling_period_ns)
    indices = _indices(recording, frames)
    size = pixels, pixels * 9 // 32 * 2
    pictures: Callable[[Iterable[int]], Iterator[UInt8Array]]
    with ExitStack() as stack:
        if link is None:
            chosen = choose_user(recording, user or "") if "link" in recording.topics else None
            plan, indices = _survey(recording, indices, chosen, camera)
            # Frames pass one by one, twice: limits and scales of the first pass hold in all of the second.
            moving = MovingMap(plan, pixels)
            size = moving.size

            def pictures(steps: Iterable[int]) -> Iterator[UInt8Array]:
                # Cameras may see every n-th frame: between two pictures the earlier one stands.
                last = None
                for step in steps:
                    frame = RecordedFrame(recording, indices[step])
                    data = map_data(recording, frame, chosen, None)
                    if plan.camera is not None:
                        last = _seen(frame).get(plan.camera, last)
                    if data is not None:
                        yield moving.draw(data, step, last)
        elif user is not None or camera is not None:
            raise SetupError("user and cameras of the page are in its link; leave out --user and --camera")
        else:
            draw = stack.enter_context(opened_page(Answers(RecordedFrames(recording)), link, size))

            def pictures(steps: Iterable[int]) -> Iterator[UInt8Array]:
                return (_pixels(draw(indices[step])) for step in steps)

        make_folder_of(file)
        count = len(indices)
        spread = sorted({round(i) for i in np.linspace(0, count - 1, min(_SAMPLES, count))})
        samples = list(pictures(spread)) if suffix == ".gif" else []
        samples = samples or list(pictures(spread[:1]))
        columns = (MofNCompleteColumn(), TimeRemainingColumn())
        with progress_bar(console or Console(quiet=True), *columns) as bar:
            drawn = iter(bar.track(pictures(range(count)), total=count, description="drawing"))
            WRITERS[suffix](Reel(drawn, count, rate, samples, key_colours()), file)
    speed = rate * recording.metadata.sampling_period_ns * 1e-9
    return Film(file, count, rate, speed, size)


def _pixels(png: bytes) -> UInt8Array:
    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))


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


def _survey(
    recording: Recording, indices: Sequence[int], user: User | None, camera: str | None
) -> tuple[Plan, list[int]]:
    """Plan of the film from a first look at its frames, and the places of those that have a scene."""
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
    limits = np.array(views)
    low, high = limits[..., 0].min(axis=0).tolist(), limits[..., 1].max(axis=0).tolist()
    plan = Plan(
        view=((low[0], high[0]), (low[1], high[1])),
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
    return plan, kept


def _seen(frame: RecordedFrame) -> dict[str, UInt8Array]:
    """Pictures by camera."""
    payloads = frame.payloads("camera", Camera).values()
    return {image.sensor: image.rgb for payload in payloads for image in payload.images}


def _cut(data: UserSeries, indices: list[int]) -> UserSeries:
    arrays = {
        name: getattr(data, name)[indices]
        for name in ("time", "present", "has_path", "los", "abs_y", "best", "baseline", "theta")
    }
    return UserSeries(data.tx, data.rx, data.carrier, **arrays)
