"""Format ``itu``: files of the ITU challenge ML5G-PHY on beam selection, as of Raymobtime s008."""

from __future__ import annotations

import csv
import math
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from caviar_clients.datasets.impulse_responses import PlacedAntenna, placed_antennas
from caviar_clients.datasets.user_rows import Columns, Users
from caviar_formats.base import Format, Part, markdown_table, only_one
from caviar_formats.imports import Source
from caviar_formats.itu_reading import ABOVE_M, ARRAYS, HEADER, TX_YAW_DEG, WORDS, read_itu
from caviar_formats.itu_training import INPUTS, TRAINING, join_arrays, picture_inputs
from caviar_protocol.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from caviar_protocol.errors import RunError
from caviar_protocol.recording.scene import SceneArrays
from caviar_protocol.space.coordinates import euler_from_quaternion, rotation_matrix

RAYS_FILE = "rosslyn_mobile_60GHz_ts0.1s_V_Lidar_e{}.hdf5"
"""Name of a file of rays, by the number of its episode: readers open no other, whatever scene it is."""
SLOTS = (25, 100)
"""Rays of a receiver that a file has room for."""
INTERACTIONS = 9
"""Interactions of a ray that a file has room for."""
SIZES = (ARRAYS["rx"].size, ARRAYS["tx"].size)
"""Elements of the challenge's arrays, of RX and TX."""
GRID = (20, 200, 10)
"""Cells of the challenge's LIDAR grid."""
PICTURE = (960, 540)
"""Width and height of the challenge's pictures [px]."""
MOST_OBJECTS = 100_000
"""Objects of a scene that the numbers of the database leave room for."""
SHARDS = ".shards"
"""Folder of the parts of the files that all episodes share, until `Itu.finish` joins them."""


class Itu(Format):
    """CSV of receivers, and by episode HDF5 of rays, archives of LIDAR grids, PNG of pictures."""

    flavours: ClassVar[Mapping[str, str]] = {
        "compat": "read by the challenge's own code, which tells rays from padding by the missing phase",
        "full": "with phases, interactions and the SQLite database of rays",
        "baseline": "`raw_data` as of compat, and beside it `baseline_data`, which is ready for training",
    }
    packages = ("h5py", "PIL")
    needs = ("channel.a", "channel.interactions")
    whole_episodes = True
    temporary = (SHARDS,)
    loses = (
        "Transmit power, Doppler shifts, velocities; element patterns by themselves (the power of a ray has "
        "them); yaw of the transmitter, roll and pitch of receivers, and their heights: readers add 0.1 m to "
        "that of the vehicle; points of LIDARs; the weakest of more than 100 rays."
    )

    def begin(self, users: Users) -> None:
        dataset = users.dataset
        for column in ("carrier", "tx"):
            only_one(users, column)
        episodes = np.unique(users["episode"])
        if len(gaps := np.setdiff1d(np.arange(episodes[-1] + 1), episodes)):
            raise RunError(
                f"{dataset.location} has no users in episode {gaps[0]}, and readers open the file of each; "
                "generate it, or export the episodes before it"
            )
        scenario = dataset.settings["scenario"]
        self._cir = users.cir()
        self._slots = SLOTS[int(users["paths"].max() > SLOTS[0])]
        self._shape = int(users["scene"].max()) + 1, int(_numbers(users).max()) + 1
        self._tx_yaw_deg = yaw_deg(next(placed_antennas(users[:1], "tx")))
        self._last_training = min(-(-3 * len(episodes) // 4) - 1, max(len(episodes) - 2, 0))  # 1564 of 2086
        self._set = str(scenario["run"]["name"])
        carriers = {c["name"]: c["frequency_hz"] for c in scenario["carriers"]}
        self._period_s = scenario["run"]["sampling_period_ns"] / 1e9
        self._ghz = f"{carriers[str(users['carrier'][0])] / 1e9:g}"
        self._grid = None
        if "lidar.grid" in users.recorded():
            services = scenario["services"].values()
            self._grid = next((s["settings"]["grid"] for s in services if "grid" in s["settings"]), None)
        topics = dataset.episode(dataset.episodes[0]).topics
        self._cameras = [
            device["name"]
            for device in scenario["devices"]
            if "camera" in topics and device["kind"] == "camera" and not device["on"]
        ]
        if self.flavour == "baseline":
            self._require_baseline(users)

    def _require_baseline(self, users: Users) -> None:
        arrays = self._cir.shape["num_rx_ant"], self._cir.shape["num_tx_ant"]
        found: dict[str, tuple[object, object]] = {
            "elements of RX and TX": (arrays, SIZES),
            "scenes of an episode": (self._shape[0], 1),
        }
        if self._grid:
            found["cells of lidar.grid"] = users[:1]["lidar.grid"].shape[1:], GRID
        if self._cameras:
            pictures = self._pictures(users, int(users["episode"][0]))
            found["fixed cameras"] = len(self._cameras), 3
            found["pixels of a picture"] = pictures[0, 0].shape[1::-1], PICTURE
        for what, (has, needed) in found.items():
            if has != needed:
                raise RunError(f"--flavour baseline: {what}: the dataset has {has}, the challenge {needed}")

    # --- a part ------------------------------------------------------------------------------------------

    def write(self, part: Part, folder: Path) -> None:
        users, number = part.users, part.number
        raw = self._raw(folder)
        (folder / SHARDS).mkdir(exist_ok=True)
        vehicles, receivers = _vehicles(users), _numbers(users)
        grid = users["lidar.grid"] if self._grid else None
        rays, order = self._rays(users, vehicles["yaw"])
        valid = users["valid"] & (_within(vehicles, self._grid) if self._grid else True)
        rays[~valid] = np.nan
        interactions = {}
        if self.flavour == "full":
            interactions = _interactions(users, order, self._slots, valid)
        with self._shard(folder, "rows", number, "csv").open("w", newline="", encoding="utf-8") as file:
            csv.writer(file, lineterminator="\n").writerows(_rows(users, vehicles, receivers, valid, rays))
        for episode in np.unique(users["episode"]).tolist():
            mine = np.flatnonzero(users["episode"] == episode)
            at = users["scene"][mine], receivers[mine]
            rays_file = self._rays_file(raw, episode)
            _write_hdf5(rays_file, {"allEpisodeData": self._filled(at, rays[mine], np.nan)})
            if interactions:
                arrays = {name: self._filled(at, rows[mine], -1) for name, rows in interactions.items()}
                _write_hdf5(rays_file.with_name(f"{rays_file.stem}_interactions.hdf5"), arrays)
            if grid is not None:
                cells = self._filled(at, grid[mine], 0)
                folder_of_cells = raw / f"lidar_data_{self._set}"
                folder_of_cells.mkdir(parents=True, exist_ok=True)
                # A single scene has no axis of scenes.
                found = cells[0] if len(cells) == 1 else cells
                np.savez_compressed(
                    folder_of_cells / f"obstacles_e_{episode}.npz", obstacles_matrix_array=found
                )
            self._write_pictures(users, raw / f"image_data_{self._set}", episode)
        if self.flavour == "full":
            _write_database(folder / "episodedata.db", users, rays, order, self._shape, self._period_s)
        if self.flavour == "baseline":
            self._write_training(users[valid], folder, number, None if grid is None else grid[valid])

    def _rays(self, users: Users, yaw: Float64Array) -> tuple[Float32Array, Int64Array]:
        """Rays of the users, strongest first, Shape ``[U, slots, 9]``, and which paths they are."""
        rows = users.read([f"channel.{name}" for name in ("tau", "aod", "aoa", "interactions")])
        a, _ = self._cir.block(users)
        gain = a[:, 0, 0, : rows["channel.tau"].shape[1], 0]  # between the first elements of both arrays
        order = np.argsort(-np.abs(gain), axis=1, kind="stable")[:, : self._slots]
        gain = np.take_along_axis(gain, order, axis=1)
        with np.errstate(divide="ignore"):
            power = 20 * np.log10(np.abs(gain))
        angles = np.concatenate([rows["channel.aod"], rows["channel.aoa"]], axis=2)
        # Where files of others had no interactions, no path has any: the straight one is the first.
        first = rows["channel.tau"] == np.nanmin(rows["channel.tau"], axis=1, keepdims=True, initial=np.inf)
        straight = first & users["los"][:, None] & ~rows["channel.interactions"].any(axis=2)
        columns = [
            power[..., None],
            np.take_along_axis(rows["channel.tau"], order, axis=1)[..., None],
            np.degrees(np.take_along_axis(angles, order[..., None], axis=1)),
            np.take_along_axis(straight, order, axis=1)[..., None],
            (np.degrees(np.angle(gain)) if self.flavour == "full" else np.full_like(power, np.nan))[
                ..., None
            ],
            np.broadcast_to(yaw[:, None, None], (*power.shape, 1)),
        ]
        found = np.full((len(users), self._slots, 9), np.nan, np.float32)
        found[:, : power.shape[1]] = np.concatenate(columns, axis=2)
        found[:, : power.shape[1]][gain == 0] = np.nan
        return found, order

    def _filled(self, at: tuple[Int64Array, Int64Array], rows: Any, missing: float) -> Any:
        """Put rows of receivers into an array of an episode, Shape ``[scenes, receivers, ...]``."""
        found = np.full((*self._shape, *rows.shape[1:]), missing, rows.dtype)
        found[at] = rows
        return found

    def _pictures(self, users: Users, episode: int) -> Any:
        """Pictures of the fixed cameras in the order of the scenario, Shape ``[S, K, H, W, 3]``."""
        if not self._cameras:
            return ()
        cameras = users.dataset.episode(episode)["camera"]
        return cameras.rgb[:, cameras.index(self._cameras)]

    def _write_pictures(self, users: Users, folder: Path, episode: int) -> None:
        from PIL import Image

        for scene, row in enumerate(self._pictures(users, episode)):
            for camera, rgb in enumerate(row, 1):
                file = folder / f"camera{camera}" / (f"{episode}_{scene}.png" if scene else f"{episode}.png")
                file.parent.mkdir(parents=True, exist_ok=True)
                Image.fromarray(rgb).save(file, compress_level=1)

    def _write_training(self, users: Users, folder: Path, number: int, grid: Any) -> None:
        """Write shards of `baseline_data`, of valid users."""
        found = {"coord": np.stack([users["x_m"], users["y_m"]], axis=1), "lidar": grid}
        # Wᴴ H W with W[m, k] = exp(−j2πmk/N), not normalised, as the challenge has it.
        h = users["channel.h"] if len(users) else np.zeros((0, *SIZES))
        y = np.fft.fft(np.fft.ifft(h, axis=1), axis=2) * SIZES[0]
        found["beams"] = np.abs(y).astype(np.complex128)
        if self._cameras:
            episodes, place = np.unique(users["episode"], return_inverse=True)
            inputs = [picture_inputs(self._pictures(users, episode)[0]) for episode in episodes.tolist()]
            found["img"] = np.array(inputs, np.uint8).reshape(-1, *INPUTS)[place]
        training = users["episode"] <= self._last_training
        for what, values in found.items():
            for part, rows in (("train", training), ("validation", ~training)):
                if values is not None:
                    np.save(self._shard(folder, f"{what}-{part}", number, "npy"), values[rows])

    # --- the whole ---------------------------------------------------------------------------------------

    def finish(self, users: Users, folder: Path) -> None:
        with (self._raw(folder) / f"CoordVehiclesRxPerScene_{self._set}.csv").open("wb") as file:
            file.write(f"{','.join(HEADER)}\n".encode())
            for shard in _shards(folder, "rows"):
                file.write(shard.read_bytes())
        if self.flavour == "baseline":
            for part in ("train", "validation"):
                for what, (place, key) in TRAINING.items():
                    if shards := _shards(folder, f"{what}-{part}"):
                        join_arrays(shards, folder / "baseline_data" / place.format(part), key)
                shards = _shards(folder, f"beams-{part}")
                y = np.concatenate([np.abs(np.load(shard)) for shard in shards])
                best = y.reshape(-1, SIZES[0] * SIZES[1]).argmax(axis=1)
                rx, tx = np.divmod(best, SIZES[1])
                file_of_best = folder / "baseline_data" / "beam_output" / f"best_pairs_{part}.npz"
                np.savez(file_of_best, rx_times_32_plus_tx=best, tx_times_8_plus_rx=tx * SIZES[0] + rx)

    def readme(self, users: Users) -> str:
        (scenes, receivers), slots = self._shape, self._slots
        rays, split = self._rays_file(Path(), "N").as_posix(), ""
        about = {
            f"CoordVehiclesRxPerScene_{self._set}.csv": "a row for each receiver of a scene: Val is V where "
            "a ray reaches it and, with a LIDAR, its vehicle lies in the area of the grid; x, y of it, z the "
            "height of its vehicle, or 0.1 m below one that stands [m]; the number of rays; whether one is "
            "straight",
            rays: f"`allEpisodeData`, float32 [{scenes} scenes, {receivers} receivers, {slots} rays, 9], "
            "strongest first, NaN where there is none: power [dBm] of 0 dBm sent, delay [s], zenith and "
            "azimuth of departure, then of arrival [°], 1 for the straight ray, phase [°], RxAngle [°]",
        }
        if self.flavour == "full":
            about[f"{rays.removesuffix('.hdf5')}_interactions.hdf5"] = (
                "points [m], ASCII codes and number of a ray's interactions, from TX to RX; −1 is empty"
            )
            about["episodedata.db"] = "the same as tables of SQLite; vectors are float64 in binary"
        if self._grid:
            about[f"lidar_data_{self._set}/obstacles_e_N.npz"] = (
                f"`obstacles_matrix_array`, int8 [{f'{scenes} scenes, ' * (scenes > 1)}{receivers} "
                "receivers, x, y, z]: 1 obstacle, −1 TX, −2 RX, 0 free; "
                f"cells of {self._grid['minimum_m']} to {self._grid['maximum_m']} m"
            )
        for number, camera in enumerate(self._cameras, 1):
            about[f"image_data_{self._set}/camera{number}/N.png"] = f"pictures of {camera}" + (
                f" in scene 0; of scene S in `N_S.png`, S to {scenes - 1}" * (scenes > 1)
            )
        if self.flavour == "baseline":
            about = {f"raw_data/{name}": text for name, text in about.items()}
            has = {"beams": True, "coord": True, "lidar": self._grid, "img": self._cameras}
            about |= {
                f"baseline_data/{name.format('SPLIT')}": f"`{key}`"
                for what, (name, key) in TRAINING.items()
                if has[what]
            }
            about["baseline_data/beam_output/best_pairs_SPLIT.npz"] = "index of the best pair, in both orders"
            split = f" SPLIT is `train` up to episode {self._last_training}, then `validation`."
        return f"""# {users.dataset.name} in the layout of the ITU challenge ML5G-PHY

{markdown_table(("file", "what is in it"), about.items())}

N is the number of the episode. Rows of all files are sorted by episode, scene and receiver. x is to the
east, y to the north, z upwards; azimuth is from x to y, zenith from z. RxAngle is the yaw of the RX array's
boresight: its elements follow each other along RxAngle + 90°. The phase is that of the gain between the
first elements (top row, −y) of both arrays, exp(+j·phase), with the carrier's. Readers open files of rays by
this name, which says nothing of the scene; they take the TX array to lie along x, at a yaw of
{TX_YAW_DEG:g}°: here it is {self._tx_yaw_deg:g}°. VehicleName is without the prefix that the world gives its
objects, as `bus` for `vehicle.bus`.{split}

{_ABOUT_PHASES[self.flavour]}
"""

    def read(self, path: Path) -> Source:
        return read_itu(path, self.frequency_hz)

    def _raw(self, folder: Path) -> Path:
        return folder / "raw_data" if self.flavour == "baseline" else folder

    def _rays_file(self, raw: Path, episode: int | str) -> Path:
        return raw / f"ray_tracing_data_{self._set}_carrier{self._ghz}GHz" / RAYS_FILE.format(episode)

    @staticmethod
    def _shard(folder: Path, what: str, number: int, suffix: str) -> Path:
        return folder / SHARDS / f"{what}-{number:05d}.{suffix}"


_ABOUT_PHASES = {
    "compat": "Column 7 is NaN: a row with that NaN alone is a ray.",
    "full": "The challenge's own code counts NaN, and finds no rays in these files, without an error.",
    "baseline": "Column 7 of the rays is NaN. |y| is of the exact channel, Wᴴ H W with DFT matrices that are "
    "not normalised; the challenge drew random phases and left out the zenith.",
}


def _shards(folder: Path, what: str) -> list[Path]:
    return sorted((folder / SHARDS).glob(f"{what}-*"))


def _write_hdf5(file: Path, arrays: Mapping[str, Any]) -> None:
    import h5py

    file.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(file, "w") as out:
        for name, values in arrays.items():
            out[name] = values


# --- users of a part ---------------------------------------------------------------------------------------


def _numbers(users: Users) -> Int64Array:
    """Number of each user in its scene, from 0, in the order of the dataset."""
    scenes = np.stack([users["episode"], users["scene"]], axis=1)
    starts = np.flatnonzero(np.any(np.diff(scenes, axis=0, prepend=-1), axis=1))
    counts = np.diff(starts, append=len(scenes))
    found: Int64Array = np.arange(len(scenes)) - np.repeat(starts, counts)
    return found


def _vehicles(users: Users) -> Columns:
    """Vehicles of the users: name, height [m], yaw of the RX array [°], corners of the footprint [m]."""
    prefixes = [
        service["settings"].get("prefix", "")
        for service in users.dataset.settings["scenario"]["services"].values()
    ]
    names, heights, corners = [], [], []
    yaws = [yaw_deg(antenna) for antenna in placed_antennas(users, "rx")]
    for rows, scene in _scenes(users):
        for name, x, y, z in zip(
            *(users[c][rows].tolist() for c in ("object", "x_m", "y_m", "z_m")), strict=True
        ):
            if name:
                (at,) = scene.index([name])
                x, y, _ = scene.position[0, at]
                length, width, z = scene.dimensions[0, at]
                half = np.array([[i * length, j * width, 0] for i in (-0.5, 0.5) for j in (-0.5, 0.5)])
                footprint = (half @ rotation_matrix(scene.orientation[0, at]).T)[:, :2] + (x, y)
            else:
                footprint, z = np.tile((x, y), (4, 1)), z - ABOVE_M
            corners.append(footprint)
            heights.append(z)
            names.append(next((name.removeprefix(p) for p in prefixes if p and name.startswith(p)), name))
    return Columns(
        {
            "name": np.array(names),
            "height": np.array(heights),
            "yaw": np.array(yaws),
            "corners": np.array(corners),
        }
    )


def yaw_deg(antenna: PlacedAntenna) -> float:
    """Yaw of an antenna's boresight, counter-clockwise from x [°], from 0 to 360."""
    return math.degrees(euler_from_quaternion(antenna.orientation.tolist())[0]) % 360


def _scenes(users: Users) -> Iterator[tuple[Int64Array, SceneArrays]]:
    """Positions of the users of each scene, which lie together, and the scene."""
    starts = np.flatnonzero(_numbers(users) == 0)
    for rows in np.split(np.arange(len(users)), starts[1:]):
        episode, scene = (int(users[column][rows[0]]) for column in ("episode", "scene"))
        yield rows, users.dataset.episode(episode)["scene"].select(frames=[scene])


def _within(vehicles: Columns, grid: Mapping[str, Any]) -> BoolArray:
    """Vehicles that lie in the LIDAR's grid, which is the area that the challenge analyses."""
    low, high = np.array(grid["minimum_m"][:2]), np.array(grid["maximum_m"][:2])
    corners = vehicles["corners"]
    found: BoolArray = np.all((corners >= low) & (corners <= high), axis=(1, 2))
    return found


def _rows(
    users: Users, vehicles: Columns, receivers: Int64Array, valid: BoolArray, rays: Float32Array
) -> Iterator[tuple[object, ...]]:
    """Rows of the CSV; heights are text of the vehicle's kind to readers, so as short as they are."""
    columns = (
        np.where(valid, "V", "I"),
        users["episode"],
        users["scene"],
        receivers,
        vehicles["name"],
        users["x_m"],
        users["y_m"],
        [f"{height:.6g}" for height in vehicles["height"].tolist()],
        np.count_nonzero(~np.isnan(rays[:, :, 0]), axis=1),
        np.any(rays[:, :, 6] == 1, axis=1),
    )
    for *row, los in zip(*(np.asarray(column).tolist() for column in columns), strict=True):
        yield *row, f"LOS={int(los)}"


def _interactions(users: Users, order: Int64Array, slots: int, valid: BoolArray) -> dict[str, Any]:
    """Codes, numbers and points of interactions of the rays, padded with −1, by the names in the file."""
    rows = users.read(["channel.interactions", "channel.points", "channel.a"])
    kinds = np.take_along_axis(rows["channel.interactions"], order[..., None], axis=1)
    points = np.take_along_axis(rows["channel.points"], order[..., None, None], axis=1)
    absent = ~valid[:, None] | np.isnan(np.take_along_axis(rows["channel.a"], order, axis=1))
    kinds[absent] = 0
    count, paths, depth = kinds.shape
    if depth > INTERACTIONS:
        raise RunError(
            f"rays of up to {depth} interactions: the format holds {INTERACTIONS}; lower max_depth"
        )
    codes = np.full((count, slots, INTERACTIONS, 2), -1, np.int64)
    places = np.full((count, slots, INTERACTIONS, 3), -1, np.float32)
    numbers = np.full((count, slots), -1, np.int64)
    letters = np.array([[*map(ord, word), -1, -1][:2] for word in WORDS])
    codes[:, :paths, :depth] = letters[kinds]
    places[:, :paths, :depth] = np.where(kinds[..., None] > 0, points, -1)
    numbers[:, :paths] = np.where(absent, -1, np.count_nonzero(kinds, axis=2))
    return {
        "allInteractionsPositions": places,
        "allInteractionsDescriptions": codes,
        "allInteractionsNumbers": numbers,
    }


_TABLES = """
CREATE TABLE IF NOT EXISTS episodes (id INTEGER PRIMARY KEY, insite_pah VARCHAR, sumo_path VARCHAR,
    simulation_time_begin INTEGER, sampling_time FLOAT);
CREATE TABLE IF NOT EXISTS scenes (id INTEGER PRIMARY KEY, _study_area BLOB,
    episode_id INTEGER REFERENCES episodes(id));
CREATE TABLE IF NOT EXISTS objects (id INTEGER PRIMARY KEY, name VARCHAR, _dimension BLOB,
    _vertice_array BLOB, _position BLOB, scene_id INTEGER REFERENCES scenes(id));
CREATE TABLE IF NOT EXISTS receivers (id INTEGER PRIMARY KEY, total_received_power FLOAT,
    mean_time_of_arrival FLOAT, _position BLOB, object_id INTEGER REFERENCES objects(id));
CREATE TABLE IF NOT EXISTS rays (id INTEGER PRIMARY KEY, departure_elevation FLOAT, departure_azimuth FLOAT,
    arrival_elevation FLOAT, arrival_azimuth FLOAT, path_gain FLOAT, time_of_arrival FLOAT,
    interactions VARCHAR, "phaseInDegrees" FLOAT, "interactionsPositions" BLOB,
    receiver_id INTEGER REFERENCES receivers(id));
"""


def _write_database(
    file: Path, users: Users, rays: Float32Array, order: Int64Array, shape: tuple[int, int], period_s: float
) -> None:
    """Add scenes to the database, with numbers that follow from their place, so that none is there twice."""
    scenes, receivers = shape
    kinds = np.take_along_axis(users["channel.interactions"], order[..., None], axis=1)
    points = np.take_along_axis(users["channel.points"], order[..., None, None], axis=1)
    with closing(sqlite3.connect(file)) as connection, connection as database:
        database.executescript(_TABLES)

        def insert(table: str, *values: object) -> None:
            marks = ", ".join("?" * len(values))
            database.execute(f"INSERT OR REPLACE INTO {table} VALUES ({marks})", values)  # noqa: S608 - own

        for rows, scene in _scenes(users):
            episode, number = (int(users[column][rows[0]]) for column in ("episode", "scene"))
            at_scene = episode * scenes + number + 1
            insert("episodes", episode + 1, "", "", 0, period_s)
            insert("scenes", at_scene, None, episode + 1)
            for i, name in enumerate(scene.names):
                position, size = scene.position[0, i], scene.dimensions[0, i]
                corners = np.array(np.meshgrid(*([-0.5, 0.5],) * 3)).reshape(3, 8).T * size
                placed = corners @ rotation_matrix(scene.orientation[0, i]).T + position
                blobs = (size.tobytes(), placed.tobytes(), position.tobytes())
                insert("objects", at_scene * MOST_OBJECTS + i, name, *blobs, at_scene)
            for r, user in enumerate(rows.tolist()):
                mine = rays[user][~np.isnan(rays[user, :, 0])].astype(float)
                receiver = at_scene * receivers + r
                place = np.array([users[c][user] for c in ("x_m", "y_m", "z_m")])
                carrier = str(users["object"][user])
                on = at_scene * MOST_OBJECTS + scene.names.index(carrier) if carrier else None
                watts = 10 ** (mine[:, 0] / 10)
                total = float(10 * np.log10(watts.sum())) if len(mine) else None
                mean = float(watts @ mine[:, 1] / watts.sum()) if len(mine) else None
                insert("receivers", receiver, total, mean, place.tobytes(), on)
                for k, (power, delay, *angles, straight, phase, _) in enumerate(mine.tolist()):
                    kind = kinds[user, k][kinds[user, k] > 0]
                    letters = [WORDS[i] for i in kind]
                    # Two words are a straight ray to readers: interactions that nobody recorded are a third.
                    text = "-".join(["Tx", *(letters or ([] if straight else ["?"])), "Rx"])
                    met = points[user, k][: len(kind)].tobytes()
                    row = (*angles, power, delay, text, phase, met, receiver)
                    insert("rays", receiver * SLOTS[1] + k, *row)
