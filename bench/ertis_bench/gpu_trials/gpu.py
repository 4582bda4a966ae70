"""Tests, times, comparisons with other libraries, and ceilings of an NVIDIA GPU, in one run of less than ten minutes.

Each part runs in its own process with its own time limit. A part that fails, hangs or breaks the GPU's context
therefore does not affect the others.
"""

import datetime as dt
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ertis_bench import input_measurements, machine
from ertis_bench.gpu_trials import gpu_tables
from ertis_numba.base.errors import DeviceError

__all__ = [
    "BUDGETS_S",
    "FORMS",
    "REFUSED",
    "FinishedProcess",
    "execute",
    "newest",
    "part",
    "parts",
    "run",
    "sanitized",
    "tested",
]

FORMS = {"gpu": gpu_tables.gpu}
REFUSED = 3
"""Exit code of a process without a GPU. Its output states the reason."""

BUDGETS_S = {
    "machine": 60,
    "tests": 150,
    "memcheck": 60,
    "racecheck": 60,
    "paper": 100,
    "acoustic maps": 60,
    "side by side": 60,
    "ceilings": 40,
}
"""Time limit of each part in seconds. The sum is less than ten minutes."""

_ROOT = Path(__file__).parents[3]
_TESTED = (
    "tests/kernels/test_kernels.py",
    "tests/kernels/test_interpolated_beams.py",
    "tests/kernels/test_phase_shifts.py",
    "tests/kernels/test_beamformers.py",
    "tests/kernels/test_modulator.py",
    "tests/kernels/test_passive_kernels.py",
    "tests/cuda",
)
_SANITIZED_TESTS = (
    "cuda and (demodulate or fold or delay_and_sum or quantise or interpolated or spectra)"  # selects tests by name
)
_SUMMARIES = {
    "memcheck": r"ERROR SUMMARY: (\d+) error",
    "racecheck": r"RACECHECK SUMMARY: (\d+) hazard",
}
_PYTEST = (
    sys.executable,
    "-m",
    "pytest",
    "-q",
    "-p",
    "no:cacheprovider",
    "-p",
    "ertis_bench.gpu_trials.own_kernel_cache",
)
_MAX_WORKERS = 8  # Processes of tests, which mostly compile kernels.
_MAX_REPORTED = 20  # names of failed tests


@dataclass(frozen=True, slots=True)
class FinishedProcess:
    """Result of a process."""

    code: int | None
    text: str

    @property
    def last_line(self) -> str:
        """Last line of the output."""
        return self.text.strip().rpartition("\n")[2][:600]


def run(*, results: Path, say: Callable[[str], None], measure: bool = True) -> dict[str, Any]:
    """Measure, write the results to a new file, and return them."""
    if not measure:
        return newest(results)
    started_s = time.monotonic()
    gpu = part("machine")
    if gpu["status"] != "done":
        raise DeviceError(str(gpu["status"]))
    (found,) = gpu["rows"]
    when = dt.datetime.now(dt.UTC)
    report: dict[str, Any] = {
        "date": when.isoformat(timespec="seconds"),
        "revision": _revision(),
        "gpu": found,
        "machine": machine.describe(),
        "source": input_measurements.measurement()[1],
        "parts": {},
    }
    results.mkdir(parents=True, exist_ok=True)
    target = results / f"{_as_file_name(found['name'])}-{when:%Y%m%dT%H%M%SZ}.json"
    for name, measured in parts().items():
        say(f"{name}: at most {BUDGETS_S[name]} s")
        begin_s = time.monotonic()
        outcome = measured()
        report["parts"][name] = {**outcome, "wall_s": round(time.monotonic() - begin_s, 1)}
        report["wall_s"] = round(time.monotonic() - started_s, 1)
        target.write_text(
            json.dumps(report, indent=1) + "\n", "utf-8"
        )  # Writing after each part keeps results if a later part fails.
        say(f"{name}: {outcome['status']}")
    say(f"{target}: {report['wall_s']:g} s in total")
    return report


def newest(results: Path) -> dict[str, Any]:
    """Return the newest results of a folder, or an empty report if there are none."""
    reports = [json.loads(path.read_text("utf-8")) for path in sorted(results.glob("*.json"))]
    return max(reports, key=lambda report: str(report["date"]), default={})


def parts() -> dict[str, Callable[[], dict[str, Any]]]:
    """Return the parts, the most important first."""
    return {
        "tests": tested,
        "paper": lambda: part("paper"),
        "acoustic maps": lambda: part("acoustic maps"),
        "ceilings": lambda: part("ceilings"),
        "side by side": lambda: part("side by side"),
        "memcheck": lambda: sanitized("memcheck"),
        "racecheck": lambda: sanitized("racecheck"),
    }


def part(name: str) -> dict[str, Any]:
    """Run one part of `gpu_parts` in its own process, and return its rows.

    Rows that were written before a failure are included.
    """
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "rows"
        file.touch()
        done = execute([sys.executable, "-m", "ertis_bench.gpu_trials.gpu_parts", name, str(file)], BUDGETS_S[name])
        lines = file.read_text("utf-8").split("\n")[:-1]  # The last element is empty or truncated.
    status = "done" if done.code == 0 else _failed(name, done)
    return {"status": done.last_line if done.code == REFUSED else status, "rows": [json.loads(line) for line in lines]}


def tested() -> dict[str, Any]:
    """Run the tests of the kernels and of the chain on the GPU."""
    if not (_ROOT / "tests").is_dir():
        return {"status": "not available: the tests are not installed with the package"}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "report.xml"
        workers = ("--numprocesses", str(min(_MAX_WORKERS, max(1, (os.cpu_count() or 1) // 2))))
        done = execute([*_PYTEST, *workers, *_TESTED, "-k", "cuda", f"--junitxml={file}"], BUDGETS_S["tests"])
        if done.code is None or not file.exists():
            return {"status": _failed("tests", done)}
        cases = list(ET.parse(file).getroot().iter("testcase"))  # noqa: S314 - written by pytest just now
    names = {kind: [_name(case) for case in cases if case.find(kind) is not None] for kind in ("failure", "error")}
    bad = [name for found in names.values() for name in found]
    skipped = [_name(case) for case in cases if case.find("skipped") is not None]
    passed = {_name(case) for case in cases} - {*bad, *skipped}
    on_gpu = [name for name in passed if "cuda" in name]
    status = "done" if done.code == 0 and on_gpu else _failed("tests", done)
    return {
        "status": status,
        "passed": len(passed),
        "passed_on_gpu": len(on_gpu),
        "failed": len(bad),
        "skipped": len(skipped),
        "names_failed": bad[:_MAX_REPORTED],
    }


def sanitized(tool: str) -> dict[str, Any]:
    """Run a few tests under NVIDIA's checker of memory accesses or of races in shared memory."""
    sanitizer = _sanitizer()
    if sanitizer is None:
        return {"status": "not available: no compute-sanitizer on PATH or in CUDA_HOME"}
    command = [sanitizer, "--tool", tool, "--error-exitcode", "9", *_PYTEST, *_TESTED[:3], "-k", _SANITIZED_TESTS]
    done = execute(command, BUDGETS_S[tool])
    found = re.search(_SUMMARIES[tool], done.text)
    passed = re.search(r"(\d+) passed", done.text)
    if done.code is None or found is None:
        return {"status": _failed(tool, done)}
    errors, tests = int(found[1]), int(passed[1]) if passed else 0
    good = done.code == 0 and not errors and tests
    return {"status": "done" if good else _failed(tool, done), "errors": errors, "tests_passed": tests}


def _sanitizer() -> str | None:
    homes = [os.environ.get("CUDA_HOME"), os.environ.get("CUDA_PATH"), "/usr/local/cuda"]
    folders = [str(Path(home) / part) for home in homes if home for part in ("bin", "compute-sanitizer")]
    return shutil.which("compute-sanitizer") or shutil.which("compute-sanitizer", path=os.pathsep.join(folders))


def execute(command: Sequence[str], limit_s: float) -> FinishedProcess:
    """Run a command in the repository. After the time limit, kill it with all its children."""
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(
            [*(str(_ROOT / part) for part in (".", "cli", "bench")), *filter(None, sys.path)]
        ),
        "NUMBA_CUDA_LOW_OCCUPANCY_WARNINGS": "0",  # Small images have small grids.
    }
    with subprocess.Popen(  # noqa: S603
        command,
        cwd=_ROOT,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        start_new_session=True,
    ) as process:
        try:
            text, _ = process.communicate(timeout=limit_s)
        except subprocess.TimeoutExpired:
            _end(process)
            return FinishedProcess(None, process.communicate()[0])
        except BaseException:
            _end(process)
            raise
    return FinishedProcess(process.returncode, text)


def _end(process: "subprocess.Popen[str]") -> None:
    with suppress(ProcessLookupError):  # The process may have ended just now.
        os.killpg(process.pid, signal.SIGKILL)


def _failed(name: str, done: FinishedProcess) -> str:
    if done.code is None:
        return f"not finished after {BUDGETS_S[name]} s"
    return f"failed ({done.code}): {done.last_line}"


def _name(case: ET.Element) -> str:
    return f"{case.get('classname')}::{case.get('name')}"


def _revision() -> str:
    """Return the revision of the repository, with a suffix if files differ from it."""
    git = shutil.which("git")
    if git is None:
        return "unknown"
    done = execute([git, "describe", "--always", "--abbrev=12", "--dirty", "--exclude=*"], 20)
    return done.last_line if done.code == 0 else "unknown"


def _as_file_name(name: str) -> str:
    """Return a name in a form that suits file names."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")
