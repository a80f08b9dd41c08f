"""The kit's cases of meshes that come while a run goes on, played with a service of this process."""

from __future__ import annotations

import re
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import pytest

from caviar_labs.conform import Rules, conform
from caviar_protocol.messages import Input, Role
from caviar_protocol.topics import Depth
from caviar_services.frame import Frame, StepResult
from caviar_services.runner import Runner
from caviar_services.service import NoSettings, Service
from caviar_services.world.base import ObjectState
from caviar_services.world.engine import Engine, EngineWorld
from caviar_space.meshes import box, ply, unit_box

pytestmark = pytest.mark.slow

CASES = ("geometry", "later-geometry", "geometry-gone")


class Following(Service[NoSettings]):
    """Loads meshes, and sees nothing."""

    role: ClassVar[Role] = "sensors"
    inputs: ClassVar[tuple[Input, ...]] = (Input(topic="scene"),)
    outputs: ClassVar[tuple[str, ...]] = ("depth",)
    uses_scenery: ClassVar[bool] = True
    changes_geometry: ClassVar[bool] = True

    def use_meshes(self, meshes: Mapping[str, Path]) -> None:
        assert all(path.read_bytes().startswith(b"ply") for path in meshes.values())

    def step(self, frame: Frame) -> StepResult:
        frame.scene()
        return StepResult(products={"depth": Depth(images=())})


class Early(Following):
    """Fails where it is sent meshes."""

    def use_meshes(self, meshes: Mapping[str, Path]) -> None:
        raise ValueError("it cannot load them")


class Crates(Engine):
    """A crate is there from 0.3 s on, and its mesh comes with it."""

    prefixes = ("crate",)
    mesh = ""

    def step(self, t: float, previous: float, commands: object) -> list[ObjectState]:
        del previous, commands
        if t < 0.3:
            return []
        self.bring()
        at, level, still = (5.0, 0.0, 0.5), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        return [ObjectState("crate", "crate", at, level, still, (1.0, 1.0, 1.0), mesh=self.mesh)]

    def bring(self) -> None:
        self.mesh = self.offer_mesh("crate", unit_box().vertices, unit_box().faces, "wood").mesh


class Unannounced(Crates):
    """Names a mesh that it never brings."""

    mesh = f"objects/{'0' * 64}.ply"

    def bring(self) -> None:
        pass


class Oversized(Crates):
    """Brings a mesh of 2 m."""

    def bring(self) -> None:
        self.mesh = self._world.add_mesh(ply(box((-1, 1), (-1, 1), (-1, 1))))


def judged(cls: type[Service[Any]], *names: str) -> dict[str, str]:
    """Outcome of each case for a service, each life of which is a thread."""

    def tell(text: str) -> None:
        found = re.search(r"start your client.* (tcp://\S+)", text)
        if found:
            runner = Runner("client", cls, "test", found[1], own_process=False)
            threading.Thread(target=runner.run, daemon=True).start()

    rules = Rules(timeout_s=20.0)
    return {v.case: v.outcome for v in conform("tcp://127.0.0.1:0", names=names, rules=rules, tell=tell)}


def test_a_service_that_follows_passes_all_of_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert judged(Following, *CASES) == dict.fromkeys(CASES, "pass")


def test_one_that_cannot_load_them_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert judged(Early, "geometry") == {"geometry": "fail"}


@pytest.mark.parametrize(
    ("engine", "outcome"), [(Crates, "pass"), (Unannounced, "fail"), (Oversized, "fail")]
)
def test_a_world_passes_where_its_meshes_are_announced_and_can_be_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, engine: type[Engine], outcome: str
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert judged(EngineWorld.for_engine(engine()), "run-time-meshes") == {"run-time-meshes": outcome}
