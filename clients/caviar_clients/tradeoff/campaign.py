"""All settings over all scenes: what is loaded when, measured by turns, and skipped for which reason."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field

import msgspec

from caviar_clients.tradeoff import ladder
from caviar_clients.tradeoff.ladder import Block, Setting
from caviar_clients.tradeoff.measure import Rung, Step
from caviar_clients.tradeoff.rows import Timing
from caviar_clients.tradeoff.scenes import Scenes
from caviar_clients.tradeoff.schedule import Cost, predicted_s, shares, spread_order
from caviar_clients.tradeoff.users import Difference, Key, Noise, UserChannel, differences, user_channels
from caviar_protocol.errors import CaviarError, RunError

ROUNDS = 3
"""Times that each scene is measured, where time allows: for the 99th percentile."""

LIMIT = 0.7
"""Share of what is left of its block's time that the first scene of a setting may be expected to take."""


class Skipped(msgspec.Struct, frozen=True, kw_only=True):
    """A setting that was not measured."""

    setting: str
    block: str
    reason: str


@dataclass(kw_only=True)
class Measured:
    """What was found of one setting."""

    setting: Setting
    rung: str
    prepare_s: float
    loaded_mib: float | None
    timing: Timing = field(default_factory=Timing)
    baseline_ms: float = 0.0
    """Median time of the baseline, measured by turns with this one."""
    differences: list[Difference] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True, kw_only=True)
class Told:
    """How a campaign is getting on."""

    text: str
    done: float
    """Share of the present block."""
    left_s: float
    """[s] of the whole, at most, as far as can be said."""


@dataclass(kw_only=True)
class _Entry:
    """A setting of the block that is being measured."""

    rung: Rung
    measured: Measured
    count: int = 0


class Campaign:
    """Measures blocks of settings over the same scenes.

    Parameters
    ----------
    scenes
        What is measured on.
    reference, baseline
        What errors and factors are against. None: the first that can be loaded of `ladder.REFERENCES`
        and `ladder.BASELINES`.
    seconds
        For everything.
    receivers
        Receivers of a scene at most; None: all.
    told
        Is told about progress.
    """

    def __init__(
        self,
        scenes: Scenes,
        *,
        reference: Setting | None,
        baseline: Setting | None,
        seconds: float,
        receivers: int | None,
        told: Callable[[Told], None],
    ) -> None:
        self._scenes, self._receivers, self._told = scenes, receivers, told
        self._until = time.monotonic() + seconds
        self._order = spread_order(len(scenes.instants))
        self._noise = Noise.of(scenes)
        self.skipped: list[Skipped] = []
        self._reference, self._baseline = reference, baseline
        self._truth: dict[Key, UserChannel] = {}
        """Channels of the reference."""
        self.channels: dict[str, dict[Key, UserChannel]] = {}
        """Channels by label, of settings whose seeds are compared with each other."""

    @property
    def reference(self) -> str:
        """Label of what errors are against."""
        return self._named(self._reference).label

    @property
    def baseline(self) -> str:
        """Label of what factors are against."""
        return self._named(self._baseline).label

    def first(self, settings: Sequence[Setting], share: float) -> list[Measured]:
        """The block that has reference and baseline in it; raises `RunError` where they cannot be loaded."""
        with ExitStack() as stack:
            begun = time.monotonic()
            entries = self._prepared("ladder", settings, share, stack)
            by_label = {entry.measured.setting.label: entry for entry in entries}
            self._reference = self._chosen(self._reference, ladder.REFERENCES, by_label, "--reference")
            self._baseline = self._chosen(self._baseline, ladder.BASELINES, by_label, "--baseline")
            reference = by_label[self._reference.label]
            entries.sort(key=lambda entry: entry is not reference)  # its channels are needed first
            self._measure("ladder", entries, reference, begun + share * self._left_s(begun))
        return [entry.measured for entry in sorted(entries, key=lambda e: settings.index(e.measured.setting))]

    def block(self, name: Block, settings: Sequence[Setting], share: float) -> list[Measured]:
        """Another block, in which the baseline takes part."""
        with ExitStack() as stack:
            begun = time.monotonic()
            around = [self._named(self._baseline), *settings]
            entries = self._prepared(name, around, share, stack)
            self._measure(name, entries, None, begun + share * self._left_s(begun))
        return [entry.measured for entry in entries if entry.measured.setting in settings]

    def _left_s(self, now: float) -> float:
        return max(0.0, self._until - now)

    def _named(self, setting: Setting | None) -> Setting:
        if setting is None:
            raise RunError("the first block has not been measured")
        return setting

    def _chosen(
        self, wanted: Setting | None, order: Sequence[str], loaded: dict[str, _Entry], option: str
    ) -> Setting:
        labels = list(order) if wanted is None else [wanted.label]
        for label in labels:
            if label in loaded:
                return loaded[label].measured.setting
        reasons = [s.reason for s in self.skipped if s.setting in labels]
        raise RunError(
            f"none of {', '.join(labels)} can be measured ({'; '.join(dict.fromkeys(reasons))}); "
            f"name another setting with {option}"
        )

    def _prepared(
        self, name: Block, settings: Sequence[Setting], share: float, stack: ExitStack
    ) -> list[_Entry]:
        """Load and warm up what can be."""
        entries, costs = list[_Entry](), list[Cost]()
        begun = time.monotonic()
        until = begun + share * self._left_s(begun)
        for number, setting in enumerate(settings):
            self._tell(f"{name}: loading {setting.label}", number / len(settings) / 3)
            expected, left = predicted_s(setting, costs), until - time.monotonic()
            if entries and (left <= 0 or (expected or 0.0) > LIMIT * left):
                self._skip(setting, name, _no_time(expected, left))
                continue
            try:
                rung = Rung(setting, self._scenes, self._receivers)
            except (CaviarError, RuntimeError, MemoryError) as error:  # Dr.Jit raises RuntimeError
                self._skip(setting, name, str(error) or type(error).__name__)
                continue
            stack.callback(rung.close)
            costs.append(Cost(setting, rung.first.time_ms / 1e3))
            measured = Measured(
                setting=setting,
                rung=rung.first.channel.rung,
                prepare_s=rung.prepare_s,
                loaded_mib=rung.loaded_mib,
            )
            entries.append(_Entry(rung=rung, measured=measured))
        return entries

    def _measure(self, name: Block, entries: list[_Entry], reference: _Entry | None, until: float) -> None:
        """By turns, each as often as its share allows."""
        seconds = until - time.monotonic()
        cold = [entry for entry in entries if entry.rung.first.time_ms / 1e3 > LIMIT * max(seconds, 1.0)]
        warm = [entry for entry in entries if entry not in cold]
        for entry in cold:
            entry.measured.notes.append("timed on the scene that warmed it up: another would take too long")
            self._take(entry, 0, entry.rung.first, is_reference=entry is reference)
        scenes = [self._scenes_of(entry.measured.setting) for entry in warm]
        costs = [entry.rung.first.time_ms / 1e3 for entry in warm]
        for entry, count in zip(warm, shares(costs, [ROUNDS * s for s in scenes], seconds), strict=True):
            entry.count = count
        if reference is not None and reference.count:  # every scene, before others see one twice
            reference.count = max(reference.count, self._scenes_of(reference.measured.setting))
        turns = max((entry.count for entry in warm), default=0)
        for turn in range(turns):
            for entry in warm:
                if entry.count > turn and (turn == 0 or entry is reference or time.monotonic() < until):
                    self._tell(f"{name}: {entry.measured.setting.label}", (1 + 2 * turn / turns) / 3)
                    self._turn(name, entry, turn, is_reference=entry is reference)
        self._finish(entries)

    def _turn(self, name: Block, entry: _Entry, turn: int, *, is_reference: bool) -> None:
        index = self._order[turn % self._scenes_of(entry.measured.setting)]
        try:
            entry.rung.release()
            step = entry.rung.step(self._scenes.instants[index])
        except (CaviarError, RuntimeError, MemoryError) as error:
            entry.count = 0
            entry.measured.notes.append(f"ended early: {error}")
            return
        self._take(entry, index, step, is_reference=is_reference)

    def _take(self, entry: _Entry, index: int, step: Step, *, is_reference: bool) -> None:
        """Note what a step took; if its scene is new to the setting, what users got too."""
        timing, setting = entry.measured.timing, entry.measured.setting
        timing.times_ms.append(step.time_ms)
        timing.lost += step.lost_paths
        if step.memory_mib is not None:
            timing.memory_mib.append(step.memory_mib)
        frame = self._scenes.instants[index].frame
        if frame in timing.frames:
            return
        timing.frames.append(frame)
        timing.receivers.append(len(step.channel.rx))
        timing.paths.append(len(step.channel.tau))
        if setting.elements is not None:
            return  # other arrays than the reference's
        found = user_channels(frame, step, self._noise)
        if is_reference:
            self._truth.update(found)
        if setting.block in ("convergence", "diffuse convergence"):
            self.channels.setdefault(setting.label, {}).update(found)
        entry.measured.differences += differences(found, self._truth)

    def _finish(self, entries: list[_Entry]) -> None:
        entries[:] = [entry for entry in entries if entry.measured.timing.times_ms or self._failed(entry)]
        baseline = next((e for e in entries if e.measured.setting == self._baseline), None)
        for entry in entries:
            measured = entry.measured
            if baseline is not None:
                measured.baseline_ms = baseline.measured.timing.median_ms
            scenes, limit = len(measured.timing.frames), len(self._scenes.instants)
            if scenes < limit:
                measured.notes.append(f"{scenes} of {limit} scenes")
            if measured.setting.most_receivers is not None:
                measured.notes.append(f"{measured.timing.receivers[0]} receivers")
            if measured.timing.lost:
                measured.notes.append(f"paths lost in {measured.timing.lost} measurements")

    def _failed(self, entry: _Entry) -> bool:
        self._skip(entry.measured.setting, entry.measured.setting.block, "; ".join(entry.measured.notes))
        return False

    def _scenes_of(self, setting: Setting) -> int:
        return min(len(self._scenes.instants), setting.most_scenes or len(self._scenes.instants))

    def _skip(self, setting: Setting, block: Block, reason: str) -> None:
        self.skipped.append(Skipped(setting=setting.label, block=block, reason=reason))

    def _tell(self, text: str, done: float) -> None:
        self._told(Told(text=text, done=done, left_s=self._left_s(time.monotonic())))


def _no_time(expected_s: float | None, left_s: float) -> str:
    if expected_s is None or left_s <= 0:
        return "the time for its block was used up; give more with --minutes"
    return (
        f"one scene is expected to take {expected_s:.0f} s, of the {left_s:.0f} s left for its block; "
        "give more with --minutes"
    )
