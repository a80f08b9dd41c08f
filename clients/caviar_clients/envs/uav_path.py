"""``caviar/UavPath-v1``: fly an object to a goal or to addresses, in reach of the radio on the way."""

from __future__ import annotations

import math
import numbers
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from caviar_clients.envs.arguments import checked_names
from caviar_clients.envs.base import Moment, Observation, SessionEnv
from caviar_clients.envs.deliveries import (
    MOST_ADDRESSES,
    TRIES,
    Airspace,
    Box,
    Deliveries,
    greatest_power,
    rotary_wing_power,
)
from caviar_clients.session.prepared import PreparedScenario
from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import PayloadError, RunError, ScenarioError
from caviar_protocol.scenario.schema import owned_by
from caviar_protocol.seeding import generator
from caviar_protocol.space.beams import straight_beams
from caviar_protocol.space.coordinates import Vector
from caviar_protocol.space.scene import directions
from caviar_protocol.topics import Action, BeamChoice, Link, VelocityCommand, WaypointCommand
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
        """Position of the object [m], Shape ``[3]``."""
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


OWN_PARTS = ("position", "velocity", "goal", "rate", "outage")
"""What is always observed."""

SHARE_OF_WAY = (0.1, 0.5)
"""Distance of start and goal, unless it is given: of the way that the object can fly in an episode."""

GREATEST_DB = 300.0
"""[dB] Greatest ratio that an argument may be."""
# [m] beyond the clearance that the world asks for.
_MARGIN = 0.01


class Weights(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Weights of the parts of the reward, from 0 on."""

    progress: float = 1.0
    radio: float = 1.0
    outage: float = 1.0
    arrival: float = 10.0
    intrusion: float = 1.0
    energy: float = 0.0


class RewardParts(msgspec.Struct, frozen=True, kw_only=True):
    """The parts of the reward of one step, each in a range of its own."""

    progress: float
    """−1…1: how much nearer the goal has come, over the way at greatest speed."""
    radio: float
    """−1…0: what the mean rate of the users lacks of the best one."""
    outage: float
    """−1…0: minus the share of users without a path, or with an SNR below ``outage_snr_db``."""
    arrival: float
    """1 in the step that reaches the goal, else 0; with addresses, how many of them the step delivers to."""
    intrusion: float
    """−1 where the way of the step meets a box of ``no_fly_m``, else 0."""
    energy: float
    """−1…0: minus the propulsion power (`deliveries.rotary_wing_power`) over the greatest one."""

    def weighted(self, weights: Weights) -> float:
        """Sum up the parts, each times its weight."""
        return (
            weights.progress * self.progress
            + weights.radio * self.radio
            + weights.outage * self.outage
            + weights.arrival * self.arrival
            + weights.intrusion * self.intrusion
            + weights.energy * self.energy
        )


class UavPathEnv(FlightEnv):
    """Fly to a goal, or deliver to addresses, and stay in reach of the radio on the way. The action is that
    of `FlightEnv`.

    **Episode.** Start and goal are drawn by the seed, free of scenery, within the object's bounds; the
    ``options`` of `reset` set them: ``{"start": (x, y, z), "goal": (x, y, z)}`` [m], either or both. Frame 0
    puts the object at the start, so that an episode of S frames has S − 1 steps. It terminates where the goal
    is reached and is truncated after the last frame.

    With ``deliveries`` there are so many addresses in place of the goal, drawn likewise or set by
    ``{"addresses": [(x, y, z), …]}``, to be flown to in any order; the episode terminates after the last one.

    **Observation**, float32:

    * ``position``: in the box of the bounds, −1…1 on each axis, Shape ``[3]``;
    * ``velocity``: over the greatest speed, −1…1, Shape ``[3]``;
    * ``goal``: the way that is left, over the size of the box, −1…1 on each axis, Shape ``[3]``; with
      ``deliveries`` that to the first address of the shortest tour over those left;
    * ``rate``: spectral efficiency of the frame before over ``efficiency_bit_s_hz``, mean over users, 0…1,
      Shape ``[1]``; 0 at the start;
    * ``outage``: share of users in outage in the frame before, 0…1, Shape ``[1]``; 0 at the start;
    * with ``deliveries``, ``addresses``: the way to each, as ``goal``, 0 once delivered, Shape ``[N, 3]``,
      and ``delivered``: 0 or 1, Shape ``[N]``;
    * and the parts of ``observe``.

    **Reward** of a step: ``Σ weight·part`` with the parts of `RewardParts`, which ``info["reward_parts"]``
    has: progress −1…1, radio −1…0, outage −1…0, arrival, intrusion −1 or 0, energy −1…0 (weight 0 unless
    given). With one goal and the weights' defaults it lies within −3…11. Radio and outage are never above 0,
    so that nothing is gained by staying on the way; progress sums up to the same on every way to the goal.
    With addresses the way that is left is the shortest tour over them, so that any order can be flown, and
    a detour costs its length.

    Args:
        scenario: Scenario file, or the name of a scenario that ships; ``uav-path`` unless given.
        vehicle: Name of the flown object; None: the only one.
        reach_m: Distance at which the goal is reached [m].
        box_m: Two corners [m] within which start and goal are drawn; None: the object's bounds.
        distance_m: Least and greatest distance [m] of a drawn goal from the start; None: `SHARE_OF_WAY` of
            the way that the object can fly in an episode.
        efficiency_bit_s_hz: Spectral efficiency that is a radio part of 0: the best one that counts.
        outage_snr_db: A user with a lower SNR [dB] is in outage.
        deliveries: Number of addresses, 1 to `deliveries.MOST_ADDRESSES`; 0: there is one goal.
        no_fly_m: Boxes to keep out of, each as its lowest and its highest corner [m]. Starts, goals and
            addresses are drawn outside of them; nothing but the reward keeps the object out.
        weights: Of the parts: `Weights`, by name; what is left out has its default.
        observe: Further parts: `caviar_protocol.observations.PARTS`; their bounds are their own.
        options: The other arguments of `SessionEnv`, but for ``reward``.

    Raises:
        ScenarioError: The object has no bounds (``minimum_m``, ``maximum_m``), the scenario fewer than two
            frames, or an argument or an option is out of its range.

    Example:
        >>> env = UavPathEnv("uav-path", weights={"radio": 2.0})
        >>> observation, info = env.reset(seed=3)
        >>> sorted(observation)
        ['goal', 'outage', 'position', 'rate', 'velocity']
        >>> *_, info = env.step(env.action_space.sample())
        >>> sorted(info["reward_parts"])
        ['arrival', 'energy', 'intrusion', 'outage', 'progress', 'radio']
        >>> env.close()
    """

    reset_options = ("start", "goal", "addresses")
    uses_scenery = True
    needs_parts = False

    def __init__(
        self,
        scenario: str | Path | PreparedScenario = "uav-path",
        vehicle: str | None = None,
        reach_m: float = 5.0,
        box_m: tuple[Sequence[float], Sequence[float]] | None = None,
        distance_m: tuple[float, float] | None = None,
        efficiency_bit_s_hz: float = 10.0,
        outage_snr_db: float = 0.0,
        deliveries: int = 0,
        no_fly_m: Sequence[tuple[Sequence[float], Sequence[float]]] = (),
        weights: Mapping[str, float] | None = None,
        observe: Sequence[str] = (),
        **options: Any,
    ) -> None:
        if "reward" in options:
            raise ScenarioError("the reward has parts of its own; leave reward=… out, or write weights={…}")
        # Under one name an observation has one shape, and these are scaled.
        observe = checked_names("observe", observe)
        own = sorted(set(observe) & set(OWN_PARTS))
        if own:
            raise ScenarioError(f"{', '.join(own)} of observe is always observed; leave it out")
        super().__init__(scenario, vehicle, observe=observe, **options)
        self._weights = _weights(weights or {})
        self._reach = _positive("reach_m", reach_m)
        self._efficiency = _positive("efficiency_bit_s_hz", efficiency_bit_s_hz)
        if not (_is_number(outage_snr_db) and abs(outage_snr_db) <= GREATEST_DB):
            limits = f"write a number from -{GREATEST_DB:g} to {GREATEST_DB:g} [dB]"
            raise ScenarioError(f"outage_snr_db={outage_snr_db!r}; {limits}")
        self._outage_snr = float(10 ** (outage_snr_db / 10))
        self._low, self._high = self._bounds()
        self._drawn_in = (self._low, self._high) if box_m is None else self._box(box_m)
        self._step_way = self._max_speed * self.scenario.run.sampling_period_ns / 1e9
        if type(deliveries) is not int or not 0 <= deliveries <= MOST_ADDRESSES:
            limits = f"write a whole number from 0 to {MOST_ADDRESSES}"
            raise ScenarioError(f"deliveries={deliveries!r}; {limits}")
        self._count = deliveries
        self._no_fly = _boxes(no_fly_m)
        self._greatest_power = greatest_power(self._max_speed)
        self._distance = self._distances(distance_m)
        self._airspace: Airspace | None = None
        self._deliveries: Deliveries | None = None
        self._parts_now: RewardParts | None = None
        self._energy_j = 0.0
        own_parts = {
            **{name: spaces.Box(-1.0, 1.0, (3,), np.float32) for name in OWN_PARTS[:3]},
            **{name: spaces.Box(0.0, 1.0, (1,), np.float32) for name in OWN_PARTS[3:]},
        }
        if self._count:
            own_parts["addresses"] = spaces.Box(-1.0, 1.0, (self._count, 3), np.float32)
            own_parts["delivered"] = spaces.Box(0.0, 1.0, (self._count,), np.float32)
        self.observation_space = spaces.Dict({**own_parts, **self.observation_space.spaces})

    # --- arguments ---------------------------------------------------------------------------------

    def _bounds(self) -> tuple[Vector, Vector]:
        low, high = (point(self._flown.get(key)) for key in ("minimum_m", "maximum_m"))
        if low is None or high is None or not all(a < b for a, b in zip(low, high, strict=True)):
            raise ScenarioError(
                f"{self.vehicle!r} flies without bounds, and positions are observed relative to them; write "
                "minimum_m and maximum_m in [[services.<world>.settings.flown]]"
            )
        if self.scenario.run.frames < 2:
            raise ScenarioError("run.frames is 1, and frame 0 goes to the start; write at least 2")
        return low, high

    def _box(self, box_m: tuple[Sequence[float], Sequence[float]]) -> tuple[Vector, Vector]:
        low, high = _corners(box_m) or (self._high, self._low)
        if not all(a <= x <= y <= b for a, x, y, b in zip(self._low, low, high, self._high, strict=True)):
            raise ScenarioError(
                f"box_m={box_m!r} is no box within {list(self._low)} and {list(self._high)}; write its "
                "lowest and its highest corner, x, y, z [m] each"
            )
        return low, high

    def _distances(self, distance_m: tuple[float, float] | None) -> tuple[float, float]:
        if distance_m is None:
            # Frame 0 puts the object at its start: it flies in the others.
            way = self._step_way * (self.scenario.run.frames - 1)
            low, high = (share / max(1, self._count) for share in SHARE_OF_WAY)
            return max(low * way, 2 * self._reach), max(high * way, 4 * self._reach)
        found = tuple(distance_m) if isinstance(distance_m, Sequence) else ()
        if not (len(found) == 2 and all(map(_is_number, found)) and self._reach < found[0] <= found[1]):
            raise ScenarioError(
                f"distance_m={distance_m!r}; write two ascending numbers above reach_m={self._reach:g}"
            )
        return found[0], found[1]

    # --- an episode --------------------------------------------------------------------------------

    def _begin(self, options: Mapping[str, Any]) -> None:
        moment, session = self._moment, self._session
        if moment is None or session is None:
            raise RunError("no episode has begun; call reset()")
        self._moment = None  # there is no episode to step until the object is at its start
        start, addresses = self._start_and_addresses(moment, options)
        self._deliveries, self._energy_j = Deliveries(addresses, self._reach), 0.0
        there = WaypointCommand(object=self.vehicle, position=start, speed=self._max_speed, at_once=True)
        frame = session.step({"action": Action(commands=(*self._beams(moment), there))})
        # The link that comes with it is that of the place before.
        self._moment, self._parts_now = msgspec.structs.replace(self._at(frame), link=None), None

    def _start_and_addresses(self, moment: Moment, options: Mapping[str, Any]) -> tuple[Vector, list[Vector]]:
        frame = moment.frame
        # From the seed of the episode, which a broker elsewhere has, too, and not from gymnasium's generator.
        random = generator(frame.seed, frame.seed_episode, f"{self.agent}/start-and-goal")
        bounds, box = self._space((self._low, self._high)), self._space(self._drawn_in)
        start = self._given(bounds, "start", options.get("start"))
        addresses = self._given_addresses(bounds, options)
        if start is None:
            start = box.draw(random, addresses[0], self._distance) if addresses else box.draw(random)
        tries = TRIES
        while start is not None and len(addresses) < max(1, self._count):
            address = box.draw(random, start, self._distance)
            tries -= 1
            if address is None or not tries:
                start = None
            # Two in reach of one place would be one delivery.
            elif all(math.dist(address, other) > 2 * self._reach for other in addresses):
                addresses.append(address)
        if start is None:
            low, high = self._distance
            what = f"{self._count} addresses" if self._count else "goal"
            raise ScenarioError(
                f"no start and {what} {low:g} to {high:g} m apart were found between {list(box.low)} and "
                f"{list(box.high)}; write another box_m or distance_m, or other options"
            )
        # Given by options: drawn ones are farther apart than the reach.
        for address in addresses:
            if math.dist(start, address) <= self._reach:
                where = f"within reach_m={self._reach:g} of {'address' if self._count else 'goal'}"
                raise ScenarioError(f"start {list(start)} is {where} {list(address)}")
        return start, addresses

    def _given_addresses(self, space: Airspace, options: Mapping[str, Any]) -> list[Vector]:
        """Addresses, or the goal, that the options set; none where they are to be drawn."""
        name, other = ("addresses", "goal") if self._count else ("goal", "addresses")
        if options.get(other) is not None:
            raise ScenarioError(f"option {other!r} does not go with deliveries={self._count}; write {name!r}")
        given = options.get(name)
        if given is None:
            return []
        if not self._count:
            given = [given]
        elif not isinstance(given, Sequence) or len(given) != self._count:
            raise ScenarioError(
                f"addresses {given!r} are not {self._count} points; write so many, x, y, z [m]"
            )
        places = [self._given(space, name, place) for place in given]
        return [place for place in places if place is not None]

    def _space(self, box: tuple[Vector, Vector]) -> Airspace:
        # Made once: scenery is known after the first reset, and it stays.
        if self._airspace is None and self._session is not None:
            # The world keeps the object at its clearance, up to rounding: a start just there may be inside.
            clearance = float(self._flown.get("clearance_m", 1.0)) + _MARGIN
            self._airspace = Airspace(
                self._low,
                self._high,
                clearance,
                self._session.scenery,
                lambda place: not any(box.meets(place, place) for box in self._no_fly),
            )
        if self._airspace is None:
            raise RunError("no episode has begun; call reset()")
        return self._airspace.within(*box)

    def _given(self, space: Airspace, name: str, value: Any) -> Vector | None:
        if value is None:
            return None
        place = point(value)
        if place is None or not space.is_free(place):
            raise ScenarioError(
                f"{name} {value!r} is no place for {self.vehicle!r}; write a point [m] between "
                f"{list(space.low)} and {list(space.high)}, clear of the scenery and outside of buildings "
                "and of the boxes of no_fly_m"
            )
        return place

    # --- a step --------------------------------------------------------------------------------------

    def _rewarded(self, before: Moment, now: Moment, link: Link) -> float:
        efficiency, outage = self._radio(before, link)
        deliveries = self._episode_deliveries
        start, end = self._place(before), self._place(now)
        # Before what is reached is taken off the tour: the rest of the way to it is nothing that was flown.
        nearer = deliveries.tour_m(start) - deliveries.tour_m(end)
        x, y, z = now.scene.velocity[now.scene.names.index(self.vehicle)].tolist()
        power = rotary_wing_power((x, y, z))
        self._energy_j += power * (now.frame.t_ns - before.frame.t_ns) / 1e9
        self._parts_now = RewardParts(
            # Beyond ±1 only by rounding: the world bounds the speed.
            progress=min(1.0, max(-1.0, nearer / self._step_way)),
            radio=efficiency - 1.0,
            outage=0.0 - outage,  # and not -outage, which is −0.0 without one
            arrival=float(deliveries.deliver(end)),
            intrusion=0.0 - any(box.meets(start, end) for box in self._no_fly),
            energy=0.0 - power / self._greatest_power,
        )
        return self._parts_now.weighted(self._weights)

    @property
    def _episode_deliveries(self) -> Deliveries:
        if self._deliveries is None:
            raise RunError("no episode has begun; call reset()")
        return self._deliveries

    def _place(self, moment: Moment) -> Vector:
        x, y, z = self._position(moment).tolist()
        return x, y, z

    def _radio(self, moment: Moment, link: Link | None) -> tuple[float, float]:
        """Mean spectral efficiency of the users over the best one that counts, and the share in outage; both
        0 before the first link, and all in outage where there is no user."""
        served = {(pair.tx.name, pair.rx.name) for _, pair in moment.users}
        if link is None:
            return 0.0, 0.0
        mine = np.array([pair in served for pair in zip(link.tx, link.rx, strict=True)], np.bool_)
        if not mine.any():
            return 0.0, 1.0
        # Beyond the best that counts nothing is gained: the part stays within −1…0.
        efficiency = np.minimum(link.spectral_efficiency[mine] / self._efficiency, 1.0)
        in_outage = ~link.has_path[mine] | (link.snr[mine] < self._outage_snr)
        return float(efficiency.mean()), float(in_outage.mean())

    def _terminated(self, moment: Moment) -> bool:
        return self._episode_deliveries.is_done

    def _observation(self, moment: Moment) -> Observation:
        low, size = np.asarray(self._low), np.subtract(self._high, self._low)
        position = self._position(moment)
        index = moment.scene.names.index(self.vehicle)
        efficiency, outage = self._radio(moment, moment.link)
        own = {
            "position": 2 * (position - low) / size - 1,
            "velocity": moment.scene.velocity[index] / self._max_speed,
            "goal": (np.asarray(self._first_address(position)) - position) / size,
        }
        deliveries = self._episode_deliveries
        if self._count:
            ways = [
                np.zeros(3) if done else (np.asarray(address) - position) / size
                for address, done in zip(deliveries.addresses, deliveries.delivered, strict=True)
            ]
            own["addresses"], own["delivered"] = np.array(ways), np.array(deliveries.delivered, np.float64)
        # Within ±1: rounding puts what is at a bound beyond it.
        found: Observation = {
            name: np.clip(values, -1.0, 1.0).astype(np.float32) for name, values in own.items()
        }
        found["rate"], found["outage"] = (np.array([value], np.float32) for value in (efficiency, outage))
        return {**found, **super()._observation(moment)}

    def _first_address(self, position: Float64Array) -> Vector:
        """First address of the shortest tour; the last one delivered to where none is left."""
        x, y, z = position.tolist()
        first = self._episode_deliveries.next_address((x, y, z))
        return self._episode_deliveries.addresses[-1] if first is None else first

    def _info(self, moment: Moment) -> dict[str, Any]:
        known = super()._info(moment)
        place, deliveries = self._place(moment), self._episode_deliveries
        known["goal_m"] = self._first_address(self._position(moment))
        # With one goal its distance to the end: nothing is left of a tour that is done.
        goal = deliveries.addresses[0]
        known["distance_m"] = deliveries.tour_m(place) if self._count else math.dist(place, goal)
        known["delivered"], known["energy_j"] = deliveries.delivered, self._energy_j
        if self._parts_now is not None:
            known["reward_parts"] = msgspec.structs.asdict(self._parts_now)
        return known


def _is_number(value: object) -> bool:
    """Tell whether it is a finite number: NaN compares false with everything, and would pass a range."""
    return isinstance(value, numbers.Real) and math.isfinite(value)


def _positive(name: str, value: float) -> float:
    if not (_is_number(value) and value > 0):
        raise ScenarioError(f"{name}={value!r}; write a finite number above 0")
    return float(value)


def _corners(given: object) -> tuple[Vector, Vector] | None:
    """Read two points; None where it is something else."""
    low, high = map(point, given) if isinstance(given, Sequence) and len(given) == 2 else (None, None)
    return None if low is None or high is None else (low, high)


def _boxes(no_fly_m: Sequence[tuple[Sequence[float], Sequence[float]]]) -> tuple[Box, ...]:
    found = []
    for given in no_fly_m:
        corners = _corners(given)
        if corners is None or not all(a < b for a, b in zip(*corners, strict=True)):
            raise ScenarioError(
                f"no_fly_m has {given!r}; write the lowest and the highest corner of a box, x, y, z [m] each"
            )
        found.append(Box(*corners))
    return tuple(found)


def _weights(given: Mapping[str, float]) -> Weights:
    names = Weights.__struct_fields__
    if not isinstance(given, Mapping):
        raise ScenarioError(f"weights={given!r}; write numbers by name, of {', '.join(names)}")
    unknown = sorted(set(given) - set(names))
    if unknown:
        raise ScenarioError(f"weights has no part {', '.join(unknown)}; there are: {', '.join(names)}")
    wrong = {name: value for name, value in given.items() if not (_is_number(value) and value >= 0)}
    if wrong:
        raise ScenarioError(f"weights are {wrong}; write finite numbers from 0 on")
    return Weights(**given)
