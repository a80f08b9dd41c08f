"""Programs of the C++ client for tests: compiled once, and kept as long as their sources stay the same.

They stand in pytest's cache under the digest of their sources.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from scenarios_support import ROOT

CPP = ROOT / "clients" / "cpp"
WORLD = CPP / "world.cpp"
PROBE = Path(__file__).with_name("cpp_probe.cpp")
STRICT = ("-std=c++17", "-fno-exceptions", "-fno-rtti", "-Wall", "-Wextra", "-Werror", "-Wpedantic")
"""How a game engine compiles: without exceptions, RTTI, or a warning."""


def compiled(compiler: str, source: Path, folder: Path, *flags: str) -> Path:
    """A program of a source; skips by name where the compiler or ZeroMQ's header is missing."""
    if shutil.which(compiler) is None:
        pytest.skip(f"{compiler} is not installed")
    version = subprocess.run([compiler, "--version"], capture_output=True, text=True, check=True).stdout
    _require_zeromq(compiler)
    texts = [
        source.read_bytes(),
        (CPP / "caviar.hpp").read_bytes(),
        " ".join(flags).encode(),
        version.encode(),
    ]
    program = folder / f"{source.stem}-{compiler}-{hashlib.sha256(bytes(0).join(texts)).hexdigest()[:16]}"
    # Two workers may want it at the same time, and a program that is half written cannot be started.
    with program.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not program.exists():
            _compile([compiler, *flags, f"-I{CPP}", str(source)], program)
    return program


def _require_zeromq(compiler: str) -> None:
    command = [compiler, "-E", "-x", "c++", "-"]
    done = subprocess.run(command, input="#include <zmq.h>", capture_output=True, text=True, check=False)
    if done.returncode != 0:
        pytest.skip("zmq.h is not installed (Debian: libzmq3-dev)")


def _compile(command: list[str], program: Path) -> None:
    draft = program.with_suffix(".new")
    command = [*command, "-o", str(draft), "-lzmq", "-pthread"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    draft.rename(program)


class Probe:
    """The program that answers questions about the header.

    Args:
        program: Of ``cpp_probe.cpp``, which says what may be asked.
    """

    def __init__(self, program: Path) -> None:
        self.program = program
        self._process = subprocess.Popen([program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def __call__(self, *words: object) -> Any:
        """Ask a question; bytes are written as hexadecimal digits."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        shown = [f"x{word.hex()}" if isinstance(word, bytes) else str(word) for word in words]
        self._process.stdin.write(" ".join(shown) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())

    def close(self) -> None:
        """Let it end."""
        self._process.communicate()


def program_folder(config: pytest.Config, factory: pytest.TempPathFactory) -> Path:
    """Where programs are kept between sessions."""
    return factory.mktemp("cpp") if config.cache is None else config.cache.mkdir("cpp-client")
