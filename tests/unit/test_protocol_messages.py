"""What the shared field types let through, and that a message cannot be misread."""

from __future__ import annotations

import os.path
from typing import Any, get_args

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from caviar_protocol import fields
from caviar_protocol.fields import MAX_PARTS
from caviar_protocol.messages import Asset, Message, Status

pytestmark = pytest.mark.slow

DIGEST = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
TYPES = get_args(Message)


def accepts(hint: Any, value: Any) -> bool:
    """Whether a field of this type takes a value."""
    try:
        msgspec.convert(value, hint, strict=True)
    except msgspec.ValidationError:
        return False
    return True


def test_every_message_has_a_type_of_its_own_in_capitals() -> None:
    tags = [cls.__struct_config__.tag for cls in TYPES]
    assert len(set(tags)) == len(tags)
    assert all(tag == tag.upper() for tag in tags)


@pytest.mark.parametrize("cls", TYPES, ids=lambda cls: cls.__struct_config__.tag)
def test_a_later_minor_version_can_add_fields(cls: type[msgspec.Struct]) -> None:
    """Unknown fields are ignored, and nothing can be changed once it is made."""
    assert not cls.__struct_config__.forbid_unknown_fields
    assert cls.__struct_config__.frozen
    assert cls.__struct_config__.tag_field == "type"


@pytest.mark.parametrize("cls", TYPES, ids=lambda cls: cls.__struct_config__.tag)
def test_defaults_of_messages_are_singletons(cls: type[msgspec.Struct]) -> None:
    """msgspec leaves out a default by identity; that is exact only where equal means identical."""
    for field in msgspec.structs.fields(cls):
        if field.default is not msgspec.NODEFAULT:
            again = msgspec.msgpack.decode(msgspec.msgpack.encode(field.default))
            assert (tuple(again) if isinstance(again, list) else again) is field.default, field.name


@given(
    st.text(max_size=40) | st.lists(st.sampled_from(["a", "..", ".", "", "\\", "b.ply", "…"])).map("/".join)
)
def test_an_asset_name_that_is_accepted_stays_in_its_folder(name: str) -> None:
    if accepts(fields.AssetName, name):
        path = os.path.normpath(f"/store/{name}")
        assert path == f"/store/{name}", "and is written in one way only"
        assert not any(ord(letter) < 32 for letter in name)


@pytest.mark.parametrize("name", ["scenery/scene.xml", "objects/car.ply", "a", ".hidden", "..a", "ä/ö b.ply"])
def test_ordinary_asset_names_are_accepted(name: str) -> None:
    assert accepts(Asset, {"name": name, "digest": DIGEST, "size": 1})


@pytest.mark.parametrize(
    "name",
    ["", "/a", "a/", "a//b", ".", "..", "../a", "a/..", "a/../b", "./a", "a\\b", "a\0", "a\n", "x" * 256],
)
def test_asset_names_that_lead_elsewhere_are_refused(name: str) -> None:
    assert not accepts(Asset, {"name": name, "digest": DIGEST, "size": 1})


@pytest.mark.parametrize(
    ("hint", "good", "bad"),
    [
        (fields.Digest, [DIGEST], ["", DIGEST[1:], DIGEST + "0", DIGEST.upper(), DIGEST[:-1] + "\n"]),
        (fields.DigestOrNone, [DIGEST, ""], [DIGEST[1:], "\n"]),
        (fields.NewName, ["a", "car.1/antenna", "ä ö", "*"], ["", "a\n", "\x7f", "a\0b", "x" * 129]),
        (fields.Name, ["a"], ["", "x" * 129]),
        (fields.Epoch, [1, 2**63 - 1], [0, -1, 2**63, 1.0, True, "1"]),
        (fields.FrameIndex, [0, 2**63 - 1], [-1, 2**63]),
        (fields.FrameOrNone, [-1, 0], [-2, 2**63]),
        (fields.Nanoseconds, [-1, 0, 2**63 - 1], [2**63, 0.5]),
        (fields.Period, [1], [0, -1]),
        (fields.Version, [[1, 0], [2, 99]], [[1], [1, 0, 0], [-1, 0], "1.0"]),
    ],
    ids=[
        "Digest",
        "DigestOrNone",
        "NewName",
        "Name",
        "Epoch",
        "FrameIndex",
        "FrameOrNone",
        "ns",
        "Period",
        "Version",
    ],
)
def test_shared_types_hold_their_bounds(hint: Any, good: list[Any], bad: list[Any]) -> None:
    assert [value for value in good if not accepts(hint, value)] == []
    assert [value for value in bad if accepts(hint, value)] == []


def test_the_longest_list_of_products_fills_the_largest_message() -> None:
    assert fields.few.max_length is not None
    assert 1 + 2 * fields.few.max_length == MAX_PARTS


def test_statuses_are_words() -> None:
    assert [str(status) for status in Status] == ["fresh", "held", "absent", "late"]
