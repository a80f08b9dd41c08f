"""Any process wronged in any way: no hang, the culprit is named, nothing is lost (clauses 9 to 18)."""

from __future__ import annotations

import re
import signal
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from fault_matrix import (
    FAULT_FRAME,
    FAULTS,
    HANG_S,
    LENIENT_FRAMES,
    POLICIES,
    WORDS,
    Nursery,
    assert_blamed,
    assert_same,
    assert_went_on,
    scenario,
    told,
)
from fault_nursery import Case, Result

SERVICES = tuple(POLICIES)
LENIENT = [
    (service, policy) for service in SERVICES for policy in POLICIES[service] if policy in ("hold", "drop")
]
PASSING = [fault for fault in FAULTS if fault != "garbage"]
"""Faults that a run can outlive."""


def grid(rows: Sequence[tuple[Any, ...]], columns: Sequence[str]) -> list[Any]:
    """Every row with every column, of which ``make test`` takes one column a row, and all columns in turn."""
    return [
        pytest.param(*row, column, marks=[] if (i - j) % len(columns) == 0 else pytest.mark.exhaustive)
        for i, row in enumerate(rows)
        for j, column in enumerate(columns)
    ]


@pytest.fixture(scope="module")
def nursery() -> Iterator[Nursery]:
    """One for all cases."""
    found = Nursery.start()
    yield found
    found.close()


@pytest.fixture(scope="module")
def digest(nursery: Nursery, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Of the undisturbed run."""
    folder = tmp_path_factory.mktemp("undisturbed")
    result = nursery.run(Case(scenario=str(scenario(folder)), directory=str(folder / "run"), limit_s=HANG_S))
    assert result.error == ""
    return result.digest


def wronged(nursery: Nursery, path: Path, victim: str, fault: str, **more: object) -> tuple[Result, Path]:
    """A run in which one process is wronged, once."""
    directory = path.parent / "run"
    case = Case(
        scenario=str(path),
        directory=str(directory),
        victim=victim,
        fault=fault,
        frame=FAULT_FRAME,
        limit_s=HANG_S,
        **more,  # type: ignore[arg-type]
    )
    return nursery.run(case), directory


def assert_named(result: Result, victim: str, fault: str) -> None:
    """The run says who was lost, and why; of a stopped one at once."""
    (text,) = told(result, "lost", victim)
    assert repr(victim) in text
    assert re.search(r"in frame \d+: .* since its grant", text)
    assert WORDS[fault] in text
    assert len(told(result, "back", victim)) == 1
    assert told(result, "restarted") == []  # the broker outlived it


@pytest.mark.parametrize(("victim", "fault"), grid([(service,) for service in SERVICES], PASSING))
def test_under_wait_the_run_ends_as_if_nothing_had_happened(
    nursery: Nursery, digest: str, tmp_path: Path, victim: str, fault: str
) -> None:
    result, directory = wronged(nursery, scenario(tmp_path), victim, fault)
    assert_same(result, directory, digest)
    assert_named(result, victim, fault)


@pytest.mark.parametrize(("victim", "policy", "fault"), grid(LENIENT, PASSING))
def test_under_hold_and_drop_the_frames_go_on_and_say_what_they_lack(
    nursery: Nursery, tmp_path: Path, victim: str, policy: str, fault: str
) -> None:
    path = scenario(tmp_path, victim, policy, budget_ms=12.0, frames=LENIENT_FRAMES)
    result, directory = wronged(nursery, path, victim, fault)
    assert_went_on(result, directory, victim, policy)
    assert_named(result, victim, fault)


@pytest.mark.parametrize(("victim", "fault"), grid([(service,) for service in SERVICES], PASSING))
def test_under_abort_the_run_ends_with_blame(
    nursery: Nursery, tmp_path: Path, victim: str, fault: str
) -> None:
    path = scenario(tmp_path, victim, "abort", rejoin_s=0.0, budget_ms=1000.0)
    result, directory = wronged(nursery, path, victim, fault)
    assert_blamed(result, directory, victim, (WORDS[fault], f"frame {FAULT_FRAME}"))


@pytest.mark.parametrize(
    ("victim", "policy"),
    [
        pytest.param(service, policy, marks=[] if policy == "wait" else pytest.mark.exhaustive)
        for service in SERVICES
        for policy in POLICIES[service]
    ],
)
def test_garbage_ends_the_run_with_blame_whatever_the_policy(
    nursery: Nursery, tmp_path: Path, victim: str, policy: str
) -> None:
    """What a service that does not speak the protocol said before cannot be relied upon."""
    path = scenario(tmp_path, victim, policy, budget_ms=1000.0)
    result, directory = wronged(nursery, path, victim, "garbage")
    assert_blamed(result, directory, victim, (WORDS["garbage"],))


@pytest.mark.parametrize(("policy", "fault"), grid([("wait",), ("hold",), ("drop",)], PASSING))
def test_a_run_that_waits_for_nobody_ends_with_blame(
    nursery: Nursery, tmp_path: Path, policy: str, fault: str
) -> None:
    """Under ``hold`` and ``drop`` too: a service that is gone for good makes no frame any more."""
    path = scenario(tmp_path, "channel", policy, rejoin_s=0.0, budget_ms=1000.0)
    result, directory = wronged(nursery, path, "channel", fault)
    assert_blamed(result, directory, "channel", (WORDS[fault], f"frame {FAULT_FRAME}"))


@pytest.mark.parametrize("fault", FAULTS)
def test_a_broker_that_is_wronged_goes_on_or_is_followed_by_another(
    nursery: Nursery, digest: str, tmp_path: Path, fault: str
) -> None:
    result, directory = wronged(nursery, scenario(tmp_path), "broker", fault)
    assert_same(result, directory, digest)
    if fault in ("kill", "stop"):
        (text,) = told(result, "restarted")
        assert "the broker died" in text
        assert WORDS[fault] in text
    elif fault == "disconnect":
        assert sorted(n["service"] for n in result.notices if n["kind"] == "back") == sorted(SERVICES)
    else:
        words = {"garbage": "not in the protocol", "flood": "a connection from 127.0.0.1 was cut off"}
        assert any(words[fault] in text for text in told(result, "refused"))


@pytest.mark.parametrize("fault", ["kill", "stop"])
def test_without_rejoining_a_broker_that_dies_is_named(nursery: Nursery, tmp_path: Path, fault: str) -> None:
    result, directory = wronged(nursery, scenario(tmp_path, rejoin_s=0.0), "broker", fault)
    assert "the broker died" in result.error
    assert WORDS[fault] in result.error
    assert result.leftovers == []
    assert directory.is_dir()


@pytest.mark.parametrize("fault", ["kill", "stop", "disconnect"])
def test_a_remote_service_that_is_gone_is_named_and_may_come_back(
    nursery: Nursery, digest: str, tmp_path: Path, fault: str
) -> None:
    """No operating system tells of it. One that was killed is started again; others come back themselves."""
    path = scenario(tmp_path, "link", "wait", remote=True)
    result, directory = wronged(nursery, path, "link", fault, remote="link:beams")
    assert_same(result, directory, digest)
    assert "unreachable or stopped" in told(result, "lost", "link")[0]
    assert result.remotes == ([-signal.SIGKILL, 0] if fault == "kill" else [0])
