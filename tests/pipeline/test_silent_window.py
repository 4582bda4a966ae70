"""A range window without echoes is reported as such, not as an error of the image."""

import dataclasses
from pathlib import Path

import pytest

import ertis_numba as ertis
from ertis_numba import kernels
from ertis_numba.pipeline.prediction import planner_of, predict

REFLECTORS = Path(__file__).parents[2] / "data" / "synthetic" / "reflectors.h5"


def prediction(range_m):
    """Return the prediction for ranges in metres, with a budget that the plan exceeds."""
    with ertis.open_recording(REFLECTORS) as recording:
        measurement = recording[0]
    settings = measurement.settings
    settings = settings.replace(processing=settings.processing.replace(range_m=range_m, directions="2d:61"))
    measurement = dataclasses.replace(measurement, settings=settings)
    pipeline = ertis.Pipeline(settings, device="cpu", predict=False)
    image = pipeline.process(dataclasses.replace(measurement, settings=pipeline.settings))
    image = image.replace(settings=image.settings.replace("accuracy.max_error_db", -120.0))
    return predict(planner_of(image, measurement, kernels.load("cpu"), threads=1), image)


@pytest.mark.parametrize(("range_m", "has_echoes"), [((0.8, 4.5), True), ((5.2, 5.6), False)])
def test_only_images_of_echoes_exceed_the_budget(range_m, has_echoes):
    found = prediction(range_m)
    assert found.predicted_error_db > found.max_error_db
    assert found.has_echoes == has_echoes
    stated = "images may exceed the error budget" if has_echoes else "no echo was heard above the noise"
    assert found.warning.startswith(stated)
