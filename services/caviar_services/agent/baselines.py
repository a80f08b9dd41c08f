"""Agents without learning, which others are compared with: ``los-beam``, ``random`` and ``oracle``.

``los-beam`` is the baseline of the paper (section 4): it points both beams along the straight line between
transmitter and receiver, from positions and orientations alone, whether or not that line is free.
``random`` is the floor. ``oracle`` is the bound: the best pair by exhaustive search over the true channel
(paper, eq. 2).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import ClassVar

from caviar_protocol.errors import PayloadError
from caviar_protocol.messages import Input
from caviar_protocol.space.beams import straight_beams
from caviar_protocol.space.scene import Pair, directions
from caviar_protocol.topics import BeamChoice, Channel, Scene
from caviar_services.agent.base import Agent, AgentSettings
from caviar_services.link.beam_sweep import best_pairs, sweep_users
from caviar_services.link.users import User, Users, channels_of
from caviar_services.service import Frame


def straight_choices(scene: Scene, pairs: Sequence[Pair]) -> Iterator[BeamChoice]:
    """The straight-line pair of beams of each pair of devices, the same on every carrier."""
    at_tx, at_rx = directions(scene, pairs)
    for pair, towards_rx, towards_tx in zip(pairs, at_tx, at_rx, strict=True):
        tx_beam, rx_beam = straight_beams(pair.tx.array, towards_rx, pair.rx.array, towards_tx)
        yield BeamChoice(tx=pair.tx.name, rx=pair.rx.name, tx_beam=tx_beam, rx_beam=rx_beam)


class LosBeamAgent(Agent[AgentSettings]):
    """Points both beams along the straight line."""

    Settings = AgentSettings

    def choose(self, frame: Frame, scene: Scene, pairs: Sequence[Pair]) -> Iterator[BeamChoice]:
        """The straight-line pair of each user, the same on every carrier."""
        return straight_choices(scene, pairs)


class RandomAgent(Agent[AgentSettings]):
    """Uniform over all beam pairs, independent between users and frames."""

    Settings = AgentSettings

    def choose(self, frame: Frame, scene: Scene, pairs: Sequence[Pair]) -> Iterator[BeamChoice]:
        """A random pair for each user; a user's draw does not depend on who else is there."""
        for pair in pairs:
            generator = frame.generator(f"{pair.tx.name}/{pair.rx.name}")
            yield BeamChoice(
                tx=pair.tx.name,
                rx=pair.rx.name,
                tx_beam=int(generator.integers(pair.tx.array.size)),
                rx_beam=int(generator.integers(pair.rx.array.size)),
            )


class OracleAgent(Agent[AgentSettings]):
    """Knows this frame's channel, which no real agent does: the bound that others are held to."""

    Settings = AgentSettings
    inputs: ClassVar[tuple[Input, ...]] = (*Agent.inputs, Input(topic="channel", parts=("h",)))

    def choose(self, frame: Frame, scene: Scene, pairs: Sequence[Pair]) -> Iterator[BeamChoice]:
        """The pair of greatest |y| on each carrier; no choice for a user without a path."""
        channel = frame.only("channel", Channel)
        if channel is None:
            raise PayloadError(f"{self.run.name} was granted frame {frame.number} without a channel")
        users = Users(User(pair.tx, pair.rx, carrier) for carrier in channel.carriers for pair in pairs)
        for swept in sweep_users(users, channels_of(channel, users).h):
            best = best_pairs(swept.abs_y, 1)
            for u, tx_beam, rx_beam in zip(swept.users, best.tx_beam[:, 0], best.rx_beam[:, 0], strict=True):
                yield BeamChoice(
                    tx=users[u].tx.name,
                    rx=users[u].rx.name,
                    tx_beam=int(tx_beam),
                    rx_beam=int(rx_beam),
                    carrier=users[u].carrier.name,
                )
