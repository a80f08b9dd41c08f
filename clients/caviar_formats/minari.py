"""Format ``minari``: episodes of decisions and rewards, for offline reinforcement learning with Minari."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import msgspec
import numpy as np

from caviar_clients.datasets.user_rows import Users
from caviar_clients.envs.base import KINDS, OF_PACKETS, Reward
from caviar_formats.base import Format, Part, markdown_table
from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import RecordingError, RunError
from caviar_protocol.observations import FAR, OBSERVATION_PARTS, Moment, Observer, require_packets
from caviar_protocol.observations import Users as Places
from caviar_protocol.recording import RecordedFrame, Recording
from caviar_protocol.scenario import Scenario
from caviar_protocol.space.scene import Pair
from caviar_protocol.topics import Action, Link, VelocityCommand

VERSION = "0.5.4"
"""Of Minari, whose files these are."""
PACKET_PARTS = ("last_throughput", "buffered", "waiting")
OF_SENSORS = {"camera": "camera.rgb", "depth": "depth.depth", "lidar_grid": "lidar.grid"}
"""Recorded array of each part of the observation that is of a sensor."""
LARGE_B = 2**16
"""Size of an array above which it is compressed, without losses."""
_PARTS = ".parts"


class Minari(Format):
    """Dataset of Minari: observations, actions, rewards and ends of each episode, in HDF5."""

    flavours: ClassVar[Mapping[str, str]] = {kind: f"with the reward {kind!r}" for kind in KINDS}
    packages = ("h5py",)
    needs = ("link.tx_beam",)
    of_all_users = True
    whole_episodes = True
    temporary = (_PARTS,)
    loses = (
        "Channels, scenes and links but for what is observed of them; infos, seeds. The goal of a flight, "
        "which is not recorded, and its part of rewards; frames before the first velocity of a flown object."
    )

    def begin(self, users: Users) -> None:
        dataset = users.dataset
        scenario = msgspec.convert(dataset.settings["scenario"], Scenario)
        if not any(spec.role == "agent" for spec in scenario.services.values()):
            raise RunError(f"{dataset.location} has no agent, whose decisions are exported; was it imported?")
        self._flown = [
            str(spec.settings.get("prefix") or "") + flown["name"]
            for spec in scenario.services.values()
            if spec.role == "world"
            for flown in spec.settings.get("flown", ())
        ]
        first: Recording = dataset.episode(dataset.episodes[0])
        needed = ("scene", "action") if self._flown else ("scene",)
        if lacking := [topic for topic in needed if topic not in first.topics]:
            raise RecordingError(
                f'{dataset.location} was recorded without {lacking[0]}: write "{lacking[0]}" into `record` '
                "below [run] of the scenario, and generate it again"
            )
        if self.flavour in OF_PACKETS:
            require_packets(scenario, f"the reward {self.flavour!r}")
        self._places, self._reward = Places(scenario, ("*",)), Reward(self.flavour)  # type: ignore[arg-type]
        recorded = users.recorded()
        names = [
            name
            for name, part in OBSERVATION_PARTS.items()
            # On the lowest carrier the spectrum is the answer.
            if not part.needs_sensor and name != "spectrum"
            if name not in PACKET_PARTS or "link.throughput" in recorded
        ]
        for name, array in OF_SENSORS.items():
            kind = OBSERVATION_PARTS[name].needs_sensor
            for device in scenario.devices if array in recorded else ():
                own = device.count == 1 or self._places.on_objects_of(device)
                names += [f"{name}:{device.name}"] if device.kind == kind and own else []
        self._observer = Observer(scenario, self._places, names)
        numbers = np.unique(dataset.table("scenes")["episode"]).tolist()
        self._ids = {number: at for at, number in enumerate(numbers)}
        self._name = re.sub(r"[^A-Za-z0-9_-]", "-", dataset.name) + "-v0"

    def write(self, part: Part, folder: Path) -> None:
        import h5py

        (folder / _PARTS).mkdir(exist_ok=True)
        with h5py.File(folder / _PARTS / f"{part.number:05d}.hdf5", "w") as file:
            for episode in np.unique(part.scenes["episode"]).tolist():
                scenes = np.sort(part.scenes["scene"][part.scenes["episode"] == episode]).tolist()
                recording = part.users.dataset.episode(episode)
                number = self._ids[episode]
                group = file.create_group(f"episode_{number}")
                steps = self._steps([recording.frame(episode, scene) for scene in scenes], group)
                group.attrs["id"], group.attrs["total_steps"] = number, steps

    def _steps(self, frames: list[RecordedFrame], group: Any) -> int:
        """Write the steps of an episode, and return how many there are."""
        observations, actions, rewards, last = list[Any](), list[Any](), list[float](), None
        for frame in frames:
            place = f"episode {frame.episode}, frame {frame.number}"
            scene, links = frame.scene(), list(frame.payloads("link", Link).values())
            if scene is None or len(links) != 1:
                raise RecordingError(f"{place}: {'scene' if scene is None else 'link'} is absent")
            flight = self._velocities(frame)
            if flight is None and actions:
                raise RunError(f"{place}: a flown object has no velocity, which is what actions hold")
            users = self._places.present(scene)
            now = Moment(frame, scene, last, users)
            (last,) = links
            if flight is None:
                last = None  # an episode begins without a link, as in the environments
                continue
            observations.append(self._observer.read(now))
            action: dict[str, Any] = {"beams": self._beams(last, users, place)}
            actions.append(action | ({"velocity": flight} if self._flown else {}))
            rewards.append(self._reward.mean(last, {(pair.tx.name, pair.rx.name) for _, pair in users}))
        if not actions:
            raise RunError(f"episode {frames[0].episode}: its flown objects get no velocities")
        # The last frame is seen until the end: only its link comes after it.
        observations.append(self._observer.read(Moment(frame, now.scene, last, users)))
        _write_tree(group, "observations", observations)
        _write_tree(group, "actions", actions if self._flown else [action["beams"] for action in actions])
        group["rewards"] = np.array(rewards)
        group["terminations"] = np.zeros(len(rewards), np.bool_)
        group["truncations"] = np.arange(len(rewards)) == len(rewards) - 1
        group.create_group("infos")
        return len(rewards)

    def _beams(self, link: Link, users: tuple[tuple[int, Pair], ...], where: str) -> Any:
        """Index of the pair of beams that each place had, 0 for an empty one."""
        chosen = np.zeros(len(self._places), np.int64)
        for place, pair in users:
            mine = [
                link.tx_beam[u] * pair.beams[1] + link.rx_beam[u] if link.tx_beam[u] >= 0 else -1
                for u, names in enumerate(zip(link.tx, link.rx, strict=True))
                if names == (pair.tx.name, pair.rx.name)
            ]
            if len(set(mine)) != 1 or mine[0] < 0:
                what = "have no beams" if -1 in mine or not mine else "have other beams on each carrier"
                raise RunError(f"{where}: {pair.tx.name} → {pair.rx.name} {what}, which actions do not hold")
            chosen[place] = mine[0]
        return chosen if len(chosen) > 1 else chosen[0]

    def _velocities(self, frame: RecordedFrame) -> Float64Array | None:
        """Velocity that each flown object was told, Shape ``[objects, 3]``; None where one was not."""
        found = {
            command.object: command.velocity
            for action in frame.payloads("action", Action).values()
            for command in action.commands
            if isinstance(command, VelocityCommand)
        }
        if any(name not in found for name in self._flown):
            return None
        return np.array([found[name] for name in self._flown], np.float64).reshape(-1, 3)

    def finish(self, users: Users, folder: Path) -> None:
        import h5py

        data, steps = folder / self._name / "data", 0
        data.mkdir(parents=True, exist_ok=True)
        with h5py.File(data / "main_data.hdf5", "w") as out:
            for file in sorted((folder / _PARTS).iterdir()):
                with h5py.File(file, "r") as part:
                    for name, group in part.items():
                        steps += int(group.attrs["total_steps"])
                        part.copy(group, out, name)
        about = {
            "total_episodes": len(self._ids),
            "total_steps": steps,
            "data_format": "hdf5",
            "jpeg_encoding": False,
            "observation_space": msgspec.json.encode(self._observation_space()).decode(),
            "action_space": msgspec.json.encode(self._action_space()).decode(),
            "dataset_id": self._name,
            "minari_version": VERSION,
            "description": f"Beams that were chosen in dataset {users.dataset.name} of CAVIAR",
            "dataset_size": round((data / "main_data.hdf5").stat().st_size / 1e6, 1),
        }
        (data / "metadata.json").write_bytes(msgspec.json.encode(about))

    def _observation_space(self) -> dict[str, Any]:
        boxes = {name: _box(*bounds) for name, bounds in self._observer.bounds.items()}
        return {"type": "Dict", "subspaces": boxes}

    def _action_space(self) -> dict[str, Any]:
        sizes = [place.beam_pairs for place in self._places.places]
        beams: dict[str, Any] = (
            {"type": "Discrete", "dtype": "int64", "n": sizes[0], "start": 0}
            if len(sizes) == 1
            else {"type": "MultiDiscrete", "dtype": "int64", "nvec": sizes, "start": [0] * len(sizes)}
        )
        if not self._flown:
            return beams
        flight = _box(-FAR, FAR, (len(self._flown), 3), np.float64)
        return {"type": "Dict", "subspaces": {"beams": beams, "velocity": flight}}

    def readme(self, users: Users) -> str:
        parts = {
            name: (f"{np.dtype(bounds.dtype).name} {list(bounds.shape)}", _first_paragraph(name))
            for name, bounds in self._observer.bounds.items()
        }
        table = markdown_table(
            ("part", "type and shape", "what it is"), ((name, *row) for name, row in parts.items())
        )
        flown = ""
        if self._flown:
            flown = f"""
`actions` are a dictionary: `beams` as above, and `velocity`, float64 [objects, 3], in world axes [m/s], that
{", ".join(self._flown)} were told. Steps begin with the first one.
"""
        return f"""# {users.dataset.name} as a dataset of Minari

```python
import os

os.environ["MINARI_DATASETS_PATH"] = "/absolute/path/of/this/folder"  # a relative one fails

import minari  # pip install "minari[hdf5]>={VERSION}"

data = minari.load_dataset("{self._name}")
```

`{self._name}/data/main_data.hdf5` has a group for each episode, `metadata.json` beside it the spaces.
Nothing is compressed with losses, pictures neither: they make `metadata.json` large, and loading slow.

- `observations`, T + 1 of T steps, as environments of CAVIAR observe them: step k sees frame k and the link
  of the frame before; the last one is the last frame with its own link. U counts the {len(self._places)}
  places of receivers, those of transmitters one after the other; zeros stand for an empty one.
- `actions`: pair of beams of each place that the link had, `tx_beam·Nr + rx_beam`; 0 for an empty place.
- `rewards`: {self.flavour!r} of the environment `caviar/BeamSelection-v0`, mean over the users with a path.
- `terminations` are false; `truncations` true in the last step.
{flown}
{table}
"""


def _first_paragraph(name: str) -> str:
    text = OBSERVATION_PARTS[name.partition(":")[0]].__doc__ or ""
    return " ".join(text.split())


def _box(low: float, high: float, shape: tuple[int, ...], dtype: Any) -> dict[str, Any]:
    """Describe a box as Minari does, with the bounds of each element."""
    low_of, high_of = (np.full(shape, value, dtype).tolist() for value in (low, high))
    name = np.dtype(dtype).name
    return {"type": "Box", "dtype": name, "shape": shape, "low": low_of, "high": high_of}


def _write_tree(group: Any, name: str, steps: list[Any]) -> None:
    """Write values of steps, or a dictionary of them by name."""
    if not isinstance(steps[0], dict):
        values = np.stack(steps)
        large: dict[str, Any] = (
            {"compression": "gzip", "compression_opts": 1} if values.nbytes > LARGE_B else {}
        )
        group.create_dataset(name, data=values, **large)
        return
    for key in steps[0]:
        _write_tree(group.require_group(name), key, [step[key] for step in steps])
