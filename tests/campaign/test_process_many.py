"""``ertis process`` with several recordings: its output and exit codes."""

import io
import json
import re
import sys
from pathlib import Path

import click
import pytest
from click.testing import CliRunner
from ertis_cli import _process_many
from ertis_cli.main import cli

from ertis_numba.campaign import Campaign, CampaignOptions, RecordingEnded, RecordingProgress, RecordingStarted
from ertis_numba.pipeline import verification
from tests.campaigns import InlinePool, names_in, write_recordings
from tests.files import line

pytestmark = pytest.mark.usefixtures("sound_unchecked")

FAST = ["--range", "0.5:0.8", "--directions", "2d:9", "--workers", "1"]


@pytest.fixture
def runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_recordings(tmp_path / "runs", names="ab", settings=line(8, 8))
    (tmp_path / "runs" / "broken.h5").write_bytes(b"broken")
    return tmp_path / "runs"


def run(*arguments, code=0):
    done = CliRunner().invoke(cli, ["process", *(str(argument) for argument in arguments)])
    assert done.exit_code == code, (done.stderr, done.exception)
    return done


@pytest.fixture
def in_test_process(monkeypatch):
    """Process recordings in the test's own process, because worker processes start slowly."""
    monkeypatch.setattr(Campaign, "_pool", lambda _: InlinePool())


@pytest.mark.usefixtures("in_test_process")
def test_process_reports_each_recording_and_a_summary(runs, tmp_path):
    done = run("runs/*.h5", "-o", "out/", *FAST, "--json", code=1)
    *each, total = [json.loads(line) for line in done.stdout.splitlines()]
    assert {one["recording"]: one["outcome"] for one in each} == {
        "runs/a.h5": "made",
        "runs/b.h5": "made",
        "runs/broken.h5": "failed",
    }
    (made,) = [one for one in each if one["recording"] == "runs/a.h5"]
    assert (made["output"], made["measurements"], made["sensors"][0]["directions"]) == ("out/a.energy.h5", 3, 9)
    (failed,) = [one for one in each if one["outcome"] == "failed"]
    assert failed["error"].startswith("runs/broken.h5 is not an HDF5 file")
    assert total.pop("seconds") > 0
    assert total == {"recordings": 3, "made": 2, "kept": 0, "skipped": 0, "failed": 1, "measurements": 6}
    lines = done.stderr.splitlines()
    assert any(line.startswith("out/a.energy.h5: 3 measurements, 9 directions × ") for line in lines)
    assert any(line.startswith("ertis: failed: runs/broken.h5 is not an HDF5 file") for line in lines)
    assert [line.split()[:2] for line in lines if line.split()[:1] == ["runs/broken.h5"]] == [
        ["runs/broken.h5", "failed"]
    ]
    assert "3 recordings: 2 made, 1 failed; 6 measurements in " in lines[-2]
    assert lines[-1].startswith("ertis: error: 1 of 3 recordings failed")
    assert names_in(tmp_path / "out") == ["a.energy.h5", "b.energy.h5"]
    done = run("runs", "-o", "out", *FAST, "--quiet", code=1)
    assert done.stdout == ""
    assert [line.partition(" is ")[0] for line in done.stderr.splitlines()[:-1]] == ["ertis: failed: runs/broken.h5"]
    (runs / "broken.h5").unlink()
    done = run("runs", "-o", "out", *FAST)
    assert "out/a.energy.h5: exists already, kept" in done.stderr.splitlines()
    assert "2 recordings: 2 kept; 0 measurements in " in done.stderr


@pytest.mark.usefixtures("in_test_process")
def test_process_reports_plans_and_verifies_each_recording(runs):
    (runs / "broken.h5").unlink()
    done = run("runs", "-o", "out", *FAST, "--explain", "--verify", "--json")
    *each, _ = [json.loads(line) for line in done.stdout.splitlines()]
    for one in each:
        (sensor,) = one["sensors"]
        assert sensor["verified"]["error_db"] <= sensor["verified"]["max_error_db"]
        assert sensor["plan"]["safe_db"] <= -35.0
        assert "lines" not in sensor
    done = run("runs", "-o", "more", *FAST, "--explain")
    assert done.stderr.count("plan of eRTIS-7 for an error budget of -35 dB:") == 2
    again = run("runs", "-o", "more", *FAST, "--explain")
    assert again.stderr.count("plan of eRTIS-7 for an error budget of -35 dB:") == 2
    assert again.stderr.count(": exists already, kept\n") == 2


@pytest.mark.usefixtures("in_test_process")
def test_images_beyond_the_budget_are_not_written(runs, monkeypatch):
    measured = verification.Measured(error_db=-30.0, n_directions=7, peaks=None)
    monkeypatch.setattr(verification, "measure", lambda *_, **__: measured)
    done = run("runs", "-o", "out", *FAST, "--verify", code=1)
    for name in "ab":
        assert (
            f"ertis: failed: runs/{name}.h5: image of sensor eRTIS-7 has an error of -30.0 dB, but the limit is -35 dB"
            in done.stderr
        )
    assert names_in(runs.parent / "out") == []


@pytest.mark.usefixtures("in_test_process")
@pytest.mark.parametrize(
    ("arguments", "code", "stated"),
    [
        (["runs/a.h5", "runs/b.h5"], 2, "several recordings need an output folder; choose one with -o"),
        (["runs"], 2, "several recordings need an output folder"),
        (
            ["runs/a.h5", "--workers", "2"],
            2,
            "--workers applies to several recordings; add recordings, use a folder or a pattern",
        ),
        (["runs/a.h5", "--workers", "tcp://x:1"], 2, "--workers applies to several recordings"),
        (["runs", "-o", "out", "--workers", "0"], 2, "'0' is not a number of workers; use a number of at least 1"),
        (["none/*.h5", "-o", "out"], 1, "no file matches none/*.h5; choose another pattern"),
        (
            ["runs", "-o", "runs/a.h5"],
            2,
            "-o runs/a.h5 names a file, but several recordings need a folder; use -o runs/a/",
        ),
        (["runs", "-o", "out", "--directions", "90", "--azimuth", "-9:9"], 2, "directions 90 have fixed limits"),
        (["runs", "-o", "out", "--method", "paper", "--explain"], 2, "--explain needs --method fast"),
    ],
)
def test_process_refuses_invalid_usage(runs, arguments, code, stated):
    done = run(*arguments, code=code)
    assert stated in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (runs.parent / "out").exists() or names_in(runs.parent / "out") == []


def test_process_accepts_a_folder_for_one_recording(runs, tmp_path):
    run(runs / "a.h5", "-o", "out/", *FAST)
    assert names_in(tmp_path / "out") == ["a.energy.h5"]


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.usefixtures("in_test_process")
def test_progress_bars_appear_on_a_terminal(runs, monkeypatch, capsys):
    terminal = Terminal()
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setattr(sys, "stderr", terminal)
    (runs / "broken.h5").unlink()
    with click.Context(click.Command("process")):
        _process_many.process_many(["runs"], "out", CampaignOptions(), workers=None, quiet=False, as_json=True)
    shown = re.sub(r"\x1b\[[\d;?]*\w", "", terminal.getvalue())  # Remove colours.
    assert re.search(r"recordings ━+ \d/2", shown)
    assert "out/a.energy.h5: 3 measurements" in shown
    assert len(capsys.readouterr().out.splitlines()) == 3  # Progress bars go to stderr.


def test_each_recording_in_progress_has_a_bar(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    bars = vars(_process_many)["_Bars"](3)

    def drawn():
        return [(task.description, task.completed, task.total) for task in bars.progress.tasks]

    paths = [Path(f"runs/{name}.h5") for name in "ab"]
    bars.follow(RecordingProgress(paths[0], 3))  # Its start was not reported.
    for path in paths:
        bars.follow(RecordingStarted(path, 7))
    bars.follow(RecordingProgress(paths[1], 4))
    assert drawn() == [("recordings", 0, 3), ("a.h5", 0, 7), ("b.h5", 4, 7)]
    bars.follow(RecordingEnded(paths[1], Path("out/b.energy.h5"), "failed"))
    assert drawn() == [("recordings", 1, 3), ("a.h5", 0, 7)]


def test_long_table_lists_failed_recordings_only(monkeypatch, capsys):
    monkeypatch.setattr(_process_many, "_MAX_ROWS", 2)
    monkeypatch.setattr(_process_many, "_MAX_FAILED", 2)
    paths = [Path(f"runs/{number}.h5") for number in range(5)]
    report = vars(_process_many)["_Report"](paths, quiet=False, as_json=False)
    shown = vars(_process_many)["_Hidden"]()
    for path in paths:
        outcome = "kept" if path == paths[1] else "failed"
        report.follow(RecordingEnded(path, Path("out"), outcome, error="torn" if outcome == "failed" else ""), shown)
    with pytest.raises(click.ClickException, match="4 of 5 recordings failed"):
        report.close()
    table = capsys.readouterr().err.partition("outcome")[2]
    assert [line.split()[0] for line in table.splitlines() if "failed" in line] == [
        *("runs/0.h5", "runs/2.h5", "…"),
        "5",
    ]
    assert "… and 2 more" in table
