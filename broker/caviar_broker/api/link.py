"""The broker's desk, asked from an event loop."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

from caviar_broker.deskplace import REACH_S, connect
from caviar_protocol.errors import RunError

MAX_LINE = 1 << 24
"""[B] of an answer."""

_Streams = tuple[asyncio.StreamReader, asyncio.StreamWriter]


class DeskRefusal(RunError):  # noqa: N818  # it is an answer, and named as the desk names it
    """The desk was asked for what cannot be now."""


class DeskLink:
    """Asks the desk of the broker that runs in a directory; one question at a time."""

    def __init__(self, run: Path) -> None:
        self._run = run
        self._streams: _Streams | None = None
        self._turn = asyncio.Lock()

    async def ask(self, do: str, **request: Any) -> dict[str, Any]:
        """The answer. Raises `DeskRefusal`, or `RunError` where the broker does not answer or is gone."""
        async with self._turn:
            try:
                async with asyncio.timeout(REACH_S):
                    answer = await self._exchange({"do": do, **request})
            except (TimeoutError, OSError, ValueError) as error:
                self.close()
                told = (
                    f"does not answer within {REACH_S:g} s" if isinstance(error, TimeoutError) else "is gone"
                )
                raise RunError(f"the broker {told}") from error
        if not answer["ok"]:
            raise DeskRefusal(answer["error"])
        return answer

    async def _exchange(self, request: dict[str, Any]) -> dict[str, Any]:
        if self._streams is None:
            self._streams = await _open(self._run)
        reader, writer = self._streams
        writer.write(json.dumps(request).encode() + b"\n")
        await writer.drain()
        answer: dict[str, Any] = json.loads(await reader.readline())
        return answer

    async def events(self) -> AsyncIterator[dict[str, Any]]:
        """What happens in the run, until the broker ends."""
        reader, writer = await _open(self._run)
        try:
            writer.write(b'{"do": "subscribe"}\n')
            while line := await reader.readline():
                event = json.loads(line)
                if "event" in event:
                    yield event
        except OSError:
            return
        finally:
            writer.close()

    def close(self) -> None:
        """Hang up."""
        if self._streams is not None:
            self._streams[1].close()
            self._streams = None


async def _open(run: Path) -> _Streams:
    connection = connect(run)
    connection.setblocking(False)
    return await asyncio.open_unix_connection(sock=connection, limit=MAX_LINE)
