"""The agent of a session, as the run sees it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import ClassVar

import msgspec

from caviar_protocol.messages import Input, Role
from caviar_protocol.scenario.rules import BEAM
from caviar_services.service import Frame, Preparation, Prepared, Service, StepResult

PATIENCE_S = 600.0
"""[s] that a run waits for a decision before it blames the agent: learning takes time, and so does looking
at what was learned."""


class OutsideSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Whom the agent serves (contract, clause 17)."""

    users: tuple[str, ...] = ("*",)
    except_users: tuple[str, ...] = ()


class OutsideAgent(Service[OutsideSettings]):
    """Declares an agent that decides outside of the run. `declared` makes the class for one session."""

    role: ClassVar[Role] = "agent"
    outputs: ClassVar[tuple[str, ...]] = ("action",)
    Settings = OutsideSettings
    decide: ClassVar[Callable[[Frame], StepResult]]
    scenery_here: ClassVar[Callable[[Mapping[str, Path]], None]]
    first_seed: ClassVar[Callable[[], int]]

    def prepare(self, preparation: Preparation) -> Prepared:
        """Declare the actuators, and the seed of the first episode once it is known."""
        type(self).scenery_here(preparation.assets)
        self.run.progress("waiting for the first reset", PATIENCE_S)
        seed = type(self).first_seed()
        if self.settings.except_users:
            return Prepared(notes=("serves the users whom no other agent owns",), seed=seed)
        owned = tuple(text if ":" in text else BEAM + text for text in self.settings.users)
        return Prepared(actuators=owned, seed=seed)

    def step(self, frame: Frame) -> StepResult:
        """What is decided outside."""
        self.run.progress("waiting for a decision", PATIENCE_S)
        return type(self).decide(frame)


def declared(
    inputs: tuple[Input, ...],
    first_seed: Callable[[], int],
    decide: Callable[[Frame], StepResult],
    scenery_here: Callable[[Mapping[str, Path]], None] | None = None,
) -> type[OutsideAgent]:
    """The class of an agent with these inputs.

    ``first_seed`` gives the seed of the first episode, −1 for the run's; ``decide`` answers a frame;
    ``scenery_here`` is given the files of the run's scenery before the first frame, which are not fetched
    without it.
    """
    fields = {
        "inputs": inputs,
        "first_seed": staticmethod(first_seed),
        "decide": staticmethod(decide),
        "uses_scenery": scenery_here is not None,
        "scenery_here": staticmethod(scenery_here or _unused),
    }
    return type("OutsideAgent", (OutsideAgent,), fields)


def _unused(_: Mapping[str, Path]) -> None:
    """For a session that does not look at the scenery."""
