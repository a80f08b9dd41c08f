"""Two agents in one world: one flies an object, one chooses the beams towards it (the paper, section 2.2).

A `pettingzoo.ParallelEnv`: both agents decide each frame together.
"""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium

from caviar_clients.envs.arguments import checked_path
from caviar_clients.envs.base import BeamSelectionEnv, Observation, SessionEnv
from caviar_clients.envs.uav_path import MOTION, UavPathEnv
from caviar_clients.session.prepared import PreparedScenario, prepare
from caviar_protocol.errors import PayloadError, ScenarioError, SetupError, suggestion
from caviar_protocol.host import install_command
from caviar_protocol.messages import Input
from caviar_protocol.scenario import Scenario

try:
    from pettingzoo import ParallelEnv
except ImportError as error:
    how = install_command("learning")
    raise SetupError(f"environments of two agents need PettingZoo; run: {how}") from error


class UavPairEnv(ParallelEnv[str, Observation, Any]):  # type: ignore[misc]  # it has no types
    """Fly an object and choose the beams towards it, each as an agent of its own.

    The agents have the names of the scenario's: the one that owns ``motion:…`` flies, with spaces, reward and
    options of ``caviar/UavPath-v1``; the other one chooses beams, with those of ``caviar/BeamSelection-v0``.
    An episode ends for both at once.

    Args:
        scenario: Scenario file, or the name of a scenario that ships.
        pilot: Name of the agent that flies; None: the only one that owns a motion.
        beams: Name of the agent that chooses beams; None: the only other one.
        flight: Arguments of `UavPathEnv`, by name.
        selection: Arguments of `BeamSelectionEnv`, by name: ``observe``, ``reward``, …
        broker: ZeroMQ address of a broker where both agents are remote; None: the run is in this process.
        directory: Where a run in this process records; None: nowhere, which is faster.
        render_mode: ``rgb_array``: a map of the scene.

    Raises:
        ScenarioError: The scenario has no such agents, or an argument is wrong.

    Example:
        >>> env = UavPairEnv("uav-pair", flight={"deliveries": 3})
        >>> env.possible_agents
        ['pilot', 'beams']
        >>> observations, infos = env.reset(seed=1)
        >>> actions = {agent: env.action_space(agent).sample() for agent in env.agents}
        >>> observations, rewards, terminations, truncations, infos = env.step(actions)
        >>> sorted(rewards)
        ['beams', 'pilot']
        >>> env.close()
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - as PettingZoo has it
        "name": "caviar_uav_pair_v0",
        "render_modes": ["rgb_array"],
        "render_fps": 10,
        "is_parallelizable": True,
    }

    def __init__(
        self,
        scenario: str | Path,
        pilot: str | None = None,
        beams: str | None = None,
        flight: Mapping[str, Any] | None = None,
        selection: Mapping[str, Any] | None = None,
        broker: str | None = None,
        directory: str | Path | None = None,
        render_mode: str | None = None,
    ) -> None:
        prepared = prepare(checked_path("scenario", scenario))
        pilot, beams = _roles(prepared.scenario, pilot, beams)
        _check_options("selection", selection, BeamSelectionEnv)
        _check_options("flight", flight, UavPathEnv)
        at = {"broker": broker, "directory": directory, "render_mode": render_mode}
        self._selection = BeamSelectionEnv(prepared, agent=beams, **(selection or {}))
        self._pilot = _Pilot(prepared, self._selection, agent=pilot, **{**(flight or {}), **at})
        self.possible_agents = [pilot, beams]
        self.agents: list[str] = []
        self.render_mode = render_mode
        self._of: dict[str, SessionEnv[Any]] = {pilot: self._pilot, beams: self._selection}

    def observation_space(self, agent: str) -> gymnasium.spaces.Space[Any]:
        """The same object at each call, as PettingZoo asks for."""
        return self._of[agent].observation_space

    def action_space(self, agent: str) -> gymnasium.spaces.Space[Any]:
        """The same object at each call, as PettingZoo asks for."""
        return self._of[agent].action_space

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, dict[str, Any]]]:
        """Begin an episode.

        Args:
            seed: The same seed leads to the same episode. None: the episode that follows on the one before.
            options: Those of `UavPathEnv`; others are warned of, since PettingZoo lets programs pass any.

        Returns:
            Observation and information of each agent.
        """
        known = {name: value for name, value in (options or {}).items() if name in UavPathEnv.reset_options}
        if unknown := sorted(set(options or {}) - set(known)):
            there = ", ".join(UavPathEnv.reset_options)
            warnings.warn(f"no options of reset are called {unknown}; there are: {there}", stacklevel=2)
        of_pilot = self._pilot.reset(seed=seed, options=known)
        of_beams = self._selection.entered(self._pilot.frame)
        self.agents = list(self.possible_agents)
        pilot, beams = self.agents
        return {pilot: of_pilot[0], beams: of_beams[0]}, {pilot: of_pilot[1], beams: of_beams[1]}

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[
        dict[str, Observation], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]
    ]:
        """Decide for the present frame, both agents at once, and wait for the next one.

        Args:
            actions: Of each agent, by name.

        Returns:
            Observation, reward, whether the pilot's goal is reached, whether the episode is over, and
            information, of each agent by name.

        Raises:
            PayloadError: An agent has no action, or one that is none of its space.
            RunError: No episode has begun, or the run has ended.
        """
        pilot, beams = self.possible_agents
        if not isinstance(actions, Mapping) or set(actions) != {pilot, beams}:
            given = f"of {sorted(map(str, actions))}" if isinstance(actions, Mapping) else repr(actions)
            raise PayloadError(f"actions are {given}; write one for {pilot!r} and one for {beams!r}")
        decided = {name: self._of[name].decided(actions[name]) for name in self.possible_agents}
        frame = self._pilot.session.step({"action": decided[pilot]}, {beams: {"action": decided[beams]}})
        moved = {name: self._of[name].moved(frame) for name in self.possible_agents}
        # The task is the pilot's: where it is done, there is nothing left to choose beams for.
        ended = moved[pilot][2]
        if ended or frame.final:
            self.agents = []
        return (
            {name: item[0] for name, item in moved.items()},
            {name: item[1] for name, item in moved.items()},
            dict.fromkeys(moved, ended),
            dict.fromkeys(moved, frame.final),
            {name: item[4] for name, item in moved.items()},
        )

    def render(self) -> Any:
        """Draw a map of the scene as an RGB image; None without ``render_mode``."""
        return self._pilot.render()

    def close(self) -> None:
        """End the run, or leave it."""
        self._pilot.close()
        self.agents = []


class _Pilot(UavPathEnv):
    """The pilot's environment, whose session takes the other agent's place too."""

    def __init__(self, scenario: PreparedScenario, selection: BeamSelectionEnv, **options: Any) -> None:
        super().__init__(scenario, **options)
        self._selection, self._beside = selection, (selection.agent,)

    def inputs(self) -> tuple[Input, ...]:
        """Give what both agents consume."""
        by_topic = {entry.topic: entry for entry in (*self._selection.inputs(), *super().inputs())}
        return tuple(by_topic.values())


def _check_options(name: str, given: object, environment: type[SessionEnv[Any]]) -> None:
    """Raise `ScenarioError` for options that an environment does not take, or that the pair chooses."""
    if given is None:
        return
    if not isinstance(given, Mapping):
        raise ScenarioError(f"{name}={given!r}; write options by name: {name}={{'observe': ('aod',)}}")
    ours = ("self", "scenario", "agent", "broker", "directory", "render_mode", "options")
    inits = (vars(cls).get("__init__") for cls in inspect.getmro(environment) if cls is not object)
    known = {name for init in inits if init is not None for name in inspect.signature(init).parameters}
    for option in given:
        if option not in known or option in ours:
            hint = suggestion(str(option), sorted(known.difference(ours)))
            raise ScenarioError(f"{name} has no option {option!r}; {hint}")


def _roles(scenario: Scenario, pilot: str | None, beams: str | None) -> tuple[str, str]:
    """Names of the agent that flies and of the one that chooses beams."""
    agents = {name: spec for name, spec in scenario.services.items() if spec.role == "agent"}
    flying = [name for name, spec in agents.items() if any(user.startswith(MOTION) for user in spec.users)]
    if pilot is None:
        pilot = flying[0] if len(flying) == 1 else None
    if beams is None:
        others = [name for name in agents if name not in {pilot, *flying}]
        beams = others[0] if len(others) == 1 else None
    if pilot not in flying or beams not in agents or beams == pilot:
        raise ScenarioError(
            f"pilot={pilot!r} and beams={beams!r} are no two agents of the scenario, of which the first owns "
            f"a motion; its agents are: {', '.join(agents) or 'none'}; with a motion among their users: "
            f"{', '.join(flying) or 'none'}"
        )
    return pilot, beams
