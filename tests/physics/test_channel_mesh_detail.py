"""Scenery of less detail in the traced channel: what is left out is gone, all else is as it was."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import pytest
from msgspec.structs import replace
from same_paths import digest

from caviar_labs.stability.lab import (
    Plate,
    antenna,
    carriers,
    measure,
    scene,
    sionna,
    write_scenery,
)
from caviar_protocol.errors import ScenarioError
from caviar_protocol.topics import Channel
from caviar_services.channel.sionna.model import SionnaChannel
from caviar_services.channel.sionna.settings import SionnaSettings
from caviar_services.service import Preparation, RunInfo

pytestmark = pytest.mark.channel

GROUND = Plate("ground", [(-90, -90, 0), (90, -90, 0), (90, 90, 0), (-90, 90, 0)])
WALL = Plate("wall", [(-20, 9, 0), (25, 9, 0), (25, 9, 11), (-20, 9, 11)])
SIGN = Plate("sign", [(-1, -4, 1), (2, -4, 1), (2, -4, 3.5), (-1, -4, 3.5)], "marble")
FAR = Plate("far", [(-60, -52, 0), (60, -52, 0), (60, -52, 40), (-60, -52, 40)])


def traced(folder: Path, plates: list[Plate], frequency: float = 28e9, **settings: Any) -> Channel:
    model = sionna(frequency, write_scenery(folder, plates), bodies=0, max_depth=2, **settings)
    devices = [
        antenna("t", "tx", (-6.5, 2.0, 4.1)),
        antenna("a", "rx", (9.0, 3.5, 1.6)),
        antenna("b", "rx", (4.2, -11.0, 2.2)),
    ]
    return measure(model, scene(devices))


def test_full_detail_is_that_without_the_setting(tmp_path: Path) -> None:
    """Bit by bit; and so is one that happens to leave nothing out, but for the order of vertices."""
    plates = [GROUND, WALL, SIGN]
    plain = digest(traced(tmp_path, plates))
    assert digest(traced(tmp_path, plates, detail={"smallest_m": 0})) == plain
    assert digest(traced(tmp_path, plates, detail={"smallest_m": 1.0})) == plain
    assert digest(traced(tmp_path, plates, detail={"tolerance_m": 1e-3})) == plain


def test_what_is_left_out_is_as_if_it_had_never_been(tmp_path: Path) -> None:
    """A sign of 3.9 m and a wall 61 m from the middle, as in a scenery that was written without them; the
    sign's material is not even needed at 95 GHz, where it is not defined."""
    detail = {"smallest_m": 4.0, "centre_m": (0.0, 9.0), "radius_m": 60.0}
    left = traced(tmp_path / "all", [GROUND, WALL, SIGN, FAR], 95e9, detail=detail)
    assert left.options.detail == f"4 of 8 triangles, {32895 / (32895 + 7.5 + 4800):.1%} of the area"
    untold = replace(left, options=replace(left.options, detail=""))
    assert digest(untold) == digest(traced(tmp_path / "some", [GROUND, WALL], 95e9))
    whole = traced(tmp_path / "all", [GROUND, WALL, SIGN, FAR], 28e9)
    assert {"sign", "far"} <= set(whole.object_names)
    assert len(whole.tau) > len(left.tau)


def prepared(folder: Path, **detail: Any) -> tuple[str, ...]:
    settings = msgspec.convert({"samples": 500, "bodies": 0, "detail": detail}, SionnaSettings)
    model = SionnaChannel(settings, RunInfo(name="channel", carriers=carriers(28e9)))
    return model.prepare(Preparation(demand={}, assets=write_scenery(folder, [WALL, SIGN]))).notes


def test_the_effect_is_a_note(tmp_path: Path) -> None:
    note = (
        "mesh detail: 2 of 4 triangles, 98.5% of the area; of 2 pieces 1 are left out as small and 0 as far"
    )
    assert note in prepared(tmp_path, smallest_m=4.0)
    assert not any("detail" in note for note in prepared(tmp_path))


def test_a_detail_that_changes_nothing_is_told_to_be_off(tmp_path: Path) -> None:
    assert any(note.startswith("detail is switched off: ") for note in prepared(tmp_path, smallest_m=1.0))
    assert traced(tmp_path, [WALL, SIGN], detail={"smallest_m": 1.0}).options.detail == ""


def test_a_detail_that_leaves_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"settings\.detail.*smallest_m=100"):
        prepared(tmp_path, smallest_m=100.0)
