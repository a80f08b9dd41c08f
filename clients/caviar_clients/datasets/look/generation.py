"""How fast the episodes of a dataset were played, on its page, and which failed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Annotated, Any

import msgspec
import numpy as np

from caviar_clients.datasets.catalogue import Catalogue
from caviar_clients.datasets.look.data import Content
from caviar_clients.datasets.look.html import absent, figure, table
from caviar_clients.datasets.look.pictures import Draw, Theme, picture, plain
from caviar_clients.datasets.look.units import rate_unit, small_time_unit, time_unit
from caviar_clients.datasets.texts import counted, duration_text, percent
from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import RecordingError

SHOWN_FAILURES = 50


@dataclass(frozen=True, eq=False)
class Throughput:
    """How fast the episodes were played."""

    edges_s: Float64Array
    """Limits of the intervals, from the first episode, interruptions left out [s], Shape ``[N + 1]``."""
    rate: Float64Array
    """Scenes per second, Shape ``[N]``."""
    interruptions_s: tuple[float, ...]
    """Where nothing was played for long, on the same axis [s]."""
    scenes: int
    """Of the episodes whose times are known."""
    episodes: int
    busy_s: float
    """Wall time of the episodes, added up: with two workers two seconds pass in one [s]."""
    services_s: Mapping[str, float]
    """Wall time of each service, added up; what is left of ``busy_s`` is start, reset and saving [s]."""
    hosts: int
    processes: int

    @property
    def elapsed_s(self) -> float:
        """Without interruptions [s]."""
        return float(self.edges_s[-1])


INTERVALS = 60
_INTERRUPTION_S = 60.0


def read_throughput(catalogue: Catalogue) -> Throughput | None:
    """Read how fast the episodes were played; None where no times are known."""
    _, rows = catalogue.query(
        "SELECT t.started, t.wall_s, t.host, t.pid, t.detail, e.scenes FROM timings t JOIN episodes e "
        "USING (episode) WHERE t.started IS NOT NULL AND t.wall_s > 0"
    )
    if not rows:
        return None
    started, wall, hosts, pids, details, scenes = zip(*rows, strict=True)
    begin = np.array([_instant(catalogue, text) for text in started])
    walls, counts = np.array(wall), np.array(scenes, dtype=float)
    begin, interruptions = _without_interruptions(begin, walls)
    edges = np.linspace(0.0, float((begin + walls).max()), _intervals(len(rows)) + 1)
    # Scenes of an episode are spread evenly over its time.
    played = [float((counts * np.clip((edge - begin) / walls, 0.0, 1.0)).sum()) for edge in edges]
    services: dict[str, float] = {}
    for detail in details:
        for name, seconds in _services_s(catalogue, detail).items():
            services[name] = services.get(name, 0.0) + seconds
    return Throughput(
        edges_s=edges,
        rate=np.diff(played) / np.diff(edges),
        interruptions_s=interruptions,
        scenes=int(counts.sum()),
        episodes=len(rows),
        busy_s=float(walls.sum()),
        services_s=services,
        hosts=len(set(hosts)),
        processes=len(set(zip(hosts, pids, strict=True))),
    )


def _instant(catalogue: Catalogue, text: str) -> float:
    """Seconds since 1970 of a time of the table of times."""
    try:
        return datetime.fromisoformat(text).timestamp()
    except (ValueError, OverflowError) as error:
        raise RecordingError(
            f"{catalogue.path}: timings.started is {text!r:.80}, no time of ISO 8601"
        ) from error


class _Detail(msgspec.Struct):
    services_s: dict[str, Annotated[float, msgspec.Meta(ge=0)]] = {}


def _services_s(catalogue: Catalogue, text: str | None) -> dict[str, float]:
    """Wall time of each service by the table of times [s]."""
    try:
        return msgspec.json.decode(text or "{}", type=_Detail).services_s
    except (msgspec.MsgspecError, UnicodeError) as error:
        raise RecordingError(f"{catalogue.path}: timings.detail is {text!r:.80}: {error}") from error


def _intervals(episodes: int) -> int:
    """Of two episodes or more each, unless there are few."""
    return min(INTERVALS, max(episodes // 2, min(episodes, 10)))


def _without_interruptions(begin: Float64Array, wall: Float64Array) -> tuple[Float64Array, tuple[float, ...]]:
    """Times from the first one, moved together where nothing was played for long, and where that was."""
    longest = max(_INTERRUPTION_S, 10.0 * float(np.median(wall)))
    order = np.argsort(begin, kind="stable")
    moved, cut, busy_until, places = np.zeros(len(begin)), float(begin[order[0]]), -np.inf, list[float]()
    for at in order:
        if begin[at] - busy_until > longest and np.isfinite(busy_until):
            cut += float(begin[at] - busy_until)
            places.append(float(begin[at]) - cut)
        moved[at] = begin[at] - cut
        busy_until = max(busy_until, float(begin[at] + wall[at]))
    return moved, tuple(places)


def draw_throughput(found: Throughput) -> Draw:
    """Scenes per second over the time of the generation."""

    def draw(drawn: Any, theme: Theme) -> None:
        unit, name = time_unit(found.elapsed_s)
        mean = found.scenes / found.elapsed_s
        per, per_name = rate_unit(mean)
        axes = drawn.subplots()
        axes.stairs(per * found.rate, found.edges_s / unit, fill=True, color=theme.first, alpha=0.8)
        label = f"mean, {per * mean:.3g} scenes/{per_name}"
        axes.axhline(per * mean, color=theme.second, linewidth=1.4, label=label)
        for at, place in enumerate(found.interruptions_s):
            axes.axvline(
                place / unit, color=theme.muted, linewidth=1.0, linestyle=":",
                label=None if at else "interrupted; the time without work is left out",
            )  # fmt: skip
        axes.set(
            xlim=(0.0, found.elapsed_s / unit),
            xlabel=f"Time at work [{name}]",
            ylabel=f"Scenes per {_NAMES[per_name]}",
        )
        axes.set_ylim(0.0, per * max(float(found.rate.max()), mean) * 1.12)
        axes.grid(axis="y")
        handles, labels = axes.get_legend_handles_labels()
        drawn.legend(handles, labels, loc="outside upper center", ncols=2, frameon=False)

    return draw


def draw_services(shares: Mapping[str, float], scenes: int) -> Draw:
    """A bar for each service: its wall time for a scene.

    Args:
        shares: Seconds of each service.
        scenes: Of which they are the time.
    """

    def draw(drawn: Any, theme: Theme) -> None:
        axes = drawn.subplots()
        names = list(map(plain, shares))
        each = [seconds / max(scenes, 1) for seconds in shares.values()]
        unit, unit_name = small_time_unit(max(each) / 10)  # as numbers that need no zeros after the point
        each = [seconds / unit for seconds in each]
        total = sum(each)
        axes.barh(names, each, color=theme.first, height=0.62)
        for row, value in enumerate(each):
            text = f" {value:.3g} {unit_name}, {value / total:.1%}".replace("%", " %")
            axes.text(value, row, text, va="center", fontsize=9)
        axes.set(xlabel=f"Wall time for a scene [{unit_name}]", xlim=(0.0, 1.28 * max(each)))
        axes.invert_yaxis()
        axes.spines["left"].set_visible(False)
        axes.tick_params(axis="y", length=0)

    return draw


_NAMES = {"s": "second", "min": "minute", "h": "hour"}


def generation_section(content: Content) -> Iterator[str]:
    """How fast the dataset was generated, and what failed."""
    found = read_throughput(content.catalogue)
    if found is None:
        yield absent("No times are kept: how fast the episodes were played is not known.")
    else:
        per, name = rate_unit(found.scenes / found.elapsed_s)
        rate = per * found.scenes / found.elapsed_s
        where = counted(found.processes, "process", "processes")
        where = f"{where} of {counted(found.hosts, 'machine')}"
        text = (
            f"{counted(found.scenes, 'scene')} of {counted(found.episodes, 'episode')} in "
            f"{duration_text(found.elapsed_s)} at work, by {where}: {rate:.3g} scenes/{name}"
        )
        yield figure(
            picture(draw_throughput(found), f"Scenes played over the time of the generation; {text}.", 3.1),
            f"{text}. Scenes of an episode are spread evenly over its wall time.",
        )
        if found.services_s:
            shares = dict(sorted(found.services_s.items(), key=lambda item: -item[1]))
            rest = found.busy_s - sum(shares.values())
            if rest > 0.0:
                shares["start, reset, saving"] = rest
            longest = max(shares, key=lambda name: shares[name])
            yield figure(
                picture(
                    draw_services(shares, found.scenes),
                    "Bars of the wall time that each service takes for a scene; the longest is that of "
                    f"{longest}, {percent(shares[longest] / sum(shares.values()))} of all.",
                    0.9 + 0.36 * len(shares),
                ),
                "Wall time for a scene, by service, on average of all episodes; what is left is loading, "
                "resetting and saving an episode.",
            )
    _, ((attempts,),) = content.catalogue.query("SELECT count(*) FROM failures")
    failures = content.catalogue.failures()
    if failures:
        them = "it" if len(failures) == 1 else "them"
        yield f"<p>{counted(len(failures), 'episode')} failed; the generate command plays {them} again:</p>"
        yield table(
            ("episode", "error"), [(str(n), text) for n, text in failures[:SHOWN_FAILURES]], right=(0,)
        )
        if len(failures) > SHOWN_FAILURES:
            yield f"<p>… and {len(failures) - SHOWN_FAILURES:,} more, in table <code>failures</code>.</p>"
    else:
        yield (
            "<p>No episode failed.</p>"
            if not attempts
            else (
                f"<p>No episode is missing; {counted(attempts, 'time')} one failed and was played again.</p>"
            )
        )
