"""``ertis bench passive`` compares acoustic maps with those of Acoular.

Acoular runs in a process of its own, because its import changes threads and warns.
"""

import importlib.util
import json
import os
import subprocess
import sys

import numpy as np
import pytest
from ertis_bench import passive
from ertis_bench.passive import agreement, false_alarms, separation, times
from ertis_bench.passive.bearings import plane_wave_settings

from ertis_numba.base.errors import DataError

SCRIPT = """
import json, warnings
warnings.simplefilter("ignore")
from acoular.tfastfuncs import nb
from ertis_bench.passive import agreement

nb.set_num_threads(1)  # hundreds of short loops are faster on one thread of a busy machine
agreement._DIRECTIONS = "3d:60"
agreement._CLEAN_STEP = 30
print(json.dumps(agreement.compare(seed=1, say=lambda text: None)))
"""


def test_maps_equal_those_of_acoular():
    if importlib.util.find_spec("acoular") is None:
        pytest.skip("acoular is not installed; it belongs to the extra 'peers'")
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    rows = {row["name"]: row for row in json.loads(done.stdout.splitlines()[-1])}
    assert list(rows) == list(agreement.CASES)
    for row in rows.values():
        assert row["largest_db"] < row["limit_db"]
        assert row["levels"] >= 10


def test_different_map_is_refused(monkeypatch):
    different = {"largest_db": 0.2, "median_db": 0.0, "levels": 1}
    monkeypatch.setattr(agreement, "_compared", lambda *_: different)
    with pytest.raises(DataError, match=r"delay_and_sum differs from Acoular by 0\.20 dB, more than 0\.1 dB"):
        agreement.compare(seed=0, say=lambda _: None)


def test_report_without_acoular_has_times_of_this_package(monkeypatch):
    monkeypatch.setattr("ertis_bench.passive.table.PACKAGE", "no_such_package")
    monkeypatch.setattr(times, "DIRECTIONS", "90")
    monkeypatch.setattr(times, "_OURS", 2)
    report = passive.run(count=1, seeds=2, bearings=0, trials=0, seed=0, say=lambda _: None)
    assert report["differences"] == []
    assert [row["name"] for row in report["times"]] == list(times.TIMED)
    assert all(row["ours"]["processor_ms"] > 0 and "acoular" not in row for row in report["times"])
    text = passive.form(report)
    assert "Acoular is not installed" in text
    assert "| signals to cross-spectral matrices |" in text
    shares = {(row["name"], row["apart_deg"], row["weaker_db"]): row["shares"] for row in report["separation"]}
    assert all(shares[name, 5.0, 0.0] == [1.0, 1.0] for name in ("capon", "music", "hr_clean_sc"))
    assert shares["clean_sc", 10.0, 0.0] == [1.0, 1.0]
    assert "| 5° and 10 dB apart |" in text
    assert "| music | 100% / 100% |" in text


def test_noise_has_the_asked_coherence_and_continues_across_measurements():
    settings = plane_wave_settings()
    case = false_alarms.NoiseCase("both", 0.5, 4)
    heard = np.concatenate([each.data for each in false_alarms.measurements(settings, case, seed=(0, 1))])
    assert heard.shape == (4 * settings.recording.n_samples, 32)
    spectra = np.fft.rfft(heard.T)[:, 11 * 480 : 13 * 480]  # bins of 6.9 Hz, at 36 to 43 kHz
    found = np.corrcoef(spectra)
    frequency_hz = np.fft.rfftfreq(len(heard), 1 / settings.recording.sample_rate_hz)[11 * 480 : 13 * 480 : 16]
    expected = false_alarms.coherence(settings, frequency_hz, 0.5).mean(axis=0)
    assert np.abs(found - expected).max() < 0.15
    assert np.abs((found - expected).real).mean() < 0.02


def test_false_alarms_are_counted_in_order_of_their_rates():
    counts = false_alarms.alarms(false_alarms.CASES[0], seed=0, first=0, count=6)
    assert 6 > counts[0] >= counts[1] >= counts[2]
    assert false_alarms.interval(5, 100) == pytest.approx((0.0164, 0.1128), abs=1e-4)
    assert false_alarms.interval(0, 20) == pytest.approx((0.0, 0.1684), abs=1e-4)


def test_false_alarms_alone_have_a_table(monkeypatch):
    rates = [{"asked": asked, "alarms": 3, "interval": (0.01, 0.2)} for asked in false_alarms.ASKED]
    found = {"trials": 30, "band_hz": (35e3, 45e3), "cases": [{**false_alarms.CASES[1]._asdict(), "rates": rates}]}
    monkeypatch.setattr(false_alarms, "measure", lambda **_: found)
    text = passive.form(
        passive.run(count=1, seeds=1, bearings=1, trials=30, seed=0, only=passive.PARTS, say=lambda _: None)
    )
    assert "| noise of | averages | 0.01 requested | 0.1 requested | 0.3 requested |" in text
    assert "| surroundings | 1 | 0.1000 (0.0100–0.2000) |" in text


def test_sources_are_separated_by_two_maxima_near_them():
    azimuth_deg = np.arange(-10.0, 11.0)
    power = np.exp(-((azimuth_deg + 3) ** 2)) + np.exp(-((azimuth_deg - 3) ** 2))
    assert separation.are_separated(power, azimuth_deg, (-2.5, 2.5))
    assert not separation.are_separated(power, azimuth_deg, (-5, 5))
    assert not separation.are_separated(power, azimuth_deg, (-3.5, 0.5))
    near = np.isin(azimuth_deg, (-1.0, 1.0)).astype(float)
    assert separation.are_separated(near, azimuth_deg, (-1.1, 1.3))
    assert not separation.are_separated(near, azimuth_deg, (-0.4, 0.4))
    assert not separation.are_separated(np.exp(-(azimuth_deg**2)), azimuth_deg, (-1, 1))
