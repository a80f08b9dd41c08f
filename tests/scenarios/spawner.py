"""A world that spawns objects with meshes of their own while it runs; scenarios name it ``spawner:Spawning``.

What is there follows from the frame alone, so that one that is started again goes on as if it never ended.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import ClassVar

import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_protocol.assets import mesh_name
from caviar_services.service import Frame, StepResult
from caviar_services.world.base import ObjectState, World, WorldSettings
from caviar_space.meshes import Mesh, fitted, loft, ply, unit_box

LEVEL, STILL = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
MATERIALS = ("metal", "concrete", "wood", "glass", "")


class SpawningSettings(WorldSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """When how many objects of how many meshes are there."""

    objects: int = 50
    meshes: int = 5
    first: int = 5
    """Frame in which they come."""
    last: int = 15
    """Frame in which they are there for the last time."""
    period: int = 10_000
    """[frame] until others come, with other meshes."""
    wrong: tuple[str, ...] = ()
    """Meshes that are none, of which an object is there from ``first`` on: ``nan``, ``faces``, ``none``."""
    faces: int = 0
    """Of the mesh with too many."""


def prism(sides: int, wave: int = 0) -> Mesh:
    """An upright prism within the unit box: its first face looks along −x. Each wave has others."""
    turn = np.pi + np.pi / sides
    around = 2 * np.pi * np.arange(sides) / sides + turn
    corners = np.stack([np.cos(around), np.sin(around)], axis=1)
    low = np.column_stack([corners * (1 - 0.01 * wave), np.zeros(sides)])
    high = np.column_stack([corners, np.ones(sides)])
    return fitted(loft(np.array([low, high])))[0]


def sheet(faces: int) -> Mesh:
    """Many faces within the unit box."""
    vertices: Float64Array = np.concatenate([unit_box().vertices, np.zeros((2, 3))]).astype(np.float64)
    vertices[8], vertices[9] = (0.1, 0.0, 0.0), (0.0, 0.1, 0.0)
    more = np.tile(np.array([[0, 8, 9]], np.int32), (faces - 12, 1))
    return Mesh(vertices, np.concatenate([unit_box().faces, more]))


def wrong_mesh(kind: str, faces: int) -> bytes:
    """A file that is no mesh."""
    box = unit_box()
    if kind == "nan":
        vertices = box.vertices.astype(np.float64)
        vertices[3] = np.nan
        return ply(Mesh(vertices, box.faces))
    if kind == "none":
        return ply(Mesh(box.vertices, box.faces[:0]))
    return ply(sheet(faces))


class Spawning(World[SpawningSettings]):
    """Objects in a row across the way between two antennas, ever other meshes."""

    Settings = SpawningSettings
    changes_geometry: ClassVar[bool] = True

    def prefixes(self) -> tuple[str, ...]:
        return ("spawned.",)

    def mesh_classes(self) -> tuple[str, ...]:
        return ()

    def begin(self, episode: int, seed: int) -> None:
        pass

    def scenery(self) -> dict[str, Path | bytes]:
        from street_ground import GROUND, GROUND_XML  # beside this module

        return {"scenery/ground.xml": GROUND_XML.encode(), "scenery/meshes/ground.ply": GROUND.encode()}

    def objects_at(self, elapsed_ns: int) -> Iterable[ObjectState]:
        s = self.settings
        wave, frame = divmod(elapsed_ns // self.run.sampling_period_ns, s.period)
        if not s.first <= frame <= s.last:
            return
        names = [self.add_mesh(ply(prism(4 + i, wave), MATERIALS[i % 5])) for i in range(s.meshes)]
        names += [self.add_mesh(wrong_mesh(kind, s.faces)) for kind in s.wrong]
        for i in range(max(s.objects, len(names))):
            # Behind the receiver, as seen from the transmitter, beside one another.
            at = (40.0, 3.0 * (i - s.objects // 2), 1.5)
            yield ObjectState(
                f"spawned.{i:03}", "crate", at, LEVEL, STILL, (2.0, 2.8, 3.0), mesh=names[i % len(names)]
            )


class Later(Spawning):
    """Announces its meshes three frames before it names them."""

    def step(self, frame: Frame) -> StepResult:
        made, s = super().step(frame), self.settings
        ahead = frame.number == max(0, s.first - 3)
        if not ahead:
            return msgspec.structs.replace(made, meshes=None)
        files = [ply(prism(4 + i), MATERIALS[i % 5]) for i in range(s.meshes)]
        meshes = {mesh_name(content): content for content in files}
        return msgspec.structs.replace(made, meshes=meshes, meshes_from=s.first)
