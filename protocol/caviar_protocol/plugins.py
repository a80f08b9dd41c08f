"""Plug-ins: what installed distributions add to CAVIAR, by the entry points that their metadata declare."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

from caviar_protocol.errors import DeclarationError

# The module takes longer to load than the metadata: only a process that asks loads it.
if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

SERVICES = "caviar.services"
"""Group of implementations: name ``role:name``, value ``module:Class``."""
ATTACHMENTS = "caviar.attachments"
"""Group of what the command line attaches to a scenario, as of `caviar_protocol.scenario.attachments`."""
PLANTS = "caviar.plants"
"""Group of what moves the rigid body of a quadrotor in the world ``flight``: value ``module:Class``."""


# Once a process: it reads the metadata of every installed distribution.
@cache
def _installed() -> Any:
    from importlib.metadata import entry_points

    return entry_points()


def plugins(group: str) -> dict[str, EntryPoint]:
    """Entry points of a group, by name.

    Args:
        group: `SERVICES`, `ATTACHMENTS` or `PLANTS`.

    Raises:
        DeclarationError: Two distributions register the same name.

    Example:
        >>> plugins(PLANTS)["mujoco"].value
        'caviar_bridges.mujoco:MujocoPlant'
    """
    found: dict[str, EntryPoint] = {}
    for point in _installed().select(group=group):
        other = found.setdefault(point.name, point)
        # The same value twice is one distribution that is installed twice, in editable mode for instance.
        if other.value != point.value:
            raise registered_twice(point.name, origin(other), origin(point))
    return found


def registered_twice(name: str, *origins: str) -> DeclarationError:
    """Error for a name that two register."""
    return DeclarationError(
        f"{name} is registered twice, as {' and as '.join(origins)}; uninstall or rename one of them"
    )


def origin(point: EntryPoint) -> str:
    """Value of an entry point, and the distribution that declares it, for errors."""
    return f"{point.value} ({point.dist.name})" if point.dist is not None else point.value


def load_plugin(point: EntryPoint) -> Any:
    """Object that an entry point names.

    Raises:
        DeclarationError: It cannot be imported; the text has value, distribution and cause.
    """
    try:
        return point.load()
    except Exception as error:  # whatever a module that is not ours does when it is imported
        text = f"{type(error).__name__}: {error}"
        raise DeclarationError(f"{point.name!r} cannot be loaded from {origin(point)}: {text}") from error
