"""Conformance tests that every implementation of a service passes.

Subclass the class of the role in a test file and name the implementation; pytest runs the tests:

>>> class TestMyChannel(ChannelConformance):
...     service_class = MyChannel
...     settings = {"samples": 1000}

Implementations in the registry are tested without even that (``tests/conformance``).
"""

from __future__ import annotations

try:
    import pytest  # noqa: F401 - an extra: users who run no tests do not need it
except ModuleNotFoundError as missing:
    from caviar_protocol.errors import SetupError
    from caviar_protocol.host import install_command

    raise SetupError(f"the conformance tests need pytest; run: {install_command('testing')}") from missing

from caviar_services.testing.base import Played, ServiceConformance
from caviar_services.testing.plugins import CodebookConformance, NoiseConformance
from caviar_services.testing.roles import (
    CONFORMANCE,
    AgentConformance,
    ChannelConformance,
    LinkConformance,
    RecorderConformance,
    SensorConformance,
    WorldConformance,
)

__all__ = [
    "CONFORMANCE",
    "AgentConformance",
    "ChannelConformance",
    "CodebookConformance",
    "LinkConformance",
    "NoiseConformance",
    "Played",
    "RecorderConformance",
    "SensorConformance",
    "ServiceConformance",
    "WorldConformance",
]
