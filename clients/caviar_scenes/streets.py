"""Crossings of two streets with planted materials: scenes whose true materials are known, and their pictures.

Buildings of random sizes stand around a crossing; each wall is of a material of its own above the ground
floor and another, at times, below. Pictures are our renderer's with a pattern of each material, not with one
colour: bricks in their bond, panels of concrete, panes, boards, ribs of sheet metal, in tints that differ
from building to building. Walls that are not of glass have windows, which are of glass in the true picture
and no faces of the model, as in most models of cities.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array, UInt8Array
from caviar_protocol.topics import CameraDevice
from caviar_scenes.views import Eye
from caviar_space.imported_scenes import ImportedScene, Piece
from caviar_space.meshes import Mesh
from caviar_space.mitsuba_xml import RadioMaterial

MATERIALS = ("concrete", "brick", "glass", "wood", "metal", "asphalt_concrete", "medium_dry_ground")
"""Materials in ITU-R P.2040 that are planted."""
SKY = len(MATERIALS)
"""Number of the sky in a true picture."""
_WALLS = {"concrete": 0.35, "brick": 0.3, "glass": 0.15, "wood": 0.1, "metal": 0.1}
_GREY = 0.4


@dataclass(eq=False)
class Street:
    """A crossing: its model, in which all is of concrete, and what is known of it."""

    scene: ImportedScene
    truth: dict[str, list[str]]
    """Material of each face, by name of the piece."""
    style: dict[str, list[int]]
    """Number that chooses the tint of each face."""
    half_width_m: tuple[float, float]
    """Of the street along x, and of that along y."""
    _eye: Eye | None = field(default=None, repr=False)

    @property
    def eye(self) -> Eye:
        """The scene for cameras."""
        if self._eye is None:
            self._eye = Eye({name: piece.mesh for name, piece in self.scene.pieces.items()})
        return self._eye

    def picture(self, device: CameraDevice) -> tuple[UInt8Array, Int64Array]:
        """Draw what a camera sees, and the true picture.

        Args:
            device: The camera.

        Returns:
            sRGB, Shape ``[H, W, 3]``, and the number of the material of each pixel, or `SKY`, ``[H, W]``.
        """
        from caviar_services.sensors.shading import encoded, linear

        eye, seen = self.eye, self.eye.look(device)
        grey = eye.paint(device, np.full((len(eye.names), 3), _GREY))
        light = linear(grey / 255.0) / _GREY
        labels = np.full(seen.face.shape, SKY, np.int64)
        colours = light * _GREY
        materials = [m for name in eye.names for m in self.truth[name]]
        styles = np.array([s for name in eye.names for s in self.style[name]])
        of_face = np.array([MATERIALS.index(material) for material in materials])
        met = seen.face >= 0
        face, points = seen.face[met], seen.points[met]
        normal = eye.normals[face].astype(np.float64)
        flat = np.abs(normal[:, 2]) > 0.7
        along = np.where(flat, points[:, 0], normal[:, 0] * points[:, 1] - normal[:, 1] * points[:, 0])
        up = np.where(flat, points[:, 1], points[:, 2])
        albedo, labels[met] = _patterns(of_face[face], styles[face], along, up, flat)
        colours[met] = light[met] * albedo
        # Sensors' noise, the same for the same picture.
        noise = np.random.default_rng(abs(hash(device.position)) % 2**32).normal(0, 2.0, colours.shape)
        rgb = encoded(colours.astype(np.float32)) + noise
        return np.clip(np.rint(rgb), 0, 255).astype(np.uint8), labels


def street(seed: int) -> Street:
    """Make a crossing; the same number makes the same one.

    Args:
        seed: Of sizes, materials and tints.
    """
    rng = np.random.default_rng(seed)
    wx, wy = rng.uniform(8, 13), rng.uniform(6, 11)
    scene = ImportedScene(name=f"street-{seed}", materials={"concrete": RadioMaterial("concrete")})
    made = Street(scene, {}, {}, (float(wx), float(wy)))
    walls = {name: weight * rng.uniform(0.3, 1.7) for name, weight in _WALLS.items()}
    total = sum(walls.values())
    names, weights = list(walls), [weight / total for weight in walls.values()]
    number = 0
    for sx in (-1, 1):
        for sy in (-1, 1):
            # The building at the corner, then others along both streets.
            w, d = rng.uniform(14, 24, 2)
            plots = [(wy, wy + w, wx, wx + d)]
            x = wy + w + rng.choice([0.0, 4.0])
            while x < 70:
                width, depth = rng.uniform(10, 22), rng.uniform(10, 18)
                plots.append((x, x + width, wx, wx + depth))
                x += width + rng.choice([0.0, 0.0, 4.0])
            y = wx + d + rng.choice([0.0, 4.0])
            while y < 70:
                width, depth = rng.uniform(10, 22), rng.uniform(8, 12)
                plots.append((wy, wy + depth, y, y + width))
                y += width + rng.choice([0.0, 0.0, 4.0])
            for x0, x1, y0, y1 in plots:
                xs, ys = sorted((sx * float(x0), sx * float(x1))), sorted((sy * float(y0), sy * float(y1)))
                _add_building(made, f"b{number:02d}", xs, ys, rng, names, weights)
                number += 1
    far = 95.0
    mesh, tops = _quads([_rectangle((-far, far), (-far, far), 0.0)])
    road = str(rng.choice(["asphalt_concrete", "asphalt_concrete", "concrete"]))
    _add(made, "ground", mesh, [road], tops, rng)
    verges = [
        _rectangle((a, b), (c, d), 0.05)
        for a, b in ((-far, -75.0), (75.0, far))
        for c, d in ((-far, -wx), (wx, far))
    ]
    mesh, tops = _quads(verges)
    _add(made, "verge", mesh, ["medium_dry_ground"] * 4, tops, rng)
    return made


def _rectangle(x: tuple[float, float], y: tuple[float, float], z: float) -> list[tuple[float, float, float]]:
    return [(x[0], y[0], z), (x[1], y[0], z), (x[1], y[1], z), (x[0], y[1], z)]


def _quads(quads: list[list[tuple[float, float, float]]]) -> tuple[Mesh, int]:
    vertices = np.array(quads, np.float64).reshape(-1, 3)
    halves = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    faces = 4 * np.arange(len(quads), dtype=np.int32)[:, None, None] + halves
    return Mesh(vertices, faces.reshape(-1, 3)), len(quads)


def _add(
    made: Street, name: str, mesh: Mesh, materials: list[str], quads: int, rng: np.random.Generator
) -> None:
    kind = "ground" if name in ("ground", "verge") else "building"
    made.scene.pieces[name] = Piece(mesh, "concrete", kind, "street", 1)
    made.truth[name] = [material for material in materials for _ in range(2)]
    made.style[name] = [int(style) for style in rng.integers(0, 1 << 16, quads) for _ in range(2)]


def _add_building(
    made: Street,
    name: str,
    x: list[float],
    y: list[float],
    rng: np.random.Generator,
    names: list[str],
    weights: list[float],
) -> None:
    height, shop = rng.uniform(9, 28), rng.uniform(3.5, 5.0)
    (x0, x1), (y0, y1) = x, y
    corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    upper = str(rng.choice(names, p=weights))
    lower = str(rng.choice(names, p=weights)) if rng.random() < 0.4 else upper
    quads, materials = [], []
    for k in range(4):
        a, b = corners[k], corners[(k + 1) % 4]
        for z0, z1, material in ((0.0, shop, lower), (shop, height, upper)):
            quads.append([(*a, z0), (*b, z0), (*b, z1), (*a, z1)])
            materials.append(material)
    quads.append([(*corner, height) for corner in corners])
    materials.append(str(rng.choice(["concrete", "concrete", "metal"])))
    mesh, count = _quads(quads)
    _add(made, name, mesh, materials, count, rng)
    # One tint a storey of a building, not one a wall.
    tints = rng.integers(0, 1 << 16, 3)
    made.style[name] = [int(tints[k]) for k in [0, 0, 1, 1] * 4 + [2, 2]]


_TINTS = {
    "concrete": [(0.60, 0.59, 0.57), (0.72, 0.71, 0.68), (0.50, 0.50, 0.52), (0.76, 0.72, 0.64)],
    "brick": [(0.58, 0.30, 0.22), (0.48, 0.25, 0.20), (0.70, 0.52, 0.36), (0.62, 0.38, 0.30)],
    "glass": [(0.32, 0.42, 0.48), (0.24, 0.34, 0.44), (0.38, 0.48, 0.46), (0.20, 0.26, 0.30)],
    "wood": [(0.52, 0.38, 0.24), (0.44, 0.30, 0.18), (0.64, 0.50, 0.34), (0.40, 0.34, 0.28)],
    "metal": [(0.62, 0.64, 0.66), (0.44, 0.50, 0.56), (0.30, 0.36, 0.34), (0.66, 0.62, 0.58)],
    "asphalt_concrete": [(0.30, 0.30, 0.31), (0.36, 0.36, 0.36), (0.25, 0.25, 0.27), (0.33, 0.32, 0.30)],
    "medium_dry_ground": [(0.36, 0.44, 0.22), (0.42, 0.46, 0.28), (0.34, 0.38, 0.20), (0.46, 0.42, 0.30)],
}
"""sRGB of tints of each material."""


def _patterns(
    material: Int64Array, style: Int64Array, u: Float64Array, v: Float64Array, flat: BoolArray
) -> tuple[Float64Array, Int64Array]:
    """Linear sRGB and material of points of surfaces, ``[N, 3]`` and ``[N]``; u along them, v upwards [m]."""
    from caviar_services.sensors.shading import linear

    tints = np.array([_TINTS[name] for name in MATERIALS])
    base: Float64Array = linear(tints)[material, style % 4]
    # Of the tint a little more of one colour or another.
    hue: Float64Array = style[:, None] * 7.0 + np.arange(3.0)
    base *= 0.85 + 0.3 * _random(hue, 3)
    label = material.copy()
    shade = np.ones(len(u))

    def of(name: str) -> BoolArray:
        found: BoolArray = material == MATERIALS.index(name)
        return found

    row, course = np.floor(v / 0.24), v / 0.24 % 1
    column = u / 0.5 + 0.5 * (row % 2)
    mortar = (course < 0.14) | (column % 1 < 0.07)
    bricks = np.where(mortar, 1.35, 0.75 + 0.5 * _random(np.floor(column) * 131 + row, 1))
    panel = 0.92 + 0.12 * _random(np.floor(u / 3.1) * 17 + np.floor(v / 2.9), 2)
    joints = np.where((u / 3.1 % 1 < 0.02) | (v / 2.9 % 1 < 0.02), 0.65, panel)
    pane = 0.6 + 0.9 * _random(np.floor(u / 1.5) * 29 + np.floor(v / 1.75) + style, 4)
    panes = np.where((u / 1.5 % 1 < 0.06) | (v / 1.75 % 1 < 0.06), 0.35, pane)
    boards = np.where(u / 0.3 % 1 < 0.08, 0.5, 0.75 + 0.45 * _random(np.floor(u / 0.3) + style, 5))
    ribs = 0.85 + 0.35 * np.sin(2 * np.pi * u / 0.4)
    grain = 0.85 + 0.3 * _random(np.floor(u / 0.15) * 51 + np.floor(v / 0.15), 6)
    for name, values in (
        ("concrete", joints), ("brick", bricks), ("glass", panes), ("wood", boards), ("metal", ribs),
        ("asphalt_concrete", grain), ("medium_dry_ground", 0.6 + (grain - 0.85) * 2.5),
    ):  # fmt: skip
        shade = np.where(of(name), values, shade)
    # Windows of walls, not of all: 1.2 m by 1.5 m on each storey of 3 m.
    walls = ~flat & (of("concrete") | of("brick") | of("wood")) & (style % 5 > 0)
    window = walls & (u / 2.8 % 1 > 0.55) & (v / 3.0 % 1 > 0.3) & (v / 3.0 % 1 < 0.8)
    label[window] = MATERIALS.index("glass")
    dark = 0.5 + 0.9 * _random(np.floor(u / 2.8) * 43 + np.floor(v / 3.0) + style, 7)
    glass = linear(tints)[MATERIALS.index("glass"), 1] * dark[:, None]
    return np.where(window[:, None], glass, np.clip(base * shade[:, None], 0, 1)), label


def _random(key: Float64Array, salt: int) -> Float64Array:
    """Numbers 0…1 that look random, the same for the same keys."""
    value = np.sin(np.asarray(key, np.float64) * 12.9898 + salt * 78.233) * 43758.5453
    part: Float64Array = value - np.floor(value)
    return part
