"""Tones, noise and other sonars."""

import math
from collections.abc import Set as AbstractSet
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ertis_numba.settings import Call
from ertis_numba.simulation.arrivals import Arrivals, gains, rounded_s
from ertis_numba.simulation.effects import acting
from ertis_numba.simulation.estimates import Estimate
from ertis_numba.simulation.image_estimate import Sight
from ertis_numba.simulation.noise_frames import FRAME_S, NoiseFrame, frame_of, frames_between
from ertis_numba.simulation.snapshot import Snapshot
from ertis_numba.simulation.source_paths import AnySource, SourceInScene, all_sources, sources_of
from ertis_numba.simulation.sources import Noise, Sonar, Tone
from ertis_numba.simulation.surroundings import change_db

__all__ = ["arrivals", "estimate", "frames", "loudness", "sounds"]

Floats = NDArray[np.float64]
_EARLIER = 1.5  # longest way of sound from a moving source, relative to its way at the start of the measurement
_AT_ONCE = 2**22  # paths × microphones × samples whose times of emission are computed at a time


def arrivals(shot: Snapshot, active: AbstractSet[str], frequency_hz: Floats, found: list[Arrivals]) -> list[Arrivals]:
    """Return the arrivals, and the calls of other sonars. Clock drift does not apply to them."""
    for sonar in sources_of(shot, active, Sonar):
        starts_s = _calls_of(sonar, sonar.source)
        if len(starts_s) and len(sonar.paths):
            response = _level(sonar) * sonar.response(frequency_hz)
            parts = [_received(sonar, sonar.source.call, start_s, 0.0, response) for start_s in starts_s]
            found = [*found, *_joined(sonar.source.call, [part for part in parts if len(part.delay_s)])]
    return found


def frames(shot: Snapshot, active: AbstractSet[str], frequency_hz: Floats) -> list[Arrivals]:
    """Return the frames of noises during the record; they travel like calls, with the velocities at their centres."""
    found = []
    for noise in sources_of(shot, active, Noise):
        if not len(noise.paths):
            continue
        response = _level(noise) * noise.response(frequency_hz)
        first_s, last_s = _sent_s(noise)
        seed = shot.scene.seed, *b"interference", noise.number
        for number in frames_between(shot.time_s + first_s, shot.time_s + last_s):
            frame, start_s = frame_of(noise.source, seed, number), number * FRAME_S / 2 - shot.time_s
            found.append(_received(noise, frame, start_s, FRAME_S / 2, response))
    return [each for each in found if len(each.delay_s)]


def sounds(shot: Snapshot, active: AbstractSet[str], seed: tuple[int, ...]) -> "list[_ToneAtMicrophones]":
    """Return the tones of the scene at the microphones."""
    return [_ToneAtMicrophones(tone) for tone in sources_of(shot, active, Tone) if len(tone.paths)]


def loudness(shot: Snapshot, active: AbstractSet[str]) -> tuple[float, float]:
    """Return bounds on the amplitude of the tones and on the power of the noises, at the nearest microphone."""

    def power(source: SourceInScene[Tone] | SourceInScene[Noise]) -> Floats:
        frequency_hz, power = source.spectrum
        return np.asarray(power * np.sum(np.max(source.response(frequency_hz), axis=1, initial=0.0), axis=0) ** 2)

    tones, noises = sources_of(shot, active, Tone), sources_of(shot, active, Noise)
    return (
        sum(float(np.sum(np.sqrt(2 * power(tone)))) for tone in tones),
        sum(float(np.sum(power(noise))) for noise in noises),
    )


def _level(source: SourceInScene[Noise] | SourceInScene[Sonar]) -> float:
    return float(10 ** (source.source.level_db / 20))


def _received(
    source: SourceInScene[Noise] | SourceInScene[Sonar],
    sound: Call | NoiseFrame,
    start_s: float,
    centre_s: float,
    response: Floats,
) -> Arrivals:
    """Return the copies of a call or a frame that leaves at ``start_s``, with the Doppler factor ``centre_s`` later."""
    gain, late_s = gains(source.shot, source.active)
    delay_s, stretch = source.arrival(start_s + centre_s)
    delay_s = delay_s - centre_s * (1.0 if stretch is None else stretch) + late_s
    lasts_s = sound.end_s * (1.0 if stretch is None else float(stretch.max(initial=1.0)))
    heard = (delay_s.max(axis=1) > -lasts_s) & (delay_s.min(axis=1) < source.shot.sensor.recording.duration_s)
    amplitude = gain[:, None] * response[heard]
    return Arrivals(sound, rounded_s(delay_s[heard]), amplitude, None if stretch is None else stretch[heard])


def _joined(call: Call, parts: list[Arrivals]) -> list[Arrivals]:
    """Return the copies of several calls as one entry, if there are any."""
    if not parts:
        return []
    stretches = [part.stretch for part in parts if part.stretch is not None]
    return [
        Arrivals(
            call,
            np.concatenate([part.delay_s for part in parts]),
            np.concatenate([part.amplitude for part in parts]),
            np.concatenate(stretches) if stretches else None,
        )
    ]


def _sent_s(source: SourceInScene[Noise] | SourceInScene[Sonar] | SourceInScene[AnySource]) -> tuple[float, float]:
    """Return the first and the last time at which sound leaves that may arrive in the record, after the snapshot."""
    shot, length_m = source.shot, source.paths.length_m
    return -_EARLIER * float(length_m.max()) / shot.speed_m_s, shot.sensor.recording.duration_s


def _calls_of(source: SourceInScene[Sonar] | SourceInScene[AnySource], sonar: Sonar) -> Floats:
    """Return the start times (call,) of another sonar's calls that may arrive during the record, often negative."""
    if not len(source.paths):
        return np.zeros(0)
    time_s = source.shot.time_s
    first_s, last_s = _sent_s(source)
    first_s -= 2 * sonar.call.end_s
    earliest, latest = ((time_s + each_s - sonar.offset_s) / sonar.period_s for each_s in (first_s, last_s))
    numbers = np.arange(max(0, math.ceil(earliest)), math.floor(latest) + 1)
    return np.asarray(sonar.offset_s + numbers * sonar.period_s - time_s)


@dataclass(frozen=True)
class _ToneAtMicrophones:
    """Tone ``Im Σ a exp(2πi f tₑ)`` at the microphones, summed over paths and partials; tₑ is ``t - r / c`` at rest."""

    tone: SourceInScene[Tone]

    def add_to(self, signals: Floats, first: int) -> None:
        """Add the tone to ``signals``, which start at sample ``first``, in place: (mic, sample) float64."""
        rate_hz = self.tone.shot.sensor.recording.sample_rate_hz
        emission = [act for _, act in acting("emission", self.tone.active)]
        if not emission or not _moves(self.tone):
            self._add_at_rest(signals, np.arange(first, first + signals.shape[1]) / rate_hz)
            return
        paths, shot = self.tone.paths, self.tone.shot
        step = max(1, _AT_ONCE // (len(paths) * len(signals)))
        frequency_hz, amplitude, response = self._partials()
        _, late_s = gains(shot, self.tone.active)
        for begin in range(0, signals.shape[1], step):
            part = signals[:, begin : begin + step]
            received_s = np.arange(first + begin, first + begin + part.shape[1]) / rate_hz - late_s[:, None]
            for act in emission:
                sent_s = act(shot, paths, received_s)
            for partial, each_hz in enumerate(frequency_hz):
                turn = 2 * math.pi * (each_hz * shot.time_s % 1.0 + each_hz * sent_s) + np.angle(amplitude[partial])
                part += abs(amplitude[partial]) * np.einsum("pm,pmt->mt", response[..., partial], np.sin(turn))

    def _add_at_rest(self, signals: Floats, time_s: Floats) -> None:
        """Add the tone of a source at rest: each partial has one amplitude and phase per microphone."""
        shot = self.tone.shot
        delay_s = self.tone.paths.length_m / shot.speed_m_s + gains(shot, self.tone.active)[1]
        frequency_hz, amplitude, response = self._partials()
        for partial, each_hz in enumerate(frequency_hz):
            # Whole periods of a long time are removed before they cost precision.
            turns = (each_hz * (shot.time_s - delay_s)) % 1.0
            heard = amplitude[partial] * np.sum(response[..., partial] * np.exp(2j * math.pi * turns), axis=0)
            swing_rad = 2 * math.pi * each_hz * time_s
            signals += np.outer(heard.real, np.sin(swing_rad)) + np.outer(heard.imag, np.cos(swing_rad))

    def _partials(self) -> tuple[Floats, NDArray[np.complex128], Floats]:
        """Return frequencies and amplitudes at 1 m of the partials, and the response of the paths to each."""
        frequency_hz, amplitude = self.tone.source.partials()
        return frequency_hz, amplitude, self.tone.response(frequency_hz)


def _moves(source: SourceInScene[Tone]) -> bool:
    """Return True if a source, its mirror images or the microphones move."""
    ends = source.paths.transmitter, source.paths.receiver
    return any(np.any(end.velocity_m_s) for end in ends) or bool(np.any(ends[1].spin_rad_s))


def estimate(sight: Sight) -> Estimate | None:
    """Find the loudest of tones, noises and other sonars."""
    middle = sight.shot.at_centre()
    sources = all_sources(middle, sight.active)
    if not sources:
        return None
    total, loudest, reason = 0.0, 0.0, "no source reaches the band"
    for source in sources:
        level = _level_in_image(sight, source)
        total += level
        if level > loudest:
            loudest = level
            level_db = 20 * math.log10(loudest / sight.floor)
            reason = f"{source.name} reaches {level_db:+.1f} dB relative to the weakest reflector"
    return Estimate(change_db=change_db(np.array([total]), np.array([sight.quietest])), reason=reason)


def _level_in_image(sight: Sight, source: SourceInScene[AnySource]) -> float:
    """Return the highest amplitude of a source in the image."""
    paths = source.paths
    if not len(paths):
        return 0.0
    frequency_hz, power = source.spectrum
    power = power * source.response(frequency_hz)[:, 0] ** 2  # (path, frequency)
    if isinstance(source.source, Tone):
        parts = np.sqrt(2 * np.sum(power, axis=0))
        level = sum(sight.of_tone(float(part), float(each)) for part, each in zip(parts, frequency_hz, strict=True))
    elif isinstance(source.source, Noise):
        dbfs = 10 * math.log10(max(float(power.sum()), 1e-40))
        level = sight.of_white_noise(dbfs, coherent=True, band=(frequency_hz, np.sum(power, axis=0)))
    else:
        amplitude = math.sqrt(2 * float(power.sum()))
        level = amplitude * sight.likeness(source.source.call) * _part_in_window(sight, source, source.source)
    direction = np.einsum("pkx,px->pk", paths.receiver.axes, -paths.arriving[:, 0])
    return level * float(np.max(sight.coverage(direction)))


def _part_in_window(sight: Sight, source: SourceInScene[AnySource], sonar: Sonar) -> float:
    """Return the largest fraction of another sonar's call that reaches into the image of any measurement."""
    if sight.shot.scene.count > 1:
        return 1.0  # its calls are not synchronised, so at least one measurement contains one
    delays_s = [source.arrival(start_s)[0].mean() for start_s in _calls_of(source, sonar)]
    return float(np.max(sight.reach(np.array(delays_s)), initial=0.0))
