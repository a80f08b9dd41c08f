"""Format ``p2m``: paths of Wireless InSite, files ``*.paths.tTTT_SS.rRRR.p2m`` of versions 3.2 and 3.3."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

import numpy as np

from caviar_formats.base import Format
from caviar_formats.imports import ImportedScene, Paths, Source, damaged
from caviar_protocol.errors import RunError
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT
from caviar_protocol.topics import AntennaDevice, Carrier
from caviar_protocol.topics.channel import Interaction

LETTERS = {
    "R": Interaction.REFLECTION,
    "D": Interaction.DIFFRACTION,  # mostly at vertical edges
    "d": Interaction.DIFFRACTION,  # at horizontal ones
    "DS": Interaction.SCATTERING,
    "S": Interaction.SCATTERING,
    "T": Interaction.TRANSMISSION,
}
LENGTH = 2e-3
"""Of a path's delay from the length of its points, relative: files have five digits of either."""
LENGTH_M = 0.05
GAIN_DB = 0.5
"""Of a straight path from free space between isotropic antennas, above which an import says so."""


class P2m(Format):
    """Files of paths, or a folder of such files, one for each transmitter and set of receivers: a scene."""

    def read(self, path: Path) -> Source:
        files = sorted(path.glob("*.paths.*.p2m")) if path.is_dir() else [path]
        if not files:
            raise RunError(f"{path} has no file *.paths.*.p2m")
        if (frequency_hz := self.frequency_hz) is None:
            raise RunError(f"{path}: the files do not have the carrier's frequency; give --frequency-hz HZ")
        devices: dict[str, AntennaDevice] = {}
        paths = [one for file in files for one in _File(file, frequency_hz).pairs(devices)]
        return Source(
            path=path,
            scenes=[ImportedScene(episode=0, scene=0, devices=tuple(devices.values()), paths=paths)],
            carriers=(Carrier(name="carrier", frequency_hz=frequency_hz),),
            lacks="The files have no receivers without paths, arrays, orientations, objects, Doppler shifts.",
            assumed="Powers are of transmitters that send 0 dBm on 100 MHz, antennas are single elements. "
            "Phases that version 3.2 does not write are those of the delays, −2πfτ."
            + _beside_free_space(paths, frequency_hz),
        )


def _beside_free_space(paths: list[Paths], frequency_hz: float) -> str:
    """Name the straight path that is farthest from free space, |a| = 1 / (4πfτ); empty: none is far."""
    worst, text = GAIN_DB, ""
    for pair in paths:
        straight = ~np.asarray(pair.interactions).any(axis=1) & (pair.tau > 0)
        for over in 20 * np.log10(np.abs(pair.a[0]) * 4 * np.pi * frequency_hz * pair.tau)[straight]:
            if abs(over) > worst:
                worst = abs(over)
                text = (
                    f" The straight path from {pair.tx} to {pair.rx} is {over:+.2f} dB from free space at "
                    f"{frequency_hz / 1e9:g} GHz: antennas have gains, or --frequency-hz is another one's."
                )
    return text


class _File:
    """A file, read line by line with the number of the line for errors."""

    def __init__(self, path: Path, frequency_hz: float) -> None:
        self._path, self._frequency = path, frequency_hz
        try:
            lines = path.read_text(encoding="ascii").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise damaged(path, "", f"is no file of paths: {error}") from error
        self._lines = iter([*enumerate(lines, 1)])
        self._at, self._columns = 0, 0
        stem = path.name.removesuffix(".p2m").rpartition(".paths.")[2] or path.stem
        self._tx, _, self._rx = stem.partition(".")

    def pairs(self, devices: dict[str, AntennaDevice]) -> Iterator[Paths]:
        """Read the paths of each receiver, and add the devices at their ends."""
        (receivers,) = self._counts("the number of receivers", 1)
        for _ in range(receivers):
            number, count = self._counts("a receiver's number and its number of paths", 2)
            if not count:
                continue
            self._numbers("received power, mean delay and delay spread", 3)
            rx = f"{self._rx or 'rx'}-{number:05d}"
            found = [self._path_of() for _ in range(count)]
            points = found[0][1]
            for name, role, place in ((self._tx, "tx", points[0]), (rx, "rx", points[-1])):
                x, y, z = place.tolist()
                made = AntennaDevice(name=name, role=role, position=(x, y, z))  # type: ignore[arg-type]
                if (before := devices.setdefault(name, made)) != made:
                    self._fail(f"{name} is at {made.position}, and was at {before.position}")
            yield self._paths(rx, found)
        for number, line in self._lines:
            if line.strip():
                self._at = number
                self._fail(f"{line.strip()!r:.80} follows the last of {receivers} receivers")

    def _path_of(self) -> tuple[list[float], np.ndarray[tuple[int, int], np.dtype[np.float64]], list[int]]:
        """Read a path: its numbers, the points from TX to RX, and the interactions."""
        values = self._numbers("a path of 8 values, or 9 with its phase", 8, 9)
        if self._columns and len(values) != self._columns:
            self._fail(f"a path of {len(values)} values follows some of {self._columns}")
        self._columns = len(values)
        tokens = self._line("the interactions of a path, as Tx-R-Rx").strip().split("-")
        if tokens[0] != "Tx" or tokens[-1] != "Rx" or any(token not in LETTERS for token in tokens[1:-1]):
            self._fail(f"{'-'.join(tokens)!r:.60} are no interactions, as Tx-R-D-Rx ({', '.join(LETTERS)})")
        points = np.array([self._numbers("a point x, y, z", 3) for _ in tokens])
        power, tau, *angles = values[2], *values[-5:]
        length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
        if abs(tau * SPEED_OF_LIGHT - length) > LENGTH_M + LENGTH * length or power > 0:
            self._fail(
                f"the path of {length:.2f} m by its points has a delay of {tau:g} s and {power:g} dBm: "
                "columns are number, interactions, power, (phase,) delay, arrival, departure"
            )
        if not all(0 <= zenith <= 180 for zenith in angles[::2]):
            self._fail(f"zenith angles {angles[0]:g}° and {angles[2]:g}° are not within 0° to 180°")
        return values, points, [int(LETTERS[token]) for token in tokens[1:-1]]

    def _paths(self, rx: str, found: list[tuple[list[float], np.ndarray, list[int]]]) -> Paths:
        values = np.array([one for one, *_ in found])
        tau, depth = values[:, -5], max(len(kinds) for *_, kinds in found)
        angles = np.radians(values[:, -4:])
        phase = np.radians(values[:, 3]) if self._columns == 9 else -2 * np.pi * self._frequency * tau
        types, points = np.zeros((len(found), depth), np.uint8), np.zeros((len(found), depth, 3))
        for at, (_, places, kinds) in enumerate(found):
            types[at, : len(kinds)], points[at, : len(kinds)] = kinds, places[1:-1]
        return Paths(
            tx=self._tx,
            rx=rx,
            los=not types.any(axis=1).all(),
            a=(10 ** (values[:, 2] / 20) * np.exp(1j * phase))[None],
            tau=tau,
            aod=angles[:, 2:],
            aoa=angles[:, :2],
            interactions=types,
            points=points,
        )

    def _line(self, what: str) -> str:
        """The next line that is no comment."""
        for number, line in self._lines:
            self._at = number
            if line.strip() and not line.startswith("#"):
                return line
        self._at += 1
        return self._fail(f"the file ends, and {what} is expected")

    def _numbers(self, what: str, *counts: int) -> list[float]:
        line = self._line(what)
        try:
            values = [float(word) for word in line.split()]
        except ValueError:
            values = []
        if len(values) not in counts or not np.isfinite(values).all():
            self._fail(f"{line.strip()!r:.80} is not {what}")
        return values

    def _counts(self, what: str, count: int) -> list[int]:
        values = self._numbers(what, count)
        if any(value < 0 or value % 1 for value in values):
            self._fail(f"{values} are not {what}")
        return [int(value) for value in values]

    def _fail(self, why: str) -> NoReturn:
        raise damaged(self._path, f"line {self._at}", why)
