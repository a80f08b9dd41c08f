"""The ray-traced rungs: Sionna RT finds the paths; ``rung`` says what becomes of the arrays.

``siso-rt`` traces between the arrays' centres and applies the arrays as plane waves, ``spherical`` gives
each antenna pair its own length of the same paths (`spherical`), ``mimo-rt`` traces every pair (`mimo_rt`).
They are one implementation with one scene and one set of options, so a rung is a setting like any other.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import ClassVar

import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array, Int64Array
from caviar_protocol.assets import default_folder
from caviar_protocol.errors import PayloadError, SetupError
from caviar_protocol.host import install_command
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.seeding import derive_seed
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT
from caviar_protocol.topics import AntennaDevice, ChannelOptions, Scene
from caviar_protocol.topics.channel import UNMATCHED_PREFIX
from caviar_services.channel.arrays.channel_matrices import Matrices
from caviar_services.channel.arrays.element_visibility import outermost
from caviar_services.channel.arrays.mimo_rt import ElementTracer
from caviar_services.channel.arrays.spherical import SphericalWaves
from caviar_services.channel.base import Found, PathModel
from caviar_services.channel.enumeration.chain_cache import ChainCache
from caviar_services.channel.enumeration.path_solver import EnumeratedTracer
from caviar_services.channel.enumeration.scenery_chains import SceneryChains, SceneryLaunch
from caviar_services.channel.paths import Antenna, PathTable
from caviar_services.channel.propagation.clearance import with_near_pairs
from caviar_services.channel.propagation.foliage import Foliage
from caviar_services.channel.sionna.candidate_visibility import Corners
from caviar_services.channel.sionna.contributing import contributing
from caviar_services.channel.sionna.diffuse_paths import Element
from caviar_services.channel.sionna.edge_range import EdgeRange
from caviar_services.channel.sionna.materials import MaterialPolicy, ObjectMaterials, OutsideUse
from caviar_services.channel.sionna.path_solver import LANE_BYTES, Tracer
from caviar_services.channel.sionna.path_table import Ends, Traced, path_ends, path_table, traced_surfaces
from caviar_services.channel.sionna.ray_launcher import LaunchOptions, rays_within
from caviar_services.channel.sionna.scene import SceneSettings, SionnaScene
from caviar_services.channel.sionna.scene_sharing import scene_of
from caviar_services.channel.sionna.settings import SionnaSettings
from caviar_services.channel.sionna.tracked_chains import Following, FollowingState
from caviar_services.channel.sionna.warmup import compile_kernels
from caviar_services.checkpoint import restored, saved
from caviar_services.ray_tracing import activate_llvm, all_threads, choose_variant, limit_threads
from caviar_services.service import Frame, Preparation, RunInfo, StepResult

_COMPILE_GRACE_S = 120.0


class SionnaChannel(PathModel[SionnaSettings]):
    """Ray-traced channel, on any number of carriers.

    Each transmitter launches its rays once a frame, whoever receives, and every receiver is offered all
    that they met: its paths do not depend on which others there are. Several carriers share the paths;
    a path that one of them does not have is of amplitude 0 there.
    """

    Settings: ClassVar[type[msgspec.Struct]] = SionnaSettings
    rung = "siso-rt"
    extra: ClassVar[str] = "channel"
    uses_scenery: ClassVar[bool] = True
    checkpoints: ClassVar[bool] = True

    @classmethod
    def check_settings(cls, settings: SionnaSettings, place: Place) -> None:
        """See `SionnaSettings.check`."""
        settings.check(place)

    def __init__(self, settings: SionnaSettings, run: RunInfo) -> None:
        super().__init__(settings, run)
        self.rung = settings.rung
        # Rays of each launch; where candidates are enumerated, of the scenery's.
        self._samples = settings.launched_samples()
        self._variant = ""
        self._scene: SionnaScene
        self._tracer: Tracer
        # Traces diffuse paths where they have a launch of their own.
        self._diffuse: Tracer | None = None
        self._edge_range: EdgeRange | None = None
        # Traces where no edge is in range.
        self._unbent: Tracer
        # Transmitters of this frame that no edge is in range of.
        self._without_edge = 0
        # Finds reflected paths where they are enumerated.
        self._enumerated: EnumeratedTracer | None = None
        # What it knows of the scenery.
        self._scenery: SceneryChains
        # Whether rays are launched in each frame for the paths of all kinds.
        self._launches = True
        self._following: Following | None = None
        self._outside: tuple[OutsideUse, ...] = ()
        self.foliage: Foliage | None = None
        """What paths lose in; None: no foliage in the scenario."""
        if settings.foliage:
            self.foliage = Foliage(
                settings.foliage,
                run.carriers,
                Place("services").at(run.name).at("settings"),
                {"without_body": settings.without_body, "object_materials": settings.object_materials},
            )
        self._detail = ""
        self._room: dict[str, int] = {}
        self._names: tuple[str, ...] = ()
        self._keys: dict[str, ObjectMaterials] = {}
        # Of the pieces of the scene in the last frame.
        self._known_unmatched: tuple[object, dict[str, int]] = (None, {})
        # Power that half of the rays would have missed in the last frame, Shape ``[T, R]``.
        self._missed = np.zeros((0, 0))
        seed = settings.launch_seed
        self._asked = LaunchOptions(
            max_depth=settings.max_depth,
            samples=self._samples,
            max_paths=settings.max_paths,
            seed=derive_seed(run.seed, 0, f"{run.name}/launch") if seed is None else seed,
            reflection=settings.reflection,
            refraction=settings.refraction,
            diffraction=settings.diffraction,
            scattering=settings.scattering,
            rays_at_once=rays_within(settings.memory_gib, settings.max_depth),
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
            samples=self._samples,
            materials_outside=tuple(use.brief(self.run.carriers[use.carrier].name) for use in self._outside),
            detail=self._detail,
            foliage=() if self.foliage is None else self.foliage.briefs,
        )

    @property
    def extent(self) -> tuple[Float64Array, Float64Array] | None:
        return (self._scene.low, self._scene.high) if self._scene.has_scenery else None

    @property
    def room(self) -> Mapping[str, int]:
        return self._room

    def enclosing(self, position: Float64Array) -> str:
        """See `ChannelModel.enclosing`; an antenna at a surface is on the side that it is traced from."""
        piece = self._scene.enclosing(self._scene.surfaces.cleared(position))
        return self._names[piece] if piece >= 0 else ""

    @property
    def scene(self) -> SionnaScene:
        """What waves meet; after `load_scene`."""
        return self._scene

    @property
    def launch_seed(self) -> int:
        """Of all rays."""
        return self._asked.seed

    def load_scene(self, preparation: Preparation) -> tuple[str, ...]:
        """Start the ray tracer and load scenery and bodies; notes for the user.

        `load` begins with it; a radio map needs the scene without the paths."""
        s = self.settings
        self.run.progress("importing the ray tracer", _COMPILE_GRACE_S)
        notes = self._start()
        self.run.progress("loading the scene", _COMPILE_GRACE_S)
        frequencies = tuple(carrier.frequency_hz for carrier in self.run.carriers)
        self._room = s.pool_sizes(preparation.assets, self.run.name)
        self._scene = scene_of(
            preparation.assets,
            self._room,
            SceneSettings(
                frequencies_hz=frequencies,
                body_material=s.body_material,
                materials=MaterialPolicy(
                    changes=s.materials,
                    outside=s.outside_itu_range,
                    key=f"services.{self.run.name}.settings",
                ),
                edges=s.diffraction,
                free_edges=s.free_edges,
                detail=s.detail,
                objects=ObjectMaterials(s.object_materials),
                foliage=ObjectMaterials() if self.foliage is None else self.foliage.keys,
            ),
        )
        if self.foliage is not None:
            self.foliage.stand(self._scene.foliage_meshes)
            notes += tuple(f"foliage {brief}" for brief in self.foliage.briefs)
        self._names = self._scene.names
        self._outside = self._scene.outside
        self._keys = {"object_materials": ObjectMaterials(s.object_materials)}
        if self.foliage is not None:
            self._keys["foliage"] = self.foliage.keys
        notes += tuple(use.note(self.run.carriers[use.carrier].name) for use in self._outside)
        if self._scene.detail_effect is not None:
            notes += (self._scene.detail_effect.note,)
            self._detail = self._scene.detail_effect.brief
        return notes

    def load(self, preparation: Preparation) -> tuple[str, ...]:
        s = self.settings
        notes = self.load_scene(preparation)
        frequencies = tuple(carrier.frequency_hz for carrier in self.run.carriers)
        self._launched, switched = contributing(self._asked, self._scene.used_surfaces(), frequencies)
        self._wavelengths = SPEED_OF_LIGHT / np.array(frequencies)
        enumerated = s.enumerates(self._moving(preparation)) and self._launched.reflection
        self._samples = s.launched_samples(enumerated)
        if enumerated:
            self._launched = replace(self._launched, samples=s.samples_per_frame)
        launched, samples = self._launched, self.settings.scattering_samples
        if samples is not None and launched.scattering:
            own = replace(
                launched,
                samples=samples,
                diffraction=False,
                only_scattered=True,
                diffuse_paths=self.settings.scattering_paths,
            )
            self._diffuse = Tracer(self._scene, self._wavelengths.tolist(), own)
            launched = replace(launched, scattering=False)
        self._tracer = Tracer(self._scene, self._wavelengths.tolist(), launched)
        if enumerated:
            notes += self._enumerate(launched)
        if s.edges_within_m is not None and launched.diffraction:
            self._edge_range = EdgeRange(self._scene, s.edges_within_m)
            self._unbent = Tracer(
                self._scene, self._wavelengths.tolist(), replace(launched, diffraction=False)
            )
            range_note = (
                f"diffraction is switched off for transmitters with no edge within {s.edges_within_m:g} m of "
                "them or of a receiver, and for paths over edges farther from both ends; the count "
                "no_edge_in_range tells for how many transmitters"
            )
            notes = (*notes, range_note)
        if s.follow is not None:
            self._following = Following(s.follow, self._scene, self._tracer, frozenset(s.without_body))
        return (*notes, *switched, *self._warm_up())

    def reset(self, episode: int, seed: int, t0_ns: int) -> None:
        """Forget the paths of the episode before: what is followed must not begin with them."""
        if self._following is not None:
            self._following.clear()
        self._tracer.forget()
        if self._edge_range is not None:
            self._unbent.forget()
        if self._diffuse is not None:
            self._diffuse.forget()

    def checkpoint(self) -> bytes:
        """The chains that are followed."""
        return saved(self, 1, self._following.state if self._following else FollowingState())

    def restore(self, state: bytes) -> None:
        """See `checkpoint`."""
        was = restored(self, 1, FollowingState, state)
        if self._following is not None:
            self._activate()
            self._following.go_on(was)

    def step(self, frame: Frame) -> StepResult:
        """Raises `PayloadError` where paths that shall be followed are not known."""
        if self.settings.follow is not None and frame.previous < 0 < frame.number:
            raise PayloadError(
                f"{self.run.name} follows paths from the beginning of an episode and was started again in "
                f"frame {frame.number}, where it knows none; without its setting `follow`, or with states "
                "saved (run.checkpoint_frames above 0), the run goes on"
            )
        return super().step(frame)

    def release_memory(self) -> None:
        """Dr.Jit keeps freed buffers, some of each size that it has seen; sizes vary with the paths."""
        import drjit as dr

        dr.flush_malloc_cache()

    def paths(self, scene: Scene, transmitters: Sequence[Antenna], receivers: Sequence[Antenna]) -> Found:
        self._activate()
        _refuse_buried(scene, self.settings.without_body, self.foliage)
        if self.foliage is not None:
            self.foliage.move(scene)
        if self._following is not None:
            names, velocity = self._following.place(scene)
        else:
            names, velocity = self._scene.place(scene, frozenset(self.settings.without_body))
        self._names = names
        self._missed = np.zeros((len(transmitters), len(receivers)))
        clear = [self._cleared(antenna) for antenna in (*transmitters, *receivers)]
        sources, targets = clear[: len(transmitters)], clear[len(transmitters) :]
        self._without_edge = 0
        parts = [part for t, source in enumerate(sources) for part in self._launch(t, source, targets, names)]
        parts = parts or [(np.zeros(0, np.int64), self._tracer.nothing)]
        antennas = transmitters, receivers
        table = path_table(self._scene, parts, names, velocity, antennas, (sources, targets))
        if self._edge_range is not None:
            table = table.take(self._edge_range.within(table, *path_ends(table.pair, *antennas)))
        los = np.zeros(len(transmitters) * len(receivers), bool)
        straight = (table.types == 0).all(1)
        los[table.pair[straight if table.hidden is None else straight & ~table.hidden]] = True
        table, too_close = with_near_pairs(table, los, *antennas, self._wavelengths, self._scene.surfaces)
        if self.foliage is not None:
            table = self.foliage.attenuated(table, *path_ends(table.pair, *antennas))
        if not self.settings.los:
            table = table.take((table.types != 0).any(1))
        return Found(
            table=table,
            los=los.reshape(len(transmitters), len(receivers)),
            counts={
                "path_limit_reached": sum(part.lost for _, part in parts),
                "too_close": too_close,
                **self._unmatched(scene),
                **({} if self._edge_range is None else {"no_edge_in_range": self._without_edge}),
            },
            matrices=self._matrices([part for _, part in parts], table, (sources, targets)),
            split_nmse=self._split_nmse(parts, antennas),
        )

    def _split_nmse(self, parts: Sequence[tuple[Int64Array, Traced]], antennas: Ends) -> Float64Array | None:
        """See `Found.split_nmse`; antennas count as isotropic."""
        if not (self.with_split and self._launches):
            return None
        power = np.zeros(self._missed.size)
        for pair, traced in parts:
            dimmed = self._dimmed(traced, *path_ends(pair, *antennas))
            power += _power(pair, dimmed, self._missed.size)
        split: Float64Array = self._missed / np.maximum(power, np.finfo(np.float64).tiny).reshape(
            self._missed.shape
        )
        return split

    def _dimmed(self, traced: Traced, start: Float64Array, end: Float64Array) -> Traced:
        """Traced paths between these positions [m], Shape ``[P, 3]``, with what foliage leaves of them."""
        if self.foliage is None:
            return traced
        factor = self.foliage.amplitude_factor(start, traced.points, end, traced.types)
        return replace(traced, transfer=traced.transfer * factor[..., None, None])

    def _activate(self) -> None:
        """The variant of Mitsuba is the process's, and others may have set theirs."""
        import mitsuba as mi

        if mi.variant() != self._variant:
            mi.set_variant(self._variant)

    def _matrices(self, launches: Sequence[Traced], table: PathTable, traced_from: Ends) -> Matrices | None:
        """How the rung makes H; `PlaneWaves` where it has no way of its own."""
        memory = int(self.settings.memory_gib * 2**30)
        if self.rung == "spherical" and table.traced is not None:
            surfaces = traced_surfaces(launches, table.traced, table.types, table.points, self._scene)
            return SphericalWaves(surfaces, self._tracer.look, traced_from, self.run.carriers, memory)
        if self.rung == "mimo-rt":
            # A part of a launch is held whole; the rest is for the candidates of some receivers at a time.
            launched = self._launched
            lanes = memory // LANE_BYTES - min(launched.lanes, launched.rays_at_once) * launched.max_depth
            return ElementTracer(
                self._tracer,
                self._scene,
                table.object_velocity,
                self._wavelengths,
                max(1, lanes),
                self.settings.los,
                self.foliage,
            )
        return None

    def _cleared(self, antenna: Antenna) -> Antenna:
        """An antenna where it is traced from."""
        return replace(antenna, position=self._scene.surfaces.cleared(antenna.position))

    def _launch(
        self, t: int, transmitter: Antenna, receivers: Sequence[Antenna], names: tuple[str, ...]
    ) -> list[tuple[Int64Array, Traced]]:
        """Paths of one transmitter to the receivers, with the pair that each belongs to, launch by launch."""
        others = [r for r, receiver in enumerate(receivers) if receiver.name != transmitter.name]
        targets = np.array([receivers[r].position for r in others]).reshape(-1, 3)
        corners = None
        if self.rung == "spherical" and (self.with_h or self.wideband):
            longest = SPEED_OF_LIGHT / min(carrier.frequency_hz for carrier in self.run.carriers)
            corners = Corners(
                outermost([transmitter], longest)[0], outermost([receivers[r] for r in others], longest)
            )
        s = self.settings
        followed = None if self._following is None else self._following.of(transmitter.name)
        tracer = self._tracer
        if self._edge_range is not None and not self._edge_range.reaches(
            np.concatenate([transmitter.position[None], targets])
        ):
            tracer = self._unbent
            self._without_edge += 1
        found = []
        over_edges = tracer is self._tracer
        if self._enumerated is not None:
            scenery = self._scenery.of(transmitter.name, transmitter.position)
            found.append(self._enumerated.trace(transmitter.position, targets, scenery, over_edges))
        if self._launches:
            launched = tracer.trace(
                transmitter.position, targets, s.receivers_at_once, followed, names, corners=corners
            )
            if self._enumerated is not None:
                launched = self._enumerated.unknown(launched, found[0], scenery, over_edges)
            found.append(launched)
            if self.with_split:
                last = found[-1]
                missed = tracer.missed_by_half(transmitter.position, last)
                ends = targets[last.receiver]
                dimmed = self._dimmed(last, np.broadcast_to(transmitter.position, ends.shape), ends)
                self._missed[t, others] = _power(last.receiver, dimmed, len(others), missed)
        if self._diffuse is not None:
            element = Element(transmitter)
            found.append(
                self._diffuse.trace(transmitter.position, targets, s.receivers_at_once, element=element)
            )
        first, index = t * len(receivers), np.array(others, np.int64)
        return [(first + index[traced.receiver], traced) for traced in found]

    def _unmatched(self, scene: Scene) -> dict[str, int]:
        """Counts of the keys of settings that are for no object of a scene and no piece of scenery."""
        named = scene.names, scene.classes
        if self._known_unmatched[0] != named:
            pieces = [(name, "") for name in (*self._scene.names, *self._scene.foliage_meshes)]
            objects = zip(*named, strict=True)
            found = [*pieces, *objects]
            counts = {
                f"{UNMATCHED_PREFIX}{setting}.{key}": 1
                for setting, keys in self._keys.items()
                for key in keys.unmatched(found)
            }
            self._known_unmatched = named, counts
        return self._known_unmatched[1]

    def _moving(self, preparation: Preparation) -> bool:
        """Whether objects move in the run, for all that is known before its first frame."""
        meshes = any(name.startswith("objects/") for name in preparation.assets)
        return meshes or any(device.on for device in self.run.devices)

    def _enumerate(self, launched: LaunchOptions) -> tuple[str, ...]:
        """Know the scenery from where transmitters stand; what was found, and what could not be kept."""
        s = self.settings
        depth = min(launched.max_depth, s.enumerated_depth)
        # Paths that only other elements than the arrays' centres have are launched too.
        self._launches = (
            launched.refraction
            or launched.diffraction
            or launched.scattering
            or launched.max_depth > depth
            or self.rung == "spherical"
        )
        cache = ChainCache(default_folder() / "chains") if s.cache_chains else None
        launch = SceneryLaunch(samples=self._samples, launches=s.scenery_launches)
        self._enumerated = EnumeratedTracer(self._scene, launched)
        options = replace(launched, max_depth=depth)
        self._scenery = SceneryChains(self._scene, options, launch, s.samples_per_frame, cache)
        notes = []
        for device in self.run.devices:
            if device.kind == "antenna" and device.role in ("tx", "both") and not device.on:
                name = device.name

                def progress(part: int, parts: int, name: str = name) -> None:
                    phase = f"launching scenery rays from {name!r}, part {part + 1} of {parts}"
                    self.run.progress(phase, _COMPILE_GRACE_S)

                place = self._scene.surfaces.cleared(np.array(device.position_m))
                with all_threads():
                    known = self._scenery.prepare(name, place, progress)
                notes.append(f"transmitter {name!r}: {known}")
        return (*notes, *(cache.notes if cache else ()))

    def _start(self) -> tuple[str, ...]:
        """Import the ray tracer with its library and variant; notes that say which."""
        self._variant = choose_variant()
        notes: tuple[str, ...] = (f"Mitsuba variant {self._variant}",)
        if self._variant.startswith("llvm"):
            notes = (activate_llvm(), *notes)
        try:
            import mitsuba as mi

            mi.set_variant(self._variant)
            limit_threads()
            import sionna.rt
        except ImportError as error:
            raise SetupError(
                f"sionna-rt cannot be imported ({error}); run: {install_command('channel')}"
            ) from error
        return (*notes, f"sionna-rt {sionna.rt.__version__}")

    def _warm_up(self) -> tuple[str, ...]:
        """Compile every kernel that frames need; how long that took."""
        self.run.progress("compiling kernels", _COMPILE_GRACE_S)
        begin = time.monotonic()
        tracers = [self._tracer] if self._edge_range is None else [self._tracer, self._unbent]
        compile_kernels(
            self._scene,
            self._launched,
            tracers if self._launches else [],
            self._diffuse,
            rung=self.rung,
            followed_parts=self.settings.follow,
            enumerated=self._enumerated,
        )
        self.run.progress("kernels compiled", 0.0)
        return (f"kernels compiled in {time.monotonic() - begin:.1f} s",)


def _power(where: Int64Array, traced: Traced, count: int, weight: Float64Array | float = 1.0) -> Float64Array:
    """Weighted power of the paths that arrive at each of ``count`` places, with isotropic antennas."""
    power = (np.abs(traced.transfer) ** 2).sum((0, 2, 3))
    return np.bincount(where, weights=weight * power, minlength=count).astype(np.float64)


def _refuse_buried(scene: Scene, without_body: Sequence[str], foliage: Foliage | None) -> None:
    """Raise `PayloadError` for an antenna in the very middle of a body, which no wave can reach."""
    for device in scene.devices:
        if isinstance(device, AntennaDevice) and device.parent and device.position == (0.0, 0.0, 0.0):
            cls = scene.classes[scene.names.index(device.parent)]
            is_foliage = foliage is not None and foliage.keys.of(device.parent, cls)
            if cls not in without_body and not is_foliage:
                raise PayloadError(
                    f"antenna {device.name!r} stands in the middle of the body of {device.parent!r}, where "
                    f"no wave reaches it; mount it on the roof or floor, or list {cls!r} in without_body"
                )
