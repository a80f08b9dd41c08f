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

`GeometricBatch` makes the channels of many episodes at once, with the formulas of the service as arrays.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import accumulate, pairwise
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
from caviar_protocol.space.antenna_arrays import steering_vector
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT, Pose, dot, unrotated
from caviar_protocol.space.scene import antennas, device_pose
from caviar_protocol.topics import AntennaArray, AntennaDevice, Channel, ChannelMatrix, ChannelOptions, Scene
from caviar_services.channel.arrays.channel_matrices import (
    Bins,
    Wideband,
    bins_of,
    superposed,
    wideband_parts,
)
from caviar_services.channel.base import (
    BatchChannels,
    ChannelBatch,
    ChannelModel,
    MemberSeed,
    Modelled,
    SceneAt,
)
from caviar_services.channel.propagation.atmosphere import amplitude_factor
from caviar_services.channel.statistical.waves import (
    BLOCK,
    Components,
    Draws,
    GeometricSettings,
    Line,
    PairWaves,
    Shares,
    Sight,
    Waves,
    angles,
    superposed_waves,
    times,
    turned,
    velocity,
)
from caviar_services.service import Frame, Preparation, RunInfo
from caviar_space.obstacles import Boxes

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
    """

    Settings = GeometricSettings
    rung = "geometric"
    batches = True

    def __init__(self, settings: GeometricSettings, run: RunInfo) -> None:
        super().__init__(settings, run)
        self._frequencies = [carrier.frequency_hz for carrier in run.carriers]
        self._frequency = np.array(self._frequencies)[:, None]
        self._shares = Shares.of(settings)
        ids = [_id(f"component {number}") for number in range(settings.components)]
        # Of a pair, by whether its line of sight is free.
        self._ids = {False: ids, True: [_id("straight"), *ids[1:]]}
        self._obstacles = Boxes.aligned([(box.minimum_m, box.maximum_m) for box in settings.obstacles])
        self._drawn: dict[tuple[str, str], _Drawn] = {}
        self._block = 0
        self._ends: _Ends | None = None
        self._constants: dict[tuple[tuple[bool, ...], tuple[bool, ...], int], _Constant] = {}
        self.has_path_gain = settings.normalization != "unit"
        """Whether amplitudes follow from distance, carrier and element patterns."""
        self._nearest = float((SPEED_OF_LIGHT / self._frequency).max()) if self.has_path_gain else 0.0

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

    def batch(self) -> GeometricBatch:
        """Make the channels of many episodes at once."""
        return GeometricBatch(self)

    def reset(self, episode: int, seed: int, t0_ns: int) -> None:
        """Forget the draws of the episode before."""
        self._drawn.clear()

    def model(
        self,
        frame: Frame,
        scene: Scene,
        transmitters: Sequence[AntennaDevice],
        receivers: Sequence[AntennaDevice],
    ) -> Modelled:
        # Lists of devices are those of the frame before as long as devices neither come nor go.
        if self._ends is None or self._ends[:2] != (transmitters, receivers):
            self._ends = _Ends.of(transmitters, receivers)
        sight = self.sight(scene, transmitters, receivers)
        waves = Waves(len(self._frequencies))
        for line, free, near in zip(*sight, strict=True):
            if not near:
                self._add(waves, frame, line, free)
        too_close = sum(sight.near)
        channel = self._channel(self._ends, waves, sight)
        return Modelled(channel=channel, counts={"too_close": too_close} if too_close else {})

    # --- the line of sight -----------------------------------------------------------------------

    def sight(
        self, scene: Scene, transmitters: Sequence[AntennaDevice], receivers: Sequence[AntennaDevice]
    ) -> Sight:
        """Find the straight lines between antennas of a scene, and which of them are free.

        Args:
            scene: The scene.
            transmitters: Antennas that send.
            receivers: Antennas that receive.
        """
        sent, taken = (
            [(device, device_pose(scene, device), velocity(scene, device)) for device in ends]
            for ends in (transmitters, receivers)
        )
        blocked, found = self._blocks(scene), Sight([], [], [])
        for transmitter in sent:
            for receiver in taken:
                line = Line(transmitter, receiver, self._frequencies)
                near = line.length == 0 or line.length < self._nearest
                found.lines.append(line)
                found.free.append(near or not blocked(line))
                found.near.append(near)
        return found

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
            ends = np.array([pair.tx_pose.position, pair.rx_pose.position])[:, None]
            if self._obstacles.block(*ends).any():
                return True
            carriers = (pair.tx.parent, pair.rx.parent)
            met = np.flatnonzero(boxes.block(*ends)[0]).tolist()
            return any(boxes.names[index] not in carriers for index in met)

        return hidden

    # --- waves -----------------------------------------------------------------------------------------

    def _add(self, waves: Waves, frame: Frame, line: Line, free: bool) -> None:
        """Add the components of a pair."""
        numbers, count = self._numbers(frame, line.tx.name, line.rx.name, free), self.settings.components
        for late, at in zip(numbers[:count], range(count, count * 9, 8), strict=True):
            departure = turned(line.outwards, numbers[at : at + 4])
            arrival = turned(line.inwards, numbers[at + 4 : at + 8])
            waves.tau.append(line.delay + late)
            waves.departure.append(departure)
            waves.arrival.append(arrival)
            # To first order in v/c: motion of either end along its own direction outwards raises the
            # frequency.
            approach = dot(line.velocity[0], departure) + dot(line.velocity[1], arrival)
            waves.doppler_ratio.append(approach / SPEED_OF_LIGHT)
        at = count * 9
        for mine, phase in zip(waves.amplitude, line.phase, strict=True):
            mine += [complex(*times(numbers[n : n + 2], phase)) for n in range(at, at + 2 * count, 2)]
            at += 2 * count
        if self.has_path_gain:
            waves.length += [line.length] * count

    def block_of(self, number: int) -> tuple[int, int]:
        """Find the block of draws that a frame is in, and its row there."""
        # Blocks begin at fixed numbers, so that a frame has the same draws wherever a run or a replay begins.
        return (0, 0) if self.draws_last else divmod(number, BLOCK)

    @property
    def draws_last(self) -> bool:
        """True if draws last an episode, whose only block has one row."""
        return self.settings.redraw == "episode"

    def draws(self, seed: int, seed_episode: int, pair: tuple[str, str], block: int) -> Draws:
        """Draw a block of frames.

        Args:
            seed: Of the episode.
            seed_episode: Episodes since the first one with this seed.
            pair: Names of transmitter and receiver.
            block: As `block_of` numbers them.
        """
        stream = "/".join((self.run.name, *pair))
        random = generator(seed, seed_episode, stream, block)
        return Draws.of(random, 1 if self.draws_last else BLOCK, self.settings)

    def components(self, draws: Draws, free: BoolArray) -> Components:
        """Components of pairs; see `Components.of`."""
        return Components.of(draws, free, self._shares, self._frequency[:, 0])

    def _numbers(self, frame: Frame, tx: str, rx: str, free: bool) -> list[float]:
        """The components of a pair in a frame: excess delays, deviations, then amplitudes by carrier."""
        block, row = self.block_of(frame.number)
        if block != self._block or (self.draws_last and len(self._drawn) >= KEPT):
            # Pairs that have left go with it; the others draw the same again.
            self._drawn.clear()
            self._block = block
        drawn = self._drawn.get((tx, rx))
        if drawn is None:
            drawn = self._drawn[tx, rx] = _Drawn(
                self.draws(frame.seed, frame.seed_episode, (tx, rx), block), {}
            )
        table = drawn.tables.get(free)
        if table is None:
            made = self.components(drawn.draws, np.array(free))
            fields = (made.excess, made.turn, made.amplitude)
            # One row a frame: as lists, a block would be thousands of objects for the garbage collector.
            table = np.concatenate([field.reshape(len(made.excess), -1) for field in fields], axis=1)
            drawn.tables[free] = table
        numbers: list[float] = table[row].tolist()
        return numbers

    # --- the product -----------------------------------------------------------------------------------

    def _channel(self, ends: _Ends, waves: Waves, sight: Sight) -> Channel:
        key = tuple(sight.free), tuple(sight.near), len(ends.rx)
        constant = self._constants.get(key)
        if constant is None:
            if len(self._constants) >= KEPT_CONSTANTS:
                self._constants.clear()
            shape = len(ends.tx), len(ends.rx)
            constant = self._constants[key] = _Constant.of(key[0], key[1], self._ids, shape)
        a = np.array(waves.amplitude, np.complex128)
        pairs = [
            PairWaves(line.tx, line.rx, line.tx_pose, line.rx_pose, mine)
            for line, mine in zip(sight.lines, constant.rows, strict=True)
        ]
        if self.has_path_gain:
            patterns = np.ones(len(waves.tau))
            for pair in pairs:
                patterns[pair.mine] = self.pattern_gain(
                    pair.tx.array, pair.departures(waves), pair.rx.array, pair.arrivals(waves)
                )
            a *= self.path_gain(np.array(waves.length), patterns, np.array(waves.tau))
        # One array, cut up: making an array costs more than its numbers.
        both, count = waves.departure + waves.arrival, len(waves.tau)
        seen = [x for wave in both for x in angles(wave)]
        numbers = np.array(waves.tau + waves.doppler_ratio + seen, np.float64)
        aod, aoa = numbers[2 * count :].reshape(2, count, 2)
        wideband = self._wideband(a, waves, pairs, constant.offsets, len(ends.rx))
        return Channel(
            rung=self.rung,
            options=self.modelled,
            carriers=self.run.carriers,
            tx=ends.tx,
            rx=ends.rx,
            los=constant.los,
            offsets=constant.offsets,
            id=constant.id,
            a=a,
            tau=numbers[:count],
            aod=aod,
            aoa=aoa,
            doppler=self._frequency * numbers[count : 2 * count],
            interactions=constant.interactions,
            points=constant.points,
            objects=constant.objects,
            h=self._matrices(a, waves, pairs, len(ends.rx)) if self.with_h else (),
            hf=wideband.hf,
            taps=wideband.taps,
        )

    def pattern_gain(
        self, tx: AntennaArray, departures: Float64Array, rx: AntennaArray, arrivals: Float64Array
    ) -> Float64Array:
        """Amplitude of the two element patterns together.

        Args:
            tx: Array of the transmitter.
            departures: Directions of departure in its axes, Shape ``[..., 3]``.
            rx: Array of the receiver.
            arrivals: Directions of arrival in its axes, Shape ``[..., 3]``.

        Returns:
            Shape ``[...]``.
        """
        sent = self.patterns.element(tx).amplitude(departures.reshape(-1, 3))
        sent *= self.patterns.element(rx).amplitude(arrivals.reshape(-1, 3))
        return sent.reshape(departures.shape[:-1])

    def path_gain(self, length: Float64Array, patterns: Float64Array, tau: Float64Array) -> Float64Array:
        """λ/(4πd), element patterns and absorption.

        Args:
            length: Of the straight line [m], of a shape that broadcasts to ``[..., P]``.
            patterns: From `pattern_gain`, Shape ``[..., P]``.
            tau: Delay [s], Shape ``[..., P]``.

        Returns:
            Factors of amplitudes, Shape ``[..., C, P]``.
        """
        spread = SPEED_OF_LIGHT / self._frequency / (4 * np.pi * length[..., None, :])
        factor: Float64Array = spread * patterns[..., None, :]
        if self.absorption_db_per_km is not None:
            factor *= amplitude_factor(self.absorption_db_per_km, tau)
        return factor

    def _matrices(
        self, a: Complex128Array, waves: Waves, pairs: Sequence[PairWaves], receivers: int
    ) -> tuple[ChannelMatrix, ...]:
        """H of every carrier and pair."""
        of_pair = []
        for pair in pairs:
            transmit = pair.transmit(waves)
            receive = pair.receive(waves) if pair.rx.array.size > 1 else None
            if pair.mine.start == pair.mine.stop:
                shape = (len(a), pair.rx.array.size, pair.tx.array.size)
                of_pair.append(np.zeros(shape, np.complex128))
            else:
                of_pair.append(superposed_waves(a[:, pair.mine], transmit, receive))
        found = []
        for carrier in range(len(a)):
            for number, h in enumerate(of_pair):
                tx, rx = divmod(number, receivers)
                found.append(ChannelMatrix(carrier=carrier, tx=tx, rx=rx, h=h[carrier]))
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
                    receive, transmit = pair.receive(waves), pair.transmit(waves)
                    elements = receive[:, :, None] * transmit[:, None, :]
                    yield superposed(weights * a[asked.index, pair.mine], elements)

        bins = bins_of(self.wideband, self.run.carriers, tau, offsets)
        return wideband_parts(bins, responses(bins), receivers)


class _Drawn(NamedTuple):
    """Draws of a pair, for a block of frames."""

    draws: Draws
    tables: dict[bool, Float64Array]
    """Its components, a row a frame, by whether the line of sight is free; made when they are asked for."""


class _Ends(NamedTuple):
    """Antennas, and their names."""

    transmitters: Sequence[AntennaDevice]
    receivers: Sequence[AntennaDevice]
    tx: tuple[str, ...]
    rx: tuple[str, ...]

    @classmethod
    def of(cls, transmitters: Sequence[AntennaDevice], receivers: Sequence[AntennaDevice]) -> _Ends:
        """Ends of some antennas. Raises `PayloadError` for arrays that waves have no polarization for."""
        for device in (*transmitters, *receivers):
            if not device.array.is_uniform:
                raise PayloadError(f"device {device.name!r} {_NOT_UNIFORM}")
        tx, rx = (tuple(device.name for device in ends) for ends in (transmitters, receivers))
        return cls(transmitters, receivers, tx, rx)


KEPT_CONSTANTS = 64


class _Constant(NamedTuple):
    """Arrays of a product that change only when a line of sight does: a scene in which the same lines are
    free has the same ones, whatever moves."""

    rows: list[slice]
    """Of each pair, those of its waves."""
    los: BoolArray
    offsets: Int64Array
    id: UInt64Array
    interactions: UInt8Array
    points: Float64Array
    objects: Int32Array

    @classmethod
    def of(
        cls,
        free: tuple[bool, ...],
        near: tuple[bool, ...],
        ids: Mapping[bool, Sequence[int]],
        shape: tuple[int, int],
    ) -> _Constant:
        """Constants of pairs by whether their lines are free, and their ends too near to each other for a
        path."""
        of_pairs = [[] if close else ids[los] for los, close in zip(free, near, strict=True)]
        offsets = [0, *accumulate(map(len, of_pairs))]
        paths = offsets[-1]
        made = cls(
            rows=[slice(*ends) for ends in pairwise(offsets)],
            los=np.array(free, np.bool_).reshape(shape),
            offsets=np.array(offsets, np.int64),
            id=np.array([number for of_pair in of_pairs for number in of_pair], np.uint64),
            interactions=np.zeros((paths, 0), np.uint8),
            points=np.zeros((paths, 0, 3)),
            objects=np.zeros((paths, 0), np.int32),
        )
        for array in made[1:]:
            array.flags.writeable = False  # several products share it
        return made


def _id(kind: str) -> int:
    return int.from_bytes(hashlib.blake2b(kind.encode(), digest_size=8).digest(), "little")


class GeometricBatch(ChannelBatch):
    """Channels of M members, of which each draws what the service draws for its seed.

    Args:
        model: Prepared, with the settings and patterns of the run.
    """

    def __init__(self, model: GeometricChannel) -> None:
        self._model = model
        self._members: Sequence[MemberSeed] = ()
        self._block = -1
        self._draws: dict[tuple[str, str], Draws] = {}

    def begin(self, members: Sequence[MemberSeed]) -> None:
        self._members, self._block = tuple(members), -1

    def reach(self, number: int) -> int:
        _, row = self._model.block_of(number)
        return BLOCK if self._model.draws_last else BLOCK - row

    def width(self, members: int) -> int:
        return members * self._model.settings.components

    def channels(self, frames: Sequence[SceneAt]) -> BatchChannels:
        first = frames[0].scene
        transmitters, receivers = antennas(first, "tx"), antennas(first, "rx")
        sights = [self._model.sight(at.scene, transmitters, receivers) for at in frames]
        near = np.array([sight.near for sight in sights], np.bool_)
        free = np.array([sight.free for sight in sights], np.bool_)
        h, has_path = [], []
        for pair in range(len(transmitters) * len(receivers)):
            lines = [sight.lines[pair] for sight in sights]
            amplitude, matrices = self._pair(lines, frames[0].number, free[:, pair])
            apart = ~near[:, pair]
            h.append(matrices if apart.all() else np.where(apart[:, None, None, None], matrices, 0.0))
            has_path.append(amplitude.any(axis=-1) & apart[:, None])
        return BatchChannels(h, np.stack(has_path, axis=2), free)

    def _pair(
        self, lines: Sequence[Line], number: int, free: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]
    ) -> tuple[Complex128Array, Complex128Array]:
        """Amplitudes, Shape ``[M, K, C, L]``, and H of a pair, Shape ``[M, K, C, Nr, Nt]``."""
        model, tx, rx = self._model, lines[0].tx, lines[0].rx
        made = model.components(self._drawn(tx.name, rx.name, number, len(lines)), free)
        phase = np.array([line.phase for line in lines])[..., None]
        parts = times((made.amplitude[..., 0], made.amplitude[..., 1]), (phase[:, :, 0], phase[:, :, 1]))
        amplitude = np.empty(parts[0].shape, np.complex128)
        amplitude.real, amplitude.imag = parts
        turn = np.moveaxis(made.turn, -1, 0)
        outwards, inwards = ([getattr(line, end) for line in lines] for end in ("outwards", "inwards"))
        departures = _local(outwards, turn[:4], [line.tx_pose for line in lines])
        arrivals: Float64Array | None = None
        if rx.array.size > 1 or model.has_path_gain:
            arrivals = _local(inwards, turn[4:], [line.rx_pose for line in lines])
        if model.has_path_gain and arrivals is not None:
            patterns = model.pattern_gain(tx.array, departures, rx.array, arrivals)
            # Of two devices at one place there is no gain, and no path.
            length = np.array([line.length or 1.0 for line in lines])[:, None]
            tau = np.array([line.delay for line in lines])[:, None] + made.excess
            amplitude *= model.path_gain(length, patterns, tau)
        transmit = steering_vector(tx.array, departures)
        receive = None
        if rx.array.size > 1 and arrivals is not None:
            receive = steering_vector(rx.array, arrivals)
        return amplitude, superposed_waves(amplitude, transmit, receive)

    def _drawn(self, tx: str, rx: str, number: int, count: int) -> Draws:
        """Draws of all members in some frames of a block, Shape ``[M, K]`` in place of ``[F]``."""
        model = self._model
        block, row = model.block_of(number)
        if block != self._block:
            self._draws.clear()
            self._block = block
        drawn = self._draws.get((tx, rx))
        if drawn is None:
            members = [model.draws(*member, (tx, rx), block) for member in self._members]
            drawn = Draws(*[np.stack(field) for field in zip(*members, strict=True)])
            self._draws[tx, rx] = drawn
        # Draws that last an episode are one row, which is that of every frame.
        rows = slice(None) if model.draws_last else slice(row, row + count)
        return Draws(
            gain=drawn.gain[:, rows],
            excess=drawn.excess[:, rows],
            excess_free=drawn.excess_free[:, rows],
            deviation=drawn.deviation[:, rows],
        )


def _local(lines: Sequence[Sequence[float]], turn: Float64Array, poses: Sequence[Pose]) -> Float64Array:
    """Directions of waves in the axes of a device.

    Args:
        lines: Of each frame, as `turned` takes them.
        turn: Deviations, Shape ``[4, M, K, L]``.
        poses: Of the device in each frame.

    Returns:
        Unit vectors, Shape ``[M, K, L, 3]``.
    """
    of_line = np.array(lines).T[..., None]
    orientation = np.array([pose.orientation for pose in poses]).T[..., None]
    vectors = turned(tuple(of_line), tuple(turn))
    return np.stack(unrotated(tuple(orientation), vectors), axis=-1)
