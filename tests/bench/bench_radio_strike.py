"""Steps a second of `caviar/RadioStrike-v0`, one environment and a vector of them, also beside the original.

Run as ``python tests/bench/bench_radio_strike.py [--original FOLDER] [--json FILE] [--markdown FILE]``.
FOLDER is a checkout of the challenge's code (github.com/lasseufpa/ITU-Challenge-ML5G-PHY-RL): then the
original takes turns with the others, and the rewards of ``legacy`` are held against its own. Of what it
imports without using it (AirSim, pandas, the spaces of gym) there are empty modules here. CartPole, of
gymnasium, says how fast the machine is at the moment. All take turns, and the median of the turns counts.
"""

# ruff: noqa: T201 - a command that prints what it measured

from __future__ import annotations

import argparse
import csv
import json
import os
import statistics
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import chdir
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode

import caviar_clients.envs
from caviar_labs.radio_strike.env import RadioStrikeEnv
from caviar_labs.radio_strike.rules import USERS
from caviar_labs.radio_strike.sources import synthetic_episode

gymnasium.register_envs(caviar_clients.envs)

Turn = Callable[[], float]
"""Plays for a while, and returns steps a second."""


def single(env: gymnasium.Env[Any, Any], count: int) -> Turn:
    """Turns of one environment with random actions."""
    actions = [env.action_space.sample() for _ in range(count)]
    env.reset(seed=1)

    def turn() -> float:
        began = time.perf_counter()
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()
        return count / (time.perf_counter() - began)

    return turn


def vector(rules: str, members: int, count: int) -> Turn:
    """Turns of a vector; steps of all members count, and resets take place within them."""
    envs = gymnasium.make_vec(
        "caviar/RadioStrike-v0", num_envs=members, rules=rules, autoreset_mode=AutoresetMode.SAME_STEP
    )
    actions = [envs.action_space.sample() for _ in range(count)]
    envs.reset(seed=1)

    def turn() -> float:
        began = time.perf_counter()
        for action in actions:
            envs.step(action)
        return count * members / (time.perf_counter() - began)

    return turn


# --- the original -------------------------------------------------------------------------------------------


def write_episode(folder: Path) -> None:
    """Write a made-up flight as the original reads it."""
    columns = ["timestamp", "obj", *(f"pos_{axis}" for axis in "xyz"), *(f"orien_{axis}" for axis in "xyzw")]
    columns += [
        f"{kind}_{of}_{axis}" for kind in ("linear", "angular") for of in ("acc", "vel") for axis in "xyz"
    ]
    folder.mkdir()
    with (folder / "ep0.csv").open("w", newline="") as text:
        writer = csv.writer(text)
        writer.writerow(columns)
        for step, places in enumerate(synthetic_episode(0).position.tolist()):
            for name, place in zip(USERS, places, strict=True):
                writer.writerow([step * 10_000_000, name, *place, *[0] * 16])


def original(checkout: Path) -> Any:
    """Make the environment of the original, in a folder with ``episodes/ep0.csv``."""
    for name in ("airsim", "pandas", "gym", "gym.spaces"):
        sys.modules.setdefault(name, ModuleType(name))
    vars(sys.modules["gym"])["Env"] = object
    nothing = {"Box": lambda **_: None, "MultiDiscrete": lambda *_: None}
    vars(sys.modules["gym.spaces"]).update(nothing)
    if str(checkout) not in sys.path:
        sys.path.insert(0, str(checkout))
    from beamselect_env import BeamSelectionEnv  # type: ignore[import-not-found]

    return BeamSelectionEnv([0])


def greatest_difference(theirs: Any, episode: Path, count: int) -> float:
    """Greatest difference of rewards from those of the original, after the same seed."""
    ours = RadioStrikeEnv("legacy", episodes=episode)
    ours.reset(seed=7)
    np.random.seed(7)
    drawn = np.random.default_rng(1).integers([3, 64], size=(count, 2)).tolist()
    return max(abs(float(theirs.step(action)[1]) - ours.step(action)[1]) for action in drawn)


def original_turn(env: Any, count: int) -> Turn:
    """Turns of the original, which never ends by itself."""
    drawn = np.random.default_rng(2).integers([3, 64], size=(count, 2)).tolist()

    def turn() -> float:
        began = time.perf_counter()
        for action in drawn:
            env.step(action)
        return count / (time.perf_counter() - began)

    return turn


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--turns", type=int, default=9, help="of each")
    parser.add_argument("--members", type=int, default=64, help="of a vector")
    parser.add_argument("--original", type=Path, help="checkout of the original")
    parser.add_argument("--json", type=Path, help="where the figures are written too")
    parser.add_argument("--markdown", type=Path, help="where they go as a table")
    options = parser.parse_args()
    turns: dict[str, Turn] = {
        "cartpole": single(gymnasium.make("CartPole-v1", disable_env_checker=True), 5000)
    }
    for rules in ("legacy", "fixed"):
        made = gymnasium.make("caviar/RadioStrike-v0", rules=rules, disable_env_checker=True)
        turns[rules] = single(made, 1500)
        turns[f"{rules} × {options.members}"] = vector(rules, options.members, 150)
    checkout = options.original.resolve() if options.original else None
    with TemporaryDirectory() as folder, chdir(folder):
        if checkout:
            write_episode(Path("episodes"))
            worst = greatest_difference(original(checkout), Path("episodes/ep0.csv"), 10_000)
            print(f"rewards of legacy differ from the original's by at most {worst:g} in 10,000 steps")
            # 18,000 steps of a user are what the file has.
            turns["original"] = original_turn(original(checkout), min(1000, 18_000 // (options.turns + 1)))
        measured: dict[str, list[float]] = {name: [] for name in turns}
        for turn in turns.values():
            turn()  # caches
        for _ in range(options.turns):
            for name, turn in turns.items():
                measured[name].append(turn())
    figures = {name: statistics.median(rates) for name, rates in measured.items()}
    for name, rate in figures.items():
        spread = f"{min(measured[name]):,.4g} to {max(measured[name]):,.4g}"
        ratio = f", {rate / figures['original']:.3g} times the original" if checkout else ""
        share = rate / figures["cartpole"]
        print(f"{name:12} {rate:10,.4g} steps/s ({spread}), {share:.3g} of CartPole's{ratio}")
    if options.json:
        found = {"steps_per_second": figures, "turns": measured, "cores": os.cpu_count()}
        options.json.write_text(json.dumps(found, indent=2) + "\n", "utf-8")
    if options.markdown:
        options.markdown.write_text(as_markdown(figures), "utf-8")


def as_markdown(figures: Mapping[str, float]) -> str:
    """The figures as a table."""
    others = [name for name in ("original", "cartpole") if name in figures]
    lines = [["environment", "steps/s", *(f"times {name}" for name in others)], ["---"] * (2 + len(others))]
    for name, rate in figures.items():
        lines.append([name, f"{rate:,.0f}", *(f"{rate / figures[other]:.3g}" for other in others)])
    return "".join("| " + " | ".join(cells) + " |\n" for cells in lines)


if __name__ == "__main__":
    main()
