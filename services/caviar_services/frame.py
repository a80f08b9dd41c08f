"""One frame as a service sees it: its inputs, decoded and checked on first use, and its result."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TypeVar, cast

import msgspec
import numpy as np

from caviar_protocol.arrays import Payload
from caviar_protocol.codec import decode_payload
from caviar_protocol.errors import PayloadError, ProductError, ProtocolError
from caviar_protocol.messages import GrantInput, Report, Status
from caviar_protocol.seeding import generator
from caviar_protocol.space.scene import merge_scenes
from caviar_protocol.topics import Scene
from caviar_protocol.validation import ContentCheck

P = TypeVar("P", bound=Payload)

_ABSENT = Status.ABSENT


class FrameInput:
    """One input of a frame: its provenance, and its payload, decoded and checked on first use.

    Args:
        provenance: Topic, source, frame and status of the product.
        header: Header of the product as it travels; empty where it never did.
        body: Body of the product as it travels.
        payload: The product as it is, of a producer in this process.
        check: Looks at what the payload says, before the service does; None: it is trusted.

    Example:
        >>> absent = GrantInput(topic="link", source="link", status=Status.ABSENT, cause="link was late")
        >>> FrameInput(absent).present
        False
    """

    # A plain class with slots: several are made in each frame, and nothing compares them.
    __slots__ = ("_check", "_payload", "body", "header", "provenance")

    def __init__(
        self,
        provenance: GrantInput,
        header: bytes | memoryview = b"",
        body: bytes | memoryview = b"",
        payload: Payload | None = None,
        check: ContentCheck | None = None,
    ) -> None:
        self.provenance = provenance
        self.header = header
        self.body = body
        self._payload = payload
        self._check = check

    @property
    def present(self) -> bool:
        """Whether there is a payload: fresh, held or late."""
        return self.provenance.status is not _ABSENT

    @property
    def payload(self) -> Payload:
        """The payload; its arrays are read-only.

        Raises:
            PayloadError: The product is absent.
            ProductError: It cannot be decoded, or says what its topic does not allow; names topic and source.
        """
        payload, check = self._payload, self._check
        if payload is not None and check is None:
            return payload
        entry = self.provenance
        if not self.present:
            raise PayloadError(f"{entry.topic} of {entry.source} is absent: {entry.cause}")
        if payload is None:
            payload = self._decoded(entry)
        if check is not None:
            check(entry, payload, bytes(self.header))
        self._payload, self._check = payload, None
        return payload

    def under(self, provenance: GrantInput) -> FrameInput:
        """The same product with another provenance, as a later frame gets it.

        Args:
            provenance: Its topic and source are those of this one.
        """
        return FrameInput(provenance, self.header, self.body, self._payload, self._check)

    def look(self) -> None:
        """Check the payload where that is due, for a service that does not use it.

        Raises:
            ProductError: As for `payload`.
        """
        if self._check is not None and self._check.is_due(self.provenance):
            self.payload  # noqa: B018 - decoded and checked on first use

    def _decoded(self, entry: GrantInput) -> Payload:
        if self._check is not None:
            self._check.digest(entry, self.header, self.body)
        try:
            return decode_payload(entry.topic, self.header, self.body)
        except ProtocolError as error:
            problem = f"cannot be read: {error}"
            raise ProductError(entry.topic, entry.source, entry.frame, problem) from error


class Frame(msgspec.Struct, frozen=True, kw_only=True):
    """One frame as a service sees it.

    Example:
        >>> frame = Frame(episode=0, number=3, t_ns=300_000_000, service="agent", seed=7)
        >>> frame.generator("noise").normal() == frame.generator("noise").normal()
        True
        >>> frame.only("channel", Payload) is None  # it is no input of this frame
        True
    """

    episode: int
    number: int
    t_ns: int
    """Simulated time since the start of the episode's clock [ns]."""
    previous: int = -1
    """The frame this service last completed; −1: none. A world steps the whole gap."""
    final: bool = False
    """The agent's extra grant after the last frame (clause 16)."""
    budget_ns: int = 0
    """Wall time that this service has for the frame [ns]; 0: no limit."""
    inputs: tuple[FrameInput, ...] = ()
    imposed: Mapping[str, str] = {}
    """Decisions of the run that is replayed (clause 6); they go before what the service would decide."""
    reports: tuple[Report, ...] = ()
    """Recorders: what the services of this frame reported beside their products."""
    service: str = ""
    seed: int = 0
    """Of the episode: the run's, or what an agent chose."""
    seed_episode: int = 0
    """Episodes since the first one with this seed."""

    def payloads(self, topic: str, cls: type[P]) -> dict[str, P]:
        """Payloads of a topic that are present.

        Args:
            topic: Name of the topic.
            cls: Payload class of the topic, for the type of the result.

        Returns:
            Payload by source, in the order of the inputs.

        Raises:
            ProductError: A payload cannot be decoded, or says what its topic does not allow.
        """
        # By the enum's member that a module variable holds: looking it up costs more than the comparison.
        found: dict[str, P] = {}
        for item in self.inputs:
            entry = item.provenance
            if entry.topic == topic and entry.status is not _ABSENT:
                found[entry.source] = cast(P, item.payload)
        return found

    of = payloads  # its earlier name

    def only(self, topic: str, cls: type[P]) -> P | None:
        """Payload of a topic that has one source.

        Args:
            topic: Name of the topic.
            cls: Payload class of the topic, for the type of the result.

        Returns:
            The payload; None where it is absent.

        Raises:
            PayloadError: There are several sources; the text names them.
            ProductError: The payload cannot be decoded, or says what its topic does not allow.
        """
        found = self.payloads(topic, cls)
        if len(found) > 1:
            raise PayloadError(
                f"{self.service} takes {topic} from one source, the run has {', '.join(sorted(found))}; "
                "remove all but one of them from the scenario"
            )
        return next(iter(found.values()), None)

    def scene(self) -> Scene:
        """The scenes of all worlds as one (contract, clause 3).

        Raises:
            PayloadError: There is none, or two worlds have an object of one name.
        """
        scenes = self.payloads("scene", Scene)
        if not scenes:
            raise PayloadError(f"{self.service} was granted frame {self.number} without a scene")
        return merge_scenes(scenes)

    def generator(self, stream: str = "") -> np.random.Generator:
        """Random generator of this service for this frame (contract, clause 19).

        Args:
            stream: Name of an independent sequence of numbers within the frame.

        Returns:
            A generator that depends on the seed, the episode, the service, the stream and the frame alone.
        """
        # Not by drawing from one generator: a frame that is computed again, or alone, has the same numbers.
        return generator(self.seed, self.seed_episode, f"{self.service}/{stream}", self.number)

    def __iter__(self) -> Iterator[FrameInput]:
        return iter(self.inputs)


class StepResult(msgspec.Struct, frozen=True, kw_only=True):
    """What a service made of a frame.

    Example:
        >>> StepResult(counts={"users-without-path": 2}, fidelity="ray-traced").end_episode
        False
    """

    products: Mapping[str, Payload] = {}
    """Payload by topic; a declared output that is missing here is absent."""
    fidelity: str = ""
    """Rung or quality of the products, for their provenance."""
    decisions: Mapping[str, str] = {}
    """What was decided, by subject, for the recorder; a replay imposes it (`Frame.imposed`)."""
    counts: Mapping[str, int] = {}
    """Events of the frame by name, which the summary of the run adds up."""
    measured: Mapping[str, int] = {}
    """Nanoseconds that named phases took."""
    end_episode: bool = False
    """Agents: this frame is the last of the episode."""
    meshes: Mapping[str, Path | bytes] | None = None
    """Worlds with ``changes_geometry``: files of all meshes, beside those of `Service.scenery`, that objects
    may have, by their names (`caviar_protocol.assets.mesh_name`); None: as before."""
    meshes_from: int = -1
    """First frame in which they may; −1: this one."""
    seed: int = -1
    """Agents, with ``end_episode`` or for the final grant: of the next episode; −1: none chosen."""
