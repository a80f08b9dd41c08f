"""What is switched off finds the same paths, bit by bit, as what is left on; and products say what it was."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caviar_labs.stability.formulas import turn
from caviar_labs.stability.lab import (
    Plate,
    Thing,
    antenna,
    carriers,
    measure,
    scene,
    sionna,
    write_scenery,
)
from caviar_protocol.topics import Channel, Interaction
from caviar_services.channel.sionna import model as sionna_model
from caviar_services.channel.sionna.ray_launcher import LaunchOptions
from caviar_services.channel.sionna.settings import (
    SionnaSettings,
    SurfaceMaterial,
    UsedSurfaces,
    contributing,
)
from caviar_services.service import Preparation, RunInfo

pytestmark = pytest.mark.channel

CARRIERS = (28e9, 3.5e9)

KIND = {
    "refraction": Interaction.TRANSMISSION,
    "diffraction": Interaction.DIFFRACTION,
    "scattering": Interaction.SCATTERING,
}


def slanted(material: str, thickness: float = 0.1) -> list[Plate]:
    """Two plates at an angle, which share no corner."""
    side = turn(0.3, 0.2, 0.1)
    plates = [
        [[-40, -30, 0], [40, -30, 0], [40, 30, 0], [-40, 30, 0]],
        [[-30, 9, -2], [35, 9, -2], [35, 9, 12], [-30, 9, 12]],
    ]
    return [
        Plate(f"plate{i}", [(side @ corner).tolist() for corner in corners], material, thickness)
        for i, corners in enumerate(plates)
    ]


def left_on(
    options: LaunchOptions, surfaces: UsedSurfaces, frequencies: Sequence[float]
) -> tuple[LaunchOptions, tuple[str, ...]]:
    return options, ()


def both(
    monkeypatch: pytest.MonkeyPatch,
    assets: dict[str, Path],
    frequencies: Sequence[float] = CARRIERS,
    **settings: Any,
) -> tuple[Channel, Channel]:
    """The products with options switched off, and with all left on."""
    rng = np.random.default_rng(5)
    places = rng.uniform((-25, -20, 1), (25, 25, 15), (12, 3))
    devices = [
        antenna("t", "tx", (3.0, -7.0, 6.5)),
        *(antenna(f"r{i}", "rx", p) for i, p in enumerate(places)),
    ]
    things = [Thing("car", (4.0, 2.0, 1.5)), Thing("van", (-8.0, -1.0, 1.9), (6.0, 2.0, 2.6))]
    at = scene(devices, things if settings.get("bodies", 2) else ())
    off = measure(sionna(frequencies, assets, **settings), at)
    monkeypatch.setattr(sionna_model, "contributing", left_on)
    return off, measure(sionna(frequencies, assets, **settings), at)


def same_paths(a: Channel, b: Channel) -> bool:
    names = ("offsets", "id", "a", "tau", "aod", "aoa", "doppler", "interactions", "points", "objects", "los")
    return all(getattr(a, name).tobytes() == getattr(b, name).tobytes() for name in names)


@pytest.mark.parametrize(
    ("material", "thickness", "option", "more"),
    [
        pytest.param("metal", 0.1, "refraction", {}, marks=pytest.mark.exhaustive),
        ("concrete", 20.0, "refraction", {}),
        pytest.param("metal", 0.1, "refraction", {"reflection": False}, marks=pytest.mark.exhaustive),
        pytest.param("concrete", 0.1, "scattering", {}, marks=pytest.mark.exhaustive),
        ("glass", 0.1, "scattering", {"refraction": True}),
        pytest.param("concrete", 0.1, "diffraction", {"bodies": 0}, marks=pytest.mark.exhaustive),
    ],
)
def test_what_is_switched_off_would_have_found_nothing(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    material: str,
    thickness: float,
    option: str,
    more: dict[str, Any],
) -> None:
    assets = write_scenery(tmp_path, slanted(material, thickness))
    off, on = both(monkeypatch, assets, **{option: True, "max_depth": 2, **more})
    assert not getattr(off.options, option)
    assert getattr(on.options, option)
    assert same_paths(off, on)
    assert len(off.tau) > (0 if more.get("reflection") is False else 12)


def test_at_the_limit_of_what_is_sent_through_nothing_is_lost(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Plates just thick enough to switch refraction off, some −90 dB, and half a million rays."""
    thin, thick = 0.05, 0.5
    asked = LaunchOptions(
        max_depth=1,
        samples=1,
        max_paths=1,
        seed=0,
        reflection=True,
        refraction=True,
        diffraction=False,
        scattering=False,
    )
    permittivity, conductivity = 5.24, 0.0462 * 28**0.7822  # concrete, ITU-R P.2040-3, table 3
    while thick - thin > 1e-5:
        middle = (thin + thick) / 2
        plate = SurfaceMaterial(
            name="plate",
            constants=((permittivity, conductivity),),
            thickness_m=middle,
            scattering_coefficient=0.0,
        )
        if contributing(asked, UsedSurfaces(materials=(plate,), has_edges=True), (28e9,))[0].refraction:
            thin = middle
        else:
            thick = middle
    assets = write_scenery(tmp_path, slanted("concrete", thick))
    settings: dict[str, Any] = {"refraction": True, "max_depth": 2, "samples": 500_000}
    off, on = both(monkeypatch, assets, (28e9,), **settings)
    assert not off.options.refraction
    assert on.options.refraction
    assert same_paths(off, on)


def test_without_surfaces_nothing_is_launched(monkeypatch: pytest.MonkeyPatch) -> None:
    """All options fall away, and the products say so: the direct paths are left."""
    off, on = both(monkeypatch, {}, bodies=0, refraction=True, diffraction=True, max_depth=3)
    assert (off.options.reflection, off.options.max_depth, on.options.max_depth) == (False, 0, 3)
    assert same_paths(off, on)
    assert len(off.tau) == 12


@pytest.mark.parametrize(
    ("material", "thickness", "settings"),
    [
        pytest.param("concrete", 0.1, {"refraction": True}, marks=pytest.mark.exhaustive),
        pytest.param("metal", 0.1, {"diffraction": True}, marks=pytest.mark.exhaustive),
        (
            "concrete",
            0.1,
            {"scattering": True, "materials": {"skin-plate1": {"scattering_coefficient": 0.4}}},
        ),
    ],
)
def test_what_finds_paths_is_left_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, material: str, thickness: float, settings: dict[str, Any]
) -> None:
    """A plate that some passes through, a body with edges, one rough plate of two."""
    option = next(iter(settings))
    assets = write_scenery(tmp_path, slanted(material, thickness))
    on, _ = both(monkeypatch, assets, **settings, max_depth=2)
    assert getattr(on.options, option)
    assert (on.interactions == KIND[option]).any()


def test_each_switch_is_a_note(tmp_path: Path) -> None:
    settings = SionnaSettings(samples=500, bodies=1, refraction=True, scattering=True, diffraction=True)
    model = sionna_model.SionnaChannel(settings, RunInfo(name="channel", carriers=carriers(28e9)))
    assets = write_scenery(tmp_path, slanted("concrete", 0.3))
    notes = [
        note for note in model.prepare(Preparation(demand={}, assets=assets)).notes if "switched off" in note
    ]
    assert notes == [
        "warning: scattering is switched off: no material has a scattering_coefficient above 0",
        (
            "warning: refraction is switched off: no ray is ever sent through a material "
            "(skin-plate0 −136 dB, skin-plate1 −136 dB, body_material −∞ dB at most)"
        ),
    ]
    assert model.options.diffraction
