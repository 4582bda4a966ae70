"""Limits on the size of a scene."""

from ertis_numba.base.errors import ArgumentError

__all__ = [
    "MAX_AMPLITUDES",
    "MAX_MIRROR_POINTS",
    "MAX_PATHS",
    "require_few_amplitudes",
    "require_few_mirrors",
    "require_few_paths",
]

MAX_PATHS = 20_000
"""Limit on the sound paths to one sensor in one measurement."""
MAX_MIRROR_POINTS = 2**21
"""Limit on chains of walls × mirrored targets, which bounds the time to trace them."""
MAX_AMPLITUDES = 2**26
"""Limit on paths × microphones × frequencies: about 2 GB during computation."""


def require_few_mirrors(n_walls: int, order: int, n_places: int) -> None:
    """Raise ArgumentError if the number of chains of walls × places exceeds `MAX_MIRROR_POINTS`."""
    n_chains = sum(n_walls * (n_walls - 1) ** k for k in range(order)) if n_walls else 0
    if n_chains * n_places > MAX_MIRROR_POINTS:
        raise ArgumentError(
            f"the scene has {n_chains * n_places} mirror points, from {n_walls} walls (6 per box), {n_places} targets "
            f"and max_reflections {order}; the limit is {MAX_MIRROR_POINTS}. Lower max_reflections, or use fewer "
            "walls or targets"
        )


def require_few_paths(n_paths: int) -> None:
    """Raise ArgumentError if there are more paths than `MAX_PATHS`, and estimates would take too long."""
    if n_paths > MAX_PATHS:
        raise ArgumentError(
            f"the scene has at least {n_paths} sound paths to one sensor; the limit is {MAX_PATHS}. "
            "Lower max_reflections, or use fewer targets or walls"
        )


def require_few_amplitudes(n_paths: int, n_mics: int, n_frequencies: int) -> None:
    """Raise ArgumentError if one measurement needs more than `MAX_AMPLITUDES` amplitudes, and thus too much memory."""
    if n_paths * n_mics * n_frequencies > MAX_AMPLITUDES:
        raise ArgumentError(
            f"the scene has {n_paths} sound paths to {n_mics} microphones at {n_frequencies} frequencies, in total "
            f"{n_paths * n_mics * n_frequencies} amplitudes; the limit is {MAX_AMPLITUDES}. Lower max_reflections, or "
            "use fewer targets, walls or microphones"
        )
