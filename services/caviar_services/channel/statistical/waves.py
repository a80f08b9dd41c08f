"""Multipath of the channel ``geometric`` as plain numbers, and its settings.

A pair has a handful of waves: an array of three costs as much as ten numbers. The settings' defaults are the
medians of 3GPP TR 38.901, table 7.5-6, UMi street canyon with line of sight at 28 GHz, rounded.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array, quantity
from caviar_protocol.space.coordinates import Pose, Vector, unrotated
from caviar_protocol.space.scene import device_velocity
from caviar_protocol.topics import AntennaDevice, Scene
from caviar_services.channel.base import ChannelSettings

Corner = tuple[float, float, float]
Spread = Annotated[float, quantity("°", "standard deviation of a Laplacian", ge=0, le=180)]


class Obstacle(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A box along the world's axes that blocks the line of sight."""

    minimum_m: Annotated[Corner, quantity("m", "lowest corner")]
    maximum_m: Annotated[Corner, quantity("m", "highest corner")]

    def __post_init__(self) -> None:
        if not all(low < high for low, high in zip(self.minimum_m, self.maximum_m, strict=True)):
            raise ValueError(f"minimum_m {self.minimum_m} is not below maximum_m {self.maximum_m}")


class GeometricSettings(ChannelSettings, frozen=True, kw_only=True):
    """Settings of the channel ``geometric``; ``atmosphere`` goes with ``path-loss``."""

    components: Annotated[int, quantity("1", "waves of a pair, L", ge=1, le=64)] = 3
    k_factor_db: Annotated[
        float, quantity("dB", "power of the straight path over the rest", ge=-100, le=100)
    ] = 9.0
    delay_spread_ns: Annotated[float, quantity("ns", "mean excess delay", ge=0, le=1e6)] = 32.0
    azimuth_spread_departure_deg: Spread = 14.0
    zenith_spread_departure_deg: Spread = 1.0
    azimuth_spread_arrival_deg: Spread = 41.0
    zenith_spread_arrival_deg: Spread = 4.0
    redraw: Literal["frame", "episode"] = "frame"
    """How long draws hold: each frame has new ones (the paper), or they last an episode."""
    nlos: Literal["never", "angle", "geometry"] = "never"
    """What blocks the line of sight: nothing; an angular range; the bounding boxes of other objects of the
    scene, and ``obstacles``."""
    nlos_azimuth_deg: (
        Annotated[tuple[float, float], quantity("°", "blocked range, both ends within")] | None
    ) = None
    """With ``nlos = "angle"``: azimuth of the receiver in the transmitter's axes, which is the angle θ that
    a base station computes from a user's position (the paper: 20° to 30°)."""
    obstacles: tuple[Obstacle, ...] = ()
    """With ``nlos = "geometry"``."""
    normalization: Literal["unit", "path-loss"] = "unit"
    """Mean power of H: ``unit`` whatever the distance, or of free space at that distance (``path-loss``)."""
    nlos_loss_db: (
        Annotated[float, quantity("dB", "further loss without line of sight", ge=0, le=200)] | None
    ) = None
    """With ``normalization = "path-loss"``; 20 dB where it is not given."""

    def __post_init__(self) -> None:
        if (self.nlos == "angle") != (self.nlos_azimuth_deg is not None):
            raise ValueError(
                'nlos = "angle" and nlos_azimuth_deg go together; write both, for example '
                "nlos_azimuth_deg = [20.0, 30.0], or neither"
            )
        if self.nlos_azimuth_deg is not None and not self.nlos_azimuth_deg[0] < self.nlos_azimuth_deg[1]:
            raise ValueError(f"nlos_azimuth_deg is {list(self.nlos_azimuth_deg)}; write the lower end first")
        if self.obstacles and self.nlos != "geometry":
            raise ValueError('obstacles block nothing without nlos = "geometry"')
        if self.nlos_loss_db is not None and self.normalization != "path-loss":
            raise ValueError('nlos_loss_db belongs to normalization = "path-loss"')
        if self.atmosphere is not None and self.normalization != "path-loss":
            raise ValueError(
                'atmosphere belongs to normalization = "path-loss": "unit" has no loss over distance'
            )


class PairWaves(msgspec.Struct, frozen=True):
    """A pair of devices, and which of the waves are its own."""

    tx: AntennaDevice
    rx: AntennaDevice
    tx_pose: Pose
    rx_pose: Pose
    mine: slice
    """Rows of `Waves`."""

    def departures(self, waves: Waves) -> Float64Array:
        """Directions of departure in the axes of TX, Shape ``[L, 3]``."""
        return _in_axes(self.tx_pose, waves.departure[self.mine])

    def arrivals(self, waves: Waves) -> Float64Array:
        """Directions of arrival in the axes of RX, Shape ``[L, 3]``."""
        return _in_axes(self.rx_pose, waves.arrival[self.mine])


def _in_axes(pose: Pose, vectors: Sequence[Vector]) -> Float64Array:
    turned = pose.orientation
    return np.array([unrotated(turned, vector) for vector in vectors], np.float64).reshape(-1, 3)


class Line:
    """The straight line between the devices of a pair.

    Args:
        tx: The transmitter, with its pose and velocity [m/s]; ``rx`` likewise.
        rx: See ``tx``.
        tx_pose: See ``tx``.
        rx_pose: See ``tx``.
        tx_speed: See ``tx``.
        rx_speed: See ``tx``.
    """

    # One is made for each pair of each frame: slots are quicker to fill than the fields of a dataclass.
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
    """Waves of all pairs, added pair after pair as plain numbers."""

    def __init__(self) -> None:
        self.amplitude: list[complex] = []
        """Without carrier phase and path gain."""
        self.tau: list[float] = []
        """[s]."""
        self.departure: list[Vector] = []
        """Unit vectors in world axes; ``arrival`` from RX towards the wave."""
        self.arrival: list[Vector] = []
        self.doppler_ratio: list[float] = []
        self.id: list[int] = []
        self.length: list[float] = []
        """Length of the pair's straight line [m]."""


@dataclass(frozen=True, eq=False)
class Draws:
    """Random draws of one pair for some frames, as lists; within a frame sorted by delay."""

    gain: list[list[complex]]
    """Of mean power 1, by frame and component."""
    excess: list[list[float]]
    """[s], by frame and component."""
    excess_free: list[list[float]]
    """The same, sorted after component 0: dropping the shortest of all would make the others longer."""
    deviation: list[list[list[float]]]
    """[rad] of departure zenith and azimuth, arrival zenith and azimuth, by frame and component."""

    @classmethod
    def of(cls, random: np.random.Generator, frames: int, settings: GeometricSettings) -> Draws:
        """Draws for so many frames.

        Args:
            random: Generator of the pair and block.
            frames: Number of frames.
            settings: Distributions.
        """
        # The order of draws is fixed: each is as many numbers of the generator, and products follow from
        # them.
        shape = (frames, settings.components)
        gain = random.normal(0.0, math.sqrt(0.5), (*shape, 2)).view(np.complex128)[..., 0]
        excess = random.exponential(settings.delay_spread_ns * 1e-9, shape)
        # Of a free pair component 0 is the straight path, whose delay is not drawn: the others are sorted
        # after it.
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
    """Amplitudes times exp(−j2πfτ) at a frequency [Hz]."""
    # The whole turns of f·τ go first: they are millions, and only the rest is a phase.
    turns = [frequency * tau for tau in waves.tau]
    phases = [cmath.rect(1.0, -2 * math.pi * (turn - round(turn))) for turn in turns]
    return [amplitude * phase for amplitude, phase in zip(waves.amplitude, phases, strict=True)]


def velocity(scene: Scene, device: AntennaDevice) -> Vector:
    """Velocity of a device in world axes [m/s]."""
    if not device.parent:
        return (0.0, 0.0, 0.0)
    x, y, z = device_velocity(scene, device).tolist()
    return (x, y, z)


def direction(zenith: float, azimuth: float) -> Vector:
    """Unit vector of a direction [rad]; a zenith beyond a pole comes down on its other side.

    Example:
        >>> [round(x, 9) for x in direction(math.pi / 2, math.pi / 2)]
        [0.0, 1.0, 0.0]
    """
    sine = math.sin(zenith)
    return (sine * math.cos(azimuth), sine * math.sin(azimuth), math.cos(zenith))


def angles(vector: Vector) -> tuple[float, float]:
    """Zenith and azimuth of a vector [rad].

    Example:
        >>> angles((0.0, 0.0, 2.0))
        (0.0, 0.0)
    """
    x, y, z = vector
    return (math.atan2(math.hypot(x, y), z), math.atan2(y, x))


def dot(a: Vector, b: Vector) -> float:
    """Inner product.

    Example:
        >>> dot((1.0, 2.0, 3.0), (1.0, 0.0, 1.0))
        4.0
    """
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
