"""Agent ``los-beam``: the baseline of the paper (section 4).

It chooses the beams that point along the straight line between transmitter and receiver, from
positions and orientations alone, whether or not that line is free.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from caviar_protocol.space.beams import straight_beams
from caviar_protocol.space.scene import Pair, directions
from caviar_protocol.topics import BeamChoice, Scene
from caviar_services.agent.base import Agent, AgentSettings
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
