"""Conformance kit for clients in any language: a broker that follows scripts, and a verdict per clause.

It shares no code with the product's broker and reads headers with the plain ``msgpack`` package, so that
it is a second reading of ``protocol/SPEC.md``. Only payloads are judged with `caviar_protocol`'s types.

`conform` takes a client through the cases, one life after another, and collects the verdicts. The cases are
in `lifecycle`, `frames`, `content`, `geometry` and `wrong`. `session` plays the broker for one life of the
client, which `client` starts, with the contents of `street`; `canonical` judges what comes.
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from caviar_labs.conform import content, frames, geometry, lifecycle, wrong
from caviar_labs.conform.case import Case, Kit, Verdict
from caviar_labs.conform.client import ByHand, Client, Rules, Started, Wire
from caviar_protocol.errors import SetupError, suggestion
from caviar_protocol.keys import ROLES

__all__ = ["Case", "Kit", "Rules", "Verdict", "cases", "conform"]


def cases() -> tuple[Case, ...]:
    """Return all cases.

    Example:
        >>> [case.name for case in cases()[:2]]
        ['hello', 'observe']
    """
    # In the order in which they need the fewest lives: those that end one come last, and `canonical` judges
    # what came in all others.
    return (
        *lifecycle.JOINING,
        *frames.FRAMES_AND_EPISODES,
        *content.CASES,
        *wrong.CASES,
        *geometry.CASES,
        *frames.CHECKPOINTS,
        *lifecycle.LEAVING,
        *frames.AFTERWARDS,
        lifecycle.canonical,
    )


def chosen(names: Sequence[str]) -> list[Case]:
    """Return the cases of these names, or all; raises `SetupError` for a name that no case has."""
    known = {case.name: case for case in cases()}
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"did you mean {near[0]!r}? " if near else ""
            raise SetupError(f"there is no case {name!r}; {hint}cases: {', '.join(known)}")
    return [case for case in known.values() if case.name in names or not names]


def conform(
    endpoint: str,
    *,
    command: str = "",
    names: Sequence[str] = (),
    rules: Rules | None = None,
    front: Callable[[str], AbstractContextManager[str]] = nullcontext,
    tell: Callable[[str], None] = lambda text: None,
    each: Callable[[Verdict], None] = lambda verdict: None,
) -> list[Verdict]:
    """Listen at an address and judge a client.

    Args:
        endpoint: ZeroMQ address to listen at; port 0 takes any.
        command: Starts the client, with ``{endpoint}`` and ``{name}`` filled in; empty: the user does, when
            ``tell`` asks for it.
        names: Cases to play; by default all.
        rules: What is known of the client.
        front: Serves clients in front of the kit's own endpoint, as a gateway does; yields the address that
            clients are given.
        tell: Shows the user a text.
        each: Gets each verdict as soon as there is one.

    Returns:
        The verdicts, in the order of the cases.

    Raises:
        SetupError: A case or role is unknown.
        RunError: The endpoint cannot be listened at, or the command cannot be started or fails before its
            client sends anything.

    Example:
        >>> client = "python -m caviar_services {name} --use agent:los-beam --broker {endpoint}"
        >>> [v.outcome for v in conform("tcp://127.0.0.1:0", command=client, names=["hello"])]
        ['pass']
    """
    picked, given = chosen(names), rules or Rules()
    if given.role and given.role not in ROLES:
        raise SetupError(f"no client has the role {given.role!r}; {suggestion(given.role, ROLES)}")
    wire = Wire(endpoint)
    verdicts = []
    with (
        closing(wire),
        front(wire.endpoint) as address,
        # A client that was killed may still write: what it leaves is removed as far as it goes.
        TemporaryDirectory(prefix="caviar-conform-", ignore_cleanup_errors=True) as folder,
    ):
        client: Client = ByHand(wire, address, tell, given.timeout_s)
        if command:
            client = Started(command, address, given.name or "client", Path(folder))
        kit = Kit(wire, client, replace(given, directory=folder, mark=os.urandom(8).hex()))
        try:
            for case in picked:
                verdicts.append(kit.judge(case))
                each(verdicts[-1])
            kit.discard()
        finally:
            if command:
                client.dispose()
    return verdicts
