"""Amplitudes of fused points of isolated reflectors, rendered by sums of delayed calls."""

import math

import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba.geometry.air import absorption_db_m
from ertis_numba.geometry.waveform import call_at
from tests.small_platforms import HEIGHT_M, LEVEL, RATE_HZ, images_of, mounted, rendered, settings_of

PLACES = (0.8, 20.0), (1.2, 119.7), (1.5, 62.0), (1.9, -1.2), (2.7, 74.5), (3.3, 110.0), (3.6, 16.7)


def level_at_1_m_db(settings):
    """Level of the echo of a reflector of strength 1 at 1 m, after the matched filter: the mean over its spectrum."""
    energy = np.abs(np.fft.rfft(call_at(settings.call, np.arange(8192) / RATE_HZ))) ** 2
    inside = np.flatnonzero(energy > 1e-3 * energy.max())
    hz = np.fft.rfftfreq(8192, 1 / RATE_HZ)[inside]
    return 20 * math.log10(
        LEVEL * np.average(10 ** (-2 * absorption_db_m(settings.air, hz) / 20), weights=energy[inside])
    )


@pytest.mark.parametrize("diameter_m", [0.0, 0.012])
@pytest.mark.parametrize("count", [2, 3, 4])
def test_amplitude_of_an_isolated_point_is_that_at_1_m_on_the_axis(count, diameter_m):
    settings, random = settings_of(diameter_m=diameter_m), np.random.default_rng(count)
    fuser = ertis.Fuser(mounted(count))
    for range_m, azimuth_deg in PLACES:
        turn = math.radians(azimuth_deg)
        place_m = (range_m * math.cos(turn), range_m * math.sin(turn), HEIGHT_M)
        signals = rendered(mounted(count), settings, place_m, 0.0, diameter_m=diameter_m, random=random, noise=2e-5)
        points = fuser(images_of(signals, settings).values()).points
        assert len(points) == 1
        level_db = 20 * math.log10(points.amplitude[0])
        assert level_db == pytest.approx(level_at_1_m_db(settings), abs=1.0), (range_m, azimuth_deg)
