"""Interference: what receivers get from transmitters that serve others at the same time, on the same carrier.

Receiver u listens with its beam w_u; a transmitter x serves its users v with beams f_v and spreads its power
P_x evenly over those that it serves at once or in turn, K_x of them. Beside the noise N_u there is

    I_u = Σ_x P_x · (1/K_x) · Σ_v |w_u* H_xu f_v|²   over all x that do not serve u,

and the SINR is S_u/(I_u + N_u).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int32Array, Int64Array
from caviar_services.link.base import Users
from caviar_services.link.beam_sweep import Swept


def amplitudes(
    swept: Sequence[Swept], count: int, users: Int64Array, tx_beams: Int64Array, rx_beams: Int64Array
) -> Float64Array:
    """Look up |w* H f| of beams that need not be those of one user.

    Args:
        swept: All beam pairs of all users that have a path.
        count: Number of users, U.
        users: Index of the user whose H it is, any Shape.
        tx_beams: Index of f in the codebook of its transmitter, of the same Shape.
        rx_beams: Index of w in the codebook of its receiver, of the same Shape.

    Returns:
        |y|, of the same Shape; 0 without a path.
    """
    found = np.zeros(users.shape)
    for group in swept:
        place = np.full(count, -1, np.int64)
        place[group.users] = np.arange(len(group.users))
        where = place[users]
        if len(group.users) == count:
            return group.abs_y[where, tx_beams, rx_beams]
        here = where >= 0
        found[here] = group.abs_y[where[here], tx_beams[here], rx_beams[here]]
    return found


@dataclass(frozen=True, eq=False)
class Interferers:
    """Which users hear the transmitters of which others, while the same users are there; K pairs of these."""

    victims: Int64Array
    """The user that hears, Shape ``[K]``."""
    culprits: Int64Array
    """The user that the other transmitter serves, on the same carrier."""
    between: Int64Array
    """The user of that transmitter and the victim's receiver."""
    groups: Int64Array
    """A number for each user, the same for those of one transmitter and carrier, Shape ``[U]``."""

    @classmethod
    def of(cls, users: Users) -> Interferers:
        """Of the users of a scene.

        Args:
            users: All of them.

        Example:
            >>> from caviar_services.link.base import users_of
            >>> from caviar_services.testing.samples import CARRIERS, scene
            >>> len(Interferers.of(users_of(scene(0), CARRIERS)).victims)  # one base station
            0
        """
        names = [(user.tx.name, user.rx.name, user.carrier.name) for user in users]
        index = {name: number for number, name in enumerate(names)}
        groups: dict[tuple[str, str], int] = {}
        numbers = [groups.setdefault((tx, carrier), len(groups)) for tx, _, carrier in names]
        found = [
            (victim, culprit, index[other, rx, carrier])
            for victim, (tx, rx, carrier) in enumerate(names)
            for culprit, (other, _, same) in enumerate(names)
            if tx != other and carrier == same and (other, rx, carrier) in index
        ]
        victims, culprits, between = np.array(found, np.int64).reshape(-1, 3).T.copy()
        return cls(victims, culprits, between, np.array(numbers, np.int64))

    def noise_rise(
        self,
        swept: Sequence[Swept],
        power_over_noise: Float64Array,
        tx_beam: Int32Array,
        rx_beam: Int32Array,
    ) -> Float64Array:
        """Interference over noise of all users where each transmitter serves all its users with beams.

        Args:
            swept: All beam pairs of all users that have a path.
            power_over_noise: Of each user, Shape ``[U]``.
            tx_beam: Chosen TX beam of each user, −1 for one that is not served, Shape ``[U]``.
            rx_beam: Chosen RX beam, likewise.

        Returns:
            I/N, Shape ``[U]``; 0 for users that are not served.
        """
        served: BoolArray = tx_beam >= 0
        heard = served[self.victims] & served[self.culprits]
        victims, culprits, between = self.victims[heard], self.culprits[heard], self.between[heard]
        sharing = np.bincount(self.groups[served], minlength=int(self.groups.max(initial=0)) + 1)
        beams = tx_beam[culprits].astype(np.int64), rx_beam[victims].astype(np.int64)
        gain = amplitudes(swept, len(served), between, *beams) ** 2
        rise = power_over_noise[between] * gain / sharing[self.groups[culprits]]
        # One after the other, in the order of the culprits: equal sums on every machine.
        return np.bincount(victims, rise, minlength=len(served)).astype(np.float64)
