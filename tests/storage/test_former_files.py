"""Files of earlier versions, whose variables and keys had other names, stay readable."""

import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from ertis_numba.base.errors import SettingsError
from ertis_numba.frames import SequenceGap
from ertis_numba.journal import Journal
from ertis_numba.network.central_node._ledger import Ledger
from ertis_numba.network.central_node._received_items import SensorSession
from ertis_numba.settings import Settings
from ertis_numba.simulation import Scene
from ertis_numba.storage import open_energyscapes, open_recording, write_energyscapes, write_recording
from ertis_numba.storage.schema import FORMER_NAMES

FILES = Path(__file__).parents[1] / "former_files"
SESSION_ID = 5


def test_former_recording_has_session_ids_and_gaps():
    with open_recording(FILES / "recording.h5") as recording:
        assert [stamp.session_id for stamp in recording.stamps()] == [SESSION_ID, SESSION_ID]
        assert [(gap.first, gap.last, gap.session_id) for gap in recording.gaps] == [(12, 14, SESSION_ID)]
        assert recording[1].data.shape == (4096,)


def test_former_energyscape_has_amplitudes():
    with open_energyscapes(FILES / "energyscape.h5") as images:
        amplitude = images[1].amplitude
        assert images[1].stamp.session_id == SESSION_ID
    with h5py.File(FILES / "energyscape.h5") as file:
        assert np.array_equal(amplitude, file["sensors/eRTIS-7/energy"][1])


def test_former_settings_keys_are_read():
    settings = Settings.load(FILES / "settings.toml")
    assert settings.accuracy.stopband_attenuation_db == 50.0
    assert settings.accuracy.focal_zones == 20
    assert settings.processing.diagonal_loading == 2.0


@pytest.mark.parametrize(
    "text",
    [
        '[processing]\nbeamformer = "coherence_factor"\nsnapshots = 3\n',
        '[processing]\nbeamformer="coherence_factor"  # clean pictures\nsnapshots = 3\n',
        "[processing]\nsnapshots = 3\n\t'beamformer'\t=\t'coherence_factor'",
        '[ processing ]\r\nbeamformer = """coherence_factor"""\r\nsnapshots = 3\r\n',
        'processing = {beamformer = "coherence_factor", snapshots = 3}',
        'processing.snapshots = 3\nprocessing . "beamformer" = "coherence_factor"',
        '[processing]\nbeamformer = "coherence_factor"\nweighting = "coherence_factor"\nsnapshots = 3\n',
    ],
)
def test_former_beamformer_coherence_factor_is_a_weighting(text, tmp_path):
    processing = Settings.from_toml(text).processing
    assert (processing.beamformer, processing.weighting) == ("delay_and_sum", "coherence_factor")
    assert processing.snapshots == 3
    again = Settings.from_toml(Settings(processing=processing).to_toml())
    assert again.processing == processing
    (tmp_path / "former.toml").write_text(text, newline="")
    updated = Settings().replace("processing.beamformer", "dmas").updated_from_file(tmp_path / "former.toml")
    assert (updated.processing.beamformer, updated.processing.weighting) == ("delay_and_sum", "coherence_factor")


def test_former_keys_are_read_in_any_spelling():
    accuracy = Settings.from_toml("accuracy = {\"zones\"=4, 'stop_band_db' = 50, interpolation='fitted'}").accuracy
    assert (accuracy.focal_zones, accuracy.stopband_attenuation_db) == (4, 50.0)


def test_former_keys_of_scenes_are_read():
    scene = Scene.from_toml("sensors = [{name = 'a', processing = {beamformer='coherence_factor', loading=2}}]")
    processing = scene.sensors[0].processing
    assert (processing.weighting, processing.diagonal_loading) == ("coherence_factor", 2.0)


def test_texts_that_mention_former_keys_are_unchanged():
    assert Settings.from_toml("[array]\nlayout = 'zones = loading = 3.csv'").array.layout == "zones = loading = 3.csv"


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        (
            '[processing]\nbeamformer = "coherence_factor"\nsnapshots = 3\n\n[air]\ntemperature_c = "cold"\n',
            r"s, line 6, air\.temperature_c: Expected `float`",
        ),
        (
            '[processing]\nbeamformer = "coherence_factor"\nsnapshots = "many"\n',
            r"s, line 3, processing\.snapshots: Expected `int`",
        ),
        ("[accuracy]\nprecision = 'auto'\nzones = 'many'\n", r"s, line 3, accuracy\.focal_zones: Expected `int"),
        ("[accuracy]\nzones = 4\nfocal_zones = 3\n", r"s, line 2, accuracy: unknown key `zones`"),
        (
            '[processing]\nsnapshots = 3\nbeamformer = "coherence_factor"\nweighting = "none"\n',
            r"s, line 3, processing\.beamformer: value 'coherence_factor' is unknown; known are delay_and_sum, ",
        ),
    ],
)
def test_errors_of_former_settings_name_the_line_of_the_text(text, reported):
    with pytest.raises(SettingsError, match=reported):
        Settings.from_toml(text, "s")


def test_former_journal_is_read(tmp_path):
    for path in FILES.glob("rec.h5.journal*"):
        shutil.copy(path, tmp_path)
    with Journal.open(tmp_path / "rec.h5.journal") as journal:
        assert {key.session_id for key in journal.index()} == {SESSION_ID}
        assert {entry.measurement.stamp.behaviour for entry in journal.entries()} == {"unknown"}


def test_former_ledger_is_read(tmp_path):
    shutil.copy(FILES / ".ertis-ledger", tmp_path)
    ledger = Ledger(tmp_path)
    assert ledger.acked_through == {SensorSession("left", SESSION_ID): 12}
    assert ledger.gaps == [SequenceGap("left", 3, 9, "the spool was full", SESSION_ID)]
    assert not ledger.damage


def test_ledger_of_version_2_is_read(tmp_path):
    (tmp_path / ".ertis-ledger").write_text('{"version": 2, "settled": {"left": {"5": 12}}}')
    assert Ledger(tmp_path).acked_through == {SensorSession("left", SESSION_ID): 12}


@pytest.mark.parametrize("name", ["recording.h5", "energyscape.h5"])
def test_former_file_passes_verification(name):
    with (open_recording if name == "recording.h5" else open_energyscapes)(FILES / name) as reader:
        assert reader.attributes["ertis_format_version"] == 1
        assert [item.stamp.behaviour for item in reader] == ["unknown"] * 2


def test_copies_of_former_files_use_present_names(tmp_path):
    with open_recording(FILES / "recording.h5") as recording, open_energyscapes(FILES / "energyscape.h5") as images:
        write_recording(tmp_path / "recording.h5", recording)
        write_energyscapes(tmp_path / "energyscape.h5", images)
    names = set()
    for path in tmp_path.iterdir():
        with h5py.File(path) as file:
            names |= set(file["sensors/eRTIS-7"])
    assert names >= set(FORMER_NAMES)
    assert not names & set(FORMER_NAMES.values())
