"""Pictures of one user through a run: |y| (Fig. 8 of the paper), dispersion, frequency response.

|y| of the best pair, the agent and the baseline is drawn over time, with the angle of arrival below, and over
that angle itself. Dispersion and frequency response are computed from the paths of the channel: amplitudes
are those between the reference points of both arrays, element patterns included, so that the figures are
those of single elements, not of what a beam leaves of the paths.
"""

from __future__ import annotations

import difflib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np

from caviar_clients.plots.style import (
    AGENT,
    BASELINE,
    BLUE,
    GREY,
    LIGHT_GREY,
    OPTIMUM,
    ORANGE,
    VERMILION,
    figure,
    legend_below,
    shade_frames,
)
from caviar_protocol.arrays import BoolArray, Complex128Array, Float64Array
from caviar_protocol.errors import RecordingError
from caviar_protocol.messages import Status
from caviar_protocol.multipath import (
    coherence,
    delay_spread,
    doppler_spread,
    k_factor,
    subcarrier_offsets,
    subcarrier_weights,
)
from caviar_protocol.recording import Recording
from caviar_protocol.recording.arrays import TopicArrays
from caviar_protocol.topics import Carrier, Link

# A pale red that neither the grey of NLOS nor one of the curves looks like.
_NO_PATH = "#f2c9b8"


@dataclass(frozen=True, eq=False)
class UserSeries:
    """|y| of one user through a run, Shape ``[F]`` each; NaN and false in frames without the user."""

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
    begins: tuple[int, ...] = ()
    """Frames in which an episode after the first begins."""


def link_source(recording: Recording) -> str:
    """Choose the source of topic ``link`` that pictures show: the first by name."""
    sources = recording.topics.get("link", ())
    if not sources:
        raise RecordingError(f"{recording.path} has no link, so there is no |y| to draw")
    return sources[0]


def has_users(recording: Recording) -> bool:
    """Check whether any frame of the link has a user."""
    return any(link.rx for link in _links(recording))


def choose_user(recording: Recording, user: str = "") -> tuple[str, str, str]:
    """Choose a user of the link.

    Args:
        recording: The recording.
        user: Name of its receiver, or of the object with the receiver; empty: that which was there longest.

    Returns:
        (tx, rx, carrier), of several with the name the one that was there longest.

    Raises:
        RecordingError: No user has the name; the error has the names of all.
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
    """Read the |y| of a user, frame by frame.

    Args:
        recording: The recording.
        user: (tx, rx, carrier).
    """
    # One pass over the frames: the recording's arrays would decode each link anew for every column.
    source = link_source(recording)
    time: list[float] = []
    rows = []
    episode, base, last = 0, 0, 0
    begins: list[int] = []
    for frame in recording.frames():
        if frame.episode != episode:
            begins += [len(time)] if time else []
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
        begins=tuple(begins),
    )


def draw_over_time(data: UserSeries, agent: str, file: Path) -> None:
    """Draw |y| of the best pair over time, what others lose to it, and the angle of arrival; NLOS shaded.

    Args:
        data: The user.
        agent: Name of the agent, for the legend.
        file: PNG that is written.
    """
    with figure(file, 9.0, 8.0) as drawn:
        top, middle, bottom = drawn.subplots(3, 1, sharex=True, height_ratios=(3, 3, 2))
        for label, values, style in curves(data, agent):
            shown = np.where(data.has_path, decibels(values), np.nan)
            # |y| of a perfect agent is the optimum: its loss shows beside the other's, the curves would not.
            axes, shown = (top, shown) if values is data.best else (middle, shown - decibels(data.best))
            axes.plot(*_apart(data, shown), label=f"{label}, mean |y| {_mean(data, values):.3g}", **style)
        optimum = f"optimum, mean |y| {_mean(data, data.best):.3g}"
        middle.plot([], [], color=OPTIMUM, linewidth=2.8, label=optimum)
        for axes in (top, middle, bottom):
            shade(axes, data)
            axes.grid()
        top.set_ylabel("|y| of the\noptimum [dB]")
        middle.set_ylabel("|y| below\nthe optimum [dB]")
        middle.set_ylim(top=max(0.5, -0.03 * middle.get_ylim()[0]))
        top.set_title(f"Beam selection for {data.rx}, served by {data.tx} ({data.carrier})")
        theta = _apart(data, np.degrees(_wrapped(data.theta)))
        bottom.plot(*_without_jumps(*theta), color=GREY, linewidth=1.6)
        bottom.set(ylabel="AoA θ [°]", xlabel="Time [s]")
        bottom.margins(x=0)
        legend_below(drawn, middle)


def decibels(values: Float64Array) -> Float64Array:
    """Express amplitudes in dB; NaN for 0."""
    found: Float64Array = 20 * np.log10(np.where(values > 0, values, np.nan))
    return found


def _apart(data: UserSeries, values: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Insert a gap where an episode begins, so that no line joins two."""
    begins = list(data.begins)
    return np.insert(data.time, begins, data.time[begins]), np.insert(values, begins, np.nan)


def draw_over_angle(data: UserSeries, agent: str, file: Path) -> None:
    """Draw what is lost to the optimum over the angle of arrival, a point a frame; hollow: NLOS."""
    with figure(file, 9.0, 5.0) as drawn:
        axes = drawn.subplots()
        theta = np.degrees(_wrapped(data.theta))
        for label, values, style in curves(data, agent)[1:]:
            color, values = style["color"], decibels(values) - decibels(data.best)
            for mask, face in ((data.has_path & data.los, color), (data.has_path & ~data.los, "none")):
                axes.scatter(
                    theta[mask], values[mask], s=_SIZES[color], marker=_MARKERS[color],
                    facecolors=face, edgecolors=color, linewidths=1.0, alpha=0.75,
                )  # fmt: skip
            axes.scatter([], [], s=30, marker=_MARKERS[color], color=color, label=label)
        if (data.has_path & ~data.los).any():
            axes.scatter([], [], s=30, facecolors="none", edgecolors=GREY, label="hollow: NLOS")
        axes.grid()
        axes.set(xlabel="AoA θ [°]", ylabel="|y| relative to the optimum [dB]")
        axes.set_ylim(top=max(0.5, -0.03 * axes.get_ylim()[0]))
        axes.set_title(f"|y| over the angle of arrival: {data.rx}, served by {data.tx} ({data.carrier})")
        legend_below(drawn, axes)


_MARKERS = {OPTIMUM: "o", AGENT: "s", BASELINE: "^"}
_SIZES = {OPTIMUM: 54, AGENT: 24, BASELINE: 7}


def curves(data: UserSeries, agent: str) -> list[tuple[str, Float64Array, dict[str, Any]]]:
    """Return label, values and style of each curve.

    Args:
        data: The user.
        agent: Name of the agent, for the label.
    """
    # From wide and dark to thin and dashed: curves that coincide, as those of a perfect agent, all show.
    return [
        ("optimum", data.best, {"color": OPTIMUM, "linewidth": 2.8}),
        (f"agent ({agent})", data.abs_y, {"color": AGENT, "linewidth": 1.6}),
        ("LOS beam", data.baseline, {"color": BASELINE, "linewidth": 1.1, "linestyle": "--"}),
    ]


def shade(axes: Any, data: UserSeries) -> None:
    """Colour the background of frames without line of sight, and of those without any path."""
    shade_frames(axes, data.time, data.has_path & ~data.los, LIGHT_GREY, "NLOS")
    shade_frames(axes, data.time, data.present & ~data.has_path, _NO_PATH, "no path")


def _mean(data: UserSeries, values: Float64Array) -> float:
    with_path = values[data.has_path]
    return float(with_path.mean()) if len(with_path) else 0.0


def _wrapped(theta: Float64Array) -> Float64Array:
    """Wrap angles to ±π."""
    result: Float64Array = np.arctan2(np.sin(theta), np.cos(theta))
    return result


def _without_jumps(time: Float64Array, degrees: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Insert a gap where an angle passes ±180°, so that no line crosses the picture."""
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


# Frequencies that are drawn of a carrier without subcarriers.
_POINTS = 256
# Weaker paths and deeper fades than this below the strongest are at the edge of a picture [dB]: one null of a
# two-path channel is −∞ dB and would take all of the scale.
_RANGE_DB = 40.0


@dataclass(frozen=True, eq=False)
class UserPaths:
    """The paths of one user through a run; P is the most that a frame has, NaN where it has fewer."""

    tx: str
    rx: str
    carrier: Carrier
    frames: list[tuple[int, int]]
    """Episode and number of each frame."""
    time: Float64Array
    """[s], simulated; an episode begins where the one before ended. Shape ``[F]``."""
    los: BoolArray
    a: Complex128Array
    """Shape ``[F, P]``."""
    tau: Float64Array
    """[s], Shape ``[F, P]``."""
    doppler: Float64Array
    """[Hz], Shape ``[F, P]``."""


def running_time(topic: TopicArrays[Any, Any], period_ns: int) -> Float64Array:
    """Simulated time of each frame of a topic, in which an episode begins where the one before ended.

    Args:
        topic: Arrays of the topic.
        period_ns: Between frames [ns].

    Returns:
        [s], Shape ``[F]``.
    """
    # Each episode counts its time from its own start: what came before it is added up.
    begins = np.flatnonzero(np.diff(topic.episode, prepend=-1))
    lasted = np.diff(np.append(begins, len(topic)))
    last = topic.t_ns[begins + lasted - 1] + period_ns - topic.t_ns[begins]
    ahead = np.repeat(np.concatenate([[0], np.cumsum(last[:-1])]) - topic.t_ns[begins], lasted)
    time: Float64Array = (topic.t_ns + ahead + topic.t_ns[0]) * 1e-9
    return time


def user_paths(recording: Recording, user: tuple[str, str, str] | None) -> UserPaths | None:
    """Read the paths of a user.

    Args:
        recording: The recording, with topic ``channel``.
        user: (tx, rx, carrier); None: the first user.

    Returns:
        Its paths; None where the channel has no such user.
    """
    channel = recording["channel", recording.topics["channel"][0]]
    if not channel.users:
        return None
    tx, rx, carrier = user or channel.users[0]
    if (tx, rx, carrier) not in channel.users:
        return None
    mine = channel.select(tx=tx, rx=rx, carrier=carrier)
    return UserPaths(
        tx=tx,
        rx=rx,
        carrier=channel.carriers[carrier],
        frames=list(zip(channel.episode.tolist(), channel.frame.tolist(), strict=True)),
        time=running_time(channel, recording.metadata.sampling_period_ns),
        los=mine.los[:, 0],
        a=mine.a[:, 0],
        tau=mine.tau[:, 0],
        doppler=mine.doppler[:, 0],
    )


def draw_dispersion(data: UserPaths, file: Path) -> None:
    """Draw delay spread, K-factor, coherence bandwidth and time over simulated time; NLOS shaded."""
    sigma_tau, sigma_nu = delay_spread(data.a, data.tau), doppler_spread(data.a, data.doppler)
    with np.errstate(divide="ignore"):
        k_db = 10 * np.log10(k_factor(data.a, data.tau, data.los))
    all_rows = (
        ("RMS delay\nspread [ns]", sigma_tau * 1e9, BLUE),
        ("K-factor [dB]", k_db, BLUE),
        ("Coherence\nbandwidth [MHz]", coherence(sigma_tau) * 1e-6, VERMILION),
        ("Coherence\ntime [ms]", coherence(sigma_nu) * 1e3, VERMILION),
    )
    # Of one path in each frame only the delay spread, 0, is a number: empty panels would say no more.
    rows = [row for row in all_rows if np.isfinite(row[1]).any()] or all_rows[:1]
    left_out = [label.replace("\n", " ").split(" [")[0] for label, *_ in all_rows[len(rows) :]]
    without = f"\n{', '.join(left_out)}: {_why_empty(all_rows[-1][1])}" if len(rows) == 1 else ""
    with figure(file, 9.0, 1.0 + 1.75 * len(rows) + 0.6 * bool(without)) as drawn:
        axes = drawn.subplots(len(rows), 1, sharex=True, squeeze=False)[:, 0]
        for place, (label, values, color) in zip(axes, rows, strict=True):
            finite = np.where(np.isfinite(values), values, np.nan)
            place.plot(data.time, finite, color=color, linewidth=1.6, marker=".", markersize=4)
            place.set_ylabel(label)
            if label.startswith("Coherence"):
                _scale(place, finite[np.isfinite(finite)])
            if not np.isfinite(finite).any():
                place.set_yticks([])
                place.text(0.5, 0.5, _why_empty(values), transform=place.transAxes, ha="center", color=GREY)
            place.grid()
            shade_frames(place, data.time, ~data.los & np.isfinite(data.tau).any(-1), LIGHT_GREY)
        axes[0].set_title(
            f"Dispersion of {data.rx}, served by {data.tx} ({data.carrier.name}); shaded: NLOS"
            + (without or "\ncoherence: correlation stays above 0.5 for at least 1/(6σ)")
        )
        axes[-1].set_xlabel("Time [s]")
        axes[-1].margins(x=0)


def _scale(axes: Any, values: Float64Array) -> None:
    """Make the y axis logarithmic where values span more than a decade, with numbers at 1, 2 and 5."""
    # Within a decade a logarithmic axis may have no number at all: there it stays linear.
    if not len(values) or values.max() <= 10 * values.min():
        return
    from matplotlib.ticker import FuncFormatter, LogLocator

    axes.set_yscale("log")
    axes.minorticks_off()
    axes.yaxis.set_major_locator(
        LogLocator(subs=(1.0, 2.0, 5.0) if values.max() < 1e3 * values.min() else (1.0,))
    )
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _why_empty(values: Float64Array) -> str:
    """Explain why no value of a user can be drawn."""
    if np.isposinf(values).any():
        return "infinite, with one path in each frame"
    return "no direct path" if np.isneginf(values).any() else "no path"


def draw_frequency_response(data: UserPaths, shown: tuple[int, int], moment: str, file: Path) -> None:
    """Draw power delay profile and |H(f)| of one frame above, |H(f)| of all frames below.

    Args:
        data: Paths of the user.
        shown: Episode and number of the frame.
        moment: Its name, for the title.
        file: PNG that is written.
    """
    frame = data.frames.index(shown)
    carrier = data.carrier
    if not carrier.subcarriers:
        spacing = carrier.bandwidth_hz / _POINTS
        carrier = msgspec.structs.replace(carrier, subcarriers=_POINTS, subcarrier_spacing_hz=spacing)
    carrier = msgspec.structs.replace(carrier, slots=1)
    offsets, gain_db = subcarrier_offsets(carrier) * 1e-6, _gains_db(data, carrier)
    with figure(file, 10.0, 7.5) as drawn:
        grid = drawn.add_gridspec(2, 2, height_ratios=(3, 4))
        profile, response = drawn.add_subplot(grid[0, 0]), drawn.add_subplot(grid[0, 1])
        _draw_profile(profile, data, frame)
        response.plot(offsets, gain_db[frame], color=BLUE, linewidth=1.6)
        response.set(xlabel="Frequency from the carrier [MHz]", ylabel="|H(f)|² [dB]")
        response.margins(x=0)
        response.grid()
        drawn.suptitle(f"{data.rx}, served by {data.tx} ({data.carrier.name}): {moment}")
        _draw_map(drawn.add_subplot(grid[1, :]), data, offsets, gain_db, frame)


def _draw_profile(axes: Any, data: UserPaths, frame: int) -> None:
    """Draw the gain of each path over its delay."""
    there = np.isfinite(data.tau[frame])
    delay = data.tau[frame][there] * 1e9
    with np.errstate(divide="ignore"):
        gain_db = 20 * np.log10(np.abs(data.a[frame][there]))
    axes.set(xlabel="Delay [ns]", ylabel="Gain of a path [dB]")
    axes.grid()
    if not len(delay) or not np.isfinite(gain_db).any():
        axes.text(0.5, 0.5, "no path", transform=axes.transAxes, ha="center", color=GREY)
        return
    floor = gain_db.max() - _RANGE_DB
    shown = np.maximum(gain_db, floor)
    direct = int(delay.argmin()) if data.los[frame] else -1
    for index, (x, y) in enumerate(zip(delay, shown, strict=True)):
        color = ORANGE if index == direct else BLUE
        above = 4 if index == direct else 3
        axes.vlines(x, floor, y, color=color, linewidth=1.6, zorder=above)
        axes.plot(x, y, "o", color=color, markersize=5, zorder=above)
    axes.set_ylim(floor, gain_db.max() + 3)
    spread = float(delay_spread(data.a[frame], data.tau[frame]))
    k = float(k_factor(data.a[frame], data.tau[frame], data.los[frame]))
    texts = [f"σ = {spread * 1e9:.3g} ns"]
    if np.isfinite(k) and k > 0:
        texts.append(f"K = {10 * np.log10(k):.1f} dB (direct path: orange)".replace("-", "−"))
    axes.set_title(", ".join(texts))


def _draw_map(axes: Any, data: UserPaths, offsets: Float64Array, gain_db: Float64Array, frame: int) -> None:
    """Draw |H(f)|² over time and frequency."""
    known = gain_db[np.isfinite(gain_db)]
    if len(known):
        least, most = float(known.min()), float(known.max())
        floor = max(least, most - _RANGE_DB)
        mesh = axes.pcolormesh(
            data.time, offsets, gain_db.T, shading="nearest", cmap="viridis", vmin=floor, vmax=most
        )
        extend = "min" if floor > least else "neither"
        axes.figure.colorbar(mesh, ax=axes, label="|H(f)|² [dB]", extend=extend)
    axes.axvline(data.time[frame], color=VERMILION, linewidth=1.0, linestyle="--")
    axes.set(xlabel="Time [s]", ylabel="Frequency from\nthe carrier [MHz]")


def _gains_db(data: UserPaths, carrier: Carrier) -> Float64Array:
    """Compute |H(f)|² of each frame [dB], Shape ``[F, K]``; NaN in frames without a path."""
    found = np.full((len(data.time), carrier.subcarriers), np.nan)
    for frame, (a, tau, doppler) in enumerate(zip(data.a, data.tau, data.doppler, strict=True)):
        there = np.isfinite(tau)
        if there.any():
            response = subcarrier_weights(carrier, tau[there], doppler[there])[0] @ a[there]
            with np.errstate(divide="ignore"):
                found[frame] = 20 * np.log10(np.abs(response))
    return np.where(np.isfinite(found), found, np.nan)
