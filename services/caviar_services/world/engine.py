"""A program as a world, with the small surface that client libraries of other languages have.

A subclass of `Engine` says in `step` where its objects are, and `Engine.run` takes part in a run whose
scenario has a place for it (``use = "remote"``). `EngineWorld` makes of it the service that all worlds are:
devices, scenery, meshes, checkpoints, coming back.
"""

from __future__ import annotations

import logging
import sys
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, cast

import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_protocol.assets import ITU_MATERIALS
from caviar_protocol.errors import AssetError, CaviarError, PayloadError, suggestion
from caviar_protocol.messages import Input
from caviar_protocol.space.coordinates import Vector
from caviar_protocol.topics import Action
from caviar_protocol.topics.link import Command
from caviar_protocol.topics.scene import MESH_REFUSED_PREFIX
from caviar_services.checkpoint import restored, saved
from caviar_services.service import Frame, Preparation, Prepared, RunInfo, StepResult, series_of
from caviar_services.world.base import ObjectState, World, WorldSettings
from caviar_space.meshes import Mesh, fitted, ply
from caviar_space.mitsuba_xml import RadioMaterial, scenery_files

_log = logging.getLogger("caviar.service")

Triples = Float64Array | Sequence[Sequence[float]]
"""Rows of three numbers."""

SMALLEST_M = 0.01
"""[m] side of the box of a mesh that is refused and has none."""


class OfferedMesh(NamedTuple):
    """A mesh that was offered, as objects take it over."""

    mesh: str
    """For `ObjectState.mesh`; empty where it was refused, and its objects are boxes."""
    dimensions: Vector
    """Of its bounding box [m]."""
    centre: Vector
    """Of its bounding box in the axes of the mesh [m]: where `ObjectState.position` is."""


class SceneryMesh(NamedTuple):
    """A part of the static scenery."""

    name: str
    vertices: Triples
    """In world axes [m]."""
    triangles: Triples
    """Vertices of each, counter-clockwise as seen from outside."""
    material: str
    """One of those that are given beside it."""


class Engine(ABC):
    """Base of programs that are worlds; a subclass implements `step`, and what else it needs.

    Example:
        >>> class Street(Engine):
        ...     prefixes = ("car",)
        ...
        ...     def step(self, t, previous, commands):
        ...         at, level, velocity = (10 * t, 0.0, 0.75), (1.0, 0.0, 0.0, 0.0), (10.0, 0.0, 0.0)
        ...         yield ObjectState("car", "car", at, level, velocity, (4.6, 1.9, 1.5))
        >>> world = EngineWorld.of(Street())(WorldSettings(), RunInfo(name="world"))
        >>> world.reset(0, 1, 0)
        >>> world.step(Frame(episode=0, number=2, t_ns=200_000_000)).products["scene"].position.tolist()
        [[2.0, 0.0, 0.75]]
    """

    Settings: ClassVar[type[WorldSettings]] = WorldSettings
    """Of the scenario's ``[services.NAME.settings]``; a subclass may have more keys."""
    prefixes: tuple[str, ...] = ()
    """What names of its objects begin with; whole names where they are known."""
    settings: Any
    """As of ``Settings``, from `prepare` on."""
    seed_episode: int = 0
    """Number of the episode from the first one with its seed."""
    _world: EngineWorld

    def prepare(self) -> None:  # noqa: B027 - optional hook
        """Load, and offer meshes and scenery; called again when the world comes back to a run."""

    def reset(self, seed: int, t0: float) -> None:  # noqa: B027 - optional hook
        """Go to the first state of an episode.

        Args:
            seed: Randomness depends on it and on ``seed_episode`` alone.
            t0: Time of frame 0 in the run [s].
        """

    @abstractmethod
    def step(self, t: float, previous: float, commands: Sequence[Command]) -> Iterable[ObjectState]:
        """The objects at an instant.

        Args:
            t: Time since frame 0 [s].
            previous: That of the frame before, from which the engine advances; in frame 0 it is ``t``.
            commands: Of agents, in the frame before.

        Returns:
            Those that came first in front: they get the devices of a scenario first.
        """

    def save(self) -> bytes:
        """The state that outlives a frame; empty where time, seed and settings say all."""
        return b""

    def restore(self, state: bytes) -> None:  # noqa: B027 - optional hook
        """Take over what `save` returned, also in another process.

        Meshes that came while the run went on are not in it: offer those of its objects again.

        Args:
            state: The bytes.
        """

    def offer_mesh(self, name: str, vertices: Triples, triangles: Triples, material: str = "") -> OfferedMesh:
        """Bring the mesh of objects.

        In `prepare` it is there for the whole run. Later it comes while the run goes on: it stays as long as
        an object has it, and 20 frames longer, until the episode ends. Offering it again changes nothing.

        Args:
            name: Of the mesh.
            vertices: x forward, y left, z up [m], Shape ``[V, 3]``.
            triangles: Vertices of each, counter-clockwise as seen from outside, Shape ``[F, 3]``.
            material: Of Recommendation ITU-R P.2040; empty: what the channel's settings say.

        Raises:
            AssetError: In `prepare`: it is none. Later that is logged, and its objects are boxes.
        """
        return self._world.offer_mesh(name, vertices, triangles, material)

    def offer_scenery(self, meshes: Iterable[SceneryMesh], materials: Mapping[str, RadioMaterial]) -> None:
        """Bring the static scenery, in `prepare`; at most one world of a run does.

        Args:
            meshes: In world axes [m].
            materials: By the names that the meshes have.

        Raises:
            AssetError: A mesh is none, or a material is not one of Recommendation ITU-R P.2040.
        """
        self._world.offer_scenery(meshes, materials)

    def run(self, endpoint: str = "", name: str = "") -> int:
        """Take part in a run until it is over; keys are those of the environment (``CAVIAR_KEY``).

        Args:
            endpoint: ``tcp://HOST:PORT`` of the broker.
            name: Of this world in the scenario.

        Returns:
            The exit status of the process: 0 after SHUTDOWN, 1 where it failed, was refused or is blamed, 143
            after SIGTERM, 2 without arguments. Why is written to standard error.
        """
        from caviar_services.runner import Runner, SignalTermination

        if not endpoint or not name:
            sys.stderr.write(f"usage: python {sys.argv[0]} tcp://HOST:PORT NAME\n")
            return 2
        logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s %(message)s")
        _log.info("%s: waiting for the broker at %s", name, endpoint)
        try:
            cls = EngineWorld.of(self)
            runner = Runner(name, cls, type(self).__name__, endpoint, termination=SignalTermination())
            status = runner.run()
        except CaviarError as error:
            sys.stderr.write(f"{name}: {error}\n")
            return 1
        if runner.ended:
            _log.info("%s: the run is over: %s", name, runner.ended)
        return 1 if status == 0 and runner.failed else status


class _State(msgspec.Struct, frozen=True, array_like=True):
    """What outlives a frame."""

    elapsed_ns: int
    arrived: tuple[str, ...]
    own: bytes


class EngineWorld(World[WorldSettings]):
    """The world of an `Engine`.

    Args:
        settings: Of the engine's class.
        run: What the world knows about the run.
    """

    inputs: ClassVar[tuple[Input, ...]] = (Input(topic="action", lag=1, required=False),)
    checkpoints: ClassVar[bool] = True
    changes_geometry: ClassVar[bool] = True
    engine: ClassVar[Engine]

    @classmethod
    def of(cls, engine: Engine) -> type[EngineWorld]:
        """Make the class of an engine's world.

        Args:
            engine: Which every incarnation of the world has.
        """
        members: dict[str, Any] = {"engine": engine, "Settings": type(engine).Settings}
        members["__module__"] = type(engine).__module__
        return cast(type[EngineWorld], type(f"{type(engine).__name__}World", (cls,), members))

    def __init__(self, settings: WorldSettings, run: RunInfo) -> None:
        super().__init__(settings, run)
        self._engine = self.engine
        self._engine._world, self._engine.settings = self, settings
        self._files: dict[str, bytes] | None = None
        self._is_prepared = False
        # Time of the frame before since frame 0 [ns]; −1: none.
        self._elapsed_ns = -1
        self._commands: list[Command] = []
        self._refusals: set[str] = set()
        # Of these, what the report of the next frame has.
        self._refused: dict[str, int] = {}

    def prefixes(self) -> tuple[str, ...]:
        """Those of the engine."""
        prefixes = self._engine.prefixes
        if isinstance(prefixes, str):
            author = f"{type(self._engine).__name__}.prefixes"
            raise PayloadError(f"{author} is {prefixes!r}; write ({prefixes!r},)")
        return tuple(prefixes)

    def mesh_classes(self) -> tuple[str, ...]:
        """None: an engine has meshes of its own."""
        return ()

    def scenery(self) -> Mapping[str, Path | bytes]:
        """What the engine offers while it is prepared, and the files that the scenario names."""
        if self._files is None:
            self._files = {}
            self._engine.prepare()
            self._is_prepared = True
        return {**super().scenery(), **self._files}

    def prepare(self, preparation: Preparation) -> Prepared:
        """Declare the names of the engine's objects."""
        self.scenery()
        return super().prepare(preparation)

    def begin(self, episode: int, seed: int) -> None:
        """Reset the engine."""
        self._elapsed_ns = -1
        self._refusals.clear()
        self._refused = {}
        self._engine.seed_episode = episode
        self._engine.reset(seed, self._t0_ns / 1e9)

    def step(self, frame: Frame) -> StepResult:
        """Advance the engine, with the commands of the frame before."""
        self._commands = [c for action in frame.payloads("action", Action).values() for c in action.commands]
        made = super().step(frame)
        refused, self._refused = self._refused, {}
        return msgspec.structs.replace(made, counts={**made.counts, **refused})

    def objects_at(self, elapsed_ns: int) -> Iterable[ObjectState]:
        """The engine's objects."""
        before, self._elapsed_ns = self._elapsed_ns, elapsed_ns
        previous_ns = elapsed_ns if before < 0 else before
        objects = self._engine.step(elapsed_ns / 1e9, previous_ns / 1e9, self._commands)
        return series_of(ObjectState, f"{type(self._engine).__name__}.step", objects)

    def checkpoint(self) -> bytes:
        """The state of the engine, and which of its objects came first."""
        state = self._engine.save()
        if not isinstance(state, bytes):
            author = f"{type(self._engine).__name__}.save"
            raise PayloadError(f"{author} returned {type(state).__name__}, and a state is bytes")
        return saved(self, 1, _State(self._elapsed_ns, self._mounts.arrived, state))

    def restore(self, state: bytes) -> None:
        """See `checkpoint`."""
        was = restored(self, 1, _State, state)
        self._elapsed_ns = was.elapsed_ns
        self._mounts.clear(was.arrived)
        self._engine.restore(was.own)

    def offer_mesh(self, name: str, vertices: Triples, triangles: Triples, material: str) -> OfferedMesh:
        """See `Engine.offer_mesh`."""
        mesh = _mesh(vertices, triangles)
        try:
            self._check(mesh, material)
            unit, dimensions, centre = fitted(mesh)
        except (AssetError, PayloadError) as error:
            problem = f"mesh {name!r}: {error}"
            if not self._is_prepared:
                raise AssetError(problem) from error
            if problem not in self._refusals:
                self._refusals.add(problem)
                self._refused[f"{MESH_REFUSED_PREFIX}{name}"] = 1
                _log.warning("%s; objects with it are boxes", problem)
            # Dimensions and centre of the finite vertices of what is no mesh.
            there = mesh.vertices[np.isfinite(mesh.vertices).all(axis=1)]
            if not len(there):
                there = np.zeros((1, 3))
            low, high = there.min(axis=0), there.max(axis=0)
            return OfferedMesh("", _vector(np.maximum(high - low, SMALLEST_M)), _vector((low + high) / 2))
        content = ply(unit, material)
        file = f"objects/{name}.ply"
        asset = self.add_mesh(content) if self._is_prepared else self._offered(file, content)
        return OfferedMesh(asset, _vector(dimensions), _vector(centre))

    def offer_scenery(self, meshes: Iterable[SceneryMesh], materials: Mapping[str, RadioMaterial]) -> None:
        """See `Engine.offer_scenery`."""
        shapes = {}
        for name, vertices, triangles, material in meshes:
            shapes[name] = _mesh(vertices, triangles), material
            try:
                self._check(shapes[name][0], "")
            except AssetError as error:
                raise AssetError(f"scenery {name!r}: {error}") from error
        for name, content in scenery_files("scene", shapes, materials).items():
            self._offered(name, content)

    def _offered(self, name: str, content: bytes) -> str:
        if self._is_prepared or self._files is None:
            raise AssetError(f"{name} comes after the run began; offer it in prepare()")
        self._files[name] = content
        return name

    def _check(self, mesh: Mesh, material: str) -> None:
        most = self._meshes.max_faces if self._is_prepared else 0
        if not np.isfinite(mesh.vertices).all():
            raise AssetError("a vertex is not finite")
        if not len(mesh.faces):
            raise AssetError("it has no triangles")
        if most and len(mesh.faces) > most:
            raise AssetError(f"it has {len(mesh.faces)} triangles, and this run takes {most}")
        if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
            raise AssetError(f"a triangle has a corner that is none of its {len(mesh.vertices)} vertices")
        if material and material not in ITU_MATERIALS:
            raise AssetError(
                f"ITU-R P.2040 has no material {material!r}; {suggestion(material, ITU_MATERIALS)}"
            )


def _mesh(vertices: Triples, triangles: Triples) -> Mesh:
    return Mesh(
        np.asarray(vertices, np.float64).reshape(-1, 3), np.asarray(triangles, np.int32).reshape(-1, 3)
    )


def _vector(numbers: Float64Array) -> Vector:
    x, y, z = numbers.tolist()
    return (x, y, z)
