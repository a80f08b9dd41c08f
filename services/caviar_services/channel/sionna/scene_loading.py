"""Scenery and bodies for Sionna RT: loaded, given their materials, joined to a shape a material, with the
detail asked for.

Meshes and descriptions are read by our own readers: Mitsuba takes triangles only, keeps float32, and its
errors name neither the user's file nor a shape.

Bodies stand for moving objects, by mesh and material (`BodyPool`); more are made when objects or meshes come.
"""

from __future__ import annotations

import gc
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_protocol.assets import is_mesh_name, material_of
from caviar_protocol.errors import AssetError, ScenarioError
from caviar_protocol.messages import WARNING
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.topics import Scene
from caviar_services.channel.sionna import mi
from caviar_services.drjit_setup import aligned_columns
from caviar_space.materials import (
    BODY_THICKNESS,
    OBJECT_MATERIAL,
    Constants,
    ItuMaterial,
    MaterialPolicy,
    MaterialSettings,
    ObjectMaterials,
    body_kind,
    itu_material,
    of_thickness,
    without_thickness,
)
from caviar_space.mesh_detail import DetailEffect, DetailSettings, detailed, with_few_faces
from caviar_space.meshes import (
    Body,
    Mesh,
    assign_bodies,
    coarse_centre,
    is_object_mesh,
    object_meshes,
    shown_asset,
)
from caviar_space.mitsuba_xml import SceneryShape, asset_name, read_scenery, world_mesh
from caviar_space.walls import solid_walls


@dataclass(frozen=True, eq=False)
class Shape:
    """One shape of the ray tracer: pieces of one material."""

    id: str
    material: Any
    names: list[str]
    meshes: list[Mesh]


@dataclass(frozen=True, eq=False)
class Piece:
    """A piece of scenery as its files have it."""

    mesh: Mesh
    """In world coordinates [m]."""
    material: Any
    """Of the ray tracer: a `sionna.rt.RadioMaterialBase`; None: foliage that has none."""
    place: str
    """Where it stands, for messages: file, line and name."""


def file_pieces(
    description: Path | None,
    foliage: ObjectMaterials | None = None,
    solid_walls_m: float | None = None,
    others: ObjectMaterials | None = None,
) -> tuple[dict[str, Piece], tuple[str, ...]]:
    """Read the pieces of scenery, by name, in the order of the description.

    Args:
        description: The scene description; None: there is none.
        foliage: Pieces that need no radio material, since waves pass through them.
        solid_walls_m: Closed plates up to this thickness [m] become sheets of that thickness
            (`caviar_space.walls`); None: none.
        others: Materials of pieces that are given another one, whose thickness counts.

    Returns:
        The pieces, a note on walls that became sheets, and a warning where meshes without triangles are left
        out.

    Raises:
        AssetError: Names what is wrong with the description, a material or a mesh.
    """
    if description is None:
        return {}, ()
    pieces, empty, walls = {}, [], list[float]()
    materials: dict[str, Any] = {}
    for shape in read_scenery(description, asset_name(description)).shapes:
        leaves = shape.radio is None and foliage is not None and foliage.material_for(shape.name)
        material = None if leaves else _radio_material(shape, materials)
        mesh = world_mesh(shape)
        if not len(mesh.faces):
            empty.append(f"{shape.place}, mesh {shape.file.name}")
            continue
        made: list[tuple[Mesh, float | None]] = [(mesh, None)]
        kept = [keys for keys in (foliage, others) if keys and keys.material_for(shape.name)]
        if solid_walls_m and material is not None and not kept:
            made = solid_walls(mesh, solid_walls_m)
        for number, (part, thickness) in enumerate(made):
            own = material if thickness is None else _radio_material(_as_thick(shape, thickness), materials)
            pieces[f"{shape.name}, part {number}" if number else shape.name] = Piece(part, own, shape.place)
        walls += [thickness for _, thickness in made if thickness is not None]
    notes: tuple[str, ...] = ()
    if walls:
        sizes = f"{min(walls):g} to {max(walls):g}" if len(set(walls)) > 1 else f"{walls[0]:g}"
        what = f"closed walls of {sizes} m in {len(walls)} pieces"
        notes += (f"{WARNING}solid_walls_m: {what} are one slab each, in the middle, where they reflect",)
    if empty:
        more = f", and {len(empty) - 1} more" if len(empty) > 1 else ""
        notes += (f"{WARNING}{empty[0]}, has no triangles{more}: left out",)
    return pieces, notes


def _as_thick(shape: SceneryShape, thickness_m: float) -> SceneryShape:
    """The same shape of a material of another thickness."""
    if shape.radio is None:
        return shape
    root = ElementTree.fromstring(shape.radio.xml)  # noqa: S314 - made by read_scenery
    for old in root.findall("float[@name='thickness']"):
        root.remove(old)
    ElementTree.SubElement(root, "float", name="thickness", value=f"{thickness_m:.9g}")
    name = of_thickness(shape.radio.name, thickness_m)
    return replace(shape, radio=shape.radio._replace(name=name, xml=ElementTree.tostring(root, "unicode")))


def _radio_material(shape: SceneryShape, made: dict[str, Any]) -> Any:
    """The ray tracer's material of a shape, of which those that are ``made`` are each made once."""
    if shape.radio is None:
        named = f"material {shape.material!r} of type {shape.material_type!r}"
        raise AssetError(
            f"{shape.place} has {named if shape.material else 'no material'}, of which the ray tracer has no "
            "radio constants; give it one of ITU-R P.2040, such as <bsdf type='itu-radio-material' "
            "id='itu_concrete'><string name='type' value='concrete'/></bsdf>"
        )
    name, xml, place = shape.radio
    if name not in made:
        try:
            with any_frequency():
                made[name] = mi.load_string(xml.replace("<bsdf ", f"<bsdf id={quoteattr(name)} ", 1))
        except RuntimeError as error:
            # Of a traceback the last line says what is wrong.
            cause = str(error).strip().splitlines()[-1].rpartition("(line 1")[2]
            raise AssetError(f"{place}: {cause}; correct it") from error
    return made[name]


def mi_mesh(shape: Shape, centre: Float64Array) -> Any:
    """Make the mesh that the ray tracer has for a shape.

    Args:
        shape: In world coordinates.
        centre: What the ray tracer counts from [m], Shape ``[3]``.
    """
    counts = np.array([len(mesh.vertices) for mesh in shape.meshes])
    # Faces of each piece refer to its own vertices.
    before = np.cumsum(counts) - counts
    faces = np.concatenate([mesh.faces + begin for mesh, begin in zip(shape.meshes, before, strict=True)])
    properties = mi.Properties()
    properties.set_id(shape.id)
    # Else Mitsuba would smooth normals over the corners that faces share.
    properties["face_normals"] = True
    made = mi.Mesh(shape.id, int(counts.sum()), len(faces), props=properties)
    params = mi.traverse(made)
    params["vertex_positions"] = floats(np.concatenate([mesh.vertices for mesh in shape.meshes]) - centre)
    params["faces"] = mi.UInt(np.ascontiguousarray(faces, np.uint32).ravel())
    params.update()
    return made


def floats(vertices: Float64Array) -> Any:
    """Coordinates as the ray tracer has them.

    Args:
        vertices: [m], Shape ``[V, 3]``.
    """
    (column,) = aligned_columns(vertices.reshape(1, -1))
    return mi.Float(column)


def new_scene(materials: Iterable[Any]) -> Any:
    """Make a `sionna.rt.Scene` without shapes; its materials are frozen.

    Args:
        materials: Of its scenery, a `sionna.rt.RadioMaterialBase` each.
    """
    from sionna.rt import load_scene

    # A scene refers to itself. Until one without other references is collected, kernels branch over what is
    # in it too, and are compiled anew.
    gc.collect()
    scene = load_scene()
    with any_frequency():
        for material in materials:
            scene.add(material)
    for material in scene.radio_materials.values():
        # No change of the scene's frequency is to change a material.
        if hasattr(material, "itu_type"):
            material.frequency_update_callback = None
    return scene


@contextmanager
def any_frequency() -> Iterator[None]:
    """While a material is made, which Sionna RT does at 3.5 GHz, it is not outside its range.

    Its constants then mean nothing: `set_materials` is to follow.
    """
    from sionna.rt.radio_materials import itu_material as module

    # Sionna RT looks the function up in its module at each call.
    evaluate = module.itu_material
    module.itu_material = lambda name, frequency: (1.0, 0.0)
    try:
        yield
    finally:
        module.itu_material = evaluate


@dataclass(frozen=True, eq=False)
class ObjectMaterial:
    """A material that objects are given, in the ray tracer."""

    name: str
    radio: Any
    """The `sionna.rt.RadioMaterial`."""
    itu: tuple[ItuMaterial, ...]
    """On each carrier; empty where its constants are the scenario's."""
    constants: tuple[Constants, ...]
    """On each carrier, as used."""


def object_materials(
    objects: ObjectMaterials, frequencies_hz: tuple[float, ...], policy: MaterialPolicy
) -> dict[str, ObjectMaterial]:
    """Make the materials that objects are given, by name.

    Args:
        objects: Which they are.
        frequencies_hz: Of the carriers [Hz].
        policy: Changes, and what to do where a material is not defined.

    Raises:
        ScenarioError: Neither ITU-R P.2040 nor `OTHER_MATERIALS` has one, and the scenario gives no
            constants; names the key.
    """
    from sionna.rt import RadioMaterial

    made = {}
    for name in objects.names:
        change, key = policy.changes_of(name), Place("object_materials").at(objects.key_of(name)).key
        remedy = f"choose another material, give {policy.key}.materials.{name} constants of its own"
        itu: tuple[ItuMaterial, ...] = ()
        if not change.is_electric:
            itu = tuple(itu_material(key, name, f, policy, remedy) for f in frequencies_hz)
        defined = [of.constants for of in itu] or [(1.0, 0.0)] * len(frequencies_hz)
        constants = tuple(change.applied(of_carrier) for of_carrier in defined)
        radio = RadioMaterial(f"{OBJECT_MATERIAL}{name}", BODY_THICKNESS)
        _checked_change(radio, name, change, policy)
        radio.relative_permittivity, radio.conductivity = constants[0]
        made[name] = ObjectMaterial(name, radio, itu, constants)
    return made


def set_materials(
    scene: Any, frequency_hz: float, policy: MaterialPolicy, others: Iterable[str] = ()
) -> None:
    """Give all materials of a `sionna.rt.Scene` their constants at a carrier.

    Constants are set here rather than by Sionna RT, whose float32 frequency puts 60 GHz outside of
    a range that ends at 60 GHz; the scene's own materials are frozen.

    Args:
        scene: A `sionna.rt.Scene`.
        frequency_hz: Of the carrier [Hz].
        policy: What the scenario says about materials.
        others: Names of those that objects are given.

    Raises:
        ScenarioError: The scenario names an unknown material, or gives one a bad value.
    """
    materials = scene.radio_materials
    named = {*materials, *map(without_thickness, materials)}
    unknown = sorted(policy.changes.keys() - named - set(others))
    if unknown:
        known = sorted(name for name in named if not name.startswith("caviar-"))
        raise ScenarioError(
            f"the scenery has no material {unknown[0]!r}; it has: {', '.join(known)}",
            key=f"{policy.key}.materials.{unknown[0]}",
        )
    for name, material in materials.items():
        itu = _itu_of(name, material, frequency_hz, policy)
        if itu is not None:
            material.relative_permittivity, material.conductivity = itu.constants
        _checked_change(material, name, policy.changes_of(name), policy)
    scene.frequency = frequency_hz


def itu_materials(
    scene: Any, frequency_hz: float, policy: MaterialPolicy
) -> list[tuple[Any, ItuMaterial, Constants]]:
    """List the materials of a scene that may differ between carriers.

    Args:
        scene: A `sionna.rt.Scene`.
        frequency_hz: Of the carrier [Hz].
        policy: What the scenario says about materials.

    Returns:
        Each with its constants at the carrier, as ITU defines them and as changed.
    """
    found = []
    for name, material in scene.radio_materials.items():
        itu = _itu_of(name, material, frequency_hz, policy)
        if itu is not None:
            found.append((material, itu, policy.changes_of(name).applied(itu.constants)))
    return found


def _itu_of(name: str, material: Any, frequency_hz: float, policy: MaterialPolicy) -> ItuMaterial | None:
    """The ITU material that a material of the scene is; None for others, and for those that nothing needs."""
    if not hasattr(material, "itu_type") or policy.changes_of(name).is_electric or not material.is_used:
        return None
    return itu_material(name, material.itu_type, frequency_hz, policy)


def _checked_change(material: Any, name: str, change: MaterialSettings, policy: MaterialPolicy) -> None:
    """Give a material what a scenario changes about it. Raises `ScenarioError` for a bad value."""
    try:
        for attribute, value in (
            ("relative_permittivity", change.relative_permittivity),
            ("conductivity", change.conductivity_s_per_m),
            ("scattering_coefficient", change.scattering_coefficient),
            ("xpd_coefficient", change.xpd_coefficient),
            ("thickness", change.thickness_m),
        ):
            if value is not None:
                setattr(material, attribute, value)
    except ValueError as error:
        raise ScenarioError(
            f"material {name!r}: {error}; correct it", key=f"{policy.key}.materials.{name}"
        ) from error


def by_material(pieces: Mapping[str, Piece], changed: Mapping[str, Any]) -> list[Shape]:
    """Join pieces to one shape a material.

    Args:
        pieces: By name.
        changed: Materials of pieces that are given another one than the scenery's.
    """
    # One shape a material: each further shape costs a millisecond a trace, whatever its size.
    groups: dict[str, Shape] = {}
    for name, piece in pieces.items():
        material = changed.get(name, piece.material)
        # Mitsuba takes no point in the id of a shape.
        shape = f"caviar-scenery-{material.name.replace('.', '%2E')}"
        group = groups.setdefault(material.name, Shape(shape, material, [], []))
        group.names.append(name)
        group.meshes.append(piece.mesh)
    return list(groups.values())


def with_detail(
    shapes: list[Shape], detail: DetailSettings, key: str
) -> tuple[list[Shape], DetailEffect | None]:
    """Give scenery the detail that the scenario asks for.

    Args:
        shapes: The scenery.
        detail: What is left out.
        key: Where the detail stands in the scenario.

    Returns:
        The shapes, and what that did to them; None where nothing was to be left out.

    Raises:
        ScenarioError: Nothing would be left.
    """
    if detail.is_full:
        return shapes, None
    pieces = [piece for shape in shapes for piece in zip(shape.names, shape.meshes, strict=True)]
    kept, effect = detailed(pieces, detail)
    if pieces and not kept:
        raise ScenarioError(f"{detail} leaves out all of the scenery; leave out less", key=key)
    left = dict(kept)
    return [
        Shape(shape.id, shape.material, names, [left[name] for name in names])
        for shape in shapes
        if (names := [name for name in shape.names if name in left])
    ], effect


# [m]; float32 has a step of 8 mm at this distance: what is farther from the centre is traced too coarsely.
_FARTHEST = 1e5


def bounds(shapes: Sequence[Shape]) -> tuple[Float64Array, Float64Array]:
    """Lowest and highest corner [m] of all shapes, Shape ``[3]`` each; the origin where there are none.

    Args:
        shapes: In world coordinates.
    """
    low, high = _boxes(shapes)
    return (low.min(0), high.max(0)) if len(low) else (np.zeros(3), np.zeros(3))


def _boxes(shapes: Sequence[Shape]) -> tuple[Float64Array, Float64Array]:
    """Lowest and highest corner [m] of each piece, Shape ``[N, 3]`` each."""
    vertices = [mesh.vertices for shape in shapes for mesh in shape.meshes if len(mesh.vertices)]
    low = np.array([corners.min(0) for corners in vertices]).reshape(-1, 3)
    return low, np.array([corners.max(0) for corners in vertices]).reshape(-1, 3)


def counting_centre(shapes: Sequence[Shape]) -> tuple[Float64Array, str]:
    """Choose where the ray tracer, which has float32 only, counts from.

    It is the middle of the scenery, or of most of it where some pieces are so far away that all others would
    be coarse: with one triangle at 1e8 m, a step of float32 is 4 m, and rays pass through vehicles.

    Args:
        shapes: The scenery.

    Returns:
        The centre [m], Shape ``[3]``, and a warning that names the farthest piece, empty where none is far.
    """
    low, high = _boxes(shapes)
    # The usual scene: its middle, so that products stay what they are.
    if not len(low) or (high.max(0) - low.min(0)).max() <= 2 * _FARTHEST:
        lowest, highest = bounds(shapes)
        return coarse_centre((lowest + highest) / 2), ""
    middles = (low + high) / 2
    near = np.array([((low >= m - _FARTHEST) & (high <= m + _FARTHEST)).all(1) for m in middles])
    # Where two places have as many pieces, that which is nearer to the origin counts.
    most = np.lexsort((np.abs(middles).max(1), -near.sum(1)))[0]
    kept = near[most] | (np.arange(len(near)) == most)
    centre = coarse_centre((low[kept].min(0) + high[kept].max(0)) / 2)
    reach = np.maximum(np.abs(low - centre), np.abs(high - centre)).max(1)
    far, step = int(reach.argmax()), np.spacing(np.float32(reach.max()))
    pieces = [piece for shape in shapes for piece in zip(shape.names, shape.meshes, strict=True)]
    names = [name for name, mesh in pieces if len(mesh.vertices)]
    return centre, (
        f"{WARNING}the piece {names[far]!r} of the scenery reaches from {_place(low[far])} to "
        f"{_place(high[far])}, where the ray tracer counts in steps of {step:.2g} m: paths by way of it are "
        "wrong by as much; move it nearer, or leave it out"
    )


def _place(corner: Float64Array) -> str:
    return f"({', '.join(f'{c:g}' for c in corner)}) m"


def own_materials(assets: Mapping[str, Path]) -> dict[str, str]:
    """Find the materials that meshes of objects name in their files, by asset.

    Args:
        assets: Files of the run by name.
    """
    named = {name: material_of(file) for name, file in assets.items() if is_object_mesh(name)}
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
        most_faces: Of a mesh (`with_few_faces`); None: any.

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
        most_faces: int | None = None,
    ) -> None:
        self._objects = objects
        self._own_materials = own
        self._later = _LaterMeshes()
        self._most_faces = most_faces
        self.notes: tuple[str, ...] = ()
        """What became of meshes with more faces."""
        units = self._read(assets)
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
        """Unit meshes of the kinds of bodies that there are."""
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
            meshes=self._read(meshes),
            materials=own_materials(meshes),
            changed=True,
        )

    def _read(self, files: Mapping[str, Path]) -> dict[str, Mesh]:
        meshes = object_meshes(files)
        if self._most_faces is None:
            return meshes
        for name, mesh in meshes.items():
            meshes[name], off = with_few_faces(mesh, self._most_faces)
            if off:
                faces = f"{len(mesh.faces):,} → {len(meshes[name].faces):,} faces"
                self.notes += (f"mesh {name!r}: {faces}, within {off:.2%} of its sides (object_faces)",)
        return meshes

    def make_room(self, scene: Scene, body_of: Mapping[int, tuple[str, str]]) -> bool:
        """Make bodies where a frame has more objects of a kind than there are bodies.

        A mesh of the beginning whose pool is 0 gets none: `assign` refuses its objects.

        Args:
            scene: The scene of a frame.
            body_of: Body of each of its objects that waves meet (`body_of`), by the object's index.

        Returns:
            Whether there are other bodies than before.
        """
        later = self._later
        needed = Counter(body_of.values())
        # Bodies that a mesh came for are made whatever the pools are; boxes stand in where it is not there.
        of_assets = {(scene.assets[i], body) for i, body in body_of.items()}
        came = {body for asset, body in of_assets if is_mesh_name(asset)}
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
        """True if meshes came for which bodies are not made yet."""
        return self._later.changed

    def body_of(self, scene: Scene, i: int) -> tuple[str, str]:
        """Mesh and material of the body of an object; the box for a mesh that is not there.

        Args:
            scene: The scene of a frame.
            i: Index of the object.
        """
        asset = scene.assets[i]
        if asset not in self._later.meshes:
            asset = shown_asset(asset, self._first.meshes)
        own = self._later.materials.get(asset) or self._own_materials.get(asset, "")
        return asset, self._objects.material_for(scene.names[i], scene.classes[i]) or own

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
