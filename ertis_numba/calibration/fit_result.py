"""Result of the fit of an array: layout, changes, residuals and findings."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.analysis.health.arrival import Compressed
from ertis_numba.calibration.advice import not_observable
from ertis_numba.calibration.array_fit import ArrayFit, fit_gains
from ertis_numba.calibration.observations import Observations, Tolerances
from ertis_numba.calibration.result import Calibration, Residuals
from ertis_numba.calibration.sounds import MAX_DIRECT_PATH_M, Sound, is_line
from ertis_numba.calibration.usable_sounds import (
    Heard,
    Microphones,
)
from ertis_numba.calibration.wavefronts import Target, locate_source, travel_times
from ertis_numba.geometry import Layout, unit_vectors
from ertis_numba.geometry.air import absorption_db_m

__all__ = ["NEPER_DB", "SCALE_S", "PreparedFit", "assembled", "image_contrast_db"]

NEPER_DB: Final = 20 / math.log(10)


SCALE_S: Final = 5e-6


@dataclass(frozen=True, slots=True, eq=False)
class PreparedFit:
    """Sounds and microphones of a calibration, with the order of the channels known."""

    heard: Heard
    every: Microphones
    used: NDArray[np.bool_]
    kept: Microphones
    source_m: NDArray[np.float64]
    target: Target
    expected: Tolerances
    order: str
    swaps: tuple[tuple[int, ...], ...]
    silent: tuple[int, ...]

    def speed_m_s(self) -> NDArray[np.float64]:
        """Return the speed of sound of each recording: (record,) float64."""
        return np.array([sound.speed_m_s for sound in self.heard.sounds.values()])


def assembled(job: PreparedFit, seen: Observations, fit: ArrayFit, inverted: NDArray[np.bool_]) -> Calibration:
    """Return the result: the new layout, changes, residuals and findings."""
    heard, every, kept, expected = job.heard, job.every, job.kept, job.expected
    former, n_mics = heard.former, len(kept.channels)
    settings = next(iter(heard.sounds.values())).settings
    centre_hz = (settings.call.low_frequency_hz + settings.call.high_frequency_hz) / 2
    absorption = float(absorption_db_m(settings.air, np.array([centre_hz]))[0]) / NEPER_DB
    former_gain = former.gain[kept.channels]
    change_np, gain_covariance, level_rest = fit_gains(
        seen, np.log(np.abs(former_gain)), fit.distance_m, absorption, expected
    )
    change_db = NEPER_DB * change_np
    covariance = np.zeros((n_mics, 5, n_mics, 5))
    covariance[:, 0, :, 0] = NEPER_DB**2 * gain_covariance
    covariance[:, 1:, :, 1:] = fit.covariance.reshape(n_mics, 4, n_mics, 4)
    levels = NEPER_DB * level_rest
    residuals = Residuals(
        before_time_s=_before(job, seen, fit),
        after_time_s=fit.residual_s,
        before_level_db=levels + change_db - np.mean(change_db),
        after_level_db=levels,
    )
    enabled = former.enabled.copy()
    enabled[[*job.silent, *heard.copies]] = False
    gain, delay_s, positions_m = former.gain.copy(), former.delay_s.copy(), former.positions_m.copy()
    positions_m[every.channels] = every.positions_m
    gain[kept.channels] = former_gain * np.exp(change_np) * np.where(inverted, -1.0, 1.0)
    delay_s[kept.channels] = fit.delay_s
    positions_m[kept.channels] = fit.positions_m
    layout = replace(former, enabled=enabled, gain=gain, delay_s=delay_s, positions_m=positions_m)
    sounds = list(heard.sounds.values())
    unclear = tuple(np.setdiff1d(np.flatnonzero(enabled), kept.channels).tolist())
    made = Calibration(
        layout=layout,
        former=former,
        channels=tuple(kept.channels.tolist()),
        gain_db=change_db,
        delay_s=fit.delay_s - kept.delay_s,
        moved_m=fit.positions_m - kept.positions_m,
        covariance=covariance,
        expected_sd=np.array([expected.gain_db, 1e6 * expected.delay_s, *(3 * [1e3 * expected.position_m])]),
        residuals=residuals,
        source_m=fit.source_m,
        swaps=job.swaps,
        inverted=tuple(kept.channels[inverted].tolist()),
        silent=job.silent,
        unclear=unclear,
        duplicates=heard.copies,
        order=job.order,
        mirrored="",
        sound_speed=None,
        scale=None,
        not_observable=(),
        contrast_db=tuple(image_contrast_db(sounds, every.channels, each) for each in (former, layout)),
        rejected=dict(sorted(heard.rejected.items())),
    )
    return replace(
        made,
        not_observable=not_observable(made.is_observed, job.target, expected, is_line=is_line(every.positions_m)),
    )


def _before(job: PreparedFit, seen: Observations, fit: ArrayFit) -> NDArray[np.float64]:
    """Return the residuals of the layout in use, with sources that fit it best: (record, mic) float64."""
    heard, kept, target, speed_m_s = job.heard, job.kept, job.target, job.speed_m_s()
    positions_m = heard.former.positions_m[kept.channels]
    rest_s = np.full_like(seen.time_s, np.nan)
    for record, start_m in enumerate(fit.source_m):
        valid = np.isfinite(seen.time_sd_s[record])
        time_s = (seen.time_s[record] - kept.delay_s)[valid]
        speed = float(speed_m_s[record])
        source_m = locate_source(time_s, positions_m[valid], start_m, speed, target, scale_s=SCALE_S)
        rest_s[record, valid] = time_s - travel_times(source_m[None], positions_m[valid], speed, target).time_s[0]
    return rest_s


_AZIMUTH_DEG: Final = np.arange(-80.0, 81.0, 5.0)
_ELEVATION_DEG: Final = np.arange(-45.0, 46.0, 15.0)
_MAX_RECORDS: Final = 4


def image_contrast_db(sounds: Iterable[Sound], channels: NDArray[np.intp], layout: Layout) -> float:
    """Return the power of the strongest direction relative to the mean, beyond the direct sound, in dB."""
    azimuth_rad, elevation_rad = (
        grid.ravel() for grid in np.radians(np.meshgrid(_AZIMUTH_DEG, _ELEVATION_DEG, indexing="ij"))
    )
    towards = unit_vectors(azimuth_rad, elevation_rad)
    used = layout.enabled[channels]
    chosen = channels[used]
    highest, mean = 0.0, 0.0
    for sound in list(sounds)[:_MAX_RECORDS]:
        delay_s = layout.delay_s[chosen] - towards @ layout.positions_m[chosen].T / sound.speed_m_s
        power = _beams(sound.pulses, used, delay_s, layout.gain[chosen])
        later = round((MAX_DIRECT_PATH_M / sound.speed_m_s - sound.pulses.start_s) / sound.pulses.step_s)
        per_sample = power.shape[1] / sound.pulses.envelope.shape[1]
        power = power[:, round(max(later, 0) * per_sample) :]
        highest += float(power.max(axis=0).sum())
        mean += float(power.mean(axis=0).sum())
    return 10 * math.log10(highest / mean) if mean else 0.0


def _beams(
    pulses: Compressed, used: NDArray[np.bool_], delay_s: NDArray[np.float64], gain: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the power of each beam: (direction, sample) float64, from the time of the first step on."""
    turn = 2j * np.pi * pulses.frequency_hz
    # The record begins where the envelopes begin.
    signals = pulses.bins[used] * np.exp(turn * (pulses.start_s - pulses.origin_s)) / gain[:, None]
    beams = np.empty((len(delay_s), signals.shape[1]), dtype=np.complex64)
    steering = np.exp(turn[0] * delay_s)
    step = np.exp((turn[1] - turn[0]) * delay_s)
    for index in range(len(turn)):
        beams[:, index] = steering @ signals[:, index]
        steering *= step
    made = scipy.fft.ifft(beams, 2 * signals.shape[1], axis=1)
    return np.asarray(made.real**2 + made.imag**2, dtype=np.float64)
