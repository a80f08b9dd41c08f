"""Observations of a policy: parts by name, and the users that they are about.

Environments, training on recordings and agents that serve a trained policy read observations here, so that a
policy sees the same numbers wherever it decides.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from typing import Any

import numpy as np
from numpy.typing import NDArray

from caviar_protocol.errors import ScenarioError
from caviar_protocol.messages import Input
from caviar_protocol.observations.parts import (
    FAR,
    OBSERVATION_PARTS,
    Bounds,
    LinkFigures,
    Moment,
    ObservedFrame,
    OfLink,
    Part,
    require_packets,
)
from caviar_protocol.observations.users import KnownDevices, KnownScenario, Place, Users
from caviar_protocol.plugins import plugin_class, plugins

__all__ = [
    "FAR",
    "OBSERVATION_PARTS",
    "Bounds",
    "KnownDevices",
    "KnownScenario",
    "LinkFigures",
    "Moment",
    "ObservedFrame",
    "Observer",
    "Part",
    "Place",
    "Users",
    "inputs_of",
    "is_feedback",
    "part",
    "part_class",
    "require_packets",
]


def is_feedback(name: str) -> bool:
    """Return whether a part is read from the link of the frame before alone, and from nothing of the scene.

    Args:
        name: Of the part, as in `OBSERVATION_PARTS`.

    Example:
        >>> is_feedback("last_beam"), is_feedback("position")
        (True, False)
    """
    cls = part_class(name)
    return cls is not None and issubclass(cls, OfLink)


def inputs_of(names: Iterable[str]) -> tuple[Input, ...]:
    """Inputs of parts beside the scene and the link of the frame before, one for each topic.

    Args:
        names: Of the parts; those that do not exist need nothing.

    Example:
        >>> [given.topic for given in inputs_of(("position", "lidar_grid:top"))]
        ['lidar']
    """
    found = (cls for name in names if (cls := part_class(name)) is not None)
    return tuple({i.topic: i for cls in found for i in cls.inputs}.values())


PART_PLUGINS = "caviar.observations"
"""Group of entry points, each a subclass of `Part`, named as the part is."""


def part_class(name: str) -> type[Part] | None:
    """The class of a part, built in or of a plug-in; None where there is none.

    Args:
        name: Of the part; what follows a colon is not looked at.

    Raises:
        DeclarationError: The plug-in cannot be loaded, or is no `Part`.
    """
    kind = name.partition(":")[0]
    return OBSERVATION_PARTS.get(kind) or plugin_class(PART_PLUGINS, kind, Part)  # type: ignore[type-abstract]  # compared, never made


def part(scenario: KnownScenario, users: Users, name: str) -> Part:
    """Make a part of the observation.

    Args:
        scenario: Has the devices.
        users: The places.
        name: Of the part, as in `OBSERVATION_PARTS`; of a sensor's, the sensor may stand after a colon.

    Raises:
        ScenarioError: The part does not exist, or its sensor does not; the text has those there are.
    """
    kind, _, sensor = name.partition(":")
    cls = part_class(kind)
    if cls is None:
        known = [*OBSERVATION_PARTS, *plugins(PART_PLUGINS)]
        near = get_close_matches(kind, known, n=1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise ScenarioError(f"no observation is called {name!r}; {hint}there are: {', '.join(known)}")
    device = cls.needs_sensor
    if not device:
        if sensor:
            raise ScenarioError(f"{name!r}: {kind!r} is not of a sensor; write {kind!r}")
        return cls(scenario, users, "")
    names = [d.name for d in scenario.devices if d.kind == device]
    if not sensor and len(names) == 1:
        sensor = names[0]
    if sensor not in names:
        there = (
            ", ".join(f"{kind}:{n}" for n in names)
            or f"none, as the scenario has no device of kind {device!r}"
        )
        raise ScenarioError(f"observation {name!r} names no {device} of the scenario; there are: {there}")
    return cls(scenario, users, sensor)


class Observer:
    """Reads some parts of the observation in every frame.

    Args:
        scenario: Has the devices.
        users: The places.
        names: Of the parts, as in `OBSERVATION_PARTS`.

    Raises:
        ScenarioError: A part does not exist, or its sensor does not; the text has those there are.

    Example:
        >>> from caviar_protocol.scenario import load_scenario
        >>> scenario = load_scenario("geometric")
        >>> observer = Observer(scenario, Users(scenario, ("*",)), ("aoa", "last_abs_y"))
        >>> {name: bounds.shape for name, bounds in observer.bounds.items()}
        {'aoa': (1,), 'last_abs_y': (1,)}
    """

    def __init__(self, scenario: KnownScenario, users: Users, names: Iterable[str]) -> None:
        self._parts: dict[str, Part] = {name: part(scenario, users, name) for name in names}
        self.bounds: Mapping[str, Bounds] = {name: found.bounds for name, found in self._parts.items()}
        """Of each part, by name."""
        self._places = len(users)
        self._blank = {name: np.zeros(of.shape, of.dtype) for name, of in self.bounds.items()}

    def row_shape(self, name: str) -> tuple[int, ...] | None:
        """Shape of one place's values of a part; None: all users share the values.

        Args:
            name: Of the part.
        """
        if not self._parts[name].per_user:
            return None
        first, *others = self.bounds[name].shape
        return tuple(others) or (first // self._places,)

    @property
    def inputs(self) -> tuple[Input, ...]:
        """Inputs of the parts beside the scene and the link of the frame before, one for each topic."""
        return inputs_of(self._parts)

    def read(self, moment: Moment) -> dict[str, NDArray[Any]]:
        """Read all parts at a frame; zeros stand for what is not known.

        Args:
            moment: What is known at the frame.
        """
        found = {}
        for name, of in self._parts.items():
            value = of.read(moment)
            # A copy: learners keep observations, and some write into them.
            found[name] = self._blank[name].copy() if value is None else value
        return found
