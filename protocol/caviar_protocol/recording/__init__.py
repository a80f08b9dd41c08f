"""Reading what a run recorded.

>>> from caviar_protocol.recording import Recording
>>> recording = Recording("runs/smoke-20261122-101500")
>>> recording["channel"].h.shape  # frames × users × Nr × Nt
(100, 2, 4, 32)
>>> recording.frame(episode=0, frame=7).scene().names
('car', 'uav')

`newest_run` gives the directory of the newest run, `Recording.__getitem__` a topic as arrays over all frames,
`Recording.frames` the products frame by frame; docs/reference/recordings.md has more.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from caviar_protocol.recording.reader import RecordedFrame, RecordedProduct, Recording, RecordingWarning
    from caviar_protocol.run_directory import newest_run

_PLACES = dict.fromkeys(
    ("RecordedFrame", "RecordedProduct", "Recording", "RecordingWarning"), "recording.reader"
)
_PLACES["newest_run"] = "run_directory"


def __getattr__(name: str) -> object:
    # A recorder writes segments and reads none: it need not load the arrays of every topic.
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"caviar_protocol.{_PLACES[name]}"), name)
