"""The viewer's page in a real browser: a recording, a run as it goes on, a scenario, a saved file."""

from __future__ import annotations

import io
import json
import math
import re
import shutil
import signal
import subprocess
import time
import urllib.error
import urllib.request
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from node_project import node_project
from scenarios_support import caviar, started

import caviar as package
from caviar_clients.cli.page import FLAGS
from caviar_protocol.recording import Recording
from caviar_protocol.topics import Channel, Lidar, Link

playwright = pytest.importorskip("playwright.sync_api")
PIL = pytest.importorskip("PIL.Image")

CHROMIUM = shutil.which("chromium")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed (Debian: chromium)"),
]
SIZE = (1280, 720)
ORANGE, SKY = (230, 159, 0), (86, 180, 233)
"""Colours of objects with and without a device (Okabe and Ito, 2008)."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as drivers:
        found = drivers.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield found
        found.close()


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return package.run("street-canyon", frames=8, out=tmp_path_factory.mktemp("view"), embedded=True)


class Page:
    """A page that is open; it collects what the browser complains of."""

    def __init__(self, browser: Any, url: str, **context: Any) -> None:
        self.complaints: list[str] = []
        self.raw = browser.new_page(viewport=dict(zip(("width", "height"), SIZE, strict=True)), **context)
        self.raw.on("console", lambda m: self.complaints.append(m.text) if m.type == "error" else None)
        self.raw.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.raw.goto(url)
        self.ready()

    def ready(self) -> None:
        self.holds("window.caviar !== undefined")
        self.raw.evaluate("window.caviar.ready")

    @property
    def state(self) -> dict[str, Any]:
        found: dict[str, Any] = self.raw.evaluate("window.caviar.state()")
        return found

    def until(self, condition: str) -> None:
        """Wait for a condition on ``s``, the page's state, of a frame that is loaded."""
        loaded = "(s.live || s.shown.n === s.n)"
        self.holds(f"(() => {{ const s = window.caviar.state(); return {loaded} && {condition}; }})()")

    def holds(self, expression: str) -> None:
        """Wait until an expression is true."""
        # Not `wait_for_function`, which evaluates text in the page: its security policy forbids that.
        end = time.monotonic() + 60
        while not self.raw.evaluate(f"!!({expression})"):
            assert time.monotonic() < end, f"{expression}\n{self.raw.evaluate('window.caviar.state()')}"
            self.raw.wait_for_timeout(50)

    def press(self, *keys: str) -> None:
        for key in keys:
            self.raw.keyboard.press(key)

    def pixels(self, colour: tuple[int, int, int], near: int = 40) -> int:
        """Number of pixels near a colour."""
        picture = np.asarray(PIL.open(io.BytesIO(self.raw.screenshot())).convert("RGB"), int)
        return int((np.abs(picture - colour).max(-1) <= near).sum())

    def place_of(self, position: list[float]) -> tuple[float, float]:
        """Where a place in the world is on the screen [px]."""
        x, y = self.raw.evaluate("place => window.caviar.project(place)", position)
        return x, y


@contextmanager
def served(*arguments: str | Path) -> Iterator[str]:
    """``caviar view`` with these arguments; its URL."""
    words = ["caviar_clients", "view", *arguments, "--no-browser"]
    with started(*words, mark=uuid.uuid4().hex) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            url = re.match(r"http://\S+/view/", line)
            assert url, line
            yield url[0]
        finally:
            process.send_signal(signal.SIGINT)
            assert process.wait(20) == 0


@pytest.fixture(scope="module")
def address(recorded: Path) -> Iterator[str]:
    with served(recorded) as url:
        yield url


@pytest.fixture
def opened(browser: Any, address: str) -> Iterator[Callable[..., Page]]:
    pages: list[Page] = []

    def open_page(fragment: str = "", url: str = address, **context: Any) -> Page:
        pages.append(Page(browser, url + fragment, **context))
        return pages[-1]

    yield open_page
    for page in pages:
        page.raw.close()


def test_a_frame_shows_its_products(opened: Callable[..., Page], recorded: Path) -> None:
    page = opened("#n=5&layers=buildings,terrain,objects,devices,rays,beams,lidar")
    page.until("s.shown.points > 0 && s.shown.paths > 0")
    state, frame = page.state, Recording(recorded).frame(0, 5)
    scene = frame.scene()
    assert scene is not None
    shown = state["shown"]
    assert set(shown["objects"]) == set(scene.names)
    for name, position in zip(scene.names, scene.position, strict=True):
        assert np.allclose(shown["objects"][name], position, rtol=0, atol=1e-6)
    (channel,) = frame.payloads("channel", Channel).values()
    assert shown["paths"] == len(channel.tau)
    (lidar,) = frame.payloads("lidar", Lidar).values()
    total = sum(len(scan.ray) for scan in lidar.scans)
    assert shown["points"] == len(range(0, total, -(-total // 20_000)))
    (link,) = frame.payloads("link", Link).values()
    tx, rx, carrier = shown["user"].split("|")
    i = list(zip(link.tx, link.rx, link.carrier, strict=True)).index((tx, rx, carrier))
    assert (shown["tx_beam"], shown["rx_beam"]) == (link.tx_beam[i], link.rx_beam[i])
    assert shown["best_tx_beam"] == link.top_tx_beam[i, 0]
    assert shown["snr_db"] == pytest.approx(10 * math.log10(link.snr[i]), abs=1e-9)
    assert {(lobe["device"], lobe["beam"]) for lobe in shown["lobes"]} >= {(tx, link.tx_beam[i])}
    assert state["errors"] == []
    assert page.complaints == []


def test_it_is_steered_by_mouse_keyboard_and_link(opened: Callable[..., Page]) -> None:
    page = opened()
    page.until("s.shown.paths > 0")
    assert page.pixels(ORANGE) > 50
    # The nearest vehicle on the screen: nothing stands before it.
    eye = np.array(page.state["camera"]["position"])
    vehicles = page.state["shown"]["objects"]
    places = {name: page.place_of(position) for name, position in vehicles.items()}
    carriers = {device.partition("/")[0] for device in page.state["shown"]["devices"]}
    seen = [n for n, (x, y) in places.items() if 300 < x < 1200 and 80 < y < 640 and n not in carriers]
    nearest = min(seen, key=lambda name: float(np.linalg.norm(np.array(vehicles[name]) - eye)))
    page.raw.mouse.click(*places[nearest])
    page.until("s.selected !== null")
    assert page.state["selected"] == nearest
    assert nearest in page.raw.inner_text("body")
    page.press("End")
    page.until("s.n === 7")
    page.press("Home", "ArrowRight", "ArrowRight")
    page.until("s.n === 2")
    slider = page.raw.get_by_role("slider", name="Frame")
    slider.focus()
    slider.press("ArrowRight")
    page.until("s.n === 3")
    before = page.state["camera"]["position"]
    page.raw.mouse.move(640, 300)
    page.raw.mouse.wheel(0, 240)
    # The camera stands in the link once the wheel has moved it.
    page.until(
        "location.hash.includes('n=3') && (new URLSearchParams(location.hash.slice(1)).get('cam') ?? '')"
        f".split(',').slice(0, 3).every((v, i) => Math.abs(v - s.camera.position[i]) < 0.02)"
        f" && s.camera.position.some((v, i) => Math.abs(v - {before}[i]) > 1)"
    )
    link, state = page.raw.evaluate("[location.href, window.caviar.state()]")
    again = opened(url=link)
    assert (again.state["n"], again.state["selected"]) == (3, nearest)
    assert np.allclose(again.state["camera"]["position"], state["camera"]["position"], atol=0.02)
    page.press(" ")
    page.until("s.n === 7 && !s.playing")
    assert page.complaints == again.complaints == []


def test_layers_are_hidden(opened: Callable[..., Page]) -> None:
    page = opened("#layers=buildings,terrain")
    assert page.pixels(ORANGE) + page.pixels(SKY, near=20) < 40
    page.raw.get_by_label("Objects").check()
    page.until("Object.keys(s.shown.objects).length > 0")
    page.raw.wait_for_timeout(300)
    assert page.pixels(ORANGE) > 50


def test_a_run_is_paused_stepped_and_stopped(browser: Any, tmp_path: Path) -> None:
    words = ["caviar_clients", "run", "street-canyon", "--frames", "5000", "--out", tmp_path, "--view"]
    with started(*words, mark=uuid.uuid4().hex) as process:
        assert process.stdout is not None
        url = next(found[0] for line in process.stdout if (found := re.match(r"http://\S+/view/", line)))
        page = Page(browser, url)
        page.until("s.live && s.shown.paths > 0")
        first = page.state["n"]
        page.until(f"s.n > {first}")
        page.raw.get_by_label("LIDAR").check()
        page.until("s.shown.points > 0")
        page.press("c")
        page.raw.get_by_role("button", name="Pause the run").click()
        page.raw.get_by_role("button", name="Let the run make one frame").wait_for()
        page.until("s.news && s.news.paused")
        status = url.removesuffix("view/") + "status"

        def finished() -> int:
            with urllib.request.urlopen(status) as answer:  # noqa: S310 - of this machine
                return int(json.load(answer)["frames_finished"])

        page.raw.wait_for_timeout(500)  # frames in flight are finished
        before = finished()
        page.raw.get_by_role("button", name="Let the run make one frame").click()
        while finished() == before:
            page.raw.wait_for_timeout(50)
        assert finished() == before + 1
        page.press("ArrowLeft")
        page.until("!s.live")
        page.raw.get_by_role("button", name="Stop the run").click()
        assert process.wait(60) == 1
        page.raw.close()
        process.stdout.close()


def test_a_scenario_that_has_not_run_shows_its_scene(browser: Any) -> None:
    with served("street-canyon") as url:
        page = Page(browser, url)
        page.until("Object.keys(s.shown.objects).length > 0")
        assert page.state["kind"] == "scenario"
        assert page.state["shown"]["devices"]["bs"] == [0, -8.3, 5]
        page.raw.get_by_text("bs", exact=True).first.wait_for()
        assert page.complaints == []
        page.raw.close()


def test_a_saved_page_needs_no_server(browser: Any, recorded: Path, tmp_path: Path) -> None:
    file = tmp_path / "page.html"
    finished = caviar("view", recorded, "--save", file, "--limit", "4")
    assert finished.status == 0, finished.output
    assert file.stat().st_size <= 4e6
    for wrong in (tmp_path, tmp_path / "nowhere" / "page.html"):
        refused = caviar("view", recorded, "--save", wrong)
        assert refused.status == 1
        assert str(wrong) in refused.output
        assert "Traceback" not in refused.output
    page = Page(browser, file.as_uri())
    page.until("s.shown.paths > 0")
    page.press("End")
    page.until("s.n > 0 && s.shown.paths > 0")
    scene = Recording(recorded).frame(0, page.state["frame"]).scene()
    assert scene is not None
    assert np.allclose(
        [page.state["shown"]["objects"][name] for name in scene.names], scene.position, atol=1e-6
    )
    assert page.complaints == []
    page.raw.close()


def test_two_runs_stand_side_by_side(browser: Any, recorded: Path, tmp_path: Path) -> None:
    other = package.run("street-canyon", frames=8, seed=5, out=tmp_path, embedded=True)
    with served(recorded, "--beside", other) as url:
        page = Page(browser, url + "#n=6")
        page.until("s.shown.different.objects.length > 0")
        scenes = [Recording(run).frame(0, 6).scene() for run in (recorded, other)]
        places = [
            {n: tuple(p) for n, p in zip(s.names, s.position.tolist(), strict=True)} for s in scenes if s
        ]
        moved = {n for n in places[0].keys() & places[1].keys() if places[0][n] != places[1][n]}
        assert moved <= set(page.state["shown"]["different"]["objects"])
        assert page.complaints == []
        page.raw.close()


def test_it_is_accessible(opened: Callable[..., Page], tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.mktemp("axe")
    (folder / "source").mkdir()
    (folder / "source" / "package.json").write_text(
        '{"private": true, "dependencies": {"axe-core": "4.11.0"}}'
    )
    (folder / "source" / "empty.mjs").write_text("")
    script = node_project(folder / "source", "empty.mjs", folder) / "node_modules" / "axe-core" / "axe.min.js"
    for scheme in ("light", "dark"):
        page = opened("#dock=curves", color_scheme=scheme, bypass_csp=True)
        page.until("s.shown.paths > 0")
        page.raw.add_script_tag(path=script)
        found = page.raw.evaluate("axe.run()")["violations"]
        serious = [rule["id"] for rule in found if rule["impact"] in ("serious", "critical")]
        assert serious == [], [node["html"] for rule in found for node in rule["nodes"]]


def test_pictures_and_films_of_the_page(opened: Callable[..., Page], recorded: Path, tmp_path: Path) -> None:
    link = "#n=5&quality=fine&panel=0&layers=buildings,terrain,objects,rays"
    file, film = tmp_path / "page.png", tmp_path / "page.gif"
    assert (
        caviar("view", recorded, "--picture", file, "--link", f"http://any/view/{link}").output == f"{file}\n"
    )
    page = opened(link)
    page.until("s.shown.paths > 0")
    drawn, shown = (
        np.asarray(PIL.open(picture).convert("RGB"), int)
        for picture in (file, io.BytesIO(page.raw.screenshot()))
    )
    assert np.abs(drawn - shown).mean() < 2
    words = ("plot", "video", recorded, "--link", link, "--frames", "2:5", "--width", "640", "--out", film)
    done = caviar(*words)
    assert "3 frames of 640×360" in done.output
    with PIL.open(film) as animation:
        assert animation.n_frames == 3
        pictures = []
        for number in range(3):
            animation.seek(number)
            pictures.append(np.asarray(animation.convert("RGB"), int))
    assert all((a != b).any() for a, b in pairwise(pictures))
    assert all((np.abs(picture - ORANGE).max(-1) <= 40).sum() > 50 for picture in pictures)
    assert caviar(*words, "--user", "bs").status != 0


HOSTILE = "<script>window.hacked = 1;<img src=x onerror='window.hacked = 2'>"


def test_names_are_text(browser: Any, tmp_path: Path) -> None:
    scenario = tmp_path / "hostile.toml"
    text = caviar("new", scenario).output
    assert scenario.is_file(), text
    content = scenario.read_text()
    for key in ("name", "on"):
        content = content.replace(f'\n{key} = "car"', f"\n{key} = {json.dumps(HOSTILE)}")
    scenario.write_text(content)
    run = package.run(scenario, frames=3, out=tmp_path / "runs", embedded=True)
    assert HOSTILE in (Recording(run).frame(0, 0).scene() or pytest.fail("no scene")).names
    with served(run) as url:
        page = Page(browser, url + "#n=1")
        page.until("Object.keys(s.shown.objects).length > 0")
        page.raw.get_by_text(HOSTILE).first.wait_for()
        assert page.raw.evaluate("window.hacked") is None
        page.raw.close()
    saved = tmp_path / "saved.html"
    assert caviar("view", run, "--save", saved).status == 0
    page = Page(browser, saved.as_uri())
    assert page.raw.evaluate("window.hacked") is None
    page.raw.close()


def test_a_damaged_product_is_said_and_not_shown(browser: Any, recorded: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(recorded, tmp_path / "copy"))
    segment = copy / "recording-0000.mcap"
    entry = Recording(copy)
    chunk = entry.segment_of(4)[0].chunks[entry.segment_of(4)[1]]
    content = bytearray(segment.read_bytes())
    middle = chunk.offset + 100_000  # among the points of the LIDAR
    content[middle : middle + 64] = bytes(64)
    segment.write_bytes(content)
    with served(copy) as url:
        page = Page(browser, url + "#n=4&layers=buildings,objects,lidar")
        page.raw.get_by_text(re.compile("damaged")).first.wait_for()
        assert page.state["shown"]["points"] == 0
        page.press("ArrowRight")
        page.until("s.n === 5 && s.shown.points > 0")
        page.raw.close()


def status_of(url: str, **headers: str) -> int:
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers)) as answer:  # noqa: S310
            return int(answer.status)
    except urllib.error.HTTPError as error:
        return error.code


def test_guests_are_turned_away(address: str, recorded: Path, tmp_path: Path) -> None:
    assert status_of(f"{address}data/about") == 200
    assert status_of(f"{address}data/about", Origin="http://evil.example") == 403
    assert status_of(f"{address}data/about", Host="evil.example") == 403
    for path in (
        "../../etc/passwd",
        "data/../../x",
        "data/meshes/..%2f..%2fx",
        "data/frames/99",
        "secret.js",
    ):
        assert status_of(address + path) == 404, path
    keys = tmp_path / "keys"
    made = caviar("keys", "token", "ana", "--role", "viewer", "--directory", keys)
    token = re.search(r"\S{30,}", made.output)
    assert token, made.output
    with served(recorded, "--keys", keys) as url:
        assert status_of(url) == 200  # the page itself, which asks for a token
        assert status_of(f"{url}data/about") == 401
        assert status_of(f"{url}data/about", Authorization="Bearer of-another-run") == 401
        assert status_of(f"{url}data/about", Authorization=f"Bearer {token[0]}") == 200


def test_the_bundle_is_built_of_its_sources(repository: Path, tmp_path: Path) -> None:
    source = repository / "clients" / "view"
    copy = Path(
        shutil.copytree(source, tmp_path / "clients" / "view", ignore=shutil.ignore_patterns("node_modules"))
    )
    shutil.copytree(
        repository / "clients" / "js",
        tmp_path / "clients" / "js",
        ignore=shutil.ignore_patterns("node_modules"),
    )
    (tmp_path / "broker" / "caviar_view" / "page").mkdir(parents=True)
    done = subprocess.run(
        ["npm", "ci", "--no-audit", "--no-fund"],
        cwd=copy,
        capture_output=True,
        text=True,
        timeout=180,
        check=False,
    )
    if "ENOTFOUND" in done.stderr or "EAI_AGAIN" in done.stderr or "ECONNREFUSED" in done.stderr:
        pytest.skip("npm cannot reach its registry")
    assert done.returncode == 0, done.stderr
    for script in ("check", "build", "test"):
        done = subprocess.run(
            ["npm", "run", script], cwd=copy, capture_output=True, text=True, timeout=180, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
    for name in ("index.html", "viewer.js", "viewer.css"):
        built = (tmp_path / "broker" / "caviar_view" / "page" / name).read_bytes()
        assert built == (repository / "broker" / "caviar_view" / "page" / name).read_bytes(), name
    sizes = [len(path.read_text().splitlines()) for path in (source / "src").rglob("*.ts")]
    assert max(sizes) <= 500
