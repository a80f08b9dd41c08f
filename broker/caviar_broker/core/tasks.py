"""Tasks, what is decided about their products, and the grants made from decisions."""

from __future__ import annotations

from dataclasses import dataclass, field

import msgspec

from caviar_broker.core.events import Product
from caviar_broker.core.graph import Edge
from caviar_broker.core.transitions import TASK, TaskEvent, TaskState, step
from caviar_protocol.messages import GrantInput, Report, Status


class Decision(msgspec.Struct, frozen=True):
    """What consumers of a frame get of one (topic, source)."""

    status: Status
    product: Product | None
    cause: str = ""
    journal: int = 0
    """Journal entry that holds a held product; 0: the one of this decision, as for one that is replayed."""


class GrantOrder(msgspec.Struct, frozen=True):
    """A grant that the schedule wants sent."""

    service: str
    frame: int
    previous: int
    final: bool
    inputs: tuple[GrantInput, ...]
    products: tuple[Product, ...]
    reports: tuple[Report, ...]


class Gathered(msgspec.Struct, frozen=True):
    """Inputs of a task, all of them decided."""

    decisions: list[tuple[Edge, Decision]]
    cause: str | None
    """Why the first required input is absent (clause 10); frame 0 has no earlier one."""
    entry: int
    """Number of the last journal entry that a grant relies on from before its frame (clause 18): the
    service's own, lag 1 inputs and held products."""

    def provided(self, frame: int) -> tuple[list[GrantInput], list[Product]]:
        """Provenance of every input, and the products of those that are not absent."""
        inputs = [provenance(edge.topic, edge.source, decision, frame) for edge, decision in self.decisions]
        return inputs, [decision.product for _, decision in self.decisions if decision.product is not None]


@dataclass(slots=True, eq=False)
class Task:
    """One service's part of one frame."""

    service: str
    frame: int
    state: TaskState = TaskState.PENDING
    eligible_at: int | None = None
    """When it could first have been granted, or skipped, had its service been there and not late [ns]."""
    started_at: int = 0
    """When it was granted or, where grants queue, when the one before it was answered [ns]."""
    inputs: Gathered | None = None
    """Kept while its grant waits for the journal."""
    overran: bool = False
    """Whether its budget is up."""
    order: GrantOrder | None = None
    """As granted, until it is answered: a service that rejoins gets it again."""
    decisions: dict[str, Decision] = field(default_factory=dict)
    """By topic, once decided."""
    journal: int = 0
    """Number of the journal entry of its decisions; 0: not decided."""
    report: Report | None = None

    def move(self, event: TaskEvent) -> None:
        """Take a transition of the table."""
        self.state = step(TASK, self.state, event)


def provenance(topic: str, source: str, decision: Decision, frame: int) -> GrantInput:
    """What a consumer in ``frame`` is told about where its input comes from."""
    product = decision.product
    if product is None:
        return GrantInput(topic=topic, source=source, status=decision.status, cause=decision.cause)
    return GrantInput(
        topic=topic,
        source=source,
        status=decision.status,
        frame=product.frame,
        t_ns=product.t_ns,
        age=frame - product.frame,
        fidelity=product.fidelity,
        digest=product.digest,
        cause=decision.cause,
    )


def validate_decision(service: str, frame: int, topic: str, decision: Decision) -> None:
    """Raise AssertionError where a decision contradicts itself (clauses 9 to 12)."""
    what = f"{topic} of {service} in frame {frame}"
    match decision.status:
        case Status.FRESH:
            assert decision.product is not None, f"{what} is fresh without a product"
            assert decision.product.frame == frame, f"{what} is not fresh"
        case Status.HELD:
            assert decision.product is not None, f"{what} is held without a product"
            assert decision.product.frame < frame, f"{what} is not an earlier one"
            assert decision.cause, f"{what} is held without a cause"
        case _:
            assert decision.product is None, f"{what} is absent with a product"
            assert decision.cause, f"{what} is absent without a cause"


def milliseconds(ns: int) -> str:
    """A duration for people."""
    return f"{ns / 1e6:.1f} ms"
