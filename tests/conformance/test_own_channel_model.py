"""The channel model that docs/howto/channel-models.md shows is one, by the tests that all models pass."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import numpy as np

from caviar_protocol.space.coordinates import SPEED_OF_LIGHT
from caviar_protocol.topics import AntennaDevice, Carrier, Scene
from caviar_services.channel.paths import Antenna
from caviar_services.channel.propagation.patterns import Patterns
from caviar_services.service import RunInfo
from caviar_services.testing import ChannelConformance

PAGE = (Path(__file__).parents[2] / "docs" / "howto" / "channel-models.md").read_text("utf-8")


def shown() -> Any:
    """The first example of the page as a module."""
    code = re.findall(r"^```python\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)[0]
    made = ModuleType("own_channel_model")
    sys.modules[made.__name__] = made
    exec(compile(code, "channel-models.md", "exec"), vars(made))  # noqa: S102
    return made


OWN = shown()


class TestOwnModel(ChannelConformance):
    service_class = OWN.TwoRay
    settings: ClassVar[dict[str, Any]] = {"height_m": 0.1}
    test_importing_it_imports_nothing_heavy = None  # another process does not find a module without a file


def test_its_two_rays_add_up_to_the_formula() -> None:
    """λ/(4πd) on both, with a reflection coefficient of −1 across the plane of incidence."""
    ends = {"tx": (0.0, 0.0, 12.0), "rx": (80.0, 0.0, 3.0)}
    devices = [AntennaDevice(name=name, role=name, position=at) for name, at in ends.items()]  # type: ignore[arg-type]
    scene = Scene(
        names=(), classes=(), assets=(), devices=tuple(devices),
        position=np.zeros((0, 3)), orientation=np.zeros((0, 4)),
        velocity=np.zeros((0, 3)), dimensions=np.zeros((0, 3)),
    )  # fmt: skip
    tx, rx = ([Antenna.of(scene, device, Patterns())] for device in devices)
    run = RunInfo(name="channel", carriers=(Carrier(name="c", frequency_hz=2e9),))
    table = OWN.TwoRay(OWN.TwoRaySettings(height_m=1.0), run).paths(scene, tx, rx).table
    direct, reflected = np.hypot(80.0, 9.0), np.hypot(80.0, 11.0 + 2.0)
    wavelength = SPEED_OF_LIGHT / 2e9
    across = table.transfer[0, :, 1, 1]
    np.testing.assert_allclose(across, wavelength / (4 * np.pi) * np.array([1 / direct, -1 / reflected]))
    np.testing.assert_allclose(table.points[1, 0], [80.0 * 11 / 13, 0.0, 1.0])
