"""A run in one process names the service that it waits for."""

from __future__ import annotations

import itertools
import logging
import threading
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

import pytest
from msgspec.structs import replace as replace_field

from caviar_broker.core.plan import briefings, plan_run
from caviar_clients.session import watchdog
from caviar_clients.session.embedded import EmbeddedRun, EmbeddedSession
from caviar_clients.session.prepared import prepare
from caviar_protocol.messages import Grant, Input
from caviar_protocol.scenario import Scenario, parse_scenario
from caviar_protocol.topics import Action
from caviar_services.agent.baselines import RandomAgent
from caviar_services.channel.statistical.free_space import FreeSpaceChannel
from caviar_services.service import Frame, Preparation, Prepared, StepResult

SMOKE = Path(__file__).parents[2] / "deploy" / "caviar_scenarios" / "smoke.toml"

told: list[str] = []
is_hanging, is_told = threading.Event(), threading.Event()


def tell(text: str) -> None:
    told.append(text)
    if is_hanging.is_set():  # elsewhere a busy machine may be slow
        is_told.set()


def hang(name: str, place: str) -> None:
    """Return once the watchdog has told of it."""
    if name == place:
        is_hanging.set()
        assert is_told.wait(20.0), "the watchdog says nothing"
        is_hanging.clear()


class Hangs(RandomAgent):
    """Hangs in the place that its class says."""

    where = ""
    before_step: ClassVar[Callable[[Frame], object]] = staticmethod(lambda frame: None)

    def prepare(self, preparation: Preparation) -> Prepared:
        self.run.progress("loading a policy")
        hang("prepare", self.where)
        return super().prepare(preparation)

    def reset(self, episode: int, seed: int, t0_ns: int) -> None:
        hang("reset", self.where)
        super().reset(episode, seed, t0_ns)

    def step(self, frame: Frame) -> StepResult:
        type(self).before_step(frame)
        hang("step", self.where if frame.number == 2 else "")
        return super().step(frame)

    def end_episode(self, frames: int) -> None:
        hang("end", self.where)

    def close(self) -> None:
        hang("close", self.where)


class SlowChannel(FreeSpaceChannel):
    """Hangs in a frame."""

    def step(self, frame: Frame) -> StepResult:
        hang("step", "step" if frame.number == 2 else "")
        return super().step(frame)


def test_a_wait_is_told_again_when_its_time_doubles_or_after_so_long() -> None:
    scenario = prepare(parse_scenario(SMOKE.read_text())).scenario
    plan = plan_run(scenario, "run", briefings(scenario, Path()))
    work = ("channel", Grant(epoch=1, attempt=1, episode=0, frame=3, t_ns=0))

    def times(*again_s: float) -> list[float]:
        watch = watchdog.Watchdog(plan, {}, lambda: work, tell, *again_s)
        told_at = [0.0]
        while len(told_at) < 6:
            told_at.append(watch._due_s(work, told_at[-1]))
        return told_at[1:]

    assert times() == [watchdog.STEP_S * factor for factor in (1, 2, 4, 8, 16)]
    assert times(2.0 * watchdog.STEP_S) == pytest.approx(
        [watchdog.STEP_S * factor for factor in (1, 2, 4, 6, 8)]
    )


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("LOOK_S", "STEP_S", "LOAD_S"):
        monkeypatch.setattr(watchdog, name, 0.05)
    told.clear()
    is_told.clear()


def smoke(*changes: tuple[str, str]) -> Scenario:
    text = SMOKE.read_text()
    for old, new in (("frames = 100\n", "frames = 4\n"), *changes):
        assert old in text
        text = text.replace(old, new, 1)
    return prepare(parse_scenario(text)).scenario


@pytest.mark.parametrize(
    ("where", "words"),
    [
        ("prepare", "waiting for agent 'agent' to prepare (loading a policy), at "),
        ("reset", "waiting for agent 'agent' to reset to episode 0"),
        ("step", "waiting for agent 'agent' in frame 2 (budget 20 ms), at "),
        ("end", "waiting for agent 'agent' to end episode 0"),
        ("close", "waiting for agent 'agent' to close"),
    ],
)
def test_a_service_that_hangs_is_named_with_frame_budget_and_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, where: str, words: str
) -> None:
    monkeypatch.setattr(Hangs, "where", where)
    scenario = smoke(('use = "los-beam"', f'use = "{__name__}:Hangs"'))
    outcome = EmbeddedRun(scenario, tmp_path, on_wait=tell).run()
    assert outcome.error == ""
    text = [text for text in told if text.startswith(words)][-1]
    assert f"{Path(__file__).name}:" in text
    assert text.endswith(" in hang")


def test_a_run_that_moves_on_is_not_told_of(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watchdog, "LOOK_S", 0.0005)
    monkeypatch.setattr(watchdog, "STEP_S", 30.0)
    monkeypatch.setattr(watchdog, "LOAD_S", 30.0)
    assert EmbeddedRun(smoke(), directory=None, on_wait=tell).run().error == ""
    assert told == []


@pytest.mark.parametrize(("budget_ms", "is_told"), [(60_000, False), (20, True)])
def test_a_service_within_a_long_budget_is_not_told_of(budget_ms: int, is_told: bool) -> None:
    """Nobody wants to hear of a ray tracer that is within its budget."""
    scenario = smoke(("budget_ms = 20\n", f"budget_ms = {budget_ms}\n"))  # the world's, the first one
    plan = plan_run(scenario, "run", briefings(scenario, Path()))
    work = "world", Grant(epoch=1, attempt=1, episode=0, frame=2, t_ns=0)
    looks, looked = itertools.count(), threading.Event()

    def present() -> watchdog.Work:
        if next(looks) == 4:
            looked.set()
        return work

    with watchdog.Watchdog(plan, {}, present, tell):
        assert looked.wait(20.0)
    assert bool(told) == is_told


@pytest.mark.parametrize("recorded", [True, False])
def test_an_environments_service_that_hangs_is_a_warning_in_the_programs_log(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path, recorded: bool
) -> None:
    """With the clock, which a recording needs, and without it."""

    handler = logging.Handler()
    monkeypatch.setattr(handler, "emit", lambda record: tell(record.getMessage()))
    monkeypatch.setattr(logging.getLogger("caviar.session"), "handlers", [handler])
    scenario = smoke(('use = "free-space"', f'use = "{__name__}:SlowChannel"'))
    inputs = (Input(topic="scene"), Input(topic="channel"))
    with EmbeddedSession(scenario, "agent", inputs, tmp_path if recorded else None) as run:
        frame = run.reset(seed=1)
        while not frame.final:
            frame = run.step({"action": Action(commands=())})
    assert [text for text in told if "waiting for channel 'channel' in frame 2" in text], told
    assert {record.levelname for record in caplog.records} == {"WARNING"}


def test_an_order_to_stop_names_what_keeps_the_run_from_its_end(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(watchdog, "STOP_S", 0.01)
    monkeypatch.setattr(watchdog, "STEP_S", 1000.0)
    monkeypatch.setattr(watchdog, "LOAD_S", 1000.0)
    monkeypatch.setattr(Hangs, "where", "step")
    scenario = smoke(('use = "los-beam"', f'use = "{__name__}:Hangs"'))
    # A session that another test of this process left to the garbage collector has its own.
    before = set(threading.enumerate())
    run = EmbeddedRun(scenario, tmp_path, on_wait=tell)
    # As a signal handler does, in the middle of the step.
    monkeypatch.setattr(
        Hangs, "before_step", staticmethod(lambda frame: frame.number == 2 and run.stop("enough of it"))
    )
    outcome = run.run()
    assert (outcome.error, run.statistics.frames) == ("enough of it", 2)
    assert ["waiting for agent 'agent' in frame 2" in text for text in told] == [True]
    assert not set(threading.enumerate()) - before


def test_misses_of_a_run_in_one_process_are_counted_after_its_first_frame(tmp_path: Path) -> None:
    scenario = prepare(Path("smoke"), 4).scenario
    services = {name: replace_field(spec, budget_ms=1e-6) for name, spec in scenario.services.items()}
    run = EmbeddedRun(replace_field(scenario, services=services), tmp_path)
    assert run.run().error == ""
    assert {s.frames - s.misses for s in run.statistics.services().values()} == {1}
