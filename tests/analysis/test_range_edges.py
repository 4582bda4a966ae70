"""Echoes that slide through the edge of the range window: nothing but the echo itself is listed."""

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

import ertis_numba as ertis
from ertis_numba.analysis.detect import left_out_at_edges
from ertis_numba.analysis.points import PointExtractor
from ertis_numba.geometry import Grid
from ertis_numba.settings import Array
from ertis_numba.storage import write_energyscapes
from tests.analysis.test_detect import image_of

RESOLUTION_M = 343.87 / 2 / 25e3
WINDOW_M = (1.0, 1.25)
AZIMUTH_DEG = 12.0


def slid(edge, quarters, layout="eRTIS_v3D1", directions="2d:91"):
    """Image of an echo some quarters of the resolution within an edge, or beyond it, and its range."""
    range_m = WINDOW_M[edge] + (1 if edge == 0 else -1) * quarters / 4 * RESOLUTION_M
    settings = ertis.Settings().replace(array=Array(layout=layout))
    echo = (AZIMUTH_DEG, 0, range_m, 1.0)
    return image_of([echo], directions=directions, range_m=WINDOW_M, settings=settings, noise=1e-3), range_m


def are_the_echo(azimuth_deg, range_m, true_m):
    return (np.abs(np.subtract(azimuth_deg, AZIMUTH_DEG)) < 6) & (np.abs(np.subtract(range_m, true_m)) < RESOLUTION_M)


@pytest.mark.parametrize("edge", [0, 1])
@pytest.mark.parametrize("layout", ["eRTIS_v3D1", "xRTIS_v1"])
def test_only_the_echo_itself_is_listed_at_an_edge(edge, layout):
    for quarters in range(-24, 25, 4):
        image, true_m = slid(edge, quarters, layout)
        peaks = [peak for peak in ertis.find_peaks(image, top=20) if peak.level_dbfs > -44]  # above the noise
        own = are_the_echo([peak.azimuth_deg for peak in peaks], [peak.range_m for peak in peaks], true_m)
        assert own.all(), (quarters, peaks)
        cloud = PointExtractor(image.settings, Grid(image.azimuth_rad, image.elevation_rad))(image)
        places_m = cloud.position_m[cloud.amplitude > 10 ** (-44 / 20)]
        azimuth_deg = np.degrees(np.arctan2(places_m[:, 1], places_m[:, 0]))
        assert are_the_echo(azimuth_deg, np.linalg.norm(places_m, axis=1), true_m).all(), quarters
        if quarters > 5:  # The last range may lie one step before the end of the window.
            assert len(peaks) == 1, quarters
            assert len(places_m) == 1, quarters


def test_echo_one_resolution_within_the_first_range_is_listed():
    image, true_m = slid(0, 4)
    (peak,) = ertis.find_peaks(image, top=1)
    assert are_the_echo(peak.azimuth_deg, peak.range_m, true_m)


@pytest.mark.parametrize("edge", [0, 1])
def test_maxima_left_out_at_an_edge_are_counted(tmp_path, monkeypatch, edge):
    monkeypatch.chdir(tmp_path)
    noted = {}
    for quarters in (-4, 12):
        image, _ = slid(edge, quarters)
        peaks = ertis.find_peaks(image, false_alarm=1e-3)
        count = left_out_at_edges(image, peaks, false_alarm=1e-3)
        assert (count > 0) == (quarters < 0)
        write_energyscapes("img.h5", [image], overwrite=True)
        noted[quarters] = CliRunner().invoke(cli, ["peaks", "img.h5"]).stderr
        assert (f"{count} maxima near the first or last range left out" in noted[quarters]) == (quarters < 0)
    assert "may be side lobes of an echo outside the range; use a wider range with 'ertis process --range'" in noted[-4]
