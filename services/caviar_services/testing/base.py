"""Conformance tests of the contract that services of every role keep to (`caviar_services.service`).

The tests drive a service as the runner would, without sockets: prepare, play episodes, close. They compare
bytes, since products are bytes to everything behind the service.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, get_args

import msgspec
import pytest
from msgspec import inspect

from caviar_protocol.codec import decode_payload, encode_payload
from caviar_protocol.errors import CaviarError, ScenarioError
from caviar_protocol.messages import Role
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.scenario.conversion import convert_settings
from caviar_protocol.topics import PARTS, PAYLOADS, Carrier
from caviar_services.service import Frame, Preparation, Prepared, RunInfo, Service, StepResult
from caviar_services.testing import samples

# Importing one of these costs start-up time and memory in every process that does, an agent's too.
HEAVY = ("mitsuba", "drjit", "sionna", "torch", "libsumo", "traci", "matplotlib", "panda3d", "scipy")
"""Libraries that an implementation imports only when it prepares."""

FRAMES = 4
INTERRUPTED = 3
"""Frames after which a service is replaced by another; as many follow."""

EPISODE_SEED = 11

Encoded = dict[str, tuple[bytes, bytes]]
"""Header and body of products by topic."""


@dataclass
class Played:
    """Life of a service: prepared, played episodes, was closed.

    Example:
        >>> from caviar_services.agent.baselines import RandomAgent
        >>> from caviar_services.testing import AgentConformance
        >>> class TestRandomAgent(AgentConformance):
        ...     service_class = RandomAgent
        >>> played = TestRandomAgent.play(Path())
        >>> [len(results) for results in played.episodes], sorted(played.encoded()[0])
        ([4, 4], ['action'])
    """

    service: Service[Any]
    prepared: Prepared
    assets: Mapping[str, Path]
    directory: Path
    episodes: list[list[StepResult]] = field(default_factory=list)
    """Results of each episode, frame by frame."""
    frames: list[Frame] = field(default_factory=list)
    """Grants of the first episode."""
    granted: list[list[tuple[bytes, bytes]]] = field(default_factory=list)
    """Bytes of the inputs of each, as they were before the service saw them."""

    def encoded(self, episode: int = 0) -> list[Encoded]:
        """Bytes of every product, frame by frame.

        Args:
            episode: Index of the episode in the order in which they were played.
        """
        return [encoded(result) for result in self.episodes[episode]]


def encoded(result: StepResult) -> Encoded:
    """Encode every product of a frame.

    Args:
        result: What a service made of the frame.

    Returns:
        Header and body by topic.
    """
    return {topic: encode_payload(payload) for topic, payload in result.products.items()}


class ServiceConformance:
    """Tests of the contract in `caviar_services.service`.

    Subclass the class of the role (`caviar_services.testing.CONFORMANCE`) in a test file and set
    ``service_class``; pytest runs the tests. A class without ``service_class`` is not collected.

    Attributes:
        service_class: The implementation.

    Example:
        >>> from caviar_services.agent.baselines import RandomAgent
        >>> from caviar_services.testing import AgentConformance
        >>> class TestRandomAgent(AgentConformance):
        ...     service_class = RandomAgent
        ...     settings = {"users": ["car.*"]}
        >>> TestRandomAgent.__test__, AgentConformance.__test__
        (True, False)
    """

    __test__ = False

    service_class: ClassVar[type[Service[Any]]]
    settings: ClassVar[Mapping[str, Any]] = {}
    """Settings as in a scenario, ``file:`` paths already absolute."""
    carriers: ClassVar[tuple[Carrier, ...]] = samples.CARRIERS
    devices: ClassVar[tuple[DeviceSpec, ...]] = samples.DEVICES
    demand: ClassVar[Mapping[str, frozenset[str]] | None] = None
    """Parts asked for, by topic; by default all."""
    episodes: ClassVar[tuple[int, ...]] = (0, 0)
    """Episodes of a life; by default the same one twice."""

    # pytest collects whatever class a test file imports; the bases have nothing to test.
    def __init_subclass__(cls) -> None:
        cls.__test__ = hasattr(cls, "service_class")

    # --- a life of the service -------------------------------------------------------------------

    @pytest.fixture(scope="class")
    @classmethod
    def played(cls, tmp_path_factory: pytest.TempPathFactory) -> Played:
        """One life of the service."""
        return cls.play(tmp_path_factory.mktemp("life"))

    @classmethod
    def build(cls, directory: Path) -> Service[Any]:
        """The service in a run with the sample street's carriers and devices.

        Args:
            directory: Where a recorder writes, in ``run`` below it.

        Raises:
            ScenarioError: `settings` are wrong.
        """
        run = RunInfo(
            name=cls.service_class.role,
            run="conformance",
            seed=3,  # another one than the episode's: a service that takes the wrong one shows
            sampling_period_ns=samples.SAMPLING_PERIOD_NS,
            frames=FRAMES,
            carriers=cls.carriers,
            devices=cls.devices,
            directory=directory / "run",
        )
        return cls.service_class(convert_settings(cls.service_class.Settings, cls.settings), run)

    @classmethod
    def street(cls, service: Service[Any], directory: Path) -> Mapping[str, Path]:
        """Files of scenery by asset name, as the runner would have fetched them.

        Args:
            service: The service that is tested.
            directory: Where the files are written.
        """
        return samples.scenery(directory)

    @classmethod
    def frames_of(cls, service: Service[Any], episode: int, count: int = FRAMES) -> list[Frame]:
        """Grants of an episode. In the last one, inputs that are not required are absent.

        Args:
            service: The service, whose declared inputs the frames have.
            episode: Number of the episode.
            count: Number of frames.
        """
        # Absent in the last frame, not in the first, which has no lagged input anyway.
        optional = {i.topic: "left out" for i in service.inputs if not i.required and i.topic != "*"}
        return [
            Frame(
                episode=episode,
                number=number,
                t_ns=number * samples.SAMPLING_PERIOD_NS,
                previous=number - 1,
                inputs=samples.inputs(service.inputs, number, optional if number == count - 1 else {}),
                service=service.run.name,
                seed=EPISODE_SEED,
                seed_episode=episode,
            )
            for number in range(count)
        ]

    @classmethod
    def prepared(
        cls, service: Service[Any], directory: Path, demand: Mapping[str, frozenset[str]] | None = None
    ) -> tuple[Prepared, Mapping[str, Path]]:
        """Prepare a service with the sample street.

        Args:
            service: The service.
            directory: Where the files of scenery are written.
            demand: Parts asked for, by topic; None: those of the class, by default all.

        Returns:
            What the service answers, and the files of scenery by asset name.
        """
        assets = cls.street(service, directory / "assets")
        if demand is None:
            demand = cls.demand or {topic: frozenset(PARTS.get(topic, ())) for topic in service.outputs}
        producers = {topic: (samples.source(topic),) for topic in PAYLOADS}
        return service.prepare(Preparation(demand=demand, assets=assets, producers=producers)), assets

    @classmethod
    @contextmanager
    def at_start(
        cls, directory: Path, demand: Mapping[str, frozenset[str]] | None = None
    ) -> Iterator[Service[Any]]:
        """The service at the beginning of the first episode; closed in the end.

        Args:
            directory: Where files of scenery, and a recorder's, are written.
            demand: As for `prepared`.
        """
        service = cls.build(directory)
        try:
            cls.prepared(service, directory, demand)
            service.reset(cls.episodes[0], EPISODE_SEED, 0)
            yield service
        finally:
            service.close()

    @classmethod
    def play(cls, directory: Path, skip: Sequence[int] = ()) -> Played:
        """Prepare, play the episodes, close.

        Args:
            directory: Where files of scenery, and a recorder's, are written.
            skip: Numbers of frames that are left out of each episode.
        """
        service = cls.build(directory)
        try:
            played = Played(service, *cls.prepared(service, directory), service.run.directory)
            for episode in cls.episodes:
                service.reset(episode, EPISODE_SEED, 0)
                frames = [frame for frame in cls.frames_of(service, episode) if frame.number not in skip]
                # Copied before the steps: a service that writes into its inputs is to be found out.
                granted = [[(bytes(i.header), bytes(i.body)) for i in frame.inputs] for frame in frames]
                played.episodes.append([])
                for frame in frames:
                    played.episodes[-1].append(service.step(frame))
                    if len(played.episodes) > 1:  # in the second one: the bytes of both are compared
                        service.release_memory()
                service.end_episode(len(frames))
                if not played.frames:
                    played.frames, played.granted = frames, granted
        finally:
            service.close()
        return played

    # --- what it declares ------------------------------------------------------------------------

    def test_role_inputs_and_outputs_are_those_of_the_protocol(self) -> None:
        """A topic or part that no other service knows would never be granted."""
        cls = self.service_class
        assert cls.role in get_args(Role)
        assert set(cls.outputs) <= set(PAYLOADS)
        assert len(set(cls.outputs)) == len(cls.outputs)
        for item in cls.inputs:
            assert item.lag in (0, 1)
            if item.topic == "*":
                assert cls.role == "recorder"
                assert not item.required
                continue
            assert item.topic in PAYLOADS
            assert set(item.parts) <= set(PARTS.get(item.topic, ()))
            assert item.lag == 1 or item.topic not in cls.outputs, "depends on its own product"

    def test_settings_are_a_frozen_struct_that_names_units(self) -> None:
        """Numbers cross the boundary of a file there, so each says what it is measured in."""
        info = inspect.type_info(self.service_class.Settings)
        assert isinstance(info, inspect.StructType)
        config = self.service_class.Settings.__struct_config__
        assert config.frozen
        assert config.forbid_unknown_fields
        for entry in info.fields:
            kinds = entry.type.types if isinstance(entry.type, inspect.UnionType) else (entry.type,)
            for kind in kinds:
                assert not isinstance(kind, inspect.IntType | inspect.FloatType), f"{entry.name} has no unit"

    def test_an_unknown_setting_is_refused_by_name(self) -> None:
        """The message names the key."""
        with pytest.raises(ScenarioError, match="unknown key 'no_such_setting'"):
            convert_settings(self.service_class.Settings, {**self.settings, "no_such_setting": 1})

    def test_without_settings_it_starts_or_says_what_it_lacks(self, tmp_path: Path) -> None:
        """A setting that is not given leads to no traceback."""
        # The length is that of a text with a value and a remedy; «error» alone would pass otherwise.
        run = RunInfo(name="service", carriers=self.carriers, devices=self.devices, directory=tmp_path)
        try:
            self.service_class(convert_settings(self.service_class.Settings, {}), run).close()
        except CaviarError as error:
            assert len(str(error)) > 20

    def test_importing_it_imports_nothing_heavy(self) -> None:
        """So that an agent or a broker does not carry a ray tracer."""
        module = self.service_class.__module__
        show = (
            f"import {module}, sys; print(*({{m.partition('.')[0] for m in sys.modules}} & set({HEAVY!r})))"
        )
        # A process of its own: in this one other tests have imported everything.
        done = subprocess.run(  # noqa: S603 - this interpreter, a module of ours
            [sys.executable, "-c", show], capture_output=True, text=True, timeout=60, check=False
        )
        assert done.returncode == 0, done.stderr
        assert done.stdout.split() == []

    # --- what it produces ------------------------------------------------------------------------

    def test_products_are_of_declared_topics_and_of_their_class(self, played: Played) -> None:
        """Every frame whose inputs are there gives every output that is asked for."""
        # All of them in the first frame alone: in the last one, inputs that are not required are absent.
        for result in played.episodes[0]:
            assert set(result.products) <= set(self.service_class.outputs)
            for topic, payload in result.products.items():
                assert type(payload) is PAYLOADS[topic]
        assert set(played.episodes[0][0].products) == set(self.demand or self.service_class.outputs)

    def test_products_are_finite_and_survive_the_wire(self, played: Played) -> None:
        """Encoding refuses what is not finite (clause 21)."""
        for frame, result in zip(played.encoded(), played.episodes[0], strict=True):
            for topic, (header, body) in frame.items():
                assert decode_payload(topic, header, body) == result.products[topic]

    def test_what_it_reports_beside_products_can_travel(self, played: Played) -> None:
        """Decisions are strings; counts and measured times whole numbers ≥ 0."""
        # `type(…) is int`: a NumPy integer is equal to one, and msgpack has no form for it.
        for result in played.episodes[0]:
            assert all(isinstance(value, str) for value in result.decisions.values())
            numbers = [*result.counts.values(), *result.measured.values()]
            assert all(type(value) is int and value >= 0 for value in numbers), numbers
            msgspec.msgpack.encode([result.fidelity, dict(result.counts), dict(result.measured)])

    def test_the_same_seed_gives_the_same_bytes_in_another_life(self, played: Played, tmp_path: Path) -> None:
        """Clause 20, and clause 19 for random numbers."""
        again = self.play(tmp_path)
        for episode in range(len(self.episodes)):
            assert again.encoded(episode) == played.encoded(episode)

    def test_a_reset_leaves_nothing_of_the_episode_before(self, played: Played) -> None:
        """The same episode played twice in one life is the same."""
        if len(set(self.episodes)) == 1:
            assert played.encoded(1) == played.encoded(0)

    def test_another_process_goes_on_with_the_same_bytes(self, tmp_path: Path) -> None:
        """Clause 18: after what `checkpoint` saved; a service without state, from its frames alone."""
        declared = self.service_class.checkpoints
        with self.at_start(tmp_path / "first") as first:
            frames = self.frames_of(first, self.episodes[0], 2 * INTERRUPTED)
            for frame in frames[:INTERRUPTED]:
                first.step(frame)
            state = first.checkpoint() if declared else b""
            expected = [encoded(first.step(frame)) for frame in frames[INTERRUPTED:]]
        with self.at_start(tmp_path / "second") as second:
            later = frames[INTERRUPTED:]
            if declared:
                second.restore(state)
                assert second.checkpoint() == state, "what was restored is not what was saved"
            else:
                # The frame before was another process's: a service whose products depend on it shows now.
                later[0] = msgspec.structs.replace(later[0], previous=-1)
            found = [encoded(second.step(frame)) for frame in later]
        assert found == expected, "has state that outlives a frame: " + (
            "checkpoint and restore leave some of it out" if declared else "set checkpoints = True"
        )

    def test_saving_twice_gives_the_same_bytes(self, tmp_path: Path) -> None:
        """A state has one form, and saving it changes nothing."""
        if not self.service_class.checkpoints:
            pytest.skip("keeps no state from frame to frame")
        with self.at_start(tmp_path) as service:
            service.step(self.frames_of(service, self.episodes[0])[0])
            assert service.checkpoint() == service.checkpoint()

    def test_what_is_no_state_is_refused(self, tmp_path: Path) -> None:
        """With an error for the user, not a traceback."""
        if not self.service_class.checkpoints:
            pytest.skip("keeps no state from frame to frame")
        with self.at_start(tmp_path) as service:
            service.step(self.frames_of(service, self.episodes[0])[0])
            state = service.checkpoint()
            # Nothing, text, a state that was cut off, and one with a wrong bit: each is read in another step.
            flipped = bytes([*state[:-1], state[-1] ^ 1])
            for garbage in (b"", b"no state at all", state[: len(state) // 2], flipped):
                with pytest.raises(CaviarError) as error:
                    service.restore(garbage)
                assert len(str(error.value)) > 20

    def test_inputs_are_left_as_they_were(self, played: Played) -> None:
        """Other services of an embedded run get the same objects."""
        for frame, granted in zip(played.frames, played.granted, strict=True):
            for item, (header, body) in zip(frame.inputs, granted, strict=True):
                assert (bytes(item.header), bytes(item.body)) == (header, body)
                if item.present:
                    assert encode_payload(item.payload) == (header, body)

    def test_it_can_be_closed_twice_and_before_it_was_prepared(self, played: Played, tmp_path: Path) -> None:
        """An error may come at any time."""
        # Twice: the runner closes after an error, and again when it ends.
        played.service.close()
        self.build(tmp_path).close()
