"""Stated standard deviations of two echoes at one range, which interfere."""

import math

import numpy as np
import pytest

from ertis_numba.analysis.detect import find_peaks
from tests.echo_draws import AMPLITUDE, Case, Draws, unit

CASES = [Case("2d:181", 40, range_m=(0.72, 0.98)), Case("3d:600", 30, range_m=(0.72, 0.98))]
N_DRAWS = 15


def standardised(draws, rng, apart_deg):
    """Errors of direction, range and level of each peak from the nearer echo, in stated standard deviations."""
    azimuth_deg, elevation_deg, range_m = draws.place(rng)
    azimuth_deg *= 0.6
    second, behind_m = 10 ** (-rng.uniform(0, 10) / 20), rng.uniform(0, 0.004)
    aside_deg = azimuth_deg + apart_deg / math.cos(math.radians(elevation_deg))
    directions = np.stack([unit(azimuth_deg, elevation_deg), unit(aside_deg, elevation_deg)])
    heard = draws.signals(directions[0], range_m) + second * draws.signals(directions[1], range_m + behind_m)
    noise = AMPLITUDE / draws.noise * 10 ** (-draws.case.snr_db / 20)
    image = draws.image(heard + noise * rng.standard_normal(heard.shape))
    for peak in find_peaks(image, top=2, false_alarm=1e-3):
        errors_deg = np.degrees(np.arccos(np.minimum(1, directions @ unit(peak.azimuth_deg, peak.elevation_deg))))
        nearer = int(np.argmin(errors_deg))
        yield (
            errors_deg[nearer] / peak.angle_sd_deg,
            abs(peak.range_m - range_m - nearer * behind_m) / peak.range_sd_m,
            abs(peak.level_dbfs - 20 * math.log10(AMPLITUDE * (second if nearer else 1))) / peak.level_sd_db,
        )


@pytest.fixture(scope="module")
def every_draws():
    return [Draws(case) for case in CASES]


@pytest.mark.parametrize(("apart_deg", "beyond"), [((6, 8, 10), 0.25), ((14, 18, 25), 0.06)])
def test_errors_of_echoes_at_one_range_are_about_those_that_are_stated(every_draws, apart_deg, beyond):
    """Within main lobes of 9°, echoes merge or push each other aside; without interference, 5 % exceed two."""
    rng = np.random.default_rng([77, apart_deg[0]])
    found = [
        each
        for draws in every_draws
        for angle_deg in apart_deg
        for _ in range(N_DRAWS)
        for each in standardised(draws, rng, angle_deg)
    ]

    assert (np.mean(np.array(found) > 2, axis=0) <= beyond).all()
