"""Many `BeamSelectionEnv` as one vector environment, whose members are computed together as arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from caviar_clients.envs.arguments import checked_members, checked_seeds, whole_numbers
from caviar_clients.envs.base import BeamSelectionEnv, Observation, RewardKind, link_info
from caviar_clients.session.batch import REMEDY, BatchLink, BatchSession, MemberSeed, check_batch
from caviar_protocol import observations
from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array, Payload
from caviar_protocol.errors import PayloadError, RunError, ScenarioError
from caviar_protocol.space.scene import pairs_of
from caviar_protocol.topics import Scene

Actions = NDArray[np.int64]
P = TypeVar("P", bound=Payload)


class _Nothing:
    """The products of a frame that a batch observes: none beside scene and link."""

    def payloads(self, topic: str, cls: type[P]) -> Mapping[str, P]:
        return {}


class BeamSelectionVectorEnv(VectorEnv[Observation, Actions, NDArray[Any]]):
    """``caviar/BeamSelection-v0`` many times, computed as arrays: what ``gymnasium.make_vec`` makes.

    Member i is equal, bit by bit, to a `BeamSelectionEnv` of its seed, with the same observations, rewards
    and information. All members are in the same frame, so their episodes end together. Worlds have to show
    the same in every episode (``trajectory``), the channel has to be ``geometric`` or ``free-space`` and the
    link ``beams``; of other scenarios the environments are made one by one.

    Args:
        num_envs: Number of members, M.
        scenario: Scenario file, or the name of a scenario that ships.
        autoreset_mode: ``NEXT_STEP``: the step after the end of an episode begins the next one and ignores
            its actions; ``SAME_STEP``: the last step itself returns the first observation of the next one,
            and has the last one as ``final_obs`` and ``final_info`` in its information.
        agent: As for `SessionEnv`, as all below.
        users: See ``agent``.
        observe: See ``agent``; of sensors nothing is observed.
        reward: See ``agent``.
        others: Further arguments of `SessionEnv`, which a batch has no use for: they are refused.

    Raises:
        ScenarioError: The scenario cannot be computed for many episodes at once, or an argument is wrong; the
            text names the service and the remedy.

    Example:
        >>> import gymnasium
        >>> envs = gymnasium.make_vec("caviar:caviar/BeamSelection-v0", num_envs=64, scenario="geometric")
        >>> observations, infos = envs.reset(seed=1)  # member i has the seed 1 + i
        >>> observations["aoa"].shape
        (64, 1)
        >>> observations, rewards, terminations, truncations, infos = envs.step(envs.action_space.sample())
        >>> infos["best_abs_y"].shape  # members × users
        (64, 1)
        >>> envs.close()
    """

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012  # as gymnasium has it

    def __init__(
        self,
        num_envs: int,
        scenario: str | Path,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        agent: str | None = None,
        users: str | Sequence[str] = "*",
        observe: Sequence[str] = ("aoa",),
        reward: RewardKind = "abs_y",
        **others: Any,
    ) -> None:
        num_envs = checked_members(num_envs)
        for name, value in others.items():
            if value is not None:
                raise ScenarioError(f"{name}={value!r} is not for many environments at once; {REMEDY}")
        self.num_envs = num_envs
        self.autoreset_mode = _mode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        # One of them, of which no run begins: it has the spaces, and reads arguments, places and features.
        single = self.single = BeamSelectionEnv(
            scenario, agent=agent, users=users, observe=observe, reward=reward
        )
        check_batch(single.prepared, single.agent)
        if single.observer.inputs:
            topics = ", ".join(sorted({entry.topic for entry in single.observer.inputs}))
            raise ScenarioError(
                f"observe={tuple(observe)!r} needs {topics}, and sensors see one scene at a time; {REMEDY}"
            )
        self.single_observation_space = single.observation_space
        self.single_action_space = single.action_space
        self.observation_space = batch_space(single.observation_space, num_envs)
        self.action_space = batch_space(single.action_space, num_envs)
        self._highest = np.array([place.beam_pairs for place in single.users.places]) - 1
        self._session: BatchSession | None = None
        self._members: list[MemberSeed] | None = None
        self._number = 0  # of the frame, the same for all
        self._over = False
        self._link: BatchLink | None = None
        self._places: tuple[object, Int64Array] = ((), np.zeros(0, np.int64))

    # --- gymnasium -------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode of each member.

        Args:
            seed: Of member 0, and member i has ``seed + i``; or one for each, None for the episode that
                follows on the one before. None: so for all, and at first ``run.seed`` of the scenario + i.
            options: There are none.

        Returns:
            Observations and information of frame 0, as `BeamSelectionEnv.reset` returns them, Shape
            ``[M, …]`` each.

        Raises:
            ScenarioError: An option does not exist, or seeds are no M numbers.
            RunError: The run has ended.
        """
        members = self._seeded(seed)
        super().reset(seed=seed if isinstance(seed, int) else None)
        if options:
            raise ScenarioError(f"no options of reset are called {sorted(options)}; there are none")
        if self._session is None:
            self._session = BatchSession(self.single.prepared, self.single.agent, self.num_envs)
            self.closed = False
        self._members = members
        return self._begin(self._session)

    def step(
        self, actions: Actions
    ) -> tuple[Observation, Float64Array, BoolArray, BoolArray, dict[str, Any]]:
        """Decide for the present frame of each member.

        Args:
            actions: Of `action_space`.

        Returns:
            What `BeamSelectionEnv.step` returns, Shape ``[M, …]`` each; information with a mask ``_NAME``
            beside each ``NAME``, as other vector environments have it.

        Raises:
            PayloadError: The actions are none of `action_space`.
            RunError: No episode has begun, or the run has ended.
        """
        session, members = self._session, self._members
        if session is None or members is None:
            raise RunError("no episode has begun; call reset()")
        never = np.zeros(self.num_envs, np.bool_)
        if self._over:
            self._members = [_following(member) for member in members]
            observation, info = self._begin(session)
            return observation, np.zeros(self.num_envs), never, never.copy(), info
        pairs = self._beam_pairs(actions)
        scene = session.scene_at(self._number).scene
        users = self.single.users.present(scene)
        link = session.step(self._number, self._of_users(scene, pairs))
        self._link, self._number = link, self._number + 1
        served = {(pair.tx.name, pair.rx.name) for _, pair in users}
        rewards = self.single.reward.means(link, served)
        over = self._number == session.frames
        truncations = np.full(self.num_envs, over)
        observation, info = self._observation(session), self._info(session)
        if not over:
            return observation, rewards, never, truncations, info
        if self.autoreset_mode is AutoresetMode.NEXT_STEP:
            self._over = True
            return observation, rewards, never, truncations, info
        last = {"final_obs": self._one_by_one(observation), "final_info": info}
        self._members = [_following(member) for member in members]
        observation, info = self._begin(session)
        return observation, rewards, never, truncations, {**self._masked(last), **info}

    def close_extras(self, **_: Any) -> None:
        """End the run."""
        session, self._session = self._session, None
        if session is not None:
            session.close()

    # --- episodes --------------------------------------------------------------------------------

    def _seeded(self, seed: int | Sequence[int | None] | None) -> list[MemberSeed]:
        if seed is None:
            if self._members is not None:
                return [_following(member) for member in self._members]
            seed = self.single.scenario.run.seed
        seeds = checked_seeds(seed, self.num_envs)
        known = self._members
        if known is None:
            known = [MemberSeed(self.single.scenario.run.seed + i, -1) for i in range(self.num_envs)]
        return [
            _following(member) if chosen is None else MemberSeed(chosen, 0)
            for member, chosen in zip(known, seeds, strict=True)
        ]

    def _begin(self, session: BatchSession) -> tuple[Observation, dict[str, Any]]:
        session.begin(self._members or ())
        self._number, self._over, self._link = 0, False, None
        return self._observation(session), self._info(session)

    # --- actions ---------------------------------------------------------------------------------

    def _beam_pairs(self, actions: Actions) -> Int64Array:
        """The actions, Shape ``[M, places]``."""
        shape = (self.num_envs, len(self._highest))
        chosen = whole_numbers(actions, self.action_space.shape or (), shape).reshape(shape)
        if (chosen < 0).any() or (chosen > self._highest).any():
            member, place = np.argwhere((chosen < 0) | (chosen > self._highest))[0].tolist()
            raise PayloadError(
                f"the action of member {member} is {chosen[member].tolist()}; write numbers from 0 to "
                f"{self._highest[place]}"
            )
        return chosen

    def _of_users(self, scene: Scene, chosen: Int64Array) -> Int64Array:
        """Beam pair of each user of the link, −1 where it is not served, Shape ``[M, U]``."""
        # Devices hardly ever change.
        devices, places = self._places
        if scene.devices is not devices:
            of_pair = {(p.tx.name, p.rx.name): place for place, p in self.single.users.present(scene)}
            found = [of_pair.get((p.tx.name, p.rx.name), -1) for p in pairs_of(scene)]
            places = np.array(found * len(self.single.scenario.carriers), np.int64)
            self._places = scene.devices, places
        return np.where(places < 0, -1, chosen[:, places])

    # --- observations and information ------------------------------------------------------------

    def _observation(self, session: BatchSession) -> Observation:
        # The last scene is seen until the end: only the link comes after it.
        scene = session.scene_at(min(self._number, session.frames - 1)).scene
        present = self.single.users.present(scene)
        read = self.single.observer.read(observations.Moment(_Nothing(), scene, self._link, present))
        found = {}
        for name, of in self.single.observer.bounds.items():
            value = np.empty((self.num_envs, *of.shape), of.dtype)
            value[:] = read[name]  # what is of the scene is the same for all
            found[name] = value
        return found

    def _info(self, session: BatchSession) -> dict[str, Any]:
        known: dict[str, Any] = {
            "frame": np.full(self.num_envs, self._number),
            "t_ns": np.full(self.num_envs, session.instant_ns(self._number)),
        }
        if self._link is not None:
            known |= link_info(self._link)
            known["late"] = np.zeros(self.num_envs, np.bool_)  # the run is in this process, and waits
            known["missed_frames"] = np.zeros(self.num_envs, np.int64)
        return self._masked(known)

    def _masked(self, known: Mapping[str, Any]) -> dict[str, Any]:
        """With the mask of each value, which all members have."""
        found = {}
        for name, value in known.items():
            found[name], found[f"_{name}"] = value, np.ones(self.num_envs, np.bool_)
        return found

    def _one_by_one(self, observation: Observation) -> NDArray[np.object_]:
        """The observation of each member, as ``final_obs`` has them."""
        found = np.empty(self.num_envs, object)
        for member in range(self.num_envs):
            found[member] = {name: values[member].copy() for name, values in observation.items()}
        return found


def _following(member: MemberSeed) -> MemberSeed:
    """The episode that follows on one."""
    return MemberSeed(member.seed, member.seed_episode + 1)


def _mode(given: AutoresetMode | str) -> AutoresetMode:
    try:
        mode = AutoresetMode(given)
    except ValueError:
        mode = AutoresetMode.DISABLED
    if mode is AutoresetMode.DISABLED:
        raise ScenarioError(
            f"autoreset_mode={given!r} is not there for members that are in the same frame; write "
            f"{AutoresetMode.NEXT_STEP.value!r} or {AutoresetMode.SAME_STEP.value!r}"
        )
    return mode
