"""Direct sound 60 to 100 dB above the echoes, and echoes 60 dB above other echoes.

Levels down to -80 dB pass through the simulator's modulators; the noise of one measurement lies below that. Levels
down to -100 dB use the float signals before the modulators.
"""

import numpy as np
import pytest

from ertis_numba.analysis.detect import find_peaks
from ertis_numba.frames import Energyscape, Measurement
from ertis_numba.geometry.waveform import call_samples
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Processing, Recording, Settings
from ertis_numba.simulation import Emitter, Point, Sensor
from ertis_numba.simulation.render import Simulator
from tests.cases import noise
from tests.hard_cases.tuned import chain_of
from tests.scenes import only, scene_of

pytestmark = pytest.mark.usefixtures("sound_unchecked")

LOUDEST_DB = -6.0  # level of the direct sound in the microphone nearest to the emitter
DIRECT_DB = -46.0  # reaches LOUDEST_DB at that microphone's distance of 1 cm
SHORT = Settings(
    recording=Recording(n_samples=65_536),
    processing=Processing(directions="2d:91", range_m=(0.0, 2.0), wavefront="plane"),
)


def echo(azimuth_deg, range_m, level_db):
    """A point whose echo has the given level in dBFS."""
    return Point(azimuth_deg=azimuth_deg, range_m=range_m, strength_db=level_db + 40 * np.log10(range_m))


def simulator_of(*points, direct_sound_db):
    sensor = Sensor(
        array=SHORT.array,
        recording=SHORT.recording,
        processing=SHORT.processing,
        emitter=Emitter(direct_sound_db=direct_sound_db),
    )
    return Simulator(scene_of(*points, sensor=sensor), plan=only("spreading", "direct_sound"))


def modulated_image(simulator):
    """The image of the modulated signals."""
    return Pipeline(SHORT).process(simulator.render())


def unmodulated_image(simulator):
    """The image of the signals before the modulators."""
    chain = chain_of(SHORT)
    amplitude = np.empty((len(chain.grid), len(chain.range_m)), dtype=np.float32)
    chain.process_signals(simulator.signals(), amplitude)
    return Energyscape(amplitude, chain.grid.azimuth_rad, chain.grid.elevation_rad, chain.range_m, SHORT)


def beyond(image, range_m):
    """The part of an image beyond a range."""
    there = image.range_m > range_m
    return image.replace(amplitude=np.ascontiguousarray(image.amplitude[:, there]), range_m=image.range_m[there])


def strongest(image):
    [peak] = find_peaks(image, top=1)
    return peak


@pytest.mark.parametrize(
    ("image_of", "below_db", "range_m"),
    [
        (modulated_image, 60, 0.6),
        (modulated_image, 60, 1.9),
        (modulated_image, 80, 0.6),
        (modulated_image, 80, 1.9),
        (unmodulated_image, 80, 0.6),
        (unmodulated_image, 100, 0.6),
        (unmodulated_image, 100, 1.9),
    ],
)
def test_echo_below_the_direct_sound_has_the_right_position(image_of, below_db, range_m):
    """The echo is within 0.5°, 2 mm and 1.5 dB, and all else beyond 0.5 m is at least 12 dB weaker."""
    level_db = LOUDEST_DB - below_db
    simulator = simulator_of(echo(20.0, range_m, level_db), direct_sound_db=DIRECT_DB)
    assert 20 * np.log10(np.abs(simulator.signals()).max()) == pytest.approx(LOUDEST_DB, abs=0.1)
    image = beyond(image_of(simulator), 0.5)
    peak = strongest(image)
    assert peak.azimuth_deg == pytest.approx(20, abs=0.5)
    assert peak.range_m == pytest.approx(range_m, abs=2e-3)
    assert 20 * np.log10(image.amplitude.max()) == pytest.approx(level_db, abs=1.5)
    elsewhere = np.abs(image.range_m - range_m) > 0.15
    assert image.amplitude[:, elsewhere].max() < image.amplitude.max() / 4


@pytest.mark.parametrize(("farther_m", "min_db"), [(0.1, 50), (0.2, 75), (0.3, 90), (0.5, 135), (1.5, 140)])
def test_direct_sound_decays_with_range(farther_m, min_db):
    """Relative to the loudest microphone: -54 dB at 10 cm, -77 at 20, -96 at 30, -143 at 50, -149 beyond (float32)."""
    image = unmodulated_image(simulator_of(direct_sound_db=DIRECT_DB))
    assert 20 * np.log10(beyond(image, farther_m).amplitude.max()) - LOUDEST_DB < -min_db


@pytest.mark.parametrize("azimuth_deg", [25.0, -20.0])
@pytest.mark.parametrize("image_of", [modulated_image, unmodulated_image])
def test_echo_60_db_below_another_is_found(image_of, azimuth_deg):
    """Both echoes are within 0.5° and 2 mm, even in the same direction."""
    points = echo(-20.0, 0.8, -10.0), echo(azimuth_deg, 1.3, -70.0)
    image = image_of(simulator_of(*points, direct_sound_db=-250.0))
    near, far = strongest(image), strongest(beyond(image, 1.1))
    assert (near.azimuth_deg, far.azimuth_deg) == pytest.approx((-20, azimuth_deg), abs=0.5)
    assert (near.range_m, far.range_m) == pytest.approx((0.8, 1.3), abs=2e-3)
    assert 20 * np.log10(beyond(image, 1.1).amplitude.max() / image.amplitude.max()) == pytest.approx(-60, abs=1)


def full_scale_noise(settings):
    """Full-scale noise for the length of a call, then an idle pattern far out of band."""
    loud = int(settings.call.duration_s * settings.recording.sample_rate_hz)
    words = np.where(np.arange(settings.recording.n_samples) % 2, 0xFFFFFFFF, 0).astype(np.uint32)
    words[:loud] = noise(settings).data[:loud]
    return words


@pytest.mark.parametrize("method", ["fast", "paper"])
def test_direct_sound_does_not_wrap_to_far_ranges(method):
    settings = Settings.from_preset("short_25_50").replace(
        processing=Processing(directions="2d:5", range_m=(0.0, 2.0), method=method)
    )
    image = Pipeline(settings).process(Measurement(full_scale_noise(settings), settings))
    near = image.amplitude[:, image.range_m < 0.43].max()
    far_db = 20 * np.log10(image.amplitude[:, image.range_m > 0.6].max(axis=0) / near + 1e-9)
    # Only the ringing of the band edges is left, and it decays instead of returning at far ranges.
    assert far_db.max() < -60
    assert far_db[-100:].max() < -80


def test_circular_convolution_wraps_around():
    """A transform as long as the record moves sound from before its start to its end at full level."""
    settings = Settings.from_preset("short_25_50")
    signal = (full_scale_noise(settings) & 1) * 2.0 - 1.0
    call = call_samples(settings.call, rate_hz=settings.recording.sample_rate_hz)
    n = len(signal)

    def last_half_metre_db(n_fft):
        matched = np.fft.irfft(np.fft.rfft(signal, n_fft) * np.conj(np.fft.rfft(call, n_fft)), n_fft)[:n]
        return 20 * np.log10(np.abs(matched[-n // 5 :]).max() / np.abs(matched).max())

    assert last_half_metre_db(n) > -3
    assert last_half_metre_db(2 * n) < -30  # the idle pattern, not filtered
