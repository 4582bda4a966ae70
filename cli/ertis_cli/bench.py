"""``ertis bench``: benchmarks that produce the tables of the documentation."""

import importlib
import os
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

# The NumPy backends are compared on one thread. NumPy's BLAS reads this variable when it is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import click

from ertis_cli import options

__all__ = ["bench"]


def _count(default: int) -> Callable[..., Any]:
    return click.option(
        "--count",
        type=click.IntRange(min=1),
        default=default,
        show_default=True,
        metavar="N",
        help="Measurements per case.",
    )


def _seed(about: str, *, default: int = 0) -> Callable[..., Any]:
    """Return a seed option with a fixed default, so that runs are reproducible."""
    return click.option(
        "--seed", type=click.IntRange(min=0), default=default, show_default=True, metavar="S", help=about
    )


def _random_settings(default: int) -> Callable[..., Any]:
    """Return the options of a benchmark over random settings."""
    count = click.option(
        "--count",
        type=click.IntRange(min=1),
        default=default,
        show_default=True,
        metavar="N",
        help="Number of random settings.",
    )
    seed = _seed("Seed of the first setting.")
    return lambda command: count(seed(command))


_update = click.option(
    "--update",
    "targets",
    multiple=True,
    type=click.Path(path_type=Path, dir_okay=False, exists=True, writable=True),
    metavar="FILE",
    help="Replace the table between the markers in a Markdown file; repeatable.",
)


@click.group()
def bench() -> None:
    """Run benchmarks of speed and accuracy.

    The wheel contains paper and accuracy. The others exist only in the source folder.
    """
    from ertis_numba import kernels

    kernels.require_numba("'ertis bench'")


@bench.command()
@_count(100)
@_update
@options.quiet
@options.as_json
def paper(**given: Any) -> None:
    """Time the signal chain at 90, 1850 and 3000 directions."""
    from ertis_bench import paper as benchmark

    _run("paper", benchmark, **given)


@bench.command()
@_count(20)
@_update
@options.quiet
@options.as_json
def peers(**given: Any) -> None:
    """Compare with NumPy, Acoular, PyTorch and JAX.

    Libraries that are not installed are left out: pip install 'ertis-numba[peers]'.
    """
    _run("peers", _in_source_folder("peers"), **given)


@bench.command()
@_count(20)
@click.option(
    "--directions", metavar="GRID", default="3000", show_default=True, help="Directions, as in 'ertis process'."
)
@click.option(
    "--plot",
    "picture",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FRONT.png",
    help="Plot error versus time to this file, which is overwritten.",
)
@_update
@options.quiet
@options.as_json
def accuracy(*, picture: Path | None, **given: Any) -> None:
    """Measure image error versus time.

    Compares about twenty plans and the paper's method.
    """
    from ertis_bench import accuracy as benchmark

    if picture and not picture.absolute().parent.is_dir():  # refuse now rather than after minutes
        raise click.BadParameter(f"folder {picture.parent} does not exist; create it first", param_hint="--plot")
    report = _run("accuracy", benchmark, **given)
    if picture:
        benchmark.plot(report, picture)


@bench.command()
@click.option("--count", type=click.IntRange(min=1), default=5, show_default=True, metavar="N", help="Repetitions.")
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

    benchmark = _in_source_folder("costs", "cpu_times.costs")
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
@_update
@options.quiet
@options.as_json
def verification(**given: Any) -> None:
    """Compare --verify with a float64 reference.

    Settings are random; nothing is timed.
    """
    _run("verification", _in_source_folder("verification", "error_trials.verify_trials"), **given)


@bench.command()
@_count(20)
@click.option(
    "--directions", metavar="GRID", default="3000", show_default=True, help="Directions, as in 'ertis process'."
)
@_update
@options.quiet
@options.as_json
def beamformers(**given: Any) -> None:
    """Measure time and error of each beamformer.

    Includes weightings, at the default error budget.
    """
    _run("beamformers", _in_source_folder("beamformers", "cpu_times.beamformers"), **given)


@bench.command()
@_random_settings(300)
@_update
@options.quiet
@options.as_json
def budgets(**given: Any) -> None:
    """Count random settings that exceed their error budget.

    Distinguishes settings with and without a warning; nothing is timed.
    """
    _run("budgets", _in_source_folder("budgets", "error_trials.budgets"), **given)


@bench.command()
@click.option(
    "--count", type=click.IntRange(min=1), default=400, show_default=True, metavar="N", help="Points per case."
)
@_seed("Seed of the point positions.")
@_update
@options.quiet
@options.as_json
def points(**given: Any) -> None:
    """Compare errors of points with their uncertainties.

    Varies grids, error budgets and noise; nothing is timed.
    """
    _run("points", _in_source_folder("points", "error_trials.point_errors"), **given)


@bench.command()
@click.option(
    "--count", type=click.IntRange(min=1), default=30, show_default=True, metavar="N", help="Arrays with faults."
)
@click.option(
    "--healthy", type=click.IntRange(min=0), default=200, show_default=True, metavar="N", help="Arrays without faults."
)
@_seed("Seed of the first array.")
@_update
@options.quiet
@options.as_json
def calibration(**given: Any) -> None:
    """Calibrate arrays with random errors, and count the faults found."""
    _run("calibration", _in_source_folder("calibration", "error_trials.calibration"), **given)


@bench.command()
@click.option("--count", type=click.IntRange(min=1), default=12, show_default=True, metavar="N", help="Scenes.")
@click.option("--rooms", type=click.IntRange(min=0), default=4, show_default=True, metavar="N", help="Rooms.")
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
@_update
@options.quiet
@options.as_json
def fusion(**given: Any) -> None:
    """Measure ghosts and positions in fused images of four sensors."""
    _run("fusion", _in_source_folder("fusion", "platform_trials.fusion"), **given)


@bench.command()
@click.option(
    "--count",
    type=click.IntRange(min=1),
    default=20,
    show_default=True,
    metavar="N",
    help="Rooms, or scenes of each kind.",
)
@click.option(
    "--only",
    multiple=True,
    type=click.Choice(["scenes"]),
    help="Run odometry in drawn scenes instead: moving objects, few reflectors, corridors, platforms at rest, and "
    "others.",
)
@click.option(
    "--length",
    "length_m",
    type=click.FloatRange(min=0.0),
    default=0.0,
    show_default=True,
    metavar="M",
    help="Length of a path through a hall; 0 leaves out the hall.",
)
@_seed("Seed of the first room or scene.")
@_update
@options.quiet
@options.as_json
def motion(**given: Any) -> None:
    """Measure errors of ego-velocity and odometry."""
    _run("motion", _in_source_folder("motion", "platform_trials.motion"), **given)


@bench.command("map")
@click.option("--count", type=click.IntRange(min=0), default=1, show_default=True, metavar="N", help="Rooms.")
@click.option(
    "--poses", type=click.IntRange(min=1), default=40, show_default=True, metavar="N", help="Poses in each room."
)
@click.option(
    "--length",
    "length_m",
    type=click.FloatRange(0.0, 500.0),
    default=32.0,
    show_default=True,
    metavar="M",
    help="Length of the path through a hall; 0 leaves out the hall.",
)
@click.option(
    "--rate",
    "rate_hz",
    type=click.FloatRange(0.0, 20.0, min_open=True),
    default=2.5,
    show_default=True,
    metavar="HZ",
    help="Pulses per second, at 1 m/s.",
)
@click.option(
    "--only",
    multiple=True,
    type=click.Choice(["space", "shifts"]),
    metavar="PART",
    help="Run only this part: space maps rooms in three dimensions, with rough floors and ceilings and without a hall, "
    "and shifts maps the example platform with poses that are moved by a part of a cell.",
)
@_seed("Seed of the first room, and of the hall.", default=1)
@_update
@options.quiet
@options.as_json
def mapping(**given: Any) -> None:
    """Measure errors of occupancy maps."""
    _run("map", _in_source_folder("map", "platform_trials.mapping"), **given)


@bench.command()
@click.option(
    "--count", type=click.IntRange(min=1), default=3, show_default=True, metavar="N", help="Maps of each by Acoular."
)
@click.option(
    "--seeds", type=click.IntRange(min=0), default=100, show_default=True, metavar="N", help="Pairs of sources."
)
@click.option(
    "--bearings", type=click.IntRange(min=0), default=20, show_default=True, metavar="N", help="Trials of bearings."
)
@click.option(
    "--trials",
    type=click.IntRange(min=1),
    default=1000,
    show_default=True,
    metavar="N",
    help="Maps of each kind of noise in which false alarms are counted.",
)
@click.option(
    "--only",
    multiple=True,
    type=click.Choice(["false-alarms"]),
    help="Count only false alarms of bearings, which takes a few minutes.",
)
@_seed("Seed of the signals, and of the first trial.")
@_update
@options.quiet
@options.as_json
def passive(**given: Any) -> None:
    """Measure errors and times of acoustic maps.

    Compares them with Acoular if it is installed: pip install 'ertis-numba[peers]'.
    """
    _run("passive", _in_source_folder("passive"), **given)


@bench.command()
@_count(30)
@_update
@options.quiet
@options.as_json
def scaling(**given: Any) -> None:
    """Measure time versus directions, ranges and threads.

    Also varies the number of microphones.
    """
    _run("scaling", _in_source_folder("scaling", "cpu_times.scaling"), **given)


@bench.command()
@_count(30)
@click.option(
    "--verdicts",
    type=click.IntRange(min=1),
    metavar="N",
    help="Instead of timing, restore each effect that was left out of N random scenes; fail if it changes an image.",
)
@_update
@options.quiet
@options.as_json
def simulation(*, verdicts: int | None, **given: Any) -> None:
    """Time simulations with relevant and with all effects."""
    if verdicts is None:
        _run("simulation", _in_source_folder("simulation", "simulation_trials.simulation"), **given)
        return
    from ertis_numba.base.errors import DataError

    if given["targets"]:
        raise click.UsageError("--verdicts writes no table; remove --update")
    trials = _in_source_folder("simulation", "simulation_trials.verdicts")
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
@click.option(
    "--count", type=click.IntRange(min=2), default=24, show_default=True, metavar="N", help="Number of recordings."
)
@click.option(
    "--rounds",
    type=click.IntRange(min=1),
    default=5,
    show_default=True,
    metavar="N",
    help="Number of times to measure each case; all cases take turns.",
)
@_update
@options.quiet
@options.as_json
def many(**given: Any) -> None:
    """Time many recordings on workers and a dask cluster.

    Compares all output files.
    """
    _run("many", _in_source_folder("many", "cpu_times.campaign_scaling"), **given)


@bench.command("health")
@click.option(
    "--long", is_flag=True, help="Use 1,000 healthy arrays and 30 trials per fault instead of 40 arrays and 1 trial."
)
@_seed("Seed of the scenes.")
@_update
@options.quiet
@options.as_json
def of_health(**given: Any) -> None:
    """Count false alarms and named faults of health checks."""
    _run("health", _in_source_folder("health", "health_trials"), **given)


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
@_update
@options.quiet
@options.as_json
def network(*, only: tuple[str, ...], **given: Any) -> None:
    """Measure storage and imaging of a central node.

    Uses keys, and checks every sample and image.
    """
    from ertis_numba.base import checks

    benchmark = _in_source_folder("network", "network_trials.performance")
    for part in only:
        checks.choice("--only", part, benchmark.PARTS)
    if given["duration_s"] is not None:
        checks.positive("--duration", given["duration_s"])
    _run("network", benchmark, only=only, **given)


@bench.command()
@click.option(
    "--duration",
    "duration_s",
    type=click.FloatRange(min=2.0),
    default=30.0,
    show_default=True,
    metavar="S",
    help="Duration of each run: images, images and storage, serial line.",
)
@_seed("Seed of the samples.", default=1)
@_update
@options.quiet
@options.as_json
def latency(**given: Any) -> None:
    """Time each stage from a sensor node to an application.

    Also measures the processor time of each process.
    """
    _run("latency", _in_source_folder("latency", "network.latency"), **given)


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
@_update
@options.quiet
@options.as_json
def gpu(*, newest: bool, **given: Any) -> None:
    """Test and time the NVIDIA GPU of this machine.

    Takes less than ten minutes, and compares with other libraries and limits.
    """
    _run("gpu", _in_source_folder("gpu", "gpu_trials.gpu"), measure=not newest, **given)


def _in_source_folder(name: str, package: str | None = None) -> ModuleType:
    """Return a benchmark that the wheel lacks."""
    module = f"ertis_bench.{package or name}"
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name not in {module, module.rpartition(".")[0]}:
            raise
        from ertis_numba.base.errors import ArgumentError

        raise ArgumentError(
            f"'ertis bench {name}' exists only in the source folder; run 'pip install --editable .' in that folder"
        ) from None


def _run(
    name: str, benchmark: ModuleType, *, targets: tuple[Path, ...], quiet: bool, as_json: bool, **given: Any
) -> dict[str, Any]:
    from ertis_bench import markdown, tables

    parts = given.get("only", ())
    forms = getattr(benchmark, "FORMS", None) or tables.FORMS[name]
    # Files without a place are refused before minutes of work.
    places = [(target, *markdown.place(target, "ertis bench", forms, parts)) for target in targets]
    report: dict[str, Any] = benchmark.run(say=lambda text: options.say(text, quiet=quiet), **given)
    for target, form, marker in places:
        markdown.update(target, marker, forms[form](report))
    if as_json:
        options.print_json(report)
    elif not targets:
        click.echo(forms[name](report))
    return report
