"""`caviar inspect`: the summary, the digest line, and the status for damage."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest
from recording_builders import absent, frame, link, product, record, record_run, recorder, scene, with_packets

from caviar_clients.cli.main import main
from caviar_clients.cli.recordings import inspect_command
from caviar_clients.cli.summary import summarise
from caviar_protocol.messages import Status
from caviar_protocol.recording import Recording
from caviar_protocol.recording.segment import Segment


def test_the_digest_is_one_line_and_that_of_the_bytes(tmp_path, capsys):
    record(tmp_path)
    assert inspect_command(tmp_path, digest=True) == 0
    out, err = capsys.readouterr()
    assert out == Recording(tmp_path).run_digest().digest + "\n"
    assert err == ""


def test_a_changed_byte_gives_another_digest_a_warning_and_status_1(tmp_path, capsys):
    file = record(tmp_path) / "recording-0000.mcap"
    inspect_command(tmp_path, digest=True)
    before = capsys.readouterr().out
    body = bytes(Recording(tmp_path).frame(0, 3).products[1].body)
    data = bytearray(file.read_bytes())
    data[data.index(body)] ^= 1
    file.write_bytes(data)
    assert inspect_command(tmp_path, digest=True) == 1
    out, err = capsys.readouterr()
    assert len(out) == 65
    assert out != before
    assert "frame 3 (recording-0000.mcap" in err
    assert "scene of 'world'" in err
    assert inspect_command(tmp_path) == 1
    assert "frame 3" in capsys.readouterr().err


def test_a_recording_that_breaks_off_has_a_digest_and_a_note(tmp_path, capsys):
    file = record(tmp_path) / "recording-0000.mcap"
    file.write_bytes(file.read_bytes()[: Segment(file).chunks[3].offset + 50])
    assert inspect_command(tmp_path, digest=True) == 1
    assert "lost are all frames after frame 2 of episode 0 up to frame 4" in capsys.readouterr().err
    (tmp_path / "recording.json").unlink()  # which a recorder that was killed does not say it closed
    assert inspect_command(tmp_path, digest=True) == 0
    out, err = capsys.readouterr()
    assert out.strip() == Recording(record(tmp_path / "three", frames=3)).run_digest().digest
    assert "that of 3 frames" in err


def test_the_summary_counts_every_status_and_leaves_users_without_path_out_of_means(tmp_path):
    late = product("link", "link", link(0), 0, Status.LATE, used_in=1)
    record(
        tmp_path,
        [
            frame(0, product("scene", "world", scene(0), 0), absent("link", "link", "late")),
            frame(
                1,
                product("scene", "world", scene(0), 0, Status.HELD, used_in=1),
                late,
                product("link", "link", link(1, without_path=(2,)), 1),
            ),
        ],
    )
    summary = summarise(Recording(tmp_path))
    assert [(s.topic, s.fresh, s.held, s.absent, s.late) for s in summary.sources] == [
        ("link", 1, 0, 1, 1),
        ("scene", 1, 1, 0, 0),
    ]
    assert summary.link is not None
    assert summary.link.mean_abs_y_best == pytest.approx(4.1)
    assert summary.link.mean_abs_y == pytest.approx(2.05)
    assert summary.link.mean_abs_y_baseline == pytest.approx(1.025)
    assert summary.link.no_path_share == pytest.approx(1 / 3)
    assert (summary.frames, summary.frames_planned, summary.episodes) == (2, 10, 1)
    assert summary.simulated_s == pytest.approx(0.2)


def test_the_summary_adds_up_packets_where_the_link_has_some(tmp_path, capsys):
    links = [with_packets(link(0)), link(1), with_packets(link(2))]
    record(tmp_path, [frame(n, product("link", "link", made, n)) for n, made in enumerate(links)])
    assert inspect_command(tmp_path) == 0
    shown = " ".join(capsys.readouterr().out.split())
    # Of each three users 0, 1 and 2 kbit of 10 kbit came through; 1 of 6 blocks failed.
    assert "10.0% sent, 10.0% dropped, mean delay 2 ms, mean throughput 10 kbit/s a user" in shown
    assert inspect_command(tmp_path, as_json=True) == 0
    packets = json.loads(capsys.readouterr().out)["link"]["packets"]
    assert (packets["sent"], packets["block_errors"], packets["blocks"]) == (6000, 2, 12)


def test_the_json_summary_is_complete_json(tmp_path, capsys):
    record(tmp_path, frames=3, notes=("windy",))
    assert inspect_command(tmp_path, as_json=True) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["run"] == "sample-1"
    assert content["frames"] == 3
    assert content["complete"] is True
    assert content["link"]["no_path_share"] == 0
    assert content["versions"]["mcap"]
    assert content["notes"] == ["windy"]


def test_the_table_names_run_topics_and_what_is_missing(tmp_path, capsys):
    made = recorder(tmp_path)
    made.step(frame(0))
    assert inspect_command(tmp_path) == 0
    out = capsys.readouterr().out
    for word in ("sample-1", "seed 7", "breaks off", "1 of 10 planned", "mean |y|", "scene", "world", "mcap"):
        assert word in out
    made.close()


def test_an_empty_run_is_summarised_without_means(tmp_path, capsys):
    record(tmp_path, frames=0)
    assert inspect_command(tmp_path) == 0
    assert "0 of 10 planned" in capsys.readouterr().out


def test_without_a_run_the_newest_is_taken_and_named(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    record(tmp_path / "runs" / "smoke-1")
    monkeypatch.setattr(sys, "argv", ["caviar", "inspect", "--digest"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0
    out, err = capsys.readouterr()
    assert out == Recording("runs/smoke-1").run_digest().digest + "\n"
    assert err == "run runs/smoke-1, the newest in ./runs\n"


def test_the_gain_over_a_random_pair_is_that_of_all_pairs(tmp_path):
    """Of `smoke`: mean |y|² of the chosen pairs over that of all pairs, each swept."""
    recording = Recording(record_run(tmp_path))
    link = summarise(recording).link
    assert link is not None
    pairs = recording["channel"].beam_gains ** 2  # frames × users × Nt × Nr, NaN past a user's own arrays
    chosen = np.mean(recording["link"].abs_y ** 2)
    random, best = np.nanmean(pairs, (2, 3)).mean(), np.nanmax(pairs, (2, 3)).mean()
    assert link.gain_over_random_db == pytest.approx(10 * np.log10(chosen / random))
    assert link.loss_to_best_db == pytest.approx(10 * np.log10(best / chosen))
