"""Channels between keyframes against closed forms, in float64: two rays over the ground, and an edge."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from caviar_labs.interpolation import Interpolation, Keyframe
from caviar_labs.stability.formulas import C, mirrored, spherical_wave
from caviar_labs.stability.lab import Array, Thing, antenna, carriers, scene
from caviar_protocol.errors import PayloadError
from caviar_protocol.space.coordinates import angles
from caviar_protocol.topics import AntennaArray, Channel, ChannelMatrix, Scene

FREQUENCY = 60e9
TX = np.array([3.0, -7.0, 11.0])
GROUND = 0.63
"""Reflection off the ground, the same at every angle."""
UP = np.array([0.0, 0.0, 1.0])
H_S = 0.4


def straight(t: float) -> Array:
    return np.array([12.0 + 17.0 * t, 5.0 - 4.0 * t, 1.5 + 0.8 * t])


def braking(t: float) -> Array:
    return straight(t) - np.array([2.0, 0.5, 0.0]) * t**2


def velocity(way: Callable[[float], Array], t: float) -> Array:
    return (way(t + 1e-6) - way(t - 1e-6)) / 2e-6


def images(position: Array) -> list[Array]:
    """From TX to RX and to its image below the ground."""
    return [position - TX, mirrored(position, np.zeros(3), UP) - TX]


def two_rays(position: Array, moves: Array, ids: tuple[int, ...] = (7, 4)) -> Channel:
    """The straight path and that off the ground; those with an id, in the order of the product."""
    mirror = np.diag([1.0, 1.0, -1.0])
    to_end = images(position)[: len(ids)]
    tau = np.array([np.linalg.norm(vector) for vector in to_end]) / C
    a = np.array([spherical_wave(float(C * t), FREQUENCY) for t in tau]) * [1.0, -GROUND][: len(ids)]
    rate = np.array(
        [v @ m / np.linalg.norm(v) for v, m in zip(to_end, (moves, mirror @ moves), strict=False)]
    )
    back = np.array([-to_end[0], -mirror @ to_end[-1]])[: len(ids)]
    below = TX + to_end[-1] * TX[2] / (TX[2] + position[2])
    points = np.array([np.zeros(3), below])[: len(ids), None]
    return Channel(
        rung="siso-rt",
        carriers=carriers(FREQUENCY),
        tx=("bs",),
        rx=("rx",),
        los=np.ones((1, 1), np.bool_),
        offsets=np.array([0, len(ids)], np.int64),
        object_names=("ground",),
        id=np.array(ids, np.uint64),
        a=a[None],
        tau=tau,
        aod=angles(np.array(to_end)),
        aoa=angles(back),
        doppler=(-FREQUENCY * rate / C)[None],
        interactions=np.array([[0], [1]], np.uint8)[: len(ids)],
        points=points,
        objects=np.array([[-1], [0]], np.int32)[: len(ids)],
    )


def world(position: Array, moves: Array) -> Scene:
    car = Thing("car", tuple(position), velocity=tuple(moves))
    devices = [
        antenna("bs", "tx", TX, AntennaArray(columns=8, rows=3)),
        antenna("rx", "rx", (0.0, 0.0, 0.0), AntennaArray(columns=5), parent="car"),
    ]
    return scene(devices, [car])


def keyframes(way: Callable[[float], Array], known: bool, spacing: float = H_S) -> Interpolation:
    made = []
    for t in (0.0, spacing):
        moves = velocity(way, t)
        at = world(way(t), moves) if known else None
        made.append(Keyframe(t, two_rays(way(t), moves), at))
    return Interpolation(*made)


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("t", [0.03, 0.2, 0.39])
def test_uniform_motion_is_exact(known: bool, t: float) -> None:
    """Delay, phase at 60 GHz, angles and Doppler shift, from scenes and from Doppler shifts alone."""
    moves = velocity(straight, t)
    got = keyframes(straight, known).at(t, world(straight(t), moves) if known else None).channel
    truth = two_rays(straight(t), moves)
    assert got.id.tolist() == truth.id.tolist()
    np.testing.assert_allclose(got.tau, truth.tau, rtol=1e-9 if not known else 1e-13)
    np.testing.assert_allclose(got.a, truth.a, atol=1e-5 * np.abs(truth.a).max())
    np.testing.assert_allclose(got.aod, truth.aod, atol=1e-9)
    np.testing.assert_allclose(got.aoa, truth.aoa, atol=1e-9)
    np.testing.assert_allclose(got.doppler, truth.doppler, rtol=1e-5)


@pytest.mark.parametrize("t", [0.05, 0.2, 0.33])
def test_known_positions_are_exact_whatever_the_acceleration(t: float) -> None:
    """H of both arrays included: a car that brakes."""
    moves = velocity(braking, t)
    now = world(braking(t), moves)
    got = keyframes(braking, known=True).at(t, now, with_h=True)
    truth = two_rays(braking(t), moves)
    np.testing.assert_allclose(got.channel.tau, truth.tau, rtol=1e-13)
    expected = plane_waves(truth)
    error = np.linalg.norm(got.channel.h[0].h - expected) / np.linalg.norm(expected)
    assert 20 * np.log10(error) <= min(float(got.bound_db[0, 0, 0]), -80.0)


@pytest.mark.parametrize("spacing", [0.05, 0.1, 0.2, 0.4])
def test_the_bound_from_doppler_shifts_holds_for_steady_braking(spacing: float) -> None:
    between = keyframes(braking, known=False, spacing=spacing)
    for share in (0.1, 0.37, 0.5, 0.81):
        t = share * spacing
        got, truth = between.at(t), two_rays(braking(t), velocity(braking, t))
        error = abs((got.channel.a - truth.a).sum()) / abs(truth.a.sum())
        assert 20 * np.log10(error) <= got.bound_db[0, 0, 0]


def test_keyframes_come_out_as_they_went_in() -> None:
    """With a bound of what float32 leaves of coefficients."""
    between = keyframes(braking, known=False)
    for t in (0.0, H_S):
        got, truth = between.at(t), two_rays(braking(t), velocity(braking, t))
        np.testing.assert_allclose(got.channel.a, truth.a, rtol=1e-6)
        np.testing.assert_allclose(got.channel.doppler, truth.doppler, rtol=1e-9)
        assert got.bound_db[0, 0, 0] < -80


def test_a_path_that_dies_fades_and_counts_whole() -> None:
    """While the reflected path fades, the bound is no less than all of it would make."""
    ends = [
        Keyframe(0.0, two_rays(straight(0.0), velocity(straight, 0.0))),
        Keyframe(H_S, two_rays(straight(H_S), velocity(straight, H_S), ids=(7,))),
    ]
    got = Interpolation(*ends).at(0.1)
    truth = two_rays(straight(0.1), velocity(straight, 0.1))
    assert got.changed.tolist() == [[True]]
    ratio = abs(got.channel.a[0, 1] / truth.a[0, 1])
    assert 0.74 < ratio < 0.76
    assert got.bound_db[0, 0, 0] >= 20 * np.log10(abs(truth.a[0, 1]) / (2 * abs(truth.a[0, 0])))


def plane_waves(channel: Channel) -> Array:
    """H of the arrays of `world`, element by element from their places in it."""
    wavelength = C / FREQUENCY
    tx = [(0.0, (n // 3 - 3.5) / 2, (1 - n % 3) / 2) for n in range(24)]
    rx = [(0.0, (n - 2.0) / 2, 0.0) for n in range(5)]
    h = np.zeros((5, 24), complex)
    for p in range(len(channel.tau)):
        out, back = (
            np.array([np.sin(z) * np.cos(y), np.sin(z) * np.sin(y), np.cos(z)])
            for z, y in (channel.aod[p], channel.aoa[p])
        )
        for m, n in np.ndindex(5, 24):
            way = wavelength * (np.dot(back, rx[m]) + np.dot(out, tx[n]))
            h[m, n] += channel.a[0, p] * np.exp(2j * np.pi * way / wavelength)
    return h


def test_over_an_edge_the_remainder_holds() -> None:
    """A path around an edge, which no image straightens: length by Keller's law of the shortest way."""
    edge_x, edge_z = 20.0, 14.0
    start, speed = np.array([0.0, 0.0, 2.0]), np.array([3.0, 21.0, 1.0])

    def diffracted(t: float) -> tuple[Channel, Scene]:
        end = np.array([31.0, 4.0, 1.5]) + speed * t
        down, up = (np.hypot(p[0] - edge_x, p[2] - edge_z) for p in (start, end))
        along = start[1] + (end[1] - start[1]) * down / (down + up)
        point = np.array([edge_x, along, edge_z])
        length = np.hypot(down + up, end[1] - start[1])
        base = two_rays(end, speed, ids=(9,))
        out, back = (point - p for p in (start, end))
        rate = (end - point) @ speed / np.linalg.norm(end - point)
        devices = [antenna("bs", "tx", start), antenna("rx", "rx", (0, 0, 0), parent="car")]
        fields = {
            "tau": np.array([length]) / C,
            "a": np.array([[1e-3 * spherical_wave(float(length), FREQUENCY)]]),
            "aod": angles(out[None]),
            "aoa": angles(back[None]),
            "doppler": np.array([[-FREQUENCY * rate / C]]),
            "interactions": np.array([[2]], np.uint8),
            "points": point[None, None],
            "objects": np.array([[0]], np.int32),
        }
        made = {name: getattr(base, name) for name in base.__struct_fields__ if name not in fields}
        return Channel(**made, **fields), scene(devices, [Thing("car", tuple(end), velocity=tuple(speed))])

    for known in (True, False):
        ends = [diffracted(t) for t in (0.0, H_S)]
        between = Interpolation(
            *(Keyframe(t, c, s if known else None) for t, (c, s) in zip((0.0, H_S), ends, strict=True))
        )
        for t in (0.1, 0.2, 0.3):
            truth, now = diffracted(t)
            got = between.at(t, now)
            error = abs((got.channel.a - truth.a).sum()) / abs(truth.a.sum())
            assert 20 * np.log10(error) <= got.bound_db[0, 0, 0]
            assert abs(got.channel.tau - truth.tau)[0] * C < 2e-4


@pytest.mark.parametrize("t", [0.07, 0.2, 0.31])
def test_a_mirror_that_accelerates_is_followed(t: float) -> None:
    """A tilted side of a lorry that pulls out; the image of the receiver by the plane where it is then."""
    normal = np.array([0.36, -0.8, 0.48])
    station, user = np.array([2.0, -9.0, 7.0]), np.array([19.0, -6.0, 1.2])
    moves = np.array([6.0, -2.0, 0.5])

    def seen(t: float) -> tuple[Channel, Scene]:
        side = np.array([9.0, 3.0, 2.0]) + moves * t + np.array([3.0, -1.0, 0.0]) * t**2
        speed = moves + 2 * np.array([3.0, -1.0, 0.0]) * t
        end = mirrored(user, side, normal)
        line = end - station
        point = station + line * ((side - station) @ normal / (line @ normal))
        length = float(np.linalg.norm(line))
        out, back = line / length, (point - user) / np.linalg.norm(point - user)
        base = two_rays(user, np.zeros(3), ids=(5,))
        fields = {
            "tau": np.array([length / C]),
            "a": np.array([[-0.5 * spherical_wave(length, FREQUENCY)]]),
            "aod": angles(out[None]),
            "aoa": angles(back[None]),
            "doppler": np.array([[-FREQUENCY / C * 2 * (normal @ speed) * (out @ normal)]]),
            "interactions": np.array([[1]], np.uint8),
            "points": point[None, None],
            "objects": np.array([[0]], np.int32),
            "object_names": ("lorry",),
        }
        made = {name: getattr(base, name) for name in base.__struct_fields__ if name not in fields}
        devices = [antenna("bs", "tx", station), antenna("rx", "rx", user)]
        lorry = Thing("lorry", tuple(side + np.array([0.0, 1.0, 0.0])), velocity=tuple(speed))
        return Channel(**made, **fields), scene(devices, [lorry])

    between = Interpolation(*(Keyframe(at, *seen(at)) for at in (0.0, H_S)))
    truth, now = seen(t)
    got = between.at(t, now)
    np.testing.assert_allclose(got.channel.tau, truth.tau, rtol=1e-13)
    np.testing.assert_allclose(got.channel.doppler, truth.doppler, rtol=1e-9)
    np.testing.assert_allclose(got.channel.aoa, truth.aoa, atol=1e-12)
    error = abs(got.channel.a - truth.a).sum() / abs(truth.a).sum()
    assert 20 * np.log10(error) <= min(float(got.bound_db[0, 0, 0]), -80.0)


def test_a_path_of_one_keyframe_keeps_its_phase_where_positions_are_known() -> None:
    """Until it is gone: only its amplitude fades."""
    ends = [
        Keyframe(t, two_rays(braking(t), velocity(braking, t), ids), world(braking(t), velocity(braking, t)))
        for t, ids in ((0.0, (7,)), (H_S, (7, 4)))
    ]
    moves = velocity(braking, 0.3)
    got = Interpolation(*ends).at(0.3, world(braking(0.3), moves)).channel
    truth = two_rays(braking(0.3), moves)
    np.testing.assert_allclose(got.a[0, 1] / truth.a[0, 1], 0.75, rtol=1e-6)


def test_devices_that_one_keyframe_lacks_are_left_out() -> None:
    channel = two_rays(straight(0.0), velocity(straight, 0.0))
    fields = {name: getattr(channel, name) for name in channel.__struct_fields__}
    none = {
        name: fields[name][:0] for name in ("tau", "id", "aod", "aoa", "interactions", "points", "objects")
    }
    nobody = Channel(
        **{
            **fields,
            **none,
            "a": channel.a[:, :0],
            "doppler": channel.doppler[:, :0],
            "rx": (),
            "los": channel.los[:, :0],
            "offsets": np.zeros(1, np.int64),
        }
    )
    got = Interpolation(Keyframe(0.0, channel), Keyframe(1.0, nobody)).at(0.5)
    assert (got.channel.tx, got.channel.rx, got.channel.tau.size) == (("bs",), (), 0)
    assert got.bound_db.shape == (1, 1, 0)


def test_keyframes_of_other_carriers_are_refused() -> None:
    channel = two_rays(straight(0.0), velocity(straight, 0.0))
    fields = {name: getattr(channel, name) for name in channel.__struct_fields__}
    other = Channel(**{**fields, "carriers": carriers(28e9)[:1]})
    with pytest.raises(PayloadError, match="the same carriers"):
        Interpolation(Keyframe(0.0, channel), Keyframe(1.0, other))


def test_a_scene_that_lacks_a_device_is_refused() -> None:
    between = keyframes(braking, known=True)
    whole = world(braking(0.2), velocity(braking, 0.2))
    without = scene([device for device in whole.devices if device.name != "rx"])
    with pytest.raises(PayloadError, match="lacks rx 'rx'"):
        between.at(0.2, without)
    with pytest.raises(PayloadError, match="lacks the device 'rx'"):
        Keyframe(0.0, two_rays(braking(0.0), velocity(braking, 0.0)), without)


@pytest.mark.parametrize("t", [-0.1, 0.5])
def test_a_time_outside_is_refused(t: float) -> None:
    with pytest.raises(PayloadError, match=rf"{t} s is not between the keyframes at 0\.0 s and 0\.4 s"):
        keyframes(straight, known=False).at(t)


def test_keyframes_in_the_wrong_order_are_refused() -> None:
    channel = two_rays(straight(0.0), velocity(straight, 0.0))
    with pytest.raises(PayloadError, match="not later"):
        Interpolation(Keyframe(1.0, channel), Keyframe(1.0, channel))


def test_matrices_need_the_scene() -> None:
    with pytest.raises(PayloadError, match="need the scene of the instant"):
        keyframes(straight, known=True).at(0.1, with_h=True)
    assert isinstance(
        keyframes(straight, known=True).at(0.1, world(straight(0.1), UP), True).channel.h[0], ChannelMatrix
    )
