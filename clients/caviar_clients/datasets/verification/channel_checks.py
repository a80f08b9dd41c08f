"""Checks of a channel and its link: paths by their points, gains below those of free space, H as the sum of
its paths, |y| of the pairs of beams by H, and SNR by |y|.

Points of interaction are recorded, so the geometry of each path is computed anew from them: delay,
departure, arrival and Doppler shift (`caviar_services.channel.paths`). What happens at a point
takes power and brings none: |a| of a path is at most c/(4πf·cτ) times the amplitudes of both elements towards
it (Friis 1946), of which reflection and transmission leave the part that Fresnel's coefficients say.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from caviar_clients.datasets.verification import Finding
from caviar_protocol.arrays import BoolArray, Complex128Array, Float64Array
from caviar_protocol.space.antenna_arrays import steering_vector
from caviar_protocol.space.beams import beam_gains, best_pairs
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT, unit_vectors
from caviar_protocol.space.scene import antennas
from caviar_protocol.topics import Carrier, Channel, Link, Scene
from caviar_protocol.topics.channel import PLANE_WAVES, Interaction
from caviar_services.channel.paths import Antenna, PathGeometry, Turning, path_geometry
from caviar_services.link.link_budget import noise_power

GAIN_DB = 0.5
"""Of a line of sight from free space; air and foliage take no more over a street."""
DIFFRACTED_DB = 6.1
"""Above free space that a diffraction may bring a path: the uniform theory of diffraction adds four terms,
each of at most 1/2 of the wave that arrives (Kouyoumjian and Pathak 1974)."""
DELAY = 1e-6
"""Relative, of delays from lengths."""
ANGLE_RAD = 1e-4
DOPPLER = 1e-6
"""Of a Doppler shift from that of all speeds together, relative."""
DOPPLER_HZ = 1e-3
MATRIX = 1e-5
"""Of H from the sum of its paths, relative; a channel may round H to single precision."""
PROPORTION = 0.3
"""Of an H of spherical waves, or of paths for each element, from the sum of its paths with plane waves,
relative, up to which the factor between both is looked at."""
FACTOR_DB = 3.0
"""Of that factor, from 1."""

BEAM = 1e-9
"""Relative, of |y| from a recorded H."""
FROM_PATHS = 1e-5
"""Relative, of |y| from an H that the paths add up to: the link may have had it in single precision."""
SNR = 1e-9
"""Relative, of an SNR from |y|."""

User = tuple[str, str, str]
"""Carrier, transmitter and receiver."""


@dataclass(frozen=True, eq=False)
class Pair:
    """The paths of a transmitter and a receiver in one scene."""

    place: tuple[int, int]
    """Episode and scene."""
    channel: Channel
    tx: int
    """Index into ``channel.tx``; ``rx`` into ``channel.rx``."""
    rx: int
    ends: tuple[Antenna, Antenna]
    geometry: PathGeometry
    """By the points of the paths."""

    @property
    def cut(self) -> slice:
        """Slice of the path axis."""
        return self.channel.pair(self.channel.tx[self.tx], self.user)

    @property
    def user(self) -> str:
        """Name of the receiver."""
        return self.channel.rx[self.rx]

    def finding(self, what: str, expected: str, found: str) -> Finding:
        """A finding of this receiver."""
        return Finding(*self.place, self.user, what, expected, found)


def pair_of(
    place: tuple[int, int],
    scene: Scene,
    channel: Channel,
    pair: tuple[int, int],
    ends: tuple[Antenna, Antenna],
) -> Pair:
    """Make a `Pair`: the geometry of its paths is computed.

    Args:
        place: Episode and scene.
        scene: With the objects at which paths have points.
        channel: Of the scene.
        pair: Indices of transmitter and receiver.
        ends: Their antennas.
    """
    cut = channel.pair(channel.tx[pair[0]], channel.rx[pair[1]])
    points, types, objects = channel.points[cut], channel.interactions[cut], channel.objects[cut]
    count = len(points)
    at = {name: index for index, name in enumerate(scene.names)}
    # Scenery stands: an index below 0 finds the row of zeros at the end.
    moving = np.array([*(at.get(name, -1) for name in channel.object_names), -1], np.int64)[objects]
    velocity = np.concatenate([scene.velocity, np.zeros((1, 3))])[moving]
    if scene.angular_velocity is not None and points.shape[1]:
        turning = Turning(scene.position, scene.angular_velocity)
        velocity = velocity + turning.velocity(moving.astype(np.int32), points)
    tx, rx = ends

    def repeated(vector: Float64Array) -> Float64Array:
        return np.broadcast_to(vector, (count, 3))

    geometry = path_geometry(
        repeated(tx.position),
        points,
        repeated(rx.position),
        (types != 0).sum(1).astype(np.int64),
        repeated(tx.velocity),
        velocity,
        repeated(rx.velocity),
    )
    return Pair(place, channel, *pair, ends, geometry)


# --- geometry -----------------------------------------------------------------------------------------------


def check_geometry(pair: Pair) -> Iterator[Finding]:
    """Delays, directions and Doppler shifts that are not those of the points of the paths.

    Args:
        pair: Its paths.

    Yields:
        Of each quantity the path that is farthest off.
    """
    channel, cut, right = pair.channel, pair.cut, pair.geometry
    tau = channel.tau[cut]
    if not len(tau):
        return
    off = np.abs(tau - right.tau) - DELAY * right.tau
    worst = int(off.argmax())
    if off[worst] > 0:
        yield pair.finding(
            f"delay of {_name(pair, worst)}", f"{right.tau[worst]:.9g} s", f"{tau[worst]:.9g} s"
        )
    for name, directions in (("aod", right.departure), ("aoa", right.arrival)):
        angles = getattr(channel, name)[cut]
        apart = np.linalg.norm(unit_vectors(angles) - directions, axis=1)
        # A path without length has no direction.
        apart[right.tau == 0] = 0.0
        worst = int(apart.argmax())
        if apart[worst] > ANGLE_RAD:
            expected = _angles(directions[worst])
            yield pair.finding(f"{name} of {_name(pair, worst)}", expected, _angles_text(angles[worst]))
    yield from _doppler(pair)


def _doppler(pair: Pair) -> Iterator[Finding]:
    channel, cut = pair.channel, pair.cut
    speeds = max(float(np.linalg.norm(end.velocity)) for end in pair.ends)
    for c, carrier in enumerate(channel.carriers):
        right = carrier.frequency_hz * pair.geometry.doppler_ratio
        found = channel.doppler[c, cut]
        allowed = DOPPLER_HZ + DOPPLER * (np.abs(right) + carrier.frequency_hz * speeds / SPEED_OF_LIGHT)
        off = np.abs(found - right) - allowed
        worst = int(off.argmax())
        if off[worst] > 0:
            what = f"Doppler shift of {_name(pair, worst)}, {carrier.name}"
            yield pair.finding(what, f"{right[worst]:.3f} Hz", f"{found[worst]:.3f} Hz")


def _name(pair: Pair, path: int) -> str:
    """A path of a pair by what it does."""
    channel, row = pair.channel, pair.cut.start + path
    kinds = channel.interactions[row]
    steps = [
        f"{Interaction(int(kind)).name.lower()} at {channel.object_names[thing] if thing >= 0 else 'a point'}"
        for kind, thing in zip(kinds.tolist(), channel.objects[row].tolist(), strict=True)
        if kind
    ]
    return f"path {path} ({', '.join(steps) or 'direct'})"


def _angles(direction: Float64Array) -> str:
    x, y, z = direction.tolist()
    return _angles_text(np.array([math.atan2(math.hypot(x, y), z), math.atan2(y, x)]))


def _angles_text(pair: Float64Array) -> str:
    return ", ".join(f"{math.degrees(angle):.2f}°" for angle in pair.tolist())


# --- gains --------------------------------------------------------------------------------------------------


def check_gains(pair: Pair) -> Iterator[Finding]:
    """Paths that bring more than free space does over their own length, on each carrier.

    Args:
        pair: Its paths.

    Yields:
        The path that is farthest above, of each carrier.
    """
    channel, cut = pair.channel, pair.cut
    tau, types = channel.tau[cut], channel.interactions[cut]
    if not len(tau) or not pair.ends[0].array.is_uniform or not pair.ends[1].array.is_uniform:
        return
    elements = np.ones(len(tau))
    for end, towards in zip(pair.ends, (pair.geometry.departure, pair.geometry.arrival), strict=True):
        elements = elements * np.linalg.norm(end.radiated(towards), axis=1)
    # Diffuse power is that of the surface that scatters, whose lengths before and after multiply.
    diffuse: BoolArray = (types == Interaction.SCATTERING).any(axis=1)
    bound = GAIN_DB + DIFFRACTED_DB * (types == Interaction.DIFFRACTION).sum(axis=1)
    bound[diffuse] = math.inf
    for c, carrier in enumerate(channel.carriers):
        with np.errstate(divide="ignore", invalid="ignore"):
            free = elements / (4 * math.pi * carrier.frequency_hz * tau)
            over = 20 * np.log10(np.abs(channel.a[c, cut]) / free)
        over = np.where(np.abs(channel.a[c, cut]) > 0, over - bound, -math.inf)
        worst = int(over.argmax())
        if over[worst] > 0:
            got = 20 * math.log10(abs(channel.a[c, cut][worst]))
            most = 20 * math.log10(free[worst]) if free[worst] > 0 else -math.inf
            what = f"gain of {_name(pair, worst)}, {carrier.name}"
            expected = f"at most {most:.2f} dB, of free space over {tau[worst] * SPEED_OF_LIGHT:.2f} m"
            yield pair.finding(what, expected, f"{got:.2f} dB")


# --- H ------------------------------------------------------------------------------------------------------


def matrix_of(pair: Pair, carrier: int) -> Complex128Array | None:
    """H of plane waves as the sum of its paths; None of arrays with several panels or polarizations.

    Args:
        pair: Its paths.
        carrier: Index of the carrier.

    Returns:
        h[m, n] = Σ a·exp(+j2π/λ·(u_rx·d_m + u_tx·d_n)) (`topics.ChannelMatrix`), Shape ``[Nr, Nt]``.
    """
    tx, rx = pair.ends
    if not tx.array.is_uniform or not rx.array.is_uniform:
        return None
    transmit = steering_vector(tx.array, unit_vectors(pair.channel.aod[pair.cut]) @ tx.rotation)
    receive = steering_vector(rx.array, unit_vectors(pair.channel.aoa[pair.cut]) @ rx.rotation)
    h: Complex128Array = (receive * pair.channel.a[carrier, pair.cut, None]).T @ transmit
    return h


def check_matrix(pair: Pair, carrier: int, h: Complex128Array) -> Iterator[Finding]:
    """An H that is not the sum of its paths.

    Of spherical waves, and of paths for each element, H differs from that sum; where it is nearly
    proportional to it, it has its magnitude.

    Args:
        pair: Its paths.
        carrier: Index of the carrier.
        h: Recorded, Shape ``[Nr, Nt]``.
    """
    right = matrix_of(pair, carrier)
    if right is None:
        return
    name = f"H, {pair.channel.carriers[carrier].name}"
    if right.shape != h.shape:
        yield pair.finding(
            name, f"{right.shape[0]} × {right.shape[1]} elements", f"{h.shape[0]} × {h.shape[1]}"
        )
        return
    size, scale = float(np.linalg.norm(h)), float(np.linalg.norm(right))
    # Waves that cancel leave what rounding leaves: the amplitudes are the scale of errors.
    summed = float(np.abs(pair.channel.a[carrier, pair.cut]).sum()) * math.sqrt(h.size)
    if pair.channel.rung in PLANE_WAVES:
        if float(np.linalg.norm(h - right)) > MATRIX * summed:
            yield pair.finding(name, f"‖H‖ {scale:.6g} as of its paths", _apart(h, right))
    elif scale > 0 and size > 0:
        factor = complex(np.vdot(right, h)) / scale**2
        rest = float(np.linalg.norm(h - factor * right))
        if rest < PROPORTION * size and abs(20 * math.log10(max(abs(factor), 1e-300))) > FACTOR_DB:
            yield pair.finding(name, f"‖H‖ about {scale:.6g} as of its paths", f"‖H‖ {size:.6g}")


def _apart(h: Complex128Array, right: Complex128Array) -> str:
    size, scale = float(np.linalg.norm(h)), float(np.linalg.norm(right))
    off = float(np.linalg.norm(h - right)) / scale if scale else math.inf
    return f"‖H‖ {size:.6g}, {off:.2g} of it apart"


# --- beams --------------------------------------------------------------------------------------------------


def check_flags(place: tuple[int, int], channel: Channel, link: Link) -> Iterator[Finding]:
    """Lines of sight of a link that are not those of its channel.

    Args:
        place: Episode and scene.
        channel: Of the scene.
        link: Of the scene.
    """
    for row, (tx, rx) in enumerate(zip(link.tx, link.rx, strict=True)):
        if tx in channel.tx and rx in channel.rx:
            right = bool(channel.los[channel.tx.index(tx), channel.rx.index(rx)])
            if right != bool(link.los[row]):
                words = {True: "free", False: "hidden"}
                yield Finding(*place, rx, "line of sight of the link", words[right], words[not right])


def check_beams(
    place: tuple[int, int], scene: Scene, link: Link, matrices: Mapping[User, tuple[Complex128Array, float]]
) -> Iterator[Finding]:
    """Pairs of beams that are not those of H.

    Args:
        place: Episode and scene.
        scene: With the arrays.
        link: Of the scene.
        matrices: H of each user, Shape ``[Nr, Nt]``, and how far |y| may be from it, relative.
    """
    arrays = {device.name: device.array for device in antennas(scene, "tx")}
    arrays |= {device.name: device.array for device in antennas(scene, "rx")}
    for row, user in enumerate(zip(link.carrier, link.tx, link.rx, strict=True)):
        if user not in matrices or not link.has_path[row]:
            continue
        _, tx, rx = user
        h, tolerance = matrices[user]
        abs_y = beam_gains(h[None], arrays[tx], arrays[rx])[0]
        for what, expected, found in _wrong_pairs(link, row, abs_y, tolerance):
            yield Finding(*place, rx, what, expected, found)


def _wrong_pairs(
    link: Link, row: int, abs_y: Float64Array, tolerance: float
) -> Iterator[tuple[str, str, str]]:
    """Faults of a user's pairs, what each should be and is: the first of the list, and the chosen one.

    Beams of equal |y| may stand in either order, as rounding has it.
    """
    listed = link.top_tx_beam.shape[1]
    best = best_pairs(abs_y[None], listed)
    error = tolerance * float(abs_y.max(initial=0.0))
    seen: set[tuple[int, int]] = set()
    for rank in range(min(listed, best.abs_y.shape[1])):
        pair = int(link.top_tx_beam[row, rank]), int(link.top_rx_beam[row, rank])
        said, right = float(link.top_abs_y[row, rank]), float(best.abs_y[0, rank])
        of_pair = _at(abs_y, pair)
        if of_pair is None or pair in seen or abs(of_pair - said) > error or abs(right - said) > error:
            expected = _pair_text(int(best.tx_beam[0, rank]), int(best.rx_beam[0, rank]), right)
            rank_text = "best pair of beams" if rank == 0 else f"pair of beams of rank {rank + 1}"
            yield rank_text, expected, _pair_text(*pair, said)
            break
        seen.add(pair)
    chosen = int(link.tx_beam[row]), int(link.rx_beam[row])
    right_y = 0.0 if -1 in chosen else _at(abs_y, chosen)
    said = float(link.abs_y[row])
    if right_y is None:
        beams = f"TX beams 0 to {abs_y.shape[0] - 1}, RX beams 0 to {abs_y.shape[1] - 1}"
        yield "chosen pair of beams", beams, _pair_text(*chosen, said)
    elif abs(right_y - said) > error:
        yield "chosen pair of beams", _pair_text(*chosen, right_y), _pair_text(*chosen, said)


def _at(abs_y: Float64Array, pair: tuple[int, int]) -> float | None:
    """|y| of a pair; None where the codebooks have no such beam."""
    inside = 0 <= pair[0] < abs_y.shape[0] and 0 <= pair[1] < abs_y.shape[1]
    return float(abs_y[pair]) if inside else None


def _pair_text(tx_beam: int, rx_beam: int, abs_y: float) -> str:
    return f"TX {tx_beam}, RX {rx_beam}, |y| {abs_y:.6g}"


def check_snr(
    place: tuple[int, int],
    scene: Scene,
    link: Link,
    carriers: tuple[Carrier, ...],
    settings: Mapping[str, Any],
) -> Iterator[Finding]:
    """SNRs that are not P·|y|²/(k·T·B·F) (`topics.Link`).

    Args:
        place: Episode and scene.
        scene: With the transmit powers.
        link: Of the scene.
        carriers: Of the channel.
        settings: Of the link: ``temperature_k`` and ``noise_figure_db``, where they are not the default.
    """
    figure, temperature = settings.get("noise_figure_db", 9.0), settings.get("temperature_k", 290.0)
    noise = {carrier.name: noise_power(carrier, figure, temperature) for carrier in carriers}
    power = {device.name: 1e-3 * 10 ** (device.power_dbm / 10) for device in antennas(scene, "tx")}
    kinds = [("SNR of the chosen pair", link.snr, link.abs_y)]
    if link.top_abs_y.shape[1]:
        kinds.append(("SNR of the best pair", link.snr_best, link.top_abs_y[:, 0]))
    for row, (carrier, tx, rx) in enumerate(zip(link.carrier, link.tx, link.rx, strict=True)):
        if carrier not in noise or tx not in power:
            continue
        for what, snr, abs_y in kinds:
            right = power[tx] * float(abs_y[row]) ** 2 / noise[carrier]
            if not np.isclose(snr[row], right, rtol=SNR, atol=0.0):
                yield Finding(*place, rx, what, f"{right:.6g}", f"{float(snr[row]):.6g}")
