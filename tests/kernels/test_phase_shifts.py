"""Phase shifts of spectra: kernels equal references, images are exact, and strict budgets choose them."""

import dataclasses

import numpy as np
import pytest

from ertis_numba.base.errors import ArgumentError
from ertis_numba.chain import phase_shifts
from ertis_numba.chain.plan_response import deviation_of
from ertis_numba.chain.planner import Planner
from ertis_numba.chain.signal_model import signal_model_of
from ertis_numba.frames import Measurement
from ertis_numba.geometry import unit_vectors
from ertis_numba.kernels._scalar import cosine_and_sine
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Accuracy, Array, Processing, Settings
from tests import reference
from tests.cases import CASES, LINE_8, SHORT, noise
from tests.error_cases import CPU, random_measurement
from tests.hard_cases.tuned import tuned
from tests.on_device import KERNELS, sized
from tests.simulation.test_real import RAW

GARBAGE = 12_345.0
SHAPES = {
    # microphones, directions, places of the input, places of the output, first bin, bins
    "least": (1, 1, 1, 1, 0, 1),
    "wraps": (3, 5, 40, 40, 73, 30),
    "full": (2, 3, 33, 33, 5, 33),
    "two bins at a place": (2, 3, 60, 30, 47, 41),
    "three bins at a place": (5, 2, 24, 8, 3, 24),
    "over a tile": (1, 2, 140, 140, 9, 131),
    "many bins": (6, 17, 900, 900, 333, 777),
    "eRTIS": (32, 90, 1400, 1400, 620, 1085),
    "thousand microphones": (1000, 3, 64, 64, 2, 50),
}
SHAPE_NAMES = sized(
    ["least", "wraps", "full", "two bins at a place", "three bins at a place", "over a tile"],
    ["many bins", "eRTIS", "thousand microphones"],
)
SHIFTED = {"delay_taps": 0, "stopband_attenuation_db": 100.0, "max_error_db": 0.0}
PUBLISHED = Settings(processing=Processing(directions="3d:3000", range_m=(0.5, 5.0)))


@pytest.fixture(params=KERNELS)
def kernel_set(request):
    return KERNELS[request.param]


def spectra_of(name):
    """Return input of the kernel: spectra, starts, steps, first bin and number of bins."""
    n_mics, n_directions, n_in, _, first_bin, n_bins = SHAPES[name]
    random = np.random.default_rng(3)
    spectra = np.zeros((n_mics, 1, n_in), dtype=np.complex64)
    heard = random.standard_normal((n_mics, n_bins)) + 1j * random.standard_normal((n_mics, n_bins))
    spectra[:, 0, (first_bin + np.arange(n_bins)) % n_in] = heard
    starts, steps = random.integers(0, 2**32, (2, n_directions, n_mics), dtype=np.uint32)
    return spectra, starts, steps, first_bin, n_bins


def sums_of(spectra, starts, steps, first_bin, n_bins, n_out):
    """Evaluate the equation of `SumSpectra` in float64."""
    out = np.zeros((len(starts), 1, n_out), dtype=complex)
    for b in range(n_bins):
        phases = np.exp(2j * np.pi * ((starts.astype(float) + b * steps.astype(float)) / 2**32 % 1))
        out[:, 0, (first_bin + b) % n_out] += phases @ spectra[:, 0, (first_bin + b) % spectra.shape[2]]
    return out


@pytest.mark.parametrize("name", SHAPE_NAMES)
def test_sum_spectra_equals_its_reference(kernel_set, name):
    given, n_out = spectra_of(name), SHAPES[name][3]
    expected = sums_of(*given, n_out)
    out = np.full(expected.shape, GARBAGE, dtype=np.complex64)
    kernel_set.sum_spectra(*given, out)
    assert np.linalg.norm(out - expected) < 2e-6 * np.linalg.norm(expected)
    assert np.abs(out - expected).max() < 1e-5 * np.abs(expected).max()
    assert not out[expected == 0].any()


@pytest.mark.parametrize(("lead", "first", "stop"), [(0, 0, 40), (7, 0, 40), (3, 5, 17), (2, 39, 40), (0, 3, 3)])
def test_envelope_rows_equals_its_reference(kernel_set, lead, first, stop):
    random = np.random.default_rng(4)
    beams = random.standard_normal((5, 1, 50, 2)).astype(np.float32).view(np.complex64)[..., 0]
    out = np.full((4, 40), GARBAGE, dtype=np.float32)
    kernel_set.envelope_rows(beams, lead, first, stop, out)
    expected = np.full((4, 40), GARBAGE)
    expected[:, first:stop] = np.abs(beams[:4, 0, lead + first : lead + stop])
    assert out == pytest.approx(expected, rel=1e-6)


def test_phases_are_exact_at_any_turn():
    phases = np.concatenate([np.arange(0, 2**32, 2**24 + 1), [2**29 - 1, 2**29, 2**31, 2**32 - 1]]).astype(np.uint32)
    found = np.array([cosine_and_sine(phase) for phase in phases])
    turns = 2 * np.pi * phases.astype(float) / 2**32
    assert np.abs(found - np.stack([np.cos(turns), np.sin(turns)], axis=1)).max() < 1.2e-7
    assert cosine_and_sine(np.uint64(5 * 2**32 + 2**30)) == cosine_and_sine(np.uint32(2**30))


def test_nan_affects_only_its_own_bin():
    spectra, *given = spectra_of("wraps")
    spectra[1, 0, (73 + 4) % 40] = np.nan
    out = np.empty((5, 1, 40), dtype=np.complex64)
    KERNELS["cpu"].sum_spectra(spectra, *given, out)
    assert np.flatnonzero(np.isnan(out[:, 0]).any(axis=0)).tolist() == [(73 + 4) % 40]


def real_settings(directions, range_m):
    """Return settings for the real measurement."""
    settings = Settings.from_preset("default_25_50")
    return settings.replace(processing=settings.processing.replace(directions=directions, range_m=range_m))


# ---- images --------------------------------------------------------------------------------------------


def error_db(pipeline, measurement):
    """Error of the pipeline's image of a measurement."""
    vectors = unit_vectors(pipeline.grid.azimuth_rad, pipeline.grid.elevation_rad)
    spherical = pipeline.settings.processing.wavefront == "spherical"
    expected = reference.exact(measurement.data, pipeline.settings, vectors, pipeline.range_m, spherical=spherical)
    return reference.error_db(pipeline.process(measurement).amplitude, expected)


@pytest.mark.parametrize("device", ["cpu", "numpy"])
@pytest.mark.parametrize("name", CASES)
def test_image_with_phase_shifts_is_exact(name, device):
    settings = tuned(CASES[name], **SHIFTED)
    pipeline = Pipeline(settings, device=device, predict=False)
    accuracy = pipeline.settings.accuracy
    assert (accuracy.precision, accuracy.oversampling, accuracy.beam_taps) == ("float32", 1, 0)
    assert error_db(pipeline, noise(settings)) < -95


@pytest.mark.parametrize("layout", ["eRTIS", "line"])
def test_spherical_wavefronts_with_phase_shifts_are_exact(layout):
    """Each range has its own focal zone."""
    array = Array() if layout == "eRTIS" else Array(layout="line", positions_m=LINE_8, word_bits=8)
    processing = Processing(directions="2d:5", range_m=(0.1, 0.4), wavefront="spherical")
    settings = tuned(SHORT.replace(array=array, processing=processing), **SHIFTED, focal_zones=10_000)
    assert error_db(Pipeline(settings, predict=False), noise(settings)) < -95


def test_blocks_of_directions_do_not_change_the_image(monkeypatch):
    settings = tuned(CASES["solid angle"], **SHIFTED)
    measurement = noise(settings)
    whole = Pipeline(settings, predict=False).process(measurement).amplitude
    monkeypatch.setattr(phase_shifts, "_BEAMS_BYTES", 20_000)
    with Pipeline(settings, predict=False) as pipeline:
        assert 1 < phase_shifts.rows_at_a_time(11, 300) < 11
        assert pipeline.process(measurement).amplitude.tobytes() == whole.tobytes()


def test_phase_shifts_give_the_same_bits_on_any_number_of_threads():
    settings = tuned(SHORT.replace(processing=SHORT.processing.replace(directions="2d:90")), **SHIFTED)
    measurement = noise(settings)
    counts = range(1, KERNELS["cpu"].max_threads + 1)
    images = [Pipeline(settings, threads=count, predict=False).process(measurement).amplitude for count in counts]
    assert len({image.tobytes() for image in images}) == 1


def test_beams_of_phase_shifts_have_no_deviation():
    settings = Pipeline(tuned(SHORT, **SHIFTED), predict=False).settings
    assert deviation_of(settings, np.eye(3)[:1]) is None


# ---- plans ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("instruction_set", ["AVX-512 VNNI", "AVX-512", "AVX2", "SSE2"])
@pytest.mark.parametrize(
    ("max_error_db", "is_shifted"),
    [(-20.0, False), (-35.0, False), (-60.0, False), (-90.0, True), (-100.0, True), (-110.0, True)],
)
def test_strict_budgets_choose_phase_shifts(max_error_db, is_shifted, instruction_set):
    """The grid is the published one: 3000 directions, from 0.5 m to 5 m."""
    kernel_set = dataclasses.replace(CPU, instruction_set=instruction_set)
    settings = tuned(PUBLISHED, max_error_db=max_error_db)
    chosen = Planner(settings, kernel_set, threads=1).choose()
    assert (chosen.settings.accuracy.delay_taps == 0) == is_shifted
    assert chosen.error_db <= max_error_db
    if not is_shifted:
        shifted = Planner(tuned(settings, delay_taps=0), kernel_set, threads=1).choose()
        assert shifted.time_ms > chosen.time_ms


@pytest.mark.parametrize("changes", [{"precision": "int16"}, {"oversampling": 16}, {"beam_taps": 6}, {"delay_taps": 4}])
def test_other_given_parts_of_a_plan_exclude_phase_shifts(changes):
    settings = tuned(PUBLISHED, max_error_db=-60.0, **changes)
    accuracy = Planner(settings, CPU, threads=1).choose().settings.accuracy
    assert accuracy.delay_taps > 0
    assert {name: getattr(accuracy, name) for name in changes} == changes


def test_spherical_wavefronts_take_phase_shifts_only_if_asked():
    processing = PUBLISHED.processing.replace(wavefront="spherical")
    settings = tuned(PUBLISHED.replace(processing=processing), max_error_db=-60.0)
    assert Planner(settings, CPU, threads=1).choose().settings.accuracy.delay_taps > 0
    asked = Planner(tuned(settings, delay_taps=0), CPU, threads=1).choose()
    assert asked.settings.accuracy.focal_zones > 1
    assert asked.error_db <= -60


@pytest.mark.parametrize("max_error_db", [-90.0, -100.0, -109.0, -110.0])
def test_true_error_of_phase_shifts_keeps_strict_budgets(max_error_db):
    settings = tuned(real_settings("2d:61", (0.8, 5.0)), delay_taps=0)
    with Pipeline(settings, "cpu", max_error_db=max_error_db, predict=False) as pipeline:
        assert error_db(pipeline, Measurement(np.fromfile(RAW, dtype="<u4"), settings)) < max_error_db


# ---- predictions ---------------------------------------------------------------------------------------


def differences_db(measurement, settings):
    """Return predicted and true errors of phase shifts for three decimation filters."""
    settings = settings.replace(processing=settings.processing.replace(wavefront="plane"))
    signal_model = signal_model_of(measurement, settings, CPU)
    found = []
    for attenuation_db in (80.0, 100.0, 140.0):
        with Pipeline(tuned(settings, **SHIFTED | {"stopband_attenuation_db": attenuation_db}), predict=False) as made:
            planner = Planner(made.settings, CPU, threads=1, signal_model=signal_model)
            found.append((planner.error_db(made.settings.accuracy), error_db(made, measurement)))
    return np.array(found)


def assert_predicted(pairs):
    """Predictions agree within 2 dB, below -100 dB within 3 dB if pessimistic; more where only rounding is left."""
    predicted_db, true_db = pairs.T
    assert (predicted_db > true_db - 2).all(), pairs
    audible = true_db > -118
    assert audible.any()
    assert (predicted_db < true_db + np.where(true_db > -100, 2, 3))[audible].all(), pairs


@pytest.mark.parametrize(
    ("directions", "range_m"),
    [("2d:31", (0.8, 5.0)), ("2d:31", (0.1, 1.0)), ("2d:31", (3.0, 5.0)), ("2d:31", (1.5, 2.0)), ("3d:60", (0.5, 5.0))],
)
def test_predicted_error_of_phase_shifts_matches_the_real_measurement(directions, range_m):
    settings = real_settings(directions, range_m)
    assert_predicted(differences_db(Measurement(np.fromfile(RAW, dtype="<u4"), settings), settings))


@pytest.mark.parametrize("seed", range(12))
def test_predicted_error_of_phase_shifts_matches_random_scenes(seed):
    assert_predicted(differences_db(*random_measurement(seed)))


@pytest.mark.parametrize("name", ["default", "wide band", "solid angle", "line of 8"])
def test_predicted_error_of_phase_shifts_matches_noise(name):
    assert_predicted(differences_db(noise(CASES[name]), CASES[name]))


# ---- settings ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"precision": "int16"}, r"accuracy\.precision is 'int16', but accuracy\.delay_taps 0 .* only 'float32'"),
        ({"oversampling": 4}, r"accuracy\.oversampling is 4, but accuracy\.delay_taps 0 .* supports only 1; leave"),
        ({"beam_taps": 4}, r"accuracy\.beam_taps is 4, but accuracy\.delay_taps 0 .* supports only 0; leave"),
    ],
)
def test_unsuitable_parts_of_a_plan_are_refused(changes, message):
    with pytest.raises(ArgumentError, match=message):
        Accuracy(delay_taps=0, **changes)


@pytest.mark.parametrize(
    "changes", [{"beamformer": "dmas"}, {"beamformer": "capon"}, {"weighting": "coherence_factor"}]
)
def test_adaptive_beamformers_are_refused(changes):
    with pytest.raises(ArgumentError, match=r"accuracy\.delay_taps is 0 .* does not support; leave it out or use 1"):
        Settings(processing=Processing(**changes), accuracy=Accuracy(delay_taps=0))
