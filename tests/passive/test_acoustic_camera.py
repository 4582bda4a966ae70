"""Acoustic maps: equal to their equations in float64, and right about simulated sources."""

import re

import numpy as np
import pytest
import threadpoolctl
from scipy.signal import csd

import ertis_numba as ertis
from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.frames import is_passive
from ertis_numba.geometry import far_field_delays, microphones, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s, transmission_loss_db
from ertis_numba.passive import AcousticCamera, CrossSpectrum, find_bearings, octave_bands
from ertis_numba.passive.bands import bin_shares
from ertis_numba.passive.methods import METHODS, in_parts
from ertis_numba.settings import MAP_METHODS, Settings
from tests.on_device import KERNELS

pytestmark = pytest.mark.filterwarnings("ignore::ertis_numba.base.errors.CoarseGridWarning")  # Small grids save time.

SMALL = {
    "array.layout": "six",
    "array.positions_m": [
        [0, 0, 0],
        [0, 0.01, 0],
        [0, 0.023, 0.004],
        [0, -0.012, 0.02],
        [0, 0.03, -0.015],
        [0, -0.02, -0.01],
    ],
    "recording.encoding": "float32",
    "recording.sample_rate_hz": 225e3,
    "recording.n_samples": 8192,
    "processing.directions": "2d:61",
    "passive.bands_hz": [[20e3, 25e3], [30e3, 40e3]],
    "passive.resolution_hz": 900.0,
}
DEVICES = [name for name in KERNELS if not KERNELS[name].simulated]


def settings_of(**changes):
    return Settings().replace(**(SMALL | {name.replace("__", "."): value for name, value in changes.items()}))


def sound(settings, sources, *, noise=0.0, seed=0):
    """Return a measurement of noise from azimuths in degrees with RMS values, as plane waves, and of white noise."""
    random = np.random.default_rng(seed)
    recording, layout = settings.recording, microphones(settings.array)
    n, rate_hz = recording.n_samples, recording.sample_rate_hz
    frequency_hz = np.fft.rfftfreq(n, 1 / rate_hz)
    spectrum = np.zeros((len(layout.enabled_positions_m), n // 2 + 1), complex)
    for azimuth_deg, rms in sources:
        direction = unit_vectors(np.radians([azimuth_deg]), np.zeros(1))
        speed = sound_speed_m_s(settings.air)
        delay_s = far_field_delays(layout.enabled_positions_m, direction, sound_speed_m_s=speed)[0]
        source = np.fft.rfft(rms * random.standard_normal(n))
        spectrum += source * np.exp(-2j * np.pi * frequency_hz * delay_s[:, None])
    samples = np.fft.irfft(spectrum, n) + noise * random.standard_normal((len(spectrum), n))
    return ertis.Measurement(np.ascontiguousarray(samples.T, np.float32), settings)


def reference_matrix(camera, measurement):
    """Return the cross-spectral matrix by SciPy's implementation of Welch's method, in float64."""
    recording = camera.settings.recording
    n_block = round(recording.sample_rate_hz / (camera.frequency_hz[1] - camera.frequency_hz[0]))
    rows = measurement.data.T.astype(float)
    n_mics = len(rows)
    out = np.zeros((len(camera.frequency_hz), n_mics, n_mics), complex)
    for i in range(n_mics):
        for j in range(n_mics):
            frequency_hz, density = csd(
                rows[j], rows[i], recording.sample_rate_hz, "hann", n_block, detrend=False, scaling="density"
            )
            places = np.searchsorted(frequency_hz, camera.frequency_hz - 1)
            out[:, i, j] = density[places] * frequency_hz[1]
    return out


def waves_of(camera):
    settings = camera.settings
    directions = unit_vectors(camera.grid.azimuth_rad, camera.grid.elevation_rad)
    positions_m = microphones(settings.array).enabled_positions_m
    speed = sound_speed_m_s(settings.air)
    delay_s = far_field_delays(positions_m, directions, sound_speed_m_s=speed)
    return np.exp(-2j * np.pi * camera.frequency_hz[:, None, None] * delay_s.T)


def reference_powers(camera, matrix):
    """Evaluate the equations of the methods, (bin, direction), in float64."""
    passive, v = camera.settings.passive, waves_of(camera)
    n_mics = matrix.shape[1]

    def form(matrices):
        return np.einsum("kmd,kmn,knd->kd", v.conj(), matrices, v, optimize=True).real

    if passive.method == "delay_and_sum":
        if not passive.diagonal_removal:
            return form(matrix) / n_mics**2
        hollow = matrix * (1 - np.eye(n_mics))
        return np.maximum(form(hollow), 0) / (n_mics**2 - n_mics)
    if passive.method == "functional":
        values, vectors = np.linalg.eigh(matrix)
        root = vectors @ (values[:, :, None] ** (1 / passive.functional_order) * vectors.conj().transpose(0, 2, 1))
        return (form(root) / n_mics) ** passive.functional_order / n_mics
    if passive.method == "capon":
        load = passive.diagonal_loading * np.trace(matrix, axis1=1, axis2=2).real / n_mics
        return 1 / form(np.linalg.inv(matrix + load[:, None, None] * np.eye(n_mics)))
    _, vectors = np.linalg.eigh(matrix)
    noise = vectors[:, :, : n_mics - passive.n_sources]
    return n_mics / form(noise @ noise.conj().transpose(0, 2, 1))


@pytest.mark.parametrize("device", DEVICES)
def test_cross_spectrum_equals_that_of_scipy(device):
    settings = settings_of()
    with AcousticCamera(settings, device, 1) as camera:
        measurement = sound(settings, [(20, 0.1)], noise=0.02)
        camera.add(measurement)
        found = camera.cross_spectrum()
        expected = reference_matrix(camera, measurement)
    assert np.abs(found.matrix - expected).max() < 2e-3 * np.abs(expected).max()  # the low-pass filter has a ripple
    assert np.allclose(found.matrix, found.matrix.conj().transpose(0, 2, 1), atol=1e-7 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("method", "diagonal_removal"),
    [("delay_and_sum", True), *((name, False) for name in MAP_METHODS if not name.endswith("clean_sc"))],
)
def test_powers_equal_their_equation(method, diagonal_removal):
    settings = settings_of(passive__method=method, passive__diagonal_removal=diagonal_removal)
    with AcousticCamera(settings, "cpu") as camera:
        camera.add(sound(settings, [(20, 0.1), (-35, 0.05)], noise=0.02))
        expected = reference_powers(camera, camera.cross_spectrum().matrix.astype(complex))
        found = camera.powers()
    assert np.abs(found - expected).max() < 2e-4 * np.abs(expected).max()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("n_sources", [1, 2, 20])
def test_music_equals_its_equation_at_sharp_peaks(device, n_sources):
    """Two sources lie in directions of the grid, 40 and 34 dB above the noise, and have peaks of 60 dB at most."""
    changes = {key: value for key, value in SMALL.items() if not key.startswith("array.")}
    settings = Settings().replace(**changes, **{"passive.method": "music", "passive.n_sources": n_sources})
    random = np.random.default_rng(6)

    def complex_noise(count):
        return random.standard_normal((len(camera.frequency_hz), count, 64, 2)).view(complex)[..., 0]

    with AcousticCamera(settings, device, 1) as camera:
        waves = waves_of(camera)[:, :, [20, 45]] * [1.0, 0.5]
        heard = waves @ complex_noise(2) + 0.01 * complex_noise(waves.shape[1])
        matrix = heard @ heard.conj().transpose(0, 2, 1) / heard.shape[2]
        spectrum = CrossSpectrum(matrix.astype(np.complex64), camera.frequency_hz, 64)
        found = METHODS["music"](spectrum, camera.waves, settings.passive)
        expected = np.minimum(reference_powers(camera, spectrum.matrix.astype(complex)), 1e6)
    assert np.abs(10 * np.log10(found / expected)).max() < 0.1


@pytest.mark.parametrize(("n_bins", "threads", "n_parts"), [(0, 2, 1), (15, 2, 1), (16, 4, 2), (92, 3, 3), (92, 1, 1)])
def test_parts_of_the_bins_yield_the_results_of_all_bins(n_bins, threads, n_parts):
    numbers, doubled, lengths = np.arange(n_bins), 2 * np.arange(n_bins), []

    def total(some, others):
        lengths.append(len(some))
        return some + others

    assert in_parts(total, numbers, doubled, threads=threads).tolist() == list(range(0, 3 * n_bins, 3))
    assert len(lengths) == n_parts


def test_maps_are_computed_with_one_thread_of_blas(monkeypatch):
    counts, camera = [], AcousticCamera(settings_of(), "numpy")

    def record(spectrum, *_):
        counts.extend(each["num_threads"] for each in threadpoolctl.threadpool_info() if each["user_api"] == "blas")
        return np.zeros((len(spectrum.matrix), len(camera.grid)), np.float32)

    monkeypatch.setitem(METHODS, "delay_and_sum", record)
    with threadpoolctl.threadpool_limits(2, user_api="blas"), camera:
        camera.process(sound(camera.settings, [(20, 0.1)]))
    assert set(counts) == {1}


@pytest.mark.parametrize("method", MAP_METHODS)
def test_source_has_its_direction_and_level(method):
    settings = settings_of(passive__method=method, passive__averages=4)
    with AcousticCamera(settings, "cpu") as camera:
        (found,) = camera.process_many(sound(settings, [(20, 0.1)], noise=0.01, seed=seed) for seed in range(4))
    assert found.n_measurements == 4
    nyquist_hz = settings.recording.sample_rate_hz / 2
    for loudest in found.loudest():
        assert np.degrees(loudest.azimuth_rad) == pytest.approx(21, abs=3.1)  # directions are 3 degrees apart
        if method in ("delay_and_sum", "clean_sc", "hr_clean_sc"):
            low_hz, high_hz = loudest.band_hz
            expected_db = 10 * np.log10(0.1**2 * (high_hz - low_hz) / nyquist_hz)
            assert loudest.level_dbfs == pytest.approx(expected_db, abs=1.0)


def test_clean_sc_leaves_the_powers_of_two_sources():
    settings = settings_of(passive__method="clean_sc", passive__averages=4)
    with AcousticCamera(settings, "cpu") as camera:
        (found,) = camera.process_many(
            sound(settings, [(30, 0.1), (-42, 0.05)], noise=0.005, seed=seed) for seed in range(4)
        )
    power = found.power.sum(axis=1)
    near = [np.abs(np.degrees(found.azimuth_rad) - azimuth_deg) < 7 for azimuth_deg in (30, -42)]
    assert power[near[0]].sum() / power[near[1]].sum() == pytest.approx(4, rel=0.3)
    assert power[~near[0] & ~near[1]].sum() < 0.1 * power.sum()


@pytest.mark.parametrize("diagonal_removal", [False, True])
def test_clean_sc_has_no_power_beside_a_source_in_a_direction_of_the_grid(diagonal_removal):
    """Sidelobes of a map without the diagonal are negative in part, and must cancel all the same.

    Delays of up to a tenth of a block leave about 0.5 % of the sound incoherent.
    """
    settings = settings_of(passive__method="clean_sc", passive__diagonal_removal=diagonal_removal)
    with AcousticCamera(settings, "cpu") as camera:
        found = camera.process(sound(settings, [(21, 0.1)]))
    place = int(np.argmin(np.abs(np.degrees(found.azimuth_rad) - 21)))
    beside = np.delete(found.power, place, axis=0)
    assert 10 * np.log10(beside.sum(axis=0) / found.power[place]).max() < -20


def test_measurement_of_other_settings_is_refused_with_the_keys_that_differ():
    settings = settings_of()
    warmer = settings.replace(**{"air.temperature_c": 30.0, "air.humidity_percent": 10.0})
    message = (
        r"has air.temperature_c 30.0, but 20.0 is in use, air.humidity_percent 10.0, but 50.0 is in use; process it "
        r"with its own settings \(measurement.settings\)"
    )
    with AcousticCamera(settings, "numpy") as camera, pytest.raises(DataError, match=message):
        camera.add(sound(warmer, [(20, 0.1)]))


def test_diagonal_removal_suppresses_the_noise_of_microphones():
    levels = {}
    for removed in (False, True):
        settings = settings_of(passive__diagonal_removal=removed, passive__averages=20)
        with AcousticCamera(settings, "cpu") as camera:
            (found,) = camera.process_many(sound(settings, [], noise=0.1, seed=seed) for seed in range(20))
        levels[removed] = 10 * np.log10(found.power.mean())
    assert levels[True] < levels[False] - 6


def test_calibrated_delays_and_gains_are_removed():
    plain = settings_of()
    gain, delay_s = (1.0, 0.5, 2.0, 1.0, -1.0, 1.0), (0.0, 2e-6, -3e-6, 1e-6, 0.0, 4e-6)
    calibrated = plain.replace(**{"array.gain": gain, "array.delay_s": delay_s})
    heard = sound(plain, [(20, 0.1)], noise=0.001)
    n, rate_hz = plain.recording.n_samples, plain.recording.sample_rate_hz
    lag = np.exp(-2j * np.pi * np.fft.rfftfreq(n, 1 / rate_hz) * np.array(delay_s)[:, None])
    moved = np.array(gain)[:, None] * np.fft.irfft(np.fft.rfft(heard.data.T) * lag, n)
    with AcousticCamera(plain, "cpu") as camera:
        expected = camera.process(heard)
    with AcousticCamera(calibrated, "cpu") as camera:
        found = camera.process(ertis.Measurement(np.ascontiguousarray(moved.T, np.float32), calibrated))
    assert found.power == pytest.approx(expected.power, rel=0.02, abs=1e-3 * float(expected.power.max()))


def test_levels_are_those_of_sound_pressure_if_the_sensitivity_is_known():
    plain = settings_of()
    known = plain.replace("array.sensitivity_dbfs", -26.0)
    found = []
    for settings in (plain, known):
        with AcousticCamera(settings, "cpu") as camera:
            found.append(camera.process(sound(settings, [(20, 0.1)])))
    assert found[0].level_db is None
    assert found[1].level_db == pytest.approx(found[1].level_dbfs + 94 + 26 + 3, abs=0.1)


@pytest.mark.parametrize("delay_s", [0.0, 0.01])
def test_time_of_the_call_is_left_out(delay_s):
    settings = settings_of(call__delay_s=delay_s)
    measurement = sound(settings, [(20, 0.01)])
    loud = measurement.data.copy()
    n_call = int((settings.call.end_s + 0.0005) * settings.recording.sample_rate_hz)
    loud[:n_call] += np.sin(np.arange(n_call) * 0.8)[:, None].astype(np.float32)
    levels = {}
    with AcousticCamera(settings, "cpu") as camera:
        for behaviour in ("passive", "active"):
            found = camera.process(ertis.Measurement(loud, settings, ertis.Stamp(behaviour=behaviour)))
            levels[behaviour] = found.level_dbfs.max()
            assert (found.masked_s > settings.call.end_s) == (behaviour == "active")
    assert levels["active"] < levels["passive"] - 10


def test_focus_is_that_of_a_near_source():
    scene = ertis.Scene.from_toml(
        "sensors = [{emitter.silent = true}]\neffects = {absorption = false}\n"
        "noises = [{position_m = [0.25, 0.02, 0.0], band_hz = [30000, 50000], level_db = -40}]"
    )
    measurement = ertis.render(scene)
    levels = []
    for focus_m in (None, 0.25):
        settings = measurement.settings.replace(
            **{"passive.focus_m": focus_m, "passive.bands_hz": [[30e3, 50e3]], "processing.directions": "2d:181"}
        )
        with AcousticCamera(settings, "cpu") as camera:
            found = camera.process(ertis.Measurement(measurement.data, settings, measurement.stamp))
        levels.append(found.loudest()[0])
    assert levels[1].level_dbfs == pytest.approx(-40 - 20 * np.log10(np.hypot(0.25, 0.02)), abs=0.3)
    assert levels[1].level_dbfs > levels[0].level_dbfs + 0.5
    assert np.degrees(levels[1].azimuth_rad) == pytest.approx(np.degrees(np.arctan2(0.02, 0.25)), abs=1.5)


@pytest.mark.parametrize("range_m", [0.5, 3.0])
def test_source_level_is_that_at_1_m_at_any_distance(range_m):
    scene = ertis.Scene.from_toml(
        "sensors = [{emitter.silent = true}]\neffects = {absorption = true}\n"
        f"noises = [{{azimuth_deg = 20.0, range_m = {range_m}, band_hz = [30000, 70000], level_db = -40}}]"
    )
    measurement = ertis.render(scene)
    settings = measurement.settings.replace(
        **{
            "passive.focus_m": range_m,
            "passive.bands_hz": [[35e3, 40e3], [60e3, 65e3]],
            "array.sensitivity_dbfs": -26.0,
        }
    )
    with AcousticCamera(settings, "cpu") as camera:
        found = camera.process(ertis.Measurement(measurement.data, settings, measurement.stamp))
    # The noise is white: each band has an eighth of its power. Few blocks measure it to some tenths of a decibel.
    wanted_db = 94 + 26 + 3.01 - 40 - 10 * np.log10(8)
    assert [each.source_level_db for each in found.loudest()] == pytest.approx([wanted_db, wanted_db], abs=0.7)
    loss_db = transmission_loss_db(settings.air, range_m, found.centre_hz)
    assert found.source_level_db == pytest.approx(found.level_db + loss_db, abs=1e-3)
    assert found.reference.unit == "dB re 20 µPa at 1 m"


@pytest.mark.parametrize(("focus_m", "sensitivity_dbfs"), [(None, -26.0), (2.0, None)])
def test_source_level_needs_distance_and_sensitivity(focus_m, sensitivity_dbfs):
    settings = settings_of(passive__focus_m=focus_m, array__sensitivity_dbfs=sensitivity_dbfs)
    with AcousticCamera(settings, "numpy") as camera:
        found = camera.process(sound(settings, [(20, 0.1)]))
    assert found.source_level_db is None
    assert {each.source_level_db for each in found.loudest()} == {None}
    assert found.reference.unit == ("dBFS" if sensitivity_dbfs is None else "dB re 20 µPa")


def test_source_level_is_unknown_where_air_absorbs_too_much():
    settings = settings_of(array__sensitivity_dbfs=-26.0, passive__focus_m=10_000.0)
    with AcousticCamera(settings, "cpu") as camera:
        camera.add(sound(settings, [(20, 0.1)], noise=0.02))
        found, bearings = camera.map(), find_bearings(camera, top=1)
    assert np.isnan(found.source_level_db).all()
    assert np.isfinite(found.level_db).all()
    assert {each.source_level_db for each in found.loudest()} == {None}
    assert {each.as_dict()["source_level_db"] for each in found.loudest()} == {None}
    assert {each.level[1] for each in bearings} == {found.reference.unit} == {"dB re 20 µPa"}


def test_mode_decides_between_images_and_maps():
    settings, silent, loud = Settings(), ertis.Stamp(behaviour="passive"), ertis.Stamp(behaviour="active")
    assert [is_passive(settings, stamp) for stamp in (silent, loud, ertis.Stamp())] == [True, False, False]
    assert is_passive(settings.replace("processing.mode", "passive"), loud)
    assert not is_passive(settings.replace("processing.mode", "active"), silent)


def test_octaves_are_those_of_the_standard():
    assert octave_bands(8.9e3, 89.5e3).mean(axis=1).round(-2)[[0, -1]].tolist() == [10100.0, 80000.0]
    assert len(octave_bands(8.9e3, 89.5e3)) == 10
    thirds = octave_bands(100, 10e3)
    assert thirds[1:, 0] == pytest.approx(thirds[:-1, 1])
    assert octave_bands(707, 1413, fraction=1) == pytest.approx(np.array([[707.9, 1412.5]]), rel=1e-3)


def test_adjacent_bands_sum_to_the_band_that_contains_them():
    power = []
    for bands_hz in ([[20e3, 40e3]], [[30.3e3, 40e3], [20e3, 30.3e3]]):
        with AcousticCamera(settings_of(passive__bands_hz=bands_hz, passive__resolution_hz=500.0), "cpu") as camera:
            power.append(camera.process(sound(camera.settings, [(20, 0.1)])).power.sum(axis=1))
    assert power[1] == pytest.approx(power[0], rel=1e-4)


@pytest.mark.parametrize("fraction", [1, 3])
def test_octaves_share_each_frequency_once(fraction):
    bands_hz, frequency_hz = octave_bands(8.9e3, 89.5e3, fraction=fraction), np.arange(8.0e3, 95.0e3, 250.0)
    shares = bin_shares(bands_hz, frequency_hz).sum(axis=0)
    inside = (frequency_hz > bands_hz.min() + 125) & (frequency_hz < bands_hz.max() - 125)
    assert shares[inside] == pytest.approx(1)
    assert shares.max() <= 1 + 1e-6


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"passive__bands_hz": [[20e3, 100e3]]}, "reaches only 90000 Hz"),
        ({"passive__bands_hz": [[25e3, 20e3]]}, "passive.bands_hz[0]"),
        (
            {"passive__bands_hz": [[40e3, 41e3], [20e3, 30e3], [40e3, 41e3]]},
            "has overlapping bands 40000 to 41000 Hz and 40000 to 41000 Hz; use bands that share at most an edge",
        ),
        ({"passive__bands_hz": [[25e3, 40e3], [20e3, 26e3]]}, "20000 to 26000 Hz and 25000 to 40000 Hz"),
        ({"passive__bands_hz": "third_octaves", "passive__limits_hz": [100e3, 101e3]}, "use wider limits"),
        ({"passive__resolution_hz": 10.0}, "passive.resolution_hz needs blocks of"),
        ({"passive__method": "music", "passive__n_sources": 6}, "6 microphones"),
        ({"passive__method": "capon", "passive__diagonal_removal": True}, "does not support"),
        ({"passive__method": "loudest"}, "passive.method"),
        ({"array__disabled": (0, 1, 2, 3, 4)}, "array has 1 enabled microphone"),
    ],
)
def test_settings_that_cannot_be_used_are_refused(changes, words):
    with pytest.raises(ArgumentError, match=words.replace("[", r"\[").replace("]", r"\]")):
        AcousticCamera(settings_of(**changes), "cpu")


@pytest.mark.parametrize("bands_hz", [(1.0, 2.0), (10.0, 20.0), (1000.0, 1010.0)])
def test_narrow_bands_are_refused_with_a_width_that_suffices(bands_hz):
    narrow = settings_of(passive__bands_hz=[bands_hz], passive__resolution_hz=None)
    with pytest.raises(
        ArgumentError, match=r"^passive\.bands_hz needs blocks of .* bands of at least \d+ Hz"
    ) as refused:
        AcousticCamera(narrow, "cpu")
    width_hz = int(re.search(r"at least (\d+) Hz", str(refused.value))[1])
    wide = narrow.replace("passive.bands_hz", [(bands_hz[0], bands_hz[0] + width_hz)])
    with AcousticCamera(wide, "cpu") as camera:
        assert np.isfinite(camera.process(sound(wide, [(20, 0.1)])).power).all()


def test_measurements_of_another_type_are_refused():
    with AcousticCamera(settings_of(), "cpu") as camera:
        with pytest.raises(ArgumentError, match="measurements is of type Measurement"):
            list(camera.process_many(sound(settings_of(), [])))
        with pytest.raises(ArgumentError, match=r"measurements\[0\] is of type int"):
            list(camera.process_many([1]))


def test_too_few_blocks_are_refused():
    settings = settings_of(passive__method="music", passive__n_sources=4, passive__resolution_hz=60.0)
    with AcousticCamera(settings, "cpu") as camera:
        with pytest.raises(DataError, match="no measurement"):
            camera.map()
        with pytest.raises(DataError, match=r"larger passive\.averages"):
            camera.process(sound(settings, [(20, 0.1)]))
    settings = settings_of(passive__resolution_hz=28.0)
    with AcousticCamera(settings, "cpu") as camera, pytest.raises(DataError, match="no block of"):
        camera.process(ertis.Measurement(sound(settings, []).data, settings, ertis.Stamp(behaviour="active")))


@pytest.mark.parametrize("scale", [2e13, 1e18, 1e38])
def test_sound_whose_powers_exceed_single_precision_is_refused(scale):
    measurement = sound(settings_of(), [(20, 0.1)], noise=0.01)
    data = (scale * measurement.data.astype(float) / np.abs(measurement.data).max()).astype(np.float32)
    with AcousticCamera(measurement.settings, "cpu") as camera, pytest.raises(DataError, match="divide the samples"):
        camera.process(ertis.Measurement(data, measurement.settings))
    data = (0.9e12 * measurement.data.astype(float) / np.abs(measurement.data).max()).astype(np.float32)
    with AcousticCamera(measurement.settings, "cpu") as camera:
        assert np.isfinite(camera.process(ertis.Measurement(data, measurement.settings)).power).all()
