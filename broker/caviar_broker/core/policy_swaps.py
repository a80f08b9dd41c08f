"""Policies that agents change to while a run goes on (`caviar_protocol.policies`).

A file that is offered is announced in every GRANT to its agent. The agent fetches and loads it beside its
frames, then decides a frame with it, or says why it cannot. From which frame on a policy served stands in the
decisions of the frames; here is what is announced, and what came of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

from caviar_protocol.policies import DECISION, EARLIER, NEXT, REFUSED, SHA256


class PolicyState(msgspec.Struct, frozen=True):
    """Policy that an agent serves, and the one that it is to change to."""

    serving: str = ""
    """SHA-256; empty: it has not decided a frame yet."""
    since: int = -1
    """Frame from which it has; −1: none yet."""
    wanted: str = ""
    """SHA-256 of the one that was offered last; empty: none was."""
    refused: Mapping[str, str] = {}
    """Why others could not be served, by SHA-256."""


class PolicySwaps:
    """Announcements to the agents of one run that serve policies.

    Args:
        given: SHA-256 of the files that each agent was given so far, by its name, the scenario's first.

    Example:
        >>> swaps = PolicySwaps({"agent": ("0a",)})
        >>> swaps.offer("agent", "1b")
        >>> swaps.announced("agent"), swaps.note("agent", {"policy": "1b"}, 7)
        ({'policy.next': '1b'}, 'policy 1b… serves from frame 7 on')
        >>> swaps.state("agent").since
        7
    """

    def __init__(self, given: Mapping[str, Sequence[str]]) -> None:
        self._given = {agent: [*digests] for agent, digests in given.items()}
        # A run that goes on had changed to the last one, or was to.
        self._states = {
            agent: PolicyState(wanted=digests[-1] if len(digests) > 1 else "")
            for agent, digests in given.items()
        }

    @property
    def agents(self) -> tuple[str, ...]:
        """Names of the agents that serve policies."""
        return tuple(self._given)

    def state(self, agent: str) -> PolicyState:
        """State of an agent of `agents`."""
        return self._states[agent]

    def offer(self, agent: str, digest: str) -> None:
        """Announce a file to an agent of `agents` from its next grant on."""
        given, state = self._given[agent], self._states[agent]
        if given[-1] != digest:
            given.append(digest)
        refused = {other: why for other, why in state.refused.items() if other != digest}
        self._states[agent] = msgspec.structs.replace(state, wanted=digest, refused=refused)

    def settings(self, agent: str, settings: Mapping[str, Any]) -> dict[str, Any]:
        """The settings of a service with the digests of its policies, if it serves any."""
        given = self._given.get(agent)
        if not given:
            return dict(settings)
        return {**settings, SHA256: given[0], EARLIER: given[1:]}

    def announced(self, agent: str) -> Mapping[str, str]:
        """Decisions with which a GRANT announces a policy to an agent."""
        state = self._states.get(agent)
        return {NEXT: state.wanted} if state is not None and state.wanted else {}

    def note(self, agent: str, decisions: Mapping[str, str], frame: int) -> str:
        """Note the decisions of a DONE.

        Args:
            agent: That answered.
            decisions: Of its DONE.
            frame: That it answered.

        Returns:
            What to tell the user; empty where there is nothing new.
        """
        state = self._states.get(agent)
        if state is None or not decisions:
            return ""
        told, digest = "", decisions.get(DECISION, "")
        if digest and digest != state.serving:
            if state.serving or digest != self._given[agent][0]:
                told = f"policy {digest[:12]}… serves from frame {frame} on"
            state = msgspec.structs.replace(state, serving=digest, since=frame)
        refused, _, why = decisions.get(REFUSED, "").partition(" ")
        if refused and refused not in state.refused:
            told = f"policy {refused[:12]}… is refused: {why}"
            # What was refused is announced no more: the agent stays with what it has.
            given = self._given[agent]
            if len(given) > 1 and given[-1] == refused:
                given.pop()
            back = given[-1] if len(given) > 1 else ""
            wanted = back if state.wanted == refused else state.wanted
            state = msgspec.structs.replace(state, wanted=wanted, refused={**state.refused, refused: why})
        self._states[agent] = state
        return told
