"""Optional parts of the distribution: whether they are installed, and the command that installs them."""

from __future__ import annotations

import importlib.util
import sys

DISTRIBUTION = "caviar-sim"
"""Name under which pip knows this project."""

_MODULES = {"channel": "sionna", "sensors": "mitsuba", "world": "libsumo", "plot": "matplotlib"}
"""A module that each extra brings and the base install does not."""


def has_extra(extra: str) -> bool:
    """Whether the libraries of an extra can be imported; they are not imported for that."""
    return importlib.util.find_spec(_MODULES[extra]) is not None


def install_command(*extras: str) -> str:
    """Shell command that adds extras to this installation: ``/…/python -m pip install 'caviar-sim[plot]'``.

    It names the interpreter that runs, so that it works without an activated environment; pip takes the
    requirements of the extras from the metadata of what is installed, be that a wheel or a checkout.
    """
    return f"{sys.executable} -m pip install '{DISTRIBUTION}[{','.join(extras)}]'"
