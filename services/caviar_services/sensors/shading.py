"""Pictures by ray tracing: sun with shadows, light of the sky, haze, and smooth edges.

Nothing is random. Each pixel looks at its part of the sky in a few fixed directions; the sets of
16 neighbours complete each other, and a filter that stops at edges joins them. Pixels with an
edge in them are traced again, at eight points each. So a picture is clean without many samples,
and the same scene gives the same bytes.

What colour things have in a picture: by material for scenery, by class for moving objects.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from caviar_protocol.arrays import Float32Array, Float64Array, Int64Array, UInt8Array
from caviar_protocol.space.coordinates import Pose, rotation_matrix
from caviar_protocol.topics import CameraDevice, Intrinsics
from caviar_services.drjit_setup import aligned_columns
from caviar_services.sensors.base import TracedScene
from caviar_space.mitsuba_xml import SceneryShape

SUN = (1.0, 0.93, 0.80)
"""Irradiance of a surface that faces the sun, over π; linear sRGB, as all colours here."""
ZENITH, HORIZON = (0.22, 0.42, 0.80), (0.72, 0.82, 0.93)
"""Radiance of the sky."""
SKYLIGHT = 1.25
"""How much brighter the sky is for surfaces than in the picture, where it would be white."""
BOUNCED = (0.36, 0.35, 0.33)
"""What comes from where the sky is hidden: light that streets and façades pass on."""
SKY_REACH = 60.0
"""[m]; what is farther does not hide the sky from a surface."""
HAZE = 1800.0
"""[m]; after this way, 63 % of what is seen is haze."""
DIRECTIONS = 6
"""In which a sample looks for the sky."""
TILE = 4
"""Edge length [px] of the square of pixels whose directions complete each other."""
EDGE_SAMPLES = 8
"""In a pixel with an edge, one in each of as many rows and columns."""


P = TypeVar("P", bound=np.generic)


@dataclass(frozen=True, eq=False)
class View:
    """View of one camera at one instant: device, optics and world pose."""

    device: CameraDevice
    optics: Intrinsics
    pose: Pose

    @property
    def fields(self) -> dict[str, Any]:
        """Fields of every image about its camera: sensor, intrinsics, position and orientation."""
        return {
            "sensor": self.device.name,
            "intrinsics": self.optics,
            "position": self.pose.position,
            "orientation": self.pose.orientation,
        }

    def image(self, pixels: NDArray[P]) -> NDArray[P]:
        """Values by pixel as an image.

        Args:
            pixels: Row by row from the top, Shape ``[height·width, …]``.

        Returns:
            Shape ``[height, width, …]``.
        """
        return pixels.reshape(self.device.height, self.device.width, *pixels.shape[1:])


class Painter:
    """Draws pictures of a scene. Use it under `active_variant`, after `TracedScene.update`.

    Args:
        mi: Mitsuba, with the variant that is active.
        traced: The scene for rays.
        albedo: Linear sRGB of each owner, Shape ``[owners, 3]``.
        sun: Unit vector towards the sun, world axes.
    """

    def __init__(self, mi: Any, traced: TracedScene, albedo: Float64Array, sun: Float64Array) -> None:
        self._mi, self._traced, self._sun = mi, traced, sun
        table = np.concatenate([traced.face_normals().T, albedo[traced.face_owner].T])
        if not table.size:
            table = np.zeros((6, 1))  # of a face that no ray hits: nothing can be read from an empty table
        self._table = [mi.Float(column) for column in aligned_columns(table)]

    def paint(self, view: View) -> UInt8Array:
        """Draw what a camera sees.

        Args:
            view: The camera.

        Returns:
            sRGB, Shape ``[height, width, 3]``, top row first.
        """
        width, height = view.device.width, view.device.height
        rows, columns = np.divmod(np.arange(width * height), width)
        seen = self._trace(view, columns + 0.5, rows + 0.5, (rows % TILE) * TILE + columns % TILE)
        colour, edge = self._smoothed(view, seen)
        pixels = np.flatnonzero(edge)
        if len(pixels):
            colour[:, pixels] = self._edges(view, pixels)
        return view.image(encoded(colour).T)

    def _edges(self, view: View, pixels: Int64Array) -> Float32Array:
        """Colours of pixels that are more than one thing: the mean of several points of each."""
        part = np.arange(EDGE_SAMPLES)
        # Steps of 3 mod 8 spread the points so that no two share a row or a column.
        x, y = (part + 0.5) / EDGE_SAMPLES, ((3 * part + 1) % EDGE_SAMPLES + 0.5) / EDGE_SAMPLES
        rows, columns = np.divmod(pixels[:, None], view.device.width)
        index = np.broadcast_to(part * (TILE * TILE // EDGE_SAMPLES), (len(pixels), EDGE_SAMPLES))
        seen = self._trace(view, (columns + x).ravel(), (rows + y).ravel(), index.ravel())
        colour = _stacked(seen.colour(self._mi, seen.ambient))
        mean: Float32Array = colour.reshape(3, len(pixels), EDGE_SAMPLES).mean(axis=2)
        return mean

    def _trace(self, view: View, x: Float64Array, y: Float64Array, index: Int64Array) -> _Seen:
        """Surfaces and light at points of the image [px]; ``index`` [0, 16) chooses where to look for sky."""
        import drjit as dr

        mi = self._mi
        px, py, turn = (mi.Float(column) for column in aligned_columns(np.stack([x, y, index])))
        direction = self._directions(view, px, py)
        origin = _opaque(mi.Point3f, (np.array(view.pose.position) - self._traced.centre).tolist())
        distance, face = self._traced.intersect(mi, mi.Ray3f(origin, direction))
        hit = dr.isfinite(distance)
        table = [dr.gather(mi.Float, column, face, hit) for column in self._table]
        normal = mi.Vector3f(*table[:3])
        normal = dr.select(dr.dot(normal, direction) > 0, -normal, normal)
        # Off the surface, by more where float32 is coarser: a ray from it would hit the surface itself.
        point = origin + distance * direction + normal * (2e-3 + 2e-5 * distance)
        sun = self._sunlight(point, normal, hit)
        ambient = self._skylight(point, normal, turn, hit)
        seen = _Seen(direction, distance, normal, mi.Color3f(*table[3:]), sun, ambient, hit)
        dr.eval(seen.ambient, seen.sun, seen.distance, seen.normal, seen.albedo, seen.direction, seen.hit)
        return seen

    def _directions(self, view: View, x: Any, y: Any) -> Any:
        import drjit as dr

        # Optics and pose are not compiled in: one kernel serves all cameras, wherever they turn.
        mi, optics = self._mi, view.optics
        right = (x - _opaque(mi.Float, optics.cx)) / _opaque(mi.Float, optics.fx)
        down = (y - _opaque(mi.Float, optics.cy)) / _opaque(mi.Float, optics.fy)
        forward, left, up = (
            _opaque(mi.Vector3f, column) for column in rotation_matrix(view.pose.orientation).T.tolist()
        )
        return dr.normalize(forward - right * left - down * up)

    def _sunlight(self, point: Any, normal: Any, hit: Any) -> Any:
        """Cosine at which the sun shines on a point; 0 in shadow."""
        import drjit as dr

        mi = self._mi
        towards = mi.Vector3f(self._sun.tolist())
        facing = dr.maximum(dr.dot(normal, towards), 0.0)
        lit = hit & (facing > 0)
        # Rays to the sun are parallel, so Embree may trace them in packets; those to the sky are not.
        shadow = self._traced.occluded(mi.Ray3f(point, towards), lit, coherent=True)
        return dr.select(lit & ~shadow, facing, 0.0)

    def _skylight(self, point: Any, normal: Any, turn: Any, hit: Any) -> Any:
        """Mean of what comes to a surface from all sides but the sun, weighted with the cosine."""
        import drjit as dr

        mi = self._mi
        across, along = mi.coordinate_system(normal)
        total = mi.Color3f(0.0)
        for number in range(DIRECTIONS):
            # Points of a Fibonacci spiral on the disc, lifted to the hemisphere (Malley's method), in
            # an order in which the 16 sets of neighbours interleave.
            share = (number * TILE * TILE + turn + 0.5) / (DIRECTIONS * TILE * TILE)
            angle = (number * TILE * TILE + turn) * (math.pi * (3 - math.sqrt(5)))
            radius = dr.sqrt(share)
            sine, cosine = dr.sincos(angle)
            height = dr.sqrt(dr.maximum(1 - share, 0.0))
            towards = across * (radius * cosine) + along * (radius * sine) + normal * height
            ray = mi.Ray3f(point, towards)
            ray.maxt = mi.Float(SKY_REACH)
            hidden = self._traced.occluded(ray, hit, coherent=False)
            total += dr.select(hidden, mi.Color3f(BOUNCED), SKYLIGHT * _sky(mi, towards))
        return total / DIRECTIONS

    def _smoothed(self, view: View, seen: _Seen) -> tuple[Float32Array, Any]:
        """Colours of one sample a pixel, skylight joined over each pixel's tile; where edges are."""
        import drjit as dr

        mi = self._mi
        width, height = _opaque(mi.Int32, view.device.width), _opaque(mi.Int32, view.device.height)
        index = dr.arange(mi.Int32, view.device.width * view.device.height)
        row = index // width
        column = index - row * width
        # The 16 pixels of a tile have looked in 16 sets of six directions, so their mean is that of 96. It
        # stops at edges: light does not leak from one surface to another.
        total, count, edge = mi.Color3f(seen.ambient), mi.Float(1.0), mi.Bool(False)
        for dy in range(-TILE // 2, TILE // 2):
            for dx in range(-TILE // 2, TILE // 2):
                if dx == dy == 0:
                    continue
                inside = (column + dx >= 0) & (column + dx < width) & (row + dy >= 0) & (row + dy < height)
                other = dr.select(inside, index + dy * width + dx, index)
                same = seen.same_surface(mi, other)
                total += dr.select(same, dr.gather(mi.Color3f, seen.ambient, other), 0.0)
                count += dr.select(same, mi.Float(1.0), 0.0)
        for dx, dy in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            inside = (column + dx >= 0) & (column + dx < width) & (row + dy >= 0) & (row + dy < height)
            other = dr.select(inside, index + dy * width + dx, index)
            edge |= ~seen.same_picture(mi, other)
        colour = seen.colour(mi, total / count)
        dr.eval(colour, edge)
        return _stacked(colour), edge.numpy()


@dataclass(frozen=True, eq=False)
class _Seen:
    """Surfaces and light that samples of a picture see, as Dr.Jit arrays."""

    direction: Any
    distance: Any
    normal: Any
    albedo: Any
    sun: Any
    """Cosine at which the sun shines on it; 0 in shadow."""
    ambient: Any
    """Light from everywhere else."""
    hit: Any

    def same_surface(self, mi: Any, other: Any) -> Any:
        """Test whether each sample and its ``other`` one lie in one smooth surface."""
        import drjit as dr

        between = dr.gather(mi.Float, self.distance, other) * dr.gather(mi.Vector3f, self.direction, other)
        between -= self.distance * self.direction
        # In one plane, within what a curved surface bends between two pixels that far away.
        flat = dr.abs(dr.dot(between, self.normal)) < 0.02 + 2e-3 * self.distance
        alike = dr.dot(dr.gather(mi.Vector3f, self.normal, other), self.normal) > 0.9
        return self.hit & dr.gather(mi.Bool, self.hit, other) & flat & alike

    def same_picture(self, mi: Any, other: Any) -> Any:
        """Test whether no edge of a surface, a colour or a shadow runs between each sample and its other."""
        import drjit as dr

        both = dr.gather(mi.Bool, self.hit, other)
        light = dr.abs(dr.gather(mi.Float, self.sun, other) - self.sun) < 0.1
        paint = dr.gather(mi.Color3f, self.albedo, other) - self.albedo
        paint = dr.abs(paint.x) + dr.abs(paint.y) + dr.abs(paint.z) < 0.02
        return (~self.hit & ~both) | (self.same_surface(mi, other) & light & paint)

    def colour(self, mi: Any, ambient: Any) -> Any:
        """Linear sRGB under this ``ambient`` light, seen through the air."""
        import drjit as dr

        light = mi.Color3f(SUN) * self.sun + ambient
        # Beer and Lambert: of the light of a surface, exp(−way/HAZE) comes through.
        haze = 1 - dr.exp(-self.distance / HAZE)
        seen = dr.lerp(self.albedo * light, mi.Color3f(HORIZON), haze)
        return dr.select(self.hit, seen, _sky(mi, self.direction))


def encoded(colour: Float32Array) -> UInt8Array:
    """Encode linear colours as 8-bit sRGB (IEC 61966-2-1); what is too bright is cut off.

    Args:
        colour: Linear sRGB, any shape.

    Example:
        >>> encoded(np.array([0.0, 0.5, 2.0], np.float32)).tolist()
        [0, 188, 255]
    """
    # A table instead of a power for each pixel; even where the curve is steepest, five of its steps are one
    # of 8 bits.
    table: UInt8Array = _SRGB[(np.clip(colour, 0, 1) * (len(_SRGB) - 1) + 0.5).astype(np.int32)]
    return table


def _srgb_table(size: int = 1 << 14) -> UInt8Array:
    linear = np.arange(size) / (size - 1)
    curve = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.round(255 * curve).astype(np.uint8)


_SRGB = _srgb_table()


def _sky(mi: Any, direction: Any) -> Any:
    """Radiance from a direction without anything in it; below the horizon that of the haze."""
    import drjit as dr

    height = dr.sqrt(dr.maximum(direction.z, 0.0))
    return dr.lerp(mi.Color3f(HORIZON), mi.Color3f(ZENITH), height)


def _opaque(kind: Any, value: Any) -> Any:
    """A value that changes from frame to frame without becoming part of the compiled kernel."""
    import drjit as dr

    made = kind(value)
    dr.make_opaque(made)
    return made


def _stacked(colour: Any) -> Float32Array:
    """Rows red, green, blue of a Dr.Jit colour, in one evaluation."""
    import drjit as dr

    dr.eval(colour)
    return np.stack([channel.numpy() for channel in colour])


Colour = tuple[float, float, float]

MATERIALS: dict[str, Colour] = {
    "concrete": (0.62, 0.61, 0.60),
    "marble": (0.86, 0.80, 0.70),
    "brick": (0.66, 0.41, 0.33),
    "wood": (0.64, 0.50, 0.36),
    "glass": (0.52, 0.64, 0.70),
    "metal": (0.50, 0.54, 0.60),
    "plasterboard": (0.87, 0.86, 0.82),
    "ceiling_board": (0.88, 0.88, 0.86),
    "chipboard": (0.72, 0.60, 0.44),
    "plywood": (0.76, 0.64, 0.47),
    "floorboard": (0.58, 0.44, 0.31),
    "very_dry_ground": (0.66, 0.58, 0.44),
    "medium_dry_ground": (0.48, 0.47, 0.32),
    "wet_ground": (0.38, 0.36, 0.26),
}
"""sRGB, 0…1, of a surface of each material of Recommendation ITU-R P.2040."""

CLASSES: dict[str, Colour] = {
    "car": (0.78, 0.36, 0.31),
    "bus": (0.93, 0.74, 0.25),
    "truck": (0.25, 0.47, 0.74),
    "pedestrian": (0.20, 0.60, 0.45),
    "uav": (0.93, 0.50, 0.16),
}
"""sRGB, 0…1, of the moving objects of each class."""

OTHER: Colour = (0.62, 0.60, 0.62)
"""Where neither material nor class is known."""

SHAPE_SHADES, OBJECT_SHADES = 0.2, 0.45
"""Things of one colour differ by up to this share, so that neighbours look different."""


def linear(colour: Colour | Float32Array | Float64Array) -> Float64Array:
    """Decode sRGB to linear sRGB, 0…1 (IEC 61966-2-1).

    Args:
        colour: sRGB, 0…1, of any shape.

    Example:
        >>> linear((1.0, 0.5, 0.0)).round(3).tolist()
        [1.0, 0.214, 0.0]
    """
    value = np.array(colour, dtype=np.float64)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def shape_colour(shape: SceneryShape, chosen: Mapping[str, Colour]) -> Float64Array:
    """Choose the colour of a shape of the scenery.

    It is what was chosen for its material, else its own colour, else that of its ITU material; parts of
    one building (``town_hall-itu_marble``, ``town_hall-itu_metal``) are lighter or darker together.

    Args:
        shape: The shape.
        chosen: sRGB by name of a material.

    Returns:
        Linear sRGB, Shape ``[3]``.
    """
    for name in (shape.material, shape.itu_material):
        if name in chosen:
            return linear(chosen[name])
    if shape.colour is not None:
        return np.array(shape.colour)
    return shaded(
        linear(MATERIALS.get(shape.itu_material, OTHER)), shape.name.partition("-itu_")[0], SHAPE_SHADES
    )


def object_colour(kind: str, name: str, chosen: Mapping[str, Colour]) -> Float64Array:
    """Choose the colour of a moving object.

    Args:
        kind: Class of the object.
        name: Name of the object, which chooses its shade.
        chosen: sRGB by class.

    Returns:
        Linear sRGB, Shape ``[3]``.

    Example:
        >>> bool((object_colour("car", "car.1", {}) == object_colour("car", "car.2", {})).all())
        False
    """
    return shaded(linear(chosen.get(kind) or CLASSES.get(kind, OTHER)), name, OBJECT_SHADES)


def shaded(colour: Float64Array, name: str, share: float) -> Float64Array:
    """Shade a colour, the same way for the same name.

    Args:
        colour: Linear sRGB, Shape ``[3]``.
        name: Name of the thing.
        share: By how much it gets lighter or darker at most.

    Returns:
        Linear sRGB, Shape ``[3]``.

    Example:
        >>> grey = np.array([0.5, 0.5, 0.5])
        >>> bool((shaded(grey, "car.1", 0.2) == shaded(grey, "car.1", 0.2)).all())
        True
    """
    # CRC-32, not `hash`, which Python makes different in each process.
    value = zlib.crc32(name.encode())
    light, warm = ((value >> shift & 0xFFFF) / 0x7FFF - 1 for shift in (0, 16))
    factor = 1 + share * (0.7 * light + 0.3 * warm * np.array([1.0, 0.0, -1.0]))
    return np.clip(colour * factor, 0.0, 1.0)
