"""Base of environments that fly an object: its command, and beams that follow it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from caviar_clients.envs.base import Moment, SessionEnv
from caviar_clients.session.prepared import PreparedScenario
from caviar_protocol.errors import PayloadError, ScenarioError
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

    def __init__(self, scenario: str | Path | PreparedScenario, vehicle: str | None, **options: Any) -> None:
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
        if share is None or max(map(abs, share)) > 1.0 + ROUNDING:
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
