"""Rung ``siso-rt``: Sionna RT traces between reference points, arrays are applied as plane waves."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from caviar_protocol.arrays import Float64Array, Int64Array, quantity
from caviar_protocol.coordinates import SPEED_OF_LIGHT
from caviar_protocol.errors import PayloadError, ScenarioError, SetupError
from caviar_protocol.seeding import derive_seed
from caviar_protocol.topics import AntennaDevice, ChannelOptions, Interaction, Scene
from caviar_services.channel.assemble import Antenna, PathTable
from caviar_services.channel.base import ChannelSettings, Found, PathModel
from caviar_services.channel.clearance import spread_anew, with_near_pairs
from caviar_services.channel.sionna_follow import Followed
from caviar_services.channel.sionna_launch import LaunchOptions
from caviar_services.channel.sionna_materials import (
    MaterialPolicy,
    MaterialSettings,
    OutsideRange,
    OutsideUse,
)
from caviar_services.channel.sionna_scene import SceneSettings, SionnaScene
from caviar_services.channel.sionna_sharing import scene_of
from caviar_services.channel.sionna_tracer import Traced, Tracer
from caviar_services.channel.specular import distinct, path_lengths, refined_points
from caviar_services.llvm import activate_llvm, choose_variant
from caviar_services.service import Frame, Preparation, RunInfo, StepResult

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
    follow: (
        Annotated[int, quantity("1", "frames in which all rays are launched, a part in each", ge=2, le=1000)]
        | None
    ) = None
    """Reflections and transmissions are followed from frame to frame, not looked for with all rays in each:
    new ones are found within this many frames, and a channel that is started again in the middle of an
    episode cannot go on. Absent: each frame stands on its own."""
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
    outside_itu_range: OutsideRange = "error"
    """Where ITU-R P.2040 does not define a material at a carrier: ``error``; ``nearest``, the constants of
    the nearest end of a range; ``extrapolate``, the power law of that range."""

    def __post_init__(self) -> None:
        if self.follow is not None and (self.diffraction or self.scattering):
            raise ValueError(
                "follow knows reflections and transmissions only; leave it out, or set diffraction and "
                "scattering to false"
            )


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
        self._followed: dict[str, Followed] = {}
        self._outside: tuple[OutsideUse, ...] = ()

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
            samples=s.samples,
            materials_outside=tuple(use.brief(self.run.carriers[use.carrier].name) for use in self._outside),
        )

    def load(self, preparation: Preparation) -> tuple[str, ...]:
        s = self.settings
        self.run.progress("importing the ray tracer", _COMPILE_GRACE_S)
        notes = self._start()
        self.run.progress("loading the scene", _COMPILE_GRACE_S)
        frequencies = tuple(carrier.frequency_hz for carrier in self.run.carriers)
        self._scene = scene_of(
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
            ),
        )
        self._outside = self._scene.outside
        notes += tuple(use.note(self.run.carriers[use.carrier].name) for use in self._outside)
        seed = s.launch_seed
        if seed is None:
            seed = derive_seed(self.run.seed, 0, f"{self.run.name}/launch")
        launch = LaunchOptions(
            max_depth=s.max_depth,
            samples=s.samples,
            max_paths=s.max_paths,
            seed=seed,
            reflection=s.reflection,
            refraction=s.refraction,
            diffraction=s.diffraction,
            scattering=s.scattering,
        )
        self._wavelengths = SPEED_OF_LIGHT / np.array(frequencies)
        self._no_transfer = np.zeros((len(frequencies), 0, 3, 3), np.complex128)
        self._tracer = Tracer(self._scene, self._wavelengths.tolist(), launch)
        return (*notes, *self._warm_up())

    def reset(self, episode: int, seed: int, t0_ns: int) -> None:
        """Forget the paths of the episode before."""
        self._followed.clear()

    def step(self, frame: Frame) -> StepResult:
        """Raises `PayloadError` where paths that shall be followed are not known."""
        if self.settings.follow is not None and frame.previous < 0 < frame.number:
            raise PayloadError(
                f"{self.run.name} follows paths from the beginning of an episode and was started again in "
                f"frame {frame.number}, where it knows none; without its setting `follow` the run goes on"
            )
        return super().step(frame)

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
        clear = [self._cleared(antenna) for antenna in (*transmitters, *receivers)]
        sources, targets = clear[: len(transmitters)], clear[len(transmitters) :]
        parts = [self._launch(t, source, targets, names) for t, source in enumerate(sources)]
        table = self._table(parts, names, velocity, (transmitters, receivers), (sources, targets))
        los = np.zeros(len(transmitters) * len(receivers), bool)
        los[table.pair[(table.types == 0).all(1)]] = True
        table, too_close = with_near_pairs(
            table, los, transmitters, receivers, self._wavelengths, self._scene.surfaces
        )
        if not self.settings.los:
            table = table.take((table.types != 0).any(1))
        return Found(
            table=table,
            los=los.reshape(len(transmitters), len(receivers)),
            counts={
                "path_limit_reached": sum(part.lost for _, part in parts),
                "too_close": too_close,
            },
        )

    def _table(
        self,
        parts: Sequence[tuple[Int64Array, Traced]],
        names: tuple[str, ...],
        velocity: Float64Array,
        antennas: tuple[Sequence[Antenna], Sequence[Antenna]],
        traced_from: tuple[Sequence[Antenna], Sequence[Antenna]],
    ) -> PathTable:
        """What all launches found, with names, points in float64 and each path once.

        Antennas are TX and RX where they are, and where they were traced from.
        """
        depth = self.settings.max_depth
        pair = _joined([pair for pair, _ in parts], (0,), np.int64)
        types = _joined([part.types for _, part in parts], (0, depth), np.uint8)
        shapes = _joined([part.shapes for _, part in parts], (0, depth), np.int64)
        primitives = _joined([part.primitives for _, part in parts], (0, depth), np.int64)
        (start, end), ends = _ends(pair, *antennas), _ends(pair, *traced_from)
        traced = _joined([part.points for _, part in parts], (0, depth, 3), np.float64)
        triangles = self._scene.triangles(shapes, primitives)
        points = refined_points(start, traced, end, types, triangles, ends)
        specular = ((types != Interaction.DIFFRACTION) & (types != Interaction.SCATTERING)).all(1)
        objects = self._scene.object_index(shapes, primitives)
        table = PathTable(
            pair=pair,
            transfer=spread_anew(
                np.concatenate([self._no_transfer, *(part.transfer for _, part in parts)], axis=1),
                specular,
                path_lengths(ends[0], traced, ends[1], types),
                path_lengths(start, points, end, types),
            ),
            types=types,
            objects=objects,
            points=points,
            object_names=names,
            object_velocity=velocity,
            faces=self._scene.face_number(shapes, primitives),
        )
        there = ~(self._scene.is_parking(names, objects) & (types != 0)).any(1)
        return table.take(there & distinct(pair, types, points))

    def _cleared(self, antenna: Antenna) -> Antenna:
        """An antenna where it is traced from."""
        return replace(antenna, position=self._scene.surfaces.cleared(antenna.position))

    def _launch(
        self, t: int, transmitter: Antenna, receivers: Sequence[Antenna], names: tuple[str, ...]
    ) -> tuple[Int64Array, Traced]:
        """Paths of one transmitter to the receivers, with the pair that each belongs to."""
        others = [r for r, receiver in enumerate(receivers) if receiver.name != transmitter.name]
        targets = np.array([receivers[r].position for r in others]).reshape(-1, 3)
        s, followed = self.settings, None
        if s.follow is not None:
            followed = self._followed.setdefault(transmitter.name, Followed(s.follow))
        traced = self._tracer.trace(transmitter.position, targets, s.receivers_at_once, followed, names)
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
        followed = None if self.settings.follow is None else Followed(self.settings.follow)
        for shift in (0.0, 0.5, 1.0):
            self._tracer.trace(
                above + shift, receivers + shift / 2, followed=followed, names=self._scene.names
            )
        self.run.progress("kernels compiled", 0.0)
        return (f"kernels compiled in {time.monotonic() - begin:.1f} s",)


def _joined(arrays: Sequence[Array], empty: tuple[int, ...], dtype: type[np.generic]) -> Array:
    return np.concatenate([np.zeros(empty, dtype), *arrays])


def _ends(
    pair: Int64Array, transmitters: Sequence[Antenna], receivers: Sequence[Antenna]
) -> tuple[Float64Array, Float64Array]:
    """Positions [m] of TX and RX of paths, each of Shape ``[P, 3]``."""
    tx, rx = np.divmod(pair, max(len(receivers), 1))
    start = np.array([antenna.position for antenna in transmitters]).reshape(-1, 3)
    end = np.array([antenna.position for antenna in receivers]).reshape(-1, 3)
    return start[tx], end[rx]


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
