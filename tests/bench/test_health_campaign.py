"""Short form of the campaign: no false alarm for healthy arrays, and every observable fault is named."""

import json

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_bench import health_trials as benchmark
from ertis_bench.health_trials.campaign import false_alarms, named
from ertis_bench.health_trials.faults import FAULTS
from ertis_bench.health_trials.scenes import SCENES, base
from ertis_cli.main import cli

from ertis_numba.analysis.health.kinds import KINDS
from ertis_numba.storage import write_recording


@pytest.mark.parametrize("seed", range(3 * len(SCENES)))
def test_health_names_no_fault_of_a_healthy_array(seed):
    assert false_alarms(seed)[1] == {}


@pytest.mark.parametrize(
    "seed",
    [
        60328,  # all modulators alternate for 17,000 samples, without noise
        60330,  # overlapping echoes shift the carrier of one channel by a period
        200738,  # echoes cancel at one channel in the loudest eighth of the record
    ],
)
def test_health_names_no_fault_of_ambiguous_healthy_arrays(seed):
    assert false_alarms(seed)[1] == {}


@pytest.mark.parametrize("name", [name for name, fault in FAULTS.items() if fault.observable])
def test_health_names_the_fault(name):
    is_named, report = named(name, 0)
    assert is_named, (report.faults, report.not_observable)
    assert all(finding.remedy for finding in report.findings)


@pytest.mark.parametrize("gain_db", [6.0, -6.0])
def test_gain_faults_have_the_gain_of_their_name(gain_db):
    healthy = base("one echo", 0, is_pdm=False)
    measurement, [channel] = FAULTS[f"gain {gain_db:+g} dB"].put_into(healthy, np.random.default_rng(0))
    peak = np.abs(measurement.data[:, channel].astype(float)).max() / 32768
    assert 20 * np.log10(peak / np.abs(healthy.signals[channel]).max()) == pytest.approx(gain_db, abs=0.3)


def test_every_fault_is_in_the_table_of_kinds():
    for fault in FAULTS.values():
        assert all(name in KINDS for name in fault.names)


@pytest.fixture
def white(tmp_path):
    """A recording whose first measurement has one unconnected channel."""
    fault = FAULTS["white bits, unconnected"]
    measurement, channels = fault.put_into(base("one echo", 0, is_pdm=True), np.random.default_rng(0))
    return write_recording(tmp_path / "rec.h5", [measurement]), channels[0]


def test_info_reports_value_limit_and_remedy_of_each_finding(white):
    path, channel = white
    done = CliRunner().invoke(cli, ["info", str(path), "--health", "--json"])
    [section] = json.loads(done.stdout)["sensors"]
    [finding] = [item for item in section["findings"] if item["fault"] == "white bits"]
    assert finding["channels"] == [channel]
    assert finding["measured"] > finding["limit"] == -3.0
    assert finding["unit"] == "dB"
    assert "connected" in finding["remedy"]
    lines = CliRunner().invoke(cli, ["info", str(path), "--health"]).stdout
    assert f"fault          channel {channel}: white bits, " in lines


def test_process_warns_of_an_unconnected_channel_in_one_line(white, tmp_path):
    path, channel = white
    options = [
        "--directions",
        "2d:31",
        "--range",
        "0.8:1.2",
        "--quiet",
        "--max-error",
        "-25",
        "-o",
        str(tmp_path / "img.h5"),
    ]
    done = CliRunner().invoke(cli, ["process", str(path), *options])
    assert done.exit_code == 0
    assert done.stderr.count("\n") == 1
    assert f"white bits: channel {channel}" in done.stderr
    assert CliRunner().invoke(cli, ["process", str(path), *options, "--force", "--strict"]).exit_code == 1


def test_process_warns_of_repeated_blocks_in_one_line(tmp_path):
    fault = FAULTS["repeated block"]
    measurement, _ = fault.put_into(base("one echo", 0, is_pdm=True), np.random.default_rng(0))
    path = write_recording(tmp_path / "rec.h5", [measurement])
    options = ["--directions", "2d:5", "--range", "0.8:1.2", "--quiet", "-o", str(tmp_path / "img.h5")]
    done = CliRunner().invoke(cli, ["process", str(path), *options])
    assert "sensor sensor has faults in its recording (repeated blocks" in done.stderr
    assert sum("faulty" in line or "faults" in line for line in done.stderr.splitlines()) == 1


def test_bench_health_writes_its_table(monkeypatch, tmp_path):
    monkeypatch.setattr(benchmark.campaign, "_SHORT", (2, 1))
    monkeypatch.setattr(benchmark.campaign, "FAULTS", {"stuck at 0": FAULTS["stuck at 0"]})
    page = tmp_path / "page.md"
    page.write_text("<!-- ertis bench health -->\n<!-- /ertis bench health -->\n")
    done = CliRunner().invoke(cli, ["bench", "health", "--update", str(page), "--quiet"])
    assert done.exit_code == 0, done.output
    assert "| stuck at 0 | 1 of 1 | yes | any scene |" in page.read_text()
    assert "0 of 2 (1 of silence, 1 of one echo)" in page.read_text()
