"""What mesh detail costs and saves: the ray-traced channel in Munich at several levels.

    python tests/bench/bench_detail.py --json detail.json

Each level traces the same receivers, around one transmitter above the streets; errors are against full
detail. NMSE of H is that of all receivers together, path gains are sums of powers.
"""

# ruff: noqa: T201 - what it measures is printed

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from caviar_protocol.arrays import BoolArray, Complex128Array, Float64Array
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.topics import AntennaArray, AntennaDevice, Carrier, Channel, Scene
from caviar_services.channel.sionna_rt import SionnaChannel, SionnaSettings
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo
from caviar_services.world.assets import scenery_assets

STATION = (8.5, 21.0, 27.0)
"""Position of the transmitter [m]."""

SPREAD_M = 70.0
"""Receivers are drawn this far around the station in x and y."""

LEVELS: dict[str, dict[str, Any]] = {
    "full": {"smallest_m": 1e-9},
    "near": {"centre_m": [8.5, 21.0], "radius_m": 250.0},
    "planar": {"tolerance_m": 0.001},
    "decimated": {"tolerance_m": 0.5},
    "near, decimated": {"centre_m": [8.5, 21.0], "radius_m": 250.0, "tolerance_m": 0.5},
    "coarse": {"centre_m": [8.5, 21.0], "radius_m": 150.0, "smallest_m": 25.0, "tolerance_m": 2.0},
}


def prepared(detail: dict[str, Any], **settings: Any) -> tuple[SionnaChannel, float, tuple[str, ...]]:
    """A model, how long it took to get ready [s], and its notes."""
    assets = {name: file for name, file in scenery_assets("sionna:munich").items() if isinstance(file, Path)}
    run = RunInfo(name="channel", seed=1, carriers=(Carrier(name="c", frequency_hz=28e9),))
    model = SionnaChannel(msgspec.convert({"detail": detail, "bodies": 0, **settings}, SionnaSettings), run)
    begin = time.perf_counter()
    notes = model.prepare(Preparation(demand={"channel": frozenset({"h"})}, assets=assets)).notes
    return model, time.perf_counter() - begin, notes


def scene(places: Float64Array) -> Scene:
    """The station, with 8×8 elements, and receivers of 4."""
    station = AntennaDevice(name="t", role="tx", position=STATION, array=AntennaArray(rows=8, columns=8))
    receivers = [
        AntennaDevice(name=f"r{i:03d}", role="rx", position=(x, y, z), array=AntennaArray(columns=4))
        for i, (x, y, z) in enumerate(places.tolist())
    ]
    return Scene(
        names=(),
        classes=(),
        assets=(),
        position=np.zeros((0, 3)),
        orientation=np.zeros((0, 4)),
        velocity=np.zeros((0, 3)),
        dimensions=np.zeros((0, 3)),
        devices=tuple(sorted([station, *receivers], key=lambda device: device.name)),
    )


def traced(model: SionnaChannel, at: Scene) -> Channel:
    source = FrameInput(GrantInput(topic="scene", source="world", status=Status.FRESH), payload=at)
    product = model.step(Frame(episode=0, number=0, t_ns=0, inputs=(source,))).products["channel"]
    assert isinstance(product, Channel)
    return product


def gains(channel: Channel) -> Float64Array:
    """Path gain of each receiver, Shape ``[R]``."""
    power = np.concatenate([[0.0], np.cumsum(np.abs(channel.a[0]) ** 2)])
    return np.diff(power[channel.offsets])


def matrices(channel: Channel) -> Complex128Array:
    """H of all receivers, Shape ``[R, 4, 64]``."""
    return np.array([matrix.h for matrix in channel.h])


def compared(reference: Channel, channel: Channel) -> dict[str, float]:
    """Errors of one product against another of the same receivers."""
    h, expected = matrices(channel), matrices(reference)
    found: BoolArray = gains(channel) > 0
    error = 10 * np.log10(gains(channel)[found] / gains(reference)[found])
    of_each = (np.abs(h - expected) ** 2).sum((1, 2)) / (np.abs(expected) ** 2).sum((1, 2))
    total = (np.abs(h - expected) ** 2).sum() / (np.abs(expected) ** 2).sum()
    return {
        "nmse_db": float(10 * np.log10(max(total, 1e-30))),
        "nmse_worst_db": float(10 * np.log10(max(of_each.max(), 1e-30))),
        "path_gain_error_db_median": float(np.median(np.abs(error))),
        "path_gain_error_db_worst": float(np.abs(error).max()),
        "receivers_lost": float((~found).sum()),
        "los_agreement": float((channel.los == reference.los).mean()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--receivers", type=int, default=10)
    parser.add_argument("--frames", type=int, default=10)
    parser.add_argument("--settings", type=json.loads, default={}, help="JSON, as in a scenario")
    parser.add_argument("--json", type=Path, help="write the rows here")
    options = parser.parse_args()

    rng = np.random.default_rng(3)
    places = rng.uniform((-SPREAD_M, -SPREAD_M, 1.5), (SPREAD_M, SPREAD_M, 2.0), (20 * options.receivers, 3))
    places[:, :2] += STATION[:2]
    reference: Channel | None = None
    rows: list[dict[str, Any]] = []
    for name, detail in LEVELS.items():
        model, ready, notes = prepared(detail, **options.settings)
        if reference is None:  # those that stand within a building receive nothing
            places = places[gains(traced(model, scene(places))) > 0][: options.receivers]
        at = scene(places)
        channel = traced(model, at)
        times = []
        for _ in range(options.frames):
            begin = time.perf_counter()
            traced(model, at)
            times.append(time.perf_counter() - begin)
        reference = reference or channel
        rows.append(
            {
                "level": name,
                "detail": detail,
                "effect": next(note for note in notes if note.startswith("mesh detail")),
                "prepare_s": ready,
                "frame_ms_median": float(np.median(times) * 1e3),
                "paths": len(channel.tau),
                **compared(reference, channel),
            }
        )
        print(json.dumps(rows[-1], ensure_ascii=False), flush=True)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=2, ensure_ascii=False) + "\n", "utf-8")


if __name__ == "__main__":
    main()
