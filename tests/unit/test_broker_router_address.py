"""The address that a broker chooses: any free port, but none that an outgoing connection may take."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from caviar_broker import connections as port_module
from caviar_broker.connections import Router, free_endpoints

LIVENESS_NS = 1_500_000_000


def number(endpoint: str) -> int:
    return int(endpoint.rpartition(":")[2])


def ephemeral() -> range:
    first, last = map(int, port_module.PORT_RANGE.read_text().split())
    return range(first, last + 1)


def test_a_port_that_the_broker_chooses_is_none_that_outgoing_connections_get() -> None:
    port = Router("tcp://127.0.0.1:0", LIVENESS_NS)
    try:
        assert number(port.endpoint) not in ephemeral()
    finally:
        port.close()


def test_a_port_that_is_taken_is_passed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        busy = taken.getsockname()[1]
        candidates = [f"tcp://127.0.0.1:{busy}", "tcp://127.0.0.1:0"]
        monkeypatch.setattr(port_module, "free_endpoints", lambda endpoint: iter(candidates))
        port = Router("tcp://127.0.0.1:0", LIVENESS_NS)
        try:
            assert number(port.endpoint) not in (0, busy)
        finally:
            port.close()


def test_an_address_with_a_port_is_the_only_one() -> None:
    assert list(free_endpoints("tcp://[::1]:5570")) == ["tcp://[::1]:5570"]


@pytest.mark.parametrize("told", ["1024 65535", "", "none"])
def test_the_system_chooses_where_no_port_lies_outside_and_linux_s_range_holds_where_none_is_told(
    told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "range").write_text(told)
    monkeypatch.setattr(port_module, "PORT_RANGE", tmp_path / "range")
    found = list(free_endpoints("tcp://*:0"))
    assert found[-1] == "tcp://*:0"
    chosen = [number(endpoint) for endpoint in found[:-1]]
    assert bool(chosen) == (told != "1024 65535")
    assert not [port for port in chosen if 32768 <= port <= 60999]
