"""Scenes, channels and frames for the tests of links and agents, as small as they can be."""

from __future__ import annotations

from typing import Any

import numpy as np

from caviar_protocol.arrays import Complex128Array, Payload
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.space.coordinates import quaternion_from_euler
from caviar_protocol.topics import (
    Action,
    AntennaArray,
    AntennaDevice,
    BeamChoice,
    Carrier,
    Channel,
    ChannelMatrix,
    Scene,
)
from caviar_services.service import Frame, FrameInput

CARRIER = Carrier(name="mmwave", frequency_hz=28e9, bandwidth_hz=100e6)


def antenna(
    name: str,
    role: str,
    array: tuple[int, int] = (1, 1),
    position: tuple[float, float, float] = (0.0, 0.0, 0.0),
    yaw: float = 0.0,
    **more: Any,
) -> AntennaDevice:
    """A device with ``array`` = (rows, columns)."""
    return AntennaDevice(
        name=name,
        role=role,
        array=AntennaArray(rows=array[0], columns=array[1]),
        position=position,
        orientation=quaternion_from_euler(yaw),
        **more,
    )


def scene_of(
    *devices: AntennaDevice, objects: dict[str, tuple[tuple[float, float, float], float]] | None = None
) -> Scene:
    """A scene of devices, and of objects given as name to (position, yaw)."""
    found = dict(sorted((objects or {}).items()))
    return Scene(
        names=tuple(found),
        classes=("car",) * len(found),
        assets=("",) * len(found),
        position=np.array([p for p, _ in found.values()], dtype=np.float64).reshape(-1, 3),
        orientation=np.array(
            [quaternion_from_euler(yaw) for _, yaw in found.values()], dtype=np.float64
        ).reshape(-1, 4),
        velocity=np.zeros((len(found), 3)),
        dimensions=np.ones((len(found), 3)),
        devices=tuple(sorted(devices, key=lambda device: device.name)),
    )


def channel_of(
    tx: tuple[str, ...],
    rx: tuple[str, ...],
    h: dict[tuple[str, str, str], Complex128Array],
    carriers: tuple[Carrier, ...] = (CARRIER,),
    with_h: bool = True,
    los: bool = True,
) -> Channel:
    """A channel with one path for every (carrier, tx, rx) in ``h``, and none for the others."""
    pairs = [(t, r) for t in tx for r in rx]
    reached = [any((c.name, t, r) in h for c in carriers) for t, r in pairs]
    offsets = np.concatenate([[0], np.cumsum(reached)]).astype(np.int64)
    count = int(offsets[-1])
    a = np.zeros((len(carriers), count), dtype=np.complex128)
    for c, carrier in enumerate(carriers):
        for p, (t, r) in enumerate(pairs):
            if reached[p] and (carrier.name, t, r) in h:
                a[c, offsets[p]] = 1e-5
    return Channel(
        rung="free-space",
        carriers=carriers,
        tx=tx,
        rx=rx,
        los=np.array(reached, dtype=np.bool_).reshape(len(tx), len(rx)) & los,
        offsets=offsets,
        id=np.zeros(count, np.uint64),
        a=a,
        tau=np.zeros(count),
        aod=np.zeros((count, 2)),
        aoa=np.zeros((count, 2)),
        doppler=np.zeros((len(carriers), count)),
        interactions=np.zeros((count, 0), np.uint8),
        points=np.zeros((count, 0, 3)),
        objects=np.zeros((count, 0), np.int32),
        h=tuple(
            ChannelMatrix(carrier=[k.name for k in carriers].index(c), tx=tx.index(t), rx=rx.index(r), h=m)
            for (c, t, r), m in h.items()
        )
        if with_h
        else (),
    )


def given(topic: str, payload: Payload, source: str = "", status: Status = Status.FRESH) -> FrameInput:
    """An input of a frame."""
    return FrameInput(GrantInput(topic=topic, source=source or topic, status=status), payload=payload)


def choices(source: str, *commands: Any, status: Status = Status.FRESH) -> FrameInput:
    """The action of an agent; a tuple (tx, rx, tx_beam, rx_beam[, carrier]) is a beam choice."""
    built = [
        BeamChoice(**dict(zip(("tx", "rx", "tx_beam", "rx_beam", "carrier"), command, strict=False)))
        if isinstance(command, tuple)
        else command
        for command in commands
    ]
    return given("action", Action(commands=tuple(built)), source, status)


def frame_of(
    *inputs: FrameInput, number: int = 0, final: bool = False, seed: int = 1, service: str = "link"
) -> Frame:
    """A frame with these inputs."""
    return Frame(episode=0, number=number, t_ns=0, inputs=inputs, final=final, seed=seed, service=service)


def random_h(seed: int, nr: int, nt: int, scale: float = 1e-5) -> Complex128Array:
    """A random matrix, Shape ``[Nr, Nt]``."""
    generator = np.random.default_rng(seed)
    h: Complex128Array = scale * (generator.normal(size=(nr, nt)) + 1j * generator.normal(size=(nr, nt)))
    return h
