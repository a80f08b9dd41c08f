"""Agents ``ucb`` and ``thompson``: bandits that learn from the feedback of their own choices, without pilots.

Each beam pair of a user is an arm, and what its receiver fed back of the frame before is the reward. What was
learnt is discounted from frame to frame, since users move. ``ucb`` takes the pair of the highest upper
confidence bound (discounted UCB: Garivier and Moulines, "On upper-confidence bound policies for switching
bandit problems", ALT 2011), ``thompson`` that of the highest draw from its normal posterior (Agrawal and
Goyal, "Further optimal regret bounds for Thompson sampling", AISTATS 2013). With ``cell_m`` there is a bandit
for each cell of positions, of which all receivers learn (as in Va, Shimizu, Bansal and Heath, "Online
learning for position-aided millimeter wave beam training", IEEE Access 7, 2019); else one for each receiver.

Draws are seeded by frame and user. What is learnt ends with the episode, as all state of a service does. It
is checkpointed, so that an agent that is killed goes on with the same choices.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from typing import Annotated, ClassVar, Literal, NamedTuple

import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array, quantity
from caviar_protocol.messages import Status
from caviar_protocol.space.beams import straight_beams
from caviar_protocol.space.scene import Pair, device_pose, directions
from caviar_protocol.topics import BeamChoice, Link, Scene
from caviar_services.agent.base import Agent, AgentSettings
from caviar_services.checkpoint import Packed, restored, saved
from caviar_services.service import Frame, RunInfo

Feedback = Literal["abs_y", "spectral_efficiency"]


class BanditSettings(AgentSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the agents ``ucb`` and ``thompson``."""

    feedback: Feedback = "abs_y"
    """What a receiver feeds back of the frame before: ``abs_y`` or ``spectral_efficiency``."""
    discount: Annotated[
        float, quantity("1", "weight that feedback keeps from one to the next", gt=0, le=1)
    ] = 0.99
    exploration: Annotated[
        float, quantity("1", "width of the bounds, in multiples of the highest feedback so far", ge=0, le=100)
    ] = 0.05
    cell_m: Annotated[float, quantity("m", "edge of a cell of positions", gt=0, le=1e6)] | None = None
    """Absent: a bandit for each receiver, wherever it is."""


class Feedbacks:
    """The feedback that came to a user of a link, with the pair that it is of."""

    def __init__(self, frame: Frame, kind: Feedback) -> None:
        self._found: dict[tuple[str, str, str], tuple[int, int, float]] = {}
        for item in frame.inputs:
            # A held link is that of an earlier frame, from which was learnt already.
            if item.provenance.topic != "link" or item.provenance.status is not Status.FRESH:
                continue
            link = item.payload
            if not isinstance(link, Link):
                continue
            names = zip(link.carrier, link.tx, link.rx, strict=True)
            values: Float64Array = getattr(link, kind)
            numbers = zip(link.tx_beam.tolist(), link.rx_beam.tolist(), values.tolist(), strict=True)
            self._found |= dict(zip(names, numbers, strict=True))

    def feedback(self, carrier: str, tx: str, rx: str) -> tuple[int, int, float] | None:
        """TX and RX beam that served a user, and what it fed back; None where it was not served."""
        found = self._found.get((carrier, tx, rx))
        return None if found is None or found[0] < 0 else found


class Bandit:
    """Statistics of the pairs of one user or cell.

    Args:
        arms: Number of pairs.

    Example:
        >>> bandit = Bandit(3)
        >>> bandit.learn(1, 2.0, discount=0.5)
        >>> bandit.learn(2, 4.0, discount=0.5)
        >>> bandit.plays.tolist(), bandit.sums.tolist(), bandit.highest
        ([0.0, 0.5, 1.0], [0.0, 1.0, 4.0], 4.0)
    """

    def __init__(self, arms: int) -> None:
        self.plays: Float64Array = np.zeros(arms)
        """Discounted number of times that each pair served."""
        self.sums: Float64Array = np.zeros(arms)
        """Discounted sum of its feedback."""
        self.highest = 0.0
        """Highest feedback so far."""

    def learn(self, arm: int, feedback: float, discount: float) -> None:
        """Take the feedback of a pair in."""
        self.plays *= discount
        self.sums *= discount
        self.plays[arm] += 1
        self.sums[arm] += feedback
        self.highest = max(self.highest, feedback)


class Context(NamedTuple):
    """Subject of a bandit."""

    carrier: str
    tx: str
    where: str
    """Receiver, or cell."""
    tx_beams: int
    rx_beams: int


class _Saved(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    context: Context
    plays: Packed
    sums: Packed
    highest: float


class _Asked(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """A user, and the bandit that chose for it in the frame before."""

    user: tuple[str, str, str]
    context: Context


class _BanditState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    bandits: tuple[_Saved, ...]
    asked: tuple[_Asked, ...]


class BanditAgent(Agent[BanditSettings]):
    """Base of agents with a bandit for each user or cell. Subclasses implement `pick`.

    Args:
        settings: Users, feedback, discount and exploration.
        run: What the agent knows about the run.
    """

    Settings: ClassVar[type[msgspec.Struct]] = BanditSettings
    checkpoints: ClassVar[bool] = True

    def __init__(self, settings: BanditSettings, run: RunInfo) -> None:
        super().__init__(settings, run)
        self._bandits: dict[Context, Bandit] = {}
        # By carrier, TX and RX: the bandit that chose in the frame before.
        self._asked: dict[tuple[str, str, str], Context] = {}

    def reset(self, episode: int, seed: int, t0_ns: int) -> None:
        """Every episode begins without knowledge."""
        self._bandits, self._asked = {}, {}

    def checkpoint(self) -> bytes:
        """All bandits, and which of them chose last."""
        bandits = tuple(
            _Saved(context, Packed.pack(b.plays, "<f8"), Packed.pack(b.sums, "<f8"), b.highest)
            for context, b in sorted(self._bandits.items())
        )
        asked = tuple(_Asked(user, context) for user, context in sorted(self._asked.items()))
        return saved(self, 1, _BanditState(bandits, asked))

    def restore(self, state: bytes) -> None:
        """See `checkpoint`."""
        found = restored(self, 1, _BanditState, state)
        self._bandits = {}
        for entry in found.bandits:
            bandit = self._bandits[entry.context] = Bandit(0)
            bandit.plays, bandit.sums = entry.plays.array(np.float64), entry.sums.array(np.float64)
            bandit.highest = entry.highest
        self._asked = {entry.user: entry.context for entry in found.asked}

    def choose(self, frame: Frame, scene: Scene, pairs: Sequence[Pair]) -> Iterator[BeamChoice]:
        """Learn from the frame before, then pick a pair for each user and carrier."""
        self._learn(frame)
        self._asked = {}
        at_tx, at_rx = directions(scene, pairs)
        for pair, towards_rx, towards_tx in zip(pairs, at_tx, at_rx, strict=True):
            where, sizes = self._where(scene, pair), pair.beams
            for carrier in self.run.carriers:
                context = Context(carrier.name, pair.tx.name, where, *sizes)
                bandit = self._bandits.get(context)
                if bandit is None:
                    bandit = self._bandits[context] = Bandit(pair.beam_pairs)
                self._asked[carrier.name, pair.tx.name, pair.rx.name] = context
                if bandit.plays.any():
                    # A stream of its own for each user: who else is there does not move its draws.
                    stream = f"{carrier.name}/{pair.tx.name}/{pair.rx.name}"
                    beams = divmod(self.pick(bandit, frame.generator(stream)), sizes[1])
                else:
                    beams = straight_beams(pair.tx.array, towards_rx, pair.rx.array, towards_tx)
                yield BeamChoice(
                    tx=pair.tx.name,
                    rx=pair.rx.name,
                    tx_beam=beams[0],
                    rx_beam=beams[1],
                    carrier=carrier.name,
                )

    @abstractmethod
    def pick(self, bandit: Bandit, generator: np.random.Generator) -> int:
        """Pick a pair.

        Args:
            bandit: What is known; at least one pair has served.
            generator: Of the user and frame.

        Returns:
            Index ``tx_beam·Nr + rx_beam``.
        """

    def _learn(self, frame: Frame) -> None:
        feedbacks = Feedbacks(frame, self.settings.feedback)
        for user, context in self._asked.items():
            found = feedbacks.feedback(*user)
            if found is not None:
                tx_beam, rx_beam, value = found
                arm = tx_beam * context.rx_beams + rx_beam
                self._bandits[context].learn(arm, value, self.settings.discount)

    def _where(self, scene: Scene, pair: Pair) -> str:
        edge = self.settings.cell_m
        if edge is None:
            return pair.rx.name
        return ",".join(str(math.floor(x / edge)) for x in device_pose(scene, pair.rx).position)


class UcbAgent(BanditAgent):
    """Picks the pair of the highest upper confidence bound; pairs that never served come first, in any order.

    Example:
        >>> agent, bandit = UcbAgent(BanditSettings(), RunInfo(name="agent")), Bandit(2)
        >>> bandit.learn(0, 5.0, 1.0)
        >>> agent.pick(bandit, np.random.default_rng(0))  # the one that has not served yet
        1
    """

    def pick(self, bandit: Bandit, generator: np.random.Generator) -> int:
        """The pair of the greatest S/n + c·B·sqrt(ln(N)/n): N is the sum of all n, B the highest feedback."""
        unknown = np.flatnonzero(bandit.plays == 0)
        if len(unknown):
            return int(generator.choice(unknown))
        plays = bandit.plays
        width = self.settings.exploration * bandit.highest
        bounds = bandit.sums / plays + width * np.sqrt(max(math.log(plays.sum()), 0.0) / plays)
        return int(bounds.argmax())


class ThompsonAgent(BanditAgent):
    """Picks the pair of the highest draw from the posteriors of their means.

    Example:
        >>> agent = ThompsonAgent(BanditSettings(exploration=0.0), RunInfo(name="agent"))
        >>> bandit = Bandit(3)
        >>> bandit.learn(0, 5.0, 1.0)
        >>> bandit.learn(1, 2.0, 1.0)
        >>> bandit.learn(2, 1.0, 1.0)
        >>> agent.pick(bandit, np.random.default_rng(0))  # without exploration: the best so far
        0
    """

    def pick(self, bandit: Bandit, generator: np.random.Generator) -> int:
        """The pair of the greatest draw from N((S + B)/(n + 1), (c·B)²/(n + 1)): B is the highest feedback.

        The prior of each pair is as good as the best feedback so far. With one of 0, pairs that never served
        would hardly be drawn once another one has.
        """
        weight = bandit.plays + 1.0
        highest = bandit.highest or 1.0  # as long as nothing came back, anything may
        spread = self.settings.exploration * highest / np.sqrt(weight)
        drawn = (bandit.sums + highest) / weight + spread * generator.standard_normal(len(weight))
        return int(drawn.argmax())
