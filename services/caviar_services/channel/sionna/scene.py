"""Scenery and moving bodies in Sionna RT: loaded once, moved in one update a frame.

Every further shape makes each trace a millisecond longer, whatever its size. So there is one
shape for each material, and a table that says which triangles belong to what (`NumberedTriangles`); paths
still name the single building and vehicle.

The ray tracer counts in float32, whose step is 1 mm at 10 km. So it is given the scene relative to
`SionnaScene.centre`, and callers get what its paths meet in float64 and in world coordinates: the
scenery's corners as they stand in the files, and those of moving bodies from their poses.

Models of one process that need equal scenes share one within `shared_scenes`: the ray-traced rungs of an
adaptive ladder mostly do.
"""

from __future__ import annotations

import gc
import math
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from caviar_protocol.arrays import Float64Array, Int64Array
from caviar_protocol.errors import PayloadError, ScenarioError
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT
from caviar_protocol.topics import Scene
from caviar_services.channel.paths import Turning
from caviar_services.channel.propagation.utd import Media
from caviar_services.channel.sionna import mi
from caviar_services.channel.sionna.diffracting_edges import SceneEdges
from caviar_services.channel.sionna.scene_loading import (
    BodyPool,
    ObjectMaterial,
    Shape,
    bounds,
    by_material,
    counting_centre,
    file_pieces,
    floats,
    itu_materials,
    mi_mesh,
    new_scene,
    object_materials,
    own_materials,
    set_materials,
    with_detail,
)
from caviar_services.channel.sionna.triangle_numbering import (
    NumberedTriangles,
    closed_walls,
    coinciding_materials,
)
from caviar_space.materials import (
    BODY_THICKNESS,
    EPSILON_0,
    OBJECT_MATERIAL,
    Constants,
    ItuMaterial,
    MaterialPolicy,
    ObjectMaterials,
    OutsideUse,
    SurfaceMaterial,
    UsedSurfaces,
    body_kind,
    itu_material,
)
from caviar_space.mesh_detail import DetailSettings
from caviar_space.meshes import Body, Mesh, coarse_centre, placed_objects, unit_box
from caviar_space.mitsuba_xml import find_scenery

# Frequency [Hz] of a carrier, and what is to be set at materials.
_Tuning = tuple[float, list[tuple[Any, Constants]]]

# [rad]; a phase of 2e9 in a slab is NaN.
_MOST_PHASE = 5e8

_SKIN = "caviar-body"
_NOTHING = "caviar-nothing"

_SKIN_NAME = "body_material"
_OTHER_SKIN = "choose another body_material"


@dataclass(frozen=True, kw_only=True)
class SceneSettings:
    """Settings of a scene, beside its files; equal ones share a scene within `shared_scenes`."""

    frequencies_hz: tuple[float, ...]
    """Of the carriers. The scene is at the first one, unless it is tuned to another."""
    body_material: str
    """ITU-R P.2040 material of bodies without one of their own."""
    materials: MaterialPolicy
    edges: bool
    """Look for the edges between faces (diffraction)."""
    free_edges: bool = False
    """Whether the rims of open surfaces are edges too."""
    detail: DetailSettings = field(default_factory=DetailSettings)
    """What of the scenery is left out."""
    object_faces: int | None = None
    """Faces of an object's mesh at most; None: any number."""
    solid_walls_m: float | None = None
    """Closed plates up to this thickness are one slab of it; None: a slab for each of their faces."""
    objects: ObjectMaterials = field(default_factory=ObjectMaterials)
    """Of what objects and pieces of scenery are made that differ from the others."""
    foliage: ObjectMaterials = field(default_factory=ObjectMaterials)
    """Which objects and pieces of scenery are foliage: waves do not meet them."""
    pool_keys: Mapping[str, str] = field(default_factory=dict, compare=False)
    """Key of the scenario that says how many bodies there are, by asset, for errors."""


class SionnaScene(NumberedTriangles):
    """The triangles of a `sionna.rt.Scene` with a pool of bodies for moving objects.

    Bodies that stand for no object are shrunk to a point: a triangle without area is never hit.

    Args:
        assets: Files of the run by name: scene description, its meshes, and meshes of objects.
        pool: How many bodies of each asset there are at first; an empty asset is the box, 0 forbids any.
        settings: Materials, edges and detail.

    Raises:
        AssetError: A file is not what it should be.
        ScenarioError: A material is not known, not defined at a carrier, or has a bad value.
    """

    def __init__(self, assets: Mapping[str, Path], pool: Mapping[str, int], settings: SceneSettings) -> None:
        from sionna.rt import RadioMaterial

        self._settings = settings
        self.bodies_version = 0
        """Counts how often bodies were made anew while the run goes on."""
        self.compiled: list[object] = []
        """Of what has traced in it, and has its kernels (`PathFinder.compile_kernels`)."""
        self._rt_objects: list[tuple[Shape, Any]] = []
        own = own_materials(assets)
        skins = self._skins = self._skin_materials(pool, settings, own)
        description = find_scenery(assets)
        pieces, self.notes = file_pieces(
            description, settings.foliage, settings.solid_walls_m, settings.objects
        )
        """Warnings for the user about the scenery."""
        self._scene = new_scene(piece.material for piece in pieces.values() if piece.material is not None)
        self._objects, self._foliage = settings.objects, settings.foliage
        leaves = [name for name in pieces if self._foliage.material_for(name)]
        self.foliage_meshes = {name: pieces.pop(name).mesh for name in leaves}
        """Pieces of scenery that are foliage, by name; no shape has them."""
        self._scenery = frozenset(pieces)
        made = object_materials(self._objects, settings.frequencies_hz, settings.materials)
        made = self._made = self._with_materials_of_meshes(made, set(own.values()))
        changed = {name: made[m].radio for name in self._scenery if (m := self._objects.material_for(name))}
        full = by_material(pieces, changed)
        key = f"{settings.materials.key}.detail"
        shapes, self.detail_effect = with_detail(full, settings.detail, key)
        self.low, self.high = bounds(shapes)
        # Made after the scenery was read, whose faults are named first.
        self._pool = BodyPool(
            assets, pool, settings.pool_keys, self._objects, own, made, settings.object_faces
        )
        self.notes += self._pool.notes
        self._at_rest = shapes
        self._standing: frozenset[Body] = frozenset()
        self._known_bodies: tuple[object, Mapping[int, tuple[str, str]]] = (), {}
        # Vertices of bodies that the ray tracer has, and the version of the scene that they are of.
        self._shown, self._shown_version = np.zeros((0, 3)), -1
        self.turning: Turning | None = None
        """How the objects turn that bodies stand for, by the names that `place` returned; None: none does."""
        self._skin = RadioMaterial(
            f"{_SKIN}-skin", BODY_THICKNESS, *(skins[0].constants if skins else (1.0, 0.0))
        )
        self._moving = self._body_shapes()
        self._shapes = [*shapes, *self._moving]
        # The note names the piece that is so far from the others that the ray tracer is coarse there.
        centre, far_note = counting_centre(shapes)
        self.notes += (far_note,) if far_note else ()
        super().__init__(
            self._shapes,
            self._replace_shapes(centre),
            self._pool.bodies,
            self._pool.meshes,
            centre,
            len(self._moving),
        )
        self.notes += coinciding_materials(shapes, self.plane_of[: self._first_moving])
        self.edges: SceneEdges | None = None
        """None where nothing is diffracted."""
        if settings.edges:
            self.edges = SceneEdges(self, self.unit_meshes, settings.free_edges)
        set_materials(self._scene, settings.frequencies_hz[0], settings.materials, made)
        self._set_carriers()

    def _skin_materials(
        self, pool: Mapping[str, int], settings: SceneSettings, own: Mapping[str, str]
    ) -> list[ItuMaterial]:
        """The material of bodies without one of their own, on each carrier; none without bodies."""
        self._skin_error: ScenarioError | None = None
        """Why no object may have `body_material`; None: objects may."""
        policy = settings.materials
        if not any(pool.values()):
            return []
        try:
            return [
                itu_material(_SKIN_NAME, settings.body_material, frequency, policy, _OTHER_SKIN)
                for frequency in settings.frequencies_hz
            ]
        except ScenarioError as error:
            # Meshes of objects are of it for sure where none names a material; of boxes, and of objects
            # with a material of their own, nothing may be made of it.
            if not settings.objects.by_key and any(mesh and mesh not in own for mesh in pool):
                raise
            self._skin_error, policy = error, replace(policy, outside="nearest")
        return [
            itu_material(_SKIN_NAME, settings.body_material, frequency, policy)
            for frequency in settings.frequencies_hz
        ]

    def _set_carriers(self) -> None:
        """Note what materials have on each carrier, and which are used where they are not defined."""
        settings, skins = self._settings, self._skins
        self._carriers: list[_Tuning] = []
        self.outside: tuple[OutsideUse, ...] = ()
        """Materials used where they are not defined, by carrier."""
        # Of meshes that are gone, materials stay known to the ray tracer, and are used by nothing.
        used_by_bodies = {m for m, bodies in self._pool.of_material.items() if bodies} | set(
            self._objects.names
        )
        made = {name: of for name, of in self._made.items() if name in used_by_bodies}
        for carrier, frequency in enumerate(settings.frequencies_hz):
            found = itu_materials(self._scene, frequency, settings.materials)
            used = [(material.name, itu, constants) for material, itu, constants in found]
            tuned = [(material, constants) for material, _, constants in found]
            if skins and self._skin_error is None:
                used.append((_SKIN_NAME, skins[carrier], skins[carrier].constants))
            if skins:
                tuned.append((self._skin, skins[carrier].constants))
            used += [(name, of.itu[carrier], of.constants[carrier]) for name, of in made.items() if of.itu]
            tuned += [(of.radio, of.constants[carrier]) for of in made.values()]
            self._carriers.append((frequency, tuned))
            self.outside += tuple(
                OutsideUse(name=name, carrier=carrier, itu=itu, constants=constants)
                for name, itu, constants in used
                if itu.is_outside
            )
        self._limit_thickness()

    def _limit_thickness(self) -> None:
        """Make no slab so thick that the ray tracer, in float32, has no sine of the phase in it: paths by
        way of it would be NaN, and lost."""
        for carrier, (frequency, _) in enumerate(self._carriers):
            self.tune(carrier)
            for material in {id(shape.material): shape.material for shape in self._shapes}.values():
                permittivity, conductivity = _constants(material)
                eta = abs(complex(permittivity, conductivity / (2 * math.pi * frequency * EPSILON_0)))
                most = _MOST_PHASE * SPEED_OF_LIGHT / (2 * math.pi * frequency * math.sqrt(eta))
                if float(material.thickness[0]) > most:
                    material.thickness = most
        self.tune(0)

    @property
    def mi_scene(self) -> Any:
        """The Mitsuba scene as it stands, in metres relative to `centre`."""
        return self.rt_scene.mi_scene

    @property
    def rt_scene(self) -> Any:
        """The `sionna.rt.Scene` as it stands, in metres relative to `centre`.

        Bodies are moved in it when it is asked for: an update takes a fifth of a frame of enumerated paths.
        """
        if self._shown_version != self.version:
            bodies = self.relative[len(self.vertices) - len(self._vertices) :]
            end, params = 0, self._scene.mi_scene_params
            for shape in self._moving:
                begin, end = end, end + sum(len(mesh.vertices) for mesh in shape.meshes)
                # Each update rebuilds the tree of a shape: only of those that moved.
                if not np.array_equal(self._shown[begin:end], bodies[begin:end]):
                    params[f"{shape.id}.vertex_positions"] = floats(bodies[begin:end])
            params.update()
            self._shown, self._shown_version = bodies.copy(), self.version
        return self._scene

    @cached_property
    def mi_scenery(self) -> Any:
        """The scenery alone, a `mitsuba.Scene` in metres relative to `centre`."""
        shapes = {shape.id: item.mi_mesh for shape, item in self._rt_objects if shape in self._at_rest}
        return mi.load_dict({"type": "scene", **shapes})

    @property
    def wavelengths(self) -> tuple[float, ...]:
        """Wavelengths of the carriers [m]."""
        return tuple(SPEED_OF_LIGHT / frequency for frequency, _ in self._carriers)

    def tune(self, carrier: int) -> None:
        """Set frequency and materials to those of a carrier.

        Args:
            carrier: Its index.
        """
        frequency, constants = self._carriers[carrier]
        for material, (permittivity, conductivity) in constants:
            material.relative_permittivity, material.conductivity = permittivity, conductivity
        self._scene.frequency = frequency

    def used_surfaces(self) -> UsedSurfaces:
        """Surfaces that waves can meet, at rest and moving."""
        constants, slabs = self._surface_materials
        # Bodies that stand for nothing count: which objects will come is not known.
        used = [(i, shape) for i, shape in enumerate(self._shapes) if shape.id != _NOTHING]
        return UsedSurfaces(
            materials=tuple(
                SurfaceMaterial(
                    name=_material_name(shape),
                    constants=tuple((float(p), float(c)) for p, c in constants[:, :, i].T),
                    thickness_m=float(slabs[0, i]),
                    scattering_coefficient=float(slabs[1, i]),
                )
                for i, shape in used
            ),
            has_edges=self.edges is not None and len(self.edges) > 0,
        )

    def closed_walls(self, transparent: Collection[str]) -> tuple[str, ...]:
        """Warnings of closed thin walls, each face of which is a slab.

        Args:
            transparent: Names of the materials (`used_surfaces`) that waves go through.
        """
        ids = {shape.id for shape in self._at_rest if _material_name(shape) in transparent}
        return closed_walls(self._at_rest, self.part_of[: self._first_moving], ids)

    @cached_property
    def _surface_materials(self) -> tuple[Float64Array, Float64Array]:
        """Permittivity and conductivity [S/m] of each shape on each carrier, Shape ``[2, C, S]``, and
        thickness [m] and scattering coefficient, Shape ``[2, S]``."""
        constants = []
        # The ray tracer has the constants of one carrier at a time; here are those of all, once for the run.
        for carrier in range(len(self._carriers)):
            self.tune(carrier)
            constants.append([_constants(shape.material) for shape in self._shapes])
        self.tune(0)
        slabs = [
            (float(material.thickness[0]), float(material.scattering_coefficient[0]))
            for material in (shape.material for shape in self._shapes)
        ]
        return np.moveaxis(np.array(constants), -1, 0), np.array(slabs).T

    def media(self, shapes: Int64Array) -> Media:
        """Materials of process-local shapes; anything for no shape.

        Args:
            shapes: Of any Shape.
        """
        of = self._shape_order[self._where(shapes)]
        constants, slabs = self._surface_materials
        return Media(*constants[..., of], *slabs[:, of])

    @property
    def unit_meshes(self) -> Mapping[str, Mesh]:
        """Unit meshes of the kinds of bodies that there are (`body_kind`)."""
        return self._pool.unit_meshes

    @property
    def standing_bodies(self) -> tuple[int, ...]:
        """Numbers of the bodies that stand for an object, in ascending order."""
        return tuple(sorted(self._piece_of[body] - self.first_body_piece for body in self._standing))

    # --- meshes that come while the run goes on ------------------------------------------------------

    def use_meshes(self, meshes: Mapping[str, Path]) -> None:
        """Take meshes that objects may have from the next frame on, beside those of the beginning.

        Bodies for them are made by `make_room`, when it is known how many objects have them.

        Args:
            meshes: Files by asset name; those of an earlier call that are not here are gone.

        Raises:
            AssetError: A file is no mesh.
        """
        self._pool.use_meshes(meshes)
        self._known_bodies = (), {}

    def make_room(self, scene: Scene, without_body: frozenset[str]) -> None:
        """Make bodies where there are too few for the objects of a scene.

        Then `bodies_version` is another, and what was made of the bodies before is of no use.

        Args:
            scene: The scene of a frame.
            without_body: Classes of objects that waves pass through.
        """
        if self._pool.awaits_meshes:  # before bodies are: where a material is refused, nothing has changed
            self._made = self._with_materials_of_meshes(self._made, self._pool.named_materials())
        if not self._pool.make_room(scene, self._body_of(scene, without_body)):
            return
        self._skins = self._skins or self._skin_materials({"": 1}, self._settings, {})
        self._moving = self._body_shapes()
        self._shapes = [*self._at_rest, *self._moving]
        version, ids = self.version, self._replace_shapes(self.centre)
        super().__init__(
            self._shapes, ids, self._pool.bodies, self._pool.meshes, self.centre, len(self._moving)
        )
        self.version = version + 1
        self._standing, self._shown_version = frozenset(), -1
        self.bodies_version += 1
        self.__dict__.pop("_surface_materials", None)
        if self.edges is not None:
            self.edges = SceneEdges(self, self.unit_meshes, self._settings.free_edges)
        self._set_carriers()

    def _with_materials_of_meshes(
        self, made: Mapping[str, ObjectMaterial], named: set[str]
    ) -> dict[str, ObjectMaterial]:
        """Materials of bodies, with those that meshes name."""
        # A mesh says what it is made of wherever it is used: where P.2040 does not define that at a carrier,
        # the nearest constants count.
        policy = self._settings.materials
        if policy.outside == "error":
            policy = replace(policy, outside="nearest")
        own = ObjectMaterials({name: name for name in sorted(named - made.keys())})
        return {**made, **object_materials(own, self._settings.frequencies_hz, policy)}

    def place(self, scene: Scene, without_body: frozenset[str]) -> tuple[tuple[str, ...], Float64Array]:
        """Move the bodies to the objects of a scene, in one update; foliage has none.

        Args:
            scene: The scene of a frame.
            without_body: Classes of objects that waves pass through.

        Returns:
            The names that the indices of `object_index` stand for, and their velocities [m/s], Shape
            ``[len(names), 3]``.

        Raises:
            PayloadError: The pool is too small, or an object has the name of a piece of scenery.
            ScenarioError: An object is of `body_material`, which is not defined at a carrier.
        """
        kinds = {i: body_kind(*body) for i, body in self._body_of(scene, without_body).items()}
        if self._skin_error is not None:
            of_skin = {kind for kind, _ in self._pool.of_material[""]}
            if of_skin.intersection(kinds.values()):
                raise self._skin_error
        return self.place_bodies(scene, kinds)

    def _body_of(self, scene: Scene, without_body: frozenset[str]) -> Mapping[int, tuple[str, str]]:
        """Mesh and material of the body of each object that waves meet, by the object's index."""
        of = scene.names, scene.classes, scene.assets, without_body
        if of != self._known_bodies[0]:  # mostly the same objects as in the frame before
            self._known_bodies = (
                of,
                {
                    i: self._pool.body_of(scene, i)
                    for i, cls in enumerate(scene.classes)
                    if cls not in without_body and not self._foliage.material_for(scene.names[i], cls)
                },
            )
        return self._known_bodies[1]

    def place_bodies(self, scene: Scene, kinds: Mapping[int, str]) -> tuple[tuple[str, ...], Float64Array]:
        """Move bodies of given kinds to some objects; else as `place`.

        Args:
            scene: The scene of a frame.
            kinds: Kind of the body of each object (`body_kind`), by the object's index in the scene.
        """
        solid = list(kinds)
        index = {scene.names[i]: i for i in solid}
        clash = self._scenery & index.keys()
        if clash:
            raise PayloadError(f"object {min(clash)!r} has the name of a piece of scenery; rename one")
        # Without scenery nothing else says where the world is, and far from the origin float32 is coarse.
        if not self.has_scenery and solid:
            positions = scene.position[solid]
            centre = coarse_centre((positions.min(0) + positions.max(0)) / 2)
            if (centre != self.centre).any():
                self.low, self.high = self.low + (centre - self.centre), self.high + (centre - self.centre)
                self.count_from(centre)
        # A new assignment each frame: the product follows from this frame alone, also after a restart.
        objects = ((scene.names[i], kind) for i, kind in kinds.items())
        taken = self._pool.assign(objects)
        standing = {body: index[name] for name, body in taken.items()}
        names, velocity = list(self.names), np.zeros((len(self.names), 3))
        pieces, rows = [self._piece_of[body] for body in standing], list(standing.values())
        velocity[pieces] = scene.velocity[rows]
        turning = None
        if scene.angular_velocity is not None and scene.angular_velocity.any():
            turning = Turning(np.zeros_like(velocity), np.zeros_like(velocity))
            turning.centre[pieces] = scene.position[rows]
            turning.angular_velocity[pieces] = scene.angular_velocity[rows]
        vertices, meshes = self._vertices.copy(), self._pool.meshes
        first = self._first_vertices - (len(self.vertices) - len(vertices))
        for body in self._standing.difference(standing):
            begin = first[self._piece_of[body]]
            vertices[begin : begin + len(meshes[body[0]].vertices)] = self._middle
        placed = placed_objects([meshes[kind] for kind, _ in standing], scene, rows)
        for piece, i, corners in zip(pieces, rows, placed, strict=True):
            vertices[first[piece] : first[piece] + len(corners)] = corners
            names[piece] = scene.names[i]
        self.move(vertices)
        self._standing, self.turning = frozenset(standing), turning
        return tuple(names), velocity

    @property
    def has_scenery(self) -> bool:
        """True if anything stands still; `low` and `high` are its corners."""
        return bool(self._scenery)

    def enclosing(self, position: Float64Array) -> int:
        """See `NumberedTriangles.enclosing`; below its lowest point, no scenery is around anything.

        Args:
            position: [m], Shape ``[3]``.
        """
        piece = super().enclosing(position)
        # Below the ground a ray upwards meets it once, and yet the point is inside of nothing.
        return piece if piece >= self.first_body_piece or position[2] >= self.low[2] else -1

    @property
    def _middle(self) -> Float64Array:
        return (self.low + self.high) / 2

    def _body_shapes(self) -> list[Shape]:
        """The bodies as a shape of each material; none of them stands for anything yet."""
        shapes = []
        for material, bodies in self._pool.of_material.items():
            if bodies:
                name = f"{_SKIN}-of-{material}" if material else _SKIN
                radio = self._made[material].radio if material else self._skin
                names = [f"{_SKIN}-{kind or 'box'}-{slot}" for kind, slot in bodies]
                meshes = [self._shrunk(self._pool.meshes[kind]) for kind, _ in bodies]
                shapes.append(Shape(name, radio, names, meshes))
        # The ray tracer needs a shape also where there is neither scenery nor a body.
        return shapes or [Shape(_NOTHING, self._skin, [_NOTHING], [self._shrunk(unit_box())])]

    def _shrunk(self, mesh: Mesh) -> Mesh:
        """A mesh as a point, which no ray hits."""
        return Mesh(np.tile(self._middle, (len(mesh.vertices), 1)), mesh.faces)

    def _replace_shapes(self, centre: Float64Array) -> Int64Array:
        """Put the shapes in place of what was there. Returns their process-local numbers."""
        from sionna.rt import SceneObject

        # Scenery that is there stays: its shapes are those of the first call.
        there = {shape.id: item for shape, item in self._rt_objects if shape in self._at_rest}
        made = [
            (
                shape,
                there.get(shape.id)
                or SceneObject(mi_mesh=mi_mesh(shape, centre), radio_material=shape.material),
            )
            for shape in self._shapes
        ]
        kept = set(there.values())
        self._scene.edit(
            add=[item for _, item in made if item not in kept],
            remove=[item for item in self._scene.objects.values() if item not in kept],
        )
        self._rt_objects = made
        # A scene refers to itself: until the one before is collected, kernels branch over what is in it, too.
        gc.collect()
        return np.array([item.object_id for _, item in made], np.int64)


def _material_name(shape: Shape) -> str:
    """Name of a shape's material, as a scenario has it."""
    name: str = shape.material.name
    return _SKIN_NAME if shape.id == _SKIN else name.removeprefix(OBJECT_MATERIAL)


def _constants(material: Any) -> Constants:
    return float(material.relative_permittivity[0]), float(material.conductivity[0])


MadeScene = tuple[tuple[Any, ...], SionnaScene]
"""A scene made within `shared_scenes`, after what it was made of."""
_made: ContextVar[list[MadeScene] | None] = ContextVar("made", default=None)


@contextmanager
def shared_scenes(made: list[MadeScene] | None = None) -> Iterator[None]:
    """Within, `scene_of` returns one scene for equal arguments.

    Models that share a scene take turns: each frame of one places the bodies anew.

    Args:
        made: Scenes that were made before, to which those that are made are added; None: those of
            `shared_scenes` around this one, or else none.

    Example:
        >>> with shared_scenes():
        ...     pass  # prepare the models of a ladder
    """
    outer = _made.get()
    token = _made.set(made if made is not None else outer if outer is not None else [])
    try:
        yield
    finally:
        _made.reset(token)


def scene_of(assets: Mapping[str, Path], pool: Mapping[str, int], settings: SceneSettings) -> SionnaScene:
    """Make a scene, or return an equal one that was made before within `shared_scenes`.

    Args:
        assets, pool, settings: As for `SionnaScene`.
    """
    made, wanted = _made.get(), (dict(assets), dict(pool), settings)
    for known, scene in made or ():
        if known == wanted:
            return scene
    scene = SionnaScene(assets, pool, settings)
    if made is not None:
        made.append((wanted, scene))
    return scene
