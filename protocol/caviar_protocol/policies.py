"""Trained policies as files of a run: where a run keeps them, and the decisions that name them.

The agent ``policy`` serves an ONNX file. A run keeps each file that it was given, in order, so that its
broker can hand them to the agent on whatever machine that is, and a replay finds what decided each frame.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

from caviar_protocol.errors import RunError
from caviar_protocol.files import replace_file
from caviar_protocol.run_directory import RunDirectory

USE = "policy"
"""Implementation of the agent that serves policies."""
DECISION = "policy"
"""Decision of a frame: SHA-256 of the policy that decides it, in DONE, and in GRANT where it is imposed."""
NEXT = "policy.next"
"""In GRANT: SHA-256 of the policy that the agent is to change to once it has loaded it."""
REFUSED = "policy.refused"
"""In DONE: SHA-256 of the policy that the agent cannot serve, a space, and why."""
FILE, SHA256, EARLIER = "file", "sha256", "earlier"
"""Keys of the agent's settings; the broker fills in the last two."""
MAX_POLICY = 64 * 2**20
"""[B] of a policy's file."""


class PolicyFolder:
    """The policies that the agents of one run were given: ``policies/AGENT/0001-SHA256.onnx``.

    Args:
        directory: Of the run.

    Example:
        >>> folder = PolicyFolder(Path("runs/beams"))
        >>> digest = folder.add("agent", b"an ONNX file")
        >>> folder.add("agent", b"an ONNX file") == digest, len(folder.digests("agent"))
        (True, 1)
    """

    def __init__(self, directory: Path) -> None:
        self._folder = RunDirectory(directory).policies

    def files(self, agent: str) -> dict[str, Path]:
        """Files of an agent by SHA-256."""
        return {path.stem.partition("-")[2]: path for path in self._paths(agent)}

    def digests(self, agent: str) -> tuple[str, ...]:
        """SHA-256 of the files in the order in which an agent was given them; one may come again."""
        return tuple(path.stem.partition("-")[2] for path in self._paths(agent))

    def add(self, agent: str, content: bytes) -> str:
        """Keep a file as the last one, unless it is that already.

        Args:
            agent: Name of the agent in the run.
            content: The file.

        Returns:
            Its SHA-256.

        Raises:
            RunError: It is too large, or cannot be written.
        """
        if len(content) > MAX_POLICY:
            raise RunError(f"the policy has {len(content)} B, and a policy may have {MAX_POLICY} B")
        digest, paths = hashlib.sha256(content).hexdigest(), self._paths(agent)
        if paths and paths[-1].stem.endswith(digest):
            return digest
        number = 1 + int(paths[-1].name.partition("-")[0]) if paths else 0
        path = self._folder / agent / f"{number:04d}-{digest}.onnx"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            replace_file(path, content)
        except OSError as error:
            raise RunError(f"cannot write {path}: {error.strerror}") from error
        return digest

    def remove(self, agent: str, digest: str) -> None:
        """Forget the last file if it has this digest: the agent refused it."""
        paths = self._paths(agent)
        if paths and paths[-1].stem.endswith(digest):
            paths[-1].unlink(missing_ok=True)

    def _paths(self, agent: str) -> list[Path]:
        found = (self._folder / agent).glob("[0-9]*-*.onnx")
        return sorted(found, key=lambda path: (len(path.name), path.name))
