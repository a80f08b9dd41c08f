"""What ranks the pairs of beams of a dataset's users: policies, and baselines to hold them against.

Baselines that learn do so from other episodes: the most frequent pairs, the pairs of the nearest users, and
the agent ``fingerprint``. ``los-beam``, ``out-of-band`` and sweeps are the agents of a run
(`caviar_services.agent`), asked for each recorded frame; what they try is their ranking.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, cast

import msgspec
import numpy as np

from caviar_clients.datasets.reader import Dataset
from caviar_clients.learning.samples import EVERYONE, Samples, Selection
from caviar_protocol.arrays import Int64Array
from caviar_protocol.errors import ScenarioError
from caviar_protocol.observations import Users as Places
from caviar_protocol.scenario import Scenario
from caviar_protocol.space.antenna_arrays import steering_vector
from caviar_protocol.space.beams import beam_gains
from caviar_protocol.topics import Channel, Link
from caviar_services.agent.fingerprint import FingerprintAgent, Fingerprints, FingerprintSettings
from caviar_services.agent.pilots import Measured, PilotAgent, PilotSettings, Sounding
from caviar_services.agent.policy import SCORES, PolicyModel
from caviar_services.agent.sweeps import (
    ExhaustiveSweepAgent,
    HierarchicalSettings,
    HierarchicalSweepAgent,
    OutOfBandAgent,
    OutOfBandSettings,
)
from caviar_services.link.base import User, channels_of
from caviar_services.link.base import Users as LinkUsers
from caviar_services.service import RunInfo

NEIGHBOURS = 5
"""Users of training that the nearest-neighbour rule looks at."""
CELL_M = 5.0
"""Edge of a cell of positions of the agent ``fingerprint`` [m]."""
_MOST = 4096
_CHUNK = 512


class Ranking(NamedTuple):
    """Ranking of the pairs of N users by one method."""

    order: Int64Array
    """Indices of pairs, best first, Shape ``[N, K]``; −1 where a ranking ends."""
    pilots: float | None = None
    """Of a frame, on average, of a method that sends them to find its pair; None: for each user as many as
    pairs are tried."""


def ranked_by_policy(model: PolicyModel, samples: Samples, called: str) -> Ranking:
    """Rank by a policy, scene by scene as an agent does.

    Args:
        model: The policy, with a card.
        samples: With what it observes.
        called: What errors call it.

    Raises:
        ScenarioError: It was trained for other codebooks.
    """
    card = model.card
    if card is None or not set(card.codebooks) <= {samples.beams}:
        trained = "no card says for which" if card is None else f"{card.codebooks[0]} beams"
        raise ScenarioError(
            f"{called} was trained for other codebooks ({trained}) than the dataset has, {samples.beams}"
        )
    if not card.per_user and len(card.codebooks) != samples.places:
        raise ScenarioError(
            f"{called} was trained for {len(card.codebooks)} users, and the dataset's scenario has "
            f"{samples.places}; train one for these"
        )
    order: Int64Array | None = None
    starts = np.flatnonzero(np.diff(samples.scene, prepend=-1))
    for users in np.split(np.arange(len(samples)), starts[1:]):
        scene = samples.scene[users[0]]
        observation = {name: samples.observed[name][scene] for name in model.inputs}
        found = model.ranked(observation) if SCORES in model.outputs else model.act(observation)[:, None]
        order = np.empty((len(samples), found.shape[1]), np.int64) if order is None else order
        order[users] = found[samples.place[users]]
    assert order is not None  # noqa: S101 - there are users
    return Ranking(order)


# --- baselines that learn from other episodes ---------------------------------------------------------------


def ranked_by_frequency(learnt: Samples, samples: Samples) -> Ranking:
    """Rank for all users alike: pairs that were the best of most users first, then by their mean |y|².

    Args:
        learnt: Users that the counts are of.
        samples: Users that are ranked for.
    """
    pairs = learnt.abs_y.shape[1]
    counts = np.bincount(learnt.best[learnt.has_path], minlength=pairs)
    order = np.lexsort((-(learnt.abs_y**2).sum(0), -counts))
    return Ranking(np.broadcast_to(order, (len(samples), pairs)))


def ranked_by_neighbours(learnt: Samples, samples: Samples, neighbours: int = NEIGHBOURS) -> Ranking:
    """Rank by the mean of |y|² over its greatest, of the users that were nearest in position.

    Args:
        learnt: Users that are looked at.
        samples: Users that are ranked for.
        neighbours: How many.
    """
    learnt = learnt.where(learnt.has_path)
    power = learnt.abs_y**2 / (learnt.abs_y**2).max(1, keepdims=True)
    order = np.empty((len(samples), power.shape[1]), np.int64)
    near = min(neighbours, len(learnt))
    for start in range(0, len(samples), _CHUNK):
        mine = slice(start, start + _CHUNK)
        away = ((samples.position[mine, None] - learnt.position) ** 2).sum(2)
        nearest = np.argpartition(away, near - 1, axis=1)[:, :near]
        order[mine] = np.argsort(-power[nearest].mean(1), axis=1, kind="stable")
    return Ranking(order)


def ranked_along_the_line(samples: Samples) -> Ranking:
    """Rank by |y| of a lone path along the straight line; the first pair is that of the agent ``los-beam``.

    Args:
        samples: Users that are ranked for.
    """
    tx, rx = samples.arrays
    straight: Int64Array = samples.straight[:, None]
    if not (tx.is_uniform and rx.is_uniform):  # panels and polarizations: the agent's pair alone
        return Ranking(straight)
    found = []
    for start in range(0, len(samples), _CHUNK):
        mine = slice(start, start + _CHUNK)
        sent, taken = (
            steering_vector(tx, samples.towards_rx[mine]),
            steering_vector(rx, samples.towards_tx[mine]),
        )
        gains = beam_gains(taken[:, :, None] * sent[:, None, :], tx, rx).reshape(len(sent), -1)
        # Of beams that are equal in theory rounding decides: the agent's own comes first.
        np.put_along_axis(gains, straight[mine], np.inf, axis=1)
        found.append(np.argsort(-gains, axis=1, kind="stable"))
    return Ranking(np.concatenate(found))


# --- agents, asked frame by frame ---------------------------------------------------------------------------


@dataclass(frozen=True)
class _Listening(Sounding):
    """A sounding that hears which pairs an agent means to try, in its order."""

    tried: dict[int, Sequence[tuple[int, int]]] = field(default_factory=dict)

    def best_of(self, index: int, pairs: Sequence[tuple[int, int]]) -> Measured | None:
        self.tried[index] = pairs
        return super().best_of(index, pairs)


def ranked_by_agent(
    agent: PilotAgent[Any], dataset: Dataset, samples: Samples, selection: Selection = EVERYONE
) -> Ranking:
    """Rank by what an agent tries in each recorded frame, or by the pair that it takes.

    Args:
        agent: Prepared.
        dataset: Of the samples, with topics ``scene`` and ``channel``.
        samples: Users that are ranked for.
        selection: By which they were read.
    """
    scenario = msgspec.convert(dataset.settings["scenario"], Scenario)
    rows = {(int(s), int(p)): n for n, (s, p) in enumerate(zip(samples.scene, samples.place, strict=True))}
    order = np.full((len(samples), samples.abs_y.shape[1]), -1, np.int64)
    receive, sent, at = samples.beams[1], 0, -1
    carrier = selection.carrier or scenario.carriers[0].name
    places = Places(scenario, selection.users, (), selection.transmitters)
    for episode in dataset.episodes:
        for frame in dataset.episode(episode).frames():
            at += 1
            scene = frame.scene()
            channel = next(iter(frame.payloads("channel", Channel).values()))
            assert scene is not None  # noqa: S101 - the samples were read from it
            present = places.present(scene)
            users = LinkUsers(User(pair.tx, pair.rx, c) for c in channel.carriers for _, pair in present)
            seats = [place for _ in channel.carriers for place, _ in present]
            sounding = _Listening(
                frame=cast(Any, None), scene=scene, users=users, h=channels_of(channel, users).h,
                noise_energy=0.0, pilot_s=1.0, sent=defaultdict(int), events={},
            )  # fmt: skip
            for user, tx_beam, rx_beam in agent.select(sounding):
                row = rows.get((at, seats[user]))
                if row is None or users[user].carrier.name != carrier:
                    continue
                pairs = sounding.tried.get(user, [(tx_beam, rx_beam)])
                order[row, : len(pairs)] = [t * receive + r for t, r in pairs]
            sent += sounding.pilots
    kept = max(1, int((order >= 0).sum(1).max()))
    return Ranking(order[:, :kept], None if kept > 1 else sent / (at + 1))


def exhaustive_sweep() -> PilotAgent[Any]:
    """The agent ``exhaustive-sweep``."""
    return ExhaustiveSweepAgent(PilotSettings(), RunInfo(name="agent"))


def hierarchical_sweep() -> PilotAgent[Any]:
    """The agent ``hierarchical-sweep``, with its default settings."""
    return HierarchicalSweepAgent(HierarchicalSettings(), RunInfo(name="agent"))


def out_of_band(dataset: Dataset) -> PilotAgent[Any] | None:
    """The agent ``out-of-band`` that tries all pairs; None for a dataset of one carrier.

    Args:
        dataset: Has the carriers.
    """
    carriers = msgspec.convert(dataset.settings["scenario"], Scenario).carriers
    if len(carriers) < 2:
        return None
    settings = OutOfBandSettings(
        candidates=_MOST, aid=min(carriers, key=lambda carrier: carrier.frequency_hz).name
    )
    return OutOfBandAgent(settings, RunInfo(name="agent"))


def fingerprint(dataset: Dataset) -> PilotAgent[Any]:
    """The agent ``fingerprint`` that tries all pairs of a cell.

    Args:
        dataset: Episodes that it learns from, with topics ``scene`` and ``link``.
    """
    table = Fingerprints(CELL_M)
    for episode in dataset.episodes:
        for frame in dataset.episode(episode).frames():
            scene = frame.scene()
            for link in frame.payloads("link", Link).values():
                if scene is not None:
                    table.learn(scene, link)
    agent = FingerprintAgent(FingerprintSettings(file="", candidates=_MOST), RunInfo(name="agent"))
    agent.table = table
    return agent
