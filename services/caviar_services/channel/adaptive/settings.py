"""Settings of the adaptive channel, and the models that they name."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Annotated, Any

import msgspec

from caviar_protocol.arrays import quantity
from caviar_protocol.errors import DeclarationError, ScenarioError, suggestion
from caviar_protocol.scenario.conversion import Place, convert_settings
from caviar_services.channel.base import ChannelModel
from caviar_services.registry import load
from caviar_services.service import RunInfo


class LadderRung(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One rung: a channel model with its settings."""

    label: str
    """Its name in decisions and products."""
    use: str = "sionna-rt"
    """Any registered channel model."""
    settings: dict[str, Any] = msgspec.field(default_factory=dict)
    """Its own, beside and before those in ``common``."""
    expected_error_db: (
        Annotated[float, quantity("dB", "NMSE of a pair's H against the reference, until it is measured")]
        | None
    ) = None


class AdaptiveSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A ladder, and when to stand on which of its rungs."""

    ladder: tuple[LadderRung, ...] = ()
    """From the fastest to the most accurate."""
    common: dict[str, Any] = msgspec.field(default_factory=dict)
    """Settings of every rung whose model has them."""
    fixed: str = ""
    """Label of the rung that every frame is computed on; empty: what fits the budget. A run whose rung
    follows from durations cannot be repeated, unless its decisions are imposed."""
    budget_ms: (
        Annotated[float, quantity("ms", "for a frame, in place of the service's own budget", gt=0)] | None
    ) = None
    quantile: Annotated[float, quantity("1", "of a frame's duration that must fit", gt=0, lt=1)] = 0.95
    share: Annotated[float, quantity("1", "of the budget that it may take", gt=0, le=1)] = 0.8
    margin: Annotated[float, quantity("1", "of that which is spare before going up", ge=0, lt=1)] = 0.1
    patience: Annotated[int, quantity("frame", "that must have it in a row", ge=1)] = 10
    calibrate_every: Annotated[
        int,
        quantity("frame", "from one that the reference computes too to the next; 0: none", ge=0),
    ] = 0
    reference: LadderRung | None = None
    """The channel that counts as exact where errors are measured: more accurate than any rung, and too slow
    to be one. Absent: the highest rung."""

    @property
    def labels(self) -> tuple[str, ...]:
        """Of the rungs, lowest first."""
        return tuple(rung.label for rung in self.ladder)


@dataclass(frozen=True, kw_only=True)
class Rung:
    """A rung that is built."""

    label: str
    model: ChannelModel[Any]
    expected_error_db: float | None


@contextmanager
def naming(label: str) -> Iterator[None]:
    """Errors raised within say of which rung they are; a key that they begin with stays in front.

    Args:
        label: Of the rung.
    """
    try:
        yield
    except Exception as error:
        error.args = (f"{error} (rung {label!r})", *error.args[1:])
        raise


def built(settings: AdaptiveSettings, run: RunInfo) -> tuple[Rung, ...]:
    """The ladder of a scenario, and after it the reference where that is no rung. Raises `ScenarioError`
    naming the key for whatever cannot be."""
    place = run.settings_place
    every = zip(_every(settings), _places(settings, place), models(settings, place), strict=True)
    return tuple(
        Rung(
            label=rung.label,
            model=cls(own, replace(run, settings_key=at.at("settings").key)),
            expected_error_db=rung.expected_error_db,
        )
        for rung, at, (cls, own) in every
    )


def _places(settings: AdaptiveSettings, place: Place) -> list[Place]:
    """Where each of the rungs, and the reference where it is none, stands."""
    places = [place.at("ladder").at(index) for index in range(len(settings.ladder))]
    return places if settings.reference is None else [*places, place.at("reference")]


def _every(settings: AdaptiveSettings) -> tuple[LadderRung, ...]:
    """The rungs, and the reference where it is none."""
    return settings.ladder if settings.reference is None else (*settings.ladder, settings.reference)


def models(settings: AdaptiveSettings, place: Place) -> list[tuple[type[ChannelModel[Any]], Any]]:
    """The channel model of each rung, and of a reference that is none, with its settings. Errors as those of
    `built`.

    ``place`` is where ``settings`` stand.
    """
    _check(settings, place)
    every = _every(settings)
    places = _places(settings, place)
    found = [_model(rung.use, where) for rung, where in zip(every, places, strict=True)]
    known = [frozenset(cls.Settings.__struct_fields__) for cls in found]
    for name in settings.common:
        if not any(name in fields for fields in known):
            everything = frozenset[str]().union(*known)
            raise (
                place.at("common")
                .at(name)
                .error(f"no rung has a setting {name!r}; {suggestion(name, everything)}")
            )
    made: list[tuple[type[ChannelModel[Any]], Any]] = []
    for rung, at, cls, fields in zip(every, places, found, known, strict=True):
        shared = {n: v for n, v in settings.common.items() if n in fields and n not in rung.settings}
        where = at.at("settings")
        try:
            own = convert_settings(cls.Settings, {**shared, **rung.settings}, where)
            cls.check_settings(own, where)
        except ScenarioError as error:
            raise _where_it_stands(error, shared, where, place.at("common")) from error
        made.append((cls, own))
    return made


def _where_it_stands(
    error: ScenarioError, shared: Mapping[str, Any], where: Place, common: Place
) -> ScenarioError:
    """An error about a rung's settings, which names ``common`` where the value stands there."""
    rest = error.key.removeprefix(where.key)
    if any(re.match(rf"\.{re.escape(name)}(?![A-Za-z0-9_-])", rest) for name in shared):
        return Place(common.key + rest, common.source).error(error.message)
    return error


def _model(use: str, place: Place) -> type[ChannelModel[Any]]:
    """The channel model that a rung names."""
    try:
        cls = load("channel", use)
    except DeclarationError as error:
        raise place.at("use").error(str(error)) from error
    if not issubclass(cls, ChannelModel):
        raise place.at("use").error(f"is {use!r}, which is no ChannelModel and cannot be a rung")
    return cls


def rung_of(labels: tuple[str, ...], label: str, what: str) -> int:
    """Index of a label. Raises `ScenarioError` naming ``what`` asked for it, and the labels."""
    if label not in labels:
        raise ScenarioError(f"{what} is {label!r}, which is no rung; {suggestion(label, labels)}")
    return labels.index(label)


def _check(settings: AdaptiveSettings, place: Place) -> None:
    ladder = place.at("ladder")
    if not settings.ladder:
        raise ladder.error(f"has no rung; write [[{ladder.key}]] with label, use and settings for each")
    for label, count in Counter(rung.label for rung in _every(settings)).items():
        if count > 1:
            raise ladder.error(f"has {count} rungs with the label {label!r}; give each its own")
    if settings.fixed and settings.fixed not in settings.labels:
        hint = suggestion(settings.fixed, settings.labels)
        raise place.at("fixed").error(f"is {settings.fixed!r}, which is no rung; {hint}")
