"""Notes on omissions and unknown values in lists of reflectors."""

import math
from collections.abc import Iterable, Sequence

from ertis_numba.analysis.detect import left_out_at_edges, left_out_in_noise
from ertis_numba.base.angles import DegreesFromRadians
from ertis_numba.base.units import counted
from ertis_numba.frames import Energyscape, Peak

__all__ = ["list_notes", "noise_note", "open_edge_note", "unconfirmed_note"]


def list_notes(
    found: Iterable[tuple[Energyscape, Sequence[Peak]]], *, min_level_db: float = -30.0, false_alarm: float | None
) -> list[str]:
    """Return notes on images of one sensor and their lists by `find_peaks`, with the arguments of this function."""
    n_left_out = n_noisy = n_unconfirmed = 0
    open_edges = None
    errors_deg: list[float] = []
    for image, peaks in found:
        n_left_out += left_out_at_edges(image, peaks, min_level_db=min_level_db, false_alarm=false_alarm)
        if false_alarm is not None:
            n_noisy += left_out_in_noise(image, min_level_db=min_level_db, false_alarm=false_alarm)
        if image.points is not None:
            n_unconfirmed += int((~image.points.is_certain).sum())
        errors_deg += (peak.grid_error_deg for peak in peaks)
        open_edges = open_edge_note(image, errors_deg)
    notes = (_left_out_note(n_left_out), noise_note(n_noisy), unconfirmed_note(n_unconfirmed), open_edges)
    return [each for each in notes if each is not None]


def _left_out_note(count: int) -> str | None:
    """Return a note on maxima that were left out near the ends of the range axis; None if there are none."""
    if not count:
        return None
    maxima = "1 maximum" if count == 1 else f"{count} maxima"
    cause = "it may be a side lobe" if count == 1 else "they may be side lobes"
    return (
        f"{maxima} near the first or last range left out because {cause} of an echo outside the range; use a wider "
        "range with 'ertis process --range'"
    )


def noise_note(count: int) -> str | None:
    """Return a note on maxima that noise from their direction may have caused; None if there are none."""
    if not count:
        return None
    if count == 1:
        return (
            "1 maximum left out because a hiss, a tone or a click from its direction may have caused it; in dense "
            "scenes, it may be a reflector beside stronger ones; 'ertis peaks --all' lists it"
        )
    return (
        f"{count} maxima left out because a hiss, a tone or a click from their directions may have caused them; in "
        "dense scenes, they may be reflectors beside stronger ones; 'ertis peaks --all' lists them"
    )


def open_edge_note(grid: DegreesFromRadians, grid_errors: Iterable[float]) -> str | None:
    """Return a note on listed directions whose sources may lie beyond the edges of the grid; None without any."""
    count = sum(map(math.isinf, grid_errors))
    if not count or len(grid.azimuth_rad) == 1:
        return None
    return (
        f"{counted(count, 'listed direction')} may have a source beyond the edges of the grid, so grid_error_deg is "
        "unknown; use 'ertis process' with a wider --azimuth or --elevation"
    )


def unconfirmed_note(count: int) -> str | None:
    """Return a note on points of a fusion that are not listed; None if there are none."""
    if not count:
        return None
    return (
        f"{counted(count, 'point')} left out because too few pairs of emitter and receiver confirm them: they may be "
        "ghosts, or reflectors that few sensors hear; the file contains them with point_confirmed = 0"
    )
