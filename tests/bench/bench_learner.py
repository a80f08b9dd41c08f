"""Rates of the agent ``learner`` over a run beside those of ``los-beam`` and of the best pairs, in and out of
sight.

Run as ``python tests/bench/bench_learner.py [SCENARIO] [--seeds 5] [--frames N] [--policy FILE] [--markdown
FILE] [--picture FILE]``: a run in this process for each seed. Rates are Shannon's, and those of the learner
are less by the air time of its pilots. The picture has the rate over the run, the mean of all seeds; the
table has the last quarter of the frames with such users, and of all windows the one in which the learner is
worst beside ``los-beam``.

With ``--policy``, trained elsewhere, the agent ``policy`` and a learner that begins from it play each seed
too, with the transmitters of the policy's card; the table then has a row for each of them.
"""

# ruff: noqa: T201 - a command that prints what it measured

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from msgspec.structs import replace
from policy_files import for_policy

from caviar_clients.replay.plan import Request, plan_replay
from caviar_clients.replay.recorded import RecordedRun
from caviar_clients.session.embedded import EmbeddedRun
from caviar_protocol.arrays import BoolArray, Float64Array
from caviar_protocol.recording import Recording
from caviar_protocol.scenario import Scenario, load_scenario
from caviar_protocol.spec import table
from caviar_protocol.topics import Link
from caviar_services.agent.pilots import PILOT_TIME
from caviar_services.agent.policy import PolicyModel

WINDOW = 25
"""Frames of a point of the curve."""
AGENTS = ("learner", "los-beam", "best pair")


def with_learner(scenario: Scenario, seed: int, frames: int | None) -> Scenario:
    """The scenario with this agent and seed; what a replay with another agent needs is recorded."""
    services = {
        name: replace(spec, use="learner", settings={}) if spec.role == "agent" else spec
        for name, spec in scenario.services.items()
    }
    sensors = tuple(spec.use for spec in services.values() if spec.role == "sensors")
    topics = ("scene", "channel", "link", *sensors)
    run = replace(scenario.run, seed=seed, record=topics, frames=frames or scenario.run.frames, episodes=1)
    return replace(scenario, run=run, services=services)


def with_policy(folder: Path, file: Path) -> dict[str, Scenario]:
    """Replays of a recorded run with other agents: they serve the same users over the same channels."""
    run, policy = RecordedRun(Recording(folder)), f"file:{file.resolve()}"
    (agent,) = (name for name, spec in run.scenario.services.items() if spec.role == "agent")
    settings: dict[str, tuple[str, Mapping[str, Any]]] = {
        "policy": ("policy", {"file": policy}),
        "policy, 8 pilots": ("policy", {"file": policy, "candidates": 8}),
        "learner from policy": ("learner", {"policy": policy}),
    }
    return {
        name: plan_replay(run, Request(replace={agent: use}, settings={agent: given})).scenario
        for name, (use, given) in settings.items()
    }


def rates_of(scenario: Scenario, folder: Path) -> tuple[Float64Array, BoolArray, BoolArray]:
    """Rates in each frame.

    Returns:
        Of `AGENTS` the rate of each user [bit/s/Hz], Shape ``[3, K, U]``, and whether it has a path, and is
        in sight, Shape ``[K, U]``.
    """
    folder.mkdir()
    outcome = EmbeddedRun(scenario, folder).run()
    assert not outcome.error, outcome.error
    rates, paths, sight = [], [], []
    for frame in Recording(folder).frames():
        (link,) = frame.payloads("link", Link).values()
        pilots_ns = sum(report.counts.get(PILOT_TIME, 0) for report in frame.reports)
        left = max(0.0, 1.0 - pilots_ns / scenario.run.sampling_period_ns)
        with np.errstate(divide="ignore", invalid="ignore"):
            power = np.where(link.top_abs_y[:, 0] > 0, link.snr_best / link.top_abs_y[:, 0] ** 2, 0.0)
        baseline = np.log2(1 + power * link.baseline_abs_y**2)
        rates.append((left * np.log2(1 + link.snr), baseline, np.log2(1 + link.snr_best)))
        paths.append(link.has_path)
        sight.append(link.los)
    return np.moveaxis(np.array(rates), 1, 0), np.array(paths), np.array(sight)


def windows(rates: Float64Array, chosen: BoolArray) -> Float64Array:
    """Means over the chosen users and all seeds of each window, Shape ``[3, W]``; NaN where there is none.

    Args:
        rates: Shape ``[3, S, K, U]``.
        chosen: Shape ``[S, K, U]``.
    """
    starts = range(0, rates.shape[2], WINDOW)
    found = np.full((len(rates), len(starts)), np.nan)
    for w, start in enumerate(starts):
        cut = slice(start, start + WINDOW)
        if chosen[:, cut].any():
            found[:, w] = rates[:, :, cut][:, chosen[:, cut]].mean(axis=-1)
    return found


def last_quarter(chosen: BoolArray) -> BoolArray:
    """Of the chosen users those in the last quarter of the frames that have one, seed by seed.

    Args:
        chosen: Shape ``[S, K, U]``.
    """
    found = chosen.copy()
    for of_seed in found:
        frames = np.flatnonzero(of_seed.any(axis=-1))
        of_seed[: frames[3 * len(frames) // 4] if len(frames) else 0] = False
    return found


def by_agent(rates: Float64Array, agents: Sequence[str], chosen: Mapping[str, BoolArray]) -> list[list[str]]:
    """Rows of the table with a policy: mean rates over all frames, then those of the last quarter.

    Args:
        rates: Shape ``[A, S, K, U]``.
        agents: Names, A.
        chosen: Users by the name of their kind, Shape ``[S, K, U]``.
    """
    masks = [*chosen.values(), *(last_quarter(of) for of in chosen.values())]
    return [[agent, *(f"{rates[a, mask].mean():.2f}" for mask in masks)] for a, agent in enumerate(agents)]


def draw(curves: dict[str, Float64Array], agents: Sequence[str], file: Path, title: str) -> None:
    """Draw the rate of each agent over the run, in and out of sight."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.6), layout="constrained")
    axes = figure.subplots(1, len(curves), sharey=True)
    for ax, (name, curve) in zip(axes, curves.items(), strict=True):
        frames = WINDOW * (np.arange(curve.shape[1]) + 0.5)
        for agent, values in zip(agents, curve, strict=True):
            ax.plot(frames, values, marker=".", label=agent)
        ax.set(title=name, xlabel="frame")
    axes[0].set(ylabel="rate [bit/s/Hz]")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right center")
    figure.suptitle(title)
    figure.savefig(file, dpi=120)


def main() -> None:
    """Measure, print and draw."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("scenario", nargs="?", default="geometric")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--frames", type=int, help="of each run; absent: those of the scenario")
    parser.add_argument("--policy", type=Path, help="ONNX file that was trained elsewhere")
    parser.add_argument("--markdown", type=Path, help="write the table of the documentation there")
    parser.add_argument("--picture", type=Path, help="draw the curve there")
    args = parser.parse_args()
    base = load_scenario(args.scenario)
    agents = [*AGENTS]
    if args.policy:
        base = for_policy(base, PolicyModel(args.policy))
    runs = []
    with TemporaryDirectory(prefix="caviar-learner-") as name:
        for seed in range(1, args.seeds + 1):
            folder = Path(name) / str(seed)
            rates, has_path, los = rates_of(with_learner(base, seed, args.frames), folder)
            replays = with_policy(folder, args.policy) if args.policy else {}
            for number, scenario in enumerate(replays.values()):
                again, _, _ = rates_of(scenario, Path(name) / f"{seed}-{number}")
                rates = np.concatenate([rates, again[:1]])
            agents = [*AGENTS, *replays]
            runs.append((rates, has_path, los))
    users = min(rates.shape[2] for rates, _, _ in runs)
    rates = np.stack([one[:, :, :users] for one, _, _ in runs], axis=1)
    has_path = np.stack([one[:, :users] for _, one, _ in runs])
    los = np.stack([one[:, :users] for _, _, one in runs])
    curves, rows = {}, []
    kinds = {"in sight": has_path & los, "out of sight": has_path & ~los}
    for name, chosen in kinds.items():
        if not chosen.any():
            continue
        curves[name] = curve = windows(rates, chosen)
        late = last_quarter(chosen)
        last = rates[: len(AGENTS), late].mean(axis=-1)
        ratios = [
            of_seed[0, own].mean() / of_seed[1, own].mean()
            for of_seed, own in zip(np.moveaxis(rates, 1, 0), late, strict=True)
            if own.any()
        ]
        worst = np.nanmin(curve[0] / curve[1])
        rows.append(
            (
                name,
                *(f"{value:.2f}" for value in last),
                f"{min(ratios):.3f}–{max(ratios):.3f}",
                f"{worst:.3f}",
            )
        )
    head = (
        "users",
        *(f"{agent}, last quarter" for agent in AGENTS),
        "ratio to los-beam by seed",
        "least of a window",
    )
    text = table(head, rows)
    if args.policy:
        print(text)
        head = ("agent", *kinds, *(f"{name}, last quarter" for name in kinds))
        text = table(head, by_agent(rates, agents, kinds))
    print(text)
    if args.markdown:
        args.markdown.write_text(f"# Learner\n\n{text}\n")
    if args.picture:
        draw(curves, agents, args.picture, f"{args.scenario}, {args.seeds} seeds, means of {WINDOW} frames")


if __name__ == "__main__":
    main()
