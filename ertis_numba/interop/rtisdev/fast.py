"""Fast chain for the images of RTIS Dev, if it supports the arguments.

RTIS Dev's low pass for rectified beams smooths the exact envelope, so that results differ a little.
"""

import tempfile
from pathlib import Path
from typing import Any, Final

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import Measurement, Stamp
from ertis_numba.geometry import microphones
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.interop.rtisdev.processor import Configuration, Processor, cleaned, rounded
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Array, Call, Processing, Recording, Settings
from ertis_numba.simulation.modulator import Modulator

__all__ = ["FastProcessor"]

_RATE_HZ: Final = 4.5e6  # Arguments are numbers of samples, so that any rate gives the same image.
_SPACING_M: Final = 0.004
_SILENT: Final = 1e-4  # Relative to the largest sample of the call.
_MAX_CALL: Final = 0.25  # Relative to the record.
_MAX_DIFFERENCE_DB: Final = -15.0
_STAMP: Final = Stamp(sensor="rtisdev")
_N_ECHOES: Final = 24
_FADE: Final = 1.5  # Decades over which echoes differ.
_LOUD: Final = 0.4  # Relative to full scale, where modulators are still linear.
_WEAK: Final = _LOUD / 1000  # Quantisation noise, which both methods filter differently, is not negligible.
_MAX_ERROR_DB: Final = -60.0  # A loose budget would raise the noise of the fast chain above that of the exact one.
Real = NDArray[np.float32]


class FastProcessor:
    """Thread-safe processing by the fast chain; ``exact`` computes the rest, and the images to compare with.

    ``difference_db`` is the RMS of the difference of both images of a simulated measurement with loud echoes, relative
    to the exact image; ``weak_difference_db`` is that of echoes 60 dB weaker. Images of noise alone differ more. Raises
    ArgumentError if either exceeds -15 dB, or for arguments that the fast chain does not support.
    """

    def __init__(self, exact: Processor, *, device: str = "auto") -> None:
        given = exact.configuration
        self._exact, self._given = exact, given
        delays, call = _require_supported(given)
        means = delays.mean(axis=1)
        self._shift = round(float(means.mean()))
        # Beams of RTIS Dev count time from the smallest delay, and ours from the mean delay.
        centre = (len(given.envelope_filter) - 1) // 2
        offsets = np.rint(centre - self._shift + means).astype(np.int64)
        self._order = np.argsort(offsets, kind="stable")  # Directions with the same filter follow each other.
        self._offsets = offsets[self._order]
        self._n_taps = -(-len(given.envelope_filter) // given.envelope_factor)
        columns = self._offsets // given.envelope_factor
        self._first = given.first_range + int(columns.min()) - self._n_taps + 1
        self._last = given.last_range + int(columns.max())
        self._pipeline = _pipeline(given, delays[self._order], call, device, self._first, self._last)
        self._scale = 1.0
        words = _simulated(given, delays, call, _LOUD)
        wanted, found = exact.uncleaned(words, pdm=True), self._image(words)
        self._scale = float(np.vdot(found, wanted) / max(float(np.vdot(found, found)), 1e-30))
        self.difference_db = _difference_db(self._scale * found, wanted)
        words = _simulated(given, delays, call, _WEAK)
        self.weak_difference_db = _difference_db(self._image(words), exact.uncleaned(words, pdm=True))
        worst_db = max(self.difference_db, self.weak_difference_db)
        if worst_db > _MAX_DIFFERENCE_DB:
            raise ArgumentError(
                f"its images would differ by {worst_db:.1f} dB, and {_MAX_DIFFERENCE_DB:g} dB is the limit"
            )

    @property
    def configuration(self) -> Configuration:
        """Arguments of the configuration."""
        return self._given

    def process(self, data: NDArray[Any], *, pdm: bool) -> Real:
        """Return the image, as `Processor.process` does."""
        if not pdm or self._exact.has_lost_gpu:
            return self._exact.process(data, pdm=pdm)
        return cleaned(self._image(data), self._given.clean_multipliers)

    def _image(self, data: NDArray[Any]) -> Real:
        given = self._given
        words = self._exact.words(data).ravel()
        shift = self._shift * given.pdm_factor
        later = np.roll(words, -shift)
        if shift > 0:
            later[-shift:] = np.where(np.arange(shift) % 2, np.uint32(0xFFFF_FFFF), np.uint32(0))  # Silence.
        shape = self._pipeline.settings.recording.n_samples, 1
        measurement = Measurement(later.reshape(shape), self._pipeline.settings, _STAMP)
        envelope = self._pipeline.process(measurement).amplitude
        return self._smoothed(envelope)

    def _smoothed(self, envelope: Real) -> Real:
        """Filter the envelope as RTIS Dev filters rectified beams, and return the rows in the order of directions."""
        given, factor = self._given, self._given.envelope_factor
        first = round(self._pipeline.range_m[0] / _step_m(given))
        padded = np.zeros((len(envelope), self._last - self._first), np.float32)
        begin = first - self._first
        padded[:, begin : begin + envelope.shape[1]] = envelope
        image = np.empty((given.n_directions, given.last_range - given.first_range), np.float32)
        base = int((self._offsets // factor).min())
        starts = np.flatnonzero(np.diff(self._offsets, prepend=self._offsets[0] - 1))
        for start, stop in zip(starts, [*starts[1:], len(self._offsets)], strict=True):
            column, phase = divmod(int(self._offsets[start]), factor)
            taps = np.zeros(self._n_taps)
            some = given.envelope_filter[phase::factor]
            taps[len(taps) - len(some) :] = some[::-1]
            smooth = np.empty((stop - start, image.shape[1]), np.float32)
            whole, unit = rounded(taps * self._scale)
            self._exact.run("rectify_and_decimate", padded[start:stop], whole, unit, 1, column - base, out=smooth)
            image[self._order[start:stop]] = smooth
        return image


def _require_supported(given: Configuration) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Return the delays and the samples of the call."""
    if given.delays is None or given.matched_filter is None or not given.has_envelope:
        raise ArgumentError("it requires a matched filter, beamforming and an envelope")
    if given.dmas_order > 1 or given.coherent:
        raise ArgumentError("with delays of their own, images are sums: without DMAS and coherence factor")
    if given.pre_filter is not None or given.post_filter is not None:
        raise ArgumentError("it has no filters before or after the beams")
    if not (given.matched_filter == given.matched_filter[0]).all():
        raise ArgumentError("all microphones must have the same matched filter")
    n_beam = given.n_signal - given.beamforming_drop
    if given.last_range * given.envelope_factor + len(given.envelope_filter) // 2 > n_beam:
        raise ArgumentError(f"the image ends beyond the {n_beam} samples of the beams")
    call = scipy.fft.irfft(np.conj(given.matched_filter[0].astype(np.complex128)), given.n_signal)
    loud = np.flatnonzero(np.abs(call) > _SILENT * np.abs(call).max())
    if not len(loud) or loud[-1] >= _MAX_CALL * given.n_signal:
        raise ArgumentError("the matched filter is not that of a call at the beginning of the record")
    return given.delays, call[: loud[-1] + 1]


def _step_m(given: Configuration) -> float:
    """Return the distance between two ranges of the image."""
    return sound_speed_m_s(Settings().air) / 2 * given.pdm_factor * given.envelope_factor / _RATE_HZ


def _pipeline(
    given: Configuration, delays: NDArray[np.int32], call: NDArray[np.float64], device: str, first: int, last: int
) -> Pipeline:
    """Return the fast chain for ranges ``first`` to ``last`` of the record, without the last."""
    step_m = _step_m(given)
    rate_hz = _RATE_HZ / given.pdm_factor
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "delays.npy"
        np.save(path, delays)
        processing = Processing(
            directions=f"2d:{given.n_directions}",
            delay_matrix=str(path),
            delay_rate_hz=rate_hz,
            range_decimation=given.pdm_factor * given.envelope_factor,
            range_m=(max(first - 0.25, 0.0) * step_m, (last - 0.75) * step_m),
        )
        settings = Settings(
            array=_array(given.n_mics).replace(disabled=given.disabled or None),
            call=Call(sample_rate_hz=rate_hz, waveform=tuple((call / np.abs(call).max()).tolist())),
            recording=Recording(n_samples=given.n_samples, sample_rate_hz=_RATE_HZ),
            processing=processing,
        )
        return Pipeline(settings, device, max_error_db=_MAX_ERROR_DB, predict=False)


def _array(n_mics: int) -> Array:
    """Return an array with any positions, because the delays are given."""
    row = 8
    positions_m = tuple((0.0, _SPACING_M * (mic % row), _SPACING_M * (mic // row)) for mic in range(n_mics))
    return Array(layout="rtisdev", positions_m=positions_m)


def _difference_db(found: Real, wanted: Real) -> float:
    """Return the RMS of the difference of two images relative to the second one."""
    difference = float(np.linalg.norm(found - wanted)) / max(float(np.linalg.norm(wanted)), 1e-30)
    return 20 * float(np.log10(max(difference, 1e-30)))


def _simulated(
    given: Configuration, delays: NDArray[np.int32], call: NDArray[np.float64], peak: float
) -> NDArray[np.uint32]:
    """Return the PDM words of some echoes from random directions, with a peak relative to full scale."""
    rng = np.random.default_rng(1)
    signals = np.zeros((given.n_mics, given.n_signal))
    for _ in range(_N_ECHOES):
        direction = rng.integers(given.n_directions)
        arrival = given.envelope_factor * rng.integers(given.first_range, given.last_range)
        amplitude = 10 ** -rng.uniform(0.0, _FADE)
        for signal, delay in zip(signals, delays[direction], strict=True):
            echo = signal[arrival + delay : arrival + delay + len(call)]
            echo += amplitude * call[: len(echo)]
    signals *= peak / np.abs(signals).max()
    fine = scipy.fft.irfft(scipy.fft.rfft(signals, axis=1) * given.pdm_factor, given.n_samples, axis=1)
    layout = microphones(_array(given.n_mics))
    keys, silence = np.arange(given.n_mics, dtype=np.uint64), np.zeros(given.n_mics)
    words = np.empty((given.n_samples, 1), np.uint32)
    band = 0.25 / given.pdm_factor
    Modulator(layout, keys, silence, order=4, dither=0.5, band=band).process(fine, out=words)
    return words.ravel()
