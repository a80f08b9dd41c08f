"""Recordings for tests, all through the real recorder.

`record` writes frames that a test makes up: a street with cars, rays, links and a LIDAR. `record_run` runs a
scenario in this process. `recorder` is for tests of what is on disk before a recording is closed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace

from caviar_clients.session.embedded import EmbeddedRun
from caviar_protocol.arrays import Payload
from caviar_protocol.codec import encode_payload
from caviar_protocol.digest import payload_digest
from caviar_protocol.messages import GrantInput, Report, Status
from caviar_protocol.run_directory import RunDirectory
from caviar_protocol.scenario import Scenario, load_scenario
from caviar_protocol.space.coordinates import quaternion_from_euler, rotation_matrix
from caviar_protocol.space.scene import device_pose
from caviar_protocol.topics import (
    AntennaArray,
    AntennaDevice,
    Carrier,
    Channel,
    Lidar,
    LidarDevice,
    LidarScan,
    Link,
    OccupancyGrid,
    Scene,
)
from caviar_services.recorder.mcap import McapRecorder, McapSettings
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo

PERIOD_NS = 100_000_000
SCENARIO = {"run": {"name": "sample", "frames": 10}, "services": {"link": {"role": "link"}}}


def scene(frame: int, cars: int = 3) -> Scene:
    """Cars that drive east at 10 m/s, a base station over them, a LIDAR and an antenna on the first."""
    yaw = 0.1
    names = tuple(f"car.{i}" for i in range(cars))
    devices = (
        AntennaDevice(
            name="bs",
            role="tx",
            position=(0.0, 20.0, 15.0),
            orientation=quaternion_from_euler(-math.pi / 2),
            array=AntennaArray(columns=16),
        ),
        *(AntennaDevice(name=f"{name}/rx", role="rx", parent=name, position=(0, 0, 1.0)) for name in names),
        LidarDevice(name=f"{names[0]}/top", parent=names[0], position=(0, 0, 1.5), beams=8, azimuth_steps=90),
    )
    return Scene(
        names=names,
        classes=("car",) * cars,
        assets=("",) * cars,
        position=np.array([[-30.0 + 12 * i + frame, 3.5 * (i % 2), 0.75] for i in range(cars)]),
        orientation=np.tile(np.array(quaternion_from_euler(yaw)), (cars, 1)),
        velocity=np.tile(np.array([10.0, 1.0, 0.0]), (cars, 1)),
        dimensions=np.tile(np.array([4.5, 1.8, 1.5]), (cars, 1)),
        devices=tuple(sorted(devices, key=lambda device: device.name)),
    )


def with_packets(plain: Link) -> Link:
    """The link with packets: user u got u of the 10 that came, after 2 ms; 1 was dropped, the others wait."""
    users = np.arange(len(plain.rx))
    return replace(
        plain,
        arrived=np.full(len(users), 10_000),
        sent=1000 * users,
        dropped=np.full(len(users), 1000),
        buffered=9000.0 - 1000 * users,
        delivered=users.copy(),
        delay=np.where(users > 0, 2e-3, 0.0),
        waiting=np.full(len(users), 5e-3),
        sinr=np.full(len(users), 3.0),
        throughput=1e4 * users,
        blocks=2 * users,
        block_errors=users // 2,
    )


def link(frame: int, users: int = 3, without_path: tuple[int, ...] = ()) -> Link:
    """Best |y| of 4, the agent reaches half of it, the baseline a quarter."""
    has_path = np.array([u not in without_path for u in range(users)], dtype=bool)
    best = np.where(has_path, 4.0 + 0.1 * frame, 0.0)
    return Link(
        tx=("bs",) * users,
        rx=tuple(f"car.{u}/rx" for u in range(users)),
        carrier=("c0",) * users,
        has_path=has_path,
        los=has_path & (frame % 5 != 0),
        tx_beam=np.full(users, 3, np.int32),
        rx_beam=np.zeros(users, np.int32),
        abs_y=best / 2,
        top_tx_beam=np.full((users, 1), 4, np.int32),
        top_rx_beam=np.zeros((users, 1), np.int32),
        top_abs_y=best[:, None].copy(),
        baseline_abs_y=best / 4,
        aod_azimuth=np.full(users, 0.02 * frame),
        aoa_azimuth=np.full(users, 0.5 + 0.02 * frame),
        snr=best**2,
        snr_best=4 * best**2,
        spectral_efficiency=np.log2(1 + best**2),
        bit_rate=1e8 * np.log2(1 + best**2),
        reward=best / 2,
        no_path=len(without_path),
    )


def channel(frame: int, users: int = 3) -> Channel:
    """To each car a line of sight and a reflection on a wall at y = 30 m; no path to the last car."""
    where = scene(frame, users)
    start = np.array([0.0, 20.0, 15.0])
    ends = where.position[:-1] + np.array([0.0, 0.0, 1.0])
    mirrored = start * [1, -1, 1] + [0, 60, 0]
    share = (30.0 - ends[:, 1]) / (mirrored[1] - ends[:, 1])
    bounce = ends + share[:, None] * (mirrored - ends)
    reached = users - 1
    interactions = np.tile(np.array([[0], [1]], np.uint8), (reached, 1))
    points = np.zeros((2 * reached, 1, 3))
    points[1::2, 0] = bounce
    towards = np.empty((2, 2 * reached, 3))  # from the transmitter, from the receiver
    towards[0, 0::2], towards[0, 1::2] = ends - start, bounce - start
    towards[1, 0::2], towards[1, 1::2] = start - ends, bounce - ends
    length = np.empty(2 * reached)
    length[0::2] = np.linalg.norm(ends - start, axis=1)
    length[1::2] = np.linalg.norm(ends - mirrored, axis=1)
    return Channel(
        rung="siso-rt",
        carriers=(Carrier(name="c0", frequency_hz=28e9),),
        tx=("bs",),
        rx=tuple(f"car.{u}/rx" for u in range(users)),
        los=np.array([[u < reached for u in range(users)]]),
        offsets=np.array([2 * min(u, reached) for u in range(users + 1)]),
        object_names=("wall",),
        id=np.arange(2 * reached, dtype=np.uint64),
        a=(1e-3 / length)[None].astype(np.complex128),
        tau=length / 3e8,
        aod=_angles(towards[0]),
        aoa=_angles(towards[1]),
        doppler=np.zeros((1, 2 * reached)),
        interactions=interactions,
        points=points,
        objects=interactions.astype(np.int32) - 1,
    )


def _angles(towards: np.ndarray) -> np.ndarray:
    """(zenith, azimuth) of directions."""
    x, y, z = towards.T
    return np.stack([np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)], axis=-1)


def lidar(frame: int) -> Lidar:
    """The LIDAR of the first car sees a wall 10 m ahead and to the left, and a car behind it."""
    where = scene(frame)
    pose = device_pose(where, next(d for d in where.devices if isinstance(d, LidarDevice)))
    ray = np.arange(8 * 90)[np.arange(8 * 90) % 90 < 60].astype(np.int32)
    azimuth = (ray % 90) * 2 * np.pi / 90
    points = 10.0 * np.stack([np.cos(azimuth), np.sin(azimuth), 0.05 * (ray // 90)], axis=-1)
    world = points @ rotation_matrix(pose.orientation).T + pose.position
    scan = LidarScan(
        sensor="car.0/top",
        position=pose.position,
        orientation=pose.orientation,
        ray=ray,
        points=points.astype(np.float32),
        points_world=world.astype(np.float32),
        range=np.full(len(ray), 10.0, np.float32),
        object=np.where(azimuth > np.pi, 0, 1).astype(np.int32),
    )
    return Lidar(object_names=("car.1", "wall"), scans=(scan,))


def grid_only() -> Lidar:
    """A fixed LIDAR whose scan has a grid alone: cells at two heights, and a transmitter."""
    cells = np.zeros((9, 9, 3), np.int8)
    cells[2, 3, 1], cells[6, 3, 2], cells[5, 5, 2] = 1, 1, -1
    scan = LidarScan(
        sensor="top",
        position=(0.0, 0.0, 1.0),
        orientation=(1.0, 0.0, 0.0, 0.0),
        ray=np.zeros(0, np.int32),
        points=np.zeros((0, 3), np.float32),
        range=np.zeros(0, np.float32),
        object=np.zeros(0, np.int32),
        grid=OccupancyGrid(origin=(-4.0, -4.0, 0.0), cell=(1.0, 1.0, 1.0), occupancy=cells),
    )
    return Lidar(object_names=(), scans=(scan,))


def product(
    topic: str,
    source: str,
    payload: Payload | tuple[bytes, bytes],
    frame: int,
    status: Status = Status.FRESH,
    used_in: int | None = None,
    **provenance: str,
) -> FrameInput:
    """A product as a recorder is granted it; ``payload`` may be its header and body."""
    header, body = payload if isinstance(payload, tuple) else encode_payload(payload)
    entry = GrantInput(
        topic=topic,
        source=source,
        status=status,
        frame=frame,
        t_ns=frame * PERIOD_NS,
        age=(frame if used_in is None else used_in) - frame,
        digest=payload_digest(header, body),
        **provenance,
    )
    return FrameInput(entry, memoryview(header), memoryview(body))


def absent(topic: str, source: str, cause: str) -> FrameInput:
    """A product that is not there."""
    return FrameInput(GrantInput(topic=topic, source=source, status=Status.ABSENT, cause=cause))


def frame(
    number: int, *inputs: FrameInput, episode: int = 0, seed: int = 7, reports: tuple[Report, ...] = ()
) -> Frame:
    """A frame as a recorder is granted it; by default with a scene and a link."""
    inputs = inputs or (
        product("scene", "world", scene(number), number),
        product("link", "link", link(number), number),
    )
    return Frame(
        episode=episode,
        number=number,
        t_ns=number * PERIOD_NS,
        inputs=inputs,
        reports=reports,
        service="recorder",
        seed=seed,
    )


def frame_of(number: int, *, episode: int = 0, **payloads: Payload) -> Frame:
    """A frame with these payloads, by topic, all of source ``s``."""
    inputs = (product(topic, "s", payload, number) for topic, payload in payloads.items())
    return frame(number, *inputs, episode=episode)


def recorder(
    folder: Path,
    assets: Mapping[str, Path] | None = None,
    *,
    run: Mapping[str, object] | None = None,
    seed: int = 7,
    again: bool = False,
    **settings: object,
) -> McapRecorder:
    """A prepared recorder that writes to ``folder``.

    ``run`` replaces keys of that table of the scenario, ``seed`` is that of the run; ``again`` says that
    the recorder died and was started anew.
    """
    info = RunInfo(
        name="recorder",
        run="sample-1",
        seed=seed,
        sampling_period_ns=PERIOD_NS,
        frames=10,
        scenario=SCENARIO | {"run": {**SCENARIO["run"], **(run or {})}},
        directory=folder,
        again=again,
    )
    made = McapRecorder(McapSettings(**settings), info)
    made.prepare(Preparation(demand={}, assets=assets or {}))
    return made


def record(folder: Path, frames: int | Iterable[Frame] = 5, **how: Any) -> Path:
    """A whole recording of these frames, or of so many that `frame` makes; ``how`` as for `recorder`."""
    made = recorder(folder, **how)
    episode = None
    for one in (frame(number) for number in range(frames)) if isinstance(frames, int) else frames:
        if one.episode != episode:
            made.reset(one.episode, one.seed, 0)
            episode = one.episode
        made.step(one)
    made.close()
    return folder


def record_run(folder: Path, scenario: str | Path | Scenario = "smoke", **run: object) -> Path:
    """A recording of a scenario that is run in this process; ``run`` replaces keys of its table ``[run]``."""
    made = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    made = replace(made, run=replace(made.run, **run))
    folder.mkdir(parents=True, exist_ok=True)
    ended = EmbeddedRun(made, folder)
    assert not ended.run().error
    ended.statistics.save(RunDirectory(folder).latencies)
    return folder
