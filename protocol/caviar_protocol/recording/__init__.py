"""Recordings of runs: what they consist of, and their reader.

>>> from caviar_protocol.recording import Recording
>>> recording = Recording("runs/smoke-20261122-101500")
>>> recording["channel"].h.shape  # frames × users × Nr × Nt
(100, 2, 4, 32)
>>> recording.frame(episode=0, frame=7).scene().names
('car', 'uav')

`newest_run` gives the directory of the newest run, `Recording.__getitem__` a topic as arrays over all frames,
`Recording.frames` the products frame by frame; docs/reference/recordings.md has more.

This module has what a recording consists of: metadata, frames, products, segments and the manifest.
`Recording` itself, of `caviar_protocol.recording.reader`, is loaded when it is first used.

``recording.json``, the *manifest*, says which segments a recording has, and what each finished one is. A
segment that is removed, exchanged or cut leaves no trace in the other segments; the manifest shows it. It is
replaced as a whole: when a segment has its first frame (and then is listed as open), when a segment is
finished (once it is on disk, where the run's ``durability`` wants that), and when the recording is closed. So
what it says of a finished segment holds after a loss of power too. A segment that is not listed was begun
later. A recording without a manifest was made by an earlier version, and is read without one.
"""

from __future__ import annotations

import hashlib
import zlib
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, cast

import msgspec

from caviar_protocol.arrays import Payload, quantity
from caviar_protocol.codec.payloads import decode_payload
from caviar_protocol.errors import ProtocolError, RecordingError, suggestion
from caviar_protocol.files import read_regular, replace_file
from caviar_protocol.messages import Asset, GrantInput, Report, Status
from caviar_protocol.run_directory import RunDirectory, newest_run
from caviar_protocol.space.scene import merge_scenes
from caviar_protocol.topics import PAYLOADS, Scene

if TYPE_CHECKING:
    from caviar_protocol.recording.reader import Recording, RecordingWarning

P = TypeVar("P", bound=Payload)

FORMAT = 1
"""Version of the layout of a recording; a reader refuses any other."""

PROFILE = "caviar"
"""MCAP profile of a segment."""

FRAME_TOPIC = "frame"
"""MCAP topic of the `FrameEntry` of each frame, the first message of its chunk."""

METADATA_NAME = "caviar"
"""Name of the MCAP metadata record that holds `RecordingMetadata`, a JSON text a field."""


class RecordingMetadata(msgspec.Struct, frozen=True, kw_only=True):
    """Metadata that stand once in every segment: how the run was made.

    Example:
        >>> from caviar_protocol.recording import Recording
        >>> recording = Recording("runs/smoke-20261122-101500")
        >>> recording.metadata.name, recording.metadata.seed, recording.metadata.sampling_period_ns
        ('smoke', 1, 100000000)
    """

    format: int = FORMAT
    segment: int = 0
    """Number of the segment, from 0."""
    run: str = ""
    seed: int = 0
    sampling_period_ns: Annotated[int, quantity("ns", "T_sam")] = 0
    frames: Annotated[int, quantity("frame", "of an episode, as planned")] = 0
    scenario: dict[str, Any] = {}
    """The scenario as resolved: every default in its place."""
    versions: dict[str, str] = {}
    """Version of Python and of each installed package that the run may use."""
    machine: dict[str, str] = {}
    """``platform``, ``cpu``, ``cpu_count``, ``gpu`` where there is one."""
    started: str = ""
    """Start of the recording, ISO 8601, UTC."""
    assets: tuple[Asset, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name of the scenario."""
        run = self.scenario.get("run")
        return str(run.get("name", "")) if isinstance(run, dict) else ""


class FrameEntry(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Record of one frame beside its products; msgpack on the wire.

    Example:
        >>> from caviar_protocol.recording import Recording
        >>> recording = Recording("runs/smoke-20261122-101500")
        >>> entry = recording.frame(episode=0, frame=7).entry
        >>> [(item.topic, item.source, item.status.value) for item in entry.inputs][0]
        ('action', 'agent', 'fresh')
    """

    episode: Annotated[int, quantity("1", "episode number, from 0", ge=0)]
    frame: Annotated[int, quantity("1", "frame number in the episode, from 0", ge=0)]
    t_ns: Annotated[int, quantity("ns", "simulated time of the frame in the episode")]
    seed: Annotated[int, quantity("1", "seed of the episode")] = 0
    inputs: tuple[GrantInput, ...] = ()
    """Provenance of every product, sorted by (topic, source, frame). Fresh and late products
    stand in the frame's chunk, a held one in the chunk of the frame it was computed for."""
    reports: tuple[Report, ...] = ()
    """What services reported beside their products: decisions that a replay imposes, counts of what
    was dropped, and wall times, which no digest covers."""


class SegmentRecord(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One segment in the manifest.

    Example:
        >>> manifest = read_manifest(Path("runs/smoke-20261122-101500"))
        >>> manifest.segments[0].extent
        'frame 0 of episode 0 to frame 99 of episode 0'
    """

    name: str
    first: tuple[int, int] | None = None
    """(episode, frame) of its first frame; None where it was closed without one."""
    finished: bool = False
    """Whether it was closed; an open one has only a name and a first frame here."""
    last: tuple[int, int] | None = None
    """(episode, frame) of its last frame."""
    frames: int = 0
    size: int = 0
    """[B]"""
    crc: int = 0
    """CRC-32 of the whole file."""

    @property
    def extent(self) -> str:
        """Its frames for people."""
        if self.first is None:
            return "no frame"
        if self.last is None:
            return f"{frame_name(self.first)} and later"
        return f"{frame_name(self.first)} to {frame_name(self.last)}"


class Manifest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The segments of a recording, in order.

    Example:
        >>> manifest = read_manifest(Path("runs/smoke-20261122-101500"))
        >>> manifest.closed, [segment.name for segment in manifest.segments]
        (True, ['recording-0000.mcap'])
    """

    run: str = ""
    seed: int = 0
    segments: tuple[SegmentRecord, ...] = ()
    closed: bool = False
    """Whether the recorder came to its end and closed the recording."""

    def save(self, folder: Path, *, sync: bool) -> None:
        """Write the manifest to a run directory, in one step.

        Args:
            folder: The run directory.
            sync: Whether it is on the disk when this returns.

        Raises:
            OSError: It cannot be written.
        """
        content = msgspec.json.encode(self)
        replace_file(RunDirectory(folder).manifest, _sealed(content), durable=sync)


class _Envelope(msgspec.Struct):
    crc: int
    """CRC-32 of the bytes of ``manifest``."""
    manifest: msgspec.Raw


def read_manifest(folder: Path) -> Manifest | None:
    """Read the manifest in a run directory.

    Args:
        folder: The run directory.

    Returns:
        The manifest; None where there is none.

    Raises:
        RecordingError: It cannot be read, or a byte of it differs from what was written.
    """
    path = RunDirectory(folder).manifest
    try:
        data = read_regular(path)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror} (errno {error.errno})") from error
    try:
        content = bytes(msgspec.json.decode(data, type=_Envelope).manifest)
        # Bytes are compared, and not the CRC alone: what stands around the manifest is covered too.
        if data != _sealed(content):
            raise RecordingError(f"{path} is damaged: its content does not have its CRC-32")
        return msgspec.json.decode(content, type=Manifest)
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path} is damaged: {error}") from error


def frame_name(instant: tuple[int, int]) -> str:
    """A frame as errors name it.

    Args:
        instant: (episode, frame).

    Example:
        >>> frame_name((0, 7))
        'frame 7 of episode 0'
    """
    return f"frame {instant[1]} of episode {instant[0]}"


def _sealed(content: bytes) -> bytes:
    return b'{"crc":%d,"manifest":%s}\n' % (zlib.crc32(content), content)


def check_topic(topic: str) -> str:
    """Check that there is a topic of this name, and return it.

    Args:
        topic: What a caller asks for.

    Raises:
        RecordingError: There is none; the text suggests the one that was probably meant.

    Example:
        >>> check_topic("chanel")
        Traceback (most recent call last):
            ...
        caviar_protocol.errors.RecordingError: there is no topic 'chanel'; did you mean 'channel'?
    """
    if topic not in PAYLOADS:
        raise RecordingError(f"there is no topic {topic!r}; {suggestion(topic, PAYLOADS)}")
    return topic


class RecordedProduct:
    """One product of a frame; its payload is decoded on first use.

    Args:
        provenance: Topic, source, status and digest, as the frame's record has them.
        data: Header length (8 bytes, little-endian), header and body.
        place: Recording, frame, topic and source, as errors name them.

    Example:
        >>> from caviar_protocol.recording import Recording
        >>> recording = Recording("runs/smoke-20261122-101500")
        >>> product = recording.frame(episode=0, frame=7).products[0]
        >>> product.provenance.topic, product.digest == product.provenance.digest
        ('action', True)
        >>> type(product.payload).__name__
        'Action'
    """

    def __init__(self, provenance: GrantInput, data: memoryview, place: str) -> None:
        self.provenance = provenance
        self.place = place
        """Recording, frame, topic and source, as errors name them."""
        self._data = data

    @property
    def size(self) -> int:
        """Stored bytes."""
        return len(self._data)

    @property
    def header(self) -> memoryview:
        """The wire bytes of the payload's header."""
        return self._data[8 : 8 + self._header_length]

    @property
    def body(self) -> memoryview:
        """The wire bytes of the payload's arrays."""
        return self._data[8 + self._header_length :]

    @property
    def _header_length(self) -> int:
        # The bytes are checked only where their CRC or digest was: a length may be anything.
        length = int.from_bytes(self._data[:8], "little")
        if len(self._data) < 8 or 8 + length > len(self._data):
            raise RecordingError(f"{self.place}: a header of {length} B does not fit {len(self._data)} B")
        return length

    @cached_property
    def payload(self) -> Payload:
        """The typed payload; its arrays are read-only views into the file.

        Raises:
            RecordingError: The bytes are not a payload of the topic.
        """
        try:
            return decode_payload(self.provenance.topic, self.header, self.body)
        except ProtocolError as error:
            raise RecordingError(f"{self.place}: {error}") from error

    @property
    def digest(self) -> str:
        """SHA-256 of the recorded bytes (`caviar_protocol.digest.payload_digest`)."""
        return hashlib.sha256(self._data).hexdigest()


class RecordedFrame:
    """One frame: the provenance of all its products, and the products, read on first use.

    Args:
        recording: Of which the frame is.
        index: Place of the frame in it, from 0.

    Example:
        >>> from caviar_protocol.recording import Recording
        >>> recording = Recording("runs/smoke-20261122-101500")
        >>> frame = recording.frame(episode=0, frame=7)
        >>> frame.t_ns, [product.provenance.topic for product in frame.products]
        (700000000, ['action', 'channel', 'link', 'scene'])
    """

    def __init__(self, recording: Recording, index: int) -> None:
        self._recording = recording
        self._index = index
        self.entry = recording.entry(index)
        self.episode = self.entry.episode
        self.number = self.entry.frame
        self.t_ns = self.entry.t_ns
        self.inputs = self.entry.inputs
        """Provenance of every product, absent ones included."""
        self.reports = self.entry.reports
        """What services reported beside their products: decisions, counts, wall times."""

    @cached_property
    def products(self) -> tuple[RecordedProduct, ...]:
        """Products that are not absent, in the order of `inputs`.

        Raises:
            RecordingError: Bytes are damaged or missing; the text names the place.
        """
        return self._recording.products_of(self._index)

    def payloads(self, topic: str, cls: type[P]) -> dict[str, P]:
        """Payloads of a topic by source, fresh and held ones.

        Args:
            topic: Name of the topic.
            cls: Its payload class, of which the result is.

        Raises:
            RecordingError: There is no such topic, or ``cls`` is not its payload class.

        Example:
            >>> from caviar_protocol.recording import Recording
            >>> from caviar_protocol.topics import Link
            >>> frame = Recording("runs/smoke-20261122-101500").frame(episode=0, frame=7)
            >>> frame.payloads("link", Link)["link"].rx
            ('car/rx', 'uav/rx-uav')
        """
        if PAYLOADS.get(topic) is not cls:
            check_topic(topic)
            raise RecordingError(f"payloads of {topic!r} are {PAYLOADS[topic].__name__}, not {cls.__name__}")
        return {
            product.provenance.source: cast(P, product.payload)
            for product in self.products
            if product.provenance.topic == topic and product.provenance.status is not Status.LATE
        }

    of = payloads  # its earlier name

    def scene(self) -> Scene | None:
        """The scenes of all worlds as one (contract, clause 3); None where there is none.

        Example:
            >>> from caviar_protocol.recording import Recording
            >>> recording = Recording("runs/smoke-20261122-101500")
            >>> recording.frame(episode=0, frame=7).scene().names
            ('car', 'uav')
        """
        scenes = self.payloads("scene", Scene)
        return merge_scenes(scenes) if scenes else None


_READER = ("Recording", "RecordingWarning")


def __getattr__(name: str) -> object:
    # A recorder writes segments and reads none: it need not load the arrays of every topic.
    if name not in _READER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("caviar_protocol.recording.reader"), name)
