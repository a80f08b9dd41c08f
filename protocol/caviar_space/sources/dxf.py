"""DXF as a scene: faces, meshes and what has a thickness, one piece a layer.

Cadmapper's and other programs' drawings of towns; units are those that the drawing states (``$INSUNITS``).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_space.imported_scenes import ImportedScene
from caviar_space.sources import Request
from caviar_space.sources.pieces import SceneBuilder, joined_triangles, reading, slug

# A few blocks within each other expand to as many as a machine can hold.
_MOST_ENTITIES = 1_000_000
# [m] between an arc and the lines that stand for it.
_ARC_M = 0.02


def read_dxf(path: Path, request: Request) -> ImportedScene:
    """Read a DXF drawing as a scene; see `caviar_space.sources.Reader`.

    Outlines with a thickness are walls, and with floor and roof where they are closed.
    """
    builder = SceneBuilder(path, request)
    builder.read(path)
    with reading(path, "DXF"):
        import ezdxf
        from ezdxf import units

        drawing = ezdxf.readfile(path)
        if drawing.units:
            metre = units.conversion_factor(units.InsertUnits(drawing.units), units.InsertUnits.Meters)
        else:
            metre = 1.0
            builder.scene.notes.append("the drawing has no unit ($INSUNITS): metres are taken")
        layers: dict[str, list[Float64Array]] = {}
        left_out: dict[str, int] = {}
        if (count := _expanded(drawing, drawing.modelspace(), {})) > _MOST_ENTITIES:
            raise ValueError(f"blocks expand to {count} entities: at most {_MOST_ENTITIES} are read")
        for entity in _without_blocks(drawing.modelspace()):
            polygons = [polygon * metre for polygon in _polygons(entity, metre)]
            if polygons:
                layers.setdefault(entity.dxf.layer, []).extend(polygons)
            else:
                left_out[entity.dxftype()] = left_out.get(entity.dxftype(), 0) + 1
        for number, (layer, polygons) in enumerate(layers.items(), 1):
            vertices, faces = joined_triangles([[polygon] for polygon in polygons])
            kind, material = slug(layer) or "layer", builder.material(layer)
            builder.add(layer, vertices, faces, material, kind, path, number)
        kinds = ", ".join(sorted(left_out))[:100]
        if kinds:
            builder.note_left_out({f"entities without faces ({kinds})": sum(left_out.values())})
    return builder.finish()


def _expanded(drawing: Any, layout: Any, known: dict[str, int]) -> int:
    """Count of entities of a layout once the blocks that it holds are written out."""
    count = 0
    for entity in layout:
        count += 1
        name = entity.dxf.name if entity.dxftype() == "INSERT" else ""
        if name in drawing.blocks:
            if known.setdefault(name, -1) < 0:
                known[name] = _expanded(drawing, drawing.blocks[name], known)
            count += entity.mcount * known[name]
    return count


def _without_blocks(entities: Iterable[Any]) -> Iterator[Any]:
    """Entities, in place of blocks those that they hold; dimensions stay, whose arrows are faces."""
    for entity in entities:
        if entity.dxftype() != "INSERT":
            yield entity
        elif entity.mcount > 1:
            yield from _without_blocks(entity.multi_insert())
        else:
            yield from _without_blocks(entity.virtual_entities())


def _polygons(entity: Any, metre: float) -> Iterator[Float64Array]:
    """Polygons of an entity in the drawing's unit, Shape ``[N, 3]`` each."""
    from ezdxf.path import make_path
    from ezdxf.render import MeshBuilder, MeshVertexMerger

    kind = entity.dxftype()
    thickness = entity.dxf.get("thickness", 0.0) if entity.dxf.is_supported("thickness") else 0.0
    if kind == "3DFACE":
        yield _array(entity.wcs_vertices())
    elif kind == "MESH":
        yield from (_array(face) for face in MeshBuilder.from_mesh(entity).faces_as_vertices())
    elif kind == "POLYLINE" and (entity.is_poly_face_mesh or entity.is_polygon_mesh):
        yield from (_array(face) for face in MeshVertexMerger.from_polyface(entity).faces_as_vertices())
    elif thickness or kind in ("SOLID", "TRACE"):
        if kind in ("SOLID", "TRACE"):
            outline, closed = _array(entity.wcs_vertices()), True
        else:
            path = make_path(entity)
            outline, closed = _array(path.flattening(_ARC_M / metre)), path.is_closed
            outline = outline[:-1] if closed else outline
        yield from _extruded(outline, np.array(entity.dxf.extrusion) * thickness, closed)


def _array(points: Any) -> Float64Array:
    return np.array([tuple(point) for point in points], np.float64).reshape(-1, 3)


def _extruded(outline: Float64Array, along: Float64Array, closed: bool) -> Iterator[Float64Array]:
    """Walls above an outline, with floor and roof if it is closed, fronts outside."""
    if not along.any():
        yield outline
        return
    if closed:
        arms = outline - outline[0]
        if np.cross(arms, np.roll(arms, -1, axis=0)).sum(0) @ along < 0:
            outline = outline[::-1]
        yield outline[::-1]
        yield outline + along
    for a, b in zip(outline, np.roll(outline, -1, axis=0) if closed else outline[1:], strict=False):
        yield np.array([a, b, b + along, a + along])
