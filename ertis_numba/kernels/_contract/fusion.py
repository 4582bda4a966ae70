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
    "BESIDE_DB",
    "BESIDE_M",
    "LAST_PATH_M",
    "LEAST_COSINE",
    "NEAREST_M",
    "NEGLIGIBLE",
    "SPREADING_M",
    "FusionKernels",
    "HeardEchoes",
    "PredictedPlaces",
    "SeenPlaces",
    "ViewingSensors",
]

AUDIBLE: Final = 10 ** (-25.0 / 10)
"""Power that an emitter radiates in a direction, relative to ahead, above which its echoes are audible."""
BESIDE_DB: Final = (-13.0, -16.0)
"""Power of a call to the side from which its path is uncertain, and most uncertain."""
BESIDE_M: Final = 6e-3
"""Largest error of such a path."""
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

Truths = NDArray[np.bool_]
Doubles = NDArray[np.float64]
Places = NDArray[np.int64]


class CoarsenImage(Protocol):
    """Reduce an image to the highest power of each coarse step, and separate noise and side lobes.

    Parameters
    ----------
    amplitude : (direction, range) float32
    first : (step + 1,) uint32
        First range of each step; equal ones for a step without ranges.
    is_deaf : (step,) bool
        Steps without audible echoes, whose power is 0.
    close : (direction, neighbour) uint32
        Directions within the error of a direction.
    side_lobes : float32
        Power of side lobes, relative to the strongest direction of a step and of both adjacent steps, because a pulse
        covers several steps.
    least : float32
        Least floor.
    floor : (step,) float32
        Output: power that noise and side lobes may reach.
    highest : (direction, step) float32
        Output: highest power of the close directions at a step and beside it.
    out : (direction, step) float32
        Power above the floor, 0 below it.
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
    """Return the highest value of each cell and its neighbours.

    Parameters
    ----------
    values : (row, azimuth, range) float32
    reach : int
        Number of neighbouring azimuths on each side, which are cyclic; ranges have one.
    out : (row, azimuth, range) float32
    """

    def __call__(self, values: Real, reach: int, out: Real) -> None: ...


class PredictEchoes(Protocol):
    """Predict the power of the echoes of reflectors, within a main lobe around each direction.

    Parameters
    ----------
    begin : (direction,) uint32
        First half-step of each direction with an entry. A step has three: its start, its middle and its end, which is
        the start of the next one. The highest echo counts.
    bounds : (direction + 1,) uint32
        Bounds of the entries of each direction, one for each half-step.
    cell : (entry,) uint32
        Cell that causes an echo.
    gain : (entry,) float32
        Gain of this echo; 0 for none.
    reflectivity : (cell,) float32
    lobe : (direction, neighbour) uint32
        Directions within the main lobe of each direction.
    out : (direction, step) float32
    """

    def __call__(
        self, begin: Turns, bounds: Turns, cell: Turns, gain: Real, reflectivity: Real, lobe: Turns, out: Real
    ) -> None: ...


class ShareEchoes(Protocol):
    """Compute the share of each pixel's power that belongs to one hypothesis.

    With the rivals' predicted power R, the share is ``1 − suppression · R / power``, limited to 0 to 1. With the
    predicted own power P, a pixel whose reflector other pairs confirm has a share of at least ``(P / (P + R))³``. The
    share is multiplied by ``part``.

    Parameters
    ----------
    predicted : (hypothesis, pixel) float32
    total : (pixel,) float32
        Sum over hypotheses.
    same_pixel, same_hypothesis : (entry,) uint32
        Hypotheses that lead to the same place in a pixel, and are no rivals there.
    power : (pixel,) float32
    part : (pixel,) float32
        Factor of the result.
    confirmed : (pixel,) float32
        Power of echoes that other pairs confirm; empty if unknown.
    number : int
        Index of the hypothesis.
    suppression, least_confirmed : float32
        Factor of rivals, and confirmed power relative to a pixel from which its reflector is confirmed.
    out : (pixel,) float32
    """

    def __call__(
        self,
        predicted: Real,
        total: Real,
        same_pixel: Turns,
        same_hypothesis: Turns,
        power: Real,
        part: Real,
        confirmed: Real,
        number: int,
        suppression: np.float32,
        least_confirmed: np.float32,
        out: Real,
    ) -> None: ...


class GatherEvidence(Protocol):
    """Gather the floor, the highest power and the weight of the echoes of a pair.

    Parameters
    ----------
    first, second : (entry,) uint32
        Pixels of two neighbouring directions.
    between : (entry,) float32
        Weight of the second pixel.
    step : (entry,) uint32
    gain, weight : (entry,) float32
        Gain of the echo, and weight of the pair. The weight of an echo is ``weight · (gain / floor)²``.
    highest : (pixel,) float32
    floor : (step,) float32
    out : (3, entry) float32
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
    """Add the weighted reflectivities that a pair shows, and the weights.

    Parameters
    ----------
    cell, first, second : (entry,) uint32
    between : (entry,) float32
    weight, lifted : (entry,) float32
        Weight and gain of each echo.
    power : (pixel,) float32
    share : (pixel,) float32
        Share of the power that belongs to the pair; empty for all of it.
    is_foreign : bool
        True if shares are also factors of the weights.
    out : (2, cell) float32
        Sums of weighted reflectivities and of weights, to which the kernel adds.
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
    """Add the products of the lobes and the pulses of echoes.

    Matrix products of BLAS take several times as long, because lobes are narrow, and some use all cores.

    Parameters
    ----------
    lobe : (echo, direction) float32
        Values up to `NEGLIGIBLE` count as 0.
    pulse : (echo, step) float32
    out : (direction, step) float32
        Sums, to which the kernel adds.
    """

    def __call__(self, lobe: Real, pulse: Real, out: Real) -> None: ...


class LimitCells(Protocol):
    """Limit cells to the reflectivity that a pair shows.

    Parameters
    ----------
    cell : (entry,) uint32
    is_used : (entry,) bool
    gain : (entry,) float32
    evidence : (3, entry) float32
        Result of `GatherEvidence`.
    margin : float32
        Factor of the highest power and the floor.
    out : (cell,) float32
    """

    def __call__(
        self, cell: Turns, is_used: Truths, gain: Real, evidence: Real, margin: np.float32, out: Real
    ) -> None: ...


class ConfirmCells(Protocol):
    """Limit cells to the reflectivity that a pair confirms, where its echo must be visible.

    Parameters
    ----------
    cell, is_used, gain, evidence
        As in `LimitCells`.
    reflectivity : (cell,) float32
        Expected reflectivity.
    visible : float32
        Power of a visible echo relative to the floor.
    skipped : int
        Row that the pair does not limit; −1 for none.
    out : (row, cell) float32
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
    """Add the reflectivity that a pair shows, and the expected one, over the cells with visible echoes.

    Parameters
    ----------
    cell, is_used, gain, evidence, reflectivity, visible
        As in `ConfirmCells`.
    strong : float32
        Expected reflectivity above which a cell counts.
    out : (2,) float64
        Sums, to which the kernel adds.
    """

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


class LocateReflector(Protocol):
    """Locate a reflector by the paths and directions of its echoes.

    Least squares with the weights of a Cauchy distribution (P. J. Huber, E. M. Ronchetti, Robust Statistics, 2009),
    because echoes that overlap at one sensor shift its direction or range by far more than noise does.

    Parameters
    ----------
    emitter_m, receiver_m : (echo, axis) float64
    path_m : (echo,) float64
        Path of the sound.
    axes : (echo, 3, axis) float64
        Direction from the receiver, and two unit vectors across.
    deviation : (echo, 2) float64
        Standard deviations of the path in metres and of the direction in radians.
    information : float
        Information about each coordinate in 1/m² that is known beforehand.
    nearest_m : float
        Least distance from emitters and receivers.
    outlier : float
        Residual, in standard deviations, that has half of the weight; infinite for plain least squares.
    n_rounds : int
        Iterations; at least 1.
    position_m : (axis,) float64
        Position, from a first estimate.
    out : (axis, axis) float64
        Covariance before the last update: the inverse of the weighted normal matrix.
    """

    def __call__(
        self,
        emitter_m: Doubles,
        receiver_m: Doubles,
        path_m: Doubles,
        axes: Doubles,
        deviation: Doubles,
        information: float,
        nearest_m: float,
        outlier: float,
        n_rounds: int,
        position_m: Doubles,
        out: Doubles,
    ) -> None: ...


class PredictedPlaces(NamedTuple):
    """Possible reflectors as the sensors see them.

    Attributes
    ----------
    apart_m : (place, sensor) float64
        Distances.
    seen : (place, sensor, axis) float64
        Directions in which the echoes appear.
    depth : (place, sensor) float64
        Cosines of the angles to the axes of the sensors; those behind are negative.
    slope_m : (place, sensor) float64
        Change of the distances over one standard deviation of the place, …
    across_m2 : (place,) float64
        … and its square, across the direction.
    expected : (place, receiver, emitter) float64
        Expected powers.
    extra_m2 : (place, emitter) float64
        Variances of paths in addition to those of the echoes.
    is_flat : (sensor,) bool
        Receivers that hear echoes from behind.
    """

    apart_m: Doubles
    seen: Doubles
    depth: Doubles
    slope_m: Doubles
    across_m2: Doubles
    expected: Doubles
    extra_m2: Doubles
    is_flat: Truths


class HeardEchoes(NamedTuple):
    """Echoes in the images of all receivers.

    Attributes
    ----------
    receiver : (echo,) int64
    direction : (echo, axis) float64
    path_m : (echo, emitter) float64
        Length of the path if the emitter's call caused the echo; NaN if it did not.
    gate_rad2, gate_m2 : (echo,) float64
        Variances of directions and of paths.
    power : (echo,) float64
    """

    receiver: Places
    direction: Doubles
    path_m: Doubles
    gate_rad2: Doubles
    gate_m2: Doubles
    power: Doubles


class MatchEchoes(Protocol):
    """Find the echoes that reflectors at given places explain, by path, direction and power.

    Parameters
    ----------
    chosen : (some,) int64
        Echoes to match.
    gate : float
        Largest sum of squares, in units of variances.
    alike : float
        Largest ratio of the power to the expected one. Echoes from behind may be weaker.
    found : (3, count) int64
        Output: place, echo and emitter of the first matches.
    out : (count,) float64
        Output: their sums of squares.

    Returns
    -------
    int
        Number of all matches, which may exceed the space for them.
    """

    def __call__(
        self,
        places: PredictedPlaces,
        echoes: HeardEchoes,
        chosen: Places,
        gate: float,
        alike: float,
        found: Places,
        out: Doubles,
    ) -> int: ...


class ViewingSensors(NamedTuple):
    """Sensors of a platform, and the sound that their emitters radiate.

    Attributes
    ----------
    sensor_m, ahead : (sensor, axis) float64
        Positions and axes.
    is_flat : (sensor,) bool
        Receivers that hear echoes from behind.
    model : (receiver,) int64
        Model of the emitters in the air of each receiver; -1 for receivers without an image.
    patterns : (model, emitter, cosine) float64
        Power that each emitter radiates, relative to that ahead, for evenly spaced cosines from -1 to 1.
    lost : (model, path) float64
        Logarithm of the power after evenly spaced paths from 0 to `LAST_PATH_M`, without spreading.
    """

    sensor_m: Doubles
    ahead: Doubles
    is_flat: Truths
    model: Places
    patterns: Doubles
    lost: Doubles


class SeenPlaces(NamedTuple):
    """Places seen from all sensors.

    Attributes
    ----------
    apart_m : (place, sensor) float64
        Distances.
    toward : (place, sensor, axis) float64
        Unit vectors to the places.
    depth : (place, sensor) float64
        Cosines of the angles to the axes of the sensors.
    seen : (place, sensor, axis) float64
        Directions in which the echoes appear: a flat array shows those from behind in front.
    radiated : (place, emitter) float64
        Power of each call towards the places, relative to ahead.
    gain : (place, receiver, emitter) float64
        Power of echoes relative to 1 m ahead, 0 where they are inaudible.
    beside_m : (place, emitter) float64
        Errors of paths from emitters beside their beams. There, what a piston radiates depends on the frequency, and
        echoes come early or late.
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


class SeePlaces(Protocol):
    """Compute how the sensors of a platform see places.

    Parameters
    ----------
    place_m : (place, axis) float64
    """

    def __call__(self, place_m: Doubles, sensors: ViewingSensors, out: SeenPlaces) -> None: ...


class FindArrivals(Protocol):
    """Find the echoes that fit sound from given places, by path and direction.

    Parameters
    ----------
    origin_m : (source, emitter, axis) float64
        Place from which the call of each emitter arrives; NaN for none.
    sent_m : (source, emitter) float64
        Path of the call to this place.
    sensor_m, ahead : (sensor, axis) float64
        Positions and axes of the sensors.
    is_flat : (sensor,) bool
        Receivers that hear echoes from behind.
    receiver : (echo,) int64
    direction : (echo, axis) float64
    path_m : (echo, emitter) float64
        Length of the path if the emitter's call caused the echo; NaN if it did not.
    within_m, within_rad : float
        Largest differences of paths, and of directions ahead of the receiver.
    found : (3, count) int64
        Output: source, emitter and echo of the first matches, in ascending order.

    Returns
    -------
    int
        Number of all matches, which may exceed the space for them.
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
    find_arrivals: FindArrivals
    see_places: SeePlaces
