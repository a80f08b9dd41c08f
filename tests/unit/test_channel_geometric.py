"""The geometric service: whose draws are whose, what blocks a line, and what it refuses."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from caviar_labs.stability.lab import channel_of, frame_of
from caviar_protocol.codec import decode_payload, encode_payload
from caviar_protocol.errors import PayloadError, ScenarioError
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.space.coordinates import quaternion_from_euler
from caviar_protocol.topics import AntennaArray, AntennaDevice, Carrier, Panel, Scene
from caviar_services.channel.statistical.geometric import GeometricChannel
from caviar_services.channel.statistical.waves import GeometricSettings
from caviar_services.registry import load
from caviar_services.service import Preparation, RunInfo, StepResult
from caviar_space.obstacles import Boxes

pytestmark = pytest.mark.slow

CARRIERS = (Carrier(name="a", frequency_hz=28e9), Carrier(name="b", frequency_hz=60e9))


def model(of: tuple[Carrier, ...] = CARRIERS, **settings: Any) -> GeometricChannel:
    made = GeometricChannel(
        msgspec.convert(settings, GeometricSettings), RunInfo(name="channel", seed=7, carriers=of)
    )
    made.prepare(Preparation(demand={"channel": frozenset({"h"})}))
    return made


def device(name: str, role: str, *position: float, parent: str = "") -> AntennaDevice:
    return AntennaDevice(
        name=name,
        role=role,  # type: ignore[arg-type]
        position=position,  # type: ignore[arg-type]
        parent=parent,
        array=AntennaArray(columns=3),
    )


def scene(*devices: AntennaDevice, boxes: dict[str, tuple[Any, Any, float]] | None = None) -> Scene:
    """Devices, and boxes by name: centre, size, yaw."""
    boxes = dict(sorted((boxes or {}).items()))
    return Scene(
        names=tuple(boxes),
        classes=("truck",) * len(boxes),
        assets=("",) * len(boxes),
        position=np.array([centre for centre, _, _ in boxes.values()], np.float64).reshape(-1, 3),
        orientation=np.array([quaternion_from_euler(yaw) for *_, yaw in boxes.values()]).reshape(-1, 4),
        velocity=np.zeros((len(boxes), 3)),
        dimensions=np.array([size for _, size, _ in boxes.values()], np.float64).reshape(-1, 3),
        devices=tuple(sorted(devices, key=lambda device: device.name)),
    )


def step(
    service: GeometricChannel, at: Scene, number: int = 0, episode: int = 0, seed: int = 7
) -> StepResult:
    return service.step(frame_of(at, number, episode=episode, seed=seed, seed_episode=episode))


TWO = (device("t", "tx", 0, 0, 10), device("r", "rx", 50, -9, 2))


def test_it_is_registered_under_its_rung() -> None:
    assert load("channel", "geometric") is GeometricChannel
    result = step(model(), scene(*TWO))
    assert result.fidelity == channel_of(result).rung == "geometric"


def test_a_pair_draws_the_same_whoever_else_is_there() -> None:
    """The paths of t → r are equal bit by bit with three more receivers and one more transmitter."""
    alone = channel_of(step(model(), scene(*TWO), 130))
    crowd = scene(
        *TWO,
        device("q", "rx", -40, 3, 2),
        device("s", "rx", 9, 9, 9),
        device("u", "tx", 5, 5, 5),
        device("z", "rx", 1, 77, 3),
    )
    among = channel_of(step(model(), crowd, 130))
    mine = among.pair("t", "r")
    for field in ("id", "tau", "aod", "aoa", "points", "interactions"):
        assert np.array_equal(getattr(among, field)[mine], getattr(alone, field)), field
    for field in ("a", "doppler"):
        assert np.array_equal(getattr(among, field)[:, mine], getattr(alone, field)), field
    assert not np.array_equal(among.tau[among.pair("u", "r")], alone.tau)


def test_draws_depend_on_frame_episode_and_seed_and_not_on_what_came_before() -> None:
    """Frame 70 is the same after frame 69 and at once; other frames, episodes and seeds differ."""
    running = model()
    delays = [channel_of(step(running, scene(*TWO), number)).tau.tolist() for number in range(71)]
    assert channel_of(step(model(), scene(*TWO), 70)).tau.tolist() == delays[70]
    others = [{"episode": 1}, {"seed": 8}, {"number": 6}]
    drawn = [
        channel_of(step(model(), scene(*TWO), **{"number": 70, **other})).tau.tolist() for other in others
    ]
    assert len({tuple(d) for d in (*drawn, *delays)}) == len(others) - 1 + len(delays)  # frame 6 was there


def test_draws_can_last_an_episode() -> None:
    """The same seed in the next episode is not the same episode."""
    running = model(redraw="episode")
    running.reset(0, 7, 0)
    first, later = (channel_of(step(running, scene(*TWO), number)) for number in (0, 400))
    assert encode_payload(first) == encode_payload(later)
    running.reset(1, 7, 0)
    assert not np.array_equal(channel_of(step(running, scene(*TWO), 0, episode=1)).tau, first.tau)


def test_the_product_is_canonical_and_survives_the_wire() -> None:
    """By delay; ids unique in a pair; both carriers share all but the phase."""
    crowd = scene(*TWO, device("q", "rx", -40, 3, 2), device("u", "tx", 25, -3, 5))
    for number in range(20):
        channel = channel_of(step(model(components=4), crowd, number))
        assert channel.offsets.tolist() == [0, 4, 8, 12, 16]
        for begin in range(0, 16, 4):
            pair = slice(begin, begin + 4)
            assert (np.diff(channel.tau[pair]) > 0).all()
            assert len(set(channel.id[pair].tolist())) == 4
        np.testing.assert_allclose(np.abs(channel.a[0]), np.abs(channel.a[1]), rtol=1e-12)
        np.testing.assert_allclose(channel.doppler[1], channel.doppler[0] * 60 / 28, rtol=1e-12)
        assert decode_payload("channel", *encode_payload(channel)) == channel


def test_two_carriers_are_what_each_is_alone() -> None:
    """The same draws serve both."""
    crowd = scene(*TWO, device("q", "rx", -40, 3, 2))
    both = channel_of(step(model(normalization="path-loss"), crowd, 5))
    for index, carrier in enumerate(CARRIERS):
        alone = channel_of(step(model(normalization="path-loss", of=(carrier,)), crowd, 5))
        assert np.array_equal(alone.a[0], both.a[index])
        assert np.array_equal(alone.doppler[0], both.doppler[index])
        assert np.array_equal(alone.tau, both.tau)
        for matrix in alone.h:
            (same,) = [m for m in both.h if (m.carrier, m.tx, m.rx) == (index, matrix.tx, matrix.rx)]
            assert np.array_equal(matrix.h, same.h)


def test_a_single_component_is_the_line_alone() -> None:
    channel = channel_of(step(model(components=1), scene(*TWO)))
    assert np.abs(channel.a) == pytest.approx(1.0)
    encode_payload(channel)


def test_devices_at_one_place_have_no_path_and_are_counted() -> None:
    crowd = scene(*TWO, device("x", "both", 20, 0, 5))
    result = step(model(), crowd)
    channel = channel_of(result)
    assert result.counts["too_close"] == 1
    assert channel.offsets.tolist() == [0, 3, 6, 9, 9]
    assert not channel.h[3].h.any()
    encode_payload(channel)


@pytest.mark.parametrize("role", ["tx", "rx"])
def test_without_an_end_there_is_an_empty_product(role: str) -> None:
    channel = channel_of(step(model(), scene(device("d", role, 0, 0, 0))))
    assert len(channel.tau) == 0
    assert channel.offsets.tolist() == [0]
    encode_payload(channel)


def test_a_range_of_angles_may_lie_behind() -> None:
    """[170, 190] around the back, where azimuths jump from 180° to −180°."""
    service = model(nlos="angle", nlos_azimuth_deg=[170, 190])
    for azimuth, free in ((-179, False), (171, False), (169, True), (-170.5, False), (-169, True), (0, True)):
        angle = np.radians(azimuth)
        there = device("r", "rx", float(40 * np.cos(angle)), float(40 * np.sin(angle)), 12.0)
        assert channel_of(step(service, scene(TWO[0], there))).los.tolist() == [[free]], azimuth


def test_boxes_between_the_ends_block_the_line() -> None:
    """A turned truck in between blocks, one beside, behind or below does not; nor does a carrier's own."""
    ends = device("t", "tx", 0, 0, 0.1, parent="a"), device("c/r", "rx", 0, 0, 0, parent="c")
    carriers = {"a": ((0, 0, 1), (4, 4, 2), 0.0), "c": ((40, 0, 1), (4, 2, 2), 1.0)}
    others = {
        "across": (((20, 3, 1), (10, 1, 2), np.pi / 2), False),
        "along": (((20, 3, 1), (10, 1, 2), 0.0), True),
        "behind": (((50, 0, 1), (4, 4, 4), 0.0), True),
        "below": (((20, 0, 0), (4, 4, 1), 0.0), True),
    }
    for name, (box, free) in others.items():
        world = scene(*ends, boxes={**carriers, name: box})
        assert channel_of(step(model(nlos="geometry"), world)).los.tolist() == [[free]], name


def test_boxes_of_the_settings_block_too() -> None:
    service = model(nlos="geometry", obstacles=[{"minimum_m": [10, -9, 0], "maximum_m": [12, -1, 30]}])
    behind, beside = device("r", "rx", 50, -9, 2), device("s", "rx", 50, 9, 2)
    channel = channel_of(step(service, scene(TWO[0], behind, beside)))
    assert channel.los.tolist() == [[False, True]]


@pytest.mark.parametrize("seed", range(3))
def test_occlusion_agrees_with_points_along_the_segment(seed: int) -> None:
    """20 random turned boxes and 100 segments against 4000 points along each."""
    rng = np.random.default_rng(seed)
    boxes = {f"b{i}": (rng.uniform(-30, 30, 3), rng.uniform(4, 15, 3), rng.uniform(-3, 3)) for i in range(20)}
    world = scene(boxes=boxes)
    start, end = rng.uniform(-40, 40, (2, 100, 3))
    found = Boxes.of(world).block(start, end).any(1)
    s = np.linspace(0, 1, 4001)[:, None, None]
    along = start + s * (end - start)
    nearest = np.full(100, np.inf)
    for centre, size, yaw in boxes.values():
        local = along - centre
        x = local[..., 0] * np.cos(yaw) + local[..., 1] * np.sin(yaw)
        y = local[..., 1] * np.cos(yaw) - local[..., 0] * np.sin(yaw)
        outside = np.abs(np.stack([x, y, local[..., 2]], -1)) - size / 2
        nearest = np.minimum(nearest, outside.max(-1).min(0))
    clear = np.abs(nearest) > 0.05
    assert clear.sum() > 80
    assert 10 < found.sum() < 90
    assert (found == (nearest < 0))[clear].all()


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"nlos_azimuth_deg": [20, 30]}, "go together"),
        ({"nlos": "angle"}, "go together"),
        ({"nlos": "angle", "nlos_azimuth_deg": [30, 20]}, "lower end first"),
        ({"obstacles": [{"minimum_m": [0, 0, 0], "maximum_m": [1, 1, 1]}]}, "block nothing"),
        (
            {"nlos": "geometry", "obstacles": [{"minimum_m": [0, 0, 0], "maximum_m": [1, 1, 0]}]},
            "is not below",
        ),
        ({"nlos_loss_db": 3.0}, "belongs to"),
    ],
)
def test_settings_that_do_nothing_are_refused(settings: dict[str, Any], told: str) -> None:
    with pytest.raises(msgspec.ValidationError, match=told):
        model(**settings)


@pytest.mark.parametrize("array", [AntennaArray(polarization="cross"), AntennaArray(panels=(Panel(),))])
def test_arrays_that_its_waves_have_no_polarization_for_are_refused(array: AntennaArray) -> None:
    """Before the run where the scenario has them, else in the frame."""
    spec = DeviceSpec(name="bs", kind="antenna", role="tx", array=array)
    run = RunInfo(name="channel", carriers=CARRIERS, devices=(spec,))
    with pytest.raises(ScenarioError, match=r"devices\.bs\.array: .*dual"):
        GeometricChannel(GeometricSettings(), run).prepare(Preparation(demand={}))
    bs = AntennaDevice(name="bs", role="tx", array=array)
    with pytest.raises(PayloadError, match='use = "sionna-rt"'):
        step(model(), scene(bs, device("ue", "rx", 9.0, 0.0, 0.0)))
