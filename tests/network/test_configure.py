"""New settings for sensors in a network: requests of admins, and captures that apply them between measurements."""

import contextlib
import io
import json
import signal
import subprocess
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba.base.errors import ArgumentError, NetworkError, RefusedError, SonarError
from ertis_numba.chain.memory import require_images
from ertis_numba.devices.capture import CaptureSession, SettingsChange
from ertis_numba.devices.driver import SonarDriver
from ertis_numba.devices.emulator import Emulator, Quirks, SyncChain
from ertis_numba.devices.setup import Setup
from ertis_numba.journal import Journal
from ertis_numba.network import messages
from ertis_numba.network.allow_list import AllowList, Permission
from ertis_numba.network.central_client import CentralClient
from ertis_numba.network.keys import ClientKeys, KeyPair, ServerKeys
from ertis_numba.network.sensor_node import SensorNode
from ertis_numba.settings import Air, Processing, Recording, Settings
from ertis_numba.storage import open_recording
from tests.central import Node, running
from tests.emulated import N_SAMPLES, PATIENT, PATIENT_ERTIS, WORDS, patient
from tests.journals import ENVIRONMENT, TINY, entries
from tests.network.test_capture_to import command
from tests.network.test_central_images import Images
from tests.pages import page, python_in
from tests.sending import until

SETTINGS = Settings(recording=Recording(n_samples=N_SAMPLES), processing=Processing(range_m=(0.1, 0.5)))
WARM = SETTINGS.replace(air=Air(temperature_c=31.5))
__all__ = ["patient"]  # A fixture, imported for use here.

LONGER = SETTINGS.replace(recording=Recording(n_samples=2 * N_SAMPLES))
IMPOSSIBLE = SETTINGS.replace(recording=Recording(n_samples=N_SAMPLES // 2))
"""Settings that the serial protocol cannot express."""

SOON_S = 60.0


class Session:
    """A capture session of emulated sensors in a thread; its sink is a sensor node."""

    def __init__(self, stack, folder, *, names=("one",), **options):
        self.emulators = [stack.enter_context(Emulator(WORDS, name=name, link=folder / name)) for name in names]
        self.sonars = {name: stack.enter_context(SonarDriver.open(str(folder / name))) for name in names}
        self.sink = stack.enter_context(SensorNode("tcp://127.0.0.1:9"))
        self.stored, self._more = [], threading.Condition()
        self.fails = set()
        self.before_settings = {}  # Functions to call before a driver is configured.
        for name in names:
            self.configure(name, SETTINGS)
        options = {"trigger": "command", "rate_hz": 20.0, "configure": self.configure} | options
        self.session = CaptureSession(self.sonars, SETTINGS, on_stored=self._store, **options)
        self.thread = threading.Thread(target=self._run)
        self.error = None

    def configure(self, name, settings):
        self.before_settings.get(settings, lambda: None)()
        if name in self.fails:
            self.fails.remove(name)
            raise SonarError(f"{name} does not answer")
        self.sonars[name].configure(Setup.of(settings))

    def _run(self):
        try:
            self.session.run(self.sink)
        except Exception as error:  # noqa: BLE001  the test looks at it
            self.error = error

    def _store(self, taken):
        with self._more:
            self.stored += taken
            self._more.notify_all()

    def __enter__(self):
        self.thread.start()
        return self

    def __exit__(self, *_):
        self.session.stop()
        self.thread.join()

    def wait_for(self, condition):
        with self._more:
            assert self._more.wait_for(lambda: condition(self.stored), SOON_S), len(self.stored)

    def change(self, settings):
        """Request settings, and return the error of the change, None after success."""
        answered, result = threading.Event(), []
        self.session.change(SettingsChange(settings, lambda error: (result.append(error), answered.set())))
        assert answered.wait(SOON_S), self.error
        return result[0]


@pytest.fixture
def sessions(tmp_path):
    with contextlib.ExitStack() as stack:
        yield lambda **options: Session(stack, tmp_path, **options)


def by_settings(stored):
    """Sequence numbers of each sensor and session, with its settings, in order."""
    found = {}
    for entry in stored:
        stamp = entry.measurement.stamp
        found.setdefault((stamp.sensor, stamp.session_id), (entry.measurement.settings, []))[1].append(stamp.sequence)
    return list(found.values())


@PATIENT
@pytest.mark.parametrize("settings", [WARM, LONGER], ids=["air", "length"])
def test_session_applies_new_settings_between_measurements(sessions, settings):
    with sessions() as run:
        run.wait_for(lambda stored: len(stored) >= 2)
        assert run.change(settings) is None
        run.wait_for(lambda stored: sum(entry.measurement.settings == settings for entry in stored) >= 3)
    (former, before), (new, after) = by_settings(run.stored)
    assert (former, new) == (SETTINGS, settings)
    assert before == list(range(len(before)))
    assert after == list(range(len(after)))
    assert {len(entry.measurement.data) for entry in run.stored[-3:]} == {settings.recording.n_samples}
    assert run.session.counts["one"].stored == len(run.stored)
    assert run.session.counts["one"].lost == 0
    assert run.error is None


def test_number_of_measurements_includes_those_before_a_change(sessions):
    with sessions(n=6) as run:
        run.wait_for(lambda stored: len(stored) >= 2)
        assert run.change(WARM) is None
        run.thread.join(SOON_S)
        assert not run.thread.is_alive()
    assert len(run.stored) == run.session.counts["one"].stored == 6


def test_recording_refuses_new_settings_and_goes_on(sessions, tmp_path):
    """A journal becomes a recording, which has one set of settings for each sensor."""
    run = sessions()
    with Journal.create(tmp_path / "rec.h5.journal", target="rec.h5") as run.sink, run:
        run.wait_for(lambda stored: len(stored) >= 2)
        assert "is in" in str(run.change(WARM))
        count = len(run.stored)
        run.wait_for(lambda stored: len(stored) >= count + 2)
    assert {entry.measurement.settings for entry in run.stored} == {SETTINGS}


@pytest.mark.alone
def test_synchronised_sensors_are_armed_again(sessions):
    run = sessions(names=("one", "two"), trigger="sync", n=12)
    with SyncChain(run.emulators, rate_hz=10.0), run:
        run.wait_for(lambda stored: len(stored) >= 4)
        assert run.change(LONGER) is None
        run.thread.join(SOON_S)
        assert not run.thread.is_alive()
    settings = [given for given, _ in by_settings(run.stored)]
    assert settings.count(SETTINGS) == settings.count(LONGER) == 2
    assert run.session.complete >= 6
    assert 6 <= max(len(numbers) for _, numbers in by_settings(run.stored)) + 2 <= 12


@pytest.mark.parametrize(
    ("settings", "fails", "reason"),
    [(IMPOSSIBLE, (), "samples"), (WARM, ("two",), "two does not answer")],
    ids=["impossible", "no answer"],
)
def test_refused_settings_leave_all_sensors_as_they_were(sessions, settings, fails, reason):
    with sessions(names=("one", "two")) as run:
        run.wait_for(lambda stored: len(stored) >= 2)
        run.fails.update(fails)
        error = run.change(settings)
        assert isinstance(error, (ArgumentError, SonarError))
        assert reason in str(error)
        count = len(run.stored)
        run.wait_for(lambda stored: len(stored) >= count + 4)
    assert {entry.measurement.settings for entry in run.stored} == {SETTINGS}
    assert run.error is None


def test_sensor_that_is_unplugged_during_a_change_keeps_its_settings(sessions):
    with sessions() as run:
        run.wait_for(lambda stored: len(stored) >= 2)
        run.before_settings[WARM] = run.emulators[0].unplug
        assert isinstance(run.change(WARM), SonarError)
        count = len(run.stored)
        run.emulators[0].replug()
        run.wait_for(lambda stored: len(stored) >= count + 2)
    assert {entry.measurement.settings for entry in run.stored} == {SETTINGS}
    assert run.session.counts["one"].unplugged == 1


@pytest.mark.parametrize("trigger", ["command", "sync"])
def test_change_while_a_sensor_is_unplugged_is_refused_and_the_others_go_on(sessions, trigger):
    run = sessions(names=("one", "two"), trigger=trigger)
    with contextlib.ExitStack() as stack:
        if trigger == "sync":
            stack.enter_context(SyncChain(run.emulators, rate_hz=10.0))
        stack.enter_context(run)
        run.wait_for(lambda stored: len(stored) >= 4)
        run.emulators[1].unplug()
        count = len(run.stored)
        run.wait_for(lambda stored: len(stored) >= count + 4)  # Its reader waits for it meanwhile.
        assert "unplugged" in str(run.change(WARM))
        count = len(run.stored)
        run.wait_for(lambda stored: len(stored) >= count + 2)
        run.emulators[1].replug()
        run.wait_for(lambda stored: any(entry.measurement.stamp.sensor == "two" for entry in stored[count:]))
    assert {entry.measurement.settings for entry in run.stored} == {SETTINGS}
    assert run.error is None


def test_sensor_that_does_not_answer_is_configured_again_later(sessions):
    with sessions(names=("one", "two")) as run:
        run.wait_for(lambda stored: len(stored) >= 4)
        run.fails = ["two", "two"]  # also when the former settings are restored
        assert "two does not answer" in str(run.change(WARM))
        count = len(run.stored)
        run.wait_for(lambda stored: any(entry.measurement.stamp.sensor == "two" for entry in stored[count:]))
    assert {entry.measurement.settings for entry in run.stored} == {SETTINGS}
    assert run.error is None


def test_failed_change_names_its_sensor_and_reason_also_when_repeated(sessions):
    with sessions(names=("one", "two")) as run:
        run.wait_for(lambda stored: len(stored) >= 4)
        run.fails = ["two"] * 20  # also while the former settings are restored
        for _ in range(2):
            error = run.change(WARM)
            assert str(error) == "sensor two: two does not answer"


def test_silent_sensor_is_not_reported_as_unplugged(sessions):
    with sessions(names=("one", "two")) as run:
        run.wait_for(lambda stored: len(stored) >= 4)
        run.emulators[1].quirks = Quirks(silent=True)
        for _ in range(2):
            error = str(run.change(WARM))
            assert error.startswith("sensor two: /dev/")
            assert "unplugged" not in error
            assert "answer" in error


def test_change_of_an_ended_session_is_refused(sessions):
    with sessions(n=1) as run:
        run.thread.join(SOON_S)
        with pytest.raises(SonarError, match="the capture has ended; start it again"):
            run.session.change(SettingsChange(WARM))
    with pytest.raises(ArgumentError, match="create it with configure"):
        CaptureSession(run.sonars, SETTINGS, trigger="command").change(SettingsChange(WARM))


# The network


@pytest.fixture(scope="module")
def words():
    """Three measurements cut from one simulated measurement, so that their bits are accepted."""
    with open_recording("data/synthetic/reflectors.h5") as recording:
        whole = recording[0].data
    return [np.ascontiguousarray(whole[start : start + N_SAMPLES]) for start in range(0, 3 * N_SAMPLES, N_SAMPLES)]


@pytest.fixture
def sensors(tmp_path, words):
    (tmp_path / "settings.toml").write_text(SETTINGS.to_toml())
    (tmp_path / "warm.toml").write_text(WARM.to_toml())
    (tmp_path / "impossible.toml").write_text(IMPOSSIBLE.to_toml())
    with (
        Emulator(words, name="one", link=tmp_path / "one") as one,
        Emulator(words[::-1], name="two", link=tmp_path / "two") as two,
    ):
        yield one, two


@contextlib.contextmanager
def capturing(tmp_path, address, *arguments):
    """Run ``ertis capture`` of both sensors, and yield its process once it stores measurements of both."""
    line = [*PATIENT_ERTIS, *command(tmp_path, "--to", address, *arguments, ports=("one", "two"))]
    with subprocess.Popen(
        line, cwd=tmp_path, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            lines = (json.loads(line) for line in process.stdout)
            missing = {"one", "two"}
            while missing:
                event = next(lines)
                missing -= {event["sensor"]} if event["event"] == "acked_through" else set()
            process.lines = lines
            yield process
        finally:
            process.kill()


def configure(tmp_path, *arguments):
    with contextlib.chdir(tmp_path):
        done = CliRunner().invoke(cli, ["sensors", "configure", *map(str, arguments)])
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return done


def ended(process):
    """Interrupt a capture, and return its remaining events and its stderr."""
    process.send_signal(signal.SIGINT)
    events = list(process.lines)
    assert process.wait(SOON_S) == 0
    return events, process.stderr.read()


@pytest.mark.usefixtures("sensors")
def test_command_configures_all_sensors_of_a_capture(tmp_path):
    (tmp_path / "archive").mkdir()
    with running(tmp_path / "archive") as central, capturing(tmp_path, central.address) as process:
        done = configure(tmp_path, central.address, "two", "--settings", "warm.toml", "--json")
        assert (done.exit_code, json.loads(done.stdout)) == (0, {"configured": ["one", "two"]}), done.output
        kept = 0
        for event in process.lines:
            kept += event["event"] == "acked_through" and event["acked_through"] >= 1
            if kept >= 4:
                break
        events, err = ended(process)
    assert "two: new settings, requested by an admin" in err
    assert events[-1]["event"] == "captured"
    assert (events[-1]["lost"], events[-1]["unacked"]) == (0, 0)
    assert {"event": "configure", "sensor": "two", "text": "new settings requested by key loopback"} in central.events
    found = {"one": set(), "two": set()}
    for path in (tmp_path / "archive").glob("*.journal"):
        with Journal.open(path) as journal:
            for entry in journal.entries():
                stamp = entry.measurement.stamp
                found[stamp.sensor].add(entry.measurement.settings.air.temperature_c)
    assert found == {"one": {20.0, 31.5}, "two": {20.0, 31.5}}


@pytest.mark.usefixtures("sensors")
def test_command_reports_settings_that_the_sensors_cannot_have(tmp_path):
    (tmp_path / "archive").mkdir()
    with running(tmp_path / "archive") as central, capturing(tmp_path, central.address) as process:
        done = configure(tmp_path, central.address, "one", "--settings", "impossible.toml")
        events, err = ended(process)
    assert done.exit_code == 1
    assert done.stderr.startswith("ertis: error: sensor one keeps its settings: ")
    assert "one: new settings were refused: " in err
    assert (events[-1]["lost"], events[-1]["unacked"]) == (0, 0)


@pytest.mark.usefixtures("sensors")
def test_capture_with_fixed_settings_refuses_new_ones(tmp_path):
    (tmp_path / "archive").mkdir()
    with (
        running(tmp_path / "archive") as central,
        capturing(tmp_path, central.address, "--fixed-settings") as process,
        CentralClient(central.address) as admin,
    ):
        with pytest.raises(RefusedError, match="does not accept settings; start it without --fixed-settings"):
            admin.configure("one", WARM, SOON_S)
        with pytest.raises(RefusedError, match=r"no sensor node sends sensor three; start 'ertis capture --to'"):
            admin.configure("three", WARM, SOON_S)
        ended(process)


@pytest.mark.usefixtures("sensors")
def test_code_of_the_network_page_configures_a_sensor(tmp_path):
    _, code = python_in(page("network"))
    (tmp_path / "archive").mkdir()
    with running(tmp_path / "archive") as central, capturing(tmp_path, central.address) as process:
        reported = io.StringIO()
        with contextlib.redirect_stdout(reported):
            exec(code.replace("tcp://127.0.0.1:5601", central.address).replace("front", "one"), {})
        assert float(reported.getvalue()) >= 0
        ended(process)


def test_command_without_settings_is_refused(tmp_path):
    done = configure(tmp_path, "tcp://127.0.0.1:1", "one", "--temperature", "25")
    assert done.exit_code == 2
    assert "all settings of the sensor are replaced; add --preset or --settings" in done.stderr


def test_only_admins_may_change_settings(tmp_path):
    pairs = {name: KeyPair.new(name) for name in ("central", "robot", "viewer", "admin")}
    AllowList(
        keys=(
            Permission(name="robot", public=pairs["robot"].public, role="sensor", serials=("front",)),
            Permission(name="viewer", public=pairs["viewer"].public, role="application"),
            Permission(name="admin", public=pairs["admin"].public, role="admin"),
        )
    ).save(tmp_path / "allow.toml")
    requests = []

    def accept(request):
        requests.append(request)
        request.accept(["front"])

    given = ServerKeys(pairs["central"], tmp_path / "allow.toml")
    keys = {name: ClientKeys(pair, pairs["central"].public) for name, pair in pairs.items()}
    (tmp_path / "archive").mkdir()
    with (
        running(tmp_path / "archive", keys=given) as central,
        SensorNode(central.address, keys=keys["robot"], on_settings=accept) as node,
    ):
        node.add_sensor("front", TINY)
        node.append(entries(1, sensor="front"))
        assert node.flush(SOON_S)
        for name in ("robot", "viewer"):
            with (
                CentralClient(central.address, keys=keys[name]) as client,
                pytest.raises(RefusedError, match=r"has the role \w+, which may not change settings"),
            ):
                client.configure("front", WARM, SOON_S)
        assert not requests
        with CentralClient(central.address, keys=keys["admin"]) as client:
            assert client.configure("front", WARM, SOON_S) == ("front",)
    assert [(request.sensor, request.settings.air) for request in requests] == [("front", WARM.air)]


@contextlib.contextmanager
def answering(tmp_path, on_settings, **options):
    """Run a central node and a sensor node, and yield a client."""
    (tmp_path / "archive").mkdir()
    with (
        running(tmp_path / "archive", **options) as central,
        SensorNode(central.address, on_settings=on_settings) as node,
        CentralClient(central.address) as client,
    ):
        node.add_sensor("front", TINY)
        node.append(entries(1, sensor="front"))
        assert node.flush(SOON_S)
        client.address = central.address
        yield client


def test_settings_beyond_the_limit_of_the_central_node_are_refused(tmp_path):
    requests = []
    with (
        answering(tmp_path, requests.append, max_bytes=65_536) as client,
        pytest.raises(RefusedError, match=r"131072 bytes, but the central node accepts at most 65536; record"),
    ):
        client.configure("front", SETTINGS, SOON_S)
    assert not requests


def test_request_without_an_answer_ends_with_its_timeout(tmp_path):
    requests = []
    with answering(tmp_path, requests.append) as client:
        with pytest.raises(NetworkError, match=r"sensor node of front did not answer within 1 s, and may"):
            client.configure("front", WARM, 1.0)
        until(lambda: requests)
    assert len(requests) == 1


class RequiringImages(Images):
    """A stand-in for image processing that requires what a real one does."""

    def require_usable(self, settings):
        require_images(settings)


FAR = SETTINGS.replace(processing=Processing(range_m=(0.1, 50.0)))
LARGE = SETTINGS.replace(processing=Processing(range_m=(0.1, 0.5), directions="3d:1000000"))


@pytest.mark.parametrize(
    ("settings", "reason"),
    [(FAR, "range_m ends at 50 m, but the record"), (LARGE, "images of 3d:1000000 over")],
    ids=["beyond the record", "too large"],
)
def test_settings_without_an_image_are_refused_by_a_central_node_that_computes_images(tmp_path, settings, reason):
    requests = []

    def accept(request):
        requests.append(request)
        request.accept(["front"])

    with answering(tmp_path, accept, processing=RequiringImages()) as client:
        expected = (
            f"sensor front keeps its settings: no image could be computed from measurements with them: .*{reason}"
        )
        with pytest.raises(RefusedError, match=expected):
            client.configure("front", settings, SOON_S)
        assert not requests
        assert client.configure("front", WARM, SOON_S) == ("front",)


def test_settings_without_an_image_are_possible_for_recordings_with_a_warning(tmp_path):
    (tmp_path / "far.toml").write_text(FAR.to_toml())
    with answering(tmp_path, lambda request: request.accept(["front"])) as client:
        done = configure(tmp_path, client.address, "front", "--settings", "far.toml")
    assert (done.exit_code, done.stdout) == (0, "configured: front\n")
    assert done.stderr.startswith(
        "ertis: warning: images of these measurements need other settings: processing.range_m ends at 50 m"
    )


def test_dry_run_warns_of_settings_without_an_image(tmp_path):
    (tmp_path / "far.toml").write_text(FAR.to_toml())
    done = CliRunner().invoke(cli, ["capture", "--port", "x", "--dry-run", "--settings", str(tmp_path / "far.toml")])
    assert done.exit_code == 0, done.output
    assert "warning: images of these measurements need other settings: processing.range_m ends at 50 m" in done.stderr


@pytest.mark.parametrize("says_bye", [True, False])
def test_request_ends_at_once_if_the_sensor_node_leaves(tmp_path, says_bye):
    (tmp_path / "archive").mkdir()
    with running(tmp_path / "archive") as central, CentralClient(central.address) as client:
        with Node(central.address) as node:
            node.hello("front")
            answer = ThreadPoolExecutor(1).submit(client.configure, "front", TINY, 2 * SOON_S)
            node.hear(messages.Configure)
            if says_bye:
                node.send(messages.Bye())
                error = answer.exception(SOON_S)
        if not says_bye:  # The connection has ended without a message.
            error = answer.exception(SOON_S)
    assert isinstance(error, RefusedError)
    assert str(error).startswith("sensor front keeps its settings: its sensor node has left before it answered; start")


def test_arguments_of_configure_are_validated(tmp_path):
    with answering(tmp_path, None) as client:
        for arguments, message in (
            ((3, SETTINGS), "sensor is of type int; pass the name of a sensor"),
            (("front", "short_25_50"), "settings is of type str; pass a Settings, which"),
            (("front", None), "settings is of type NoneType"),
            (("front", SETTINGS, float("nan")), "patience_s is nan; use a finite number"),
            (("front", SETTINGS, "long"), "patience_s is 'long'; use a number"),
        ):
            with pytest.raises(ArgumentError, match=message):
                client.configure(*arguments)
        with pytest.raises(ArgumentError, match="patience_s is 0; use a number above 0"):
            client.status(0)
    with pytest.raises(ArgumentError, match="keys is of type str; pass a ClientKeys"):
        CentralClient("tcp://127.0.0.1:5601", keys="mine")
    with pytest.raises(ArgumentError, match="address 5601 cannot be used"):
        CentralClient(5601)


def test_threads_share_a_client(tmp_path):
    def configured(number):
        if number % 2:
            return client.status(SOON_S).sensors["front"].received
        return client.configure("front", WARM, SOON_S)

    with answering(tmp_path, lambda request: request.accept(["front"])) as client, ThreadPoolExecutor(8) as threads:
        answers = list(threads.map(configured, range(60)))
    assert answers == [("front",), 1] * 30


def test_client_that_is_closed_ends_the_request_of_another_thread(tmp_path):
    requests = []
    with answering(tmp_path, requests.append) as client, ThreadPoolExecutor(1) as thread:
        answer = thread.submit(client.configure, "front", WARM, 2 * SOON_S)
        until(lambda: requests)
        client.__exit__(None, None, None)
        assert "is not open" in str(answer.exception(SOON_S))


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"[array]\nlayout = '/etc/passwd'", "the name of a file"),
        (b"n = ", "settings for sensor front"),
        (b"\xff", "not text"),
    ],
    ids=["file", "broken", "bytes"],
)
def test_hostile_settings_are_refused_by_the_sensor_node(tmp_path, payload, reason):
    requests = []
    with answering(tmp_path, requests.append) as client, Node(client.address) as admin:
        admin.send(messages.Configure(sensor="front", request_id=5), payload)
        answer = admin.hear()
    assert isinstance(answer, messages.Configured)
    assert (answer.request_id, answer.sensors) == (5, ())
    assert reason in answer.error
    assert not requests


@pytest.mark.parametrize("payload", [(), (b"a", b"b"), (b"x" * (Settings.max_bytes + 1),)], ids=["none", "two", "long"])
def test_request_without_one_settings_text_is_refused_by_the_central_node(tmp_path, payload):
    with answering(tmp_path, None) as client, Node(client.address) as admin:
        admin.send(messages.Configure(sensor="front", request_id=5), *payload)
        answer = admin.hear()
    assert isinstance(answer, messages.Refused)
    assert (answer.code, answer.sensor) == ("settings", "front")


def test_answer_without_a_request_is_ignored(tmp_path):
    with answering(tmp_path, None) as client, Node(client.address) as node:
        node.send(messages.Configured(sensor="front", request_id=7, sensors=("front",)))
        node.send(messages.Ping())
        assert isinstance(node.hear(), messages.Pong)
        assert client.status().refused == {}


def test_requests_with_no_answer_are_limited(tmp_path):
    with answering(tmp_path, lambda _: None) as client, Node(client.address) as admin:
        for number in range(65):
            admin.send(messages.Configure(sensor="front", request_id=number), TINY.to_toml().encode())
        answer = admin.hear()
    assert isinstance(answer, messages.Refused)
    assert answer.code == "size"
    assert "64 requests for settings have no answer yet" in answer.reason


def test_payload_of_new_settings_contains_no_file_names(tmp_path):
    """A layout from a file is sent as positions."""
    np.savetxt(tmp_path / "own.csv", np.random.default_rng(1).uniform(-50.0, 50.0, (32, 3)), delimiter=",")
    requests = []

    def accept(request):
        requests.append(request)
        request.accept(["front"])

    with answering(tmp_path, accept) as client:
        done = configure(tmp_path, client.address, "front", "--preset", "short_25_50", "--layout", "own.csv")
    assert done.exit_code == 0, done.output
    assert done.stdout == "configured: front\n"
    assert len(requests[0].settings.array.positions_m) == 32
