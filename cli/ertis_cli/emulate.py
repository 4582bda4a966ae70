"""``ertis emulate``: devices that answer and measure like real ones, on pseudo terminals."""

import json
import threading
import time
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click

from ertis_cli import options
from ertis_cli._signals import broken_off_by_signals, interrupt_later

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from ertis_numba.devices.emulator import Emulator
    from ertis_numba.simulation import Scene
    from ertis_numba.simulation.render import Simulator
    from ertis_numba.storage import RecordingReader

    Given = Mapping[str, tuple[Any, Any]]  # by sensor: measurements, and those without emission

__all__ = ["emulate"]

_LOOK_S = 0.5  # how often devices are looked after


class _Fault(click.ParamType):  # type: ignore[type-arg]  # generic since click 8.4 only
    name = "KIND=P"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, float]:
        kind, equals, share = str(value).partition("=")
        try:
            return kind, float(share if equals else "")
        except ValueError:
            return self.fail(f"{value!r} is no fault, give a kind and a probability as in lose=0.01", param, ctx)


@click.command()
@options.input_file("SCENE.toml|REC.h5")
@options.sensor("Emulate this sensor only; all by default.")
@click.option(
    "--count", type=click.IntRange(min=1), metavar="N", help="Measurements of a scene; the scene's own by default."
)
@click.option("--seed", type=click.IntRange(min=0), metavar="S", help="Decides the noise of a scene, and faults.")
@click.option(
    "--sync-rate",
    type=click.FloatRange(0.001, 1000.0),
    metavar="HZ",
    help="Connect the devices to a SYNC line with so many pulses per second.",
)
@click.option(
    "--link",
    type=click.Path(path_type=Path),
    metavar="PATH",
    help="Link that leads to the port of a single device; by default 'ertis devices' finds it by the sensor's name.",
)
@click.option(
    "--fault",
    "faults",
    type=_Fault(),
    multiple=True,
    metavar="KIND=P",
    help="Spoil measurements with a probability: flip, duplicate, lose, add, swap, cut, drop, stall or unplug.",
)
@click.option(
    "--unplug",
    "absences",
    type=options.INTERVAL,
    multiple=True,
    metavar="AT:FOR",
    help="Unplug the devices after AT seconds, for FOR seconds.",
)
@click.option(
    "--log", "log_path", type=click.Path(path_type=Path), metavar="FILE", help="Append a line of JSON per measurement."
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object per device on stdout.")
@options.quiet
def emulate(
    *,
    path: Path,
    sensor: str | None,
    count: int | None,
    seed: int | None,
    sync_rate: float | None,
    link: Path | None,
    faults: tuple[tuple[str, float], ...],
    absences: tuple[tuple[float, float], ...],
    log_path: Path | None,
    quiet: bool,
    as_json: bool,
) -> None:
    """Be the sensors of a scene or of a recording, until interrupted.

    Each sensor is a device of its own, on a pseudo terminal whose path is printed when it is ready. It takes the
    commands of a real one, and measures what the scene lets it hear, or what was recorded, over and over.
    Measurements without emission are those of the scene while all sensors are silent.
    """
    from ertis_numba.devices.emulator import Emulator, SyncChain
    from ertis_numba.devices.emulator.faults import Faults
    from ertis_numba.devices.links import HeldLink, emulated_folder

    kinds = dict(faults)
    Faults(0, kinds)  # refused before a scene is rendered
    is_scene = path.suffix.lower() == ".toml"
    if count is not None and not is_scene:
        raise click.UsageError("--count is of scenes; a recording has its own", ctx=click.get_current_context())
    with ExitStack() as stack:
        stack.enter_context(broken_off_by_signals())
        names = _names(path, sensor, is_scene=is_scene)
        if link is not None and len(names) > 1:
            raise click.UsageError(
                f"--link is of one device, but {path.name} has {len(names)} sensors; choose one with --sensor",
                ctx=click.get_current_context(),
            )
        links = {name: link or emulated_folder() / name for name in names}
        for each in links.values():  # the same
            HeldLink(each).release()
        if is_scene:
            given = _rendered(path, names, count=count, seed=seed, quiet=quiet)
        else:
            given = _replayed(path, names, stack)
        log = None if log_path is None else stack.enter_context(log_path.open("a", encoding="utf-8"))
        devices = [
            stack.enter_context(
                Emulator(
                    words,
                    passive=passive,
                    name=name,
                    faults=Faults((seed or 0) + place, kinds) if kinds else None,
                    link=links[name],
                    log=log,
                    on_port=partial(_tell, name, quiet=quiet),
                )
            )
            for place, (name, (words, passive)) in enumerate(given.items())
        ]
        for device in devices:
            row = {"sensor": device.name, "port": device.port, "link": str(device.link)}
            click.echo(json.dumps(row) if as_json else device.port)
        if sync_rate is not None:
            stack.enter_context(SyncChain(devices, sync_rate))
        _look_after(devices, sorted(absences))


def _names(path: Path, sensor: str | None, *, is_scene: bool) -> list[str]:
    """Return the sensors to emulate, none of which measures what no device can."""
    from ertis_numba.devices.setup import Setup
    from ertis_numba.simulation import load_scene
    from ertis_numba.storage import open_recording

    if is_scene:
        scene = load_scene(path)
        settings = {each.name: each.settings() for each in ([scene.sensor(sensor)] if sensor else scene.sensors)}
    else:
        settings = {}
        for name in options.sensors_of(path, sensor):
            with open_recording(path, sensor=name) as recording:
                settings[name] = recording.settings
    for each in settings.values():
        Setup.of(each)
    return list(settings)


def _rendered(path: Path, names: "Sequence[str]", *, count: int | None, seed: int | None, quiet: bool) -> "Given":
    """Render the scene, then the same with all sensors silent."""
    from ertis_numba.simulation import load_scene

    changes = {"count": count, "seed": seed}
    scene = load_scene(path).replace(**{name: value for name, value in changes.items() if value is not None})
    silent = scene.replace(
        sensors=tuple(each.replace(emitter=each.emitter.replace(silent=True)) for each in scene.sensors)
    )
    with options.note_when_slow(options.PREPARING, quiet=quiet), interrupt_later():
        from ertis_numba.simulation.plan import make_plan
        from ertis_numba.simulation.render import Simulator, compile_kernels

        compile_kernels()
    with options.note_when_slow("deciding which effects matter ...", quiet=quiet, after_s=3.0):
        simulators = [
            [Simulator(each, sensor=name, plan=plan) for name in names]
            for each, plan in [(each, make_plan(each)) for each in (scene, silent)]
        ]
    shown = options.progress(
        _words(simulators, scene), length=2 * scene.count * len(names), label="rendering", quiet=quiet
    )
    words: dict[str, tuple[list[Any], list[Any]]] = {name: ([], []) for name in names}
    with shown as rendered:
        for name, kind, rows in rendered:
            words[name][kind].append(rows)
    return words


def _words(
    simulators: "Sequence[Sequence[Simulator]]", scene: "Scene"
) -> "Iterator[tuple[str, int, NDArray[np.uint32]]]":
    for kind, of_kind in enumerate(simulators):
        for index in range(scene.count):
            for simulator in of_kind:
                yield simulator.sensor.name, kind, simulator.render(index).words


def _replayed(path: Path, names: "Sequence[str]", stack: ExitStack) -> "Given":
    from ertis_numba.storage import open_recording

    return {name: (_Replay(stack.enter_context(open_recording(path, sensor=name))), None) for name in names}


class _Replay:
    """The words of a recording, read when they are wanted."""

    def __init__(self, recording: "RecordingReader") -> None:
        self._recording = recording

    def __len__(self) -> int:
        return len(self._recording)

    def __getitem__(self, index: int) -> "NDArray[np.uint32]":
        return self._recording[index].words


def _tell(name: str, port: str, *, quiet: bool) -> None:
    options.say(f"{name} is back: {port}", quiet=quiet)


def _look_after(devices: "Sequence[Emulator]", absences: "list[tuple[float, float]]") -> NoReturn:
    """Unplug devices when that is due, until one fails or the user has seen enough."""
    began_s = time.monotonic()
    never = threading.Event()
    while True:
        for device in devices:
            if device.error is not None:
                raise device.error
        due_s = absences[0][0] - (time.monotonic() - began_s) if absences else _LOOK_S
        if due_s <= 0:
            for device in devices:
                device.unplug(for_s=absences[0][1])
            del absences[0]
        else:
            never.wait(min(due_s, _LOOK_S))
