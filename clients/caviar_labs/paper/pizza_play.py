"""Episodes of ``caviar paper pizza`` in the closed loop: drone, rays and link, frame by frame."""

from __future__ import annotations

import math
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Protocol

import numpy as np

from caviar_clients.envs.deliveries import Deliveries
from caviar_clients.session.connected import open_session
from caviar_clients.session.prepared import prepare
from caviar_labs.paper.pizza_flight import Legs
from caviar_labs.paper.pizza_town import HEIGHT_M, Round
from caviar_protocol.arrays import BoolArray, Float64Array
from caviar_protocol.errors import RunError
from caviar_protocol.messages import Input
from caviar_protocol.observations import Users
from caviar_protocol.space.beams import straight_beams
from caviar_protocol.space.scene import Pair, directions
from caviar_protocol.topics import Action, BeamChoice, Link, Scene, VelocityCommand, WaypointCommand

REACH_M = 3.0
"""Distance at which an address is delivered to."""

_BRAKES_M_S2 = 3.0
"""That a way is planned with; the drone can do twice as much."""
_SLOWEST_M_S = 2.0
"""At an address, and in the sharpest turn."""
_AHEAD_S = 0.8
"""That the drone looks ahead on its way."""


class ChoosesBeams(Protocol):
    """Chooses a beam in each frame."""

    def __call__(self, place: Float64Array, scene: Scene, pair: Pair, last_beam: int, last: float) -> int:
        """Choose.

        Args:
            place: x and y of the drone [m].
            scene: Where everything is.
            pair: Base station and receiver.
            last_beam: Of the frame before, −1: none.
            last: Its spectral efficiency [bit/s/Hz].
        """


class Flies(Protocol):
    """Chooses the next address, and the way to it."""

    def __call__(self, legs: Legs, at: int, left: BoolArray) -> tuple[int, int]:
        """Choose.

        Args:
            legs: Between the places of the episode, start first.
            at: Place where the drone is.
            left: Addresses that are left.

        Returns:
            Place of the next address, from 1 on, and the kind of way.
        """


@dataclass(frozen=True, eq=False)
class Flight:
    """Course of one episode of F frames."""

    seconds: float
    """Until the last delivery, or until the episode ended without."""
    delivered: int
    order: tuple[int, ...]
    """Addresses as they were flown to, from 1 on."""
    kinds: tuple[int, ...]
    """Kinds of the ways to them."""
    places: Float64Array
    """x and y of the drone [m], Shape ``[F, 2]``."""
    efficiency: Float64Array
    """[bit/s/Hz], Shape ``[F]``."""
    los: BoolArray
    """Whether the line of sight was free, Shape ``[F]``."""
    straight: BoolArray
    """Whether the beam was as good as the one along the straight line, Shape ``[F]``."""


class Course:
    """Follows a way: as fast as its turns allow, and slowly over its end.

    Args:
        way: Its turns [m], Shape ``[N, 2]``.
        speed_m_s: Greatest speed.

    Example:
        >>> course = Course(np.array([[0.0, 0.0], [40.0, 0.0]]), 8.0)
        >>> [course.velocity(np.array([x, 0.0]))[0].round(1).item() for x in (2.0, 16.0, 30.0, 39.0)]
        [8.0, 8.0, 8.0, 3.2]
    """

    def __init__(self, way: Float64Array, speed_m_s: float) -> None:
        self._way, self._speed = way, speed_m_s
        self._steps = np.diff(way, axis=0)
        self._lengths = np.concatenate([[0.0], np.linalg.norm(self._steps, axis=1).cumsum()])
        headings = np.arctan2(self._steps[:, 1], self._steps[:, 0])
        turns = np.abs((np.diff(headings) + np.pi) % (2 * np.pi) - np.pi)
        # So fast that the velocity changes by no more than what one second of braking changes.
        allowed = _BRAKES_M_S2 / (2 * np.maximum(np.sin(turns / 2), 1e-9))
        self._allowed = np.append(np.clip(allowed, _SLOWEST_M_S, speed_m_s), _SLOWEST_M_S)
        self._flown = 0.0

    def velocity(self, place: Float64Array) -> Float64Array:
        """Give the velocity [m/s] to fly with from a place."""
        # The nearest point of the way, from where the drone was on: ways may cross themselves.
        candidates = np.linspace(self._flown, min(self._flown + 2 * self._speed, self._lengths[-1]), 81)
        away = np.linalg.norm(self._at(candidates) - place, axis=1)
        self._flown = float(candidates[away.argmin()])
        to_turns = self._lengths[1:] - self._flown
        coming = to_turns >= 0
        bounds = np.sqrt(self._allowed[coming] ** 2 + 2 * _BRAKES_M_S2 * to_turns[coming])
        speed = min(self._speed, float(bounds.min(initial=self._speed)))
        ahead = self._at(np.array([self._flown + max(1.0, _AHEAD_S * speed)]))[0] - place
        found: Float64Array = ahead * (speed / max(float(np.linalg.norm(ahead)), 1e-9))
        return found

    def _at(self, lengths: Float64Array) -> Float64Array:
        return np.stack([np.interp(lengths, self._lengths, axis) for axis in self._way.T], axis=1)


class Loop(AbstractContextManager["Loop"]):
    """The co-simulation, which episodes are played in one after the other, in place of both of its agents.

    Args:
        scenario: The experiment's: one flown object with a receiver, one transmitter, and the agents
            ``pilot`` and ``beams``.
    """

    def __init__(self, scenario: str | Path) -> None:
        prepared = prepare(Path(scenario))
        described = prepared.scenario
        flown = described.services["world"].settings["flown"][0]
        self._drone, self._speed = str(flown["name"]), float(flown["max_speed_m_s"])
        self.frame_s = described.run.sampling_period_ns / 1e9
        """Duration of a frame."""
        self.bandwidth_hz = described.carriers[0].bandwidth_hz
        wanted = (Input(topic="scene"), Input(topic="link", lag=1, required=False))
        self._session = open_session(prepared, "pilot", wanted, beside=("beams",))
        self._users = Users(described, ("*",))

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._session.close()

    def fly(self, asked: Round, legs: Legs, flies: Flies, chooses: ChoosesBeams) -> Flight:
        """Play an episode.

        Args:
            asked: Start and addresses.
            legs: The ways between them.
            flies: Chooses the next address and the way to it.
            chooses: Chooses the beams.

        Returns:
            What became of it.
        """
        points = [(x, y, HEIGHT_M) for x, y in asked.places.tolist()]
        deliveries = Deliveries(points[1:], REACH_M)
        self._session.reset(asked.seed)
        start = WaypointCommand(object=self._drone, position=points[0], speed=self._speed, at_once=True)
        frame = self._session.step({"action": Action(commands=(start,))})
        at, target = 0, 0
        order, kinds, course = list[int](), list[int](), Course(asked.places[[0, 0]], self._speed)
        seen, last = list[_Seen](), _NOTHING
        while not (frame.final or deliveries.is_done):
            scene = frame.scene()
            x, y, _ = scene.position[scene.names.index(self._drone)].tolist()
            place = np.array([x, y])
            left = ~np.array(deliveries.delivered)
            if not target or not left[target - 1]:
                target, kind = flies(legs, at, left)
                course = Course(legs.found[kind].way(at, target), self._speed)
                order.append(target)
                kinds.append(kind)
                at = target
            ((_, pair),) = self._users.present(scene)
            beam = chooses(place, scene, pair, last.beam, last.efficiency)
            vx, vy = course.velocity(place).tolist()
            frame = self._session.step(
                {"action": Action(commands=(VelocityCommand(object=self._drone, velocity=(vx, vy, 0.0)),))},
                {"beams": {"action": Action(commands=(_choice(pair, beam),))}},
            )
            last = _seen(place, beam, frame.only("link", Link))
            seen.append(last)
            if not frame.final:
                scene = frame.scene()
                x, y, z = scene.position[scene.names.index(self._drone)].tolist()
                deliveries.deliver((x, y, z))
        return Flight(
            seconds=len(seen) * self.frame_s,
            delivered=sum(deliveries.delivered),
            order=tuple(order),
            kinds=tuple(kinds),
            places=np.array([one.place for one in seen]),
            efficiency=np.array([one.efficiency for one in seen]),
            los=np.array([one.los for one in seen]),
            straight=np.array([one.straight for one in seen]),
        )


@dataclass(frozen=True, eq=False)
class _Seen:
    """Record of a frame."""

    place: Float64Array
    beam: int
    efficiency: float
    los: bool
    straight: bool


_NOTHING = _Seen(np.zeros(2), -1, 0.0, False, False)


def _seen(place: Float64Array, beam: int, link: Link | None) -> _Seen:
    if link is None or not len(link.rx):
        raise RunError("the link of a frame is missing; the scenario needs a link and a receiver")
    return _Seen(
        place,
        beam,
        float(link.spectral_efficiency[0]),
        bool(link.los[0]),
        math.isclose(float(link.abs_y[0]), float(link.baseline_abs_y[0]), rel_tol=1e-9),
    )


def _choice(pair: Pair, beam: int) -> BeamChoice:
    return BeamChoice(tx=pair.tx.name, rx=pair.rx.name, tx_beam=beam, rx_beam=0)


def straight(place: Float64Array, scene: Scene, pair: Pair, last_beam: int, last: float) -> int:
    """Choose the beam along the straight line, as the agent ``los-beam`` does."""
    at_tx, at_rx = directions(scene, [pair])
    return straight_beams(pair.tx.array, at_tx[0], pair.rx.array, at_rx[0])[0]


def nearest_first(legs: Legs, at: int, left: BoolArray) -> tuple[int, int]:
    """Fly to the address with the shortest way around the blocks: the baseline, and the kind of its ways.

    Example:
        >>> from caviar_labs.paper.pizza_flight import legs_between
        >>> places = np.array([[0.0, 0.0], [60.0, 0.0], [20.0, 0.0]])
        >>> legs = legs_between(places, lambda places: places[:, 0] * 0)
        >>> nearest_first(legs, 0, np.array([True, True]))
        (2, 0)
    """
    addresses = (np.flatnonzero(left) + 1).tolist()
    return min(addresses, key=lambda address: float(legs.found[0].cost[at, address])), 0
