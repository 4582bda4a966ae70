"""Signals and beams of a recording in an NPZ file: processing that ends before the envelope."""

import dataclasses
import itertools
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import options
from ertis_cli._config import typed

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from ertis_numba.frames import Beams, Energyscape, MicrophoneSignals
    from ertis_numba.settings import ExcludedChannels, Settings
    from ertis_numba.storage import RecordingReader

__all__ = ["is_results_file", "require_image", "write_results"]

_OF_IMAGES = ("dtype", "explain", "mounting", "strict", "verify", "workers")


def is_results_file(target: str | None) -> bool:
    """Return True for the name of a file that holds signals or beams."""
    return target is not None and Path(target).suffix.lower() == ".npz"


def require_image(
    settings: "Settings",
    reason: str = "an energyscape file holds images; use -o FILE.npz, or --last-stage envelope",
) -> None:
    """Raise an error with a reason and a remedy if the last stage yields no image."""
    stage = settings.processing.last_stage
    if stage != "envelope":
        raise click.UsageError(f"the last stage is {stage}, but {reason}", click.get_current_context())


def write_results(
    path: Path,
    target: Path,
    changed: "Callable[[Settings], Settings]",
    *,
    without: "ExcludedChannels",
    sensor: str | None,
    force: bool,
    quiet: bool,
    as_json: bool,
    **device: Any,
) -> None:
    """Write the results of the last stage for all measurements of one sensor; None if there is only one."""
    from ertis_numba.interop import export
    from ertis_numba.storage import check_target, open_recording

    for name in _OF_IMAGES:
        if typed(name):
            raise click.UsageError(f"--{name} is for images; remove it with -o {target}", click.get_current_context())
    names = options.sensors_of(path, sensor, "a recording")
    if len(names) > 1:
        raise click.UsageError(
            f"{path} has sensors {', '.join(names)}, but an NPZ file holds one; choose one with --sensor",
            click.get_current_context(),
        )
    without.require_known(options.sensors_of(path, None))
    check_target(target, overwrite=force, sources=[path])
    with open_recording(path, sensor=names[0]) as recording:
        stage = changed(recording.settings).processing.last_stage
        if stage == "envelope":
            raise click.UsageError(
                f"-o {target} is for signals and beams; add --last-stage, or export images with 'ertis export'",
                click.get_current_context(),
            )
        results = _Results(recording, lambda each: without.applied(changed(each), names[0]), device, quiet=quiet)
        export(target, results, file_format="npz", overwrite=force)
        count = len(recording)
    options.say(f"{target}: {stage} of {options.counted(count, 'measurement')} of {names[0]}", quiet=quiet)
    if as_json:
        options.print_json({"output": str(target), "sensor": names[0], "last_stage": stage, "measurements": count})


class _Results:
    """Results of the last stage for each measurement of a recording, under a progress bar."""

    def __init__(
        self,
        recording: "RecordingReader",
        changed: "Callable[[Settings], Settings]",
        device: dict[str, Any],
        *,
        quiet: bool,
    ) -> None:
        self._recording, self._changed, self._device, self._quiet = recording, changed, device, quiet

    def __len__(self) -> int:
        return len(self._recording)

    def __iter__(self) -> "Iterator[Energyscape | Beams | MicrophoneSignals]":
        with options.progress(self._each(), length=len(self), label="processing", quiet=self._quiet) as shown:
            yield from shown

    def _each(self) -> "Iterator[Energyscape | Beams | MicrophoneSignals]":
        for settings, group in itertools.groupby(self._recording, lambda measurement: measurement.settings):
            with options.pipeline(self._changed(settings), quiet=self._quiet, **self._device) as pipeline:
                for measurement in group:
                    yield pipeline.result(dataclasses.replace(measurement, settings=pipeline.settings))
