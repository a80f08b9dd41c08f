"""How many threads the ray tracer of a process computes with.

Left alone, Dr.Jit takes as many as the machine has cores, and each of them looks for work for a while behind
every kernel. Services that trace rays side by side then take the cores from one another: on two cores, in
`street-canyon`, the channel's frame took 65 ms of processor time with two threads and 39 ms with one, the
LIDAR's 19 ms and 11 ms. So `caviar run` shares the cores out among them.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from caviar_protocol.errors import SetupError

ENVIRONMENT = "CAVIAR_RAY_TRACING_THREADS"
"""Environment variable that says how many; without it they are as many as the cores."""


def cores() -> int:
    """That this process may run on."""
    return len(os.sched_getaffinity(0))


def share_of_each(tracers: int) -> int:
    """Threads for each of so many processes that trace rays on this machine at once."""
    return max(1, cores() // max(1, tracers))


def limited_threads(environment: Mapping[str, str] = os.environ) -> int:
    """As many threads as `ENVIRONMENT` says; 0 where it says nothing. `SetupError` where it is no number."""
    text = environment.get(ENVIRONMENT, "")
    if not text:
        return 0
    if not (text.isascii() and text.isdecimal() and int(text) > 0):
        raise SetupError(f"{ENVIRONMENT} is {text!r}; write a number of threads from 1 on, or unset it")
    return int(text)


def limit_threads() -> None:
    """Have the ray tracer compute with as many threads as `ENVIRONMENT` says; imports Dr.Jit."""
    import drjit as dr

    threads = limited_threads()
    if threads and dr.thread_count() != threads:
        dr.set_thread_count(threads)


@contextmanager
def all_threads() -> Iterator[None]:
    """All cores, for what others wait for before the first frame."""
    import drjit as dr

    before = dr.thread_count()
    if before < cores():
        dr.set_thread_count(cores())
    try:
        yield
    finally:
        if dr.thread_count() != before:
            dr.set_thread_count(before)
