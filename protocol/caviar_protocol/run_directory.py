"""Directory of a run: the name of each file that CAVIAR writes there, and which run is the newest."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from caviar_protocol.errors import RecordingError

SEGMENT_PATTERN = "recording-*.mcap"
"""Names of the segments of a recording, as a glob pattern."""


@dataclass(frozen=True)
class RunDirectory:
    """The directory of one run, with a property for each file that a part of CAVIAR writes there.

    Nothing is read or made: a property is a path, whether or not the file exists.

    Example:
        >>> run = RunDirectory(Path("runs/smoke-20261122-101500"))
        >>> run.journal.name, run.segment(0).name, run.log("broker").relative_to(run.path).as_posix()
        ('journal.msgpack', 'recording-0000.mcap', 'logs/broker.log')
    """

    path: Path

    @property
    def record(self) -> Path:
        """Scenario, endpoint and versions of the run. Written by the broker."""
        return self.path / "run.json"

    @property
    def journal(self) -> Path:
        """Every decision of the broker, in order (contract, clause 18)."""
        return self.path / "journal.msgpack"

    @property
    def checkpoints(self) -> Path:
        """Folder of the states of services, beside the journal."""
        return self.path / "checkpoints"

    @property
    def policies(self) -> Path:
        """Folder of the trained policies that agents of the run were given, a folder for each agent."""
        return self.path / "policies"

    @property
    def events(self) -> Path:
        """Notices of the run, one JSON object a line."""
        return self.path / "events.jsonl"

    @property
    def latencies(self) -> Path:
        """Wall times of frames and services as NumPy arrays. Written by the broker when the run ends."""
        return self.path / "latency.npz"

    @property
    def summary(self) -> Path:
        """Figures of the run. Written by ``caviar run`` when the run ends."""
        return self.path / "summary.json"

    @property
    def summary_table(self) -> Path:
        """The same figures as the table that ``caviar run`` prints."""
        return self.path / "summary.txt"

    @property
    def control_socket(self) -> Path:
        """Unix socket at which the broker takes commands, where the file system has such sockets."""
        return self.path / "control.sock"

    @property
    def control_note(self) -> Path:
        """Note with the place of the broker's control socket, and what else a client has to know."""
        return self.path / "control.json"

    def log(self, process: str) -> Path:
        """Log of a process: ``broker``, ``http``, or the name of a service."""
        return self.path / "logs" / f"{process}.log"

    @property
    def manifest(self) -> Path:
        """Manifest of the recording: its segments, and the record of each finished one."""
        return self.path / "recording.json"

    def segment(self, number: int) -> Path:
        """Segment of the recording, counted from 0."""
        return self.path / f"recording-{number:04d}.mcap"

    def segments(self) -> list[Path]:
        """Segments of the recording that are there, in order. Raises `OSError` where the disk refuses."""
        # With more than 10,000 segments numbers grow longer, and names alone would sort wrongly.
        return sorted(self.path.glob(SEGMENT_PATTERN), key=lambda file: (len(file.name), file.name))

    @property
    def assets(self) -> Path:
        """Folder of the recorded scenery, files at their asset names."""
        return self.path / "assets"


def runs_below(folder: str | Path) -> str:
    """Say which run is meant where a folder of runs was given in place of one: the end of an error's text.

    Args:
        folder: That was given.

    Returns:
        ``"; it holds runs: give one, as runs/smoke-20261122-101500"``, of a dataset an episode; empty where
        it holds none.
    """
    for dataset in (Path(folder), Path(folder).parent):
        first = min((dataset / "episodes").glob("episode-*"), default=None)
        if first is not None and (dataset / "catalogue.sqlite").is_file():
            return (
                f"; {dataset} is a dataset: give an episode of it, as {first}; caviar dataset verify "
                f"{dataset} and caviar dataset look {dataset} look at all"
            )
    try:
        newest = newest_run(folder)
    except (RecordingError, OSError):
        return ""
    return f"; it holds runs: give one of them, as {newest}"


def newest_run(root: str | Path = "runs", name: str = "*") -> Path:
    """Find the run directory below ``root`` whose recording was written last.

    A directory without a recording, as a run leaves that failed while starting, is passed over.

    Args:
        root: Directory in which ``caviar run`` makes the directories of runs (its ``--out``).
        name: Glob pattern of the run directory's name, such as ``"smoke-*"``.

    Raises:
        RecordingError: No directory below ``root`` with this name has a recording.

    Example:
        >>> newest_run(name="smoke-2*").name
        'smoke-20261122-101500'
    """
    # The newest file counts, not the newest name: a run of yesterday may have been resumed since.
    written = {
        file.parent: file.stat().st_mtime_ns for file in sorted(Path(root).glob(f"{name}/{SEGMENT_PATTERN}"))
    }
    if not written:
        where = Path(root).resolve() / name
        raise RecordingError(f"no run with a recording is at {where}; make one with: caviar run SCENARIO")
    return max(written, key=lambda directory: (written[directory], directory.name))
