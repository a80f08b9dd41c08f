"""``caviar dataset verify``: a clean set has no finding, and each planted fault is found at its place."""

from __future__ import annotations

import importlib.util
import json
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from recording_builders import PERIOD_NS, absent, frame, product, record
from typer.testing import CliRunner

from caviar_clients.cli.main import app
from caviar_clients.datasets.catalogue import Catalogue
from caviar_clients.datasets.directory import DatasetDirectory, writing_dataset
from caviar_clients.datasets.episode import EpisodeTask, play_episode
from caviar_clients.datasets.estimate import try_worker
from caviar_clients.datasets.plan import plan_dataset
from caviar_clients.datasets.rows import rows_of
from caviar_clients.datasets.verification import Finding, gaps
from caviar_clients.datasets.verification.physics import PhysicsChecks
from caviar_clients.datasets.verification.verify import lacking_scenery, verify
from caviar_protocol.arrays import Payload
from caviar_protocol.errors import RecordingError
from caviar_protocol.messages import Status
from caviar_protocol.recording import Recording
from caviar_protocol.run_directory import RunDirectory
from caviar_protocol.scenario import Scenario, load_scenario
from caviar_protocol.space.ply import read_ply
from caviar_protocol.topics import Channel, Lidar, Link
from caviar_services.service import Frame

pytestmark = pytest.mark.slow

EPISODES, SCENES = 3, 4
AT = 1, 2
"""Episode and scene of a fault."""


def generated(out: Path, scenario: str | Scenario) -> Path:
    directory = DatasetDirectory(out)
    loaded = load_scenario(scenario) if isinstance(scenario, str) else scenario
    plan = plan_dataset(loaded, episodes=EPISODES, scenes=SCENES)
    with writing_dataset(directory):
        catalogue = Catalogue(directory.catalogue, writable=True)
        catalogue.plan(plan.settings(), EPISODES)
        assert not try_worker(plan.scenario, str(out), [0, 0, 0], {}).error  # has the scenery in its place
        for number in range(EPISODES):
            result = play_episode(EpisodeTask(plan.scenario, number, str(out)))
            assert result.rows is not None, result.error
            catalogue.add(result.rows, result.measured)
        catalogue.close()
    return out


def test_foliage_does_not_hide_a_line_of_sight(tmp_path: Path) -> None:
    scenario = load_scenario("district")
    scenery = Path(str(scenario.services["traffic"].settings["scenery"]).removeprefix("file:"))
    shutil.copytree(scenery.parent / "meshes", tmp_path / "scenery" / "meshes")
    shutil.copy(scenery, tmp_path / "scenery")
    services = {"channel": {"role": "channel", "settings": scenario.services["channel"].settings}}
    crown = read_ply(scenery.parent / "meshes" / "foliage-trees.ply")[0][:8].mean(0)
    along = np.array([0.0, 3.0, 0.0])
    for known, is_hidden in ((services, False), ({}, True)):
        checks = PhysicsChecks(tmp_path, {"scenario": {"services": known}})
        assert checks._surfaces is not None
        assert checks._surfaces.between(crown - along, crown + along) is is_hidden


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return generated(tmp_path_factory.mktemp("clean") / "d", "smoke")


@pytest.fixture
def data(clean: Path, tmp_path: Path) -> Path:
    """A copy to plant a fault in."""
    shutil.copytree(clean, tmp_path / "d")
    return tmp_path / "d"


Change = Callable[[Any], Payload | None]
"""A product from the one that was recorded; None: it is absent."""


def rewritten(
    data: Path,
    changes: dict[str, Change],
    scene: int = AT[1],
    *,
    seed: int = 1,
    stated: int = 1,
    of_episode: int = AT[0],
) -> None:
    """Record an episode anew, with other products in one scene, and list it: only its content can tell.

    Args:
        data: Folder of the dataset.
        changes: By topic.
        scene: In which they are.
        seed: Of all scenes.
        stated: Seed that the metadata have.
        of_episode: Whose products it has.
    """
    recording = Recording(DatasetDirectory(data).episode(of_episode))
    frames = []
    for one in recording.frames():
        inputs = []
        for item in one.products:
            topic, source, payload = item.provenance.topic, item.provenance.source, item.payload
            if topic in changes and one.number == scene:
                payload = changes[topic](payload)
            inputs.append(
                absent(topic, source, f"{source} produced none")
                if payload is None
                else product(topic, source, payload, one.number)
            )
        frames.append(frame(one.number, *inputs, episode=AT[0], seed=seed))
    replaced(data, frames, stated)


def replaced(data: Path, frames: list[Frame], seed: int = 1) -> None:
    """Have another recording of the episode, and its rows in the catalogue."""
    folder = DatasetDirectory(data).episode(AT[0])
    shutil.rmtree(folder)
    record(folder, frames, assets={}, compression="zstd", seed=seed)
    assert len(Recording(folder)) == len(frames)
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
    rewritten(data, {})
    assert found(data) == []


PATH_AXES = {
    "id": 0, "a": 1, "tau": 0, "aod": 0, "aoa": 0, "doppler": 1, "interactions": 0, "points": 0, "objects": 0
}  # fmt: skip
"""Fields of a channel with a row for each path, and which axis that is."""


def doubled_h(channel: Channel) -> Channel:
    return replace(channel, h=tuple(replace(one, h=2 * one.h) for one in channel.h))


def with_columns(link: Link, order: list[int], *fields: str) -> Link:
    """The link with its columns of best pairs in another order."""
    columns = np.r_[order, len(order) : link.top_abs_y.shape[1]]
    return replace(link, **{name: getattr(link, name)[:, columns] for name in fields})


TOP = ("top_tx_beam", "top_rx_beam", "top_abs_y")

CONTENT: dict[str, tuple[dict[str, Change], str, str]] = {
    "the sign of an angle": (
        {"channel": of_channel(aod=lambda c: changed(c.aod, (0, 1), lambda a: -a))},
        "car/rx",
        "aod of path 0 (direct)",
    ),
    "3 dB too much gain": (
        {"channel": of_channel(a=lambda c: changed(c.a, (0, 0), lambda a: a * 10 ** (3 / 20)))},
        "car/rx",
        "gain of path 0 (direct), mmwave",
    ),
    "3 dB too little gain": (
        {"channel": of_channel(a=lambda c: changed(c.a, (0, 0), lambda a: a * 10 ** (-3 / 20)))},
        "car/rx",
        "gain of the line of sight, mmwave",
    ),
    "a delay too short": (
        {"channel": of_channel(tau=lambda c: changed(c.tau, 0, lambda tau: tau * 0.99))},
        "car/rx",
        "delay of path 0 (direct)",
    ),
    "a Doppler shift of the other sign": (
        {"channel": of_channel(doppler=lambda c: -c.doppler)},
        "car/rx",
        "Doppler shift of path 0 (direct), mmwave",
    ),
    "a free line of sight without a path": (
        {
            "channel": of_channel(
                offsets=lambda c: np.maximum(c.offsets - 1, 0),
                **{
                    name: lambda c, name=name, axis=axis: np.delete(getattr(c, name), 0, axis)
                    for name, axis in PATH_AXES.items()
                },
            )
        },
        "car/rx",
        "line of sight",
    ),
    "a free line of sight that is said to be hidden, in all products": (
        {
            "channel": of_channel(los=lambda c: changed(c.los, (0, 0), False)),
            "link": lambda link: replace(link, los=changed(link.los, 0, False)),
        },
        "car/rx",
        "line of sight",
    ),
    "a line of sight that the link has otherwise": (
        {"link": lambda link: replace(link, los=changed(link.los, 0, False))},
        "car/rx",
        "line of sight of the link",
    ),
    "another carrier": (
        {"channel": of_channel(carriers=lambda c: (replace(c.carriers[0], frequency_hz=30e9),))},
        "",
        "carriers of the channel",
    ),
    "swapped beams": (
        {"link": lambda link: replace(link, top_tx_beam=link.top_tx_beam[:, ::-1].copy())},
        "car/rx",
        "best pair of beams",
    ),
    "the best pair and the second one, swapped in all columns": (
        {"link": lambda link: with_columns(link, [1, 0], *TOP)},
        "car/rx",
        "best pair of beams",
    ),
    "the second pair and the third one, swapped in all columns": (
        {"link": lambda link: with_columns(link, [0, 2, 1], *TOP)},
        "car/rx",
        "pair of beams of rank 2",
    ),
    "the second pair is the best one again": (
        {"link": lambda link: with_columns(link, [0, 0], *TOP)},
        "car/rx",
        "pair of beams of rank 2",
    ),
    "the beams of both ends, exchanged": (
        {"link": lambda link: replace(link, top_tx_beam=link.top_rx_beam, top_rx_beam=link.top_tx_beam)},
        "car/rx",
        "best pair of beams",
    ),
    "a beam that the codebook does not have": (
        {"link": lambda link: replace(link, top_tx_beam=changed(link.top_tx_beam, (0, 0), 32))},
        "car/rx",
        "best pair of beams",
    ),
    "a chosen beam that is not that of its |y|": (
        {"link": lambda link: replace(link, tx_beam=(link.tx_beam + 1) % 32)},
        "car/rx",
        "chosen pair of beams",
    ),
    "an SNR of 3 dB more": (
        {"link": lambda link: replace(link, snr_best=2 * link.snr_best)},
        "car/rx",
        "SNR of the best pair",
    ),
    "the H of another user": (
        {
            "channel": of_channel(
                h=lambda c: (replace(c.h[0], h=c.h[0].h * np.exp(1j * np.arange(32))), *c.h[1:])
            )
        },
        "car/rx",
        "best pair of beams",
    ),
    "H, |y| and SNR, all as of twice the amplitude": (
        {
            "channel": doubled_h,
            "link": lambda link: replace(
                link,
                abs_y=2 * link.abs_y,
                top_abs_y=2 * link.top_abs_y,
                baseline_abs_y=2 * link.baseline_abs_y,
                snr=4 * link.snr,
                snr_best=4 * link.snr_best,
            ),
        },
        "car/rx",
        "H, mmwave",
    ),
    "an object that jumps ahead by the width of a lane": (
        {"scene": lambda scene: replace(scene, position=changed(scene.position, (0, 0), lambda x: x + 3.7))},
        "car",
        "movement since the scene before",
    ),
    "an object that jumps": (
        {"scene": lambda scene: replace(scene, position=changed(scene.position, (0, 1), lambda y: y + 30.0))},
        "car",
        "movement since the scene before",
    ),
    "a topic that is absent": ({"channel": lambda channel: None}, "", "product channel of channel"),
    "a mesh that is not there": (
        {"scene": lambda scene: replace(scene, assets=("objects/hearse.ply", *scene.assets[1:]))},
        "",
        "file of car",
    ),
}


@pytest.mark.parametrize("fault", CONTENT)
def test_a_fault_of_the_content_is_found_at_its_place(fault: str, data: Path) -> None:
    changes, user, what = CONTENT[fault]
    rewritten(data, changes)
    findings = found(data)
    assert (AT[0], user, what) in [(f.episode, f.user, f.what) for f in findings if f.scene == AT[1]]
    assert {f.episode for f in findings} == {AT[0]}
    assert all(f.expected != f.found for f in findings)


def test_a_topic_that_no_scene_has_is_found(data: Path) -> None:
    frames = [
        frame(
            one.number,
            *(
                product(p.provenance.topic, p.provenance.source, p.payload, one.number)
                for p in one.products
                if p.provenance.topic != "action"
            ),
            episode=one.episode,
            seed=1,
        )
        for one in Recording(DatasetDirectory(data).episode(1)).frames()
    ]
    replaced(data, frames)
    findings = [(f.scene, f.what, f.found) for f in found(data)]
    assert findings == [(0, "product action", "none in scenes 0–3 (4)")]


def test_seeds_that_are_not_those_of_the_dataset_are_found(data: Path) -> None:
    rewritten(data, {}, seed=2, stated=3)
    assert [(f.episode, f.scene, f.what, f.expected, f.found) for f in found(data)] == [
        (1, None, "seed of the recording", "1", "3"),
        (1, 0, "seed", "1", "2 in scenes 0–3 (4)"),
    ]
    edit(data, "UPDATE episodes SET seed = 1 WHERE episode = 1")
    assert ("catalogue: episodes.seed", "2", "1") in [(f.what, f.expected, f.found) for f in found(data)]


def test_a_flipped_bit_is_found(data: Path) -> None:
    file = RunDirectory(DatasetDirectory(data).episode(1)).segment(0)
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 4
    file.write_bytes(content)
    (finding,) = found(data)
    assert (finding.episode, finding.what) == (1, "recording")
    assert "recording-0000.mcap" in finding.found
    folder = DatasetDirectory(data).episode(1)
    assert finding.found.endswith(f"remove {folder}, and the generate command plays the episode again")


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
        (1, "episode", "episode 1 failed: agent 'agent' failed"),
        (1, "episode", "episode 1; the generate command adds what is whole"),
    ]


def test_episodes_that_are_missing_are_one_line_whatever_their_number(data: Path) -> None:
    catalogue = Catalogue(DatasetDirectory(data).catalogue, writable=True)
    catalogue.plan(catalogue.settings, 10**7)
    for number in (5, 6, 8):
        catalogue.add_failure(number, "2026-11-24", "agent 'agent' failed", "here")
    catalogue.close()
    assert [(f.episode, f.what, f.found) for f in found(data)] == [
        (
            3,
            "episode",
            "episodes 3–4, 7, 9–9999999 (9,999,994) are missing: run the generate command again",
        ),
        (5, "episode", "episodes 5–6, 8 (3) failed: agent 'agent' failed"),
    ]


def test_gaps_cost_what_is_there_and_not_what_is_planned() -> None:
    assert gaps(range(0, 2000, 2), 10**18)[-1] == range(1999, 10**18)
    assert gaps([-3, 7], 3) == [range(3)]


def test_an_episode_beyond_those_that_are_planned_is_found(data: Path) -> None:
    catalogue = Catalogue(DatasetDirectory(data).catalogue, writable=True)
    catalogue.plan(catalogue.settings, 2)
    catalogue.close()
    (finding,) = found(data)
    assert (finding.episode, finding.expected) == (2, "episodes 0 to 1 as planned")


def test_a_segment_that_is_cut_is_found(data: Path) -> None:
    file = RunDirectory(DatasetDirectory(data).episode(1)).segment(0)
    file.write_bytes(file.read_bytes()[:-2000])
    (finding,) = found(data)
    assert (finding.episode, finding.what, finding.expected) == (1, "recording", "a whole recording")


def edit(data: Path, sql: str) -> None:
    with sqlite3.connect(DatasetDirectory(data).catalogue) as connection:
        assert connection.execute(sql).rowcount == 1


COPY_OF_CAR = """
INSERT INTO users
SELECT 7, scene, carrier, tx, rx, object, object_class, 0, 0, 0, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0
FROM users {OF_CAR}"""
OF_CAR = "WHERE episode = 1 AND scene = 2 AND rx = 'car/rx'"


@pytest.mark.parametrize(
    ("sql", "scene", "user", "what", "said"),
    [
        ("UPDATE users SET x_m = x_m + 1 {OF_CAR}", 2, "car/rx", "users.x_m", ""),
        ("UPDATE users SET los = 0 {OF_CAR}", 2, "car/rx", "users.los", "0"),
        ("UPDATE users SET gain_db = 9e999 {OF_CAR}", 2, "car/rx", "users.gain_db", "inf"),
        ("UPDATE users SET snr_db = -9e999 {OF_CAR}", 2, "car/rx", "users.snr_db", "-inf"),
        ("UPDATE users SET delay_s = NULL {OF_CAR}", 2, "car/rx", "users.delay_s", "None"),  # as of NaN
        ("UPDATE scenes SET t_s = 9e999 WHERE episode = 1 AND scene = 2", 2, "", "scenes.t_s", "inf"),
        (
            "UPDATE products SET bytes = 1 WHERE episode = 1 AND scene = 2 AND topic = 'link'",
            2,
            "",
            "products.bytes",
            "1",
        ),
        ("UPDATE episodes SET digest = 'x' WHERE episode = 1", None, "", "episodes.digest", "x"),
        ("DELETE FROM scenes WHERE episode = 1 AND scene = 2", 2, "", "scenes", "none"),
        ("DELETE FROM users {OF_CAR}", 2, "car/rx", "users (mmwave, bs)", "none"),
        ("INSERT INTO scenes VALUES (1, 4, 0.4, 1, 1, 1, 1, 'x')", 4, "", "scenes", "a row"),
        ("INSERT INTO scenes VALUES (7, 3, 0.4, 1, 1, 1, 1, 'x')", 3, "", "scenes", "1 row without it"),
        (
            "INSERT INTO products VALUES (7, 1, 'link', 'link', 'fresh', 1, 'x')",
            1,
            "",
            "products",
            "1 row without it",
        ),
        (
            COPY_OF_CAR,
            2,
            "car/rx",
            "users",
            "1 row without it",
        ),
        ("UPDATE timings SET wall_s = 9e999 WHERE episode = 1", None, "", "timings.wall_s", "inf"),
    ],
)
def test_a_row_that_was_edited_is_found(
    sql: str, scene: int | None, user: str, what: str, said: str, data: Path
) -> None:
    edit(data, sql.replace("{OF_CAR}", OF_CAR))
    (finding,) = found(data)
    assert (finding.scene, finding.user, finding.what) == (scene, user, f"catalogue: {what}")
    assert finding.episode == (7 if "without it" in said else 1)
    assert said in ("", finding.found)


def test_every_column_that_differs_is_named_with_how_many_rows_do(data: Path) -> None:
    with sqlite3.connect(DatasetDirectory(data).catalogue) as connection:
        connection.execute("UPDATE users SET y_m = 9e999, abs_y = 9e999 WHERE episode = 1")
    assert [(f.scene, f.user, f.what, f.found) for f in found(data)] == [
        (0, "car/rx", "catalogue: users.y_m", "inf (and 7 more)"),
        (0, "car/rx", "catalogue: users.abs_y", "inf (and 7 more)"),
    ]


def test_scenery_and_meshes_that_are_missing_are_found(data: Path, tmp_path: Path) -> None:
    assets = DatasetDirectory(data).assets
    meshes = sorted(file.relative_to(assets).as_posix() for file in assets.rglob("*.ply"))
    assert meshes
    shutil.rmtree(assets)
    lacking = found(data)
    assert {f.expected for f in lacking} == {f"assets/{name} in the dataset" for name in meshes}
    assert {(f.episode, f.scene) for f in lacking} == {(number, 0) for number in range(EPISODES)}


def test_a_scenery_without_one_of_its_files_is_named(tmp_path: Path) -> None:
    xml = tmp_path / "scenery" / "town.xml"
    xml.parent.mkdir()
    xml.write_text(
        '<scene version="3.0.0"><shape type="ply" id="wall">'
        '<string name="filename" value="meshes/wall.ply"/></shape></scene>'
    )
    world = {"role": "world", "use": "trajectory", "settings": {"scenery": "file:town.xml"}}
    settings = {"scenario": {"services": {"world": world}}}
    (finding,) = lacking_scenery(settings, {"scenery/town.xml": xml})
    assert (finding.episode, finding.what) == (-1, "scenery")
    assert "meshes/wall.ply" in finding.found
    (finding,) = lacking_scenery(settings, {})
    assert (finding.expected, finding.found) == ("the file assets/scenery/town.xml in the dataset", "none")
    bundled = {"world": {**world, "settings": {"scenery": "sionna:munich"}}}
    assert [f.found for f in lacking_scenery({"scenario": {"services": bundled}}, {})] == ["none"]


@pytest.mark.parametrize(
    ("sql", "said"),
    [
        ("UPDATE dataset SET value = 'x' WHERE key = 'settings'", "settings in table dataset"),
        ("UPDATE dataset SET value = '[]' WHERE key = 'settings'", "settings in table dataset"),
        ("UPDATE dataset SET value = '1e9' WHERE key = 'episodes'", "episodes in table dataset is '1e9'"),
        (
            "UPDATE dataset SET value = json_set(value, '$.scenario.services', 7) WHERE key = 'settings'",
            "$.scenario.services",
        ),
    ],
)
def test_a_catalogue_that_is_none_is_an_error_that_names_the_place(sql: str, said: str, data: Path) -> None:
    edit(data, sql)
    with pytest.raises(RecordingError) as caught:
        found(data)
    assert said in str(caught.value)
    assert str(DatasetDirectory(data).catalogue) in str(caught.value)


def test_a_catalogue_without_a_column_is_named(data: Path) -> None:
    with sqlite3.connect(DatasetDirectory(data).catalogue) as connection:
        connection.execute("ALTER TABLE users DROP COLUMN gain_db")
    with pytest.raises(RecordingError, match="table users has no column gain_db"):
        found(data)


def test_a_shifted_stamp_and_a_scene_that_is_missing_are_found(data: Path) -> None:
    folder = DatasetDirectory(data).episode(1)
    recording = Recording(folder)

    def again(frames: list[Frame]) -> list[tuple[int | None, str, str]]:
        replaced(data, frames)
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
    assert found(data) == []
    rewritten(data, {"channel": of_channel(los=lambda c: changed(c.los, (0, 4), lambda los: not los))})
    findings = [f for f in found(data) if f.what == "line of sight"]
    assert [(f.episode, f.scene, f.user) for f in findings][:1] == [(*AT, "rx4")]


@pytest.fixture(scope="module")
def scanned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Traffic in a street, with noisy LIDARs on ten vehicles; every second scan has its points."""
    scenario = load_scenario("canyon-mobile")
    services = dict(scenario.services)
    services["channel"] = replace(services["channel"], use="free-space", settings={})
    noise = {"use": "gaussian", "range_std_m": 0.05}
    settings = {**services["lidar"].settings, "points_every": 2, "noise": noise}
    services["lidar"] = replace(services["lidar"], settings=settings)
    run = replace(scenario.run, sampling_period_ns=PERIOD_NS)  # that of `frame`
    scenario = replace(scenario, run=run, services=services)
    return generated(tmp_path_factory.mktemp("scanned") / "d", scenario)


def cells(lidar: Lidar, sensor: int) -> Any:
    grid = lidar.scans[sensor].grid
    assert grid is not None
    return grid.occupancy


def mirrored_obstacles(lidar: Lidar, sensor: int, other: Lidar) -> Any:
    """Antennas stay where they are."""
    marks = np.minimum(cells(lidar, sensor), 0)
    return np.where(marks < 0, marks, np.maximum(cells(lidar, sensor)[:, ::-1], 0))


GRIDS: dict[str, tuple[Callable[[Lidar, int, Lidar], Any], str]] = {
    "mirrored along the street": (lambda lidar, i, other: cells(lidar, i)[::-1], "TX in the LIDAR grid"),
    "mirrored across it": (mirrored_obstacles, "obstacles of the LIDAR grid"),
    "of another user": (lambda lidar, i, other: cells(lidar, i + 1), "RX in the LIDAR grid"),
    "all zero": (lambda lidar, i, other: np.zeros_like(cells(lidar, i)), "TX in the LIDAR grid"),
    "of another episode": (lambda lidar, i, other: cells(other, i), "RX in the LIDAR grid"),
}
"""Grid of a sensor from the scans of its scene and of another episode, and what is found."""


def with_scan(lidar: Lidar, sensor: int, **fields: Any) -> Lidar:
    scans = list(lidar.scans)
    scans[sensor] = replace(scans[sensor], **fields)
    return replace(lidar, scans=tuple(scans))


@pytest.mark.sumo
@pytest.mark.channel
def test_scans_that_are_not_those_of_their_scene_are_found(scanned: Path, tmp_path: Path) -> None:
    assert found(scanned) == []  # noise included
    data = shutil.copytree(scanned, tmp_path / "d")
    directory = DatasetDirectory(data)
    (other,) = Recording(directory.episode(2)).frame(2, 3).payloads("lidar", Lidar).values()

    def with_other_grids(lidar: Lidar) -> Lidar:
        changed_ones = lidar
        for sensor, (change, _) in enumerate(GRIDS.values()):
            grid = lidar.scans[sensor].grid
            assert grid is not None
            occupancy = np.ascontiguousarray(change(lidar, sensor, other))
            changed_ones = with_scan(changed_ones, sensor, grid=replace(grid, occupancy=occupancy))
        return changed_ones

    def with_mirrored_points(lidar: Lidar) -> Lidar:
        return with_scan(lidar, 7, points=lidar.scans[7].points * np.array([1, -1, 1], np.float32))

    rewritten(data, {"lidar": with_other_grids}, 3)
    rewritten(data, {"lidar": with_mirrored_points}, 2)
    frames = [Recording(directory.episode(1)).frame(1, scene) for scene in (2, 3)]
    names = [[scan.sensor for scan in next(iter(f.payloads("lidar", Lidar).values())).scans] for f in frames]
    findings = found(data)
    assert [(f.episode, f.scene, f.user, f.what) for f in findings] == [
        (1, 2, names[0][7], "points of the LIDAR"),
        *((1, 3, names[1][sensor], what) for sensor, (_, what) in enumerate(GRIDS.values())),
    ]
    assert all(f.expected != f.found for f in findings)


@pytest.mark.sumo
@pytest.mark.channel
def test_scans_are_said_to_be_unchecked_where_no_ray_tracer_is_installed(
    scanned: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    notes: list[str] = []
    assert list(verify(scanned, note=notes.append)) == []
    assert [("LIDAR" in note, "Mitsuba" in note) for note in notes] == [(True, True)]


@pytest.mark.sumo
@pytest.mark.channel
def test_an_episode_that_is_a_copy_of_another_is_found(scanned: Path, tmp_path: Path) -> None:
    data = shutil.copytree(scanned, tmp_path / "d")
    rewritten(data, {"lidar": lambda lidar: lidar}, of_episode=0)
    content = [f for f in found(data) if f.what == "content"]
    assert [(f.episode, f.found) for f in content] == [(1, "those of episode 0")]


def test_episodes_that_are_all_equal_are_no_copies_and_a_note_says_so(clean: Path) -> None:
    notes: list[str] = []
    assert list(verify(clean, note=notes.append)) == []
    assert ["episodes 1–2 (2)" in note for note in notes] == [True]


def test_the_command_says_what_is_wrong_and_fails(data: Path, tmp_path: Path) -> None:
    runner = CliRunner()
    clean = runner.invoke(app, ["dataset", "verify", str(data)])
    assert (clean.exit_code, clean.output.strip().splitlines()[-1]) == (0, f"{data}: nothing is wrong")
    edit(data, "UPDATE users SET los = 0 WHERE episode = 1 AND scene = 2 AND rx = 'car/rx'")
    wrong = runner.invoke(app, ["dataset", "verify", str(data), "--json", str(tmp_path / "f.json")])
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
    replaced(data, frames)
    assert found(data) == []
