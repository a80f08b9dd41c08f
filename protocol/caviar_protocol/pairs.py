"""Who could talk to whom in a scene, and where they see each other.

A *pair* is a transmitting and a receiving device of the scene. A device that both transmits and
receives is no pair with itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_protocol.coordinates import Vector, unrotated
from caviar_protocol.scene import antennas, device_pose
from caviar_protocol.topics import AntennaDevice, Scene

BORESIGHT: Vector = (1.0, 0.0, 0.0)


@dataclass(frozen=True)
class Pair:
    """A transmitter and a receiver."""

    tx: AntennaDevice
    rx: AntennaDevice


def pairs_of(scene: Scene) -> list[Pair]:
    """All pairs of the scene, sorted by TX, then RX."""
    receivers = antennas(scene, "rx")
    return [Pair(tx, rx) for tx in antennas(scene, "tx") for rx in receivers if rx.name != tx.name]


def directions(scene: Scene, pairs: Sequence[Pair]) -> tuple[Float64Array, Float64Array]:
    """Direction of RX from TX in the TX device's axes, and of TX from RX in the RX device's axes.

    Unit vectors, Shape ``[U, 3]`` each. Two devices at one point see each other at boresight.
    """
    devices = {device.name: device for pair in pairs for device in (pair.tx, pair.rx)}
    poses = {name: device_pose(scene, device) for name, device in devices.items()}
    at_tx, at_rx = [], []
    for pair in pairs:
        tx, rx = poses[pair.tx.name], poses[pair.rx.name]
        (x0, y0, z0), (x1, y1, z1) = tx.position, rx.position
        dx, dy, dz = x1 - x0, y1 - y0, z1 - z0
        length = math.hypot(dx, dy, dz)
        if length > 0:
            dx, dy, dz = dx / length, dy / length, dz / length
            at_tx.append(unrotated(tx.orientation, (dx, dy, dz)))
            at_rx.append(unrotated(rx.orientation, (-dx, -dy, -dz)))
        else:
            at_tx.append(BORESIGHT)
            at_rx.append(BORESIGHT)
    return np.array(at_tx).reshape(-1, 3), np.array(at_rx).reshape(-1, 3)
