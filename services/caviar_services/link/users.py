"""Users of a frame, their channels, and the beams that agents chose for them.

A *user* is a pair of devices on one carrier.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import cast

import msgspec
import numpy as np

from caviar_protocol.arrays import BoolArray, Complex128Array, Int32Array
from caviar_protocol.errors import PayloadError, ProductError
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.space.scene import Pair, pairs_of
from caviar_protocol.topics import Action, AntennaArray, BeamChoice, Carrier, Channel, Scene, UserSchedule
from caviar_services.service import Frame


@dataclass(frozen=True)
class User(Pair):
    """A pair on one carrier."""

    carrier: Carrier

    def __str__(self) -> str:
        return f"{self.tx.name} → {self.rx.name} on {self.carrier.name}"


class Users(tuple[User, ...]):
    """The users of a scene, and what can be looked up as long as they stay the same."""

    _place: tuple[object, list[tuple[int, int, int] | None]] | None = None

    @cached_property
    def of_pair(self) -> dict[tuple[str, str], list[int]]:
        """Users of each pair of devices, by name."""
        found: dict[tuple[str, str], list[int]] = defaultdict(list)
        for index, user in enumerate(self):
            found[user.tx.name, user.rx.name].append(index)
        return dict(found)

    @cached_property
    def batch(self) -> list[int]:
        """A number for each user, the same for those with equal arrays."""
        numbers: dict[tuple[AntennaArray, AntennaArray], int] = {}
        return [numbers.setdefault((user.tx.array, user.rx.array), len(numbers)) for user in self]

    def places(self, channel: Channel) -> list[tuple[int, int, int] | None]:
        """Carrier, TX and RX of each user as the channel product counts them; None where it has them not."""
        axes = (channel.carriers, channel.tx, channel.rx)
        if self._place is None or self._place[0] != axes:
            carriers = {carrier.name: index for index, carrier in enumerate(channel.carriers)}
            tx = {name: index for index, name in enumerate(channel.tx)}
            rx = {name: index for index, name in enumerate(channel.rx)}
            found = [
                (carriers[user.carrier.name], tx[user.tx.name], rx[user.rx.name])
                if user.carrier.name in carriers and user.tx.name in tx and user.rx.name in rx
                else None
                for user in self
            ]
            self._place = axes, found
        return self._place[1]


def users_of(scene: Scene, carriers: Sequence[Carrier]) -> Users:
    """All users: carriers in the given order, then TX, then RX by name."""
    pairs = pairs_of(scene)
    return Users(User(pair.tx, pair.rx, carrier) for carrier in carriers for pair in pairs)


class UserChannels(msgspec.Struct, frozen=True):
    """What the channel product says about each user, Shape ``[U]`` each."""

    unknown: int
    """Users that the channel does not cover: a held channel has no device that came later."""
    has_path: BoolArray
    """At least one path with an amplitude other than 0 on the user's carrier."""
    los: BoolArray
    h: tuple[Complex128Array | None, ...]
    """H, Shape ``[Nr, Nt]``; None without a path."""


def channels_of(channel: Channel, users: Users) -> UserChannels:
    """Look up each user in the channel product.

    Raises `PayloadError` naming the user where paths reach it but its H is missing or does not
    fit its arrays.
    """
    matrices = {(matrix.carrier, matrix.tx, matrix.rx): matrix.h for matrix in channel.h}
    offsets, free, receivers = channel.offsets.tolist(), channel.los.tolist(), len(channel.rx)
    unknown, has_path, los = 0, [False] * len(users), [False] * len(users)
    found: list[Complex128Array | None] = [None] * len(users)
    for u, place in enumerate(users.places(channel)):
        if place is None:
            unknown += 1
            continue
        c, t, r = place
        first = t * receivers + r
        los[u] = free[t][r]
        if np.count_nonzero(channel.a[c, offsets[first] : offsets[first + 1]]):
            has_path[u], found[u] = True, _checked(users[u], matrices.get(place))
    flags = np.array(has_path + los, np.bool_).reshape(2, -1)
    return UserChannels(unknown, flags[0], flags[1], tuple(found))


def _checked(user: User, h: Complex128Array | None) -> Complex128Array:
    if h is None:
        raise PayloadError(
            f"the channel has paths for {user} but no H; its service has to compute part 'h', "
            "which is in demand"
        )
    expected = (user.rx.array.size, user.tx.array.size)
    if h.shape != expected:
        raise PayloadError(
            f"H of {user} has shape {h.shape}, the arrays of the scene need {expected} (RX × TX elements)"
        )
    return h


# Names that an error message lists at most.
_LISTED = 8


class Choices(msgspec.Struct, frozen=True):
    """Chosen beams per user, −1 where no agent serves it, Shape ``[U]`` each."""

    tx_beam: Int32Array
    rx_beam: Int32Array
    outdated: int = 0
    """Commands of held actions whose user is no longer there."""


def choices_of(frame: Frame, users: Users) -> Choices:
    """The beams that the agents of this frame chose.

    A choice without a carrier holds for every carrier on which its agent makes no other. Where an
    agent schedules a receiver, the transmitter's other receivers are not served. A held action may name
    users that left since; those commands are counted.

    Raises:
        ProductError: An agent names a user that does not exist or a beam outside the codebook, or
            contradicts itself.
        PayloadError: The commands of two agents concern one user; both are named.
    """
    book = _Book(users)
    for action, command in _commands(frame):
        if isinstance(command, BeamChoice):
            book.choose(action, command)
        elif isinstance(command, UserSchedule):
            book.schedule(action, command)
    return book.result()


def _commands(frame: Frame) -> Iterator[tuple[GrantInput, object]]:
    """Each command, with the provenance of its action, agents in sorted order."""
    actions = [item for item in frame if item.provenance.topic == "action" and item.present]
    for item in sorted(actions, key=lambda entry: entry.provenance.source):
        for command in cast(Action, item.payload).commands:
            yield item.provenance, command


@dataclass
class _Book:
    """Commands of a frame, entered one after the other."""

    users: Users
    chosen: dict[int, tuple[str, BeamChoice]] = field(default_factory=dict)
    scheduled: dict[str, tuple[str, str]] = field(default_factory=dict)
    outdated: int = 0

    def choose(self, action: GrantInput, command: BeamChoice) -> None:
        indices = [
            index
            for index in self.users.of_pair.get((command.tx, command.rx), ())
            if command.carrier in ("", self.users[index].carrier.name)
        ]
        if not indices:
            self._no_such_user(action, command.tx, command.rx, command.carrier)
        for index in indices:
            previous = self.chosen.get(index)
            if previous is not None and self._first_wins(index, previous, action, command):
                continue
            self._require_in_codebook(action, self.users[index], command)
            self.chosen[index] = (action.source, command)

    def schedule(self, action: GrantInput, command: UserSchedule) -> None:
        if (command.tx, command.rx) not in self.users.of_pair:
            self._no_such_user(action, command.tx, command.rx, "")
            return
        if command.tx in self.scheduled:
            other = self.scheduled[command.tx][0]
            problem = f"schedule a receiver of {command.tx!r}; at most one command per transmitter and frame"
            raise _contradiction(other, action, problem)
        self.scheduled[command.tx] = (action.source, command.rx)

    def result(self) -> Choices:
        tx_beam, rx_beam = ([-1] * len(self.users) for _ in range(2))
        for index, (_, command) in self.chosen.items():
            if self.scheduled.get(command.tx, ("", command.rx))[1] == command.rx:
                tx_beam[index], rx_beam[index] = command.tx_beam, command.rx_beam
        beams = np.array(tx_beam + rx_beam, np.int32).reshape(2, -1)
        return Choices(beams[0], beams[1], self.outdated)

    def _first_wins(
        self, index: int, previous: tuple[str, BeamChoice], action: GrantInput, command: BeamChoice
    ) -> bool:
        """Whether the earlier choice stays: one that names a carrier beats one that does not."""
        first_agent, first = previous
        if first_agent == action.source and bool(first.carrier) != bool(command.carrier):
            return bool(first.carrier)
        user = self.users[index]
        problem = (
            f"choose beams for {_user(user.tx.name, user.rx.name)} on carrier {user.carrier.name!r}; "
            "let one of them own the receiver (services.<agent>.users)"
        )
        raise _contradiction(first_agent, action, problem)

    def _require_in_codebook(self, action: GrantInput, user: User, command: BeamChoice) -> None:
        for side, beam, device in (("TX", command.tx_beam, user.tx), ("RX", command.rx_beam, user.rx)):
            if beam >= device.array.size:
                raise _wrong(
                    action,
                    f"it chose {side} beam {beam} for {_user(user.tx.name, user.rx.name)}; "
                    f"the codebook of {device.name!r} has beams 0 to {device.array.size - 1}",
                )

    def _no_such_user(self, action: GrantInput, tx: str, rx: str, carrier: str) -> None:
        if action.status is Status.HELD:
            self.outdated += 1
            return
        names = sorted({_user(user.tx.name, user.rx.name) for user in self.users})
        listed = ", ".join(names[:_LISTED]) + (", …" if len(names) > _LISTED else "")
        where = f" on carrier {carrier!r}" if carrier else ""
        raise _wrong(
            action,
            f"it commands {_user(tx, rx)}{where}, which does not exist in this frame; "
            f"there are: {listed or 'none'}",
        )


def _user(tx: str, rx: str) -> str:
    return f"{tx} → {rx}"


def _wrong(action: GrantInput, problem: str) -> ProductError:
    return ProductError(action.topic, action.source, action.frame, problem)


def _contradiction(first: str, action: GrantInput, problem: str) -> PayloadError | ProductError:
    """An action against one of the agent ``first``: its own fault, or, of two agents, that of neither."""
    if first == action.source:
        return _wrong(action, f"two commands {problem}")
    return PayloadError(f"agents {first!r} and {action.source!r} both {problem}")
