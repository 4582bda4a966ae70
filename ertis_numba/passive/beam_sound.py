"""Sound of one direction, and its conversion to frequencies that people hear."""

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import Measurement
from ertis_numba.geometry import unit_vectors
from ertis_numba.passive.heard_signals import HeardSignals
from ertis_numba.passive.wave_delays import WaveDelays

__all__ = ["BeamSound", "heterodyned", "listen_to", "time_expanded"]

_MAX_EXPANSION: Final = 1000.0
_PASSED: Final = 0.9  # Highest frequency that keeps its level, relative to half of the sample rate.
_SILENCE: Final = 64  # Samples after a sound, which keep its end apart from its start.
_FINEST_RATIO: Final = 100_000  # Largest denominator of the ratio of two sample rates.


@dataclass(frozen=True, slots=True, eq=False)
class BeamSound:
    """Sound from one direction.

    Attributes
    ----------
    samples : (sample,) float32
        Sound pressure at the centroid of the array; full scale of a microphone is 1.
    rate_hz : float
        Samples per second.

    Raises
    ------
    ArgumentError
        The samples are not one-dimensional, or the rate is not positive.

    Examples
    --------
    >>> import numpy as np
    >>> from ertis_numba.passive import BeamSound
    >>> BeamSound(np.zeros(480, np.float32), 48e3).duration_s
    0.01
    """

    samples: NDArray[np.float32]
    rate_hz: float

    def __post_init__(self) -> None:
        checks.instance("samples", self.samples, np.ndarray, "numpy.asarray makes")
        checks.shape("samples", self.samples.shape, (self.samples.size,))
        checks.positive("rate_hz", self.rate_hz)

    @property
    def duration_s(self) -> float:
        """Duration in seconds."""
        return len(self.samples) / self.rate_hz


def listen_to(
    measurement: Measurement,
    azimuth_deg: float,
    elevation_deg: float = 0.0,
    *,
    signals: HeardSignals | None = None,
) -> BeamSound:
    """Return the sound of a measurement from one direction, by delay-and-sum.

    The signals of the microphones are delayed by exact fractions of a sample, as phase shifts of their spectra, and
    averaged. Sound from the direction keeps its level, and noise of 32 microphones loses 15 dB. If the signals have a
    lower rate than the record, sound above the highest frequency of the bands is left out.

    Parameters
    ----------
    measurement : Measurement
        Measurement whose settings state the air, the distance of the source and the highest frequency (``passive``).
    azimuth_deg, elevation_deg : float
        Direction in the sensor frame in degrees; the elevation is 0 by default.
    signals : HeardSignals, optional
        Demodulator of the measurement's settings, which saves time for many measurements.

    Raises
    ------
    ArgumentError
        An angle is outside its limits, or the bands exceed the record.
    DataError
        The measurement does not match ``signals``.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     sound = ertis.listen_to(recording[0], azimuth_deg=20)
    >>> sound.rate_hz
    225000.0
    """
    checks.instance("measurement", measurement, Measurement, "a recording contains")
    checks.between("azimuth_deg", azimuth_deg, -180.0, 180.0)
    checks.between("elevation_deg", elevation_deg, -90.0, 90.0)
    if signals is None:
        with HeardSignals(measurement.settings) as own:
            return listen_to(measurement, azimuth_deg, elevation_deg, signals=own)
    checks.instance("signals", signals, HeardSignals, "HeardSignals(measurement.settings) makes")
    heard, rate_hz = signals(measurement), signals.rate_hz
    direction = unit_vectors(np.radians([azimuth_deg]), np.radians([elevation_deg]))
    delay_s = WaveDelays(signals.settings)(direction)[0]
    n_samples = heard.shape[1]
    n_fft = scipy.fft.next_fast_len(n_samples + 2 * math.ceil(float(np.abs(delay_s).max()) * rate_hz) + 64, real=True)
    frequency_hz = np.fft.rfftfreq(n_fft, 1 / rate_hz)
    is_decimated = rate_hz < signals.settings.recording.sample_rate_hz
    spectrum = np.zeros(len(frequency_hz), np.complex128)
    for row, delay in zip(heard, delay_s, strict=True):
        spectrum += scipy.fft.rfft(row, n_fft) * np.exp(2j * np.pi * frequency_hz * delay)
    if is_decimated:  # Above, the filter lets aliases pass.
        spectrum[frequency_hz > signals.band_hz[1]] = 0
    samples = scipy.fft.irfft(spectrum / len(heard), n_fft)[:n_samples]
    return BeamSound(samples.astype(np.float32), rate_hz)


def heterodyned(sound: BeamSound, shift_hz: float, rate_hz: float = 48e3) -> BeamSound:
    """Return a sound whose frequencies are lower by a shift, at another sample rate.

    A tone at ``shift_hz + f`` becomes one of f. Tones below the shift become audible too, with ``−f``, as with a bat
    detector. Frequencies farther from the shift than half of the sample rate are removed, and those from 0.9 of this
    distance on are attenuated.

    Parameters
    ----------
    sound : BeamSound
    shift_hz : float
        Shift in hertz, up to half of the sound's rate.
    rate_hz : float
        Sample rate of the result; 48 kHz by default.

    Raises
    ------
    ArgumentError
        An argument is outside its limits.

    Examples
    --------
    >>> import numpy as np
    >>> from ertis_numba.passive import BeamSound, heterodyned
    >>> whistle = BeamSound(np.sin(2 * np.pi * 40e3 * np.arange(22500) / 225e3).astype(np.float32), 225e3)
    >>> heard = heterodyned(whistle, 39e3)
    >>> int(np.abs(np.fft.rfft(heard.samples)).argmax() / heard.duration_s + 0.5)
    1000
    """
    checks.instance("sound", sound, BeamSound, "listen_to returns")
    checks.between("shift_hz", shift_hz, 0.0, sound.rate_hz / 2)
    checks.between("rate_hz", rate_hz, 1e3, sound.rate_hz)
    if not len(sound.samples):
        return BeamSound(sound.samples, rate_hz)
    ratio = Fraction(rate_hz / sound.rate_hz).limit_denominator(_FINEST_RATIO)
    if not ratio:
        raise ArgumentError(f"rate_hz is {rate_hz:g}, too low for a sound of {sound.rate_hz:g} Hz; use a higher rate")
    n_samples = math.ceil(len(sound.samples) * ratio)
    size = ratio.denominator * math.ceil((len(sound.samples) + _SILENCE) / ratio.denominator)
    time_s = np.arange(size) / sound.rate_hz
    padded = np.pad(sound.samples.astype(np.float64), (0, size - len(sound.samples)))
    spectrum = scipy.fft.fft(scipy.signal.hilbert(padded) * np.exp(-2j * np.pi * shift_hz * time_s))
    n_kept = size * ratio.numerator // ratio.denominator
    number = np.rint(np.fft.fftfreq(n_kept, 1 / n_kept)).astype(np.intp)
    away = np.abs(number) / (n_kept / 2)
    passed = np.cos(np.pi / 2 * np.clip((away - _PASSED) / (1 - _PASSED), 0, 1)) ** 2
    samples = (scipy.fft.ifft(spectrum[number] * passed).real * float(ratio))[:n_samples]
    return BeamSound(samples.astype(np.float32), rate_hz)


def time_expanded(sound: BeamSound, factor: float) -> BeamSound:
    """Return a sound that is played more slowly, so that its frequencies are lower by a factor.

    Parameters
    ----------
    sound : BeamSound
    factor : float
        Duration of the result relative to that of the sound, 1 to 1000; bat detectors use 10.

    Returns
    -------
    BeamSound
        The same samples at a lower rate.

    Raises
    ------
    ArgumentError
        The factor is outside its limits.

    Examples
    --------
    >>> import numpy as np
    >>> from ertis_numba.passive import BeamSound, time_expanded
    >>> time_expanded(BeamSound(np.zeros(8100, np.float32), 225e3), 10).rate_hz
    22500.0
    """
    checks.instance("sound", sound, BeamSound, "listen_to returns")
    return BeamSound(sound.samples, sound.rate_hz / checks.between("factor", factor, 1.0, _MAX_EXPANSION))
