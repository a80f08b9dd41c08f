"""Messages and payloads come back as they went, in one form, whatever they hold."""

from __future__ import annotations

import threading
from typing import Any, get_args

import msgpack
import msgspec
import numpy as np
import protocol_strategies as ps
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from caviar_protocol.codec import (
    check_parts,
    check_version,
    decode_message,
    decode_payload,
    encode_message,
    encode_payload,
    message_type,
    part_count,
)
from caviar_protocol.errors import DecodeError, LimitError, PayloadError, VersionError
from caviar_protocol.fields import MAX_BODY, MAX_HEADER
from caviar_protocol.messages import (
    PROTOCOL_VERSION,
    AssetData,
    Bye,
    CheckpointDone,
    Done,
    Grant,
    GrantInput,
    Heartbeat,
    Message,
    ProductHeader,
    Restore,
    Status,
    Welcome,
)
from caviar_protocol.topics import (
    PAYLOADS,
    Action,
    AntennaArray,
    AntennaDevice,
    BeamChoice,
    CameraDevice,
    Carrier,
    Channel,
    ChannelOptions,
    LidarDevice,
    Scene,
    WaypointCommand,
)

pytestmark = pytest.mark.slow

DIGEST = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


def scene(*devices: Any) -> Scene:
    """A scene of devices alone."""
    none = np.zeros((0, 3))
    return Scene(
        names=(),
        classes=(),
        assets=(),
        position=none,
        orientation=np.zeros((0, 4)),
        velocity=none,
        dimensions=none,
        devices=devices,
    )


@pytest.mark.parametrize("cls", get_args(Message), ids=lambda cls: cls.__struct_config__.tag)
@settings(max_examples=30)
@given(data=st.data())
def test_a_message_survives_the_wire(cls: type[Message], data: st.DataObject) -> None:
    """Equal when decoded, the same bytes when encoded again, and readable by the msgpack package."""
    message = data.draw(ps.struct(cls))
    header = encode_message(message)
    decoded = decode_message(header)
    assert decoded == message
    assert encode_message(decoded) == header
    plain = msgpack.unpackb(header)
    assert next(iter(plain.items())) == ("type", message_type(message))
    assert set(plain) - {"type"} <= set(cls.__struct_fields__)


@pytest.mark.parametrize("topic", PAYLOADS)
@settings(max_examples=30)
@given(data=st.data())
def test_a_payload_survives_the_wire(topic: str, data: st.DataObject) -> None:
    payload = data.draw(ps.payload(PAYLOADS[topic]))
    header, body = encode_payload(payload)
    decoded = decode_payload(topic, header, body)
    assert decoded == payload
    assert encode_payload(decoded) == (header, body)


@pytest.mark.parametrize("topic", PAYLOADS)
@settings(max_examples=30)
@given(data=st.data())
def test_arrays_lie_aligned_in_field_order_with_zeros_between(topic: str, data: st.DataObject) -> None:
    header, body = encode_payload(data.draw(ps.payload(PAYLOADS[topic])))
    end = 0
    for reference in references(msgpack.unpackb(header)):
        offset, size = reference["offset"], np.dtype(reference["dtype"]).itemsize
        assert offset == -(-end // 8) * 8
        assert body[end:offset] == bytes(offset - end)
        end = offset + int(np.prod(reference["shape"], dtype=int)) * size
    assert len(body) == end


def references(value: Any) -> list[dict[str, Any]]:
    """Array references in a header, in the order in which they stand."""
    if isinstance(value, dict):
        if set(value) == {"dtype", "shape", "offset"}:
            return [value]
        value = list(value.values())
    return [found for item in value for found in references(item)] if isinstance(value, list) else []


# --- one form -------------------------------------------------------------------------------------


def fresh(value: Any) -> Any:
    """An equal object that is another one, as arithmetic or a file gives it."""
    return msgspec.msgpack.decode(msgspec.msgpack.encode(value), type=type(value))


@pytest.mark.parametrize(
    "cls", [AntennaDevice, LidarDevice, CameraDevice], ids=lambda cls: cls.__struct_config__.tag
)
def test_a_default_is_left_out_however_it_was_made(cls: type[msgspec.Struct]) -> None:
    """msgspec alone compares with `is`: an equal float from a computation would be written."""
    required = {"name": "x", "role": "tx"} if cls is AntennaDevice else {"name": "x"}
    defaults = {f.name: f.default for f in msgspec.structs.fields(cls) if not f.required}
    spelled = cls(**required, **{name: fresh(value) for name, value in defaults.items()})
    assert encode_payload(scene(spelled)) == encode_payload(scene(cls(**required)))


def test_nested_defaults_are_left_out_too() -> None:
    given_array = AntennaArray(vertical_spacing=float("0.5"), pattern="".join(["i", "so"]))
    device = AntennaDevice(name="x", role="rx", array=given_array)
    assert encode_payload(scene(device)) == encode_payload(scene(AntennaDevice(name="x", role="rx")))
    assert b"options" not in encode_payload(channel(ChannelOptions()))[0]


def channel(options: ChannelOptions) -> Channel:
    """A channel without devices."""
    return Channel(
        rung="free-space",
        options=options,
        carriers=(Carrier(name="c", frequency_hz=1e9),),
        tx=(),
        rx=(),
        los=np.zeros((0, 0), np.bool_),
        offsets=np.zeros(1, np.int64),
        id=np.zeros(0, np.uint64),
        a=np.zeros((1, 0), np.complex128),
        tau=np.zeros(0),
        aod=np.zeros((0, 2)),
        aoa=np.zeros((0, 2)),
        doppler=np.zeros((1, 0)),
        interactions=np.zeros((0, 0), np.uint8),
        points=np.zeros((0, 0, 3)),
        objects=np.zeros((0, 0), np.int32),
    )


def test_numbers_travel_as_the_type_of_their_field() -> None:
    """Integers where floats are declared and NumPy scalars give the bytes of the plain value."""
    plain = Action(commands=(WaypointCommand(object="uav", position=(1.0, 2.0, 3.0), speed=5.0),))
    mixed = Action(
        commands=(WaypointCommand(object="uav", position=(1, np.float64(2), 3), speed=np.float32(5)),)
    )
    assert encode_payload(mixed) == encode_payload(plain)
    beam = Action(commands=(BeamChoice(tx="a", rx="b", tx_beam=np.int64(7)),))  # type: ignore[arg-type]
    assert encode_payload(beam) == encode_payload(Action(commands=(BeamChoice(tx="a", rx="b", tx_beam=7),)))


def test_the_order_of_a_free_map_does_not_change_the_bytes() -> None:
    one = Done(epoch=1, attempt=1, episode=0, frame=0, counts={"a": 1, "b": 2})
    other = Done(epoch=1, attempt=1, episode=0, frame=0, counts={"b": 2, "a": 1})
    assert encode_message(one) == encode_message(other)


def test_an_array_in_another_memory_order_gives_the_same_bytes() -> None:
    position = np.arange(6.0).reshape(2, 3)
    rows = {"names": ("a", "b"), "classes": ("car",) * 2, "assets": ("", ""), "orientation": np.zeros((2, 4))}
    rest = {"velocity": np.zeros((2, 3)), "dimensions": np.ones((2, 3))}
    straight = Scene(**rows, **rest, position=position)
    turned = Scene(**rows, **rest, position=np.asfortranarray(position))
    spread = Scene(**rows, **rest, position=np.repeat(position, 2, axis=1)[:, ::2])
    assert encode_payload(turned) == encode_payload(straight) == encode_payload(spread)


# --- what may not travel --------------------------------------------------------------------------


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_a_non_finite_scalar_does_not_leave(value: float) -> None:
    """Also inside a device, which is no payload of its own."""
    with pytest.raises(PayloadError, match=r"devices\[0\]\.position\[1\]"):
        encode_payload(scene(CameraDevice(name="x", position=(0.0, value, 0.0))))


def test_a_non_finite_element_does_not_leave_and_is_named() -> None:
    bad = msgspec.structs.replace(channel(ChannelOptions()), doppler=np.zeros((1, 0)))
    encode_payload(bad)
    one = np.zeros((1, 3))
    one[0, 2] = np.nan
    scene_of_one = Scene(
        names=("a",),
        classes=("car",),
        assets=("",),
        position=one,
        orientation=np.zeros((1, 4)),
        velocity=np.zeros((1, 3)),
        dimensions=np.ones((1, 3)),
    )
    with pytest.raises(PayloadError, match=r"Scene\.position\[0, 2\] is nan"):
        encode_payload(scene_of_one)


@pytest.mark.parametrize(
    ("device", "what"),
    [
        (CameraDevice(name=7), "CameraDevice.name = 7"),  # type: ignore[arg-type]
        (CameraDevice(name="x", width="wide"), "CameraDevice.width = 'wide'"),  # type: ignore[arg-type]
        (CameraDevice(name="x", position=(0.0, 0.0)), "CameraDevice.position"),  # type: ignore[arg-type]
        (AntennaDevice(name="x", role="relay"), "AntennaDevice.role = 'relay'"),  # type: ignore[arg-type]
        ("camera", "Scene.devices"),
    ],
)
def test_a_value_of_the_wrong_type_does_not_leave_and_is_named(device: Any, what: str) -> None:
    with pytest.raises(PayloadError, match=what.replace(".", r"\.")):
        encode_payload(scene(device))


def test_text_that_is_no_unicode_does_not_leave() -> None:
    with pytest.raises(PayloadError, match="BYE"):
        encode_message(Bye(epoch=1, attempt=1, reason="\ud800"))
    with pytest.raises(PayloadError, match="Scene"):
        encode_payload(scene(CameraDevice(name="\ud800")))


def test_settings_that_other_languages_lack_do_not_leave() -> None:
    for value in ({1: 2}, b"bytes", {"deep": [object()]}):
        welcome = Welcome(
            version=(1, 0), run="r", epoch=1, attempt=1, heartbeat_ns=1, liveness_ns=1, settings={"x": value}
        )
        with pytest.raises(PayloadError, match=r"WELCOME\.settings\.x"):
            encode_message(welcome)


def test_a_header_that_is_too_large_does_not_leave() -> None:
    with pytest.raises(LimitError, match="BYE header has"):
        encode_message(Bye(epoch=1, attempt=1, reason="x" * MAX_HEADER))
    with pytest.raises(LimitError, match="payload header has"):
        encode_payload(scene(CameraDevice(name="x" * MAX_HEADER)))


# --- parts and versions ---------------------------------------------------------------------------


def grant(*statuses: Status) -> Grant:
    """A GRANT with one input of each status."""
    inputs = tuple(GrantInput(topic="scene", source=f"w{i}", status=s) for i, s in enumerate(statuses))
    return Grant(epoch=1, attempt=1, episode=0, frame=0, t_ns=0, inputs=inputs)


@given(st.lists(st.sampled_from(list(Status)), max_size=6))
def test_a_grant_has_two_parts_for_each_input_that_is_not_absent(statuses: list[Status]) -> None:
    message = grant(*statuses)
    present = len([status for status in statuses if status != "absent"])
    assert part_count(message) == 1 + 2 * present
    check_parts(message, [b""] * (1 + 2 * present))
    for wrong in {0, 1, 2 * present, 2 + 2 * present} - {1 + 2 * present}:
        with pytest.raises(DecodeError, match="GRANT announces"):
            check_parts(message, [b""] * wrong)


def test_a_done_has_two_parts_for_each_product() -> None:
    product = ProductHeader(topic="scene", digest=DIGEST)
    assert part_count(Done(epoch=1, attempt=1, episode=0, frame=0, products=(product,) * 3)) == 7


def test_states_and_assets_have_one_part_and_all_else_none() -> None:
    place = {"epoch": 1, "attempt": 1, "episode": 0, "frame": 0}
    assert part_count(AssetData(digest=DIGEST, offset=0, size=0)) == 2
    assert part_count(Restore(**place)) == part_count(CheckpointDone(**place)) == 2
    assert part_count(Heartbeat(sequence=0)) == 1


class Sized:
    """Stands for a part of some length without holding it."""

    def __init__(self, length: int) -> None:
        self.length = length

    def __len__(self) -> int:
        return self.length


def test_parts_are_measured_before_they_are_used() -> None:
    message = grant(Status.FRESH)
    check_parts(message, [b"", Sized(MAX_HEADER), Sized(MAX_BODY)])
    with pytest.raises(LimitError, match="part 1 of GRANT has 1048577 B"):
        check_parts(message, [b"", Sized(MAX_HEADER + 1), b""])
    with pytest.raises(LimitError, match="part 2 of GRANT"):
        check_parts(message, [b"", b"", Sized(MAX_BODY + 1)])
    restore = Restore(epoch=1, attempt=1, episode=0, frame=0)
    check_parts(restore, [b"", Sized(MAX_BODY)])
    with pytest.raises(LimitError, match="part 1 of RESTORE"):
        check_parts(restore, [b"", Sized(MAX_BODY + 1)])


@given(st.integers(0, 1000), st.integers(0, 1000), st.integers(0, 1000))
def test_a_chunk_stays_within_its_asset(offset: int, length: int, size: int) -> None:
    message = AssetData(digest=DIGEST, offset=offset, size=size)
    if offset + length <= size:
        check_parts(message, [b"", Sized(length)])
    else:
        with pytest.raises(DecodeError, match=f"bytes {offset} to {offset + length} of an asset of {size} B"):
            check_parts(message, [b"", Sized(length)])


@given(st.integers(0, 2**31), st.integers(0, 2**31))
def test_any_minor_version_is_accepted_and_another_major_names_both(major: int, minor: int) -> None:
    if major == PROTOCOL_VERSION[0]:
        check_version((major, minor))
    else:
        own = r"\.".join(map(str, PROTOCOL_VERSION))
        with pytest.raises(VersionError, match=rf"{major}\.{minor}, this side speaks {own}"):
            check_version((major, minor))


def test_a_version_error_is_told_only_of_the_messages_that_open() -> None:
    with pytest.raises(DecodeError) as caught:
        decode_message(msgpack.packb({"type": "BYE", "version": [2, 0]}))
    assert caught.value.code == "malformed"


# --- threads --------------------------------------------------------------------------------------


def test_threads_share_the_codec_without_seeing_each_other() -> None:
    """The heartbeat thread encodes while the main thread decodes; bodies must not be mixed up."""
    wrong: list[str] = []

    def work(number: int) -> None:
        position = np.full((1, 3), float(number))
        mine = Scene(
            names=(f"object {number}",),
            classes=("car",),
            assets=("",),
            position=position,
            orientation=np.full((1, 4), float(number)),
            velocity=position,
            dimensions=position,
        )
        wire = encode_payload(mine)
        for sequence in range(300):
            if decode_payload("scene", *wire) != mine or encode_payload(mine) != wire:
                wrong.append(f"payload of thread {number}")
            beat = Heartbeat(sequence=sequence, phase=str(number))
            if decode_message(encode_message(beat)) != beat:
                wrong.append(f"message of thread {number}")

    threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


def test_what_stands_in_a_field_is_encoded_anew_where_it_is_another() -> None:
    """A tuple of immutable values is encoded once for each object; a list in its place may change."""
    first, second = (BeamChoice(tx="a", rx="b", tx_beam=beam) for beam in (1, 2))
    alike = Action(commands=(first,))
    assert encode_payload(alike) == encode_payload(Action(commands=(first,)))
    assert encode_payload(Action(commands=(second,))) != encode_payload(alike)
    commands = [first]
    changing = Action(commands=commands)  # type: ignore[arg-type]  # as a careless producer does
    before = encode_payload(changing)
    commands[0] = second
    assert before == encode_payload(alike)
    assert encode_payload(changing) == encode_payload(Action(commands=(second,)))
