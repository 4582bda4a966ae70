"""Simulated power cuts: acknowledged measurements are stored exactly once (the short form of two benchmarks)."""

import random
import shutil
import subprocess
import sys

import pytest

from tests.faults import powercuts, reliability_table
from tests.faults.network import table
from tests.faults.powercuts import log as logs
from tests.faults.powercuts.disk import Disk
from tests.faults.powercuts.log import DiskOperation, DiskRecord

SEED = 1
N_STATES = {"capture": 12, "record": 10, "spool": 16}
N_MEASUREMENTS = 8
NOTHING_WRONG = dict.fromkeys(("lost", "twice", "wrong", "failed", "left_over"), 0)


@pytest.mark.parametrize("name", N_STATES)
def test_power_cuts_lose_and_duplicate_nothing(tmp_path, name, monkeypatch):
    """Syncs fail in half of the runs."""
    monkeypatch.setenv("ERTIS_CAPTURE_CHECK_BITS", "0")  # Each capture would load kernels for the check.
    reason = powercuts.reason_not_to_try(tmp_path)
    if reason:
        pytest.skip(reason)
    reported = []
    found = powercuts.try_cuts(
        tmp_path, seed=SEED, count=N_STATES[name], only=(name,), n_measurements=N_MEASUREMENTS, say=reported.append
    )
    assert {what: found[what] for what in NOTHING_WRONG} == NOTHING_WRONG, reported
    assert found["states"] == N_STATES[name]
    assert found["acknowledged"] > N_STATES[name]
    assert found["failed_syncs"] > 0


def test_power_cuts_without_a_compiler_are_reported_as_not_tried(tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda _: None)
    found = powercuts.try_cuts(tmp_path, seed=SEED, count=1)
    assert found == {"reason": "power cuts need Linux and a C compiler; install gcc"}
    reported = f"not tried: {found['reason']}"
    assert table.row("power_cuts", found)[2] == reported
    report = {"power_cuts": found, "machine": {}, "seed": SEED, "long": False, "only": []}
    monkeypatch.setattr(reliability_table, "sentence", lambda _: "")
    assert reported in reliability_table.reliability(report)


class RecordedDisk:
    """Simulated disk with the recorded operations of one process."""

    def __init__(self, folder):
        self.folder, self.disk = folder, Disk(folder)

    def __call__(self, kind, name="", data=b"", *, inode=1, offset=0):
        path = str(self.folder / name) if name else str(self.folder)
        self.disk.take(DiskRecord(kind, 1, inode, offset, path, data))

    def sync(self, name, *, inode=1, ends=DiskOperation.SYNC_END):
        is_folder = int(not name)
        self(DiskOperation.SYNC_BEGIN, name, inode=inode, offset=is_folder)
        self(ends, name, inode=inode, offset=is_folder)

    def states(self, target, count=60):
        """Return the contents by file name for several disks after a power cut."""
        found = []
        rng = random.Random(SEED)
        for number in range(count):
            place = target / str(number)
            self.disk.cut(place, rng)
            found.append({path.name: path.read_bytes() for path in place.iterdir()})
        return found


@pytest.fixture
def recorded_disk(tmp_path):
    folder = tmp_path / "disk"
    folder.mkdir()
    return RecordedDisk(folder)


@pytest.fixture
def after(tmp_path):
    folder = tmp_path / "after"
    folder.mkdir()
    return folder


def test_disk_keeps_what_was_synced(recorded_disk, after):
    recorded_disk(DiskOperation.CREATE, "a")
    recorded_disk(DiskOperation.WRITE, "a", b"x" * 5000)
    recorded_disk.sync("a")
    recorded_disk.sync("")
    assert recorded_disk.states(after, 9) == 9 * [{"a": b"x" * 5000}]


def test_disk_loses_and_tears_what_was_not_synced(recorded_disk, after):
    recorded_disk(DiskOperation.CREATE, "a")
    recorded_disk.sync("")
    recorded_disk(DiskOperation.WRITE, "a", b"x" * 4096)
    contents = [state["a"] for state in recorded_disk.states(after)]
    assert {b"", b"x" * 4096} < set(contents)
    assert any(content[:512] == bytes(512) and b"x" in content for content in contents)


def test_disk_never_holds_data_of_a_failed_sync(recorded_disk, after):
    recorded_disk(DiskOperation.CREATE, "a")
    recorded_disk(DiskOperation.WRITE, "a", b"x" * 512)
    recorded_disk.sync("a", ends=DiskOperation.SYNC_FAIL)
    recorded_disk.sync("a")
    recorded_disk.sync("")
    assert recorded_disk.states(after, 9) == 9 * [{"a": b""}]
    recorded_disk(DiskOperation.WRITE, "a", b"y" * 512)
    recorded_disk.sync("a")
    assert {state["a"] for state in recorded_disk.states(after / "0")} == {b"y" * 512}


def test_disk_may_lose_names_until_their_folder_is_synced(recorded_disk, after):
    recorded_disk(DiskOperation.CREATE, "a")
    recorded_disk(DiskOperation.WRITE, "a", b"x")
    recorded_disk.sync("a")
    recorded_disk(DiskOperation.RENAME, "a", str(recorded_disk.folder / "b").encode())
    names = [set(state) for state in recorded_disk.states(after)]
    assert set() in names
    assert {"a"} in names
    assert {"b"} in names
    recorded_disk.sync("")
    assert {frozenset(state) for state in recorded_disk.states(after / "0")} == {frozenset({"b"})}


def test_log_contains_the_operations_of_a_process(tmp_path):
    reason = powercuts.reason_not_to_try(tmp_path)
    if reason:
        pytest.skip(reason)
    code = """
import os, sys
folder = sys.argv[1]
with open(f"{folder}/a", "wb", buffering=0) as file:
    file.write(b"one")
    os.fsync(file.fileno())
    file.truncate(1)
    try:
        os.fdatasync(file.fileno())
        os.write(1, b"synced")
    except OSError as error:
        os.write(1, b"%d" % error.errno)
os.rename(f"{folder}/a", f"{folder}/b")
os.unlink(f"{folder}/b")
"""
    (tmp_path / "disk").mkdir()
    seen = set()
    for seed in range(3):
        (tmp_path / "log").unlink(missing_ok=True)
        environment = logs.environment(tmp_path / "disklog.so", tmp_path / "disk", tmp_path / "log", fail=(1, 99, seed))
        command = [sys.executable, "-c", code, tmp_path / "disk"]
        subprocess.run(command, env=environment, check=True, capture_output=True)
        *first, sync, ack, renamed, unlinked = logs.read(tmp_path / "log")
        assert [record.kind.name for record in first] == [
            "CREATE", "WRITE", "SYNC_BEGIN", "SYNC_END", "TRUNCATE", "SYNC_BEGIN",
        ]  # fmt: skip
        seen.add((sync.kind.name, ack.data))
        assert (renamed.kind, unlinked.kind) == (DiskOperation.RENAME, DiskOperation.UNLINK)
    assert seen == {("SYNC_FAIL", b"5"), ("SYNC_END", b"synced")}
