"""The newest frames of a run as it goes on, as an observer of its broker sees them."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from caviar_protocol.arrays import Payload
from caviar_protocol.errors import ProtocolError, RecordingError
from caviar_protocol.messages import GrantInput
from caviar_protocol.observer import Observation, ObservedProduct
from caviar_protocol.recording import FrameEntry
from caviar_view.frames import AnsweredGrants, Frames, answered_grants, events_of

MOST_FRAMES = 4096
"""Frames that are held, to look back at."""
MOST_BYTES = 1 << 28
"""Bytes of products that are held: of older frames those of sensors go first."""
EVENT_BYTES = 1 << 16
"""Of the notices of the run, the newest ones."""
_MARGIN = 256
_SENSORS = frozenset({"lidar", "camera", "depth", "segmentation"})


class LiveFrames(Frames):
    """Frames of a run, added as they are seen; those that were finished in between are not there.

    Args:
        directory: Of the run.
        scenario: As it was resolved.
        run: Id of the run.
        seed: Of the run.
        assets: Files of scenery by asset name.
    """

    kind, complete, damage = "run", True, ()

    def __init__(
        self,
        directory: Path,
        scenario: Mapping[str, Any],
        run: str,
        seed: int,
        assets: Mapping[str, Path],
    ) -> None:
        self._directory = directory
        self.scenario, self.run, self.seed, self.assets = scenario, run, seed, assets
        self.first = self.end = 0
        self.topics: Mapping[str, Sequence[str]] = {}
        self.state, self.paused = "", False
        self._entries: deque[FrameEntry] = deque()
        self._products: dict[tuple[int, str, str], ObservedProduct] = {}
        # Places of products in the order in which they are given up.
        self._sensors: deque[tuple[int, str, str]] = deque()
        self._others: deque[tuple[int, str, str]] = deque()
        self._bytes = 0
        self._answered: dict[str, dict[tuple[int, int], tuple[int, int, int]]] = {}
        # Number of answers of each service that came up to now.
        self._known: dict[str, int] = {}
        # Filled by the thread that observes, read by those that answer.
        self._lock = threading.Lock()

    def add(self, seen: Observation) -> None:
        """Take in what an observer has got."""
        with self._lock:
            self.state, self.paused = seen.message.state, seen.message.paused
            newest = self._entries[-1] if self._entries else None
            is_known = newest is not None and (newest.episode, newest.frame) == (seen.episode, seen.frame)
            if seen.frame < 0 or is_known:
                return
            message = seen.message
            self._entries.append(
                FrameEntry(
                    episode=seen.episode,
                    frame=seen.frame,
                    t_ns=message.t_ns,
                    inputs=message.inputs,
                    reports=message.reports,
                )
            )
            found = {topic: set(sources) for topic, sources in self.topics.items()}
            for (topic, source), product in seen.products.items():
                key = (self.end, topic, source)
                self._products[key] = product
                self._bytes += len(product.header) + len(product.body)
                (self._sensors if topic in _SENSORS else self._others).append(key)
                found.setdefault(topic, set()).add(source)
            self.topics = {topic: sorted(sources) for topic, sources in sorted(found.items())}
            self.end += 1
            self._give_up()

    def _give_up(self) -> None:
        while self._bytes > MOST_BYTES and (self._sensors or self._others):
            self._forget((self._sensors or self._others).popleft())
        self.first = max(0, self.end - MOST_FRAMES)
        oldest = self.end - len(self._entries)
        # Some more than `first` says: an answer that is being made may have begun with them.
        if len(self._entries) > MOST_FRAMES + _MARGIN:
            self._entries.popleft()
            for keys in (self._sensors, self._others):
                while keys and keys[0][0] == oldest:
                    self._forget(keys.popleft())

    def _forget(self, key: tuple[int, str, str]) -> None:
        product = self._products.pop(key)
        self._bytes -= len(product.header) + len(product.body)

    def entry(self, place: int) -> FrameEntry:
        """Record of a frame."""
        with self._lock:
            oldest = self.end - len(self._entries)
            if not oldest <= place < self.end:
                raise RecordingError(f"frame {place} is not held any more")
            return self._entries[place - oldest]

    def payload(self, place: int, item: GrantInput) -> Payload:
        """Payload of one of a frame's inputs."""
        with self._lock:
            product = self._products.get((place, item.topic, item.source))
        if product is None:
            raise RecordingError(
                f"{item.topic} of frame {place} is not held any more; a recording of the run has it"
            )
        try:
            return product.payload
        except ProtocolError as error:
            raise RecordingError(f"{item.topic} of {item.source!r} in frame {place}: {error}") from error

    def events(self) -> Sequence[Mapping[str, Any]]:
        """The newest notices."""
        return events_of(self._directory, EVENT_BYTES)

    def known_answers(self) -> dict[str, int]:
        """Number of answers of each service up to the newest that `add_answers` has got."""
        return self._known

    def add_answers(self, found: Mapping[str, Any]) -> None:
        """Take in what the broker's control channel says of ``answers``."""
        for name, part in found.items():
            known = self._answered.get(name, {}) | answered_grants(part["rows"])
            # A new one in place of the old: another thread may be reading that.
            self._answered[name] = dict(list(known.items())[-MOST_FRAMES:])
            self._known[name] = max(self._known.get(name, 0), part["first"] + len(part["rows"]))

    def answers(self) -> AnsweredGrants:
        """Grants that were answered, of the newest frames."""
        return self._answered
