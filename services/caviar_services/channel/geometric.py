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

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import msgspec
import numpy as np

from caviar_protocol.arrays import BoolArray, Complex128Array, Float64Array, UInt64Array, quantity
from caviar_protocol.coordinates import SPEED_OF_LIGHT, angles
from caviar_protocol.seeding import generator
from caviar_protocol.topics import Channel, ChannelMatrix, ChannelOptions, Scene
from caviar_services.antenna import steering_vector
from caviar_services.channel.assemble import Antenna
from caviar_services.channel.base import ChannelModel, Modelled
from caviar_services.channel.occlusion import Boxes
from caviar_services.channel.patterns import element_amplitude
from caviar_services.service import Frame, RunInfo

BLOCK = 256
"""Frames whose draws are made at once: a generator costs more than what one frame takes from it."""

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
        self._frequency = np.array([carrier.frequency_hz for carrier in run.carriers])
        self._reflected = np.full(count, math.sqrt(1 / count))
        rest = math.sqrt(1 / ((k + 1) * (count - 1))) if count > 1 else 0.0
        self._behind_straight = np.full(count, rest)
        self._straight = math.sqrt(k / (k + 1)) if count > 1 else 1.0
        ids = [_id(f"component {number}") for number in range(count)]
        self._ids = np.array([ids, [_id("straight"), *ids[1:]]], np.uint64)
        """Of a pair without, and with a line of sight."""
        self._obstacles = Boxes.aligned([(box.minimum_m, box.maximum_m) for box in settings.obstacles])
        self._draws: dict[tuple[str, str], tuple[int, _Draws]] = {}
        loss_db = 20.0 if settings.nlos_loss_db is None else settings.nlos_loss_db
        self._nlos_factor = 10 ** (-loss_db / 20)
        unit = settings.normalization == "unit"
        self._nearest = 0.0 if unit else float((SPEED_OF_LIGHT / self._frequency).max())

    @property
    def options(self) -> ChannelOptions:
        return ChannelOptions(reflection=self.settings.components > 1, max_depth=1)

    def reset(self, episode: int, seed: int, t0_ns: int) -> None:
        """Forget the draws of the episode before."""
        self._draws.clear()

    def model(
        self, frame: Frame, scene: Scene, transmitters: Sequence[Antenna], receivers: Sequence[Antenna]
    ) -> Modelled:
        pairs = [(tx, rx) for tx in transmitters for rx in receivers]
        start = np.array([tx.position for tx, _ in pairs]).reshape(-1, 3)
        end = np.array([rx.position for _, rx in pairs]).reshape(-1, 3)
        distance = np.sqrt(((end - start) ** 2).sum(-1))
        is_far = (distance > 0) & (distance >= self._nearest)
        los = np.ones(len(pairs), np.bool_)
        if not is_far.all():
            chosen = np.flatnonzero(is_far).tolist()
            pairs = [pairs[index] for index in chosen]
            start, end, distance = start[is_far], end[is_far], distance[is_far]
        free = self._line_of_sight(scene, pairs, start, end)
        los[is_far] = free
        waves = self._waves(frame, pairs, start, end, distance, free)
        return Modelled(
            channel=self._channel(transmitters, receivers, pairs, waves, los, is_far, free),
            counts={"too_close": int(np.count_nonzero(~is_far))},
        )

    # --- the line of sight -----------------------------------------------------------------------

    def _line_of_sight(
        self, scene: Scene, pairs: Sequence[tuple[Antenna, Antenna]], start: Float64Array, end: Float64Array
    ) -> BoolArray:
        """Whether it is free, Shape ``[Q]``."""
        settings = self.settings
        if settings.nlos_azimuth_deg is not None:
            low, high = settings.nlos_azimuth_deg
            local = [(line @ tx.rotation).tolist() for line, (tx, _) in zip(end - start, pairs, strict=True)]
            # Ranges may lie anywhere on the circle: [170, 190] is behind an array.
            return np.array(
                [(math.degrees(math.atan2(y, x)) - low) % 360 > high - low for x, y, _ in local], np.bool_
            )
        free = np.ones(len(pairs), np.bool_)
        if settings.nlos == "geometry" and pairs:
            free &= ~self._obstacles.block(start, end).any(-1)
            boxes = Boxes.of(scene)
            parents = {device.name: device.parent for device in scene.devices}
            carries = np.array(
                [[name in (parents[tx.name], parents[rx.name]) for name in boxes.names] for tx, rx in pairs]
            )
            free &= ~(boxes.block(start, end) & ~carries.reshape(len(pairs), -1)).any(-1)
        return free

    # --- waves -----------------------------------------------------------------------------------------

    def _waves(
        self,
        frame: Frame,
        pairs: Sequence[tuple[Antenna, Antenna]],
        start: Float64Array,
        end: Float64Array,
        distance: Float64Array,
        free: BoolArray,
    ) -> _Waves:
        draws = [self._drawn(frame, tx.name, rx.name) for tx, rx in pairs]
        gain = np.array([row[0] for row in draws]).reshape(len(pairs), -1)
        excess = np.array([row[1] for row in draws]).reshape(gain.shape)
        deviation = np.array([row[2] for row in draws]).reshape(*gain.shape, 4)
        gain = gain * np.where(free[:, None], self._behind_straight, self._reflected)

        line = (end - start) / distance[:, None]
        zenith, azimuth = angles(line).T[..., None]
        departure = _unit(zenith + deviation[..., 0], azimuth + deviation[..., 1])
        arrival = _unit(np.pi - zenith + deviation[..., 2], azimuth + np.pi + deviation[..., 3])
        if free.any():
            gain[free, 0], excess[free, 0] = self._straight, 0.0
            departure[free, 0], arrival[free, 0] = line[free], -line[free]

        tau = distance[:, None] / SPEED_OF_LIGHT + excess
        velocity = np.array([(tx.velocity, rx.velocity) for tx, rx in pairs]).reshape(-1, 2, 1, 3)
        turns = self._frequency[:, None, None] * tau
        a = gain * np.exp(-2j * np.pi * (turns - np.round(turns)))
        if self.settings.normalization == "path-loss":
            a = a * self._path_gain(pairs, distance, free, departure, arrival)
        return _Waves(
            a=a,
            tau=tau,
            departure=departure,
            arrival=arrival,
            # A source that moves along its wave, and a receiver that moves against it, raise the frequency.
            doppler_ratio=(velocity[:, 0] * departure + velocity[:, 1] * arrival).sum(-1) / SPEED_OF_LIGHT,
        )

    def _path_gain(
        self,
        pairs: Sequence[tuple[Antenna, Antenna]],
        distance: Float64Array,
        free: BoolArray,
        departure: Float64Array,
        arrival: Float64Array,
    ) -> Float64Array:
        """λ/(4πd), the loss without line of sight and both element patterns, Shape ``[C, Q, L]``."""
        spreading = SPEED_OF_LIGHT / self._frequency[:, None] / (4 * np.pi * distance)
        spreading = spreading * np.where(free, 1.0, self._nlos_factor)
        patterns = [
            element_amplitude(tx.array.pattern, departure[q] @ tx.rotation)
            * element_amplitude(rx.array.pattern, arrival[q] @ rx.rotation)
            for q, (tx, rx) in enumerate(pairs)
        ]
        factor: Float64Array = spreading[..., None] * np.array(patterns).reshape(1, len(pairs), -1)
        return factor

    def _drawn(self, frame: Frame, tx: str, rx: str) -> tuple[Complex128Array, Float64Array, Float64Array]:
        """Gain, excess delay and deviations of a pair's components in a frame, sorted by delay."""
        whole_episode = self.settings.redraw == "episode"
        block, row = (0, 0) if whole_episode else divmod(frame.number, BLOCK)
        known = self._draws.get((tx, rx))
        if known is None or known[0] != block:
            random = generator(frame.seed, frame.seed_episode, f"{self.run.name}/{tx}/{rx}", block)
            known = self._draws[tx, rx] = (
                block,
                _Draws.of(random, 1 if whole_episode else BLOCK, self.settings),
            )
        made = known[1]
        return made.gain[row], made.excess[row], made.deviation[row]

    # --- the product -----------------------------------------------------------------------------------

    def _channel(
        self,
        transmitters: Sequence[Antenna],
        receivers: Sequence[Antenna],
        pairs: Sequence[tuple[Antenna, Antenna]],
        waves: _Waves,
        los: BoolArray,
        is_far: BoolArray,
        free: BoolArray,
    ) -> Channel:
        count = len(waves.tau) * self.settings.components
        offsets = np.zeros(len(is_far) + 1, np.int64)
        np.cumsum(is_far * self.settings.components, out=offsets[1:])
        carriers = len(self._frequency)
        ids: UInt64Array = self._ids[free.astype(np.intp)].reshape(-1)
        return Channel(
            rung=self.rung,
            options=self.options,
            carriers=self.run.carriers,
            tx=tuple(antenna.name for antenna in transmitters),
            rx=tuple(antenna.name for antenna in receivers),
            los=los.reshape(len(transmitters), len(receivers)),
            offsets=offsets,
            id=ids,
            a=waves.a.reshape(carriers, -1),
            tau=waves.tau.reshape(-1),
            aod=angles(waves.departure).reshape(-1, 2),
            aoa=angles(waves.arrival).reshape(-1, 2),
            doppler=self._frequency[:, None] * waves.doppler_ratio.reshape(-1),
            interactions=np.zeros((count, 0), np.uint8),
            points=np.zeros((count, 0, 3)),
            objects=np.zeros((count, 0), np.int32),
            h=self._matrices(transmitters, receivers, pairs, waves, is_far) if self.with_h else (),
        )

    def _matrices(
        self,
        transmitters: Sequence[Antenna],
        receivers: Sequence[Antenna],
        pairs: Sequence[tuple[Antenna, Antenna]],
        waves: _Waves,
        is_far: BoolArray,
    ) -> tuple[ChannelMatrix, ...]:
        """H of every carrier and pair; zeros for a pair without waves."""
        steered, places = [], {}
        for q, (pair, (tx, rx)) in enumerate(zip(np.flatnonzero(is_far).tolist(), pairs, strict=True)):
            transmit = steering_vector(tx.array, waves.departure[q] @ tx.rotation)
            receive = steering_vector(rx.array, waves.arrival[q] @ rx.rotation)
            steered.append((transmit, receive))
            places[pair] = q
        found = []
        for carrier, a in enumerate(waves.a):
            for pair in range(len(is_far)):
                tx_index, rx_index = divmod(pair, len(receivers))
                q = places.get(pair, -1)
                if q < 0:
                    shape = receivers[rx_index].array.size, transmitters[tx_index].array.size
                    h: Complex128Array = np.zeros(shape, np.complex128)
                else:
                    transmit, receive = steered[q]
                    h = (receive * a[q, :, None]).T @ transmit
                found.append(ChannelMatrix(carrier=carrier, tx=tx_index, rx=rx_index, h=h))
        return tuple(found)


@dataclass(frozen=True, eq=False)
class _Waves:
    """Waves of Q pairs with L components each, on C carriers."""

    a: Complex128Array
    """Shape ``[C, Q, L]``."""
    tau: Float64Array
    """[s], Shape ``[Q, L]``."""
    departure: Float64Array
    """Unit vectors in world axes, Shape ``[Q, L, 3]``; ``arrival`` from RX towards the wave."""
    arrival: Float64Array
    doppler_ratio: Float64Array
    """Shape ``[Q, L]``."""


@dataclass(frozen=True, eq=False)
class _Draws:
    """Draws of one pair for some frames, within a frame sorted by delay."""

    gain: Complex128Array
    """Of mean power 1, Shape ``[frames, L]``."""
    excess: Float64Array
    """[s], Shape ``[frames, L]``."""
    deviation: Float64Array
    """[rad] of departure zenith and azimuth, arrival zenith and azimuth, Shape ``[frames, L, 4]``."""

    @classmethod
    def of(cls, random: np.random.Generator, frames: int, settings: GeometricSettings) -> _Draws:
        shape = (frames, settings.components)
        gain = random.normal(0.0, math.sqrt(0.5), (*shape, 2)).view(np.complex128)[..., 0]
        excess = np.sort(random.exponential(settings.delay_spread_ns * 1e-9, shape), axis=-1)
        spreads = (
            settings.zenith_spread_departure_deg,
            settings.azimuth_spread_departure_deg,
            settings.zenith_spread_arrival_deg,
            settings.azimuth_spread_arrival_deg,
        )
        scale = np.radians(spreads) / math.sqrt(2)  # a Laplacian of scale b has the variance 2b²
        return cls(gain, excess, random.laplace(0.0, 1.0, (*shape, 4)) * scale)


def _unit(zenith: Float64Array, azimuth: Float64Array) -> Float64Array:
    """Unit vectors of directions, Shape ``[..., 3]``; a zenith beyond a pole comes down on its other side."""
    sine = np.sin(zenith)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(zenith)], axis=-1)


def _id(kind: str) -> int:
    return int.from_bytes(hashlib.blake2b(kind.encode(), digest_size=8).digest(), "little")
