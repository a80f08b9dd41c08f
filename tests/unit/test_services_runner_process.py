"""The process of a service, before it joins a run."""

from __future__ import annotations

import pytest

from caviar_services import runner


def test_a_service_process_keeps_the_memory_that_products_need(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else glibc returns it to the system after every frame, and each page costs a fault in the next."""
    called: list[str] = []

    class Ran:
        ended = ""

        def __init__(self, *_: object, **__: object) -> None:
            called.append("made")

        def run(self) -> int:
            called.append("run")
            return 0

    monkeypatch.setattr(runner, "steady_memory", lambda: called.append("steady"))
    monkeypatch.setattr(runner, "SignalTermination", lambda _: None)
    monkeypatch.setattr(runner, "Runner", Ran)
    assert runner.serve("link", "link:beams", "tcp://127.0.0.1:1") == 0
    assert called == ["steady", "made", "run"]
