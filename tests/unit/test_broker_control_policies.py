"""Policies that are given over the control channel of a running broker, as any program may do it."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import pytest
from broker_harness import PAIR, Client, eventually, plan, playing, serving

from caviar_broker.control.socket import RequestRefusedError, ask
from caviar_broker.policies import offer_policy, policy_outcome
from caviar_protocol import messages as m
from caviar_protocol.policies import DECISION, NEXT, REFUSED, PolicyFolder

pytestmark = pytest.mark.slow

FIRST, SECOND = b"one policy", b"another policy"
ONE, TWO = (hashlib.sha256(content).hexdigest() for content in (FIRST, SECOND))


def decides(client: Client, decisions: dict[str, str]) -> m.Grant:
    """Answer a grant with these decisions."""
    grant = client.expect(m.Grant)
    client.done(grant, ("lidar", b"x", b"x"), decisions=decisions)
    return grant


def swap(directory: Path, **given: Any) -> dict[str, Any]:
    return ask(directory, do="swap", **given)


def test_a_policy_is_announced_in_grants_and_what_comes_of_it_is_told(tmp_path: Path) -> None:
    run = plan(*PAIR, frames=6, policies={"sensors": (ONE,)})
    with serving(run, tmp_path, desk=tmp_path) as broker, playing(broker.endpoint, *PAIR) as (world, sensors):
        PolicyFolder(tmp_path).add("sensors", FIRST)
        world.answer()
        assert decides(sensors, {DECISION: ONE}).decisions == {}
        assert offer_policy(tmp_path, "", SECOND) == ("sensors", TWO)
        assert broker.server.store.path(TWO).read_bytes() == SECOND
        assert policy_outcome(tmp_path, "sensors", TWO)["state"] == "offered"
        world.answer()  # the grant of this frame may have been on its way
        decides(sensors, {DECISION: ONE})
        world.answer()
        assert decides(sensors, {DECISION: TWO}).decisions == {NEXT: TWO}
        world.answer()
        third = offer_policy(tmp_path, "sensors", b"a third")[1]
        decides(sensors, {DECISION: TWO, REFUSED: f"{third} it is torn"})
        # The world's next grant may come before the broker has read what the sensors answer.
        found = {"state": "refused", "frame": -1, "reason": "it is torn"}
        eventually(lambda: policy_outcome(tmp_path, "sensors", third) == found, "the agent's refusal")
        assert policy_outcome(tmp_path, "sensors", TWO) == {"state": "serving", "frame": 2, "reason": ""}
        assert PolicyFolder(tmp_path).digests("sensors") == (ONE, TWO), "what was refused is not kept"
        assert f"policy {TWO[:12]}… serves from frame 2 on" in broker.witness.texts("sensors")


def test_what_cannot_be_announced_is_refused_with_the_reason(tmp_path: Path) -> None:
    with serving(plan(*PAIR, policies={"sensors": (ONE,)}), tmp_path, desk=tmp_path):
        PolicyFolder(tmp_path).add("sensors", FIRST)
        for given, why in (
            ({"agent": "world", "sha256": ONE}, "agent is 'world'; agents that serve policies: sensors"),
            ({"agent": ["sensors"], "sha256": ONE}, "agents that serve policies: sensors"),
            ({"agent": "sensors", "sha256": TWO}, "there is no such file in policies/sensors"),
            ({"agent": "sensors", "sha256": f"../{ONE}"}, "there is no such file"),
            ({"agent": "sensors"}, "sha256 is None"),
        ):
            with pytest.raises(RequestRefusedError, match=why):
                swap(tmp_path, **given)
        with pytest.raises(RequestRefusedError, match=r"'world'.*sensors"):
            offer_policy(tmp_path, "world", SECOND)


def test_a_file_that_only_the_run_has_is_hashed_by_the_broker(tmp_path: Path) -> None:
    with serving(plan(*PAIR, policies={"sensors": (ONE,)}), tmp_path, desk=tmp_path) as broker:
        folder = PolicyFolder(tmp_path)
        folder.add("sensors", SECOND)
        file = folder.files("sensors")[TWO]
        file.write_bytes(SECOND[:-1])
        with pytest.raises(RequestRefusedError, match="it was changed"):
            swap(tmp_path, agent="sensors", sha256=TWO)
        file.write_bytes(SECOND)
        assert swap(tmp_path, agent="sensors", sha256=TWO)["ok"] is True
        assert broker.server.store.path(TWO).read_bytes() == SECOND
