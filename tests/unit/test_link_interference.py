"""Interference: the SINR of the links `beams` and `cell` against the formula, product by product."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from link_builders import CARRIER, antenna, channel_of, choices, frame_of, given, random_h, scene_of

from caviar_protocol.arrays import Complex128Array
from caviar_protocol.cell.traffic import Traffic
from caviar_protocol.codec import encode_payload
from caviar_protocol.space.antenna_arrays import dft_codebook
from caviar_protocol.topics import AntennaDevice, Carrier, Link
from caviar_services.link.beams import BeamLink, BeamLinkSettings
from caviar_services.link.cell import CellLink
from caviar_services.link.link_budget import noise_power
from caviar_services.link.terminals import CellSettings
from caviar_services.service import Frame, FrameInput, RunInfo

SUB6 = Carrier(name="sub6", frequency_hz=3.5e9, bandwidth_hz=20e6)
TX = (
    antenna("bs.0", "tx", (1, 4), power_dbm=30.0),
    antenna("bs.1", "tx", (1, 4), (90.0, 0.0, 0.0), power_dbm=30.0),
    antenna("bs.2", "tx", (1, 2), (0.0, 90.0, 0.0), power_dbm=37.0),
)
RX = (
    antenna("a", "rx", (1, 2), (20.0, 10.0, 0.0)),
    antenna("b", "rx", (1, 2), (40.0, 10.0, 0.0)),
    antenna("c", "rx", (1, 1), (70.0, 10.0, 0.0)),
)
D = antenna("d", "rx", (1, 2), (99.0, 1.0, 0.0))
DEVICES = {device.name: device for device in (*TX, *RX, D)}
NOISE = noise_power(CARRIER, 9.0, 290.0)
Beams = dict[tuple[str, str], tuple[int, int]]
Matrices = dict[tuple[str, str, str], Complex128Array]


def matrices(tx: tuple[AntennaDevice, ...], rx: tuple[AntennaDevice, ...], *carriers: str) -> Matrices:
    """Random H; that of the last pair is missing, as of a user without a path."""
    pairs = [(c, t, r) for c in carriers or ("mmwave",) for t in tx for r in rx]
    return {
        (c, t.name, r.name): random_h(7 + n, r.array.size, t.array.size, 3e-7)
        for n, (c, t, r) in enumerate(pairs[: len(pairs) - (len(pairs) > 2)])
    }


def frame(h: Matrices, beams: Beams, carriers: tuple[Carrier, ...] = (CARRIER,)) -> Frame:
    tx, rx = (tuple(dict.fromkeys(key[end] for key in sorted(h))) for end in (1, 2))
    scene = scene_of(*(DEVICES[name] for name in (*tx, *rx)))
    act = choices("agent", *((*pair, *chosen) for pair, chosen in beams.items()))
    inputs: tuple[FrameInput, ...] = (
        given("scene", scene),
        given("channel", channel_of(tx, rx, h, carriers)),
    )
    return frame_of(*inputs, act)


def power(h: Matrices, tx: str, rx: str, tx_beam: int, rx_beam: int, carrier: str = "mmwave") -> float:
    """P·|w* H f|² [W] by the codebooks as vectors."""
    if (carrier, tx, rx) not in h:
        return 0.0
    w = dft_codebook(DEVICES[rx].array)[rx_beam]
    f = dft_codebook(DEVICES[tx].array)[tx_beam].conj()
    watts = 10 ** ((DEVICES[tx].power_dbm - 30) / 10)
    return float(watts * abs(w.conj() @ h[carrier, tx, rx] @ f) ** 2)


def beams_link(granted: Frame, **settings: Any) -> Link:
    link = BeamLink(BeamLinkSettings(**settings), RunInfo(name="link"))
    product = link.step(granted).products["link"]
    assert isinstance(product, Link)
    return product


def cell_link(granted: Frame, **settings: Any) -> Link:
    link = CellLink(
        CellSettings(**{"traffic": (Traffic(),), "association": "agent", **settings}),
        RunInfo(name="link", sampling_period_ns=10_000_000),
    )
    link.reset(0, 1, 0)
    product = link.step(granted).products["link"]
    assert isinstance(product, Link)
    return product


def of_user(found: Link, field: str, tx: str, rx: str, carrier: str = "mmwave") -> float:
    users = list(zip(found.tx, found.rx, found.carrier, strict=True))
    return float(getattr(found, field)[users.index((tx, rx, carrier))])


def test_two_transmitters_of_equal_power_at_one_user() -> None:
    """S = I: the SINR is S/(S + N), a little below 1; in `beams`, and in a slot of `cell`."""
    h = {
        ("mmwave", tx, rx): np.full((DEVICES[rx].array.size, 4), 2e-6 + 0j)
        for tx, rx in (("bs.0", "c"), ("bs.1", "c"), ("bs.1", "d"))
    }
    granted = frame(h, {("bs.0", "c"): (0, 0), ("bs.1", "d"): (0, 0)})
    received = 1.0 * abs(4 * 2e-6 / 2) ** 2  # 1 W, four elements in phase, a beam of unit norm
    expected = received / (received + NOISE)
    assert 0.8 < expected < 1
    for found in (beams_link(granted, interference=True), cell_link(granted)):
        assert of_user(found, "sinr", "bs.0", "c") == pytest.approx(expected, rel=1e-12)
        assert of_user(found, "snr", "bs.0", "c") == pytest.approx(received / NOISE, rel=1e-12)
        # The other user hears nothing of the first transmitter, from which it has no path.
        assert of_user(found, "sinr", "bs.1", "d") == of_user(found, "snr", "bs.1", "d")


def test_beams_hear_the_mean_of_what_each_other_transmitter_sends_to_its_users() -> None:
    """Three transmitters of other powers and arrays; one of them serves two receivers, one of these two."""
    h = matrices(TX, RX)
    chosen: Beams = {
        ("bs.0", "a"): (1, 1), ("bs.0", "b"): (3, 0), ("bs.1", "b"): (2, 1), ("bs.2", "a"): (1, 0),
    }  # fmt: skip
    found = beams_link(frame(h, chosen), interference=True, reward="spectral_efficiency")
    for (tx, rx), (tx_beam, rx_beam) in chosen.items():
        heard = 0.0
        for other in {t for t, _ in chosen} - {tx}:
            sent = [power(h, other, rx, f, rx_beam) for (t, _), (f, _) in chosen.items() if t == other]
            heard += sum(sent) / len(sent)
        expected = power(h, tx, rx, tx_beam, rx_beam) / (heard + NOISE)
        assert of_user(found, "sinr", tx, rx) == pytest.approx(expected, rel=1e-9)
        efficiency = np.log2(1 + expected)
        assert of_user(found, "spectral_efficiency", tx, rx) == pytest.approx(efficiency, rel=1e-9)
        assert of_user(found, "bit_rate", tx, rx) == pytest.approx(100e6 * efficiency, rel=1e-9)
        assert of_user(found, "reward", tx, rx) == of_user(found, "spectral_efficiency", tx, rx)
    assert of_user(found, "sinr", "bs.1", "a") == 0.0


def test_a_carrier_hears_nothing_of_another() -> None:
    h = matrices(TX[:2], RX[:2], "mmwave", "sub6")
    chosen: Beams = {("bs.0", "a"): (1, 1), ("bs.1", "b"): (2, 1)}
    found = beams_link(frame(h, chosen, (CARRIER, SUB6)), interference=True)
    for carrier in (CARRIER, SUB6):
        signal = power(h, "bs.0", "a", 1, 1, carrier.name)
        heard = power(h, "bs.1", "a", 2, 1, carrier.name)
        expected = signal / (heard + noise_power(carrier, 9.0, 290.0))
        assert of_user(found, "sinr", "bs.0", "a", carrier.name) == pytest.approx(expected, rel=1e-9)


def test_without_the_setting_the_bytes_of_beams_are_those_of_before() -> None:
    granted = frame(matrices(TX, RX), {("bs.0", "a"): (1, 1), ("bs.1", "b"): (2, 1)})
    plain, heard = beams_link(granted), beams_link(granted, interference=True)
    assert plain.sinr is None
    assert b"sinr" not in encode_payload(plain)[0]
    assert heard.sinr is not None
    assert (heard.snr == plain.snr).all()


def test_a_slot_has_the_interference_of_those_that_it_serves() -> None:
    """Two transmitters with two receivers each, full buffers: slots take all combinations in turn."""
    h = matrices(TX[:2], (*RX, D))
    chosen: Beams = {
        ("bs.0", "a"): (1, 1), ("bs.0", "b"): (3, 0), ("bs.1", "c"): (2, 0), ("bs.1", "d"): (0, 1),
    }  # fmt: skip
    found = cell_link(frame(h, chosen), slots=2, scheduler="round-robin")
    # Slot 0 serves a and c, slot 1 serves b and d.
    for (tx, r), (other, victim) in ((("bs.0", "a"), ("bs.1", "c")), (("bs.1", "d"), ("bs.0", "b"))):
        tx_beam, rx_beam = chosen[tx, r]
        heard = power(h, other, r, chosen[other, victim][0], rx_beam)
        expected = power(h, tx, r, tx_beam, rx_beam) / (heard + NOISE)
        assert of_user(found, "sinr", tx, r) == pytest.approx(expected, rel=1e-9)
        bits = np.floor(100e6 * np.log2(1 + expected) * 5e-3 + 1e-6)
        assert of_user(found, "sent", tx, r) == bits
    alone = cell_link(frame(h, chosen), slots=2, interference=False)
    assert of_user(alone, "sinr", "bs.0", "a") == of_user(alone, "snr", "bs.0", "a")


@pytest.mark.parametrize("sharing", ["band", "space"])
def test_users_served_at_once_share_power_and_band_or_hear_each_other(sharing: str) -> None:
    """One transmitter with two receivers, another with one, all in each slot."""
    h = matrices(TX[:2], RX)
    chosen: Beams = {("bs.0", "a"): (1, 1), ("bs.0", "b"): (3, 0), ("bs.1", "c"): (2, 0)}
    h["mmwave", "bs.1", "c"] = random_h(99, 1, 4, 3e-7)
    found = cell_link(frame(h, chosen), users_per_slot=2, sharing=sharing)
    a, b, c = (power(h, tx, rx, *beams) for (tx, rx), beams in chosen.items())
    from_other = power(h, "bs.1", "a", 2, 1)
    at_c = (power(h, "bs.0", "c", 1, 0) + power(h, "bs.0", "c", 3, 0)) / 2
    if sharing == "band":
        of_a = a / (from_other + NOISE)
        bits = np.floor(100e6 * np.log2(1 + of_a) * 1e-2 + 1e-6) // 2
    else:
        of_a = a / 2 / (power(h, "bs.0", "a", 3, 1) / 2 + from_other + NOISE)
        bits = np.floor(100e6 * np.log2(1 + of_a) * 1e-2 + 1e-6)
    assert b > 0
    assert of_user(found, "sinr", "bs.0", "a") == pytest.approx(of_a, rel=1e-9)
    assert of_user(found, "sent", "bs.0", "a") == bits
    assert of_user(found, "sinr", "bs.1", "c") == pytest.approx(c / (at_c + NOISE), rel=1e-9)


def test_many_episodes_at_once_are_computed_without_interference_only() -> None:
    assert BeamLink.computes_batches({})
    assert not BeamLink.computes_batches({"interference": True})
