"""Our codec and the byte vectors: what they mean, how they are written, and what is refused."""

from __future__ import annotations

import subprocess
import sys
from typing import Any, get_args

import msgpack
import msgspec
import pytest
from vector_files import FOLDER, Vector, all_vectors, array_of, assert_means, is_array, load, named

from caviar_protocol.arrays import WIRE_DTYPES, Payload
from caviar_protocol.codec import (
    check_parts,
    check_version,
    decode_message,
    decode_payload,
    encode_message,
    encode_payload,
    message_type,
)
from caviar_protocol.codec.payloads import BodyReader, BodyWriter
from caviar_protocol.digest import payload_digest
from caviar_protocol.errors import ProtocolError
from caviar_protocol.messages import Grant, Hello, Message, Observe
from caviar_protocol.topics import PAYLOADS

VECTORS = all_vectors()
ACCEPTED = [vector for vector in VECTORS if vector.refused is None]
MESSAGES = [vector for vector in ACCEPTED if vector.stated["kind"] == "message"]
PAYLOAD_VECTORS = [vector for vector in ACCEPTED if vector.stated["kind"] == "payload"]


def read(vector: Vector) -> Any:
    """What a careful reader makes of a vector."""
    if vector.stated["kind"] == "message":
        message = decode_message(vector.header)
        if isinstance(message, Hello):
            check_version(message.version)
        check_parts(message, vector.parts)
        return message
    if vector.stated["kind"] == "payload":
        return decode_payload(vector.stated["topic"], vector.header, vector.body)
    reader = BodyReader(memoryview(vector.body).toreadonly())
    return [reader.read(reference) for reference in msgpack.unpackb(vector.header)]


@pytest.mark.parametrize("vector", ACCEPTED, ids=named)
def test_a_vector_means_what_its_json_says(vector: Vector) -> None:
    assert_means(read(vector), vector.means, vector.name)


@pytest.mark.parametrize("vector", [v for v in MESSAGES if v.canonical], ids=named)
def test_a_message_is_encoded_to_the_bytes_of_its_vector(vector: Vector) -> None:
    assert encode_message(decode_message(vector.header)) == vector.header


@pytest.mark.parametrize("vector", [v for v in PAYLOAD_VECTORS if v.canonical], ids=named)
def test_a_payload_is_encoded_to_the_bytes_of_its_vector(vector: Vector) -> None:
    assert encode_payload(read(vector)) == (vector.header, vector.body)


@pytest.mark.parametrize(
    "vector", [v for v in ACCEPTED if v.canonical and v.stated["kind"] == "arrays"], ids=named
)
def test_arrays_are_laid_out_as_in_their_vector(vector: Vector) -> None:
    writer = BodyWriter()
    references = [writer.place(array) for array in read(vector)]
    assert msgpack.packb(references) == vector.header
    assert writer.body() == vector.body


@pytest.mark.parametrize("vector", [v for v in MESSAGES if not v.canonical], ids=named)
def test_what_is_tolerated_is_encoded_in_its_canonical_form(vector: Vector) -> None:
    assert encode_message(read(vector)) == msgpack.packb(vector.means)


@pytest.mark.parametrize("vector", [v for v in VECTORS if v.refused is not None], ids=named)
def test_a_wrong_vector_is_refused_with_its_code(vector: Vector) -> None:
    with pytest.raises(ProtocolError) as caught:
        read(vector)
    assert caught.value.code == vector.refused


@pytest.mark.parametrize("vector", [v for v in ACCEPTED if "value" in v.stated], ids=named)
def test_the_msgpack_package_reads_every_vector(vector: Vector) -> None:
    assert msgpack.unpackb(vector.header) == without_elements(vector.stated["value"])


def without_elements(value: Any) -> Any:
    """JSON as it stands in a header: arrays without their elements."""
    if is_array(value):
        return {key: item for key, item in value.items() if key != "values"}
    if isinstance(value, dict):
        return {key: without_elements(item) for key, item in value.items()}
    return [without_elements(item) for item in value] if isinstance(value, list) else value


def test_the_files_are_what_the_independent_maker_makes() -> None:
    result = subprocess.run(
        [sys.executable, FOLDER / "make.py", "--check"], capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr


def test_the_maker_knows_nothing_of_our_codec() -> None:
    lines = (FOLDER / "make.py").read_text("utf-8").splitlines()
    imported = {line.split()[1] for line in lines if line.startswith(("import ", "from "))}
    assert imported == {"__future__", "json", "struct", "sys", "pathlib", "typing", "msgpack"}


def test_every_digest_in_a_vector_with_a_product_is_that_of_its_parts() -> None:
    checked = 0
    for vector in MESSAGES:
        message = read(vector)
        if "product" in vector.stated:
            entries = message.inputs if isinstance(message, Grant | Observe) else message.products
            assert [e.digest for e in entries] == [payload_digest(*vector.parts[1:3])], vector.name
            checked += 1
    assert checked == 3


# --- completeness ---------------------------------------------------------------------------------


def presence(typed: Any, stated: Any, found: dict[tuple[str, str], set[bool]]) -> None:
    """Note for every optional field below ``typed`` whether the wire had it."""
    if isinstance(typed, msgspec.Struct):
        for field in msgspec.structs.fields(typed):
            here = field.name in stated
            if not field.required:
                found.setdefault((type(typed).__name__, field.name), set()).add(here)
            if here:
                presence(getattr(typed, field.name), stated[field.name], found)
    elif isinstance(typed, tuple) and isinstance(stated, list):
        for item, value in zip(typed, stated, strict=True):
            presence(item, value, found)


def structs_below(cls: type[msgspec.Struct]) -> set[type[msgspec.Struct]]:
    """A struct class and all that stand in its fields."""
    found = {cls}
    queue = [cls]
    while queue:
        for field in msgspec.structs.fields(queue.pop()):
            for inner in classes_in(field.type):
                if inner not in found:
                    found.add(inner)
                    queue.append(inner)
    return found


def classes_in(hint: Any) -> set[type[msgspec.Struct]]:
    """Struct classes that a type hint names."""
    if isinstance(hint, type) and issubclass(hint, msgspec.Struct):
        return {hint}
    return {cls for argument in get_args(hint) for cls in classes_in(argument)}


def test_every_message_and_topic_has_a_vector() -> None:
    types = {message_type(read(vector)) for vector in MESSAGES}
    assert types == {cls.__struct_config__.tag for cls in get_args(Message)}
    assert {vector.stated["topic"] for vector in PAYLOAD_VECTORS} == set(PAYLOADS)


def test_every_optional_field_is_present_in_one_vector_and_absent_in_another() -> None:
    found: dict[tuple[str, str], set[bool]] = {}
    for vector in MESSAGES + PAYLOAD_VECTORS:
        if vector.canonical:
            presence(read(vector), vector.means, found)
    optional = {
        (cls.__name__, field.name)
        for root in (*get_args(Message), *PAYLOADS.values())
        for cls in structs_below(root)
        for field in msgspec.structs.fields(cls)
        if not field.required
    }
    assert set(found) == optional
    assert {field for field, seen in found.items() if seen != {True, False}} == set()


def test_every_element_type_has_a_vector() -> None:
    arrays = [load("arrays_every_type"), load("arrays_complex64")]
    assert {str(array.dtype.str) for vector in arrays for array in read(vector)} == set(WIRE_DTYPES)
    assert array_of({"dtype": "<c16", "shape": [1], "values": [[1.0, -2.0]]})[0] == 1 - 2j


def test_a_decoded_array_cannot_be_written_to() -> None:
    payload = read(load("scene_one_object"))
    assert isinstance(payload, Payload)
    with pytest.raises(ValueError, match="read-only"):
        payload.position[0, 0] = 1.0  # type: ignore[attr-defined]
