"""Foliage as lossy volumes: Recommendation ITU-R P.833-10, attenuation in vegetation.

Waves pass through foliage on straight lines and lose A = A_m·(1 − exp(−γ·d/A_m)) [dB] (section 2.1, eq. 1),
with the length d within it [m], the specific attenuation γ [dB/m] for very short paths, and the maximum
attenuation A_m [dB] of what arrives by other ways than straight through. Without a maximum that is γ·d.
Amplitudes fall by 10^(−A/20), phases and directions stay.

The length d is that of a straight line within closed meshes (`MeshVolumes`), in float64. A point is inside
where the surfaces around it wind about it: a line that enters as often as it leaves is outside (winding
number, here of the crossings before a point). So surfaces may overlap and enclose cavities. A line through an
edge or a corner crosses what a line infinitesimally beside it crosses (H. Edelsbrunner and E. P. Mücke,
"Simulation of simplicity", ACM Trans. Graph. 9(1), 1990).
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import msgspec
import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array, UInt8Array, quantity
from caviar_protocol.errors import AssetError, suggestion
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.space.scene import object_pose
from caviar_protocol.topics import Carrier, Scene
from caviar_services.channel.paths import Attenuation, path_corners
from caviar_services.channel.sionna.materials import ObjectMaterials
from caviar_space.meshes import Mesh, placed, unit_box
from caviar_space.vectors import ranges

# Boxes in a box of the next level, and triangles in one of the first.
_BRANCHES = 8

# By which boxes are wider, relative to the largest coordinate and 1 m.
_SLACK = 1e-9

# Pairs of a line and a box or triangle that are looked at together: what stays in a processor's cache.
_AT_ONCE = 1 << 16


def outward(mesh: Mesh) -> Float64Array:
    """Triangles of a closed mesh, all with their outside in front.

    Args:
        mesh: Corners at exactly one place count as one.

    Returns:
        Corners [m], counter-clockwise as seen from outside, Shape ``[F, 3, 3]``.

    Raises:
        ValueError: Edges are open, or have both triangles on one side; says how many.

    Example:
        >>> corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
        >>> crown = Mesh(corners, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32))
        >>> outward(crown).shape
        (4, 3, 3)
    """
    _, place = np.unique(mesh.vertices, axis=0, return_inverse=True)
    corners = place.reshape(-1)[mesh.faces]
    sides = np.stack([corners, np.roll(corners, -1, axis=1)], axis=-1).reshape(-1, 2)
    sides = sides[sides[:, 0] != sides[:, 1]]
    edges, edge, count = np.unique(np.sort(sides, axis=1), axis=0, return_inverse=True, return_counts=True)
    # Two triangles with the same outside run along their common edge in opposite directions.
    ways = np.bincount(edge.reshape(-1), np.where(sides[:, 0] < sides[:, 1], 1, -1), minlength=len(edges))
    is_open = np.count_nonzero(count % 2)
    if is_open or not len(edges):
        raise ValueError(f"{is_open} of its {len(edges)} edges are open")
    if ways.any():
        turned = np.count_nonzero(ways)
        raise ValueError(f"at {turned} of its {len(edges)} edges one triangle faces out and the other in")
    triangles: Float64Array = mesh.vertices[mesh.faces]
    # Six times the volume, relative to a corner: at UTM coordinates the digits would be lost.
    a, b, c = np.moveaxis(triangles - triangles[0, 0], 1, 0)
    volume = float((np.cross(a, b) * c).sum())
    return triangles[:, ::-1] if volume < 0 else triangles


@dataclass(frozen=True, eq=False)
class MeshVolumes:
    """Volumes within closed surfaces of F triangles, each of one of some kinds."""

    triangles: Float64Array
    """Corners [m], Shape ``[F, 3, 3]``, neighbours near to each other."""
    kind: Int64Array
    """What the volume is of that each is around, Shape ``[F]``."""

    @classmethod
    def of(cls, surfaces: Sequence[tuple[Float64Array, int]]) -> MeshVolumes:
        """Volumes within surfaces.

        Args:
            surfaces: Triangles of each (`outward`), and the kind of its volume.
        """
        triangles = np.concatenate([np.zeros((0, 3, 3)), *(corners for corners, _ in surfaces)])
        kind = np.repeat(
            np.array([kind for _, kind in surfaces], np.int64), [len(corners) for corners, _ in surfaces]
        )
        order = _near_each_other(triangles.mean(1))
        return cls(triangles[order], kind[order])

    @cached_property
    def _boxes(self) -> list[tuple[Float64Array, Float64Array]]:
        """Lowest and highest corners of boxes, Shape ``[3, N]`` each, level by level: around triangles,
        around `_BRANCHES` of these, and so on up to one box, each a little wider than what it holds."""
        slack = _SLACK * (1 + np.abs(self.triangles).max())
        low, high = self.triangles.min(1).T - slack, self.triangles.max(1).T + slack
        levels = [(np.ascontiguousarray(low), np.ascontiguousarray(high))]
        while low.shape[1] > 1:
            first = np.arange(0, low.shape[1], _BRANCHES)
            low, high = np.minimum.reduceat(low, first, axis=1), np.maximum.reduceat(high, first, axis=1)
            levels.append((low, high))
        return levels

    def crossings(
        self, start: Float64Array, direction: Float64Array
    ) -> Iterator[tuple[Int64Array, Int64Array, Float64Array, Int64Array]]:
        """Where lines enter and leave volumes.

        Args:
            start: A point of each of Q lines [m], Shape ``[Q, 3]``.
            direction: Along each line [m], Shape ``[Q, 3]``.

        Yields:
            For some lines at a time: line, kind, multiple of the direction, and 1 for entering or −1 for
            leaving, Shape ``[N]`` each. Left out are lines that miss all volumes from 0 to 1 or are not
            finite, and some crossings beyond 1.
        """
        if not len(self.kind):
            return
        lines = np.flatnonzero((direction != 0).any(1) & np.isfinite(start + direction).all(1))
        with np.errstate(divide="ignore"):
            slabs = np.ascontiguousarray(start.T), 1 / np.ascontiguousarray(direction.T)
        root = np.zeros(len(lines), np.int64)
        met = _meets(slabs, lines, self._boxes[-1], root, (0.0, 1.0))
        # Depth first, and large levels in halves, so that few pairs of lines and boxes exist at a time.
        pending = [(len(self._boxes) - 1, lines[met], root[met])]
        while pending:
            level, lines, boxes = pending.pop()
            if len(lines) > _AT_ONCE:
                half = len(lines) // 2
                pending += [(level, lines[:half], boxes[:half]), (level, lines[half:], boxes[half:])]
            elif level:
                below = self._boxes[level - 1]
                sizes = np.minimum(_BRANCHES, below[0].shape[1] - boxes * _BRANCHES)
                parent, boxes = ranges(boxes * _BRANCHES, sizes)
                lines = lines[parent]
                met = _meets(slabs, lines, below, boxes, (-np.inf, 1.0))
                pending.append((level - 1, lines[met], boxes[met]))
            elif len(lines):
                crossed, along, step = _crossed(start[lines], direction[lines], self.triangles[boxes])
                yield lines[crossed], self.kind[boxes[crossed]], along, step


def lengths_inside(
    volumes: Sequence[MeshVolumes], start: Float64Array, end: Float64Array, kinds: int
) -> Float64Array:
    """Lengths of segments within the union of all volumes of each kind.

    Args:
        volumes: Of all kinds, numbered from 0.
        start: Start of each of Q segments [m], Shape ``[Q, 3]``; ``end`` likewise.
        end: See ``start``.
        kinds: Number of kinds, K.

    Returns:
        Lengths [m], Shape ``[Q, K]``.

    Example:
        >>> from caviar_space.meshes import box
        >>> crown = MeshVolumes.of([(outward(box((0, 2), (0, 2), (0, 2))), 0)])
        >>> start, end = np.array([[-1.0, 1.0, 1.5]]), np.array([[1.5, 1.0, 1.5]])
        >>> lengths_inside([crown], start, end, kinds=1).tolist()
        [[1.5]]
    """
    direction = end - start
    found = [crossed for of in volumes for crossed in of.crossings(start, direction)]
    if not found:
        return np.zeros((len(start), kinds))
    line, kind, along, step = (np.concatenate(parts) for parts in zip(*found, strict=True))
    # Along each line and kind, the running sum of +1 and −1 is the winding number after each crossing.
    pair, along = line * kinds + kind, np.clip(along, 0.0, 1.0)
    order = np.lexsort((step, along, pair))
    pair, along, around = pair[order], along[order], np.cumsum(step[order])
    first = np.diff(pair, prepend=-1) != 0
    around -= np.repeat((around - step[order])[first], np.diff(np.flatnonzero(first), append=len(pair)))
    # Up to the next crossing, or to the end: crossings beyond are not all known.
    until = np.where(np.append(first[1:], True), 1.0, np.append(along[1:], 1.0))
    gaps = np.where(around != 0, until - along, 0.0)
    share = np.bincount(pair, gaps, minlength=len(start) * kinds).reshape(len(start), kinds)
    inside: Float64Array = share * np.sqrt((direction**2).sum(1, keepdims=True))
    return inside


def _near_each_other(points: Float64Array) -> Int64Array:
    """An order of points, Shape ``[N, 3]``, in which neighbours are near: Morton's, of 10 bits an axis."""
    if not len(points):
        return np.zeros(0, np.int64)
    low, size = points.min(0), np.ptp(points, axis=0).max()
    cells = ((points - low) / (size or 1.0) * 1023).astype(np.int64)
    bits = (cells[..., None] >> np.arange(10)) & 1
    code = (bits << (3 * np.arange(10) + np.arange(3)[:, None])).sum((1, 2))
    return np.argsort(code, kind="stable")


def _meets(
    slabs: tuple[Float64Array, Float64Array],
    lines: Int64Array,
    corners: tuple[Float64Array, Float64Array],
    boxes: Int64Array,
    between: tuple[float, float],
) -> BoolArray:
    """Whether lines touch boxes between two multiples of their directions, pair by pair, Shape ``[N]``.

    By slabs (T. L. Kay and J. T. Kajiya, "Ray tracing complex scenes", SIGGRAPH 1986).

    Args:
        slabs: Start and inverse of the direction of all lines, Shape ``[3, Q]`` each.
        lines, boxes: Number of the line and of the box, Shape ``[N]``.
        corners: Lowest and highest of all boxes, Shape ``[3, M]`` each.
    """
    near, far = np.full(len(lines), between[0]), np.full(len(lines), between[1])
    with np.errstate(invalid="ignore"):
        for start, inverse, low, high in zip(*slabs, *corners, strict=True):
            at, along = start[lines], inverse[lines]
            one, other = (low[boxes] - at) * along, (high[boxes] - at) * along
            np.fmax(near, np.fmin(one, other), out=near)
            np.fmin(far, np.fmax(one, other), out=far)
    met: BoolArray = near <= far
    return met


def _crossed(
    origin: Float64Array, direction: Float64Array, triangles: Float64Array
) -> tuple[Int64Array, Float64Array, Int64Array]:
    """Which of N triangles, Shape ``[N, 3, 3]``, lines meet, at what multiple of the direction, and whether
    they enter there, 1, or leave, −1.

    In axes in which the line is the third one (S. Woop, C. Benthin and I. Wald, "Watertight ray/triangle
    intersection", JCGT 2(1), 2013): the sign of the product of two corners is opposite for the two triangles
    at an edge, and right or zero.
    """
    # The longest component of the direction becomes the third axis, so that the shear is well conditioned.
    axis = np.argmax(np.abs(direction), axis=1)
    axes = (axis[:, None] + np.array([1, 2, 0])) % 3
    towards = np.take_along_axis(direction, axes, axis=1)
    corners = np.take_along_axis(triangles - origin[:, None], axes[:, None], axis=2)
    x = corners[..., 0] - towards[:, :1] / towards[:, 2:] * corners[..., 2]
    y = corners[..., 1] - towards[:, 1:2] / towards[:, 2:] * corners[..., 2]
    x_next, y_next = np.roll(x, -1, axis=1), np.roll(y, -1, axis=1)
    product = x * y_next - y * x_next
    # On an edge, the line counts as a little beside it, by ε along x and by ε² along y.
    beside = np.where(y != y_next, y - y_next, x_next - x)
    side = np.sign(np.where(product == 0, beside, product))
    met = np.flatnonzero((side[:, 0] != 0) & (side == side[:, :1]).all(1))
    weight = np.roll(product[met], -1, axis=1)
    depth = (weight * corners[met, :, 2]).sum(1) / weight.sum(1)
    step = -side[met, 0] * np.sign(towards[met, 2])
    return met, depth / towards[met, 2], step.astype(np.int64)


# Mixed coniferous and deciduous woodland near St Petersburg (P.833-10, table 1): frequency [MHz], γ [dB/m]
# and A_m [dB].
_TABLE_1 = np.array(
    [
        (105.9, 0.04, 9.4),
        (466.475, 0.12, 18.0),
        (949.0, 0.17, 26.5),
        (1852.2, 0.30, 29.0),
        (2117.5, 0.34, 34.1),
    ]
)

_SOURCE = "ITU-R P.833-10, table 1"

_REMEDY = (
    'attenuation_db_per_m = {{ {carrier} = … }} and source = "…"; figure 2 of the Recommendation has values '
    "up to about 30 GHz"
)


class FoliageSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How much one kind of foliage attenuates."""

    attenuation_db_per_m: dict[
        str, Annotated[float, quantity("dB/m", "specific attenuation γ on a carrier", ge=0)]
    ] = {}
    """By name of the carrier. Absent: that of ITU-R P.833's table 1, from 105.9 to 2117.5 MHz."""
    maximum_db: dict[
        str, Annotated[float, quantity("dB", "attenuation A_m at most, on a carrier", gt=0)]
    ] = {}
    """By name of the carrier. Absent: none where γ is given, that of table 1 where it is not."""
    source: str = ""
    """Where values that are given are from; products state it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FoliageKind:
    """One kind of foliage, on C carriers."""

    key: str
    """Name, pattern of names or class of what is of it."""
    attenuation_db_per_m: Float64Array
    """γ [dB/m], Shape ``[C]``."""
    maximum_db: Float64Array
    """A_m [dB], Shape ``[C]``; infinite: none."""
    source: tuple[str, ...]
    """Of the values, by carrier."""

    def attenuation_db(self, length: Float64Array) -> Float64Array:
        """Attenuation A [dB], Shape ``[C, P]``, of paths of these lengths within it [m], Shape ``[P]``
        (P.833-10, eq. 1)."""
        straight: Float64Array = self.attenuation_db_per_m[:, None] * length
        most = np.where(np.isfinite(self.maximum_db), self.maximum_db, 1.0)[:, None]
        # `expm1`: for short ways 1 − exp(…) would lose its digits.
        saturating = -most * np.expm1(-straight / most)
        return np.where(np.isfinite(self.maximum_db)[:, None], saturating, straight)

    def briefs(self, carriers: Sequence[Carrier]) -> tuple[str, ...]:
        """Lines that products state about it, carrier by carrier."""
        return tuple(
            f"{self.key}@{carrier.name}: {gamma:g} dB/m"
            + (f", at most {most:g} dB" if np.isfinite(most) else "")
            + f" ({source})"
            for carrier, gamma, most, source in zip(
                carriers, self.attenuation_db_per_m, self.maximum_db, self.source, strict=True
            )
        )


class Foliage(Attenuation):
    """The foliage of a scene, and the attenuation of paths in it.

    The volume of a piece of scenery is within its mesh, that of an object is its bounding box. A path loses,
    to each kind, A of the length that all of its legs run within the union of all volumes of this kind.

    Args:
        settings: By name of an object or a piece of scenery, pattern of names with ``*``, or class of
            objects.
        carriers: Of the run.
        place: Where the settings of the channel stand.
        others: Settings of the channel that say something else of objects, with their keys.

    Raises `ScenarioError` naming the key where γ or its source is not given, a carrier does not exist, or
    another setting has the same key.
    """

    def __init__(
        self,
        settings: Mapping[str, FoliageSettings],
        carriers: Sequence[Carrier],
        place: Place,
        others: Mapping[str, Collection[str]],
    ) -> None:
        self.kinds = tuple(
            _kind(key, of, carriers, place.at("foliage").at(key), others) for key, of in settings.items()
        )
        self.keys = ObjectMaterials({key: key for key in settings})
        """Tells the kind of an object."""
        self.briefs = tuple(brief for kind in self.kinds for brief in kind.briefs(carriers))
        """What products state of them, kind by kind and carrier by carrier."""
        self._number = {kind.key: number for number, kind in enumerate(self.kinds)}
        self._box = unit_box()
        self._still = self._moving = MeshVolumes.of([])

    def stand(self, pieces: Mapping[str, Mesh]) -> None:
        """Take pieces of scenery for foliage.

        Args:
            pieces: Meshes by name; a name has the kind that the settings give it.

        Raises:
            AssetError: A mesh is not closed.
        """
        surfaces = []
        for name, mesh in pieces.items():
            try:
                surfaces.append((outward(mesh), self._number[self.keys.of(name)]))
            except ValueError as error:
                raise AssetError(
                    f"piece of scenery {name!r} is foliage and has no inside: {error}; give it a closed "
                    "mesh, such as the hull of a crown, and single leaves another name"
                ) from error
        self._still = MeshVolumes.of(surfaces)

    def move(self, scene: Scene) -> None:
        """Move the foliage among the objects of a scene to where they are."""
        boxes = [
            (placed(self._box, scene.dimensions[i], object_pose(scene, i))[self._box.faces], kind)
            for i, (name, cls) in enumerate(zip(scene.names, scene.classes, strict=True))
            if (kind := self._number.get(self.keys.of(name, cls))) is not None
        ]
        self._moving = MeshVolumes.of(boxes)

    def amplitude_factor(
        self, start: Float64Array, points: Float64Array, end: Float64Array, types: UInt8Array
    ) -> Float64Array:
        """Factors by foliage, 10^(−A/20), Shape ``[C, P]``; see `Attenuation`."""
        corners = path_corners(start, points, end, (types != 0).sum(1))
        paths, legs = len(corners), corners.shape[1] - 1
        ends = corners[:, :-1].reshape(-1, 3), corners[:, 1:].reshape(-1, 3)
        inside = lengths_inside((self._still, self._moving), *ends, len(self.kinds))
        inside = inside.reshape(paths, legs, -1).sum(1)
        lost = sum(kind.attenuation_db(inside[:, k]) for k, kind in enumerate(self.kinds))
        return 10 ** (-np.asarray(lost) / 20)


def _kind(
    key: str,
    settings: FoliageSettings,
    carriers: Sequence[Carrier],
    place: Place,
    others: Mapping[str, Collection[str]],
) -> FoliageKind:
    for name, keys in others.items():
        if key in keys:
            raise place.error(
                f"{key!r} is foliage here and stands in {name}, too; leave it out of one of them"
            )
    names = [carrier.name for carrier in carriers]
    for field in ("attenuation_db_per_m", "maximum_db"):
        given: Mapping[str, float] = getattr(settings, field)
        for name in given:
            if name not in names:
                raise place.at(field).at(name).error(f"no carrier {name!r}; {suggestion(name, names)}")
        if given and not settings.source:
            raise place.at(field).error(
                f"gives values without where they are from; write it as {place.at('source').key}"
            )
    rows = [_on_carrier(settings, carrier, place) for carrier in carriers]
    return FoliageKind(
        key=key,
        attenuation_db_per_m=np.array([gamma for gamma, _, _ in rows]),
        maximum_db=np.array([most for _, most, _ in rows]),
        source=tuple(source for _, _, source in rows),
    )


def _on_carrier(settings: FoliageSettings, carrier: Carrier, place: Place) -> tuple[float, float, str]:
    """γ [dB/m], A_m [dB] and their source on a carrier."""
    given = settings.attenuation_db_per_m.get(carrier.name)
    if given is not None:
        return given, settings.maximum_db.get(carrier.name, np.inf), settings.source
    megahertz, low, high = carrier.frequency_hz / 1e6, _TABLE_1[0, 0], _TABLE_1[-1, 0]
    if not low <= megahertz <= high:
        raise place.at("attenuation_db_per_m").error(
            f"lacks carrier {carrier.name!r} at {megahertz:g} MHz, and table 1 of ITU-R P.833 is for "
            f"{low:g}–{high:g} MHz; write {_REMEDY.format(carrier=carrier.name)}"
        )
    # Between the rows of the table, straight in logarithms of all three.
    gamma, most = (
        float(np.exp(np.interp(np.log(megahertz), np.log(_TABLE_1[:, 0]), np.log(_TABLE_1[:, column]))))
        for column in (1, 2)
    )
    if carrier.name in settings.maximum_db:
        return gamma, settings.maximum_db[carrier.name], f"{_SOURCE}, {settings.source}"
    return gamma, most, _SOURCE
