"""Wideband parts of the street canyon: their time, and how near they come to Sionna RT's own.

    python tests/bench/bench_wideband.py [--frames N] [--repeat N] [--sionna] [--markdown FILE]

Times are those of 10 users of 64 × 8 elements on 264 subcarriers, in frames of `street-canyon`: the response
of one beam pair of each user from the paths, and the whole grid, encoded and with its digest. The least of
some repetitions counts for each frame, and the median of the frames is printed; the grids of all repetitions
have to have one digest.

``--sionna`` holds both parts against ``Paths.cfr`` and ``Paths.taps`` of Sionna RT in the canyon without
traffic, receiver by receiver. Sionna computes the phase of the carrier in float32, off by some 1e-2 rad at
28 GHz: ``exact carrier`` replaces that phase, and nothing else, by that of delays in float64.
"""

# ruff: noqa: T201 - a command that prints what it measured

from __future__ import annotations

import argparse
import re
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from bench_channel import canyon
from bench_ladder import world

from caviar_labs.tradeoff.errors import nmse
from caviar_protocol.arrays import Complex128Array
from caviar_protocol.codec import encode_payload
from caviar_protocol.digest import payload_digest
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.multipath import subcarrier_offsets
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT, quaternion_from_euler
from caviar_protocol.space.scene import antennas
from caviar_protocol.topics import AntennaArray, AntennaDevice, Carrier, Channel, Scene
from caviar_services.channel.arrays.channel_matrices import Located, PlaneWaves, bins_of, wideband_parts
from caviar_services.channel.paths import Antenna, PathGeometry
from caviar_services.channel.sionna.model import SionnaChannel
from caviar_services.channel.sionna.settings import SionnaSettings
from caviar_services.link.base import users_of
from caviar_services.link.beam_scores import beam_responses
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo

NUMEROLOGY = {"subcarriers": 264, "subcarrier_spacing_hz": 120e3, "taps": 64}


class Model:
    """A ray-traced channel of one carrier."""

    def __init__(self, run: RunInfo, assets: Any, settings: dict[str, Any], parts: set[str]) -> None:
        self.channel = SionnaChannel(msgspec.convert(settings, SionnaSettings), run)
        self.channel.prepare(Preparation(demand={"channel": frozenset(parts)}, assets=assets))

    def __call__(self, scene: Scene, number: int = 0) -> Channel:
        inputs = (FrameInput(GrantInput(topic="scene", source="w", status=Status.FRESH), payload=scene),)
        frame = Frame(episode=0, number=number, t_ns=0, previous=number - 1, inputs=inputs)
        product = self.channel.step(frame).products["channel"]
        assert isinstance(product, Channel)
        return product


def whole_grid(channel: Channel, scene: Scene) -> Channel:
    """The product with part ``hf``, made from its paths as `assemble` makes it."""
    tx, rx = ([Antenna.of(scene, device) for device in antennas(scene, role)] for role in ("tx", "rx"))
    ratio = channel.doppler[0] / channel.carriers[0].frequency_hz
    geometry = PathGeometry(channel.tau, _directions(channel.aod), _directions(channel.aoa), ratio)
    pair = np.repeat(np.arange(len(channel.offsets) - 1), np.diff(channel.offsets))
    none = np.zeros((1, len(pair), 3, 3), np.complex128)
    located = Located(np.arange(len(pair)), pair, channel.offsets, geometry, channel.a, none, None)
    bins = bins_of({"hf"}, channel.carriers, channel.tau, channel.offsets)
    waves = PlaneWaves(channel.carriers, tx, rx, located)
    responses = (response for asked in bins for response in waves.responses(asked))
    made = wideband_parts(bins, responses, len(rx))
    return msgspec.structs.replace(channel, hf=made.hf)


def _directions(angles: Any) -> Any:
    sine = np.sin(angles[:, 0])
    return np.stack([sine * np.cos(angles[:, 1]), sine * np.sin(angles[:, 1]), np.cos(angles[:, 0])], -1)


def times(frames: int, repeat: int) -> dict[str, float]:
    """[ms] of the two uses, and whether digests agree."""
    made = world(5, frames, 10)
    carrier = msgspec.structs.replace(made.run.carriers[0], **NUMEROLOGY)
    run = replace(made.run, carriers=(carrier,))
    settings = {"max_depth": 3, "pool": made.settings["pool"]}
    model = Model(run, made.preparation.assets, settings, {"hf"})
    rows, paths, users = [], 0, 0
    for number, scene in enumerate(made.scenes):
        channel = model(scene, number)
        of_scene = users_of(scene, channel.carriers)
        paths, users = max(paths, len(channel.tau)), max(users, len(of_scene))
        taken, digests = [], set()
        for _ in range(repeat):
            began = time.perf_counter()
            beam_responses(channel, scene, of_scene, [(17, 3)] * len(of_scene))
            served = time.perf_counter()
            grid = whole_grid(channel, scene)
            made_at = time.perf_counter()
            digests.add(payload_digest(*encode_payload(grid)))
            taken.append(np.diff([began, served, made_at, time.perf_counter()]))
        if len(digests) != 1:
            raise SystemExit(f"frame {number}: digests differ between {repeat} makings")
        rows.append(np.min(taken, axis=0))
    beams, grid_ms, encoded = 1e3 * np.median(rows, axis=0)
    return {
        "beam pairs of all users [ms]": float(beams),
        "whole grid of all users [ms]": float(grid_ms),
        "its encoding and digest [ms]": float(encoded),
        "whole grid, its encoding and digest [ms]": 1e3 * float(np.median(np.array(rows)[:, 1:].sum(1))),
        "paths": paths,
        "users": users,
    }


# --- beside Sionna RT ---------------------------------------------------------------------------------


def canyon_scene(receivers: int) -> Scene:
    """The canyon without traffic: a station of 4 × 8 elements, receivers of 2 that stand along the street."""
    rng = np.random.default_rng(3)
    places = np.stack([rng.uniform(-60, 60, receivers), rng.uniform(-4, 4, receivers)], -1)
    array = AntennaArray(columns=2, polarization="V")
    ends = [
        AntennaDevice(name=f"rx{i:02d}", role="rx", position=(float(x), float(y), 1.7), array=array)
        for i, (x, y) in enumerate(places)
    ]
    station = AntennaDevice(
        name="bs",
        role="tx",
        position=(0.0, -8.3, 5.0),
        orientation=quaternion_from_euler(np.pi / 2),
        array=AntennaArray(rows=4, columns=8, pattern="tr38901", polarization="V"),
    )
    zero = np.zeros((0, 3))
    return Scene(
        names=(), classes=(), assets=(), position=zero, orientation=np.zeros((0, 4)), velocity=zero,
        dimensions=zero, devices=(station, *ends),
    )  # fmt: skip


def beside_sionna(frequency_hz: float, receivers: int = 10, rays: int = 1_000_000) -> dict[str, float]:
    """NMSE [dB] of both parts against Sionna RT's, mean and worst of the receivers."""
    carrier = Carrier(name="x", frequency_hz=frequency_hz, bandwidth_hz=100e6, **NUMEROLOGY)  # type: ignore[arg-type]
    settings = {"max_depth": 3, "samples": rays, "candidates": "launched"}
    scene = canyon_scene(receivers)
    model = Model(RunInfo(name="channel", seed=1, carriers=(carrier,)), canyon(), settings, {"hf", "taps"})
    channel = model(scene)
    errors: dict[str, list[float]] = {}
    for r in range(receivers):
        raw = _sionna_paths(model, scene, r, rays)
        for name, is_exact in (("float32 carrier", False), ("exact carrier", True)):
            hf, taps = _sionna_parts(raw, channel, r, carrier, is_exact)
            errors.setdefault(f"hf, {name}", []).append(nmse(channel.hf[r].h[0], hf))
            errors.setdefault(f"taps, {name}", []).append(nmse(channel.taps[r].h[0], taps))
    return {
        f"{name}, {kind}": 10 * np.log10(figure)
        for name, values in errors.items()
        for kind, figure in (("mean", np.mean(values)), ("worst", np.max(values)))
    }


def _sionna_paths(model: Model, scene: Scene, r: int, rays: int) -> Any:
    import sionna.rt as rt

    traced, (station,), ends = model.channel._scene.rt_scene, antennas(scene, "tx"), antennas(scene, "rx")
    for name in (*traced.transmitters, *traced.receivers):
        traced.remove(name)
    traced.tx_array, traced.rx_array = (
        rt.PlanarArray(
            num_rows=device.array.rows, num_cols=device.array.columns, vertical_spacing=0.5,
            horizontal_spacing=0.5, pattern=device.array.pattern, polarization="V",
        )
        for device in (station, ends[r])
    )  # fmt: skip
    centre = model.channel._scene.centre
    places = [(np.array(device.position) - centre).tolist() for device in (station, ends[r])]
    traced.add(rt.Transmitter("tx", position=places[0], orientation=[np.pi / 2, 0.0, 0.0]))
    traced.add(rt.Receiver("rx", position=places[1], orientation=[0.0, 0.0, 0.0]))
    return rt.PathSolver()(
        traced, max_depth=3, samples_per_src=rays, max_num_paths_per_src=1_000_000, synthetic_array=True,
        refraction=False,
    )  # fmt: skip


def _sionna_parts(
    paths: Any, channel: Channel, r: int, carrier: Carrier, is_exact: bool
) -> tuple[Complex128Array, Complex128Array]:
    """``cfr`` and ``taps`` with absolute delays, Shape ``[K, Nr, Nt]`` and ``[L, Nr, Nt]``."""
    import mitsuba as mi

    kept = paths._a_real, paths._a_imag
    if is_exact:
        paths._a_real, paths._a_imag = _with_exact_carrier(paths, channel, r, carrier)
    frequencies = mi.Float(subcarrier_offsets(carrier).astype(np.float32))
    hf = paths.cfr(frequencies=frequencies, normalize_delays=False, normalize=False, out_type="numpy")
    first = channel.taps[r].first
    taps = paths.taps(
        bandwidth=carrier.bandwidth_hz, l_min=first, l_max=first + carrier.taps - 1, normalize_delays=False,
        normalize=False, out_type="numpy",
    )  # fmt: skip
    paths._a_real, paths._a_imag = kept
    return np.moveaxis(hf[0, :, 0, :, 0], -1, 0), np.moveaxis(taps[0, :, 0, :, 0], -1, 0)


def _with_exact_carrier(paths: Any, channel: Channel, r: int, carrier: Carrier) -> tuple[Any, ...]:
    """Amplitudes to which Sionna's own carrier phase adds up to that of delays in float64."""
    import mitsuba as mi

    tau = paths.tau.numpy()[0, 0].astype(np.float64)
    mine = channel.tau[channel.offsets[r] : channel.offsets[r + 1]]
    nearest = np.abs(tau[:, None] - mine).argmin(1)
    if np.abs(tau - mine[nearest]).max() * SPEED_OF_LIGHT > 1e-3:
        raise SystemExit(f"receiver {r} has other paths in Sionna RT")
    a = paths.a[0].numpy() + 1j * paths.a[1].numpy()
    turned = paths.cir(normalize_delays=False, out_type="numpy")[0][..., 0]
    exact = a * np.exp(-2j * np.pi * np.mod(carrier.frequency_hz * mine[nearest], 1.0))
    a = a * np.divide(exact, turned, out=np.ones_like(a), where=turned != 0)
    return tuple(mi.TensorXf(np.ascontiguousarray(part, np.float32)) for part in (a.real, a.imag))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--sionna", action="store_true", help="hold the parts against Paths.cfr and taps")
    parser.add_argument("--markdown", type=Path, help="where the figures go as tables")
    args = parser.parse_args()
    figures: dict[str, dict[str, float]] = {"times": times(args.frames, args.repeat)}
    if args.sionna:
        for frequency_hz in (3.5e9, 28e9):
            figures[f"{frequency_hz / 1e9:g} GHz"] = beside_sionna(frequency_hz)
    for name, of in figures.items():
        print(f"{name}: " + ", ".join(f"{key} {value:.4g}" for key, value in of.items()))
    if args.markdown:
        args.markdown.write_text(as_markdown(figures), "utf-8")


def as_markdown(figures: dict[str, dict[str, float]]) -> str:
    """Two tables: times, and errors of each carrier."""
    times = figures.pop("times")
    lines = ["# Times", "", "| 10 users of 64 × 8 elements, 264 subcarriers | ms |", "| --- | ---: |"]
    lines += [f"| {name[:-5]} | {value:.1f} |" for name, value in times.items() if name.endswith(" [ms]")]
    if figures:
        lines += ["", "# Sionna RT", "", f"| NMSE [dB] | {' | '.join(figures)} |", "| --- | ---: | ---: |"]
        for name in next(iter(figures.values())):
            lines.append(f"| {name} | {' | '.join(f'{of[name]:.1f}' for of in figures.values())} |")
    return re.sub(r"-(?=\d)", "−", "\n".join(lines)) + "\n"


if __name__ == "__main__":
    main()
