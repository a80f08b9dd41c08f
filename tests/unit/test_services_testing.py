"""The conformance tests find services that break the contract."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np
import pytest

from caviar_protocol.arrays import quantity
from caviar_protocol.errors import PayloadError, RunError
from caviar_protocol.messages import Input
from caviar_protocol.topics import Channel
from caviar_services.agent.base import Agent, AgentSettings
from caviar_services.channel.statistical.free_space import FreeSpaceChannel
from caviar_services.service import Frame, Service, StepResult
from caviar_services.testing import CONFORMANCE, ChannelConformance, ServiceConformance, samples

pytestmark = pytest.mark.slow


class Unseeded(FreeSpaceChannel):
    """Draws from a generator that is not seeded."""

    def step(self, frame: Frame) -> StepResult:
        result = super().step(frame)
        channel = result.products["channel"]
        assert isinstance(channel, Channel)
        noisy = msgspec.structs.replace(channel, a=channel.a * np.random.default_rng().random())
        return StepResult(products={"channel": noisy})


class Remembering(FreeSpaceChannel):
    """Counts frames over the end of an episode."""

    count = 0

    def step(self, frame: Frame) -> StepResult:
        type(self).count += 1
        result = super().step(frame)
        channel = result.products["channel"]
        return StepResult(products={"channel": msgspec.structs.replace(channel, dropped=type(self).count)})


class Infinite(FreeSpaceChannel):
    """Publishes a delay of an infinite way."""

    def step(self, frame: Frame) -> StepResult:
        channel = super().step(frame).products["channel"]
        assert isinstance(channel, Channel)
        tau = channel.tau.copy()
        tau[0] = np.inf
        return StepResult(products={"channel": msgspec.structs.replace(channel, tau=tau)})


class Undeclared(FreeSpaceChannel):
    """Publishes a scene, which it did not declare."""

    def step(self, frame: Frame) -> StepResult:
        return StepResult(products={**super().step(frame).products, "scene": frame.scene()})


class Overwriting(FreeSpaceChannel):
    """Moves the objects that it was shown."""

    def step(self, frame: Frame) -> StepResult:
        result = super().step(frame)
        for item in frame.inputs:
            item.header = b"\x80"
        return result


class Amplifying(FreeSpaceChannel):
    """Gains energy on the way."""

    def step(self, frame: Frame) -> StepResult:
        channel = super().step(frame).products["channel"]
        assert isinstance(channel, Channel)
        return StepResult(products={"channel": msgspec.structs.replace(channel, a=channel.a * 1e9)})


class Counting(FreeSpaceChannel):
    """Counts the frames of an episode, and does not say that it has state."""

    count = 0

    def reset(self, episode: int, seed: int, t0_ns: int) -> None:
        self.count = 0

    def step(self, frame: Frame) -> StepResult:
        self.count += 1
        channel = super().step(frame).products["channel"]
        return StepResult(products={"channel": msgspec.structs.replace(channel, dropped=self.count)})


class Saving(Counting):
    """Saves its count."""

    checkpoints: ClassVar[bool] = True

    def checkpoint(self) -> bytes:
        return self.count.to_bytes(8)

    def restore(self, state: bytes) -> None:
        if len(state) != 8 or state[0]:
            raise RunError(f"{state[:8]!r} is no count of frames; start the run again")
        self.count = int.from_bytes(state)


class Forgetting(Saving):
    """Saves what is not its state."""

    def checkpoint(self) -> bytes:
        return bytes(8)


class Deaf(Saving):
    """Does not take over what it saved."""

    def restore(self, state: bytes) -> None:
        """Nothing."""


class Credulous(Saving):
    """Takes over anything."""

    def restore(self, state: bytes) -> None:
        self.count = int.from_bytes(state)


class Restless(Saving):
    """Saves something else each time."""

    saves = 0

    def checkpoint(self) -> bytes:
        self.saves += 1
        return self.saves.to_bytes(8)


_GOES_ON = "test_another_process_goes_on_with_the_same_bytes"

BROKEN = [
    (Counting, _GOES_ON),
    (Forgetting, _GOES_ON),
    (Deaf, _GOES_ON),
    (Credulous, "test_what_is_no_state_is_refused"),
    (Restless, "test_saving_twice_gives_the_same_bytes"),
    (Unseeded, "test_the_same_seed_gives_the_same_bytes_in_another_life"),
    (Remembering, "test_a_reset_leaves_nothing_of_the_episode_before"),
    (Infinite, "test_products_are_finite_and_survive_the_wire"),
    (Undeclared, "test_products_are_of_declared_topics_and_of_their_class"),
    (Overwriting, "test_inputs_are_left_as_they_were"),
    (Amplifying, "test_paths_are_indexed_and_physical"),
]


def conformance_of(service: type[Service[Any]], base: type[ServiceConformance]) -> Any:
    kind = type("Tests", (base,), {"service_class": service})
    kind.__test__ = False
    return kind()


@pytest.mark.parametrize(("service", "name"), BROKEN)
def test_a_broken_service_fails_the_test_of_what_it_breaks(
    service: type[Service[Any]], name: str, tmp_path: Path
) -> None:
    tests = conformance_of(service, ChannelConformance)
    played = tests.play(tmp_path / "first")
    test = getattr(tests, name)
    arguments = {"played": played, "tmp_path": tmp_path / "second"}
    wanted = test.__code__.co_varnames[1 : test.__code__.co_argcount]
    with pytest.raises((AssertionError, PayloadError, pytest.fail.Exception)):
        test(**{key: arguments[key] for key in wanted})


@pytest.mark.parametrize("name", [_GOES_ON, "test_saving_twice_gives_the_same_bytes"])
def test_a_service_that_saves_all_of_its_state_passes(name: str, tmp_path: Path) -> None:
    getattr(conformance_of(Saving, ChannelConformance), name)(tmp_path)


class LooseSettings(msgspec.Struct, kw_only=True):
    """Neither frozen nor strict, and a number without a unit."""

    samples: int = 3


class UnitlessSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    good: Annotated[float, quantity("m", "with a unit")] = 1.0
    bare: float | None = None


@pytest.mark.parametrize("settings", [LooseSettings, UnitlessSettings])
def test_settings_without_units_or_strictness_are_found(settings: type[msgspec.Struct]) -> None:
    service = type("Loose", (FreeSpaceChannel,), {"Settings": settings})
    with pytest.raises(AssertionError):
        conformance_of(service, ChannelConformance).test_settings_are_a_frozen_struct_that_names_units()


def test_a_declaration_of_unknown_topics_is_found() -> None:
    class Curious(Agent[AgentSettings]):
        Settings = AgentSettings
        inputs: ClassVar[tuple[Input, ...]] = (Input(topic="weather"),)

        def choose(self, frame: Any, scene: Any, pairs: Any) -> list[Any]:
            return []

    with pytest.raises(AssertionError):
        conformance_of(Curious, CONFORMANCE["agent"]).test_role_inputs_and_outputs_are_those_of_the_protocol()


def test_an_implementation_that_imports_a_heavy_library_at_once_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "matplotlib.py").write_text("")
    (tmp_path / "eager.py").write_text("import matplotlib\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    service = type("Eager", (FreeSpaceChannel,), {"__module__": "eager"})
    with pytest.raises(AssertionError, match="matplotlib"):
        conformance_of(service, ChannelConformance).test_importing_it_imports_nothing_heavy()


def test_the_sample_street_has_a_product_of_every_topic_that_changes() -> None:
    for topic in samples.PAYLOADS:
        bytes_of = [samples.inputs([Input(topic=topic)], frame)[0] for frame in range(3)]
        for one, other in itertools.pairwise(bytes_of):
            assert (one.header, one.body) != (other.header, other.body), topic


def test_every_role_has_its_conformance_class() -> None:
    assert set(CONFORMANCE) == {"world", "channel", "sensors", "link", "agent", "recorder"}
