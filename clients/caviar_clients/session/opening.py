"""`open_session`: from a scenario to a session of one of its agents, here or at a broker elsewhere."""

from __future__ import annotations

from pathlib import Path

from caviar_clients.session.base import Session
from caviar_clients.session.connected import ConnectedSession
from caviar_clients.session.embedded import EmbeddedSession
from caviar_protocol.errors import ScenarioError
from caviar_protocol.keys import Credentials
from caviar_protocol.messages import Input
from caviar_protocol.scenario import Scenario


def agent_of(scenario: Scenario, agent: str | None) -> str:
    """The agent whose place a session takes: the one named, the remote one, or the only one.

    Raises `ScenarioError` naming the agents where that does not say which.
    """
    agents = {name: spec for name, spec in scenario.services.items() if spec.role == "agent"}
    remote = [name for name, spec in agents.items() if spec.remote]
    names = ", ".join(agents) or "none"
    if agent is not None:
        if agent not in agents:
            raise ScenarioError(f"the scenario has no agent {agent!r}; its agents are: {names}")
        return agent
    found = remote or list(agents)
    if len(found) != 1:
        raise ScenarioError(
            f"name the agent whose place is taken, agent=…; the scenario's agents are: {names}"
        )
    return found[0]


def open_session(
    scenario: Scenario,
    agent: str,
    inputs: tuple[Input, ...],
    broker: str | None = None,
    directory: Path | None = None,
    credentials: Credentials | None = None,
    with_scenery: bool = False,
) -> Session:
    """A session of ``agent``, at ``broker`` or, without one, in this process."""
    if broker is None:
        return EmbeddedSession(scenario, agent, inputs, directory, with_scenery)
    if directory is not None:
        raise ScenarioError("a connected run records where its broker says; leave directory=… out")
    return ConnectedSession(broker, agent, inputs, credentials=credentials, with_scenery=with_scenery)
