"""Settings: TOML round trips, error messages for invalid values, and recording presets."""

import dataclasses
import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import assume, given, settings, strategies as st

from ertis_numba.base.errors import ArgumentError, SettingsError
from ertis_numba.frames import Energyscape, Stamp
from ertis_numba.geometry import direction_grid, microphones
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.settings import (
    ERROR_PRESETS_DB,
    PRESETS,
    Accuracy,
    Air,
    Array,
    Call,
    Processing,
    Recording,
    Settings,
    fit_ranges,
    record_range_m,
)

TWO = ((0.0, 0.0, 0.0), (0.0, 0.01, 0.0))


def ordered(low, high):
    return st.tuples(st.floats(low, high), st.floats(low, high)).map(lambda pair: (min(pair), max(pair)))


@st.composite
def arrays(draw):
    if draw(st.booleans()):
        return Array(layout=draw(st.text(max_size=20)), word_bits=draw(st.sampled_from([8, 16, 32, 64])))
    axis = st.floats(-1, 1)
    positions_m = draw(st.lists(st.tuples(axis, axis, axis), min_size=1, max_size=5))
    count = len(positions_m)

    def each(values):
        return draw(st.none() | st.lists(values, min_size=count, max_size=count).map(tuple))

    enabled = each(st.booleans())
    assume(enabled is None or any(enabled))
    gain, delay_s = each(st.floats(1e-3, 1e3)), each(st.floats(-1e-3, 1e-3))
    return Array(positions_m=tuple(positions_m), enabled=enabled, gain=gain, delay_s=delay_s)


calls = st.builds(
    Call,
    start_frequency_hz=st.floats(30_000, 90_000),
    stop_frequency_hz=st.floats(10_000, 29_000),
    duration_s=st.floats(1e-4, 1e-2),
    sample_rate_hz=st.floats(200_000, 2e6),
    ramp_fraction=st.floats(0, 0.5),
)
any_settings = st.builds(
    Settings,
    array=arrays(),
    call=calls,
    recording=st.builds(Recording, sample_rate_hz=st.floats(3e6, 5e6), n_samples=st.integers(1, 2**28)),
    air=st.builds(
        Air,
        temperature_c=st.floats(-40, 60),
        humidity_percent=st.floats(0, 100),
        pressure_pa=st.floats(10_000, 200_000),
    ),
    processing=st.builds(
        Processing,
        method=st.sampled_from(["fast", "paper"]),
        directions=st.sampled_from(["90", "2d:181", "grid.csv"]),
        azimuth_limits_deg=ordered(-180, 180),
        elevation_limits_deg=ordered(-90, 90),
        range_m=ordered(0, 100),
        decimation=st.sampled_from([None, 1, 4, 10, 16]),
        range_decimation=st.integers(1, 100).map(lambda count: 80 * count),
        wavefront=st.just("plane"),
    ),
    accuracy=st.builds(
        Accuracy,
        max_error_db=st.floats(-200, 0),
        precision=st.sampled_from(["auto", "float32", "int16"]),
        oversampling=st.none() | st.integers(1, 64),
        delay_taps=st.none() | st.integers(1, 8),
        beam_taps=st.sampled_from([None, 0, 2, 4, 6]),
        beam_density=st.none() | st.floats(1.1, 8),
        stopband_attenuation_db=st.none() | st.floats(40, 140),
        focal_zones=st.none() | st.integers(1, 1000),
    ),
)


@settings(max_examples=60, deadline=None)
@given(any_settings)
def test_settings_survive_toml(made):
    assert Settings.from_toml(made.to_toml()) == made
    assert hash(made) == hash(Settings.from_toml(made.to_toml()))


def test_band_edges_survive_toml_and_raise_the_signal_rate():
    made = Settings(processing=Processing(band_edges_hz=(5e3, 120e3)))
    assert Settings.from_toml(made.to_toml()) == made
    assert (Settings().decimation, made.decimation) == (20, 10)


def test_empty_settings_file_gives_the_defaults():
    assert Settings.from_toml("") == Settings() == Settings.from_preset("default_25_50")


def test_settings_are_read_from_a_file(tmp_path):
    path = tmp_path / "sensor.toml"
    path.write_text("[air]\ntemperature_c = 3\n", encoding="utf-8")
    assert Settings.load(path).air == Air(temperature_c=3.0)


def test_settings_are_immutable():
    with pytest.raises(AttributeError, match="immutable"):
        Settings().air.temperature_c = 3.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[air", r"s: .*; correct it or remove it"),
        ("[airs]", r"s, line 1: unknown key `airs`"),
        ("[air]\ntemperature = 3", r"s, line 2, air: unknown key `temperature`"),
        ("[air]\ntemperature_c = 'cold'", r"s, line 2, air\.temperature_c: Expected `float`, got `str`"),
        ("[air]\ntemperature_c = nan", r"air\.temperature_c is nan; use a finite number"),
        ("[air]\ntemperature_c = -41", r"air\.temperature_c is -41; use a number from -40 to 60"),
        ("[air]\nhumidity_percent = 101", r"air\.humidity_percent is 101; use a number from 0 to 100"),
        ("[air]\npressure_pa = 1013", r"air\.pressure_pa is 1013; use a number from 10000 to 200000"),
        ("[array]\nword_bits = 12", r"array\.word_bits '12' is unknown.*known are 8, 16, 32, 64"),
        ("[array]\nword_bits = 8.0", r"s, line 2, array\.word_bits: Expected `int`, got `float`"),
        ("[array]\nenabled = [true]", r"array\.enabled is given without array\.positions_m; use both or neither"),
        ("[array]\ngain = [1]", r"array\.gain is given without array\.positions_m; use both or neither"),
        ("[array]\ndelay_s = [0]", r"array\.delay_s is given without array\.positions_m; use both or neither"),
        ("[array]\npositions_m = []", r"number of array\.positions_m is 0; use a whole number from 1 to 1024"),
        ("[array]\npositions_m = [[0, 0]]", r"s, line 2, array\.positions_m\[0\]: Expected `array` of length 3, got 2"),
        ("[array]\npositions_m = [[0, 0, nan]]", r"array\.positions_m\[0\] is nan; use a finite number"),
        (
            "[array]\npositions_m = [[0, 0, 0]]\nenabled = [true, true]",
            r"array\.enabled has shape \(2,\); pass shape \(1,\)",
        ),
        ("[array]\npositions_m = [[0, 0, 0]]\nenabled = [false]", r"array\.enabled is false for all channels; enable"),
        ("[array]\npositions_m = [[0, 0, 0]]\ngain = [1, 1]", r"array\.gain has shape \(2,\); pass shape \(1,\)"),
        ("[array]\npositions_m = [[0, 0, 0]]\ngain = [0]", r"array\.gain\[0\] is 0; use a number from 0\.001 to 1000"),
        ("[array]\npositions_m = [[0, 0, 0]]\ngain = [nan]", r"array\.gain\[0\] is nan; use a finite number"),
        ("[array]\npositions_m = [[0, 0, 0]]\ndelay_s = []", r"array\.delay_s has shape \(0,\); pass shape \(1,\)"),
        ("[array]\npositions_m = [[0, 0, 0]]\ndelay_s = [1]", r"array\.delay_s\[0\] is 1; use a number from -0\.001"),
        ("[call]\nstart_frequency_hz = 0", r"call\.start_frequency_hz is 0; use a number above 0"),
        (
            "[call]\nstop_frequency_hz = 225e3",
            r"call\.stop_frequency_hz is 225000; use less than half of call\.sample",
        ),
        (
            "[call]\nstop_frequency_hz = 5e4",
            r"call.start_frequency_hz and call.stop_frequency_hz are both 50000; choose two different frequencies",
        ),
        ("[call]\nduration_s = 0", r"call\.duration_s is 0; use a number from 3\.55556e-05 to 1"),
        ("[call]\nsample_rate_hz = -1", r"call\.sample_rate_hz is -1; use a number above 0"),
        ("[call]\nramp_fraction = 0.6", r"call\.ramp_fraction is 0\.6; use a number from 0 to 0\.5"),
        ("[recording]\nsample_rate_hz = 0", r"recording\.sample_rate_hz is 0; use a number from 1000 to 1e\+09"),
        ("[recording]\nn_samples = 0", r"recording\.n_samples is 0; use a whole number from 1 to 268435456"),
        (
            "[processing]\nmethod = 'slow'",
            r"s, line 2, processing\.method: value 'slow' is unknown; known are fast",
        ),
        ("[processing]\ndecimation = 0", r"processing\.decimation is 0; use a whole number from 1 to 1000"),
        ("[processing]\nrange_decimation = 0", r"processing\.range_decimation is 0; use a whole number from 1"),
        (
            "[processing]\ndecimation = 7",
            r"processing\.decimation is 7; use a divisor of processing\.range_decimation",
        ),
        ("[processing]\noversampling = 10", r"s, line 2, processing: unknown key `oversampling`"),
        ("[accuracy]\nmax_error_db = 3", r"accuracy\.max_error_db is 3; use a number from -200 to 0"),
        (
            "[accuracy]\nprecision = 'int8'",
            r"s, line 2, accuracy\.precision: value 'int8' is unknown \(did",
        ),
        ("[accuracy]\noversampling = 65", r"accuracy\.oversampling is 65; use a whole number from 1 to 64"),
        ("[accuracy]\ninterpolation = 'linear'", r"s, line 2, accuracy: unknown key `interpolation`"),
        ("[accuracy]\ndelay_taps = 9", r"accuracy\.delay_taps is 9; use a whole number from 0 to 8"),
        ("[accuracy]\nbeam_taps = 3", r"accuracy\.beam_taps '3' is unknown.*known are 0, 2, 4, 6"),
        ("[accuracy]\nbeam_density = 1", r"accuracy\.beam_density is 1; use a number from 1\.1 to 8"),
        (
            "[accuracy]\nstopband_attenuation_db = 30",
            r"accuracy\.stopband_attenuation_db is 30; use a number from 40 to 140",
        ),
        ("[accuracy]\nfocal_zones = 0", r"accuracy\.focal_zones is 0; use a whole number from 1 to"),
        (
            "[processing]\nmethod = 'paper'\nwavefront = 'spherical'",
            r"processing\.wavefront is 'spherical', but .* 'paper' supports only plane wavefronts; use 'plane'",
        ),
        ("[processing]\nrange_m = [2, 1]", r"processing\.range_m runs from 2 to 1; use the smaller number first"),
        ("[processing]\nrange_m = [-1, 1]", r"processing\.range_m is -1; use a number from 0 to 10000"),
        ("[processing]\nazimuth_limits_deg = [-181, 0]", r"processing\.azimuth_limits_deg is -181; use a number from"),
        ("[processing]\nelevation_limits_deg = [0, 91]", r"processing\.elevation_limits_deg is 91; use a number from"),
        (
            "[processing]\nband_edges_hz = [25000, 60000]",
            r"band_edges_hz is 25000 to 60000 Hz, but .*; use a lower edge of at most 24900 and an upper edge",
        ),
        (
            "[processing]\nband_edges_hz = [5000, 120000]\ndecimation = 20",
            r"processing\.band_edges_hz ends at 120000 Hz, but signals at 225000 Hz reach only 112500 Hz; use",
        ),
        (
            "[processing]\nmethod = 'paper'\nband_edges_hz = [20000, 55000]",
            r"processing\.band_edges_hz is not supported by processing.method 'paper'; leave it out",
        ),
        ("[processing]\nband_edges_hz = [-1, 55000]", r"processing\.band_edges_hz is -1; use a number from 0 to"),
        (
            "[processing]\ndecimation = 50",
            r"processing\.decimation 50 leaves signals at 90000 Hz; use a decimation that leaves",
        ),
    ],
)
def test_bad_settings_are_refused(text, message):
    with pytest.raises(SettingsError, match=message) as caught:
        Settings.from_toml(text, "s")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Array(word_bits="32"), r"array\.word_bits is '32'; use a whole number"),
        (lambda: Array(positions_m=((0.0, 0.0),)), r"array\.positions_m\[0\] has shape \(2,\); pass shape \(3,\)"),
        (lambda: Array(positions_m=((0.0,) * 3,) * 1025), r"number of array\.positions_m is 1025; use .* 1 to 1024"),
        (lambda: Array(positions_m=TWO, enabled=(1, 0)), r"array\.enabled\[0\] is 1; use true or false"),
        (lambda: Array(positions_m=TWO, enabled=("yes", "no")), r"array\.enabled\[0\] is 'yes'; use true or false"),
        (lambda: Array(positions_m=5), r"array\.positions_m is 5; use a list or None"),
        (lambda: Array(layout=3), r"array\.layout is 3; use text"),
        (lambda: Accuracy(focal_zones=1.5), r"accuracy\.focal_zones is 1\.5; use a whole number or None"),
        (lambda: Processing(range_m="12"), r"processing\.range_m is '12'; use a list"),
        (lambda: Processing(range_m=(1, 2, 3)), r"processing\.range_m has shape \(3,\); pass shape \(2,\)"),
        (
            lambda: Processing(range_m=(1, 10**400)),
            r"processing\.range_m\[1\] exceeds the range of .*; use a finite number",
        ),
        (lambda: Processing(method=3), r"processing\.method is 3; use text"),
        (lambda: Settings(processing="90"), r"settings\.processing is '90'; use Processing\(\.\.\.\)"),
        (lambda: Settings(air={"pressure_pa": "low"}), r"settings\.air\.pressure_pa is 'low'; use a number"),
        (lambda: Settings(air={"pressure_pa": 1}), r"^air\.pressure_pa is 1; use a number from 10000 to 200000$"),
        (lambda: Processing(method="slow"), r"processing\.method 'slow' is unknown; known are fast, paper"),
        (lambda: Air(temperature_c="warm"), r"air\.temperature_c is 'warm'; use a number"),
        (lambda: Air().replace(temperature=3), r"air key 'temperature' is unknown .did you mean 'temperature_c'"),
        (lambda: Air().replace(temperature_c=99), r"air\.temperature_c is 99; use a number from -40 to 60"),
        (lambda: Settings.from_preset("defualt_25_50"), r"preset 'defualt_25_50' is unknown .did you mean 'default_25"),
    ],
)
def test_bad_arguments_are_refused(make, message):
    with pytest.raises(ArgumentError, match=message):
        make()


@pytest.mark.parametrize(
    ("made", "wanted"),
    [
        pytest.param(Processing(range_m=[0.5, 1]), Processing(range_m=(0.5, 1.0)), id="a list"),
        pytest.param(Processing(range_m=np.array([0.5, 1])), Processing(range_m=(0.5, 1.0)), id="an array"),
        pytest.param(Processing(dmas_order=np.int64(3)), Processing(dmas_order=3), id="a number of NumPy"),
        pytest.param(Processing(directions=Path("d.csv")), Processing(directions="d.csv"), id="a path of directions"),
        pytest.param(Array(layout=Path("mine.csv")), Array(layout="mine.csv"), id="a path of a layout"),
        pytest.param(Array(positions_m=np.array(TWO)), Array(positions_m=TWO), id="positions"),
        pytest.param(
            Array(positions_m=TWO, enabled=np.array([True, False])),
            Array(positions_m=TWO, enabled=(True, False)),
            id="flags",
        ),
    ],
)
def test_fields_accept_the_forms_of_settings_files(made, wanted):
    assert made == wanted
    assert hash(made) == hash(wanted)
    assert repr(made) == repr(wanted)  # Equality alone does not distinguish 1, 1.0 and NumPy numbers.


def test_error_presets_are_budgets_in_order():
    assert Accuracy().max_error_db == ERROR_PRESETS_DB["standard"]
    budgets_db = [Accuracy(max_error_db=budget_db).max_error_db for budget_db in ERROR_PRESETS_DB.values()]
    assert budgets_db == sorted(budgets_db, reverse=True)


@pytest.mark.parametrize("content", [None, b"\xff\xfea", b"a = \xe9"])
def test_unreadable_files_are_refused(tmp_path, content):
    path = tmp_path / "s.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(SettingsError, match=r"s\.toml: .*; (choose a settings file \(TOML\)|save it as UTF-8)"):
        Settings.load(path)


@pytest.mark.parametrize("name", PRESETS)
def test_presets_have_the_documented_values(name):
    made = Settings.from_preset(name)
    words = {"short": 65_536, "default": 163_840, "long": 294_912}[name.split("_")[0]]
    low_hz, high_hz = (1000 * int(edge) for edge in name.split("_")[1:])
    assert made.recording.n_samples == words
    assert (made.call.start_frequency_hz, made.call.stop_frequency_hz) == (high_hz, low_hz)
    assert (made.call.low_frequency_hz, made.call.high_frequency_hz) == (low_hz, high_hz)
    echo_ends_s = 2 * made.processing.range_m[1] / sound_speed_m_s(Air(temperature_c=-40.0)) + made.call.duration_s
    assert echo_ends_s <= made.recording.duration_s


def test_rates_and_durations_are_derived():
    made = Settings()
    assert made.recording.duration_s == pytest.approx(36.4e-3, abs=1e-5)
    assert (made.signal_rate_hz, made.output_rate_hz) == (225_000, 45_000)


def test_stamps_and_images_are_frozen():
    image = Energyscape(np.ones((1, 1), np.float32), np.zeros(1), np.zeros(1), np.ones(1), Settings())
    assert image.is_planar
    assert not image.replace(elevation_rad=np.full(1, math.pi / 4)).is_planar
    with pytest.raises(dataclasses.FrozenInstanceError):
        Stamp().sequence = 1


def test_every_section_refuses_unknown_fields():
    for section in (Array, Call, Recording, Air, Processing, Accuracy, Settings):
        with pytest.raises(msgspec.ValidationError, match="unknown field"):
            msgspec.convert({"colour": 1}, section)


@pytest.mark.parametrize(
    ("preset", "method", "decimation"),
    [
        ("default_25_50", "fast", 20),
        ("default_25_50", "paper", 10),
        ("default_20_80", "fast", 10),
        ("long_20_80", "paper", 10),
    ],
)
def test_decimation_is_checked_for_method_and_band(preset, method, decimation):
    made = Settings.from_preset(preset)
    made = made.replace(processing=made.processing.replace(method=method))
    assert made.decimation == decimation
    assert made.decimation * made.output_decimation == made.processing.range_decimation


def test_range_decimation_without_a_useful_divisor_is_refused():
    with pytest.raises(ArgumentError, match=r"range_decimation 101 has no divisor near 20, .*; use a multiple of 20"):
        Settings(processing=Processing(range_decimation=101))


def test_distant_microphones_are_refused():
    with pytest.raises(
        ArgumentError, match=r"array.positions_m spans 40 m, more than 25 m; if the numbers are millimetres, divide"
    ):
        Array(positions_m=((0.0, 0.0, 0.0), (40.0, 0.0, 0.0)))
    with pytest.raises(ArgumentError, match=r"array.positions_m\[1\] is 4e\+07; use a number from -1e\+07 to 1e\+07"):
        Array(positions_m=((0.0, 0.0, 0.0), (4e7, 0.0, 0.0)))
    assert Array(positions_m=((5e5, 5e6, 0.0), (5e5, 5e6 + 20, 0.0)), enabled=(True, True)).layout == "own array"


def test_files_named_in_settings_are_relative_to_the_settings_file(tmp_path, monkeypatch):
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "line.csv").write_text("y_mm, z_mm\n0, 0\n10, 0\n")
    (folder / "two.csv").write_text("-10, 0\n10, 0\n")
    (folder / "s.toml").write_text('[array]\nlayout = "line.csv"\n[processing]\ndirections = "two.csv"\n')
    monkeypatch.chdir(tmp_path)
    found = Settings.load("mine/s.toml")
    assert found.array.layout == str(Path("mine/line.csv"))
    assert len(microphones(found.array).enabled) == len(direction_grid(found.processing)) == 2
    (folder / "s.toml").write_text(f'[array]\nlayout = "{folder / "line.csv"}"\n')
    assert Settings.load("mine/s.toml").array.layout == str(folder / "line.csv")
    (folder / "s.toml").write_text('[array]\nlayout = "uRTIS_v1"\n[processing]\ndirections = "90"\n')
    named = Settings(array=Array(layout="uRTIS_v1"), processing=Processing(directions="90"))
    assert Settings.load("mine/s.toml") == named


def test_settings_file_updates_only_its_keys(tmp_path, monkeypatch):
    folder = tmp_path / "mine"
    folder.mkdir()
    monkeypatch.chdir(tmp_path)
    known = Settings(
        array=Array(layout="of a recording", positions_m=TWO, gain=(2.0, 3.0)),
        recording=Recording(n_samples=100_000),
        processing=Processing(directions="near.csv", range_m=(1.0, 2.0)),
    )
    (folder / "s.toml").write_text("\ufeff[recording]\nsample_rate_hz = 4e6\n[processing]\nrange_m = [1, 3]\n", "utf-8")
    changed = known.updated_from_file("mine/s.toml")
    assert changed.recording == Recording(sample_rate_hz=4e6, n_samples=100_000)
    assert changed.processing == known.processing.replace(range_m=(1.0, 3.0))
    assert (changed.array, changed.call) == (known.array, known.call)
    (folder / "s.toml").write_text('[array]\nlayout = "line.csv"\n[processing]\ndirections = "far.csv"\n')
    changed = known.updated_from_file("mine/s.toml")
    assert changed.array == Array(layout=str(Path("mine/line.csv")))
    assert changed.processing == known.processing.replace(directions=str(Path("mine/far.csv")))


def test_inconsistent_settings_file_is_refused(tmp_path):
    (tmp_path / "s.toml").write_text("[processing]\nrange_decimation = 50\n")
    known = Settings(processing=Processing(decimation=20))
    with pytest.raises(SettingsError, match=r"s\.toml: processing\.decimation is 20; use a divisor of .* \(50\)"):
        known.updated_from_file(tmp_path / "s.toml")


@pytest.mark.parametrize(
    ("rate_hz", "band_hz", "step"),
    [
        pytest.param(4.5e6, (25e3, 50e3), 100, id="the paper's"),
        pytest.param(4.5e6, (20e3, 80e3), 40, id="the wide preset"),
        pytest.param(4.5e6, (40e3, 50e3), 100, id="a narrow band keeps the default"),
        pytest.param(1e6, (25e3, 50e3), 20, id="a multiple of 4"),
        pytest.param(192e3, (25e3, 50e3), 4, id="PCM"),
        pytest.param(192e3, (15e3, 90e3), 1, id="no room"),
    ],
)
def test_ranges_are_checked_for_rate_and_band(rate_hz, band_hz, step):
    call = Call(start_frequency_hz=band_hz[1], stop_frequency_hz=band_hz[0])
    recording = Recording(sample_rate_hz=rate_hz, n_samples=round(rate_hz / 20))
    assert fit_ranges(Processing(), recording, call).range_decimation == step


def test_range_window_ends_where_the_whole_echo_fits():
    def window_m(n_samples, **processing):
        recording = Recording(sample_rate_hz=1e6, n_samples=n_samples)
        return fit_ranges(Processing(**processing), recording, Call()).range_m

    assert window_m(10**6) == (0.5, 5.0)
    assert window_m(22_500) == (0.5, 3.0)
    assert window_m(5_000) == (0.0, 0.3)
    assert window_m(2_810) == (0.0, 0.046)  # The window is shorter than one step.
    assert window_m(2_810, range_m=(0.2, 9.0)) == (0.2, 9.0)
    with pytest.raises(
        ArgumentError,
        match=r"recording.n_samples gives a record of 2\.5 ms, but the call ends after 2\.5 ms; use more samples",
    ):
        window_m(2_500)


def test_record_range_m_is_rounded_inwards_to_a_centimetre():
    assert record_range_m(Recording(n_samples=65_536), Call(), 343.0) == (0.43, 2.06)
    assert fit_ranges(Processing(), Recording(n_samples=65_536), Call()).range_m == (0.5, 1.8)
