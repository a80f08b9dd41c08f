"""Meshes that a world announces while the run goes on, over real sockets (clause 4)."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from broker_harness import MS, Client, Serving, plan, serving

from caviar_protocol import messages as m
from caviar_protocol.assets import mesh_name
from caviar_protocol.digest import geometry_digest
from caviar_space.meshes import Mesh, ply, unit_box

pytestmark = pytest.mark.slow

CAPABLE = {"version": (1, 6), "capabilities": ("assets", "geometry")}
BOX, CRATE = ply(unit_box()), ply(unit_box(), "wood")
EMPTY = ply(Mesh(unit_box().vertices, unit_box().faces[:0]))


def described(content: bytes) -> m.Asset:
    digest = hashlib.sha256(content).hexdigest()
    return m.Asset(name=mesh_name(content), digest=digest, size=len(content))


@contextmanager
def street(tmp_path: Path, **run: Any) -> Iterator[tuple[Serving, Client, Client]]:
    """A broker, a world, and sensors, all of which were reset."""
    with (
        serving(plan("world", "sensors", **run), tmp_path) as broker,
        Client(broker.endpoint, "world", **CAPABLE) as world,
        Client(broker.endpoint, "sensors", **CAPABLE) as sensors,
    ):
        for client in (world, sensors):
            client.join()
        assert world.ready().max_faces == broker.server.clock.plan.max_faces
        sensors.ready()
        for client in (world, sensors):
            client.reset()
        yield broker, world, sensors


def announce(world: Client, frame: int, *contents: bytes) -> None:
    """Answer a grant with a scene, and with all meshes from a frame on."""
    grant = world.expect(m.Grant)
    change = m.GeometryChange(frame=frame, assets=tuple(map(described, contents)))
    world.done(grant, ("scene", b"\x80", b"scene"), geometry=change)


def deliver(world: Client, *contents: bytes) -> None:
    for content in contents:
        get = world.expect(m.AssetGet)
        assert get.digest == described(content).digest
        world.send(m.AssetData(digest=get.digest, offset=0, size=len(content)), content)


def load(client: Client, frame: int, *contents: bytes) -> None:
    """Take GEOMETRY and answer it."""
    order = client.expect(m.Geometry)
    assets = tuple(sorted(map(described, contents), key=lambda asset: asset.name))
    assert (order.frame, order.assets) == (frame, assets)
    ids = client.ids | {"episode": order.episode, "frame": frame}
    client.send(m.GeometryDone(**ids, geometry=geometry_digest(assets)))


def test_a_frame_waits_for_the_mesh_of_its_world_and_for_those_that_load_it(tmp_path: Path) -> None:
    with street(tmp_path) as (_, world, sensors):
        announce(world, 0, CRATE)
        assert sensors.quiet(), "the broker has not got the mesh"
        deliver(world, CRATE)
        order = sensors.expect(m.Geometry)
        assert order.assets == (described(CRATE),)
        sensors.send(m.AssetGet(digest=described(CRATE).digest))
        sensors.expect(m.AssetData)
        assert sensors.parts == [CRATE]
        assert sensors.quiet(), "frame 0 waits for GEOMETRY_DONE"
        ids = sensors.ids | {"episode": 0, "frame": 0}
        sensors.send(m.GeometryDone(**ids, geometry=geometry_digest(order.assets)))
        assert sensors.answer().frame == 0
        announce(world, 2, CRATE, BOX)  # of which one is known, for a later frame
        deliver(world, BOX)
        load(sensors, 2, CRATE, BOX)
        assert sensors.answer().frame == 1
        announce(world, 2)
        load(sensors, 2)
        assert sensors.answer().frame == 2


def test_a_world_that_runs_ahead_is_heard_in_the_order_in_which_it_answered(tmp_path: Path) -> None:
    run = plan("world", "sensors")
    ahead = {**CAPABLE, "max_in_flight": 3}
    services = tuple(
        s if s.role != "world" else type(s)(**{**vars(s), "max_in_flight": 3}) for s in run.services
    )
    run = type(run)(**{**vars(run), "services": services})
    with (
        serving(run, tmp_path) as broker,
        Client(broker.endpoint, "world", **ahead) as world,
        Client(broker.endpoint, "sensors", **CAPABLE) as sensors,
    ):
        for client in (world, sensors):
            client.join()
        for client in (world, sensors):
            client.ready()
        for client in (world, sensors):
            client.reset()
        announce(world, 0, CRATE)
        world.answer()
        while not isinstance(message := world.receive(), m.AssetGet):
            assert isinstance(message, m.Grant)
            world.done(message, ("scene", b"\x80", b"later"))
        world.send(m.AssetData(digest=message.digest, offset=0, size=len(CRATE)), CRATE)
        load(sensors, 0, CRATE)
        assert [sensors.answer().frame for _ in range(3)] == [0, 1, 2]


@pytest.mark.parametrize(
    ("content", "why"),
    [(EMPTY, "has no faces"), (b"no mesh", "not a PLY file"), (CRATE, "has 12 faces, the run takes 8")],
    ids=["no faces", "no mesh", "too many faces"],
)
def test_a_file_that_is_no_mesh_is_refused_and_the_run_goes_on(
    tmp_path: Path, content: bytes, why: str
) -> None:
    with street(tmp_path, max_faces=8) as (broker, world, sensors):
        announce(world, 0, content)
        deliver(world, content)
        error = world.expect(m.Error)
        assert (error.code, error.subject) == ("refused-mesh", described(content).digest)
        assert why in error.message
        assert described(content).name in error.message
        assert sensors.answer().frame == 0
        announce(world, 1, content)  # again: neither asked for nor told again
        assert sensors.answer().frame == 1
        world.answer()
        assert sensors.answer().frame == 2
        for client in (world, sensors):
            client.expect(m.EpisodeEnd)
            client.bye()
        assert broker.outcome().error == ""


def test_a_world_that_does_not_have_what_it_announced_ends_the_run(tmp_path: Path) -> None:
    with street(tmp_path, limits={"stall": 3000 * MS}) as (broker, world, _):
        announce(world, 0, CRATE)
        get = world.expect(m.AssetGet)
        world.send(m.Error(code="unknown-asset", of="ASSET_GET", subject=get.digest, message="lost"))
        outcome = broker.outcome()
        assert outcome.culprit == "world"
        assert "cannot deliver it: lost" in outcome.error
