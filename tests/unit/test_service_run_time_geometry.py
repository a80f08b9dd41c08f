"""A service's side of meshes that come and go while a run goes on, without sockets (clause 4)."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import pytest

from caviar_protocol import messages as m
from caviar_protocol.assets import AssetStore, mesh_name
from caviar_protocol.digest import geometry_digest
from caviar_protocol.errors import AssetError
from caviar_services.frame import Frame, StepResult
from caviar_services.run_time_geometry import AnnouncedMeshes
from caviar_services.service import NoSettings, Service
from caviar_services.session import ServiceSession
from caviar_services.world.assets import RunTimeMeshes

CRATE, BARREL = b"a crate", b"a barrel"
IDS = {"epoch": 1, "attempt": 1}


def described(content: bytes) -> m.Asset:
    digest = hashlib.sha256(content).hexdigest()
    return m.Asset(name=mesh_name(content), digest=digest, size=len(content))


class Following(Service[NoSettings]):
    """Notes which meshes it has in each frame."""

    role = "sensors"
    outputs = ("lidar",)
    uses_scenery: ClassVar[bool] = True
    changes_geometry: ClassVar[bool] = True
    log: ClassVar[list[tuple[int, list[bytes]]]] = []
    meshes: Mapping[str, Path] = {}

    def use_meshes(self, meshes: Mapping[str, Path]) -> None:
        self.meshes = dict(meshes)

    def step(self, frame: Frame) -> StepResult:
        self.log.append((frame.number, sorted(path.read_bytes() for path in self.meshes.values())))
        return StepResult()


class Life:
    """One service between PREPARE and its frames, and what it sends."""

    def __init__(self, store: AssetStore) -> None:
        Following.log.clear()
        self.sent: list[m.Message] = []
        self.session = ServiceSession("lidar", "test", Following, self._take, store)
        times = {"heartbeat_ns": 100_000_000, "liveness_ns": 1_500_000_000}
        self.session.handle(m.Welcome(version=m.PROTOCOL_VERSION, run="demo", **IDS, **times))
        self.session.handle(m.Prepare(**IDS, demand=(m.Demand(topic="lidar"),)))
        self.reset(0)

    def _take(self, message: m.Message, _: Sequence[Any]) -> None:
        self.sent.append(message)

    def reset(self, episode: int) -> None:
        self.session.handle(m.Reset(**IDS, episode=episode, seed=1, t0_ns=0))
        self.episode = episode

    def announce(self, frame: int, *contents: bytes) -> None:
        assets = tuple(map(described, contents))
        self.session.handle(m.Geometry(**IDS, episode=self.episode, frame=frame, assets=assets))

    def deliver(self, content: bytes) -> None:
        data = m.AssetData(digest=described(content).digest, offset=0, size=len(content))
        self.session.handle(data, (content,))

    def grant(self, frame: int) -> m.Done:
        self.session.handle(m.Grant(**IDS, episode=self.episode, frame=frame, t_ns=0))
        done = self.sent[-1]
        assert isinstance(done, m.Done), done
        return done

    def loaded(self) -> list[tuple[int, str]]:
        return [(x.frame, x.geometry) for x in self.sent if isinstance(x, m.GeometryDone)]


@pytest.fixture
def life(tmp_path: Path) -> Life:
    return Life(AssetStore(tmp_path))


def test_a_service_that_follows_names_the_capability(tmp_path: Path) -> None:
    class Still(Following):
        changes_geometry = False

    capabilities = [
        ServiceSession("s", "test", cls, lambda *_: None, AssetStore(tmp_path)).hello().capabilities
        for cls in (Following, Still)
    ]
    assert ["geometry" in named for named in capabilities] == [True, False]


def test_meshes_are_fetched_beside_the_frames_and_used_from_theirs_on(life: Life) -> None:
    life.grant(0)
    life.announce(2, CRATE, BARREL)
    assert isinstance(life.sent[-1], m.AssetGet)
    assert life.grant(1).geometry_digest == ""
    life.deliver(CRATE)
    assert life.loaded() == []
    life.deliver(BARREL)
    right = geometry_digest([described(CRATE), described(BARREL)])
    assert life.loaded() == [(2, right)]
    assert life.grant(2).geometry_digest == right
    assert Following.log == [(0, []), (1, []), (2, sorted([CRATE, BARREL]))]


def test_a_frame_that_does_not_wait_says_with_which_geometry_it_was_computed(life: Life) -> None:
    life.announce(0, CRATE)
    assert life.grant(0).geometry_digest == ""
    life.deliver(CRATE)
    assert life.grant(1).geometry_digest == geometry_digest([described(CRATE)])
    life.announce(2, CRATE, BARREL)
    assert life.grant(2).geometry_digest == geometry_digest([described(CRATE)])
    life.deliver(BARREL)
    assert life.grant(3).geometry_digest == geometry_digest([described(CRATE), described(BARREL)])


def test_a_later_change_for_a_frame_replaces_the_one_before(life: Life) -> None:
    life.announce(3, CRATE)
    life.deliver(CRATE)
    life.announce(3, BARREL)
    life.deliver(BARREL)
    for frame in range(4):
        life.grant(frame)
    assert Following.log[-2:] == [(2, []), (3, [BARREL])]
    assert [frame for frame, _ in life.loaded()] == [3, 3]


def test_meshes_go_with_a_change_and_with_the_episode(life: Life) -> None:
    life.announce(0, CRATE)
    life.deliver(CRATE)
    life.grant(0)
    life.announce(1)
    assert life.grant(1).geometry_digest == ""
    life.announce(2, CRATE)  # in the store: nothing is fetched
    assert life.loaded()[-1][0] == 2
    life.announce(5, BARREL)
    life.reset(1)
    life.deliver(BARREL)  # of the episode before
    assert life.grant(0).geometry_digest == ""
    assert [meshes for _, meshes in Following.log] == [[CRATE], [], []]
    assert len(life.loaded()) == 3


def test_what_cannot_be_fetched_is_a_fault(life: Life) -> None:
    life.announce(0, CRATE)
    digest = described(CRATE).digest
    life.session.handle(m.Error(code="unknown-asset", subject=digest, message="no asset has this digest"))
    fault = life.sent[-1]
    assert isinstance(fault, m.Fault)
    assert "no asset has this digest" in fault.message


def test_a_world_announces_all_its_meshes_where_they_change(tmp_path: Path) -> None:
    announced = AnnouncedMeshes(AssetStore(tmp_path))
    crate, barrel = mesh_name(CRATE), mesh_name(BARREL)
    assert announced.change(0, StepResult()) is None
    first = announced.change(1, StepResult(meshes={crate: CRATE}, meshes_from=4))
    assert first == m.GeometryChange(frame=4, assets=(described(CRATE),))
    both = announced.change(5, StepResult(meshes={crate: CRATE, barrel: BARREL}))
    assert both is not None
    assert (both.frame, len(both.assets)) == (5, 2)
    assert announced.change(9, StepResult(meshes={})) == m.GeometryChange(frame=9)
    with pytest.raises(AssetError, match=f"its name has to be {crate}"):
        announced.change(10, StepResult(meshes={barrel: CRATE}))


def test_a_mesh_lingers_after_its_last_object_and_a_refused_one_is_not_announced_again() -> None:
    meshes = RunTimeMeshes()
    meshes.max_faces = 100
    crate, barrel = meshes.add(CRATE), meshes.add(BARREL)
    assert sorted(meshes.at(0, {crate}) or ()) == sorted([crate, barrel]), "one is there before it is used"
    meshes.refuse(described(BARREL).digest, "no mesh")
    assert list(meshes.at(1, {crate}) or ()) == [crate]
    assert meshes.counts == {f"mesh-refused/{barrel}": 1}
    assert meshes.counts == {}, "told once"
    last = 1 + RunTimeMeshes.LINGER_FRAMES
    assert [meshes.at(frame, ()) for frame in range(2, last + 1)] == [None] * (last - 1)
    assert meshes.at(last + 1, ()) == {}
    assert meshes.at(last + 2, ()) is None


def test_a_world_that_was_started_again_says_once_more_what_it_has() -> None:
    meshes = RunTimeMeshes(again=True)
    meshes.max_faces = 100
    assert meshes.at(7, ()) == {}, "there may be some that it does not know of"
    assert meshes.at(8, ()) is None


def test_a_run_that_takes_none_is_told_of_none() -> None:
    meshes = RunTimeMeshes()
    assert meshes.at(0, {meshes.add(CRATE)}) is None
