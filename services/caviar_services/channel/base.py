"""What all channel models share: from a frame to its `Channel` product."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar, TypeVar

import msgspec

from caviar_protocol.arrays import BoolArray
from caviar_protocol.errors import ScenarioError
from caviar_protocol.messages import Input, Role
from caviar_protocol.scene import antennas
from caviar_protocol.topics import AntennaDevice, Channel, ChannelOptions, Scene
from caviar_services.channel.assemble import Antenna, Matrices, PathTable, Product, assemble
from caviar_services.service import Frame, Preparation, Prepared, RunInfo, Service, StepResult

S = TypeVar("S", bound=msgspec.Struct)


@dataclass(frozen=True, kw_only=True)
class Found:
    """What a model found in a frame."""

    table: PathTable
    los: BoolArray
    """Whether the line of sight is free, Shape ``[T, R]``."""
    counts: dict[str, int] = field(default_factory=dict)
    matrices: Matrices | None = None
    """How H is made where it is not of plane waves."""


@dataclass(frozen=True, kw_only=True)
class Modelled:
    """What a model made of a frame."""

    channel: Channel
    counts: dict[str, int] = field(default_factory=dict)
    measured: dict[str, int] = field(default_factory=dict)
    """Nanoseconds that named phases took."""


class ChannelModel(Service[S]):
    """Base of channel models: from the scene of a frame to its `Channel` product.

    A model sets ``rung`` and implements `model`; it loads what it needs in `load` and says in
    `options` what it models.
    """

    role: ClassVar[Role] = "channel"
    inputs: ClassVar[tuple[Input, ...]] = (Input(topic="scene"),)
    outputs: ClassVar[tuple[str, ...]] = ("channel",)
    rung: str
    """Step of the fidelity ladder."""

    def __init__(self, settings: S, run: RunInfo) -> None:
        super().__init__(settings, run)
        if not run.carriers:
            raise ScenarioError(
                "a channel needs at least one carrier; add [[carriers]] with name and frequency_hz",
                key="carriers",
            )
        self.with_h = False
        """Whether somebody asks for the matrices."""

    @property
    def options(self) -> ChannelOptions:
        """What the products model."""
        return ChannelOptions()

    def load(self, preparation: Preparation) -> tuple[str, ...]:
        """Load scenery, compile, warm up; notes for the user."""
        return ()

    @abstractmethod
    def model(
        self,
        frame: Frame,
        scene: Scene,
        transmitters: Sequence[AntennaDevice],
        receivers: Sequence[AntennaDevice],
    ) -> Modelled:
        """The channels of all TX/RX pairs of a frame."""

    def prepare(self, preparation: Preparation) -> Prepared:
        self.with_h = "h" in preparation.demand.get("channel", frozenset())
        return Prepared(notes=self.load(preparation))

    def step(self, frame: Frame) -> StepResult:
        scene = frame.scene()
        made = self.model(frame, scene, antennas(scene, "tx"), antennas(scene, "rx"))
        channel = made.channel
        return StepResult(
            products={"channel": channel},
            fidelity=self.rung,
            counts={"paths": len(channel.tau), "dropped": channel.dropped, **made.counts},
            measured=made.measured,
        )


class PathModel(ChannelModel[S]):
    """Base of models that find the paths of a frame; antennas, carrier phase, order, ids and matrices
    are applied here, in float64, the same way for every rung of the ladder."""

    @abstractmethod
    def paths(self, scene: Scene, transmitters: Sequence[Antenna], receivers: Sequence[Antenna]) -> Found:
        """Paths of all TX/RX pairs of a scene, in any order."""

    def model(
        self,
        frame: Frame,
        scene: Scene,
        transmitters: Sequence[AntennaDevice],
        receivers: Sequence[AntennaDevice],
    ) -> Modelled:
        begin = time.perf_counter_ns()
        tx = [Antenna.of(scene, device) for device in transmitters]
        rx = [Antenna.of(scene, device) for device in receivers]
        found = self.paths(scene, tx, rx)
        traced = time.perf_counter_ns()
        product = Product(
            rung=self.rung, options=self.options, carriers=self.run.carriers, with_h=self.with_h
        )
        channel = assemble(product, tx, rx, found.table, found.los, found.matrices)
        done = time.perf_counter_ns()
        return Modelled(
            channel=channel,
            counts=found.counts,
            measured={"paths": traced - begin, "assemble": done - traced},
        )
