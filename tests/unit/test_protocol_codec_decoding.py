"""A value that is none of the possible ones is refused with those that are."""

from __future__ import annotations

from typing import Any

import msgpack
import pytest

from caviar_protocol.codec import decode_message, decode_payload
from caviar_protocol.errors import DecodeError

HELLO = {"type": "HELLO", "version": [1, 0], "name": "mine", "role": "agent"}
GRANT = {"type": "GRANT", "epoch": 1, "attempt": 1, "episode": 0, "frame": 0, "t_ns": 0}
ANTENNA = {"type": "antenna", "name": "bs", "role": "tx"}


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        (HELLO | {"role": "worldd"}, "write one of agent, channel, link, observer, recorder, sensors, world"),
        (HELLO | {"type": "HELO"}, "write one of HELLO, WELCOME, REFUSE"),
        (
            GRANT | {"inputs": [{"topic": "scene", "source": "city", "status": "new"}]},
            "write one of fresh, held, absent, late",
        ),
    ],
)
def test_a_word_of_a_message_that_is_not_possible(fields: dict[str, Any], told: str) -> None:
    with pytest.raises(DecodeError, match=told):
        decode_message(msgpack.packb(fields))


@pytest.mark.parametrize(
    ("device", "told"),
    [
        (ANTENNA | {"type": "radar"}, "write one of antenna, lidar, camera"),
        (ANTENNA | {"role": "receiver"}, "write one of both, rx, tx"),
        (ANTENNA | {"array": {"pattern": "isotropic"}}, "write one of dipole, hw_dipole, iso, tr38901"),
    ],
)
def test_a_word_inside_a_payload_that_is_not_possible(device: dict[str, Any], told: str) -> None:
    scene: dict[str, Any] = {"names": [], "classes": [], "assets": []}
    for name, columns in (("position", 3), ("orientation", 4), ("velocity", 3), ("dimensions", 3)):
        scene[name] = {"dtype": "<f8", "shape": [0, columns], "offset": 0}
    with pytest.raises(DecodeError, match=told):
        decode_payload("scene", msgpack.packb(scene | {"devices": [ANTENNA, device]}), b"")


def test_an_error_of_another_kind_names_no_words() -> None:
    with pytest.raises(DecodeError) as error:
        decode_message(msgpack.packb(HELLO | {"role": 7}))
    assert "write one of" not in str(error.value)


def test_an_empty_delimiter_in_front_of_the_header_is_called_so() -> None:
    with pytest.raises(DecodeError, match=r"first part is empty.*REQ"):
        decode_message(b"")
