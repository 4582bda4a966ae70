"""Compare the kernels on emulated aarch64 with those on this machine, and run their tests there.

Usage: python -m tests.arm FOLDER. The folder, of 1 GB, is set up on the first run. Nothing is timed, because emulation
says nothing about the speed of a processor.
"""

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import click
import numpy as np

from tests import reference

HERE = Path(__file__).parent
CPUS = ("cortex-a72", "cortex-a76", "cortex-a78ae")
"""Processors of Raspberry Pi 4 and 5, and Jetson Orin."""

TESTS = (
    ("tests/kernels/test_interpolated_beams.py", "cpu and (int16 or equal_their_reference)"),
    ("tests/kernels/test_kernels.py", "cpu and (envelope_int16 or quantise)"),
    ("tests/pipeline/test_pipeline.py", "test_pipeline_image_is_exact and cpu and (default or disabled)"),
)
MAX_DIFFERENCE_DB = -90.0


def main(folder: Path) -> int:
    """Run all checks, print a line for each, and return the exit code."""
    begun_s = time.monotonic()
    code = subprocess.run([HERE / "setup.sh", folder], env=os.environ | {"PYTHON": sys.executable}, check=False)
    if code.returncode:
        return code.returncode
    click.echo(f"set up in {time.monotonic() - begun_s:.0f} s")
    results = [_same_images(folder), *(_long_multiplications(folder, cpu) for cpu in CPUS), _tests(folder)]
    minutes = (time.monotonic() - begun_s) / 60
    click.echo(f"aarch64: {sum(results)} of {len(results)} checks passed in {minutes:.1f} min")
    return 0 if all(results) else 1


def _emulated(folder: Path, arguments: Sequence[str | Path], cpu: str = "cortex-a76") -> subprocess.CompletedProcess:
    environment = os.environ | {"CPU": cpu}
    command = [HERE / "qemu.sh", folder, *arguments]
    return subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=False)


def _reported(name: str, found: str, *, good: bool) -> bool:
    click.echo(f"{'ok  ' if good else 'FAIL'} {name}: {found}")
    return good


def _same_images(folder: Path) -> bool:
    """Compare sums, which must have the same bits, and images of the same plans."""
    paths = {name: folder / f"{name}.npz" for name in ("here", "aarch64")}
    own = [sys.executable, "-m", "tests.arm.images", paths["here"]]
    if subprocess.run(own, check=False).returncode:
        return _reported("images", "failed on this machine", good=False)
    if _emulated(folder, ["-m", "tests.arm.images", paths["aarch64"]]).returncode:
        return _reported("images", "failed on aarch64", good=False)
    here, there = (np.load(path) for path in paths.values())
    results = [_reported("instruction set", str(there["instruction_set"]), good=there["instruction_set"] == "NEON")]
    for name in here:
        if name.startswith("sums"):
            same = here[name].tobytes() == there[name].tobytes()
            results.append(_reported(name, "the same bits" if same else "other bits", good=same))
        elif name != "instruction_set":
            difference_db = reference.error_db(there[name], here[name])
            found = f"image differs by {difference_db:.1f} dB; the limit is {MAX_DIFFERENCE_DB:g} dB"
            results.append(_reported(name, found, good=difference_db <= MAX_DIFFERENCE_DB))
    return all(results)


def _long_multiplications(folder: Path, cpu: str) -> bool:
    """Count instructions in the assembly of a 16-bit kernel."""
    done = _emulated(folder, ["-m", "tests.arm.assembly"], cpu)
    if done.returncode:
        return _reported(cpu, "compilation failed", good=False)
    sums, widened = map(int, done.stdout.split())
    found = f"{sums} smlal and smlal2, {widened} other multiplications of 32 bits"
    return _reported(cpu, found, good=sums > 0 and not widened)


def _tests(folder: Path) -> bool:
    results = []
    for path, names in TESTS:
        options = ["-q", "-p", "no:cacheprovider", "-o", "addopts=", "--timeout", "0"]
        done = _emulated(folder, ["-m", "pytest", *options, path, "-k", names])
        lines = done.stdout.strip().splitlines() or ["no output"]
        if done.returncode:
            click.echo(done.stdout)
        results.append(_reported(path, lines[-1], good=done.returncode == 0))
    return all(results)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]).absolute()))
