"""The link `cell`: packets of each user, slot by slot."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from link_builders import CARRIER, antenna, channel_of, choices, frame_of, given, random_h, scene_of
from msgspec.structs import replace

from caviar_clients.session.prepared import prepare
from caviar_protocol.arrays import Complex128Array, Float64Array
from caviar_protocol.cell.traffic import Traffic
from caviar_protocol.codec import decode_payload, encode_payload
from caviar_protocol.errors import ProductError, ScenarioError
from caviar_protocol.scenario import DeviceSpec, find_scenario
from caviar_protocol.scenario.conversion import Place, convert_settings
from caviar_protocol.topics import AntennaDevice, Carrier, Link, UserSchedule
from caviar_services.link.cell import CellLink
from caviar_services.link.link_budget import noise_power
from caviar_services.link.terminals import CellSettings
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo

BS = antenna("bs", "tx", (1, 4), power_dbm=30.0)
A = antenna("a", "rx", (1, 1), (20.0, 10.0, 0.0))
B = antenna("b", "rx", (1, 1), (100.0, -80.0, 60.0))
C = antenna("c", "rx", (1, 1), (50.0, 0.0, 0.0))
ALL = choices("agent", *(("bs", rx, 1, 0) for rx in "abc"))
PERIOD_NS = 10_000_000
# 100 kbit a slot of 1 ms at 100 MHz and 1 bit/s/Hz.
STEADY = Traffic(model="constant", rate_bit_s=1e6, packet_bits=1000)


def link_of(*traffic: Traffic, carriers: tuple[Carrier, ...] = (CARRIER,), **settings: Any) -> CellLink:
    run = RunInfo(name="link", seed=1, sampling_period_ns=PERIOD_NS, carriers=carriers)
    link = CellLink(CellSettings(**{"slots": 10, "traffic": traffic or (STEADY,), **settings}), run)
    link.reset(0, 1, 0)
    return link


def h_of_snr(device: AntennaDevice, snr: float) -> Complex128Array:
    """H of a user with one receiving element whose beam 1 of `BS` has this SNR."""
    watts = 10 ** ((BS.power_dbm - 30) / 10)
    size = np.sqrt(snr * noise_power(CARRIER, 9.0, 290.0) / watts)
    n = np.arange(4)
    return (size * np.exp(2j * np.pi * n / 4) / 2)[None].astype(np.complex128)


def frames(
    snr: dict[str, float], count: int, *actions: FrameInput, devices: tuple[AntennaDevice, ...] = (A, B, C)
) -> list[Frame]:
    """Frames in which the receivers have these SNRs, with beam 1 of the base station."""
    present = tuple(device for device in devices if device.name in snr)
    h = {("mmwave", "bs", d.name): h_of_snr(d, snr[d.name]) for d in present if snr[d.name]}
    channel = channel_of(("bs",), tuple(d.name for d in present), h)
    inputs = (given("scene", scene_of(BS, *present)), given("channel", channel), *actions)
    return [replace(frame_of(*inputs, number=n), previous=n - 1) for n in range(count)]


def played(link: CellLink, granted: list[Frame]) -> list[Link]:
    found = []
    for frame in granted:
        product = link.step(frame).products["link"]
        assert isinstance(product, Link)
        decode_payload("link", *encode_payload(product))
        found.append(product)
    return found


def sums(links: list[Link], name: str) -> list[int]:
    total: list[int] = sum(getattr(link, name) for link in links).tolist()
    return total


def test_what_arrived_was_sent_or_dropped_or_waits_in_every_frame() -> None:
    """Channels, choices and users change at random; packets come and age."""
    rng = np.random.default_rng(3)
    traffic = (
        Traffic(users=("a",), model="poisson", rate_bit_s=60e6, packet_bits=4000, max_age_s=0.02),
        Traffic(users=("b",), model="alternating", rate_bit_s=90e6, light_rate_bit_s=1e6, period_s=0.07),
        Traffic(users=("c",), model="poisson", rate_bit_s=30e6, max_packets=20),
    )
    link = link_of(*traffic, scheduler="proportional-fair")
    granted = []
    for number in range(120):
        snr = {rx: float(rng.choice([0.0, 0.1, 1.0])) for rx in "abc"}
        chosen = choices("agent", *(("bs", rx, 1, 0) for rx in "abc" if rng.random() < 0.8))
        granted.append(replace(frames(snr, 1, chosen)[0], number=number, previous=number - 1))
    links = played(link, granted)
    before = np.zeros(3)
    for found in links:
        assert (found.buffered == before + found.arrived - found.sent - found.dropped).all()
        assert (found.waiting > 0).tolist() == (found.buffered > 0).tolist()
        before = found.buffered
    assert min(*sums(links, "sent"), *sums(links, "dropped")[::2]) > 1e6


def test_one_user_alone_gets_all_of_its_packets_through_in_the_slot_of_arrival() -> None:
    link = link_of()
    links = played(link, frames({"a": 1.0}, 5, choices("agent", ("bs", "a", 1, 0))))
    assert sums(links, "arrived") == sums(links, "sent") == [50_000]
    for found in links:
        assert found.delay.tolist() == pytest.approx([1e-3])
        assert found.throughput.tolist() == pytest.approx([1e6])
        assert found.sinr.tolist() == pytest.approx([1.0])
        assert (found.blocks.tolist(), found.block_errors.tolist()) == ([10], [0])
        assert found.buffered.tolist() == [0]


def test_a_user_of_a_slotted_queue_waits_as_long_as_the_formula_says() -> None:
    """M/D/1 in slots, load 0.5: 1.5 slots, within 2 %; a packet is what a slot carries."""
    traffic = Traffic(model="poisson", rate_bit_s=50e6, packet_bits=100_000)
    link = link_of(traffic, slots=1000)
    link._slot_s = 1e-3
    links = played(link, frames({"a": 1.0 + 1e-9}, 60, choices("agent", ("bs", "a", 1, 0))))
    delivered = np.array([found.delivered[0] for found in links])
    delay = np.array([found.delay[0] for found in links])
    assert delivered.sum() > 25_000
    assert (delay * delivered).sum() / delivered.sum() == pytest.approx(1.5e-3, rel=0.02)


def test_slots_go_round_and_one_user_a_slot_is_served() -> None:
    link = link_of(Traffic())
    links = played(link, frames({"a": 1.0, "b": 3.0, "c": 1.0}, 6, ALL))
    assert np.sum([found.blocks for found in links], 0).tolist() == [20, 20, 20]
    # 1 and 2 bit/s/Hz: 100 and 200 kbit a slot.
    sent = sums(links, "sent")
    assert [round(bits / 1e5) for bits in sent] == [20, 40, 20]


def test_users_that_share_a_slot_share_its_bandwidth() -> None:
    link = link_of(Traffic(), users_per_slot=2)
    links = played(link, frames({"a": 1.0, "b": 3.0, "c": 1.0}, 6, ALL))
    assert np.sum([found.blocks for found in links], 0).tolist() == [40, 40, 40]
    assert [round(bits / 1e5) for bits in sums(links, "sent")] == [20, 40, 20]


def test_max_rate_serves_the_best_channel_until_nothing_waits_there() -> None:
    link = link_of(Traffic(users=("b",)), STEADY, scheduler="max-rate")
    found = played(link, frames({"a": 1.0, "b": 3.0, "c": 1.0}, 1, ALL))[0]
    assert found.blocks.tolist() == [0, 10, 0]
    assert found.buffered[[0, 2]].tolist() == [10_000, 10_000]


def test_agents_schedule_the_receivers_that_take_turns() -> None:
    scheduled = [UserSchedule(tx="bs", rx=rx) for rx in ("a", "c")]
    one, two = (
        played(link_of(Traffic()), frames({"a": 1.0, "b": 1.0, "c": 1.0}, 1, ALL, choices("s", *chosen)))[0]
        for chosen in (scheduled[:1], scheduled)
    )
    assert one.blocks.tolist() == [10, 0, 0]
    assert two.blocks.tolist() == [5, 0, 5]


def test_without_beams_nothing_is_sent_and_packets_grow_old_and_are_dropped() -> None:
    link = link_of(replace(STEADY, max_age_s=0.025))
    links = played(link, frames({"a": 1.0}, 6))
    # A packet a slot: the first is dropped when it has waited for 25 slots.
    assert [found.buffered[0] for found in links] == [10_000, 20_000, 25_000, 25_000, 25_000, 25_000]
    assert sums(links, "dropped") == [35_000]
    assert links[-1].waiting.tolist() == pytest.approx([0.025])
    assert sums(links, "sent") == [0]


def test_a_full_buffer_has_always_as_much_as_can_be_sent() -> None:
    links = played(link_of(Traffic()), frames({"a": 2.0**7 - 1}, 3, choices("x", ("bs", "a", 1, 0))))
    for found in links:
        assert found.throughput[0] == pytest.approx(7 * 100e6, rel=1e-6)
        assert found.buffered[0] > 0


def test_the_rate_ends_at_that_of_the_best_modulation() -> None:
    act = choices("x", ("bs", "a", 1, 0))
    assert played(link_of(rate_model="capped"), frames({"a": 1e6}, 1, act))[0].spectral_efficiency == 7.4063
    link = link_of(rate_model="capped", max_spectral_efficiency=5.5547)
    assert played(link, frames({"a": 1e6}, 1, act))[0].spectral_efficiency == 5.5547


def test_a_terminal_is_served_by_the_transmitter_that_reaches_it_best() -> None:
    """Two base stations; what happened stands with the user of the one that serves, 0 with the other."""
    other = antenna("other", "tx", (1, 4), (200.0, 0.0, 10.0), power_dbm=30.0)
    h = {
        ("mmwave", tx, rx): h_of_snr(A, snr)
        for tx, rx, snr in (("bs", "a", 1.0), ("other", "a", 3.0), ("bs", "b", 3.0), ("other", "b", 1.0))
    }
    channel = channel_of(("bs", "other"), ("a", "b"), h)
    act = choices("agent", *((tx, rx, 1, 0) for tx in ("bs", "other") for rx in "ab"))
    frame = frame_of(given("scene", scene_of(BS, other, A, B)), given("channel", channel), act)
    found = played(link_of(), [frame])[0]
    assert list(zip(found.tx, found.rx, strict=True)) == [
        ("bs", "a"), ("bs", "b"), ("other", "a"), ("other", "b")
    ]  # fmt: skip
    assert found.arrived.tolist() == [0, 10_000, 10_000, 0]
    # Neither has to wait for the other: each is served by its own.
    assert found.blocks.tolist() == [0, 10, 10, 0]


def test_packets_of_a_user_do_not_depend_on_who_else_is_there() -> None:
    traffic = Traffic(model="poisson", rate_bit_s=20e6)
    alone = played(link_of(traffic), frames({"b": 1.0}, 30))
    together = played(link_of(traffic), frames({"a": 1.0, "b": 1.0, "c": 1.0}, 30))
    assert [found.arrived[0] for found in alone] == [found.arrived[1] for found in together]
    assert [found.arrived[0] for found in together] != [found.arrived[1] for found in together]


def test_a_user_that_leaves_takes_its_packets_along_and_comes_back_with_none() -> None:
    link = link_of()
    first, *_ = frames({"a": 1.0, "b": 1.0}, 1)
    away, back = frames({"b": 1.0}, 2)[1], frames({"a": 1.0, "b": 1.0}, 3)[2]
    assert "bits-of-users-that-left" not in link.step(first).counts
    gone = link.step(away)
    assert gone.counts["bits-of-users-that-left"] == 10_000
    (found,) = played(link, [back])
    assert found.buffered.tolist() == [10_000, 30_000]


def test_traffic_goes_on_in_frames_that_the_link_missed() -> None:
    """As in `drop` and `hold`, where a frame goes on without its link."""
    granted = frames({"a": 1.0}, 6)
    link = link_of()
    (first,) = played(link, granted[:1])
    (found,) = played(link, [replace(granted[4], previous=0)])
    assert (first.arrived[0], found.arrived[0]) == (10_000, 40_000)
    assert found.buffered.tolist() == [50_000]


def test_another_process_goes_on_with_the_same_bytes_at_any_frame() -> None:
    """Also where a block of drawn arrivals ends: 102 frames of 10 slots."""
    traffic = (
        Traffic(users=("a",), model="poisson", rate_bit_s=60e6, packet_bits=4000, max_age_s=0.02),
        Traffic(users=("b",), model="alternating", rate_bit_s=90e6, light_rate_bit_s=1e6, period_s=0.07),
        Traffic(),
    )
    for scheduler in ("round-robin", "proportional-fair"):
        granted = frames({"a": 0.3, "b": 1.0, "c": 0.1}, 120, ALL)
        whole = [encode_payload(x) for x in played(link_of(*traffic, scheduler=scheduler), granted)]
        link = link_of(*traffic, scheduler=scheduler)
        for number, (frame, expected) in enumerate(zip(granted, whole, strict=True)):
            if number % 17 == 0:
                state = link.checkpoint()
                link = link_of(*traffic, scheduler=scheduler)
                link.restore(state)
            assert encode_payload(link.step(frame).products["link"]) == expected


@pytest.mark.parametrize(
    ("kind", "field"), [("throughput", "throughput"), ("snr", "snr"), ("abs_y", "abs_y")]
)
def test_the_reward_is_what_the_settings_name(kind: str, field: str) -> None:
    found = played(link_of(reward=kind), frames({"a": 1.0, "b": 0.5}, 1, choices("x", ("bs", "a", 1, 0))))[0]
    np.testing.assert_array_equal(found.reward, getattr(found, field))


def test_the_reward_of_delay_is_better_the_less_it_is() -> None:
    found = played(link_of(reward="delay"), frames({"a": 1.0}, 1, choices("x", ("bs", "a", 1, 0))))[0]
    assert found.reward.tolist() == pytest.approx([-1e-3])


def test_settings_that_contradict_each_other_are_refused_with_their_key() -> None:
    place = Place("services.link.settings")
    with pytest.raises(ScenarioError, match=r"settings\.traffic\[0\]\.rate_bit_s"):
        CellLink.check_settings(CellSettings(traffic=(Traffic(model="poisson"),)), place)
    with pytest.raises(ScenarioError, match=r'max_spectral_efficiency.*rate_model.*=.*"capped"'):
        CellLink.check_settings(CellSettings(max_spectral_efficiency=3.0), place)


def test_without_users_there_is_an_empty_product() -> None:
    scene, channel = scene_of(BS), channel_of(("bs",), (), {})
    (found,) = played(link_of(), [frame_of(given("scene", scene), given("channel", channel))])
    assert found.arrived.shape == found.throughput.shape == (0,)


def test_users_of_two_carriers_have_a_buffer_on_each() -> None:
    second = Carrier(name="sub6", frequency_hz=3.5e9, bandwidth_hz=20e6)
    h = {(c, "bs", "a"): random_h(7, 1, 4) for c in ("mmwave", "sub6")}
    channel = channel_of(("bs",), ("a",), h, (CARRIER, second))
    frame = frame_of(
        given("scene", scene_of(BS, A)), given("channel", channel), choices("x", ("bs", "a", 1, 0))
    )
    (found,) = played(link_of(carriers=(CARRIER, second)), [frame])
    assert (found.carrier, found.blocks.tolist()) == (("mmwave", "sub6"), [10, 10])
    throughput: Float64Array = found.throughput
    assert throughput.tolist() == pytest.approx([1e6, 1e6])


# --- which transmitter serves -----------------------------------------------------------------------------

OTHER = antenna("other", "tx", (1, 4), (200.0, 0.0, 10.0), power_dbm=30.0)


def two_cells(
    number: int, snr: tuple[float, float], *beams: str, tx: tuple[str, ...] = ("bs", "other")
) -> Frame:
    """Frame with receiver ``a``, its SNRs from both transmitters, and an agent's beams of those named."""
    h = {("mmwave", name, "a"): h_of_snr(A, value) for name, value in zip(tx, snr, strict=True)}
    act = choices("pilot", *((name, "a", 1, 0) for name in beams))
    scene = scene_of(*(device for device in (BS, OTHER) if device.name in tx), A)
    inputs = (given("scene", scene), given("channel", channel_of(tx, ("a",), h)), act)
    return replace(frame_of(*inputs, number=number), previous=number - 1)


def servers(links: list[Link]) -> list[str]:
    return ["".join(tx for tx, serves in zip(x.tx, x.serving, strict=True) if serves) for x in links]


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (
            "average_slots = 50",
            "has no effect with scheduler 'round-robin'; leave it out, or write scheduler",
        ),
        ("average_slots = 100", "average_slots: has no effect"),  # also where it is the default
        ('rate_model = "capped"\nmcs_table = 1', "mcs_table: has no effect with rate_model 'capped'; leave"),
        ("target_block_error = 0.2", 'or write rate_model = "nr"'),
        ("outer_loop_db = 0", "outer_loop_db: has no effect with rate_model 'shannon'"),
        ("hysteresis_db = 6", "has no effect with association 'best'; leave it out, or write association"),
        (
            'sharing = "band"',
            "sharing: has no effect with users_per_slot 1; leave it out, or write users_per",
        ),
    ],
)
def test_a_key_without_effect_is_refused_at_its_line(given: str, words: str, tmp_path: Path) -> None:
    head, table, rest = find_scenario("cell").read_text().partition("[services.link.settings]\n")
    rest = rest[rest.index("[[services.link.settings.traffic]]") :]
    path = tmp_path / "my.toml"
    path.write_text(f"{head}{table}{given}\n{rest}")
    line = path.read_text().splitlines().index(given.splitlines()[-1]) + 1
    with pytest.raises(ScenarioError) as refused:
        prepare(path)
    assert f"my.toml:{line}: services.link.settings." in str(refused.value)
    assert words in str(refused.value)


def test_keys_with_effect_are_taken() -> None:
    for settings in (
        {"scheduler": "proportional-fair", "average_slots": 50.0},
        {"rate_model": "nr", "mcs_table": 1, "target_block_error": 0.2, "outer_loop_db": 0.5},
        {"association": "sticky", "hysteresis_db": 6.0},
        {"users_per_slot": 2, "sharing": "space"},
    ):
        CellLink.check_settings(CellSettings(**settings), Place("settings"))
    with pytest.raises(ScenarioError, match=r"settings\.hysteresis_db: has no effect"):
        CellLink.check_settings(CellSettings(hysteresis_db=6.0), Place("settings"))


COURSE = [(4.0, 1.0), (3.0, 4.0), (2.0, 5.0), (4.0, 3.0), (9.0, 3.0)]


@pytest.mark.parametrize(
    ("rule", "expected"),
    [
        ({"association": "best"}, ["bs", "other", "other", "bs", "bs"]),
        # 3 dB is a factor of 1.995: 4 of 3 is too little, 5 of 2 enough, and so is 9 of 3 back again.
        ({"association": "sticky"}, ["bs", "bs", "other", "other", "bs"]),
        ({"association": "sticky", "hysteresis_db": 6.0}, ["bs"] * 5),
    ],
)
def test_a_receiver_changes_its_transmitter_by_rule(rule: dict[str, Any], expected: list[str]) -> None:
    link = link_of(**rule)
    results = [link.step(two_cells(n, snr, "bs", "other")) for n, snr in enumerate(COURSE)]
    links = [result.products["link"] for result in results]
    assert servers(links) == expected
    changes = [a != b for a, b in pairwise(expected)]
    assert [result.counts.get("handovers", 0) for result in results] == [0, *changes]


def test_packets_go_along_in_a_handover_and_its_slots_are_lost() -> None:
    """Three slots without service after each; the buffer is the receiver's, whoever serves it."""
    link = link_of(association="best", handover_slots=13)
    links = played(link, [two_cells(n, snr, "bs", "other") for n, snr in enumerate(COURSE[:3])])
    assert servers(links) == ["bs", "other", "other"]
    assert [found.blocks.tolist() for found in links] == [[10, 0], [0, 0], [0, 7]]
    assert [found.buffered.tolist() for found in links] == [[0, 0], [0, 10_000], [0, 0]]
    sent = np.sum([found.sent for found in links], 0)
    assert sent.tolist() == [10_000, 20_000]
    # The first slot after the change carries what waited through it, the oldest packet for 14 slots.
    assert links[2].delay[1] == pytest.approx(np.mean([*range(1, 15), *[1] * 6]) * 1e-3)


def test_an_agent_takes_a_receiver_to_another_transmitter_by_its_beams() -> None:
    link = link_of(association="agent")
    beams = [("bs",), ("other",), (), ("other",), ("bs",)]
    links = played(link, [two_cells(n, (4.0, 1.0), *chosen) for n, chosen in enumerate(beams)])
    assert servers(links) == ["bs", "other", "other", "other", "bs"]
    # Without beams it stays where it is, and nothing is sent.
    assert [int(found.blocks.sum()) for found in links] == [10, 10, 0, 10, 10]


def test_beams_of_two_transmitters_are_refused_where_the_agent_associates() -> None:
    with pytest.raises(ProductError, match=r"'pilot'.*'bs'.*'other'.*'a'"):
        link_of(association="agent").step(two_cells(0, (4.0, 1.0), "bs", "other"))


def test_a_transmitter_that_leaves_hands_its_receivers_over() -> None:
    link = link_of(association="sticky")
    links = played(
        link, [two_cells(0, (4.0, 1.0), "bs", "other"), two_cells(1, (1.0,), "other", tx=("other",))]
    )
    assert servers(links) == ["bs", "other"]
    assert links[1].sent.tolist() == [10_000]


def test_association_and_lost_slots_outlive_the_process() -> None:
    granted = [two_cells(n, COURSE[n % 5], "bs", "other") for n in range(15)]
    rule: dict[str, Any] = {"association": "sticky", "handover_slots": 13}
    whole = [encode_payload(found) for found in played(link_of(**rule), granted)]
    link = link_of(**rule)
    for frame, expected in zip(granted, whole, strict=True):
        state, link = link.checkpoint(), link_of(**rule)
        link.restore(state)
        assert encode_payload(link.step(frame).products["link"]) == expected


@pytest.mark.parametrize(
    ("users", "expected"),
    [
        (
            ("*", "c/*"),
            r"traffic\[1\]\.users\[1\]: 'c/\*' is no receiver of the scenario; known: a, car\.\*/rx",
        ),
        ((), r"traffic\[1\]\.users: is empty, so that nothing arrives"),
    ],
)
def test_traffic_of_a_receiver_that_is_not_there_is_refused(users: tuple[str, ...], expected: str) -> None:
    devices = (
        DeviceSpec(name="bs", kind="antenna", role="tx"),
        DeviceSpec(name="a", kind="antenna", role="rx"),
        DeviceSpec(name="rx", on="car.*", kind="antenna", role="rx"),
    )
    wrong = CellSettings(traffic=(Traffic(users=("car.3/*",)), Traffic(users=users)))
    link = CellLink(wrong, RunInfo(name="link", carriers=(CARRIER,), devices=devices))
    with pytest.raises(ScenarioError, match=expected):
        link.prepare(Preparation(demand={"link": frozenset()}))


def test_a_reward_that_is_not_there_is_refused_with_all_that_are() -> None:
    with pytest.raises(ScenarioError, match=r"'dlay'.*'delay'"):
        convert_settings(CellSettings, {"reward": "dlay"})
