"""`caviar plot map`: what is asked for, what is drawn, and what the arrays say."""

from __future__ import annotations

import dataclasses
import json
import struct
import sys
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from recording_builders import record, scene
from rich.console import Console

from caviar_clients.cli import main as command
from caviar_clients.cli import radio_map as radio_map_command
from caviar_clients.cli.radio_map import (
    ARRAYS,
    MapOptions,
    channel_of,
    draw_radio_map,
    noise_of,
    surface_of,
)
from caviar_clients.plots.map import RadioMapView, colour_limits, draw_servers, draw_values
from caviar_clients.session.plausibility import in_hertz
from caviar_clients.session.scenes import scene_at
from caviar_protocol.errors import RecordingError, RunError, ScenarioError
from caviar_protocol.scenario import ServiceSpec
from caviar_protocol.topics import Carrier
from caviar_services.channel.radio_map import transmitters_of
from caviar_space.meshes import Mesh, box, ply

pytestmark = pytest.mark.slow

pytest.importorskip("matplotlib")


def view() -> RadioMapView:
    return RadioMapView(
        area=(0.0, 0.0, 30.0, 20.0),
        transmitters=("west", "east"),
        positions=np.array([[5.0, 5.0], [25.0, 15.0]]),
        scene=scene(0),
        footprints=None,
        title="a map",
    )


def pixels(file: Path) -> tuple[int, int]:
    """Width and height of a PNG."""
    content = file.read_bytes()
    assert content[:8] == b"\x89PNG\r\n\x1a\n"
    width, height = struct.unpack(">II", content[16:24])
    return width, height


def test_pictures_of_values_and_of_servers(tmp_path: Path) -> None:
    values = np.array([[-80.0, -90.0, np.nan], [-100.0, np.nan, -70.0]])
    draw_values(view(), values, "Path gain [dB]", tmp_path / "new" / "gain.png")
    draw_values(view(), np.full((2, 3), np.nan), "Path gain [dB]", tmp_path / "empty.png")
    draw_servers(view(), np.array([[0, 1, -1], [1, 0, 0]], np.int32), tmp_path / "server.png")
    drawn = [tmp_path / name for name in ("new/gain.png", "empty.png", "server.png")]
    assert all(min(pixels(file)) > 400 for file in drawn)
    assert len({file.read_bytes() for file in drawn}) == 3


def test_the_colour_bar_leaves_out_what_is_rare() -> None:
    assert colour_limits(np.array([])) == (0.0, 1.0, "neither")
    assert colour_limits(np.array([-90.0, -90.0])) == (-90.5, -89.5, "neither")
    low, high, ends = colour_limits(np.concatenate([np.linspace(-120, -60, 10_000), [-300.0, 0.0]]))
    assert (low, high) == (pytest.approx(-119.4, abs=0.1), pytest.approx(-60, abs=0.1))
    assert ends == "both"
    low, high, ends = colour_limits(np.linspace(-250, -50, 1000))
    assert high - low == pytest.approx(100.0)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--metric", "gian"), "--metric 'gian' does not exist; did you mean 'gain'?"),
        (("--cell", "0"), "--cell 0: write the side of a cell in metres, above 0"),
        (("--height", "nan"), "--height nan: write a height in metres"),
        (("--height", "1e300"), "--height 1e+300: write a height in metres, at most 1,000,000"),
        (("--cell", "1e300"), "--cell 1e+300: write the side of a cell in metres"),
        (("--memory-gib", "inf"), "--memory-gib inf: write GiB, above 0"),
        (("--beam", "7" * 5000), "write best, wide, or the number"),
        (("--area", "0", "0", "0", "1"), "--area 0 0 0 1: write lowest x and y"),
        (("--beam", "widest"), "--beam 'widest': write best, wide, or the number"),
        (("--out", "map.jpg"), "--out map.jpg: a radio map is a PNG"),
        (("--frame", "400"), "--frame 400: scenario 'smoke' has the frames 0 to"),
        (("--carrier", "mmwav"), "--carrier 'mmwav' does not exist; did you mean 'mmwave'?"),
    ],
)
def test_a_mistake_is_named_and_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], options, words
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["caviar", "plot", "map", "smoke", *options])
    with pytest.raises(SystemExit) as ended:
        command.main()
    assert ended.value.code == 1
    assert words in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_scene_without_a_transmitter_is_refused() -> None:
    """It may be mounted on an object that is not there yet."""
    with pytest.raises(RunError, match="frame 7 has no transmitter on carrier"):
        transmitters_of(msgspec.structs.replace(scene(0), devices=()), "frame 7", "mm")


def test_a_run_without_a_channel_is_refused() -> None:
    scenes = dataclasses.replace(scene_at(Path("smoke")), services={})
    with pytest.raises(RunError, match=r"smoke.*no channel.*sionna"):
        channel_of(scenes, scenes.instants[0].scene)


def test_a_channel_that_traces_no_rays_is_refused_and_leaves_nothing_behind(tmp_path: Path) -> None:
    shipped = Path(__file__).parents[2] / "deploy" / "caviar_scenarios" / "smoke.toml"
    text = shipped.read_text()
    assert 'use = "free-space"' in text
    (tmp_path / "mine.toml").write_text(text.replace('use = "free-space"', 'use = "geometric"'))
    with pytest.raises(RunError, match="'channel' is 'geometric'"):
        draw_radio_map(tmp_path / "mine.toml", tmp_path / "map.png", MapOptions(), Console())
    assert [file.name for file in tmp_path.iterdir()] == ["mine.toml"]


def test_a_channel_with_foliage_is_refused(tmp_path: Path) -> None:
    """The map would show the places behind it as if it were not there."""
    shipped = Path(__file__).parents[2] / "deploy" / "caviar_scenarios" / "smoke.toml"
    traced = shipped.read_text().replace('use = "free-space"', 'use = "sionna-rt"')
    file = tmp_path / "mine.toml"
    file.write_text(f"{traced}\n[services.channel.settings.foliage.hedge]\n")
    scenes = scene_at(file)
    with pytest.raises(ScenarioError, match="volumes that attenuate") as refused:
        channel_of(scenes, scenes.instants[0].scene)
    assert refused.value.key == "services.channel.settings.foliage"


def test_a_recorded_instant_is_found_and_a_missing_one_is_named(tmp_path: Path) -> None:
    run = record(tmp_path / "run", frames=3)
    with pytest.raises(RecordingError, match="no frame 3 of episode 0"):
        scene_at(run, 3)


def test_noise_is_that_of_the_link() -> None:
    carrier = Carrier(name="c", frequency_hz=28e9, bandwidth_hz=100e6)
    link = ServiceSpec(role="link", use="beams", budget_ms=1, settings={"noise_figure_db": 5.0})
    power, origin = noise_of({"mine": link}, carrier)
    assert power == pytest.approx(1.380649e-23 * 290 * 100e6 * 10**0.5)
    assert origin == "100 MHz, noise figure 5 dB and 290 K of link 'mine'"
    power, origin = noise_of({}, carrier)
    assert power == pytest.approx(1.380649e-23 * 290 * 100e6 * 10**0.9)
    assert origin.endswith("by default")
    assert [in_hertz(f) for f in (28e9, 100e6, 15e3, 10.0)] == ["28 GHz", "100 MHz", "15 kHz", "10 Hz"]


@pytest.mark.channel
def test_a_scenario_gives_pictures_and_arrays_that_agree(tmp_path: Path) -> None:
    """`smoke` in free space: the arrays have the axes, the units and the numbers that they promise."""
    area = (-50.0, -40.0, 50.0, 40.0)
    metrics = ("gain", "best-server")
    options = MapOptions(metrics=metrics, cell=20.0, area=area, beam="wide", samples=20_000, frame=2)
    files = draw_radio_map(Path("smoke"), tmp_path / "out" / "smoke.png", options, Console(quiet=True))
    assert [file.name for file in files] == ["smoke-gain.png", "smoke-best-server.png", "smoke.npz"]
    arrays = np.load(files[-1], allow_pickle=False)
    about = json.loads(str(arrays["metadata"]))
    assert set(arrays.files) == {*ARRAYS, "metadata"}
    sizes = {"x": 5, "y": 4, "transmitter": 1, "xyz": 3}
    for name, described in about["arrays"].items():
        assert arrays[name].shape == tuple(sizes[axis] for axis in described["axes"]), name
    assert (about["frame"], about["t_ns"], about["carrier"]) == (2, 200_000_000, "mmwave")
    assert arrays["x"].tolist() == [-40.0, -20.0, 0.0, 20.0, 40.0]
    x, y = np.meshgrid(arrays["x"], arrays["y"])
    distance = np.linalg.norm(np.stack([x, y, arrays["z"]], -1) - arrays["position"][0], axis=-1)
    friis = 20 * np.log10(299_792_458.0 / about["frequency_hz"] / (4 * np.pi * distance))
    far = distance > 30
    np.testing.assert_allclose(arrays["gain"][0][far], friis[far], atol=1.0)
    np.testing.assert_allclose(arrays["rss"] - arrays["gain"], arrays["power"][0], atol=1e-4)
    noise = 10 * np.log10(about["noise_w"]) + 30
    np.testing.assert_allclose(arrays["sinr"], arrays["rss"] - noise, atol=1e-4)


PATTERN = "theta_deg,phi_deg,gain_dbi\n0,0,-3\n90,0,-3\n180,0,-3\n0,180,-3\n90,180,-3\n180,180,-3\n"


def with_pattern(folder: Path, *changes: tuple[str, str]) -> Path:
    """`smoke` whose base station has elements of a file."""
    (folder / "flat.csv").write_text(PATTERN)
    text = (Path(__file__).parents[2] / "deploy" / "caviar_scenarios" / "smoke.toml").read_text()
    for old, new in (("array = { rows = 4, columns = 8 }", 'array.pattern_file = "file:flat.csv"'), *changes):
        assert old in text
        text = text.replace(old, new)
    (folder / "mine.toml").write_text(text)
    return folder / "mine.toml"


@pytest.mark.channel
def test_elements_of_a_pattern_file_radiate(tmp_path: Path) -> None:
    """3 dB less than an isotropic element towards everywhere."""
    options = MapOptions(cell=20.0, area=(-50.0, -40.0, 50.0, 40.0), beam="wide", samples=20_000)
    files = draw_radio_map(with_pattern(tmp_path), tmp_path / "m.png", options, Console(quiet=True))
    arrays = np.load(files[-1], allow_pickle=False)
    about = json.loads(str(arrays["metadata"]))
    x, y = np.meshgrid(arrays["x"], arrays["y"])
    distance = np.linalg.norm(np.stack([x, y, arrays["z"]], -1) - arrays["position"][0], axis=-1)
    friis = 20 * np.log10(299_792_458.0 / about["frequency_hz"] / (4 * np.pi * distance)) - 3
    far = distance > 30
    np.testing.assert_allclose(arrays["gain"][0][far], friis[far], atol=1.0)


class _Scenery:
    """What `surface_of` asks a channel for."""

    has_scenery = True
    low, high = np.array([0.0, 0.0, 0.0]), np.array([100.0, 50.0, 30.0])


def _surface(tmp_path: Path, **wanted: object) -> tuple[str, ...]:
    """Notes about the cells over a slope from 0 to 30 m, 100 m long and 50 m wide."""
    (tmp_path / "slope.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
        "0 0 0\n100 0 30\n100 50 30\n0 50 0\n3 0 1 2\n3 0 2 3\n"
    )
    (tmp_path / "a.xml").write_text(
        '<scene version="2.1.0"><shape type="ply" id="mesh-slope">'
        '<string name="filename" value="slope.ply"/></shape></scene>'
    )
    channel = SimpleNamespace(scene=_Scenery())
    _, _, notes = surface_of(channel, scene(0), tmp_path / "a.xml", MapOptions(**wanted))  # type: ignore[arg-type]
    return notes


def test_what_is_unusual_about_the_cells_is_said(tmp_path: Path) -> None:
    rising, buried = _surface(tmp_path, cell=1.0, height=15.0)
    assert rising == "the ground rises by 30 m, --surface ground follows it"
    assert buried == "50.0% of the cells are below what is taken as ground"
    beside = _surface(tmp_path, area=(1000.0, 1000.0, 1100.0, 1100.0))[0]
    assert beside == ("warning: the area is beside the scenery, which reaches x 0 to 100 m, y 0 to 50 m")


def test_a_plane_is_above_the_top_of_a_slab_and_the_lowest_sheet(tmp_path: Path) -> None:
    """A slab with its top at 3 m; then a sheet at 2 m beside it, which faces down."""
    slab = box((0.0, 100.0), (0.0, 50.0), (2.5, 3.0))
    sheet = Mesh(
        np.array([[100.0, 0.0, 2.0], [100.0, 50.0, 2.0], [200.0, 0.0, 2.0]]), np.array([[0, 1, 2]], np.int32)
    )
    for meshes, lowest in (((slab,), 3.0), ((slab, sheet), 2.0)):
        for number, mesh in enumerate(meshes):
            (tmp_path / f"{number}.ply").write_bytes(ply(mesh))
        shapes = (
            f'<shape type="ply" id="mesh-{number}"><string name="filename" value="{number}.ply"/></shape>'
            for number in range(len(meshes))
        )
        (tmp_path / "a.xml").write_text(f'<scene version="2.1.0">{"".join(shapes)}</scene>')
        channel: Any = SimpleNamespace(scene=_Scenery())
        surface, _, _ = surface_of(channel, scene(0), tmp_path / "a.xml", MapOptions(height=1.5))
        assert np.unique(surface.z).tolist() == [lowest + 1.5]


@pytest.mark.parametrize(
    ("wanted", "words"),
    [
        (
            {"cell": 0.001},
            r"--cell 0.001 makes 5e\+09 cells, at most 20,000,000 can be; take cells of 0.016 m",
        ),
        ({"cell": 1e-320}, "at most 20,000,000 can be; take cells of 0.016 m or a smaller --area"),
        ({"area": (-1e308, -1e308, 1e308, 1e308)}, "is inf × inf m; take a smaller one"),
        ({"surface": "roof"}, "--surface 'roof' does not exist; write plane, ground or .* scenery: slope"),
        ({"surface": "slop"}, "did you mean 'slope'"),
    ],
)
def test_cells_that_cannot_be_are_refused_with_those_that_can(tmp_path: Path, wanted, words: str) -> None:
    with pytest.raises(RunError, match=words):
        _surface(tmp_path, **wanted)


@pytest.mark.parametrize(
    ("name", "words"),
    [("", r"is a folder; write .*, as .*/radio-map.png"), ("map.jpg", "write a name that ends in .png")],
)
def test_a_map_goes_into_a_png(tmp_path: Path, name: str, words: str) -> None:
    with pytest.raises(RunError, match=words):
        draw_radio_map(Path("smoke"), tmp_path / name, MapOptions(beam="wide"), Console())


def test_a_power_in_another_unit_is_warned_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As before a run; the map itself is made."""
    screen = StringIO()
    monkeypatch.setattr(radio_map_command, "_mapped", lambda *_: (_ for _ in ()).throw(RunError("enough")))
    source = with_pattern(tmp_path, ("power_dbm = 30.0", "power_dbm = 150.0"))
    with pytest.raises(RunError, match="enough"):
        draw_radio_map(source, tmp_path / "m.png", MapOptions(beam="wide"), Console(file=screen))
    assert "power_dbm: is 150 dBm, beyond any transmitter's" in screen.getvalue()
