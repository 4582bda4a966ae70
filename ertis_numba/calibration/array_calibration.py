"""Calibration of an array by recordings of one sound each."""

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import DataError
from ertis_numba.calibration.advice import how_to_record, require_directions
from ertis_numba.calibration.array_fit import ArrayFit, fit_array
from ertis_numba.calibration.channel_order import find_swaps
from ertis_numba.calibration.fit_result import NEPER_DB, SCALE_S, PreparedFit, assembled
from ertis_numba.calibration.observations import Observations, Tolerances
from ertis_numba.calibration.reference_place import (
    ArrayScale,
    ReflectorPlace,
    flipped,
    mirror_of,
    scale_from_direction,
    speed_from_distance,
    speed_from_spread,
)
from ertis_numba.calibration.result import Calibration
from ertis_numba.calibration.sounds import is_line
from ertis_numba.calibration.usable_sounds import (
    MIN_COHERENCE,
    Microphones,
    hear_all,
    ordered,
    require_sounds,
    silent_channels,
    unclear_channels,
)
from ertis_numba.calibration.wavefronts import TARGETS, Target, locate_source, travel_times
from ertis_numba.frames import Measurement
from ertis_numba.geometry import Layout

__all__ = ["calibrate"]

_MIN_MICROPHONES: Final = 8
_MAX_LEVEL: Final = 4.0  # Largest plausible level of a microphone in expected deviations.
_NEAR: Final = 3.0  # A sound that is more expected deviations from its expected time is another one.
_INVERTED_SHARE: Final = 0.8  # Share of the recordings in which an inverted channel is inverted.
_MIN_EVIDENCE: Final = 100.0  # Sum over the recordings of the logarithm of the likelihood of an inverted polarity.
_FEW: Final = 4  # Number of recordings from which on residuals reveal errors of the model.
_MODEL_S, _MODEL_DB = 1e-7, 0.05  # Errors of the model with real sound; 100 ns of sound are 0.03 mm.
_MISFIT: Final = 3.0  # Residuals relative to the noise, above which another target is tried.
_MAX_CHANGE: Final = 3.0  # Root-mean-square change relative to the tolerance, above which the layout is wrong.
_MAX_SPEED: Final = 0.1  # Relative difference of a measured speed of sound.
_BAD_RECORD: Final = 6.0  # Residual of a bad recording relative to that of the median one.
_MIN_BAD_S: Final = 1e-7
_MAX_OTHER_S: Final = 3e-7  # Error of times because of other sound, beyond which a recording is left out.


def calibrate(
    recordings: Iterable[Measurement] | Iterable[Iterable[Measurement]],
    layout: Layout | str | Path | None = None,
    *,
    target: Target = "reflector",
    gain_tolerance_db: float = 3.0,
    delay_tolerance_s: float = 5e-6,
    position_tolerance_m: float = 1e-3,
    first_place: tuple[float, float, float] | None = None,
    ideal: bool = False,
    on_progress: Callable[[int], None] | None = None,
) -> Calibration:
    """Estimate gain, delay, polarity and position of each microphone from recordings.

    Each measurement should contain one strong sound: the echo of a small reflector, at a different place in each
    recording, or of a flat wall, the direct sound of the sensor's own emitter, or the call of another sensor of the
    SYNC chain. Swapped, inverted, silent and duplicate channels are found first. `fit_array` and `fit_gains` describe
    the fits that follow.

    Parameters
    ----------
    recordings : iterable of Measurement, or of recordings
    layout : Layout, str or Path, optional
        Layout in use; that of the first measurement by default.
    target : {"reflector", "wall", "direct", "beacon"}
        Origin of the strongest sound.
    gain_tolerance_db, delay_tolerance_s : float
        Standard deviations of gains and delays that are expected before the calibration.
    position_tolerance_m : float
        The same of positions along each axis. 0 keeps the positions of the layout. Direct sound always keeps them.
    first_place : (azimuth_deg, elevation_deg, range_m), optional
        Place of the reflector in the first recording. The direction, which may be rough, reveals a mirrored layout and
        another size of the array, and the range gives the speed of sound, which the fit then uses.
    ideal : bool
        True if air, emitter and reflector are exactly as the settings say, as in simulations; False, the default, adds
        model errors of 100 ns and 0.05 dB, so that positions and intervals do not depend on them.
    on_progress : callable, optional
        Function that is called with the number of measurements so far.

    Raises
    ------
    ArgumentError
        There are no measurements, or the layout does not suit them.
    DataError
        No sound stands out, the signals are saturated, the layout does not fit them, or all recordings are from one
        direction.

    Examples
    --------
    Calibrate an array with a reflector at twenty places::

        recordings = [ertis.open_recording(path) for path in sorted(Path("reflector").glob("*.h5"))]
        calibration = ertis.calibrate(recordings)
        print(calibration.findings, calibration.residuals.before_s, calibration.residuals.after_s)
    """
    checks.choice("target", target, TARGETS)
    checks.between("gain_tolerance_db", gain_tolerance_db, 0.01, 60.0)
    checks.between("delay_tolerance_s", delay_tolerance_s, 1e-9, 1e-3)
    checks.between("position_tolerance_m", position_tolerance_m, 0.0, 0.1)
    place = None if first_place is None else ReflectorPlace(*first_place).checked()
    heard = hear_all(recordings, layout, target, on_progress)
    enabled = np.flatnonzero(heard.former.enabled)
    keeps = target == "direct" or is_line(heard.former.positions_m[enabled])
    expected = Tolerances(
        gain_db=gain_tolerance_db,
        delay_s=delay_tolerance_s,
        position_m=0.0 if keeps else position_tolerance_m,
        model_s=0.0 if ideal else _MODEL_S,
        model_db=0.0 if ideal else _MODEL_DB,
    )
    is_silent = silent_channels(heard.sounds)
    used = (
        ~is_silent
        & ~unclear_channels(heard.sounds, _MAX_LEVEL * gain_tolerance_db)
        & ~np.isin(enabled, list(heard.copies))
    )
    if used.sum() < _MIN_MICROPHONES:
        raise DataError(
            f"{int(used.sum())} of {len(enabled)} channels contain the same sound, but a calibration needs "
            f"{_MIN_MICROPHONES}; {how_to_record(target)}"
        )
    every = Microphones(enabled, heard.former.positions_m[enabled], heard.former.delay_s[enabled])
    every, source_m, order = ordered(heard, every, used, target)
    if expected.position_m:
        require_directions(source_m, target)
    kept = every.part(used)
    speed_m_s = np.array([sound.speed_m_s for sound in heard.sounds.values()])
    time_s = np.stack([sound.arrival.time_s for sound in heard.sounds.values()])[:, used] - kept.delay_s
    found = find_swaps(time_s, kept.positions_m, source_m, speed_m_s, target)
    prepared = PreparedFit(
        heard=heard,
        every=every,
        used=used,
        kept=replace(kept, positions_m=kept.positions_m[found.place]),
        source_m=source_m,
        target=target,
        expected=expected,
        order=order,
        swaps=tuple(tuple(kept.channels[list(cycle)].tolist()) for cycle in found.cycles()),
        silent=tuple(enabled[is_silent].tolist()),
    )
    return _with_place(_fitted(prepared), prepared, place)


def _fitted(job: PreparedFit) -> Calibration:
    """Return the calibration, after leaving out recordings that do not agree with the others."""
    seen, inverted = _observed(job)
    source_m = job.source_m
    n_valid = np.isfinite(seen.time_sd_s).sum(axis=1)
    few = {i: f"{n} microphones receive the same sound" for i, n in enumerate(n_valid) if n < _MIN_MICROPHONES}
    seen, source_m = _left_out(job, few | _overlapped(job, few), seen, source_m)
    fit = _fit(job, seen, source_m)
    bad = {
        int(i): f"it does not agree with the others: residuals of {1e6 * _rms(fit.residual_s[i]):.1f} µs"
        for i in np.flatnonzero(_bad_records(fit.residual_s))
    }
    if not bad:
        bad = _of_other_targets(job, seen, fit)
    if bad:
        seen, source_m = _left_out(job, bad, seen, source_m)
        fit = _fit(job, seen, source_m)
    _require_plausible(job, fit)
    return assembled(job, seen, fit, inverted)


def _overlapped(job: PreparedFit, few: dict[int, str]) -> dict[int, str]:
    """Return the recordings whose echo another sound overlaps, with the reason, if enough others remain."""
    other_s = [sound.arrival.other_sound[0] for sound in job.heard.sounds.values()]
    found = {
        index: f"another sound overlaps its echo: parts of the band differ by {1e6 * each_s:.1f} µs"
        for index, each_s in enumerate(other_s)
        if each_s > _MAX_OTHER_S and index not in few
    }
    n_left = len(other_s) - len(few) - len(found)
    return found if n_left >= _FEW else {}


def _fit(job: PreparedFit, seen: Observations, source_m: NDArray[np.float64]) -> ArrayFit:
    kept = job.kept
    return fit_array(seen, kept.delay_s, kept.positions_m, source_m, job.speed_m_s(), job.target, job.expected)


def _of_other_targets(job: PreparedFit, seen: Observations, fit: ArrayFit) -> dict[int, str]:
    """Return recordings of another kind of target, with the reason; raise DataError if all are."""
    if job.target == "direct":
        return {}
    other: Target = "wall" if job.target == "reflector" else "reflector"
    scale = 2.0 if job.target == "reflector" else 0.5
    misfit = _misfit(fit.residual_s, seen)
    if np.median(misfit) > _MISFIT:
        kept = job.kept
        speed_m_s = job.speed_m_s()
        start_m = scale * job.source_m[: len(speed_m_s)]
        tried = fit_array(seen, kept.delay_s, kept.positions_m, start_m, speed_m_s, other, job.expected)
        if np.median(_misfit(tried.residual_s, seen)) < np.median(misfit) / 2:
            raise DataError(
                f"the times fit a {other} better than a {job.target}, by a factor of "
                f"{np.median(misfit) / np.median(_misfit(tried.residual_s, seen)):.0f}; use target={other!r}"
            )
    found = {}
    for record in np.flatnonzero(misfit > _MISFIT).tolist():
        valid = np.isfinite(seen.time_sd_s[record])
        time_s, places_m = (seen.time_s[record] - fit.delay_s)[valid], fit.positions_m[valid]
        speed = float(job.speed_m_s()[record])
        start_m = scale * fit.source_m[record]
        source_m = locate_source(time_s, places_m, start_m, speed, other, scale_s=SCALE_S)
        rest_s = time_s - travel_times(source_m[None], places_m, speed, other).time_s[0]
        if np.median(np.abs(rest_s)) / seen.noise_s[record] < misfit[record] / 2:
            found[record] = f"its sound fits a {other} better than a {job.target}"
    return found


def _misfit(residual_s: NDArray[np.float64], seen: Observations) -> NDArray[np.float64]:
    """Return the median residual of each recording relative to its noise: (record,) float64."""
    return np.asarray(np.nanmedian(np.abs(residual_s), axis=1) / seen.noise_s)


def _require_plausible(job: PreparedFit, fit: ArrayFit) -> None:
    """Refuse changes that are far larger than their tolerances."""
    later = _rms(fit.delay_s - job.kept.delay_s)
    moved = _rms(fit.positions_m - job.kept.positions_m)
    expected = job.expected
    if later > _MAX_CHANGE * expected.delay_s or (expected.position_m and moved > _MAX_CHANGE * expected.position_m):
        raise DataError(
            f"microphones would move by {1e3 * moved:.1f} mm and be delayed by {1e6 * later:.1f} µs (RMS), over "
            f"{_MAX_CHANGE:g} times the tolerances, so layout {job.heard.former.name} is probably not that of this "
            "sensor; use the layout of this array, or larger tolerances"
        )


def _left_out(
    job: PreparedFit, reasons: dict[int, str], seen: Observations, source_m: NDArray[np.float64]
) -> tuple[Observations, NDArray[np.float64]]:
    """Leave out recordings by their places among the usable ones, with reasons; return the rest."""
    numbers = list(job.heard.sounds)
    for index, reason in reasons.items():
        job.heard.rejected[numbers[index]] = reason
        del job.heard.sounds[numbers[index]]
    require_sounds(job.heard, job.target)
    chosen = np.array([index not in reasons for index in range(len(numbers))])
    return _rows(seen, chosen), source_m[chosen]


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def _observed(job: PreparedFit) -> tuple[Observations, NDArray[np.bool_]]:
    """Measure all sounds again, with gates around their times; also return which microphones are inverted."""
    heard, used, kept, expected = job.heard, job.used, job.kept, job.expected
    rows, evidence = [], []
    for sound, place_m in zip(heard.sounds.values(), job.source_m, strict=True):
        expected_s = travel_times(place_m[None], kept.positions_m, sound.speed_m_s, job.target).time_s[0] + kept.delay_s
        own_s = sound.arrival.time_s[used]
        near_s = _NEAR * (expected.delay_s + expected.position_m / sound.speed_m_s)
        is_near = np.abs(own_s - expected_s) < near_s
        at_s, of_pulse = sound.arrival.time_s.copy(), used.copy()
        # Where another echo is stronger, the sound in question is weaker, but it is there.
        at_s[used] = np.where(is_near, own_s, expected_s)
        of_pulse[used] = is_near
        again = sound.measure(at_s, of_pulse)
        evidence.append(again.evidence[used])
        # Many recordings reveal other sound by their residuals, but few agree with any calibration.
        other_s, other = again.other_sound if len(heard.sounds) < _FEW else (0.0, 0.0)
        valid = (again.coherence[used] >= MIN_COHERENCE) & (np.abs(again.time_s[used] - expected_s) < near_s)
        rows.append(
            (
                again.time_s[used],
                np.where(valid, np.hypot(again.time_sd_s[used], math.hypot(other_s, expected.model_s)), np.inf),
                float(np.median(again.time_sd_s[used])),
                again.level[used],
                np.where(
                    valid, np.hypot(again.level_sd[used], math.hypot(other, expected.model_db / NEPER_DB)), np.inf
                ),
            )
        )
    inverted = _inverted(np.array(evidence), np.sign(heard.former.gain[kept.channels]))
    return Observations(*(np.array(column) for column in zip(*rows, strict=True))), inverted


def _rows(seen: Observations, chosen: NDArray[np.bool_]) -> Observations:
    columns = (seen.time_s, seen.time_sd_s, seen.noise_s, seen.level, seen.level_sd)
    return Observations(*(column[chosen] for column in columns))


def _bad_records(residual_s: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return True for recordings that fit much worse than the others: (record,) bool."""
    typical_s = np.nan_to_num(np.nanmedian(np.abs(residual_s), axis=1), nan=np.inf)
    return np.asarray(typical_s > np.maximum(_MIN_BAD_S, _BAD_RECORD * np.median(typical_s)))


def _inverted(evidence: NDArray[np.float64], sign: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return True for microphones whose polarity certainly differs from that of most microphones: (mic,) bool."""
    relative = evidence * sign
    relative = relative * np.where(np.median(relative, axis=1, keepdims=True) < 0, -1, 1)
    is_negative = np.mean(relative < 0, axis=0) > _INVERTED_SHARE
    return np.asarray(is_negative & (relative.sum(axis=0) < -_MIN_EVIDENCE))


def _with_place(made: Calibration, job: PreparedFit, place: ReflectorPlace | None) -> Calibration:
    """Return the calibration with the findings from the place of the first reflector, or from direct sound."""
    first = next(iter(job.heard.sounds))
    speed_m_s = job.heard.sounds[first].speed_m_s
    if job.target == "direct":
        sound = job.heard.sounds[first]
        sd_s = np.hypot(sound.arrival.time_sd_s, job.expected.delay_s)[job.used]
        time_s = sound.arrival.time_s[job.used] - job.kept.delay_s
        speed = speed_from_spread(time_s, sd_s, job.kept.positions_m, made.source_m[0], speed_m_s, job.target)
        return replace(made, sound_speed=speed)
    if place is None:
        return made
    if first != 0:
        raise DataError(
            f"the first recording, whose place is given, cannot be used: {job.heard.rejected[0]}; repeat this "
            "recording, or begin with another recording whose place is known"
        )
    speed = speed_from_distance(made.source_m[0], place, speed_m_s, job.target)
    if abs(speed.speed_m_s / speed_m_s - 1) > _MAX_SPEED:
        raise DataError(
            f"the range {place.range_m:g} m of the first place does not agree with the echo at "
            f"{place.range_m * speed_m_s / speed.speed_m_s:.2f} m; correct the place"
        )
    made = replace(_fitted(_at_speed(job, made, speed.speed_m_s / speed_m_s)), sound_speed=speed)
    if is_line(job.every.positions_m) or not place.shows_mirroring:
        line = "a mirrored layout, because the azimuth or elevation of the place is below 10°, or the array is a line"
        return replace(made, not_observable=(*made.not_observable, line))
    name = mirror_of(made.source_m[0], place)
    made = replace(made, scale=_scale(job, made.source_m[0], speed.speed_m_s, place))
    if not name:
        return made
    flip = flipped(name)
    layout = replace(made.layout, positions_m=made.layout.positions_m * flip)
    return replace(
        made,
        layout=layout,
        moved_m=made.moved_m * flip,
        source_m=made.source_m * flip,
        mirrored=name,
    )


def _scale(
    job: PreparedFit, start_m: NDArray[np.float64], speed_m_s: float, place: ReflectorPlace
) -> ArrayScale | None:
    """Return the size of the array relative to the layout, whose fitted delays would hide some of it."""
    time_s = next(iter(job.heard.sounds.values())).arrival.time_s[job.used] - job.kept.delay_s
    source_m = locate_source(time_s, job.kept.positions_m, start_m, speed_m_s, job.target, scale_s=SCALE_S)
    return scale_from_direction(source_m, place)


def _at_speed(job: PreparedFit, made: Calibration, ratio: float) -> PreparedFit:
    """Return the calibration to repeat with another speed of sound."""
    sounds = {number: replace(sound, speed_m_s=ratio * sound.speed_m_s) for number, sound in job.heard.sounds.items()}
    return replace(job, heard=replace(job.heard, sounds=sounds), source_m=ratio * made.source_m)
