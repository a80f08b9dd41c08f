"""Rung ``siso-rt``: Sionna RT traces between reference points, arrays are applied as plane waves."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from caviar_protocol.arrays import Float64Array, Int64Array, quantity
from caviar_protocol.coordinates import SPEED_OF_LIGHT
from caviar_protocol.errors import PayloadError, ScenarioError, SetupError
from caviar_protocol.seeding import derive_seed
from caviar_protocol.topics import AntennaDevice, ChannelOptions, Scene
from caviar_services.channel.assemble import Antenna, PathTable
from caviar_services.channel.base import ChannelSettings, Found, PathModel
from caviar_services.channel.contributing import contributing
from caviar_services.channel.mesh_detail import DetailSettings
from caviar_services.channel.sionna_launch import LaunchOptions
from caviar_services.channel.sionna_materials import (
    MaterialPolicy,
    MaterialSettings,
    OutsideRange,
    OutsideUse,
)
from caviar_services.channel.sionna_scene import SceneSettings, SionnaScene
from caviar_services.channel.sionna_tracer import Traced, Tracer
from caviar_services.channel.specular import refined_points
from caviar_services.llvm import activate_llvm, choose_variant
from caviar_services.service import Preparation, RunInfo

Array = NDArray[Any]

_COMPILE_GRACE_S = 120.0


class SionnaSettings(ChannelSettings, frozen=True, kw_only=True):
    """What is modelled, and how finely."""

    max_depth: Annotated[int, quantity("1", "interactions of a path at most", ge=0, le=16)] = 3
    samples: Annotated[int, quantity("1", "rays launched per transmitter", ge=1, le=100_000_000)] = 100_000
    los: bool = True
    reflection: bool = True
    refraction: bool = False
    diffraction: bool = False
    scattering: bool = False
    """Diffuse reflection; needs a scattering_coefficient above 0 in ``materials``."""
    launch_seed: Annotated[int | None, quantity("1", "of the ray launch; absent: from the run's seed")] = None
    max_paths: Annotated[
        int, quantity("1", "candidates of a TX/RX pair; more are lost and counted", ge=1)
    ] = 200_000
    receivers_at_once: Annotated[
        int | None, quantity("1", "receivers looked at together; absent: as many as fit")
    ] = None
    bodies: Annotated[int, quantity("1", "moving objects of one mesh at most", ge=0, le=4096)] = 32
    pool: dict[str, int] = msgspec.field(default_factory=dict)
    """Bodies of single meshes where ``bodies`` does not fit, by file name without ending: ``car = 64``;
    ``box`` for objects without a mesh."""
    without_body: tuple[str, ...] = ()
    """Classes of objects that the waves pass through."""
    body_material: str = "metal"
    """ITU-R P.2040 material of moving objects."""
    materials: dict[str, MaterialSettings] = msgspec.field(default_factory=dict)
    """Changes to materials of the scenery, by name."""
    detail: DetailSettings = msgspec.field(default_factory=DetailSettings)
    """What of the scenery is left out; absent, nothing is."""
    outside_itu_range: OutsideRange = "error"
    """Where ITU-R P.2040 does not define a material at a carrier: ``error``; ``nearest``, the constants of
    the nearest end of a range; ``extrapolate``, the power law of that range."""


class SionnaChannel(PathModel[SionnaSettings]):
    """Ray-traced channel, on any number of carriers.

    Each transmitter launches its rays once a frame, whoever receives, and every receiver is offered all
    that they met: its paths do not depend on which others there are. Several carriers share the paths;
    a path that one of them does not have is of amplitude 0 there.
    """

    Settings: ClassVar[type[msgspec.Struct]] = SionnaSettings
    rung: ClassVar[str] = "siso-rt"
    uses_scenery: ClassVar[bool] = True

    def __init__(self, settings: SionnaSettings, run: RunInfo) -> None:
        super().__init__(settings, run)
        self._variant = ""
        self._scene: SionnaScene
        self._tracer: Tracer
        self._outside: tuple[OutsideUse, ...] = ()
        seed = settings.launch_seed
        self._asked = LaunchOptions(
            max_depth=settings.max_depth,
            samples=settings.samples,
            max_paths=settings.max_paths,
            seed=derive_seed(run.seed, 0, f"{run.name}/launch") if seed is None else seed,
            reflection=settings.reflection,
            refraction=settings.refraction,
            diffraction=settings.diffraction,
            scattering=settings.scattering,
        )
        self._launched = self._asked

    @property
    def options(self) -> ChannelOptions:
        launched = self._launched
        return ChannelOptions(
            los=self.settings.los,
            reflection=launched.reflection,
            refraction=launched.refraction,
            diffraction=launched.diffraction,
            scattering=launched.scattering,
            max_depth=launched.max_depth,
            samples=launched.samples,
            materials_outside=tuple(use.brief(self.run.carriers[use.carrier].name) for use in self._outside),
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
                materials=MaterialPolicy(
                    changes=s.materials,
                    outside=s.outside_itu_range,
                    key=f"services.{self.run.name}.settings",
                ),
                weld=s.diffraction,
                detail=s.detail,
            ),
        )
        self._outside = self._scene.outside
        notes += tuple(use.note(self.run.carriers[use.carrier].name) for use in self._outside)
        if self._scene.detail_effect is not None:
            notes += (self._scene.detail_effect.note,)
        self._launched, switched = contributing(self._asked, self._scene.surfaces(), frequencies)
        wavelengths = [SPEED_OF_LIGHT / frequency for frequency in frequencies]
        self._tracer = Tracer(self._scene, wavelengths, self._launched)
        return (*notes, *switched, *self._warm_up())

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
        parts = [self._launch(t, transmitter, receivers) for t, transmitter in enumerate(transmitters)]
        table = self._table(parts, names, velocity, transmitters, receivers)
        straight = (table.types == 0).all(1)
        los = np.zeros(len(transmitters) * len(receivers), bool)
        los[table.pair[straight]] = True
        if not self.settings.los:
            table = table.take(~straight)
        return Found(
            table=table,
            los=los.reshape(len(transmitters), len(receivers)),
            counts={"path_limit_reached": sum(part.lost for _, part in parts)},
        )

    def _table(
        self,
        parts: Sequence[tuple[Int64Array, Traced]],
        names: tuple[str, ...],
        velocity: Float64Array,
        transmitters: Sequence[Antenna],
        receivers: Sequence[Antenna],
    ) -> PathTable:
        """What all launches found, with names, and specular points in float64."""
        depth = self._launched.max_depth
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
            faces=self._scene.face_number(shapes, primitives),
        )

    def _launch(
        self, t: int, transmitter: Antenna, receivers: Sequence[Antenna]
    ) -> tuple[Int64Array, Traced]:
        """Paths of one transmitter to the receivers, with the pair that each belongs to."""
        others = [r for r, receiver in enumerate(receivers) if receiver.name != transmitter.name]
        targets = np.array([receivers[r].position for r in others]).reshape(-1, 3)
        traced = self._tracer.trace(transmitter.position, targets, self.settings.receivers_at_once)
        return t * len(receivers) + np.array(others, np.int64)[traced.receiver], traced

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

    def _warm_up(self) -> tuple[str, ...]:
        """Compile every kernel that frames need: move the bodies, and trace what finds paths."""
        self.run.progress("compiling kernels", _COMPILE_GRACE_S)
        begin = time.monotonic()
        middle = (self._scene.low + self._scene.high) / 2
        above = np.array([middle[0], middle[1], self._scene.high[2] + 10.0])
        receivers = above + np.arange(1, 9)[:, None] * np.array([1.3, 0.7, -0.1])
        self._tracer.trace(above, receivers)
        self._tracer.trace(above + 0.5, receivers + 0.25)
        self.run.progress("kernels compiled", 0.0)
        return (f"kernels compiled in {time.monotonic() - begin:.1f} s",)


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
