"""What colour things have in a picture: by material for scenery, by class for moving objects."""

from __future__ import annotations

import zlib
from collections.abc import Mapping

import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_services.scenery import SceneryShape

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
"""Things of one colour differ by up to this share, so that neighbours can be told apart."""


def linear(colour: Colour) -> Float64Array:
    """Linear sRGB of an sRGB colour, 0…1 (IEC 61966-2-1)."""
    value = np.array(colour, dtype=np.float64)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def shape_colour(shape: SceneryShape, chosen: Mapping[str, Colour]) -> Float64Array:
    """Linear sRGB of a shape of the scenery, Shape ``[3]``.

    By what was ``chosen`` for its material, else its own colour, else that of its ITU material; parts of
    one building (``town_hall-itu_marble``, ``town_hall-itu_metal``) are lighter or darker together.
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
    """Linear sRGB of a moving object of class ``kind``, Shape ``[3]``."""
    return shaded(linear(chosen.get(kind) or CLASSES.get(kind, OTHER)), name, OBJECT_SHADES)


def shaded(colour: Float64Array, name: str, share: float) -> Float64Array:
    """A shade of a colour, lighter or darker by up to a ``share``, the same for the same name."""
    value = zlib.crc32(name.encode())
    light, warm = ((value >> shift & 0xFFFF) / 0x7FFF - 1 for shift in (0, 16))
    factor = 1 + share * (0.7 * light + 0.3 * warm * np.array([1.0, 0.0, -1.0]))
    return np.clip(colour * factor, 0.0, 1.0)
