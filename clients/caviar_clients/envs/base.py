"""Base class of the environments: scenario, session, observation, reward. The first environment,
``caviar/BeamSelection-v0``: choose a beam pair for each user, every frame.
"""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Collection, Mapping, Sequence
from functools import reduce
from operator import add
from pathlib import Path
from typing import Any, ClassVar, Generic, Literal, Protocol, TypeAlias, TypeVar, get_args

import gymnasium
import numpy as np
from gymnasium import spaces
from msgspec.structs import replace
from numpy.typing import NDArray

from caviar_clients.envs.arguments import checked_names, checked_path, checked_patterns
from caviar_clients.plots.moving import MapRenderer
from caviar_clients.session.base import Frame, Session
from caviar_clients.session.connected import CONNECT_TIMEOUT_S, agent_of, open_session
from caviar_clients.session.prepared import PreparedScenario, prepare
from caviar_protocol import observations
from caviar_protocol.arrays import BoolArray, Float64Array
from caviar_protocol.errors import PayloadError, RunError, ScenarioError
from caviar_protocol.keys import credentials
from caviar_protocol.messages import Input, Status
from caviar_protocol.observations import LinkFigures, Observer, Users, require_packets
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.topics import Action, BeamChoice, Link
from caviar_protocol.topics.link import Command


class LinkResult(LinkFigures, Protocol):
    """Link that environments report: a `Link`, or one of many episodes."""

    @property
    def has_path(self) -> BoolArray:
        """Mask of users with a path, Shape ``[..., U]`` as all below."""

    @property
    def los(self) -> BoolArray:
        """Mask of users with a free line of sight."""

    @property
    def top_abs_y(self) -> Float64Array:
        """|y| of the best pairs, best first, Shape ``[..., U, K]``."""

    @property
    def baseline_abs_y(self) -> Float64Array:
        """|y| of the pair along the straight line."""

    @property
    def snr(self) -> Float64Array:
        """Linear."""


def link_info(link: LinkResult) -> dict[str, NDArray[Any]]:
    """Collect the arrays of a link for ``info``, by name."""
    known = {
        "abs_y": link.abs_y,
        "best_abs_y": link.top_abs_y[..., 0],
        "baseline_abs_y": link.baseline_abs_y,
        "los": link.los,
    }
    if isinstance(link, Link) and link.throughput is not None:
        known |= {name: getattr(link, name) for name in PACKETS}
    return known


PACKETS = ("throughput", "delay", "waiting", "buffered", "dropped")
"""What ``info`` has of a link with packets, in the units of `Link`."""

RewardKind: TypeAlias = Literal["abs_y", "normalised", "snr", "spectral_efficiency", "throughput", "delay"]
KINDS: tuple[RewardKind, ...] = get_args(RewardKind)
OF_PACKETS = ("throughput", "delay")
"""Rewards for which the link has to have packets."""


class Reward:
    """Mean over the users served of one of their figures; users without a path are left out.

    Args:
        kind: ``abs_y``: |y| of the chosen pair (the paper, section 4); ``normalised``: |y| over that of the
            best pair; ``snr``: linear; ``spectral_efficiency`` [bit/s/Hz]. Of a link with packets, mean over
            the users whose receiver the transmitter serves, with a path or without: ``throughput`` [Mbit/s];
            ``delay`` [ms]: minus the mean delay of the packets that came through in the frame, or minus the
            age of the oldest one that still waits, whichever is longer: to send nothing is no way out.
    """

    def __init__(self, kind: RewardKind) -> None:
        self.kind = kind
        self._known: tuple[tuple[str, ...], tuple[str, ...], Collection[tuple[str, str]]] | None = None
        self._served: BoolArray | None = None

    def served(self, link: LinkResult, pairs: Collection[tuple[str, str]]) -> BoolArray | None:
        """Find the users of a link that are among some pairs.

        Args:
            link: Has the users.
            pairs: Names of transmitter and receiver.

        Returns:
            Whether each user is, Shape ``[U]``; None where all are.
        """
        # Users hardly ever change: comparing three tuples costs less than looking up each pair.
        known = (link.tx, link.rx, pairs)
        if known != self._known:
            inside = np.array([pair in pairs for pair in zip(link.tx, link.rx, strict=True)], np.bool_)
            self._known, self._served = known, None if inside.all() else inside
        return self._served

    def mean(self, link: Link, pairs: Collection[tuple[str, str]]) -> float:
        """Work out the reward for a frame.

        Args:
            link: What the decision led to.
            pairs: Names of transmitter and receiver of the users that count.

        Returns:
            The mean over these users; 0 where none of them has a path.
        """
        values = self._values(link)
        counted, served = self._counted(link), self.served(link, pairs)
        if served is not None:
            counted = counted & served
        if len(values) == 1:  # without a mask and a mean of NumPy, which take 5 µs more
            return float(values[0]) if counted[0] else 0.0
        chosen: list[float] = values[counted].tolist()
        # One after the other, as `means` adds them: `sum` has an order of its own.
        return reduce(add, chosen) / len(chosen) if chosen else 0.0

    def means(self, link: LinkResult, pairs: Collection[tuple[str, str]]) -> Float64Array:
        """Work out the rewards for a frame of many episodes.

        Args:
            link: What the decisions led to, with M rows of users.
            pairs: Names of transmitter and receiver of the users that count.

        Returns:
            What `mean` returns for the link of each episode, Shape ``[M]``.
        """
        values = self._values(link)
        counted, served = link.has_path, self.served(link, pairs)
        if served is not None:
            counted = counted & served
        total, number = np.zeros(len(values)), counted.sum(axis=1)
        for user in range(values.shape[1]):
            total += np.where(counted[:, user], values[:, user], 0.0)
        means: Float64Array = np.divide(total, number, out=np.zeros(len(values)), where=number > 0)
        return means

    def _counted(self, link: Link) -> BoolArray:
        if self.kind not in OF_PACKETS:
            return link.has_path
        if link.serving is None:
            raise ScenarioError(
                f"the reward {self.kind!r} is of packets, and the link of the run sends none; write "
                'use = "cell" and its traffic, or another reward'
            )
        return link.serving

    def _values(self, link: LinkResult) -> Float64Array:
        match self.kind:
            case "throughput" | "delay":
                return self._of_packets(link)
            case "abs_y":
                return link.abs_y
            case "snr":
                return link.snr
            case "spectral_efficiency":
                return link.spectral_efficiency
            case "normalised":
                best = link.top_abs_y.max(axis=-1, initial=0.0)
                share: Float64Array = np.divide(link.abs_y, best, out=np.zeros(best.shape), where=best > 0)
                return share

    def _of_packets(self, link: LinkResult) -> Float64Array:
        if not isinstance(link, Link) or link.throughput is None:
            return np.zeros(link.abs_y.shape)  # it is refused where users are counted
        if self.kind == "throughput":
            return link.throughput / 1e6
        ages = [values for values in (link.delay, link.waiting) if values is not None]
        longest: Float64Array = np.max(ages, axis=0)
        return 0.0 - 1e3 * longest


A = TypeVar("A")
Observation = dict[str, np.ndarray[Any, np.dtype[Any]]]


class Moment(observations.Moment, frozen=True):
    """Knowledge at a frame of a session."""

    frame: Frame
    link: Link | None


class SessionEnv(gymnasium.Env[Observation, A], Generic[A]):
    """A run of CAVIAR as a gymnasium environment (contract, clause 16).

    ``step(a_k)`` reports the decision of frame k, waits for the grant of frame k + 1, or the final one,
    and returns its observation with the reward of link(k). An episode ends by truncation after its
    last frame; the last observation has the scene of the last frame and its link.

    Args:
        scenario: Scenario file, the name of a scenario that ships, or one that is prepared.
        broker: ZeroMQ address of a broker that runs the scenario, with the agent's ``use = "remote"``; None:
            the run takes place in this process.
        agent: Name of the agent whose place is taken; None: the remote one, or the only one.
        users: Receivers served, as names with ``*`` and ``?``.
        transmitters: Transmitters that serve them, likewise; the users of others have no beams.
        observe: Names of the parts of the observation: `caviar_protocol.observations.PARTS`.
        reward: What the reward is: `caviar_clients.envs.base.Reward`.
        directory: Where an embedded run records; None: it does not, which is faster.
        render_mode: ``rgb_array``: a map of the scene.
        key, broker_key: For a broker with keys: files with the agent's secret key and with the broker's
            public one. By default those that CAVIAR_KEY and CAVIAR_BROKER_KEY name.
        connect_timeout_s: Time in which a broker has to answer [s].

    Raises:
        ScenarioError: The scenario or an argument is wrong; the text has value, place and remedy.

    Example:
        >>> import gymnasium
        >>> env = gymnasium.make("caviar:caviar/BeamSelection-v0", scenario="geometric", observe=("aoa",))
        >>> observation, info = env.reset(seed=1)
        >>> observation["aoa"].shape
        (1,)
        >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        >>> reward >= 0
        True
        >>> env.close()
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012  # as gymnasium has it

    reset_options: ClassVar[tuple[str, ...]] = ()
    """Names of the ``options`` that `reset` takes."""
    needs_parts: ClassVar[bool] = True
    """Whether ``observe`` has to name a part, since nothing else is observed."""
    uses_scenery: ClassVar[bool] = False
    """Whether the files of the run's scenery are fetched (`Session.scenery`)."""

    def __init__(
        self,
        scenario: str | Path | PreparedScenario,
        broker: str | None = None,
        agent: str | None = None,
        users: str | Sequence[str] = "*",
        observe: Sequence[str] = ("aoa",),
        reward: RewardKind = "abs_y",
        directory: str | Path | None = None,
        render_mode: str | None = None,
        key: str | Path | None = None,
        broker_key: str | Path | None = None,
        connect_timeout_s: float = CONNECT_TIMEOUT_S,
        transmitters: str | Sequence[str] = "*",
    ) -> None:
        if reward not in KINDS:
            raise ScenarioError(f"no reward is called {reward!r}; there are: {', '.join(KINDS)}")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ScenarioError(f"render_mode is {render_mode!r}; write 'rgb_array' or None")
        observe = checked_names("observe", observe)
        if not observe and self.needs_parts:
            raise ScenarioError("observe names no part; write observe=('aoa',)")
        if not isinstance(scenario, PreparedScenario):
            scenario = prepare(checked_path("scenario", scenario))
        self.prepared = scenario
        self.scenario = self.prepared.scenario
        if not any(spec.role == "link" for spec in self.scenario.services.values()):
            raise Place("services", self.scenario.source).error(
                "no service is a link, which says what beams achieve; add [services.link] with "
                'role = "link", use = "beams" and budget_ms'
            )
        if reward in OF_PACKETS:
            require_packets(self.scenario, f"reward {reward!r}")
        # A program may make hundreds of environments: Python shows the same warning once.
        for text in self.prepared.warnings:
            warnings.warn(text, stacklevel=2)
        self.agent = agent_of(self.scenario, agent)
        self.render_mode = render_mode
        self.transmitters = checked_patterns("transmitters", transmitters)
        """Patterns of those that are served."""
        served = checked_patterns("users", users)
        self.users = Users(self.scenario, served, transmitters=self.transmitters)
        self.observer = Observer(self.scenario, self.users, observe)
        """Reads the parts of the observation."""
        self.observation_space: spaces.Dict[Any] = spaces.Dict(  # type: ignore[assignment]  # of arrays
            {name: spaces.Box(*bounds) for name, bounds in self.observer.bounds.items()}
        )
        self.reward = Reward(reward)
        """Of the link."""
        if not isinstance(broker, str | None):
            raise ScenarioError(f"broker={broker!r}; write its address, as in 'tcp://127.0.0.1:5570'")
        self._broker, self._connect_timeout_s = broker, connect_timeout_s
        own, its = (None if path is None else Path(path) for path in (key, broker_key))
        self._credentials = None if broker is None else credentials(own, its)
        self._directory = None if directory is None else Path(directory)
        self._beside: tuple[str, ...] = ()  # agents whose places are taken, too
        self._renderer: MapRenderer | None = None
        self._session: Session | None = None
        self._moment: Moment | None = None

    # --- gymnasium -------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: The same seed leads to the same episode, here and at a broker. None: the episode that
                follows on the one before.
            options: Of the kind of environment, by name: `reset_options`.

        Returns:
            Observation and information of frame 0: its number ``frame`` and time ``t_ns`` [ns].

        Raises:
            ScenarioError: An option does not exist.
            RunError: The run has ended.
        """
        super().reset(seed=seed)
        unknown = sorted(set(options or {}) - set(self.reset_options))
        if unknown:
            there = f"there are: {', '.join(self.reset_options)}" if self.reset_options else "there are none"
            raise ScenarioError(f"no options of reset are called {unknown}; {there}, set it in the scenario")
        # With the first reset, and not before: a program that only looks at the spaces starts no run.
        if self._session is None:
            self._session = self._open()
        self._moment = self._at(self._session.reset(seed))
        self._begin(options or {})
        return self._observation(self._moment), self._info(self._moment)

    def step(self, action: A) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Decide for the present frame, and wait for the next one.

        Args:
            action: Of `action_space`.

        Returns:
            Observation of the next frame; reward of the decision; whether the goal is reached; whether the
            episode is over; and information: ``abs_y``, ``best_abs_y``, ``baseline_abs_y`` and ``los`` of
            each user, Shape ``[U]``, and of a link with packets `caviar_clients.envs.base.PACKETS`,
            beside ``frame`` and ``t_ns``; ``late``, whether the decision came
            after its deadline, so that the agent's late policy stood in for it, and ``missed_frames``, how
            many frames then went on before the next one that it is asked for (at a broker: a run in this
            process waits).

        Raises:
            PayloadError: The action is none of `action_space`.
            RunError: No episode has begun, or the run has ended.
        """
        decided = self.decided(action)
        return self.moved(self.session.step({"action": decided}))

    # For environments of several agents, which step one session for all of them.

    @property
    def frame(self) -> Frame:
        """The frame that is to be decided, or the final one.

        Raises:
            RunError: No episode has begun.
        """
        if self._moment is None:
            raise RunError("no episode has begun; call reset()")
        return self._moment.frame

    @property
    def session(self) -> Session:
        """The session that is open.

        Raises:
            RunError: None is: no episode has begun, or the environment is closed.
        """
        if self._session is None:
            raise RunError("no session is open; call reset()")
        return self._session

    def entered(self, frame: Frame) -> tuple[Observation, dict[str, Any]]:
        """Take the frame that an episode begins with: what `reset` returns."""
        self._moment = self._at(frame)
        return self._observation(self._moment), self._info(self._moment)

    def decided(self, action: A) -> Action:
        """Make of an action what the agent answers the present frame with.

        Raises:
            PayloadError: The action is none of `action_space`.
            RunError: No episode has begun.
        """
        # A learner's mistake, which would otherwise wait for a grant that never comes.
        if self._moment is None or self._moment.frame.final:
            raise RunError("the episode is over, or none has begun; call reset()")
        return Action(commands=tuple(self._commands(action, self._moment)))

    def moved(self, frame: Frame) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Take the frame that follows on a decision: what `step` returns."""
        before = self._moment
        if before is None:
            raise RunError("no episode has begun; call reset()")
        self._moment = now = self._at(frame)
        if now.link is None:
            raise RunError(f"agent {self.agent!r} got no link of frame {before.frame.number}; is there one?")
        reward = self._rewarded(before, now, now.link)
        info = self._info(now) | self._lateness(before.frame, frame)
        return self._observation(now), reward, self._terminated(now), now.frame.final, info

    def _lateness(self, before: Frame, now: Frame) -> dict[str, Any]:
        """Lateness of the decision for a frame, and the number of frames that went on without any."""
        if self._broker is None:
            return {"late": False, "missed_frames": 0}  # the run waits
        missed = now.number - before.number - 1
        own = (i.provenance for i in now.inputs if i.provenance.topic == "action")
        in_time = any(entry.source == self.agent and entry.status is Status.FRESH for entry in own)
        return {"late": missed > 0 or not in_time, "missed_frames": missed}

    def close(self) -> None:
        """End the run, or leave it. A later `reset` begins another one."""
        # Before the session is closed: a second close, of a wrapper, finds nothing to do.
        session, self._session, self._moment = self._session, None, None
        if session is not None:
            session.close()

    def render(self) -> Any:
        """Draw a map of the scene as an RGB image, Shape ``[480, 640, 3]``; None without ``render_mode``."""
        moment = self._moment
        if self.render_mode is None or moment is None:
            return None
        if self._renderer is None:
            self._renderer = MapRenderer()
        pair = moment.users[0][1] if moment.users else None
        title = f"frame {moment.frame.number}, t = {moment.frame.t_ns / 1e9:.2f} s"
        return self._renderer.draw(moment.scene, moment.link, pair, title)

    def __getstate__(self) -> dict[str, Any]:
        """A copy, or one in another process, has no run: it begins an episode with `reset`."""
        return {**self.__dict__, "_session": None, "_moment": None, "_renderer": None}

    def _open(self) -> Session:
        """Open the session of the environment's agent."""
        return open_session(
            self.prepared,
            self.agent,
            self.inputs(),
            self._broker,
            self._directory,
            self._credentials,
            with_scenery=self.uses_scenery,
            beside=self._beside,
            connect_timeout_s=self._connect_timeout_s,
        )

    # --- what a kind of environment defines -----------------------------------------------------------

    @abstractmethod
    def _commands(self, action: A, moment: Moment) -> Sequence[Command]:
        """Translate an action into commands of the agent."""

    def _begin(self, options: Mapping[str, Any]) -> None:
        """Bring the first frame of an episode to what the ``options`` of a reset ask for."""

    def _rewarded(self, before: Moment, now: Moment, link: Link) -> float:
        """Work out the reward of the decision between two moments; ``link`` is what it led to."""
        served = {(pair.tx.name, pair.rx.name) for _, pair in before.users}
        return self.reward.mean(link, served)

    def _terminated(self, moment: Moment) -> bool:
        """Tell whether the goal is reached, or cannot be any more."""
        return False

    # --- from frames to observations ------------------------------------------------------------------

    def inputs(self) -> tuple[Input, ...]:
        """Give what the agent consumes: one input for each topic, since two cameras are in one product."""
        own = (Input(topic="scene"), Input(topic="link", lag=1, required=False), *self.observer.inputs)
        # What became of its own decision; in this process none is ever late.
        return own if self._broker is None else (*own, Input(topic="action", lag=1, required=False))

    def _at(self, frame: Frame) -> Moment:
        link = frame.only("link", Link)
        last = self._moment
        if frame.final and last is not None:
            # Only the link comes with it; what else was seen in the last frame still is.
            seen = (item for item in last.frame.inputs if item.provenance.topic != "link")
            return Moment(replace(frame, inputs=(*frame.inputs, *seen)), last.scene, link, last.users)
        scene = frame.scene()
        return Moment(frame, scene, link, self.users.present(scene))

    def _observation(self, moment: Moment) -> Observation:
        return self.observer.read(moment)

    def _info(self, moment: Moment) -> dict[str, Any]:
        link = moment.link
        known: dict[str, Any] = {"frame": moment.frame.number, "t_ns": moment.frame.t_ns}
        if link is not None:
            known |= link_info(link)
        return known


class BeamSelectionEnv(SessionEnv[np.int64 | NDArray[np.int64]]):
    """Choose a beam pair for each user in every frame (the paper, section 4): ``caviar/BeamSelection-v0``.

    The action is the index ``tx_beam·Nr + rx_beam`` of a pair of the two DFT codebooks: ``Discrete`` for one
    place, ``MultiDiscrete`` with one entry for each place otherwise.

    Args:
        scenario: Scenario file, or the name of a scenario that ships.
        options: The other arguments of `SessionEnv`.

    Example:
        >>> env = BeamSelectionEnv("geometric")
        >>> env.action_space
        Discrete(64)
    """

    def __init__(self, scenario: str | Path | PreparedScenario, **options: Any) -> None:
        super().__init__(scenario, **options)
        self._sizes = sizes = [place.beam_pairs for place in self.users.places]
        self.action_space = spaces.Discrete(sizes[0]) if len(sizes) == 1 else spaces.MultiDiscrete(sizes)

    def _commands(self, action: np.int64 | NDArray[np.int64], moment: Moment) -> Sequence[Command]:
        sizes = self._sizes
        # A Discrete space samples NumPy's integers; learners pass arrays of one entry, too.
        chosen = [int(action)] if isinstance(action, np.integer) else np.ravel(action).tolist()
        if len(chosen) != len(sizes) or not all(
            isinstance(index, int) and 0 <= index < size for index, size in zip(chosen, sizes, strict=True)
        ):
            raise PayloadError(self._refusal(action, chosen, moment))
        commands = []
        for place, pair in moment.users:
            tx_beam, rx_beam = divmod(chosen[place], pair.beams[1])
            commands.append(BeamChoice(tx=pair.tx.name, rx=pair.rx.name, tx_beam=tx_beam, rx_beam=rx_beam))
        return sorted(commands, key=lambda choice: (choice.rx, choice.tx))

    def _refusal(self, action: object, chosen: Sequence[object], moment: Moment) -> str:
        """Say what is wrong with an action, and what to write."""
        sizes = self._sizes
        users = {place: f"{pair.tx.name} → {pair.rx.name}" for place, pair in moment.users}
        if len(sizes) == 1:
            form = f"an int from 0 to {sizes[0] - 1}"
        elif len(set(sizes)) == 1:
            form = f"{len(sizes)} ints, one for each place, from 0 to {sizes[0] - 1} each"
        else:
            ranges = " and ".join(f"from 0 to {size - 1}" for size in sizes)
            form = f"{len(sizes)} ints, one for each place, {ranges}"
        wrong = ""
        if len(chosen) == len(sizes) > 1:
            ok = (isinstance(v, int) and 0 <= v < size for v, size in zip(chosen, sizes, strict=True))
            place = [*ok].index(False)
            wrong = f", with {chosen[place]!r} at place {place} ({users.get(place, 'without a user now')})"
        elif users and len(sizes) == 1:
            wrong = f" for {users[0]}"
        text = " ".join(repr(action).split())
        return f"the action is {text}{wrong}; write {form}: tx_beam·Nr + rx_beam, a pair of the codebooks"
