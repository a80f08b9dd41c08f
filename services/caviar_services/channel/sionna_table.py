"""Paths of all launches in one table: named, with points in float64, and each path once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from caviar_protocol.arrays import Complex128Array, Float64Array, Int64Array, UInt8Array
from caviar_protocol.topics import Interaction
from caviar_services.channel.clearance import spread_anew
from caviar_services.channel.edge_fields import edge_fields, faces_of
from caviar_services.channel.paths import Antenna, PathTable
from caviar_services.channel.sionna_scene import SionnaScene
from caviar_services.channel.sionna_traced import Traced
from caviar_services.channel.sionna_wedges import Wedges
from caviar_services.channel.specular import distinct, path_lengths, refined_points

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
    pair = np.concatenate([pair for pair, _ in parts])
    types = np.concatenate([part.types for _, part in parts])
    shapes = np.concatenate([part.shapes for _, part in parts])
    primitives = np.concatenate([part.primitives for _, part in parts])
    hidden = np.concatenate([part.hidden for _, part in parts])
    (start, end), ends = path_ends(pair, *antennas), path_ends(pair, *traced_from)
    traced = np.concatenate([part.points for _, part in parts])
    points = refined_points(start, traced, end, types, scene.triangles(shapes, primitives), ends)
    transfer = np.concatenate([part.transfer for _, part in parts], axis=1)
    _diffract_anew(scene, [part for _, part in parts], (types, shapes, primitives), traced, ends, transfer)
    specular = ((types != Interaction.DIFFRACTION) & (types != Interaction.SCATTERING)).all(1)
    objects = scene.object_index(shapes, primitives)
    faces, joined = scene.surface_names(scene.triangle_numbers(shapes, primitives), names)
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
        hidden=hidden,
        traced=np.arange(len(pair)),
        object_names=names,
        object_velocity=velocity,
        object_turning=scene.turning,
        faces=faces,
        joined_faces=joined,
    )
    # What only other elements have may have its points where the centres' path has them, on another face.
    kept = hidden.copy()
    shown = np.flatnonzero(~hidden)
    kept[shown] = distinct(pair[shown], types[shown], points[shown])
    return table.take(kept & ~(scene.is_parking(names, objects) & (types != 0)).any(1))


def _diffract_anew(
    scene: SionnaScene,
    parts: Sequence[Traced],
    met: tuple[UInt8Array, Int64Array, Int64Array],
    traced: Float64Array,
    ends: tuple[Float64Array, Float64Array],
    transfer: Complex128Array,
) -> None:
    """Give diffracted paths the fields of their exact geometry, in place.

    ``met`` are types, shapes and triangles of all paths, ``traced`` their points and ``ends`` where they run.
    """
    types, shapes, primitives = met
    rows = np.flatnonzero((types == Interaction.DIFFRACTION).sum(1) == 1)
    if not len(rows):
        return
    types, shapes, primitives = types[rows], shapes[rows], primitives[rows]
    at = np.argmax(types == Interaction.DIFFRACTION, axis=1)
    wedge = Wedges.joined([part.wedge for part in parts])
    of_edge = np.broadcast_to(shapes[np.arange(len(rows)), at][:, None], (len(rows), 2))
    faces, is_edge = faces_of(scene.triangles(of_edge, wedge.faces[rows]), wedge.ends[rows])
    triangles = scene.triangles(shapes, primitives) - scene.centre
    start, end = (place[rows] - scene.centre for place in ends)
    points = refined_points(start, traced[rows] - scene.centre, end, types, triangles)
    points = np.where((types != 0)[..., None], points, end[:, None])
    a, b, c = np.moveaxis(triangles, -2, 0)
    with np.errstate(invalid="ignore", divide="ignore"):  # such paths stay as traced
        fields = edge_fields(
            np.concatenate([start[:, None], points, end[:, None]], axis=1),
            types,
            np.cross(b - a, c - a),
            faces,
            scene.media(shapes),
            scene.wavelengths,
        )
    good = is_edge & np.isfinite(fields).all((0, 2, 3))
    transfer[:, rows[good]] = fields[:, good]


def path_ends(
    pair: Int64Array, transmitters: Sequence[Antenna], receivers: Sequence[Antenna]
) -> tuple[Float64Array, Float64Array]:
    """Positions [m] of TX and RX of paths, each of Shape ``[P, 3]``."""
    tx, rx = np.divmod(pair, max(len(receivers), 1))
    start = np.array([antenna.position for antenna in transmitters]).reshape(-1, 3)
    end = np.array([antenna.position for antenna in receivers]).reshape(-1, 3)
    return start[tx], end[rx]
