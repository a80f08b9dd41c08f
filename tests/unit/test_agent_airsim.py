"""The agent that serves AirSim's RPC: frames on one side, a client on the other."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from airsim_harness import PERIOD_NS, Body, scene
from link_builders import given
from msgspec.structs import replace

from caviar_bridges.airsim.agent import AirSimAgent, AirSimSettings
from caviar_bridges.airsim.attachment import attach
from caviar_bridges.airsim.rpc import RpcClient
from caviar_clients.session.prepared import prepare
from caviar_protocol.errors import RunError, ScenarioError, SetupError
from caviar_protocol.scenario import load_scenario
from caviar_protocol.topics import Action, VelocityCommand, WaypointCommand
from caviar_services.connection import RunOver
from caviar_services.service import Frame, Preparation, RunInfo, StepResult

SHIPPED = Path(__file__).parents[2] / "deploy" / "caviar_scenarios" / "airsim.toml"


class Run:
    """An agent, and the frames of a vehicle that obeys it."""

    def __init__(self, agent: AirSimAgent) -> None:
        self.agent, self.body, self.number, self.final = agent, Body(), 0, False

    def step(self) -> StepResult:
        """One frame, in which the vehicle obeys."""
        made = self.agent.step(self.frame())
        action = made.products.get("action")
        if isinstance(action, Action):
            self.body.move(action.commands)
        self.number += 1
        return made

    def frame(self) -> Frame:
        t_ns, seen = self.number * PERIOD_NS, given("scene", scene(self.body))
        return Frame(
            episode=0, number=self.number, t_ns=t_ns, service="pilot", inputs=(seen,), final=self.final
        )


@contextmanager
def prepared(attend: Callable[[], None] = lambda: None, **values: Any) -> Iterator[tuple[Run, int]]:
    """A prepared agent in its run, and the port that it listens on."""
    values = {"vehicles": {"Drone1": "uav"}, "users": ("motion:uav",), "listen": "127.0.0.1:0"} | values
    settings = AirSimSettings(**values)
    agent = AirSimAgent(settings, RunInfo(name="pilot", attend=attend, episodes=2))
    try:
        declared = agent.prepare(Preparation(demand={}))
        assert declared.actuators == ("motion:uav",)
        agent.reset(0, 1, 0)
        yield Run(agent), int(declared.notes[-1].rpartition(":")[2])
    finally:
        agent.close()


def commands(result: StepResult) -> tuple[Any, ...]:
    action = result.products["action"]
    assert isinstance(action, Action)
    return action.commands


@contextmanager
def beside(work: Callable[[], Any]) -> Iterator[Future[Any]]:
    """Work in a thread."""
    with ThreadPoolExecutor(1) as threads:
        yield threads.submit(work)


def test_without_a_client_the_vehicle_hovers_and_frames_go_by() -> None:
    with prepared() as (run, _):
        for _ in range(3):
            assert commands(run.step()) == (VelocityCommand(object="uav", velocity=(0.0, 0.0, 0.0)),)


def test_a_motion_call_becomes_commands_and_returns_when_it_is_done() -> None:
    def client(port: int) -> Any:
        with RpcClient(port=port) as airsim:
            airsim.call("enableApiControl", True, "")
            airsim.call("armDisarm", True, "")
            done = airsim.call("moveToPosition", 4.0, 0.0, -3.0, 5.0)
            return done, airsim.call("getMultirotorState", "")["kinematics_estimated"]["position"]

    with prepared() as (run, port), beside(lambda: client(port)) as result:
        seen = set()
        while not result.done():
            seen.update(commands(run.step()))
        done, where = result.result()
    assert done is True
    assert list(where.values()) == pytest.approx([4.0, 0.0, -3.0], abs=0.5)
    assert any(isinstance(c, WaypointCommand) and c.position == (35.0, 79.0, 4.5) for c in seen)


def test_a_control_taken_before_the_first_frame_is_kept() -> None:
    with prepared() as (run, port), RpcClient(port=port) as airsim:
        airsim.call("enableApiControl", True, "")
        run.agent.reset(0, 1, 0)
        run.step()
        assert airsim.call("isApiControlEnabled", "Drone1") is True
        run.agent.reset(1, 1, 0)  # but not beyond the end of its episode
        assert airsim.call("isApiControlEnabled", "Drone1") is False


def test_a_run_waits_for_its_first_client_where_it_is_to() -> None:
    with prepared(start="client") as (run, port), beside(run.step) as first:
        assert not first.done()
        with RpcClient(port=port) as airsim:
            assert airsim.call("ping") is True
            first.result(10)


def test_a_frame_that_is_held_is_left_when_the_run_ends() -> None:
    """The order comes while the agent looks for it; its client learns that the run is over."""
    over = threading.Event()

    def attend() -> None:
        if over.is_set():
            raise RunOver("stopped by Ctrl-C")

    with prepared(attend, start="paused") as (run, port), beside(run.step) as held:
        with RpcClient(port=port) as airsim:
            assert airsim.call("simIsPaused") is True
            assert airsim.call("getMultirotorState", "")["timestamp"] == 0
        over.set()
        with pytest.raises(RunOver):
            held.result(10)


def test_closing_answers_calls_in_progress() -> None:
    with prepared() as (run, port):
        client = RpcClient(port=port)
        run.step()

        def wait() -> None:
            client.call("enableApiControl", True, "")
            client.call("armDisarm", True, "")
            client.call("moveToPosition", 90.0, 0.0, -3.0, 1.0)

        with beside(wait) as waiting:
            while not any(isinstance(c, WaypointCommand) for c in commands(run.step())):
                pass
            run.agent.close()
            with pytest.raises(RunError, match="refuses moveToPosition: the run is over"):
                waiting.result(10)
        client.close()


def test_a_reset_ends_the_episode_where_another_one_follows() -> None:
    with prepared() as (run, port), RpcClient(port=port) as airsim:
        run.step()
        with beside(lambda: airsim.call("reset")) as resetting:
            while not run.step().end_episode:
                pass
            run.final = True
            assert run.step() == StepResult()
            run.final = False
            assert not resetting.done()
            run.agent.reset(1, 1, 0)
            run.step()
            assert resetting.result(10) is None


def test_an_address_in_use_is_refused_before_the_first_frame() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        listen = f"127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(SetupError, match=f"cannot be served at {listen}"), prepared(listen=listen):
            pass


@pytest.mark.parametrize(
    ("old", "new", "key", "words"),
    [
        (
            "[services.pilot.settings]",
            '[services.pilot.settings]\nlisten = "a:b"',
            "settings.listen",
            "write HOST:PORT",
        ),
        ('SimpleFlight = "uav"', 'A = "uav", B = "uav"', "settings.vehicles", "are the object 'uav'"),
        ('use = "airsim"', 'use = "airsim"\npolicy = "hold"', "policy", 'write "wait"'),
    ],
)
def test_settings_that_cannot_be_are_refused_with_their_key(
    tmp_path: Path, old: str, new: str, key: str, words: str
) -> None:
    source = SHIPPED.read_text()
    assert old in source
    file = tmp_path / "scenario.toml"
    file.write_text(source.replace(old, new, 1))
    with pytest.raises(ScenarioError) as error:
        prepare(file)
    assert f"services.pilot.{key}" in str(error.value)
    assert words in str(error.value)


def test_scripts_take_the_place_of_the_agent_that_flies() -> None:
    """And of its users; the agent of the beams stays."""
    found = attach(load_scenario("uav-pair"), ":5")
    pilot = found.services["pilot"]
    assert (pilot.use, pilot.users) == ("airsim", ("motion:uav",))
    assert pilot.settings == {"vehicles": {"uav": "uav"}, "listen": ":5"}
    assert found.services["beams"] == load_scenario("uav-pair").services["beams"]


def test_scripts_are_one_more_agent_where_none_flies() -> None:
    scenario = load_scenario("uav-pair")
    services = {name: spec for name, spec in scenario.services.items() if name != "pilot"}
    found = attach(replace(scenario, services=services), ":5")
    assert list(found.services)[-1] == "airsim"
    assert found.services["airsim"].users == ("motion:uav",)


def test_an_agent_of_scripts_gets_another_address() -> None:
    shipped = load_scenario("airsim")
    found = attach(shipped, ":5")
    assert found.services["pilot"].settings == shipped.services["pilot"].settings | {"listen": ":5"}


def test_a_scenario_in_which_nothing_flies_is_refused() -> None:
    with pytest.raises(ScenarioError, match="flown by commands"):
        attach(load_scenario("smoke"), ":5")
