"""Sweep of DFT codebooks, and what beam pairs get over the band.

Each end has one RF chain and the DFT codebook of its array (paper, section 2.1). Every beam pair of every
user is swept each frame (eq. 1, `caviar_protocol.space.beams.beam_gains`).

Over the band and the slots of a frame the equivalent channel (eq. 1) of a pair of beams w and f is

    y(Δf, Δt) = w* H(Δf, Δt) f = Σ_p (w* r_p) · (t_pᵀ f) · a_p · exp(−j2π(Δf·(τ_p − Δt·ν_p/f_c) − ν_p·Δt))

with the phases r_p and t_p of the elements on path p: two numbers a path instead of a matrix a subcarrier
(`beam_responses`).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import msgspec
import numpy as np

from caviar_protocol.arrays import Complex128Array, Float64Array
from caviar_protocol.errors import PayloadError
from caviar_protocol.multipath import subcarrier_weights
from caviar_protocol.space.antenna_arrays import steering_vector
from caviar_protocol.space.beams import beam_gains
from caviar_protocol.space.codebooks import beam_count, codebook_of
from caviar_protocol.space.coordinates import rotation_matrix
from caviar_protocol.space.scene import device_pose
from caviar_protocol.topics import AntennaDevice, Channel, Scene
from caviar_protocol.topics.channel import PLANE_WAVES
from caviar_services.link.base import Users


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
        swept.append(Swept(found, beam_gains(stacked, first.tx.array, first.rx.array)))
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
            count = beam_count(device.array)
            if beam >= count:
                raise PayloadError(
                    f"beam {beam} of user {user} does not exist; the codebook of {device.name!r} has beams "
                    f"0 to {count - 1}"
                )
        ends = (
            codebook_of(user.tx.array).vector(tx_beam).conj(),
            codebook_of(user.rx.array).vector(rx_beam).conj(),
        )
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
