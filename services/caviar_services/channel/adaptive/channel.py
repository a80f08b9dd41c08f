"""The adaptive channel: each frame on the most accurate rung of a ladder that fits its budget.

Every rung is a channel model of its own, loaded and compiled before the first frame. Which one computed
a frame is a decision in DONE, which a replay imposes: durations differ from run to run, products then do not.
With ``calibrate_every`` some frames are computed by the highest rung, too, beyond the budget; from its
matrices follows what error each rung is expected to have, which stands in its products.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import ClassVar

import msgspec
from msgspec.structs import replace

from caviar_protocol.messages import Input, Role
from caviar_protocol.scene import antennas
from caviar_protocol.tables import Place
from caviar_protocol.topics import AntennaDevice, Channel, Scene
from caviar_services.channel.adaptive.controller import Choice, Controller, ControllerState
from caviar_services.channel.adaptive.cost_model import CostModel, CostState, Workload
from caviar_services.channel.adaptive.errors_stated import ErrorState, StatedError, nmse_db
from caviar_services.channel.adaptive.rehearsal import rehearsal_scene
from caviar_services.channel.adaptive.settings import AdaptiveSettings, Rung, built, models, rung_of
from caviar_services.channel.base import Modelled
from caviar_services.channel.outage import outage_counts
from caviar_services.channel.sionna_sharing import shared_scenes
from caviar_services.service import Frame, Preparation, Prepared, RunInfo, Service, StepResult
from caviar_services.state import restored, saved

DECISION = "rung"
"""Key of the decision in DONE."""

TIMINGS = 5
"""Timings of each rung before the first frame, behind one that is not counted."""

_TIMING_GRACE_S = 120.0

Devices = tuple[Sequence[AntennaDevice], Sequence[AntennaDevice]]
"""Transmitters and receivers."""


class _State(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    costs: CostState
    errors: tuple[ErrorState, ...]
    controller: ControllerState
    current: int | None
    rungs: tuple[bytes, ...]
    """State of each rung's model; empty where it has none."""


class AdaptiveChannel(Service[AdaptiveSettings]):
    """A ladder of channel models, one of which computes a frame."""

    role: ClassVar[Role] = "channel"
    inputs: ClassVar[tuple[Input, ...]] = (Input(topic="scene"),)
    outputs: ClassVar[tuple[str, ...]] = ("channel",)
    uses_scenery: ClassVar[bool] = True
    checkpoints: ClassVar[bool] = True
    Settings: ClassVar[type[msgspec.Struct]] = AdaptiveSettings
    clock: Callable[[], int] = staticmethod(time.perf_counter_ns)
    """Wall time [ns]."""

    @classmethod
    def check_settings(cls, settings: AdaptiveSettings, place: Place) -> None:
        """Raise `ScenarioError` for what is wrong inside the ladder."""
        models(settings, place)

    def __init__(self, settings: AdaptiveSettings, run: RunInfo) -> None:
        super().__init__(settings, run)
        self.rungs: tuple[Rung, ...] = built(settings, run)
        self.errors = [StatedError(rung.expected_error_db) for rung in self.rungs]
        self.costs: CostModel
        """Known once the service is prepared."""
        self._controller = Controller(settings.share, settings.margin, settings.patience)
        self._current: int | None = None
        self._with_h = False

    # --- before the first frame --------------------------------------------------------------------

    def prepare(self, preparation: Preparation) -> Prepared:
        self._with_h = "h" in preparation.demand.get("channel", frozenset())
        notes: list[str] = []
        with shared_scenes():
            for rung in self.rungs:
                told = rung.model.prepare(preparation).notes
                notes += [note for note in told if note not in notes]
        notes += self._time_rungs()
        return Prepared(notes=tuple(notes))

    def _time_rungs(self) -> list[str]:
        """Try every rung on the scenario's antennas, and begin to predict from how long it took."""
        scene = rehearsal_scene(self.run.devices)
        devices = antennas(scene, "tx"), antennas(scene, "rx")
        frame = Frame(episode=0, number=0, t_ns=0, service=self.run.name, seed=self.run.seed)
        timings = []
        for rung in self.rungs:
            self.run.progress(f"timing rung {rung.label}", _TIMING_GRACE_S)
            runs = [self._modelled(rung, frame, scene, devices)[1] for _ in range(TIMINGS + 1)]
            timings.append(runs[1:])
            rung.model.reset(0, self.run.seed, 0)
        pairs = len(devices[0]) * len(devices[1])
        self.costs = CostModel(timings, pairs, self.settings.quantile)
        self.run.progress("rungs timed", 0.0)
        return [
            f"rung {rung.label}: {sorted(taken)[len(taken) // 2] / 1e6:.1f} ms for {pairs} pairs"
            for rung, taken in zip(self.rungs, timings, strict=True)
        ]

    # --- frames ------------------------------------------------------------------------------------

    def reset(self, episode: int, seed: int, t0_ns: int) -> None:
        """Forget errors and rung, but not how fast this machine is."""
        for rung in self.rungs:
            rung.model.reset(episode, seed, t0_ns)
        for error in self.errors:
            error.reset()
        self._controller.reset()
        self._current = None

    def step(self, frame: Frame) -> StepResult:
        scene = frame.scene()
        devices = antennas(scene, "tx"), antennas(scene, "rx")
        work = Workload(pairs=len(devices[0]) * len(devices[1]), objects=len(scene.names))
        predicted = self.costs.predict(work)
        choice = self._choice(frame, predicted)
        rung = self.rungs[choice.rung]
        counts = {
            "rung-changes": int(self._current is not None and choice.rung != self._current),
            "no-rung-fits": int(not choice.fits),
        }
        self._current = choice.rung
        stated = self.errors[choice.rung].stated_db
        calibrates = self._calibrates(frame)
        made, taken = self._modelled(rung, frame, scene, devices, with_h=calibrates)
        self._observe(choice.rung, work, taken, calibrates)
        measured = {**made.measured, "rung": taken, "rung-predicted": round(predicted[choice.rung])}
        if calibrates:
            began = self.clock()
            counts |= self._calibrate(choice.rung, made.channel, frame, scene, devices)
            measured["calibrate"] = self.clock() - began
        channel = replace(made.channel, expected_error_db=stated, h=made.channel.h if self._with_h else ())
        return StepResult(
            products={"channel": channel},
            fidelity=f"{channel.rung} {rung.label}" + ("" if stated is None else f", NMSE ≤ {stated:.1f} dB"),
            decisions={DECISION: rung.label},
            counts={
                "paths": len(channel.tau),
                "dropped": channel.dropped,
                **made.counts,
                **outage_counts(channel, scene, rung.model),
                **{name: count for name, count in counts.items() if count},
            },
            measured=measured,
        )

    def _choice(self, frame: Frame, predicted: Sequence[float]) -> Choice:
        labels = self.settings.labels
        if DECISION in frame.imposed:
            rung = rung_of(labels, frame.imposed[DECISION], "the rung imposed")
        elif self.settings.fixed:
            rung = labels.index(self.settings.fixed)
        else:
            own = self.settings.budget_ms
            return self._controller.choose(predicted, frame.budget_ns if own is None else round(own * 1e6))
        self._controller.impose(rung)
        return Choice(rung=rung, fits=True)

    def _calibrates(self, frame: Frame) -> bool:
        every = self.settings.calibrate_every
        return bool(every) and frame.number % every == 0 and len(self.rungs) > 1

    def _modelled(
        self, rung: Rung, frame: Frame, scene: Scene, devices: Devices, *, with_h: bool = False
    ) -> tuple[Modelled, int]:
        """What a rung makes of a frame, and how long it took [ns]; ``with_h``: with matrices in any case."""
        model = rung.model
        asked, model.with_h = model.with_h, model.with_h or with_h
        began = self.clock()
        try:
            made = model.model(frame, scene, *devices)
        finally:
            model.with_h = asked
        return made, self.clock() - began

    def _observe(self, rung: int, work: Workload, taken: int, calibrates: bool) -> None:
        if self._with_h or not calibrates:  # else it did more than frames ask for
            self.costs.observe(rung, work, taken)

    def _calibrate(
        self, chosen: int, channel: Channel, frame: Frame, scene: Scene, devices: Devices
    ) -> dict[str, int]:
        """Measure the error of the chosen rung; where that is the highest, of the one least known."""
        highest = len(self.rungs) - 1
        checked = chosen
        if chosen == highest:
            checked = min(range(highest), key=lambda rung: self.errors[rung].measured)
        other = self.rungs[checked if chosen == highest else highest]
        second = self._modelled(other, frame, scene, devices, with_h=True)[0].channel
        mine, true = (second, channel) if chosen == highest else (channel, second)
        error = nmse_db(mine, true)
        held = None if error is None else self.errors[checked].check(error)
        return {} if held is None else {"error-checks": 1, "error-covered": int(held)}

    def checkpoint(self) -> bytes:
        """What is known of costs and errors, the rung, and what the rungs follow.

        Durations decide, so the same frames lead to the same rungs only where those are imposed.
        """
        state = _State(
            costs=self.costs.state,
            errors=tuple(error.state for error in self.errors),
            controller=self._controller.state,
            current=self._current,
            rungs=tuple(rung.model.checkpoint() if rung.model.checkpoints else b"" for rung in self.rungs),
        )
        return saved(self, 1, state)

    def restore(self, state: bytes) -> None:
        """See `checkpoint`."""
        was = restored(self, 1, _State, state)
        for error, known in zip(self.errors, was.errors, strict=True):
            error.go_on(known)
        for rung, model_state in zip(self.rungs, was.rungs, strict=True):
            if rung.model.checkpoints:
                rung.model.restore(model_state)
        self.costs.go_on(was.costs)
        self._controller.go_on(was.controller)
        self._current = was.current

    # --- the rest of its life ------------------------------------------------------------------------

    def release_memory(self) -> None:
        for rung in self.rungs:
            rung.model.release_memory()

    def end_episode(self, frames: int) -> None:
        for rung in self.rungs:
            rung.model.end_episode(frames)

    def close(self) -> None:
        for rung in self.rungs:
            rung.model.close()
