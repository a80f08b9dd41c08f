"""Maps of scenes as RGB images, for environments that render."""

from __future__ import annotations

from typing import Any

import numpy as np

from caviar_clients.plots.map import MapData, chosen_beam, draw_antennas, draw_beam, draw_objects
from caviar_clients.plots.style import GREY
from caviar_protocol.arrays import Float64Array, UInt8Array
from caviar_protocol.errors import SetupError
from caviar_protocol.host import install_command
from caviar_protocol.space.codebooks import codebook_of
from caviar_protocol.space.scene import Pair, device_pose
from caviar_protocol.topics import AntennaArray, Link, Scene

SIZE_IN, DPI = (6.4, 4.8), 100
"""640×480 pixels."""
MARGIN_M = 15.0
"""Around what was seen so far."""


class MapRenderer:
    """Draws scenes as maps. The view only grows: what stands still in the world stands still in the pictures.

    Raises:
        SetupError: Matplotlib is not installed; the text has the command.
    """

    def __init__(self) -> None:
        try:
            from matplotlib.backends.backend_agg import FigureCanvasAgg
            from matplotlib.figure import Figure
        except ImportError as error:
            raise SetupError(f"pictures need Matplotlib; run: {install_command('plot')}") from error
        self._figure = Figure(SIZE_IN, dpi=DPI, layout="compressed")
        self._canvas = FigureCanvasAgg(self._figure)
        self._axes: Any = self._figure.subplots()
        self._low, self._high = np.full(2, np.inf), np.full(2, -np.inf)

    def draw(self, scene: Scene, link: Link | None, pair: Pair | None, title: str) -> UInt8Array:
        """Draw a scene.

        Args:
            scene: What is drawn.
            link: Has the beams; None: none is drawn.
            pair: The one whose beam is drawn; None: none.
            title: Stands above the map.

        Returns:
            Picture, Shape ``[480, 640, 3]``, red, green and blue, 0 to 255.
        """
        user = None
        if pair is not None and link is not None:
            users = zip(link.tx, link.rx, link.carrier, strict=True)
            user = next((u for u in users if u[:2] == (pair.tx.name, pair.rx.name)), None)
        data = MapData(scene, None, link, None, _beam_gain, user, title)
        axes = self._axes
        axes.clear()
        self._widen(scene)
        axes.set_xlim(self._low[0], self._high[0])
        axes.set_ylim(self._low[1], self._high[1])
        axes.set_aspect("equal")
        axes.grid(color=GREY, alpha=0.2)
        beam = chosen_beam(data)
        if beam is not None:
            draw_beam(axes, beam)
        draw_objects(axes, data)
        draw_antennas(axes, data)
        axes.set_xlabel("x, east [m]")
        axes.set_ylabel("y, north [m]")
        axes.set_title(title)
        self._canvas.draw()
        return np.array(self._canvas.buffer_rgba())[..., :3].copy()  # the canvas uses its buffer again

    def _widen(self, scene: Scene) -> None:
        devices = [device_pose(scene, device).position[:2] for device in scene.devices]
        seen = np.concatenate([scene.position[:, :2], np.array(devices).reshape(-1, 2)])
        if len(seen):
            self._low = np.minimum(self._low, seen.min(0) - MARGIN_M)
            self._high = np.maximum(self._high, seen.max(0) + MARGIN_M)


def _beam_gain(array: AntennaArray, beam: int, directions: Float64Array) -> Float64Array:
    return codebook_of(array).gain(beam, directions)
