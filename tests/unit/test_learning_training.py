"""Trainings: interrupted anywhere they lead to the same policy; curves, checkpoints, exported policies."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caviar_clients.learning import training
from caviar_clients.learning.campaign import _differences, check_folder, reached, train_experiment
from caviar_clients.learning.checkpoints import locked, newest_checkpoint
from caviar_clients.learning.experiment import Experiment, parse_experiment
from caviar_clients.learning.training import LinearRate, Progress, read_result, train_seed
from caviar_protocol.errors import RunError, ScenarioError
from caviar_protocol.scenario import find_scenario
from caviar_services.agent.policy import PolicyModel

pytest.importorskip("stable_baselines3")
pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

pytestmark = pytest.mark.slow

FRAMES, STEPS = 10, 160


@pytest.fixture(autouse=True)
def _reports_of_each_step(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training, "REPORT_S", 0.0)


@pytest.fixture
def short(tmp_path: Path) -> Path:
    """`geometric` with episodes of 10 frames."""
    path = tmp_path / "short.toml"
    path.write_text(find_scenario("geometric").read_text().replace("frames = 500", f"frames = {FRAMES}"))
    return path


def experiment(
    scenario: Path | str,
    algorithm: str = 'name = "dqn"\nlearning_starts = 20',
    members: int = 1,
    folder: Path | None = None,
) -> Experiment:
    return parse_experiment(
        f"""
        [experiment]
        name = "beams"
        seeds = [1, 2]
        steps = {STEPS}
        checkpoint_steps = 35
        [environment]
        id = "caviar/BeamSelection-v0"
        members = {members}
        [environment.options]
        scenario = "{scenario}"
        observe = ["position", "last_beam"]
        [algorithm]
        {algorithm}
        learning_rate = 1e-3
        final_learning_rate = 1e-4
        [features.position]
        scale = 60.0
        waves = 3
        """,
        "my.toml",
        folder,
    )


class KilledError(Exception):
    """What ends a training in a test."""


def end_at(wanted: Experiment, folder: Path, steps: int) -> list[int]:
    """Begin or go on to train seed 1, and end that after so many steps; returns the steps that were told."""
    told = []

    def report(progress: Progress) -> None:
        told.append(progress.steps)
        if progress.steps >= steps:
            raise KilledError

    with pytest.raises(KilledError):
        train_seed(wanted, 1, folder, report)
    return told


def begin(wanted: Experiment, root: Path) -> Path:
    """Begin to train an experiment, and end that after its first steps; returns its folder."""

    def report(progress: Progress) -> None:
        if progress.steps:
            raise KilledError

    with pytest.raises(KilledError):
        train_experiment(wanted, root, report=report)
    return root / wanted.experiment.name


ALGORITHMS = [
    ('name = "dqn"\nlearning_starts = 20\nbuffer_size = 60', 1),
    ('name = "dqn"\nlearning_starts = 20', 3),
    ('name = "ppo"\nn_steps = 16\nbatch_size = 16', 2),
    ('name = "a2c"', 2),
]


@pytest.mark.parametrize(("algorithm", "members"), ALGORITHMS)
def test_an_interrupted_training_leads_to_the_same_policy(
    algorithm: str, members: int, short: Path, tmp_path: Path
) -> None:
    """Replay buffer, optimizer, rates and random numbers go on as they were: the exported files are equal."""
    wanted = experiment(short, algorithm, members)
    whole = train_seed(wanted, 1, tmp_path / "whole")
    for steps in (50, 100):
        end_at(wanted, tmp_path / "parts", steps)
    parts = train_seed(wanted, 1, tmp_path / "parts")
    assert whole.steps >= STEPS
    assert whole.policy
    assert (parts.policy, parts.steps, parts.mean_reward) == (whole.policy, whole.steps, whole.mean_reward)


def test_a_training_goes_on_from_its_checkpoint_and_a_finished_one_is_skipped(
    short: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = experiment(short)
    assert end_at(wanted, tmp_path / "beams", 60)[0] == 0
    newest = newest_checkpoint(tmp_path / "beams" / "seed-1" / "checkpoints")
    assert newest is not None
    assert int(newest.name) == 36  # after 35 steps, when those of the last four are trained on
    assert reached(wanted, tmp_path) == {1: 36, 2: 0}
    with np.load(newest / "replay_buffer.npz") as buffer:
        assert buffer["rewards"].shape == (36, 1)
        assert buffer["observations/position"].any()
    assert end_at(wanted, tmp_path / "beams", 100)[0] == 36
    train_seed(wanted, 1, tmp_path / "beams")
    monkeypatch.setattr(training, "make_envs", lambda _: pytest.fail("trained again"))
    assert train_seed(wanted, 1, tmp_path / "beams").steps == STEPS


def test_a_draft_of_a_checkpoint_is_not_read(short: Path, tmp_path: Path) -> None:
    """As a process leaves one that is killed while it writes."""
    wanted = experiment(short)
    checkpoints = tmp_path / "beams" / "seed-1" / "checkpoints"
    draft = checkpoints / "000000000090.partial"
    draft.mkdir(parents=True)
    (draft / "model.zip").write_bytes(b"half")
    assert newest_checkpoint(checkpoints) is None
    assert end_at(wanted, tmp_path / "beams", 70)[0] == 0
    assert train_seed(wanted, 1, tmp_path / "beams").steps == STEPS
    assert [path.name for path in checkpoints.iterdir()] == [f"{STEPS:012d}"]


def test_a_damaged_checkpoint_is_named_with_the_remedy(short: Path, tmp_path: Path) -> None:
    wanted = experiment(short)
    end_at(wanted, tmp_path, 60)
    newest = newest_checkpoint(tmp_path / "seed-1" / "checkpoints")
    assert newest is not None
    (newest / "replay_buffer.npz").write_bytes(b"PK damaged")
    with pytest.raises(RunError, match=r"checkpoint .* cannot be read"):
        train_seed(wanted, 1, tmp_path)


def curves_of(file: Path) -> dict[str, tuple[int, float]]:
    """Last step and number of each tag of an event file: a length, 4 bytes, the event, and 4 bytes."""
    from tensorboardX.proto.event_pb2 import Event

    data, found = file.read_bytes(), {}
    while data:
        end = 12 + int.from_bytes(data[:8], "little")
        event, data = Event.FromString(data[12:end]), data[end + 4 :]
        found |= {value.tag: (event.step, value.simple_value) for value in event.summary.value}
    return found


def test_the_policy_has_its_card_and_the_curves_those_of_the_library(short: Path, tmp_path: Path) -> None:
    wanted = experiment(short, members=3)
    result = train_seed(wanted, 2, tmp_path)
    mine = tmp_path / "seed-2"
    model = PolicyModel(mine / "policy.onnx")
    assert model.digest == result.policy
    card = model.card
    assert card is not None
    assert (set(card.observe), card.codebooks) == ({"position", "last_beam"}, ((64, 1),))
    assert (card.algorithm, card.seeds, card.steps) == ("Stable-Baselines3 DQN", (2,), result.steps)
    assert card.figures == {"mean_reward": pytest.approx(result.mean_reward)}
    (file,) = (mine / "curves").iterdir()
    curves = curves_of(file)
    assert {"rollout/ep_rew_mean", "train/loss", "beams/abs_y", "beams/los_beam", "beams/optimum"} <= set(
        curves
    )
    assert 0 < curves["beams/abs_y"][1] <= curves["beams/optimum"][1]
    assert STEPS // 2 < curves["beams/abs_y"][0] <= result.steps


def test_seeds_differ_and_episodes_of_training_leave_low_seeds_free(short: Path, tmp_path: Path) -> None:
    wanted = experiment(short, members=5)
    assert train_seed(wanted, 1, tmp_path).policy != train_seed(wanted, 2, tmp_path).policy
    seeds = {training._chunk_seed(seed, steps) for seed in range(20) for steps in range(0, 1000, 100)}
    assert len(seeds) == 200
    assert min(seeds) >= 2**30
    assert max(seeds) < 2**31


def test_an_environment_without_beams_is_trained_without_a_policy_file(tmp_path: Path) -> None:
    text = """
        experiment = { name = "pole", seeds = [1], steps = 128 }
        environment = { id = "CartPole-v1", members = 2 }
        algorithm = { name = "ppo", n_steps = 32, batch_size = 32 }
        """
    (result,) = train_experiment(parse_experiment(text), tmp_path)
    assert result.policy is None
    assert sorted(path.name for path in (tmp_path / "pole" / "seed-1").iterdir()) == [
        "checkpoints", "curves", "lock", "model.zip", "result.json",
    ]  # fmt: skip


def test_a_folder_of_other_values_is_refused_with_the_values(short: Path, tmp_path: Path) -> None:
    wanted = experiment(short)
    begin(wanted, tmp_path)
    begin(wanted, tmp_path)
    changed = experiment(short, 'name = "dqn"\nlearning_starts = 30')
    with pytest.raises(RunError, match="learning_starts was 20 and is 30") as refused:
        check_folder(changed, tmp_path)
    assert "remove" not in str(refused.value)
    short.write_text(short.read_text().replace("components = 3", "components = 2"))
    with pytest.raises(RunError, match="the file of the scenario is another one"):
        check_folder(wanted, tmp_path)


def test_a_text_that_is_nearly_that_of_before_is_named() -> None:
    before = {"environment": {"options": {"observe": ["aoa", "last_abs_y"], "reward": "abs_y"}}}
    now = {"environment": {"options": {"observe": ["aoa", "lasst_abs_y"], "reward": "snr_db"}}}
    assert list(_differences(before, now)) == [
        "environment.options.observe[1] was 'last_abs_y' and is 'lasst_abs_y' (did you mean 'last_abs_y'?)",
        "environment.options.reward was 'abs_y' and is 'snr_db'",
    ]


def test_a_folder_that_has_moved_with_its_scenario_is_gone_on_with(
    tmp_path: Path,
) -> None:
    before, after = tmp_path / "before", tmp_path / "after"
    (before / "scenarios").mkdir(parents=True)
    text = find_scenario("geometric").read_text().replace("frames = 500", f"frames = {FRAMES}")
    (before / "scenarios" / "short.toml").write_text(text)
    begin(experiment("file:scenarios/short.toml", folder=before), before / "training")
    before.rename(after)
    moved = experiment("file:scenarios/short.toml", folder=after)
    assert str(after) in moved.environment.options["scenario"]
    begin(moved, after / "training")
    (after / "scenarios" / "short.toml").rename(after / "short.toml")
    with pytest.raises(RunError, match=r"'file:scenarios/short\.toml'.*'file:short\.toml'"):
        check_folder(experiment("file:short.toml", folder=after), after / "training")


@pytest.mark.parametrize("jobs", [1, 2])
def test_an_experiment_that_is_refused_before_its_first_step_leaves_no_folder(
    jobs: int, short: Path, tmp_path: Path
) -> None:
    refused = experiment(short, 'name = "ppo"\nn_steps = 1\nbatch_size = 1')  # one advantage has no spread
    with pytest.raises(ScenarioError, match="algorithm: PPO of"):
        train_experiment(refused, tmp_path / "deep" / "training", jobs)
    assert not (tmp_path / "deep").exists()
    # A folder that was there stays, with what is in it.
    folder = begin(experiment(short, 'name = "ppo"\nn_steps = 16\nbatch_size = 16'), tmp_path)
    kept = sorted(folder.rglob("*"))
    with pytest.raises(RunError, match="was begun with other values"):
        train_experiment(refused, tmp_path, jobs)
    assert sorted(folder.rglob("*")) == kept


def test_an_experiment_is_trained_by_one_command_at_a_time(short: Path, tmp_path: Path) -> None:
    wanted = experiment(short)
    seen = []

    def report(_: Progress) -> None:
        if not seen:
            with pytest.raises(RunError) as refused:
                train_experiment(wanted, tmp_path)
            seen.append(str(refused.value))
            raise KilledError

    with pytest.raises(KilledError):
        train_experiment(wanted, tmp_path, report=report)
    assert seen == [
        f"'beams' in {tmp_path / 'beams'} is being trained by process {os.getpid()}; wait for it, or end it"
    ]
    begin(wanted, tmp_path)  # the lock ended with the command, and what it made is gone


def test_a_seed_is_trained_by_one_process_at_a_time(
    short: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "PATIENCE_S", 0.0)
    (tmp_path / "seed-1").mkdir()
    with (
        locked(tmp_path / "seed-1" / "lock", "seed 1"),
        pytest.raises(RunError, match=f"seed 1 is being trained by process {os.getpid()}"),
    ):
        train_seed(experiment(short), 1, tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (
            '"last_beam"',
            '"last_bean"',
            "my.toml:13: environment.options.observe: no observation is called 'last_bean'",
        ),
        ("features.position", "features.positon", "my.toml:16: features.positon: 'positon' is not observed"),
        (
            "scale = 60.0",
            "scale = [60.0, 1.0]",
            "features.position.scale: has 2 numbers, and 'position' has 3",
        ),
        ("observe =", "reward = 3\nobserve =", "no reward is called 3"),
    ],
)
def test_what_the_environment_does_not_take_is_named_with_its_place(
    old: str, new: str, expected: str, short: Path, tmp_path: Path
) -> None:
    text = f"""
        [experiment]
        name = "beams"
        seeds = [1]
        steps = 100

        [environment]
        id = "caviar/BeamSelection-v0"
        members = 2

        [environment.options]

        scenario = "{short}"
        observe = ["position", "last_beam"]
        [algorithm]
        name = "dqn"
        [features.position]
        scale = 60.0
        """
    with pytest.raises(ScenarioError) as refused:
        train_seed(parse_experiment(text.replace(old, new).strip(), "my.toml"), 1, tmp_path)
    assert expected in str(refused.value)


def test_an_encoding_of_one_user_where_there_are_several_is_answered_with_the_option(tmp_path: Path) -> None:
    text = """
        experiment = { name = "two", seeds = [1], steps = 200 }
        algorithm = { name = "dqn" }
        features = { position = { scale = [50.0, 50.0, 20.0] } }
        [environment]
        id = "caviar/BeamSelection-v0"
        options = { scenario = "smoke", observe = ["position"] }
        """
    with pytest.raises(ScenarioError) as refused:
        train_experiment(parse_experiment(text), tmp_path)
    expected = (
        "'position' has 6; 3 for each of 2 users. Choose these by the option `users` below "
        '[environment.options], as users = ["car/rx"] of car/rx, uav/rx-uav; or write one for all'
    )
    assert expected in str(refused.value)
    chosen = text.replace('"position"] }', '"position"], users = ["car/rx"] }')
    assert check_folder(parse_experiment(chosen), tmp_path)
    training.make_envs(parse_experiment(chosen)).close()


def test_an_algorithm_that_does_not_fit_the_actions_is_refused(tmp_path: Path) -> None:
    text = """
        experiment = { name = "pendulum", seeds = [1], steps = 128 }
        environment = { id = "Pendulum-v1" }
        algorithm = { name = "dqn" }
        """
    with pytest.raises(ScenarioError, match=r"algorithm: DQN of .*Discrete"):
        train_seed(parse_experiment(text), 1, tmp_path)


def test_the_learning_rate_falls_over_the_whole_experiment() -> None:
    rate = LinearRate(1e-3, 1e-4)
    assert [rate(1.0), rate(0.5), rate(0.0)] == pytest.approx([1e-3, 5.5e-4, 1e-4])


@pytest.mark.parametrize("fails", [True, False])
def test_a_network_that_diverges_ends_the_training_before_its_checkpoint(
    fails: bool, short: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import torch

    def diverge(model: Any, *_: object) -> None:
        with torch.no_grad():
            next(model.policy.parameters()).fill_(float("nan"))
        if fails:  # as the distributions of PPO do
            raise ValueError("found invalid values")

    monkeypatch.setattr(training, "_train_chunk", diverge)
    with pytest.raises(RunError, match="seed 1 has diverged"):
        train_seed(experiment(short), 1, tmp_path)
    assert newest_checkpoint(tmp_path / "seed-1" / "checkpoints") is None


def test_a_training_without_enough_memory_says_what_to_make_smaller(
    short: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def allocate(*_: object) -> None:
        raise MemoryError("Unable to allocate 7.28 TiB")

    monkeypatch.setattr(training, "_train_chunk", allocate)
    with pytest.raises(RunError, match=r"more memory .* step 0"):
        train_seed(experiment(short), 1, tmp_path)


def test_a_folder_whose_record_is_gone_is_not_gone_on_with(short: Path, tmp_path: Path) -> None:
    wanted = experiment(short)
    folder = begin(wanted, tmp_path)
    (folder / "experiment.json").unlink()
    with pytest.raises(RunError, match=r"seed-1.*experiment\.json"):
        check_folder(wanted, tmp_path)


def test_a_result_of_another_seed_is_refused(tmp_path: Path) -> None:
    (tmp_path / "seed-1").mkdir()
    (tmp_path / "seed-1" / "result.json").write_text('{"seed": 7, "steps": 1, "digest": "", "seconds": 1}')
    with pytest.raises(RunError, match=r"result\.json.*seed 7.*seed 1"):
        read_result(tmp_path, 1)


def test_a_copy_of_a_checkpoint_is_none(tmp_path: Path) -> None:
    for name in ("000000000035", "000000000070.old", "000000000070 (copy)"):
        (tmp_path / name).mkdir()
    assert newest_checkpoint(tmp_path) == tmp_path / "000000000035"


def test_a_disk_that_is_full_at_the_end_is_named_and_the_checkpoint_stays(
    short: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from stable_baselines3.common.base_class import BaseAlgorithm

    save = BaseAlgorithm.save

    def full(model: Any, path: Path, *others: Any, **options: Any) -> None:
        if path == tmp_path / "seed-1" / "model.zip":
            raise OSError(errno.ENOSPC, "No space left on device")
        save(model, path, *others, **options)

    with monkeypatch.context() as patched:
        patched.setattr(BaseAlgorithm, "save", full)
        with pytest.raises(RunError, match=r"model\.zip: No space left"):
            train_seed(experiment(short), 1, tmp_path)
    assert train_seed(experiment(short), 1, tmp_path).steps >= STEPS
