"""Finder of the paths of a frame in the ray-traced channel: by launches, by enumeration, or by both.

Reflections are launched in every frame, followed from frame to frame (`tracking`), or enumerated
(`enumeration.enumerated_paths`); paths of other kinds are launched. Diffuse paths may have a launch of their
own, and transmitters far from every edge one without diffraction. Which of these there are is fixed by the
settings, and `PathFinder.compile_kernels` has all of them compiled before the first frame.
"""

from __future__ import annotations

import importlib
import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_protocol.assets import default_folder
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT
from caviar_protocol.topics import Scene
from caviar_services.channel.arrays.element_paths import outermost
from caviar_services.channel.enumeration.enumerated_paths import EnumeratedTracer
from caviar_services.channel.enumeration.scenery_chains import (
    ChainCache,
    KnownScenery,
    SceneryChains,
    SceneryLaunch,
)
from caviar_services.channel.paths import Antenna, PathTable, path_ends
from caviar_services.channel.sionna.candidates import Corners, Met
from caviar_services.channel.sionna.diffracting_edges import EdgeRange
from caviar_services.channel.sionna.path_solver import Tracer
from caviar_services.channel.sionna.path_table import Ends, Traced
from caviar_services.channel.sionna.ray_launcher import Element, LaunchOptions
from caviar_services.channel.sionna.scene import SionnaScene
from caviar_services.channel.sionna.settings import SionnaSettings
from caviar_services.channel.sionna.tracking import Followed, Following, FollowingState
from caviar_services.drjit_setup import all_threads
from caviar_services.service import RunInfo

COMPILE_GRACE_S = 120.0
"""How long a kernel may take to compile, or a launch of scenery, before it counts as stalled."""

Launched = list[tuple[Int64Array, Traced]]
"""Paths of each launch or enumeration, and the pair that each path belongs to, Shape ``[P]``."""


class PathFinder:
    """Finds the paths of frames in a scene.

    Args:
        scene: Where; other models of the process may move its bodies between two frames.
        settings: How paths are looked for.
        options: What is launched in a frame, without what cannot contribute.
        run: Carriers, and devices whose places are known before the first frame.
        enumerated: Whether reflections are enumerated.
        before: Of the same scene with other bodies, whose knowledge of scenery holds; None: there is none.
    """

    def __init__(
        self,
        scene: SionnaScene,
        settings: SionnaSettings,
        options: LaunchOptions,
        run: RunInfo,
        enumerated: bool,
        before: PathFinder | None = None,
    ) -> None:
        self._scene, self._settings, self._run = scene, settings, run
        self.wavelengths = SPEED_OF_LIGHT / np.array([carrier.frequency_hz for carrier in run.carriers])
        """Of the carriers [m], Shape ``[C]``."""
        self.samples = settings.launched_samples(enumerated)
        """Rays of a launch; where candidates are enumerated, of scenery's."""
        # Rays are then launched in frames only for what is not enumerated, and few do.
        if enumerated:
            options = replace(options, samples=settings.samples_per_frame)
        self.options = options
        """What is launched in a frame, diffuse paths with a launch of their own included."""
        self._diffuse: Tracer | None = None
        own_samples = settings.scattering_samples
        if own_samples is not None and options.scattering:
            diffuse = replace(
                options,
                samples=own_samples,
                diffraction=False,
                only_scattered=True,
                diffuse_paths=settings.scattering_paths,
            )
            self._diffuse = self._tracer_of(diffuse)
            options = replace(options, scattering=False)
        self.tracer = self._tracer_of(options)
        """Traces all paths but diffuse ones that have a launch of their own."""
        self.launches = True
        """Whether rays are launched in each frame for paths of all kinds."""
        self.notes: tuple[str, ...] = ()
        """For the user."""
        self._enumerated: EnumeratedTracer | None = None
        self._scenery: SceneryChains
        if enumerated:
            self._enumerate(options, before)
        # Where no edge is in range of a transmitter and its receivers, a tracer without diffraction is used.
        self._edge_range: EdgeRange | None = None
        self._unbent: Tracer
        if settings.edges_within_m is not None and options.diffraction:
            self._edge_range = EdgeRange(scene.edges, settings.edges_within_m)
            self._unbent = self._tracer_of(replace(options, diffraction=False))
            range_note = (
                "diffraction is switched off for transmitters with no edge within "
                f"{settings.edges_within_m:g} m of them or of a receiver, and for paths over edges farther "
                "from both ends; the count no_edge_in_range tells for how many transmitters"
            )
            self.notes = (*self.notes, range_note)
        self._without_edge = 0
        self._without_body = frozenset(settings.without_body)
        self._following: Following | None = None
        if settings.follow is not None:
            self._following = Following(settings.follow, scene, self._without_body)
        self.missed: list[tuple[Int64Array, Traced, Float64Array]] = []
        """Of each launch of a frame for paths of all kinds, if asked for: pairs, paths, and the probability
        that half of the rays would have missed each path."""

    def _tracer_of(self, options: LaunchOptions) -> Tracer:
        return Tracer(self._scene, self.wavelengths.tolist(), options)

    # --- before the first frame ----------------------------------------------------------------------

    def _enumerate(self, options: LaunchOptions, before: PathFinder | None) -> None:
        """Know the scenery from where transmitters stand; notes say what was found, and what was not kept."""
        s, scene = self._settings, self._scene
        depth = min(options.max_depth, s.enumerated_depth)
        # Paths that only other elements than the arrays' centres have are launched too.
        self.launches = (
            options.refraction
            or options.diffraction
            or options.scattering
            or options.max_depth > depth
            or s.rung == "spherical"
        )
        cache = ChainCache(default_folder() / "chains") if s.cache_chains else None
        launch = SceneryLaunch(samples=self.samples, launches=s.scenery_launches)
        self._enumerated = EnumeratedTracer(scene, options)
        known_options = replace(options, max_depth=depth)
        earlier = before._scenery if before is not None and before._enumerated is not None else None
        transmitters = [d for d in self._run.devices if d.kind == "antenna" and d.role in ("tx", "both")]
        # Of transmitters that only frames tell of, any may move.
        moving = not transmitters or any(device.on for device in transmitters)
        self._scenery = SceneryChains(
            scene, known_options, launch, s.samples_per_frame, moving, cache, earlier
        )
        if earlier is not None:
            return

        def progress(phase: str) -> None:
            self._run.progress(phase, COMPILE_GRACE_S)

        for device in transmitters:
            if not device.on:
                name = device.name

                place = scene.surfaces.cleared(np.array(device.position_m))
                with all_threads():
                    known = self._scenery.prepare(name, place, progress)
                self.notes += (f"transmitter {name!r}: {known}",)
        self.notes += tuple(dict.fromkeys(cache.notes) if cache else ())

    def compile_kernels(self) -> None:
        """Trace above the scene, so that every kernel that frames need is compiled before the first one.

        Raises:
            SetupError: A library is missing (`compiled_loops.compile_loops`).
        """
        scene, options, s = self._scene, self.options, self._settings
        # Of an episode before this one, in the same scene.
        if (s, options) in scene.compiled:
            return
        scene.compiled.append((s, options))
        if options.diffraction:
            importlib.import_module("scipy.special")  # which the first diffracted path would wait for
        middle = (scene.low + scene.high) / 2
        above = np.array([middle[0], middle[1], scene.high[2] + 10.0])
        receivers = above + np.arange(1, 9)[:, None] * np.array([1.3, 0.7, -0.1])
        followed = None if s.follow is None else Followed(s.follow)
        tracers = [self.tracer] if self._edge_range is None else [self.tracer, self._unbent]
        if not self.launches:
            tracers = []
        # What is followed begins with nothing known; the later launches go by what the earlier ones met.
        for shift, tracer in itertools.product((0.0, 0.5, 1.0), tracers):
            tracer.trace(above + shift, receivers + shift / 2, followed=followed, names=scene.names)
        if self._diffuse is not None:
            for shift in (0.0, 0.5):
                self._diffuse.trace(above + shift, receivers + shift / 2)
        if s.rung != "siso-rt":
            corners = Corners(above[None] + [[0, 0, 0.1], [0, 0.1, 0]], receivers[:, None] + np.eye(3)[:2])
            for tracer in tracers:
                tracer.trace(above, receivers, corners=corners)
        if self._enumerated is not None:
            loops = importlib.import_module("caviar_services.channel.enumeration.compiled_loops")
            loops.compile_loops(self._compiling, options.diffraction)
            self._enumerated.compile_kernels()
            self._enumerate_above(self._enumerated, above)
        if s.rung == "spherical":
            look = self.tracer.look
            look.nearest(receivers, receivers - 1.0)
            chains = np.full((len(receivers), options.max_depth), -1)
            look.reflected(chains, receivers, receivers - 1.0)

    def _compiling(self, number: int, count: int) -> None:
        phase = f"compiling kernels of enumeration {number + 1}/{count}"
        # Some seconds of a processor that other processes may share.
        self._run.progress(phase, 3 * COMPILE_GRACE_S)

    def _enumerate_above(self, tracer: EnumeratedTracer, above: Float64Array) -> None:
        """Enumerate paths among two bodies of each mesh there, with a chain of scenery of each length."""
        scene, depth = self._scene, self.options.max_depth
        # Kinds are given, and not by names and classes, which the user's patterns may match.
        kinds = dict(enumerate(kind for kind in scene.unit_meshes for _ in scene.bodies_of(kind)[:2]))
        count = len(kinds)
        if not count:
            return
        place = above + np.arange(count)[:, None] * np.array([2.0, 7.0, 0.5])
        objects = Scene(
            names=tuple(f"caviar-warming-{number:04d}" for number in kinds),
            classes=("",) * count,
            assets=("",) * count,
            position=place,
            orientation=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
            velocity=np.zeros((count, 3)),
            dimensions=np.tile([4.0, 2.0, 1.5], (count, 1)),
        )
        chains = np.full((depth + 1, depth), -1, np.int32)
        for length in range(depth + 1):
            chains[length, :length] = np.arange(length)
        chains = chains[(chains < scene.first_moving_plane).all(1)]
        some = np.arange(depth)
        sights = np.stack(np.meshgrid(some, some), axis=-1).reshape(-1, 2).astype(np.int32)
        scenery = KnownScenery(chains[1:], sights)
        # With all, some and none of the bodies standing.
        for parked in (0, count // 2, count):
            scene.place_bodies(objects, {number: kind for number, kind in kinds.items() if number >= parked})
            tracer.trace(above + np.array([0.0, 3.0, 4.0]), place + np.array([0.3, 0.2, 1.0]), scenery)

    # --- frames --------------------------------------------------------------------------------------

    def forget(self) -> None:
        """Forget what was found before: an episode begins."""
        if self._following is not None:
            self._following.clear()
        self.tracer.forget()
        if self._edge_range is not None:
            self._unbent.forget()
        if self._diffuse is not None:
            self._diffuse.forget()

    @property
    def state(self) -> FollowingState:
        """The chains that are followed."""
        return self._following.state(self.tracer.offers()) if self._following else FollowingState()

    def resume(self, state: FollowingState) -> None:
        """Follow the chains of a saved state.

        Args:
            state: Of another finder with the same settings.
        """
        if self._following is not None:
            self._following.resume(state)
            self.tracer.offer_again(state.offers)

    def place(self, scene: Scene) -> tuple[tuple[str, ...], Float64Array]:
        """Move the bodies to the objects of a frame; see `SionnaScene.place`.

        Args:
            scene: The scene of the frame.
        """
        self._without_edge, self.missed = 0, []
        if self._following is not None:
            return self._following.place(scene)
        return self._scene.place(scene, self._without_body)

    def trace(
        self,
        transmitters: Sequence[Antenna],
        receivers: Sequence[Antenna],
        names: tuple[str, ...],
        *,
        elements: bool = False,
        with_missed: bool = False,
    ) -> Launched:
        """Find the paths of all pairs of a frame, launch by launch, one at least.

        Args:
            transmitters, receivers: Antennas where they are traced from; no device has paths to itself.
            names: What `place` returned.
            elements: Whether paths are asked for that only some elements of arrays have.
            with_missed: Whether `missed` is.
        """
        found: Launched = []
        for t, transmitter in enumerate(transmitters):
            others = np.array([r for r, rx in enumerate(receivers) if rx.name != transmitter.name], np.int64)
            ends = [receivers[r] for r in others.tolist()]
            targets = np.array([antenna.position for antenna in ends]).reshape(-1, 3)
            corners = self._corners(transmitter, ends) if elements else None
            pair = t * len(receivers) + others
            for traced, missed in self._found(transmitter, targets, names, corners, with_missed):
                found.append((pair[traced.receiver], traced))
                if missed is not None:
                    self.missed.append((*found[-1], missed))
        return found or [(np.zeros(0, np.int64), self.tracer.nothing)]

    def _corners(self, transmitter: Antenna, receivers: Sequence[Antenna]) -> Corners:
        longest = float(self.wavelengths.max())
        return Corners(outermost([transmitter], longest)[0], outermost(receivers, longest))

    def _found(
        self,
        transmitter: Antenna,
        targets: Float64Array,
        names: tuple[str, ...],
        corners: Corners | None,
        with_missed: bool,
    ) -> list[tuple[Traced, Float64Array | None]]:
        """Paths of one transmitter to targets [m], Shape ``[R, 3]``, with the probability that half of the
        rays would have missed them where it is asked for."""
        source, at_once = transmitter.position, self._settings.receivers_at_once
        tracer, over_edges = self.tracer, True
        if self._edge_range is not None and not self._edge_range.reaches(
            np.concatenate([source[None], targets])
        ):
            # Diffraction doubles the time of a launch, found or not.
            tracer, over_edges = self._unbent, False
            self._without_edge += 1
        found: list[tuple[Traced, Float64Array | None]] = []
        known: Callable[[Met], BoolArray] | None = None
        if self._enumerated is not None:
            scenery = self._scenery.known_from(transmitter.name, source)
            known = partial(self._enumerated.known_bends, scenery=scenery) if over_edges else None
            found.append((self._enumerated.trace(source, targets, scenery, over_edges), None))
        if self.launches:
            followed = None if self._following is None else self._following.chains_from(transmitter.name)
            launched = tracer.trace(source, targets, at_once, followed, names, corners=corners, known=known)
            if self._enumerated is not None:
                launched = self._enumerated.unknown(launched, found[0][0], scenery, over_edges)
            found.append((launched, tracer.missed_by_half(source, launched) if with_missed else None))
        if self._diffuse is not None:
            element = Element(transmitter)
            found.append((self._diffuse.trace(source, targets, at_once, element=element), None))
        return found

    def in_edge_range(self, table: PathTable, antennas: Ends) -> PathTable:
        """Leave out paths over edges that are out of range of both ends.

        Args:
            table: All paths of a frame.
            antennas: Transmitters and receivers.
        """
        if self._edge_range is None:
            return table
        return table.take(self._edge_range.within(table, *path_ends(table.pair, *antennas)))

    @property
    def counts(self) -> dict[str, int]:
        """Counts of the last frame, for the report."""
        return {} if self._edge_range is None else {"no_edge_in_range": self._without_edge}
