"""Comparison of the peaks of an image with the scene's ground truth."""

import functools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.analysis.detect import observed, peaks_of_grid
from ertis_numba.analysis.noise import threshold_of
from ertis_numba.base import checks
from ertis_numba.base.constants import FALSE_ALARM
from ertis_numba.frames import Energyscape, Peak, Reflector
from ertis_numba.geometry import array_weights, microphones, observable_angles, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.geometry.waveform import matched_filter_spectrum
from ertis_numba.settings import Settings

__all__ = ["Comparison", "Errors", "Match", "compare", "errors_of", "visible"]

_GATE_M = 0.1  # Maximum range difference between a reflector and its peak.
_GATE_HALF_LOBES = 3.0  # Maximum angle between them: one and a half main lobes.
_HALF_AMPLITUDE = math.sqrt(2 * math.log(2))  # Argument x for which exp(-x² / 2) is one half.
_SLACK_DB = 3.0  # Tolerance of a level in the image relative to the true level.
_MAX_FALSE = 100  # More than a hundred spurious peaks add no information.
_MIN_DB = -1000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Match:
    """Reflector of the ground truth and the peak assigned to it.

    Attributes
    ----------
    reflector : Reflector
    peak : Peak
    angle_deg : float
        Angle between the two directions in degrees; in a planar image, the angle between the two azimuths. For
        microphones on a line, the difference of the angles to this line. NaN if the array observes no direction.
    range_m : float
        Range of the peak minus that of the reflector, in metres.
    level_db : float
        Level of the peak minus that of the reflector, each relative to the strongest reflector that was found.
    """

    reflector: Reflector
    peak: Peak
    angle_deg: float
    range_m: float
    level_db: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Comparison of one image with the ground truth.

    Attributes
    ----------
    matched : tuple of Match
        Reflectors that were found, in the order of the ground truth.
    missed : tuple of Reflector
        Visible reflectors without a peak.
    spurious : tuple of Peak
        Spurious peaks, which no reflector explains.
    explained : tuple of Peak
        Peaks of reflectors that do not count: too weak, outside of the image, of another sensor's call, or mirrored by
        a plane array.
    """

    matched: tuple[Match, ...]
    missed: tuple[Reflector, ...]
    spurious: tuple[Peak, ...]
    explained: tuple[Peak, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Errors:
    """Numbers and errors of reflectors over several images; None if none matched. A positive bias is too far away."""

    measurements: int
    angle_rms_deg: float | None
    range_bias_m: float | None
    range_rms_m: float | None
    level_rms_db: float | None
    missed: int
    spurious: int
    matched: int


def compare(image: Energyscape, reflectors: Sequence[Reflector], *, min_level_db: float = -30.0) -> Comparison:
    """Compare the peaks of an image with the ground truth of its measurement.

    A reflector is visible, and counts, under these conditions:

    - It returns the sensor's own call.
    - Its range lies on the range axis.
    - Its direction lies within half a main lobe of the nearest direction of the image.
    - Its level relative to the strongest visible reflector is at least ``min_level_db``.

    Peaks and visible reflectors are assigned one to one. The assignment first maximises the number of pairs within
    0.1 m and one and a half main lobes, then minimises the sum of squared distances. SciPy solves this assignment
    problem after D. F. Crouse, 2016. Found reflectors exceed the noise of the image
    (`ertis_numba.analysis.noise.threshold_of`, probability 0.001). Spurious peaks are those of `find_peaks`. The number
    of peaks is limited to that of the reflectors plus 100.

    Parameters
    ----------
    image : Energyscape
    reflectors : sequence of Reflector
        Ground truth of the measurement that the image was computed from.
    min_level_db : float
        Minimum level of a reflector, relative to the strongest visible reflector; -30 dB by default.

    Raises
    ------
    ArgumentError
        ``min_level_db`` is above 0, or the directions of the image are levelled.

    Examples
    --------
    Compare an image of a simulated scene with its ground truth::

        from ertis_numba.simulation import Point

        scene = ertis.Scene(points=(Point(azimuth_deg=20.0, range_m=1.5),))
        simulator = ertis.Simulator(scene)
        measurement = simulator.render(index=0)
        image = ertis.Pipeline(measurement.settings).process(measurement)
        comparison = ertis.compare(image, simulator.reflectors(index=0))
        print(len(comparison.matched), len(comparison.missed), len(comparison.spurious))
    """
    checks.instance("image", image, Energyscape, "Pipeline.process returns")
    reflectors = list(checks.items("reflectors", reflectors, Reflector, "RecordingReader.reflectors returns"))
    checks.between("min_level_db", min_level_db, _MIN_DB, 0.0)
    image.settings.processing.require_sensor_frame("the ground truth is in the frame of the sensor")
    lobe = _Lobe(image.settings)
    in_view = _in_view(image, reflectors, lobe)
    in_range = _in_range(image, reflectors)
    is_shown = in_view & in_range & _is_own(reflectors)
    levels_db = np.array([reflector.level_db for reflector in reflectors])
    strongest_db = float(np.max(levels_db, where=is_shown, initial=_MIN_DB))
    counts = is_shown & (levels_db >= strongest_db + min_level_db)
    counted = [reflector for reflector, does in zip(reflectors, counts, strict=True) if does]

    # A reflector that does not count may still be the strongest in the image, or leak into it.
    above_db = float(np.max(levels_db, where=in_range, initial=strongest_db)) - strongest_db if counted else 0.0
    floor_db = max(_MIN_DB, min_level_db - above_db - _SLACK_DB)
    # Only spurious peaks must be listed: the truth tells reflectors beside stronger ones from noise of their direction.
    limits: dict[str, Any] = {"top": len(reflectors) + _MAX_FALSE, "min_level_db": floor_db}
    where = image.amplitude >= threshold_of(image, FALSE_ALARM) if image.points is None else None
    peaks = peaks_of_grid(image, where=where, false_alarm=None, **limits)
    listed = {_place(peak) for peak in peaks_of_grid(image, false_alarm=FALSE_ALARM, **limits)}
    pairs = _assign(image, counted, peaks, lobe)
    # Levels of peaks are relative to the strongest peak, those of reflectors to the strongest reflector. A matched pair
    # determines the offset between the two references.
    step_db = _step_db(pairs, strongest_db if counted else 0.0)

    min_db = min_level_db + (strongest_db if counted else 0.0) - step_db
    left = [peak for peak in peaks if peak.level_db >= min_db and not any(peak is taken for _, taken in pairs)]
    left = [peak for peak in left if _place(peak) in listed]
    is_due = _explained(image, reflectors, left, lobe, in_view=in_view, counts=counts, step_db=step_db)
    return Comparison(
        matched=tuple(_match(image, reflector, peak, step_db) for reflector, peak in pairs),
        missed=tuple(reflector for reflector in counted if not any(reflector is found for found, _ in pairs)),
        spurious=tuple(observed(image, [peak for peak, due in zip(left, is_due, strict=True) if not due])),
        explained=tuple(observed(image, [peak for peak, due in zip(left, is_due, strict=True) if due])),
    )


def _place(peak: Peak) -> tuple[float, float, float]:
    """Return the place of a peak, which is the same in all lists of an image."""
    return peak.azimuth_deg, peak.elevation_deg, peak.range_m


def visible(image: Energyscape, reflectors: Sequence[Reflector]) -> NDArray[np.bool_]:
    """Return True for each reflector (reflector,) that an image can show, whatever its level."""
    return _in_range(image, reflectors) & _is_own(reflectors) & _in_view(image, reflectors, _lobe_of(image.settings))


def errors_of(comparisons: Iterable[Comparison]) -> Errors:
    """Return the errors over all reflectors of several images, one comparison per image."""
    given = list(comparisons)
    matches = [match for comparison in given for match in comparison.matched]
    ranges_m = [match.range_m for match in matches]
    return Errors(
        measurements=len(given),
        angle_rms_deg=_rms(match.angle_deg for match in matches if not math.isnan(match.angle_deg)),
        range_bias_m=math.fsum(ranges_m) / len(ranges_m) if ranges_m else None,
        range_rms_m=_rms(ranges_m),
        level_rms_db=_rms(match.level_db for match in matches),
        missed=sum(len(comparison.missed) for comparison in given),
        spurious=sum(len(comparison.spurious) for comparison in given),
        matched=len(matches),
    )


def _rms(values: Iterable[float]) -> float | None:
    squares = [value**2 for value in values]
    return math.sqrt(math.fsum(squares) / len(squares)) if squares else None


class _Lobe:
    """Main lobe of an array; infinitely wide for a single microphone.

    Near a reflector, the amplitude falls like ``exp(−k² Δuᵀ C Δu / 2)``. Δu is the difference of the unit vectors, and
    C is the weighted covariance of the microphone positions. k is the wave number at the centre of the call. For the
    shipped layouts, the width at half amplitude is accurate to one tenth. ``half_deg`` is half of it, along the
    narrowest axis.
    """

    def __init__(self, settings: Settings) -> None:
        positions_m = microphones(settings.array).enabled_positions_m
        rate_hz = settings.signal_rate_hz
        n_fft = math.ceil(settings.call.end_s * rate_hz) + 1
        centre_hz = matched_filter_spectrum(settings, n_fft=n_fft).centre_hz
        wave_1_m = 2 * math.pi * centre_hz / sound_speed_m_s(settings.air)
        scale = wave_1_m / _HALF_AMPLITUDE / math.sqrt(len(positions_m))
        self._reach = scale * positions_m * np.sqrt(array_weights(settings))[:, None]
        largest = float(np.linalg.norm(self._reach, ord=2))
        self.half_deg = math.degrees(1 / largest) if largest else math.inf

    def __call__(self, direction_offset: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return distances (...,) in half main lobes; 0 between a direction and its mirror image at a plane array."""
        return np.asarray(np.linalg.norm(direction_offset @ self._reach.T, axis=-1))


@functools.lru_cache(maxsize=64)
def _lobe_of(settings: Settings) -> _Lobe:
    return _Lobe(settings)


def _in_view(image: Energyscape, reflectors: Sequence[Reflector], lobe: _Lobe) -> NDArray[np.bool_]:
    """Return True for each reflector within the solid angle of an image: (reflector,) bool."""
    directions = unit_vectors(image.azimuth_rad, image.elevation_rad)
    chords = np.array([np.min(np.linalg.norm(directions - unit, axis=1)) for unit in _units(reflectors)])
    return np.asarray(_degrees_between(chords) <= lobe.half_deg)


def _is_own(reflectors: Sequence[Reflector]) -> NDArray[np.bool_]:
    """Return True for each reflector that returns the sensor's own call: (reflector,) bool."""
    return np.array([not reflector.emitter for reflector in reflectors], dtype=np.bool_)


def _in_range(image: Energyscape, reflectors: Sequence[Reflector]) -> NDArray[np.bool_]:
    """Return True for each reflector on the range axis, except its ends, which are never maxima: (reflector,) bool."""
    inner_m = image.range_m[1:-1] if len(image.range_m) > 2 else image.range_m
    ranges_m = np.array([reflector.range_m for reflector in reflectors])
    return np.asarray((ranges_m >= inner_m[0]) & (ranges_m <= inner_m[-1]))


def _assign(
    image: Energyscape, counted: Sequence[Reflector], peaks: Sequence[Peak], lobe: _Lobe
) -> list[tuple[Reflector, Peak]]:
    """Return the pairs of reflectors and peaks."""
    if not counted or not peaks:
        return []
    angles = _angles_deg(image, counted, peaks) / (_GATE_HALF_LOBES * lobe.half_deg)
    ranges = _range_offsets_m(counted, peaks) / _GATE_M
    near = (angles <= 1) & (np.abs(ranges) <= 1)
    dear = 2.0 * min(near.shape) + 1  # This cost exceeds the sum over all near pairs.
    rows, columns = scipy.optimize.linear_sum_assignment(np.where(near, angles**2 + ranges**2, dear))
    return [(counted[row], peaks[column]) for row, column in zip(rows, columns, strict=True) if near[row, column]]


def _step_db(pairs: Sequence[tuple[Reflector, Peak]], strongest_db: float) -> float:
    """Return the offset that converts levels of peaks to levels of reflectors, in dB."""
    if not pairs:
        return strongest_db
    reflector, peak = max(pairs, key=lambda pair: pair[0].level_db)
    return reflector.level_db - peak.level_db


def _match(image: Energyscape, reflector: Reflector, peak: Peak, step_db: float) -> Match:
    has_direction = observable_angles(image.settings.array).has_direction(is_planar=image.is_planar)
    return Match(
        reflector=reflector,
        peak=observed(image, [peak])[0],
        angle_deg=float(_angles_deg(image, [reflector], [peak])[0, 0]) if has_direction else math.nan,
        range_m=peak.range_m - reflector.range_m,
        level_db=peak.level_db + step_db - reflector.level_db,
    )


def _explained(
    image: Energyscape,
    reflectors: Sequence[Reflector],
    peaks: Sequence[Peak],
    lobe: _Lobe,
    *,
    in_view: NDArray[np.bool_],
    counts: NDArray[np.bool_],
    step_db: float,
) -> NDArray[np.bool_]:
    """Return True for each peak (peak,) caused by a reflector that need not be found there."""
    if not peaks or not reflectors:
        return np.zeros(len(peaks), dtype=np.bool_)
    offsets = _units(reflectors)[:, None] - _units(peaks)[None]
    alike = lobe(offsets) <= _GATE_HALF_LOBES
    apart = _angles_deg(image, reflectors, peaks) > _GATE_HALF_LOBES * lobe.half_deg
    weaker = np.array([peak.level_db + step_db for peak in peaks]) <= np.array(
        [[reflector.level_db + _SLACK_DB] for reflector in reflectors]
    )
    near = np.abs(_range_offsets_m(reflectors, peaks)) <= _GATE_M
    due = near & ((alike & (apart | ~counts[:, None])) | (weaker & ~in_view[:, None]))
    return np.asarray(np.any(due, axis=0))


def _units(places: Sequence[Reflector] | Sequence[Peak]) -> NDArray[np.float64]:
    """Return the directions as unit vectors: (place, axis) float64."""
    angles_rad = np.radians([[place.azimuth_deg, place.elevation_deg] for place in places]).reshape(-1, 2)
    return unit_vectors(angles_rad[:, 0], angles_rad[:, 1])


def _degrees_between(chords: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the angle between unit vectors from the length of their difference."""
    return np.asarray(np.degrees(2 * np.arcsin(np.minimum(chords / 2, 1.0))))


def _angles_deg(image: Energyscape, reflectors: Sequence[Reflector], peaks: Sequence[Peak]) -> NDArray[np.float64]:
    """Return the angles between reflectors and peaks that the array can observe: (reflector, peak) float64."""
    line = observable_angles(image.settings.array).line
    if line is not None:
        cones = (np.degrees(np.arccos(np.clip(_units(places) @ line, -1, 1))) for places in (reflectors, peaks))
        return np.asarray(np.abs(np.subtract.outer(*cones)))
    if image.is_planar:
        azimuths = ([place.azimuth_deg for place in places] for places in (reflectors, peaks))
        difference = np.subtract.outer(*azimuths)
        return np.asarray(np.abs((difference + 180) % 360 - 180))
    return _degrees_between(np.linalg.norm(_units(reflectors)[:, None] - _units(peaks)[None], axis=-1))


def _range_offsets_m(reflectors: Sequence[Reflector], peaks: Sequence[Peak]) -> NDArray[np.float64]:
    """Return the ranges of peaks minus those of reflectors, in metres: (reflector, peak) float64."""
    return np.subtract.outer([peak.range_m for peak in peaks], [reflector.range_m for reflector in reflectors]).T
