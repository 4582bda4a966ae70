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
from ertis_numba.passive.correlation import Bins, Correlation
from ertis_numba.passive.heard_signals import HeardSignals

__all__ = ["TimeDifference", "Weighting", "time_differences"]

Weighting = Literal["phat", "scot", "none"]

_WEIGHTINGS: Final = ("phat", "scot", "none")
_MIN_BLOCK: Final = 8
_MAX_BLOCK: Final = 1e15  # More than any record has.
_TINY: Final = 1e-30
_BY_CHANCE: Final = 1e-3  # Probability that one frequency looks coherent in noise.
_MANY_BY_CHANCE: Final = 0.01  # Probability that so many frequencies look coherent in noise.
# Approximate power that leaks, by distance in frequencies.
_LEAKED_SHARES: Final = (0.5, 0.1, *(1e-3 * (3 / apart) ** 6 for apart in range(3, 13)))
_MAX_COHERENCE: Final = 1 - 1e-9
_FALSE_SHARE: Final = 5e-4  # Share of frequencies by chance among the coherent ones.
_ALONE: Final = 0.01  # Probability by chance of coherent neighbours.
_LEAST_LOUD: Final = 2.2  # Effective number of loud blocks, below which the sound may be a single click.
_DISTORTION: Final = 0.3  # Error of the delay of signals of one step, in samples …
_COARSE: Final = 1 / 6  # … and the step relative to their deviation that has no effect.
_LIMITED: Final = 5e-3  # Share of samples at the extremes of a limited signal.
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
        if a single step or click is all they share, or if the delay is the largest permitted one.
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

    The cross-spectrum G of two signals is averaged over blocks under Hann windows that overlap by half. It yields the
    weights of frequencies: ``1 / |G|`` (``phat``), ``1 / √(G₁₁ G₂₂)`` (``scot``) or 1 (``none``). The correlation of
    the whole signals under these weights has its largest maximum at the delay (C. Knapp and G. Carter, The generalized
    correlation method for estimation of time delay, 1976). Frequencies without coherence are left out.

    The uncertainty has the variance ``∫ W² ω² G₁₁ G₂₂ (1 − γ²) df / 2 T (∫ W ω² |G| df)²`` for the weighting W, the
    time T and the coherence γ². Each further maximum at a delay Δ from the first one adds ``p Δ²`` for its probability
    p to be the right one. In weak or narrow-band sound, the uncertainty is therefore about that of whole periods.

    One source without echoes is assumed. If its delay fits the phases of the band significantly worse than the noise
    allows, the misfit widens the uncertainty. Sources or echoes may fit as one where the band does not resolve them
    (less than about 0.2 divided by its width apart), or where it is narrower than a tenth of its frequencies. The error
    of their common delay may then exceed the uncertainty, and so may that of sound of a steep spectrum, such as 1/f² at
    40 dB above the noise, without weighting. For coarse or limited signals, the uncertainty contains up to 0.3 samples.
    Sound that both channels pick up electrically, such as hum or several clicks, looks like a source at delay 0.

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
        heard = signals.rows
        largest = np.abs(heard).max()  # Powers of very large or small sound exceed single precision.
        rows = heard / (largest if largest > 0 else np.float32(1))
        rows -= rows.mean(axis=1, keepdims=True, dtype=np.float64).astype(np.float32)
        rows[np.ptp(heard, axis=1) == 0] = 0  # A constant is no sound.
        signals = signals._replace(rows=rows)
        self._signals, self._n_block, self._weighting = signals, n_block, weighting
        self._spectra = [self._spectra_of(row) for row in rows]
        self._coarse_s = [_distortion(row) / rate_hz for row in heard]

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
        rows = signals.rows[first], signals.rows[second]
        bins = self._bins(self._spectra[first], self._spectra[second])
        found = Correlation(*rows, bins, -own_s, rate_hz)
        n_late = round((found.delay_s(most_s) + own_s) * rate_hz)
        n_common = rows[0].size - abs(n_late)
        if n_late != 0 and n_common >= 4 * self._n_block:
            # Blocks of the same sound have no error of windows that cut it at different times.
            rows = rows[0][max(-n_late, 0) :][:n_common], rows[1][max(n_late, 0) :][:n_common]
            bins = self._bins(*(self._spectra_of(each) for each in rows))
            found = Correlation(*rows, bins, n_late / rate_hz - own_s, rate_hz)
        delay_s, uncertainty_s, peak = found.result(most_s)
        coarse_s = max(self._coarse_s[first], self._coarse_s[second])
        return TimeDifference(first, second, delay_s, math.hypot(uncertainty_s, coarse_s), peak)

    def _bins(self, first: NDArray[np.complex64], second: NDArray[np.complex64]) -> Bins:
        """Return the cross-spectrum of blocks, and the weights of frequencies."""
        cross = (second * first.conj()).mean(axis=0, dtype=np.complex128)
        size = np.abs(cross)
        power: list[NDArray[np.float64]] = [
            (np.abs(each) ** 2).mean(axis=0, dtype=np.float64) for each in (first, second)
        ]
        scale = np.maximum(np.sqrt(power[0] * power[1]), _TINY)
        n_blocks = _INDEPENDENT * len(first)
        coherence = np.minimum((size / scale) ** 2, _MAX_COHERENCE)
        n_free = max(n_blocks - 1, _TINY)
        candidates = self._chosen & (size > _leaked(size))
        chance_of_any = (1 - coherence) ** n_free
        chance = np.where(candidates, chance_of_any, 1.0)
        n_chosen = float(self._chosen.sum())
        n_found = int((chance < _BY_CHANCE).sum())
        is_coherent = bool(
            scipy.stats.poisson.sf(n_found - 1, _BY_CHANCE * n_chosen) < _MANY_BY_CHANCE
            or chance.min() < _BY_CHANCE / n_chosen
        )
        # As many as leave few among them by chance (Y. Benjamini and Y. Hochberg, 1995).
        ordered = np.sort(chance)
        allowed = ordered[ordered <= _FALSE_SHARE * np.arange(1, ordered.size + 1) / n_chosen]
        limit = min(float(allowed[-1]), _BY_CHANCE) if allowed.size else _BY_CHANCE
        # Under the window, sound of one frequency is in its neighbours too, chance is not.
        padded = np.pad(chance_of_any, 1, constant_values=1.0)
        is_alone = np.minimum(padded[:-2], padded[2:]) > _ALONE
        coherent = chance <= np.where(is_alone, _ALONE * limit, limit)
        coherent = coherent if coherent.any() else chance <= limit
        divisor = np.maximum({"phat": size, "scot": scale, "none": np.ones_like(scale)}[self._weighting], _TINY)
        weights = np.where(coherent if is_coherent else self._chosen, 1 / divisor, 0.0)
        most = n_chosen if self._weighting == "phat" else float((scale / divisor)[self._chosen].sum())
        # The mean of γ² / (1 - γ²) as measured in n blocks is (1 + n γ² / (1 - γ²)) / (n - 2).
        measured = coherence / (1 - coherence)
        ratio = np.maximum(((n_blocks - 2) * measured - 1) / n_blocks, 0.0)
        # A coherence that noise may reach by chance does not tell which of several maxima is right.
        by_chance = 1 - _BY_CHANCE ** (1 / n_free)
        evidence = np.maximum(1 - by_chance / np.maximum(coherence, _TINY), 0.0)
        is_known = is_coherent and n_blocks > 2 and self._n_loud(first, second) > _LEAST_LOUD
        return Bins(self._n_block, cross, weights, most, ratio / (1 + ratio), evidence, is_known)

    def _n_loud(self, *spectra: NDArray[np.complex64]) -> float:
        """Return the number of blocks that contain the power: at most 2 if it is a single step or click."""
        numbers = []
        for each in spectra:
            power = np.abs(each[:, self._chosen]) ** 2
            shares = (power / np.maximum(power.mean(axis=0), _TINY)).mean(axis=1, dtype=np.float64)
            numbers.append(float(shares.sum()) ** 2 / max(float((shares**2).sum()), _TINY))
        return min(numbers)


def _distortion(row: NDArray[np.float32]) -> float:
    """Return the error in samples by the harmonics of a coarse or limited signal, which may be aliased."""
    values = np.unique(row)
    if len(values) < 2:
        return 0.0
    limited = (np.count_nonzero((row == values[0]) | (row == values[-1])) - 2) / row.size
    coarseness = float(np.diff(values).min()) / max(float(row.std(dtype=np.float64)), _TINY)
    if limited > _LIMITED:
        return _DISTORTION
    return _DISTORTION * min(coarseness, 1.0) if coarseness > _COARSE else 0.0


def _leaked(size: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how much each frequency may contain of the sound of others, through a Hann window."""
    leaked = np.zeros_like(size)
    for apart, share in enumerate(_LEAKED_SHARES, start=1):
        np.maximum(leaked[apart:], share * size[:-apart], out=leaked[apart:])
        np.maximum(leaked[:-apart], share * size[apart:], out=leaked[:-apart])
    return leaked
