"""The products of one topic over the frames of a recording, as NumPy arrays.

`Recording.__getitem__` makes a `TopicArrays`: ``recording["channel"]``. It knows which frames it covers, and
reads them when an attribute is asked for. A `Column` says how the rows of one product (users, objects,
sensors) become rows of an array whose first axis counts frames. `caviar_protocol.recording.topics` and
`caviar_protocol.recording.scene` have a class for each topic.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cache, cached_property, partial
from typing import (
    TYPE_CHECKING,
    Any,
    ClassVar,
    Generic,
    Self,
    TypeAlias,
    TypeVar,
    get_args,
    get_type_hints,
    overload,
)

import msgspec
import numpy as np
from numpy.typing import NDArray

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array, Payload, array_fields
from caviar_protocol.errors import RecordingError, SetupError, suggestion
from caviar_protocol.fields import GrantInput, Status
from caviar_protocol.space.scene import merge_scenes

if TYPE_CHECKING:
    from caviar_protocol.recording.reader import Recording

P = TypeVar("P", bound=Payload)
K = TypeVar("K", bound=Hashable)
S = TypeVar("S", bound=np.generic)
Rows: TypeAlias = Sequence[Any] | NDArray[Any]
"""One array or number a row of a product, in the order of its keys; an array counts rows along axis 0."""

# What stands where there is no value, by kind of element.
_MISSING: dict[str, Any] = {"f": np.nan, "c": complex(np.nan, np.nan), "i": -1, "u": 0, "b": False}
_FRESHNESS = (Status.ABSENT, Status.HELD, Status.FRESH)


MEASURED_B = 16 * 2**20
"""Size of a recording up to which the text of a topic has the sizes of its arrays, for which all of the topic
is read."""


class Column(Generic[S]):
    """An array attribute of a `TopicArrays`, read from the recording each time it is asked for.

    Args:
        dtype: Element type.
        shape: Of one row: fixed sizes, or the name of one that differs between rows. Such an axis is as long
            as the longest row, and the others are padded with the missing value.
        rows: Rows of one product; by default the payload's field of this attribute's name.
    """

    def __init__(
        self,
        dtype: type[S],
        *shape: int | str,
        unit: str = "1",
        doc: str = "",
        rows: Callable[[Any, Any], Rows] | None = None,
    ) -> None:
        self.dtype, self.shape, self.unit, self.doc = np.dtype(dtype), shape, unit, doc
        # Set by `__set_name__`, when the class body is done.
        self.name = ""
        self._rows = rows

    def __set_name__(self, owner: type[TopicArrays[Any, Any]], name: str) -> None:
        self.name = name
        owner.columns = {**owner.columns, name: self}
        axes = ", ".join(["F", owner.axis, *map(str, self.shape)])
        self.__doc__ = f"{self.doc} [{self.unit}], {self.dtype.name}, Shape ``[{axes}]``."

    @overload
    def __get__(self, view: None, owner: type[Any]) -> Self: ...
    @overload
    def __get__(self, view: TopicArrays[Any, Any], owner: type[Any]) -> NDArray[S]: ...
    def __get__(self, view: TopicArrays[Any, Any] | None, owner: type[Any]) -> Self | NDArray[S]:
        return self if view is None else view.stack(self)

    def rows(self, view: TopicArrays[Any, Any], payload: Payload) -> Rows:
        """Rows of one product, in the order of ``view.keys_of(payload)``.

        Args:
            view: The topic in some frames.
            payload: One product of it.
        """
        found: Rows = getattr(payload, self.name) if self._rows is None else self._rows(view, payload)
        return found


# Python evaluates type hints anew at each call, and a payload has a dozen columns.
_type_hints = cache(partial(get_type_hints, include_extras=True))


def payload_column(
    dtype: type[S],
    cls: type[Payload],
    name: str,
    axes: int = 1,
    rows: Callable[[Any, Any], Rows] | None = None,
) -> Column[S]:
    """A column with the shape, the unit and the description of a payload's field.

    Args:
        dtype: Element type, that of the field.
        cls: Class of the payload, or of the object in it that is a row.
        name: The field.
        axes: Leading axes of the field that count rows.
        rows: Rows of one product; by default those of the field along its first axis.
    """
    spec, hint = array_fields(cls)[name], _type_hints(cls)[name]
    candidates = (hint, *get_args(hint))  # an optional field is a union with the annotated type
    doc = next(
        str(meta.description)
        for candidate in candidates
        for meta in getattr(candidate, "__metadata__", ())
        if isinstance(meta, msgspec.Meta)
    )
    return Column(dtype, *spec.shape[axes:], unit=spec.unit, doc=doc, rows=rows)


class TopicArrays(Generic[P, K]):
    """Products of one topic in some frames of a recording.

    Nothing is read before it is asked for, and no array is kept: an attribute costs the memory of its array,
    which ``[i:j]``, `select` and `blocks` make smaller. Indexing with an integer gives the payload of a frame
    (None where it is absent), with a slice, a list of positions or a mask the same topic in these frames.

    Where a frame has no product, or a product lacks a row that other frames have, arrays hold NaN, or −1 for
    integers, 0 for unsigned ones and false for booleans; `present` says which rows are there, `status` why.
    Axis F counts the frames.

    Args:
        recording: Of which the frames are.
        topic: Name of the topic.
        sources: Services that produced it; several only of ``scene``, whose worlds are merged.
        indices: Places of the frames in the recording, Shape ``[F]``.

    Raises:
        RecordingError: On reading: the bytes of a product are damaged or not in this file; the message names
            frame and place.

    Example:
        >>> from caviar_protocol.recording import Recording
        >>> recording = Recording("runs/smoke-20261122-101500")
        >>> link = recording["link"]
        >>> link[10:20].abs_y.shape, link[link.fresh].frame[:3].tolist(), type(link[7]).__name__
        ((10, 2), [0, 1, 2], 'Link')
    """

    axis: ClassVar[str] = ""
    """Name of the second axis of the arrays."""
    columns: ClassVar[dict[str, Column[Any]]] = {}
    """The arrays by attribute name."""

    def __init__(
        self, recording: Recording, topic: str, sources: tuple[str, ...], indices: Int64Array
    ) -> None:
        self.topic = topic
        self.sources = sources
        """Services that produced it. Several only of ``scene``, whose worlds are merged."""
        self._recording, self._indices = recording, indices
        self._wanted: tuple[tuple[int, frozenset[str]], ...] = ()
        self._reference: TopicArrays[Any, K] | None = None
        self._known_sizes: dict[str, tuple[int, ...]] = {}

    def __getattr__(self, name: str) -> Any:
        # Only of what is not there.
        hint = suggestion(name, self.columns)
        topic = self.__dict__.get("topic", type(self).__name__)
        text = name if name.startswith("_") else f"{topic} has no {name!r}; {hint}"
        raise AttributeError(text, name=name, obj=self)

    # --- frames -------------------------------------------------------------------------------

    @property
    def place(self) -> str:
        """File or directory, and topic, as an error names them."""
        return f"{self._recording.path}: {self.topic}"

    def recorded(self, part: str, rows: Sequence[NDArray[Any] | None]) -> list[NDArray[Any]]:
        """Rows of a part that is computed only where a consumer asks for it.

        Args:
            part: Topic and part: ``channel.h``.
            rows: Rows of one product; None where one lacks the part.

        Raises:
            RecordingError: A row is not there; the text says what to write into the scenario.
        """
        found = [row for row in rows if row is not None]
        if len(found) == len(rows):
            return found
        run = self._recording.metadata.scenario.get("run", {})
        if isinstance(run, Mapping) and part in run.get("record", ()):
            raise RecordingError(
                f"{self.place} has no {part}, which `record` below [run] of its scenario asks for: "
                f"{' and '.join(map(repr, self.sources))} did not deliver it; mend it, and run again"
            )
        raise RecordingError(
            f"{self.place} was recorded without {part}: write it into `record` below [run] of the scenario, "
            "and run again"
        )

    def __len__(self) -> int:
        """Number of frames F."""
        return len(self._indices)

    @cached_property
    def episode(self) -> Int64Array:
        """Episode of each frame, from 0. Shape ``[F]``."""
        return self._of_entries("episode")

    @cached_property
    def frame(self) -> Int64Array:
        """Number of each frame in its episode, from 0. Shape ``[F]``."""
        return self._of_entries("frame")

    @cached_property
    def t_ns(self) -> Int64Array:
        """Simulated time of each frame in its episode [ns]. Shape ``[F]``."""
        return self._of_entries("t_ns")

    @property
    def t(self) -> Float64Array:
        """Simulated time of each frame in its episode [s]. Shape ``[F]``."""
        return self.t_ns.astype(np.float64) * 1e-9

    @cached_property
    def status(self) -> NDArray[np.str_]:
        """``fresh``, ``held`` (an earlier product, used again) or ``absent``. Shape ``[F]``.

        It is what the consumers of the frame got: where a product came late, the status is ``held`` or
        ``absent``. Of several sources it is the least fresh.
        """
        found = [min((item.status for item in items), key=_FRESHNESS.index) for items in self._provenance]
        return np.array(found, dtype=np.str_)

    @property
    def fresh(self) -> BoolArray:
        """Frames with a product of their own, as a mask: ``channel[channel.fresh].h``. Shape ``[F]``."""
        mask: BoolArray = self.status == Status.FRESH
        return mask

    @cached_property
    def age(self) -> Int64Array:
        """Frames since the product was computed; −1 where it is absent. Shape ``[F]``."""
        found = [
            max((item.age if item.status is not Status.ABSENT else -1) for item in items)
            for items in self._provenance
        ]
        return np.array(found, dtype=np.int64)

    @property
    def cause(self) -> tuple[str, ...]:
        """Cause why the product of each frame is held or absent: service and frame of origin. Length F."""
        return tuple("; ".join(item.cause for item in items if item.cause) for items in self._provenance)

    # --- choosing -----------------------------------------------------------------------------

    @overload
    def __getitem__(self, frames: int | np.integer[Any]) -> P | None: ...
    @overload
    def __getitem__(self, frames: slice | Sequence[int] | NDArray[Any]) -> Self: ...
    def __getitem__(
        self, frames: int | np.integer[Any] | slice | Sequence[int] | NDArray[Any]
    ) -> P | Self | None:
        if isinstance(frames, slice):
            return self._view(self._indices[frames])
        if isinstance(frames, np.ndarray | Sequence):
            return self._view(self._indices[np.asarray(frames, dtype=None if len(frames) else np.int64)])
        return self._payload(int(self._indices[operator.index(frames)]))

    def __iter__(self) -> Iterator[P | None]:
        """The payload of each frame, None where it is absent."""
        return (self._payload(int(index)) for index in self._indices)

    def select(self, *, episode: int | None = None, frames: Iterable[int] | None = None) -> Self:
        """The frames with these numbers, of this episode.

        Args:
            episode: Number of an episode; None: all.
            frames: Numbers of frames in their episodes; None: all.

        Raises:
            RecordingError: An episode or a frame was not recorded; the text says what was.
        """
        chosen = np.ones(len(self), dtype=bool)
        if episode is not None:
            chosen &= self._chosen("episode", self.episode, [episode])
        if frames is not None:
            chosen[chosen] = self._chosen("frame", self.frame[chosen], frames)
        return self._view(self._indices[chosen])

    def blocks(self, frames: int) -> Iterator[Self]:
        """Parts of the frames, one after the other, with the rows and sizes of the whole.

        So a recording of any length is read in the memory of one block.

        Args:
            frames: Frames of a block at most.

        Raises:
            ValueError: A block would have no frame.

        Example:
            >>> from caviar_protocol.recording import Recording
            >>> channel = Recording("runs/smoke-20261122-101500")["channel"]
            >>> [block.los.shape for block in channel.blocks(40)]
            [(40, 2), (40, 2), (20, 2)]
        """
        if frames < 1:
            raise ValueError(f"a block has at least 1 frame, got {frames}")
        for start in range(0, len(self), frames):
            yield self[start : start + frames].like(self)

    def like(self, other: TopicArrays[Any, K]) -> Self:
        """These frames with the rows of another view, in its order; of one topic, with its sizes, too.

        Args:
            other: The view, such as that of all frames.
        """
        view = self._view(self._indices)
        view._reference = other
        return view

    # --- rows ---------------------------------------------------------------------------------

    @cached_property
    def keys(self) -> tuple[K, ...]:
        """Keys of the second axis: everything that occurs in one of these frames, sorted."""
        if self._reference is not None:
            return tuple(key for key in self._reference.keys if self._is_wanted(key))
        found: dict[K, None] = {}
        seen: Sequence[K] | None = None
        for payload in self:
            # Rows are those of the frame before in most frames: one comparison of tuples a frame.
            if payload is not None and (keys := self.keys_of(payload)) != seen:
                found.update(dict.fromkeys(keys))
                seen = keys
        return tuple(key for key in self.sorted_keys(found) if self._is_wanted(key))

    @property
    def present(self) -> BoolArray:
        """True if the frame's product has the row. Shape ``[F, rows]``."""
        found = np.zeros((len(self), len(self.keys)), dtype=bool)
        for at, payload in enumerate(self):
            if payload is not None:
                found[at, self._places(self.keys_of(payload))[1]] = True
        return found

    def stack(self, column: Column[S]) -> NDArray[S]:
        """Read the array of a column.

        Args:
            column: One of `columns`.

        Returns:
            Shape ``[F, rows, …]``, with the missing value where a row is not there.
        """
        shape = self._shape(column)
        # Padding comes first, so that rows and frames that are absent need no step of their own.
        out: NDArray[S] = np.full(shape, _MISSING[column.dtype.kind], dtype=column.dtype)
        for at, payload in enumerate(self):
            if payload is None:
                continue
            rows, (own, places) = column.rows(self, payload), self._places(self.keys_of(payload))
            # One assignment for all rows where they are of full size; ragged ones go one by one.
            if isinstance(rows, np.ndarray) and rows.shape[1:] == shape[2:]:
                out[at, places] = rows[own]
            else:
                for row, place in zip(own, places, strict=True):
                    # The Ellipsis keeps a view where the row is one number, which an index alone would copy.
                    part = out[at, place, ...]
                    part[tuple(map(slice, np.shape(rows[row])))] = rows[row]
        return out

    def table(self) -> dict[str, NDArray[Any]]:
        """Read what has one value, or three or four, a row: columns of a table, each product decoded once.

        Returns:
            ``episode``, ``frame``, ``t`` [s], names of the row, and arrays by name, of vectors with ``_x``,
            ``_y``, ``_z`` (of orientations ``_w`` before them); a row for each that is present. Arrays that
            were not recorded, or have no number in any row, are left out.

        Example:
            >>> from caviar_protocol.recording import Recording
            >>> table = Recording("runs/smoke-20261122-101500")["scene"].table()
            >>> len(table["t"]), list(table)[:5]
            (200, ['episode', 'frame', 't', 'name', 'position_x'])
        """
        found = {name: list[Any]() for name, c in self.columns.items() if c.shape in ((), (3,), (4,))}
        at, keys = list[int](), list[K]()
        for frame, payload in enumerate(self):
            if payload is None:
                continue
            own, places = self._places(self.keys_of(payload))
            at += [frame] * len(own)
            keys += [self.keys[place] for place in places]
            for name in list(found):
                try:
                    rows = self.columns[name].rows(self, payload)
                except RecordingError:
                    del found[name]  # a part that was not recorded
                else:
                    found[name] += [rows[row] for row in own]
        names = getattr(self.keys[0], "_fields", ("name",)) if self.keys else ()
        place = np.array(at, np.int64)
        table = {"episode": self.episode[place], "frame": self.frame[place], "t": self.t[place]}
        table |= {name: np.array([_field(key, i) for key in keys]) for i, name in enumerate(names)}
        for name, values in found.items():
            column = self.columns[name]
            array = np.array(values, column.dtype).reshape(-1, *map(int, column.shape))
            if array.size and array.dtype.kind == "f" and np.isnan(array).all():
                continue
            axes = "wxyz"[-array.shape[1] :] if array.ndim > 1 else ""
            table |= {f"{name}_{axis}": array[:, i] for i, axis in enumerate(axes)} or {name: array}
        return table

    def dataframe(self) -> Any:
        """Make a ``pandas.DataFrame`` of `table`.

        Raises:
            SetupError: pandas is not installed.

        Example:
            >>> from caviar_protocol.recording import Recording
            >>> link = Recording("runs/smoke-20261122-101500")["link"]
            >>> link.dataframe().groupby("rx").snr.mean()  # doctest: +SKIP
        """
        return data_frame(self.table())

    def __repr__(self) -> str:
        lines = [f"{self.topic} of {', '.join(map(repr, self.sources))}, F = {len(self)} frames"]
        shapes: dict[str, tuple[int, ...]] = {}
        with suppress(OSError):  # damaged: reading an array says where
            # Ragged axes need every product decoded: too long for the text of a large recording.
            if sum(file.stat().st_size for file in self._recording.files) <= MEASURED_B:
                for name, column in self.columns.items():
                    with suppress(RecordingError):  # damaged likewise, or a part that was not recorded
                        shapes[name] = self._shape(column)
        for name, column in self.columns.items():
            lines.append(f"  {name}: {column.__doc__}" + (f" Here {shapes[name]}." if name in shapes else ""))
        return "\n".join(lines)

    def _shape(self, column: Column[Any]) -> tuple[int, ...]:
        return len(self), len(self.keys), *self._sizes(column)

    # --- what a topic defines -------------------------------------------------------------------

    def keys_of(self, payload: P) -> Sequence[K]:
        """Key of each row of one product."""
        raise NotImplementedError

    def sorted_keys(self, keys: Iterable[K]) -> Iterable[K]:
        """All keys in the order of the second axis; ``keys`` come in the order in which they occurred."""
        raise NotImplementedError

    # --- reading --------------------------------------------------------------------------------

    def _view(self, indices: Int64Array) -> Self:
        view = type(self)(self._recording, self.topic, self.sources, indices)
        view._wanted, view._reference = self._wanted, self._reference
        return view

    def _narrowed(self, wanted: Iterable[tuple[int, str, str | Iterable[str] | None]]) -> Self:
        """The rows whose key has one of the given names in a field, given as (field, its name, names)."""
        view = self._view(self._indices)
        for field, label, names in wanted:
            if names is None:
                continue
            chosen = {names} if isinstance(names, str) else set(names)
            known = {_field(key, field) for key in self.keys}
            for name in sorted(chosen - known):
                raise RecordingError(
                    f"{self.place} has no {label} {name!r} in these frames; {suggestion(name, known)}"
                )
            view._wanted = (*view._wanted, (field, frozenset(chosen)))
        return view

    def _is_wanted(self, key: K) -> bool:
        return all(_field(key, field) in names for field, names in self._wanted)

    def _payload(self, index: int) -> P | None:
        found: dict[str, P] = {}
        for item in self._items(index):
            if item.status is not Status.ABSENT:
                found[item.source] = self._recording.recorded_product(index, item).payload  # type: ignore[assignment]
        if len(found) < 2:
            return next(iter(found.values()), None)
        # `Recording` lets several sources through of scenes alone: those of the worlds.
        return merge_scenes(found)  # type: ignore[arg-type, return-value]

    def _items(self, index: int) -> list[GrantInput]:
        """Provenance by source; a source that the frame does not list is absent."""
        listed = {
            item.source: item
            for item in self._recording.entry(index).inputs
            if item.topic == self.topic and item.status is not Status.LATE
        }
        return [
            listed.get(source) or GrantInput(topic=self.topic, source=source, status=Status.ABSENT)
            for source in self.sources
        ]

    @cached_property
    def _provenance(self) -> list[list[GrantInput]]:
        return [self._items(int(index)) for index in self._indices]

    def _of_entries(self, field: str) -> Int64Array:
        entries = (self._recording.entry(int(index)) for index in self._indices)
        return np.array([getattr(entry, field) for entry in entries], dtype=np.int64)

    def _chosen(self, label: str, values: Int64Array, wanted: Iterable[int]) -> BoolArray:
        numbers = np.unique(np.fromiter(wanted, dtype=np.int64))
        for number in numbers[~np.isin(numbers, values)][:1]:
            has = f"{values.min()} to {values.max()}" if len(values) else "none"
            raise RecordingError(f"{self.place} has no {label} {number} here; it has {has}")
        chosen: BoolArray = np.isin(values, numbers)
        return chosen

    @cached_property
    def _place_of(self) -> dict[K, int]:
        return {key: place for place, key in enumerate(self.keys)}

    def _places(self, keys: Sequence[K]) -> tuple[list[int], list[int]]:
        """Rows of a product that are wanted, and where each of them stands on the second axis."""
        known = self._place_of
        own = [row for row, key in enumerate(keys) if key in known]
        return own, [known[keys[row]] for row in own]

    def _sizes(self, column: Column[Any]) -> tuple[int, ...]:
        """Sizes of one row of the array."""
        # A block has the sizes of the whole, or blocks could not be concatenated.
        if type(self._reference) is type(self):
            return self._reference._sizes(column)
        if all(isinstance(size, int) for size in column.shape):
            return tuple(size for size in column.shape if isinstance(size, int))
        if column.name not in self._known_sizes:
            found = np.array([size if isinstance(size, int) else 0 for size in column.shape])
            for payload in self:
                if payload is not None:
                    rows, (own, _) = column.rows(self, payload), self._places(self.keys_of(payload))
                    for row in own:
                        found = np.maximum(found, np.shape(rows[row]))
            self._known_sizes[column.name] = tuple(found.tolist())
        return self._known_sizes[column.name]


def data_frame(table: Mapping[str, NDArray[Any]]) -> Any:
    """Make a ``pandas.DataFrame``, which is no requirement of this distribution.

    Args:
        table: Columns.

    Raises:
        SetupError: pandas is not installed.
    """
    try:
        from pandas import DataFrame
    except ModuleNotFoundError as error:
        raise SetupError(
            "a DataFrame needs pandas, which is not installed; run: pip install pandas"
        ) from error
    return DataFrame(dict(table))


def _field(key: Any, field: int) -> str:
    """A field of a key that has several; a key that is a name is its own."""
    return key if isinstance(key, str) else str(key[field])
