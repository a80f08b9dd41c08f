"""Large parts between two processes of one host: through ipc sockets, and as slots of shared memory.

    python tests/bench/bench_shared_memory.py [--repeat N] [--markdown FILE]

Parts go through a ROUTER in a process of its own, as through the broker. With shared memory they are copied
into a slot of a ring, and the slot's number goes through the sockets. The consumer reads every byte. The
producer waits for the answer to each part, as a service that waits for its grant does, or has four on their
way. Ways take turns; medians of their rates.
"""

# ruff: noqa: T201 - what it measures is printed

from __future__ import annotations

import argparse
import multiprocessing
import tempfile
import time
from contextlib import ExitStack
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path

import numpy as np
import zmq

SIZES_MIB, WINDOWS = (1, 4), (1, 4)
SECONDS = 2.0
PRODUCER, CONSUMER, END = b"p", b"c", b"end"


def route(address: str) -> None:
    """Pass on what the producer and the consumer send each other, until the producer's last word."""
    with zmq.Context() as context, context.socket(zmq.ROUTER) as socket:
        socket.bind(address)
        known: set[bytes] = set()
        while len(known) < 2:  # a word to one that is not there yet would be lost
            known.add(socket.recv_multipart()[0])
        socket.send_multipart([PRODUCER, b"both are there"])
        while True:
            sender, *parts = socket.recv_multipart(copy=False)
            receiver = CONSUMER if sender.bytes == PRODUCER else PRODUCER
            socket.send_multipart([receiver, *parts], copy=False)
            if parts[0].bytes == END:
                return


def consume(address: str, name: str, size: int) -> None:
    """Read every part, which is a message or in a slot of the named memory, and answer it."""
    shared = SharedMemory(name) if name else None
    with zmq.Context() as context, context.socket(zmq.DEALER) as socket:
        socket.identity = CONSUMER
        socket.connect(address)
        socket.send(b"here")
        while (parts := socket.recv_multipart(copy=False))[0].bytes != END:
            if shared is None:
                words = np.frombuffer(parts[1].buffer, np.uint64)
            else:
                words = np.ndarray(size // 8, np.uint64, shared.buf, int(parts[0].bytes) * size)
            int(words.sum())
            del words, parts
            socket.send(b"read")
    if shared is not None:
        shared.close()


def rate(size: int, window: int, with_memory: bool, folder: str) -> float:
    """Delivered bytes a second of parts of a size, with so many on their way."""
    address = f"ipc://{folder}/socket"
    shared = SharedMemory(create=True, size=size * (window + 1)) if with_memory else None
    name = shared.name if shared else ""
    others = [
        multiprocessing.Process(target=route, args=(address,)),
        multiprocessing.Process(target=consume, args=(address, name, size)),
    ]
    content = np.random.default_rng(0).integers(0, 255, size, np.uint8)
    with ExitStack() as ended:
        if shared is not None:
            ended.callback(shared.unlink)
            ended.callback(shared.close)
        for other in others:
            ended.callback(other.kill)
        socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.DEALER)
        ended.callback(socket.close, 0)
        socket.identity, socket.rcvtimeo = PRODUCER, 30_000  # one of the others may have ended
        socket.connect(address)
        for other in others:
            other.start()
        socket.send(b"here")
        socket.recv()
        began, sent, waiting = time.perf_counter(), 0, 0
        while time.perf_counter() - began < SECONDS:
            part = content.copy()  # a producer makes its part anew in each frame
            slot = sent % (window + 1)
            if shared is None:
                socket.send_multipart([b"%d" % slot, part.data], copy=False)
            else:
                np.ndarray(size, np.uint8, shared.buf, slot * size)[:] = part
                socket.send(b"%d" % slot)
            sent, waiting = sent + 1, waiting + 1
            while waiting >= window:
                socket.recv()
                waiting -= 1
        for _ in range(waiting):
            socket.recv()
        taken = time.perf_counter() - began
        socket.send(END)
        for other in others:
            other.join(10)
    return sent * size / taken


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--markdown", type=Path, help="where the figures go as a table")
    options = parser.parse_args()
    lines = ["| parts | on their way | ipc, MB/s | shared memory, MB/s | ratio |"]
    lines.append("| --- | ---: | ---: | ---: | ---: |")
    for size in SIZES_MIB:
        for window in WINDOWS:
            rates: tuple[list[float], list[float]] = ([], [])
            for _ in range(options.repeat):
                for with_memory in (False, True):
                    with tempfile.TemporaryDirectory() as folder:
                        rates[with_memory].append(rate(size << 20, window, with_memory, folder) / 1e6)
            ipc, memory = (float(np.median(of)) for of in rates)
            lines.append(f"| {size} MiB | {window} | {ipc:,.0f} | {memory:,.0f} | {memory / ipc:.1f} |")
            print(lines[-1], flush=True)
    if options.markdown:
        options.markdown.write_text("## Shared memory\n\n" + "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
