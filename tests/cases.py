"""Settings that every chain and every device is tested on, and data to test them with."""

import numpy as np

from ertis_numba.frames import Measurement, Stamp
from ertis_numba.frames.sample_format import sample_format
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Accuracy, Air, Array, Call, Processing, Recording, Settings

LINE_8 = tuple((0.0, 0.004 * channel, 0.0) for channel in range(8))
SHORT = Settings(
    recording=Recording(n_samples=40_960),
    processing=Processing(directions="2d:7", range_m=(0.4, 0.9), wavefront="plane"),
    accuracy=Accuracy(max_error_db=-45.0),
)
CASES = {
    "default": SHORT,
    "wide band": SHORT.replace(call=Call(start_frequency_hz=80_000.0, stop_frequency_hz=20_000.0)),
    "upward sweep": SHORT.replace(call=Call(start_frequency_hz=25_000.0, stop_frequency_hz=50_000.0)),
    "one direction": SHORT.replace(processing=SHORT.processing.replace(directions="2d:1")),
    "first sample": SHORT.replace(processing=SHORT.processing.replace(range_m=(0.0, 0.4))),
    "last sample": SHORT.replace(processing=SHORT.processing.replace(range_m=(1.2, 1.55))),
    "prime record": SHORT.replace(recording=Recording(n_samples=40_961)),
    "odd record": SHORT.replace(recording=Recording(n_samples=40_965)),
    "solid angle": SHORT.replace(processing=SHORT.processing.replace(directions="3d:11")),
    "cold": SHORT.replace(air=Air(temperature_c=-40.0, humidity_percent=0.0)),
    "one microphone": SHORT.replace(array=Array(layout="one", positions_m=((0.0, 0.0, 0.0),), word_bits=8)),
    "line of 8": SHORT.replace(array=Array(layout="line", positions_m=LINE_8, word_bits=8)),
    "16 bits, disabled": SHORT.replace(
        array=Array(layout="line", positions_m=LINE_8, enabled=(True, False) * 4, word_bits=16)
    ),
    "64 bits, two words": SHORT.replace(
        array=Array(layout="long", positions_m=tuple((0.0, 0.001 * m, 0.0) for m in range(70)), word_bits=64)
    ),
    "calibrated": SHORT.replace(
        array=Array(
            layout="line", positions_m=LINE_8, gain=(2.0, 1.0) * 4, delay_s=(0.0, 1e-6, -2e-6, 3e-6) * 2, word_bits=8
        )
    ),
    "array weights": SHORT.replace(
        array=Array(
            layout="line", positions_m=LINE_8, enabled=(True, True, False, True) * 2, gain=(2.0, 1.0) * 4, word_bits=8
        ),
        processing=SHORT.processing.replace(array_weights=(0.0, 1.0, 9.0, 2.0, 3.0, 0.5, 9.0, 1.0)),
    ),
    "PCM of 16 bits": SHORT.replace(
        recording=Recording(sample_rate_hz=192_000.0, n_samples=1_748, encoding="int16"),
        processing=SHORT.processing.replace(range_decimation=4),
    ),
    "PCM, calibrated": SHORT.replace(
        array=Array(
            layout="line",
            positions_m=LINE_8,
            enabled=(True, True, False, True) * 2,
            gain=(2.0, 1.0) * 4,
            delay_s=(0.0, 1e-6, -2e-6, 3e-6) * 2,
        ),
        recording=Recording(sample_rate_hz=125_000.0, n_samples=1_139, encoding="float32"),
        processing=SHORT.processing.replace(range_decimation=2),
    ),
    "PCM, decimated": SHORT.replace(
        recording=Recording(sample_rate_hz=1e6, n_samples=9_103, encoding="float32"),
        processing=SHORT.processing.replace(range_decimation=20),
    ),
    "decimated by 15": SHORT.replace(processing=SHORT.processing.replace(decimation=15, range_decimation=150)),
    "fine ranges": SHORT.replace(processing=SHORT.processing.replace(range_decimation=30)),
    "every sample": SHORT.replace(processing=SHORT.processing.replace(range_decimation=10, range_m=(0.6, 0.62))),
}
"""Settings by name. Records are short to keep the float64 reference implementations fast."""


def noise(settings: Settings, seed: int = 1) -> Measurement:
    """White noise, which exercises all ranges and directions at once."""
    words, random = sample_format(settings), np.random.default_rng(seed)
    if settings.recording.is_pdm:
        numbers = random.integers(0, 2**settings.array.word_bits, words.shape, dtype=words.dtype)
    else:
        numbers = (0.1 * settings.recording.full_scale * random.standard_normal(words.shape)).astype(words.dtype)
    return Measurement(numbers, settings, Stamp(sequence=5))


def process_noise(seed: int) -> bytes:
    """Amplitudes of the image of white noise. Other processes import this module faster than one of tests."""
    return Pipeline(SHORT, predict=False).process(noise(SHORT, seed)).amplitude.tobytes()


def words_of(signals, seed: int = 1):
    """Convert signals to words whose bits are 1 with probability (1 + signal) / 2: (sample,) uint32.

    This is the simplest one-bit converter. Its mean equals the signal, and its error is white.

    Parameters
    ----------
    signals : (mic, sample)
        Within -1 and 1; at most 32 microphones.
    """
    random = np.random.default_rng(seed)
    words = np.zeros(signals.shape[1], dtype=np.uint32)
    for mic, signal in enumerate(signals):
        words |= (random.random(len(signal)) < (1 + signal) / 2).astype(np.uint32) << np.uint32(mic)
    return words
