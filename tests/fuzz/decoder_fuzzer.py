"""Feeds the decoder random and mutated bytes; run as a script, in a process of its own.

    python decoder_fuzzer.py SEED COUNT [MEMORY_MIB]

Prints a JSON report. Whatever comes out of the decoder other than a `ProtocolError`, takes long, or
does not survive its own round trip, ends it with a line that names seed, index and input.
"""

from __future__ import annotations

import contextlib
import json
import resource
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from caviar_protocol.codec import (
    check_parts,
    decode_message,
    decode_payload,
    encode_message,
    encode_payload,
)
from caviar_protocol.errors import PayloadError, ProtocolError
from caviar_protocol.topics import PAYLOADS

FOLDER = Path(__file__).resolve().parents[2] / "protocol" / "vectors"
TOPICS = tuple(PAYLOADS)
SLOW_S = 1.0
"""[s] of processor time that no input may take."""

LYING = [
    bytes([marker]) + fill * 4
    for marker in (*range(0xC4, 0xCA), *range(0xD9, 0xE0))
    for fill in (b"\xff", b"\x7f")
]
"""Length fields that claim far more than there is."""

MARKERS = bytes(
    [0xC0, 0xC1, 0xC2, 0xCA, 0xCB, 0xCF, 0xD3, 0xD4, 0xD8, 0x80, 0x8F, 0x90, 0x9F, 0xA0, 0xBF, 0xFF, 0x7F]
)
"""First bytes of every family of values."""

Seed = tuple[str, bytes, bytes]
"""Topic (empty for a message), header, body."""


def seeds() -> list[Seed]:
    """The vectors, accepted and refused, but for the few that are large."""
    found = []
    for source in sorted(FOLDER.glob("*.json")):
        stated = json.loads(source.read_text("utf-8"))
        header, body = source.with_suffix(".msgpack").read_bytes(), source.with_suffix(".body")
        if len(header) < 10_000:
            found.append((stated.get("topic", ""), header, body.read_bytes() if body.exists() else b""))
    return found


class Mutator:
    """Makes new inputs of old ones; the same seed makes the same inputs."""

    def __init__(self, seed: int, corpus: list[Seed]) -> None:
        self.seed = seed
        self._rng = np.random.default_rng(seed)
        self._corpus = corpus
        self._draws: list[int] = []

    def draw(self, bound: int) -> int:
        """A number from 0 to below ``bound``."""
        if not self._draws:
            self._draws = self._rng.integers(0, 1 << 62, 1 << 16).tolist()
        return self._draws.pop() % bound

    def input(self) -> Seed:
        """The next input."""
        topic, header, body = self._corpus[self.draw(len(self._corpus))]
        which = self.draw(4) if body else 3
        if which != 0:
            header = self._mutated(header)
        if which < 2:
            body = self._mutated(body)
        if self.draw(64) == 0:
            topic = TOPICS[self.draw(len(TOPICS))]
        return topic, header, body

    def _mutated(self, data: bytes) -> bytes:
        kind = self.draw(9)
        if kind == 0:
            return self._rng.bytes(self.draw(64))
        if kind == 1:
            return data[: self.draw(len(data) + 1)]
        if kind == 2:
            other = self._corpus[self.draw(len(self._corpus))][1]
            return data[: self.draw(len(data) + 1)] + other[self.draw(len(other) + 1) :]
        if kind == 3:
            at, lie = self.draw(len(data) + 1), LYING[self.draw(len(LYING))]
            return data[:at] + lie[: 1 + self.draw(5)] + data[at + self.draw(3) :]
        if kind == 4:
            at, length = self.draw(len(data) + 1), self.draw(16)
            return data[:at] + data[at : at + length] * (1 + self.draw(64)) + data[at:]
        if kind == 5:
            at = self.draw(len(data) + 1)
            return data[:at] + self._rng.bytes(1 + self.draw(8)) + data[at:]
        changed = bytearray(data)
        for _ in range(1 + self.draw(2) if changed else 0):
            at = self.draw(len(changed))
            changed[at] = MARKERS[self.draw(len(MARKERS))] if kind == 6 else changed[at] ^ 1 << self.draw(8)
        return bytes(changed)


def feed(topic: str, header: bytes, body: bytes) -> bool:
    """Decode one input as a reader would; True where it was accepted."""
    try:
        decoded: Any = decode_payload(topic, header, body) if topic else decode_message(header)
    except ProtocolError:
        return False
    if not topic:
        again = decode_message(encode_message(decoded))
        if encode_message(again) != encode_message(decoded):
            raise AssertionError("a message changed on its way through the codec")
        with contextlib.suppress(ProtocolError):  # the parts may not fit the header
            check_parts(decoded, [header, body])
        return True
    try:
        first = encode_payload(decoded)
    except PayloadError:
        return True  # it holds a non-finite value, which a writer refuses
    if encode_payload(decode_payload(topic, *first)) != first:
        raise AssertionError("a payload changed on its way through the codec")
    return True


def fuzz(mutator: Mutator, count: int) -> tuple[int, float]:
    """Feed ``count`` inputs; returns how many were accepted and the longest processor time of one [s].

    Whatever is wrong is raised, after its input has been written to stderr.
    """
    accepted, slowest = 0, 0.0
    for index in range(count):
        topic, header, body = mutator.input()
        start = time.process_time()
        try:
            accepted += feed(topic, header, body)
            took = time.process_time() - start
            assert took < SLOW_S, f"it took {took:.1f} s"
            slowest = max(slowest, took)
        except Exception as error:
            sys.stderr.write(
                f"seed {mutator.seed}, input {index}, topic {topic!r}: {type(error).__name__}: {error}\n"
                f"header {header.hex()}\nbody {body.hex()}\n"
            )
            raise
    return accepted, slowest


def main(seed: int, count: int, memory_mib: int) -> int:
    """Feed ``count`` inputs with at most so much more memory than now; 0 when all went as it should."""
    mutator = Mutator(seed, seeds())
    fuzz(mutator, 1000)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    in_use = int(Path("/proc/self/statm").read_text("ascii").split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (in_use + (memory_mib << 20),) * 2)
    accepted, slowest = fuzz(mutator, count)
    report = {
        "inputs": count,
        "accepted": accepted,
        "slowest_s": slowest,
        "grown_kib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before,
    }
    sys.stdout.write(json.dumps(report) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]) if len(sys.argv) > 3 else 256))
