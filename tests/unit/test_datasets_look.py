"""The page of a dataset (``caviar dataset look``)."""

from __future__ import annotations

import re
import shutil
import sqlite3
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from caviar_clients.cli.datasets import _remove
from caviar_clients.cli.main import app
from caviar_clients.datasets.catalogue import Catalogue
from caviar_clients.datasets.directory import DatasetDirectory, writing_dataset
from caviar_clients.datasets.episode import EpisodeTask, play_episode
from caviar_clients.datasets.look import data as look_data
from caviar_clients.datasets.look import figures, maps
from caviar_clients.datasets.look import page as look_page
from caviar_clients.datasets.look.data import Scan, UserColumns, read_throughput, read_users
from caviar_clients.datasets.look.figures import draw_beams, picture
from caviar_clients.datasets.look.maps import cell_m, draw_gain, draw_scans, map_of, scans_height
from caviar_clients.datasets.look.page import write_page
from caviar_clients.datasets.plan import plan_dataset
from caviar_clients.datasets.reader import Dataset
from caviar_clients.datasets.shares import UserCounts, count_users, paper_counts
from caviar_protocol.errors import RecordingError, SetupError
from caviar_protocol.run_directory import RunDirectory
from caviar_protocol.scenario import load_scenario

pytest.importorskip("matplotlib", reason="pictures need Matplotlib: extra plot")

pytestmark = pytest.mark.slow

SECTIONS = (
    "dataset", "coverage", "sight", "gain", "angles", "beams", "correlation", "lidar", "cameras",
    "generation",
)  # fmt: skip


def make(out: Path, episodes: int, scenes: int, file: Path | None = None) -> Path:
    directory = DatasetDirectory(out)
    scenario = load_scenario(file or "smoke")
    plan = plan_dataset(scenario, episodes=episodes, scenes=scenes)
    with writing_dataset(directory):
        catalogue = Catalogue(directory.catalogue, writable=True)
        catalogue.plan(plan.settings(), episodes)
        for number in range(episodes):
            result = play_episode(EpisodeTask(plan.scenario, number, str(out)))
            assert result.rows is not None, result.error
            catalogue.add(result.rows, result.measured)
        catalogue.close()
    return out


class Page(HTMLParser):
    """What a page names, and the text of each section."""

    def __init__(self, file: Path) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.alts: list[str | None] = []
        self.texts: dict[str, str] = {}
        self.pictures: dict[str, int] = {}
        self.tags: list[str] = []
        self._section = ""
        self.feed(file.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self.tags.append(tag)
        self.addresses += [found[key] or "" for key in ("src", "href", "srcset") if key in found]
        if tag == "img":
            self.alts.append(found.get("alt"))
            self.pictures[self._section] = self.pictures.get(self._section, 0) + 1
        if tag == "section":
            self._section = found["id"] or ""

    def handle_data(self, data: str) -> None:
        self.texts[self._section] = self.texts.get(self._section, "") + data


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("dataset"), 3, 4)


@pytest.fixture(scope="module")
def page(folder: Path) -> Page:
    return Page(write_page(folder))


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures are one pixel each: the texts of a page are looked at."""
    header = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + (1).to_bytes(4) * 2
    monkeypatch.setattr(figures, "_png", lambda *_: header)


def test_a_page_has_every_section_that_its_recordings_allow(page: Page) -> None:
    assert [name for name in page.texts if name] == list(SECTIONS)
    assert page.pictures == {
        "coverage": 2, "sight": 2, "gain": 1, "angles": 1, "beams": 1, "correlation": 1, "generation": 2,
    }  # fmt: skip
    assert page.texts["lidar"].strip().endswith("No LIDAR is recorded.")
    assert page.texts["cameras"].strip().endswith("No camera is recorded.")
    assert "delay spread of all users is 0" in page.texts["gain"]
    assert re.search(r"smoke.*3.*12, 4 in each episode.*24: a receiver", page.texts["dataset"], re.DOTALL)
    assert "100.0 %" in page.texts["sight"]
    assert "3 recorded episodes (12 scenes)" in page.texts["angles"]
    assert "0.3 s apart" in page.texts["correlation"]
    assert "No episode failed." in page.texts["generation"]


def test_a_page_is_one_file_with_nothing_from_elsewhere(folder: Path, page: Page) -> None:
    assert page.addresses
    assert [a for a in page.addresses if not a.startswith(("data:", "#"))] == []
    assert {a[1:] for a in page.addresses if a.startswith("#")} == set(SECTIONS)
    text = (folder / "look.html").read_text()
    assert "<script" not in text
    assert "http://" not in text
    assert "https://" not in text
    assert str(folder) not in text  # no path of this machine
    assert page.tags.count("h1") == page.tags.count("title") == 1
    assert [path.name for path in folder.glob("look*")] == ["look.html"]


def test_every_picture_has_an_alternative_text_and_a_dark_form(page: Page) -> None:
    assert all(alt and len(alt) > 30 for alt in page.alts)
    assert page.tags.count("source") == len(page.alts) == 10


def test_a_dataset_of_scenes_alone_says_what_is_missing(tmp_path: Path) -> None:
    file = tmp_path / "scenes.toml"
    file.write_text(SCENES_ALONE)
    page = Page(write_page(make(tmp_path / "d", 1, 1, file), tmp_path / "out" / "page.html"))
    assert page.pictures == {"generation": 2}
    for name, words in {
        "coverage": "No channel is recorded",
        "sight": "No channel is recorded",
        "gain": "No channel is recorded",
        "angles": "No channel is recorded",
        "beams": "No link is recorded",
        "correlation": "No channel is recorded",
        "lidar": "No LIDAR is recorded",
    }.items():
        assert words in page.texts[name], name


@pytest.mark.usefixtures("undrawn")
def test_shares_of_users_stand_beside_those_of_the_paper(
    tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(folder, tmp_path / "d")
    with sqlite3.connect(tmp_path / "d" / "catalogue.sqlite") as base:
        base.execute("UPDATE users SET los = 0 WHERE episode = 1")
    users = Dataset(tmp_path / "d").users()
    los = int((users["los"] & users["valid"]).sum())
    counts = count_users(Dataset(tmp_path / "d"))
    assert counts == UserCounts(len(users), int(users["valid"].sum()), los)
    assert 0 < los < counts.valid
    monkeypatch.setattr(
        look_page, "paper_counts", lambda name: paper_counts("s001") if name == "smoke" else ""
    )
    text = Page(write_page(tmp_path / "d")).texts["sight"]
    assert f"{counts}. s001 of the paper: 58,000 users, 41,000 valid (71 %)." in text


@pytest.mark.usefixtures("undrawn")
def test_a_channel_without_link_has_paths_and_no_beams(tmp_path: Path) -> None:
    text = Path(load_scenario("smoke").source.file).read_text()
    kept = re.sub(r"(?ms)^\[services\.(agent|link)\]\n.*?(?=^\[|\Z)", "", text)
    kept = re.sub(r"(?m)^record = .*$", 'record = ["scene", "channel"]', kept)
    kept = re.sub(r"(?m)^bandwidth_hz = .*\n", "", kept)
    file = tmp_path / "channel.toml"
    file.write_text(kept)
    page = Page(write_page(make(tmp_path / "d", 2, 1, file)))
    assert "No link is recorded" in page.texts["beams"]
    assert "Episodes have one scene" in page.texts["correlation"]
    assert "100 MHz" in page.texts["dataset"]
    assert page.pictures["coverage"] == 2


def test_scans_are_drawn_as_points_or_as_a_grid() -> None:
    points, none = np.random.default_rng(1).normal(size=(50, 3)), np.zeros((0, 4, 2))
    scan = Scan("car/top", points, None, (0.0, 0.0), none)
    cells = np.zeros((4, 5))
    cells[1, 2], cells[0, 0] = 1, -2
    grid = Scan("car/top", points[:0], (cells, (0.0, 5.0, 0.0, 4.0)), (2.0, 2.0), none)
    street = Scan("bus/top", points[:0], (np.zeros((2, 20)), (0.0, 20.0, 0.0, 2.0)), (2.0, 2.0), none)
    assert scans_height([street] * 3) > scans_height([street])
    for scans in ([scan], [scan, grid], [street, street]):
        shown = picture(draw_scans(scans), scans_height(scans), map_like=True)
        assert shown.light.startswith("data:image/png;base64,")
        assert shown.light != shown.dark
        assert 300 < shown.width < 1000


def users_at(x: list[float], gain_db: list[float]) -> UserColumns:
    places, gains, some = np.array(x), np.array(gain_db), np.ones(len(x), dtype=int)
    has = np.isfinite(gains)
    return UserColumns((("c", "bs"),), places, 0 * places, has, has, some, gains, gains, some, some, 0 * some)


def test_receivers_that_stand_still_are_one_dot_with_the_median() -> None:
    users = users_at([5.0, 5.0, 5.0, 9.0, 9.0], [-90.0, -80.0, np.nan, np.nan, np.nan])
    place = map_of(users, None, {(0.0, 0.0)})
    np.testing.assert_allclose(place.dots, [[5.0, 0.0, -85.0], [9.0, 0.0, np.nan]])
    (left, right), _ = place.view
    assert right - left >= 40.0


def test_many_places_are_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(maps, "DOTS", 2)
    users = users_at([0.0, 1.0, 30.0, 60.0], [-90.0, -80.0, np.nan, -70.0])
    place = map_of(users, None, set())
    assert place.dots is None
    assert cell_m(place) == 1.0
    assert picture(draw_gain(users, place), 4.0, map_like=True).light.startswith("data:image/png")


def test_users_are_read_in_parts(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data, told = Dataset(folder), list[tuple[str, int, int]]()
    catalogue = Catalogue(DatasetDirectory(folder).catalogue)
    monkeypatch.setattr(look_data, "_ROWS_AT_ONCE", 1)
    users = read_users(catalogue, lambda *how: told.append(how))
    assert [done for _, done, _ in told] == [1, 2, 3]
    table = data.table("users")
    np.testing.assert_array_equal(users.gain_db, table["gain_db"])
    np.testing.assert_array_equal(users.tx_beam, table["tx_beam"])
    assert [users.groups[group] for group in users.group] == list(
        zip(table["carrier"], table["tx"], strict=True)
    )


@pytest.mark.usefixtures("undrawn")
def test_a_sample_of_many_episodes_is_stated(
    folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(look_data, "SAMPLE_EPISODES", 2)
    page = Page(write_page(folder, tmp_path / "page.html"))
    assert "2 of the 3 recorded episodes, drawn with seed 0 (8 scenes)" in page.texts["angles"]


def test_throughput_leaves_interruptions_out_and_adds_workers_up(tmp_path: Path) -> None:
    catalogue = Catalogue(tmp_path / "catalogue.sqlite", writable=True)
    starts = ("00:00:00", "00:00:00", "00:00:10", "05:00:00")
    for number, start in enumerate(starts):
        catalogue._connection.execute("INSERT INTO episodes VALUES (?, 20, 1, '', 1, '')", (number,))
        catalogue._connection.execute(
            "INSERT INTO timings VALUES (?, ?, 'a', ?, 10.0, 9.0, ?)",
            (number, f"2026-11-24T{start}+00:00", number % 2, '{"services_s": {"channel": 4.0}}'),
        )
    found = read_throughput(catalogue)
    assert found is not None
    assert found.elapsed_s == pytest.approx(30.0)
    assert found.interruptions_s == pytest.approx((20.0,))
    assert found.services_s == {"channel": 16.0}
    assert (found.busy_s, found.processes, found.hosts) == (40.0, 2, 1)
    width = float(np.diff(found.edges_s)[0])
    assert found.rate.sum() * width == pytest.approx(80.0)
    assert found.rate[0] == pytest.approx(4.0)
    assert found.rate[-1] == pytest.approx(2.0)


@pytest.fixture
def copy(folder: Path, tmp_path: Path) -> Path:
    """Of the dataset, without its page."""
    shutil.copytree(folder, tmp_path / "d", ignore=shutil.ignore_patterns("look.html"))
    return tmp_path / "d"


@pytest.mark.usefixtures("undrawn")
def test_failures_are_listed(copy: Path) -> None:
    catalogue = Catalogue(DatasetDirectory(copy).catalogue, writable=True)
    catalogue.add_failure(7, "2026-11-24T00:00:00", "the <world> ended", "host")
    catalogue.close()
    page = Page(write_page(copy))
    assert "1 episode failed" in page.texts["generation"]
    assert "the <world> ended" in page.texts["generation"]


@pytest.mark.usefixtures("undrawn")
def test_a_catalogue_without_recordings_has_its_tables_on_the_page(folder: Path, tmp_path: Path) -> None:
    shutil.copy(folder / "catalogue.sqlite", tmp_path)
    page = Page(write_page(tmp_path))
    assert "recordings of 3 episodes are not in the folder" in page.texts["dataset"]
    assert page.pictures == {"coverage": 2, "sight": 2, "gain": 1, "beams": 1, "generation": 2}
    assert "No recording in the folder can be read" in page.texts["correlation"]


def test_a_dataset_without_an_episode_says_so(tmp_path: Path) -> None:
    out = make(tmp_path / "d", 0, 1)
    catalogue = Catalogue(DatasetDirectory(out).catalogue, writable=True)
    catalogue.add_failure(0, "2026-11-24T00:00:00", "no <world>", "host")
    catalogue.close()
    page = Page(write_page(out))
    assert page.pictures == {}
    assert all("No episode is there yet." in page.texts[name] for name in SECTIONS[1:-1])
    assert "no <world>" in page.texts["generation"]
    assert "smoke" in page.texts["dataset"]


def damaged(folder: Path, *episodes: int) -> None:
    """Flip a bit of each of these recordings."""
    for number in episodes:
        file = RunDirectory(DatasetDirectory(folder).episode(number)).segment(0)
        content = bytearray(file.read_bytes())
        content[len(content) // 2] ^= 4
        file.write_bytes(content)


@pytest.mark.usefixtures("undrawn")
def test_a_damaged_recording_is_left_out_and_named(copy: Path) -> None:
    damaged(copy, 1)
    notes: list[str] = []
    page = Page(write_page(copy, note=notes.append))
    assert len(notes) == 1
    assert notes[0].startswith("left out: 1 of 3 recordings that cannot be read, the first of episode 1: ")
    assert "1 recording of the sample cannot be read, and is left out" in page.texts["dataset"]
    assert "the generate command plays it again" in page.texts["dataset"]
    assert re.search(r"why1.*recording-0000\.mcap", page.texts["dataset"], re.DOTALL)
    assert "2 of the 3 recorded episodes, drawn with seed 0 (8 scenes)" in page.texts["angles"]


@pytest.mark.usefixtures("undrawn")
def test_a_dataset_of_damaged_recordings_alone_has_its_tables_on_the_page(copy: Path) -> None:
    damaged(copy, 0, 1, 2)
    page = Page(write_page(copy))
    assert "3 recordings of the sample cannot be read, and are left out" in page.texts["dataset"]
    assert "No recording in the folder can be read" in page.texts["correlation"]
    assert page.pictures == {"coverage": 2, "sight": 2, "gain": 1, "beams": 1, "generation": 2}


def edit(folder: Path, sql: str) -> None:
    with sqlite3.connect(DatasetDirectory(folder).catalogue) as connection:
        assert connection.execute(sql).rowcount > 0


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    ("sql", "said"),
    [
        (
            "UPDATE users SET gain_db = 9e999 WHERE episode = 1 AND scene = 2 AND rx = 'car/rx'",
            "users.gain_db of episode 1, scene 2, user car/rx is inf, not a number within",
        ),
        ("UPDATE users SET x_m = 1e300", "users.x_m of episode 0, scene 0"),
        ("UPDATE users SET paths = -1", "users.paths of episode 0, scene 0"),
        ("UPDATE scenes SET users = -5", "scenes.users of episode 0, scene 0 is -5"),
        ("UPDATE timings SET started = 'x'", "timings.started is 'x'"),
        ("UPDATE timings SET detail = '[]'", "timings.detail is '[]'"),
        ("UPDATE dataset SET value = '{'", "settings in table dataset"),
        (
            "UPDATE dataset SET value = json_set(value, '$.scenario.carriers[0].frequency_hz', 'x')",
            "$.scenario.carriers[0].frequency_hz",
        ),
        (
            "UPDATE dataset SET value = json_set(value, '$.scenario.services.channel.settings.obstacles', 5)",
            "settings in table dataset",
        ),
    ],
)
def test_a_catalogue_with_what_cannot_be_is_an_error_that_names_it(sql: str, said: str, copy: Path) -> None:
    edit(copy, f"{sql} WHERE key = 'settings'" if "UPDATE dataset" in sql else sql)
    with pytest.raises(RecordingError) as caught:
        write_page(copy)
    assert said in str(caught.value)
    assert str(DatasetDirectory(copy).catalogue) in str(caught.value)
    assert not DatasetDirectory(copy).page.exists()


def test_a_column_of_texts_is_no_column_of_numbers(copy: Path) -> None:
    with sqlite3.connect(DatasetDirectory(copy).catalogue) as connection:
        connection.executescript(
            "CREATE TABLE loose AS SELECT * FROM users; DROP TABLE users; ALTER TABLE loose RENAME TO users;"
            "UPDATE users SET gain_db = 'loud' WHERE episode = 2"
        )
    with pytest.raises(RecordingError, match=r"users\.gain_db.* 2, scene 0.*'loud'.* 7 "):
        write_page(copy)


@pytest.mark.usefixtures("undrawn")
def test_units_fit_the_numbers(copy: Path) -> None:
    edit(copy, "UPDATE users SET delay_spread_s = 2.5e-6")
    assert "median 2.5 µs" in Page(write_page(copy)).texts["gain"]


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("beam", [99999999999, -5, 32])
def test_beams_that_no_codebook_has_are_left_out_and_told(beam: int, copy: Path) -> None:
    edit(copy, f"UPDATE users SET tx_beam = {beam} WHERE episode = 1 AND scene = 2 AND rx = 'car/rx'")  # noqa: S608 - our own
    notes: list[str] = []
    page = Page(write_page(copy, note=notes.append))
    said = (
        "left out: best beams of 1 of 24 users that no codebook has (TX 0 to 31, RX 0 to 3), the first of "
        f"episode 1, scene 2, car/rx: TX {beam}, RX 3"
    )
    assert notes == [f"{said}; caviar dataset verify {copy} says more"]
    assert said in page.texts["beams"]
    assert page.pictures["beams"] == 1


@pytest.mark.usefixtures("undrawn")
def test_codebooks_of_a_link_of_ones_own_may_be_larger_than_arrays(copy: Path) -> None:
    own = "UPDATE dataset SET value = json_set(value, '$.scenario.services.link.use', 'my:Link')"
    edit(copy, f"{own} WHERE key = 'settings'")
    edit(copy, "UPDATE users SET tx_beam = 1000000000")
    notes: list[str] = []
    page = Page(write_page(copy, note=notes.append))
    assert "have too many pairs to be drawn" in page.texts["beams"]
    edit(copy, "UPDATE users SET tx_beam = 40")
    assert Page(write_page(copy, note=notes.append)).pictures["beams"] == 1
    assert notes == []
    assert "left out" not in page.texts["beams"]


def test_names_are_no_formulas() -> None:
    beams, name = np.zeros(2, dtype=int), r"$\frac{$"
    shown: list[str] = []
    drawn = draw_beams([(name, beams, beams)], (2, 2))
    picture(lambda figure, theme: (drawn(figure, theme), shown.append(figure.axes[0].get_title())), 3.0)
    assert shown == [r"\$\frac{\$"] * 2


@pytest.mark.usefixtures("undrawn")
def test_one_is_no_plural(tmp_path: Path) -> None:
    page = Page(write_page(make(tmp_path / "d", 1, 1)))
    assert "2 paths of 1 recorded episode (1 scene)" in page.texts["angles"]
    assert "1 scene of 1 episode in" in page.texts["generation"]
    assert "on 2 objects" in page.texts["dataset"]
    edit(tmp_path / "d", "DELETE FROM users WHERE rx = 'car/rx'")
    page = Page(write_page(tmp_path / "d"))
    assert "on 1 object" in page.texts["dataset"]
    assert "on 1 objects" not in page.texts["dataset"]


def test_a_folder_that_is_no_dataset_stays_as_it_is(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"no dataset.*catalogue\.sqlite"):
        write_page(tmp_path / "nothing")
    assert list(tmp_path.iterdir()) == []


def test_overwrite_removes_the_page_of_what_is_removed(tmp_path: Path) -> None:
    out = make(tmp_path / "d", 1, 1)
    page, other = DatasetDirectory(out).page, out / "notes.txt"
    for file in (page, other):
        file.write_text("text")
    _remove(out)
    assert not page.exists()
    assert other.exists()


@pytest.mark.usefixtures("undrawn")
def test_the_command_says_where_the_page_is(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "page.html"
    result = CliRunner().invoke(app, ["dataset", "look", str(folder), "--out", str(out)])
    assert result.exit_code == 0, result.output
    assert result.output.splitlines()[-1] == str(out)
    assert Page(out).pictures


def test_the_command_names_the_extra_that_is_missing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("caviar_clients.cli.shared.has_extra", lambda extra: False)
    result = CliRunner().invoke(app, ["dataset", "look", str(folder)])
    assert isinstance(result.exception, SetupError)
    assert re.search(
        r"caviar dataset look needs what is not installed \(plot\); run: .*plot", str(result.exception)
    )


def test_a_browser_opens_the_page_without_an_error(folder: Path, page: Page, tmp_path: Path) -> None:
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("chromium is not installed (Debian's package chromium)")
    answer = subprocess.run(
        [
            chromium, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path}",
            "--enable-logging=stderr", "--dump-dom", (folder / "look.html").as_uri(),
        ],
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    assert [line for line in answer.stderr.splitlines() if "CONSOLE" in line] == []
    assert answer.stdout.count("<img ") == len(page.alts)
    assert "<title>smoke – dataset" in answer.stdout


SCENES_ALONE = """
[run]
name = "scenes"
frames = 1
seed = 1
sampling_period_ns = 100_000_000
record = ["scene"]

[services.world]
role = "world"
use = "trajectory"
budget_ms = 20
[[services.world.settings.objects]]
name = "car"
kind = "car"
dimensions_m = [4.5, 1.8, 1.5]
waypoints = [[0.0, 0.0, 0.0, 0.75], [5.0, 5.0, 0.0, 0.75]]

[services.recorder]
role = "recorder"
use = "mcap"
budget_ms = 100
"""
