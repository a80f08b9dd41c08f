"""Parts in demand: one that is left out, or of another numerology or array, is refused by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from caviar_protocol.errors import ProductError
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.topics import (
    AntennaArray,
    Carrier,
    Channel,
    ChannelMatrix,
    ChannelResponse,
    ChannelTaps,
    Depth,
    DepthImage,
    Intrinsics,
    Panel,
)
from caviar_protocol.validation import ContentCheck, ContentRules, PartCheck

WIDE = Carrier(name="wide", frequency_hz=28e9, subcarriers=5, subcarrier_spacing_hz=1e5, taps=3, slots=2)
CARRIERS = (Carrier(name="narrow", frequency_hz=3e9), WIDE)
DUAL = AntennaArray(columns=2, polarization="cross", panels=(Panel(), Panel(yaw_deg=90.0)))
SPECS = (
    DeviceSpec(name="bs", kind="antenna", role="both", array=AntennaArray(rows=2, columns=3)),
    DeviceSpec(name="rx", kind="antenna", role="rx", on="car.*", array=DUAL),
)
SIZES = {"bs": 6, "car.1/rx": 8}
TX, RX = ("bs",), ("bs", "car.1/rx")
ALL = frozenset({"h", "hf", "taps"})


def entries(cls: Any, *bins: int, carriers: tuple[int, ...], dtype: str) -> tuple[Any, ...]:
    more = {"first": -2} if cls is ChannelTaps else {}
    return tuple(
        cls(carrier=c, tx=0, rx=r, h=np.zeros((*bins, SIZES[name], 6), dtype), **more)
        for c in carriers
        for r, name in enumerate(RX)
    )


def channel(**changes: Any) -> Channel:
    """One transmitter, which receives too, a car; every part."""
    fields: dict[str, Any] = {
        "rung": "free-space",
        "carriers": CARRIERS,
        "tx": TX,
        "rx": RX,
        "los": np.zeros((1, 2), np.bool_),
        "offsets": np.zeros(3, np.int64),
        "id": np.zeros(0, np.uint64),
        "a": np.zeros((2, 0), np.complex128),
        "tau": np.zeros(0),
        "aod": np.zeros((0, 2)),
        "aoa": np.zeros((0, 2)),
        "doppler": np.zeros((2, 0)),
        "interactions": np.zeros((0, 0), np.uint8),
        "points": np.zeros((0, 0, 3)),
        "objects": np.zeros((0, 0), np.int32),
        "h": entries(ChannelMatrix, carriers=(0, 1), dtype="<c16"),
        "hf": entries(ChannelResponse, 2, 5, carriers=(1,), dtype="<c8"),
        "taps": entries(ChannelTaps, 2, 3, carriers=(1,), dtype="<c8"),
    }
    return Channel(**(fields | changes))


def reshaped(part: str, *shape: int) -> Callable[[], Channel]:
    """The channel with another shape of the last entry of a part."""

    def made() -> Channel:
        *others, last = getattr(channel(), part)
        return channel(**{part: (*others, replace(last, h=np.zeros(shape, last.h.dtype)))})

    return made


RIGHT = channel()
NOT_FINITE = replace(RIGHT.hf[1], h=np.full((2, 5, 8, 6), np.nan, "<c8"))
WRONG: dict[str, tuple[Callable[[], Channel], str]] = {
    "no h": (lambda: channel(h=()), r"part 'h' is in demand .* for bs → car.1/rx on 'narrow'"),
    "no hf": (lambda: channel(hf=()), r"part 'hf' is in demand .* for bs → car.1/rx on 'wide'"),
    "no taps": (lambda: channel(taps=()), "part 'taps' is in demand"),
    "a pair left out": (lambda: channel(hf=RIGHT.hf[:1]), "part 'hf' is in demand .* bs → car.1/rx on"),
    "a subcarrier left out": (
        reshaped("hf", 2, 4, 8, 6),
        r"hf of bs → car.1/rx on 'wide' has shape \(2, 4, 8, 6\), by the scenario it is \(2, 5, 8, 6\): sl",
    ),
    "transposed": (reshaped("hf", 2, 5, 6, 8), r"hf of .* shape \(2, 5, 6, 8\), .* \(2, 5, 8, 6\)"),
    "no slots": (reshaped("taps", 1, 3, 8, 6), r"taps of .* \(1, 3, 8, 6\), .* \(2, 3, 8, 6\): slots × taps"),
    "one polarization": (reshaped("h", 4, 6), r"h of .* on 'wide' .* \(4, 6\), .* \(8, 6\): RX elements"),
    "of no carrier with subcarriers": (lambda: channel(hf=(replace(RIGHT.hf[0], carrier=0), *RIGHT.hf)),
                                       r"hf\[0\] is of carrier, tx and rx \(0, 0, 0\), for which there is"),
    "out of range": (lambda: channel(h=(*RIGHT.h, replace(RIGHT.h[0], rx=7))), r"h\[4\] .* \(0, 0, 7\)"),
    "out of order": (lambda: channel(hf=RIGHT.hf[::-1]), r"hf\[1\] is of bs → bs on 'wide', after bs → car"),
    "twice": (lambda: channel(hf=(*RIGHT.hf, RIGHT.hf[1])), r"hf\[2\] is of bs → car.1/rx on 'wide', after"),
    "other carriers": (lambda: channel(carriers=CARRIERS[::-1]), r"\['wide', 'narrow'\], by the scenario"),
    "not finite": (lambda: channel(hf=(RIGHT.hf[0], NOT_FINITE)), r"hf\[1\]: ChannelResponse.h\[0, 0, "),
}  # fmt: skip


def checked(payload: Channel, demand: frozenset[str] = ALL) -> None:
    rules = ContentRules(devices={"world": SPECS}, carriers=CARRIERS, parts={"channel": demand})
    check = ContentCheck(rules)
    check(GrantInput(topic="channel", source="rays", status=Status.FRESH, frame=0), payload)


@pytest.mark.parametrize("wrong", WRONG)
def test_a_part_that_is_not_as_asked_for_is_refused_and_its_source_named(wrong: str) -> None:
    make, words = WRONG[wrong]
    with pytest.raises(ProductError, match=f"^channel of 'rays', frame 0: .*{words}") as caught:
        checked(make())
    assert caught.value.source == "rays"


def test_right_parts_pass_and_a_device_needs_no_channel_to_itself() -> None:
    checked(RIGHT)
    checked(channel(h=RIGHT.h[1::2], hf=RIGHT.hf[1:], taps=RIGHT.taps[1:]))
    checked(channel(h=(), hf=(), taps=()), frozenset())


def test_a_part_that_no_carrier_has_is_empty() -> None:
    narrow = CARRIERS[:1]
    made = channel(carriers=narrow, h=RIGHT.h[:2], hf=(), taps=(), a=RIGHT.a[:1], doppler=RIGHT.doppler[:1])
    rules = ContentRules(devices={"world": SPECS}, carriers=narrow, parts={"channel": ALL})
    ContentCheck(rules)(GrantInput(topic="channel", source="rays", status=Status.FRESH, frame=0), made)


def test_what_is_not_known_of_the_scenario_is_not_compared() -> None:
    check = PartCheck({"channel": ALL})
    assert check("channel", reshaped("h", 1, 1)()) == ""
    assert "part 'hf' is in demand" in check("channel", channel(hf=()))


def test_what_one_consumer_of_a_process_asks_for_stays_asked_for() -> None:
    check = ContentCheck()
    check.adopt(ContentRules(parts={"channel": frozenset({"hf"})}))
    check.adopt(ContentRules(parts={"channel": frozenset({"h"}), "lidar": frozenset()}))
    with pytest.raises(ProductError, match="'hf'"):
        check(GrantInput(topic="channel", source="rays", status=Status.FRESH, frame=0), channel(hf=()))


def test_an_image_without_normals_is_refused_where_they_are_in_demand() -> None:
    image = DepthImage(
        sensor="eye",
        intrinsics=Intrinsics(fx=1.0, fy=1.0, cx=1.0, cy=1.0),
        position=(0.0, 0.0, 0.0),
        orientation=(1.0, 0.0, 0.0, 0.0),
        depth=np.ones((2, 2), "<f4"),
    )
    asked = PartCheck({"depth": frozenset({"normals"})})
    assert asked("depth", Depth(images=(image,))).startswith("part 'normals' is in demand")
    whole = replace(image, normals=np.ones((2, 2, 3), "<f4"))
    assert asked("depth", Depth(images=(whole,))) == ""
    assert PartCheck({})("depth", Depth(images=(image,))) == ""
