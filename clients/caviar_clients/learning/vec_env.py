"""Vector environments for Stable-Baselines3, whose ``VecEnv`` is not gymnasium's ``VectorEnv``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from caviar_protocol.errors import ScenarioError, SetupError
from caviar_protocol.host import install_command

Envs = VectorEnv[Any, Any, Any]
Infos = list[dict[str, Any]]


def stable_baselines3_env(envs: Envs) -> Any:
    """Make a ``VecEnv`` of Stable-Baselines3 of a vector environment.

    At the end of an episode ``infos`` have ``terminal_observation`` and ``TimeLimit.truncated``, so that the
    value of the last state is not lost where an episode is over by its length alone. Wrap the result in
    ``VecMonitor`` for the means of rewards that training prints.

    Args:
        envs: Made with ``autoreset_mode="SameStep"``, since Stable-Baselines3 expects the first observation
            of the next episode in the last step of one.

    Returns:
        A ``stable_baselines3.common.vec_env.VecEnv``; closing it closes ``envs``.

    Raises:
        ScenarioError: ``envs`` begin episodes in another way.
        SetupError: Stable-Baselines3 is not installed; the text has the command.

    Example:
        >>> import gymnasium
        >>> from stable_baselines3 import PPO
        >>> options = {"scenario": "geometric", "observe": ("aod",), "autoreset_mode": "SameStep"}
        >>> envs = gymnasium.make_vec("caviar:caviar/BeamSelection-v0", num_envs=8, **options)
        >>> model = PPO("MultiInputPolicy", stable_baselines3_env(envs), n_steps=16, gamma=0.0)
        >>> model.learn(128).num_timesteps
        128
        >>> envs.close()
    """
    mode = envs.metadata.get("autoreset_mode")
    if mode is not AutoresetMode.SAME_STEP:
        raise ScenarioError(
            f"the environments begin episodes by {mode}, and Stable-Baselines3 needs "
            f'{AutoresetMode.SAME_STEP}; make them with autoreset_mode="{AutoresetMode.SAME_STEP.value}"'
        )
    return _vec_env_class()(envs)


@cache
def _vec_env_class() -> Any:
    try:
        from stable_baselines3.common.vec_env import VecEnv
    except ImportError as error:
        raise SetupError(f"Stable-Baselines3 is not installed; run: {install_command('learning')}") from error

    class StableBaselines3Env(VecEnv):  # type: ignore[misc]  # Stable-Baselines3 is not looked at
        """A vector environment as Stable-Baselines3 has them."""

        def __init__(self, envs: Envs) -> None:
            self.envs = envs
            self._actions: Any = None
            super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

        def reset(self) -> Any:
            seeds = self._seeds if any(seed is not None for seed in self._seeds) else None
            options = next((chosen for chosen in self._options if chosen), None)
            observation, infos = self.envs.reset(seed=seeds, options=options)
            # Both are for one reset.
            self._reset_seeds()
            self._reset_options()
            self.reset_infos = _one_by_one(infos, self.num_envs)
            return observation

        def step_async(self, actions: NDArray[Any]) -> None:
            self._actions = actions

        def step_wait(self) -> tuple[Any, NDArray[np.float32], NDArray[np.bool_], Infos]:
            observation, rewards, terminations, truncations, infos = self.envs.step(self._actions)
            found, dones = _one_by_one(infos, self.num_envs), terminations | truncations
            for member, last in enumerate(_last_infos(infos, self.num_envs)):
                if dones[member]:
                    self.reset_infos[member] = found[member]
                    found[member] = {**last, "terminal_observation": infos["final_obs"][member]}
                found[member]["TimeLimit.truncated"] = bool(truncations[member] and not terminations[member])
            return observation, rewards.astype(np.float32), dones, found

        def close(self) -> None:
            self.envs.close()

        # A member is a row of arrays, and no object with attributes and methods of its own.

        def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
            return [getattr(self.envs, attr_name) for _ in self._get_indices(indices)]

        def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
            raise AttributeError(f"{attr_name!r} cannot be set: members are computed together")

        def env_method(self, method_name: str, *args: Any, indices: Any = None, **options: Any) -> list[Any]:
            raise AttributeError(f"{method_name!r} cannot be called: members are computed together")

        def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
            return [False for _ in self._get_indices(indices)]

    return StableBaselines3Env


_OF_THE_END = ("final_obs", "final_info")


def _one_by_one(infos: Mapping[str, Any], count: int) -> Infos:
    """The information of each member, without masks and what is of an episode that ended."""
    columns = {n: v for n, v in infos.items() if not n.startswith("_") and n not in _OF_THE_END}
    return [
        {name: value[member] for name, value in columns.items() if infos[f"_{name}"][member]}
        for member in range(count)
    ]


def _last_infos(infos: Mapping[str, Any], count: int) -> Sequence[dict[str, Any]]:
    """The information of the last step of each member whose episode ended."""
    return _one_by_one(infos["final_info"], count) if "final_info" in infos else [{}] * count
