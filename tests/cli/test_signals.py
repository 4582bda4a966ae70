"""Signals sent to commands: the short form of the run of `python -m tests.faults reliability --long`."""

import os
import signal
import subprocess
import sys
import textwrap

import pytest
from ertis_cli.main import COMMANDS

from tests.faults import signals
from tests.faults.reliability import ONE_SENSOR
from tests.journals import ENVIRONMENT

SEED = 1


def test_signal_tests_cover_every_command():
    assert list(dict.fromkeys(name.split()[0] for name in signals.COMMANDS)) == list(COMMANDS)


def test_signals_end_commands_while_they_start(tmp_path):
    found = signals.send(tmp_path, ONE_SENSOR, seed=SEED, count=3, only=("listen", "peaks", "doctor"))
    assert (found["codes"], found["tracebacks"]) == (0, 0), found["by_command"]


def run(program):
    text = (
        "from ertis_cli import _stop_signals; _stop_signals.obey_signals()\nimport signal, sys, time\n"
        + textwrap.dedent(program)
    )
    return subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=False, timeout=100)


@pytest.mark.parametrize(("number", "code"), [("SIGINT", 130), ("SIGTERM", 143), ("SIGHUP", 129)])
def test_swallowed_signal_is_sent_again(number, code):
    done = run(f"""
        try:
            signal.raise_signal(signal.{number})
        except BaseException:
            pass  # as some libraries do
        try:
            time.sleep(80)
        except KeyboardInterrupt:
            sys.exit(130)
        """)
    assert (done.returncode, done.stderr) == (code, "")


def test_signal_is_not_repeated_during_cleanup():
    done = run("""
        try:
            try:
                signal.raise_signal(signal.SIGTERM)
            finally:
                time.sleep(0.3)  # longer than a few intervals after which the signal would come again
                print("cleared up")
        finally:
            _stop_signals.interruption.end()
        """)
    assert (done.returncode, done.stdout, done.stderr) == (143, "cleared up\n", "")


def run_command(module, number, program=""):
    """Run the command line and send it a signal when it imports a module."""
    text = f"""
import atexit, os, signal, sys, time

class Finder:
    def find_spec(self, name, *_):
        if name == "{module}":
            sys.meta_path.remove(self)
            signal.raise_signal(signal.{number})

sys.meta_path.insert(0, Finder())
from ertis_cli.__main__ import main
sys.argv = ["ertis", "sensors", "list"]
{textwrap.dedent(program)}
main()
"""
    return subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=False, timeout=100)


@pytest.mark.parametrize("number", ["SIGINT", "SIGTERM"])
def test_signal_before_the_handlers_exist_prints_nothing(number):
    done = run_command("ertis_cli._stop_signals", number)
    assert (done.returncode, done.stderr) == (-getattr(signal, number), "")


@pytest.mark.parametrize(("number", "code"), [("SIGINT", 130), ("SIGTERM", 143)])
@pytest.mark.parametrize("module", ["ertis_cli.main", "ertis_cli.devices"])
def test_signal_is_not_repeated_after_the_command_has_ended(module, number, code):
    done = run_command(
        module,
        number,
        """
        def clear_up():
            time.sleep(0.3)  # longer than a few intervals after which the signal would come again
            os.write(1, b"cleared up")

        atexit.register(clear_up)
        """,
    )
    assert (done.returncode, done.stdout) == (code, "cleared up")
    assert done.stderr.strip() in ("", "ertis: error: interrupted")


def test_interrupted_command_does_not_finalise_the_interpreter():
    done = run_command(
        "ertis_cli.devices",
        "SIGTERM",
        """
        class Interrupted:
            def __del__(self, abort=os.abort):
                abort()  # as a library that was interrupted in its import

        sys.interrupted = Interrupted()
        """,
    )
    assert (done.returncode, done.stderr) == (143, "")


def test_command_ends_without_a_scan_of_all_objects():
    """A frozen object is not scanned by the interpreter's last collection, which would take up to 0.3 s."""
    done = run_command("none", "SIGTERM", "import gc; atexit.register(lambda: print(gc.get_freeze_count() > 1000))")
    assert (done.returncode, done.stdout.splitlines()[-1]) == (0, "True")


def test_ctrl_c_in_code_run_by_exec_exits_with_code_130(tmp_path):
    """Python would otherwise end by SIGINT, because it treats an interrupt in code run by `exec` as unhandled."""
    (tmp_path / "sitecustomize.py").write_text(
        """
import signal, sys

class Finder:
    def find_spec(self, name, *_):
        if name == "ertis_cli.devices":
            sys.meta_path.remove(self)
            exec("signal.raise_signal(signal.SIGINT)")  # as dataclasses are made

sys.meta_path.insert(0, Finder())
"""
    )
    environment = ENVIRONMENT | {"PYTHONPATH": os.pathsep.join([str(tmp_path), ENVIRONMENT["PYTHONPATH"]])}
    command = [sys.executable, "-m", "ertis_cli", "sensors", "list"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment, timeout=100)
    assert (done.returncode, done.stderr) == (130, "\nertis: error: interrupted\n")


def test_signal_that_is_ignored_from_the_start_stays_ignored():
    """`nohup` starts commands with SIGHUP ignored."""
    program = """
        signal.raise_signal(signal.SIGHUP)
        with _stop_signals.stopped_by_signals() as asked:
            signal.raise_signal(signal.SIGHUP)
        print(asked.came, _stop_signals.interruption.asked)
        with _stop_signals.stopped_by_signals() as asked:
            signal.raise_signal(signal.SIGTERM)
        print(asked.came == [signal.SIGTERM], _stop_signals.interruption.asked)
        """
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        done = run(program)
    finally:
        signal.signal(signal.SIGHUP, before)
    assert (done.returncode, done.stdout) == (0, "[] False\nTrue True\n")


def test_signal_in_the_code_of_imports_waits_for_its_end():
    """An exception there would keep import locks, and a command that waits for a thread's import would never end."""
    done = run("""
        text = "def find():\\n    signal.raise_signal(signal.SIGTERM)\\n    return 'found'"
        exec(compile(text, "<frozen importlib._bootstrap>", "exec"))
        print(find(), flush=True)
        time.sleep(80)
        """)
    assert (done.returncode, done.stdout, done.stderr) == (143, "found\n", "")
