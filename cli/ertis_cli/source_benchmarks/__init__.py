"""Benchmarks of ``ertis bench`` that exist only in the source folder: the wheel does not contain this package."""

import importlib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import click

from ertis_cli import options
from ertis_cli.bench import bench, count_of, run, update

__all__: list[str] = []


def _benchmark(name: str) -> ModuleType:
    """Return a module of `ertis_bench`, once its command runs."""
    return importlib.import_module(f"ertis_bench.{name}")


def _number(name: str, default: int, about: str, *, least: int = 1, metavar: str = "N") -> Callable[..., Any]:
    """Return the option of a whole number."""
    return click.option(
        name, type=click.IntRange(min=least), default=default, show_default=True, metavar=metavar, help=about
    )


def _seed(about: str, *, default: int = 0) -> Callable[..., Any]:
    """Return a seed option with a fixed default, so that runs are reproducible."""
    return _number("--seed", default, about, least=0, metavar="S")


def _quantity(
    name: str, variable: str, limits: click.FloatRange, default: float, metavar: str, about: str
) -> Callable[..., Any]:
    """Return the option of a number with a unit."""
    return click.option(name, variable, type=limits, default=default, show_default=True, metavar=metavar, help=about)


def _random_settings(default: int) -> Callable[..., Any]:
    """Return the options of a benchmark over random settings."""
    count, seed = _number("--count", default, "Number of random settings."), _seed("Seed of the first setting.")
    return lambda command: count(seed(command))


def _report(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of all benchmarks that report a table."""
    return update(options.quiet(options.as_json(command)))


@bench.command()
@count_of(20)
@_report
def peers(**given: Any) -> None:
    """Compare with NumPy, Acoular, PyTorch and JAX.

    Libraries that are not installed are left out: pip install 'ertis-numba[peers]'.
    """
    run("peers", _benchmark("peers"), **given)


@bench.command()
@_number("--count", 5, "Repetitions.")
@click.option(
    "--update",
    "targets",
    multiple=True,
    type=click.Path(path_type=Path, dir_okay=False, exists=True, writable=True),
    metavar="nominal_costs.py",
    help="Write the costs into this file of nominal costs, by which plans are chosen, or into the table of a Markdown "
    "file; repeatable. New costs change images.",
)
@click.option(
    "--unit",
    "units",
    multiple=True,
    metavar="NAME",
    help="Measure only this unit of work, relative to the other nominal costs; repeatable. All by default.",
)
@options.quiet
@options.as_json
def costs(*, count: int, targets: tuple[Path, ...], units: tuple[str, ...], quiet: bool, as_json: bool) -> None:
    """Measure the kernel costs that the planner uses.

    Covers every instruction set of this machine. The table also has the nominal costs.
    """
    from ertis_bench import markdown

    benchmark = _benchmark("cpu_times.costs")
    for unit in units:
        if unit not in benchmark.UNITS:
            raise click.BadParameter(
                f"unit {unit!r} is unknown; known are {', '.join(benchmark.UNITS)}", param_hint="--unit"
            )
    for target in targets:
        if target.suffix == ".md":
            markdown.around(target, benchmark.MARKER)
        elif target.name != "nominal_costs.py":
            raise click.BadParameter(
                f"{target} is not nominal_costs.py; choose ertis_numba/chain/nominal_costs.py, or a Markdown file",
                param_hint="--update",
            )
    report = benchmark.run(count=count, say=lambda text: options.say(text, quiet=quiet), units=units or benchmark.UNITS)
    for target in targets:
        benchmark.update(target, report)
    if as_json:
        options.print_json(report)
    elif not targets:
        click.echo(benchmark.as_markdown(report))


@bench.command()
@_random_settings(200)
@_report
def verification(**given: Any) -> None:
    """Compare --verify with a float64 reference.

    Settings are random; nothing is timed.
    """
    run("verification", _benchmark("error_trials.verify_trials"), **given)


@bench.command()
@count_of(20)
@click.option(
    "--directions", metavar="GRID", default="3000", show_default=True, help="Directions, as in 'ertis process'."
)
@_report
def beamformers(**given: Any) -> None:
    """Measure time and error of each beamformer.

    Includes weightings, at the default error budget.
    """
    run("beamformers", _benchmark("cpu_times.beamformers"), **given)


@bench.command()
@_random_settings(300)
@_report
def budgets(**given: Any) -> None:
    """Count random settings that exceed their error budget.

    Distinguishes settings with and without a warning; nothing is timed.
    """
    run("budgets", _benchmark("error_trials.budgets"), **given)


@bench.command()
@_number("--count", 400, "Points per case.")
@_seed("Seed of the point positions.")
@_report
def points(**given: Any) -> None:
    """Compare errors of points with their uncertainties.

    Varies grids, error budgets and noise; nothing is timed.
    """
    run("points", _benchmark("error_trials.point_errors"), **given)


@bench.command()
@_number("--count", 30, "Arrays with faults.")
@_number("--healthy", 200, "Arrays without faults.", least=0)
@_seed("Seed of the first array.")
@_report
def calibration(**given: Any) -> None:
    """Calibrate arrays with random errors, and count the faults found."""
    run("calibration", _benchmark("error_trials.calibration"), **given)


@bench.command()
@_number("--count", 12, "Scenes.")
@_number("--rooms", 4, "Rooms.", least=0)
@_seed("Seed of the first scene.")
@click.option(
    "--only",
    multiple=True,
    type=click.Choice(["calls", "clocks", "delays", "emitters", "reflections", "scans"]),
    metavar="PART",
    help="Run only this part: calls compares sensors with equal and with different calls, clocks checks clocks and "
    "mountings by direct sound, delays compares delays of sensors that emit in sequence, emitters finds broken and "
    "wrongly stated emitters, reflections counts spurious confirmed points where walls reflect sound several times, "
    "and scans compares laser scans of confirmed reflectors with rays.",
)
@_report
def fusion(**given: Any) -> None:
    """Measure ghosts and positions in fused images of four sensors."""
    run("fusion", _benchmark("platform_trials.fusion"), **given)


@bench.command()
@_number("--count", 20, "Rooms, or scenes of each kind.")
@click.option(
    "--only",
    multiple=True,
    type=click.Choice(["scenes"]),
    help="Run odometry in drawn scenes instead: moving objects, few reflectors, corridors, platforms at rest, and "
    "others.",
)
@_quantity(
    "--length",
    "length_m",
    click.FloatRange(min=0.0),
    0.0,
    "M",
    "Length of a path through a hall; 0 leaves out the hall.",
)
@_seed("Seed of the first room or scene.")
@_report
def motion(**given: Any) -> None:
    """Measure errors of ego-velocity and odometry."""
    run("motion", _benchmark("platform_trials.motion"), **given)


@bench.command("map")
@_number("--count", 1, "Rooms.", least=0)
@_number("--poses", 40, "Poses in each room.")
@_quantity(
    "--length",
    "length_m",
    click.FloatRange(0.0, 500.0),
    32.0,
    "M",
    "Length of the path through a hall; 0 leaves out the hall.",
)
@_quantity("--rate", "rate_hz", click.FloatRange(0.0, 20.0, min_open=True), 2.5, "HZ", "Pulses per second, at 1 m/s.")
@click.option(
    "--only",
    multiple=True,
    type=click.Choice(["space", "shifts"]),
    metavar="PART",
    help="Run only this part: space maps rooms in three dimensions, with rough floors and ceilings and without a hall, "
    "and shifts maps the example platform with poses that are moved by a part of a cell.",
)
@_seed("Seed of the first room, and of the hall.", default=1)
@_report
def mapping(**given: Any) -> None:
    """Measure errors of occupancy maps."""
    run("map", _benchmark("platform_trials.mapping"), **given)


@bench.command()
@_number("--count", 3, "Maps of each by Acoular.")
@_number("--seeds", 100, "Pairs of sources.", least=0)
@_number("--bearings", 20, "Trials of bearings.", least=0)
@_number("--trials", 1000, "Maps of each kind of noise in which false alarms are counted.")
@click.option(
    "--only",
    multiple=True,
    type=click.Choice(["false-alarms"]),
    help="Count only false alarms of bearings, which takes a few minutes.",
)
@_seed("Seed of the signals, and of the first trial.")
@_report
def passive(**given: Any) -> None:
    """Measure errors and times of acoustic maps.

    Compares them with Acoular if it is installed: pip install 'ertis-numba[peers]'.
    """
    run("passive", _benchmark("passive"), **given)


@bench.command()
@count_of(30)
@_report
def scaling(**given: Any) -> None:
    """Measure time versus directions, ranges and threads.

    Also varies the number of microphones.
    """
    run("scaling", _benchmark("cpu_times.scaling"), **given)


@bench.command()
@count_of(30)
@click.option(
    "--verdicts",
    type=click.IntRange(min=1),
    metavar="N",
    help="Instead of timing, restore each effect that was left out of N random scenes; fail if it changes an image.",
)
@_report
def simulation(*, verdicts: int | None, **given: Any) -> None:
    """Time simulations with relevant and with all effects."""
    if verdicts is None:
        run("simulation", _benchmark("simulation_trials.simulation"), **given)
        return
    from ertis_numba.base.errors import DataError

    if given["targets"]:
        raise click.UsageError("--verdicts writes no table; remove --update")
    trials = _benchmark("simulation_trials.verdicts")
    report = trials.run(count=verdicts, say=lambda text: options.say(text, quiet=given["quiet"]))
    if given["as_json"]:
        options.print_json(report)
    else:
        click.echo(
            f"{report['verdicts']} verdicts in {report['scenes']} scenes, {report['rendered']} of them by A/B renders; "
            f"effects left out that change an image by more than the tolerance: {len(report['wrong'])}"
        )
    if report["wrong"]:
        raise DataError(f"effects omitted in error: {report['wrong']}; report these scenes")


@bench.command()
@_number("--count", 24, "Number of recordings.", least=2)
@_number("--rounds", 5, "Number of times to measure each case; all cases take turns.")
@_report
def many(**given: Any) -> None:
    """Time many recordings on workers and a dask cluster.

    Compares all output files.
    """
    run("many", _benchmark("cpu_times.campaign_scaling"), **given)


@bench.command("health")
@click.option(
    "--long", is_flag=True, help="Use 1,000 healthy arrays and 30 trials per fault instead of 40 arrays and 1 trial."
)
@_seed("Seed of the scenes.")
@_report
def of_health(**given: Any) -> None:
    """Count false alarms and named faults of health checks."""
    run("health", _benchmark("health_trials"), **given)


@bench.command()
@click.option(
    "--duration",
    "duration_s",
    type=float,
    metavar="S",
    help="Duration of each part; by default five minutes for storage and one minute for others.",
)
@_seed("Seed of the samples.", default=1)
@click.option(
    "--only", multiple=True, metavar="PART", help="Run only this part, such as storage or processing; repeatable."
)
@click.option(
    "--folder",
    type=click.Path(path_type=Path, file_okay=False, exists=True),
    metavar="DIR",
    help="Folder for stored data; needs 220 MB per second of the run.",
)
@_report
def network(*, only: tuple[str, ...], **given: Any) -> None:
    """Measure storage and imaging of a central node.

    Uses keys, and checks every sample and image.
    """
    from ertis_numba.base import checks

    benchmark = _benchmark("network_trials.performance")
    for part in only:
        checks.choice("--only", part, benchmark.PARTS)
    if given["duration_s"] is not None:
        checks.positive("--duration", given["duration_s"])
    run("network", benchmark, only=only, **given)


@bench.command()
@_quantity("--duration", "duration_s", click.FloatRange(min=10.0), 60.0, "S", "Time that each number must last.")
@_seed("Seed of the samples.", default=1)
@_report
def capacity(**given: Any) -> None:
    """Find how many sensors this machine stores, images and fuses without a loss.

    Takes about ten minutes. Stop other programs first.
    """
    run("capacity", _benchmark("network_trials.capacity"), **given)


@bench.command()
@_quantity(
    "--duration",
    "duration_s",
    click.FloatRange(min=2.0),
    30.0,
    "S",
    "Duration of each run: images, images and storage, serial line.",
)
@_seed("Seed of the samples.", default=1)
@_report
def latency(**given: Any) -> None:
    """Time each stage from a sensor node to an application.

    Also measures the processor time of each process.
    """
    run("latency", _benchmark("network.latency"), **given)


@bench.command()
@click.option(
    "--results",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("bench/results"),
    show_default=True,
    metavar="FOLDER",
    help="Folder for results, one file per run.",
)
@click.option(
    "--newest", is_flag=True, help="Measure nothing; write the tables of the newest results. No GPU is needed."
)
@_report
def gpu(*, newest: bool, **given: Any) -> None:
    """Test and time the NVIDIA GPU of this machine.

    Takes less than ten minutes, and compares with other libraries and limits.
    """
    run("gpu", _benchmark("gpu_trials.gpu"), measure=not newest, **given)
