"""``ertis simulate``: simulate a scene and write a recording."""

import warnings
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import options

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ertis_numba.frames import Measurement, Reflector, Trajectory, TrueSource
    from ertis_numba.simulation import Scene
    from ertis_numba.simulation.effect_plan import EffectPlan
    from ertis_numba.simulation.render import Simulator
    from ertis_numba.storage import GroundTruthLog

    Truths = dict[str, tuple[list[Reflector], list[TrueSource]]]

__all__ = ["simulate"]

_FOLLOWED = 0.6  # of full scale; larger signals exceed the range of the modulators
_COLUMN_BYTES = 72  # of a measurement, in addition to its samples: stamp, CRC-32 and air
_REFLECTOR_BYTES = 200  # of a reflector, in the recording and in the temporary file
_ROW = "{name:22}  {state:4}  {estimate:>10}  {cost:>8}  {reason}"


@click.command()
@options.input_file("SCENE.toml")
@options.output("Recording to write; SCENE.h5 beside the scene by default.")
@click.option(
    "--count",
    type=click.IntRange(min=1),
    metavar="N",
    help="Number of measurements per sensor; the scene's own by default.",
)
@click.option("--seed", type=click.IntRange(min=0), metavar="S", help="Seed of the noise; the scene's own by default.")
@options.sensor("Simulate this sensor only; all sensors by default.")
@click.option(
    "--tolerance-db",
    type=float,
    metavar="DB",
    help="Omit effects that no key requests and that change no image by more than this; 0 keeps all effects. The "
    "scene's own by default, which is 0.1 unless set.",
)
@click.option("--explain", is_flag=True, help="Print a table of effects with their state, the reason and the cost.")
@options.force
@options.quiet
@options.as_json
def simulate(
    *,
    path: Path,
    target: Path | None,
    count: int | None,
    seed: int | None,
    sensor: str | None,
    tolerance_db: float | None,
    explain: bool,
    force: bool,
    quiet: bool,
    as_json: bool,
) -> None:
    """Simulate a scene and write a recording.

    The recording contains the data that the scene's sensors would record, the scene itself, and the ground truth: the
    position at which an image should show each reflector. Only effects that matter in the scene are simulated. Scene,
    seed, sensor and measurement index determine every bit.
    """
    from ertis_numba.base.errors import PoseWarning
    from ertis_numba.simulation import load_scene
    from ertis_numba.storage import check_target, write_recording

    changes = {"count": count, "seed": seed, "tolerance_db": tolerance_db}
    scene = load_scene(path)
    scene = scene.replace(**{name: value for name, value in changes.items() if value is not None})
    target = target or path.with_suffix(".h5")
    check_target(target, overwrite=force, sources=[path])
    names = [scene.sensor(sensor).name] if sensor else [each.name for each in scene.sensors]
    for name in names:
        options.note_layout(scene.sensor(name).array)
    _require_room(target, scene, names)
    with options.note_when_slow(options.PREPARING, quiet=quiet):
        from ertis_numba.simulation.effect_plan import make_plan
        from ertis_numba.simulation.render import Simulator, compile_kernels

        compile_kernels()
    with options.note_when_slow("choosing the effects to simulate ...", quiet=quiet, after_s=3.0):
        plan = make_plan(scene)
        simulators = [Simulator(scene, sensor=name, plan=plan) for name in names]
        if explain:  # costs exclude the first call, which compiles
            for simulator in simulators:
                simulator.render(0)
                simulator.clock.cost_ms.clear()
    firsts = {each.sensor.name: (each.reflectors(0), each.sources(0)) for each in simulators}
    _require_room(target, scene, names, n_reflectors=sum(len(row) for both in firsts.values() for row in both))
    with ExitStack() as stack:
        logs = {name: stack.enter_context(_log(scene, plan, target.parent)) for name in names}
        shown = stack.enter_context(
            options.progress(
                _measurements(simulators, firsts, logs),
                length=scene.count * len(names),
                label="simulating",
                quiet=quiet,
            )
        )
        with warnings.catch_warnings(category=PoseWarning, action="ignore"):  # The scene defines them.
            write_recording(
                target,
                shown,
                overwrite=force,
                source=path.name,
                truth=logs,
                mounting={simulator.sensor.name: _mounting(simulator) for simulator in simulators},
                poses=_poses(scene),
            )
        n_reflectors = max(log.n_own_targets for log in logs.values())
    options.say(_summary(target, scene, n_sensors=len(names), n_reflectors=n_reflectors), quiet=quiet)
    _print_notes(plan, simulators, quiet=quiet)
    effects = _effects(plan, simulators)
    if as_json:
        options.print_json(_report(target, scene, plan, firsts) | ({"effects": effects} if explain else {}))
    elif explain:
        _print(effects)


def _require_room(target: Path, scene: "Scene", names: "Sequence[str]", n_reflectors: int = 0) -> None:
    """Raise an error if the recording exceeds the free disk space."""
    from ertis_numba.base.atomic_files import require_free_space
    from ertis_numba.frames.sample_format import sample_format

    n_bytes = sum(sample_format(scene.sensor(name).settings()).n_bytes + _COLUMN_BYTES for name in names)
    require_free_space(
        target.parent,
        scene.count * (n_bytes + n_reflectors * _REFLECTOR_BYTES),
        purpose=f"{options.counted(scene.count, 'measurement')} of {options.counted(len(names), 'sensor')}",
    )


def _measurements(
    simulators: "Sequence[Simulator]", firsts: "Truths", logs: "dict[str, GroundTruthLog]"
) -> "Iterator[Measurement]":
    """Yield simultaneous measurements, one sensor after the other, and log their ground truth."""
    scene = simulators[0].scene
    for index in range(scene.count):
        for simulator in simulators:
            name = simulator.sensor.name
            anew = index and scene.moves
            logs[name].append(*((simulator.reflectors(index), simulator.sources(index)) if anew else firsts[name]))
            yield simulator.render(index)


def _log(scene: "Scene", plan: "EffectPlan", folder: Path) -> "GroundTruthLog":
    from ertis_numba.storage import GroundTruthLog

    # Store the verdicts, so that the same data can be rendered even if an A/B render would decide otherwise.
    decided = scene.replace(effects={verdict.name: verdict.on for verdict in plan.verdicts})
    return GroundTruthLog(decided.to_toml(), scene.seed, left_out=plan.left_out, folder=folder)


def _mounting(simulator: "Simulator") -> Any:
    """Return the position and the rotation of a sensor at the start of the first measurement."""
    return simulator.sensor.path().position_at(0.0), simulator.sensor.quaternion()


def _poses(scene: "Scene") -> "Trajectory | None":
    """Return the poses of the scene's platform at all pulses, and one more, since sensors follow each other by SYNC."""
    import numpy as np

    return None if scene.platform is None else scene.platform.trajectory(np.arange(scene.count + 1) / scene.rate_hz)


def _print_notes(plan: "EffectPlan", simulators: "Sequence[Simulator]", *, quiet: bool) -> None:
    """Report the effects that are left out, signals beyond full scale, and the notes of the plan."""
    if plan.left_out:
        options.say(
            f"left out: {', '.join(plan.left_out)}; --explain gives the reasons, --tolerance-db 0 keeps all effects",
            quiet=quiet,
        )
    for simulator in simulators:
        followed, by = (_FOLLOWED, "modulators") if simulator.sensor.recording.is_pdm else (1.0, "converters")
        if simulator.loudest > followed:
            options.note(
                f"signals of {simulator.sensor.name} reach {simulator.loudest:.2g} of full scale, but {by} "
                f"follow only up to {followed:g}; lower emitter.level_db or increase distances",
                quiet=quiet,
            )
    for note in plan.notes:
        options.note(note, quiet=quiet)


def _effects(plan: "EffectPlan", simulators: "Sequence[Simulator]") -> list[dict[str, Any]]:
    """Return the rows of ``--explain``; costs are per measurement and sensor."""
    rendered = len(simulators) * simulators[0].scene.count
    return [
        {
            "name": verdict.name,
            "on": verdict.on,
            "forced": verdict.forced,
            "ab_rendered": verdict.ab_rendered,
            "coupled": verdict.coupled,
            "reason": verdict.reason,
            "estimate_db": None if verdict.estimate_db is None else round(verdict.estimate_db, 6),
            "cost_ms": round(sum(simulator.clock.cost_ms[verdict.name] for simulator in simulators) / rendered, 3),
        }
        for verdict in plan.verdicts
    ]


def _print(effects: list[dict[str, Any]]) -> None:
    click.echo(_ROW.format(name="effect", state="", estimate="change", cost="cost", reason="why"))
    for effect in effects:
        estimate = effect["estimate_db"]
        click.echo(
            _ROW.format(
                name=effect["name"],
                state=("on" if effect["on"] else "off") + ("*" if effect["forced"] else ""),
                estimate="" if estimate is None else f"{estimate:.2g} dB",
                cost=f"{effect['cost_ms']:.1f} ms" if effect["on"] else "",
                reason=effect["reason"],
            )
        )
    if any(effect["forced"] for effect in effects):
        click.echo("* set by the scene, regardless of the estimate")


def _summary(target: Path, scene: "Scene", *, n_sensors: int, n_reflectors: int) -> str:
    several = f" of {options.counted(n_sensors, 'sensor')}" if n_sensors > 1 else ""
    measurements = options.counted(scene.count, "measurement")
    return f"{target}: {measurements}{several}, {options.counted(n_reflectors, 'reflector')}"


def _report(target: Path, scene: "Scene", plan: "EffectPlan", firsts: "Truths") -> dict[str, Any]:
    return {
        "output": str(target),
        "measurements": scene.count,
        "seed": scene.seed,
        "left_out": list(plan.left_out),
        "sensors": [
            {"sensor": name, "reflectors": [_row(each) for each in reflectors]}
            | ({"sources": [_row(each) for each in sources]} if sources else {})
            for name, (reflectors, sources) in firsts.items()
        ],
    }


def _row(true: "Reflector | TrueSource") -> dict[str, Any]:
    row = {name: getattr(true, name) for name in true.__slots__}
    if row.get("emitter") == "":  # usual case: an echo of the sensor's own call
        del row["emitter"]
    return {name: round(value, 6) if isinstance(value, float) else value for name, value in row.items()}
