"""Channels within a frame: from paths as the channel's own responses have them, and what slots make of it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from link_builders import choices, given
from msgspec.structs import replace
from test_protocol_cell_link_adaptation import waterfall

from caviar_protocol.cell.link_adaptation import BlockTable
from caviar_protocol.cell.traffic import Traffic
from caviar_protocol.errors import PayloadError, ScenarioError
from caviar_protocol.multipath import slot_offsets, subcarrier_offsets
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.space.antenna_arrays import dft_codebook
from caviar_protocol.space.coordinates import quaternion_from_euler
from caviar_protocol.topics import AntennaArray, AntennaDevice, Carrier, Channel, Link, Scene
from caviar_services.channel.statistical.geometric import GeometricChannel
from caviar_services.channel.statistical.waves import GeometricSettings
from caviar_services.link import cell as module
from caviar_services.link.base import users_of
from caviar_services.link.cell import CellLink
from caviar_services.link.link_budget import noise_power
from caviar_services.link.nr import Blocks
from caviar_services.link.slot_rates import band_points, responses
from caviar_services.link.terminals import CellSettings
from caviar_services.service import Frame, Preparation, RunInfo

CARRIERS = (
    Carrier(
        name="mmwave", frequency_hz=28e9, subcarriers=48, subcarrier_spacing_hz=1e6, slots=5,
        slot_duration_s=2e-3,
    ),
    Carrier(
        name="sub6", frequency_hz=3.5e9, bandwidth_hz=60e6, subcarriers=48, subcarrier_spacing_hz=1e6,
        slots=5, slot_duration_s=2e-3,
    ),
)  # fmt: skip
PERIOD_NS = 10_000_000
BEAMS = {("bs.0", "car.0/rx"): (3, 1), ("bs.0", "car.1/rx"): (7, 0), ("bs.1", "car.1/rx"): (2, 1)}


def scene() -> Scene:
    """Two base stations of other arrays, turned; a car that drives at 20 m/s and one that stands."""
    station = AntennaDevice(name="bs.0", role="tx", position=(0, 0, 9), array=AntennaArray(columns=4, rows=2))
    devices = (
        replace(station, orientation=quaternion_from_euler(0.3, 0.1), power_dbm=20.0),
        replace(station, name="bs.1", position=(60, 5, 7), array=AntennaArray(columns=4), power_dbm=27.0),
        *(
            AntennaDevice(
                name=f"car.{n}/rx",
                role="rx",
                parent=f"car.{n}",
                position=(0, 0, 1),
                array=AntennaArray(columns=2),
            )
            for n in range(2)
        ),
    )
    return Scene(
        names=("car.0", "car.1"),
        classes=("car",) * 2,
        assets=("",) * 2,
        position=np.array([[30.0, 8.0, 0.7], [45.0, -9.0, 0.7]]),
        orientation=np.array([quaternion_from_euler(0.4), quaternion_from_euler(-2.0)]),
        velocity=np.array([[18.0, 8.0, 0.0], [0.0, 0.0, 0.0]]),
        dimensions=np.full((2, 3), 2.0),
        devices=devices,
    )


def frame(*more: Any) -> Frame:
    inputs = (given("scene", scene()), *more)
    return Frame(episode=0, number=0, t_ns=0, inputs=inputs, service="link", seed=4)


@pytest.fixture(scope="module")
def channel() -> Channel:
    settings = GeometricSettings(
        components=4, normalization="path-loss", delay_spread_ns=80.0, k_factor_db=0.0
    )
    model = GeometricChannel(settings, RunInfo(name="channel", carriers=CARRIERS))
    model.prepare(Preparation(demand={"channel": frozenset({"h", "hf"})}))
    product = model.step(frame()).products["channel"]
    assert isinstance(product, Channel)
    return product


def test_responses_are_those_of_the_channel_at_its_slots_and_subcarriers(channel: Channel) -> None:
    """Of all pairs of devices on both carriers, with beams of their own."""
    users = users_of(scene(), CARRIERS)
    asked = np.arange(len(users))
    tx_beams = np.array([n % user.tx.array.size for n, user in enumerate(users)])
    rx_beams = np.array([n % 2 for n, _ in enumerate(users)])
    points = np.array([subcarrier_offsets(carrier) for carrier in CARRIERS])
    found = responses(channel, scene(), users, asked, tx_beams, rx_beams, slot_offsets(CARRIERS[0]), points)
    matrices = {(response.carrier, response.tx, response.rx): response.h for response in channel.hf}
    for n, (user, place) in enumerate(zip(users, users.channel_indices(channel), strict=True)):
        assert place is not None
        w = dft_codebook(user.rx.array)[rx_beams[n]]
        f = dft_codebook(user.tx.array)[tx_beams[n]].conj()
        expected = w.conj() @ matrices[place] @ f
        scale = np.abs(matrices[place]).max()
        np.testing.assert_allclose(found[n], expected, rtol=0, atol=2e-5 * scale)
    moving = [n for n, user in enumerate(users) if user.rx.parent == "car.0"]
    assert np.ptp(np.abs(found[moving]), axis=1).max() > 0.1 * np.abs(found[moving]).max()


def cell(**settings: Any) -> CellLink:
    given_settings = {"slots": 5, "traffic": (Traffic(),), "association": "agent", **settings}
    run = RunInfo(name="link", sampling_period_ns=PERIOD_NS, carriers=CARRIERS[:1])
    link = CellLink(CellSettings(**given_settings), run)
    link.reset(0, 1, 0)
    return link


def granted(channel: Channel, *pairs: tuple[str, str]) -> Frame:
    """A frame on the first carrier with beams of these pairs."""
    one = replace(
        channel,
        carriers=channel.carriers[:1],
        a=channel.a[:1],
        doppler=channel.doppler[:1],
        h=tuple(matrix for matrix in channel.h if matrix.carrier == 0),
        hf=(),
    )
    act = choices("agent", *((*pair, *BEAMS[pair]) for pair in pairs))
    return frame(given("channel", one), act)


def linked(link: CellLink, granted_frame: Frame) -> Link:
    product = link.step(granted_frame).products["link"]
    assert isinstance(product, Link)
    return product


def power(channel: Channel, tx: str, rx: str, tx_beam: int, rx_beam: int, slot: int) -> float:
    """P·|y|² [W] at the carrier in a slot of 2 ms, from the channel's own response."""
    devices = {device.name: device for device in scene().devices if isinstance(device, AntennaDevice)}
    found = next(r.h for r in channel.hf if (r.carrier, channel.tx[r.tx], channel.rx[r.rx]) == (0, tx, rx))
    h = found[slot, 24]
    w, f = dft_codebook(devices[rx].array)[rx_beam], dft_codebook(devices[tx].array)[tx_beam].conj()
    return float(10 ** ((devices[tx].power_dbm - 30) / 10) * abs(w.conj() @ h @ f) ** 2)


def test_each_slot_has_the_sinr_of_its_instant(channel: Channel) -> None:
    """Two transmitters at once; the mean over the slots of S/(I + N)."""
    pairs = ("bs.0", "car.0/rx"), ("bs.1", "car.1/rx")
    found = linked(cell(selective=("time",)), granted(channel, *pairs))
    noise = noise_power(CARRIERS[0], 9.0, 290.0)
    users = list(zip(found.tx, found.rx, strict=True))
    for (tx, rx), (other, victim) in (pairs, pairs[::-1]):
        (tx_beam, rx_beam), (interfering, _) = BEAMS[tx, rx], BEAMS[other, victim]
        sinr = [
            power(channel, tx, rx, tx_beam, rx_beam, slot)
            / (power(channel, other, rx, interfering, rx_beam, slot) + noise)
            for slot in range(5)
        ]
        assert found.sinr[users.index((tx, rx))] == pytest.approx(np.mean(sinr), rel=1e-4)
        bits = sum(np.floor(100e6 * np.log2(1 + x) * 2e-3) for x in sinr)
        assert found.sent[users.index((tx, rx))] == pytest.approx(bits, rel=1e-4)
    still = linked(cell(), granted(channel, *pairs))
    assert abs(found.sinr[0] / still.sinr[0] - 1) > 0.02


def test_in_one_slot_a_frame_the_paths_say_what_h_says(channel: Channel) -> None:
    pairs = ("bs.0", "car.0/rx"), ("bs.1", "car.1/rx")
    by_paths = linked(cell(slots=1, selective=("time",)), granted(channel, *pairs))
    by_h = linked(cell(slots=1), granted(channel, *pairs))
    np.testing.assert_allclose(by_paths.sinr, by_h.sinr, rtol=1e-9)


def test_blocks_fail_by_the_effective_sinr_of_their_band(
    channel: Channel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Parameters of the mapping so small that the worst part of the band decides."""
    users = users_of(scene(), CARRIERS[:1])
    user = next(n for n, u in enumerate(users) if (u.tx.name, u.rx.name) == ("bs.0", "car.0/rx"))
    best = linked(cell(), granted(channel))
    # Beside the best pair of beams, pairs on several paths.
    ends = best.top_tx_beam[user].astype(np.int64), best.top_rx_beam[user].astype(np.int64)
    y = responses(channel, scene(), users, np.full(10, user), *ends, np.zeros(1), band_points(CARRIERS))
    of_all = 10 * np.log10(0.1 * np.abs(y[:, 0]) ** 2 / noise_power(CARRIERS[0], 9.0, 290.0))
    chosen = int(np.ptp(np.where(of_all.min(1, keepdims=True) > 0, of_all, 0), axis=1).argmax())
    monkeypatch.setitem(BEAMS, ("bs.0", "car.0/rx"), (int(ends[0][chosen]), int(ends[1][chosen])))
    snr_db = of_all[chosen]
    worst = float(snr_db.min())
    assert float(snr_db.max()) > worst + 2 > 2
    # With two schemes the first one is safe in the worst part, the second in the best part only.
    table = waterfall([worst - 4, worst + 1])
    table = BlockTable(table.bits, table.error, -5.0, 0.1, np.full(2, 1e-3))
    monkeypatch.setattr(module, "load_blocks", lambda *_: {"mmwave": Blocks((table,), 1)})
    link = cell(rate_model="nr", selective=("frequency",))
    link.prepare(Preparation(demand={"link": frozenset()}))
    found = linked(link, granted(channel, ("bs.0", "car.0/rx")))
    assert (found.sent[user], found.block_errors.sum()) == (5 * table.bits[0], 0)
    assert found.sinr[user] == pytest.approx((10 ** (snr_db / 10)).mean(), rel=1e-9)


def test_a_band_has_a_point_in_each_resource_block_up_to_a_bound() -> None:
    points = band_points(CARRIERS)
    assert points.shape == (2, 4)
    np.testing.assert_allclose(points[0], [-18e6, -6e6, 6e6, 18e6])
    wide = Carrier(
        name="w", frequency_hz=28e9, bandwidth_hz=400e6, subcarriers=3168, subcarrier_spacing_hz=120e3
    )
    assert band_points([wide, CARRIERS[0]]).shape == (2, 64)
    assert band_points([Carrier(name="flat", frequency_hz=28e9)]).tolist() == [[0.0]]


def test_channels_that_do_not_follow_from_paths_are_refused(channel: Channel) -> None:
    exact = granted(replace(channel, rung="spherical"), ("bs.0", "car.0/rx"))
    with pytest.raises(PayloadError, match="rung 'spherical'"):
        cell(selective=("time",)).step(exact)


def test_a_band_is_asked_for_with_the_rate_model_that_uses_it_and_carriers_that_have_one() -> None:
    place = Place("services.link.settings")
    with pytest.raises(ScenarioError, match=r"settings\.selective.*'frequency'.*'shannon'"):
        CellLink.check_settings(CellSettings(selective=("frequency",)), place)
    flat = (Carrier(name="flat", frequency_hz=28e9),)
    link = CellLink(
        CellSettings(selective=("frequency",), rate_model="nr"), RunInfo(name="link", carriers=flat)
    )
    with pytest.raises(ScenarioError, match=r"'frequency'.*24 subcarriers"):
        link.prepare(Preparation(demand={"link": frozenset()}))
