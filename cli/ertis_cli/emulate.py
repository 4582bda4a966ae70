"""``ertis sensors emulate``: emulated devices on pseudo terminals."""

import json
import math
import sys
import threading
import time
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import options
from ertis_cli._central_watch import size
from ertis_cli._stop_signals import broken_off_by_signals, stopped_by_signals

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from ertis_cli._emulation import Replayed, SceneRenderer
    from ertis_numba.devices.emulator import DeviceConfig, Emulator

    Refusal = Callable[[str, DeviceConfig], str]
    # By sensor: measurements, measurements without emission, and the check of a configuration.
    Given = Mapping[str, tuple[Any, Any, Refusal]]

__all__ = ["emulate"]

_TIMED_S = 1.0  # rendering time after which the rest is estimated
_LONG_S = 10.0  # estimated time from which it is reported
_POLL_INTERVAL_S = 0.5  # interval between checks of the devices


class _Fault(click.ParamType):  # type: ignore[type-arg]  # generic since click 8.4 only
    name = "KIND=P"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, float]:
        kind, equals, share = str(value).partition("=")
        try:
            return kind, float(share if equals else "")
        except ValueError:
            return self.fail(f"{value!r} is not a fault; choose a kind and a probability, as in lose=0.01", param, ctx)


class _Absence(click.ParamType):  # type: ignore[type-arg]  # as above
    name = "AT:FOR"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, float]:
        at_s, for_s = options.INTERVAL.convert(value, param, ctx)
        if not (0 <= at_s < math.inf and 0 <= for_s < math.inf):
            self.fail(f"{value!r} is not an absence; use two times of at least 0 s, as in 2:5", param, ctx)
        return at_s, for_s


@click.command()
@options.input_file("SCENE.toml|REC.h5")
@options.sensor("Emulate this sensor only; all by default.")
@click.option(
    "--count",
    type=click.IntRange(min=1),
    metavar="N",
    help="Number of measurements of a scene; the scene's own by default.",
)
@click.option("--seed", type=click.IntRange(min=0), metavar="S", help="Seed of the noise of a scene, and of faults.")
@click.option(
    "--sync-rate",
    type=click.FloatRange(0.001, 1000.0),
    metavar="HZ",
    help="Connect the devices to a SYNC line with this pulse rate.",
)
@click.option(
    "--link",
    type=options.FILE,
    metavar="PATH",
    help="Symbolic link to the port of one device; by default, 'ertis sensors list' finds it by the sensor's name.",
)
@click.option(
    "--fault",
    "faults",
    type=_Fault(),
    multiple=True,
    metavar="KIND=P",
    help="Inject a fault with a probability: flip, duplicate, lose, add, swap, cut, drop, stall or unplug; repeatable.",
)
@click.option(
    "--unplug",
    "absences",
    type=_Absence(),
    multiple=True,
    metavar="AT:FOR",
    help="Unplug the devices after AT seconds, for FOR seconds; repeatable.",
)
@click.option(
    "--log",
    "log_path",
    type=options.FILE,
    metavar="FILE",
    help="Append a line of JSON per measurement to this file.",
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
    """Emulate the sensors of a scene or a recording.

    Each sensor is a separate device on a pseudo terminal. The path of the terminal is printed when the device is ready.
    The device accepts the commands of a real one. It returns simulated or recorded measurements, and repeats them
    until Ctrl-C ends the command.
    For measurements without emission, the scene is simulated with all sensors silent.

    A scene is rendered for the call that was uploaded. Without --sync-rate, all measurements with the scene's call, and
    all without emission, are rendered in advance. With --sync-rate, each is rendered at its pulse, and the first pulses
    are slower. A recording supports only its own call; with any other call, the sensor does not measure. A recording
    also keeps its behaviour: a warning is printed if only one of host and recording has a call.

    'ertis capture' can read the mounting of the sensors from the same file: --mounting SCENE.toml|REC.h5.
    """
    from ertis_numba.base.errors import ArgumentError
    from ertis_numba.devices.emulator import Emulator, SyncChain
    from ertis_numba.devices.emulator.faults import Faults
    from ertis_numba.devices.links import HeldLink, emulated_folder

    _require_log(log_path)
    kinds = dict(faults)
    try:
        Faults(0, kinds)  # refuse before rendering a scene
    except ArgumentError as error:
        raise click.UsageError(f"--fault: {error}", ctx=click.get_current_context()) from error
    is_scene = path.suffix.lower() == ".toml"
    if count is not None and not is_scene:
        raise click.UsageError("--count is for scenes; remove it for a recording", ctx=click.get_current_context())
    with ExitStack() as stack:
        stack.enter_context(broken_off_by_signals())
        names = _names(path, sensor, is_scene=is_scene)
        if link is not None:
            _require_link(link, path, names)
        links = {name: link or emulated_folder() / name for name in names}
        for each in links.values():  # refuse a taken link before rendering
            HeldLink(each).release()
        renderer = _renderer(path, names, count=count, seed=seed, quiet=quiet) if is_scene else None
        if renderer is not None and sync_rate is None:
            _render_all(renderer, names, quiet=quiet)
        given = _replayed(path, names, stack) if renderer is None else _rendered(renderer, names)
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
                    accepts=partial(_accepts, refusal, name),
                    on_port=partial(_emit_event, name, quiet=quiet),
                    on_measurement=partial(_report_difference, words) if renderer is None else None,
                )
            )
            for place, (name, (words, passive, refusal)) in enumerate(given.items())
        ]
        signals = stack.enter_context(stopped_by_signals())
        for device in devices:
            row = {"sensor": device.name, "port": device.port, "link": str(device.link)}
            click.echo(json.dumps(row) if as_json else device.port)
        ended = threading.Event()
        signals.obey(ended.set)
        if sync_rate is not None:
            if renderer is not None:
                measurements = f"{options.counted(renderer.count, 'measurement')} of each sensor"
                options.say(f"rendering {measurements} as pulses come; the first round is slower", quiet=quiet)
            stack.enter_context(SyncChain(devices, sync_rate, before=partial(_get_ready, devices, given)))
        _look_after(devices, sorted(absences), ended)
    options.say("the emulated sensors have ended", quiet=quiet)
    sys.exit(128 + signals.came[0])


def _require_log(path: Path | None) -> None:
    """Refuse to append lines to a file of another kind, such as a recording."""
    from ertis_numba.base.errors import ArgumentError

    if path is not None and path.is_file():
        with path.open("rb") as file:
            if file.read(1) not in {b"", b"{"}:
                raise ArgumentError(
                    f"log {path} exists, and is no log of 'ertis sensors emulate'; choose another file (--log)"
                )


def _require_link(link: Path, path: Path, names: "Sequence[str]") -> None:
    """Raise an error for a link to several devices, or in a folder that does not exist."""
    from ertis_numba.base.errors import ArgumentError

    if len(names) > 1:
        raise click.UsageError(
            f"--link is for one device, but {path.name} has {len(names)} sensors; choose one with --sensor",
            ctx=click.get_current_context(),
        )
    if not link.parent.is_dir():
        raise ArgumentError(f"link {link}: folder {link.parent} does not exist; create it or choose another")


def _names(path: Path, sensor: str | None, *, is_scene: bool) -> list[str]:
    """Return the names of the sensors to emulate; raise an error for settings that no device supports."""
    from ertis_numba.devices.setup import Setup
    from ertis_numba.simulation import load_scene
    from ertis_numba.storage import open_recording

    if is_scene:
        scene = load_scene(path)
        settings = {
            each.name: each.settings() for each in (scene.sensors if sensor is None else [scene.sensor(sensor)])
        }
    else:
        settings = {}
        for name in options.sensors_of(path, sensor):
            with open_recording(path, sensor=name) as recording:
                settings[name] = recording.settings
    for each in settings.values():
        Setup.of(each)
    return list(settings)


def _renderer(
    path: Path, names: "Sequence[str]", *, count: int | None, seed: int | None, quiet: bool
) -> "SceneRenderer":
    """Return the scene, ready to be rendered; the first run compiles kernels."""
    from ertis_cli._emulation import SceneRenderer
    from ertis_numba.simulation import load_scene, target_validity
    from ertis_numba.simulation.snapshot import snapshot

    changes = {"count": count, "seed": seed}
    scene = load_scene(path).replace(**{name: value for name, value in changes.items() if value is not None})
    for name in names:
        options.note_layout(scene.sensor(name).array)
        shot = snapshot(scene, scene.sensor(name), 0.0)
        target_validity.require_clear(shot)
        for note in target_validity.notes(shot):
            options.note(note, quiet=quiet)
    with options.note_when_slow(options.PREPARING, quiet=quiet):
        from ertis_numba.simulation.render import compile_kernels

        compile_kernels()
    return SceneRenderer(scene)


def _render_all(renderer: "SceneRenderer", names: "Sequence[str]", *, quiet: bool) -> None:
    """Render the measurements for the scene's call, and those without emission, in advance, so that none is late."""
    behaviours = (True, False) if renderer.emits else (False,)
    n_steps = len(behaviours) * renderer.count * len(names)
    todo = ((name, index, active) for active in behaviours for index in range(renderer.count) for name in names)
    measurements = options.counted(renderer.count * len(names), "measurement")
    with_call = "with a call, and as many without" if renderer.emits else "without a call"
    options.say(f"rendering {measurements} {with_call} ...", quiet=quiet)
    estimate = _Estimate(n_steps, n_first=len(names))
    with options.progress(todo, length=n_steps, label="rendering", quiet=quiet) as shown:
        for name, index, active in shown:
            text = estimate.after(renderer.words(name, index, active=active).nbytes)
            if text:
                options.say(text, quiet=quiet)


class _Estimate:
    """Estimate of time and memory of a long task from its first steps, reported once."""

    def __init__(self, n_steps: int, *, n_first: int, clock: "Callable[[], float]" = time.monotonic) -> None:
        self._n_steps, self._n_first, self._clock = n_steps, n_first, clock
        self._n_done = self._n_bytes = 0
        self._begun_s, self._is_reported = 0.0, False

    def after(self, n_bytes: int) -> str:
        """Count a step that made some bytes; return a message once if the task is long, otherwise an empty string."""
        self._n_done, self._n_bytes = self._n_done + 1, self._n_bytes + n_bytes
        n_timed, now_s = self._n_done - self._n_first, self._clock()
        if n_timed <= 0:
            self._begun_s = now_s
        if n_timed <= 0 or self._is_reported or now_s - self._begun_s < _TIMED_S:
            return ""
        self._is_reported = True
        left_s = (now_s - self._begun_s) / n_timed * (self._n_steps - self._n_done)
        if left_s < _LONG_S:
            return ""
        left = f"{left_s / 60:.0f} min" if left_s >= 90 else f"{left_s:.0f} s"
        room = size(self._n_bytes / self._n_done * self._n_steps)
        return f"rendering takes about {left} and {room} of memory; a smaller --count takes less"


def _rendered(renderer: "SceneRenderer", names: "Sequence[str]") -> "Given":
    return {name: (renderer.of(name, active=True), renderer.of(name, active=False), renderer.refusal) for name in names}


def _replayed(path: Path, names: "Sequence[str]", stack: ExitStack) -> "Given":
    from ertis_cli._emulation import Replayed
    from ertis_numba.storage import open_recording

    words = {name: Replayed(stack.enter_context(open_recording(path, sensor=name))) for name in names}
    return {name: (each, None, each.refusal) for name, each in words.items()}


def _accepts(refusal: "Refusal", name: str, config: "DeviceConfig") -> bool:
    """Return False, and print the reason, if no measurements exist for a configuration."""
    reason = refusal(name, config)
    if reason:
        options.warn(reason)
    return not reason


def _report_difference(replayed: "Replayed", index: int, active: bool) -> None:  # noqa: FBT001 - a callback
    """Print a warning if the recording has another behaviour than the host has requested."""
    if message := replayed.difference(index, active):
        options.warn(message)


def _get_ready(devices: "Sequence[Emulator]", given: "Given", pulse: int) -> None:
    """Render the measurements of a pulse in advance, also for devices that are about to be armed."""
    from ertis_numba.base.errors import ErtisError

    registers = {device.name: device.registers for device in devices if device.error is None}
    if not any(each.armed for each in registers.values()):
        return
    for name, each in registers.items():
        words, passive, _ = given[name]
        if each.armed or each.n_codes:
            chosen = words if (each.active and each.amplifier) or passive is None else passive
            with suppress(ErtisError):  # the device fails as well, and reports the error
                chosen[pulse % len(chosen)]  # stores the rendered measurement


def _emit_event(name: str, port: str, *, quiet: bool) -> None:
    options.say(f"{name} reconnected: {port}", quiet=quiet)


def _look_after(devices: "Sequence[Emulator]", absences: "list[tuple[float, float]]", ended: threading.Event) -> None:
    """Unplug devices when due, until one fails or the command is asked to end."""
    began_s = time.monotonic()
    while not ended.is_set():
        for device in devices:
            if device.error is not None:
                raise device.error
        due_s = absences[0][0] - (time.monotonic() - began_s) if absences else _POLL_INTERVAL_S
        if due_s <= 0:
            for device in devices:
                device.unplug(for_s=absences[0][1])
            del absences[0]
        else:
            ended.wait(min(due_s, _POLL_INTERVAL_S))
