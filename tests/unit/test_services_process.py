"""The process of a service, before it joins a run."""

from __future__ import annotations

import pytest

from caviar_services import __main__ as process


def test_a_service_process_keeps_the_memory_that_products_need(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else glibc returns it to the system behind every frame, and each page costs a fault in the next."""
    called: list[str] = []
    monkeypatch.setattr(process, "steady_memory", lambda: called.append("steady"))
    monkeypatch.setattr(process, "run_service", lambda *_, **__: called.append("run"))
    process.serve("link", "link:beams", "tcp://127.0.0.1:1")
    assert called == ["steady", "run"]
