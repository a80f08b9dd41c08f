"""Which options can contribute: slabs, edges, and what is said about each switch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from caviar_services.channel.sionna.ray_launcher import LaunchOptions
from caviar_services.channel.sionna.settings import (
    SurfaceMaterial,
    UsedSurfaces,
    contributing,
    slab,
)

ASKED = LaunchOptions(
    max_depth=3,
    samples=1000,
    max_paths=1000,
    seed=1,
    reflection=True,
    refraction=True,
    diffraction=True,
    scattering=True,
)
C, EPSILON_0, MU_0 = 299_792_458.0, 8.8541878128e-12, 1.25663706212e-6


def made_of(*constants: tuple[float, float], thickness: float = 0.1, rough: float = 0.0) -> SurfaceMaterial:
    return SurfaceMaterial(
        name="skin", constants=constants, thickness_m=thickness, scattering_coefficient=rough
    )


def surfaces(*materials: SurfaceMaterial, edges: bool = True) -> UsedSurfaces:
    return UsedSurfaces(materials=materials, has_edges=edges)


METAL = made_of((1.0, 1e7))
GLASS = made_of((6.31, 0.3))


def through_layers(angle: float, eta: complex, thickness: float, frequency: float, te: bool) -> complex:
    """Transmission by way of the wave matrix of a layer (M. Born, E. Wolf, "Principles of Optics",
    section 1.6.2): tangential fields at both faces."""
    k0 = 2 * np.pi * frequency / C
    normal = np.sqrt(eta - np.sin(angle) ** 2 + 0j)
    beta = k0 * thickness * normal
    inside, outside = (normal, np.cos(angle)) if te else (normal / eta, np.cos(angle))
    m = np.array(
        [[np.cos(beta), 1j * np.sin(beta) / inside], [1j * inside * np.sin(beta), np.cos(beta)]], complex
    )
    e, h = m @ np.array([1.0, outside])
    return complex(2 * outside / (outside * e + h))


def test_a_slab_is_that_of_the_wave_matrix() -> None:
    """Random lossy slabs at random angles and frequencies, TE and TM: within 1e-9."""
    rng = np.random.default_rng(2)
    for _ in range(50):
        permittivity, conductivity = rng.uniform(1.1, 9), 10 ** rng.uniform(-3, 0)
        frequency, thickness, angle = (
            10 ** rng.uniform(8.7, 10.5),
            rng.uniform(1e-3, 0.1),
            rng.uniform(0, 1.5),
        )
        eta = permittivity - 1j * conductivity / (2 * np.pi * frequency * EPSILON_0)
        _, got = slab(np.array([np.cos(angle)]), (permittivity, conductivity), thickness, frequency)
        for row, te in enumerate((True, False)):
            expected = through_layers(angle, eta, thickness, frequency, te)
            assert abs(got[row, 0] - expected) < 1e-9 * max(1.0, abs(expected))


def test_a_lossless_slab_loses_nothing() -> None:
    back, through = slab(np.cos(np.linspace(0, 1.55, 40)), (4.2, 0.0), 0.03, 28e9)
    assert np.allclose(np.abs(back) ** 2 + np.abs(through) ** 2, 1.0, atol=1e-12)


def test_all_that_contribute_stay() -> None:
    rough = made_of((6.31, 0.3), rough=0.2)
    assert contributing(ASKED, surfaces(METAL, rough), (28e9,)) == (ASKED, ())


def test_only_what_was_asked_for_is_switched_off() -> None:
    asked = replace(ASKED, scattering=False, refraction=False)
    left, notes = contributing(asked, surfaces(METAL, edges=False), (28e9,))
    assert left == replace(asked, diffraction=False)
    assert notes == ("warning: diffraction is switched off: no two faces meet at an edge",)


def test_a_material_counts_on_every_carrier() -> None:
    """One that blocks 28 GHz and passes 2 GHz keeps refraction on."""
    asked = replace(ASKED, scattering=False)
    both = surfaces(made_of((5.0, 30.0), (5.0, 0.01)))
    assert contributing(asked, both, (28e9, 2e9))[0].refraction
    assert not contributing(asked, surfaces(made_of((5.0, 30.0))), (28e9,))[0].refraction


def test_where_nothing_is_reflected_the_faintest_transmission_counts() -> None:
    """All rays then go on through, however little of them."""
    wall = surfaces(made_of((5.0, 2.0)))
    asked = replace(ASKED, scattering=False)
    assert not contributing(asked, wall, (28e9,))[0].refraction
    assert contributing(replace(asked, reflection=False), wall, (28e9,))[0].refraction


@pytest.mark.parametrize(
    ("asked", "found", "reason"),
    [
        (replace(ASKED, max_depth=0), surfaces(GLASS), "max_depth is 0"),
        (ASKED, UsedSurfaces(materials=(), has_edges=False), "there is neither scenery nor a body"),
    ],
)
def test_without_interactions_nothing_is_launched(
    asked: LaunchOptions, found: UsedSurfaces, reason: str
) -> None:
    left, notes = contributing(asked, found, (28e9,))
    assert left == replace(
        asked, max_depth=0, reflection=False, refraction=False, diffraction=False, scattering=False
    )
    assert [note.rpartition(": ")[2] for note in notes] == [reason] * 4


def test_a_launch_of_nothing_has_no_depth() -> None:
    asked = replace(ASKED, reflection=False, refraction=False, diffraction=False)
    left, notes = contributing(asked, surfaces(METAL), (28e9,))
    assert (left.scattering, left.max_depth, len(notes)) == (False, 0, 1)
