"""Channels at the instants of slots and over the band, for chosen beams, from the paths of a channel product.

Δt after the frame's instant and Δf from the carrier, the equivalent channel of TX beam f and RX beam w is

    y(Δf, Δt) = Σ_p (w* r_p) · (t_pᵀ f) · a_p · exp(j2π(ν_p·Δt − Δf·(τ_p − Δt·ν_p/f_c)))

with the phases r_p and t_p of the elements on path p (`beam_sweep`): Doppler shifts ν turn the phases of the
paths against each other within a frame, delays τ over the band.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from caviar_protocol.arrays import Complex128Array, Float64Array, Int64Array
from caviar_protocol.errors import PayloadError
from caviar_protocol.space.antenna_arrays import steering_vector
from caviar_protocol.space.codebooks import codebook_of
from caviar_protocol.space.coordinates import rotation_matrix
from caviar_protocol.space.scene import device_pose
from caviar_protocol.topics import AntennaDevice, Carrier, Channel, Scene
from caviar_protocol.topics.channel import PLANE_WAVES
from caviar_services.link.base import Users

MOST_POINTS = 64
"""Points of a band that are computed at most; the SINR of more resource blocks hardly differs from theirs."""

_BLOCK_SUBCARRIERS = 12
"""Subcarriers of a resource block (3GPP TS 38.211)."""


def band_points(carriers: Sequence[Carrier]) -> Float64Array:
    """Frequencies at which the band of each carrier is looked at, from its centre.

    Args:
        carriers: C carriers.

    Returns:
        [Hz], evenly spaced, as many as the most that a carrier has resource blocks, Shape ``[C, F]``. A
        carrier without subcarriers is looked at over its bandwidth.

    Example:
        >>> carrier = Carrier(name="n257", frequency_hz=28e9, subcarriers=48, subcarrier_spacing_hz=120e3)
        >>> band_points([carrier]).tolist()
        [[-2160000.0, -720000.0, 720000.0, 2160000.0]]
    """
    blocks = [carrier.subcarriers // _BLOCK_SUBCARRIERS for carrier in carriers]
    count = min(max([*blocks, 1]), MOST_POINTS)
    width = [
        carrier.subcarriers * carrier.subcarrier_spacing_hz or carrier.bandwidth_hz for carrier in carriers
    ]
    places = (np.arange(count) + 0.5) / count - 0.5
    points: Float64Array = np.array(width)[:, None] * places
    return points


def responses(
    channel: Channel,
    scene: Scene,
    users: Users,
    asked: Int64Array,
    tx_beams: Int64Array,
    rx_beams: Int64Array,
    instants: Float64Array,
    points: Float64Array,
) -> Complex128Array:
    """Compute y of K pairs of beams.

    Args:
        channel: With its paths, of a rung with plane waves.
        scene: Of the same frame.
        users: Of that scene.
        asked: Index of the user of each pair of beams, Shape ``[K]``.
        tx_beams: TX beam of each, likewise.
        rx_beams: RX beam of each, likewise.
        instants: Δt [s], Shape ``[S]``.
        points: Δf of each carrier of the channel [Hz], Shape ``[C, F]``.

    Returns:
        Shape ``[K, S, F]``; zeros without a path, or for a user that the channel does not cover.

    Raises:
        PayloadError: The response of a user does not follow from paths; names it, and the remedy.
    """
    found = np.zeros((len(asked), len(instants), points.shape[1]), np.complex128)
    places = users.channel_indices(channel)
    offsets, receivers = channel.offsets, len(channel.rx)
    requests, begins, counts, carriers = [], [], [], []
    for k, user in enumerate(asked.tolist()):
        place = places[user]
        if place is None:
            continue
        _require_plane_waves(channel, users, user)
        carrier, tx, rx = place
        pair = tx * receivers + rx
        if offsets[pair + 1] > offsets[pair]:
            requests.append(k)
            begins.append(offsets[pair])
            counts.append(offsets[pair + 1] - offsets[pair])
            carriers.append(carrier)
    if not requests:
        return found
    # Paths of all pairs of beams one after the other: `request` says whose each one is.
    count = np.array(counts, np.int64)
    request = np.repeat(np.arange(len(requests)), count)
    ends = np.cumsum(count)
    path = np.arange(ends[-1]) - np.repeat(ends - count - np.array(begins, np.int64), count)
    carrier = np.array(carriers, np.int64)[request]
    whose = np.array(requests, np.int64)[request]
    devices = [(users[user].tx, users[user].rx) for user in asked.tolist()]
    amplitude = channel.a[carrier, path]
    amplitude = amplitude * _gains(scene, [tx for tx, _ in devices], whose, channel.aod[path], tx_beams)
    amplitude = amplitude * _gains(scene, [rx for _, rx in devices], whose, channel.aoa[path], rx_beams)
    doppler, frequency = channel.doppler[carrier, path], points[carrier].T
    centre = np.array([c.frequency_hz for c in channel.carriers])[carrier]
    drifting = channel.tau[path] - instants[:, None] * (doppler / centre)
    turns = (instants[:, None] * doppler)[:, None] - frequency * drifting[:, None]
    waves = amplitude * np.exp(2j * np.pi * turns)
    found[requests] = np.moveaxis(np.add.reduceat(waves, ends - count, axis=-1), -1, 0)
    return found


def _require_plane_waves(channel: Channel, users: Users, index: int) -> None:
    user = users[index]
    if channel.rung not in PLANE_WAVES:
        raise PayloadError(
            f"the channel of user {user} within a frame does not follow from the paths of rung "
            f"{channel.rung!r}; leave out `selective` of the link, or use one of {', '.join(PLANE_WAVES)}"
        )
    if not (user.tx.array.is_uniform and user.rx.array.is_uniform):
        raise PayloadError(
            f"the channel of user {user} within a frame does not follow from its paths, since an array has "
            "several panels or polarizations; leave out `selective` of the link"
        )


def _gains(
    scene: Scene,
    devices: Sequence[AntennaDevice],
    whose: Int64Array,
    angles: Float64Array,
    beams: Int64Array,
) -> Complex128Array:
    """Gain of the beam of each path's request at one end, Shape ``[P]``."""
    gains = np.ones(len(whose), np.complex128)
    by_device: dict[str, list[int]] = {}
    for k in dict.fromkeys(whose.tolist()):
        if devices[k].array.size > 1:
            by_device.setdefault(devices[k].name, []).append(k)
    for requests in by_device.values():
        device = devices[requests[0]]
        here = np.flatnonzero(np.isin(whose, requests))
        zenith, azimuth = angles[here].T
        sine = np.sin(zenith)
        directions = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(zenith)], -1)
        steered = steering_vector(
            device.array, directions @ rotation_matrix(device_pose(scene, device).orientation)
        )
        chosen, place = np.unique(beams[whose[here]], return_inverse=True)
        vectors = np.array([codebook_of(device.array).vector(beam).conj() for beam in chosen.tolist()])
        gains[here] = (steered * vectors[place]).sum(-1)
    return gains
