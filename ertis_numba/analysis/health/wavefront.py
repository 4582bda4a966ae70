"""Checks on the wavefront of the strongest arrival: polarity, order and delay of channels, and time of the emission."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.health.array_match import MISFIT, SIGNS, SIZE, find_other_array, is_misfit, unobservable
from ertis_numba.analysis.health.arrival import Compressed, Fit, compress, fit_delays, fit_emitter, strongest
from ertis_numba.analysis.health.coherence import aligned, correlate, half_bands, half_gate, mean_of
from ertis_numba.analysis.health.emission import describe_shift, fit_emission
from ertis_numba.analysis.health.levels import gain_findings
from ertis_numba.analysis.health.limits import MAX_DELAY_S, MAX_SHIFT_S
from ertis_numba.analysis.health.not_observable import KNOWN_PLACE, OF_ARRIVAL, ORDER, SINGLE_ECHO, NotObservable
from ertis_numba.analysis.health.report import Finding
from ertis_numba.base.units import runs
from ertis_numba.geometry import Layout, microphones
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.settings import Settings

__all__ = ["by_array", "by_wavefront"]

_COMPACT_SHARE = 0.75  # Minimum share of the microphones that a wavefront must fit.
_MIN_PATH_M = 0.2  # Minimum path of an echo; shorter paths are indistinguishable from the direct sound.
_MIN_DEPTH_M = 0.01  # Minimum spread of distances from the emitter. On a ring, its sound equals an echo from ahead.
_DIRECT_SPREAD = 0.75  # Maximum spread relative to that of an echo, which has two more unknowns.
_PILOTS = 4  # Number of microphones in which the strongest arrival is searched.
_MAX_SPREAD_S = 3e-6  # Spread of the wavefront, beyond which the phase of the carrier is not conclusive.
_HALF_PERIOD_S = 12e-6  # Half a period of the highest usual carrier.
_AGREEMENT_S = 8e-6  # Tolerance between the delays of a swapped pair, or of the two halves of the band.
_LAG_S = 60e-6
_SMALL = 0.12  # Size of an array whose positions in millimetres are read as centimetres, and a margin.
_PRESENT = 0.85  # Minimum correlation relative to the usual value for an arrival at its expected time.
_DEVIATIONS = 7.5  # Median absolute residuals of the wavefront; five deviations of a normal distribution.
_COHERENT = 0.85
_COMPACT_COHERENCE = 0.97  # Minimum coherence of the median channel; a single echo has 0.995.
_SAME = 0.95  # Minimum coherence of a channel whose delay or level is compared.
_INVERTED = 0.97
_OPPOSITE = 1.08  # Minimum ratio of negative to positive correlation; half a period of an octave band has 0.83.
_MAX_SUSPECTS = 0.25  # Maximum share of microphones; if more disagree, the arrival is the cause.
_MAX_OTHERS = 0.1  # Share of the channels that may hear another echo beside the strongest.
_ONE_SOUND = 0.99  # Least similarity of all but a tenth of the channels in a single sound; overlapping ones have less.
_TWO_SIGNS = 0.5  # Least mean of squared phasors, whose phases differ by half a turn.
_MISFIT_S = 3.5e-6  # RMS of the smaller three quarters of the residuals; delays with a deviation of 3 µs have 1.7 µs.
_AFTER_DIRECT_S = 2e-3  # Time after the direct sound at which an echo is examined, too.


_INCOHERENT = "the channels contain different sounds at the strongest arrival"
_OF_CHANNELS = OF_ARRIVAL[:3]
_SHIFT = NotObservable(
    faults=OF_ARRIVAL[-1:], reason="the strongest arrival is not the direct sound", remedy=KNOWN_PLACE
)


@dataclass(frozen=True, slots=True, eq=False)
class _StrongestSound:
    """Strongest arrival of a record: times (mic,) without calibrated delays, and the way since the emission."""

    found: Compressed
    times_s: NDArray[np.float64]
    path_m: float
    is_near: bool
    shifts: list[Finding]
    other: Finding | None


def by_array(
    signals: Callable[[int], NDArray[np.float32]], channels: Sequence[int], settings: Settings, *, n_samples: int
) -> list[Finding] | None:
    """Return the faults of the array as a whole, in half the time of `by_wavefront`; None without an arrival."""
    arrival = _arrival(signals, channels, settings, n_samples)
    if arrival is None:
        return None
    return [] if arrival.other is None else [arrival.other]


def _arrival(
    signals: Callable[[int], NDArray[np.float32]], channels: Sequence[int], settings: Settings, n_samples: int
) -> _StrongestSound | None:
    """Return the strongest arrival, compared with other arrays; None if no arrival exceeds the background."""
    arrival = _arrival_after(signals, channels, settings, n_samples, -math.inf)
    if arrival is None or arrival.other is not None or not arrival.is_near:
        return arrival
    # An echo is examined, too: the direct sound arrives at opposite microphones of a ring or grid at once.
    earliest_s = float(arrival.times_s.max()) + _AFTER_DIRECT_S
    echo = _arrival_after(signals, channels, settings, n_samples, earliest_s)
    other = None if echo is None else echo.other
    return arrival if other is None or other.fault not in (MISFIT, ORDER, SIGNS) else replace(arrival, other=other)


def _arrival_after(
    signals: Callable[[int], NDArray[np.float32]],
    channels: Sequence[int],
    settings: Settings,
    n_samples: int,
    earliest_s: float,
) -> _StrongestSound | None:
    layout, speed_m_s = microphones(settings.array), sound_speed_m_s(settings.air)
    positions_m = layout.positions_m[list(channels)]
    rate_hz = settings.recording.sample_rate_hz
    first, last = _loudest(signals, channels, settings, n_samples, earliest_s)
    found = compress(signals, channels, settings.call, rate_hz=rate_hz, first=first, last=last)
    found.envelope[:, found.start_s + np.arange(found.envelope.shape[1]) * found.step_s < earliest_s] = 0.0
    width_s = float(2 * np.linalg.norm(positions_m, axis=1).max(initial=0.0)) / speed_m_s
    arrived = strongest(found, width_s)
    is_small = arrived is None  # Positions in a larger unit would spread an arrival over most of the record.
    arrived = strongest(found, _SMALL * width_s) if arrived is None else arrived
    if arrived is None:
        return None
    times_s, middle_s = arrived
    times_s = times_s - layout.delay_s[list(channels)]
    emission_s = fit_emission(times_s, positions_m, speed_m_s)
    shifts = [] if emission_s is None else _shifts(emission_s, channels, speed_m_s)
    path_m, is_near = max(middle_s * speed_m_s, _MIN_PATH_M), middle_s * speed_m_s < _MIN_PATH_M
    other = find_other_array(found, times_s, channels, layout, path_m, speed_m_s, is_near=is_near)
    if other is not None and shifts and other.fault == SIZE:  # A shift changes the expected curvature.
        other = None
    if is_small and other is None:
        return None
    if other is None and not is_small and not is_near:  # The place of the emitter may differ from that of the array.
        other = _misfit(found, times_s, path_m, list(channels), layout, speed_m_s)
    return _StrongestSound(found, times_s, path_m, is_near, shifts, other)


def _misfit(
    found: Compressed,
    times_s: NDArray[np.float64],
    path_m: float,
    channels: list[int],
    layout: Layout,
    speed_m_s: float,
) -> Finding | None:
    """Return a finding if a sound that is the same in each channel fits no wavefront, or with opposite signs only."""
    positions_m, delay_s = layout.positions_m[channels], layout.delay_s[channels]
    echo = fit_delays(times_s, positions_m, (0.0, 1 / path_m, 2 / path_m), speed_m_s)
    if echo is None:
        return None
    fit = max(fit_emitter(times_s, positions_m, speed_m_s), echo, key=lambda each: (each.share, -each.spread_s))
    heard = _gated(found, times_s + delay_s)
    same = np.abs(_along_common(heard))
    n_others = _n_others(found, times_s + delay_s, np.linalg.norm(positions_m, axis=1).max() / speed_m_s)
    if np.quantile(same, 0.1) < _ONE_SOUND or n_others > _MAX_OTHERS * len(channels):
        return None
    residual_s = np.sort(np.abs(times_s - fit.delay_s))[: math.ceil((1 - _MAX_SUSPECTS) * len(channels))]
    rms_s = float(np.sqrt(np.mean(residual_s**2)))
    if rms_s > _MISFIT_S and is_misfit(times_s, positions_m, path_m, speed_m_s):
        residuals = f"residuals of {1e6 * rms_s:.2g} µs in the best three quarters of the channels"
        detail = f"no wavefront fits an echo that is sharp in all {len(channels)} channels, with {residuals}"
        return Finding(
            fault=MISFIT, channels=tuple(channels), measured=1e6 * rms_s, limit=1e6 * _MISFIT_S, detail=detail
        )
    if fit.share < 1 or fit.spread_s > _MAX_SPREAD_S:
        return None
    return _opposite_signs(_gated(found, fit.delay_s + delay_s), channels)


def _along_common(heard: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return the components of signals (mic, step) along the signal that is most alike in all channels: (mic,)."""
    # The eigenvectors of the small matrix take a twentieth of the time of a singular value decomposition.
    common = np.linalg.eigh(heard @ heard.conj().T)[1][:, -1].conj() @ heard
    return np.asarray(heard @ common.conj() / max(float(np.linalg.norm(common)), np.finfo(np.float64).tiny))


def _opposite_signs(heard: NDArray[np.complex128], channels: list[int]) -> Finding | None:
    """Return a finding if more channels than single faults explain have the opposite sign: signals (mic, step)."""
    phasor = _along_common(heard)
    squared = np.mean(phasor**2) / np.mean(np.abs(phasor) ** 2)
    sign = np.sign((phasor * np.exp(-0.5j * np.angle(squared))).real)
    few = -1.0 if sign.sum() >= 0 else 1.0
    inverted = [channel for channel, each in zip(channels, sign, strict=True) if each == few]
    if np.abs(squared) < _TWO_SIGNS or len(inverted) <= _MAX_SUSPECTS * len(channels):
        return None
    named = ", ".join(f"{first}-{last}" if last > first else f"{first}" for first, last in runs(inverted))
    detail = f"{len(inverted)} of {len(channels)} compared channels have the opposite sign of the others: {named}"
    return Finding(
        fault=SIGNS, channels=tuple(inverted), measured=float(np.abs(squared)), limit=_TWO_SIGNS, detail=detail
    )


def _n_others(found: Compressed, at_s: NDArray[np.float64], reach_s: float) -> int:
    """Return the number of channels that hear another echo of half of the amplitude within the reach of the array."""
    half_s, _ = (steps * found.step_s for steps in half_gate(found, _LAG_S))
    time_s = found.start_s + np.arange(found.envelope.shape[1]) * found.step_s
    away_s, near = np.abs(time_s - at_s[:, None]), np.abs(time_s - np.median(at_s)) <= 2 * reach_s + 2 * half_s
    other = np.where((away_s > half_s) & near, found.envelope, 0.0).max(axis=1)
    return int(np.sum(other > 0.5 * np.where(away_s <= half_s, found.envelope, 0.0).max(axis=1)))


def _gated(found: Compressed, at_s: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Return the signals around their times, with equal power: (mic, step) complex128."""
    wide, (_, lags) = aligned(found, at_s, _LAG_S), half_gate(found, _LAG_S)
    gated = wide[:, lags : wide.shape[1] - lags]
    power = np.sum(np.abs(gated) ** 2, axis=1, keepdims=True)
    return np.asarray(gated / np.sqrt(np.maximum(power, np.finfo(np.float64).tiny)))


def by_wavefront(
    signals: Callable[[int], NDArray[np.float32]],
    channels: Sequence[int],
    settings: Settings,
    *,
    n_samples: int,
) -> tuple[list[Finding], tuple[NotObservable, ...]]:
    """Return the findings from the strongest arrival in channels with sound, and the faults that it cannot reveal."""
    layout, speed_m_s = microphones(settings.array), sound_speed_m_s(settings.air)
    positions_m = layout.positions_m[list(channels)]
    arrival = _arrival(signals, channels, settings, n_samples)
    if arrival is None:
        return [], _hidden("no arrival exceeds the background")
    if arrival.other is not None:
        return [arrival.other], ()
    times_s, shifts = arrival.times_s, arrival.shifts
    curvatures = (0.0, 1 / arrival.path_m, 2 / arrival.path_m)
    echo = fit_delays(times_s, positions_m, curvatures, speed_m_s)
    if echo is None:
        return shifts, _hidden(f"{len(channels)} microphones are too few to fit a wavefront", KNOWN_PLACE)
    direct = fit_emitter(times_s, positions_m, speed_m_s)
    from_centre_m = np.linalg.norm(positions_m, axis=1)
    is_direct = (
        direct.share >= max(_COMPACT_SHARE, echo.share)
        and direct.spread_s < _DIRECT_SPREAD * echo.spread_s
        and float(np.ptp(from_centre_m)) > _MIN_DEPTH_M
    )
    if not is_direct and arrival.is_near:
        return shifts, _hidden("the strongest arrival is too near to fit a wavefront")
    fit = direct if is_direct else echo
    if fit.share < _COMPACT_SHARE:
        return shifts, _hidden("no single wavefront fits the strongest arrival")
    hidden = unobservable(times_s, positions_m, arrival.path_m, speed_m_s, is_direct=is_direct)
    shown, reason = _of_channels(arrival.found, times_s, fit, channels, layout)
    unclear = (NotObservable(faults=_OF_CHANNELS, reason=reason, remedy=SINGLE_ECHO),) if reason else ()
    return [*shifts, *shown], (*unclear, *(() if is_direct else (_SHIFT,)), *hidden)


def _hidden(reason: str, remedy: str = SINGLE_ECHO) -> tuple[NotObservable, ...]:
    """Return the faults that no arrival shows."""
    return (NotObservable(faults=OF_ARRIVAL, reason=reason, remedy=remedy),)


def _shifts(emission_s: float, channels: Sequence[int], speed_m_s: float) -> list[Finding]:
    """Return a finding if the record does not begin with the emission."""
    described = describe_shift([emission_s], speed_m_s)
    if described is None:
        return []
    return [
        Finding(
            fault="shifted record",
            channels=tuple(channels),
            measured=1e6 * emission_s,
            limit=1e6 * MAX_SHIFT_S,
            detail=described[0],
        )
    ]


def _loudest(
    signals: Callable[[int], NDArray[np.float32]],
    channels: Sequence[int],
    settings: Settings,
    n_samples: int,
    earliest_s: float,
) -> tuple[int, int]:
    """Return the slice from one call length before the strongest arrival at some microphones to two after it."""
    rate_hz, call = settings.recording.sample_rate_hz, settings.call
    length = round(call.duration_s * rate_hz)
    few = list(channels)[:: max(1, len(channels) // _PILOTS)]
    pilot = compress(signals, few, call, rate_hz=rate_hz, first=0, last=n_samples)
    level = np.median(pilot.envelope, axis=0)
    level[pilot.start_s + np.arange(len(level)) * pilot.step_s < earliest_s] = 0.0
    middle_s = pilot.start_s + int(np.argmax(level)) * pilot.step_s
    middle = round((middle_s + call.start_s) * rate_hz)
    return max(0, middle - length), min(n_samples, middle + 2 * length)


def _of_channels(
    found: Compressed, times_s: NDArray[np.float64], fit: Fit, channels: Sequence[int], layout: Layout
) -> tuple[list[Finding], str]:
    """Return findings for channels with another delay, gain or polarity than the wavefront; else the obstacle."""
    picked = list(channels)
    gain, delay_s = layout.gain[picked], layout.delay_s[picked]
    matrix = np.column_stack([np.ones(len(picked)), layout.positions_m[picked]])
    fitted_s = fit.delay_s
    for _ in range(2):
        wide = aligned(found, fitted_s + delay_s, _LAG_S) / gain[:, None]
        reference = mean_of(wide[fit.inliers], found, _LAG_S)
        here = correlate(wide, reference, found, _LAG_S)
        # The carrier determines the delays of the inliers; their common slope is a property of the wavefront.
        near = fit.inliers & (np.abs(here.lag_s) < MAX_DELAY_S)
        if near.sum() > matrix.shape[1]:
            fitted_s = fitted_s + matrix @ np.linalg.lstsq(matrix[near], here.lag_s[near], rcond=None)[0]
    if np.median(here.coherence) < _COHERENT:
        return [], _INCOHERENT
    # A channel with a lag beyond the gate is aligned to its own peak.
    own = correlate(aligned(found, times_s + delay_s, _LAG_S) / gain[:, None], reference, found, _LAG_S)
    if np.median(own.coherence) < _COMPACT_COHERENCE:
        return [], _INCOHERENT
    beyond = (here.coherence < _COHERENT) & (own.coherence >= _COHERENT)
    offset_s = np.where(beyond, times_s - fitted_s + own.lag_s, here.lag_s)
    coherence = np.maximum(here.coherence, own.coherence)
    usual = float(np.median(here.peak[fit.inliers]))
    strength = np.maximum(np.maximum(here.peak, own.peak), here.negative)
    is_same = np.maximum(coherence, here.opposite) >= _SAME
    findings = gain_findings(channels, np.where(is_same, 20 * np.log10(strength), np.nan))
    if fit.spread_s > _MAX_SPREAD_S:
        return findings, f"the times of the strongest arrival deviate from a wavefront by {1e6 * fit.spread_s:.1f} µs"
    inverted = (here.opposite >= _INVERTED) & (here.negative > _OPPOSITE * np.maximum(here.peak, own.peak))
    inverted &= np.abs(times_s - fitted_s) < _HALF_PERIOD_S  # An echo delayed by half a period is not inverted.
    moved = ~inverted & (coherence >= _SAME) & (here.at_zero < _PRESENT * usual)
    limit_s = max(MAX_DELAY_S, _DEVIATIONS * fit.spread_s)
    moved &= np.abs(offset_s) > limit_s
    # Overlapping echoes may shift the carrier by a period, but not the envelope or both halves of the band alike.
    moved &= np.abs(times_s - fitted_s - offset_s) < _HALF_PERIOD_S
    if moved.any():
        moved &= _in_half_bands(found, fitted_s + delay_s, offset_s, fit.inliers)
    if np.mean(inverted | moved) > _MAX_SUSPECTS:
        return findings, "the strongest arrival differs between too many channels"
    findings += [
        Finding(
            fault="inverted polarity",
            channels=(channels[int(mic)],),
            measured=-float(here.opposite[mic]),
            limit=-_INVERTED,
        )
        for mic in np.flatnonzero(inverted)
    ]
    return findings + _moved(np.flatnonzero(moved), offset_s, fitted_s, channels, limit_s), ""


def _in_half_bands(
    found: Compressed, at_s: NDArray[np.float64], offset_s: NDArray[np.float64], inliers: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return True for each channel whose offset is the same in both halves of the band: (mic,) bool."""
    agrees = np.ones(len(at_s), bool)
    for half in half_bands(found):
        reference = mean_of(aligned(half, at_s, _LAG_S)[inliers], half, _LAG_S)
        rest = correlate(aligned(half, at_s + offset_s, _LAG_S), reference, half, _LAG_S)
        agrees &= np.abs(rest.lag_s) < _AGREEMENT_S
    return agrees


def _moved(
    mics: NDArray[np.intp],
    offset_s: NDArray[np.float64],
    fitted_s: NDArray[np.float64],
    channels: Sequence[int],
    limit_s: float,
) -> list[Finding]:
    """Return findings for delayed channels: ``swapped`` for pairs that fit each other's position, else ``late``."""
    findings, left = [], mics.tolist()
    while left:
        mic = left.pop(0)
        measured = Finding(
            fault="late", channels=(channels[mic],), measured=1e6 * float(offset_s[mic]), limit=1e6 * limit_s
        )
        for other in np.flatnonzero(np.abs(offset_s) > limit_s).tolist():
            apart_s = fitted_s[other] - fitted_s[mic]
            if abs(offset_s[mic] - apart_s) < _AGREEMENT_S and abs(offset_s[other] + apart_s) < _AGREEMENT_S:
                left = [rest for rest in left if rest != other]
                pair = ((mic, other), (other, mic))
                findings += [
                    replace(
                        measured,
                        fault="swapped",
                        channels=(channels[one],),
                        measured=1e6 * float(offset_s[one]),
                        detail=f"with channel {channels[two]}",
                    )
                    for one, two in pair
                ]
                break
        else:
            findings.append(measured)
    return findings
