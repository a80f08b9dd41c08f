"""Episodes that no policy was trained on: policies play the same frames one after the other, as arrays.

Where the environment computes many episodes at once, or recorded ones, this is far quicker than a contest
(`caviar_clients.learning.contest`), which takes any scenario and any agent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from caviar_clients.envs.vector import BeamSelectionVectorEnv
from caviar_clients.learning.recorded import RecordedBeamsVectorEnv
from caviar_protocol.arrays import BoolArray, Float64Array
from caviar_services.agent.policy import PolicyModel

OBSERVED = ("aod", "departure", "position", "last_beam", "last_rate")
"""What policies may observe here."""
KINDS = ("all", "LOS", "NLOS")


@dataclass(eq=False)
class Episodes:
    """Episodes, their frames, and what agents achieved in them; Shape ``[E, T]`` unless it is said.

    Made by `batch_episodes` and `recorded_episodes`; `play` fills it.
    """

    envs: Any
    """A vector environment, a member for each episode."""
    reset: dict[str, Any]
    """Arguments of its ``reset``."""
    period_s: float
    """Between frames."""
    angle_deg: Float64Array = field(default_factory=lambda: np.zeros((0, 0)))
    """Azimuth of the UAV seen from the base station, in its axes."""
    has_path: BoolArray = field(default_factory=lambda: np.zeros((0, 0), np.bool_))
    los: BoolArray = field(default_factory=lambda: np.zeros((0, 0), np.bool_))
    optimum: Float64Array = field(default_factory=lambda: np.zeros((0, 0)))
    """|y| of the best beam."""
    los_beam: Float64Array = field(default_factory=lambda: np.zeros((0, 0)))
    """|y| of the beam along the straight line."""
    chosen: dict[str, list[Float64Array]] = field(default_factory=dict)
    """|y| of the beams that policies chose, by agent, an entry for each policy."""

    def play(self, agent: str, file: Path) -> None:
        """Play all episodes with a policy.

        Args:
            agent: Which its |y| goes to.
            file: ONNX file of the policy.

        Raises:
            ScenarioError: The file is no policy.
        """
        model, rows = PolicyModel(file, f"policy {file}"), []
        observation, _ = self.envs.reset(**self.reset)
        over = np.zeros(self.envs.num_envs, np.bool_)
        while not over.all():
            angle = np.degrees(observation["aod"].reshape(len(over)))
            beams = [
                model.act({name: part[member] for name, part in observation.items()})[0]
                for member in range(len(over))
            ]
            observation, _, _, over, info = self.envs.step(np.array(beams))
            columns = ("abs_y", "baseline_abs_y", "best_abs_y", "los")
            rows.append([angle, *(np.asarray(info[name], np.float64).reshape(-1) for name in columns)])
        self.angle_deg, abs_y, self.los_beam, self.optimum, los = np.array(rows).transpose(1, 2, 0)
        self.has_path = self.optimum > 0
        self.los = self.has_path & (los > 0)
        self.chosen.setdefault(agent, []).append(abs_y)

    def close(self) -> None:
        """End the environments; what was played stays."""
        self.envs.close()

    def frames(self, kind: str) -> BoolArray:
        """Frames with a path of a kind: ``all``, ``LOS`` or ``NLOS``.

        Args:
            kind: One of `KINDS`.
        """
        if kind == "all":
            return self.has_path
        return self.los if kind == "LOS" else self.has_path & ~self.los

    def means(self, method: str, kind: str) -> list[float]:
        """Mean |y| over frames of a kind, an entry for each policy.

        Args:
            method: An agent, ``los-beam`` or ``optimum``, which have one entry.
            kind: One of `KINDS`.
        """
        values = {"los-beam": [self.los_beam], "optimum": [self.optimum]}.get(method) or self.chosen[method]
        mine = self.frames(kind)
        return [float(of[mine].mean()) if mine.any() else float("nan") for of in values]


def batch_episodes(scenario: str | Path, episodes: int, first_seed: int) -> Episodes:
    """Episodes of a scenario that is computed for many at once.

    Args:
        scenario: Name or file.
        episodes: How many, E.
        first_seed: Of the first; the others have those after it.

    Example:
        >>> found = batch_episodes("geometric", episodes=2, first_seed=1000)
        >>> found.period_s
        0.1
        >>> found.close()
    """
    envs = BeamSelectionVectorEnv(episodes, scenario, observe=OBSERVED)
    return Episodes(envs, {"seed": first_seed}, envs.single.scenario.run.sampling_period_ns * 1e-9)


def recorded_episodes(recording: Path, users: Sequence[str]) -> Episodes:
    """Recorded users, each an episode; all were there in as many frames.

    Args:
        recording: Directory of a run.
        users: Names of their receivers, in the order of the episodes.

    Raises:
        ScenarioError: The recording has none of these users.
        RecordingError: The recording cannot be read.
    """
    envs = RecordedBeamsVectorEnv(len(users), [recording], OBSERVED, users=users, normalization="unit")
    found = [track.user[1] for track in envs.tracks.tracks]
    tracks = sorted(range(len(found)), key=lambda index: users.index(found[index]))
    period_s = envs.tracks.scenario.run.sampling_period_ns * 1e-9
    return Episodes(envs, {"seed": 0, "options": {"tracks": tracks}}, period_s)
