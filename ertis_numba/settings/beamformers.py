"""Registry of beamformers and weightings: options, kernel, weights and error of each, in one place."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

from ertis_numba.base.errors import ArgumentError
from ertis_numba.base.units import counted
from ertis_numba.settings.limits import Limits

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

__all__ = [
    "ADAPTIVE_COMBINATIONS",
    "BEAMFORMERS",
    "WEIGHTINGS",
    "Beamformer",
    "BeamformerName",
    "BeamformerOption",
    "SignalStream",
    "Weighting",
    "WeightingName",
]

BeamformerName = Literal["delay_and_sum", "dmas", "capon"]
WeightingName = Literal["none", "coherence_factor"]


class SignalStream(NamedTuple):
    """Signal ``|y|^power · exp(i turns φ)`` of each microphone, made from its analytic signal ``y = |y| exp(iφ)``."""

    power: float
    turns: int


@dataclass(frozen=True, slots=True)
class BeamformerOption:
    """Key of `Processing` for a beamformer, its limits, of type int for whole numbers, and help in one line."""

    name: str
    limits: Limits
    help: str


def _amplitudes(weights: "NDArray[np.complex64]", *_: float) -> "NDArray[np.complex64]":
    """Return weights whose magnitudes have a mean of 1, so that a mean over the microphones keeps amplitudes."""
    scaled: NDArray[np.complex64] = weights.shape[1] * weights
    return scaled


@dataclass(frozen=True, slots=True, kw_only=True)
class Beamformer:
    """Declaration of a beamformer; functions receive the values of its options after their first argument.

    - ``title``: name in publications, for captions.
    - ``kernel``: computes ``out`` from ``(analytic, offsets, weights, *options, out)``; empty for delay-and-sum.
    - ``weights``: makes those of the kernel, (direction, mic), from weights whose magnitudes add up to about 1; by
      default, it multiplies them by the number of microphones.
    - ``sensitivity``: coefficients of `Sensitivity` from the number of microphones; 1 and 0 by default.
    - ``streams``: from their sums, `combine_streams_int16` computes the amplitude: the power sums ``|y|^(k/n)
      exp(ikφ)``, k = 1 … n, of an elementary symmetric polynomial of order n. Without, only ``kernel`` can compute it.
    - ``cost``: time of ``kernel`` relative to delay-and-sum in single precision.
    - ``single_precision``: error power of an image in single precision from the number of microphones; 0 by default. If
      it is not far below the budget, the weights for the kernel have double precision.
    - ``check``: raises `ArgumentError` if the beamformer does not support the number of microphones.
    """

    title: str
    kernel: str
    options: tuple[BeamformerOption, ...] = ()
    weights: Callable[..., "NDArray[np.complex64]"] = _amplitudes
    sensitivity: Callable[..., tuple[float, float]] = lambda *_: (1.0, 0.0)
    streams: Callable[..., tuple[SignalStream, ...]] = lambda *_: ()
    cost: Callable[..., float] = lambda *_: 1.0
    single_precision: Callable[..., float] = lambda *_: 0.0
    check: Callable[..., None] = lambda *_: None

    def values(self, processing: object) -> tuple[Any, ...]:
        """Return the values of the options in processing settings."""
        return tuple(getattr(processing, option.name) for option in self.options)


@dataclass(frozen=True, slots=True, kw_only=True)
class Weighting:
    """Declaration of a weighting: a factor from 0 to 1 that multiplies each amplitude of any beamformer.

    ``kernel`` multiplies ``out`` from ``(analytic, offsets, weights, out)``. ``sensitivity`` is the increase of the
    image's relative error in units of that of delay-and-sum beams. ``streams`` are those of the beam and of the total
    power; without, only ``kernel`` can compute the factor. ``cost`` is relative to delay-and-sum in single precision.
    """

    title: str
    kernel: str
    sensitivity: float = 0.0
    streams: tuple[()] | tuple[SignalStream, SignalStream] = ()
    cost: float = 0.0


def _require_order(n_mics: int, order: int) -> None:
    """Check that the order of DMAS does not exceed the number of microphones."""
    if n_mics < order:
        raise ArgumentError(
            f"processing.dmas_order is {order}, but the array has {counted(n_mics, 'microphone')}; "
            "the order must not exceed the number of microphones. Use a lower order or another processing.beamformer"
        )


def _dmas_roots(weights: "NDArray[np.complex64]", order: int) -> "NDArray[np.complex64]":
    """Return roots of the weights, divided by a root of the number of products in the sum."""
    import numpy as np  # noqa: PLC0415  The help of commands reads this module, and need not wait for NumPy.

    n_mics = weights.shape[1]
    exact = _amplitudes(weights).astype(np.complex128)
    level = np.abs(exact)
    shrunk = np.power(level, 1 / order - 1, out=np.zeros_like(level), where=level != 0)
    # Every product has ``order`` factors, and each factor carries that root of the divisor. No sum overflows float32.
    roots = exact * shrunk * math.comb(n_mics, order) ** (-1 / order)
    return np.asarray(roots, dtype=np.complex64)


def _capon_sensitivity(n_mics: int, _: int, loading: float) -> tuple[float, float]:
    """Return coefficients for a beamformer that cancels an echo with delay errors, the less the more loading."""
    return 1 + 9 / (1 + loading / 0.01), n_mics / loading


def _capon_single_precision(n_mics: int, _: int, loading: float) -> float:
    """Return the error power of covariances in single precision, which is largest where microphones agree."""
    return (1e-7 * n_mics / loading) ** 2  # -111 dB were measured for 32 microphones and a loading of 1


_BEAM: Final = SignalStream(1.0, 1)

BEAMFORMERS: Final[Mapping[BeamformerName, Beamformer]] = MappingProxyType(
    {
        "delay_and_sum": Beamformer(title="delay-and-sum", kernel="", streams=lambda: (_BEAM,)),
        "dmas": Beamformer(
            title="DMAS",
            kernel="combine_dmas",
            options=(
                BeamformerOption("dmas_order", Limits(2, 8), "Microphone signals that dmas multiplies at a time"),
            ),
            weights=_dmas_roots,
            sensitivity=lambda _, order: (float(order), 0.0),  # error powers of the factors add up
            # Power sums, from which Newton's identities give the sum of the products.
            streams=lambda order: tuple(SignalStream(turns / order, turns) for turns in range(1, order + 1)),
            cost=lambda order: 3.0 + 4.0 * order,  # 11 and 25 times were measured for orders 2 and 5
            check=_require_order,
        ),
        "capon": Beamformer(
            title="Capon",
            kernel="combine_capon",
            options=(
                BeamformerOption("snapshots", Limits(1, 32), "Ranges from which capon estimates its covariance matrix"),
                BeamformerOption("diagonal_loading", Limits(1e-6, 1e6), "Loading of capon, relative to the mean power"),
            ),
            sensitivity=_capon_sensitivity,
            single_precision=_capon_single_precision,
        ),
    }
)
"""Beamformers by name, in the order of `BeamformerName`."""

WEIGHTINGS: Final[Mapping[WeightingName, Weighting]] = MappingProxyType(
    {
        "none": Weighting(title="no weighting", kernel=""),
        # Delay-and-sum with this weighting has the third power of the beam where microphones agree, and three times
        # the error power in noise.
        "coherence_factor": Weighting(
            title="coherence factor",
            kernel="weight_coherence",
            sensitivity=math.sqrt(3) - 1,
            streams=(_BEAM, SignalStream(2.0, 0)),
            cost=1.5,
        ),
    }
)
"""Weightings by name, in the order of `WeightingName`."""

ADAPTIVE_COMBINATIONS: Final = tuple(
    (beamformer, weighting)
    for weighting in WEIGHTINGS
    for beamformer in BEAMFORMERS
    if (beamformer, weighting) != ("delay_and_sum", "none")
)
"""All pairs of a beamformer and a weighting, except delay-and-sum without a weighting."""
