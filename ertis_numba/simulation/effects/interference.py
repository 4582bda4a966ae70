"""Tones, noise and other sonars."""

import math

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from ertis_numba.simulation.effects._frames import FRAME, OverlappingFrames, band_bins, drawn, window
from ertis_numba.simulation.effects.spreading import spreading
from ertis_numba.simulation.paths import Paths, without_target
from ertis_numba.simulation.placed import Placed
from ertis_numba.simulation.snapshot import Snapshot, TransmitterPose
from ertis_numba.simulation.sources import Noise, Sonar, Tone

__all__ = ["add_tone", "calls_of", "noise_of", "way_from"]


def way_from(shot: Snapshot, source: Placed) -> Paths:
    """Return the direct path from an omnidirectional source to the microphones."""
    transmitter = TransmitterPose(
        position_m=source.position_at(shot.time_s), velocity_m_s=source.velocity_at(shot.time_s), facing=np.zeros(3)
    )
    return without_target(transmitter, shot.receiver, shot.targets)


def add_tone(shot: Snapshot, tone: Tone, signals: NDArray[np.float64], first: int) -> None:
    """Add ``a / r · sin(2π f (t - r / c))`` to the signals in place; t is the time of the scene.

    Parameters
    ----------
    shot : Snapshot
    tone : Tone
    signals : (mic, sample) float64
    first : int
        Index of the first sample in the record.
    """
    way, rate_hz = way_from(shot, tone), shot.sensor.recording.sample_rate_hz
    amplitude = 10 ** (tone.level_db / 20) * spreading(way)[0]
    # Whole periods of a long time are removed before they cost precision.
    turns = (tone.frequency_hz * (shot.time_s - way.length_m[0] / shot.speed_m_s)) % 1.0
    swing_rad = 2 * math.pi * tone.frequency_hz / rate_hz * np.arange(first, first + signals.shape[1])
    start_rad = 2 * math.pi * turns
    signals += np.outer(amplitude * np.cos(start_rad), np.sin(swing_rad))
    signals += np.outer(amplitude * np.sin(start_rad), np.cos(swing_rad))


def noise_of(shot: Snapshot, noise: Noise, seed: tuple[int, ...]) -> OverlappingFrames:
    """Return the noise of one source, equal at all microphones except for delay and ``1 / r``.

    Each frame is delayed together with its window, so that distant microphones receive the same noise.
    """
    way, rate_hz = way_from(shot, noise), shot.sensor.recording.sample_rate_hz
    apart_m = way.length_m[0] - np.linalg.norm(way.transmitter.position_m - shot.receiver.centre_m)
    late_samples = apart_m / shot.speed_m_s * rate_hz
    amplitude = 10 ** (noise.level_db / 20) * spreading(way)[0]
    margin = math.ceil(np.abs(late_samples).max()) + 1
    n_fft = int(scipy.fft.next_fast_len(FRAME + 2 * margin, real=True))
    bins = band_bins(noise.band_hz, rate_hz)
    alone = np.ones((len(bins), 1, 1))
    turned = np.exp(-2j * math.pi / n_fft * (late_samples[:, None] + margin) * np.arange(n_fft // 2 + 1))

    def heard(random: np.random.Generator) -> NDArray[np.float64]:
        spectrum = scipy.fft.rfft(drawn(random, bins, alone)[0] * window(), n_fft)
        return np.asarray(amplitude[:, None] * scipy.fft.irfft(spectrum * turned, n_fft))

    return OverlappingFrames(seed, heard, margin=margin)


def calls_of(shot: Snapshot, sonar: Sonar) -> NDArray[np.float64]:
    """Return the start times of another sonar's calls that arrive during the record: (call,) float64.

    Times are in seconds after the start of the record, and often negative. Only the direct sound of these calls is
    modelled, because their echoes are far weaker.
    """
    way_s = float(np.mean(way_from(shot, sonar).length_m)) / shot.speed_m_s
    earliest_s = shot.time_s - way_s - sonar.call.duration_s - sonar.offset_s
    latest_s = shot.time_s - way_s + shot.sensor.recording.duration_s - sonar.offset_s
    numbers = np.arange(max(0, math.ceil(earliest_s / sonar.period_s)), math.floor(latest_s / sonar.period_s) + 1)
    return np.asarray(sonar.offset_s + numbers * sonar.period_s - shot.time_s)
