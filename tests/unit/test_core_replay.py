"""What a replayed service had not in time is so again (contract, clause 6)."""

from __future__ import annotations

from core_harness import MS, Simulation, agent, recorder, sensors, world

from caviar_broker.core import events as ev
from caviar_protocol import messages as m
from caviar_protocol.messages import GrantInput, Status


def played(recorded: dict[tuple[str, int, int], tuple[GrantInput, ...]]) -> Simulation:
    takes = (m.Input(topic="lidar", required=False), m.Input(topic="scene"))
    services = [world(), sensors(), agent(inputs=takes), recorder()]
    return Simulation(services, frames=6, recorded=recorded, strict=False).join().run()


def entry(status: Status, **fields: object) -> GrantInput:
    return GrantInput(topic="lidar", source="lidar", status=status, **fields)  # type: ignore[arg-type]


def test_held_products_keep_frame_time_and_cause() -> None:
    held = entry(Status.HELD, frame=2, t_ns=200 * MS, age=2, cause="lidar missed frame 4")
    run = played({("lidar", 0, 4): (held,)})
    assert not run.outcome.error
    got = run.inputs("agent", 4)["lidar", "lidar"]
    assert (got.status, got.frame, got.t_ns, got.age) == (Status.HELD, 2, 200 * MS, 2)
    assert got.cause == "lidar missed frame 4"
    assert run.inputs("recorder", 4)["lidar", "lidar"] == got
    assert run.inputs("agent", 5)["lidar", "lidar"].status is Status.FRESH


def test_absent_products_keep_their_cause() -> None:
    absent = entry(Status.ABSENT, cause="lidar failed in frame 1: dust")
    run = played({("lidar", 0, 1): (absent,)})
    assert run.inputs("agent", 1)["lidar", "lidar"] == absent


def test_they_are_not_in_the_digest_and_stand_in_the_journal() -> None:
    """As in the recorded run, where only fresh products made the digest."""
    whole, with_held = played({}), played({("lidar", 0, 4): (entry(Status.HELD, frame=3, cause="late"),)})
    assert whole.outcome.digest != with_held.outcome.digest
    (journal,) = [a for a in with_held.seen(ev.Journal, "lidar") if a.frame == 4]
    assert [d.status for d in journal.decisions] == [Status.HELD]
