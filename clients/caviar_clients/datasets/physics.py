"""What physics says about the scenes of a dataset, computed anew from positions, scenery and H."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_protocol.codec import encode_payload
from caviar_protocol.errors import AssetError
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.recording import RecordedFrame, Recording
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT
from caviar_protocol.space.scene import antennas, device_pose
from caviar_protocol.topics import AntennaDevice, Carrier, Channel, Link, Scene
from caviar_services.channel.propagation.clearance import Boxes, Surfaces
from caviar_services.channel.statistical.free_space import FreeSpaceChannel, FreeSpaceSettings
from caviar_services.link.beam_sweep import best_pairs, sweep
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo
from caviar_services.world.scenery import scenery_triangles

T = TypeVar("T", Channel, Link)

GAIN_DB = 0.5
"""Of a line of sight from free space; air and foliage take no more over a street."""
GREATEST_ELEMENT_DB = 8.0
"""Gain of the strongest built-in element (3GPP TR 38.901, 8 dBi)."""
TRACED = ("siso-rt", "spherical", "mimo-rt")
"""Rungs on which something can hide a line of sight."""
DELAY = 1e-6
"""Relative, of delays from lengths."""
ANGLE_RAD = 1e-4
ACCELERATION_M_S2 = 15.0
JUMP_M = 0.5
"""Of an object between two scenes, beyond its velocity and that acceleration."""
EDGE_M = 0.01
"""A line of sight that passes an edge within this may be decided either way."""
BODY_SHARE = 0.4
"""Of the box of a vehicle, about its centre, which is inside of its mesh for sure."""
BEAM = 1e-9
"""Relative, of |y| from H."""


@dataclass(frozen=True)
class Finding:
    """Something that is wrong."""

    episode: int
    scene: int | None
    """None: of the episode as a whole."""
    user: str
    """Receiver; empty: of the scene as a whole."""
    what: str
    expected: str
    found: str


class PhysicsChecks:
    """Checks the scenes of a dataset.

    Args:
        assets: Folder of the scenery; where it is not there, occlusion is not looked at.
        settings: Of the dataset.
    """

    def __init__(self, assets: Path, settings: dict[str, Any]) -> None:
        files = {str(file.relative_to(assets)): file for file in sorted(assets.rglob("*")) if file.is_file()}
        self._surfaces: Surfaces | None = None
        try:
            triangles = scenery_triangles(dict(files))
        except AssetError:
            triangles = np.zeros((0, 3, 3))
        if len(triangles):
            self._surfaces = Surfaces(triangles, outside=lambda number, normal: True)
        self._free: FreeSpaceChannel | None = None
        carriers = _carriers(settings)
        if carriers:
            run = RunInfo(name="free-space", carriers=carriers)
            self._free = FreeSpaceChannel(FreeSpaceSettings(), run)
            self._free.prepare(
                Preparation(demand={"channel": frozenset()}, assets=files, producers={"scene": ("world",)})
            )

    def episode(self, recording: Recording) -> Iterator[Finding]:
        """Check all scenes of an episode.

        Args:
            recording: Of the episode.
        """
        before: tuple[RecordedFrame, Scene] | None = None
        for frame in recording.frames():
            scene = frame.scene()
            if scene is None:
                continue
            if before is not None:
                yield from _continuity(*before, frame, scene)
            before = frame, scene
            # A held product is that of an earlier scene, where it was looked at.
            for channel in _fresh(frame, "channel", Channel):
                yield from self._channel(frame, scene, channel)
                for link in _fresh(frame, "link", Link):
                    yield from _beams(frame, scene, channel, link)

    def _channel(self, frame: RecordedFrame, scene: Scene, channel: Channel) -> Iterator[Finding]:
        place = frame.episode, frame.number
        devices = {device.name: device for device in scene.devices if isinstance(device, AntennaDevice)}
        at = {
            name: np.array(device_pose(scene, device).position)
            for name, device in devices.items()
            if name in (*channel.tx, *channel.rx)
        }
        free = self._free_space(frame, scene)
        for t, tx in enumerate(channel.tx):
            for r, rx in enumerate(channel.rx):
                if tx == rx or tx not in at or rx not in at:
                    continue
                cut = _cut(channel, t, r)
                yield from self._sight(place, scene, channel, (t, r), at[tx], at[rx])
                if channel.rung == "geometric":  # it draws its paths
                    continue
                bound = _bound_db(devices[tx]) + _bound_db(devices[rx])
                yield from _lengths(place, channel, cut, rx, at[tx], at[rx], bound)
                if free is not None and free.tx == channel.tx and free.rx == channel.rx:
                    yield from _line_of_sight(place, channel, free, t, r)
        yield from _reciprocity(place, channel)

    def _free_space(self, frame: RecordedFrame, scene: Scene) -> Channel | None:
        """The channel of the same scene without anything but antennas."""
        if self._free is None:
            return None
        item = GrantInput(topic="scene", source="world", status=Status.FRESH, frame=frame.number)
        step = Frame(
            episode=frame.episode,
            number=frame.number,
            t_ns=frame.t_ns,
            inputs=(FrameInput(item, *encode_payload(scene)),),
        )
        found = self._free.step(step).products["channel"]
        return found if isinstance(found, Channel) else None

    def _sight(
        self,
        place: tuple[int, int],
        scene: Scene,
        channel: Channel,
        pair: tuple[int, int],
        start: Float64Array,
        end: Float64Array,
    ) -> Iterator[Finding]:
        """A line of sight that is hidden for sure and said to be free, or the other way round."""
        if channel.rung not in TRACED:
            return
        is_free = bool(channel.los[pair])
        hidden = self._hidden(scene, start, end)
        if hidden is not None and hidden == is_free:
            words = {True: "free", False: "hidden"}
            yield Finding(*place, channel.rx[pair[1]], "line of sight", words[not is_free], words[is_free])

    def _hidden(self, scene: Scene, start: Float64Array, end: Float64Array) -> bool | None:
        """Whether something stands between two points; None where that is a matter of `EDGE_M`, or of the
        shape of a body within its box."""
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


def _fresh(frame: RecordedFrame, topic: str, cls: type[T]) -> list[T]:
    """Products of a topic that were computed for this scene."""
    return [
        product.payload
        for product in frame.products
        if product.provenance.topic == topic
        and product.provenance.status is Status.FRESH
        and isinstance(product.payload, cls)
    ]


def _carriers(settings: dict[str, Any]) -> tuple[Carrier, ...]:
    """The carriers of a dataset; none where the settings are not of this version."""
    try:
        return msgspec.convert(settings.get("scenario", {}).get("carriers", ()), tuple[Carrier, ...])
    except msgspec.ValidationError:
        return ()


def _bound_db(device: AntennaDevice) -> float:
    """Greatest gain of an element [dB]; without a bound where a file says it."""
    return math.inf if device.array.pattern_file else GREATEST_ELEMENT_DB


def _cut(channel: Channel, t: int, r: int) -> slice:
    pair = t * len(channel.rx) + r
    return slice(int(channel.offsets[pair]), int(channel.offsets[pair + 1]))


def _lengths(
    place: tuple[int, int],
    channel: Channel,
    cut: slice,
    rx: str,
    start: Float64Array,
    end: Float64Array,
    bound: float,
) -> Iterator[Finding]:
    """Paths shorter than the straight line, or stronger than free space over their length."""
    tau = channel.tau[cut]
    if not len(tau):
        return
    least = float(np.linalg.norm(end - start)) / SPEED_OF_LIGHT
    if tau.min() < least * (1 - DELAY):
        yield Finding(*place, rx, "delay", f"at least {least:.9g} s", f"{tau.min():.9g} s")
    for c, carrier in enumerate(channel.carriers):
        friis = SPEED_OF_LIGHT / carrier.frequency_hz / (4 * math.pi * SPEED_OF_LIGHT * tau)
        over = 20 * np.log10(np.maximum(np.abs(channel.a[c, cut]), 1e-300) / friis)
        if over.max() > bound + GAIN_DB:
            yield Finding(
                *place, rx, "path gain", f"at most {bound:.1f} dB above free space", f"{over.max():.1f} dB"
            )


def _line_of_sight(
    place: tuple[int, int], channel: Channel, free: Channel, t: int, r: int
) -> Iterator[Finding]:
    """A direct path that is not that of free space: delay, directions, gain."""
    cut, right = _cut(channel, t, r), _cut(free, t, r)
    types = channel.interactions[cut]
    direct = np.flatnonzero(~types.any(axis=1)) if types.shape[1:] and types.size else np.arange(len(types))
    if right.stop == right.start:
        return
    rx = channel.rx[r]
    if not len(direct):
        if channel.los[t, r] and channel.options.los:
            yield Finding(*place, rx, "line of sight", "a direct path", "none")
        return
    path, line = cut.start + int(direct[0]), right.start
    if not math.isclose(channel.tau[path], free.tau[line], rel_tol=DELAY):
        yield Finding(*place, rx, "delay", f"{free.tau[line]:.9g} s", f"{channel.tau[path]:.9g} s")
        return
    for name in ("aod", "aoa"):
        got, expected = getattr(channel, name)[path], getattr(free, name)[line]
        turned = np.abs(np.angle(np.exp(1j * (got - expected))))
        if turned.max() > ANGLE_RAD and math.sin(float(expected[0])) > ANGLE_RAD:
            yield Finding(*place, rx, name, _angles(expected), _angles(got))
    for c, carrier in enumerate(channel.carriers):
        ratio = 20 * math.log10(max(abs(channel.a[c, path]), 1e-300) / max(abs(free.a[c, line]), 1e-300))
        options = channel.options
        lossy = bool(options.foliage or options.blockage or options.absorption_db_per_km)
        is_wrong = ratio > GAIN_DB or (ratio < -GAIN_DB and not lossy)
        if is_wrong and abs(free.a[c, line]) > 1e-30:
            expected_db = 20 * math.log10(abs(free.a[c, line]))
            what = f"gain of the line of sight, {carrier.name}"
            yield Finding(*place, rx, what, f"{expected_db:.2f} dB", f"{expected_db + ratio:.2f} dB")


def _angles(pair: Float64Array) -> str:
    return ", ".join(f"{math.degrees(angle):.2f}°" for angle in pair.tolist())


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


def _beams(frame: RecordedFrame, scene: Scene, channel: Channel, link: Link) -> Iterator[Finding]:
    """Best pairs of beams that are not those of H."""
    arrays = {device.name: device.array for device in antennas(scene, "tx")}
    arrays |= {device.name: device.array for device in antennas(scene, "rx")}
    names = [carrier.name for carrier in channel.carriers]
    h = {(names[m.carrier], channel.tx[m.tx], channel.rx[m.rx]): m.h for m in channel.h}
    for row, user in enumerate(zip(link.carrier, link.tx, link.rx, strict=True)):
        matrix = h.get(user)
        if matrix is None or not link.has_path[row] or not link.top_abs_y.shape[1]:
            continue
        _, tx, rx = user
        best = best_pairs(sweep(matrix[None], arrays[tx], arrays[rx]), 1)
        expected = int(best.tx_beam[0, 0]), int(best.rx_beam[0, 0]), float(best.abs_y[0, 0])
        found = int(link.top_tx_beam[row, 0]), int(link.top_rx_beam[row, 0]), float(link.top_abs_y[row, 0])
        same = math.isclose(expected[2], found[2], rel_tol=BEAM)
        if expected[:2] != found[:2] or not same:
            yield Finding(
                frame.episode,
                frame.number,
                rx,
                "best pair of beams",
                f"TX {expected[0]}, RX {expected[1]}, |y| {expected[2]:.6g}",
                f"TX {found[0]}, RX {found[1]}, |y| {found[2]:.6g}",
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
        off = float(np.linalg.norm(scene.position[at] - before.position[was] - carried))
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
