"""Settings of a dataset as its catalogue has them, checked before anything is made of them.

They are JSON in a database that comes from anywhere. Of a scenario only what `verify` and `look` read is
looked at, so that datasets of other versions, with more keys or fewer, can be read.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from caviar_clients.datasets.catalogue import Catalogue
from caviar_protocol.errors import RecordingError

_Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
_Small = Annotated[int, Meta(ge=0, le=2**24)]


class _Run(msgspec.Struct, frozen=True):
    name: str = ""
    seed: _Count = 0
    frames: _Count = 0
    sampling_period_ns: _Count = 0
    instants_s: tuple[float, ...] = ()
    record: tuple[str, ...] = ()


class _Carrier(msgspec.Struct, frozen=True):
    name: str = ""
    frequency_hz: Annotated[float, Meta(gt=0)] = 1.0
    bandwidth_hz: Annotated[float, Meta(gt=0)] = 1.0


class _Array(msgspec.Struct, frozen=True):
    rows: _Small = 1
    columns: _Small = 1


class _Device(msgspec.Struct, frozen=True):
    name: str = ""
    kind: str = ""
    role: str = ""
    on: str | None = None
    array: _Array | None = None
    power_dbm: float = 0.0
    size_px: tuple[_Small, _Small] = (0, 0)
    field_of_view_deg: float = 0.0
    range_m: tuple[float, float] = (0.0, 0.0)
    beams: _Small = 0
    azimuth_steps: _Small = 0
    count: _Count = 1


class _Box(msgspec.Struct, frozen=True):
    minimum_m: tuple[float, float, float]
    maximum_m: tuple[float, float, float]


class _Service(msgspec.Struct, frozen=True):
    role: str = ""
    use: str = ""
    settings: dict[str, Any] = {}


class _Scenario(msgspec.Struct, frozen=True):
    run: _Run = _Run()
    carriers: tuple[_Carrier, ...] = ()
    devices: tuple[_Device, ...] = ()
    services: dict[str, _Service] = {}


class _Settings(msgspec.Struct, frozen=True):
    scenario: _Scenario = _Scenario()
    files: dict[str, str] = {}
    versions: dict[str, str] = {}
    device: str = ""


def checked_settings(catalogue: Catalogue) -> dict[str, Any]:
    """Settings of a dataset as plain values.

    Args:
        catalogue: Of the dataset.

    Raises:
        RecordingError: They are not those of a dataset; names the key.
    """
    settings = catalogue.settings
    try:
        found = msgspec.convert(settings, _Settings)
        for spec in found.scenario.services.values():
            msgspec.convert(spec.settings.get("obstacles", ()), tuple[_Box, ...])
    except msgspec.ValidationError as error:
        raise RecordingError(
            f"{catalogue.path}: settings in table dataset are not those of a dataset: {error}; generate it "
            "anew with --overwrite"
        ) from error
    instants = found.scenario.run.instants_s
    if instants and (len(instants) < found.scenario.run.frames or not all(map(math.isfinite, instants))):
        raise RecordingError(
            f"{catalogue.path}: settings in table dataset: scenario.run.instants_s has {len(instants)} "
            f"instants for {found.scenario.run.frames} scenes; generate it anew with --overwrite"
        )
    return settings
