"""Agent ``random``: the beams that chance picks, as a floor for comparisons."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from caviar_protocol.space.scene import Pair
from caviar_protocol.topics import BeamChoice, Scene
from caviar_services.agent.base import Agent, AgentSettings
from caviar_services.service import Frame


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
