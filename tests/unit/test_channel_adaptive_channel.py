"""The adaptive channel on a clock that stands still but for its rungs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import pytest
from adaptive_rungs import LADDER, MS, Time, TimedRung, adaptive, channel_of, frame, labels, rung

from caviar_clients.session.prepared import prepare
from caviar_protocol.codec import encode_payload
from caviar_protocol.errors import PayloadError, ScenarioError
from caviar_protocol.scenario.conversion import convert_settings
from caviar_protocol.topics import Carrier
from caviar_services.channel.adaptive.channel import AdaptiveChannel
from caviar_services.registry import load
from caviar_services.service import Preparation, RunInfo, StepResult

SCENARIO = Path(__file__).parents[2] / "deploy" / "caviar_scenarios" / "adaptive.toml"


class TestLadder:
    """What a scenario may say, and what is refused by key."""

    @pytest.mark.parametrize(
        ("settings", "expected"),
        [
            ({"ladder": []}, r"ladder: has no rung; write \[\[services.channel.settings.ladder\]\]"),
            ({"ladder": [rung("a", 1), rung("a", 2)]}, "has 2 rungs with the label 'a'"),
            ({"fixed": "hihg"}, "fixed: is 'hihg', which is no rung; did you mean 'high'"),
            ({"common": {"takes_m": 3}}, "common.takes_m: no rung has a setting 'takes_m'; did you mean"),
            (
                {"ladder": [{"label": "a", "use": "free-space", "settings": {"sampls": 3}}]},
                r"ladder\[0\].settings.sampls: unknown key",
            ),
            (
                {"ladder": [{"label": "a", "use": "free-spac"}]},
                r"ladder\[0\].use: .*did you mean 'free-space'",
            ),
            (
                {"ladder": [{"label": "a", "use": "adaptive"}]},
                "which is no ChannelModel and cannot be a rung",
            ),
        ],
    )
    def test_what_is_wrong_is_named(self, settings: dict[str, Any], expected: str) -> None:
        with pytest.raises(ScenarioError, match=expected):
            adaptive(**settings)

    @pytest.mark.parametrize(
        ("right", "wrong", "told"),
        [
            ("max_depth = 2 ", "max_dpth = 2 ", "ladder[1].settings.max_dpth: unknown key 'max_dpth'"),
            (
                "max_depth = 2 ",
                "max_depth = -1 ",
                "ladder[1].settings.max_depth: is -1, write a whole number",
            ),
            ('label = "d3"', 'label = "d3"\nuse = "sionna_rt"', "ladder[2].use: "),
            ('label = "d3"', 'label = "d1"', "ladder: has 2 rungs with the label 'd1'"),
            ("los = true", "los = 3", "common.los: is 3, write true or false"),
            ("los = true", "loss = true", "common.loss: no rung has a setting 'loss'"),
        ],
    )
    def test_a_mistake_inside_the_ladder_is_named_by_line_before_anything_starts(
        self, tmp_path: Path, right: str, wrong: str, told: str
    ) -> None:
        text = SCENARIO.read_text()
        assert text.count(right) == 1
        path = tmp_path / "adaptive.toml"
        path.write_text(text.replace(right, wrong).replace("file:", f"file:{SCENARIO.parent}/"))
        with pytest.raises(ScenarioError) as error:
            prepare(path)
        assert f": services.channel.settings.{told}" in str(error.value)
        assert error.value.file == str(path)
        assert error.value.line is not None
        named = path.read_text().splitlines()[error.value.line - 1]
        stands = (
            "[[services.channel.settings.ladder]]" if told.startswith("ladder: ") else wrong.split("\n")[-1]
        )
        assert stands in named

    def test_common_settings_go_to_the_rungs_that_have_them_and_own_ones_go_before(self) -> None:
        ladder = [
            {"label": "free", "use": "free-space"},
            rung("timed", 5),
            {**rung("plain", 1), "settings": {}},
        ]
        made = adaptive(ladder=ladder, common={"takes_ms": 7.0})
        assert [getattr(r.model.settings, "takes_ms", None) for r in made.rungs] == [None, 5, 7]

    def test_what_a_rung_refuses_names_its_key_in_the_ladder(self) -> None:
        ladder = [rung("low", 1), {"label": "air", "use": "free-space", "settings": {"atmosphere": {}}}]
        settings = convert_settings(AdaptiveChannel.Settings, {"ladder": ladder})
        run = RunInfo(name="channel", carriers=(Carrier(name="c", frequency_hz=2e12),))
        with pytest.raises(ScenarioError) as caught:
            AdaptiveChannel(settings, run)
        assert caught.value.key == "services.channel.settings.ladder[1].settings.atmosphere"

    def test_an_error_in_a_frame_names_the_rung(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def fail(self: TimedRung, *_: object) -> None:
            raise PayloadError("settings.x: there is no way")

        channel = adaptive()
        monkeypatch.setattr(TimedRung, "model", fail)
        with pytest.raises(PayloadError, match=r"^settings\.x.*'middle'\)$"):
            channel.step(frame(0, 60))

    def test_it_is_registered(self) -> None:
        assert load("channel", "adaptive") is AdaptiveChannel


def test_notes_say_how_long_each_rung_took() -> None:
    notes = adaptive().prepare(Preparation(demand={})).notes
    assert notes == tuple(
        f"rung {label}: {taken} ms for 2 pairs among 0 objects"
        for label, taken in (("low", "10.0"), ("middle", "30.0"), ("high", "100.0"))
    )


def test_rungs_are_timed_with_nothing_remembered_among_bodies_that_move() -> None:
    """A rung that keeps what it made of a scene where nothing moved, and after a reset nothing."""
    memo = {"takes_ms": 80.0, "remembers": True, "bodies": 30}
    ladder = [{"label": "memo", "use": "adaptive_rungs:TimedRung", "settings": memo}]
    assert adaptive(ladder=ladder).prepare(Preparation(demand={})).notes == (
        "rung memo: 80.0 ms for 2 pairs among 2 objects",
    )


class TestDecisions:
    """Which rung computes a frame."""

    @pytest.mark.parametrize(
        ("budget_ms", "expected"), [(20, "low"), (60, "middle"), (200, "high"), (0, "high"), (5, "low")]
    )
    def test_the_most_accurate_that_fits(self, budget_ms: float, expected: str) -> None:
        result = adaptive().step(frame(0, budget_ms))
        assert result.decisions == {"rung": expected}
        assert f" {expected}" in result.fidelity
        assert result.counts.get("no-rung-fits", 0) == (budget_ms == 5)

    def test_the_setting_goes_before_the_budget_of_the_grant(self) -> None:
        assert adaptive(budget_ms=15.0).step(frame(0, 200)).decisions == {"rung": "low"}

    def test_a_slow_down_leads_down_and_its_end_up_again(self) -> None:
        """Four times as slow from frame 20 to 59: the high rung misses twice, then the middle one fits."""
        channel, found, missed = adaptive(), [], 0
        for number in range(140):
            Time.load = 4.0 if 20 <= number < 60 else 1.0
            found.append(channel.step(frame(number, 200)))
            missed += found[-1].measured["rung"] > 200 * MS
        rungs = labels(found)
        assert set(rungs[:20]) == {"high"}
        assert set(rungs[25:60]) <= {"low", "middle"}
        assert rungs[59] == "middle", "120 of 160 ms"
        assert set(rungs[100:]) == {"high"}
        assert missed <= 3
        assert sum(result.counts.get("rung-changes", 0) for result in found) <= 4

    def test_a_fixed_rung_is_fixed(self) -> None:
        channel = adaptive(fixed="middle")
        assert labels([channel.step(frame(n, 1)) for n in range(3)]) == ["middle"] * 3

    def test_what_is_imposed_goes_before_everything(self) -> None:
        channel = adaptive(fixed="middle")
        assert labels([channel.step(frame(n, 1, "high")) for n in range(3)]) == ["high"] * 3

    def test_an_imposed_rung_that_is_none_is_refused(self) -> None:
        with pytest.raises(ScenarioError, match=r"'hig'.*'high'"):
            adaptive().step(frame(0, imposed="hig"))

    def test_products_are_those_of_the_rung(self) -> None:
        """Bit by bit, where no error is stated."""
        channel = adaptive()
        middle = channel.rungs[1].model.step(frame(3))
        assert encode_payload(channel_of(channel.step(frame(3, imposed="middle")))) == encode_payload(
            channel_of(middle)
        )

    def test_imposed_decisions_give_the_same_bytes_at_any_speed(self) -> None:
        """Errors that are stated, too."""
        first = adaptive(calibrate_every=3)
        results = []
        for number in range(40):
            Time.load = 4.0 if number % 20 > 9 else 1.0
            results.append(first.step(frame(number, 200)))
        assert len(set(labels(results))) > 1
        again = adaptive(calibrate_every=3)
        for number, (result, label) in enumerate(zip(results, labels(results), strict=True)):
            Time.load = 0.1
            repeated = again.step(frame(number, 200, label))
            assert encode_payload(channel_of(repeated)) == encode_payload(channel_of(result))


def bounds(result: StepResult) -> list[float] | None:
    stated = channel_of(result).error_bound_db
    return None if stated is None else stated.ravel().tolist()


class TestStatedErrors:
    """Errors 0.1 (−20 dB) and a tenth of it, by turns, of the low rung; 0.01 of the middle one."""

    def test_the_chosen_rung_is_checked_against_the_highest(self) -> None:
        channel = adaptive(calibrate_every=1)
        found = [channel.step(frame(number, 20)) for number in range(20)]
        assert set(labels(found)) == {"low"}
        stated = [bounds(result) for result in found]
        assert stated[0] == [6.0, 6.0], "finite before anything is known"
        assert stated[-1] == [-20.0, -20.0]
        checks = sum(result.counts["error-checks"] for result in found)
        covered = sum(result.counts.get("error-covered", 0) for result in found)
        assert (checks, covered) == (40, 38), (
            "two pairs in each frame; of frame 1 only smaller errors were known"
        )
        assert found[-1].fidelity == "free-space low, NMSE ≤ -20.0 dB"
        assert channel_of(found[-1]).expected_error_db == -20.0
        assert channel_of(found[-1]).error_reference == "free-space high"
        assert found[-1].measured["calibrate"] == 100 * MS

    def test_while_the_highest_is_chosen_the_others_take_turns(self) -> None:
        channel = adaptive(calibrate_every=1)
        for number in range(12):
            result = channel.step(frame(number))
            assert result.decisions == {"rung": "high"}
            assert result.counts["error-checks"] == 2
            assert bounds(result) is None
            assert channel_of(result).error_reference == ""
        assert [bound.measured for bound in channel.calibration.bounds] == [6, 6, 0]

    def test_the_reference_may_be_no_rung(self) -> None:
        channel = adaptive(calibrate_every=1, reference=rung("exact", 500))
        found = [channel.step(frame(number)) for number in range(8)]
        assert set(labels(found)) == {"high"}
        assert {channel_of(result).error_reference for result in found} == {"free-space exact"}
        assert bounds(found[-1]) == [-60.0, -60.0]
        assert found[-1].measured["calibrate"] == 500 * MS
        with pytest.raises(ScenarioError, match="2 rungs with the label 'low'"):
            adaptive(reference=rung("low", 1))
        with pytest.raises(ScenarioError, match=r"reference.use.*'free-space'"):
            adaptive(reference={"label": "exact", "use": "free-spac"})

    def test_only_the_frames_asked_for_are_checked(self) -> None:
        channel = adaptive(calibrate_every=4)
        found = [channel.step(frame(number, 20)) for number in range(9)]
        assert ["calibrate" in result.measured for result in found] == [n % 4 == 0 for n in range(9)]
        unchecked = [adaptive().step(frame(n, 20)) for n in range(3)]
        assert not any("calibrate" in result.measured or bounds(result) for result in unchecked)

    def test_matrices_that_nobody_asked_for_are_not_sent(self) -> None:
        """They are needed to measure the error."""
        channel = adaptive(h=False, calibrate_every=1)
        found = [channel.step(frame(number, 20)) for number in range(5)]
        assert all(channel_of(result).h == () for result in found)
        assert bounds(found[-1]) is not None

    def test_a_declared_error_is_stated_until_it_is_measured(self) -> None:
        ladder = [{**LADDER[0], "expected_error_db": -15.0}, *LADDER[1:]]
        result = adaptive(ladder=ladder).step(frame(0, 20))
        assert (bounds(result), channel_of(result).expected_error_db) == ([-15.0, -15.0], -15.0)


class TestEpisodes:
    """What is known of errors goes on from episode to episode, and a repeated one is the same."""

    @staticmethod
    def played(channel: AdaptiveChannel, imposed: StepResult | None = None) -> list[StepResult]:
        begin = frame(0, 20)
        if imposed is not None:
            begin = msgspec.structs.replace(begin, imposed=imposed.decisions)
        return [channel.step(begin), *(channel.step(frame(number, 20)) for number in range(1, 6))]

    def test_errors_known_in_one_are_stated_in_the_next(self) -> None:
        channel = adaptive(calibrate_every=1)
        first = self.played(channel)
        channel.reset(1, 1, 0)
        second = self.played(channel)
        assert bounds(first[0]) == [6.0, 6.0]
        assert bounds(second[0]) == [-19.0, -19.0], "1 dB above the largest as long as few are known"
        assert list(first[0].decisions) == ["rung"]
        assert [list(result.decisions) for result in second] == [["rung", "state:errors"], *5 * [["rung"]]]

    def test_a_run_that_begins_anew_knows_nothing(self) -> None:
        channel = adaptive(calibrate_every=1)
        first = [encode_payload(channel_of(result)) for result in self.played(channel)]
        for episode in (0, 2):
            channel.reset(episode, 1, 0)
            assert [encode_payload(channel_of(result)) for result in self.played(channel)] == first

    def test_another_process_states_the_same_where_the_decision_is_imposed(self) -> None:
        """As a replay does it, and a broker with a service that was started again."""
        channel = adaptive(calibrate_every=1)
        self.played(channel)
        channel.reset(1, 1, 0)
        expected = self.played(channel)
        other = adaptive(calibrate_every=1)
        other.reset(1, 1, 0)
        found = self.played(other, expected[0])
        assert [encode_payload(channel_of(result)) for result in found] == [
            encode_payload(channel_of(result)) for result in expected
        ]
        assert found[0].decisions == expected[0].decisions

    @pytest.mark.parametrize(("text", "told"), [("{", "cannot be read"), ('{"lo": ""}', "about 'lo'")])
    def test_a_decision_that_is_none_is_refused(self, text: str, told: str) -> None:
        imposed = msgspec.structs.replace(frame(0), imposed={"state:errors": text})
        with pytest.raises(ScenarioError, match=told):
            adaptive(calibrate_every=1).step(imposed)
