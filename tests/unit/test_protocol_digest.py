"""Digests of products, scenery and runs, against the words of SPEC.md."""

from __future__ import annotations

import hashlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from caviar_protocol.digest import RunDigest, geometry_digest, payload_digest
from caviar_protocol.messages import Asset

DIGEST = st.binary(min_size=32, max_size=32).map(bytes.hex)
PRODUCT = st.tuples(st.sampled_from(["scene", "link"]), st.sampled_from(["a", "b", "c"]), DIGEST)


def sha256(*data: bytes) -> bytes:
    """SHA-256 of the concatenation."""
    return hashlib.sha256(b"".join(data)).digest()


@given(st.binary(max_size=40), st.binary(max_size=40))
def test_a_product_digest_covers_length_header_and_body(header: bytes, body: bytes) -> None:
    length = len(header).to_bytes(8, "little")
    assert payload_digest(header, body) == sha256(length, header, body).hex()
    assert payload_digest(memoryview(header), memoryview(body)) == payload_digest(header, body)


@given(st.binary(min_size=1, max_size=20), st.binary(max_size=20), st.data())
def test_the_border_between_header_and_body_counts(header: bytes, body: bytes, data: st.DataObject) -> None:
    both, border = header + body, len(header)
    other = data.draw(st.integers(0, len(both)).filter(lambda cut: cut != border))
    assert payload_digest(both[:border], both[border:]) != payload_digest(both[:other], both[other:])


def asset(name: str, content: bytes) -> Asset:
    """An asset as a world announces it."""
    return Asset(name=name, digest=hashlib.sha256(content).hexdigest(), size=len(content))


def test_geometry_is_that_of_the_assets_in_any_order() -> None:
    a, b = asset("scenery/a.ply", b"a"), asset("scenery/b.ply", b"b")
    stated = f"scenery/a.ply\0{a.digest}\0scenery/b.ply\0{b.digest}\0".encode()
    assert geometry_digest([b, a]) == geometry_digest([a, b]) == sha256(stated).hex()
    assert geometry_digest([a, asset("scenery/b.ply", b"B")]) != geometry_digest([a, b])
    assert geometry_digest([]) == ""


def chain(*frames: tuple[int, int, list[tuple[str, str, str]]]) -> str:
    """Run digest of frames."""
    run = RunDigest()
    for episode, frame, products in frames:
        run.add_frame(episode, frame, products)
    return run.hexdigest()


@pytest.mark.parametrize("every", [1, 3, 1000])
def test_when_frames_are_hashed_does_not_matter(every: int) -> None:
    """Also where more frames wait than `RunDigest` keeps."""
    frames = [(0, k, [("scene", "a", f"{k:064x}"), ("link", "b", f"{k:064x}")]) for k in range(200)]
    run, expected = RunDigest(), hashlib.sha256(b"caviar-run-1").digest()
    for episode, frame, products in frames:
        run.add_frame(episode, frame, products)
        if frame % every == 0:
            run.fold()
        for topic, source, digest in sorted(products):
            stated = f"{episode}\0{frame}\0{topic}\0{source}\0".encode()
            expected = sha256(expected, stated, bytes.fromhex(digest))
    assert run.hexdigest() == expected.hex()


def test_a_run_without_products_has_the_digest_of_the_name_of_the_chain() -> None:
    assert RunDigest().hexdigest() == hashlib.sha256(b"caviar-run-1").hexdigest()


def test_a_link_of_the_chain_is_as_specified() -> None:
    digest = "ab" * 32
    start = sha256(b"caviar-run-1")
    expected = sha256(start, b"2\x0017\0scene\0traffic\0", bytes.fromhex(digest))
    assert chain((2, 17, [("scene", "traffic", digest)])) == expected.hex()


@given(st.lists(PRODUCT, max_size=6, unique_by=lambda p: p[:2]), st.randoms(use_true_random=False))
def test_the_order_of_arrival_in_a_frame_does_not_count(
    products: list[tuple[str, str, str]], rng: object
) -> None:
    shuffled = list(products)
    rng.shuffle(shuffled)  # type: ignore[attr-defined]
    assert chain((0, 0, shuffled)) == chain((0, 0, products))


@pytest.mark.parametrize(
    "other",
    [
        (1, 5, [("scene", "a", "00" * 32)]),
        (0, 6, [("scene", "a", "00" * 32)]),
        (0, 5, [("link", "a", "00" * 32)]),
        (0, 5, [("scene", "b", "00" * 32)]),
        (0, 5, [("scene", "a", "01" + "00" * 31)]),
        (0, 5, []),
    ],
)
def test_everything_that_identifies_a_product_counts(
    other: tuple[int, int, list[tuple[str, str, str]]],
) -> None:
    assert chain(other) != chain((0, 5, [("scene", "a", "00" * 32)]))


def test_the_order_of_frames_counts() -> None:
    first, second = (0, 0, [("scene", "a", "00" * 32)]), (0, 1, [("scene", "a", "00" * 32)])
    assert chain(first, second) != chain(second, first)
