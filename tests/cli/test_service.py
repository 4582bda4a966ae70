"""Units of systemd for nodes, and the signs of life that its watchdog receives."""

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading

import pytest
from click.testing import CliRunner
from ertis_cli import _watchdog, service
from ertis_cli._watch import Watch
from ertis_cli.main import cli

from tests.journals import ENVIRONMENT

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="systemd runs on Linux")
NODES = {
    "capture": ["--port", "207A3558", "--trigger", "sync", "--to", "tcp://10.0.0.1:5601", "--spool", "my spool"],
    "serve": ["--listen", "tcp://0.0.0.0:5601", "--record", "100 % $HOME"],
    "record": ["-o", "RECORDINGS"],
    "ros": ["tcp://127.0.0.1:5602"],
}
MAX_EXPOSURE = 2.5  # of 10, by systemd-analyze: "OK" begins at 2


def run(*words):
    return CliRunner().invoke(cli, ["sensors", "service", *words])


def files_of(node):
    """Return the files that the command would write, by path."""
    done = run("--dry-run", "--user", "daemon", node, *NODES[node])
    assert done.exit_code == 0, done.output
    parts = re.split(r"^# (/etc/.*)\n", done.stdout, flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def keys_of(unit):
    return dict(re.findall(r"^(\w+)=(.*)$", unit, re.MULTILINE))


def test_unit_runs_the_command_of_the_node_with_its_arguments_quoted_for_systemd(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    keys = keys_of(files_of("serve")["/etc/systemd/system/ertis-serve.service"])
    assert keys["ExecStart"] == (
        f'{service._quoted(sys.executable)} -P -m ertis_cli serve --listen "tcp://0.0.0.0:5601" '  # noqa: SLF001
        '--record "100 %% $$HOME"'
    )
    assert (keys["User"], keys["WorkingDirectory"], keys["Restart"]) == ("daemon", str(tmp_path), "on-failure")


@pytest.mark.parametrize("node", NODES)
def test_systemd_accepts_the_unit_and_rates_its_exposure_as_low(node, tmp_path):
    program = shutil.which("systemd-analyze")
    if program is None:
        pytest.skip("systemd-analyze is not installed")
    (text, *_) = files_of(node).values()
    unit = tmp_path / f"ertis-{node}.service"
    unit.write_text(text)
    verified = subprocess.run([program, "verify", unit], capture_output=True, text=True, check=False)
    about = [line for line in verified.stderr.splitlines() if unit.name in line]
    assert (verified.returncode, about) == (0, []), verified.stderr
    rated = subprocess.run(
        [program, "security", "--offline=true", "--no-pager", unit], capture_output=True, text=True, check=True
    )
    (exposure,) = re.findall(r"Overall exposure level for .*: ([\d.]+)", rated.stdout)
    assert float(exposure) <= MAX_EXPOSURE, rated.stdout


def test_rule_is_for_the_sensors_given_by_serial_number_only():
    rule = files_of("capture")["/etc/udev/rules.d/65-ertis-capture.rules"]
    assert 'ENV{ID_SERIAL_SHORT}=="207A3558", SYMLINK+="ertis/207A3558", GROUP="dialout"' in rule
    assert 'ENV{ID_MM_DEVICE_IGNORE}="1"' in rule
    assert rule.count("SUBSYSTEM") == 1
    assert len(files_of("ros")) == 1


def test_arguments_that_the_node_refuses_are_wrong_usage():
    done = run("--dry-run", "record", "--rotate-size", "large", "-o", "RECORDINGS")
    assert done.exit_code == 2
    assert "'--rotate-size': 'large' is not a valid float" in done.stderr


def test_service_is_installed_and_removed(monkeypatch, tmp_path):
    for name in ("systemctl", "udevadm"):
        (tmp_path / name).write_text(f'#!/bin/sh\necho {name} "$@" >> {tmp_path}/calls\n')
        (tmp_path / name).chmod(0o755)
    for name in ("units", "rules"):
        (tmp_path / name).mkdir()
        monkeypatch.setattr(service, f"_{name.upper()}", tmp_path / name)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    assert run("capture", *NODES["capture"]).exit_code == 0
    assert (tmp_path / "units" / "ertis-capture.service").stat().st_size
    assert (tmp_path / "rules" / "65-ertis-capture.rules").stat().st_size
    assert run("--uninstall", "capture").exit_code == 0
    assert not any(each for name in ("units", "rules") for each in (tmp_path / name).iterdir())
    reload = ["systemctl daemon-reload", "udevadm control --reload", "udevadm trigger --subsystem-match=tty"]
    enable, disable = (f"systemctl {each} --now ertis-capture.service" for each in ("enable", "disable"))
    assert (tmp_path / "calls").read_text().splitlines() == [*reload, enable, disable, *reload]


def test_system_without_systemd_is_an_error(monkeypatch, tmp_path):
    monkeypatch.setattr(service, "_UNITS", tmp_path / "none")
    done = run("record", "-o", "RECORDINGS")
    assert done.exit_code == 1
    assert f"{tmp_path}/none does not exist; use a Linux system that runs systemd" in done.stderr


@pytest.fixture
def systemd(monkeypatch, tmp_path):
    """Return a socket that receives signs of life like systemd's."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as heard:
        heard.bind(str(tmp_path / "notify"))
        heard.settimeout(60)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.setenv("WATCHDOG_USEC", "400000")
        monkeypatch.setattr(_watchdog, "_next_s", 0.0)
        yield heard


def test_central_node_reports_that_it_is_ready_and_lives(systemd, tmp_path):
    notify = {name: os.environ[name] for name in ("NOTIFY_SOCKET", "WATCHDOG_USEC")}
    command = [sys.executable, "-m", "ertis_cli", "record", "--listen", "tcp://127.0.0.1:0", "-o", tmp_path / "out"]
    with subprocess.Popen(command, env=ENVIRONMENT | notify, stderr=subprocess.DEVNULL) as process:
        try:
            assert [systemd.recv(99) for _ in range(2)] == [b"READY=1\nWATCHDOG=1"] * 2
        finally:
            process.send_signal(signal.SIGTERM)


def test_capture_reports_that_it_lives_in_its_loop(systemd):
    watch = Watch(quiet=True, as_json=False)
    watch.tick()
    watch.tick()
    assert systemd.recv(99) == b"READY=1\nWATCHDOG=1"
    systemd.settimeout(0)
    with pytest.raises(BlockingIOError):
        systemd.recv(99)  # the second tick came before the next report was due


def test_loop_that_stands_still_sends_no_sign_of_life(systemd, monkeypatch):
    monkeypatch.setenv("WATCHDOG_USEC", "0")
    asked, counted = [], threading.Semaphore(0)

    def progress():
        asked.append(min(len(asked), 3))  # 0, 1, 2, 3, 3, 3, ...
        counted.release()
        return asked[-1]

    with _watchdog.follow(progress, 0.001):
        for _ in range(20):
            assert counted.acquire(timeout=60)
    systemd.settimeout(0)
    heard = [systemd.recv(99) for _ in range(4)]  # of the four values
    with pytest.raises(BlockingIOError):
        systemd.recv(99)
    assert set(heard) == {b"READY=1\nWATCHDOG=1"}
