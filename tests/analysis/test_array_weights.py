"""Array weights: laws of tapered apertures, and equality of every path that uses them."""

import math

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli
from hypothesis import given, strategies as st

from ertis_numba import kernels
from ertis_numba.analysis.compare import _Lobe
from ertis_numba.analysis.point_spread import PointSpread
from ertis_numba.analysis.uncertainty import _effective_covariance_m2
from ertis_numba.base.errors import ArgumentError
from ertis_numba.figures import _captions
from ertis_numba.figures._array import pattern_db, width_deg
from ertis_numba.geometry import array_weights, effective_count, microphones, unit_vectors
from ertis_numba.pipeline import Pipeline, verification
from ertis_numba.pipeline.prediction import planner_of, predict
from ertis_numba.settings import Array, Settings, parse_window
from ertis_numba.settings.beamformers import ADAPTIVE_COMBINATIONS
from ertis_numba.simulation import Point, Scene
from ertis_numba.simulation.render import Simulator
from ertis_numba.storage import open_energyscapes, write_recording
from tests import reference
from tests.cases import SHORT, noise
from tests.hard_cases.tuned import tuned
from tests.rings import sensor_of

WINDOWS = ("cosine", "hann", "hamming", "blackman", "taylor:35", "kaiser:4")
HALF_WAVE_M = 343.87 / 40e3 / 2
N_LINE = 32
LINE = Array(layout="line", positions_m=tuple((0.0, HALF_WAVE_M * m, 0.0) for m in range(N_LINE)))


def weighted(settings, weights):
    return settings.replace(processing=settings.processing.replace(array_weights=weights))


def line_pattern(weights):
    """Angles and levels of the beam pattern of a line at half-wavelength spacing."""
    angle_deg = np.linspace(-90, 90, 7201)
    settings = weighted(SHORT.replace(array=LINE), weights)
    level_db = pattern_db(settings, [40e3], angle_deg, np.zeros_like(angle_deg), azimuth_deg=0, elevation_deg=0)
    return angle_deg, level_db


def highest_side_lobe_db(level_db):
    """Level of the highest maximum beside the main lobe, which ends at the first minimum."""
    right = level_db[len(level_db) // 2 :]
    return float(right[int(np.argmax(np.diff(right) > 0)) :].max())


# ---- the weights ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("window", "side_lobe_db", "widening"),
    [("uniform", -13.2, 1.0), ("cosine", -23.0, 1.34), ("hann", -31.5, 1.62), ("hamming", -41.0, 1.47)],
)
def test_windows_lower_side_lobes_and_widen_the_main_lobe(window, side_lobe_db, widening):
    """Levels and widths of continuous apertures, after F. J. Harris, Proc. IEEE 66 (1978), table 1."""
    angle_deg, level_db = line_pattern(window)
    assert highest_side_lobe_db(level_db) == pytest.approx(side_lobe_db, abs=1.5)
    uniform_deg = width_deg(*line_pattern("uniform"), 0.0)
    assert width_deg(angle_deg, level_db, 0.0) / uniform_deg == pytest.approx(widening, rel=0.03)


@pytest.mark.parametrize("attenuation_db", [25, 35, 50])
def test_taylor_window_has_the_side_lobes_of_its_parameter(attenuation_db):
    _, level_db = line_pattern(f"taylor:{attenuation_db}")
    assert highest_side_lobe_db(level_db) == pytest.approx(-attenuation_db, abs=1.5)


def test_hann_weights_of_a_line_are_those_of_the_equation():
    place = (np.arange(N_LINE) - (N_LINE - 1) / 2) / (N_LINE / 2)
    expected = np.cos(math.pi * place / 2) ** 2
    found = array_weights(weighted(SHORT.replace(array=LINE), "hann"))
    np.testing.assert_allclose(found, expected / expected.mean(), atol=2e-6)


@pytest.mark.parametrize("window", WINDOWS)
@pytest.mark.parametrize("layout", ["eRTIS_v3D1", "eRTIS_v2"])
def test_windows_fall_with_the_distance_from_the_centre(window, layout):
    settings = weighted(SHORT.replace(array=Array(layout=layout)), window)
    weights = array_weights(settings)
    outwards = np.argsort(np.linalg.norm(microphones(settings.array).enabled_positions_m, axis=1))
    assert (np.diff(weights[outwards]) <= 1e-12).all()
    assert weights.min() > 0
    assert weights.mean() == pytest.approx(1.0)


@given(
    st.lists(st.floats(0.0, 1e3), min_size=8, max_size=8).filter(lambda each: max(each) > 1e-3), st.floats(1e-2, 1e2)
)
def test_listed_weights_are_scaled_to_a_mean_of_1(weights, scale):
    settings = SHORT.replace(array=LINE.replace(positions_m=LINE.positions_m[:8]))
    found = array_weights(weighted(settings, tuple(weights)))
    scaled = array_weights(weighted(settings, tuple(scale * weight for weight in weights)))
    assert found.mean() == pytest.approx(1.0)
    np.testing.assert_allclose(found, scaled, rtol=1e-9, atol=1e-12)
    assert 1 - 1e-9 <= effective_count(found) <= 8 + 1e-9


def test_single_microphone_has_the_weight_1():
    settings = SHORT.replace(array=Array(layout="one", positions_m=((0.0, 0.0, 0.0),), word_bits=8))
    assert array_weights(weighted(settings, "hann")).tolist() == [1.0]


# ---- images -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("device", [name for name in kernels.usable() if not kernels.load(name).simulated])
@pytest.mark.parametrize(
    "plan",
    [
        {"precision": "float32"},
        {"precision": "int16"},
        {"precision": "float32", "beam_taps": 6},
        {"precision": "int16", "beam_taps": 6},
        {"precision": "float32", "wavefront": "spherical"},
    ],
    ids=lambda plan: "-".join(map(str, plan.values())),
)
def test_weighted_image_is_that_of_an_array_with_gains_divided_by_the_weights(device, plan):
    """A weight and the inverse of a gain are the same factor, so the float64 reference needs no weights."""
    wavefront = plan.get("wavefront", "plane")
    rest = {name: value for name, value in plan.items() if name != "wavefront"}
    processing = SHORT.processing.replace(wavefront=wavefront, directions="3d:12", array_weights="hann")
    settings = tuned(SHORT.replace(processing=processing), **rest)
    measurement = noise(settings)
    image = Pipeline(settings, device, predict=False).process(measurement)
    layout = microphones(settings.array)
    gain = np.ones(len(layout.enabled))
    gain[layout.enabled] = 1 / array_weights(settings)
    referee = weighted(settings, "uniform").replace(array=layout.to_array().replace(gain=tuple(gain.tolist())))
    directions = unit_vectors(image.azimuth_rad, image.elevation_rad)
    exact = reference.exact(measurement.data, referee, directions, image.range_m, spherical=wavefront == "spherical")
    assert reference.error_db(image.amplitude, exact) < settings.accuracy.max_error_db
    assert reference.error_db(verification.exact_image(image, measurement).amplitude, exact) < -100


@pytest.mark.parametrize("method", ["fast", "paper"])
def test_weight_of_zero_is_a_disabled_microphone(method):
    channels = (4, 9)
    weights = tuple(0.0 if channel in channels else 2.0 for channel in range(32))
    processing = SHORT.processing.replace(method=method)
    settings = tuned(
        SHORT.replace(processing=processing), precision="float32", oversampling=24, delay_taps=2, beam_taps=0
    )
    disabled = settings.replace(array=settings.array.replace(disabled=channels))
    found, expected = (
        Pipeline(each, predict=False).process(noise(each)).amplitude for each in (weighted(settings, weights), disabled)
    )
    assert np.linalg.norm(found - expected) < 1e-6 * np.linalg.norm(expected)


def test_weights_keep_the_level_of_an_echo_and_lower_its_side_lobes():
    processing = SHORT.processing.replace(directions="2d:181", range_m=(0.6, 1.2), wavefront="spherical")
    settings = SHORT.replace(array=LINE, processing=processing)
    scene = Scene(points=(Point(azimuth_deg=0.0, elevation_deg=0.0, range_m=0.9),), sensors=(sensor_of(settings),))
    measurement = Simulator(scene).render()
    tops, sides = [], []
    for window in ("uniform", "hann"):
        amplitude = Pipeline(weighted(settings, window), predict=False).process(measurement).amplitude
        tops.append(amplitude.max())
        aside = np.abs(np.arange(181) - 90) > 12  # beyond the main lobe of either
        sides.append(amplitude[aside][:, np.abs(np.arange(amplitude.shape[1]) - np.argmax(amplitude[90])) < 3].max())
    assert 20 * np.log10(tops[1] / tops[0]) == pytest.approx(0.0, abs=0.5)
    assert 20 * np.log10(sides[1] / sides[0]) < -10


@pytest.mark.parametrize("weights", ["hann", "kaiser:8", tuple(float(channel % 4 == 0) for channel in range(32))])
@pytest.mark.parametrize("wavefront", ["plane", "spherical"])
def test_predicted_error_of_weighted_images_is_not_too_low(weights, wavefront):
    processing = SHORT.processing.replace(directions="2d:31", wavefront=wavefront, array_weights=weights)
    settings = SHORT.replace(processing=processing)
    measurement = noise(settings)
    image = Pipeline(settings, "cpu", 1, predict=False).process(measurement)
    predicted_db = predict(planner_of(image, measurement, kernels.load("cpu"), threads=1)).predicted_error_db
    true_db = verification.error_db(image.amplitude, verification.exact_image(image, measurement).amplitude)
    assert true_db - 1 < predicted_db < true_db + 12


def test_whole_weights_are_repeated_microphones_to_point_spread_and_lobe():
    once, twice = LINE.positions_m[:3], LINE.positions_m[:1] + 2 * LINE.positions_m[1:2] + LINE.positions_m[2:3]
    three = weighted(SHORT.replace(array=LINE.replace(positions_m=once)), (1.0, 2.0, 1.0))
    four = SHORT.replace(array=LINE.replace(positions_m=twice))
    rng = np.random.default_rng(1)
    away, away_m = 0.3 * rng.standard_normal((50, 3)), 0.01 * rng.standard_normal(50)
    np.testing.assert_allclose(PointSpread(three)(away, away_m), PointSpread(four)(away, away_m), rtol=1e-4)
    np.testing.assert_allclose(_Lobe(three)(away), _Lobe(four)(away))


def test_uncertainty_of_weighted_arrays_is_that_of_maxima_in_noise():
    """Maxima of 4000 weighted beams in white noise have the predicted standard deviation."""
    wave_1_m, amplitude = 2 * math.pi * 40e3 / 343.87, 30.0
    settings = weighted(SHORT.replace(array=LINE), "hann")
    weights, place_m = array_weights(settings), microphones(LINE).enabled_positions_m[:, 1]
    rng = np.random.default_rng(1)
    heard = amplitude + (rng.standard_normal((4000, 32)) + 1j * rng.standard_normal((4000, 32))) / math.sqrt(2)
    at = np.linspace(-0.02, 0.02, 41)
    power = np.abs((heard * weights) @ np.exp(-1j * wave_1_m * np.outer(place_m, at))) ** 2
    curve = np.polynomial.polynomial.polyfit(at, power.T, 2)
    found = -curve[1] / (2 * curve[2])
    ratio = amplitude**2 * effective_count(weights)
    least_m2 = float(_effective_covariance_m2(microphones(LINE).enabled_positions_m, weights)[1, 1])
    expected = 1 / (wave_1_m * math.sqrt(least_m2 * 2 * ratio))
    assert found.std() == pytest.approx(expected, rel=0.06)


# ---- settings, files and commands -----------------------------------------------------------------------


def test_array_weights_survive_files_and_the_command_line(tmp_path):
    write_recording(tmp_path / "rec.h5", [noise(SHORT)])
    arguments = ["process", str(tmp_path / "rec.h5"), "-o", str(tmp_path / "image.h5"), "--quiet", "--force"]
    for given_weights in (["--array-weights", "taylor:35"], ["--settings", str(tmp_path / "s.toml")]):
        (tmp_path / "s.toml").write_text('processing.array_weights = "taylor:35"\n')
        done = CliRunner().invoke(cli, [*arguments, *given_weights])
        assert done.exit_code == 0, done.output
        with open_energyscapes(tmp_path / "image.h5") as images:
            assert images.settings.processing.array_weights == "taylor:35"
    listed = weighted(SHORT, np.arange(32))
    assert listed.processing.array_weights == tuple(float(channel) for channel in range(32))
    assert Settings.from_toml(listed.to_toml()) == listed


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ("han", r"processing.array_weights 'han' is unknown \(did you mean 'hann'\?\)"),
        ("hann:3", "processing.array_weights is 'hann:3' although the window hann has no parameter; use 'hann'"),
        ("taylor:x", "processing.array_weights is 'taylor:x'; use a number after the colon, such as 'taylor:30'"),
        ("taylor:nan", "parameter of processing.array_weights taylor is nan; use a finite number"),
        ("taylor:90", "parameter of processing.array_weights taylor is 90; use a number from 20 to 80"),
        ((1.0, -1.0), r"processing.array_weights\[1\] is -1; use a number from 0 to"),
        ((math.nan,) * 32, r"processing.array_weights\[0\] is nan; use a finite number"),
        ((), "processing.array_weights has 0 numbers; use one number for each channel"),
        ((1.0,) * 31, r"processing.array_weights has shape \(31,\); pass shape \(32,\)"),
        ((0.0,) * 32, "processing.array_weights is 0 for all 32 enabled microphones"),
        (3, "processing.array_weights is 3; use text or a list"),
        (np.ones((32, 2)), r"processing.array_weights\[0\] is \[1.0, 1.0\]; use a number"),
    ],
)
def test_unusable_array_weights_are_refused_in_one_line(weights, message):
    with pytest.raises(ArgumentError, match=message) as caught:
        Pipeline(weighted(SHORT, weights))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("beamformer", "weighting"), ADAPTIVE_COMBINATIONS)
@pytest.mark.parametrize("weights", ["hann", (1.0,) * 32])
def test_adaptive_beamformers_support_uniform_weights_only(beamformer, weighting, weights):
    processing = SHORT.processing.replace(beamformer=beamformer, weighting=weighting)
    with pytest.raises(ArgumentError, match="supports only 'uniform'; leave array_weights out"):
        processing.replace(array_weights=weights)


def test_every_window_has_an_error_free_name():
    for name in WINDOWS:
        assert parse_window(name).window == name.partition(":")[0]


@pytest.mark.parametrize(("weights", "name"), [("uniform", "uniform"), ("hann", "hann"), ((1.0,) * 32, "listed")])
def test_picture_of_an_array_names_its_weights(weights, name):
    assert f"{name} weights, plane waves" in _captions.of_array(weighted(SHORT, weights)).settings
