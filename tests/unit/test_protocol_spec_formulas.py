"""What SPEC.md says about matrices, beams and noise, held against what services compute."""

from __future__ import annotations

import math

import numpy as np
import pytest

from caviar_protocol.arrays import Float64Array
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.multipath import first_tap
from caviar_protocol.space.beams import straight_beams
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT, quaternion_from_euler, rotation_matrix
from caviar_protocol.topics import AntennaArray, AntennaDevice, Carrier, Channel, Panel, Scene
from caviar_services.channel.statistical.free_space import FreeSpaceChannel, FreeSpaceSettings
from caviar_services.link.beams import BeamLinkSettings
from caviar_services.link.link_budget import noise_power
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo

CARRIERS = (Carrier(name="low", frequency_hz=3.5e9), Carrier(name="high", frequency_hz=28e9))
PANELS = (Panel(position_m=(0.02, 0.3, 0.1)), Panel(position_m=(0.0, -0.25, 0.0)))


def elements(device: AntennaDevice, wavelength: float) -> Float64Array:
    """Places of elements from the reference point of a device without a parent, in world axes, ``[N, 3]``."""
    array, found = device.array, []
    for panel in array.panels or (Panel(),):
        for i in range(array.rows * array.columns):
            y = (i // array.rows - (array.columns - 1) / 2) * array.horizontal_spacing * wavelength
            z = ((array.rows - 1) / 2 - i % array.rows) * array.vertical_spacing * wavelength
            found.append(np.array(panel.position_m) + np.array([0.0, y, z]))
    return np.array(found) @ rotation_matrix(device.orientation).T


def unit(angles: Float64Array) -> Float64Array:
    zenith, azimuth = angles
    return np.array(
        [math.sin(zenith) * math.cos(azimuth), math.sin(zenith) * math.sin(azimuth), math.cos(zenith)]
    )


def test_matrices_follow_from_paths_as_the_specification_says() -> None:
    """Panels are moved and not turned, so that all elements have the same gain."""
    devices = (
        AntennaDevice(
            name="bs",
            role="tx",
            position=(1.0, -2.0, 9.0),
            orientation=quaternion_from_euler(0.7, 0.2, -0.3),
            array=AntennaArray(rows=2, columns=3, horizontal_spacing=0.6, panels=PANELS),
        ),
        AntennaDevice(
            name="rx",
            role="rx",
            position=(40.0, 13.0, 1.5),
            orientation=quaternion_from_euler(2.5, -0.1, 0.4),
            array=AntennaArray(rows=3, vertical_spacing=0.4),
        ),
    )
    nothing = {name: np.zeros((0, size)) for name, size in
               {"position": 3, "orientation": 4, "velocity": 3, "dimensions": 3}.items()}  # fmt: skip
    scene = Scene(names=(), classes=(), assets=(), devices=devices, **nothing)
    model = FreeSpaceChannel(FreeSpaceSettings(), RunInfo(name="channel", carriers=CARRIERS))
    model.prepare(Preparation(demand={"channel": frozenset({"h"})}))
    entry = FrameInput(GrantInput(topic="scene", source="w", status=Status.FRESH, frame=0), payload=scene)
    channel = model.step(Frame(episode=0, number=0, t_ns=0, inputs=(entry,))).products["channel"]
    assert isinstance(channel, Channel)
    for carrier, matrix in zip(CARRIERS, channel.h, strict=True):
        wavelength = SPEED_OF_LIGHT / carrier.frequency_hz
        sent = elements(devices[0], wavelength) @ unit(channel.aod[0])
        taken = elements(devices[1], wavelength) @ unit(channel.aoa[0])
        phases = np.exp(2j * np.pi / wavelength * (taken[:, None] + sent[None, :]))
        np.testing.assert_allclose(matrix.h, channel.a[matrix.carrier, 0] * phases, rtol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_the_beams_along_the_straight_line_are_those_of_the_specification(seed: int) -> None:
    rng = np.random.default_rng(seed)
    panels = (Panel(), Panel(yaw_deg=180.0))
    one = AntennaArray(rows=4, columns=8, vertical_spacing=0.7)
    two = AntennaArray(rows=2, columns=5, polarization="cross", panels=panels)
    for _ in range(50):
        ends = rng.normal(size=(2, 3))
        (x0, y0, z0), (x1, y1, z1) = (end / np.linalg.norm(end) for end in ends)
        sent = round(-4 * 0.7 * z0) % 4 + 4 * (round(8 * 0.5 * y0) % 8)
        panel, left = (0, y1) if x1 > 0 else (1, -y1)  # the one that faces the other end; its own axis y
        # V couples to −45° as to +45°, and so to the first.
        taken = 20 * panel + round(-2 * 0.5 * z1) % 2 + 2 * (round(5 * 0.5 * left) % 5)
        beams = straight_beams(one, (x0, y0, z0), two, (x1, y1, z1))
        assert beams == (sent, taken)
    crossed = straight_beams(two, (1.0, 0.0, 0.0), two, (1.0, 0.0, 0.0))
    assert crossed == (0, 10)


def test_noise_and_the_first_tap_are_those_of_the_specification() -> None:
    settings, carrier = BeamLinkSettings(), Carrier(name="c", frequency_hz=28e9, bandwidth_hz=50e6)
    noise = noise_power(carrier, settings.noise_figure_db, settings.temperature_k)
    assert noise == pytest.approx(1.380649e-23 * 290 * 50e6 * 10**0.9)
    assert first_tap(carrier, np.array([2e-6, 41e-9])) == math.floor(50e6 * 41e-9) - 6 == -4
    assert first_tap(carrier, np.zeros(0)) == 0
