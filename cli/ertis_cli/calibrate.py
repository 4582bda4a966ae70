"""``ertis sensors calibrate``: calibration of an array."""

from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import _calibrate_poses, _tables, options

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ertis_numba.calibration import Calibration, Target
    from ertis_numba.frames import Measurement

__all__ = ["calibrate"]

_COLUMNS: dict[str, _tables.Side] = dict.fromkeys(
    ("channel", "gain dB", "±", "delay µs", "±µs", "x mm", "±x", "y mm", "±y", "z mm", "±z"), "right"
)
_DIGITS = (3, 3, 4, 4, 4)  # of gain in dB, delay in µs, and x, y and z in mm
_INTERVAL = 1.96  # half of a 95 % interval in standard deviations
_MAX_LOSS_DB = 0.02  # of contrast, which rounding may cause


class _Place(click.ParamType):  # type: ignore[type-arg]  # generic since click 8.4 only
    name = "AZ:EL:M"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float, float]:
        with suppress(ValueError):
            azimuth, elevation, range_m = (float(part) for part in str(value).split(":"))
            return azimuth, elevation, range_m
        return self.fail(f"{value!r} is not a place; use azimuth, elevation and range, as in 30:15:1.2", param, ctx)


_PLACE = _Place()


@click.command()
@options.input_files("REC.h5...")
@options.output("Layout or mounting file (TOML) to write; without it, the calibration is only printed.")
@click.option(
    "--target",
    "source",
    type=click.Choice(["reflector", "wall", "direct", "beacon"]),
    default="reflector",
    show_default=True,
    help="Source of the strongest sound: a small reflector, a flat wall, the sensor's own emitter, or another sensor "
    "of the SYNC chain.",
)
@click.option(
    "--layout",
    metavar="NAME|FILE",
    shell_complete=options.complete_layouts,
    help="Layout to calibrate, by name or file; by default, the layout in the first recording.",
)
@options.sensor("Sensor to calibrate; required if a recording contains several.")
@click.option(
    "--gain-tolerance",
    "gain_db",
    type=click.FloatRange(0.01, 60.0),
    default=3.0,
    show_default=True,
    metavar="DB",
    help="Standard deviation of gains that is expected before the calibration, in dB.",
)
@click.option(
    "--delay-tolerance",
    "delay_us",
    type=click.FloatRange(0.001, 1000.0),
    default=5.0,
    show_default=True,
    metavar="US",
    help="Standard deviation of delays that is expected before the calibration, in µs.",
)
@click.option(
    "--position-tolerance",
    "position_mm",
    type=click.FloatRange(0.0, 100.0),
    default=1.0,
    show_default=True,
    metavar="MM",
    help="Standard deviation of positions along each axis, in mm; 0 keeps the positions of the layout.",
)
@click.option(
    "--first-place",
    type=_PLACE,
    metavar="AZ:EL:M",
    help="Place of the reflector in the first recording: azimuth and elevation in °, range in m. It reveals a mirrored "
    "layout or another size of the array, and gives the speed of sound.",
)
@click.option(
    "--ideal",
    is_flag=True,
    help="Assume that air, emitter and reflector are exactly as the settings say, as in simulations.",
)
@click.option(
    "--poses",
    is_flag=True,
    help="Calibrate positions and orientations of several sensors instead of microphones, and write a mounting file.",
)
@click.option(
    "--sensors",
    type=options.NAMES,
    help="With --poses: names of the sensors in the order of the SYNC chain, as in front,left; all sensors by default.",
)
@options.force
@options.quiet
@options.as_json
@click.pass_context
def calibrate(
    ctx: click.Context,
    *,
    paths: tuple[Path, ...],
    target: Path | None,
    source: "Target",
    layout: str | None,
    sensor: str | None,
    gain_db: float,
    delay_us: float,
    position_mm: float,
    first_place: tuple[float, float, float] | None,
    ideal: bool,
    poses: bool,
    sensors: tuple[str, ...] | None,
    force: bool,
    quiet: bool,
    as_json: bool,
) -> None:
    """Calibrate the microphones of an array from recordings.

    Record one small, hard reflector 0.5 to 2 m ahead at about 20 places, to the left and right, up and down, far from
    other objects. Swapped, inverted, silent and duplicate channels are found first. Then the gain, delay and position
    of each microphone are estimated. Values are changes of the layout in use, with half of their 95 % intervals.

    The new layout is for array.layout in settings files. It is not written if it lowers the contrast of images of these
    recordings, which happens if other sound overlaps the one that is measured.

    With --poses, the recordings contain several sensors of one SYNC chain, and one small reflector at 10 to 20 places
    that they see together. The mounting file is for --mounting of 'ertis capture' and other commands.
    """
    from ertis_numba.base.atomic_files import atomic_write, check_target
    from ertis_numba.base.errors import ArgumentError
    from ertis_numba.calibration import calibrate as calibrated
    from ertis_numba.geometry import layout_file

    if poses:
        _require_no_other_options(ctx)
        _calibrate_poses.write_poses(paths, sensors, target, force=force, quiet=quiet, as_json=as_json)
        return
    if sensors is not None:
        raise click.UsageError("--sensors requires --poses; add --poses, or choose one sensor with --sensor", ctx)
    if target is not None:
        if target.suffix.lower() != ".toml":
            raise ArgumentError(
                f"output {target} does not end in .toml; layout files do, so name it {target.stem}.toml"
            )
        check_target(target, overwrite=force, sources=paths)
    with ExitStack() as stack:
        places, measurements = _opened(paths, sensor, stack)
        shown = stack.enter_context(
            options.progress(measurements, length=len(places), label="measuring sounds", quiet=quiet)
        )
        made = calibrated(
            shown,
            layout,
            target=source,
            gain_tolerance_db=gain_db,
            delay_tolerance_s=1e-6 * delay_us,
            position_tolerance_m=1e-3 * position_mm,
            first_place=first_place,
            ideal=ideal,
        )
    before_db, after_db = made.contrast_db
    is_better = after_db > before_db - _MAX_LOSS_DB
    if target is not None and is_better:
        count = options.counted(len(made.source_m), "measurement")
        text = f"ertis sensors calibrate, {count} of a {source}, from layout {made.former.name}"
        text += "" if ideal or not position_mm else ", whose scale it keeps"
        content = layout_file(made.layout, name=target.stem, source=text).to_toml()
        with atomic_write(target, overwrite=force) as partial:
            partial.write_text(content, "utf-8")
    if as_json:
        options.print_json(_report(made, places, target if is_better else None))
    else:
        _print(made, places, quiet=quiet)
    if not is_better:
        raise ArgumentError(
            f"the calibration lowers the contrast of images from {before_db:.2f} to {after_db:.2f} dB, so it is "
            f"{'only printed' if target is None else 'not written'}: other sound overlaps the {source}, or the array "
            "is larger or smaller than the layout; record at more places, far from other objects, and measure the array"
        )
    if target is not None:
        options.say(f"wrote {target}; use it as array.layout in a settings file", quiet=quiet)


def _require_no_other_options(ctx: click.Context) -> None:
    """Raise an error for options that have no meaning with ``--poses``."""
    kept = {"paths", "target", "poses", "sensors", "force", "quiet", "as_json"}
    for parameter in ctx.command.params:
        name = parameter.name or ""
        if name not in kept and ctx.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE:
            raise click.UsageError(f"{parameter.opts[0]} is not for --poses; remove one of them", ctx)


def _opened(paths: tuple[Path, ...], sensor: str | None, stack: ExitStack) -> "tuple[list[str], Iterator[Measurement]]":
    """Return the places of all measurements, as file and index, and the measurements of one sensor."""
    from ertis_numba.base.errors import ArgumentError
    from ertis_numba.storage import open_recording, sensor_names

    found = []
    for path in paths:
        names = sensor_names(path, "a recording")
        if sensor is None and len(names) > 1:
            raise ArgumentError(f"{path} contains sensors {', '.join(names)}; choose one with --sensor")
        found.append(stack.enter_context(closing(open_recording(path, sensor=sensor))))
    places = [
        f"{path} [{index}]" if len(recording) > 1 else str(path)
        for path, recording in zip(paths, found, strict=True)
        for index in range(len(recording))
    ]
    return places, (measurement for recording in found for measurement in recording)


def _report(made: "Calibration", places: list[str], written: Path | None) -> dict[str, Any]:
    """Return the calibration as JSON."""
    names = ("gain_db", "delay_us", "x_mm", "y_mm", "z_mm")
    channels = [
        {"channel": channel}
        | {name: round(float(value), 6) for name, value in zip(names, values, strict=True)}
        | {f"{name}_sd": round(float(value), 6) for name, value in zip(names, deviations, strict=True)}
        for channel, values, deviations in zip(made.channels, made.changes, made.sd, strict=True)
    ]
    residuals = made.residuals
    return {
        "layout": None if written is None else str(written),
        "measurements": len(made.source_m),
        "findings": list(made.findings),
        "channels": channels,
        "residuals": {
            name: round(value, 6)
            for name, value in (
                ("before_us", 1e6 * residuals.before_s),
                ("after_us", 1e6 * residuals.after_s),
                ("before_db", residuals.before_db),
                ("after_db", residuals.after_db),
            )
        },
        "sound_speed_m_s": None if made.sound_speed is None else [round(value, 3) for value in made.sound_speed],
        "scale": None if made.scale is None else [round(value, 4) for value in made.scale],
        "contrast_db": [round(value, 3) for value in made.contrast_db],
        "sources_m": [[round(float(value), 5) for value in row] for row in made.source_m],
        "not_observable": list(made.not_observable),
        "left_out": {places[number]: reason for number, reason in made.rejected.items()},
    }


def _print(made: "Calibration", places: list[str], *, quiet: bool) -> None:
    rows = []
    for channel, values, deviations in zip(made.channels, made.changes, made.sd, strict=True):
        cells = [str(channel)]
        for value, deviation, digits in zip(values, deviations, _DIGITS, strict=True):
            cells += [f"{value:+.{digits}f}", f"{_INTERVAL * deviation:.{digits}f}"]
        rows.append(cells)
    _tables.TextTable(_COLUMNS, rows).print()
    for line in made.findings:
        click.echo(line)
    residuals, (before_db, after_db) = made.residuals, made.contrast_db
    n_used, n_left = len(made.source_m), len(made.rejected)
    used = f"{n_used} of {n_used + n_left} measurements" if n_left else options.counted(n_used, "measurement")
    click.echo(
        f"residuals of {used}: {1e6 * residuals.before_s:.3f} µs and "
        f"{residuals.before_db:.3f} dB before, {1e6 * residuals.after_s:.3f} µs and {residuals.after_db:.3f} dB after"
    )
    click.echo(f"contrast of images: {before_db:.2f} dB before, {after_db:.2f} dB after")
    if made.sound_speed is not None:
        speed_m_s, sd_m_s = made.sound_speed
        click.echo(f"speed of sound: {speed_m_s:.1f} ± {_INTERVAL * sd_m_s:.1f} m/s")
    if made.scale is not None:
        click.echo(f"size of the array by the direction of the first place: {made.scale}")
    for line in made.not_observable:
        options.say(f"not observable: {line}", quiet=quiet)
    for number, reason in made.rejected.items():
        options.warn(f"{places[number]} is left out: {reason}")
