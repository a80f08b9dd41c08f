"""Enumerated candidates: every path of images that there is, whatever rays would meet."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from channel_lab import Array, C, Plate, Thing, antenna, carriers, measure, mirrored, scene, write_scenery

from caviar_protocol.codec import encode_payload
from caviar_protocol.digest import payload_digest
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.topics import Channel, Scene
from caviar_services.channel.base import ChannelModel
from caviar_services.channel.enumeration import scenery_chains
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


def rectangles(at: Scene, plates: Sequence[Plate] = PLATES) -> list[Array]:
    """Corner and both sides of every face, Shape ``[3, 3]``: of the plates, then of the boxes."""
    found = []
    for plate in plates:
        a, b, _, d = np.array(plate.corners, float)
        found.append(np.array([a, b - a, d - a]))
    for position, (w, _, _, z), size in zip(at.position, at.orientation, at.dimensions, strict=True):
        cosine, sine = w * w - z * z, 2 * w * z
        axes = np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]]) * size[:, None]
        for axis, sign in itertools.product(range(3), (-0.5, 0.5)):
            one, other = axes[(axis + 1) % 3], axes[(axis + 2) % 3]
            corner = position + sign * axes[axis] - (one + other) / 2
            found.append(np.array([corner, one, other]))
    return found


def crossing(start: Array, end: Array, face: Array) -> tuple[float, Array] | None:
    """Where a segment crosses a face, as a part of it, and the point; None: nowhere."""
    corner, one, other = face
    normal = np.cross(one, other)
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
    numbers = range(len(faces))
    for depth in range(DEPTH + 1):
        for chain in itertools.product(numbers, repeat=depth):
            if any(one == other for one, other in itertools.pairwise(chain)):
                continue
            images = [start]
            for number in chain:
                corner, one, other = faces[number]
                normal = np.cross(one, other)
                images.append(mirrored(images[-1], corner, normal / np.linalg.norm(normal)))
            here, points = end, [end]
            for number, image in zip(chain[::-1], images[:0:-1], strict=True):
                met = crossing(here, image, faces[number])
                if met is None:
                    break
                here = met[1]
                points.append(here)
            else:
                points.append(start)
                ends = (None, *chain[::-1], None)
                segments = zip(itertools.pairwise(points), itertools.pairwise(ends), strict=True)
                if all(is_free(*segment, faces, own) for segment, own in segments):
                    found.append(float(np.linalg.norm(images[-1] - end)))
    return sorted(found)


def lengths(channel: Channel, rx: int) -> list[float]:
    return sorted((channel.tau[channel.offsets[rx] : channel.offsets[rx + 1]] * C).tolist())


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


@pytest.mark.parametrize("count", [1, 2])
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


@pytest.mark.parametrize(("few", "rays"), [(64, 1), (0, 100_000)])
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


def test_what_is_not_enumerated_is_launched_beside_it(tmp_path: Path) -> None:
    """Diffraction at the boxes' edges; reflections are there once."""
    plain, _ = street(tmp_path / "one")
    bent, _ = street(tmp_path / "two", diffraction=True)
    at = traffic(1)
    reflections, all_kinds = measure(plain, at), measure(bent, at)
    diffracted = (all_kinds.interactions == 2).any(1)
    assert diffracted.any()
    rest = [key for key, bends in zip(keys(all_kinds), diffracted, strict=True) if not bends]
    assert sorted(rest) == sorted(keys(reflections))
    assert len(set(keys(all_kinds))) == len(keys(all_kinds))


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
    with pytest.raises(msgspec.ValidationError, match='candidates = "enumerated" goes with neither'):
        msgspec.convert({"candidates": "enumerated", **more}, SionnaSettings)


def test_spherical_waves_keep_what_only_a_part_of_the_elements_has(tmp_path: Path) -> None:
    """Launched paths of the arrays' corners stand beside the enumerated ones of their centres."""
    launched, _ = street(tmp_path / "one", rung="spherical", candidates="launched", samples=100_000)
    enumerated, _ = street(tmp_path / "two", rung="spherical", samples_per_frame=100_000)
    at = traffic(1)
    assert set(keys(measure(launched, at))) <= set(keys(measure(enumerated, at)))
