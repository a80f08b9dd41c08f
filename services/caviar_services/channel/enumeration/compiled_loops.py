"""Loops that Numba compiles: each for one signature, before the first frame, and kept on disk between runs.

No frame waits for a compiler, since a loop takes no other types than those of its signature. There are no
threads, no reassociated sums and no fused products, so that results are the same bits on every processor.

Numba's cache on disk looks at the date of a loop's own file and not at those of what the loop takes from
elsewhere: so a module of loops calls no compiled function of another one, and has constants of others as
arguments.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from threading import Lock
from typing import Any, TypeVar

from caviar_protocol.errors import SetupError
from caviar_protocol.host import install_command

try:
    import numba
except ImportError:  # on the base install, where nothing calls the loops
    numba = None

F = TypeVar("F", bound=Callable[..., Any])

_OPTIONS = {"nogil": True, "error_model": "numpy"}
_MODULES = ("beam_kernels", "path_kernels")
_loops: list[tuple[Any, str, bool]] = []
_lock = Lock()


def compiled(function: F) -> F:
    """Have a function compiled into each loop that calls it; without Numba it stays as it is."""
    made: F = function if numba is None else numba.njit(forceinline=True, **_OPTIONS)(function)
    return made


def vectorized(function: F) -> F:
    """As `compiled`, of a loop over arrays, compiled on its own: within another loop, a compiler cannot tell
    that its arrays do not overlap, and takes one element at a time."""
    made: F = function if numba is None else numba.njit(**_OPTIONS)(function)
    return made


def loop(signature: str, edges: bool = False) -> Callable[[F], F]:
    """Have a function compiled by `compile_loops` for these types of arguments; ``edges``: only where waves
    are diffracted."""

    def decorate(function: F) -> F:
        if numba is None:
            return function
        try:
            made = numba.njit(cache=True, **_OPTIONS)(function)
        except RuntimeError:  # Numba has no folder that it may write to
            made = numba.njit(**_OPTIONS)(function)
        _loops.append((made, signature, edges))
        kept: F = made
        return kept

    return decorate


def compile_loops(progress: Callable[[int, int], None], edges: bool = True) -> None:
    """Compile loops, a quarter of a minute for all, or read from disk what was compiled before.

    Args:
        progress: Called before each loop with its number, from 0, and the count of loops.
        edges: Whether those of edges are wanted, too.

    Raises:
        SetupError: Numba is not installed.
    """
    if numba is None:
        raise SetupError(
            'candidates = "enumerated" needs Numba, which is not installed; add it: '
            f"{install_command('channel')}"
        )
    for name in _MODULES:
        import_module(f"{__package__}.{name}")
    with _lock:  # services of an embedded run are prepared at once
        wanted = [entry for entry in _loops if edges or not entry[2]]
        for number, (made, signature, of_edges) in enumerate(wanted):
            progress(number, len(wanted))
            made.compile(signature)
            made.disable_compile()
            _loops.remove((made, signature, of_edges))
