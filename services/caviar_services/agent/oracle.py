"""Agent ``oracle``: the best pair by exhaustive search over the true channel (paper, eq. 2)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import ClassVar

from caviar_protocol.errors import PayloadError
from caviar_protocol.messages import Input
from caviar_protocol.space.scene import Pair
from caviar_protocol.topics import BeamChoice, Channel, Scene
from caviar_services.agent.base import Agent, AgentSettings
from caviar_services.link.sweep import best_pairs
from caviar_services.link.users import User, Users, channels_of, sweep_users
from caviar_services.service import Frame


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
