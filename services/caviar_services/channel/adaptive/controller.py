"""Ladder of an adaptive channel: its settings and rungs, their cost model, and the controller that picks the
next frame's rung: down at once, up with patience.

Cost of a rung, learned while running from measured durations:

    log duration = log timing + load + bias
                   + α · log(pairs / pairs₀) + β · log((10 + objects) / (10 + objects₀)) + scatter

``timing`` is what a rung took before the first frame with pairs₀ and objects₀; its ``bias``, α and β are
learned. ``load`` is common to all rungs, since what slows one of them slows its neighbours: so a rung that
does not run is still judged by how busy the machine is now. Recursive least squares (a Kalman filter: Kalman,
"A New Approach to Linear Filtering and Prediction Problems", 1960) tells these apart: load wanders from frame
to frame, and what changes with the rung is the rung's. What a rung has learned goes back towards its
prior in time, so that one that was slow once is tried again.

Stated is a quantile: the expected duration times that quantile of the recent ratios measured / expected,
raised as long as more frames than that take longer (the quantile tracking of Angelopoulos, Candès and
Tibshirani, "Conformal PID Control for Time Series Prediction", 2023): slow frames come in bursts.
"""

from __future__ import annotations

import math
import re
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Annotated, Any

import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array, quantity
from caviar_protocol.errors import DeclarationError, ScenarioError, suggestion
from caviar_protocol.scenario.conversion import Place, convert_settings
from caviar_services.channel.base import ChannelModel
from caviar_services.checkpoint import Packed
from caviar_services.registry import load
from caviar_services.service import RunInfo


class LadderRung(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One rung: a channel model with its settings."""

    label: str
    """Its name in decisions and products."""
    use: str = "sionna-rt"
    """Any registered channel model."""
    settings: dict[str, Any] = msgspec.field(default_factory=dict)
    """Its own, beside and before those in ``common``."""
    expected_error_db: (
        Annotated[float, quantity("dB", "NMSE of a pair's H against the reference, until it is measured")]
        | None
    ) = None


class AdaptiveSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A ladder, and when to stand on which of its rungs."""

    ladder: tuple[LadderRung, ...] = ()
    """From the fastest to the most accurate."""
    common: dict[str, Any] = msgspec.field(default_factory=dict)
    """Settings of every rung whose model has them."""
    fixed: str = ""
    """Label of the rung that every frame is computed on; empty: what fits the budget. A run whose rung
    follows from durations cannot be repeated, unless its decisions are imposed."""
    budget_ms: (
        Annotated[float, quantity("ms", "for a frame, in place of the service's own budget", gt=0)] | None
    ) = None
    quantile: Annotated[float, quantity("1", "of a frame's duration that must fit", gt=0, lt=1)] = 0.95
    share: Annotated[float, quantity("1", "of the budget that it may take", gt=0, le=1)] = 0.8
    margin: Annotated[float, quantity("1", "of that which is spare before going up", ge=0, lt=1)] = 0.1
    patience: Annotated[int, quantity("frame", "that must have it in a row", ge=1)] = 10
    calibrate_every: Annotated[
        int, quantity("frame", "from one that the reference computes too to the next; 0: none", ge=0)
    ] = 0
    reference: LadderRung | None = None
    """The channel that counts as exact where errors are measured: more accurate than any rung, and too slow
    to be one. Absent: the highest rung."""

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the rungs, lowest first."""
        return tuple(rung.label for rung in self.ladder)


@dataclass(frozen=True, kw_only=True)
class Rung:
    """A rung that is built."""

    label: str
    model: ChannelModel[Any]
    expected_error_db: float | None


@contextmanager
def naming(label: str) -> Iterator[None]:
    """Errors raised within say of which rung they are; a key that they begin with stays in front.

    Args:
        label: Of the rung.
    """
    try:
        yield
    except Exception as error:
        error.args = (f"{error} (rung {label!r})", *error.args[1:])
        raise


def built(settings: AdaptiveSettings, run: RunInfo) -> tuple[Rung, ...]:
    """The ladder of a scenario, and after it the reference where that is no rung. Raises `ScenarioError`
    naming the key for whatever cannot be."""
    place = run.settings_place
    every = zip(_every(settings, place), models(settings, place), strict=True)
    return tuple(
        Rung(
            label=rung.label,
            model=cls(own, replace(run, settings_key=at.at("settings").key)),
            expected_error_db=rung.expected_error_db,
        )
        for (rung, at), (cls, own) in every
    )


def _every(settings: AdaptiveSettings, place: Place) -> list[tuple[LadderRung, Place]]:
    """The rungs, and the reference where it is none, with their places in the scenario."""
    found = [(rung, place.at("ladder").at(index)) for index, rung in enumerate(settings.ladder)]
    return found if settings.reference is None else [*found, (settings.reference, place.at("reference"))]


def models(settings: AdaptiveSettings, place: Place) -> list[tuple[type[ChannelModel[Any]], Any]]:
    """The channel model of each rung, and of a reference that is none, with its settings. Errors as those of
    `built`.

    ``place`` is where ``settings`` stand.
    """
    _check(settings, place)
    every = _every(settings, place)
    found = [_model(rung.use, where) for rung, where in every]
    known = [frozenset(cls.Settings.__struct_fields__) for cls in found]
    for name in settings.common:
        if not any(name in fields for fields in known):
            everything = frozenset[str]().union(*known)
            raise (
                place.at("common")
                .at(name)
                .error(f"no rung has a setting {name!r}; {suggestion(name, everything)}")
            )
    made: list[tuple[type[ChannelModel[Any]], Any]] = []
    for (rung, at), cls, fields in zip(every, found, known, strict=True):
        shared = {n: v for n, v in settings.common.items() if n in fields and n not in rung.settings}
        where = at.at("settings")
        try:
            own = convert_settings(cls.Settings, {**shared, **rung.settings}, where)
            cls.check_settings(own, where)
        except ScenarioError as error:
            raise _where_it_stands(error, shared, where, place.at("common")) from error
        made.append((cls, own))
    return made


def _where_it_stands(
    error: ScenarioError, shared: Mapping[str, Any], where: Place, common: Place
) -> ScenarioError:
    """An error about a rung's settings, which names ``common`` where the value stands there."""
    rest = error.key.removeprefix(where.key)
    if any(re.match(rf"\.{re.escape(name)}(?![A-Za-z0-9_-])", rest) for name in shared):
        return Place(common.key + rest, common.source).error(error.message)
    return error


def _model(use: str, place: Place) -> type[ChannelModel[Any]]:
    """The channel model that a rung names."""
    try:
        cls = load("channel", use)
    except DeclarationError as error:
        raise place.at("use").error(str(error)) from error
    if not issubclass(cls, ChannelModel):
        raise place.at("use").error(f"is {use!r}, which is no ChannelModel and cannot be a rung")
    return cls


def rung_of(labels: tuple[str, ...], label: str, what: str) -> int:
    """Index of a label. Raises `ScenarioError` naming ``what`` asked for it, and the labels."""
    if label not in labels:
        raise ScenarioError(f"{what} is {label!r}, which is no rung; {suggestion(label, labels)}")
    return labels.index(label)


def _check(settings: AdaptiveSettings, place: Place) -> None:
    ladder = place.at("ladder")
    if not settings.ladder:
        raise ladder.error(f"has no rung; write [[{ladder.key}]] with label, use and settings for each")
    for label, count in Counter(rung.label for rung, _ in _every(settings, place)).items():
        if count > 1:
            raise ladder.error(f"has {count} rungs with the label {label!r}; give each its own")
    if settings.fixed and settings.fixed not in settings.labels:
        hint = suggestion(settings.fixed, settings.labels)
        raise place.at("fixed").error(f"is {settings.fixed!r}, which is no rung; {hint}")


HALF_LIFE = 32
"""Frames after which a ratio counts half. One slow frame is then 2 to 4 % of all, and leaves a p95 alone."""

TRACKING = 0.1
"""How much the stated quantile is raised by a frame that exceeds it, in the logarithm."""

REVERSION = 128
"""Frames after which half of what is not seen again of a rung is gone."""

OBJECTS = 10.0
"""Moving objects whose cost is compared with that of a scene without."""

# Frames that are remembered; older ones would weigh less than two percent together.
_WINDOW = 6 * HALF_LIFE

# Frames that are assumed before the first one, so that the first ratios alone decide little.
_ASSUMED = 32
# Standard deviation of their ratios in the logarithm, as seen on a machine with other things to do.
_ASSUMED_SCATTER = 0.15

# Mean and standard deviation of bias, α and β before the first frame: half of a frame grows with its pairs, a
# little with its objects.
_PRIOR = np.array([0.0, 0.5, 0.1])
_PRIOR_DEVIATION = np.array([0.2, 0.3, 0.2])

# Standard deviation of load before the first frame: the timings are of another scene.
_LOAD_DEVIATION = 0.3
# Standard deviation of the change of load from one frame to the next.
_LOAD_STEP = 0.06
# Standard deviation of a frame's duration in the logarithm that the filter assumes; it sets how fast it
# learns.
_SCATTER = 0.1
# A frame that is further off than that counts as only so far: one outlier would throw the filter off. A
# second one in a row on the same side is a change, and is learned at once.
_SURPRISE = 0.5


@dataclass(frozen=True, kw_only=True)
class Workload:
    """Numbers that the cost of a frame depends on."""

    pairs: int
    """Transmitters times receivers."""
    objects: int
    """Moving objects in the scene."""


class CostState(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A `CostModel` between two frames."""

    timing: Packed
    pairs: int
    objects: int
    mean: Packed
    covariance: Packed
    side: int
    changed: int
    rung: int | None
    raised: float
    rows: Packed
    measured: tuple[float, ...]
    expected: tuple[float, ...]


class CostModel:
    """Predicts the duration of the next frame on every rung, as a quantile.

    Args:
        timings_ns: Durations of each rung before the first frame [ns], a few of each.
        work: Pairs and objects in those frames.
        quantile: That predictions state, in (0, 1).

    Example:
        >>> work = Workload(pairs=10, objects=0)
        >>> model = CostModel([[1_000_000] * 5, [8_000_000] * 5], work, quantile=0.95)
        >>> [round(ns / 1e6) for ns in model.expect(work)]
        [1, 8]
    """

    def __init__(self, timings_ns: Sequence[Sequence[int]], work: Workload, quantile: float) -> None:
        self._timing = np.log([max(float(np.median(timings)), 1.0) for timings in timings_ns])
        self._timed, self._quantile, count = work, quantile, len(timings_ns)
        self._prior = np.concatenate([[0.0], np.tile(_PRIOR, count)])
        self._mean = self._prior.copy()
        deviation = np.tile(_PRIOR_DEVIATION, count)
        self._covariance = np.diag(np.concatenate([[_LOAD_DEVIATION], deviation]) ** 2)
        kept = 0.5 ** (1 / REVERSION)
        self._kept = np.concatenate([[1.0], np.full(3 * count, kept)])
        # With this drift, the variance of a rung that is not seen any more goes back to that of the prior.
        self._drift = np.diag(np.concatenate([[_LOAD_STEP], deviation * math.sqrt(1 - kept**2)]) ** 2)
        # Outlier of the last frame: 1 slower, −1 faster, 0 none.
        self._side = 0
        # State that has changed if the next frame is such an outlier, too: the load, or the bias of a new
        # rung.
        self._changed = 0
        self._rung: int | None = None
        # Logarithm of the factor by which tracking raises the stated quantile.
        self._raised = 0.0
        self._rows: deque[Float64Array] = deque(maxlen=_WINDOW)
        self._measured: deque[float] = deque(maxlen=_WINDOW)
        self._expected: deque[float] = deque(maxlen=_WINDOW)
        self._assume(timings_ns)

    def _assume(self, timings_ns: Sequence[Sequence[int]]) -> None:
        """Begin with frames like the timings, with the scatter that frames are assumed to have."""
        rows = [self._row(rung, self._timed) for rung in range(len(timings_ns))]
        timed = [
            (rung, math.log(max(duration, 1)) - float(self._timing[rung]))
            for rung, timings in enumerate(timings_ns)
            for duration in timings
        ]
        scatter = NormalDist(0.0, _ASSUMED_SCATTER)
        for index in range(_ASSUMED):
            rung, measured = timed[index % len(timed)]
            # 7 and the count have no common factor, so every share comes once, and high and low by turns.
            share = (index * 7 % _ASSUMED + 0.5) / _ASSUMED
            self._rows.append(rows[rung])
            self._measured.append(measured + scatter.inv_cdf(share))
            self._expected.append(0.0)

    @property
    def state(self) -> CostState:
        """All that was learned, and the timings that it is relative to."""
        return CostState(
            timing=Packed.of(self._timing, "<f8"),
            pairs=self._timed.pairs,
            objects=self._timed.objects,
            mean=Packed.of(self._mean, "<f8"),
            covariance=Packed.of(self._covariance, "<f8"),
            side=self._side,
            changed=self._changed,
            rung=self._rung,
            raised=self._raised,
            rows=Packed.of(np.array(self._rows), "<f8"),
            measured=tuple(self._measured),
            expected=tuple(self._expected),
        )

    def restore(self, state: CostState) -> None:
        """Continue from the state of another model of the same ladder.

        Its timings come with what it learned, which is relative to them. A difference between both machines
        is learned as a change of load.
        """
        self._timing = state.timing.array(np.float64)
        self._timed = Workload(pairs=state.pairs, objects=state.objects)
        self._mean, self._covariance = state.mean.array(np.float64), state.covariance.array(np.float64)
        self._side, self._changed, self._rung = state.side, state.changed, state.rung
        self._raised = state.raised
        self._rows = deque(state.rows.array(np.float64), maxlen=_WINDOW)
        self._measured = deque(state.measured, maxlen=_WINDOW)
        self._expected = deque(state.expected, maxlen=_WINDOW)

    @property
    def load(self) -> float:
        """Factor by which all rungs take longer now than before the first frame."""
        return math.exp(self._mean[0])

    def expect(self, work: Workload) -> list[float]:
        """The expected duration of a frame on each rung [ns]."""
        rows = [self._row(rung, work) for rung in range(len(self._timing))]
        return [
            math.exp(timing + float(row @ self._mean)) for timing, row in zip(self._timing, rows, strict=True)
        ]

    def predict(self, work: Workload) -> list[float]:
        """The stated quantile of the duration of a frame on each rung [ns]."""
        factor = math.exp(self._log_factor())
        return [factor * expected for expected in self.expect(work)]

    def _log_factor(self) -> float:
        """Logarithm of the ratio of the stated quantile to what is expected."""
        measured = np.array(self._measured)
        # Against what was expected then, a rise is remembered for long after it was understood; against
        # what would be expected now, a fall. The smaller one has understood both.
        then = _weighted_quantile(measured - np.array(self._expected), self._quantile)
        now = _weighted_quantile(measured - np.array(self._rows) @ self._mean, self._quantile)
        return min(then, now) + self._raised

    def observe(self, rung: int, work: Workload, duration_ns: int) -> None:
        """Learn from a frame.

        Args:
            rung: That computed it, by its place on the ladder.
            work: Pairs and objects in it.
            duration_ns: That it took [ns].
        """
        self._mean = self._prior + self._kept * (self._mean - self._prior)
        covariance = self._kept[:, None] * self._covariance * self._kept + self._drift
        row, measured = self._row(rung, work), math.log(max(duration_ns, 1)) - float(self._timing[rung])
        expected = float(row @ self._mean)
        surprise = measured - expected
        missed = surprise > self._log_factor()
        self._raised = max(0.0, self._raised + TRACKING * (missed - (1 - self._quantile)))
        side = 0 if abs(surprise) < _SURPRISE else 1 if surprise > 0 else -1
        if side and side == self._side:
            covariance[self._changed, self._changed] += surprise**2
        else:
            surprise = min(max(surprise, -_SURPRISE), _SURPRISE)
            self._changed = 0 if self._rung in (None, rung) else 1 + 3 * rung
        self._side, self._rung = side, rung
        gain = covariance @ row
        gain /= _SCATTER**2 + float(row @ gain)
        self._mean = self._mean + gain * surprise
        covariance = covariance - np.outer(gain, row @ covariance)
        self._covariance = (covariance + covariance.T) / 2
        self._rows.append(row)
        self._measured.append(measured)
        self._expected.append(expected)

    def _row(self, rung: int, work: Workload) -> Float64Array:
        """Factors of load, and of bias, α and β of every rung, whose sum is the logarithm of a duration."""
        row = np.zeros(len(self._prior))
        row[0] = 1.0
        row[1 + 3 * rung : 4 + 3 * rung] = (
            1.0,
            math.log((1 + work.pairs) / (1 + self._timed.pairs)),
            math.log((OBJECTS + work.objects) / (OBJECTS + self._timed.objects)),
        )
        return row


def _weighted_quantile(values: Float64Array, quantile: float) -> float:
    """Quantile of values with weights that halve every `HALF_LIFE` values, the last one counting most."""
    order = np.argsort(values, kind="stable")
    share = np.cumsum(0.5 ** (np.arange(len(values))[::-1] / HALF_LIFE)[order])
    index = int(np.searchsorted(share, quantile * share[-1]))
    return float(values[order[min(index, len(values) - 1)]])


@dataclass(frozen=True, kw_only=True)
class Choice:
    """A rung by its place on the ladder, 0 the lowest."""

    rung: int
    fits: bool
    """Whether the frame is expected to be done in time."""


class ControllerState(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A `Controller` between two frames."""

    current: int | None
    streaks: tuple[int, ...]


class Controller:
    """Picks the most accurate rung whose predicted duration fits, with hysteresis.

    A predicted miss leads down in the same frame. Up leads only a rung that would have fitted, with
    ``margin`` to spare, in each of the last ``patience`` frames. So noise about a border does not make
    products change their quality from frame to frame.

    Args:
        share: Of the budget that a prediction may take: the rest is for decoding, encoding, and surprises.
        margin: Share of that which must be spare before going up.
        patience: Frames in a row that must have it.

    Example:
        >>> controller = Controller(share=0.8, margin=0.1, patience=2)
        >>> [controller.choose([1e6, slow], budget_ns=10_000_000).rung for slow in (5e6, 9e6, 5e6, 5e6)]
        [1, 0, 0, 1]
    """

    def __init__(self, share: float, margin: float, patience: int) -> None:
        self._share, self._margin, self._patience = share, margin, patience
        self._current: int | None = None
        self._streaks: list[int] = []

    def reset(self) -> None:
        """Forget everything: the next frame is the first."""
        self._current, self._streaks = None, []

    @property
    def state(self) -> ControllerState:
        """The rung, and for how many frames each rung would have fitted."""
        return ControllerState(current=self._current, streaks=tuple(self._streaks))

    def restore(self, state: ControllerState) -> None:
        """Continue from the state of another controller."""
        self._current, self._streaks = state.current, list(state.streaks)

    def choose(self, predicted_ns: Sequence[float], budget_ns: int) -> Choice:
        """The rung for a frame.

        Args:
            predicted_ns: Duration predicted for each rung [ns], lowest rung first.
            budget_ns: Time that the frame has [ns]; 0: no limit.
        """
        limit = budget_ns * self._share if budget_ns else float("inf")
        fits = [predicted <= limit for predicted in predicted_ns]
        spare = [predicted <= limit * (1 - self._margin) for predicted in predicted_ns]
        # In the first frame nothing is known: a rung that fits is taken without patience.
        streaks = self._streaks or [self._patience] * len(fits)
        self._streaks = [streak + 1 if ok else 0 for streak, ok in zip(streaks, spare, strict=True)]
        if self._current is None:
            return self._take(self._highest(fits), fits)
        current = self._current
        if not fits[current]:
            return self._take(self._highest(fits[:current]), fits)
        return self._take(max(current, self._highest([s >= self._patience for s in self._streaks])), fits)

    def impose(self, rung: int) -> None:
        """Take note that a frame was computed on this rung by a decision from outside."""
        if rung != self._current:
            self._streaks = [0] * len(self._streaks)
        self._current = rung

    def _take(self, rung: int, fits: Sequence[bool]) -> Choice:
        if rung != self._current:
            self._streaks = [0] * len(fits)
        self._current = rung
        return Choice(rung=rung, fits=fits[rung])

    @staticmethod
    def _highest(possible: Sequence[bool]) -> int:
        """The last that is possible; the lowest rung where none is."""
        return max((rung for rung, ok in enumerate(possible) if ok), default=0)
