"""The adaptive channel: each frame on the most accurate rung of a ladder that fits its budget.

Every rung is a channel model of its own, loaded and compiled before the first frame. Which one computed
a frame is a decision in DONE, which a replay imposes: durations differ from run to run, products then do not.
With ``calibrate_every`` some frames are computed by the reference, too, beyond the budget; from its matrices
follows a bound on the error of each pair (`calibration`), which stands in the products of the other frames.
What is known of errors where an episode begins is a decision of its first frame, so that a replay of it, or a
process that takes over, states the same.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import count, islice
from pathlib import Path
from typing import ClassVar

import msgspec
import numpy as np
from msgspec.structs import replace

from caviar_protocol.messages import Input, Role
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.scenario.schema import fixed_device, mounted_device
from caviar_protocol.space.coordinates import Vector, quaternion_from_euler
from caviar_protocol.space.scene import antennas
from caviar_protocol.topics import AntennaDevice, Scene
from caviar_protocol.topics.scene import Device
from caviar_services.channel.adaptive.calibration import Calibration, CalibrationState
from caviar_services.channel.adaptive.controller import (
    AdaptiveSettings,
    Choice,
    Controller,
    ControllerState,
    CostModel,
    CostState,
    Rung,
    Workload,
    built,
    models,
    naming,
    rung_of,
)
from caviar_services.channel.assemble import outage_counts
from caviar_services.channel.base import Modelled
from caviar_services.channel.sionna.scene import shared_scenes
from caviar_services.checkpoint import restored, saved
from caviar_services.service import Frame, Preparation, Prepared, RunInfo, Service, StepResult

DECISION = "rung"
"""Key of the decision in DONE."""

TIMINGS = 5
"""Timings of each rung before the first frame, after one that is not counted."""

_TIMING_GRACE_S = 120.0

Devices = tuple[Sequence[AntennaDevice], Sequence[AntennaDevice]]
"""Transmitters and receivers."""


class _State(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    costs: CostState
    errors: CalibrationState
    controller: ControllerState
    current: int | None
    rungs: tuple[bytes, ...]
    """State of the model of each rung and of the reference; empty where it has none."""


class AdaptiveChannel(Service[AdaptiveSettings]):
    """A ladder of channel models, one of which computes a frame; the settings say which
    (`AdaptiveSettings`)."""

    role: ClassVar[Role] = "channel"
    inputs: ClassVar[tuple[Input, ...]] = (Input(topic="scene"),)
    outputs: ClassVar[tuple[str, ...]] = ("channel",)
    uses_scenery: ClassVar[bool] = True
    checkpoints: ClassVar[bool] = True
    changes_geometry: ClassVar[bool] = True
    Settings: ClassVar[type[msgspec.Struct]] = AdaptiveSettings
    clock: Callable[[], int] = staticmethod(time.perf_counter_ns)
    """Wall time [ns]."""

    @classmethod
    def check_settings(cls, settings: AdaptiveSettings, place: Place) -> None:
        """Raise `ScenarioError` for what is wrong inside the ladder."""
        models(settings, place)

    def __init__(self, settings: AdaptiveSettings, run: RunInfo) -> None:
        super().__init__(settings, run)
        self._every: tuple[Rung, ...] = built(settings, run)
        self.rungs = self._every[: len(settings.ladder)]
        """The ladder, without a reference that is none of its rungs."""
        self.calibration = Calibration(self._every, settings.calibrate_every)
        for rung in self._every:
            rung.model.with_split = bool(settings.calibrate_every)
        self.costs: CostModel
        """Known once the service is prepared."""
        self._controller = Controller(settings.share, settings.margin, settings.patience)
        self._current: int | None = None
        self._with_h = False

    # --- before the first frame --------------------------------------------------------------------

    def prepare(self, preparation: Preparation) -> Prepared:
        self._with_h = "h" in preparation.demand.get("channel", frozenset())
        notes: list[str] = []
        with shared_scenes():
            for rung in self._every:
                with naming(rung.label):
                    said = rung.model.prepare(preparation).notes
                notes += [note for note in said if note not in notes]
        notes += self._time_rungs()
        return Prepared(notes=tuple(notes))

    def _time_rungs(self) -> list[str]:
        """Try every rung on the scenario's antennas in traffic, and begin to predict from how long it took.

        Bodies drive, and each time a rung forgets what it traced before, as it would have to in a run.
        """
        room = self._room()
        scenes = [
            rehearsal_scene(self.run.devices, room, self._ground_m(), self._is_free, step)
            for step in range(TIMINGS + 1)
        ]
        timings = []
        for rung in self._every:
            self.run.progress(f"timing rung {rung.label}", _TIMING_GRACE_S)
            timings.append([self._timed(rung, number, scene) for number, scene in enumerate(scenes)][1:])
            # Nothing of the rehearsal may follow into the run: products depend on its frames alone.
            rung.model.reset(0, self.run.seed, 0)
        timings = timings[: len(self.rungs)]
        work = _workload(scenes[0])
        self.costs = CostModel(timings, work, self.settings.quantile)
        self.run.progress("rungs timed", 0.0)
        return [
            f"rung {rung.label}: {sorted(taken)[len(taken) // 2] / 1e6:.1f} ms for {work.pairs} pairs among "
            f"{work.objects} objects"
            for rung, taken in zip(self.rungs, timings, strict=True)
        ]

    def _timed(self, rung: Rung, number: int, scene: Scene) -> int:
        """Duration of a rung for a scene that it has not seen [ns]."""
        rung.model.reset(0, self.run.seed, 0)
        frame = Frame(episode=0, number=number, t_ns=0, service=self.run.name, seed=self.run.seed)
        return self._modelled(rung, frame, scene, (antennas(scene, "tx"), antennas(scene, "rx")))[1]

    def _room(self) -> Mapping[str, int]:
        """Objects of each mesh that every model has room for."""
        # A scene of the rehearsal must fit every rung: some hold fewer bodies than others.
        rooms = [rung.model.room for rung in self._every if rung.model.room]
        shared = set.intersection(*map(set, rooms)) if rooms else set()
        return {asset: min(room[asset] for room in rooms) for asset in sorted(shared)}

    def _ground_m(self) -> float:
        """Height of the lowest point of the scenery [m]."""
        extents = [rung.model.extent for rung in self._every]
        return min((float(extent[0][2]) for extent in extents if extent is not None), default=0.0)

    def _is_free(self, place: Vector) -> bool:
        """Test whether a point is in the open."""
        model = self._every[-1].model
        if model.extent is not None:
            low, high = model.extent
            if not (low[:2] < place[:2]).all() or not (place[:2] < high[:2]).all():
                return False
        return not model.enclosing(np.array(place))

    def use_meshes(self, meshes: Mapping[str, Path]) -> None:
        """Take the meshes that objects may have from the next frame on, in the model of every rung.

        Args:
            meshes: Files by asset name.
        """
        for rung in self._every:
            rung.model.use_meshes(meshes)

    # --- frames ------------------------------------------------------------------------------------

    def reset(self, episode: int, seed: int, t0_ns: int) -> None:
        """Forget the rung, but not how fast this machine is, nor what errors were in the episode before."""
        for rung in self._every:
            rung.model.reset(episode, seed, t0_ns)
        self.calibration.reset(episode)
        self._controller.reset()
        self._current = None

    def step(self, frame: Frame) -> StepResult:
        scene = frame.scene()
        devices = antennas(scene, "tx"), antennas(scene, "rx")
        # What is imposed is learned before anything is stated: a replay then states the same.
        known = self.calibration.begin(frame.imposed)
        work = _workload(scene)
        predicted = self.costs.predict(work)
        choice = self._choice(frame, predicted)
        rung = self.rungs[choice.rung]
        counts = {
            "rung-changes": int(self._current is not None and choice.rung != self._current),
            "no-rung-fits": int(not choice.fits),
        }
        self._current = choice.rung
        calibrates = self.calibration.is_due(frame.number)
        made, taken = self._modelled(rung, frame, scene, devices, with_h=calibrates)
        # Calibration makes matrices: where frames do not ask for them, its duration says nothing about
        # theirs.
        if self._with_h or not calibrates:
            self.costs.observe(choice.rung, work, taken)
        measured = {**made.measured, "rung": taken, "rung-predicted": round(predicted[choice.rung])}
        channel = self.calibration.stated(choice.rung, frame.number, made)
        if calibrates:
            began = self.clock()
            counts |= self._calibrate(choice.rung, made, frame, scene, devices)
            measured["calibrate"] = self.clock() - began
        stated = channel.expected_error_db
        # Matrices that calibration alone asked for are no part of the product.
        channel = replace(channel, h=channel.h if self._with_h else ())
        return StepResult(
            products={"channel": channel},
            fidelity=f"{channel.rung} {rung.label}" + ("" if stated is None else f", NMSE ≤ {stated:.1f} dB"),
            decisions={DECISION: rung.label, **known},
            counts={
                "paths": len(channel.tau),
                "dropped": channel.dropped,
                **made.counts,
                **outage_counts(channel, scene, rung.model, made.dropped_pairs),
                **{name: count for name, count in counts.items() if count},
            },
            measured=measured,
        )

    def _choice(self, frame: Frame, predicted: Sequence[float]) -> Choice:
        labels = self.settings.labels
        if DECISION in frame.imposed:
            rung = rung_of(labels, frame.imposed[DECISION], "the rung imposed")
        elif self.settings.fixed:
            rung = labels.index(self.settings.fixed)
        else:
            own = self.settings.budget_ms
            return self._controller.choose(predicted, frame.budget_ns if own is None else round(own * 1e6))
        self._controller.impose(rung)
        return Choice(rung=rung, fits=True)

    def _modelled(
        self, rung: Rung, frame: Frame, scene: Scene, devices: Devices, *, with_h: bool = False
    ) -> tuple[Modelled, int]:
        """Channel of a frame by a rung, and its duration [ns]; ``with_h``: with matrices in any case."""
        model = rung.model
        asked, model.with_h = model.with_h, model.with_h or with_h
        began = self.clock()
        try:
            with naming(rung.label):
                made = model.model(frame, scene, *devices)
        finally:
            model.with_h = asked
        return made, self.clock() - began

    def _calibrate(
        self, chosen: int, made: Modelled, frame: Frame, scene: Scene, devices: Devices
    ) -> dict[str, int]:
        """Have another rung compute the frame too, and measure the errors of the less accurate one."""
        partner = self.calibration.partner(chosen)
        model = self._every[partner].model
        demanded, model.wideband = model.wideband, frozenset()
        try:
            other = self._modelled(self._every[partner], frame, scene, devices, with_h=True)[0]
        finally:
            model.wideband = demanded
        if partner == self.calibration.reference:
            return self.calibration.check(chosen, frame.number, made, other.channel)
        return self.calibration.check(partner, frame.number, other, made.channel)

    def checkpoint(self) -> bytes:
        """Saved state: costs and errors, the rung, and what the rungs follow.

        Durations decide, so the same frames lead to the same rungs only where those are imposed.
        """
        state = _State(
            costs=self.costs.state,
            errors=self.calibration.state,
            controller=self._controller.state,
            current=self._current,
            rungs=tuple(rung.model.checkpoint() if rung.model.checkpoints else b"" for rung in self._every),
        )
        return saved(self, 2, state)

    def restore(self, state: bytes) -> None:
        """See `checkpoint`."""
        was = restored(self, 2, _State, state)
        for rung, model_state in zip(self._every, was.rungs, strict=True):
            if rung.model.checkpoints:
                rung.model.restore(model_state)
        self.calibration.restore(was.errors)
        self.costs.restore(was.costs)
        self._controller.restore(was.controller)
        self._current = was.current

    # --- the rest of its life ------------------------------------------------------------------------

    def release_memory(self) -> None:
        for rung in self._every:
            rung.model.release_memory()

    def end_episode(self, frames: int) -> None:
        for rung in self._every:
            rung.model.end_episode(frames)

    def close(self) -> None:
        for rung in self._every:
            rung.model.close()


def _workload(scene: Scene) -> Workload:
    pairs = len(antennas(scene, "tx")) * len(antennas(scene, "rx"))
    return Workload(pairs=pairs, objects=len(scene.names))


# [m]: bodies stand about the first fixed antenna on a spiral.
_NEAREST, _SPACING = 12.0, 3.0

# [rad] from one to the next: never in line.
_GOLDEN_ANGLE = 2.4

# Places on the spiral that are looked at for each one that is needed.
_TRIED = 20

# Of a body [m]: a car's.
_DIMENSIONS = (4.5, 1.8, 1.6)

# [m] above the ground, of antennas whose objects have no body.
_HEIGHT = 1.5

# [m] that bodies drive from one scene to the next: far enough that nothing is where it was.
_STEP = 0.5

Free = Callable[[Vector], bool]
"""Whether a body may stand at a place."""


def rehearsal_scene(
    devices: Sequence[DeviceSpec],
    room: Mapping[str, int],
    ground_m: float = 0.0,
    is_free: Free = lambda place: True,
    step: int = 0,
) -> Scene:
    """A scene to time rungs on: all antennas that a scenario announces on bodies that drive, and as many
    bodies without.

    Args:
        devices: Of the scenario.
        room: Bodies of each mesh that there may be, by asset; ``""`` is a box.
        ground_m: Height of the ground [m].
        is_free: Places where it is not true are left out, if there are enough others.
        step: Scenes of successive steps are those of traffic that drives.
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
            place = (x, y, ground_m + _HEIGHT + 0.1 * number)
            found.append(replace(carried, parent="", position=place))
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
