"""Declarations of the methods of acoustic maps."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias

from ertis_numba.base.errors import ArgumentError

if TYPE_CHECKING:
    from ertis_numba.settings.passive import Passive

__all__ = ["MAP_METHODS", "MapMethod", "MapMethodName"]

MapMethodName: TypeAlias = Literal["delay_and_sum", "functional", "capon", "music", "clean_sc", "hr_clean_sc"]


@dataclass(frozen=True, slots=True, kw_only=True)
class MapMethod:
    """Declaration of a method of acoustic maps.

    Attributes
    ----------
    title : str
        Name in publications, for captions.
    has_level : bool
        True if the powers have levels, by default; False for numbers that find directions only.
    is_sparse : bool
        True if maps have the powers of sources, and 0 elsewhere.
    is_linear : bool
        True if the powers of neighbouring bins follow the window of the spectrum.
    is_inverse : bool
        True if the inverses of the powers are quadratic forms of waves, and thus smooth over directions.
    removes_diagonal : bool
        True if the method supports ``passive.diagonal_removal``.
    order : callable
        Returns the exponent of the powers of delay-and-sum from the settings; 1 by default.
    peak : callable, optional
        Returns the power of one source relative to its maximum, given that of delay-and-sum, the number of microphones
        and the settings. Only for methods whose peaks are narrower than those of delay-and-sum.
    check : callable
        Raises `ArgumentError` if settings do not fit the number of microphones.
    """

    title: str
    has_level: bool = True
    is_sparse: bool = False
    is_linear: bool = False
    is_inverse: bool = False
    removes_diagonal: bool = False
    order: "Callable[[Passive], float]" = lambda _: 1.0
    peak: "Callable[[Any, int, Passive], Any] | None" = None
    check: "Callable[[Passive, int], None]" = lambda *_: None


def _functional_peak(power: Any, _: int, passive: "Passive") -> Any:
    return power**passive.functional_order


def _capon_peak(power: Any, n_mics: int, passive: "Passive") -> Any:
    """Return ``ε / (ε + M (1 − ρ²))`` with the loading ε, M microphones and the power ρ² of delay-and-sum."""
    return passive.diagonal_loading / (passive.diagonal_loading + n_mics * (1 - power))


def _require_fewer_sources(passive: "Passive", n_mics: int) -> None:
    if passive.n_sources >= n_mics:
        raise ArgumentError(
            f"passive.n_sources is {passive.n_sources}, but the array has {n_mics} microphones; use fewer than {n_mics}"
        )


MAP_METHODS: Final[Mapping[MapMethodName, MapMethod]] = MappingProxyType(
    {
        "delay_and_sum": MapMethod(title="delay-and-sum", is_linear=True, removes_diagonal=True),
        "functional": MapMethod(
            title="functional beamforming",
            is_linear=True,
            order=lambda passive: passive.functional_order,
            peak=_functional_peak,
        ),
        "capon": MapMethod(title="Capon", is_inverse=True, peak=_capon_peak),
        "music": MapMethod(title="MUSIC", has_level=False, is_inverse=True, check=_require_fewer_sources),
        "clean_sc": MapMethod(title="CLEAN-SC", is_sparse=True, removes_diagonal=True),
        "hr_clean_sc": MapMethod(title="HR-CLEAN-SC", is_sparse=True, removes_diagonal=True),
    }
)
"""Methods of acoustic maps by name; ``docs/explanation/acoustic-maps.md`` has their equations."""
