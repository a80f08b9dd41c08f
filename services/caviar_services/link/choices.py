"""Which beams the agents chose for whom in a frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import cast

import msgspec
import numpy as np

from caviar_protocol.arrays import Int32Array
from caviar_protocol.errors import PayloadError, ProductError
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.topics import Action, BeamChoice, UserSchedule
from caviar_services.link.users import User, Users
from caviar_services.service import Frame

_LISTED = 8
"""Names that an error message lists at most."""


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

    Raises
    ------
    ProductError
        An agent names a user that does not exist or a beam outside the codebook, or contradicts itself.
    PayloadError
        The commands of two agents concern one user; both are named.
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
