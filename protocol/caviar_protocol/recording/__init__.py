"""Reading what a run recorded.

>>> from caviar_protocol.recording import Recording
>>> recording = Recording("runs/smoke-20261122-101500")
>>> recording["channel"].h.shape  # frames × users × Nr × Nt
(100, 2, 4, 32)
>>> recording.frame(episode=0, frame=7).scene().names
('car', 'uav')

`newest_run` gives the directory of the newest run, `Recording.__getitem__` a topic as arrays over all frames,
`Recording.frames` the products frame by frame; docs/reading-recordings.md has more.
"""

from caviar_protocol.recording.reader import RecordedFrame, RecordedProduct, Recording, RecordingWarning
from caviar_protocol.run_directory import newest_run
