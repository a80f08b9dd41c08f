"""What brings a service that lost its state back to where it was (contract, clause 18)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from caviar_broker.core.tasks import GrantOrder

MAX_WEIGHT = 64 * 2**20
"""[B] of products kept for a service, behind which its state is saved before its turn."""

Weigh = Callable[[Any], int]
"""Size of a product's payload [B], which only the shell can tell."""


@dataclass(slots=True)
class Remembered:
    """A grant, and what it was answered with."""

    order: GrantOrder
    digests: Mapping[str, str] | None
    """By topic; None: with FAULT."""


@dataclass(slots=True)
class Memory:
    """The last checkpoint of one service in one episode, and the grants that it answered since.

    They are sent again one after the other to an incarnation that has been reset.
    """

    frame: int = -1
    """Of the checkpoint; −1: there is none."""
    state: Any = None
    """As the service sent it, opaque."""
    grants: list[Remembered] = field(default_factory=list)
    weight: int = 0
    """Of their products [B]."""
    asked: int | None = None
    """Frame of the CHECKPOINT that is not answered yet."""
    asked_at: int = 0
    """When it was sent [ns]."""
    position: int = 0
    """The grant that is sent again next, or was and is not answered yet."""

    def remember(self, order: GrantOrder, digests: Mapping[str, str] | None, weigh: Weigh) -> None:
        """A grant was answered."""
        self.grants.append(Remembered(order, digests))
        self.weight += sum(weigh(product.payload) for product in order.products)

    def due(self, period: int) -> bool:
        """Whether it is time to save the state."""
        return len(self.grants) >= period or self.weight > MAX_WEIGHT

    def saved(self, state: Any) -> None:
        """CHECKPOINT was answered; nothing had been granted meanwhile."""
        assert self.asked is not None, "a state that nobody asked for"
        assert self.asked == self.last, f"state after frame {self.asked}, not {self.last}"
        self.frame, self.state, self.asked = self.asked, state, None
        self.grants.clear()
        self.weight = 0

    def rewind(self) -> None:
        """The service lost its state."""
        self.asked, self.position = None, 0

    @property
    def pending(self) -> Remembered | None:
        """What is to be answered once more; None: the service is where it was."""
        return self.grants[self.position] if self.position < len(self.grants) else None

    @property
    def last(self) -> int:
        """The frame that the service completed last; −1: none."""
        return self.grants[-1].order.frame if self.grants else self.frame
