"""Format ``viwi``: raw data and pictures as of the ViWi datasets, and sequences of best beams."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Any

import numpy as np

from caviar_clients.datasets.impulse_responses import only_array, placed_antennas
from caviar_clients.datasets.user_rows import Users
from caviar_formats.base import Format, Part, only_one
from caviar_protocol.arrays import Complex128Array, Int64Array
from caviar_protocol.errors import RunError

LENGTH = 13
"""Beams of a sequence."""
NUMBER = np.dtype([("real", "<f8"), ("imag", "<f8")])
"""Complex number of MATLAB."""
_PARTS = ".parts"
_KEYS = ("episode", "scene", "rx")


class ViWi(Format):
    """Struct of channels and places in `raw_data.mat`, pictures in `rgb`, and `beams.csv`."""

    packages = ("h5py", "PIL")
    needs = ("channel.h",)
    temporary = (_PARTS,)
    loses = (
        "Users without a path; all but channels and places; elements of receivers but the first; cameras "
        "that move, or are not the nearest one to a transmitter; pictures of later users at the same place."
    )

    def begin(self, users: Users) -> None:
        users = users[users["valid"]]
        if not len(users):
            raise RunError(f"{users.dataset.location} has no user with a path, and the format no others")
        only_one(users, "carrier")
        self._array = only_array(users, "tx")
        self._transmitters: list[str] = np.unique(users["tx"]).tolist()
        recorded = users.recorded()
        self._channel = "channel.hf" if "channel.hf" in recorded else "channel.h"
        # Readers find the user of a picture by its place.
        places = np.stack([users["x_m"], users["y_m"]], axis=1).round(3)
        first = np.unique(places, axis=0, return_index=True)[1]
        self._pictured = set(_keys(users[np.sort(first)]))
        cameras = {
            device["name"]: device["position_m"]
            for device in users.dataset.settings["scenario"]["devices"]
            if "camera.rgb" in recorded and device["kind"] == "camera" and not device["on"]
        }
        some = users.one_of_each_kind()
        places_of = dict(zip(some["tx"].tolist(), placed_antennas(some, "tx"), strict=True))
        self._cameras = [
            min(cameras, key=lambda name: math.dist(cameras[name], places_of[tx].position.tolist()))
            for tx in (self._transmitters if cameras else ())
        ]

    def write(self, part: Part, folder: Path) -> None:
        (folder / _PARTS).mkdir(exist_ok=True)
        users = part.users[part.users["valid"]]
        if not len(users):
            return
        keys = _keys(users)
        rows = {key: row for row, key in enumerate(dict.fromkeys(keys))}
        row_of = np.array([rows[key] for key in keys])
        h = self._at_first_element(users)
        channel = np.zeros((len(self._transmitters), len(rows), *h.shape[1:]), np.complex128)
        channel[np.searchsorted(self._transmitters, users["tx"]), row_of] = h
        loc = np.zeros((len(rows), 3))
        loc[row_of] = np.stack([users[f"{axis}_m"] for axis in "xyz"], axis=1)
        columns = dict(zip(_KEYS, map(np.array, zip(*rows, strict=True)), strict=True))
        np.savez(folder / _PARTS / f"{part.number:05d}.npz", allow_pickle=False, channel=channel, loc=loc,
                 beam=self._best_beams(channel), **columns)  # fmt: skip
        if self._cameras:
            self._write_pictures(users, list(rows), loc.tolist(), folder)

    def _at_first_element(self, users: Users) -> Complex128Array:
        """H at the first element of the receivers, Shape ``[U, K, N]``, elements row by row from −z, −y."""
        h = users[self._channel]
        h = h[:, 0, :, 0] if self._channel == "channel.hf" else h[:, :1]
        grid = h.reshape(*h.shape[:2], self._array.columns, self._array.rows)
        found: Complex128Array = np.swapaxes(grid[..., ::-1], 2, 3).reshape(h.shape)
        return found

    def _best_beams(self, channel: Complex128Array) -> Int64Array:
        """Strongest beam of the DFT codebook of ViWi, from 1; 0 without a path."""
        shape = (*channel.shape[:3], self._array.rows, self._array.columns)
        power = (np.abs(np.fft.ifft2(channel.reshape(shape))) ** 2).sum(axis=2)
        best: Int64Array = 1 + power.reshape(*shape[:2], -1).argmax(axis=2)
        return np.where(channel.any(axis=(2, 3)), best, 0)

    def _write_pictures(self, users: Users, keys: list[Any], loc: list[Any], folder: Path) -> None:
        from PIL import Image

        (folder / "rgb").mkdir(exist_ok=True)
        for (episode, scene, rx), place in zip(keys, loc, strict=True):
            if (episode, scene, rx) not in self._pictured:
                continue
            recording = users.dataset.episode(episode)
            view: Any = recording["camera"][[recording.place(episode, scene)]]
            pictures = view.rgb[0, view.index(self._cameras)]
            for number, picture in enumerate(pictures, 1):
                Image.fromarray(picture).save(folder / _picture(number, place), compress_level=1)

    def finish(self, users: Users, folder: Path) -> None:
        import h5py

        parts = [np.load(file) for file in sorted((folder / _PARTS).iterdir())]
        small = {
            name: np.concatenate([part[name] for part in parts], axis=int(name == "beam"))
            for name in ("beam", "loc", *_KEYS)
        }
        file = folder / "raw_data.mat"
        with h5py.File(file, "w", userblock_size=512) as out:
            out.create_group("#refs#")  # the struct is the second group
            struct = out.create_group("raw_data")
            shape = parts[0]["channel"].shape
            channel = struct.create_dataset("channel", (shape[0], len(small["loc"]), *shape[2:]), NUMBER)
            row = 0
            for part in parts:
                found = np.ascontiguousarray(part["channel"])
                channel[:, row : row + found.shape[1]] = found.view(NUMBER)
                row += found.shape[1]
            struct["loc"] = small["loc"]
            for item, kind in ((struct, "struct"), (channel, "double"), (struct["loc"], "double")):
                item.attrs["MATLAB_class"] = np.bytes_(kind)
        with file.open("r+b") as out:
            # Version 2.0, little-endian: of MAT-files, MATLAB R2006b, "MAT-file header".
            out.write(b"MATLAB 7.3 MAT-file".ljust(116) + bytes(8) + b"\x00\x02IM")
        self._write_sequences(small, folder / "beams.csv")

    def _write_sequences(self, small: dict[str, Any], file: Path) -> None:
        order = np.lexsort((small["scene"], small["rx"], small["episode"]))
        episode, scene, rx, loc = (small[name][order] for name in (*_KEYS, "loc"))
        ends = (np.diff(episode) != 0) | (rx[1:] != rx[:-1]) | (np.diff(scene) != 1)
        with file.open("w", newline="") as out:
            writer = csv.writer(out, lineterminator="\n")
            writer.writerow([f"{what}_{n}" for what in ("Beam", "Img") for n in range(1, LENGTH + 1)])
            for number, of_transmitter in enumerate(small["beam"], 1):
                beams, rows = of_transmitter[order], list[int]()
                for row, beam in enumerate(beams.tolist()):
                    if row and ends[row - 1]:
                        rows = []
                    rows = [*rows, row] if beam else []
                    if len(rows) == LENGTH:
                        keys = [(int(episode[at]), int(scene[at]), str(rx[at])) for at in rows]
                        pictures = [
                            _picture(number, loc[at].tolist())
                            if self._cameras and key in self._pictured
                            else ""
                            for at, key in zip(rows, keys, strict=True)
                        ]
                        writer.writerow([*beams[rows].tolist(), *pictures])
                        rows = []

    def readme(self, users: Users) -> str:
        names = "\n".join(
            f"| {number} | {tx} | {self._cameras[number - 1] if self._cameras else ''} |"
            for number, tx in enumerate(self._transmitters, 1)
        )
        return f"""# {users.dataset.name} in the form of ViWi

- `raw_data.mat` (MATLAB 7.3, that is HDF5): struct `raw_data` with `channel`, float64 pairs (real, imag), in
  MATLAB elements × subcarriers × users × transmitters, in h5py the other way round: H at the first element
  (top row, −y) of the receiver, of `{self._channel}`, 0 without a path; those of the transmitter in rows from
  −z upwards, in a row from −y to +y. `loc`: 3 × users, places of the receivers in the world [m], x to the
  east, y to the north, z upwards.
- `rgb/cam_N_X_Y.png`: picture of transmitter N's camera, the nearest one that stands, with the user at X, Y
  [m] in it; users of a scene have the same picture. Readers find the user of a picture by its place.
- `beams.csv`: sequences of {LENGTH} consecutive scenes of a receiver, transmitter by transmitter, without
  overlap: `Beam_1` to `Beam_{LENGTH}`, strongest beam from 1 of the DFT codebook exp(−j2πnq/N) over rows and
  columns, by the sum of powers over subcarriers; `Img_1` to `Img_{LENGTH}`, pictures, empty where there is
  none.

| N | transmitter | camera |
| --- | --- | --- |
{names}
"""


def _keys(users: Users) -> list[tuple[int, int, str]]:
    return list(zip(*(users[name].tolist() for name in _KEYS), strict=True))


def _picture(number: int, place: list[float]) -> str:
    return f"rgb/cam_{number}_{place[0]:.3f}_{place[1]:.3f}.png"
