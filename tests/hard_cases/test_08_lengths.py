"""Records of awkward lengths compared with the exact image: prime, odd, or shorter than the call or the filters."""

import numpy as np
import pytest

from ertis_numba.geometry import unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.geometry.waveform import decimation_taps, matched_band_hz
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Array, Recording
from ertis_numba.simulation import Point, Sensor
from ertis_numba.simulation.effects import EFFECTS
from ertis_numba.simulation.render import Simulator
from tests import reference
from tests.cases import LINE_8, SHORT, noise
from tests.hard_cases.forced import FULL, forced
from tests.hard_cases.tuned import tuned
from tests.scenes import EAR, only, scene_of

LINE = SHORT.replace(array=Array(layout="line", positions_m=LINE_8, word_bits=8))
CALL = int(LINE.call.duration_s * LINE.recording.sample_rate_hz)  # 11,250 samples
N_TAPS = len(
    decimation_taps(
        sample_rate_hz=LINE.recording.sample_rate_hz, decimation=LINE.decimation, pass_hz=matched_band_hz(LINE)[1]
    )
)
LENGTHS = {
    "one sample": 1,
    "prime, less than a range": 97,
    "one short of the low pass": N_TAPS - 1,
    "half of the low pass": N_TAPS // 2,
    "odd": 1001,
    "one short of the call": CALL - 1,
    "one over the call": CALL + 1,
    "prime": 12_347,
    "multiple of 10 but not of 8": 20_010,
    "multiple of 8 but not of 10": 20_008,
    "one short of 32,768": 32_767,
    "one over 32,768": 32_769,
    "prime beyond": 34_877,
}


def of_length(n_samples, settings=LINE):
    """Settings whose image ends with the record."""
    end_m = sound_speed_m_s(settings.air) * n_samples / settings.recording.sample_rate_hz / 2
    return settings.replace(
        recording=Recording(n_samples=n_samples),
        processing=settings.processing.replace(directions="2d:3", range_m=(0.0, end_m * (1 - 1e-12))),
    )


@pytest.mark.parametrize("precision", ["float32", "auto"])
@pytest.mark.parametrize("n_samples", LENGTHS.values(), ids=LENGTHS)
def test_image_of_any_record_length_is_exact(n_samples, precision):
    """The error budget is -60 dB; records that contain only one end of the call's band reach -45 dB."""
    settings = tuned(of_length(n_samples), precision=precision, max_error_db=-60.0)
    pipeline, measurement = Pipeline(settings, predict=False), noise(settings)
    amplitude = pipeline.process(measurement).amplitude
    directions = unit_vectors(pipeline.grid.azimuth_rad, pipeline.grid.elevation_rad)
    wanted = reference.exact(measurement.data, settings, directions, pipeline.range_m)
    assert reference.error_db(amplitude, wanted) < -45


@pytest.mark.parametrize("n_samples", [1009, 12_347, 32_769])
def test_truncation_to_whole_blocks_loses_the_end(n_samples):
    """Without the samples after the last multiple of 32 the image is off by -15 to -52 dB."""
    settings = of_length(n_samples)
    words = noise(settings).data
    directions, range_m = np.eye(3)[:1], np.linspace(0, settings.processing.range_m[1], 50)
    cut = words[: n_samples // 32 * 32]
    lost_db = reference.error_db(
        reference.exact(cut, settings, directions, range_m), reference.exact(words, settings, directions, range_m)
    )
    assert lost_db > -60


# ---- through the simulator -------------------------------------------------------------------------


@pytest.mark.parametrize("n_samples", [1, 100, 4097])
def test_records_shorter_than_the_call_are_handled(n_samples):
    sensor = Sensor(array=EAR.array, recording=Recording(n_samples=n_samples), emitter=FULL.emitter)
    assert Simulator(forced(scene_of(Point(range_m=0.05), sensor=sensor)), plan=only(*EFFECTS)).render().data.shape == (
        n_samples,
    )
