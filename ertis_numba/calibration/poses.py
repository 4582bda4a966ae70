"""Calibration of the poses of several sensors on one platform."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from typing import Final

import numpy as np
import scipy
import threadpoolctl
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.base.units import counted
from ertis_numba.calibration.pose_fit import PoseFit, PoseProblem, fit_poses
from ertis_numba.calibration.pose_links import echo_points
from ertis_numba.calibration.pose_matching import Gates, Matched, match_waves, without_outliers
from ertis_numba.calibration.pose_result import PoseCalibration, SensorPose
from ertis_numba.calibration.pose_start import MIN_REFLECTORS, place_sensors, too_few
from ertis_numba.calibration.wave_finder import Wave, find_waves
from ertis_numba.frames import Measurement
from ertis_numba.geometry.air import sound_speed_m_s

__all__ = ["calibrate_poses"]

_GATES: Final = (Gates(0.03, 0.05), Gates(0.012, 0.03), Gates(0.008, 0.02))
"""Gates of successive rounds; the first one allows for the errors of the first approximation."""
_MAX_ROTATION_SD_DEG: Final = 0.5  # Beyond this, a rotation counts as not observable.
_MAX_POSITION_SD_M: Final = 0.01
_LINE: Final = 0.12  # Extent of reflectors across a line relative to that along it.

_Heard = dict[str, dict[tuple[int, int], list[Wave]]]


def calibrate_poses(
    measurements: Mapping[str, Iterable[Measurement]],
    *,
    reference: str | None = None,
    on_progress: Callable[[int], None] | None = None,
) -> PoseCalibration:
    """Estimate poses of sensors from reflectors that they hear in common, and from each other's calls.

    All sensors emit together on one SYNC chain, in the order of `measurements`; docs/how-to/calibrate.md describes the
    recordings. An error of the speed of sound scales all distances: 1 °C by 0.17 %. Calibrate arrays first.
    """
    if len(measurements) < 2:
        raise ArgumentError(
            f"poses of {counted(len(measurements), 'sensor')} are wanted, but mountings need at "
            "least two sensors; add recordings"
        )
    names = list(measurements)
    reference = names[0] if reference is None else reference
    checks.choice("reference", reference, names)
    # Only now is SciPy's BLAS loaded. On busy cores, its threads wait for each other; the matrices are small.
    _ = scipy.optimize.least_squares
    with threadpoolctl.threadpool_limits(1, user_api="blas"):
        return _calibrated(measurements, reference, on_progress)


def _calibrated(
    measurements: Mapping[str, Iterable[Measurement]], reference: str, on_progress: Callable[[int], None] | None
) -> PoseCalibration:
    names = list(measurements)
    heard, speed_m_s = _heard(measurements, on_progress)
    common = _common_pulses(heard)
    rotation, translation_m = place_sensors(heard, reference, speed_m_s)
    for gates in _GATES:
        matched = match_waves(heard, rotation, translation_m, speed_m_s, gates)
        _require_reflectors(matched, names)
        problem = PoseProblem(matched.waves, rotation, translation_m, matched.reflectors_m, names.index(reference))
        fit = fit_poses(problem)
        rotation, translation_m = fit.rotation, fit.translation_m
    matched = without_outliers(matched, fit.reflectors_m, fit.path_residual_m, _GATES[-1].path_m)
    n_reflectors = _require_reflectors(matched, names)
    fit = fit_poses(PoseProblem(matched.waves, rotation, translation_m, matched.reflectors_m, names.index(reference)))
    poses = {name: _pose(matched, fit, number, int(n_reflectors[number])) for number, name in enumerate(names)}
    found = {pulse for pulse, _ in matched.pulse}
    return PoseCalibration(
        reference,
        poses,
        fit.reflectors_m,
        len(common),
        tuple(sorted({pulse for pulse, _ in common} - found)),
        tuple(_not_observable(poses, matched, fit, names, reference)),
    )


def _heard(
    measurements: Mapping[str, Iterable[Measurement]], on_progress: Callable[[int], None] | None
) -> tuple[_Heard, float]:
    """Return the waves of all measurements, and the mean speed of sound."""
    heard: _Heard = {}
    speeds_m_s: list[float] = []
    for name, each in measurements.items():
        heard[name] = {}
        seen: Counter[int] = Counter()
        problem = ""
        for measurement in checks.items(f"measurements of {name}", each, Measurement, "a recording contains"):
            pulse = measurement.stamp.sync_count
            speeds_m_s.append(sound_speed_m_s(measurement.settings.air))
            try:
                # Several measurements may have the number of the last SYNC pulse.
                heard[name][pulse, seen[pulse]] = find_waves(measurement)
            except DataError as error:
                problem = str(error)
            seen[pulse] += 1
            if on_progress is not None:
                on_progress(len(speeds_m_s))
        if not any(len(echo_points(waves)[0]) for waves in heard[name].values()):
            if problem:
                raise DataError(f"sensor {name}: {problem}")
            raise DataError(
                f"sensor {name} heard no echo that stands out in {seen.total()} measurements; place a small, hard "
                "reflector 0.5 to 2 m in front of it, or raise the emission level"
            )
    return heard, float(np.mean(speeds_m_s))


def _common_pulses(heard: _Heard) -> list[tuple[int, int]]:
    """Return the SYNC pulses of more than one sensor."""
    counts = Counter(pulse for waves in heard.values() for pulse in waves)
    common = sorted(pulse for pulse, count in counts.items() if count > 1)
    if not common:
        raise ArgumentError(
            f"sensors {', '.join(heard)} have no SYNC pulse in common; record them together on one SYNC chain"
        )
    return common


def _require_reflectors(matched: Matched, names: list[str]) -> NDArray[np.intp]:
    """Return the number of reflectors of each sensor; raise an error if one has too few."""
    waves = matched.waves
    pairs = {
        (receiver, reflector)
        for receiver, reflector in zip(waves.receiver.tolist(), waves.reflector.tolist(), strict=True)
        if reflector >= 0
    }
    counts = np.bincount([receiver for receiver, _ in pairs], minlength=len(names))
    for name, count in zip(names, counts, strict=True):
        if count < MIN_REFLECTORS:
            raise too_few(name, [other for other in names if other != name])
    return counts


def _pose(matched: Matched, fit: PoseFit, number: int, n_reflectors: int) -> SensorPose:
    own = matched.waves.receiver == number
    quaternion = scipy.spatial.transform.Rotation.from_matrix(fit.rotation[number]).as_quat()
    return SensorPose(
        translation_m=fit.translation_m[number],
        rotation_xyzw=quaternion * (1.0 if quaternion[3] >= 0 else -1.0),
        covariance=fit.covariance[number],
        residual_m=float(np.sqrt(np.mean(fit.path_residual_m[own] ** 2))) if own.any() else 0.0,
        n_reflectors=n_reflectors,
        n_waves=int(own.sum()),
    )


def _not_observable(
    poses: dict[str, SensorPose], matched: Matched, fit: PoseFit, names: list[str], reference: str
) -> Iterable[str]:
    """Yield the quantities that the waves do not determine, one line each."""
    remedy = "place the reflector at more places, to the left and right, up and down, near and far"
    for number, name in enumerate(names):
        if name == reference:
            continue
        deviation = np.sqrt(np.linalg.eigvalsh(poses[name].covariance[3:, 3:]).clip(min=0).max())
        position_m = np.sqrt(np.linalg.eigvalsh(poses[name].covariance[:3, :3]).clip(min=0).max())
        own = matched.waves.reflector[matched.waves.receiver == number]
        places_m = fit.reflectors_m[np.unique(own[own >= 0])]
        extent_m = np.linalg.svd(places_m - places_m.mean(axis=0), compute_uv=False) if len(places_m) else np.zeros(3)
        on_line = len(extent_m) < 2 or extent_m[1] < _LINE * extent_m[0]
        if np.degrees(deviation) > _MAX_ROTATION_SD_DEG or position_m > _MAX_POSITION_SD_M:
            why = (
                f"a rotation of {name} about the line on which its {len(places_m)} reflectors are"
                if on_line
                else f"the pose of {name}, from {len(places_m)} reflectors, to within "
                f"{2 * np.degrees(deviation):.1f}° and {200 * position_m:.1f} cm"
            )
            yield f"{why}: {remedy}"
