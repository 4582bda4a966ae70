"""Settings from other machines and files are bounded in size, depth and memory, and name no files."""

import itertools
import threading
import time
import zlib

import pytest

from ertis_numba.base.errors import ArgumentError, SettingsError
from ertis_numba.chain import memory
from ertis_numba.chain.memory import predicted_bytes
from ertis_numba.geometry import received_settings, storable
from ertis_numba.network.central_node import _validation
from ertis_numba.network.central_node._admission import Unwanted
from ertis_numba.network.central_node._intake import Intake
from ertis_numba.network.central_node._validation import Greeting, Greetings
from ertis_numba.network.messages import Ack, Hello, Refused, Welcome
from ertis_numba.network.processing.shared_pipeline import SharedPipeline
from ertis_numba.settings import MAX_CALL_SAMPLES, Array, Call, Processing, Recording, Settings
from ertis_numba.settings.documents import MAX_KEY_PARTS
from tests.central import Node, running, stored
from tests.faults.network import all_trials as faults, hostile, table
from tests.faults.network.hostile_hellos import hostile_texts
from tests.journals import TINY, entries


def test_from_toml_names_the_line_after_thousands_of_blank_lines():
    """Formerly each line caused a parse of all lines before it: 25,000 lines took 36 s."""
    begun_s = time.process_time()
    with pytest.raises(SettingsError, match="s, line 25001: unknown key `bogus`"):
        Settings.from_toml("\n" * 25_000 + "bogus = 1\n", "s")
    with pytest.raises(SettingsError, match="s: unknown key `bogus`"):
        Settings.from_toml("\n" * 25_000 + "bogus = 1\n", "s", find_line=False)
    assert time.process_time() - begun_s < 2


@pytest.mark.parametrize(
    "text",
    [
        f"a{'.a' * MAX_KEY_PARTS} = 1",
        f"[a{' . a' * MAX_KEY_PARTS}]",
        f"x = {{ 'a'{'.a' * MAX_KEY_PARTS} = 1 }}",
        f"a{'.a' * 32_000} = 1",
    ],
)
def test_from_toml_refuses_keys_of_many_parts(text):
    with pytest.raises(SettingsError, match=f"line 2: a dotted key has more than {MAX_KEY_PARTS} parts; use fewer"):
        Settings.from_toml(f"\n{text}\n")


def test_from_toml_accepts_many_numbers_in_a_line():
    array = Array(positions_m=tuple((0.001 * n, 0.002 * n, 0.0) for n in range(1024)))
    text = f"[array]\npositions_m = {[list(each) for each in array.positions_m or ()]}\n"
    assert Settings.from_toml(text).array == array
    assert received_settings(Settings(array=array).to_toml(), "s").array == array


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("x = " + "9" * 5000, "Exceeds the limit .*; use a shorter number"),
        ("x = " + "[" * 5000, "nested too deeply"),
        ("\n" * 30_001, "30001 lines and commas; the limit is 30000"),
        (f"x = [{'1,' * 30_001}]", "30001 lines and commas; the limit is 30000"),
        ("#" * (Settings.max_bytes + 1), f"{Settings.max_bytes + 1} bytes; the limit is {Settings.max_bytes}"),
        ("#" + "é" * (Settings.max_bytes // 2), f"{Settings.max_bytes + 1} bytes; the limit is {Settings.max_bytes}"),
    ],
)
def test_from_toml_refuses_texts_that_are_slow_to_parse(text, match):
    with pytest.raises(SettingsError, match=match):
        Settings.from_toml(text)


@pytest.mark.parametrize(("duration_s", "rate_hz"), [(1.0, 1e300), (1.0, 5e7), (0.01, 2e8)])
def test_call_refuses_too_many_samples(duration_s, rate_hz):
    with pytest.raises(ArgumentError, match=rf"call has \d+ samples .*; the limit is {MAX_CALL_SAMPLES}. Shorten"):
        Call(duration_s=duration_s, sample_rate_hz=rate_hz)


@pytest.mark.parametrize("table", [Array, Processing])
def test_names_in_settings_have_a_maximum_length(table):
    """An HDF5 attribute has at most 64 kB, and a longer layout once prevented the sealing of a journal."""
    name = "layout" if table is Array else "directions"
    with pytest.raises(ArgumentError, match=f"{name} has 5000 characters; the limit is 4096"):
        table(**{name: "x" * 5000})


def test_received_settings_refuse_all_hostile_texts_within_a_second():
    slowest_s = 0.0
    for name, text in itertools.islice(hostile_texts(), 0, None, 3):
        begun_s = time.process_time()
        with pytest.raises(ArgumentError):
            _take(name, text)
        slowest_s = max(slowest_s, time.process_time() - begun_s)
    assert slowest_s < 1


def _take(name, text):
    settings = received_settings(text, name)
    if settings.recording.n_samples > 2**20:  # whose measurements are longer than a central node takes
        raise ArgumentError("too long")


@pytest.mark.parametrize("directions", ["/x.csv", "/x.csv/", "x.CSV", "~/x.csv", "..\\x.csv", "x", "", "/etc/passwd"])
def test_received_settings_name_no_file(directions):
    settings = Settings(processing=Processing(directions=directions))
    with pytest.raises(SettingsError, match=r"s: processing.directions is .*, the name of a file; name a grid instead"):
        received_settings(settings.to_toml(), "s")
    assert received_settings(settings.to_toml(), "s", are_applied=True) == settings
    with pytest.raises(ArgumentError, match="a recording cannot contain directions"):
        storable(settings)


@pytest.mark.parametrize("layout", ["/x.csv", "x.toml", "eRTIS_v3D1.toml", "../eRTIS_v3D1"])
def test_received_settings_name_no_layout_file(layout):
    with pytest.raises(SettingsError, match=r"s: array.layout is .*, the name of a file; send its positions instead"):
        received_settings(Settings(array=Array(layout=layout)).to_toml(), "s")


@pytest.mark.parametrize(
    ("changes", "megabytes"),
    [
        ({"processing": Processing(directions="3d:1000000", range_m=(0.5, 0.6))}, 5009),
        (
            {
                "processing": Processing(directions="2d:1", range_m=(0.0, 0.1), range_decimation=1, decimation=1),
                "recording": Recording(sample_rate_hz=1e9, n_samples=1_000_000),
            },
            3978,
        ),
    ],
)
def test_workers_refuse_settings_that_need_too_much_memory(changes, megabytes):
    settings = Settings().replace(**changes)
    assert predicted_bytes(settings) / 1e6 == pytest.approx(megabytes, rel=0.02)
    with pytest.raises(ArgumentError, match=r"needs about \d+ MB; the limit is 1000 MB. Use fewer directions"):
        SharedPipeline(settings.to_toml(), "cpu")
    assert predicted_bytes(Settings()) < memory.MAX_BYTES / 100


def test_pipeline_limits_the_tables_of_its_plan(monkeypatch):
    monkeypatch.setattr(memory, "MAX_BYTES", predicted_bytes(Settings()) + 1000)
    with pytest.raises(ArgumentError, match="no plan fits into memory"):
        SharedPipeline(Settings().to_toml(), "numpy")


# The central node


class _Frame:
    def __init__(self, content):
        self.bytes = content


def _greeting(peer, size=1):
    hello = Hello(sensor="left", session_id=1, next_sequence=0, settings_crc32=0)
    return Greeting([_Frame(peer)], hello, [bytes(size)], "")


def test_hello_messages_of_peers_take_turns():
    """One node with hundreds of hello messages must not delay another."""
    goes, order = threading.Event(), []

    def read(_, payload):
        assert goes.wait(60)
        order.append(len(payload[0]))

    greetings = Greetings(read)
    greetings.open()
    for _ in range(5):
        greetings.offer(_greeting(b"a", 1))
    greetings.offer(_greeting(b"b", 2))
    goes.set()
    deadline_s = time.monotonic() + 60
    while len(order) < 6 and time.monotonic() < deadline_s:
        threading.Event().wait(0.001)
    greetings.close()
    assert order.index(2) <= 2


def test_number_of_waiting_hello_messages_is_limited(monkeypatch):
    monkeypatch.setattr(_validation, "MAX_WAITING_OF_PEER", 3)
    monkeypatch.setattr(_validation, "MAX_WAITING_BYTES", 1000)
    greetings = Greetings(lambda *_: None)
    for _ in range(3):
        greetings.offer(_greeting(b"a"))
    with pytest.raises(Unwanted, match="too many hellos are waiting; send hello again in a few seconds"):
        greetings.offer(_greeting(b"a"))
    with pytest.raises(Unwanted, match="too many hellos are waiting"):
        greetings.offer(_greeting(b"b", 998))
    greetings.forget(b"a")
    greetings.offer(_greeting(b"b", 998))


def test_central_node_acknowledges_others_during_a_long_hello(tmp_path, monkeypatch):
    given = entries(2)
    text = b"x = [" + b"[1111]," * 29_000 + b"]\n"
    read, begun, acknowledged = Intake.read, threading.Event(), threading.Event()

    def read_slowly(intake, hello, payload):
        if hello.sensor == "bad":
            begun.set()
            assert acknowledged.wait(60)
        return read(intake, hello, payload)

    monkeypatch.setattr(Intake, "read", read_slowly)
    with running(tmp_path) as central, Node(central.address) as node, Node(central.address) as other:
        assert isinstance(node.hello(), Welcome)
        node.measure(given[0])
        node.hear_settled(10)
        hello = Hello(sensor="bad", session_id=1, next_sequence=0, settings_crc32=zlib.crc32(text))
        for _ in range(4):
            other.send(hello, text)
        assert begun.wait(60)
        node.measure(given[1])
        node.hear_settled(11)
        acknowledged.set()
        answers = [other.hear(Refused) for _ in range(4)]
    assert all("unknown key `x`" in answer.reason for answer in answers)


@pytest.mark.parametrize("directions", ["/etc/passwd.csv/", "/dev/stdin", "2d:1000000000"])
def test_hello_that_names_a_file_is_refused(tmp_path, directions):
    settings = TINY.replace(processing=TINY.processing.replace(directions=directions))
    with running(tmp_path) as central, Node(central.address) as node:
        answer = node.hello(settings=settings)
        assert isinstance(answer, Refused)
        assert answer.code == "settings"
        node.measure(*entries(1))
        assert not isinstance(node.hear(), Ack)
    assert stored(tmp_path) == ([], [])


def test_hostile_hello_messages_are_refused(tmp_path):
    found = hostile.hellos(tmp_path, seed=1, count=30, alone_s=0.5)
    assert table.row("hellos", found)
    assert (found["hellos"], found["taken"]) == (30, [])
    assert (found["lost"], found["twice"], found["wrong"], found["tracebacks"]) == (0, 0, 0, 0)
    assert found["stored"] == found["promised"] > 0
    assert found["memory grew, MB"] < 200
    assert (found["flushed"], found["exit code"]) == (True, 0)
    assert faults.LONG.n_hellos + faults.LONG.n_files > 200


def test_hostile_files_are_refused(tmp_path):
    found = hostile.files(tmp_path, count=8)
    assert table.row("files", found)
    assert found["reads"] == 3 * found["files"] == 24
    assert (found["taken"], found["failed"], found["crashes"]) == ([], [], [])
    assert found["memory grew, MB"] < 200
