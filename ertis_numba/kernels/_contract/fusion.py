"""Contracts of the kernels of fusion: powers of images to reflectivities of cells, for one thread.

Pixels are (direction, step) of one receiver, flattened; cells are those of the fused image. Entries are the cells or
pixels of one pair of emitter and receiver. ``cell`` of `AddEchoes`, `LimitCells` and `ConfirmCells` holds no cell
twice. Other indices may repeat.
"""

from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ertis_numba.kernels._contract.arrays import Real, Turns

__all__ = [
    "AUDIBLE",
    "DISTURBING",
    "LAST_PATH_M",
    "LEAST_COSINE",
    "NEAREST_M",
    "NEGLIGIBLE",
    "SPREADING_M",
    "FusionKernels",
    "HeardEchoes",
    "SeenPlaces",
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
NEGLIGIBLE: Final = 1e-20
"""Values of lobes that are left out. Products with them may be denormal, which takes a hundred times as long."""
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


class CoarsenImage(Protocol):
    """Reduce an image to the highest power of each coarse step, and separate noise and side lobes.

    ``first`` (step + 1,) are the first ranges, equal for a step without ranges; ``is_deaf`` (step,) steps have the
    power 0. ``close`` (direction, neighbour) lie within the error of a direction. ``side_lobes`` are relative to the
    strongest direction of a step and of both adjacent steps, because a pulse covers several steps. Outputs: ``floor``
    (step,), the power that noise and side lobes may reach, at least ``least``; ``highest`` (direction, step), the power
    of close directions at a step and beside it; ``out`` (direction, step), the power above the floor, 0 below it.
    """

    def __call__(
        self,
        amplitude: Real,
        first: Turns,
        is_deaf: Truths,
        close: Turns,
        side_lobes: np.float32,
        least: np.float32,
        floor: Real,
        highest: Real,
        out: Real,
    ) -> None: ...


class SpreadCells(Protocol):
    """Compute the highest value of each cell and its neighbours: one range and ``reach`` cyclic azimuths each side."""

    def __call__(self, values: Real, reach: int, out: Real) -> None: ...


class PredictEchoes(Protocol):
    """Predict the power of the echoes of reflectors, within a main lobe around each direction: (direction, step).

    Entries from ``bounds[direction]`` on, for half-steps from ``begin[direction]`` on, state the ``cell`` that causes
    an echo and its ``gain``. A step has three: its start, its middle and its end, the start of the next one. The
    highest counts. ``lobe`` (direction, neighbour) are the directions in the main lobe.
    """

    def __call__(
        self, begin: Turns, bounds: Turns, cell: Turns, gain: Real, reflectivity: Real, lobe: Turns, out: Real
    ) -> None: ...


class ShareEchoes(Protocol):
    """Compute the shares (share, pixel) of each pixel's power that belong to the hypotheses ``wanted`` (share,).

    ``predicted`` (hypothesis, pixel) are the powers that all hypotheses predict. With the rivals' predicted power R,
    the share is ``1 − suppression · R / power``, limited to 0 to 1. With the predicted own power P, a pixel whose
    reflector other pairs confirm has a share ``own`` of at least ``(P / (P + R))³``. Shares are multiplied by ``part``
    (share, pixel). ``same_pixel`` and ``same_hypothesis`` (entry,), from ``bounds[share]`` on, lead to one place and
    are no rivals. ``confirmed`` is empty if unknown; ``least_confirmed`` is relative to a pixel.
    """

    def __call__(
        self,
        predicted: Real,
        wanted: Turns,
        bounds: Turns,
        same_pixel: Turns,
        same_hypothesis: Turns,
        power: Real,
        part: Real,
        confirmed: Real,
        own: int,
        suppression: np.float32,
        least_confirmed: np.float32,
        out: Real,
    ) -> None: ...


class GatherEvidence(Protocol):
    """Gather the floor, the highest power and the weight of the echoes of a pair: (3, entry).

    ``first`` and ``second`` are pixels of two neighbouring directions, ``between`` the weight of the second one. The
    weight of an echo is ``weight · (gain / floor)²``.
    """

    def __call__(
        self,
        first: Turns,
        second: Turns,
        between: Real,
        step: Turns,
        gain: Real,
        weight: Real,
        highest: Real,
        floor: Real,
        out: Real,
    ) -> None: ...


class AddEchoes(Protocol):
    """Add the weighted reflectivities that a pair shows, and the weights, to ``out`` (2, cell).

    Pixels are those of `GatherEvidence`; ``lifted`` (entry,) is the gain of an echo. ``share`` (pixel,) of the power
    belongs to the pair, all if it is empty; with ``is_foreign``, shares are also factors of the weights.
    """

    def __call__(
        self,
        cell: Turns,
        first: Turns,
        second: Turns,
        between: Real,
        weight: Real,
        lifted: Real,
        power: Real,
        share: Real,
        is_foreign: bool,  # noqa: FBT001  kernels take no keywords
        out: Real,
    ) -> None: ...


class AddLobes(Protocol):
    """Add the products of lobes (echo, direction), 0 up to `NEGLIGIBLE`, and pulses (echo, step) to (direction, step).

    Matrix products of BLAS take several times as long, because lobes are narrow, and some use all cores.
    """

    def __call__(self, lobe: Real, pulse: Real, out: Real) -> None: ...


class LimitCells(Protocol):
    """Limit cells to the reflectivity that a pair shows in the result of `GatherEvidence`, times ``margin``."""

    def __call__(
        self, cell: Turns, is_used: Truths, gain: Real, evidence: Real, margin: np.float32, out: Real
    ) -> None: ...


class ConfirmCells(Protocol):
    """Limit cells (row, cell) to the reflectivity that a pair confirms, where its echo must be visible.

    ``reflectivity`` is the expected one, ``visible`` the power of a visible echo relative to the floor, and ``skipped``
    the row that the pair does not limit, −1 for none.
    """

    def __call__(
        self,
        cell: Turns,
        is_used: Truths,
        gain: Real,
        evidence: Real,
        reflectivity: Real,
        visible: np.float32,
        skipped: int,
        out: Real,
    ) -> None: ...


class CompareEchoes(Protocol):
    """Add the shown and the expected reflectivity (2,) of cells above ``strong`` with echoes as in `ConfirmCells`."""

    def __call__(
        self,
        cell: Turns,
        is_used: Truths,
        gain: Real,
        evidence: Real,
        reflectivity: Real,
        visible: np.float32,
        strong: np.float32,
        out: Doubles,
    ) -> None: ...


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


@dataclass(frozen=True, slots=True, kw_only=True)
class FusionKernels:
    """Kernels of fusion of one device, all for one thread."""

    coarsen_image: CoarsenImage
    spread_cells: SpreadCells
    predict_echoes: PredictEchoes
    share_echoes: ShareEchoes
    gather_evidence: GatherEvidence
    add_echoes: AddEchoes
    add_lobes: AddLobes
    limit_cells: LimitCells
    confirm_cells: ConfirmCells
    compare_echoes: CompareEchoes
    locate_reflector: LocateReflector
    match_echoes: MatchEchoes
    find_maxima: FindMaxima
    find_arrivals: FindArrivals
    see_places: SeePlaces
    overlap_echoes: OverlapEchoes
