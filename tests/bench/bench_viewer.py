"""What the viewer costs and how soon it shows something, in headless Chromium.

    python tests/bench/bench_viewer.py [--pages 3] [--pairs 5] [--frames 600] [--nice] [--json FILE]

Alternating pairs of runs of `street-canyon`, without and with so many pages that follow it live: frames a
second once the pages are open and drawn, and processor time of a frame, of the processes of the run alone;
digests are compared. ``--nice`` gives the browser what the run leaves. Then, of
recordings: seconds from opening a page of `street-canyon` to its first picture; milliseconds of jumps to
random frames among 10,000 of `smoke`; seconds until a scene of a million triangles is drawn, and how many
triangles it is thinned to. Needs Playwright and Debian's chromium. The exit status is 1 where digests differ.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

CAVIAR = str(Path(sys.executable).with_name("caviar"))


SETTLED_S = 10.0
"""[s] from opening the pages until rates are measured."""


@contextmanager
def browser(nice: bool = False) -> Iterator[Any]:
    """A headless browser of its own process tree."""
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium") or "chromium"
    with tempfile.TemporaryDirectory() as place, sync_playwright() as drivers:
        if nice:
            script = Path(place, "chromium")
            script.write_text(f'#!/bin/sh\nexec nice -n 19 {chromium} "$@"\n')
            script.chmod(0o755)
            chromium = str(script)
        flags = ["--no-first-run", "--disable-background-networking", "--disable-sync"]
        found = drivers.chromium.launch(executable_path=chromium, args=flags)
        yield found
        found.close()


@contextmanager
def served(source: Path | str) -> Iterator[str]:
    """``caviar view``; its URL."""
    command = [CAVIAR, "view", str(source), "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            found = re.match(r"http://\S+/view/", process.stdout.readline())
            assert found
            yield found[0]
        finally:
            process.terminate()


def opened(chromium: Any, url: str) -> tuple[Any, float]:
    """A page once it has drawn a frame, and the seconds that took."""
    page = chromium.new_page(viewport={"width": 1280, "height": 720})
    begin = time.perf_counter()
    page.goto(url)
    while not page.evaluate("window.caviar !== undefined"):
        if time.perf_counter() - begin > 60:
            raise SystemExit(f"{url} shows nothing within 60 s: give the run more --frames")
        time.sleep(0.005)
    page.evaluate("window.caviar.ready")
    return page, time.perf_counter() - begin


def settled_rate(url: str, process: subprocess.Popen[str]) -> float:
    """Frames a second from now until a run ends."""
    marks: list[tuple[float, int]] = []
    while process.poll() is None:
        try:
            with urllib.request.urlopen(url.replace("/view/", "/status"), timeout=10) as answer:  # noqa: S310
                marks.append((time.monotonic(), json.load(answer)["frames_finished"]))
        except OSError:
            break
        time.sleep(0.5)
    if len(marks) < 10 or marks[-1][1] == marks[0][1]:
        raise SystemExit("the run ended before its pages were settled: give it more --frames")
    (begin, first), (end, last) = marks[0], marks[-1]
    return (last - first) / (end - begin)


def played(frames: int, pages: int, folder: Path, nice: bool) -> dict[str, Any]:
    """Summary of a run that so many pages follow, with the processor time of its own processes."""
    command = [CAVIAR, "run", "street-canyon", "--frames", str(frames), "--out", str(folder), "--view"]
    command += ["--json", str(folder / "summary.json")]
    with ExitStack() as stack:
        chromium = stack.enter_context(browser(nice)) if pages else None
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        url = next(found[0] for line in process.stdout if (found := re.match(r"http://\S+/view/", line)))
        if chromium is not None:
            for _ in range(pages):
                opened(chromium, url)
        time.sleep(SETTLED_S)
        rate = settled_rate(url, process)
        process.stdout.read()
        _, status, used = os.wait4(process.pid, 0)
    if os.waitstatus_to_exitcode(status):
        raise SystemExit(f"{' '.join(command)} failed")
    summary: dict[str, Any] = json.loads((folder / "summary.json").read_text())
    return summary | {"settled_rate": rate, "cpu_s": (used.ru_utime + used.ru_stime) / frames}


def large_scene(folder: Path, side: int = 708) -> Path:
    """A scenario whose ground has a million triangles."""
    from caviar_space.meshes import Mesh, ply

    x, y = np.meshgrid(np.linspace(-500, 500, side), np.linspace(-500, 500, side), indexing="ij")
    vertices = np.stack([x.ravel(), y.ravel(), 10 * np.sin(x / 60).ravel() * np.cos(y / 45).ravel()], 1)
    i = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    faces = np.concatenate([np.stack([i, i + side, i + 1], 1), np.stack([i + 1, i + side, i + side + 1], 1)])
    (folder / "ground.ply").write_bytes(ply(Mesh(vertices, faces.astype(np.int32))))
    (folder / "large.xml").write_text(
        '<scene version="2.1.0"><bsdf type="itu-radio-material" id="mat-g"><string name="type" '
        'value="concrete"/></bsdf><shape type="ply" id="mesh-ground"><string name="filename" '
        'value="ground.ply"/><ref id="mat-g" name="bsdf"/></shape></scene>'
    )
    scenario = folder / "large.toml"
    subprocess.run([CAVIAR, "new", str(scenario)], check=True, stdout=subprocess.DEVNULL)
    text = scenario.read_text()
    text = text.replace("# [services.world.settings]", "[services.world.settings]")
    scenario.write_text(re.sub(r'# scenery = "file:my-city.xml".*', 'scenery = "file:large.xml"', text))
    return scenario


def main() -> int:
    """Measure, and print; the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pages", type=int, default=3)
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--nice", action="store_true")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    figures: dict[str, Any] = {"pages": arguments.pages}
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        rates, costs, digests = [], [], set()
        for pair in range(arguments.pairs):
            without, along = (
                played(arguments.frames, pages, Path(tempfile.mkdtemp(dir=folder)), arguments.nice)
                for pages in (0, arguments.pages)
            )
            rates.append(along["settled_rate"] / without["settled_rate"])
            costs.append(along["cpu_s"] / without["cpu_s"])
            digests |= {without["digest"], along["digest"]}
            print(f"pair {pair}: {rates[-1]:.3f} of the frames/s, {costs[-1]:.3f} of the processor time")  # noqa: T201
        figures |= {"rate_ratio": statistics.median(rates), "cpu_ratio": statistics.median(costs)}
        run = max(folder.glob("*/street-canyon-*"))
        long = [CAVIAR, "run", "smoke", "--frames", "10000", "--embedded", "--out", str(folder / "smoke")]
        subprocess.run(long, check=True, stdout=subprocess.DEVNULL)
        smoke = next((folder / "smoke").glob("*"))
        with browser() as chromium:
            with served(run) as url:
                first = [opened(chromium, url)[1] for _ in range(3)]
            with served(smoke) as url:
                page, _ = opened(chromium, url)
                choice = random.Random(1)
                jumps = []
                for n in [choice.randrange(10_000) for _ in range(40)]:
                    begin = time.perf_counter()
                    page.evaluate("n => window.caviar.go(n)", n)
                    jumps.append(1e3 * (time.perf_counter() - begin))
                    assert page.evaluate("window.caviar.state().n") == n
            with served(large_scene(folder)) as url:
                page, large = opened(chromium, url)
                mesh = page.evaluate("fetch('data/about').then(r => r.json()).then(a => a.meshes[0])")
        figures |= {
            "first_picture_s": min(first), "first_pictures_s": first,
            "jump_ms": statistics.median(jumps), "worst_jump_ms": max(jumps),
            "large_scene_s": large, "triangles": mesh["triangles"], "of_triangles": mesh["of"],
        }  # fmt: skip
    print(json.dumps(figures, indent=1))  # noqa: T201
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=1) + "\n")
    return int(len(digests) != 1)


if __name__ == "__main__":
    raise SystemExit(main())
