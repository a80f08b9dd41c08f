"""DFT beams against independent formulas, on the free-space channel between turned arrays."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from caviar_protocol.arrays import Float64Array, Payload
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.space.antenna_arrays import dft_codebook, element_positions, steering_vector
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT, quaternion_from_euler, rotation_matrix
from caviar_protocol.topics import Action, AntennaArray, AntennaDevice, Carrier, Channel, Link, Scene
from caviar_services.agent.base import Agent, AgentSettings
from caviar_services.agent.baselines import LosBeamAgent, OracleAgent
from caviar_services.channel.statistical.free_space import FreeSpaceChannel, FreeSpaceSettings
from caviar_services.link.beams import BeamLink, BeamLinkSettings
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo

CARRIER = Carrier(name="mmwave", frequency_hz=28e9, bandwidth_hz=100e6)
WAVELENGTH = SPEED_OF_LIGHT / CARRIER.frequency_hz
SCALLOPING = 2 / math.pi
"""Amplitude that the nearest DFT beam keeps at least, per array axis: halfway between two beams of N
elements 1/(N sin(π/2N)) is left, which falls to 2/π as N grows (Harris 1978, table 1: 3.92 dB)."""

yaw = st.floats(-math.pi, math.pi)
tilt = st.floats(-1.2, 1.2)
arrays = st.builds(
    AntennaArray,
    rows=st.integers(1, 4),
    columns=st.integers(1, 8),
    vertical_spacing=st.floats(0.3, 1.2),
    horizontal_spacing=st.floats(0.3, 1.2),
)
orientations = st.builds(quaternion_from_euler, yaw, tilt, tilt)
coordinates = st.floats(-300, 300)


def frame_of(**inputs: Payload) -> Frame:
    entries = [
        FrameInput(GrantInput(topic=topic, source=topic, status=Status.FRESH), payload=payload)
        for topic, payload in inputs.items()
    ]
    return Frame(episode=0, number=0, t_ns=0, inputs=tuple(entries), service="test")


def scene_of(*devices: AntennaDevice) -> Scene:
    empty: Float64Array = np.zeros((0, 3))
    return Scene(
        names=(),
        classes=(),
        assets=(),
        position=empty,
        orientation=np.zeros((0, 4)),
        velocity=empty,
        dimensions=empty,
        devices=devices,
    )


def free_space(scene: Scene) -> Channel:
    model = FreeSpaceChannel(FreeSpaceSettings(), RunInfo(name="channel", carriers=(CARRIER,)))
    model.prepare(Preparation(demand={"channel": frozenset({"h"})}))
    channel = model.step(frame_of(scene=scene)).products["channel"]
    assert isinstance(channel, Channel)
    return channel


def link_of(agent: type[Agent[AgentSettings]], scene: Scene, channel: Channel) -> Link:
    decide = agent(AgentSettings(), RunInfo(name="agent"))
    action = decide.step(frame_of(scene=scene, channel=channel)).products["action"]
    assert isinstance(action, Action)
    link = BeamLink(BeamLinkSettings(), RunInfo(name="link"))
    product = link.step(frame_of(scene=scene, channel=channel, action=action)).products["link"]
    assert isinstance(product, Link)
    return product


@settings(deadline=None, max_examples=80)
@given(
    tx_array=arrays,
    rx_array=arrays,
    tx_orientation=orientations,
    rx_orientation=orientations,
    tx_position=st.tuples(coordinates, coordinates, coordinates),
    rx_position=st.tuples(coordinates, coordinates, coordinates),
)
def test_in_free_space_the_straight_line_pair_is_the_best_pair(
    tx_array: AntennaArray,
    rx_array: AntennaArray,
    tx_orientation: tuple[float, float, float, float],
    rx_orientation: tuple[float, float, float, float],
    tx_position: tuple[float, float, float],
    rx_position: tuple[float, float, float],
) -> None:
    """For any pose, array and spacing: with one plane wave |y| is the product of both ends' gains,
    so `los-beam` and `oracle` reach the same |y|; and it lies between the scalloping loss and the
    full gain sqrt(Nr·Nt)·λ/(4πd) of Friis' formula."""
    distance = math.dist(tx_position, rx_position)
    assume(distance >= 1)
    bs = AntennaDevice(name="bs", role="tx", array=tx_array, position=tx_position, orientation=tx_orientation)
    user = AntennaDevice(
        name="ue", role="rx", array=rx_array, position=rx_position, orientation=rx_orientation
    )
    scene = scene_of(bs, user)
    channel = free_space(scene)
    los, oracle = (link_of(agent, scene, channel) for agent in (LosBeamAgent, OracleAgent))
    amplitude = abs(channel.a[0, 0])
    friis = WAVELENGTH / (4 * math.pi * distance)
    assume(amplitude >= 1e-3 * friis)  # crossed polarisations leave nothing but rounding
    assert los.abs_y[0] == pytest.approx(oracle.abs_y[0], rel=1e-9)
    assert los.abs_y[0] == los.baseline_abs_y[0]
    full = math.sqrt(tx_array.size * rx_array.size) * amplitude
    axes = sum(size > 1 for a in (tx_array, rx_array) for size in (a.rows, a.columns))
    assert SCALLOPING**axes * full * (1 - 1e-9) <= oracle.abs_y[0] <= full * (1 + 1e-9)
    assert amplitude <= friis * (1 + 1e-9)


def test_a_user_on_the_grid_gets_friis_times_the_full_array_gain() -> None:
    """64 × 8 elements, user at sin φ = 2·5/64 of a BS turned by 0.4 rad, facing back at beam 0."""
    azimuth = 0.4 + math.asin(2 * 5 / 64)
    distance = 120.0
    position = (3 + distance * math.cos(azimuth), -7 + distance * math.sin(azimuth), 10.0)
    bs = AntennaDevice(
        name="bs",
        role="tx",
        array=AntennaArray(columns=64),
        position=(3.0, -7.0, 10.0),
        orientation=quaternion_from_euler(0.4),
    )
    user = AntennaDevice(
        name="ue",
        role="rx",
        array=AntennaArray(columns=8),
        position=position,
        orientation=quaternion_from_euler(azimuth + math.pi),
    )
    scene = scene_of(bs, user)
    link = link_of(LosBeamAgent, scene, free_space(scene))
    assert (link.tx_beam[0], link.rx_beam[0]) == (5, 0)
    assert link.abs_y[0] == pytest.approx(math.sqrt(64 * 8) * WAVELENGTH / (4 * math.pi * distance), rel=1e-9)
    assert link.top_abs_y[0, 1] < 1e-9 * link.abs_y[0]


def test_beam_pattern_is_the_dirichlet_kernel() -> None:
    """|c_k* a(φ)| = |sin(Nψ/2)/sin(ψ/2)|/sqrt(N), ψ = 2π(d sin φ − k/N) (Balanis, eq. 6-10)."""
    array = AntennaArray(columns=16, horizontal_spacing=0.5)
    azimuth = np.linspace(-1.5, 1.5, 301) + 1e-4
    directions = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros_like(azimuth)], axis=-1)
    pattern = np.abs(steering_vector(array, directions) @ dft_codebook(array).conj().T)
    psi = 2 * np.pi * (0.5 * np.sin(azimuth)[:, None] - np.arange(16) / 16)
    expected = np.abs(np.sin(8 * psi) / np.sin(psi / 2)) / 4
    np.testing.assert_allclose(pattern, expected, atol=1e-9)


def test_channel_and_codebook_agree_on_the_phase_of_every_element() -> None:
    """H of a long link against path lengths from element to element: the spherical wave itself."""
    tx_pose = ((0.0, 0.0, 0.0), quaternion_from_euler(0.3, -0.2, 0.1))
    rx_pose = ((4000.0, 2500.0, 900.0), quaternion_from_euler(-2.0, 0.3, -0.4))
    tx_array, rx_array = AntennaArray(rows=2, columns=3), AntennaArray(rows=3, columns=2)
    scene = scene_of(
        AntennaDevice(name="bs", role="tx", array=tx_array, position=tx_pose[0], orientation=tx_pose[1]),
        AntennaDevice(name="ue", role="rx", array=rx_array, position=rx_pose[0], orientation=rx_pose[1]),
    )
    h = free_space(scene).h[0].h
    tx_elements, rx_elements = (
        np.array(position) + WAVELENGTH * element_positions(array) @ rotation_matrix(orientation).T
        for (position, orientation), array in ((tx_pose, tx_array), (rx_pose, rx_array))
    )
    lengths = np.linalg.norm(rx_elements[:, None] - tx_elements[None], axis=-1)
    phase = np.exp(-2j * np.pi * (lengths - lengths[0, 0]) / WAVELENGTH)
    np.testing.assert_allclose(h / h[0, 0], phase, atol=1e-3)
