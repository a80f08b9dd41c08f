"""When the rungs of a ladder are timed and their errors measured: before the first frame while frames run.

Rehearsal scenes, which every rung is timed on before the first frame, have the scenario's antennas on bodies
that drive. Errors are those against the reference; what a rung states follows from them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import count, islice

import msgspec
import numpy as np
from msgspec.structs import replace

from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import ScenarioError
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.scenario.schema import fixed_device, mounted_device
from caviar_protocol.space.coordinates import Vector, quaternion_from_euler
from caviar_protocol.topics import Channel, Scene
from caviar_protocol.topics.scene import Device
from caviar_services.channel.adaptive.error_bounds import (
    BoundState,
    ErrorBound,
    errors_db,
    pair_powers,
    scores_db,
)
from caviar_services.channel.adaptive.settings import Rung
from caviar_services.channel.base import Modelled

_NEAREST, _SPACING = 12.0, 3.0
"""[m]: bodies stand about the first fixed antenna on a spiral."""

_GOLDEN_ANGLE = 2.4
"""[rad] from one to the next: never in line."""

_TRIED = 20
"""Places on the spiral that are looked at for each one that is needed."""

_DIMENSIONS = (4.5, 1.8, 1.6)
"""Of a body [m]: a car's."""

_HEIGHT = 1.5
"""[m] above the ground, of antennas whose objects have no body."""

_STEP = 0.5
"""[m] that bodies drive from one scene to the next: far enough that nothing is where it was."""

Free = Callable[[Vector], bool]
"""Whether a body may stand at a place."""


def rehearsal_scene(
    devices: Sequence[DeviceSpec],
    room: Mapping[str, int],
    ground_m: float = 0.0,
    is_free: Free = lambda place: True,
    step: int = 0,
) -> Scene:
    """All antennas that a scenario announces, and traffic: bodies that carry them, and as many that do not.

    Parameters
    ----------
    devices
        Of the scenario.
    room
        Bodies of each mesh that there may be, by asset; ``""`` is a box.
    ground_m
        Height of the ground [m].
    is_free
        Places where it is not true are left out, if there are enough others.
    step
        Scenes of successive steps are those of traffic that drives.
    """
    antennas = [spec for spec in devices if spec.kind == "antenna" and spec.role]
    fixed = [spec for spec in antennas if not spec.on]
    mounted = [spec for spec in antennas if spec.on for _ in range(spec.count)]
    found: list[Device] = [fixed_device(spec) for spec in fixed]
    middle = fixed[0].position_m if fixed else (0.0, 0.0, 0.0)
    spiral = _places(middle, ground_m + _DIMENSIONS[2] / 2, is_free, 2 * len(mounted))
    assets, names, position, orientation, velocity = _bodies(room), [], [], [], []
    for number, (place, heading) in enumerate(spiral):
        spec = mounted[number] if number < len(mounted) else None
        name, asset = f"rehearsal-{number:04d}", next(assets, None)
        along = np.array([math.cos(heading), math.sin(heading), 0.0])
        here = np.array(place) + step * _STEP * along
        carried = None if spec is None else mounted_device(spec, name, _DIMENSIONS)
        # An antenna in the middle of its object would be inside a body: its object is to have none.
        if carried is not None and (asset is None or carried.position == (0.0, 0.0, 0.0)):
            x, y, _ = here.tolist()
            found.append(_alone(carried, (x, y, ground_m + _HEIGHT + 0.1 * number)))
        elif asset is not None:
            found += [] if carried is None else [carried]
            names.append((name, asset))
            position.append(here)
            orientation.append(quaternion_from_euler(heading))
            velocity.append(_STEP * along)
    size = len(names)
    return Scene(
        names=tuple(name for name, _ in names),
        classes=("",) * size,
        assets=tuple(asset for _, asset in names),
        position=np.array(position).reshape(-1, 3),
        orientation=np.array(orientation).reshape(-1, 4),
        velocity=np.array(velocity).reshape(-1, 3),
        dimensions=np.tile(_DIMENSIONS, (size, 1)),
        devices=tuple(sorted(found, key=lambda device: device.name)),
    )


def _places(middle: Vector, height: float, is_free: Free, wanted: int) -> list[tuple[Vector, float]]:
    """Places on the spiral, free ones first, and headings along it [rad]."""

    def place(number: int) -> tuple[Vector, float]:
        radius, angle = _NEAREST + _SPACING * number, _GOLDEN_ANGLE * number
        x, y = middle[0] + radius * math.cos(angle), middle[1] + radius * math.sin(angle)
        return (x, y, height), angle + math.pi / 2

    every = [place(number) for number in range(_TRIED * wanted)]
    free = list(islice((found for found in every if is_free(found[0])), wanted))
    return free if len(free) == wanted else [*free, *(found for found in every if found not in free)][:wanted]


def _bodies(room: Mapping[str, int]) -> Iterator[str]:
    """Assets by turns while there is room; boxes where there is no mesh."""
    meshes = {asset: size for asset, size in room.items() if asset} or dict(room)
    for turn in count():
        left = [asset for asset in sorted(meshes) if turn < meshes[asset]]
        if not left:
            return
        yield from left


def _alone(device: Device, position: Vector) -> Device:
    """A device that stands in the world."""
    return replace(device, parent="", position=position)


DECISION = "state:errors"
"""Key, among the decisions of an episode's first frame, of what is known of errors from episodes before: a
replay of the episode, or a process that takes over in it, has to state the same."""


class CalibrationState(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A `Calibration` between two frames."""

    bounds: tuple[BoundState, ...]
    episode: int | None
    begins: bool


class Calibration:
    """Bounds on the errors of all rungs.

    Parameters
    ----------
    rungs
        The ladder, and behind it a reference that is no rung.
    every
        Frames from one check to the next; 0: there are none, and only errors that rungs declare are stated.
    """

    def __init__(self, rungs: Sequence[Rung], every: int) -> None:
        self._rungs, self._every = rungs, every
        self.reference = len(rungs) - 1
        """Number of the rung that errors are relative to."""
        self.bounds = [ErrorBound(rung.expected_error_db) for rung in rungs]
        self._episode: int | None = None
        self._begins = False

    def is_due(self, number: int) -> bool:
        """Whether errors are measured in the frame of this number."""
        return bool(self._every) and number % self._every == 0 and len(self._rungs) > 1

    # --- from episode to episode ---------------------------------------------------------------------

    def reset(self, episode: int) -> None:
        """What was learned outlives an episode, but where episodes begin to be counted again."""
        follows = self._episode is not None and episode == self._episode + 1
        for bound in self.bounds:
            if follows:
                bound.forget_pairs()
            else:
                bound.reset()
        self._episode, self._begins = episode, True

    def begin(self, imposed: Mapping[str, str]) -> dict[str, str]:
        """Decisions of a frame beside its rung: where an episode begins, what is known from those before.

        Raises `ScenarioError` where something else is imposed.
        """
        begins, self._begins = self._begins, False
        if DECISION in imposed:
            self._learn(imposed[DECISION])
        known = {
            rung.label: bound.learned
            for rung, bound in zip(self._rungs, self.bounds, strict=True)
            if bound.learned
        }
        return {DECISION: msgspec.json.encode(known).decode()} if begins and known else {}

    def _learn(self, text: str) -> None:
        try:
            known = msgspec.json.decode(text, type=dict[str, str])
            for rung, bound in zip(self._rungs, self.bounds, strict=True):
                bound.learn(known.pop(rung.label, ""))
        except ValueError as error:  # msgspec's errors are ValueErrors
            raise ScenarioError(f"the decision imposed, {DECISION!r}, cannot be read: {error}") from error
        if known:
            raise ScenarioError(
                f"the decision imposed, {DECISION!r}, is about {min(known)!r}, which is no rung"
            )

    # --- from frame to frame -------------------------------------------------------------------------

    def stated(self, rung: int, number: int, made: Modelled) -> Channel:
        """The product of a rung with bounds on its errors, where it has some, before these are measured."""
        channel, bound = made.channel, self.bounds[rung]
        if rung == self.reference or not (
            self._every or bound.measured or self._rungs[rung].expected_error_db is not None
        ):
            return channel
        bounds = bound.bounds_db(number, _pairs(channel), scores_db(made))
        reference = self._rungs[self.reference]
        return replace(
            channel,
            expected_error_db=_together(bounds, pair_powers(channel)),
            error_bound_db=bounds.reshape(len(channel.tx), len(channel.rx)),
            error_reference=f"{reference.model.rung} {reference.label}",
        )

    def partner(self, chosen: int) -> int:
        """Which rung computes a frame beside the chosen one to measure errors: the reference, or where that
        was chosen the one that was measured least often."""
        if chosen != self.reference:
            return self.reference
        return min(range(self.reference), key=lambda rung: self.bounds[rung].measured)

    def check(self, rung: int, number: int, made: Modelled, reference: Channel) -> dict[str, int]:
        """Measure the errors of a rung; how many pairs were checked, and how many were within their bounds.

        Both channels have their matrices.
        """
        errors = errors_db(made.channel, reference)
        known = np.isfinite(errors)
        every = zip(_pairs(made.channel), known.tolist(), strict=True)
        pairs = [pair for pair, is_known in every if is_known]
        held = self.bounds[rung].check(number, pairs, scores_db(made)[known], errors[known])
        return {"error-checks": len(pairs), "error-covered": held}

    # --- what outlives a frame -----------------------------------------------------------------------

    @property
    def state(self) -> CalibrationState:
        """All that is known."""
        bounds = tuple(bound.state for bound in self.bounds)
        return CalibrationState(bounds=bounds, episode=self._episode, begins=self._begins)

    def go_on(self, state: CalibrationState) -> None:
        """Know what another one knew."""
        for bound, known in zip(self.bounds, state.bounds, strict=True):
            bound.go_on(known)
        self._episode, self._begins = state.episode, state.begins


def _pairs(channel: Channel) -> list[str]:
    """A name for each pair, transmitters slowest."""
    return [f"{tx} > {rx}" for tx in channel.tx for rx in channel.rx]


def _together(bounds_db: Float64Array, powers: Float64Array) -> float | None:
    """Bound [dB] on the NMSE of all matrices together, Σ‖H − Hᵣ‖² / Σ‖H‖², if each pair is within its own;
    None where no pair has a path."""
    if not powers.sum():
        return None
    ratio = float((powers * 10 ** (bounds_db / 10)).sum() / powers.sum())
    return math.ceil(100 * math.log10(ratio) - 1e-6) / 10
