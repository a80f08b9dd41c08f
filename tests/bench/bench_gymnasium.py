"""Steps a second of `caviar/BeamSelection-v0` in one process, beside those of a trivial environment.

Run as ``python tests/bench/bench_gymnasium.py [--json FILE]``. ``geometric`` is the scenario of that name;
``siso-rt`` is ``street-canyon``, of which no service asks for the LIDAR. CartPole, of gymnasium, says how
fast the machine is at the moment. The three take turns, and the median of all turns counts.
"""

# ruff: noqa: T201 - a command that prints what it measured

from __future__ import annotations

import argparse
import json
import statistics
import time
from pathlib import Path
from typing import Any

import gymnasium

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


def beam_selection(scenario: str) -> gymnasium.Env[Any, Any]:
    """The environment with one of the shipped scenarios."""
    file = SCENARIOS / f"{scenario}.toml"
    return gymnasium.make("caviar/BeamSelection-v0", scenario=file, disable_env_checker=True)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--turns", type=int, default=9, help="of each environment")
    parser.add_argument("--json", type=Path, help="where the figures are written too")
    options = parser.parse_args()
    environments = {
        "cartpole": (gymnasium.make("CartPole-v1", disable_env_checker=True), 5000),
        "geometric": (beam_selection("geometric"), 2000),
        "siso-rt": (beam_selection("street-canyon"), 20),
    }
    for env, count in environments.values():
        env.reset(seed=1)
        steps_per_second(env, count // 4)  # kernels and caches
    measured: dict[str, list[float]] = {name: [] for name in environments}
    for _ in range(options.turns):
        for name, (env, count) in environments.items():
            measured[name].append(steps_per_second(env, count))
    figures = {name: statistics.median(turns) for name, turns in measured.items()}
    for name, rate in figures.items():
        spread = f"{min(measured[name]):,.4g} to {max(measured[name]):,.4g}"
        print(f"{name:10} {rate:10,.4g} steps/s ({spread}), {rate / figures['cartpole']:.3g} of CartPole's")
    for env, _ in environments.values():
        env.close()
    if options.json:
        options.json.write_text(json.dumps({"steps_per_second": figures, "turns": measured}, indent=2) + "\n")


if __name__ == "__main__":
    main()
