"""Obstacles: distances against other formulas, and flights that never come too near."""

from __future__ import annotations

import importlib.util
import math

import numpy as np
import pytest

from caviar_protocol.arrays import Float64Array
from caviar_protocol.space.coordinates import Vector
from caviar_services.service import Preparation, RunInfo
from caviar_services.world.flight import FlightSettings, FlightWorld, FlownObject
from caviar_services.world.flight_dynamics import (
    SLID_ALONG_OBSTACLE,
    STOPPED_BY_OBSTACLE,
    Flyer,
    Limits,
    Motion,
)
from caviar_space.meshes import box
from caviar_space.obstacles import Obstacles
from caviar_space.scenery import scenery_assets, scenery_triangles

pytestmark = pytest.mark.slow

Bounds = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]

needs_scenes = pytest.mark.skipif(
    importlib.util.find_spec("sionna") is None, reason="the scenery comes with sionna-rt"
)


def triangles(*boxes: Bounds) -> Float64Array:
    meshes = [box(*bounds) for bounds in boxes]
    return np.concatenate([mesh.vertices[mesh.faces] for mesh in meshes])


def from_box(point: Float64Array, bounds: Bounds) -> float:
    """Distance of a point outside a box from it; 0 inside."""
    low, high = np.array(bounds).T
    return float(np.linalg.norm(np.maximum(np.maximum(low - point, point - high), 0.0)))


def random_box(rng: np.random.Generator, extent: float) -> Bounds:
    low = rng.uniform(-extent, extent, 3)
    high = low + rng.uniform(0.05, extent / 2, 3)
    (a, b, c), (d, e, f) = low.tolist(), high.tolist()
    return ((a, d), (b, e), (c, f))


def vector(values: Float64Array) -> Vector:
    x, y, z = values.tolist()
    return (x, y, z)


def test_distances_are_those_of_boxes() -> None:
    rng = np.random.default_rng(5)
    for _ in range(40):
        bounds = [random_box(rng, 60.0) for _ in range(12)]
        obstacles = Obstacles(triangles(*bounds))
        for point in rng.uniform(-90, 90, (10, 3)):
            expected = min(from_box(point, b) for b in bounds)
            if expected > 0:  # inside, surfaces are meant, not volumes
                assert obstacles.distance(vector(point)) == pytest.approx(expected, abs=1e-9)
                assert obstacles.distance(vector(point), 7.0) == pytest.approx(min(expected, 7.0), abs=1e-9)


def test_distances_from_slanted_triangles_are_the_least_over_their_points() -> None:
    """Against a dense sample of the triangle, which can only be farther away, and not much."""
    rng = np.random.default_rng(6)
    u, v = np.meshgrid(np.linspace(0, 1, 80), np.linspace(0, 1, 80))
    u, v = u[u + v <= 1], v[u + v <= 1]
    for _ in range(60):
        a, b, c, point = rng.normal(0, 4, (4, 3))
        sample = a + u[:, None] * (b - a) + v[:, None] * (c - a)
        nearest = float(np.linalg.norm(sample - point, axis=1).min())
        found = Obstacles(np.array([[a, b, c]])).distance(vector(point))
        spacing = max(np.linalg.norm(b - a), np.linalg.norm(c - a)) / 79
        assert nearest - spacing <= found <= nearest + 1e-12


def test_a_needle_is_its_longest_edge() -> None:
    obstacles = Obstacles(np.array([[[0.0, 0, 0], [4.0, 0, 0], [2.0, 0, 0]], [[9.0, 0, 0]] * 3]))
    assert obstacles.distance((2.0, 3.0, 0.0)) == pytest.approx(3.0)
    assert obstacles.distance((9.0, 0.0, 2.0)) == pytest.approx(2.0)


MS = 1_000_000


def flyer(obstacles: Obstacles, speed: float, acceleration: float, clearance: float = 1.0) -> Flyer:
    made = Flyer(
        Limits(
            speed=speed,
            acceleration=acceleration,
            clearance=clearance,
            low=(-500.0, -500.0, -500.0),
            high=(500.0, 500.0, 500.0),
        )
    )
    made.obstacles = obstacles
    return made


@pytest.mark.parametrize(
    ("speed", "step_s"),
    [
        pytest.param(1.0, 0.25, marks=pytest.mark.exhaustive),
        pytest.param(30.0, 0.01, marks=pytest.mark.exhaustive),
        (30.0, 0.25),
        (1000.0, 0.01),
        (1000.0, 0.25),
    ],
)
def test_no_flight_comes_too_near_to_boxes(speed: float, step_s: float) -> None:
    """Also where one sub-step is longer than walls are thick; watched along the whole way."""
    rng = np.random.default_rng(int(speed))
    hits = 0
    for _ in range(5):
        bounds = [random_box(rng, 15.0) for _ in range(10)]
        clearance = float(rng.uniform(0.3, 1.5))
        made = flyer(Obstacles(triangles(*bounds)), speed, speed * 20, clearance)
        start = next(
            p
            for p in rng.uniform(-30, 30, (500, 3))
            if min(from_box(p, b) for b in bounds) > clearance + 0.01
        )
        made.reset(vector(start), 0.0)
        for _ in range(12):
            target = vector(rng.uniform(-20, 20, 3))
            for _ in range(math.ceil(25 / (speed * step_s)) + 3):
                before = np.array(made.state.position)
                hits += len(made.fly(Motion(target=target, speed=speed), round(step_s * 1e9)))
                after = np.array(made.state.position)
                assert min(from_box(after, b) for b in bounds) >= clearance - 1e-5
                assert math.hypot(*made.state.velocity) <= speed + 1e-9
                # Around a corner a step is no straight line, but it is never through a box.
                if np.linalg.norm(after - before) < clearance:
                    for s in (0.25, 0.5, 0.75):
                        assert min(from_box(before + s * (after - before), b) for b in bounds) > 0
    assert hits > 0


@pytest.mark.parametrize("speed", [5.0, 80.0, 1000.0])
def test_no_speed_leads_through_a_thin_wall(speed: float) -> None:
    rng = np.random.default_rng(3)
    wall = triangles(((10.0, 10.01), (-600.0, 600.0), (-600.0, 600.0)))
    for _ in range(10):
        made = flyer(Obstacles(wall), speed, 1e5)
        made.reset((0.0, 0.0, 0.0), 0.0)
        course = rng.normal((1.0, 0.0, 0.0), 0.3)
        velocity = vector(course / np.linalg.norm(course) * speed)
        for _ in range(30):
            made.fly(Motion(velocity=velocity), 100 * MS)
            assert made.state.position[0] <= 9.0 + 1e-6


def test_along_a_wall_it_slides_and_head_on_it_stops() -> None:
    wall = Obstacles(triangles(((10.0, 12.0), (-300.0, 300.0), (-300.0, 300.0))))
    made = flyer(wall, 10.0, 50.0)
    made.reset((0.0, 0.0, 0.0), 0.0)
    made.fly(Motion(velocity=(6.0, 8.0, 0.0)), 4000 * MS)
    assert made.state.velocity[0] == pytest.approx(0.0, abs=1e-9)
    assert made.state.velocity[1] > 5.0
    head_on = flyer(wall, 10.0, 50.0)
    head_on.reset((0.0, 0.0, 0.0), 0.0)
    events = head_on.fly(Motion(velocity=(10.0, 0.0, 0.0)), 4000 * MS)
    assert events == {STOPPED_BY_OBSTACLE: 1}
    assert 8.5 < head_on.state.position[0] <= 9.0


def test_in_a_corner_it_stops_and_gets_out_again() -> None:
    corner = triangles(
        ((10.0, 12.0), (-50.0, 50.0), (-50.0, 50.0)), ((-50.0, 50.0), (10.0, 12.0), (-50.0, 50.0))
    )
    made = flyer(Obstacles(corner), 10.0, 50.0)
    made.reset((0.0, 0.0, 0.0), 0.0)
    made.fly(Motion(velocity=(7.0, 6.0, 0.0)), 4000 * MS)
    assert 8.4 < made.state.position[0] <= 9.0 + 1e-6
    assert 8.4 < made.state.position[1] <= 9.0 + 1e-6
    made.fly(Motion(target=(0.0, 0.0, 0.0), speed=5.0), 5000 * MS)
    assert math.dist(made.state.position, (0.0, 0.0, 0.0)) < 1e-2


def test_the_same_commands_lead_to_the_same_flight_bit_by_bit() -> None:
    """What is remembered of the flight before does not matter."""
    rng = np.random.default_rng(12)
    obstacles = Obstacles(triangles(*(random_box(rng, 30.0) for _ in range(20))))
    made = flyer(obstacles, 20.0, 30.0, 0.5)
    start = next(vector(p) for p in rng.uniform(-40, 40, (500, 3)) if obstacles.distance(vector(p)) > 3.0)
    targets = [vector(p) for p in rng.uniform(-30, 30, (20, 3))]
    flights = []
    events: set[str] = set()
    for _ in range(2):
        made.reset(start, 0.0)
        places = []
        for target in targets:
            events |= set(made.fly(Motion(target=target, speed=20.0), 1000 * MS))
            places.append((made.state.position, made.state.velocity))
        flights.append(places)
    assert flights[0] == flights[1]
    assert SLID_ALONG_OBSTACLE in events


def among_boxes(seed: int) -> tuple[Flyer, np.random.Generator, list[Bounds]]:
    """Something that flies at the origin, with a dozen boxes around it."""
    rng = np.random.default_rng(seed)
    bounds = [b for b in (random_box(rng, 25.0) for _ in range(16)) if from_box(np.zeros(3), b) > 1.5]
    made = flyer(Obstacles(triangles(*bounds)), 12.0, 4.0)
    made.reset((0.0, 0.0, 0.0), 0.0)
    return made, rng, bounds


def motion(rng: np.random.Generator) -> Motion:
    place = vector(rng.uniform(-25, 25, 3))
    return Motion(velocity=place) if rng.random() < 0.5 else Motion(target=place, speed=12.0)


@pytest.mark.parametrize(
    "seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.exhaustive) for seed in range(2, 6))]
)
def test_the_acceleration_keeps_its_limit_at_walls_too(seed: int) -> None:
    """Seen in steps that are shorter than a sub-step."""
    made, rng, bounds = among_boxes(seed)
    events: set[str] = set()
    for _ in range(20):
        wanted = motion(rng)
        for _ in range(400):
            before = made.state.velocity
            events |= set(made.fly(wanted, 7 * MS))
            assert math.dist(before, made.state.velocity) <= 4.0 * 0.007 * (1 + 1e-9)
            assert min(from_box(np.array(made.state.position), b) for b in bounds) >= 1.0 - 1e-9
    assert events & {SLID_ALONG_OBSTACLE, STOPPED_BY_OBSTACLE}


@pytest.mark.parametrize("seed", range(6))
def test_how_the_time_is_cut_makes_no_difference(seed: int) -> None:
    """Bit by bit, also where nothing ends with a sub-step."""
    whole, rng, _ = among_boxes(seed)
    cut, _, _ = among_boxes(seed)
    for _ in range(12):
        wanted, left = motion(rng), int(rng.integers(30 * MS, 3000 * MS))
        whole.fly(wanted, left)
        while left:
            length = min(left, int(rng.integers(1, 400 * MS)))
            cut.fly(wanted, length)
            left -= length
        assert (whole.state.position, whole.state.velocity, whole.state.yaw) == (
            cut.state.position,
            cut.state.velocity,
            cut.state.yaw,
        )


def test_nothing_stands_in_the_way_where_there_is_no_scenery() -> None:
    made = flyer(Obstacles.none(), 10.0, 50.0)
    made.reset((0.0, 0.0, 0.0), 0.0)
    assert made.fly(Motion(velocity=(10.0, 0.0, 0.0)), 2000 * MS) == {}
    assert made.state.position[0] == pytest.approx(10.0 * 2.0 - 10.0**2 / (2 * 50.0))


@needs_scenes
def test_flights_over_munich_keep_clear_of_it() -> None:
    """Random waypoints, most of them inside blocks or behind them, at 40 m/s."""
    obstacles = Obstacles(
        (found := scenery_triangles(scenery_assets("sionna:munich")))[found[..., 2].max(axis=1) > 0.125]
    )
    made = flyer(obstacles, 40.0, 30.0)
    made.reset((70.0, 55.0, 22.0), 0.0)
    rng = np.random.default_rng(9)
    events: set[str] = set()
    for _ in range(25):
        target = vector(rng.uniform((-200, -200, 2), (250, 300, 30)))
        for _ in range(4):
            events |= set(made.fly(Motion(target=target, speed=40.0), 500 * MS))
            assert obstacles.distance(made.state.position, 5.0) >= 1.0 - 1e-5
    assert events


@needs_scenes
def test_a_start_inside_the_clearance_is_refused() -> None:
    """The base station of the shipped scenario stands one metre above the roof."""
    from caviar_protocol.errors import ScenarioError

    thing = FlownObject(
        name="uav", start_m=(8.5, 21.3, 26.5), max_speed_m_s=5.0, max_acceleration_m_s2=2.0, clearance_m=2.0
    )
    made = FlightWorld(FlightSettings(scenery="sionna:munich", flown=(thing,)), RunInfo(name="world"))
    with pytest.raises(ScenarioError, match=r"'uav' keeps 2\.000 m"):
        made.prepare(Preparation(demand={}))
