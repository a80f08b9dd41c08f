"""Paths of all launches in one table, each once: read from the ray tracer's buffer, named, in float64."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from caviar_protocol.arrays import BoolArray, Complex128Array, Float64Array, Int64Array, UInt8Array
from caviar_protocol.topics import Interaction
from caviar_services.channel.arrays.element_paths import Surfaces
from caviar_services.channel.paths import Antenna, PathTable, path_ends, spread_anew, with_direct
from caviar_services.channel.propagation.image_method import distinct, path_lengths, refined_points
from caviar_services.channel.propagation.patterns import spherical_basis
from caviar_services.channel.propagation.utd import (
    Bends,
    Chains,
    Sight,
    beyond_edges,
    edge_fields,
    waves_beside,
)
from caviar_services.channel.sionna import dr
from caviar_services.channel.sionna.diffracting_edges import SceneEdges
from caviar_services.channel.sionna.scene import SionnaScene
from caviar_space.vectors import Rows

# Below this horizontal part of a direction Sionna RT sets its azimuth to 0: its `EPSILON_FLOAT`.
_POLE = 100 * 2.0**-24

_TYPES = np.zeros(17, np.uint8)
_TYPES[[1, 2, 4, 8]] = (
    Interaction.REFLECTION,
    Interaction.SCATTERING,
    Interaction.TRANSMISSION,
    Interaction.DIFFRACTION,
)
"""Interaction of each flag of `sionna.rt.constants.InteractionType`."""


@dataclass(frozen=True, eq=False)
class Traced(Rows):
    """P paths from one transmitter, of at most D interactions."""

    by_carrier = frozenset({"transfer"})
    receiver: Int64Array
    """Index of the receiver, Shape ``[P]``."""
    transfer: Complex128Array
    """Dyad from the field sent to the field received, world axes, without carrier phase; Shape
    ``[C, P, 3, 3]`` with C carriers."""
    types: UInt8Array
    """`Interaction` of each point, Shape ``[P, D]``."""
    shapes: Int64Array
    """Process-local id of the shape at each point, Shape ``[P, D]``."""
    primitives: Int64Array
    """Triangle of that shape, Shape ``[P, D]``."""
    points: Float64Array
    """Interaction points [m], Shape ``[P, D, 3]``."""
    edge: Int64Array
    """Number of the edge that diffracts each path, −1 for none, Shape ``[P]``; of an edge, ``shapes`` and
    ``primitives`` say its first face."""
    hidden: BoolArray
    """Paths that only other elements than the centres of the arrays have, Shape ``[P]``."""
    settled: BoolArray
    """Paths that all corners of both arrays are known to have, Shape ``[P]``."""
    lost: int
    """How many more candidates were found than ``max_paths`` of each receiver."""

    def seen_from(self, first: int) -> Traced:
        """The same with receivers counted from another one on.

        Args:
            first: Index of that receiver.
        """
        return replace(self, receiver=self.receiver + first)


def nothing(carriers: int, depth: int, lost: int) -> Traced:
    """No paths.

    Args:
        carriers: How many.
        depth: Interactions of a path at most.
        lost: How many candidates were lost.
    """
    return Traced(
        receiver=np.zeros(0, np.int64),
        transfer=np.zeros((carriers, 0, 3, 3), np.complex128),
        types=np.zeros((0, depth), np.uint8),
        shapes=np.zeros((0, depth), np.int64),
        primitives=np.zeros((0, depth), np.int64),
        points=np.zeros((0, depth, 3)),
        edge=np.zeros(0, np.int64),
        hidden=np.zeros(0, np.bool_),
        settled=np.zeros(0, np.bool_),
        lost=lost,
    )


def joined(parts: Sequence[Traced], carriers: int, depth: int) -> Traced:
    """Paths of all parts, part by part.

    Args:
        parts: Of one transmitter; none at all are no paths.
        carriers: How many.
        depth: Interactions of a path at most.
    """
    if len(parts) == 1:
        return parts[0]
    whole = Traced.joined([nothing(carriers, depth, 0), *parts])
    return replace(whole, lost=sum(part.lost for part in parts))


def geometry(buffer: Any) -> tuple[UInt8Array, Int64Array, Int64Array, Float64Array]:
    """Types, shapes, triangles and points that a buffer holds, each of Shape ``[P, D]`` or ``[P, D, 3]``.

    Args:
        buffer: A `PathsBuffer` of Sionna RT.
    """
    depth = buffer.max_depth
    vertices = (buffer.vertices_x, buffer.vertices_y, buffer.vertices_z)
    # One evaluation for all: each `numpy()` alone would run a kernel.
    dr.eval(vertices, buffer.interaction_types, buffer.shapes, buffer.primitives)
    return (
        # Buffers have room for one interaction at least, also where none is traced.
        _TYPES[buffer.interaction_types.numpy()[:, :depth]],
        buffer.shapes.numpy()[:, :depth].astype(np.int64),
        buffer.primitives.numpy()[:, :depth].astype(np.int64),
        np.stack([v.numpy()[:, :depth] for v in vertices], axis=-1).astype(np.float64),
    )


def read(buffer: Any, carriers: int, transmitter: Float64Array, receivers: Float64Array, lost: int) -> Traced:
    """Read the paths of a solver's buffer.

    Args:
        buffer: A `PathsBuffer` of Sionna RT, with the fields of all carriers.
        carriers: How many.
        transmitter: As the ray tracer has it [m], Shape ``[3]``.
        receivers: As the ray tracer has them [m], Shape ``[R, 3]``.
        lost: How many candidates were lost.
    """
    dr.eval(buffer.a, buffer.valid)
    receiver = buffer.target_indices.numpy().astype(np.int64)
    types, shapes, primitives, points = geometry(buffer)
    jones = np.empty((carriers, len(receiver), 2, 2), np.complex128)
    for carrier, taken, sent in np.ndindex(carriers, 2, 2):
        amplitude = buffer.a[2 * carrier + taken][sent]
        jones[carrier, :, taken, sent] = dr.real(amplitude).numpy()
        jones[carrier, :, taken, sent] += 1j * dr.imag(amplitude).numpy()
    return Traced(
        receiver=receiver,
        transfer=_dyad(jones, transmitter, receivers[receiver], points, types),
        types=types,
        shapes=shapes,
        primitives=primitives,
        points=points,
        edge=edge_numbers(buffer, types),
        hidden=np.zeros(len(receiver), np.bool_),
        settled=np.zeros(len(receiver), np.bool_),
        lost=lost,
    )


def edge_numbers(buffer: Any, types: UInt8Array) -> Int64Array:
    """Number of the edge in each path that is diffracted, −1 in others, Shape ``[P]``.

    Args:
        buffer: A `PathsBuffer` of Sionna RT.
        types: `Interaction` of each point, Shape ``[P, D]``.
    """
    wedges = buffer.diffracting_wedges
    if wedges is None:
        return np.full(len(types), -1)
    number = wedges.local_edge.numpy().astype(np.int64)
    return np.where((types == Interaction.DIFFRACTION).any(1), number, -1)


def _dyad(
    jones: Complex128Array,
    transmitter: Float64Array,
    receivers: Float64Array,
    points: Float64Array,
    types: UInt8Array,
) -> Complex128Array:
    """World-axes dyads, Shape ``[C, P, 3, 3]``, of Jones matrices between spherical bases.

    The bases are those of the directions that the solver saw, which are of float32 positions.
    """
    count = (types != 0).sum(1)
    rows = np.arange(len(count))
    start = np.broadcast_to(transmitter.astype(np.float32).astype(np.float64), receivers.shape)
    end = receivers.astype(np.float32).astype(np.float64)
    padded = np.concatenate([points, end[:, None]], axis=1) if points.shape[1] else end[:, None]
    direct = count == 0
    first = np.where(direct[:, None], end, padded[:, 0])
    last = np.where(direct[:, None], start, padded[rows, np.maximum(count - 1, 0)])
    sent = np.stack(spherical_basis(_unit(first - start), _POLE), axis=-2)
    taken = np.stack(spherical_basis(_unit(last - end), _POLE), axis=-2)
    return np.stack([np.einsum("pix,pij,pjy->pxy", taken, of_carrier, sent) for of_carrier in jones])


def _unit(vectors: Float64Array) -> Float64Array:
    """Unit vectors, and zero along one of no length."""
    length = np.sqrt((vectors**2).sum(-1, keepdims=True))
    units: Float64Array = vectors / np.where(length > 0, length, 1.0)
    return units


Ends = tuple[Sequence[Antenna], Sequence[Antenna]]
"""Transmitters and receivers."""


def path_table(
    scene: SionnaScene,
    parts: Sequence[tuple[Int64Array, Traced]],
    names: tuple[str, ...],
    velocity: Float64Array,
    antennas: Ends,
    traced_from: Ends,
) -> PathTable:
    """Table of all paths that launches found between antennas.

    Args:
        scene: Where they were.
        parts: Of each launch, one at least, the pair that each path belongs to, and its paths.
        names, velocity: What `SionnaScene.place` returned.
        antennas, traced_from: Where they are, and where they were traced from.
    """
    met = Traced.joined([part for _, part in parts])
    pair, types, traced = np.concatenate([pair for pair, _ in parts]), met.types, met.points
    triangles = scene.triangle_numbers(met.shapes, met.primitives)
    (start, end), ends = path_ends(pair, *antennas), path_ends(pair, *traced_from)
    corners, of_edges = scene.corners(triangles), None
    if scene.edges is not None:
        of_edges = scene.edges.ends(met.edge)
    # Traced points are of float32 and of antennas off their surfaces; these are of the true positions.
    points = refined_points(start, traced, end, types, corners, of_edges, ends)
    faces, joined = scene.surface_names(triangles, names)
    kept = np.ones(len(pair), np.bool_)
    sights: Mapping[int, Sight] = {}
    if scene.edges is not None and (met.edge >= 0).any():
        # An edge is known by its number within its object, in place of a face.
        faces = np.where(types == Interaction.DIFFRACTION, scene.edges.number[met.edge][:, None], faces)
        kept, sights = _diffract_anew(scene, scene.edges, met, pair, triangles, ends)
    # Spreading of diffracted and scattered paths is no function of their length alone.
    specular = ((types != Interaction.DIFFRACTION) & (types != Interaction.SCATTERING)).all(1)
    objects = scene.object_index(met.shapes, met.primitives)
    table = PathTable(
        pair=pair,
        transfer=spread_anew(
            met.transfer,
            specular,
            path_lengths(ends[0], traced, ends[1], types),
            path_lengths(start, points, end, types),
        ),
        types=types,
        objects=objects,
        points=points,
        hidden=met.hidden,
        traced=np.arange(len(pair)),
        object_names=names,
        object_velocity=velocity,
        object_turning=scene.turning,
        faces=faces,
        joined_faces=joined,
    )
    # What only other elements have may have its points where the centres' path has them, on another face.
    shown = np.flatnonzero(~met.hidden & kept)
    kept &= met.hidden
    kept[shown] = distinct(pair[shown], types[shown], points[shown])
    table = table.take(kept)
    return _with_sights(table, scene, sights, antennas, traced_from) if sights else table


def _diffract_anew(
    scene: SionnaScene,
    edges: SceneEdges,
    met: Traced,
    pair: Int64Array,
    triangles: Int64Array,
    ends: tuple[Float64Array, Float64Array],
) -> tuple[BoolArray, Mapping[int, Sight]]:
    """Give diffracted paths the fields of their exact geometry, in place.

    ``triangles`` are what paths meet, and ``ends`` where they run. Returns which of all paths do not run
    beyond the ends of an edge, and of pairs whose line of sight passes an edge closely whether it is lit.
    """
    rows = np.flatnonzero(met.edge >= 0)
    types, edge = met.types[rows], met.edge[rows]
    bent = np.argmax(types == Interaction.DIFFRACTION, axis=1)
    of_edges = edges.ends(edge) - scene.centre
    corners = scene.corners(triangles[rows]) - scene.centre
    start, end = (place[rows] - scene.centre for place in ends)
    points = refined_points(start, met.points[rows] - scene.centre, end, types, corners, of_edges)
    kept = np.ones(len(met.edge), np.bool_)
    kept[rows] = ~beyond_edges(points[np.arange(len(rows)), bent], of_edges)
    # After the last interaction all points are the receiver, so that segments there have no length.
    points = np.where((types != 0)[..., None], points, end[:, None])
    path = np.concatenate([start[:, None], points, end[:, None]], axis=1)
    a, b, c = np.moveaxis(corners, -2, 0)
    faces, is_edge = edges.faces(edge)
    chains = Chains(np.where(met.hidden, -1, pair), met.types, scene.surface_of[triangles])
    with np.errstate(invalid="ignore", divide="ignore"):  # such paths stay as traced
        planes = scene.surface_of[edges.triangles[edge]]
        lit, sights = waves_beside(Bends.of(path, types, faces), planes, rows, chains)
        fields = edge_fields(
            path,
            types,
            np.cross(b - a, c - a),
            faces,
            scene.media(met.shapes[rows]),
            scene.media(scene.shapes_of(edges.triangles[edge, 1])[0][:, None]),
            scene.wavelengths,
            lit,
        )
    # Others keep the fields of the ray tracer.
    good = is_edge & np.isfinite(fields).all((0, 2, 3))
    met.transfer[:, rows[good]] = fields[:, good]
    return kept, sights


def _with_sights(
    table: PathTable, scene: SionnaScene, sights: Mapping[int, Sight], antennas: Ends, traced_from: Ends
) -> PathTable:
    """The table with those lines of sight that are lit, if nothing else is in their way, and no others."""
    dark = np.array([pair for pair, sight in sights.items() if not sight.lit], np.int64)
    straight = (table.types == 0).all(1)
    if table.hidden is not None:
        straight &= ~table.hidden
    missing = np.array(
        sorted(sights.keys() - set(table.pair[straight].tolist()) - set(dark.tolist())), np.int64
    )
    # Beside an edge float32 may see the line of sight on the wrong side of the shadow boundary.
    table = table.take(~(straight & np.isin(table.pair, dark)))
    start, end = path_ends(missing, *traced_from)
    free = [
        set(scene.surface_of[scene.surfaces.met_between(one, other)].tolist()) <= sights[pair].passed
        for pair, one, other in zip(missing.tolist(), start, end, strict=True)
    ]
    pairs = missing[free]
    start, end = path_ends(pairs, *antennas)
    distance = np.sqrt(((end - start) ** 2).sum(1))
    return with_direct(table, pairs, np.zeros(len(pairs), np.bool_), distance, np.array(scene.wavelengths))


def traced_surfaces(
    launches: Sequence[Traced],
    traced: Int64Array,
    types: UInt8Array,
    points: Float64Array,
    scene: SionnaScene,
) -> Surfaces:
    """Surfaces that some paths of all launches meet.

    Args:
        launches: What was traced.
        traced: Numbers of the paths among all, −1 for paths that meet nothing, Shape ``[P]``.
        types, points: Those of the table.
        scene: As it stands.
    """
    depth = types.shape[1]
    # Nothing stands at the end, where −1 finds it.
    none = np.zeros((1, depth), np.int64)
    shapes = np.concatenate([*(launch.shapes for launch in launches), none])[traced]
    primitives = np.concatenate([*(launch.primitives for launch in launches), none])[traced]
    edge = np.concatenate([*(launch.edge for launch in launches), [-1]])[traced]
    settled = np.concatenate([*(launch.settled for launch in launches), np.zeros(1, np.bool_)])[traced]
    triangles = scene.triangle_numbers(shapes, primitives)
    edges = scene.edges
    count = len(traced)
    origin, normal = scene.planes(shapes, primitives)
    return Surfaces(
        types=types,
        points=points,
        origin=origin,
        plane=scene.surface_of[triangles],
        normal=normal,
        edge=np.zeros((count, 2, 3)) if edges is None else edges.ends(edge),
        outward=np.zeros((count, 3)) if edges is None else edges.outward(edge),
        settled=settled,
    )
