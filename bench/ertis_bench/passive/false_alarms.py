"""False alarms of bearings in noise without sources, relative to the requested rates.

The noise is drawn as long float32 records, which are cut into measurements. With one-bit microphones, whose noise is
also white in the band, a trial would take ten times as long.
"""

import concurrent.futures
import multiprocessing
from collections.abc import Callable, Iterator
from typing import Any, Final, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_bench.passive.bearings import BAND_HZ, NOISE_BAND_HZ, plane_wave_settings
from ertis_numba.base.forks import usable_cores
from ertis_numba.frames import Measurement, Stamp
from ertis_numba.geometry import microphones
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.passive import AcousticCamera, BearingFinder
from ertis_numba.settings import Settings

__all__ = [
    "ASKED",
    "CASES",
    "CONFIDENCE",
    "NoiseCase",
    "alarms",
    "coherence",
    "interval",
    "measure",
    "measurements",
]

ASKED: Final = (0.3, 0.1, 0.01)
"""Requested probabilities that noise alone yields any bearing."""

CONFIDENCE: Final = 0.95


class NoiseCase(NamedTuple):
    """Noise, and the maps that are searched."""

    name: str
    diffuse: float
    averages: int


CASES: Final = (
    NoiseCase("microphones", 0.0, 1),
    NoiseCase("surroundings", 0.999, 1),
    NoiseCase("surroundings", 0.999, 10),
)
"""Noise of the microphones themselves, and diffuse noise 30 dB above it."""

_RMS: Final = 0.01
_STRIP: Final = 16  # Bins of a measurement, 0.4 kHz, that share one coherence.
_CHUNK: Final = 50  # Trials of a worker process in one piece.


def measure(*, trials: int, seed: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Count the maps of noise without sources that yield a bearing.

    Returns
    -------
    dict
        ``cases``: name, share of diffuse sound, averages, and ``rates``, with the requested rate, the number of maps
        with a bearing, and the limits of the confidence interval of their share.
    """
    rows = []
    context = multiprocessing.get_context("spawn")  # Threads of kernels do not survive a fork.
    with concurrent.futures.ProcessPoolExecutor(usable_cores(), mp_context=context) as pool:
        for case in CASES:
            pieces = [(case, seed, first, min(_CHUNK, trials - first)) for first in range(0, trials, _CHUNK)]
            counts = np.sum(list(pool.map(alarms, *zip(*pieces, strict=True))), axis=0)
            rates = [
                {"asked": asked, "alarms": int(count), "interval": interval(int(count), trials)}
                for asked, count in zip(ASKED, counts, strict=True)
            ]
            say(f"{case.name}, {case.averages} averaged: {', '.join(map(str, counts))} of {trials} maps")
            rows.append({**case._asdict(), "rates": rates})
    return {"trials": trials, "band_hz": BAND_HZ, "cases": rows}


def interval(count: int, trials: int) -> tuple[float, float]:
    """Return the limits of the confidence interval of a share (C. Clopper and E. Pearson, 1934)."""
    found = scipy.stats.binomtest(count, trials).proportion_ci(CONFIDENCE, method="exact")
    return float(found.low), float(found.high)


def alarms(case: NoiseCase, seed: int, first: int, count: int) -> list[int]:
    """Return the number of maps with a bearing at each requested rate, the highest first."""
    settings, counts = plane_wave_settings().replace("passive.resolution_hz", None), [0] * len(ASKED)
    with AcousticCamera(settings, "cpu", threads=1, check=False) as camera:
        finders = [BearingFinder(camera, false_alarm=asked, top=1) for asked in ASKED]
        for trial in range(first, first + count):
            camera.reset()
            for heard in measurements(settings, case, seed=(seed, CASES.index(case), trial)):
                camera.add(heard)
            for place, finder in enumerate(finders):
                if not finder.find():  # Lower rates then yield nothing either.
                    break
                counts[place] += 1
    return counts


def measurements(settings: Settings, case: NoiseCase, *, seed: tuple[int, ...]) -> Iterator[Measurement]:
    """Yield the measurements of a map: parts of one record of noise with the requested coherence."""
    recording = settings.recording
    n_samples, n_mics = recording.n_samples * case.averages, len(microphones(settings.array).enabled_positions_m)
    n_strip = _STRIP * case.averages
    first, last = (round(edge_hz * n_samples / recording.sample_rate_hz / n_strip) for edge_hz in NOISE_BAND_HZ)
    centres_hz = (np.arange(first, last) + 0.5) * n_strip * recording.sample_rate_hz / n_samples
    drawn = np.random.default_rng(seed).standard_normal((len(centres_hz), n_mics, 2 * n_strip))
    strips = np.linalg.cholesky(coherence(settings, centres_hz, case.diffuse)) @ drawn
    spectra = np.zeros((n_mics, n_samples // 2 + 1), np.complex128)
    rows = np.ascontiguousarray(strips.transpose(1, 0, 2)).reshape(n_mics, -1).view(np.complex128)
    spectra[:, first * n_strip : last * n_strip] = rows
    heard = scipy.fft.irfft(spectra, n_samples)
    heard *= _RMS / np.sqrt((heard**2).mean())
    stamp = Stamp(behaviour="passive")
    for part in np.split(heard.T.astype(np.float32), case.averages):
        yield Measurement(np.ascontiguousarray(part), settings, stamp)


def coherence(settings: Settings, frequency_hz: NDArray[np.float64], diffuse: float) -> NDArray[np.float64]:
    """Return the coherence of the microphones, ``sin(k d) / (k d)`` in the diffuse part: (frequency, mic, mic)."""
    positions_m = microphones(settings.array).enabled_positions_m
    apart_s = np.linalg.norm(positions_m[:, None] - positions_m, axis=-1) / sound_speed_m_s(settings.air)
    of_diffuse_sound = np.sinc(2 * apart_s * frequency_hz[:, None, None])
    return np.asarray(diffuse * of_diffuse_sound + (1 - diffuse) * np.eye(len(positions_m)))
