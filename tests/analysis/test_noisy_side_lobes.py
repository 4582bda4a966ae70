"""Side lobes of one echo are no reflectors, although noise raises some of them above all that noise alone yields."""

import numpy as np
import pytest

from ertis_numba.analysis.detect import find_peaks
from tests.echo_draws import AMPLITUDE, Case, Draws, unit

DRAWS = 16


def images(directions, snrs_db):
    """Extractor, and images of one echo each with its direction."""
    wide = Case(directions, 0.0, limits_deg=(-90, 90, -60, 60), window_m=(0.3, 1.3), range_m=(0.6, 1.0))
    draws, rng = Draws(wide), np.random.default_rng(21)
    found = []
    for snr_db in np.repeat(snrs_db, DRAWS):
        azimuth_deg, elevation_deg, range_m = draws.place(rng)
        direction = unit(azimuth_deg, elevation_deg)
        heard = draws.signals(direction, range_m)
        noise = AMPLITUDE / draws.noise * 10 ** (-snr_db / 20)
        found.append((draws.image(heard + noise * rng.standard_normal(heard.shape)), direction))
    return draws.extract, found


@pytest.mark.parametrize(("directions", "snrs_db"), [("2d:181", (37, 40)), ("3d:600", (37, 40))])
def test_an_echo_is_one_peak(directions, snrs_db):
    _, found = images(directions, snrs_db)
    assert [len(find_peaks(image, false_alarm=1e-3)) for image, _ in found] == [1] * len(found)


def test_an_echo_has_points_in_its_direction_only():
    extract, found = images("3d:600", (25, 27))
    for image, direction in found:
        cloud = extract(image)
        assert len(cloud) > 0
        assert (cloud.position_m @ direction > np.cos(np.radians(15)) * cloud.range_m).all()
