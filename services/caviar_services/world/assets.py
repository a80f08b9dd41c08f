"""Meshes that a world brings while its run goes on: which there are in a frame.

Files that a world brings beside scenery: meshes of moving objects, and element patterns of antennas.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import ClassVar

from caviar_protocol.assets import digest_in, mesh_name
from caviar_protocol.errors import AssetError, ScenarioError
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.scenario.schema import pattern_asset
from caviar_protocol.topics.scene import MESH_REFUSED_PREFIX
from caviar_services.pattern_files import read_pattern
from caviar_space.meshes import SHAPES, ply


def object_assets(classes: Iterable[str]) -> dict[str, Path | bytes]:
    """Make the unit meshes of object classes.

    Args:
        classes: Keys of `caviar_space.meshes.SHAPES`.

    Returns:
        PLY bytes by asset name.

    Example:
        >>> list(object_assets(["car", "car", "bus"]))
        ['objects/bus.ply', 'objects/car.ply']
    """
    return {f"objects/{name}.ply": ply(SHAPES[name]()) for name in sorted(set(classes))}


def pattern_assets(devices: Iterable[DeviceSpec]) -> dict[str, Path | bytes]:
    """Find the files of the element patterns that devices name.

    Args:
        devices: Devices of the scenario.

    Returns:
        File by asset name.

    Raises:
        ScenarioError: A file is wrong (`read_pattern`); names the device's key.
    """
    found: dict[str, Path | bytes] = {}
    for device in devices:
        if device.array is not None and device.array.pattern_file:
            file = Path(device.array.pattern_file)
            try:
                read_pattern(file)  # so that an error names the user's file, not a copy of it
            except AssetError as error:
                key = Place("devices").at(device.name).at("array").at("pattern_file").key
                raise ScenarioError(str(error), key=key) from error
            found[pattern_asset(device.array.pattern_file)] = file
    return found


_log = logging.getLogger("caviar.service")


class RunTimeMeshes:
    """The meshes of a world beside those of its scenery.

    Args:
        again: Whether another process of the world may have announced some before.

    Example:
        >>> meshes = RunTimeMeshes()
        >>> meshes.max_faces = 1000
        >>> crate = meshes.add(b"ply")
        >>> [*meshes.at(3, {crate})] == [crate], meshes.at(4, {crate}) is None
        (True, True)
    """

    LINGER_FRAMES: ClassVar[int] = 20
    """Frames for which a mesh stays that no object has any more: one that comes back soon costs nothing."""

    def __init__(self, again: bool = False) -> None:
        self._again = again
        self._files: dict[str, bytes] = {}
        # Frame in which an object had it last, or in which it came.
        self._used: dict[str, int] = {}
        self._frame = 0
        # Names announced last; None: not known.
        self._announced: frozenset[str] | None = frozenset()
        self._refused: dict[str, str] = {}
        self._told: set[str] = set()
        self.max_faces = 0
        """Triangles that a mesh may have; 0: the run takes none, and objects are boxes."""
        self.reset()

    def reset(self) -> None:
        """Begin an episode, without meshes."""
        self._files.clear()
        self._used.clear()
        self._frame = 0
        self._announced = None if self._again else frozenset()

    def add(self, content: bytes) -> str:
        """Bring a mesh; its name.

        Args:
            content: The PLY file.
        """
        name = mesh_name(content)
        self._files.setdefault(name, content)
        self._used[name] = max(self._used.get(name, 0), self._frame)
        return name

    def at(self, frame: int, used: Collection[str]) -> Mapping[str, bytes] | None:
        """Meshes of a frame, for `StepResult.meshes`; None where they are those of the frame before.

        Args:
            frame: Its number.
            used: Those that objects have.
        """
        self._frame = frame + 1
        if not self.max_faces:
            return None
        for name in used:
            if name in self._files:
                self._used[name] = frame
        for name in [n for n, last in self._used.items() if last + self.LINGER_FRAMES < frame]:
            del self._used[name], self._files[name]
        there = frozenset(name for name in self._files if name not in self._refused)
        if there == self._announced:
            return None
        self._announced = there
        return {name: self._files[name] for name in sorted(there)}

    def refuse(self, digest: str, reason: str) -> None:
        """Note that a mesh is not used.

        Args:
            digest: SHA-256 of its file; empty: none of those announced is.
            reason: Why.
        """
        _log.warning("%s; objects with it are boxes", reason)
        for name in self._files if not digest else [n for n in self._files if digest_in(n) == digest]:
            self._refused[name] = reason

    @property
    def counts(self) -> Mapping[str, int]:
        """Meshes that were refused since the last call, for the report."""
        # Told once each: the summary adds counts up.
        news = [name for name in self._refused if name not in self._told]
        self._told.update(news)
        return {f"{MESH_REFUSED_PREFIX}{name}": 1 for name in news}
