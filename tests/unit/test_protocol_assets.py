"""Content-addressed files: verified, refetched when damaged, and never outside their folder."""

from __future__ import annotations

import hashlib
import os
import threading
from pathlib import Path

import pytest

from caviar_protocol.assets import MAX_ASSET, AssetStore, IncomingAsset, default_folder
from caviar_protocol.errors import AssetError, SetupError
from caviar_protocol.fields import MAX_ASSET_CHUNK
from caviar_protocol.messages import Asset


@pytest.fixture
def store(tmp_path: Path) -> AssetStore:
    return AssetStore(tmp_path / "cache")


def reopened(store: AssetStore) -> AssetStore:
    """The same folder as another process finds it."""
    return AssetStore(store.folder)


def described(name: str, content: bytes) -> Asset:
    return Asset(name=name, digest=hashlib.sha256(content).hexdigest(), size=len(content))


def test_a_file_is_kept_under_its_digest_and_read_back_in_chunks(store: AssetStore, tmp_path: Path) -> None:
    content = os.urandom(MAX_ASSET_CHUNK + 17)
    (tmp_path / "mesh.ply").write_bytes(content)
    asset = store.add("scenery/mesh.ply", tmp_path / "mesh.ply")
    assert asset == described("scenery/mesh.ply", content)
    assert store.holds(asset)
    assert store.read(asset.digest, 0) == (content[:MAX_ASSET_CHUNK], len(content))
    assert store.read(asset.digest, MAX_ASSET_CHUNK) == (content[MAX_ASSET_CHUNK:], len(content))
    assert store.read(asset.digest, len(content)) == (b"", len(content))
    with pytest.raises(AssetError, match="there is nothing at"):
        store.read(asset.digest, len(content) + 1)
    with pytest.raises(AssetError, match="is not here"):
        store.read("0" * 64, 0)


@pytest.mark.parametrize("damage", [b"", b"pla", b"plague", b"plaza and more"])
def test_a_damaged_file_is_not_believed_and_is_replaced(store: AssetStore, damage: bytes) -> None:
    """Truncated, emptied, changed in place, or grown: what a full disk or a crash leaves."""
    asset = store.add("a.ply", b"plaza!")
    store.path(asset.digest).write_bytes(damage)
    other = reopened(store)
    assert not other.holds(asset)
    with pytest.raises(AssetError, match=r"'a\.ply'.*was never fetched"):
        other.folder_of([asset])
    assert other.add("a.ply", b"plaza!") == asset
    assert other.holds(asset)
    assert other.path(asset.digest).read_bytes() == b"plaza!"


def test_a_file_that_is_truncated_while_it_is_used_is_noticed_by_its_size(store: AssetStore) -> None:
    asset = store.add("a.ply", b"plaza!")
    assert store.holds(asset)
    os.truncate(store.path(asset.digest), 2)
    assert not store.holds(asset)


def test_a_laid_out_folder_with_a_damaged_file_is_mended(store: AssetStore) -> None:
    manifest = [store.add("scenery/town.xml", b"<scene/>"), store.add("scenery/meshes/a.ply", b"plaza!")]
    laid_out = store.folder_of(manifest)
    laid_out["scenery/meshes/a.ply"].unlink()
    laid_out["scenery/town.xml"].unlink()
    laid_out["scenery/town.xml"].write_bytes(b"<scene>")
    again = reopened(store).folder_of(manifest)
    assert again == laid_out
    assert {name: path.read_bytes() for name, path in again.items()} == {
        "scenery/town.xml": b"<scene/>",
        "scenery/meshes/a.ply": b"plaza!",
    }


def test_damage_through_a_laid_out_file_reaches_nobody(store: AssetStore) -> None:
    """A laid out file may be the stored one (a hard link); writing to it damages both."""
    asset = store.add("a.ply", b"plaza!")
    store.folder_of([asset])["a.ply"].write_bytes(b"graffiti")
    other = reopened(store)
    assert not other.holds(asset)
    other.add("a.ply", b"plaza!")
    assert other.folder_of([asset])["a.ply"].read_bytes() == b"plaza!"


def test_files_lie_at_their_relative_names_in_one_folder(store: AssetStore) -> None:
    manifest = [store.add("scenery/town.xml", b"x"), store.add("scenery/meshes/a.ply", b"y")]
    paths = store.folder_of(manifest)
    assert paths["scenery/meshes/a.ply"] == paths["scenery/town.xml"].parent / "meshes" / "a.ply"
    other = store.folder_of(manifest[:1])
    assert other["scenery/town.xml"] != paths["scenery/town.xml"]
    assert [p.name for p in store.folder.rglob("*") if "staged" in p.name or p.suffix == ".partial"] == []


def test_one_folder_laid_out_by_many_threads_at_once_is_whole(store: AssetStore) -> None:
    manifest = [store.add(f"meshes/{number}.ply", str(number).encode()) for number in range(40)]
    barrier, failures = threading.Barrier(4), list[BaseException]()

    def lay_out() -> None:
        try:
            mine = reopened(store)
            barrier.wait(10)
            for name, path in mine.folder_of(manifest).items():
                assert path.read_bytes() == Path(name).stem.encode()
        except BaseException as error:
            failures.append(error)
            raise

    threads = [threading.Thread(target=lay_out) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(20)
    assert failures == []


@pytest.mark.parametrize(
    "name", ["../a", "/etc/passwd", "a/../../b", "a//b", "./a", "a/.", "a\\b", "", "a\0b", "a\n", "x" * 256]
)
def test_no_name_leads_out_of_the_folder(store: AssetStore, name: str) -> None:
    with pytest.raises(AssetError, match="is not a relative path"):
        store.add(name, b"x")
    digest = store.add("ok", b"x").digest
    with pytest.raises(AssetError, match="is not a relative path"):
        store.folder_of([Asset(name=name, digest=digest, size=1)])


def test_a_name_that_is_also_a_folder_is_an_error_that_names_it(store: AssetStore) -> None:
    manifest = [store.add("a", b"x"), store.add("a/b", b"y")]
    with pytest.raises(AssetError, match="cannot lay out 'a/b'"):
        store.folder_of(manifest)


def test_a_file_that_cannot_be_read_is_named(store: AssetStore, tmp_path: Path) -> None:
    with pytest.raises(AssetError, match=r"'a\.ply'.*nowhere\.ply.*No such file"):
        store.add("a.ply", tmp_path / "nowhere.ply")


def test_a_cache_that_cannot_be_made_names_the_remedy(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(SetupError, match="export XDG_CACHE_HOME"):
        AssetStore(tmp_path / "file" / "cache")


def test_the_cache_is_where_the_user_keeps_caches(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_folder() == tmp_path / "caviar"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", "/home/somebody")
    assert default_folder() == Path("/home/somebody/.cache/caviar")


def test_chunks_become_a_file(store: AssetStore) -> None:
    asset = described("a", b"abcdef")
    incoming = IncomingAsset(store, asset)
    assert not incoming.add_chunk(0, 6, b"abc")
    assert incoming.offset == 3
    assert not store.holds(asset)
    assert incoming.add_chunk(3, 6, memoryview(b"def"))
    assert store.holds(asset)


def test_an_empty_file_is_one_empty_chunk(store: AssetStore) -> None:
    asset = described("empty", b"")
    assert IncomingAsset(store, asset).add_chunk(0, 0, b"")
    assert store.folder_of([asset])["empty"].read_bytes() == b""


@pytest.mark.parametrize(
    ("offset", "size", "chunk"),
    [(1, 6, b"abc"), (0, 7, b"abc"), (0, 6, b""), (0, 6, b"abcdefg")],
    ids=["wrong offset", "wrong size", "nothing", "too much"],
)
def test_a_chunk_that_is_not_the_next_one_is_refused(
    store: AssetStore, offset: int, size: int, chunk: bytes
) -> None:
    with pytest.raises(AssetError, match="expected them at 0 of 6 B"):
        IncomingAsset(store, described("a", b"abcdef")).add_chunk(offset, size, chunk)


def test_content_of_another_digest_is_refused_and_not_kept(store: AssetStore) -> None:
    asset = described("a", b"abcdef")
    with pytest.raises(AssetError, match=f"announced was {asset.digest}"):
        IncomingAsset(store, asset).add_chunk(0, 6, b"abcdeF")
    assert list((store.folder / "assets").iterdir()) == []


def test_a_file_larger_than_any_may_be_is_refused_before_it_comes(store: AssetStore) -> None:
    with pytest.raises(AssetError, match=f"has {MAX_ASSET + 1} B"):
        IncomingAsset(store, Asset(name="a", digest="0" * 64, size=MAX_ASSET + 1))
