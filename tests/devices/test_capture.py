"""Captures from emulated sensors on real pseudo terminals: stored samples equal sent samples under every fault."""

import contextlib
import io
import json
import os
import signal
import subprocess
import sys
import threading
import zlib
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba.base.errors import ArgumentError, SonarError
from ertis_numba.devices.capture import CaptureSession
from ertis_numba.devices.capture.gap_reasons import DROPPED, NOT_TRIGGERED
from ertis_numba.devices.driver import SonarDriver
from ertis_numba.devices.emulator import Emulator, Quirks, SyncChain
from ertis_numba.devices.emulator.faults import BlockFault, Faults, Spoilt
from ertis_numba.devices.setup import Setup
from ertis_numba.journal import Journal
from ertis_numba.settings import Recording, Settings
from ertis_numba.storage import open_recording
from ertis_numba.storage.sealing import seal
from tests.emulated import PATIENT, PATIENT_ERTIS, PacedChain, patient

__all__ = ["patient"]  # A fixture, imported for use here.

ROOT = Path(__file__).parents[2]
ERTIS = (sys.executable, "-m", "ertis_cli")
SHORT = 32_768  # the shortest measurement of a sensor
SETTINGS = Settings(recording=Recording(n_samples=SHORT)).replace(
    processing=Settings().processing.replace(range_m=(0.1, 0.5))
)


@pytest.fixture(scope="module")
def words():
    """Four measurements cut from one simulated measurement."""
    whole = open_recording(ROOT / "data" / "synthetic" / "reflectors.h5")[0].data
    return [np.ascontiguousarray(whole[start : start + SHORT]) for start in range(0, 4 * SHORT, SHORT)]


class DropFaults(Faults):
    """Faults that drop the measurements with some numbers."""

    def __init__(self, counters):
        super().__init__()
        self._counters = counters

    def spoil(self, block):
        if int.from_bytes(block[4:8], "little") in self._counters:
            return Spoilt((), (BlockFault("drop", 0, len(block)),))
        return super().spoil(block)


class Capture:
    """Emulated sensors, their drivers, a journal, and a record of all callbacks."""

    def __init__(self, stack, folder, words, *, trigger="command", names=("one",), dropped=None, **options):
        self.log = io.StringIO()
        self.emulators = [
            stack.enter_context(
                Emulator(
                    words, name=name, link=folder / name, log=self.log, faults=DropFaults((dropped or {}).get(name, ()))
                )
            )
            for name in names
        ]
        sonars = {name: stack.enter_context(SonarDriver.open(str(folder / name))) for name in names}
        setup = Setup.of(SETTINGS)
        for sonar in sonars.values():
            sonar.configure(setup)
        self.sonars = sonars
        self.journal = stack.enter_context(Journal.create(folder / "rec.h5.journal", target="rec.h5"))
        self.notes, self.stored = [], []
        self.many = threading.Event()
        self._wanted = 0
        self.session = CaptureSession(
            sonars,
            SETTINGS,
            trigger=trigger,
            on_stored=self._store,
            on_note=lambda sensor, text: self.notes.append((sensor, text)),
            on_back=lambda sensor, away_s: self.notes.append((sensor, away_s)),
            **options,
        )

    def _store(self, entries):
        self.stored += [entry.measurement.stamp for entry in entries]
        if len(self.stored) >= self._wanted:
            self.many.set()

    def wait_for(self, count):
        self.many.clear()
        self._wanted = count
        if len(self.stored) < count:
            assert self.many.wait(60), f"{len(self.stored)} stored, wanted {count}: {self.notes}"

    def recording(self, sensor="one"):
        self.journal.close()
        path = self.journal.path.with_name("rec.h5")
        if not path.exists():
            assert seal(self.journal.path).recording == path
        return open_recording(path, sensor=sensor)


@pytest.fixture
def captures(tmp_path, words):
    with ExitStack() as stack:
        yield lambda **options: Capture(stack, tmp_path, words, **options)


@pytest.mark.alone
def test_capture_stores_the_samples_that_were_sent(captures, words):
    capture = captures(n=6, rate_hz=20.0)
    capture.session.run(capture.journal)
    with capture.recording() as recording:
        assert len(recording) == 6
        for number, measurement in enumerate(recording):
            np.testing.assert_array_equal(measurement.data, words[number % 4])
            assert measurement.stamp.sequence == number
            assert measurement.stamp.sync_count >= number  # ticks that a busy machine misses are skipped
        times_ns = np.array([stamp.timestamp_ns for stamp in recording.stamps()])
        sent_ns = [json.loads(entry)["time_ns"] for entry in capture.log.getvalue().splitlines()]
        late_ms = (times_ns + 1e9 * SETTINGS.recording.duration_s - sent_ns) / 1e6
        assert np.median(late_ms) == pytest.approx(0, abs=6)  # the stamp plus the recording time is the sending time
        assert np.median(np.diff(times_ns)) / 1e6 == pytest.approx(50, abs=20)  # wide enough for a busy machine
        assert all(0 < stamp.timestamp_uncertainty_ns < 1e8 for stamp in recording.stamps())
        assert recording.settings.recording == SETTINGS.recording
        assert not recording.gaps
    assert capture.session.counts["one"].stored == len(capture.stored) == 6
    assert capture.session.counts["one"].lost == 0


@pytest.mark.alone
def test_sync_capture_groups_measurements_of_one_pulse(captures, words):
    """Each sensor is armed while pulses already arrive, so the counters of the sensors differ."""
    names = ("a", "b", "c")
    capture = captures(trigger="sync", names=names, n=8)
    with SyncChain(capture.emulators, rate_hz=20.0):
        capture.session.run(capture.journal)
    # Pulses may arrive before all sensors are armed, and an emulator ignores pulses while it measures.
    assert capture.session.complete >= 4
    assert capture.session.complete + capture.session.incomplete <= 8
    rows = {}
    for name in names:
        with capture.recording(name) as recording:
            for measurement in recording:
                index = next(i for i in range(4) if np.array_equal(words[i], measurement.data))
                rows.setdefault(measurement.stamp.sync_count, set()).add(index)
    assert set(rows) <= set(range(8))
    assert all(len(indices) == 1 for indices in rows.values())


def test_capture_records_dropped_measurements_as_gaps(captures, monkeypatch):
    """Gaps at the beginning and at the end are recorded with their reason, too.

    The driver gives up dropped measurements soon, but waits for others as long as a busy machine needs.
    """
    dropped, usual_s = (0, 2, 3, 6), SonarDriver.deadline_s.fget
    patient_s = lambda sonar: usual_s(sonar) + 60.0 * (sonar._next not in dropped)  # noqa: E731, SLF001
    monkeypatch.setattr(SonarDriver, "deadline_s", property(patient_s))
    capture = captures(rate_hz=20.0, n=4, dropped={"one": dropped})
    capture.session.run(capture.journal)
    with capture.recording() as recording:
        assert [stamp.sequence for stamp in recording.stamps()] == [1, 4, 5, 7]
        assert [(gap.first, gap.last) for gap in recording.gaps] == [(0, 0), (2, 3), (6, 6)]
        assert {gap.reason for gap in recording.gaps} == {"it did not arrive in time"}
    assert capture.session.counts["one"].missing == {"it did not arrive in time": 4}
    assert [text.split(":")[1] for _, text in capture.notes] == [
        " no complete measurement within 0.53 s; 0 of 131084 bytes arrived"
    ] * 4


@PATIENT
def test_capture_counts_commands_skipped_at_too_high_a_rate(captures):
    capture = captures(rate_hz=400.0, n=4)
    capture.session.run(capture.journal)
    counts = capture.session.counts["one"]
    assert (counts.stored, counts.lost) == (4, 0)
    assert counts.skipped == capture.stored[-1].sync_count - 3 > 3


def test_sync_capture_ends_when_last_measurement_is_lost(captures):
    capture = captures(trigger="sync", n=6, dropped={"one": (2, 5)})
    with PacedChain(capture.emulators, rate_hz=20.0):
        capture.session.run(capture.journal)
    with capture.recording() as recording:
        assert [stamp.sequence for stamp in recording.stamps()] == [0, 1, 3, 4]
        assert [(gap.first, gap.last) for gap in recording.gaps] == [(2, 2), (5, 5)]
    assert capture.session.counts["one"].lost == 2


def test_gap_reasons_distinguish_dropped_measurements_from_missed_pulses(captures):
    capture = captures(trigger="sync", names=("one", "two"), n=10, dropped={"two": (4,)})
    one, two = capture.emulators
    trigger = two.trigger
    two.trigger = lambda pulse, *, at_ns: pulse != 6 and trigger(pulse, at_ns=at_ns)
    with PacedChain([one, two], rate_hz=10.0):
        capture.session.run(capture.journal)
    with capture.recording("two") as recording:
        reasons = {gap.reason for gap in recording.gaps}
    assert reasons == {DROPPED, NOT_TRIGGERED}


class OrderRecorder:
    """A sink that forwards all calls to a journal and records the order of the numbers."""

    def __init__(self, journal):
        self._journal = journal
        self.numbers = {}

    def add_sensor(self, name, *given, **options):
        self.numbers[name] = []
        self._journal.add_sensor(name, *given, **options)

    def append(self, entries):
        for entry in entries:
            self.numbers[entry.measurement.stamp.sensor].append(entry.measurement.stamp.sequence)
        return self._journal.append(entries)

    def note_gap(self, sensor, first, last, reason, *, session_id):
        self.numbers[sensor] += range(first, last + 1)
        self._journal.note_gap(sensor, first, last, reason, session_id=session_id)


def test_capture_passes_gaps_and_measurements_in_order(captures):
    """The pulses of the second sensor are known only from its third block, so gaps and measurements come together."""
    capture = captures(trigger="sync", names=("one", "two"), n=8, dropped={"two": (1,)})
    sink = OrderRecorder(capture.journal)
    with PacedChain(capture.emulators, rate_hz=20.0):
        capture.session.run(sink)
    assert capture.session.counts["two"].lost >= 1
    assert sink.numbers == {name: sorted(numbers) for name, numbers in sink.numbers.items()}
    assert len(sink.numbers["two"]) >= 4


@pytest.mark.alone  # on a busy machine the other sensor misses more pulses
def test_sync_capture_accepts_pulses_before_the_first_sensors(captures):
    capture = captures(trigger="sync", names=("one", "two"), n=8, dropped={"one": range(4)})
    with SyncChain(capture.emulators, rate_hz=20.0):
        capture.session.run(capture.journal)
    with capture.recording("two") as recording:
        assert recording.stamps()[0].sequence == 0
        assert recording.stamps()[0].sync_count == 0
    with capture.recording("one") as recording:
        assert (recording.stamps()[0].sequence, recording.stamps()[0].sync_count >= 0) == (0, True)
    assert capture.session.complete >= 4


@pytest.mark.alone
@pytest.mark.parametrize("trigger", ["command", "sync"])
def test_capture_resumes_when_unplugged_sensor_returns(captures, words, trigger):
    capture = captures(trigger=trigger, rate_hz=20.0)
    runner = threading.Thread(target=capture.session.run, args=(capture.journal,))
    with ExitStack() as stack:
        if trigger == "sync":
            stack.enter_context(SyncChain(capture.emulators, rate_hz=20.0))
        runner.start()
        capture.wait_for(4)
        capture.emulators[0].unplug()
        assert not (capture.journal.path.parent / "one").exists()
        before = len(capture.stored)
        capture.emulators[0].replug()
        capture.wait_for(before + 6)
        capture.session.stop()
        runner.join()
    assert capture.session.counts["one"].unplugged == 1
    (away_s,) = [what for _, what in capture.notes if isinstance(what, float)]
    assert 0 < away_s < 3
    with capture.recording() as recording:
        sequences = [stamp.sequence for stamp in recording.stamps()]
        assert sequences == sorted(set(sequences))
        gaps = [number for gap in recording.gaps for number in range(gap.first, gap.last + 1)]
        assert sorted([*sequences, *gaps]) == list(range(sequences[-1] + 1))
        assert all(gap.reason == "the sensor was unplugged" for gap in recording.gaps)
        sent = {zlib.crc32(each.tobytes()) for each in words}
        assert all(zlib.crc32(measurement.data.tobytes()) in sent for measurement in recording)


@pytest.mark.alone
def test_capture_continues_numbers_after_counter_reset(captures):
    """A power cut that the computer does not notice resets the counter of a sensor."""
    capture = captures(trigger="sync")
    runner = threading.Thread(target=capture.session.run, args=(capture.journal,))
    with SyncChain(capture.emulators, rate_hz=20.0):
        runner.start()
        capture.wait_for(6)
        capture.emulators[0].registers.counter = 3
        capture.wait_for(len(capture.stored) + 12)
        capture.session.stop()
        runner.join()
    sequences = [stamp.sequence for stamp in capture.stored]
    assert sequences == sorted(set(sequences))
    assert sequences[-1] < 60
    with capture.recording() as recording:
        assert sum(gap.last - gap.first + 1 for gap in recording.gaps) == sequences[-1] + 1 - len(sequences) < 5


def test_capture_fails_when_unplugged_sensor_stays_away(captures):
    capture = captures(rate_hz=20.0, patience_s=0.5)
    runner_error = []

    def run():
        try:
            capture.session.run(capture.journal)
        except SonarError as error:
            runner_error.append(error)

    runner = threading.Thread(target=run)
    runner.start()
    capture.wait_for(3)
    capture.emulators[0].unplug()
    runner.join()
    assert str(runner_error[0]).startswith("one: ")
    with capture.recording() as recording:
        assert len(recording) >= 3  # stored measurements are kept


@PATIENT
def test_capture_keeps_other_sensors_when_one_is_silent(captures):
    capture = captures(names=("one", "two"), n=12, rate_hz=20.0)
    capture.emulators[1].unplug()
    with pytest.raises(SonarError, match="two: "):
        CaptureSession(capture.sonars, SETTINGS, trigger="command", rate_hz=20.0, n=12, patience_s=0.4).run(
            capture.journal
        )
    with capture.recording("one") as recording:
        assert len(recording) == 12


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"trigger": "whistle"}, "trigger 'whistle' is unknown; known are command, sync"),
        ({"rate_hz": 0.0}, "rate is 0; use a number from"),
        ({"n": 0}, "n is 0; use a whole number"),
        ({"duration_s": 0.0}, "duration is 0; use a number above 0"),
        ({"patience_s": -1.0}, "patience is -1; use a number above 0"),
    ],
)
def test_capture_session_rejects_invalid_options(captures, options, message):
    capture = captures()
    with pytest.raises(ArgumentError, match=message):
        CaptureSession(capture.sonars, SETTINGS, **{"trigger": "command", **options})


def test_capture_session_rejects_empty_sonars():
    with pytest.raises(ArgumentError, match="sonars is empty; pass at least one sensor"):
        CaptureSession({}, SETTINGS, trigger="command")


# The tests below run the command as users do.


@pytest.fixture
def sensor(tmp_path, words):
    """An emulated sensor, linked as eRTIS-7."""
    with Emulator(words, name="eRTIS-7", link=tmp_path / "eRTIS-7") as emulator:
        yield emulator


def settings_file(tmp_path):
    path = tmp_path / "settings.toml"
    path.write_text(SETTINGS.to_toml())
    return path


def start(tmp_path, *arguments, ertis=ERTIS):
    command = [*ertis, "capture", "--settings", str(settings_file(tmp_path)), *arguments]
    return subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def run(tmp_path, *arguments):
    """Run the command in this process."""
    with contextlib.chdir(tmp_path):
        done = CliRunner().invoke(cli, ["capture", "--settings", str(settings_file(tmp_path)), *arguments])
    return done.exit_code, [json.loads(line) for line in done.stdout.splitlines()], done.stderr


def has_open(process, path):
    """Return True if a process has a file open."""
    with contextlib.suppress(OSError):  # the process may close a file at this moment
        return any(os.path.realpath(each) == path for each in Path(f"/proc/{process.pid}/fd").iterdir())
    return False


@PATIENT
def test_capture_command_reports_and_writes_a_recording(tmp_path, sensor, words):
    code, lines, err = run(tmp_path, "--port", str(sensor.link), "-n", "3", "--rate", "20", "--json")
    assert code == 0, err
    *stored, final = lines
    assert [line["crc32"] for line in stored] == [zlib.crc32(each.tobytes()) for each in words[:3]]
    assert (final["event"], final["stored"], final["lost"]) == ("captured", 3, 0)
    assert Path(final["output"]).name.startswith("eRTIS-7_")
    with open_recording(tmp_path / final["output"]) as recording:
        assert [measurement.stamp.sensor for measurement in recording] == ["eRTIS-7"] * 3
    assert "3 measurements, 0 lost" in err
    assert not list(tmp_path.glob("*.journal*"))


@pytest.mark.parametrize(
    ("number", "arguments", "code"),
    [(signal.SIGINT, (), 0), (signal.SIGTERM, (), 0), (signal.SIGINT, ("-n", "1000"), 130)],
)
def test_capture_command_completes_its_file_on_signal(tmp_path, sensor, number, arguments, code):
    command = ["--port", str(sensor.link), "--rate", "20", "--json", "-o", "rec.h5", "--quiet", "--no-check-bits"]
    process = start(tmp_path, *command, *arguments, ertis=PATIENT_ERTIS)
    first = [process.stdout.readline() for _ in range(3)]
    process.send_signal(number)
    out, err = process.communicate(timeout=60)
    assert process.returncode == code, err
    lines = [json.loads(line) for line in [*first, *out.splitlines()]]
    with open_recording(tmp_path / "rec.h5") as recording:
        assert len(recording) == lines[-1]["stored"] == len(lines) - 1 >= 3
    assert err == ""


@pytest.mark.parametrize("after_s", [0.01, 0.2, 0.4])
def test_capture_command_leaves_no_file_when_stopped_at_start(tmp_path, sensor, after_s):
    """Libraries that are being loaded must neither swallow the signal nor fail because of it."""
    process = start(tmp_path, "--port", str(sensor.link), "-o", "rec.h5")
    while not has_open(process, sensor.port):
        with pytest.raises(subprocess.TimeoutExpired):  # it still runs
            process.wait(0.005)
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(after_s)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode in {0, 130}, err  # 0 if the measurement had begun
    assert "Traceback" not in err
    if process.returncode:
        assert not list(tmp_path.glob("rec.h5*"))
    else:
        with open_recording(tmp_path / "rec.h5") as recording:
            assert len(recording) >= 1


def test_capture_command_does_not_load_hdf5(tmp_path, sensor):
    arguments = ["capture", "--port", str(sensor.link), "-n", "2", "-o", "rec.h5", "--quiet", "--settings"]
    code = (
        "import sys; from ertis_cli.main import cli\n"
        "try: cli.main(sys.argv[1:])\n"
        "except SystemExit as end: assert not end.code, end.code\n"
        "print('h5py' in sys.modules, 'ertis_numba.journal' in sys.modules)"
    )
    command = [sys.executable, "-c", code, *arguments, str(settings_file(tmp_path))]
    paths = os.pathsep.join(str(ROOT / folder) for folder in (".", "cli", "bench"))
    done = subprocess.run(
        command, cwd=tmp_path, env=os.environ | {"PYTHONPATH": paths}, capture_output=True, text=True, check=False
    )
    assert done.stdout == "False True\n", done.stderr


def test_capture_dry_run_prints_commands_and_opens_no_port(tmp_path):
    with contextlib.chdir(tmp_path):
        done = CliRunner().invoke(cli, ["capture", "--port", "none", "--dry-run", "--trigger", "sync", "--pin", "2"])
    assert done.exit_code == 0, done.stderr
    assert "!G,655360,0,0         measurement length: 655360 bytes\n" in done.stdout
    assert "!C,0… to 1125         samples of the call, unless the sensor already has them\n" in done.stdout
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "message", "code"),
    [
        (["--port", "{link}", "--name", "a", "--name", "b"], "2 names are given for 1 ports; use one --name", 2),
        (["--port", "nowhere"], "ertis: error: serial port 'nowhere' does not exist", 1),
        (
            ["--port", "{link}", "--preset", "default_25_50"],
            "--preset and --settings cannot be combined; choose one",
            2,
        ),
        (
            ["--port", "{link}", "-o", "settings.toml"],
            "output settings.toml is the input itself; choose another name",
            1,
        ),
        (["--port", "{link}", "--port", "{link}"], "is given 2 times; name each sensor once", 2),
        (["--port", "{link}", "--rate", "0"], "--rate is 0; use a number from", 2),
        (["--port", "{link}", "--temperature", "99"], "--temperature is 99; use a number from -40 to 60", 2),
        ([], "Missing option '--port'", 2),
    ],
)
def test_capture_command_reports_errors_in_one_line(tmp_path, sensor, arguments, message, code):
    found, lines, err = run(tmp_path, *(each.replace("{link}", str(sensor.link)) for each in arguments))
    assert (found, lines) == (code, [])
    assert message in err
    assert len(err.splitlines()) == 1, err
    assert not list(tmp_path.glob("*.h5*"))


def test_capture_command_does_not_overwrite_a_leftover_journal(tmp_path, sensor):
    left = tmp_path / "rec.h5.journal"
    left.write_bytes(b"anything")
    code, _, err = run(tmp_path, "--port", str(sensor.link), "-n", "1", "-o", "rec.h5", "--force")
    assert code == 1
    assert "ertis import journals" in err
    assert left.read_bytes() == b"anything"


def test_capture_command_reports_a_silent_sensor_in_one_line(tmp_path, sensor):
    sensor.quirks = Quirks(silent=True)
    code, _, err = run(tmp_path, "--port", str(sensor.link), "-n", "1")
    assert code == 1
    assert len(err.splitlines()) == 1
