"""Enumerated candidates: every path of images that there is, whatever rays would meet."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from caviar_labs.stability.formulas import C, itu_permittivity, mirrored, spherical_wave
from caviar_labs.stability.lab import (
    Array,
    Plate,
    Thing,
    antenna,
    carriers,
    measure,
    scene,
    write_scenery,
)
from caviar_protocol.codec import encode_payload
from caviar_protocol.digest import payload_digest
from caviar_protocol.errors import SetupError
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.topics import Channel, Interaction, Scene
from caviar_services.channel.base import ChannelModel
from caviar_services.channel.enumeration import compiled_loops, scenery_chains
from caviar_services.channel.sionna.model import SionnaChannel
from caviar_services.channel.sionna.settings import SionnaSettings
from caviar_services.service import Preparation, RunInfo

STATION = (-3.0, -8.3, 5.0)
PLATES = [
    Plate("ground", [(-40, -20, 0), (40, -20, 0), (40, 20, 0), (-40, 20, 0)]),
    Plate("north", [(-25, 10, 0), (25, 10, 0), (25, 10, 12), (-25, 10, 12)]),
    Plate("south", [(-30, -10, 0), (30, -10, 0), (30, -10, 9), (-30, -10, 9)]),
]
DEPTH = 3
DIFFRACTED = int(Interaction.DIFFRACTION)


@pytest.fixture(autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache that no other test has."""
    folder = tmp_path_factory.mktemp("cache")
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder))
    return folder / "caviar" / "chains"


def street(
    folder: Path,
    standing: bool = True,
    plates: Sequence[Plate] = PLATES,
    stations: Mapping[str, tuple[float, float, float]] = {"bs": STATION},
    **settings: Any,
) -> tuple[ChannelModel[Any], tuple[str, ...]]:
    """A channel between two walls, and what it said when it was prepared."""
    own = {"samples": 20_000, "bodies": 4, "candidates": "enumerated", "max_depth": DEPTH, **settings}
    devices = tuple(
        DeviceSpec(name=name, kind="antenna", role="tx", position_m=at) for name, at in stations.items()
    )
    run = RunInfo(name="channel", seed=1, carriers=carriers(28e9), devices=devices if standing else ())
    model = SionnaChannel(msgspec.convert(own, SionnaSettings), run)
    folder.mkdir(exist_ok=True)
    prepared = model.prepare(Preparation(demand={}, assets=write_scenery(folder, plates)))
    return model, prepared.notes


def test_a_missing_compiler_is_said_before_the_first_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compiled_loops, "numba", None)
    with pytest.raises(SetupError, match=r"Numba.*caviar-sim\[channel\]"):
        street(tmp_path)


def traffic(seed: int) -> Scene:
    """Three boxes that stand anyhow between the walls, and two receivers above them."""
    rng = np.random.default_rng(seed)
    things = []
    for number in range(3):
        yaw = rng.uniform(0, np.pi)
        x, y = -9.0 + 8.0 * number + rng.uniform(-1.5, 1.5), rng.uniform(-4.5, 4.5)
        size = rng.uniform((3.0, 1.5, 1.2), (6.0, 2.2, 3.0))
        turned = (float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2)))
        things.append(Thing(f"box-{number}", (x, y, size[2] / 2 + 0.05), tuple(size), turned))
    above = [(*thing.position[:2], thing.position[2] + thing.size[2] / 2 + 0.3) for thing in things[:2]]
    devices = [antenna("bs", "tx", STATION), *(antenna(f"rx{i}", "rx", p) for i, p in enumerate(above))]
    return scene(devices, things)


def face_of(corner: Array, one: Array, other: Array) -> Array:
    normal = np.cross(one, other)
    return np.array([corner, one, other, normal / np.linalg.norm(normal)])


def rectangles(at: Scene, plates: Sequence[Plate] = PLATES) -> list[Array]:
    """Corner, both sides and normal of every face, Shape ``[4, 3]``: of the plates, then of the boxes."""
    found = []
    for plate in plates:
        a, b, _, d = np.array(plate.corners, float)
        found.append(face_of(a, b - a, d - a))
    for position, (w, _, _, z), size in zip(at.position, at.orientation, at.dimensions, strict=True):
        cosine, sine = w * w - z * z, 2 * w * z
        axes = np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]]) * size[:, None]
        for axis, sign in itertools.product(range(3), (-0.5, 0.5)):
            one, other = axes[(axis + 1) % 3], axes[(axis + 2) % 3]
            corner = position + sign * axes[axis] - (one + other) / 2
            found.append(face_of(corner, one, other))
    return found


def crossing(start: Array, end: Array, face: Array) -> tuple[float, Array] | None:
    """Where a segment crosses a face, as a part of it, and the point; None: nowhere."""
    corner, one, other, normal = face
    across = (end - start) @ normal
    if abs(across) < 1e-12:
        return None
    along = (corner - start) @ normal / across
    point = start + along * (end - start)
    u, v = (point - corner) @ one / (one @ one), (point - corner) @ other / (other @ other)
    inside = 0 <= u <= 1 and 0 <= v <= 1 and 0 < along < 1
    return (along, point) if inside else None


def is_free(start: Array, end: Array, faces: list[Array], own: tuple[int, ...]) -> bool:
    """Whether no face but those at its ends stands on a segment."""
    return not any(crossing(start, end, face) for number, face in enumerate(faces) if number not in own)


def paths_by_images(start: Array, end: Array, faces: list[Array]) -> list[float]:
    """Lengths of all paths [m], by trying every sequence of faces."""
    found = []
    for chain in chains_of(faces, DEPTH):
        points = points_back(start, chain, faces, end)
        if points is not None:
            ends = itertools.pairwise((None, *chain[::-1], None))
            segments = zip(itertools.pairwise(points), ends, strict=True)
            if all(is_free(*segment, faces, own) for segment, own in segments):
                found.append(float(np.linalg.norm(images(start, chain, faces)[-1] - end)))
    return sorted(found)


def edges_of(at: Scene, first: int) -> list[tuple[Array, Array, Array, tuple[int, int]]]:
    """Both ends of every edge of the boxes, the outward normals of its faces, and their numbers among
    `rectangles`, from ``first`` on."""
    found = []
    for box, (position, (w, _, _, z), size) in enumerate(
        zip(at.position, at.orientation, at.dimensions, strict=True)
    ):
        cosine, sine = w * w - z * z, 2 * w * z
        axes = np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])
        for along in range(3):
            others = [axis for axis in range(3) if axis != along]
            for signs in itertools.product((-1, 1), repeat=2):
                normals = np.array([s * axes[axis] for s, axis in zip(signs, others, strict=True)])
                middle = position + sum(n * size[axis] / 2 for n, axis in zip(normals, others, strict=True))
                half = axes[along] * size[along] / 2
                faces = [
                    first + 6 * box + 2 * axis + (s + 1) // 2 for s, axis in zip(signs, others, strict=True)
                ]
                found.append((middle - half, middle + half, normals, (faces[0], faces[1])))
    return found


def images(start: Array, chain: Sequence[int], faces: list[Array]) -> list[Array]:
    """Images of a point behind each face of a chain, itself first."""
    found = [start]
    for number in chain:
        corner, _, _, normal = faces[number]
        found.append(mirrored(found[-1], corner, normal))
    return found


def points_back(start: Array, chain: Sequence[int], faces: list[Array], end: Array) -> list[Array] | None:
    """Points of reflection from the end back to the start, both included; None: no path."""
    points = [end]
    for number, image in zip(chain[::-1], images(start, chain, faces)[:0:-1], strict=True):
        met = crossing(points[-1], image, faces[number])
        if met is None:
            return None
        points.append(met[1])
    return [*points, start]


def chains_of(faces: list[Array], most: int) -> list[tuple[int, ...]]:
    """Sequences of faces, none twice in turn."""
    every = itertools.chain.from_iterable(
        itertools.product(range(len(faces)), repeat=n) for n in range(most + 1)
    )
    return [chain for chain in every if all(a != b for a, b in itertools.pairwise(chain))]


def lengths_over_edges(start: Array, end: Array, at: Scene) -> list[float]:
    """Lengths of all paths over one edge [m], by trying every sequence of faces before and after each."""
    faces = rectangles(at)
    edges = edges_of(at, len(PLATES))
    begin, other = (np.array([edge[side] for edge in edges]) for side in (0, 1))
    span = np.linalg.norm(other - begin, axis=1)
    along = (other - begin) / span[:, None]
    found = []

    def unfolded(point: Array) -> tuple[Array, Array]:
        s = ((point - begin) * along).sum(1)
        return s, np.linalg.norm(point - begin - s[:, None] * along, axis=1)

    chains = chains_of(faces, DEPTH - 1)
    for before, behind in itertools.product(chains, chains):
        if len(before) + len(behind) >= DEPTH:
            continue
        source, target = images(start, before, faces)[-1], images(end, behind, faces)[-1]
        (s, from_source), (t, from_target) = unfolded(source), unfolded(target)
        place = (s * from_target + t * from_source) / (from_source + from_target)
        for number in np.flatnonzero((place > 0) & (place < span)):
            point = begin[number] + place[number] * along[number]
            normals, own = edges[number][2:]
            if any((normals @ (image - point)).max() <= 0 for image in (source, target)):
                continue
            if set(own) & {*before[-1:], *behind[-1:]}:
                continue
            ways = [
                points_back(end_of, chain, faces, point) for end_of, chain in ((start, before), (end, behind))
            ]
            if all(
                way is not None
                and all(
                    is_free(*segment, faces, (*a, *b))
                    for segment, (a, b) in zip(
                        itertools.pairwise(way),
                        itertools.pairwise([own, *((n,) for n in chain[::-1]), ()]),
                        strict=True,
                    )
                )
                for way, chain in zip(ways, (before, behind), strict=True)
            ):
                found.append(float(np.linalg.norm(source - point) + np.linalg.norm(target - point)))
    return sorted(found)


def lengths_through(start: Array, end: Array, at: Scene) -> list[tuple[float, int]]:
    """Length [m] and number of reflections of all paths that go through boxes, by every sequence of faces."""
    faces = rectangles(at)
    found = []
    for chain in chains_of(faces, DEPTH - 1):
        points = points_back(start, chain, faces, end)
        if points is None:
            continue
        crossed: list[int] = []
        for segment, ends in zip(
            itertools.pairwise(points), itertools.pairwise((None, *chain[::-1], None)), strict=True
        ):
            crossed += [
                n for n, face in enumerate(faces) if n not in ends and crossing(*segment, face) is not None
            ]
        if 0 < len(crossed) <= DEPTH - len(chain) and min(crossed) >= len(PLATES):
            found.append((float(np.linalg.norm(images(start, chain, faces)[-1] - end)), len(chain)))
    return sorted(found)


def lengths(channel: Channel, rx: int, kind: int | None = None) -> list[float]:
    """Of the paths of a receiver [m], or of those with an interaction of a kind."""
    rows = np.arange(channel.offsets[rx], channel.offsets[rx + 1])
    if kind is not None:
        rows = rows[(channel.interactions[rows] == kind).any(1)]
    return sorted((channel.tau[rows] * C).tolist())


def keys(channel: Channel) -> list[tuple[int, int]]:
    """Receiver and number of each path."""
    receiver = np.repeat(np.arange(len(channel.rx)), np.diff(channel.offsets))
    return list(zip(receiver.tolist(), channel.id.tolist(), strict=True))


def same(one: Channel, other: Channel) -> bool:
    return payload_digest(*encode_payload(one)) == payload_digest(*encode_payload(other))


def test_there_are_the_paths_of_all_sequences_of_faces(tmp_path: Path) -> None:
    """Of three boxes and three plates, by 5,000 sequences for each receiver; some by way of three faces."""
    model, _ = street(tmp_path)
    deepest = 0
    for seed in range(3):
        at = traffic(seed)
        channel = measure(model, at)
        faces = rectangles(at)
        for rx, device in enumerate(at.devices[1:]):
            wanted = paths_by_images(np.array(STATION), np.array(device.position), faces)
            assert lengths(channel, rx) == pytest.approx(wanted, abs=1e-7)
        deepest += int((channel.interactions != 0).all(1).sum())
    assert deepest > 10


@pytest.mark.parametrize("count", [1, pytest.param(2, marks=pytest.mark.exhaustive)])
def test_there_are_as_many_where_no_chain_of_scenery_is_as_long_as_others(tmp_path: Path, count: int) -> None:
    plates = PLATES[:count]
    model, _ = street(tmp_path, plates=plates)
    at = traffic(0)
    channel, faces = measure(model, at), rectangles(at, plates)
    for rx, device in enumerate(at.devices[1:]):
        wanted = paths_by_images(np.array(STATION), np.array(device.position), faces)
        assert len(wanted) >= 2
        assert lengths(channel, rx) == pytest.approx(wanted, abs=1e-7)


def test_a_plate_that_nobody_sees_leaves_the_line_of_sight(tmp_path: Path) -> None:
    """No face of scenery reflects, and no body is there: no chain at all."""
    far = Plate("far", [(900, 900, -90), (901, 900, -90), (901, 901, -90), (900, 901, -90)])
    model, _ = street(tmp_path, plates=[far])
    channel = measure(model, scene([antenna("bs", "tx", STATION), antenna("rx", "rx", (0.0, 0.0, 2.0))], []))
    assert len(channel.tau) == 1


def test_fields_are_those_of_launched_paths(tmp_path: Path) -> None:
    """Of each path that rays meet."""
    enumerated, _ = street(tmp_path / "one")
    launched, _ = street(tmp_path / "other", candidates="launched", samples=100_000)
    at = traffic(1)
    found, known = measure(enumerated, at), measure(launched, at)
    row = {key: i for i, key in enumerate(keys(found))}
    assert set(keys(known)) <= row.keys()
    rows = [row[key] for key in keys(known)]
    assert np.abs(found.a[0, rows] - known.a[0]).max() < 2e-5 * np.abs(known.a[0]).max()
    assert np.array_equal(found.interactions[rows], known.interactions)
    assert found.tau[rows] == pytest.approx(known.tau, rel=1e-13)


def test_a_cold_and_a_cached_launch_give_the_same(tmp_path: Path, own_cache: Path) -> None:
    cold, of_rays = street(tmp_path / "one")
    cached, of_file = street(tmp_path / "two")
    assert any("4 launches of 20000 rays" in note for note in of_rays)
    assert any("of the cache" in note for note in of_file)
    assert same(measure(cold, traffic(0)), measure(cached, traffic(0)))
    (file,) = own_cache.iterdir()
    file.write_bytes(file.read_bytes()[:-1])
    mended, said = street(tmp_path / "three")
    assert any("damaged" in note for note in said)
    assert any("4 launches of 20000 rays" in note for note in said)
    assert same(measure(cold, traffic(0)), measure(mended, traffic(0)))
    assert any("of the cache" in note for note in street(tmp_path / "four")[1])


def test_another_scenery_is_another_file_and_none_is_kept_that_need_not(
    tmp_path: Path, own_cache: Path
) -> None:
    street(tmp_path / "one", cache_chains=False)
    assert not own_cache.exists()
    street(tmp_path / "two")
    street(tmp_path / "three", samples=30_000)
    street(tmp_path / "four", max_depth=2)
    assert len(list(own_cache.iterdir())) == 3


@pytest.mark.parametrize(("few", "rays"), [pytest.param(64, 1, marks=pytest.mark.exhaustive), (0, 100_000)])
def test_from_a_transmitter_that_moves_the_same_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, few: int, rays: int
) -> None:
    """By all sequences of its scenery's few faces; of many, a launch in each frame finds the chains."""
    stands, _ = street(tmp_path / "one")
    monkeypatch.setattr(scenery_chains, "_FEW", few)
    moves, said = street(tmp_path / "two", standing=False, samples_per_frame=rays)
    assert not any("chains of scenery" in note for note in said)
    at = traffic(2)
    assert same(measure(stands, at), measure(moves, at))


def test_there_are_the_paths_over_all_edges_of_bodies(tmp_path: Path) -> None:
    """Of three boxes, by all sequences of faces before and after; each once, and one ray decides nothing."""
    model, _ = street(tmp_path, diffraction=True, samples_per_frame=1)
    plain, _ = street(tmp_path / "plain")
    at = traffic(1)
    channel = measure(model, at)
    for rx, device in enumerate(at.devices[1:]):
        wanted = lengths_over_edges(np.array(STATION), np.array(device.position), at)
        assert len(wanted) > 20
        assert lengths(channel, rx, DIFFRACTED) == pytest.approx(wanted, abs=1e-7)
    bent = (channel.interactions == DIFFRACTED).any(1)
    rest = [key for key, bends in zip(keys(channel), bent, strict=True) if not bends]
    assert sorted(rest) == sorted(keys(measure(plain, at)))
    assert len(set(keys(channel))) == len(keys(channel))


def test_there_are_the_paths_through_all_bodies(tmp_path: Path) -> None:
    """Also those with a reflection, beside a box or inside; what goes through two crosses too many faces."""
    model, _ = street(tmp_path, refraction=True, samples_per_frame=1, body_material="plasterboard")
    found = reflected = 0
    for seed in range(2):
        at = traffic(seed)
        places = np.random.default_rng(seed).uniform((-12, -5, 0.3), (10, 5, 3.0), (16, 3))
        devices = [antenna(f"rx{i:02d}", "rx", place) for i, place in enumerate(places)]
        at = msgspec.structs.replace(at, devices=(at.devices[0], *devices))
        channel = measure(model, at)
        for rx, device in enumerate(devices):
            wanted = lengths_through(np.array(STATION), np.array(device.position), at)
            told = lengths(channel, rx, int(Interaction.TRANSMISSION))
            assert told == pytest.approx([length for length, _ in wanted], abs=1e-7)
            found += len(wanted)
            reflected += sum(count for _, count in wanted)
    assert found > 12
    assert reflected > 1


def test_what_goes_through_a_body_has_the_field_of_two_slabs(tmp_path: Path) -> None:
    """At normal incidence (ITU-R P.2040-3, eq. 44), beside a launch's."""
    settings = {"refraction": True, "reflection": True, "body_material": "plasterboard", "max_depth": 2}
    frequency, thickness = 28e9, 0.1
    model, _ = street(tmp_path, samples_per_frame=1, **settings)
    ends = [antenna("bs", "tx", (-9.0, 0.0, 2.0)), antenna("rx", "rx", (9.0, 0.0, 2.0))]
    channel = measure(model, scene(ends, [Thing("box", (1.0, 0.2, 2.0), (2.0, 4.0, 3.0))]))
    straight = (channel.interactions == Interaction.TRANSMISSION).all(1)
    assert straight.sum() == 1
    eta = itu_permittivity(2.73, 0.0, 0.0085, 0.9395, frequency)
    index, back = np.sqrt(eta), (1 - np.sqrt(eta)) / (1 + np.sqrt(eta))
    within = np.exp(-2j * np.pi * thickness * frequency / C * index)
    through = (1 - back**2) * within / (1 - (back * within) ** 2)
    wanted = spherical_wave(18.0, frequency) * through**2
    assert channel.a[0, straight][0] == pytest.approx(wanted, rel=1e-5)


def test_paths_over_edges_have_the_fields_of_launched_ones(tmp_path: Path) -> None:
    enumerated, _ = street(tmp_path / "one", diffraction=True, samples_per_frame=1)
    launched, _ = street(tmp_path / "two", diffraction=True, candidates="launched", samples=30_000)
    at = traffic(2)
    found, known = measure(enumerated, at), measure(launched, at)
    row = {key: i for i, key in enumerate(keys(found))}
    assert set(keys(known)) < row.keys()
    rows = [row[key] for key in keys(known)]
    assert np.abs(found.a[0, rows] - known.a[0]).max() < 2e-5 * np.abs(known.a[0]).max()


def test_a_reflection_and_the_wave_over_the_edge_where_it_ends_have_one_sum(tmp_path: Path) -> None:
    """Across the line at which the reflection by the top of a box, then by the north wall, ends.

    Where a launch and enumeration do not agree on that reflection, they give the wave over the edge opposite
    signs, and both are right: the sum is the same, and continuous.
    """
    off = np.array([-1e-3, -3e-4, -1e-4, -1e-5, -1e-6, 1e-6, 1e-5, 1e-4, 3e-4, 1e-3])
    top, edge, wall = 2.0, 2.0, 10.0
    image = np.array([*STATION[:2], 2 * top - STATION[2]])
    beyond = np.array([1.0, 2 * wall - 5.0])
    height = image[2] + (top - image[2]) * (beyond[1] - image[1]) / (edge - image[1])
    length = np.linalg.norm([[*beyond, z] for z in height + off] - image, axis=1)
    devices = [antenna(f"rx{i}", "rx", (1.0, 5.0, float(z))) for i, z in enumerate(height + off)]
    at = scene([antenna("bs", "tx", STATION), *devices], [Thing("box", (0.0, 0.0, 1.0), (4.0, 4.0, 2.0))])
    sums = []
    for candidates in ("enumerated", "launched"):
        model, _ = street(tmp_path / candidates, diffraction=True, candidates=candidates, max_depth=2)
        channel = measure(model, at)
        owner = np.repeat(np.arange(len(off)), np.diff(channel.offsets))
        near = np.abs(channel.tau * C - length[owner]) < 1e-5
        bent = near & (channel.interactions == DIFFRACTED).any(1)
        reflected = near & (channel.interactions[:, :2] == Interaction.REFLECTION).all(1)
        h = channel.a[0] * np.exp(2j * np.pi * length[owner] * 28e9 / C)
        assert owner[bent].tolist() == list(range(len(off)))
        there = np.isin(np.arange(len(off)), owner[reflected])
        assert there[off > 0].all() or candidates == "launched"
        assert not there[off <= -3e-4].any()
        assert (np.sign(h[bent].real) == np.where(there, 1, -1) * np.sign(h[bent][-1].real)).all()
        sums.append(h[bent])
        np.add.at(sums[-1], owner[reflected], h[reflected])
        assert np.abs(sums[-1] / sums[0][0] - 1).max() < 0.01
    assert np.abs(sums[1] / sums[0] - 1).max() < 2e-3


def test_deeper_paths_than_are_enumerated_are_launched(tmp_path: Path) -> None:
    shallow, _ = street(tmp_path / "one", max_depth=2)
    mixed, _ = street(tmp_path / "two", enumerated_depth=2)
    at = traffic(0)
    two, three = measure(shallow, at), measure(mixed, at)
    assert set(keys(two)) < set(keys(three))


def test_transmitters_on_both_sides_of_a_thin_wall_have_the_paths_that_each_has_alone(tmp_path: Path) -> None:
    """However near to one another: each is launched from where it stands."""
    plates = [*PLATES, Plate("wall", [(-20, 0, 0), (20, 0, 0), (20, 0, 20), (-20, 0, 20)])]
    sides = {"north": (-3.0, 0.021, 9.0), "south": (-3.0, -0.021, 9.0)}
    receivers = [antenna(f"rx{y}", "rx", (4.0, y, 2.0)) for y in (-7.0, 7.0)]
    both, _ = street(tmp_path / "both", plates=plates, stations=sides, scenery_launches=1)
    together = measure(both, scene([*(antenna(name, "tx", at) for name, at in sides.items()), *receivers]))
    for t, (name, at) in enumerate(sides.items()):
        alone, _ = street(tmp_path / name, plates=plates, stations={name: at}, scenery_launches=1)
        one = measure(alone, scene([antenna(name, "tx", at), *receivers]))
        assert len(one.tau) > 3
        begin, end = together.offsets[2 * t], together.offsets[2 * t + 2]
        assert np.array_equal(together.tau[begin:end], one.tau)
        assert np.array_equal(together.a[:, begin:end], one.a)


def test_a_position_in_single_precision_is_that_of_the_scenario(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Worlds in other languages may send it so; its launch before the first frame counts."""
    place = (-3.1, -8.3, 5.7)
    model, _ = street(tmp_path, stations={"bs": place}, scenery_launches=1)
    monkeypatch.setattr(scenery_chains.SceneryChains, "_now", None)
    rounded = tuple(np.float32(place).tolist())
    assert rounded != place
    assert len(measure(model, scene([antenna("bs", "tx", rounded), antenna("rx", "rx", (0, 0, 2))])).tau) > 3


@pytest.mark.parametrize("more", [{"follow": 4}, {"rung": "mimo-rt"}])
def test_what_launches_its_own_cannot_enumerate(more: dict[str, Any]) -> None:
    with pytest.raises(msgspec.ValidationError, match='candidates = "enumerated"'):
        msgspec.convert({"candidates": "enumerated", **more}, SionnaSettings)


def test_spherical_waves_keep_what_only_a_part_of_the_elements_has(tmp_path: Path) -> None:
    """Launched paths of the arrays' corners stand beside the enumerated ones of their centres."""
    launched, _ = street(tmp_path / "one", rung="spherical", candidates="launched", samples=100_000)
    enumerated, _ = street(tmp_path / "two", rung="spherical", samples_per_frame=100_000)
    at = traffic(1)
    assert set(keys(measure(launched, at))) <= set(keys(measure(enumerated, at)))
