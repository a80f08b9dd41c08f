"""``caviar/UavPath-v0``: fly an object, and the radio channel follows. `uav_path_v1` replaces it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from caviar_clients.envs.base import Observation
from caviar_clients.envs.flight import FlightEnv, point
from caviar_clients.envs.observations import FAR, Moment
from caviar_protocol.errors import ScenarioError
from caviar_protocol.space.coordinates import Vector


class UavPathEnv(FlightEnv):
    """A flight with a reward of |y| and of metres; the radio is 5·10⁻⁵ of it beside 0.75 for the way, so
    that hardly any learner hears it. `uav_path_v1.UavPathV1Env` has parts of comparable size.

    Parameters as `FlightEnv`, and:

    Parameters
    ----------
    goal_m
        Where to fly [m]; the episode terminates when it is reached. The observation has ``goal`` then, the
        way that is left [m], Shape ``[3]``. None: there is none.
    reach_m
        Distance at which the goal is reached [m].
    progress_weight
        Reward for each metre that the goal has come nearer, beside that of the link.
    """

    def __init__(
        self,
        scenario: str | Path,
        vehicle: str | None = None,
        goal_m: Sequence[float] | None = None,
        reach_m: float = 2.0,
        progress_weight: float = 0.1,
        observe: Sequence[str] = ("position", "velocity", "last_abs_y"),
        **options: Any,
    ) -> None:
        super().__init__(scenario, vehicle, observe=observe, **options)
        self._goal: Vector | None = None
        if goal_m is not None:
            self._goal = point(goal_m)
            if self._goal is None:
                raise ScenarioError(f"goal_m={goal_m!r} is no point; write three finite numbers, x, y, z [m]")
            way = {"goal": spaces.Box(-FAR, FAR, (3,), np.float32)}
            self.observation_space = spaces.Dict({**self.observation_space.spaces, **way})
        self._reach, self._progress_weight = reach_m, progress_weight

    def _way(self, moment: Moment) -> NDArray[np.float64]:
        """What is left to the goal [m], Shape ``[3]``."""
        way: NDArray[np.float64] = np.asarray(self._goal) - self._position(moment)
        return way

    def _observation(self, moment: Moment) -> Observation:
        found = super()._observation(moment)
        if self._goal is not None:
            found["goal"] = self._way(moment).astype(np.float32)
        return found

    def _further_reward(self, before: Moment, now: Moment) -> float:
        if self._goal is None:
            return 0.0
        nearer = np.linalg.norm(self._way(before)) - np.linalg.norm(self._way(now))
        return self._progress_weight * float(nearer)

    def _terminated(self, moment: Moment) -> bool:
        return self._goal is not None and bool(np.linalg.norm(self._way(moment)) <= self._reach)
