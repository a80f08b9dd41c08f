"""What goes into the core and what comes out of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from caviar_protocol.messages import (
    Asset,
    Done,
    Fault,
    GrantInput,
    Hello,
    Message,
    Ready,
    Refuse,
    ResetDone,
)


@dataclass(frozen=True, slots=True)
class Product:
    """One source's value of one topic for one frame. The core never looks into ``payload``."""

    topic: str
    source: str
    frame: int
    t_ns: int
    digest: str
    fidelity: str
    payload: Any


# --- events ----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Joined:
    """HELLO of a service came."""

    hello: Hello


@dataclass(frozen=True, slots=True)
class AssetsOffered:
    """A world announced its scenery, and the asset store holds all of it."""

    service: str
    assets: tuple[Asset, ...]


@dataclass(frozen=True, slots=True)
class ReadyReceived:
    """READY came."""

    service: str
    message: Ready


@dataclass(frozen=True, slots=True)
class ResetDoneReceived:
    """RESET_DONE came."""

    service: str
    message: ResetDone


@dataclass(frozen=True, slots=True)
class DoneReceived:
    """DONE came; ``payloads`` are opaque, one for each of its products."""

    service: str
    message: Done
    payloads: tuple[Any, ...] = ()


@dataclass(frozen=True, slots=True)
class FaultReceived:
    """FAULT came."""

    service: str
    message: Fault


@dataclass(frozen=True, slots=True)
class Violated:
    """A service sent what it may not, in a way it cannot be told to mend."""

    service: str
    text: str


@dataclass(frozen=True, slots=True)
class Progressed:
    """A heartbeat came."""

    service: str
    progress: int
    phase: str = ""
    grace_ns: int = 0


@dataclass(frozen=True, slots=True)
class Lost:
    """A service died or became unreachable; ``verdict`` says how that is known."""

    service: str
    verdict: str


@dataclass(frozen=True, slots=True)
class ByeReceived:
    """BYE came."""

    service: str
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Journaled:
    """All journal entries up to and including this number are with the operating system."""

    number: int


@dataclass(frozen=True, slots=True)
class StopRequested:
    """The user, or the machine, wants the run to end."""

    reason: str


Event = (
    Joined | AssetsOffered | ReadyReceived | ResetDoneReceived | DoneReceived | FaultReceived
    | Violated | Progressed | Lost | ByeReceived | Journaled | StopRequested
)  # fmt: skip


# --- actions ---------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Send:
    """Send a message to a service; ``products`` follow it, two parts each."""

    service: str
    message: Message
    products: tuple[Product, ...] = ()


@dataclass(frozen=True, slots=True)
class TurnAway:
    """Answer the HELLO that is being handled with a refusal."""

    name: str
    refusal: Refuse


@dataclass(frozen=True, slots=True)
class Journal:
    """Write one task's outcome to the journal, then feed `Journaled` (clause 18)."""

    number: int
    episode: int
    frame: int
    service: str
    outcome: str
    """``done``, ``fault``, ``overdue``, ``skipped``, or, for products that came later, ``late``."""
    decisions: tuple[GrantInput, ...]
    products: tuple[Product, ...]
    """Those that a later frame may consume."""


@dataclass(frozen=True, slots=True)
class Notice:
    """Something the user or the log must know: nothing late, dropped or overwritten in silence."""

    kind: str
    """``miss``, ``late``, ``skipped``, ``fault``, ``lost``, ``idle``, ``lag``, ``stale``,
    ``discarded`` or ``note``."""
    service: str
    text: str
    episode: int = 0
    frame: int = -1


@dataclass(frozen=True, slots=True)
class Latency:
    """The figure behind p50 and p99: one for each grant once it is answered, late or not, or will never
    be; and one for each frame that a service could not be granted before its deadline."""

    service: str
    episode: int
    frame: int
    elapsed_ns: int
    missed: bool


@dataclass(frozen=True, slots=True)
class FrameFinished:
    """Every service is through with a frame."""

    episode: int
    frame: int
    t_ns: int
    lag_ns: int
    """How far real time has slipped so far, under realtime pace (clause 8)."""


@dataclass(frozen=True, slots=True)
class EpisodeFinished:
    """An episode is over and had this many frames."""

    episode: int
    frames: int


@dataclass(frozen=True, slots=True)
class Finished:
    """The run is over. ``error`` is empty where all went well, else the one line that blames."""

    error: str
    culprit: str
    digest: str


Action = Send | TurnAway | Journal | Notice | Latency | FrameFinished | EpisodeFinished | Finished
