"""``caviar/RecordedBeams-v0``: choose beams for recorded users, one an episode, many together as arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from caviar_clients.envs.arguments import (
    checked_members,
    checked_names,
    checked_patterns,
    checked_seeds,
    whole_numbers,
)
from caviar_clients.envs.base import KINDS, OF_PACKETS, Reward, RewardKind, link_info
from caviar_clients.learning.tracks import NoProducts, Tracks, read_tracks
from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_protocol.cell.link_adaptation import shannon
from caviar_protocol.errors import PayloadError, RunError, ScenarioError
from caviar_protocol.observations import Moment
from caviar_services.link.base import BatchLink

Normalization: TypeAlias = Literal["recorded", "unit"]
Observation = dict[str, NDArray[Any]]
_MODES = (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP)
_PARTS_OF_PACKETS = ("last_throughput", "buffered", "waiting")


class RecordedBeamsVectorEnv(VectorEnv[Observation, NDArray[np.int64], NDArray[Any]]):
    """Users of recordings, each member of the batch another one, in frames of its own.

    An episode is one user from its first to its last frame; of which recording and user is drawn, and each
    comes once before one comes again. Observations are those of `BeamSelectionEnv` with the user alone.

    Args:
        num_envs: Number of members, M.
        recordings: Directories of runs that recorded ``scene`` and ``channel``.
        observe: Parts of the observation, none of sensors.
        reward: As of `BeamSelectionEnv`.
        users: Receivers, as names with ``*`` and ``?``.
        carrier: By its name; None: the first.
        normalization: ``unit``: |y| in rewards and information is relative to the root mean square of the
            entries of H in that frame, as the channel ``geometric`` has it: at most sqrt(Nt·Nr). What is
            observed stays as it was recorded.
        autoreset_mode: ``NextStep`` or ``SameStep``, as of `BeamSelectionVectorEnv`.

    Raises:
        ScenarioError: An argument is wrong.
        RecordingError: A recording lacks what is needed.

    Example:
        >>> env = RecordedBeamsVectorEnv(
        ...     3, ["runs/smoke-20261122-101500"], observe=("aod", "last_beam"), users="uav/*"
        ... )
        >>> observations, _ = env.reset(seed=1)
        >>> observations["aod"].shape, env.single_action_space.n
        ((3, 1), np.int64(32))
        >>> _, rewards, *_ = env.step(np.zeros(3, np.int64))
        >>> rewards.shape
        (3,)
    """

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012  # as gymnasium has it

    def __init__(
        self,
        num_envs: int,
        recordings: Sequence[str | Path],
        observe: Sequence[str] = ("aod",),
        reward: RewardKind = "abs_y",
        users: str | Sequence[str] = "*",
        carrier: str | None = None,
        normalization: Normalization = "recorded",
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    ) -> None:
        if reward not in KINDS:
            raise ScenarioError(f"no reward is called {reward!r}; there are: {', '.join(KINDS)}")
        if normalization not in get_args(Normalization):
            known = " or ".join(map(repr, get_args(Normalization)))
            raise ScenarioError(f"normalization={normalization!r}; write {known}")
        if reward in OF_PACKETS:
            raise ScenarioError(f"reward {reward!r} is of packets, which are not replayed; write 'abs_y'")
        observe, recordings = checked_names("observe", observe), checked_names("recordings", recordings)
        if packets := [name for name in observe if name in _PARTS_OF_PACKETS]:
            raise ScenarioError(f"observation {packets[0]!r} is of packets, which are not replayed")
        if not observe:
            raise ScenarioError("observe names no part; write observe=('aod',)")
        if autoreset_mode not in (*_MODES, *(mode.value for mode in _MODES)):
            known = " or ".join(repr(mode.value) for mode in _MODES)
            raise ScenarioError(f"autoreset_mode={autoreset_mode!r}; write {known}")
        num_envs = self.num_envs = checked_members(num_envs)
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.tracks: Tracks = read_tracks(recordings, observe, checked_patterns("users", users), carrier)
        self._reward = Reward(reward)
        self._scale = 1 / self.tracks.rms() if normalization == "unit" else np.ones(len(self.tracks.has_path))
        self._best = self.tracks.swept.max(axis=1)
        self.parts: spaces.Dict[Any] = spaces.Dict(
            {name: spaces.Box(*bounds) for name, bounds in self.tracks.bounds.items()}
        )
        self.single_observation_space = self.parts
        self.single_action_space = spaces.Discrete(self.tracks.place.beam_pairs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._orders: list[_Order] = []
        # Row of each member in the arrays of the tracks, and the one after its last.
        self._row, self._end = np.zeros(num_envs, np.int64), np.zeros(num_envs, np.int64)
        self._over = np.zeros(num_envs, np.bool_)
        self._link: BatchLink | None = None

    # --- gymnasium -------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode of each member.

        Args:
            seed: Of member 0, and member i has ``seed + i``; or one for each. None: the order of users that
                was begun goes on.
            options: ``tracks``: index of the user that each member begins with.

        Raises:
            ScenarioError: An option does not exist.
        """
        seeds = checked_seeds(seed, self.num_envs)
        super().reset(seed=seed if isinstance(seed, int) else None)
        options = dict(options or {})
        chosen = options.pop("tracks", None)
        if options:
            raise ScenarioError(f"no options of reset are called {sorted(options)}; there is: tracks")
        if chosen is not None:
            chosen = self._checked_tracks(chosen)
        if seed is not None or not self._orders:
            if seed is None:
                seeds = checked_seeds(0, self.num_envs)
            self._orders = [_Order(len(self.tracks.tracks), s) for s in seeds]
        everyone = np.ones(self.num_envs, np.bool_)
        self._begin(everyone, chosen)
        self._link = None
        return self._observation(), self._masked(self._instant(), everyone)

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[Observation, Float64Array, BoolArray, BoolArray, dict[str, Any]]:
        """Choose a pair of beams for each member.

        Raises:
            PayloadError: The actions are none of `action_space`.
            RunError: No episode has begun.
        """
        if not self._orders:
            raise RunError("no episode has begun; call reset()")
        beams, begins = self._checked(actions), self._over
        rows = np.where(begins, self._end - 1, self._row)
        link = self._scored(rows, beams)
        rewards = np.where(begins, 0.0, self._rewards(link, rows))
        known = self._instant() | link_info(self._scaled(link, rows))
        self._row = np.where(begins, self._row, self._row + 1)
        over = (self._row == self._end) & ~begins
        self._begin(begins, None)
        self._link = _forgotten(link, begins)
        never, last = np.zeros(self.num_envs, np.bool_), {}
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            if over.any():
                last = {"final_obs": self._one_by_one(self._observation(), over), "_final_obs": over}
                last |= {"final_info": self._masked(known, over), "_final_info": over}
                self._begin(over, None)
                self._link = _forgotten(self._link, over)
        else:
            self._over = over
        return self._observation(), rewards, never, over, {**self._masked(known, ~begins), **last}

    # --- episodes --------------------------------------------------------------------------------

    def _begin(self, members: BoolArray, chosen: Sequence[int] | None) -> None:
        """Begin the next episode of some members."""
        for member in np.flatnonzero(members).tolist():
            index = self._orders[member].following() if chosen is None else int(chosen[member])
            rows = self.tracks.tracks[index].rows
            self._row[member], self._end[member] = rows.start, rows.stop
        self._over = self._over & ~members

    def _checked_tracks(self, chosen: object) -> list[int]:
        """The option ``tracks`` of `reset`."""
        count, given = len(self.tracks.tracks), np.asarray(chosen, dtype=object).ravel().tolist()
        fits = np.shape(given) == (self.num_envs,) and np.ndim(chosen) == 1  # type: ignore[arg-type]
        if not (fits and all(isinstance(i, int | np.integer) and 0 <= i < count for i in given)):
            raise ScenarioError(
                f"tracks={chosen!r}; write {self.num_envs} whole numbers from 0 to {count - 1}, one for each "
                "member"
            )
        return [int(i) for i in given]

    def _checked(self, actions: NDArray[np.int64]) -> Int64Array:
        beams, count = whole_numbers(actions, (self.num_envs,)), self.tracks.place.beam_pairs
        if (beams < 0).any() or (beams >= count).any():
            member = int(np.flatnonzero((beams < 0) | (beams >= count))[0])
            raise PayloadError(
                f"the action of member {member} is {beams[member]}; write numbers from 0 to {count - 1}"
            )
        return beams.astype(np.int64)

    # --- links -----------------------------------------------------------------------------------

    def _scored(self, rows: Int64Array, beams: Int64Array) -> BatchLink:
        """Figures of the beams in these frames, as they were recorded."""
        tracks, pair = self.tracks, self.tracks.pair
        abs_y = tracks.swept[rows, beams]
        snr = tracks.power_over_noise[rows] * abs_y**2
        tx_beam, rx_beam = np.divmod(beams, pair.beams[1])
        return BatchLink(
            tx=(pair.tx.name,),
            rx=(pair.rx.name,),
            carrier=(tracks.tracks[0].user[2],),
            has_path=tracks.has_path[rows, None],
            los=tracks.los[rows, None],
            tx_beam=tx_beam[:, None],
            rx_beam=rx_beam[:, None],
            abs_y=abs_y[:, None],
            top_abs_y=self._best[rows, None, None],
            baseline_abs_y=tracks.swept[rows, tracks.straight[rows]][:, None],
            snr=snr[:, None],
            spectral_efficiency=shannon(snr, tracks.settings.max_spectral_efficiency)[:, None],
        )

    def _scaled(self, link: BatchLink, rows: Int64Array) -> BatchLink:
        scale = self._scale[rows, None]
        return link._replace(
            abs_y=link.abs_y * scale,
            top_abs_y=link.top_abs_y * scale[:, None],
            baseline_abs_y=link.baseline_abs_y * scale,
        )

    def _rewards(self, link: BatchLink, rows: Int64Array) -> Float64Array:
        pair = self.tracks.pair
        return self._reward.means(self._scaled(link, rows), {(pair.tx.name, pair.rx.name)})

    # --- observations and information ------------------------------------------------------------

    def _observation(self) -> Observation:
        # The last frame is seen until the end: only the link comes after it.
        rows, tracks = np.minimum(self._row, self._end - 1), self.tracks
        found = {name: values[rows] for name, values in tracks.seen.items()}
        fed_back = tracks.feedback.read(Moment(NoProducts(), tracks.scene, self._link, ((0, tracks.pair),)))
        for name, value in fed_back.items():
            found[name] = np.broadcast_to(value, (self.num_envs, *tracks.bounds[name].shape)).copy()
        return {name: found[name] for name in tracks.bounds}

    def _instant(self) -> dict[str, Any]:
        rows = np.minimum(self._row, self._end - 1)
        return {"frame": self.tracks.number[rows], "t_ns": self.tracks.t_ns[rows]}

    def _masked(self, known: Mapping[str, Any], members: BoolArray) -> dict[str, Any]:
        """With the mask of each value: the members that have it."""
        return dict(known) | {f"_{name}": members for name in known}

    def _one_by_one(self, observation: Observation, members: BoolArray) -> NDArray[np.object_]:
        """The observation of each of some members, as ``final_obs`` has them."""
        found = np.full(self.num_envs, None, object)
        for member in np.flatnonzero(members).tolist():
            found[member] = {name: values[member] for name, values in observation.items()}
        return found


class _Order:
    """Order of the users: each once before one comes again."""

    def __init__(self, count: int, seed: int | None) -> None:
        self._random, self._count, self._left = np.random.default_rng(seed), count, list[int]()

    def following(self) -> int:
        self._left = self._left or self._random.permutation(self._count).tolist()
        return self._left.pop()


def _forgotten(link: BatchLink, members: BoolArray) -> BatchLink:
    """A link of which members whose episode has just begun know nothing."""
    gone = members[:, None]
    return link._replace(
        tx_beam=np.where(gone, -1, link.tx_beam),
        rx_beam=np.where(gone, -1, link.rx_beam),
        abs_y=np.where(gone, 0.0, link.abs_y),
        spectral_efficiency=np.where(gone, 0.0, link.spectral_efficiency),
    )


class RecordedBeamsEnv(gymnasium.Env[Observation, np.int64]):
    """``caviar/RecordedBeams-v0``: one member of `RecordedBeamsVectorEnv`.

    Args:
        recordings: As of `RecordedBeamsVectorEnv`.
        options: Its other arguments.

    Example:
        >>> env = RecordedBeamsEnv(["runs/smoke-20261122-101500"], users="uav/*")
        >>> _, info = env.reset(seed=1)
        >>> _, abs_y, _, _, info = env.step(np.int64(0))
        >>> bool(0 <= abs_y <= info["best_abs_y"][0])
        True
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  # as gymnasium has it

    def __init__(self, recordings: Sequence[str | Path], render_mode: None = None, **options: Any) -> None:
        self._one = RecordedBeamsVectorEnv(1, recordings, **options)
        self.render_mode = render_mode
        self.observation_space: spaces.Dict[Any] = self._one.parts  # type: ignore[assignment]  # of arrays
        self.action_space = self._one.single_action_space
        self.users, self.scenario = self._one.tracks.users, self._one.tracks.scenario
        self._is_over = True

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode; ``options`` may have ``track``, the index of the user."""
        super().reset(seed=seed)
        options = dict(options or {})
        if "tracks" in options:
            raise ScenarioError("no options of reset are called ['tracks']; there is: track")
        if "track" in options:
            track, count = options.pop("track"), len(self._one.tracks.tracks)
            if not (isinstance(track, int | np.integer) and 0 <= track < count):
                raise ScenarioError(f"track={track!r}; write a whole number from 0 to {count - 1}")
            options["tracks"] = [int(track)]
        observation, info = self._one.reset(seed=seed, options=options)
        self._is_over = False
        return self._only(observation), self._only(info)

    def step(self, action: np.int64) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Choose a pair of beams, by its index."""
        if self._is_over:
            raise RunError("the episode is over, or none has begun; call reset()")
        observation, rewards, _, truncations, info = self._one.step(np.atleast_1d(np.asarray(action)))
        self._is_over = bool(truncations[0])
        return self._only(observation), float(rewards[0]), False, self._is_over, self._only(info)

    def _only(self, of_members: Mapping[str, Any]) -> dict[str, Any]:
        return {name: value[0] for name, value in of_members.items() if not name.startswith("_")}
