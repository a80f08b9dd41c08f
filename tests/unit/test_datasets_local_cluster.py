"""How processes that play episodes are ended, and how it is said that they ended."""

from __future__ import annotations

import asyncio
import signal
import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import pytest

from caviar_clients.datasets import local_cluster
from caviar_clients.datasets.local_cluster import exit_of, exit_text, noting_nanny


@pytest.mark.parametrize("at_once", [True, False])
def test_a_command_that_is_interrupted_waits_for_no_step(
    at_once: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Dask itself asks a process to end, waits for four seconds, and kills it then."""
    asked = list[dict[str, Any]]()

    async def ask(**named: Any) -> None:
        asked.append(named)

    monkeypatch.setattr(noting_nanny(), "at_once", at_once)
    with subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"]) as process:
        nanny = noting_nanny().__new__(noting_nanny())
        nanny.process = SimpleNamespace(pid=process.pid, kill=ask)
        asyncio.run(nanny.kill(timeout=1.0, reason="test"))
        if not at_once:
            assert process.poll() is None
            process.kill()
        assert process.wait(60.0) == -signal.SIGKILL
    assert asked == [{"timeout": 1.0, "reason": "test"}]


def test_an_exit_is_said_with_status_or_signal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local_cluster, "exit_codes", {"tcp://a": 3, "tcp://b": -11, "tcp://c": -40})
    assert exit_of("tcp://a", wait_s=0.0) == "it exited with status 3 (no signal), as os._exit(3) does"
    assert exit_of("tcp://b", wait_s=0.0) == "signal SIGSEGV ended it, a fault in compiled code"
    assert exit_of("tcp://c", wait_s=0.0) == "signal 40 ended it"
    assert exit_of("tcp://d", wait_s=0.0) == "how is in the log of the worker tcp://d"
    assert "lacks" in exit_text(-signal.SIGKILL)
