"""Messages between a service and the broker.

A message is a ZeroMQ multipart: one msgpack map (the *header*, with the message's ``type``),
then, for messages that carry products, two parts a product: its payload header and its body
(see `caviar_protocol.arrays`). DEALER and ROUTER add and take away the routing part. SPEC.md
says who sends what when, and what answers what is wrong.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any, Literal

import msgspec

from caviar_protocol.arrays import quantity

PROTOCOL_VERSION = (1, 0)
"""Major and minor version of the protocol that this package speaks."""

CAPABILITIES: tuple[str, ...] = ("assets", "episodes", "parts")
"""Optional features that this package implements. Peers use what both of them list."""

Role = Literal["world", "channel", "sensors", "link", "agent", "recorder"]
Policy = Literal["wait", "hold", "drop", "abort"]

Name = Annotated[str, msgspec.Meta(min_length=1, max_length=128)]
FrameIndex = Annotated[int, quantity("1", "frame number in the episode, from 0", ge=0)]
Nanoseconds = Annotated[int, quantity("ns", "whole nanoseconds")]
Digest = Annotated[str, quantity("1", "SHA-256, 64 lower-case hexadecimal digits")]


class _Message(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, tag_field="type"):
    """Base of all messages: a map with a ``type`` and the fields that differ from their default."""


class Status(StrEnum):
    """What became of a product (contract, clauses 9 to 12)."""

    FRESH = "fresh"
    """Computed for the frame it is used in."""
    HELD = "held"
    """The newest earlier product, used again."""
    ABSENT = "absent"
    """There is none; `GrantInput.cause` says why."""
    LATE = "late"
    """Came after its deadline; only a recorder sees it, under its true frame."""


class Input(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One declared input of a service (contract, clause 3)."""

    topic: Name
    """Topic, or ``*`` for every topic (recorders only)."""
    lag: Annotated[int, quantity("frame", "0: of the same frame, 1: of the one before", ge=0, le=1)] = 0
    required: bool = True
    """Without a required input the service is not granted the frame (clause 10)."""
    parts: tuple[str, ...] = ()
    """Parts of the payload that the service needs beyond the mandatory fields (clause 5)."""


class Demand(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What the run asks of one output of a service (contract, clause 5)."""

    topic: Name
    parts: tuple[str, ...] = ()


class Asset(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One file of scenery: a mesh, a scene description, a terrain (contract, clause 4)."""

    name: Name
    """Relative path with forward slashes, unique in the run: ``scenery/scene.xml``."""
    digest: Digest
    size: Annotated[int, quantity("B", "length of the file", ge=0)]


class GrantInput(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Provenance of one input of a GRANT. Unless absent, two message parts hold the product."""

    topic: Name
    source: Name
    status: Status
    frame: Annotated[int, quantity("1", "frame it was computed for; −1 when absent", ge=-1)] = -1
    t_ns: Nanoseconds = 0
    age: Annotated[int, quantity("frame", "frames between its frame and the one it is used in", ge=0)] = 0
    fidelity: str = ""
    digest: str = ""
    cause: str = ""
    """Why it is absent or held: the service and frame at the origin (clause 10)."""


class ProductHeader(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One product of a DONE; two message parts hold it."""

    topic: Name
    digest: Digest
    fidelity: str = ""


# --- joining -------------------------------------------------------------------------------


class Hello(_Message, frozen=True, kw_only=True, tag="HELLO"):
    """Service to broker, first message on the ordered connection."""

    version: tuple[int, int]
    name: Name
    role: Role
    inputs: tuple[Input, ...] = ()
    outputs: tuple[Name, ...] = ()
    capabilities: tuple[str, ...] = ()
    implementation: str = ""
    """What it is, for people: ``sionna-rt``, ``my-game-engine 3.1``."""
    max_in_flight: Annotated[
        int, quantity("1", "grants it can queue; more than 1 only under wait", ge=1, le=64)
    ] = 1
    host: str = ""
    """Identifies kernel and process namespace, so that a broker on the same one can watch ``pid``."""
    pid: Annotated[int, quantity("1", "process id on ``host``; 0: not told", ge=0)] = 0


class Welcome(_Message, frozen=True, kw_only=True, tag="WELCOME"):
    """Broker to service: you are in, and this is what you are set to."""

    version: tuple[int, int]
    run: str
    epoch: Annotated[int, quantity("1", "incarnation of the broker, from 1", ge=1)]
    attempt: Annotated[int, quantity("1", "incarnation of this service, from 1", ge=1)]
    capabilities: tuple[str, ...] = ()
    heartbeat_ns: Annotated[int, quantity("ns", "send a HEARTBEAT this often", gt=0)]
    liveness_ns: Annotated[int, quantity("ns", "silence after which a peer counts as gone", gt=0)]
    seed: Annotated[int, quantity("1", "seed of the run", ge=0)] = 0
    settings: dict[str, Any] = {}
    """Settings of this service from the scenario, as they stand there."""
    scenario: dict[str, Any] = {}
    """What concerns every service: ``carriers``, ``devices``, ``sampling_period_ns``, ``frames``."""


class Refuse(_Message, frozen=True, kw_only=True, tag="REFUSE"):
    """Broker to service: you cannot take part. The service exits with a status other than 0."""

    code: str
    message: str


class Prepare(_Message, frozen=True, kw_only=True, tag="PREPARE"):
    """Broker to service: fetch these assets, load, warm up, then answer READY (or FAULT)."""

    epoch: int
    attempt: int
    demand: tuple[Demand, ...] = ()
    """Outputs that someone consumes, with the parts asked for. Nobody asks: not run (clause 5)."""
    assets: tuple[Asset, ...] = ()
    """All scenery of the run; empty for worlds, which announce it."""
    producers: dict[str, tuple[str, ...]] = {}
    """Topic to the names of its sources in this run."""


class AssetOffer(_Message, frozen=True, kw_only=True, tag="ASSET_OFFER"):
    """World to broker, before READY: the scenery I bring. Answered by an ASSET_GET for each
    digest that the broker does not hold."""

    epoch: int
    attempt: int
    assets: tuple[Asset, ...]


class AssetGet(_Message, frozen=True, kw_only=True, tag="ASSET_GET"):
    """Either way: send me these bytes. Answered by ASSET_DATA, or ERROR ``unknown-asset``."""

    digest: Digest
    offset: Annotated[int, quantity("B", "first byte wanted", ge=0)] = 0


class AssetData(_Message, frozen=True, kw_only=True, tag="ASSET_DATA"):
    """Either way: bytes of an asset, in one further message part of at most `limits.MAX_ASSET_CHUNK`."""

    digest: Digest
    offset: Annotated[int, quantity("B", "where the part begins", ge=0)]
    size: Annotated[int, quantity("B", "length of the whole asset", ge=0)]


class Ready(_Message, frozen=True, kw_only=True, tag="READY"):
    """Service to broker: loaded and warmed up."""

    epoch: int
    attempt: int
    geometry: str = ""
    """Digest of the scenery held (`caviar_protocol.digest.geometry_digest`); empty: none needed."""
    prefixes: tuple[str, ...] = ()
    """Worlds: prefixes of the names of their objects and fixed devices."""
    actuators: tuple[str, ...] = ()
    """Agents: the actuators they own, as patterns with ``*``: ``beam:car.*``, ``motion:uav``."""
    notes: tuple[str, ...] = ()
    """What a user should know: the library chosen, the GPU used."""


# --- episodes and frames -------------------------------------------------------------------


class Reset(_Message, frozen=True, kw_only=True, tag="RESET"):
    """Broker to service, before frame 0 of an episode. Answered by RESET_DONE."""

    epoch: int
    attempt: int
    episode: Annotated[int, quantity("1", "episode number, from 0", ge=0)]
    seed: Annotated[int, quantity("1", "seed of the run, or what an agent reset to", ge=0)]
    t0_ns: Nanoseconds


class ResetDone(_Message, frozen=True, kw_only=True, tag="RESET_DONE"):
    """Service to broker: ready for frame 0 of the episode."""

    epoch: int
    attempt: int
    episode: int


class Grant(_Message, frozen=True, kw_only=True, tag="GRANT"):
    """Broker to service: do your part of this frame. Answered by DONE or FAULT."""

    epoch: int
    attempt: int
    episode: int
    frame: FrameIndex
    previous_frame: Annotated[int, quantity("1", "what this service last completed; −1: none", ge=-1)] = -1
    t_ns: Nanoseconds
    budget_ns: Annotated[int, quantity("ns", "wall time until the deadline; 0: none", ge=0)] = 0
    inputs: tuple[GrantInput, ...] = ()
    final: bool = False
    """The extra grant of an agent after the last frame: lag 1 inputs, no action (clause 16)."""
    decisions: dict[str, str] = {}
    """Decisions imposed, in a replay (clause 6)."""


class Done(_Message, frozen=True, kw_only=True, tag="DONE"):
    """Service to broker: my part of this frame is done."""

    epoch: int
    attempt: int
    episode: int
    frame: FrameIndex
    products: tuple[ProductHeader, ...] = ()
    decisions: dict[str, str] = {}
    """Decisions taken that a replay has to impose (a rung chosen, say)."""
    measured: dict[str, int] = {}
    """Nanoseconds a named phase took. Wall time stands here, never in a product (clause 6)."""
    counts: dict[str, int] = {}
    """What was dropped or skipped, by name (clause 21): ``non-finite-paths``."""
    end_episode: bool = False
    """An agent ends the episode with this frame (clause 16)."""


class Fault(_Message, frozen=True, kw_only=True, tag="FAULT"):
    """Service to broker: I cannot."""

    epoch: int
    attempt: int
    episode: int = 0
    frame: Annotated[int, quantity("1", "frame it happened in; −1: outside a frame", ge=-1)] = -1
    phase: str
    """``prepare``, ``reset``, ``step``, ``encode``, …"""
    message: str
    """One line for the user."""
    detail: str = ""
    """Traceback, for the log."""


class Cancel(_Message, frozen=True, kw_only=True, tag="CANCEL"):
    """Broker to service, advisory: nobody waits for this frame any more. DONE or FAULT is still due."""

    epoch: int
    attempt: int
    episode: int
    frame: FrameIndex


class EpisodeEnd(_Message, frozen=True, kw_only=True, tag="EPISODE_END"):
    """Broker to service: the episode had this many frames. Not answered."""

    epoch: int
    attempt: int
    episode: int
    frames: Annotated[int, quantity("1", "frames of the episode", ge=0)]


class Checkpoint(_Message, frozen=True, kw_only=True, tag="CHECKPOINT"):
    """Broker to service: save your state after this frame. Answered by CHECKPOINT_DONE. Needs
    capability ``checkpoint``."""

    epoch: int
    attempt: int
    episode: int
    frame: FrameIndex


class CheckpointDone(_Message, frozen=True, kw_only=True, tag="CHECKPOINT_DONE"):
    """Service to broker: my state after this frame, in one further part. Opaque to the broker."""

    epoch: int
    attempt: int
    episode: int
    frame: FrameIndex


class Restore(_Message, frozen=True, kw_only=True, tag="RESTORE"):
    """Broker to a service that rejoined: your state after this frame, in one further part; grants
    since then follow. Answered by READY. Needs capability ``checkpoint``."""

    epoch: int
    attempt: int
    episode: int
    frame: FrameIndex


class Shutdown(_Message, frozen=True, kw_only=True, tag="SHUTDOWN"):
    """Broker to service: the run is over. Answered by BYE within ``grace_ns``."""

    reason: str
    grace_ns: Annotated[int, quantity("ns", "then the process may be killed", ge=0)] = 0


class Bye(_Message, frozen=True, kw_only=True, tag="BYE"):
    """Service to broker: I leave; nothing more comes from me."""

    epoch: int
    attempt: int
    reason: str = ""


class Stale(_Message, frozen=True, kw_only=True, tag="STALE"):
    """Broker to service: your message was for another epoch, attempt, episode or frame (clause 1)
    and was not used."""

    of: str
    """Type of the message that was stale."""
    epoch: int
    attempt: int
    episode: int
    frame: Annotated[int, quantity("1", "the frame that is outstanding; −1: none", ge=-1)]


class Error(_Message, frozen=True, kw_only=True, tag="ERROR"):
    """Either way: I could not use what you sent. Never answered."""

    code: str
    """``malformed``, ``limit``, ``version``, ``unexpected``, ``unknown-asset``, ``unknown-peer``."""
    message: str


# --- the heartbeat connection --------------------------------------------------------------


class Attach(_Message, frozen=True, kw_only=True, tag="ATTACH"):
    """Service to broker, first message on the heartbeat connection (clause 2)."""

    epoch: int
    attempt: int
    name: Name


class Heartbeat(_Message, frozen=True, kw_only=True, tag="HEARTBEAT"):
    """Service to broker, every ``heartbeat_ns``: I live, and this far I have come."""

    sequence: Annotated[int, quantity("1", "counts heartbeats, from 0", ge=0)]
    progress: Annotated[int, quantity("1", "grows whenever work advances", ge=0)] = 0
    phase: str = ""
    """What it is doing: ``loading scene``, ``compiling kernels``, ``step``."""
    grace_ns: Annotated[int, quantity("ns", "this phase may stay silent for so long", ge=0)] = 0


class HeartbeatAck(_Message, frozen=True, kw_only=True, tag="HEARTBEAT_ACK"):
    """Broker to service: answers ATTACH (sequence 0) and every HEARTBEAT."""

    sequence: Annotated[int, quantity("1", "of the heartbeat answered", ge=0)]


Message = (
    Hello | Welcome | Refuse | Prepare | AssetOffer | AssetGet | AssetData | Ready
    | Reset | ResetDone | Grant | Done | Fault | Cancel | EpisodeEnd | Checkpoint | CheckpointDone | Restore
    | Shutdown | Bye | Stale | Error | Attach | Heartbeat | HeartbeatAck
)  # fmt: skip
"""Every message of the protocol."""
