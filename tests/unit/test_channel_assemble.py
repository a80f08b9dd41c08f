"""From paths in any order to the canonical channel product."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from caviar_protocol.codec import decode_payload, encode_payload
from caviar_protocol.space.coordinates import quaternion_from_euler, rotation_matrix
from caviar_protocol.topics import AntennaArray, Carrier, Channel, ChannelOptions, Interaction
from caviar_services.channel.assemble import Product, assemble
from caviar_services.channel.paths import Antenna, PathTable, stable_ids

CARRIERS = (Carrier(name="low", frequency_hz=3.5e9), Carrier(name="high", frequency_hz=28e9))
NAMES = ("wall", "bridge", "car", "unused")


def antenna(name: str, x: float, columns: int = 1) -> Antenna:
    return Antenna(
        name,
        AntennaArray(columns=columns),
        np.array([x, 1.0, 2.0]),
        rotation_matrix(quaternion_from_euler(0.3, -0.2, 0.1)),
        np.array([1.0, 0.0, 0.0]),
    )


def random_table(rng: np.random.Generator, paths: int = 60, pairs: int = 6, depth: int = 3) -> PathTable:
    count = rng.integers(0, depth + 1, paths)
    used = np.arange(depth) < count[:, None]
    types = np.where(used, rng.integers(1, 3, (paths, depth)), 0).astype(np.uint8)
    return PathTable(
        pair=rng.integers(0, pairs, paths),
        transfer=rng.normal(size=(2, paths, 3, 3)) + 1j * rng.normal(size=(2, paths, 3, 3)),
        types=types,
        objects=np.where(used, rng.integers(0, 3, (paths, depth)), -1).astype(np.int32),
        points=rng.normal(size=(paths, depth, 3)) * 20,
        object_names=NAMES,
        object_velocity=rng.normal(size=(len(NAMES), 3)),
    )


def build(table: PathTable, with_h: bool = False) -> Channel:
    product = Product(rung="siso-rt", options=ChannelOptions(), carriers=CARRIERS, with_h=with_h)
    transmitters = [antenna("t0", 0.0, columns=4), antenna("t1", 5.0)]
    receivers = [antenna("r0", 50.0), antenna("r1", 60.0, columns=2), antenna("r2", 70.0)]
    return assemble(product, transmitters, receivers, table, np.ones((2, 3), bool))[0]


@pytest.mark.parametrize("seed", range(5))
def test_the_order_in_which_paths_were_found_does_not_matter(seed: int) -> None:
    """The bytes of the product are the same for every permutation of the table."""
    rng = np.random.default_rng(seed)
    table = random_table(rng)
    shuffled = table.take(rng.permutation(len(table.pair)))
    assert encode_payload(build(table, with_h=True)) == encode_payload(build(shuffled, with_h=True))


def test_the_process_local_numbering_of_objects_does_not_matter() -> None:
    table = random_table(np.random.default_rng(3))
    permutation = np.array([2, 3, 0, 1])
    inverse = np.argsort(permutation).astype(np.int32)
    renamed = PathTable(
        pair=table.pair,
        transfer=table.transfer,
        types=table.types,
        objects=np.where(table.objects >= 0, inverse[table.objects], -1).astype(np.int32),
        points=table.points,
        object_names=tuple(NAMES[i] for i in permutation),
        object_velocity=table.object_velocity[permutation],
    )
    assert encode_payload(build(table)) == encode_payload(build(renamed))


def test_paths_are_sorted_as_the_topic_promises() -> None:
    """Compared with Python's own sorting of tuples, names as text."""
    channel = build(random_table(np.random.default_rng(1)))
    for p in range(6):
        rows = range(int(channel.offsets[p]), int(channel.offsets[p + 1]))
        keys = []
        for i in rows:
            types = [int(t) for t in channel.interactions[i]]
            names = [channel.object_names[o] if o >= 0 else "" for o in channel.objects[i]]
            keys.append(
                (sum(t > 0 for t in types), types, names, channel.tau[i], *channel.aod[i], *channel.aoa[i])
            )
        assert keys == sorted(keys)
    assert channel.offsets[-1] == 60


def test_only_names_that_occur_are_listed_sorted() -> None:
    channel = build(random_table(np.random.default_rng(1)))
    assert channel.object_names == ("bridge", "car", "wall")


def test_what_is_not_finite_is_dropped_and_counted() -> None:
    """A NaN in one place drops that path alone (contract, clause 21)."""
    rng = np.random.default_rng(2)
    table = random_table(rng)
    bad = table.transfer.copy()
    bad[1, 7, 0, 2] = np.nan
    points = table.points.copy()
    first = int(np.flatnonzero(table.types[:, 0])[3])
    assert first != 7
    points[first, 0, 1] = np.inf
    broken = PathTable(
        pair=table.pair,
        transfer=bad,
        types=table.types,
        objects=table.objects,
        points=points,
        object_names=table.object_names,
        object_velocity=table.object_velocity,
    )
    channel = build(broken, with_h=True)
    assert channel.dropped == 2
    assert len(channel.tau) == 58
    encode_payload(channel)  # refuses what is not finite
    good = np.ones(60, bool)
    good[[7, first]] = False
    assert np.array_equal(np.sort(channel.tau), np.sort(build(table.take(good)).tau))


def test_garbage_past_the_last_interaction_does_not_count() -> None:
    """Solvers leave old values there; a NaN among them drops nothing."""
    table = random_table(np.random.default_rng(4))
    points = np.where(table.types[..., None] == 0, np.nan, table.points)
    objects = np.where(table.types == 0, 3, table.objects).astype(np.int32)
    littered = PathTable(
        pair=table.pair,
        transfer=table.transfer,
        types=table.types,
        objects=objects,
        points=points,
        object_names=table.object_names,
        object_velocity=table.object_velocity,
    )
    assert encode_payload(build(littered)) == encode_payload(build(table))


def test_ids_are_unique_in_a_pair_and_survive_movement() -> None:
    """Moving every point a little changes delays but no id."""
    table = random_table(np.random.default_rng(5))
    channel = build(table)
    for p in range(6):
        ids = channel.id[channel.offsets[p] : channel.offsets[p + 1]]
        assert len(set(ids.tolist())) == len(ids)
    moved = PathTable(
        pair=table.pair,
        transfer=table.transfer,
        types=table.types,
        objects=table.objects,
        points=table.points + 1e-9,
        object_names=table.object_names,
        object_velocity=table.object_velocity,
    )
    later = build(moved)
    assert np.array_equal(later.id, channel.id)
    assert not np.array_equal(later.tau, channel.tau)


def test_ids_tell_kinds_apart_but_not_pairs() -> None:
    """A reflection at the wall has one id wherever it occurs, and another than one at the car."""
    one = np.array([[Interaction.REFLECTION]], np.uint8)
    table = PathTable(
        pair=np.array([0, 1, 2]),
        transfer=np.ones((2, 3, 3, 3), np.complex128),
        types=np.repeat(one, 3, axis=0),
        objects=np.array([[0], [0], [2]], np.int32),
        points=np.full((3, 1, 3), 9.0),
        object_names=NAMES,
        object_velocity=np.zeros((4, 3)),
    )
    ids = build(table).id.tolist()
    assert ids[0] == ids[1] != ids[2]


def test_matrices_come_only_on_demand_and_for_every_pair() -> None:
    """Carriers slowest, zeros where a pair has no path; H is the sum over paths for single elements."""
    table = random_table(np.random.default_rng(6))
    table = table.take(table.pair != 5)
    assert build(table).h == ()
    channel = build(table, with_h=True)
    assert [(m.carrier, m.tx, m.rx) for m in channel.h] == [
        (c, t, r) for c in range(2) for t in range(2) for r in range(3)
    ]
    assert channel.h[1].h.shape == (2, 4)
    assert not channel.h[5].h.any()
    where = channel.pair("t1", "r0")
    assert channel.h[9].h[0, 0] == pytest.approx(channel.a[1, where].sum(), rel=1e-12)


def test_the_product_survives_the_wire() -> None:
    channel = build(random_table(np.random.default_rng(7)), with_h=True)
    assert decode_payload("channel", *encode_payload(channel)) == channel


def test_no_paths_at_all_make_an_empty_product() -> None:
    table = random_table(np.random.default_rng(8))
    channel = build(table.take(np.zeros(60, bool)), with_h=True)
    assert channel.a.shape == (2, 0)
    assert channel.interactions.shape == (0, 0)
    assert channel.offsets.tolist() == [0] * 7
    assert decode_payload("channel", *encode_payload(channel)) == channel


def test_one_path_of_each_pair_needs_no_order_and_gets_the_same_bytes() -> None:
    """Found in the order of the pairs or in another one: lines of sight, as free space has them."""
    table = random_table(np.random.default_rng(9), paths=6, depth=0)
    sighted = replace(table, pair=np.arange(6))
    shuffled = sighted.take(np.array([4, 0, 5, 2, 1, 3]))
    assert encode_payload(build(sighted, with_h=True)) == encode_payload(build(shuffled, with_h=True))


def test_ids_of_paths_of_one_kind_count_within_their_pair() -> None:
    """The same ids whether all paths are of one kind, or others stand between them."""
    table = random_table(np.random.default_rng(10), paths=8, depth=1)
    pair = np.array([0, 0, 0, 1, 3, 3, 3, 3])
    types = np.array([0, 0, 1, 0, 0, 0, 0, 1], np.uint8)[:, None]
    mixed = replace(table, pair=pair, types=types, objects=np.where(types, 1, -1).astype(np.int32))
    alone = stable_ids(mixed.take(types[:, 0] == 0))
    assert alone.tolist() == stable_ids(mixed)[types[:, 0] == 0].tolist()
    assert alone[0] == alone[2] != alone[1]


def test_h_in_single_precision_is_within_6e_8_of_each_number() -> None:
    table = random_table(np.random.default_rng(5))
    product = Product(rung="siso-rt", options=ChannelOptions(), carriers=CARRIERS, with_h=True)
    ends = [antenna("t0", 0.0, columns=4)], [antenna("r0", 50.0, columns=2)]
    table = table.take(table.pair == 0)
    exact, rounded = (
        assemble(replace(product, rounds_h=rounds), *ends, table, np.ones((1, 1), bool))[0]
        for rounds in (False, True)
    )
    for one, other in zip(exact.h, rounded.h, strict=True):
        assert (one.h != other.h).any()
        np.testing.assert_allclose(other.h.view(float), one.h.view(float), rtol=6e-8)
        np.testing.assert_array_equal(other.h, other.h.astype(np.complex64))
    assert decode_payload("channel", *encode_payload(rounded)).h[0].h.dtype == np.complex128
