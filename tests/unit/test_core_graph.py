"""The graph of a run: sources, cycles, demand and clashes (contract, clauses 3, 5 and 17)."""

from __future__ import annotations

from fnmatch import fnmatchcase
from itertools import product
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from caviar_broker.core.graph import build_graph, check_actuators, check_prefixes
from caviar_protocol.errors import DeclarationError
from caviar_protocol.messages import PROTOCOL_VERSION, Demand, Hello, Input


def hello(name: str, role: Any, takes: str = "", gives: str = "", **kw: Any) -> Hello:
    """``takes``: topics, ``@1`` for lag 1, ``?`` for optional."""
    inputs = tuple(
        Input(topic=t.rstrip("?").split("@")[0], lag=int("@1" in t), required=not t.endswith("?"))
        for t in takes.split()
    )
    return Hello(
        version=PROTOCOL_VERSION, name=name, role=role, inputs=inputs, outputs=tuple(gives.split()), **kw
    )


def graph(*hellos: Hello, record: tuple[str, ...] = ()) -> Any:
    return build_graph({h.name: h for h in hellos}, record)


WORLD, AGENT = hello("world", "world", "", "scene"), hello("agent", "agent", "scene", "action")


def test_services_stand_after_the_producers_of_their_frame() -> None:
    found = graph(
        hello("a-link", "link", "channel action?", "link"),
        hello("b-agent", "agent", "scene link@1?", "action"),
        hello("c-channel", "channel", "scene", "channel"),
        hello("d-world", "world", "", "scene"),
        record=("link",),
    )
    assert found.order == ("d-world", "c-channel", "b-agent", "a-link")
    assert found.retained == {"a-link"}, "only lag 1 makes a product needed later"


def test_clause_3_a_cycle_within_a_frame_is_refused_by_naming_it() -> None:
    services = (
        hello("world", "world", "", "scene"),
        hello("link", "link", "action scene", "link"),
        hello("agent", "agent", "link", "action"),
    )
    with pytest.raises(DeclarationError) as error:
        graph(*services)
    text = str(error.value)
    assert "cycle" in text
    assert "'agent' needs 'link' of 'link'" in text or "'link' needs 'action' of 'agent'" in text
    assert "lag 1" in text
    assert "world" not in text, "who is not in the cycle is not blamed"


def test_clause_3_lag_1_opens_a_cycle() -> None:
    found = graph(
        hello("link", "link", "action", "link"),
        hello("agent", "agent", "link@1", "action"),
    )
    assert found.order == ("agent", "link")


def test_clause_3_a_service_that_needs_its_own_product_of_the_frame_is_a_cycle() -> None:
    with pytest.raises(DeclarationError, match="'w' needs 'scene' of 'w'"):
        graph(hello("w", "world", "scene", "scene"), AGENT)


def test_clause_3_a_topic_may_have_several_sources_and_consumers_get_each() -> None:
    found = graph(WORLD, hello("uav", "world", "", "scene"), AGENT)
    assert [(e.topic, e.source) for e in found.inputs["agent"]] == [("scene", "uav"), ("scene", "world")]
    assert found.producers["scene"] == ("uav", "world")


def test_an_input_that_is_declared_twice_counts_once_and_as_required() -> None:
    found = graph(WORLD, hello("agent", "agent", "scene? scene", "action"))
    assert [(e.source, e.required) for e in found.inputs["agent"]] == [("world", True)]


def test_a_required_input_without_a_source_names_consumer_topic_and_what_there_is() -> None:
    with pytest.raises(DeclarationError, match=r"'agent' needs topic 'lidar'.*scene"):
        graph(WORLD, hello("agent", "agent", "scene lidar", "action"))


def test_an_optional_input_without_a_source_is_no_edge() -> None:
    assert [e.topic for e in graph(WORLD, hello("a", "agent", "scene lidar?")).inputs["a"]] == ["scene"]


def test_only_recorders_take_every_topic() -> None:
    with pytest.raises(DeclarationError, match="only a recorder"):
        graph(WORLD, hello("agent", "agent", "*", "action"))


def test_clause_5_a_producer_that_nobody_asks_for_is_idle() -> None:
    found = graph(WORLD, AGENT, hello("lidar", "sensors", "scene", "lidar"))
    assert found.idle == ("lidar",)
    assert "lidar" not in found.order
    assert found.demand["lidar"] == ()


def test_clause_5_the_recorder_creates_no_demand_and_records_what_exists() -> None:
    recorder = hello("recorder", "recorder", "*?")
    found = graph(WORLD, AGENT, hello("lidar", "sensors", "scene", "lidar"), recorder)
    assert found.idle == ("lidar",)
    assert [e.topic for e in found.inputs["recorder"]] == ["scene"]


def test_clause_5_topics_to_record_are_in_demand_and_what_they_need_too() -> None:
    recorder = hello("recorder", "recorder", "*?")
    lidar = hello("lidar", "sensors", "scene", "lidar")
    found = graph(WORLD, lidar, recorder, record=("lidar",))
    assert found.idle == ()
    assert [e.topic for e in found.inputs["recorder"]] == ["lidar", "scene"]


def test_clause_5_an_unknown_topic_to_record_is_refused() -> None:
    with pytest.raises(DeclarationError, match="'liadr'"):
        graph(WORLD, AGENT, record=("liadr",))


def test_clause_5_demand_names_the_parts_that_consumers_and_the_recording_ask_for() -> None:
    link = Hello(
        version=PROTOCOL_VERSION,
        name="link",
        role="link",
        inputs=(Input(topic="channel", parts=("h",)),),
        outputs=(),
    )
    recorder = Hello(
        version=PROTOCOL_VERSION,
        name="recorder",
        role="recorder",
        inputs=(Input(topic="channel", required=False, parts=("everything",)),),
    )
    channel = hello("channel", "channel", "", "channel")
    found = graph(channel, link, recorder, record=("channel.points",))
    assert found.demand["channel"] == (Demand(topic="channel", parts=("h", "points")),)


def test_clause_5_an_output_that_nobody_asks_for_is_not_in_demand_though_another_is() -> None:
    camera = hello("camera", "sensors", "scene", "camera depth")
    found = graph(WORLD, camera, hello("agent", "agent", "scene camera", "action"))
    assert found.outputs["camera"] == ("camera",)


@pytest.mark.parametrize(("a", "b"), [("car", "car"), ("car", "car."), ("", "uav")])
def test_clause_3_prefixes_of_which_one_begins_with_the_other_clash(a: str, b: str) -> None:
    with pytest.raises(DeclarationError, match=r"'one' and 'two' clash"):
        check_prefixes({"one": ("x", a), "two": (b,)})


def test_clause_3_one_world_may_have_overlapping_prefixes() -> None:
    check_prefixes({"one": ("car", "car."), "two": ("uav",)})


def test_clause_17_patterns_of_two_agents_that_share_an_actuator_clash() -> None:
    with pytest.raises(DeclarationError, match=r"'beam:\*\.1'"):
        check_actuators({"a": ("beam:car.*",), "b": ("motion:uav", "beam:*.1")})


def test_clause_17_patterns_of_two_agents_that_share_nothing_do_not_clash() -> None:
    check_actuators({"a": ("beam:car.*", "motion:*"), "b": ("beam:uav", "beam:bus.?")})


@given(st.text("ab*?", max_size=4), st.text("ab*?", max_size=4))
def test_clause_17_two_patterns_clash_exactly_where_a_name_matches_both(a: str, b: str) -> None:
    # Each pattern has a match among names of at most 8 letters if it has any in common with the other.
    names = ("".join(letters) for n in range(9) for letters in product("abc", repeat=n))
    common = any(fnmatchcase(name, a) and fnmatchcase(name, b) for name in names)
    try:
        check_actuators({"one": (a,), "two": (b,)})
    except DeclarationError:
        assert common
    else:
        assert not common
