"""``caviar/BeamSelection-v0``: choose a beam pair for each user, every frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from caviar_clients.envs.base import SessionEnv
from caviar_clients.envs.observations import Moment
from caviar_protocol.errors import PayloadError
from caviar_protocol.topics import BeamChoice
from caviar_protocol.topics.link import Command


class BeamSelectionEnv(SessionEnv[np.int64 | NDArray[np.int64]]):
    """Beam selection (the paper, section 4).

    The action is the index ``tx_beam·Nr + rx_beam`` of a pair of the two DFT codebooks: ``Discrete`` for one
    place, ``MultiDiscrete`` with one entry for each place otherwise. Parameters as `SessionEnv`.
    """

    def __init__(self, scenario: str | Path, **options: Any) -> None:
        super().__init__(scenario, **options)
        self._sizes = sizes = [place.beam_pairs for place in self.users.places]
        self.action_space = spaces.Discrete(sizes[0]) if len(sizes) == 1 else spaces.MultiDiscrete(sizes)

    def _commands(self, action: np.int64 | NDArray[np.int64], moment: Moment) -> Sequence[Command]:
        sizes = self._sizes
        chosen = [int(action)] if isinstance(action, np.integer) else np.ravel(action).tolist()
        if len(chosen) != len(sizes) or not all(
            isinstance(index, int) and 0 <= index < size for index, size in zip(chosen, sizes, strict=True)
        ):
            highest = ", ".join(str(size - 1) for size in sizes)
            raise PayloadError(
                f"the action is {action!r}; write {len(sizes)} whole number(s), one a place, "
                f"from 0 to at most {highest}"
            )
        commands = []
        for place, pair in moment.users:
            tx_beam, rx_beam = divmod(chosen[place], pair.rx.array.size)
            commands.append(BeamChoice(tx=pair.tx.name, rx=pair.rx.name, tx_beam=tx_beam, rx_beam=rx_beam))
        return sorted(commands, key=_order)


def _order(choice: BeamChoice) -> tuple[str, str]:
    return choice.rx, choice.tx
