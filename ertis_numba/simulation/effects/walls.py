"""Mirror images of emitters and targets in walls."""

from ertis_numba.simulation.mirrors import Seen, images
from ertis_numba.simulation.snapshot import Ear, Mouth, Snapshot

__all__ = ["walls"]


def walls(
    shot: Snapshot, mouth: Mouth
) -> tuple[tuple[Seen[Mouth], ...], tuple[Seen[Ear], ...], tuple[Seen[Mouth], ...]]:
    """Return an emitter as the targets see it, the microphones as they do, and the emitter as the microphones do.

    The first of each list is the thing itself, the others are its images, of up to the scene's
    ``max_reflections`` walls, as far as they can be seen.
    """
    most = shot.scene.max_reflections
    ear_m = shot.ear.centre_m[None]
    return (
        tuple(images(mouth, shot.targets.positions_m, shot.mirrors, most)),
        tuple(images(shot.ear, shot.targets.positions_m, shot.mirrors, most)),
        tuple(images(mouth, ear_m, shot.mirrors, most)),
    )
