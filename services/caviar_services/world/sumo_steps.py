"""Steps of SUMO that fit the sampling period of a run and the spacing of its episodes."""

from __future__ import annotations

import math

from caviar_protocol.errors import ScenarioError

_NS_PER_MS = 1_000_000
# SUMO's car-following models are made for steps up to one second.
_LONGEST_STEP_MS = 1000


def step_length_ms(sampling_period_ns: int, step_ms: int | None) -> int:
    """Choose SUMO's step for a sampling period. SUMO steps whole milliseconds.

    Args:
        sampling_period_ns: Sampling period of the run [ns].
        step_ms: The step that is asked for [ms]; None: the sampling period.

    Returns:
        [ms]

    Raises:
        ScenarioError: The sampling period is no whole number of steps; says what to write.

    Example:
        >>> step_length_ms(100_000_000, None), step_length_ms(100_000_000, 20)
        (100, 20)
    """
    period_ms, rest = divmod(sampling_period_ns, _NS_PER_MS)
    if rest:
        near = " or ".join(str(ms * _NS_PER_MS) for ms in (period_ms, period_ms + 1) if ms)
        raise ScenarioError(
            f"SUMO steps whole milliseconds, and {sampling_period_ns} ns is none; write {near}",
            key="run.sampling_period_ns",
        )
    step = period_ms if step_ms is None else step_ms
    if (step_ms is None and period_ms > _LONGEST_STEP_MS) or not 1 <= step <= period_ms or period_ms % step:
        fitting = max(
            n for n in range(1, min(period_ms, max(step, 1), _LONGEST_STEP_MS) + 1) if period_ms % n == 0
        )
        raise ScenarioError(
            f"a step of {step} ms does not fit the sampling period of {period_ms} ms; "
            f"write step_ms = {fitting}",
            key="settings.step_ms",
        )
    return step


def check_spacing(between_episodes_s: float, step_ms: int) -> None:
    """Check that episodes can begin so far apart in one traffic.

    Args:
        between_episodes_s: From the beginning of an episode to that of the next [s].
        step_ms: SUMO's step [ms].

    Raises:
        ScenarioError: It is not a whole number of steps, or none at all.

    Example:
        >>> check_spacing(30.0, 100)
    """
    ms = between_episodes_s * 1000.0
    if not 0 < ms < math.inf or abs(ms / step_ms - round(ms / step_ms)) > 1e-6:
        raise ScenarioError(
            f"{between_episodes_s} s is not a whole number of SUMO's steps of {step_ms} ms, at least one",
            key="settings.between_episodes_s",
        )
