"""Reflectors in images of arrays with grating lobes, whose echoes are independent delayed sweeps in noise."""

import math

import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba.analysis.detect import find_peaks
from ertis_numba.frames import Measurement
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.settings import Array, Call, Processing, Recording, Settings
from tests.echo_draws import sweep, unit

RATE_HZ, N_SAMPLES = 450_000.0, 8_192


def line(n_mics, length_m):
    return tuple((0.0, float(y_m), 0.0) for y_m in np.linspace(-length_m / 2, length_m / 2, n_mics))


def images(positions_m, rng, n_images, *, are_pairs=False, **call):
    """Images of one echo each, or of two echoes closer than a pulse, with the direction and range of the first."""
    settings = Settings(
        array=Array(positions_m=positions_m),
        call=Call(**call),
        recording=Recording(sample_rate_hz=RATE_HZ, n_samples=N_SAMPLES, encoding="float32"),
        processing=Processing(directions="2d:361", range_m=(0.5, 2.5), range_decimation=10, wavefront="spherical"),
    )
    pipeline = ertis.Pipeline(settings, threads=1, predict=False)
    speed_m_s, microphones_m = sound_speed_m_s(settings.air), np.array(positions_m)
    form = {
        "first_hz": settings.call.start_frequency_hz,
        "last_hz": settings.call.stop_frequency_hz,
        "ramp": max(settings.call.ramp_fraction, 1e-9),
    }
    for _ in range(n_images):
        azimuth_deg, range_m = rng.uniform(-55, 55), rng.uniform(0.9, 2.0)
        places = [(azimuth_deg, range_m, 1.0)]
        if are_pairs:
            places.append((azimuth_deg + rng.uniform(-2, 2), range_m + rng.uniform(0.004, 0.01), rng.uniform(0.5, 1)))
        heard = np.zeros((len(microphones_m), N_SAMPLES))
        for echo_deg, echo_m, amplitude in places:
            path_m = echo_m + np.linalg.norm(echo_m * unit(echo_deg, 0) - microphones_m, axis=1)
            heard += amplitude * sweep(np.arange(N_SAMPLES) / RATE_HZ - path_m[:, None] / speed_m_s, **form)
        heard += 0.02 * rng.standard_normal(heard.shape)
        words = (0.01 * heard.T).astype(np.float32)
        yield pipeline.process(Measurement(words, pipeline.settings)), azimuth_deg, range_m


@pytest.mark.parametrize(("n_mics", "length_m"), [(32, 0.6), (16, 1.0), (16, 0.3)])
def test_side_and_grating_lobes_of_sparse_lines_are_no_reflectors(n_mics, length_m):
    rng = np.random.default_rng([21, n_mics])
    for image, azimuth_deg, range_m in images(line(n_mics, length_m), rng, 6):
        peaks = find_peaks(image, top=None, false_alarm=1e-3)
        assert len(peaks) == 1
        assert peaks[0].azimuth_deg == pytest.approx(azimuth_deg, abs=0.5)
        assert peaks[0].range_m == pytest.approx(range_m, abs=2e-3)


@pytest.mark.parametrize(
    "call", [{"ramp_fraction": 0.0}, {"start_frequency_hz": 42_000.0, "stop_frequency_hz": 38_000.0}], ids=str
)
def test_side_lobes_of_the_call_are_no_reflectors(call):
    """Of a microphone alone, and of a line; pulses of narrow or abrupt sweeps are long."""
    rng = np.random.default_rng(22)
    for positions_m in (((0.0, 0.0, 0.0),), line(8, 0.03)):
        for image, _, range_m in images(positions_m, rng, 4, **call):
            peaks = find_peaks(image, top=None, false_alarm=1e-3)
            assert [round(peak.range_m - range_m, 2) for peak in peaks] == [0.0]
            assert not math.isnan(peaks[0].level_db)


@pytest.mark.parametrize("positions_m", [line(8, 0.028), line(16, 0.056)])
def test_side_lobes_of_two_echoes_closer_than_a_pulse_are_no_reflectors(positions_m):
    for image, azimuth_deg, _ in images(positions_m, np.random.default_rng(22), 20, are_pairs=True):
        peaks = find_peaks(image, top=None, false_alarm=1e-3)
        assert peaks
        assert [peak.azimuth_deg for peak in peaks] == pytest.approx([azimuth_deg] * len(peaks), abs=10)
