"""Fields of messages: their types and limits, the objects inside messages, and the version that brought each.

A reader of an earlier minor version skips most of what a later one brought. It cannot skip values of closed
fields, and fields that change what others mean: a scenario that has them needs services of the version that
brought them (SPEC.md, section Versions). `required_knowledge` finds these.
"""

from __future__ import annotations

from collections.abc import Iterator
from enum import StrEnum
from functools import cache
from typing import Annotated, Any, Literal

import msgspec

from caviar_protocol.arrays import described, quantity

MAX_INTEGER = 2**63 - 1
"""Every integer of the protocol fits into a signed 64-bit one."""

# --- limits, the same on both sides (SPEC.md, section Limits) ---------------------------------------------

MAX_HEADER = 1 << 20
"""Bytes of a message header or payload header."""

MAX_BODY = 1 << 30
"""Bytes of the body of one product."""

# A header and two parts each of 256 products; `few` bounds the lists of products to as many.
MAX_PARTS = 513
"""Parts of a message without its routing part: a header and 256 products."""

MAX_NESTING = 32
"""Depth of maps and arrays in a header."""

MAX_ASSET_CHUNK = 4 << 20
"""Bytes of the data part of an ASSET_DATA."""

MAX_IN_FLIGHT = 64
"""Grants that a service may be asked to queue."""

MAX_SUBCARRIERS = 65536
"""Subcarriers of a carrier."""

# --- types ------------------------------------------------------------------------------------------------

# ``$`` alone would let a line feed pass at the end, which breaks a log line.
PRINTABLE = r"^[^\x00-\x1f\x7f]*$(?!\n)"
"""Pattern of names, which stand in tables, logs and file names: no control characters."""
# Neither ``.`` nor ``..`` as a segment, so that a path never leads out of its folder.
_SEGMENT = r"(?!\.{1,2}(?:/|$))[^/\\\x00-\x1f\x7f]+"

Name = Annotated[str, described("name of a service or topic that was declared", min_length=1, max_length=128)]
"""Refers to a name that HELLO declared."""

NewName = Annotated[
    str,
    described("declares a name, no control characters", min_length=1, max_length=128, pattern=PRINTABLE),
]
AssetName = Annotated[
    str,
    described(
        "relative path with forward slashes, without ``.`` and ``..``",
        min_length=1,
        max_length=255,
        pattern=rf"^{_SEGMENT}(?:/{_SEGMENT})*$(?!\n)",
    ),
]
"""Names a file below one folder, wherever that is; so it can never lead out of it."""

Text = Annotated[str, described("text for people")]
Word = Annotated[str, described("word that programs compare", min_length=1, max_length=128)]
NamePattern = Annotated[str, described("name, or a pattern with ``*``", min_length=1, max_length=255)]

Version = Annotated[
    tuple[Annotated[int, msgspec.Meta(ge=0)], Annotated[int, msgspec.Meta(ge=0)]],
    quantity("1", "(major, minor) version of the protocol"),
]
Epoch = Annotated[int, quantity("1", "incarnation of the broker, from 1", ge=1, le=MAX_INTEGER)]
Attempt = Annotated[int, quantity("1", "incarnation of the service, from 1", ge=1, le=MAX_INTEGER)]
EpisodeIndex = Annotated[int, quantity("1", "episode of the run, from 0", ge=0, le=MAX_INTEGER)]
FrameIndex = Annotated[int, quantity("1", "frame of the episode, from 0", ge=0, le=MAX_INTEGER)]
FrameOrNone = Annotated[int, quantity("1", "frame of the episode; −1: none", ge=-1, le=MAX_INTEGER)]
Age = Annotated[int, quantity("frame", "age", ge=0, le=MAX_INTEGER)]
Seed = Annotated[int, quantity("1", "seed of everything random", ge=0, le=MAX_INTEGER)]
SeedOrNone = Annotated[int, quantity("1", "seed; −1: none", ge=-1, le=MAX_INTEGER)]
# Whole: sums of periods are exact, and every client gets the same instant.
Nanoseconds = Annotated[int, quantity("ns", "simulated time, whole", ge=-MAX_INTEGER, le=MAX_INTEGER)]
Duration = Annotated[int, quantity("ns", "wall time, whole", ge=0, le=MAX_INTEGER)]
Period = Annotated[int, quantity("ns", "wall time, whole, at least 1", ge=1, le=MAX_INTEGER)]
Count = Annotated[int, quantity("1", "count", ge=0, le=MAX_INTEGER)]
Size = Annotated[int, quantity("B", "number of bytes", ge=0, le=MAX_INTEGER)]

# `max_length` keeps out a line feed, which ``$`` would let pass after 64 digits.
Digest = Annotated[
    str,
    quantity("1", "SHA-256, 64 lower-case hexadecimal digits", max_length=64, pattern="^[0-9a-f]{64}$"),
]
DigestOrNone = Annotated[
    str,
    quantity(
        "1",
        "SHA-256, 64 lower-case hexadecimal digits, or empty",
        max_length=64,
        pattern=r"^([0-9a-f]{64})?$(?!\n)",
    ),
]

# Without a bound a header of 1 MB could announce a million parts, each of which costs an object.
few = msgspec.Meta(max_length=256)
"""Bound of a list whose items each belong to message parts, or to a declaration of such."""


Role = Literal["world", "channel", "sensors", "link", "agent", "recorder"]
PeerRole = Literal[Role, "observer"]
"""Role of a service, or of an observer, which no scenario names."""
Policy = Literal["wait", "hold", "drop", "abort"]


# Members are strings, so that they stand on the wire and in texts as they are.
class Status(StrEnum):
    """Fate of a product (contract, clauses 9 to 12)."""

    FRESH = "fresh"
    """Computed for the frame it is used in."""
    HELD = "held"
    """The newest earlier product, used again."""
    ABSENT = "absent"
    """There is none; `GrantInput.cause` says why."""
    LATE = "late"
    """Came after its deadline; only a recorder sees it, under its true frame."""


# --- objects inside messages ------------------------------------------------------------------------------


class Input(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One declared input of a service (contract, clause 3).

    Example:
        >>> Input(topic="link", lag=1, required=False)  # of the frame before, where there is one
        Input(topic='link', lag=1, required=False, parts=())
    """

    topic: NewName
    """Topic, or ``*`` for every topic (recorders only)."""
    lag: Annotated[int, quantity("frame", "0: of the same frame, 1: of the one before", ge=0, le=1)] = 0
    required: bool = True
    """Without a required input the service is not granted the frame (clause 10)."""
    # A word of another minor version is accepted here; `PARTS` knows those of this one.
    parts: Annotated[tuple[Word, ...], few] = ()
    """Parts of the payload that the service needs beyond the mandatory fields (clause 5)."""


class Subscription(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Products that an observer wants to see, of those that the run has anyway: it creates no demand.

    Example:
        >>> Subscription(topic="lidar", every=10)
        Subscription(topic='lidar', source='', every=10)
    """

    topic: NewName
    """Topic, or ``*`` for every topic."""
    source: Text = ""
    """Service that they come from; empty: any."""
    every: Annotated[
        int, quantity("frame", "frames from one to the next, at least", ge=1, le=MAX_INTEGER)
    ] = 1


class Demand(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What the run asks of one output of a service (contract, clause 5)."""

    topic: Name
    """Topic of this service that has a consumer."""
    parts: Annotated[tuple[Word, ...], few] = ()
    """Parts of its payload that a consumer asks for."""


class Asset(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One file of scenery: a mesh, a scene description, a terrain (contract, clause 4).

    Example:
        >>> import hashlib
        >>> mesh = b"ply"
        >>> Asset(name="meshes/wall.ply", digest=hashlib.sha256(mesh).hexdigest(), size=len(mesh)).name
        'meshes/wall.ply'
    """

    name: AssetName
    """Unique in the run: ``scenery/scene.xml``."""
    digest: Digest
    """Of the file's bytes."""
    size: Size
    """Length of the file."""


class GeometryChange(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Meshes that a world has beyond those of its ASSET_OFFER, from a frame of the episode on.

    It replaces what the world announced before: a world that was started again says it once more, and what
    nothing needs any longer is left out.

    Example:
        >>> import hashlib
        >>> digest = hashlib.sha256(b"ply").hexdigest()
        >>> crate = Asset(name=f"objects/{digest}.ply", digest=digest, size=3)
        >>> GeometryChange(frame=12, assets=(crate,)).frame
        12
    """

    frame: FrameIndex
    """First frame in which scenes may name them, and in which what is left out is gone."""
    # Without `few`: none of them is a message part.
    assets: tuple[Asset, ...] = ()
    """All of them, each named ``objects/SHA-256.ply``: a name never stands for another file."""


class GrantInput(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Provenance of one input of a GRANT. Unless absent, two message parts hold the product.

    Example:
        >>> held = GrantInput(topic="channel", source="rt", status=Status.HELD, frame=5, age=2)
        >>> held.frame + held.age  # the granted frame
        7
    """

    topic: Name
    source: Name
    """Service that produced it, or should have."""
    status: Status
    """``fresh``, ``held``, ``absent`` or ``late``."""
    frame: FrameOrNone = -1
    """Frame that it was computed for; −1 when absent."""
    t_ns: Nanoseconds = 0
    """Time of that frame; 0 when absent."""
    age: Age = 0
    """Frames between its frame and the granted one: 0 or 1 when fresh, as its lag says; more when held."""
    fidelity: Text = ""
    """Rung or quality, as its producer states it."""
    # The producer's, passed on unchanged: a consumer compares it with the bytes that it got.
    digest: DigestOrNone = ""
    """Product digest (`caviar_protocol.digest.payload_digest`); empty when absent."""
    cause: Text = ""
    """Why it is absent or held: the service and frame at the origin (clause 10)."""
    geometry: DigestOrNone = ""
    """Digest of the geometry that it was made with, where its producer did not have that of the frame; empty:
    it had, or has none."""


class Report(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What the DONE of a service said beside its products, for the recorder."""

    source: Name
    """The service."""
    decisions: dict[str, str] = {}
    """As in its DONE; a replay imposes them (clause 6)."""
    measured: dict[str, Duration] = {}
    """As in its DONE."""
    counts: dict[str, Count] = {}
    """As in its DONE."""
    geometry: GeometryChange | None = None
    """As in the DONE of a world, without the meshes that were refused; a replay announces it again."""


class ProductHeader(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One product of a DONE; two message parts hold it.

    Example:
        >>> from caviar_protocol.digest import payload_digest
        >>> header, body = b"fields", b"arrays"
        >>> ProductHeader(topic="action", digest=payload_digest(header, body)).topic
        'action'
    """

    topic: Name
    digest: Digest
    """Product digest (`caviar_protocol.digest.payload_digest`) of the two parts."""
    fidelity: Text = ""
    """Rung or quality, for the provenance that consumers see."""


# --- versions ---------------------------------------------------------------------------------------------

SINCE: dict[str, str] = {
    "Subscription": "1.7",
    "Hello.subscriptions": "1.7",
    "Observe": "1.7",
    "Observed": "1.7",
    "GeometryChange": "1.6",
    "Geometry": "1.6",
    "GeometryDone": "1.6",
    "Prepare.max_faces": "1.6",
    "Done.geometry": "1.6",
    "Done.geometry_digest": "1.6",
    "Report.geometry": "1.6",
    "GrantInput.geometry": "1.6",
    "Ready.seed": "1.1",
    "Done.seed": "1.1",
    "Reset.seed_episode": "1.1",
    "ChannelOptions.materials_outside": "1.1",
    "ChannelOptions.absorption_db_per_km": "1.1",
    "ChannelOptions.detail": "1.1",
    "ChannelOptions.foliage": "1.4",
    "ChannelOptions.blockage": "1.6",
    "Welcome.rejoin_ns": "1.3",
    "Prepare.prefixes": "1.3",
    "Fault.culprit": "1.3",
    "WaypointCommand.at_once": "1.3",
    "WaypointCommand.yaw": "1.6",
    "VelocityCommand.yaw": "1.6",
    "VelocityCommand.yaw_rate": "1.6",
    "Scene.angular_velocity": "1.4",
    "Carrier.subcarriers": "1.4",
    "Carrier.subcarrier_spacing_hz": "1.4",
    "Carrier.taps": "1.4",
    "Carrier.slots": "1.4",
    "Carrier.slot_duration_s": "1.4",
    "ChannelResponse": "1.4",
    "ChannelTaps": "1.4",
    "Channel.hf": "1.4",
    "Channel.taps": "1.4",
    "AntennaArray.pattern_file": "1.4",
    "AntennaArray.panels": "1.4",
    "Panel": "1.4",
    "AntennaArray.codebook": "1.6",
    "Channel.error_bound_db": "1.4",
    "Channel.error_reference": "1.4",
    "Link.serving": "1.5",
    "Link.arrived": "1.5",
    "Link.sent": "1.5",
    "Link.dropped": "1.5",
    "Link.delivered": "1.5",
    "Link.delay": "1.5",
    "Link.waiting": "1.5",
    "Link.sinr": "1.5",
    "Link.throughput": "1.5",
    "Link.blocks": "1.5",
    "Link.block_errors": "1.5",
    "AntennaDevice.carriers": "1.6",
    "Channel.used": "1.6",
    "PathCommand": "1.6",
    "AttitudeCommand": "1.6",
    "DriveCommand": "1.6",
    "RoadStop": "1.6",
    "SignalCommand": "1.6",
}
"""Minor version that brought a field (``Grant.reports``) or a class (``Grant``); 1.0 unless said here."""


VALUES_SINCE: dict[str, dict[str, str]] = {
    "Hello.role": {"observer": "1.7"},
    "AntennaArray.polarization": dict.fromkeys(
        ("-45", "+45", "RHCP", "LHCP", "VH", "cross", "circular"), "1.4"
    ),
}
"""Minor version that brought a value of a closed field; that of the field unless said here."""

PARTS_SINCE: dict[str, str] = {"channel.hf": "1.4", "channel.taps": "1.4"}
"""Minor version that brought a part of a topic; 1.0 unless said here."""

CHANGES_OTHERS = frozenset({"AntennaArray.pattern_file", "AntennaArray.panels", "AntennaArray.codebook"})
"""Fields that change what others mean, or what has to be delivered: elements and beams, an asset."""


def parse_version(since: str) -> Version:
    """Read a version that is written as text.

    Args:
        since: Major and minor number with a dot between them.

    Example:
        >>> parse_version("1.4")
        (1, 4)
    """
    major, _, minor = since.partition(".")
    return int(major), int(minor)


fields_of = cache(msgspec.structs.fields)
"""Fields of a struct's class, inspected once: that takes longer than what follows from it."""


def required_knowledge(value: msgspec.Struct) -> Iterator[tuple[str, Any, Version]]:
    """Find what a reader of a struct has to know that version 1.0 of the protocol does not have.

    Args:
        value: A struct that travels, such as the array of a device.

    Returns:
        Name of a field, its value, and the version that brought it; of each such field.

    Example:
        >>> from caviar_protocol.topics import AntennaArray
        >>> list(required_knowledge(AntennaArray(polarization="VH")))
        [('polarization', 'VH', (1, 4))]
    """
    cls = type(value)
    # What has its default is not on the wire, so that a reader of 1.0 never meets it.
    defaults = {field.name: field.default for field in fields_of(cls)}
    for name in value.__struct_fields__:
        key, got = f"{cls.__name__}.{name}", getattr(value, name)
        since = VALUES_SINCE.get(key, {}).get(got) if isinstance(got, str) else None
        if since is None and key in CHANGES_OTHERS and got != defaults[name]:
            since = SINCE[key]
        if since is not None:
            yield name, got, parse_version(since)
