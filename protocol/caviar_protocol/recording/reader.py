"""The reader of a recording: frames, products, and topics as arrays.

A recording is a run directory with segments ``recording-0000.mcap``, ``recording-0001.mcap``, … and the
scenery in ``assets/``. After a crash it is readable up to the last frame whose record was written whole;
`Recording.complete` then is false. What is damaged or missing is in `Recording.damage`, and said by a
`RecordingWarning`.
"""

from __future__ import annotations

import warnings
from bisect import bisect_right
from collections.abc import Iterator, Mapping
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, TypeVar, overload

import numpy as np

from caviar_protocol.arrays import Payload
from caviar_protocol.assets import recorded_meshes
from caviar_protocol.errors import RecordingError, suggestion
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.recording import (
    FrameEntry,
    RecordedFrame,
    RecordedProduct,
    RecordingMetadata,
    check_topic,
)
from caviar_protocol.recording.arrays import TopicArrays
from caviar_protocol.recording.integrity import (
    RecordedSegments,
    RunDigestReport,
    metadata_of,
    recorded_digest,
)
from caviar_protocol.recording.segment import Channel, Segment
from caviar_protocol.run_directory import RunDirectory
from caviar_protocol.space.codebooks import CODEBOOKS_FOLDER, add_codebook_files

# Columns read the type hints of all payloads: what looks at frames and digests alone does without.
if TYPE_CHECKING:
    from caviar_protocol.recording.scene import (
        CameraArrays,
        DepthArrays,
        LidarArrays,
        SceneArrays,
        SegmentationArrays,
    )
    from caviar_protocol.recording.topics import ActionArrays, ChannelArrays, LinkArrays

T = TypeVar("T", bound=str)
Key: TypeAlias = T | tuple[T, str]
"""A topic, or a topic and a source."""


class RecordingWarning(UserWarning):
    """A recording is damaged, and only a part of it can be read; the text says which."""


class Recording:
    """A recorded run, or one segment of it.

    Args:
        path: The run directory, or one ``.mcap`` file of it.
        past_gaps: Whether what comes after a segment that is missing or broken is read too.

    Raises:
        RecordingError: It is not a recording, nothing of it can be read, or the content contradicts itself.

    Warns:
        RecordingWarning: It is damaged, or a segment is missing. What precedes can be read, and `damage`
            says what cannot. A last segment that breaks off, as a killed recorder leaves it, is no damage.

    Example:
        >>> recording = Recording("runs/smoke-20261122-101500")
        >>> len(recording), recording.complete
        (100, True)
        >>> recording.topics
        {'action': ('agent',), 'channel': ('channel',), 'link': ('link',), 'scene': ('world',)}
        >>> recording["link"].abs_y.shape  # frames × users
        (100, 2)
    """

    def __init__(self, path: str | Path, *, past_gaps: bool = False) -> None:
        self.path = Path(path)
        self._found = RecordedSegments(self.path, past_gaps=past_gaps)
        self._segments = self._found.segments
        self.complete = self._found.closed
        """Whether the recorder closed it, and nothing of it is missing."""
        self.damage = tuple(self._found.damage)
        """What is missing or cannot be read: a line each. `run_digest` looks at every byte."""
        if self.damage:
            more = f" (and {len(self.damage) - 1} more)" if len(self.damage) > 1 else ""
            warnings.warn(f"the recording is damaged: {self.damage[0]}{more}", RecordingWarning, stacklevel=2)
        self.metadata = self._read_metadata()
        add_codebook_files(RunDirectory(self.directory).assets.glob(f"{CODEBOOKS_FOLDER}*"))
        self._starts = [0]
        for segment in self._segments:
            self._starts.append(self._starts[-1] + len(segment.chunks))
        # Segments of two runs in one folder would interleave: numbers must ascend without exception.
        order = [
            (entry.episode, entry.frame, segment.path.name)
            for segment in self._segments
            for entry in segment.entries
        ]
        for earlier, later in pairwise(order):
            if later[:2] <= earlier[:2]:
                raise RecordingError(
                    f"{self.path}: frame {later[1]} of episode {later[0]} in {later[2]} follows frame "
                    f"{earlier[1]} of episode {earlier[0]} in {earlier[2]}: segments of two runs are mixed, "
                    "or one is damaged"
                )
        self._index = {(episode, frame): index for index, (episode, frame, _) in enumerate(order)}
        self._latest: tuple[int, dict[tuple[Channel, int], memoryview]] | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        # Its files are mapped into the memory of this process: another one opens them itself.
        return partial(Recording, past_gaps=self._found.past_gaps), (self.path.absolute(),)

    def __len__(self) -> int:
        return self._starts[-1]

    def __iter__(self) -> Iterator[RecordedFrame]:
        return self.frames()

    def __repr__(self) -> str:
        episodes = len({episode for episode, _ in self._index})
        of = f"{len(self)} frames in {episodes} episode{'s' * (episodes != 1)}"
        lines = [f"Recording of {self.path}: {of}{'' if self.complete else ', breaks off'}"]
        lines += [f"  {topic} of {', '.join(map(repr, sources))}" for topic, sources in self.topics.items()]
        return "\n".join(lines)

    @property
    def directory(self) -> Path:
        """The run directory."""
        return self.path if self.path.is_dir() else self.path.parent

    @property
    def files(self) -> tuple[Path, ...]:
        """The segments that were read."""
        return tuple(segment.path for segment in self._segments)

    @property
    def assets(self) -> dict[str, Path]:
        """Files of scenery that were recorded, by asset name, and `meshes`."""
        folder = RunDirectory(self.directory).assets
        found = {asset.name: folder / asset.name for asset in self.metadata.assets}
        return {name: file for name, file in found.items() if file.is_file()} | self.meshes

    @property
    def meshes(self) -> dict[str, Path]:
        """Files of the meshes that worlds announced while the run went on, by asset name."""
        return recorded_meshes(RunDirectory(self.directory).assets)

    @property
    def topics(self) -> dict[str, tuple[str, ...]]:
        """Topics of which at least one product is stored, with their sources."""
        found: dict[str, set[str]] = {}
        for segment in self._segments:
            for channel in segment.channels.values():
                if channel.source:
                    found.setdefault(channel.topic, set()).add(channel.source)
        return {topic: tuple(sorted(found[topic])) for topic in sorted(found)}

    @overload
    def __getitem__(self, key: Key[Literal["scene"]]) -> SceneArrays: ...
    @overload
    def __getitem__(self, key: Key[Literal["channel"]]) -> ChannelArrays: ...
    @overload
    def __getitem__(self, key: Key[Literal["lidar"]]) -> LidarArrays: ...
    @overload
    def __getitem__(self, key: Key[Literal["camera"]]) -> CameraArrays: ...
    @overload
    def __getitem__(self, key: Key[Literal["depth"]]) -> DepthArrays: ...
    @overload
    def __getitem__(self, key: Key[Literal["segmentation"]]) -> SegmentationArrays: ...
    @overload
    def __getitem__(self, key: Key[Literal["action"]]) -> ActionArrays: ...
    @overload
    def __getitem__(self, key: Key[Literal["link"]]) -> LinkArrays: ...
    @overload
    def __getitem__(self, key: Key[str]) -> TopicArrays[Any, Any]: ...
    def __getitem__(self, key: Key[str]) -> TopicArrays[Any, Any]:
        """A topic as arrays over all frames: ``recording["channel"].h``, ``recording["lidar", "l1"].range``.

        Args:
            key: A topic; with the source where several services produce it. The scenes of several worlds are
                one.

        Raises:
            RecordingError: There is no such topic, none of its products is in the recording, or the source
                is not one of it.
        """
        if not isinstance(key, str | tuple):
            raise RecordingError(
                f"recording[{key!r}] is no topic, which is a text, as in recording['link']; frames are "
                "recording.frame(episode=0, frame=7) and recording.frames()"
            )
        from caviar_protocol.recording.topics import TOPIC_ARRAYS

        topic, source = (key, "") if isinstance(key, str) else key
        return TOPIC_ARRAYS[check_topic(topic)](
            self, topic, self._sources(topic, source), np.arange(len(self), dtype=np.int64)
        )

    def _sources(self, topic: str, source: str) -> tuple[str, ...]:
        """The services to take a topic from."""
        known = self.topics.get(topic, ())
        if not known:
            raise RecordingError(
                f"{self.path} holds no product of {topic!r}; it holds {', '.join(self.topics) or 'none'}"
            )
        if source:
            if source not in known:
                raise RecordingError(f"{self.path} has no {topic} of {source!r}; {suggestion(source, known)}")
            return (source,)
        if len(known) > 1 and topic != "scene":
            raise RecordingError(
                f"{self.path} has {topic} of {', '.join(map(repr, known))}: choose one, as in "
                f"recording[{topic!r}, {known[0]!r}]"
            )
        return known

    def frames(self) -> Iterator[RecordedFrame]:
        """All frames, in the order of (episode, frame).

        Example:
            >>> recording = Recording("runs/smoke-20261122-101500")
            >>> sum(frame.scene() is not None for frame in recording.frames())
            100
        """
        return (RecordedFrame(self, index) for index in range(len(self)))

    def frame(self, episode: int, frame: int) -> RecordedFrame:
        """One frame.

        Args:
            episode: Number of the episode, from 0.
            frame: Number of the frame in it, from 0.

        Raises:
            RecordingError: It was not recorded; the text says which frames are there.

        Example:
            >>> Recording("runs/smoke-20261122-101500").frame(episode=0, frame=7).t_ns
            700000000
        """
        return RecordedFrame(self, self.place(episode, frame))

    def place(self, episode: int, frame: int) -> int:
        """Find the place of a frame, as ``recording[topic][place]`` takes it.

        Args:
            episode: Number of the episode, from 0.
            frame: Number of the frame in it, from 0.

        Raises:
            RecordingError: It was not recorded; the text says which frames are there.
        """
        index = self._index.get((episode, frame))
        if index is None:
            has = f"frames {min(self._index)} to {max(self._index)}" if self._index else "no frame"
            raise RecordingError(
                f"{self.path} has no frame {frame} of episode {episode}; it has {has} (episode, frame)"
            )
        return index

    def product(self, episode: int, frame: int, topic: str, source: str) -> Payload:
        """The payload of one product, fresh or held.

        Args:
            episode: Number of the episode.
            frame: Number of the frame in it.
            topic: Name of the topic.
            source: Name of the service.

        Raises:
            RecordingError: The frame was not recorded, or the product is absent in it.

        Example:
            >>> recording = Recording("runs/smoke-20261122-101500")
            >>> recording.product(episode=0, frame=7, topic="channel", source="channel").rung
            'free-space'
        """
        check_topic(topic)
        for product in self.frame(episode, frame).products:
            entry = product.provenance
            if (entry.topic, entry.source) == (topic, source) and entry.status is not Status.LATE:
                return product.payload
        raise RecordingError(f"{self._frame_place(episode, frame)} has no {topic} of {source!r}")

    def products(self, topic: str) -> Iterator[tuple[RecordedFrame, RecordedProduct]]:
        """Every fresh or held product of a topic, with its frame.

        Args:
            topic: Name of the topic.

        Raises:
            RecordingError: There is no topic of this name.

        Example:
            >>> recording = Recording("runs/smoke-20261122-101500")
            >>> max(product.size for frame, product in recording.products("action"))  # [B]
            104
        """
        check_topic(topic)  # here, and not when the first product is asked for
        return (
            (frame, product)
            for frame in self.frames()
            for product in frame.products
            if product.provenance.topic == topic and product.provenance.status is not Status.LATE
        )

    of = products  # its earlier name

    def run_digest(self) -> RunDigestReport:
        """The run's digest, recomputed from the payload bytes alone (contract, clause 20).

        It does not stop at damage: a changed payload gives another digest and is named.

        Example:
            >>> report = Recording("runs/smoke-20261122-101500").run_digest()
            >>> report.frames, report.damage
            (100, ())
        """
        return recorded_digest(self._found)

    def entry(self, index: int) -> FrameEntry:
        """The frame record of the ``index``-th frame of the recording.

        Args:
            index: Place of a frame in the recording, from 0.
        """
        segment, place = self.segment_of(index)
        return segment.entries[place]

    def segment_of(self, index: int) -> tuple[Segment, int]:
        """The segment of the ``index``-th frame of the recording, and the frame's place in it.

        Args:
            index: Place of a frame in the recording, from 0.
        """
        # Empty segments have the start of the next one: the last of equal starts has the frame.
        number = bisect_right(self._starts, index) - 1
        return self._segments[number], index - self._starts[number]

    def products_of(self, index: int) -> tuple[RecordedProduct, ...]:
        """The products of the ``index``-th frame, held ones fetched from where they stand.

        Args:
            index: Place of a frame in the recording, from 0.

        Raises:
            RecordingError: The frame's chunk is damaged, or the bytes of a product are missing.
        """
        own = self._messages(index)
        return tuple(
            self._product(index, item, own)
            for item in self.entry(index).inputs
            if item.status is not Status.ABSENT
        )

    def recorded_product(self, index: int, item: GrantInput) -> RecordedProduct:
        """One product of the ``index``-th frame, which is not absent, wherever it stands.

        Of the frame only this product's bytes are read.

        Args:
            index: Place of the frame in the recording, from 0.
            item: Provenance of the product, one of the frame's inputs.

        Raises:
            RecordingError: The bytes are missing, or have another digest than the frame's record says.
        """
        product = self._product(index, item, self._stored(index))
        if product.digest != item.digest:
            raise RecordingError(f"{product.place}: its bytes are damaged, their digest is not {item.digest}")
        return product

    def _product(
        self, index: int, item: GrantInput, own: Mapping[tuple[Channel, int], memoryview]
    ) -> RecordedProduct:
        entry, key = self.entry(index), (Channel(item.topic, item.source), item.frame)
        place = f"{self._frame_place(entry.episode, entry.frame)}, {item.topic} of {item.source!r}"
        data = own.get(key)
        # A held product is stored once, in the frame it was computed for, or where it came late.
        if data is None and item.status is Status.HELD:
            data = self._held(entry.episode, *key)
        if data is None:
            remedy = "" if self.path.is_dir() else f"; open {self.directory}, which may have them"
            raise RecordingError(f"{place}: its bytes, of frame {item.frame}, are not in {self.path}{remedy}")
        return RecordedProduct(item, data, place)

    def _held(self, episode: int, channel: Channel, frame: int) -> memoryview | None:
        for index in (self._index.get((episode, frame)), self._late.get((episode, channel, frame))):
            if index is not None and (channel, frame) in (stored := self._messages(index)):
                return stored[channel, frame]
        return None

    def _messages(self, index: int) -> dict[tuple[Channel, int], memoryview]:
        segment, place = self.segment_of(index)
        chunk = segment.chunks[place]
        if segment.damaged(chunk):
            entry = segment.entries[place]
            raise RecordingError(
                f"{self._frame_place(entry.episode, entry.frame)}: the chunk at offset {chunk.offset} of "
                f"{segment.path} is damaged, its CRC-32 differs; `caviar inspect --digest` names the product"
            )
        return self._stored(index)

    def _stored(self, index: int) -> dict[tuple[Channel, int], memoryview]:
        """The products in a frame's chunk, whose CRC is not looked at."""
        # The topics of a frame are read one after the other: its chunk is decompressed once.
        if self._latest is None or self._latest[0] != index:
            segment, place = self.segment_of(index)
            messages = segment.messages(segment.chunks[place])
            self._latest = index, {(m.channel, m.frame): m.data for m in messages}
        return self._latest[1]

    @cached_property
    def _late(self) -> dict[tuple[int, Channel, int], int]:
        return {
            (entry.episode, Channel(item.topic, item.source), item.frame): index
            for index, entry in enumerate(self.entry(i) for i in range(len(self)))
            for item in entry.inputs
            if item.status is Status.LATE
        }

    def _read_metadata(self) -> RecordingMetadata:
        found = [metadata_of(segment) for segment in self._segments]
        for segment, metadata in zip(self._segments, found, strict=True):
            if (metadata.run, metadata.seed) != (found[0].run, found[0].seed):
                raise RecordingError(
                    f"{segment.path} belongs to run {metadata.run!r} with seed {metadata.seed}, "
                    f"{self._segments[0].path.name} to run {found[0].run!r} with seed {found[0].seed}"
                )
        return found[0]

    def _frame_place(self, episode: int, frame: int) -> str:
        return f"{self.path}: episode {episode}, frame {frame}"


Imposed: TypeAlias = Mapping[tuple[str, int, int], Mapping[str, str]]
"""Decisions to impose, by (service, episode, frame) (contract, clause 6)."""


def recorded_decisions(recording: Recording) -> Imposed:
    """All decisions that services took in a recorded run, for a replay to impose (contract, clause 6).

    Args:
        recording: Of the run.

    Returns:
        Decisions by (service, episode, frame).

    Example:
        >>> recorded_decisions(Recording("runs/smoke-20261122-101500"))  # no service of it decides anything
        {}
    """
    return {
        (report.source, frame.episode, frame.number): report.decisions
        for frame in recording.frames()
        for report in frame.reports
        if report.decisions
    }
