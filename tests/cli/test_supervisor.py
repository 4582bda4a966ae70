"""Central nodes ended by a signal: the command restarts them, and no acknowledged measurement is lost."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from ertis_cli._supervisor import Life

from tests.central import Node, stored, wanted
from tests.journals import ENVIRONMENT, entries
from tests.network.test_record import Recording
from tests.network.test_serve import LOOPBACK, TIMEOUT_S, is_gone, serving

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="central nodes are supervised on Linux")

AT_START = "import os, sys\nif 'record' in sys.argv:\n    os.register_at_fork(after_in_child=lambda: {})\n"


def environment_with(folder, action):
    """Variables that make each process of a central node run code at its start."""
    (folder / "sitecustomize.py").write_text(AT_START.format(action))
    return ENVIRONMENT | {"PYTHONPATH": os.pathsep.join([str(folder), ENVIRONMENT["PYTHONPATH"]])}


def until(condition):
    end_s = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < end_s, "it has not happened"
        time.sleep(0.01)


def test_record_restarts_at_its_address_without_losing_acknowledged_measurements(tmp_path):
    given = entries(15, first=0)
    with Recording(tmp_path) as central:
        pid, restarted = central.started["pid"], []
        for first, number in ((0, signal.SIGABRT), (5, signal.SIGKILL), (10, signal.SIGTERM)):
            with Node(central.address) as node:
                assert node.hello(first=first).acked_through == first - 1
                node.measure(*given[first : first + 5])
                assert node.hear_settled(first + 4).acked_through == first + 4
                if number == signal.SIGTERM:
                    break
                os.kill(pid, number)
                restarted.append(central.event("restarted"))
                listening = central.event("listening")
                assert listening["address"] == central.address
                pid = listening["pid"]
        central.process.send_signal(signal.SIGTERM)
        reported = central.event("recorded")
        assert central.process.wait() == 0
    assert restarted == [
        {"event": "restarted", "restarts": restarts, "reason": reason}
        for restarts, reason in ((1, "SIGABRT"), (2, "SIGKILL"))
    ]
    assert reported["restarts"] == 2
    assert sorted(stored(tmp_path)[0]) == sorted(wanted(given))


def test_serve_restarts_with_both_of_its_addresses():
    with serving(*LOOPBACK, "--workers", "1", "--device", "numpy") as served:
        os.kill(served.started["pid"], signal.SIGABRT)
        served.event("restarted")
        again = served.event("listening")
        assert (again["address"], again["publish"]) == (served.listen, served.publish)
        assert again["pid"] != served.started["pid"]
        assert served.end()["restarts"] == 1


def test_node_ends_with_its_supervisor(tmp_path):
    with Recording(tmp_path) as central:
        child = central.started["pid"]
        central.process.kill()
        central.process.wait()
        until(lambda: is_gone(child))


def test_duration_and_output_continue_after_a_restart(tmp_path):
    begun_s = time.monotonic()
    with Recording(tmp_path, "--duration", "5") as central:
        os.kill(central.started["pid"], signal.SIGABRT)
        events = [json.loads(line) for line in central.process.stdout]
        assert central.process.wait() == 0
    assert [event["event"] for event in events] == ["restarted", "listening", "recorded"]
    assert time.monotonic() - begun_s >= 5.0


def test_node_ended_before_listening_is_not_restarted(tmp_path):
    environment = environment_with(tmp_path, "os.abort()")
    command = [sys.executable, "-m", "ertis_cli", "record", "--listen", "tcp://127.0.0.1:0", "-o", str(tmp_path / "a")]
    done = subprocess.run([*command, "--json"], capture_output=True, text=True, check=False, env=environment)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("ertis: error: SIGABRT ended the central node's process before it listened; all ack")


@pytest.mark.parametrize(("end", "reason"), [("os.abort()", "SIGABRT"), ("os._exit(3)", "exit code 3")])
def test_supervisor_fails_after_ten_restarts_in_vain_and_keeps_measurements(end, reason, tmp_path):
    given, broken = entries(3, first=0), tmp_path / "broken"
    environment = environment_with(tmp_path, f"os.path.exists({str(broken)!r}) and {end}")
    with (
        Recording(tmp_path / "a", environment=environment, stderr=subprocess.PIPE) as central,
        central.process.stderr as stderr,
    ):
        with Node(central.address) as node:
            node.hello(first=0)
            node.measure(*given)
            node.hear_settled(2)
            broken.touch()
            os.kill(central.started["pid"], signal.SIGKILL)
            assert central.process.wait(TIMEOUT_S) == 1
        reported = stderr.read()
        assert "restarted" not in central.process.stdout.read()
    failed = f"ertis: error: the central node's process failed to start 10 times in a row ({reason}); all acknowledged"
    assert reported.startswith(failed)
    assert stored(tmp_path / "a")[0] == wanted(given)


def test_node_killed_while_stopping_fails(tmp_path):
    with Recording(tmp_path) as central:
        child = central.started["pid"]
        os.kill(child, signal.SIGSTOP)
        until(lambda: status_of(child)["State"].startswith("T"))
        central.process.send_signal(signal.SIGTERM)
        until(lambda: int(status_of(child)["ShdPnd"], 16) & 1 << signal.SIGTERM - 1)  # it waits for a stopped process
        os.kill(child, signal.SIGKILL)
        assert central.process.wait(TIMEOUT_S) == 1


def status_of(pid):
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return {name: value.strip() for name, _, value in (line.partition(":") for line in lines)}


def test_restarted_process_runs_for_the_rest_of_the_duration():
    assert Life().remaining_s(None) is None
    assert Life(elapsed_s=4.0).remaining_s(10.0) == 6.0
    assert Life(elapsed_s=40.0).remaining_s(10.0) > 0.0


def test_nodes_end_with_a_killed_demo(tmp_path):
    program = (
        "import pathlib, sys, time; from ertis_cli.demo import _DemoRun\n"
        f"run = _DemoRun({ENVIRONMENT!r}, quiet=True)\n"
        "output = pathlib.Path('started.jsonl')\n"
        "with run.node('record', '--listen', 'tcp://127.0.0.1:0', '-o', 'out', '--json', output=output) as node:\n"
        "    print(node['pid'], flush=True)\n"
        "    time.sleep(60)\n"
    )
    command = [sys.executable, "-c", program]
    with subprocess.Popen(command, cwd=tmp_path, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True) as process:
        pid = int(process.stdout.readline())
        process.kill()
    until(lambda: is_gone(pid))
