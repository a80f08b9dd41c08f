"""Policies as the agent ``policy`` serves them: whether their pairs of beams are those of the offline
evaluation, and the time from GRANT to DONE, features included.

Run as ``python tests/bench/bench_served.py POLICY… [--scenario district] [--frames 1000] [--set KEY=VALUE]
[--markdown FILE]``: for each policy a run with every service a process of its own, as `caviar run` starts
them, with the transmitters of the policy's card. What was recorded is then ranked as ``caviar policy evaluate
--on`` ranks a dataset. The broker takes the times. Beside them stand the processor time of reading, observing
and choosing again, which other programs change little, and the load of the machine in the last minute of the
run. ``--set services.channel.use=free-space --set services.channel.settings={}`` makes a thousand scenes in
minutes; policies that observe nothing of the link choose the same.
"""

# ruff: noqa: T201 - a command that prints what it measured

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import msgspec
import numpy as np
from msgspec.structs import replace
from policy_files import for_policy

from caviar_clients.datasets.reader import Dataset
from caviar_clients.learning.dataset_evaluation import method_name
from caviar_clients.learning.ranking_methods import ranked_by_policy
from caviar_clients.learning.samples import Selection, read_samples
from caviar_clients.replay.plan import scenario_text
from caviar_protocol.observations import Moment, Observer, Users
from caviar_protocol.recording import Recording
from caviar_protocol.run_directory import RunDirectory
from caviar_protocol.scenario import Scenario, load_scenario
from caviar_protocol.spec import table
from caviar_protocol.topics import Link
from caviar_services.agent.policy import PolicyModel

WARM_UP = 20
"""Frames whose times do not count."""


class RunAsDataset:
    """What `read_samples` reads of a dataset, of a run: its recording is the one episode."""

    episodes = (0,)

    def __init__(self, scenario: Scenario, folder: Path) -> None:
        self.location, self._recording = str(folder), Recording(folder)
        self.settings = {"scenario": msgspec.to_builtins(scenario)}

    def table(self, name: str) -> dict[str, Any]:
        """Number of scenes of the episode."""
        return {"scenes": np.array([sum(1 for _ in self._recording.frames())])}

    def episode(self, number: int) -> Recording:
        """The recording."""
        return self._recording


def served(scenario: Scenario, folder: Path, settings: Sequence[str]) -> tuple[Path, np.ndarray]:
    """Directory of a run, and the agent's times [ms]."""
    file = folder / "scenario.toml"
    file.write_text(scenario_text(scenario))
    command = [sys.executable, "-m", "caviar_clients", "run", str(file), "--out", str(folder / "runs")]
    command += [part for setting in settings for part in ("--set", setting)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    (directory,) = (folder / "runs").glob("*/")
    with np.load(RunDirectory(directory).latencies) as found:
        return directory, found["latency_ns/agent"][WARM_UP:] / 1e6


def equal_pairs(model: PolicyModel, scenario: Scenario, folder: Path) -> tuple[int, int, int]:
    """Observations that were compared, those with equal pairs, and different pairs among them."""
    assert model.card is not None
    run = cast(Dataset, RunAsDataset(scenario, folder))
    samples = read_samples(run, tuple(model.inputs), Selection(transmitters=model.card.transmitters))
    offline = ranked_by_policy(model, samples, "policy").order[:, 0]
    chosen = []
    for frame in Recording(folder).frames():
        (link,) = frame.payloads("link", Link).values()
        chosen.append(link.tx_beam * samples.beams[1] + link.rx_beam)
    pairs = np.concatenate(chosen)
    assert pairs.shape == offline.shape, (pairs.shape, offline.shape)
    return len(pairs), int((pairs == offline).sum()), len(np.unique(pairs))


def processor_times(model: PolicyModel, scenario: Scenario, folder: Path) -> list[float]:
    """Of reading each recorded frame, observing and choosing [ms]."""
    assert model.card is not None
    places = Users(scenario, ("*",), (), model.card.transmitters)
    observer = Observer(scenario, places, tuple(model.inputs))
    times = []
    for frame in Recording(folder).frames():
        begun = time.thread_time_ns()
        scene = frame.scene()
        assert scene is not None
        model.act(observer.read(Moment(frame, scene, None, places.present(scene))))
        times.append((time.thread_time_ns() - begun) / 1e6)
    return times[WARM_UP:]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("policies", nargs="+", type=Path)
    parser.add_argument("--scenario", default="district")
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--set", action="append", default=[], help="KEY=VALUE of the scenario")
    parser.add_argument("--markdown", type=Path, help="write the table of the documentation there")
    args = parser.parse_args()
    rows = []
    for file in args.policies:
        model = PolicyModel(file)
        base = for_policy(load_scenario(args.scenario), model)
        grid = ("lidar.grid",) if "lidar" in base.services else ()
        topics = ("scene", "channel", "link", *grid)
        agent = replace(base.services["agent"], use="policy", settings={"file": f"file:{file.resolve()}"})
        run = replace(base.run, record=topics, frames=args.frames, episodes=1)
        scenario = replace(base, run=run, services={**base.services, "agent": agent})
        with TemporaryDirectory(prefix="caviar-served-") as name:
            directory, times = served(scenario, Path(name), args.set)
            load = os.getloadavg()[0]
            count, equal, pairs = equal_pairs(model, scenario, directory)
            busy = np.quantile(processor_times(model, scenario, directory), 0.99)
        median, p99 = np.quantile(times, (0.5, 0.99))
        counts = (f"{count:,}", f"{equal:,}", f"{pairs}")
        figures = (f"{value:.2f}" for value in (median, p99, busy))
        rows.append((method_name(file), *counts, *figures, f"{load:.1f}"))
        print(*rows[-1], flush=True)
    times_head = ("median, ms", "99 %, ms", "processor time, 99 %, ms", "load")
    head = ("policy", "observations", "equal", "pairs served", *times_head)
    text = table(head, rows)
    print(text)
    if args.markdown:
        args.markdown.write_text(f"# Served\n\n{text}\n")


if __name__ == "__main__":
    main()
