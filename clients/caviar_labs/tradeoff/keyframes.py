"""A setting that is traced at every few frames alone, with channels interpolated in between.

Over consecutive frames: each is traced, and the channels that interpolation makes of every second, fifth,
tenth of these are compared with the traced ones.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from statistics import fmean

import numpy as np

from caviar_clients.session.scenes import Instant, Scenes
from caviar_labs.interpolation import Between, Interpolation, Keyframe
from caviar_labs.tradeoff.errors import (
    FLOOR_DB,
    Key,
    Noise,
    Row,
    UserChannel,
    decibel,
    differences,
    error_fields,
    mean_or_none,
    nmse,
    user_channels,
)
from caviar_labs.tradeoff.ladder import Setting
from caviar_labs.tradeoff.worker import Sample, Worker, seen
from caviar_protocol.errors import RunError
from caviar_protocol.topics import Channel
from caviar_protocol.topics.channel import PLANE_WAVES

# With 21 consecutive frames the widest has two intervals, so that one odd one does not decide.
SPACINGS = (2, 5, 10)
"""Frames from one keyframe to the next."""


@dataclass(frozen=True, eq=False)
class Traced:
    """A frame, and what tracing it gave."""

    instant: Instant
    sample: Sample
    channel: Channel

    def keyframe(self) -> Keyframe:
        """Make the frame an end of an interval."""
        return Keyframe(self.instant.t_ns / 1e9, self.channel, self.instant.scene)


@dataclass(eq=False)
class _Found:
    """Findings of a spacing. Each interval counts its later keyframe and all frames between."""

    # Of each frame: the time of its interval, shared out.
    times_ms: list[float] = field(default_factory=list)
    users: dict[Key, UserChannel] = field(default_factory=dict)
    paths: list[int] = field(default_factory=list)
    # Whether a channel's bound is finite, and of those channels, whether the error keeps within it.
    promised: list[bool] = field(default_factory=list)
    within: list[bool] = field(default_factory=list)


def keyframe_rows(
    setting: Setting,
    scenes: Scenes,
    receivers: int | None,
    seconds: float,
    tell: Callable[[str], None],
) -> list[Row]:
    """Make a row for tracing each of the consecutive frames, then one for each of `SPACINGS`.

    Args:
        setting: Setting that keyframes are traced with; its rung has plane waves.
        scenes: Its consecutive scenes are measured on.
        receivers: Receivers of a scene at most; None: all.
        seconds: Time for everything [s].
        tell: Called with a text about the progress.

    Raises:
        RunError: That cannot be measured, or not in time; the error says why.
    """
    instants = scenes.consecutive
    spacings = [spacing for spacing in SPACINGS if spacing < len(instants)]
    if not spacings:
        raise RunError(f"there are no {SPACINGS[0] + 1} consecutive frames with a transmitter and a receiver")
    until = time.monotonic() + seconds
    tell(f"keyframes: loading {setting.label}")
    block, noise = scenes.with_instants(instants), Noise.of(scenes)
    with closing(Worker(setting, block, receivers, seconds, products=True)) as worker:
        traced = []
        for index, instant in enumerate(instants):
            tell(f"keyframes: {setting.label}")
            sample = worker.step(index, max(1.0, until - time.monotonic()))
            if sample.channel is None or sample.rung not in PLANE_WAVES:
                raise RunError(f"H of {sample.rung} does not follow from paths; choose another --baseline")
            kept = Instant(instant.frame, instant.t_ns, seen(instant.scene, receivers, None))
            traced.append(Traced(kept, sample, sample.channel))
        loaded = worker.loaded
    truth = {key: user for entry in traced for key, user in entry.sample.users.items()}
    # Times without the first frame, which belongs to no interval: all rows are over the same frames.
    every = _Found(
        times_ms=[entry.sample.time_ms for entry in traced[1:]],
        users=dict(truth),
        paths=[entry.sample.paths for entry in traced],
    )
    base = float(np.median(every.times_ms))
    first, last = instants[0].frame, instants[-1].frame
    note = f"frames {first} to {last}, consecutive; errors against a trace of each of them"
    rows = [_row(setting.label, 1, every, truth, base, traced[0].sample, loaded.seconds, note)]
    for spacing in spacings:
        tell(f"keyframes: every {spacing}")
        found = spaced(traced, spacing, noise)
        label = f"{setting.label}, keyframes every {spacing}"
        rows.append(_row(label, spacing, found, truth, base, traced[0].sample, loaded.seconds, note))
    return rows


def spaced(traced: Sequence[Traced], spacing: int, noise: Noise) -> _Found:
    """Interpolate between every few of the frames, and compare with the frames in between.

    Args:
        traced: Consecutive frames.
        spacing: Frames from one keyframe to the next.
        noise: Noise of the receivers, for the capacity.
    """
    found = _Found()
    for first in range(0, len(traced) - spacing, spacing):
        last = first + spacing
        begin = time.perf_counter()
        between = Interpolation(traced[first].keyframe(), traced[last].keyframe())
        made = []
        for entry in traced[first + 1 : last]:
            got = between.at(entry.instant.t_ns / 1e9, entry.instant.scene, with_h=True)
            made.append((entry, got))
        # As in a run: the later keyframe has to be traced before any frame of its interval.
        took_ms = (time.perf_counter() - begin) * 1e3 + traced[last].sample.time_ms
        found.times_ms += [took_ms / spacing] * spacing
        for entry, got in made:
            found.users.update(user_channels(entry.instant.frame, entry.instant.scene, got.channel, noise))
            found.paths.append(len(got.channel.tau))
            _note_bounds(found, entry.channel, got)
        found.users.update(traced[last].sample.users)
        found.paths.append(traced[last].sample.paths)
    return found


def _note_bounds(found: _Found, truth: Channel, got: Between) -> None:
    made = {(m.carrier, got.channel.tx[m.tx], got.channel.rx[m.rx]): m for m in got.channel.h}
    for matrix in truth.h:
        mine = made.get((matrix.carrier, truth.tx[matrix.tx], truth.rx[matrix.rx]))
        # Where the truth has no path its norm is 0, and no relative bound means anything.
        if mine is None or not matrix.h.any():
            continue
        bound = float(got.bound_db[mine.carrier, mine.tx, mine.rx])
        # Not finite: the pair has other paths at both keyframes, and nothing is promised of those between.
        found.promised.append(bound < np.inf)
        if found.promised[-1]:
            found.within.append(decibel(nmse(mine.h, matrix.h)) <= max(bound, FLOOR_DB))


def _row(
    label: str,
    spacing: int,
    found: _Found,
    truth: Mapping[Key, UserChannel],
    base_ms: float,
    first: Sample,
    prepare_s: float,
    note: str,
) -> Row:
    median = float(np.median(found.times_ms))
    return Row(
        setting=label,
        block="keyframes",
        column="keyframes",
        row=str(spacing),
        rung=first.rung,
        time_ms_median=median,
        time_ms_p99=float(np.percentile(found.times_ms, 99)),
        factor=median / base_ms,
        memory_mib=None,
        loaded_mib=None,
        prepare_s=prepare_s,
        measurements=len(found.times_ms),
        scenes=len(found.paths),
        receivers=float(first.receivers),
        paths=fmean(found.paths),
        with_bound=mean_or_none(found.promised),
        within_bound=mean_or_none(found.within),
        note=note,
        **error_fields(differences(found.users, truth)),  # type: ignore[arg-type]  # fields of a row, by name
    )
