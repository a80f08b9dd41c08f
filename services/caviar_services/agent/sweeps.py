"""Agents that sweep the codebooks: ``exhaustive-sweep``, ``hierarchical-sweep`` and ``last-sweep``.

They find beams as radio systems do, by pilots (`caviar_services.agent.pilots`), and pay for it in air time.
An exhaustive sweep of Nt TX and Nr RX beams takes Nt·Nr pilots and finds the best pair (paper, eq. 2). A
hierarchical sweep first tries wide beams, then the narrower ones within the best of them: for N beams and b
children of each about b·log_b(N) pilots an end, but it may go astray where a wide beam has several paths
in it, or too little gain. ``last-sweep`` sweeps every ``period`` frames and keeps to what it found.

Agent ``out-of-band``: what a lower carrier sees tells where to look at a higher one.

Paths leave and arrive under much the same angles on carriers of different frequency. A lower carrier has its
own link, whose arrays measure the spatial spectrum at no further cost; only the beam pairs in which it is
strongest are tried by pilots of the higher carrier (González-Prelcic, Ali, Va and Heath, "Millimeter-wave
communication with out-of-band information", IEEE Commun. Mag. 55(12), 2017; Ali, González-Prelcic and Heath,
"Millimeter wave beam-selection using out-of-band spatial information", IEEE Trans. Wireless Commun. 17(2),
2018). Both carriers stand in the channel product of the run; the spacing of elements is in wavelengths, so
that a beam of a codebook has the same direction on all of them.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from typing import Annotated, ClassVar

import msgspec
import numpy as np
from msgspec.structs import replace

from caviar_protocol.arrays import Complex128Array, Float64Array, Int64Array, quantity
from caviar_protocol.errors import ScenarioError, suggestion
from caviar_protocol.scenario import DeviceSpec, Scenario
from caviar_protocol.scenario.conversion import Place, Source
from caviar_protocol.space.beams import beam_gains, best_pairs
from caviar_protocol.space.codebooks import DFT
from caviar_protocol.topics import AntennaArray
from caviar_services.agent.pilots import Measured, PilotAgent, PilotSettings, Sounding
from caviar_services.checkpoint import restored, saved
from caviar_services.link.base import User
from caviar_services.link.beam_scores import sweep_users
from caviar_services.service import Preparation, Prepared, RunInfo


def sweep_all(sounding: Sounding, indices: Iterable[int]) -> Iterator[Measured]:
    """Try all pairs of some users, and take the best of each.

    Args:
        sounding: Users and channels; the pilots are counted in it.
        indices: The users.

    Returns:
        The pair of each user that has a path: without one there is nothing to measure but noise.
    """
    users, chosen = sounding.users, set(indices)
    sounding.count_shared((users[u], users[u].beam_pairs) for u in sorted(chosen))
    h = [sounding.h[u] if u in chosen else None for u in range(len(users))]
    for group in sweep_users(users, h):
        for u, abs_y in zip(group.users, group.abs_y, strict=True):
            best = best_pairs(sounding.measured(users[u], abs_y)[None], 1)
            yield Measured(u, int(best.tx_beam[0, 0]), int(best.rx_beam[0, 0]))


class ExhaustiveSweepAgent(PilotAgent[PilotSettings]):
    """Tries all pairs in every frame: the best choice, at the highest price.

    Example:
        >>> from caviar_services.testing.samples import CARRIERS, granted
        >>> agent = ExhaustiveSweepAgent(PilotSettings(), RunInfo(name="agent", carriers=CARRIERS))
        >>> agent.step(granted(agent.inputs, 0, "agent")).counts["pilots"]  # 16 TX beams, 3 or 2 RX beams
        48
    """

    def select(self, sounding: Sounding) -> Iterator[Measured]:
        """The pair of greatest |y|, as measured."""
        return sweep_all(sounding, range(len(sounding.users)))


class LastSweepSettings(PilotSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the agent ``last-sweep``."""

    period: Annotated[int, quantity("frame", "from one sweep to the next", ge=1, le=1_000_000)] = 10


class _Kept(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """The pair that the last sweep found for a user."""

    carrier: str
    tx: str
    rx: str
    tx_beam: int
    rx_beam: int


class _LastSweepState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    swept: int
    """Frame of the last sweep of all users; −1: there was none."""
    kept: tuple[_Kept, ...]


class LastSweepAgent(PilotAgent[LastSweepSettings]):
    """Keeps to the best pairs of the last sweep, which age as users move.

    A user that comes between two sweeps, or had no path in the last one, is swept by itself.

    Args:
        settings: Users, pilots and the period.
        run: What the agent knows about the run.
    """

    Settings = LastSweepSettings
    checkpoints: ClassVar[bool] = True

    def __init__(self, settings: LastSweepSettings, run: RunInfo) -> None:
        super().__init__(settings, run)
        self._swept = -1
        self._kept: dict[tuple[str, str, str], tuple[int, int]] = {}

    def reset(self, episode: int, seed: int, t0_ns: int) -> None:
        """Every episode begins with a sweep."""
        self._swept, self._kept = -1, {}

    def checkpoint(self) -> bytes:
        """What the last sweep found, and when it was."""
        kept = tuple(_Kept(*key, *beams) for key, beams in sorted(self._kept.items()))
        return saved(self, 1, _LastSweepState(self._swept, kept))

    def restore(self, state: bytes) -> None:
        """See `checkpoint`."""
        found = restored(self, 1, _LastSweepState, state)
        self._swept = found.swept
        self._kept = {(k.carrier, k.tx, k.rx): (k.tx_beam, k.rx_beam) for k in found.kept}

    def select(self, sounding: Sounding) -> Iterator[Measured]:
        """What the last sweep found, or finds now."""
        users, frame = sounding.users, sounding.frame.number
        if self._swept < 0 or frame - self._swept >= self.settings.period:
            # Of users that left nothing is kept; one without a path now has no pair that is worth keeping.
            self._swept, self._kept = frame, {}
        missing = [u for u, user in enumerate(users) if _key(user) not in self._kept]
        for found in sweep_all(sounding, missing):
            self._kept[_key(users[found.user])] = found.tx_beam, found.rx_beam
        for u, user in enumerate(users):
            if (pair := self._kept.get(_key(user))) is not None:
                yield Measured(u, *pair)


def _key(user: User) -> tuple[str, str, str]:
    return user.carrier.name, user.tx.name, user.rx.name


class HierarchicalSettings(PilotSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the agent ``hierarchical-sweep``."""

    branching: Annotated[
        int, quantity("1", "narrower beams within a wide one, along each axis of an array", ge=2, le=64)
    ] = 4


class HierarchicalSweepAgent(PilotAgent[HierarchicalSettings]):
    """Narrows the beams of both ends level by level, in every frame.

    A wide beam is one of fewer elements, the others are off (the DEACT codebook of Xiao, He, Xia and Xia,
    "Hierarchical codebook design for beamforming training in millimeter-wave communication", IEEE Trans.
    Wireless Commun. 15(5), 2016). At each level the pairs of the beams within the best pair so far are tried.
    All users of a transmitter listen to the pilots of the first level; those of the others are of one user.

    Example:
        >>> from caviar_services.testing.samples import CARRIERS, granted
        >>> agent = HierarchicalSweepAgent(HierarchicalSettings(), RunInfo(name="agent", carriers=CARRIERS))
        >>> agent.step(granted(agent.inputs, 0, "agent")).counts["pilots"]  # 4·3, then 4 for each user
        20
    """

    Settings = HierarchicalSettings

    @classmethod
    def check_scenario(cls, settings: HierarchicalSettings, scenario: Scenario, place: Place) -> None:
        """Raise `ScenarioError` where an antenna has another codebook than that of the DFT."""
        _require_dft(scenario.devices, scenario.source)

    def prepare(self, preparation: Preparation) -> Prepared:
        """Look at the codebooks of a run whose scenario is on another machine, too."""
        _require_dft(self.run.devices, Source())
        return super().prepare(preparation)

    def select(self, sounding: Sounding) -> Iterator[Measured]:
        """The pair that the levels lead to; no choice for a user without a path."""
        users, branching = sounding.users, self.settings.branching
        levels = {u: _levels(user.tx.array, user.rx.array, branching) for u, user in enumerate(users)}
        first = ((users[u], of[0].tx.array.size * of[0].rx.array.size) for u, of in levels.items())
        sounding.count_shared(first)
        for u, of_user in levels.items():
            matrix = sounding.h[u]
            if matrix is not None:
                yield Measured(u, *_descend(sounding, users[u], matrix, of_user))


def _require_dft(devices: Sequence[DeviceSpec], source: Source) -> None:
    for index, device in enumerate(devices):
        if device.array is not None and device.array.codebook != DFT:
            raise (
                Place("devices", source)
                .at(index)
                .at("array")
                .at("codebook")
                .error(
                    f"is {device.array.codebook!r}, and 'hierarchical-sweep' narrows DFT beams alone; write "
                    f"{DFT!r}, or use another agent"
                )
            )


class End(msgspec.Struct, frozen=True):
    """The beams of one end at one level of a hierarchical sweep."""

    array: AntennaArray
    """With the elements that are on."""
    elements: Int64Array
    """Which of the whole array these are."""
    turn: Complex128Array
    """Phases that turn the beams of the codebook to the middle of the narrow ones within them."""


class Level(msgspec.Struct, frozen=True):
    """Both ends at one level."""

    tx: End
    rx: End


def _descend(
    sounding: Sounding, user: User, matrix: Complex128Array, levels: Sequence[Level]
) -> tuple[int, int]:
    tx_beam = rx_beam = 0
    before: Level | None = None
    for number, level in enumerate(levels):
        tx, rx = level.tx, level.rx
        if before is None:
            tx_beams, rx_beams = np.arange(tx.array.size), np.arange(rx.array.size)
        else:
            tx_beams = children(before.tx.array, tx.array)[tx_beam]
            rx_beams = children(before.rx.array, rx.array)[rx_beam]
            sounding.count(user, len(tx_beams) * len(rx_beams))
        heard = matrix[np.ix_(rx.elements, tx.elements)] * rx.turn[:, None] * tx.turn
        abs_y = beam_gains(heard, tx.array, rx.array)[np.ix_(tx_beams, rx_beams)]
        best = best_pairs(sounding.measured(user, abs_y, str(number))[None], 1)
        tx_beam, rx_beam = int(tx_beams[best.tx_beam[0, 0]]), int(rx_beams[best.rx_beam[0, 0]])
        before = level
    return tx_beam, rx_beam


# Arrays are few and frozen, and asked for in every frame.
@lru_cache(maxsize=256)
def _levels(tx: AntennaArray, rx: AntennaArray, branching: int) -> tuple[Level, ...]:
    """From the widest beams to the codebook itself; an end that is through keeps its beam."""
    of_tx, of_rx = narrowing(tx, branching), narrowing(rx, branching)
    depth = max(len(of_tx), len(of_rx))
    of_tx += of_tx[-1:] * (depth - len(of_tx))
    of_rx += of_rx[-1:] * (depth - len(of_rx))
    return tuple(Level(end_of(tx, a), end_of(rx, b)) for a, b in zip(of_tx, of_rx, strict=True))


def end_of(whole: AntennaArray, part: AntennaArray) -> End:
    """Describe the beams of an array of which only a part is on.

    A beam of n of N elements is N/n times as wide as those of the codebook. Turned by (N/n − 1)/2 of their
    spacing it has as many of them on one side as on the other: unturned, some would lie on the border of two.

    Args:
        whole: The array.
        part: The same with fewer rows and columns.

    Example:
        >>> end = end_of(AntennaArray(columns=4), AntennaArray(columns=2))
        >>> end.elements.tolist(), np.angle(end.turn, deg=True).round(6).tolist()  # half of 90° an element
        ([0, 1], [0.0, -45.0])
    """
    blocks = whole.size // (whole.rows * whole.columns)
    q, p = np.meshgrid(np.arange(part.columns), np.arange(part.rows), indexing="ij")
    cycles = q * (1 / part.columns - 1 / whole.columns) / 2 + p * (1 / part.rows - 1 / whole.rows) / 2
    turn = np.exp(-2j * np.pi * np.tile(cycles.reshape(-1), blocks))
    return End(part, used_elements(whole, part), turn)


def narrowing(array: AntennaArray, branching: int) -> list[AntennaArray]:
    """List the arrays of a hierarchical sweep, each at most ``branching`` times as long as the one before.

    Args:
        array: The whole array, which is the last of them.
        branching: Of each axis; one of which no number up to that is a divisor stays whole.

    Returns:
        Arrays with fewer rows and columns in each panel and polarization, the smallest first.

    Example:
        >>> [(a.rows, a.columns) for a in narrowing(AntennaArray(rows=2, columns=64), 4)]
        [(2, 4), (2, 16), (2, 64)]
    """
    rows, columns = _sizes(array.rows, branching), _sizes(array.columns, branching)
    depth = max(len(rows), len(columns))
    # The shorter axis is whole from its end on: its beams are told apart while those of the other are wide.
    rows += rows[-1:] * (depth - len(rows))
    columns += columns[-1:] * (depth - len(columns))
    return [replace(array, rows=r, columns=c) for r, c in zip(rows, columns, strict=True)]


def _sizes(size: int, branching: int) -> list[int]:
    # Whole ratios alone: else beams lie on the border of wider ones, and the sweep goes astray there.
    sizes = [size]
    while sizes[0] > branching:
        divisor = next((d for d in range(branching, 1, -1) if sizes[0] % d == 0), 0)
        if not divisor:
            break
        sizes.insert(0, sizes[0] // divisor)
    return sizes


def used_elements(whole: AntennaArray, part: AntennaArray) -> Int64Array:
    """Elements of an array that a smaller one has: the first rows and columns of each block.

    Args:
        whole: The array.
        part: The same with fewer rows and columns.

    Example:
        >>> used_elements(AntennaArray(rows=2, columns=3), AntennaArray(rows=1, columns=2)).tolist()
        [0, 2]
    """
    blocks = whole.size // (whole.rows * whole.columns)
    grid = np.arange(whole.size).reshape(blocks, whole.columns, whole.rows)
    return grid[:, : part.columns, : part.rows].reshape(-1)


@lru_cache(maxsize=256)
def children(wide: AntennaArray, narrow: AntennaArray) -> tuple[Int64Array, ...]:
    """The beams of a codebook within each beam of a wider one.

    Along an axis, beam j of m elements is within beam ⌊j·n/m⌋ of n.

    Args:
        wide: Array of the wider beams.
        narrow: The same with more rows or columns.

    Returns:
        Of each beam of ``wide`` those of ``narrow``; each of these is within one.

    Example:
        >>> [beams.tolist() for beams in children(AntennaArray(columns=2), AntennaArray(columns=4))]
        [[0, 1], [2, 3]]
    """
    blocks = wide.size // (wide.rows * wide.columns)
    # Beam k has p = k % rows and q = k // rows, block by block (`caviar_protocol.topics.Link`).
    within = np.empty((blocks, narrow.columns, narrow.rows), np.int64)
    rows, columns = _parents(wide.rows, narrow.rows), _parents(wide.columns, narrow.columns)
    for block in range(blocks):
        within[block] = (block * wide.columns + columns[:, None]) * wide.rows + rows
    flat = within.reshape(-1)
    found: dict[int, list[int]] = defaultdict(list)
    for beam, parent in enumerate(flat.tolist()):
        found[parent].append(beam)
    return tuple(np.array(found[parent], np.int64) for parent in range(wide.size))


def _parents(wide: int, narrow: int) -> Int64Array:
    """The beam of ``wide`` elements along an axis that each one of ``narrow`` is within."""
    parents: Int64Array = np.arange(narrow) * wide // narrow
    return parents


Axes = tuple[
    Annotated[int, quantity("1", "rows", ge=1, le=1024)],
    Annotated[int, quantity("1", "columns", ge=1, le=1024)],
]


class OutOfBandSettings(PilotSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the agent ``out-of-band``."""

    aid: str = ""
    """Name of the carrier whose spectrum is used; empty: that of the lowest frequency."""
    tx_elements: Axes | None = None
    """Rows and columns of each panel that the transmitter has on that carrier; absent: all of its array."""
    rx_elements: Axes | None = None
    """The same of the receiver."""
    candidates: Annotated[int, quantity("1", "pairs that are tried on each other carrier", ge=1, le=4096)] = 8
    """1: the strongest pair of the spectrum is taken without a pilot."""


class OutOfBandAgent(PilotAgent[OutOfBandSettings]):
    """Tries the pairs in which the spatial spectrum of a lower carrier is strongest.

    The lower carrier itself is served with the best pair of its codebook, as its arrays receive with all
    elements at once.

    Raises:
        ScenarioError: The scenario has one carrier alone, or none of the name ``aid``.
    """

    Settings = OutOfBandSettings
    _aid: str

    def __init__(self, settings: OutOfBandSettings, run: RunInfo) -> None:
        super().__init__(settings, run)
        self._aid = settings.aid

    def prepare(self, preparation: Preparation) -> Prepared:
        """Find the carrier that aids."""
        carriers = self.run.carriers
        names = [carrier.name for carrier in carriers]
        if len(carriers) < 2:
            raise ScenarioError(
                f"{self.run.name!r} looks at a lower carrier, and the scenario has "
                f"{names[0] if names else 'none'} alone; add another [[carriers]]"
            )
        if self._aid and self._aid not in names:
            raise ScenarioError(
                f"no carrier is called {self._aid!r}; {suggestion(self._aid, names)}",
                key=self.run.settings_place.at("aid").key,
            )
        self._aid = self._aid or min(carriers, key=lambda carrier: carrier.frequency_hz).name
        return super().prepare(preparation)

    def select(self, sounding: Sounding) -> Iterator[Measured]:
        """The best of the pairs that the spectrum names; where it is dark, no choice."""
        users = sounding.users
        aiding = {(u.tx.name, u.rx.name): i for i, u in enumerate(users) if u.carrier.name == self._aid}
        for index, user in enumerate(users):
            aid = aiding.get((user.tx.name, user.rx.name))
            matrix = None if aid is None else sounding.h[aid]
            if matrix is None:
                continue
            if index == aid:
                best = best_pairs(beam_gains(matrix, user.tx.array, user.rx.array)[None], 1)
                yield Measured(index, int(best.tx_beam[0, 0]), int(best.rx_beam[0, 0]))
                continue
            listed = best_pairs(self._spectrum(user, matrix)[None], self.settings.candidates)
            beams = listed.tx_beam[0].tolist(), listed.rx_beam[0].tolist()
            found = sounding.best_of(index, list(zip(*beams, strict=True)))
            if found is not None:
                yield found

    def _spectrum(self, user: User, matrix: Complex128Array) -> Float64Array:
        """|y| of all pairs with the elements that there are on the lower carrier, Shape ``[Nt, Nr]``."""
        settings = self.settings
        # With the others 0 the beams of the whole codebook sample the spectrum of fewer elements.
        seen = np.zeros_like(matrix)
        of_rx = _elements(user.rx.array, settings.rx_elements)
        kept = np.ix_(of_rx, _elements(user.tx.array, settings.tx_elements))
        seen[kept] = matrix[kept]
        return beam_gains(seen, user.tx.array, user.rx.array)


def _elements(array: AntennaArray, axes: tuple[int, int] | None) -> Int64Array:
    if axes is None:
        return np.arange(array.size)
    rows, columns = min(axes[0], array.rows), min(axes[1], array.columns)
    return used_elements(array, replace(array, rows=rows, columns=columns))
