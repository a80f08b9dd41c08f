"""What a run lacks is said in one message: open files, and time before it has begun."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

INTERRUPTED_WHILE_LOADING = """
import os, signal, sys
import caviar_clients.__main__ as command

class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == "typer":
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupting())
sys.argv = ["caviar", "run", "smoke"]
command.main()
"""


def test_too_few_open_files_are_refused_with_the_limit_and_the_remedy(tmp_path: Path) -> None:
    command = f"ulimit -n 30 && exec {sys.executable} -m caviar_clients run smoke --frames 2 --out {tmp_path}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=120)
    assert done.returncode == 1
    assert "may have 30 files open, and a run of 5 services needs 60" in done.stdout + done.stderr
    assert "ulimit -n" in done.stdout + done.stderr
    assert "Traceback" not in done.stdout + done.stderr


def test_a_low_limit_that_may_be_raised_is_raised(tmp_path: Path) -> None:
    command = (
        f"ulimit -Sn 30 && exec {sys.executable} -m caviar_clients run smoke --frames 2 --out {tmp_path}"
    )
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr


def test_ctrl_c_while_the_command_is_loaded_ends_it_without_a_traceback() -> None:
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED_WHILE_LOADING], capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")
