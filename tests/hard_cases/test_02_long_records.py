"""Records of 16,777,216 samples: no drift over 640 m, and no buffers of that size except the samples themselves."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ertis_numba.frames import Measurement, Stamp
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.geometry.waveform import call_at
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Array, Processing, Recording, Settings
from ertis_numba.storage import write_recording
from tests import reference
from tests.hard_cases.tuned import tuned

pytestmark = pytest.mark.usefixtures("sound_unchecked")

N_SAMPLES = 2**24
N_NOISE = 40_960
PAIR = Array(layout="pair", positions_m=((0.0, -0.02, 0.0), (0.0, 0.02, 0.0)), word_bits=8)
LONG = Settings(
    array=PAIR,
    recording=Recording(n_samples=N_SAMPLES),
    processing=Processing(directions="2d:5", range_m=(0.4, 0.9), wavefront="plane"),
)
RATE_HZ = LONG.recording.sample_rate_hz
LATER = (N_SAMPLES - N_NOISE - 2000) // 100 * 100  # a multiple of range_decimation, to shift ranges by whole steps


def shifted_image(first, precision, shift=0):
    """The image of noise that begins at sample ``first + shift``, with the range window shifted alike.

    An idle pattern with a period of two samples surrounds the noise.
    """
    farther_m = shift * sound_speed_m_s(LONG.air) / (2 * RATE_HZ)
    near_m, far_m = LONG.processing.range_m
    processing = LONG.processing.replace(range_m=(near_m + farther_m, far_m + farther_m))
    words = np.zeros(N_SAMPLES, dtype=np.uint8)
    words[1::2] = 0xFF
    words[first + shift :][:N_NOISE] = np.random.default_rng(1).integers(0, 256, N_NOISE, dtype=np.uint8)
    settings = tuned(LONG.replace(processing=processing), precision=precision)
    image = Pipeline(settings).process(Measurement(words, settings))
    assert image.range_m[0] == pytest.approx(near_m + farther_m, abs=1e-9)
    return image.amplitude


@pytest.mark.parametrize("precision", ["float32", "auto"])
def test_end_of_a_long_record_is_imaged_like_its_start(precision):
    """The image at 640 m equals that of the same bits at 0.4 m, bit for bit where both windows align."""
    near, far = shifted_image(1000, precision), shifted_image(1000, precision, LATER)
    n_ranges = min(near.shape[1], far.shape[1])  # rounding may exclude the last range from one window
    assert n_ranges >= 130
    change = np.linalg.norm(far[:, :n_ranges] - near[:, :n_ranges])
    assert change < 1e-5 * np.linalg.norm(near)  # the change may be 0


def test_times_in_float32_drift_in_long_records():
    """Float32 cannot represent every index beyond 2²⁴: after 3.7 s the error of the call is -36 dB."""
    assert np.float32(N_SAMPLES + 1) == np.float32(N_SAMPLES)
    index = LATER + np.arange(12_000)
    wanted = call_at(LONG.call, (index - LATER) / RATE_HZ)
    drifted = index.astype(np.float32) / np.float32(RATE_HZ) - np.float32(LATER / RATE_HZ)
    assert -40 < reference.error_db(call_at(LONG.call, drifted.astype(float)), wanted) < -30
    assert reference.error_db(call_at(LONG.call, index / RATE_HZ - LATER / RATE_HZ), wanted) < -100


STREAM = """
import sys
import ertis_numba as ertis
for path in sys.argv[1:]:
    with ertis.open_recording(path) as recording:
        pipeline = ertis.Pipeline(recording.settings)
        for measurement in recording:
            pipeline.process(measurement)
    print(open("/proc/self/status").read())
"""


def write_four(path, n_samples):
    """Write a recording of four records of ``n_samples``."""
    settings = LONG.replace(recording=Recording(n_samples=n_samples))
    words = np.zeros(n_samples, dtype=np.uint8)
    words[1::2] = 0xFF
    return write_recording(path, (Measurement(words, settings, Stamp(sequence=number)) for number in range(4)))


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="only Linux says how large a process ever was")
def test_memory_grows_only_by_the_samples(tmp_path):
    """Memory holds two records of 16 MiB of a file of 64 MiB; signals would take 128 MiB.

    One process streams short records first, and then long ones.
    """
    paths = [write_four(tmp_path / "short.h5", 2**17), write_four(tmp_path / "long.h5", N_SAMPLES)]
    done = subprocess.run([sys.executable, "-c", STREAM, *paths], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    # Not getrusage: its maximum includes the size of the process that started this one.
    short_kb, long_kb = map(int, re.findall(r"VmHWM:\s+(\d+) kB", done.stdout))
    assert N_SAMPLES < 1024 * (long_kb - short_kb) < 2.5 * N_SAMPLES
