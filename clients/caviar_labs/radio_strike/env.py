"""``caviar/RadioStrike-v0``: a base station schedules one of three users each slot, and chooses its beam."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeAlias, cast

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from caviar_clients.envs.arguments import whole_numbers
from caviar_labs.radio_strike.rules import BEAMS, USERS, RulesName, rules_of
from caviar_labs.radio_strike.simulation import Library, Outcome, Simulation
from caviar_labs.radio_strike.sources import Source, episode_loaders
from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import RunError, ScenarioError

_LOW = np.array([-1e5, -1e5, -1e5, 0, 0, 0, 0], np.float64)
_HIGH = np.array([1e5, 1e5, 1e5, 1e9, 1e9, 1e9, 1e12], np.float64)


def action_space() -> spaces.MultiDiscrete:
    """User and beam."""
    return spaces.MultiDiscrete([len(USERS), BEAMS])


def observation_space() -> gymnasium.Space[Float64Array]:
    """The seven numbers. The bounds hold; those of the original (1e3 packets sent, 2e4 waiting) do not."""
    # Its own type leaves open which numbers it has.
    return cast(gymnasium.Space[Float64Array], spaces.Box(_LOW, _HIGH, dtype=np.float64))


def make_simulation(
    rules: str,
    episodes: Source | Iterable[Source] | None,
    users: Sequence[str] | None,
    base_station: str | None,
    steps: int | None,
    members: int,
) -> Simulation:
    """Make the game from the arguments of an environment.

    Raises:
        ScenarioError: An argument is wrong; the text has value and remedy.
    """
    chosen = rules_of(rules)
    if steps is not None and not (isinstance(steps, int | np.integer) and steps >= 1):
        raise ScenarioError(f"steps={steps!r}; write a whole number from 1 on")
    if steps is not None and not chosen.resets:
        raise ScenarioError('steps has no effect with rules="legacy", of which no episode ends; leave it out')
    library = Library(episode_loaders(episodes, users, base_station), chosen)
    library.bounds(0)  # so that a wrong file is known now, and not in training
    return Simulation(chosen, library, members, None if steps is None else int(steps))


def episode_option(options: Mapping[str, Any] | None, simulation: Simulation) -> int | None:
    """Number of the episode that ``options`` of a reset ask for.

    Raises:
        ScenarioError: An option is unknown, or there is no such episode.
    """
    given = dict(options or {})
    episode = given.pop("episode", None)
    if given:
        raise ScenarioError(f"options has no {', '.join(map(repr, given))}; there is: episode")
    if episode is None:
        return None
    count = len(simulation.library)
    if not simulation.rules.resets:
        raise ScenarioError('rules="legacy" plays its episodes in order; leave the option episode out')
    if not (isinstance(episode, int | np.integer) and 0 <= episode < count):
        raise ScenarioError(f"episode {episode!r} is not there; write a number from 0 to {count - 1}")
    return int(episode)


Returned: TypeAlias = tuple[Float64Array, float, bool, bool, dict[str, Any]]
"""What a step returns."""


class RadioStrikeEnv(gymnasium.Env[Float64Array, NDArray[np.int64]]):
    """Radio-Strike, the environment of the ITU AI/ML in 5G Challenge 2021 (PS-006), in NumPy.

    In each slot of 10 ms packets arrive for a UAV, a car and a pedestrian; the action schedules one of them
    and chooses one of 64 beams of the base station. Packets of this user are sent, the oldest first; those
    that could not be sent in ten slots are dropped. `caviar_labs.radio_strike` has a table of what
    ``legacy`` and ``fixed`` do.

    **Action**: ``MultiDiscrete([3, 64])``, user and beam.

    **Observation**: float64, Shape ``[7]``: position of the scheduled user (north, east, down of the base
    station) [m], packets of all users that were dropped, packets that were sent, packets of all users that
    waited before, bit rate [bit/s].

    **Reward**: ``(sent − 2·dropped) / (arrived + waited before)`` over all users, −2…1.

    Args:
        rules: ``fixed``, or ``legacy``: the original, bug for bug.
        episodes: Trajectories: an episode file ``ep{N}.csv`` of the challenge or the output file of an agent,
            a folder with episode files, the run directory of a recording or a `Recording`, an `Episode`,
            or several of these. None: 100 made-up episodes. They are read when they are first played.
        users: With a recording: three devices or objects in the places of UAV, car and pedestrian; None:
            its receivers, where there are three.
        base_station: With a recording: device or object; None: its transmitter, where there is one.
        steps: Of an episode at most, with ``fixed``.

    Raises:
        ScenarioError: An argument or an episode file is wrong; the text has value, place and remedy.
        RecordingError: A recording has not what is needed.

    Example:
        >>> import gymnasium
        >>> env = gymnasium.make("caviar:caviar/RadioStrike-v0", rules="fixed")
        >>> observation, info = env.reset(seed=1, options={"episode": 0})
        >>> observation[:3].tolist()  # of the UAV
        [14.0, -28.0, 6.4]
        >>> observation, reward, terminated, truncated, info = env.step([0, 12])
        >>> info["chosen_ue"], -2 <= reward <= 1
        ('uav1', True)
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  # as gymnasium has it

    def __init__(
        self,
        rules: RulesName = "fixed",
        episodes: Source | Iterable[Source] | None = None,
        users: Sequence[str] | None = None,
        base_station: str | None = None,
        steps: int | None = None,
        render_mode: None = None,
    ) -> None:
        if render_mode is not None:
            raise ScenarioError(f"render_mode={render_mode!r}; the environment draws nothing, leave it out")
        self._simulation = make_simulation(rules, episodes, users, base_station, steps, 1)
        self.render_mode = None
        self._begun = self._over = False
        self.action_space = action_space()
        self.observation_space = observation_space()

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return len(self._simulation.library)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float64Array, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: Of all random numbers. With ``legacy`` a seed starts the simulation anew, as the original
                does after ``numpy.random.seed(seed)``, and the numbers are the same; without one nothing
                changes, and zeros are observed.
            options: With ``fixed``: ``{"episode": number}``; by default one is drawn.

        Returns:
            The observation, and ``{"episode": number}``.
        """
        super().reset(seed=seed)
        game, episode = self._simulation, episode_option(options, self._simulation)
        anew = seed is not None or not self._begun
        if anew:
            random = self.np_random  # drawn from the system where there was no seed yet
            game.seed(0, random, self.np_random_seed)
        if anew or game.rules.resets:
            game.begin(0, episode)
        self._begun, self._over = True, False
        return game.first_observation(0), {"episode": int(game.episode[0, 0])}

    def step(
        self, action: NDArray[np.int64] | Sequence[int]
    ) -> tuple[Float64Array, float, bool, bool, dict[str, Any]]:
        """Play a slot.

        Args:
            action: User and beam.

        Raises:
            PayloadError: The action is no two whole numbers.
            ScenarioError: There is no such user or beam.
            RunError: The episode is over, `reset` was never called, or, with ``legacy``, a user is at the end
                of the last episode.
        """
        user, beam = whole_numbers(action, (2,)).tolist()
        if not 0 <= beam < BEAMS:
            raise ScenarioError(f"beam {beam} is not in the codebook; write a number from 0 to {BEAMS - 1}")
        return self._returned(user, self._played(user, np.array([beam])))

    def best_beam_step(self, user: int) -> Returned:
        """Play a slot with the beam that is best in it, which no agent can know, as the original's
        ``B-BeamOracle`` does.

        Args:
            user: The one that is scheduled.

        Returns:
            As `step`; ``info["best_beam"]`` is the beam.
        """
        (chosen,) = whole_numbers([user], (1,)).tolist()
        outcome = self._played(chosen, None)
        observation, reward, terminated, truncated, info = self._returned(chosen, outcome)
        return observation, reward, terminated, truncated, info | {"best_beam": int(outcome.beam[0])}

    def _played(self, user: int, beams: NDArray[np.int64] | None) -> Outcome:
        if not self._begun:
            raise RunError("no episode has begun; call reset()")
        if self._over:
            raise RunError("the episode is over; call reset()")
        if not 0 <= user < len(USERS):
            raise ScenarioError(f"there is no user {user}; write a number from 0 to {len(USERS) - 1}")
        return self._simulation.step(np.array([user]), beams)

    def _returned(self, user: int, outcome: Outcome) -> Returned:
        info: dict[str, Any] = {name: float(values[0]) for name, values in outcome.info().items()}
        info["chosen_ue"] = USERS[user]
        terminated, self._over = bool(outcome.terminated[0]), bool(outcome.truncated[0])
        return outcome.observation[0], float(outcome.reward[0]), terminated, self._over, info
