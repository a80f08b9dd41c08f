"""The byte vectors of the protocol, and what their JSON says they mean."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from caviar_protocol.arrays import WIRE_DTYPES

FOLDER = Path(__file__).resolve().parents[2] / "protocol" / "vectors"


@dataclass(frozen=True)
class Vector:
    """One vector: its JSON and its bytes."""

    name: str
    stated: dict[str, Any]
    header: bytes
    body: bytes

    @property
    def refused(self) -> str | None:
        """Error code with which a reader refuses it."""
        return self.stated.get("refused")

    @property
    def canonical(self) -> bool:
        """Whether these are the bytes that a writer writes."""
        return self.refused is None and not self.stated.get("tolerated", False)

    @property
    def means(self) -> Any:
        """What a reader takes it for."""
        return self.stated["means"] if "means" in self.stated else self.stated["value"]

    @property
    def parts(self) -> list[bytes]:
        """Header and further parts, where it is a message."""
        further = [bytes.fromhex(part) for part in self.stated.get("parts", [])]
        further += [bytes(length) for length in self.stated.get("lengths", [])]
        if "product" in self.stated:
            product = load(self.stated["product"])
            further += [product.header, product.body]
        return [self.header, *further]


def load(name: str) -> Vector:
    """One vector by name."""
    source = FOLDER / f"{name}.json"
    body = source.with_suffix(".body")
    return Vector(
        name,
        json.loads(source.read_text("utf-8")),
        source.with_suffix(".msgpack").read_bytes(),
        body.read_bytes() if body.exists() else b"",
    )


def all_vectors(kind: str = "") -> list[Vector]:
    """All vectors, or those of one kind: ``message``, ``payload``, ``arrays``."""
    found = [load(path.stem) for path in sorted(FOLDER.glob("*.json"))]
    return [vector for vector in found if kind in ("", vector.stated["kind"])]


def named(vector: Vector) -> str:
    """Id of a parametrised test."""
    return vector.name


def is_array(value: Any) -> bool:
    """Whether JSON states an array with its elements."""
    return isinstance(value, dict) and "values" in value


def array_of(value: dict[str, Any]) -> np.ndarray[Any, Any]:
    """The NumPy array that JSON states."""
    dtype = WIRE_DTYPES[value["dtype"]]
    if dtype.kind == "c":
        part = np.dtype(f"<f{dtype.itemsize // 2}")
        pairs = np.array(value["values"], dtype=part).reshape(*value["shape"], 2)
        return np.ascontiguousarray(pairs).view(dtype)[..., 0]
    return np.array(value["values"], dtype=dtype).reshape(value["shape"])


def assert_means(typed: Any, stated: Any, path: str) -> None:
    """Compare a decoded object with its JSON: fields that JSON leaves out have their default."""
    if is_array(stated):
        expected = array_of(stated)
        assert typed.dtype == expected.dtype, path
        assert typed.shape == expected.shape, path
        assert typed.tobytes() == expected.tobytes(), path
    elif isinstance(typed, msgspec.Struct):
        config = typed.__struct_config__
        if config.tag_field:
            assert stated[config.tag_field] == config.tag, path
        assert set(stated) <= {*typed.__struct_fields__, config.tag_field}, path
        for field in msgspec.structs.fields(typed):
            value = getattr(typed, field.name)
            if field.name in stated:
                assert_means(value, stated[field.name], f"{path}.{field.name}")
            else:
                default = field.default if field.default_factory is msgspec.NODEFAULT else {}
                assert value == default, f"{path}.{field.name}"
    elif isinstance(stated, dict):
        assert list(typed) == list(stated), path
        for key, value in stated.items():
            assert_means(typed[key], value, f"{path}.{key}")
    elif isinstance(stated, list):
        assert len(typed) == len(stated), path
        for index, (item, value) in enumerate(zip(typed, stated, strict=True)):
            assert_means(item, value, f"{path}[{index}]")
    else:
        assert typed == stated, path
        assert type(stated) is type(typed) or isinstance(typed, str), path
