"""The gateway: a WebSocket is one connection to the broker's port, message by message.

Each has a DEALER socket of its own, closed with it, so that the broker sees whether the peer is there.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Awaitable, Callable
from typing import Any

import msgspec
import zmq
import zmq.asyncio
from starlette.websockets import WebSocket, WebSocketDisconnect

from caviar_broker.http.auth import Tokens, foreign, subprotocol, token_of, token_shown
from caviar_broker.http.server import ADMIT
from caviar_broker.security.limits import NoticeThrottle
from caviar_protocol import messages as m
from caviar_protocol.codec import decode_message, encode_message, join_parts, message_type, split_frame
from caviar_protocol.codec.messages import MAX_FRAME
from caviar_protocol.errors import ProtocolError
from caviar_protocol.keys import Credentials, Token

SLOW_S = 5.0
"""[s] that a peer may take nothing of what is sent to it."""
SLOW_RATE = 1e6
"""[B/s] at which it has to take what is large."""
LINGER_MS = 1000
"""[ms] that the last messages of a peer that has gone are kept for the broker."""
QUEUE = 16
"""Messages that wait in either direction."""
LOOK_S = 1.0
"""[s] between looks at whether a token still holds."""
MESSAGES_BEFORE_HELLO = 8
"""Messages of a WebSocket until the broker has accepted its HELLO or ATTACH. Beyond twice as many, the broker
would cut off the gateway's connection, and bar its key."""
TOO_LARGE = 1009
REMEDY = "make one with  caviar keys token NAME --role ROLE"
ABNORMAL = 1006
"""Close code of a connection that ended without a close frame."""
FAREWELLS = (1000, 1001, 1005)
"""Close codes of a peer that leaves: done, going away (a page that is closed), none given."""
MAX_REASON = 123
"""[B] of the reason in a close frame (RFC 6455, section 5.5)."""

NOTE, REFUSED = "note", "refused"
"""Kinds of notices; the second is shown on the run's console."""

Tell = Callable[[str, str, str], Awaitable[None]]


class Gateway:
    """Connects WebSockets with a broker.

    Args:
        endpoint: Where the broker listens.
        tokens: Who may take part.
        tell: Called with a service, or "", what the run's user should know about it, and the kind of the
            notice.
        credentials: Its key, which a broker with keys admits for the services that have a token, and that
            broker's.
        remedy: Command that makes a token, for refusals.
    """

    def __init__(
        self,
        endpoint: str,
        tokens: Tokens,
        tell: Tell,
        credentials: Credentials | None = None,
        remedy: str = REMEDY,
    ) -> None:
        self._endpoint, self._tokens, self._tell = endpoint, tokens, tell
        self._credentials, self._remedy = credentials, remedy
        self._throttle = NoticeThrottle()
        self._context: zmq.asyncio.Context = zmq.asyncio.Context()
        self.connections = 0
        """How many are open."""

    async def serve(self, socket: WebSocket) -> None:
        """Serve one WebSocket until it closes."""
        offered = socket.scope.get("subprotocols", [])
        token = token_of(socket.headers, self._tokens, offered)
        if why := self._refusal(socket, token, token_shown(socket.headers, offered)):
            # Accept, send REFUSE, close: pages and engines cannot read the answer to a request that
            # fails.
            peer = socket.client.host if socket.client else "an unknown address"
            # Throttled: a page that tries again and again must not fill the console of the run.
            await self._refused(why, f"a WebSocket from {peer} was refused: {why}")
            await socket.accept(subprotocol(socket.scope.get("subprotocols", [])))
            await _send(socket, m.Refuse(code="unauthorized", message=why))
            await _close(socket, 1008, why)
            return
        self.connections += 1
        try:
            await socket.accept(subprotocol(offered))
            bridge = _Bridge(socket, self._dealer, self._tokens, token, self._tell, self._refused)
            await bridge.run()
        finally:
            self.connections -= 1

    def _refusal(self, socket: WebSocket, token: Token | None, shown: bool) -> str:
        """Reason why a request is refused; empty where it is not."""
        if strange := foreign(socket.headers, self._tokens):
            return strange
        if token is not None:
            what = f"the token of {token.name!r} is for {token.role}, and a service takes part here"
            return "" if token.of_service else f"{what}; {self._remedy}"
        if not self._tokens.exist:
            return ""
        what = "this token is not, or no longer, known" if shown else "there is no token in the request"
        return f"{what}; {self._remedy}"

    async def _refused(self, kind: str, text: str) -> None:
        """Show a refusal on the run's console, each kind once in a while."""
        if shown := self._throttle.tell(kind, text, time.monotonic_ns()):
            await self._tell("", shown, REFUSED)

    def _dealer(self) -> zmq.asyncio.Socket:
        dealer = self._context.socket(zmq.DEALER)
        dealer.linger = LINGER_MS
        # Few, so that a peer that does not read is felt by the broker, whose limits then apply to it.
        dealer.sndhwm = dealer.rcvhwm = QUEUE
        dealer.setsockopt(zmq.IPV6, int("[" in self._endpoint))
        if self._credentials is not None:
            self._credentials.apply_to(dealer)
        dealer.connect(self._endpoint)
        return dealer

    def close(self) -> None:
        """Close everything."""
        self._context.destroy(linger=LINGER_MS)


class _CutOff(Exception):  # noqa: N818  # it ends a connection, and is no error of ours
    """The peer is cut off: close code and reason."""

    def __init__(self, code: int, reason: str) -> None:
        self.code, self.reason = code, reason
        super().__init__(reason)


class _Bridge:
    """One WebSocket and its DEALER."""

    def __init__(
        self,
        socket: WebSocket,
        connect: Callable[[], zmq.asyncio.Socket],
        tokens: Tokens,
        token: Token | None,
        tell: Tell,
        refused: Callable[[str, str], Awaitable[None]],
    ) -> None:
        self._socket, self._tell, self._refused = socket, tell, refused
        self._tokens, self._token = tokens, token
        self._connect = connect
        # Made for a peer that says who it is: one that is silent costs the broker nothing.
        self._dealer: asyncio.Future[zmq.asyncio.Socket] = asyncio.get_running_loop().create_future()
        # Whether the broker has accepted the peer, and how many messages of it came before that.
        self._admitted, self._messages = False, 0
        # The WELCOME that the peer got on its ordered connection; None before that, and after its BYE.
        self._welcome: m.Welcome | None = None
        self._awaits_welcome = False
        # What the peer is called, once it said so.
        self._name = ""
        # Bytes of the frame sent last, which may still be under way.
        self._sent = 0

    async def run(self) -> None:
        """Carry messages both ways until one side ends."""
        tasks = [asyncio.create_task(way) for way in (self._up(), self._down(), self._watch_token())]
        up, down, _ = tasks
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            if down.done() and isinstance(down.exception(), WebSocketDisconnect):
                # It takes nothing any more; what it sent before, BYE among it, may not have been read yet.
                await asyncio.wait([up], timeout=LOOK_S)
            done = [task for task in tasks if task.done()]
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            if self._dealer.done():
                self._dealer.result().close()
        for task in done:
            error = task.exception()
            if isinstance(error, _CutOff):
                if self._name:
                    text = f"the WebSocket of {self._name!r} was cut off: {error.reason}"
                    await self._tell(self._name, text, NOTE)
                else:
                    text = f"a WebSocket that has not said who it is was cut off: {error.reason}"
                    await self._refused(f"cut off with code {error.code}", text)
                await _close(self._socket, error.code, error.reason)
            elif error is not None and not isinstance(error, WebSocketDisconnect):
                raise error

    # --- from the peer ------------------------------------------------------------------------------

    async def _up(self) -> None:
        while True:
            # One message after the other, and no task for each: the broker gets them in their order, and a
            # peer that sends faster than the broker reads is held up by TCP.
            event = await self._socket.receive()
            if event["type"] == "websocket.disconnect":
                await self._note_end(event.get("code", ABNORMAL))
                return
            frame = event.get("bytes")
            self._messages += not self._admitted
            if self._messages > MESSAGES_BEFORE_HELLO:
                raise _CutOff(1008, f"more than {MESSAGES_BEFORE_HELLO} messages, and no HELLO was accepted")
            if frame is None:
                raise _CutOff(1003, "it sent text; a message is one binary frame")
            try:
                parts: list[Any] = list(split_frame(frame))
            except ProtocolError as error:
                await self._answer(m.Error(code=error.code, message=str(error)))
                raise _CutOff(1007, f"it sent a frame that is no message: {error}") from error
            parts[0] = await self._header(parts[0])
            await self._forward(parts)

    async def _forward(self, parts: list[Any]) -> None:
        if not self._dealer.done():
            self._dealer.set_result(self._connect())
        await self._dealer.result().send_multipart(parts)

    async def _note_end(self, code: int) -> None:
        """The peer is gone: a closing handshake counts as BYE; without one the broker sees that, not why."""
        if code in FAREWELLS:
            if self._welcome is not None:
                who = {"epoch": self._welcome.epoch, "attempt": self._welcome.attempt}
                bye = m.Bye(**who, reason=f"it closed its WebSocket (code {code})")
                await self._forward([encode_message(bye)])
            return
        reason = {
            ABNORMAL: "its process ended, its machine is unreachable, or it has not read for long",
            TOO_LARGE: f"it sent a message of more than {MAX_FRAME} B",
        }.get(code, "")
        if reason and self._name:
            text = f"a WebSocket of {self._name!r} ended with code {code}: {reason}"
            await self._tell(self._name, text, NOTE)

    async def _header(self, header: memoryview) -> Any:
        """The header as the broker gets it.

        What is no message goes on to the broker, which judges it as it does over ZeroMQ, except before
        the peer said who it is.
        """
        try:
            message = decode_message(header)
        except ProtocolError as error:
            if self._name:
                return header
            await self._answer(m.Error(code=error.code, message=str(error)))
            raise _CutOff(1007, f"it sent what is not in the protocol: {error}") from error
        match message:
            case m.Hello():
                await self._identify(message.name, message.role)
                self._awaits_welcome = True
                # A process id means nothing here: this connection tells whether the peer is there.
                fields = msgspec.msgpack.decode(header)
                return msgspec.msgpack.encode({k: v for k, v in fields.items() if k not in ("pid", "host")})
            case m.Attach():
                await self._identify(message.name, "")
            case m.Bye():
                self._welcome = None
            case _ if not self._name:
                text = f"{message_type(message)} came before HELLO or ATTACH"
                await self._answer(m.Error(code="unknown-peer", of=message_type(message), message=text))
                raise _CutOff(1008, text)
            case _:
                pass
        return header

    async def _identify(self, name: str, role: str) -> None:
        token = self._token
        if token is not None and (token.name != name or role not in ("", token.role)):
            text = f"the token is of {token.role} {token.name!r}, not of {role} {name!r}".replace("  ", " ")
            await self._answer(m.Refuse(code="unauthorized", message=text))
            raise _CutOff(1008, text)
        if self._name not in ("", name):
            raise _CutOff(1008, f"it said that it is {name!r}, on the connection of {self._name!r}")
        self._name = name

    async def _answer(self, message: m.Message) -> None:
        """An answer of the gateway's own, in front of a cut."""
        await _send(self._socket, message)

    # --- to the peer --------------------------------------------------------------------------------

    async def _down(self) -> None:
        dealer = await asyncio.shield(self._dealer)  # the one who waits may be cancelled, and not the future
        while True:
            parts = await dealer.recv_multipart(copy=False)
            if self._awaits_welcome or not self._admitted:
                # Learn from WELCOME, or the answer to ATTACH, that the peer is accepted, and as what;
                # what cannot be read here is the peer's to judge.
                header = parts[0].buffer
                with contextlib.suppress(ProtocolError):
                    message = decode_message(header)
                    if isinstance(message, m.Welcome):
                        self._welcome, self._awaits_welcome = message, False
                    if isinstance(message, m.Welcome | m.HeartbeatAck):
                        self._admitted = True
                        self._socket.scope.get("state", {}).get(ADMIT, _no_limits)()
            frame = join_parts([part.buffer for part in parts])
            # The frame before may still be on its way: its size counts for the time of this one.
            patience = SLOW_S + self._sent / SLOW_RATE
            try:
                async with asyncio.timeout(patience):
                    await self._socket.send_bytes(frame)
            except TimeoutError as error:
                raise _CutOff(1008, f"it has not read for {patience:.3g} s") from error
            self._sent = len(frame)

    async def _watch_token(self) -> None:
        """A token that is revoked ends what came in with it."""
        while True:
            await asyncio.sleep(LOOK_S)
            if self._token is not None and not self._tokens.holds(self._token):
                raise _CutOff(1008, "its token was revoked")


def _no_limits() -> None:
    """Admit a peer where the server has no limits for strangers."""


async def _send(socket: WebSocket, message: m.Message) -> None:
    """Send a message of one part; a peer that does not take it within `LOOK_S` goes without."""
    with contextlib.suppress(TimeoutError, RuntimeError, WebSocketDisconnect):
        async with asyncio.timeout(LOOK_S):
            await socket.send_bytes(join_parts([encode_message(message)]))


async def _close(socket: WebSocket, code: int, reason: str) -> None:
    """Close a WebSocket; one that does not read, or has gone, is left to end by itself."""
    # Cut in bytes, as the limit counts, without half a character at the end.
    short = reason.encode()[:MAX_REASON].decode(errors="ignore")
    with contextlib.suppress(TimeoutError, RuntimeError, WebSocketDisconnect):
        async with asyncio.timeout(LOOK_S):
            await socket.close(code, short)
