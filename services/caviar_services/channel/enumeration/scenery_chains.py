"""Faces of a scene, and chains of planes of scenery that waves from a place go along: launched, or enumerated
where faces are few.

Faces of scenery are made once, those of moving bodies as they stand in a frame.

One launch misses what its rays pass by: of 84 chains of the street canyon it finds 77, whether with 1e5
rays or with 1e7, and the others only where the rays point elsewhere. So several launches, each turned a
little, are united, and a launch is traced in parts, whose memory is bounded.

Where scenery has few faces, a transmitter that moves needs no launch: every sequence of faces that see one
another is a chain, from wherever it is. From a place, the beams of its images (`image_beams`) leave most of
them dark.

Of a thousand planes in a town each sees some thirty. Rays in all directions from points of each plane tell
which; planes that are hidden but for less than one ray meets count as hidden.

Launched chains are kept in files, so that the next run with the same scenery does not launch them again. A
file's name is a digest of all that its chains follow from, so a file is never out of date: the scenery's
triangles, the transmitter's position, how rays are launched, and the versions of this format and of the ray
tracer. Files are put in place in one step, and one that is damaged is launched again.
"""

from __future__ import annotations

import fcntl
import hashlib
import math
import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import astuple, dataclass, replace
from functools import lru_cache, reduce
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int32Array, Int64Array
from caviar_protocol.files import read_regular, replace_file
from caviar_protocol.messages import WARNING
from caviar_services.channel.enumeration.image_beams import (
    ChainPairs,
    Targets,
    first_beams,
    kernels,
    reflected_beams,
)
from caviar_services.channel.sionna.candidates import Faces, chains_of
from caviar_services.channel.sionna.ray_launcher import Launch, Launcher, LaunchOptions, PartedLauncher
from caviar_services.channel.sionna.scene import SionnaScene
from caviar_services.checkpoint import Packed
from caviar_services.drjit_setup import positions
from caviar_space.planes import two_sided_planes
from caviar_space.rectangles import FaceRectangles, narrowest_sides
from caviar_space.vectors import ranges


class SceneFaces:
    """Faces of a scene in the coordinates of its ray tracer.

    Args:
        scene: The scene; its bodies are where `SionnaScene.place` put them last.
        inner: Whether waves may be inside of closed bodies, so that the inner sides of their faces reflect
            too.
    """

    def __init__(self, scene: SionnaScene, inner: bool = False) -> None:
        self._scene = scene
        table = scene.plane_table
        first = scene.first_moving_plane
        triangles, sizes = table.triangles_of(np.arange(len(table.triangle)))
        piece = scene.piece_of(triangles)
        self._scenery = _faces_of(scene, np.arange(first))
        self._row = np.full(first, -1)
        self._row[self._scenery.plane] = np.arange(len(self._scenery))
        body_of = piece[np.cumsum(sizes) - sizes] - scene.first_body_piece
        # Number of the body that each moving plane is of.
        self._body_of = body_of[first:]
        self._two_sided = np.ones(len(self._body_of), np.bool_)
        # Side of each moving plane's rectangle, the first of its triangles having the sides 0 to 2.
        self._along = np.zeros(len(self._body_of), np.int64)
        for asset, mesh in scene.unit_meshes.items():
            numbers = scene.face_numbers(asset)
            both, order = two_sided_planes(mesh, numbers), np.argsort(numbers, kind="stable")
            # Counted from the first triangle of each plane.
            sizes = np.bincount(numbers)
            along = narrowest_sides(mesh.vertices[mesh.faces[order]], sizes)
            along -= 3 * (np.cumsum(sizes) - sizes)
            for body in scene.bodies_of(asset):
                self._two_sided[self._body_of == body] = both | inner
                self._along[self._body_of == body] = along
        self._standing: tuple[int, ...] | None = None
        self._rows: tuple[Int64Array, Int64Array, Int64Array]

    def scenery(self, planes: Int64Array) -> FaceRectangles:
        """Faces of these planes of scenery, in ascending order; planes of no area are left out."""
        rows = self._row[np.unique(planes)]
        return self._scenery.take(rows[rows >= 0])

    def bodies(self) -> tuple[FaceRectangles, Int64Array]:
        """Faces of all standing bodies, body after body, and how many each of these has."""
        # Which rows are needed follows from which bodies stand, and is kept while these are the same.
        scene, standing = self._scene, self._scene.standing_bodies
        if standing != self._standing:
            planes = np.flatnonzero(np.isin(self._body_of, np.array(standing, np.int64)))
            self._rows = (planes, *scene.plane_table.triangles_of(planes + scene.first_moving_plane))
            self._standing = standing
        planes, triangles, sizes = self._rows
        normal = scene.plane_table.normal[planes + scene.first_moving_plane]
        flat = np.einsum("fc,fc->f", normal, normal) > 0
        if not flat.all():
            kept = np.flatnonzero(flat)
            triangles = triangles[ranges(np.cumsum(sizes)[kept] - sizes[kept], sizes[kept])[1]]
            planes, sizes, normal = planes[kept], sizes[kept], normal[kept]
        faces = FaceRectangles.of(
            planes + scene.first_moving_plane,
            scene.corners(triangles) - scene.centre,
            sizes,
            3 * (np.cumsum(sizes) - sizes) + self._along[planes],
            normal,
            self._two_sided[planes],
        )
        counts = np.bincount(self._body_of[planes])
        return faces, counts[counts > 0]


def _faces_of(scene: SionnaScene, planes: Int64Array) -> FaceRectangles:
    """Faces of planes of scenery."""
    table = scene.plane_table
    triangles, sizes = table.triangles_of(planes)
    own = np.repeat(np.arange(len(planes)), sizes)
    used = (table.normal[planes] != 0).any(1)[own]
    corners = scene.corners(triangles[used]) - scene.centre
    sizes = np.bincount(own[used], minlength=len(planes))
    kept = np.flatnonzero(sizes)
    # Scenery has faces of either sense, so their order of corners says nothing.
    both = np.ones(len(kept), np.bool_)
    sizes = sizes[kept]
    along = narrowest_sides(corners, sizes)
    return FaceRectangles.of(planes[kept], corners, sizes, along, table.normal[planes[kept]], both)


# [m] off its plane that a ray starts, so that it does not meet the plane.
_OFF_PLANE = 1e-3

# Rays that are cast together, so that memory is bounded.
_PART = 1_000_000


def visible_pairs(look: Faces, faces: FaceRectangles, rays: int, seed: int) -> Int64Array:
    """Pairs of planes that see one another, found by rays in random directions from random points.

    Args:
        look: Casts the rays; no moving body should be in the scene.
        faces: Faces of the planes.
        rays: Rays from each face.
        seed: Seed of points and directions.

    Returns:
        Both planes of each pair, in both orders, sorted, Shape ``[M, 2]``.
    """
    rng = np.random.default_rng(seed)
    at_once = max(1, _PART // rays)
    found = [np.zeros((0, 2), np.int64)]
    for begin in range(0, len(faces), at_once):
        some = np.arange(begin, min(begin + at_once, len(faces)))
        face = np.repeat(some, rays)
        start = _points(faces.take(some), rays, rng)
        direction = rng.standard_normal((len(face), 3))
        direction /= np.sqrt((direction**2).sum(1))[:, None]
        # A ray leaves on the side of its plane that it points to.
        off = np.sign((direction * faces.normal[face]).sum(1))[:, None] * faces.normal[face] * _OFF_PLANE
        behind, plane = look.nearest(start + off, start + off + direction)
        hit = np.isfinite(behind)
        found.append(np.unique(np.column_stack([faces.plane[face], plane])[hit], axis=0))
    pairs = np.concatenate(found)
    pairs = pairs[np.isin(pairs[:, 1], faces.plane) & (pairs[:, 0] != pairs[:, 1])]
    return np.unique(np.concatenate([pairs, pairs[:, ::-1]]), axis=0)


def seen_planes(look: Faces, points: Float64Array, planes: Int64Array, rays: int) -> BoolArray:
    """Planes that points see: those that rays in all directions meet first.

    Args:
        look: Casts the rays.
        points: Positions [m], Shape ``[R, 3]``.
        planes: Planes that are asked about, ascending, Shape ``[U]``.
        rays: Rays from each point.

    Returns:
        Whether each point sees each plane, Shape ``[R, U]``.
    """
    seen = np.zeros((len(points), len(planes) + 1), np.bool_)
    start = np.repeat(points, rays, axis=0)
    behind, plane = look.nearest(start, start + np.tile(_directions(rays), (len(points), 1)))
    # By a table: bisection of so many rays among a thousand planes takes longer than the rays.
    place = np.full(max(plane.max(initial=0), planes.max(initial=0)) + 1, len(planes))
    place[planes] = np.arange(len(planes))
    met = np.where(np.isfinite(behind), place[plane], len(planes))
    seen[np.repeat(np.arange(len(points)), rays), met] = True
    return seen[:, :-1]


@lru_cache(maxsize=4)
def _directions(rays: int) -> Float64Array:
    """Unit vectors that are spread evenly, on a Fibonacci lattice, Shape ``[N, 3]``."""
    number = np.arange(rays) + 0.5
    z, turn = 1 - 2 * number / rays, np.pi * (1 + math.sqrt(5.0)) * number
    flat = np.sqrt(1 - z**2)
    return np.column_stack([flat * np.cos(turn), flat * np.sin(turn), z])


def _points(faces: FaceRectangles, count: int, rng: np.random.Generator) -> Float64Array:
    """Random points of each face [m], uniform over its triangles, face after face."""
    corners = faces.triangles
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.abs(one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0])
    ends = np.cumsum(area)
    last = np.cumsum(faces.sizes) - 1
    begin, whole = ends[last] - np.add.reduceat(area, last + 1 - faces.sizes), ends[last]
    drawn = begin[:, None] + rng.random((len(faces), count)) * (whole - begin)[:, None]
    triangle = np.clip(np.searchsorted(ends, drawn), (last + 1 - faces.sizes)[:, None], last[:, None])
    triangle = triangle.ravel()
    weights = rng.random((len(triangle), 2))
    weights = np.where((weights.sum(1) > 1)[:, None], 1 - weights, weights)
    flat = corners[triangle, 0] + weights[:, :1] * one[triangle] + weights[:, 1:] * other[triangle]
    face = np.repeat(np.arange(len(faces)), count)
    points: Float64Array = faces.centre[face] + np.einsum("na,nac->nc", flat, faces.axes[face])
    return points


MOST_CHAINS = 20_000
"""Largest number of sequences that are enumerated."""


def chain_targets(faces: FaceRectangles, sights: Int64Array, depth: int) -> Targets | None:
    """Targets of beams along sequences of faces, of which each sees the next one.

    Args:
        faces: Of scenery, in ascending order of their planes.
        sights: Pairs of planes that see one another, in both orders, sorted, Shape ``[M, 2]``.
        depth: Faces of a sequence at most.

    Returns:
        The targets; None where there are more sequences than `MOST_CHAINS`.
    """
    seen = np.searchsorted(faces.plane, sights)
    # Sequences that end at each face; their number grows with a power of the faces that each one sees.
    ends, count = np.ones(len(faces)), 0.0
    for _ in range(depth):
        count += ends.sum()
        ends = np.bincount(seen[:, 1], ends[seen[:, 0]], len(faces)).astype(np.float64)
    return Targets(faces, np.zeros(0, np.int64), seen) if count <= MOST_CHAINS else None


def lit_chains(targets: Targets, source: Float64Array, seen: BoolArray, depth: int) -> Int32Array:
    """Sequences of faces that a source can light.

    Args:
        targets: From `chain_targets`.
        source: Position [m], Shape ``[3]``.
        seen: Faces that the source may see, Shape ``[U]``.
        depth: Faces of a sequence at most.

    Returns:
        Planes of each, −1 past the last, Shape ``[K, D]``: shorter sequences first, with the beginnings of
        each one among them.
    """
    beams = [first_beams(targets, source, np.flatnonzero(seen))]
    for _ in range(1, depth):
        shown = kernels.shown_scenery(beams[-1].rows, targets.arrays)
        beams.append(reflected_beams(targets, beams[-1], *shown.T))
    chains = ChainPairs.joined([(of.chain, np.zeros(len(of), np.int64)) for of in beams], depth).chain
    return np.where(chains >= 0, targets.faces.plane[chains], -1).astype(np.int32)


# From each plane, to find which others it sees: before the first frame, and in each.
_SIGHT_RAYS, _SIGHT_RAYS_PER_FRAME = 4096, 64

# Of a coordinate; a transmitter that is this near to where it was prepared has not moved: worlds in other
# languages may send its position in single precision.
_ROUNDING = float(np.finfo(np.float32).eps)

# Of a transmitter that moves, to find the faces that may come first: 2.2° apart.
_SEEN_RAYS = 8192

# Faces of scenery of which all sequences are taken.
_FEW = 64


@dataclass(frozen=True, kw_only=True)
class SceneryLaunch:
    """Launches that look for chains of scenery."""

    samples: int
    """Rays of a launch."""
    launches: int
    """Number of launches, each turned a little against the others."""


@dataclass(frozen=True, eq=False)
class KnownScenery:
    """Scenery as it is known from the place of a transmitter."""

    chains: Int32Array
    """Planes that reflect waves from there in turn, −1 past the last, Shape ``[K, D]``."""
    sights: Int32Array
    """Pairs of these planes that see one another, in both orders, Shape ``[M, 2]``."""


class SceneryChains:
    """Chains of scenery of all transmitters: of those that stand, launched once with many rays; of others,
    all that there can be, or where these are too many, launched in each frame.

    Made while no body is in the scene.

    Args:
        scene, options: What is traced in, and the depth and the seed of what is wanted.
        launch: From where a transmitter stands.
        per_frame: Rays from one that moves.
        moving: Whether any moves: all chains that there can be are looked for only then.
        cache: Where chains are kept between runs; None: nowhere.
        before: Of the same scenery among other bodies, whose chains hold; None: there are none.
    """

    def __init__(
        self,
        scene: SionnaScene,
        options: LaunchOptions,
        launch: SceneryLaunch,
        per_frame: int,
        moving: bool,
        cache: ChainCache | None,
        before: SceneryChains | None = None,
    ) -> None:
        self._scene, self._options, self._launch, self._cache = scene, options, launch, cache
        self._launcher = PartedLauncher(scene, only_reflected(options, per_frame))
        self._look = Faces(scene, still=True)
        self._faces = SceneFaces(scene)
        # By the name of a transmitter that stands: its place in the world [m], and what is known from there.
        # Each has its own: however near to another one it stands, a wall may be between them.
        self._known: dict[str, tuple[Float64Array, KnownScenery]] = {}
        if before is not None:
            self._known.update(before._known)
        # All chains, and which planes see one another; None: too many, or no transmitter moves.
        self._every: tuple[Targets, Int32Array] | None = (
            before._every if before is not None else self._every_chain() if moving else None
        )
        self._last: tuple[bytes, int, KnownScenery] | None = None

    def prepare(self, name: str, transmitter: Float64Array, progress: Callable[[str], None]) -> str:
        """Find the chains from where a transmitter stands, while no body is in the scene.

        Args:
            name: Of the transmitter.
            transmitter: Its position in the world [m], Shape ``[3]``.
            progress: Called with what is done, before each part of it.

        Returns:
            A note for the user on what was found.
        """
        if not self._scene.has_scenery:
            return "there is no scenery"
        place = transmitter - self._scene.centre
        key = self._key(place)
        widths = (self._options.max_depth, 2)
        known = self._cache.load(key, widths) if self._cache else None
        source = "of the cache"
        if known is None:
            with self._cache.launching(key, progress) if self._cache else nullcontext(progress) as tell:
                known = self._cache.load(key, widths) if self._cache else None
                if known is None:
                    parts = _Parts(f"launching scenery rays from {name!r}", tell)
                    chains = launched_chains(self._scene, self._options, self._launch, place, parts)
                    known = chains, self._sights(chains, _SIGHT_RAYS)
                    source = f"of {self._launch.launches} launches of {self._launch.samples} rays"
                    if self._cache:
                        self._cache.save(key, known)
        chains, sights = known
        self._known[name] = transmitter, KnownScenery(chains, sights)
        return f"{len(chains)} chains of scenery {source}"

    def known_from(self, name: str, transmitter: Float64Array) -> KnownScenery:
        """Chains and sights of scenery that are known from a transmitter, in the scene as it stands.

        Args:
            name: Of the transmitter.
            transmitter: Its position in the world [m], Shape ``[3]``.
        """
        # What one launch of many rays has found holds as long as the transmitter stands there.
        if name in self._known:
            known, scenery = self._known[name]
            if np.all(np.abs(known - transmitter) <= _ROUNDING * np.abs(known)):
                return scenery
        place = transmitter - self._scene.centre
        # Kept while neither the transmitter nor the scene has moved.
        last = self._last
        if last is None or last[:2] != (place.tobytes(), self._scene.version):
            last = self._last = place.tobytes(), self._scene.version, self._now(place)
        return last[2]

    def _now(self, place: Float64Array) -> KnownScenery:
        """Scenery as the frame shows it from a place in the ray tracer's coordinates [m], Shape ``[3]``."""
        if not self._scene.has_scenery:
            return KnownScenery(np.zeros((0, self._options.max_depth), np.int32), np.zeros((0, 2), np.int32))
        if self._every is None:
            chains = self._launched(place)
            return KnownScenery(chains, self._sights(chains, _SIGHT_RAYS_PER_FRAME))
        targets, sights = self._every
        seen = seen_planes(self._look, place[None], targets.faces.plane, _SEEN_RAYS)[0]
        return KnownScenery(lit_chains(targets, place, seen, self._options.max_depth), sights)

    def _every_chain(self) -> tuple[Targets, Int32Array] | None:
        faces = self._faces.scenery(np.arange(self._scene.first_moving_plane))
        if not 0 < len(faces) <= _FEW:
            return None
        sights = visible_pairs(self._look, faces, _SIGHT_RAYS, self._options.seed)
        targets = chain_targets(faces, sights, self._options.max_depth)
        return None if targets is None else (targets, sights.astype(np.int32))

    def _launched(self, place: Float64Array) -> Int32Array:
        """Chains that one launch finds from a place in the ray tracer's coordinates [m], Shape ``[3]``."""

        def look(_: Int64Array, launch: Launch) -> Int32Array:
            return scenery_of(launch, self._scene, self._options.max_depth)

        return reduce(united, self._launcher.each(look, positions(place[None])))

    def _sights(self, chains: Int32Array, rays: int) -> Int32Array:
        """Pairs of planes of chains that see one another, found with so many rays from each."""
        faces = self._faces.scenery(chains[chains >= 0].astype(np.int64))
        return visible_pairs(self._look, faces, rays, self._options.seed).astype(np.int32)

    def _key(self, place: Float64Array) -> str:
        import sionna.rt

        options = (self._options.max_depth, self._options.seed, *astuple(self._launch), sionna.rt.__version__)
        return cache_key(self._scene.scenery_digest, place.tobytes(), repr(options).encode())


class _Parts:
    """Tells before each part of a launch how many there are, and after the first how long they will take."""

    def __init__(self, what: str, tell: Callable[[str], None]) -> None:
        self._what, self._tell, self._began = what, tell, time.monotonic()

    def __call__(self, part: int, parts: int) -> None:
        left = f", {(time.monotonic() - self._began) * (parts / part - 1):.0f} s left" if part else ""
        self._tell(f"{self._what}, {part + 1} of {parts}{left}")


def launched_chains(
    scene: SionnaScene,
    options: LaunchOptions,
    launch: SceneryLaunch,
    transmitter: Float64Array,
    progress: Callable[[int, int], None],
) -> Int32Array:
    """Find the chains of scenery that rays from a place go along.

    Args:
        scene: Without bodies.
        options: Of the paths that are wanted: depth and seed; only reflections are looked for.
        launch: Rays and launches.
        transmitter: Position in the ray tracer's coordinates [m], Shape ``[3]``.
        progress: Called before each part with its number and the count of parts.

    Returns:
        Planes of all chains, −1 past the last, Shape ``[K, D]``: shorter ones first, with the beginnings of
        each one among them.
    """
    reflected = only_reflected(options, launch.samples)
    source = positions(transmitter[None])
    part = options.rays_at_once
    parts = -(-launch.samples // part)
    found = np.full((0, options.max_depth), -1, np.int32)
    # Parts outside, launches inside: a part has rays of its own, and each launch turns them, so that memory
    # holds one part at a time.
    for index in range(parts):
        rays = (index * part, min((index + 1) * part, launch.samples))
        launcher = Launcher(scene, reflected, rays)
        for number in range(launch.launches):
            progress(index * launch.launches + number, parts * launch.launches)
            chains = scenery_of(launcher(source, number=number), scene, options.max_depth)
            found = united(found, chains)
    return found


def only_reflected(options: LaunchOptions, samples: int) -> LaunchOptions:
    """Options of a launch that looks for chains of reflections with so many rays."""
    return replace(
        options, samples=samples, reflection=True, refraction=False, diffraction=False, scattering=False
    )


def scenery_of(launch: Launch, scene: SionnaScene, depth: int) -> Int32Array:
    """Chains of a launch that planes of scenery alone reflect, sorted as in `launched_chains`."""
    chains = chains_of(launch, scene, depth)
    some = chains.straight & ((chains.planes >= 0).sum(1) == chains.depth)
    some &= (chains.planes < scene.first_moving_plane).all(1)
    return united(np.full((0, depth), -1, np.int32), chains.planes[some])


def united(one: Int32Array, other: Int32Array) -> Int32Array:
    """The chains of both, each once, sorted by their number of planes and by these."""
    chains = np.unique(np.concatenate([one, other]), axis=0)
    order: Int64Array = np.lexsort((*chains.T[::-1], (chains >= 0).sum(1)))
    return chains[order]


_FORMAT: Literal["caviar-chains-1"] = "caviar-chains-1"
# [s] between looks at whether another process has launched, and for how long it is waited for: it may be
# stopped. [B] of the file by which it tells what it does.
_LOOK_S, _PATIENCE_S = 0.2, 600.0
_TOLD_B = 200


class _ChainFile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Content of a file of the cache."""

    format: Literal["caviar-chains-1"]
    key: str
    tables: tuple[Packed, ...]
    """Of planes by number."""
    digest: bytes
    """Of the tables' bytes."""


class ChainCache:
    """Cache of chains in the files of a folder.

    Args:
        folder: Made when the first file is written; several processes may use it at once.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     cache = ChainCache(Path(folder))
        ...     cache.save("a1", (np.array([[3, -1]], np.int32),))
        ...     [table.tolist() for table in cache.load("a1", (2,))], cache.load("b2", (2,))
        ([[[3, -1]]], None)
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.notes: list[str] = []
        """What could not be read or written, and why."""

    def load(self, key: str, widths: tuple[int, ...]) -> tuple[Int32Array, ...] | None:
        """Read the tables of a key.

        Args:
            key: From `cache_key`.
            widths: Of the rows of each table.

        Returns:
            The tables; None where there is no file, or a damaged one, which a note tells of.
        """
        path = self._folder / key
        try:
            data = read_regular(path, "it is replaced")
        except FileNotFoundError:
            return None
        except OSError as error:
            self.notes.append(
                f"{WARNING}{path} cannot be read ({error.strerror}); its chains are launched again"
            )
            return None
        try:
            file = msgspec.msgpack.decode(data, type=_ChainFile)
            tables: tuple[Int32Array, ...] = tuple([table.array(np.int32) for table in file.tables])
            intact = file.key == key and file.digest == _digest(file.tables)
        # Whatever is wrong with a file, launching again is right: its name says what its content has to be.
        except (msgspec.MsgspecError, UnicodeDecodeError, ValueError):
            intact = False
        if intact and [table.shape[1:] for table in tables] == [(width,) for width in widths]:
            return tables
        self.notes.append(f"{WARNING}{path} is damaged; its chains are launched again")
        return None

    @contextmanager
    def launching(self, key: str, progress: Callable[[str], None]) -> Iterator[Callable[[str], None]]:
        """A block in which no other process of this machine is with the same key, so that workers of a
        dataset, which begin at once, launch the chains once.

        Args:
            key: From `cache_key`.
            progress: Called with the phase of the process that holds the lock, while this one waits for it,
                for `_PATIENCE_S` at most.

        Yields:
            Function that takes each phase of this process: it calls ``progress``, and writes the phase to the
            lock's file, from where processes that wait read it.
        """
        path, until = self._folder / f"{key}.lock", time.monotonic() + _PATIENCE_S
        lock = -1

        def tell(text: str) -> None:
            with suppress(OSError):
                os.pwrite(lock, text.encode().ljust(_TOLD_B), 0)
            progress(text)

        with ExitStack() as stack:
            # Without a lock each launches for itself; `save` says what is wrong with the folder.
            with suppress(OSError):
                self._folder.mkdir(parents=True, exist_ok=True)
                lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NONBLOCK | os.O_CLOEXEC)
                stack.callback(os.close, lock)  # which unlocks it, as the end of the process does
                while not _locked(lock) and time.monotonic() < until:
                    told = os.pread(lock, _TOLD_B, 0).decode(errors="replace")
                    progress(f"{told.strip() or 'launching scenery rays'}, in another process")
                    time.sleep(_LOOK_S)
                stack.callback(path.unlink, missing_ok=True)
            yield tell

    def save(self, key: str, tables: tuple[Int32Array, ...]) -> None:
        """Write the tables of a key; where that fails, a note says so."""
        packed = tuple([Packed.pack(table, "<i4") for table in tables])
        file = _ChainFile(format=_FORMAT, key=key, tables=packed, digest=_digest(packed))
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            replace_file(self._folder / key, msgspec.msgpack.encode(file), durable=False)
        except OSError as error:
            self.notes.append(
                f"{WARNING}chains cannot be kept in {self._folder} ({error.strerror}); the next run "
                "launches them again, unless XDG_CACHE_HOME names a folder that can be written"
            )


def _locked(file: int) -> bool:
    """Lock an open file; whether no other process holds it."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def cache_key(*parts: bytes) -> str:
    """Name of a file: the digest of everything that its chains follow from."""
    digest = hashlib.blake2b(digest_size=20)
    for part in (_FORMAT.encode(), *parts):
        # With lengths: else two parts could be divided in another place and have the same digest.
        digest.update(len(part).to_bytes(8, "little"))
        digest.update(part)
    return digest.hexdigest()


def _digest(tables: tuple[Packed, ...]) -> bytes:
    return hashlib.blake2b(b"".join([table.data for table in tables]), digest_size=16).digest()
