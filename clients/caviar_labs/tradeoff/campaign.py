"""All settings over all scenes: order and number of measurements, what is loaded when, what is skipped.

Settings are measured in blocks, and a block in waves of `TOGETHER` settings that are loaded at once and take
turns with the baseline scene by scene: noise of the machine then hits all of a wave alike, and factors to the
baseline stay right where times do not.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from caviar_clients.session.scenes import Scenes
from caviar_labs.tradeoff.errors import Key, Row, UserChannel
from caviar_labs.tradeoff.keyframes import keyframe_rows
from caviar_labs.tradeoff.ladder import Block, Setting
from caviar_labs.tradeoff.worker import Sample, Worker
from caviar_protocol.errors import CaviarError, RunError, suggestion


def spread_order(count: int) -> list[int]:
    """Order all indices below ``count`` such that the first few of them lie far apart.

    Sorted by their binary digits reversed (van der Corput 1935).

    Example:
        >>> spread_order(8)
        [0, 4, 2, 6, 1, 5, 3, 7]
    """
    digits = max(1, (count - 1).bit_length())
    # However early time runs out, the scenes that were seen are spread over the episode.
    return sorted(range(count), key=lambda i: int(f"{i:0{digits}b}"[::-1], 2))


def shares(costs_s: Sequence[float], most: Sequence[int], seconds: float) -> list[int]:
    """Decide how often each setting is measured: at least once.

    The time is shared out equally, and what the cheap ones leave goes to the expensive ones.

    Args:
        costs_s: Time of one measurement of each [s].
        most: Measurements of each at most.
        seconds: Time for all of them [s].

    Example:
        >>> shares([1.0, 10.0], [9, 9], 40.0)
        [9, 3]
    """
    # From the cheapest on: each that needs less than its share leaves the rest to those after it.
    counts, left = [0] * len(costs_s), seconds
    order = sorted(range(len(costs_s)), key=lambda i: costs_s[i] * most[i])
    for rank, i in enumerate(order):
        share = left / (len(order) - rank)
        counts[i] = max(1, min(most[i], int(share / costs_s[i]) if costs_s[i] > 0 else most[i]))
        left -= counts[i] * costs_s[i]
    return counts


@dataclass(frozen=True)
class Cost:
    """Time that one scene of a setting took [s]."""

    setting: Setting
    seconds: float


def predicted_s(setting: Setting, known: Sequence[Cost]) -> float | None:
    """Predict the time of a scene [s] from settings of the same table that were measured.

    From the row of its column that was measured last: as much longer as the same two rows differ in the
    first column, or as there are more pairs of elements, or more samples, whichever says most.

    Args:
        setting: The setting in question.
        known: Costs of the table so far, in the order in which they were measured.

    Returns:
        The time [s]; None where nothing of its column was measured.
    """
    column = [cost for cost in known if setting.column and cost.setting.column == setting.column]
    if not column:
        return None
    last = column[-1]
    # The first column is measured first, and its rows cost as the others' do relative to each other.
    first = known[0].setting.column
    by_row = {cost.setting.row: cost.seconds for cost in known if cost.setting.column == first}
    ratios = [
        _pairs(setting) / _pairs(last.setting),
        _samples(setting) / _samples(last.setting),
    ]
    if by_row.get(last.setting.row) and setting.row in by_row:
        ratios.append(by_row[setting.row] / by_row[last.setting.row])
    # The greatest: a prediction that is too short costs the time of all others, one too long a cell.
    return last.seconds * max(ratios)


def _pairs(setting: Setting) -> int:
    return setting.elements[0] * setting.elements[1] if setting.elements else 1


def _samples(setting: Setting) -> int:
    settings: Mapping[str, object] = setting.settings
    samples = settings.get("samples", 1)
    return samples if isinstance(samples, int) else 1


ROUNDS = 3
"""Times that each scene is measured, where time allows: a 99th percentile needs many measurements."""
TOGETHER = 3
"""Settings that are loaded at a time, beside the baseline: each holds a scene of its own in memory."""
PATIENCE = 4.0
"""A setting that loads this many times longer than its share of the time left of its block, or measures
longer than this many times that time, is ended, so that it does not use up what the others need."""
AFFORDABLE = 0.5
"""Share of the time left of its block that one scene of a setting may be expected to take."""
AT_LEAST_S = 20.0
"""[s] for loading and a scene, however little time is left: else a short comparison would measure nothing."""
WORTH_S = 5.0
"""[s] A scene that takes longer, and longer than there is time, is not measured again after the warm-up."""


class Skipped(msgspec.Struct, frozen=True, kw_only=True):
    """A setting that was not measured."""

    setting: str
    block: str
    reason: str


class Measured:
    """Measurements of one setting.

    Args:
        worker: Has the setting loaded.
    """

    def __init__(self, worker: Worker) -> None:
        self.setting, self.loaded = worker.setting, worker.loaded
        self.baseline_ms = 0.0
        """Median time [ms] of the baseline, measured by turns with this setting."""
        self.notes: list[str] = []
        """What a reader of the table should know."""
        self.samples: list[Sample] = []
        """All measurements; a scene that is measured again has no users there."""
        self.scenes: dict[int, Sample] = {}
        """The first measurement of each scene, by its frame."""

    def add_sample(self, frame: int, sample: Sample) -> None:
        """Add a measurement of a scene."""
        if frame in self.scenes:
            # The channels of a scene are the same at each measurement, and megabytes.
            sample = replace(sample, users={})
        self.samples.append(sample)
        self.scenes.setdefault(frame, sample)

    def absorb(self, other: Measured) -> None:
        """Add the measurements of the same setting from another wave."""
        self.samples += other.samples
        self.scenes = other.scenes | self.scenes

    @property
    def times_ms(self) -> list[float]:
        """Times of all measurements [ms]."""
        return [sample.time_ms for sample in self.samples]

    @property
    def median_ms(self) -> float:
        """Median of these times [ms]; 0 where there is none."""
        return float(np.median(self.times_ms)) if self.samples else 0.0

    @property
    def users(self) -> dict[Key, UserChannel]:
        """Channels of all users of all scenes."""
        return {key: user for sample in self.scenes.values() for key, user in sample.users.items()}


@dataclass(frozen=True, kw_only=True)
class Progress:
    """Progress of a campaign."""

    text: str
    done: float
    """Share of the whole."""
    left_s: float
    """[s] that it may still take."""


class _Entry:
    """A setting that is loaded."""

    def __init__(self, worker: Worker) -> None:
        self.worker, self.measured = worker, Measured(worker)
        # Measurements that it gets.
        self.count = 0

    @property
    def cost_s(self) -> float:
        return self.worker.loaded.first.time_ms / 1e3


class Campaign:
    """Measures blocks of settings over the same scenes, each setting by turns with the baseline.

    Args:
        scenes: What is measured on.
        baseline: What factors are against: the first of these that can be loaded.
        whole: Labels of settings that see every scene, whatever that takes: the reference.
        seconds: Time for everything [s].
        receivers: Receivers of a scene at most; None: all.
        report: Called with the progress before each step.

    Raises:
        RunError: No baseline can be measured.
    """

    def __init__(
        self,
        scenes: Scenes,
        *,
        baseline: Sequence[Setting],
        whole: Sequence[str],
        seconds: float,
        receivers: int | None,
        report: Callable[[Progress], None],
    ) -> None:
        self._scenes, self._receivers, self._report, self._whole = scenes, receivers, report, whole
        self._seconds, self._begun = seconds, time.monotonic()
        self._order = spread_order(len(scenes.instants))
        self.skipped: list[Skipped] = []
        self._baseline = self._first_loaded(baseline)

    @property
    def baseline(self) -> Setting:
        """Setting that factors are against."""
        return self._baseline.setting

    def close(self) -> None:
        """End the process of the baseline."""
        self._baseline.close()

    def block(self, name: Block, settings: Sequence[Setting], share: float) -> list[Measured]:
        """Measure settings within a share of the time that is left.

        Args:
            name: Name of the block.
            settings: Settings in the order of the table; the expensive ones come last.
            share: Share of the time that is left.

        Returns:
            What was measured, in the order of ``settings``; what was not is in `skipped`.

        Raises:
            RunError: The baseline, which needs measuring anew in each wave, fails.
        """
        begun = time.monotonic()
        until, costs, found = begun + share * self._left_s, list[Cost](), dict[Setting, Measured]()
        own = Measured(self._baseline)
        # Waves of a few: every setting that is loaded holds its scene, and kernels of Dr.Jit, in memory.
        waves = [settings[i : i + TOGETHER] for i in range(0, len(settings), TOGETHER)]
        for number, wave in enumerate(waves):
            now = time.monotonic()
            with ExitStack() as stack:
                behind = len(settings) - TOGETHER * number
                entries = self._loaded(name, wave, costs, (until, behind), stack)
                self._by_turns(name, entries, now + max(0.0, until - now) / (len(waves) - number))
            baseline, *others = entries
            if not baseline.measured.samples:
                raise RunError(f"{self.baseline.label} {'; '.join(baseline.measured.notes)}")
            own.absorb(baseline.measured)
            # Against the baseline of the same wave: the machine may be busier in the next one.
            for entry in others:
                entry.measured.baseline_ms = baseline.measured.median_ms
                if self._is_of_use(entry.measured, name):
                    found[entry.measured.setting] = entry.measured
        own.baseline_ms = own.median_ms
        found[self.baseline] = own
        return [found[setting] for setting in settings if setting in found]

    def keyframes(self, share: float) -> list[Row]:
        """Measure the baseline with channels interpolated between keyframes, in a share of the time left."""
        seconds = min(self._left_s, max(AT_LEAST_S, share * self._left_s))
        try:
            return keyframe_rows(self.baseline, self._scenes, self._receivers, seconds, self._tell)
        except (
            CaviarError
        ) as error:  # a part of the report that is missing, and said so, is no failure of all
            label = f"{self.baseline.label}, keyframes"
            self.skipped.append(Skipped(setting=label, block="keyframes", reason=str(error)))
            return []

    @property
    def _left_s(self) -> float:
        return max(0.0, self._begun + self._seconds - time.monotonic())

    def _first_loaded(self, settings: Sequence[Setting]) -> Worker:
        for setting in settings:
            self._tell(f"loading {setting.label}")
            try:
                return self._start(setting, max(AT_LEAST_S, self._left_s))
            except RunError as error:
                self._skip(setting, "ladder", str(error))
        reasons = dict.fromkeys(s.reason for s in self.skipped)
        raise RunError(
            f"no baseline can be measured, of {', '.join(s.label for s in settings)}: {'; '.join(reasons)}"
        )

    def _start(self, setting: Setting, seconds: float) -> Worker:
        return Worker(setting, self._scenes, self._receivers, seconds)

    def _loaded(
        self,
        name: Block,
        wave: Sequence[Setting],
        costs: list[Cost],
        time_for: tuple[float, int],
        stack: ExitStack,
    ) -> list[_Entry]:
        """The baseline, and of a wave what can be loaded in time: until then, for so many settings."""
        until, to_come = time_for
        # The baseline's process stays from wave to wave; its record starts anew, for this wave's factors.
        entries = [_Entry(self._baseline)]
        for number, setting in enumerate(wave):
            if setting == self.baseline:
                continue
            self._tell(f"{name}: loading {setting.label}")
            # Before it is loaded, which may take as long: a scene of it would not fit into the time anyway.
            expected, left = predicted_s(setting, costs), until - time.monotonic()
            out_of_time = left <= 0 or (expected or 0.0) > AFFORDABLE * left
            if out_of_time and setting.label not in self._whole:
                self._skip(setting, name, _no_time(expected, left))
                continue
            try:
                share = min(left, PATIENCE * left / (to_come - number))
                whole = setting.label in self._whole
                worker = self._start(setting, max(AT_LEAST_S, self._left_s if whole else share))
            except RunError as error:
                self._skip(setting, name, str(error))
                continue
            stack.enter_context(closing(worker))
            entries.append(_Entry(worker))
            costs.append(Cost(setting, entries[-1].cost_s))
        return entries

    def _by_turns(self, name: Block, entries: Sequence[_Entry], until: float) -> None:
        """Measure each as often as its share of the time allows; once at least."""
        # Loading has taken its part of the time: what is left is shared out.
        seconds = max(0.0, until - time.monotonic())
        most = [ROUNDS * self._scenes_of(entry.measured.setting) for entry in entries]
        for entry, count in zip(entries, shares([e.cost_s for e in entries], most, seconds), strict=True):
            whole = entry.measured.setting.label in self._whole
            entry.count = max(count, self._scenes_of(entry.measured.setting)) if whole else count
        for turn in range(max(entry.count for entry in entries)):
            for entry in entries:
                if entry.count > turn:
                    self._tell(f"{name}: {entry.measured.setting.label}")
                    self._turn(entry, turn, until)

    def _turn(self, entry: _Entry, turn: int, until: float) -> None:
        measured = entry.measured
        whole = measured.setting.label in self._whole and turn < len(self._order)
        # The first turn is always taken, so that each setting that was loaded has a line in the table.
        if turn and not whole and time.monotonic() > until:
            return
        if not turn and not whole and entry.cost_s > max(WORTH_S, until - time.monotonic()):
            # The warm-up's scene includes compilation, so its time is an upper bound; the note says so.
            measured.add_sample(self._scenes.instants[0].frame, entry.worker.loaded.first)
            measured.notes.append("timed on the scene that warmed it up: another would take too long")
            entry.count = 0
            return
        # After the last scene it begins again with the first: a second measurement of each, then a third.
        index = self._order[turn % self._scenes_of(measured.setting)]
        try:
            share = min(self._left_s, PATIENCE * (until - time.monotonic()))
            sample = entry.worker.step(index, max(AT_LEAST_S, self._left_s if whole else share))
        except RunError as error:
            entry.count = 0
            measured.notes.append(f"ended early: {error}")
            return
        measured.add_sample(self._scenes.instants[index].frame, sample)

    def _is_of_use(self, measured: Measured, name: Block) -> bool:
        """Tell whether a setting was measured at all; adds notes for the reader of the table."""
        if not measured.samples:
            self._skip(measured.setting, name, "; ".join(measured.notes))
            return False
        scenes, limit = len(measured.scenes), self._scenes_of(measured.setting)
        if scenes < len(self._scenes.instants):
            why = "" if scenes == limit else ", for want of time"
            measured.notes.append(f"{scenes} of {len(self._scenes.instants)} scenes{why}")
        if measured.setting.most_receivers is not None:
            measured.notes.append(f"{measured.samples[0].receivers} receivers")
        if lost := sum(sample.lost_paths for sample in measured.samples):
            measured.notes.append(f"paths lost in {lost} of {len(measured.samples)} measurements")
        return True

    def _scenes_of(self, setting: Setting) -> int:
        return min(len(self._scenes.instants), setting.most_scenes or len(self._scenes.instants))

    def _skip(self, setting: Setting, block: Block, reason: str) -> None:
        self.skipped.append(Skipped(setting=setting.label, block=block, reason=reason))

    def _tell(self, text: str) -> None:
        left = self._left_s
        self._report(Progress(text=text, done=1 - left / self._seconds, left_s=left))


def _no_time(expected_s: float | None, left_s: float) -> str:
    if expected_s is None or left_s <= 0:
        return "the time for its block was used up; give more with --minutes"
    return (
        f"one scene is expected to take {expected_s:.0f} s, of the {left_s:.0f} s left for its block; "
        "give more with --minutes"
    )


def candidates(
    label: str | None, order: Sequence[str], known: Sequence[Setting], option: str
) -> list[Setting]:
    """Look up the setting with a label, or without one those of a list.

    Args:
        label: Label that the user gives; None: none is given.
        order: Labels of the list, in order of preference.
        known: All settings.
        option: Option of the command line, for the error.

    Raises:
        RunError: No setting has the label; the error names near ones.
    """
    by_label = {setting.label: setting for setting in known}
    if label is None:
        return [by_label[name] for name in order]
    if label not in by_label:
        raise RunError(f"{option} {label!r} is no setting of the ladder; {suggestion(label, by_label)}")
    return [by_label[label]]
