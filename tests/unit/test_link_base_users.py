"""Users of a frame, the directions between devices, and their channels."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from link_builders import CARRIER, antenna, channel_of, random_h, scene_of

from caviar_protocol.errors import PayloadError
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.space.coordinates import angles
from caviar_protocol.space.scene import directions, pairs_of
from caviar_protocol.topics import AntennaDevice, Carrier, Channel
from caviar_services.channel.statistical.free_space import FreeSpaceChannel, FreeSpaceSettings
from caviar_services.link.base import channels_of, users_of
from caviar_services.link.beam_scores import sweep_users
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo

BS = antenna("bs", "tx", (1, 4))
CAR = antenna("car/rx", "rx", (1, 2), (10.0, 0.0, 0.0))


def test_users_are_carriers_then_tx_then_rx_and_no_device_serves_itself() -> None:
    scene = scene_of(antenna("b", "tx"), antenna("a", "both"), antenna("r", "rx", position=(5.0, 0.0, 0.0)))
    high, low = Carrier(name="z", frequency_hz=60e9), Carrier(name="a", frequency_hz=28e9)
    assert [(p.tx.name, p.rx.name) for p in pairs_of(scene)] == [("a", "r"), ("b", "a"), ("b", "r")]
    assert [(u.carrier.name, u.tx.name, u.rx.name) for u in users_of(scene, (high, low))] == [
        (carrier, tx, rx) for carrier in "za" for tx, rx in (("a", "r"), ("b", "a"), ("b", "r"))
    ]


def test_directions_turn_with_the_device_and_with_the_object_it_is_mounted_on() -> None:
    """A car at north-east of the BS heading 60°, its array turned 25° more; the BS looks at 10°."""
    heading, mount = math.radians(60), math.radians(25)
    bs = antenna("bs", "tx", yaw=math.radians(10))
    on_car = antenna("car/rx", "rx", yaw=mount, parent="car")
    scene = scene_of(bs, on_car, objects={"car": ((30.0, 30.0, 0.0), heading)})
    at_tx, at_rx = directions(scene, pairs_of(scene))
    assert angles(np.array(at_tx))[0, 1] == pytest.approx(math.radians(45 - 10))
    assert angles(np.array(at_rx))[0, 1] == pytest.approx(math.radians(-135 - 60 - 25 + 360))


def test_directions_keep_their_height() -> None:
    scene = scene_of(
        antenna("bs", "tx", position=(0.0, 0.0, 30.0)), antenna("r", "rx", position=(0.0, 40.0, 0.0))
    )
    at_tx, at_rx = directions(scene, pairs_of(scene))
    np.testing.assert_allclose(at_tx, [(0, 0.8, -0.6)], atol=1e-15)
    np.testing.assert_allclose(at_rx, [(0, -0.8, 0.6)], atol=1e-15)


def test_devices_at_one_point_see_each_other_at_boresight() -> None:
    scene = scene_of(antenna("t", "tx"), antenna("r", "rx", yaw=1.0))
    at_tx, at_rx = directions(scene, pairs_of(scene))
    np.testing.assert_array_equal(at_tx, [(1, 0, 0)])
    np.testing.assert_array_equal(at_rx, [(1, 0, 0)])


def test_a_held_channel_does_not_cover_a_device_that_came_later() -> None:
    scene = scene_of(BS, CAR, antenna("new/rx", "rx", position=(0.0, 9.0, 0.0)))
    channel = channel_of(("bs",), ("car/rx", "gone/rx"), {("mmwave", "bs", "car/rx"): random_h(1, 2, 4)})
    found = channels_of(channel, users_of(scene, channel.carriers))
    assert found.unknown == 1
    assert found.has_path.tolist() == [True, False]
    assert found.h[1] is None


def test_a_path_of_amplitude_zero_on_a_carrier_is_no_path_there() -> None:
    """One path, that the second carrier does not see."""
    carriers = (CARRIER, Carrier(name="thz", frequency_hz=140e9))
    channel = channel_of(("bs",), ("car/rx",), {("mmwave", "bs", "car/rx"): random_h(1, 2, 4)}, carriers)
    found = channels_of(channel, users_of(scene_of(BS, CAR), carriers))
    assert found.has_path.tolist() == [True, False]
    assert found.los.tolist() == [True, True]


def test_a_channel_without_h_is_refused_naming_the_user_and_the_part() -> None:
    channel = channel_of(("bs",), ("car/rx",), {("mmwave", "bs", "car/rx"): random_h(1, 2, 4)}, with_h=False)
    with pytest.raises(PayloadError, match=r"bs → car/rx on mmwave.*'h'"):
        channels_of(channel, users_of(scene_of(BS, CAR), channel.carriers))


def test_an_h_that_does_not_fit_the_arrays_is_refused_with_both_shapes() -> None:
    channel = channel_of(("bs",), ("car/rx",), {("mmwave", "bs", "car/rx"): random_h(1, 4, 2)})
    with pytest.raises(PayloadError, match=r"bs → car/rx.*\(4, 2\).*\(2, 4\)"):
        channels_of(channel, users_of(scene_of(BS, CAR), channel.carriers))


def test_users_with_different_arrays_are_swept_in_their_own_shapes_and_order() -> None:
    """Batches of equal arrays do not mix up whose sweep is whose."""
    devices = [antenna(f"r{i}", "rx", (1, 1 + i % 2), (5.0 + i, 0.0, 0.0)) for i in range(4)]
    users = users_of(scene_of(BS, *devices), (CARRIER,))
    h = [random_h(i, 1 + i % 2, 4) for i in range(3)]
    groups = sweep_users(users, [*h, None])
    swept = {u: abs_y for group in groups for u, abs_y in zip(group.users, group.abs_y, strict=True)}
    assert {u: abs_y.shape for u, abs_y in swept.items()} == {0: (4, 1), 1: (4, 2), 2: (4, 1)}
    for u, matrix in enumerate(h):
        abs_y = swept[u]
        assert np.sum(abs_y**2) == pytest.approx(np.sum(np.abs(matrix) ** 2))


def test_devices_that_name_carriers_are_users_on_those_alone() -> None:
    """Two stations at one carrier each, a receiver with both, one with the higher alone."""
    low, high = Carrier(name="low", frequency_hz=3.5e9), Carrier(name="high", frequency_hz=28e9)

    def on(device: AntennaDevice, *carriers: str) -> AntennaDevice:
        return msgspec.structs.replace(device, carriers=carriers)

    scene = scene_of(
        on(antenna("lamp", "tx"), "high"),
        on(antenna("macro", "tx", position=(0.0, 50.0, 0.0)), "low"),
        antenna("both", "rx", position=(30.0, 0.0, 0.0)),
        on(antenna("mm", "rx", position=(40.0, 0.0, 0.0)), "high"),
    )
    assert [(p.tx.name, p.rx.name) for p in pairs_of(scene)] == [
        ("lamp", "both"), ("lamp", "mm"), ("macro", "both")
    ]  # fmt: skip
    users = users_of(scene, (low, high))
    expected = ["macro → both on low", "lamp → both on high", "lamp → mm on high"]
    assert [str(user) for user in users] == expected
    model = FreeSpaceChannel(FreeSpaceSettings(), RunInfo(name="channel", carriers=(low, high)))
    model.prepare(Preparation(demand={"channel": frozenset({"h"})}))
    entry = GrantInput(topic="scene", source="world", status=Status.FRESH, frame=0)
    frame = Frame(episode=0, number=0, t_ns=0, inputs=(FrameInput(entry, payload=scene),), service="channel")
    result = model.step(frame)
    channel = result.products["channel"]
    assert isinstance(channel, Channel)
    # Pairs: lamp–both, lamp–mm, macro–both, macro–mm; the last has no carrier in common.
    assert channel.offsets.tolist() == [0, 1, 2, 3, 3]
    assert (channel.a != 0).tolist() == [[False, False, True], [True, True, False]]
    assert [(m.carrier, m.tx, m.rx) for m in channel.h] == [(0, 1, 0), (1, 0, 0), (1, 0, 1)]
    assert channels_of(channel, users).has_path.all()
    assert not any(name.startswith("no-path") for name in result.counts)
