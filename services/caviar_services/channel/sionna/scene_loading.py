"""Scenery in Sionna RT: loaded, joined to one shape a material, with as much detail as asked for."""

from __future__ import annotations

import gc
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from caviar_protocol.errors import AssetError, ScenarioError
from caviar_services.channel.mesh_detail.detail import DetailEffect, DetailSettings, detailed
from caviar_services.channel.sionna.materials import any_frequency, freeze
from caviar_services.channel.sionna.meshes import Shape
from caviar_services.mesh.scenery import asset_name
from caviar_services.mesh.shapes import Mesh


def loaded(description: Path | None) -> Any:
    """The `sionna.rt.Scene` of a description, or an empty one.

    Raises `AssetError` where the ray tracer cannot take it.
    """
    from sionna.rt import load_scene

    # A scene refers to itself. Until one that nobody has any more is collected, kernels branch over what is
    # in it too, and are compiled anew.
    gc.collect()
    try:
        with any_frequency():
            scene = load_scene(None if description is None else str(description), merge_shapes=False)
    except (ValueError, TypeError, RuntimeError) as error:
        raise AssetError(f"{asset_name(description)}: the ray tracer cannot load it: {error}") from error
    freeze(scene)
    return scene


def by_material(scene: Any, meshes: Mapping[str, Mesh], changed: Mapping[str, Any]) -> list[Shape]:
    """Meshes of what was loaded, by name, joined to one shape a material; ``changed`` has the materials of
    pieces that are given another one than the scenery's."""
    groups: dict[str, Shape] = {}
    for name, mesh in meshes.items():
        material = changed.get(name, scene.objects[name].radio_material)
        group = groups.setdefault(material.name, Shape(f"caviar-scenery-{material.name}", material, [], []))
        group.names.append(name)
        group.meshes.append(mesh)
    return list(groups.values())


def with_detail(
    shapes: list[Shape], detail: DetailSettings, key: str
) -> tuple[list[Shape], DetailEffect | None]:
    """Scenery with this detail, and what that did to it; None where nothing was to be left out.

    ``key`` is where the detail stands in the scenario.

    Raises `ScenarioError` where nothing would be left.
    """
    if detail.is_full:
        return shapes, None
    pieces = [piece for shape in shapes for piece in zip(shape.names, shape.meshes, strict=True)]
    kept, effect = detailed(pieces, detail)
    if pieces and not kept:
        raise ScenarioError(
            f"{detail} leaves out all of the scenery; leave out less",
            key=key,
        )
    left = dict(kept)
    return [
        Shape(shape.id, shape.material, names, [left[name] for name in names])
        for shape in shapes
        if (names := [name for name in shape.names if name in left])
    ], effect
