"""Datasets from files of the ITU challenge and of Raymobtime: rays of receivers, by their CSV and HDF5."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from caviar_formats.imports import ImportedScene, Paths, Source, damaged
from caviar_formats.p2m import LETTERS
from caviar_protocol.arrays import Float64Array
from caviar_protocol.space.antenna_arrays import steering_vector
from caviar_protocol.space.coordinates import (
    SPEED_OF_LIGHT,
    quaternion_from_euler,
    rotation_matrix,
    unit_vectors,
)
from caviar_protocol.topics import AntennaArray, AntennaDevice, Carrier

HEADER = ("Val", "EpisodeID", "SceneID", "VehicleArrayID", "VehicleName", "x", "y", "z", "rays", "LOS")
WORDS = ("", "R", "D", "DS", "T")
"""Interactions by their codes in `Channel`, as they are written; `LETTERS` has all that are read."""
ARRAYS = {"tx": AntennaArray(columns=32), "rx": AntennaArray(columns=8)}
"""Arrays of the challenge, of which the files say nothing."""
TX_YAW_DEG = 90.0
"""Yaw of its transmitter: azimuths are measured to the axis of the array."""
ABOVE_M = 0.1
"""Height of an antenna above the vehicle whose height is the z of its row."""

Key = tuple[int, int, int]


def read_itu(path: Path, frequency_hz: float | None = None) -> Source:
    """Open the files of a set, or of one below ``raw_data``.

    Args:
        path: Folder with one ``CoordVehiclesRxPerScene_*.csv``, and the files of rays in its folders.
        frequency_hz: Of the carrier [Hz]; None: by the name of a file of rays.

    Raises:
        RunError: A file is missing or damaged; names it, and the place in it. So does the iterator.
    """
    tables = sorted(path.rglob("CoordVehiclesRxPerScene*.csv"))
    if len(tables) != 1:
        raise damaged(path, "", f"has {len(tables)} files CoordVehiclesRxPerScene_*.csv, not one")
    (table,) = tables
    rays: dict[int, Path] = {}
    for file in sorted(table.parent.rglob("*.hdf5")):
        if found := re.fullmatch(r".*_e(\d+)\.hdf5", file.name):
            rays[int(found[1])] = file
    rows = _rows(table)
    if missing := sorted(set(rows) - set(rays)):
        raise damaged(
            table.parent, "", f"has no file of rays *_e{missing[0]}.hdf5, an episode of {table.name}"
        )
    ghz = re.search(r"(\d+(?:\.\d+)?)GHz", next(iter(rays.values())).as_posix())
    if frequency_hz is None and ghz is None:
        raise damaged(
            table.parent, "", "files of rays have no carrier, as 60GHz, in their names; give --frequency-hz"
        )
    hertz = frequency_hz or float(ghz[1]) * 1e9  # type: ignore[index]  # one of both is there
    scenes = max(scene for mine in rows.values() for _, scene, _ in mine) + 1
    position, phases = _transmitter(rows, rays)
    return Source(
        path=path,
        scenes=_scenes(table, rows, rays, scenes, position, hertz),
        carriers=(Carrier(name=f"{hertz / 1e9:g}GHz", frequency_hz=hertz, bandwidth_hz=100e6),),
        scenes_of_episode=scenes,
        lacks="No receivers that are not valid, objects, velocities, Doppler shifts, LIDARs and pictures are "
        "imported." + ("" if phases else " The files have no phases: those of paths are of their delays."),
        assumed=f"Arrays have {ARRAYS['tx'].size} and {ARRAYS['rx'].size} elements, TX yaw {TX_YAW_DEG:g}°, "
        f"receivers are {ABOVE_M} m above their vehicles, the transmitter is where straight rays begin, "
        "and sends 0 dBm on 100 MHz.",
    )


def _rows(table: Path) -> dict[int, dict[Key, dict[str, str]]]:
    """Valid rows of the CSV by episode, then by episode, scene and receiver; an episode may have none."""
    found: dict[Key, dict[str, str]] = {}
    try:
        with table.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, strict=True)
            if tuple(reader.fieldnames or ()) != HEADER:
                raise damaged(
                    table, "line 1", f"has the columns {reader.fieldnames}; expected {list(HEADER)}"
                )
            for row in reader:
                place = f"line {reader.line_num}"
                if None in row.values() or None in row:
                    raise damaged(table, place, f"has not {len(HEADER)} columns")
                try:
                    key = int(row["EpisodeID"]), int(row["SceneID"]), int(row["VehicleArrayID"])
                    numbers = [float(row[c]) for c in "xyz"] if row["Val"] == "V" else []
                except ValueError as error:
                    raise damaged(table, place, str(error)) from error
                if row["Val"] not in ("V", "I") or min(key) < 0 or not np.isfinite(numbers).all():
                    raise damaged(table, place, "needs V or I, numbers from 0, and a place in finite metres")
                if found and key <= next(reversed(found)):
                    raise damaged(
                        table, place, "comes after a later receiver; sort by episode, scene, receiver"
                    )
                found[key] = row
    except (UnicodeDecodeError, csv.Error) as error:
        raise damaged(table, "", f"is no CSV in UTF-8: {error}") from error
    valid: dict[int, dict[Key, dict[str, str]]] = {key[0]: {} for key in found}
    for key, row in found.items():
        if row["Val"] == "V":
            valid[key[0]][key] = row
    if not any(valid.values()):
        raise damaged(table, "", "has no valid row")
    return valid


def _rays(file: Path, rows: Mapping[Key, Mapping[str, str]]) -> dict[Key, Float64Array]:
    """Rays of the valid receivers of an episode, Shape ``[rays, 9]`` each."""
    import h5py

    try:
        with h5py.File(file) as data:
            every = np.asarray(data["allEpisodeData"][()], np.float64)
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise damaged(file, "", f"has no array allEpisodeData: {error}") from error
    if every.ndim != 4 or every.shape[3] not in (8, 9):
        raise damaged(
            file, "allEpisodeData", f"has the shape {every.shape}; expected [scenes, receivers, rays, 8 or 9]"
        )
    found = {}
    for key, row in rows.items():
        _, scene, receiver = key
        place = f"allEpisodeData[{scene}, {receiver}]"
        if scene >= every.shape[0] or receiver >= every.shape[1]:
            raise damaged(file, place, f"is not there: the shape is {every.shape}, and the CSV has the row")
        rays = every[scene, receiver]
        padding = np.isnan(rays[:, 0])
        if (padding[:-1] & ~padding[1:]).any():
            raise damaged(file, place, "has a ray after padding")
        rays = rays[~padding]
        # The column of RxAngle is missing in the first sets, where arrays keep their heading.
        rays = np.pad(rays, [(0, 0), (0, 9 - rays.shape[1])])
        if not np.isfinite(np.delete(rays, 7, axis=1)).all():
            raise damaged(file, place, "has a ray with numbers that are not finite")
        if not row["rays"].isdecimal() or len(rays) != int(row["rays"]) or not len(rays):
            raise damaged(file, place, f"has {len(rays)} rays, and the CSV {row['rays']}")
        if row["LOS"] != f"LOS={int(rays[:, 6].any())}":
            raise damaged(file, place, f"has straight rays {rays[:, 6].any()}, and the CSV {row['LOS']}")
        if (rays[:, 1] < 0).any() or (rays[:, [2, 4]] < 0).any() or (rays[:, [2, 4]] > 180).any():
            raise damaged(file, place, "has a delay below 0 s, or a zenith outside of 0 to 180°")
        found[key] = rays
    return found


def _interactions(file: Path) -> list[Any]:
    """Codes of interactions, Shape ``[S, R, L, D]``, and their points; empty where there is no such file."""
    import h5py

    beside = file.with_name(f"{file.stem}_interactions.hdf5")
    if not beside.exists():
        return []
    try:
        with h5py.File(beside) as data:
            codes = np.asarray(data["allInteractionsDescriptions"][()], np.int64)
            points = np.asarray(data["allInteractionsPositions"][()], np.float64)
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise damaged(beside, "", f"has no arrays of interactions: {error}") from error
    if codes.shape[4:] != (2,) or points.shape != (*codes.shape[:4], 3):
        raise damaged(beside, "", f"has arrays of the shapes {codes.shape} and {points.shape}")
    found = np.zeros(codes.shape[:4], np.uint8)
    for word, kind in LETTERS.items():
        found[(codes == [*map(ord, word), -1, -1][:2]).all(axis=-1)] = kind
    if (unknown := (codes[..., 0] > 0) & (found == 0)).any():
        at = [int(i) for i in np.argwhere(unknown)[0]]
        raise damaged(beside, f"allInteractionsDescriptions{at}", f"{codes[tuple(at)]} is no interaction")
    return [found, points]


def _receiver(row: Mapping[str, str]) -> Float64Array:
    return np.array([float(row["x"]), float(row["y"]), float(row["z"]) + ABOVE_M])


def _transmitter(
    rows: Mapping[int, dict[Key, dict[str, str]]], rays: Mapping[int, Path]
) -> tuple[Float64Array, bool]:
    """Position of the transmitter: the median of where straight rays begin; and whether rays have phases."""
    begins, phases = [], False
    for episode, mine in rows.items():
        for key, found in _rays(rays[episode], mine).items():
            phases |= bool(np.isfinite(found[:, 7]).all())
            for ray in found[found[:, 6] == 1]:
                way = unit_vectors(np.radians(ray[2:4])) * ray[1] * SPEED_OF_LIGHT
                begins.append(_receiver(mine[key]) - way)
        if len(begins) >= 100:
            break
    if not begins:
        raise damaged(
            next(iter(rays.values())).parent, "", "has no straight ray, by which to find the transmitter"
        )
    middle: Float64Array = np.median(begins, axis=0)
    return middle, phases


def _scenes(
    table: Path,
    rows: Mapping[int, dict[Key, dict[str, str]]],
    rays: Mapping[int, Path],
    scenes: int,
    place: Float64Array,
    hertz: float,
) -> Iterator[ImportedScene]:
    tx = AntennaDevice(
        name="tx",
        role="tx",
        position=tuple(place.tolist()),
        orientation=quaternion_from_euler(np.radians(TX_YAW_DEG)),
        array=ARRAYS["tx"],
    )
    for episode, mine in rows.items():
        found = _rays(rays[episode], mine)
        met = _interactions(rays[episode])
        for scene in range(scenes):
            devices, paths = [tx], []
            for key in [key for key in mine if key[1] == scene]:
                name = mine[key]["VehicleName"] or f"rx{key[2]}"
                if name in {device.name for device in devices}:
                    raise damaged(table, f"episode {episode}, scene {scene}", f"has {name!r} twice")
                rx = AntennaDevice(
                    name=name,
                    role="rx",
                    position=tuple(_receiver(mine[key]).tolist()),
                    orientation=quaternion_from_euler(np.radians(found[key][0, 8])),
                    array=ARRAYS["rx"],
                )
                devices.append(rx)
                paths.append(_paths(found[key], hertz, tx, rx, met and [values[key[1:]] for values in met]))
            yield ImportedScene(episode=episode, scene=scene, devices=tuple(devices), paths=paths)


def _paths(rays: Float64Array, hertz: float, tx: AntennaDevice, rx: AntennaDevice, met: list[Any]) -> Paths:
    """Columns of topic ``channel``; phases move from the first elements to the centres of the arrays."""
    a: Any = 10 ** (rays[:, 0] / 20)
    angles = {"aod": np.radians(rays[:, 2:4]), "aoa": np.radians(rays[:, 4:6])}
    if np.isnan(rays[:, 7]).any():
        a = a * np.exp(-2j * np.pi * hertz * rays[:, 1])
    else:
        a = a * np.exp(1j * np.radians(rays[:, 7]))
        for device, towards in zip((tx, rx), angles.values(), strict=True):
            own = unit_vectors(towards) @ rotation_matrix(device.orientation)
            a = a * steering_vector(device.array, own)[:, 0].conj()
    types, points = (values[: len(rays)] for values in met) if met else (None, None)
    return Paths(
        tx=tx.name,
        rx=rx.name,
        los=bool(rays[:, 6].any()),
        a=a[None],
        tau=rays[:, 1],
        interactions=types,
        points=points,
        **angles,
    )
