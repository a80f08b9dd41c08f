"""Rung ``geometric``: a few multipath components drawn from stated distributions.

The model of the paper's INLOOP experiment (Oliveira et al., section 4): the narrowband channel of
each TX/RX pair is a sum of L = 3 plane waves (Heath et al., "An Overview of Signal Processing
Techniques for Millimeter Wave MIMO Systems", 2016, eq. 6),

    H = Σ_l a_l · a_r(AoA_l) · a_t(AoD_l)ᵀ.

With a free line of sight, component 0 is the straight path, of power K/(K + 1), and the others share
the rest; without one, all L are reflected. A reflected component l has

* a gain that is complex Gaussian (Rayleigh), all of equal mean power;
* an excess delay that is exponential with mean ``delay_spread_ns``, after the straight line's d/c;
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

Waves have no polarization: arrays of dual polarization, and of several panels, are refused.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np

from caviar_protocol.arrays import (
    BoolArray,
    Complex64Array,
    Complex128Array,
    Float64Array,
    Int32Array,
    Int64Array,
    UInt8Array,
    UInt64Array,
)
from caviar_protocol.errors import PayloadError, ScenarioError
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.seeding import generator
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT, Pose
from caviar_protocol.space.scene import device_pose
from caviar_protocol.topics import AntennaDevice, Channel, ChannelMatrix, ChannelOptions, Scene
from caviar_services.antenna_arrays import steering_vector
from caviar_services.channel.arrays.channel_matrices import (
    Bins,
    Wideband,
    bins_of,
    superposed,
    wideband_parts,
)
from caviar_services.channel.base import ChannelModel, Modelled
from caviar_services.channel.propagation.atmosphere import amplitude_factor
from caviar_services.channel.propagation.clearance import Boxes
from caviar_services.channel.statistical.waves import (
    Draws,
    GeometricSettings,
    Line,
    PairWaves,
    Waves,
    angles,
    direction,
    dot,
    velocity,
    with_phase,
)
from caviar_services.service import Frame, Preparation, RunInfo

BLOCK = 256
"""Frames whose draws are made at once: a generator costs more than what one frame takes from it."""

KEPT = 4096
"""Pairs whose draws are kept at most."""


_NOT_UNIFORM = (
    "has an array of dual polarization or of several panels, and the waves of the channel 'geometric' have "
    'no polarization; take one of V, H, -45, +45, RHCP and LHCP without panels, or use = "sionna-rt"'
)


class GeometricChannel(ChannelModel[GeometricSettings]):
    """L waves for each TX/RX pair.

    Paths have no interaction points: none are known. Under ``path-loss`` a pair closer than one
    wavelength, under ``unit`` one at the same point, has no path and counts as ``too_close``.

    Example:
        >>> from caviar_services.channel.stability.lab import geometric, link
        >>> channel = link(geometric(28e9, components=3, k_factor_db=10.0), (0, 0, 10), (30, 40, 1.5))
        >>> len(channel.tau), round(float(abs(channel.a[0, 0]) ** 2), 3)  # the straight path has K / (K + 1)
        (3, 0.909)
    """

    Settings = GeometricSettings
    rung = "geometric"

    def __init__(self, settings: GeometricSettings, run: RunInfo) -> None:
        super().__init__(settings, run)
        count, k = settings.components, 10 ** (settings.k_factor_db / 10)
        self._frequencies = [carrier.frequency_hz for carrier in run.carriers]
        self._frequency = np.array(self._frequencies)[:, None]
        # Amplitudes: all components of a blocked pair share the power, of a free one those after the
        # straight path.
        self._reflected = math.sqrt(1 / count)
        self._behind_straight = math.sqrt(1 / ((k + 1) * (count - 1))) if count > 1 else 0.0
        self._straight = math.sqrt(k / (k + 1)) if count > 1 else 1.0
        ids = [_id(f"component {number}") for number in range(count)]
        # Of a pair, by whether its line of sight is free.
        self._ids = {False: ids, True: [_id("straight"), *ids[1:]]}
        self._obstacles = Boxes.aligned([(box.minimum_m, box.maximum_m) for box in settings.obstacles])
        self._draws: dict[tuple[str, str], Draws] = {}
        self._block = 0
        loss_db = 20.0 if settings.nlos_loss_db is None else settings.nlos_loss_db
        self._nlos_factor = 10 ** (-loss_db / 20)
        self._unit = settings.normalization == "unit"
        self._nearest = 0.0 if self._unit else float((SPEED_OF_LIGHT / self._frequency).max())

    @property
    def options(self) -> ChannelOptions:
        return ChannelOptions(reflection=self.settings.components > 1, max_depth=1)

    def load(self, preparation: Preparation) -> tuple[str, ...]:
        """Check the arrays of the run's devices.

        Raises:
            ScenarioError: An array has dual polarization or several panels.
        """
        for spec in self.run.devices:
            if spec.array is not None and not spec.array.is_uniform:
                place = Place("devices").at(spec.name).at("array")
                raise ScenarioError(f"device {spec.name!r} {_NOT_UNIFORM}", key=place.key)
        return ()

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
        for device in (*transmitters, *receivers):
            if not device.array.is_uniform:
                raise PayloadError(f"device {device.name!r} {_NOT_UNIFORM}")
        waves, count = Waves(), self.settings.components
        offsets, los, blocked = [0], [], self._blocks(scene)
        poses = {device.name: device_pose(scene, device) for device in (*transmitters, *receivers)}
        speeds = {device.name: velocity(scene, device) for device in (*transmitters, *receivers)}
        for tx in transmitters:
            for rx in receivers:
                pair = Line(tx, rx, poses[tx.name], poses[rx.name], speeds[tx.name], speeds[rx.name])
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

    def _blocks(self, scene: Scene) -> Callable[[Line], bool]:
        """A function that says whether something in the scene blocks a line."""
        settings = self.settings
        if settings.nlos_azimuth_deg is not None:
            low, high = settings.nlos_azimuth_deg
            # Ranges may lie anywhere on the circle: [170, 190] is behind an array.
            return lambda pair: (pair.azimuth_deg - low) % 360 <= high - low
        if settings.nlos == "never":
            return lambda pair: False
        boxes = Boxes.of(scene)
        # An antenna stands on its own vehicle, whose box must not block it.

        def hidden(pair: Line) -> bool:
            ends = np.array([pair.start, pair.end])[:, None]
            if self._obstacles.block(*ends).any():
                return True
            carriers = (pair.tx.parent, pair.rx.parent)
            met = np.flatnonzero(boxes.block(*ends)[0]).tolist()
            return any(boxes.names[index] not in carriers for index in met)

        return hidden

    # --- waves -----------------------------------------------------------------------------------------

    def _add(self, waves: Waves, frame: Frame, pair: Line, free: bool) -> None:
        """Add the components of a pair."""
        # Numbers, not arrays: there are a handful of waves, and an array of three costs as much as ten
        # numbers.
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
                departure = direction(pair.zenith + tilt[0], pair.azimuth + tilt[1])
                arrival = direction(math.pi - pair.zenith + tilt[2], pair.azimuth + math.pi + tilt[3])
            waves.amplitude.append(amplitude * loss)
            waves.tau.append(tau)
            waves.departure.append(departure)
            waves.arrival.append(arrival)
            # To first order in v/c: motion of either end along its own direction outwards raises the
            # frequency.
            approach = dot(pair.velocity[0], departure) + dot(pair.velocity[1], arrival)
            waves.doppler_ratio.append(approach / SPEED_OF_LIGHT)
        waves.id += self._ids[free]
        waves.length += [pair.length] * len(gains)

    def _drawn(
        self, frame: Frame, tx: str, rx: str, free: bool
    ) -> tuple[Sequence[complex], Sequence[float], Sequence[Sequence[float]]]:
        """Gain, excess delay and deviations of a pair's components in a frame, sorted by delay.

        Where the line of sight is ``free``, component 0 stands in front and its delay is not used.
        """
        # Blocks begin at fixed numbers, so that a frame has the same draws wherever a run or a replay begins.
        whole_episode = self.settings.redraw == "episode"
        block, row = (0, 0) if whole_episode else divmod(frame.number, BLOCK)
        if block != self._block or (whole_episode and len(self._draws) >= KEPT):
            # Pairs that have left go with it; the others draw the same again.
            self._draws.clear()
            self._block = block
        made = self._draws.get((tx, rx))
        if made is None:
            random = generator(frame.seed, frame.seed_episode, f"{self.run.name}/{tx}/{rx}", block)
            made = Draws.of(random, 1 if whole_episode else BLOCK, self.settings)
            self._draws[tx, rx] = made
        return made.gain[row], (made.excess_free if free else made.excess)[row], made.deviation[row]

    # --- the product -----------------------------------------------------------------------------------

    def _channel(
        self,
        transmitters: Sequence[AntennaDevice],
        receivers: Sequence[AntennaDevice],
        poses: Mapping[str, Pose],
        waves: Waves,
        los: list[bool],
        offsets: list[int],
    ) -> Channel:
        a = np.array([with_phase(waves, f) for f in self._frequencies], np.complex128)
        pairs = [
            PairWaves(tx, rx, poses[tx.name], poses[rx.name], slice(*ends))
            for (tx, rx), ends in zip(product(transmitters, receivers), pairwise(offsets), strict=True)
        ]
        if not self._unit:
            a *= self._path_gain(waves, pairs)
        # One array for both ends: making an array costs more than its numbers.
        both = waves.departure + waves.arrival
        aod, aoa = np.array([x for wave in both for x in angles(wave)], np.float64).reshape(2, -1, 2)
        shape = (len(transmitters), len(receivers))
        constant = _constant(tuple(los), tuple(offsets), tuple(waves.id), shape)
        wideband = self._wideband(a, waves, pairs, constant.offsets, len(receivers))
        return Channel(
            rung=self.rung,
            options=self.modelled,
            carriers=self.run.carriers,
            tx=tuple([device.name for device in transmitters]),
            rx=tuple([device.name for device in receivers]),
            los=constant.los,
            offsets=constant.offsets,
            id=constant.id,
            a=a,
            tau=np.array(waves.tau, np.float64),
            aod=aod,
            aoa=aoa,
            doppler=self._frequency * np.array(waves.doppler_ratio, np.float64),
            interactions=constant.interactions,
            points=constant.points,
            objects=constant.objects,
            h=self._matrices(a, waves, pairs, len(receivers)) if self.with_h else (),
            hf=wideband.hf,
            taps=wideband.taps,
        )

    def _path_gain(self, waves: Waves, pairs: Sequence[PairWaves]) -> Float64Array:
        """λ/(4πd), both element patterns and absorption, Shape ``[C, P]``."""
        patterns = np.ones(len(waves.tau))
        for pair in pairs:
            patterns[pair.mine] = self.patterns.of(pair.tx.array).amplitude(pair.departures(waves))
            patterns[pair.mine] *= self.patterns.of(pair.rx.array).amplitude(pair.arrivals(waves))
        factor: Float64Array = (
            SPEED_OF_LIGHT / self._frequency / (4 * np.pi * np.array(waves.length)) * patterns
        )
        if self.absorption_db_per_km is not None:
            factor *= amplitude_factor(self.absorption_db_per_km, np.array(waves.tau))
        return factor

    def _matrices(
        self, a: Complex128Array, waves: Waves, pairs: Sequence[PairWaves], receivers: int
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
                h = mine.dot(transmit)[None] if receive is None else (receive * mine[:, None]).T @ transmit
                found.append(ChannelMatrix(carrier=carrier, tx=tx, rx=rx, h=h))
        return tuple(found)

    def _wideband(
        self,
        a: Complex128Array,
        waves: Waves,
        pairs: Sequence[PairWaves],
        offsets: Int64Array,
        receivers: int,
    ) -> Wideband:
        """The parts ``hf`` and ``taps`` in demand."""
        if not self.wideband:
            return Wideband()
        tau, ratio = np.array(waves.tau), np.array(waves.doppler_ratio)

        def responses(bins: Sequence[Bins]) -> Iterator[Complex64Array]:
            for asked in bins:
                doppler = ratio * asked.carrier.frequency_hz
                for number, pair in enumerate(pairs):
                    weights = asked.weights(number, tau[pair.mine], doppler[pair.mine])
                    receive = steering_vector(pair.rx.array, pair.arrivals(waves))
                    transmit = steering_vector(pair.tx.array, pair.departures(waves))
                    elements = receive[:, :, None] * transmit[:, None, :]
                    yield superposed(weights * a[asked.index, pair.mine], elements)

        bins = bins_of(self.wideband, self.run.carriers, tau, offsets)
        return wideband_parts(bins, responses(bins), receivers)


class _Constant(NamedTuple):
    """Arrays of a product that change only when a line of sight does."""

    los: BoolArray
    offsets: Int64Array
    id: UInt64Array
    interactions: UInt8Array
    points: Float64Array
    objects: Int32Array


@lru_cache(maxsize=64)
def _constant(
    los: tuple[bool, ...], offsets: tuple[int, ...], ids: tuple[int, ...], shape: tuple[int, int]
) -> _Constant:
    # Keyed by values: a scene in which the same lines are free has the same arrays, whatever moves.
    paths = offsets[-1]
    arrays = _Constant(
        los=np.array(los, np.bool_).reshape(shape),
        offsets=np.array(offsets, np.int64),
        id=np.array(ids, np.uint64),
        interactions=np.zeros((paths, 0), np.uint8),
        points=np.zeros((paths, 0, 3)),
        objects=np.zeros((paths, 0), np.int32),
    )
    for array in arrays:
        array.flags.writeable = False  # several products share it
    return arrays


def _id(kind: str) -> int:
    return int.from_bytes(hashlib.blake2b(kind.encode(), digest_size=8).digest(), "little")
