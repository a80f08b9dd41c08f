"""The adaptive channel with a real ray tracer, and runs of it that are repeated."""

from __future__ import annotations

import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from scenarios_support import SCENARIOS

from caviar_clients.cli.summary import Decided, summarise
from caviar_clients.session.embedded import EmbeddedRun
from caviar_protocol.codec import encode_payload
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.recording import Recording
from caviar_protocol.recording.reader import Imposed, recorded_decisions
from caviar_protocol.scenario import Scenario, load_scenario
from caviar_protocol.scenario.conversion import convert_settings
from caviar_protocol.topics import Channel, Scene
from caviar_services.channel.adaptive.channel import TIMINGS, AdaptiveChannel, rehearsal_scene
from caviar_services.channel.adaptive.controller import Workload
from caviar_services.channel.sionna.model import SionnaChannel
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo

pytestmark = pytest.mark.channel

RUNGS = {"1e3": 1_000, "1e4": 10_000, "1e5": 100_000}
"""Rays of each rung: launched, for enumerated ones take a launch of the scenery beforehand."""

BODIES = 20
"""Boxes in the street, one for each antenna and as many beside them."""


def scenario(frames: int, **settings: Any) -> Scenario:
    """The shipped scenario for a few frames, with other rungs."""
    for library in ("libsumo", "mitsuba", "sionna.rt"):
        pytest.importorskip(library, reason="needs the extras")
    shipped = load_scenario(SCENARIOS / "adaptive.toml")
    channel = shipped.services["channel"]
    ladder = [{"label": label, "settings": {"samples": samples}} for label, samples in RUNGS.items()]
    common = {**channel.settings["common"], "candidates": "launched", "max_depth": 3}
    settings = {**channel.settings, "ladder": ladder, "common": common, **settings}
    channel = msgspec.structs.replace(channel, settings=settings)
    return msgspec.structs.replace(
        shipped,
        run=msgspec.structs.replace(shipped.run, frames=frames),
        services={**shipped.services, "channel": channel},
    )


class ScaledClock:
    """Time that this process computes for, which goes faster or slower: what else runs is not in it."""

    def __init__(self) -> None:
        self.scale = 1.0
        self._last, self._now = time.process_time_ns(), 0.0

    def __call__(self) -> int:
        now = time.process_time_ns()
        self._now += (now - self._last) * self.scale
        self._last = now
        return round(self._now)


def street() -> dict[str, Path]:
    """The bundled street canyon, where it lies."""
    package = find_spec("sionna.rt")
    assert package is not None
    assert package.origin is not None
    name = "simple_street_canyon"
    return {f"scenery/{name}.xml": Path(package.origin).parent / "scenes" / name / f"{name}.xml"}


@pytest.fixture(scope="module")
def canyon() -> tuple[AdaptiveChannel, ScaledClock]:
    """A prepared channel with the scenario's rungs, and its clock."""
    planned = scenario(1)
    common = {"candidates": "launched", "max_depth": 2, "bodies": BODIES}
    settings = planned.services["channel"].settings | {"common": common}
    run = RunInfo(name="channel", carriers=planned.carriers, devices=planned.devices)
    channel = AdaptiveChannel(convert_settings(AdaptiveChannel.Settings, settings), run)
    clock = ScaledClock()
    channel.clock = clock
    channel.prepare(Preparation(demand={"channel": frozenset()}, assets=street()))
    return channel, clock


def played(channel: AdaptiveChannel, numbers: range, budget_ms: float) -> list[str]:
    """The rungs that frames with the scenario's antennas are computed on."""
    frames = [granted(traffic(channel, n), n, round(budget_ms * 1e6)) for n in numbers]
    return [channel.step(frame).decisions["rung"] for frame in frames]


def traffic(channel: AdaptiveChannel, step: int) -> Scene:
    """The scenario's antennas on boxes that drive through the street."""
    return rehearsal_scene(channel.run.devices, {"": BODIES}, is_free=channel._is_free, step=step)


def granted(scene: Scene, number: int, budget_ns: int = 0) -> Frame:
    source = FrameInput(GrantInput(topic="scene", source="w", status=Status.FRESH), payload=scene)
    return Frame(episode=0, number=number, t_ns=0, budget_ns=budget_ns, inputs=(source,))


def test_equal_scenes_are_loaded_once(canyon: tuple[AdaptiveChannel, ScaledClock]) -> None:
    """Munich four times over would cost minutes and gigabytes."""
    models = [rung.model for rung in canyon[0].rungs]
    assert [type(model) for model in models] == [SionnaChannel] * 3
    assert len({id(vars(model)["_scene"]) for model in models}) == 1


def test_products_are_those_of_a_channel_of_its_own(canyon: tuple[AdaptiveChannel, ScaledClock]) -> None:
    """Another user of the scene leaves nothing of itself in it."""
    adaptive = canyon[0]
    rung = adaptive.rungs[0].model
    alone = SionnaChannel(rung.settings, rung.run)
    alone.prepare(Preparation(demand={"channel": frozenset()}, assets=street()))
    frame = granted(traffic(adaptive, 0), 1)
    products = [model.step(frame).products["channel"] for model in (adaptive.rungs[2].model, rung, alone)]
    assert encode_payload(products[1]) == encode_payload(products[2])
    assert encode_payload(products[0]) != encode_payload(products[1])


def test_budgets_and_a_slow_machine_choose_the_rung(canyon: tuple[AdaptiveChannel, ScaledClock]) -> None:
    """Budgets are multiples of what this machine was timed to need, so that any machine passes."""
    channel, clock = canyon
    work = Workload(pairs=10, objects=BODIES)
    low, _, high = (predicted / 1e6 for predicted in channel.costs.predict(work))
    channel.reset(0, 1, 0)
    assert played(channel, range(5), 0.2 * low) == ["1e3"] * 5
    channel.reset(0, 1, 0)
    wide = 10 * high
    assert played(channel, range(5), wide) == ["1e5"] * 5
    clock.scale = 100.0
    slow = played(channel, range(5, 15), wide)
    assert slow[0] == "1e5"
    assert set(slow[4:]) == {"1e3"}, "after no more than four misses"
    clock.scale = 1.0
    later = played(channel, range(15, 45), wide)
    assert later[: channel.settings.patience - 1] == ["1e3"] * (channel.settings.patience - 1)
    assert set(later[-10:]) == {"1e5"}


class ScriptedClock:
    """Every rung takes 10 ms until some frame, then a second."""

    def __init__(self, frames: int = 4) -> None:
        self._slow_after = 2 * (3 * (TIMINGS + 1) + frames)
        self._asked, self._now = 0, 0

    def __call__(self) -> int:
        self._now += 10_000_000 if self._asked < self._slow_after else 1_000_000_000
        self._asked += 1
        return self._now


def embedded(
    planned: Scenario, directory: Path, clock: Callable[[], int], imposed: Imposed | None = None
) -> tuple[str, Recording]:
    """Digest and recording of a run in which the channel has this clock."""
    directory.mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(AdaptiveChannel, "clock", staticmethod(clock))
        outcome = EmbeddedRun(planned, directory, imposed=imposed).run()
    assert not outcome.error
    return outcome.digest, Recording(directory)


def rungs_of(decisions: Imposed) -> list[str]:
    return [decisions["channel", 0, number]["rung"] for number in range(len(decisions))]


@pytest.mark.sumo
def test_recorded_decisions_imposed_repeat_a_run(tmp_path: Path) -> None:
    """Bit by bit, though everything takes another time; without them the run is another one."""
    planned = scenario(9, calibrate_every=0)
    digest, recording = embedded(planned, tmp_path / "first", ScriptedClock())
    decisions = recorded_decisions(recording)
    taken = rungs_of(decisions)
    assert taken[0] == "1e5"
    assert taken[-1] == "1e3"
    other, _ = embedded(planned, tmp_path / "other", ScriptedClock(frames=2))
    assert other != digest
    repeated, recording = embedded(planned, tmp_path / "again", ScriptedClock(frames=2), decisions)
    assert repeated == digest
    assert recorded_decisions(recording) == decisions


@pytest.mark.exhaustive
@pytest.mark.sumo
def test_stated_errors_hold_in_most_frames_of_a_run(tmp_path: Path) -> None:
    """Errors of successive frames are not independent, so less is asked for than the nine in ten stated."""
    planned = scenario(12, calibrate_every=1, fixed="1e4")
    _, recording = embedded(planned, tmp_path / "run", ScriptedClock())
    (found,) = summarise(recording).decided
    assert isinstance(found, Decided)
    assert found.frames == {"1e4": 12}
    products = [
        channel for _, item in recording.products("channel") if isinstance(channel := item.payload, Channel)
    ]
    bounds = [channel.error_bound_db for channel in products]
    assert all(bound is not None and np.isfinite(bound).all() for bound in bounds)
    assert {channel.error_reference for channel in products} == {"siso-rt 1e5"}
    pairs = sum(len(channel.rx) for channel in products)
    assert 0.8 * pairs < found.error_checks <= pairs, "but those that the reference does not reach"
    assert found.error_covered >= 0.75 * found.error_checks
