"""Time window of the record that an image needs, and its range axis."""

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import fourier
from ertis_numba.base.errors import ArgumentError
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.geometry.waveform import matched_guard_s
from ertis_numba.settings import Settings

__all__ = ["TimeWindow", "time_window"]


@dataclass(frozen=True, slots=True, eq=False)
class TimeWindow:
    """Time window of an image: signal samples to demodulate, and samples after the matched filter.

    ``n_fft`` is ``output_decimation`` times ``n_outputs``, the samples of each phase. ``lead`` is the index of the
    sample of phase 0 at the first range, and ``start_s`` the time of sample 0 of phase 0.
    """

    range_m: NDArray[np.float64]
    first_sample: int
    n_samples: int
    n_fft: int
    n_outputs: int
    lead: int
    start_s: float

    @classmethod
    def from_start(cls, n_samples: int, *, n_fft: int, n_outputs: int = 0) -> Self:
        """Return a window that begins at sample 0, without a range axis."""
        return cls(
            range_m=np.zeros(0),
            first_sample=0,
            n_samples=n_samples,
            n_fft=n_fft,
            n_outputs=n_outputs,
            lead=0,
            start_s=0.0,
        )


def time_window(settings: Settings, *, largest_delay_s: float, n_taps: int, ringing_db: float = 60.0) -> TimeWindow:
    """Return the time window for beams with delays within ``± largest_delay_s``."""
    # It adds the ringing of the matched filter on both sides, and is long enough for a linear convolution.
    speed_m_s = sound_speed_m_s(settings.air)
    first_m, last_m = settings.processing.range_m
    record_m = speed_m_s * (settings.recording.duration_s - settings.call.start_s) / 2
    if last_m > record_m:
        raise ArgumentError(
            f"processing.range_m ends at {last_m:g} m, but the record of "
            f"{settings.recording.duration_s * 1e3:.4g} ms covers {record_m:.4g} m; shorten processing.range_m or "
            "use a longer preset"
        )
    output_rate_hz = settings.output_rate_hz
    step_m = speed_m_s / (2 * output_rate_hz)
    n_ranges = math.floor((last_m - first_m) / step_m * (1 + 1e-12)) + 1
    lead = math.ceil(largest_delay_s * output_rate_hz) + 1
    guard_s = matched_guard_s(settings, down_db=ringing_db)
    start_s = 2 * first_m / speed_m_s - lead / output_rate_hz
    stop_s = start_s + (n_ranges + 2 * lead) / output_rate_hz
    spanned_s = stop_s - start_s + settings.call.end_s + 2 * guard_s
    n_outputs = fourier.next_fast_len(math.ceil(spanned_s * output_rate_hz))
    n_fft = n_outputs * settings.output_decimation
    rate_hz = settings.signal_rate_hz
    decimation = settings.decimation
    before = n_taps // 2 // decimation
    after = (settings.recording.n_samples - 1 + n_taps // 2) // decimation
    first_sample = max(-before, math.floor((start_s - guard_s) * rate_hz))
    last_sample = min(after, math.ceil((stop_s + settings.call.end_s + guard_s) * rate_hz))
    return TimeWindow(
        range_m=first_m + step_m * np.arange(n_ranges, dtype=np.float64),
        first_sample=first_sample,
        n_samples=min(max(0, last_sample - first_sample + 1), n_fft),
        n_fft=n_fft,
        n_outputs=n_outputs,
        lead=lead,
        start_s=start_s,
    )
