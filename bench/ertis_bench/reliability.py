"""What is lost when things go wrong: faults on the wire, pulled plugs, killed processes, full disks."""

import os
import secrets
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ertis_bench import captures, kills, machine, wire_faults
from ertis_numba.constants import ERTIS_PDM_RATE_HZ
from ertis_numba.devices.bits import BitCheck
from ertis_numba.devices.commands import LENGTH_STEP
from ertis_numba.storage import open_recording

__all__ = ["LONG", "ONE_SENSOR", "SHORT", "Extent", "run", "small_disk", "wire"]

_ROOT = Path(__file__).parents[2]
ONE_SENSOR = _ROOT / "data" / "synthetic" / "reflectors.h5"
"""What is captured, where one sensor will do."""

_DISK_MB = 20


@dataclass(frozen=True, slots=True, kw_only=True)
class Extent:
    """How much is tried.

    Attributes
    ----------
    duration_s : float
        Of the sustained capture.
    n_groups : int
        Pulses of the SYNC chain.
    n_blocks : int
        With faults on the wire.
    n_unplugs : int
    n_kills : int
        Of captures, and as many of processes that do nothing but write a journal.
    n_seal_kills : int
    """

    duration_s: float
    n_groups: int
    n_blocks: int
    n_unplugs: int
    n_kills: int
    n_seal_kills: int


SHORT = Extent(duration_s=5.0, n_groups=12, n_blocks=3_000, n_unplugs=1, n_kills=3, n_seal_kills=5)
LONG = Extent(duration_s=600.0, n_groups=1_200, n_blocks=100_000, n_unplugs=20, n_kills=500, n_seal_kills=200)


def run(*, say: Callable[[str], None], long: bool = False, seed: int | None = None) -> dict[str, Any]:
    """Try everything and return the report."""
    extent = LONG if long else SHORT
    seed = secrets.randbits(31) if seed is None else seed
    say(f"seed {seed}")
    report: dict[str, Any] = {"machine": machine.describe(), "seed": seed, "long": long}
    with tempfile.TemporaryDirectory(prefix="ertis-") as place:
        folder = Path(place)
        platform = folder / "platform.toml"
        platform.write_text(captures.platform(4, n_measurements=5).to_toml())
        say(f"capturing at 20 Hz for {extent.duration_s:g} s")
        report["sustained"] = captures.sustained(
            ONE_SENSOR, _new(folder, "sustained"), duration_s=extent.duration_s, rate_hz=20.0
        )
        say(f"{extent.n_groups} pulses to four sensors")
        report["chain"] = captures.chain(platform, _new(folder, "chain"), n_groups=extent.n_groups, rate_hz=10.0)
        say(f"{extent.n_blocks} faulty blocks")
        report["wire"] = wire(extent.n_blocks, seed)
        report["wire_splices"] = wire(extent.n_blocks, seed, splices=True)
        say(f"{extent.n_unplugs} times without its plug")
        report["unplugs"] = captures.unplugs(ONE_SENSOR, _new(folder, "plug"), seed=seed, count=extent.n_unplugs)
        say(f"{extent.n_kills} captures killed")
        report["kills"] = captures.kills(ONE_SENSOR, _new(folder, "kills"), seed=seed, count=extent.n_kills)
        say(f"{extent.n_kills} writers of a journal killed")
        report["journals"] = kills.appending(_new(folder, "journals"), seed=seed, count=extent.n_kills)
        say(f"{extent.n_seal_kills} sealings killed")
        report["seals"] = kills.sealing(_new(folder, "sealing"), seed=seed, count=extent.n_seal_kills)
        say(f"a disk of {_DISK_MB} MB")
        with small_disk(_new(folder, "disk")) as disk:
            report["disk_full"] = None if disk is None else captures.disk_full(ONE_SENSOR, folder, disk)
    return report


def wire(n_blocks: int, seed: int, *, splices: bool = False) -> dict[str, Any]:
    """Send blocks of the least length, with the words of a sensor, over a line with faults."""
    with open_recording(ONE_SENSOR) as recording:
        words = recording[0].words
    check = BitCheck(LENGTH_STEP, ERTIS_PDM_RATE_HZ, splices=splices)
    return asdict(wire_faults.send(n_blocks, seed=seed, n_samples=LENGTH_STEP, words=words, bits=check.check))


@contextmanager
def small_disk(folder: Path) -> Iterator[Path | None]:
    """Yield ``folder`` as a disk of its own in memory, or None where only root may mount one."""
    command = ["mount", "-t", "tmpfs", "-o", f"size={_DISK_MB}m", "ertis", str(folder)]
    try:
        mounted = os.name == "posix" and subprocess.run(command, capture_output=True, check=False).returncode == 0  # noqa: S603
    except FileNotFoundError:
        mounted = False
    try:
        yield folder if mounted else None
    finally:
        if mounted:
            subprocess.run(["umount", str(folder)], check=True)  # noqa: S603, S607


def _new(folder: Path, name: str) -> Path:
    made = folder / name
    made.mkdir()
    return made
