"""Interpolated beams stay within the error that the beam grid predicts, for any flat array."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from ertis_numba import kernels
from ertis_numba.base.errors import ArgumentError
from ertis_numba.chain.beam_grid import Aperture, BeamGrid
from ertis_numba.chain.interpolation_fit import Spectrum
from ertis_numba.chain.planner import Planner
from ertis_numba.geometry import direction_grid, microphones, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.geometry.waveform import matched_noise_spectrum
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Accuracy, Air, Array, Call, Processing, Settings
from tests import reference
from tests.cases import SHORT, noise
from tests.hard_cases.tuned import tuned
from tests.pages import page

SPEED_M_S = sound_speed_m_s(Air())
CALL = Call()
SPECTRUM = Spectrum(*matched_noise_spectrum(Settings(call=CALL), n_waves=40))


def random_plane(n_mics, seed):
    """Random microphones in a tilted plane with an offset from the origin."""
    random = np.random.default_rng(seed)
    axes = np.linalg.qr(random.standard_normal((3, 2)))[0]
    places = random.uniform(-0.03, 0.03, (n_mics, 2)) @ axes.T
    return places - places.mean(axis=0)


ARRAYS_M = {
    "eRTIS": microphones(Array()).enabled_positions_m,
    "line of 16": np.stack([np.zeros(16), 0.004 * (np.arange(16) - 7.5), np.zeros(16)], axis=1),
    "two microphones": np.array([[0.0, -0.01, 0.005], [0.0, 0.01, -0.005]]),
    "random plane": random_plane(24, 1),
    "three in a corner": random_plane(3, 2),
}
GRIDS = {"half circle": "2d:181", "half sphere": "3d:500"}
CHOICES = [(2, 2.0), (2, 4.0), (4, 1.25), (4, 2.0), (6, 1.75), (6, 3.0)]


def apertures(array, grid):
    axes = direction_grid(Processing(directions=GRIDS[grid]))
    return Aperture.of(ARRAYS_M[array], unit_vectors(axes.azimuth_rad, axes.elevation_rad))


def beam_grid_of(aperture, n_taps, density, **more):
    return BeamGrid(
        aperture,
        SPECTRUM,
        n_taps=n_taps,
        density=density,
        high_hz=CALL.high_frequency_hz,
        sound_speed_m_s=SPEED_M_S,
        **more,
    )


def predicted_db_of(aperture, n_taps, density):
    """Predicted error, weighted by the spectrum of the signals."""
    return 10 * np.log10(beam_grid_of(aperture, n_taps, density, estimate=True).errors @ SPECTRUM.power)


def beams_of(aperture, points, spectra):
    """Sums over microphones at every frequency: (point, wave) complex128."""
    delays_s = aperture.delays_s(points, sound_speed_m_s=SPEED_M_S)
    return np.einsum("mw,pmw->pw", spectra, np.exp(2j * math.pi * delays_s[:, :, None] * SPECTRUM.frequency_hz))


@pytest.mark.parametrize(("n_taps", "density"), [(2, 2.5), (4, 1.25), (4, 1.5), (4, 2.5), (6, 2.0)])
def test_documented_sizes_and_errors_of_beam_grids_are_computed(n_taps, density):
    axes = direction_grid(Processing(directions="3000"))
    aperture = Aperture.of(ARRAYS_M["eRTIS"], unit_vectors(axes.azimuth_rad, axes.elevation_rad))
    spacing = aperture.spacing(density, high_hz=CALL.high_frequency_hz, sound_speed_m_s=SPEED_M_S)
    count, error_db = aperture.count_grid_points(spacing, n_taps), predicted_db_of(aperture, n_taps, density)
    row = f"| {n_taps} × {n_taps} taps, density {density:g} | {count} | −{-error_db:.0f} dB |"
    assert row in page("accuracy")


@pytest.mark.parametrize(("n_taps", "density"), CHOICES)
@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("array", ARRAYS_M)
def test_interpolated_beams_stay_within_the_predicted_error(array, grid, n_taps, density):
    """The microphones receive independent noise; the error is the mean over several noises."""
    aperture = apertures(array, grid)
    nodes = beam_grid_of(aperture, n_taps, density)
    random = np.random.default_rng(5)
    wrong = right = 0.0
    for _ in range(4):
        spectra = random.standard_normal((2, len(ARRAYS_M[array]), len(SPECTRUM.power)))
        spectra = (spectra[0] + 1j * spectra[1]) * np.sqrt(SPECTRUM.power)
        kept = beams_of(aperture, nodes.points, spectra * nodes.gain(SPECTRUM.frequency_hz))
        near = kept[nodes.places[:, :, None] + np.arange(2)]  # (direction, pair, 2, wave)
        made = np.einsum("dpk,dpkw->dw", nodes.weights, near)
        wanted = beams_of(aperture, aperture.directions, spectra)[nodes.rows]
        wrong += np.sum(np.abs(made - wanted) ** 2)
        right += np.sum(np.abs(wanted) ** 2)
    predicted_db = predicted_db_of(aperture, n_taps, density)
    optimistic_db = 2 if array == "two microphones" else 1  # 36 weights suit two more than others at 40 directions
    assert predicted_db - 2 < 10 * np.log10(wrong / right) < predicted_db + optimistic_db


@pytest.mark.parametrize("array", ARRAYS_M)
def test_interpolation_residual_equals_its_prediction(array):
    """Waves from all directions and their residuals add up to the mean error."""
    aperture = apertures(array, "half sphere")
    rough = beam_grid_of(aperture, 4, 2.0, estimate=True)
    n_mics, n_directions = min(len(ARRAYS_M[array]), 40), min(len(aperture.directions), 40)
    assert rough.steering.shape == rough.wrong.shape == (n_mics, len(SPECTRUM.power), n_directions)
    assert_allclose(np.mean(np.abs(rough.wrong) ** 2, axis=(0, 2)), rough.errors)
    some = np.linspace(0, len(aperture.directions) - 1, n_directions).astype(int)
    delays_s = aperture.delays_s(aperture.directions[some], sound_speed_m_s=SPEED_M_S)
    wanted = np.exp(2j * math.pi * delays_s.T[:, None] * SPECTRUM.frequency_hz[:, None])
    assert_allclose(rough.steering, wanted, atol=1e-9)


@pytest.mark.parametrize("shift_hz", [0.0, -90e3, 200e3, -720e3])
@pytest.mark.parametrize(("n_taps", "density"), [(2, 2.0), (4, 2.0), (6, 3.0)])
def test_estimate_predicts_the_power_of_shifted_waves(n_taps, density, shift_hz):
    """The reference is the complete beam grid: all directions, and its own gain."""
    aperture = apertures("eRTIS", "half sphere")
    nodes = beam_grid_of(aperture, n_taps, density)
    delays_s = aperture.delays_s(nodes.points, sound_speed_m_s=SPEED_M_S)
    waves = np.exp(2j * math.pi * delays_s[:, :, None] * (SPECTRUM.frequency_hz + shift_hz))
    waves *= nodes.gain(SPECTRUM.frequency_hz)
    made = np.einsum("dpk,dpkmw->dmw", nodes.weights[::7], waves[nodes.places[::7, :, None] + np.arange(2)])
    power = np.mean(np.abs(made) ** 2, axis=(0, 1)) @ SPECTRUM.power
    found = beam_grid_of(aperture, n_taps, density, estimate=True).passed(shift_hz) @ SPECTRUM.power
    assert found == pytest.approx(power, rel=0.15)
    if not shift_hz:
        assert found == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("array", ARRAYS_M)
def test_beam_grid_points_surround_every_direction(array):
    """At the rim of the half sphere, grid points lie outside of the unit circle."""
    aperture = apertures(array, "half sphere")
    spacing = aperture.spacing(2.0, high_hz=CALL.high_frequency_hz, sound_speed_m_s=SPEED_M_S)
    nodes = beam_grid_of(aperture, 4, 2.0)
    assert len(nodes.points) == aperture.count_grid_points(spacing, 4) == len(np.unique(nodes.points.round(9), axis=0))
    assert sorted(nodes.rows) == list(range(len(aperture.directions)))
    assert np.linalg.norm(nodes.points, axis=1).max() > 1
    near = nodes.points[nodes.places[:, :, None] + np.arange(2)]
    away = (near - aperture.directions[nodes.rows][:, None, None]) / spacing
    assert np.abs(away).max() < 2 + 1e-9
    assert (away.min(axis=(1, 2)) <= -1 + 1e-9).all()
    assert (away.max(axis=(1, 2)) >= 1 - 1e-9).all()


@pytest.mark.parametrize("range_m", [0.08, 0.5, math.inf])
@pytest.mark.parametrize("array", ARRAYS_M)
def test_beam_grid_delays_equal_direct_delays(array, range_m):
    aperture = apertures(array, "half sphere")
    axes = direction_grid(Processing(directions=GRIDS["half sphere"]))
    directions = unit_vectors(axes.azimuth_rad, axes.elevation_rad)
    found_s = aperture.delays_s(aperture.directions, sound_speed_m_s=SPEED_M_S, range_m=range_m)
    if math.isinf(range_m):
        wanted_m = -directions @ ARRAYS_M[array].T
    else:
        wanted_m = np.linalg.norm(range_m * directions[:, None] - ARRAYS_M[array], axis=2) - range_m
    assert_allclose(found_s, wanted_m / SPEED_M_S, atol=1e-15)


BALL = random_plane(12, 3) + 0.01 * np.random.default_rng(4).standard_normal((12, 3))
NO_PLANE = {
    "not flat": Array(layout="ball", positions_m=tuple(map(tuple, BALL.tolist())), word_bits=16),
    "one microphone": Array(layout="one", positions_m=((0.0, 0.0, 0.0),), word_bits=8),
}


@pytest.mark.parametrize("array", NO_PLANE)
def test_nonplanar_arrays_use_direct_sums(array):
    settings = tuned(SHORT, max_error_db=-35.0).replace(
        array=NO_PLANE[array], processing=SHORT.processing.replace(directions="3d:800")
    )
    pipeline, measurement = Pipeline(settings), noise(settings)
    assert pipeline.settings.accuracy.beam_taps == 0
    some = np.arange(0, len(pipeline.grid), 100)
    directions = unit_vectors(pipeline.grid.azimuth_rad[some], pipeline.grid.elevation_rad[some])
    wanted = reference.exact(measurement.data, settings, directions, pipeline.range_m)
    assert reference.error_db(pipeline.process(measurement).amplitude[some], wanted) < -35


@pytest.mark.parametrize(
    "plan",
    [
        Accuracy(beam_taps=4),
        Accuracy(
            precision="float32",
            oversampling=2,
            delay_taps=2,
            beam_taps=4,
            beam_density=2.0,
            stopband_attenuation_db=60.0,
            focal_zones=1,
        ),
    ],
)
@pytest.mark.parametrize("array", NO_PLANE)
def test_nonplanar_arrays_refuse_a_beam_grid(array, plan):
    settings = SHORT.replace(array=NO_PLANE[array], accuracy=plan)
    with pytest.raises(ArgumentError, match=r"accuracy\.beam_taps is .*the array (has no extent|is neither).*use 0"):
        Pipeline(settings)


def test_beam_grid_is_used_for_many_directions_only():
    counts = {}
    for directions in ("3d:60", "3d:3000"):
        settings = tuned(SHORT, max_error_db=-35.0)
        settings = settings.replace(processing=SHORT.processing.replace(directions=directions))
        chosen = Planner(settings, kernels.load("cpu"), threads=1).choose()
        counts[directions] = chosen.settings.accuracy.beam_taps
    assert counts["3d:60"] == 0
    assert counts["3d:3000"] > 0


def test_one_enabled_microphone_beside_the_origin_uses_no_beam_grid():
    array = Array(layout="eRTIS_v3D1", disabled=tuple(range(1, 32)))
    settings = Settings(array=array, processing=Processing(directions="2d:181"))
    assert Pipeline(settings, device="numpy").settings.accuracy.beam_taps == 0
