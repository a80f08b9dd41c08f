"""``caviar/UavPath-v0``: fly an object, and the radio channel follows (`uav_path_v1` replaces it).

`FlightEnv` holds what both versions share: the vehicle, its command, and beams that follow it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from caviar_clients.envs.base import Moment, Observation, SessionEnv
from caviar_protocol.errors import PayloadError, ScenarioError
from caviar_protocol.observations import FAR
from caviar_protocol.scenario.schema import owned_by
from caviar_protocol.space.beams import straight_beams
from caviar_protocol.space.coordinates import Vector
from caviar_protocol.space.scene import directions
from caviar_protocol.topics import BeamChoice, VelocityCommand
from caviar_protocol.topics.link import Command

MOTION = "motion:"
ROUNDING = 1e-6
"""Beyond ±1 an action is taken so far: float32 rounds."""


class FlightEnv(SessionEnv[NDArray[np.float32]]):
    """Trajectory control in the loop (contract, clause 3; world ``flight``).

    The action is a velocity over the object's greatest speed, in world axes, Shape ``[3]``, each within
    ±1; one longer than 1, as the corners of that box are, is shortened to 1. The world bounds acceleration
    too, and keeps the object clear of buildings. Beams of receivers that the agent owns beside the motion
    point along the straight line.

    Args:
        scenario: Scenario file, or the name of a scenario that ships.
        vehicle: Name of the flown object; None: the only one.
        options: The other arguments of `SessionEnv`.

    Raises:
        ScenarioError: The scenario has no such object, or the agent does not own its motion.
    """

    refuses_outside: ClassVar[bool] = True
    """Whether an action beyond ±1 is refused, or shortened like one within."""

    def __init__(self, scenario: str | Path, vehicle: str | None, **options: Any) -> None:
        super().__init__(scenario, **options)
        self.vehicle, self._flown = self._flown_object(vehicle)
        self._max_speed = float(self._flown["max_speed_m_s"])
        self._steered = self._receivers_of_agent()
        self.action_space = spaces.Box(-1.0, 1.0, (3,), np.float32)

    def _flown_object(self, vehicle: str | None) -> tuple[str, dict[str, Any]]:
        """Name of the object in the run, and its settings."""
        # Of several worlds each has a prefix for the names of its objects.
        worlds = [spec.settings for spec in self.scenario.services.values() if spec.role == "world"]
        found = {
            str(settings.get("prefix") or "") + thing["name"]: thing
            for settings in worlds
            for thing in settings.get("flown", ())
        }
        names = ", ".join(found) or "none; use a world 'flight' with [[services.<world>.settings.flown]]"
        if vehicle is None and len(found) == 1:
            vehicle = next(iter(found))
        if vehicle is None or vehicle not in found:
            raise ScenarioError(f"vehicle={vehicle!r} is no flown object of the scenario; there are: {names}")
        return vehicle, found[vehicle]

    def _receivers_of_agent(self) -> tuple[str, ...]:
        """Patterns of the receivers whose beams the agent owns."""
        # Without `users` an agent owns every actuator of the run (contract, clause 17).
        users = self.scenario.services[self.agent].users or ("*",)
        if users != ("*",) and not owned_by(
            (u for u in users if u.startswith(MOTION)), MOTION + self.vehicle
        ):
            raise ScenarioError(
                f"agent {self.agent!r} owns {', '.join(users)}; add 'motion:{self.vehicle}' to its users"
            )
        return tuple(text.removeprefix("beam:") for text in users if not text.startswith(MOTION))

    def _commands(self, action: NDArray[np.float32], moment: Moment) -> Sequence[Command]:
        share = point(action)
        if share is None or (self.refuses_outside and max(map(abs, share)) > 1.0 + ROUNDING):
            text = " ".join(repr(action).split())
            raise PayloadError(
                f"the action is {text}; write three numbers within -1 and 1: the velocity east, north and up "
                f"over {self._max_speed:g} m/s"
            )
        x, y, z = share
        # The corners of the box of actions are √3 long; the object flies at its greatest speed there.
        speed = self._max_speed / max(1.0, math.hypot(x, y, z))
        flight = VelocityCommand(object=self.vehicle, velocity=(x * speed, y * speed, z * speed))
        return [*self._beams(moment), flight]

    def _beams(self, moment: Moment) -> list[BeamChoice]:
        """Beams along the straight line, of the receivers that the agent owns."""
        pairs = [pair for _, pair in moment.users if owned_by(self._steered, pair.rx.name)]
        at_tx, at_rx = directions(moment.scene, pairs)
        choices = []
        for pair, towards_rx, towards_tx in zip(pairs, at_tx, at_rx, strict=True):
            tx_beam, rx_beam = straight_beams(pair.tx.array, towards_rx, pair.rx.array, towards_tx)
            choices.append(BeamChoice(tx=pair.tx.name, rx=pair.rx.name, tx_beam=tx_beam, rx_beam=rx_beam))
        return sorted(choices, key=lambda choice: (choice.rx, choice.tx))

    def _position(self, moment: Moment) -> NDArray[np.float64]:
        """Where the object is [m], Shape ``[3]``."""
        position: NDArray[np.float64] = moment.scene.position[moment.scene.names.index(self.vehicle)]
        return position


def point(numbers: Any) -> Vector | None:
    """Read a point, or another vector of three numbers.

    Returns:
        Three finite numbers; None where it is something else.

    Example:
        >>> point([1, 2, 3.5]), point("here")
        ((1.0, 2.0, 3.5), None)
    """
    try:
        found = np.asarray(numbers, np.float64)
    except (TypeError, ValueError):
        return None
    if found.shape != (3,) or not np.isfinite(found).all():
        return None
    x, y, z = found.tolist()
    return x, y, z


class UavPathEnv(FlightEnv):
    """Fly to a goal, rewarded by |y| and by metres: ``caviar/UavPath-v0``.

    The radio is 5·10⁻⁵ of the reward beside 0.75 for the way, so that hardly any learner hears it.
    `uav_path_v1.UavPathV1Env` has parts of comparable size. This one is kept for what was learned in it, so
    that an action beyond ±1 is shortened here, too.

    Args:
        scenario, vehicle, options: As of `FlightEnv`.
        goal_m: Where to fly [m]; the episode terminates when it is reached. The observation has ``goal``
            then, the way that is left [m], Shape ``[3]``. None: there is none.
        reach_m: Distance at which the goal is reached [m].
        progress_weight: Reward for each metre that the goal has come nearer, beside that of the link [1/m].
        observe: Parts of the observation, as of `SessionEnv`.

    Raises:
        ScenarioError: An argument is wrong; the text has value and remedy.

    Example:
        >>> env = UavPathEnv("uav-path", goal_m=(60.0, 40.0, 30.0))
        >>> sorted(env.observation_space.spaces)
        ['goal', 'last_abs_y', 'position', 'velocity']
    """

    refuses_outside = False

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
        """The way that is left to the goal [m], Shape ``[3]``."""
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
        # Over an episode the differences sum up to the way from start to end, whatever path is flown.
        nearer = np.linalg.norm(self._way(before)) - np.linalg.norm(self._way(now))
        return self._progress_weight * float(nearer)

    def _terminated(self, moment: Moment) -> bool:
        return self._goal is not None and bool(np.linalg.norm(self._way(moment)) <= self._reach)
