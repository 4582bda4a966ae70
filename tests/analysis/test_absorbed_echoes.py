"""Stated standard deviations of lone echoes from afar, whose high frequencies air has absorbed."""

import numpy as np
import pytest

from ertis_numba.analysis.detect import find_peaks
from tests.analysis.test_point_coverage import standardised
from tests.echo_draws import Case, Draws

AFAR = {"range_m": (0.8, 4.4), "window_m": (0.5, 4.7), "n_samples": 13_500}
CASES = {"line": Case("2d:91", 40, **AFAR), "space": Case("3d:600", 40, **AFAR)}
DRAWS = 30


@pytest.mark.parametrize("name", CASES)
def test_errors_of_a_lone_echo_are_those_of_noise(name):
    """Absorption is no sign of a second echo, which would widen standard deviations to 2 dB and some degrees."""
    draws, rng = Draws(CASES[name]), np.random.default_rng(31)
    rms = np.sqrt(np.mean([np.square(standardised(draws, rng)) for _ in range(DRAWS)], axis=0))
    assert ((rms > 0.8) & (rms < 1.3)).all()
    image, _ = draws.drawn(rng)
    assert find_peaks(image, top=1, false_alarm=1e-3)[0].level_sd_db < 0.1
