"""How strongly single elements send into a path and take from it.

Seen from the elements of an array, a path that is near starts in different directions, and a pattern that
slopes weights it differently. The gain is found at three places along each side of an array, with the
other array's centre, and is a parabola between them: to first order in the size of the arrays over the
length of the path, what both ends do adds up.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from caviar_protocol.arrays import Complex128Array, Float64Array, Int64Array
from caviar_protocol.topics import AntennaArray
from caviar_services.channel.paths import Antenna
from caviar_services.channel.propagation.patterns import Field, FormulaPattern, polarized_field


class ElementGains:
    """Amplitudes of P paths at single elements, without spreading and carrier phase.

    Parameters
    ----------
    antennas
        Transmitters and receivers.
    which
        Transmitter and receiver of each path, Shape ``[P]`` each.
    towards
        Where straight lines along the path from both lead [m], Shape ``[P, 3]`` each.
    transfer
        That of `PathTable`, times what takes its spreading out, Shape ``[P, 3, 3]``.
    wavelength
        [m].
    """

    def __init__(
        self,
        antennas: tuple[Sequence[Antenna], Sequence[Antenna]],
        which: tuple[Int64Array, Int64Array],
        towards: tuple[Float64Array, Float64Array],
        transfer: Complex128Array,
        wavelength: float,
    ) -> None:
        self._parts: dict[tuple[AntennaArray, AntennaArray], tuple[Complex128Array, Complex128Array]] = {}
        self._place = np.zeros(len(transfer), np.int64)
        for arrays in {(tx.array, rx.array) for tx in antennas[0] for rx in antennas[1]}:
            ends = [
                np.array([antenna.array == array for antenna in side], bool)
                for side, array in zip(antennas, arrays, strict=True)
            ]
            rows = np.flatnonzero(ends[0][which[0]] & ends[1][which[1]])
            self._place[rows] = np.arange(len(rows))
            sent, taken = (
                _fields(array, side, index[rows], to[rows], wavelength)
                for array, side, index, to in zip(arrays, antennas, which, towards, strict=True)
            )
            middle_sent, middle_taken = (field[:, field.shape[1] // 2] for field in (sent, taken))
            onward = (middle_taken[:, None] @ transfer[rows])[:, 0]
            back = (transfer[rows] @ middle_sent[:, :, None])[:, :, 0]
            centre = (onward * middle_sent).sum(-1)[:, None]
            self._parts[arrays] = (
                (sent @ onward[:, :, None])[:, :, 0],
                (taken @ back[:, :, None])[:, :, 0] - centre,
            )

    def of(
        self, rows: slice, transmit: AntennaArray, receive: AntennaArray
    ) -> tuple[Complex128Array, Complex128Array]:
        """Parts of which amplitudes of paths between these arrays are sums, ``[p, N]`` and ``[p, M]``."""
        place = self._place[rows]
        sent, taken = self._parts[transmit, receive]
        return sent[place] @ _nodes(transmit)[1].T, taken[place] @ _nodes(receive)[1].T


def _fields(
    array: AntennaArray,
    antennas: Sequence[Antenna],
    which: Int64Array,
    towards: Float64Array,
    wavelength: float,
) -> Field:
    """Fields towards paths at the places of an array, world axes, Shape ``[P, K, 3]``."""
    nodes, _ = _nodes(array)
    rotation = np.array([antenna.rotation for antenna in antennas])[which]
    centre = np.array([antenna.position for antenna in antennas])[which]
    away = (towards - centre)[:, None] @ rotation - wavelength * nodes
    length = np.sqrt((away**2).sum(-1, keepdims=True))
    local = (away / np.where(length > 0, length, 1.0)).reshape(-1, 3)
    # Antennas of one array have the same pattern.
    pattern = next((antenna.pattern for antenna in antennas if antenna.array == array), None)
    field = polarized_field(pattern or FormulaPattern(array.pattern), array.polarization, local)
    world: Field = field.reshape(*away.shape) @ rotation.transpose(0, 2, 1)
    return world


@lru_cache(maxsize=256)
def _nodes(array: AntennaArray) -> tuple[Float64Array, Float64Array]:
    """Places in the axes of an array [wavelengths], Shape ``[K, 3]``, and their weights for its elements."""
    across = _axis(array.columns)
    down = _axis(array.rows)
    width = (array.columns - 1) / 2 * array.horizontal_spacing
    height = (array.rows - 1) / 2 * array.vertical_spacing
    nodes = np.array([[0.0, y * width, -z * height] for y in across[0] for z in down[0]])
    # Element i is row i % rows of column i // rows.
    weights = np.einsum("ca,rb->crab", across[1], down[1]).reshape(array.size, -1)
    return nodes, weights


def _axis(count: int) -> tuple[Float64Array, Float64Array]:
    """Places along one side as parts of its half, and Lagrange's weights of each for ``count`` elements."""
    if count == 1:
        return np.zeros(1), np.ones((1, 1))
    at = np.linspace(-1.0, 1.0, count)
    return np.array([-1.0, 0.0, 1.0]), np.stack([at * (at - 1) / 2, 1 - at**2, at * (at + 1) / 2], axis=1)
