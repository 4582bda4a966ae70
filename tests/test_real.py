"""One real measurement, through the command line, against the exact image.

The file comes with the package rtisdev, whose code is never imported: its wheel changes warning filters and
brings top-level packages of its own.
"""

import functools
import importlib.metadata
import json
import subprocess
import sys

import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba.geometry import unit_vectors
from tests import reference

RAW = importlib.metadata.distribution("rtisdev").locate_file("rtisdev/simulate.bin")


def run(*command):
    done = subprocess.run(
        [sys.executable, "-m", "ertis_cli", *map(str, command)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module", params=["eRTIS_v3D1", "eRTIS_v2"])
def processed(request, tmp_path_factory):
    """The layout, the file of its image and the image."""
    folder = tmp_path_factory.mktemp(request.param)
    recording, image = folder / "recording.h5", folder / "image.h5"
    run("import", RAW, "-o", recording, "--layout", request.param, "--preset", "default_25_50")
    # One of the ten is a maximum by a hair, which errors of -35 dB may level.
    run("process", recording, "-o", image, "--directions", "2d:181", "--range", "0.8:5", "--max-error", "fine")
    with ertis.open_energyscapes(image) as images:
        return request.param, image, images[0]


@functools.cache
def exact_energy(azimuth_rad, elevation_rad, range_m):
    """The image of the right layout on some axes, which both layouts have in common."""
    words, settings = np.fromfile(RAW, dtype="<u4"), ertis.Settings.from_preset("default_25_50")
    return reference.exact(words, settings, unit_vectors(np.array(azimuth_rad), np.array(elevation_rad)), range_m)


@pytest.fixture(scope="module")
def exact_image(processed):
    """The exact image of the right layout, on the axes of the processed one."""
    image = processed[2]
    amplitude = exact_energy(
        *(tuple(axis.tolist()) for axis in (image.azimuth_rad, image.elevation_rad, image.range_m))
    )
    settings = ertis.Settings.from_preset("default_25_50")
    return image.replace(amplitude=amplitude.astype(np.float32), settings=settings)


def agreeing(found, wanted):
    """How many of the wanted peaks are found within 1.5°, 1 cm and 1 dB."""
    return sum(
        any(
            abs(peak["azimuth_deg"] - other.azimuth_deg) < 1.5
            and abs(peak["range_m"] - other.range_m) < 0.01
            and abs(peak["level_db"] - other.level_db) < 1
            for peak in found
        )
        for other in wanted
    )


def test_ten_strongest_reflectors_match_the_exact_image(processed, exact_image):
    layout, path, _ = processed
    found = json.loads(run("peaks", path, "--top", 10, "--json"))["peaks"]
    wanted = ertis.find_peaks(exact_image, top=10)
    assert len(found) == len(wanted) == 10
    assert [peak["level_db"] for peak in found] == sorted((peak["level_db"] for peak in found), reverse=True)
    if layout == "eRTIS_v3D1":
        assert agreeing(found, wanted) == 10
    else:
        assert agreeing(found, wanted) <= 1


def test_image_of_the_real_measurement_is_exact(processed, exact_image):
    layout, _, image = processed
    error_db = reference.error_db(image.amplitude, exact_image.amplitude.astype(float))
    brightest_db = 20 * np.log10(image.amplitude.max() / exact_image.amplitude.max())
    if layout == "eRTIS_v3D1":
        assert error_db < -60
        assert abs(brightest_db) < 0.1
    else:  # the same positions in another channel order smear everything
        assert error_db > -3
        assert brightest_db < -10
