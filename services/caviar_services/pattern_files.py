"""Element patterns from files: tables of gain or of the complex far field, and MSI/Planet files.

A table is a CSV file, ``.csv``, with one direction a line, all zenith angles combined with all azimuths:

- ``theta_deg,phi_deg,gain_dbi``: the gain; the polarization is that of the array, or
- ``theta_deg,phi_deg,e_theta_re,e_theta_im,e_phi_re,e_phi_im``: the far field along θ̂ and φ̂, so that
  ``|E_θ|² + |E_φ|²`` is the gain as a factor.

Lines that begin with ``#`` are comments. Angles are those of the device: zenith from +z, 0° to 180°,
azimuth counter-clockwise from +x, once around. Between the directions of a table, the gain [dB] or the
field is bilinear in both angles.

An MSI/Planet file, ``.msi`` or ``.pln``, has a horizontal and a vertical cut as attenuation [dB] against
``GAIN`` (dBd unless it says dBi). Horizontal angles count clockwise from boresight, vertical ones downwards
from the horizon; the number after ``HORIZONTAL`` and ``VERTICAL`` is that of the lines that follow. The
directions between follow by summing: the attenuation is that of the horizontal cut at the azimuth plus that
of the front half of the vertical cut at the elevation (T. G. Vasiliadis, A. G. Dimitriou and G. D. Sergiadis,
"A novel technique for the approximation of 3-D antenna radiation patterns", IEEE Trans. Antennas Propag.
53(7), 2005).
"""

from __future__ import annotations

import codecs
import math
import os
import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from caviar_protocol.arrays import Complex128Array, Float64Array, Int64Array
from caviar_protocol.errors import AssetError
from caviar_protocol.fields import MAX_BODY
from caviar_protocol.files import open_regular

SUFFIXES = (".csv", ".msi", ".pln")

GAIN = ("theta_deg", "phi_deg", "gain_dbi")
FIELD = ("theta_deg", "phi_deg", "e_theta_re", "e_theta_im", "e_phi_re", "e_phi_im")

_MARKS = {codecs.BOM_UTF8: "utf-8", codecs.BOM_UTF16_LE: "utf-16-le", codecs.BOM_UTF16_BE: "utf-16-be"}

# [dBi]; a pattern whose gain has a higher mean over the sphere is refused. An antenna has 0 dBi less its
# losses; cuts that are summed may miss that by some decibels.
_IMPOSSIBLE_DBI = 10.0

# [dB] by which a direction of a cut may exceed the stated gain, which is rounded, or of another tilt.
_BEYOND_MAXIMUM_DB = 3.0

# Lines of a cut at most.
_MOST_ANGLES = 3600

# Between two neighbouring angles of a cut.
_WIDEST_GAP_DEG = 90.0

# Gain of a half-wave dipole, which dBd refer to [dBi].
_DIPOLE_DBI = 2.15

_CUTS = {"HORIZONTAL": "horizontal", "VERTICAL": "vertical"}


@dataclass(frozen=True, eq=False)
class PatternTable:
    """Values at directions; between them they are bilinear in both angles.

    Example:
        >>> table = PatternTable(np.array([0.0, np.pi]), np.array([0.0, 2 * np.pi]), np.zeros((2, 2)))
        >>> table.is_field, table.at(np.array([1.0]), np.array([0.5])).tolist()
        (False, [0.0])
    """

    theta: Float64Array
    """Zenith angles [rad], ascending from 0 to π, Shape ``[T]``."""
    phi: Float64Array
    """Azimuths [rad], ascending, the last a whole turn after the first, Shape ``[F]``."""
    values: Float64Array | Complex128Array
    """Gains [dBi], Shape ``[T, F]``, or E_θ and E_φ, Shape ``[T, F, 2]``."""

    @property
    def is_field(self) -> bool:
        """Whether the values are fields."""
        return self.values.ndim == 3

    @property
    def mean_gain_dbi(self) -> float:
        """Mean of the gain over the sphere [dBi]: 0 without losses."""
        theta, phi = np.radians(np.arange(0.5, 180.0)), np.radians(np.arange(0.5, 360.0))
        values = self.at(np.repeat(theta, len(phi)), np.tile(phi, len(theta)))
        with np.errstate(over="ignore"):
            gain = (np.abs(values) ** 2).sum(1) if self.is_field else 10 ** (values.real / 10)
            weight = np.repeat(np.sin(theta), len(phi))
            mean = float(gain @ weight / weight.sum())
        return 10 * math.log10(mean) if mean > 0 else -math.inf

    def at(self, theta: Float64Array, phi: Float64Array) -> Float64Array | Complex128Array:
        """Interpolate the pattern.

        Args:
            theta: Zenith angles [rad], Shape ``[P]``.
            phi: Azimuths [rad], any turn, Shape ``[P]``.

        Returns:
            Gains [dBi], Shape ``[P]``, or fields, Shape ``[P, 2]``.
        """
        turned = self.phi[0] + (phi - self.phi[0]) % (2 * np.pi)
        row, down = _cells(self.theta, theta)
        column, across = _cells(self.phi, turned)
        if self.is_field:
            down, across = down[:, None], across[:, None]
        upper = self.values[row, column] * (1 - across) + self.values[row, column + 1] * across
        lower = self.values[row + 1, column] * (1 - across) + self.values[row + 1, column + 1] * across
        between: Float64Array | Complex128Array = upper * (1 - down) + lower * down
        return between


def _cells(nodes: Float64Array, at: Float64Array) -> tuple[Int64Array, Float64Array]:
    """The interval of nodes that each value is in, and how far into it, 0 to 1."""
    cell = np.clip(np.searchsorted(nodes, at, side="right") - 1, 0, len(nodes) - 2)
    return cell, (at - nodes[cell]) / (nodes[cell + 1] - nodes[cell])


def read_pattern(file: Path) -> PatternTable:
    """Read the pattern in a file, by the ending of its name.

    Args:
        file: A ``.csv`` table, or a Planet file, ``.msi`` or ``.pln``.

    Raises:
        AssetError: The file is wrong; names file, line and what to write instead.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder, "isotropic.csv")
        ...     text = "\\n".join(["theta_deg,phi_deg,gain_dbi", "0,0,0", "180,0,0"])
        ...     _ = file.write_text(text)
        ...     table = read_pattern(file)
        >>> abs(round(table.mean_gain_dbi, 6))
        0.0
    """
    if file.suffix.lower() not in SUFFIXES:
        raise AssetError(f"{file}: no pattern has the ending {file.suffix!r}; known: {', '.join(SUFFIXES)}")
    try:
        with open_regular(file, "name a file") as opened:
            if os.fstat(opened.fileno()).st_size > MAX_BODY:
                raise AssetError(f"{file} has more than {MAX_BODY} B; write fewer directions")
            lines = _decoded(opened.read()).splitlines()
    except OSError as error:
        raise AssetError(f"pattern {file} cannot be read: {error.strerror}") from error
    table = _table(file, lines) if file.suffix.lower() == ".csv" else _planet(file, lines)
    if not table.mean_gain_dbi <= _IMPOSSIBLE_DBI:
        raise AssetError(
            f"{file}: its gain has a mean of {table.mean_gain_dbi:.3g} dBi over the sphere, where no antenna "
            "has more than 0 dBi; correct gains, units, and signs"
        )
    return table


def _decoded(data: bytes) -> str:
    """The text of a file, which may begin with a byte order mark, as spreadsheets write it."""
    for mark, encoding in _MARKS.items():
        if data.startswith(mark):
            return data[len(mark) :].decode(encoding, errors="replace")
    # Planet files have comments in whatever encoding their maker used; what counts is ASCII.
    return data.decode("latin-1")


def _table(file: Path, lines: list[str]) -> PatternTable:
    header: tuple[str, ...] = ()
    rows: list[list[float]] = []
    for number, text in enumerate(map(str.strip, lines), 1):
        if not text or text.startswith("#"):
            continue
        parts = tuple(part.strip() for part in text.split(","))
        if not header:
            header = parts
            if header not in (GAIN, FIELD):
                raise AssetError(f"{file}:{number}: is {text!r}; write {','.join(GAIN)} or {','.join(FIELD)}")
        else:
            rows.append(_numbers(file, number, parts, len(header)))
    if not rows:
        raise AssetError(f"{file} holds no direction; write {','.join(GAIN)}, then one direction a line")
    table = np.array(rows)
    theta, row = np.unique(table[:, 0], return_inverse=True)
    around = table[:, 1] % 360.0
    # A table that ends where it began has this azimuth twice: 0 and 360, or -180 and 180.
    phi, column = np.unique(around, return_inverse=True)
    if theta[0] != 0 or theta[-1] != 180:
        raise AssetError(f"{file}: zenith angles go from {theta[0]:g}° to {theta[-1]:g}°; write 0° to 180°")
    # Of each direction a line is needed, so what is missing is known before a table of all is made.
    directions = np.unique(row * len(phi) + column)
    if len(directions) < len(theta) * len(phi):
        gaps = np.flatnonzero(directions != np.arange(len(directions)))
        t, f = divmod(int(gaps[0]) if len(gaps) else len(directions), len(phi))
        raise AssetError(
            f"{file}: there is no line for theta_deg = {theta[t]:g}, phi_deg = {phi[f]:g} (modulo 360); "
            "write each zenith angle with each azimuth"
        )
    values = np.empty((len(theta), len(phi), len(header) - 2))
    values[row, column] = table[:, 2:]
    if not np.array_equal(values[row, column], table[:, 2:]):
        raise AssetError(f"{file}: a direction has two different values; remove one")
    phi, values = np.append(phi, phi[0] + 360.0), np.concatenate([values, values[:, :1]], axis=1)
    return _made(theta, phi, values)


def _numbers(file: Path, line: int, parts: tuple[str, ...], count: int) -> list[float]:
    try:
        numbers = [float(part) for part in parts]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise AssetError(f"{file}:{line}: is {','.join(parts)!r:.80}; write {count} finite numbers")
    return numbers


def _made(theta_deg: Float64Array, phi_deg: Float64Array, values: Float64Array) -> PatternTable:
    """A table of gains, Shape ``[T, F, 1]``, or of both parts of both components, ``[T, F, 4]``."""
    angles = np.radians(theta_deg), np.radians(phi_deg)
    if values.shape[2] == 1:
        return PatternTable(*angles, values[..., 0])
    return PatternTable(*angles, values[..., 0::2] + 1j * values[..., 1::2])


def _planet(file: Path, lines: list[str]) -> PatternTable:
    gain_dbi: float | None = None
    cuts: dict[str, _CutLines] = {}
    cut: _CutLines | None = None
    for number, text in enumerate(lines, 1):
        parts = text.replace(",", ".").split()  # decimal commas, as some makers' tools write them
        key = parts[0].upper() if parts else ""
        if key in _CUTS:
            if key in cuts:
                raise AssetError(f"{file}:{number}: is a second {key}; remove one")
            # How many lines follow a cut's key.
            if len(parts) < 2 or not parts[1].isdecimal() or not 1 <= int(parts[1][:9]) <= _MOST_ANGLES:
                raise AssetError(
                    f"{file}:{number}: is {' '.join(parts)!r:.80}; write {parts[0]} and how many lines "
                    f"follow, up to {_MOST_ANGLES}"
                )
            cut = cuts[key] = _CutLines(file, number, key, int(parts[1]))
        elif key == "GAIN":
            if gain_dbi is not None:
                raise AssetError(f"{file}:{number}: is a second GAIN; remove one")
            gain_dbi = _gain(file, number, parts[1:])
        elif cut is not None and _is_number(key):
            cut.add(number, tuple(parts))
    if gain_dbi is None:
        raise AssetError(f"{file} has no GAIN; add a line such as GAIN 15.5 dBi")
    for key, name in _CUTS.items():
        if key not in cuts:
            raise AssetError(f"{file} has no {name} cut; add {key} 360 and a line for each degree")
    across, down = (cuts[key].cut() for key in _CUTS)
    # Nodes of the table are those of both cuts, so that it has their values.
    azimuth = np.unique(-across.angle % 360.0)
    depression = (down.angle + 180.0) % 360.0 - 180.0
    front = np.abs(depression) <= 90.0
    theta = np.unique(np.concatenate([90.0 + depression[front], [0.0, 180.0]]))
    phi = np.append(azimuth, azimuth[0] + 360.0)
    attenuation = down.at(theta - 90.0)[:, None] + across.at(-phi)[None]
    return _made(theta, phi, (gain_dbi - attenuation)[..., None])


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _gain(file: Path, line: int, parts: list[str]) -> float:
    # «15.5dBi» in one word, and no unit at all, are both found in files of makers.
    if len(parts) == 1 and (joined := re.fullmatch(r"(.*\d\.?)(db[di])", parts[0], re.IGNORECASE)):
        parts = [*joined.groups()]
    unit = parts[1].lower() if len(parts) > 1 else "dbd"
    if not parts or unit not in ("dbd", "dbi"):
        raise AssetError(f"{file}:{line}: is {' '.join(parts)!r:.80}; write GAIN, a number, and dBi or dBd")
    (value,) = _numbers(file, line, (parts[0],), 1)
    return value + (_DIPOLE_DBI if unit == "dbd" else 0.0)


@dataclass(frozen=True)
class _CutLines:
    """The lines of a cut as they are read."""

    file: Path
    line: int
    key: str
    count: int
    """Lines that follow, by the key's own."""
    losses: dict[float, float] = field(default_factory=dict)
    """Attenuation [dB] by angle [°], 0 to less than 360."""
    read: list[int] = field(default_factory=list)
    """Numbers of the lines."""

    def add(self, line: int, parts: tuple[str, ...]) -> None:
        """One more direction."""
        angle, loss = _numbers(self.file, line, parts, 2)
        if loss < -_BEYOND_MAXIMUM_DB:
            raise AssetError(
                f"{self.file}:{line}: the loss is {loss:g} dB; write the attenuation against GAIN, which is "
                "positive"
            )
        # 0° and 360° are one direction, which a cut that ends where it began has twice.
        if self.losses.setdefault(angle % 360.0, loss) != loss:
            raise AssetError(f"{self.file}:{line}: a second loss at {angle:g}°; remove one")
        self.read.append(line)

    def cut(self) -> _Cut:
        """The cut, whole."""
        if len(self.read) != self.count:
            raise AssetError(
                f"{self.file}:{self.line}: {self.key} says {self.count}, {len(self.read)} lines follow; "
                "complete the cut, or correct the number"
            )
        angles = np.array(sorted(self.losses))
        gaps = np.diff(angles, append=angles[0] + 360.0)
        widest = int(np.argmax(gaps))
        if gaps[widest] > _WIDEST_GAP_DEG:
            raise AssetError(
                f"{self.file}:{self.line}: {self.key} has no line between {angles[widest]:g}° and "
                f"{angles[(widest + 1) % len(angles)]:g}°; write angles all around, at most "
                f"{_WIDEST_GAP_DEG:g}° apart"
            )
        return _Cut(angles, np.array([self.losses[angle] for angle in angles.tolist()]))


@dataclass(frozen=True, eq=False)
class _Cut:
    """Attenuation [dB] over angles [°] around, ascending from 0 to less than 360."""

    angle: Float64Array
    loss: Float64Array

    def at(self, angle: Float64Array) -> Float64Array:
        return np.interp(angle, self.angle, self.loss, period=360.0)
