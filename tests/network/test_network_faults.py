"""Short form of `python -m tests.faults network`: killed nodes, failing disks and hostile connections.

The long form uses a new seed in each run; here the seed is fixed, so that a failure can be repeated.
"""

import shutil
from dataclasses import replace

import pytest
from ertis_bench import machine
from ertis_bench.network import serving
from ertis_bench.network.diary import Diary, DiaryKey, Row
from ertis_bench.network.processes import central
from ertis_bench.network.receiver import Received, read_received
from ertis_bench.network.sender import SMALL, SenderJob, words_of
from ertis_bench.network.sent import Sent, read_diaries
from ertis_bench.network_trials.oracle import compare, judged as judged_by_checker, read_folder

from ertis_numba.base.errors import DataError
from ertis_numba.frames import Measurement, Stamp
from ertis_numba.network.messages import Group
from ertis_numba.network.status import SensorStatus, Status
from ertis_numba.storage import RecordingWriter, open_recording
from tests.faults import reliability
from tests.faults.network import all_trials as faults, keys, kills, links, peers, processing, table, wire, zmtp
from tests.faults.network.keyed_node import KeyedNode
from tests.faults.network.sender_thread import SenderThread
from tests.files import noise

SEED = 1
N_KILLS = {"centrals": 4, "nodes": 4, "workers": 2}
NOTHING_WRONG = dict.fromkeys(
    ("lost", "missing", "wrong", "twice", "unexpected", "silent", "broken", "left_over", "tracebacks"), 0
)
SPOILING = """
import sys, zlib

if "record" in sys.argv:
    from dataclasses import replace
    from ertis_numba.journal import Journal, JournalEntry

    append = Journal.append

    def spoiling(self, entries):
        kept = []
        for entry in entries:
            sequence = entry.measurement.stamp.sequence
            if sequence == 3:
                continue
            if sequence == 5:
                words = entry.measurement.data.copy()
                words[1000] ^= 1
                measurement = replace(entry.measurement, data=words)
                entry = JournalEntry(measurement, entry.monotonic_ns, zlib.crc32(words.data))
            kept.append(entry)
        append(self, kept)

    Journal.append = spoiling
"""


def wrong_in(part, found):
    """Counts that should be 0 and are not; tests also check that they can be detected."""
    assert all(table.row(part, found))
    return {name: found[name] for name in NOTHING_WRONG if name in found and found[name] != 0}


def test_killed_central_nodes_lose_nothing(tmp_path):
    found = kills.centrals(tmp_path, seed=SEED, count=N_KILLS["centrals"], rate_hz=faults.SHORT.rate_hz)
    assert wrong_in("centrals", found) == {}
    assert (found["orphans"], found["unacked"]) == (0, 0)
    assert found["stored"] == found["promised"] > 10 * N_KILLS["centrals"]


def test_killed_sensor_nodes_lose_nothing(tmp_path):
    found = kills.nodes(tmp_path, seed=SEED, count=N_KILLS["nodes"])
    assert wrong_in("nodes", found) == {}
    assert (found["in_spool"], found["orphans"]) == (0, 0)
    assert found["promised"] > 5 * N_KILLS["nodes"]


def test_killed_sealing_processes_lose_nothing(tmp_path):
    found = kills.sealings(tmp_path, seed=SEED, count=2, rate_hz=10.0)
    assert wrong_in("sealings", found) == {}
    assert found["kills"] == 2


def test_killed_workers_lose_nothing(tmp_path):
    found = processing.workers(tmp_path, seed=SEED, count=N_KILLS["workers"])
    assert wrong_in("workers", found) == {}
    assert {name: found[name] for name in ("unbalanced", "uncounted", "untold", "disordered", "foreign")} == {
        "unbalanced": 0, "uncounted": 0, "untold": 0, "disordered": 0, "foreign": 0,
    }  # fmt: skip
    assert found["respawned"] >= found["kills"] == N_KILLS["workers"]
    assert found["acked_through"]
    assert set(found["dropped"]) <= {"superseded", "failed twice", "the workers were getting ready"}
    assert found["images after the kills"] > 4  # more than were on the way
    assert found["orphans"] == 0


def test_full_disk_loses_nothing(tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    with reliability.small_disk(disk) as mounted:
        if mounted is None:
            pytest.skip("only root may mount a small disk")
        found = links.disk_full(tmp_path, mounted, seed=SEED)
    assert wrong_in("disk_full", found) == {}
    assert (found["state"], found["acked in fault"]) == ("fault", 0)
    assert found["offered"] == found["stored"] > found["acked before"] > 0
    assert "free" in found["said"]


def test_failing_disk_loses_nothing(tmp_path):
    found = links.disk_fails(tmp_path, seed=SEED)
    assert wrong_in("disk_fails", found) == {}
    assert (found["state"], found["acked in fault"]) == ("fault", 0)
    assert found["offered"] == found["stored"] > found["acked before"] > 0


def test_lost_acks_and_dead_cables_lose_nothing(tmp_path):
    found = links.meddled(tmp_path, seed=SEED, duration_s=2.0)
    assert wrong_in("meddled", found) == {}
    assert found["flushed"]
    assert {"ack lose", "ack repeat", "ack delay"} <= found["meddled"].keys()


@pytest.fixture(scope="module")
def encrypted(tmp_path_factory):
    """Return the results of flipped bits, and then those of all keys, at one central node, which starts slowly."""
    folder = tmp_path_factory.mktemp("encrypted")
    with KeyedNode.running(folder) as keyed:
        flipped, sent = wire.flip_bits(keyed, folder, seed=SEED, count=faults.SHORT.n_flips)
        tried, listed, removed = keys.try_keys(keyed, folder, seed=SEED)
        flipped["exit code"] = keyed.node.stop()
    stored = judged_by_checker(folder, keyed.archive, [sent, listed, removed], kept=[sent, listed])
    return flipped | stored, tried | stored


def test_keys_are_enforced(encrypted):
    _, found = encrypted
    assert found["let in"] == ["the listed application", "the listed sensor"]
    assert found["raw"] == 0
    assert found["unsettled when removed"] > 0
    assert {"unknown key", "no key", "role", "serial", "removed key"} <= found["refused"].keys()
    assert wrong_in("keys", found) == {}
    assert found["notes"]


@pytest.mark.alone  # the limit is a wall-clock time
def test_removed_key_is_cut_off_within_a_second(encrypted):
    _, found = encrypted
    assert found["removed, s"] < 1.0


def test_malformed_messages_harm_nothing(tmp_path):
    found = peers.fuzzed(tmp_path, seed=SEED, count=5_000)
    assert wrong_in("fuzzed", found) == {}
    assert (found["inputs"], found["restarts"], found["exit code"]) == (5_000, 0, 0)
    assert found["answers"] > 100
    assert found["flushed"]
    assert found["memory grew, MB"] < 50


def test_flipped_bits_end_only_their_encrypted_connections(encrypted):
    found, _ = encrypted
    assert wrong_in("flips", found) == {}
    assert (found["flips"], found["restarts"], found["sockets left"]) == (faults.SHORT.n_flips, 0, 0)
    assert found["flushed"]
    assert found["exit code"] == 0


def test_killed_nodes_do_not_end_a_lagging_central_node(tmp_path):
    found = wire.gone(tmp_path, seed=SEED, count=faults.SHORT.n_gone)
    assert wrong_in("gone", found) == {}
    assert (found["kills"], found["restarts"], found["sockets left"]) == (faults.SHORT.n_gone, 0, 0)
    assert found["promised"] > faults.SHORT.n_gone
    assert found["flushed"]
    assert (found["exit code"], found["orphans"]) == (0, 0)


def test_checker_detects_a_faulty_node(tmp_path, monkeypatch):
    (tmp_path / "spoiling").mkdir()
    (tmp_path / "spoiling" / "sitecustomize.py").write_text(SPOILING)
    monkeypatch.syspath_prepend(str(tmp_path / "spoiling"))
    record = kills.RestartedRecorder(tmp_path)
    diary = tmp_path / "sender.ndjson"
    with SenderThread(SenderJob(address=record.address, diary=str(diary), count=8, rate_hz=100.0)) as sender:
        sender.wait_for("begun")
        record.finish([sender])
    found = kills.judged(tmp_path, record.archive, [diary])
    assert (found["lost"], found["wrong"], found["silent"]) == (1, 1, 1)
    (recording,) = record.archive.glob("*.h5")
    shutil.copy(recording, record.archive / "again.h5")
    assert kills.judged(tmp_path, record.archive, [diary])["twice"] == 7


@pytest.fixture(scope="module")
def sent(tmp_path_factory):
    """Diary, and the measurements that it lists."""
    path = tmp_path_factory.mktemp("sent") / "sender.ndjson"
    diary, measurements = Diary(path), []
    for number, made in enumerate(noise(SMALL, 6, SEED)):
        stamp = Stamp(sensor="front", sequence=number, session_id=7, sync_count=number, timestamp_ns=1_000 + number)
        measurements.append(Measurement(words_of(made.data, 7, number), SMALL, stamp))
        key = DiaryKey("front", 7, number)
        diary.offered(key, Row.of(measurements[-1]), 5)
        diary.kept(key)
    diary.acked_through("front", 7, 3, "stored", 9)
    return path, measurements


def stored(folder, measurements, *, name="rec.h5", gaps=()):
    folder.mkdir(exist_ok=True)
    with RecordingWriter(folder / name) as writer:
        for measurement in measurements:
            writer.write(measurement)
        for first, last, reason in gaps:
            writer.note_gap("front", first, last, reason, session_id=7)


def judged(path, folder):
    reported = read_diaries([path])
    found = compare(reported, read_folder(folder), reported.kept)
    return {name: count for name, count in found.items() if name not in ("promised", "stored") and count}


def test_checker_accepts_correct_results(tmp_path, sent):
    path, measurements = sent
    stored(tmp_path / "a", measurements)
    assert judged(path, tmp_path / "a") == {}
    reported = read_diaries([path])
    assert len(reported.acked()) == 4
    assert reported.ack_times_ms() == pytest.approx([4e-6] * 4)


def test_checker_detects_losses(tmp_path, sent):
    path, measurements = sent
    stored(tmp_path / "a", [*measurements[:2], *measurements[3:]])
    assert judged(path, tmp_path / "a") == {"lost": 1, "silent": 1}
    stored(tmp_path / "b", [*measurements[:2], *measurements[3:]], gaps=[(2, 2, "memory full")])
    assert judged(path, tmp_path / "b") == {"missing": 1}
    stored(tmp_path / "c", measurements[:-1])  # no number above it tells
    assert judged(path, tmp_path / "c") == {"lost": 1}


def test_checker_detects_changes(tmp_path, sent):
    path, measurements = sent
    words = measurements[2].data.copy()
    words[30_000] ^= 1 << 31
    for number, changed in enumerate(
        (
            replace(measurements[2], data=words),
            replace(measurements[2], stamp=replace(measurements[2].stamp, timestamp_ns=5)),
            replace(measurements[2], stamp=replace(measurements[2].stamp, sync_count=1)),
        )
    ):
        folder = tmp_path / str(number)
        stored(folder, [*measurements[:2], changed, *measurements[3:]])
        assert judged(path, folder) == {"wrong": 1}


def test_checker_detects_duplicates_and_inventions(tmp_path, sent):
    path, measurements = sent
    stored(tmp_path / "a", measurements)
    stored(tmp_path / "a", measurements[2:3], name="again.h5")
    assert judged(path, tmp_path / "a") == {"twice": 1}
    stranger = replace(measurements[0], stamp=replace(measurements[0].stamp, session_id=8))
    stored(tmp_path / "a", [stranger], name="other.h5")
    assert judged(path, tmp_path / "a") == {"twice": 1, "unexpected": 1}


def test_checker_detects_broken_and_leftover_files(tmp_path, sent):
    path, measurements = sent
    stored(tmp_path / "a", measurements)
    whole = (tmp_path / "a" / "rec.h5").read_bytes()
    (tmp_path / "a" / "cut.h5").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "a" / "more.h5.journal").touch()
    assert judged(path, tmp_path / "a") == {"broken": 1, "left_over": 1}
    with open_recording(tmp_path / "a" / "rec.h5") as recording:
        assert len(recording) == 6


def test_partial_diary_line_is_ignored(tmp_path, sent):
    path = tmp_path / "cut.ndjson"
    path.write_bytes(sent[0].read_bytes()[:-3])
    reported = read_diaries([path])
    assert (len(reported.kept), reported.acked_through) == (6, {})


def test_images_are_counted(tmp_path):
    path = tmp_path / "images.ndjson"
    path.write_text(
        '["a", 1, 0, 0, 0, 2000000, false]\n["a", 1, 3, 2, 1, 4000000, true]\n["a", 1, 3, 4, 1, 4000000, false]\n["a",'
    )
    found = read_received(path)
    assert (found.twice, found.disordered, found.wrong, found.dropped, found.unrecorded) == (1, 0, 1, 1, 1)
    assert found.times_ms == {DiaryKey("a", 1, 0): 2.0, DiaryKey("a", 1, 3): 4.0}


def test_inconsistent_counts_are_reported():
    sensors = {"a": SensorStatus(received=9, published=5, dropped={"superseded": 3}, in_flight=0)}
    status = Status(version="", pid=1, host="", address="", state="processing", sensors=sensors)
    serve = serving.Serve(None, "", "", "", None, latest=status)
    reported = Sent(
        kept={DiaryKey("a", 1, number) for number in range(10)}, offered={DiaryKey("a", 1, 0): Row(0, 0, 0)}
    )
    received = Received(
        times_ms={DiaryKey("a", 1, 0): 1.0, DiaryKey("b", 1, 0): 1.0}, numbers=[0, 1, 4], dropped=1, wrong=1
    )
    found = serving.accounts(serve, reported, received)
    assert (found["unbalanced"], found["uncounted"], found["foreign"], found["wrong"]) == (1, 1, 1, 1)
    assert found["untold"] == 1 + 1  # five were published, three came, one was told; numbers 2 and 3 are not there


def test_mixed_groups_are_detected():
    pulse_of = {(sensor, number): number + (sensor == "b" and number > 2) for sensor in "ab" for number in range(6)}
    came = [
        Group(number=number, dropped=0, group=number, members=members, missing=(), spread_ns=0, flags=flags)
        for number, (members, flags) in enumerate(
            (
                ((("a", 1, 0), ("b", 2, 0)), ()),
                ((("a", 1, 3), ("b", 2, 3)), ()),  # of the fourth and the fifth pulse
                ((("a", 1, 4), ("b", 2, 3)), ("clock",)),
                ((("a", 1, 3),), ("incomplete", "pulse")),
            )
        )
    ]
    at = {"lost": 2, "double": 3, "clock": 4}
    found = processing.grouped(came, pulse_of, at, n_sensors=2, count=6)
    assert (found["complete"], found["mixed"], found["clock flags after"], found["flagged pulses"]) == (2, 1, 1, [3])
    assert all(table.row("groups", found))


def test_part_that_could_not_run_is_reported():
    assert table.row("hosts", None)[2] == "not tried: requires root"
    report = {"machine": machine.describe(), "seed": 3, "long": False, "only": ["hosts"], "hosts": None}
    assert "Command: `python -m tests.faults network --only hosts --seed 3`." in table.network(report)


def test_frames_are_joined_from_any_chunks():
    frames = [zmtp.ZmtpFrame(1, bytes(300)), zmtp.ZmtpFrame(0, b"x"), zmtp.ZmtpFrame(4, b"\x04PING")]
    data = b"".join(frame.encode() for frame in frames)
    for size in (1, 2, 7, 300, len(data)):
        reader = zmtp.ZmtpFrameParser()
        came = [frame for start in range(0, len(data), size) for frame in reader.feed(data[start : start + size])]
        assert [frame.body for frame in came] == [frame.body for frame in frames]
        assert [(frame.more, frame.is_command) for frame in came] == [(True, False), (False, False), (False, True)]


def test_parts_match_their_descriptions():
    assert set(faults.PARTS) == set(table.ROWS)


def test_node_that_does_not_start_is_reported(tmp_path):
    with (
        central("record", tmp_path, "-o", str(tmp_path / "file"), listen="tcp://nowhere") as node,
        pytest.raises(DataError, match=r"event 'listening' of central did not arrive; .* ended with 2; .*ertis: error"),
    ):
        node.wait_for("listening")
