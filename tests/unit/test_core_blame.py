"""A consumer that refuses an input: the run ends, and blames the service that made it."""

from __future__ import annotations

from typing import Any

import pytest
from core_harness import MS, Simulation, agent, channel, link, loop, world

from caviar_broker.core import events as ev
from caviar_protocol import messages as m

WORDS = "scene of 'world', frame 0: object 'car': orientation (2, 0, 0, 0) has norm 2"


def refused(culprit: str, words: str = WORDS, **channel_has: Any) -> Simulation:
    """A run in which the channel answers frame 0 with FAULT, and names this culprit."""
    services = loop(channel={"latency": 20 * MS, **channel_has})
    run = Simulation(services).join().run(lambda run: bool(run.grants("channel")))
    fault = m.Fault(epoch=1, attempt=1, episode=0, frame=0, phase="step", message=words, culprit=culprit)
    run.feed(ev.FaultReceived("channel", fault))
    return run


def test_the_source_of_a_refused_input_is_to_blame() -> None:
    run = refused("world").run()
    assert run.outcome.culprit == "world"
    assert run.outcome.error == f"world 'world' made a wrong product: {WORDS} (refused by channel 'channel')"


@pytest.mark.parametrize("policy", ["hold", "drop"])
def test_a_wrong_product_ends_the_run_also_where_its_consumer_could_be_done_without(policy: str) -> None:
    assert refused("world", policy=policy).run().outcome.culprit == "world"


@pytest.mark.parametrize("culprit", ["agent", "nobody", "channel"])
def test_a_culprit_that_made_none_of_the_inputs_is_not_believed(culprit: str) -> None:
    run = refused(culprit).run()
    assert run.outcome.culprit == "channel"
    assert "channel 'channel' failed in frame 0, step: " in run.outcome.error


@pytest.mark.parametrize("policy", ["wait", "hold"])
def test_what_a_service_says_in_several_lines_is_one_in_errors_and_notices(policy: str) -> None:
    run = refused("", "ValueError: shapes:\r\n\tweights: 3\n", policy=policy).run()
    said = "step: ValueError: shapes: / weights: 3"
    if policy == "wait":
        assert run.outcome.error == f"channel 'channel' failed in frame 0, {said}"
    else:
        assert said in [notice.text for notice in run.notices("fault", "channel")]


def test_consumers_are_told_the_prefixes_of_all_worlds() -> None:
    first = world("air", ready={"prefixes": ("uav.",)})
    second = world("road", ready={"prefixes": ("car.", "bs")})
    run = Simulation([first, second, channel(), agent(), link()]).join().run()
    told = {name: run.seen(m.Prepare, name)[0].prefixes for name in ("air", "road", "channel", "link")}
    both = {"air": ("uav.",), "road": ("car.", "bs")}
    assert told == {"air": {}, "road": {}, "channel": both, "link": both}
