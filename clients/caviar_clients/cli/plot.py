"""``caviar plot``: pictures of a recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from caviar_clients.plots.fig8 import choose_user, draw_over_angle, draw_over_time, series
from caviar_clients.plots.footprints import Footprints, footprints
from caviar_clients.plots.lidar import draw_scan
from caviar_clients.plots.map import MapData, draw_map
from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import RecordingError
from caviar_protocol.recording import RecordedFrame, Recording
from caviar_protocol.topics import AntennaArray, Channel, Lidar, Link
from caviar_services.antenna import steering_vector
from caviar_services.channel.patterns import radiated_field
from caviar_services.link.codebook import dft_codebook
from caviar_services.scenery import find_scenery, read_scenery


def plot_run(
    run: Path, out: Path | None = None, frame: int | None = None, user: str | None = None
) -> list[Path]:
    """Draw what a recording holds: a map, |y| over time and over the angle of arrival, a LIDAR scan.

    Parameters
    ----------
    run
        Run directory or segment.
    out
        Folder of the pictures; the run directory by default.
    frame
        Frame of the first episode for map and scan; by default the middle of those that have most
        to show.
    user
        Receiver, or its object, for |y| and the beam; by default the one that was there longest.

    Returns
    -------
    list of Path
        The files, in the order map, |y|, LIDAR. What was not recorded is not drawn.

    Raises
    ------
    RecordingError
        It is not a recording, it holds nothing to draw, or frame or user are not in it.
    SetupError
        Matplotlib is missing; names the command that installs it.
    """
    recording = Recording(run)
    folder = out or recording.directory
    topics = recording.topics
    chosen = choose_user(recording, user or "") if "link" in topics else None
    files: list[Path] = []
    if "scene" in topics:
        files.append(folder / "map.png")
        _map(recording, _frame(recording, frame, "channel", chosen), chosen, files[-1])
    if chosen is not None:
        files += [folder / "beams-over-time.png", folder / "beams-over-angle.png"]
        data, agent = series(recording, chosen), _agent(recording)
        draw_over_time(data, agent, files[-2])
        draw_over_angle(data, agent, files[-1])
    if "lidar" in topics:
        files.append(folder / "lidar.png")
        _scan(_frame(recording, frame, "lidar", chosen), files[-1])
    if not files:
        raise RecordingError(f"{run} holds nothing to draw: neither scene, link nor lidar")
    return files


def beam_gain(array: AntennaArray, beam: int, directions: Float64Array) -> Float64Array:
    """Amplitude of a codebook beam towards unit vectors in device axes, Shape ``[N, 3]`` to ``[N]``.

    ``|c_k* a(k̂)| / sqrt(N)`` times the amplitude of the element pattern.
    """
    response = steering_vector(array, directions) @ dft_codebook(array)[beam].conj()
    element = np.linalg.norm(radiated_field(array, np.eye(3), directions), axis=1)
    gain: Float64Array = np.abs(response) / np.sqrt(array.size) * element
    return gain


def _map(recording: Recording, frame: RecordedFrame, user: tuple[str, str, str] | None, file: Path) -> None:
    scene = frame.scene()
    if scene is None:
        raise RecordingError(f"frame {frame.number} has no scene; choose another with --frame")
    data = MapData(
        scene=scene,
        channel=next(iter(frame.of("channel", Channel).values()), None),
        link=next(iter(frame.of("link", Link).values()), None),
        footprints=_scenery(recording),
        beam_gain=beam_gain,
        user=user,
        title=f"{recording.metadata.name}: {_moment(frame)}",
    )
    draw_map(data, file)


def _scan(frame: RecordedFrame, file: Path) -> None:
    lidars = frame.of("lidar", Lidar)
    lidar = next((lidar for _, lidar in sorted(lidars.items()) if lidar.scans), None)
    if lidar is None:
        raise RecordingError(f"frame {frame.number} has no LIDAR scan; choose another with --frame")
    scan = lidar.scans[0]
    draw_scan(scan, lidar, frame.scene(), f"LIDAR {scan.sensor}: {_moment(frame)}", file)


def _scenery(recording: Recording) -> Footprints | None:
    description = find_scenery(recording.assets)
    if description is None:
        return None
    return footprints((shape.file, shape.to_world) for shape in read_scenery(description).shapes)


def _frame(
    recording: Recording, number: int | None, topic: str, user: tuple[str, str, str] | None
) -> RecordedFrame:
    """The frame asked for, or the middle one of those with the topic in which the user sees most."""
    if number is not None:
        return recording.frame(0, number)
    candidates = list(recording.frames())
    for wanted in ("scene", topic):
        with_topic = [frame for frame in candidates if _has(frame, wanted)]
        candidates = with_topic or candidates
    ranks = [_worth(frame, user) for frame in candidates]
    candidates = [frame for frame, rank in zip(candidates, ranks, strict=True) if rank == max(ranks)]
    return candidates[len(candidates) // 2]


def _has(frame: RecordedFrame, topic: str) -> bool:
    return any(entry.topic == topic and entry.status in ("fresh", "held") for entry in frame.inputs)


def _worth(frame: RecordedFrame, user: tuple[str, str, str] | None) -> int:
    """3: the user has a line of sight, 2: a path, 1: is there, 0: is not."""
    for link in frame.of("link", Link).values() if user is not None else ():
        users = list(zip(link.tx, link.rx, link.carrier, strict=True))
        if user in users:
            index = users.index(user)
            return 1 + int(link.has_path[index]) + int(link.has_path[index] and link.los[index])
    return 0


def _agent(recording: Recording) -> str:
    """What served the users, for the legend: the implementation where there was one agent."""
    services = recording.metadata.scenario.get("services")
    specs = services.values() if isinstance(services, dict) else ()
    used = sorted({str(s.get("use")) for s in specs if isinstance(s, dict) and s.get("role") == "agent"})
    return ", ".join(used) or "none"


def _moment(frame: RecordedFrame) -> str:
    episode = f"episode {frame.episode}, " if frame.episode else ""
    return f"{episode}frame {frame.number}, t = {frame.t_ns * 1e-9:.2f} s"
