"""Users of a frame and their channels; a *user* is a pair of devices on one carrier."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from caviar_protocol.arrays import BoolArray, Complex128Array, Float64Array
from caviar_protocol.errors import PayloadError
from caviar_protocol.pairs import Pair, pairs_of
from caviar_protocol.topics import AntennaArray, Carrier, Channel, Scene
from caviar_services.link.sweep import sweep


@dataclass(frozen=True)
class User(Pair):
    """A pair on one carrier."""

    carrier: Carrier

    def __str__(self) -> str:
        return f"{self.tx.name} → {self.rx.name} on {self.carrier.name}"


def users_of(scene: Scene, carriers: Sequence[Carrier]) -> list[User]:
    """All users: carriers in the given order, then TX, then RX by name."""
    pairs = pairs_of(scene)
    return [User(pair.tx, pair.rx, carrier) for carrier in carriers for pair in pairs]


@dataclass(frozen=True)
class UserChannels:
    """What the channel product says about each user, Shape ``[U]`` each."""

    known: BoolArray
    """The channel covers the pair. A held channel does not cover a device that came later."""
    has_path: BoolArray
    """At least one path with an amplitude other than 0 on the user's carrier."""
    los: BoolArray
    h: tuple[Complex128Array | None, ...]
    """H, Shape ``[Nr, Nt]``; None without a path."""


def channels_of(channel: Channel, users: Sequence[User]) -> UserChannels:
    """Look up each user in the channel product.

    Raises `PayloadError` naming the user where paths reach it but its H is missing or does not
    fit its arrays.
    """
    carriers = {carrier.name: index for index, carrier in enumerate(channel.carriers)}
    tx_index = {name: index for index, name in enumerate(channel.tx)}
    rx_index = {name: index for index, name in enumerate(channel.rx)}
    matrices = {(matrix.carrier, matrix.tx, matrix.rx): matrix.h for matrix in channel.h}
    offsets, receivers = channel.offsets.tolist(), len(channel.rx)
    known, has_path, los = ([False] * len(users) for _ in range(3))
    found: list[Complex128Array | None] = [None] * len(users)
    for u, user in enumerate(users):
        key = (carriers.get(user.carrier.name), tx_index.get(user.tx.name), rx_index.get(user.rx.name))
        if None in key:
            continue
        c, t, r = key
        first = t * receivers + r  # type: ignore[operator]  # no None in it
        known[u] = True
        los[u] = bool(channel.los[t, r])
        has_path[u] = bool(channel.a[c, offsets[first] : offsets[first + 1]].any())
        if has_path[u]:
            found[u] = _checked(user, matrices.get(key))  # type: ignore[arg-type]  # no None in it
    return UserChannels(
        known=np.array(known, np.bool_),
        has_path=np.array(has_path, np.bool_),
        los=np.array(los, np.bool_),
        h=tuple(found),
    )


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


class Swept(NamedTuple):
    """Users with equal arrays, swept as one batch."""

    users: list[int]
    abs_y: Float64Array
    """|y| of all beam pairs, Shape ``[len(users), Nt, Nr]``."""


def sweep_users(users: Sequence[User], h: Sequence[Complex128Array | None]) -> list[Swept]:
    """|y| of all beam pairs of the users with an H."""
    groups: dict[tuple[AntennaArray, AntennaArray], list[int]] = defaultdict(list)
    for index, matrix in enumerate(h):
        if matrix is not None:
            groups[users[index].tx.array, users[index].rx.array].append(index)
    return [Swept(found, sweep(np.array([h[u] for u in found]), *arrays)) for arrays, found in groups.items()]
