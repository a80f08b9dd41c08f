"""A broker in the middle of a run against a flood of wrong messages from connections that come and go."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

FUZZER = Path(__file__).with_name("server_fuzzer.py")


def fuzzed(inputs: int, timeout_s: float) -> dict[str, int]:
    """The report of the fuzzer, which ends with 0 only where the run's digest was that of one in peace."""
    result = subprocess.run(
        [sys.executable, FUZZER, "--inputs", str(inputs)],
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )
    assert result.returncode == 0, result.stderr[-4000:] or result.stdout
    report: dict[str, int] = json.loads(result.stdout)
    assert report["digest"] == report["undisturbed"]
    assert report["frames"] >= 20
    # Connections that close take what they had not sent along; a service's own noise comes on top.
    assert report["handled"] > 0.98 * inputs
    assert report["grown_kib"] < 64 << 10
    # A service's noise is reported each time, that of strangers now and then: not for each input.
    assert report["notices"] < 0.05 * inputs
    return report


def test_a_run_is_the_same_beside_ten_thousand_wrong_messages() -> None:
    fuzzed(10_000, 60)


@pytest.mark.exhaustive
def test_a_run_is_the_same_beside_a_million_wrong_messages() -> None:
    fuzzed(1_000_000, 300)
