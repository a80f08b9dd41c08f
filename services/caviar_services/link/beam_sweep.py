"""Sweep of DFT codebooks, and what beam pairs get over the band.

Each end has one RF chain and the DFT codebook of its array (paper, section 2.1). Every beam pair of every
user is swept each frame (eq. 1). The sweep is a Fourier transform of H; the codebook as vectors is in
`caviar_services.antenna_arrays`.

Over the band and the slots of a frame the equivalent channel (eq. 1) of a pair of beams w and f is

    y(Δf, Δt) = w* H(Δf, Δt) f = Σ_p (w* r_p) · (t_pᵀ f) · a_p · exp(−j2π(Δf·(τ_p − Δt·ν_p/f_c) − ν_p·Δt))

with the phases r_p and t_p of the elements on path p: two numbers a path instead of a matrix a subcarrier
(`beam_responses`).
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import msgspec
import numpy as np

from caviar_protocol.arrays import Complex128Array, Float64Array, Int32Array, Int64Array
from caviar_protocol.errors import PayloadError
from caviar_protocol.multipath import subcarrier_weights
from caviar_protocol.space.coordinates import rotation_matrix
from caviar_protocol.space.scene import device_pose
from caviar_protocol.topics import AntennaDevice, Channel, Scene
from caviar_protocol.topics.channel import PLANE_WAVES
from caviar_protocol.topics.scene import AntennaArray
from caviar_services.antenna_arrays import dft_beam, steering_vector
from caviar_services.link.base import Users

SORTED_WHOLE = 256
"""Pairs up to which sorting all of them is faster than looking for the best first."""
SMALL = 32
"""Elements along an axis up to which a product of matrices is faster than a fast transform. From 64 on it
would be shared out to threads too, which on a busy machine wait for each other ten times as long."""


class Pairs(NamedTuple):
    """Beam pairs of U users, best first, Shape ``[U, k]`` each."""

    tx_beam: Int32Array
    rx_beam: Int32Array
    abs_y: Float64Array


def sweep(h: Complex128Array, tx: AntennaArray, rx: AntennaArray) -> Float64Array:
    """Compute |y| of every pair of DFT beams.

    y = w* H f (paper, eq. 1) with the beams of `antenna_arrays.dft_codebook`. Both conj(w) and f have
    entries exp(−j2πkn/N)/sqrt(N), so the product over all pairs is a Fourier transform over the
    columns and rows of both arrays, and no codebook of N² entries has to be formed. Of several panels or
    polarizations each block is transformed by itself.

    Args:
        h: Channel matrices, Shape ``[..., Nr, Nt]``.
        tx: Array of the transmitter, of Nt elements.
        rx: Array of the receiver, of Nr elements.

    Returns:
        |y| by TX beam and RX beam, Shape ``[..., Nt, Nr]``.

    Example:
        >>> uniform = AntennaArray(rows=1, columns=4)
        >>> abs_y = sweep(np.ones((4, 4), np.complex128), uniform, uniform)  # in phase: towards boresight
        >>> round(float(abs_y[0, 0]), 6), round(float(abs_y[1, 1]), 6)
        (4.0, 0.0)
    """
    # Elements are numbered panel by panel, column by column (`antenna_arrays.element_positions`): so the axes
    # of the grid come out of a reshape, and the transform of one axis after the other is that of all.
    leading, grid = h.shape[:-2], _grid(tx, rx)
    y = h.reshape((*leading, *grid.shape))  # one element at each end: an array without axes
    for axis, size in grid.axes:
        if size > SMALL:
            y = np.fft.fft(y, axis=axis, out=np.empty(y.shape, np.complex128))  # it looks long for a type
        else:
            y = (y.swapaxes(axis, -1) @ _fourier(size)).swapaxes(axis, -1)
    magnitude: Float64Array = np.abs(y.reshape(*leading, rx.size, tx.size).swapaxes(-1, -2))
    if grid.scale != 1.0:
        magnitude *= grid.scale
    return magnitude


class _Grid(NamedTuple):
    """How H is transformed."""

    shape: tuple[int, ...]
    """By panels, columns and rows of RX, then of TX, without those that are 1."""
    axes: tuple[tuple[int, int], ...]
    """Axes of it, from the last one on, and their sizes, of columns and rows."""
    scale: float
    """What the fast transforms among them lack to be unitary."""


@lru_cache(maxsize=256)
def _grid(tx: AntennaArray, rx: AntennaArray) -> _Grid:
    sizes: list[tuple[int, bool]] = []
    for array in (rx, tx):
        panels = array.size // (array.columns * array.rows)
        sizes += [(panels, False), (array.columns, True), (array.rows, True)]
    kept = [(size, transformed) for size, transformed in sizes if size > 1]
    axes = [(n - len(kept), size) for n, (size, transformed) in enumerate(kept) if transformed]
    scale = math.prod(1 / math.sqrt(size) for _, size in axes if size > SMALL)
    return _Grid(tuple(size for size, _ in kept), tuple(axes), scale)


@lru_cache(maxsize=SMALL)
def _fourier(size: int) -> Complex128Array:
    """The unitary Fourier matrix, entries exp(−j2πkn/N)/sqrt(N)."""
    n = np.arange(size)
    matrix: Complex128Array = np.exp(-2j * np.pi * (np.outer(n, n) % size) / size) / np.sqrt(size)
    return matrix


def best_pairs(abs_y: Float64Array, k: int) -> Pairs:
    """Find the pairs of beams with the greatest |y|.

    The first one is eq. (2) of the paper. Of equal ones the lowest pair index
    ``tx_beam·Nr + rx_beam`` comes first.

    Args:
        abs_y: |y| of all pairs, Shape ``[U, Nt, Nr]``.
        k: Number of pairs; all of them where there are fewer.

    Example:
        >>> best_pairs(np.array([[[1.0, 3.0], [2.0, 0.0]]]), 2).abs_y
        array([[3., 2.]])
    """
    flat = abs_y.reshape(len(abs_y), -1)
    k = min(k, flat.shape[1])
    if flat.shape[1] <= SORTED_WHOLE:
        order = (-flat).argsort(-1, "stable")[:, :k]
    else:
        order = np.array([_best_of_many(row, k) for row in flat])
    tx_beam, rx_beam = order.astype(np.int32), np.zeros(order.shape, np.int32)
    if abs_y.shape[2] > 1:
        tx_beam, rx_beam = np.divmod(tx_beam, np.int32(abs_y.shape[2]))
    if len(flat) > 1:
        # `take` on one flat axis: `take_along_axis` forms index arrays of all axes first.
        order = order + np.arange(0, flat.size, flat.shape[1])[:, None]
    return Pairs(tx_beam, rx_beam, flat.take(order))


def _best_of_many(flat: Float64Array, k: int) -> Int64Array:
    """Indices of the ``k`` greatest, found without sorting all."""
    # A partition is linear in the number of pairs; only what reaches the k-th is sorted, equal ones included,
    # so that the order among them is that of a stable sort of all.
    threshold = np.partition(flat, flat.size - k)[flat.size - k]
    candidates = np.flatnonzero(flat >= threshold)
    order: Int64Array = candidates[np.argsort(-flat[candidates], kind="stable")][:k]
    return order


class Swept(msgspec.Struct, frozen=True):
    """Users with equal arrays, swept as one batch."""

    users: list[int]
    abs_y: Float64Array
    """|y| of all beam pairs, Shape ``[len(users), Nt, Nr]``."""


def sweep_users(users: Users, h: Sequence[Complex128Array | None]) -> list[Swept]:
    """Sweep all users that have an H, those with equal arrays as one batch.

    Args:
        users: The users.
        h: H of each user, Shape ``[Nr, Nt]``; None for a user without a path.

    Returns:
        A batch for each combination of arrays.

    Example:
        >>> from caviar_services.link.base import channels_of, users_of
        >>> from caviar_services.testing.samples import CARRIERS, product, scene
        >>> users = users_of(scene(0), CARRIERS)
        >>> [batch.abs_y.shape for batch in sweep_users(users, channels_of(product("channel", 0), users).h)]
        [(1, 16, 3), (1, 16, 2)]
    """
    groups: dict[int, list[int]] = defaultdict(list)
    for index, (matrix, group) in enumerate(zip(h, users.array_groups, strict=True)):
        if matrix is not None:
            groups[group].append(index)
    swept = []
    for found in groups.values():
        first = users[found[0]]
        stacked = np.array([h[u] for u in found])
        swept.append(Swept(found, sweep(stacked, first.tx.array, first.rx.array)))
    return swept


def beam_responses(
    channel: Channel, scene: Scene, users: Users, beams: Sequence[tuple[int, int]]
) -> list[Complex128Array]:
    """Compute y of each user's beam pair on the subcarriers and in the slots of its carrier.

    Args:
        channel: With its paths; on the rungs ``spherical`` and ``mimo-rt``, where an array does not see
            plane waves, with part ``hf``; so for arrays of dual polarization or several panels.
        scene: Of the same frame.
        users: Of that scene.
        beams: TX and RX beam of each user; a pair with −1 is not served.

    Returns:
        Of each user, Shape ``[S, K]`` with S slots and K subcarriers; zeros for a user that is not served,
        has no path, or is not in ``channel``.

    Raises:
        PayloadError: Naming the user, for a beam that its codebook does not have, or where part ``hf`` is
            missing.

    Example:
        >>> from caviar_services.link.base import users_of
        >>> from caviar_services.testing.samples import CARRIERS, product, scene
        >>> users = users_of(scene(0), CARRIERS)
        >>> responses = beam_responses(product("channel", 0), scene(0), users, [(0, 0)] * len(users))
        >>> [y.shape for y in responses]  # slots × subcarriers of the carrier
        [(2, 5), (2, 5)]
    """
    # Asked for by a service that needs it (part `hf`), so mostly there are none.
    matrices = {(response.carrier, response.tx, response.rx): response.h for response in channel.hf}
    rotations: dict[str, Float64Array] = {}
    found = []
    for user, indices, (tx_beam, rx_beam) in zip(users, users.channel_indices(channel), beams, strict=True):
        if indices is None or tx_beam < 0 or rx_beam < 0:
            found.append(np.zeros((user.carrier.slots, user.carrier.subcarriers), np.complex128))
            continue
        for beam, device in ((tx_beam, user.tx), (rx_beam, user.rx)):
            if beam >= device.array.size:
                raise PayloadError(
                    f"beam {beam} of user {user} does not exist; the codebook of {device.name!r} has beams "
                    f"0 to {device.array.size - 1}"
                )
        ends = dft_beam(user.tx.array, tx_beam).conj(), dft_beam(user.rx.array, rx_beam).conj()
        index, tx, rx = indices
        # The one amplitude of a path is that between two of its devices' subarrays.
        uniform = user.tx.array.is_uniform and user.rx.array.is_uniform
        if channel.rung in PLANE_WAVES and uniform:
            paths = channel.pair(user.tx.name, user.rx.name)
            sent = _gains(scene, user.tx, channel.aod[paths], ends[0], rotations)
            taken = _gains(scene, user.rx, channel.aoa[paths], ends[1], rotations)
            carrier = channel.carriers[index]
            weights = subcarrier_weights(carrier, channel.tau[paths], channel.doppler[index, paths])
            found.append(weights @ (channel.a[index, paths] * sent * taken))
        elif (index, tx, rx) in matrices:
            found.append((matrices[index, tx, rx] @ ends[0]) @ ends[1])
        else:
            raise PayloadError(
                f"the response of user {user} on rung {channel.rung!r} does not follow from paths; ask for "
                "part 'hf' of the channel in the inputs of this service"
            )
    return found


def _gains(
    scene: Scene,
    device: AntennaDevice,
    angles: Float64Array,
    beam: Complex128Array,
    rotations: dict[str, Float64Array],
) -> Complex128Array:
    """Gain of a beam on paths with these angles in world axes, Shape ``[P, 2]`` to ``[P]``."""
    if device.array.size == 1:
        return np.ones(len(angles), np.complex128)
    # Of one device for all its users: a base station is the transmitter of most of them.
    if device.name not in rotations:
        rotations[device.name] = rotation_matrix(device_pose(scene, device).orientation)
    sine = np.sin(angles[:, 0])
    directions = np.empty((len(angles), 3))
    directions[:, 0] = sine * np.cos(angles[:, 1])
    directions[:, 1] = sine * np.sin(angles[:, 1])
    directions[:, 2] = np.cos(angles[:, 0])
    gains: Complex128Array = steering_vector(device.array, directions @ rotations[device.name]) @ beam
    return gains
