"""Files of trained policies on their way to the agents that serve them (`caviar_protocol.policies`)."""

from __future__ import annotations

import fcntl
import hashlib
import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from caviar_broker.control.socket import RequestRefusedError, ask
from caviar_protocol.assets import AssetStore
from caviar_protocol.errors import AssetError, RunError, ScenarioError
from caviar_protocol.policies import FILE, SHA256, USE, PolicyFolder
from caviar_protocol.run_directory import RunDirectory
from caviar_protocol.scenario import Scenario

POLL_S = 0.05
"""[s] between two questions for what came of a policy."""


def given_policies(
    scenario: Scenario, store: AssetStore, directory: Path | None
) -> dict[str, tuple[str, ...]]:
    """The policies that the agents of a run are given at its start, put into the store.

    Args:
        scenario: With absolute paths, as it is loaded.
        store: That of the broker.
        directory: Of the run, which keeps the files; None: nothing is kept.

    Returns:
        SHA-256 of the files of each agent, by its name: that of the scenario, then those that a user gave it
        in this run, before its broker was started again, or in the run that is replayed.

    Raises:
        ScenarioError: A file is not the one of ``sha256`` in the settings.
        RunError: A file is too large, cannot be kept, or was changed since a run kept it.
        AssetError: A file cannot be stored.
    """
    kept = PolicyFolder(directory) if directory is not None else None
    found: dict[str, tuple[str, ...]] = {}
    for agent, spec in scenario.services.items():
        if spec.role != "agent" or spec.use != USE:
            continue
        contents: list[bytes] = []
        goes_on = kept is not None and bool(kept.digests(agent))
        if scenario.replay is not None and agent in scenario.replay.imposed:
            recorded = PolicyFolder(Path(scenario.replay.recording))
            contents = _contents(recorded, agent)
        if kept is not None and goes_on:
            contents = _contents(kept, agent)
        path = Path(str(spec.settings.get(FILE, "")).removeprefix("file:"))
        if not contents and path.is_file():
            contents = [path.read_bytes()]
        digests = []
        for content in contents:
            digests.append(store.add(f"policies/{agent}.onnx", content).digest)
            if kept is not None and not goes_on:
                kept.add(agent, content)
        pinned = spec.settings.get(SHA256)
        if pinned and digests and digests[0] != pinned:
            raise ScenarioError(
                f"{pinned!r} is not the SHA-256 of {path}, which is {digests[0]}; write that one, or put "
                "the other file there",
                key=f"services.{agent}.settings.{SHA256}",
            )
        # Without a file here, the agent's own machine is to have it.
        if digests:
            found[agent] = tuple(digests)
    return found


def _contents(folder: PolicyFolder, agent: str) -> list[bytes]:
    files = folder.files(agent)
    found = []
    for digest in folder.digests(agent):
        content = files[digest].read_bytes()
        if hashlib.sha256(content).hexdigest() != digest:
            raise RunError(
                f"{files[digest]} was changed since the run kept it: its SHA-256 is not the one in its name; "
                "put the policy of that SHA-256 there"
            )
        found.append(content)
    return found


def offer_policy(directory: Path, agent: str, content: bytes) -> tuple[str, str]:
    """Give an agent of a running run another policy.

    Args:
        directory: Of the run, on the machine of its broker.
        agent: Name of the agent; empty: the only one that serves policies.
        content: The ONNX file.

    Returns:
        Name of the agent, and SHA-256 of the file.

    Raises:
        RequestRefusedError: The broker refuses it; the text says why.
        RunError: No broker runs there, or the file cannot be kept.
    """
    known = ask(directory, do="policies")
    agents = known["policies"]
    if not agents:
        raise RequestRefusedError(directory, 'no agent of the run serves policies (use = "policy")')
    if not agent and len(agents) == 1:
        (agent,) = agents
    if agent not in agents:
        which = f"no agent {agent!r} serves policies" if agent else "several agents serve policies"
        raise RequestRefusedError(directory, f"{which}; name one of {', '.join(agents)}")
    folder = PolicyFolder(directory)
    with _alone(directory):
        before = folder.digests(agent)
        new = folder.add(agent, content)
        try:
            # Hashed and stored here, and not between the frames of the broker.
            _store(Path(known["store"]), agent, content)
            ask(directory, do="swap", agent=agent, sha256=new)
        except RunError:
            # A file that was there already may have decided frames.
            if folder.digests(agent) != before:
                folder.remove(agent, new)
            raise
    return agent, new


def _store(folder: Path, agent: str, content: bytes) -> None:
    """Put a policy where the broker's peers fetch files from."""
    try:
        AssetStore(folder).add(f"policies/{agent}.onnx", content)
    except AssetError as error:
        raise RunError(str(error)) from error


@contextmanager
def _alone(directory: Path) -> Iterator[None]:
    """Have one policy at a time kept and announced: the last file is the one that was announced last.

    A broker that resumes the run goes by the files. A file system without locks locks nothing.
    """
    folder = RunDirectory(directory).policies
    fd = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
    try:
        with suppress(OSError):
            fcntl.flock(fd, fcntl.LOCK_EX)
        yield
    finally:
        os.close(fd)


def policy_outcome(directory: Path, agent: str, digest: str) -> Mapping[str, Any]:
    """Outcome of a policy that was offered.

    Args:
        directory: Of the run.
        agent: To which it was offered.
        digest: SHA-256 of its file.

    Returns:
        ``state``: ``offered``, ``serving`` or ``refused``; ``frame`` from which it serves, or −1; ``reason``.

    Raises:
        RunError: No broker runs there.
    """
    found = ask(directory, do="policies")["policies"][agent]
    if digest in found["refused"]:
        PolicyFolder(directory).remove(agent, digest)
        return {"state": "refused", "frame": -1, "reason": found["refused"][digest]}
    if found["serving"] == digest:
        return {"state": "serving", "frame": found["since"], "reason": ""}
    return {"state": "offered", "frame": -1, "reason": ""}


def awaited_outcome(directory: Path, agent: str, digest: str, wait_s: float) -> Mapping[str, Any]:
    """Wait until a policy that was offered is taken or refused.

    Args:
        directory: Of the run.
        agent: To which it was offered.
        digest: SHA-256 of its file.
        wait_s: How long to wait [s].

    Returns:
        As `policy_outcome`; the ``state`` is ``offered`` where it is neither by then.

    Raises:
        RunError: The broker has ended.
    """
    until = time.monotonic() + wait_s
    while True:
        found = policy_outcome(directory, agent, digest)
        if found["state"] != "offered" or time.monotonic() >= until:
            return found
        time.sleep(POLL_S)
