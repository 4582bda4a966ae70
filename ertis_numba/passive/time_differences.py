"""Time differences of arrival between pairs of microphones, by generalised cross-correlation."""

import itertools
import math
from typing import Final, Literal, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba import checks
from ertis_numba.air import sound_speed_m_s
from ertis_numba.errors import ArgumentError
from ertis_numba.frames import Measurement
from ertis_numba.geometry import microphones
from ertis_numba.passive.heard_signals import HeardSignals

__all__ = ["TimeDifference", "Weighting", "time_differences"]

Weighting = Literal["phat", "scot", "none"]

_WEIGHTINGS: Final = ("phat", "scot", "none")
_FINER: Final = 8  # Samples of the correlation per sample of the signals.
_MIN_BLOCK: Final = 8
_MAX_BLOCK: Final = 1e15  # More than any record has.
_TINY: Final = 1e-30
_MAX_COHERENCE: Final = 1 - 1e-9
_INDEPENDENT: Final = 0.947  # Share of independent blocks: neighbours have a correlation of 1/6 under Hann windows.


class TimeDifference(NamedTuple):
    """Time difference of the sound at two microphones.

    Attributes
    ----------
    first, second : int
        Rows of the signals: among enabled microphones, for a measurement.
    delay_s : float
        Time by which the sound arrives later at the second, in seconds.
    uncertainty_s : float
        Standard deviation in seconds: the Cramér-Rao bound at the measured coherence. Infinite without coherence, and
        with fewer than three blocks, which cannot show it.
    peak : float
        Correlation at the delay, relative to that of equal signals.
    """

    first: int
    second: int
    delay_s: float
    uncertainty_s: float
    peak: float


def time_differences(
    heard: Measurement | NDArray[np.float32],
    *,
    rate_hz: float | None = None,
    weighting: Weighting = "phat",
    band_hz: tuple[float, float] | NDArray[np.float64] | None = None,
    max_delay_s: float | None = None,
    resolution_hz: float = 1e3,
) -> list[TimeDifference]:
    """Return the time difference of arrival of each pair of microphones, by generalised cross-correlation.

    The cross-spectrum G of two signals is averaged over blocks under Hann windows that overlap by half. The correlation
    of ``G / |G|`` (``phat``), ``G / √(G₁₁ G₂₂)`` (``scot``) or G (``none``) has its largest maximum at the delay (C.
    Knapp and G. Carter, The generalized correlation method for estimation of time delay, 1976). A parabola interpolates
    it between samples. The uncertainty is that of the same work: ``1 / √(2 T ∫ ω² γ² / (1 − γ²) df)`` for the time T
    and the measured coherence γ², corrected for its bias. It holds if the largest maximum is the right one; in weak or
    narrow-band sound, another may be larger.

    Parameters
    ----------
    heard : Measurement or (mic, sample) float32
        Signals, or a measurement. Calibrated gains and delays of a measurement are removed.
    rate_hz : float, optional
        Sample rate of signals in hertz.
    weighting : {"phat", "scot", "none"}
        Weighting of frequencies; ``phat`` by default.
    band_hz : (low, high), optional
        Band in hertz; that of all bands of ``settings.passive`` for a measurement, else all frequencies.
    max_delay_s : float, optional
        Largest delay in seconds; that of sound along the distance of the microphones for a measurement, else half of a
        block.
    resolution_hz : float
        Spacing of frequencies in hertz; 1000 by default. A block lasts one period of it.

    Returns
    -------
    list of TimeDifference
        One for each pair: (0, 1), (0, 2), …, (1, 2), ….

    Raises
    ------
    ArgumentError
        There are fewer than two microphones, a rate is missing or superfluous, or an argument is outside its limits.
    DataError
        The measurement is not valid.

    Examples
    --------
    >>> import numpy as np
    >>> import ertis_numba as ertis
    >>> noise = np.random.default_rng(0).standard_normal(5000).astype(np.float32)
    >>> (found,) = ertis.time_differences(np.stack([noise[3:], noise[:-3]]), rate_hz=100e3)
    >>> round(found.delay_s * 1e6, 1)
    30.0
    """
    checks.choice("weighting", weighting, _WEIGHTINGS)
    if isinstance(heard, Measurement):
        if rate_hz is not None:
            raise ArgumentError("rate_hz is given, but a measurement has its own rate; leave it out")
        signals = _of_measurement(heard)
    else:
        if rate_hz is None:
            raise ArgumentError("rate_hz is missing; give the sample rate of the signals")
        signals = _Signals(_of_array(heard), checks.positive("rate_hz", rate_hz), (0.0, rate_hz / 2))
    n_mics, n_samples = signals.rows.shape if signals.rows.ndim == 2 else (0, 0)
    if n_mics < 2 or n_samples < _MIN_BLOCK:
        raise ArgumentError(
            f"heard has shape {signals.rows.shape}; give {_MIN_BLOCK} samples or more of two microphones or more"
        )
    checks.positive("resolution_hz", resolution_hz)
    n_block = round(min(signals.rate_hz / resolution_hz, _MAX_BLOCK))
    if not _MIN_BLOCK <= n_block <= n_samples:
        raise ArgumentError(
            f"resolution_hz is {resolution_hz:g}, which needs {n_block} of {n_samples} samples; give a number from "
            f"{signals.rate_hz / n_samples:.4g} to {signals.rate_hz / _MIN_BLOCK:.4g}"
        )
    if isinstance(band_hz, np.ndarray):  # such as a row of AcousticCamera.band_hz
        band_hz = tuple(band_hz.tolist())
    correlator = _Correlator(signals, n_block, signals.band_hz if band_hz is None else band_hz, weighting)
    if max_delay_s is not None:
        checks.positive("max_delay_s", max_delay_s)
    return [
        correlator.pair(first, second, most_s=max_delay_s) for first, second in itertools.combinations(range(n_mics), 2)
    ]


class _Signals(NamedTuple):
    """Signals of microphones, with their calibrated delays and their positions, if known."""

    rows: NDArray[np.float32]
    rate_hz: float
    band_hz: tuple[float, float]
    delay_s: NDArray[np.float64] | None = None
    positions_s: NDArray[np.float64] | None = None  # relative to the speed of sound


def _of_array(heard: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return signals in single precision; refuse all but finite real numbers."""
    try:
        rows = np.asarray(heard)
    except ValueError:  # rows of different lengths
        rows = np.asarray(None)
    if rows.dtype.kind not in "iuf":
        raise ArgumentError(
            f"heard is of type {type(heard).__name__}; give a Measurement, or real numbers with axes microphone, sample"
        )
    with np.errstate(over="ignore"):  # finite_array reports what exceeds single precision
        rows = rows.astype(np.float32)
    checks.finite_array("heard", rows)
    return rows


def _of_measurement(measurement: Measurement) -> _Signals:
    settings = measurement.settings
    layout = microphones(settings.array)
    positions_s = layout.enabled_positions_m / sound_speed_m_s(settings.air)
    with HeardSignals(settings) as reader:
        return _Signals(
            reader(measurement), reader.rate_hz, reader.band_hz, layout.delay_s[layout.enabled], positions_s
        )


class _Correlator:
    """Spectra of blocks of signals, and the correlation of pairs of them."""

    def __init__(self, signals: _Signals, n_block: int, band_hz: tuple[float, float], weighting: Weighting) -> None:
        rate_hz = signals.rate_hz
        checks.interval("band_hz", band_hz, 0.0, rate_hz / 2)
        self._frequency_hz = np.fft.rfftfreq(n_block, 1 / rate_hz)
        self._chosen = (self._frequency_hz >= band_hz[0]) & (self._frequency_hz <= band_hz[1])
        self._chosen &= (self._frequency_hz > 0) & (self._frequency_hz < rate_hz / 2)
        if not self._chosen.any():
            raise ArgumentError(
                f"band_hz {band_hz[0]:g} to {band_hz[1]:g} contains none of the frequencies {self._frequency_hz[1]:g} "
                "Hz apart; give a wider band, or a smaller resolution_hz"
            )
        pieces = np.lib.stride_tricks.sliding_window_view(signals.rows, n_block, axis=1)[:, :: n_block // 2]
        window = scipy.signal.get_window("hann", n_block)
        self._spectra = scipy.fft.rfft(pieces * window, axis=2)
        self._power = (np.abs(self._spectra) ** 2).mean(axis=1)
        self._signals, self._n_block, self._weighting = signals, n_block, weighting
        self._rate_hz, self._duration_s = rate_hz, signals.rows.shape[1] / rate_hz

    def pair(self, first: int, second: int, *, most_s: float | None) -> TimeDifference:
        """Return the time difference of two signals, up to a largest one."""
        cross = (self._spectra[second] * self._spectra[first].conj()).mean(axis=0)
        delay_s, positions_s = self._signals.delay_s, self._signals.positions_s
        if delay_s is not None:
            cross = cross * np.exp(2j * np.pi * self._frequency_hz * (delay_s[second] - delay_s[first]))
        if most_s is None and positions_s is not None:
            most_s = float(np.linalg.norm(positions_s[second] - positions_s[first])) + 1 / self._rate_hz
        if most_s is None:
            most_s = self._n_block / self._rate_hz / 2
        scale = np.sqrt(self._power[first] * self._power[second])
        size = np.maximum({"phat": np.abs(cross), "scot": scale, "none": np.ones_like(scale)}[self._weighting], _TINY)
        weighted = np.where(self._chosen, cross / size, 0)
        most = self._chosen.sum() if self._weighting == "phat" else (scale / size)[self._chosen].sum()
        n_fine = _FINER * self._n_block
        correlation = scipy.fft.irfft(weighted, n_fine) * n_fine / 2
        reach = max(1, int(min(most_s * self._rate_hz * _FINER, n_fine // 2 - 2)))
        lags = np.arange(-reach, reach + 1)
        top = int(lags[np.argmax(correlation[lags])])
        before, here, after = correlation[[top - 1, top, top + 1]]
        curvature = before - 2 * here + after
        shift = float(np.clip(0.5 * (before - after) / curvature, -0.5, 0.5)) if curvature < 0 else 0.0
        found_s = (top + shift) / (_FINER * self._rate_hz)
        return TimeDifference(first, second, found_s, self._uncertainty_s(cross, scale), float(here / max(most, _TINY)))

    def _uncertainty_s(self, cross: NDArray[np.complex128], scale: NDArray[np.float64]) -> float:
        """Return the Cramér-Rao bound at the coherence of the chosen frequencies."""
        n_blocks = _INDEPENDENT * self._spectra.shape[1]
        if n_blocks <= 2:
            return math.inf
        coherence = (np.abs(cross) / np.maximum(scale, _TINY))[self._chosen] ** 2
        coherence = np.minimum(coherence, _MAX_COHERENCE)
        # The mean of γ² / (1 − γ²) as measured in n blocks is (1 + n γ² / (1 − γ²)) / (n − 2).
        ratio = ((n_blocks - 2) * coherence / (1 - coherence) - 1) / n_blocks
        omega = 2 * np.pi * self._frequency_hz[self._chosen]
        spacing_hz = self._rate_hz / self._n_block
        information = 2 * self._duration_s * spacing_hz * float((omega**2 * ratio).sum())
        return 1 / math.sqrt(information) if information > 0 else math.inf
