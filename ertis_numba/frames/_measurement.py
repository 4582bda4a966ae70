"""Measurements, and the signals of their microphones."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.frames._stamp import Stamp
from ertis_numba.frames._xarray import data_array
from ertis_numba.settings import Settings

if TYPE_CHECKING:
    import xarray

__all__ = ["Measurement", "MicrophoneSignals"]


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """Samples of all microphones for one emission.

    Attributes
    ----------
    data : (sample,) or (sample, word) uint8 to uint64; (sample, channel) int16 or float32
        PDM: one word per clock tick, in which bit m, least significant first, is channel m. An array with more
        channels than a word has bits needs several words per sample. PCM: one number per channel, if
        ``settings.recording.encoding`` is ``int16`` or ``float32``.
    settings : Settings
        Settings of the sensor.
    stamp : Stamp
        Origin of the measurement.

    Raises
    ------
    ArgumentError
        An attribute has another type.

    Examples
    --------
    >>> import numpy as np
    >>> import ertis_numba as ertis
    >>> settings = ertis.Settings.from_preset("short_25_50")
    >>> words = np.zeros(settings.recording.n_samples, np.uint32)
    >>> ertis.Measurement(words, settings, ertis.Stamp(sequence=3)).stamp.sequence
    3
    """

    data: NDArray[Any]
    settings: Settings
    stamp: Stamp = Stamp()

    def __post_init__(self) -> None:
        checks.instance("data", self.data, np.ndarray, "a recording contains, or numpy.asarray makes")
        checks.instance("settings", self.settings, Settings, "a recording contains, or Settings.from_preset returns")

    def to_xarray(self) -> "xarray.DataArray":
        """Return the samples as an `xarray.DataArray`, with the names that recordings have.

        Returns
        -------
        xarray.DataArray
            ``pdm`` of dimensions ``sample`` and, for several words, ``word``; or ``pcm`` of dimensions ``sample`` and
            ``microphone``. The scalar coordinate ``time`` joins several of them by
            ``xarray.concat(arrays, "time")``. Settings and the rest of the stamp are attributes. Memory is shared.

        Raises
        ------
        ArgumentError
            xarray is not installed (extra ``xarray``).

        Examples
        --------
        >>> import ertis_numba as ertis
        >>> with ertis.open_recording("reflectors.h5") as recording:
        ...     recording[0].to_xarray().dims
        ('sample',)
        """
        pcm = not self.settings.recording.is_pdm
        dims = ("sample", "microphone" if pcm else "word")[: self.data.ndim]
        channels = np.arange(self.data.shape[1] if pcm else 0, dtype=np.int32)
        return data_array(
            "pcm" if pcm else "pdm",
            self.data,
            dims,
            {"microphone": ("microphone", channels, "channel", "")} if pcm else {},
            about="PCM samples" if pcm else "PDM words; bit m, least significant first, is channel m",
            settings=self.settings,
            stamp=self.stamp,
        )


@dataclass(frozen=True, slots=True, eq=False)
class MicrophoneSignals:
    """Signals of the enabled microphones of one measurement, before beamforming.

    Attributes
    ----------
    demodulated : (mic, sample) float32
        Low-passed and decimated signals, divided by the calibrated gains; full scale is 1. Own filters are not applied.
    matched : (mic, sample) complex64
        Analytic signals after the call's matched filter and own filters. An echo has its peak at the sample at which it
        begins; a full-scale echo has an envelope of 1.
    time_s : (sample,) float64
        Time since the start of the emission in seconds.
    sample_rate_hz : float
        Rate of the signals in hertz.
    positions_m : (mic, axis) float64
        Microphone positions x, y, z in the sensor frame in metres.
    delay_s : (mic,) float64
        Calibrated delay of each microphone in seconds; the signals still contain it.
    sound_speed_m_s : float
        Speed of sound in the air of the settings, in metres per second.
    settings : Settings
        Settings of the pipeline.
    stamp : Stamp
        Stamp of the measurement.
    """

    demodulated: NDArray[np.float32]
    matched: NDArray[np.complex64]
    time_s: NDArray[np.float64]
    sample_rate_hz: float
    positions_m: NDArray[np.float64]
    delay_s: NDArray[np.float64]
    sound_speed_m_s: float
    settings: Settings
    stamp: Stamp = Stamp()

    @property
    def range_m(self) -> NDArray[np.float64]:
        """Range of an echo that arrives at the array's centre at each time: (sample,) float64, in metres."""
        return self.sound_speed_m_s * self.time_s / 2
