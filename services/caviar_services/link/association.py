"""Association: which transmitter serves a receiver, and what it costs to change."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_services.link.base import Users

AssociationRule = Literal["best", "sticky", "agent"]


@dataclass(frozen=True, eq=False)
class Layout:
    """Which users are of which terminal and transmitter, while the same users are there."""

    users: Users
    names: tuple[tuple[str, str], ...]
    """Receiver and carrier of each terminal, T of them."""
    transmitters: tuple[str, ...]
    """Names of all transmitters, X of them."""
    rows: Int64Array
    """Index of the user of each terminal and transmitter, Shape ``[T, X]``; −1: none."""
    tx: Int64Array
    """Index of the transmitter of each user, Shape ``[U]``."""
    carrier: Int64Array
    """A number for the carrier of each user, Shape ``[U]``."""

    @classmethod
    def of(cls, users: Users) -> Layout:
        """Of the users of a scene.

        Args:
            users: All of them.

        Example:
            >>> from caviar_services.link.base import users_of
            >>> from caviar_services.testing.samples import CARRIERS, scene
            >>> Layout.of(users_of(scene(0), CARRIERS)).names
            (('car.1/rx', 'mmwave'), ('truck.2/rx', 'mmwave'))
        """
        names = {name: t for t, name in enumerate(dict.fromkeys((u.rx.name, u.carrier.name) for u in users))}
        transmitters = {name: x for x, name in enumerate(dict.fromkeys(u.tx.name for u in users))}
        carriers = {name: c for c, name in enumerate(dict.fromkeys(u.carrier.name for u in users))}
        rows = np.full((len(names), len(transmitters)), -1, np.int64)
        tx = np.array([transmitters[user.tx.name] for user in users], np.int64)
        for index, user in enumerate(users):
            rows[names[user.rx.name, user.carrier.name], tx[index]] = index
        carrier = np.array([carriers[user.carrier.name] for user in users], np.int64)
        return cls(users, tuple(names), tuple(transmitters), rows, tx, carrier)

    def servers(self, names: Sequence[str]) -> Int64Array:
        """Find transmitters by name.

        Args:
            names: Of each terminal, that of a transmitter.

        Returns:
            Index of the transmitter of each terminal, −1 for one that is not there; Shape ``[T]``.
        """
        index = {name: x for x, name in enumerate(self.transmitters)}
        found = [index.get(name, -1) for name in names]
        # Of a device that transmits and receives there is no user of itself.
        return np.array([x if x >= 0 and self.rows[t, x] >= 0 else -1 for t, x in enumerate(found)], np.int64)


def associate(
    layout: Layout,
    before: Int64Array,
    power: Float64Array,
    chosen: BoolArray,
    rule: AssociationRule,
    hysteresis_db: float,
) -> Int64Array:
    """Choose the transmitter that serves each terminal.

    Args:
        layout: Terminals and transmitters.
        before: Index of the transmitter that served each terminal in the frame before, −1: none; Shape
            ``[T]``.
        power: Power of the best pair of beams of each user, in any unit, Shape ``[U]``.
        chosen: Users for which an agent chose beams, Shape ``[U]``.
        rule: ``best``: that of the greatest power; ``sticky``: the one before, until another one has more by
            the hysteresis; ``agent``: that for which an agent chose beams, of several the first.
        hysteresis_db: Of ``sticky`` [dB].

    Returns:
        Index of the transmitter of each terminal, Shape ``[T]``.

    Example:
        >>> from caviar_services.link.base import users_of
        >>> from caviar_services.testing.samples import CARRIERS, scene
        >>> layout = Layout.of(users_of(scene(0), CARRIERS))
        >>> nowhere, power = np.array([-1, -1]), np.array([1e-9, 2e-9])
        >>> associate(layout, nowhere, power, power > 0, "best", 0.0)
        array([0, 0])
    """
    terminals = np.arange(len(layout.rows))
    if layout.rows.shape[1] <= 1:
        return np.zeros(len(terminals), np.int64)
    there = layout.rows >= 0
    of_each = np.where(there, power[layout.rows], -1.0)
    best: Int64Array = of_each.argmax(1)
    if rule == "best":
        return best
    serving = np.where(before >= 0, before, best)
    if rule == "sticky":
        better = of_each[terminals, best] > of_each[terminals, serving] * 10 ** (hysteresis_db / 10)
        return np.where(better, best, serving)
    by_agent = there & chosen[layout.rows]
    return np.where(by_agent.any(1), by_agent.argmax(1), serving)
