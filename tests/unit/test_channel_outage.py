"""Why users have no path: each cause by count, and antennas inside of objects by name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from caviar_labs.stability.lab import frame_of
from caviar_protocol.arrays import Float64Array
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.space.coordinates import Vector
from caviar_protocol.topics import AntennaDevice, Carrier, Channel, Scene
from caviar_services.channel.assemble import outage_counts
from caviar_services.channel.base import Found
from caviar_services.channel.paths import Antenna
from caviar_services.channel.sionna.model import SionnaChannel
from caviar_services.channel.sionna.settings import SionnaSettings
from caviar_services.channel.statistical.free_space import FreeSpaceChannel, FreeSpaceSettings
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo
from caviar_space.meshes import box
from caviar_space.obstacles import RISING_RAYS, Surfaces

pytestmark = pytest.mark.slow

HOUSE = box((-5.0, 5.0), (10.0, 20.0), (0.0, 8.0))
CARRIERS = (Carrier(name="a", frequency_hz=3e9), Carrier(name="b", frequency_hz=28e9))


def antenna(name: str, position: Vector, parent: str = "", role: str = "rx") -> AntennaDevice:
    return AntennaDevice(name=name, role=role, position=position, parent=parent)  # type: ignore[arg-type]


def scene(*devices: AntennaDevice, car: Vector = (0.0, 0.0, 0.75)) -> Scene:
    """One car, looking east, and devices."""
    return Scene(
        names=("car",),
        classes=("car",),
        assets=("",),
        position=np.array([car]),
        orientation=np.array([[1.0, 0, 0, 0]]),
        velocity=np.zeros((1, 3)),
        dimensions=np.array([[4.0, 2.0, 1.5]]),
        devices=tuple(sorted(devices, key=lambda device: device.name)),
    )


@dataclass
class Town:
    """Scenery 100 m wide, with a house at x < 0."""

    extent: tuple[Float64Array, Float64Array] | None = (np.array([-50.0, -50, 0]), np.array([50.0, 50, 30]))

    def enclosing(self, position: Float64Array) -> str:
        return "house" if position[0] < 0 else ""


def channel(paths: list[int], los: list[bool], a: list[list[complex]] | None = None) -> Channel:
    """From ``bs`` to ``r0``, ``r1``, …: so many paths each, on two carriers."""
    count = sum(paths)
    return Channel(
        rung="x",
        carriers=CARRIERS,
        tx=("bs",),
        rx=tuple(f"r{i}" for i in range(len(paths))),
        los=np.array([los]),
        offsets=np.cumsum([0, *paths]),
        id=np.arange(count, dtype=np.uint64),
        a=np.ones((2, count), np.complex128) if a is None else np.array(a, np.complex128),
        tau=np.zeros(count),
        aod=np.zeros((count, 2)),
        aoa=np.zeros((count, 2)),
        doppler=np.zeros((2, count)),
        interactions=np.zeros((count, 0), np.uint8),
        points=np.zeros((count, 0, 3)),
        objects=np.zeros((count, 0), np.int32),
    )


BS = antenna("bs", (10.0, 0.0, 10.0), role="tx")


@pytest.mark.parametrize(
    ("position", "los", "counts"),
    [
        ((20.0, 9.0, 1.0), False, {"no-path/blocked": 2}),
        ((20.0, 9.0, 1.0), True, {"no-path/no-path-found": 2}),
        ((20.0, 51.0, 1.0), False, {"no-path/out-of-range": 2}),
        ((20.0, 9.0, -1.0), False, {"no-path/out-of-range": 2}),
        ((20.0, 9.0, 300.0), False, {"no-path/blocked": 2}),
        ((20.0, 51.0, 1.0), True, {"no-path/no-path-found": 2}),
        ((10.05, 0.0, 10.0), True, {"no-path/too-close": 2}),
        ((-20.0, 9.0, 1.0), False, {"no-path/inside-an-object": 2, "inside/r0 in house": 1}),
    ],
)
def test_each_cause_counts_a_user_on_each_carrier(
    position: Vector, los: bool, counts: dict[str, int]
) -> None:
    """3 GHz has a wavelength of 10 cm."""
    devices = scene(BS, antenna("r0", position))
    assert outage_counts(channel([0], [los]), devices, Town()) == counts


def test_users_with_a_path_are_not_counted_and_a_carrier_without_amplitude_has_none() -> None:
    devices = scene(BS, *(antenna(f"r{i}", (20.0, 9.0, 1.0)) for i in range(3)))
    found = channel([1, 2, 0], [False] * 3, [[1, 0, 1], [1, 0, 0]])
    assert outage_counts(found, devices, Town()) == {"no-path/blocked": 1 + 2}
    assert outage_counts(channel([1, 1, 1], [False] * 3), devices, Town()) == {}


def test_users_whose_paths_were_dropped_are_told_from_those_without() -> None:
    devices = scene(BS, *(antenna(f"r{i}", (20.0, 9.0, 1.0)) for i in range(3)))
    found = outage_counts(channel([0, 0, 1], [True, False, True]), devices, Town(), {0, 2})
    assert found == {"no-path/not-finite": 2, "no-path/blocked": 2}


class NotFinite(FreeSpaceChannel):
    """A model that computes no amplitude for its second receiver."""

    def paths(self, scene: Scene, transmitters: Sequence[Antenna], receivers: Sequence[Antenna]) -> Found:
        found = super().paths(scene, transmitters, receivers)
        found.table.transfer[:, found.table.pair == 1] = np.nan
        return found


def test_a_model_that_computes_no_number_says_so_in_its_counts() -> None:
    devices = scene(BS, *(antenna(f"r{i}", (20.0, 9.0, 1.0)) for i in range(2)))
    model = NotFinite(FreeSpaceSettings(), RunInfo(name="channel", carriers=CARRIERS))
    model.prepare(Preparation(demand={"channel": frozenset()}))
    provenance = GrantInput(topic="scene", source="world", status=Status.FRESH, frame=0)
    made = model.step(
        Frame(
            episode=0, number=0, t_ns=0, inputs=(FrameInput(provenance, payload=devices),), service="channel"
        )
    )
    assert {name: made.counts[name] for name in ("dropped", "no-path/not-finite")} == {
        "dropped": 1,
        "no-path/not-finite": 2,
    }


def test_no_device_is_a_user_of_itself() -> None:
    both = channel([0], [True])
    both = Channel(**{name: getattr(both, name) for name in both.__struct_fields__} | {"rx": ("bs",)})
    assert outage_counts(both, scene(BS), Town()) == {}


def test_without_scenery_nothing_is_out_of_range() -> None:
    devices = scene(BS, antenna("r0", (1e4, 0.0, 1.0)))
    assert outage_counts(channel([0], [False]), devices, Town(extent=None)) == {"no-path/blocked": 2}


@pytest.mark.parametrize("inside", [True, False])
def test_rays_from_inside_of_a_house_leave_it_once_and_others_never_or_twice(inside: bool) -> None:
    """Its floor is taken away, as most models of cities have none."""
    triangles = HOUSE.vertices[HOUSE.faces[2:]]
    house = Surfaces(triangles, lambda triangle, normal: True)
    rng = np.random.default_rng(5)
    low, high = triangles.reshape(-1, 3).min(0), triangles.reshape(-1, 3).max(0)
    for _ in range(100):
        place = rng.uniform(low, high) if inside else rng.uniform(low - 20.0, high + 20.0)
        if inside == bool(((place > low) & (place < high)).all()) and place[2] > 0:
            rays = list(house.above(place))
            assert len(rays) == RISING_RAYS
            assert all(len(met) % 2 == inside for met in rays)


# --- with the ray tracer ---------------------------------------------------------------------------------


def ply(vertices: Float64Array, faces: np.ndarray) -> str:  # type: ignore[type-arg]
    rows = [" ".join(map(str, row)) for row in vertices.tolist()]
    rows += [f"3 {a} {b} {c}" for a, b, c in faces.tolist()]
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    return (
        f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\n{axes}element face {len(faces)}\n"
        "property list uchar int vertex_index\nend_header\n" + "\n".join(rows) + "\n"
    )


@pytest.fixture(scope="module")
def traced(tmp_path_factory: pytest.TempPathFactory) -> SionnaChannel:
    """Ground, and a house without a floor whose roof is a piece of its own."""
    pytest.importorskip("sionna.rt", reason="sionna-rt is not installed")
    folder: Path = tmp_path_factory.mktemp("town")
    ground = np.array([[-50.0, -50, 0], [50, -50, 0], [50, 50, 0], [-50, 50, 0]])
    pieces = {
        "ground": (ground, np.array([[0, 1, 2], [0, 2, 3]])),
        "roof": (HOUSE.vertices, HOUSE.faces[2:4]),
        "walls": (HOUSE.vertices, HOUSE.faces[4:]),
    }
    shapes = ""
    for name, (vertices, faces) in pieces.items():
        (folder / f"{name}.ply").write_text(ply(vertices, faces))
        shapes += (
            f'<shape type="ply" id="mesh-{name}"><string name="filename" value="{name}.ply"/>'
            '<ref id="skin" name="bsdf"/></shape>'
        )
    (folder / "town.xml").write_text(
        '<scene version="2.1.0"><bsdf type="itu-radio-material" id="skin"><string name="type" '
        f'value="concrete"/></bsdf>{shapes}</scene>'
    )
    assets = {f"scenery/{file.name}": file for file in folder.iterdir()}
    run = RunInfo(name="channel", carriers=CARRIERS[1:], devices=())
    made = SionnaChannel(SionnaSettings(samples=500, max_depth=1, bodies=1), run)
    made.prepare(Preparation(demand={"channel": frozenset()}, assets=assets))
    return made


def causes(traced: SionnaChannel, town: Scene) -> dict[str, int]:
    """What the service reports of a scene, beside the counts that it always has."""
    counts = traced.step(frame_of(town)).counts
    return {name: count for name, count in counts.items() if "/" in name}


@pytest.mark.parametrize(
    ("rx", "car", "counts"),
    [
        (antenna("car/rx", (0.3, 0.1, 0.2), "car"), (0.0, 0.0, 0.75), {"inside/car/rx in car": 1}),
        (antenna("car/rx", (0.0, 0.0, 0.74), "car"), (0.0, 0.0, 0.75), {"inside/car/rx in car": 1}),
        (antenna("rx", (1.0, 0.5, 0.4)), (0.0, 0.0, 0.75), {"inside/rx in car": 1}),
        (antenna("car/rx", (0.0, 0.0, 0.85), "car"), (0.0, 15.0, 0.75), {"inside/car/rx in walls": 1}),
        (antenna("car/rx", (0.0, 0.0, 0.85), "car"), (0.0, 0.0, 0.75), {}),
    ],
    ids=["in its own body", "just below its roof", "in another's body", "in a house", "on the roof"],
)
def test_an_antenna_inside_an_object_is_counted_and_named(
    traced: SionnaChannel, rx: AntennaDevice, car: Vector, counts: dict[str, int]
) -> None:
    users = {"no-path/inside-an-object": 1} if counts else {}
    bs = antenna("bs", (20.0, -20.0, 10.0), role="tx")
    assert causes(traced, scene(bs, rx, car=car)) == users | counts


@pytest.mark.parametrize(
    ("position", "cause"),
    [((0.0, 24.0, 1.0), "blocked"), ((0.0, 60.0, 1.0), "out-of-range"), ((20.0, 20.0, -3.0), "out-of-range")],
    ids=["behind the house", "behind it, beside the scenery", "below the ground"],
)
def test_places_that_no_ray_reaches_have_a_cause(traced: SionnaChannel, position: Vector, cause: str) -> None:
    town = scene(
        antenna("bs", (0.0, -20.0, 5.0), role="tx"), antenna("rx", position), car=(40.0, -40.0, 0.75)
    )
    assert causes(traced, town) == {f"no-path/{cause}": 1}
