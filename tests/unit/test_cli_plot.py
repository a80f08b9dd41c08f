"""`caviar plot`: which pictures a recording gives, and of which frame."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np
import pytest
import recording_builders
from recording_builders import channel, frame_of, lidar, link, record, scene
from typer.testing import CliRunner

from caviar_clients.cli.main import app
from caviar_clients.cli.plot import plot_run, scenery
from caviar_clients.plots.style import figure, legend_below, paper_style, saved_files
from caviar_protocol.errors import RecordingError, RunError
from caviar_protocol.recording import Recording

pytestmark = pytest.mark.slow

pytest.importorskip("matplotlib")


def full(folder: Path, frames: int = 4) -> Path:
    numbers = range(frames)
    return record(
        folder,
        [frame_of(n, scene=scene(n), channel=channel(n), link=link(n), lidar=lidar(n)) for n in numbers],
    )


@pytest.fixture
def maps_alone(monkeypatch):
    """Without the pictures of paths, which take as long again."""
    monkeypatch.setattr("caviar_clients.cli.plot.user_paths", lambda recording, user: None)


def test_all_pictures_go_into_the_run_directory(tmp_path):
    files = plot_run(full(tmp_path))
    assert [file.name for file in files] == [
        "map.png",
        "beams-over-time.png",
        "beams-over-angle.png",
        "dispersion.png",
        "frequency-response.png",
        "lidar.png",
    ]
    assert all(file.parent == tmp_path and file.stat().st_size > 5000 for file in files)


def test_figures_for_papers_are_as_wide_as_columns_with_their_fonts_and_numbers(tmp_path):
    made = []
    for folder in (tmp_path / "a", tmp_path / "b"):
        with paper_style(), figure(folder / "curve.png", 9.0, 6.0) as drawn:
            axes = drawn.subplots()
            axes.plot([0.0, 1.5], [2.0, np.nan], label="a long name of a curve, of 40 characters")
            axes.scatter([1.0], [2.0], c=[7.0])
            axes.pcolormesh([0.0, 2.0], [0.0, 4.0, 6.0], [[3.0], [5.0]])
            axes.set_title("of the caption")
            legend_below(drawn, axes)
        made.append({file.name: file.read_bytes() for file in folder.iterdir()})
    assert made[0] == made[1], "no dates"
    assert sorted(made[0]) == sorted(file.name for file in paper_files("curve"))
    for name, points in (("1col", 3.5 * 72), ("2col", 7.16 * 72)):
        pdf, svg = made[0][f"curve-{name}.pdf"], made[0][f"curve-{name}.svg"].decode()
        (width,) = re.findall(rb"/MediaBox \[ ?0 0 ([\d.]+) ", pdf)
        assert float(width) == pytest.approx(points, abs=0.01)
        assert b"/FontFile2" in pdf
        assert b"/Type3" not in pdf
        assert float(re.findall(r'width="([\d.]+)pt"', svg)[0]) == pytest.approx(points, abs=0.01)
        assert "<text" not in svg
    with (tmp_path / "a" / "curve.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert {row["panel"] for row in rows} == {"of the caption"}
    found = [(row["kind"], row["x"], row["y"], row["value"]) for row in rows]
    assert found == [
        ("line", "0.0", "2.0", ""),
        ("line", "1.5", "nan", ""),
        ("points", "1.0", "2.0", "7.0"),
        ("cells", "1.0", "2.0", "3.0"),
        ("cells", "1.0", "5.0", "5.0"),
    ]


def paper_files(stem):
    with paper_style():
        return saved_files(Path(f"{stem}.png"))


def test_a_run_is_drawn_for_papers(tmp_path):
    done = CliRunner().invoke(
        app, ["plot", str(record(tmp_path / "run")), "--style", "paper", "--out", str(tmp_path)]
    )
    assert done.exit_code == 0, done.output
    names = {file.name for file in tmp_path.iterdir()} - {"run"}
    pictures = ("map", "beams-over-time", "beams-over-angle")
    assert names == {file.name for stem in pictures for file in paper_files(stem)}
    assert {Path(line).name for line in done.output.split()} == names
    with (tmp_path / "beams-over-time.csv").open(encoding="utf-8") as stream:
        assert "optimum" in {row["label"].partition(",")[0] for row in csv.DictReader(stream)}
    assert paper_files("map") != saved_files(Path("map.png")), "of the block alone"


def test_what_was_not_recorded_is_not_drawn(tmp_path):
    files = plot_run(record(tmp_path / "run"), tmp_path / "pictures")
    assert [file.name for file in files] == ["map.png", "beams-over-time.png", "beams-over-angle.png"]
    assert all(file.is_file() for file in files)


@pytest.mark.usefixtures("maps_alone")
def test_another_frame_gives_another_map(tmp_path):
    run = record(tmp_path / "run")
    first = plot_run(run, tmp_path / "a", frame=0)[0].read_bytes()
    assert plot_run(run, tmp_path / "b", frame=0)[0].read_bytes() == first
    assert plot_run(run, tmp_path / "c", frame=3)[0].read_bytes() != first


@pytest.mark.usefixtures("maps_alone")
def test_by_default_the_map_shows_the_middle_of_the_frames_with_line_of_sight(tmp_path):
    run = record(tmp_path / "run", frames=6)  # the sample is NLOS in frames 0 and 5
    chosen = plot_run(run, tmp_path / "a")[0].read_bytes()
    assert plot_run(run, tmp_path / "b", frame=3)[0].read_bytes() == chosen


def test_boxes_that_block_a_drawn_channel_are_on_the_map(tmp_path, monkeypatch):
    """They are in no scene, but in the settings of the channel that is recorded with the run."""
    assert scenery(Recording(record(tmp_path / "without"))) is None
    box = {"minimum_m": [20.0, 20.0, 0.0], "maximum_m": [35.0, 30.0, 25.0]}
    drawn_channel = {"role": "channel", "use": "geometric", "settings": {"obstacles": [box]}}
    services = {"channel": drawn_channel, "link": {"role": "link", "use": "beams"}}
    monkeypatch.setattr(recording_builders, "SCENARIO", recording_builders.SCENARIO | {"services": services})
    drawn = scenery(Recording(record(tmp_path / "with")))
    assert drawn is not None
    assert drawn.faces.min(axis=(0, 1)).tolist() == [20.0, 20.0]
    assert drawn.faces.max(axis=(0, 1)).tolist() == [35.0, 30.0]


def test_a_frame_or_user_that_is_not_there_is_refused(tmp_path):
    run = full(tmp_path / "run")
    with pytest.raises(RecordingError, match="no frame 99 of episode 0"):
        plot_run(run, tmp_path, frame=99)
    with pytest.raises(RecordingError, match="no user is named 'bike'"):
        plot_run(run, tmp_path, user="bike")


@pytest.mark.parametrize("name", ["x.png", "x.PDF"])
def test_a_file_is_no_folder_for_several_pictures(tmp_path, name):
    """A folder called x.png was made, and its picture could not be opened."""
    run = record(tmp_path / "run")
    with pytest.raises(RunError, match=rf"--out .*{name}: several pictures are written; .* --out .*/x$"):
        plot_run(run, tmp_path / name)
    assert not (tmp_path / name).exists()


@pytest.mark.usefixtures("maps_alone")
@pytest.mark.parametrize("name", ["run-2.5", "old.png"])
def test_a_folder_may_have_any_name(tmp_path, name):
    (tmp_path / "old.png").mkdir()
    run = record(tmp_path / "run")
    assert plot_run(run, tmp_path / name)[0] == tmp_path / name / "map.png"


def test_an_empty_recording_has_nothing_to_draw(tmp_path):
    with pytest.raises(RecordingError, match="holds nothing to draw"):
        plot_run(record(tmp_path, frames=0))


@pytest.mark.usefixtures("maps_alone")
def test_of_a_run_without_users_the_map_is_drawn(tmp_path):
    made = recording_builders.recorder(tmp_path / "run")
    for number in range(2):
        items = (
            recording_builders.product("scene", "world", recording_builders.scene(number, 1), number),
            recording_builders.product("link", "link", recording_builders.link(number, 0), number),
        )
        made.step(recording_builders.frame(number, *items))
    made.close()
    assert [file.name for file in plot_run(tmp_path / "run", tmp_path / "out")] == ["map.png"]
