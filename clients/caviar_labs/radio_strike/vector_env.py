"""Many environments of Radio-Strike computed as one batch, for `gymnasium.make_vec`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from caviar_clients.envs.arguments import checked_members, checked_seeds, whole_numbers
from caviar_labs.radio_strike.env import (
    action_space,
    episode_option,
    make_simulation,
    observation_space,
)
from caviar_labs.radio_strike.rules import BEAMS, USERS, RulesName
from caviar_labs.radio_strike.simulation import OBSERVED, Outcome
from caviar_labs.radio_strike.sources import Source
from caviar_protocol.arrays import BoolArray, Float64Array
from caviar_protocol.errors import RunError, ScenarioError

_MODES = (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP)
_NAMES = np.array(USERS, object)


class RadioStrikeVectorEnv(VectorEnv[Float64Array, NDArray[np.int64], NDArray[Any]]):
    """``num_envs`` environments of Radio-Strike, whose steps are computed together.

    Member i has the numbers of a single environment of its seed, to the last bit, whatever ``num_envs`` is.
    With ``reset(seed=s)`` the seed of member i is s + i. ``info`` is laid out as gymnasium does it: arrays by
    name, and beside each the mask of the members that have it, after an underscore.

    Args:
        num_envs: Number of members.
        autoreset_mode: ``AutoresetMode.NEXT_STEP`` (or its value): a member that ended is reset in the next
            step, its action without effect; ``SAME_STEP``: in the same step, with the last observation in
            ``info["final_obs"]``.
        rules: As all others of `caviar_labs.radio_strike.env.RadioStrikeEnv`.
        episodes: See ``rules``.
        users: See ``rules``.
        base_station: See ``rules``.
        steps: See ``rules``.

    Raises:
        ScenarioError: An argument or an episode file is wrong.

    Example:
        >>> import gymnasium
        >>> envs = gymnasium.make_vec("caviar:caviar/RadioStrike-v0", num_envs=64)
        >>> observations, infos = envs.reset(seed=1)
        >>> observations, rewards, terminated, truncated, infos = envs.step(envs.action_space.sample())
        >>> observations.shape, rewards.shape
        ((64, 7), (64,))
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  # as gymnasium has it

    def __init__(
        self,
        num_envs: int = 1,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        rules: RulesName = "fixed",
        episodes: Source | Iterable[Source] | None = None,
        users: Sequence[str] | None = None,
        base_station: str | None = None,
        steps: int | None = None,
    ) -> None:
        super().__init__()
        num_envs = checked_members(num_envs)
        values = [mode.value for mode in _MODES]
        if autoreset_mode not in _MODES and autoreset_mode not in values:
            raise ScenarioError(f"autoreset_mode={autoreset_mode!r}; write one of {', '.join(values)}")
        self.num_envs = num_envs
        self.render_mode = None
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self._simulation = make_simulation(rules, episodes, users, base_station, steps, num_envs)
        self.single_action_space, self.single_observation_space = action_space(), observation_space()
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._random: list[np.random.Generator] = []
        self._seeds: list[int] = []
        self._ended = np.zeros(num_envs, np.bool_)

    @property  # type: ignore[misc]  # as SyncVectorEnv has it
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """The generator of each member."""
        return tuple(self._random)

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """The seed of each member."""
        return tuple(self._seeds)

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return len(self._simulation.library)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Float64Array, dict[str, Any]]:
        """Begin an episode in all members.

        Args:
            seed: Of member 0, that of member i is i more; or one of each, where None leaves the member's
                random numbers as they are.
            options: As of the single environment, for all members.

        Raises:
            ScenarioError: The number of seeds is not that of members, or an option is wrong.
        """
        seeds = checked_seeds(seed, self.num_envs)
        game, episode = self._simulation, episode_option(options, self._simulation)
        first_time = not self._random
        if first_time:
            self._random = [np.random.default_rng(0)] * self.num_envs
            self._seeds = [0] * self.num_envs
        for member, one in enumerate(seeds):
            anew = first_time or one is not None
            if anew:
                self._random[member], self._seeds[member] = seeding.np_random(one)
                game.seed(member, self._random[member], self._seeds[member])
            if anew or game.rules.resets:
                game.begin(member, episode)
        self._ended[:] = False
        every = np.ones(self.num_envs, np.bool_)
        return self._first(every), self._laid_out(self._episode_of(every), every)

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[Float64Array, Float64Array, BoolArray, BoolArray, dict[str, Any]]:
        """Play a slot in all members.

        Args:
            actions: User and beam of each, Shape ``[num_envs, 2]``.

        Raises:
            PayloadError: The actions are no whole numbers of this shape.
            ScenarioError: There is no such user or beam; names the member.
            RunError: `reset` was never called, or, with ``legacy``, the last episode is over.
        """
        users, beams = self._checked(actions)
        if self._ended.any():
            # Only with NEXT_STEP: these begin an episode, the others play.
            return self._reset_and_step(users, beams)
        return self._returned(self._simulation.step(users, beams), users)

    def best_beam_step(
        self, users: NDArray[np.int64]
    ) -> tuple[Float64Array, Float64Array, BoolArray, BoolArray, dict[str, Any]]:
        """Play a slot with the beams that are best in it, which no agent can know.

        Args:
            users: The one that each member schedules, Shape ``[num_envs]``.

        Returns:
            As `step`; ``info["best_beam"]`` has the beams.

        Raises:
            RunError: `reset` was never called, or a member ended in the step before and is to be reset in
                this one.
        """
        given = whole_numbers(users, (self.num_envs,))
        chosen, _ = self._checked(np.stack([given, np.zeros_like(given)], axis=1))
        if self._ended.any():
            raise RunError("a member has ended; call reset(), or take AutoresetMode.SAME_STEP")
        return self._returned(self._simulation.step(chosen, None), chosen, is_best=True)

    # --- parts of a step ----------------------------------------------------------------------------------

    def _checked(self, actions: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        if not self._random:
            raise RunError("no episode has begun; call reset()")
        given = whole_numbers(actions, (self.num_envs, 2))
        users, beams = given.astype(np.int64).T.copy()
        # As unsigned numbers negative ones are large: one comparison finds both.
        if (users.view(np.uint64) >= len(USERS)).any() or (beams.view(np.uint64) >= BEAMS).any():
            wrong = (users < 0) | (users >= len(USERS)) | (beams < 0) | (beams >= BEAMS)
            member = int(wrong.argmax())
            raise ScenarioError(
                f"action {given[member].tolist()} of member {member} is not in {self.single_action_space}"
            )
        return users, beams

    def _returned(
        self, outcome: Outcome, users: NDArray[np.int64], is_best: bool = False
    ) -> tuple[Float64Array, Float64Array, BoolArray, BoolArray, dict[str, Any]]:
        ended = outcome.terminated | outcome.truncated
        values = _info(outcome, users)
        if is_best:
            values["best_beam"] = outcome.beam
        observation = outcome.observation
        if self.autoreset_mode is AutoresetMode.NEXT_STEP or not ended.any():
            self._ended = ended if self.autoreset_mode is AutoresetMode.NEXT_STEP else self._ended
            info = self._laid_out(values, np.ones(self.num_envs, np.bool_))
        else:
            observation, info = self._reset_now(observation, values, ended)
        return observation, outcome.reward, outcome.terminated, outcome.truncated, info

    def _reset_now(
        self, observation: Float64Array, values: dict[str, NDArray[Any]], ended: BoolArray
    ) -> tuple[Float64Array, dict[str, Any]]:
        """Reset members that ended in this step."""
        self._begin(ended)
        final = np.full(self.num_envs, None, object)
        for member in np.flatnonzero(ended).tolist():
            final[member] = observation[member].copy()
        info: dict[str, Any] = {"final_obs": final, "_final_obs": ended.copy()}
        of_ended = {name: array[ended] for name, array in values.items()}
        info |= {"final_info": self._laid_out(of_ended, ended), "_final_info": ended.copy()}
        info |= self._laid_out(self._episode_of(ended), ended)
        if not ended.all():
            info |= self._laid_out({name: array[~ended] for name, array in values.items()}, ~ended)
        return np.where(ended[:, None], self._first(ended), observation), info

    def _reset_and_step(
        self, users: NDArray[np.int64], beams: NDArray[np.int64]
    ) -> tuple[Float64Array, Float64Array, BoolArray, BoolArray, dict[str, Any]]:
        """Reset the members that ended in the step before, and play a slot in the others."""
        reset = self._ended
        self._begin(reset)
        observation, info = self._first(reset), self._laid_out(self._episode_of(reset), reset)
        reward = np.zeros(self.num_envs)
        terminated, truncated = np.zeros((2, self.num_envs), np.bool_)
        playing = np.flatnonzero(~reset)
        if len(playing):
            outcome = self._simulation.step(users[playing], beams[playing], playing)
            observation[playing], reward[playing] = outcome.observation, outcome.reward
            terminated[playing], truncated[playing] = outcome.terminated, outcome.truncated
            info |= self._laid_out(_info(outcome, users[playing]), ~reset)
        self._ended = terminated | truncated
        return observation, reward, terminated, truncated, info

    def _begin(self, members: BoolArray) -> None:
        if self._simulation.rules.resets:
            for member in np.flatnonzero(members).tolist():
                self._simulation.begin(member)

    def _first(self, members: BoolArray) -> Float64Array:
        """First observations of members that were reset, Shape ``[num_envs, 7]``; zeros for the others."""
        observation = np.zeros((self.num_envs, OBSERVED))
        if self._simulation.rules.resets:
            for member in np.flatnonzero(members).tolist():
                observation[member] = self._simulation.first_observation(member)
        return observation

    def _episode_of(self, members: BoolArray) -> dict[str, NDArray[Any]]:
        return {"episode": self._simulation.episode[members, 0]}

    def _laid_out(self, values: dict[str, NDArray[Any]], members: BoolArray) -> dict[str, Any]:
        """Info of some members, as gymnasium lays it out.

        Args:
            values: Of these members alone, by name.
            members: Shape ``[num_envs]``.
        """
        info: dict[str, Any] = {}
        masks = np.empty((len(values), self.num_envs), np.bool_)
        masks[:] = members
        for mask, (name, array) in zip(masks, values.items(), strict=True):
            if len(array) < self.num_envs:
                spread = np.zeros(self.num_envs, array.dtype)
                if array.dtype == object:
                    spread[:] = None
                spread[members] = array
                array = spread
            info[name], info[f"_{name}"] = array, mask
        return info


def _info(outcome: Outcome, users: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
    # Copies: the values are columns of the observation, which the caller may change.
    values = {name: array.copy() for name, array in outcome.info().items()}
    return values | {"chosen_ue": _NAMES[users]}
