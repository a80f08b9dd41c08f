"""Clause 4: meshes that a world announces while the run goes on, in virtual time."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
from core_harness import MS, SECOND, Simulation, agent, channel, link, recorder, sensors, world

from caviar_broker.core import events as ev
from caviar_broker.core.plan import Timeouts
from caviar_broker.journal import CheckpointFiles, JournalFile
from caviar_broker.resume import read_resumption
from caviar_protocol import messages as m
from caviar_protocol.digest import geometry_digest

GROUND = m.Asset(name="scenery/ground.ply", digest="0" * 64, size=1)


def mesh(content: str) -> m.Asset:
    digest = hashlib.sha256(content.encode()).hexdigest()
    return m.Asset(name=f"objects/{digest}.ply", digest=digest, size=len(content))


CRATE, BARREL = mesh("crate"), mesh("barrel")
Changes = Mapping[tuple[int, int], m.GeometryChange]


def announcing(changes: Changes) -> Callable[[int, int], Mapping[str, Any]]:
    """What a world reports: a change of its meshes with the answers to some frames."""
    return lambda episode, frame: {"geometry": changes[episode, frame]} if (episode, frame) in changes else {}


def change(frame: int, *assets: m.Asset) -> m.GeometryChange:
    return m.GeometryChange(frame=frame, assets=tuple(sorted(assets, key=lambda asset: asset.name)))


def street(
    changes: Changes, services: Mapping[str, Mapping[str, Any]] | None = None, **plan: Any
) -> Simulation:
    """World, channel, LIDAR, agent, link and recorder; the ray tracers and the recorder load meshes."""
    of = services or {}
    made = [
        world(assets=(GROUND,), loads=0, report=announcing(changes), **of.get("world", {})),
        channel(**{"loads": 20 * MS, **of.get("channel", {})}),
        sensors(**{"loads": 5 * MS, **of.get("lidar", {})}),
        agent(**of.get("agent", {})),
        link(),
        recorder(**{"loads": MS, **of.get("recorder", {})}),
    ]
    return Simulation(made, **{"frames": 8, "record": ("lidar",), **plan}).join()


def test_a_frame_waits_until_every_consumer_holds_the_geometry_that_takes_effect_with_it() -> None:
    run = street({(0, 3): change(3, CRATE)}).run()
    assert run.outcome.error == ""
    for name in ("channel", "lidar", "recorder"):
        (order,) = run.seen(m.Geometry, name)
        assert (order.frame, order.assets) == (3, (CRATE,))
    told = run.time_sent(m.Geometry)
    assert run.time_of("channel", 3) >= told + 20 * MS
    assert told + 5 * MS <= run.time_of("lidar", 3) < told + 20 * MS, "each waits for its own meshes"
    assert run.notices("miss") == [], "a frame that waits for meshes is not charged to its service"


def test_meshes_for_a_later_frame_are_loaded_while_the_frames_before_are_granted() -> None:
    run = street({(0, 2): change(5, CRATE)}).run()
    told = run.time_sent(m.Geometry)
    assert run.time_of("channel", 5) >= told + 20 * MS
    assert run.held["channel"] == [(5, geometry_digest([GROUND, CRATE]))]
    assert not any(run.inputs("link", frame)["channel", "channel"].geometry for frame in range(8))


@pytest.mark.parametrize("policy", ["hold", "drop"])
def test_without_wait_the_old_geometry_is_used_and_the_provenance_says_which(policy: m.Policy) -> None:
    slow = {
        "channel": {"policy": policy, "loads": 250 * MS, "budget": 400 * MS},
        "world": {"latency": 90 * MS},
    }
    run = street({(0, 3): change(3, CRATE)}, slow).run()
    assert run.outcome.error == ""
    used = [run.inputs("link", frame)["channel", "channel"].geometry for frame in range(8)]
    assert used[:3] == ["", "", ""]
    assert used[3] == geometry_digest([GROUND]), "what READY said"
    assert used[7] == "", "it has them by then"


def test_a_consumer_that_cannot_follow_keeps_its_scenery_and_the_provenance_says_so() -> None:
    fixed = {"channel": {"loads": None, "ready": {"geometry": geometry_digest([GROUND])}}}
    run = street({(0, 3): change(3, CRATE)}, fixed).run()
    assert run.outcome.error == ""
    assert run.seen(m.Geometry, "channel") == []
    used = [run.inputs("link", frame)["channel", "channel"].geometry for frame in range(5)]
    assert used == ["", "", "", *[geometry_digest([GROUND])] * 2]


def test_a_world_may_announce_nothing_where_a_consumer_of_scenes_speaks_an_earlier_version() -> None:
    old = {"agent": {"hello": {"version": (1, 5)}}}
    run = street({(0, 3): change(3, CRATE)}, old).run()
    assert run.outcome.error == ""
    assert run.seen(m.Prepare, "world")[0].max_faces == 0
    (warning,) = run.notices("warning", "world")
    assert "agent 'agent' speaks protocol 1.5, which does not know them: protocol 1.6" in warning.text
    (error,) = run.seen(m.Error, "world")
    assert (error.code, error.of) == ("refused-mesh", "DONE")
    assert run.seen(m.Geometry) == []
    assert street({}).run().seen(m.Prepare, "world")[0].max_faces == 2_000_000


@pytest.mark.parametrize(
    ("announced", "refused", "why"),
    [
        (change(3, CRATE), {CRATE.name: "the mesh: has no faces"}, f"{CRATE.name}: the mesh: has no faces"),
        (
            change(3, m.Asset(name="objects/crate.ply", digest="a" * 64, size=1)),
            {},
            f"objects/{'a' * 64}.ply",
        ),
        (change(2, CRATE), {}, "meshes for frame 2 came with frame 3"),
    ],
    ids=["no faces", "another name", "a frame that is over"],
)
def test_what_is_no_mesh_is_refused_by_name_and_the_run_is_intact(
    announced: m.GeometryChange, refused: Mapping[str, str], why: str
) -> None:
    again = change(5 if announced.frame > 2 else 2, *announced.assets)
    run = street({(0, 3): announced, (0, 5): again}, {"world": {"refused": refused}}).run()
    assert run.outcome.error == ""
    first, *more = [error.message for error in run.seen(m.Error, "world")]
    assert why in first
    assert first not in more, "each is told once"
    assert run.seen(m.Geometry) == []
    assert run.outcome.digest == street({}).run().outcome.digest


def test_another_digest_than_the_worlds_ends_the_run_and_names_its_service() -> None:
    run = street({(0, 3): change(3, CRATE)}, {"lidar": {"loads_wrong": True}}).run()
    assert run.outcome.culprit == "lidar"
    assert f"holds geometry {'f' * 12}… for frame 3" in run.outcome.error


def test_a_service_that_loads_meshes_is_what_the_run_waits_for() -> None:
    run = street({(0, 3): change(3, CRATE)}, {"channel": {"loads": 9 * SECOND}})
    run.run(lambda run: bool(run.seen(m.Geometry)))
    run.run_to(run.now + 2 * SECOND)
    waits = {wait.service: wait.text for wait in run.clock.status(run.now).waits}
    told = "channel 'channel' loads meshes that a world announced, for 2 s now, at most 30 s"
    assert told in waits["channel"]


def test_meshes_that_are_never_loaded_are_a_stall_with_blame() -> None:
    run = street({(0, 3): change(3, CRATE)}, {"channel": {"loads": 100 * SECOND}}).run()
    assert run.outcome.culprit == "channel"
    assert "30 s since GEOMETRY" in run.outcome.error


def test_what_was_announced_lasts_until_the_episode_ends() -> None:
    changes = {(0, 1): change(1, CRATE), (0, 4): change(4, BARREL), (1, 2): change(2, CRATE)}
    run = street(changes, episodes=2).run()
    assert run.outcome.error == ""
    sent = [(order.episode, order.frame, order.assets) for order in run.seen(m.Geometry, "lidar")]
    assert sent == [(0, 1, (CRATE,)), (0, 4, (BARREL,)), (1, 2, (CRATE,))]


def test_what_is_said_again_changes_nothing_and_frames_never_descend() -> None:
    both = change(6, CRATE, BARREL)
    changes = {(0, 1): change(1, CRATE), (0, 2): both, (0, 3): change(3, CRATE), (0, 4): change(4, BARREL)}
    run = street(changes).run()
    assert run.outcome.error == ""
    assert [order.frame for order in run.seen(m.Geometry, "lidar")] == [1, 6]
    (error,) = run.seen(m.Error, "world")
    assert "meshes for frame 4 came after those for frame 6" in error.message


def test_meshes_of_two_worlds_are_one_set() -> None:
    one, other = announcing({(0, 1): change(4, CRATE)}), announcing({(0, 2): change(3, BARREL)})
    services = [
        world(loads=0, report=one),
        world("uav", loads=0, report=other),
        channel(loads=MS),
        agent(),
        link(),
    ]
    run = Simulation(services, frames=6).join().run()
    assert run.outcome.error == ""
    both = tuple(sorted((CRATE, BARREL), key=lambda asset: asset.name))
    orders = {order.frame: order.assets for order in run.seen(m.Geometry, "channel")}
    assert orders == {3: (BARREL,), 4: both}


@pytest.mark.parametrize("victim", ["world", "channel", "lidar", "recorder"])
def test_a_service_that_is_killed_in_the_middle_of_a_change_leaves_the_digest_as_it_was(victim: str) -> None:
    changes = {(0, 3): change(3, CRATE), (0, 6): change(6, CRATE, BARREL)}
    whole = street(changes).run()
    assert whole.outcome.error == ""
    rejoin = Timeouts(rejoin=5 * SECOND)
    run = street(changes, timeouts=rejoin)
    run.run(lambda run: bool(run.seen(m.Geometry)))
    run.kill(victim)
    run.join(victim, at=10 * MS).run()
    assert run.outcome.error == ""
    assert run.outcome.digest == whole.outcome.digest
    for name in ("channel", "lidar", "recorder"):
        assert run.held[name][-1] == (6, geometry_digest([GROUND, CRATE, BARREL]))


def test_a_service_that_comes_back_gets_the_meshes_of_its_frame_before_its_state() -> None:
    stateful = {"channel": {"stateful": True}}
    changes = {(0, 1): change(1, CRATE), (0, 5): change(5, BARREL)}
    run = street(changes, stateful, checkpoint_frames=3, timeouts=Timeouts(rejoin=5 * SECOND))
    run.run(lambda run: any(grant.frame == 5 for grant in run.grants("channel")))
    before = len(run.log)
    run.kill("channel")
    run.join("channel", at=MS).run()
    assert run.outcome.error == ""
    assert run.notices("differs") == []
    sent = [a.message for _, a in run.log[before:] if isinstance(a, ev.Send) and a.service == "channel"]
    kinds = [type(message).__name__ for message in sent]
    assert kinds.index("Reset") < kinds.index("Geometry") < kinds.index("Restore") < kinds.index("Grant")
    frames = [message.frame for message in sent if isinstance(message, m.Geometry)]
    assert frames == [3, 5], "those in force where it goes on, and those since"


def test_a_broker_that_resumes_has_the_meshes_of_the_journal(tmp_path: Path) -> None:
    changes = {(0, 2): change(3, CRATE), (0, 5): change(6, CRATE, BARREL)}
    whole = street(changes).run()
    journal = JournalFile(tmp_path / "journal", 1)
    run = street(changes, journal=journal)
    run.run(lambda run: any(grant.frame == 5 for grant in run.grants("link")))
    journal.close()
    state = read_resumption(tmp_path / "journal", CheckpointFiles(tmp_path, durable=False))
    before = state.resumption
    assert before is not None
    assert before.geometry[0] == ("world", changes[0, 2])
    journal = JournalFile(tmp_path / "journal", 2, end=state.end)
    run = street(changes, resumption=before, journal=journal, strict=False, epoch=2).run()
    journal.close()
    assert run.outcome.error == ""
    assert run.outcome.digest == whole.outcome.digest
    assert run.seen(m.Geometry, "channel")[0].assets == (CRATE,)
    assert run.held["channel"][-1] == (6, geometry_digest([GROUND, CRATE, BARREL]))
