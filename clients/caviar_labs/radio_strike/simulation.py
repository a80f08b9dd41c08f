"""The game of Radio-Strike for any number of members at once, each independent of the others.

A single environment is a batch of one: both are computed by the same operations, element by element, so that
a member of a batch has the numbers of a single environment of its seed, to the last bit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from caviar_labs.radio_strike.draws import BlockDraws, Draws, LegacyDraws
from caviar_labs.radio_strike.rules import (
    BEAMS,
    LEGACY_STEPS,
    MAX_AGE,
    USERS,
    Rules,
    magnitudes,
    straight_lines,
)
from caviar_labs.radio_strike.trajectories import Episode
from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_protocol.errors import RunError

Members: TypeAlias = slice | Int64Array
"""Which of a batch: all of them, or some by index. A slice gives views instead of copies."""

ALL = slice(None)
OBSERVED = 7
"""Numbers of an observation."""

# Columns of a trajectory in `Library.rows`.
_AZIMUTH, _ZENITH, _LEVEL = 3, 4, 5


class EpisodesOverError(RunError, TypeError):
    """A user of ``legacy`` is at the end of the last episode. The original raises `TypeError` then."""


class Library:
    """Episodes in the order in which they are played, each read when it is first needed, and kept: 2.6 MB for
    each of three minutes.

    Args:
        loaders: Read each.
        rules: For the columns that follow from positions.
    """

    def __init__(self, loaders: Sequence[Callable[[], Episode]], rules: Rules) -> None:
        self._loaders, self._rules = loaders, rules
        self._bounds: dict[int, tuple[int, int]] = {}
        self._used = 0
        self.rows: Float64Array = np.empty((0, len(USERS), 6))
        """Position [m], azimuth [°], zenith angle [°] and path gain [dB] of each user, Shape ``[N, 3, 6]``;
        a larger array takes its place when an episode is read."""

    def __len__(self) -> int:
        return len(self._loaders)

    def bounds(self, episode: int) -> tuple[int, int]:
        """The first row of an episode, and the one after its last.

        Args:
            episode: Number in the order.

        Raises:
            ScenarioError: Its file is wrong.
        """
        if episode not in self._bounds:
            position = self._loaders[episode]().position
            first, stop = self._used, self._used + len(position)
            if stop > len(self.rows):
                # At least doubled, so that many episodes do not copy all rows as often.
                grown = np.empty((max(stop, 2 * len(self.rows)), len(USERS), 6))
                grown[:first] = self.rows[:first]
                self.rows = grown
            self.rows[first:stop, :, :3] = position
            self.rows[first:stop, :, 3:] = np.stack(straight_lines(position, self._rules), axis=-1)
            self._bounds[episode], self._used = (first, stop), stop
        return self._bounds[episode]


class Outcome(NamedTuple):
    """What a step led to, of K members; Shape ``[K]``."""

    observation: Float64Array
    """Shape ``[K, 7]``: position of the scheduled user [m], packets dropped, sent and buffered, bit rate
    [bit/s]."""
    reward: Float64Array
    terminated: BoolArray
    truncated: BoolArray
    beam: Int64Array
    packets: Float64Array
    """Of all users: those that arrived, and those that waited before."""
    magnitude: Float64Array
    """|y|."""

    def info(self) -> dict[str, Any]:
        """What the original says beside the observation, by its names."""
        _, _, _, dropped, sent, buffered, rate = self.observation.T
        return {
            "pkts_dropped": dropped,
            "pkts_transmitted": sent,
            "pkts_buffered": buffered,
            "bit_rate": rate,
            "packets": self.packets,
            "channel_mag": self.magnitude,
        }


class Simulation:
    """The game of M members.

    Args:
        rules: Of all.
        library: Episodes that all play.
        members: How many.
        steps: Of an episode at most; None: as long as its trajectory.

    Example:
        >>> from caviar_labs.radio_strike.rules import FIXED
        >>> from caviar_labs.radio_strike.sources import episode_loaders
        >>> game = Simulation(FIXED, Library(episode_loaders(), FIXED), members=2)
        >>> for member in range(2):
        ...     game.seed(member, np.random.default_rng(member), member)
        ...     game.begin(member)
        >>> game.step(np.array([0, 2]), np.array([7, 40])).reward.shape
        (2,)
    """

    def __init__(self, rules: Rules, library: Library, members: int, steps: int | None = None) -> None:
        self.rules, self.library, self._limit = rules, library, steps
        self._draws: Draws = (BlockDraws if rules.resets else LegacyDraws)(rules, members)
        self._lasting = np.arange(members)
        # Packets of each user by the slots that they have waited.
        self._waiting = np.zeros((members, len(USERS), MAX_AGE))
        self._steps = np.zeros(members, np.int64)
        # Rows of each user: that of the next step, and the one after the last of the episode.
        self._row = np.zeros((members, len(USERS)), np.int64)
        self._stop = np.zeros((members, len(USERS)), np.int64)
        self.episode = np.zeros((members, len(USERS)), np.int64)
        """Number of the episode in which each user is, Shape ``[M, 3]``."""

    def seed(self, member: int, random: np.random.Generator, seed: int) -> None:
        """Give a member its random numbers.

        Args:
            member: Its index.
            random: Seeded generator, for ``fixed``.
            seed: What it was seeded with; with ``legacy`` what `numpy.random.seed` takes before the original.
        """
        self._draws.seed(member, random, seed)

    def begin(self, member: int, episode: int | None = None) -> None:
        """Begin a game.

        Args:
            member: Its index.
            episode: Number of the episode; None: drawn with ``fixed``, the first with ``legacy``.

        Raises:
            ScenarioError: The file of the episode is wrong.
        """
        drawn = self._draws.begin(member, len(self.library))
        if episode is None:
            episode = drawn
        self._waiting[member] = 0
        self._steps[member] = 0
        self.episode[member] = episode
        self._row[member], self._stop[member] = self.library.bounds(episode)

    def first_observation(self, member: int) -> Float64Array:
        """What is observed before the first step: with ``fixed`` the position of the first user, with
        ``legacy`` zeros. Shape ``[7]``.

        Args:
            member: Its index.
        """
        observation = np.zeros(OBSERVED)
        if self.rules.resets:
            observation[:3] = self.library.rows[self._row[member, 0], 0, :3]
        return observation

    def step(self, users: Int64Array, beams: Int64Array | None, members: Members = ALL) -> Outcome:
        """Play a slot.

        Args:
            users: The one that each member schedules, Shape ``[K]``.
            beams: The beam that each uses, Shape ``[K]``; None: the best one of the slot.
            members: Which of the batch, K of them.

        Raises:
            EpisodesOverError: With ``legacy``: a user is at the end of the last episode.
        """
        rules, lasting = self.rules, self._lasting[members]
        among = self._lasting[: len(lasting)]
        steps = self._steps[members]
        if not rules.resets:
            self._next_episodes(lasting, users)
        rows = self._row[lasting, users]
        arrived, rays = self._draws.draw(lasting, users, steps, self._stop[lasting, users] - rows)
        at = self.library.rows[rows, users]
        tried = np.arange(BEAMS)[None] if beams is None else beams[:, None]
        abs_y = magnitudes(rules, at[:, _AZIMUTH], at[:, _ZENITH], at[:, _LEVEL], rays, tried)
        best = abs_y.argmax(1)
        magnitude = abs_y[among, best]
        rate = rules.bit_rate(magnitude)

        waiting = self._waiting[members]
        buffered = waiting.sum(axis=(1, 2))  # of whole numbers, so exact in any order
        dropped = waiting[:, :, -1].sum(1)
        aged = np.empty_like(waiting)
        aged[:, :, 0] = arrived
        aged[:, :, 1:] = waiting[:, :, :-1]
        sent = _send(aged, among, users, rules.packets(rate))
        self._waiting[members] = aged

        offered = arrived.sum(1) + buffered
        gained = sent - 2 * dropped
        # Without a packet there is nothing to send: neither good nor bad.
        reward = np.divide(gained, offered, out=np.zeros(len(gained)), where=offered > 0)
        observation = np.empty((len(lasting), OBSERVED))
        observation[:, :3] = at[:, :3]
        observation[:, 3], observation[:, 4] = dropped, sent
        observation[:, 5], observation[:, 6] = buffered, rate

        steps = steps + 1
        self._steps[members] = steps
        if rules.all_move:
            self._row[members] += 1
        else:
            self._row[lasting, users] += 1
        terminated, truncated = self._ends(members, steps)
        beam = best if beams is None else beams
        return Outcome(observation, reward, terminated, truncated, beam, offered, magnitude)

    def _ends(self, members: Members, steps: Int64Array) -> tuple[BoolArray, BoolArray]:
        never = np.zeros(len(steps), np.bool_)
        if not self.rules.resets:
            return steps >= LEGACY_STEPS, never
        over = self._row[members, 0] >= self._stop[members, 0]
        if self._limit is not None:
            over |= steps >= self._limit
        return never, over

    def _next_episodes(self, members: Int64Array, users: Int64Array) -> None:
        """Put scheduled users that are at the end of their episode at the beginning of the next."""
        ended = self._row[members, users] >= self._stop[members, users]
        if not ended.any():
            return
        for member, user in zip(members[ended].tolist(), users[ended].tolist(), strict=True):
            number = int(self.episode[member, user]) + 1
            if number >= len(self.library):
                raise EpisodesOverError(
                    f"{USERS[user]} is at the end of the last of {len(self.library)} episodes, where "
                    "the original ends with a TypeError; reset with a seed, name more episodes, or take "
                    'rules="fixed"'
                )
            self.episode[member, user] = number
            self._row[member, user], self._stop[member, user] = self.library.bounds(number)


def _send(
    waiting: Float64Array, among: Int64Array, users: Int64Array, capacity: Float64Array
) -> Float64Array:
    """Send packets of the scheduled users, the oldest first; return how many.

    Args:
        waiting: Packets by user and age, which are changed, Shape ``[K, 3, 10]``.
        among: 0 … K − 1.
        users: Shape ``[K]``.
        capacity: Packets that can be sent, Shape ``[K]``.
    """
    oldest_first = waiting[among, users, ::-1]
    before = oldest_first.cumsum(1) - oldest_first
    sent = np.minimum(np.maximum(capacity[:, None] - before, 0.0), oldest_first)
    waiting[among, users, ::-1] = oldest_first - sent
    total: Float64Array = sent.sum(1)
    return total
