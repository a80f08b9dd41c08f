"""Meshes that come while the run goes on, as rays of sensors meet them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caviar_protocol.assets import mesh_name
from caviar_protocol.topics import Depth, Scene
from caviar_services.sensors.base import Sensors, SensorSettings, TracedScene
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo
from caviar_space.meshes import box, joined, ply

pytestmark = [pytest.mark.slow, pytest.mark.channel]
pytest.importorskip("mitsuba")

STEP = joined([box((-0.5, 0.5), (-0.5, 0.5), (-0.5, 0.0)), box((0.0, 0.5), (-0.5, 0.5), (0.0, 0.5))])
"""Low in front and high behind: a ray at three quarters of the height meets it in its middle."""


class Range(Sensors[SensorSettings]):
    """The distance from the origin along +x, at three quarters of the object's height."""

    outputs = ("depth",)
    uses_scenery = True
    seen: float = 0.0

    def example_devices(self) -> tuple[()]:
        return ()

    def observe(self, mi: Any, traced: TracedScene, scene: Scene) -> dict[str, Any]:
        distance, _ = traced.intersect(mi, mi.Ray3f(mi.Point3f(0, 0, 1), mi.Vector3f(1, 0, 0)))
        self.seen = float(distance[0])
        return {"depth": Depth(images=())}


def frame(number: int, asset: str) -> Frame:
    """An object of 4 m × 2 m × 4 m, from 8 m on, whose mesh is this one."""
    from caviar_protocol.messages import GrantInput, Status

    scene = Scene(
        names=("step",),
        classes=("crate",),
        assets=(asset,),
        position=np.array([[10.0, 0.0, 0.0]]),
        orientation=np.array([[1.0, 0.0, 0.0, 0.0]]),
        velocity=np.zeros((1, 3)),
        dimensions=np.array([[4.0, 2.0, 4.0]]),
    )
    entry = GrantInput(topic="scene", source="world", status=Status.FRESH, frame=number)
    return Frame(episode=0, number=number, t_ns=0, inputs=(FrameInput(entry, payload=scene),))


def test_rays_meet_a_mesh_while_it_is_there_and_a_box_before_and_after(tmp_path: Path) -> None:
    content = ply(STEP)
    name, file = mesh_name(content), tmp_path / "step.ply"
    file.write_bytes(content)
    sensors = Range(SensorSettings(), RunInfo(name="range"))
    sensors.prepare(Preparation(demand={"depth": frozenset()}))
    seen = []
    for number, meshes in enumerate(({}, {name: file}, {name: file}, {})):
        sensors.use_meshes(meshes)
        sensors.step(frame(number, name))
        seen.append(sensors.seen)
    np.testing.assert_allclose(seen, [8.0, 10.0, 10.0, 8.0], rtol=1e-6)
    sensors.close()
