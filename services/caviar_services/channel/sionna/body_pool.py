"""Bodies that stand for moving objects, by mesh and material; more are made when objects or meshes come."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from caviar_protocol.assets import is_mesh_name, material_of
from caviar_protocol.topics import Scene
from caviar_services.channel.sionna.materials import ObjectMaterials, body_kind
from caviar_services.channel.sionna.scene_loading import unit_mesh
from caviar_services.channel.sionna.triangle_numbering import Body
from caviar_space.meshes import Mesh, assign_bodies


def own_materials(assets: Mapping[str, Path]) -> dict[str, str]:
    """Find the materials that meshes of objects name in their files, by asset.

    Args:
        assets: Files of the run by name.
    """
    named = {name: material_of(file) for name, file in assets.items() if name.startswith("objects/")}
    return {name: material for name, material in named.items() if material}


@dataclass(frozen=True)
class _LaterMeshes:
    """Meshes that came while the run goes on, and the bodies that were made since its beginning."""

    meshes: Mapping[str, Mesh] = field(default_factory=dict)
    """By asset."""
    materials: Mapping[str, str] = field(default_factory=dict)
    """By asset: of those that name one."""
    room: Mapping[tuple[str, str], int] = field(default_factory=dict)
    """Bodies by mesh and material; those of the box are for objects whose mesh is not there."""
    changed: bool = False
    """Whether bodies have to be made for them."""


@dataclass(frozen=True)
class _Bodies:
    """The bodies that there are, by their kinds (`body_kind`)."""

    counts: dict[str, int]
    meshes: dict[str, Mesh]
    of_material: dict[str, list[Body]]
    """By material; an empty one is that of all bodies without one of their own."""


class BodyPool:
    """The bodies that objects of a scene may have.

    Args:
        assets: Files of the run by name; the meshes of objects among them.
        pool: How many bodies of each asset there are at first; an empty asset is the box, 0 forbids any.
        keys: Key of the scenario that says how many, by asset, for errors.
        objects: Materials of objects that differ from the others.
        own: Materials that meshes name in their files, by asset (`own_materials`).
        materials: Names of all materials that bodies may have: there are bodies for each.

    Raises:
        AssetError: A file is no mesh.
    """

    def __init__(
        self,
        assets: Mapping[str, Path],
        pool: Mapping[str, int],
        keys: Mapping[str, str],
        objects: ObjectMaterials,
        own: Mapping[str, str],
        materials: Collection[str],
    ) -> None:
        self._objects = objects
        self._own_materials = own
        self._later = _LaterMeshes()
        units = {asset: unit_mesh(asset, assets) for asset in pool}
        # Each material of bodies is a shape of its own, with a pool of its own.
        kinds = {(asset, m): body_kind(asset, m) for m in ("", *materials) for asset in sorted(pool)}
        self._keys = {kind: keys.get(asset, "") for (asset, _), kind in kinds.items()}
        self._first = _Bodies(
            {kind: pool[asset] for (asset, _), kind in kinds.items()},
            {kind: units[asset] for (asset, _), kind in kinds.items()},
            {
                m: [
                    (kind, slot)
                    for (asset, of), kind in kinds.items()
                    if of == m
                    for slot in range(pool[asset])
                ]
                for m in ("", *materials)
            },
        )
        self._now = self._first

    @property
    def of_material(self) -> Mapping[str, list[Body]]:
        """Bodies by material; an empty one is that of all bodies without one of their own."""
        return self._now.of_material

    @property
    def bodies(self) -> list[Body]:
        """All bodies, material by material."""
        return [body for of in self._now.of_material.values() for body in of]

    @property
    def meshes(self) -> Mapping[str, Mesh]:
        """Unit mesh of each kind of body, those of which there is none included."""
        return self._now.meshes

    @property
    def unit_meshes(self) -> Mapping[str, Mesh]:
        """Of the kinds of bodies that there are."""
        return {kind: mesh for kind, mesh in self._now.meshes.items() if self._now.counts[kind]}

    def named_materials(self) -> set[str]:
        """Materials that meshes name, those that came later too."""
        return {*self._own_materials.values(), *self._later.materials.values()}

    def use_meshes(self, meshes: Mapping[str, Path]) -> None:
        """Take meshes that objects may have from the next frame on, beside those of the beginning.

        Args:
            meshes: Files by asset name; those of an earlier call that are not here are gone.

        Raises:
            AssetError: A file is no mesh.
        """
        self._later = _LaterMeshes(
            meshes={name: unit_mesh(name, meshes) for name in sorted(meshes)},
            materials=own_materials(meshes),
            changed=True,
        )

    def make_room(self, scene: Scene, solid: Sequence[int]) -> bool:
        """Make bodies where a frame has more objects of a kind than there are bodies.

        A mesh of the beginning whose pool is 0 gets none: `assign` refuses its objects.

        Args:
            scene: The scene of a frame.
            solid: Its objects that waves meet, by their index.

        Returns:
            Whether there are other bodies than before.
        """
        later, asset_of = self._later, scene.assets
        body_of = {i: self._body_of(scene, i) for i in solid}
        needed = Counter(body_of.values())
        # Bodies that a mesh came for are made whatever the pools are; boxes stand in where it is not there.
        came = {body for i, body in body_of.items() if is_mesh_name(asset_of[i])}
        for key in [k for k in needed if k not in came and not self._first.counts.get(body_kind(*k))]:
            del needed[key]
        short = any(n > self._now.counts.get(body_kind(*key), 0) for key, n in needed.items())
        if not later.changed and not short:
            return False
        # In powers of two: objects that come one by one seldom make bodies anew.
        room = {} if later.changed else dict(later.room)
        for key, n in needed.items():
            room[key] = max(room.get(key, 0), 1 << (n - 1).bit_length())
        self._later = replace(later, room=room, changed=False)
        self._now = self._with_room(room)
        return True

    def _with_room(self, room: Mapping[tuple[str, str], int]) -> _Bodies:
        """The bodies of the beginning, and those made since, which come last of their material."""
        first, later = self._first, self._later.meshes
        counts, meshes = dict(first.counts), dict(first.meshes)
        of_material = {m: [*bodies] for m, bodies in first.of_material.items()}
        for (asset, material), count in sorted(room.items()):
            kind = body_kind(asset, material)
            before = counts.get(kind, 0)
            counts[kind] = max(before, count)
            meshes[kind] = later[asset] if asset in later else first.meshes[asset]
            more = [(kind, slot) for slot in range(before, counts[kind])]
            of_material[material] = of_material.get(material, []) + more
        return _Bodies(counts, meshes, of_material)

    @property
    def awaits_meshes(self) -> bool:
        """Whether meshes came for which bodies are not made yet."""
        return self._later.changed

    def kind(self, scene: Scene, i: int) -> str:
        """Which bodies may stand for an object.

        Args:
            scene: The scene of a frame.
            i: Index of the object.
        """
        return body_kind(*self._body_of(scene, i))

    def _body_of(self, scene: Scene, i: int) -> tuple[str, str]:
        """Mesh and material of the body of an object of a scene; the box for a mesh that is not there."""
        asset = scene.assets[i]
        if is_mesh_name(asset) and asset not in self._later.meshes and asset not in self._first.meshes:
            asset = ""
        own = self._later.materials.get(asset) or self._own_materials.get(asset, "")
        return asset, self._objects.of(scene.names[i], scene.classes[i]) or own

    def assign(self, objects: Iterable[tuple[str, str]]) -> dict[str, Body]:
        """Choose a body for each object, as `assign_bodies` does.

        Args:
            objects: Name and kind of each.

        Returns:
            By name.

        Raises:
            PayloadError: There are too few bodies of a kind.
        """
        return assign_bodies(objects, self._now.counts, self._keys)
