"""What each minor version of the protocol brought, and what a run needs a service to know of it.

Most of what is new a reader of an earlier version passes over unharmed. Values of closed fields, and fields
that change what others mean, it cannot: a scenario that has them needs services of the version that brought
them (SPEC.md, section Versions).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec

from caviar_protocol.fields import Version

SINCE: dict[str, str] = {
    "Ready.seed": "1.1",
    "Done.seed": "1.1",
    "Reset.seed_episode": "1.1",
    "ChannelOptions.materials_outside": "1.1",
    "ChannelOptions.absorption_db_per_km": "1.1",
    "ChannelOptions.detail": "1.1",
    "ChannelOptions.foliage": "1.4",
    "Welcome.rejoin_ns": "1.3",
    "Prepare.prefixes": "1.3",
    "Fault.culprit": "1.3",
    "WaypointCommand.at_once": "1.3",
    "Scene.angular_velocity": "1.4",
    "Carrier.subcarriers": "1.4",
    "Carrier.subcarrier_spacing_hz": "1.4",
    "Carrier.taps": "1.4",
    "Carrier.slots": "1.4",
    "Carrier.slot_duration_s": "1.4",
    "ChannelResponse": "1.4",
    "ChannelTaps": "1.4",
    "Channel.hf": "1.4",
    "Channel.taps": "1.4",
    "AntennaArray.pattern_file": "1.4",
    "AntennaArray.panels": "1.4",
    "Panel": "1.4",
    "Channel.error_bound_db": "1.4",
    "Channel.error_reference": "1.4",
}
"""Minor version that brought a field (``Grant.reports``) or a class (``Grant``); 1.0 unless said here."""


VALUES_SINCE: dict[str, dict[str, str]] = {
    "AntennaArray.polarization": dict.fromkeys(
        ("-45", "+45", "RHCP", "LHCP", "VH", "cross", "circular"), "1.4"
    ),
}
"""Minor version that brought a value of a closed field; that of the field unless said here."""

PARTS_SINCE: dict[str, str] = {"channel.hf": "1.4", "channel.taps": "1.4"}
"""Minor version that brought a part of a topic; 1.0 unless said here."""

CHANGES_OTHERS = frozenset({"AntennaArray.pattern_file", "AntennaArray.panels"})
"""Fields that change what others mean, or what has to be delivered: the elements of an array, an asset."""


def parsed(since: str) -> Version:
    """``1.4`` as a version."""
    major, _, minor = since.partition(".")
    return int(major), int(minor)


def required_knowledge(value: msgspec.Struct) -> Iterator[tuple[str, Any, Version]]:
    """Field, value and version of what a reader of this struct has to know and 1.0 does not have."""
    cls = type(value)
    defaults = {field.name: field.default for field in msgspec.structs.fields(cls)}
    for name in value.__struct_fields__:
        key, got = f"{cls.__name__}.{name}", getattr(value, name)
        since = VALUES_SINCE.get(key, {}).get(got) if isinstance(got, str) else None
        if since is None and key in CHANGES_OTHERS and got != defaults[name]:
            since = SINCE[key]
        if since is not None:
            yield name, got, parsed(since)
