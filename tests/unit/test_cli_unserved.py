"""What a summary says about agents that served no user."""

from __future__ import annotations

from caviar_clients.cli.summary import ReportTally
from caviar_protocol.messages import Report


def report(source: str, count: int = 1) -> Report:
    return Report(source=source, counts={"frames-without-users": count})


def test_only_an_agent_without_users_in_every_frame_is_warned_of() -> None:
    unserved = ReportTally()
    unserved.add(0, [report("pilot"), report("tower"), Report(source="link", counts={"no-path/x": 1})])
    unserved.add(0, [report("tower"), report("link", 0)])
    assert [line.partition(" ")[0] for line in unserved.warnings()] == ["tower"]


def test_a_recording_without_frames_warns_of_nobody() -> None:
    assert ReportTally().warnings() == []


def test_what_was_of_no_use_in_any_frame_is_named() -> None:
    """A device without an object; not one that had one in one frame."""
    unserved = ReportTally()
    unserved.add(
        0,
        [
            Report(source="world", counts={"device-without-object/rx": 1, "device-without-object/late": 1}),
        ],
    )
    unserved.add(
        0,
        [
            Report(source="world", counts={"device-without-object/rx": 1}),
        ],
    )
    assert unserved.warnings() == [
        "device 'rx' stood on no object of world in any frame; see its `on`",
    ]
