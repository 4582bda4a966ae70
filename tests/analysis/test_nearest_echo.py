"""The nearest echo of each direction is a maximum above both limits and above possible side lobes."""

import numpy as np
import pytest

from ertis_numba.analysis.nearest_echo import nearest_echo
from ertis_numba.base.errors import ArgumentError
from tests.files import image

RANGES_M = np.linspace(0.5, 4.5, 401)


def with_echoes(*echoes):
    """Image of 5 directions; each echo is (direction, range in m, amplitude)."""
    given = image(np.array([-60.0, -30.0, 0.0, 30.0, 60.0]), range_m=RANGES_M)
    amplitude = np.zeros_like(given.amplitude)
    for direction, range_m, level in echoes:
        middle = int(np.argmin(np.abs(RANGES_M - range_m)))
        amplitude[direction, middle - 1 : middle + 2] = np.array([0.5, 1.0, 0.5]) * level
    return given.replace(amplitude=amplitude.astype(np.float32))


def test_nearest_of_several_echoes_counts():
    range_m, level_dbfs = nearest_echo(with_echoes((1, 1.5, 0.1), (1, 3.0, 0.1), (3, 2.0, 0.05)))
    assert np.allclose(range_m, [np.inf, 1.5, np.inf, 2.0, np.inf])
    assert np.allclose(level_dbfs[[1, 3]], [-20.0, 20 * np.log10(0.05)], atol=1e-4)
    assert np.all(np.isneginf(level_dbfs[[0, 2, 4]]))


def test_weak_echoes_and_side_lobes_do_not_count():
    weak, side_lobe = (0, 1.0, 0.009), (2, 3.0, 0.02)  # 20.9 dB below the strongest; 14 dB below it at its range
    range_m, _ = nearest_echo(with_echoes((1, 3.0, 0.1), weak, side_lobe))
    assert np.allclose(range_m, [np.inf, 3.0, np.inf, np.inf, np.inf])
    range_m, _ = nearest_echo(with_echoes((1, 3.0, 0.1), weak, side_lobe), min_level_db=-21.0)
    assert np.allclose(range_m, [1.0, 3.0, np.inf, np.inf, np.inf])


def test_floor_leaves_an_image_without_strong_echoes_empty():
    given = with_echoes((1, 3.0, 1e-4))
    assert np.isfinite(nearest_echo(given)[0]).sum() == 1
    assert not np.isfinite(nearest_echo(given, floor_dbfs=-79.0)[0]).any()


def test_silent_image_has_no_echo():
    assert not np.isfinite(nearest_echo(with_echoes())[0]).any()


def test_rise_towards_the_end_of_the_image_is_no_echo():
    given = with_echoes()
    given.amplitude[:] = np.linspace(0.1, 0.2, len(RANGES_M), dtype=np.float32)
    assert not np.isfinite(nearest_echo(given)[0]).any()


@pytest.mark.parametrize(
    ("n_ranges", "options", "message"),
    [
        (401, {"min_level_db": 1.0}, "min_level_db is 1; use"),
        (2, {}, "the image has 2 ranges; use an image with at least 3"),
    ],
)
def test_invalid_arguments_are_refused(n_ranges, options, message):
    given = image(np.array([-10.0, 10.0]), range_m=RANGES_M[:n_ranges])
    with pytest.raises(ArgumentError, match=message):
        nearest_echo(given, **options)
