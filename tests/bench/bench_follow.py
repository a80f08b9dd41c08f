"""Paths that are followed from frame to frame, beside those that all rays find anew in each frame.

    python tests/bench/bench_follow.py [--frames N] [--samples N] [--follow N] [--json FILE]
                                       [--markdown FILE]

Munich, cars that drive through a street, ten of them with an array of 8 elements, a base station with 64. The
two take turns frame by frame, with Sionna RT's own path solver in some of the frames. What following
finds is held against all rays, and both against ten times as many.
"""

# ruff: noqa: T201 - a command that prints what it measured

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import numpy as np
from bench_camera import street

from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.space.coordinates import Pose
from caviar_protocol.space.scene import device_pose
from caviar_protocol.topics import AntennaArray, AntennaDevice, Carrier, Channel, Scene
from caviar_services.channel.sionna.model import SionnaChannel
from caviar_services.channel.sionna.settings import SionnaSettings
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo
from caviar_services.world.assets import object_assets
from caviar_space.scenery import scenery_assets

STATION = (-62.0, -84.0, 9.0)
RECEIVERS = 10
DEPTH = 3


def traffic(frame: int, cars: int) -> Scene:
    """The scene of a frame."""
    scene = street(frame, cars, Pose(STATION, (1.0, 0.0, 0.0, 0.0)))
    station = AntennaDevice(name="bs", role="tx", position=STATION, array=AntennaArray(columns=64))
    roofs = [
        AntennaDevice(
            name=f"{name}/rx",
            role="rx",
            parent=name,
            position=(0.0, 0.0, 0.9),
            array=AntennaArray(columns=8),
        )
        for name in scene.names[:: max(1, cars // RECEIVERS)][:RECEIVERS]
    ]
    return msgspec.structs.replace(scene, devices=(station, *roofs))


class Model:
    """A channel, what its frames took and what it made last."""

    def __init__(self, assets: Mapping[str, Path], cars: int, **settings: Any) -> None:
        run = RunInfo(name="channel", carriers=(Carrier(name="mmwave", frequency_hz=28e9),))
        self.channel = SionnaChannel(
            SionnaSettings(max_depth=DEPTH, bodies=cars, candidates="launched", **settings), run
        )
        self.channel.prepare(Preparation(demand={"channel": frozenset({"h"})}, assets=assets))
        self.ms: list[float] = []

    def __call__(self, number: int, scene: Scene) -> Channel:
        provenance = GrantInput(topic="scene", source="world", status=Status.FRESH, frame=number)
        inputs = (FrameInput(provenance, payload=scene),)
        began = time.perf_counter()
        frame = Frame(episode=0, number=number, t_ns=0, previous=number - 1, inputs=inputs)
        product = self.channel.step(frame).products["channel"]
        self.ms.append(1e3 * (time.perf_counter() - began))
        assert isinstance(product, Channel)
        return product


def sionna_solver(model: Model, scene: Scene, samples: int) -> Callable[[Scene], float]:
    """Sionna RT's own solver in the scene of a model; [ms] of a frame, after the scene was updated."""
    import drjit as dr
    import mitsuba as mi
    import sionna.rt as rt

    traced = model.channel._scene.rt_scene
    traced.tx_array = traced.rx_array = rt.PlanarArray(
        num_rows=1, num_cols=1, vertical_spacing=0.5, horizontal_spacing=0.5, pattern="iso", polarization="V"
    )
    traced.add(rt.Transmitter("bs", mi.Point3f(*STATION)))
    receivers = [device for device in scene.devices if device.parent]
    for number in range(len(receivers)):
        traced.add(rt.Receiver(f"rx{number}", mi.Point3f(0.0, 0.0, 0.0)))
    solver = rt.PathSolver(deterministic=True)

    def solve(now: Scene) -> float:
        for number, device in enumerate(d for d in now.devices if d.parent):
            x, y, z = device_pose(now, device).position
            traced.get(f"rx{number}").position = mi.Point3f(*(dr.opaque(mi.Float, v) for v in (x, y, z)))
        began = time.perf_counter()
        paths = solver(
            traced,
            max_depth=DEPTH,
            samples_per_src=samples,
            max_num_paths_per_src=200_000,
        )
        dr.eval(paths.a, paths.tau)
        dr.sync_thread()
        return 1e3 * (time.perf_counter() - began)

    return solve


def reflected_power(channel: Channel, rx: int) -> dict[int, float]:
    """|a|² of each path of a receiver that is not the straight one, by its id."""
    mine = slice(int(channel.offsets[rx]), int(channel.offsets[rx + 1]))
    power = np.abs(channel.a[0, mine]) ** 2 * (channel.interactions[mine] != 0).any(1)
    return {i: p for i, p in zip(channel.id[mine].tolist(), power.tolist(), strict=True) if p > 0}


def recall(found: Channel, reference: Channel) -> list[float]:
    """Share of the reference's reflected power that was found, for each receiver that has some."""
    shares = []
    for rx in range(len(reference.rx)):
        wanted, there = reflected_power(reference, rx), reflected_power(found, rx)
        if wanted:
            shares.append(sum(p for i, p in wanted.items() if i in there) / sum(wanted.values()))
    return shares


def errors(found: Channel, reference: Channel) -> list[tuple[float, float]]:
    """‖H − H_ref‖² and ‖H_ref‖² of each receiver that the reference reaches."""
    pairs = [(f.h, r.h) for f, r in zip(found.h, reference.h, strict=True) if np.abs(r.h).any()]
    return [(float((np.abs(f - r) ** 2).sum()), float((np.abs(r) ** 2).sum())) for f, r in pairs]


def nmse_db(parts: list[tuple[float, float]]) -> float:
    """NMSE = E‖H − H_ref‖² / E‖H_ref‖² over frames and receivers, each of which counts the same."""
    mean = float(np.mean([error / power for error, power in parts]))
    return float(10 * np.log10(max(mean, 1e-30)))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cars", type=int, default=36)
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--samples", type=int, default=1_000_000)
    parser.add_argument("--follow", type=int, default=20, help="frames until all rays were launched")
    parser.add_argument("--every", type=int, default=20, help="frames between those held against more rays")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--markdown", type=Path, help="where the figures go as a table")
    told = parser.parse_args()
    with TemporaryDirectory() as folder:
        assets = {}
        for name, content in {**scenery_assets("sionna:munich"), **object_assets(["car"])}.items():
            assets[name] = content if isinstance(content, Path) else Path(folder) / name
            if isinstance(content, bytes):
                assets[name].parent.mkdir(exist_ok=True)
                assets[name].write_bytes(content)
        anew = Model(assets, told.cars, samples=told.samples)
        followed = Model(assets, told.cars, samples=told.samples, follow=told.follow)
        dense = Model(assets, told.cars, samples=10 * told.samples)
    solve = sionna_solver(anew, traffic(0, told.cars), told.samples)
    update_ms, solver_ms = [], []
    shares: list[float] = []
    parts: dict[str, list[tuple[float, float]]] = {"followed, all rays": [], "followed": [], "all rays": []}
    known: dict[str, list[float]] = {"followed": [], "all rays": []}
    for frame in range(told.frames):
        scene = traffic(frame, told.cars)
        one, other = anew(frame, scene), followed(frame, scene)
        shares += recall(other, one)
        parts["followed, all rays"] += errors(other, one)
        if frame % told.every == told.every - 1:
            reference = dense(frame, scene)
            for label, found in (("followed", other), ("all rays", one)):
                known[label] += recall(found, reference)
                parts[label] += errors(found, reference)
            solver_ms.append(solve(scene))
            began = time.perf_counter()
            anew.channel._scene.place(traffic(frame + 1, told.cars), frozenset())
            update_ms.append(1e3 * (time.perf_counter() - began))
            print(f"frame {frame + 1} of {told.frames}", flush=True)
    ours, following = float(np.median(anew.ms)), float(np.mean(followed.ms))
    figures = {
        "scene_update_ms": float(np.median(update_ms)),
        "followed_ms_mean": following,
        "all_rays_ms_median": ours,
        "sionna_solver_ms_median": float(np.median(solver_ms)),
        "factor_to_all_rays": ours / following,
        "factor_to_sionna_solver": float(np.median(solver_ms)) / following,
        "recall_5th_percentile": float(np.percentile(shares, 5)),
        "recall_mean": float(np.mean(shares)),
        "nmse_to_all_rays_db": nmse_db(parts["followed, all rays"]),
        "nmse_to_ten_times_the_rays_db": {label: nmse_db(parts[label]) for label in known},
        "recall_of_ten_times_the_rays": {label: float(np.mean(known[label])) for label in known},
    }
    for name, value in figures.items():
        print(f"{name:32} {value}")
    if told.json:
        told.json.write_text(json.dumps(figures, indent=2) + "\n")
    if told.markdown:
        title = (
            f"Munich, {told.cars} cars, {RECEIVERS} receivers, {told.samples:.0e} rays, depth {DEPTH}, "
            f"{told.frames} frames, `follow = {told.follow}`"
        )
        told.markdown.write_text(as_markdown(title.replace("e+0", "e"), figures), "utf-8")


def as_markdown(title: str, figures: Mapping[str, Any]) -> str:
    """A table: what all rays and what following finds, of what ten times as many rays find."""
    recall_of, nmse_of = figures["recall_of_ten_times_the_rays"], figures["nmse_to_ten_times_the_rays_db"]
    sides = ("all rays", "followed")
    rows = {
        "recall of reflected power that ten times the rays find, mean": [
            f"{100 * recall_of[side]:.1f} %" for side in sides
        ],
        "NMSE of H against ten times the rays": [
            f"{nmse_of[side]:.1f} dB".replace("-", "−") for side in sides
        ],
        "recall of what all rays find, 5th percentile of receivers and frames": [
            "–",
            f"{100 * figures['recall_5th_percentile']:.0f} %",
        ],
        "time of a frame to that of all rays": ["1", f"{1 / figures['factor_to_all_rays']:.2f}"],
    }
    lines = [f"| {title} | all rays in each frame | followed |", "| --- | ---: | ---: |"]
    return "\n".join([*lines, *(f"| {name} | {' | '.join(cells)} |" for name, cells in rows.items())]) + "\n"


if __name__ == "__main__":
    main()
