"""Agent ``out-of-band``: what a lower carrier sees tells where to look at a higher one.

Paths leave and arrive under much the same angles on carriers of different frequency. A lower carrier has its
own link, whose arrays measure the spatial spectrum at no further cost; only the beam pairs in which it is
strongest are tried by pilots of the higher carrier (González-Prelcic, Ali, Va and Heath, "Millimeter-wave
communication with out-of-band information", IEEE Commun. Mag. 55(12), 2017; Ali, González-Prelcic and Heath,
"Millimeter wave beam-selection using out-of-band spatial information", IEEE Trans. Wireless Commun. 17(2),
2018). Both carriers stand in the channel product of the run; the spacing of elements is in wavelengths, so
that a beam of a codebook has the same direction on all of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

import numpy as np
from msgspec.structs import replace

from caviar_protocol.arrays import Complex128Array, Float64Array, Int64Array, quantity
from caviar_protocol.errors import ScenarioError, suggestion
from caviar_protocol.space.beams import beam_gains, best_pairs
from caviar_protocol.topics import AntennaArray
from caviar_services.agent.pilots import Measured, PilotAgent, PilotSettings, Sounding
from caviar_services.agent.sweeps import used_elements
from caviar_services.link.base import User
from caviar_services.service import Preparation, Prepared, RunInfo

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
