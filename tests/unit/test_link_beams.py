"""The link `beams`: what each user got, and what it could have got."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given as for_all
from hypothesis import settings
from hypothesis import strategies as st
from link_builders import CARRIER, antenna, channel_of, choices, frame_of, given, random_h, scene_of

from caviar_protocol.arrays import Complex128Array
from caviar_protocol.codec import decode_payload, encode_payload
from caviar_protocol.errors import PayloadError
from caviar_protocol.space.antenna_arrays import beam_towards, dft_codebook
from caviar_protocol.space.scene import directions, pairs_of
from caviar_protocol.topics import AntennaDevice, Carrier, Channel, Link
from caviar_services.link.beams import BeamLink, BeamLinkSettings
from caviar_services.service import FrameInput, RunInfo, StepResult

BS = antenna("bs", "tx", (1, 4), power_dbm=30.0)
NEAR = antenna("near", "rx", (1, 2), (20.0, 10.0, 0.0), yaw=2.5)
FAR = antenna("uav", "rx", (1, 1), (100.0, -80.0, 60.0))
H: dict[tuple[str, str, str], Complex128Array] = {
    ("mmwave", "bs", "near"): random_h(1, 2, 4),
    ("mmwave", "bs", "uav"): random_h(2, 1, 4),
}


def stepped(
    *actions: FrameInput,
    devices: tuple[AntennaDevice, ...] = (BS, NEAR, FAR),
    channel: Channel | None = None,
    **given_settings: Any,
) -> StepResult:
    link = BeamLink(BeamLinkSettings(**given_settings), RunInfo(name="link"))
    scene = scene_of(*devices)
    channel = channel or channel_of(("bs",), ("near", "uav"), H)
    return link.step(frame_of(given("scene", scene), given("channel", channel), *actions))


def linked(*actions: FrameInput, **more: Any) -> Link:
    product = stepped(*actions, **more).products["link"]
    assert isinstance(product, Link)
    return product


def brute_force(h: Complex128Array, tx: AntennaDevice, rx: AntennaDevice) -> dict[tuple[int, int], float]:
    """|w* H f| of every pair, one product after the other."""
    return {
        (p, q): abs(complex(w.conj() @ h @ f.conj()))
        for p, f in enumerate(dft_codebook(tx.array))
        for q, w in enumerate(dft_codebook(rx.array))
    }


def test_every_field_follows_from_h_by_brute_force() -> None:
    link = linked(choices("agent", ("bs", "near", 3, 1), ("bs", "uav", 2, 0)), top_k=3)
    assert (link.tx, link.rx, link.carrier) == (("bs", "bs"), ("near", "uav"), ("mmwave", "mmwave"))
    at_tx, at_rx = directions(scene_of(BS, NEAR, FAR), pairs_of(scene_of(BS, NEAR, FAR)))
    for u, (rx, pair) in enumerate(((NEAR, (3, 1)), (FAR, (2, 0)))):
        all_y = brute_force(H["mmwave", "bs", rx.name], BS, rx)
        ranked = sorted(all_y, key=lambda pair: -all_y[pair])[:3]
        assert (link.tx_beam[u], link.rx_beam[u]) == pair
        assert link.abs_y[u] == pytest.approx(all_y[pair], rel=1e-12)
        assert list(zip(link.top_tx_beam[u], link.top_rx_beam[u], strict=True)) == ranked
        np.testing.assert_allclose(link.top_abs_y[u], [all_y[pair] for pair in ranked], rtol=1e-12)
        straight = (int(beam_towards(BS.array, at_tx[u])), int(beam_towards(rx.array, at_rx[u])))
        assert link.baseline_abs_y[u] == pytest.approx(all_y[straight], rel=1e-12)
    np.testing.assert_array_equal(link.reward, link.abs_y)


def test_azimuths_are_in_the_axes_of_each_end() -> None:
    link = linked()
    assert link.aod_azimuth[0] == pytest.approx(math.atan2(10, 20))
    assert link.aoa_azimuth[0] == pytest.approx(math.atan2(10, 20) + math.pi - 2.5)


def test_snr_and_rate_against_a_calculation_by_hand() -> None:
    """1 W through |y|² = 1e-10 into 1 MHz at 290 K with a noise figure of 10 dB.

    N = 1.380649e-23 · 290 · 1e6 · 10 = 4.00388e-14 W (−103.98 dBm); S = 1e-10 W; SNR = 2497.6.
    """
    carrier = Carrier(name="mmwave", frequency_hz=28e9, bandwidth_hz=1e6)
    device = antenna("r", "rx", (1, 1), (9.0, 0.0, 0.0))
    one_antenna = antenna("bs", "tx", power_dbm=30.0)
    channel = channel_of(("bs",), ("r",), {("mmwave", "bs", "r"): np.array([[1e-5 + 0j]])}, (carrier,))
    link = linked(
        choices("agent", ("bs", "r", 0, 0)),
        devices=(one_antenna, device),
        channel=channel,
        noise_figure_db=10.0,
    )
    assert link.snr[0] == pytest.approx(2497.58, rel=1e-5)
    assert link.snr_best[0] == link.snr[0]
    assert link.spectral_efficiency[0] == pytest.approx(11.2869, rel=1e-5)
    assert link.bit_rate[0] == pytest.approx(11.2869e6, rel=1e-5)


def test_transmit_power_moves_the_snr_and_not_abs_y() -> None:
    act = choices("agent", ("bs", "near", 1, 1))
    weak, strong = (
        linked(act, devices=(msgspec.structs.replace(BS, power_dbm=dbm), NEAR, FAR)) for dbm in (10.0, 23.0)
    )
    np.testing.assert_array_equal(weak.abs_y, strong.abs_y)
    assert strong.snr[0] / weak.snr[0] == pytest.approx(10**1.3)


def test_users_whose_best_beams_have_more_than_60_db_are_counted() -> None:
    best = 10 * np.log10(linked().snr_best)  # at 30 dBm
    assert best[1] > best[0] + 1

    def counts(over_db: float) -> dict[str, int]:
        power = 30.0 + 60.0 + over_db - float(best[1])
        return dict(stepped(devices=(msgspec.structs.replace(BS, power_dbm=power), NEAR, FAR)).counts)

    assert counts(-0.01) == {}
    assert counts(0.01) == {"snr-above-60-db": 1}


def test_spectral_efficiency_is_capped_where_set() -> None:
    act = choices("agent", ("bs", "near", 1, 1))
    free = linked(act)
    capped = linked(act, max_spectral_efficiency=2.5)
    assert free.spectral_efficiency[0] > 2.5
    assert capped.spectral_efficiency.tolist() == [2.5, 0.0]
    assert capped.bit_rate[0] == 2.5 * CARRIER.bandwidth_hz
    np.testing.assert_array_equal(free.snr, capped.snr)


@pytest.mark.parametrize("kind", ["abs_y", "normalised", "snr", "spectral_efficiency"])
def test_reward_is_what_the_settings_say(kind: Any) -> None:
    link = linked(choices("agent", ("bs", "near", 1, 1)), reward=kind)
    expected = link.abs_y / link.top_abs_y[:, 0] if kind == "normalised" else getattr(link, kind)
    np.testing.assert_allclose(link.reward, expected, rtol=1e-14)
    assert link.reward[0] > 0
    assert link.reward[1] == 0


def test_a_user_without_a_path_is_zero_and_counted() -> None:
    channel = channel_of(("bs",), ("near", "uav"), {("mmwave", "bs", "near"): H["mmwave", "bs", "near"]})
    result = stepped(
        choices("agent", ("bs", "near", 1, 1), ("bs", "uav", 3, 0)), channel=channel, reward="normalised"
    )
    link = result.products["link"]
    assert isinstance(link, Link)
    assert link.has_path.tolist() == [True, False]
    assert link.no_path == 1
    assert result.counts == {"users-without-path": 1}
    assert (link.tx_beam[1], link.rx_beam[1]) == (3, 0)
    assert set(link.top_tx_beam[1]) == set(link.top_rx_beam[1]) == {-1}
    for name in ("abs_y", "baseline_abs_y", "snr", "snr_best", "spectral_efficiency", "bit_rate", "reward"):
        assert getattr(link, name)[1] == 0
        assert getattr(link, name)[0] > 0
    assert not link.top_abs_y[1].any()


def test_a_user_that_nobody_serves_still_has_its_best_pair() -> None:
    link = linked(choices("agent", ("bs", "near", 1, 1)))
    assert (link.tx_beam[1], link.rx_beam[1], link.abs_y[1], link.snr[1]) == (-1, -1, 0, 0)
    assert link.top_abs_y[1, 0] > 0
    assert link.snr_best[1] > 0


def test_a_user_that_the_channel_does_not_cover_is_counted_apart() -> None:
    channel = channel_of(("bs",), ("near",), {("mmwave", "bs", "near"): H["mmwave", "bs", "near"]})
    result = stepped(channel=channel)
    link = result.products["link"]
    assert isinstance(link, Link)
    assert link.rx == ("near", "uav")
    assert link.no_path == 1
    assert result.counts == {"users-without-channel": 1}


def test_lists_of_best_pairs_are_as_long_as_the_largest_user_needs() -> None:
    """8 pairs for one user, 4 for the other, whose list ends with −1 and 0."""
    link = linked(top_k=10)
    assert link.top_abs_y.shape == (2, 8)
    assert link.top_tx_beam[1].tolist()[4:] == [-1] * 4
    assert sorted(link.top_tx_beam[1].tolist()[:4]) == [0, 1, 2, 3]
    assert not link.top_abs_y[1, 4:].any()


def test_a_frame_without_users_gives_an_empty_link() -> None:
    channel = channel_of(("bs",), (), {})
    link = linked(devices=(BS,), channel=channel)
    assert link.rx == ()
    assert link.top_abs_y.shape == (0, 0)


def test_two_carriers_have_their_own_channel_noise_and_beams() -> None:
    narrow = Carrier(name="narrow", frequency_hz=28e9, bandwidth_hz=1e6)
    h = {("mmwave", "bs", "near"): random_h(1, 2, 4), ("narrow", "bs", "near"): random_h(1, 2, 4)}
    channel = channel_of(("bs",), ("near",), h, (CARRIER, narrow))
    act = choices("agent", ("bs", "near", 1, 1), ("bs", "near", 2, 0, "narrow"))
    link = linked(act, devices=(BS, NEAR), channel=channel)
    assert link.carrier == ("mmwave", "narrow")
    assert link.tx_beam.tolist() == [1, 2]
    assert link.snr_best[1] / link.snr_best[0] == pytest.approx(100)


@pytest.mark.parametrize("power", [math.inf, 1e4, -1e4])
def test_an_impossible_power_is_refused_naming_the_device(power: float) -> None:
    with pytest.raises(PayloadError, match=r"'bs' transmits.*power_dbm.*±200"):
        linked(devices=(msgspec.structs.replace(BS, power_dbm=power), NEAR, FAR))


def test_a_frame_without_channel_is_refused_by_name() -> None:
    link = BeamLink(BeamLinkSettings(), RunInfo(name="my-link"))
    with pytest.raises(PayloadError, match="frame 4 without a channel"):
        link.step(frame_of(given("scene", scene_of(BS)), number=4, service="my-link"))


def test_the_product_names_the_rung_it_stands_on() -> None:
    assert stepped().fidelity == "free-space"


@pytest.mark.parametrize(
    "wrong",
    [{"top_k": 0}, {"noise_figure_db": math.nan}, {"temperature_k": 0.0}, {"reward": "y"}, {"topk": 3}],
)
def test_settings_outside_their_range_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(wrong, BeamLinkSettings)


@settings(deadline=None, max_examples=60)
@for_all(
    seed=st.integers(0, 2**32 - 1),
    exponent=st.integers(-160, 3),
    tx=st.tuples(st.integers(1, 4), st.integers(1, 4)),
    rx=st.tuples(st.integers(1, 3), st.integers(1, 3)),
    power=st.floats(-200, 200),
    reach=st.booleans(),
    data=st.data(),
)
def test_any_channel_gives_finite_values_and_nothing_beats_the_best(
    seed: int,
    exponent: int,
    tx: tuple[int, int],
    rx: tuple[int, int],
    power: float,
    reach: bool,
    data: st.DataObject,
) -> None:
    """Also for amplitudes whose squares are not representable any more. `encode_payload` refuses
    whatever is not finite, and equal steps give equal bytes."""
    position = tuple(data.draw(st.floats(-1e3, 1e3)) for _ in range(3))
    devices = (antenna("bs", "tx", tx, power_dbm=power), antenna("r", "rx", rx, position))  # type: ignore[arg-type]
    h = random_h(seed, rx[0] * rx[1], tx[0] * tx[1], scale=10.0**exponent)
    channel = channel_of(("bs",), ("r",), {("mmwave", "bs", "r"): h} if reach else {})
    pair = (data.draw(st.integers(0, tx[0] * tx[1] - 1)), data.draw(st.integers(0, rx[0] * rx[1] - 1)))
    act = choices("agent", ("bs", "r", *pair))
    link = linked(act, devices=devices, channel=channel, reward="normalised")
    encoded = encode_payload(link)
    assert decode_payload("link", *encoded) == link
    assert encode_payload(linked(act, devices=devices, channel=channel, reward="normalised")) == encoded
    best = link.top_abs_y[0, 0]
    assert 0 <= link.abs_y[0] <= best
    assert 0 <= link.baseline_abs_y[0] <= best
    assert 0 <= link.reward[0] <= 1
    assert (link.reward[0] > 0) == (reach and link.abs_y[0] > 0)
    assert np.all(np.diff(link.top_abs_y[0]) <= 0)
    assert link.snr[0] <= link.snr_best[0]
