"""An exported policy makes the choices of the library that trained it, served as the agent serves it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

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
