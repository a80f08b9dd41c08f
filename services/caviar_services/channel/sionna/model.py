"""The ray-traced rungs: Sionna RT finds the paths; ``rung`` says what becomes of the arrays.

``siso-rt`` traces between the arrays' centres and applies the arrays as plane waves, ``spherical`` gives
each antenna pair its own length of the same paths (`spherical`), ``mimo-rt`` traces every pair (`mimo_rt`).
They are one implementation with one scene and one set of options, so a rung is a setting like any other.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array, Int64Array
from caviar_protocol.errors import PayloadError, ScenarioError, SetupError
from caviar_protocol.host import install_command
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.seeding import derive_seed
from caviar_protocol.topics import AntennaDevice, ChannelOptions, Scene
from caviar_protocol.topics.channel import UNMATCHED_PREFIX
from caviar_services.channel.arrays.channel_matrices import Matrices
from caviar_services.channel.arrays.mimo_rt import ElementTracer
from caviar_services.channel.arrays.spherical import SphericalWaves
from caviar_services.channel.base import Found, PathModel
from caviar_services.channel.paths import Antenna, PathTable, path_ends, with_near_pairs
from caviar_services.channel.propagation.attenuation import Attenuation, Foliage, HumanBlockage
from caviar_services.channel.sionna import dr, mi
from caviar_services.channel.sionna.path_finder import COMPILE_GRACE_S, Launched, PathFinder
from caviar_services.channel.sionna.path_solver import LANE_BYTES
from caviar_services.channel.sionna.path_table import Ends, Traced, path_table, traced_surfaces
from caviar_services.channel.sionna.scene import SceneSettings, SionnaScene, scene_of
from caviar_services.channel.sionna.settings import SionnaSettings, contributing, transmits
from caviar_services.channel.sionna.tracking import FollowingState
from caviar_services.checkpoint import restored, saved
from caviar_services.drjit_setup import activate_llvm, choose_variant, limit_threads
from caviar_services.service import Frame, Preparation, RunInfo, StepResult
from caviar_space.materials import MaterialPolicy, ObjectMaterials, OutsideUse
from caviar_space.meshes import is_object_mesh


class SionnaChannel(PathModel[SionnaSettings]):
    """Ray-traced channel, on any number of carriers.

    Each transmitter launches its rays once a frame, and every receiver is offered all that they met: the
    paths of a receiver do not depend on which others there are. Several carriers share the paths; a path
    that one of them does not have is of amplitude 0 there.

    Args:
        settings: What is modelled, and how finely.
        run: Carriers and devices of the run.

    Raises:
        ScenarioError: What `ChannelModel` refuses, or foliage that is not defined at a carrier.

    Example:
        >>> from caviar_protocol.topics import Carrier
        >>> run = RunInfo(name="channel", carriers=(Carrier(name="c", frequency_hz=28e9),))
        >>> SionnaChannel(SionnaSettings(max_depth=2, diffraction=True), run).options.max_depth
        2
    """

    Settings: ClassVar[type[msgspec.Struct]] = SionnaSettings
    rung = "siso-rt"
    extra: ClassVar[str] = "channel"
    packages: ClassVar[tuple[str, ...]] = ("sionna-rt", "mitsuba", "drjit", "scipy")
    uses_scenery: ClassVar[bool] = True
    checkpoints: ClassVar[bool] = True
    changes_geometry: ClassVar[bool] = True

    @classmethod
    def check_settings(cls, settings: SionnaSettings, place: Place) -> None:
        """See `SionnaSettings.check`.

        Args:
            settings, place: What stands where in the scenario.
        """
        settings.check(place)

    def __init__(self, settings: SionnaSettings, run: RunInfo) -> None:
        super().__init__(settings, run)
        self.rung = settings.rung
        self.rounds_h = settings.h_precision == "single"
        self._variant = ""
        self._scene: SionnaScene
        self._finder: PathFinder
        self._outside: tuple[OutsideUse, ...] = ()
        self._enumerates = False
        self._bodies_version = 0
        self._detail = ""
        self._room: dict[str, int] = {}
        self._names: tuple[str, ...] = ()  # of the pieces of the scene in the last frame
        objects = ObjectMaterials(settings.object_materials)
        # Settings of which each key names objects or pieces of scenery.
        self._keys: dict[str, ObjectMaterials] = {"object_materials": objects}
        self.foliage: Foliage | None = None
        """What paths lose in; None: no foliage in the scenario."""
        if settings.foliage:
            others = {"without_body": settings.without_body, "object_materials": settings.object_materials}
            self.foliage = Foliage(settings.foliage, run.carriers, run.settings_place, others)
            self._keys["foliage"] = self.foliage.keys
        self.blockage: HumanBlockage | None = None
        """People as screens; None: they are bodies."""
        if settings.human_blockage is not None:
            self.blockage = HumanBlockage(settings.human_blockage, run.carriers)
        self._losses: tuple[Attenuation, ...] = tuple(filter(None, (self.foliage, self.blockage)))
        # Names and classes of the last frame's objects, and which keys match none: both seldom change.
        self._known_unmatched: tuple[object, dict[str, int]] = (None, {})
        self._samples = settings.launched_samples()
        # What the user asked for, and what of it can contribute, which is known once the scene is.
        self._asked = settings.launch_options(derive_seed(run.seed, 0, f"{run.name}/launch"))
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
            samples=self._samples,
            materials_outside=tuple(use.brief(self.run.carriers[use.carrier].name) for use in self._outside),
            detail=self._detail,
            foliage=() if self.foliage is None else self.foliage.briefs,
            blockage=() if self.blockage is None else self.blockage.briefs,
        )

    @property
    def extent(self) -> tuple[Float64Array, Float64Array] | None:
        return (self._scene.low, self._scene.high) if self._scene.has_scenery else None

    @property
    def room(self) -> Mapping[str, int]:
        return self._room

    def enclosing(self, position: Float64Array) -> str:
        """See `ChannelModel.enclosing`; an antenna at a surface is on the side that it is traced from.

        Args:
            position: [m], Shape ``[3]``.
        """
        piece = self._scene.enclosing(self._scene.surfaces.cleared(position))
        return self._names[piece] if piece >= 0 else ""

    @property
    def scene(self) -> SionnaScene:
        """Scene that waves meet; after `load_scene`."""
        return self._scene

    @property
    def launch_seed(self) -> int:
        """Seed of all rays."""
        return self._asked.seed

    # --- before the first frame ----------------------------------------------------------------------

    def load_scene(self, preparation: Preparation) -> tuple[str, ...]:
        """Start the ray tracer and load scenery and bodies; notes for the user.

        `load` begins with it; a radio map needs the scene without the paths.

        Args:
            preparation: With the files of the run.

        Raises:
            SetupError: The ray tracer cannot be started on this machine.
            AssetError, ScenarioError: See `SionnaScene`.
        """
        s, place = self.settings, self.run.settings_place
        self.run.progress("importing the ray tracer", COMPILE_GRACE_S)
        notes = self._start()
        self.run.progress("loading the scene", COMPILE_GRACE_S)
        self._room = s.pool_sizes(preparation.assets, place)
        foliage = ObjectMaterials() if self.foliage is None else self.foliage.keys
        self._scene = scene_of(
            preparation.assets,
            self._room,
            SceneSettings(
                frequencies_hz=tuple(carrier.frequency_hz for carrier in self.run.carriers),
                body_material=s.body_material,
                materials=MaterialPolicy(changes=s.materials, outside=s.outside_itu_range, key=place.key),
                edges=s.diffraction,
                free_edges=s.free_edges,
                solid_walls_m=s.solid_walls_m,
                detail=s.detail,
                object_faces=s.object_faces,
                objects=self._keys["object_materials"],
                foliage=foliage,
                pool_keys={asset: s.pool_key(asset, place) for asset in self._room},
            ),
        )
        scene = self._scene
        self._bodies_version = scene.bodies_version
        if self.foliage is not None:
            self.foliage.stand(scene.foliage_meshes)
            notes += tuple(f"foliage {brief}" for brief in self.foliage.briefs)
        self._names, self._outside = scene.names, scene.outside
        notes += tuple(use.note(self.run.carriers[use.carrier].name) for use in self._outside)
        notes += scene.notes
        if scene.detail_effect is not None:
            notes += (scene.detail_effect.note,)
            self._detail = scene.detail_effect.brief
        return notes

    def load(self, preparation: Preparation) -> tuple[str, ...]:
        """Load the scene, launch what is launched once, and compile; notes for the user.

        Args:
            preparation: With the files of the run.

        Raises:
            SetupError, AssetError, ScenarioError: See `load_scene`.
        """
        s = self.settings
        notes = self.load_scene(preparation)
        # Objects move in the run where a world has meshes of them, or devices are mounted on them.
        meshes = any(map(is_object_mesh, preparation.assets))
        moving = meshes or any(device.on for device in self.run.devices)
        self._enumerates = s.enumerates(moving)
        switched = self._make_finder()
        if self._launched.refraction:
            frequencies = tuple(carrier.frequency_hz for carrier in self.run.carriers)
            surfaces = self._scene.used_surfaces().materials
            through = {
                surface.name for surface in surfaces if transmits(surface, self._launched, frequencies)
            }
            notes += self._scene.closed_walls(through)
        self.run.progress("compiling kernels", COMPILE_GRACE_S)
        begin = time.monotonic()
        self._finder.compile_kernels()
        self.run.progress("kernels compiled", 0.0)
        compiled = f"kernels compiled in {time.monotonic() - begin:.1f} s"
        return (*notes, *self._finder.notes, *switched, compiled)

    def _make_finder(self, before: PathFinder | None = None) -> tuple[str, ...]:
        """Make what finds paths in the scene as it is; notes on what is switched off.

        Args:
            before: Of the scene with other bodies; None: none was made.
        """
        frequencies = tuple(carrier.frequency_hz for carrier in self.run.carriers)
        launched, switched = contributing(self._asked, self._scene.used_surfaces(), frequencies)
        enumerated = self._enumerates and launched.reflection
        self._finder = PathFinder(self._scene, self.settings, launched, self.run, enumerated, before)
        self._launched, self._samples = self._finder.options, self._finder.samples
        return switched

    def use_meshes(self, meshes: Mapping[str, Path]) -> None:
        """Take the meshes that objects may have from the next frame on, beside those of `prepare`.

        Args:
            meshes: Files by asset name.

        Raises:
            AssetError: A file is no mesh.
            ScenarioError: Paths are followed: what is known of them is known by the bodies of before.
        """
        if meshes and self.settings.follow is not None:
            raise ScenarioError(
                "a world brings meshes while the run goes on, among which paths cannot be followed; leave it "
                "out, or have the world bring its meshes at the beginning",
                key=self.run.settings_place.at("follow").key,
            )
        self._activate()
        self.run.progress("loading meshes", COMPILE_GRACE_S)
        self._scene.use_meshes(meshes)
        self.run.progress("meshes loaded", 0.0)

    def _make_room(self, scene: Scene) -> None:
        """Make bodies where there are too few for the objects of a scene."""
        if self.settings.follow is None:  # what is followed is known by the bodies that there are
            self._scene.make_room(scene, frozenset(self.settings.without_body))
        # Also where another model that shares the scene has made them.
        if self._scene.bodies_version != self._bodies_version:
            # Kernels may have to be compiled for them, which the first trace does.
            self.run.progress("making more bodies", COMPILE_GRACE_S)
            self._bodies_version = self._scene.bodies_version
            self._make_finder(self._finder)
            self._names, self._outside = self._scene.names, self._scene.outside

    def _start(self) -> tuple[str, ...]:
        """Import the ray tracer with its library and variant; notes that say which."""
        self._variant = choose_variant()
        notes: tuple[str, ...] = (f"Mitsuba variant {self._variant}",)
        if self._variant.startswith("llvm"):
            notes = (activate_llvm(), *notes)
        try:
            self._activate()
            limit_threads()
            import sionna.rt
        except ImportError as error:
            raise SetupError(
                f"sionna-rt cannot be imported ({error}); run: {install_command('channel')}"
            ) from error
        return (*notes, f"sionna-rt {sionna.rt.__version__}")

    def _activate(self) -> None:
        """The variant of Mitsuba is the process's, and others may have set theirs."""
        if mi.variant() != self._variant:
            mi.set_variant(self._variant)

    # --- frames --------------------------------------------------------------------------------------

    def reset(self, episode: int, seed: int, t0_ns: int) -> None:
        """Forget the paths of the episode before: what is followed must not begin with them.

        Args:
            episode, seed, t0_ns: See `Service.reset`.
        """
        self._finder.forget()

    def checkpoint(self) -> bytes:
        """The chains that are followed."""
        return saved(self, 1, self._finder.state)

    def restore(self, state: bytes) -> None:
        """Follow the chains of a saved state.

        Args:
            state: Of `checkpoint`.
        """
        was = restored(self, 1, FollowingState, state)
        self._activate()
        self._finder.resume(was)

    def step(self, frame: Frame) -> StepResult:
        """See `ChannelModel.step`.

        Args:
            frame: The frame.

        Raises:
            PayloadError: What `ChannelModel.step` refuses; paths are to be followed and are not known, or an
                antenna is in the middle of a body.
        """
        if self.settings.follow is not None and frame.previous < 0 < frame.number:
            raise PayloadError(
                f"{self.run.name} follows paths from the beginning of an episode and was started again in "
                f"frame {frame.number}, where it knows none; without its setting `follow`, or with states "
                "saved (run.checkpoint_frames above 0), the run goes on"
            )
        return super().step(frame)

    def release_memory(self) -> None:
        """Dr.Jit keeps freed buffers, some of each size that it has seen; sizes vary with the paths."""
        dr.flush_malloc_cache()

    def paths(self, scene: Scene, transmitters: Sequence[Antenna], receivers: Sequence[Antenna]) -> Found:
        """Find the paths of all pairs: traced, near ones by formula, with what foliage leaves of them.

        Args:
            scene, transmitters, receivers: See `PathModel.paths`.
        """
        # Another service of an embedded run may have set another variant.
        self._activate()
        _refuse_buried(scene, self.settings.without_body, self.foliage)
        for loss in self._losses:
            loss.move(scene)
        self._make_room(scene)
        finder, antennas = self._finder, (transmitters, receivers)
        names, velocity = finder.place(scene)
        self._names = names
        traced_from = self._cleared(transmitters), self._cleared(receivers)
        elements = self.rung == "spherical" and (self.with_h or bool(self.wideband))
        with_missed = self.with_split and finder.launches
        parts = finder.trace(*traced_from, names, elements=elements, with_missed=with_missed)
        table = path_table(self._scene, parts, names, velocity, antennas, traced_from)
        table = finder.in_edge_range(table, antennas)
        los = np.zeros(len(transmitters) * len(receivers), bool)
        # Hidden paths are of other elements than the centres. Foliage dims a line of sight and does not
        # block it.
        straight = (table.types == 0).all(1)
        los[table.pair[straight if table.hidden is None else straight & ~table.hidden]] = True
        table, too_close = with_near_pairs(table, los, *antennas, finder.wavelengths, self._scene.surfaces)
        # After the near pairs, whose lines of sight foliage and people dim, too.
        for loss in self._losses:
            table = loss.attenuated(table, *path_ends(table.pair, *antennas))
        if not self.settings.los:
            table = table.take((table.types != 0).any(1))
        return Found(
            table=table,
            los=los.reshape(len(transmitters), len(receivers)),
            counts={
                "path_limit_reached": sum(part.lost for _, part in parts),
                "too_close": too_close,
                **self._unmatched(scene),
                **finder.counts,
            },
            matrices=self._matrices([part for _, part in parts], table, traced_from),
            split_nmse=self._split_nmse(parts, antennas) if with_missed else None,
        )

    def _cleared(self, antennas: Sequence[Antenna]) -> list[Antenna]:
        """Antennas where they are traced from."""
        cleared = self._scene.surfaces.cleared
        return [replace(antenna, position=cleared(antenna.position)) for antenna in antennas]

    def _split_nmse(self, parts: Launched, antennas: Ends) -> Float64Array:
        """See `Found.split_nmse`; antennas count as isotropic."""
        shape = len(antennas[0]), len(antennas[1])
        power, missed = np.zeros((2, shape[0] * shape[1]))
        for pair, traced in parts:
            power += self._power(pair, traced, antennas, len(power))
        for pair, traced, probability in self._finder.missed:
            missed += self._power(pair, traced, antennas, len(power), probability)
        split: Float64Array = (missed / np.maximum(power, np.finfo(np.float64).tiny)).reshape(shape)
        return split

    def _power(
        self, pair: Int64Array, traced: Traced, antennas: Ends, pairs: int, weight: Float64Array | float = 1.0
    ) -> Float64Array:
        """Weighted power of paths between each pair, with what foliage and people leave of them."""
        transfer = traced.transfer
        for loss in self._losses:
            start, end = path_ends(pair, *antennas)
            factor = loss.amplitude_factor(start, traced.points, end, traced.types)
            transfer = transfer * factor[..., None, None]
        power = weight * (np.abs(transfer) ** 2).sum((0, 2, 3))
        return np.bincount(pair, weights=power, minlength=pairs).astype(np.float64)

    def _matrices(self, launches: Sequence[Traced], table: PathTable, traced_from: Ends) -> Matrices | None:
        """Maker of the rung's H; `PlaneWaves` where it has no way of its own."""
        finder, memory = self._finder, int(self.settings.memory_gib * 2**30)
        if self.rung == "spherical" and table.traced is not None:
            surfaces = traced_surfaces(launches, table.traced, table.types, table.points, self._scene)
            return SphericalWaves(surfaces, finder.tracer.look, traced_from, memory)
        if self.rung == "mimo-rt":
            # A part of a launch is held whole; the rest is for the candidates of some receivers at a time.
            launched = self._launched
            lanes = memory // LANE_BYTES - min(launched.lanes, launched.rays_at_once) * launched.max_depth
            return ElementTracer(
                finder.tracer,
                self._scene,
                table.object_velocity,
                finder.wavelengths,
                max(1, lanes),
                self.settings.los,
                self._losses,
            )
        return None

    def _unmatched(self, scene: Scene) -> dict[str, int]:
        """Counts of the keys of settings that are for no object of a scene and no piece of scenery."""
        named = scene.names, scene.classes
        if self._known_unmatched[0] != named:
            # Keys may be for scenery or objects, by the same names.
            pieces = [(name, "") for name in (*self._scene.names, *self._scene.foliage_meshes)]
            found = [*pieces, *zip(*named, strict=True)]
            counts = {
                f"{UNMATCHED_PREFIX}{setting}.{key}": 1
                for setting, keys in self._keys.items()
                for key in keys.unmatched(found)
            }
            self._known_unmatched = named, counts
        return self._known_unmatched[1]


def _refuse_buried(scene: Scene, without_body: Sequence[str], foliage: Foliage | None) -> None:
    """Raise `PayloadError` for an antenna in the very middle of a body, which no wave can reach."""
    for device in scene.devices:
        if isinstance(device, AntennaDevice) and device.parent and device.position == (0.0, 0.0, 0.0):
            cls = scene.classes[scene.names.index(device.parent)]
            is_foliage = foliage is not None and foliage.keys.material_for(device.parent, cls)
            if cls not in without_body and not is_foliage:
                raise PayloadError(
                    f"antenna {device.name!r} stands in the middle of the body of {device.parent!r}, where "
                    f"no wave reaches it; mount it on the roof or floor, or list {cls!r} in without_body"
                )
