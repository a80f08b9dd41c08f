"""Which decisions are safe: numbers of journal entries, written and not (contract, clause 18)."""

from __future__ import annotations


class Ledger:
    """Counts the entries of the run's journal.

    Entries become safe in order, so one number says which are: all up to and including `written`.
    """

    def __init__(self, *, kept: bool = True) -> None:
        self._kept = kept
        """Whether there is a journal; without one every entry is as safe as it will be."""
        self.last = 0
        """Number of the last entry; 0: none yet."""
        self.written = 0
        """All entries up to this number are with the operating system."""
        self.waiting_since: int | None = None
        """Since when no entry was confirmed though some are outstanding [ns]; None: none is."""

    def enter(self, now: int) -> int:
        """Number of a new entry."""
        self.last += 1
        if not self._kept:
            self.written = self.last
        elif self.waiting_since is None:
            self.waiting_since = now
        return self.last

    def confirm(self, number: int, now: int) -> bool:
        """Entries up to ``number`` are written; whether that is news."""
        if number <= self.written:
            return False
        self.written = number
        self.waiting_since = now if number < self.last else None
        return True
