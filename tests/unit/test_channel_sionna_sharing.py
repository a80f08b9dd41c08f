"""Scenes are shared by those who ask for the same, for as long as that was wished."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from caviar_services.channel.sionna import scene
from caviar_services.channel.sionna.scene import SceneSettings, scene_of, shared_scenes
from caviar_space.materials import MaterialPolicy, MaterialSettings

ASSETS = {"scenery/scene.xml": Path("/a/scene.xml")}


def settings(**changes: Any) -> SceneSettings:
    plain: dict[str, Any] = {
        "frequencies_hz": (28e9,),
        "body_material": "metal",
        "materials": MaterialPolicy(),
        "edges": True,
    }
    return SceneSettings(**plain | changes)


@pytest.fixture(autouse=True)
def no_ray_tracer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scenes that are only what they were made of."""
    monkeypatch.setattr(scene, "SionnaScene", lambda *made: [*made])


def test_equal_requests_get_one_scene() -> None:
    with shared_scenes():
        first = scene_of(ASSETS, {"": 3}, settings())
        assert scene_of(dict(ASSETS), {"": 3}, settings()) is first


@pytest.mark.parametrize(
    ("assets", "pool", "other"),
    [
        ({"scenery/scene.xml": Path("/b/scene.xml")}, {"": 3}, {}),
        (ASSETS, {"": 4}, {}),
        (ASSETS, {"": 3}, {"free_edges": True}),
        (ASSETS, {"": 3}, {"frequencies_hz": (28e9, 60e9)}),
        (ASSETS, {"": 3}, {"materials": MaterialPolicy(changes={"wall": MaterialSettings(thickness_m=1)})}),
    ],
)
def test_other_requests_get_another(assets: dict[str, Path], pool: dict[str, int], other: Any) -> None:
    with shared_scenes():
        first = scene_of(ASSETS, {"": 3}, settings())
        assert scene_of(assets, pool, settings(**other)) is not first


def test_outside_nothing_is_shared_or_kept() -> None:
    with shared_scenes():
        inside = scene_of(ASSETS, {}, settings())
    assert scene_of(ASSETS, {}, settings()) is not inside
    assert scene_of(ASSETS, {}, settings()) is not scene_of(ASSETS, {}, settings())
    with shared_scenes():
        assert scene_of(ASSETS, {}, settings()) is not inside
