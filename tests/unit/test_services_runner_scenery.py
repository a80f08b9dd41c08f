"""Scenery travels through the broker, whole and unchanged, or the service says what is wrong."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Sequence
from pathlib import Path

import msgspec
import pytest
from runner_harness import Broker, ends, played_broker, service

from caviar_protocol import messages as m
from caviar_protocol.digest import geometry_digest
from caviar_protocol.fields import MAX_ASSET_CHUNK

pytestmark = pytest.mark.slow

__all__ = ["played_broker"]


def manifest(files: dict[str, bytes]) -> tuple[m.Asset, ...]:
    return tuple(
        m.Asset(name=name, digest=hashlib.sha256(content).hexdigest(), size=len(content))
        for name, content in files.items()
    )


def deliver(broker: Broker, contents: Sequence[bytes], first: m.Message | None = None) -> m.Message:
    """Answer ASSET_GETs until something else comes."""
    by_digest = {hashlib.sha256(content).hexdigest(): content for content in contents}
    message = first or broker.receive()
    while isinstance(message, m.AssetGet):
        content = by_digest[message.digest]
        chunk = content[message.offset : message.offset + MAX_ASSET_CHUNK]
        data = m.AssetData(digest=message.digest, offset=message.offset, size=len(content))
        broker.send(data, chunk)
        message = broker.receive()
    return message


def test_scenery_is_fetched_chunk_by_chunk_and_only_once(broker: Broker, tmp_path: Path) -> None:
    files = {"a.ply": os.urandom(MAX_ASSET_CHUNK + 3), "scenery/empty": b""}
    for fetches in (True, False):
        with service(broker.endpoint, cache=tmp_path) as process:
            broker.welcome()
            broker.prepare(manifest(files))
            first = broker.receive()
            assert isinstance(first, m.AssetGet) == fetches
            ready = deliver(broker, list(files.values()), first)
            assert isinstance(ready, m.Ready)
            assert ready.geometry == geometry_digest(manifest(files))
            assert ready.notes == (f"a.ply={files['a.ply'][:20]!r}", "scenery/empty=b''")
            broker.shutdown()
            ends(process, 0)


def test_a_truncated_file_in_the_cache_is_fetched_again(broker: Broker, tmp_path: Path) -> None:
    files = {"a.ply": b"plaza"}
    (asset,) = manifest(files)
    folder = tmp_path / "caviar" / "assets"
    folder.mkdir(parents=True)
    (folder / asset.digest).write_bytes(b"pla")
    with service(broker.endpoint, cache=tmp_path):
        broker.welcome()
        broker.prepare((asset,))
        ready = deliver(broker, [b"plaza"])
        assert isinstance(ready, m.Ready)
        assert ready.notes == ("a.ply=b'plaza'",)


BAD_DATA = {
    "digest": ({}, b"plazA", "announced was"),
    "offset": ({"offset": 1}, b"laza", "expected them at 0"),
    "nothing": ({}, b"", "got 0 B"),
}


@pytest.mark.parametrize(("change", "chunk", "words"), BAD_DATA.values(), ids=BAD_DATA)
def test_wrong_scenery_is_a_fault(
    broker: Broker, tmp_path: Path, change: dict[str, int], chunk: bytes, words: str
) -> None:
    (asset,) = manifest({"a.ply": b"plaza"})
    with service(broker.endpoint, cache=tmp_path):
        broker.welcome()
        broker.prepare((asset,))
        broker.expect(m.AssetGet)
        data = m.AssetData(digest=asset.digest, offset=0, size=5)
        broker.send(msgspec.structs.replace(data, **change), chunk)
        fault = broker.expect(m.Fault)
        assert fault.phase == "prepare"
        assert "'a.ply'" in fault.message
        assert words in fault.message


def test_scenery_that_the_broker_does_not_have_is_a_fault(broker: Broker, tmp_path: Path) -> None:
    (asset,) = manifest({"a.ply": b"plaza"})
    with service(broker.endpoint, cache=tmp_path):
        broker.welcome()
        broker.prepare((asset,))
        get = broker.expect(m.AssetGet)
        broker.send(m.Error(code="unknown-asset", of="ASSET_GET", subject=get.digest, message="not here"))
        assert "cannot deliver asset 'a.ply': not here" in broker.expect(m.Fault).message


def test_scenery_that_never_comes_is_a_fault_in_time(broker: Broker, tmp_path: Path) -> None:
    (asset,) = manifest({"a.ply": b"plaza"})
    with service(broker.endpoint, "sensors:Sensors", "--connect-timeout", "3", cache=tmp_path):
        broker.welcome()
        broker.prepare((asset,))
        broker.expect(m.AssetGet)
        started = time.monotonic()
        assert broker.expect(m.Fault).phase == "prepare"
        assert 2.5 < time.monotonic() - started < 30.0


def test_shutdown_while_scenery_is_fetched_is_obeyed(broker: Broker, tmp_path: Path) -> None:
    with service(broker.endpoint, cache=tmp_path) as process:
        broker.welcome()
        broker.prepare(manifest({"a.ply": b"plaza"}))
        broker.expect(m.AssetGet)
        broker.shutdown()
        ends(process, 0)


def test_a_world_offers_its_scenery_and_serves_it(broker: Broker, tmp_path: Path) -> None:
    with service(broker.endpoint, "world:World", cache=tmp_path) as process:
        broker.welcome()
        broker.prepare()
        offer = broker.expect(m.AssetOffer)
        assert offer.assets == manifest({"empty": b"", "scenery/town.xml": b"<scene/>"})
        ready = broker.expect(m.Ready)
        assert ready.geometry == geometry_digest(offer.assets)
        assert (ready.prefixes, ready.notes) == (("town/",), ("empty", "scenery/town.xml"))
        for asset, content in zip(offer.assets, (b"", b"<scene/>"), strict=True):
            broker.send(m.AssetGet(digest=asset.digest))
            data = broker.expect(m.AssetData)
            assert (data.digest, data.offset, data.size) == (asset.digest, 0, len(content))
            assert broker.parts == [content]
        broker.send(m.AssetGet(digest="0" * 64))
        error = broker.expect(m.Error)
        assert (error.code, error.subject) == ("unknown-asset", "0" * 64)
        broker.shutdown()
        ends(process, 0)


def test_a_world_whose_names_lead_out_of_the_folder_is_a_fault(broker: Broker, tmp_path: Path) -> None:
    with service(broker.endpoint, "world:World", cache=tmp_path):
        broker.welcome(settings={"wrong": "name"})
        broker.prepare()
        assert "'../escape.ply' is not a relative path" in broker.expect(m.Fault).message
        assert not (tmp_path / "caviar" / "escape.ply").exists()
