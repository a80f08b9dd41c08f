"""What a channel model finds: paths between antennas, before any antenna is applied."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caviar_protocol.arrays import (
    BoolArray,
    Complex128Array,
    Float64Array,
    Int32Array,
    Int64Array,
    UInt8Array,
)
from caviar_protocol.coordinates import rotation_matrix
from caviar_protocol.scene import device_pose, device_velocity
from caviar_protocol.topics import AntennaArray, AntennaDevice, Scene


@dataclass(frozen=True, eq=False)
class Antenna:
    """An antenna device where it is in this frame, in world axes."""

    name: str
    array: AntennaArray
    position: Float64Array
    """[m], Shape ``[3]``."""
    rotation: Float64Array
    """Turns device axes into world axes, Shape ``[3, 3]``."""
    velocity: Float64Array
    """[m/s], Shape ``[3]``."""

    @classmethod
    def of(cls, scene: Scene, device: AntennaDevice) -> Antenna:
        """The antenna of a device, composed with its parent's pose."""
        pose = device_pose(scene, device)
        return cls(
            device.name,
            device.array,
            np.array(pose.position),
            rotation_matrix(pose.orientation),
            device_velocity(scene, device),
        )


@dataclass(frozen=True, eq=False)
class PathTable:
    """Paths as a model found them: any order, no antennas applied, no carrier phase.

    P paths of at most D interactions, C carriers.
    """

    pair: Int64Array
    """TX index · number of RX + RX index, Shape ``[P]``."""
    transfer: Complex128Array
    """Dyad from the field sent to the field received, with spreading λ/(4πd) and without
    exp(−j2πfτ), in world axes; Shape ``[C, P, 3, 3]``, rows at RX, columns at TX."""
    types: UInt8Array
    """`Interaction` at each point, Shape ``[P, D]``; 0 behind the last."""
    objects: Int32Array
    """Index into ``object_names``, Shape ``[P, D]``; −1 behind the last."""
    points: Float64Array
    """Interaction points [m], Shape ``[P, D, 3]``."""
    object_names: tuple[str, ...]
    object_velocity: Float64Array
    """Velocity [m/s] of each named object, Shape ``[len(object_names), 3]``."""
    hidden: BoolArray | None = None
    """Paths that only elements beside the arrays' centres have: they are in H alone, Shape ``[P]``; absent:
    none is."""
    traced: Int64Array | None = None
    """Number of each among the paths of all launches, Shape ``[P]``; −1 for paths by formula; absent:
    unknown."""
    faces: Int32Array | None = None
    """Number of the plane of each point within its object, the same in every frame, Shape ``[P, D]``;
    absent: unknown. Below 0: −1 minus the place of a surface in ``joined_faces``."""
    joined_faces: tuple[tuple[str, int], ...] = ()
    """Object and number of the plane that surfaces of several objects are known by."""

    def take(self, which: Int64Array | BoolArray) -> PathTable:
        """These paths, in this order."""
        return PathTable(
            pair=self.pair[which],
            transfer=self.transfer[:, which],
            types=self.types[which],
            objects=self.objects[which],
            points=self.points[which],
            object_names=self.object_names,
            object_velocity=self.object_velocity,
            faces=None if self.faces is None else self.faces[which],
            joined_faces=self.joined_faces,
            hidden=None if self.hidden is None else self.hidden[which],
            traced=None if self.traced is None else self.traced[which],
        )
