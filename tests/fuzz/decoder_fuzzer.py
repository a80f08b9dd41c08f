"""Feeds the decoder random and mutated bytes; run as a script, in processes of its own.

    python decoder_fuzzer.py [--inputs 1000000] [--seed 6] [--processes 2] [--memory-mib 256]

Inputs are made of the vectors: as bytes, and as what those bytes say, with values, keys and types
exchanged. Prints a JSON report, and while it works how far it has come. Whatever comes out of the decoder
other than a `ProtocolError`, takes long, or does not survive its own round trip, ends it with a line that
names seed, index and input.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import json
import multiprocessing
import os
import resource
import sys
import time
from pathlib import Path
from typing import Any

import msgpack  # type: ignore[import-untyped]
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

VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 2**31, 2**63 - 1, 2**64 - 1, -(2**63), 0.0, -0.0, 1e308, -1e-320),
    *(float("nan"), float("inf"), -float("inf"), "", "a", "\x00", "é" * 40, "x" * 300, b"", b"\xff" * 9),
    *(
        [],
        {},
        [[]],
        {"": 0},
        [0] * 20,
        {"type": "HELLO"},
        msgpack.ExtType(5, b"abc"),
        msgpack.Timestamp(1, 2),
    ),
)
"""What may stand where something else was expected."""
CHUNK = 10_000
"""Inputs that are made of one seed."""
PROGRESS_S = 5.0
"""[s] between reports of progress."""

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

    def __init__(self, seed: int | tuple[int, int], corpus: list[Seed]) -> None:
        self.seed = seed
        self._rng = np.random.default_rng(seed)
        self._corpus = corpus
        self._trees = {header: tree for _, header, _ in corpus if (tree := _tree(header))}
        self._others = list(self._trees.values())
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
            tree = self._trees.get(header)
            header = self.restructured(header, tree) if tree and self.draw(3) == 0 else self.mutated(header)
        if which < 2:
            body = self.mutated(body)
        if self.draw(64) == 0:
            topic = TOPICS[self.draw(len(TOPICS))]
        return topic, header, body

    def restructured(self, header: bytes, tree: dict[Any, Any]) -> bytes:
        """What a header says, with one or two things in it exchanged, taken out, or said twice."""
        tree = copy.deepcopy(tree)
        for _ in range(1 + self.draw(2)):
            holder: Any = tree
            while holder:
                keys = list(holder) if isinstance(holder, dict) else range(len(holder))
                key = keys[self.draw(len(keys))]
                inner = holder[key]
                if not isinstance(inner, dict | list) or not inner or self.draw(4) == 0:
                    self._exchange(holder, key)
                    break
                holder = inner
        try:
            return bytes(msgpack.packb(tree))
        except ValueError:  # deep things within deep things, which the packer refuses
            return self.mutated(header)

    def _exchange(self, holder: Any, key: Any) -> None:
        kind = self.draw(6)
        if kind == 0:
            del holder[key]
        elif kind == 1 and isinstance(holder, list):
            holder.insert(key, copy.deepcopy(holder[key]))
        elif kind == 1:
            holder[f"{key}x"] = holder.pop(key)
        elif kind == 2:
            values = list(self._others[self.draw(len(self._others))].values())
            holder[key] = copy.deepcopy(values[self.draw(len(values))])
        elif kind == 3 and isinstance(holder[key], int):
            holder[key] = min(2**64 - 1, max(-(2**63), holder[key] + self.draw(5) - 2))
        else:
            holder[key] = copy.deepcopy(VALUES[self.draw(len(VALUES))])

    def mutated(self, data: bytes) -> bytes:
        """Other bytes, of these: cut, spliced, repeated, overwritten."""
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


def _tree(header: bytes) -> dict[Any, Any] | None:
    """What a header says; None where it is no map, or an empty one."""
    try:
        tree = msgpack.unpackb(header, strict_map_key=False)
    except (ValueError, msgpack.UnpackException):
        return None
    return tree if isinstance(tree, dict) and tree else None


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


def _bound_memory(memory_mib: int) -> None:
    """This process may take so much more memory than now."""
    fuzz(Mutator(0, seeds()), 1000)
    in_use = int(Path("/proc/self/statm").read_text("ascii").split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (in_use + (memory_mib << 20),) * 2)


def _chunk(job: tuple[int, int, int]) -> tuple[int, int, float, int]:
    """Feed one chunk: inputs, how many were accepted, the longest time [s], growth of the process [KiB]."""
    seed, number, count = job
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    accepted, slowest = fuzz(Mutator((seed, number), seeds()), count)
    return count, accepted, slowest, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before


def run(inputs: int, seed: int, processes: int, memory_mib: int) -> dict[str, float]:
    """Feed so many inputs; the report."""
    jobs = [(seed, n, min(CHUNK, inputs - n * CHUNK)) for n in range(-(-inputs // CHUNK))]
    began = told = time.monotonic()
    done = accepted = grown = 0
    slowest = 0.0
    context = multiprocessing.get_context("spawn")
    with context.Pool(processes, _bound_memory, (memory_mib,)) as pool:
        for count, good, took, more in pool.imap_unordered(_chunk, jobs):
            done, accepted, grown, slowest = done + count, accepted + good, grown + more, max(slowest, took)
            now = time.monotonic()
            if now - told > PROGRESS_S:
                told, rate = now, done / (now - began)
                sys.stderr.write(
                    f"{done} of {inputs} inputs, {rate:.0f} /s, {(inputs - done) / rate:.0f} s left\n"
                )
    return {
        "inputs": done,
        "accepted": accepted,
        "slowest_s": slowest,
        "grown_kib": grown,
        "seconds": time.monotonic() - began,
    }


def main() -> int:
    """What the command line says; 0 when all went as it should."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--inputs", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=6)
    parser.add_argument("--processes", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--memory-mib", type=int, default=256)
    arguments = parser.parse_args()
    report = run(arguments.inputs, arguments.seed, arguments.processes, arguments.memory_mib)
    sys.stdout.write(json.dumps(report) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
