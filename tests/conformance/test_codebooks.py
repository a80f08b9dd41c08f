"""Every built-in codebook, one of a file and one of a plug-in pass the conformance tests."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from caviar_protocol import plugins
from caviar_protocol.space.codebooks import CODEBOOKS, codebook_of, named_by_content
from caviar_protocol.topics import AntennaArray, Panel
from caviar_services.testing import CodebookConformance

UNIFORM = AntennaArray(rows=3, columns=4, horizontal_spacing=0.7)
SEVERAL = replace(UNIFORM, polarization="cross", panels=(Panel(yaw_deg=90.0), Panel(yaw_deg=-70.0)))
ARGUMENTS = {"dft": ["dft"], "quantized": ["quantized:1", "quantized:3"], "file": ["file:"]}

# A plug-in as another distribution has it: a module, and the entry point that names its class.
PLUGIN = '''
import numpy as np
from caviar_protocol.space.antenna_arrays import steering_vector
from caviar_protocol.space.codebooks import Codebook

class Fan(Codebook):
    """Beams towards evenly spaced azimuths in front of the array: ``fan:7`` has seven."""

    def block(self):
        azimuth = np.linspace(-1.2, 1.2, int(self.argument))
        towards = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros_like(azimuth)], axis=-1)
        return steering_vector(self.uniform, towards) / np.sqrt(self.uniform.size)
'''


@pytest.fixture
def arrays(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[AntennaArray, ...]:
    """Arrays with one codebook; of a file with more beams than elements."""
    name = request.param
    if name == "file:":
        learned = np.random.default_rng(3).normal(size=(2, 20, 12)).view()
        beams = learned[0] + 1j * learned[1]
        np.save(tmp_path / "beams.npy", (beams / np.linalg.norm(beams, axis=1)[:, None]).astype(np.complex64))
        name = named_by_content(f"file:{tmp_path / 'beams.npy'}")
    return replace(UNIFORM, codebook=name), replace(SEVERAL, codebook=name)


@pytest.fixture
def fan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """An installed distribution with the codebook ``fan``."""
    (tmp_path / "fan_beams.py").write_text(PLUGIN)
    info = tmp_path / "fan_beams-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: fan-beams\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[caviar.codebooks]\nfan = fan_beams:Fan\nnone = math:pi\n")
    monkeypatch.syspath_prepend(tmp_path)
    for cache in (plugins._all, plugins.plugins):
        cache.cache_clear()
    yield
    for cache in (plugins._all, plugins.plugins, codebook_of):
        cache.cache_clear()


def test_all_that_are_built_in_are_tested() -> None:
    assert ARGUMENTS.keys() == CODEBOOKS.keys()


@pytest.mark.parametrize("arrays", [name for names in ARGUMENTS.values() for name in names], indirect=True)
class TestBuiltIn(CodebookConformance):
    """The table `CODEBOOKS`."""

    @pytest.fixture
    def codebooks(self, arrays):  # type: ignore[no-untyped-def]  # arrays of a file are made by a fixture
        return [codebook_of(array) for array in arrays]


@pytest.mark.usefixtures("fan")
class TestPlugin(CodebookConformance):
    """A codebook of another distribution."""

    arrays = (replace(UNIFORM, codebook="fan:7"), replace(SEVERAL, codebook="fan:16"))

    def test_it_has_beams_of_its_own_number(self) -> None:
        assert [codebook_of(array).beams for array in self.arrays] == [7, 64]

    def test_another_object_is_refused_by_name(self) -> None:
        with pytest.raises(plugins.DeclarationError, match="math:pi of fan-beams"):
            codebook_of(replace(UNIFORM, codebook="none"))
