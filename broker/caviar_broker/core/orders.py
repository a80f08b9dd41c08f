"""What is sent with a grant: inputs, and to recorders also what came late and what others told."""

from __future__ import annotations

from caviar_broker.core.decisions import DecisionBook
from caviar_broker.core.events import Product
from caviar_broker.core.tasks import Decision, Gathered, GrantOrder, Task, provenance
from caviar_broker.core.turns import Turns
from caviar_protocol.messages import GrantInput, Report, Status


class Orders:
    """Writes the grants of one episode."""

    def __init__(self, book: DecisionBook, turns: Turns) -> None:
        self._book, self._turns = book, turns
        self.late: list[Product] = []
        """Late products that the recorder has not been told of (clause 11)."""

    def order(self, task: Task, gathered: Gathered, previous: int) -> GrantOrder:
        """The grant of a task to a service whose last frame is ``previous``."""
        inputs, products = gathered.provided(task.frame)
        reports: list[Report] = []
        if task.service in self._turns.recorders:
            told = [product for product in self.late if product.frame <= task.frame]
            self.late = [product for product in self.late if product.frame > task.frame]
            inputs += [_late_input(product, task.frame) for product in told]
            products += told
            of_frame = (self._book.find(name, task.frame) for name in self._turns.others)
            reports = sorted((t.report for t in of_frame if t and t.report), key=lambda r: r.source)
        final = task.frame == self._book.frames
        return GrantOrder(
            task.service, task.frame, previous, final, tuple(inputs), tuple(products), tuple(reports)
        )


def _late_input(product: Product, frame: int) -> GrantInput:
    return provenance(product.topic, product.source, Decision(Status.LATE, product), frame)
