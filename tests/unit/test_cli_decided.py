"""What a summary says about decisions."""

from __future__ import annotations

from caviar_clients.cli.summary import ReportTally
from caviar_clients.cli.summary_table import decided_lines
from caviar_protocol.messages import Report


def report(rung: str, **counts: int) -> Report:
    told = {name.replace("_", "-"): count for name, count in counts.items()}
    return Report(source="channel", decisions={"rung": rung}, counts=told)


def test_shares_changes_and_coverage_are_counted() -> None:
    decisions = ReportTally()
    for rung in ("low", "low", "high", "low"):
        decisions.add(0, [report(rung), Report(source="link", counts={"error-checks": 9})])
    decisions.add(0, [report("low", error_checks=1, error_covered=1)])
    decisions.add(0, [report("low", error_checks=1, error_covered=0)])
    (found,) = decisions.decisions()
    assert found.frames == {"low": 5, "high": 1}
    assert (found.changes, found.error_checks, found.error_covered) == (2, 2, 1)
    assert decided_lines([found]) == [
        "channel: rung low 83%, high 17%; 2 changes; stated error held in 1 of 2 checks"
    ]


def test_what_was_known_when_an_episode_began_is_no_choice() -> None:
    decisions = ReportTally()
    decisions.add(1, [Report(source="channel", decisions={"rung": "low", "state:errors": "{}"})])
    assert decided_lines(decisions.decisions()) == ["channel: rung low 100%; 0 changes"]


def test_a_new_episode_is_no_change() -> None:
    decisions = ReportTally()
    decisions.add(0, [report("low")])
    decisions.add(1, [report("high")])
    assert decisions.decisions()[0].changes == 0


def test_without_decisions_nothing_is_said() -> None:
    decisions = ReportTally()
    decisions.add(0, [Report(source="link", measured={"step": 3})])
    assert decided_lines(decisions.decisions()) == []
