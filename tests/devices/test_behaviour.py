"""Whether a call was emitted is kept from the sensor to files, the network and exports."""

import json
import subprocess
from dataclasses import replace

import h5py
import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba.base.errors import ArgumentError, DamagedError
from ertis_numba.devices.driver import SonarDriver
from ertis_numba.devices.setup import Setup
from ertis_numba.frames import Measurement, Stamp
from ertis_numba.interop import export
from ertis_numba.journal import Journal, JournalEntry
from ertis_numba.journal._tables import row_crc32
from ertis_numba.network.central_node import Archive
from ertis_numba.network.sensor_node import SensorNode
from ertis_numba.pipeline import Pipeline
from ertis_numba.simulation import Emitter, Scene, Sensor
from ertis_numba.simulation.render import render
from ertis_numba.storage import open_energyscapes, open_recording, write_energyscapes, write_recording
from ertis_numba.storage.sealing import seal
from tests.central import running
from tests.cli.test_device_commands import device  # noqa: F401  a fixture
from tests.cli.test_emulate import SHORT
from tests.emulated import PATIENT, PATIENT_ERTIS, TIMEOUT_S, WORDS, patient

__all__ = ["patient"]  # A fixture, imported for use here.

pytestmark = PATIENT
GIVEN = ["active", "passive", "unknown"]


@pytest.fixture
def measurements():
    return [
        Measurement(words, SHORT, Stamp(sensor="mine", sequence=number, behaviour=behaviour))
        for number, (words, behaviour) in enumerate(zip(WORDS, GIVEN, strict=True))
    ]


def behaviours(path, opened=open_recording):
    with opened(path) as reader:
        assert [stamp.behaviour for stamp in reader.stamps()] == [each.stamp.behaviour for each in reader]
        return [stamp.behaviour for stamp in reader.stamps()]


def test_files_keep_the_behaviour(measurements, tmp_path):
    assert behaviours(write_recording(tmp_path / "rec.h5", measurements)) == GIVEN
    with Pipeline(SHORT) as pipeline:
        images = [pipeline.process(each) for each in measurements]
    assert behaviours(write_energyscapes(tmp_path / "img.h5", images), open_energyscapes) == GIVEN
    export(tmp_path / "images.npz", images)
    with np.load(tmp_path / "images.npz") as stored:
        assert stored["behaviour"].tolist() == GIVEN
    assert images[1].to_xarray().attrs["behaviour"] == "passive"


def test_unknown_behaviour_is_refused(measurements, tmp_path):
    wrong = replace(measurements[0], stamp=Stamp(sensor="mine", behaviour="loud"))
    with pytest.raises(ArgumentError, match="behaviour 'loud' is unknown"):
        write_recording(tmp_path / "rec.h5", [wrong])


def test_journal_keeps_the_behaviour(measurements, tmp_path):
    path = tmp_path / "rec.h5.journal"
    with Journal.create(path, target="rec.h5", source="test") as journal:
        journal.add_sensor("mine", SHORT)
        journal.append([JournalEntry(each, monotonic_ns=0) for each in measurements])
    seal(path)
    assert behaviours(tmp_path / "rec.h5") == GIVEN


def test_journal_with_an_unknown_behaviour_is_damaged(measurements, tmp_path):
    with Journal.create(tmp_path / "rec.h5.journal", target="rec.h5", source="test") as journal:
        journal.add_sensor("mine", SHORT)
        journal.append([JournalEntry(measurements[0], monotonic_ns=0)])
        execute = journal._database.execute  # noqa: SLF001  no public access
        execute("UPDATE measurements SET behaviour = 'loud'")
        ((*values, _, _),) = execute("SELECT * FROM measurements")
        execute("UPDATE measurements SET row_crc32 = ?", (row_crc32(values[1:]),))
        with pytest.raises(DamagedError, match="has behaviour 'loud', wanted one of active, passive, unknown; copy"):
            next(journal.entries())


def test_file_with_an_unknown_behaviour_is_damaged(measurements, tmp_path, monkeypatch):
    """A program that writes such a file computes its checksum, too."""
    monkeypatch.setattr("ertis_numba.storage._reader.FileReader._require_content", lambda _: None)
    path = write_recording(tmp_path / "rec.h5", measurements)
    with h5py.File(path, "r+") as file:
        file["sensors/mine/behaviour"][1] = 7
    with open_recording(path) as recording:
        for read in (recording.stamps, lambda: recording[1]):
            with pytest.raises(DamagedError, match=r"measurement 1 has behaviour 7, but the format knows 1 \(active\)"):
                read()


def test_network_keeps_the_behaviour(measurements, tmp_path):
    with running(archive=Archive(tmp_path)) as central, SensorNode(central.address) as node:
        node.add_sensor("mine", SHORT)
        node.append([JournalEntry(each, monotonic_ns=0) for each in measurements])
        assert node.flush(TIMEOUT_S)
    (path,) = tmp_path.glob("*.h5")
    assert behaviours(path) == GIVEN


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize(("options", "behaviour"), [([], "active"), (["--passive"], "passive")])
def test_capture_stores_the_behaviour(tmp_path, options, behaviour):
    (tmp_path / "settings.toml").write_text(SHORT.to_toml())
    path = tmp_path / "rec.h5"
    command = ["capture", "--port", "mine", "--settings", tmp_path / "settings.toml", "-n", 2, "-o", path, *options]
    command += ["--no-check-bits"]
    done = CliRunner().invoke(cli, [str(each) for each in command])
    assert done.exit_code == 0, done.stderr
    assert behaviours(path) == [behaviour, behaviour]
    shown = CliRunner().invoke(cli, ["info", str(path)])
    assert f"2 {behaviour}" in shown.stdout
    report = json.loads(CliRunner().invoke(cli, ["info", "--json", str(path)]).stdout)
    assert report["behaviour"] == {behaviour: 2}


@pytest.mark.parametrize("active", [True, False])
def test_measurement_has_the_behaviour_of_its_command(device, active):  # noqa: F811  a fixture
    with SonarDriver.open("mine") as sonar:
        sonar.configure(replace(Setup.of(SHORT, active=not active), amplifier=True))
        assert sonar.measure(active=active).behaviour == ("active" if active else "passive")
        assert sonar.measure().behaviour == ("passive" if active else "active")
    assert device.registers.amplifier == 1


@pytest.mark.parametrize("active", [True, False])
def test_triggered_measurements_have_the_behaviour_of_the_setup(device, active):  # noqa: F811  a fixture
    with SonarDriver.open("mine") as sonar:
        sonar.configure(Setup.of(SHORT, active=active))
        sonar.arm()
        assert device.trigger()
        block = next(sonar.listen(stop=lambda: False, timeout_s=TIMEOUT_S))
    assert block.behaviour == ("active" if active else "passive")


def test_measurements_of_another_programs_sensor_have_unknown_behaviour(device):  # noqa: F811  a fixture
    with SonarDriver.open("mine") as first:
        first.configure(Setup.of(SHORT))
        first.arm()
        first._is_armed = False  # noqa: SLF001  so that it leaves the sensor armed
    with SonarDriver.open("mine", listen_only=True) as sonar:
        sonar.configure(Setup.of(SHORT))
        assert device.trigger()
        assert next(sonar.listen(stop=lambda: False, timeout_s=TIMEOUT_S)).behaviour == "unknown"


@pytest.mark.usefixtures("device")
def test_behaviour_survives_a_killed_capture(tmp_path):
    (tmp_path / "settings.toml").write_text(SHORT.to_toml())
    command = [*PATIENT_ERTIS, "capture", "--port", "mine", "--settings", "settings.toml", "-o", "rec.h5", "--passive"]
    command += ["--json", "--quiet", "--no-check-bits"]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True) as process:
        assert all(process.stdout.readline() for _ in range(3))
        process.kill()
    done = CliRunner().invoke(cli, ["import", "journals", str(tmp_path)])
    assert done.exit_code == 0, done.stderr
    found = behaviours(tmp_path / "rec.h5")
    assert len(found) >= 3
    assert set(found) == {"passive"}


def test_simulated_measurements_state_their_behaviour():
    assert render(Scene()).stamp.behaviour == "active"
    silent = Scene(sensors=(Sensor(emitter=Emitter(silent=True)),))
    assert render(silent).stamp.behaviour == "passive"
