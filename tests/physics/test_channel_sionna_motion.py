"""The traced channel of things that move, come and go: Doppler, no traces left, equal products."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from caviar_labs.stability.formulas import C, mirrored
from caviar_labs.stability.lab import (
    Plate,
    Thing,
    antenna,
    measure,
    pair_sums,
    scene,
    sionna,
    write_scenery,
)
from caviar_protocol.codec import encode_payload
from caviar_protocol.digest import payload_digest
from caviar_protocol.space.coordinates import multiply, quaternion_from_euler
from caviar_protocol.topics import AntennaArray, Channel, Interaction, Scene
from caviar_services.channel.base import ChannelModel

pytestmark = pytest.mark.channel

F = 28e9
GROUND = Plate("ground", [(-200, -200, 0), (200, -200, 0), (200, 200, 0), (-200, 200, 0)])
WALL = Plate("wall", [(-90, 14, 0), (80, 20, 0), (80, 20, 25), (-90, 14, 25)], "glass", 0.1)


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> ChannelModel[Any]:
    assets = write_scenery(tmp_path_factory.mktemp("street"), [GROUND, WALL])
    return sionna(F, assets, bodies=6, max_depth=2)


def digest(channel: Channel) -> str:
    return payload_digest(*encode_payload(channel))


def traffic(cars: int, seed: int = 5, behind_the_wall: bool = False) -> Scene:
    """A base station and cars in random places, every second with a receiver on its roof."""
    rng = np.random.default_rng(seed)
    things = [
        Thing(
            f"car.{i}",
            (rng.uniform(-60, 60), -6 + 4 * (i % 4), 0.85),
            quaternion=quaternion_from_euler(rng.uniform(-3, 3)),
            velocity=tuple(rng.uniform(-15, 15, 3) * [1, 1, 0]),
        )
        for i in range(cars)
    ]
    receivers = [antenna(f"{t.name}/rx", "rx", (0, 0, 1.1), parent=t.name) for t in things[::2]]
    if behind_the_wall:
        receivers.append(antenna("hidden", "rx", (5, 30, 2)))
    return scene([antenna("bs", "tx", (-20, 9, 7.5)), *receivers], things)


@pytest.mark.parametrize("seed", range(3))
def test_doppler_of_a_moving_reflector(street: ChannelModel[Any], seed: int) -> None:
    """A vertical metal slab moves, TX and RX stand: the shift of the path by way of it is −f·dL/dt of the
    image's distance L, within 0.5 Hz of some kilohertz."""
    rng = np.random.default_rng(seed)
    yaw = rng.uniform(-0.1, 0.1)
    forward = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    centre = np.array([60.0, 3.0, 5.2])
    velocity = rng.uniform(-20, 20, 3)
    slab = Thing("slab", centre, (1.0, 30.0, 10.0), quaternion_from_euler(yaw), velocity)
    tx, rx = np.array([2.0, rng.uniform(-2, 2), 6.0]), np.array([-4.0, rng.uniform(2, 5), 4.5])
    channel = measure(street, scene([antenna("t", "tx", tx), antenna("r", "rx", rx)], [slab]))
    names = [[channel.object_names[o] for o in row if o >= 0] for row in channel.objects]
    path = names.index(["slab"])

    def length(t: float) -> float:
        face = centre + velocity * t - forward * 0.5
        return float(np.linalg.norm(rx - mirrored(tx, face, forward)))

    rate = (length(1e-3) - length(-1e-3)) / 2e-3
    assert channel.tau[path] == pytest.approx(length(0.0) / C, rel=2e-7)
    assert channel.doppler[0, path] == pytest.approx(-F / C * rate, abs=0.5)
    direct = names.index([])
    assert channel.doppler[0, direct] == 0


def test_a_reflector_that_approaches_raises_the_frequency(street: ChannelModel[Any]) -> None:
    """Head on at 10 m/s: +2·f·v/c (both legs), less the slight angle between the ends."""
    slab = Thing("slab", (60, 0, 5.2), (1, 12, 10), velocity=(-10.0, 0, 0))
    devices = [antenna("t", "tx", (0, -0.2, 6)), antenna("r", "rx", (0, 0.2, 6))]
    channel = measure(street, scene(devices, [slab]))
    path = [row[0] >= 0 and channel.object_names[row[0]] == "slab" and row[1] < 0 for row in channel.objects]
    assert channel.doppler[0, path] == pytest.approx(2 * F * 10 / C, rel=1e-4)


def keyed(channel: Channel) -> dict[tuple[int, int], int]:
    """Row of each path by its pair and id."""
    pair = np.repeat(np.arange(len(channel.offsets) - 1), np.diff(channel.offsets))
    return {(int(p), int(i)): row for row, (p, i) in enumerate(zip(pair, channel.id, strict=True))}


TURNS = {
    "a car in a bend of 12 m at 43 km/h": ((12.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "one that spins where it stands": ((0.0, 0.0, 0.0), (0.0, 0.0, -2.5)),
    "one that pitches and rolls too": ((-9.0, 4.0, 0.0), (0.3, -0.4, 1.2)),
}


@pytest.mark.parametrize("name", TURNS)
def test_doppler_where_objects_turn(street: ChannelModel[Any], name: str) -> None:
    """Each path by way of a van that turns, and to antennas at its corners: −f·dτ/dt by differences over
    ±0.1 ms within 1 Hz. Without angular velocities the worst is off by more than 100 Hz."""
    velocity, turning = (np.array(vector) for vector in TURNS[name])
    rate = float(np.linalg.norm(turning))
    ends = [
        antenna("bs", "tx", (-20, 9, 7.5)),
        antenna("r", "rx", (-16, 6, 1.7)),
        antenna("s", "rx", (4, 9, 5)),
    ]
    for i, corner in enumerate([(2.9, 1.1, 1.6), (-2.9, -1.1, 1.6), (3.1, 0.0, 0.4)]):
        ends.append(antenna(f"van/{i}", "rx", corner, parent="van"))

    def at(t: float, told: bool = True) -> Channel:
        half = rate * t / 2
        spun = (np.cos(half), *(np.sin(half) * turning / rate))
        pose = multiply(spun, quaternion_from_euler(2.6))
        van = Thing(
            "van",
            np.array([2.0, -3.0, 1.9]) + velocity * t,
            (6.0, 2.4, 3.0),
            pose,
            velocity,
            turning if told else (0.0, 0.0, 0.0),
        )
        return measure(street, scene(ends, [van]))

    before, now, after, unaware = at(-1e-4), at(0.0), at(1e-4), at(0.0, told=False)
    b, a, u = keyed(before), keyed(after), keyed(unaware)
    errors, without, by_way = [], [], 0
    for key, row in keyed(now).items():
        if key in b and key in a:
            shift = -F * (after.tau[a[key]] - before.tau[b[key]]) / 2e-4
            errors.append(abs(now.doppler[0, row] - shift))
            without.append(abs(unaware.doppler[0, u[key]] - shift))
            by_way += "van" in {now.object_names[o] for o in now.objects[row] if o >= 0}
    assert len(errors) >= 12
    assert by_way >= 2
    assert max(errors) < 1.0
    assert max(without) > 100.0


def test_doppler_of_moving_ends_over_a_reflection(street: ChannelModel[Any]) -> None:
    """Every path of two moving cars: −f·dτ/dt by differences over ±2 ms, matched by path id."""
    here = traffic(3)

    def at(t: float) -> Channel:
        moved = Scene(
            names=here.names,
            classes=here.classes,
            assets=here.assets,
            position=here.position + here.velocity * t,
            orientation=here.orientation,
            velocity=here.velocity,
            dimensions=here.dimensions,
            devices=here.devices,
        )
        return measure(street, moved)

    before, now, after = at(-2e-3), at(0.0), at(2e-3)
    b, a = keyed(before), keyed(after)
    checked = 0
    for key, row in keyed(now).items():
        if key in b and key in a:
            rate = (after.tau[a[key]] - before.tau[b[key]]) / 4e-3
            assert now.doppler[0, row] == pytest.approx(-F * rate, abs=60)
            checked += 1
    assert checked >= 6
    assert np.abs(now.doppler).max() > 600


def test_what_came_and_went_leaves_no_trace(street: ChannelModel[Any]) -> None:
    """The product of a frame does not depend on who was there before."""
    few = digest(measure(street, traffic(2)))
    measure(street, traffic(6, seed=9))
    assert digest(measure(street, traffic(2))) == few
    measure(street, scene([]))
    assert digest(measure(street, traffic(2))) == few


def test_parked_bodies_and_receivers_do_not_matter(tmp_path: Path) -> None:
    """A service with just the bodies and receivers needed finds the same paths, refraction on; amplitudes
    agree within 1e-4, as which of two triangles a ray on their common edge hits may differ."""
    assets = write_scenery(tmp_path, [GROUND, WALL])
    tight = sionna(F, assets, pool={"box": 3}, receivers_at_once=3, refraction=True, max_depth=3)
    roomy = sionna(F, assets, pool={"box": 24}, receivers_at_once=16, refraction=True, max_depth=3)
    frame = traffic(3, behind_the_wall=True)
    one, other = measure(tight, frame), measure(roomy, frame)
    assert np.array_equal(one.id, other.id)
    assert np.array_equal(one.offsets, other.offsets)
    assert (np.abs(one.a - other.a) < 1e-4 * np.abs(one.a)).all()
    assert (one.interactions == Interaction.TRANSMISSION).any()


@pytest.mark.parametrize(
    "settings",
    [pytest.param({}, marks=pytest.mark.exhaustive), {"candidates": "enumerated"}],
    ids=["launched", "enumerated"],
)
def test_more_objects_than_bodies_have_bodies_made(tmp_path: Path, settings: dict[str, Any]) -> None:
    """The channel is that of a pool which was large enough, in the frame that is short and in those after."""
    assets = write_scenery(tmp_path, [GROUND, WALL])
    small = sionna(F, assets, bodies=1, max_depth=2, **settings)
    large = sionna(F, assets, bodies=24, max_depth=2, **settings)
    for count in (1, 3, 7, 2):
        frame = traffic(count)
        one, other = measure(small, frame), measure(large, frame)
        assert np.array_equal(one.id, other.id)
        assert np.array_equal(one.offsets, other.offsets)
        assert (np.abs(one.a - other.a) < 1e-4 * np.abs(one.a)).all()


def test_more_receivers_than_one_launch_takes(tmp_path: Path) -> None:
    """Launches of two receivers each give the paths of one launch of all."""
    assets = write_scenery(tmp_path, [GROUND, WALL])
    frame = traffic(6)
    one = measure(sionna(F, assets, bodies=6, receivers_at_once=3), frame)
    two = measure(sionna(F, assets, bodies=6, receivers_at_once=2), frame)
    assert digest(one) == digest(two)


@pytest.mark.parametrize(
    "everything", [pytest.param(False, marks=pytest.mark.exhaustive), True], ids=["reflection", "everything"]
)
@pytest.mark.parametrize(
    "rung",
    [
        pytest.param("siso-rt", marks=pytest.mark.exhaustive),
        pytest.param("spherical", marks=pytest.mark.exhaustive),
        "mimo-rt",
    ],
)
def test_no_frame_compiles_a_kernel(tmp_path: Path, rung: str, everything: bool) -> None:
    """Neither moving, coming and going, nor numbers of objects, receivers, elements and paths: all was
    compiled while preparing. Kernels of single frames would also be a leak of memory."""
    settings = {"rung": rung, "bodies": 6, **(ALL_ON if everything else {})}
    model = sionna(F, write_scenery(tmp_path, [GROUND, WALL]), **settings)
    arrays = AntennaArray(), AntennaArray(rows=2, columns=2), AntennaArray(columns=3)
    import drjit as dr

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for seed, cars in enumerate((1, 6, 0, 3, 5, 2, 4, 6)):
            at = traffic(cars, seed)
            devices = tuple(replace(device, array=arrays[seed % 3]) for device in at.devices)
            measure(model, replace(at, devices=devices))
        history = dr.kernel_history([dr.KernelType.JIT])
        dr.kernel_history_clear()
    assert len(history) > 40
    assert not [entry["operation_count"] for entry in history if not entry["cache_hit"]]


def test_a_car_in_between_blocks_the_line_of_sight(street: ChannelModel[Any]) -> None:
    ends = [antenna("t", "tx", (-30, -3, 1.0)), antenna("r", "rx", (30, -3, 1.0))]
    free = measure(street, scene(ends))
    blocked = measure(street, scene(ends, [Thing("car", (3, -3, 0.8))]))
    assert free.los.all()
    assert not blocked.los.any()
    assert (np.abs(pair_sums(blocked)) < np.abs(pair_sums(free))).all()


PROCESS = """
import sys
sys.path[:0] = [{here!r}]
from pathlib import Path
from caviar_labs.stability.lab import measure, sionna, write_scenery
from test_channel_sionna_motion import F, GROUND, WALL, digest, traffic
assets = write_scenery(Path({folder!r}), [GROUND, WALL])
model = sionna(F, assets, bodies=6, **{settings!r})
print(digest(measure(model, traffic(4))), digest(measure(model, traffic(5, seed=2))))
"""

ALL_ON: dict[str, Any] = {
    "refraction": True,
    "diffraction": True,
    "scattering": True,
    "samples": 3000,
    "materials": {
        "skin-ground": {"scattering_coefficient": 0.4},
        "skin-wall": {"scattering_coefficient": 0.3},
    },
}


@pytest.mark.parametrize(
    "settings", [pytest.param({}, marks=pytest.mark.exhaustive), ALL_ON], ids=["specular", "all-on"]
)
def test_two_processes_make_equal_products(tmp_path: Path, settings: dict[str, Any]) -> None:
    """Bit-equal payloads of this process, where much came before, and of one of its own, with diffraction and
    diffuse scattering too: the solver returns those in another order each time, the product does not."""
    code = PROCESS.format(here=str(Path(__file__).parent), folder=str(tmp_path / "there"), settings=settings)
    there = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=200, check=True
    ).stdout.splitlines()[-1]
    model = sionna(F, write_scenery(tmp_path / "here", [GROUND, WALL]), bodies=6, **settings)
    here = [digest(measure(model, frame)) for frame in (traffic(4), traffic(5, seed=2))]
    assert there.split() == here
    assert len(set(here)) == 2


def test_diffraction_and_scattering_come_in_canonical_order(tmp_path: Path) -> None:
    """Repeated runs are equal, and have paths of all kinds."""
    model = sionna(F, write_scenery(tmp_path, [GROUND, WALL]), **ALL_ON)
    tower = Thing("tower", (12, -6, 5), (8, 8, 10))
    ends = [
        antenna("t", "tx", (-10, -4, 4)),
        antenna("r", "rx", (24, -12, 2)),
        antenna("s", "rx", (5, 30, 2)),
    ]
    products = [measure(model, scene(ends, [tower])) for _ in range(3)]
    assert len({digest(product) for product in products}) == 1
    kinds = set(np.unique(products[0].interactions).tolist())
    assert {Interaction.DIFFRACTION, Interaction.SCATTERING, Interaction.TRANSMISSION} <= kinds
