"""The exchange of `bench_broker` in mosaik: ``python peer_mosaik.py SERVICES PAYLOAD FRAMES``.

Prints the seconds that a frame takes. Needs ``pip install mosaik``.
"""

# ruff: noqa: T201 - the figure is the output

from __future__ import annotations

import logging
import sys
import time
from pathlib import Path
from typing import Any

import mosaik
import mosaik_api_v3

WARM_UP = 50
META: Any = {
    "api_version": "3.0",
    "type": "time-based",
    "models": {"M": {"public": True, "params": [], "attrs": ["made", "taken"]}},
}


class Peer(mosaik_api_v3.Simulator):  # type: ignore[misc]
    """A simulator with one entity; the one with frames to measure is the hub."""

    def __init__(self) -> None:
        super().__init__(META)
        self._started, self._now = 0.0, 0

    def init(self, sid: str, time_resolution: float = 1.0, **told: Any) -> Any:
        """Settings."""
        self._body, self._frames, self._sources = "x" * told["payload"], told["frames"], told["sources"]
        return self.meta

    def create(self, num: int, model: str, **_: Any) -> list[dict[str, Any]]:
        """The entity."""
        return [{"eid": "e", "type": model}]

    def step(self, now: int, inputs: Any, max_advance: int) -> int:
        """Take what came; the time when it was, of the hub."""
        taken = inputs.get("e", {}).get("taken", {})
        assert len(taken) == self._sources, f"frame {now}: {len(taken)} inputs"
        if 0 < now < WARM_UP:
            due = self._stamped(now if self._frames else now - 1)
            assert all(value == due for value in taken.values()), f"frame {now}: {taken}"
        self._now = now
        if self._frames and now == WARM_UP:
            self._started = time.perf_counter()
        if self._frames and now == WARM_UP + self._frames:
            print("seconds a frame:", (time.perf_counter() - self._started) / self._frames, flush=True)
        return now + 1

    def get_data(self, outputs: Any) -> Any:
        """The product."""
        # Who took the right values in the warm-up does so later, and then nothing is spent on showing it.
        return {"e": {"made": self._body if self._now >= WARM_UP else self._stamped(self._now)}}

    def _stamped(self, frame: int) -> str:
        """A product that tells its frame, modulo 10."""
        return str(frame % 10).ljust(len(self._body))[: len(self._body)]


def main() -> None:
    """The scenario here, a process for each simulator."""
    if "--peer" in sys.argv:
        sys.argv = [sys.argv[0], sys.argv[-1], "--log-level", "error"]
        logging.disable()
        mosaik_api_v3.start_simulation(Peer())
        return
    services, payload, frames = (int(value) for value in sys.argv[1:])
    command = f"{sys.executable} {Path(__file__).resolve()} --peer %(addr)s"
    with mosaik.World({"Peer": {"cmd": command}}, skip_greetings=True) as world:
        hub = world.start("Peer", payload=payload, frames=frames, sources=services - 1).M()
        for _ in range(services - 1):
            leaf = world.start("Peer", payload=payload, frames=0, sources=1).M()
            world.connect(leaf, hub, ("made", "taken"))
            world.connect(hub, leaf, ("made", "taken"), time_shifted=True, initial_data={"made": ""})
        world.run(until=frames + WARM_UP + 1, print_progress=False)


if __name__ == "__main__":
    main()
