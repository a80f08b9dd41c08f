"""What each service learns about the scenario: its part of it, and who owns which users."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from caviar_broker.core.plan import briefings, with_ownership
from caviar_protocol.codec import decode_message, encode_message
from caviar_protocol.host import host_identity
from caviar_protocol.messages import Welcome
from caviar_protocol.scenario import load_scenario, parse_scenario

SMOKE = Path(__file__).parents[2] / "deploy" / "caviar_scenarios" / "smoke.toml"
SECOND_AGENT = """
[services.other]
role = "agent"
use = "random"
budget_ms = 20
users = ["uav/rx-uav"]
"""


def test_a_world_is_told_its_own_devices_and_others_all_of_them(tmp_path: Path) -> None:
    text = SMOKE.read_text() + (
        '\n[services.second]\nrole = "world"\nuse = "trajectory"\nbudget_ms = 20\n'
        '[[services.second.settings.objects]]\nname = "van"\nkind = "car"\ndimensions_m = [4.0, 2.0, 2.0]\n'
        "waypoints = [[0.0, 0.0, 0.0, 1.0]]\n"
    )
    text = text.replace('[[devices]]\nname = "rx-uav"', '[[devices]]\nworld = "second"\nname = "rx-uav"')
    for name in ("bs", "rx"):
        text = text.replace(
            f'[[devices]]\nname = "{name}"\n', f'[[devices]]\nworld = "world"\nname = "{name}"\n'
        )
    told = briefings(parse_scenario(text), tmp_path)
    names = {service: {d["name"] for d in brief["devices"]} for service, brief in told.items()}
    assert names["world"] == {"bs", "rx"}
    assert names["second"] == {"rx-uav"}
    assert names["link"] == names["recorder"] == {"bs", "rx", "rx-uav"}


def test_the_recorder_is_told_where_to_write_and_all_that_was_resolved(tmp_path: Path) -> None:
    told = briefings(load_scenario(SMOKE), tmp_path)
    assert told["recorder"]["directory"] == str(tmp_path)
    assert set(told["recorder"]["resolved"]["services"]) == set(told)
    assert "directory" not in told["link"]


def test_every_briefing_can_travel(tmp_path: Path) -> None:
    scenario = load_scenario(SMOKE)
    for name, told in briefings(scenario, tmp_path).items():
        welcome = Welcome(
            version=(1, 0),
            run="r",
            epoch=1,
            attempt=1,
            heartbeat_ns=1,
            liveness_ns=1,
            settings=scenario.services[name].settings,
            scenario=told,
        )
        decoded = decode_message(encode_message(welcome))
        assert isinstance(decoded, Welcome)
        assert encode_message(decoded) == encode_message(welcome)


def test_agents_own_their_users_and_default_agents_the_rest() -> None:
    scenario = with_ownership(parse_scenario(SMOKE.read_text() + SECOND_AGENT))
    assert scenario.services["other"].settings["users"] == ("uav/rx-uav",)
    assert scenario.services["agent"].settings["except_users"] == ("uav/rx-uav",)
    assert scenario.services["link"].settings == {}


def test_without_owners_nothing_is_told() -> None:
    scenario = load_scenario(SMOKE)
    assert with_ownership(scenario) == scenario


def test_processes_of_one_namespace_have_one_host_identity() -> None:
    code = "from caviar_protocol.host import host_identity; print(host_identity())"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=30, check=True
    )
    assert done.stdout.strip() == host_identity()
    assert f"pid:[{Path('/proc/self/ns/pid').stat().st_ino}]" in host_identity()
