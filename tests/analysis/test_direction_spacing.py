"""Warning of directions that are too far apart for the main lobe of the array."""

from contextlib import ExitStack

import click
import numpy as np
import pytest
from ertis_cli._pulses import PipelinesBySensor

import ertis_numba as ertis
from ertis_numba.analysis.direction_spacing import spacing_warning
from ertis_numba.frames import Energyscape, Stamp
from ertis_numba.geometry import direction_grid, spacing_rad, unit_vectors
from ertis_numba.settings import Array, Processing, Settings


def blank(directions, sensor="sensor"):
    processing = Processing(directions=directions)
    grid = direction_grid(processing)
    return Energyscape(
        np.zeros((len(grid), 2), np.float32),
        grid.azimuth_rad,
        grid.elevation_rad,
        np.array([1.0, 1.01]),
        ertis.Settings(processing=processing),
        Stamp(sensor=sensor, sequence=0, sync_count=0, timestamp_ns=0),
    )


def warning_of(directions, **changes):
    image = blank(directions)
    return spacing_warning(image.settings.replace(**changes), image)


@pytest.mark.parametrize("directions", ["2d:30", "90", "1850", "3d:1000", ((0.0, 0.0),)])
def test_fine_grids_cause_no_warning(directions):
    assert warning_of(directions) is None


def test_one_microphone_hears_no_direction_that_a_grid_could_miss():
    one = ertis.Settings().replace(**{"array.disabled": tuple(range(1, 32))}).array
    assert warning_of("2d:181", array=one) is None
    assert warning_of("2d:20", array=one) is None


@pytest.mark.parametrize(("directions", "spacing"), [("2d:20", "9.5"), ("3d:400", "7.1")])
def test_coarse_grids_cause_a_warning_with_a_grid_that_is_fine(directions, spacing):
    text = warning_of(directions)
    assert text.startswith(f"directions are {spacing}° apart")
    finer = text.removesuffix(" directions").split()[-1]
    assert warning_of(finer) is None


@pytest.mark.parametrize(
    "changes",
    [
        {"processing.weighting": "coherence_factor"},
        {"processing.beamformer": "dmas", "processing.dmas_order": 4},
        {"processing.beamformer": "capon"},
    ],
)
def test_narrower_beamformers_need_finer_grids(changes):
    assert warning_of("2d:30") is None
    text = warning_of("2d:30", **changes)
    assert f"in images with {next(iter(changes.values()))}; process with at least 2d:" in text
    assert warning_of(text.removesuffix(" directions").split()[-1], **changes) is None


def test_no_grid_is_named_if_none_suffices():
    narrow = {"processing.beamformer": "capon", "processing.diagonal_loading": 1e-6}
    assert "no grid of up to 200000 directions suffices" in warning_of("3d:400", **narrow)


def test_commands_warn_once_of_the_first_sensor_with_a_coarse_grid(capsys):
    grids = (("front", "2d:30"), ("left", "2d:20"), ("left", "2d:20"), ("right", "3d:400"))
    with ExitStack() as stack, click.Context(click.Command("map")):
        pipelines = PipelinesBySensor(lambda settings: settings, stack, quiet=True)
        for sensor, directions in grids:
            assert pipelines.image(blank(directions, sensor)).stamp.sensor == sensor
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("ertis: warning: directions are 9.5° apart")
    assert pipelines.warnings == [line.removeprefix("ertis: warning: ")]


@pytest.mark.parametrize(
    ("azimuths_deg", "spacing_deg"), [((0, 0, 2, 2, 4, 4), 2), ((-180, 0, 180), 180), ((5, 5), 180)]
)
def test_spacing_counts_equal_directions_once(azimuths_deg, spacing_deg):
    azimuth_rad = np.radians(np.array(azimuths_deg, dtype=np.float64))
    spacing = spacing_rad(unit_vectors(azimuth_rad, np.zeros(len(azimuth_rad))))
    assert np.degrees(spacing) == pytest.approx(spacing_deg)


@pytest.mark.parametrize("axis", [1, 2])
def test_directions_of_a_line_are_apart_along_it(axis):
    """Around the line, they sound alike, so that their distance there does not count."""
    places_m = np.zeros((16, 3))
    places_m[:, axis] = np.linspace(-0.15, 0.15, 16)
    settings = Settings.from_preset("default_25_50")
    settings = settings.replace(
        array=Array(positions_m=places_m.tolist()), processing=settings.processing.replace(directions="3d:400")
    )
    text = spacing_warning(settings, direction_grid(settings.processing))
    assert text.startswith("directions are 7.1° apart")
