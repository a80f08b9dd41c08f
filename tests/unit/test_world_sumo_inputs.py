"""What SUMO is given: traffic out of order, options that break promises, files outside of their folder."""

from __future__ import annotations

import gzip
import importlib.util
from pathlib import Path

import pytest

from caviar_protocol.errors import ScenarioError
from caviar_services.world.sumo_inputs import check_file, checked_inputs

pytestmark = [
    pytest.mark.sumo,
    pytest.mark.skipif(importlib.util.find_spec("sumo") is None, reason="needs the world extra"),
]

FIRST = '<flow id="first" begin="00:01:00" end="90" period="2" from="a" to="b"/>'
LATER = '<trip id="later" depart="{}" from="a" to="b"/>'


def routes(folder: Path, *elements: str, name: str = "traffic.rou.xml") -> Path:
    text = "<routes>\n" + "\n".join(elements) + "\n</routes>\n"
    path = folder / name
    path.write_bytes(gzip.compress(text.encode()) if name.endswith(".gz") else text.encode())
    return path


def configured(folder: Path, text: str, *options: str) -> list[str]:
    """Check a configuration; returns the notes."""
    (folder / "town.net.xml").write_text("<net/>")
    config = folder / "town.sumocfg"
    config.write_text(f'<configuration><net-file value="town.net.xml"/>{text}</configuration>')
    named = {"config": [str(config)], "net": [], "routes": [], "additional": []}
    return list(checked_inputs(named, options).notes)


@pytest.mark.parametrize("name", ["traffic.rou.xml", "traffic.rou.xml.gz"])
@pytest.mark.parametrize(
    ("time", "late"), [("59.9", True), ("0:00:59", True), ("60", False), ("0:0:1:1", False)]
)
def test_traffic_that_sumo_would_leave_out_is_named_with_its_line(
    tmp_path: Path, name: str, time: str, late: bool
) -> None:
    file = routes(tmp_path, FIRST, LATER.format(time), name=name)
    if not late:
        check_file("routes", str(file))
        return
    with pytest.raises(ScenarioError, match=r"'later'.*59.*'first'.*60") as caught:
        check_file("routes", str(file))
    assert (caught.value.line, caught.value.key, caught.value.file) == (3, "settings.routes", str(file))


def test_traffic_is_checked_where_a_configuration_or_an_include_names_it(tmp_path: Path) -> None:
    file = routes(tmp_path, FIRST, LATER.format(3))
    with pytest.raises(ScenarioError, match="'later' departs at 3 s") as caught:
        configured(tmp_path, '<route-files value="traffic.rou.xml"/>')
    assert (caught.value.file, caught.value.key) == (str(file), "settings.config")
    routes(tmp_path, LATER.format(3), name="more.xml")
    outer = routes(tmp_path, FIRST, '<include href="more.xml"/>')
    with pytest.raises(ScenarioError, match="'later' departs at 3 s") as caught:
        check_file("routes", str(outer))
    assert caught.value.file == str(tmp_path / "more.xml")


@pytest.mark.parametrize(
    ("text", "options", "refused"),
    [
        ('<random value="true"/>', (), "random"),
        ("", ("--random",), "random"),
        ("", ("--mesosim", "true"), "mesosim"),
        ('<remote-port value="8813"/>', (), "remote-port"),
        ("", ("--save-state.times", "3"), "save-state.times"),
        ("", ("--tripinfo-output", "trips.xml"), "--tripinfo-output"),
        ("", ("--device.ssm.file", "ssm.xml"), "--device.ssm.file"),
    ],
)
def test_options_that_break_a_promise_are_refused_by_name(
    tmp_path: Path, text: str, options: tuple[str, ...], refused: str
) -> None:
    with pytest.raises(ScenarioError, match=rf"{refused} "):
        configured(tmp_path, text, *options)
    assert configured(tmp_path, '<random value="false"/>', "--mesosim", "false") == []


def test_what_a_configuration_would_write_is_switched_off_and_noted(tmp_path: Path) -> None:
    (note, other) = configured(
        tmp_path,
        '<output><summary-output value="../mine.txt"/><summary-output.period value="5"/>'
        '<fcd-output.attributes value="x,y"/><output-prefix value="osm_"/></output>'
        '<report><log value="log.txt"/></report><processing><no-internal-links value="true"/></processing>',
    )
    assert "summary-output, log" in note
    assert "no-internal-links" in other


@pytest.mark.parametrize(
    ("element", "refused"),
    [
        ('<inductionLoop id="d" lane="ab_0" pos="1" period="1" file="../mine.txt"/>', "mine.txt"),
        ('<timedEvent type="SaveTLSStates" source="t" dest="mine.txt"/>', "mine.txt"),
        ('<vType id="v"><param key="device.ssm.file" value="mine.txt"/></vType>', "mine.txt"),
        ('<include href="../mine.xml"/>', "outside of"),
        ('<include href="more.xml"/>', "is no file"),
        ('<include href="traffic.rou.xml"/>', "includes this one"),
    ],
)
def test_files_stay_in_their_folder_and_write_nothing(tmp_path: Path, element: str, refused: str) -> None:
    (tmp_path / "mine.xml").write_text("<routes/>")
    (tmp_path / "town").mkdir()
    file = routes(tmp_path / "town", element)
    with pytest.raises(ScenarioError, match=refused) as caught:
        check_file("additional", str(file))
    assert caught.value.line == 2
    check_file("additional", str(routes(tmp_path, '<rerouter file="in.xml"/><inductionLoop file="NUL"/>')))


def test_entities_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "e.rou.xml"
    file.write_text('<!DOCTYPE routes [<!ENTITY mine SYSTEM "/etc/passwd">]><routes>&mine;</routes>')
    with pytest.raises(ScenarioError, match="entity 'mine'"):
        check_file("routes", str(file))
