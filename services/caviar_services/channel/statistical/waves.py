"""Multipath of the channel ``geometric``: its formulas, and its settings.

The service computes one frame as plain numbers: a pair has a handful of waves, and an array of three costs as
much as ten numbers. Many episodes are computed as arrays (`geometric`). Both
use the formulas of this module, which take either, and agree bit by bit: what is done frame by frame is sums
and products alone, in one order. Sines and exponentials are those of the draws, taken for a block of frames
at once, and those of the straight line, which are numbers in both.

A direction stands as cosine and sine of its zenith and its azimuth, so that deviations are added without
angles. The settings' defaults are the medians of 3GPP TR 38.901, table 7.5-6, UMi street canyon with line of
sight at 28 GHz, rounded.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Annotated, Literal, NamedTuple, TypeAlias, TypeVar

import msgspec
import numpy as np

from caviar_protocol.arrays import BoolArray, Complex128Array, Float64Array, quantity
from caviar_protocol.space.antenna_arrays import element_phases
from caviar_protocol.space.coordinates import (
    SPEED_OF_LIGHT,
    Pose,
    UnitQuaternion,
    Vector,
    dot,
    rotated,
    unrotated,
)
from caviar_protocol.space.scene import device_velocity
from caviar_protocol.topics import AntennaArray, AntennaDevice, Scene
from caviar_services.channel.arrays.channel_matrices import turn_phase
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

    def transmit(self, waves: Waves) -> Complex128Array:
        """Phases of the elements of TX, Shape ``[L, Nt]``."""
        return _phases(self.tx.array, self.tx_pose, waves.departure[self.mine])

    def receive(self, waves: Waves) -> Complex128Array:
        """Phases of the elements of RX, Shape ``[L, Nr]``."""
        return _phases(self.rx.array, self.rx_pose, waves.arrival[self.mine])


def _in_axes(pose: Pose, vectors: Sequence[Vector]) -> Float64Array:
    turned = pose.orientation
    return np.array([unrotated(turned, vector) for vector in vectors], np.float64).reshape(-1, 3)


def _phases(array: AntennaArray, pose: Pose, vectors: Sequence[Vector]) -> Complex128Array:
    y_axis, z_axis = _axes(pose.orientation)
    y = np.array([dot(y_axis, vector) for vector in vectors], np.float64)
    z = np.array([dot(z_axis, vector) for vector in vectors], np.float64) if array.rows > 1 else y
    return element_phases(array, y, z)


# A base station stands still: of two devices one mostly has the orientation that it had.
@lru_cache(maxsize=256)
def _axes(q: UnitQuaternion) -> tuple[Vector, Vector]:
    """World components of the y and the z axis of a body."""
    return rotated(q, (0.0, 1.0, 0.0)), rotated(q, (0.0, 0.0, 1.0))


Placed: TypeAlias = tuple[AntennaDevice, Pose, Vector]
"""A device, its pose, and its velocity [m/s]."""


class Line:
    """The straight line between the devices of a pair.

    Args:
        transmitter: The device, its pose and its velocity [m/s].
        receiver: Likewise.
        frequencies: Of the carriers [Hz].
    """

    # One is made for each pair of each frame: slots are quicker to fill than the fields of a dataclass.
    __slots__ = (
        "along",
        "delay",
        "inwards",
        "length",
        "outwards",
        "phase",
        "rx",
        "rx_pose",
        "tx",
        "tx_pose",
        "velocity",
    )

    def __init__(self, transmitter: Placed, receiver: Placed, frequencies: Sequence[float]) -> None:
        self.tx, self.tx_pose, outgoing = transmitter
        self.rx, self.rx_pose, incoming = receiver
        self.velocity = outgoing, incoming
        (x0, y0, z0), (x1, y1, z1) = self.tx_pose.position, self.rx_pose.position
        x, y, z = x1 - x0, y1 - y0, z1 - z0
        self.length = math.hypot(x, y, z)
        scale = 1 / self.length if self.length > 0 else 0.0
        self.along = x, y, z = x * scale, y * scale, z * scale
        level = math.hypot(x, y)
        # A vertical line has no azimuth: it is 0, as atan2 has it.
        cosine, sine = (x / level, y / level) if level > 0 else (1.0, 0.0)
        # Seen from the other end: π − zenith, azimuth + π.
        self.outwards, self.inwards = (z, level, cosine, sine), (-z, level, -cosine, -sine)
        self.delay = self.length / SPEED_OF_LIGHT
        # exp(−j2πfτ) on each carrier, real and imaginary part. The whole turns of f·τ go first: they are
        # millions, and only the rest is a phase.
        turns = [frequency * self.delay for frequency in frequencies]
        angles = [-2 * math.pi * (turn - round(turn)) for turn in turns]
        self.phase = [(math.cos(angle), math.sin(angle)) for angle in angles]

    @property
    def azimuth_deg(self) -> float:
        """Azimuth of RX in the axes of TX [°]."""
        x, y, _ = unrotated(self.tx_pose.orientation, self.along)
        return math.degrees(math.atan2(y, x))


class Sight(NamedTuple):
    """Straight lines of all pairs of a scene, by transmitter, then receiver."""

    lines: list[Line]
    free: list[bool]
    """Whether nothing blocks each."""
    near: list[bool]
    """Whether its ends are so near to each other that there is no path."""


class Waves:
    """Waves of all pairs, added pair after pair as plain numbers.

    Args:
        carriers: Number of carriers.
    """

    def __init__(self, carriers: int) -> None:
        self.amplitude: list[list[complex]] = [[] for _ in range(carriers)]
        """On each carrier, without path gain."""
        self.tau: list[float] = []
        """[s]."""
        self.departure: list[Vector] = []
        """Unit vectors in world axes; ``arrival`` from RX towards the wave."""
        self.arrival: list[Vector] = []
        self.doppler_ratio: list[float] = []
        self.length: list[float] = []
        """Length of the pair's straight line [m], where path gain follows from it."""


BLOCK = 256
"""Frames whose draws are made at once: a generator costs more than what one frame takes from it."""


class Draws(NamedTuple):
    """Random draws of one pair for F frames; within a frame sorted by delay."""

    gain: Complex128Array
    """Of mean power 1, Shape ``[F, L]``."""
    excess: Float64Array
    """Delay after that of the straight line [s], Shape ``[F, L]``."""
    excess_free: Float64Array
    """The same, sorted after component 0: dropping the shortest of all would make the others longer."""
    deviation: Float64Array
    """[rad] of departure zenith and azimuth, arrival zenith and azimuth, Shape ``[F, L, 4]``."""

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
        return cls(gain, excess, excess_free, random.laplace(0.0, 1.0, (*shape, 4)) * scale)


class Shares(NamedTuple):
    """Amplitudes of the kinds of components."""

    straight: float
    """The straight path of a free pair."""
    behind: float
    """Each of the others of a free pair."""
    reflected: float
    """Each of a blocked pair."""

    @classmethod
    def of(cls, settings: GeometricSettings) -> Shares:
        """Amplitudes whose squares add up to 1; those of a blocked pair are weaker by ``nlos_loss_db``."""
        count, k = settings.components, 10 ** (settings.k_factor_db / 10)
        loss_db = 20.0 if settings.nlos_loss_db is None else settings.nlos_loss_db
        loss = 1.0 if settings.normalization == "unit" else 10 ** (-loss_db / 20)
        return cls(
            straight=math.sqrt(k / (k + 1)) if count > 1 else 1.0,
            behind=math.sqrt(1 / ((k + 1) * (count - 1))) if count > 1 else 0.0,
            reflected=math.sqrt(1 / count) * loss,
        )


class Components(NamedTuple):
    """Draws as they are beside any straight line. The straight path of a free pair is component 0, whose
    excess delay and deviations are 0."""

    amplitude: Float64Array
    """Real and imaginary part, with the carrier phase of the excess delay, Shape ``[..., C, L, 2]``."""
    excess: Float64Array
    """[s], Shape ``[..., L]``."""
    turn: Float64Array
    """Cosine and sine of the deviations: of zenith and azimuth at TX, then at RX, Shape ``[..., L, 8]``."""

    @classmethod
    def of(cls, draws: Draws, free: BoolArray, shares: Shares, frequencies: Float64Array) -> Components:
        """Components of pairs with and without a line of sight.

        Args:
            draws: Of Shape ``[...]`` in place of ``[F]``.
            free: Whether the line of sight is, of a shape that broadcasts to ``[...]``.
            shares: Amplitudes.
            frequencies: Of C carriers [Hz], Shape ``[C]``.
        """
        free = free[..., None]
        straight = free & (np.arange(draws.gain.shape[-1]) == 0)
        scaled = draws.gain * np.where(free, shares.behind, shares.reflected)
        gain = np.where(straight, shares.straight, scaled)[..., None, :]
        excess = np.where(straight, 0.0, np.where(free, draws.excess_free, draws.excess))
        phase = turn_phase(frequencies[:, None] * excess[..., None, :])
        amplitude = np.stack(times((gain.real, gain.imag), (phase.real, phase.imag)), axis=-1)
        turn = np.exp(1j * np.where(straight[..., None], 0.0, draws.deviation)).view(np.float64)
        return cls(amplitude, excess, turn)


N = TypeVar("N", float, Float64Array)
Turn: TypeAlias = tuple[N, N, N, N] | Sequence[N]
"""Cosine and sine of a zenith, cosine and sine of an azimuth."""


def times(a: tuple[N, N] | Sequence[N], b: tuple[N, N] | Sequence[N]) -> tuple[N, N]:
    """Real and imaginary part of the product of two complex numbers, or of arrays of them.

    Written out: processors that multiply and add in one step round a complex product in ways of their own.
    """
    (x, y), (u, v) = a, b
    return x * u - y * v, x * v + y * u


def turned(line: Turn[N], turn: Turn[N]) -> tuple[N, N, N]:
    """Unit vector of a direction that deviates from another one; a zenith beyond a pole comes down on its
    other side.

    Args:
        line: The other direction.
        turn: The deviations.

    Returns:
        x, y and z: numbers, or arrays.

    Example:
        >>> north_east = (0.0, 1.0, math.sqrt(0.5), math.sqrt(0.5))
        >>> [round(x, 9) for x in turned(north_east, (1.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)))]
        [0.0, 1.0, 0.0]
    """
    cosine, sine, along, across = line
    up, down, ahead, aside = turn
    level = sine * up + cosine * down
    return (
        level * (along * ahead - across * aside),
        level * (across * ahead + along * aside),
        cosine * up - sine * down,
    )


def superposed_waves(
    amplitude: Complex128Array, transmit: Complex128Array, receive: Complex128Array | None
) -> Complex128Array:
    """H[m, n] = Σ_l a[l] · receive[l, m] · transmit[l, n].

    Args:
        amplitude: On C carriers, Shape ``[..., C, L]``.
        transmit: Phases of the elements of TX, Shape ``[..., L, Nt]``.
        receive: Phases of the elements of RX, Shape ``[..., L, Nr]``; None: a single element, which sees
            every direction with the same phase.

    Returns:
        Shape ``[..., C, Nr, Nt]``.
    """
    weights = amplitude[..., None]
    if receive is not None:
        weights = weights * receive[..., None, :, :]
    terms = weights[..., None] * transmit[..., None, :, None, :]
    # One after the other: a product of matrices, and a sum along an axis, have an order that depends on the
    # shape.
    h: Complex128Array = terms[..., 0, :, :]
    for component in range(1, terms.shape[-3]):
        h = h + terms[..., component, :, :]
    return h


def velocity(scene: Scene, device: AntennaDevice) -> Vector:
    """Velocity of a device in world axes [m/s]."""
    if not device.parent:
        return (0.0, 0.0, 0.0)
    x, y, z = device_velocity(scene, device).tolist()
    return (x, y, z)


def angles(vector: Vector) -> tuple[float, float]:
    """Zenith and azimuth of a vector [rad].

    Example:
        >>> angles((0.0, 0.0, 2.0))
        (0.0, 0.0)
    """
    x, y, z = vector
    return (math.atan2(math.hypot(x, y), z), math.atan2(y, x))
