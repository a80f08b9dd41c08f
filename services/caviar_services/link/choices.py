"""Which beams the agents chose for whom in a frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import cast

import msgspec
import numpy as np

from caviar_protocol.arrays import Int32Array
from caviar_protocol.errors import PayloadError
from caviar_protocol.messages import Status
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
    agent schedules a receiver, the transmitter's other receivers are not served. Raises
    `PayloadError` naming the agents where two commands concern one user, and naming the agent
    for a user that does not exist or a beam outside the codebook. A held action may name users
    that left since; those commands are counted.
    """
    book = _Book(users)
    for agent, held, command in _commands(frame):
        if isinstance(command, BeamChoice):
            book.choose(agent, held, command)
        elif isinstance(command, UserSchedule):
            book.schedule(agent, held, command)
    return book.result()


def _commands(frame: Frame) -> Iterator[tuple[str, bool, object]]:
    """(agent, action is held, command), agents in sorted order."""
    actions = [item for item in frame if item.provenance.topic == "action" and item.present]
    for item in sorted(actions, key=lambda entry: entry.provenance.source):
        held = item.provenance.status is Status.HELD
        for command in cast(Action, item.payload).commands:
            yield item.provenance.source, held, command


@dataclass
class _Book:
    """Commands of a frame, entered one after the other."""

    users: Users
    chosen: dict[int, tuple[str, BeamChoice]] = field(default_factory=dict)
    scheduled: dict[str, tuple[str, str]] = field(default_factory=dict)
    outdated: int = 0

    def choose(self, agent: str, held: bool, command: BeamChoice) -> None:
        indices = [
            index
            for index in self.users.of_pair.get((command.tx, command.rx), ())
            if command.carrier in ("", self.users[index].carrier.name)
        ]
        if not indices:
            self._no_such_user(agent, held, command.tx, command.rx, command.carrier)
        for index in indices:
            previous = self.chosen.get(index)
            if previous is not None and self._first_wins(index, previous, agent, command):
                continue
            self._require_in_codebook(agent, self.users[index], command)
            self.chosen[index] = (agent, command)

    def schedule(self, agent: str, held: bool, command: UserSchedule) -> None:
        if (command.tx, command.rx) not in self.users.of_pair:
            self._no_such_user(agent, held, command.tx, command.rx, "")
            return
        if command.tx in self.scheduled:
            other = self.scheduled[command.tx][0]
            raise PayloadError(
                f"{_who(other, agent)} schedule a receiver of {command.tx!r}; "
                "at most one command per transmitter and frame"
            )
        self.scheduled[command.tx] = (agent, command.rx)

    def result(self) -> Choices:
        tx_beam, rx_beam = ([-1] * len(self.users) for _ in range(2))
        for index, (_, command) in self.chosen.items():
            if self.scheduled.get(command.tx, ("", command.rx))[1] == command.rx:
                tx_beam[index], rx_beam[index] = command.tx_beam, command.rx_beam
        beams = np.array(tx_beam + rx_beam, np.int32).reshape(2, -1)
        return Choices(beams[0], beams[1], self.outdated)

    def _first_wins(
        self, index: int, previous: tuple[str, BeamChoice], agent: str, command: BeamChoice
    ) -> bool:
        """Whether the earlier choice stays: one that names a carrier beats one that does not."""
        first_agent, first = previous
        if first_agent == agent and bool(first.carrier) != bool(command.carrier):
            return bool(first.carrier)
        user = self.users[index]
        raise PayloadError(
            f"{_who(first_agent, agent)} choose beams for {_user(user.tx.name, user.rx.name)} on carrier "
            f"{user.carrier.name!r}; let one of them own the receiver (services.<agent>.users)"
        )

    def _require_in_codebook(self, agent: str, user: User, command: BeamChoice) -> None:
        for side, beam, device in (("TX", command.tx_beam, user.tx), ("RX", command.rx_beam, user.rx)):
            if beam >= device.array.size:
                raise PayloadError(
                    f"agent {agent!r} chose {side} beam {beam} for {_user(user.tx.name, user.rx.name)}; "
                    f"the codebook of {device.name!r} has beams 0 to {device.array.size - 1}"
                )

    def _no_such_user(self, agent: str, held: bool, tx: str, rx: str, carrier: str) -> None:
        if held:
            self.outdated += 1
            return
        names = sorted({_user(user.tx.name, user.rx.name) for user in self.users})
        listed = ", ".join(names[:_LISTED]) + (", …" if len(names) > _LISTED else "")
        where = f" on carrier {carrier!r}" if carrier else ""
        raise PayloadError(
            f"agent {agent!r} commands {_user(tx, rx)}{where}, which does not exist in this frame; "
            f"there are: {listed or 'none'}"
        )


def _user(tx: str, rx: str) -> str:
    return f"{tx} → {rx}"


def _who(first: str, second: str) -> str:
    if first == second:
        return f"two commands of agent {first!r}"
    return f"agents {first!r} and {second!r} both"
