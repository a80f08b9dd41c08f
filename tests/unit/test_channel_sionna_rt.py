"""The ray-traced service: settings, what it refuses and how it says so."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from caviar_labs.stability.lab import frame_of
from caviar_protocol.errors import AssetError, PayloadError, ScenarioError
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.topics import AntennaDevice, Carrier, Channel, Scene
from caviar_services.channel.sionna.model import SionnaChannel
from caviar_services.channel.sionna.settings import SionnaSettings
from caviar_services.registry import load
from caviar_services.service import Preparation, RunInfo, StepResult
from caviar_space.meshes import ply, unit_box

pytestmark = pytest.mark.slow

RX = DeviceSpec(name="rx", kind="antenna", role="rx", on="car.*", count=3)
PLY = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_index
end_header
-50 -50 0
50 -50 0
0 50 0
3 0 1 2
"""


def scenery(folder: Path, itu_type: str, mesh: str = "floor.ply") -> dict[str, Path]:
    (folder / "floor.ply").write_text(PLY)
    (folder / "scene.xml").write_text(
        f'<scene version="2.1.0"><bsdf type="itu-radio-material" id="skin"><string name="type" '
        f'value="{itu_type}"/></bsdf><shape type="ply" id="mesh-floor"><string name="filename" '
        f'value="{mesh}"/><ref id="skin" name="bsdf"/></shape></scene>'
    )
    return {"scenery/scene.xml": folder / "scene.xml", "scenery/floor.ply": folder / "floor.ply"}


def model(frequency: float = 28e9, **settings: Any) -> SionnaChannel:
    settings = {"samples": 500, "max_depth": 1, "bodies": 2, **settings}
    run = RunInfo(name="channel", carriers=(Carrier(name="c", frequency_hz=frequency),), devices=(RX,))
    return SionnaChannel(msgspec.convert(settings, SionnaSettings), run)


def prepared(assets: dict[str, Path] | None = None, **settings: Any) -> SionnaChannel:
    made = model(**settings)
    made.prepare(Preparation(demand={"channel": frozenset()}, assets=assets or {}))
    return made


def step(
    channel: SionnaChannel, names: tuple[str, ...], *devices: AntennaDevice, asset: str = ""
) -> StepResult:
    count = len(names)
    scene = Scene(
        names=names,
        classes=("car",) * count,
        assets=(asset,) * count,
        position=np.arange(3 * count, dtype=float).reshape(count, 3) * 10,
        orientation=np.tile([1.0, 0, 0, 0], (count, 1)),
        velocity=np.zeros((count, 3)),
        dimensions=np.tile([4.0, 2.0, 1.5], (count, 1)),
        devices=devices,
    )
    return channel.step(frame_of(scene))


def test_it_is_registered_and_says_its_rung() -> None:
    assert load("channel", "sionna-rt") is SionnaChannel
    assert model(diffraction=True, samples=77).options.diffraction
    assert model(samples=77).options.samples == 77
    assert model().rung == SionnaChannel.rung == "siso-rt"


@pytest.mark.parametrize("rung", ["siso-rt", "spherical", "mimo-rt"])
def test_a_rung_is_a_setting(rung: str) -> None:
    assert model(rung=rung).rung == rung


def test_an_unknown_rung_is_refused_by_name() -> None:
    with pytest.raises(msgspec.ValidationError, match="plane-waves"):
        model(rung="plane-waves")


@pytest.mark.parametrize(("spacing_deg", "rays"), [(1.0, 41_253), (0.25, 660_047), (57.29577951308232, 13)])
def test_ray_spacing_is_rays_on_the_sphere(spacing_deg: float, rays: int) -> None:
    """By hand: 4π sr are 41,253 square degrees."""
    assert model(samples=None, ray_spacing_deg=spacing_deg).options.samples == rays


def test_samples_and_ray_spacing_are_not_both_given() -> None:
    given = SionnaSettings(samples=1000, ray_spacing_deg=1.0)
    with pytest.raises(ScenarioError) as caught:
        SionnaChannel.check_settings(given, Place("settings"))
    for part in ("samples = 1000", "settings.ray_spacing_deg: is 1", "leave one out"):
        assert part in str(caught.value)


def test_without_either_there_are_100000_rays() -> None:
    assert model(samples=None).options.samples == 100_000


def test_an_unknown_setting_is_refused_by_name() -> None:
    with pytest.raises(msgspec.ValidationError, match="max_dept"):
        model(max_dept=3)


@pytest.mark.channel
class TestPreparing:
    """What is wrong with a scenario or its scenery comes out in `prepare`, as one message."""

    def test_the_notes_name_library_and_variant(self) -> None:
        notes = model().prepare(Preparation(demand={})).notes
        assert any("LLVM" in note or "cuda" in note for note in notes)
        assert any("variant" in note for note in notes)

    def test_progress_announces_compilation(self) -> None:
        told: list[tuple[str, float]] = []
        carriers = (Carrier(name="c", frequency_hz=1e9),)
        run = RunInfo(name="c", carriers=carriers, progress=lambda *phase: told.append(phase))
        SionnaChannel(SionnaSettings(samples=100, bodies=0), run).prepare(Preparation(demand={}))
        assert next(grace for phase, grace in told if phase == "compiling kernels") >= 30

    def test_a_material_outside_its_range_is_named_with_the_remedies(self, tmp_path: Path) -> None:
        with pytest.raises(ScenarioError) as caught:
            prepared(scenery(tmp_path, "brick"), frequency=60e9)
        assert str(caught.value) == (
            "services.channel.settings.outside_itu_range: material 'skin' (ITU brick) is defined for "
            "1–40 GHz, 110–330 GHz, the carrier is at 60 GHz; choose a carrier within, give it "
            "relative_permittivity and conductivity_s_per_m in services.channel.settings.materials.skin, "
            "or set outside_itu_range = "
            '"nearest" (constants of the nearest end) or "extrapolate" (power law of the nearest range)'
        )

    def test_bodies_outside_the_range_of_their_material_are_named_where_an_object_has_it(
        self, tmp_path: Path
    ) -> None:
        """Before the first frame where a mesh of the run is of it, else with the first such object."""
        named = r"'body_material' \(ITU metal\).*another body_material"
        (tmp_path / "car.ply").write_bytes(ply(unit_box()))
        with pytest.raises(ScenarioError, match=named):
            prepared({"objects/car.ply": tmp_path / "car.ply"}, frequency=140e9)
        boxes = prepared(frequency=140e9, object_materials={"van": "glass"})
        step(boxes, ())
        with pytest.raises(ScenarioError, match=named):
            step(boxes, ("a",))
        step(prepared(frequency=140e9, object_materials={"car": "glass"}), ("a",))

    def test_without_bodies_their_material_is_not_needed(self) -> None:
        prepared(frequency=140e9, bodies=0)

    @pytest.mark.parametrize(("itu_type", "frequency"), [("floorboard", 60e9), ("clear_acrylic", 140e9)])
    def test_materials_that_are_not_defined_at_3_5_ghz_can_be_loaded(
        self, tmp_path: Path, itu_type: str, frequency: float
    ) -> None:
        """Sionna RT evaluates materials at 3.5 GHz while it loads a scene."""
        prepared(scenery(tmp_path, itu_type), frequency=frequency, bodies=0)

    def test_a_material_that_nothing_is_made_of_is_not_needed(self, tmp_path: Path) -> None:
        assets = scenery(tmp_path, "concrete")
        spare = '<bsdf type="itu-radio-material" id="spare"><string name="type" value="brick"/></bsdf>'
        xml = assets["scenery/scene.xml"]
        xml.write_text(xml.read_text().replace("<shape", f"{spare}<shape"))
        prepared(assets, frequency=60e9)

    @pytest.mark.parametrize(
        "settings",
        [
            {"outside_itu_range": "nearest"},
            {"outside_itu_range": "extrapolate"},
            {"materials": {"skin": {"relative_permittivity": 4.0, "conductivity_s_per_m": 0.1}}},
        ],
    )
    def test_each_remedy_works(self, tmp_path: Path, settings: dict[str, Any]) -> None:
        prepared(scenery(tmp_path, "brick"), frequency=60e9, **settings)

    def test_the_end_of_a_range_belongs_to_it(self, tmp_path: Path) -> None:
        """Marble is defined up to 60 GHz, which float32 rounds up."""
        prepared(scenery(tmp_path, "marble"), frequency=60e9)

    def test_an_unknown_material_in_the_settings_is_named(self, tmp_path: Path) -> None:
        with pytest.raises(ScenarioError, match=r"no material 'skim'.*skin"):
            prepared(scenery(tmp_path, "brick"), materials={"skim": {"thickness_m": 0.2}})

    def test_an_unknown_body_material_is_named(self) -> None:
        with pytest.raises(ScenarioError, match=r"'aluminium'.*metal"):
            prepared(body_material="aluminium")

    def test_a_missing_mesh_is_named(self, tmp_path: Path) -> None:
        with pytest.raises(AssetError, match=r"absent\.ply"):
            prepared(scenery(tmp_path, "brick", mesh="absent.ply"))

    def test_a_broken_mesh_is_named(self, tmp_path: Path) -> None:
        assets = scenery(tmp_path, "brick")
        (tmp_path / "floor.ply").write_text("no mesh")
        with pytest.raises(AssetError, match=r"floor\.ply"):
            prepared(assets)

    @pytest.mark.parametrize("count", [-3, 4097, 1_000_000])
    def test_a_pool_has_the_limits_of_bodies(self, count: int) -> None:
        with pytest.raises(msgspec.ValidationError, match=r"Expected `int` .*\$\.pool"):
            model(pool={"box": count})

    def test_a_pool_for_a_mesh_that_is_not_there_is_named(self) -> None:
        with pytest.raises(ScenarioError, match=r"pool.lorry.*'lorry'"):
            prepared(pool={"lorry": 3})


@pytest.fixture(scope="module")
def channel() -> SionnaChannel:
    return prepared()


@pytest.mark.channel
class TestFrames:
    """What a frame may and may not hold."""

    @pytest.mark.parametrize("settings", [{"bodies": 0}, {"follow": 2}], ids=["none", "followed"])
    def test_objects_without_bodies_name_the_setting_where_none_are_made(self, settings: Any) -> None:
        """Where bodies are forbidden, and where what is followed is known by the bodies that there are."""
        text = r"^services\.channel\.settings\.bodies: object '.' .*the pool has \d; write a larger number$"
        with pytest.raises(PayloadError, match=text):
            step(prepared(**settings), ("a", "b", "c"))

    def test_an_asset_that_is_not_there_is_named(self, channel: SionnaChannel) -> None:
        with pytest.raises(PayloadError, match=r"'objects/tank\.ply'"):
            step(channel, ("a",), asset="objects/tank.ply")

    def test_an_object_named_like_scenery_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(PayloadError, match="'floor'"):
            step(prepared(scenery(tmp_path, "brick")), ("floor",))

    def test_an_antenna_in_the_middle_of_a_body_is_refused(self, channel: SionnaChannel) -> None:
        with pytest.raises(PayloadError, match=r"'a/rx'.*roof.*without_body"):
            step(channel, ("a",), AntennaDevice(name="a/rx", role="rx", parent="a"))

    def test_waves_pass_through_what_has_no_body(self) -> None:
        """The same antenna, once its class is listed."""
        ends = (
            AntennaDevice(name="a/rx", role="rx", parent="a"),
            AntennaDevice(name="t", role="tx", position=(9.0, 9, 9)),
        )
        channel = step(prepared(without_body=["car"]), ("a",), *ends).products["channel"]
        assert isinstance(channel, Channel)
        assert channel.los.all()

    @pytest.mark.parametrize("role", ["tx", "rx"])
    def test_a_frame_without_an_end_is_empty(self, channel: SionnaChannel, role: str) -> None:
        device = AntennaDevice(name="d", role=role, position=(0.0, 0, 5))  # type: ignore[arg-type]
        result = step(channel, ("a",), device)
        assert result.counts["paths"] == 0

    def test_a_device_of_both_roles_does_not_hear_itself(self, tmp_path: Path) -> None:
        """Not even its echo from the ground below."""
        device = AntennaDevice(name="d", role="both", position=(0.0, 0, 5))
        other = AntennaDevice(name="e", role="rx", position=(2.0, 3, 7))
        channel = step(prepared(scenery(tmp_path, "brick")), (), device, other).products["channel"]
        assert isinstance(channel, Channel)
        assert channel.rx == ("d", "e")
        assert channel.offsets.tolist() == [0, 0, 2]

    def test_without_line_of_sight_paths_the_flag_stays(self) -> None:
        ends = (
            AntennaDevice(name="r", role="rx", position=(30.0, 0, 5)),
            AntennaDevice(name="t", role="tx", position=(0.0, 0, 5)),
        )
        channel = step(prepared(los=False), (), *ends).products["channel"]
        assert isinstance(channel, Channel)
        assert channel.los.all()
        assert len(channel.tau) == 0

    def test_candidates_beyond_the_limit_are_counted(self, tmp_path: Path) -> None:
        """The limit is one of each pair: direct path and ground reflection are two candidates."""
        ends = (
            AntennaDevice(name="r", role="rx", position=(10.0, 0, 5)),
            AntennaDevice(name="s", role="rx", position=(-7.0, 0, 5)),
            AntennaDevice(name="t", role="tx", position=(0.0, 0, 5)),
        )
        enough = step(prepared(scenery(tmp_path, "brick"), max_paths=2), (), *ends)
        assert (enough.counts["paths"], enough.counts["path_limit_reached"]) == (4, 0)
        result = step(prepared(scenery(tmp_path, "brick"), max_paths=1), (), *ends)
        assert (result.counts["paths"], result.counts["path_limit_reached"]) == (2, 2)

    @pytest.mark.parametrize("below", ["concrete", "metal"])
    def test_the_upper_of_two_sheets_a_millimetre_apart_is_met(self, tmp_path: Path, below: str) -> None:
        """Whichever stands first in the file; two in one plane are warned of by name."""
        above = {"concrete": "metal", "metal": "concrete"}[below]
        ends = (
            AntennaDevice(name="r", role="rx", position=(10.0, 0, 5)),
            AntennaDevice(name="t", role="tx", position=(0.0, 0, 5)),
        )
        heard = []
        for sheets in ({below: 0.0, above: 0.001}, {above: 0.001, below: 0.0}, {above: 0.001}):
            channel = step(prepared(sheets_of(tmp_path, sheets)), (), *ends).products["channel"]
            assert isinstance(channel, Channel)
            heard.append(channel.a)
        np.testing.assert_array_equal(heard[0], heard[2])
        np.testing.assert_array_equal(heard[1], heard[2])
        made = model()
        assets = sheets_of(tmp_path, {below: 0.0, above: 0.0})
        notes = made.prepare(Preparation(demand={}, assets=assets)).notes
        assert any(f"{below!r}" in note and f"{above!r}" in note and "one plane" in note for note in notes)


def sheets_of(folder: Path, heights: dict[str, float]) -> dict[str, Path]:
    """A floor of each material at its height [m]."""
    (folder / "floor.ply").write_text(PLY)
    file = folder / "sheets.xml"
    file.write_text(
        '<scene version="2.1.0">'
        + "".join(
            f'<bsdf type="diffuse" id="itu_{m}"/><shape type="ply" id="{m}"><string name="filename" '
            f'value="floor.ply"/><ref id="itu_{m}" name="bsdf"/><transform name="to_world"><translate '
            f'z="{z}"/></transform></shape>'
            for m, z in heights.items()
        )
        + "</scene>"
    )
    return {"scenery/sheets.xml": file, "scenery/floor.ply": folder / "floor.ply"}
