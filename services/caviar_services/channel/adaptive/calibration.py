"""Calibration of stated errors: bounds on each pair's error on a rung, from frames that the reference
computes, too.

The error of a pair is the normalised mean square error of its matrices on all carriers against those of the
reference, Σ‖H − Hᵣ‖² / Σ‖Hᵣ‖², in dB. Two things tell pairs apart before it is known:

- the pair's error in the last check, since errors of successive frames are alike;
- a score of its channel. Where rays were launched that is the split launch: the error of what half of the
  rays would have found against what all of them did. Elsewhere it is the share of the power that arrives by
  paths of the most interactions that the rung looks for: where these bring much, those of one more do.

Stated is a quantile of the errors that were measured, each with a weight that falls with the distance of its
score and last error from those of the pair: localized conformal prediction (L. Guan, "Localized conformal
prediction: a generalized inference framework for conformal prediction", Biometrika 110, 2023). Errors of
scenes that change are not exchangeable, so the quantile's level is tracked: raised by each error beyond its
bound and lowered by each one within (I. Gibbs and E. Candès, "Adaptive conformal inference under distribution
shift", NeurIPS 2021), which makes the share of errors within their bounds go to 0.9 however errors change.

The level is tracked instead of an offset in dB, because errors in dB have two humps: a pair has all paths of
the reference, or it lacks one.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
from msgspec.structs import replace

from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import ScenarioError
from caviar_protocol.topics import Channel
from caviar_services.channel.adaptive.controller import Rung
from caviar_services.channel.base import Modelled

SHARE = 0.9
"""Share of errors that bounds shall hold for."""

FLOOR_DB, CEILING_DB = -60.0, 20.0
"""Errors and scores beyond are taken for these: below, matrices are equal for all that links do with them."""

STEP_DB = 0.5
"""What is remembered is rounded to, so that it fits into a byte."""

WINDOW = 200
"""Errors that are remembered."""

# Errors of one check that are remembered: those of one frame are alike.
_MOST_AT_ONCE = 50

# Errors that count as measured before the first check: twice as much power as there is, and four times.
_ASSUMED_DB = (3.0, 6.0)
# After it: the assumed errors are at most that much above the largest measured one.
_ASSUMED_ABOVE_DB = (1.0, 3.0)
# Measured errors up to which each of the assumed ones weighs as much as one of them; of n its weight is
# (10/n)³, so that bounds are wide in the first frames alone.
_ASSUMED_UNTIL = 10

# Distance of scores, or of last errors, at which a measured error weighs exp(−1/2).
_WIDTH_DB = 8.0
# Weight of an error that was measured of quite another channel.
_LEAST_WEIGHT = 0.02
# Squared distance, in widths, to a last error that is not known.
_UNKNOWN = 0.5

# Change of the level by an error beyond its bound, over `SHARE`.
_TRACKING = 0.04
# Errors of one check that count: more of one frame, which are alike, would throw the level to and fro.
_TRACKED_AT_ONCE = 10
_LEVELS = (0.0, 1.2)
# What a level of 2 would add to the largest error: levels above 1 are of errors larger than any measured.
_BEYOND_DB = 100.0

# Frames after which the last error says nothing any more.
_LAST_FRAMES = 30

_ROUNDING_DB = 1e-6
_NOT_KNOWN = 255
_LEVEL_STEPS = 10_000


def errors_db(channel: Channel, reference: Channel) -> Float64Array:
    """Errors of a channel's matrices.

    Args:
        channel: With matrices.
        reference: The channel of the same scene that counts as exact, with matrices.

    Returns:
        NMSE of each pair over all carriers [dB], Shape ``[T·R]``; NaN where the reference has no path.
    """
    error, power = np.zeros((2, len(channel.tx) * len(channel.rx)))
    for mine, true in zip(channel.h, reference.h, strict=True):
        pair = mine.tx * len(channel.rx) + mine.rx
        error[pair] += (np.abs(mine.h - true.h) ** 2).sum()
        power[pair] += (np.abs(true.h) ** 2).sum()
    known = power > 0
    return np.where(known, in_db(error / np.where(known, power, 1.0)), np.nan)


def scores_db(modelled: Modelled) -> Float64Array:
    """Scores of pairs that say how far their channels may be off [dB], Shape ``[T·R]``; see above."""
    if modelled.split_nmse is not None:
        return in_db(modelled.split_nmse.ravel())
    channel = modelled.channel
    last = (channel.interactions != 0).sum(1) == channel.options.max_depth
    power = (np.abs(channel.a) ** 2).sum(0)
    every = pair_powers(channel)
    return in_db(_of_pairs(channel, power * last) / np.where(every > 0, every, 1.0))


def pair_powers(channel: Channel) -> Float64Array:
    """Σ|a|² of each pair over all carriers, Shape ``[T·R]``."""
    return _of_pairs(channel, (np.abs(channel.a) ** 2).sum(0))


def _of_pairs(channel: Channel, values: Float64Array) -> Float64Array:
    """Sums of values over the paths of each pair, Shape ``[P]`` to ``[T·R]``."""
    # Each pair is summed by itself: as differences of one running sum, weak pairs would lose their digits.
    pair = np.repeat(np.arange(len(channel.offsets) - 1), np.diff(channel.offsets))
    return np.bincount(pair, weights=values, minlength=len(channel.offsets) - 1).astype(np.float64)


def in_db(ratio: Float64Array) -> Float64Array:
    """Levels of ratios of powers [dB], limited to the range from `FLOOR_DB` to `CEILING_DB`.

    Example:
        >>> in_db(np.array([0.0, 0.5])).round(2).tolist()
        [-60.0, -3.01]
    """
    least, most = 10 ** (FLOOR_DB / 10), 10 ** (CEILING_DB / 10)
    found: Float64Array = 10 * np.log10(np.clip(ratio, least, most))
    return found


class BoundState(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An `ErrorBound` between two frames."""

    learned: str
    last: dict[str, tuple[int, float]]
    measured: int


class ErrorBound:
    """Bounds on the errors of one rung.

    Args:
        declared_db: Error that the scenario expects [dB]; it takes the place of what is assumed before the
            first check.

    Example:
        >>> bound, scores = ErrorBound(), np.array([-20.0])
        >>> bound.bounds_db(0, ["bs > car"], scores).tolist()  # nothing is known yet
        [6.0]
        >>> for frame in range(0, 200, 10):
        ...     _ = bound.check(frame, ["bs > car"], scores, errors=np.array([-17.0]))
        >>> bound.bounds_db(200, ["bs > car"], scores).tolist()
        [-17.0]
    """

    def __init__(self, declared_db: float | None = None) -> None:
        self._assumed = np.array(_ASSUMED_DB if declared_db is None else (declared_db, declared_db))
        self.measured = 0
        """Checks so far."""
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self.measured = 0
        self._level = SHARE
        # Score, last error and error of what was measured, in steps, Shape ``[N, 3]``.
        self._known = np.zeros((0, 3), np.uint8)
        self.forget_pairs()

    def forget_pairs(self) -> None:
        """Forget the last errors of pairs: in another episode a name may be another vehicle's."""
        self._last: dict[str, tuple[int, float]] = {}

    @property
    def level(self) -> float:
        """Level of the quantile that is stated."""
        return self._level

    def bounds_db(self, frame: int, pairs: Sequence[str], scores: Float64Array) -> Float64Array:
        """Bounds that are stated for pairs.

        Args:
            frame: Number of the frame in its episode.
            pairs: Names of the pairs.
            scores: Scores of their channels [dB], Shape ``[len(pairs)]``.

        Returns:
            Bounds [dB], rounded up to 0.1 dB, Shape ``[len(pairs)]``.
        """
        values, last = self._known * STEP_DB + FLOOR_DB, self._last_errors(frame, pairs)
        count = len(values)
        distance = ((values[:, 0] - scores[:, None]) / _WIDTH_DB) ** 2
        known = (self._known[:, 1] != _NOT_KNOWN) & ~np.isnan(last)[:, None]
        apart = ((values[:, 1] - np.nan_to_num(last)[:, None]) / _WIDTH_DB) ** 2
        weight = np.exp(-(distance + np.where(known, apart, _UNKNOWN)) / 2) + _LEAST_WEIGHT
        if count:
            weight *= count / weight.sum(1, keepdims=True)
        assumed = self._assumed
        if count:
            assumed = np.minimum(_ASSUMED_DB, values[:, 2].max() + np.array(_ASSUMED_ABOVE_DB))
        of_assumed = (_ASSUMED_UNTIL / max(count, _ASSUMED_UNTIL)) ** 3
        weight = np.pad(weight, ((0, 0), (0, len(assumed))), constant_values=of_assumed)
        every = np.concatenate([values[:, 2], assumed])
        order = np.argsort(every, kind="stable")
        share = np.cumsum(weight[:, order], axis=1)
        below = share < (self._level - 1e-9) * share[:, -1:]
        bound = every[order][np.minimum(below.sum(1), len(every) - 1)]
        bound = bound + max(self._level - 1.0, 0.0) * _BEYOND_DB
        rounded: Float64Array = np.ceil(bound * 10 - 1e-6) / 10
        return rounded

    def check(self, frame: int, pairs: Sequence[str], scores: Float64Array, errors: Float64Array) -> int:
        """Learn the measured errors of pairs.

        Args:
            frame: As in `bounds_db`; likewise ``pairs`` and ``scores``.
            pairs: See ``frame``.
            scores: See ``frame``.
            errors: Of the pairs [dB], Shape ``[len(pairs)]``.

        Returns:
            How many errors were within their bounds.
        """
        held = errors <= self.bounds_db(frame, pairs, scores) + _ROUNDING_DB
        if self.measured and len(errors):
            missed = 1 - held.mean()
            level = self._level + _TRACKING * (missed - (1 - SHARE)) * min(len(errors), _TRACKED_AT_ONCE)
            self._level = round(min(max(level, _LEVELS[0]), _LEVELS[1]) * _LEVEL_STEPS) / _LEVEL_STEPS
        last = self._last_errors(frame, pairs)
        before = np.where(np.isnan(last), _NOT_KNOWN, _steps(last))
        found = np.stack([_steps(scores), before, _steps(errors, up=True)], axis=1).astype(np.uint8)
        every = -(-len(found) // _MOST_AT_ONCE)
        self._known = np.concatenate([self._known, found[:: max(every, 1)]])[-WINDOW:]
        self._last = {pair: (frame, error) for pair, error in zip(pairs, errors.tolist(), strict=True)}
        self.measured += 1
        return int(held.sum())

    def _last_errors(self, frame: int, pairs: Sequence[str]) -> Float64Array:
        """Error of each pair in the last check [dB]; NaN where it is too old or there is none."""
        never = (-math.inf, math.nan)
        found = [self._last.get(pair, never) for pair in pairs]
        return np.array([error if frame - at <= _LAST_FRAMES else math.nan for at, error in found])

    # --- what outlives a frame, an episode, a process ----------------------------------------------

    @property
    def learned(self) -> str:
        """Level and measured errors as a text; empty: none."""
        if not self.measured:
            return ""
        level = round(self._level * _LEVEL_STEPS).to_bytes(2, "big")
        return base64.b64encode(level + self._known.tobytes()).decode("ascii")

    def learn(self, text: str) -> None:
        """Continue from the text of `learned`.

        Raises:
            ValueError: It is no such text.
        """
        self.reset()
        if not text:
            return
        content = base64.b64decode(text, validate=True)
        if len(content) < 2 or (len(content) - 2) % 3 or len(content) > 2 + 3 * WINDOW:
            raise ValueError(f"{len(content)} bytes are no level and errors")
        self._level = int.from_bytes(content[:2], "big") / _LEVEL_STEPS
        self._known = np.frombuffer(content[2:], np.uint8).reshape(-1, 3).copy()
        self.measured = 1

    @property
    def state(self) -> BoundState:
        """All that is known."""
        return BoundState(learned=self.learned, last=dict(self._last), measured=self.measured)

    def restore(self, state: BoundState) -> None:
        """Continue from the state of another bound."""
        self.learn(state.learned)
        self._last, self.measured = dict(state.last), state.measured


def _steps(values: Float64Array, *, up: bool = False) -> Float64Array:
    """Values [dB] in steps above the floor."""
    steps = (np.clip(np.nan_to_num(values), FLOOR_DB, CEILING_DB) - FLOOR_DB) / STEP_DB
    return np.ceil(steps - 1e-6) if up else np.round(steps)


DECISION = "state:errors"
"""Key, among the decisions of an episode's first frame, of what is known of errors from episodes before: a
replay of the episode, or a process that takes over in it, has to state the same."""


class CalibrationState(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A `Calibration` between two frames."""

    bounds: tuple[BoundState, ...]
    episode: int | None
    begins: bool


class Calibration:
    """Bounds on the errors of all rungs.

    Args:
        rungs: The ladder, and after it a reference that is no rung.
        every: Frames from one check to the next; 0: there are none, and only errors that rungs declare are
            stated.
    """

    def __init__(self, rungs: Sequence[Rung], every: int) -> None:
        self._rungs, self._every = rungs, every
        self.reference = len(rungs) - 1
        """Number of the rung that errors are relative to."""
        self.bounds = [ErrorBound(rung.expected_error_db) for rung in rungs]
        self._episode: int | None = None
        self._begins = False

    def is_due(self, number: int) -> bool:
        """Test whether errors are measured in the frame of this number."""
        return bool(self._every) and number % self._every == 0 and len(self._rungs) > 1

    # --- from episode to episode ---------------------------------------------------------------------

    def reset(self, episode: int) -> None:
        """Begin an episode: what was learned outlives the one before, unless episodes are counted anew."""
        follows = self._episode is not None and episode == self._episode + 1
        for bound in self.bounds:
            if follows:
                bound.forget_pairs()
            else:
                bound.reset()
        self._episode, self._begins = episode, True

    def begin(self, imposed: Mapping[str, str]) -> dict[str, str]:
        """Decisions of a frame beside its rung: in the first one of an episode, what is known from those
        before.

        Args:
            imposed: Decisions that a replay imposes.

        Raises:
            ScenarioError: What is imposed cannot be read, or is about another ladder.
        """
        begins, self._begins = self._begins, False
        if DECISION in imposed:
            self._learn(imposed[DECISION])
        known = {
            rung.label: bound.learned
            for rung, bound in zip(self._rungs, self.bounds, strict=True)
            if bound.learned
        }
        return {DECISION: msgspec.json.encode(known).decode()} if begins and known else {}

    def _learn(self, text: str) -> None:
        try:
            known = msgspec.json.decode(text, type=dict[str, str])
            for rung, bound in zip(self._rungs, self.bounds, strict=True):
                bound.learn(known.pop(rung.label, ""))
        except ValueError as error:  # msgspec's errors are ValueErrors
            raise ScenarioError(f"the decision imposed, {DECISION!r}, cannot be read: {error}") from error
        if known:
            raise ScenarioError(
                f"the decision imposed, {DECISION!r}, is about {min(known)!r}, which is no rung"
            )

    # --- from frame to frame -------------------------------------------------------------------------

    def stated(self, rung: int, number: int, made: Modelled) -> Channel:
        """The product of a rung with bounds on its errors, before these are measured.

        Args:
            rung: Number of the rung.
            number: Of the frame.
            made: What the rung's model made.
        """
        channel, bound = made.channel, self.bounds[rung]
        if rung == self.reference or not (
            self._every or bound.measured or self._rungs[rung].expected_error_db is not None
        ):
            return channel
        bounds = bound.bounds_db(number, _pairs(channel), scores_db(made))
        reference = self._rungs[self.reference]
        return replace(
            channel,
            expected_error_db=_together(bounds, pair_powers(channel)),
            error_bound_db=bounds.reshape(len(channel.tx), len(channel.rx)),
            error_reference=f"{reference.model.rung} {reference.label}",
        )

    def partner(self, chosen: int) -> int:
        """Rung that computes a frame beside the chosen one to measure errors: the reference, or where that
        was chosen the one that was measured least often."""
        if chosen != self.reference:
            return self.reference
        return min(range(self.reference), key=lambda rung: self.bounds[rung].measured)

    def check(self, rung: int, number: int, made: Modelled, reference: Channel) -> dict[str, int]:
        """Measure the errors of a rung.

        Args:
            rung: Number of the rung.
            number: Of the frame.
            made: What the rung's model made, with matrices.
            reference: The reference's product of that frame, with matrices.

        Returns:
            Counts of pairs that were checked, and of those within their bounds.
        """
        errors = errors_db(made.channel, reference)
        known = np.isfinite(errors)
        every = zip(_pairs(made.channel), known.tolist(), strict=True)
        pairs = [pair for pair, is_known in every if is_known]
        held = self.bounds[rung].check(number, pairs, scores_db(made)[known], errors[known])
        return {"error-checks": len(pairs), "error-covered": held}

    # --- what outlives a frame -----------------------------------------------------------------------

    @property
    def state(self) -> CalibrationState:
        """All that is known."""
        bounds = tuple(bound.state for bound in self.bounds)
        return CalibrationState(bounds=bounds, episode=self._episode, begins=self._begins)

    def restore(self, state: CalibrationState) -> None:
        """Continue from the state of another calibration."""
        for bound, known in zip(self.bounds, state.bounds, strict=True):
            bound.restore(known)
        self._episode, self._begins = state.episode, state.begins


def _pairs(channel: Channel) -> list[str]:
    """Names of the pairs, transmitters slowest."""
    return [f"{tx} > {rx}" for tx in channel.tx for rx in channel.rx]


def _together(bounds_db: Float64Array, powers: Float64Array) -> float | None:
    """Bound [dB] on the NMSE of all matrices together, Σ‖H − Hᵣ‖² / Σ‖H‖², if each pair is within its own;
    None where no pair has a path."""
    if not powers.sum():
        return None
    ratio = float((powers * 10 ** (bounds_db / 10)).sum() / powers.sum())
    return math.ceil(100 * math.log10(ratio) - 1e-6) / 10
