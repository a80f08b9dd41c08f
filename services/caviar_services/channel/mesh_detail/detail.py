"""How much of the scenery is traced: small and far pieces are left out, the rest is made of fewer triangles.

Reflections come from planes, and few of a city's planes matter to a street: what detail costs in accuracy
depends on the scene, so it is to be measured (``tests/bench/bench_detail.py``), and what is left out is told.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array, Int64Array, quantity
from caviar_services.channel.mesh_detail.decimation import decimated, welded
from caviar_services.mesh.shapes import Mesh


class DetailSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What of the scenery the channel leaves out; what is not given leaves nothing out.

    A piece is what hangs together by common corners within one named shape.
    """

    smallest_m: Annotated[float, quantity("m", "diagonal of the box around a piece at least", ge=0)] = 0.0
    centre_m: Annotated[tuple[float, float] | None, quantity("m", "x and y that radius_m is around")] = None
    radius_m: Annotated[
        float | None, quantity("m", "horizontal distance of the box around a piece at most")
    ] = None
    tolerance_m: Annotated[
        float, quantity("m", "distance between the surface and that of fewer triangles at most", ge=0)
    ] = 0.0

    def __post_init__(self) -> None:
        if (self.centre_m is None) != (self.radius_m is None):
            raise ValueError(
                "centre_m and radius_m go together; write both, for example centre_m = [0.0, 0.0] and "
                "radius_m = 300.0, or neither"
            )
        if self.radius_m is not None and self.radius_m < 0:
            raise ValueError(f"radius_m is {self.radius_m}; it must be at least 0")

    @property
    def is_full(self) -> bool:
        """Whether nothing is left out."""
        return self.smallest_m == 0 and self.radius_m is None and self.tolerance_m == 0


@dataclass(frozen=True, kw_only=True)
class DetailEffect:
    """What became of the scenery."""

    triangles: tuple[int, int]
    """Before and after."""
    pieces: int
    """Before."""
    small: int
    """Pieces left out because they are smaller than ``smallest_m``."""
    far: int
    """Pieces left out because they are farther than ``radius_m``."""
    area_share: float
    """Part of the surface's area [m²] that is left."""

    @property
    def brief(self) -> str:
        """For products: what is left, empty for all of it."""
        before, after = self.triangles
        return f"{after} of {before} triangles, {self.area_share:.1%} of the area" if after < before else ""

    @property
    def note(self) -> str:
        """For the user, in one line."""
        if not self.brief:
            return "detail is switched off: no piece of the scenery is small or far, and no triangle is spare"
        return (
            f"mesh detail: {self.brief}; of {self.pieces} pieces {self.small} are left out as small and "
            f"{self.far} as far"
        )


def detailed(
    shapes: Sequence[tuple[str, Mesh]], settings: DetailSettings
) -> tuple[list[tuple[str, Mesh]], DetailEffect]:
    """Named meshes with this detail, in their order, and what that did to them.

    Shapes of which no piece is left are gone. A mesh that is left whole and not decimated is passed through.
    """
    kept: list[tuple[str, Mesh]] = []
    lost: Counter[str] = Counter()
    pieces = 0
    for name, mesh in shapes:
        label = piece_numbers(mesh)
        reasons = _reasons(mesh, label, settings)
        pieces += len(reasons)
        lost.update(reasons)
        staying = np.array([not reason for reason in reasons], np.bool_)
        if not staying.any():
            continue
        left = mesh if staying.all() else Mesh(mesh.vertices, mesh.faces[staying[label]])
        if settings.tolerance_m > 0:
            left = decimated(left, settings.tolerance_m)
        elif left is not mesh:
            left = welded(left)
        if len(left.faces):
            kept.append((name, left))
    whole = sum(_area(mesh) for _, mesh in shapes)
    return kept, DetailEffect(
        triangles=(sum(len(mesh.faces) for _, mesh in shapes), sum(len(mesh.faces) for _, mesh in kept)),
        pieces=pieces,
        small=lost["small"],
        far=lost["far"],
        area_share=sum(_area(mesh) for _, mesh in kept) / whole if whole > 0 else 1.0,
    )


def piece_numbers(mesh: Mesh) -> Int64Array:
    """Number of the piece that each triangle belongs to, from 0 in the order of their first triangles; Shape
    ``[F]``. Triangles that touch at a corner are of one piece."""
    _, place = np.unique(mesh.vertices, axis=0, return_inverse=True)
    corners: Int64Array = place.reshape(-1)[mesh.faces].astype(np.int64)
    label = np.arange(len(mesh.vertices), dtype=np.int64)
    while True:
        lowest = label[corners].min(1)
        following = label.copy()
        np.minimum.at(following, corners, lowest[:, None])
        following = following[following]
        if (following == label).all():
            break
        label = following
    _, first, inverse = np.unique(label[corners[:, 0]], return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    numbers: Int64Array = rank[inverse.reshape(-1)]
    return numbers


def _reasons(mesh: Mesh, label: Int64Array, settings: DetailSettings) -> list[str]:
    """Why each piece is left out; empty for those that stay."""
    reasons = []
    for piece in range(int(label.max(initial=-1)) + 1):
        corners = mesh.vertices[mesh.faces[label == piece]].reshape(-1, 3)
        low, high = corners.min(0), corners.max(0)
        if np.linalg.norm(high - low) < settings.smallest_m:
            reasons.append("small")
        elif settings.centre_m is not None and settings.radius_m is not None:
            beside = _distance(np.array(settings.centre_m), low[:2], high[:2])
            reasons.append("far" if beside > settings.radius_m else "")
        else:
            reasons.append("")
    return reasons


def _distance(point: Float64Array, low: Float64Array, high: Float64Array) -> float:
    """From a point to the nearest of a box."""
    return float(np.linalg.norm(point - np.clip(point, low, high)))


def _area(mesh: Mesh) -> float:
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)
