"""An exported policy makes the choices of the library that trained it, served as the agent serves it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from numpy.typing import NDArray
from typer.testing import CliRunner

from caviar_clients.cli.main import app
from caviar_clients.envs.base import BeamSelectionEnv
from caviar_clients.learning.export import export_policy
from caviar_services.agent.policy import PolicyModel

stable_baselines3 = pytest.importorskip("stable_baselines3")
pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

pytestmark = pytest.mark.slow

OBSERVATIONS = 10_000
OBSERVED = ("aod", "position", "last_beam", "last_rate")


def drawn(env: BeamSelectionEnv) -> list[dict[str, NDArray[Any]]]:
    """Observations: half over the whole space, half about what the environment shows."""
    draws, space = np.random.default_rng(11), env.observation_space
    space.seed(5)
    env.action_space.seed(5)
    shown = [env.reset(seed=3)[0]]
    while len(shown) < 100:
        shown.append(env.step(env.action_space.sample())[0])
    found = [space.sample() for _ in range(OBSERVATIONS // 2)]
    for number in range(OBSERVATIONS - len(found)):
        near = shown[number % len(shown)]
        found.append({n: (v + draws.normal(0, 0.3, v.shape)).astype(v.dtype) for n, v in near.items()})
    return found


@pytest.mark.parametrize(
    "algorithm",
    ["DQN", *(pytest.param(name, marks=pytest.mark.exhaustive) for name in ("PPO", "A2C"))],
)
def test_ten_thousand_choices_are_those_of_stable_baselines3(algorithm: str, tmp_path: Path) -> None:
    env = BeamSelectionEnv("geometric", observe=OBSERVED)
    library = getattr(stable_baselines3, algorithm)
    more = {"learning_starts": 50} if algorithm == "DQN" else {}
    model = library("MultiInputPolicy", env, seed=1, policy_kwargs={"net_arch": [64, 64]}, **more)
    model.learn(200)
    file = tmp_path / "policy.onnx"
    export_policy(model, env, file)
    served = PolicyModel(file)
    observations = drawn(env)
    found = np.array([served.act(seen) for seen in observations])
    wanted = np.array([np.ravel(model.predict(seen, deterministic=True)[0]) for seen in observations])
    assert (found == wanted).all()
    assert len(np.unique(wanted)) > 3, "the network chooses"


@pytest.mark.parametrize("keys", [None, pytest.param(["position"], marks=pytest.mark.exhaustive)])
def test_the_statistics_of_vec_normalize_are_part_of_the_policy(
    keys: list[str] | None, tmp_path: Path
) -> None:
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    env = BeamSelectionEnv("geometric", observe=OBSERVED)
    envs = VecNormalize(DummyVecEnv([lambda: env]), norm_obs_keys=keys, clip_obs=3.0)
    model = stable_baselines3.PPO("MultiInputPolicy", envs, n_steps=128, seed=1)
    model.learn(128)
    export_policy(model, env, tmp_path / "policy.onnx")
    served = PolicyModel(tmp_path / "policy.onnx")
    observations = drawn(env)
    found = np.array([served.act(seen) for seen in observations])
    rows = {name: np.stack([seen[name] for seen in observations]) for name in observations[0]}
    seen = envs.normalize_obs(rows)
    wanted = np.array(
        [model.predict({n: v[i] for n, v in seen.items()}, deterministic=True)[0] for i in range(len(found))]
    )
    assert (found[:, 0] == wanted).all()
    assert len(np.unique(wanted)) > 3, "the network chooses"
    model.save(tmp_path / "model.zip")
    envs.save(str(tmp_path / "statistics.pkl"))
    names = [str(tmp_path / name) for name in ("model.zip", "again.onnx", "statistics.pkl")]
    command = ["policy", "export", *names[:2], "--algorithm", "ppo", "--on", "geometric"]
    asked = CliRunner().invoke(app, command)
    assert "give --trust if you know who wrote it" in str(asked.exception)
    if keys is None:  # a normalised rate is negative
        lost = CliRunner().invoke(app, [*command, "--trust"])
        assert "outside of its bounds" in str(lost.exception)
    made = CliRunner().invoke(app, [*command, "--trust", "--normalization", names[2]])
    assert made.exit_code == 0, made.exception
    again = PolicyModel(tmp_path / "again.onnx")
    assert all(again.act(seen) == served.act(seen) for seen in observations[::20])


def test_parts_of_sensors_go_into_the_file_with_their_own_types(tmp_path: Path) -> None:
    class Seen(BeamSelectionEnv):
        """An environment that shows a grid and a picture, beside what it has."""

        def __init__(self) -> None:
            super().__init__("geometric", observe=("aod",))
            own = {
                "camera": spaces.Box(0, 255, (36, 40, 3), np.uint8),
                "lidar_grid": spaces.Box(-2, 1, (4, 3, 2), np.int8),
            }
            self.observation_space = spaces.Dict({**own, **self.observation_space.spaces})

        def _observation(self, moment: Any) -> Any:
            return {**self.observation_space.sample(), **super()._observation(moment)}

    env = Seen()
    model = stable_baselines3.PPO("MultiInputPolicy", env, n_steps=64, seed=1)
    card = export_policy(model, env, tmp_path / "policy.onnx")
    served = PolicyModel(tmp_path / "policy.onnx")
    assert card.observe == ("aod", "camera", "lidar_grid")
    assert served.types == {"aod": "tensor(float)", "camera": "tensor(uint8)", "lidar_grid": "tensor(int8)"}
    assert served.inputs["camera"] == (1, 36, 40, 3)
