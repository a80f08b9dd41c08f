"""What a link has to say about beams: |y| of every pair that it lists, by H and in order, and SNR by |y|."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from caviar_clients.datasets.verification.findings import Finding
from caviar_protocol.arrays import Complex128Array, Float64Array
from caviar_protocol.space.beams import beam_gains, best_pairs
from caviar_protocol.space.scene import antennas
from caviar_protocol.topics import AntennaArray, Carrier, Channel, Link, Scene
from caviar_services.link.link_budget import noise_power

BEAM = 1e-9
"""Relative, of |y| from a recorded H."""
FROM_PATHS = 1e-5
"""Relative, of |y| from an H that the paths add up to: the link may have had it in single precision."""
SNR = 1e-9
"""Relative, of an SNR from |y|."""

User = tuple[str, str, str]
"""Carrier, transmitter and receiver."""


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
    """What of a user's pairs is wrong, what it should be and is: the first of the list, and the chosen one.

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


def arrays_fit(h: Complex128Array, tx: AntennaArray, rx: AntennaArray) -> bool:
    """Whether H has a row for each element of the receiver, and a column for each of the transmitter."""
    return h.shape == (rx.size, tx.size)
