"""What the users of a scene get from a channel, and how two channels differ for one of them.

A user is a pair of devices on one carrier, as for the link.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from caviar_clients.tradeoff import errors
from caviar_clients.tradeoff.scenes import Scenes
from caviar_protocol.arrays import Complex128Array, Float64Array
from caviar_protocol.scenario.conversion import convert_settings
from caviar_protocol.topics import Channel, Scene
from caviar_services.link.beams import BeamLinkSettings, noise_power, transmit_power
from caviar_services.link.sweep import sweep
from caviar_services.link.users import User, channels_of, users_of

Key = tuple[int, str, str, str]
"""Frame, transmitter, receiver, carrier."""

ANGLES = ("aod_zenith", "aod_azimuth", "aoa_zenith", "aoa_azimuth")


@dataclass(frozen=True)
class Noise:
    """What the capacity takes from the link's settings; see `BeamLinkSettings`."""

    figure_db: float
    temperature_k: float

    @classmethod
    def of(cls, scenes: Scenes) -> Noise:
        """That of the scenario's link ``beams``, else the link's default."""
        settings = convert_settings(BeamLinkSettings, scenes.settings_of("link", "beams"))
        return cls(settings.noise_figure_db, settings.temperature_k)


@dataclass(frozen=True, kw_only=True, eq=False)
class UserChannel:
    """One user's channel and what follows from it; no path, no spread: None."""

    los: bool
    path_gain_db: float
    """−∞ without a path."""
    delay_spread_s: float | None
    angular_spread_rad: tuple[float, ...] | None
    """In the order of `ANGLES`."""
    h: Complex128Array | None
    capacity_bps_hz: float
    abs_y: Float64Array | None
    """|y| of all pairs of beams, Shape ``[Nt, Nr]``."""
    ranked: list[int]
    """The five best pairs, best first; none without a path."""


def user_channels(frame: int, scene: Scene, channel: Channel, noise: Noise) -> dict[Key, UserChannel]:
    """The channels of all users of a scene."""
    users = users_of(scene, channel.carriers)
    looked_up = channels_of(channel, users)
    return {
        (frame, user.tx.name, user.rx.name, user.carrier.name): _user_channel(
            user, channel, bool(los), h, noise
        )
        for user, los, h in zip(users, looked_up.los, looked_up.h, strict=True)
    }


def _user_channel(
    user: User, channel: Channel, los: bool, h: Complex128Array | None, noise: Noise
) -> UserChannel:
    if h is None:
        return UserChannel(
            los=los,
            path_gain_db=-np.inf,
            delay_spread_s=None,
            angular_spread_rad=None,
            h=None,
            capacity_bps_hz=0.0,
            abs_y=None,
            ranked=[],
        )
    paths = channel.pair(user.tx.name, user.rx.name)
    a = channel.a[channel.carriers.index(user.carrier), paths]
    power = np.abs(a) ** 2
    directions = np.concatenate([channel.aod[paths], channel.aoa[paths]], axis=1)
    noise_w = noise_power(user.carrier, noise.figure_db, noise.temperature_k)
    abs_y = sweep(h, user.tx.array, user.rx.array)
    return UserChannel(
        los=los,
        path_gain_db=errors.path_gain_db(a),
        delay_spread_s=errors.delay_spread_s(channel.tau[paths], power),
        angular_spread_rad=tuple(errors.angular_spread_rad(angle, power) for angle in directions.T),
        h=h,
        capacity_bps_hz=errors.capacity_bps_hz(h, transmit_power(user) / noise_w),
        abs_y=abs_y,
        ranked=errors.top_k(abs_y, 5),
    )


class Difference(NamedTuple):
    """How far a user's channel is from the reference's; None where one of them has no path."""

    missed: bool
    """The reference has a path, the channel none."""
    invented: bool
    """The other way round."""
    los_agrees: bool
    path_gain_db: float | None
    delay_spread_s: float | None
    angular_spread_rad: tuple[float, ...] | None
    nmse: float | None
    """None where the reference has no path."""
    capacity_bps_hz: float
    top1: bool | None
    top5: bool | None
    pair_loss_db: float | None


def difference(found: UserChannel, reference: UserChannel) -> Difference:
    """Found minus reference."""
    has, should = found.h is not None, reference.h is not None
    spreads = None
    if found.angular_spread_rad is not None and reference.angular_spread_rad is not None:
        pairs = zip(found.angular_spread_rad, reference.angular_spread_rad, strict=True)
        spreads = tuple(got - expected for got, expected in pairs)
    delay = None
    if found.delay_spread_s is not None and reference.delay_spread_s is not None:
        delay = found.delay_spread_s - reference.delay_spread_s
    value, top1, top5, loss = None, None, None, None
    if reference.h is not None and reference.abs_y is not None:
        value = 1.0 if found.h is None else errors.nmse(found.h, reference.h)
        top1, top5 = (errors.hit(found.ranked, reference.ranked, k) for k in (1, 5))
        loss = errors.pair_loss_db(reference.abs_y, found.ranked[0]) if found.ranked else None
    return Difference(
        missed=should and not has,
        invented=has and not should,
        los_agrees=found.los == reference.los,
        path_gain_db=found.path_gain_db - reference.path_gain_db if has and should else None,
        delay_spread_s=delay,
        angular_spread_rad=spreads,
        nmse=value,
        capacity_bps_hz=found.capacity_bps_hz - reference.capacity_bps_hz,
        top1=top1,
        top5=top5,
        pair_loss_db=loss,
    )


def differences(found: Mapping[Key, UserChannel], reference: Mapping[Key, UserChannel]) -> list[Difference]:
    """Of all users that both know."""
    return [difference(channel, reference[key]) for key, channel in found.items() if key in reference]
