"""Recordings that show themselves in notebooks."""

from __future__ import annotations

import base64
from html import escape
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from caviar_protocol.errors import CaviarError
from caviar_protocol.recording import RecordedFrame, Recording
from caviar_protocol.run_directory import RunDirectory


class Page(NamedTuple):
    """A web page that a notebook shows in a frame of its own."""

    html: str
    height: int
    """Of the frame [px]."""

    def _repr_html_(self) -> str:
        # The page runs its own scripts, and reaches neither the notebook nor its server.
        style = f"width: 100%; height: {self.height}px; border: 0"
        return f'<iframe sandbox="allow-scripts" style="{style}" srcdoc="{escape(self.html)}"></iframe>'

    def __repr__(self) -> str:
        return f"page of {len(self.html) / 1e6:.1f} MB, for notebooks"


class RecordedRun(Recording):
    """A recording that shows itself in a notebook: the summary of its run, and where Matplotlib is a map."""

    def view(self, limit_mb: float = 10.0, height: int = 600) -> Page:
        """Make the page of ``caviar view``, without a server.

        Args:
            limit_mb: Size at most, which the notebook grows by [MB]; frames and points are thinned to it.
            height: Of the frame in the notebook [px].

        Raises:
            RecordingError: Not even a few frames fit, or bytes are damaged.
        """
        from caviar_view.answers import Answers
        from caviar_view.frames import RecordedFrames
        from caviar_view.save import saved_page

        content, _ = saved_page(Answers(RecordedFrames(self)), int(limit_mb * 1e6))
        return Page(content.decode(), height)

    def _repr_html_(self) -> str:
        file = RunDirectory(self.directory).summary_table
        summary = file.read_text(encoding="utf-8") if file.is_file() else ""
        texts = "\n".join(f"<pre>{escape(text)}</pre>" for text in (repr(self), summary) if text)
        return f'<div style="display: flex; flex-wrap: wrap; gap: 1em">{texts}{self._map()}</div>'

    def _map(self) -> str:
        """The map of the middle frame as an image; empty where there is none, or no Matplotlib."""
        if find_spec("matplotlib") is None or not len(self):
            return ""
        from caviar_clients.cli.plot import map_data, scenery
        from caviar_clients.plots.map import draw_map

        with TemporaryDirectory() as folder:
            file = Path(folder, "map.png")
            try:
                data = map_data(self, RecordedFrame(self, len(self) // 2), None, scenery(self))
                if data is None:
                    return ""
                draw_map(data, file)
            except CaviarError:
                return ""  # damaged; its text is shown all the same
            image = base64.b64encode(file.read_bytes()).decode()
        return f'<img alt="map of frame {len(self) // 2}" width="480" src="data:image/png;base64,{image}">'
