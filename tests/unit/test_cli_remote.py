"""Remote services: what is checked, what is planned, and what the user is told to type."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest
from typer.testing import CliRunner

from caviar_broker.core.plan import SECOND, plan_run
from caviar_clients.cli import remote
from caviar_clients.cli.main import app
from caviar_clients.sessions.checking import TOPICS_OF, checked_scenario
from caviar_protocol.errors import ScenarioError
from caviar_protocol.messages import Role
from caviar_protocol.scenario import ServiceSpec
from caviar_protocol.scenario_checks import refuse_remote
from caviar_protocol.scenario_loader import load_scenario
from caviar_services.registry import BUILT_IN, load

SCENARIOS = Path(__file__).parents[2] / "deploy" / "scenarios"
REMOTE = SCENARIOS / "remote.toml"
ENDPOINT = "tcp://127.0.0.1:45123"


def spec(role: Role) -> ServiceSpec:
    return ServiceSpec(role=role, use="remote", budget_ms=20.0)


def scenario(folder: Path, *changes: tuple[str, str]) -> Path:
    """The shipped scenario with some text replaced."""
    text = REMOTE.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / "scenario.toml"
    path.write_text(text)
    return path


def test_a_remote_service_is_not_looked_up_and_its_settings_are_left_as_they_are(tmp_path: Path) -> None:
    settings = ("[timeouts]", '[services.agent.settings]\npolicy = "mine"\nlayers = [64, 64]\n\n[timeouts]')
    checked = checked_scenario(scenario(tmp_path, settings))
    assert checked.services["agent"].settings == {"policy": "mine", "layers": [64, 64]}
    plan = plan_run(checked, "run", {})
    agent = next(service for service in plan.services if service.name == "agent")
    assert (agent.use, agent.remote, agent.settings) == ("", True, {"policy": "mine", "layers": [64, 64]})


@pytest.mark.parametrize(
    ("changes", "agent", "others"),
    [
        ((), 30 * SECOND, 0),
        ((("connect_s = 120", "rejoin_s = 5"),), 5 * SECOND, 5 * SECOND),
        ((("connect_s = 120", "rejoin_s = 0"),), 0, 0),
        ((('use = "remote"', 'use = "random"'),), 0, 0),
    ],
)
def test_only_remote_services_are_waited_for_unless_the_scenario_says_how_long(
    tmp_path: Path, changes: tuple[tuple[str, str], ...], agent: int, others: int
) -> None:
    plan = plan_run(load_scenario(scenario(tmp_path, *changes)), "run", {})
    waits = {s.name: plan.limits.rejoin if s.rejoin is None else s.rejoin for s in plan.services}
    assert waits.pop("agent") == agent
    assert set(waits.values()) == {others}


def test_a_topic_that_a_remote_service_may_produce_may_be_recorded(tmp_path: Path) -> None:
    sensors = ("[services.recorder]", '[services.eyes]\nrole = "sensors"\nuse = "remote"\nbudget_ms = 9\n\n')
    record = ('record = ["scene",', 'record = ["lidar", "camera", "scene",')
    checked_scenario(scenario(tmp_path, record, (sensors[0], sensors[1] + sensors[0])))
    with pytest.raises(ScenarioError, match="no service of the run produces 'lidar'"):
        checked_scenario(scenario(tmp_path, record))


def test_remote_services_may_produce_all_that_those_of_their_role_do() -> None:
    for key in BUILT_IN:
        role, _, name = key.partition(":")
        assert set(load(role, name).outputs) <= set(TOPICS_OF[role])


def test_a_run_without_a_broker_refuses_remote_services_by_place_and_remedy() -> None:
    refuse_remote(load_scenario(SCENARIOS / "smoke.toml"))
    with pytest.raises(ScenarioError, match=r"remote\.toml:\d+: services\.agent\.use: .*an implementation"):
        refuse_remote(load_scenario(REMOTE))


def test_the_user_is_told_who_is_awaited_where_and_what_to_type(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(REMOTE.parents[2])
    assert remote.waiting_text("agent", spec("agent"), ENDPOINT, 30.0) == (
        f"waiting for 'agent' (agent) at {ENDPOINT}, for 30 s (timeouts.connect_s): "
        f"start it with  python clients/minimal/agent.py {ENDPOINT} agent"
    )
    assert remote.start_command("my world", spec("world"), ENDPOINT) == (
        f"caviar service 'my world' --use world:IMPLEMENTATION --broker {ENDPOINT}"
    )
    monkeypatch.setattr(remote, "MINIMAL", Path("/nowhere/agent.py"))
    assert "caviar service agent --use agent:IMPLEMENTATION" in remote.start_command(
        "agent", spec("agent"), ENDPOINT
    )


def test_the_example_is_named_from_wherever_the_user_stands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert str(remote.MINIMAL) in remote.start_command("agent", spec("agent"), ENDPOINT)


@pytest.mark.parametrize("everywhere", ["0.0.0.0", "[::]"])  # noqa: S104  # only told, not bound
def test_an_address_of_all_interfaces_is_told_as_one_to_connect_to(everywhere: str) -> None:
    assert remote.reachable(f"tcp://{everywhere}:5555") == f"tcp://{socket.gethostname()}:5555"
    assert remote.reachable(ENDPOINT) == ENDPOINT


def test_the_broker_command_names_what_fills_the_place(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        bind = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        result = CliRunner().invoke(app, ["broker", str(REMOTE), "--bind", bind, "--out", str(tmp_path)])
    assert "caviar service agent --use agent:IMPLEMENTATION" in result.output
    assert "caviar service link --use link:beams" in result.output
