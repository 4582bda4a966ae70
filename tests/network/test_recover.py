"""``ertis import journals`` and ``ertis capture`` seal journals in a separate process and report the result."""

import json
import shutil
import sys

import pytest
from click.testing import CliRunner
from ertis_cli.capture import _seal
from ertis_cli.main import cli

from ertis_numba.base.errors import DataError, JournalInUseError, SonarError
from ertis_numba.journal import seal_in_subprocess, storage_processes
from ertis_numba.processes import child
from ertis_numba.storage import sealing_process
from ertis_numba.storage.sealing import seal
from ertis_numba.storage.verify import verify
from tests.journal.test_journal_damage import spoil
from tests.journals import crashed, create, entries


def run(*arguments, code=0):
    done = CliRunner().invoke(cli, [str(argument) for argument in arguments])
    assert done.exit_code == code, (done.stdout, done.stderr, done.exception)
    return done


@pytest.fixture
def sealed_here(monkeypatch):
    """Run what sealing processes run in this process, for tests of what is reported of their replies."""

    def seal_here(request, replies, progress):
        def report(note):
            if isinstance(note, storage_processes.SealingProgress):
                progress(note.done, note.of)
            else:
                replies.append(note)

        return f"ended with {vars(sealing_process)['_seal'](request, report)}"

    monkeypatch.setattr(storage_processes, "_seal", seal_here)


def test_sealing_process_seals_a_journal(tmp_path):
    with create(tmp_path, [*entries(4), *entries(1, sensor="right")]) as journal:
        path = journal.path
    shutil.copy(path, tmp_path / "kept")
    reported = []
    sealed = seal_in_subprocess(path, progress=lambda *numbers: reported.append(numbers))
    assert reported == [(number + 1, 5) for number in range(5)]
    assert not path.exists()
    shutil.copy(tmp_path / "kept", path)
    assert sealed == seal(path)
    assert [report.measurements for report in verify(tmp_path / "rec.h5")] == [4, 1]


def test_sealing_process_removes_an_empty_journal(tmp_path):
    create(tmp_path, []).close()
    sealed = seal_in_subprocess(tmp_path / "rec.h5.journal")
    assert (sealed.recording, sealed.remark) == (None, f"{tmp_path}/rec.h5.journal: no measurement was captured")


def test_sealing_process_reports_a_refusal(tmp_path):
    with (
        create(tmp_path) as journal,
        pytest.raises(JournalInUseError, match=r"rec.h5.journal is in use by another process"),
    ):
        seal_in_subprocess(journal.path)
    (tmp_path / "rec.h5").write_text("mine")
    with pytest.raises(DataError, match="exists with other content"):
        seal_in_subprocess(journal.path)
    assert seal_in_subprocess(journal.path, overwrite=True).measurements == 3


@pytest.fixture
def fake_python(tmp_path, monkeypatch):
    """Return a function that makes seal_in_subprocess run a shell line instead of Python; ``$0`` is the script."""

    def replace_python(line):
        script = tmp_path / "python"
        script.write_text(f"#!/bin/sh\n{line}\n")
        script.chmod(0o755)
        monkeypatch.setattr(child.sys, "executable", str(script))

    return replace_python


HALF = """
import os, sys
os.write(int(sys.argv[-1].removeprefix("--pipe=")), bytes([5, 0, 0, 0, 1]))  # The first byte of five.
os.kill(os.getpid(), 9)
"""


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("kill -9 $$", "was ended by SIGKILL, printing nothing; seal it again"),
        (f"exec {sys.executable} -c '{HALF}' \"$@\"", "was ended by SIGKILL, printing nothing; seal it again"),
        ("echo Traceback >&2; echo; echo 'KeyError: 1' >&2; exit 1", "ended with 1, printing 'KeyError: 1'; seal it"),
        ("seq 100000 >&2; exit 3", "ended with 3, printing '100000'; seal it again"),  # Exceeds the capacity of a pipe.
        (
            f"exec {sys.executable} -c 'import os, sys; sys.exit(str(os.getsid(0) == os.getpid()))'",
            "ended with 1, printing 'True'; seal it again",  # A session of its own shields it from Ctrl-C.
        ),
    ],
)
def test_sealing_process_that_dies_is_reported(tmp_path, fake_python, line, reason):
    fake_python(line)
    with pytest.raises(DataError, match=f"rec.h5.journal: the process that seals it {reason}"):
        seal_in_subprocess(crashed(tmp_path))


SLOW = """
import time
from pathlib import Path
from ertis_numba.journal.storage_processes import Sealed, SealingProgress, SealingResult, SealJournal
from ertis_numba.processes import connect

pipe = connect(SealJournal, outlives_parent=True)
pipe.send(SealingProgress(1, 3))
time.sleep(60)
pipe.send(Sealed(SealingResult(Path("it was not asked to end"), Path("none"))))
"""


@pytest.mark.parametrize("late", [False, True])
def test_sealing_process_can_be_interrupted(tmp_path, fake_python, late):
    path = crashed(tmp_path)
    slow = tmp_path / "slow.py"
    slow.write_text(SLOW)
    fake_python(f"trap '' INT; exec {sys.executable} \"$@\"" if late else f'exec {sys.executable} {slow} "$4"')

    def interrupt(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as error:
        seal_in_subprocess(path, progress=interrupt)
    safe = f"the measurements are safe in {path}; recover them with 'ertis import journals {path}'"
    assert str(error.value) == (f"the measurements are in {tmp_path / 'rec.h5'}" if late else safe)
    assert (path.exists(), (tmp_path / "rec.h5").exists()) == (not late, late)
    assert seal(path).measurements == 3


# The command `ertis import journals`.


def test_recover_seals_a_folder(tmp_path):
    (tmp_path / "sub").mkdir()
    crashed(tmp_path)
    crashed(tmp_path, entries(1), name="b.h5")
    (tmp_path / "c.h5.journal").touch()
    with create(tmp_path, name="used.h5"):
        done = run("import", "journals", tmp_path)
    assert sorted(done.stderr.splitlines()) == [
        f"{tmp_path}/b.h5: 1 measurement, 0 missing",
        f"{tmp_path}/c.h5.journal: no measurement was captured; removed",
        f"{tmp_path}/rec.h5: 3 measurements, 0 missing",
        f"{tmp_path}/used.h5.journal: in use by a running capture; left alone",
    ]
    assert done.stdout == ""
    assert sorted(path.name for path in tmp_path.iterdir()) == ["b.h5", "rec.h5", "sub", "used.h5.journal"]
    assert verify(tmp_path / "rec.h5")[0].is_intact


@pytest.mark.usefixtures("sealed_here")
def test_recover_reports_unsealable_journals(tmp_path):
    path = crashed(tmp_path)
    (tmp_path / "rec.h5").write_text("mine")
    crashed(tmp_path, name="b.h5")
    done = run("import", "journals", tmp_path, "--json", "--quiet", code=1)
    assert done.stderr == (
        f"ertis: error: {tmp_path}/rec.h5 exists with other content than {path}; move it, or replace it (--force)\n"
    )
    reported = json.loads(done.stdout)["journals"]
    assert [(report.get("measurements"), "error" in report) for report in reported] == [(3, False), (None, True)]
    assert run("import", "journals", path, "--force", "--quiet").stderr == ""
    assert verify(tmp_path / "rec.h5")[0].is_intact


@pytest.mark.usefixtures("sealed_here")
def test_recover_reports_damaged_measurements(tmp_path):
    create(tmp_path).close()
    path = tmp_path / "rec.h5.journal"
    spoil(path, "UPDATE measurements SET words = x'00' WHERE id = 1")
    reported = f"2 measurements, 1 missing, of which 1 damaged; the journal is kept as {path}.damaged"
    assert reported in run("import", "journals", path, code=3).stderr


def test_recover_reports_a_folder_without_journals(tmp_path):
    assert run("import", "journals", tmp_path).stderr == f"no journal in {tmp_path}\n"
    assert run("import", "journals", tmp_path, "--quiet").stderr == ""
    assert json.loads(run("import", "journals", tmp_path, "--json").stdout) == {"journals": []}
    assert (
        "none.journal: No such file or directory" in run("import", "journals", tmp_path / "none.journal", code=1).stderr
    )


def test_recover_ignores_modules_in_the_folder(tmp_path, monkeypatch):
    crashed(tmp_path)
    (tmp_path / "h5py.py").write_text("raise SystemExit('the wrong one')")
    monkeypatch.chdir(tmp_path)
    assert run("import", "journals", ".").stderr == "rec.h5: 3 measurements, 0 missing\n"


def interrupted(*_, **__):
    raise KeyboardInterrupt


def test_recover_can_be_interrupted(tmp_path, monkeypatch):
    path = crashed(tmp_path)
    monkeypatch.setattr(child.subprocess, "Popen", interrupted)
    done = run("import", "journals", path, code=130)
    assert (
        done.stderr.splitlines()[0]
        == f"the measurements are safe in {path}; recover them with 'ertis import journals {path}'"
    )
    monkeypatch.undo()
    assert run("import", "journals", path).stderr == f"{tmp_path}/rec.h5: 3 measurements, 0 missing\n"


# Sealing at the end of a capture.


LOST = SonarError("left: it was unplugged; plug it in")


@pytest.mark.usefixtures("sealed_here")
def test_capture_reports_damage(tmp_path, capsys):
    create(tmp_path).close()
    path = tmp_path / "rec.h5.journal"
    spoil(path, "UPDATE measurements SET words = x'00' WHERE id = 1")
    _seal(path, LOST, overwrite=False)  # The command reports the damage.
    assert capsys.readouterr().err == f"1 measurement is damaged; the journal is kept as {path}.damaged\n"
    assert len(verify(tmp_path / "rec.h5")) == 1


@pytest.mark.usefixtures("sealed_here")
def test_failed_capture_that_cannot_be_sealed_is_reported(tmp_path, capsys):
    path = crashed(tmp_path)
    (tmp_path / "rec.h5").write_text("mine")
    reported = (
        f"{tmp_path}/rec.h5 exists with other content than {path}; move it, or replace it (overwrite=True); "
        f"the measurements are safe in {path}; recover them with 'ertis import journals {path}'"
    )
    with pytest.raises(SonarError, match="left: it was unplugged"):
        _seal(path, LOST, overwrite=False)
    assert capsys.readouterr().err == f"ertis: error: {reported}\n"
    with pytest.raises(DataError) as error:
        _seal(path, None, overwrite=False)
    assert str(error.value) == reported
    assert capsys.readouterr().err == ""
    _seal(path, None, overwrite=True)
    assert verify(tmp_path / "rec.h5")[0].is_intact


@pytest.mark.usefixtures("sealed_here")
def test_empty_capture_is_reported(tmp_path):
    for failure, wanted in ((None, "rec.h5.journal: no measurement was captured"), (LOST, "left: it was unplugged")):
        create(tmp_path, []).close()
        with pytest.raises((DataError, SonarError), match=wanted):
            _seal(tmp_path / "rec.h5.journal", failure, overwrite=False)
        assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("failure", [None, LOST])
def test_capture_with_interrupted_sealing_keeps_its_journal(tmp_path, monkeypatch, capsys, failure):
    path = crashed(tmp_path)
    monkeypatch.setattr(child.subprocess, "Popen", interrupted)
    with pytest.raises(KeyboardInterrupt if failure is None else SonarError):
        _seal(path, failure, overwrite=False)
    assert (
        capsys.readouterr().err
        == f"the measurements are safe in {path}; recover them with 'ertis import journals {path}'\n"
    )
