"""Wideband parts of a product, from paths as a model found them."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace

from caviar_protocol.codec import decode_payload, encode_payload
from caviar_protocol.errors import ScenarioError
from caviar_protocol.multipath import slot_offsets, subcarrier_offsets
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.space.antenna_arrays import element_positions
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT
from caviar_protocol.topics import AntennaArray, Carrier, Channel, ChannelOptions
from caviar_services.channel.arrays.channel_matrices import check_size, empty_parts, superposed
from caviar_services.channel.assemble import Product, assemble
from caviar_services.channel.paths import Antenna, PathTable
from caviar_services.channel.statistical.free_space import FreeSpaceChannel, FreeSpaceSettings
from caviar_services.service import Preparation, RunInfo

CARRIERS = (
    Carrier(
        name="wide",
        frequency_hz=28e9,
        bandwidth_hz=400e6,
        subcarriers=31,
        subcarrier_spacing_hz=12e6,
        taps=40,
        slots=2,
        slot_duration_s=2e-4,
    ),
    Carrier(name="narrow", frequency_hz=3.5e9),
)
ARRAYS = AntennaArray(rows=2, columns=4), AntennaArray(columns=3)


def antenna(name: str, array: AntennaArray, x: float, speed: float = 0.0) -> Antenna:
    return Antenna(name, array, np.array([x, 2.0, 3.0]), np.eye(3), np.array([speed, 0.0, 0.0]))


def product(parts: frozenset[str], reached: tuple[int, ...] = (0,)) -> Channel:
    """A transmitter, a receiver with a direct and a reflected path, and one without a path."""
    transmitters = [antenna("bs", ARRAYS[0], 0.0)]
    receivers = [antenna("near", ARRAYS[1], 40.0, speed=-20.0), antenna("none", ARRAYS[1], 50.0)]
    pair = np.repeat(np.array(reached, np.int64), 2)
    loss = SPEED_OF_LIGHT / (4 * np.pi * np.array([28e9, 3.5e9]))
    scale = np.tile([1 / 40.0, 0.4 / 60.0], len(reached))
    table = PathTable(
        pair=pair,
        transfer=(loss[:, None] * scale)[..., None, None] * np.eye(3, dtype=np.complex128),
        types=np.tile(np.array([[0], [1]], np.uint8), (len(reached), 1)),
        objects=np.tile(np.array([[-1], [0]], np.int32), (len(reached), 1)),
        points=np.tile(np.array([[[0.0, 0.0, 0.0]], [[20.0, 24.0, 3.0]]]), (len(reached), 1, 1)),
        object_names=("wall",),
        object_velocity=np.zeros((1, 3)),
    )
    asked = Product(rung="siso-rt", options=ChannelOptions(), carriers=CARRIERS, with_h=True, wideband=parts)
    return assemble(asked, transmitters, receivers, table, np.array([[True, False]]))[0]


BOTH = frozenset({"hf", "taps"})


def test_every_element_pair_has_the_response_of_its_paths() -> None:
    """Σ_p a·exp(j2π k̂·r)·exp(−j2π(f·τ)) written out, with delays that shrink or grow from slot to slot."""
    channel = product(BOTH)
    carrier = CARRIERS[0]
    f, t = subcarrier_offsets(carrier), slot_offsets(carrier)
    expected = np.zeros((2, 31, 3, 8), np.complex128)
    taps = np.zeros((2, 40, 3, 8), np.complex128)
    for p in range(2):
        away = [
            np.array([np.sin(z) * np.cos(phi), np.sin(z) * np.sin(phi), np.cos(z)])
            for z, phi in (channel.aoa[p], channel.aod[p])
        ]
        rx, tx = (
            np.exp(2j * np.pi * element_positions(array) @ k)
            for array, k in zip(ARRAYS[::-1], away, strict=True)
        )
        a, tau, shift = channel.a[0, p], channel.tau[p], channel.doppler[0, p]
        for s in range(2):
            delay = tau - shift / 28e9 * t[s]
            turned = a * np.exp(2j * np.pi * shift * t[s]) * np.outer(rx, tx)
            expected[s] += np.exp(-2j * np.pi * f * delay)[:, None, None] * turned
            sample = channel.taps[0].first + np.arange(40) - 400e6 * delay
            taps[s] += np.sinc(sample)[:, None, None] * turned
    assert np.abs(channel.hf[0].h - expected).max() <= 1e-6 * np.abs(expected).max()
    assert np.abs(channel.taps[0].h - taps).max() <= 1e-6 * np.abs(taps).max()
    assert np.abs(channel.hf[0].h[0, 15] - channel.h[0].h).max() <= 1e-6 * np.abs(channel.h[0].h).max()
    assert abs(channel.doppler[0, 0]) == pytest.approx(28e9 * 20 / SPEED_OF_LIGHT)


def test_pairs_without_a_path_have_zeros_and_carriers_without_subcarriers_nothing() -> None:
    channel = product(BOTH)
    assert [(r.carrier, r.tx, r.rx) for r in channel.hf] == [(0, 0, 0), (0, 0, 1)]
    assert channel.hf[1].h.shape == (2, 31, 3, 8)
    assert channel.taps[1].h.shape == (2, 40, 3, 8)
    assert not channel.hf[1].h.any()
    assert not channel.taps[1].h.any()
    empty = product(BOTH, reached=())
    assert not any(r.h.any() for r in (*empty.hf, *empty.taps))


def test_parts_are_made_where_asked_for_and_change_nothing_else() -> None:
    plain = product(frozenset())
    assert plain.hf == plain.taps == ()
    assert product(frozenset({"taps"})).hf == ()
    header, body = encode_payload(product(BOTH))
    assert (header, body) == encode_payload(product(BOTH))
    assert decode_payload("channel", header, body) == product(BOTH)
    for matrix, other in zip(plain.h, product(BOTH).h, strict=True):
        assert matrix.h.tobytes() == other.h.tobytes()


def test_a_part_that_no_carrier_defines_is_empty_and_a_note_says_what_to_write() -> None:
    assert empty_parts({"h", "hf", "taps"}, CARRIERS) == ()
    notes = empty_parts({"h", "hf", "taps"}, CARRIERS[1:])
    assert [note.partition(";")[0] for note in notes] == [
        "a part in demand is empty: channel.hf needs a carrier with subcarriers",
        "a part in demand is empty: channel.taps needs a carrier with taps",
    ]
    run = RunInfo(name="channel", carriers=CARRIERS[1:])
    model = FreeSpaceChannel(FreeSpaceSettings(), run)
    prepared = model.prepare(Preparation(demand={"channel": BOTH}))
    assert prepared.notes == empty_parts(BOTH, CARRIERS[1:])


def test_parts_that_no_product_holds_are_refused_before_the_first_frame_by_their_key() -> None:
    huge = replace(CARRIERS[0], subcarriers=65536, slots=17)
    check_size({"hf", "taps"}, CARRIERS, 512, 64)
    with pytest.raises(ScenarioError, match=r"'wide' takes 1\.06 GiB.*128 tran") as told:
        check_size({"h", "hf"}, (CARRIERS[1], huge), 128, 1)
    assert told.value.key == "carriers[1].subcarriers"
    check_size({"h"}, (CARRIERS[1], huge), 128, 1)
    devices = (
        DeviceSpec(name="bs", kind="antenna", role="tx", array=AntennaArray(rows=8, columns=16)),
        DeviceSpec(name="rx", kind="antenna", role="rx", on="car*", count=9),
    )
    model = FreeSpaceChannel(FreeSpaceSettings(), RunInfo(name="channel", carriers=(huge,), devices=devices))
    with pytest.raises(ScenarioError, match=r"takes 1\.06 GiB"):
        model.prepare(Preparation(demand={"channel": BOTH}))


@pytest.mark.parametrize(("bins", "paths", "sizes"), [(7, 0, (2, 3)), (5, 130, (8, 64)), (3, 2, (64, 1024))])
def test_sums_in_blocks_are_sums(bins: int, paths: int, sizes: tuple[int, int]) -> None:
    random = np.random.default_rng(paths)
    weights, waves = (
        random.normal(size=shape) + 1j * random.normal(size=shape)
        for shape in ((bins, paths), (paths, *sizes))
    )
    found, expected = superposed(weights, waves), np.einsum("jp,pmn->jmn", weights, waves)
    assert found.shape == (bins, *sizes)
    assert np.abs(found - expected).max(initial=0.0) <= 1e-5 * max(np.abs(expected).max(initial=0.0), 1.0)
