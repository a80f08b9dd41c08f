"""Several carriers in one ray-traced product are what each of them is in a run of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caviar_labs.stability.formulas import (
    itu_permittivity,
    mirrored,
    reflected,
    spherical_wave,
    unit,
    vertical,
)
from caviar_labs.stability.lab import Plate, Thing, antenna, measure, scene, sionna, write_scenery
from caviar_protocol.space.coordinates import quaternion_from_euler
from caviar_protocol.topics import AntennaArray, Scene

pytestmark = pytest.mark.channel

FREQUENCIES = (3.5e9, 28e9)
PLATES = [
    Plate("ground", [(-300, -300, 0), (300, -300, 0), (300, 300, 0), (-300, 300, 0)], thickness=0.2),
    Plate("wall", [(-40, 14, 0), (70, 21, 0), (70, 21, 25), (-40, 14, 25)], "glass", thickness=0.01),
]


def street(shift: float) -> Scene:
    """Two stations, two receivers, one on a moving body, over ground beside a thin slanted wall."""
    car = Thing(
        "car", (14.0 + shift, -3.0, 0.8), quaternion=quaternion_from_euler(0.4), velocity=(9.0, 1.0, 0.0)
    )
    station = AntennaArray(columns=4)
    return scene(
        [
            antenna("s", "tx", (-21, -6, 8.5), station),
            antenna("t", "tx", (33, 4, 6.0)),
            antenna("car/r", "rx", (0.3, 0.1, 1.4), AntennaArray(columns=2), parent="car"),
            antenna("x", "rx", (19, 2.5, 1.7)),
        ],
        [car],
    )


@pytest.mark.parametrize(
    "options",
    [
        pytest.param({"max_depth": 2, "diffraction": True}, marks=pytest.mark.exhaustive),
        {"max_depth": 1, "reflection": False, "refraction": True},
    ],
    ids=["reflection and diffraction", "refraction"],
)
def test_carriers_are_what_each_is_alone(tmp_path: Path, options: dict[str, Any]) -> None:
    """Paths, amplitudes, Doppler shifts and matrices, bit by bit, in frames one after the other."""
    assets = write_scenery(tmp_path, PLATES)
    settings = {"body_material": "glass", "outside_itu_range": "nearest", **options}
    both = sionna(FREQUENCIES, assets, **settings)
    alone = [sionna(frequency, assets, **settings) for frequency in FREQUENCIES]
    for shift in (0.0, 3.0):
        world = street(shift)
        shared = measure(both, world)
        assert len(shared.tau) >= 4
        for c, model in enumerate(alone):
            single = measure(model, world)
            mine = np.abs(shared.a[c]) > 0
            for field in ("id", "tau", "aod", "aoa", "interactions", "points"):
                assert np.array_equal(getattr(shared, field)[mine], getattr(single, field)), field
            assert np.array_equal(shared.a[c, mine], single.a[0])
            assert np.array_equal(shared.doppler[c, mine], single.doppler[0])
            assert shared.los.tolist() == single.los.tolist()
            of_carrier = [matrix for matrix in shared.h if matrix.carrier == c]
            for matrix, same in zip(of_carrier, single.h, strict=True):
                np.testing.assert_allclose(matrix.h, same.h, rtol=1e-12)


def test_each_carrier_meets_the_ground_with_its_own_constants(tmp_path: Path) -> None:
    """Reflection at ITU concrete, whose conductivity rises with frequency, within 1e-3 of Fresnel."""
    model = sionna((1.5e9, 60e9), write_scenery(tmp_path, [Plate("ground", PLATES[0].corners)]), max_depth=1)
    tx, rx = np.array([-9.0, 4.0, 6.0]), np.array([31.0, -8.0, 11.0])
    channel = measure(model, scene([antenna("t", "tx", tx), antenna("r", "rx", rx)]))
    assert channel.interactions[:, 0].tolist() == [0, 1]
    up = np.array([0.0, 0.0, 1.0])
    image = mirrored(tx, np.zeros(3), up)
    k_out = unit(rx - image)
    k_in = k_out * [1, 1, -1]
    for c, frequency in enumerate((1.5e9, 60e9)):
        eta = itu_permittivity(5.24, 0.0, 0.0462, 0.7822, frequency)
        arrived = vertical(-k_out) @ reflected(vertical(k_in), k_in, up, eta)
        expected = spherical_wave(float(np.linalg.norm(rx - image)), frequency) * arrived
        assert channel.a[c, 1] == pytest.approx(expected, rel=2e-3)


def test_no_frame_with_two_carriers_compiles_a_kernel(tmp_path: Path) -> None:
    """Also not the first: all kernels of both carriers are there when it begins."""
    import drjit as dr

    model = sionna(FREQUENCIES, write_scenery(tmp_path, PLATES), receivers_at_once=2, max_depth=2)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for shift in (0.0, 3.0, -5.0):
            measure(model, street(shift))
        history = dr.kernel_history([dr.KernelType.JIT])
        dr.kernel_history_clear()
    assert len(history) > 10
    assert not [entry["operation_count"] for entry in history if not entry["cache_hit"]]
