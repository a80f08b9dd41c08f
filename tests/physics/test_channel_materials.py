"""Materials at any frequency: ITU-R P.2040's own table, its ranges' ends, and every bundled scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import pytest

from caviar_labs.stability.formulas import (
    itu_permittivity,
    mirrored,
    reflected,
    spherical_wave,
    unit,
    vertical,
)
from caviar_labs.stability.lab import (
    Array,
    Lab,
    Material,
    Plate,
    antenna,
    carriers,
    link,
    measure,
    only_reflection,
    scene,
    sionna,
    square,
    write_scenery,
)
from caviar_protocol.codec import encode_payload
from caviar_protocol.errors import AssetError, ScenarioError
from caviar_protocol.topics import Channel, Scene
from caviar_services.channel.base import ChannelModel
from caviar_services.channel.sionna.model import SionnaChannel
from caviar_services.channel.sionna.settings import SionnaSettings
from caviar_services.service import Preparation, RunInfo
from caviar_space.materials import (
    ItuMaterial,
    MaterialPolicy,
    MaterialSettings,
    itu_material,
)
from caviar_space.scenery import scenery_assets

pytestmark = pytest.mark.channel

FREQUENCIES = (2.8e9, 28e9, 60e9, 100e9)
BUNDLED = (
    "box",
    "box_knife",
    "box_one_screen",
    "box_two_screens",
    "double_reflector",
    "etoile",
    "floor_wall",
    "florence",
    "munich",
    "san_francisco",
    "simple_reflector",
    "simple_street_canyon",
    "simple_street_canyon_with_cars",
    "simple_wedge",
    "triple_reflector",
)
LARGE = ("florence", "munich", "san_francisco")
BRICK = {
    "nearest": ("brick@c2: nearest 40 GHz", "brick@c3: nearest 110 GHz"),
    "extrapolate": ("brick@c2: extrapolate 1–40 GHz", "brick@c3: extrapolate 110–330 GHz"),
}
"""What scenes with brick use of it: neither 60 nor 100 GHz is in 1–40 or 110–330 GHz."""
WITH_BRICK = {"floor_wall", "munich", "simple_street_canyon", "simple_street_canyon_with_cars"}


@pytest.fixture(autouse=True, scope="module")
def started() -> None:
    """Sionna's table can be read only when a variant is set."""
    sionna(1e9, samples=100, max_depth=1, bodies=0, receivers_at_once=1)


def at(
    itu_type: str, ghz: float, outside: Literal["error", "nearest", "extrapolate"] = "error"
) -> ItuMaterial:
    return itu_material("m", itu_type, ghz * 1e9, MaterialPolicy(outside=outside))


# --- the table ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("itu_type", "ghz", "a", "b", "c", "d"),
    [
        ("concrete", 1.0, 5.24, 0.0, 0.0462, 0.7822),
        ("concrete", 28.0, 5.24, 0.0, 0.0462, 0.7822),
        ("concrete", 100.0, 5.24, 0.0, 0.0462, 0.7822),
        ("brick", 40.0, 3.91, 0.0, 0.0238, 0.16),
        ("plasterboard", 60.0, 2.73, 0.0, 0.0085, 0.9395),
        ("wood", 28.0, 1.99, 0.0, 0.0047, 1.0718),
        ("glass", 60.0, 6.31, 0.0, 0.0036, 1.3394),
        ("glass", 300.0, 5.79, 0.0, 0.0004, 1.658),
        ("ceiling_board", 260.0, 1.52, 0.0, 0.0029, 1.029),
        ("chipboard", 60.0, 2.58, 0.0, 0.0217, 0.78),
        ("plywood", 5.0, 2.71, 0.0, 0.33, 0.0),
        ("marble", 60.0, 7.074, 0.0, 0.0055, 0.9262),
        ("floorboard", 60.0, 3.66, 0.0, 0.0044, 1.3515),
        ("metal", 100.0, 1.0, 0.0, 1e7, 0.0),
        ("very_dry_ground", 10.0, 3.0, 0.0, 0.00015, 2.52),
        ("medium_dry_ground", 5.8, 15.0, -0.1, 0.035, 1.63),
        ("wet_ground", 2.8, 30.0, -0.4, 0.15, 1.30),
    ],
)
def test_constants_are_those_of_table_3(
    itu_type: str, ghz: float, a: float, b: float, c: float, d: float
) -> None:
    """P.2040-3, table 3, typed from the Recommendation; the ends of a range belong to it."""
    found = at(itu_type, ghz)
    assert found.constants == pytest.approx((a * ghz**b, c * ghz**d), rel=1e-12)
    assert not found.is_outside


@pytest.mark.parametrize(
    ("itu_type", "ghz", "nearest", "parameters"),
    [
        ("brick", 60.0, 40.0, (3.91, 0.0, 0.0238, 0.16)),
        ("marble", 80.0, 60.0, (7.074, 0.0, 0.0055, 0.9262)),
        ("concrete", 0.5, 1.0, (5.24, 0.0, 0.0462, 0.7822)),
        ("concrete", 400.0, 330.0, (5.17, 0.0, 0.0145, 1.09)),
        ("metal", 140.0, 100.0, (1.0, 0.0, 1e7, 0.0)),
        ("wet_ground", 28.0, 10.0, (30.0, -0.4, 0.15, 1.30)),
        ("medium_dry_ground", 60.0, 10.0, (15.0, -0.1, 0.035, 1.63)),
        ("plywood", 60.0, 40.0, (2.71, 0.0, 0.33, 0.0)),
        ("floorboard", 28.0, 50.0, (3.66, 0.0, 0.0044, 1.3515)),
    ],
)
def test_outside_its_ranges(itu_type: str, ghz: float, nearest: float, parameters: tuple[float, ...]) -> None:
    """`nearest` is the law at the nearest end, `extrapolate` the same law at the carrier."""
    a, b, c, d = parameters
    held = at(itu_type, ghz, "nearest")
    assert held.constants == pytest.approx((a * nearest**b, c * nearest**d), rel=1e-12)
    assert held.source == f"nearest {nearest:g} GHz"
    beyond = at(itu_type, ghz, "extrapolate")
    assert beyond.constants == pytest.approx((a * ghz**b, c * ghz**d), rel=1e-12)
    assert held.is_outside
    assert beyond.is_outside
    with pytest.raises(ScenarioError, match=f"ITU {itu_type}.* GHz, the carrier is at {ghz:g} GHz; choose"):
        at(itu_type, ghz)


@pytest.mark.parametrize("outside", ["nearest", "extrapolate"])
def test_a_policy_changes_nothing_within_a_range(outside: Any) -> None:
    assert at("brick", 28.0, outside).constants == at("brick", 28.0).constants


# --- in a channel -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("outside", "at_ghz", "source"),
    [("nearest", 10.0, "nearest 10 GHz"), ("extrapolate", 60.0, "extrapolate 1–10 GHz")],
)
def test_reflection_by_wet_ground_at_60_ghz(tmp_path: Path, outside: str, at_ghz: float, source: str) -> None:
    """Fresnel, with the constants of 10 GHz or of the law at 60 GHz; product and notes say which."""
    corners = [(-300, -300, 0), (300, -300, 0), (300, 300, 0), (-300, 300, 0)]
    assets = write_scenery(tmp_path, [Plate("ground", corners, "wet_ground")])
    model = sionna((5e9, 60e9), assets, max_depth=1, outside_itu_range=outside)
    tx, rx, up = np.array([-9.0, 4.0, 6.0]), np.array([31.0, -8.0, 11.0]), np.array([0.0, 0.0, 1.0])
    channel = measure(model, scene([antenna("t", "tx", tx), antenna("r", "rx", rx)]))
    image = mirrored(tx, np.zeros(3), up)
    k_out = unit(rx - image)
    k_in = k_out * [1, 1, -1]
    epsilon, sigma = 30 * at_ghz**-0.4, 0.15 * at_ghz**1.3
    eta = itu_permittivity(epsilon, 0.0, sigma, 0.0, 60e9)
    arrived = vertical(-k_out) @ reflected(vertical(k_in), k_in, up, eta)
    expected = spherical_wave(float(np.linalg.norm(rx - image)), 60e9) * arrived
    assert channel.a[1, 1] == pytest.approx(expected, rel=2e-3)
    assert channel.options.materials_outside == (f"skin-ground@c1: {source}",)


def test_the_notes_say_what_was_used(tmp_path: Path) -> None:
    """Material, type, ranges, carrier, frequency, policy and constants; with what the scenario changes."""
    corners = [(-9, -9, 0), (9, -9, 0), (9, 9, 0)]
    assets = write_scenery(tmp_path, [Plate("p", corners, "brick"), Plate("q", corners, "brick")])
    settings = {
        "outside_itu_range": "nearest",
        "materials": {"skin-q": {"relative_permittivity": 4.5}},
        "samples": 100,
        "receivers_at_once": 1,
    }
    run = RunInfo(name="channel", carriers=carriers(28e9, 60e9))
    model = SionnaChannel(msgspec.convert(settings, SionnaSettings), run)
    notes = model.prepare(Preparation(demand={}, assets=assets)).notes
    told = (
        "material {} (ITU brick) is defined for 1–40 GHz, 110–330 GHz; on carrier 'c1' at 60 GHz it has "
        "(nearest 40 GHz) relative permittivity {}, conductivity 0.04294 S/m"
    )
    assert [note for note in notes if note.startswith("material")] == [
        told.format("'skin-p'", 3.91),
        told.format("'skin-q'", 4.5),
    ]


# --- bundled scenes -----------------------------------------------------------------------------


def test_these_are_all_bundled_scenes() -> None:
    with pytest.raises(AssetError) as caught:
        scenery_assets("sionna:none")
    assert str(caught.value).endswith(f"known: {', '.join(BUNDLED)}")


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(
            name,
            marks=[pytest.mark.exhaustive] if name != "etoile" else [],
        )
        for name in BUNDLED
    ],
)
def test_bundled_scenes_run_on_four_carriers(name: str) -> None:
    """2.8, 28, 60 and 100 GHz in one product: a free line of sight, and a reflection from below on all four,
    under either policy; what was used where is in the product. A wedge of two walls has nothing below."""
    assets = scenery_assets(f"sionna:{name}")
    nearest, extrapolated = (
        over(assets, policy, [0] if name == "simple_wedge" else [0, 1])
        for policy in ("nearest", "extrapolate")
    )
    has_brick = name in WITH_BRICK
    assert nearest.options.materials_outside == (BRICK["nearest"] if has_brick else ())
    assert extrapolated.options.materials_outside == (BRICK["extrapolate"] if has_brick else ())
    if not has_brick:
        assert encode_payload(nearest)[1] == encode_payload(extrapolated)[1]


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name == "floor_wall" else pytest.mark.exhaustive)
        for name in sorted(WITH_BRICK)
    ],
)
def test_bundled_scenes_with_brick_are_refused_at_60_ghz_by_default(name: str) -> None:
    with pytest.raises(ScenarioError, match=r"'brick'.*1–40 GHz, 110–330 GHz"):
        sionna(60e9, scenery_assets(f"sionna:{name}"), bodies=0)


def over(assets: Any, outside: str, interactions: list[int]) -> Channel:
    """The product of a pair close above a scene, checked."""
    model = sionna(
        FREQUENCIES,
        assets,
        outside_itu_range=outside,
        samples=1000,
        max_depth=1,
        bodies=0,
        receivers_at_once=1,
    )
    tx, rx = above(model)
    channel = measure(model, pair(tx, rx))
    straight = [spherical_wave(float(np.linalg.norm(rx - tx)), f) for f in FREQUENCIES]
    assert np.isfinite(channel.a).all()
    assert (np.abs(channel.a) > 0).all()
    assert channel.interactions.sum(1).tolist() == interactions
    np.testing.assert_allclose(np.abs(channel.a[:, 0]), np.abs(straight), rtol=0.02)
    return channel


def above(model: ChannelModel[Any]) -> tuple[Array, Array]:
    low, high = model._scene.low, model._scene.high  # type: ignore[attr-defined]
    x, y, z = (low[0] + high[0]) / 2, (low[1] + high[1]) / 2, high[2]
    return np.array([x + 0.3, y + 0.2, z + 2]), np.array([x + 0.1, y + 0.4, z + 3])


def pair(tx: Array, rx: Array) -> Scene:
    return scene([antenna("t", "tx", tx), antenna("r", "rx", rx)])


@pytest.mark.parametrize("candidates", ["launched", "enumerated"])
@pytest.mark.parametrize(
    ("permittivity", "conductivity", "thickness"),
    [
        pytest.param(1e12, 0.0, 1000.0, marks=pytest.mark.exhaustive),
        pytest.param(1.0, 1e12, 1000.0, marks=pytest.mark.exhaustive),
        (1e9, 1e9, 0.1),
    ],
)
def test_the_greatest_constants_reflect_everything(
    tmp_path: Path, permittivity: float, conductivity: float, thickness: float, candidates: str
) -> None:
    plate = Plate("ground", square(100.0), Material(permittivity, conductivity, thickness))
    channel = link(Lab(tmp_path).traced(28e9, [plate], candidates=candidates), (0, 0, 10), (20, 0, 2))
    gain = np.abs(channel.a[0, only_reflection(channel)] / spherical_wave(float(np.hypot(20, 12)), 28e9))
    assert gain == pytest.approx(1.0, abs=2e-4)


def test_constants_beyond_what_float32_can_square_are_refused() -> None:
    with pytest.raises(msgspec.ValidationError, match="1000000000000"):
        msgspec.convert({"conductivity_s_per_m": 1e13}, MaterialSettings)
