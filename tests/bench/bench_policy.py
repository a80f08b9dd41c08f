"""Time from GRANT to DONE of the agent ``policy``, features included, beside that of ``los-beam``.

Run as ``python tests/bench/bench_policy.py [--frames 2000] [--rounds 3] [--markdown FILE]``. Scenario
``geometric`` with every service a process of its own, as `caviar run` starts them; the policy is a perceptron
with two hidden layers that observes the angle of departure, the position and the last beam and rate. The
broker takes the times; quantiles are those of the round with the median p99.
"""

# ruff: noqa: T201 - a command that prints what it measured

from __future__ import annotations

import argparse
import subprocess
import sys
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from policy_files import perceptron_policy, scenario_with

from caviar_protocol.run_directory import RunDirectory
from caviar_protocol.spec import table

WARM_UP = 50
"""Frames that do not count."""
QUANTILES = (0.5, 0.95, 0.99)


PACES = {"free": "as fast as it goes", "10": "100 frames/s"}
"""What ``--pace`` is, and what the table calls it; a frame of the scenario lasts 100 ms."""


def measured(scenario: Path, out: Path, pace: str) -> list[float]:
    """Quantiles of the agent's times [ms] in one run."""
    command = [sys.executable, "-m", "caviar_clients", "run", str(scenario), "--out", str(out)]
    command += ["--pace", pace]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    (directory,) = out.glob("*/")
    with np.load(RunDirectory(directory).latencies) as found:
        times = found["latency_ns/agent"][WARM_UP:] / 1e6
    return [float(value) for value in np.quantile(times, QUANTILES)]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--markdown", type=Path, help="write the table of the documentation there")
    args = parser.parse_args()
    found: dict[tuple[str, str], list[list[float]]] = {}
    with TemporaryDirectory(prefix="caviar-policy-") as name:
        folder = Path(name)
        perceptron_policy(folder / "policy.onnx")
        served = scenario_with(folder, "policy.onnx", args.frames)
        plain = folder / "plain.toml"
        served_by = 'use = "policy"\nsettings.file = "file:policy.onnx"'
        plain.write_text(served.read_text().replace(served_by, 'use = "los-beam"'))
        cases = {"`policy`, 64-64": served, "`los-beam`": plain}
        for number in range(args.rounds):
            for (called, scenario), pace in product(cases.items(), PACES):
                times = measured(scenario, folder / f"{number}-{scenario.stem}-{pace}", pace)
                found.setdefault((called, PACES[pace]), []).append(times)
                print(called, PACES[pace], ", ".join(f"{value:.2f} ms" for value in times))
    rows = []
    for names, rounds in found.items():
        middle = sorted(rounds, key=lambda times: times[-1])[len(rounds) // 2]
        rows.append([*names, *(f"{value:.2f}" for value in middle)])
    text = table(("GRANT to DONE, ms", "pace", "median", "95 %", "99 %"), rows)
    print(text)
    if args.markdown:
        args.markdown.write_text(text + "\n")


if __name__ == "__main__":
    main()
