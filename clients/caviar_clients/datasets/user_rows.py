"""Users of a dataset as rows: columns of the catalogue, and what was recorded of each user."""

from __future__ import annotations

import importlib.util
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from caviar_clients.datasets.rows import USER_COLUMNS, column_types
from caviar_clients.datasets.texts import counted
from caviar_protocol.errors import RecordingError, SetupError, suggestion
from caviar_protocol.host import install_command
from caviar_protocol.recording import Recording
from caviar_protocol.recording.arrays import TopicArrays, data_frame
from caviar_protocol.recording.topics import TOPIC_ARRAYS
from caviar_protocol.topics import Lidar, Link, topics_of

if TYPE_CHECKING:
    from caviar_clients.datasets.impulse_responses import ImpulseResponses
    from caviar_clients.datasets.reader import Dataset
    from caviar_clients.datasets.torch_data import UserBatches, UserSamples

_DTYPES: dict[type, Any] = {int: np.int64, float: np.float64, bool: np.bool_, str: np.str_}
_NONE: dict[type, Any] = {int: -1, float: np.nan}
Beside: TypeAlias = "Callable[[Dataset, int, int], object] | None"
SENSORS = topics_of("sensors")
"""Topics with a row for each sensor: a user has the one on its own object, or that of all."""
_WITH_USERS = ("channel", "link", *SENSORS)


class Columns(Mapping[str, NDArray[Any]]):
    """Columns of a table, by name, all of the same length.

    Args:
        columns: Arrays of the same length.

    Example:
        >>> table = Columns({"episode": np.array([0, 1]), "scenes": np.array([3, 4])})
        >>> table["scenes"].sum(), len(table), list(table)
        (np.int64(7), 2, ['episode', 'scenes'])
    """

    def __init__(self, columns: Mapping[str, NDArray[Any]]) -> None:
        self._columns = dict(columns)

    @classmethod
    def of_rows(cls, row: type[Any], names: Sequence[str], rows: Sequence[Sequence[Any]]) -> Columns:
        """Make columns of the rows of a database.

        Args:
            row: Class whose fields are the columns.
            names: Of the columns, in the order of the values.
            rows: Values.
        """
        types = column_types(row)
        values = list(zip(*rows, strict=True)) if rows else [()] * len(names)
        found = {}
        for name, column in zip(names, values, strict=True):
            kind, optional = types[name]
            given = [_NONE[kind] if value is None else value for value in column] if optional else column
            found[name] = np.array(given, dtype=_DTYPES[kind])
        return cls(found)

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name not in self._columns:
            raise RecordingError(f"there is no column {name!r}; {suggestion(name, self._columns)}")
        return self._columns[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __contains__(self, name: object) -> bool:
        return name in self._columns

    def __len__(self) -> int:
        """Number of rows."""
        return len(next(iter(self._columns.values()))) if self._columns else 0

    def where(self, rows: NDArray[Any]) -> Columns:
        """These rows only.

        Args:
            rows: A mask, or positions.
        """
        return Columns({name: column[rows] for name, column in self._columns.items()})

    def dataframe(self) -> Any:
        """Make a ``pandas.DataFrame`` of the columns: ``data.table("scenes").dataframe()``.

        Raises:
            SetupError: pandas is not installed.
        """
        return data_frame(self)


class Users:
    """Users of a dataset, a row each: a receiver in a scene, on a carrier, for a transmitter.

    A name without a dot is a column of the catalogue: ``users["gain_db"]``. A name with one is a recorded
    array, of which each user has a row: ``users["channel.h"]``, ``users["lidar.grid"]``. Recorded arrays are
    read when they are asked for, and not kept.

    Args:
        dataset: Of which they are.
        table: Their rows of the catalogue.
    """

    def __init__(self, dataset: Dataset, table: Columns) -> None:
        self._dataset, self._table = dataset, table

    @property
    def dataset(self) -> Dataset:
        """The dataset that they are of."""
        return self._dataset

    def __len__(self) -> int:
        """Number of users."""
        return len(self._table)

    def dataframe(self) -> Any:
        """Make a ``pandas.DataFrame`` of the columns of the catalogue.

        Raises:
            SetupError: pandas is not installed.
        """
        return self._table.dataframe()

    def __repr__(self) -> str:
        about = {name: USER_COLUMNS.get(name, "") for name in self._table} | self.recorded()
        lines = [f"{counted(len(self), 'user')} of {self._dataset.location}"]
        lines += [f"  {name}: {text}" for name, text in about.items()]
        return "\n".join(lines)

    def __getattr__(self, name: str) -> Any:
        # Only of what is not there.
        if name.startswith("_"):
            raise AttributeError(name, name=name, obj=self)
        meant = [name] if name in self._table else _recorded_like(name)
        written = " or ".join(f"users[{one!r}]" for one in meant[:3])
        hint = f"write {written}" if meant else "print(users) lists their names"
        raise AttributeError(f"users have no attribute {name!r}; {hint}", name=name, obj=self)

    def recorded(self) -> dict[str, str]:
        """Names of the recorded arrays, each with what it is, its unit and the shape of a row."""
        if not self._dataset.episodes:
            return {}
        recording = self._dataset.episode(self._dataset.episodes[0])
        return {
            f"{topic}.{name}": f"{column.doc} [{column.unit}], {column.dtype.name}, {list(column.shape)}"
            for topic in recording.topics
            if topic in _WITH_USERS
            for name, column in TOPIC_ARRAYS[topic].columns.items()
            if not _lacks(recording, topic, name)
        }

    def readable(self) -> dict[str, str]:
        """Recorded arrays, as of `recorded`, of which each user has one row: no sensors of which it has none
        or several."""
        found = self.recorded()
        some = self.one_of_each_kind()
        for topic in {name.partition(".")[0] for name in found}.intersection(SENSORS):
            try:
                some._recorded([next(name for name in found if name.startswith(f"{topic}."))])
            except RecordingError:
                found = {name: text for name, text in found.items() if not name.startswith(f"{topic}.")}
        return found

    def one_of_each_kind(self) -> Users:
        """Take the first user of each transmitter, class of object and device on it."""
        columns = zip(self["tx"], self["object_class"], self["rx"], strict=True)
        kinds = np.array([f"{tx} {cls} {rx.rpartition('/')[2]}" for tx, cls, rx in columns])
        return Users(self._dataset, self._table.where(np.sort(np.unique(kinds, return_index=True)[1])))

    def __getitem__(self, name: str | slice | Sequence[int] | NDArray[Any]) -> Any:
        """A column, a recorded array, or with a slice, a mask or positions these users only.

        Raises:
            RecordingError: There is no such name, or it was not recorded.
            IndexError: There are no such users, or the mask has another length.
            TypeError: It is the position of one user; ``users[3:4]`` are users, ``users["rx"][3]`` a value.
        """
        if isinstance(name, str):
            return self.read([name])[name]
        has = f"users are 0 to {len(self) - 1}" if len(self) else "there are no users here"
        if isinstance(name, int | np.integer) and not isinstance(name, bool):
            raise TypeError(
                f"users[{name}] is one user: write users[{name}:{name + 1 or None}] for that one alone, or "
                f"users['rx'][{name}] for a value; {has}"
            )
        try:
            rows = np.arange(len(self))[name if isinstance(name, slice) else np.asarray(name)]
        except IndexError as error:
            raise IndexError(f"users[{_shown(name)}]: {error}; {has}, as a slice, list or mask") from None
        return Users(self._dataset, self._table.where(rows))

    def read(self, names: Sequence[str], beside: Beside = None) -> Columns:
        """Read several columns and recorded arrays at once, each scene once.

        Args:
            names: As of ``users[name]``.
            beside: Called with (dataset, episode, scene) after each scene, to read more of its frame.

        Returns:
            An array for each name; axis 0 counts the users, in their order. Rows of different lengths are
            padded with NaN, −1 for integers, 0 for unsigned ones and false for booleans. Where all these
            users have one row, as the picture of a scene's only camera, it is not copied: the array is a view
            that cannot be written. See `distinct` for users of many scenes.

        Raises:
            RecordingError: There is no such name, or it was not recorded; a user's object has no such sensor.
            ValueError: ``names`` is empty.
            TypeError: It is a text.
        """
        self.check_names(names)
        columns = {name: self._table[name] for name in names if "." not in name}
        recorded = [name for name in names if "." in name]
        rows = self._recorded(recorded, beside) if recorded else {}
        return Columns({name: columns[name] if name in columns else _stacked(rows[name]) for name in names})

    def rows(self, names: Sequence[str], beside: Beside = None) -> dict[str, list[Any]]:
        """Read the rows of recorded arrays as they are, without padding.

        Args:
            names: Of recorded arrays.
            beside: As of `read`.

        Returns:
            For each name an array or a number a user, in their order.

        Raises:
            RecordingError, ValueError, TypeError: As of `read`.
        """
        self.check_names(names)
        return self._recorded(names, beside)

    def distinct(self, name: str) -> tuple[NDArray[Any], NDArray[np.int64]]:
        """Read each row of a recorded array once, however many users have it, as the pictures of cameras.

        Args:
            name: Of a recorded array, ``"camera.rgb"``.

        Returns:
            The rows, padded as of `read`, and for each user the index of its own: with both,
            ``rows[index[i]]`` is ``users[name][i]``.

        Raises:
            RecordingError: As of `read`.
            ValueError: It is a column of the catalogue.

        Example:
            >>> users = caviar.dataset("data/cameras").users()  # doctest: +SKIP
            >>> pictures, index = users.distinct("camera.rgb")  # doctest: +SKIP
        """
        self.check_names([name])
        if "." not in name:
            raise ValueError(f"distinct({name!r}): a column of the catalogue; numpy.unique finds its values")
        rows = self._recorded([name])[name]
        once = {id(row): row for row in rows}
        place = {key: at for at, key in enumerate(once)}
        return _stacked([*once.values()]), np.array([place[id(row)] for row in rows], dtype=np.int64)

    def batches(self, size: int, names: Sequence[str], *, shuffle: int | None = None) -> Iterator[Columns]:
        """Read the users in parts, so that a dataset of any size is read in the memory of one.

        Args:
            size: Users of a part at most.
            names: Columns and recorded arrays.
            shuffle: Seed of the order; None: as they are. Episodes are shuffled, and users within 16 of
                them, so that what is read together lies together.

        Raises:
            RecordingError: There is no such name.
            ValueError: A part would have no user, ``names`` is empty, or ``shuffle`` no number.
            TypeError: ``names`` is a text.
        """
        self.check_names(names)
        parts = self.parts(size, shuffle=shuffle)
        return (part.read(names) for part in parts)  # no generator itself: what is wrong is said at once

    def parts(self, size: int, *, shuffle: int | None = None) -> list[Users]:
        """The parts that `batches` reads, in the same order; nothing is read.

        Args:
            size: Users of a part at most.
            shuffle: As of `batches`.

        Raises:
            ValueError: A part would have no user, or ``shuffle`` is no number.
        """
        check_batches(size, shuffle)
        order = np.arange(len(self)) if shuffle is None else self._shuffled(shuffle)
        return [self[order[start : start + size]] for start in range(0, len(order), size)]

    def cir(
        self, *, time_steps: int = 1, sampling_frequency: float = 1.0, paths: int | None = None
    ) -> ImpulseResponses:
        """Impulse responses between antenna elements, for Sionna's ``CIRDataset``.

        Args:
            time_steps: Of each response.
            sampling_frequency: Of the time steps [Hz].
            paths: Of each response; None: as many as the user with most has.

        Raises:
            RecordingError: The users' arrays differ, or have several polarizations or panels.
            ValueError: There is no time step, or the frequency is not positive.
        """
        from caviar_clients.datasets.impulse_responses import ImpulseResponses

        return ImpulseResponses(self, time_steps, sampling_frequency, paths)

    def torch(self, names: Sequence[str]) -> UserSamples:
        """A PyTorch ``Dataset`` of these users, by position (`torch_data.UserSamples`).

        Args:
            names: Columns and recorded arrays of a sample.

        Raises:
            RecordingError: There is no such name.
            SetupError: PyTorch is not installed; the text has the command.
            ValueError: ``names`` is empty, or devices give an array several shapes, which no batch holds.
            TypeError: It is a text.
        """
        self.check_names(names)
        _require_torch()
        self._require_one_shape(names)
        from caviar_clients.datasets.torch_data import UserSamples

        return UserSamples(self, names)

    def torch_batches(self, size: int, names: Sequence[str], *, shuffle: int | None = None) -> UserBatches:
        """A PyTorch ``IterableDataset`` of batches, in one order for any number of loading processes.

        Args:
            size: Users of a batch at most.
            names: Columns and recorded arrays.
            shuffle: Seed of the order; None: as they are.

        Raises:
            RecordingError: There is no such name.
            SetupError: PyTorch is not installed; the text has the command.
            ValueError, TypeError: As of `batches`.
        """
        self.check_names(names)
        check_batches(size, shuffle)
        _require_torch()
        from caviar_clients.datasets.torch_data import UserBatches

        return UserBatches(self, names, size, shuffle)

    def check_names(self, names: Sequence[str]) -> None:
        """Check names of columns and of recorded arrays, of which the first product is looked at.

        Args:
            names: As of `read`.

        Raises:
            RecordingError: There is no such name, or it was not recorded; the text has the near ones.
            ValueError: There is none.
            TypeError: It is a text.
        """
        if isinstance(names, str):
            raise TypeError(f"names is {names!r}: write a list of names, as [{names!r}]")
        if not len(names):
            raise ValueError(f"names is {names!r}: name a column at least; known: {', '.join(self._table)}")
        for name in names:
            topic, dot, field = name.partition(".")
            if not dot and name not in self._table and (arrays := _recorded_like(name)):
                raise RecordingError(
                    f"there is no column {name!r}; a recorded array has its topic's name in front: "
                    f"{', '.join(map(repr, arrays))}"
                )
            if not dot:
                self._table[name]  # which raises
            elif topic not in _WITH_USERS:
                raise RecordingError(
                    f"{name!r}: {topic!r} has no row for each user; {suggestion(topic, _WITH_USERS)} Other "
                    "topics: dataset.episode(NUMBER)[TOPIC]"
                )
            elif field not in (columns := TOPIC_ARRAYS[topic].columns):
                raise RecordingError(f"{topic} has no array {field!r}; {suggestion(field, columns)}")
            elif self._dataset.episodes:
                recording = self._dataset.episode(self._dataset.episodes[0])
                if topic in recording.topics and (why := _lacks(recording, topic, field)):
                    raise RecordingError(why)

    def _require_one_shape(self, names: Sequence[str]) -> None:
        """Refuse arrays whose shape the devices say, and differs: a user of each device is looked at."""
        fixed = [name for name in names if "." in name and name not in _OF_ANY_LENGTH]
        devices = {
            str(name).rpartition("/")[2]: at
            for end in ("tx", "rx")
            for name, at in zip(*np.unique(self._table[end], return_index=True), strict=True)
        }
        some = self[np.array(sorted(devices.values()), dtype=np.int64)]
        for name, rows in some._recorded(fixed).items():
            shapes = {np.shape(row): str(rx) for row, rx in zip(rows, some["rx"], strict=True)}
            if len(shapes) > 1:
                (one, rx), (other, another) = list(shapes.items())[:2]
                raise ValueError(
                    f"{name} has the shape {one} for {rx!r} and {other} for {another!r}: take torch_batches, "
                    "which pads, or users of one kind, as dataset.users(object_class='car')"
                )

    def _shuffled(self, seed: int) -> NDArray[np.int64]:
        draw = random.Random(seed)  # noqa: S311 - no secret
        episode = self._table["episode"]
        numbers = np.unique(episode).tolist()
        draw.shuffle(numbers)
        places = {number: np.flatnonzero(episode == number).tolist() for number in numbers}
        order = list[int]()
        for start in range(0, len(numbers), _TOGETHER):
            part = [place for number in numbers[start : start + _TOGETHER] for place in places[number]]
            draw.shuffle(part)
            order += part
        return np.array(order, dtype=np.int64)

    def _recorded(self, names: Sequence[str], beside: Beside = None) -> dict[str, list[Any]]:
        """Rows of recorded arrays, in the order of the users."""
        found: dict[str, list[Any]] = {name: [None] * len(self) for name in names}
        by_topic: dict[str, list[str]] = {}
        for name in names:
            topic, _, field = name.partition(".")
            by_topic.setdefault(topic, []).append(field)
        table = self._table
        scenes = np.stack([table["episode"], table["scene"]], axis=1)
        # Each scene once, in the order in which they lie on the disk.
        order = np.lexsort((scenes[:, 1], scenes[:, 0]))
        starts = np.flatnonzero(np.any(np.diff(scenes[order], axis=0, prepend=-1), axis=1))
        for at, start in enumerate(starts):
            stop = starts[at + 1] if at + 1 < len(starts) else len(order)
            users = order[start:stop]
            episode, scene = (int(value) for value in scenes[users[0]])
            for topic, fields in by_topic.items():
                rows = self._rows(topic, fields, episode, scene, users)
                for field, values in zip(fields, rows, strict=True):
                    column = found[f"{topic}.{field}"]
                    for user, row in zip(users, values, strict=True):
                        column[user] = row
            if beside:
                beside(self._dataset, episode, scene)
        return found

    def _rows(
        self, topic: str, fields: Sequence[str], episode: int, scene: int, users: NDArray[Any]
    ) -> list[list[Any]]:
        """Rows of recorded arrays of a topic, of users of one scene, whose payload is decoded once."""
        recording = self._dataset.episode(episode)
        arrays: TopicArrays[Any, Any] = recording[topic]
        payload = arrays[recording.place(episode, scene)]
        place = f"{recording.path}, scene {scene}"
        if payload is None:
            raise RecordingError(f"{place}: {topic} is absent")
        at = {key: number for number, key in enumerate(arrays.keys_of(payload))}
        keys = [self._key(topic, at, user, place) for user in users]
        all_rows = list[list[Any]]()
        for field in fields:
            rows = arrays.columns[field].rows(arrays, payload)
            # Users with one row have one object, which `_stacked` and `distinct` know again.
            found = {key: rows[key] for key in set(keys)}
            all_rows.append([found[key] for key in keys])
        return all_rows

    def _key(self, topic: str, at: Mapping[Any, int], user: int, place: str) -> int:
        """The row of a product that a user has."""
        table = self._table
        if topic not in SENSORS:
            key = str(table["tx"][user]), str(table["rx"][user]), str(table["carrier"][user])
            if key not in at:
                raise RecordingError(f"{place}: {topic} has no user {key}")
            return at[key]
        carrier = str(table["object"][user])
        own = [row for sensor, row in at.items() if carrier and str(sensor).startswith(f"{carrier}/")]
        fixed = [row for sensor, row in at.items() if "/" not in str(sensor)]
        for rows in (own, fixed):
            if len(rows) == 1:
                return rows[0]
        raise RecordingError(
            f"{place}: {table['rx'][user]} has {len(own)} sensors of {topic} on its object, and {len(fixed)} "
            f"stand fixed: it takes one of either; read dataset.episode({table['episode'][user]})[{topic!r}]"
        )


def _lacks(recording: Recording, topic: str, name: str) -> str:
    """Say why an array was not recorded, as its topic's first product shows; empty where it was."""
    arrays = recording[topic]
    payload = next((payload for payload in arrays if payload is not None), None)
    if payload is None:
        return ""
    try:
        arrays.columns[name].rows(arrays, payload)
    except RecordingError as error:
        return str(error)
    if isinstance(payload, Link) and getattr(payload, name) is None:
        return f"{arrays.place} has no {name}: the run had no packets; give its link some, and run again"
    scans = payload.scans if isinstance(payload, Lidar) and name in _OF_HITS else ()
    if scans and scans[0].grid is not None and not any(len(scan.ray) for scan in scans):
        return (
            f"{arrays.place} was recorded without {name}: its scans have the grid alone; write lidar into "
            "`record` below [run] of the scenario, and run again"
        )
    return ""


_OF_HITS = ("hits", "points", "points_world", "range", "ray", "object")
_OF_ANY_LENGTH = frozenset(f"lidar.{name}" for name in _OF_HITS) | {
    f"channel.{name}" for name, column in TOPIC_ARRAYS["channel"].columns.items() if "P" in column.shape
}
"""Arrays as long as what was found: paths, hits."""


def _recorded_like(name: str) -> list[str]:
    """Names of recorded arrays that are meant by that of a topic, or by one without its topic."""
    if name.lower() in _WITH_USERS:
        return [f"{name.lower()}.{field}" for field in TOPIC_ARRAYS[name.lower()].columns]
    return [
        f"{topic}.{field}"
        for topic in _WITH_USERS
        for field in TOPIC_ARRAYS[topic].columns
        if field.lower() == name.lower()
    ]


def check_batches(size: int, shuffle: int | None) -> None:
    """Check the size of batches, and the seed of their order.

    Args:
        size: Users of a batch.
        shuffle: Seed; None: none.

    Raises:
        ValueError: A batch would have no user, or the seed is no whole number.
    """
    if not isinstance(size, int | np.integer) or isinstance(size, bool) or size < 1:
        raise ValueError(f"size is {size!r}: a batch has at least 1 user, write a whole number, as 64")
    if shuffle is not None and (not isinstance(shuffle, int | np.integer) or isinstance(shuffle, bool)):
        raise ValueError(
            f"shuffle is {shuffle!r}: it is the seed of the order, write a whole number, as shuffle=1; None "
            "leaves the users as they are"
        )


def _shown(value: object) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else f"{text[:57]}…"


def _require_torch() -> None:
    if importlib.util.find_spec("torch") is None:
        raise SetupError(f"PyTorch is not installed; run: {install_command('learning')}")


_TOGETHER = 16

# What stands where there is no value, by kind of element.
_MISSING: dict[str, Any] = {"f": np.nan, "c": complex(np.nan, np.nan), "i": -1, "u": 0, "b": False}


def _stacked(rows: Sequence[Any]) -> NDArray[Any]:
    """Rows as one array, padded where their lengths differ."""
    if not rows:
        return np.zeros(0)
    if len(rows) > 1 and np.ndim(rows[0]) and all(row is rows[0] for row in rows):
        return np.broadcast_to(rows[0], (len(rows), *np.shape(rows[0])))
    arrays = [np.asarray(row) for row in rows]
    shape = tuple(np.max([array.shape for array in arrays], axis=0).astype(int)) if arrays[0].ndim else ()
    if all(array.shape == shape for array in arrays):
        return np.stack(arrays)
    out = np.full((len(arrays), *shape), _MISSING[arrays[0].dtype.kind], dtype=arrays[0].dtype)
    for at, array in enumerate(arrays):
        out[at][tuple(slice(size) for size in array.shape)] = array
    return out
