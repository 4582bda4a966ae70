"""Tones, noise and other sonars."""

import math
from collections.abc import Set as AbstractSet
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.simulation.arrivals import Arrivals, gains, rounded_s
from ertis_numba.simulation.effects._overlapping_noise import FRAME, OverlappingFrames, band_bins, drawn, window
from ertis_numba.simulation.effects.spreading import spreading
from ertis_numba.simulation.estimates import Estimate
from ertis_numba.simulation.image_estimate import Sight
from ertis_numba.simulation.paths import Paths, without_target
from ertis_numba.simulation.snapshot import Snapshot, Transmitters
from ertis_numba.simulation.sources import Noise, Sonar, Tone
from ertis_numba.simulation.surroundings import change_db
from ertis_numba.simulation.trajectory import Placed

__all__ = ["arrivals", "estimate", "loudness", "sounds"]


def arrivals(shot: Snapshot, active: AbstractSet[str], found: list[Arrivals]) -> list[Arrivals]:
    """Return the arrivals, and the calls of other sonars. Clock drift does not apply to them."""
    gain, late_s = gains(shot, active)
    found = [*found]
    for sonar in shot.scene.sonars:
        paths, starts_s = _way_from(shot, sonar), _calls_of(shot, sonar)
        if len(starts_s):
            amplitude = gain * (10 ** (sonar.level_db / 20) * spreading(paths))
            delay_s = paths.length_m / shot.speed_m_s + starts_s[:, None] + late_s
            amplitude = np.repeat(amplitude[..., None], len(starts_s), axis=0)
            found.append(Arrivals(sonar.call, rounded_s(delay_s), amplitude))
    return found


def sounds(shot: Snapshot, seed: tuple[int, ...]) -> "list[OverlappingFrames | _ToneAtMicrophones]":
    """Return the noises and the tones of the scene at the microphones."""
    noises = [_noise_of(shot, noise, (*seed, 1 + number)) for number, noise in enumerate(shot.scene.noises)]
    return [*noises, *(_ToneAtMicrophones(shot, tone) for tone in shot.scene.tones)]


def loudness(shot: Snapshot) -> tuple[float, float]:
    """Return the amplitude of the tones, and the power of the noises, at the nearest microphone."""

    def near(source: Noise | Tone) -> float:
        return float(10 ** (source.level_db / 20) * np.max(spreading(_way_from(shot, source))))

    return sum(near(tone) for tone in shot.scene.tones), sum(near(noise) ** 2 for noise in shot.scene.noises)


def _way_from(shot: Snapshot, source: Placed) -> Paths:
    """Return the direct path from an omnidirectional source to the microphones."""
    transmitter = Transmitters(
        position_m=source.position_at(shot.time_s)[None],
        velocity_m_s=source.velocity_at(shot.time_s)[None],
        facing=np.zeros((1, 3)),
    )
    return without_target(transmitter, shot.receiver, shot.targets)


@dataclass(frozen=True)
class _ToneAtMicrophones:
    """Tone ``a / r · sin(2π f (t - r / c))`` at the microphones; t is the time of the scene."""

    shot: Snapshot
    tone: Tone

    def add_to(self, signals: NDArray[np.float64], first: int) -> None:
        """Add the tone to ``signals``, which start at sample ``first``, in place: (mic, sample) float64."""
        shot, tone = self.shot, self.tone
        way, rate_hz = _way_from(shot, tone), shot.sensor.recording.sample_rate_hz
        amplitude = 10 ** (tone.level_db / 20) * spreading(way)[0]
        # Whole periods of a long time are removed before they cost precision.
        turns = (tone.frequency_hz * (shot.time_s - way.length_m[0] / shot.speed_m_s)) % 1.0
        swing_rad = 2 * math.pi * tone.frequency_hz / rate_hz * np.arange(first, first + signals.shape[1])
        start_rad = 2 * math.pi * turns
        signals += np.outer(amplitude * np.cos(start_rad), np.sin(swing_rad))
        signals += np.outer(amplitude * np.sin(start_rad), np.cos(swing_rad))


def _noise_of(shot: Snapshot, noise: Noise, seed: tuple[int, ...]) -> OverlappingFrames:
    """Return the noise of one source, equal at all microphones except for delay and ``1 / r``.

    Each frame is delayed together with its window, so that distant microphones receive the same noise.
    """
    way, rate_hz = _way_from(shot, noise), shot.sensor.recording.sample_rate_hz
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


def _calls_of(shot: Snapshot, sonar: Sonar) -> NDArray[np.float64]:
    """Return the start times of another sonar's calls that arrive during the record: (call,) float64.

    Times are in seconds after the start of the record, and often negative. Only the direct sound of these calls is
    modelled, because their echoes are far weaker.
    """
    way_s = float(np.mean(_way_from(shot, sonar).length_m)) / shot.speed_m_s
    earliest_s = shot.time_s - way_s - sonar.call.duration_s - sonar.offset_s
    latest_s = shot.time_s - way_s + shot.sensor.recording.duration_s - sonar.offset_s
    numbers = np.arange(max(0, math.ceil(earliest_s / sonar.period_s)), math.floor(latest_s / sonar.period_s) + 1)
    return np.asarray(sonar.offset_s + numbers * sonar.period_s - shot.time_s)


def estimate(sight: Sight) -> Estimate | None:
    """Find the loudest of tones, noises and other sonars."""
    scene, shot = sight.shot.scene, sight.shot
    if not (scene.tones or scene.noises or scene.sonars):
        return None
    total, loudest, reason = 0.0, 0.0, "no source reaches the band"
    for kind in ("tones", "noises", "sonars"):
        for number, source in enumerate(getattr(scene, kind)):
            paths = _way_from(shot, source)
            amplitude = float(10 ** (source.level_db / 20) * np.mean(spreading(paths)))
            direction = -np.mean(paths.arriving, axis=1) @ paths.receiver.axes[0].T
            level = float(sight.coverage(direction)[0])
            if kind == "tones":
                level *= sight.of_tone(amplitude, source.frequency_hz)
            elif kind == "noises":
                level *= sight.of_white_noise(20 * math.log10(amplitude), coherent=True, band_hz=source.band_hz)
            else:
                level *= amplitude * sight.likeness(source.call) * _part_in_window(sight, source)
            total += level
            if level > loudest:
                loudest = level
                level_db = 20 * math.log10(loudest / sight.floor)
                reason = f"{kind}[{number}] reaches {level_db:+.1f} dB relative to the weakest reflector"
    return Estimate(change_db=change_db(np.array([total]), np.array([sight.quietest])), reason=reason)


def _part_in_window(sight: Sight, sonar: Sonar) -> float:
    """Return the largest fraction of another sonar's call that reaches into the image of any measurement."""
    scene, shot = sight.shot.scene, sight.shot
    if scene.count > 1:
        return 1.0  # its calls are not synchronised, so at least one measurement contains one
    way = _way_from(shot, sonar)
    calls_s = _calls_of(shot, sonar) + np.mean(way.length_m) / shot.speed_m_s
    return float(np.max(sight.reach(calls_s), initial=0.0))
