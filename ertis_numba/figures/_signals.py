"""Signals of the microphones over time, and their matched-filter output over range."""

import math

import numpy as np
import scipy
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.ticker import FixedLocator
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.figures import _captions
from ertis_numba.figures._canvas import Canvas
from ertis_numba.figures._microphone_traces import MicrophoneTraces, echoes, signals
from ertis_numba.figures._page import Panel, compose
from ertis_numba.figures._sampling import join_ranges
from ertis_numba.frames import Measurement
from ertis_numba.settings import Settings

__all__ = ["draw", "draw_echoes", "spectrogram"]

_MAX_TRACES = 64
_COLUMNS = 1200  # of a trace: the least and the greatest of each are drawn
_MAX_SPECTRA = 600  # columns of a spectrogram: of the spectra in each the greatest is drawn
_CHUNK = 2**20  # samples of spectra at a time, so that memory stays bounded
_COMPRESSED = 10 ** (-40 / 20)  # of the loudest; below that, amplitudes are linear
_LOUDEST = 0.999  # share of the samples that stay within their row
_CURVE_EMS = 11.0
_MAX_PLACES = 1000


def draw(canvas: Canvas, measurement: Measurement, *, microphone: int | None) -> Figure:
    """Draw the traces of all microphones or of one, and the mean of their spectrograms."""
    settings, em_pt = measurement.settings, canvas.style.em_pt
    heard = _chosen(signals(measurement), microphone)
    step = -(-len(heard.values) // _MAX_TRACES)  # of a large array some, evenly spaced
    heard = MicrophoneTraces(heard.values[::step], heard.axis, heard.channels[::step])
    rows = len(heard.values)
    some_ms, all_ms = 1e3 * len(heard.axis) / settings.signal_rate_hz, 1e3 * settings.recording.duration_s
    some_in_words, all_in_words = _captions.number(some_ms, 4), _captions.number(all_ms, 4)
    heading = _captions.of_measurement(
        "Microphone signals",
        settings,
        measurement.stamp,
        f"{_captions.number(settings.signal_rate_hz / 1e3, 4)} kHz sample rate",
        f"{all_in_words} ms" if some_ms > 0.999 * all_ms else f"the first {some_in_words} of {all_in_words} ms",
        values=heard.values,
    )
    loudest = float(np.quantile(np.abs(heard.values), _LOUDEST)) or 1.0
    whose = f"mean of {rows} microphones" if rows > 1 else f"microphone {heard.channels[0]}"
    traces = Panel(
        lambda axes: _traces(canvas, axes, heard, loudest),
        lambda width_pt: min(0.84 * width_pt, (8 + 1.1 * rows) * em_pt),
        lambda axes: _row_ticks(axes, heard.channels, em_pt=em_pt),
        f"a row is ±{_captions.number(loudest, 2)} of full scale, compressed",
    )
    spectra = Panel(
        lambda axes: _spectrogram(canvas, axes, heard, settings),
        lambda width_pt: 0.7 * width_pt,
        title=f"spectrogram, {whose}",
    )
    return compose(canvas, heading, [traces, spectra], width_pt=1008.0)


def draw_echoes(canvas: Canvas, measurement: Measurement, *, microphone: int | None) -> Figure:
    """Draw the mean level over range, and below it a row for each microphone."""
    em_pt, heard = canvas.style.em_pt, _chosen(echoes(measurement), microphone)
    range_m, count = heard.axis, len(heard.values)
    every = f" every {_captions.number(1e3 * (range_m[1] - range_m[0]), 2)} mm" if len(range_m) > 1 else ""
    axis = f"{_captions.span(range_m)} m{every}"
    title = "Matched-filter output"
    heading = _captions.of_measurement(title, measurement.settings, measurement.stamp, axis, values=heard.values)
    # A mean is below the strongest, as microphones differ: both parts of the picture have the same 0 dB.
    upper = Panel(
        lambda axes: _curve(canvas, axes, heard),
        lambda width_pt: _CURVE_EMS * em_pt if count > 1 else max(0.35 * width_pt, _CURVE_EMS * em_pt),
        title=f"mean of {count} microphones, and each of them" if count > 1 else f"microphone {heard.channels[0]}",
    )
    lower = Panel(
        lambda axes: _rows(canvas, axes, heard),
        lambda _: min(30.0, 8 + 0.8 * count) * em_pt,
        lambda axes: _row_ticks(axes, heard.channels, em_pt=em_pt),
    )
    return compose(canvas, heading, [upper, lower][: 1 + (count > 1)], stacked=True)


def _chosen(heard: MicrophoneTraces, microphone: int | None) -> MicrophoneTraces:
    """Return the traces of one microphone, or of all."""
    if microphone is None:
        return heard
    place = np.flatnonzero(heard.channels == checks.integer("microphone", microphone, 0))
    if not len(place):
        raise ArgumentError(
            f"microphone {microphone} is none of the {len(heard.channels)} enabled ones; use a number from "
            f"{heard.channels[0]} to {heard.channels[-1]}"
        )
    return MicrophoneTraces(heard.values[place], heard.axis, heard.channels[place])


def _row_ticks(axes: Axes, channels: NDArray[np.int64], *, em_pt: float) -> None:
    """Label the rows 0, 1, … of an axis with their channels, as many as fit."""
    height_pt = axes.bbox.height * 72 / axes.figure.dpi
    step = max(1, math.ceil(len(channels) * 1.6 * em_pt / height_pt))
    step = next(nice for nice in (1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024) if nice >= step)
    places = np.arange(0, len(channels), step)
    axes.yaxis.set_major_locator(FixedLocator(places.tolist()))
    axes.yaxis.set_ticklabels([str(channel) for channel in channels[places]])


def spectrogram(
    heard: MicrophoneTraces, settings: Settings
) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float64]]:
    """Return the power of short spectra, mean over microphones: (frequency, time), with frequencies and times."""
    # The window of `2 √(T / B)` is about as long as the call stays within its bandwidth. Columns of long records are
    # maxima.
    call, rate_hz = settings.call, settings.signal_rate_hz
    swept_hz = call.high_frequency_hz - call.low_frequency_hz
    count = len(heard.axis)
    size = min(count, max(16, round(2 * math.sqrt(call.duration_s / swept_hz) * rate_hz)))
    n_fft = scipy.fft.next_fast_len(4 * size)
    joined = max(1, math.ceil((count - size) / (size / 2) / _MAX_SPECTRA))
    n_spectra = min(joined * _MAX_SPECTRA, count - size + 1)
    starts = np.rint(np.linspace(0, count - size, n_spectra)).astype(np.intp)
    columns = starts.reshape(-1, joined)
    window = np.hanning(size + 2)[1:-1].astype(np.float32)
    frequency_hz = np.arange(n_fft // 2 + 1) * rate_hz / n_fft
    power = np.empty((len(columns), len(frequency_hz)), dtype=np.float32)
    step = max(1, _CHUNK // (joined * n_fft))
    for first in range(0, len(columns), step):
        some = columns[first : first + step]
        summed = np.zeros((some.size, power.shape[1]), dtype=np.float32)
        for values in heard.values:
            pieces = np.lib.stride_tricks.sliding_window_view(values, size)[some.ravel()] * window
            summed += np.abs(scipy.fft.rfft(pieces, n_fft)) ** 2
        power[first : first + step] = summed.reshape(*some.shape, -1).max(axis=1)
    times_s = heard.axis[columns].mean(axis=1) + (size - 1) / 2 / rate_hz
    return power.T / np.float32(len(heard.values)), frequency_hz, times_s


def _traces(canvas: Canvas, axes: Axes, heard: MicrophoneTraces, loudest: float) -> None:
    """Draw a row for each trace, the first on top; louder parts are clipped."""
    linear = max(_COMPRESSED * loudest, 2 * float(np.median(np.abs(heard.values))))  # noise is not enlarged
    values = np.arcsinh(heard.values / linear) / math.asinh(loudest / linear)
    time_ms, low, high = _ends(heard.axis * 1e3, np.clip(values / 2, -0.5, 0.5))
    rows = np.arange(len(values))[:, None]
    xs = np.broadcast_to(np.repeat(time_ms, 2), (len(values), 2 * len(time_ms)))
    # Least and greatest in turn are a line that covers all between them.
    ys = np.stack([rows - high, rows - low], axis=2).reshape(len(values), -1)
    lines = LineCollection(
        list(np.stack([xs, ys], axis=2)),
        colors=canvas.style.mark,
        linewidths=0.5 * canvas.style.line_pt,
        rasterized=True,
    )
    axes.add_collection(lines, autolim=False)
    axes.set_xlim(0.0, heard.axis[-1] * 1e3)
    axes.set_ylim(len(values) - 0.4, -0.6)
    axes.set_xlabel("time (ms)")
    axes.set_ylabel("microphone (channel)")


def _ends(
    axis: NDArray[np.float64], values: NDArray[np.float32]
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float32]]:
    """Return places, least and greatest of so many samples in a row that few are left: (place,), twice (row, place)."""
    step = -(-values.shape[1] // _COLUMNS)
    starts = np.arange(0, values.shape[1], step)
    return axis[starts], np.minimum.reduceat(values, starts, axis=1), np.maximum.reduceat(values, starts, axis=1)


def _spectrogram(canvas: Canvas, axes: Axes, heard: MicrophoneTraces, settings: Settings) -> AxesImage:
    power, frequency_hz, times_s = spectrogram(heard, settings)
    half_s = (times_s[-1] - times_s[0]) / max(1, 2 * (len(times_s) - 1)) or 0.5e-3
    extent = (
        1e3 * (times_s[0] - half_s),
        1e3 * (times_s[-1] + half_s),
        0.0,
        float(frequency_hz[-1]) / 1e3,
    )
    shown = canvas.show(axes, canvas.level_db(np.sqrt(power)), extent=extent)
    axes.set_xlim(0.0, heard.axis[-1] * 1e3)
    axes.set_xlabel("time (ms)")
    axes.set_ylabel("frequency (kHz)")
    canvas.grid(axes)
    return shown


def _curve(canvas: Canvas, axes: Axes, heard: MicrophoneTraces) -> None:
    """Draw the mean power over range, below the strongest of all microphones."""
    mean = np.sqrt(np.mean(np.square(heard.values, dtype=np.float64), axis=0))
    strongest = float(heard.values.max(initial=0.0)) or 1.0
    floor = strongest * 10 ** (-canvas.dynamic_range_db / 20)
    level_db = 20 * np.log10(np.maximum(mean, floor) / strongest)
    axes.plot(heard.axis, level_db, linewidth=0.7 * canvas.style.line_pt, rasterized=True)
    axes.set_ylim(-canvas.dynamic_range_db, 3.0)
    spare_m = 0.0 if len(heard.axis) > 1 else 0.1
    axes.set_xlim(float(heard.axis[0]) - spare_m, float(heard.axis[-1]) + spare_m)
    canvas.grid(axes)
    axes.set_ylabel("dB re strongest")
    if len(heard.values) > 1:
        axes.tick_params(labelbottom=False)
    else:
        axes.set_xlabel("range (m)")


def _rows(canvas: Canvas, axes: Axes, heard: MicrophoneTraces) -> AxesImage:
    """Draw a row for each microphone, the first on top."""
    range_m, level_db = join_ranges(heard.axis, canvas.level_db(heard.values), largest=_MAX_PLACES)
    half_m = float(range_m[-1] - range_m[0]) / max(1, 2 * (len(range_m) - 1)) or 0.05
    rows = len(level_db)
    extent = (float(range_m[0]) - half_m, float(range_m[-1]) + half_m, rows - 0.5, -0.5)
    shown = canvas.show(axes, level_db[::-1], extent=extent)
    spare_m = 0.0 if len(heard.axis) > 1 else 0.1
    axes.set_xlim(float(heard.axis[0]) - spare_m, float(heard.axis[-1]) + spare_m)
    axes.set_xlabel("range (m)")
    axes.set_ylabel("microphone (channel)")
    return shown
