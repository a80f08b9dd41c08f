"""``caviar verify``: a clean set has no finding, and each planted fault is found at its place."""

from __future__ import annotations

import json
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from recording_builders import frame, product, record
from typer.testing import CliRunner

from caviar_clients.cli.main import app
from caviar_clients.datasets.catalogue import Catalogue
from caviar_clients.datasets.directory import DatasetDirectory, writing_dataset
from caviar_clients.datasets.episode import EpisodeTask, play_episode
from caviar_clients.datasets.physics import Finding
from caviar_clients.datasets.plan import plan_dataset
from caviar_clients.datasets.rows import rows_of
from caviar_clients.datasets.verify import verify
from caviar_protocol.arrays import Payload
from caviar_protocol.errors import RecordingError
from caviar_protocol.messages import Status
from caviar_protocol.recording import Recording
from caviar_protocol.run_directory import RunDirectory
from caviar_protocol.scenario import load_scenario
from caviar_protocol.topics import Channel
from caviar_services.service import Frame

EPISODES, SCENES = 3, 4
AT = 1, 2
"""Episode and scene of a fault."""


def generated(out: Path, scenario: str) -> Path:
    directory = DatasetDirectory(out)
    plan = plan_dataset(load_scenario(scenario), episodes=EPISODES, scenes=SCENES)
    with writing_dataset(directory):
        catalogue = Catalogue(directory.catalogue, writable=True)
        catalogue.plan(plan.settings(), EPISODES)
        for number in range(EPISODES):
            result = play_episode(EpisodeTask(plan.scenario, number, str(out)))
            assert result.rows is not None, result.error
            catalogue.add(result.rows, result.measured)
        catalogue.close()
    return out


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return generated(tmp_path_factory.mktemp("clean") / "d", "smoke")


@pytest.fixture
def data(clean: Path, tmp_path: Path) -> Path:
    """A copy to plant a fault in."""
    shutil.copytree(clean, tmp_path / "d")
    return tmp_path / "d"


def rewritten(data: Path, topic: str, change: Callable[[Any], Payload], scene: int = AT[1]) -> None:
    """Record an episode anew with another product in one scene: only its content can tell."""
    folder = DatasetDirectory(data).episode(AT[0])
    recording = Recording(folder)
    metadata = recording.metadata
    frames = []
    for one in recording.frames():
        payloads = [(item.provenance.topic, item.provenance.source, item.payload) for item in one.products]
        inputs = [
            product(
                name, source, change(payload) if (name, one.number) == (topic, scene) else payload, one.number
            )
            for name, source, payload in payloads
        ]
        frames.append(frame(one.number, *inputs, episode=one.episode, seed=one.entry.seed))
    shutil.rmtree(folder)
    record(folder, frames, assets={}, compression="zstd")
    assert len(Recording(folder)) == len(frames)
    assert metadata.frames
    catalogue = Catalogue(DatasetDirectory(data).catalogue, writable=True)
    catalogue.add(rows_of(Recording(folder)), {})
    catalogue.close()


def found(data: Path) -> list[Finding]:
    return list(verify(data))


def of_channel(**fields: Callable[[Channel], Any]) -> Callable[[Channel], Channel]:
    return lambda channel: replace(channel, **{name: value(channel) for name, value in fields.items()})


def changed(array: Any, index: Any, value: Any) -> Any:
    copy = array.copy()
    copy[index] = value(copy[index]) if callable(value) else value
    return copy


def test_a_clean_set_has_no_finding_and_progress_is_told(clean: Path) -> None:
    told: list[tuple[int, int]] = []
    assert list(verify(clean, lambda done, total: told.append((done, total)))) == []
    assert told == [(1, 3), (2, 3), (3, 3)]


def test_recording_an_episode_anew_is_no_fault_by_itself(data: Path) -> None:
    rewritten(data, "scene", lambda scene: scene)
    assert found(data) == []


PATH_AXES = {
    "id": 0, "a": 1, "tau": 0, "aod": 0, "aoa": 0, "doppler": 1, "interactions": 0, "points": 0, "objects": 0
}  # fmt: skip
"""Fields of a channel with a row for each path, and which axis that is."""

CONTENT: dict[str, tuple[str, Callable[[Any], Payload], str, str]] = {
    "the sign of an angle": (
        "channel",
        of_channel(aod=lambda c: changed(c.aod, (0, 1), lambda a: -a)),
        "car/rx",
        "aod",
    ),
    "3 dB too much gain": (
        "channel",
        of_channel(a=lambda c: changed(c.a, (0, 0), lambda a: a * 10 ** (3 / 20))),
        "car/rx",
        "gain of the line of sight, mmwave",
    ),
    "a delay too short": (
        "channel",
        of_channel(tau=lambda c: changed(c.tau, 0, lambda tau: tau * 0.99)),
        "car/rx",
        "delay",
    ),
    "a free line of sight without a path": (
        "channel",
        of_channel(
            offsets=lambda c: np.maximum(c.offsets - 1, 0),
            **{
                name: lambda c, name=name, axis=axis: np.delete(getattr(c, name), 0, axis)
                for name, axis in PATH_AXES.items()
            },
        ),
        "car/rx",
        "line of sight",
    ),
    "swapped beams": (
        "link",
        lambda link: replace(link, top_tx_beam=link.top_tx_beam[:, ::-1].copy()),
        "car/rx",
        "best pair of beams",
    ),
    "the H of another user": (
        "channel",
        of_channel(h=lambda c: (replace(c.h[0], h=c.h[0].h * np.exp(1j * np.arange(32))), *c.h[1:])),
        "car/rx",
        "best pair of beams",
    ),
    "an object that jumps": (
        "scene",
        lambda scene: replace(scene, position=changed(scene.position, (0, 1), lambda y: y + 30.0)),
        "car",
        "movement since the scene before",
    ),
}


@pytest.mark.parametrize("fault", CONTENT)
def test_a_fault_of_the_content_is_found_at_its_place(fault: str, data: Path) -> None:
    topic, change, user, what = CONTENT[fault]
    rewritten(data, topic, change)
    findings = found(data)
    assert (AT[0], user, what) in [(f.episode, f.user, f.what) for f in findings if f.scene == AT[1]]
    assert {f.episode for f in findings} == {AT[0]}
    assert all(f.expected != f.found for f in findings)


def test_a_flipped_bit_is_found(data: Path) -> None:
    file = RunDirectory(DatasetDirectory(data).episode(1)).segment(0)
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 4
    file.write_bytes(content)
    (finding,) = found(data)
    assert (finding.episode, finding.what) == (1, "recording")
    assert "recording-0000.mcap" in finding.found


def test_a_missing_episode_is_found(data: Path) -> None:
    shutil.rmtree(DatasetDirectory(data).episode(1))
    (finding,) = found(data)
    assert (finding.episode, finding.what) == (1, "recording")


def test_an_episode_that_was_never_played_and_one_too_many_are_found(data: Path) -> None:
    catalogue = Catalogue(DatasetDirectory(data).catalogue, writable=True)
    catalogue.forget([1])
    catalogue.add_failure(1, "2026-11-24", "agent 'agent' failed", "here")
    catalogue.close()
    findings = [(f.episode, f.what, f.found) for f in found(data)]
    assert findings == [
        (1, "episode", "none; it failed: agent 'agent' failed"),
        (1, "episode", "a recording"),
    ]


def test_a_segment_that_is_cut_is_found(data: Path) -> None:
    file = RunDirectory(DatasetDirectory(data).episode(1)).segment(0)
    file.write_bytes(file.read_bytes()[:-2000])
    (finding,) = found(data)
    assert (finding.episode, finding.what, finding.expected) == (1, "recording", "a whole recording")


def edit(data: Path, sql: str) -> None:
    with sqlite3.connect(DatasetDirectory(data).catalogue) as connection:
        assert connection.execute(sql).rowcount == 1


@pytest.mark.parametrize(
    ("sql", "scene", "user", "what"),
    [
        (
            "UPDATE users SET x_m = x_m + 1 WHERE episode = 1 AND scene = 2 AND rx = 'car/rx'",
            2,
            "car/rx",
            "users.x_m",
        ),
        (
            "UPDATE users SET los = 0 WHERE episode = 1 AND scene = 2 AND rx = 'car/rx'",
            2,
            "car/rx",
            "users.los",
        ),
        (
            "UPDATE products SET bytes = 1 WHERE episode = 1 AND scene = 2 AND topic = 'link'",
            2,
            "",
            "products.bytes",
        ),
        ("UPDATE episodes SET digest = 'x' WHERE episode = 1", None, "", "episodes.digest"),
        ("DELETE FROM scenes WHERE episode = 1 AND scene = 2", None, "", "scenes"),
    ],
)
def test_a_row_that_was_edited_is_found(
    sql: str, scene: int | None, user: str, what: str, data: Path
) -> None:
    edit(data, sql)
    (finding,) = found(data)
    assert (finding.episode, finding.scene, finding.user, finding.what) == (
        1,
        scene,
        user,
        f"catalogue: {what}",
    )


def test_a_shifted_stamp_and_a_scene_that_is_missing_are_found(data: Path) -> None:
    folder = DatasetDirectory(data).episode(1)
    recording = Recording(folder)

    def again(frames: list[Frame]) -> list[tuple[int | None, str, str]]:
        shutil.rmtree(folder)
        record(folder, frames, assets={})
        catalogue = Catalogue(DatasetDirectory(data).catalogue, writable=True)
        catalogue.add(rows_of(Recording(folder)), {})
        catalogue.close()
        return [(f.scene, f.what, f.found) for f in found(data)]

    def frames(without: int, shift_ns: int) -> list[Frame]:
        made = []
        for one in recording.frames():
            inputs = tuple(
                product(p.provenance.topic, p.provenance.source, p.payload, one.number) for p in one.products
            )
            t_ns = one.t_ns + (shift_ns if one.number == SCENES - 1 else 0)
            made.append(
                Frame(episode=1, number=one.number, t_ns=t_ns, inputs=inputs, seed=1, service="recorder")
            )
        return [one for one in made if one.number != without]

    shifted, lacking, short = frames(-1, 5_000_000), frames(2, 0), frames(3, 0)
    assert (3, "stamp", "305000000 ns") in again(shifted)
    assert (None, "scenes", "0, 1, 2") in again(short)
    ((_, what, said),) = again(lacking)
    assert (what, "frame 3" in said, "follows frame 1" in said) == ("recording", True, True)


def test_a_folder_that_is_no_dataset_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="is no dataset"):
        found(tmp_path)


@pytest.mark.slow
@pytest.mark.channel
def test_a_ray_traced_set_is_clean_and_a_wrong_line_of_sight_is_found(tmp_path: Path) -> None:
    data = generated(tmp_path / "d", "canyon-fixed")
    from caviar_services.world.scenery import scenery_assets

    for name, content in scenery_assets("sionna:simple_street_canyon").items():
        file = DatasetDirectory(data).assets / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content if isinstance(content, bytes) else content.read_bytes())
    assert found(data) == []
    rewritten(data, "channel", of_channel(los=lambda c: changed(c.los, (0, 4), lambda los: not los)))
    findings = [f for f in found(data) if f.what == "line of sight"]
    assert [(f.episode, f.scene, f.user) for f in findings][:1] == [(*AT, "rx4")]


def test_the_command_says_what_is_wrong_and_fails(data: Path, tmp_path: Path) -> None:
    runner = CliRunner()
    clean = runner.invoke(app, ["verify", str(data)])
    assert (clean.exit_code, clean.output.strip().splitlines()[-1]) == (0, f"{data}: nothing is wrong")
    edit(data, "UPDATE users SET los = 0 WHERE episode = 1 AND scene = 2 AND rx = 'car/rx'")
    wrong = runner.invoke(app, ["verify", str(data), "--json", str(tmp_path / "f.json")])
    assert wrong.exit_code != 0
    assert "catalogue: users.los" in " ".join(wrong.output.split())
    assert json.loads((tmp_path / "f.json").read_text()) == [
        {
            "episode": 1,
            "scene": 2,
            "user": "car/rx",
            "what": "catalogue: users.los",
            "expected": "True",
            "found": "0",
        }
    ]


def test_a_product_that_is_held_is_no_fault(data: Path) -> None:
    """It is that of an earlier scene, in which positions were others."""
    folder = DatasetDirectory(data).episode(1)
    recording = Recording(folder)
    frames = []
    earlier: dict[str, Payload] = {}
    for one in recording.frames():
        held = {"channel", "link"} if one.number == 3 else set()
        inputs = tuple(
            product(p.provenance.topic, p.provenance.source, p.payload, one.number)
            if p.provenance.topic not in held
            else product(
                p.provenance.topic,
                p.provenance.source,
                earlier[p.provenance.topic],
                2,
                Status.HELD,
                used_in=3,
            )
            for p in one.products
        )
        earlier = {p.provenance.topic: p.payload for p in one.products}
        frames.append(frame(one.number, *inputs, episode=1, seed=one.entry.seed))
    shutil.rmtree(folder)
    record(folder, frames, assets={})
    catalogue = Catalogue(DatasetDirectory(data).catalogue, writable=True)
    catalogue.add(rows_of(Recording(folder)), {})
    catalogue.close()
    assert found(data) == []
