"""How services get into a run, and who is turned away (contract, clauses 1, 3, 4 and 5)."""

from __future__ import annotations

import pytest
from core_harness import MS, SECOND, Sim, Simulation, agent, channel, link, loop, recorder, sensors, world

from caviar_broker.core import events as ev
from caviar_broker.core.plan import Feature, PatternFile, Timeouts, plan_run
from caviar_broker.core.transitions import RunState
from caviar_protocol import messages as m
from caviar_protocol.digest import geometry_digest
from caviar_protocol.scenario import parse_scenario


def refusals(run: Simulation) -> list[m.Refuse]:
    return [a.refusal for a in run.seen(ev.TurnAway)]


def asset(name: str, content: str = "a") -> m.Asset:
    return m.Asset(name=name, digest=content * 64, size=1)


def test_worlds_prepare_first_and_all_others_with_their_scenery() -> None:
    mesh = asset("scenery/meshes/wall.ply")
    run = Simulation([world(assets=(mesh,)), channel(), agent(), link(), recorder()]).join().run()
    order = [a.service for _, a in run.log if isinstance(a, ev.Send) and isinstance(a.message, m.Prepare)]
    assert order[0] == "world"
    assert set(order[1:]) == {"channel", "agent", "link", "recorder"}
    assert run.seen(m.Prepare, "world")[0].assets == ()
    assert run.seen(m.Prepare, "channel")[0].assets == (mesh,)
    assert run.outcome.error == ""


def test_prepare_tells_demand_and_producers() -> None:
    run = Simulation(loop()).join().run()
    prepare = run.seen(m.Prepare, "channel")[0]
    assert [d.topic for d in prepare.demand] == ["channel"]
    assert prepare.producers["scene"] == ("world",)


def test_welcome_tells_identity_settings_and_the_capabilities_that_both_have() -> None:
    run = Simulation([world(hello={"capabilities": ("episodes", "telepathy")}), agent()], seed=7)
    run.hello("world")
    welcome = run.seen(m.Welcome, "world")[0]
    assert (welcome.epoch, welcome.attempt, welcome.seed) == (1, 1, 7)
    assert welcome.capabilities == ("episodes",)


def test_clause_1_another_service_under_a_taken_name_is_refused_and_does_no_harm() -> None:
    run = Simulation(loop()).join()
    run.after(4 * MS, lambda: run.hello("world"))
    run.run()
    assert [r.code for r in refusals(run)] == ["name-taken"]
    assert run.outcome.error == ""


def test_an_unknown_name_is_refused_with_the_one_that_was_probably_meant() -> None:
    run = Simulation(loop())
    run.feed(ev.Joined(m.Hello(version=m.PROTOCOL_VERSION, name="chanel", role="channel")))
    assert refusals(run)[0].code == "unknown-name"
    assert "did you mean 'channel'?" in refusals(run)[0].message
    assert run.join().run().outcome.error == ""


def test_another_major_version_is_refused_naming_both_and_ends_the_run() -> None:
    run = Simulation(loop(channel={"hello": {"version": (99, 3)}})).join().run()
    assert refusals(run)[0].code == "version"
    assert run.outcome.culprit == "channel"
    assert "99.3" in run.outcome.error
    assert ".".join(map(str, m.PROTOCOL_VERSION)) in run.outcome.error


def test_an_unknown_minor_version_is_accepted() -> None:
    major, _ = m.PROTOCOL_VERSION
    run = Simulation(loop(channel={"hello": {"version": (major, 99)}})).join().run()
    assert run.outcome.error == ""


@pytest.mark.parametrize("role", ["world", "channel", "link", "agent"])
def test_a_service_that_cannot_know_what_the_scenario_has_is_refused_with_its_version_and_the_key(
    role: str,
) -> None:
    feature = Feature("devices[0].array.panels", "panels (2 of them) of device 'bs'", (1, 4))
    run = Simulation(loop(**{role: {"hello": {"version": (1, 3)}, "features": (feature,)}})).join().run()
    assert refusals(run)[0].code == "version"
    assert run.outcome.culprit == role
    assert (
        f"devices[0].array.panels: {role} '{role}' speaks protocol 1.3, which does not" in run.outcome.error
    )
    assert "panels (2 of them) of device 'bs': protocol 1.4 brought it; update" in run.outcome.error
    assert not run.seen(m.Grant)
    later = Simulation(loop(**{role: {"hello": {"version": (1, 4)}, "features": (feature,)}})).join().run()
    assert later.outcome.error == ""


@pytest.mark.parametrize(
    ("array", "key"),
    [
        ('polarization = "cross"', "polarization ('cross')"),
        ('polarization = "+45"', "polarization ('+45')"),
        ("panels = [{}, {yaw_deg = 180}]", "panels (2 of them)"),
    ],
)
def test_what_the_devices_of_a_scenario_need_their_readers_to_know(array: str, key: str) -> None:
    services = "".join(
        f'[services.{name}]\nrole = "{role}"\nuse = "remote"\nbudget_ms = 9\n'
        for name, role in {"a": "world", "b": "world", "c": "channel"}.items()
    )
    text = (
        f'{services}[run]\nname = "old"\nframes = 1\n'
        '[[devices]]\nname = "bs"\nworld = "a"\nkind = "antenna"\nrole = "tx"\narray = { columns = 4 }\n'
        f'[[devices]]\nname = "rx"\nworld = "b"\nkind = "antenna"\nrole = "rx"\narray = {{ {array} }}\n'
        '[[carriers]]\nname = "mmwave"\nfrequency_hz = 28e9\nsubcarriers = 4\nsubcarrier_spacing_hz = 1e5\n'
    )
    plan = plan_run(parse_scenario(text), "run", {})
    features = {service.name: service.features for service in plan.services}
    needed = Feature(f"devices[1].array.{array.split()[0]}", f"{key} of device 'rx'", (1, 4))
    assert features == {"a": (), "b": (needed,), "c": (needed,)}


def test_a_part_is_not_asked_of_a_service_of_a_version_without_it() -> None:
    hears = (m.Input(topic="channel", parts=("h", "hf")),)
    old = {"hello": {"version": (1, 3)}}
    run = Simulation(loop(channel=old, link={"inputs": hears})).join().run()
    assert run.outcome.error.startswith(
        "channel 'channel' speaks protocol 1.3, which has no part 'hf' of topic 'channel': protocol 1.4"
    )
    assert "have link 'link' do without" in run.outcome.error
    recorded = Simulation([*loop(channel=old), recorder()], record=("channel.taps",)).join().run()
    assert "no part 'taps'" in recorded.outcome.error
    assert "have run.record do without" in recorded.outcome.error
    assert Simulation(loop(channel=old)).join().run().outcome.error == ""


def test_a_part_that_no_topic_has_is_refused_with_the_one_that_was_probably_meant() -> None:
    hears = (m.Input(topic="channel", parts=("hff",)),)
    run = Simulation(loop(link={"inputs": hears})).join().run()
    assert refusals(run)[0].code == "declaration"
    assert run.outcome.culprit == "link"
    assert "'link' asks for the part 'hff' of topic 'channel', which has no such part; " in run.outcome.error
    assert "did you mean 'hf'" in run.outcome.error
    later = {"inputs": hears, "hello": {"version": (1, 99)}}
    assert Simulation(loop(link=later)).join().run().outcome.error == ""


def test_a_service_of_another_role_than_the_scenario_says_is_refused_and_ends_the_run() -> None:
    run = Simulation(loop(channel={"hello": {"role": "sensors"}})).join().run()
    assert refusals(run)[0].code == "declaration"
    assert run.outcome.culprit == "channel"
    assert "sensors" in run.outcome.error


def test_another_implementation_than_the_scenario_says_is_refused_and_ends_the_run() -> None:
    """Its metadata would call the recording what it is not."""
    rays = {"use": "free-space", "hello": {"implementation": "sionna-rt"}}
    run = Simulation(loop(channel=rays)).join().run()
    assert refusals(run)[0].code == "declaration"
    assert run.outcome.culprit == "channel"
    assert "'sionna-rt'" in run.outcome.error
    assert "'free-space'" in run.outcome.error


def test_a_client_that_names_no_implementation_is_accepted() -> None:
    assert Simulation(loop(channel={"use": "free-space"})).join().run().outcome.error == ""


def test_hello_after_the_end_is_refused() -> None:
    run = Simulation(loop()).join().run()
    run.feed(ev.Joined(m.Hello(version=m.PROTOCOL_VERSION, name="world", role="world")))
    assert refusals(run)[-1].code == "late"


def test_clause_3_a_cycle_ends_the_run_before_anything_is_prepared() -> None:
    needs_action = (m.Input(topic="scene"), m.Input(topic="action"))
    takes_link = (m.Input(topic="link"),)
    run = Simulation([world(), link(inputs=needs_action), agent(inputs=takes_link)]).join().run()
    assert "cycle" in run.outcome.error
    assert not run.seen(m.Prepare)
    assert {a.service for a in run.seen(ev.Send) if isinstance(a.message, m.Shutdown)} == set(run.services)


@pytest.mark.parametrize(
    ("one", "two", "culprit"),
    [
        (world(ready={"prefixes": ("car",)}), world("uav", ready={"prefixes": ("car.",)}), "uav"),
        (agent("a1", ready={"actuators": ("beam:*",)}), agent("a2", ready={"actuators": ("beam:x",)}), "a2"),
    ],
)
def test_clause_3_a_clash_is_refused_at_ready_naming_both(one: Sim, two: Sim, culprit: str) -> None:
    rest = [s for s in (world("town", ready={"prefixes": ("house",)}), agent()) if s.role != one.role]
    run = Simulation([one, two, *rest]).join().run()
    assert [r.code for r in run.seen(m.Refuse, culprit)] == ["clash"]
    assert run.outcome.culprit == culprit
    assert one.name in run.outcome.error
    assert two.name in run.outcome.error


def test_clause_4_two_worlds_with_different_files_of_one_name_are_refused() -> None:
    worlds = [world(assets=(asset("x.ply", "a"),)), world("uav", assets=(asset("x.ply", "b"),))]
    run = Simulation([*worlds, agent()]).join().run()
    assert "'x.ply'" in run.outcome.error
    assert run.seen(m.Refuse, "uav")[0].code == "clash"


def test_clause_4_two_worlds_may_bring_the_same_file() -> None:
    worlds = [world(assets=(asset("x.ply"),)), world("uav", assets=(asset("x.ply"), asset("y.ply")))]
    run = Simulation([*worlds, agent()]).join().run()
    assert [a.name for a in run.seen(m.Prepare, "agent")[0].assets] == ["x.ply", "y.ply"]
    assert run.outcome.error == ""


def test_clause_4_another_geometry_than_the_worlds_announced_is_refused() -> None:
    services = [world(assets=(asset("x.ply"),)), channel(ready={"geometry": "f" * 64}), agent(), link()]
    run = Simulation(services).join().run()
    assert run.seen(m.Refuse, "channel")[0].code == "geometry"
    assert run.outcome.culprit == "channel"
    assert "ffffffffffff" in run.outcome.error


def test_clause_4_the_geometry_of_all_worlds_is_accepted() -> None:
    files = (asset("x.ply"), asset("y.ply", "b"))
    worlds = [world(assets=files[1:]), world("uav", assets=files[:1])]
    both = channel(ready={"geometry": geometry_digest(files)})
    assert Simulation([*worlds, both, agent(), link()]).join().run().outcome.error == ""


def patterned(own: m.Asset | None, offered: tuple[m.Asset, ...]) -> Simulation:
    """A run whose scenario names a pattern file, which the broker has as ``own``."""
    file = PatternFile("patterns/a.csv", "devices[0].array.pattern_file", "/here/a.csv", "world", own)
    return Simulation(loop(world={"assets": offered}), patterns=(file,)).join().run()


def test_a_pattern_file_that_no_world_offers_comes_from_the_broker() -> None:
    mine = asset("patterns/a.csv")
    for offered in ((), (mine,)):
        run = patterned(mine, offered)
        assert run.outcome.error == ""
        assert run.seen(m.Prepare, "channel")[0].assets == (mine,)


def test_another_pattern_file_than_the_scenarios_is_refused_and_its_world_named() -> None:
    run = patterned(asset("patterns/a.csv"), (asset("patterns/a.csv", "b"),))
    assert run.outcome.culprit == "world"
    assert (
        "world 'world' offers another file as 'patterns/a.csv' than the scenario's /here/a.csv"
        in run.outcome.error
    )
    assert not run.seen(m.Grant)


def test_a_pattern_file_that_is_nowhere_ends_the_run_before_its_first_frame() -> None:
    run = patterned(None, ())
    assert run.outcome.culprit == "world"
    assert "devices[0].array.pattern_file: world 'world' offers no 'patterns/a.csv', and" in run.outcome.error
    assert not run.seen(m.Grant)
    assert patterned(None, (asset("patterns/a.csv"),)).outcome.error == ""


def test_scenery_of_somebody_who_is_no_world_is_not_used() -> None:
    run = Simulation([world(), channel(assets=(asset("x.ply"),)), agent(), link()]).join().run()
    assert [e.of for e in run.seen(m.Error, "channel")] == ["ASSET_OFFER"]
    assert run.seen(m.Prepare, "agent")[0].assets == ()


def test_clause_5_an_idle_service_is_prepared_and_shut_down_and_never_reset() -> None:
    run = Simulation([world(), agent(), sensors()]).join().run()
    assert [n.service for n in run.notices("idle")] == ["lidar"]
    got = [type(a.message) for a in run.seen(ev.Send, "lidar")]
    assert got == [m.Welcome, m.Prepare, m.Shutdown]
    assert run.seen(m.Prepare, "lidar")[0].demand == ()
    assert run.outcome.error == ""


@pytest.mark.parametrize("harm", ["dies", "fails", "is silent"])
def test_clause_5_the_run_does_without_an_idle_service(harm: str) -> None:
    run = Simulation([world(latency=20 * MS), agent(), sensors(ready_after=None)]).join()
    fault = m.Fault(epoch=1, attempt=1, phase="prepare", message="no mesh")
    if harm == "dies":
        run.after(30 * MS, lambda: run.kill("lidar"))
    if harm == "fails":
        run.after(30 * MS, lambda: run.feed(ev.FaultReceived("lidar", fault)))
    run.run()
    assert run.outcome.error == ""
    assert len(run.notices({"dies": "lost", "fails": "fault", "is silent": "idle"}[harm], "lidar")) == 1


def test_clause_5_topics_to_record_are_produced_though_nobody_else_asks() -> None:
    run = Simulation([world(), agent(), sensors(), recorder()], record=("lidar",)).join().run()
    assert ("lidar", "lidar") in run.inputs("recorder", 0)


def test_a_service_that_fails_while_preparing_ends_the_run_with_its_words() -> None:
    run = Simulation(loop(channel={"ready_after": None})).join()
    fault = m.Fault(epoch=1, attempt=1, phase="prepare", message="no libLLVM; apt-get install libllvm19")
    run.after(5 * MS, lambda: run.feed(ev.FaultReceived("channel", fault)))
    run.run()
    assert run.outcome.culprit == "channel"
    assert "no libLLVM; apt-get install libllvm19" in run.outcome.error


def test_a_note_that_is_a_warning_is_noticed_as_one() -> None:
    run = Simulation(loop(channel={"ready_after": None})).join()
    run.run(lambda run: bool(run.seen(m.Prepare, "channel")))
    notes = ("sionna-rt 2.2.0", f"{m.WARNING}scattering is switched off")
    run.feed(ev.ReadyReceived("channel", m.Ready(epoch=1, attempt=1, notes=notes)))
    assert [n.text for n in run.notices("note", "channel")] == ["sionna-rt 2.2.0"]
    assert [n.text for n in run.notices("warning", "channel")] == ["scattering is switched off"]


def test_ready_of_another_attempt_is_stale_and_not_used() -> None:
    run = Simulation(loop(channel={"ready_after": None})).join()
    run.run(lambda run: bool(run.seen(m.Prepare, "channel")))
    run.feed(ev.ReadyReceived("channel", m.Ready(epoch=1, attempt=2)))
    run.feed(ev.ReadyReceived("channel", m.Ready(epoch=2, attempt=1)))
    assert [s.of for s in run.seen(m.Stale, "channel")] == ["READY", "READY"]
    assert run.clock.state is RunState.PREPARING


def test_ready_out_of_turn_is_answered_with_an_error() -> None:
    run = Simulation(loop()).join().run(lambda run: run.clock.state is RunState.RUNNING)
    run.feed(ev.ReadyReceived("channel", m.Ready(epoch=1, attempt=1)))
    assert run.seen(m.Error, "channel")[0].code == "unexpected"
    assert run.run().outcome.error == ""


def test_the_time_to_connect_is_limited_and_the_missing_are_named() -> None:
    run = Simulation(loop(), timeouts=Timeouts(connect=3 * SECOND))
    run.join("world", "agent", "recorder").run()
    assert run.outcome.error.startswith("channel 'channel', link 'link' did not connect within 3 s")
    assert run.outcome.culprit == "channel"
    assert run.now == SECOND + 3 * SECOND


def test_the_time_to_get_ready_is_limited() -> None:
    run = Simulation(loop(channel={"ready_after": None}), timeouts=Timeouts(ready=5 * SECOND)).join().run()
    assert run.outcome.culprit == "channel"
    assert "preparing" in run.outcome.error
    assert "no heartbeat ever came" in run.outcome.error


def test_clause_14_a_declared_grace_lets_loading_take_longer() -> None:
    slow = {"ready_after": 60 * SECOND, "heartbeat": (SECOND, False), "phase": "compiling kernels"}
    timeouts = Timeouts(ready=5 * SECOND)
    impatient = Simulation(loop(channel=slow), timeouts=timeouts).join().run()
    assert "phase 'compiling kernels'" in impatient.outcome.error
    patient = Simulation(loop(channel=slow | {"grace": 90 * SECOND}), timeouts=timeouts).join().run()
    assert patient.outcome.error == ""


def test_progress_lets_loading_take_longer() -> None:
    slow = {"ready_after": 60 * SECOND, "heartbeat": (SECOND, True), "phase": "loading"}
    assert (
        Simulation(loop(channel=slow), timeouts=Timeouts(ready=5 * SECOND)).join().run().outcome.error == ""
    )


def test_the_time_to_reset_is_limited() -> None:
    run = Simulation(loop(world={"reset_after": None}), timeouts=Timeouts(reset=5 * SECOND)).join().run()
    assert run.outcome.culprit == "world"
    assert "resetting" in run.outcome.error


def test_the_time_to_leave_is_limited_and_who_stays_is_named() -> None:
    run = Simulation(loop(link={"says_bye": False}), timeouts=Timeouts(shutdown=2 * SECOND)).join().run()
    assert run.outcome.error == ""
    assert [n.service for n in run.notices("lost")] == ["link"]


def test_a_stop_that_is_requested_ends_the_run_in_any_state() -> None:
    for after in (0, 1, 2 * MS + 1, 4 * MS, 10 * MS):
        run = Simulation(loop()).join()
        run.after(after, lambda run=run: run.feed(ev.StopRequested("Ctrl-C")))
        run.run()
        assert run.outcome.error == "Ctrl-C"
        assert run.outcome.culprit == ""
