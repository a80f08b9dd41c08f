"""``caviar view RUN --foxglove``: a run as it goes on, served to Foxglove."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import msgspec

from caviar_broker.control.socket import ask
from caviar_broker.http.process import reachable
from caviar_formats.foxglove import FoxgloveMessages
from caviar_formats.viewers import moment
from caviar_protocol.assets import AssetStore
from caviar_protocol.errors import SetupError
from caviar_protocol.fields import Asset
from caviar_protocol.host import install_command
from caviar_protocol.observer import Observation, ObservedProduct, Observer
from caviar_protocol.run_directory import RunDirectory
from caviar_protocol.space.scene import merge_scenes
from caviar_protocol.topics import Scene
from caviar_view.world import World

PERIOD_S = 0.05
"""Least time from one frame that is shown to the next [s]."""


class ObservedFrame:
    """A frame of an observer, as `moment` takes it.

    Args:
        seen: By the observer.
    """

    def __init__(self, seen: Observation) -> None:
        self.t_ns = seen.message.t_ns
        self.products: tuple[ObservedProduct, ...] = tuple(seen.products.values())

    def payloads(self, topic: str, cls: type[Any]) -> dict[str, Any]:
        """Payloads of a topic by source, as of `RecordedFrame.payloads`."""
        found = [p for p in self.products if p.provenance.topic == topic]
        return {product.provenance.source: product.payload for product in found}

    def scene(self) -> Scene | None:
        """The scenes of all worlds as one; None where there is none."""
        scenes = self.payloads("scene", Scene)
        return merge_scenes(scenes) if scenes else None


class _Guests:
    """Listener of the server: notes that a viewer has come, which has not seen the scenery."""

    has_come = True

    def on_subscribe(self, client: Any, channel: Any) -> None:
        """Take note of a viewer."""
        self.has_come = True

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        """Do nothing."""


def serve_foxglove(run: Path, port: int, announce: Callable[[str], None]) -> None:
    """Serve a run to Foxglove on this machine until it ends: the newest frames, as an observer sees them.

    The server of Foxglove's SDK asks nobody for a token: it is reached from this machine alone, and a run of
    which the broker asks for keys is not served.

    Args:
        run: Directory of the run.
        port: To serve at; 0: any.
        announce: Called with the address that Foxglove opens, once there is a frame.

    Raises:
        RunError: No broker runs there, or it refuses the observer.
        SetupError: The SDK of Foxglove is not installed, the port is taken, or the broker asks for keys.
    """
    if find_spec("foxglove") is None:
        raise SetupError(f"--foxglove needs foxglove; run: {install_command('viewers')}")
    import foxglove

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
            name=status["run"], host="127.0.0.1", port=port, server_listener=guests, context=context
        )
    except (OSError, RuntimeError) as error:
        raise SetupError(f"--foxglove {port}: {error}; choose another port, or 0 for any") from error
    messages, is_announced = FoxgloveMessages(context), False
    try:
        endpoint = reachable(status["endpoint"])
        with Observer(endpoint, "Foxglove", period_s=PERIOD_S) as observer:
            for seen in observer:
                if seen.frame < 0 or not seen.products:  # a run that begins, or pauses
                    continue
                messages.stamp(seen.message.t_ns)
                if guests.has_come:
                    guests.has_come = False
                    messages.scenery(world)
                messages.add(moment(ObservedFrame(seen)))
                if not is_announced:  # with its topics: the SDK refuses who subscribes to one as it appears
                    is_announced = True
                    announce(f"ws://127.0.0.1:{server.port}")
    finally:
        server.stop()


def _assets(run: Path) -> Mapping[str, Path]:
    scenery = ask(run, do="scenery")
    return AssetStore(Path(scenery["store"])).folder_of(msgspec.convert(scenery["assets"], list[Asset]))
