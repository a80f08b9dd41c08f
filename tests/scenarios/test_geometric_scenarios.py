"""The scenarios of the geometric channel: each runs in one process, and shows what it claims."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scenarios_support import SCENARIOS, run

from caviar_protocol.codec import decode_payload
from caviar_protocol.recording import Recording
from caviar_protocol.space.scene import antennas, device_pose, merge_scenes
from caviar_protocol.topics import Channel, Link, Scene

C = 299_792_458.0
Frame = tuple[Scene, Channel, Link]


def played(name: str, out: Path, frames: int = 20) -> list[Frame]:
    """Scene, channel and link of the first frames of a shipped scenario, run in one process."""
    finished = run(SCENARIOS / f"{name}.toml", out, "--embedded", "--frames", str(frames))
    assert finished.status == 0, finished.output
    return list(_frames(finished.directory))


def _frames(directory: Path) -> Iterator[Frame]:
    for frame in Recording(directory).frames():
        found: dict[str, dict[str, Any]] = {}
        for product in frame.products:
            topic = product.provenance.topic
            payload = decode_payload(topic, product.header, product.body)
            found.setdefault(topic, {})[product.provenance.source] = payload
        (channel,), (link,) = found["channel"].values(), found["link"].values()
        yield merge_scenes(found["scene"]), channel, link


def test_one_station_serves_vehicles_and_drones(tmp_path: Path) -> None:
    """Fig. 2 of the paper: both kinds have a beam and an amplitude, in every frame."""
    frames = played("fig2", tmp_path)
    assert len(frames) == 20
    for scene, channel, link in frames:
        assert set(scene.classes) == {"car", "truck", "uav"}
        assert channel.tx == ("bs",)
        served = {rx for rx, beam, y in zip(link.rx, link.tx_beam, link.abs_y, strict=True) if beam >= 0 < y}
        assert len([rx for rx in served if rx.startswith("road.")]) == 3
        assert len([rx for rx in served if rx.startswith("air.")]) == 2


def test_in_the_long_run_users_of_fig2_are_seen_and_hidden(tmp_path: Path) -> None:
    """The car beside the lorry and the drone in the yard lose the line of sight and get it back."""
    frames = played("fig2", tmp_path, 200)
    seen = {
        rx: np.array([channel.los[0, channel.rx.index(rx)] for _, channel, _ in frames])
        for rx in frames[0][1].rx
    }
    for rx in ("road.passing/rx", "air.delivery/rx-uav"):
        hidden = np.flatnonzero(~seen[rx])
        assert 5 < len(hidden) < 150, rx
        assert seen[rx][0] or seen[rx][-1], rx
    assert seen["road.oncoming/rx"].mean() > 0.9


def test_a_flying_base_station_transmits_from_where_the_uav_is(tmp_path: Path) -> None:
    """The straight path of each car is as long as its distance to the UAV's panel, as both move."""
    frames = played("uav-base-station", tmp_path)
    places = []
    for scene, channel, link in frames:
        (station,) = antennas(scene, "tx")
        assert (station.name, station.parent) == ("uav/bs", "uav")
        assert channel.tx == ("uav/bs",)
        at = np.array(device_pose(scene, station).position)
        places.append(at)
        assert np.linalg.norm(at - scene.position[scene.names.index("uav")]) < 0.5
        for device in antennas(scene, "rx"):
            assert channel.los[0, channel.rx.index(device.name)]
            away = float(np.linalg.norm(np.array(device_pose(scene, device).position) - at))
            assert channel.tau[channel.pair(station.name, device.name)][0] * C == pytest.approx(away)
        assert set(link.rx) == {"car-1/rx", "car-2/rx", "car-3/rx"}
        assert set(link.carrier) == {"mmwave", "sub-6"}
        assert (link.abs_y > 0).all()
    assert np.linalg.norm(places[-1] - places[0]) > 5


def test_the_paper_s_experiment_is_the_same_in_one_process_and_in_many(tmp_path: Path) -> None:
    digests = []
    for out, mode in (("one", ["--embedded"]), ("many", [])):
        finished = run(SCENARIOS / "geometric.toml", tmp_path / out, "--frames", "60", *mode)
        assert finished.status == 0, finished.output
        digests.append(json.loads((finished.directory / "summary.json").read_text())["digest"])
    assert digests[0] == digests[1]


def test_the_baseline_of_the_paper_s_experiment_fails_where_the_line_is_blocked(tmp_path: Path) -> None:
    """Three times blocked, once for less than two seconds; the straight line's beam is good only outside."""
    frames = played("geometric", tmp_path, 500)
    free = np.array([channel.los[0, 0] for _, channel, _ in frames])
    azimuth = np.array([np.degrees(link.aod_azimuth[0]) for *_, link in frames])
    assert np.array_equal(free, (azimuth < 20) | (azimuth > 30))
    edges = np.flatnonzero(np.diff(np.r_[0, ~free, 0].astype(np.int64)))
    lengths = np.diff(edges)[::2]
    assert len(lengths) == 3
    assert lengths.min() < 20
    share = np.array([link.baseline_abs_y[0] / link.top_abs_y[0, 0] for *_, link in frames])
    assert share[free].mean() > 0.95
    assert share[~free].mean() < 0.6
