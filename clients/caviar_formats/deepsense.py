"""Format ``deepsense``: a scenario of DeepSense 6G, samples of a base station that sweeps 64 beams."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from caviar_clients.datasets.impulse_responses import only_array, placed_antennas
from caviar_clients.datasets.reader import Dataset
from caviar_clients.datasets.user_rows import Columns, Users
from caviar_formats.base import Format, Part, only_one
from caviar_protocol.arrays import Float32Array, Float64Array
from caviar_protocol.errors import RunError
from caviar_protocol.space.antenna_arrays import steering_vector
from caviar_space.imported_scenes import Georeference

BEAMS_DEG = np.linspace(-45.0, 45.0, 64)
"""Azimuth of each beam in the axes of the array, counter-clockwise from its boresight [°]."""
CSV = "scenario00.csv"
SENSORS = {"rgb": "camera.rgb", "lidar": "lidar.points"}
"""Recorded arrays of the sensors beside the road, by the part of the name of their columns."""
_ROWS = ".rows"


class _Description(msgspec.Struct):
    """Part of the description of an imported scene."""

    origin: Georeference | None = None


class DeepSense(Format):
    """Table `scenario00.csv` of samples, and for each of them a text file of 64 powers, two of places, and
    what sensors beside the road saw."""

    packages = ("PIL",)
    needs = ("channel.h",)
    temporary = (_ROWS,)
    takes_origin = True
    loses = (
        "Users without a path. Of channels all but the received power; heights, velocities, orientations; "
        "radar, which is not recorded; sensors that move with objects; depth, segmentation; objects."
    )

    def begin(self, users: Users) -> None:
        dataset, users = users.dataset, users[users["valid"]]
        if not len(users):
            raise RunError(f"{dataset.location} has no user with a path, and samples have powers")
        only_one(users, "carrier")
        self._tx = only_one(users, "tx")
        self._stands = "/" not in self._tx
        self._georeference = self._origin(users)
        array = only_array(users, "tx")
        if array.columns < 2:
            raise RunError(f"{dataset.location}: {self._tx} has one column, which no beam turns in azimuth")
        azimuth = np.radians(BEAMS_DEG)
        directions = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(len(azimuth))], axis=1)
        self._beams = steering_vector(array, directions).conj().T / np.sqrt(array.size)
        # Samples by episode and receiver, for readers take a sequence from its first row to its last.
        keys = [users["episode"], users["rx"], users["scene"]]
        episode, rx, scene = (column[np.lexsort(keys[::-1])] for column in keys)
        begins = (np.diff(episode) != 0) | (rx[1:] != rx[:-1]) | (np.diff(scene) != 1)
        sequences = np.cumsum(np.concatenate([[True], begins]))
        rows = zip(episode.tolist(), scene.tolist(), rx.tolist(), strict=True)
        # Index of each sample, and number of its sequence.
        self._numbers = dict(zip(rows, enumerate(sequences.tolist(), 1), strict=True))
        self._sensors: dict[str, tuple[str, str]] = {}  # topic and sensor, by column
        recorded, devices = users.recorded(), dataset.settings["scenario"]["devices"]
        for what, name in SENSORS.items():
            topic = name.partition(".")[0]
            standing = [d["name"] for d in devices if d["kind"] == topic and not d["on"]]
            for number, sensor in enumerate(standing if name in recorded else (), 1):
                self._sensors[f"unit1_{what}{number if len(standing) > 1 else ''}"] = topic, sensor

    def _origin(self, users: Users) -> Georeference:
        if self.origin:
            return Georeference(latitude_deg=self.origin[0], longitude_deg=self.origin[1])
        for file in sorted(users.dataset.assets.glob("scenery/*.json")):
            try:
                found = msgspec.json.decode(file.read_bytes(), type=_Description).origin
            except msgspec.DecodeError as error:
                raise RunError(f"{file}: {error}; write the origin of the world with --origin") from error
            if found:
                return found
        raise RunError(
            f"{users.dataset.location} has places in metres, and this format latitudes and longitudes: write "
            "those of the world's origin, as --origin 38.8907,-77.0787; scenes that are imported bring them"
        )

    def write(self, part: Part, folder: Path) -> None:
        users = part.users[part.users["valid"]]
        for name in ("unit1/mmWave_data", "unit1/GPS_data", "unit2/GPS_data", _ROWS):
            (folder / name).mkdir(parents=True, exist_ok=True)
        with (folder / _ROWS / f"{part.number:05d}.csv").open("w", newline="") as file:
            if len(users):
                csv.writer(file).writerows(self._samples(users, part.scenes, folder))

    def _samples(self, users: Users, scenes: Columns, folder: Path) -> Iterator[list[Any]]:
        """Write the files of samples; yields their rows."""
        antennas = list(placed_antennas(users, "tx"))
        milliwatts = 10 ** (np.array([antenna.power_dbm for antenna in antennas]) / 10)
        powers = np.abs(users["channel.h"][:, 0] @ self._beams) ** 2 * milliwatts[:, None]
        own = self._degrees(np.array([antenna.position for antenna in antennas]))
        other = self._degrees(np.stack([users[f"{axis}_m"] for axis in "xyz"], axis=1))
        keys = (users[name].tolist() for name in ("episode", "scene", "rx"))
        columns = (scenes[name].tolist() for name in ("episode", "scene", "t_s"))
        times = {(episode, scene): t_s for episode, scene, t_s in zip(*columns, strict=True)}
        seen: dict[tuple[int, int], list[str]] = {}
        for at, (episode, scene, rx) in enumerate(zip(*keys, strict=True)):
            index, sequence = self._numbers[episode, scene, rx]
            if (instant := (episode, scene)) not in seen:
                seen[instant] = self._write_sensors(users.dataset, *instant, folder)
            written = [f"{power:.9e}" for power in powers[at]]
            place = "gps_location.txt" if self._stands else f"gps_location_{index}.txt"
            files = {
                f"unit1/mmWave_data/mmWave_power_{index}.txt": written,
                f"unit1/GPS_data/{place}": own[at],
                f"unit2/GPS_data/gps_location_{index}.txt": other[at],
            }
            for path, lines in files.items():
                (folder / path).write_text("".join(f"{line}\n" for line in lines))
            beam = 1 + int(np.argmax([float(power) for power in written]))
            stamp = _time_stamp(times[instant])
            yield [index, *seen[instant], *(f"./{path}" for path in files), beam, sequence, stamp]

    def _degrees(self, places: Float64Array) -> list[list[str]]:
        """Write latitude and longitude of each place, with 0.1 mm."""
        found = np.array(self._georeference.to_wgs84(*places.T))[:2].T
        return [[f"{value:.9f}" for value in place] for place in found.tolist()]

    def _write_sensors(self, dataset: Dataset, episode: int, scene: int, folder: Path) -> list[str]:
        """Write what the sensors saw in a scene; paths, empty where one saw nothing."""
        from PIL import Image

        recording, paths = dataset.episode(episode), []
        for column, (topic, sensor) in self._sensors.items():
            view: Any = recording[topic][[recording.place(episode, scene)]]
            at = view.names.index(sensor) if sensor in view.names else None
            if at is None or not view.present[0, at]:
                paths.append("")
                continue
            kind, suffix = ("camera_data", "png") if topic == "camera" else ("lidar_data", "ply")
            path = f"unit1/{kind}/{column.removeprefix('unit1_')}_{episode}_{scene}.{suffix}"
            (folder / path).parent.mkdir(exist_ok=True)
            if topic == "camera":
                Image.fromarray(view.rgb[0, at]).save(folder / path, compress_level=1)
            else:
                _write_ply(folder / path, view.points[0, at, : view.hits[0, at]])
            paths.append(f"./{path}")
        return paths

    def finish(self, users: Users, folder: Path) -> None:
        rows: list[list[str]] = []
        for file in (folder / _ROWS).iterdir():
            with file.open(newline="") as lines:
                rows += csv.reader(lines)
        rows.sort(key=lambda row: int(row[0]))
        with (folder / CSV).open("w", newline="") as out:
            writer = csv.writer(out, lineterminator="\n")
            writer.writerow([
                "index", *self._sensors, "unit1_pwr_60ghz", "unit1_loc", "unit2_loc", "unit1_beam",
                "seq_index", "time_stamp[UTC]",
            ])  # fmt: skip
            writer.writerows(rows)

    def readme(self, users: Users) -> str:
        carrier = str(users["carrier"][0])
        carriers = users.dataset.settings["scenario"]["carriers"]
        ghz = next(c["frequency_hz"] for c in carriers if c["name"] == carrier) / 1e9
        origin = self._georeference
        return f"""# {users.dataset.name} as a scenario of DeepSense 6G

`{CSV}` has a row for each sample, a receiver in a scene with a path. Unit 1 is the transmitter
`{self._tx}`, unit 2 the receiver: by reciprocity the power that unit 1 measures of unit 2. Paths are relative
to this folder, files are text unless it is said.

- `index`: of the sample, from 1.
- `unit1_rgb`, `unit1_lidar`, numbered where there are several: picture (`.png`) and points (`.ply`, binary,
  float32 x, y, z [m] in the axes of the sensor: forward, left, up) of the sensors that stand beside the road;
  samples of one scene share them. A column is left out where none was recorded.
- `unit1_pwr_60ghz`: 64 lines (`.txt`), received power of each beam [mW] at {ghz:g} GHz: of the recorded
  narrowband H and transmit power, without noise and losses of a codebook, at the first element (top row, −y)
  of the receiver's array. Beams are steering vectors of the recorded array, in azimuth from its boresight, at
  its elevation 0: beam 1 at −45°, the clockwise end, to beam 64 at +45°. Of an array of few columns they
  overlap.
- `unit1_loc`, `unit2_loc`: latitude and longitude [°] on WGS84, two lines (`.txt`), without errors of a
  receiver. The world's origin is at {origin.latitude_deg:.9f}, {origin.longitude_deg:.9f}; x is to the east,
  y to the north.
- `unit1_beam`: strongest beam, from 1, of the powers as they are written.
- `seq_index`: from 1; a sequence is one receiver in consecutive scenes.
- `time_stamp[UTC]`: simulated time in the episode as hours, minutes, seconds and ms, not that of a day.
"""


def _time_stamp(t_s: float) -> str:
    """Write a time as the tables of DeepSense have it."""
    seconds, milliseconds = divmod(round(1000 * t_s), 1000)
    minutes, seconds = divmod(seconds, 60)
    hours, minutes = divmod(minutes, 60)
    return f"['{hours:02d}-{minutes:02d}-{seconds:02d}-{milliseconds:03d}']"


def _write_ply(file: Path, points: Float32Array) -> None:
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    file.write_bytes(f"{header}{axes}end_header\n".encode() + points.astype("<f4").tobytes())
