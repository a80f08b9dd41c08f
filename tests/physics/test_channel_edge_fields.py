"""Amplitudes of diffracted paths: the same wherever a scene stands, continuous, and Sommerfeld's."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caviar_labs.stability.formulas import EPSILON_0, C, turn, unit
from caviar_labs.stability.lab import (
    Array,
    Plate,
    Thing,
    antenna,
    measure,
    scene,
    sionna,
    write_scenery,
)
from caviar_protocol.space.coordinates import quaternion_from_euler
from caviar_protocol.topics import Interaction
from caviar_services.channel.propagation import utd as module
from caviar_services.channel.propagation.utd import Media, edge_fields, wedges_of
from caviar_services.channel.sionna import path_table

pytestmark = pytest.mark.channel

DIFFRACTED = int(Interaction.DIFFRACTION)
ROOF, SIDE = 1.51, 0.9

SENDERS = ((-11.3, 1.2, 6.0), (-11.3, 1.2, ROOF), (-11.3, SIDE, 6.0), (-11.3, SIDE, ROOF), (-30.0, 0.0, 1.6))
"""Where nothing is special; in the plane of the roof, of a side, of both; and near the roof's plane."""
RECEIVERS = (
    *((9.0, 0.5, 1.2), (14.0, -2.0, 1.5), (9.0, 0.93, 1.2), (2.25, 7.0, 1.0), (-2.25, 8.0, 1.0)),
    *((5.0, -3.0, ROOF), (1.1, 7.3, 2.4), (20.0, 0.3, 0.8), (3.0, -5.0, 0.4), (7.0, 2.0, ROOF)),
)

FAINT = 1e-10
"""Amplitude; a ray in the plane of a face may bend by none."""

Levels = dict[tuple[Any, ...], float]


def diffracted_levels(
    folder: Path, middle: Array, offset: Array, yaw: float, body: str = "metal", max_depth: int = 3
) -> Levels:
    """Level [dB] of each diffracted path about a car, by sender, receiver, interactions and place; the
    ground's middle lies off the car, and all is turned and then moved."""
    turned = turn(yaw, 0, 0)
    ground = [
        offset + turned @ (middle + corner)
        for corner in np.array([(-300, -300, 0), (300, -300, 0), (300, 300, 0), (-300, 300, 0)], float)
    ]
    model = sionna(
        28e9,
        write_scenery(folder, [Plate("ground", ground)]),
        diffraction=True,
        max_depth=max_depth,
        samples=100_000,
        body_material=body,
    )
    car = Thing("car", offset + turned @ [0, 0, 0.76], quaternion=quaternion_from_euler(yaw))
    found: Levels = {}
    for sender, place in enumerate(SENDERS):
        devices = [antenna("t", "tx", offset + turned @ place)]
        devices += [antenna(f"r{i}", "rx", offset + turned @ at) for i, at in enumerate(RECEIVERS)]
        channel = measure(model, scene(devices, [car]))
        pairs = np.repeat(np.arange(len(RECEIVERS)), np.diff(channel.offsets))
        for path in np.flatnonzero((channel.interactions == DIFFRACTED).any(1)):
            at = (channel.points[path] - offset) @ turned * (channel.interactions[path] != 0)[:, None]
            key = (
                *(sender, int(pairs[path])),
                *filter(None, channel.interactions[path].tolist()),
                *(np.round(at[channel.interactions[path] == DIFFRACTED][0] + 0.017, 1) + 0.0).tolist(),
            )
            found[key] = float(20 * np.log10(max(abs(channel.a[0, path]), FAINT)))
    return found


@pytest.mark.parametrize("body", [pytest.param("metal", marks=pytest.mark.exhaustive), "concrete"])
def test_a_diffracted_path_is_as_strong_wherever_the_scene_stands(tmp_path: Path, body: str) -> None:
    """A car on open ground, the scenery's middle off it, and all of it moved by up to 12 km and turned:
    every diffracted path that is found in both has the same level to 0.001 dB, also in the planes of faces.
    Where nothing is turned, all but those over an edge's end are found; turned, other rays meet the car."""
    cases = [
        ((0, 0, 0), (0, 0, 0), 0.0),
        ((-60.3, 141.7, 0), (1000.0, -430.0, 0), 0.0),
        ((15.0, -90.0, 0), (-9000.0, 7000.0, 0), 0.4),
    ]
    found = [
        diffracted_levels(tmp_path / str(i), np.array(m, float), np.array(o, float), yaw, body)
        for i, (m, o, yaw) in enumerate(cases)
    ]
    for other, (_, _, yaw) in zip(found[1:], cases[1:], strict=True):
        both = found[0].keys() & other.keys()
        assert len(both) > (0.5 if yaw else 0.95) * len(found[0]) > 25
        assert max(abs(found[0][key] - other[key]) for key in both) < 1e-3


def test_levels_do_not_depend_on_how_deep_is_traced(tmp_path: Path) -> None:
    """Paths over an edge alone, which any depth finds."""
    one, three = (
        diffracted_levels(tmp_path / str(d), np.array([70.0, -20, 0]), np.zeros(3), 0.2, max_depth=d)
        for d in (1, 3)
    )
    alone = {key[:2] + key[-3:]: level for key, level in three.items() if len(key) == 6}
    single = {key[:2] + key[-3:]: level for key, level in one.items()}
    both = alone.keys() & single.keys()
    assert len(both) > 20
    assert max(abs(alone[key] - single[key]) for key in both) < 1e-6


@pytest.fixture
def both_fields(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Array, Array]]:
    """The ray tracer's dyads of diffracted paths of full depth, and what they are replaced by."""
    seen: list[tuple[Array, Array]] = []
    replaced = path_table._diffract_anew

    def keep(scene_: Any, edges: Any, met: Any, *others: Any) -> Any:
        before = met.transfer.copy()
        found = replaced(scene_, edges, met, *others)
        rows = (met.types == DIFFRACTED).any(1) & (met.types != 0).all(1) & found[0]
        seen.append((before[:, rows], met.transfer[:, rows]))
        return found

    monkeypatch.setattr(path_table, "_diffract_anew", keep)
    monkeypatch.setattr(module, "_SIGN", 1.0)  # the ray tracer's, which is wrong
    return seen


@pytest.mark.parametrize(
    "depth", [pytest.param(1, marks=pytest.mark.exhaustive), 2, pytest.param(3, marks=pytest.mark.exhaustive)]
)
def test_but_for_a_sign_fields_are_those_of_the_ray_tracer_where_its_legs_are_right(
    tmp_path: Path, both_fields: list[tuple[Array, Array]], depth: int
) -> None:
    """Paths of as many interactions as are traced, about bodies that stand askew, by way of plates of three
    materials: dyads are equal to 1e-3 of their largest entry on two carriers, three in four to 1e-5."""
    slope = turn(0, 0.004, 0.003)
    plates = [
        Plate(
            "ground", [slope @ np.array(c) for c in [(-99, -99, 0), (99, -99, 0), (99, 99, 0), (-99, 99, 0)]]
        ),
        Plate("wall", [(-40, 12, -2), (35, 14, -2), (35, 14, 12), (-40, 12, 12)], "glass"),
        Plate("fence", [(3, -20, -1), (3.5, 20, -1), (3.5, 20, 3.0), (3, -20, 3.0)], "wood", 0.03),
    ]
    model = sionna(
        [5e9, 28e9],
        write_scenery(tmp_path, plates),
        diffraction=True,
        refraction=True,
        max_depth=depth,
        samples=100_000,
        body_material="concrete",
    )
    rng = np.random.default_rng(4)
    things = [
        Thing("car", (0, 0, 0.9), quaternion=quaternion_from_euler(0.5, 0.1, 0.07)),
        Thing("van", (-6, 3, 1.6), (5.5, 2, 2.4), quaternion=quaternion_from_euler(-1.1, 0.03, 0)),
    ]
    places = rng.uniform((-15, -9, 0.4), (15, 9, 5), (25, 3))
    devices = [antenna(f"r{i}", "rx", place) for i, place in enumerate(places[1:])]
    measure(model, scene([antenna("t", "tx", places[0]), *devices], things))
    ((traced, anew),) = [pair for pair in both_fields if pair[0].size]
    off = np.abs(anew - traced).max((2, 3)) / np.abs(traced).max((2, 3))
    assert off.shape[1] > 5
    assert off.max() < 1e-3
    assert np.quantile(off, 0.75) < 1e-5


def wedge(interior: float, length: float = 100.0) -> Array:
    """Two faces that meet along z, one along +x and the other turned from it by −``interior``."""
    low, high = np.array([0.0, 0, -length]), np.array([0.0, 0, length])
    along = np.array([1.0, 0, 0]), np.array([np.cos(interior), -np.sin(interior), 0])
    return np.array([[low, high, side * length] for side in along])


def edge_of(triangles: Array) -> tuple[Array, Array]:
    """Ends of the edge that comes first in both of two triangles, and their other corners."""
    return triangles[None, 0, :2], triangles[None, :, 2]


def made_of(eta: float) -> Media:
    """High conductivity, or permittivity ``eta``."""
    slab = eta if np.isfinite(eta) else 1.0, 0.1 if np.isfinite(eta) else 1e12
    return Media(*(np.full((1, 1, 1), x) for x in slab), *(np.full((1, 1), x) for x in (1e3, 0.0)))


def over_edge(angle: float, at: float, interior: float, eta: float, along_edge: bool) -> complex:
    """Field over the edge of a wedge of high conductivity or of permittivity ``eta``, along it or across."""
    places = [leg * np.array([np.cos(a), np.sin(a), 0.0]) for leg, a in ((S_IN, at), (S_OUT, angle))]
    faces, is_edge = wedges_of(*edge_of(wedge(interior)))
    assert is_edge.all()
    media = made_of(eta)
    corners = np.array([[places[0], np.zeros(3), places[1]]])
    types = np.array([[DIFFRACTED]], np.uint8)
    dyad = edge_fields(corners, types, np.array([[[0.0, 1, 0]]]), faces, media, media, [WAVELENGTH])[0, 0]
    up = np.array([0.0, 0, 1])
    sent, taken = (up, up) if along_edge else (np.cross(up, -places[0]), np.cross(up, places[1]))
    return complex(unit(taken) @ dyad @ unit(sent)) * np.exp(-2j * np.pi / WAVELENGTH * (S_IN + S_OUT))


S_IN, S_OUT, WAVELENGTH = 40.0, 25.0, 0.1


def straight(length: float) -> complex:
    return complex(WAVELENGTH / (4 * np.pi * length) * np.exp(-2j * np.pi / WAVELENGTH * length))


@pytest.mark.parametrize("along_edge", [True, False])
@pytest.mark.parametrize("eta", [np.inf, 5.0])
@pytest.mark.parametrize("interior", [0.0, 0.5, np.pi / 2, 2.0])
def test_the_field_is_continuous_where_light_and_reflection_end(
    interior: float, eta: float, along_edge: bool
) -> None:
    """Direct, reflected (Fresnel) and diffracted wave together, on both sides of both boundaries, of a
    conductor and a dielectric, to 3 % of the direct wave."""
    at = 0.6
    for boundary in (np.pi + at, np.pi - at):
        if boundary > 2 * np.pi - interior:
            continue
        totals = []
        for angle in (boundary - 1e-5, boundary + 1e-5):
            total = over_edge(angle, at, interior, eta, along_edge)
            tx, rx = (
                S_IN * np.array([np.cos(at), np.sin(at)]),
                S_OUT * np.array([np.cos(angle), np.sin(angle)]),
            )
            if angle < np.pi + at:
                total += straight(float(np.linalg.norm(rx - tx)))
            if angle < np.pi - at:
                cosine = np.sin(at)
                lossy = eta - 0.1j / (2 * np.pi * C / WAVELENGTH * EPSILON_0) if np.isfinite(eta) else 1e30
                root = np.sqrt(lossy - (1 - cosine**2))
                te = (cosine - root) / (cosine + root)
                tm = (lossy * cosine - root) / (lossy * cosine + root)
                total += (te if along_edge else tm) * straight(float(np.linalg.norm(rx - tx * [1, -1])))
            totals.append(total)
        assert abs(totals[0] - totals[1]) < 0.03 * abs(straight(S_IN + S_OUT))


def test_behind_a_half_plane_is_sommerfelds_field() -> None:
    """A conducting half-plane, E along its edge, deep in the shadow: within 2 % of the solution of
    A. Sommerfeld (1896), asymptotically exp(−jπ/4)/(2·sqrt(2πk))·(sec((φ−φ')/2) − sec((φ+φ')/2))."""
    at = 1.1
    for angle in (5.2, 5.5, 5.8):
        secants = 1 / np.cos((angle - at) / 2) - 1 / np.cos((angle + at) / 2)
        d = abs(secants) / (2 * np.sqrt(4 * np.pi**2 / WAVELENGTH))
        expected = WAVELENGTH / (4 * np.pi) * d / np.sqrt(S_IN * S_OUT * (S_IN + S_OUT))
        assert abs(over_edge(angle, at, 0.0, np.inf, True)) == pytest.approx(expected, rel=0.02)


def test_what_has_no_length_or_no_width_is_no_wedge() -> None:
    ends, apexes = edge_of(wedge(1.0))
    assert not wedges_of(ends[:, :1].repeat(2, 1), apexes)[1].any()
    assert not wedges_of(ends, np.stack([apexes[:, 0], ends[:, 0]], axis=1))[1].any()


def test_each_face_of_an_edge_has_its_own_material() -> None:
    """Deep in the shadow of neither face, of a wedge of a conductor and a dielectric: between the fields of
    wedges of one of these, and the same from the other side with the materials swapped."""
    faces, _ = wedges_of(*edge_of(wedge(np.pi / 2)))
    places = [leg * np.array([np.cos(a), np.sin(a), 0.0]) for leg, a in ((S_IN, 1.9), (S_OUT, 2.9))]
    types, normal = np.array([[DIFFRACTED]], np.uint8), np.array([[[0.0, 1, 0]]])

    def level(first: float, second: float, path: list[Array]) -> complex:
        corners = np.array([[path[0], np.zeros(3), path[1]]])
        dyad = edge_fields(corners, types, normal, faces, made_of(first), made_of(second), [WAVELENGTH])
        return complex(dyad[0, 0, 2, 2])

    alike = [level(eta, eta, places) for eta in (np.inf, 5.0)]
    mixed = level(np.inf, 5.0, places)
    assert min(abs(mixed - one) for one in alike) > 1e-3 * abs(mixed)
    # The wedge is its own mirror image about the plane between both faces, which swaps these.
    mirror = np.array([[0.0, -1, 0], [-1, 0, 0], [0, 0, 1]])
    assert level(5.0, np.inf, [mirror @ place for place in places]) == pytest.approx(mixed, rel=1e-9)


def test_faces_look_outward_from_a_wedge_that_stands_anywhere() -> None:
    rng = np.random.default_rng(2)
    for interior in (0.3, 1.2, 2.7):
        moved = wedge(interior) @ turn(*rng.uniform(-3, 3, 3)).T + rng.uniform(-1e4, 1e4, 3)
        faces, is_edge = wedges_of(*edge_of(moved))
        assert is_edge.all()
        assert faces.exterior[0] == pytest.approx(2 * np.pi - interior, abs=1e-9)
        middle = unit(moved[:, 2].mean(0) - moved[0, :2].mean(0))
        outward = faces.normals[0].sum(0)
        assert outward @ middle < 0
