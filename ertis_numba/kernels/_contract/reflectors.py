"""Contracts of the kernels of fusion that locate reflectors by echoes, for one thread."""

from typing import Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ertis_numba.kernels._contract.arrays import Real

__all__ = [
    "AUDIBLE",
    "DISTURBING",
    "GRAZING",
    "LAST_PATH_M",
    "LEAST_COSINE",
    "NEAREST_M",
    "SHIFT",
    "SIDE_LOBES",
    "SPREAD",
    "SPREADING_M",
    "TILT",
    "Doubles",
    "FindArrivals",
    "FindMaxima",
    "HeardEchoes",
    "LocateReflector",
    "MatchEchoes",
    "OverlapEchoes",
    "Places",
    "SeePlaces",
    "SeenPlaces",
    "Truths",
    "ViewingSensors",
]

AUDIBLE: Final = 10 ** (-25.0 / 10)
"""Power that an emitter radiates in a direction, relative to ahead, above which its echoes are audible."""
LAST_PATH_M: Final = 256.0
"""Last path of sound whose absorption is tabulated."""
SPREADING_M: Final = 0.05
"""Distance below which spreading does not increase."""
NEAREST_M: Final = 1e-9
"""Least distance of a place from a sensor."""
LEAST_COSINE: Final = 0.25
"""Directions are less certain beside a flat array, by up to the reciprocal of this factor."""
DISTURBING: Final = 1e-4
"""Power relative to that of an echo, from which another one disturbs it."""
GRAZING: Final = 0.1
"""Least cosine of the angle to the axis of the array."""
SHIFT: Final = 0.28
"""Error of a path or a direction relative to the distance of an equally strong echo."""
SIDE_LOBES: Final = 10 ** (-21.0 / 10)
"""Mean power of side lobes of sparse arrays, relative to the main lobe, …"""
SPREAD: Final = 0.33
"""… over a path relative to the pulse and to the change of direction in widths of the beam, …"""
TILT: Final = 0.5
"""… and the error of a direction by their slopes, relative to the width and to their amplitude."""

Truths = NDArray[np.bool_]
Doubles = NDArray[np.float64]
Places = NDArray[np.int64]


class ViewingSensors(NamedTuple):
    """Sensors of a platform, and the sound that their emitters radiate; ``is_flat`` receivers hear echoes from behind.

    ``model`` (receiver,): that of the emitters in its air, -1 without an image. ``patterns`` (model, emitter, cosine):
    power relative to ahead for evenly spaced cosines from -1 to 1. ``lost`` (model, path): logarithm of the power after
    evenly spaced paths from 0 to `LAST_PATH_M`, without spreading. ``beside_m`` (emitter, cosine): as in `SeenPlaces`.
    """

    sensor_m: Doubles
    ahead: Doubles
    is_flat: Truths
    model: Places
    patterns: Doubles
    lost: Doubles
    beside_m: Doubles


class SeenPlaces(NamedTuple):
    """Places seen from all sensors.

    ``apart_m`` (place, sensor) are distances, ``toward`` unit vectors to the places, ``depth`` cosines to the axes of
    the sensors, and ``seen`` directions in which echoes appear: a flat array shows those from behind in front.
    ``radiated`` (place, emitter) is relative to ahead, and ``gain`` (place, receiver, emitter) to 1 m ahead, 0 where
    echoes are inaudible. ``beside_m`` (place, emitter): errors of paths from emitters beside their beams. There, what a
    piston radiates depends on the frequency, and echoes come early or late.
    """

    apart_m: Doubles
    toward: Doubles
    depth: Doubles
    seen: Doubles
    radiated: Doubles
    gain: Doubles
    beside_m: Doubles

    def only(self, number: int) -> "SeenPlaces":
        """Return one of the places."""
        return SeenPlaces._make(each[number : number + 1] for each in self)


class HeardEchoes(NamedTuple):
    """Echoes in the images of all receivers; ``path_m`` (echo, emitter) is NaN if its call did not cause the echo.

    ``axes`` (echo, 3, axis) are the direction from the receiver and two unit vectors across, ``deviation`` (echo, 2)
    those of the path in m and of the direction in rad. ``gate_rad2`` and ``gate_m2`` are the variances of directions
    and of paths in a search.
    """

    receiver: Places
    path_m: Doubles
    axes: Doubles
    deviation: Doubles
    gate_rad2: Doubles
    gate_m2: Doubles
    power: Doubles


class LocateReflector(Protocol):
    """Locate a reflector by the paths and directions of its echoes; ``position_m`` starts at a first estimate.

    Least squares with the weights of a Cauchy distribution (P. J. Huber, E. M. Ronchetti, Robust Statistics, 2009),
    because echoes that overlap at one sensor shift its direction or range by far more than noise does. ``echo`` and
    ``emitter`` (member,) are its echoes, with ``added`` variances (member, 2), none if it is empty. Receivers hear
    echoes from behind in front. ``information`` in 1/m² about each coordinate is known beforehand. ``outlier``:
    residual in standard deviations that has half of the weight; infinite for plain least squares. ``out`` (axis, axis):
    covariance before the last update.
    """

    def __call__(
        self,
        sensor_m: Doubles,
        ahead: Doubles,
        echoes: HeardEchoes,
        echo: Places,
        emitter: Places,
        added: Doubles,
        information: float,
        nearest_m: float,
        outlier: float,
        n_rounds: int,
        position_m: Doubles,
        out: Doubles,
    ) -> None: ...


class MatchEchoes(Protocol):
    """Find the echoes that reflectors at given places explain, by path, direction and power; return their number.

    The number may exceed the space for them. ``across`` (place, axis): a vector across the direction, as long as one
    standard deviation of the place. ``reflectivity`` (place,) is the expected one. ``extra_m``: standard deviation of
    paths beside those of the echoes. ``is_flat`` receivers hear echoes from behind. ``chosen``: echoes to match.
    ``gate``: largest sum of squares, in variances. ``alike``: largest ratio of the power to the expected one; echoes
    from behind may be weaker. Outputs: ``found`` (3, count), place, echo and emitter of the first matches, and their
    sums of squares.
    """

    def __call__(
        self,
        places: SeenPlaces,
        across: Doubles,
        reflectivity: Doubles,
        extra_m: float,
        is_flat: Truths,
        echoes: HeardEchoes,
        chosen: Places,
        gate: float,
        alike: float,
        found: Places,
        out: Doubles,
    ) -> int: ...


class SeePlaces(Protocol):
    """Compute how the sensors of a platform see places (place, axis)."""

    def __call__(self, place_m: Doubles, sensors: ViewingSensors, out: SeenPlaces) -> None: ...


class FindMaxima(Protocol):
    """Compute the highest amplitudes around bins of an image: ``out`` (2, place, bin).

    The first ones are those of the directions ``is_near`` (place, direction), up to ``near`` ranges beside a bin's
    ``column`` (place, bin). The second ones are those of all directions, up to ``beside`` ranges beside it.
    """

    def __call__(
        self, amplitude: Real, is_near: Truths, column: Places, near: int, beside: int, out: Doubles
    ) -> None: ...


class FindArrivals(Protocol):
    """Find the echoes that fit sound from given places, by path and direction; return their number.

    The number may exceed the space for them. ``origin_m`` (source, emitter, axis): place from which a call arrives, NaN
    for none, after the path ``sent_m``. ``path_m`` (echo, emitter) is NaN if the call did not cause the echo. Output
    ``found`` (3, count): source, emitter and echo of the first matches, in ascending order.
    """

    def __call__(
        self,
        origin_m: Doubles,
        sent_m: Doubles,
        sensor_m: Doubles,
        ahead: Doubles,
        is_flat: Truths,
        receiver: Places,
        direction: Doubles,
        path_m: Doubles,
        within_m: float,
        within_rad: float,
        found: Places,
    ) -> int: ...


class OverlapEchoes(Protocol):
    """Compute how much the echoes of reflectors disturb others: ``out`` (3, echo, reflector).

    Outputs are the relative power, and the variances of path and direction. Two echoes within the width of the
    compressed pulse and of the beam have one maximum, or several at other places, depending on their phases. The error
    grows with the ratio of the amplitudes, and with the distance up to the width. Pulses with side lobes fall off as
    ``(1 + x²)^-1.75`` over a path of x widths: they are 26 dB down at six widths, and 40 dB at fourteen. Predictions
    ``path_m`` and ``power`` (reflector, receiver, emitter) and ``direction`` (reflector, receiver, axis) are compared
    with echoes at a ``receiver`` (echo,), ``heard_m`` (echo, emitter), NaN for silent emitters, ``toward`` (echo, axis)
    and ``loudness`` (echo,), except where ``is_other`` (echo, reflector, emitter) is False: the prediction of the echo
    itself. ``ahead`` (sensor, axis) are the axes of arrays, ``pulse_m`` (sensor,) is a path, and ``beam`` (sensor,) a
    difference of unit vectors.
    """

    def __call__(
        self,
        path_m: Doubles,
        power: Doubles,
        direction: Doubles,
        receiver: Places,
        heard_m: Doubles,
        toward: Doubles,
        loudness: Doubles,
        is_other: Truths,
        ahead: Doubles,
        pulse_m: Doubles,
        beam: Doubles,
        out: Doubles,
    ) -> None: ...
