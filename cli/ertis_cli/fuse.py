"""``ertis fuse``: one image per SYNC pulse from all sensors of a platform."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import _fuse, _image_options, _pulses, _results, options

if TYPE_CHECKING:
    from ertis_numba.settings import ExcludedChannels, Settings

__all__ = ["fuse"]


@click.command()
@options.input_files("REC.h5...")
@options.output("Energyscape file to write, by default REC.fused.h5 beside the first recording.")
@options.without("Channels to exclude, such as those of faulty microphones")
@_image_options.image_options
@_pulses.processing
@options.emitter_diameter("Diameter of emitters")
@options.force
@options.quiet
@options.as_json
def fuse(
    *,
    paths: tuple[Path, ...],
    target: Path | None,
    without: "ExcludedChannels",
    settings_file: Path | None,
    preset: str | None,
    mounting: Path | None,
    emitter_diameter_m: float | None,
    device: str,
    threads: int | None,
    plan: str,
    force: bool,
    quiet: bool,
    as_json: bool,
    **given: Any,
) -> None:
    """Fuse recordings of several sensors into one image per SYNC pulse.

    All sensors of the recordings belong to one platform, and the image shows its surroundings. Echoes of a sensor's
    call that another sensor received appear where their reflector is. The sensors may share one recording.

    The settings file overrides the settings of the recordings, the preset overrides both, and other options override
    all of them.
    """
    if target is not None and target.suffix.lower() in _fuse.OTHER_FORMATS:
        raise click.UsageError(f"-o {target} is not an energyscape file; choose a .h5 file")

    def changed(recorded: "Settings") -> "Settings":
        settings = _image_options.with_given(recorded, settings_file=settings_file, preset=preset, given=given)
        _results.require_image(settings, 'fusion needs images; set last_stage = "envelope" in --settings FILE')
        return settings

    _fuse.write_fused(
        paths,
        target or paths[0].with_suffix(".fused.h5"),
        changed,
        without=without,
        mounting=mounting,
        emitter_diameter_m=emitter_diameter_m,
        force=force,
        quiet=quiet,
        as_json=as_json,
        device=device,
        threads=threads,
        plan=plan,
    )
