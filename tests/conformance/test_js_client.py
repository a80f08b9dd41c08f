"""The client library in clients/js: types, vectors, conformance kit, and whole runs in Node and Chromium."""

from __future__ import annotations

import http.server
import json
import re
import shlex
import shutil
import socket
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import engine_worlds as worlds
import pytest
from node_project import node_project
from scenarios_support import ROOT, blocks, caviar, environment, eventually, running
from test_websocket_agent import WITHIN_S, WebRun

from caviar_broker.control.socket import ask
from caviar_broker.http.process import gateway_in_front
from caviar_labs.conform import Verdict, cases, conform
from caviar_labs.conform.client import Rules
from caviar_protocol.recording import Recording

CLIENT = ROOT / "clients" / "js"
HERE = Path(__file__).parent
FRAMES = 160
LEAST_NODE = 18
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
WORLD_IN_TYPESCRIPT = """
import { type Command, GODOT, type SceneObject, World } from "./src/index.mjs";

class Typed extends World {
  private speed = 0;
  override reset(seed: bigint): void { this.speed = Number(seed % 10n); }
  override step(t: number, previous: number, commands: Command[]): SceneObject[] {
    for (const command of commands) if (command.type === "waypoint") this.speed = command.speed;
    const ahead = { position: [0, 0, -t * this.speed], velocity: [0, 0, -this.speed] };
    const { position, velocity } = GODOT.toEnu(ahead);
    const object: SceneObject = { name: "car", class: "car", position, velocity, dimensions: [4, 2, 1.5] };
    // @ts-expect-error: tsc says so where this is no mistake
    const wrong: SceneObject = { ...object, velocity: 3 };
    return [object, wrong];
  }
}
export const ended: Promise<string> = new Typed({ prefixes: ["car"] }).run("ws://127.0.0.1:8080/ws");
"""

CASES_OF_THE_AGENT = (
    "hello", "ready", "frames", "repeated-grant", "queued-grants", "held-inputs", "absent-inputs", "episodes",
    "undecodable-input", "truncated", "checkpoint", "restore", "shutdown", "final-grant", "several-sources",
    "canonical",
)  # fmt: skip

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def node() -> str:
    """Path of Node; skips by name where there is none, or an old one."""
    path = shutil.which("node")
    if path is None:
        pytest.skip("node is not installed")
    told = subprocess.run([path, "--version"], capture_output=True, text=True, check=True).stdout
    if int(re.findall(r"\d+", told)[0]) < LEAST_NODE:
        pytest.skip(f"node {told.strip()} is older than {LEAST_NODE}")
    return path


def printed(*command: str | Path, cwd: Path = ROOT) -> str:
    """Output of a command that has to succeed."""
    done = subprocess.run(
        list(map(str, command)), capture_output=True, text=True, cwd=cwd, timeout=120, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


# --- without a broker -------------------------------------------------------------------------------


def test_every_vector_is_read_written_or_refused_and_axes_are_those_of_engines(node: str) -> None:
    vectors = ROOT / "protocol" / "vectors"
    report = json.loads(
        printed(node, HERE / "js_vectors.mjs", CLIENT / "src", vectors, ROOT / "clients/axes.json")
    )
    assert report["wrong"] == []
    stated = [json.loads(path.read_text()) for path in vectors.glob("*.json")]
    refused = sum("refused" in vector for vector in stated)
    assert report["checked"]["refused"] == refused >= 55
    assert report["checked"]["read"] == len(stated) - refused
    poses = json.loads((ROOT / "clients/axes.json").read_text())["poses"]
    assert report["checked"]["poses"] == 2 * 4 * len(poses)
    assert report["checked"]["meshes"] == 4


def test_what_the_library_does_without_a_broker(node: str) -> None:
    printed(node, "--test", HERE / "js_library.test.mjs")


def test_the_reference_world_has_at_most_80_lines_of_code() -> None:
    lines = [line.strip() for line in (CLIENT / "world.mjs").read_text().splitlines()]
    code = [line for line in lines if line and not re.match(r"//|/\*\*.*\*/$", line)]
    assert 40 < len(code) <= 80


@pytest.fixture(scope="module")
def tools(node: str, tmp_path_factory: pytest.TempPathFactory, pytestconfig: pytest.Config) -> Path:
    """The library beside TypeScript and esbuild; skips by name where npm or its registry is missing."""
    wanted = json.loads((CLIENT / "package.json").read_text())
    source = tmp_path_factory.mktemp("js-source")
    (source / "package.json").write_text(json.dumps({"dependencies": wanted["devDependencies"]}))
    shutil.copy(CLIENT / "tsconfig.json", source)
    cache = pytestconfig.cache
    folder = cache.mkdir("js-client") if cache is not None else tmp_path_factory.mktemp("js-client")
    node_project(source, "tsconfig.json", folder)
    shutil.copy(CLIENT / "package.json", folder)  # esbuild reads there what is not for browsers
    shutil.copytree(CLIENT / "src", folder / "src", dirs_exist_ok=True)
    return folder


def test_the_library_is_strictly_typed_and_so_is_a_world_in_typescript(tools: Path) -> None:
    script = tools / "typed.ts"
    script.write_text(WORLD_IN_TYPESCRIPT)
    config = json.loads((CLIENT / "tsconfig.json").read_text())
    config["include"] = ["src", "typed.ts"]
    (tools / "tsconfig.json").write_text(json.dumps(config))
    printed(tools / "node_modules/.bin/tsc", cwd=tools)
    script.unlink()


def test_a_bundle_for_browsers_has_nothing_of_node(tools: Path) -> None:
    shutil.copy(CLIENT / "world.mjs", tools)
    options = ("--bundle", "--format=esm", "--platform=browser", "--log-level=warning")
    bundle = printed(tools / "node_modules/.bin/esbuild", "world.mjs", *options, cwd=tools)
    assert re.search(r"Street\b.* extends World", bundle)
    assert "node:" not in bundle


# --- the conformance kit ----------------------------------------------------------------------------


def judged(node: str, script: str, role: str, *names: str) -> list[Verdict]:
    """Verdicts of the kit on a script of clients/js, over WebSocket."""
    told: list[str] = []
    return conform(
        "tcp://127.0.0.1:0",
        command=shlex.join([node, str(CLIENT / script), "{endpoint}", "{name}"]),
        rules=Rules(name="mine", role=role, timeout_s=15.0),
        names=names,
        front=lambda endpoint: gateway_in_front(endpoint, "127.0.0.1:0", told.append),
    )


def failures(verdicts: list[Verdict]) -> dict[str, str]:
    """What went wrong, by case."""
    return {v.case: f"expected {v.expected}; got {v.got}" for v in verdicts if v.outcome == "fail"}


def test_the_world_fails_no_case_of_the_kit(node: str) -> None:
    verdicts = judged(node, "world.mjs", "world")
    assert failures(verdicts) == {}
    assert [v.case for v in verdicts] == [case.name for case in cases()]
    passed = {v.case for v in verdicts if v.outcome == "pass"}
    # Not of a world: parts of a channel, late inputs of a recorder, an agent's final grant, others' meshes.
    assert {v.case for v in verdicts} - passed == {
        "late-inputs", "channel-parts", "channel-consistency", "final-grant",
        "geometry", "later-geometry", "geometry-gone", "observe",
    }  # fmt: skip


def test_the_agent_fails_no_case_that_differs_from_the_worlds(node: str) -> None:
    verdicts = judged(node, "agent.mjs", "agent", *CASES_OF_THE_AGENT)
    assert failures(verdicts) == {}
    assert sum(v.outcome == "pass" for v in verdicts) == len(CASES_OF_THE_AGENT)


LOOK = """import {{ Observer }} from "{library}";
const [url, name] = process.argv.slice(2);
const observer = new Observer(url, {{ name }});
for await (const {{ products }} of observer) for (const {{ payload }} of products) payload.names.length;
if (!observer.ended) process.exit(1);
"""


def test_an_observer_fails_no_case_of_the_kit(node: str, tmp_path: Path) -> None:
    script = tmp_path / "look.mjs"
    script.write_text(LOOK.format(library=CLIENT / "src" / "index.mjs"))
    verdicts = judged(node, str(script), "observer")
    assert failures(verdicts) == {}
    passed = [v.case for v in verdicts if v.outcome == "pass"]
    assert passed == ["hello", "observe", "other-major", "refused", "canonical"]


# --- whole runs -------------------------------------------------------------------------------------


@contextmanager
def waiting_run(
    folder: Path, *options: str, scenario: Path = CLIENT / "world.toml", frames: int = FRAMES
) -> Iterator[WebRun]:
    """``caviar run --http`` of the scenario that waits for a world."""
    out = folder / "out"
    options = ("--frames", str(frames), "--http", "127.0.0.1:0", *options)
    with running(scenario, out, *options) as (process, mark):
        yield WebRun(process, mark, out)


@pytest.fixture(scope="module")
def light(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scenario with a recorder for the world, and no service that loads large libraries."""
    return worlds.light(CLIENT / "world.toml", tmp_path_factory.mktemp("light"))


@pytest.fixture(scope="module")
def undisturbed(node: str, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """Digest and directory of a run with the world in Node."""
    with waiting_run(tmp_path_factory.mktemp("undisturbed")) as run:
        with run.agent(node, str(CLIENT / "world.mjs"), run.url, "world") as world:
            digest = run.digest()
            assert world.wait(WITHIN_S) == 0
        return digest, next(run.out.glob("*/"))


THROWS = """import {{ main, World }} from "{library}";
class Throws extends World {{
  step() {{ {step} }}
}}
await main(new Throws({{ prefixes: ["car"] }}));
"""


@pytest.mark.parametrize(
    "step",
    [
        'throw new Error("no road is left");',
        "for (const until = Date.now() + 1500; Date.now() < until; ); return [];",
    ],
    ids=["throws", "late"],
)
def test_a_world_that_ends_the_run_ends_with_status_1(node: str, step: str, tmp_path: Path) -> None:
    script = tmp_path / "throws.mjs"
    script.write_text(THROWS.format(library=CLIENT / "src" / "index.mjs", step=step))
    with (
        waiting_run(tmp_path, scenario=worlds.ending(tmp_path, "late"), frames=3) as run,
        run.agent(node, str(script), run.url, "world") as world,
    ):
        assert world.wait(WITHIN_S) == 1
        assert run.process.wait(WITHIN_S) == 1  # the world had joined: the run ends with it


def scenes(directory: Path) -> list[str]:
    """Digests of the scenes of a run, frame by frame."""
    return [product.digest for _, product in Recording(directory).products("scene")]


@pytest.mark.channel
def test_frames_have_paths_scans_and_links_of_what_the_world_brings(
    undisturbed: tuple[str, Path],
) -> None:
    recording = Recording(undisturbed[1])
    assert len(recording) == FRAMES
    topics = {product.provenance.topic for product in recording.frame(0, FRAMES - 1).products}
    assert topics == {"scene", "channel", "lidar", "action", "link"}
    there: list[set[str]] = []
    for frame in (0, 70, 150):
        scene = recording.frame(0, frame).scene()
        assert scene is not None
        there.append({*scene.names, *(device.name for device in scene.devices)})
    always = {"car", "uav", "bs", "car/rx", "car/lidar", "uav/rx-uav"}
    assert there[0] == always | {"truck.0", "truck.0/rx"}
    assert there[1] == always  # the truck has gone
    assert there[2] == always | {"truck.1", "truck.1/rx"}
    # The mesh of trucks came while the run went on.
    first = recording.frame(0, 0).scene()
    assert first is not None
    assert set(recording.meshes) == {first.assets[first.names.index("truck.0")]}
    lidar: Any = next(product for _, product in recording.products("lidar")).payload
    assert {"ground", "building"} <= set(lidar.object_names)
    hit = {lidar.object_names[index] for index in set(lidar.scans[0].object.tolist())}
    assert {"ground", "building"} <= hit


def frames_of(run: WebRun) -> int:
    """Frames that a run has finished."""
    return int(ask(next(run.out.glob("*/")), do="status")["status"]["frames_finished"])


class Cable:
    """Carries TCP connections of this machine to a port, and may be cut."""

    def __init__(self, port: int) -> None:
        self._to, self._ends = ("127.0.0.1", port), list[socket.socket]()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        with suppress(OSError):  # it is closed
            while True:
                here, _ = self._listener.accept()
                there = socket.create_connection(self._to)
                self._ends += [here, there]
                for source, target in ((here, there), (there, here)):
                    threading.Thread(target=self._carry, args=(source, target), daemon=True).start()

    @staticmethod
    def _carry(source: socket.socket, target: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(1 << 16):
                target.sendall(data)
            target.shutdown(socket.SHUT_RDWR)

    def cut(self) -> None:
        """End all connections, as a network does that is gone; new ones are carried."""
        ends, self._ends = self._ends, []
        for end in ends:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()

    def close(self) -> None:
        """Carry nothing any more."""
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self.cut()


@pytest.mark.channel
def test_cut_off_then_killed_and_started_again_it_makes_the_same_digest(
    node: str, undisturbed: tuple[str, Path], tmp_path: Path
) -> None:
    with waiting_run(tmp_path) as run:
        cable = Cable(int(re.findall(r":(\d+)/", run.url)[0]))
        command = (node, str(CLIENT / "world.mjs"))
        with run.agent(*command, f"ws://127.0.0.1:{cable.port}/ws", "world") as first:
            eventually(lambda: frames_of(run) >= 40, WITHIN_S, "40 frames are done")
            cable.cut()
            eventually(
                lambda: frames_of(run) >= 80, WITHIN_S, "it came back by itself, and 80 frames are done"
            )
            assert first.poll() is None
            first.kill()  # SIGKILL
            first.wait()
        cable.close()
        with run.agent(*command, run.url, "world") as second:
            assert run.digest() == undisturbed[0]
            assert second.wait(WITHIN_S) == 0
        assert run.output.count("back: world") == 2


def with_its_own_websocket(node: str) -> list[str]:
    """Node with the WebSocket that it brings, where it brings one; without it the library has its own."""
    told = subprocess.run([node, "--version"], capture_output=True, text=True, check=True).stdout
    major, minor = map(int, re.findall(r"\d+", told)[:2])
    return [node, "--experimental-websocket"] if (20, 10) <= (major, minor) < (22, 0) else [node]


def followed(page: Path, folder: Path) -> Path:
    """The first world and the scenario of the page in a folder with the library; returns the scenario."""
    (folder / "node_modules").mkdir()
    (folder / "node_modules" / "caviar-client").symlink_to(CLIENT)  # as npm installs a folder
    first = dict(reversed(blocks(page)))
    (folder / "world.mjs").write_text(first["js"])
    (folder / "run.toml").write_text(first["toml"])
    return folder / "run.toml"


def test_the_world_of_the_page_gets_to_its_frames_with_its_token_and_with_no_other(
    node: str, tmp_path: Path
) -> None:
    scenario, keys = followed(ROOT / "docs/howto/js-client.md", tmp_path), tmp_path / "keys"
    assert caviar("keys", "new", "broker", "--directory", keys).status == 0
    made = caviar("keys", "token", "world", "--role", "world", "--directory", keys)
    command = (*with_its_own_websocket(node), str(tmp_path / "world.mjs"))
    with waiting_run(tmp_path, "--keys", str(keys), scenario=scenario, frames=3) as run:
        stranger = subprocess.run(
            [*command, run.url, "world"], env=environment(run.mark, CAVIAR_TOKEN=made.output[1:].strip()),
            capture_output=True, text=True, timeout=WITHIN_S, check=False,
        )  # fmt: skip
        assert stranger.returncode == 1
        assert "refused: unauthorized: " in stranger.stderr
        with subprocess.Popen(
            [*command, run.url, "world"], env=environment(run.mark, CAVIAR_TOKEN=made.output.strip())
        ) as world:
            run.digest()
            assert world.wait(WITHIN_S) == 0


class Quiet(http.server.SimpleHTTPRequestHandler):
    """Serves files without a line for each."""

    extensions_map = {".html": "text/html", ".mjs": "text/javascript"}  # noqa: RUF012  # as the base has it

    def log_message(self, *_: object) -> None:
        pass


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """URL of a folder, served to this machine."""
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder)))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


@pytest.mark.channel
@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
def test_a_page_in_chromium_publishes_the_scenes_that_node_publishes(
    undisturbed: tuple[str, Path], light: Path, tmp_path: Path
) -> None:
    options = ("--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path}/profile")
    with served(CLIENT) as site, waiting_run(tmp_path, scenario=light) as run:
        page = f"{site}/browser.html?url={run.url}&name=world"
        with subprocess.Popen(
            [str(CHROMIUM), *options, page], env=environment(run.mark),
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        ) as browser:  # fmt: skip
            try:
                run.digest()
            finally:
                browser.terminate()
        directory = next(run.out.glob("*/"))
    assert len(Recording(directory)) == FRAMES
    assert scenes(directory) == scenes(undisturbed[1])
