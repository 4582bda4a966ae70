"""Commands that read hostile files, each in a forked process: ``python -m tests.faults.network.hostile_reads FOLDER``.

The parent has imported all modules. Time and memory of each fork are therefore those of the command alone.
"""

import argparse
import importlib
import json
import os
import resource
import runpy
import signal
import sys
import time
from pathlib import Path
from typing import Any, Final, NamedTuple

from tests.faults.network.hostile_files import HostileFile, hostile_files, write_good

__all__ = ["main"]

_LOADED: Final = (
    "ertis_cli.main", "ertis_cli.verify", "ertis_cli.info", "ertis_cli.process", "ertis_numba.pipeline",
    "ertis_numba.storage", "ertis_numba.analysis.points", "ertis_numba.network.messages", "scipy.signal",
)  # fmt: skip
_MAX_S: Final = 20


class _Read(NamedTuple):
    code: int
    took_s: float
    cpu_s: float
    peak_bytes: int
    stated: str


def main() -> None:
    """Try the files, and print the results as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int)
    given = parser.parse_args()
    for name in _LOADED:
        importlib.import_module(name)
    good = write_good(given.folder / "good.h5")
    _check_valid_file(good, given.folder)
    floor = {
        command: _read(command, given.folder / "nothing.h5", given.folder) for command in ("verify", "info", "process")
    }
    made = list(hostile_files())
    step = 1.0 if given.count is None else max(1.0, len(made) / given.count)
    chosen = [made[int(place * step)] for place in range(int(len(made) / step))]
    reads = [read for each in chosen for read in _reads(each, good, given.folder, floor)]
    print(json.dumps(_summary(chosen, reads)))  # noqa: T201  read by who started it


def _check_valid_file(good: Path, folder: Path) -> None:
    """Check that the commands accept the valid file.

    The check runs in forks, so that lazily imported modules stay out of the parent.
    """
    for command in ("verify", "info"):
        read = _read(command, good, folder)
        if read.code:
            raise SystemExit(f"ertis {command} of the valid file ended with {read.code}: {read.stated}")


def _reads(each: HostileFile, good: Path, folder: Path, floor: dict[str, _Read]) -> list[dict[str, Any]]:
    path = folder / "bad.h5"
    path.unlink(missing_ok=True)
    each.make(good, path)
    found = []
    for command, smallest in floor.items():
        if command in each.harmless_to:
            continue
        read = _read(command, path, folder)
        found.append(
            {
                "name": f"{command}: {each.name}",
                "code": read.code,
                "took_s": max(0.0, read.took_s - smallest.took_s),
                "cpu_s": max(0.0, read.cpu_s - smallest.cpu_s),
                "grew_mb": max(0.0, (read.peak_bytes - smallest.peak_bytes) / 1e6),
                "said": read.stated,
            }
        )
    return found


def _read(command: str, path: Path, folder: Path) -> _Read:
    """Run a command on a file in a forked process."""
    stated, out = folder / "said.txt", folder / "image.h5"
    out.unlink(missing_ok=True)
    arguments = ["ertis", command, str(path), *(["-o", str(out), "--quiet"] if command == "process" else [])]
    begun_s = time.monotonic()
    pid = os.fork()
    if not pid:
        _run_in_this_process(arguments, stated)
    _, status, usage = os.wait4(pid, 0)
    took_s = time.monotonic() - begun_s
    lines = stated.read_text(errors="replace").strip().splitlines()
    traceback = any(line.startswith("Traceback (most") for line in lines)
    last = lines[-1] if lines else ""
    return _Read(
        os.waitstatus_to_exitcode(status),
        took_s,
        usage.ru_utime + usage.ru_stime,
        1024 * usage.ru_maxrss,
        "Traceback: " + last if traceback else last,
    )


def _run_in_this_process(arguments: list[str], stated: Path) -> None:
    """Run a command in this process, and exit."""
    code = 70
    try:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(_MAX_S)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        descriptor = os.open(stated, os.O_CREAT | os.O_TRUNC | os.O_WRONLY, 0o600)
        for stream in (1, 2):
            os.dup2(descriptor, stream)
        sys.argv = arguments
        try:
            runpy.run_module("ertis_cli", run_name="__main__")
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1
        sys.stdout.flush()
        sys.stderr.flush()
    except BaseException:  # noqa: BLE001  nothing may come back from here
        import traceback  # noqa: PLC0415  where something is wrong only

        traceback.print_exc()
        sys.stderr.flush()
        code = 71
    finally:
        os._exit(code)


def _summary(chosen: list[HostileFile], reads: list[dict[str, Any]]) -> dict[str, Any]:
    slowest = max(reads, key=lambda read: read["took_s"])
    largest = max(reads, key=lambda read: read["grew_mb"])
    return {
        "files": len(chosen),
        "reads": len(reads),
        "taken": [read["name"] for read in reads if read["code"] == 0],
        "failed": [f"{read['name']}: {read['said']}" for read in reads if read["said"].startswith("Traceback")],
        "crashes": [f"{read['name']}: {read['code']}" for read in reads if read["code"] < 0],
        "slowest, s": round(slowest["took_s"], 3),
        "slowest": slowest["name"],
        "slowest, s of CPU": round(max(read["cpu_s"] for read in reads), 3),
        "memory grew, MB": round(largest["grew_mb"], 1),
        "largest": largest["name"],
    }


if __name__ == "__main__":
    main()
