"""Physics of the scenes of a dataset, computed anew from positions, scenery and H.

`channel_checks` has what paths, H, beams and SNRs have to be. Here stand lines of sight, reciprocity, and how
objects move from one scene to the next.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Set
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from caviar_clients.datasets.verification import Finding
from caviar_clients.datasets.verification.channel_checks import (
    BEAM,
    DELAY,
    FROM_PATHS,
    GAIN_DB,
    Pair,
    User,
    check_beams,
    check_flags,
    check_gains,
    check_geometry,
    check_matrix,
    check_snr,
    matrix_of,
    pair_of,
)
from caviar_clients.datasets.verification.lidar_checks import LidarChecks
from caviar_protocol.arrays import Complex128Array, Float64Array
from caviar_protocol.errors import AssetError, CaviarError
from caviar_protocol.messages import Status
from caviar_protocol.recording import RecordedFrame, Recording
from caviar_protocol.scenario.schema import PATTERNS
from caviar_protocol.space.codebooks import CODEBOOKS_FOLDER, add_codebook_files
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT, rotation_matrix
from caviar_protocol.topics import AntennaDevice, Carrier, Channel, Link, Scene
from caviar_protocol.topics.channel import PLANE_WAVES
from caviar_services.channel.paths import Antenna
from caviar_services.channel.propagation.patterns import Patterns
from caviar_services.pattern_files import read_pattern
from caviar_space.obstacles import Boxes, Surfaces
from caviar_space.scenery import scenery_triangles

T = TypeVar("T", Channel, Link)

TRACED = ("siso-rt", "spherical", "mimo-rt")
"""Rungs on which something can hide a line of sight."""
POINTED = ("free-space", *TRACED)
"""Rungs whose paths follow from their points."""
ACCELERATION_M_S2 = 15.0
JUMP_M = 0.5
"""Of an object between two scenes, beyond its velocity and that acceleration."""
LANE_M = 3.75
"""A vehicle may be so far to the side at once: SUMO changes lanes, and parks beside one, in one step."""
ON_ROADS = frozenset({"bus", "car", "motorcycle", "truck"})
EDGE_M = 0.01
"""A line of sight that passes an edge within this may be decided either way."""
WEAK = 1e-12
"""Amplitude below which polarizations that do not match leave what rounding leaves."""
BODY_SHARE = 0.4
"""Of the box of a vehicle, about its centre, which is inside of its mesh for sure."""


class PhysicsChecks:
    """Checks the scenes of a dataset.

    Args:
        assets: Folder of the scenery; where it is not there, occlusion is not looked at.
        settings: Of the dataset.
    """

    def __init__(self, assets: Path, settings: Mapping[str, Any]) -> None:
        self.files = {
            file.relative_to(assets).as_posix(): file for file in sorted(assets.rglob("*")) if file.is_file()
        }
        """Of the dataset, by asset name."""
        self.scenery_error = ""
        """Why the scenery cannot be read; empty: it can, or there is none."""
        self._surfaces: Surfaces | None = None
        try:
            # Waves pass through foliage, which dims a line of sight and does not hide it.
            triangles = scenery_triangles(dict(self.files), _foliage(settings))
        except AssetError as error:
            triangles, self.scenery_error = np.zeros((0, 3, 3)), str(error)
        if len(triangles):
            self._surfaces = Surfaces(triangles, outside=lambda number, normal: True)
        self._carriers = _carriers(settings)
        self._budget = _link_settings(settings)
        self.lidar = LidarChecks(self.files, settings.get("scenario", {}).get("services", {}))
        add_codebook_files(file for name, file in self.files.items() if name.startswith(CODEBOOKS_FOLDER))
        self._patterns = Patterns()
        try:
            tables = {
                name: read_pattern(file) for name, file in self.files.items() if name.startswith(PATTERNS)
            }
            self._patterns = Patterns(tables)
        except CaviarError as error:
            self.scenery_error = self.scenery_error or str(error)

    def episode(self, recording: Recording) -> Iterator[Finding]:
        """Check all scenes of an episode.

        Args:
            recording: Of the episode.

        Raises:
            RecordingError: A product cannot be read.
        """
        before: tuple[RecordedFrame, Scene] | None = None
        meshes = recording.meshes
        assets = self.files.keys() | recording.assets.keys()
        said: set[tuple[str, str]] = set()
        for frame in recording.frames():
            scene = frame.scene()
            if scene is None:
                continue
            if before is not None:
                yield from _continuity(*before, frame, scene)
            before = frame, scene
            for name, asset in _lacking_assets(scene, assets):
                if (name, asset) not in said:  # in its first scene
                    said.add((name, asset))
                    what = f"file of {name}"
                    yield Finding(
                        frame.episode, frame.number, "", what, f"assets/{asset} in the dataset", "none"
                    )
            # A held product is that of an earlier scene, where it was looked at.
            yield from self.lidar.frame(frame, meshes)
            for channel in _fresh(frame, "channel", Channel):
                links = _fresh(frame, "link", Link)
                yield from self._channel((frame.episode, frame.number), scene, channel, links)

    def _channel(
        self, place: tuple[int, int], scene: Scene, channel: Channel, links: list[Link]
    ) -> Iterator[Finding]:
        carriers = [(carrier.name, carrier.frequency_hz) for carrier in channel.carriers]
        if self._carriers and carriers != [(c.name, c.frequency_hz) for c in self._carriers]:
            expected = ", ".join(f"{c.name} at {c.frequency_hz:g} Hz" for c in self._carriers)
            found = ", ".join(f"{name} at {frequency:g} Hz" for name, frequency in carriers)
            yield Finding(*place, "", "carriers of the channel", expected, found)
            return
        recorded = {(m.carrier, m.tx, m.rx): m.h for m in channel.h}
        matrices: dict[User, tuple[Complex128Array, float]] = {}
        for pair in self._pairs(place, scene, channel):
            yield from self._sight(pair, scene)
            yield from _paths(pair)
            for c, carrier in enumerate(channel.carriers):
                if not channel.uses(c, pair.tx, pair.rx):
                    continue
                user = carrier.name, channel.tx[pair.tx], pair.user
                h = recorded.get((c, pair.tx, pair.rx))
                if h is not None:
                    yield from check_matrix(pair, c, h)
                    if h.shape == (pair.ends[1].array.size, pair.ends[0].array.size):
                        matrices[user] = h, BEAM
                elif channel.rung in PLANE_WAVES and (summed := matrix_of(pair, c)) is not None:
                    matrices[user] = summed, FROM_PATHS
        yield from _reciprocity(place, channel)
        for link in links:
            yield from check_flags(place, channel, link)
            yield from check_beams(place, scene, link, matrices)
            if self._budget is not None:
                yield from check_snr(place, scene, link, channel.carriers, self._budget)

    def _pairs(self, place: tuple[int, int], scene: Scene, channel: Channel) -> Iterator[Pair]:
        """All pairs of two devices of the scene that have a carrier in common."""
        antennas: dict[str, Antenna] = {}
        for device in scene.devices:
            if isinstance(device, AntennaDevice) and device.name in (*channel.tx, *channel.rx):
                pattern = device.array.pattern_file
                if not pattern or pattern in self.files:
                    antennas[device.name] = Antenna.of(scene, device, self._patterns)
        for t, tx in enumerate(channel.tx):
            for r, rx in enumerate(channel.rx):
                has_carrier = channel.used is None or channel.used[:, t, r].any()
                if tx != rx and tx in antennas and rx in antennas and has_carrier:
                    yield pair_of(place, scene, channel, (t, r), (antennas[tx], antennas[rx]))

    def _sight(self, pair: Pair, scene: Scene) -> Iterator[Finding]:
        """A line of sight that is hidden for sure and said to be free, or the other way round."""
        if pair.channel.rung not in TRACED:
            return
        is_free = bool(pair.channel.los[pair.tx, pair.rx])
        hidden = self._hidden(scene, pair.ends[0].position, pair.ends[1].position)
        if hidden is not None and hidden == is_free:
            words = {True: "free", False: "hidden"}
            yield pair.finding("line of sight", words[not is_free], words[is_free])

    def _hidden(self, scene: Scene, start: Float64Array, end: Float64Array) -> bool | None:
        """Check whether something stands between two points; None where that is a matter of `EDGE_M`, or of
        the shape of a body within its box."""
        boxes = Boxes.of(scene)
        hidden = False
        if len(scene.names):
            sure = Boxes(boxes.names, boxes.centre, boxes.rotation, boxes.half * BODY_SHARE)
            wide = Boxes(boxes.names, boxes.centre, boxes.rotation, boxes.half + EDGE_M)
            hidden = bool(sure.block(start[None], end[None]).any())
            if not hidden and bool(wide.block(start[None], end[None]).any()):
                return None
        if self._surfaces is None:
            return True if hidden else None
        line = (end - start) / max(float(np.linalg.norm(end - start)), 1e-9)
        side = np.cross(line, (0.0, 0.0, 1.0) if abs(line[2]) < 0.9 else (1.0, 0.0, 0.0))
        side /= np.linalg.norm(side)
        shifts = [
            np.zeros(3),
            *(sign * EDGE_M * axis for axis in (side, np.cross(line, side)) for sign in (1, -1)),
        ]
        # Ends stand off the surfaces that carry them.
        ends = start + 2 * EDGE_M * line, end - 2 * EDGE_M * line
        decided = {self._surfaces.between(ends[0] + shift, ends[1] + shift) for shift in shifts}
        if hidden:
            return True
        return decided.pop() if len(decided) == 1 else None


def _foliage(settings: Mapping[str, Any]) -> list[str]:
    """Keys of what is foliage for the channels of a dataset."""
    services = settings.get("scenario", {}).get("services", {}).values()
    return [
        key
        for service in services
        if service.get("role") == "channel"
        for key in service.get("settings", {}).get("foliage", {})
    ]


def _fresh(frame: RecordedFrame, topic: str, cls: type[T]) -> list[T]:
    """Products of a topic that were computed for this scene."""
    return [
        product.payload
        for product in frame.products
        if product.provenance.topic == topic
        and product.provenance.status is Status.FRESH
        and isinstance(product.payload, cls)
    ]


def _lacking_assets(scene: Scene, assets: Set[str]) -> Iterator[tuple[str, str]]:
    """Files that a scene names and that are in neither dataset nor recording, each with what names it."""
    for name, asset in zip(scene.names, scene.assets, strict=True):
        if asset and asset not in assets:
            yield name, asset
    for device in scene.devices:
        pattern = device.array.pattern_file if isinstance(device, AntennaDevice) else ""
        if pattern and pattern not in assets:
            yield device.name, pattern


def _carriers(settings: Mapping[str, Any]) -> tuple[Carrier, ...]:
    """The carriers of a dataset; none where the settings are not of this version."""
    try:
        return msgspec.convert(settings.get("scenario", {}).get("carriers", ()), tuple[Carrier, ...])
    except msgspec.ValidationError:
        return ()


def _link_settings(settings: Mapping[str, Any]) -> dict[str, float] | None:
    """Noise figure and temperature of a shipped link; None where another made the SNRs, or several did."""
    services = settings.get("scenario", {}).get("services", {})
    links = [spec for spec in services.values() if spec.get("role") == "link"]
    if len(links) != 1 or links[0].get("use") not in ("beams", "cell"):
        return None
    given = links[0].get("settings", {})
    names = ("noise_figure_db", "temperature_k")
    return {name: given[name] for name in names if isinstance(given.get(name), int | float)}


def _paths(pair: Pair) -> Iterator[Finding]:
    """Paths that do not follow from their points, or that bring too much."""
    channel = pair.channel
    if channel.rung in POINTED:
        yield from check_geometry(pair)
        yield from check_gains(pair)
        yield from _line_of_sight(pair)
    elif channel.rung not in ("geometric", "imported"):  # which draw paths, or round positions
        tau, (start, end) = channel.tau[pair.cut], (antenna.position for antenna in pair.ends)
        least = float(np.linalg.norm(end - start)) / SPEED_OF_LIGHT
        if len(tau) and tau.min() < least * (1 - DELAY):
            yield pair.finding("delay", f"at least {least:.9g} s", f"{tau.min():.9g} s")


def _line_of_sight(pair: Pair) -> Iterator[Finding]:
    """A free line of sight without a direct path, or with one weaker than in free space; a hidden one with a
    direct path."""
    channel, (tx, rx), options = pair.channel, pair.ends, pair.channel.options
    distance = float(np.linalg.norm(rx.position - tx.position))
    # Nearer than a wavelength far-field gains do not hold, and there is no path.
    if distance * min(carrier.frequency_hz for carrier in channel.carriers) < SPEED_OF_LIGHT:
        return
    direct = np.flatnonzero(~channel.interactions[pair.cut].any(axis=1))
    if not len(direct):
        if channel.los[pair.tx, pair.rx] and options.los:
            yield pair.finding("line of sight", "a direct path", "none")
        return
    # Foliage and people weaken a line of sight that is not free, and let it through.
    if options.foliage or options.blockage:
        return
    if not channel.los[pair.tx, pair.rx]:
        yield pair.finding("line of sight", "free, as of a direct path", "hidden")
    if options.absorption_db_per_km:
        return
    if not tx.array.is_uniform or not rx.array.is_uniform:
        return
    along = pair.geometry.departure[direct[:1]]
    # Friis 1946, with the mismatch of both polarizations.
    element = abs(complex((tx.radiated(along) * rx.radiated(-along)).sum()))
    for c, carrier in enumerate(channel.carriers):
        free = element * SPEED_OF_LIGHT / carrier.frequency_hz / (4 * math.pi * distance)
        found = abs(channel.a[c, pair.cut][direct[0]])
        if channel.uses(c, pair.tx, pair.rx) and free > WEAK and found < free * 10 ** (-GAIN_DB / 20):
            expected = f"{20 * math.log10(free):.2f} dB"
            got = f"{20 * math.log10(found):.2f} dB" if found else "0"
            yield pair.finding(f"gain of the line of sight, {carrier.name}", expected, got)


def _reciprocity(place: tuple[int, int], channel: Channel) -> Iterator[Finding]:
    """Both directions of a pair of devices, where both are recorded."""
    h = {(m.carrier, channel.tx[m.tx], channel.rx[m.rx]): m.h for m in channel.h}
    for (carrier, tx, rx), one in h.items():
        other = h.get((carrier, rx, tx))
        if tx < rx and other is not None and one.shape == other.T.shape:
            scale = max(float(np.abs(one).max(initial=0.0)), 1e-300)
            worst = float(np.abs(one - other.T).max(initial=0.0)) / scale
            if worst > 1e-6:
                yield Finding(
                    *place, rx, f"H from and to {tx}", "transposes of each other", f"{worst:.2g} apart"
                )


def _continuity(
    earlier: RecordedFrame, before: Scene, frame: RecordedFrame, scene: Scene
) -> Iterator[Finding]:
    """Objects that are elsewhere than their velocities carry them to."""
    dt = (frame.t_ns - earlier.t_ns) * 1e-9
    places = {name: at for at, name in enumerate(before.names)}
    for at, name in enumerate(scene.names):
        was = places.get(name)
        if was is None or scene.classes[at] == "pedestrian":  # who may turn on the spot
            continue
        carried = 0.5 * (before.velocity[was] + scene.velocity[at]) * dt
        step = scene.position[at] - before.position[was] - carried
        if scene.classes[at] in ON_ROADS:
            left = rotation_matrix(scene.orientation[at])[:, 1]
            if abs(aside := float(step @ left)) <= LANE_M:
                step = step - aside * left
        off = float(np.linalg.norm(step))
        allowed = JUMP_M + 0.5 * ACCELERATION_M_S2 * dt**2 + 0.5 * float(np.linalg.norm(carried))
        if off > allowed:
            moved = float(np.linalg.norm(scene.position[at] - before.position[was]))
            yield Finding(
                frame.episode,
                frame.number,
                name,
                "movement since the scene before",
                f"{float(np.linalg.norm(carried)):.2f} m by its velocities",
                f"{moved:.2f} m",
            )
