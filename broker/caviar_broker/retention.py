"""Which entries of a journal a broker that resumes still needs, so that the others can go."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from caviar_broker.core.resumption import Snapshot
from caviar_broker.journal_format import JournalEntry


class Located(NamedTuple):
    """An entry by what decides whether it is needed, and its place in the file."""

    episode: int
    frame: int
    service: str
    outcome: str
    topics: tuple[str, ...]
    """Of the products in it."""
    offset: int
    """Of its payload [B]."""
    length: int

    @classmethod
    def of(cls, entry: JournalEntry, offset: int, length: int) -> Located:
        """The place of an entry."""
        topics = tuple([product[0] for product in entry.products])
        return cls(entry.episode, entry.frame, entry.service, entry.outcome, topics, offset, length)


class EntryIndex:
    """The places of the entries of a journal, in 40 B each: they are kept until the next compaction."""

    def __init__(self) -> None:
        self._numbers = array("q")
        """Episode, frame, offset and length of each."""
        self._kinds: list[tuple[str, str, tuple[str, ...]]] = []
        """Service, outcome and topics of each."""
        self._known: dict[tuple[str, str, tuple[str, ...]], tuple[str, str, tuple[str, ...]]] = {}

    def extend(self, entries: Iterable[Located]) -> None:
        """Note entries behind those that are known."""
        for entry in entries:
            kind = entry.service, entry.outcome, entry.topics
            self._kinds.append(self._known.setdefault(kind, kind))
            self._numbers.extend((entry.episode, entry.frame, entry.offset, entry.length))

    def __iter__(self) -> Iterator[Located]:
        numbers = iter(self._numbers)
        columns = zip(numbers, numbers, numbers, numbers, strict=True)
        for (episode, frame, offset, length), kind in zip(columns, self._kinds, strict=True):
            yield Located(episode, frame, *kind, offset, length)


def needed(entries: Iterable[Located], snapshot: Snapshot) -> tuple[int, list[Located]]:
    """Entries that are needed beside a snapshot, in order, and the frame from which all are there.

    That frame is the last finished one, or that of the oldest among the services' newest states of a
    finished frame: what came since is granted again to a service that comes back. Of earlier frames the
    newest products remain, which may be held, and how agents end the episode.
    """
    live = [
        entry
        for entry in _in_force(entries)
        if entry.episode > snapshot.episode
        or (entry.episode == snapshot.episode and entry.outcome != "episode")
    ]
    saved: dict[str, int] = {}
    for entry in live:
        is_finished = entry.episode == snapshot.episode and entry.frame < snapshot.finished
        if entry.outcome == "checkpoint" and is_finished:
            saved[entry.service] = max(entry.frame, saved.get(entry.service, -1))
    base = min([snapshot.finished - 1, *saved.values()])
    newest: dict[tuple[str, str], Located] = {}
    for entry in live:
        if entry.episode == snapshot.episode and entry.frame < base:
            for topic in entry.topics:
                before = newest.get((entry.service, topic))
                if before is None or entry.frame >= before.frame:
                    newest[entry.service, topic] = entry
    held = {entry.offset for entry in newest.values()}
    return base, [
        entry
        for entry in live
        if entry.episode > snapshot.episode
        or entry.frame >= base
        or entry.offset in held
        or entry.outcome in ("end", "seed")
    ]


def _in_force(entries: Iterable[Located]) -> list[Located]:
    """Entries without those that a broker decided anew, and without what a snapshot replaces."""
    found: list[Located] = []
    for entry in entries:
        if entry.outcome == "resumed":
            found = [e for e in found if (e.episode, e.frame) < (entry.episode, entry.frame)]
        elif entry.outcome == "episode":
            found = [e for e in found if e.episode < entry.episode]
            found.append(entry)
        elif entry.outcome != "snapshot":
            found.append(entry)
    return found
