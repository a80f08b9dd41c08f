"""Agent ``fingerprint``: beams that served best near a position before, tried by a few pilots.

Inverse multipath fingerprinting (Va, Choi, Shimizu, Bansal and Heath, "Inverse multipath fingerprinting for
millimeter wave V2I beam alignment", IEEE Trans. Veh. Technol. 67(5), 2018): a table holds, for each cell of
positions, the beam pairs in the order of how often they were the best there. The table is learnt from the
links of a recorded run. A user's position gives its cell, and pilots are sent for the first few pairs of it
alone.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, NamedTuple, TypeAlias

import numpy as np

from caviar_protocol.arrays import Float64Array, quantity
from caviar_protocol.errors import RecordingError, ScenarioError
from caviar_protocol.recording import Recording
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.scenario.schema import published_array
from caviar_protocol.space.beams import straight_beams
from caviar_protocol.space.codebooks import DFT, beam_count
from caviar_protocol.space.coordinates import Vector
from caviar_protocol.space.scene import Pair, antennas, device_pose, directions
from caviar_protocol.topics import AntennaArray, Link, Scene
from caviar_services.agent.pilots import Measured, PilotAgent, PilotSettings, Sounding
from caviar_services.service import Preparation, Prepared

UNKNOWN = "users-without-fingerprint"
"""Count of the users of which the recording says nothing; they are served along the straight line."""
LOADING_S = 600.0
"""[s] that reading a recording may take without progress."""

Cell: TypeAlias = tuple[int, int, int]


class FingerprintSettings(PilotSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the agent ``fingerprint``."""

    file: str
    """``file:`` and the path of a recorded run, relative to the folder of the scenario; its directory, or one
    segment. It has topics ``scene`` and ``link``."""
    cell_m: Annotated[float, quantity("m", "edge of a cell of positions", gt=0, le=1e6)] = 5.0
    candidates: Annotated[int, quantity("1", "pairs of a cell that are tried", ge=1, le=4096)] = 8
    """1: the first pair of the cell is taken without a pilot."""


class Codebooks(NamedTuple):
    """Subject of a fingerprint: a transmitter that stands still, a carrier, and beams of both ends."""

    tx: str
    carrier: str
    tx_beams: int
    rx_beams: int
    tx_codebook: str = DFT
    rx_codebook: str = DFT

    @classmethod
    def for_pair(cls, pair: Pair, carrier: str) -> Codebooks:
        """Codebooks of a pair of a scene."""
        return cls(pair.tx.name, carrier, *pair.beams, pair.tx.array.codebook, pair.rx.array.codebook)


class Fingerprints:
    """Beam pairs by position, best first.

    Args:
        cell_m: Edge of a cell [m].

    Example:
        >>> from caviar_services.testing.samples import product, scene
        >>> table = Fingerprints(5.0)
        >>> table.learn(scene(0), product("link", 0))
        >>> known = Codebooks("bs", "mmwave", 16, 3)
        >>> len(table.pairs(known, (-12.0, 3.0, 1.65))), table.pairs(known._replace(tx="other"), (0, 0, 0))
        (10, ())
    """

    def __init__(self, cell_m: float) -> None:
        self._cell_m = cell_m
        # How often a pair was the best in a cell, and the sum of |y|² over the frames in which it was listed.
        self._seen: dict[Codebooks, dict[Cell, dict[tuple[int, int], list[float]]]] = defaultdict(dict)
        self._cells: dict[Codebooks, tuple[list[Cell], Float64Array]] = {}
        self._ranked: dict[tuple[Codebooks, Cell], tuple[tuple[int, int], ...]] = {}

    @property
    def codebooks(self) -> tuple[Codebooks, ...]:
        """Codebooks of which there are fingerprints, sorted."""
        return tuple(sorted(self._seen))

    @property
    def cells(self) -> int:
        """Number of cells with a fingerprint."""
        return sum(len(cells) for cells in self._seen.values())

    def learn(self, scene: Scene, link: Link) -> None:
        """Learn from the best pairs that a link lists.

        Args:
            scene: Of the frame.
            link: Of the same frame.
        """
        sizes = {device.name: device for role in ("tx", "rx") for device in antennas(scene, role)}
        beams = np.stack([link.top_tx_beam, link.top_rx_beam], axis=-1).tolist()
        power = (link.top_abs_y**2).tolist()
        for u, (tx, rx, carrier) in enumerate(zip(link.tx, link.rx, link.carrier, strict=True)):
            if not link.has_path[u] or tx not in sizes or rx not in sizes:
                continue
            key = Codebooks.for_pair(Pair(sizes[tx], sizes[rx]), carrier)
            cell = self._cell(device_pose(scene, sizes[rx]).position)
            pairs = self._seen[key].setdefault(cell, {})
            for rank, ((tx_beam, rx_beam), gain) in enumerate(zip(beams[u], power[u], strict=True)):
                if tx_beam >= 0:
                    entry = pairs.setdefault((tx_beam, rx_beam), [0, 0.0])
                    entry[0] += rank == 0
                    entry[1] += gain
        self._cells.clear()
        self._ranked.clear()

    def pairs(self, key: Codebooks, position: Vector) -> tuple[tuple[int, int], ...]:
        """Look up the pairs of a position, or of the nearest cell that has any.

        Args:
            key: Transmitter, carrier and codebooks.
            position: Of the receiver in the world [m].

        Returns:
            TX and RX beams: those that were the best in most frames first, then by their mean |y|².
        """
        if key not in self._seen:
            return ()
        cell = self._cell(position)
        if cell not in self._seen[key]:
            if key not in self._cells:
                known = sorted(self._seen[key])
                self._cells[key] = known, np.array(known, np.float64)
            known, places = self._cells[key]
            cell = known[int(((places - cell) ** 2).sum(1).argmin())]
        if (key, cell) not in self._ranked:
            seen = self._seen[key][cell]
            order = sorted(seen, key=lambda pair: (-seen[pair][0], -seen[pair][1], pair))
            self._ranked[key, cell] = tuple(order)
        return self._ranked[key, cell]

    def _cell(self, position: Vector) -> Cell:
        x, y, z = (math.floor(value / self._cell_m) for value in position)
        return x, y, z


def learnt(path: Path, cell_m: float) -> Fingerprints:
    """Learn fingerprints from a recorded run.

    Args:
        path: Its directory, or a segment.
        cell_m: Edge of a cell [m].

    Raises:
        RecordingError: There is no recording, or none with scenes and links.
    """
    recording, table = Recording(path), Fingerprints(cell_m)
    missing = {"scene", "link"} - recording.topics.keys()
    if missing:
        raise RecordingError(
            f'{path} has no {" and no ".join(sorted(missing))}; record a run with record = ["scene", "link"]'
        )
    for frame, product in recording.products("link"):
        scene = frame.scene()
        if scene is not None and isinstance(product.payload, Link):
            table.learn(scene, product.payload)
    return table


class FingerprintAgent(PilotAgent[FingerprintSettings]):
    """Tries the pairs that served best near a user's position in a recorded run.

    Raises:
        ScenarioError: The recording cannot be read, or is of other transmitters, carriers or codebooks.
    """

    Settings = FingerprintSettings
    table: Fingerprints
    """What `prepare` learnt from the recording."""

    @classmethod
    def check_settings(cls, settings: FingerprintSettings, place: Place) -> None:
        """Raise `ScenarioError` where there is no such file."""
        path = Path(settings.file.removeprefix("file:"))
        if not path.exists():
            raise place.at("file").error(f"there is no {path}; name the directory of a recorded run")

    def prepare(self, preparation: Preparation) -> Prepared:
        """Read the recording."""
        path = Path(self.settings.file.removeprefix("file:"))
        key = self.run.settings_place.at("file").key
        self.run.progress(f"learning from {path.name}", LOADING_S)
        try:
            self.table = table = learnt(path, self.settings.cell_m)
        except RecordingError as error:
            raise ScenarioError(str(error), key=key) from error
        self.run.progress("prepared", 0.0)
        if not any(map(self._is_here, table.codebooks)):
            there = ", ".join(
                f"{c.tx!r} with {c.tx_beams} beams on {c.carrier}"
                + ("" if c.tx_codebook == DFT else f" ({c.tx_codebook})")
                for c in table.codebooks
            )
            raise ScenarioError(
                f"{path} has fingerprints of {there or 'no transmitter'}, and the scenario none "
                "of these; record a run of this scenario",
                key=key,
            )
        prepared = super().prepare(preparation)
        note = f"fingerprints of {table.cells} cells of {self.settings.cell_m:g} m, from {path.name}"
        return Prepared(actuators=prepared.actuators, notes=(*prepared.notes, note))

    def _is_here(self, known: Codebooks) -> bool:
        """Return whether the scenario has such a transmitter and carrier. Receivers come and go."""
        if all(carrier.name != known.carrier for carrier in self.run.carriers):
            return False
        return any(
            fnmatchcase(known.tx, f"{device.on}/{device.name}" if device.on else device.name)
            and (device.array is None or _codebook(device.array) == (known.tx_beams, known.tx_codebook))
            for device in self.run.devices
        )

    def select(self, sounding: Sounding) -> Iterator[Measured]:
        """The best of the first few pairs of each user's cell."""
        for index, user in enumerate(sounding.users):
            position = device_pose(sounding.scene, user.rx).position
            pairs = self.table.pairs(Codebooks.for_pair(user, user.carrier.name), position)
            if not pairs:
                sounding.note(UNKNOWN)
                at_tx, at_rx = directions(sounding.scene, [user])
                yield Measured(index, *straight_beams(user.tx.array, at_tx[0], user.rx.array, at_rx[0]))
                continue
            found = sounding.best_of(index, pairs[: self.settings.candidates])
            if found is not None:
                yield found


def _codebook(array: AntennaArray) -> tuple[int, str]:
    """Size and name of a scenario's codebook, as they are in a scene."""
    published = published_array(array)
    return beam_count(published), published.codebook
