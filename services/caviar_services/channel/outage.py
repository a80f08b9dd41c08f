"""Why users have no path, from the product of a frame and what its antennas stand in.

Only users without a path cost anything here, and nothing of it is part of the product.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from typing import Protocol

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT
from caviar_protocol.space.scene import device_pose
from caviar_protocol.topics import Channel, Scene
from caviar_protocol.topics.channel import INSIDE_PREFIX, Cause
from caviar_protocol.topics.scene import Device


class Surroundings(Protocol):
    """What a channel model knows about places; in the state of the last frame."""

    @property
    def extent(self) -> tuple[Float64Array, Float64Array] | None:
        """Lowest and highest corner [m] of the scenery, Shape ``[3]`` each; None: there is none."""

    def enclosing(self, position: Float64Array) -> str:
        """Name of the object that a point [m], Shape ``[3]``, is inside; empty: none."""


def outage_counts(
    channel: Channel, scene: Scene, surroundings: Surroundings, dropped_pairs: Collection[int] = ()
) -> dict[str, int]:
    """Users without a path by `Cause`, and the antennas that stand inside an object, for a report.

    Args:
        channel: The product of a frame.
        scene: The scene that it was made of.
        surroundings: What the model knows about places.
        dropped_pairs: Pairs of which paths were dropped, for values that are not finite.
    """
    offsets = channel.offsets
    if (offsets[1:] > offsets[:-1]).all() and channel.a.all():
        return {}
    users = _users_without_path(channel)
    ends = _Ends(channel, scene, surroundings)
    causes: Counter[Cause] = Counter()
    for p in np.flatnonzero(users).tolist():
        t, r = divmod(p, len(channel.rx))
        if channel.tx[t] != channel.rx[r]:
            cause = Cause.NOT_FINITE if p in dropped_pairs else ends.cause(t, r)
            causes[cause] += int(users[p])
    counts = {cause.count_name: number for cause, number in causes.items()}
    return counts | {f"{INSIDE_PREFIX}{name} in {around}": 1 for name, around in ends.inside.items()}


def _users_without_path(channel: Channel) -> Int64Array:
    """For each pair, the carriers on which no path has an amplitude, Shape ``[T·R]``."""
    paths = np.diff(channel.offsets)
    reached: BoolArray = np.zeros((len(channel.carriers), len(paths)), np.bool_)
    carrier, path = np.nonzero(channel.a)
    reached[carrier, np.repeat(np.arange(len(paths)), paths)[path]] = True
    lacking: Int64Array = np.count_nonzero(~reached, axis=0)
    return lacking


class _Ends:
    """The antennas of a frame; each place is looked at once, whatever number of pairs it is in."""

    def __init__(self, channel: Channel, scene: Scene, surroundings: Surroundings) -> None:
        self._channel, self._scene, self._surroundings = channel, scene, surroundings
        self._devices: Mapping[str, Device] = {device.name: device for device in scene.devices}
        self._positions: dict[str, Float64Array] = {}
        self._around: dict[str, str] = {}
        lowest_hz = min((carrier.frequency_hz for carrier in channel.carriers), default=np.inf)
        self._wavelength = SPEED_OF_LIGHT / lowest_hz

    @property
    def inside(self) -> dict[str, str]:
        """Antennas that stand inside an object, and its name."""
        return {name: around for name, around in sorted(self._around.items()) if around}

    def cause(self, t: int, r: int) -> Cause:
        """Why a pair has no path."""
        channel = self._channel
        names = channel.tx[t], channel.rx[r]
        start, end = (self._position(name) for name in names)
        around = [self._enclosing(name) for name in names]  # of both, since both are to be named
        if any(around):
            return Cause.INSIDE
        if np.linalg.norm(end - start) < self._wavelength:
            return Cause.TOO_CLOSE
        if channel.los[t, r]:
            return Cause.NOT_FOUND
        return Cause.OUT_OF_RANGE if self._is_beside(start) or self._is_beside(end) else Cause.BLOCKED

    def _position(self, name: str) -> Float64Array:
        if name not in self._positions:
            self._positions[name] = np.array(device_pose(self._scene, self._devices[name]).position)
        return self._positions[name]

    def _enclosing(self, name: str) -> str:
        if name not in self._around:
            self._around[name] = self._surroundings.enclosing(self._position(name))
        return self._around[name]

    def _is_beside(self, position: Float64Array) -> bool:
        """Whether a place is beside the scenery or below it; above it, the sky goes on."""
        if self._surroundings.extent is None:
            return False
        low, high = self._surroundings.extent
        return bool((position < low).any() or (position[:2] > high[:2]).any())
