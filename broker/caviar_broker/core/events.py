"""Events that go into the core, and actions that come out of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from caviar_protocol.messages import (
    Asset,
    CheckpointDone,
    Done,
    Fault,
    GeometryChange,
    GeometryDone,
    GrantInput,
    Hello,
    Message,
    Ready,
    Refuse,
    ResetDone,
)


class Product(msgspec.Struct, frozen=True):
    """One source's value of one topic for one frame. The core never looks into ``payload``."""

    topic: str
    source: str
    frame: int
    t_ns: int
    digest: str
    fidelity: str
    payload: Any
    geometry: str = ""
    """Digest of the geometry that it was made with, where that is not the frame's."""


# --- events ----------------------------------------------------------------------------------


class Joined(msgspec.Struct, frozen=True):
    """HELLO of a service came."""

    hello: Hello
    local: bool = False
    """Whether the operating system says when its process ends."""


class AssetsOffered(msgspec.Struct, frozen=True):
    """A world announced its scenery, and the asset store holds all of it."""

    service: str
    assets: tuple[Asset, ...]


class ReadyReceived(msgspec.Struct, frozen=True):
    """READY came."""

    service: str
    message: Ready


class ResetDoneReceived(msgspec.Struct, frozen=True):
    """RESET_DONE came."""

    service: str
    message: ResetDone


class DoneReceived(msgspec.Struct, frozen=True):
    """DONE came; ``payloads`` are opaque, one for each of its products. The asset store holds the meshes that
    it announces."""

    service: str
    message: Done
    payloads: tuple[Any, ...] = ()
    refused: Mapping[str, str] | None = None
    """Why a mesh that it announces is none, by name."""


class GeometryDoneReceived(msgspec.Struct, frozen=True):
    """GEOMETRY_DONE came."""

    service: str
    message: GeometryDone


class FaultReceived(msgspec.Struct, frozen=True):
    """FAULT came."""

    service: str
    message: Fault


class CheckpointReceived(msgspec.Struct, frozen=True):
    """CHECKPOINT_DONE came; ``state`` is opaque."""

    service: str
    message: CheckpointDone
    state: Any


class PolicyOffered(msgspec.Struct, frozen=True):
    """A user gives an agent another policy; the asset store holds the file."""

    service: str
    digest: str


class Violated(msgspec.Struct, frozen=True):
    """A service sent what it may not, and no answer would mend it."""

    service: str
    text: str


class Progressed(msgspec.Struct, frozen=True):
    """A heartbeat came."""

    service: str
    progress: int
    phase: str = ""
    grace_ns: int = 0


class Lost(msgspec.Struct, frozen=True):
    """A service died or became unreachable; ``verdict`` says how that is known."""

    service: str
    verdict: str


class ByeReceived(msgspec.Struct, frozen=True):
    """BYE came."""

    service: str
    reason: str = ""


class Journaled(msgspec.Struct, frozen=True):
    """All journal entries up to and including this number are with the operating system."""

    number: int


class StopRequested(msgspec.Struct, frozen=True):
    """The user, or the machine, wants the run to end."""

    reason: str


class PauseRequested(msgspec.Struct, frozen=True):
    """The user wants no new frame to begin."""


class ResumeRequested(msgspec.Struct, frozen=True):
    """The user wants frames to begin again."""


class StepRequested(msgspec.Struct, frozen=True):
    """The user wants so many frames of a paused run to begin."""

    frames: int


# A union for the type checker; `FrameClock` looks the handler up by the class of the event.
Event = (
    Joined | AssetsOffered | ReadyReceived | ResetDoneReceived | DoneReceived | FaultReceived
    | CheckpointReceived | GeometryDoneReceived | Violated | Progressed | Lost | ByeReceived | Journaled
    | StopRequested | PauseRequested | ResumeRequested | StepRequested | PolicyOffered
)  # fmt: skip


# --- actions ---------------------------------------------------------------------------------


class Send(msgspec.Struct, frozen=True):
    """Send a message to a service; ``products`` follow it, two parts each."""

    service: str
    message: Message
    products: tuple[Product, ...] = ()
    attachment: Any = None
    """State of a service, in one part."""


class TurnAway(msgspec.Struct, frozen=True):
    """Answer the HELLO that is being handled with a refusal."""

    name: str
    refusal: Refuse


class Journal(msgspec.Struct, frozen=True):
    """Write one task's outcome, or another turn of the run, to the journal, then feed `Journaled`
    (clause 18)."""

    number: int
    episode: int
    frame: int
    service: str
    outcome: str
    """``done``, ``fault``, ``overdue``, ``skipped``, or, for what came later, ``late``. Of the run:
    ``episode`` (one begins), ``resumed`` (one continues with this frame), ``end`` (an agent ends it with
    this frame), ``seed`` (an agent chooses the next one's), ``checkpoint`` (a service saved its state),
    ``geometry`` (a world announced meshes with its answer to this frame)."""
    decisions: tuple[GrantInput, ...] = ()
    products: tuple[Product, ...] = ()
    """Those that a later frame may consume, or a service that comes back."""
    chosen: Mapping[str, str] | None = None
    """Decisions that the service took."""
    facts: Mapping[str, int] | None = None
    """``seed``, ``seed_episode`` and ``frames``, where they belong to the entry."""
    members: tuple[str, ...] = ()
    """Services of the run, where an episode begins."""
    state: Any = None
    """Of a service, after this frame; opaque."""
    geometry: GeometryChange | None = None
    """Meshes that a world has from a frame on."""


class Notice(msgspec.Struct, frozen=True):
    """Something the user or the log must know: nothing late, dropped or overwritten in silence."""

    kind: str
    """``miss``, ``late``, ``skipped``, ``fault``, ``lost``, ``away``, ``back``, ``refused``, ``idle``,
    ``lag``, ``stale``, ``discarded``, ``differs``, ``disk``, ``damage`` or ``note``."""
    service: str
    text: str
    episode: int = 0
    frame: int = -1


class Latency(msgspec.Struct, frozen=True):
    """Latency of a grant, of which p50 and p99 are computed: one for each grant once it is answered, late or
    not, or will never be; and one for each frame that a service could not be granted before its deadline."""

    service: str
    episode: int
    frame: int
    elapsed_ns: int
    missed: bool


class Overdue(msgspec.Struct, frozen=True):
    """A deadline has passed; what the policy says about it goes with this action."""

    service: str
    episode: int
    frame: int
    due_ns: int
    """When the deadline was, on the clock of ``now``."""


class FrameFinished(msgspec.Struct, frozen=True):
    """Every service is through with a frame."""

    episode: int
    frame: int
    t_ns: int
    lag_ns: int
    """How far real time has slipped so far, under realtime pace (clause 8)."""


class EpisodeFinished(msgspec.Struct, frozen=True):
    """An episode is over and had this many frames."""

    episode: int
    frames: int


class Finished(msgspec.Struct, frozen=True):
    """The run is over. ``error`` is empty where all went well, else the one line that blames."""

    error: str
    culprit: str
    digest: str


Action = Send | TurnAway | Journal | Notice | Latency | Overdue | FrameFinished | EpisodeFinished | Finished
