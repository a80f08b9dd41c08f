"""The decoder against wrong inputs, and against those that aim at memory or the stack."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import tracemalloc
from pathlib import Path

import decoder_fuzzer
import pytest

from caviar_protocol.codec import decode_message, decode_payload
from caviar_protocol.errors import DecodeError, LimitError, ProtocolError
from caviar_protocol.fields import MAX_HEADER

SEED = 6


@pytest.mark.parametrize("inputs", [50_000, pytest.param(1_000_000, marks=pytest.mark.exhaustive)])
@pytest.mark.skipif(sys.platform != "linux", reason="bounds memory with what Linux tells")
def test_wrong_inputs_raise_only_our_error_in_bounded_memory(inputs: int) -> None:
    """The process may take 256 MiB more than at its start; an input may take 1 s."""
    fuzzer = Path(decoder_fuzzer.__file__)
    result = subprocess.run(
        [sys.executable, fuzzer, "--inputs", str(inputs), "--seed", str(SEED)],
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert result.returncode == 0, result.stderr[-4000:]
    report = json.loads(result.stdout)
    assert report["inputs"] == inputs
    assert report["accepted"] > inputs // 50, "mutations that are always refused test little"
    assert report["grown_kib"] < 64 << 10


def test_the_fuzzer_names_seed_and_input_of_what_it_finds(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(header: bytes) -> None:
        raise UnicodeDecodeError("utf-8", header, 0, 1, "as a decoder might that forgot to convert it")

    monkeypatch.setattr(decoder_fuzzer, "decode_message", broken)
    with pytest.raises(UnicodeDecodeError):
        decoder_fuzzer.fuzz(decoder_fuzzer.Mutator(3, [("", b"\x81\xa1x\x01", b"")]), 10)
    printed = capsys.readouterr().err
    assert printed.startswith("seed 3, input 0, topic ''")
    assert "header " in printed


def test_equal_seeds_make_equal_inputs() -> None:
    corpus = decoder_fuzzer.seeds()
    first, second = (decoder_fuzzer.Mutator(11, corpus) for _ in range(2))
    inputs = [first.input() for _ in range(200)]
    assert inputs == [second.input() for _ in range(200)]
    assert len(set(inputs)) > 190


def welcome(settings: bytes) -> bytes:
    """A WELCOME whose settings are one entry with these bytes."""
    fields = b"\xa4type\xa7WELCOME\xa7version\x92\x01\x00\xa3run\xa1r\xa5epoch\x01\xa7attempt\x01"
    return b"\x88" + fields + b"\xacheartbeat_ns\x01\xabliveness_ns\x01\xa8settings\x81\xa1x" + settings


@pytest.mark.parametrize(
    ("item", "what"),
    [(b"\x80", "maps"), (b"\x90", "arrays"), (b"\xa0", "texts"), (b"\x91\x90", "arrays in arrays")],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_header_takes_at_most_a_hundred_times_its_size(item: bytes, what: str) -> None:
    """Full of the smallest items; so a header of the largest size cannot cost more than 100 MiB."""
    count = 100_000
    header = welcome(b"\xdd" + count.to_bytes(4, "big") + item * count)
    tracemalloc.start()
    try:
        decode_message(header)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 100 * len(header), what


@pytest.mark.parametrize("marker", [b"\xdd", b"\xdf", b"\xdb", b"\xc6", b"\xc9"], ids=bytes.hex)
def test_a_lying_length_allocates_nothing(marker: bytes) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(DecodeError):
            decode_message(welcome(marker + b"\xff\xff\xff\xff"))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 1 << 20


@pytest.mark.parametrize("depth", [1000, 100_000, 1_000_000])
@pytest.mark.parametrize("known", [True, False], ids=["settings", "unknown field"])
def test_deep_nesting_is_a_limit_and_no_overflow_of_the_stack(depth: int, known: bool) -> None:
    header = welcome(b"\x91" * depth + b"\xc0")
    with pytest.raises(LimitError):
        decode_message(header if known else header.replace(b"settings", b"sittings"))


def test_deep_nesting_is_survived_on_the_small_stack_of_a_thread() -> None:
    """The heartbeat thread decodes too."""
    caught: list[ProtocolError] = []

    def decode() -> None:
        try:
            decode_message(welcome(b"\x91" * 1_000_000 + b"\xc0"))
        except ProtocolError as error:
            caught.append(error)

    before = threading.stack_size(128 << 10)
    try:
        thread = threading.Thread(target=decode)
        thread.start()
        thread.join(30)
    finally:
        threading.stack_size(before)
    assert isinstance(caught[0], LimitError)


def test_a_header_beyond_the_limit_is_refused_unread() -> None:
    with pytest.raises(LimitError, match="1048577 B"):
        decode_message(bytes(MAX_HEADER + 1))
    with pytest.raises(LimitError, match="1048577 B"):
        decode_payload("scene", bytes(MAX_HEADER + 1), b"")
