"""|y| of the best pair, the agent and the baseline, in the form of Fig. 8 of the paper.

Two pictures: over time, with the angle of arrival below (the paper's figure), and over the
angle of arrival itself.
"""

from __future__ import annotations

import difflib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from caviar_clients.plots.style import AGENT, BASELINE, GREY, LIGHT_GREY, OPTIMUM, figure, legend_below
from caviar_protocol.arrays import BoolArray, Float64Array
from caviar_protocol.errors import RecordingError
from caviar_protocol.messages import Status
from caviar_protocol.recording import Recording
from caviar_protocol.topics import Link

_NO_PATH = "#f2c9b8"


@dataclass(frozen=True, eq=False)
class UserSeries:
    """One user through a run, Shape ``[F]`` each; NaN and false in frames without the user."""

    tx: str
    rx: str
    carrier: str
    time: Float64Array
    """[s], simulated; an episode begins where the one before ended."""
    present: BoolArray
    has_path: BoolArray
    los: BoolArray
    abs_y: Float64Array
    best: Float64Array
    baseline: Float64Array
    theta: Float64Array
    """Azimuth of the transmitter seen from the receiver, in the receiver's axes [rad]."""


def link_source(recording: Recording) -> str:
    """The source of topic ``link`` that pictures show: the first by name."""
    sources = recording.topics.get("link", ())
    if not sources:
        raise RecordingError(f"{recording.path} has no link, so there is no |y| to draw")
    return sources[0]


def has_users(recording: Recording) -> bool:
    """Whether any frame of a link has a user."""
    return any(link.rx for link in _links(recording))


def choose_user(recording: Recording, user: str = "") -> tuple[str, str, str]:
    """(tx, rx, carrier) of the user that was there longest, or of the one whose receiver, or whose
    receiver's object, is named ``user``.

    Raises `RecordingError` with the names there are where nobody is named so.
    """
    frames: Counter[tuple[str, str, str]] = Counter()
    for link in _links(recording):
        frames.update(zip(link.tx, link.rx, link.carrier, strict=True))
    found = {key: n for key, n in frames.items() if not user or user in (key[1], key[1].split("/")[0])}
    if not found:
        names = sorted({rx for _, rx, _ in frames})
        near = difflib.get_close_matches(user, names, n=1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise RecordingError(f"no user is named {user!r}; {hint}known: {', '.join(names) or 'none'}")
    return min(found, key=lambda key: (-found[key], key))


def series(recording: Recording, user: tuple[str, str, str]) -> UserSeries:
    """Everything about one user, frame by frame."""
    source = link_source(recording)
    time, rows = [], []
    episode, base, last = 0, 0, 0
    for frame in recording.frames():
        if frame.episode != episode:
            episode, base = frame.episode, last + recording.metadata.sampling_period_ns - frame.t_ns
        last = base + frame.t_ns
        time.append(last * 1e-9)
        rows.append(_row(frame.payloads("link", Link).get(source), user))
    table = np.array(rows, dtype=np.float64).reshape(-1, 6)
    present = ~np.isnan(table[:, 0])
    return UserSeries(
        *user,
        time=np.array(time),
        present=present,
        has_path=present & (table[:, 0] > 0),
        los=present & (table[:, 1] > 0),
        abs_y=table[:, 2],
        best=table[:, 3],
        baseline=table[:, 4],
        theta=table[:, 5],
    )


def draw_over_time(data: UserSeries, agent: str, file: Path) -> None:
    """Fig. 8: |y| over time above, the angle of arrival below; NLOS shaded."""
    with figure(file, 9.0, 6.0) as drawn:
        top, bottom = drawn.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        for label, values, style in curves(data, agent):
            top.plot(
                data.time,
                np.where(data.has_path, values, np.nan),
                label=f"{label}, mean {_mean(data, values):.3g}",
                **style,
            )
        for axes in (top, bottom):
            shade(axes, data)
            axes.grid(color=LIGHT_GREY, linewidth=0.6)
        top.set_ylabel("|y|")
        top.set_ylim(bottom=0)
        top.set_title(f"Beam selection for {data.rx}, served by {data.tx} ({data.carrier})")
        bottom.plot(*_without_jumps(data.time, np.degrees(_wrapped(data.theta))), color=GREY, linewidth=1.6)
        bottom.set_ylabel("AoA θ [°]")
        bottom.set_xlabel("Time [s]")
        bottom.margins(x=0)
        legend_below(drawn, top)


def draw_over_angle(data: UserSeries, agent: str, file: Path) -> None:
    """|y| over the angle of arrival, a point a frame; hollow where the line of sight is blocked."""
    with figure(file, 9.0, 5.0) as drawn:
        axes = drawn.subplots()
        theta = np.degrees(_wrapped(data.theta))
        for label, values, style in curves(data, agent):
            color = style["color"]
            for mask, face in ((data.has_path & data.los, color), (data.has_path & ~data.los, "none")):
                axes.scatter(
                    theta[mask], values[mask], s=_SIZES[color], marker=_MARKERS[color],
                    facecolors=face, edgecolors=color, linewidths=1.0, alpha=0.75,
                )  # fmt: skip
            axes.scatter([], [], s=30, marker=_MARKERS[color], color=color, label=label)
        if (data.has_path & ~data.los).any():
            axes.scatter([], [], s=30, facecolors="none", edgecolors=GREY, label="hollow: NLOS")
        axes.grid(color=LIGHT_GREY, linewidth=0.6)
        axes.set_xlabel("AoA θ [°]")
        axes.set_ylabel("|y|")
        axes.set_ylim(bottom=0)
        axes.set_title(f"|y| over the angle of arrival: {data.rx}, served by {data.tx} ({data.carrier})")
        legend_below(drawn, axes)


_MARKERS = {OPTIMUM: "o", AGENT: "s", BASELINE: "^"}
_SIZES = {OPTIMUM: 54, AGENT: 24, BASELINE: 7}


def curves(data: UserSeries, agent: str) -> list[tuple[str, Float64Array, dict[str, Any]]]:
    """Label, values and style; drawn so that curves which coincide can still be seen."""
    return [
        ("optimum", data.best, {"color": OPTIMUM, "linewidth": 2.8}),
        (f"agent ({agent})", data.abs_y, {"color": AGENT, "linewidth": 1.6}),
        ("baseline (straight line)", data.baseline, {"color": BASELINE, "linewidth": 1.1, "linestyle": "--"}),
    ]


def shade(axes: Any, data: UserSeries) -> None:
    """Background of frames without line of sight, and of those without any path."""
    half = np.median(np.diff(data.time)) / 2 if len(data.time) > 1 else 0.5
    for mask, color, label in (
        (data.has_path & ~data.los, LIGHT_GREY, "NLOS"),
        (data.present & ~data.has_path, _NO_PATH, "no path"),
    ):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
        for n, (first, stop) in enumerate(edges.reshape(-1, 2)):
            axes.axvspan(
                data.time[first] - half, data.time[stop - 1] + half,
                color=color, linewidth=0, zorder=0, label=label if n == 0 else None,
            )  # fmt: skip


def _mean(data: UserSeries, values: Float64Array) -> float:
    with_path = values[data.has_path]
    return float(with_path.mean()) if len(with_path) else 0.0


def _wrapped(theta: Float64Array) -> Float64Array:
    """Angles within ±π."""
    result: Float64Array = np.arctan2(np.sin(theta), np.cos(theta))
    return result


def _without_jumps(time: Float64Array, degrees: Float64Array) -> tuple[Float64Array, Float64Array]:
    """The same with a gap where an angle passes ±180°, so that no line crosses the picture."""
    jumps = np.flatnonzero(np.abs(np.diff(degrees)) > 180) + 1
    return np.insert(time, jumps, time[jumps]), np.insert(degrees, jumps, np.nan)


def _row(link: Link | None, user: tuple[str, str, str]) -> tuple[float, ...]:
    if link is not None:
        for u, key in enumerate(zip(link.tx, link.rx, link.carrier, strict=True)):
            if key == user:
                best = float(link.top_abs_y[u].max(initial=0.0))
                return (
                    float(link.has_path[u]), float(link.los[u]), float(link.abs_y[u]), best,
                    float(link.baseline_abs_y[u]), float(link.aoa_azimuth[u]),
                )  # fmt: skip
    return (float("nan"),) * 6


def _links(recording: Recording) -> list[Link]:
    source = link_source(recording)
    return [
        cast(Link, product.payload)
        for _, product in recording.products("link")
        if product.provenance.source == source and product.provenance.status is Status.FRESH
    ]
