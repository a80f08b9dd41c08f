"""Maps of OpenStreetMap as scenes: buildings with parts and roofs, trees, water, ground, and a road network.

All that a file of a map has (`map_files`) is drawn in transverse Mercator about the origin
(`Georeference.projection`), and so is the network that SUMO's netconvert makes of the roads (`road_network`).
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import AssetError, SetupError
from caviar_protocol.host import install_command
from caviar_space.imported_scenes import (
    Georeference,
    ImportedScene,
    Piece,
    box_in_metres,
    source_of,
    wall_material,
)
from caviar_space.meshes import Mesh, joined
from caviar_space.mitsuba_xml import RadioMaterial
from caviar_space.sources.building_shapes import PITCHED, Roof, crown, plate, prism, roofed, triangulated
from caviar_space.sources.height_grids import STEP_M, Terrain
from caviar_space.sources.map_files import (
    Element,
    Map,
    building_kind,
    is_water,
    metres,
    read_map_file,
)

if TYPE_CHECKING:
    from shapely import Geometry, Polygon

    from caviar_space.sources import Request

STOREY_M = 3.0
"""Height of a storey [m]."""
DEFAULT_HEIGHT_M = 9.0
"""Height of a building that neither tags nor neighbours say [m]."""
NEIGHBOURS_M = 200.0
"""Distance within which the median of the tagged heights stands for one that is not tagged [m]."""
LOW_BUILDINGS: Mapping[str, float] = dict.fromkeys(
    ("garage", "garages", "carport", "shed", "hut", "kiosk", "cabin", "service", "container", "toilets"), 3.0
) | {"roof": 4.5}
"""Height by the kind of a building that is not like its neighbours [m]."""
MATERIALS: Mapping[str, str] = {
    **dict.fromkeys(("brick", "clay", "roof_tiles", "tile", "tiles", "terracotta", "masonry"), "brick"),
    **dict.fromkeys(("concrete", "cement_block", "plaster", "sandstone", "eternit", "gravel"), "concrete"),
    **dict.fromkeys(("glass", "mirror", "glass_facade", "solar_panels"), "glass"),
    **dict.fromkeys(
        ("metal", "steel", "metal_sheet", "copper", "tin", "zinc", "aluminium", "gold", "lead"), "metal"
    ),
    **dict.fromkeys(("stone", "marble", "limestone", "granite", "slate"), "marble"),
    **dict.fromkeys(("wood", "timber_framing", "bamboo", "thatch"), "wood"),
    **dict.fromkeys(("tar_paper", "bitumen", "asphalt", "asphalt_shingle"), "asphalt_concrete"),
    "ground": "concrete",
    "water": "wet_ground",
}
"""Material in ITU-R P.2040 by the value of ``building:material`` or ``roof:material``; ``ground``, and
``water``, of which the Recommendation has none: wet ground comes nearest."""
TREE_M = (10.0, 5.0)
"""Height of a tree and diameter of its crown that are not tagged [m]; the crown begins at 0.3 of it."""
BEYOND_M = 500.0
"""Distance from the box of an extract within which buildings are taken, where none is asked for [m]."""
ROW_M = 8.0
"""Distance between the trees of a row [m]."""
# [m] from the origin: beyond, the projection's scale is off by more than 0.5 per mille.
_FAR_M = 200e3
# Of ground that is not level: 40 by 40 km.
_MOST_SQUARES = 4_000_000
# Distance from the border of a map to the last node of a coast, at most [m].
_CUT_M = 100.0
_COMPASS = (
    "N", "NNE", "NE", "ENE", "E", "ESE", "SE", "SSE", "S", "SSW", "SW", "WSW", "W", "WNW", "NW", "NNW"
)  # fmt: skip


def read_map(path: Path, request: Request) -> ImportedScene:
    """Read a map of OpenStreetMap.

    Args:
        path: ``.osm``, ``.osm.pbf``, ``.geojson``.
        request: Box, origin, heights and materials.

    Raises:
        AssetError: The file is no map, is damaged, or has nothing within the box.
        SetupError: A library of the extra ``scenes`` is not installed.
    """
    try:
        import osmium  # noqa: F401
        import pyproj  # noqa: F401
        import shapely  # noqa: F401
    except ImportError as error:
        raise SetupError(
            f"maps need {error.name}, of the extra `scenes`; run: {install_command('scenes')}"
        ) from error
    request.progress("read the map", 0.0)
    return _Assembly(path, request, read_map_file(path)).scene()


class _Solid(NamedTuple):
    """Body to be: a footprint [m] between two heights over its lowest ground [m]; equal ones are a plate."""

    element: Element
    polygon: Polygon
    low: float
    high: float
    roof: Roof


class _Assembly:
    """Makes a scene of a map."""

    def __init__(self, path: Path, request: Request, found: Map) -> None:
        self.path, self.request, self.map = path, request, found
        self.notes: Counter[str] = found.left_out
        box, bounds = request.box_deg, found.bounds or self._extent()
        self.boxed = bool(box or request.box_m)
        west, south, east, north = box or bounds
        self.origin = request.origin or Georeference(
            latitude_deg=round((south + north) / 2, 7), longitude_deg=round((west + east) / 2, 7)
        )
        self.origin = msgspec.structs.replace(self.origin, projection="tmerc")
        self.box = request.box_m or box_in_metres((west, south, east, north), self.origin)
        if not max(map(abs, self.box)) <= _FAR_M:  # nor is an infinite one
            raise AssetError(
                f"{path}: the box reaches {max(map(abs, self.box)) / 1e3:.0f} km from the origin, of at most "
                f"{_FAR_M / 1e3:.0f}; write --box W,S,E,N, or an --origin within it"
            )

    def _extent(self) -> tuple[float, float, float, float]:
        import shapely

        shapes = [element.shape for element in (*self.map.areas, *self.map.trees)]
        places = np.concatenate([shapely.get_coordinates(shapes), *(road.places for road in self.map.roads)])
        if not len(places):
            raise AssetError(f"{self.path} has neither buildings nor roads nor trees; name another extract")
        return (*places.min(axis=0).tolist(), *places.max(axis=0).tolist())

    def _project(self, places: Float64Array) -> Float64Array:
        """x and y [m] of longitudes and latitudes [°], Shape ``[N, 2]`` each."""
        longitude, latitude = cast("tuple[Any, Any]", places.T)
        x, y, _ = self.origin.to_scene(latitude, longitude, cast("Any", np.zeros(len(places))))
        found: Float64Array = np.stack([x, y], axis=1)
        if not np.isfinite(found).all():
            raise AssetError(f"{self.path}: places too far from the origin to be drawn; write --box W,S,E,N")
        return found

    def scene(self) -> ImportedScene:
        """Make the scene: buildings, foliage, water, ground, and the network of roads."""
        self.made = ImportedScene(name=self.path.name.split(".")[0], origin=self.origin)
        self.made.sources.append(source_of(self.path))
        self.request.progress("buildings", 0.1)
        outlines, parts = self._areas()
        solids = self._solids(outlines, parts)
        self._survey([solid.polygon for solid in solids])
        for solid in solids:
            self._add_building(solid)
        self.request.progress("ground and trees", 0.2)
        self._add_foliage()
        self._add_ground()
        self.request.progress("roads", 0.3)
        self._add_roads(solids)
        if not self.made.pieces.keys() - {"ground"} and not self.made.files:
            raise AssetError(f"{self.path} has neither buildings nor roads within the box; name another box")
        self.made.notes += [f"{times} × {what}" for what, times in sorted(self.notes.items()) if times]
        self.request.progress("", 1.0)
        return self.made

    def _areas(self) -> tuple[list[Element], list[Element]]:
        """Outlines and parts of buildings with polygons in the scene [m]; water and woods stay aside."""
        import shapely

        x0, y0, x1, y1 = self.box
        frame = shapely.box(x0, y0, x1, y1)
        outlines, parts = list[Element](), list[Element]()
        self.water, self.woods = list[Any](), list[Element]()
        for element in self._near(self.map.areas):
            shape = element.shape
            if not shape.is_valid:
                self.notes["outline that crosses itself: mended"] += 1
                shape = shapely.make_valid(shape)
            for polygon in shapely.get_parts(shapely.get_parts(shape)):
                if polygon.geom_type != "Polygon":
                    continue
                if kind := building_kind(element.tags):
                    polygon = shapely.simplify(polygon, 0.02)
                    if not polygon.is_valid or polygon.area < 1.0:
                        self.notes["footprint of less than 1 m²"] += 1
                    else:
                        (parts if kind == "part" else outlines).append(element._replace(shape=polygon))
                elif polygon.intersects(frame):
                    inside = [p for p in shapely.get_parts(polygon & frame) if p.geom_type == "Polygon"]
                    if is_water(element.tags):
                        self.water += inside
                    else:
                        self.woods += [element._replace(shape=p) for p in inside]
        return outlines, parts

    def _near(self, elements: Sequence[Element]) -> list[Element]:
        """Elements that touch the box, in the scene [m]."""
        import shapely

        if not elements:
            return []
        shapes = np.array([element.shape for element in elements])
        # Without a box buildings are taken that an extract has beyond its own.
        beyond = 0.0 if self.boxed else BEYOND_M
        x0, y0, x1, y1 = np.array(self.box) + beyond * np.array((-1, -1, 1, 1))
        places = [self.origin.to_wgs84(x, y)[:2] for x in (x0, x1) for y in (y0, y1)]
        (south, west), (north, east) = np.min(places, axis=0), np.max(places, axis=0)
        bounds = shapely.bounds(shapes)
        there = (bounds[:, :2] <= (east, north)).all(axis=1) & (bounds[:, 2:] >= (west, south)).all(axis=1)
        drawn = shapely.transform(shapes[there], self._project)
        return [
            elements[i]._replace(shape=s) for i, s in zip(np.flatnonzero(there).tolist(), drawn, strict=True)
        ]

    def _solids(self, outlines: list[Element], parts: list[Element]) -> list[_Solid]:
        """Bodies of the buildings whose middle is in the box; parts take the place of their outline."""
        import shapely

        x0, y0, x1, y1 = self.box
        shapes = np.array([outline.shape for outline in outlines], object)
        tree = shapely.STRtree(shapes)
        owned: dict[int, list[Element]] = {}
        for part in parts:
            near = tree.query(part.shape, "intersects")
            shared = shapely.area(shapely.intersection(shapes[near], part.shape))
            best = int(near[shared.argmax()]) if len(near) and shared.max() > 0.5 * part.shape.area else -1
            owned.setdefault(best, []).append(part)
        middles = shapely.centroid(shapes)
        frame = shapely.box(x0, y0, x1, y1) if self.boxed else shapely.box(-np.inf, -np.inf, np.inf, np.inf)
        inside = shapely.contains_xy(frame, shapely.get_x(middles), shapely.get_y(middles))
        known = [self._tagged(outline.tags) for outline in outlines]
        like = [
            i for i, found in enumerate(known) if found and outlines[i].tags["building"] not in LOW_BUILDINGS
        ]
        neighbours = shapely.STRtree(middles[like])
        solids = []
        for index, outline in enumerate(outlines):
            if not inside[index]:
                continue
            height = known[index]
            if height:
                how = "height" if self._height(outline.tags) else f"building:levels, {STOREY_M:g} m each"
            elif height := LOW_BUILDINGS.get(outline.tags["building"], 0.0):
                how = "their kind"
            elif len(near := neighbours.query(middles[index], "dwithin", distance=NEIGHBOURS_M)):
                how = f"the median of those tagged within {NEIGHBOURS_M:g} m"
                height = float(np.median([known[like[i]] for i in near]))
            else:
                how, height = f"the default of {DEFAULT_HEIGHT_M:g} m", DEFAULT_HEIGHT_M
            self.notes[f"building with its height by {how}"] += 1
            rest = outline.shape
            for part in owned.get(index, ()):
                solids.append(body := self._solid(part, part.shape, self._tagged(part.tags) or height))
                if not (body.low and 0 < known[index] < body.high):  # else it stands on its outline's storeys
                    rest = rest - part.shape
            # A strip that is narrower than a metre is a matter of how outline and parts were drawn.
            left = [
                p for p in shapely.get_parts(rest) if p.geom_type == "Polygon" and p.buffer(-0.5).area > 1.0
            ]
            solids += [self._solid(outline, polygon, height) for polygon in left]
        for part in owned.get(-1, ()):
            if shapely.contains_xy(frame, *part.shape.centroid.coords[0]):
                solids.append(self._solid(part, part.shape, self._tagged(part.tags) or DEFAULT_HEIGHT_M))
        return solids

    def _height(self, tags: Mapping[str, str], key: str = "height", least: float = 0.0) -> float | None:
        """Length of a tag between bounds [m]; None: there is none, or it cannot be one, which is noted."""
        if key not in tags:
            return None
        value = metres(tags[key])
        if value is None or not least <= value <= 1000 or (key == "height" and value == 0):
            self.notes[f"{key} that cannot be read"] += 1
            return None
        return value

    def _tagged(self, tags: Mapping[str, str]) -> float:
        """Height that the tags say [m]; 0: none."""
        levels = metres(tags.get("building:levels", ""))
        roof = self._roof(tags).height_m or 0.0
        by_levels = levels * STOREY_M + roof if levels and 0 < levels < 300 else 0.0
        return self._height(tags) or by_levels

    def _roof(self, tags: Mapping[str, str]) -> Roof:
        rise = self._height(tags, "roof:height")
        levels = metres(tags.get("roof:levels", ""))
        if rise is None and levels and 0 < levels < 10:
            rise = levels * STOREY_M
        shape = tags.get("roof:shape", "flat")
        if rise is None and "height" not in tags and shape in PITCHED:
            rise = STOREY_M  # on top of the storeys
        towards = tags.get("roof:direction", "").upper()
        direction = _COMPASS.index(towards) * 22.5 if towards in _COMPASS else metres(towards)
        across = tags.get("roof:orientation") == "across"
        return Roof(shape, rise or None, across, direction)

    def _solid(self, element: Element, polygon: Polygon, high: float) -> _Solid:
        tags = element.tags
        levels = metres(tags.get("building:min_level", "")) or 0.0
        low = self._height(tags, "min_height") or max(levels, 0.0) * STOREY_M
        if not low and tags.get("building") == "roof":
            low = high
        if low > high:
            self.notes["min_height that is not below height: left out"] += 1
            low = 0.0
        return _Solid(element, polygon, low, high, self._roof(tags))

    def _add_building(self, solid: _Solid) -> None:
        name, tags = f"building-{solid.element.name}", solid.element.tags
        number = 1
        while {name, f"{name}-roof"} & self.made.pieces.keys():
            number += 1
            name = f"building-{solid.element.name}-{number}"
        ground = self._lowest(solid.polygon)
        low, high = ground + solid.low, ground + solid.high
        body = roofed(solid.polygon, low, high, solid.roof)
        if solid.low == solid.high:  # a roof without walls is one face: a slab would count twice
            body = plate(solid.polygon, high)
        if body is None:
            if solid.roof.shape != "flat":
                self.notes[
                    "roof that is flat here: its shape, or that of its footprint, is none of those known"
                ] += 1
            body = prism(solid.polygon, low, high)
        walls = self._material(tags.get("building:material", ""), self.request.material)
        roofs = self._material(tags.get("roof:material", ""), walls)
        faces = body.mesh.faces
        line = int(re.sub(r"\D", "", solid.element.name) or 0)
        if roofs == walls or body.roof.all():
            self._add(name, body.mesh, roofs, "building", line)
            return
        for suffix, material, chosen in (("", walls, ~body.roof), ("-roof", roofs, body.roof)):
            used, places = np.unique(faces[chosen], return_inverse=True)
            mesh = Mesh(body.mesh.vertices[used], places.reshape(-1, 3).astype(np.int32))
            self._add(name + suffix, mesh, material, "building", line)

    def _material(self, given: str, default: str) -> str:
        """Material in ITU-R P.2040 by its name on maps."""
        given = given.strip().lower().replace(" ", "_")
        if not given:
            return default
        found = self.request.materials.get(given) or MATERIALS.get(given)
        if found is None:
            self.notes[f"material {given!r} that no table has: {default}; write --materials {given}=…"] += 1
        return found or default

    def _add(self, name: str, mesh: Mesh, material: str, kind: str, line: int = 0) -> None:
        self.made.pieces[name] = Piece(mesh, material, kind, self.path.name, line)
        radio = wall_material(material)
        if kind == "foliage":  # is to waves what a channel says of its volume
            radio = RadioMaterial(colour=(0.0, 0.25, 0.0))
        self.made.materials.setdefault(material, radio)

    def _lowest(self, shape: Geometry) -> float:
        """Height of the lowest ground under a shape [m]."""
        import shapely

        if self.terrain is None:
            return 0.0
        return float(self.terrain.at(shapely.get_coordinates(shapely.segmentize(shape, STEP_M / 4))).min())

    def _survey(self, footprints: Sequence[Any]) -> None:
        """Take the heights of the ground; z counts from the lowest."""
        import shapely

        self.terrain = None
        x0, y0, x1, y1 = shapely.total_bounds([*footprints, shapely.box(*self.box)])
        self.extent = (float(x0), float(y0), float(x1), float(y1))
        if self.request.heights is None:
            return
        from caviar_space.sources.height_grids import read_heights

        grid = read_heights(self.request.heights)
        self.made.sources.append(source_of(self.request.heights))
        x, y = (np.arange(a, b + STEP_M, STEP_M) for a, b in ((x0, x1), (y0, y1)))
        if len(x) * len(y) > _MOST_SQUARES:
            raise AssetError(f"{self.path} has {len(x) * len(y)} squares of ground of {STEP_M:g} m within "
                             f"the box, of at most {_MOST_SQUARES}; write a smaller --box")  # fmt: skip
        places = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
        latitude, longitude, _ = self.origin.to_wgs84(
            *cast("Any", (places[..., 0], places[..., 1], 0 * places[..., 0]))
        )
        heights = grid.at(np.ravel(longitude), np.ravel(latitude)).reshape(places.shape[:2])
        if np.isnan(heights).all():
            raise AssetError(f"{self.request.heights} has no heights within the box; name another grid")
        lowest = float(np.nanmin(heights))
        self.notes[f"place of the ground without a height: {lowest:g} m"] += int(np.isnan(heights).sum())
        self.terrain = Terrain((float(x0), float(y0)), np.nan_to_num(heights - lowest, nan=0.0))
        self.origin = self.made.origin = msgspec.structs.replace(self.origin, altitude_m=lowest)

    def _add_foliage(self) -> None:
        """Crowns of trees, and woods, of which all of a kind are one piece: volumes may overlap."""
        import shapely

        crowns: dict[tuple[float, float], Mesh] = {}
        x0, y0, x1, y1 = self.box
        for element in self._near(self.map.trees):
            line = element.shape
            high = self._height(element.tags, least=1.0) or TREE_M[0]
            wide = self._height(element.tags, "diameter_crown", least=0.5) or TREE_M[1]
            along = np.arange(0.0, line.length + 1e-6, ROW_M)  # of a point: 0
            for x, y in shapely.get_coordinates(
                shapely.line_interpolate_point(line, along) if line.length else line
            ):
                if x0 <= x <= x1 and y0 <= y <= y1:
                    ground = self._lowest(shapely.Point(x, y))
                    crowns[x, y] = crown(x, y, ground + 0.3 * high, ground + high, wide)
        for index, element in enumerate(self.woods):
            ground = self._lowest(element.shape)
            high = self._height(element.tags, least=1.0) or TREE_M[0]
            self._add(
                f"foliage-wood-{index}",
                prism(element.shape, ground, ground + high).mesh,
                "foliage",
                "foliage",
            )
        if crowns:
            self._add("foliage-trees", joined(list(crowns.values())), "foliage", "foliage")

    def _add_ground(self) -> None:
        """Level ground below all pieces, and water in it."""
        import shapely

        if self.terrain is not None:
            self.notes["water on ground that is not level: left out"] += len(self.water)
            self._add("ground", self.terrain.mesh(), self._material("ground", "concrete"), "ground")
            return
        water = shapely.union_all([*self.water, *self._sea()])
        land = shapely.box(*self.extent) - water
        for name, area in (("ground", land), ("water", water)):
            flat = [triangulated(p) for p in shapely.get_parts(area) if p.area > 0.1]
            if flat:
                meshes = [Mesh(np.column_stack([at, np.zeros(len(at))]), faces) for at, faces in flat]
                self._add(name, joined(meshes), self._material(name, "concrete"), name)

    def _sea(self) -> list[Any]:
        """Parts of the ground to the right of coasts."""
        import shapely

        frame = shapely.box(*self.extent)
        drawn = [element.shape for element in self._near(self.map.coast)]
        coasts = shapely.line_merge(shapely.union_all(drawn), directed=True) & frame
        lines = list[Any]()
        for line in shapely.get_parts(coasts):
            points = shapely.get_coordinates(line)
            # An extract ends a coast at its last node within.
            ends = [shapely.shortest_line(shapely.Point(at), frame.boundary) for at in points[[0, -1]]]
            first, last = (shapely.get_coordinates(e)[1:] if e.length < _CUT_M else points[:0] for e in ends)
            lines.append(shapely.LineString(np.concatenate([first, points, last])))
        parts = shapely.polygonize([shapely.union_all([frame.boundary, *lines])]).geoms
        found = []
        for line in lines:
            points = shapely.get_coordinates(line)
            steps = np.diff(points, axis=0)
            longest = int(np.linalg.norm(steps, axis=1).argmax())
            middle, (x, y) = points[longest] + steps[longest] / 2, steps[longest]
            aside = 0.1 * np.array((y, -x)) / np.hypot(x, y)
            sea = [part for part in parts if shapely.contains_xy(part, *(middle + aside))]
            if any(shapely.contains_xy(part, *(middle - aside)) for part in sea):
                self.notes["coast that ends within the box: no sea"] += 1
            else:
                found += sea
        return found

    def _add_roads(self, solids: Sequence[_Solid]) -> None:
        from caviar_space.sources.road_network import network_of

        roads = [road._replace(places=self._project(road.places)) for road in self.map.roads]
        made = network_of(roads, self.map.signs, [solid.polygon for solid in solids], self.box, self.origin,
                          self.terrain.at if self.terrain else None,
                          lambda name, share: self.request.progress(name, 0.3 + 0.7 * share))  # fmt: skip
        self.notes.update(made.left_out)
        self.made.notes += made.notes
        self.made.files.update(made.files)
