"""Simplification of a scene to what a scenario requires: fewer triangles at a stated error of received power.

Three ladders are bisected, one after the other: the area around the devices that is kept, the size of parts
that are left out, and the distance within which triangles are merged. A rung holds where the scenario's own
channel finds powers within the error at positions of its devices. Half of the positions choose; the others
are measured for the report alone.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np

from caviar_clients.session.prepared import prepare
from caviar_clients.session.scenes import Instant, Scenes, simulated_scenes
from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import RunError, ScenarioError
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.scenario.conversion import convert_settings
from caviar_protocol.space.scene import antennas, device_pose
from caviar_protocol.topics import Channel
from caviar_scenes.checks import Parts
from caviar_scenes.opened import OpenedScene, open_scene, write_changed
from caviar_scenes.repairs import Repaired
from caviar_services.registry import load
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo
from caviar_space.mesh_detail import decimated
from caviar_space.meshes import Mesh
from caviar_space.scenery import scenery_assets

SPEED_OF_LIGHT = 299_792_458.0
"""[m/s]"""
WITHIN = 0.9
"""Share of the users' positions at which the error is kept."""
CHOOSING = 0.95
"""Share of users' positions that choose at which it is kept: a few of those that do not are worse off."""

# Share of the longest detour of a path that is kept, and what of parts and triangles goes.
_DETOURS = (3.0, 1.5, 1.0, 0.7, 0.5, 0.35, 0.25, 0.18, 0.12, 0.08, 0.05, 0.03)
_SIZES_M = (1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0, 30.0, 45.0, 70.0)
_TOLERANCES_M = (0.001, 0.01, 0.03, 0.1, 0.2, 0.4, 0.7, 1.2, 2.0, 3.5)


@dataclass(frozen=True)
class Reduction:
    """What is left out of a scene."""

    detour_m: float = math.inf
    """By which the way between two devices by a part is longer than the straight one, at most."""
    smallest_m: float = 0.0
    """Diagonal of the box around a part, at least."""
    tolerance_m: float = 0.0
    """Distance between the surface and that of fewer triangles, at most."""


@dataclass(frozen=True)
class Errors:
    """Errors of received power [dB] over positions of users."""

    median_db: float
    p90_db: float
    p95_db: float
    max_db: float
    users: int

    @classmethod
    def of(cls, errors: Float64Array) -> Errors:
        """Errors of users, Shape ``[U]``."""
        if not len(errors):
            return cls(0.0, 0.0, 0.0, 0.0, 0)
        # Not interpolated: between a found and a lost user there is no error.
        p90, p95 = (float(np.quantile(errors, share, method="higher")) for share in (WITHIN, CHOOSING))
        return cls(float(np.median(errors)), p90, p95, float(errors.max()), len(errors))


@dataclass(frozen=True, kw_only=True)
class Simplified:
    """Report of a simplification."""

    scenario: str
    scene: str
    error_db: float
    reduction: Reduction
    triangles: tuple[int, int]
    """Before and after."""
    pieces: tuple[int, int]
    frame_ms: tuple[float, float]
    """Median processor time of a channel's frame at the positions held out, before and after."""
    held_out: Errors
    chosen: Errors
    positions: tuple[int, int]
    """Frames that choose, and frames held out."""
    tried: list[tuple[Reduction, int, Errors]] = field(default_factory=list)
    """Each candidate, its triangles, and its errors at the positions that were looked at."""


@dataclass(eq=False)
class _Measured:
    gains: list[Float64Array] = field(default_factory=list)
    """Sum of the powers of paths, of each frame: Shape ``[C, U]``."""
    times_ms: list[float] = field(default_factory=list)
    """Of each frame; the first compiles."""
    detour_m: float = 0.0
    """Longest detour of a path."""


def simplify(
    scenario: str,
    error_db: float,
    out: Path,
    positions: int = 100,
    progress: Callable[[str, float], None] = lambda name, share: None,
) -> Simplified:
    """Simplify the scenery of a scenario, and write it.

    Args:
        scenario: Name or file.
        error_db: Error of received power [dB] that is kept at nine of ten positions of users.
        out: Folder that is made: the scene, and ``simplified.json``.
        positions: Frames at which users are looked at; every second one chooses.
        progress: Called with what is measured, and the share that is done.

    Raises:
        ScenarioError: The scenario has no scenery, or its channel uses none.
        RunError: No user receives anything, or the world fails.
    """
    path = Path(scenario)
    prepared = prepare(path)
    channels = [s for s in prepared.of_role("channel") if s.cls.uses_scenery]
    if not channels:
        raise ScenarioError(f"no channel of {scenario} uses scenery; name a scenario with a ray tracer")
    opened = open_scene(scenario)
    if out.exists():
        raise RunError(f"{out} is there already; name another folder, or remove it")
    progress("world", 0.0)
    scenes = simulated_scenes(path, prepared)
    count = min(positions, len(scenes.instants))
    every = [scenes.instants[i] for i in np.linspace(0, len(scenes.instants) - 1, count).astype(int)]
    choosing, held_out = every[0::2], every[1::2] or every
    ladders = (_DETOURS, _SIZES_M, _TOLERANCES_M)
    steps = 3 + sum(math.ceil(math.log2(len(ladder) + 1)) for ladder in ladders)
    done = 0

    def measured(
        description: Path | None,
        instants: Sequence[Instant],
        what: str,
        goes_on: Callable[[_Measured], bool] = lambda so_far: True,
    ) -> _Measured:
        nonlocal done
        begun = done / steps
        say = lambda share: progress(what, begun + share / steps)  # noqa: E731
        found = _measure(scenes, description, instants, say, goes_on)
        done += 1
        return found

    before = measured(None, choosing, "whole scene")
    if not any((gains > 0).any() for gains in before.gains):
        raise RunError(f"no device of {scenario} receives anything at {len(choosing)} positions")
    reach, size = _reach(opened, choosing), _diagonals(opened)
    tried: list[tuple[Reduction, int, Errors]] = []
    with tempfile.TemporaryDirectory(prefix="caviar-simplify-") as temporary:

        def holds(reduction: Reduction, what: str) -> bool:
            made = reduced(opened, reduction, reach, size)
            folder = Path(temporary) / str(len(tried))
            write_changed(opened, made, folder, {}, "candidate")
            bad = (1 - CHOOSING) * len(_errors(before, before))

            def goes_on(so_far: _Measured) -> bool:
                return bool((_errors(before, so_far) > error_db).sum() <= bad)

            after = measured(folder / "scene.xml", choosing, what, goes_on)
            tried.append((reduction, _triangles(made), Errors.of(_errors(before, after))))
            return goes_on(after)

        def bisected(
            ladder: Sequence[float], name: str, at: Callable[[float], Reduction]
        ) -> Reduction | None:
            low, high = -1, len(ladder)
            while high - low > 1:
                middle = (low + high) // 2
                if holds(at(ladder[middle]), f"{name} {ladder[middle]:g}"):
                    low = middle
                else:
                    high = middle
            return at(ladder[low]) if low >= 0 else None

        best = Reduction()
        stages: tuple[tuple[Sequence[float], str, Callable[[float], Reduction]], ...] = (
            (_DETOURS, "area", lambda v: Reduction(v * before.detour_m, best.smallest_m, best.tolerance_m)),
            (_SIZES_M, "parts", lambda v: Reduction(best.detour_m, v, best.tolerance_m)),
            (_TOLERANCES_M, "triangles", lambda v: Reduction(best.detour_m, best.smallest_m, v)),
        )
        for ladder, name, at in stages:
            best = bisected(ladder, name, at) or best
        made = reduced(opened, best, reach, size)
        folder = Path(temporary) / "final"
        write_changed(opened, made, folder, {}, "candidate")
        whole = measured(None, held_out, "held out, whole")
        after = measured(folder / "scene.xml", held_out, "held out, simplified")
    chosen = next((e for r, _, e in reversed(tried) if r == best), Errors.of(np.zeros(0)))
    report = Simplified(
        scenario=scenario,
        scene=opened.name,
        error_db=error_db,
        reduction=best,
        triangles=(sum(len(mesh.faces) for mesh in opened.meshes.values()), _triangles(made)),
        pieces=(len(opened.meshes), sum(bool(meshes) for meshes in made.values())),
        frame_ms=(float(np.median(whole.times_ms)), float(np.median(after.times_ms))),
        held_out=Errors.of(_errors(whole, after)),
        chosen=chosen,
        positions=(len(choosing), len(held_out)),
        tried=tried,
    )
    text = msgspec.json.format(msgspec.json.encode(report), indent=2)
    said = f"simplified for {scenario} within {error_db:g} dB, from {report.triangles[0]} triangles"
    write_changed(opened, made, out, {"simplified.json": text}, said)
    return report


def reduced(scene: OpenedScene, reduction: Reduction, reach: Float64Array, size: Float64Array) -> Repaired:
    """Make the pieces of a scene that a reduction leaves.

    Args:
        scene: The scene.
        reduction: What is left out.
        reach: Least detour by way of each part [m], Shape ``[P]``.
        size: Diagonal of the box around each part [m], Shape ``[P]``.
    """
    parts = Parts(list(scene.meshes.values()))
    kept = ((reach <= reduction.detour_m) & (size >= reduction.smallest_m))[parts.part]
    ends = np.cumsum([0, *(len(mesh.faces) for mesh in scene.meshes.values())])
    made: Repaired = {}
    for name, mesh, begin, end in zip(scene.meshes, scene.meshes.values(), ends, ends[1:], strict=False):
        own = kept[begin:end]
        left = mesh if own.all() else Mesh(mesh.vertices, mesh.faces[own])
        # A volume that is decimated may be open.
        if reduction.tolerance_m > 0 and name not in scene.foliage and len(left.faces):
            left = decimated(left, reduction.tolerance_m)
        made[name] = [(left, None)] if len(left.faces) else []
    return made


def _triangles(made: Repaired) -> int:
    return sum(len(mesh.faces) for meshes in made.values() for mesh, _ in meshes)


def _diagonals(scene: OpenedScene) -> Float64Array:
    low, high = Parts(list(scene.meshes.values())).boxes()
    diagonals: Float64Array = np.linalg.norm(high - low, axis=1)
    return diagonals


def _reach(scene: OpenedScene, instants: Sequence[Instant]) -> Float64Array:
    """Least detour of a way between two antennas by the box of each part [m], Shape ``[P]``."""
    low, high = Parts(list(scene.meshes.values())).boxes()
    least = np.full(len(low), np.inf)

    def distance(place: Float64Array) -> Float64Array:
        gap: Float64Array = np.linalg.norm(place - np.clip(place, low, high), axis=1)
        return gap

    for instant in instants:
        places = {
            role: [np.array(device_pose(instant.scene, d).position) for d in antennas(instant.scene, role)]
            for role in ("tx", "rx")
        }
        near = [(place, distance(place)) for place in places["tx"]]
        for rx in places["rx"]:
            to_rx = distance(rx)
            for tx, to_tx in near:
                np.minimum(least, to_tx + to_rx - np.linalg.norm(tx - rx), out=least)
    positive: Float64Array = np.maximum(least, 0.0)
    return positive


def _measure(
    scenes: Scenes,
    description: Path | None,
    instants: Sequence[Instant],
    said: Callable[[float], None],
    goes_on: Callable[[_Measured], bool],
) -> _Measured:
    """Run the scenario's channel at instants, in its scenery or in another one, as long as it ``goes_on``."""
    spec = next(
        s for s in scenes.services.values() if s.role == "channel" and load("channel", s.use).uses_scenery
    )
    cls = load("channel", spec.use)
    run = RunInfo(
        name="channel",
        run="simplify",
        seed=scenes.seed,
        sampling_period_ns=scenes.sampling_period_ns,
        carriers=scenes.carriers,
        devices=scenes.devices,
    )
    assets = dict(scenes.assets)
    if description is not None:
        assets = {name: file for name, file in assets.items() if not name.startswith("scenery/")}
        assets |= scenery_assets(str(description))
    model = cls(convert_settings(cls.Settings, spec.settings), run)
    model.prepare(Preparation(demand={"channel": frozenset()}, assets=assets))
    found = _Measured()
    for number, instant in enumerate(instants):
        source = FrameInput(
            GrantInput(topic="scene", source="world", status=Status.FRESH, frame=instant.frame),
            payload=instant.scene,
        )
        frame = Frame(
            episode=0, number=instant.frame, t_ns=instant.t_ns, inputs=(source,), service="channel",
            seed=scenes.seed,
        )  # fmt: skip
        model.reset(0, scenes.seed, 0)
        begin = time.process_time()
        channel = model.step(frame).products["channel"]
        found.times_ms.append((time.process_time() - begin) * 1e3)
        if not isinstance(channel, Channel):
            raise RunError(f"{spec.use} made no channel of frame {instant.frame}")
        power = np.cumsum(np.abs(channel.a) ** 2, axis=1)
        power = np.concatenate([np.zeros((len(power), 1)), power], axis=1)
        found.gains.append(np.diff(power[:, channel.offsets], axis=1))
        found.detour_m = max(found.detour_m, _detour(channel, instant))
        said((number + 1) / len(instants))
        if not goes_on(found):
            break
    model.close()
    return found


def _detour(channel: Channel, instant: Instant) -> float:
    """Longest detour of a path [m]: its delay is relative to nothing, or to the first path of its pair."""
    places = {d.name: np.array(device_pose(instant.scene, d).position) for d in instant.scene.devices}
    longest = 0.0
    for tx in channel.tx:
        for rx in channel.rx:
            tau = channel.tau[channel.pair(tx, rx)]
            if len(tau):
                straight = float(np.linalg.norm(places[tx] - places[rx]))
                longest = max(longest, float(tau.max()) * SPEED_OF_LIGHT - straight)
    return longest


def _errors(before: _Measured, after: _Measured) -> Float64Array:
    """Error of each user's power [dB] at the positions of both; ∞: one of both has none."""
    errors = [np.zeros(0)]
    for one, other in zip(before.gains, after.gains, strict=False):
        some = (one > 0) | (other > 0)
        with np.errstate(divide="ignore"):
            errors.append(np.abs(10 * np.log10(other[some]) - 10 * np.log10(one[some])))
    return np.concatenate(errors)
