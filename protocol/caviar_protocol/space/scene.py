"""Poses in a scene, scenes of several worlds merged, and pairs of antennas (contract, clause 3).

A *pair* is a transmitting and a receiving device of the scene that have a carrier in common. A device that
both transmits and receives is no pair with itself.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import PayloadError
from caviar_protocol.space.codebooks import beam_count
from caviar_protocol.space.coordinates import Pose, Vector, compose, unrotated
from caviar_protocol.topics.scene import AntennaDevice, Device, Scene


def merge_scenes(scenes: Mapping[str, Scene]) -> Scene:
    """Unite the scenes of all worlds (contract, clause 3), sorted by name.

    Args:
        scenes: Scene of each world, by the world's name.

    Raises:
        PayloadError: A name occurs twice; the text names the object and both worlds.

    Example:
        >>> from caviar_protocol.recording import Recording
        >>> recording = Recording("runs/smoke-20261122-101500")
        >>> scene = recording.product(episode=0, frame=7, topic="scene", source="world")
        >>> merge_scenes({"world": scene}) is scene  # of one world
        True
    """
    # The usual case, in which nothing is copied.
    if len(scenes) == 1:
        return next(iter(scenes.values()))
    owner: dict[str, str] = {}
    for source, scene in scenes.items():
        for name in (*scene.names, *(device.name for device in scene.devices)):
            if name in owner:
                raise PayloadError(
                    f"{name!r} comes from both world {owner[name]!r} and world {source!r}; "
                    "give their objects different prefixes"
                )
            owner[name] = source
    parts = list(scenes.values())
    names = [name for scene in parts for name in scene.names]
    # By name as one world would have them: nothing downstream knows how many worlds there are.
    order = sorted(range(len(names)), key=names.__getitem__)
    classes = [item for scene in parts for item in scene.classes]
    assets = [item for scene in parts for item in scene.assets]

    def joined(field: str) -> Float64Array:
        stacked: Float64Array = np.concatenate([getattr(scene, field) for scene in parts])
        return stacked[order]

    # A world that does not turn objects, next to one that does, counts as not turning.
    turning = None
    if any(scene.angular_velocity is not None for scene in parts):
        known = [(scene.angular_velocity, np.zeros_like(scene.velocity)) for scene in parts]
        turning = np.concatenate([still if turns is None else turns for turns, still in known])[order]
    return Scene(
        names=tuple(names[i] for i in order),
        classes=tuple(classes[i] for i in order),
        assets=tuple(assets[i] for i in order),
        position=joined("position"),
        orientation=joined("orientation"),
        velocity=joined("velocity"),
        dimensions=joined("dimensions"),
        devices=tuple(sorted((d for scene in parts for d in scene.devices), key=lambda device: device.name)),
        angular_velocity=turning,
    )


def object_pose(scene: Scene, index: int) -> Pose:
    """World pose of an object.

    Args:
        scene: The scene.
        index: Place of the object in ``scene.names``.

    Example:
        >>> from caviar_protocol.recording import Recording
        >>> recording = Recording("runs/smoke-20261122-101500")
        >>> object_pose(recording["scene"][0], 0).orientation
        (1.0, 0.0, 0.0, 0.0)
    """
    x, y, z = scene.position[index].tolist()
    w, qx, qy, qz = scene.orientation[index].tolist()
    return Pose((x, y, z), (w, qx, qy, qz))


def device_pose(scene: Scene, device: Device) -> Pose:
    """World pose of a device: its mount pose on top of its parent's pose.

    Args:
        scene: The scene of the device.
        device: One of its devices.

    Raises:
        PayloadError: The parent is not in the scene.

    Example:
        >>> from caviar_protocol.recording import Recording
        >>> recording = Recording("runs/smoke-20261122-101500")
        >>> scene = recording["scene"][0]
        >>> [device_pose(scene, device).position for device in scene.devices if device.name == "bs"]
        [(0.0, 0.0, 10.0)]
    """
    # Channel, link and agent ask for the same poses: what was composed is kept with the scene.
    known: dict[str, tuple[Device, Pose]] = scene.__dict__.setdefault("_poses", {})
    entry = known.get(device.name)
    if entry is not None and (entry[0] is device or entry[0] == device):
        return entry[1]
    pose = Pose(device.position, device.orientation)
    if device.parent:
        pose = compose(object_pose(scene, _parent_index(scene, device)), pose)
    known[device.name] = device, pose
    return pose


def device_velocity(scene: Scene, device: Device) -> Float64Array:
    """Velocity of a device in world axes: that of its parent, at the device's place.

    Args:
        scene: The scene of the device.
        device: One of its devices.

    Returns:
        v + ω × r with the parent's velocity v and angular velocity ω [m/s], Shape ``[3]``.
    """
    if not device.parent:
        return np.zeros(3)
    index = _parent_index(scene, device)
    velocity: Float64Array = scene.velocity[index]
    if scene.angular_velocity is None:
        return velocity
    # Written out: for one vector `np.cross` takes as long as forty of these products.
    (x, y, z), (px, py, pz) = device_pose(scene, device).position, scene.position[index].tolist()
    wx, wy, wz = scene.angular_velocity[index].tolist()
    x, y, z = x - px, y - py, z - pz
    turned: Float64Array = np.array((wy * z - wz * y, wz * x - wx * z, wx * y - wy * x))
    return velocity + turned


# Of the last scene, by role: the devices of one frame mostly are those of the next.
_antennas: dict[str, tuple[tuple[Device, ...], list[AntennaDevice]]] = {}


def antennas(scene: Scene, role: str) -> Sequence[AntennaDevice]:
    """Antenna devices of a scene, sorted by name.

    Args:
        scene: The scene.
        role: ``"tx"`` for those that transmit, ``"rx"`` for those that receive.

    Example:
        >>> from caviar_protocol.recording import Recording
        >>> recording = Recording("runs/smoke-20261122-101500")
        >>> [device.name for device in antennas(recording["scene"][0], "tx")]
        ['bs']
    """
    known = _antennas.get(role)
    if known is None or known[0] is not scene.devices:
        found = (d for d in scene.devices if isinstance(d, AntennaDevice) and d.role in (role, "both"))
        known = scene.devices, sorted(found, key=lambda device: device.name)
        _antennas[role] = known
    return known[1]


def _parent_index(scene: Scene, device: Device) -> int:
    try:
        return scene.names.index(device.parent)
    except ValueError:
        raise PayloadError(
            f"device {device.name!r} is mounted on {device.parent!r}, which is not in the scene"
        ) from None


BORESIGHT: Vector = (1.0, 0.0, 0.0)


@dataclass(frozen=True)
class Pair:
    """A transmitter and a receiver.

    Example:
        >>> from caviar_protocol.recording import Recording
        >>> scene = Recording("runs/smoke-20261122-101500")["scene"][0]
        >>> pair = pairs_of(scene)[1]
        >>> pair.rx.position  # on its mount, the UAV
        (0.0, 0.0, -0.175)
        >>> device_pose(scene, pair.rx).position  # in the world
        (20.0, -15.0, 0.125)
    """

    tx: AntennaDevice
    """Its ``position`` is that on its mount; `device_pose` gives the one in the world."""
    rx: AntennaDevice
    """The same."""

    @property
    def beams(self) -> tuple[int, int]:
        """Sizes of the codebooks of both ends."""
        return beam_count(self.tx.array), beam_count(self.rx.array)

    @property
    def beam_pairs(self) -> int:
        """Number of pairs of them."""
        sent, taken = self.beams
        return sent * taken

    def uses(self, carrier: str) -> bool:
        """Return whether both ends use a carrier.

        Args:
            carrier: Name of the carrier.
        """
        return self.tx.uses(carrier) and self.rx.uses(carrier)


def pairs_of(scene: Scene) -> list[Pair]:
    """All pairs of a transmitting and a receiving device with a carrier in common, sorted by TX, then RX.

    Args:
        scene: The scene.

    Example:
        >>> from caviar_protocol.recording import Recording
        >>> scene = Recording("runs/smoke-20261122-101500")["scene"][0]
        >>> [(pair.tx.name, pair.rx.name) for pair in pairs_of(scene)]
        [('bs', 'car/rx'), ('bs', 'uav/rx-uav')]
    """
    receivers = antennas(scene, "rx")
    return [
        Pair(tx, rx)
        for tx in antennas(scene, "tx")
        for rx in receivers
        if rx.name != tx.name and share_carrier(tx.carriers, rx.carriers)
    ]


def share_carrier(tx: Sequence[str], rx: Sequence[str]) -> bool:
    """Return whether two devices have a carrier in common.

    Args:
        tx: Carriers of the one, by name; empty: all of the run.
        rx: Carriers of the other.

    Example:
        >>> share_carrier(("mm",), ()), share_carrier(("mm",), ("sub6",))
        (True, False)
    """
    return not tx or not rx or not set(tx).isdisjoint(rx)


def directions(scene: Scene, pairs: Sequence[Pair]) -> tuple[list[Vector], list[Vector]]:
    """Directions in which the two devices of each pair see each other.

    Args:
        scene: The scene of the pairs.
        pairs: Pairs of its antennas.

    Returns:
        Unit vectors to RX from TX in the TX device's axes, and to TX from RX in the RX device's axes; a list
        of each, one vector a pair. Two devices at one point see each other at boresight.

    Example:
        >>> from caviar_protocol.recording import Recording
        >>> recording = Recording("runs/smoke-20261122-101500")
        >>> scene = recording["scene"][0]
        >>> at_tx, at_rx = directions(scene, pairs_of(scene))
        >>> len(at_tx), round(math.hypot(*at_tx[0]), 6)
        (2, 1.0)
    """
    # Link and agent ask for the same pairs: what was computed is kept with the scene.
    known: dict[tuple[str, str], tuple[Pair, Vector, Vector]] = scene.__dict__.setdefault("_directions", {})
    at_tx, at_rx = [], []
    for pair in pairs:
        names = pair.tx.name, pair.rx.name
        entry = known.get(names)
        # By value: a link keeps its users from frame to frame, as long as the devices are equal.
        if entry is None or entry[0].tx != pair.tx or entry[0].rx != pair.rx:
            entry = known[names] = (pair, *_straight_directions(scene, pair))
        at_tx.append(entry[1])
        at_rx.append(entry[2])
    return at_tx, at_rx


def _straight_directions(scene: Scene, pair: Pair) -> tuple[Vector, Vector]:
    tx, rx = device_pose(scene, pair.tx), device_pose(scene, pair.rx)
    (x0, y0, z0), (x1, y1, z1) = tx.position, rx.position
    dx, dy, dz = x1 - x0, y1 - y0, z1 - z0
    length = math.hypot(dx, dy, dz)
    # A direction is needed all the same, and this one is in every codebook.
    if length == 0:
        return BORESIGHT, BORESIGHT
    dx, dy, dz = dx / length, dy / length, dz / length
    return unrotated(tx.orientation, (dx, dy, dz)), unrotated(rx.orientation, (-dx, -dy, -dz))
