"""Signals at random times of every command. Each command must end soon, with its documented exit code and no traceback.

Commands run as real processes. The time of a signal is uniformly distributed between the first line of the command and
the end of an undisturbed run. Before that line Python itself starts, and handles signals with its own defaults.
"""

import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from ertis_numba.journal import SUFFIX, Journal, JournalEntry
from ertis_numba.pipeline import Pipeline
from ertis_numba.storage import open_recording, write_energyscapes, write_recording
from tests.faults import captures

__all__ = ["COMMANDS", "MAX_END_S", "send"]

MAX_END_S: Final = 1.0
"""Longest permitted time from a signal to the end of the process, in seconds."""

_SCENE = Path(__file__).parents[2] / "data" / "synthetic" / "scenes" / "two_facing_sensors.toml"
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_STARTS = 5
_MAX_TRIES = 10  # Tries per signal. Only signals that reach a running process count.
_UNDISTURBED_S = 4.0
_TIMEOUT_S = 120.0
_FAULTS = ("late", "codes", "tracebacks")
_WAITING_S: Final = {"sensors configure": 2.5, "sensors status": 2.5}
"""Time in which a command waits for an answer; it fails some time later without one."""
_UNCAUGHT = re.compile(r"Traceback|Error:|Exception|Fatal|Assertion")

COMMANDS: Final[dict[str, Sequence[str]]] = {
    "acoustic": ("{recording}", "-o", "{out}/sound.h5"),
    "bench": ("scaling", "--count", "1", "--quiet"),
    "capture": ("--port", "{port}", "-o", "{out}/captured.h5"),
    "compare": ("{images}",),
    "demo": ("-o", "{out}/demo"),
    "doctor": (),
    "example": ("reflectors", "-o", "{out}", "--force"),
    "export": ("{images}", "-o", "{out}/cloud.ply"),
    "fuse": ("{pair}", "-o", "{out}/fused.h5"),
    "import journals": ("{out}/crashed",),
    "import poses": ("{recording}", "{trajectory}", "-o", "{out}/posed.h5", "--force"),
    "import signals": ("{raw}", "-o", "{out}/imported.h5", "--layout", "eRTIS_v3D1", "--preset", "default_25_50"),
    "info": ("--health", "{recording}"),
    "keys": ("new", "fresh", "--dir", "{out}/keys"),
    "listen": ("tcp://127.0.0.1:1",),
    "map": ("{recording}", "--poses", "{trajectory}", "--mounting", "{mounting}", "-o", "{out}/place.pgm"),
    "odometry": ("{drive}", "-o", "{out}/path.tum"),
    "peaks": ("{images}",),
    "plot": ("{recording}", "-o", "{out}/picture.png"),
    "process": ("{recording}", "-o", "{out}/images.h5"),
    "record": ("--listen", "tcp://127.0.0.1:0", "-o", "{out}/recordings"),
    "reference completion": ("bash",),
    "reference layouts": ("eRTIS_v3D1",),
    "reference presets": ("2d_181_5m",),
    "reference settings": ("scene",),
    "ros": ("{recording}", "--duration", "2"),
    "sensors calibrate": ("{recording}",),
    "sensors check": ("{recording}", "--report", "{out}/report.html"),
    "sensors configure": ("tcp://127.0.0.1:1", "front", "--preset", "short_25_50"),
    "sensors emulate": ("{recording}",),
    "sensors list": (),
    "sensors reset": ("--port", "{port}", "--hook", "true"),
    "sensors rtisdev": ("{script}",),
    "sensors send": ("--port", "{port}", "!Y,0,0,0"),
    "sensors status": ("tcp://127.0.0.1:1",),
    "serve": ("--listen", "tcp://127.0.0.1:0", "--publish", "tcp://127.0.0.1:0", "--record", "{out}/recordings"),
    "simulate": ("{scene}", "-o", "{out}/simulated.h5"),
    "verify": ("{recording}",),
    "view": ("{recording}", "--port", "0", "--no-open"),
}
"""Arguments of each command. A test compares the names with those of the command line."""


def send(folder: Path, source: Path, *, seed: int, count: int, only: Sequence[str] = ()) -> dict[str, Any]:
    """Send ``count`` signals to each command, or to some of them only.

    Returns
    -------
    dict
        Over all commands: ``signals``; ``late``, signals after which the process took longer than `MAX_END_S`;
        ``codes``, signals after which the exit code was not the documented one; and ``tracebacks``. ``slowest_s`` is
        the longest time, and ``slowest`` its command. ``by_command`` has the same counts per command, with examples.
    """
    rng = random.Random(seed)
    found: dict[str, dict[str, Any]] = {}
    commands = only or tuple(COMMANDS)
    begins_s = _interpreter_s()
    with ExitStack() as stack:
        stack.enter_context(_default_signals())
        paths = _files(folder, source)
        if any("{port}" in COMMANDS[command] for command in commands):
            paths["port"] = stack.enter_context(captures.emulated(source, folder))[0]
        for command in commands:
            found[command] = _to_command(command, paths, folder / "out", rng, count, begins_s)
    slowest = max(found, key=lambda command: float(found[command]["slowest_s"]))
    total = {name: sum(each[name] for each in found.values()) for name in ("signals", *_FAULTS)}
    return {
        "commands": len(found),
        **total,
        "slowest": slowest,
        "slowest_s": found[slowest]["slowest_s"],
        "by_command": found,
    }


@contextmanager
def _default_signals() -> Iterator[None]:
    """Restore default signal handling for new processes.

    A script or ``nohup`` that has started this process may ignore signals, and children inherit this.
    """
    ignored = [number for number in _SIGNALS if signal.getsignal(number) is signal.SIG_IGN]
    for number in ignored:
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    try:
        yield
    finally:
        for number in ignored:
            signal.signal(number, signal.SIG_IGN)


def _files(folder: Path, source: Path) -> dict[str, str]:
    """Create the files that commands read, and return the names by which `COMMANDS` refers to them."""
    raw, images, crashed = folder / "raw.bin", folder / "images.h5", folder / "crashed"
    script, trajectory, drive = folder / "script.py", folder / "trajectory.tum", folder / "drive.h5"
    mounting, pair = folder / "mounting.toml", folder / "pair.h5"
    script.write_text("import rtisdev\nrtisdev.open_connection('/dev/no-such-port', allowDebugMode=True)\n")
    with open_recording(source) as recording:
        measurement = recording[0]
        mounting.write_text(f'[[sensors]]\nname = "{recording.sensor}"\nposition_m = [0.0, 0.0, 0.0]\n')
        ahead = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        later = replace(measurement.stamp, timestamp_ns=measurement.stamp.timestamp_ns + 10**8)
        write_recording(
            drive,
            [measurement, replace(measurement, stamp=replace(later, sequence=1, sync_count=1))],
            mounting={later.sensor: ahead},
        )
        other = replace(measurement, stamp=replace(measurement.stamp, sensor="other"))
        write_recording(pair, [measurement, other], mounting={later.sensor: ahead, "other": ahead})
        raw.write_bytes(measurement.data.tobytes())
        times_s = [stamp.timestamp_ns // 10**9 + later for stamp in recording.stamps() for later in (0, 1)]
        trajectory.write_text("".join(f"{time_s} 0 0 0 0 0 0 1\n" for time_s in sorted({*times_s})))
        made = folder / "journal"
        made.mkdir()
        with Journal.create(made / f"rec.h5{SUFFIX}", target="rec.h5", source="signals") as journal:
            journal.add_sensor(measurement.stamp.sensor, measurement.settings)
            journal.append([JournalEntry(measurement, monotonic_ns=0)])
            shutil.copytree(made, crashed)  # The copy equals the files of a killed process.
        with Pipeline(measurement.settings) as pipeline:
            write_energyscapes(images, [pipeline.process(measurement)], recording=recording)
    return {
        "recording": str(source),
        "drive": str(drive),
        "pair": str(pair),
        "scene": str(_SCENE),
        "raw": str(raw),
        "images": str(images),
        "crashed": str(crashed),
        "script": str(script),
        "trajectory": str(trajectory),
        "mounting": str(mounting),
    }


def _to_command(
    command: str, paths: dict[str, str], out: Path, rng: random.Random, count: int, begins_s: float
) -> dict[str, Any]:
    lasts_s, killed_s, code, errors = _run_command(command, paths, out, None, _UNDISTURBED_S)
    if not killed_s and code and command not in _WAITING_S:
        raise RuntimeError(f"'ertis {command}' fails by itself, so that no signal can interrupt it: {errors.strip()}")
    lasts_s = min(lasts_s, _WAITING_S.get(command, lasts_s))
    found: dict[str, Any] = {"signals": 0, **dict.fromkeys(_FAULTS, 0), "slowest_s": 0.0}
    examples: Counter[str] = Counter()
    for _ in range(_MAX_TRIES * count):
        if found["signals"] == count:
            break
        number = rng.choice(_SIGNALS)
        at_s = rng.uniform(begins_s, max(lasts_s, begins_s))
        _, took_s, code, errors = _run_command(command, paths, out, number, at_s)
        if not took_s or _in_interpreter(errors):
            continue
        found["signals"] += 1
        documented = {128 + number, -number, 0}
        faults = {
            "late": took_s > MAX_END_S,
            "codes": code not in documented,
            "tracebacks": _UNCAUGHT.search(errors) is not None,
        }
        for name, is_so in faults.items():
            found[name] += is_so
        if any(faults.values()):
            examples[f"{number.name} after {at_s:.2f} s: {took_s:.2f} s, {code}: {errors.strip()[-300:]}"] += 1
        found["slowest_s"] = max(found["slowest_s"], took_s)
    found["slowest_s"] = round(found["slowest_s"], 3)
    return found | ({"examples": list(examples)[:5]} if examples else {})


def _in_interpreter(errors: str) -> bool:
    """Return True if a signal arrived before Python ran the first line of the command.

    Python may take longer to start than `_interpreter_s` measures. Its traceback then has no frame in this package.
    """
    return "Traceback" in errors and "ertis_cli" not in errors


def _interpreter_s() -> float:
    """Return the longest time that Python takes to start and to find a module, in a few runs."""

    def once() -> float:
        begin_s = time.monotonic()
        subprocess.run([sys.executable, "-m", "this"], stdout=subprocess.DEVNULL, check=True)
        return time.monotonic() - begin_s

    return max(once() for _ in range(_STARTS))


def _run_command(
    command: str, paths: dict[str, str], out: Path, number: signal.Signals | None, at_s: float
) -> tuple[float, float, int, str]:
    """Run a command, send a signal at a time, and return its duration, the time to its end, its exit code and stderr.

    Without a signal the process is killed at that time, if it is still running.
    """
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(paths["crashed"], out / "crashed")
    arguments = [each.format(out=out, **paths) for each in COMMANDS[command]]
    begin_s = time.monotonic()
    with subprocess.Popen(
        [sys.executable, "-m", "ertis_cli", *command.split(), *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            _, errors = process.communicate(timeout=at_s)
            return time.monotonic() - begin_s, 0.0, process.returncode, errors
        except subprocess.TimeoutExpired:
            pass
        sent_s = time.monotonic()
        process.send_signal(number or signal.SIGKILL)
        try:
            process.wait(_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
        ended_s = time.monotonic()
        _, errors = process.communicate()
        return ended_s - begin_s, ended_s - sent_s, process.returncode, errors
