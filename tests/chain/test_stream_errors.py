"""Images from streams: measured and predicted errors in hard scenes, focal zones, and equality with exact kernels."""

import numpy as np
import pytest

from ertis_numba import kernels
from ertis_numba.chain.stream_recipe import uses_streams
from ertis_numba.frames import Measurement
from ertis_numba.geometry import microphones, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.geometry.waveform import call_at
from ertis_numba.pipeline import Pipeline, verification
from ertis_numba.settings import Accuracy, Array, Processing, Recording, Settings

CPU = kernels.load("cpu")
PCM = Settings(
    recording=Recording(sample_rate_hz=450e3, n_samples=5_400, encoding="float32"),
    processing=Processing(
        directions="3d:60",
        azimuth_limits_deg=(-50, 50),
        elevation_limits_deg=(-30, 30),
        range_m=(0.7, 1.3),
        range_decimation=10,
    ),
    accuracy=Accuracy(precision="int16"),
)
COMBINATIONS = {
    "coherence factor": {"weighting": "coherence_factor"},
    "dmas 2": {"beamformer": "dmas", "dmas_order": 2},
    "dmas 3": {"beamformer": "dmas", "dmas_order": 3},
    "dmas 5 with coherence factor": {"beamformer": "dmas", "dmas_order": 5, "weighting": "coherence_factor"},
}
# Azimuth and elevation in degrees, range in metres, and amplitude of each echo; RMS of the noise.
SCENES = {
    "one echo": ([(20, 10, 1.0, 1.0)], 1e-3),
    "near-equal echoes": ([(20, 10, 1.0, 1.0), (28, 10, 1.004, 0.95)], 1e-3),
    "strong next to weak": ([(-30, 0, 0.9, 1.0), (-22, 5, 0.91, 0.03), (40, 20, 1.2, 0.01)], 1e-3),
    "echoes in noise": ([(10, 0, 0.9, 1.0), (-40, 10, 1.1, 0.5)], 0.3),
    "noise only": ([], 0.3),
}
pytestmark = [
    pytest.mark.skipif(not CPU.tile_ranges, reason="this processor has no 16-bit dot product"),
    pytest.mark.usefixtures("sound_unchecked"),
]


def heard(settings, echoes, noise, *, dead=(), loud=()):
    """Measurement of points and noise; some microphones are dead, and some 20 dB louder."""
    layout, random = microphones(settings.array), np.random.default_rng(5)
    time_s = np.arange(settings.recording.n_samples) / settings.recording.sample_rate_hz
    positions_m = layout.enabled_positions_m
    signals = noise * random.standard_normal((len(positions_m), len(time_s)))
    for azimuth_deg, elevation_deg, range_m, amplitude in echoes:
        toward = unit_vectors(np.radians([azimuth_deg]), np.radians([elevation_deg]))[0]
        if settings.processing.wavefront == "plane":
            paths_m = 2 * range_m - positions_m @ toward
        else:
            paths_m = range_m + np.linalg.norm(range_m * toward - positions_m, axis=1)
        for mic, path_m in enumerate(paths_m):
            signals[mic] += amplitude * call_at(settings.call, time_s - path_m / sound_speed_m_s(settings.air))
    signals[list(dead)] = 0
    signals[list(loud)] *= 10
    return Measurement((0.05 * signals.T).astype(np.float32), settings)


def imaged(measurement):
    with Pipeline(measurement.settings, "cpu", 1) as pipeline:
        image = pipeline.process(measurement)
        return image, pipeline.prediction


@pytest.mark.filterwarnings("ignore:images may exceed the error budget")
@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("combination", COMBINATIONS)
def test_errors_are_predicted_within_3_db_and_kept_for_echoes(combination, scene):
    settings = PCM.replace(processing=PCM.processing.replace(**COMBINATIONS[combination]))
    measurement = heard(settings, *SCENES[scene])
    image, prediction = imaged(measurement)
    assert uses_streams(image.settings.processing, image.settings.accuracy)
    true_db = verification.measure(image, measurement).error_db
    assert abs(prediction.predicted_error_db - true_db) < 3.0
    assert true_db <= -35.0 or (prediction.warning and scene == "noise only")


@pytest.mark.filterwarnings("ignore:images may exceed the error budget")
@pytest.mark.parametrize("faults", [{"dead": (3, 17)}, {"loud": (5,)}], ids=["dead", "loud"])
@pytest.mark.parametrize("combination", COMBINATIONS)
def test_errors_with_faulty_microphones_are_predicted_within_3_db(combination, faults):
    settings = PCM.replace(processing=PCM.processing.replace(**COMBINATIONS[combination]))
    measurement = heard(settings, *SCENES["near-equal echoes"], **faults)
    image, prediction = imaged(measurement)
    true_db = verification.measure(image, measurement).error_db
    assert abs(prediction.predicted_error_db - true_db) < 3.0
    assert true_db <= -35.0 or prediction.warning


@pytest.mark.parametrize("combination", COMBINATIONS)
def test_streams_of_silence_are_silent(combination):
    settings = PCM.replace(processing=PCM.processing.replace(**COMBINATIONS[combination]))
    image, _ = imaged(heard(settings, [], 0.0))
    assert not image.amplitude.any()


def test_coherence_factor_of_one_microphone_is_its_envelope():
    array = Array(layout="one", positions_m=((0.0, 0.0, 0.0),), word_bits=8)
    settings = PCM.replace(array=array, processing=PCM.processing.replace(directions="2d:5"))
    plain, _ = imaged(heard(settings, *SCENES["one echo"]))
    settings = settings.replace(processing=settings.processing.replace(weighting="coherence_factor"))
    image, _ = imaged(heard(settings, *SCENES["one echo"]))
    assert verification.error_db(image.amplitude, plain.amplitude) < -35


@pytest.mark.parametrize("combination", COMBINATIONS)
def test_calibrated_gains_do_not_change_images_of_streams(combination):
    gains = np.random.default_rng(2).uniform(0.3, 3.0, 32)
    settings = PCM.replace(processing=PCM.processing.replace(**COMBINATIONS[combination]))
    plain = heard(settings, *SCENES["near-equal echoes"])
    positions_m = tuple(map(tuple, microphones(settings.array).enabled_positions_m.tolist()))
    calibrated = settings.replace(
        array=Array(layout="calibrated", positions_m=positions_m, gain=tuple(gains.tolist()), word_bits=32)
    )
    louder = Measurement((plain.data * gains).astype(np.float32), calibrated)
    first, second = (imaged(each)[0].amplitude for each in (plain, louder))
    assert verification.error_db(second, first) < -45


@pytest.mark.parametrize("combination", COMBINATIONS)
def test_streams_focus_spherical_wavefronts(combination):
    processing = PCM.processing.replace(**COMBINATIONS[combination], wavefront="spherical", range_m=(0.3, 0.5))
    settings = PCM.replace(processing=processing)
    measurement = heard(settings, [(20, 10, 0.4, 1.0)], 1e-3)
    image, prediction = imaged(measurement)
    assert image.settings.accuracy.focal_zones > 1
    true_db = verification.measure(image, measurement).error_db
    assert true_db <= -35.0
    assert abs(prediction.predicted_error_db - true_db) < 3.0
