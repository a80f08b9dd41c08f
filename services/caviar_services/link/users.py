"""Users of a frame and their channels; a *user* is a pair of devices on one carrier."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import msgspec
import numpy as np

from caviar_protocol.arrays import BoolArray, Complex128Array, Float64Array
from caviar_protocol.errors import PayloadError
from caviar_protocol.space.scene import Pair, pairs_of
from caviar_protocol.topics import AntennaArray, Carrier, Channel, Scene
from caviar_services.link.sweep import sweep


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


class Swept(msgspec.Struct, frozen=True):
    """Users with equal arrays, swept as one batch."""

    users: list[int]
    abs_y: Float64Array
    """|y| of all beam pairs, Shape ``[len(users), Nt, Nr]``."""


def sweep_users(users: Users, h: Sequence[Complex128Array | None]) -> list[Swept]:
    """|y| of all beam pairs of the users with an H."""
    groups: dict[int, list[int]] = defaultdict(list)
    for index, (matrix, batch) in enumerate(zip(h, users.batch, strict=True)):
        if matrix is not None:
            groups[batch].append(index)
    swept = []
    for found in groups.values():
        first = users[found[0]]
        swept.append(Swept(found, sweep(np.array([h[u] for u in found]), first.tx.array, first.rx.array)))
    return swept
