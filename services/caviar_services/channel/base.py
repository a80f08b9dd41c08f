"""Base classes of channel models: from the scene of a frame to its `Channel` product.

`PathModel` is for models that find paths, `ChannelModel` for all others. What both report beside the product
is counted here as well.

`ChannelBatch` makes the channels of many episodes of one run at once, for environments of which a learner
steps a batch. The episodes of a batch are its *members*. They are in the same frame, and in the same scene:
the worlds of a batch show the same in every episode. Each has a seed of its own, and so other draws.
"""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, TypeVar

import msgspec
import numpy as np

from caviar_protocol.arrays import BoolArray, Complex128Array, Float64Array
from caviar_protocol.errors import PayloadError, ScenarioError
from caviar_protocol.host import keep_large_buffers
from caviar_protocol.messages import GrantInput, Input, Role, Status
from caviar_protocol.multipath import changes
from caviar_protocol.scenario.schema import PATTERNS
from caviar_protocol.scene_validation import numbers_are_right, wrong_device_number, wrong_number
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT
from caviar_protocol.space.scene import antennas
from caviar_protocol.topics import AntennaArray, AntennaDevice, Channel, ChannelOptions, Scene
from caviar_protocol.topics.scene import Device
from caviar_services.channel.arrays.channel_matrices import Matrices, check_size, empty_parts
from caviar_services.channel.assemble import Product, assemble, outage_counts, restricted
from caviar_services.channel.paths import Antenna, PathTable
from caviar_services.channel.propagation.atmosphere import Atmosphere, specific_attenuation
from caviar_services.channel.propagation.patterns import Patterns
from caviar_services.pattern_files import read_pattern
from caviar_services.service import Frame, FrameInput, Preparation, Prepared, RunInfo, Service, StepResult


class ChannelSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of every channel model; a model with more subclasses it.

    Example:
        >>> class ShadowedSettings(ChannelSettings, frozen=True, kw_only=True):
        ...     shadowing_db: float = 0.0
        >>> ShadowedSettings(shadowing_db=4.0)
        ShadowedSettings(atmosphere=None, shadowing_db=4.0)
    """

    atmosphere: Atmosphere | None = None
    """Air that absorbs along every path (ITU-R P.676); ``{}`` is that of the Recommendation's figures, and
    absent is none."""


S = TypeVar("S", bound=ChannelSettings)


@dataclass(frozen=True, kw_only=True)
class Found:
    """Paths of a frame, with counts, as `PathModel.paths` returns them."""

    table: PathTable
    """Paths of all pairs, in any order."""
    los: BoolArray
    """Whether the line of sight is free, Shape ``[T, R]``."""
    counts: dict[str, int] = field(default_factory=dict)
    """What the report of the run adds up, by name."""
    matrices: Matrices | None = None
    """How H is made where it is not of plane waves."""
    split_nmse: Float64Array | None = None
    """Expected ‖H − Hₕ‖²/‖H‖² of what half of the rays would have found, Hₕ, paths added up by power, Shape
    ``[T, R]``; absent: not asked for, or no rays were launched."""


@dataclass(frozen=True, kw_only=True)
class Modelled:
    """Channel of a frame, with counts and durations, as `ChannelModel.model` returns it."""

    channel: Channel
    counts: dict[str, int] = field(default_factory=dict)
    """See `Found.counts`."""
    measured: dict[str, int] = field(default_factory=dict)
    """Nanoseconds that named phases took."""
    split_nmse: Float64Array | None = None
    """See `Found.split_nmse`."""
    dropped_pairs: frozenset[int] = frozenset()
    """Numbers of the pairs of which paths were dropped, for values that are not finite."""


class ChannelModel(Service[S]):
    """Base of channel models: from the scene of a frame to its `Channel` product.

    A model sets ``rung`` and implements `model`; it loads what it needs in `load` and says in
    `options` what it models. One that finds paths subclasses `PathModel` instead.

    Args:
        settings: Of the model's ``Settings``, `ChannelSettings` or a subclass.
        run: Carriers and devices of the run; one carrier at least.

    Raises:
        ScenarioError: There is no carrier, a frequency is not finite and above 0, or the atmosphere is not
            defined at one; names the key.
    """

    role: ClassVar[Role] = "channel"
    Settings: ClassVar[type[msgspec.Struct]] = ChannelSettings
    inputs: ClassVar[tuple[Input, ...]] = (Input(topic="scene"),)
    outputs: ClassVar[tuple[str, ...]] = ("channel",)
    attributes_to_set: ClassVar[tuple[str, ...]] = ("rung",)
    rung: str
    """Step of the fidelity ladder, as in `topics.Channel.rung`. A rung of the model `adaptive` is a model of
    such a step, with settings of its own and a label."""

    def __init__(self, settings: S, run: RunInfo) -> None:
        super().__init__(settings, run)
        if not run.carriers:
            raise ScenarioError(
                "a channel needs at least one carrier; add [[carriers]] with name and frequency_hz",
                key="carriers",
            )
        for carrier in run.carriers:
            if not (math.isfinite(carrier.frequency_hz) and carrier.frequency_hz > 0):
                raise ScenarioError(
                    f"carrier {carrier.name!r} is at {carrier.frequency_hz} Hz; write a finite frequency > 0",
                    key="carriers",
                )
        self.absorption_db_per_km = self._absorption()
        """Specific attenuation of the air on each carrier, Shape ``[C]``; None: no atmosphere."""
        # The devices of the last scene, which mostly are those of the next.
        self._devices: tuple[Device, ...] = ()
        self.with_h = False
        """Whether the matrices are in demand."""
        self.wideband: frozenset[str] = frozenset()
        """Parts ``hf`` and ``taps`` that are in demand."""
        self.with_split = False
        """Whether `Modelled.split_nmse` is asked for."""
        self.patterns = Patterns()
        """Of the elements of arrays, with those of the run's pattern files."""

    @property
    def needs_assets(self) -> bool:
        """True if files are read in `prepare`: scenery, meshes of objects, or pattern files of antennas."""
        arrays = [spec.array for spec in self.run.devices if spec.array is not None]
        return self.uses_scenery or any(array.pattern_file for array in arrays)

    @property
    def options(self) -> ChannelOptions:
        """Options that the products model, beside absorption."""
        return ChannelOptions()

    @cached_property
    def modelled(self) -> ChannelOptions:
        """`options`, with the absorption that all models share; known once `load` is through."""
        if self.absorption_db_per_km is None:
            return self.options
        # Part of what a product states, as the options of the model are.
        absorption = tuple(self.absorption_db_per_km.tolist())
        return msgspec.structs.replace(self.options, absorption_db_per_km=absorption)

    @property
    def extent(self) -> tuple[Float64Array, Float64Array] | None:
        """Lowest and highest corner [m] of the scenery, Shape ``[3]`` each; None: the model has none."""
        return None

    def enclosing(self, position: Float64Array) -> str:
        """Name the object of the last frame that a point is inside.

        Args:
            position: Of the point [m], Shape ``[3]``.

        Returns:
            The name; empty where the model knows of none.
        """
        return ""

    @property
    def room(self) -> Mapping[str, int]:
        """Limit of objects of each mesh in a scene, by asset, ``""`` for those without one; known once
        `load` is through. Empty: objects are no obstacles to the model."""
        return {}

    def load(self, preparation: Preparation) -> tuple[str, ...]:
        """Load scenery, compile, warm up; `prepare` calls it once, before the first frame.

        Args:
            preparation: What is in demand, and the files of scenery, meshes and patterns.

        Returns:
            Notes for the user, such as what was switched off and why.
        """
        return ()

    @abstractmethod
    def model(
        self,
        frame: Frame,
        scene: Scene,
        transmitters: Sequence[AntennaDevice],
        receivers: Sequence[AntennaDevice],
    ) -> Modelled:
        """Make the channels of all TX/RX pairs of a frame.

        Args:
            frame: The frame; its `Frame.generator` is the only source of randomness.
            scene: The scene of the frame, whose numbers are finite.
            transmitters: Antennas that send, in the order of `Channel.tx`.
            receivers: Antennas that receive, in the order of `Channel.rx`.
        """

    def batch(self) -> ChannelBatch:
        """Make the channels of many episodes at once; of models that say so with ``batches``.

        Returns:
            Channels that are equal, bit by bit, to those of a run of each episode.
        """
        raise NotImplementedError(f"{type(self).__name__} computes one episode at a time")

    def prepare(self, preparation: Preparation) -> Prepared:
        """Read pattern files, load the model, and say what the user should know.

        Args:
            preparation: Parts in demand, and the files of the run.

        Raises:
            ScenarioError: Parts in demand are larger than a product may be.
            AssetError: A file is not what it should be.
        """
        demand = preparation.demand.get("channel", frozenset())
        self.with_h = "h" in demand
        self.wideband = demand & {"hf", "taps"}
        elements = [(spec.role, spec.array or AntennaArray()) for spec in self.run.devices]
        sent, taken = (
            sum(array.size for role, array in elements if role in (end, "both")) for end in ("tx", "rx")
        )
        check_size(demand, self.run.carriers, sent, taken)  # each device once: how many there are scenes say
        self.load_patterns(preparation)
        # Responses of megabytes would be returned to the system in each frame, and faulted in again.
        if self.wideband:
            keep_large_buffers()
        notes = (*self.load(preparation), *self._absorption_notes(), *empty_parts(demand, self.run.carriers))
        return Prepared(notes=(*notes, *self.patterns.notes()))

    def load_patterns(self, preparation: Preparation) -> None:
        """Read the pattern files of the run's antennas; `prepare` begins with it.

        Args:
            preparation: With the files of the run.
        """
        self.patterns = Patterns(
            {
                name: read_pattern(file)
                for name, file in preparation.assets.items()
                if name.startswith(PATTERNS)
            }
        )

    def step(self, frame: Frame) -> StepResult:
        """Make the product of a frame, with counts and durations for the report.

        Args:
            frame: With the scene among its inputs.

        Raises:
            PayloadError: A number of the scene cannot be (`caviar_protocol.scene_validation`), or a path
                brings more power than was sent.
        """
        scene = frame.scene()
        wrong = "" if numbers_are_right(scene) else wrong_number(scene)
        if not wrong and scene.devices != self._devices:
            wrong, self._devices = wrong_device_number(scene), scene.devices
        if wrong:
            raise PayloadError(wrong)
        transmitters, receivers = antennas(scene, "tx"), antennas(scene, "rx")
        # Of mounted devices only the scene says how many there are.
        if self.wideband:
            sent, taken = (sum(end.array.size for end in ends) for ends in (transmitters, receivers))
            check_size(self.wideband, self.run.carriers, sent, taken)
        made = self.model(frame, scene, transmitters, receivers)
        channel = restricted(made.channel, transmitters, receivers)
        return StepResult(
            products={"channel": channel},
            fidelity=self.rung,
            counts={
                "paths": len(channel.tau),
                "dropped": channel.dropped,
                **made.counts,
                **outage_counts(channel, scene, self, made.dropped_pairs),
            },
            measured=made.measured,
        )

    def _absorption(self) -> Float64Array | None:
        air = self.settings.atmosphere
        if air is None:
            return None
        try:
            return np.array(
                [specific_attenuation(air, carrier.frequency_hz) for carrier in self.run.carriers]
            )
        except ScenarioError as error:
            raise ScenarioError(str(error), key=self.run.settings_place.at("atmosphere").key) from error

    def _absorption_notes(self) -> tuple[str, ...]:
        air = self.settings.atmosphere
        if air is None or self.absorption_db_per_km is None:
            return ()
        of_carriers = ", ".join(
            f"{absorbed:.3g} dB/km on {carrier.name!r}"
            for carrier, absorbed in zip(self.run.carriers, self.absorption_db_per_km, strict=True)
        )
        state = f"{air.temperature_k:g} K, {air.pressure_hpa:g} hPa, {air.water_vapour_g_m3:g} g/m³"
        return (f"atmosphere (ITU-R P.676) at {state}: {of_carriers}",)


def _refuse_amplified(channel: Channel) -> None:
    """Raise `PayloadError` naming the strongest path of those that bring more power than was sent."""
    carrier, path = np.unravel_index(int(np.abs(channel.a).argmax()), channel.a.shape)
    pair = int(np.searchsorted(channel.offsets, path, side="right")) - 1
    tx, rx = divmod(pair, len(channel.rx))
    through = [channel.object_names[o] for o in channel.objects[path].tolist() if o >= 0]
    length = float(channel.tau[path]) * SPEED_OF_LIGHT
    wavelength = SPEED_OF_LIGHT / channel.carriers[carrier].frequency_hz
    gain = 20 * np.log10(abs(channel.a[carrier, path]))
    raise PayloadError(
        f"the path from {channel.tx[tx]!r} to {channel.rx[rx]!r}{' by way of ' * bool(through)}"
        f"{', '.join(through)} has a gain of {gain:.1f} dB on carrier {channel.carriers[carrier].name!r}, "
        f"more than was sent: {length:.3g} m, {length / wavelength:.3g} wavelengths, are within the near "
        "field of its antennas, where far-field gains do not hold; move them apart, or off that surface"
    )


class PathModel(ChannelModel[S]):
    """Base of models that find the paths of a frame; antennas, carrier phase, order, ids and matrices
    are applied here, in float64, the same way for every rung of the ladder.

    The arguments are those of `ChannelModel`. `docs/howto/channel-models.md` has a whole model.
    """

    rounds_h = False
    """Whether H is rounded to single precision."""

    # Episode, frame and product of the last frame, for births and deaths of paths.
    _before: tuple[int, int, Channel] | None = None

    @abstractmethod
    def paths(self, scene: Scene, transmitters: Sequence[Antenna], receivers: Sequence[Antenna]) -> Found:
        """Find the paths of all TX/RX pairs of a scene.

        Args:
            scene: The scene of the frame.
            transmitters: T antennas where they are, in world axes.
            receivers: R antennas; a device that also sends has no path to itself.

        Returns:
            The paths in any order, pair t·R + r for transmitter t and receiver r, without antennas and
            without carrier phase.
        """

    def model(
        self,
        frame: Frame,
        scene: Scene,
        transmitters: Sequence[AntennaDevice],
        receivers: Sequence[AntennaDevice],
    ) -> Modelled:
        """Find the paths of a frame and make the product of them.

        Args:
            frame, scene, transmitters, receivers: See `ChannelModel.model`.

        Raises:
            PayloadError: A path brings more power than was sent.
        """
        begin = time.perf_counter_ns()
        tx = [Antenna.of(scene, device, self.patterns) for device in transmitters]
        rx = [Antenna.of(scene, device, self.patterns) for device in receivers]
        found = self.paths(scene, tx, rx)
        traced = time.perf_counter_ns()
        product = Product(
            rung=self.rung,
            options=self.modelled,
            carriers=self.run.carriers,
            with_h=self.with_h,
            wideband=self.wideband,
            absorption_db_per_km=self.absorption_db_per_km,
            rounds_h=self.rounds_h,
        )
        channel, dropped = assemble(product, tx, rx, found.table, found.los, found.matrices)
        channel = restricted(channel, transmitters, receivers)
        # A passive channel brings no more than was sent: above 1, far-field gains are used in the near field.
        if np.abs(channel.a).max(initial=0.0) > 1:
            _refuse_amplified(channel)
        done = time.perf_counter_ns()
        # Births and deaths of paths are no part of the product, which follows from its frame alone. Only two
        # frames of this model in a row are compared: another process may have made one between.
        turnover: dict[str, int] = {}
        before, self._before = self._before, (frame.episode, frame.number, channel)
        if before is not None and before[:2] == (frame.episode, frame.number - 1):
            changed = changes(before[2], channel)
            turnover = {"births": changed.births, "deaths": changed.deaths}
        return Modelled(
            channel=channel,
            counts={**turnover, **found.counts},
            measured={"paths": traced - begin, "assemble": done - traced},
            split_nmse=found.split_nmse,
            dropped_pairs=dropped,
        )


class SceneAt(NamedTuple):
    """The scene of one frame, that of all members."""

    number: int
    t_ns: int
    scene: Scene


class MemberSeed(NamedTuple):
    """Seed and number of a member's episode, on which its random numbers depend (contract, clause 19)."""

    seed: int
    seed_episode: int
    """Episodes since the first one with this seed."""


class BatchChannels(NamedTuple):
    """Channels of K frames; M is the number of members, or 1 where all have the same."""

    h: list[Complex128Array]
    """Of each pair, by transmitter, then receiver, Shape ``[M, K, C, Nr, Nt]``; zeros without a path."""
    has_path: BoolArray
    """Whether a path has an amplitude other than 0, Shape ``[M, K, pairs, C]``."""
    los: BoolArray
    """Whether the line of sight is free, Shape ``[K, pairs]``."""


class ChannelBatch(ABC):
    """The channels of many episodes; a channel model makes one with `ChannelModel.batch`."""

    @abstractmethod
    def begin(self, members: Sequence[MemberSeed]) -> None:
        """Begin an episode of each member."""

    @abstractmethod
    def reach(self, number: int) -> int:
        """Number of frames that can be computed together from a frame on."""

    @abstractmethod
    def width(self, members: int) -> int:
        """Numbers that are held at once for each element of an H, with so many members."""

    @abstractmethod
    def channels(self, frames: Sequence[SceneAt]) -> BatchChannels:
        """Compute the channels of frames that follow on each other, whose scenes have the same devices.

        Args:
            frames: At most `reach` of the first one.
        """


class SameChannels(ChannelBatch):
    """Channels that depend on the scene alone, so that one product is that of all members.

    Args:
        model: Draws nothing, and remembers nothing.
    """

    def __init__(self, model: ChannelModel[Any]) -> None:
        self._model, self._name = model, model.run.name

    def begin(self, members: Sequence[MemberSeed]) -> None:
        """Nothing depends on seeds."""

    def reach(self, number: int) -> int:
        return 64  # products that are held at once

    def width(self, members: int) -> int:
        return 1

    def channels(self, frames: Sequence[SceneAt]) -> BatchChannels:
        products = [self._product(at) for at in frames]
        first = products[0]
        carriers, pairs = len(first.carriers), len(first.offsets) - 1
        has_path = np.zeros((1, len(frames), pairs, carriers), np.bool_)
        for k, product in enumerate(products):
            ends = product.offsets.tolist()
            for pair in range(pairs):
                has_path[0, k, pair] = product.a[:, ends[pair] : ends[pair + 1]].any(axis=1)
        receivers = len(first.rx)
        made = [{(m.carrier, m.tx * receivers + m.rx): m.h for m in product.h} for product in products]
        h = []
        for pair in range(pairs):
            # A pair has no matrix on a carrier that it does not use, and no user who looks at it.
            blank = np.zeros(next((m.shape for (_, p), m in made[0].items() if p == pair), (1, 1)), complex)
            h.append(np.array([[one.get((c, pair), blank) for c in range(carriers)] for one in made])[None])
        return BatchChannels(h, has_path, np.array([product.los.reshape(-1) for product in products]))

    def _product(self, at: SceneAt) -> Channel:
        entry = GrantInput(topic="scene", source="world", status=Status.FRESH, frame=at.number)
        frame = Frame(
            episode=0,
            number=at.number,
            t_ns=at.t_ns,
            inputs=(FrameInput(entry, payload=at.scene),),
            service=self._name,
        )
        product = self._model.step(frame).products["channel"]
        if not isinstance(product, Channel):
            raise TypeError(f"channel {self._name!r} made a {type(product).__name__}")
        return product
