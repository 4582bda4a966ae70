"""Predicted errors of windows whose image is mostly the error of the plan."""

import dataclasses

import pytest

import ertis_numba as ertis
from ertis_numba.pipeline import verification
from ertis_numba.pipeline.prediction import relative_to_exact_db
from tests.simulation.test_data import FOLDER

pytestmark = pytest.mark.usefixtures("sound_unchecked")


@pytest.mark.parametrize(
    ("window_m", "directions"), [((0.5, 0.9), "2d:91"), ((0.5, 1.0), "2d:91"), ((0.5, 1.0), "3d:200")]
)
def test_bound_holds_where_the_plan_exceeds_the_noise(window_m, directions):
    """The truth is an exact image; before the first echo, the plan's error exceeds what there is."""
    with ertis.open_recording(FOLDER / "reflectors.h5") as recording:
        first = recording[0]
    processing = first.settings.processing.replace(range_m=window_m, directions=directions)
    settings = first.settings.replace(processing=processing)
    measurement = dataclasses.replace(first, settings=settings)
    pipeline = ertis.Pipeline(settings)
    with pytest.warns(ertis.ErrorBudgetWarning, match=r"may exceed the error budget|most of the image is the error"):
        image = pipeline.process(measurement)
    prediction = pipeline.prediction
    error_db = verification.measure(image, measurement).error_db
    if prediction.predicted_error_db + prediction.uncertainty_db < 0:
        assert error_db <= prediction.predicted_error_db + prediction.uncertainty_db
    else:
        assert error_db > -3.0


def test_small_shares_hardly_change():
    assert relative_to_exact_db(-20.0) == pytest.approx(-19.956, abs=1e-3)
    assert relative_to_exact_db(-3.0) == pytest.approx(0.02, abs=0.03)
