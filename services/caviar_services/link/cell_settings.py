"""Settings of the link ``cell``: traffic, slots, scheduler, rates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Literal

import msgspec

from caviar_protocol.arrays import quantity
from caviar_protocol.cell.scheduling import Scheduler
from caviar_protocol.cell.traffic import Traffic, check_traffic
from caviar_protocol.errors import suggestion
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.scenario.rules import patterns_overlap
from caviar_services.link.association import AssociationRule
from caviar_services.link.beam_scores import RewardKind, SweepSettings
from caviar_services.link.slot_rates import Sharing

RateModel = Literal["shannon", "capped", "nr"]

CellReward = RewardKind | Literal["throughput", "delay"]


class CellSettings(SweepSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the link ``cell``, beside those of ``beams``."""

    reward: CellReward = "throughput"
    """As of ``beams``; or ``throughput`` [bit/s]; or ``delay``: minus the mean delay of the packets that were
    delivered in the frame [s]."""
    traffic: Annotated[tuple[Traffic, ...], msgspec.Meta(min_length=1)] = (Traffic(),)
    """What arrives for the receivers; a receiver that fits no entry has no traffic."""
    slots: Annotated[int, quantity("1", "of a frame, evenly long", ge=1, le=10_000)] = 1
    rate_model: RateModel = "shannon"
    """Spectral efficiency of a user: ``shannon``: log2(1 + SINR); ``capped``: this up to
    ``max_spectral_efficiency``, by default 7.4063 bit/s/Hz of 256-QAM (3GPP TS 38.214); ``nr``: transport
    blocks of 5G NR that fail at random, from the tables of Sionna SYS (extra ``system``)."""
    selective: tuple[Literal["time", "frequency"], ...] = ()
    """What of the channel changes within a frame, as its paths say: ``time``: H of each slot, by the Doppler
    shifts; ``frequency``: H over the band, by the delays, of ``nr`` only. Without, H is that of the frame's
    instant and of the carrier. For channels with plane waves."""
    mcs_table: Annotated[int, quantity("1", "of modulation and coding schemes", ge=1, le=2)] = 2
    """Of ``nr``: 1: up to 64-QAM, 2: up to 256-QAM (3GPP TS 38.214, tables 5.1.3.1-1 and -2)."""
    target_block_error: Annotated[float, quantity("1", "share of blocks that may fail", gt=0, lt=1)] = 0.1
    """Of ``nr``: schemes are chosen so that no more blocks are expected to."""
    outer_loop_db: Annotated[float, quantity("dB", "step after a failed block", ge=0, le=20)] = 1.0
    """Of ``nr``: by as much schemes are chosen more carefully after a failed block; 0: no outer loop."""
    scheduler: Scheduler = "round-robin"
    """Which users of a transmitter are served in a slot, of those with something to send and beams that an
    agent chose; where an agent schedules receivers, of these alone. ``round-robin``: who was not served for
    longest; ``max-rate``: for whom the slot carries most bits; ``proportional-fair``: this over what each got
    on average."""
    users_per_slot: Annotated[int, quantity("1", "served at once by a transmitter", ge=1, le=1024)] = 1
    """They share the power evenly, and the band as ``sharing`` says; each has beams of its own."""
    sharing: Sharing = "band"
    """``band``: users served at once have equal parts of the band; ``space``: each has all of it, and hears
    the beams of the others."""
    interference: bool = True
    """Whether users hear transmitters that serve others on their carrier in the same slot."""
    association: AssociationRule = "best"
    """Which transmitter serves a receiver on a carrier: ``best``: that whose best pair of beams brings most
    power; ``sticky``: the one before, until another one brings more by ``hysteresis_db``; ``agent``: that of
    which the agent chose beams, which may be one only; where it chose none, the one before."""
    hysteresis_db: Annotated[float, quantity("dB", "that another transmitter has to be better by", ge=0)] = (
        3.0
    )
    """Of ``sticky``."""
    handover_slots: Annotated[int, quantity("1", "without service after a handover", ge=0, le=10**6)] = 0
    """A handover is a change of the transmitter; packets stay in the buffer."""
    average_slots: Annotated[float, quantity("slot", "that the average of fairness forgets in", ge=1)] = 100.0
    """Of ``proportional-fair``."""


def check_traffic_users(settings: CellSettings, devices: Sequence[DeviceSpec], place: Place) -> None:
    """Refuse traffic of receivers that the scenario cannot have: a name that is misspelt would send nothing.

    Args:
        settings: The settings.
        devices: Of the scenario; none where they are not known.
        place: Where the settings stand.

    Raises:
        ScenarioError: No receiver fits; names the key, and the receivers.

    Example:
        >>> from caviar_protocol.errors import ScenarioError
        >>> from caviar_protocol.scenario import load_scenario
        >>> wrong = CellSettings(traffic=(Traffic(users=("car/*",)),))
        >>> try:
        ...     check_traffic_users(wrong, load_scenario("geometric").devices, Place("settings"))
        ... except ScenarioError as error:
        ...     print(error)
        settings.traffic[0].users[0]: 'car/*' is no receiver of the scenario; known: uav/rx
    """
    receivers = [device for device in devices if device.kind == "antenna" and device.role in ("rx", "both")]
    names = [f"{device.on}/{device.name}" if device.on else device.name for device in receivers]
    for index, entry in enumerate(settings.traffic if names else ()):
        mine = place.at("traffic").at(index).at("users")
        if not entry.users:
            raise mine.error('is empty, so that nothing arrives; write users = ["*"], or leave the entry out')
        for position, pattern in enumerate(entry.users):
            if not any(patterns_overlap(name, pattern) for name in names):
                text = f"{pattern!r} is no receiver of the scenario; {suggestion(pattern, names)}"
                raise mine.at(position).error(text)


# What a key belongs to: another key, and its value; with other values it has no effect.
_BELONGS: Mapping[str, tuple[str, str]] = {
    "average_slots": ("scheduler", "proportional-fair"),
    "mcs_table": ("rate_model", "nr"),
    "target_block_error": ("rate_model", "nr"),
    "outer_loop_db": ("rate_model", "nr"),
    "hysteresis_db": ("association", "sticky"),
}


def check_cell_settings(settings: CellSettings, place: Place) -> None:
    """Check what the types of settings do not say.

    Args:
        settings: The settings.
        place: Where they stand.

    Raises:
        ScenarioError: A key is missing or has no effect, or a trace is wrong; names key, or file and line.

    Example:
        >>> from caviar_protocol.errors import ScenarioError
        >>> try:
        ...     check_cell_settings(CellSettings(max_spectral_efficiency=5.55), Place("settings"))
        ... except ScenarioError as error:
        ...     print(error)
        settings.max_spectral_efficiency: has no effect with rate_model 'shannon'; write rate_model = "capped"
    """
    for index, entry in enumerate(settings.traffic):
        check_traffic(entry, place.at("traffic").at(index))
    if "frequency" in settings.selective and settings.rate_model != "nr":
        raise place.at("selective").error(
            f"'frequency' has no effect with rate_model {settings.rate_model!r}, for which the band is flat; "
            'write rate_model = "nr", or selective = ["time"]'
        )
    if settings.max_spectral_efficiency is not None and settings.rate_model != "capped":
        raise place.at("max_spectral_efficiency").error(
            f'has no effect with rate_model {settings.rate_model!r}; write rate_model = "capped"'
        )
    for key, (owner, value) in _BELONGS.items():
        found = getattr(settings, owner)
        if found != value and _is_given(settings, key, place):
            raise place.at(key).error(
                f'has no effect with {owner} {found!r}; leave it out, or write {owner} = "{value}"'
            )
    if settings.users_per_slot == 1 and _is_given(settings, "sharing", place):
        raise place.at("sharing").error(
            "has no effect with users_per_slot 1; leave it out, or write users_per_slot = 2 or more"
        )


def _is_given(settings: CellSettings, key: str, place: Place) -> bool:
    """Whether a key stands in the file; of settings made in Python, whether it is not its default."""
    return place.source.holds(place.at(key).key) or getattr(settings, key) != getattr(_DEFAULTS, key)


_DEFAULTS = CellSettings()
