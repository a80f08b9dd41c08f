"""The suite of extremes: that it tells right from wrong, and the part of it that needs no ray tracer."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import pytest
from typer.testing import CliRunner

from caviar_clients.cli.main import app
from caviar_labs.stability import case as cases_module
from caviar_labs.stability import formulas
from caviar_labs.stability.case import (
    Case,
    Outcome,
    Result,
    all_of,
    cases,
    close,
    equal,
    markdown,
    refused,
    run,
    worst,
    wrong,
)
from caviar_labs.stability.lab import Lab
from caviar_protocol.errors import AssetError, PayloadError

QUICK = [case for case in cases() if not case.traced]


def test_cases_without_ray_tracer_are_right() -> None:
    """Free space and the drawn channel, from 1 mm to 50 km and with every NaN."""
    assert len(QUICK) > 50
    assert wrong(run(QUICK)) == []


def test_cases_have_names_of_their_own() -> None:
    titles = [case.title for case in cases()]
    assert len(titles) == len(set(titles)) > 150


def test_a_wrong_expectation_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """A formula that is off by a hundredth makes the cases wrong that use it, and no others."""
    exact = formulas.friis
    monkeypatch.setattr(formulas, "friis", lambda d, f: 1.01 * exact(d, f))
    found = {result.case for result in wrong(run(QUICK))}
    assert "1000 m at 60 GHz, free-space" in found
    assert "1 mm at 60 GHz, free-space" not in found  # expects no path
    assert not any("in the position" in name for name in found)


def test_a_wrong_speed_of_light_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """By phases and by Doppler shifts."""
    monkeypatch.setattr(formulas, "C", 2.9979e8)
    groups = {result.group for result in wrong(run(QUICK))}
    assert {"distance", "speed", "array"} <= groups


def test_a_case_that_breaks_is_wrong_and_the_rest_goes_on() -> None:
    def breaks(lab: Lab) -> Outcome:
        raise ZeroDivisionError("by hand")

    chosen = [Case(group="g", name="breaks", ask=breaks, traced=False), QUICK[0]]
    first, second = run(chosen)
    assert (first.verdict, first.got) == ("wrong", "ZeroDivisionError: by hand")
    assert second.verdict == "right"


def test_numbers_are_compared_within_the_larger_tolerance() -> None:
    assert close("m", 2.0, 2.019, relative=0.01).right
    assert not close("m", 2.0, 2.021, relative=0.01).right
    assert close("m", 0.0, 0.09, relative=0.01, absolute=0.1).right
    assert not close("m", 0.0, float("nan"), absolute=0.1).right
    assert not close("m", 1j, -1j, absolute=0.1).right
    assert close("m", 2.0, 3.0, relative=0.1).expected == "2 m ± 10 %"
    assert not worst([], 1.0, "m", "length").right
    assert not worst([0.1, float("nan")], 1.0, "m", "length").right
    assert all_of(equal(1, 1), equal(2, 3)).right is False


def test_an_error_is_right_only_of_its_class_and_with_its_words() -> None:
    def fails() -> None:
        raise PayloadError("device 'r' is nowhere")

    assert refused(PayloadError, "'r'", fails).right
    assert not refused(PayloadError, "'t'", fails).right
    assert not refused(AssetError, "'r'", fails).right
    assert refused(PayloadError, "'r'", lambda: 3).got == "no error, int"


def test_the_table_keeps_to_its_columns() -> None:
    row = Result(group="g", case="a|b", expected="1", got="two\nlines", verdict="wrong", seconds=0.1)
    assert markdown([row]).splitlines()[2] == "| g: a\\|b | 1 | two lines | wrong |"


class TestCommand:
    def ask(self, *arguments: str) -> tuple[int, str]:
        result = CliRunner().invoke(app, ["measure", "stability", "--no-traced", *arguments])
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        return result.exit_code, result.output

    def test_prints_and_writes(self, tmp_path: Path) -> None:
        file, table = tmp_path / "s.json", tmp_path / "s.md"
        status, output = self.ask("--group", "distance", "--json", str(file), "--markdown", str(table))
        assert status == 0
        rows = msgspec.json.decode(file.read_bytes(), type=list[Result])
        assert {row.group for row in rows} == {"distance"}
        assert f"{len(rows)} of {len(rows)} right" in output
        assert set(json.loads(file.read_text())[0]) >= {"case", "expected", "got", "verdict"}
        assert len(table.read_text().splitlines()) == len(rows) + 2

    def test_status_1_where_a_case_is_wrong(self, monkeypatch: pytest.MonkeyPatch) -> None:
        exact = formulas.friis
        monkeypatch.setattr(formulas, "friis", lambda d, f: 1.01 * exact(d, f))
        status, output = self.ask("--group", "distance")
        assert status == 1
        assert "wrong" in output

    def test_what_needs_the_ray_tracer_is_not_run_without_it(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """A missing extra is no wrong physics: the rest is judged, one line says what to install."""
        monkeypatch.setattr(cases_module, "has_extra", lambda _: False)
        result = CliRunner(env={"COLUMNS": "200"}).invoke(app, ["measure", "stability", "--group", "speed"])
        ran = sum(case.group == "speed" and not case.traced for case in cases())
        every = sum(case.group == "speed" for case in cases())
        assert result.exit_code == 0
        assert f"{ran} of {ran} right" in result.output
        assert f"{every - ran} of {every} cases did not run" in result.output
        assert result.output.count("caviar-sim[channel]") == 1
        assert "wrong" not in result.output

    def test_status_1_where_no_case_ran(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(cases_module, "has_extra", lambda _: False)
        only = [case for case in cases() if case.traced][:1]
        monkeypatch.setattr(cases_module, "cases", lambda: only)
        assert CliRunner().invoke(app, ["stability"]).exit_code == 1

    def test_an_unknown_group_is_named(self) -> None:
        with pytest.raises(Exception, match=r"no group 'speeed' .* speed"):
            self.ask("--group", "speeed")

    @pytest.mark.parametrize("option", ["--json", "--markdown"])
    def test_a_file_that_cannot_be_written_is_named_before_the_first_case(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, option: str
    ) -> None:
        monkeypatch.setattr(cases_module, "run", lambda *_: pytest.fail("a case was run"))
        with pytest.raises(Exception, match=r"cannot write .*Is a directory"):
            self.ask("--group", "speed", option, str(tmp_path))


def test_no_case_is_registered_twice_by_asking_again() -> None:
    before = len(cases())
    assert len(cases()) == before == len(cases_module.CASES)
