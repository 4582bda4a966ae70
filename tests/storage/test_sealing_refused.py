"""Sensors that a recording cannot store: the others are sealed, and the journal is kept with the reason."""

import json

import h5py
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba.journal import Journal, seal_in_subprocess
from ertis_numba.network.central_node._received_items import SealedOne, SealingFailed
from ertis_numba.settings import Call, call
from ertis_numba.storage import open_recording, sealing, sensor_names
from ertis_numba.storage.sealing import seal
from ertis_numba.storage.sealing_process import FAILED, main
from ertis_numba.storage.verify import verify
from tests.journals import TINY, create, entries
from tests.storage.test_archive import Opened

REASON = r"settings of sensor bad, call: call has 5000000 samples .*; the limit is 1048576"


@pytest.fixture
def left(tmp_path, monkeypatch):
    """Journal from a version without a limit on the samples of a call."""
    with monkeypatch.context() as before:
        before.setattr(call, "MAX_CALL_SAMPLES", 10**9)
        long = TINY.replace(call=Call(duration_s=1.0, sample_rate_hz=5e6))
        with create(tmp_path, entries(3)) as journal:
            journal.add_sensor("bad", long)
            journal.append(entries(2, sensor="bad", settings=long))
            journal.note_gap("bad", 20, 21, "lost", session_id=5)
    return journal.path


def test_seal_keeps_a_journal_in_which_one_sensor_cannot_be_sealed(tmp_path, left):
    sealed = seal(left)
    assert (sealed.measurements, list(sealed.refused)) == (3, ["bad"])
    assert sealed.set_aside == tmp_path / "rec.h5.journal.refused"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rec.h5", "rec.h5.journal.refused"]
    assert "no recording can hold sensor bad (" in sealed.remark
    with open_recording(tmp_path / "rec.h5") as recording:
        assert (recording.sensor, len(recording)) == ("left", 3)
        assert "sensor bad was set aside: " in recording.attributes["history"]
    with Journal.open(sealed.set_aside) as kept:  # The kept journal is complete.
        assert (len(kept), kept.unusable["bad"][1]) == (3, 2)


def test_seal_can_be_repeated_after_a_kill(tmp_path, left, monkeypatch):
    monkeypatch.setattr(Journal, "set_aside", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        seal(left)
    monkeypatch.undo()
    before = (tmp_path / "rec.h5").read_bytes()
    assert seal(left).set_aside == tmp_path / "rec.h5.journal.refused"
    assert (tmp_path / "rec.h5").read_bytes() == before


def test_seal_keeps_a_journal_of_which_nothing_can_be_sealed(tmp_path, monkeypatch, capsys):
    with monkeypatch.context() as before:
        before.setattr(call, "MAX_CALL_SAMPLES", 10**9)
        long = TINY.replace(call=Call(duration_s=1.0, sample_rate_hz=5e6))
        create(tmp_path, entries(2, settings=long), settings=long).close()
    assert main([str(tmp_path / "rec.h5.journal")]) == FAILED
    assert "no recording can hold sensor left" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["rec.h5.journal.refused"]


def test_seal_survives_any_error_in_laying_out_a_sensor(tmp_path, monkeypatch):
    def fails(group, settings, **more):
        if group.name == "/sensors/right" and group.file.driver == "core":
            raise ValueError("Maximum allowed size exceeded")
        return create_sensor_variables(group, settings, **more)

    create_sensor_variables = sealing.create_sensor_variables
    monkeypatch.setattr(sealing, "create_sensor_variables", fails)
    create(tmp_path, [*entries(2), *entries(2, sensor="right")]).close()
    sealed = seal(tmp_path / "rec.h5.journal")
    assert sealed.refused == {"right": "Maximum allowed size exceeded"}
    assert sensor_names(tmp_path / "rec.h5") == ("left",)
    assert h5py.is_hdf5(tmp_path / "rec.h5")


def test_recover_reports_a_sensor_that_cannot_be_sealed(tmp_path, left):
    create(tmp_path, entries(2), name="other.h5").close()
    done = CliRunner().invoke(cli, ["import", "journals", "--json", str(tmp_path)])
    assert done.exit_code == 1
    assert "ertis: error: " in done.stderr
    assert "no recording can hold sensor bad" in done.stderr
    assert f"the journal is kept as {left}.refused" in done.stderr
    journals = json.loads(done.stdout)["journals"]
    assert [each["measurements"] for each in journals] == [2, 3]
    assert list(journals[1]["refused"]) == ["bad"]


def test_verify_reports_a_sensor_of_a_journal_that_cannot_be_used(left):
    bad = verify(left)[1]
    assert (bad.sensor, bad.measurements, bad.is_intact) == ("bad", 2, False)
    assert "call has 5000000 samples" in bad.fault


def test_sealing_process_returns_refused_sensors(left):
    sealed = seal_in_subprocess(left)
    assert (sealed.measurements, list(sealed.refused), sealed.set_aside.exists()) == (3, ["bad"], True)


@pytest.mark.usefixtures("left")
def test_archive_seals_other_sensors_and_counts_set_aside_journals(tmp_path):
    with Opened(tmp_path, seal=True) as opened:
        event = opened.until(SealedOne)
        status = opened.archive.status()
    assert "no recording can hold sensor bad" in event.sealed.remark
    assert (status.sealed, status.set_aside, status.sealing_failed) == (1, 1, 0)
    assert not [event for event in opened.events if isinstance(event, SealingFailed)]
