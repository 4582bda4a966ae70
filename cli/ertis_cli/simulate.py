"""``ertis simulate``: a scene to a recording."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from ertis_cli import options

if TYPE_CHECKING:
    from ertis_numba.frames import Peak
    from ertis_numba.simulation import Scene
    from ertis_numba.storage import Truth

__all__ = ["simulate"]


@click.command()
@options.input_file("SCENE.toml")
@options.output("Recording to write; SCENE.h5 beside the scene by default.")
@click.option("--count", type=click.IntRange(min=1), default=1, show_default=True, metavar="N", help="Measurements.")
@click.option("--seed", type=click.IntRange(min=0), metavar="S", help="Decides noise; the scene's own by default.")
@options.force
@options.quiet
@options.as_json
def simulate(
    *, path: Path, target: Path | None, count: int, seed: int | None, force: bool, quiet: bool, as_json: bool
) -> None:
    """Turn a scene into a recording.

    The recording holds the words that the scene's sensor would record, the scene itself, and where an
    image should show each reflector. Scene, seed and number of the measurement decide every bit.
    """
    from ertis_numba.simulation import load_scene, true_peaks
    from ertis_numba.storage import check_target, write_recording

    scene = load_scene(path)
    if seed is not None:
        scene = scene.replace(seed=seed)
    target = target or path.with_suffix(".h5")
    check_target(target, overwrite=force, sources=[path])
    peaks = true_peaks(scene)
    with options.note_when_slow("compiling kernels (first run only) ...", quiet=quiet), options.interrupt_later():
        from ertis_numba.simulation.render import render

        first = render(scene)
    rest = (render(scene, index) if index else first for index in range(count))
    with options.progress(rest, length=count, label="simulating", quiet=quiet) as shown:
        write_recording(target, shown, overwrite=force, source=path.name, truth=_truth(scene, peaks, count))
    options.say(
        f"{target}: {options.counted(count, 'measurement')}, {options.counted(len(peaks), 'reflector')}", quiet=quiet
    )
    if as_json:
        reflectors = [{name: getattr(peak, name) for name in peak.__slots__} for peak in peaks]
        options.print_json({"output": str(target), "measurements": count, "seed": scene.seed, "reflectors": reflectors})


def _truth(scene: "Scene", peaks: "list[Peak]", count: int) -> "Truth":
    import numpy as np

    from ertis_numba.storage import Truth

    def column(name: str) -> "np.ndarray[tuple[int, ...], np.dtype[np.float64]]":
        return np.tile(np.array([getattr(peak, name) for peak in peaks], dtype=np.float64), (count, 1))

    return Truth(
        scene=scene.to_toml(),
        seed=scene.seed,
        azimuth_rad=np.radians(column("azimuth_deg")),
        elevation_rad=np.radians(column("elevation_deg")),
        range_m=column("range_m"),
        level_db=column("level_db"),
    )
