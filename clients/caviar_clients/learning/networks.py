"""Networks that rank pairs of beams for one user: `BeamNetwork`, and the base of classes of the user's own.

A network gets rows of the parts that a user observes, and gives a score for each pair of beams. What it does
to a row without learning, such as to find the receiver in a LIDAR grid, stands in `BeamModel.reduce`:
training does that once for each user, and not in every epoch; an exported policy has both in one file.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

from caviar_protocol.errors import ScenarioError

try:
    import torch
    from torch import nn
    from torch.nn.functional import avg_pool2d
except ImportError:  # `supervised.train_classifier` says what is missing, before this module is needed
    nn = None

Tensors = Mapping[str, Any]
Shapes = Mapping[str, tuple[int, ...]]

_Module: Any = object if nn is None else nn.Module

_PLACE = ("position", "departure", "aoa")
OBSERVED: Mapping[str, tuple[str, ...]] = {
    "position": _PLACE,
    "lidar": ("lidar_grid",),
    "image": ("camera", *_PLACE),
    "fusion": (*_PLACE, "lidar_grid"),
}
"""Models by name, with the parts that they observe where an experiment names none. A position is three of
them: in the world, and as the directions that both arrays see it under, in which beams are evenly spaced and
which mean the same at another station. A picture that all users share does not say which of them is meant: so
``image`` has the position, too."""
SMALL = ("lidar",)
"""Models of at most 10,000 parameters: the winner of the ITU challenge ML5G-PHY had 7,462."""
WAVES = {"position": 16, "last_beam": 16, "aod": 32, "aoa": 32, "departure": 32}
"""Sines and cosines of a part, as of an encoding (`caviar_clients.learning.experiment.Encoding`)."""
PICTURE = (36, 64)
"""Rows and columns that pictures are reduced to, or a few more, by means of whole pixels."""
LINE, FINE, STEPS = 24, 8, 32
"""Parts of the straight line from RX to TX by shares of the distance, points of each at which a LIDAR grid is
looked at, and points cell by cell from RX on."""
AROUND = (16, 6)
"""Cells to each side of RX that are looked at, along the longer and the shorter axis of the ground."""
MARKED = {"tx": -1, "rx": -2}
"""Cells of a LIDAR grid that have the devices."""


class BeamModel(_Module):  # type: ignore[misc]  # torch is not looked at
    """Base of networks that rank pairs of beams.

    Subclasses take ``shapes``, of one row of each part that is observed, and ``beams``, the sizes Nt and Nr
    of the codebooks; further arguments come from ``options`` of the experiment's ``[model]``. They implement
    ``forward``, which takes what `reduce` gives, by name, and returns scores of Shape ``[N, Nt·Nr]``.
    """

    def reduce(self, rows: Tensors) -> dict[str, Any]:
        """Do to rows of parts what needs no learning.

        Args:
            rows: By part, Shape ``[N, …]`` and of the dtype of the observation.

        Returns:
            By any names what ``forward`` takes, Shape ``[N, …]``.
        """
        return dict(rows)

    def fit(self, rows: Tensors) -> None:
        """Set constants, such as those of a normalisation, from the rows that are trained on.

        Args:
            rows: As `reduce` gave them.
        """


class BeamNetwork(BeamModel):
    """Encoders of parts, joined, and a layer of scores.

    Args:
        shapes: Of a row of each part.
        beams: Nt and Nr.
        units: Of the layers that join the parts.
        dropout: Share of these units that a step of training leaves out.
        small: At most 10,000 parameters: scores of a pair are a sum and a product of those of its two beams.

    Raises:
        ScenarioError: A part has a shape that no encoder takes.

    Example:
        >>> model = BeamNetwork({"position": (3,)}, (16, 4))
        >>> model(model.reduce({"position": torch.zeros(2, 3)})).shape
        torch.Size([2, 64])
    """

    def __init__(
        self,
        shapes: Shapes,
        beams: Sequence[int],
        units: Sequence[int] = (256, 256),
        dropout: float = 0.5,
        small: bool = False,
    ) -> None:
        super().__init__()
        self._shapes, self._small = dict(shapes), small
        self.encoders = nn.ModuleDict()
        width = 0
        for name, shape in shapes.items():
            encoder = _encoder(name, shape, small, "position" in shapes)
            self.encoders[_key(name)] = encoder
            width += encoder.width
        sizes = [width, *((24,) if small else units)]
        layers: list[Any] = []
        for a, b in pairwise(sizes):
            layers += [nn.Linear(a, b), nn.ReLU(), nn.Dropout(0.0 if small else dropout)]
        self.joined = nn.Sequential(*layers)
        self.scores = _Product(sizes[-1], *beams) if small else nn.Linear(sizes[-1], beams[0] * beams[1])

    def reduce(self, rows: Tensors) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for name in self._shapes:
            of_part = self.encoders[_key(name)].reduce(rows[name])
            found |= {f"{name}/{what}": value for what, value in of_part.items()}
        return found

    def fit(self, rows: Tensors) -> None:
        for name in self._shapes:
            self.encoders[_key(name)].fit(_of(rows, name))

    def forward(self, rows: Tensors) -> Any:
        found = [self.encoders[_key(name)](_of(rows, name)) for name in self._shapes]
        return self.scores(self.joined(torch.cat(found, dim=1)))


def _key(part: str) -> str:
    return part.replace(".", "_")  # PyTorch has dots between the names of modules


def _of(rows: Tensors, part: str) -> dict[str, Any]:
    return {name[len(part) + 1 :]: value for name, value in rows.items() if name.startswith(f"{part}/")}


def _encoder(name: str, shape: tuple[int, ...], small: bool, placed: bool) -> Any:
    kind = name.partition(":")[0]
    if len(shape) == 1:
        return _Numbers(shape[0], WAVES.get(kind, 0))
    if kind == "lidar_grid" and len(shape) == 3:
        return _Grid(shape, small, placed)
    if len(shape) == 2 or (len(shape) == 3 and shape[2] == 3):
        return _Picture(shape)
    raise ScenarioError(
        f"observation {name!r} has a row of shape {list(shape)}, which no encoder takes; give a class "
        "of your own as the model"
    )


class _Product(_Module):  # type: ignore[misc]
    """Scores a_t + b_r + c_t·d_r of all pairs: few parameters, and the two ends are not independent."""

    def __init__(self, units: int, tx: int, rx: int) -> None:
        super().__init__()
        self._sizes = (tx, rx, tx, rx)
        self.layer = nn.Linear(units, sum(self._sizes))

    def forward(self, x: Any) -> Any:
        a, b, c, d = torch.split(self.layer(x), self._sizes, dim=1)
        return (a[:, :, None] + b[:, None] + c[:, :, None] * d[:, None]).flatten(1)


class _Numbers(_Module):  # type: ignore[misc]
    """Numbers z of mean 0 and within about ±1, with sin(kπz/2) and cos(kπz/2) of k = 1 … waves."""

    def __init__(self, size: int, waves: int) -> None:
        super().__init__()
        self.width = size * (1 + 2 * waves)
        self.register_buffer("offset", torch.zeros(size))
        self.register_buffer("scale", torch.ones(size))
        self.register_buffer("waves", torch.arange(1, waves + 1) * math.pi / 2)

    def reduce(self, rows: Any) -> dict[str, Any]:
        return {"numbers": rows.float()}

    def fit(self, rows: Tensors) -> None:
        low, high = rows["numbers"].amin(0), rows["numbers"].amax(0)
        self.offset.copy_((low + high) / 2)
        self.scale.copy_(torch.where(high > low, (high - low) / 2, torch.ones_like(high)))

    def forward(self, rows: Tensors) -> Any:
        # What lies outside of the training's range would be on another wave's place.
        z = ((rows["numbers"] - self.offset) / self.scale).clamp(-1.5, 1.5)
        if not len(self.waves):
            return z
        phase = (z[:, :, None] * self.waves).flatten(1)
        return torch.cat([z, torch.sin(phase), torch.cos(phase)], dim=1)


class _Grid(_Module):  # type: ignore[misc]
    """A LIDAR grid: what stands on the straight line between TX and RX, what stands around RX, by
    convolutions with layers of height as channels, and unless that is known better, where RX is and its
    direction from TX."""

    def __init__(self, shape: tuple[int, ...], small: bool, placed: bool) -> None:
        super().__init__()
        self._shape, self._placed = shape, placed
        # The longer axis of the ground first, whichever of x and y it is.
        self._swap = shape[1] > shape[0]
        self._half = (AROUND[1], AROUND[0]) if self._swap else AROUND
        self._layer = max(1, shape[2] // 5)
        layers = -(-shape[2] // self._layer)
        first, second, units = (4, 4, 12) if small else (8, 16, 48)
        self.around = nn.Sequential(
            nn.Conv2d(layers, first, 3, 2, 1), nn.ReLU(),
            nn.Conv2d(first, second, 3, 2, 1), nn.ReLU(), nn.Flatten(),
        )  # fmt: skip
        with torch.no_grad():
            blank = self.reduce(torch.zeros((1, *shape), dtype=torch.int8))
            flat = self.around(blank["around"].float()).shape[1]
        self.dense = nn.Sequential(nn.Linear(flat, units), nn.ReLU(), nn.Dropout(0.0 if small else 0.3))
        self.rx, self.direction = _Numbers(3, 4 if small else 16), _Numbers(3, 10 if small else 32)
        self.width = units + blank["line"].shape[1]
        if not placed:
            self.width += self.rx.width + self.direction.width

    def reduce(self, rows: Any) -> dict[str, Any]:
        _, y, z = self._shape
        flat = rows.flatten(1)
        # RX is the least value of a grid and TX the next: a search for bytes, of 40,000 for each user.
        rx_at = flat.argmin(dim=1, keepdim=True)
        tx_at = torch.where(flat == MARKED["rx"], torch.zeros_like(flat), flat).argmin(dim=1, keepdim=True)
        has_tx = (torch.gather(flat, 1, tx_at) == MARKED["tx"]).float()
        tx, rx = self._cell(tx_at), self._cell(rx_at)
        away = rx - tx
        # Cells from RX to TX, by shares of the distance and one by one; those beyond TX count for nothing.
        length = away.abs().amax(dim=1, keepdim=True).clamp(min=1)
        shares = torch.arange(1, LINE * FINE + 1, device=rows.device) / (LINE * FINE + 1)
        steps = torch.arange(1, STEPS + 1, device=rows.device) / length
        back = torch.cat([shares + torch.zeros_like(length), steps], dim=1)
        point = torch.round(rx[:, None] - away[:, None] * back.clamp(max=1)[:, :, None]).long()
        index = (point[..., 0] * y + point[..., 1]) * z + point[..., 2]
        met = (torch.gather(flat, 1, index) > 0).float() * has_tx * (back < 1).float()
        parts, cells = met[:, : LINE * FINE].reshape(-1, LINE, FINE), met[:, LINE * FINE :]
        return {
            "rx": rx,
            "direction": away / torch.linalg.vector_norm(away, dim=1, keepdim=True).clamp(min=1),
            "line": torch.cat([parts.amax(dim=2), cells, has_tx], dim=1),
            "around": self._around(flat, rx.long()),
        }

    def _around(self, flat: Any, rx: Any) -> Any:
        """Whether cells around RX are occupied, the greatest of each layer, Shape ``[N, layers, …]``."""
        (a, b), (x, y, z) = self._half, self._shape
        i = rx[:, :1] + torch.arange(-a, a + 1, device=flat.device)
        j = rx[:, 1:2] + torch.arange(-b, b + 1, device=flat.device)
        inside = ((i >= 0) & (i < x))[:, :, None] & ((j >= 0) & (j < y))[:, None]
        ground = i.clamp(0, x - 1)[:, :, None] * y + j.clamp(0, y - 1)[:, None]
        index = ground[..., None] * z + torch.arange(z, device=flat.device)
        cells = torch.gather(flat, 1, index.flatten(1)).reshape(-1, 2 * a + 1, 2 * b + 1, z)
        cells = ((cells > 0) & inside[..., None]).to(torch.uint8)
        heights = [cells[..., low : low + self._layer].amax(dim=-1) for low in range(0, z, self._layer)]
        found = torch.stack(heights, dim=1)
        return found.transpose(2, 3) if self._swap else found

    def _cell(self, at: Any) -> Any:
        """Index of a cell along each axis, Shape ``[N, 3]``, of that in all, Shape ``[N, 1]``."""
        _, y, z = self._shape
        row = torch.div(at, z, rounding_mode="floor")
        x = torch.div(row, y, rounding_mode="floor")
        return torch.cat([x, row - x * y, at - row * z], dim=1).float()

    def fit(self, rows: Tensors) -> None:
        self.rx.fit({"numbers": rows["rx"]})
        self.direction.fit({"numbers": rows["direction"]})

    def forward(self, rows: Tensors) -> Any:
        parts = [self.dense(self.around(rows["around"].float())), rows["line"]]
        if not self._placed:
            parts += [self.rx({"numbers": rows["rx"]}), self.direction({"numbers": rows["direction"]})]
        return torch.cat(parts, dim=1)


class _Picture(_Module):  # type: ignore[misc]
    """A picture or a depth image, reduced to `PICTURE`, by convolutions."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        super().__init__()
        channels = shape[2] if len(shape) == 3 else 1
        self.register_buffer("offset", torch.zeros(channels, 1, 1))
        self.register_buffer("scale", torch.ones(channels, 1, 1))
        self.layers = nn.Sequential(
            nn.Conv2d(channels, 8, 5, 2, 2), nn.ReLU(),
            nn.Conv2d(8, 16, 3, 2, 1), nn.ReLU(),
            nn.Conv2d(16, 16, 3, 2, 1), nn.ReLU(), nn.Flatten(),
        )  # fmt: skip
        self._pool = tuple(max(1, size // most) for size, most in zip(shape, PICTURE, strict=False))
        with torch.no_grad():
            blank = self.reduce(torch.zeros((1, *shape), dtype=torch.uint8))["picture"]
            flat = self.layers(blank).shape[1]
        self.width = 64
        self.dense = nn.Sequential(nn.Linear(flat, self.width), nn.ReLU())

    def reduce(self, rows: Any) -> dict[str, Any]:
        picture = rows.float()
        picture = picture.permute(0, 3, 1, 2) if picture.dim() == 4 else picture[:, None]
        return {"picture": avg_pool2d(picture, self._pool)}

    def fit(self, rows: Tensors) -> None:
        self.offset.copy_(rows["picture"].mean((0, 2, 3))[:, None, None])
        self.scale.copy_(rows["picture"].std((0, 2, 3))[:, None, None].clamp(min=1e-6))

    def forward(self, rows: Tensors) -> Any:
        return self.dense(self.layers((rows["picture"] - self.offset) / self.scale))
