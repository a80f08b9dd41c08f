"""Format ``deepmimo``: scenarios of DeepMIMO 4, static and dynamic.

A path's phase is referred to the first elements of both arrays there, to their centres here: it is moved path
by path, by the arrays and poses that the export has, and back by the import.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from caviar_clients.datasets.impulse_responses import antennas_of, only_array, placed_antennas
from caviar_clients.datasets.user_rows import Users
from caviar_formats.base import Format, Part, only_one
from caviar_formats.imports import ImportedScene, Paths, Source, damaged
from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import RecordingError, RunError
from caviar_protocol.host import DISTRIBUTION
from caviar_protocol.space.coordinates import rotation_matrix, unit_vectors
from caviar_protocol.topics import AntennaArray, AntennaDevice, Carrier
from caviar_space.meshes import unit_box
from caviar_space.scenery import scenery_triangles

PATHS = 25
"""Paths of a user at most: the strongest."""
POINTS = 7
"""Interactions of a path at most: in float32 more digits are lost."""
VERSION = "4.0.5"
ANGLES = ("aoa_az", "aoa_el", "aod_az", "aod_el", "phase")
PER_USER = ("aoa_az", "aoa_el", "aod_az", "aod_el", "delay", "power", "phase", "inter", "inter_pos", "rx_pos")
OWN = ("doppler", "rx_orientation", "user")
"""Arrays that DeepMIMO does not load, in files of the same kind."""


class DeepMimo(Format):
    """Folders for ``deepmimo_scenarios``, which ``deepmimo.load`` opens."""

    flavours: ClassVar[Mapping[str, str]] = {
        "static": "one scenario, in which each receiver of each scene is a user; transmitters stand still",
        "dynamic": "a scenario for each episode, with a folder for each scene, and the objects as meshes",
    }
    needs = (
        "channel.a",
        "channel.tau",
        "channel.aod",
        "channel.aoa",
        "channel.interactions",
        "channel.points",
    )
    temporary = (".parts",)
    loses = (
        f"All but the {PATHS} strongest paths of a user, and paths of more than {POINTS} interactions; "
        "sensors, links, beams; patterns and polarizations of elements, which the powers contain; carriers "
        "but one; in a static scenario the objects."
    )

    def __init__(self, flavour: str = "") -> None:
        super().__init__(flavour)
        self.whole_episodes = self.flavour == "dynamic"

    def begin(self, users: Users) -> None:
        self._carrier = only_one(users, "carrier")
        self._arrays = {end: only_array(users, end) for end in ("tx", "rx")}
        for end, array in self._arrays.items():
            if array.rows > 1 and array.columns > 1 and array.vertical_spacing != array.horizontal_spacing:
                raise RecordingError(
                    f"{users.dataset.location}: the array at {end} has {array.horizontal_spacing} "
                    f"wavelengths between columns and {array.vertical_spacing} between rows, and arrays of "
                    "DeepMIMO one spacing; use equal ones"
                )
        specs = users.dataset.settings["scenario"]["carriers"]
        self._frequency = next(c["frequency_hz"] for c in specs if c["name"] == self._carrier)
        self._name = "".join(c if c.isalnum() else "_" for c in users.dataset.name.lower())
        self._tx = np.unique(users["tx"]).tolist()
        self._paths = min(PATHS, int(users["paths"].max(initial=1)) or 1)
        self._files = users.dataset.assets
        scenery = {f.relative_to(self._files).as_posix(): f for f in self._files.rglob("*") if f.is_file()}
        self._scenery = scenery_triangles(scenery)

    def write(self, part: Part, folder: Path) -> None:
        if self.flavour == "static":
            at = folder / ".parts" / f"{part.number:05d}"
            at.mkdir(parents=True, exist_ok=True)
            for number, tx in enumerate(self._tx):
                users = part.users[part.users["tx"] == tx]
                tables = self._tables(users) | _tx_of(users, self._tx_pose(folder, number, users))
                np.savez(at / f"{number}.npz", allow_pickle=False, **tables)
            return
        for episode in np.unique(part.scenes["episode"]).tolist():
            scenario = folder / f"{self._name}_e{episode:06d}"
            users = part.users[part.users["episode"] == episode]
            names = np.unique(users["rx"])
            scenes = part.scenes["scene"][part.scenes["episode"] == episode].tolist()
            for scene in scenes:
                here = users[users["scene"] == scene]
                # The package looks for folders of scenes where there are several.
                place = scenario / f"scene_{scene:06d}" if len(scenes) > 1 else scenario
                counts = self._write_scene(here, names, place, episode, scene)
            active = len(np.unique(users["rx"][users["valid"]]))
            self._write_params(scenario, len(names), active, len(scenes), counts)

    def _write_scene(
        self, users: Users, names: NDArray[Any], folder: Path, episode: int, scene: int
    ) -> dict[str, int]:
        """Write a scene of a dynamic scenario: rows of users that are not there are NaN."""
        folder.mkdir(parents=True, exist_ok=True)
        for number, tx in enumerate(self._tx):
            here = users[users["tx"] == tx]
            found, rows = self._tables(here), np.searchsorted(names, here["rx"])
            for name, values in found.items():
                blank = "" if values.dtype.kind == "U" else np.nan
                full = np.full((len(names), *values.shape[1:]), blank, dtype=values.dtype)
                full[rows] = values
                found[name] = full
            found["user"] = np.array([f"{episode} {scene} {name}" for name in names])
            for name, values in (found | _tx_of(here, None)).items():
                np.savez(folder / _file(name, number, len(self._tx)), allow_pickle=False, **{name: values})
        return self._write_objects(users, folder, episode, scene)

    def _tx_pose(self, folder: Path, number: int, users: Users) -> Any:
        """The pose of a transmitter, which has to stand still."""
        first = folder / ".parts" / "00000" / f"{number}.npz"
        if not first.exists():
            return None
        with np.load(first) as tables:
            return tables["tx_pos"][0], tables["tx_orientation"][0]

    def _tables(self, users: Users) -> dict[str, NDArray[Any]]:
        """Make the arrays of users of one transmitter, by their names."""
        n, p = len(users), self._paths
        out: dict[str, NDArray[Any]] = {
            name: np.full((n, p), np.nan, np.float32) for name in (*PER_USER[:8], "doppler")
        }
        out["inter_pos"] = np.full((n, p, POINTS, 3), np.nan, np.float32)
        out["user"] = np.array(
            [f"{e} {s} {rx}" for e, s, rx in zip(users["episode"], users["scene"], users["rx"], strict=True)],
            np.str_,
        )
        columns = ("a", "tau", "aod", "aoa", "doppler", "interactions", "points")
        rows = users.rows([f"channel.{name}" for name in columns], beside=antennas_of)
        sent, taken = (list(placed_antennas(users, end)) for end in ("tx", "rx"))
        out["rx_pos"] = np.array([antenna.position for antenna in taken], np.float32).reshape(n, 3)
        out["rx_orientation"] = np.array([antenna.orientation for antenna in taken]).reshape(n, 4)
        for at, row in enumerate(zip(*rows.values(), strict=True)):
            paths = dict(zip(columns, row, strict=True))
            depth = (paths["interactions"] != 0).sum(1)
            power = np.where(depth <= POINTS, np.abs(paths["a"]), 0.0)
            kept = np.argsort(-power, kind="stable")[: min(p, np.count_nonzero(power))]
            # The package takes the first path for that of a line of sight.
            direct = kept[depth[kept] == 0][np.argsort(paths["tau"][kept][depth[kept] == 0])[:1]]
            direct = direct if users["los"][at] else direct[:0]
            kept = np.concatenate([direct, kept[~np.isin(kept, direct)]])
            paths = {name: values[kept] for name, values in paths.items()}
            shift = first_element(self._arrays["tx"], sent[at].orientation, paths["aod"])
            shift = shift + first_element(self._arrays["rx"], taken[at].orientation, paths["aoa"])
            a, cut = paths["a"] * np.exp(2j * np.pi * shift), slice(len(kept))
            out["power"][at, cut] = 20 * np.log10(np.abs(a))
            out["phase"][at, cut] = np.degrees(np.angle(a))
            out["delay"][at, cut] = paths["tau"]
            out["doppler"][at, cut] = paths["doppler"]
            for end in ("aod", "aoa"):
                out[f"{end}_el"][at, cut], out[f"{end}_az"][at, cut] = np.degrees(paths[end]).T
            types = paths["interactions"][:, :POINTS].astype(int)
            digits = ["".join(map(str, row[row > 0])) or "3" for row in types]
            digits[: len(direct)] = ["0"] * len(direct)
            out["inter"][at, cut] = np.array(digits, np.float32)
            points = np.where(types[..., None] > 0, paths["points"][:, :POINTS], np.nan)
            out["inter_pos"][at, cut, : points.shape[1]] = points
        return out

    def _write_objects(self, users: Users, folder: Path, episode: int = 0, scene: int = -1) -> dict[str, int]:
        """Write scenery and, of a scene, the boxes of its objects, as meshes."""
        meshes = [("scenery", "terrain", self._scenery)] if len(self._scenery) else []
        if scene >= 0:
            arrays = users.dataset.episode(episode)["scene"].select(episode=episode)
            now = arrays.select(frames=[scene])
            if not meshes and len(arrays.keys):  # which Doppler shifts of objects need
                ground = np.array([[-1e4, -1e4, 0], [1e4, -1e4, 0], [0, 2e4, 0]])
                meshes = [("ground", "terrain", ground[None])]
            for name in arrays.keys:
                mesh = (
                    np.zeros((1, 3, 3)) + np.array([0, 0, -1e3]) + np.eye(3)
                )  # of an object that is not there
                if name in now.keys:
                    at = now.keys.index(name)
                    turn = rotation_matrix(now.orientation[0, at].tolist())
                    box = unit_box()
                    mesh = (box.vertices * now.dimensions[0, at]) @ turn.T + now.position[0, at]
                    mesh = mesh[box.faces]
                meshes.append((name, "objects", mesh))
        vertices = np.concatenate([np.zeros((0, 3)), *(mesh.reshape(-1, 3) for *_, mesh in meshes)])
        faces, start = {}, 0
        for number, (_, _, mesh) in enumerate(meshes):
            faces[str(number)] = np.arange(start, start + 3 * len(mesh), dtype=np.int32).reshape(-1, 3)
            start += 3 * len(mesh)
        about = [
            {"name": name, "label": label, "id": number, "mesh_key": str(number)}
            for number, (name, label, _) in enumerate(meshes)
        ]
        np.savez(folder / "vertices.npz", vertices=vertices)
        np.savez(folder / "faces.npz", **faces)  # type: ignore[arg-type]
        np.savez(folder / "materials.npz", **{key: np.zeros(len(f), np.int32) for key, f in faces.items()})  # type: ignore[arg-type]
        (folder / "objects.json").write_text(json.dumps(about))
        counts = {"n_objects": len(meshes), "n_vertices": len(vertices)}
        return counts | dict.fromkeys(("n_faces", "n_triangular_faces"), len(vertices) // 3)

    def finish(self, users: Users, folder: Path) -> None:
        if self.flavour != "static":
            return
        scenario, parts = folder / self._name, sorted((folder / ".parts").iterdir())
        scenario.mkdir(exist_ok=True)
        for number in range(len(self._tx)):
            files = [part / f"{number}.npz" for part in parts]
            for name in (*PER_USER, *OWN):
                _join(files, name, scenario / _file(name, number, len(self._tx)))
            with np.load(files[0]) as tables:
                for name in ("tx_pos", "tx_orientation"):
                    np.savez(scenario / _file(name, number, len(self._tx)), **{name: tables[name]})
        points, active = (count // len(self._tx) for count in (len(users), int(users["valid"].sum())))
        self._write_params(scenario, points, active, 1, self._write_objects(users, scenario))

    def _write_params(
        self, folder: Path, users: int, active: int, scenes: int, counts: Mapping[str, int]
    ) -> None:
        """Write ``params.json``, with all fields that the package's summary reads."""
        modelled = dict.fromkeys(
            ("max_path_depth", "max_reflections", "max_diffractions", "max_scattering", "max_transmissions"),
            POINTS,
        )
        arrays = {
            end: {"shape": [a.columns, a.rows], "spacing": _spacing(a), "pattern_in_powers": a.pattern}
            for end, a in self._arrays.items()
        }
        sets = {
            f"txrx_set_{number}": _set(number, *about)
            for number, about in enumerate(
                [*((name, True, 1, 1) for name in self._tx), ("receivers", False, users, active)]
            )
        }
        params = {
            "version": VERSION,
            "rt_params": {
                "raytracer_name": DISTRIBUTION,
                "raytracer_version": "1",
                "frequency": self._frequency,
                **modelled,
                "diffuse_reflections": 0,
                "diffuse_diffractions": 0,
                "diffuse_transmissions": 0,
                "diffuse_final_interaction_only": False,
                "diffuse_random_phases": False,
                "terrain_reflection": True,
                "terrain_diffraction": False,
                "terrain_scattering": False,
                "num_rays": 0,
                "ray_casting_method": "uniform",
                "synthetic_array": True,
                "ray_casting_range_az": 360.0,
                "ray_casting_range_el": 180.0,
                "gps_bbox": [0, 0, 0, 0],
                "raw_params": {"carrier": self._carrier, "arrays": arrays},
            },
            "txrx_sets": sets,
            "materials": {"material_0": _MATERIAL},
            "scene": {"num_scenes": scenes, **counts, "representation": "mesh"},
        }
        (folder / "params.json").write_text(json.dumps(params, indent=1))

    def readme(self, users: Users) -> str:
        shapes = {end: [array.columns, array.rows] for end, array in self._arrays.items()}
        one = self._name if self.flavour == "static" else f"{self._name}_e000000"
        return f"""# {users.dataset.name} for DeepMIMO 4 ({self.flavour}: {self.flavours[self.flavour]})

```python
import deepmimo as dm
import numpy as np

dm.config("scenarios_folder", "FOLDER OF THIS README")
data = dm.load("{one}")
```

`params.json` names the sets: one of a point for each transmitter, and the last of all receivers. Angles are
degrees, `el` the zenith angle, in world axes; `power` is 20·log10|a| dB of the path between two elements, and
contains their patterns; `delay` s. The `phase` has that of the carrier, at the first element (lowest row, −y)
of arrays of shapes {shapes["tx"]} (TX) and {shapes["rx"]} (RX), in the poses that they had: with other arrays
it is off. `inter` has the interactions from TX to RX: 0 line of sight, 1 reflection, 2 diffraction,
3 scattering, 4 transmission; 3 also where a model draws paths without points. Channels of the package are H
divided by the square root of the number of subcarriers; element i there is column i mod columns, from −y,
and row i // columns, from below.
`vertices.npz`, `faces.npz`, `materials.npz` and `objects.json` are meshes. The package loads no
`rx_orientation_*`, `tx_orientation_*` (quaternions w, x, y, z, of each user and of the transmitter),
`doppler_*` (Hz, for `set_doppler`) and `user_*` (episode, scene and name of the receiver).

The rotation of an array is (roll, pitch, yaw) in degrees of its quaternion.
"""

    def read(self, path: Path) -> Source:
        if self.frequency_hz is not None:
            raise RunError("--frequency-hz: the files have it; leave it out")
        below = sorted(file.parent for file in path.glob("*/params.json"))
        if below and not (path / "params.json").exists():
            raise RunError(f"{path} is no scenario, it holds {len(below)}: give one of them, as {below[0]}")
        params = _json(path / "params.json")
        try:
            frequency = float(params["rt_params"]["frequency"])
            scenes = int(params["scene"]["num_scenes"])
            sets = list(params["txrx_sets"].values())
            tx = [(s["id"], s["num_points"]) for s in sets if s["is_tx"]]
            rx = [s["id"] for s in sets if s["is_rx"] and not s["is_tx"]] or [
                s["id"] for s in sets if s["is_rx"]
            ]
            raw = params["rt_params"].get("raw_params", {}).get("arrays", {})
            arrays = {end: _array(raw.get(end)) for end in ("tx", "rx")}
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise damaged(path / "params.json", "", f"{error!r} of a scenario of DeepMIMO 4") from error
        if not frequency > 0 or not tx or not rx:
            raise damaged(path / "params.json", "", "there is no frequency, transmitter or receiver")
        folders = [path] if scenes == 1 else sorted(f for f in path.iterdir() if f.is_dir())
        if len(folders) != scenes:
            raise damaged(
                path / "params.json", "num_scenes", f"{scenes}, and there are {len(folders)} folders"
            )
        known = "" if raw else " Arrays are single elements, which a scenario does not name."
        return Source(
            path=path,
            scenes=_scenes(folders, tx, rx, arrays),
            carriers=(Carrier(name="carrier", frequency_hz=frequency),),
            scenes_of_episode=scenes,
            lacks="the scenario has no time, objects that move, sensors, and paths but the strongest",
            assumed=f"Scenes are 100 ms apart; transmitters send 0 dBm on 100 MHz.{known}",
        )


_MATERIAL = {
    "id": 0,
    "name": "not exported",
    "permittivity": 1.0,
    "conductivity": 0.0,
    "scattering_model": "none",
    "scattering_coefficient": 0.0,
    "cross_polarization_coefficient": 0.0,
}


def first_element(array: AntennaArray, orientation: Float64Array, angles: Float64Array) -> Float64Array:
    """Project the place of the element at −y and −z from the array's centre on directions [wavelengths].

    Args:
        array: A uniform array.
        orientation: (w, x, y, z), device into world.
        angles: (zenith, azimuth) in world axes [rad], Shape ``[P, 2]``.
    """
    local = unit_vectors(angles) @ rotation_matrix(np.asarray(orientation).tolist())
    y, z = (array.columns - 1) / 2 * array.horizontal_spacing, (array.rows - 1) / 2 * array.vertical_spacing
    return -(local[:, 1] * y + local[:, 2] * z)


def _spacing(array: AntennaArray) -> float:
    return array.horizontal_spacing if array.columns > 1 else array.vertical_spacing


def _array(raw: Mapping[str, Any] | None) -> AntennaArray:
    if raw is None:
        return AntennaArray()
    columns, rows = raw["shape"]
    return AntennaArray(
        rows=rows, columns=columns, horizontal_spacing=raw["spacing"], vertical_spacing=raw["spacing"],
        pattern=raw["pattern_in_powers"],
    )  # fmt: skip


def _set(number: int, name: str, is_tx: bool, points: int, active: int) -> dict[str, Any]:
    return {
        "name": name,
        "id_orig": number,
        "id": number,
        "is_tx": is_tx,
        "is_rx": not is_tx,
        "num_points": points,
        "num_active_points": active,
        "num_ant": 1,
        "dual_pol": False,
        "ant_rel_positions": [[0, 0, 0]],
        "array_orientation": [0, 0, 0],
        "grid_spacing": None,
    }


def _file(name: str, tx: int, rx: int) -> str:
    return f"{name}_t{tx:03d}_tx000_r{rx:03d}.npz"


def _tx_of(users: Users, still: tuple[Float64Array, Float64Array] | None) -> dict[str, NDArray[Any]]:
    """Pose of the one transmitter of users.

    Args:
        users: Of one transmitter.
        still: Position and orientation that it has to have; None: any.

    Raises:
        RunError: It moves, or there is no user to know it of.
    """
    poses = list(placed_antennas(users, "tx"))
    if not poses:
        if still is None:
            raise RunError(f"{users.dataset.location}: the first scenes have no user of a transmitter")
        return {"tx_pos": np.array([still[0]], np.float32), "tx_orientation": np.array([still[1]])}
    position, orientation = still or (poses[0].position, poses[0].orientation)
    for pose, episode, scene in zip(poses, users["episode"], users["scene"], strict=True):
        if not (
            np.allclose(pose.position, position, atol=1e-3) and np.allclose(pose.orientation, orientation)
        ):
            raise RunError(
                f"{users.dataset.location}, episode {episode}, scene {scene}: {users['tx'][0]} moves, and "
                "a static scenario has transmitters that stand still; use --flavour dynamic"
            )
    return {"tx_pos": np.array([position], np.float32), "tx_orientation": np.array([orientation])}


def _join(files: Sequence[Path], name: str, out: Path) -> None:
    """Join an array of several archives along axis 0, in the memory of one."""
    shapes, dtypes = [], []
    for file in files:
        with np.load(file) as tables:
            shapes.append(tables[name].shape)
            dtypes.append(tables[name].dtype)
    dtype = np.result_type(*dtypes)
    header: dict[str, Any] = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False}
    header["shape"] = (sum(shape[0] for shape in shapes), *shapes[0][1:])
    with (
        zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as stream,
    ):
        np.lib.format.write_array_header_2_0(stream, header)
        for file in files:
            with np.load(file) as tables:
                stream.write(np.ascontiguousarray(tables[name], dtype).tobytes())


# --- import -------------------------------------------------------------------------------------------------


def _json(file: Path) -> Any:
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise damaged(file, "", f"is no params.json of DeepMIMO 4: {error}") from error


def _matrix(file: Path, name: str, rows: int | None, columns: int, *, optional: bool = False) -> Any:
    """Read an array, whose shape is checked; None where it may lack and does."""
    if optional and not file.exists():
        return None
    try:
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as tables:
            found = tables[name]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise damaged(file, "", f"has no array {name!r} that can be read: {error}") from error
    if (
        found.ndim < 1
        or (rows is not None and len(found) != rows)
        or (columns and found.shape[1:] != (columns,))
    ):
        raise damaged(file, name, f"has the shape {found.shape}; {rows} rows are expected")
    if found.dtype.kind == "c":
        raise damaged(file, name, f"is of {found.dtype}; write real numbers")
    return found


def _scenes(
    folders: Sequence[Path],
    tx: Sequence[tuple[int, int]],
    rx: Sequence[int],
    arrays: Mapping[str, AntennaArray],
) -> Iterator[ImportedScene]:
    for number, folder in enumerate(folders):
        devices: dict[str, AntennaDevice] = {}
        paths = list[Paths]()
        for tx_set, count in tx:
            for index in range(count):
                for rx_set in rx:
                    paths += _pairs(folder, (tx_set, index, rx_set), arrays, devices)
        yield ImportedScene(episode=0, scene=number, devices=tuple(devices.values()), paths=paths)


def _pairs(
    folder: Path,
    sets: tuple[int, int, int],
    arrays: Mapping[str, AntennaArray],
    devices: dict[str, AntennaDevice],
) -> Iterator[Paths]:
    """Read the paths of a transmitter to all receivers of a set, whose devices are added."""
    end = "_t{:03d}_tx{:03d}_r{:03d}.npz".format(*sets)

    def table(name: str, rows: int | None, columns: int = 0, *, optional: bool = False) -> Any:
        return _matrix(folder / f"{name}{end}", name, rows, columns, optional=optional)

    rx_pos, tx_pos = table("rx_pos", None, 3), table("tx_pos", 1, 3)
    n, level = len(rx_pos), np.array([[1.0, 0.0, 0.0, 0.0]])
    own = {name: table(name, n, optional=True) for name in ("rx_orientation", "user", "doppler")}
    turned = table("tx_orientation", 1, 4, optional=True)
    turn_tx = level[0] if turned is None else turned[0]
    turn_rx = np.repeat(level, n, axis=0) if own["rx_orientation"] is None else own["rx_orientation"]
    columns = {name: table(name, n) for name in PER_USER[:8]}
    points = table("inter_pos", n, optional=True)
    shape = columns["power"].shape
    for name, values in columns.items():
        if values.ndim != 2 or values.shape != shape:
            raise damaged(folder / f"{name}{end}", name, f"has the shape {values.shape}, and power {shape}")
    tx_name = f"tx{sets[0]}-{sets[1]}"
    devices[tx_name] = _device(tx_name, "tx", tx_pos[0], turn_tx, arrays["tx"])
    for at in range(n):
        name = f"rx{sets[2]}-{at:06d}"
        if not np.isfinite(rx_pos[at]).all():
            continue
        device = _device(name, "rx", rx_pos[at], turn_rx[at], arrays["rx"])
        if devices.setdefault(name, device) != device:  # another transmitter's files have the same receivers
            place = devices[name].position
            raise damaged(
                folder / f"rx_pos{end}",
                f"row {at}",
                f"is {device.position}, and {place} for another transmitter",
            )
        there = np.flatnonzero(np.isfinite(columns["power"][at]))
        if not np.array_equal(there, np.flatnonzero(np.isfinite(columns["delay"][at]))):
            raise damaged(
                folder / f"power{end}", f"row {at}", "has other paths than delay: write NaN in both"
            )
        row = {key: values[at, there].astype(np.float64) for key, values in columns.items()}
        bad = next((key for key, values in row.items() if not np.isfinite(values).all()), None)
        if bad is not None:
            raise damaged(folder / f"{bad}{end}", f"row {at}", "is not finite where there is power")
        far = next((key for key in ANGLES if (np.abs(row[key]) > 360).any()), None)
        if far is not None or (row["delay"] < 0).any():
            wrong = "a delay below 0 s" if far is None else f"{far} beyond 360°"
            raise damaged(folder / f"{far or 'delay'}{end}", f"row {at}", f"has {wrong}")
        aod, aoa = (np.radians(np.stack([row[f"{e}_el"], row[f"{e}_az"]], axis=1)) for e in ("aod", "aoa"))
        shift = first_element(arrays["tx"], turn_tx, aod) + first_element(arrays["rx"], turn_rx[at], aoa)
        phase = np.exp(1j * (np.radians(row["phase"]) - 2 * np.pi * shift))
        texts = [str(int(value)) for value in row["inter"]]
        depth = max((len(text) for text in texts), default=0)
        types = np.array([[int(sign) for sign in text.ljust(depth, "0")] for text in texts], np.uint8)
        types = types.reshape(len(texts), depth)
        found = np.zeros((len(there), depth, 3))
        if points is not None and points.ndim == 4:
            some = points[at, there, :depth]
            found[:, : some.shape[1]] = np.nan_to_num(some)
        doppler = own["doppler"]
        yield Paths(
            tx=tx_name,
            rx=name,
            los="0" in texts,
            a=(10 ** (row["power"] / 20) * phase)[None],
            tau=row["delay"],
            aod=aod,
            aoa=aoa,
            doppler=None if doppler is None else doppler[at, there].astype(np.float64)[None],
            interactions=types,
            points=found,
        )


def _device(
    name: str, role: Any, position: Float64Array, orientation: Float64Array, array: AntennaArray
) -> AntennaDevice:
    x, y, z = map(float, position)
    w, i, j, k = map(float, orientation)
    return AntennaDevice(name=name, role=role, position=(x, y, z), orientation=(w, i, j, k), array=array)
