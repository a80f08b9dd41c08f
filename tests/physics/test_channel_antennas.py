"""Dual polarization, patterns from files and panels: against Sionna RT's own path solver, and each other."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from caviar_labs.stability.formulas import C, turn, vertical
from caviar_labs.stability.lab import (
    CONDUCTOR,
    Array,
    Lab,
    Plate,
    Thing,
    antenna,
    free_space,
    measure,
    scene,
    sionna,
    square,
)
from caviar_protocol.multipath import subcarrier_offsets
from caviar_protocol.space.coordinates import quaternion_from_euler, rotation_matrix
from caviar_protocol.topics import AntennaArray, Carrier, Channel, Panel
from caviar_services.channel.base import ChannelModel
from caviar_services.channel.propagation.patterns import Patterns, element_amplitude, radiated_field
from caviar_services.channel.statistical.free_space import FreeSpaceChannel, FreeSpaceSettings
from caviar_services.pattern_files import read_pattern
from caviar_services.service import Preparation, RunInfo
from caviar_space.scenery import scenery_assets

pytestmark = pytest.mark.channel

FREQUENCY = 28e9
TX, RX = np.array([-33.0, 11.0, 32.0]), [np.array([10.0, -2.0, 1.5]), np.array([24.0, 3.0, 1.5])]
TURNED = (0.3, 0.1, -0.2)
"""Yaw, pitch and roll of all antennas [rad]."""

Pattern = Callable[[Any, Any], tuple[Any, Any]]


def write_gain(file: Path, step: int = 1) -> Path:
    """The sector element of 3GPP TR 38.901 as a table of gains."""
    theta, phi = np.meshgrid(np.arange(0, 181, step), np.arange(-180, 181, step), indexing="ij")
    gain = 20 * np.log10(element_amplitude("tr38901", towards(theta, phi).reshape(-1, 3)))
    rows = zip(theta.ravel(), phi.ravel(), gain.tolist(), strict=True)
    file.write_text("theta_deg,phi_deg,gain_dbi\n" + "\n".join(f"{t},{p},{g!r}" for t, p, g in rows))
    return file


def write_field(file: Path) -> Path:
    """A short dipole across the view, tilted by 30° from the vertical, whose φ component leads by 90°."""
    theta, phi = np.meshgrid(np.arange(0, 181), np.arange(0, 360), indexing="ij")
    e_theta, e_phi = tilted_dipole(np.radians(theta), np.radians(phi))
    rows = zip(theta.ravel(), phi.ravel(), e_theta.ravel().tolist(), e_phi.ravel().tolist(), strict=True)
    lines = [f"{t},{p},{a.real!r},{a.imag!r},{b.real!r},{b.imag!r}" for t, p, a, b in rows]
    file.write_text("theta_deg,phi_deg,e_theta_re,e_theta_im,e_phi_re,e_phi_im\n" + "\n".join(lines))
    return file


def write_cuts(file: Path) -> Path:
    """Cuts of the sector element in an MSI/Planet file: 12(φ/65°)² and 12(θ/65°)² dB, at most 30 each."""
    angles = np.arange(360)
    loss = np.minimum(12 * (np.minimum(angles, 360 - angles) / 65) ** 2, 30)
    cut = "\n".join(f"{angle}.0 {value!r}" for angle, value in zip(angles, loss.tolist(), strict=True))
    file.write_text(
        f"NAME test\nFREQUENCY 28000\nGAIN 5.85 dBd\nHORIZONTAL 360\n{cut}\nVERTICAL 360\n{cut}\n"
    )
    return file


def towards(theta_deg: Array, phi_deg: Array) -> Array:
    theta, phi = np.radians(theta_deg), np.radians(phi_deg)
    parts = np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi
    return np.stack(parts, axis=-1)


def tilted_dipole(theta: Array, phi: Array) -> tuple[Array, Array]:
    """E of a dipole along (0, sin 30°, cos 30°), its φ component times j."""
    y, z = 0.5, np.sqrt(0.75)
    along_theta = y * np.cos(theta) * np.sin(phi) - z * np.sin(theta)
    return -np.sqrt(1.5) * along_theta + 0j, -1j * np.sqrt(1.5) * y * np.cos(phi) + 0 * theta


# --- the same in Sionna RT ---------------------------------------------------------------------


def sector(slants: tuple[float, ...]) -> list[Pattern]:
    """Sionna RT's own sector element, by its registered names."""
    from sionna.rt.antenna_pattern import PolarizedAntennaPattern, v_tr38901_pattern

    names = {(0.0, 90.0): "VH", (-45.0, 45.0): "cross", (0.0,): "V"}
    made = PolarizedAntennaPattern(v_pattern=v_tr38901_pattern, polarization=names[slants])
    patterns: list[Pattern] = made.patterns
    return patterns


def summed_cuts(theta: Any, phi: Any) -> tuple[Any, Any]:
    """The two cuts of `write_cuts` added up, in Dr.Jit."""
    import drjit as dr
    import mitsuba as mi

    width = 65 * dr.pi / 180
    around = dr.atan2(dr.sin(phi), dr.cos(phi))
    loss = dr.minimum(12 * (around / width) ** 2, 30) + dr.minimum(
        12 * ((theta - dr.pi / 2) / width) ** 2, 30
    )
    return mi.Complex2f(dr.power(10.0, (8 - loss) / 20), 0), mi.Complex2f(0 * theta, 0)


def dipole_in_drjit(theta: Any, phi: Any) -> tuple[Any, Any]:
    import drjit as dr
    import mitsuba as mi

    y, z, root = 0.5, float(np.sqrt(0.75)), float(np.sqrt(1.5))
    along = y * dr.cos(theta) * dr.sin(phi) - z * dr.sin(theta)
    return mi.Complex2f(-root * along, 0), mi.Complex2f(0, -root * y * dr.cos(phi) + 0 * theta)


def circular(sign: float) -> Pattern:
    def pattern(theta: Any, phi: Any) -> tuple[Any, Any]:
        import mitsuba as mi

        part = float(np.sqrt(0.5))
        return mi.Complex2f(part + 0 * theta, 0), mi.Complex2f(0, sign * part + 0 * theta)

    return pattern


def conjugated(patterns: list[Pattern]) -> list[Pattern]:
    """Sionna RT takes the conjugate of a receiver's pattern, so that of a reciprocal antenna is given so."""
    import drjit as dr

    def of(pattern: Pattern) -> Pattern:
        return lambda theta, phi: tuple(dr.conj(part) for part in pattern(theta, phi))  # type: ignore[return-value]

    return [of(pattern) for pattern in patterns]


def solved(
    model: ChannelModel[Any], found: Channel, sent: list[Pattern], taken: list[Pattern]
) -> list[Array]:
    """H of each receiver by Sionna RT, of columns 2×3 at TX and 2×1 at RX, with phases of exact lengths."""
    import sionna.rt as rt
    from sionna.rt.antenna_pattern import AntennaPattern, antenna_pattern_registry

    class Given(AntennaPattern):
        def __init__(self, patterns: list[Pattern]) -> None:
            self.patterns = patterns

    traced, arrays = model._scene.rt_scene, []  # type: ignore[attr-defined]
    for name, patterns, columns in (("given-tx", sent, 3), ("given-rx", taken, 1)):
        antenna_pattern_registry.register(lambda patterns=patterns: Given(patterns), name)
        arrays.append(rt.PlanarArray(num_rows=2, num_cols=columns, pattern=name))
        antenna_pattern_registry.unregister(name)
    traced.tx_array, traced.rx_array = arrays
    for name in (*traced.transmitters, *traced.receivers):
        traced.remove(name)
    centre = model._scene.centre  # type: ignore[attr-defined]
    traced.add(rt.Transmitter("tx", position=(TX - centre).tolist(), orientation=list(TURNED)))
    for number, place in enumerate(RX):
        traced.add(rt.Receiver(f"rx{number}", position=(place - centre).tolist(), orientation=list(TURNED)))
    paths = rt.PathSolver()(traced, max_depth=2, samples_per_src=100_000, refraction=False)
    a, tau = paths.a[0].numpy() + 1j * paths.a[1].numpy(), paths.tau.numpy()
    matrices = []
    for number in range(len(RX)):
        exact = found.tau[found.offsets[number] : found.offsets[number + 1]]
        rows = np.flatnonzero(paths.valid.numpy()[number, 0])
        apart = np.abs(tau[number, 0, rows][:, None] - exact) * C
        assert (apart.min(1) < 1e-3).all() and len(rows) == len(exact)  # noqa: PT018
        phase = np.exp(-2j * np.pi * (FREQUENCY * exact[apart.argmin(1)] % 1.0))
        matrices.append((a[number, :, 0][:, :, rows] * phase).sum(-1))
    return matrices


def nmse_db(found: list[Array], expected: list[Array]) -> float:
    error = sum(np.linalg.norm(a - b) ** 2 for a, b in zip(found, expected, strict=True))
    return float(10 * np.log10(error / sum(np.linalg.norm(b) ** 2 for b in expected)))


@pytest.fixture(scope="module")
def canyon(tmp_path_factory: pytest.TempPathFactory) -> ChannelModel[Any]:
    folder = tmp_path_factory.mktemp("patterns")
    assets = dict(scenery_assets("sionna:simple_street_canyon"))
    files = {
        "patterns/gain.csv": write_gain(folder / "gain.csv"),
        "patterns/field.csv": write_field(folder / "field.csv"),
        "patterns/cuts.msi": write_cuts(folder / "cuts.msi"),
    }
    return sionna(FREQUENCY, {**assets, **files}, samples=100_000, max_depth=2, bodies=0)  # type: ignore[dict-item]


def devices(transmit: AntennaArray, receive: AntennaArray) -> list[Any]:
    turned = quaternion_from_euler(*TURNED)
    sized = msgspec.structs.replace(transmit, rows=2, columns=3)
    return [
        antenna("t", "tx", TX, sized, orientation=turned),
        *(
            antenna(f"r{i}", "rx", place, msgspec.structs.replace(receive, rows=2), orientation=turned)
            for i, place in enumerate(RX)
        ),
    ]


@pytest.mark.parametrize("case", ["cross by gain table", "circular by cuts", "field table"])
def test_the_street_canyon_as_sionna_rt_has_it(canyon: ChannelModel[Any], case: str) -> None:
    """NMSE of H ≤ −55 dB, elements in Sionna RT's order, patterns there by formula."""
    transmit, receive = {
        "cross by gain table": ({"polarization": "cross", "pattern_file": "patterns/gain.csv"}, "VH"),
        "circular by cuts": ({"pattern_file": "patterns/cuts.msi"}, "circular"),
        "field table": ({"pattern_file": "patterns/field.csv"}, "VH"),
    }[case]
    given = devices(AntennaArray(**transmit), AntennaArray(polarization=receive))  # type: ignore[arg-type]
    channel = measure(canyon, scene(given))
    found = [matrix.h for matrix in channel.h]
    vh: list[Pattern] = iso("VH")
    sent, taken = {
        "cross by gain table": (sector((-45.0, 45.0)), vh),
        "circular by cuts": ([summed_cuts], conjugated([circular(-1.0), circular(1.0)])),
        "field table": ([dipole_in_drjit], vh),
    }[case]
    assert nmse_db(found, solved(canyon, channel, sent, taken)) < -55


def iso(polarization: str) -> list[Pattern]:
    from sionna.rt.antenna_pattern import antenna_pattern_registry

    patterns: list[Pattern] = antenna_pattern_registry.get("iso")(polarization=polarization).patterns
    return patterns


# --- by formula --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sent", "taken", "gain"),
    [("RHCP", "RHCP", 1.0), ("LHCP", "LHCP", 1.0), ("RHCP", "LHCP", 0.0), ("V", "RHCP", 0.5),
     ("+45", "+45", 0.0), ("+45", "-45", 1.0), ("H", "+45", 0.5)],
)  # fmt: skip
def test_polarizations_that_face_each_other(sent: str, taken: str, gain: float) -> None:
    """Power over Friis' formula: circular ones of one hand match, slanted ones are mirrored."""
    ends = AntennaArray(polarization=sent), AntennaArray(polarization=taken)  # type: ignore[arg-type]
    channel = measure(free_space(FREQUENCY), scene([antenna("t", "tx", (0, 0, 5), ends[0]),
                                                    antenna("r", "rx", (40, 0, 5), ends[1])]))  # fmt: skip
    friis = (C / FREQUENCY / (4 * np.pi * 40)) ** 2
    assert abs(channel.a[0, 0]) ** 2 / friis == pytest.approx(gain, abs=1e-12)


def test_amplitudes_of_a_path_are_those_of_the_two_polarizations_that_hear_each_other() -> None:
    """Crossed slants that face each other: the first of one end and the second of the other."""
    cross = AntennaArray(columns=2, polarization="cross")
    channel = measure(free_space(FREQUENCY), scene([antenna("t", "tx", (0, 0, 5), cross),
                                                    antenna("r", "rx", (40, 0, 5), cross)]))  # fmt: skip
    h = channel.h[0].h
    np.testing.assert_allclose(np.abs(h), abs(channel.a[0, 0]) * np.kron([[0, 1], [1, 0]], np.ones((2, 2))),
                               atol=1e-12 * abs(channel.a[0, 0]))  # fmt: skip


PANELS = (
    Panel(position_m=(0.3, 0.2, 0.1), yaw_deg=70.0, pitch_deg=10.0),
    Panel(position_m=(-0.3, 0.1, 0.0), yaw_deg=-120.0, roll_deg=30.0),
)


def test_panels_are_arrays_of_their_own_for_plane_waves() -> None:
    """H of two panels by hand: positions and fields of each element from its panel's pose, one plane wave."""
    array = AntennaArray(rows=2, columns=2, pattern="tr38901", polarization="VH", panels=PANELS)
    tx, rx = np.array([5.0, 2.0, 8.0]), np.array([60.0, -20.0, 1.5])
    yaw = quaternion_from_euler(-0.4)
    channel = measure(free_space(FREQUENCY), scene([antenna("t", "tx", tx, array, orientation=yaw),
                                                    antenna("r", "rx", rx)]))  # fmt: skip
    along = (rx - tx) / np.linalg.norm(rx - tx)
    wavelength, expected = C / FREQUENCY, []
    theta_rx = vertical(-along)
    for panel in PANELS:
        turned = turn(-0.4, 0, 0) @ turn(*np.radians([panel.yaw_deg, panel.pitch_deg, panel.roll_deg]))
        local = along @ turned
        amplitude = element_amplitude("tr38901", local[None])[0]
        for field in (vertical(local), np.cross(local, vertical(local))):
            for y, z in ((-0.25, 0.25), (-0.25, -0.25), (0.25, 0.25), (0.25, -0.25)):
                place = turn(-0.4, 0, 0) @ panel.position_m + turned @ np.array([0, y, z]) * wavelength
                polarized = amplitude * float(turned @ field @ theta_rx)
                expected.append(polarized * np.exp(2j * np.pi / wavelength * (along @ place)))
    distance = float(np.linalg.norm(rx - tx))
    wave = wavelength / (4 * np.pi * distance) * np.exp(-2j * np.pi * (distance / wavelength % 1))
    np.testing.assert_allclose(channel.h[0].h[0], wave * np.array(expected), atol=1e-9 * abs(wave))


def test_all_rungs_agree_on_panels_and_polarizations() -> None:
    """Far from small arrays over a car: spherical and traced element by element within 1e-3 of each other,
    and plane waves within what the arrays' size over the distance makes."""
    array = AntennaArray(columns=2, pattern="tr38901", polarization="cross", panels=PANELS)
    at = scene(
        [
            antenna("t", "tx", (0, 0, 6), array),
            antenna("r", "rx", (40, 6, 2), AntennaArray(polarization="VH")),
        ],
        [Thing("car", (20.0, 3.0, 0.75))],
    )
    h = {rung: measure(sionna(3.5e9, rung=rung, bodies=1, max_depth=1, candidates="launched"), at).h[0].h
         for rung in ("siso-rt", "spherical", "mimo-rt")}  # fmt: skip
    scale = np.linalg.norm(h["mimo-rt"])
    assert h["mimo-rt"].shape == (2, 8)
    assert np.linalg.norm(h["spherical"] - h["mimo-rt"]) / scale < 1e-3
    assert np.linalg.norm(h["siso-rt"] - h["mimo-rt"]) / scale < 0.1


def test_a_pattern_that_no_world_brought_is_named() -> None:
    from caviar_protocol.errors import AssetError

    with pytest.raises(AssetError, match=r"'patterns/x.csv'"):
        Patterns().element(AntennaArray(pattern_file="patterns/x.csv"))


def test_a_table_of_gains_is_the_formula_it_was_made_of(tmp_path: Path) -> None:
    """Between the directions of a 1° table by 2e-3 dB, but where the formula bends to its floor."""
    pattern = Patterns({"patterns/a.csv": read_pattern(write_gain(tmp_path / "a.csv"))})
    k = np.random.default_rng(1).normal(size=(500, 3))
    k /= np.linalg.norm(k, axis=1, keepdims=True)
    found = pattern.element(AntennaArray(pattern_file="patterns/a.csv")).amplitude(k)
    error = 20 * np.log10(found / element_amplitude("tr38901", k))
    assert np.abs(error[found > 10 ** (-21 / 20)]).max() < 2e-3
    assert np.abs(error).max() < 0.2


@pytest.mark.parametrize("rung", ["free-space", "spherical"])
def test_responses_over_the_band_have_all_subarrays(rung: str) -> None:
    """On the middle subcarrier, which is the carrier itself, the response is H."""
    array = AntennaArray(columns=2, pattern="tr38901", polarization="cross", panels=PANELS)
    carrier = Carrier(name="c", frequency_hz=3.5e9, subcarriers=4, subcarrier_spacing_hz=60e3)
    run = RunInfo(name="channel", seed=1, carriers=(carrier,))
    model: ChannelModel[Any] = FreeSpaceChannel(FreeSpaceSettings(), run)
    if rung == "spherical":
        from caviar_services.channel.sionna.model import SionnaChannel
        from caviar_services.channel.sionna.settings import SionnaSettings

        model = SionnaChannel(SionnaSettings(rung=rung, bodies=0, max_depth=1, samples=1000), run)
    model.prepare(Preparation(demand={"channel": frozenset({"h", "hf"})}))
    both = AntennaArray(polarization="VH")
    channel = measure(
        model, scene([antenna("t", "tx", (0, 0, 6), array), antenna("r", "rx", (40, 6, 2), both)])
    )
    h, response = channel.h[0].h, channel.hf[0].h
    assert response.shape == (1, 4, *h.shape)
    offset = subcarrier_offsets(carrier)
    np.testing.assert_allclose(response[0, offset == 0][0], h, rtol=1e-5, atol=1e-6 * np.abs(h).max())


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Lab:
    return Lab(tmp_path_factory.mktemp("plates"))


@pytest.mark.parametrize("yaw", [0.0, 0.7])
@pytest.mark.parametrize(
    "array",
    [AntennaArray(), AntennaArray(rows=2, columns=4), AntennaArray(columns=4, polarization="cross")],
    ids=["single", "panel", "cross"],
)
@pytest.mark.parametrize(
    "rung", [{}, {"candidates": "launched"}, {"rung": "spherical"}], ids=["free", "launched", "spherical"]
)
def test_h_is_continuous_where_a_receiver_is_carried_over_its_transmitter(
    lab: Lab, rung: dict[str, str], array: AntennaArray, yaw: float
) -> None:
    # Neither vertical nor horizontal elements have an azimuth at the pole; 119 µm is where Sionna RT's ends.
    plates = [Plate("wall", [(5, -50, -50), (5, 50, -50), (5, 50, 50), (5, -50, 50)], CONDUCTOR)]
    plates.append(Plate("ground", square(60.0, -3.0)))
    model = lab.traced(28e9, plates, **rung) if rung else free_space(28e9)
    found = []
    for metres in np.array([-1e-6, 0.0, 1e-9, 1e-6, 118.5e-6, 119.5e-6, 238e-6, 239e-6]):
        receiver = antenna(
            "r", "rx", (0.87 * metres, 0.5 * metres, 20.0), array, orientation=quaternion_from_euler(yaw)
        )
        channel = measure(model, scene([antenna("t", "tx", (0, 0, 0), array), receiver]))
        found.append(channel.h[0].h)
    steps = np.abs(np.diff(found, axis=0)).max(axis=(1, 2)) / np.abs(found).max()
    assert steps[[0, 1, 2, 4, 6]].max() < 1e-3


@pytest.mark.parametrize("polarization", ["V", "H", "+45", "RHCP"])
def test_the_limit_at_a_pole_is_that_of_both_ends_however_the_devices_are_turned(polarization: str) -> None:
    array = AntennaArray(polarization=polarization)
    for angles in [(0.4, 0.0, 0.0), (0.0, np.pi / 2, 0.0), (1.0, 0.3, -0.8)]:
        rotation = rotation_matrix(quaternion_from_euler(*angles))
        along, beside = rotation[:, 2], rotation[:, 2] + 1e-7 * (rotation[:, 0] + 0.3 * rotation[:, 1])
        gains = [
            (
                radiated_field(array, rotation, k[None], arrival=False)
                * radiated_field(array, rotation, -k[None], arrival=True)
            ).sum()
            for k in (along, beside / np.linalg.norm(beside))
        ]
        assert gains[0] == pytest.approx(gains[1], abs=1e-6)
