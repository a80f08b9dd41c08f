"""Conformance tests that every implementation of a service passes.

Subclass the class of the role in a test file, name the implementation, and pytest runs the tests::

    class TestMyChannel(ChannelConformance):
        service_class = MyChannel
        settings = {"samples": 1000}

Implementations in the registry are tested without even that (``tests/conformance``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import pytest

from caviar_protocol.codec import encode_payload
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.tables import convert_settings
from caviar_protocol.topics import PARTS, PAYLOADS, Carrier
from caviar_services import testing_samples as samples
from caviar_services.service import Frame, Preparation, Prepared, RunInfo, Service, StepResult

HEAVY = ("mitsuba", "drjit", "sionna", "torch", "libsumo", "traci", "matplotlib", "scipy")
"""Libraries that an implementation imports only when it prepares."""

FRAMES = 4
EPISODE_SEED = 11


@dataclass
class Played:
    """What a service did in one life: prepared, then played two equal episodes, then closed."""

    service: Service[Any]
    prepared: Prepared
    assets: Mapping[str, Path]
    directory: Path
    episodes: list[list[StepResult]] = field(default_factory=list)
    frames: list[Frame] = field(default_factory=list)
    """The frames of the first episode."""
    granted: list[list[tuple[bytes, bytes]]] = field(default_factory=list)
    """Bytes of the inputs of each of them, as they were before the service saw them."""

    def encoded(self, episode: int = 0) -> list[dict[str, tuple[bytes, bytes]]]:
        """Header and body of every product by frame and topic."""
        return [
            {topic: encode_payload(payload) for topic, payload in result.products.items()}
            for result in self.episodes[episode]
        ]


class ServiceConformance:
    """What holds for services of every role."""

    __test__ = False

    service_class: ClassVar[type[Service[Any]]]
    settings: ClassVar[Mapping[str, Any]] = {}
    """Settings as they would stand in a scenario, ``file:`` paths already absolute."""
    carriers: ClassVar[tuple[Carrier, ...]] = samples.CARRIERS
    devices: ClassVar[tuple[DeviceSpec, ...]] = samples.DEVICES
    demand: ClassVar[Mapping[str, frozenset[str]] | None] = None
    """Parts asked for by topic; by default all."""

    def __init_subclass__(cls) -> None:
        cls.__test__ = hasattr(cls, "service_class")

    @pytest.fixture(scope="class")
    @classmethod
    def played(cls, tmp_path_factory: pytest.TempPathFactory) -> Played:
        """One life of the service."""
        return cls.play(tmp_path_factory.mktemp("first"))

    @classmethod
    def build(cls, directory: Path) -> Service[Any]:
        """The service with its settings, in a run with the sample street's devices."""
        run = RunInfo(
            name=cls.service_class.role,
            run="conformance",
            seed=3,
            sampling_period_ns=samples.SAMPLING_PERIOD_NS,
            frames=FRAMES,
            carriers=cls.carriers,
            devices=cls.devices,
            directory=directory,
        )
        return cls.service_class(convert_settings(cls.service_class.Settings, cls.settings), run)

    @classmethod
    def frames_of(cls, service: Service[Any]) -> list[Frame]:
        """The grants of an episode. In the last frame, what is not required is absent."""
        optional = {item.topic: "left out" for item in service.inputs if not item.required and item.topic != "*"}
        return [
            Frame(
                episode=0,
                number=number,
                t_ns=number * samples.SAMPLING_PERIOD_NS,
                previous=number - 1,
                inputs=samples.inputs(service.inputs, number, optional if number == FRAMES - 1 else None),
                service=service.run.name,
                seed=service.run.seed,
            )
            for number in range(FRAMES)
        ]

    @classmethod
    def play(cls, directory: Path, episodes: Sequence[int] = (0, 0)) -> Played:
        """Live through the contract once: prepare, episodes with the same seed, close."""
        service = cls.build(directory)
        assets = cls.street(service, directory)
        demand = cls.demand or {topic: frozenset(PARTS[topic]) for topic in service.outputs}
        producers = {topic: (samples.source(topic),) for topic in PAYLOADS}
        try:
            prepared = service.prepare(Preparation(demand=demand, assets=assets, producers=producers))
            played = Played(service, prepared, assets, directory)
            for episode in episodes:
                service.reset(episode, EPISODE_SEED, 0)
                frames = [msgspec_free_copy(frame, episode) for frame in cls.frames_of(service)]
                granted = [[(bytes(i.header), bytes(i.body)) for i in frame.inputs] for frame in frames]
                played.episodes.append([service.step(frame) for frame in frames])
                service.end_episode(len(frames))
                if not played.frames:
                    played.frames, played.granted = frames, granted
        finally:
            service.close()
        return played

    @classmethod
    def street(cls, service: Service[Any], directory: Path) -> Mapping[str, Path]:
        """Scenery on disk: the sample street's, or what a world brings."""
        return samples.scenery(directory / "assets")
