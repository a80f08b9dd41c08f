"""What a summary says about users without a path."""

from __future__ import annotations

from pathlib import Path

from recording_builders import frame, frame_of, link, record, scene

from caviar_clients.cli.summary import SHOWN_ALIKE, ReportTally, summarise
from caviar_clients.cli.summary_table import SHOWN_INSIDE, outage_lines
from caviar_protocol.messages import Report
from caviar_protocol.recording import Recording


def channel(**counts: int) -> Report:
    named = {name.replace("__", "/").replace("_", "-"): count for name, count in counts.items()}
    return Report(source="channel", counts=named)


def test_causes_are_summed_over_frames_and_the_most_frequent_stands_first() -> None:
    outages = ReportTally()
    outages.add(0, [channel(no_path__blocked=1, too_close=7), Report(source="link", counts={"x": 9})])
    outages.add(0, [channel(no_path__blocked=1, no_path__out_of_range=3)])
    found = outages.outage(users=5)
    assert found is not None
    assert list(found.causes.items()) == [("out of range", 3), ("blocked", 2)]
    assert found.unexplained == 0
    assert outage_lines(found) == ["3 out of range, 2 blocked"]


def test_users_whose_channel_gave_no_cause_are_said_to_have_none() -> None:
    outages = ReportTally()
    outages.add(0, [channel(no_path__blocked=2)])
    found = outages.outage(users=6)
    assert found is not None
    assert outage_lines(found) == ["2 blocked, 4 for a cause that the channel did not report"]


def test_what_stands_inside_of_what_is_named_and_the_list_is_bounded() -> None:
    outages = ReportTally()
    names = [f"inside/car-{number}/rx in car-{number}" for number in range(SHOWN_INSIDE + 3)]
    for _ in range(2):
        outages.add(0, [Report(source="channel", counts=dict.fromkeys(names, 1))])
    found = outages.outage(users=9)
    assert found is not None
    lines = outage_lines(found)
    assert lines[1] == "inside an object: car-0/rx in car-0, in 2 frames"
    assert lines[-1] == "inside an object: 3 more antennas"


def test_paths_that_were_dropped_are_warned_of() -> None:
    dropped = ReportTally()
    for count in (0, 3, 4):
        dropped.add(0, [channel(dropped=count), Report(source="link", counts={"x": 9})])
    (warning,) = dropped.warnings()
    assert warning.startswith("channel dropped 7 paths with values that are not finite, in 2 frames: ")
    assert ReportTally().warnings() == []


def test_exits_and_commands_outside_of_a_geofence_and_refused_meshes_are_warned_of() -> None:
    seen = ReportTally()
    counts = {"left-geofence/uav": 1, "commanded-outside-geofence/uav": 1}
    for number in (7, 8):
        seen.add(2, [Report(source="world", counts=counts)], number)
    seen.add(2, [Report(source="world", counts={"mesh-refused/crate": 1})], 9)
    commanded, *others = seen.warnings()
    assert commanded.endswith(
        " outside of its geofence in 2 frames, first in frame 7 of episode 2, and kept within"
    )
    assert others == [
        "'uav' of world left its geofence 2 times, first in frame 7 of episode 2",
        "mesh 'crate' of world was refused in frame 9 of episode 2; its objects were boxes",
    ]


def test_an_snr_that_no_receiver_has_is_warned_of_once_with_its_keys() -> None:
    seen = ReportTally()
    for number in (4, 5):
        seen.add(1, [Report(source="radio", counts={"snr-above-60-db": 3})], number)
    (warning,) = seen.warnings()
    assert "in 2 frames, first in frame 4 of episode 1" in warning
    for key in ("power_dbm", "bandwidth_hz", "services.radio.settings.noise_figure_db", "normalization"):
        assert key in warning


def test_warnings_that_differ_in_a_name_alone_are_a_few() -> None:
    seen = ReportTally()
    seen.add(0, [Report(source="world", counts={f"mesh-refused/{n:02}": 1 for n in range(SHOWN_ALIKE + 3)})])
    warnings = seen.warnings()
    assert len(warnings) == SHOWN_ALIKE + 1
    assert warnings[-1] == "world: 3 more counts of 'mesh-refused'"


def test_people_who_are_shown_elsewhere_at_once_are_warned_of() -> None:
    """Jumps that a body walked are counted in the reports, and need no warning."""
    moved = ReportTally()
    for count in (0, 1, 2):
        counts = {"person-jumps": 5, "persons-put-elsewhere": count}
        moved.add(0, [Report(source="traffic", counts=counts)])
    (warning,) = moved.warnings()
    assert warning.startswith("traffic shows people elsewhere at once 3 times: SUMO put them farther away")


def test_a_key_that_is_for_nothing_in_any_frame_is_warned_of() -> None:
    unmatched = ReportTally()
    names = [{"unmatched/object_materials.sing": 1, "unmatched/object_materials.bus": 1},
             {"unmatched/object_materials.sing": 1}]  # fmt: skip
    for counts in names:
        unmatched.add(0, [Report(source="channel", counts=counts), Report(source="link")])
    (warning,) = unmatched.warnings()
    assert warning.startswith("channel: object_materials.sing had no effect: no object, class or piece")


def test_a_recording_warns_of_paths_that_were_dropped(tmp_path: Path) -> None:
    record(tmp_path, [frame(0, reports=(channel(dropped=2, no_path__not_finite=1),))])
    summary = summarise(Recording(tmp_path))
    assert [warning.partition(" with")[0] for warning in summary.warnings] == ["channel dropped 2 paths"]


def test_where_all_users_had_a_path_nothing_is_said() -> None:
    assert ReportTally().outage(users=0) is None


def test_a_recording_tells_snr_rate_and_users_without_a_path(tmp_path: Path) -> None:
    links = [link(number, without_path=(2,)) for number in range(2)]
    record(tmp_path, [frame_of(number, scene=scene(number), link=one) for number, one in enumerate(links)])
    rates = [rate for one in links for rate in one.bit_rate[one.has_path].tolist()]
    summary = summarise(Recording(tmp_path))
    assert summary.link is not None
    assert summary.outage is not None
    assert summary.link.mean_bit_rate == sum(rates) / len(rates)
    assert (summary.outage.users, summary.outage.unexplained) == (2, 2)
