"""What paths lose beside free space and interactions: base of foliage and of people as screens."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace

from caviar_protocol.arrays import Float64Array, UInt8Array
from caviar_protocol.topics import Scene
from caviar_services.channel.paths import PathTable


class Attenuation(ABC):
    """Takes power from paths by where their legs run; delays, directions and phases stay."""

    @abstractmethod
    def move(self, scene: Scene) -> None:
        """Put what attenuates, as far as it moves, where the objects of a scene are.

        Args:
            scene: Of the frame.
        """

    @abstractmethod
    def amplitude_factor(
        self, start: Float64Array, points: Float64Array, end: Float64Array, types: UInt8Array
    ) -> Float64Array:
        """Factors of amplitudes, 0 to 1 or a little above.

        Args:
            start: Position of TX of each path [m], Shape ``[P, 3]``.
            points: Where it interacts [m], as in `PathTable`, Shape ``[P, D, 3]``.
            end: Position of RX of each path [m], Shape ``[P, 3]``.
            types: Of the interactions, Shape ``[P, D]``.

        Returns:
            Factors of Shape ``[C, P]``, one for each carrier.
        """

    def attenuated(self, table: PathTable, start: Float64Array, end: Float64Array) -> PathTable:
        """Weaken paths.

        Args:
            table: The paths.
            start: Position of TX of each path [m], Shape ``[P, 3]``.
            end: Position of RX of each path [m], Shape ``[P, 3]``.

        Returns:
            The same paths, with what they have lost in their ``transfer``.
        """
        factor = self.amplitude_factor(start, table.points, end, table.types)
        return replace(table, transfer=table.transfer * factor[..., None, None])
