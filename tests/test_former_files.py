"""Files of earlier versions, whose variables and keys had other names, stay readable."""

import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from ertis_numba.frames import SequenceGap
from ertis_numba.journal import Journal
from ertis_numba.network.central_node._ledger import Ledger
from ertis_numba.network.central_node._received_items import SensorSession
from ertis_numba.settings import Settings
from ertis_numba.storage import open_energyscapes, open_recording, write_energyscapes, write_recording
from ertis_numba.storage.schema import FORMER_NAMES

FILES = Path(__file__).parent / "former_files"
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


@pytest.mark.parametrize("remark", ["", "  # clean pictures"])
def test_former_beamformer_coherence_factor_is_a_weighting(remark):
    text = f'[processing]\nbeamformer = "coherence_factor"{remark}\nsnapshots = 3\n'
    processing = Settings.from_toml(text).processing
    assert (processing.beamformer, processing.weighting) == ("delay_and_sum", "coherence_factor")
    assert processing.snapshots == 3
    again = Settings.from_toml(Settings(processing=processing).to_toml())
    assert again.processing == processing


def test_former_journal_is_read(tmp_path):
    for path in FILES.glob("rec.h5.journal*"):
        shutil.copy(path, tmp_path)
    with Journal.open(tmp_path / "rec.h5.journal") as journal:
        assert {key.session_id for key in journal.index()} == {SESSION_ID}


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
        assert len(list(reader)) == 2


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
