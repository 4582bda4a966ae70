"""Trials of network faults and their consequences.

The faults are killed nodes, bad disks, lost messages, hostile peers and overload.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.faults import powercuts
from tests.faults.network import hostile, hosts, keys, kills, links, load, peers, processing, wire
from tests.faults.reliability import small_disk
from tests.faults.trials import Parts, try_parts

__all__ = ["LONG", "PARTS", "SHORT", "NetworkFaultCounts", "run"]


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkFaultCounts:
    """Extent of the trials.

    Attributes
    ----------
    n_kills : int
        Kills of central nodes, and the same number of kills of sensor nodes.
    rate_hz : float
        Rate of each sensor whose central node is killed.
    n_seal_kills, n_worker_kills : int
        Kills of sealing processes, and of workers.
    away_s : float
        Time without a central node.
    meddled_s, cable_s : float
        Time with lost messages, and with lost packets.
    n_captures : int
        Kills during captures from emulated sensors.
    n_hostile, n_fuzzed : int
        Numbers of hostile connections and of malformed messages.
    n_hellos, n_files : int
        Maximum numbers of hostile hello messages and of hostile files. Fewer are tried if fewer exist.
    overload_s, slow_s : float
        Time with overload, and time with slow applications.
    n_pulses : int
        Pulses of a SYNC chain.
    n_power_cuts : int
        States of a disk after a power cut.
    n_flips : int
        Bits flipped in encrypted messages.
    n_gone : int
        Sensor nodes killed while the central node is behind with reading.
    """

    n_kills: int
    rate_hz: float
    n_seal_kills: int
    n_worker_kills: int
    away_s: float
    meddled_s: float
    cable_s: float
    n_captures: int
    n_hostile: int
    n_fuzzed: int
    n_hellos: int
    n_files: int
    overload_s: float
    slow_s: float
    n_pulses: int
    n_power_cuts: int
    n_flips: int
    n_gone: int


SHORT = NetworkFaultCounts(
    n_kills=20, rate_hz=40.0, n_seal_kills=3, n_worker_kills=10, away_s=2.0, meddled_s=3.0, cable_s=6.0, n_captures=2,
    n_hostile=200, n_fuzzed=10_000, n_hellos=60, n_files=60, overload_s=3.0, slow_s=8.0, n_pulses=40, n_power_cuts=60,
    n_flips=16, n_gone=3,
)  # fmt: skip
LONG = NetworkFaultCounts(
    n_kills=1_000, rate_hz=10.0, n_seal_kills=200, n_worker_kills=500, away_s=30.0, meddled_s=120.0, cable_s=120.0,
    n_captures=50, n_hostile=1_000, n_fuzzed=1_000_000, n_hellos=1_000, n_files=1_000, overload_s=600.0,
    slow_s=240.0, n_pulses=400, n_power_cuts=4_500, n_flips=1_000, n_gone=200,
)  # fmt: skip


def run(
    *, say: Callable[[str], None], fraction: float = 0.0, seed: int | None = None, only: Sequence[str] = ()
) -> dict[str, Any]:
    """Run all trials, or only some of `PARTS`, to a fraction of the long form, and return the report."""
    return try_parts(PARTS, SHORT, LONG, say=say, fraction=fraction, seed=seed, only=only)


def _disk_full(_: NetworkFaultCounts, folder: Path, seed: int) -> dict[str, Any] | None:
    disk = folder / "disk"
    disk.mkdir()
    with small_disk(disk) as mounted:
        return None if mounted is None else links.disk_full(folder, mounted, seed=seed)


PARTS: Parts[NetworkFaultCounts] = {
    "centrals": (
        "{n_kills} central nodes killed",
        lambda extent, folder, seed: kills.centrals(folder, seed=seed, count=extent.n_kills, rate_hz=extent.rate_hz),
    ),
    "nodes": (
        "{n_kills} sensor nodes killed",
        lambda extent, folder, seed: kills.nodes(folder, seed=seed, count=extent.n_kills),
    ),
    "captures": (
        "{n_captures} captures and central nodes killed",
        lambda extent, folder, seed: hosts.captures(folder, seed=seed, count=extent.n_captures),
    ),
    "sealings": (
        "{n_seal_kills} sealings killed",
        lambda extent, folder, seed: kills.sealings(folder, seed=seed, count=extent.n_seal_kills),
    ),
    "workers": (
        "{n_worker_kills} workers killed",
        lambda extent, folder, seed: processing.workers(folder, seed=seed, count=extent.n_worker_kills),
    ),
    "disk_full": ("small disk", _disk_full),
    "disk_fails": (
        "failing disk",
        lambda _, folder, seed: links.disk_fails(folder, seed=seed),
    ),
    "away": (
        "{away_s:g} s without the central node",
        lambda extent, folder, seed: links.away(folder, seed=seed, away_s=extent.away_s, how="killed"),
    ),
    "stopped": (
        "{away_s:g} s with a stopped central node",
        lambda extent, folder, seed: links.away(folder, seed=seed, away_s=extent.away_s, how="stopped"),
    ),
    "meddled": (
        "{meddled_s:g} s of lost, repeated and late acks",
        lambda extent, folder, seed: links.meddled(folder, seed=seed, duration_s=extent.meddled_s),
    ),
    "hosts": (
        "{cable_s:g} s over a bad cable between two hosts",
        lambda extent, folder, seed: hosts.hosts(folder, seed=seed, duration_s=extent.cable_s),
    ),
    "hostile": (
        "{n_hostile} hostile connections",
        lambda extent, folder, seed: peers.hostile(folder, seed=seed, count=extent.n_hostile),
    ),
    "keys": ("invalid keys and roles", lambda _, folder, seed: keys.keys(folder, seed=seed)),
    "fuzzed": (
        "{n_fuzzed} malformed messages",
        lambda extent, folder, seed: peers.fuzzed(folder, seed=seed, count=extent.n_fuzzed),
    ),
    "hellos": (
        "hostile hellos",
        lambda extent, folder, seed: hostile.hellos(folder, seed=seed, count=extent.n_hellos),
    ),
    "files": (
        "hostile files",
        lambda extent, folder, _: hostile.files(folder, count=extent.n_files),
    ),
    "flips": (
        "{n_flips} bits flipped in encrypted messages",
        lambda extent, folder, seed: wire.flips(folder, seed=seed, count=extent.n_flips),
    ),
    "gone": (
        "{n_gone} sensor nodes killed while the central node is behind",
        lambda extent, folder, seed: wire.gone(folder, seed=seed, count=extent.n_gone),
    ),
    "overload": (
        "{overload_s:g} s at twice the capacity",
        lambda extent, folder, seed: load.overload(folder, seed=seed, duration_s=extent.overload_s),
    ),
    "subscribers": (
        "{slow_s:g} s with slow and dead applications",
        lambda extent, folder, seed: load.subscribers(folder, seed=seed, duration_s=extent.slow_s),
    ),
    "groups": (
        "{n_pulses} pulses with lost and double SYNC, and with a wrong clock",
        lambda extent, folder, seed: processing.groups(folder, seed=seed, count=extent.n_pulses),
    ),
    "power_cuts": (
        "{n_power_cuts} power cuts",
        lambda extent, folder, seed: powercuts.try_cuts(
            folder, seed=seed, count=extent.n_power_cuts, only=("record", "serve", "spool")
        ),
    ),
}
"""Trials by name, each with its progress message and its function."""
