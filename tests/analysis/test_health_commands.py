"""Health in ``ertis info`` and ``ertis process``, and the examples and limits in docs/."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba.analysis.health import limits
from ertis_numba.frames import Measurement, Stamp
from ertis_numba.geometry import load_layout
from ertis_numba.storage import write_energyscapes, write_recording
from tests import files
from tests.health_recordings import (
    REAL,
    ROOT,
    real,
)
from tests.pages import path_of


def run(*arguments, code=0):
    done = CliRunner().invoke(cli, [str(argument) for argument in arguments])
    assert done.exit_code == code, (done.stderr, done.exception)
    return done


@pytest.fixture
def sick(tmp_path):
    """Ten measurements; the last one alone has a stuck bit."""
    words = [real().data] * 9 + [real().data & ~np.uint32(1 << 4)]
    given = [Measurement(each, REAL, Stamp(sequence=number)) for number, each in enumerate(words)]
    return write_recording(tmp_path / "rec.h5", given)


def test_info_reports_the_health(sick, tmp_path):
    held = json.loads(run("info", sick, "--health", "--json").stdout)
    [section] = held["sensors"]
    assert (section["measurements"], section["examined"]) == (10, 8)
    assert section["faults"] == {"stuck at 0": [4]}
    assert [row["state"] for row in section["channels"][3:6]] == ["ok", "stuck at 0", "ok"]
    assert section["dynamic_range_db"] == pytest.approx(84, abs=3)
    lines = run("info", sick, "--health").stdout.splitlines()
    assert "10, of which 8 examined" in lines[1]
    assert lines[9].split()[:4] == ["4", "stuck", "at", "0"]
    assert len({len(line) for line in lines[4:37]}) == 1
    assert lines[37].startswith("not observable ") or lines[37].startswith("fault ")
    assert any(line.startswith("fault          channel 4: stuck at 0, 0 (limit 0.001); exclude them") for line in lines)
    image = write_energyscapes(tmp_path / "img.h5", [files.image()])
    done = run("info", image, "--health", code=1)
    assert done.stderr == (
        f"ertis: error: {image} is an energyscape file, wanted a recording; use the recording from which it was made\n"
    )
    assert done.stdout == ""


@pytest.fixture
def faulty(tmp_path):
    """A recording whose first measurement has two stuck bits."""
    words = real().data & ~np.uint32(1 << 4) | np.uint32(1 << 9)
    second = dataclasses.replace(real(), stamp=Stamp(sequence=1))
    return write_recording(tmp_path / "rec.h5", [dataclasses.replace(real(), data=words), second])


# Converter noise is a larger part of so small an image than the default budget permits, which `process` reports, too.
FAST = ["--directions", "2d:31", "--range", "0.8:1.2", "--quiet", "--max-error", "-25"]


def test_process_warns_once_of_a_fault(faulty, tmp_path):
    done = run("process", faulty, "-o", tmp_path / "img.h5", *FAST)
    assert done.stderr == (
        f"ertis: warning: {faulty}: sensor sensor has faulty microphones (stuck at 0: channel 4; stuck at 1: "
        "channel 9); exclude them with --without 4,9, or see 'ertis info --health'\n"
    )
    assert (tmp_path / "img.h5").exists()


def test_process_strict_refuses_faulty_recordings(faulty, tmp_path):
    done = run("process", faulty, "-o", tmp_path / "img.h5", *FAST, "--strict", code=1)
    assert done.stderr.startswith(f"ertis: error: {faulty}: sensor sensor has faulty microphones (stuck at 0: channel")
    assert done.stderr.count("\n") == 1
    assert [item.name for item in tmp_path.iterdir()] == ["rec.h5"]


def test_suggested_remedy_fixes_the_fault(faulty, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    layout = load_layout("eRTIS_v3D1")
    rows = (1000 * layout.positions_m).tolist()
    Path("mine.toml").write_text(f"positions_mm = {rows}\ndisabled = [4, 9]\n")
    Path("settings.toml").write_text('array.layout = "mine.toml"\n')
    done = run("process", faulty, "-o", "img.h5", *FAST, "--settings", "settings.toml", "--strict")
    assert done.stderr == ""


def test_process_prints_nothing_for_healthy_recordings(tmp_path):
    path = write_recording(tmp_path / "rec.h5", [real()])
    assert run("process", path, "-o", tmp_path / "img.h5", *FAST, "--strict").stderr == ""


def test_silence_is_not_a_fault_of_single_microphones(tmp_path):
    path = write_recording(tmp_path / "rec.h5", [dataclasses.replace(real(), data=0 * real().data)])
    reported = run("process", path, "-o", tmp_path / "img.h5", *FAST).stderr
    assert "(stuck at 0: every channel); check its cable and supply, or see" in reported


def test_health_page_shows_the_printed_output(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("data").symlink_to(ROOT / "data")
    page = path_of("health").read_text("utf-8")
    for block in re.findall(r"```\n(.*?)```", page, re.DOTALL):
        for part in block.split("$ ertis ")[1:]:
            command, shown = part.split("\n", 1)
            done = run(*command.split(), *["--quiet"] * (not command.startswith("info")))
            assert done.stdout + done.stderr == shown, command


def test_health_page_has_the_limits():
    page = " ".join(path_of("health-checks").read_text("utf-8").split())
    for reported in (
        f"less than {100 * limits.MIN_CHANGES:g} % of",
        f"more than {100 * limits.MAX_SATURATED:g} % of",
        f"more than {limits.MAX_OFFSET:g} |",
        f"more than {limits.MAX_TONE_DB:g} dB out of",
        f"more than {-limits.MIN_LEVEL_DB:g} dB below",
        f"rise by {limits.MIN_RISE_DB:g} dB",
        f"first {limits.MAX_SAMPLES:,} samples",
        f"{limits.MAX_NOISE_DB:g} dB, or five",
        f"{-limits.MAX_WHITE_DB:g} dB below white bits",
        f"{-limits.MAX_FLIPPED_DB:g} dB below white bits, up to {-limits.MAX_FLIPS_DB:g} dB",
        f"{limits.MAX_STUCK_SAMPLES:,} samples, {limits.MAX_STUCK_NUMBERS} of PCM",
        f"{limits.MAX_HUM:g}, or four",
        f"{limits.MAX_GAIN_DB:g} dB, or five",
        f"| {1e6 * limits.MAX_DELAY_S:g} µs |",
        f"{limits.MIN_REPEATED_SAMPLES} samples",
        f"{1e6 * limits.MAX_SHIFT_S:g} µs",
        f"{limits.MAX_SWAP_DB:g} dB |",
    ):
        assert reported in page, reported
