"""Remote services: what is checked, what is planned, and what the user has to type."""

from __future__ import annotations

import shlex
import socket
from pathlib import Path

import pytest
from typer.testing import CliRunner

from caviar_broker import launch as broker_main
from caviar_broker.core.plan import SECOND, plan_run
from caviar_clients.cli import remote
from caviar_clients.cli.main import app
from caviar_clients.session.prepared import prepare
from caviar_protocol.errors import ScenarioError
from caviar_protocol.keys import credentials, read_authorized, read_public
from caviar_protocol.messages import Role
from caviar_protocol.scenario import ServiceSpec, load_scenario
from caviar_protocol.scenario.rules import refuse_remote
from caviar_protocol.topics import topics_of
from caviar_services.registry import load, registered

SCENARIOS = Path(__file__).parents[2] / "deploy" / "caviar_scenarios"
REMOTE = SCENARIOS / "remote.toml"
ENDPOINT = "tcp://127.0.0.1:45123"


@pytest.fixture(autouse=True)
def _broker_keeps_its_place(monkeypatch: pytest.MonkeyPatch) -> None:
    """`caviar broker` runs in this process here, which stays in no better place."""
    monkeypatch.setattr(broker_main, "raise_priority", lambda: "")


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
    checked = prepare(scenario(tmp_path, settings)).scenario
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
    waits = {s.name: plan.timeouts.rejoin if s.rejoin is None else s.rejoin for s in plan.services}
    assert waits.pop("agent") == agent
    assert set(waits.values()) == {others}


def test_a_topic_that_a_remote_service_may_produce_may_be_recorded(tmp_path: Path) -> None:
    sensors = ("[services.recorder]", '[services.eyes]\nrole = "sensors"\nuse = "remote"\nbudget_ms = 9\n\n')
    record = ('record = ["scene",', 'record = ["lidar", "camera", "scene",')
    prepare(scenario(tmp_path, record, (sensors[0], sensors[1] + sensors[0])))
    with pytest.raises(ScenarioError, match="no service of the run produces 'lidar'"):
        prepare(scenario(tmp_path, record))


def test_remote_services_may_produce_all_that_those_of_their_role_do() -> None:
    for key in registered():
        role, _, name = key.partition(":")
        # The engine draws its own pictures; a remote world has none that a scenario could count on.
        own = {"camera"} if key == "world:panda3d" else set()
        assert set(load(role, name).outputs) - own <= set(topics_of(role))


def test_a_run_without_a_broker_refuses_remote_services_by_place_and_remedy() -> None:
    refuse_remote(load_scenario(SCENARIOS / "smoke.toml"))
    with pytest.raises(ScenarioError, match=r"remote\.toml:\d+.*services\.agent\.use"):
        refuse_remote(load_scenario(REMOTE))


def test_the_user_is_told_who_is_awaited_where_and_what_to_type(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(REMOTE.parents[2])
    assert remote.waiting_text("agent", spec("agent"), ENDPOINT, 30.0) == (
        f"waiting for 'agent' (agent) at {ENDPOINT}, for 30 s (timeouts.connect_s): "
        "start your own client with this address and name (protocol/SPEC.md), "
        f"or  python clients/minimal/agent.py {ENDPOINT} agent"
    )
    assert remote.start_command("my world", spec("world"), ENDPOINT) == (
        f"python clients/python/world.py {ENDPOINT} 'my world'"
    )
    told = remote.waiting_text("link", spec("link"), ENDPOINT, 30.0)
    assert told.endswith(
        f"caviar service link --use link:IMPLEMENTATION --broker {ENDPOINT} (IMPLEMENTATION: beams, cell)"
    )
    monkeypatch.setattr(remote, "SOURCES", Path("/nowhere"))
    assert "caviar service agent --use agent:IMPLEMENTATION" in remote.start_command(
        "agent", spec("agent"), ENDPOINT
    )


def test_the_example_is_named_from_wherever_the_user_stands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert str(remote.SOURCES) in remote.start_command("agent", spec("agent"), ENDPOINT)


@pytest.mark.parametrize("everywhere", ["0.0.0.0", "[::]"])  # noqa: S104  # only told, not bound
def test_an_address_of_all_interfaces_is_told_as_one_to_connect_to(everywhere: str) -> None:
    assert remote.reachable(f"tcp://{everywhere}:5555") == f"tcp://{socket.gethostname()}:5555"
    assert remote.reachable(ENDPOINT) == ENDPOINT


def test_the_broker_command_names_what_fills_the_place(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        bind = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        result = CliRunner().invoke(app, ["broker", str(REMOTE), "--bind", bind, "--out", str(tmp_path)])
    assert "caviar service agent --use agent:IMPLEMENTATION" in result.output
    assert f"caviar service link --use link:beams --broker {bind}\n" in result.output


def test_without_an_address_to_name_services_are_started_at_the_default_one() -> None:
    services = {"agent": spec("agent")}
    for bind in ("", "tcp://127.0.0.1:0", "tcp://127.0.0.1:*"):
        assert remote.service_commands(services, bind, None) == [
            "caviar service agent --use agent:IMPLEMENTATION"
        ]


def test_the_commands_of_a_broker_with_keys_let_the_services_in(tmp_path: Path) -> None:
    """One service has no key, one has a key that is not authorized, one has its key on its own machine."""
    keys, runner = tmp_path / "my keys", CliRunner()

    def run(*arguments: str) -> None:
        result = runner.invoke(app, ["keys", *arguments, "--directory", str(keys)])
        assert result.exit_code == 0, result.output

    for new in (["broker"], ["link"], ["world", "--role", "world"]):
        run("new", *new)
    (keys / "world.key").unlink()
    roles: dict[str, Role] = {"agent": "agent", "link": "link", "world": "world"}
    services = {name: spec(role) for name, role in roles.items()}
    commands = [shlex.split(line) for line in remote.service_commands(services, ENDPOINT, keys)]
    for command in commands[:-3]:
        assert command[:2] == ["caviar", "keys"]
        assert runner.invoke(app, command[1:]).exit_code == 0, command
    assert {(entry.name, entry.role) for entry in read_authorized(keys)} == set(roles.items())
    for name, command in zip(services, commands[-3:], strict=True):
        assert command[:3] == ["caviar", "service", name]
        options = dict(zip(command[3::2], command[4::2], strict=True))
        assert options["--broker"] == ENDPOINT
        if name == "world":
            assert options["--key"] == "world.key"
            continue
        shown = credentials(Path(options["--key"]), Path(options["--broker-key"]), {})
        assert shown is not None
        assert shown.broker == read_public(keys / "broker.pub")
        assert shown.pair.public in {entry.public for entry in read_authorized(keys) if entry.name == name}


def test_the_broker_command_names_the_keys(tmp_path: Path) -> None:
    keys = tmp_path / "keys"
    arguments = ["keys", "new", "broker", "--directory", str(keys)]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    with socket.create_server(("127.0.0.1", 0)) as taken:
        bind = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        arguments = ["broker", str(REMOTE), "--bind", bind, "--out", str(tmp_path), "--keys", str(keys)]
        result = CliRunner().invoke(app, arguments)
    assert f" --broker {bind} --key {keys}/link.key --broker-key {keys}/broker.pub\n" in result.output
