"""What `caviar measure bench broker` measures: real processes, all products delivered, figures that agree."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from caviar_broker.core.graph import build_graph
from caviar_clients.cli.main import app
from caviar_labs.broker_bench import Topology, deliveries, measure, parts
from caviar_protocol import messages as m
from caviar_protocol.errors import RunError

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("topology", ["hub", "all"])
@pytest.mark.parametrize("services", [2, 5])
def test_deliveries_are_the_edges_of_the_graph(topology: Topology, services: int) -> None:
    hellos = {
        part.name: m.Hello(
            version=m.PROTOCOL_VERSION,
            name=part.name,
            role=part.role,
            inputs=part.inputs,
            outputs=(part.output,),
        )
        for part in parts(topology, services)
    }
    graph = build_graph(hellos, ("lidar",))
    assert sum(len(edges) for edges in graph.inputs.values()) == deliveries(topology, services)


@pytest.mark.parametrize("curve", [False, True])
def test_figures_of_a_run_agree(tmp_path: Path, curve: bool) -> None:
    file = tmp_path / "figures.json"
    arguments = [
        "measure",
        "bench",
        "broker",
        "--services",
        "3",
        "--payload",
        "1000",
        "--frames",
        "60",
        "--json",
        str(file),
        *["--curve"] * curve,
    ]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    figures = json.loads(file.read_text())
    per_frame = figures["us_per_frame"]
    assert set(per_frame) == {"mean", "p50", "p99"}
    assert 0 < per_frame["p50"] <= per_frame["p99"]
    assert figures["bytes_per_second"] == pytest.approx(4 * 1000 / per_frame["mean"] * 1e6)
    assert figures["broker_cpu_us_per_frame"] > 0
    assert figures["frames"] == 60
    assert figures["curve"] is curve
    assert figures["misses"] == 0


def test_a_file_that_cannot_be_written_is_named_before_anything_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("caviar_labs.broker_bench.measure", lambda *_, **__: pytest.fail("measured"))
    result = CliRunner().invoke(app, ["measure", "bench", "broker", "--json", str(tmp_path)])
    assert isinstance(result.exception, RunError)
    assert str(result.exception) == f"cannot write {tmp_path}: Is a directory; choose another file"


def test_a_client_that_cannot_take_part_ends_the_measurement_with_its_name(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("caviar_labs.broker_bench.CONNECT_NS", 1_000_000_000)
    monkeypatch.setattr("caviar_labs.broker_bench.CLIENT", "caviar_broker.no_such_module")
    with pytest.raises(RunError, match="did not connect"):
        measure("hub", 2, 10, 20)


def test_with_keys_a_client_without_one_is_not_let_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """What `--curve` measures is a broker that refuses everybody else."""
    monkeypatch.setattr("caviar_labs.broker_bench.CONNECT_NS", 1_000_000_000)
    monkeypatch.setattr("caviar_labs.broker_bench.KEY_VARIABLE", "NOBODY_READS_THIS")
    monkeypatch.setattr("caviar_labs.broker_bench.BROKER_KEY_VARIABLE", "NOR_THIS")
    with pytest.raises(RunError, match="did not connect"):
        measure("hub", 2, 10, 20, curve=True)
