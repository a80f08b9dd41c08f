"""``caviar view RUN --foxglove``: a run as it goes on, served to Foxglove."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec

from caviar_broker.control.socket import ask
from caviar_broker.http.process import reachable
from caviar_formats.viewers import FoxgloveMessages, moment
from caviar_protocol.assets import AssetStore
from caviar_protocol.errors import SetupError
from caviar_protocol.fields import Asset
from caviar_protocol.host import install_command
from caviar_protocol.observer import Observation, Observer
from caviar_protocol.recording import RecordedFrame
from caviar_protocol.run_directory import RunDirectory
from caviar_view.world import World

PERIOD_S = 0.05
"""Least time from one frame that is shown to the next [s]."""
MESSAGES = 256
"""Messages that are held for a viewer; one that is slower does without the oldest."""


class _Guests:
    """Listener of the server: notes that a viewer has come, which has seen nothing yet."""

    has_come = True

    def on_subscribe(self, client: Any, channel: Any) -> None:
        """Take note of a viewer."""
        self.has_come = True

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        """Do nothing."""


def serve_foxglove(run: Path, port: int, announce: Callable[[str], None]) -> None:
    """Serve a run to Foxglove on this machine until it ends: the newest frames, as an observer sees them.

    The server of Foxglove's SDK asks nobody for a token: it is reached from this machine alone.

    Args:
        run: Directory of the run.
        port: To serve at; 0: any.
        announce: Called with the address that Foxglove opens.

    Raises:
        RunError: No broker runs there, or it refuses the observer.
        SetupError: The SDK of Foxglove is not installed, the port is taken, or the broker asks for keys.
    """
    if find_spec("foxglove") is None:
        raise SetupError(f"--foxglove needs foxglove; run: {install_command('viewers')}")
    import foxglove
    from foxglove.websocket import Capability

    if ask(run, do="gateway")["keys"] is not None:
        raise SetupError(
            f"the broker in {run} asks for keys, and any program of this machine could read the run from a "
            "server without them; leave out --foxglove, or export the recording with --to foxglove"
        )
    status = ask(run, do="status")["status"]
    world = World(_assets(run), json.loads(RunDirectory(run).record.read_text("utf-8"))["scenario"])
    context, guests = foxglove.Context(), _Guests()
    try:
        server = foxglove.start_server(
            name=status["run"], host="127.0.0.1", port=port, server_listener=guests, context=context,
            capabilities=[Capability.Time], message_backlog_size=MESSAGES,
        )  # fmt: skip
    except (OSError, RuntimeError) as error:
        raise SetupError(f"--foxglove {port}: {error}; choose another port, or 0 for any") from error
    messages = FoxgloveMessages(context)
    try:
        announce(f"ws://127.0.0.1:{server.port}")
        now, episode = None, 0
        with Observer(reachable(status["endpoint"]), "Foxglove", period_s=PERIOD_S) as observer:
            while not observer.ended:
                seen = observer.receive(timeout_s=0.5)
                # News of a run that pauses, or has no frame yet, have no products.
                is_new = seen is not None and bool(seen.products)
                if seen is not None and is_new:
                    now = moment(_frame(seen))
                    if seen.episode != episode:  # time begins again
                        episode = seen.episode
                        server.clear_session()
                # A viewer that has come sees a run that stands still, too.
                if now is None or not (is_new or guests.has_come):
                    continue
                messages.stamp(now.t_ns)
                if guests.has_come:
                    guests.has_come = False
                    messages.scenery(world)
                messages.add(now)
                server.broadcast_time(now.t_ns)
    finally:
        server.stop()


def _frame(seen: Observation) -> RecordedFrame:
    """Frame of an observer, with the methods of one that was recorded."""
    products = tuple(seen.products.values())
    recording: Any = SimpleNamespace(entry=lambda _: seen.message, products_of=lambda _: products)
    return RecordedFrame(recording, 0)


def _assets(run: Path) -> Mapping[str, Path]:
    scenery = ask(run, do="scenery")
    return AssetStore(Path(scenery["store"])).folder_of(msgspec.convert(scenery["assets"], list[Asset]))
