"""Wavefronts: their error is predicted and reported, and ``auto`` chooses by the nearest range."""

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba import kernels
from ertis_numba.base.errors import ArgumentError
from ertis_numba.chain.planner import Planner, complete
from ertis_numba.chain.wavefronts import plane_wave_error_db
from ertis_numba.pipeline import Pipeline, verification
from ertis_numba.settings import Accuracy, Settings
from ertis_numba.storage import open_energyscapes, write_recording
from tests.analysis.test_call_match import CALL, SETTINGS, heard

CPU = kernels.load("cpu")


def with_processing(**changes):
    return SETTINGS.replace(processing=SETTINGS.processing.replace(**changes))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"range_m": (0.3, 1.2)}, "spherical"),
        ({"range_m": (0.3, 1.2), "beamformer": "dmas"}, "spherical"),
        ({"range_m": (0.3, 1.2), "weighting": "coherence_factor"}, "spherical"),
        ({"range_m": (0.3, 1.2), "beamformer": "capon"}, "plane"),
        ({"range_m": (2.5, 2.6)}, "plane"),
    ],
)
def test_auto_chooses_wavefronts_by_the_first_range(changes, expected):
    settings = with_processing(wavefront="auto", **changes).replace(accuracy=Accuracy(max_error_db=-25.0))
    assert complete(settings, CPU, threads=1).processing.wavefront == expected


def test_auto_chooses_plane_wavefronts_if_the_settings_exclude_streams():
    settings = with_processing(wavefront="auto", range_m=(0.3, 1.2), beamformer="dmas")
    settings = settings.replace(accuracy=Accuracy(max_error_db=-25.0, precision="float32"))
    with pytest.raises(ArgumentError, match="needs 16-bit streams"):
        complete(settings.replace("processing.wavefront", "spherical"), CPU, threads=1)
    assert complete(settings, CPU, threads=1).processing.wavefront == "plane"


def test_default_chooses_spherical_wavefronts_near_the_array():
    """At 0.5 m, plane wavefronts have an error of -23 dB, for a budget of -35 dB."""
    near, far = (Settings().replace("processing.range_m", range_m) for range_m in ((0.5, 5.0), (4.0, 5.0)))
    assert Settings().processing.wavefront == "auto"
    assert complete(near, CPU, threads=1).processing.wavefront == "spherical"
    assert complete(far, CPU, threads=1).processing.wavefront == "plane"
    pinned = far.replace("processing.wavefront", "plane")
    assert complete(far, CPU, threads=1) == complete(pinned, CPU, threads=1)  # and so the same bits


@pytest.mark.parametrize(
    "changes", [{"method": "paper"}, {"beamformer": "capon"}, {"delay_matrix": tuple(map(tuple, np.zeros((181, 32))))}]
)
def test_default_is_plane_where_spherical_wavefronts_are_not_supported(changes):
    settings = Settings().replace(processing=Settings().processing.replace(directions="2d:181", **changes))
    assert complete(settings, CPU, threads=1).processing.wavefront == "plane"


def test_predicted_wavefront_error_matches_exact_images():
    """The prediction is an upper bound within 10 dB, because it does not know the directions of echoes."""
    near = with_processing(range_m=(0.9, 1.2), directions="2d:31")
    measurement = heard(CALL, noise=0.3)
    images = []
    for wavefront in ("plane", "spherical"):
        settings = near.replace(processing=near.processing.replace(wavefront=wavefront))
        with Pipeline(settings, "cpu", 1, predict=False) as pipeline:
            image = pipeline.process(measurement)
        images.append(verification.exact_image(image, measurement).amplitude)
    true_db = verification.error_db(*images)
    predicted_db = plane_wave_error_db(Planner(near, CPU, threads=1).model, near, 0.9)
    assert predicted_db - 10 < true_db < predicted_db + 3


def test_process_prints_and_stores_the_error_of_plane_wavefronts(tmp_path):
    write_recording(tmp_path / "rec.h5", [heard(CALL)])
    arguments = ["process", str(tmp_path / "rec.h5"), "-o", str(tmp_path / "image.h5"), "--force"]
    done = CliRunner().invoke(cli, arguments)
    assert "the error of plane wavefronts is up to" in done.stderr
    with open_energyscapes(tmp_path / "image.h5") as images:
        assert images.wavefront_error_db > images.max_error_db
        error_db = images.wavefront_error_db
    done = CliRunner().invoke(cli, [*arguments, "--method", "paper"])
    assert "the error of plane wavefronts is up to" in done.stderr
    with open_energyscapes(tmp_path / "image.h5") as images:
        assert images.wavefront_error_db == pytest.approx(error_db, abs=0.5)
    done = CliRunner().invoke(cli, [*arguments, "--wavefront", "auto"])
    assert done.exit_code == 0, done.stderr
    assert "plane wavefronts" not in done.stderr
    with open_energyscapes(tmp_path / "image.h5") as images:
        assert images.wavefront_error_db is None
        assert images.settings.processing.wavefront == "spherical"
