"""The ray-traced rungs: Sionna RT finds the paths; ``rung`` says what becomes of the arrays.

``siso-rt`` traces between the arrays' centres and applies the arrays as plane waves, ``spherical`` gives
each antenna pair its own length of the same paths (`spherical`), ``mimo-rt`` traces every pair (`mimo_rt`).
They are one implementation with one scene and one set of options, so a rung is a setting like any other.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from caviar_protocol.arrays import Float64Array, Int64Array, quantity
from caviar_protocol.coordinates import SPEED_OF_LIGHT
from caviar_protocol.errors import PayloadError, ScenarioError, SetupError
from caviar_protocol.seeding import derive_seed
from caviar_protocol.topics import AntennaDevice, ChannelOptions, Scene
from caviar_services.channel.assemble import Antenna, Matrices, PathTable
from caviar_services.channel.base import Found, PathModel
from caviar_services.channel.mimo_rt import ElementTracer, targets_at_once
from caviar_services.channel.sionna_materials import MaterialSettings, OutsideRange
from caviar_services.channel.sionna_scene import SceneSettings, SionnaScene
from caviar_services.channel.sionna_tracer import LaunchOptions, Traced, Tracer
from caviar_services.channel.specular import refined_points
from caviar_services.channel.spherical import SphericalWaves, nearest_in
from caviar_services.channel.traced_surfaces import traced_surfaces
from caviar_services.llvm import activate_llvm, choose_variant
from caviar_services.service import Preparation, RunInfo

Array = NDArray[Any]

_LANES = 20_000_000
"""Samples · depth · receivers of one launch at most: 40 B each in the solver."""

_SAMPLES = 100_000

_COMPILE_GRACE_S = 120.0


class SionnaSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is modelled, and how finely."""

    max_depth: Annotated[int, quantity("1", "interactions of a path at most", ge=0, le=16)] = 3
    rung: Literal["siso-rt", "spherical", "mimo-rt"] = "siso-rt"
    """How arrays are treated: plane waves, spherical waves, or every antenna pair traced."""
    samples: (
        Annotated[int, quantity("1", "rays launched per transmitter; absent: 100,000", ge=1, le=100_000_000)]
        | None
    ) = None
    ray_spacing_deg: (
        Annotated[float, quantity("°", "mean angle between rays, in place of samples", ge=0.03, le=90)] | None
    ) = None
    """N rays that share the sphere's 4π sr have a mean spacing Δ [rad] with N = 4π/Δ²."""
    los: bool = True
    reflection: bool = True
    refraction: bool = False
    diffraction: bool = False
    scattering: bool = False
    """Diffuse reflection; needs a scattering_coefficient above 0 in ``materials``."""
    launch_seed: Annotated[int | None, quantity("1", "of the ray launch; absent: from the run's seed")] = None
    max_paths: Annotated[
        int, quantity("1", "candidates per transmitter; more are lost and counted", ge=1)
    ] = 200_000
    receivers_at_once: Annotated[
        int | None, quantity("1", "receivers of one launch; absent: as the scenario has")
    ] = None
    memory_gib: Annotated[
        float, quantity("GiB", "of one launch of the rung mimo-rt at most", gt=0, le=1024)
    ] = 4.0
    bodies: Annotated[int, quantity("1", "moving objects of one mesh at most", ge=0, le=4096)] = 32
    pool: dict[str, int] = {}
    """Bodies of single meshes where ``bodies`` does not fit, by file name without ending: ``car = 64``;
    ``box`` for objects without a mesh."""
    without_body: tuple[str, ...] = ()
    """Classes of objects that the waves pass through."""
    body_material: str = "metal"
    """ITU-R P.2040 material of moving objects."""
    materials: dict[str, MaterialSettings] = {}
    """Changes to materials of the scenery, by name."""
    outside_itu_range: OutsideRange = "refuse"
    """What to do where a material is not defined at the carrier frequency."""


class SionnaChannel(PathModel[SionnaSettings]):
    """Ray-traced channel, on any number of carriers.

    Each transmitter is traced by itself, with receivers filled up to a fixed number by parked
    ones: so the kernels do not depend on who is in the scene. Several carriers share the paths; a path that
    one of them does not have is of amplitude 0 there.
    """

    Settings: ClassVar[type[msgspec.Struct]] = SionnaSettings
    rung = "siso-rt"
    uses_scenery: ClassVar[bool] = True

    def __init__(self, settings: SionnaSettings, run: RunInfo) -> None:
        super().__init__(settings, run)
        self.rung = settings.rung
        self._samples = _samples(settings, run.name)
        self._variant = ""
        self._scene: SionnaScene
        self._tracer: Tracer
        self._at_once = 1

    @property
    def options(self) -> ChannelOptions:
        s = self.settings
        return ChannelOptions(
            los=s.los,
            reflection=s.reflection,
            refraction=s.refraction,
            diffraction=s.diffraction,
            scattering=s.scattering,
            max_depth=s.max_depth,
            samples=self._samples,
        )

    def load(self, preparation: Preparation) -> tuple[str, ...]:
        s = self.settings
        self.run.progress("importing the ray tracer", _COMPILE_GRACE_S)
        notes = self._start()
        self.run.progress("loading the scene", _COMPILE_GRACE_S)
        frequencies = tuple(carrier.frequency_hz for carrier in self.run.carriers)
        self._scene = SionnaScene(
            preparation.assets,
            self._pool_sizes(preparation.assets),
            SceneSettings(
                frequencies_hz=frequencies,
                body_material=s.body_material,
                materials=s.materials,
                outside_itu_range=s.outside_itu_range,
                weld=s.diffraction,
            ),
        )
        seed = s.launch_seed
        if seed is None:
            seed = derive_seed(self.run.seed, 0, f"{self.run.name}/launch")
        launch = LaunchOptions(
            max_depth=s.max_depth,
            samples=self._samples,
            max_paths=s.max_paths,
            seed=seed,
            reflection=s.reflection,
            refraction=s.refraction,
            diffraction=s.diffraction,
            scattering=s.scattering,
        )
        wavelengths = [SPEED_OF_LIGHT / frequency for frequency in frequencies]
        self._tracer = Tracer(self._scene.mi_scene, wavelengths, self._scene.tune, launch)
        self._at_once = self._receivers_at_once()
        return (*notes, *self._warm_up())

    def release_memory(self) -> None:
        """Dr.Jit keeps freed buffers, some of each size that it has seen; sizes vary with the paths."""
        import drjit as dr

        dr.flush_malloc_cache()

    def paths(self, scene: Scene, transmitters: Sequence[Antenna], receivers: Sequence[Antenna]) -> Found:
        import mitsuba as mi

        if mi.variant() != self._variant:
            mi.set_variant(self._variant)
        _refuse_buried(scene, self.settings.without_body)
        names, velocity = self._scene.place(scene, frozenset(self.settings.without_body))
        parts = [
            self._launch(t, transmitter, begin, receivers)
            for t, transmitter in enumerate(transmitters)
            for begin in range(0, len(receivers), self._at_once)
        ]
        table = self._table(parts, names, velocity, transmitters, receivers)
        straight = (table.types == 0).all(1)
        los = np.zeros(len(transmitters) * len(receivers), bool)
        los[table.pair[straight]] = True
        traced = [part for _, part in parts]
        if not self.settings.los:
            table = table.take(~straight)
            traced = [part.take((part.types != 0).any(1)) for part in traced]
        return Found(
            table=table,
            los=los.reshape(len(transmitters), len(receivers)),
            counts={"path_limit_reached": sum(part.limit_reached for _, part in parts)},
            matrices=self._matrices(traced, table),
        )

    def _matrices(self, traced: Sequence[Traced], table: PathTable) -> Matrices | None:
        """How the rung makes H; `plane_waves` where it has no way of its own."""
        if self.rung == "spherical":
            surfaces = traced_surfaces(traced, table.types, table.points, self._scene)
            return SphericalWaves(surfaces, nearest_in(self._scene.mi_scene))
        if self.rung == "mimo-rt":
            return ElementTracer(self._tracer, self._scene, self._elements_at_once(), self.settings.los)
        return None

    def _table(
        self,
        parts: Sequence[tuple[Int64Array, Traced]],
        names: tuple[str, ...],
        velocity: Float64Array,
        transmitters: Sequence[Antenna],
        receivers: Sequence[Antenna],
    ) -> PathTable:
        """What all launches found, with names, and specular points in float64."""
        depth = self.settings.max_depth
        pair = _joined([pair for pair, _ in parts], (0,), np.int64)
        types = _joined([part.types for _, part in parts], (0, depth), np.uint8)
        shapes = _joined([part.shapes for _, part in parts], (0, depth), np.int64)
        primitives = _joined([part.primitives for _, part in parts], (0, depth), np.int64)
        tx, rx = np.divmod(pair, max(len(receivers), 1))
        points = refined_points(
            np.array([antenna.position for antenna in transmitters]).reshape(-1, 3)[tx],
            _joined([part.points for _, part in parts], (0, depth, 3), np.float64),
            np.array([antenna.position for antenna in receivers]).reshape(-1, 3)[rx],
            types,
            self._scene.planes(shapes, primitives),
        )
        return PathTable(
            pair=pair,
            transfer=np.concatenate(
                [np.zeros((len(self.run.carriers), 0, 3, 3), np.complex128), *(p.transfer for _, p in parts)],
                1,
            ),
            types=types,
            objects=self._scene.object_index(shapes, primitives),
            points=points,
            object_names=names,
            object_velocity=velocity,
        )

    def _launch(
        self, t: int, transmitter: Antenna, begin: int, receivers: Sequence[Antenna]
    ) -> tuple[Int64Array, Traced]:
        """Paths of one transmitter to some receivers, with the pair that each belongs to."""
        chosen = receivers[begin : begin + self._at_once]
        targets = np.tile(self._scene.parking, (self._at_once, 1))
        targets[: len(chosen)] = [receiver.position for receiver in chosen]
        traced = self._tracer.trace(transmitter.position, targets)
        itself = [receiver.name == transmitter.name for receiver in chosen]
        real = np.zeros(self._at_once, bool)
        real[: len(chosen)] = np.logical_not(itself)
        traced = traced.take(real[traced.receiver])
        return t * len(receivers) + begin + traced.receiver, traced

    def _start(self) -> tuple[str, ...]:
        """Import the ray tracer with its library and variant; notes that say which."""
        self._variant = choose_variant()
        notes: tuple[str, ...] = (f"Mitsuba variant {self._variant}",)
        if self._variant.startswith("llvm"):
            notes = (activate_llvm(), *notes)
        try:
            import mitsuba as mi

            mi.set_variant(self._variant)
            import sionna.rt
        except ImportError as error:
            raise SetupError(
                f"sionna-rt cannot be imported ({error}); install it: pip install 'caviar-sim[channel]'"
            ) from error
        return (*notes, f"sionna-rt {sionna.rt.__version__}")

    def _pool_sizes(self, assets: Mapping[str, Path]) -> dict[str, int]:
        """Bodies of each mesh: those among the assets, and the box."""
        by_stem = {PurePosixPath(name).stem: name for name in assets if name.startswith("objects/")}
        by_stem["box"] = ""
        unknown = sorted(self.settings.pool.keys() - by_stem.keys())
        if unknown:
            raise ScenarioError(
                f"there is no object mesh {unknown[0]!r}; the run has: {', '.join(sorted(by_stem))}",
                key=f"services.{self.run.name}.settings.pool",
            )
        return {name: self.settings.pool.get(stem, self.settings.bodies) for stem, name in by_stem.items()}

    def _elements_at_once(self) -> int:
        s = self.settings
        sizes = [d.count * d.array.size for d in self.run.devices if d.array and d.role in ("rx", "both")]
        announced = sum(sizes)
        return targets_at_once(s.memory_gib, self._samples, s.max_depth, max(announced, self._at_once))

    def _receivers_at_once(self) -> int:
        s = self.settings
        if s.receivers_at_once is not None:
            return s.receivers_at_once
        announced = sum(d.count for d in self.run.devices if d.kind == "antenna" and d.role in ("rx", "both"))
        return max(1, min(announced, _LANES // (self._samples * max(s.max_depth, 1))))

    def _warm_up(self) -> tuple[str, ...]:
        """Compile every kernel that frames need: move the bodies, and trace what finds paths."""
        self.run.progress("compiling kernels", _COMPILE_GRACE_S)
        begin = time.monotonic()
        middle = (self._scene.low + self._scene.high) / 2
        above = np.array([middle[0], middle[1], self._scene.high[2] + 10.0])
        receivers = above + np.arange(1, self._at_once + 1)[:, None] * np.array([1.3, 0.7, -0.1])
        self._tracer.trace(above, receivers)
        self._tracer.trace(above + 0.5, receivers + 0.25)
        if self.rung == "spherical":
            nearest_in(self._scene.mi_scene)(receivers, np.tile([0.0, 0.0, -1.0], (len(receivers), 1)))
        if self.rung == "mimo-rt":
            targets = above + np.arange(1, self._elements_at_once() + 1)[:, None] * np.array([0.3, 0.7, -0.1])
            self._tracer.trace(above, targets)
        self.run.progress("kernels compiled", 0.0)
        return (f"kernels compiled in {time.monotonic() - begin:.1f} s",)


def _samples(settings: SionnaSettings, service: str) -> int:
    """Rays of a launch, however they were given."""
    if settings.ray_spacing_deg is None:
        return _SAMPLES if settings.samples is None else settings.samples
    if settings.samples is not None:
        raise ScenarioError(
            f"samples = {settings.samples} and ray_spacing_deg = {settings.ray_spacing_deg} both say "
            "how many rays are launched; leave one out",
            key=f"services.{service}.settings.ray_spacing_deg",
        )
    return round(4 * math.pi / math.radians(settings.ray_spacing_deg) ** 2)


def _joined(arrays: Sequence[Array], empty: tuple[int, ...], dtype: type[np.generic]) -> Array:
    return np.concatenate([np.zeros(empty, dtype), *arrays])


def _refuse_buried(scene: Scene, without_body: Sequence[str]) -> None:
    """Raise `PayloadError` for an antenna in the very middle of a body, which no wave can reach."""
    for device in scene.devices:
        if isinstance(device, AntennaDevice) and device.parent and device.position == (0.0, 0.0, 0.0):
            cls = scene.classes[scene.names.index(device.parent)]
            if cls not in without_body:
                raise PayloadError(
                    f"antenna {device.name!r} stands in the middle of the body of {device.parent!r}, where "
                    f"no wave reaches it; mount it on the roof or floor, or list {cls!r} in without_body"
                )
