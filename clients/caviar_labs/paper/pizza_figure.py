"""The figure and the film of ``caviar paper pizza``: one episode of both pairs, and all ratios."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from caviar_clients.plots.film import Reel, write_gif
from caviar_clients.plots.style import AGENT, BLACK, BLUE, GREY, LIGHT_GREY, figure, styled
from caviar_labs.paper.pizza import BASELINE, TRAINED, Report
from caviar_labs.paper.pizza_town import BLOCKS_M
from caviar_protocol.arrays import UInt8Array
from caviar_protocol.scenario import Scenario

_COLOURS = {BASELINE: BLUE, TRAINED: AGENT}
_NAMES = {BASELINE: "nearest first, los-beam", TRAINED: "trained pair"}
_MAP = "viridis"
_WHITE = "#ffffff"
_FILM_FPS = 8.0
_STILLS = 12
"""Frames that the end of the film stands still."""


def shown_episode(report: Report) -> int:
    """Choose the episode that is drawn: the one whose ratio of rates is the median of all."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = np.nan_to_num(report.rates(TRAINED) / report.rates(BASELINE), nan=1.0, posinf=1e9)
    return int(np.argsort(ratios, kind="stable")[(len(ratios) - 1) // 2])


def draw(report: Report, scenario: Scenario, file: Path) -> Path:
    """Draw an episode on the map and over time, and the ratios of all episodes.

    Args:
        report: What was played.
        scenario: The experiment's, which has the base station.
        file: PNG that is written.

    Returns:
        The file.
    """
    index = shown_episode(report)
    with figure(file, 12.5, 8.4) as drawn:
        if report.settings.quick:
            drawn.suptitle("A trial: these figures say nothing")
        grid = drawn.add_gridspec(2, 2, height_ratios=[1.15, 1.0])
        maps = [drawn.add_subplot(grid[0, column]) for column in range(2)]
        marks = None
        for axes, pair in zip(maps, (BASELINE, TRAINED), strict=True):
            flight, rate = report.flights[pair][index], _rates(report, pair, index)
            _town(axes, report, scenario, index)
            axes.plot(*flight.places.T, color=GREY, linewidth=0.8, zorder=2)
            marks = axes.scatter(
                *flight.places.T, c=rate, cmap=_MAP, vmin=0, vmax=_top(report), s=16, zorder=3
            )
            axes.set_title(f"{_NAMES[pair]}: {flight.seconds:.1f} s, {rate.mean():.0f} Mbit/s", loc="left")
        drawn.colorbar(marks, ax=maps, label="rate [Mbit/s]", shrink=0.9)
        _over_time(drawn.add_subplot(grid[1, 0]), report, index)
        _all_ratios(drawn.add_subplot(grid[1, 1]), report, index)
    return file


def _rates(report: Report, pair: str, index: int) -> Any:
    return report.flights[pair][index].efficiency * report.bandwidth_hz / 1e6


def _top(report: Report) -> float:
    return float(report.trained.table.efficiency.max()) * report.bandwidth_hz / 1e6


def _town(axes: Any, report: Report, scenario: Scenario, index: int) -> None:
    """The blocks, the base station, start and addresses of an episode."""
    from matplotlib.patches import Rectangle

    for low, high in BLOCKS_M:
        axes.add_patch(Rectangle(low, *(high - low), facecolor=LIGHT_GREY, edgecolor=GREY, linewidth=0.8))
    station = next(device.position_m for device in scenario.devices if device.role == "tx")
    axes.plot(*station[:2], marker="^", color=BLACK, markersize=10, linestyle="none", zorder=4)
    axes.annotate("base station", station[:2], xytext=(6, 4), textcoords="offset points", fontsize=9)
    asked = report.rounds[index]
    axes.plot(*asked.start, marker="s", color=BLACK, markersize=7, linestyle="none", zorder=4)
    axes.annotate("start", asked.start, xytext=(6, 6), textcoords="offset points", fontsize=9, zorder=5)
    for number, address in enumerate(asked.addresses, start=1):
        axes.plot(
            *address, marker="o", markerfacecolor="none", markeredgecolor=BLACK, markersize=13, zorder=4
        )
        axes.annotate(str(number), address, xytext=(8, 6), textcoords="offset points", fontsize=11, zorder=5)
    axes.set_aspect("equal")
    axes.set_xlim(-85, 85)
    axes.set_ylim(-50, 50)
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")


def _over_time(axes: Any, report: Report, index: int) -> None:
    for pair in (BASELINE, TRAINED):
        rate = _rates(report, pair, index)
        at = report.frame_s * np.arange(1, len(rate) + 1)
        axes.step(at, rate, where="pre", color=_COLOURS[pair], label=_NAMES[pair], linewidth=1.4)
    axes.grid()
    axes.set_ylim(bottom=0)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("rate [Mbit/s]")
    axes.set_title(f"Episode {index + 1}, whose ratio of rates is the median", loc="left")
    axes.legend(loc="lower right")


def _all_ratios(axes: Any, report: Report, index: int) -> None:
    times = report.seconds(TRAINED) / report.seconds(BASELINE)
    with np.errstate(divide="ignore", invalid="ignore"):
        rates = report.rates(TRAINED) / report.rates(BASELINE)
    axes.scatter(times, rates, color=AGENT, s=30, zorder=3)
    axes.scatter(
        times[index], rates[index], facecolor="none", edgecolor=BLACK, s=110, zorder=4, label="drawn here"
    )
    axes.axhline(1.0, color=GREY, linewidth=0.8)
    axes.axvline(1.0, color=GREY, linewidth=0.8)
    axes.axhline(1.2, color=BLACK, linewidth=0.8, linestyle="--", label="targets of the mean")
    axes.axvline(1.1, color=BLACK, linewidth=0.8, linestyle="--")
    axes.grid()
    axes.set_xlabel("time, trained over baseline")
    axes.set_ylabel("mean rate, trained over baseline")
    axes.set_title(f"All {len(times)} episodes", loc="left")
    axes.legend(loc="best")


def film(report: Report, scenario: Scenario, file: Path) -> Path:
    """Film the episode that is drawn: both pairs side by side, at four times the speed.

    Args:
        report: What was played.
        scenario: As of `draw`.
        file: GIF that is written.

    Returns:
        The file.
    """
    index = shown_episode(report)
    longest = max(len(report.flights[pair][index].places) for pair in (BASELINE, TRAINED))
    with styled():
        pictures = _Pictures(report, scenario, index)
        samples = [pictures.at(frame) for frame in (longest // 3, longest)]
        every = (pictures.at(min(frame, longest)) for frame in range(1, longest + 1 + _STILLS))
        colours = (_WHITE, BLACK, *_COLOURS.values())
        keys = np.array([[int(text[at : at + 2], 16) for at in (1, 3, 5)] for text in colours], np.uint8)
        write_gif(Reel(every, longest + _STILLS, _FILM_FPS, samples, keys), file)
    return file


class _Pictures:
    """Pictures of an episode, frame by frame, by one figure whose marks are moved."""

    def __init__(self, report: Report, scenario: Scenario, index: int) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self._report, self._index = report, index
        drawn = Figure(figsize=(12.0, 4.4), dpi=80, layout="constrained")
        self._canvas = FigureCanvasAgg(drawn)
        panels = drawn.subplots(1, 2)
        self._axes = dict(zip((BASELINE, TRAINED), panels, strict=True))
        self._trails, self._drones = {}, {}
        for pair, axes in self._axes.items():
            _town(axes, report, scenario, index)
            self._trails[pair] = axes.scatter(
                [], [], c=[], cmap=_MAP, vmin=0, vmax=_top(report), s=22, zorder=3
            )
            (self._drones[pair],) = axes.plot(
                [], [], marker="X", color=_COLOURS[pair], markersize=12, markeredgecolor=BLACK, zorder=6
            )
        drawn.colorbar(self._trails[TRAINED], ax=panels, label="rate [Mbit/s]")

    def at(self, frame: int) -> UInt8Array:
        """The picture after so many frames, Shape ``[height, width, 3]``."""
        for pair, axes in self._axes.items():
            flight = self._report.flights[pair][self._index]
            rate = _rates(self._report, pair, self._index)[:frame]
            places = flight.places[:frame]
            self._trails[pair].set_offsets(places)
            self._trails[pair].set_array(rate)
            self._drones[pair].set_data(places[-1:, 0], places[-1:, 1])
            done = " (done)" if frame >= len(flight.places) else ""
            seconds = len(rate) * self._report.frame_s
            axes.set_title(
                f"{_NAMES[pair]}: {seconds:.1f} s{done}, {rate.mean():.0f} Mbit/s so far", loc="left"
            )
        self._canvas.draw()
        picture: UInt8Array = np.asarray(self._canvas.buffer_rgba())[..., :3].copy()
        return picture
