"""Scenery through the broker: delivered by worlds, fetched by services, and blamed where wrong (clause 4)."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from broker_harness import MS, Client, Serving, plan, serving

from caviar_broker.assets import FILES_AT_ONCE
from caviar_protocol import messages as m
from caviar_protocol.digest import geometry_digest
from caviar_protocol.fields import MAX_ASSET_CHUNK

pytestmark = pytest.mark.slow

Files = dict[str, bytes]


def manifest(files: Files) -> tuple[m.Asset, ...]:
    return tuple(
        m.Asset(name=name, digest=hashlib.sha256(content).hexdigest(), size=len(content))
        for name, content in files.items()
    )


def deliver(world: Client, files: Files, requests: int) -> None:
    """Answer that many ASSET_GETs."""
    by_digest = {hashlib.sha256(content).hexdigest(): content for content in files.values()}
    for _ in range(requests):
        get = world.expect(m.AssetGet)
        content = by_digest[get.digest]
        chunk = content[get.offset : get.offset + MAX_ASSET_CHUNK]
        world.send(m.AssetData(digest=get.digest, offset=get.offset, size=len(content)), chunk)


def fetch(client: Client, asset: m.Asset) -> bytes:
    """A whole file, chunk by chunk."""
    content = b""
    while True:
        client.send(m.AssetGet(digest=asset.digest, offset=len(content)))
        data = client.expect(m.AssetData)
        assert (data.digest, data.offset, data.size) == (asset.digest, len(content), asset.size)
        content += client.parts[0]
        if len(content) == asset.size:
            return content


@contextmanager
def preparing(tmp_path: Path, **limits: int) -> Iterator[tuple[Serving, Client, Client]]:
    """A broker, a world that is asked to prepare, and sensors that have joined."""
    with (
        serving(plan("world", "sensors", limits=limits), tmp_path) as broker,
        Client(broker.endpoint, "world") as world,
        Client(broker.endpoint, "sensors") as sensors,
    ):
        world.join()
        sensors.join()
        world.expect(m.Prepare)
        yield broker, world, sensors


def offer(world: Client, assets: tuple[m.Asset, ...]) -> None:
    world.send(m.AssetOffer(**world.ids, assets=assets))


def test_scenery_of_several_chunks_and_none_travels_whole(tmp_path: Path) -> None:
    files = {
        "scenery/town.xml": b"<scene/>",
        "scenery/big.ply": os.urandom(2 * MAX_ASSET_CHUNK + 5),
        "e": b"",
    }
    with preparing(tmp_path) as (_, world, sensors):
        offer(world, manifest(files))
        world.send(m.Ready(**world.ids))  # counts once everything has come
        deliver(world, files, requests=1 + 3 + 1)
        assets = sensors.expect(m.Prepare).assets
        assert sorted(assets, key=lambda a: a.name) == sorted(manifest(files), key=lambda a: a.name)
        for asset in assets:
            assert fetch(sensors, asset) == files[asset.name]
        sensors.send(m.Ready(**sensors.ids, geometry=geometry_digest(assets)))
        world.reset()
        sensors.reset()
        world.answer()


def test_two_services_fetch_at_once(tmp_path: Path) -> None:
    files = {"a.ply": os.urandom(MAX_ASSET_CHUNK + 1), "b.ply": b"b"}
    run = plan("world", "sensors", "sensors:others")
    with (
        serving(run, tmp_path) as broker,
        Client(broker.endpoint, "world") as world,
        Client(broker.endpoint, "sensors") as one,
        Client(broker.endpoint, "others", "sensors") as two,
    ):
        for client in (world, one, two):
            client.join()
        world.expect(m.Prepare)
        offer(world, manifest(files))
        deliver(world, files, requests=3)
        world.send(m.Ready(**world.ids))
        assets = one.expect(m.Prepare).assets
        assert two.expect(m.Prepare).assets == assets
        for asset in assets:  # chunk for chunk in turn
            halves: dict[str, bytes] = {"sensors": b"", "others": b""}
            while min(map(len, halves.values())) < asset.size:
                for client in (one, two):
                    client.send(m.AssetGet(digest=asset.digest, offset=len(halves[client.name])))
                for client in (one, two):
                    client.expect(m.AssetData)
                    halves[client.name] += client.parts[0]
            assert set(halves.values()) == {files[asset.name]}


def test_a_city_of_files_is_asked_for_a_few_at_a_time(tmp_path: Path) -> None:
    files = {f"meshes/{number}.ply": str(number).encode() for number in range(300)}
    with preparing(tmp_path) as (_, world, sensors):
        offer(world, manifest(files))
        asked = [world.expect(m.AssetGet) for _ in range(FILES_AT_ONCE)]
        assert world.quiet()
        contents = {asset.digest: files[asset.name] for asset in manifest(files)}
        for get in asked:
            content = contents[get.digest]
            world.send(m.AssetData(digest=get.digest, offset=0, size=len(content)), content)
        deliver(world, files, requests=300 - FILES_AT_ONCE)
        world.send(m.Ready(**world.ids))
        assert len(sensors.expect(m.Prepare).assets) == 300


def test_what_the_broker_holds_already_is_not_asked_for(tmp_path: Path) -> None:
    files = {"a.ply": b"known"}
    for requests in (1, 0):
        with preparing(tmp_path) as (_, world, sensors):
            offer(world, manifest(files))
            deliver(world, files, requests)
            world.send(m.Ready(**world.ids))
            assert sensors.expect(m.Prepare).assets == manifest(files)


def test_an_unknown_asset_is_an_error_with_its_digest(tmp_path: Path) -> None:
    with preparing(tmp_path) as (_, _, sensors):
        sensors.send(m.AssetGet(digest="0" * 64))
        error = sensors.expect(m.Error)
        assert (error.code, error.of, error.subject) == ("unknown-asset", "ASSET_GET", "0" * 64)


WRONG = {
    "another digest": ({"digest": "1" * 64}, b"plaza", "the broker did not ask for asset 111111111111"),
    "another offset": ({"offset": 1}, b"laza", "expected them at 0"),
    "another size": ({"size": 7}, b"plaza", "expected them at 0 of 5 B"),
    "other content": ({}, b"plazA", "announced was"),
    "nothing": ({}, b"", "got 0 B"),
}


@pytest.mark.parametrize(("change", "chunk", "words"), WRONG.values(), ids=WRONG)
def test_wrong_scenery_ends_the_run_with_blame(
    tmp_path: Path, change: dict[str, object], chunk: bytes, words: str
) -> None:
    (asset,) = manifest({"a.ply": b"plaza"})
    with preparing(tmp_path) as (broker, world, _):
        offer(world, (asset,))
        get = world.expect(m.AssetGet)
        values = {"digest": get.digest, "offset": 0, "size": 5} | change
        world.send(m.AssetData(**values), chunk)  # type: ignore[arg-type]
        outcome = broker.outcome()
    assert outcome.culprit == "world"
    assert "sent wrong scenery" in outcome.error
    assert words in outcome.error


def test_a_world_that_lost_what_it_offered_is_blamed_at_once(tmp_path: Path) -> None:
    with preparing(tmp_path) as (broker, world, _):
        offer(world, manifest({"a.ply": b"plaza"}))
        get = world.expect(m.AssetGet)
        world.send(m.Error(code="unknown-asset", of="ASSET_GET", subject=get.digest, message="moved away"))
        outcome = broker.outcome()
    assert "world 'world' offered 'a.ply' and cannot deliver it: moved away" in outcome.error


def test_a_world_that_never_delivers_is_blamed_after_the_ready_time(tmp_path: Path) -> None:
    with preparing(tmp_path, ready=300 * MS) as (broker, world, _):
        offer(world, manifest({"a.ply": b"plaza"}))
        world.send(m.Ready(**world.ids))
        outcome = broker.outcome(within_s=5.0)
        assert outcome.culprit == "world"
        assert "timeouts.ready_s" in outcome.error
        assert "1 files of its scenery are due, 'a.ply' first" in broker.witness.texts("world")


def test_one_name_for_two_files_ends_the_run(tmp_path: Path) -> None:
    with preparing(tmp_path) as (broker, world, _):
        offer(world, (*manifest({"a.ply": b"one"}), *manifest({"a.ply": b"two"})))
        assert "two different files are named 'a.ply'" in broker.outcome().error


def test_only_a_world_that_prepares_offers_scenery(tmp_path: Path) -> None:
    with preparing(tmp_path) as (broker, world, sensors):
        offer(sensors, manifest({"a.ply": b"mine"}))
        assert sensors.expect(m.Error).code == "unexpected"
        world.send(m.AssetOffer(epoch=1, attempt=9, assets=manifest({"a.ply": b"old"})))
        world.send(m.Ready(**world.ids))
        assert sensors.expect(m.Prepare).assets == ()
        assert "another epoch or attempt" in broker.witness.texts("world")


def test_a_name_that_leads_out_of_the_folder_is_not_even_a_message(tmp_path: Path) -> None:
    with preparing(tmp_path) as (broker, world, _):
        offer(world, (m.Asset(name="../../etc/passwd", digest="0" * 64, size=1),))
        assert world.expect(m.Error).code == "malformed"
        assert "sent what is not in the protocol" in broker.outcome().error
