"""Faults of a network and their consequences: killed nodes, bad disks, lost messages, hostile peers, overload."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ertis_bench import powercuts
from ertis_bench.network import (
    faults_hosts,
    faults_keys,
    faults_kills,
    faults_links,
    faults_load,
    faults_peers,
    faults_processing,
    faults_wire,
    hostile,
)
from ertis_bench.reliability import small_disk
from ertis_bench.trials import Parts, try_parts

__all__ = ["LONG", "PARTS", "SHORT", "NetworkFaultCounts", "run"]


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkFaultCounts:
    """Numbers of trials.

    Attributes
    ----------
    n_kills : int
        Of central nodes, and as many of sensor nodes.
    rate_hz : float
        Of each sensor whose central node is killed.
    n_seal_kills, n_worker_kills : int
    away_s : float
        How long a central node is away.
    meddled_s, cable_s : float
        How long messages are lost, and packets.
    n_captures : int
        Kills while emulated sensors are captured from.
    n_hostile, n_fuzzed : int
        Connections and messages.
    n_hellos, n_files : int
        Hostile hellos, and hostile files; there are fewer if these are all.
    overload_s, slow_s : float
        How long there is too much to do, and how long there are slow applications.
    n_pulses : int
        Of a SYNC chain.
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
    n_flips=30, n_gone=5,
)  # fmt: skip
LONG = NetworkFaultCounts(
    n_kills=1_000, rate_hz=10.0, n_seal_kills=200, n_worker_kills=500, away_s=30.0, meddled_s=120.0, cable_s=120.0,
    n_captures=50, n_hostile=1_000, n_fuzzed=1_000_000, n_hellos=1_000, n_files=1_000, overload_s=600.0,
    slow_s=240.0, n_pulses=400, n_power_cuts=4_500, n_flips=1_000, n_gone=200,
)  # fmt: skip


def run(
    *, say: Callable[[str], None], long: bool = False, seed: int | None = None, only: Sequence[str] = ()
) -> dict[str, Any]:
    """Try everything, or only some of `PARTS`, and return the report."""
    return try_parts(PARTS, LONG if long else SHORT, say=say, long=long, seed=seed, only=only, say_found=True)


def _disk_full(_: NetworkFaultCounts, folder: Path, seed: int) -> dict[str, Any] | None:
    disk = folder / "disk"
    disk.mkdir()
    with small_disk(disk) as mounted:
        return None if mounted is None else faults_links.disk_full(folder, mounted, seed=seed)


PARTS: Parts[NetworkFaultCounts] = {
    "centrals": (
        "{n_kills} central nodes killed",
        lambda extent, folder, seed: faults_kills.centrals(
            folder, seed=seed, count=extent.n_kills, rate_hz=extent.rate_hz
        ),
    ),
    "nodes": (
        "{n_kills} sensor nodes killed",
        lambda extent, folder, seed: faults_kills.nodes(folder, seed=seed, count=extent.n_kills),
    ),
    "captures": (
        "{n_captures} captures and central nodes killed",
        lambda extent, folder, seed: faults_hosts.captures(folder, seed=seed, count=extent.n_captures),
    ),
    "sealings": (
        "{n_seal_kills} sealings killed",
        lambda extent, folder, seed: faults_kills.sealings(folder, seed=seed, count=extent.n_seal_kills),
    ),
    "workers": (
        "{n_worker_kills} workers killed",
        lambda extent, folder, seed: faults_processing.workers(folder, seed=seed, count=extent.n_worker_kills),
    ),
    "disk_full": ("a small disk", _disk_full),
    "disk_fails": (
        "a disk that fails",
        lambda _, folder, seed: faults_links.disk_fails(folder, seed=seed),
    ),
    "away": (
        "{away_s:g} s without the central node",
        lambda extent, folder, seed: faults_links.away(folder, seed=seed, away_s=extent.away_s, how="killed"),
    ),
    "stopped": (
        "{away_s:g} s in which it stands still",
        lambda extent, folder, seed: faults_links.away(folder, seed=seed, away_s=extent.away_s, how="stopped"),
    ),
    "meddled": (
        "{meddled_s:g} s of lost, repeated and late acks",
        lambda extent, folder, seed: faults_links.meddled(folder, seed=seed, duration_s=extent.meddled_s),
    ),
    "hosts": (
        "{cable_s:g} s over a bad cable between two hosts",
        lambda extent, folder, seed: faults_hosts.hosts(folder, seed=seed, duration_s=extent.cable_s),
    ),
    "hostile": (
        "{n_hostile} hostile connections",
        lambda extent, folder, seed: faults_peers.hostile(folder, seed=seed, count=extent.n_hostile),
    ),
    "keys": ("all wrong keys", lambda _, folder, seed: faults_keys.keys(folder, seed=seed)),
    "fuzzed": (
        "{n_fuzzed} malformed messages",
        lambda extent, folder, seed: faults_peers.fuzzed(folder, seed=seed, count=extent.n_fuzzed),
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
        lambda extent, folder, seed: faults_wire.flips(folder, seed=seed, count=extent.n_flips),
    ),
    "gone": (
        "{n_gone} sensor nodes killed while the central node is behind",
        lambda extent, folder, seed: faults_wire.gone(folder, seed=seed, count=extent.n_gone),
    ),
    "overload": (
        "{overload_s:g} s of twice as much as can be done",
        lambda extent, folder, seed: faults_load.overload(folder, seed=seed, duration_s=extent.overload_s),
    ),
    "subscribers": (
        "{slow_s:g} s with slow and dead applications",
        lambda extent, folder, seed: faults_load.subscribers(folder, seed=seed, duration_s=extent.slow_s),
    ),
    "groups": (
        "{n_pulses} pulses, lost, double, and with a wrong clock",
        lambda extent, folder, seed: faults_processing.groups(folder, seed=seed, count=extent.n_pulses),
    ),
    "power_cuts": (
        "{n_power_cuts} power cuts",
        lambda extent, folder, seed: powercuts.try_cuts(
            folder, seed=seed, count=extent.n_power_cuts, only=("record", "serve", "spool")
        ),
    ),
}
"""What is tried: what to say of it, and how."""
