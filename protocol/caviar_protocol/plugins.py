"""Plug-ins: what other installed distributions add, found through Python's entry points.

| group | name | value |
| --- | --- | --- |
| ``caviar.services`` | ``role:name`` | a subclass of `Service` |
| ``caviar.plants`` | engine of a quadrotor in the world ``flight`` | a subclass of its `Plant` |
| ``caviar.attachments`` | option of ``caviar run`` | as of `caviar_protocol.scenario` |
| ``caviar.observations`` | part of the observation | a subclass of `caviar_protocol.observations.Part` |
| ``caviar.codebooks`` | codebook of antenna arrays | a `caviar_protocol.space.codebooks.Codebook` class |
| ``caviar.noise`` | ``lidar:name``, ``camera:name`` | a subclass of `SensorNoise` |
| ``caviar.formats`` | format of ``caviar export`` and ``import`` | a `caviar_formats.base.Format` class |
| ``caviar.commands`` | what is typed after ``caviar`` | a function for Typer, or a ``typer.Typer`` |
| ``caviar.traffic`` | traffic model of the link ``cell`` | a `caviar_protocol.cell.traffic.TrafficModel` |

What is built in stands in a table of its own and goes first; a distribution adds names, and changes none.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, TypeVar

from caviar_protocol.errors import DeclarationError

# It takes longer to load than the metadata: only a process that looks for plug-ins loads it.
if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

T = TypeVar("T")

PREFIX = "caviar."
"""Of the names of all groups."""


# Once a process: looking for entry points reads the metadata of every installed distribution.
@cache
def _all() -> Mapping[str, tuple[EntryPoint, ...]]:
    from importlib.metadata import entry_points

    found = entry_points()
    return {group: tuple(found.select(group=group)) for group in found.groups if group.startswith(PREFIX)}


def claims(group: str) -> tuple[EntryPoint, ...]:
    """The entry points of a group, also several of one name.

    Args:
        group: Its name.
    """
    return _all().get(group, ())


@cache
def plugins(group: str) -> Mapping[str, EntryPoint]:
    """The entry points of a group, by name.

    Args:
        group: Its name.

    Raises:
        DeclarationError: Two distributions register one name for different objects; names both.

    Example:
        >>> plugins("caviar.none")
        {}
    """
    found: dict[str, EntryPoint] = {}
    for point in claims(group):
        # The same value twice is one distribution that is installed twice, in editable mode for instance.
        other = found.setdefault(point.name, point)
        if other.value != point.value:
            both = (origin(each) for each in (other, point))
            raise DeclarationError(
                f"{point.name} is registered twice in {group}, as {' and as '.join(both)}; uninstall one"
            )
    return found


def load_plugin(point: EntryPoint, kind: type[T]) -> T:
    """Import the object of an entry point.

    Args:
        point: One of `plugins`.
        kind: Of which it has to be an instance.

    Raises:
        DeclarationError: It cannot be imported, or is something else; names the distribution and the object.
    """
    what = f"{point.name} of {point.group} is {origin(point)}, which"
    try:
        found = point.load()
    except Exception as error:  # whatever a module that is not ours does when it is imported
        raise DeclarationError(f"{what} cannot be loaded: {type(error).__name__}: {error}") from error
    if not isinstance(found, kind):
        raise DeclarationError(f"{what} is no {kind.__name__}")
    return found


def plugin_class(group: str, name: str, base: type[T]) -> type[T] | None:
    """The class that a plug-in registers; None where none has the name.

    Args:
        group: Name of the group.
        name: Of the entry point.
        base: Of which it has to be a subclass.

    Raises:
        DeclarationError: It cannot be imported, or is no subclass; names the distribution and the object.
    """
    point = plugins(group).get(name)
    if point is None:
        return None
    found = load_plugin(point, type)
    if not issubclass(found, base):
        what = f"{name} of {group} is {origin(point)}"
        raise DeclarationError(f"{what}, which is no subclass of {base.__name__}")
    return found


def origin(point: EntryPoint) -> str:
    """Object of an entry point, and the distribution that declares it, for errors."""
    return f"{point.value} of {point.dist.name if point.dist is not None else 'an unnamed distribution'}"
