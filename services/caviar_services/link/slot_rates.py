"""What slots carry for the terminals that they serve: SINR with interference, and rate models.

Channels at the instants of slots and over the band, for chosen beams, from the paths of a channel product.

Δt after the frame's instant and Δf from the carrier, the equivalent channel of TX beam f and RX beam w is

    y(Δf, Δt) = Σ_p (w* r_p) · (t_pᵀ f) · a_p · exp(j2π(ν_p·Δt − Δf·(τ_p − Δt·ν_p/f_c)))

with the phases r_p and t_p of the elements on path p (`beam_sweep`): Doppler shifts ν turn the phases of the
paths against each other within a frame, delays τ over the band.

Association: which transmitter serves a receiver, and what it costs to change.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from caviar_protocol.arrays import BoolArray, Complex128Array, Float64Array, Int64Array
from caviar_protocol.cell.link_adaptation import shannon, slot_bits
from caviar_protocol.errors import PayloadError
from caviar_protocol.space.antenna_arrays import steering_vector
from caviar_protocol.space.codebooks import codebook_of
from caviar_protocol.space.coordinates import rotation_matrix
from caviar_protocol.space.scene import device_pose
from caviar_protocol.topics import AntennaDevice, Carrier, Channel, Scene
from caviar_protocol.topics.channel import PLANE_WAVES
from caviar_services.link.base import Users
from caviar_services.link.beam_scores import Scored, amplitudes

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


Sharing = Literal["band", "space"]


class SlotSinr:
    """SINR of T terminals in the slots of a frame, on F parts of the band.

    Args:
        snr: Of each terminal with all power of its transmitter, Shape ``[S, T, F]``; S is 1 where all slots
            have the same.
        members: Terminals of each transmitter and carrier, Shape ``[G, T]``.
        at_once: Terminals that a transmitter serves at once, at most.
        sharing: ``band``: they share its band; ``space``: all of them have the whole band, and hear each
            other's beams.
        noise_rise: Interference over noise at each terminal (row) when another one (column) is served with
            all power of its transmitter, Shape ``[S, T, T]``; None: nothing is heard of others.
    """

    def __init__(
        self,
        snr: Float64Array,
        members: BoolArray,
        at_once: int,
        sharing: Sharing,
        noise_rise: Float64Array | None,
    ) -> None:
        self.members, self.at_once, self.in_band = members, at_once, sharing == "band"
        self._snr, self._noise_rise = snr, noise_rise
        self._mean_snr = snr[..., 0] if snr.shape[-1] == 1 else snr.mean(-1)

    @property
    def varies(self) -> bool:
        """Whether the SNR of one slot is not that of all."""
        return len(self._snr) > 1

    @property
    def is_disturbed(self) -> bool:
        """Whether who is served changes the SINR of others."""
        return self._noise_rise is not None or (self.at_once > 1 and not self.in_band)

    def alone(self, slot: int) -> Float64Array:
        """SNR of each terminal over the band where it is served alone, Shape ``[T, F]``."""
        found: Float64Array = self._snr[slot if self.varies else 0]
        return found

    def mean_alone(self, slot: int) -> Float64Array:
        """Its mean over the band, Shape ``[T]``."""
        found: Float64Array = self._mean_snr[slot if self.varies else 0]
        return found

    def shares(self, served: BoolArray) -> Int64Array:
        """Number of terminals that share a transmitter and carrier in a slot, of each; at least 1."""
        if self.at_once == 1:
            return np.ones(len(served), np.int64)
        counts = (self.members & served).sum(1)
        found: Int64Array = np.maximum((self.members * counts[:, None]).sum(0), 1)
        return found

    def rise(self, slot: int, served: BoolArray, shares: Int64Array) -> Float64Array:
        """By how much interference lowers the SNR of each terminal as a factor, 1 for none; Shape ``[T]``."""
        # With the whole band, a terminal has a part of the power.
        own = np.ones(len(served)) if self.in_band else shares.astype(np.float64)
        if self._noise_rise is None:
            return own
        # Each of a transmitter's terminals gets its part of the power, of the band or of both.
        heard = self._noise_rise[slot if len(self._noise_rise) > 1 else 0] * (served / shares)
        found: Float64Array = own * (1 + heard.sum(1))
        return found


class Carried(NamedTuple):
    """What a slot carries, Shape ``[T]`` each; of terminals that it does not serve, anything."""

    bits: Int64Array
    """That come through."""
    sinr: Float64Array
    blocks: Int64Array
    """Transport blocks."""
    errors: Int64Array
    """Of these, how many are not decoded."""


class SlotRates(ABC):
    """A rate model in the slots of a frame.

    Args:
        sinr: Of the terminals.
    """

    def __init__(self, sinr: SlotSinr) -> None:
        self.sinr = sinr

    @abstractmethod
    def offered(self, slot: int) -> Int64Array:
        """Bits that a slot would carry for each terminal alone, as far as is known before, Shape ``[T]``."""

    @abstractmethod
    def carried(self, slot: int, served: BoolArray, waiting: Int64Array) -> Carried:
        """What a slot carries for the terminals that it serves; `offered` was asked for the slot before.

        Args:
            slot: Number of the slot in the frame.
            served: Which are served, Shape ``[T]``.
            waiting: Bits that wait for each, Shape ``[T]``.
        """


class ShannonRates(SlotRates):
    """log2(1 + SINR), up to that of the highest modulation and coding; the transmitter knows the SINR.

    Args:
        sinr: Of the terminals.
        bandwidth: Of each terminal's carrier [Hz], Shape ``[T]``.
        highest: Greatest spectral efficiency [bit/s/Hz]; None: no bound.
        slot_s: Length of a slot [s].
    """

    def __init__(self, sinr: SlotSinr, bandwidth: Float64Array, highest: float | None, slot_s: float) -> None:
        super().__init__(sinr)
        self._bandwidth, self._highest, self._slot_s = bandwidth, highest, slot_s
        count = len(bandwidth)
        self._one, self._none = np.ones(count, np.int64), np.zeros(count, np.int64)
        self._offered = [self._bits(sinr.mean_alone(0))]
        self._undisturbed = Carried(self._offered[0], sinr.mean_alone(0), self._one, self._none)

    def offered(self, slot: int) -> Int64Array:
        return self._bits(self.sinr.mean_alone(slot)) if self.sinr.varies else self._offered[0]

    def carried(self, slot: int, served: BoolArray, waiting: Int64Array) -> Carried:
        sinr = self.sinr
        if sinr.at_once == 1 and not sinr.varies and not sinr.is_disturbed:
            return self._undisturbed
        shares = sinr.shares(served)
        found = sinr.mean_alone(slot) / sinr.rise(slot, served, shares)
        bits = self._bits(found)
        return Carried(bits // shares if sinr.in_band else bits, found, self._one, self._none)

    def _bits(self, sinr: Float64Array) -> Int64Array:
        return slot_bits(self._bandwidth * shannon(sinr, self._highest), self._slot_s)


Gains = Callable[[Int64Array, Int64Array, Int64Array], Float64Array]
"""``gains(users, tx_beams, rx_beams)``: |y|² of these K in each slot and part of the band, Shape
``[K, S, F]``."""


def swept_gains(scored: Scored) -> Gains:
    """Gains that are the same in all slots and over the band, from the sweep of the frame."""

    def gains(users: Int64Array, tx_beams: Int64Array, rx_beams: Int64Array) -> Float64Array:
        found = amplitudes(scored.swept, len(scored.budget.users), users, tx_beams, rx_beams)
        power: Float64Array = found[:, None, None] ** 2
        return power

    return gains


def noise_rise(
    scored: Scored,
    layout: Layout,
    serving: Int64Array,
    gains: Gains,
    between_transmitters: bool,
    within_one: bool,
) -> Float64Array | None:
    """Interference over noise between terminals, on average over the band.

    Args:
        scored: The frame.
        layout: Terminals and transmitters.
        serving: Index of the user of each terminal with the transmitter that serves it, Shape ``[T]``.
        gains: Of beams.
        between_transmitters: Whether terminals hear beams of other transmitters.
        within_one: Whether terminals of one transmitter hear each other's beams.

    Returns:
        At each terminal (row) of the beam towards each other one (column), with all power of its
        transmitter, Shape ``[S, T, T]``; None where no terminal can hear another.
    """
    tx, carrier = layout.tx[serving], layout.carrier[serving]
    same = tx[:, None] == tx
    heard: BoolArray = (carrier[:, None] == carrier) & np.where(same, within_one, between_transmitters)
    np.fill_diagonal(heard, False)
    between = layout.rows[:, tx]
    tx_beam, rx_beam = scored.choices.tx_beam[serving], scored.choices.rx_beam[serving]
    heard &= (between >= 0) & (tx_beam >= 0) & (rx_beam >= 0)[:, None]
    if not heard.any():
        return None
    victims, culprits = heard.nonzero()
    rows = between[heard]
    beams = tx_beam[culprits].astype(np.int64), rx_beam[victims].astype(np.int64)
    gain = gains(rows, *beams).mean(-1)
    rise = np.zeros((gain.shape[1], *heard.shape))
    rise[:, heard] = (scored.budget.power_over_noise[rows][:, None] * gain).T
    return rise
