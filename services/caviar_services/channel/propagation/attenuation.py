"""Attenuation of paths beside free space and interactions: by foliage (Recommendation ITU-R P.833-10) and by
people as screens (model B of 3GPP TR 38.901).

Waves pass through foliage on straight lines and lose A = A_m·(1 − exp(−γ·d/A_m)) [dB] (section 2.1, eq. 1),
with the length d within it [m], the specific attenuation γ [dB/m] for very short paths, and the maximum
attenuation A_m [dB] of what arrives by other ways than straight through. Without a maximum that is γ·d.
Amplitudes fall by 10^(−A/20), phases and directions stay.

The length d is that of a straight line within closed meshes (`caviar_space.volumes`), in float64.

A person is a vertical rectangular screen (TR 38.901, section 7.6.4.2). A path that it stands in, or near, is
diffracted at its four edges and loses

    L = −20·log10(1 − (F_h1 + F_h2)·(F_w1 + F_w2)) [dB],
    F = ±1/π · arctan(π/2 · sqrt(π/λ · (D1 + D2 − r))).

for the upper and lower edge (h1, h2), in the top view for the others (w1, w2). All signs are + in a view in
which the screen is in the way; where it is not, the edge of the shorter way D1 + D2 has −, so that L tends
to 0 away from the screen. Losses [dB] of several screens are added.

What the report leaves open is fixed so: a screen stands across the path, as in the model of METIS (D1.4,
"METIS channel models", 2015, section 6) that the report took over, and is as wide as the person looks from
there, whose outline seen from above is an ellipse. A path with reflections is unfolded: each of its legs has
its ends at the images of TX and RX, so that the form of the direct path holds for all of them (the report has
no geometry beyond the receiver's side, and lets D2 − r fall away). Diffraction and scattering begin a new
wave. Only screens between the ends of a leg itself count for it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array, UInt8Array, quantity
from caviar_protocol.errors import AssetError, suggestion
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT, rotation_matrix
from caviar_protocol.space.scene import object_pose
from caviar_protocol.topics import Carrier, Interaction, Scene
from caviar_services.channel.paths import PathTable, path_corners
from caviar_space.materials import ObjectMaterials
from caviar_space.meshes import Mesh, placed, unit_box
from caviar_space.volumes import MeshVolumes, lengths_inside, outward


class Attenuation(ABC):
    """Takes power from paths by where their legs run; delays, directions and phases stay."""

    @abstractmethod
    def move(self, scene: Scene) -> None:
        """Put what attenuates, as far as it moves, where the objects of a scene are.

        Args:
            scene: Of the frame.
        """

    @abstractmethod
    def amplitude_factor(
        self, start: Float64Array, points: Float64Array, end: Float64Array, types: UInt8Array
    ) -> Float64Array:
        """Factors of amplitudes, 0 to 1 or a little above.

        Args:
            start: Position of TX of each path [m], Shape ``[P, 3]``.
            points: Where it interacts [m], as in `PathTable`, Shape ``[P, D, 3]``.
            end: Position of RX of each path [m], Shape ``[P, 3]``.
            types: Of the interactions, Shape ``[P, D]``.

        Returns:
            Factors of Shape ``[C, P]``, one for each carrier.
        """

    def attenuated(self, table: PathTable, start: Float64Array, end: Float64Array) -> PathTable:
        """Weaken paths.

        Args:
            table: The paths.
            start: Position of TX of each path [m], Shape ``[P, 3]``.
            end: Position of RX of each path [m], Shape ``[P, 3]``.

        Returns:
            The same paths, with what they have lost in their ``transfer``.
        """
        factor = self.amplitude_factor(start, table.points, end, table.types)
        return replace(table, transfer=table.transfer * factor[..., None, None])


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
    """Attenuation by one kind of foliage."""

    attenuation_db_per_m: dict[
        str, Annotated[float, quantity("dB/m", "specific attenuation γ on a carrier", ge=0)]
    ] = {}
    """By name of the carrier; ``"*"``: on all others. Absent: that of ITU-R P.833's table 1, from 105.9 to
    2117.5 MHz."""
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
                surfaces.append((outward(mesh), self._number[self.keys.material_for(name)]))
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
            if (kind := self._number.get(self.keys.material_for(name, cls))) is not None
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
        inside = inside.reshape(paths, legs, len(self.kinds)).sum(1)
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
            if name not in names and (name, field) != ("*", "attenuation_db_per_m"):
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
    given = settings.attenuation_db_per_m.get(carrier.name, settings.attenuation_db_per_m.get("*"))
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


# A leg whose horizontal part is shorter [m] is vertical: no screen stands across it.
_VERTICAL_M = 1e-9


class HumanBlockageSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Objects that are screens, and their size.

    Example:
        >>> HumanBlockageSettings(width_m=0.3, height_m=1.7).classes  # the size of TR 38.901
        ('pedestrian',)
    """

    classes: tuple[str, ...] = ("pedestrian",)
    """Classes of objects that are screens; each has to stand in ``without_body``, too."""
    width_m: Annotated[float, quantity("m", "of each screen", gt=0)] | None = None
    """Absent: as wide as the object looks from the path. TR 38.901, table 7.6.4.2-5, has 0.3 m."""
    height_m: Annotated[float, quantity("m", "of each screen, from the object's feet", gt=0)] | None = None
    """Absent: that of the object. TR 38.901 has 1.7 m."""


def check_screens(
    settings: HumanBlockageSettings, others: Mapping[str, Collection[str]], without_body: Collection[str]
) -> None:
    """Refuse classes that would block twice, or in two ways.

    Args:
        settings: Of the screens.
        others: Settings of the channel that say something else of objects, with their keys.
        without_body: Classes through whose bodies waves pass.

    Raises:
        ValueError: Names the class and the remedy.
    """
    for name in settings.classes:
        if name not in without_body:
            raise ValueError(
                f"human_blockage makes screens of the class {name!r}, whose traced bodies would block the "
                f"same paths again; write without_body = [{name!r}], or leave human_blockage out"
            )
        for setting, keys in others.items():
            if name in keys:
                raise ValueError(
                    f"{name!r} is a screen of human_blockage and stands in {setting}, too; leave it out of "
                    "one of them"
                )


class HumanBlockage(Attenuation):
    """Attenuation of paths by the people of a frame.

    Args:
        settings: Of the screens.
        carriers: Of the run.

    Example:
        >>> model = HumanBlockage(HumanBlockageSettings(), (Carrier(name="c", frequency_hz=28e9),))
        >>> model.put(np.array([[5.0, 0.0, 0.0]]), np.array([[0.3, 0.5, 1.7]]), np.array([0.0]))
        >>> start, end = np.array([[0.0, 0.0, 1.5]]), np.array([[10.0, 0.0, 1.5]])
        >>> factor = model.amplitude_factor(start, np.zeros((1, 0, 3)), end, np.zeros((1, 0), np.uint8))
        >>> (-20 * np.log10(factor)).round(1).tolist()
        [[9.9]]
    """

    def __init__(self, settings: HumanBlockageSettings, carriers: Sequence[Carrier]) -> None:
        self._settings = settings
        self._wavelengths = SPEED_OF_LIGHT / np.array([carrier.frequency_hz for carrier in carriers])
        self.put(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
        size = " x ".join(
            "as the object" if value is None else f"{value:g} m"
            for value in (settings.width_m, settings.height_m)
        )
        self.briefs = tuple(f"{name}: screens of TR 38.901 model B, {size}" for name in settings.classes)
        """What products state of it, class by class."""

    def move(self, scene: Scene) -> None:
        """Put the screens where the people of a scene are.

        Args:
            scene: Of the frame.
        """
        rows = [i for i, cls in enumerate(scene.classes) if cls in self._settings.classes]
        size = scene.dimensions[rows].reshape(-1, 3)
        feet = scene.position[rows].reshape(-1, 3) - np.array([0.0, 0.0, 0.5]) * size
        axes = np.array([rotation_matrix(scene.orientation[i].tolist())[:, 0] for i in rows]).reshape(-1, 3)
        self.put(feet, size, np.arctan2(axes[:, 1], axes[:, 0]))

    def put(self, feet: Float64Array, size: Float64Array, yaw: Float64Array) -> None:
        """Put K screens.

        Args:
            feet: Middle of the lower edge [m], Shape ``[K, 3]``.
            size: Length, width and height of the people [m], Shape ``[K, 3]``.
            yaw: Where they face [rad], Shape ``[K]``.
        """
        self._feet, self._size, self._yaw = feet, size, yaw

    def amplitude_factor(
        self, start: Float64Array, points: Float64Array, end: Float64Array, types: UInt8Array
    ) -> Float64Array:
        """Factors by screens, 10^(−L/20), Shape ``[C, P]``; see `Attenuation`."""
        corners = path_corners(start, points, end, (types != 0).sum(1))
        factor = np.ones((len(self._wavelengths), len(corners)))
        if not len(self._feet) or not len(corners):
            return factor
        before, after = _unfolded(corners, types)
        for leg in range(corners.shape[1] - 1):
            ends = corners[:, leg], corners[:, leg + 1]
            line = ends[1] - ends[0]
            length = np.sqrt((line**2).sum(1))
            # Unused legs have no length, vertical ones no side.
            there = np.flatnonzero(np.hypot(line[:, 0], line[:, 1]) > _VERTICAL_M)
            along = line[there] / length[there, None]
            image = ends[0][there] - before[there, leg, None] * along
            whole = before[there, leg] + length[there] + after[there, leg]
            for screen in range(len(self._feet)):
                reach = before[there, leg], before[there, leg] + length[there]
                factor[:, there] *= self._leg_factor(screen, image, along, whole, reach)
        return factor

    def _leg_factor(
        self,
        screen: int,
        start: Float64Array,
        along: Float64Array,
        whole: Float64Array,
        reach: tuple[Float64Array, Float64Array],
    ) -> Float64Array:
        """Factors of one screen for straight waves, Shape ``[C, L]``.

        Args:
            screen: Its number.
            start: Where each wave comes from [m], Shape ``[L, 3]``.
            along: Unit vector of each, Shape ``[L, 3]``.
            whole: Length of each [m], Shape ``[L]``.
            reach: Lengths at which the leg begins and ends, on which a screen counts.
        """
        level = np.hypot(along[:, 0], along[:, 1])
        side = along[:, :2] / level[:, None]
        to = self._feet[screen] - start
        # In the top view: how far along the wave the screen stands, and how far to its left.
        at = to[:, 0] * side[:, 0] + to[:, 1] * side[:, 1]
        left = to[:, 1] * side[:, 0] - to[:, 0] * side[:, 1]
        counts = (at > reach[0] * level) & (at < reach[1] * level)
        width, height = self._seen(screen, side)
        far = whole * level
        top = _edges((at, left - width / 2), (at, left + width / 2), (far, np.zeros_like(far)))
        rise = whole * along[:, 2]
        upright = _edges((at, to[:, 2]), (at, to[:, 2] + height), (far, rise))
        k = np.pi / self._wavelengths[:, None]
        passed: Float64Array = 1.0 - _knife(k, *upright) * _knife(k, *top)
        return np.where(counts, passed, 1.0)

    def _seen(self, screen: int, side: Float64Array) -> tuple[Float64Array | float, float]:
        """Width, Shape ``[L]``, and height [m] of a screen across these horizontal directions."""
        length, width, height = self._size[screen]
        if self._settings.height_m is not None:
            height = self._settings.height_m
        if self._settings.width_m is not None:
            return self._settings.width_m, height
        c, s = np.cos(self._yaw[screen]), np.sin(self._yaw[screen])
        forward, across = side[:, 0] * c + side[:, 1] * s, side[:, 1] * c - side[:, 0] * s
        # The silhouette of an ellipse with these axes, seen along the direction.
        return np.hypot(width * forward, length * across), height


def _unfolded(corners: Float64Array, types: UInt8Array) -> tuple[Float64Array, Float64Array]:
    """Lengths of the wave before and after each leg [m], Shape ``[P, D + 1]`` each: over reflections and
    transmissions, up to where it is diffracted or scattered."""
    lengths = np.sqrt((np.diff(corners, axis=1) ** 2).sum(-1))
    passes = (types == Interaction.REFLECTION) | (types == Interaction.TRANSMISSION)
    before, after = np.zeros_like(lengths), np.zeros_like(lengths)
    for leg in range(1, lengths.shape[1]):
        before[:, leg] = np.where(passes[:, leg - 1], before[:, leg - 1] + lengths[:, leg - 1], 0.0)
    for leg in range(lengths.shape[1] - 2, -1, -1):
        after[:, leg] = np.where(passes[:, leg], after[:, leg + 1] + lengths[:, leg + 1], 0.0)
    return before, after


_Point = tuple[Float64Array, Float64Array]


def _edges(one: _Point, other: _Point, end: _Point) -> tuple[Float64Array, Float64Array]:
    """Detours D1 + D2 − r [m] over two edges in a view, negative for an edge that counts as −.

    Args:
        one, other: Coordinates of the edges as seen from the start, one below the other.
        end: That of the end.
    """
    r = np.hypot(*end)
    detours = [np.hypot(*p) + np.hypot(end[0] - p[0], end[1] - p[1]) - r for p in (one, other)]
    # Rounding: on the line itself the detour is 0.
    first, second = (np.maximum(detour, 0.0) for detour in detours)
    height = end[1] / end[0] * one[0]
    blocks = (one[1] <= height) & (height <= other[1])
    nearer = first <= second
    return (np.where(blocks | ~nearer, first, -first), np.where(blocks | nearer, second, -second))


def _knife(k: Float64Array, first: Float64Array, second: Float64Array) -> Float64Array:
    """F of two edges, added; detours as of `_edges`, k = π/λ [1/m], Shape ``[C, 1]``."""
    one, other = (
        np.sign(detour) * np.arctan(np.pi / 2 * np.sqrt(k * np.abs(detour))) / np.pi
        for detour in (first, second)
    )
    found: Float64Array = one + other
    return found
