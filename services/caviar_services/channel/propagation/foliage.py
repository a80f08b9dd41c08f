"""Foliage as lossy volumes: Recommendation ITU-R P.833-10, attenuation in vegetation.

Waves pass through foliage on straight lines and lose A = A_m·(1 − exp(−γ·d/A_m)) [dB] (section 2.1, eq. 1),
with the length d within it [m], the specific attenuation γ [dB/m] for very short paths, and the maximum
attenuation A_m [dB] of what arrives by other ways than straight through. Without a maximum that is γ·d.
Amplitudes fall by 10^(−A/20), phases and directions stay.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import msgspec
import numpy as np

from caviar_protocol.arrays import Complex128Array, Float64Array, UInt8Array, quantity
from caviar_protocol.errors import AssetError, suggestion
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.space.scene import object_pose
from caviar_protocol.topics import Carrier, Scene
from caviar_services.channel.paths import PathTable
from caviar_services.channel.propagation.geometry import path_corners
from caviar_services.channel.propagation.mesh_volumes import MeshVolumes, lengths_inside, outward
from caviar_services.channel.sionna.materials import ObjectMaterials
from caviar_services.mesh.shapes import Mesh, placed, unit_box

_TABLE_1 = np.array(
    [
        (105.9, 0.04, 9.4),
        (466.475, 0.12, 18.0),
        (949.0, 0.17, 26.5),
        (1852.2, 0.30, 29.0),
        (2117.5, 0.34, 34.1),
    ]
)
"""Mixed coniferous and deciduous woodland near St Petersburg (P.833-10, table 1): frequency [MHz], γ [dB/m]
and A_m [dB]."""

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
        """A [dB], Shape ``[C, P]``, of paths that run over these lengths [m] within it, Shape ``[P]``
        (P.833-10, eq. 1)."""
        straight: Float64Array = self.attenuation_db_per_m[:, None] * length
        most = np.where(np.isfinite(self.maximum_db), self.maximum_db, 1.0)[:, None]
        saturating = -most * np.expm1(-straight / most)
        return np.where(np.isfinite(self.maximum_db)[:, None], saturating, straight)

    def briefs(self, carriers: Sequence[Carrier]) -> tuple[str, ...]:
        """What products state of it, carrier by carrier."""
        return tuple(
            f"{self.key}@{carrier.name}: {gamma:g} dB/m"
            + (f", at most {most:g} dB" if np.isfinite(most) else "")
            + f" ({source})"
            for carrier, gamma, most, source in zip(
                carriers, self.attenuation_db_per_m, self.maximum_db, self.source, strict=True
            )
        )


class Foliage:
    """What of a scene is foliage, and what paths lose in it.

    The volume of a piece of scenery is within its mesh, that of an object is its bounding box. A path loses,
    to each kind, A of the length that all of its legs run within the union of all volumes of this kind.

    Parameters
    ----------
    settings
        By name of an object or a piece of scenery, pattern of names with ``*``, or class of objects.
    carriers
        Of the run.
    place
        Where the settings of the channel stand.
    others
        Settings of the channel that say something else of objects, with their keys.

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
        """Let these pieces of scenery be foliage, by name. Raises `AssetError` for one that is not closed."""
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
        """Let the foliage among the objects of a scene be where they are."""
        boxes = [
            (placed(self._box, scene.dimensions[i], object_pose(scene, i))[self._box.faces], kind)
            for i, (name, cls) in enumerate(zip(scene.names, scene.classes, strict=True))
            if (kind := self._number.get(self.keys.of(name, cls))) is not None
        ]
        self._moving = MeshVolumes.of(boxes)

    def amplitude_factor(
        self, start: Float64Array, points: Float64Array, end: Float64Array, types: UInt8Array
    ) -> Float64Array:
        """What foliage leaves of amplitudes: 10^(−A/20), Shape ``[C, P]``.

        Parameters
        ----------
        start, end
            TX and RX position of each path [m], Shape ``[P, 3]``.
        points, types
            As in `PathTable`, Shape ``[P, D, 3]`` and ``[P, D]``.
        """
        corners = path_corners(start, points, end, (types != 0).sum(1))
        paths, legs = len(corners), corners.shape[1] - 1
        ends = corners[:, :-1].reshape(-1, 3), corners[:, 1:].reshape(-1, 3)
        inside = lengths_inside((self._still, self._moving), *ends, len(self.kinds))
        inside = inside.reshape(paths, legs, -1).sum(1)
        lost = sum(kind.attenuation_db(inside[:, k]) for k, kind in enumerate(self.kinds))
        return 10 ** (-np.asarray(lost) / 20)

    def attenuated(self, table: PathTable, start: Float64Array, end: Float64Array) -> PathTable:
        """The paths, between these positions [m], Shape ``[P, 3]``, with what foliage leaves of them."""
        factor = self.amplitude_factor(start, table.points, end, table.types)
        return replace(table, transfer=_scaled(table.transfer, factor))


def _scaled(transfer: Complex128Array, factor: Float64Array) -> Complex128Array:
    scaled: Complex128Array = transfer * factor[..., None, None]
    return scaled


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
    gamma, most = (
        float(np.exp(np.interp(np.log(megahertz), np.log(_TABLE_1[:, 0]), np.log(_TABLE_1[:, column]))))
        for column in (1, 2)
    )
    if carrier.name in settings.maximum_db:
        return gamma, settings.maximum_db[carrier.name], f"{_SOURCE}, {settings.source}"
    return gamma, most, _SOURCE
