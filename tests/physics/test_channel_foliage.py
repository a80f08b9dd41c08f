"""Foliage: what paths lose in it, against slabs of boxes and ITU-R P.833's equation, on all traced rungs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
import pytest

from caviar_labs.stability.lab import (
    Lab,
    Material,
    Plate,
    Point,
    Thing,
    antenna,
    link,
    measure,
    scene,
    square,
)
from caviar_protocol.arrays import Float64Array
from caviar_protocol.codec import encode_payload
from caviar_protocol.errors import AssetError, ScenarioError
from caviar_protocol.topics import AntennaArray, Channel, Interaction, Scene
from caviar_services.channel.paths import Antenna
from caviar_space.meshes import box

pytestmark = pytest.mark.channel

Box = tuple[Point, Point]

F = 28e9
CARRIERS = (F, F, F, 949e6)
"""Without a maximum, without loss, with a maximum, and where table 1 has values."""
GAMMA, MOST = 1.7, 12.0
STATED: dict[str, Any] = {
    "attenuation_db_per_m": {"c0": GAMMA, "c1": 0.0, "c2": GAMMA},
    "maximum_db": {"c2": MOST},
    "source": "measured",
}
ONE_CARRIER: dict[str, Any] = {"attenuation_db_per_m": {"c0": GAMMA}, "maximum_db": {}}
CROWNS: dict[str, Box] = {
    "crown.a": ((18.0, -4.0, 0.5), (24.0, 5.0, 9.0)),
    "crown.b": ((22.0, -5.0, 0.5), (28.0, 3.0, 7.0)),
}
"""Two of one kind that overlap, and stand a little off the ground."""
SURFACE = Material(5.0, 0.01, thickness=0.2)
GROUND = Plate("ground", square(90.0), SURFACE)
WALLS = [
    Plate("wall", [(10.0, 11.0, 0.0), (40.0, 11.0, 0.0), (40.0, 11.0, 9.0), (10.0, 11.0, 9.0)], SURFACE),
    Plate("back", [(52.0, -30.0, 0.0), (52.0, 30.0, 0.0), (52.0, 30.0, 12.0), (52.0, -30.0, 12.0)], SURFACE),
]
TX, RX = (0.3, 0.7, 5.1), (45.2, -1.3, 1.6)


def crown(name: str, bounds: Box, faces: Any = None) -> Plate:
    """A piece of scenery that is a closed box."""
    mesh = box(*zip(*bounds, strict=True))  # type: ignore[arg-type]
    of = mesh.faces.tolist() if faces is None else faces
    return Plate(name, mesh.vertices.tolist(), SURFACE, faces=of)


PLATES = [GROUND, *WALLS, *(crown(name, bounds) for name, bounds in CROWNS.items())]


def within(bounds: Box, start: Float64Array, end: Float64Array) -> tuple[float, float]:
    """Where a segment enters and leaves a box, as shares of it; two of the same where it does not."""
    along = end - start
    with np.errstate(divide="ignore"):
        one, other = (np.array(bounds[0]) - start) / along, (np.array(bounds[1]) - start) / along
    near, far = max(np.minimum(one, other).max(), 0.0), min(np.maximum(one, other).min(), 1.0)
    return (near, far) if near < far else (0.0, 0.0)


def length_in(boxes: Sequence[Box], corners: Float64Array) -> float:
    """How far a path runs in the union of two boxes at most, over all of its legs."""
    total = 0.0
    for start, end in pairwise(corners):
        parts = [within(bounds, start, end) for bounds in boxes]
        shared = max(0.0, min(b for _, b in parts) - max(a for a, _ in parts)) if len(parts) > 1 else 0.0
        total += (sum(b - a for a, b in parts) - shared) * float(np.linalg.norm(end - start))
    return total


def corners_of(channel: Channel, path: int, tx: Point = TX, rx: Point = RX) -> Float64Array:
    count = np.count_nonzero(channel.interactions[path])
    return np.concatenate([[tx], channel.points[path, :count], [rx]])


def lost_db(channel: Channel, carrier: int) -> Float64Array:
    """What each path has lost against the carrier without loss; that nothing is turned is checked."""
    ratio = channel.a[carrier] / channel.a[1]
    assert np.abs(ratio.imag).max() < 1e-12
    return -20 * np.log10(ratio.real)


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Lab:
    return Lab(tmp_path_factory.mktemp("foliage"))


def woods(lab: Lab, **settings: Any) -> Any:
    foliage = {"crown.*": STATED, "bush": STATED | {"maximum_db": {}}}
    return lab.traced(CARRIERS, PLATES, foliage=foliage, **{"max_depth": 2, "bodies": 2, **settings})


@pytest.mark.parametrize(
    "settings",
    [
        pytest.param({"diffraction": True, "refraction": True}, id="launched, diffracted, refracted"),
        pytest.param(
            {"candidates": "enumerated", "cache_chains": False, "scenery_launches": 1}, id="enumerated"
        ),
    ],
)
def test_each_leg_of_each_path_loses_what_it_runs_inside(lab: Lab, settings: dict[str, Any]) -> None:
    """γ·d, and the saturating form with a maximum: line of sight, reflections by ground, walls, a lorry."""
    lorry = Thing("lorry", (20.0, 6.5, 3.0), size=(8.0, 1.0, 6.0))
    channel = link(woods(lab, **settings), TX, RX, lorry)
    inside = np.array(
        [length_in(list(CROWNS.values()), corners_of(channel, path)) for path in range(len(channel.tau))]
    )
    assert channel.los.all()
    by_lorry = (channel.objects == channel.object_names.index("lorry")).any(1)
    assert np.count_nonzero(inside) >= 4
    assert inside[by_lorry].any()
    assert (inside == 0).any()
    kinds = set(channel.interactions.ravel().tolist())
    assert Interaction.REFLECTION in kinds
    assert (Interaction.DIFFRACTION in kinds) == settings.get("diffraction", False)
    assert lost_db(channel, 0) == pytest.approx(GAMMA * inside, abs=1e-6)
    assert lost_db(channel, 2) == pytest.approx(MOST * (1 - np.exp(-GAMMA * inside / MOST)), abs=1e-6)


def test_without_it_all_else_is_as_if_it_were_not_there(lab: Lab) -> None:
    """Amplitudes on the carrier without loss, and all of the geometry, to the bit."""
    with_it = link(woods(lab), TX, RX)
    bare = link(lab.traced(CARRIERS, [GROUND, *WALLS], max_depth=2, bodies=2), TX, RX)
    assert len(bare.tau) > 3
    assert np.array_equal(with_it.a[1], bare.a[1])
    for name in ("id", "tau", "aod", "aoa", "points", "doppler", "los"):
        assert np.array_equal(getattr(with_it, name), getattr(bare, name))
    assert (np.abs(with_it.a[0]) < np.abs(bare.a[0])).any()


def test_a_frame_without_any_path_has_nothing_to_attenuate(lab: Lab) -> None:
    """A wall on the ground hides all, and reflections find no way around it."""
    hidden = Plate(
        "hides", [(40.0, -90.0, 0.0), (40.0, 90.0, 0.0), (40.0, 90.0, 99.0), (40.0, -90.0, 99.0)], SURFACE
    )
    plates = [GROUND, hidden, *(crown(name, bounds) for name, bounds in CROWNS.items())]
    model = lab.traced(CARRIERS, plates, foliage={"crown.*": STATED}, max_depth=2, bodies=2)
    channel = link(model, TX, RX)
    assert not channel.tau.size
    assert not channel.los.any()


def test_the_product_states_what_attenuates(lab: Lab) -> None:
    """Kinds and carriers in the options, which its digest includes; 949 MHz has γ and A_m of table 1."""
    channel = link(woods(lab), TX, RX)
    assert channel.options.foliage == (
        "crown.*@c0: 1.7 dB/m (measured)",
        "crown.*@c1: 0 dB/m (measured)",
        "crown.*@c2: 1.7 dB/m, at most 12 dB (measured)",
        "crown.*@c3: 0.17 dB/m, at most 26.5 dB (ITU-R P.833-10, table 1)",
        "bush@c0: 1.7 dB/m (measured)",
        "bush@c1: 0 dB/m (measured)",
        "bush@c2: 1.7 dB/m (measured)",
        "bush@c3: 0.17 dB/m, at most 26.5 dB (ITU-R P.833-10, table 1)",
    )
    clear = link(lab.traced(CARRIERS, [GROUND, *WALLS], max_depth=2, bodies=2), TX, RX)
    assert clear.options.foliage == ()
    assert encode_payload(channel)[0] != encode_payload(clear)[0]
    inside = length_in(list(CROWNS.values()), np.array([TX, RX]))
    got = -20 * math.log10(abs(channel.a[3, 0] / clear.a[3, 0]))
    assert got == pytest.approx(26.5 * (1 - math.exp(-0.17 * inside / 26.5)), abs=1e-6)


def turned(yaw: float) -> Point:
    return (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))


def of_class(at: Scene, **classes: str) -> Scene:
    return msgspec.structs.replace(at, classes=tuple(classes.get(name, "car") for name in at.names))


def test_objects_are_foliage_within_their_bounding_boxes(lab: Lab) -> None:
    """By class, turned by 30° and moved between frames: three, with a pool of two bodies, and an antenna in
    the middle of one. An overlap with the crowns, of another kind, counts for both."""
    model = woods(lab, max_depth=0)
    yaw, size = math.radians(30), np.array([4.0, 6.0, 20.0])
    back = np.array([[math.cos(yaw), math.sin(yaw), 0], [-math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
    for number, x in enumerate((8.0, 21.0)):
        bushes = [Thing(f"b{i}", (x, 1.0, 3.0), tuple(size), turned(yaw)) for i in range(3)]
        devices = [antenna("t", "tx", TX), antenna("r", "rx", RX)]
        at = of_class(scene(devices, bushes), b0="bush", b1="bush", b2="bush")
        channel = measure(model, at, number)
        line = (np.array([TX, RX]) - [x, 1.0, 3.0]) @ back.T
        bush = length_in([(tuple(-size / 2), tuple(size / 2))], line)
        crowns = length_in(list(CROWNS.values()), np.array([TX, RX]))
        assert bush > 4.0
        assert lost_db(channel, 0) == pytest.approx([GAMMA * (bush + crowns)], abs=1e-6)
        assert channel.los.all()
    within_it = [antenna("t", "tx", TX), antenna("r", "rx", (0.0, 0.0, 0.0), parent="b0")]
    channel = measure(model, of_class(scene(within_it, bushes[:1]), b0="bush"), 2)
    line = np.array([TX, bushes[0].position])
    alone = length_in([(tuple(-size / 2), tuple(size / 2))], (line - line[1]) @ back.T)
    expected = GAMMA * (alone + length_in(list(CROWNS.values()), line))
    assert lost_db(channel, 0) == pytest.approx([expected], abs=1e-6)


@pytest.mark.parametrize(
    "rung", [pytest.param("siso-rt", marks=pytest.mark.exhaustive), "spherical", "mimo-rt"]
)
def test_matrices_on_every_rung(lab: Lab, rung: str) -> None:
    """H of the line of sight: on mimo-rt each pair of elements has a length of its own, elsewhere it is that
    between the arrays' centres. A hedge at 40° to the line."""
    stated = {"attenuation_db_per_m": {"c0": GAMMA, "c1": 0.0}, "source": "measured"}
    model = lab.traced((1e9, 1e9), foliage={"hedge": stated}, rung=rung, max_depth=0)
    spacing, yaw = 4.0, math.radians(40)
    array = AntennaArray(rows=1, columns=2, horizontal_spacing=spacing)
    hedge = Thing("hedge", (20.0, 0.0, 2.0), (3.0, 90.0, 9.0), turned(yaw))
    devices = [antenna("t", "tx", (0, 0, 2), array), antenna("r", "rx", (41, 0, 2), array)]
    channel = measure(model, scene(devices, [hedge]))
    got = -20 * np.log10(np.abs(channel.h[0].h / channel.h[1].h))
    y = np.array([-0.5, 0.5]) * spacing * 299_792_458.0 / 1e9
    rise = (y[:, None] - y) / 41.0  # of the line from element n to m
    across = np.hypot(1.0, rise) * 3.0 / np.abs(math.cos(yaw) + rise * math.sin(yaw))
    expected = GAMMA * (across if rung == "mimo-rt" else 3.0 / math.cos(yaw))
    assert np.abs(got - expected).max() < 1e-6


def test_what_half_of_the_rays_would_miss_is_weighed_with_what_is_left(lab: Lab) -> None:
    """A bush on the line of sight alone: of the power that arrives, the reflection is a larger part."""
    model = lab.traced((F,), [GROUND], foliage={"bush": {**STATED, **ONE_CARRIER}}, samples=50)
    model.with_split = True
    ends = [antenna("t", "tx", (0.0, 0.0, 8.0)), antenna("r", "rx", (60.0, 0.0, 8.0))]
    bush = Thing("bush", (30.0, 0.0, 8.0), (5.0, 5.0, 5.0))
    clear, behind = (
        model.paths(at, [Antenna.of(at, ends[0])], [Antenna.of(at, ends[1])])
        for at in (scene(ends), scene(ends, [bush]))
    )
    power = [(np.abs(found.table.transfer[0]) ** 2).sum((1, 2)) for found in (clear, behind)]
    assert len(power[0]) == len(power[1]) == 2
    assert power[1].sum() < 0.5 * power[0].sum()
    assert behind.split_nmse / clear.split_nmse == pytest.approx(power[0].sum() / power[1].sum(), rel=1e-5)
    assert clear.split_nmse.item() > 0


# --- what is refused -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("foliage", "key", "says"),
    [
        (
            {"tree": {}},
            "tree.attenuation_db_per_m",
            "lacks carrier 'c0' at 28000 MHz, .*105.9–2117.5 MHz; write",
        ),
        (
            {"tree": {"attenuation_db_per_m": {"c0": 1.0}}},
            "tree.attenuation_db_per_m",
            "write it as .*source",
        ),
        (
            {"tree": {"attenuation_db_per_m": {"c7": 1.0}, "source": "s"}},
            "tree.attenuation_db_per_m.c7",
            "no carrier 'c7'; known: c0",
        ),
        ({"tree": {"attenuation_db_per_m": {"c0": -1.0}}}, "tree.attenuation_db_per_m.c0", "write a number"),
        ({"tree": {"maximum_db": {"c0": 0.0}}}, "tree.maximum_db.c0", "write a number"),
        ({"car": STATED}, "car", "'car' is foliage here and stands in without_body, too"),
        ({"van": STATED}, "van", "'van' is foliage here and stands in object_materials, too"),
    ],
)
def test_what_is_wrong_names_its_key(lab: Lab, foliage: dict[str, Any], key: str, says: str) -> None:
    with pytest.raises(ScenarioError, match=says) as refused:
        lab.traced(F, foliage=foliage, without_body=["car"], object_materials={"van": "glass"})
    assert refused.value.key.endswith(f"settings.foliage.{key}")


def test_an_open_piece_of_scenery_has_no_inside(lab: Lab) -> None:
    leaf = crown("crown.c", CROWNS["crown.a"], box(*[(0.0, 1.0)] * 3).faces[1:].tolist())
    stated = {"attenuation_db_per_m": {"c0": 1.0}, "source": "s"}
    with pytest.raises(AssetError, match=r"'crown.c'.*3 of its 18 edges"):
        lab.traced(F, [GROUND, leaf], foliage={"crown.*": stated})
