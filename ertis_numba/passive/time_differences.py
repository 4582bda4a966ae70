"""Time differences of arrival between pairs of microphones, by generalised cross-correlation."""

import itertools
import math
from typing import Final, Literal, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import Measurement
from ertis_numba.geometry import microphones
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.passive.heard_signals import HeardSignals

__all__ = ["TimeDifference", "Weighting", "time_differences"]

Weighting = Literal["phat", "scot", "none"]

_WEIGHTINGS: Final = ("phat", "scot", "none")
_FINER: Final = 8  # Samples of the correlation per sample of the signals.
_MIN_BLOCK: Final = 8
_MAX_BLOCK: Final = 1e15  # More than any record has.
_TINY: Final = 1e-30
_BY_CHANCE: Final = 1e-3  # Probability that one frequency looks coherent in noise.
_MANY_BY_CHANCE: Final = 0.01  # Probability that so many frequencies look coherent in noise.
# Approximate power that leaks, by distance in frequencies.
_LEAKED_SHARES: Final = (0.5, 0.1, *(1e-3 * (3 / apart) ** 6 for apart in range(3, 13)))
_N_STEPS: Final = 4
_WIDENED: Final = 3.0
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
        Standard deviation in seconds. Infinite if the signals are not coherent, if there are fewer than three blocks,
        or if the delay is the largest permitted one.
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
    Knapp and G. Carter, The generalized correlation method for estimation of time delay, 1976). Frequencies without
    coherence, and those whose sound may be that of neighbours under the window, are left out. Blocks of the later
    signal are taken later by the delay in whole samples.

    The uncertainty is that of the same work for the weighting W: ``∫ W² ω² G₁₁ G₂₂ (1 − γ²) df / 2 T (∫ W ω² |G| df)²``
    is the variance for the time T and the measured coherence γ², corrected for its bias. Each further maximum at a
    delay Δ from the first one adds ``p Δ²`` for its probability p to be the right one. In weak or narrow-band sound,
    the uncertainty is therefore about that of whole periods. Sound of a steep spectrum, such as 1/f² at 40 dB above
    the noise, needs ``phat`` or ``scot``: unweighted, its errors may exceed the uncertainty.

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
        Largest delay in seconds, half of a block at most; that of sound along the distance of the microphones, and one
        sample, for a measurement, else half of a block.
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
            raise ArgumentError("rate_hz is missing; pass the sample rate of the signals")
        signals = _Signals(_of_array(heard), checks.positive("rate_hz", rate_hz), (0.0, rate_hz / 2))
    n_mics, n_samples = signals.rows.shape if signals.rows.ndim == 2 else (0, 0)
    if n_mics < 2 or n_samples < _MIN_BLOCK:
        raise ArgumentError(
            f"heard has shape {signals.rows.shape}; pass {_MIN_BLOCK} samples or more of two microphones or more"
        )
    checks.positive("resolution_hz", resolution_hz)
    n_block = round(min(signals.rate_hz / resolution_hz, _MAX_BLOCK))
    if not _MIN_BLOCK <= n_block <= n_samples:
        raise ArgumentError(
            f"resolution_hz = {resolution_hz:g} needs blocks of {n_block} samples, but the signals have {n_samples}; "
            f"use {signals.rate_hz / n_samples:.6g} to {signals.rate_hz / _MIN_BLOCK:.6g}"
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
            f"heard is of type {type(heard).__name__}; pass a Measurement, or real numbers with axes microphone, sample"
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
        frequency_hz = np.fft.rfftfreq(n_block, 1 / rate_hz)
        self._chosen = (frequency_hz >= band_hz[0]) & (frequency_hz <= band_hz[1])
        self._chosen &= (frequency_hz > 0) & (frequency_hz < rate_hz / 2)
        if not self._chosen.any():
            raise ArgumentError(
                f"band_hz {band_hz[0]:g} to {band_hz[1]:g} contains none of the frequencies {frequency_hz[1]:g} "
                "Hz apart; use a wider band, or a smaller resolution_hz"
            )
        self._omega = 2 * np.pi * np.asarray(frequency_hz, np.float64)
        largest = np.abs(signals.rows).max()  # Powers of very large or small sound exceed single precision.
        signals = signals._replace(rows=signals.rows / (largest if largest > 0 else np.float32(1)))
        self._signals, self._n_block, self._weighting = signals, n_block, weighting
        self._spectra = [self._spectra_of(row) for row in signals.rows]

    def _spectra_of(self, row: NDArray[np.float32]) -> NDArray[np.complex64]:
        """Return the spectra of the blocks of a signal, (block, frequency)."""
        blocks = np.lib.stride_tricks.sliding_window_view(row, self._n_block)[:: self._n_block // 2]
        window = scipy.signal.get_window("hann", self._n_block).astype(np.float32)
        spectra: NDArray[np.complex64] = scipy.fft.rfft(blocks * window, axis=1)
        return spectra

    def pair(self, first: int, second: int, *, most_s: float | None) -> TimeDifference:
        """Return the time difference of two signals, up to a largest one."""
        signals, rate_hz = self._signals, self._signals.rate_hz
        own_s = 0.0 if signals.delay_s is None else float(signals.delay_s[second] - signals.delay_s[first])
        if most_s is None and signals.positions_s is not None:
            most_s = float(np.linalg.norm(signals.positions_s[second] - signals.positions_s[first])) + 1 / rate_hz
        limit_s = self._n_block / rate_hz / 2
        most_s = limit_s if most_s is None else min(most_s, limit_s)
        rough = self._cross(self._spectra[first], self._spectra[second], 0.0, own_s)
        n_late = round((rough.delay_s(most_s) + own_s) * rate_hz)
        if n_late == 0:
            return rough.result(first, second, most_s)
        # Blocks of the same sound have no error of windows that cut it at different times.
        late = signals.rows[second][max(n_late, 0) :], signals.rows[first][max(-n_late, 0) :]
        n_common = min(each.size for each in late)
        if n_common < 4 * self._n_block:
            return rough.result(first, second, most_s)
        spectra = [self._spectra_of(each[:n_common]) for each in late]
        return self._cross(spectra[1], spectra[0], n_late / rate_hz, own_s).result(first, second, most_s)

    def _cross(
        self, first: NDArray[np.complex64], second: NDArray[np.complex64], late_s: float, own_s: float
    ) -> "_CrossSpectrum":
        """Return the cross-spectrum of blocks, the second of which are late by a time."""
        cross = (second * first.conj()).mean(axis=0, dtype=np.complex128)
        power: list[NDArray[np.float64]] = [
            (np.abs(each) ** 2).mean(axis=0, dtype=np.float64) for each in (first, second)
        ]
        return _CrossSpectrum(
            cross * np.exp(-1j * self._omega * (late_s - own_s)),
            np.sqrt(power[0] * power[1]),
            self._omega,
            self._chosen,
            len(first),
            self._weighting,
        )


class _CrossSpectrum:
    """Cross-spectrum of two signals, weighted at the frequencies where they are coherent."""

    def __init__(
        self,
        cross: NDArray[np.complex128],
        scale: NDArray[np.float64],
        omega: NDArray[np.float64],
        chosen: NDArray[np.bool_],
        n_blocks: int,
        weighting: Weighting,
    ) -> None:
        self._n_blocks, self._omega = _INDEPENDENT * n_blocks, omega
        self._n_fine = _FINER * 2 * (omega.size - 1)
        size, scale = np.abs(cross), np.maximum(scale, _TINY)
        coherence = np.minimum((size / scale) ** 2, _MAX_COHERENCE)
        coherent = chosen & (size > _leaked(size)) & (coherence > self._by_chance(_BY_CHANCE))
        n_chosen = float(chosen.sum())
        self._is_coherent = bool(
            scipy.stats.poisson.sf(coherent.sum() - 1, _BY_CHANCE * n_chosen) < _MANY_BY_CHANCE
            or (coherence[coherent] > self._by_chance(_BY_CHANCE / n_chosen)).any()
        )
        used = coherent if self._is_coherent else chosen
        divisor = np.maximum({"phat": size, "scot": scale, "none": np.ones_like(scale)}[weighting], _TINY)
        self._weighted = np.where(used, cross / divisor, 0)
        self._most = n_chosen if weighting == "phat" else float((scale / divisor)[chosen].sum())
        # The mean of γ² / (1 − γ²) as measured in n blocks is (1 + n γ² / (1 − γ²)) / (n − 2).
        ratio = ((self._n_blocks - 2) * coherence / (1 - coherence) - 1) / self._n_blocks
        # A coherence that noise may reach by chance does not tell which of several maxima is right.
        chance = self._by_chance(_BY_CHANCE) / np.maximum(coherence, _TINY)
        self._evidence = np.abs(self._weighted) * np.maximum(1 - chance, 0)
        # Variance of a component of the weighted spectrum; doubled, as windows correlate it with its neighbours.
        self._noise = np.where(used, np.abs(self._weighted) ** 2 / np.maximum(ratio, _TINY), 0.0) / self._n_blocks

    def _by_chance(self, probability: float) -> float:
        """Return the coherence that noise exceeds with a probability: (1 − γ²)^(n − 1) for n blocks."""
        return 1 - probability ** (1 / (self._n_blocks - 1)) if self._n_blocks > 1 else 1.0

    def _correlation(self, delay_s: float) -> float:
        """Return the correlation at a delay."""
        return float((self._weighted * np.exp(1j * self._omega * delay_s)).real.sum())

    def _maxima_s(self, most_s: float) -> NDArray[np.float64]:
        """Return the delays of the maxima up to a largest delay, to a fraction of a sample, the largest first."""
        step_s = 2 * np.pi / (self._omega[1] * self._n_fine)
        reach = min(int(most_s / step_s), self._n_fine // 2 - 1)
        lags = np.arange(-reach, reach + 1)
        values = (scipy.fft.irfft(self._weighted, self._n_fine) * self._n_fine / 2)[lags]
        beside = np.pad(values, 1, constant_values=-np.inf)
        tops = np.flatnonzero((values >= beside[:-2]) & (values >= beside[2:]))
        found_s: NDArray[np.float64] = lags[tops[np.argsort(-values[tops], kind="stable")]] * step_s
        return found_s

    def delay_s(self, most_s: float) -> float:
        """Return the delay of the largest maximum."""
        return self._refined_s(float(self._maxima_s(most_s)[0]), most_s)

    def _refined_s(self, delay_s: float, most_s: float) -> float:
        """Return the maximum next to a delay by Newton's method, within the limits."""
        for _ in range(_N_STEPS):
            turned = self._weighted * np.exp(1j * self._omega * delay_s)
            curvature = float((self._omega**2 * turned.real).sum())
            if curvature <= 0:
                break
            delay_s -= float((self._omega * turned.imag).sum()) / curvature
        return min(max(delay_s, -most_s), most_s)

    def result(self, first: int, second: int, most_s: float) -> TimeDifference:
        """Return the time difference up to a largest one, and its uncertainty."""
        maxima_s = self._maxima_s(most_s)
        found_s = self._refined_s(float(maxima_s[0]), most_s)
        here = self._correlation(found_s)
        uncertainty_s = self._uncertainty_s(found_s, here, maxima_s[1:]) if abs(found_s) < most_s else math.inf
        return TimeDifference(first, second, found_s, uncertainty_s, here / max(self._most, _TINY))

    def _uncertainty_s(self, found_s: float, here: float, others_s: NDArray[np.float64]) -> float:
        """Return the uncertainty of a maximum beside others."""
        if not self._is_coherent or self._n_blocks <= 2:
            return math.inf
        turned = self._weighted * np.exp(1j * self._omega * found_s)
        curvature = float((self._omega**2 * turned.real).sum())
        if curvature <= 0:
            return math.inf
        variance = float((self._omega**2 * self._noise).sum()) / curvature**2
        # A window widens the band of a sound by up to three frequencies.
        width = self._evidence.sum() ** 2 / (self._evidence**2).sum()
        offset = (self._omega - np.average(self._omega, weights=self._evidence)) * max(0.0, 1 - _WIDENED / width)
        odds, squares = 1.0, 0.0
        for other_s in others_s.tolist():
            apart = np.abs(1 - np.exp(1j * offset * (other_s - found_s))) ** 2
            spread = math.sqrt(float((apart * self._noise).sum()))
            lead = min(here - self._correlation(other_s), float((self._evidence * apart).sum()) / 2)
            wrong = float(scipy.special.ndtr(-lead / max(spread, _TINY)))
            odds += wrong / (1 - wrong)
            squares += wrong / (1 - wrong) * (other_s - found_s) ** 2
        return math.sqrt(variance + squares / odds)


def _leaked(size: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how much each frequency may contain of the sound of others, through a Hann window."""
    leaked = np.zeros_like(size)
    for apart, share in enumerate(_LEAKED_SHARES, start=1):
        np.maximum(leaked[apart:], share * size[:-apart], out=leaked[apart:])
        np.maximum(leaked[:-apart], share * size[apart:], out=leaked[:-apart])
    return leaked
