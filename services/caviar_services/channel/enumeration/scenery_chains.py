"""Chains of planes of scenery that waves from a place go along, found by launching many rays.

One launch misses what its rays pass by: of 84 chains of the street canyon it finds 77, whether with 1e5
rays or with 1e7, and the others only where the rays point elsewhere. So several launches, each turned a
little, are united, and a launch is traced in parts, whose memory is bounded.

Where scenery has few faces, a transmitter that moves needs no launch: every sequence of faces that see one
another is a chain, from wherever it is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass, replace
from functools import reduce

import numpy as np

from caviar_protocol.arrays import Float64Array, Int32Array, Int64Array
from caviar_services.channel.enumeration.chain_cache import ChainCache, cache_key
from caviar_services.channel.enumeration.chain_tree import ChainTree
from caviar_services.channel.enumeration.plane_visibility import seen_planes, visible_pairs
from caviar_services.channel.enumeration.scene_faces import SceneFaces
from caviar_services.channel.sionna.candidate_visibility import Faces
from caviar_services.channel.sionna.candidates import positions
from caviar_services.channel.sionna.chains import chains_of
from caviar_services.channel.sionna.ray_launcher import Launch, Launcher, LaunchOptions, PartedLauncher
from caviar_services.channel.sionna.scene import SionnaScene

_SIGHT_RAYS, _SIGHT_RAYS_PER_FRAME = 4096, 64
"""From each plane, to find which others it sees: before the first frame, and in each."""

_ROUNDING = float(np.finfo(np.float32).eps)
"""Of a coordinate; a transmitter that is this near to where it was prepared has not moved: worlds in other
languages may send its position in single precision."""

_SEEN_RAYS = 8192
"""Of a transmitter that moves, to find the faces that may come first: 2.2° apart."""

_FEW = 64
"""Faces of scenery of which all sequences are taken."""


@dataclass(frozen=True, kw_only=True)
class SceneryLaunch:
    """How chains of scenery are looked for."""

    samples: int
    """Rays of a launch."""
    launches: int
    """Each turned a little against the others."""


@dataclass(frozen=True, eq=False)
class KnownScenery:
    """What is known of the scenery from the place of a transmitter."""

    chains: Int32Array
    """Planes that waves from there are reflected at in turn, −1 behind the last, Shape ``[K, D]``."""
    sights: Int32Array
    """Pairs of these planes that see one another, in both orders, Shape ``[M, 2]``."""


class SceneryChains:
    """Chains of scenery of all transmitters: of those that stand, launched once with many rays; of others,
    all that there can be, or where these are too many, launched in each frame.

    Made while no body is in the scene.

    Parameters
    ----------
    scene, options
        What is traced in, and the depth and the seed of what is wanted.
    launch
        From where a transmitter stands.
    per_frame
        Rays from one that moves.
    cache
        Where chains are kept between runs; None: nowhere.
    """

    def __init__(
        self,
        scene: SionnaScene,
        options: LaunchOptions,
        launch: SceneryLaunch,
        per_frame: int,
        cache: ChainCache | None,
    ) -> None:
        self._scene, self._options, self._launch, self._cache = scene, options, launch, cache
        self._launcher = PartedLauncher(scene.mi_scene, only_reflected(options, per_frame))
        self._look = Faces(scene)
        self._faces = SceneFaces(scene)
        self._known: dict[str, tuple[Float64Array, KnownScenery]] = {}
        """By the name of a transmitter that stands: its place in the world [m], and what is known from there.

        Each has its own: however near to another one it stands, a wall may be between them."""
        self._every = self._every_chain()
        """All chains, and which planes see one another; None: too many."""
        self._last: tuple[bytes, int, KnownScenery] | None = None

    def prepare(self, name: str, transmitter: Float64Array, progress: Callable[[int, int], None]) -> str:
        """Launch from where the transmitter ``name`` stands [m], Shape ``[3]``, while no body is there.

        ``progress`` is called before each part with its number and how many there are. Returns what was
        found.
        """
        if not self._scene.has_scenery:
            return "there is no scenery"
        place = transmitter - self._scene.centre
        key = self._key(place)
        known = self._cache.load(key, (self._options.max_depth, 2)) if self._cache else None
        source = "of the cache"
        if known is None:
            chains = launched_chains(self._scene, self._options, self._launch, place, progress)
            known = chains, self._sights(chains, _SIGHT_RAYS)
            source = f"of {self._launch.launches} launches of {self._launch.samples} rays"
            if self._cache:
                self._cache.save(key, known)
        chains, sights = known
        self._known[name] = transmitter, KnownScenery(chains, sights)
        return f"{len(chains)} chains of scenery {source}"

    def of(self, name: str, transmitter: Float64Array) -> KnownScenery:
        """Those of the transmitter ``name`` at a position in the world [m], Shape ``[3]``, in the scene as it
        stands."""
        if name in self._known:
            known, scenery = self._known[name]
            if np.all(np.abs(known - transmitter) <= _ROUNDING * np.abs(known)):
                return scenery
        place = transmitter - self._scene.centre
        last = self._last
        if last is None or last[:2] != (place.tobytes(), self._scene.version):
            last = self._last = place.tobytes(), self._scene.version, self._now(place)
        return last[2]

    def _now(self, place: Float64Array) -> KnownScenery:
        """What the frame tells about the scenery from a place in the ray tracer's coordinates."""
        if not self._scene.has_scenery:
            depth = self._options.max_depth
            return KnownScenery(np.zeros((0, depth), np.int32), np.zeros((0, 2), np.int32))
        if self._every is None:
            chains = self._launched(place)
            return KnownScenery(chains, self._sights(chains, _SIGHT_RAYS_PER_FRAME))
        tree, sights = self._every
        return KnownScenery(
            tree.chains(place, seen_planes(self._look, place[None], tree.planes, _SEEN_RAYS)[0]), sights
        )

    def _every_chain(self) -> tuple[ChainTree, Int32Array] | None:
        faces = self._faces.scenery(np.arange(self._scene.first_moving_plane))
        if not 0 < len(faces) <= _FEW:
            return None
        sights = visible_pairs(self._look, faces, _SIGHT_RAYS, self._options.seed)
        tree = ChainTree.of(faces, sights, self._options.max_depth)
        return None if tree is None else (tree, sights.astype(np.int32))

    def _launched(self, place: Float64Array) -> Int32Array:
        """Chains that one launch finds from a place in the ray tracer's coordinates [m], Shape ``[3]``."""

        def look(_: Int64Array, launch: Launch) -> Int32Array:
            return scenery_of(launch, self._scene, self._options.max_depth)

        return reduce(united, self._launcher.each(look, positions(place[None])))

    def _sights(self, chains: Int32Array, rays: int) -> Int32Array:
        """Which planes of chains see one another."""
        faces = self._faces.scenery(chains[chains >= 0].astype(np.int64))
        return visible_pairs(self._look, faces, rays, self._options.seed).astype(np.int32)

    def _key(self, place: Float64Array) -> str:
        import sionna.rt

        options = (self._options.max_depth, self._options.seed, *astuple(self._launch), sionna.rt.__version__)
        return cache_key(self._scene.scenery_digest, place.tobytes(), repr(options).encode())


def launched_chains(
    scene: SionnaScene,
    options: LaunchOptions,
    launch: SceneryLaunch,
    transmitter: Float64Array,
    progress: Callable[[int, int], None],
) -> Int32Array:
    """Planes of all chains of scenery that rays from a place go along, −1 behind the last, Shape ``[K, D]``.

    Chains are sorted, those of fewer planes first, and with each chain its beginnings are there.

    Parameters
    ----------
    options
        Of the paths that are wanted: the depth and the seed; only reflections are looked for.
    transmitter
        In the ray tracer's coordinates [m], Shape ``[3]``.
    progress
        Called before each part with its number and how many there are.
    """
    reflected = only_reflected(options, launch.samples)
    source = positions(transmitter[None])
    part = options.rays_at_once
    parts = -(-launch.samples // part)
    found = np.full((0, options.max_depth), -1, np.int32)
    for index in range(parts):
        rays = (index * part, min((index + 1) * part, launch.samples))
        launcher = Launcher(scene.mi_scene, reflected, rays)
        for number in range(launch.launches):
            progress(index * launch.launches + number, parts * launch.launches)
            chains = scenery_of(launcher(source, number=number), scene, options.max_depth)
            found = united(found, chains)
    return found


def only_reflected(options: LaunchOptions, samples: int) -> LaunchOptions:
    """What a launch is made with that looks for chains of reflections."""
    return replace(
        options, samples=samples, reflection=True, refraction=False, diffraction=False, scattering=False
    )


def scenery_of(launch: Launch, scene: SionnaScene, depth: int) -> Int32Array:
    """Chains of a launch that planes of scenery alone reflect, as in `launched_chains`."""
    chains = chains_of(launch, scene, depth)
    some = chains.straight & ((chains.planes >= 0).sum(1) == chains.depth)
    some &= (chains.planes < scene.first_moving_plane).all(1)
    return united(np.full((0, depth), -1, np.int32), chains.planes[some])


def united(one: Int32Array, other: Int32Array) -> Int32Array:
    """The chains of both, each once, sorted by their number of planes and by these."""
    chains = np.unique(np.concatenate([one, other]), axis=0)
    order: Int64Array = np.lexsort((*chains.T[::-1], (chains >= 0).sum(1)))
    return chains[order]
