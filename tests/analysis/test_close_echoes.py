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


@pytest.mark.parametrize("apart_deg", [(0, 3), (3, 60)])
def test_errors_of_echoes_behind_one_another_are_within_those_that_are_stated(every_draws, apart_deg):
    """Pulses of echoes 5 to 100 mm behind one another overlap, and the weaker one may be no maximum."""
    rng, found, stated_db = np.random.default_rng([78, *apart_deg]), [], []
    for draws in every_draws:
        for _ in range(2 * N_DRAWS):
            azimuth_deg, elevation_deg, range_m = draws.place(rng)
            aside_deg = azimuth_deg - math.copysign(rng.uniform(*apart_deg), azimuth_deg)
            directions = np.stack([unit(azimuth_deg, elevation_deg), unit(aside_deg, elevation_deg)])
            ranges_m = range_m + np.array([0.0, 0.005 * 20 ** rng.uniform()])
            level = rng.permutation([1.0, 10 ** (rng.uniform(-30, 0) / 20)])
            heard = sum(level[k] * draws.signals(directions[k], ranges_m[k]) for k in (0, 1))
            noise = AMPLITUDE / draws.noise * 10 ** (-rng.uniform(35, 50) / 20)
            for peak in find_peaks(draws.image(heard + noise * rng.standard_normal(heard.shape)), false_alarm=1e-3):
                angles = np.arccos(np.minimum(1, directions @ unit(peak.azimuth_deg, peak.elevation_deg)))
                nearer = int(np.argmin(np.hypot(angles / 0.1, (peak.range_m - ranges_m) / 0.006)))
                if abs(peak.range_m - ranges_m[nearer]) < 0.02 and angles[nearer] < 0.3:
                    stated_db.append(peak.level_sd_db)
                    found.append(
                        [
                            abs(peak.range_m - ranges_m[nearer]) / peak.range_sd_m,
                            math.degrees(angles[nearer]) / peak.angle_sd_deg,
                            abs(peak.level_dbfs - 20 * math.log10(AMPLITUDE * level[nearer])) / peak.level_sd_db,
                        ]
                    )
    assert len(found) > 70
    assert np.mean(np.array(found) > 4) <= 0.005
    assert np.median(stated_db) < 0.5
