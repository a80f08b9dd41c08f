"""Rung ``geometric``: a few multipath components drawn from stated distributions.

The model of the paper's INLOOP experiment (Oliveira et al., section 4): the narrowband channel of
each TX/RX pair is a sum of L = 3 plane waves (Heath et al., "An Overview of Signal Processing
Techniques for Millimeter Wave MIMO Systems", 2016, eq. 6),

    H = Σ_l a_l · a_r(AoA_l) · a_t(AoD_l)ᵀ.

With a free line of sight, component 0 is the straight path, of power K/(K + 1), and the others share
the rest; without one, all L are reflected. A reflected component l has

* a gain that is complex Gaussian (Rayleigh), all of equal mean power;
* an excess delay that is exponential with mean ``delay_spread_ns``, behind the straight line's d/c;
* directions that deviate from the straight line by Laplacian angles, of the spreads in the settings, in
  zenith and azimuth at both ends (3GPP TR 38.901, section 7.5, has the same two distributions).

The defaults are the medians of 3GPP TR 38.901, table 7.5-6, UMi street canyon with line of sight at
28 GHz, rounded. Draws depend on seed, episode, pair and frame alone (contract, clause 19).

**Normalisation.** ``unit``: the components' mean powers sum up to 1 whatever distance, carrier and
antenna pattern, so that E‖H‖² = Nt·Nr. A single wave of amplitude 1 that lies on the DFT grid then has
|y| = sqrt(Nt·Nr), which is 8 for 64 elements and a single antenna; half-way between two beams it has 5.09,
and 6.98 on average over the grid: the paper's optimum, "always larger than 5" with mean 6.81, is on
this scale. ``path-loss``: times λ/(4πd) and the two element patterns, and ``nlos_loss_db`` weaker
without line of sight.
"""

from __future__ import annotations

import cmath
import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from typing import Annotated, ClassVar, Literal, NamedTuple

import msgspec
import numpy as np

from caviar_protocol.arrays import Complex128Array, Float64Array, quantity
from caviar_protocol.coordinates import SPEED_OF_LIGHT, Pose, Vector, unrotated
from caviar_protocol.scene import device_pose, device_velocity
from caviar_protocol.seeding import generator
from caviar_protocol.topics import AntennaDevice, Channel, ChannelMatrix, ChannelOptions, Scene
from caviar_services.antenna import steering_vector
from caviar_services.channel.base import ChannelModel, Modelled
from caviar_services.channel.occlusion import Boxes
from caviar_services.channel.patterns import element_amplitude
from caviar_services.service import Frame, RunInfo

BLOCK = 256
"""Frames whose draws are made at once: a generator costs more than what one frame takes from it."""

KEPT = 4096
"""Pairs whose draws are kept at most."""

Corner = tuple[float, float, float]
Spread = Annotated[float, quantity("°", "standard deviation of a Laplacian", ge=0, le=180)]


class Obstacle(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A box along the world's axes that blocks the line of sight."""

    minimum_m: Annotated[Corner, quantity("m", "lowest corner")]
    maximum_m: Annotated[Corner, quantity("m", "highest corner")]

    def __post_init__(self) -> None:
        if not all(low < high for low, high in zip(self.minimum_m, self.maximum_m, strict=True)):
            raise ValueError(f"minimum_m {self.minimum_m} is not below maximum_m {self.maximum_m}")


class GeometricSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the channel ``geometric``."""

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


class GeometricChannel(ChannelModel[GeometricSettings]):
    """L waves for each TX/RX pair.

    Paths have no interaction points: none are known. Under ``path-loss`` a pair closer than one
    wavelength, under ``unit`` one at the same point, has no path and counts as ``too_close``.
    """

    Settings = GeometricSettings
    rung: ClassVar[str] = "geometric"

    def __init__(self, settings: GeometricSettings, run: RunInfo) -> None:
        super().__init__(settings, run)
        count, k = settings.components, 10 ** (settings.k_factor_db / 10)
        self._frequencies = [carrier.frequency_hz for carrier in run.carriers]
        self._frequency = np.array(self._frequencies)[:, None]
        self._reflected = math.sqrt(1 / count)
        self._behind_straight = math.sqrt(1 / ((k + 1) * (count - 1))) if count > 1 else 0.0
        self._straight = math.sqrt(k / (k + 1)) if count > 1 else 1.0
        ids = [_id(f"component {number}") for number in range(count)]
        self._ids = {False: ids, True: [_id("straight"), *ids[1:]]}
        """Of a pair, by whether its line of sight is free."""
        self._obstacles = Boxes.aligned([(box.minimum_m, box.maximum_m) for box in settings.obstacles])
        self._draws: dict[tuple[str, str], _Draws] = {}
        self._block = 0
        loss_db = 20.0 if settings.nlos_loss_db is None else settings.nlos_loss_db
        self._nlos_factor = 10 ** (-loss_db / 20)
        self._unit = settings.normalization == "unit"
        self._nearest = 0.0 if self._unit else float((SPEED_OF_LIGHT / self._frequency).max())

    @property
    def options(self) -> ChannelOptions:
        return ChannelOptions(reflection=self.settings.components > 1, max_depth=1)

    def reset(self, episode: int, seed: int, t0_ns: int) -> None:
        """Forget the draws of the episode before."""
        self._draws.clear()

    def model(
        self,
        frame: Frame,
        scene: Scene,
        transmitters: Sequence[AntennaDevice],
        receivers: Sequence[AntennaDevice],
    ) -> Modelled:
        waves, count = _Waves(), self.settings.components
        offsets, los, blocked = [0], [], self._blocks(scene)
        poses = {device.name: device_pose(scene, device) for device in (*transmitters, *receivers)}
        speeds = {device.name: _velocity(scene, device) for device in (*transmitters, *receivers)}
        for tx in transmitters:
            for rx in receivers:
                pair = _Line(tx, rx, poses[tx.name], poses[rx.name], speeds[tx.name], speeds[rx.name])
                is_near = pair.length == 0 or pair.length < self._nearest
                free = is_near or not blocked(pair)
                if not is_near:
                    self._add(waves, frame, pair, free)
                los.append(free)
                offsets.append(len(waves.tau))
        too_close = len(los) - len(waves.tau) // count
        channel = self._channel(transmitters, receivers, poses, waves, los, offsets)
        return Modelled(channel=channel, counts={"too_close": too_close} if too_close else {})

    # --- the line of sight -----------------------------------------------------------------------

    def _blocks(self, scene: Scene) -> Callable[[_Line], bool]:
        """What says of a line of this scene whether something blocks it."""
        settings = self.settings
        if settings.nlos_azimuth_deg is not None:
            low, high = settings.nlos_azimuth_deg
            # Ranges may lie anywhere on the circle: [170, 190] is behind an array.
            return lambda pair: (pair.azimuth_deg - low) % 360 <= high - low
        if settings.nlos == "never":
            return lambda pair: False
        boxes = Boxes.of(scene)

        def hidden(pair: _Line) -> bool:
            ends = np.array([pair.start, pair.end])[:, None]
            if self._obstacles.block(*ends).any():
                return True
            carriers = (pair.tx.parent, pair.rx.parent)
            met = np.flatnonzero(boxes.block(*ends)[0]).tolist()
            return any(boxes.names[index] not in carriers for index in met)

        return hidden

    # --- waves -----------------------------------------------------------------------------------------

    def _add(self, waves: _Waves, frame: Frame, pair: _Line, free: bool) -> None:
        """The components of a pair.

        Numbers, not arrays: there are a handful of waves, and an array of three costs as much as ten numbers.
        """
        gains, excess, deviations = self._drawn(frame, pair.tx.name, pair.rx.name, free)
        scale = self._behind_straight if free else self._reflected
        delay = pair.length / SPEED_OF_LIGHT
        loss = 1.0 if free or self._unit else self._nlos_factor
        for number, gain in enumerate(gains):
            if free and number == 0:
                amplitude, tau, departure, arrival = complex(self._straight), delay, pair.along, pair.back
            else:
                amplitude, tau = gain * scale, delay + excess[number]
                tilt = deviations[number]
                departure = _direction(pair.zenith + tilt[0], pair.azimuth + tilt[1])
                arrival = _direction(math.pi - pair.zenith + tilt[2], pair.azimuth + math.pi + tilt[3])
            waves.amplitude.append(amplitude * loss)
            waves.tau.append(tau)
            waves.departure.append(departure)
            waves.arrival.append(arrival)
            # A source that moves along its wave, and a receiver that moves against it, raise the frequency.
            approach = _dot(pair.velocity[0], departure) + _dot(pair.velocity[1], arrival)
            waves.doppler_ratio.append(approach / SPEED_OF_LIGHT)
        waves.id += self._ids[free]
        waves.length += [pair.length] * len(gains)

    def _drawn(
        self, frame: Frame, tx: str, rx: str, free: bool
    ) -> tuple[Sequence[complex], Sequence[float], Sequence[Sequence[float]]]:
        """Gain, excess delay and deviations of a pair's components in a frame, sorted by delay.

        Where the line of sight is ``free``, component 0 stands in front and its delay is not used.
        """
        whole_episode = self.settings.redraw == "episode"
        block, row = (0, 0) if whole_episode else divmod(frame.number, BLOCK)
        if block != self._block or (whole_episode and len(self._draws) >= KEPT):
            # Pairs that have left go with it; the others draw the same again.
            self._draws.clear()
            self._block = block
        made = self._draws.get((tx, rx))
        if made is None:
            random = generator(frame.seed, frame.seed_episode, f"{self.run.name}/{tx}/{rx}", block)
            made = _Draws.of(random, 1 if whole_episode else BLOCK, self.settings)
            self._draws[tx, rx] = made
        return made.gain[row], (made.excess_free if free else made.excess)[row], made.deviation[row]

    # --- the product -----------------------------------------------------------------------------------

    def _channel(
        self,
        transmitters: Sequence[AntennaDevice],
        receivers: Sequence[AntennaDevice],
        poses: Mapping[str, Pose],
        waves: _Waves,
        los: list[bool],
        offsets: list[int],
    ) -> Channel:
        a = np.array([_with_phase(waves, f) for f in self._frequencies], np.complex128)
        pairs = [
            _Arrived(tx, rx, poses[tx.name], poses[rx.name], slice(*ends))
            for (tx, rx), ends in zip(product(transmitters, receivers), pairwise(offsets), strict=True)
        ]
        if not self._unit:
            a *= self._path_gain(waves, pairs)
        count = len(waves.tau)
        return Channel(
            rung=self.rung,
            options=self.options,
            carriers=self.run.carriers,
            tx=tuple(device.name for device in transmitters),
            rx=tuple(device.name for device in receivers),
            los=np.array(los, np.bool_).reshape(len(transmitters), len(receivers)),
            offsets=np.array(offsets, np.int64),
            id=np.array(waves.id, np.uint64),
            a=a,
            tau=np.array(waves.tau, np.float64),
            aod=np.array([_angles(vector) for vector in waves.departure], np.float64).reshape(-1, 2),
            aoa=np.array([_angles(vector) for vector in waves.arrival], np.float64).reshape(-1, 2),
            doppler=self._frequency * np.array(waves.doppler_ratio, np.float64),
            interactions=np.zeros((count, 0), np.uint8),
            points=np.zeros((count, 0, 3)),
            objects=np.zeros((count, 0), np.int32),
            h=self._matrices(a, waves, pairs, len(receivers)) if self.with_h else (),
        )

    def _path_gain(self, waves: _Waves, pairs: Sequence[_Arrived]) -> Float64Array:
        """λ/(4πd) and both element patterns, Shape ``[C, P]``."""
        patterns = np.ones(len(waves.tau))
        for pair in pairs:
            patterns[pair.mine] = element_amplitude(pair.tx.array.pattern, pair.departures(waves))
            patterns[pair.mine] *= element_amplitude(pair.rx.array.pattern, pair.arrivals(waves))
        factor: Float64Array = (
            SPEED_OF_LIGHT / self._frequency / (4 * np.pi * np.array(waves.length)) * patterns
        )
        return factor

    def _matrices(
        self, a: Complex128Array, waves: _Waves, pairs: Sequence[_Arrived], receivers: int
    ) -> tuple[ChannelMatrix, ...]:
        """H[m, n] = Σ_l a[l] · receive[l, m] · transmit[l, n] of every carrier and pair."""
        steered = []
        for pair in pairs:
            transmit = steering_vector(pair.tx.array, pair.departures(waves))
            # A single element sees every direction with the same phase.
            single = pair.rx.array.size == 1
            steered.append(
                (transmit, None if single else steering_vector(pair.rx.array, pair.arrivals(waves)))
            )
        found = []
        for carrier, of_carrier in enumerate(a):
            for number, (pair, (transmit, receive)) in enumerate(zip(pairs, steered, strict=True)):
                tx, rx = divmod(number, receivers)
                mine = of_carrier[pair.mine]
                h = mine[None] @ transmit if receive is None else (receive * mine[:, None]).T @ transmit
                found.append(ChannelMatrix(carrier=carrier, tx=tx, rx=rx, h=h))
        return tuple(found)


class _Arrived(NamedTuple):
    """A pair, and which of the waves are its own."""

    tx: AntennaDevice
    rx: AntennaDevice
    tx_pose: Pose
    rx_pose: Pose
    mine: slice

    def departures(self, waves: _Waves) -> Float64Array:
        """In the axes of TX, Shape ``[L, 3]``."""
        return _in_axes(self.tx_pose, waves.departure[self.mine])

    def arrivals(self, waves: _Waves) -> Float64Array:
        """In the axes of RX, Shape ``[L, 3]``."""
        return _in_axes(self.rx_pose, waves.arrival[self.mine])


def _in_axes(pose: Pose, vectors: Sequence[Vector]) -> Float64Array:
    turned = pose.orientation
    return np.array([unrotated(turned, vector) for vector in vectors], np.float64).reshape(-1, 3)


class _Line:
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
        self.zenith, self.azimuth = _angles(self.along)

    @property
    def azimuth_deg(self) -> float:
        """Azimuth of RX in the axes of TX [°]."""
        x, y, _ = unrotated(self.tx_pose.orientation, self.along)
        return math.degrees(math.atan2(y, x))


class _Waves:
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
class _Draws:
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
    def of(cls, random: np.random.Generator, frames: int, settings: GeometricSettings) -> _Draws:
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


def _with_phase(waves: _Waves, frequency: float) -> list[complex]:
    """Amplitudes with exp(−j2πfτ)."""
    # The whole turns of f·τ go first: they are millions, and only the rest is a phase.
    turns = [frequency * tau for tau in waves.tau]
    phases = [cmath.rect(1.0, -2 * math.pi * (turn - round(turn))) for turn in turns]
    return [amplitude * phase for amplitude, phase in zip(waves.amplitude, phases, strict=True)]


def _velocity(scene: Scene, device: AntennaDevice) -> Vector:
    x, y, z = device_velocity(scene, device).tolist()
    return (x, y, z)


def _direction(zenith: float, azimuth: float) -> Vector:
    """Unit vector of a direction; a zenith beyond a pole comes down on its other side."""
    sine = math.sin(zenith)
    return (sine * math.cos(azimuth), sine * math.sin(azimuth), math.cos(zenith))


def _angles(vector: Vector) -> tuple[float, float]:
    """(zenith, azimuth) [rad]."""
    x, y, z = vector
    return (math.atan2(math.hypot(x, y), z), math.atan2(y, x))


def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _id(kind: str) -> int:
    return int.from_bytes(hashlib.blake2b(kind.encode(), digest_size=8).digest(), "little")
