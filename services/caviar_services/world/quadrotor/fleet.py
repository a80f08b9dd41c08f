"""The quadrotors of a world, flown slice by slice beside each other, and what they touch."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache, partial

from caviar_protocol.seeding import generator
from caviar_protocol.space.coordinates import Pose, Vector
from caviar_protocol.topics.scene import LEFT_GEOFENCE_PREFIX
from caviar_services.world.base import ObjectState
from caviar_services.world.quadrotor.control import COLLIDED, ENERGY, Order, QuadrotorState
from caviar_services.world.quadrotor.flyer import SLICE_NS, Quadrotor
from caviar_services.world.quadrotor.surroundings import (
    NOISES,
    Contact,
    ball_contact,
    box_contact,
    scenery_contact,
)
from caviar_space.obstacles import Obstacles

# Scripted objects are looked up at these instants [ns], and move in straight lines between them.
_SCRIPT_NS = 100_000_000

# Slices for which noise is drawn at once.
_BLOCK = 100

Scripted = Callable[[int], Iterable[ObjectState]]
"""Objects that follow a script, by the time since the beginning of the episode [ns]."""


class Fleet:
    """Flies quadrotors in step.

    Args:
        quadrotors: By name.
        radii: Radius of the ball that stands for each in contacts [m].
        scripted: Boxes that move by a script, which may be touched.
        service: Name of the service, of which the gusts are drawn.

    Example:
        >>> fleet = Fleet({}, {}, lambda elapsed_ns: (), "world")
        >>> fleet.fly({}, 100_000_000)
        Counter()
    """

    def __init__(
        self,
        quadrotors: Mapping[str, Quadrotor],
        radii: Mapping[str, float],
        scripted: Scripted,
        service: str,
    ) -> None:
        self.quadrotors = dict(quadrotors)
        self.obstacles: dict[str, Obstacles] = {name: Obstacles.none() for name in quadrotors}
        self.seen: dict[str, QuadrotorState] = {name: uav.state for name, uav in quadrotors.items()}
        """States at the instant of the frame."""
        self._radii = radii
        self._service = service
        self._slices = 0
        self._scripted = scripted
        self._scripts = lru_cache(4)(lambda number: list(scripted(number * _SCRIPT_NS)))

    def begin(self, episode: int, seed: int, starts: Mapping[str, tuple[Vector, float]]) -> None:
        """Begin an episode.

        Args:
            episode: Number of the episode from the first one with this seed.
            seed: Of the episode.
            starts: Position [m] and yaw [rad] by name.
        """
        self._slices = 0
        for name, uav in self.quadrotors.items():
            noise = _Noise(seed, episode, f"{self._service}/gusts/{name}")
            uav.reset(*starts[name], noise)
            self.seen[name] = uav.state

    def fly(self, orders: Mapping[str, Order], elapsed_ns: int) -> Counter[str]:
        """Fly to an instant.

        Args:
            orders: By name; one without brakes and hovers.
            elapsed_ns: Since the beginning of the episode [ns].

        Returns:
            What limited the motions, each at most once; collisions that began; exits from geofences;
            energy taken.
        """
        limits, counts = set[str](), Counter[str]()
        for number in range(self._slices, elapsed_ns // SLICE_NS):
            for name, uav in self.quadrotors.items():
                for event in uav.fly_slice(orders.get(name), number):
                    limits.add(event + name if event.endswith("/") else event)
            self._touch((number + 1) * SLICE_NS, counts)
            for name, uav in self.quadrotors.items():
                counts[LEFT_GEOFENCE_PREFIX + name] += uav.leaves(self._radii[name])
        self._slices = elapsed_ns // SLICE_NS
        rest = elapsed_ns - self._slices * SLICE_NS
        for name, uav in self.quadrotors.items():
            self.seen[name] = uav.seen_after(rest, orders.get(name), self._slices)
            used = int(uav.state.energy_j)
            counts[ENERGY + name] = used - uav.state.counted_j
            uav.state.counted_j = used
        return +Counter(limits) + counts

    def resume(self, states: Mapping[str, QuadrotorState], elapsed_ns: int) -> None:
        """Go on from states of an earlier process, after `begin` of the same episode.

        Args:
            states: By name.
            elapsed_ns: Of the last frame [ns].
        """
        self._slices = elapsed_ns // SLICE_NS
        for name, uav in self.quadrotors.items():
            uav.state = states[name]

    def _touch(self, elapsed_ns: int, counts: Counter[str]) -> None:
        """Look for contacts at the end of a slice, all before any is answered."""
        found = {name: list(self._contacts(name, elapsed_ns)) for name in self.quadrotors}
        for name, uav in self.quadrotors.items():
            for what in sorted(uav.touch(found[name])):
                counts[f"{COLLIDED}{name}/{what}"] += 1

    def _contacts(self, name: str, elapsed_ns: int) -> Iterable[Contact]:
        body, radius = self.quadrotors[name].state.body, self._radii[name]
        scenery = scenery_contact(self.obstacles[name], body.position, radius)
        if scenery is not None:
            yield scenery
        number, into = divmod(elapsed_ns, _SCRIPT_NS)
        share = into / _SCRIPT_NS
        for before, after in zip(self._scripts(number), self._scripts(number + 1), strict=True):
            ax, ay, az = before.position
            bx, by, bz = after.position
            centre = (ax + share * (bx - ax), ay + share * (by - ay), az + share * (bz - az))
            box = Pose(centre, before.orientation if share < 0.5 else after.orientation)
            contact = box_contact(before.name, box, before.dimensions, before.velocity, body.position, radius)
            if contact is not None:
                yield contact
        for other, uav in self.quadrotors.items():
            if other != name:
                there = uav.state.body
                met = ball_contact(
                    other, there.position, self._radii[other], there.velocity, body.position, radius
                )
                if met is not None:
                    yield met


class _Noise:
    """Normal numbers of each slice, which depend on its number alone, not on the frames of a flight."""

    def __init__(self, seed: int, episode: int, stream: str) -> None:
        self._block = lru_cache(2)(partial(_drawn, seed, episode, stream))

    def __call__(self, number: int) -> list[float]:
        block, within = divmod(number, _BLOCK)
        return self._block(block)[within]


def _drawn(seed: int, episode: int, stream: str, block: int) -> list[list[float]]:
    # Frames begin at −1, which `generator` takes for the episode as a whole: here for what is before slice 0.
    numbers: list[list[float]] = (
        generator(seed, episode, stream, block).normal(size=(_BLOCK, NOISES)).tolist()
    )
    return numbers
