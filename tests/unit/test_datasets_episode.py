"""An episode of a dataset: its recording depends on scenario, seed and number alone."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from caviar_clients.datasets import episode as episodes
from caviar_clients.datasets.directory import DatasetDirectory, writing_dataset
from caviar_clients.datasets.episode import EpisodeTask, play_episode
from caviar_clients.datasets.estimate import Estimate, Trial, check_disk, estimate
from caviar_clients.datasets.plan import plan_dataset
from caviar_clients.datasets.settings import differences, fingerprint
from caviar_clients.session.base import failure_of
from caviar_clients.session.embedded import EmbeddedRun
from caviar_clients.session.prepared import prepare
from caviar_protocol.errors import RunError, ScenarioError
from caviar_protocol.recording import Recording
from caviar_protocol.scenario import Scenario, load_scenario, parse_scenario
from caviar_services.agent.baselines import RandomAgent
from caviar_services.service import Frame, StepResult

pytestmark = pytest.mark.slow

SMOKE = Path(__file__).parents[2] / "deploy" / "caviar_scenarios" / "smoke.toml"


class Fails(RandomAgent):
    """Fails in a frame."""

    def step(self, frame: Frame) -> StepResult:
        if frame.number == 2:
            raise ValueError("the agent has no answer")
        return super().step(frame)


def _endless(depth: int) -> int:
    return _endless(depth + 1) + 1


class FailsBy(RandomAgent):
    """Fails in a frame by what `how` raises."""

    how: Callable[[], object] = list

    def step(self, frame: Frame) -> StepResult:
        type(self).how()
        return super().step(frame)


def _raise(error: BaseException) -> None:
    raise error


def dataset(
    tmp_path: Path, scenario: Scenario | None = None, episodes: int = 4, scenes: int = 3
) -> list[bytes]:
    """Play the episodes into a folder; the bytes of their recordings."""
    directory = DatasetDirectory(tmp_path)
    plan = plan_dataset(scenario or load_scenario(SMOKE), episodes=episodes, scenes=scenes)
    with writing_dataset(directory):
        for number in reversed(range(episodes)):
            assert play_episode(EpisodeTask(plan.scenario, number, str(tmp_path))).error == ""
    return [
        directory.episode(number).joinpath("recording-0000.mcap").read_bytes() for number in range(episodes)
    ]


def test_the_bytes_of_an_episode_do_not_depend_on_folder_order_or_number_of_episodes(tmp_path: Path) -> None:
    first = dataset(tmp_path / "one" / "deeper")
    copied = tmp_path / "moved"
    copied.mkdir()
    (copied / "again.toml").write_text(SMOKE.read_text())
    second = dataset(tmp_path / "two", load_scenario(copied / "again.toml"), episodes=6)
    assert first == second[:4]
    assert len({bytes(content) for content in first}) == 4


def test_an_episode_is_that_of_a_run_of_many(tmp_path: Path) -> None:
    """Product for product: only what differs from run to run is left out."""
    dataset(tmp_path / "d")
    text = SMOKE.read_text().replace("frames = 100\n", "frames = 3\nepisodes = 4\n", 1)
    folder = tmp_path / "run"
    folder.mkdir()
    assert EmbeddedRun(prepare(parse_scenario(text)), folder).run().error == ""
    whole = Recording(folder)
    for number in range(4):
        episode = Recording(DatasetDirectory(tmp_path / "d").episode(number))
        assert [frame.episode for frame in episode.frames()] == [number] * 3
        for frame in episode.frames():
            of_run = whole.frame(number, frame.number)
            assert frame.entry.seed == of_run.entry.seed
            assert [p.digest for p in frame.products] == [p.digest for p in of_run.products]


def test_a_scene_of_the_episode_before_changes_no_byte(tmp_path: Path) -> None:
    """Bodies are made where more objects come than there is room for, and stay for the next episode."""
    pytest.importorskip("sionna.rt")
    pytest.importorskip("libsumo")
    scenario = load_scenario("canyon-mobile", ["services.channel.settings.pool={car=1, truck=1, bus=1}"])
    plan = plan_dataset(scenario, episodes=3, scenes=2)
    found = []
    for order in ((0, 1, 2), (2, 1, 0)):
        out = tmp_path / str(order[0])
        episodes._scenes.clear()
        with writing_dataset(DatasetDirectory(out)):
            for number in order:
                assert play_episode(EpisodeTask(plan.scenario, number, str(out))).error == ""
                ((_, scene),) = episodes._scenes
        assert scene.bodies_version > 0
        found.append(
            [(folder / "recording-0000.mcap").read_bytes() for folder in sorted(out.glob("episodes/*"))]
        )
    assert len(found[0]) == 3
    assert found[0] == found[1]


def test_what_differs_from_run_to_run_stands_in_no_recording(tmp_path: Path) -> None:
    dataset(tmp_path, episodes=1)
    recording = Recording(DatasetDirectory(tmp_path).episode(0))
    assert (recording.metadata.started, recording.metadata.machine) == ("", {})
    assert [
        report.measured for frame in recording.frames() for report in frame.reports if report.measured
    ] == []
    assert str(tmp_path) not in str(recording.metadata)
    assert "/" not in str(recording.metadata.scenario["services"])


def test_a_twin_leaves_the_recording_that_is_there(tmp_path: Path) -> None:
    dataset(tmp_path, episodes=1)
    plan = plan_dataset(load_scenario(SMOKE), episodes=1, scenes=3)
    before = DatasetDirectory(tmp_path).episode(0).stat().st_ino
    result = play_episode(EpisodeTask(plan.scenario, 0, str(tmp_path)))
    assert result.rows is not None
    assert result.rows.episode[:2] == (0, 3)
    assert DatasetDirectory(tmp_path).episode(0).stat().st_ino == before
    assert not DatasetDirectory(tmp_path).work.exists()


def test_an_episode_that_fails_leaves_nothing_and_says_why(tmp_path: Path) -> None:
    text = SMOKE.read_text().replace('use = "los-beam"', f'use = "{__name__}:Fails"', 1)
    plan = plan_dataset(parse_scenario(text), episodes=1, scenes=3)
    with writing_dataset(DatasetDirectory(tmp_path)):
        result = play_episode(EpisodeTask(plan.scenario, 0, str(tmp_path)))
    assert result.rows is None
    assert "the agent has no answer" in result.error
    assert "frame 2" in result.error
    assert DatasetDirectory(tmp_path).finished() == []
    assert not DatasetDirectory(tmp_path).work.exists()
    assert logging.getLogger("caviar.service").level == logging.NOTSET, "as it was"


@pytest.mark.parametrize(
    ("how", "said"),
    [
        (lambda: _raise(MemoryError()), "MemoryError (at "),
        (lambda: _endless(0), "RecursionError: maximum recursion depth exceeded (at "),
        (lambda: _raise(KeyboardInterrupt()), "it raised KeyboardInterrupt (at "),
        (lambda: _raise(ValueError("I will\n  not\n")), "ValueError: I will / not (at "),
        (lambda: _raise(SystemExit(3)), "it called sys.exit(3) (at "),
    ],
)
def test_an_agent_that_fails_is_named_with_its_line(
    tmp_path: Path, how: Callable[[], object], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a thread, as tasks of Dask are: Ctrl-C of a terminal never comes there."""
    monkeypatch.setattr(FailsBy, "how", staticmethod(how))
    text = SMOKE.read_text().replace('use = "los-beam"', f'use = "{__name__}:FailsBy"', 1)
    plan = plan_dataset(parse_scenario(text), episodes=1, scenes=3)
    task = EpisodeTask(plan.scenario, 0, str(tmp_path))
    with writing_dataset(DatasetDirectory(tmp_path)), ThreadPoolExecutor(1) as thread:
        error = thread.submit(play_episode, task).result().error
    assert "agent 'agent' failed in frame 0" in error
    assert said in error
    assert re.search(r"test_datasets_episode\.py:\d+ in \w+\)$", error)


def test_ctrl_c_of_a_terminal_is_no_failure_of_an_agent() -> None:
    with pytest.raises(KeyboardInterrupt):
        failure_of(KeyboardInterrupt())


def test_two_commands_do_not_write_one_dataset(tmp_path: Path) -> None:
    directory = DatasetDirectory(tmp_path)
    with (
        writing_dataset(directory),
        pytest.raises(RunError, match="another process writes the dataset"),
        writing_dataset(directory),
    ):
        pass


def test_what_a_killed_command_left_half_written_is_removed(tmp_path: Path) -> None:
    directory = DatasetDirectory(tmp_path)
    (directory.work / "3-abc" / "episode-000003").mkdir(parents=True)
    with writing_dataset(directory):
        assert list(directory.work.iterdir()) == []
        (directory.work / "4-abc").mkdir()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["episodes"]


def interrupted(directory: DatasetDirectory, *begun: str, elsewhere: bool = True) -> None:
    with writing_dataset(directory, elsewhere=elsewhere):
        for name in begun:
            (directory.work / name).mkdir()
        raise KeyboardInterrupt


def test_what_workers_elsewhere_still_write_is_left_after_a_fault(tmp_path: Path) -> None:
    directory = DatasetDirectory(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        interrupted(directory, "4-abc")
    assert [path.name for path in directory.work.iterdir()] == ["4-abc"]
    with pytest.raises(KeyboardInterrupt):
        interrupted(directory, "5-abc", elsewhere=False)
    assert not directory.work.exists()


def test_a_folder_that_is_named_nearly_like_an_episode_is_refused(tmp_path: Path) -> None:
    directory = DatasetDirectory(tmp_path)
    for name in ("episode-000009", "episode-1000000", ".hidden", "notes"):
        (directory.episodes / name).mkdir(parents=True)
    assert directory.finished() == [9, 1000000]
    for name in ("episode-9", "episode-0000009", "episode-9999999999999999999", "episode-000009.old"):
        (directory.episodes / name).mkdir()
        with pytest.raises(RunError, match=rf"{name} is named like an episode.*episode-000009 for number 9"):
            directory.finished()
        (directory.episodes / name).rmdir()


def test_a_scenario_that_makes_no_dataset_is_refused() -> None:
    text = SMOKE.read_text()
    elsewhere = parse_scenario(text.replace('use = "free-space"', 'use = "remote"', 1))
    with pytest.raises(ScenarioError, match="'channel' is a service elsewhere"):
        plan_dataset(elsewhere, episodes=1)
    text = text.replace('record = ["scene", "channel", "action", "link"]\n', "", 1)
    without = parse_scenario(text[: text.index("[services.recorder]")] + text[text.index("[[devices]]") :])
    with pytest.raises(ScenarioError, match=r"one recorder.*\[services.recorder\]"):
        plan_dataset(without, episodes=1)


def test_a_dataset_is_told_from_another_by_what_its_bytes_follow_from() -> None:
    scenario = load_scenario(SMOKE)
    same = plan_dataset(scenario, episodes=2, scenes=3).settings()
    more = plan_dataset(scenario, episodes=9, scenes=3).settings()
    other = plan_dataset(scenario, episodes=2, scenes=3, seed=7).settings()
    assert fingerprint(same) == fingerprint(more) != fingerprint(other)
    assert list(differences(same, other)) == ["run.seed was 1, is 7"]


def test_topics_that_are_not_named_are_not_recorded(tmp_path: Path) -> None:
    named = 'record = ["scene", "channel", "action", "link"]'
    for names, topics in (
        (["scene", "link"], ("link", "scene")),
        ([], ("action", "channel", "link", "scene")),
    ):
        out = tmp_path / f"{len(names)}"
        text = SMOKE.read_text().replace(named, f"record = {names}".replace("'", '"'), 1)
        dataset(out, parse_scenario(text), episodes=1)
        recording = Recording(DatasetDirectory(out).episode(0))
        assert tuple(sorted(recording.topics)) == topics
        assert {p.provenance.topic for frame in recording.frames() for p in frame.products} == {*topics}
        assert recording.run_digest().damage == ()


def test_an_estimate_has_a_part_for_the_episode_and_one_for_each_scene() -> None:
    trials = [Trial(9.0, scenes=(1, 3), wall_s=(1.0, 2.0), bytes=(1000, 3000))] * 2
    assert estimate(trials, episodes=10, scenes=5) == Estimate(wall_s=15.0, bytes=50_000)
    single = Trial(9.0, scenes=(1, 1, 1), wall_s=(1.0, 2.0, 3.0), bytes=(1000, 1000, 4000))
    assert estimate([single], episodes=10, scenes=1) == Estimate(wall_s=20.0, bytes=20_000)


def test_a_disk_that_is_too_small_is_refused_with_both_figures(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"1.05e\+06 TB.*[\d.]+ .B are free"):
        check_disk(tmp_path, 10**18)
