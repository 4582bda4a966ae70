"""Low-pass filter and decimation of one-bit PDM and PCM data."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ertis_numba.base import checks
from ertis_numba.base.constants import MAX_MICROPHONES
from ertis_numba.base.errors import ArgumentError
from ertis_numba.chain.demodulate import Demodulate, DemodulatePdm, FilterPcm
from ertis_numba.chain.time_window import TimeWindow
from ertis_numba.geometry.waveform import decimation_taps, integer_taps
from ertis_numba.pipeline.arrays._device import on_device

__all__ = ["demodulate"]

_PASSBAND: Final = 0.4  # of the output rate, as in scipy.signal.decimate
_SHORT_TAPS_DB: Final = 65.0  # rounding taps to 16 bits would reduce a larger attenuation


def demodulate(
    data: ArrayLike,
    *,
    sample_rate_hz: float,
    decimation: int,
    passband_hz: float | None = None,
    channels: Sequence[int] | None = None,
    stopband_attenuation_db: float = 60.0,
    device: str = "auto",
    threads: int | None = None,
) -> NDArray[np.float32]:
    """Low-pass filter and decimate one-bit PDM or PCM data.

    The filter is a Kaiser-windowed sinc. Its group delay is removed: output sample n lies at input sample
    ``n * decimation``.

    Parameters
    ----------
    data : (sample,) or (sample, word) uint8 to uint64; (sample, channel) bool, int16, float32 or float64
        Unsigned integers are PDM words, in which bit m, least significant first, is channel m. Booleans are PDM bits,
        one column for each channel. Other numbers are PCM; full scale is 32768 for int16 and 1 for floating point.
    sample_rate_hz : float
        PDM clock or PCM rate in hertz.
    decimation : int
        Input samples per output sample, 1 to 1000.
    passband_hz : float, optional
        Highest frequency of interest in hertz: no signal aliases below it. By default 0.4 times the output rate, as in
        `scipy.signal.decimate`.
    channels : sequence of int, optional
        Channels to return, in this order; all by default.
    stopband_attenuation_db : float, default 60
        Attenuation of signals that would alias into the band, 40 to 140 dB.
    device : {"auto", "cpu", "cuda", "numpy"}
        Compute device, as for `Pipeline`.
    threads : int, optional
        Number of threads; all cores by default.

    Returns
    -------
    (mic, sample) float32
        Signals at ``sample_rate_hz / decimation``; full scale is 1.

    Raises
    ------
    ArgumentError
        An argument has another type, shape or range than listed above.
    DeviceError
        The device is not available.

    Examples
    --------
    Two channels of white noise in 8-bit words:

    >>> import numpy as np
    >>> import ertis_numba as ertis
    >>> words = np.random.default_rng(0).integers(0, 4, 45_000, dtype=np.uint8)
    >>> signals = ertis.demodulate(words, sample_rate_hz=4.5e6, decimation=10, channels=[0, 1])
    >>> signals.shape, signals.dtype
    ((2, 4500), dtype('float32'))
    """
    rate_hz = checks.positive("sample_rate_hz", sample_rate_hz)
    checks.integer("decimation", decimation, 1, 1000)
    checks.between("stopband_attenuation_db", stopband_attenuation_db, 40.0, 140.0)
    rows, n_channels, full_scale = _rows_of(np.asarray(data))
    chosen = _channels(channels, n_channels)
    pass_hz = _PASSBAND * rate_hz / decimation if passband_hz is None else checks.positive("passband_hz", passband_hz)
    taps = _low_pass(rate_hz, decimation, pass_hz, stopband_attenuation_db, is_pdm=full_scale is None)
    count = -(-len(rows) // decimation)
    window = TimeWindow.from_start(count, n_fft=count)
    with on_device(device, threads) as here:
        stage: Demodulate
        if full_scale is None:
            stage = DemodulatePdm(chosen, window, here.kernels, here.memory, taps=taps, factor=decimation)
        else:
            stage = FilterPcm(
                chosen, window, here.kernels, here.memory, taps=taps, factor=decimation, full_scale=full_scale
            )
        signals = here.memory.zeros(stage.shape, np.float32)
        stage(here.lane.send(rows), stage.new_room(), signals)
        return here.fetched(signals)


def _rows_of(data: NDArray[Any]) -> tuple[NDArray[Any], int, float | None]:
    """Return data as kernels read them, the number of channels, and the full scale of PCM; None for PDM."""
    kind, size = data.dtype.kind, data.dtype.itemsize
    if data.ndim in {1, 2} and data.size:
        if kind == "u":
            rows = data.reshape(len(data), -1).astype(data.dtype.newbyteorder("="), copy=False)
            return np.require(rows, requirements=["C", "A", "W"]), 8 * size * rows.shape[1], None
        columns = data.reshape(len(data), -1)
        if kind == "b":
            return np.packbits(columns, axis=1, bitorder="little"), columns.shape[1], None
        if kind == "f" or (kind == "i" and size == 2):
            checks.finite_array("data", columns)
            dtype = np.int16 if kind == "i" else np.float32
            rows = np.require(columns.astype(dtype, copy=False), requirements=["C", "A", "W"])
            return rows, columns.shape[1], 32_768.0 if kind == "i" else 1.0
    raise ArgumentError(
        f"data holds {data.dtype} of shape {data.shape}; use PDM words (uint8 to uint64), PDM bits (bool) or PCM "
        "(int16, float32, float64), of shape (sample,) or (sample, column)"
    )


def _channels(channels: Sequence[int] | None, n_channels: int) -> NDArray[np.int32]:
    if n_channels > MAX_MICROPHONES:
        raise ArgumentError(f"data has {n_channels} channels; the limit is {MAX_MICROPHONES}")
    if channels is None:
        return np.arange(n_channels, dtype=np.int32)
    found = [checks.integer(f"channels[{index}]", each, 0, n_channels - 1) for index, each in enumerate(channels)]
    if not found:
        raise ArgumentError("channels is empty; pass at least one channel, or None for all")
    return np.array(found, dtype=np.int32)


def _low_pass(
    rate_hz: float, decimation: int, pass_hz: float, attenuation_db: float, *, is_pdm: bool
) -> NDArray[np.int16] | NDArray[np.int32]:
    """Return the decimation filter; PCM that is not decimated needs none."""
    if decimation == 1 and not is_pdm:
        return integer_taps(np.ones(1))
    try:
        taps = decimation_taps(
            sample_rate_hz=rate_hz, decimation=decimation, pass_hz=pass_hz, stopband_attenuation_db=attenuation_db
        )
        return integer_taps(taps, bits=16 if attenuation_db <= _SHORT_TAPS_DB else 32)
    except ArgumentError as error:
        raise ArgumentError(str(error).replace("processing.", "")) from error
