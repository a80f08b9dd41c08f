"""Rung ``free-space``: the line of sight by formula, occlusion ignored.

Needs no ray tracer. a = λ/(4πd) · (field of RX · field of TX) · exp(−j2πfτ) with τ = d/c (Friis
1946, with the polarisation mismatch of the two elements).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from caviar_protocol.space.coordinates import SPEED_OF_LIGHT
from caviar_protocol.topics import Scene
from caviar_services.channel.base import ChannelSettings, Found, PathModel, SameChannels
from caviar_services.channel.paths import Antenna, PathTable, path_ends


class FreeSpaceSettings(ChannelSettings, frozen=True, kw_only=True):
    """Settings of the channel ``free-space``: those of all channel models."""


class FreeSpaceChannel(PathModel[FreeSpaceSettings]):
    """One path for each TX/RX pair: the line of sight.

    A pair closer than one wavelength of a carrier, so also a device and itself, is outside the
    far field that the formula holds in: it has no path and counts as ``too_close``.
    """

    Settings: ClassVar[type[ChannelSettings]] = FreeSpaceSettings
    rung = "free-space"
    batches = True

    def batch(self) -> SameChannels:
        """Make the channels of many episodes at once, which are the same in all of them."""
        return SameChannels(self)

    def paths(self, scene: Scene, transmitters: Sequence[Antenna], receivers: Sequence[Antenna]) -> Found:
        start, end = path_ends(np.arange(len(transmitters) * len(receivers)), transmitters, receivers)
        distance = np.sqrt(((end - start) ** 2).sum(-1))
        wavelength = SPEED_OF_LIGHT / np.array([carrier.frequency_hz for carrier in self.run.carriers])
        far = np.flatnonzero(distance >= wavelength.max())
        spreading = wavelength[:, None] / (4 * np.pi * distance[far])
        table = PathTable(
            pair=far,
            # Both fields are transverse to the line, so the dyad of the line is that of the field.
            transfer=spreading[:, :, None, None] * np.eye(3, dtype=np.complex128),
            types=np.zeros((len(far), 0), np.uint8),
            objects=np.zeros((len(far), 0), np.int32),
            points=np.zeros((len(far), 0, 3)),
            object_names=(),
            object_velocity=np.zeros((0, 3)),
        )
        return Found(
            table=table,
            los=np.ones((len(transmitters), len(receivers)), bool),
            counts={"too_close": len(distance) - len(far)},
        )
