"""End-to-end trials: emulated sensors with captures that are killed, and two hosts with a bad cable."""

import random
import secrets
import signal
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

from ertis_bench.network.processes import ERTIS, JsonLinesProcess, survivors, until
from ertis_bench.network.sender import SenderJob
from ertis_bench.network.sent import read_diaries
from ertis_bench.network_trials.oracle import judged, read_folder, tracebacks

from ertis_numba.network.allow_list import AllowList, Permission
from ertis_numba.network.keys import KeyPair
from tests.faults.captures import emulated, sent_by_emulators
from tests.faults.network.cable import Weather, cable
from tests.faults.network.kills import RestartedRecorder
from tests.faults.reliability import ONE_SENSOR

__all__ = ["captures", "hosts"]

_PORT: Final = 5601
_WEATHER: Final = Weather(lose=0.01, repeat=0.01, late=0.02, delay_s=0.005)
Found = dict[str, Any]


def captures(folder: Path, *, seed: int, count: int) -> Found:
    """Kill captures of emulated sensors, and the central node to which they send. All run as users run them.

    The emulators' log is the reference. Measurements that captures report as kept must be stored.
    """
    rng = random.Random(seed)
    record = RestartedRecorder(folder)
    spool = folder / "spool"
    kept: dict[tuple[str, int, int], int] = {}
    mark = secrets.token_hex(8)
    with emulated(ONE_SENSOR, folder, "--sync-rate", "20") as ports, ExitStack() as stack:
        options = ["--to", record.address, "--spool", str(spool), "--trigger", "sync", "--json", "--quiet"]
        command = [*ERTIS, "capture", *(word for port in ports for word in ("--port", port)), *options]
        node = stack.enter_context(record.start())
        for number in range(count + 1):
            last = number == count
            if not node.running:
                node = stack.enter_context(record.start())
            with JsonLinesProcess(
                [*command, *(["-n", "10"] if last else [])], stated=folder / "capture.txt", mark=mark
            ) as capture:
                capture.wait_for("kept")
                time.sleep(rng.uniform(0.0, 1.0))
                if last:
                    node.wait_for("listening")
                    capture.wait(timeout_s=120.0)
                elif rng.random() < 0.5:
                    node.kill()
                    time.sleep(rng.uniform(0.0, 0.5))
                capture.kill()
            kept |= {
                (each["sensor"], each["session_id"], each["sequence"]): each["crc32"]
                for each in capture.events
                if each.get("event") == "kept"
            }
        node.stop()
        ended = record.finish([])
        sent = sent_by_emulators(folder)
    rows = read_folder(record.archive)
    return (
        {
            "kills": count,
            "kept": len(kept),
            "stored": len(rows.rows),
            "lost": sum(key not in rows.rows for key in kept),
            "wrong": sum(rows.rows[key][0].crc32 != check for key, check in kept.items() if key in rows.rows)
            + sum((key.sensor, row.crc32) not in sent for key, each in rows.rows.items() for row in each),
            "twice": sum(len(each) > 1 for each in rows.rows.values()),
            "broken": len(rows.broken),
            "left_over": len(rows.left_over),
            "in_spool": len(list(spool.iterdir())),
            "tracebacks": tracebacks(folder),
        }
        | ended
        | {"orphans": len(survivors(mark))}
    )


def hosts(folder: Path, *, seed: int, duration_s: float) -> Found | None:
    """Send from one host to another over a cable that loses, repeats and delays packets, and is unplugged.

    Returns
    -------
    dict or None
        Results, or None if this user may not create hosts.
    """
    archive, diary, allowed = folder / "recordings", folder / "sender.ndjson", folder / "allow.toml"
    archive.mkdir()
    pairs = {name: KeyPair.new(name) for name in ("central", "front")}
    secret = {name: str(pair.save(folder / "keys")[0]) for name, pair in pairs.items()}
    permission = Permission(name="front", public=pairs["front"].public, role="sensor", serials=("front",))
    AllowList(keys=(permission,)).save(allowed)
    with cable(seed=seed) as made, ExitStack() as stack:
        if made is None:
            return None
        address = f"tcp://{made.addresses[1]}:{_PORT}"
        options = ["--listen", address, "-o", str(archive), "--key", secret["central"], "--allow", str(allowed)]
        command = made.inside(1, [*ERTIS, "record", *options, "--json", "--quiet"])
        node = stack.enter_context(JsonLinesProcess(command, stated=folder / "central.txt"))
        node.wait_for("listening")
        job = SenderJob(
            address=address, diary=str(diary), rate_hz=20.0, seed=seed, keys=(secret["front"], pairs["central"].public)
        )
        job = job.replace(ring_bytes=500_000_000, patience_s=120.0)
        sender = stack.enter_context(JsonLinesProcess(made.inside(0, job.command()), stated=folder / "sender.txt"))
        until(lambda: diary.exists() and bool(read_diaries([diary]).acked()))
        end_s, cuts, back_s = time.monotonic() + duration_s, 0, 0.0
        while time.monotonic() < end_s:
            made.weather = _WEATHER
            time.sleep(duration_s / 6)
            made.plugged, cuts = False, cuts + 1
            time.sleep(min(30.0, duration_s / 3))
            acked, plugged_s = len(read_diaries([diary]).acked()), time.monotonic()
            made.plugged = True
            until(lambda acked=acked: len(read_diaries([diary]).acked()) > acked)  # type: ignore[misc]
            back_s = max(back_s, time.monotonic() - plugged_s)
        sender.signal(signal.SIGTERM)
        flushed = sender.wait_for("sent", timeout_s=180.0)["flushed"]
        node.stop()
        packets = {"packets": made.carried, "packets lost": made.lost}
    return (
        {"cuts": cuts, "flushed": flushed, "slowest back, s": round(back_s, 2)}
        | packets
        | judged(folder, archive, [diary])
    )
