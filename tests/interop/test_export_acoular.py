"""Acoular opens exported files, and its own beamformer finds the reflectors.

Acoular runs in a separate process, because its import changes Numba's threads and warns if NumPy is already loaded.
"""

import json
import os
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree as ET

import h5py
import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.chain.signals import signals_of
from ertis_numba.frames import Measurement
from ertis_numba.geometry import microphones
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.geometry.waveform import call_at
from ertis_numba.interop import export
from ertis_numba.settings import Settings
from tests.cases import words_of
from tests.files import image, line, noise

REFLECTORS = Path(__file__).parents[2] / "data" / "synthetic" / "reflectors.h5"
SCRIPT = """
import json, sys
import acoular as ac
import numpy as np

ac.config.global_caching = "none"
samples, first, stop, range_m, speed_m_s = sys.argv[1], *map(int, sys.argv[2:4]), *map(float, sys.argv[4:])
source = ac.MaskedTimeSamples(file=samples, start=first, stop=stop)
mics = ac.MicGeom(file=samples.removesuffix(".h5") + ".xml")
azimuth_deg = np.arange(-80.0, 81.0, 2.0)
azimuth_rad = np.radians(azimuth_deg)
grid = ac.ImportGrid()
grid.pos = range_m * np.array([np.cos(azimuth_rad), np.sin(azimuth_rad), np.zeros_like(azimuth_rad)])
spectra = ac.PowerSpectra(source=source, block_size=512, window="Hanning", overlap="50%", cached=False)
steer = ac.SteeringVector(grid=grid, mics=mics, env=ac.Environment(c=speed_m_s))
beams = ac.BeamformerBase(freq_data=spectra, steer=steer, cached=False)
power = sum(beams.synthetic(hz, 0) for hz in range(28_000, 48_000, 500))
whole = ac.TimeSamples(file=samples)
facts = {name: str(value) for name, value in whole.metadata.items()}
print(json.dumps({"azimuth_deg": azimuth_deg[power.argmax()], "rate_hz": float(whole.sample_freq),
                  "shape": [whole.num_samples, whole.num_channels], "mics": mics.pos.tolist(), "metadata": facts}))
"""


def test_acoular_finds_the_reflectors(tmp_path):
    """The nearest is at -38° and 1.15 m, within a window around its echo."""
    with ertis.open_recording(REFLECTORS) as recording:
        measurement = recording[0]
    path, geometry = export(tmp_path / "signals.h5", [measurement])
    assert [path.name, geometry.name] == ["signals.h5", "signals.xml"]
    settings = measurement.settings
    speed_m_s = sound_speed_m_s(settings.air)
    first = round(2 * 1.15 / speed_m_s * settings.signal_rate_hz)
    stop = first + round(settings.call.duration_s * settings.signal_rate_hz)
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, path, *map(str, (first - 20, stop + 20, 1.15, speed_m_s))],
        cwd=tmp_path,
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    reported = json.loads(done.stdout)
    assert reported["azimuth_deg"] == -38.0
    assert reported["rate_hz"] == settings.signal_rate_hz
    assert reported["shape"] == [-(-settings.recording.n_samples // settings.decimation), 32]
    assert np.array_equal(np.transpose(reported["mics"]), microphones(settings.array).enabled_positions_m)
    assert reported["metadata"]["sensor"] == "sensor"
    assert float(reported["metadata"]["sound_speed_m_s"]) == speed_m_s
    assert Settings.from_toml(reported["metadata"]["settings"]).call == settings.call
    assert {item.name for item in tmp_path.iterdir()} == {"signals.h5", "signals.xml"}  # no cache


def test_exported_signals_equal_the_decoded_samples():
    """A call in PDM words keeps its time and level, within the quantisation noise."""
    settings = line(8, 8)
    rate_hz, n_samples = settings.recording.sample_rate_hz, settings.recording.n_samples
    given = 0.5 * call_at(settings.call, np.arange(n_samples) / rate_hz - 2e-3)
    words = words_of(np.tile(given, (8, 1))).astype(np.uint8)
    array = settings.array.replace(gain=(1.0,) * 7 + (2.0,), enabled=(True, False) * 2 + (True,) * 4)
    signals = signals_of(Measurement(words, settings.replace(array=array)))
    wanted = given[:: settings.decimation]
    assert signals.dtype == np.float32
    assert signals.shape == (6, len(wanted))
    for signal, gain in zip(signals, [1, 1, 1, 1, 1, 2], strict=True):
        assert np.sqrt(np.mean((gain * signal - wanted) ** 2)) < 0.25  # white noise of 1, low-passed
        assert gain * (signal @ wanted) / (wanted @ wanted) == pytest.approx(1.0, abs=0.03)


def test_acoular_files_have_the_documented_content(tmp_path):
    settings = line(8, 8)
    settings = settings.replace(array=settings.array.replace(layout='my "<array>"', enabled=(False,) + (True,) * 7))
    (measurement,) = noise(settings, 1)
    path, geometry = export(tmp_path / "a.h5", [measurement])
    with h5py.File(path) as file:
        assert set(file) == {"time_data", "metadata"}
        assert file["time_data"].dtype == np.float32
        assert np.array_equal(file["time_data"][:].T, signals_of(measurement))
        assert file["time_data"].attrs["sample_freq"] == settings.signal_rate_hz
        assert file["metadata"].attrs["timestamp_ns"] == measurement.stamp.timestamp_ns
        assert file["metadata"].attrs["sequence"] == 10
    root = ET.parse(geometry).getroot()
    assert (root.tag, root.get("name")) == ("MicArray", 'my "<array>"')
    assert [item.get("Name") for item in root] == [f"channel {channel}" for channel in range(1, 8)]
    places_m = [[float(item.get(axis)) for axis in "xyz"] for item in root]
    assert np.array_equal(places_m, microphones(settings.array).enabled_positions_m)


def test_acoular_export_refuses_invalid_input(tmp_path, monkeypatch):
    for given, message in (
        (noise(), "contains signals of one measurement, but more than one measurement was passed; choose one"),
        ([], "but no measurement was passed;"),
        ([image()], "but an energyscape was passed"),
    ):
        with pytest.raises(ArgumentError, match=message):
            export(tmp_path / "a.h5", given)
    for overwrite in (False, True):
        with pytest.raises(ArgumentError, match=r"b.xml is also the name of the array's file; choose"):
            export(tmp_path / "b.xml", noise(count=1), file_format="acoular", overwrite=overwrite)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "a.xml").write_text("mine")
    with pytest.raises(ArgumentError, match=r"a.xml exists; choose another name"):
        export(tmp_path / "a.h5", noise(count=1))
    assert [item.name for item in tmp_path.iterdir()] == ["a.xml"]
    monkeypatch.setattr("ertis_numba.base.atomic_files.RESERVED_BYTES", 2**62)
    with pytest.raises(DataError, match=r"MB free, but .* including a reserve of .*; free some space"):
        export(tmp_path / "b.h5", noise(count=1))
    assert [item.name for item in tmp_path.iterdir()] == ["a.xml"]
