"""Users of a frame and their channels; a *user* is a pair of devices on one carrier."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from caviar_protocol.arrays import BoolArray, Complex128Array, Float64Array
from caviar_protocol.errors import PayloadError
from caviar_protocol.pairs import Pair, pairs_of
from caviar_protocol.topics import Carrier, Channel, Scene
from caviar_services.link.sweep import sweep


@dataclass(frozen=True)
class User(Pair):
    """A pair on one carrier."""

    carrier: Carrier


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
    known, has_path, los = (np.zeros(len(users), dtype=np.bool_) for _ in range(3))
    found: list[Complex128Array | None] = [None] * len(users)
    for u, user in enumerate(users):
        key = (carriers.get(user.carrier.name), tx_index.get(user.tx.name), rx_index.get(user.rx.name))
        if None in key:
            continue
        c, t, r = key
        known[u] = True
        los[u] = channel.los[t, r]
        has_path[u] = bool(channel.a[c, channel.pair(user.tx.name, user.rx.name)].any())
        if has_path[u]:
            found[u] = _checked(user, matrices.get(key))  # type: ignore[arg-type]  # no None in it
    return UserChannels(known, has_path, los, tuple(found))


def _checked(user: User, h: Complex128Array | None) -> Complex128Array:
    name = f"{user.tx.name} → {user.rx.name} on {user.carrier.name}"
    if h is None:
        raise PayloadError(
            f"the channel has paths for {name} but no H; its service has to compute part 'h', "
            "which is in demand"
        )
    expected = (user.rx.array.size, user.tx.array.size)
    if h.shape != expected:
        raise PayloadError(
            f"H of {name} has shape {h.shape}, the arrays of the scene need {expected} (RX × TX elements)"
        )
    return h


def sweep_users(users: Sequence[User], h: Sequence[Complex128Array | None]) -> list[Float64Array | None]:
    """|y| of all beam pairs of each user, Shape ``[Nt, Nr]``; None where H is None.

    Users with equal arrays are swept as one batch.
    """
    swept: list[Float64Array | None] = [None] * len(users)
    groups = defaultdict(list)
    for index, (user, matrix) in enumerate(zip(users, h, strict=True)):
        if matrix is not None:
            groups[user.tx.array, user.rx.array].append((index, matrix))
    for (tx, rx), members in groups.items():
        batch = sweep(np.array([matrix for _, matrix in members]), tx, rx)
        for (index, _), abs_y in zip(members, batch, strict=True):
            swept[index] = abs_y
    return swept
