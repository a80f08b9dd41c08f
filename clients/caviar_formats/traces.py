"""Formats that are written scene by scene: ``ns3-qd``, traces of channels, and ``pcd``, clouds of points."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from caviar_clients.datasets.impulse_responses import antennas_of, only_array, placed_antennas
from caviar_clients.datasets.user_rows import Users
from caviar_formats.base import Format, Part, only_one
from caviar_formats.deepmimo import first_element


class Ns3Qd(Format):
    """Scenarios for ns-3's module qd-channel: a folder for each episode, a trace for each pair of nodes."""

    needs = tuple(f"channel.{name}" for name in ("a", "tau", "aod", "aoa"))
    whole_episodes = True
    loses = (
        "All but the paths: sensors, links, objects, interactions and their points, Doppler shifts; patterns "
        "and polarizations by themselves (gains have them); carriers but one; places of nodes after the "
        "first scene that they are in, since nodes of the module stand still."
    )

    def begin(self, users: Users) -> None:
        carrier = only_one(users, "carrier")
        self._arrays = {end: only_array(users, end) for end in ("tx", "rx")}
        scenario = users.dataset.settings["scenario"]
        self._frequency = next(c["frequency_hz"] for c in scenario["carriers"] if c["name"] == carrier)
        self._period_s = scenario["run"]["sampling_period_ns"] * 1e-9

    def write(self, part: Part, folder: Path) -> None:
        for episode in np.unique(part.scenes["episode"]).tolist():
            self._write_episode(
                part.users[part.users["episode"] == episode],
                part.scenes["scene"][part.scenes["episode"] == episode].tolist(),
                folder / f"episode-{episode:06d}",
            )

    def _write_episode(self, users: Users, scenes: list[int], folder: Path) -> None:
        traces, settings, places = (
            folder / "Output" / "Ns3" / "QdFiles",
            folder / "Input",
            folder / "Output" / "Ns3" / "NodesPosition",
        )
        for made in (traces, settings, places):
            made.mkdir(parents=True, exist_ok=True)
        columns = ("a", "tau", "aod", "aoa")
        rows = users.rows([f"channel.{name}" for name in columns], beside=antennas_of)
        ends = {end: list(placed_antennas(users, end)) for end in ("tx", "rx")}
        nodes: dict[str, tuple[float, ...]] = {}
        for end in ("tx", "rx"):
            for name, antenna in zip(users[end].tolist(), ends[end], strict=True):
                nodes.setdefault(name, tuple(antenna.position.tolist()))
        order = list(nodes)
        texts: dict[tuple[str, str], dict[int, str]] = {}
        for at, (tx, rx) in enumerate(zip(users["tx"].tolist(), users["rx"].tolist(), strict=True)):
            a, tau, aod, aoa = (rows[f"channel.{name}"][at] for name in columns)
            there = np.abs(a) > 0
            a, tau, aod, aoa = a[there], tau[there], aod[there], aoa[there]
            shift = first_element(self._arrays["tx"], ends["tx"][at].orientation, aod)
            shift = shift + first_element(self._arrays["rx"], ends["rx"][at].orientation, aoa)
            phase = np.angle(a * np.exp(2j * np.pi * (shift + np.mod(self._frequency * tau, 1.0))))
            lines = [tau, 20 * np.log10(np.abs(a)), phase, *np.degrees(aod).T, *np.degrees(aoa).T]
            text = "\n".join([str(len(a)), *map(_line, lines)] if len(a) else ["0"])
            texts.setdefault((tx, rx), {})[int(users["scene"][at])] = text
        for (tx, rx), by_scene in texts.items():
            name = f"Tx{order.index(tx)}Rx{order.index(rx)}.txt"
            (traces / name).write_text("".join(f"{by_scene.get(scene, '0')}\n" for scene in scenes))
        (places / "NodesPosition.csv").write_text("".join(f"{_line(place)}\n" for place in nodes.values()))
        (folder / "nodes.txt").write_text("".join(f"{name}\n" for name in order), encoding="utf-8")
        values = {
            "numberOfTimeDivisions": len(scenes),
            "totalTimeDuration": f"{len(scenes) * self._period_s:.15g}",
            "carrierFrequency": f"{self._frequency:.15g}",
        }
        lines_of = (f"{key}\t{value}\n" for key, value in values.items())
        (settings / "paraCfgCurrent.txt").write_text("ParameterName\tParameterValue\n" + "".join(lines_of))

    def readme(self, users: Users) -> str:
        return f"""# {users.dataset.name} as traces for ns-3's module qd-channel

`episode-N` is a scenario: set the path to this folder, and the scenario to `episode-N`.

- `Input/paraCfgCurrent.txt`: number of steps, duration [s], carrier [Hz].
- `Output/Ns3/QdFiles/TxIRxJ.txt`: for each scene the number of paths and, where there are any, seven lines:
  delays [s], gains [dB], phases without those of the carrier, −2πfτ [rad], zenith and azimuth of departure
  [°], zenith and azimuth of arrival [°], in world axes. Phases are those at the first element (lowest row,
  −y) of both arrays, in the poses that they had.
- `Output/Ns3/NodesPosition/NodesPosition.csv`: places of the nodes [m], in the order of their numbers; the
  module knows its nodes by them. `nodes.txt` has their names in that order.

A node that is not there in a scene has no paths. Numbers have 15 digits.
"""


def _line(values: Iterable[float]) -> str:
    return ",".join(f"{value:.15g}" for value in values)


class Pcd(Format):
    """Files ``EPISODE/SCENE-SENSOR.pcd`` of the Point Cloud Library, binary, of each scan of each LIDAR."""

    needs = ("lidar.points",)
    of_all_users = True
    loses = "All but points of LIDARs, and of these rays, objects and grids."

    def write(self, part: Part, folder: Path) -> None:
        dataset = part.users.dataset
        numbers = (part.scenes[name].tolist() for name in ("episode", "scene"))
        for episode, scene in zip(*numbers, strict=True):
            recording = dataset.episode(episode)
            view = recording["lidar"][[recording.place(episode, scene)]]
            points, ranges, hits = view.points, view.range, view.hits
            for at, sensor in enumerate(view.keys):
                cloud = np.concatenate([points[0, at], ranges[0, at, :, None]], axis=1)[: hits[0, at]]
                pose = _line([*view.position[0, at], *view.orientation[0, at]]).replace(",", " ")
                header = (
                    "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z range\n"
                    f"SIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH {len(cloud)}\nHEIGHT 1\n"
                    f"VIEWPOINT {pose}\nPOINTS {len(cloud)}\nDATA binary\n"
                )
                file = folder / f"{episode:06d}" / f"{scene:06d}-{sensor.replace('/', '-')}.pcd"
                file.parent.mkdir(exist_ok=True)
                file.write_bytes(header.encode() + cloud.astype("<f4").tobytes())

    def readme(self, users: Users) -> str:
        return f"""# Points of the LIDARs of {users.dataset.name}

`EPISODE/SCENE-SENSOR.pcd`: the hits of a scan, float32: `x`, `y`, `z` in the axes of the sensor (x forward,
y left, z up) and `range` [m]. `VIEWPOINT` is its pose in the world, position [m] and quaternion (w, x, y, z):
world = rotation · point + position.
"""
