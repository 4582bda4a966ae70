"""Range-wise cleaning: by the pipeline, in detection, on the command line, in the network and in the view."""

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba.analysis.cfar import cfar
from ertis_numba.analysis.detect import find_peaks
from ertis_numba.analysis.noise import noise_of
from ertis_numba.analysis.points import PointExtractor
from ertis_numba.analysis.range_cleaning import clean
from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames.sample_format import sample_format
from ertis_numba.network.processing.shared_pipeline import SharedPipeline
from ertis_numba.pipeline import Pipeline
from ertis_numba.pipeline.verification import measure
from ertis_numba.settings import Processing
from ertis_numba.storage import open_energyscapes, write_energyscapes, write_recording
from ertis_numba.viewer import Choices, ViewedScene
from tests.analysis.test_detect import image_of
from tests.cases import SHORT
from tests.files import image as speckle, noise
from tests.views import taken

WITHIN_DB, ABOVE_MEAN_DB = 4.0, 1.0
LEVELS = [(WITHIN_DB, None), (None, ABOVE_MEAN_DB), (WITHIN_DB, ABOVE_MEAN_DB)]


def cleaned_settings(within_db=WITHIN_DB, above_mean_db=None, settings=SHORT, **changes):
    changes |= {"clean_within_db": within_db, "clean_above_mean_db": above_mean_db}
    return settings.replace(processing=settings.processing.replace(**changes))


def reference(amplitude, within_db, above_mean_db):
    """Clean one range after the other, in float64."""
    kept = amplitude.copy()
    for r, values in enumerate(amplitude.T.astype(float)):
        for direction, value in enumerate(values):
            weak = within_db is not None and value < values.max() * 10 ** (-within_db / 20)
            faint = above_mean_db is not None and value < sum(values) / len(values) * 10 ** (above_mean_db / 20)
            if weak or faint:
                kept[direction, r] = 0
    return kept


@pytest.mark.parametrize(("within_db", "above_mean_db"), LEVELS)
@pytest.mark.parametrize(("device", "method"), [("cpu", "fast"), ("numpy", "fast"), ("numpy", "paper")])
def test_pipeline_cleans_by_the_equations(within_db, above_mean_db, device, method):
    settings = cleaned_settings(within_db, above_mean_db, method=method)
    (measurement,) = noise(settings, 1)
    with Pipeline(settings, device=device, predict=False) as pipeline:
        whole = pipeline.process(measurement, clean=False)
        image = pipeline.process(measurement)
    wanted = reference(whole.amplitude, within_db, above_mean_db)
    assert image.amplitude.tobytes() == wanted.tobytes()
    assert 0.05 < (wanted == 0).mean() < 0.95
    assert image.settings.processing.is_cleaned
    assert not whole.settings.processing.is_cleaned
    again = clean(whole, within_db=within_db, above_mean_db=above_mean_db)
    assert again.amplitude.tobytes() == wanted.tobytes()


def test_cleaning_is_the_same_in_batches_in_streams_and_into_an_array():
    settings = cleaned_settings()
    measurements = noise(settings, 3)
    with Pipeline(settings, device="cpu", predict=False) as pipeline:
        single = [pipeline.process(each).amplitude.tobytes() for each in measurements]
        assert [each.amplitude.tobytes() for each in pipeline.process_batch(measurements)] == single
        assert [each.amplitude.tobytes() for each in pipeline.process_many(measurements, batch_size=2)] == single
        out = np.empty((len(pipeline.grid), len(pipeline.range_m)), dtype=np.float32)
        stream = pipeline.stream()
        stream.add(0, measurements[0].data[:20_000])
        image = pipeline.process(measurements[0], out, stream=stream)
        assert image.amplitude is out
        assert out.tobytes() == single[0]


def test_uncleaned_image_is_that_of_settings_without_cleaning():
    (measurement,) = noise(SHORT, 1)
    with Pipeline(cleaned_settings(), device="cpu") as cleaned, Pipeline(SHORT, device="cpu") as plain:
        image, wanted = cleaned.process(measurement, clean=False), plain.process(measurement)
        assert image.settings == wanted.settings
        assert image.amplitude.tobytes() == wanted.amplitude.tobytes()
        cleaned.process(measurement)
        assert cleaned.prediction == plain.prediction


REFLECTORS = [(12.3, 0.0, 1.0123, 1.0), (-33.3, 0.0, 1.2345, 0.5)]


@pytest.mark.parametrize("within_db", [0.0, 0.2, 1.0, 6.0])
def test_peaks_and_points_of_cleaned_images_lie_at_the_reflectors(within_db):
    """Interpolation must not use removed bins, whose logarithm is far below all others."""
    whole = image_of(REFLECTORS, range_m=(0.9, 1.4), noise=0.001)
    kept = clean(whole, within_db=within_db)
    peaks, cloud = find_peaks(kept, top=2), PointExtractor(whole.settings)(kept)
    assert len(peaks) == len(REFLECTORS)
    nearest = np.linalg.norm(cloud.position_m[:2], axis=1)
    for (azimuth_deg, _, range_m, amplitude), peak, found_m in zip(REFLECTORS, peaks, nearest, strict=True):
        assert peak.azimuth_deg == pytest.approx(azimuth_deg, abs=1)  # the spacing of the grid
        assert peak.range_m == pytest.approx(range_m, abs=0.002)
        assert peak.level_dbfs == pytest.approx(20 * np.log10(amplitude), abs=1)
        assert found_m == pytest.approx(range_m, abs=0.002)


def test_noise_of_a_cleaned_image_is_unknown():
    settings = cleaned_settings(20.0, directions="2d:19")
    (measurement,) = noise(settings, 1)
    with Pipeline(settings, device="cpu", predict=False) as pipeline:
        image, whole = pipeline.process(measurement), pipeline.process(measurement, clean=False)
    assert np.median(image.amplitude) > 0
    assert noise_of(image) == 0 < noise_of(whole)
    assert np.isnan(PointExtractor(settings)(image).uncertainty_m).all()
    with pytest.raises(ArgumentError, match=r"image is cleaned by processing.clean_within_db or .* noise is unknown"):
        cfar(image)


def test_exact_image_is_compared_with_an_uncleaned_one():
    settings = cleaned_settings()
    (measurement,) = noise(settings, 1)
    with Pipeline(settings, device="cpu", predict=False) as pipeline:
        with pytest.raises(ArgumentError, match=r"image is cleaned .* pass the image of Pipeline.process\(measurem"):
            measure(pipeline.process(measurement), measurement)
        assert measure(pipeline.process(measurement, clean=False), measurement).error_db < -40


@pytest.mark.parametrize("key", ["clean_within_db", "clean_above_mean_db"])
def test_levels_out_of_range_are_refused(key):
    with pytest.raises(ArgumentError, match=rf"processing\.{key} is -1; use a number from 0 to 1000"):
        Processing(**{key: -1.0})


def test_process_command_cleans_and_still_verifies(tmp_path):
    recording, target = tmp_path / "noise.h5", tmp_path / "images.h5"
    measurements = noise(SHORT, 2)
    write_recording(recording, measurements)
    options = ["--clean", f"within={WITHIN_DB},above_mean={ABOVE_MEAN_DB}", "--verify", "-q"]
    done = CliRunner().invoke(cli, ["process", str(recording), "-o", str(target), *options])
    assert done.exit_code == 0, done.output
    settings = cleaned_settings(WITHIN_DB, ABOVE_MEAN_DB)
    with open_energyscapes(target) as images, Pipeline(settings, device="cpu", predict=False) as pipeline:
        assert images.settings.processing == settings.processing
        for image, measurement in zip(images, measurements, strict=True):
            assert image.amplitude.tobytes() == pipeline.process(measurement).amplitude.tobytes()
    done = CliRunner().invoke(cli, ["process", str(recording), "-o", str(target), "--clean", "within=-1"])
    assert done.exit_code == 2
    assert "'--clean': 'within=-1': -1.0 is not in the range 0.0<=x<=1000.0" in done.stderr


def test_central_node_publishes_cleaned_images_and_their_points():
    settings = cleaned_settings()
    (measurement,) = noise(settings, 1)
    shared = SharedPipeline(settings.to_toml(), "cpu")
    image = shared.image(np.ascontiguousarray(measurement.data).tobytes())
    whole = shared.pipeline.process(measurement, clean=False)
    assert image.amplitude.tobytes() == reference(whole.amplitude, WITHIN_DB, None).tobytes()
    assert sample_format(settings).n_bytes == measurement.data.nbytes
    assert len(shared.points(image, 100)) > 0


def test_view_shows_cleaned_images(tmp_path):
    image = speckle()
    scene, plain = ViewedScene(clean_within_db=3.0, clean_above_mean_db=6.0), ViewedScene()
    for each in (scene, plain):
        each.take(taken(image))
    ((shown, _, _),) = scene.latest(Choices())
    assert shown.amplitude.tobytes() == reference(image.amplitude, 3.0, 6.0).tobytes()
    lowest = Choices(threshold_db=-60.0)
    drawn, all_drawn = (each.draw(lowest).sensors[image.stamp.sensor] for each in (scene, plain))
    assert (drawn.picture != all_drawn.picture).any()
    path, page = write_energyscapes(tmp_path / "images.h5", [image]), tmp_path / "page.html"
    options = ["--save-html", str(page), "--clean", "within=3,above_mean=6", "-q"]
    done = CliRunner().invoke(cli, ["view", str(path), *options])
    assert done.exit_code == 0, done.output
    assert page.stat().st_size > 0
