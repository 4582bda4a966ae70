"""Losses of captures under wire faults, unplugged sensors, killed processes and full disks."""

import os
import subprocess
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from ertis_numba.base.constants import ERTIS_PDM_RATE_HZ
from ertis_numba.devices.bits import BitCheck
from ertis_numba.devices.commands import LENGTH_STEP
from ertis_numba.storage import open_recording
from tests.faults import captures, kills, powercuts, signals, wire_faults
from tests.faults.flips import flips
from tests.faults.trials import Parts, try_parts

__all__ = ["LONG", "ONE_SENSOR", "PARTS", "SHORT", "TrialCounts", "run", "small_disk", "wire"]

_ROOT = Path(__file__).parents[2]
ONE_SENSOR = _ROOT / "data" / "synthetic" / "reflectors.h5"
"""Recording from which a single sensor is emulated."""

_DISK_MB = 20


@dataclass(frozen=True, slots=True, kw_only=True)
class TrialCounts:
    """Extent of the trials.

    Attributes
    ----------
    duration_s : float
        Duration of the sustained capture.
    n_groups : int
        Pulses of the SYNC chain.
    n_blocks : int
        Blocks on a line with faults.
    n_unplugs : int
    n_kills : int
        Killed captures, and the same number of killed processes that only write a journal.
    n_seal_kills : int
    n_signals : int
        Signals to each command.
    n_power_cuts : int
        States of a disk after a power cut.
    n_flips : int
        Damaged files.
    """

    duration_s: float
    n_groups: int
    n_blocks: int
    n_unplugs: int
    n_kills: int
    n_seal_kills: int
    n_signals: int
    n_power_cuts: int
    n_flips: int


SHORT = TrialCounts(
    duration_s=3.0,
    n_groups=12,
    n_blocks=800,
    n_unplugs=1,
    n_kills=2,
    n_seal_kills=5,
    n_signals=2,
    n_power_cuts=40,
    n_flips=12,
)
LONG = TrialCounts(
    duration_s=600.0,
    n_groups=1_200,
    n_blocks=100_000,
    n_unplugs=20,
    n_kills=500,
    n_seal_kills=200,
    n_signals=200,
    n_power_cuts=1_500,
    n_flips=2_000,
)


def run(
    *, say: Callable[[str], None], fraction: float = 0.0, seed: int | None = None, only: Sequence[str] = ()
) -> dict[str, Any]:
    """Run all trials, or only some of `PARTS`, to a fraction of the long form, and return the report."""
    return try_parts(PARTS, SHORT, LONG, say=say, fraction=fraction, seed=seed, only=only)


def _chain(extent: TrialCounts, folder: Path, _: int) -> dict[str, Any]:
    platform = folder / "platform.toml"
    platform.write_text(captures.platform(4, n_measurements=5).to_toml())
    return captures.chain(platform, folder, n_groups=extent.n_groups, rate_hz=10.0)


def _disk_full(_: TrialCounts, folder: Path, __: int) -> dict[str, Any] | None:
    disk = folder / "disk"
    disk.mkdir()
    with small_disk(disk) as mounted:
        return None if mounted is None else captures.disk_full(ONE_SENSOR, folder, mounted)


def wire(n_blocks: int, seed: int, *, splices: bool = False) -> dict[str, Any]:
    """Send the shortest blocks with the words of a sensor over a line with faults."""
    with open_recording(ONE_SENSOR) as recording:
        words = recording[0].data
    check = BitCheck(LENGTH_STEP, ERTIS_PDM_RATE_HZ, splices=splices)
    found = wire_faults.send(n_blocks, seed=seed, n_samples=LENGTH_STEP, words=words, bits=check.check)
    # asdict would turn the keys of a Counter into pairs.
    values = {each.name: getattr(found, each.name) for each in fields(found)}
    return {name: dict(value) if isinstance(value, Counter) else value for name, value in values.items()}


@contextmanager
def small_disk(folder: Path) -> Iterator[Path | None]:
    """Yield ``folder`` with a small disk in memory mounted, or None if only root may mount one."""
    command = ["mount", "-t", "tmpfs", "-o", f"size={_DISK_MB}m", "ertis", str(folder)]
    try:
        mounted = os.name == "posix" and subprocess.run(command, capture_output=True, check=False).returncode == 0
    except FileNotFoundError:
        mounted = False
    try:
        yield folder if mounted else None
    finally:
        if mounted:
            subprocess.run(["umount", str(folder)], check=True)


PARTS: Parts[TrialCounts] = {
    "sustained": (
        "capture at 20 Hz for {duration_s:g} s",
        lambda extent, folder, _: captures.sustained(ONE_SENSOR, folder, duration_s=extent.duration_s, rate_hz=20.0),
    ),
    "chain": ("{n_groups} pulses to four sensors", _chain),
    "wire": ("{n_blocks} blocks over a line with faults", lambda extent, _, seed: wire(extent.n_blocks, seed)),
    "splices": (
        "{n_blocks} blocks again, with a check for splices",
        lambda extent, _, seed: wire(extent.n_blocks, seed, splices=True),
    ),
    "unplugs": (
        "{n_unplugs} unplugged sensors",
        lambda extent, folder, seed: captures.unplugs(ONE_SENSOR, folder, seed=seed, count=extent.n_unplugs),
    ),
    "kills": (
        "{n_kills} captures killed",
        lambda extent, folder, seed: captures.kills(ONE_SENSOR, folder, seed=seed, count=extent.n_kills),
    ),
    "journals": (
        "{n_kills} writers of a journal killed",
        lambda extent, folder, seed: kills.appending(folder, seed=seed, count=extent.n_kills),
    ),
    "seals": (
        "{n_seal_kills} sealings killed",
        lambda extent, folder, seed: kills.sealing(folder, seed=seed, count=extent.n_seal_kills),
    ),
    "flips": (
        "{n_flips} damaged files",
        lambda extent, folder, seed: flips(folder, seed=seed, count=extent.n_flips),
    ),
    "disk_full": ("small disk", _disk_full),
    "signals": (
        "{n_signals} signals to each command",
        lambda extent, folder, seed: signals.send(folder, ONE_SENSOR, seed=seed, count=extent.n_signals),
    ),
    "power_cuts": (
        "{n_power_cuts} power cuts",
        lambda extent, folder, seed: powercuts.try_cuts(
            folder, seed=seed, count=extent.n_power_cuts, only=("capture", "journal")
        ),
    ),
}
"""Trials by name, each with its progress message and its function."""
