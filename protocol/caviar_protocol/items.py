"""Objects that stand inside messages: declarations, provenance, assets."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

import msgspec

from caviar_protocol.arrays import quantity
from caviar_protocol.fields import (
    Age,
    AssetName,
    Count,
    Digest,
    DigestOrNone,
    Duration,
    FrameOrNone,
    Name,
    Nanoseconds,
    NewName,
    Size,
    Text,
    Word,
    few,
)

Role = Literal["world", "channel", "sensors", "link", "agent", "recorder"]
Policy = Literal["wait", "hold", "drop", "abort"]


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

    topic: NewName
    """Topic, or ``*`` for every topic (recorders only)."""
    lag: Annotated[int, quantity("frame", "0: of the same frame, 1: of the one before", ge=0, le=1)] = 0
    required: bool = True
    """Without a required input the service is not granted the frame (clause 10)."""
    parts: Annotated[tuple[Word, ...], few] = ()
    """Parts of the payload that the service needs beyond the mandatory fields (clause 5)."""


class Demand(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What the run asks of one output of a service (contract, clause 5)."""

    topic: Name
    """Topic of this service that someone consumes."""
    parts: Annotated[tuple[Word, ...], few] = ()
    """Parts of its payload that someone asks for."""


class Asset(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One file of scenery: a mesh, a scene description, a terrain (contract, clause 4)."""

    name: AssetName
    """Unique in the run: ``scenery/scene.xml``."""
    digest: Digest
    """Of the file's bytes."""
    size: Size
    """Length of the file."""


class GrantInput(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Provenance of one input of a GRANT. Unless absent, two message parts hold the product."""

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
    digest: DigestOrNone = ""
    """Product digest (`caviar_protocol.digest.payload_digest`); empty when absent."""
    cause: Text = ""
    """Why it is absent or held: the service and frame at the origin (clause 10)."""


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


class ProductHeader(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One product of a DONE; two message parts hold it."""

    topic: Name
    digest: Digest
    """Product digest (`caviar_protocol.digest.payload_digest`) of the two parts."""
    fidelity: Text = ""
    """Rung or quality, for the provenance that consumers see."""
