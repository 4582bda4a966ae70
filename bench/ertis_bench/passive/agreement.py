"""Differences between the maps of this package and those of Acoular, for the same signals."""

from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_bench.passive._acoular import AcousticMapper
from ertis_bench.passive.sound_signals import N_BLOCK, OWN_RMS, SOURCES, listening, noise
from ertis_numba.base.errors import DataError
from ertis_numba.passive import AcousticCamera

__all__ = ["CASES", "WITHIN_DB", "Case", "bins_of", "compare"]

Powers = NDArray[np.float64]

WITHIN_DB: Final = 30.0
"""Levels are compared down to this level below the maximum of each bin."""

_DIRECTIONS: Final = "3d:400"
_CLEAN_STEP: Final = 12  # bins, since Acoular's CLEAN-SC takes longest


class Case(NamedTuple):
    """Method with its settings."""

    passive: dict[str, Any]
    limit_db: float = 0.1


CASES: Final[dict[str, Case]] = {
    "delay_and_sum": Case({}),
    "delay_and_sum, diagonal removed": Case({"diagonal_removal": True}),
    "functional, order 8": Case({"method": "functional"}),
    "capon, loading 1e-6": Case({"method": "capon", "diagonal_loading": 1e-6}),
    "music, 3 sources": Case({"method": "music", "n_sources": len(SOURCES)}),
    "clean_sc, diagonal removed": Case({"method": "clean_sc", "diagonal_removal": True}, 0.5),
}
"""Methods that are compared, by their name in tables."""


def compare(*, seed: int, say: Callable[[str], None]) -> list[dict[str, Any]]:
    """Return the differences of each case."""
    rows = []
    for name, case in CASES.items():
        say(f"comparing {name}")
        found = _compared(case, seed)
        rows.append({"name": name, "limit_db": case.limit_db, **found})
        if not found["largest_db"] <= case.limit_db:
            raise DataError(
                f"{name} differs from Acoular by {found['largest_db']:.2f} dB, more than {case.limit_db:g} dB; "
                "correct the method before its time is measured"
            )
    return rows


def _compared(case: Case, seed: int) -> dict[str, Any]:
    changes = {f"passive__{key}": value for key, value in case.passive.items()}
    settings = listening(processing__directions=_DIRECTIONS, **changes)
    heard = noise(settings, SOURCES, own_rms=OWN_RMS, seed=seed)
    theirs = AcousticMapper(settings, N_BLOCK)
    step = _CLEAN_STEP if settings.passive.method == "clean_sc" else 1
    with AcousticCamera(settings, "cpu", check=False) as camera:
        camera.add(heard)
        ours, spectrum = camera.powers()[::step].astype(np.float64), camera.cross_spectrum()
        bins = bins_of(camera)
    if settings.passive.traits.has_level:
        return _of_maps(ours, theirs.powers(heard.data, slice(bins.start, bins.stop, step)))
    other = theirs.equalised(spectrum.matrix, spectrum.frequency_hz)
    return _of_maps(*(each / each.max(axis=1, keepdims=True) for each in (ours, other)))


def bins_of(camera: AcousticCamera) -> slice:
    """Return the bins of a camera among all bins of its blocks."""
    first = round(float(camera.frequency_hz[0] / np.diff(camera.frequency_hz)[0]))
    return slice(first, first + len(camera.frequency_hz))


def _of_maps(ours: Powers, other: Powers) -> dict[str, Any]:
    """Return the differences of all levels that are compared."""
    compared = other > other.max(axis=1, keepdims=True) * 10 ** (-WITHIN_DB / 10)
    difference_db = np.abs(10 * np.log10(np.maximum(ours[compared], 1e-30) / other[compared]))
    return {
        "largest_db": float(difference_db.max()),
        "median_db": float(np.median(difference_db)),
        "levels": int(compared.sum()),
    }
