"""A handful of waves for each pair, as numbers: an array of three costs as much as ten numbers."""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_protocol.space.coordinates import Pose, Vector, unrotated
from caviar_protocol.space.scene import device_velocity
from caviar_protocol.topics import AntennaDevice, Scene
from caviar_services.channel.statistical.geometric_settings import GeometricSettings


class PairWaves(msgspec.Struct, frozen=True):
    """A pair, and which of the waves are its own."""

    tx: AntennaDevice
    rx: AntennaDevice
    tx_pose: Pose
    rx_pose: Pose
    mine: slice

    def departures(self, waves: Waves) -> Float64Array:
        """In the axes of TX, Shape ``[L, 3]``."""
        return _in_axes(self.tx_pose, waves.departure[self.mine])

    def arrivals(self, waves: Waves) -> Float64Array:
        """In the axes of RX, Shape ``[L, 3]``."""
        return _in_axes(self.rx_pose, waves.arrival[self.mine])


def _in_axes(pose: Pose, vectors: Sequence[Vector]) -> Float64Array:
    turned = pose.orientation
    return np.array([unrotated(turned, vector) for vector in vectors], np.float64).reshape(-1, 3)


class Line:
    """The straight line of a pair."""

    __slots__ = (
        "along",
        "azimuth",
        "back",
        "end",
        "length",
        "rx",
        "start",
        "tx",
        "tx_pose",
        "velocity",
        "zenith",
    )

    def __init__(
        self,
        tx: AntennaDevice,
        rx: AntennaDevice,
        tx_pose: Pose,
        rx_pose: Pose,
        tx_speed: Vector,
        rx_speed: Vector,
    ) -> None:
        self.tx, self.rx, self.tx_pose = tx, rx, tx_pose
        self.start, self.end = tx_pose.position, rx_pose.position
        self.velocity = tx_speed, rx_speed
        (x0, y0, z0), (x1, y1, z1) = self.start, self.end
        x, y, z = x1 - x0, y1 - y0, z1 - z0
        self.length = math.hypot(x, y, z)
        scale = 1 / self.length if self.length > 0 else 0.0
        self.along, self.back = (x * scale, y * scale, z * scale), (-x * scale, -y * scale, -z * scale)
        self.zenith, self.azimuth = angles(self.along)

    @property
    def azimuth_deg(self) -> float:
        """Azimuth of RX in the axes of TX [°]."""
        x, y, _ = unrotated(self.tx_pose.orientation, self.along)
        return math.degrees(math.atan2(y, x))


class Waves:
    """Waves as they are added, pair after pair."""

    def __init__(self) -> None:
        self.amplitude: list[complex] = []
        """Without carrier phase and path gain."""
        self.tau: list[float] = []
        self.departure: list[Vector] = []
        """Unit vectors in world axes; ``arrival`` from RX towards the wave."""
        self.arrival: list[Vector] = []
        self.doppler_ratio: list[float] = []
        self.id: list[int] = []
        self.length: list[float] = []
        """Of the pair's straight line [m]."""


@dataclass(frozen=True, eq=False)
class Draws:
    """Draws of one pair for some frames, as lists; within a frame sorted by delay."""

    gain: list[list[complex]]
    """Of mean power 1, by frame and component."""
    excess: list[list[float]]
    """[s], by frame and component."""
    excess_free: list[list[float]]
    """The same, sorted behind component 0: dropping the shortest of all would make the others longer."""
    deviation: list[list[list[float]]]
    """[rad] of departure zenith and azimuth, arrival zenith and azimuth, by frame and component."""

    @classmethod
    def of(cls, random: np.random.Generator, frames: int, settings: GeometricSettings) -> Draws:
        shape = (frames, settings.components)
        gain = random.normal(0.0, math.sqrt(0.5), (*shape, 2)).view(np.complex128)[..., 0]
        excess = random.exponential(settings.delay_spread_ns * 1e-9, shape)
        excess_free = excess.copy()
        excess_free[:, 1:].sort(axis=-1)
        excess.sort(axis=-1)
        spreads = (
            settings.zenith_spread_departure_deg,
            settings.azimuth_spread_departure_deg,
            settings.zenith_spread_arrival_deg,
            settings.azimuth_spread_arrival_deg,
        )
        scale = np.radians(spreads) / math.sqrt(2)  # a Laplacian of scale b has the variance 2b²
        deviation = random.laplace(0.0, 1.0, (*shape, 4)) * scale
        return cls(gain.tolist(), excess.tolist(), excess_free.tolist(), deviation.tolist())


def with_phase(waves: Waves, frequency: float) -> list[complex]:
    """Amplitudes with exp(−j2πfτ)."""
    # The whole turns of f·τ go first: they are millions, and only the rest is a phase.
    turns = [frequency * tau for tau in waves.tau]
    phases = [cmath.rect(1.0, -2 * math.pi * (turn - round(turn))) for turn in turns]
    return [amplitude * phase for amplitude, phase in zip(waves.amplitude, phases, strict=True)]


def velocity(scene: Scene, device: AntennaDevice) -> Vector:
    if not device.parent:
        return (0.0, 0.0, 0.0)
    x, y, z = device_velocity(scene, device).tolist()
    return (x, y, z)


def direction(zenith: float, azimuth: float) -> Vector:
    """Unit vector of a direction; a zenith beyond a pole comes down on its other side."""
    sine = math.sin(zenith)
    return (sine * math.cos(azimuth), sine * math.sin(azimuth), math.cos(zenith))


def angles(vector: Vector) -> tuple[float, float]:
    """(zenith, azimuth) [rad]."""
    x, y, z = vector
    return (math.atan2(math.hypot(x, y), z), math.atan2(y, x))


def dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
