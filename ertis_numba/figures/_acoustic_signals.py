"""Spectrum and spectrogram of a recording, of the mean of its microphones or of a beam."""

import math
from dataclasses import replace

import numpy as np
import scipy
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError
from ertis_numba.figures import _captions
from ertis_numba.figures._canvas import Canvas
from ertis_numba.figures._page import Panel, compose
from ertis_numba.figures.style import angle
from ertis_numba.frames import LevelReference, Measurement
from ertis_numba.geometry import microphones
from ertis_numba.passive import HeardSignals, listen_to
from ertis_numba.settings import Settings

__all__ = ["draw_spectrogram", "draw_spectrum", "power_spectra"]

_RATIO = 0.5
_SPARE_DB = 3.0
_SPACING_HZ = 1e3
_LEAST_SIZE = 90  # Samples of a spectrum at low rates.
_MAX_COLUMNS = 1000
_CHUNK = 2**20  # samples of spectra at a time, so that memory stays bounded


def draw_spectrum(canvas: Canvas, measurement: Measurement, *, direction_deg: tuple[float, float] | None) -> Figure:
    """Draw the level in each bin, of the mean of the microphones or of a beam."""
    power, frequency_hz, _, masked_s = _spectra(measurement, direction_deg)
    reference = _reference(measurement.settings, frequency_hz, direction_deg)
    canvas, level_db = _scaled(canvas, reference, power.mean(axis=1, keepdims=True))

    def paint(axes: Axes) -> None:
        axes.plot(frequency_hz / 1e3, level_db, color=canvas.style.mark)
        axes.set_xlim(0.0, frequency_hz[-1] / 1e3)
        axes.set_ylim(canvas.top_db - canvas.dynamic_range_db, canvas.top_db + _SPARE_DB)
        axes.set_xlabel("frequency (kHz)")
        axes.set_ylabel(f"level of a bin ({canvas.unit})")
        canvas.grid(axes)

    heading = _heading("Spectrum", measurement, direction_deg, frequency_hz, power, masked_s)
    return compose(canvas, heading, [Panel(paint, lambda width_pt: _RATIO * width_pt)])


def draw_spectrogram(canvas: Canvas, measurement: Measurement, *, direction_deg: tuple[float, float] | None) -> Figure:
    """Draw the level in each bin over time, of the mean of the microphones or of a beam."""
    power, frequency_hz, time_s, masked_s = _spectra(measurement, direction_deg)
    canvas, level_db = _scaled(canvas, _reference(measurement.settings, frequency_hz, direction_deg), power)
    half_s = (time_s[-1] - time_s[0]) / max(1, 2 * (len(time_s) - 1)) or 0.5e-3
    half_hz = frequency_hz[1] / 2
    edges = (time_s[0] - half_s, time_s[-1] + half_s, -half_hz, frequency_hz[-1] + half_hz)
    extent = (1e3 * edges[0], 1e3 * edges[1], edges[2] / 1e3, edges[3] / 1e3)

    def paint(axes: Axes) -> AxesImage:
        shown = canvas.show(axes, level_db, extent=extent)
        axes.set_ylim(0.0, frequency_hz[-1] / 1e3)
        axes.set_xlabel("time (ms)")
        axes.set_ylabel("frequency (kHz)")
        canvas.grid(axes)
        return shown

    canvas = replace(canvas, unit=f"{canvas.unit} in a bin")
    heading = _heading("Spectrogram", measurement, direction_deg, frequency_hz, power, masked_s)
    return compose(canvas, heading, [Panel(paint, lambda width_pt: _RATIO * width_pt)])


def power_spectra(
    values: NDArray[np.float32], rate_hz: float
) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float64]]:
    """Return mean squares (bin, time) in bins of about 1 kHz, of (channel, sample), with frequencies and times."""
    # Spectra under a Hann window overlap by three quarters (P. D. Welch, 1967); sums over all bins are the mean square.
    size = scipy.fft.next_fast_len(round(rate_hz / min(_SPACING_HZ, rate_hz / _LEAST_SIZE)), real=True)
    size += size % 2
    if values.shape[1] < size:
        raise ArgumentError(f"the record has {values.shape[1]} samples, but a spectrum needs {size}; record longer")
    window = scipy.signal.get_window("hann", size).astype(np.float32)
    scale = np.full(size // 2 + 1, 2 / (size * float((window.astype(np.float64) ** 2).sum())), np.float32)
    scale[[0, -1]] /= 2  # These frequencies have no negative twin.
    starts = np.arange(0, values.shape[1] - size + 1, size // 4)
    joined = -(-len(starts) // _MAX_COLUMNS)
    power = np.zeros((len(starts), size // 2 + 1), np.float32)
    step = max(1, _CHUNK // size)
    for first in range(0, len(starts), step):
        some = starts[first : first + step]
        for row in values:
            pieces = np.lib.stride_tricks.sliding_window_view(row, size)[some] * window
            power[first : first + step] += np.abs(scipy.fft.rfft(pieces)) ** 2
    power *= scale / np.float32(len(values))
    begins = np.arange(0, len(starts), joined)
    counts = np.diff(np.append(begins, len(starts)))
    mean = np.asarray(np.add.reduceat(power, begins, axis=0) / counts[:, None], np.float32)
    time_s = (np.add.reduceat(starts, begins) / counts + size / 2) / rate_hz
    return mean.T, np.arange(size // 2 + 1) * rate_hz / size, time_s


def _spectra(
    measurement: Measurement, direction_deg: tuple[float, float] | None
) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float64], float]:
    """Return powers, frequencies and times, and the time that is left out because of a call."""
    recording = measurement.settings.recording
    highest_hz = None if recording.is_pdm else recording.sample_rate_hz / 2
    with HeardSignals(measurement.settings, highest_hz=highest_hz) as signals:
        if direction_deg is None:
            values = signals(measurement)
        else:
            values = listen_to(measurement, *direction_deg, signals=signals).samples[None]
        first = signals.n_masked if measurement.stamp.behaviour == "active" else 0
        masked_s = first / signals.rate_hz
        power, frequency_hz, time_s = power_spectra(values[:, first:], signals.rate_hz)
        n_bins = int(np.searchsorted(frequency_hz, signals.band_hz[1], side="right"))  # Beyond, filters attenuate.
        return power[:n_bins], frequency_hz[:n_bins], masked_s + time_s, masked_s


def _reference(
    settings: Settings, frequency_hz: NDArray[np.float64], direction_deg: tuple[float, float] | None
) -> LevelReference:
    """Return the reference of levels; only the sound of a direction has a source level."""
    settings = settings.replace("array.sensitivity_dbfs", microphones(settings.array).sensitivity_dbfs)
    if direction_deg is None:
        settings = settings.replace("passive.focus_m", None)
    return LevelReference.of(settings, frequency_hz)


def _scaled(
    canvas: Canvas, reference: LevelReference, power: NDArray[np.float32]
) -> tuple[Canvas, NDArray[np.float32]]:
    """Return levels over frequency and time, NaN where they are unknown, and a canvas with their scale."""
    power = power * np.asarray(10 ** (reference.offset_db / 10), np.float32)[:, None]
    highest = float(np.nanmax(power, initial=0.0)) or 1.0
    top_db = 10 * math.log10(highest)
    lowest = 10 ** (-canvas.dynamic_range_db / 10)
    level_db = top_db + 10 * np.log10(np.maximum(power / highest, lowest))
    return replace(canvas, top_db=top_db, unit=reference.unit), np.asarray(level_db, np.float32)


def _heading(
    title: str,
    measurement: Measurement,
    direction_deg: tuple[float, float] | None,
    frequency_hz: NDArray[np.float64],
    power: NDArray[np.float32],
    masked_s: float,
) -> _captions.Heading:
    n_mics = int(microphones(measurement.settings.array).enabled.sum())
    heard = f"mean of {n_mics} microphones"
    if direction_deg is not None:
        heard = f"beam to azimuth {angle(direction_deg[0])}, elevation {angle(direction_deg[1])}"
    bins = f"bins of {_captions.number(frequency_hz[1] / 1e3)} kHz"
    unknown = _captions.unknown_levels(_reference(measurement.settings, frequency_hz, direction_deg).offset_db)
    parts = (heard, bins, *unknown, *_captions.left_out(masked_s))
    return _captions.of_measurement(title, measurement.settings, measurement.stamp, *parts, values=np.sqrt(power))
