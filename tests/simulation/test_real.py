"""Compare the image of one real measurement, processed on the command line, with its exact image.

The file is part of the package rtisdev. The tests never import the package itself, because it changes warning
filters and installs other top-level packages.
"""

import functools
import importlib.metadata
import json

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

import ertis_numba as ertis
from ertis_numba.geometry import unit_vectors
from tests import reference

RAW = importlib.metadata.distribution("rtisdev").locate_file("rtisdev/simulate.bin")


def run(*command):
    done = CliRunner().invoke(cli, [*map(str, command)])
    assert done.exit_code == 0, (done.stderr, done.exception)
    return done.stdout


@pytest.fixture(scope="module", params=["eRTIS_v3D1", "eRTIS_v2"])
def processed(request, tmp_path_factory):
    """Process the measurement with one layout; return the layout, the image file and the image."""
    folder = tmp_path_factory.mktemp(request.param)
    recording, image = folder / "recording.h5", folder / "image.h5"
    run("import", "signals", RAW, "-o", recording, "--layout", request.param, "--preset", "default_25_50")
    # One of the ten peaks is barely a maximum, and errors of -35 dB may remove it.
    run(
        "process",
        recording,
        "-o",
        image,
        "--directions",
        "2d:181",
        "--range",
        "0.8:5",
        "--max-error",
        "fine",
        "--wavefront",
        "plane",
    )
    with ertis.open_energyscapes(image) as images:
        return request.param, image, images[0]


@functools.cache
def exact_energy(azimuth_rad, elevation_rad, range_m):
    """Compute the exact image of the correct layout; cached, because both layouts use the same axes."""
    words, settings = np.fromfile(RAW, dtype="<u4"), ertis.Settings.from_preset("default_25_50")
    return reference.exact(words, settings, unit_vectors(np.array(azimuth_rad), np.array(elevation_rad)), range_m)


@pytest.fixture(scope="module")
def exact_image(processed):
    """Exact image of the correct layout, on the axes of the processed image."""
    image = processed[2]
    amplitude = exact_energy(
        *(tuple(axis.tolist()) for axis in (image.azimuth_rad, image.elevation_rad, image.range_m))
    )
    settings = ertis.Settings.from_preset("default_25_50")
    return image.replace(amplitude=amplitude.astype(np.float32), settings=settings)


def count_matches(found, wanted):
    """Count the wanted peaks found within 1.5°, 1 cm and 1 dB."""
    return sum(
        any(
            abs(peak["azimuth_deg"] - other.azimuth_deg) < 1.5
            and abs(peak["range_m"] - other.range_m) < 0.01
            and abs(peak["level_dbfs"] - other.level_dbfs) < 1
            for peak in found
        )
        for other in wanted
    )


def test_ten_strongest_reflectors_match_the_exact_image(processed, exact_image):
    layout, path, _ = processed
    found = json.loads(run("peaks", path, "--top", 10, "--json"))["peaks"]
    wanted = ertis.find_peaks(exact_image, top=10, false_alarm=1e-3)
    assert len(found) == len(wanted) == 10
    assert [peak["level_db"] for peak in found] == sorted((peak["level_db"] for peak in found), reverse=True)
    if layout == "eRTIS_v3D1":
        assert count_matches(found, wanted) == 10
    else:
        assert count_matches(found, wanted) <= 1


def test_image_of_the_real_measurement_is_exact(processed, exact_image):
    layout, _, image = processed
    error_db = reference.error_db(image.amplitude, exact_image.amplitude.astype(float))
    brightest_db = 20 * np.log10(image.amplitude.max() / exact_image.amplitude.max())
    if layout == "eRTIS_v3D1":
        assert error_db < -60
        assert abs(brightest_db) < 0.1
    else:  # A wrong channel order smears the image.
        assert error_db > -3
        assert brightest_db < -10
