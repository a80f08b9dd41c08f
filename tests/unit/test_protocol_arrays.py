"""What payload classes demand of their arrays, and how arrays lie in a body."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from typing_extensions import TypeAliasType, TypeVar

from caviar_protocol.arrays import (
    MAX_DIMENSIONS,
    WIRE_DTYPES,
    Float64Array,
    Int32Array,
    Payload,
    array,
    array_fields,
    quantity,
    require_finite,
)
from caviar_protocol.codec.payloads import BodyReader, BodyWriter, plain
from caviar_protocol.errors import DecodeError, LimitError, PayloadError, ProtocolError
from caviar_protocol.fields import MAX_BODY


class Inner(Payload, frozen=True, kw_only=True, omit_defaults=True):
    """A payload inside a payload."""

    x: Annotated[Float64Array, array("<f8", "N", unit="m", doc="x")]


_Scalar = TypeVar("_Scalar", bound=np.generic)
AliasedArray = TypeAliasType(
    "AliasedArray", np.ndarray[tuple[Any, ...], np.dtype[_Scalar]], type_params=(_Scalar,)
)
"""What `numpy.typing.NDArray` is from NumPy 2.5 on, on any version of Python."""
AliasedNumber = TypeAliasType("AliasedNumber", float)


class Aliased(Payload, frozen=True, kw_only=True, omit_defaults=True):
    """A payload whose fields are declared by aliases."""

    p: Annotated[AliasedArray[np.float64], array("<f8", "N", unit="m", doc="positions")]
    k: Annotated[AliasedArray[np.int32], array("<i4", "K", unit="1", doc="indices")] | None = None
    scale: AliasedNumber = 1.0


class Point(msgspec.Struct, frozen=True, kw_only=True):
    """A struct that is no payload."""

    at: tuple[float, float]


class Sample(Payload, frozen=True, kw_only=True, omit_defaults=True):
    """A payload with a shared size, a fixed one and an optional array."""

    sizes_from: ClassVar[dict[str, tuple[str, ...]]] = {"N": ("names", "labels")}

    names: tuple[str, ...]
    labels: tuple[str, ...] = ()
    p: Annotated[Float64Array, array("<f8", "N", 3, unit="m", doc="positions")]
    k: Annotated[Int32Array, array("<i4", "N", "K", unit="1", doc="indices")] | None = None
    inner: tuple[Inner, ...] = ()
    points: tuple[Point, ...] = ()
    scale: Annotated[float, quantity("1", "scale")] = 1.0


def sample(n: int = 2, **changed: Any) -> Sample:
    """A sample that is right, but for what is changed."""
    fields: dict[str, Any] = {"names": ("a",) * n, "labels": ("b",) * n, "p": np.zeros((n, 3))}
    return Sample(**fields | changed)


# --- declarations ---------------------------------------------------------------------------------


def test_array_fields_are_found_in_order_also_where_optional() -> None:
    assert {name: spec.shape for name, spec in array_fields(Sample).items()} == {
        "p": ("N", 3),
        "k": ("N", "K"),
    }


def test_an_element_type_that_cannot_travel_is_refused_at_declaration() -> None:
    with pytest.raises(ValueError, match="'<f2' cannot travel"):
        array("<f2", "N", unit="1", doc="half floats")


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"p": [[0.0] * 3] * 2}, "Sample.p is list, expected a NumPy array"),
        ({"p": np.zeros((2, 3), np.float32)}, "Sample.p has dtype <f4, expected <f8"),
        ({"p": np.zeros((2, 3), ">f8")}, "Sample.p has dtype >f8, expected <f8"),
        ({"p": np.zeros(6)}, "Sample.p has 1 dimensions, expected 2"),
        ({"p": np.zeros((2, 4))}, r"Sample.p has shape \(2, 4\)"),
        ({"p": np.zeros((3, 3))}, "with N = 2"),
        ({"k": np.zeros((3, 5), np.int32)}, "Sample.k has shape"),
        ({"labels": ("b",)}, "fields of different length: names 2, labels 1"),
    ],
)
def test_an_array_that_breaks_its_promise_is_named(changed: dict[str, Any], message: str) -> None:
    with pytest.raises(PayloadError, match=message):
        sample(**changed)


def test_sizes_are_bound_in_each_object_by_itself() -> None:
    """Two matrices in one product may have different sizes under one name."""
    both = sample(inner=(Inner(x=np.zeros(1)), Inner(x=np.zeros(7))))
    assert [len(item.x) for item in both.inner] == [1, 7]


def test_payloads_are_equal_where_every_element_is() -> None:
    assert sample() == sample()
    other = np.zeros((2, 3))
    other[1, 2] = 1e-300
    assert sample() != sample(p=other)
    assert sample() != sample(k=np.zeros((2, 0), np.int32))
    assert sample() != "sample"


@given(st.integers(0, 1), st.integers(0, 2), st.sampled_from([np.nan, np.inf, -np.inf]))
def test_require_finite_names_the_element(row: int, column: int, bad: float) -> None:
    p = np.zeros((2, 3))
    require_finite(sample(p=p))
    p[row, column] = bad
    with pytest.raises(PayloadError, match=rf"Sample\.p\[{row}, {column}\] is {bad}"):
        require_finite(sample(p=p))


@pytest.mark.parametrize(
    ("changed", "path"),
    [
        ({"scale": float("nan")}, r"Sample\.scale"),
        ({"inner": (Inner(x=np.zeros(1)), Inner(x=np.array([0.0, np.inf])))}, r"Sample\.inner\[1\]\.x\[1\]"),
        ({"points": (Point(at=(0.0, float("inf"))),)}, r"Sample\.points\[0\]\.at\[1\]"),
    ],
)
def test_require_finite_looks_into_everything(changed: dict[str, Any], path: str) -> None:
    with pytest.raises(PayloadError, match=path):
        require_finite(sample(**changed))


# --- bodies ---------------------------------------------------------------------------------------

ARRAYS = st.sampled_from(sorted(WIRE_DTYPES)).flatmap(
    lambda code: npst.arrays(
        WIRE_DTYPES[code], npst.array_shapes(min_dims=0, max_dims=MAX_DIMENSIONS, min_side=0, max_side=3)
    )
)


@given(st.lists(ARRAYS, max_size=5))
def test_arrays_of_every_type_and_shape_come_back(arrays: list[Any]) -> None:
    """Also those without an element or a dimension, and NaN bit by bit."""
    writer = BodyWriter()
    references = [writer.place(array) | {"shape": list(array.shape)} for array in arrays]
    body = writer.body()
    assert len(body) == writer.length
    reader = BodyReader(memoryview(body).toreadonly())
    for sent, reference in zip(arrays, references, strict=True):
        came = reader.read(reference)
        assert (came.dtype, came.shape, came.tobytes()) == (sent.dtype, sent.shape, sent.tobytes())
        assert not came.flags.writeable


@given(st.binary(max_size=64), st.lists(st.integers(-2, 5), max_size=8), st.integers(-16, 80))
def test_a_reference_is_served_from_within_the_body_or_refused(
    body: bytes, shape: list[int], offset: int
) -> None:
    for code in WIRE_DTYPES:
        try:
            taken = BodyReader(memoryview(body)).read({"dtype": code, "shape": shape, "offset": offset})
        except ProtocolError:
            continue
        assert offset % 8 == 0
        assert taken.shape == tuple(shape)
        assert taken.tobytes() == body[offset : offset + taken.nbytes]


@pytest.mark.parametrize(
    "reference",
    [
        None,
        7,
        "<f8",
        [],
        {},
        {"dtype": "<f8", "shape": [1]},
        {"dtype": 8, "shape": [1], "offset": 0},
        {"dtype": ["<f8"], "shape": [1], "offset": 0},
        {"dtype": "<f8", "shape": 1, "offset": 0},
        {"dtype": "<f8", "shape": ["1"], "offset": 0},
        {"dtype": "<f8", "shape": [True], "offset": 0},
        {"dtype": "<f8", "shape": [1.0], "offset": 0},
        {"dtype": "<f8", "shape": [1], "offset": 0.0},
        {"dtype": "<f8", "shape": [1], "offset": False},
        {"dtype": "<f8", "shape": [0, MAX_BODY, MAX_BODY], "offset": 0},
    ],
    ids=repr,
)
def test_what_is_no_reference_is_refused(reference: Any) -> None:
    with pytest.raises(DecodeError):
        BodyReader(memoryview(bytes(8))).read(reference)


def test_an_array_after_the_one_before_is_served_and_one_that_overlaps_is_not() -> None:
    def take(*offsets: int) -> None:
        reader = BodyReader(memoryview(bytes(32)))
        for offset in offsets:
            reader.read({"dtype": "<f8", "shape": [1], "offset": offset})

    take(0, 8, 24)
    for wrong in ((0, 0), (8, 0), (24, 16)):
        with pytest.raises(DecodeError, match="overlaps"):
            take(*wrong)


def test_a_writer_refuses_what_no_reader_accepts() -> None:
    with pytest.raises(PayloadError, match="dtype <f2"):
        BodyWriter().place(np.zeros(1, np.float16))
    with pytest.raises(PayloadError, match="7 dimensions"):
        BodyWriter().place(np.zeros((1,) * 7))
    with pytest.raises(LimitError, match="7 dimensions"):
        BodyReader(memoryview(bytes(8))).read({"dtype": "|u1", "shape": [1] * 7, "offset": 0})


def test_a_body_is_little_endian_wherever_it_is_written() -> None:
    writer = BodyWriter()
    assert writer.place(np.array([1.0], ">f8"))["dtype"] == "<f8"
    assert writer.body() == bytes.fromhex("000000000000f03f")


def test_fields_declared_by_type_aliases_travel_like_the_types_that_they_stand_for() -> None:
    writer = BodyWriter()
    found = plain(Aliased(p=np.arange(2.0), k=np.array([7], np.int32), scale=3.0), writer)
    assert (found["p"]["dtype"], found["k"]["dtype"], found["scale"]) == ("<f8", "<i4", 3.0)
    assert writer.body() == np.arange(2.0).tobytes() + np.array([7], np.int32).tobytes()
