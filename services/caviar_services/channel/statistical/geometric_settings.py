"""Settings of the channel ``geometric``.

Their defaults are the medians of 3GPP TR 38.901, table 7.5-6, UMi street canyon with line of sight at
28 GHz, rounded.
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from caviar_protocol.arrays import quantity
from caviar_services.channel.base import ChannelSettings

Corner = tuple[float, float, float]
Spread = Annotated[float, quantity("°", "standard deviation of a Laplacian", ge=0, le=180)]


class Obstacle(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A box along the world's axes that blocks the line of sight."""

    minimum_m: Annotated[Corner, quantity("m", "lowest corner")]
    maximum_m: Annotated[Corner, quantity("m", "highest corner")]

    def __post_init__(self) -> None:
        if not all(low < high for low, high in zip(self.minimum_m, self.maximum_m, strict=True)):
            raise ValueError(f"minimum_m {self.minimum_m} is not below maximum_m {self.maximum_m}")


class GeometricSettings(ChannelSettings, frozen=True, kw_only=True):
    """Settings of the channel ``geometric``; ``atmosphere`` goes with ``path-loss``."""

    components: Annotated[int, quantity("1", "waves of a pair, L", ge=1, le=64)] = 3
    k_factor_db: Annotated[
        float, quantity("dB", "power of the straight path over the rest", ge=-100, le=100)
    ] = 9.0
    delay_spread_ns: Annotated[float, quantity("ns", "mean excess delay", ge=0, le=1e6)] = 32.0
    azimuth_spread_departure_deg: Spread = 14.0
    zenith_spread_departure_deg: Spread = 1.0
    azimuth_spread_arrival_deg: Spread = 41.0
    zenith_spread_arrival_deg: Spread = 4.0
    redraw: Literal["frame", "episode"] = "frame"
    """How long draws hold: each frame has new ones (the paper), or they last an episode."""
    nlos: Literal["never", "angle", "geometry"] = "never"
    """What blocks the line of sight: nothing; an angular range; the bounding boxes of other objects of the
    scene, and ``obstacles``."""
    nlos_azimuth_deg: (
        Annotated[tuple[float, float], quantity("°", "blocked range, both ends within")] | None
    ) = None
    """With ``nlos = "angle"``: azimuth of the receiver in the transmitter's axes, which is the angle θ that
    a base station computes from a user's position (the paper: 20° to 30°)."""
    obstacles: tuple[Obstacle, ...] = ()
    """With ``nlos = "geometry"``."""
    normalization: Literal["unit", "path-loss"] = "unit"
    nlos_loss_db: (
        Annotated[float, quantity("dB", "further loss without line of sight", ge=0, le=200)] | None
    ) = None
    """With ``normalization = "path-loss"``; 20 dB where it is not given."""

    def __post_init__(self) -> None:
        if (self.nlos == "angle") != (self.nlos_azimuth_deg is not None):
            raise ValueError(
                'nlos = "angle" and nlos_azimuth_deg go together; write both, for example '
                "nlos_azimuth_deg = [20.0, 30.0], or neither"
            )
        if self.nlos_azimuth_deg is not None and not self.nlos_azimuth_deg[0] < self.nlos_azimuth_deg[1]:
            raise ValueError(f"nlos_azimuth_deg is {list(self.nlos_azimuth_deg)}; write the lower end first")
        if self.obstacles and self.nlos != "geometry":
            raise ValueError('obstacles block nothing without nlos = "geometry"')
        if self.nlos_loss_db is not None and self.normalization != "path-loss":
            raise ValueError('nlos_loss_db belongs to normalization = "path-loss"')
        if self.atmosphere is not None and self.normalization != "path-loss":
            raise ValueError(
                'atmosphere belongs to normalization = "path-loss": "unit" has no loss over distance'
            )
