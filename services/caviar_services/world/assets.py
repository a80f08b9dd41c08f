"""Files that a world brings beside scenery: meshes of moving objects, and element patterns of antennas."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from caviar_protocol.errors import AssetError, ScenarioError
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.scenario.schema import pattern_asset
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
