"""Attachments: services that the command line attaches to a scenario, ``caviar run --attach NAME=VALUE``.

An installed distribution adds one by an entry point of the group ``caviar.attachments``: a function that is
given the scenario and ``VALUE``, and returns the scenario with what it attaches. The first line of its
docstring is the help of ``caviar run --NAME VALUE``. The command and the broker both call it: its module
imports nothing heavy.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import FunctionType

from caviar_protocol.errors import DeclarationError, ScenarioError, suggestion
from caviar_protocol.plugins import load_plugin, origin, plugins
from caviar_protocol.scenario.schema import Scenario

ATTACHMENTS = "caviar.attachments"
"""Group of entry points."""


def attached(scenario: Scenario, attachments: Sequence[str]) -> Scenario:
    """Attach services to a scenario, one after the other.

    Args:
        scenario: Checked, as it was loaded.
        attachments: ``NAME=VALUE`` each.

    Raises:
        ScenarioError: Nothing has the name, or it cannot be attached to this scenario.
        DeclarationError: What a distribution registers is no attachment.

    Example:
        >>> from caviar_protocol.scenario import load_scenario
        >>> attached(load_scenario("smoke"), ["engine"])
        Traceback (most recent call last):
            ...
        caviar_protocol.errors.ScenarioError: --attach engine: write it as NAME=VALUE
    """
    for text in attachments:
        name, separator, value = text.partition("=")
        if not separator:
            raise ScenarioError(f"--attach {text}: write it as NAME=VALUE")
        known = plugins(ATTACHMENTS)
        if name not in known:
            hint = suggestion(name, sorted(known)) if known else "nothing that is installed can be attached"
            raise ScenarioError(f"--attach {text}: {name!r} does not exist; {hint}")
        scenario = load_plugin(known[name], FunctionType)(scenario, value)
        if not isinstance(scenario, Scenario):
            raise DeclarationError(f"--attach {text}: {origin(known[name])} returns no scenario")
    return scenario


def summary(name: str) -> str:
    """First line of what an attachment says of itself; of one that cannot be loaded, why."""
    try:
        text = load_plugin(plugins(ATTACHMENTS)[name], FunctionType).__doc__ or ""
    except DeclarationError as error:
        return str(error)
    return text.strip().partition("\n")[0].rstrip(".")
