"""Warnings of coarse directions of images in Python, at the central node and in the view."""

import time
import warnings

import pytest

from ertis_numba.base.errors import CoarseGridWarning
from ertis_numba.network.processing._predictions import Predictions
from ertis_numba.pipeline import Pipeline
from ertis_numba.storage import write_acoustic_maps, write_recording
from ertis_numba.storage.acoustic_maps import AcousticMapWriter, open_acoustic_maps
from ertis_numba.viewer import Playback
from tests.files import SMALL, noise
from tests.passive.test_default_bands import heard, mapped

COARSE = SMALL.replace("processing.directions", "2d:7")
FINE = SMALL.replace("processing.directions", "2d:181")
TEXT = "directions are 30.0° apart, so a reflector between them .* process with at least 2d:"


def test_pipelines_warn_once_of_coarse_directions():
    with Pipeline(COARSE, "cpu", 1) as pipeline:
        with pytest.warns(CoarseGridWarning, match=TEXT) as caught:
            pipeline.process(noise(COARSE)[0])
        assert [each.filename for each in caught if each.category is CoarseGridWarning] == [__file__]
        with warnings.catch_warnings():
            warnings.simplefilter("error", CoarseGridWarning)
            pipeline.process(noise(COARSE)[0])


@pytest.mark.parametrize(("settings", "predict"), [(FINE, True), (COARSE, False)])
def test_fine_and_unchecked_pipelines_do_not_warn(settings, predict):
    with warnings.catch_warnings(), Pipeline(settings, "cpu", 1, predict=predict) as pipeline:
        warnings.simplefilter("error", CoarseGridWarning)
        pipeline.process(noise(settings)[0])


@pytest.mark.parametrize(("settings", "count"), [(COARSE, 1), (FINE, 0)])
def test_workers_report_coarse_directions(settings, count):
    with Pipeline(settings, "cpu", 1, predict=False) as pipeline:
        image = pipeline.process(noise(settings)[0])
    predictions, found = Predictions("cpu"), []
    predictions.add("front", image, noise(settings)[0])
    while predictions.busy:
        found += predictions.drain()
        time.sleep(0.01)
    assert sum(each.event == "coarse_grid" and "30.0° apart" in each.warning for each in found) == count


def test_view_notes_coarse_directions_once(tmp_path):
    path = write_recording(tmp_path / "rec.h5", noise(COARSE, 2))
    with Playback(path, device="cpu") as playback:
        playback.at(0)
        playback.at(1)
        assert sum("directions are 30.0° apart" in note for note in playback.notes()) == 1


def test_files_of_maps_store_the_note_on_bands(tmp_path):
    found, note = mapped(heard(96e3, 45e3))
    path = tmp_path / "maps.h5"
    with AcousticMapWriter(path) as writer:
        writer.write(found)
        writer.note_bands("s", note)
    with open_acoustic_maps(path) as maps:
        assert maps.band_note == note
    with Playback(path) as playback:
        playback.at(0)
        assert f"sensor s: {note}" in playback.notes()
    with open_acoustic_maps(write_acoustic_maps(tmp_path / "plain.h5", [found])) as maps:
        assert maps.band_note == ""
