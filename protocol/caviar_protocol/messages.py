"""Messages between a service and the broker.

A message is a ZeroMQ multipart: one msgpack map (the *header*, with the message's ``type``),
then, for messages that carry products, two parts a product: its payload header and its body
(see `caviar_protocol.arrays`). DEALER and ROUTER add and take away the routing part. SPEC.md
says which side sends which message when, and how a wrong one is answered.
"""

from __future__ import annotations

from typing import Annotated, Any

import msgspec

from caviar_protocol.arrays import quantity
from caviar_protocol.fields import Asset as Asset
from caviar_protocol.fields import (
    Attempt,
    Count,
    Digest,
    DigestOrNone,
    Duration,
    EpisodeIndex,
    Epoch,
    FrameIndex,
    FrameOrNone,
    Name,
    NamePattern,
    Nanoseconds,
    NewName,
    Period,
    Seed,
    SeedOrNone,
    Size,
    Text,
    Version,
    Word,
    few,
)
from caviar_protocol.fields import Demand as Demand
from caviar_protocol.fields import GeometryChange as GeometryChange
from caviar_protocol.fields import GrantInput as GrantInput
from caviar_protocol.fields import Input as Input
from caviar_protocol.fields import PeerRole as PeerRole
from caviar_protocol.fields import Policy as Policy
from caviar_protocol.fields import ProductHeader as ProductHeader
from caviar_protocol.fields import Report as Report
from caviar_protocol.fields import Role as Role
from caviar_protocol.fields import Status as Status
from caviar_protocol.fields import Subscription as Subscription

PROTOCOL_VERSION = (1, 7)
"""Major and minor version of the protocol that this package speaks."""

CAPABILITIES: tuple[str, ...] = ("assets", "checkpoint", "episodes", "geometry", "observe", "parts")
"""Optional features that this package implements. Peers use what both of them list."""


# Fields that equal their default are left out, so that a new field costs old messages nothing.
class _Message(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, tag_field="type"):
    """Base of all messages: a map with a ``type`` and the fields that differ from their default."""


# --- joining -------------------------------------------------------------------------------


class Hello(_Message, frozen=True, kw_only=True, tag="HELLO"):
    """Service to broker, first message on the ordered connection.

    Example:
        >>> hello = Hello(version=PROTOCOL_VERSION, name="agent", role="agent", outputs=("action",))
        >>> msgspec.to_builtins(hello)  # the map on the wire
        {'type': 'HELLO', 'version': (1, 7), 'name': 'agent', 'role': 'agent', 'outputs': ('action',)}
    """

    version: Version
    """That the service speaks."""
    name: NewName
    """Unique in the run; what the scenario calls this service."""
    role: PeerRole
    """What it does in a run."""
    inputs: Annotated[tuple[Input, ...], few] = ()
    """What it consumes."""
    outputs: Annotated[tuple[NewName, ...], few] = ()
    """Topics that it produces."""
    capabilities: Annotated[tuple[Word, ...], few] = ()
    """Optional features that it implements."""
    implementation: Text = ""
    """What it is: ``sionna-rt``, ``my-game-engine 3.1``."""
    max_in_flight: Annotated[
        int, quantity("1", "grants it can queue; more than 1 only under wait", ge=1, le=64)
    ] = 1
    # A remote broker cannot watch a process by its id: it goes by heartbeats alone.
    host: Text = ""
    """Identifies kernel and process namespace, so that a broker on the same one can watch ``pid``."""
    pid: Count = 0
    """Process id on ``host``; 0: unknown."""
    # Looked through for each frame and observer, so fewer than of other lists.
    subscriptions: Annotated[tuple[Subscription, ...], msgspec.Meta(max_length=32)] = ()
    """Observers: what they want to see; without any, they learn of each frame and of no product."""


class Welcome(_Message, frozen=True, kw_only=True, tag="WELCOME"):
    """Broker to service: you are in, and this is what you are set to."""

    version: Version
    """That the broker speaks."""
    run: Text
    """Id of the run."""
    epoch: Epoch
    attempt: Attempt
    capabilities: Annotated[tuple[Word, ...], few] = ()
    """Optional features of HELLO that the broker implements too; only these may be used."""
    # From the broker and not from the client: one scenario sets both sides.
    heartbeat_ns: Period
    """Send a HEARTBEAT this often."""
    liveness_ns: Period
    """Silence after which a peer counts as gone."""
    seed: Seed = 0
    """Of the run."""
    # Plain, since the broker does not know the settings of implementations.
    settings: dict[str, Any] = {}
    """Settings of this service from the scenario, as they stand there."""
    # No file name: the service may be on another machine.
    scenario: dict[str, Any] = {}
    """What concerns every service: ``carriers``, ``devices``, ``episodes``, ``frames``,
    ``sampling_period_ns``; a recorder also gets its ``directory`` and, in ``resolved``, the whole
    scenario."""
    rejoin_ns: Duration = 0
    """How long the broker waits for this service once its connections are lost: until then it may say HELLO
    again on new ones. 0: it ends."""


class Refuse(_Message, frozen=True, kw_only=True, tag="REFUSE"):
    """Broker to service, answers HELLO or ATTACH: you cannot take part. The service exits with a status other
    than 0.
    """

    code: Word
    """``version``, ``name-taken``, ``unknown-name``, ``unauthorized``, ``declaration``, ``late``."""
    message: Text
    """What is wrong, naming both sides of a contradiction, and what to change."""


class Prepare(_Message, frozen=True, kw_only=True, tag="PREPARE"):
    """Broker to service: fetch these assets, load, warm up, then answer READY (or FAULT)."""

    epoch: Epoch
    attempt: Attempt
    demand: Annotated[tuple[Demand, ...], few] = ()
    """Outputs with a consumer, and the parts asked for. A service without any is not run (clause 5)."""
    # Without `few`: a city has thousands of files, and none of them is a message part.
    assets: tuple[Asset, ...] = ()
    """All scenery of the run; empty for worlds, which announce it."""
    producers: dict[str, tuple[Name, ...]] = {}
    """Topic to the names of its sources in this run."""
    # Consumers check the names of objects with them (`SceneRules.prefixes`).
    prefixes: dict[str, tuple[Text, ...]] = {}
    """World to the prefixes of its READY; empty for worlds."""
    max_faces: Count = 0
    """Worlds with capability ``geometry``: triangles that a mesh may have which they announce while the run
    goes on; 0: they may announce none in this run."""


class AssetOffer(_Message, frozen=True, kw_only=True, tag="ASSET_OFFER"):
    """World to broker, before READY: the scenery I bring. Answered by an ASSET_GET for each
    digest that the broker does not hold.
    """

    epoch: Epoch
    attempt: Attempt
    assets: tuple[Asset, ...]
    """Every file that this world brings."""


class AssetGet(_Message, frozen=True, kw_only=True, tag="ASSET_GET"):
    """Either way: send me these bytes. Answered by ASSET_DATA, or ERROR ``unknown-asset``.

    Example:
        >>> msgspec.to_builtins(AssetGet(digest="00" * 32, offset=4194304))["offset"]
        4194304
    """

    digest: Digest
    """Of the whole asset."""
    offset: Size = 0
    """First byte wanted."""


class AssetData(_Message, frozen=True, kw_only=True, tag="ASSET_DATA"):
    """Either way: bytes of an asset, in one further message part of at most `MAX_ASSET_CHUNK`."""

    digest: Digest
    """Of the whole asset."""
    offset: Size
    """Where the part begins."""
    size: Size
    """Length of the whole asset."""


WARNING = "warning: "
"""What a note of `Ready` begins with that the user is to see on the screen."""


class Ready(_Message, frozen=True, kw_only=True, tag="READY"):
    """Service to broker: loaded and warmed up.

    Example:
        >>> ready = Ready(epoch=1, attempt=1, actuators=("beam:car.*",), notes=(WARNING + "no GPU",))
        >>> msgspec.to_builtins(ready)["notes"]
        ('warning: no GPU',)
    """

    epoch: Epoch
    attempt: Attempt
    geometry: DigestOrNone = ""
    """Digest of the scenery held (`caviar_protocol.digest.geometry_digest`); empty: none needed."""
    prefixes: tuple[Text, ...] = ()
    """Worlds: prefixes of the names of their objects and fixed devices."""
    actuators: tuple[NamePattern, ...] = ()
    """Agents: the actuators they own, as patterns with ``*``: ``beam:car.*``, ``motion:uav``."""
    # Free text: a reader that knows no warnings logs them, and loses nothing.
    notes: tuple[Text, ...] = ()
    """What a user should know: the library chosen, the GPU used. One that begins with ``warning:`` is shown
    as such; the others are logged."""
    seed: SeedOrNone = -1
    """Agents: seed of the first episode, instead of the run's."""


# --- episodes and frames -------------------------------------------------------------------


class Reset(_Message, frozen=True, kw_only=True, tag="RESET"):
    """Broker to service, before frame 0 of an episode. Answered by RESET_DONE."""

    epoch: Epoch
    attempt: Attempt
    episode: EpisodeIndex
    seed: Seed
    """Of the run, or what an agent reset to."""
    t0_ns: Nanoseconds
    """Time of frame 0."""
    # Two runs with one seed draw alike, whatever number their episodes have in the run.
    seed_episode: EpisodeIndex = 0
    """Episodes since the first one with this seed: random numbers derive from both (clause 19)."""


class ResetDone(_Message, frozen=True, kw_only=True, tag="RESET_DONE"):
    """Service to broker: ready for frame 0 of the episode.

    Example:
        >>> msgspec.to_builtins(ResetDone(epoch=1, attempt=1, episode=0))
        {'type': 'RESET_DONE', 'epoch': 1, 'attempt': 1, 'episode': 0}
    """

    epoch: Epoch
    attempt: Attempt
    episode: EpisodeIndex


class Grant(_Message, frozen=True, kw_only=True, tag="GRANT"):
    """Broker to service: do your part of this frame. Answered by DONE or FAULT.

    Example:
        >>> scene = GrantInput(topic="scene", source="world", status=Status.ABSENT)
        >>> grant = Grant(epoch=1, attempt=1, episode=0, frame=7, t_ns=700_000_000, inputs=(scene,))
        >>> [entry.topic for entry in grant.inputs if entry.status is not Status.ABSENT]
        []
    """

    epoch: Epoch
    attempt: Attempt
    episode: EpisodeIndex
    frame: FrameIndex
    # Frames may have been skipped: what a service computes from motion needs the time between.
    previous_frame: FrameOrNone = -1
    """What this service last completed; a world steps the whole gap."""
    t_ns: Nanoseconds
    """Time of the frame."""
    budget_ns: Duration = 0
    """The service's budget for a frame; what follows when it is up says its policy (clause 9); 0: none."""
    inputs: Annotated[tuple[GrantInput, ...], few] = ()
    """Every declared input and each of its sources, those that are absent too."""
    final: bool = False
    """The extra grant of an agent after the last frame: lag 1 inputs, no action (clause 16)."""
    decisions: dict[str, str] = {}
    """Decisions imposed, in a replay (clause 6)."""
    reports: Annotated[tuple[Report, ...], few] = ()
    """Recorders only: what the services of this frame reported."""


class Done(_Message, frozen=True, kw_only=True, tag="DONE"):
    """Service to broker: my part of this frame is done.

    Example:
        >>> from caviar_protocol.codec import encode_payload
        >>> from caviar_protocol.digest import payload_digest
        >>> from caviar_protocol.topics import Action
        >>> parts = encode_payload(Action(commands=()))  # header and body follow the message
        >>> action = ProductHeader(topic="action", digest=payload_digest(*parts))
        >>> done = Done(epoch=1, attempt=1, episode=0, frame=7, products=(action,))
        >>> msgspec.to_builtins(done)["products"][0]["topic"]
        'action'
    """

    epoch: Epoch
    attempt: Attempt
    episode: EpisodeIndex
    frame: FrameIndex
    products: Annotated[tuple[ProductHeader, ...], few] = ()
    """At most one a topic; a declared output that is not here is absent."""
    decisions: dict[str, str] = {}
    """Decisions taken that a replay has to impose (a rung chosen, say)."""
    # In the message and in no product: a digest of wall times would differ in every run.
    measured: dict[str, Duration] = {}
    """How long a named phase took. Wall time stands here, never in a product (clause 6)."""
    counts: dict[str, Count] = {}
    """What was dropped or skipped, by name (clause 21): ``dropped``, the paths of a channel that are
    not finite, of which the user is warned."""
    end_episode: bool = False
    """An agent ends the episode with this frame (clause 16)."""
    seed: SeedOrNone = -1
    """Agents, with ``end_episode`` or for the final grant: seed of the next episode."""
    geometry: GeometryChange | None = None
    """Worlds with capability ``geometry``: meshes that objects may have from a frame on, this one or a later
    one; absent: as before."""
    geometry_digest: DigestOrNone = ""
    """Digest of the geometry that the products were made with (`caviar_protocol.digest.geometry_digest`);
    empty: that of READY."""


class Fault(_Message, frozen=True, kw_only=True, tag="FAULT"):
    """Service to broker: I cannot.

    Example:
        >>> fault = Fault(epoch=1, attempt=1, phase="prepare", message="settings.speed: is -1, write m/s > 0")
        >>> msgspec.to_builtins(fault)["phase"]  # fields that have their default do not travel
        'prepare'
    """

    epoch: Epoch
    attempt: Attempt
    episode: EpisodeIndex = 0
    frame: FrameOrNone = -1
    """Frame it happened in; −1: outside a frame."""
    phase: Text
    """``prepare``, ``reset``, ``step``, ``encode``, …"""
    message: Text
    """One line for the user. ``KEY: …``, of a wrong key of the scenario, is shown with file and line."""
    # Apart from the line for the user: a traceback is for the log.
    detail: Text = ""
    """Traceback, for the log."""
    culprit: Text = ""
    """Source of an input that cannot be read, or says what its topic does not allow: the run ends, and names
    it."""


class Geometry(_Message, frozen=True, kw_only=True, tag="GEOMETRY"):
    """Broker to service: fetch and load these meshes beside those of PREPARE, for this frame and later ones.
    Answered by GEOMETRY_DONE, in the order in which they came. Needs capability ``geometry``."""

    epoch: Epoch
    attempt: Attempt
    episode: EpisodeIndex
    frame: FrameIndex
    """First frame for which they count."""
    assets: tuple[Asset, ...] = ()
    """All meshes beyond those of PREPARE, of all worlds; those of an earlier GEOMETRY that are not here are
    gone."""


class GeometryDone(_Message, frozen=True, kw_only=True, tag="GEOMETRY_DONE"):
    """Service to broker: I hold the geometry of this frame. Under the policy ``wait`` the service is not
    granted the frame before.

    Example:
        >>> done = GeometryDone(epoch=1, attempt=1, episode=0, frame=12, geometry="00" * 32)
        >>> msgspec.to_builtins(done)["frame"]
        12
    """

    epoch: Epoch
    attempt: Attempt
    episode: EpisodeIndex
    frame: FrameIndex
    """As in GEOMETRY."""
    geometry: DigestOrNone = ""
    """Digest of the assets of PREPARE and of GEOMETRY together (`caviar_protocol.digest.geometry_digest`)."""


# Advisory: a service in the middle of a library call cannot stop, and its late answer is recorded.
class Cancel(_Message, frozen=True, kw_only=True, tag="CANCEL"):
    """Broker to service, advisory: the run no longer waits for this frame. DONE or FAULT is still due."""

    epoch: Epoch
    attempt: Attempt
    episode: EpisodeIndex
    frame: FrameIndex


class EpisodeEnd(_Message, frozen=True, kw_only=True, tag="EPISODE_END"):
    """Broker to service: the episode had this many frames. Not answered."""

    epoch: Epoch
    attempt: Attempt
    episode: EpisodeIndex
    frames: Count
    """Frames that the episode had."""


class Checkpoint(_Message, frozen=True, kw_only=True, tag="CHECKPOINT"):
    """Broker to service: save your state after this frame, the last that you completed; nothing is
    outstanding. Answered by CHECKPOINT_DONE, before which nothing is granted. Needs capability
    ``checkpoint``."""

    epoch: Epoch
    attempt: Attempt
    episode: EpisodeIndex
    frame: FrameIndex


class CheckpointDone(_Message, frozen=True, kw_only=True, tag="CHECKPOINT_DONE"):
    """Service to broker: my state after this frame, in one further part. Opaque to the broker."""

    epoch: Epoch
    attempt: Attempt
    episode: EpisodeIndex
    frame: FrameIndex


class Restore(_Message, frozen=True, kw_only=True, tag="RESTORE"):
    """Broker to a service that rejoined, after RESET: your state after this frame, in one further
    part. Answered by READY. The grants since then follow, as they were, one after the other; each is
    answered by DONE as before. Needs capability ``checkpoint``."""

    epoch: Epoch
    attempt: Attempt
    episode: EpisodeIndex
    frame: FrameIndex


RUN_COMPLETE = "the run is complete"
"""Reason of the SHUTDOWN after the last frame."""
STOPPED_BY = "stopped by"
"""Begins the reason of a SHUTDOWN that a signal to the broker brought."""


class Shutdown(_Message, frozen=True, kw_only=True, tag="SHUTDOWN"):
    """Broker to service: the run is over. Answered by BYE within ``grace_ns``."""

    reason: Text
    """Why, for the log."""
    grace_ns: Duration = 0
    """Then the process may be killed; 0: as soon as possible."""


class Bye(_Message, frozen=True, kw_only=True, tag="BYE"):
    """Service to broker: I leave; nothing more comes from me.

    Example:
        >>> msgspec.to_builtins(Bye(epoch=1, attempt=1, reason=RUN_COMPLETE))["reason"]
        'the run is complete'
    """

    epoch: Epoch
    attempt: Attempt
    reason: Text = ""
    """Why, for the log."""


class Stale(_Message, frozen=True, kw_only=True, tag="STALE"):
    """Broker to service: your message was for another epoch, attempt, episode or frame (clause 1)
    and was not used."""

    of: Word
    """Type of the message that was stale."""
    epoch: Epoch
    attempt: Attempt
    episode: EpisodeIndex
    # Required: a client that lost count finds here where it has to be.
    frame: FrameOrNone
    """The frame that is outstanding."""


class Error(_Message, frozen=True, kw_only=True, tag="ERROR"):
    """Either way: I could not use what you sent. Never answered."""

    code: Word
    """``malformed``, ``limit``, ``version``, ``unexpected``, ``unknown-asset``, ``refused-mesh``,
    ``unknown-peer``."""
    message: Text
    """What is wrong with it."""
    of: Text = ""
    """Type of the message that could not be used, where it is known."""
    subject: Text = ""
    """What it was about: the digest of an unknown asset, or of a mesh that is refused."""


# --- observers -----------------------------------------------------------------------------


class Observe(_Message, frozen=True, kw_only=True, tag="OBSERVE"):
    """Broker to observer: the newest finished frame, or another state of the run. Answered by OBSERVED,
    before which no further one comes. Needs capability ``observe``."""

    sequence: Count
    """Counts these messages to the observer, from 0."""
    state: Word
    """Of the run: ``joining``, ``preparing``, ``resetting``, ``running`` or ``stopping``."""
    paused: bool = False
    """Whether the user has it begin no frames."""
    episode: EpisodeIndex = 0
    """Of the frame."""
    frame: FrameOrNone = -1
    """Newest finished frame; −1: none is."""
    t_ns: Nanoseconds = 0
    """Time of the frame."""
    inputs: Annotated[tuple[GrantInput, ...], few] = ()
    """Products of the frame, as a service that consumes them in it is granted them."""
    reports: Annotated[tuple[Report, ...], few] = ()
    """What the services of the frame reported; empty where the observer has had the frame before."""


class Observed(_Message, frozen=True, kw_only=True, tag="OBSERVED"):
    """Observer to broker: I can take another one.

    Example:
        >>> msgspec.to_builtins(Observed(sequence=7))
        {'type': 'OBSERVED', 'sequence': 7}
    """

    sequence: Count
    """Of the OBSERVE answered."""


# --- the heartbeat connection --------------------------------------------------------------


class Attach(_Message, frozen=True, kw_only=True, tag="ATTACH"):
    """Service to broker, first message on the heartbeat connection (clause 2)."""

    epoch: Epoch
    attempt: Attempt
    name: Name
    """As in HELLO."""


class Heartbeat(_Message, frozen=True, kw_only=True, tag="HEARTBEAT"):
    """Service to broker, every ``heartbeat_ns``: I live, and this far I have come.

    Example:
        >>> loading = Heartbeat(sequence=4, progress=2, phase="loading scene", grace_ns=60_000_000_000)
        >>> msgspec.to_builtins(loading)["phase"]
        'loading scene'
    """

    sequence: Count
    """Counts heartbeats, from 0."""
    # A counter and no flag: two heartbeats show that work advanced between them.
    progress: Count = 0
    """Grows whenever work advances."""
    phase: Text = ""
    """What it is doing: ``loading scene``, ``compiling kernels``, ``step``."""
    grace_ns: Duration = 0
    """This phase may stay without progress for so long; 0: the scenario's ``stall_s``."""


class HeartbeatAck(_Message, frozen=True, kw_only=True, tag="HEARTBEAT_ACK"):
    """Broker to service: answers ATTACH (sequence 0) and every HEARTBEAT."""

    sequence: Count
    """Of the heartbeat answered."""


Message = (
    Hello | Welcome | Refuse | Prepare | AssetOffer | AssetGet | AssetData | Ready
    | Reset | ResetDone | Grant | Done | Fault | Cancel | EpisodeEnd | Checkpoint | CheckpointDone | Restore
    | Geometry | GeometryDone | Shutdown | Bye | Stale | Error | Observe | Observed
    | Attach | Heartbeat | HeartbeatAck
)  # fmt: skip
"""Every message of the protocol."""
