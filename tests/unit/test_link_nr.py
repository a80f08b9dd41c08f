"""The rate model `nr` of the link `cell`: blocks, failures that stay in the buffer, what is remembered.

Tables are made up; `test_link_nr_sionna.py` holds those of Sionna SYS.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest
from link_builders import CARRIER, antenna, channel_of, choices, frame_of, given, scene_of
from msgspec.structs import replace
from test_protocol_cell_link_adaptation import waterfall

from caviar_protocol.cell.traffic import Traffic
from caviar_protocol.codec import encode_payload
from caviar_protocol.errors import SetupError
from caviar_protocol.topics import Carrier, Link
from caviar_services.link import cell as module
from caviar_services.link.cell import CellLink
from caviar_services.link.link_budget import noise_power
from caviar_services.link.nr import Blocks, Numerology, load_tables, numerology
from caviar_services.link.terminals import CellSettings
from caviar_services.service import Frame, Preparation, RunInfo, no_progress

BS = antenna("bs", "tx", power_dbm=30.0)
USERS = tuple(antenna(name, "rx", position=(20.0, 10.0, 0.0)) for name in "ab")
NOISE = noise_power(CARRIER, 9.0, 290.0)


@pytest.fixture(autouse=True)
def _tables(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three blocks a slot; of two terminals at once each has blocks of half the size."""
    whole = waterfall([0.0, 5.0, 10.0, 15.0])
    half = type(whole)(whole.bits // 2, whole.error, whole.least_db, whole.step_db, whole.beta)
    monkeypatch.setattr(module, "load_blocks", lambda *_: {"mmwave": Blocks((whole, half), 3)})


def link_of(**settings: Any) -> CellLink:
    given_settings = {"slots": 10, "traffic": (Traffic(),), "rate_model": "nr", **settings}
    link = CellLink(
        CellSettings(**given_settings),
        RunInfo(name="link", seed=1, sampling_period_ns=10_000_000, carriers=(CARRIER,)),
    )
    link.prepare(Preparation(demand={"link": frozenset()}))
    link.reset(0, 1, 0)
    return link


def frames(count: int, *snr_db: float, seed: int = 1) -> list[Frame]:
    """Frames in which the users have these SNRs."""
    users = USERS[: len(snr_db)]
    h = {
        ("mmwave", "bs", user.name): np.full((1, 1), np.sqrt(10 ** (value / 10) * NOISE) + 0j)
        for user, value in zip(users, snr_db, strict=True)
    }
    act = choices("agent", *(("bs", user.name, 0, 0) for user in users))
    channel = channel_of(("bs",), tuple(user.name for user in users), h)
    inputs = (given("scene", scene_of(BS, *users)), given("channel", channel), act)
    return [replace(frame_of(*inputs, number=n, seed=seed), previous=n - 1) for n in range(count)]


def played(link: CellLink, granted: list[Frame]) -> list[Link]:
    found = []
    for frame in granted:
        product = link.step(frame).products["link"]
        assert isinstance(product, Link)
        found.append(product)
    return found


def total(links: list[Link], name: str) -> int:
    return int(sum(getattr(link, name).sum() for link in links))


def test_blocks_carry_the_bits_of_the_scheme_that_the_snr_allows() -> None:
    """29 dB: scheme 3, three blocks of 4,000 bits in each of ten slots, none of which fails."""
    (found,) = played(link_of(), frames(1, 29.0))
    assert (found.blocks.tolist(), found.block_errors.tolist()) == ([30], [0])
    assert found.sent.tolist() == [120_000]
    assert found.bit_rate[0] == pytest.approx(12e6, rel=1e-9)
    assert found.spectral_efficiency[0] == pytest.approx(0.12, rel=1e-9)


def test_a_block_that_fails_stays_in_the_buffer_and_counts_into_no_throughput() -> None:
    """11.5 dB: scheme 2 fails in 16 of 1,000 blocks; the target allows all."""
    traffic = Traffic(model="constant", rate_bit_s=6e6, packet_bits=1000)
    links = played(link_of(traffic=(traffic,), outer_loop_db=0.0), frames(80, 11.5))
    errors, blocks = total(links, "block_errors"), total(links, "blocks")
    assert errors / blocks == pytest.approx(0.5 * 10**-1.5, rel=0.3)
    buffered = float(links[-1].buffered[0])
    assert total(links, "arrived") == total(links, "sent") + total(links, "dropped") + buffered
    # All of it comes through in the end: what failed was sent again.
    assert total(links, "sent") >= 0.98 * total(links, "arrived")
    delays = [float(found.delay[0]) for found in links]
    assert max(delays) > 1.02e-3 > min(delays) > 0.999e-3


def test_a_user_with_little_to_send_takes_few_blocks() -> None:
    traffic = Traffic(model="constant", rate_bit_s=1e6, packet_bits=1000)
    (found,) = played(link_of(traffic=(traffic,)), frames(1, 29.0))
    assert (found.blocks.tolist(), found.sent.tolist()) == ([10], [10_000])


def test_as_many_blocks_fail_as_the_target_says_though_interference_is_unknown() -> None:
    """The SNR of each frame differs, so that schemes lie above and below what would be right."""
    rng = np.random.default_rng(5)
    link, granted = link_of(target_block_error=0.2, outer_loop_db=0.3), []
    for number in range(400):
        (frame,) = frames(1, float(rng.uniform(3, 16)))
        granted.append(replace(frame, number=number, previous=number - 1))
    links = played(link, granted)[100:]
    # Between schemes there are SNRs at which one fails seldom and the next always: the loop mixes them.
    assert total(links, "block_errors") / total(links, "blocks") == pytest.approx(0.2, abs=0.02)


def test_terminals_that_share_the_band_have_smaller_blocks() -> None:
    (found,) = played(link_of(users_per_slot=2), frames(1, 29.0, 29.0))
    assert found.blocks.tolist() == [30, 30]
    assert found.sent.tolist() == [60_000, 60_000]


def test_draws_depend_on_seed_and_frame_and_another_process_goes_on_with_the_same_bytes() -> None:
    settings: dict[str, Any] = {"scheduler": "proportional-fair"}
    granted = frames(40, 11.0, 6.0)
    whole = [encode_payload(found) for found in played(link_of(**settings), granted)]
    assert any(found.block_errors.sum() for found in played(link_of(**settings), granted))
    other = [encode_payload(found) for found in played(link_of(**settings), frames(40, 11.0, 6.0, seed=2))]
    assert other != whole
    link = link_of(**settings)
    for number, (frame, expected) in enumerate(zip(granted, whole, strict=True)):
        if number % 7 == 0:
            state, link = link.checkpoint(), link_of(**settings)
            link.restore(state)
        assert encode_payload(link.step(frame).products["link"]) == expected


def test_a_user_without_path_sends_no_blocks() -> None:
    scene, channel = scene_of(BS, *USERS), channel_of(("bs",), ("a", "b"), {})
    act = choices("agent", ("bs", "a", 0, 0))
    (found,) = played(link_of(), [frame_of(given("scene", scene), given("channel", channel), act)])
    assert (found.blocks.sum(), found.bit_rate.sum()) == (0, 0)


@pytest.mark.parametrize(
    ("carrier", "slot_s", "expected"),
    [
        # 66 blocks of 12 subcarriers, 14 symbols, 18 % overhead; one slot of NR.
        ({"frequency_hz": 28e9, "subcarriers": 792, "subcarrier_spacing_hz": 120e3}, 125e-6, (9092, 1)),
        ({"frequency_hz": 28e9, "subcarriers": 792, "subcarrier_spacing_hz": 120e3}, 1e-3, (9092, 8)),
        # A third of a slot: a third of the resource elements.
        ({"frequency_hz": 28e9, "subcarriers": 792, "subcarrier_spacing_hz": 120e3}, 125e-6 / 3, (3030, 1)),
        # 100 MHz at 3.5 GHz: 277 blocks at 30 kHz, 14 %.
        ({"frequency_hz": 3.5e9}, 5e-4, (40020, 1)),
    ],
)
def test_resource_elements_follow_from_the_numerology(
    carrier: dict[str, Any], slot_s: float, expected: tuple[int, int]
) -> None:
    made = Carrier(name="c", bandwidth_hz=100e6, **carrier)
    assert numerology(made, slot_s) == Numerology(*expected)


def test_without_sionna_sys_the_error_has_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sionna.sys", None)
    with pytest.raises(SetupError, match=r"'nr'.*caviar-sim\[system\]"):
        load_tables(2, {100}, no_progress)
