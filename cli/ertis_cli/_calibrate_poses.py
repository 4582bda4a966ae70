"""Poses of several sensors on one platform: calibration, table and mounting file."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import _tables, options

if TYPE_CHECKING:
    from ertis_numba.calibration.pose_result import PoseCalibration
    from ertis_numba.frames import Measurement
    from ertis_numba.storage import RecordingReader

__all__ = ["write_poses"]

_NUMBERS: dict[str, _tables.Side] = dict.fromkeys(
    ("x mm", "±x", "y mm", "±y", "z mm", "±z", "yaw °", "±yaw", "pitch °", "±pitch", "roll °", "±roll", "reflectors"),
    "right",
)
_COLUMNS: dict[str, _tables.Side] = {"sensor": "left", **_NUMBERS}
_PULSES_PER_FILE = 1 << 40  # Pulse numbers start again in each run.


def write_poses(
    paths: Sequence[Path],
    sensors: Sequence[str] | None,
    target: Path | None,
    *,
    reference: str | None = None,
    force: bool = False,
    quiet: bool = False,
    as_json: bool = False,
) -> None:
    """Calibrate the poses of sensors of one or several runs, print them, and write a mounting file."""
    from ertis_numba.base.atomic_files import atomic_write, check_target
    from ertis_numba.base.errors import ArgumentError, DataError
    from ertis_numba.calibration.poses import calibrate_poses

    if target is not None:
        if target.suffix.lower() != ".toml":
            raise ArgumentError(
                f"output {target} does not end in .toml; mounting files do, so name it {target.stem}.toml"
            )
        check_target(target, overwrite=force, sources=paths)
    with ExitStack() as stack:
        opened = _opened(paths, sensors, stack)
        total = sum(len(recording) for files in opened.values() for _, recording in files)
        shown = stack.enter_context(options.progress(range(total), length=total, label="finding echoes", quiet=quiet))
        ticks = iter(shown)

        def tick(_: int) -> None:
            next(ticks, None)

        made = calibrate_poses(
            {name: _measurements(files) for name, files in opened.items()},
            reference=reference,
            on_progress=tick,
        )
        next(ticks, None)  # This ends the bar.
    is_known = not made.not_observable
    if target is not None and is_known:
        content = _checked(made)
        with atomic_write(target, overwrite=force) as partial:
            partial.write_text(content, "utf-8")
    if as_json:
        options.print_json(_report(made, paths, target if is_known else None))
    else:
        _print(made, paths, quiet=quiet)
    if not is_known:
        raise DataError(f"the recordings do not determine {made.not_observable[0]}; nothing is written")
    if target is not None:
        options.say(f"wrote {target}; use it with 'ertis capture --mounting {target}'", quiet=quiet)


def _opened(
    paths: Sequence[Path], sensors: Sequence[str] | None, stack: ExitStack
) -> "dict[str, list[tuple[int, RecordingReader]]]":
    """Return the recordings of each sensor with the numbers of their files."""
    from ertis_numba.base.errors import ArgumentError
    from ertis_numba.storage import open_recording, sensor_names

    contained = [sensor_names(path, "a recording") for path in paths]
    known = list(dict.fromkeys(name for names in contained for name in names))
    wanted = known if sensors is None else [*sensors]
    for name in wanted:
        if name not in known:
            raise ArgumentError(
                f"{' and '.join(map(str, paths))} do not contain sensor {name!r}; choose from {', '.join(known)}"
            )
        if wanted.count(name) > 1:
            raise ArgumentError(f"--sensors names {name} {wanted.count(name)} times; name each sensor once")
    return {
        name: [
            (number, stack.enter_context(closing(open_recording(path, sensor=name))))
            for number, (path, names) in enumerate(zip(paths, contained, strict=True))
            if name in names
        ]
        for name in wanted
    }


def _measurements(files: "Sequence[tuple[int, RecordingReader]]") -> "Iterator[Measurement]":
    """Yield all measurements of a sensor; pulses of different files get different numbers."""
    for number, recording in files:
        for measurement in recording:
            pulse = measurement.stamp.sync_count + number * _PULSES_PER_FILE
            yield replace(measurement, stamp=replace(measurement.stamp, sync_count=pulse))


def _checked(made: "PoseCalibration") -> str:
    """Return the content of the mounting file, which a scene must accept."""
    from ertis_numba.simulation import Scene

    content = made.to_toml()
    Scene.from_toml(content, "the mounting file")
    return content


def _pulse(number: int, paths: Sequence[Path]) -> str:
    """Return the SYNC pulse as text, with its file if there are several."""
    place, pulse = divmod(number, _PULSES_PER_FILE)
    return str(pulse) if len(paths) == 1 else f"{pulse} of {paths[place]}"


def _report(made: "PoseCalibration", paths: Sequence[Path], written: Path | None) -> dict[str, Any]:
    """Return the calibration as JSON."""
    return {
        "mounting": None if written is None else str(written),
        "reference": made.reference,
        "measurements": made.n_measurements,
        "sensors": [
            {
                "sensor": name,
                "translation_m": [round(float(value), 7) for value in pose.translation_m],
                "translation_interval_m": [round(float(value), 7) for value in pose.translation_interval_m],
                "rotation_xyzw": [round(float(value), 9) for value in pose.rotation_xyzw],
                "yaw_pitch_roll_deg": [round(value, 5) for value in pose.yaw_pitch_roll_deg],
                "yaw_pitch_roll_interval_deg": [round(float(each), 5) for each in pose.yaw_pitch_roll_interval_deg],
                "covariance": [[float(f"{value:.6g}") for value in row] for row in pose.covariance],
                "residual_m": round(pose.residual_m, 7),
                "reflectors": pose.n_reflectors,
                "waves": pose.n_waves,
            }
            for name, pose in made.poses.items()
        ],
        "reflectors_m": [[round(float(value), 5) for value in row] for row in made.reflectors_m],
        "unused": [_pulse(number, paths) for number in made.unused],
        "not_observable": list(made.not_observable),
    }


def _print(made: "PoseCalibration", paths: Sequence[Path], *, quiet: bool) -> None:
    rows = []
    for name, pose in made.poses.items():
        cells = [name]
        for value_m, interval_m in zip(pose.translation_m, pose.translation_interval_m, strict=True):
            cells += [f"{1e3 * value_m:+.2f}", f"{1e3 * interval_m:.2f}"]
        for angle, interval in zip(pose.yaw_pitch_roll_deg, pose.yaw_pitch_roll_interval_deg, strict=True):
            cells += [f"{angle:+.3f}", f"{interval:.3f}"]
        rows.append([*cells, str(pose.n_reflectors)])
    _tables.TextTable(_COLUMNS, rows).print()
    worst_mm = 1e3 * max(pose.residual_m for pose in made.poses.values())
    click.echo(
        f"relative to {made.reference}, from {options.counted(len(made.reflectors_m), 'reflector')} in "
        f"{options.counted(made.n_measurements, 'measurement')}; residuals of paths up to {worst_mm:.2f} mm"
    )
    if made.unused:
        pulses = ", ".join(_pulse(number, paths) for number in made.unused)
        options.note(f"no new reflector at SYNC pulse {pulses}", quiet=quiet)
    for line in made.not_observable:
        options.say(f"not observable: {line}", quiet=quiet)
