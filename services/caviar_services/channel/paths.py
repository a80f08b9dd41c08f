"""What a channel model finds: paths between antennas, before any antenna is applied."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from caviar_protocol.arrays import (
    BoolArray,
    Complex128Array,
    Float64Array,
    Int32Array,
    Int64Array,
    UInt8Array,
)
from caviar_protocol.space.beams import subarrays
from caviar_protocol.space.coordinates import rotation_matrix
from caviar_protocol.space.scene import device_pose, device_velocity
from caviar_protocol.topics import AntennaArray, AntennaDevice, Scene
from caviar_services.channel.propagation.patterns import ElementPattern, Field, Patterns, radiated_field
from caviar_services.channel.propagation.vectors import cross


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
    pattern: ElementPattern | None = None
    """Of its elements; None: the one that the array names."""
    part: int = 0
    """Which of a device's subarrays this is."""

    @classmethod
    def of(cls, scene: Scene, device: AntennaDevice, patterns: Patterns | None = None) -> Antenna:
        """The antenna of a device, composed with its parent's pose.

        ``patterns`` knows those from files; without it the antenna is not to be asked for its field.
        """
        pose = device_pose(scene, device)
        return cls(
            device.name,
            device.array,
            np.array(pose.position),
            rotation_matrix(pose.orientation),
            device_velocity(scene, device),
            None if patterns is None else patterns.of(device.array),
        )

    @cached_property
    def subarrays(self) -> tuple[Antenna, ...]:
        """Its uniform parts, one for each panel and polarization, as antennas where they stand."""
        if self.array.is_uniform:
            return (self,)
        return tuple(
            replace(
                self,
                array=part.array,
                position=self.position + self.rotation @ np.array(part.position),
                rotation=self.rotation @ rotation_matrix(part.orientation),
                part=number,
            )
            for number, part in enumerate(subarrays(self.array))
        )

    def radiated(self, directions: Float64Array) -> Field:
        """Far field of an element of the first subarray, towards unit vectors in world axes, ``[P, 3]``."""
        first = self.subarrays[0]
        return radiated_field(first.array, first.rotation, directions, first.pattern)


def antenna_fields(antennas: Sequence[Antenna], which: Int64Array, directions: Float64Array) -> Field:
    """Field of the antenna that each path has at one end, towards the path, Shape ``[P, 3]``."""
    if len(antennas) == 1:
        return antennas[0].radiated(directions)
    found: Field = np.zeros((len(which), 3))
    for index, antenna in enumerate(antennas):
        mine = which == index
        field = antenna.radiated(directions[mine])
        if np.iscomplexobj(field) and not np.iscomplexobj(found):
            found = found.astype(np.complex128)
        found[mine] = field
    return found


@dataclass(frozen=True, eq=False)
class Turning:
    """How K named objects turn."""

    centre: Float64Array
    """What they turn about [m], Shape ``[K, 3]``."""
    angular_velocity: Float64Array
    """In world axes [rad/s], Shape ``[K, 3]``."""

    def take(self, which: Sequence[int]) -> Turning:
        """Those of these objects, in this order."""
        return Turning(self.centre[list(which)], self.angular_velocity[list(which)])

    def velocity(self, objects: Int32Array, points: Float64Array) -> Float64Array:
        """What turning adds to the velocity [m/s] of points [m] of objects, by number, −1 for what stands,
        Shape ``[..., 3]``: ω × r."""
        centre = np.concatenate([self.centre, np.zeros((1, 3))])[objects]
        turning = np.concatenate([self.angular_velocity, np.zeros((1, 3))])[objects]
        return cross(turning, points - centre)


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
    object_turning: Turning | None = None
    """How named objects turn; absent: none does."""

    @property
    def point_velocity(self) -> Float64Array:
        """Velocity [m/s] of what stands at each point, there, Shape ``[P, D, 3]``."""
        velocity: Float64Array = np.concatenate([self.object_velocity, np.zeros((1, 3))])[self.objects]
        if self.object_turning is not None:
            velocity = velocity + self.object_turning.velocity(self.objects, self.points)
        return velocity

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
            object_turning=self.object_turning,
        )
