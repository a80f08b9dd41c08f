"""Random numbers of Radio-Strike: packets that arrive, and rays. Each member has a stream of its own."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np

from caviar_labs.radio_strike.rules import RAYS, SPREAD_DEG, TOGGLE_STEPS, USERS, Rays, Rules
from caviar_protocol.arrays import Float64Array, Int64Array

BLOCK = 256
"""Slots of a member that are drawn at once: a call of a generator costs as much as dozens of numbers."""


class Drawn(NamedTuple):
    """Random numbers of a slot of K members."""

    packets: Float64Array
    """That arrive for each user, Shape ``[K, 3]``."""
    rays: Rays
    """Of the scheduled user."""


class Draws(Protocol):
    """Where a simulation has its random numbers from."""

    def seed(self, member: int, random: np.random.Generator, seed: int) -> None:
        """Begin the stream of a member anew.

        Args:
            member: Its index.
            random: Seeded generator.
            seed: What it was seeded with.
        """
        ...

    def begin(self, member: int, episodes: int) -> int:
        """Draw the episode that a member plays next.

        Args:
            member: Its index.
            episodes: How many there are.
        """
        ...

    def draw(self, members: Int64Array, users: Int64Array, steps: Int64Array, left: Int64Array) -> Drawn:
        """Draw a slot.

        Args:
            members: K members.
            users: User that each member schedules, Shape ``[K]``.
            steps: That each has played, Shape ``[K]``.
            left: Slots of its episode that each has to play, this one included, Shape ``[K]``.
        """
        ...


class LegacyDraws:
    """The stream of NumPy's global generator, in the order in which the original takes numbers from it: so
    they are its numbers after `numpy.random.seed`.

    Args:
        rules: Have the mean numbers of packets.
        members: How many.
    """

    def __init__(self, rules: Rules, members: int) -> None:
        self._means = rules.means
        self._random: list[Any] = [None] * members

    def seed(self, member: int, random: np.random.Generator, seed: int) -> None:
        """See `Draws.seed`."""
        # A seed of more than 32 bits, which `numpy.random.seed` does not take, goes in as words.
        words = [seed >> shift & 0xFFFFFFFF for shift in range(0, max(1, seed.bit_length()), 32)]
        self._random[member] = np.random.RandomState(seed if len(words) == 1 else np.array(words, np.uint32))

    def begin(self, member: int, episodes: int) -> int:
        """The first: the original plays them in order."""
        return 0

    def draw(self, members: Int64Array, users: Int64Array, steps: Int64Array, left: Int64Array) -> Drawn:
        """See `Draws.draw`. Packets of the scheduled user come first, then rays, then the other packets."""
        normal = np.empty((len(members), 12))
        packets: list[tuple[float, float, float]] = []
        light = (steps // TOGGLE_STEPS % 2).tolist()
        # Numbers one by one, since how many of the stream a Poisson number uses depends on those before it.
        for k, (member, user, is_light) in enumerate(
            zip(members.tolist(), users.tolist(), light, strict=True)
        ):
            random, (uav, car, pedestrian) = self._random[member], self._means[is_light]
            poisson = random.poisson
            if user == 0:
                first = poisson(uav)
                normal[k] = random.standard_normal(12)
                packets.append((first, poisson(car), poisson(pedestrian)))
            elif user == 1:
                first = poisson(car)
                normal[k] = random.standard_normal(12)
                packets.append((poisson(uav), first, poisson(pedestrian)))
            else:
                first = poisson(pedestrian)
                normal[k] = random.standard_normal(12)
                packets.append((poisson(uav), poisson(car), first))
        # The last four numbers are directions of arrival, which users with one antenna do not notice.
        return Drawn(np.array(packets, np.float64), _rays(normal, np.zeros((len(members), RAYS))))


class BlockDraws:
    """Numbers that are drawn in blocks of slots from a generator of each member.

    Args:
        rules: Have the mean numbers of packets.
        members: How many.
    """

    def __init__(self, rules: Rules, members: int) -> None:
        self._means = np.array(rules.means)
        self._random: list[Any] = [None] * members
        self._packets = np.zeros((members, BLOCK, len(USERS)))
        self._normal = np.zeros((members, BLOCK, 8))
        self._phase = np.zeros((members, BLOCK, RAYS))
        # The next slot of each member's block, and how many its block has.
        self._next, self._size = np.zeros((2, members), np.int64)

    def seed(self, member: int, random: np.random.Generator, seed: int) -> None:
        """See `Draws.seed`."""
        self._random[member] = random

    def begin(self, member: int, episodes: int) -> int:
        """See `Draws.begin`."""
        # What is left of the block was drawn for slots that are not played.
        self._next[member] = self._size[member] = 0
        return int(self._random[member].integers(episodes))

    def draw(self, members: Int64Array, users: Int64Array, steps: Int64Array, left: Int64Array) -> Drawn:
        """See `Draws.draw`. The numbers do not depend on the user that a member schedules."""
        used = self._next[members] >= self._size[members]
        if used.any():
            rows = (members[used].tolist(), steps[used].tolist(), left[used].tolist())
            for member, step, slots in zip(*rows, strict=True):
                self._fill(member, step, min(BLOCK, slots))
        at = self._next[members]
        self._next[members] = at + 1
        rays = _rays(self._normal[members, at], self._phase[members, at])
        return Drawn(self._packets[members, at], rays)

    def _fill(self, member: int, step: int, slots: int) -> None:
        random = self._random[member]
        light = (step + np.arange(slots)) // TOGGLE_STEPS % 2
        self._packets[member, :slots] = random.poisson(self._means[light])
        self._normal[member, :slots] = random.standard_normal((slots, 8))
        self._phase[member, :slots] = 2 * np.pi * random.random((slots, RAYS))
        self._next[member], self._size[member] = 0, slots


def _rays(normal: Float64Array, phase: Float64Array) -> Rays:
    """Rays of normal numbers, two for each quantity: Shape ``[K, ≥ 8]``."""
    gain = np.abs(normal[:, 0:2]) + np.abs(normal[:, 2:4])
    return Rays(gain, SPREAD_DEG * normal[:, 4:6], SPREAD_DEG * normal[:, 6:8], phase)
