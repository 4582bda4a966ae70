"""Sound events from the bearings of successive maps."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Final

import numpy as np
import scipy

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import Bearing, SoundEvent
from ertis_numba.passive.direction_filter import DirectionFilter

__all__ = ["BearingTracker"]

_GATE: Final = 13.8  # Squared distance that 0.1 % of the bearings of a source exceed: χ² with two degrees of freedom.
_TRIAL_MAPS: Final = 3
_TRIAL_BEARINGS: Final = 2


class BearingTracker:
    """Tracker that joins bearings of successive maps into events, band by band.

    A Kalman filter predicts each direction: see `DirectionFilter`. Bearings are assigned to events so that the sum of
    their distances, in units of their uncertainty, is least. An event begins with two bearings in its first three maps,
    and ends after some maps without a bearing.

    Parameters
    ----------
    acceleration_deg_s : float
        Typical change of velocity in a second, in degrees per second; 5 by default.
    speed_deg_s : float
        Typical velocity of a source, in degrees per second; 20 by default.
    array_error_deg : float
        Standard deviation of errors of the array in degrees, which bearings do not state; 0.2 by default.
    max_misses : int
        Maps without a bearing after which an event ends; 3 by default.

    Raises
    ------
    ArgumentError
        An argument is outside its limits.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     camera = ertis.AcousticCamera(recording.settings)
    ...     finder, tracker = ertis.BearingFinder(camera), ertis.BearingTracker()
    ...     for measurement in recording:
    ...         camera.reset()
    ...         camera.add(measurement)
    ...         events = tracker.add(finder.find(), time_s=measurement.stamp.timestamp_ns * 1e-9)
    >>> all(event.is_over for event in tracker.finish())
    True
    """

    def __init__(
        self,
        *,
        acceleration_deg_s: float = 5.0,
        speed_deg_s: float = 20.0,
        array_error_deg: float = 0.2,
        max_misses: int = 3,
    ) -> None:
        self._motion = {
            "acceleration_deg_s": checks.between("acceleration_deg_s", acceleration_deg_s, 0.0, 1e4),
            "speed_deg_s": checks.between("speed_deg_s", speed_deg_s, 0.0, 1e4),
            "array_error_deg": checks.between("array_error_deg", array_error_deg, 1e-6, 90.0),
        }
        self._max_misses = checks.integer("max_misses", max_misses, 1)
        self._tracks: list[_Track] = []
        self._time_s, self._n_events = -math.inf, 0

    def add(self, bearings: Sequence[Bearing], *, time_s: float) -> list[SoundEvent]:
        """Add the bearings of the next map.

        Parameters
        ----------
        bearings : sequence of Bearing
        time_s : float
            Time of the map in seconds, on any clock.

        Returns
        -------
        list of SoundEvent
            Events that continue, and those that ended with this map.

        Raises
        ------
        ArgumentError
            The time is not after that of the map before.
        """
        if checks.finite("time_s", time_s) <= self._time_s:
            raise ArgumentError(
                f"time_s is {time_s:g}, but the map before has {self._time_s:g}; add maps in the order of their times"
            )
        for track in self._tracks:
            track.filter.predict(time_s - self._time_s)
        self._time_s = time_s
        free = list(checks.items("bearings", bearings, Bearing, "BearingFinder.find returns"))
        for band_hz in {bearing.band_hz for bearing in free} | {track.band_hz for track in self._tracks}:
            tracks = [track for track in self._tracks if track.band_hz == band_hz]
            here = [bearing for bearing in free if bearing.band_hz == band_hz]
            free = [bearing for bearing in free if bearing.band_hz != band_hz] + _assign(tracks, here, time_s)
        kept = [track for track in self._tracks if track.number or not track.has_failed()]
        for track in kept:
            if not track.number and track.n_bearings >= _TRIAL_BEARINGS:
                self._n_events += 1
                track.number = self._n_events
        over = [track for track in kept if track.n_missed >= self._max_misses]
        self._tracks = [track for track in kept if track.n_missed < self._max_misses]
        self._tracks += [_Track(bearing, time_s, DirectionFilter(bearing, **self._motion)) for bearing in free]
        return [
            track.event(is_over=is_over)
            for tracks, is_over in ((self._tracks, False), (over, True))
            for track in tracks
            if track.number
        ]

    def finish(self) -> list[SoundEvent]:
        """End all events, and return them."""
        tracks, self._tracks = self._tracks, []
        return [track.event(is_over=True) for track in tracks if track.number]


class _Track:
    """Bearings of one source, which are an event once it has a number."""

    def __init__(self, bearing: Bearing, time_s: float, direction_filter: DirectionFilter) -> None:
        self.filter, self.band_hz = direction_filter, bearing.band_hz
        self.number = self.n_missed = 0
        self.n_bearings = self._n_maps = 1
        self._start_s, self._level_dbfs = time_s, bearing.level_dbfs
        self._last = self._state(time_s)

    def update(self, bearing: Bearing, time_s: float) -> None:
        """Add a bearing, and keep the state: predictions beyond the last bearing are not part of the event."""
        self.filter.update(bearing)
        self.n_bearings, self._n_maps, self.n_missed = self.n_bearings + 1, self._n_maps + 1, 0
        self._level_dbfs = max(self._level_dbfs, bearing.level_dbfs)
        self._last = self._state(time_s)

    def miss(self) -> None:
        """Count a map without a bearing."""
        self.n_missed, self._n_maps = self.n_missed + 1, self._n_maps + 1

    def has_failed(self) -> bool:
        """Return True if too few of the first maps had a bearing."""
        return self.n_bearings < _TRIAL_BEARINGS and self._n_maps >= _TRIAL_MAPS

    def event(self, *, is_over: bool) -> SoundEvent:
        """Return the event up to its last bearing."""
        return dataclasses.replace(self._last, number=self.number, is_over=is_over)

    def _state(self, time_s: float) -> SoundEvent:
        x, y, z = self.filter.direction
        sizes = np.degrees(np.sqrt(np.diag(self.filter.covariance)))
        velocity = np.degrees(self.filter.velocity_rad_s)
        return SoundEvent(
            number=self.number,
            band_hz=self.band_hz,
            start_s=self._start_s,
            end_s=time_s,
            azimuth_deg=math.degrees(math.atan2(y, x)),
            elevation_deg=math.degrees(math.asin(max(-1.0, min(1.0, float(z))))),
            sideways_deg=float(sizes[0]),
            upwards_deg=float(sizes[1]),
            sideways_deg_s=float(velocity[0]),
            upwards_deg_s=float(velocity[1]),
            level_dbfs=self._level_dbfs,
            n_bearings=self.n_bearings,
            is_over=False,
        )


def _assign(tracks: list[_Track], bearings: list[Bearing], time_s: float) -> list[Bearing]:
    """Update the tracks of a band with its bearings, and return those that belong to no track."""
    distance = np.array([[track.filter.distance(bearing) for bearing in bearings] for track in tracks])
    distance = distance.reshape(len(tracks), len(bearings))
    rows, columns = scipy.optimize.linear_sum_assignment(np.minimum(distance, 10 * _GATE))
    taken = {int(row): int(column) for row, column in zip(rows, columns, strict=True) if distance[row, column] <= _GATE}
    for row, track in enumerate(tracks):
        if row in taken:
            track.update(bearings[taken[row]], time_s)
        else:
            track.miss()
    return [bearing for column, bearing in enumerate(bearings) if column not in taken.values()]
