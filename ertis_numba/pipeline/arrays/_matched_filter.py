"""Matched filter of signals."""

import math
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.chain.matched_filter import MatchedFilter
from ertis_numba.chain.time_window import TimeWindow
from ertis_numba.geometry.waveform import integer_taps, matched_guard_s
from ertis_numba.kernels import fft
from ertis_numba.pipeline.arrays._device import band_of, on_device, require_no_integers
from ertis_numba.settings import Call, Processing, Recording, Settings

__all__ = ["matched_filter"]


def matched_filter(
    signals: ArrayLike,
    *,
    sample_rate_hz: float,
    call: Call | ArrayLike,
    band_edges_hz: tuple[float, float] | None = None,
    decimation: int = 1,
    device: str = "auto",
    threads: int | None = None,
) -> NDArray[np.complex64]:
    """Compress echoes of a call and return analytic signals.

    The filter is the conjugate spectrum of the call within its band. It is scaled so that a full-scale echo has an
    envelope of 1. The peak of an echo lies at the sample at which the echo begins.

    Parameters
    ----------
    signals : (..., sample) float
        Real signals, such as those of `demodulate`.
    sample_rate_hz : float
        Rate of the signals in hertz, more than twice the call's highest frequency.
    call : Call or (sample,) float
        Emitted call. An array is a waveform at ``sample_rate_hz``, of 17 to 4096 samples.
    band_edges_hz : (low, high), optional
        Frequencies in hertz at which the filter reaches 0. By default, each lies 5 kHz outside the call's band, or half
        of the band's lowest frequency if that is less.
    decimation : int, default 1
        Decimation that `demodulate` applied. The call is sampled at ``decimation * sample_rate_hz``, so that a call
        without ramps does not alias.
    device : {"auto", "cpu", "cuda", "numpy"}
        Compute device, as for `Pipeline`.
    threads : int, optional
        Number of threads; all cores by default.

    Returns
    -------
    (..., sample) complex64
        Analytic signals at the same rate and of the same length.

    Raises
    ------
    ArgumentError
        An argument has another type, shape or range than listed above.
    DeviceError
        The device is not available.

    Examples
    --------
    An echo that begins at sample 1000:

    >>> import numpy as np
    >>> import ertis_numba as ertis
    >>> from ertis_numba.settings import Call
    >>> from ertis_numba.geometry.waveform import call_samples
    >>> echo = call_samples(Call())
    >>> signal = np.zeros(4000)
    >>> signal[1000 : 1000 + len(echo)] = 0.5 * echo
    >>> matched = ertis.matched_filter(signal, sample_rate_hz=450e3, call=Call())
    >>> int(np.argmax(np.abs(matched))), round(float(np.abs(matched).max()), 2)
    (1000, 0.5)
    """
    rate_hz = checks.positive("sample_rate_hz", sample_rate_hz)
    checks.integer("decimation", decimation, 1, 1000)
    given = _real("signals", signals)
    settings = _call_settings(_call(call, rate_hz), rate_hz, decimation, band_edges_hz)
    rows = given.reshape(-1, given.shape[-1])
    n_samples = rows.shape[1]
    guard_s = settings.call.end_s + 2 * matched_guard_s(settings)
    n_fft = int(scipy.fft.next_fast_len(n_samples + math.ceil(guard_s * rate_hz) + 1))
    window = TimeWindow.from_start(n_samples, n_fft=n_fft, n_outputs=n_fft)
    padded = np.zeros((len(rows), n_fft), dtype=np.float32)
    padded[:, :n_samples] = rows
    unfiltered = integer_taps(np.ones(1))
    with on_device(device, threads) as here:
        stage = MatchedFilter(
            settings,
            window,
            here.kernels,
            here.memory,
            taps=unfiltered,
            n_mics=len(rows),
            gain=lambda frequency_hz: np.ones((1, len(frequency_hz)), dtype=np.complex128),
        )
        sent = here.memory.table(padded)
        analytic = here.memory.zeros(stage.shape, np.complex64)
        transforms = fft.plan(here.kernels.transforms, sent, analytic, zeros=here.memory.zeros, stream=here.lane.stream)
        stage(transforms, analytic, threads=here.threads)
        filtered = here.fetched(analytic)
    return np.ascontiguousarray(filtered[:, 0, :n_samples]).reshape(given.shape)


def _call(call: Call | ArrayLike, rate_hz: float) -> Call:
    """Return a call; an array is its waveform."""
    if isinstance(call, Call):
        call.require_samples()
        return call
    waveform = np.asarray(call)
    if waveform.ndim != 1 or waveform.dtype.kind not in "fiu":
        raise ArgumentError(
            f"call holds {waveform.dtype} of shape {waveform.shape}; use a Call, or a waveform of shape (sample,)"
        )
    try:
        return Call(waveform=tuple(waveform.tolist()), sample_rate_hz=rate_hz)
    except ArgumentError as error:
        raise ArgumentError(str(error).replace("call.waveform", "call").replace("call.", "")) from error


def _call_settings(call: Call, rate_hz: float, decimation: int, band_edges_hz: tuple[float, float] | None) -> Settings:
    """Return settings whose signals have a rate, so that the matched filter is that of a pipeline."""
    if rate_hz <= 2 * call.high_frequency_hz:
        raise ArgumentError(
            f"sample_rate_hz is {rate_hz:g}; use more than twice the call's highest frequency of "
            f"{call.high_frequency_hz:g} Hz"
        )
    edges_hz = None if band_edges_hz is None else band_of("band_edges_hz", band_edges_hz)
    try:
        return Settings(
            call=call,
            recording=Recording(sample_rate_hz=rate_hz * decimation),
            processing=Processing(range_decimation=decimation, decimation=decimation, band_edges_hz=edges_hz),
        )
    except ArgumentError as error:
        raise ArgumentError(str(error).replace("processing.band_edges_hz", "band_edges_hz")) from error


def _real(name: str, signals: ArrayLike) -> NDArray[Any]:
    given = np.asarray(signals)
    if not given.ndim or given.dtype.kind not in "fiu" or not given.size:
        raise ArgumentError(
            f"{name} holds {given.dtype} of shape {given.shape}; pass real numbers of shape (..., sample)"
        )
    require_no_integers(name, given)
    checks.finite_array(name, given)
    return given
