"""Paths of all launches in one table: named, with points in float64, and each path once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from caviar_protocol.arrays import BoolArray, Complex128Array, Float64Array, Int64Array, UInt8Array
from caviar_protocol.topics import Interaction
from caviar_services.channel.paths import Antenna, PathTable
from caviar_services.channel.propagation.clearance import spread_anew, with_direct
from caviar_services.channel.propagation.image_method import distinct, path_lengths, refined_points
from caviar_services.channel.propagation.shadow_boundaries import Chains, Sight, beyond_edges, waves_beside
from caviar_services.channel.propagation.utd import Bends, edge_fields
from caviar_services.channel.sionna.diffracting_edges import SceneEdges
from caviar_services.channel.sionna.path_buffer import Traced
from caviar_services.channel.sionna.scene import SionnaScene

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
    """What launches found between antennas.

    Parameters
    ----------
    scene
        Where they were.
    parts
        Of each launch, one at least, the pair that each path belongs to, and its paths.
    names, velocity
        What `SionnaScene.place` returned.
    antennas, traced_from
        Where they are, and where they were traced from.
    """
    met = _Met.of(scene, parts)
    pair, types = met.pair, met.types
    (start, end), ends = path_ends(pair, *antennas), path_ends(pair, *traced_from)
    traced = np.concatenate([part.points for _, part in parts])
    corners, of_edges = scene.corners(met.triangles), None
    if scene.edges is not None:
        of_edges = scene.edges.ends(met.edge)
    points = refined_points(start, traced, end, types, corners, of_edges, ends)
    transfer = np.concatenate([part.transfer for _, part in parts], axis=1)
    faces, joined = scene.surface_names(met.triangles, names)
    kept = np.ones(len(pair), np.bool_)
    sights: Mapping[int, Sight] = {}
    if scene.edges is not None and (met.edge >= 0).any():
        faces = np.where(types == Interaction.DIFFRACTION, scene.edges.number[met.edge][:, None], faces)
        kept, sights = _diffract_anew(scene, scene.edges, met, traced, ends, transfer)
    specular = ((types != Interaction.DIFFRACTION) & (types != Interaction.SCATTERING)).all(1)
    objects = scene.object_index(met.shapes, met.primitives)
    table = PathTable(
        pair=pair,
        transfer=spread_anew(
            transfer,
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
    table = table.take(kept & ~(scene.is_parking(names, objects) & (types != 0)).any(1))
    return _with_sights(table, scene, sights, antennas, traced_from) if sights else table


@dataclass(frozen=True, eq=False)
class _Met:
    """What P paths of all launches meet."""

    pair: Int64Array
    types: UInt8Array
    shapes: Int64Array
    primitives: Int64Array
    triangles: Int64Array
    """Numbers through all shapes."""
    edge: Int64Array
    hidden: BoolArray

    @classmethod
    def of(cls, scene: SionnaScene, parts: Sequence[tuple[Int64Array, Traced]]) -> _Met:
        """Launch by launch."""
        shapes = np.concatenate([part.shapes for _, part in parts])
        primitives = np.concatenate([part.primitives for _, part in parts])
        return cls(
            pair=np.concatenate([pair for pair, _ in parts]),
            types=np.concatenate([part.types for _, part in parts]),
            shapes=shapes,
            primitives=primitives,
            triangles=scene.triangle_numbers(shapes, primitives),
            edge=np.concatenate([part.edge for _, part in parts]),
            hidden=np.concatenate([part.hidden for _, part in parts]),
        )


def _diffract_anew(
    scene: SionnaScene,
    edges: SceneEdges,
    met: _Met,
    traced: Float64Array,
    ends: tuple[Float64Array, Float64Array],
    transfer: Complex128Array,
) -> tuple[BoolArray, Mapping[int, Sight]]:
    """Give diffracted paths the fields of their exact geometry, in place.

    ``traced`` are the points of paths and ``ends`` where they run. Returns which of all paths do not run
    beyond the ends of an edge, and of pairs whose line of sight passes an edge closely whether it is lit.
    """
    rows = np.flatnonzero(met.edge >= 0)
    types, edge = met.types[rows], met.edge[rows]
    bent = np.argmax(types == Interaction.DIFFRACTION, axis=1)
    of_edges = edges.ends(edge) - scene.centre
    corners = scene.corners(met.triangles[rows]) - scene.centre
    start, end = (place[rows] - scene.centre for place in ends)
    points = refined_points(start, traced[rows] - scene.centre, end, types, corners, of_edges)
    kept = np.ones(len(met.edge), np.bool_)
    kept[rows] = ~beyond_edges(points[np.arange(len(rows)), bent], of_edges)
    points = np.where((types != 0)[..., None], points, end[:, None])
    path = np.concatenate([start[:, None], points, end[:, None]], axis=1)
    a, b, c = np.moveaxis(corners, -2, 0)
    faces, is_edge = edges.faces(edge)
    chains = Chains(np.where(met.hidden, -1, met.pair), met.types, scene.surface_of[met.triangles])
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
    good = is_edge & np.isfinite(fields).all((0, 2, 3))
    transfer[:, rows[good]] = fields[:, good]
    return kept, sights


def _with_sights(
    table: PathTable,
    scene: SionnaScene,
    sights: Mapping[int, Sight],
    antennas: Ends,
    traced_from: Ends,
) -> PathTable:
    """The table with those lines of sight that are lit, if nothing else is in their way, and no others."""
    dark = np.array([pair for pair, sight in sights.items() if not sight.lit], np.int64)
    straight = (table.types == 0).all(1)
    if table.hidden is not None:
        straight &= ~table.hidden
    missing = np.array(
        sorted(sights.keys() - set(table.pair[straight].tolist()) - set(dark.tolist())), np.int64
    )
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


def path_ends(
    pair: Int64Array, transmitters: Sequence[Antenna], receivers: Sequence[Antenna]
) -> tuple[Float64Array, Float64Array]:
    """Positions [m] of TX and RX of paths, each of Shape ``[P, 3]``."""
    tx, rx = np.divmod(pair, max(len(receivers), 1))
    start = np.array([antenna.position for antenna in transmitters]).reshape(-1, 3)
    end = np.array([antenna.position for antenna in receivers]).reshape(-1, 3)
    return start[tx], end[rx]
