"""Captures from emulated sensors with the user's commands, to find losses and their circumstances.

The checks use only data that users see: lines on stdout, exit codes, and measurements that the reader of recordings
returns. The reference is the emulators' log of sent measurements.
"""

import json
import os
import random
import signal
import subprocess
import sys
import time
import zlib
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from ertis_bench.network.processes import ask

from ertis_numba.base.errors import DataError
from ertis_numba.devices.emulator import Emulator, SyncChain
from ertis_numba.simulation import Point, Scene, Sensor
from ertis_numba.storage import open_recording, sensor_names

__all__ = ["chain", "disk_full", "emulated", "kills", "platform", "sent_by_emulators", "sustained", "unplugs"]

_ERTIS = (sys.executable, "-m", "ertis_cli")
_WAIT_S = 120.0  # for any step that must end without help
_CAPTURE_S = 1_800.0  # for the longest capture and its sealing
Line = dict[str, Any]


def platform(n_sensors: int, *, n_measurements: int) -> Scene:
    """Return a scene of sensors that face all directions, with a moving reflector.

    The motion makes all measurements different, so that mix-ups are visible.
    """
    sensors = tuple(Sensor(name=f"sensor-{number + 1}", yaw_deg=-90.0 + 90.0 * number) for number in range(n_sensors))
    reflector = Point(range_m=1.5, velocity_m_s=(2.0, 0.0, 0.0))
    return Scene(sensors=sensors, points=(reflector,), count=n_measurements)


def sustained(source: Path, folder: Path, *, duration_s: float, rate_hz: float) -> Line:
    """Capture from one sensor that pulses trigger, and report losses and processor time."""
    target = folder / "sustained.h5"
    with emulated(source, folder, pulses_hz=rate_hz) as ports:
        lines = _capture(ports, target, "--trigger", "sync", "--duration", f"{duration_s:g}")
    final = lines[-1]
    found = _compare(target, lines[:-1], sent_by_emulators(folder))
    return {
        "seconds": duration_s,
        "rate_hz": rate_hz,
        "stored": final["stored"],
        "lost": final["lost"],
        "wrong": found["wrong"],
        "cpu_percent": 100 * final["cpu_s"] / final["seconds"],
        "megabytes_per_s": final["stored"] * _row_bytes(target) / final["seconds"] / 1e6,
    }


def chain(source: Path, folder: Path, *, n_groups: int, rate_hz: float) -> Line:
    """Capture from several sensors in one SYNC chain, and count complete and mixed groups."""
    target = folder / "chain.h5"
    with emulated(source, folder, pulses_hz=rate_hz) as ports:
        lines = _capture(ports, target, "--trigger", "sync", "-n", str(n_groups))
    sent = sent_by_emulators(folder)
    found = _compare(target, lines[:-1], sent)
    indices: dict[int, list[int]] = defaultdict(list)
    for (sensor, _), (check, sync_count) in found["rows"].items():
        indices[sync_count].append(sent[sensor, check])
    return {
        "sensors": len(ports),
        "rate_hz": rate_hz,
        "groups": len(indices),
        "complete": sum(len(each) == len(ports) for each in indices.values()),
        "mixed": sum(len(set(each)) > 1 for each in indices.values()),
        "lost": lines[-1]["lost"],
        "wrong": found["wrong"],
    }


def unplugs(source: Path, folder: Path, *, seed: int, count: int) -> Line:
    """Unplug a sensor at random times, also during measurements, and report the time until it measures again."""
    random_ = random.Random(seed)
    target = folder / "unplugs.h5"
    plugged_ns = []
    with _emulated_here(source, folder / "emulated", folder / "sent.ndjson", 20.0) as (emulator,):
        command = [*_ERTIS, "capture", "--port", str(emulator.link), "-o", str(target), "--trigger", "sync"]
        with subprocess.Popen([*command, "--json", "--quiet"], stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            came = map(json.loads, process.stdout)
            lines = _until_stored(came)
            for _ in range(count):
                time.sleep(random_.uniform(1.0, 2.0))
                emulator.unplug()
                time.sleep(random_.uniform(0.2, 1.0))
                plugged_ns.append(time.time_ns())
                emulator.replug()
                lines += _until_stored(came, after_ns=plugged_ns[-1])
            process.send_signal(signal.SIGTERM)
            lines += came
    found = _compare(target, lines[:-1], sent_by_emulators(folder))
    back_s = [line["away_s"] for line in lines if line["event"] == "back"]
    stored_ns = [line["timestamp_ns"] for line in lines if line["event"] == "stored"]
    after_s = _waits_s(plugged_ns, stored_ns)
    return {
        "unplugged": count,
        "noticed": min(len(back_s), len(after_s)),
        "wrong": found["wrong"],
        "stored": lines[-1]["stored"],
        "slowest_s": max(after_s, default=0.0),
    }


def _until_stored(came: Iterator[Line], *, after_ns: int = 0) -> list[Line]:
    """Return the lines of a capture up to the first one about a measurement after a time."""
    lines = []
    for line in came:
        lines.append(line)
        if line["event"] == "stored" and line["timestamp_ns"] > after_ns:
            break
    return lines


def _waits_s(plugged_ns: list[int], stored_ns: list[int]) -> list[float]:
    """Return the time from each reconnection to the first measurement after it, if there is one."""
    firsts = ((plugged, min((t for t in stored_ns if t > plugged), default=None)) for plugged in plugged_ns)
    return [(first - plugged) / 1e9 for plugged, first in firsts if first is not None]


def kills(source: Path, folder: Path, *, seed: int, count: int) -> Line:
    """Kill captures at random times, recover their journals, and count reported measurements that are lost."""
    random_ = random.Random(seed)
    reported = lost = wrong = unreadable = 0
    moments: Counter[str] = Counter()
    with emulated(source, folder) as ports:
        for number in range(count):
            target = folder / f"killed-{number}.h5"
            lines = _capture_until_killed(ports, target, after_s=random_.uniform(0.0, 1.2), moments=moments)
            _recover(folder)
            if not target.exists():
                unreadable += bool(lines)
                continue
            try:
                found = _compare(target, lines, sent_by_emulators(folder))
            except DataError:
                unreadable += 1
                continue
            reported += len(lines)
            lost += found["lost"]
            wrong += found["wrong"]
            target.unlink()
    leftovers = [path.name for path in folder.iterdir() if ".part" in path.name or ".journal" in path.name]
    return {
        "kills": count,
        "reported": reported,
        "lost": lost,
        "wrong": wrong,
        "unreadable": unreadable,
        "left over": len(leftovers),
        **{f"killed {moment}": n for moment, n in sorted(moments.items())},
    }


def disk_full(source: Path, folder: Path, disk: Path) -> Line:
    """Capture to a small disk until it is full, and report the command's output and the stored measurements."""
    target = disk / "full.h5"
    with emulated(source, folder) as ports:
        done = ask("capture", *_ports(ports), "-o", str(target), "--rate", "20", "--duration", "60", "--json")
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    stored = [line for line in lines if line["event"] == "stored"]
    ask("import", "journals", str(disk), "--quiet")
    found = _compare(target, stored, sent_by_emulators(folder))
    return {
        "exit code": done.returncode,
        "said": done.stderr.strip().splitlines()[-1].replace(str(disk), "DISK"),
        "reported": len(stored),
        "lost": found["lost"],
        "wrong": found["wrong"],
    }


@contextmanager
def emulated(source: Path, folder: Path, *options: str, pulses_hz: float | None = None) -> Iterator[list[str]]:
    """Yield links to the ports of emulated sensors, which log to ``sent.ndjson``.

    The emulators end with the block. Without options, those of a recording run in this process, which starts faster.
    """
    log = folder / "sent.ndjson"
    log.unlink(missing_ok=True)
    if source.suffix == ".h5" and not options:
        with _emulated_here(source, folder / "emulated", log, pulses_hz) as emulators:
            yield [str(each.link) for each in emulators]
        return
    if pulses_hz is not None:
        options += ("--sync-rate", f"{pulses_hz:g}")
    command = [*_ERTIS, "sensors", "emulate", str(source), "--quiet", "--json", "--log", str(log), *options]
    environment = os.environ | {"ERTIS_EMULATED_DIR": str(folder / "emulated")}
    n_sensors = len(Scene.load(source).sensors) if source.suffix == ".toml" else len(sensor_names(source))
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
        try:
            assert process.stdout is not None
            lines = [process.stdout.readline() for _ in range(n_sensors)]
            if not all(lines):
                raise DataError(
                    f"ertis sensors emulate {source} ended with {process.wait(_WAIT_S)}; see its output above"
                )
            yield [json.loads(line)["link"] for line in lines]
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(_WAIT_S)


@contextmanager
def _emulated_here(source: Path, links: Path, log: Path, pulses_hz: float | None) -> Iterator[list[Emulator]]:
    links.mkdir(exist_ok=True)
    emulators = []
    with ExitStack() as stack:
        file = stack.enter_context(log.open("a", encoding="utf-8"))
        for name in sensor_names(source):
            with open_recording(source, sensor=name) as recording:
                words = [measurement.data for measurement in recording]
            emulators.append(stack.enter_context(Emulator(words, name=name, link=links / name, log=file)))
        if pulses_hz is not None:
            stack.enter_context(SyncChain(emulators, pulses_hz))
        yield emulators


def _ports(ports: list[str]) -> list[str]:
    return [word for port in ports for word in ("--port", port)]


def _capture(ports: list[str], target: Path, *options: str) -> list[Line]:
    """Run a capture until it ends, and return all lines that it printed."""
    done = ask("capture", *_ports(ports), "-o", str(target), "--json", "--quiet", *options, timeout_s=_CAPTURE_S)
    if done.returncode:
        raise DataError(f"ertis capture ended with {done.returncode}: {done.stderr.strip()}")
    return [json.loads(line) for line in done.stdout.splitlines()]


def _capture_until_killed(ports: list[str], target: Path, *, after_s: float, moments: Counter[str]) -> list[Line]:
    """Start a capture, kill it some time after its first line, and return its output.

    A sealing process that the capture has started continues.
    """
    command = [*_ERTIS, "capture", *_ports(ports), "-o", str(target), "--rate", "20", "--json", "--quiet", "-n", "16"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        first = process.stdout.readline()
        time.sleep(after_s)  # The kill comes at a random time.
        ended = process.poll() is not None
        process.kill()
        lines = [json.loads(line) for line in [first, *process.stdout.readlines()] if line.endswith("\n")]
    sealing = target.with_name(f"{target.name}.journal").exists() and len(lines) >= 16
    moments["after the end" if ended else "while it sealed" if sealing else "while it captured"] += 1
    return [line for line in lines if line["event"] == "stored"]


def _recover(folder: Path) -> None:
    """Recover until no journal is left.

    One call may not suffice, because a sealing process can outlive its capture and hold a journal.
    """
    end_s = time.monotonic() + _WAIT_S
    while list(folder.glob("*.journal")) and time.monotonic() < end_s:
        ask("import", "journals", str(folder), "--quiet")


def sent_by_emulators(folder: Path) -> dict[tuple[str, int], int]:
    """Return the number of words by sensor and CRC-32, for measurements that an emulator sent without faults."""
    entries = [json.loads(line) for line in (folder / "sent.ndjson").read_text().splitlines() if line.endswith("}")]
    return {(each["name"], each["crc32"]): each["index"] for each in entries if "crc32" in each}


def _compare(target: Path, reported: list[Line], sent: dict[tuple[str, int], int]) -> Line:
    """Read a recording and compare it with the reported and the sent measurements.

    Returns
    -------
    dict
        ``rows``, CRC-32 and SYNC count by (sensor, sequence). ``lost``, number of reported measurements that are
        missing. ``wrong``, number of stored measurements that differ from the report or were never sent.
    """
    rows: dict[tuple[str, int], tuple[int, int]] = {}
    for sensor in sensor_names(target):
        with open_recording(target, sensor=sensor) as recording:
            for measurement in recording:
                stamp = measurement.stamp
                rows[sensor, stamp.sequence] = zlib.crc32(measurement.data.data), stamp.sync_count
    stored = [line for line in reported if line["event"] == "stored"]
    keys = [(line["sensor"], line["sequence"]) for line in stored]
    return {
        "rows": rows,
        "lost": sum(key not in rows for key in keys),
        "wrong": sum(key in rows and rows[key][0] != line["crc32"] for key, line in zip(keys, stored, strict=True))
        + sum((sensor, check) not in sent for (sensor, _), (check, _) in rows.items())
        + (len(keys) - len(set(keys))),
    }


def _row_bytes(target: Path) -> int:
    with open_recording(target, sensor=sensor_names(target)[0]) as recording:
        return int(recording[0].data.nbytes)
