"""Several agents in the same episodes: each frame's scene and channel are computed once, and shown to all.

Every agent has a link of its own, which scores its choices, and sees the feedback of that link alone. So the
comparison is paired frame by frame, and costs one channel however many agents there are.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from msgspec.structs import replace

from caviar_clients.session.connected import agent_of, open_session
from caviar_protocol.arrays import BoolArray, Float64Array
from caviar_protocol.errors import ScenarioError
from caviar_protocol.messages import GrantInput, Input, Status
from caviar_protocol.observations import Users
from caviar_protocol.scenario import Scenario, ServiceSpec
from caviar_protocol.scenario.conversion import Place, convert_settings
from caviar_protocol.scenario.rules import settings_place
from caviar_protocol.topics import Action, Link
from caviar_services.agent.pilots import PILOT_TIME, PILOTS
from caviar_services.registry import load, with_inputs
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo, Service


@dataclass(frozen=True)
class EpisodeScore:
    """Score of an agent's choices in an episode, by user and frame; users without a path are left out.
    Shape ``[N]`` each."""

    abs_y: Float64Array
    """Of the chosen pairs."""
    straight: Float64Array
    """Of the pairs along the straight line."""
    best: Float64Array
    """Of the best pairs."""
    los: BoolArray
    net_efficiency: Float64Array
    """Spectral efficiency [bit/s/Hz] that the pilots of the frame leave."""
    pilots: float
    """Of a frame, mean over the episode."""
    station: tuple[str, ...]
    """Transmitter and carrier of each, as ``lamp on mm``."""

    def mask(self, kind: str) -> BoolArray:
        """Mask of those of a kind: ``all``, ``LOS``, ``NLOS``, or of a station."""
        if kind == "all":
            return np.ones(len(self.los), np.bool_)
        if kind in self.station:
            return np.array([name == kind for name in self.station], np.bool_)
        if kind not in ("LOS", "NLOS"):
            return np.zeros(len(self.los), np.bool_)
        return self.los if kind == "LOS" else ~self.los


@dataclass
class _Seat:
    """An agent of a contest, its link, and what was measured in the present episode."""

    player: Service[Any]
    link: Service[Any]
    last: Link | None = None
    rows: list[Float64Array] = field(default_factory=list)
    stations: list[str] = field(default_factory=list)
    pilots: list[int] = field(default_factory=list)


class Contest:
    """Agents that play the same episodes.

    Args:
        scenario: Checked, as `caviar_clients.session.prepared.prepare` checks it. The agents take the
            place of one of its own.
        players: By name.
        users: Receivers that count, as names with ``*`` and ``?``.
        agent: Of the scenario, whose place they take; None: the only one.
        transmitters: Whose users count, likewise.

    Raises:
        ScenarioError: The scenario has no such agent, or no link, or several.

    Example:
        >>> from caviar_clients.session.prepared import prepare
        >>> scenario = prepare("geometric", frames=20).scenario
        >>> agents = {name: made_player(scenario, name) for name in ("random", "oracle")}
        >>> with Contest(scenario, agents) as contest:
        ...     found = contest.play(seed=1)
        >>> bool((found["random"].abs_y <= found["oracle"].abs_y).all())
        True
    """

    def __init__(
        self,
        scenario: Scenario,
        players: Mapping[str, Service[Any]],
        users: Sequence[str] = ("*",),
        agent: str | None = None,
        transmitters: Sequence[str] = ("*",),
    ) -> None:
        self._scenario, self._users = scenario, Users(scenario, users, transmitters=transmitters)
        self._agent = agent_of(scenario, agent)
        links = [name for name, spec in scenario.services.items() if spec.role == "link"]
        if len(links) != 1:
            raise ScenarioError(
                f"agents are compared by one link, and {scenario.run.name!r} has {len(links)}; use a "
                "scenario with one"
            )
        self._link = links[0]
        self._seats = {
            name: _Seat(player, _prepared(scenario, self._link, scenario.services[self._link]))
            for name, player in players.items()
        }
        first = next(iter(self._seats.values()))
        wanted = [*first.link.inputs, *(i for seat in self._seats.values() for i in seat.player.inputs)]
        self._session = open_session(scenario, self._agent, _merged(wanted))

    def __enter__(self) -> Contest:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the run."""
        self._session.close()

    def play(self, seed: int | None) -> dict[str, EpisodeScore]:
        """Play an episode.

        Args:
            seed: Of the episode; None: the one that follows on the last.

        Returns:
            What each agent reached, by name.
        """
        frame = self._session.reset(seed)
        for seat in self._seats.values():
            seat.last, seat.rows, seat.stations, seat.pilots = None, [], [], []
            for service in (seat.player, seat.link):
                service.reset(frame.seed_episode, frame.seed, 0)
        nothing = Action(commands=())
        while not frame.final:
            served = {(pair.tx.name, pair.rx.name) for _, pair in self._users.present(frame.scene())}
            for seat in self._seats.values():
                self._decide(seat, frame, served)
            frame = self._session.step({"action": nothing})
        return {name: _scored(seat) for name, seat in self._seats.items()}

    def _decide(self, seat: _Seat, frame: Frame, served: set[tuple[str, str]]) -> None:
        """Have an agent choose, and its link score that."""
        topics = {item.topic for item in seat.player.inputs if not item.lag}
        seen = [item for item in frame.inputs if item.provenance.topic in topics]
        if seat.last is not None:
            provenance = GrantInput(
                topic="link", source=self._link, status=Status.FRESH, frame=frame.number - 1, age=1
            )
            seen.append(FrameInput(provenance, payload=seat.last))
        made = seat.player.step(replace(frame, inputs=tuple(seen)))
        provenance = GrantInput(topic="action", source=self._agent, status=Status.FRESH, frame=frame.number)
        action = made.products.get("action", Action(commands=()))
        topics = {item.topic for item in seat.link.inputs}
        inputs = [item for item in frame.inputs if item.provenance.topic in topics]
        inputs.append(FrameInput(provenance, payload=action))
        result = seat.link.step(replace(frame, inputs=tuple(inputs), service=self._link))
        link = result.products["link"]
        assert isinstance(link, Link)  # noqa: S101  # what a link makes
        seat.last = link
        left = 1.0 - made.counts.get(PILOT_TIME, 0) / self._scenario.run.sampling_period_ns
        counted = link.has_path & np.array(
            [p in served for p in zip(link.tx, link.rx, strict=True)], np.bool_
        )
        columns = (
            link.abs_y,
            link.baseline_abs_y,
            link.top_abs_y[:, :1].reshape(-1),
            link.los,
            link.spectral_efficiency * max(0.0, left),
        )
        kept: Float64Array = np.stack(columns, axis=1, dtype=np.float64)[counted]
        seat.rows.append(kept)
        stations = [f"{tx} on {carrier}" for tx, carrier in zip(link.tx, link.carrier, strict=True)]
        seat.stations += [name for name, counts in zip(stations, counted.tolist(), strict=True) if counts]
        seat.pilots.append(made.counts.get(PILOTS, 0))


def _scored(seat: _Seat) -> EpisodeScore:
    abs_y, straight, best, los, net_efficiency = np.concatenate(seat.rows).T
    return EpisodeScore(
        abs_y=abs_y,
        straight=straight,
        best=best,
        los=los > 0,
        net_efficiency=net_efficiency,
        pilots=float(np.mean(seat.pilots)),
        station=tuple(seat.stations),
    )


def made_player(
    scenario: Scenario,
    use: str,
    settings: Mapping[str, Any] | None = None,
    users: Sequence[str] = ("*",),
    agent: str | None = None,
) -> Service[Any]:
    """Make an agent for a contest, prepared.

    Args:
        scenario: In which it plays.
        use: Registered name, or ``module:Class``.
        settings: Of the agent, as in a scenario.
        users: Receivers that it serves.
        agent: Of the scenario, whose place it takes; None: the only one. Its random numbers are that one's.

    Raises:
        ScenarioError: There is no such agent, or its settings do not fit; the text says which.
    """
    name = agent_of(scenario, agent)
    spec = replace(scenario.services[name], use=use, settings={**(settings or {}), "users": tuple(users)})
    return _prepared(scenario, name, spec)


def _prepared(scenario: Scenario, name: str, spec: ServiceSpec) -> Service[Any]:
    cls = load(spec.role, spec.use)
    cls = with_inputs(cls, cls.inputs_with(spec.settings))
    place = Place(spec.use) if spec.role == "agent" else settings_place(scenario, name)
    settings = convert_settings(cls.Settings, spec.settings, place)
    cls.check_settings(settings, place)
    cls.check_scenario(settings, scenario, place)
    run = RunInfo(
        name=name,
        seed=scenario.run.seed,
        sampling_period_ns=scenario.run.sampling_period_ns,
        frames=scenario.run.frames,
        carriers=scenario.carriers,
        devices=scenario.devices,
        settings_key=place.key,
    )
    service = cls(settings, run)
    service.prepare(Preparation(demand={topic: frozenset() for topic in cls.outputs}))
    return service


def _merged(inputs: Iterable[Input]) -> tuple[Input, ...]:
    """One input for each topic that is no agent's or link's, with all parts that anything asks for."""
    parts: dict[str, set[str]] = defaultdict(set)
    for item in inputs:
        if item.topic not in ("link", "action"):
            parts[item.topic] |= set(item.parts)
    return tuple(Input(topic=topic, parts=tuple(sorted(found))) for topic, found in sorted(parts.items()))


def episodes_of(seeds: Iterable[int], episodes: int) -> Iterator[int | None]:
    """Seeds to give `Contest.play`, for ``episodes`` of each seed.

    Example:
        >>> list(episodes_of([7, 8], 2))
        [7, None, 8, None]
    """
    for seed in seeds:
        yield seed
        yield from [None] * (episodes - 1)
