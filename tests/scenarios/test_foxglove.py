"""``caviar view RUN --foxglove``: a viewer of Foxglove beside a run that goes on."""

from __future__ import annotations

import asyncio
import json
import queue
import signal
import struct
import threading
from pathlib import Path

import pytest
from scenarios_support import SCENARIOS, eventually, recorded_below, running

from caviar_formats.live import serve_foxglove
from caviar_protocol.errors import RunError
from caviar_protocol.recording import Recording

USER = "/users/car/rx/bs/mmwave"
TOPICS = {"/scenery", "/tf", "/objects", "/rays", "/beams", USER}


async def seen_by_a_viewer(url: str, frames: int) -> dict[str, list[tuple[int, bytes]]]:
    """Times [ns] and messages by topic, of a viewer that subscribes to all topics for some frames, until each
    has come: scenery and beams, too, which do not come with each frame."""
    from websockets import connect

    topics, found = dict[int, str](), dict[str, list[tuple[int, bytes]]]()
    async with connect(url, subprotocols=["foxglove.sdk.v1"], max_size=None) as socket:
        while len(found.get(USER, ())) < frames or not set(found) >= TOPICS:
            message = await asyncio.wait_for(socket.recv(), 60)
            if isinstance(message, bytes):
                kind, subscription, t_ns = struct.unpack_from("<BIQ", message)
                assert kind == 1
                found.setdefault(topics[subscription], []).append((t_ns, message[13:]))
                continue
            for channel in json.loads(message).get("channels", ()):
                topics[channel["id"]] = channel["topic"]
                subscription = {"id": channel["id"], "channelId": channel["id"]}
                await socket.send(json.dumps({"op": "subscribe", "subscriptions": [subscription]}))
    return found


def test_foxglove_sees_a_run_as_it_goes_on_until_it_ends(tmp_path: Path) -> None:
    pytest.importorskip("foxglove")
    arguments = ("--frames", "100000", "--pace", "1")
    with running(SCENARIOS / "smoke.toml", tmp_path, *arguments) as (process, _):
        eventually(lambda: recorded_below(tmp_path) > 3, 20, "a few frames are recorded")
        (run,) = tmp_path.glob("smoke-*")
        urls = queue.Queue[str]()
        server = threading.Thread(target=serve_foxglove, args=(run, 0, urls.put), daemon=True)
        server.start()
        url = urls.get(timeout=60)
        assert url.startswith("ws://127.0.0.1:")
        first = asyncio.run(seen_by_a_viewer(url, 5))
        second = asyncio.run(seen_by_a_viewer(url, 2))
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=120)
        server.join(60)
        assert not server.is_alive()
    assert first[USER][-1][0] < second[USER][0][0]
    links = Recording(run)["link"].select(rx="car/rx")
    right = dict(zip(links.t_ns.tolist(), links.abs_y[:, 0].tolist(), strict=True))
    for t_ns, content in first[USER] + second[USER]:
        assert json.loads(content)["abs_y"] == right[t_ns]


def test_a_run_that_is_over_is_not_served(tmp_path: Path) -> None:
    pytest.importorskip("foxglove")
    with pytest.raises(RunError, match="no broker"):
        serve_foxglove(tmp_path, 0, lambda url: None)
