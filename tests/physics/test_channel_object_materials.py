"""Materials of single objects and classes: their constants, and reflection by each as Fresnel has it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from caviar_labs.stability.formulas import (
    EPSILON_0,
    itu_permittivity,
    mirrored,
    reflected,
    spherical_wave,
    unit,
    vertical,
)
from caviar_labs.stability.lab import (
    Array,
    Plate,
    Thing,
    antenna,
    measure,
    scene,
    sionna,
    write_scenery,
)
from caviar_protocol.errors import AssetError, ScenarioError
from caviar_protocol.topics import Channel, Interaction, Scene
from caviar_space.materials import OTHER_MATERIALS, ObjectMaterials, body_kind

pytestmark = pytest.mark.channel

F = 28e9
BOXES = {
    "box.glass": itu_permittivity(6.31, 0.0, 0.0036, 1.3394, F),
    "box.wood": itu_permittivity(1.99, 0.0, 0.0047, 1.0718, F),
    "person": 16.5516 - 25.8241j / (2 * np.pi * F * EPSILON_0),
    "case": 2.7 * (1 - 0.008j),
    "crate": 4.0 - 0.5j / (2 * np.pi * F * EPSILON_0),
    "car": 1 - 1e7j / (2 * np.pi * F * EPSILON_0),
}
"""Complex permittivity of what each object is made of; wood by its pattern, glass by its name."""
CLASSES = {"person": "pedestrian", "case": "robot", "crate": "crate"}
SETTINGS: dict[str, Any] = {
    "object_materials": {
        "box.*": "wood",
        "box.glass": "glass",
        "pedestrian": "skin",
        "robot": "plastic",
        "crate": "rubber",
        "wall": "marble",
    },
    # So thick that what enters does not come back.
    "materials": {
        name: {"thickness_m": 50.0} for name in ("wood", "glass", "skin", "plastic", "marble")
    } | {"rubber": {"relative_permittivity": 4.0, "conductivity_s_per_m": 0.5, "thickness_m": 50.0}},
    "bodies": 2,
    "max_depth": 1,
}  # fmt: skip
WALL = Plate("wall", [(-90, -60, 0), (200, -60, 0), (200, -60, 30), (-90, -60, 30)])
TX = np.array([44.0, -14.0, 1.9])


def receiver_of(name: str) -> tuple[str, Array]:
    """A receiver that sees the transmitter in the front of an object, 0.5 m beside its middle."""
    number = list(BOXES).index(name)
    mirror = 20.0 * number + 0.5
    return f"r{number}", np.array([mirror + (mirror - TX[0]) * 8.5 / 13.5, -9.0, 1.2])


def street() -> Scene:
    """Boxes in a row, each with the transmitter and a receiver of its own before it."""
    ends, things = [], []
    for number, name in enumerate(BOXES):
        receiver, place = receiver_of(name)
        ends.append(antenna(receiver, "rx", place))
        things.append(Thing(name, (20.0 * number, 0.0, 1.5), size=(6.0, 1.0, 3.0)))
    made = scene([antenna("t", "tx", TX), *ends], things)
    return msgspec.structs.replace(made, classes=tuple(CLASSES.get(name, "car") for name in made.names))


@pytest.fixture(scope="module", params=["launched", "enumerated"])
def seen(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Channel:
    assets = write_scenery(tmp_path_factory.mktemp("wall"), [replace(WALL, material="concrete")])
    extra = {"scenery_launches": 1, "cache_chains": False} if request.param == "enumerated" else {}
    model = sionna(F, assets, candidates=request.param, samples=200_000, **SETTINGS, **extra)
    return measure(model, street())


def by_object(channel: Channel, receiver: str, name: str) -> complex:
    """Amplitude of the path that one object reflects to a receiver."""
    paths = channel.pair("t", receiver)
    index = channel.object_names.index(name)
    rows = [
        row for row in range(paths.start, paths.stop)
        if channel.interactions[row, 0] == Interaction.REFLECTION and channel.objects[row, 0] == index
    ]  # fmt: skip
    assert len(rows) == 1
    return complex(channel.a[0, rows[0]])


def image(tx: Array, rx: Array, y: float, eta: complex) -> complex:
    """The path that a wall across y, of a half-space of permittivity ``eta``, reflects."""
    normal = np.array([0.0, 1.0, 0.0])
    start = mirrored(tx, np.array([0.0, y, 0.0]), normal)
    k_out = unit(rx - start)
    arrived = reflected(vertical(k_out * [1, -1, 1]), k_out * [1, -1, 1], normal, eta)
    return spherical_wave(float(np.linalg.norm(rx - start)), F) * complex(vertical(-k_out) @ arrived)


@pytest.mark.parametrize("name", BOXES)
def test_each_object_reflects_as_fresnel_has_it(seen: Channel, name: str) -> None:
    """Amplitude and phase within 1e-3 of the formula, by launched and by enumerated candidates."""
    receiver, rx = receiver_of(name)
    expected = image(TX, rx, -0.5, BOXES[name])
    assert abs(by_object(seen, receiver, name) / expected - 1) < 1e-3


def test_the_echo_of_a_person_is_that_of_metal_less_what_fresnel_gives(seen: Channel) -> None:
    """Skin of 16.6 − j16.6 at 28 GHz takes some 3 dB; both echoes are compared with the formula of their own
    geometry, and their ratio in decibels with that of the formulas."""
    found, expected = [], []
    for name in ("person", "car"):
        receiver, rx = receiver_of(name)
        found.append(20 * np.log10(abs(by_object(seen, receiver, name))))
        expected.append(20 * np.log10(abs(image(TX, rx, -0.5, BOXES[name]))))
        # The same way between two other materials would lose the same: only the material is left.
        metal = 20 * np.log10(abs(image(TX, rx, -0.5, BOXES["car"])))
        expected[-1], found[-1] = expected[-1] - metal, found[-1] - metal
    assert found[0] - found[1] == pytest.approx(expected[0] - expected[1], abs=0.01)
    assert -6.0 < found[0] - found[1] < -2.0


def test_a_piece_of_scenery_is_given_a_material_by_its_name(seen: Channel) -> None:
    """The wall of concrete is marble here."""
    receiver, rx = receiver_of("car")
    expected = image(TX, rx, -60.0, itu_permittivity(7.074, 0.0, 0.0055, 0.9262, F))
    assert abs(by_object(seen, receiver, "wall") / expected - 1) < 1e-3


@pytest.mark.parametrize(
    ("gigahertz", "permittivity", "conductivity"),
    [(1.0, 40.9, 0.900), (28.0, 16.55, 25.82), (60.0, 7.98, 36.4)],
)
def test_dry_skin_has_the_published_constants(
    gigahertz: float, permittivity: float, conductivity: float
) -> None:
    """Of the tables that are made of the parametric model (C. Gabriel and others)."""
    found = OTHER_MATERIALS["skin"].constants(gigahertz)
    assert found == pytest.approx((permittivity, conductivity), rel=2e-3)


def test_name_then_pattern_then_class_say_what_an_object_is_made_of() -> None:
    materials = ObjectMaterials({"car": "glass", "car.*": "wood", "car.1": "skin"})
    asked = ("car.1", "car"), ("car.2", "car"), ("bus.1", "car"), ("x", "y")
    assert [materials.material_for(*of) for of in asked] == ["skin", "wood", "glass", ""]
    assert materials.unmatched([("bus.1", "car"), ("car.2", "")]) == ("car.1",)
    assert materials.unmatched([("car.1", "car")]) == ("car", "car.*")
    assert (body_kind("objects/car.ply", ""), body_kind("", "skin")) == ("objects/car.ply", "the box of skin")


@pytest.mark.parametrize(
    ("settings", "key", "says"),
    [
        ({"object_materials": {"pedestrian": "skni"}}, "object_materials.pedestrian", "did you mean 'skin'"),
        (
            {"object_materials": {"car.*": "brick"}},
            "outside_itu_range",
            "'object_materials.\"car.\\*\"' \\(ITU brick\\) is defined for",
        ),
        (
            {"object_materials": {"car": "glass"}, "materials": {"glas": {"thickness_m": 1.0}}},
            "materials.glas",
            "has no material 'glas'",
        ),
        (
            {"object_materials": {"car": "tin"}, "materials": {"tin": {"relative_permittivity": 1.0}}},
            "object_materials.car",
            "no ITU material 'tin'; write materials.tin.conductivity_s_per_m for one of your own, or ",
        ),
    ],
)
def test_what_is_wrong_with_a_material_names_its_key(settings: dict[str, Any], key: str, says: str) -> None:
    with pytest.raises(ScenarioError, match=says) as refused:
        sionna(60e9, **settings)
    assert refused.value.key == f"services.channel.settings.{key}"


@pytest.mark.parametrize(
    "key", ["*", *(pytest.param(key, marks=pytest.mark.exhaustive) for key in ("c*", ""))]
)
@pytest.mark.parametrize("setting", ["object_materials", "foliage"])
def test_a_pattern_of_everything_ends_no_enumerated_run(setting: str, key: str) -> None:
    """Kernels are compiled with objects of no name that the user's patterns could match."""
    value: dict[str, Any] = {
        "object_materials": "glass",
        "foliage": {"attenuation_db_per_m": {"c0": 1.0}, "source": "a test"},
    }
    sionna(F, **{setting: {key: value[setting]}}, candidates="enumerated", samples=1000, max_depth=1)


@pytest.mark.parametrize(
    ("broken", "says"),
    [
        ("3 0 1 7", "faces refer to vertices 0 to 7 of 4"),
        ("3 0 1 -2", "faces refer to vertices -2 to 3 of 4"),
    ],
)
def test_a_face_without_its_vertices_is_named_by_line_and_mesh(
    tmp_path: Path, broken: str, says: str
) -> None:
    """The ray tracer reads beyond its memory there."""
    assets = write_scenery(tmp_path, [WALL])
    mesh = assets["scenery/meshes/wall.ply"]
    mesh.write_text(mesh.read_text().replace("3 0 1 2", broken))
    with pytest.raises(
        AssetError, match=rf"scenery/scene\.xml:\d+: shape 'mesh-wall': mesh wall\.ply: .*{says}"
    ):
        sionna(F, assets, samples=1000, max_depth=1)
    with pytest.raises(AssetError, match=rf"mesh 'objects/wall\.ply': .*{says}"):
        sionna(F, {"objects/wall.ply": mesh}, samples=1000, max_depth=1)


def test_keys_that_are_for_nothing_in_a_frame_are_counted_and_those_of_objects_with_a_mesh_are_not() -> None:
    keys = {"sign": "wood", "board": "glass", "pedestrian": "skin", "bus.*": "metal", "wall": "concrete"}
    model: Any = sionna(60e9, object_materials=keys, samples=1000, max_depth=1)
    scene = Scene(
        names=("bus.1", "s"),
        classes=("bus", "sign"),
        assets=("", "objects/board.ply"),
        position=np.zeros((2, 3)),
        orientation=np.tile([1.0, 0, 0, 0], (2, 1)),
        velocity=np.zeros((2, 3)),
        dimensions=np.ones((2, 3)),
    )
    assert model._unmatched(scene) == {
        "unmatched/object_materials.board": 1,
        "unmatched/object_materials.pedestrian": 1,
        "unmatched/object_materials.wall": 1,
    }
