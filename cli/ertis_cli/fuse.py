"""``ertis fuse``: one image per SYNC pulse from all sensors of a platform."""

from collections import Counter
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import _image_options, _plans, _pulses, _results, options
from ertis_cli._help_sections import SectionedCommand

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from ertis_cli._mountings import Mounting
    from ertis_numba.frames import Energyscape
    from ertis_numba.fusion import DirectSoundCheck, Fused
    from ertis_numba.settings import ExcludedChannels, Settings
    from ertis_numba.storage import RecordingReader

__all__ = ["fuse"]

_OTHER_FORMATS = {".npz", ".png", ".jpg", ".jpeg", ".pdf", ".svg"}
"""Endings of signals, beams and pictures."""

_CHECKED_PULSES = 8


@click.command(cls=SectionedCommand)
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
    if target is not None and target.suffix.lower() in _OTHER_FORMATS:
        raise click.UsageError(f"-o {target} is not an energyscape file; choose a .h5 file")

    def changed(recorded: "Settings") -> "Settings":
        settings = _image_options.with_given(recorded, settings_file=settings_file, preset=preset, given=given)
        _plans.require_plan(settings.processing.method)
        _results.require_image(settings, 'fusion needs images; set last_stage = "envelope" in --settings FILE')
        return settings

    _write_fused(
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


def _write_fused(
    paths: "Sequence[Path]",
    target: Path,
    changed: "Callable[[Settings], Settings]",
    *,
    without: "ExcludedChannels",
    mounting: "Path | None",
    emitter_diameter_m: float | None,
    force: bool,
    quiet: bool,
    as_json: bool,
    **device: Any,
) -> None:
    """Write the fused image of each SYNC pulse; mountings and emitter diameter replace those recorded."""
    from ertis_numba.fusion import PLATFORM, Fuser
    from ertis_numba.storage import EnergyscapeWriter, check_target
    from ertis_numba.storage.placed_truth import PlacedTruth

    check_target(target, overwrite=force, sources=paths)
    with ExitStack() as stack:
        readers = _pulses.open_sensors(paths, stack)
        _require_several(readers)
        mountings = _pulses.platform_mountings(readers, mounting, quiet=quiet)
        fuser = Fuser(mountings, emitter_diameter_m=emitter_diameter_m)
        without.require_known([reader.sensor for reader in readers])
        pipelines = _pulses.PipelinesBySensor(
            changed, stack, quiet=quiet, without=without, mountings=mountings, **device
        )
        active = _pulses.active_groups(readers, changed, quiet=quiet)
        groups = active.groups
        by_name = {reader.sensor: reader for reader in readers}
        clocks = _clock_check(mountings, groups, by_name)
        for text in clocks.warnings():
            options.warn(text)
        truth = PlacedTruth(readers, mountings)
        counts = _FusedCounts()
        writer = stack.enter_context(
            EnergyscapeWriter(target, overwrite=force, mounting={PLATFORM: ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))})
        )
        with options.progress(groups, length=len(groups), label="fusing", quiet=quiet) as shown:
            for number, group in enumerate(shown):
                images = {name: pipelines.image(by_name[name][place.index]) for name, place in group.items()}
                fused = fuser(images.values())
                truth.add(images, {name: place.index for name, place in group.items()})
                missing = [name for name in fused.missing if name in by_name]
                if missing:
                    options.note(f"pulse {number} has no image of {', '.join(missing)}", quiet=quiet)
                counts.add(fused, is_complete=not missing)
                writer.write(_numbered(fused, number))
        _pulses.note_truth(truth, quiet=quiet)
        if (placed := truth.truth()) is not None:
            writer.note_truth(PLATFORM, placed)
    warnings = _warn_of_echoes(counts, fuser.emitter_warning(), len(by_name), len(groups), quiet=quiet)
    pulses = options.counted(len(groups), "pulse")
    options.say(f"{target}: {pulses} of {', '.join(by_name)}, fused", quiet=quiet)
    if as_json:
        report = {
            "output": str(target),
            "sensors": list(by_name),
            "pulses": len(groups),
            "incomplete": counts.incomplete,
            "empty": counts.empty,
            "left_out": active.n_passive,
            "unheard": dict(counts.unheard),
            "without_own_echo": dict(counts.unshown),
            "simulated": placed is not None,
        }
        warnings = [*clocks.warnings(), *pipelines.warnings, *warnings]
        options.print_json(report | {"direct_sound": _direct_sound(clocks), "warnings": warnings})


class _FusedCounts:
    """Counts of incomplete and empty images, and of the pulses in which the echoes of each sensor are missing."""

    def __init__(self) -> None:
        self.incomplete = self.empty = 0
        self.unheard, self.unshown = Counter[str](), Counter[str]()

    def add(self, fused: "Fused", *, is_complete: bool) -> None:
        """Count the fused image of a pulse."""
        self.incomplete += not is_complete
        self.empty += fused.is_empty
        self.unheard.update(fused.unheard)
        self.unshown.update(fused.without_own_echo)


def _warn_of_echoes(
    counts: _FusedCounts, contradiction: str | None, n_sensors: int, n_pulses: int, *, quiet: bool
) -> list[str]:
    """Print and return warnings of missing echoes; with wrong emitters, echoes only seem to be missing."""
    _pulses.note_empty(counts.empty, n_pulses, quiet=quiet)
    every = [_unheard(name, count, n_pulses) for name, count in counts.unheard.items()]
    warnings = [contradiction] if contradiction else every
    for text in warnings:
        options.warn(text)
    if counts.empty < n_pulses and not contradiction:
        others = {name: count for name, count in counts.unshown.items() if name not in counts.unheard}
        _pulses.note_without_own_echo(others, n_sensors, n_pulses, quiet=quiet)
    return warnings


def _clock_check(
    mountings: "Mapping[str, Mounting]",
    groups: "Sequence[Mapping[str, _pulses.StampedIndex]]",
    readers: "Mapping[str, RecordingReader]",
) -> "DirectSoundCheck":
    """Return the direct sound between sensors in a few pulses, which are spread over the recordings."""
    from ertis_numba.fusion import DirectSoundCheck

    check = DirectSoundCheck(mountings)
    for group in groups[:: max(1, -(-len(groups) // _CHECKED_PULSES))]:
        check.add(readers[name][place.index] for name, place in group.items())
    return check


def _direct_sound(check: "DirectSoundCheck") -> list[dict[str, Any]]:
    """Return the direct sounds of a clock check for the JSON report."""
    return [
        {
            "emitter": each.emitter,
            "receiver": each.receiver,
            "difference_us": round(1e6 * each.difference_s, 3),
            "uncertainty_us": round(1e6 * each.uncertainty_s, 3),
        }
        for each in check.sounds
    ]


def _unheard(sensor: str, count: int, n_pulses: int) -> str:
    """Return a warning of a sensor whose call is not heard in some pulses."""
    return (
        f"no sensor hears the call of {sensor} in {count} of {n_pulses} pulses; check its mounting, its emitter and "
        "its SYNC line"
    )


def _require_several(readers: "Sequence[RecordingReader]") -> None:
    if len(readers) < 2:
        raise click.UsageError(
            f"fusion needs at least two sensors, but there is only {', '.join(each.sensor for each in readers)}; add "
            "more recordings, or use 'ertis process'",
            click.get_current_context(),
        )


def _numbered(fused: "Fused", number: int) -> "Energyscape":
    """Return the image and its points with the number of the pulse; sensors may have begun at different numbers."""
    stamp = replace(fused.stamp, sequence=number, session_id=0)
    return fused.image.replace(stamp=stamp, points=fused.points.replace(stamp=stamp))
