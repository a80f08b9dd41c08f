"""Steps a second of `caviar/BeamSelection-v0` in one process, beside those of a trivial environment.

Run as ``python tests/bench/bench_gymnasium.py [--vector 64] [--json FILE]``. ``geometric`` is the scenario of
that name; ``siso-rt`` is ``street-canyon``, of which no service asks for the LIDAR. CartPole, of gymnasium,
says how fast the machine is at the moment. With ``--vector``, ``geometric xN`` are so many members of
``gymnasium.make_vec``, whose steps count N times, and ``siso-rt`` is left out. All take turns, and the median
of all turns counts.
"""

# ruff: noqa: T201 - a command that prints what it measured

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
from gymnasium.vector import VectorEnv

import caviar_clients.envs

gymnasium.register_envs(caviar_clients.envs)

SCENARIOS = Path(__file__).resolve().parents[2] / "deploy" / "caviar_scenarios"


def steps_per_second(env: gymnasium.Env[Any, Any], count: int) -> float:
    """Steps a second with random actions, episodes that end included."""
    actions = [env.action_space.sample() for _ in range(count)]
    began = time.perf_counter()
    for action in actions:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()
    return count / (time.perf_counter() - began)


def member_steps_per_second(envs: VectorEnv[Any, Any, Any], count: int) -> float:
    """Steps of all members a second with random actions, episodes that end included."""
    actions = [envs.action_space.sample() for _ in range(count)]
    began = time.perf_counter()
    for action in actions:
        envs.step(action)
    return count * envs.num_envs / (time.perf_counter() - began)


def beam_selection(scenario: str) -> gymnasium.Env[Any, Any]:
    """The environment with one of the shipped scenarios."""
    file = SCENARIOS / f"{scenario}.toml"
    return gymnasium.make("caviar/BeamSelection-v0", scenario=file, disable_env_checker=True)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--turns", type=int, default=9, help="of each environment")
    parser.add_argument("--vector", type=int, default=0, help="members of a vector environment beside them")
    parser.add_argument("--json", type=Path, help="where the figures are written too")
    options = parser.parse_args()
    measures: dict[str, tuple[Callable[[Any, int], float], Any, int]] = {
        "cartpole": (steps_per_second, gymnasium.make("CartPole-v1", disable_env_checker=True), 5000),
        "geometric": (steps_per_second, beam_selection("geometric"), 2000),
    }
    if options.vector:
        file, members = SCENARIOS / "geometric.toml", options.vector
        envs = gymnasium.make_vec("caviar/BeamSelection-v0", num_envs=members, scenario=file)
        measures[f"geometric x{members}"] = member_steps_per_second, envs, 2000
    else:
        measures["siso-rt"] = steps_per_second, beam_selection("street-canyon"), 20
    for measure, env, count in measures.values():
        env.reset(seed=1)
        measure(env, count // 4)  # kernels and caches
    measured: dict[str, list[float]] = {name: [] for name in measures}
    for _ in range(options.turns):
        for name, (measure, env, count) in measures.items():
            measured[name].append(measure(env, count))
    figures = {name: statistics.median(turns) for name, turns in measured.items()}
    width = max(map(len, figures))
    for name, rate in figures.items():
        spread = f"{min(measured[name]):,.4g} to {max(measured[name]):,.4g}"
        share = f"{rate / figures['cartpole']:.3g} of CartPole's"
        print(f"{name:{width}} {rate:10,.4g} steps/s ({spread}), {share}")
    if options.vector:
        ratio = figures[f"geometric x{options.vector}"] / figures["geometric"]
        print(f"{options.vector} members take {ratio:.3g} times the steps of one environment")
    for _, env, _ in measures.values():
        env.close()
    if options.json:
        options.json.write_text(json.dumps({"steps_per_second": figures, "turns": measured}, indent=2) + "\n")


if __name__ == "__main__":
    main()
