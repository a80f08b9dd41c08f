"""Payloads with arrays: their typed fields, the checks of these, and how arrays travel.

A product is two byte strings: a *header* (msgpack map of the typed fields) and a *body* (the
arrays, one after the other). In the header an array stands as
``{"dtype": "<f8", "shape": [3, 2], "offset": 0}``; its elements are in C order, little-endian,
at ``offset`` bytes into the body. Offsets are multiples of 8, increase in field order, and
gaps are zero, so that equal values give equal bytes (contract, clause 20).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from operator import attrgetter
from typing import Annotated, Any, ClassVar, TypeAlias, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
from numpy.typing import NDArray

from caviar_protocol.errors import PayloadError

BoolArray: TypeAlias = NDArray[np.bool_]
UInt8Array: TypeAlias = NDArray[np.uint8]
Int8Array: TypeAlias = NDArray[np.int8]
Int32Array: TypeAlias = NDArray[np.int32]
Int64Array: TypeAlias = NDArray[np.int64]
UInt64Array: TypeAlias = NDArray[np.uint64]
Float32Array: TypeAlias = NDArray[np.float32]
Float64Array: TypeAlias = NDArray[np.float64]
Complex64Array: TypeAlias = NDArray[np.complex64]
Complex128Array: TypeAlias = NDArray[np.complex128]

WIRE_DTYPES: dict[str, np.dtype[Any]] = {
    code: np.dtype(code)
    for code in ("|b1", "|u1", "|i1", "<u2", "<i4", "<i8", "<u8", "<f4", "<f8", "<c8", "<c16")
}
"""Element types that may travel, by the code that stands in a header."""

MAX_DIMENSIONS = 6
"""An array on the wire has at most this many dimensions."""


class ArrayField(msgspec.Struct, frozen=True):
    """What an array field of a payload promises.

    Args:
        dtype: Element type as it stands in a header, a key of `WIRE_DTYPES`.
        shape: Fixed sizes and names; a name stands for one size throughout a payload object.
        unit: Unit of the elements, ``"1"`` for pure numbers.

    Example:
        >>> from caviar_protocol.topics import Scene
        >>> array_fields(Scene)["position"]
        ArrayField(dtype='<f8', shape=('N', 3), unit='m')
    """

    dtype: str
    shape: tuple[int | str, ...]
    unit: str


def array(dtype: str, *shape: int | str, unit: str, doc: str) -> Any:
    """Describe an array field of a payload.

    Args:
        dtype: Element type as it stands in a header, one of `WIRE_DTYPES`: ``"<f8"``.
        shape: Fixed sizes and names; a name stands for one size throughout a payload object.
        unit: Unit of the elements, ``"1"`` for pure numbers.
        doc: What the array is.

    Returns:
        An annotation: ``Annotated[Float64Array, array("<f8", "N", 3, unit="m", doc="position")]``.

    Raises:
        ValueError: Elements of this type cannot travel.

    Example:
        >>> Positions = Annotated[Float64Array, array("<f8", "N", 3, unit="m", doc="position")]
        >>> array("<f16", "N", unit="m", doc="position")
        Traceback (most recent call last):
            ...
        ValueError: dtype '<f16' cannot travel; one of |b1, |u1, |i1, <u2, <i4, <i8, <u8, <f4, <f8, <c8, <c16
    """
    if dtype not in WIRE_DTYPES:
        raise ValueError(f"dtype {dtype!r} cannot travel; one of {', '.join(WIRE_DTYPES)}")
    return msgspec.Meta(description=doc, extra={"array": ArrayField(dtype, shape, unit), "unit": unit})


def quantity(unit: str, doc: str, **constraints: Any) -> Any:
    """Describe a number, or a tuple of numbers, with its unit.

    Args:
        unit: Unit, ``"1"`` for a pure number.
        doc: What the number is.
        constraints: Bounds, as of `msgspec.Meta`: ``ge=0``.

    Returns:
        An annotation: ``Annotated[float, quantity("Hz", "centre frequency", gt=0)]``.

    Example:
        >>> Frequency = Annotated[float, quantity("Hz", "centre frequency", gt=0)]
        >>> msgspec.convert(28e9, Frequency)
        28000000000.0
        >>> msgspec.convert(-1.0, Frequency)
        Traceback (most recent call last):
            ...
        msgspec.ValidationError: Expected `float` > 0.0
    """
    return msgspec.Meta(description=doc, extra={"unit": unit}, **constraints)


def described(doc: str, **constraints: Any) -> Any:
    """Describe a field that has no unit: a name, a text, a flag.

    Args:
        doc: What the field is.
        constraints: Bounds, as of `msgspec.Meta`: ``max_length=128``.

    Returns:
        An annotation, as of `quantity`.

    Example:
        >>> Label = Annotated[str, described("name on the screen", max_length=8)]
        >>> msgspec.convert("uav", Label)
        'uav'
    """
    return msgspec.Meta(description=doc, extra={"unit": ""}, **constraints)


MAX_COORDINATE_M = 1e9
"""[m] from the origin, along an axis. Squares of it are still far from the limits of single precision."""
Coordinate = Annotated[float, quantity("m", "along an axis", ge=-MAX_COORDINATE_M, le=MAX_COORDINATE_M)]
Position = Annotated[tuple[Coordinate, Coordinate, Coordinate], quantity("m", "x (east), y (north), z (up)")]
Vector3 = Annotated[tuple[float, float, float], quantity("m", "x (east), y (north), z (up)")]
Quaternion = Annotated[
    tuple[float, float, float, float],
    quantity("1", "unit quaternion (w, x, y, z), rotates body axes into world axes"),
]


# Type hints are evaluated anew at each call of `get_type_hints`, and payloads are made in every frame.
@cache
def array_fields(cls: type) -> dict[str, ArrayField]:
    """The array fields of a payload class, by name, in wire order.

    Args:
        cls: A payload class, or a class of an object in one.

    Example:
        >>> from caviar_protocol.topics import Scene
        >>> [*array_fields(Scene)]
        ['position', 'orientation', 'velocity', 'dimensions', 'angular_velocity']
    """
    found: dict[str, ArrayField] = {}
    for name, hint in get_type_hints(cls, include_extras=True).items():
        for candidate in (hint, *(get_args(hint) if get_origin(hint) is not Annotated else ())):
            if get_origin(candidate) is Annotated:
                for meta in get_args(candidate)[1:]:
                    if isinstance(meta, msgspec.Meta) and meta.extra and "array" in meta.extra:
                        found[name] = meta.extra["array"]
    return found


class Payload(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Base of every typed object that may hold arrays.

    On construction, here and after decoding, each array is checked against its declared dtype
    and shape; sizes that share a name must agree. Equality compares arrays element by element.

    Raises:
        PayloadError: An array has another dtype or shape than its field declares, or sizes differ.

    Example:
        >>> from typing import Annotated
        >>> class Rays(Payload, frozen=True, kw_only=True):
        ...     length: Annotated[Float64Array, array("<f8", "N", unit="m", doc="length of each ray")]
        ...     hit: Annotated[BoolArray, array("|b1", "N", unit="1", doc="whether it hits anything")]
        >>> Rays(length=np.ones(3), hit=np.ones(2, bool))
        Traceback (most recent call last):
            ...
        caviar_protocol.errors.PayloadError: Rays.hit has shape (2,), expected ('N',) with N = 3
    """

    sizes_from: ClassVar[dict[str, tuple[str, ...]]] = {}
    """Names of sizes, and the tuple fields that have this length: ``{"N": ("names", "classes")}``."""

    def __post_init__(self) -> None:
        layout = _layout(type(self))
        # Payloads are made a thousand times a second: equal shapes are looked at once.
        shapes: tuple[Any, ...] = ()
        try:
            shapes = (*layout.shapes_of(self), *map(len, layout.listed_of(self)))
            optional = layout.optional_of(self)
            if [values for values in optional if values is not None]:
                shapes += tuple(
                    [values if values is None else (values.dtype, values.shape) for values in optional]
                )
            is_known = layout.dtypes_of(self) == layout.dtypes and shapes in layout.known
        except (AttributeError, TypeError):  # no array, or no length: reported below
            is_known = False
        if not is_known:
            # Raise `PayloadError` naming the first array that is not as declared.
            sizes = {size: self._length(fields) for size, fields in self.sizes_from.items()}
            for name, spec in array_fields(type(self)).items():
                value = getattr(self, name)
                if value is not None:
                    _check_array(type(self).__name__, name, value, spec, sizes)
            # A lidar has another number of hits in every frame: without a bound the set would grow for hours.
            if len(layout.known) >= KNOWN_SHAPES:
                layout.known.clear()
            layout.known.add(shapes)
        self.check()

    def check(self) -> None:  # optional hook
        """Raise `PayloadError` where fields contradict each other beyond what shapes say."""

    def _length(self, fields: tuple[str, ...]) -> int:
        lengths = {len(getattr(self, field)) for field in fields}
        if len(lengths) > 1:
            stated = ", ".join(f"{field} {len(getattr(self, field))}" for field in fields)
            raise PayloadError(f"{type(self).__name__} has fields of different length: {stated}")
        return lengths.pop()

    def __eq__(self, other: object) -> bool:
        if type(self) is not type(other):
            return NotImplemented
        return all(_equal(getattr(self, f), getattr(other, f)) for f in self.__struct_fields__)

    # Without this line `msgspec.Struct` gives frozen classes a hash of their fields.
    __hash__ = None  # type: ignore[assignment]  # arrays are not hashable, so neither is their owner


KNOWN_SHAPES = 256
"""Combinations of shapes of one class that are remembered at most."""


@dataclass(frozen=True)
class _Layout:
    """Layout of a payload class, for a quick look at one of its objects."""

    dtypes_of: Callable[[Any], tuple[Any, ...]]
    """Element types of the arrays that every object has, and ``shapes_of`` their shapes."""
    shapes_of: Callable[[Any], tuple[Any, ...]]
    dtypes: tuple[np.dtype[Any], ...]
    """As declared."""
    listed_of: Callable[[Any], tuple[Any, ...]]
    """Tuple fields whose lengths are sizes."""
    optional_of: Callable[[Any], tuple[Any, ...]]
    """Arrays that may be None."""
    known: set[tuple[Any, ...]]
    """Shapes and lengths that were seen to agree."""


@cache
def _layout(cls: type[Payload]) -> _Layout:
    fields = array_fields(cls)
    optional = {f.name for f in msgspec.structs.fields(cls) if f.name in fields and not f.required}
    required = tuple(name for name in fields if name not in optional)
    return _Layout(
        dtypes_of=attributes([f"{name}.dtype" for name in required]),
        shapes_of=attributes([f"{name}.shape" for name in required]),
        dtypes=tuple(WIRE_DTYPES[fields[name].dtype] for name in required),
        listed_of=attributes([field for names in cls.sizes_from.values() for field in names]),
        optional_of=attributes([name for name in fields if name in optional]),
        known=set(),
    )


def attributes(paths: Sequence[str]) -> Callable[[Any], tuple[Any, ...]]:
    """Getter of these attributes, all at once."""
    if len(paths) > 1:
        return attrgetter(*paths)
    if not paths:
        return lambda owner: ()
    # With one name `attrgetter` gives the bare value and not a tuple.
    single = attrgetter(*paths)
    return lambda owner: (single(owner),)


def _equal(a: Any, b: Any) -> bool:
    # `==` of arrays is an array, and of different dtypes may hold: bytes on the wire would differ.
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return (
            isinstance(a, np.ndarray)
            and isinstance(b, np.ndarray)
            and a.dtype == b.dtype
            and np.array_equal(a, b)
        )
    return bool(a == b)


def _check_array(owner: str, name: str, value: Any, spec: ArrayField, sizes: dict[str, int]) -> None:
    if not isinstance(value, np.ndarray):
        raise PayloadError(f"{owner}.{name} is {type(value).__name__}, expected a NumPy array")
    if value.dtype != WIRE_DTYPES[spec.dtype]:
        raise PayloadError(f"{owner}.{name} has dtype {value.dtype.str}, expected {spec.dtype}")
    if value.ndim != len(spec.shape):
        raise PayloadError(
            f"{owner}.{name} has {value.ndim} dimensions, expected {len(spec.shape)}: {spec.shape}"
        )
    for size, expected in zip(value.shape, spec.shape, strict=True):
        wanted = sizes.setdefault(expected, size) if isinstance(expected, str) else expected
        if size != wanted:
            raise PayloadError(
                f"{owner}.{name} has shape {value.shape}, expected {spec.shape} with {expected} = {wanted}"
            )


def require_finite(payload: msgspec.Struct, path: str = "") -> None:
    """Check that a payload has no number that is not finite (contract, clause 21).

    Args:
        payload: Payload, or an object in one.
        path: What the error calls it; by default the name of its class.

    Raises:
        PayloadError: It holds a NaN or an infinity; the text names the field and the element.

    Example:
        >>> from caviar_protocol.topics import WaypointCommand
        >>> require_finite(WaypointCommand(object="uav", position=(0.0, 1.0, 3.0), speed=2.0))
        >>> try:
        ...     require_finite(WaypointCommand(object="uav", position=(0.0, math.nan, 3.0), speed=2.0))
        ... except PayloadError as error:
        ...     print(error)
        WaypointCommand.position[1] is nan: non-finite values may not leave a service
    """
    path = path or type(payload).__name__
    for name in payload.__struct_fields__:
        _require_finite(getattr(payload, name), f"{path}.{name}")


def _require_finite(value: Any, path: str) -> None:
    if isinstance(value, np.ndarray):
        # Integers and flags are always finite, and `isfinite` of a camera image would cost its size.
        if value.dtype.kind in "fc" and not np.isfinite(value).all():
            bad = np.argwhere(~np.isfinite(value))[0].tolist()
            raise PayloadError(
                f"{path}{bad} is {value[tuple(bad)]}: non-finite values may not leave a service"
            )
    elif isinstance(value, float):
        if not math.isfinite(value):
            raise PayloadError(f"{path} is {value}: non-finite values may not leave a service")
    elif isinstance(value, msgspec.Struct):
        require_finite(value, path)
    # Payloads hold tuples only, never lists: they are immutable and compare by value.
    elif isinstance(value, tuple):
        for index, item in enumerate(value):
            _require_finite(item, f"{path}[{index}]")
