"""RTIS Dev with our modules in the place of its closed ones: its own tests, its presets, and its errors."""

import copy
import inspect
import logging
import os
import re
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from importlib.metadata import distribution
from pathlib import Path
from types import FunctionType

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli
from scipy.ndimage import maximum_filter1d

import ertis_numba.interop.rtisdev
from ertis_numba.base.errors import ArgumentError
from ertis_numba.devices.emulator import Emulator
from ertis_numba.devices.setup import Setup
from ertis_numba.interop.rtisdev import rtiscuda, rtisserial
from ertis_numba.settings import Call, Settings
from ertis_numba.simulation import Point, Scene
from ertis_numba.simulation.render import render
from tests import rtisdev_reference
from tests.emulated import PATIENT, patient
from tests.journals import ENVIRONMENT

__all__ = ["patient"]  # A fixture, imported for use here.

rtisdev = pytest.importorskip("rtisdev")
pytestmark = [pytest.mark.filterwarnings("ignore::DeprecationWarning"), PATIENT]

ROOT = Path(__file__).parents[2]
SCENE = ROOT / "data" / "synthetic" / "scenes" / "two_facing_sensors.toml"
TIMEOUT_S = 600.0
WIDE = ["3D_5m_1000", "3D_5m_3000", "3D_5m_4000", "3D_10m_3000"]
MAX_ERROR_DB = -60
N_COMBINED = 26  # ranges before and after a range whose sound contributes to it, half of 512 taps


def own_tests():
    """Folder with the tests of the package."""
    return Path(distribution("rtisdev").locate_file("tests"))


@pytest.fixture(autouse=True)
def without_a_sensor():
    """Let the package use its stored measurement, and forget all settings after the test."""
    quiet = logging.getLogger("quiet")
    quiet.setLevel(logging.CRITICAL + 1)
    rtisdev.set_custom_logger(quiet)
    rtisdev.open_connection("/dev/no-such-port", allowDebugMode=True)
    yield
    rtisdev.clear_current_settings()
    rtiscuda.unloadall()


def prepared(name="test", *, recording="default_25_50", **processing):
    """Settings of the package under a name."""
    rtisdev.set_recording_settings(premade=recording, configName=name)
    rtisdev.set_processing_settings(configName=name, **processing)
    return rtisdev.get_current_settings(configName=name)


def measured(settings):
    """Raw measurement of the length that the settings say."""
    measurement = rtisdev.get_raw_measurement(behaviour=False, configName=settings.configName)
    measurement.rawData = np.resize(measurement.rawData, settings.microphoneSamples)
    return measurement


def error_db(got, wanted):
    assert got.dtype == np.float32
    assert got.shape == wanted.shape
    return 10 * np.log10(np.mean((got - wanted) ** 2) / np.mean(wanted**2))


def compare(settings):
    """Compare the result of a measurement with that of the reference.

    Cleaning may decide either way for amplitudes that differ from their limit by less than -60 dB of the loudest sound
    at the ranges that the envelope's filter combines.
    """
    measurement = measured(settings)
    got = rtisdev.process_measurement(measurement, configName=settings.configName).processedData
    uncleaned = copy.copy(settings)
    uncleaned.cleanEnable = False
    wanted = rtisdev_reference.processed(uncleaned, measurement.rawData)
    if settings.cleanEnable:
        limit = rtisdev_reference.limits(settings, wanted)
        loudest = maximum_filter1d(wanted.max(axis=0), 2 * N_COMBINED + 1)
        certain = np.abs(wanted - limit) > 10 ** (MAX_ERROR_DB / 20) * loudest
        assert np.mean(certain) > 0.95
        kept = wanted > limit
        # The fifth root of a sample near 0 turns an error of 1e-7 into one of 4 %, which is rare.
        rare = 1e-4 if settings.dmasOrder > 1 else 0.0
        assert np.mean((got[certain] != 0) != kept[certain]) <= rare
        wanted = np.where(got != 0, wanted, 0.0)
    assert error_db(got, wanted) <= MAX_ERROR_DB
    assert np.argmax(np.abs(got)) == np.argmax(np.abs(wanted))


def test_all_presets_are_tested():
    """Presets with many directions are compared without cleaning, and in some directions only."""
    presets = set(rtisdev.get_premade_processing_settings_list())
    assert presets == {"2D_5m_91", "2D_5m_181", "3D_5m_500", "custom_example_2D_5m_91", *WIDE}


@pytest.mark.parametrize("preset", ["2D_5m_91", "2D_5m_181", "3D_5m_500"])
def test_presets_equal_the_reference(preset):
    compare(prepared(premade=preset))


def test_preset_with_its_own_delays_and_ranges_equals_the_reference():
    folder = Path(rtisdev.__file__).parent / "config" / "premadeSettings" / "processing"
    compare(prepared(jsonPath=str(folder / "custom_example_2D_5m_91.json")))
    compare(prepared(customPath=str(folder)))


@pytest.mark.parametrize("preset", WIDE)
def test_wide_presets_equal_the_reference(preset):
    settings = prepared(
        recording="long_25_50" if "10m" in preset else "default_25_50", premade=preset, cleanEnable=False
    )
    measurement = measured(settings)
    got = rtisdev.process_measurement(measurement, configName="test").processedData
    assert got.shape == (settings.nDirections, settings.nspses)
    some = np.arange(3, settings.nDirections, settings.nDirections // 40)
    settings.delayMatrix, settings.nDirections = settings.delayMatrix[:, some], len(some)
    wanted = rtisdev_reference.processed(settings, measurement.rawData)
    assert error_db(got[some], wanted) <= MAX_ERROR_DB
    assert np.array_equal(got[some].argmax(axis=1), wanted.argmax(axis=1))


FAST_DB = -30
"""Largest difference of the fast method; it removes what the low pass of rectified beams leaves of twice the
frequency."""


@pytest.fixture
def fast(monkeypatch, caplog):
    monkeypatch.setenv("ERTIS_RTISDEV_METHOD", "fast")
    return caplog


def announced(text):
    """Differences for loud and weak echoes that the log reports."""
    (found,) = re.findall(r"from exact ones by about (-\d+) dB for loud echoes and (-\d+) dB for echoes", text)
    return tuple(map(int, found))


@pytest.mark.parametrize("preset", ["2D_5m_91", "2D_5m_181", "3D_5m_500"])
def test_fast_method_predicts_its_difference_from_the_exact_one(fast, preset):
    settings = prepared(premade=preset, cleanEnable=False)
    predicted, _ = announced(fast.text)
    measurement = measured(settings)
    got = rtisdev.process_measurement(measurement, configName="test").processedData
    wanted = rtisdev_reference.processed(settings, measurement.rawData)
    found_db = error_db(got, wanted)
    assert found_db < FAST_DB
    assert abs(found_db - predicted) < 4
    direction, sample = np.unravel_index(np.argmax(got), got.shape)
    wanted_direction, wanted_sample = np.unravel_index(np.argmax(wanted), wanted.shape)
    assert (direction, abs(sample - wanted_sample) <= 1) == (wanted_direction, True)


@pytest.mark.parametrize(
    ("limits", "range_m", "strength_db"),
    [((0.5, 5.0), 4.0, -40.0), ((0.5, 5.0), 0.7, -60.0), ((0.3, 1.0), 0.5, -80.0), ((0.1, 0.6), 0.3, -70.0)],
    ids=["far", "near in a long image", "near", "nearest"],
)
def test_fast_method_predicts_its_difference_for_weak_and_near_echoes(fast, limits, range_m, strength_db):
    settings = prepared(directions=31, minRange=limits[0], maxRange=limits[1], cleanEnable=False)
    loud_db, weak_db = announced(fast.text)
    words = render(Scene(points=(Point(range_m=range_m, azimuth_deg=15, strength_db=strength_db),))).data.reshape(-1)
    got = rtiscuda.processing(words, 1, settings.nDirections, settings.nspses, "test")
    found_db = error_db(got, rtisdev_reference.processed(settings, words))
    assert loud_db - 4 < found_db < weak_db + 4 < -15


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"dmasOrder": 2}, "without DMAS"),
        ({"cfEnable": True}, "without DMAS and coherence factor"),
        ({"enveloppeEnable": False, "cleanEnable": False}, "it requires a matched filter, beamforming and an envelope"),
        ({"postFilterEnable": True, "postFilter": np.ones(5)}, "no filters before or after"),
    ],
    ids=["DMAS", "coherence factor", "beams", "filter"],
)
def test_fast_method_is_refused_with_the_reason_where_it_cannot(fast, changes, reason):
    settings = prepared(directions=91, **changes)
    assert "'test' uses the exact method, because the fast one cannot" in fast.text
    assert reason in fast.text
    compare(settings)


def test_fast_method_cleans_images_and_leaves_out_microphones(fast, monkeypatch):
    preload = rtiscuda.preload
    monkeypatch.setattr(rtiscuda, "preload", lambda *given: preload(*given[:-3], np.array([3, 17]), *given[-2:]))
    settings = prepared(premade="2D_5m_91")
    assert settings.cleanEnable
    settings.disableList = np.array([3, 17])
    assert "uses the fast method" in fast.text
    measurement = measured(settings)
    got = rtisdev.process_measurement(measurement, configName="test").processedData
    wanted = rtisdev_reference.processed(settings, measurement.rawData)
    assert np.mean((got == 0) & (wanted == 0)) > 0
    assert np.mean((got == 0) != (wanted == 0)) < 0.05
    both = (got != 0) & (wanted != 0)
    assert np.linalg.norm((got - wanted)[both]) < 10 ** (FAST_DB / 20) * np.linalg.norm(wanted[both])


def test_unknown_method_is_refused(monkeypatch):
    monkeypatch.setenv("ERTIS_RTISDEV_METHOD", "quick")
    with pytest.raises(ArgumentError, match=r"METHOD 'quick' is unknown; known are exact, fast"):
        prepared(directions=91)


@pytest.mark.parametrize("coherent", [False, True])
@pytest.mark.parametrize("order", range(6))
def test_beamformers_equal_the_reference(order, coherent):
    compare(prepared(directions=91, dmasOrder=order, cfEnable=coherent))


OFF = dict.fromkeys(
    ["pdmEnable", "matchedFilterEnable", "beamformingEnable", "cleanEnable", "enveloppeEnable", "preloadToggle"], False
)
BANDS = {
    "preFilter": np.hanning(65).astype(np.float32) / 32,
    "postFilter": (np.hanning(64) * np.cos(0.5 * np.arange(64))).astype(np.float32) / 16,
}


@pytest.mark.parametrize(
    "stages",
    [
        {"matchedFilterEnable": False, "beamformingEnable": False, "enveloppeEnable": False, "cleanEnable": False},
        {"beamformingEnable": False, "enveloppeEnable": False, "cleanEnable": False},
        {"enveloppeEnable": False, "cleanEnable": False},
        {"matchedFilterEnable": False},
        {"microphoneLayout": "eRTIS_v3D1REC"},
        {"preFilter": BANDS["preFilter"], "preFilterEnable": True},
        {"postFilter": BANDS["postFilter"], "postFilterEnable": True},
        {**BANDS, "preFilterEnable": True, "postFilterEnable": True, "dmasOrder": 3},
    ],
    ids="-".join,
)
def test_stages_equal_the_reference(stages):
    compare(prepared(directions=31, **stages))


def test_earlier_results_are_processed_further():
    """Signals, or beams, of an earlier call give the same image as all stages at once."""
    off = {"beamformingEnable": False, "enveloppeEnable": False, "cleanEnable": False}
    whole, signals = prepared("whole", directions=31), prepared("signals", directions=31, **off)
    rest = prepared("rest", directions=31, pdmEnable=False, matchedFilterEnable=False)
    raw = measured(whole)
    wanted = rtiscuda.processing(raw.rawData, 1, 31, whole.nspses, "whole")
    half = rtiscuda.processing(raw.rawData, 1, 32, signals.nspsls, "signals")
    assert np.allclose(rtiscuda.processing(half, 0, 31, rest.nspses, "rest"), wanted, rtol=1e-3)
    before = half.copy()
    rtiscuda.processing(half, 0, 31, rest.nspses, "rest")
    assert np.array_equal(half, before)


def test_reflectors_are_found_where_they_are():
    """This tests the delays, the matched filter and the ranges against the simulator, not against the reference."""
    places = [(1.0, -40.0), (2.0, 10.0), (3.5, 50.0)]
    scene = Scene(points=tuple(Point(range_m=range_m, azimuth_deg=angle) for range_m, angle in places))
    settings = prepared(premade="2D_5m_181")
    measurement = render(scene)
    mine = rtisdev.get_raw_measurement(behaviour=False, configName="test")
    mine.rawData = measurement.data.reshape(-1)
    image = rtisdev.process_measurement(mine, configName="test").processedData
    for range_m, azimuth_deg in places:
        near = np.abs(settings.ranges - range_m) < 0.15
        direction, at = np.unravel_index(np.argmax(image[:, near]), image[:, near].shape)
        assert abs(np.degrees(settings.directions[direction, 0]) - azimuth_deg) <= 1.5
        assert abs(settings.ranges[near][at] - range_m) <= 0.02


def test_environment_selects_the_device(monkeypatch):
    monkeypatch.setenv("ERTIS_RTISDEV_DEVICE", "numpy")
    settings = prepared(directions=5, minRange=1.0, maxRange=1.3)
    compare(settings)
    monkeypatch.setenv("ERTIS_RTISDEV_DEVICE", "gpu")
    with pytest.raises(ArgumentError, match="gpu"):
        prepared(directions=5)


def test_threads_use_several_configurations():
    settings = [prepared(name, directions=count) for name, count in (("small", 31), ("large", 91))]
    raw = measured(settings[0]).rawData
    shapes = {each.configName: (each.nDirections, each.nspses) for each in settings}
    wanted = {name: rtiscuda.processing(raw, 1, *shape, name) for name, shape in shapes.items()}
    failed = []

    def work(name):
        got = [rtiscuda.processing(raw, 1, *shapes[name], name) for _ in range(5)]
        failed.extend(name for each in got if not np.array_equal(each, wanted[name]))

    workers = [threading.Thread(target=work, args=(name,)) for name in ["small", "large"] * 2]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert not failed


def test_forked_workers_of_a_process_that_has_processed_return_the_same_images(tmp_path):
    """OpenMP would end such a worker, and the pool would start it again for ever."""
    script = tmp_path / "script.py"
    script.write_text(
        """
import multiprocessing
import numpy as np
import ertis_numba.interop.rtisdev
import rtisdev
from ertis_numba.interop.rtisdev import rtiscuda

def work(raw):
    return rtiscuda.processing(raw, 1, 5, settings.nspses, "test")

if __name__ == "__main__":
    rtisdev.open_connection("/dev/no-such-port", allowDebugMode=True)
    rtisdev.set_recording_settings(premade="default_25_50", configName="test")
    rtisdev.set_processing_settings(directions=5, minRange=1.0, maxRange=1.3, configName="test")
    settings = rtisdev.get_current_settings(configName="test")
    raw = rtisdev.get_raw_measurement(behaviour=False, configName="test").rawData
    wanted = work(raw)
    with multiprocessing.get_context("fork").Pool(2) as pool:
        for got in pool.map(work, [raw, raw]):
            print(np.array_equal(got, wanted))
"""
    )
    done = subprocess.run(
        [sys.executable, script], env=ENVIRONMENT, capture_output=True, text=True, timeout=TIMEOUT_S, check=False
    )
    assert (done.returncode, done.stdout) == (0, "True\nTrue\n"), done.stderr


@contextmanager
def emulated(folder):
    """An emulated sensor, and the name of its port."""
    link = folder / "sensor"
    command = [sys.executable, "-m", "ertis_cli", "sensors", "emulate", SCENE, "--sensor", "west", "--link", link]
    environment = ENVIRONMENT | {"ERTIS_EMULATED_DIR": str(folder)}
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout.readline().startswith("/dev/")
            yield link
        finally:
            process.terminate()


def run_script(script, *arguments):
    """Run ``ertis sensors rtisdev`` in the folder of the package's tests, as these need it."""
    return subprocess.run(
        [sys.executable, "-m", "ertis_cli", "sensors", "rtisdev", *arguments, script],
        cwd=own_tests(),
        env=ENVIRONMENT | {"MPLBACKEND": "agg"},
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )


def test_own_tests_of_the_package_pass_with_an_emulated_sensor(tmp_path):
    with emulated(tmp_path) as port:
        done = run_script("test_rtisdev.py", "--port", str(port))
    assert done.returncode == 0, done.stderr[-3000:]
    assert re.search(r"Ran 24 tests in .*\n\nOK\n", done.stderr)
    assert "disabled debug mode" in done.stdout + done.stderr


def test_own_comparison_of_beamformers_runs():
    done = run_script("test_dmas.py")
    assert done.returncode == 0, done.stderr[-3000:]
    assert len(re.findall(r"^D\w*AS.*: .*ms$", done.stdout, re.MULTILINE)) == 11


def replacements():
    """Rows of the tables of functions and classes in docs/how-to/from-rtisdev.md."""
    text = (ROOT / "docs" / "how-to" / "from-rtisdev.md").read_text("utf-8")
    return re.findall(r"^\| `(\w+)` \| `([^`]+)`", text.partition("## Settings")[0], re.MULTILINE), text


def test_each_function_and_class_has_a_replacement():
    names = {
        name
        for name, each in vars(rtisdev).items()
        if getattr(each, "__module__", "") == "rtisdev.RTISDev"
        and (isinstance(each, FunctionType) or name.startswith("RTIS"))
        and not (isinstance(each, type) and issubclass(each, Exception))
        and not name.startswith("_")
    }
    rows, _ = replacements()
    assert {name for name, _ in rows} == names
    assert len(rows) == len(names) == 33


@pytest.mark.filterwarnings("ignore:besides the call of the settings")  # The scene's other sensor emits one.
def test_replacements_run(tmp_path):
    rows, text = replacements()
    names = {}
    exec(re.search(r"```python\n(.*?)```", text, re.DOTALL)[1], names)
    with emulated(tmp_path) as port:
        for _, code in rows:
            exec(code.replace("/dev/ttyACM0", str(port)), names)
    assert len(names["images"]) == 2
    assert len(names["image"].amplitude) == 181


def test_flutter_call_is_that_of_the_package():
    """The options of our page upload the samples that the preset uploads."""
    folder = Path(rtisdev.__file__).parent / "config" / "premadeSettings" / "recording"
    theirs = rtisdev.get_settings(recordingJsonPath=str(folder / "flutter.json"), **OFF)
    call = Call.from_file(folder / "flutter.csv")
    setup = Setup.of(Settings().replace(call=call), emissions=186, emission_period_s=0.02)
    codes = np.floor(2047 * theirs.dacSignal + 2048)
    assert len(setup.codes) == theirs.dacSamples == 9000
    assert np.abs(setup.codes - codes).max() <= 1  # Our samples have a peak of 1, theirs of 0.99999.
    assert setup.emissions == theirs.callEmissions


def test_unknown_names_and_wrong_shapes_are_refused(caplog):
    settings = prepared(directions=31)
    raw = measured(settings).rawData
    shape = settings.nDirections, settings.nspses
    for arguments, message in (
        ((raw, 1, *shape, "other"), r"configuration 'other' is not preloaded; .* \(preloaded are: 'test'\)"),
        ((raw[:-1], 1, *shape, "test"), r"is uint32 of shape \(163839,\); use 163840 words of uint32"),
        ((raw.astype(np.int64), 1, *shape, "test"), r"is int64 of shape \(163840,\); use 163840 words of uint32"),
        ((raw.astype(np.float32), 1, *shape, "test"), "the measurement is float32"),
        ((raw, 1, 31, 7, "test"), r"configuration 'test' gives 31 × \d+ numbers, but 31 × 7 are wanted"),
        ((np.zeros((3, 7), np.float32), 0, *shape, "test"), r"the data has shape \(3, 7\); use 32 rows"),
        ((np.zeros((32, 7), np.float32), 0, *shape, "test"), "signals have 7 samples; use 16384"),
    ):
        caplog.clear()
        with pytest.raises(ArgumentError, match=message):
            rtiscuda.processing(*arguments)
        assert re.search(message, caplog.text)
    caplog.clear()
    rtiscuda.unloadone("other")
    assert "nothing to unload" in caplog.text


def test_words_keep_their_value_in_any_order_of_bytes():
    settings = prepared(directions=5, minRange=1.0, maxRange=1.3)
    raw = measured(settings).rawData
    shape = settings.nDirections, settings.nspses
    wanted = rtiscuda.processing(raw, 1, *shape, "test")
    for same in (raw.astype(">u4"), raw.view(np.int32), raw.view(np.uint8), raw.view("<u2").astype(">u2")):
        assert np.array_equal(rtiscuda.processing(same, 1, *shape, "test"), wanted), same.dtype


def test_data_of_earlier_stages_that_are_no_finite_numbers_are_refused():
    off = {"pdmEnable": False, "matchedFilterEnable": False}
    settings = prepared(directions=5, minRange=1.0, maxRange=1.3, **off)
    signals = np.zeros((32, 16_384))
    for bad, message in (
        (np.where(np.arange(16_384) == 7, np.nan, signals), r"the data holds nan at \[0, 7\]; pass finite numbers"),
        (signals + 1e39, r"the data holds inf at \[0, 0\]"),
        (signals * 1j, "the data is of complex128; pass an array of real numbers"),
        (None, "the data is of type NoneType; pass an array of real numbers"),
        ([[1, 2], [3]], "the data differ in length; pass rows of equal length"),
        (signals[0], r"the data has shape \(16384,\); use 32 rows"),
        (signals[:, :0], r"the data has shape \(32, 0\); use 32 rows"),
    ):
        with pytest.raises(ArgumentError, match=message):
            rtiscuda.processing(bad, 0, settings.nDirections, settings.nspses, "test")
    for name in (None, ["test"], 3):
        with pytest.raises(ArgumentError, match=r"name is of type .*; pass a string"):
            rtiscuda.processing(signals, 0, 5, settings.nspses, name)
        with pytest.raises(ArgumentError, match=r"name is of type .*; pass a string"):
            rtiscuda.unloadone(name)


def arguments_of_preload():
    """A valid call, by names."""
    given = (
        *(np.ones(8), 0, np.ones(8), 0, np.ones((32, 8193)), np.ones((32, 8193)), np.zeros((32, 31), int), 32, 31),
        *(163_840, 10, 512, 10, 131, 200, 2.0, 0.5, "bad", 1, 0, 1, 1, 0, 1, 1, np.array([64]), 1, 0),
    )
    return dict(zip(inspect.signature(rtiscuda.preload).parameters, given, strict=True))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"delay_matrix": np.zeros((31, 32), int)}, r"the delay matrix has shape \(31, 32\); use \(32, 31\)"),
        ({"delay_matrix": np.full((32, 31), -1)}, "the delay matrix holds -1"),
        ({"delay_matrix": np.full((32, 31), np.nan)}, "delay_matrix holds nan"),
        ({"delay_matrix": np.full((32, 31), 1.5)}, "delay_matrix holds fractions; use whole numbers"),
        ({"delay_matrix": np.full((32, 31), 1e12)}, r"delay_matrix holds 1e\+12; pass numbers of samples within"),
        ({"delay_matrix": np.full((32, 31), 20_000)}, "matrix holds 20000, but signals have 16384 samples; use"),
        ({"delay_matrix": None}, "delay_matrix is of type NoneType; pass an array of real numbers"),
        (
            {"matched_filter_real": np.zeros((32, 7)), "matched_filter_imag": np.zeros((32, 7))},
            r"the matched filter has shape \(32, 7\); use \(32, 8193\)",
        ),
        (
            {"matched_filter_real": np.zeros((32, 7))},
            r"matched_filter_real has shape \(32, 7\), but .*8193\); pass equal",
        ),
        ({"matched_filter_imag": np.full((32, 8193), np.nan)}, r"matched_filter_imag holds nan at \[0, 0\]"),
        ({"pdm_filter": [1.0, np.nan]}, r"pdm_filter holds nan at \[1\]; pass finite numbers"),
        ({"pdm_filter": []}, r"pdm_filter has shape \(0,\); pass a row of taps"),
        ({"pdm_filter": "low"}, "pdm_filter is of <U3; pass an array of real numbers"),
        ({"envelope_filter": np.ones((2, 2))}, r"envelope_filter has shape \(2, 2\); pass a row of taps"),
        ({"envelope_filter": [np.inf]}, "envelope_filter holds inf"),
        ({"pre_filter": [np.nan], "pre_filter_enable": 1}, "pre_filter holds nan"),
        ({"post_filter": [[1.0], [2.0, 3.0]], "post_filter_enable": 1}, "post_filter differ in length; pass rows"),
        ({"dmas_order": 6}, "dmasOrder is 6; use 0 to 5"),
        ({"dmas_order": -1}, "dmasOrder is -1; use a whole number of at least 0"),
        ({"last_range": 10}, "the image has ranges 131 to 10"),
        ({"last_range": 2000}, "the image ends at range 2000, but the record has 1639; use a smaller last_range"),
        ({"n_microphones": 33}, "n_microphones is 33; use a whole number from 1 to 32"),
        ({"n_microphones": "32"}, "n_microphones is of <U2; pass an array of real numbers"),
        ({"n_samples": 163_840.5}, "n_samples is 163840.5; use a whole number"),
        ({"n_samples": [1, 2]}, r"n_samples has shape \(2,\); pass one whole number"),
        ({"n_samples": 5}, "5 words give no signal after decimation by 10; use more words"),
        ({"pdm_subsample_factor": 0}, "pdm_subsample_factor is 0; use a whole number of at least 1"),
        ({"n_directions": 0}, "n_directions is 0; use a whole number of at least 1"),
        ({"envelope_subsample_factor": 0}, "envelope_subsample_factor is 0; use a whole number of at least 1"),
        ({"beamforming_drop": 20_000}, "beamforming_drop is 20000; use a whole number from 0 to 16383"),
        ({"mean_multiplier": np.nan}, "mean_multiplier is nan; use a finite number"),
        ({"max_multiplier": "half"}, "max_multiplier is 'half'; use a number"),
        ({"disabled_microphones": np.arange(32)}, "all 32 microphones are disabled"),
        ({"disabled_microphones": [-1]}, "disabled_microphones is -1; use a whole number of at least 0"),
    ],
)
def test_arguments_that_do_not_fit_together_are_refused(changes, message):
    with pytest.raises(ArgumentError, match=message):
        rtiscuda.preload(**(arguments_of_preload() | changes))
    with pytest.raises(ArgumentError, match="'bad' is not preloaded"):
        rtiscuda.processing(np.zeros(163_840, np.uint32), 1, 31, 69, "bad")


def test_arguments_of_stages_that_are_off_are_not_used():
    off = dict.fromkeys(("beamforming_enable", "envelope_enable", "clean_enable", "matched_filter_enable"), 0)
    unused = {
        **dict.fromkeys(("n_directions", "envelope_subsample_factor", "last_range"), 0),
        **dict.fromkeys(("mean_multiplier", "pre_filter", "post_filter", "matched_filter_real"), np.nan),
        "delay_matrix": np.zeros((1, 1)),
        "beamforming_drop": 10**6,
    }
    rtiscuda.preload(**(arguments_of_preload() | off | unused))
    assert rtiscuda.processing(np.zeros(163_840, np.uint32), 1, 32, 16_384, "bad").shape == (32, 16_384)


def test_names_of_configurations_are_texts():
    with pytest.raises(ArgumentError, match="name is of type list; pass a string"):
        rtiscuda.preload(**(arguments_of_preload() | {"name": ["a"]}))


def test_serial_arguments_of_wrong_types_are_refused(caplog):
    with pytest.raises(ArgumentError, match="port is of type NoneType; pass a string"):
        rtisserial.connect(None, 115_200)
    parent, child = os.openpty()
    rtisserial.connect(os.ttyname(child), 115_200)
    try:
        with pytest.raises(ArgumentError, match="command is of type bytes; pass a string"):
            rtisserial.command(b"!Y,0,0,0\n", wants_answer=True)
        with pytest.raises(ArgumentError, match="n_bytes is -1; use a whole number of at least 0"):
            rtisserial.getdata(-1)
    finally:
        rtisserial.close()
        os.close(parent)
        os.close(child)
    assert "n_bytes is -1" in caplog.text


def test_unplugged_sensor_is_a_connection_error(caplog):
    parent, child = os.openpty()
    rtisserial.connect(os.ttyname(child), 115_200)
    os.close(child)
    os.close(parent)
    try:
        for call in (
            lambda: rtisserial.command("!A,1,0,0\n", wants_answer=False),
            lambda: rtisserial.getdata(4),
            rtisserial.flush,
        ):
            caplog.clear()
            with pytest.raises(ConnectionError, match="was unplugged; plug it in again"):
                call()
            assert "was unplugged" in caplog.text
    finally:
        rtisserial.close()


def test_words_without_beamforming_are_refused_with_the_remedy():
    settings = prepared(directions=31, beamformingEnable=False)
    with pytest.raises(ArgumentError, match=r"no beamforming, and therefore processes beams, not PDM words; enable"):
        rtiscuda.processing(measured(settings).rawData, 1, settings.nDirections, settings.nspses, "test")


def test_connection_drops_answers_for_a_former_program(tmp_path):
    words = np.zeros((1, 16_384), np.uint32)
    with Emulator(words, name="left", link=tmp_path / "left"):
        rtisserial.connect(str(tmp_path / "left"), 115_200)
        firmware = rtisserial.command("!Y,0,0,0\n", wants_answer=True)
        for text in ("!G,65536,0,0\n", "!L,0,0,0\n", "!A,1,0,0\n"):  # a script that is interrupted here
            rtisserial.command(text, wants_answer=False)
        rtisserial.close()
        rtisserial.connect(str(tmp_path / "left"), 115_200)
        try:
            assert rtisserial.command("!Y,0,0,0\n", wants_answer=True) == firmware
        finally:
            rtisserial.close()


def test_measurement_that_does_not_arrive_is_an_error_unless_triggers_are_awaited(monkeypatch):
    parent, child = os.openpty()
    try:
        monkeypatch.setattr(rtisserial, "_ANSWER_S", 0.05)
        monkeypatch.setattr(rtisserial, "_MEASUREMENT_S", 0.05)
        rtisserial.connect(os.ttyname(child), 115_200)
        with pytest.raises(TimeoutError, match="did not answer a measurement within"):
            rtisserial.getdata(4)
        rtisserial.command("!J,1,0,0\n", wants_answer=False)
        sender = threading.Timer(0.2, os.write, (parent, b"data"))
        sender.start()
        assert bytes(rtisserial.getdata(4)) == b"data"
        sender.join()
    finally:
        rtisserial.close()
        os.close(parent)
        os.close(child)


def test_serial_errors_are_those_that_callers_expect(monkeypatch, caplog):
    with pytest.raises(ConnectionError, match="does not exist"):
        rtisserial.connect("/dev/no-such-port", 115_200)
    for call in (rtisserial.close, rtisserial.flush, lambda: rtisserial.command("!Y,0,0,0\n", wants_answer=True)):
        with pytest.raises(ConnectionRefusedError, match=r"call rtisdev\.open_connection first"):
            call()
    parent, child = os.openpty()
    try:
        monkeypatch.setattr(rtisserial, "_ANSWER_S", 0.05)
        rtisserial.connect(os.ttyname(child), 115_200)
        with pytest.raises(TimeoutError, match="did not answer '!Y,0,0,0"):
            rtisserial.command("!Y,0,0,0\n", wants_answer=True)
        assert "did not answer" in caplog.text
        os.write(parent, b"left over")
        while vars(rtisserial)["_line"].waiting < 9:
            time.sleep(0.001)
        rtisserial.flush()
        os.write(parent, b"\x01\x02\x03\x00")
        assert rtisserial.command("!Y,0,0,0\n", wants_answer=True) == 0x030201
        monkeypatch.setattr(rtisserial, "_line", None)  # as another program sees it
        with pytest.raises(ConnectionRefusedError, match="in use by another program"):
            rtisserial.connect(os.ttyname(child), 115_200)
    finally:
        os.close(parent)
        os.close(child)


def test_modules_of_a_foreign_name_appear_only_on_request():
    code = "import sys, ertis_numba; print({'rtisserial', 'rtiscuda'} & set(sys.modules))"
    code += "; import ertis_numba.interop.rtisdev, rtisserial, rtiscuda; print(rtiscuda.__name__)"
    done = subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT, capture_output=True, text=True, check=True)
    assert done.stdout == "set()\nertis_numba.interop.rtisdev.rtiscuda\n"
    assert ertis_numba.interop.rtisdev.rtiscuda is sys.modules["rtiscuda"]


def test_rtisdev_command_needs_the_package(monkeypatch, tmp_path):
    (tmp_path / "script.py").write_text("print('ran')")
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    refused = CliRunner().invoke(cli, ["sensors", "rtisdev", str(tmp_path / "script.py")])
    assert refused.exit_code == 1
    assert "rtisdev" in refused.stderr


@pytest.mark.parametrize(
    ("text", "n_frames", "last"),
    [
        ("def f():\n    raise KeyError('x')\nf()\n", 2, "KeyError: 'x'"),
        ("open('none.bin')\n", 1, "FileNotFoundError: [Errno 2] No such file or directory: 'none.bin'"),
        (
            "import rtiscuda\nrtiscuda.unloadone(3)\n",
            2,
            "ertis_numba.base.errors.ArgumentError: name is of type int; pass",
        ),
        ("x = (\n", 1, "SyntaxError: '(' was never closed"),
    ],
    ids=["own", "system", "package", "syntax"],
)
def test_error_of_a_script_is_reported_without_frames_of_the_command(tmp_path, text, n_frames, last):
    script = tmp_path / "script.py"
    script.write_text(text)
    done = run_script(script)
    assert done.returncode == 1
    lines = done.stderr.splitlines()
    frames = [line for line in lines if line.startswith("  File ")]
    assert frames[0].startswith(f'  File "{script}", line ')
    assert not [line for line in frames if "ertis_cli" in line or "click" in line or "runpy" in line]
    assert len(frames) >= n_frames
    assert lines[-1].startswith(last)


def test_script_chooses_the_exit_code(tmp_path):
    script = tmp_path / "script.py"
    script.write_text("raise SystemExit(7)")
    assert run_script(script).returncode == 7
