"""Test of the table of array weights in docs/explanation/beamformers.md."""

import math
import re

import numpy as np
import pytest
from scipy.ndimage import maximum_filter

from ertis_numba.analysis.point_spread import PointSpread
from ertis_numba.figures._array import width_deg
from ertis_numba.geometry import array_weights, effective_count
from ertis_numba.settings import Array, Settings
from tests.pages import page

ARRAYS = {
    "line": Array(layout="line", positions_m=tuple((0.0, 0.004 * m, 0.0) for m in range(16))),
    "eRTIS_v3D1": Array(layout="eRTIS_v3D1"),
}
RANGES_M = np.linspace(0.0, 0.02, 6)


def levels_db(spread, y, z):
    """Highest level over the range offsets of the compressed pulse; the levels are symmetric in Δr and Δu."""
    forward = np.sqrt(np.maximum(1 - y**2 - z**2, 0.0)) - 1
    away = np.stack([forward, y, z], axis=-1).reshape(-1, 3)
    away = np.concatenate([away, -away])
    highest = np.max([spread(away, np.full(len(away), range_m)) for range_m in RANGES_M], axis=0)
    return 20 * np.log10(np.maximum(highest.reshape(2, *y.shape).max(axis=0), 1e-9))


def figures_of(array, weights):
    """Half-power width in degrees, highest side lobe in dB and rise of the noise in dB."""
    settings = Settings(array=array)
    settings = settings.replace(processing=settings.processing.replace(array_weights=weights))
    spread, found = PointSpread(settings), array_weights(settings)
    angle_deg = np.linspace(-30, 30, 601)
    across = np.sin(np.radians(angle_deg))
    width = width_deg(angle_deg, levels_db(spread, across, np.zeros_like(across)), 0.0)
    side = np.linspace(-1, 1, 81)
    y, z = np.meshgrid(side, side if array.positions_m is None else np.zeros(1))
    level_db = np.where(y**2 + z**2 <= 1, levels_db(spread, y, z), -np.inf)
    tops = np.sort(level_db[(level_db == maximum_filter(level_db, 3)) & (level_db < -3) & np.isfinite(level_db)])
    return width, float(tops[-1]), 10 * math.log10(len(found) / effective_count(found))


@pytest.mark.parametrize("array", ARRAYS)
@pytest.mark.parametrize("weights", ["uniform", "cosine", "hamming", "hann", "taylor:35"])
def test_table_of_array_weights_is_computed(array, weights):
    row = re.search(rf"^\| `{weights}` \|(.*)\|$", page("beamformers"), re.MULTILINE)[1]
    cells = [float(cell.strip(" °dB").replace("−", "-")) for cell in row.split("|")]
    width, side_lobe_db, noise_db = figures_of(ARRAYS[array], weights)
    first = 0 if array == "line" else 3
    assert cells[first] == pytest.approx(width, abs=0.06)
    assert cells[first + 1] == pytest.approx(side_lobe_db, abs=0.6)
    assert cells[first + 2] == pytest.approx(noise_db, abs=0.06)
