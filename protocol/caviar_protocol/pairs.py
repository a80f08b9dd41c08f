"""Who could talk to whom in a scene, and where they see each other.

A *pair* is a transmitting and a receiving device of the scene. A device that both transmits and
receives is no pair with itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

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


def directions(scene: Scene, pairs: Sequence[Pair]) -> tuple[list[Vector], list[Vector]]:
    """Direction of RX from TX in the TX device's axes, and of TX from RX in the RX device's axes.

    Unit vectors, one of each for every pair. Two devices at one point see each other at boresight.
    """
    # Link and agent ask for the same pairs: what was computed is kept with the scene.
    known: dict[tuple[str, str], tuple[Pair, Vector, Vector]] = scene.__dict__.setdefault("_directions", {})
    at_tx, at_rx = [], []
    for pair in pairs:
        names = pair.tx.name, pair.rx.name
        entry = known.get(names)
        if entry is None or entry[0].tx is not pair.tx or entry[0].rx is not pair.rx:
            entry = known[names] = (pair, *_along(scene, pair))
        at_tx.append(entry[1])
        at_rx.append(entry[2])
    return at_tx, at_rx


def _along(scene: Scene, pair: Pair) -> tuple[Vector, Vector]:
    tx, rx = device_pose(scene, pair.tx), device_pose(scene, pair.rx)
    (x0, y0, z0), (x1, y1, z1) = tx.position, rx.position
    dx, dy, dz = x1 - x0, y1 - y0, z1 - z0
    length = math.hypot(dx, dy, dz)
    if length == 0:
        return BORESIGHT, BORESIGHT
    dx, dy, dz = dx / length, dy / length, dz / length
    return unrotated(tx.orientation, (dx, dy, dz)), unrotated(rx.orientation, (-dx, -dy, -dz))
