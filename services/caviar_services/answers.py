"""What a service answered, kept for a GRANT that is repeated; and exceptions turned into FAULTs."""

from __future__ import annotations

import logging
import traceback
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from caviar_protocol import limits
from caviar_protocol import messages as m
from caviar_protocol.errors import CaviarError, ProductError

_log = logging.getLogger("caviar.service")

KEPT_BYTES = 64 << 20
"""[B] of answers that are kept, beyond the newest two."""
MAX_MESSAGE = 2000
MAX_DETAIL = 20000
"""[characters] of a FAULT's texts."""


class Answers:
    """The newest answers of an episode, by frame, as they travel (contract, clause 7)."""

    def __init__(self) -> None:
        self._parts: OrderedDict[int, Sequence[Any]] = OrderedDict()
        self._bytes = 0
        self._newest = -1

    def clear(self) -> None:
        """A new episode begins."""
        self.go_on_behind(-1)

    def go_on_behind(self, frame: int) -> None:
        """The service is where it was after this frame: that and those before are not answered again."""
        self._parts.clear()
        self._bytes, self._newest = 0, frame

    def is_new(self, frame: int) -> bool:
        """Whether the frame lies behind all that were answered."""
        return frame > self._newest

    def get(self, frame: int) -> Sequence[Any] | None:
        """The answer to a frame; None where it is not kept."""
        return self._parts.get(frame)

    def put(self, frame: int, parts: Sequence[Any]) -> None:
        """Keep an answer, and forget the oldest where they get too many or too large."""
        self._parts[frame], self._newest = parts, frame
        self._bytes += _size(parts)
        while len(self._parts) > 2 and (len(self._parts) > limits.MAX_IN_FLIGHT or self._bytes > KEPT_BYTES):
            self._bytes -= _size(self._parts.popitem(last=False)[1])


def _size(parts: Sequence[Any]) -> int:
    return sum(map(len, parts))


class Guard:
    """Context in which an exception becomes a FAULT, handed to ``report``, and goes no further.

    ``phase`` may be changed inside the context.
    """

    def __init__(
        self,
        identity: Mapping[str, Any],
        report: Callable[[m.Fault], None],
        phase: str,
        episode: int = 0,
        frame: int = -1,
    ) -> None:
        self.phase = phase
        self._identity, self._report = identity, report
        self._episode, self._frame = episode, frame

    def __enter__(self) -> Guard:
        return self

    def __exit__(self, _: object, error: BaseException | None, __: object) -> bool:
        if not isinstance(error, Exception):
            return False
        known = isinstance(error, CaviarError)
        text = str(error) if known else f"{type(error).__name__}: {error}"
        detail = "" if known else "".join(traceback.format_exception(error))
        _log.error(detail or text)
        self._report(
            m.Fault(
                **self._identity,
                episode=self._episode,
                frame=self._frame,
                phase=self.phase,
                message=_sendable(text[:MAX_MESSAGE]),
                detail=_sendable(detail[-MAX_DETAIL:]),
                culprit=error.source if isinstance(error, ProductError) else "",
            )
        )
        return True


def _sendable(text: str) -> str:
    """The text without what UTF-8 cannot say: names of files may hold such."""
    return text.encode(errors="backslashreplace").decode()
