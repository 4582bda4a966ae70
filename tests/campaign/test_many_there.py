"""Existing output: detection of damage, and requirements that apply to it as to new output."""

import h5py
import numpy as np
import pytest

from ertis_numba.campaign import CampaignOptions, existing_output
from ertis_numba.pipeline import verification
from ertis_numba.storage import write_recording
from tests.campaigns import outcomes, run_here, write_recordings
from tests.files import line, noise


def narrow(settings):
    return settings.replace(processing=settings.processing.replace(range_m=(0.5, 0.8)))


def exact(settings):
    return narrow(settings).replace(accuracy=settings.accuracy.replace(oversampling=48))


@pytest.fixture
def runs(tmp_path, monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")  # otherwise the creation dates would differ
    write_recordings(tmp_path / "runs", names="a", settings=line(8, 8))
    return tmp_path / "runs"


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out"


def state(file):
    return file.stat().st_ino, file.stat().st_mtime_ns


def spoil_energy(file):
    with h5py.File(file, "r+") as images:
        images["sensors/eRTIS-7/amplitude"][1, 3, 5] += 1.0


def spoil_head(file):
    content = bytearray(file.read_bytes())
    content[48:64] = bytes(16)  # of the superblock
    file.write_bytes(content)


@pytest.mark.parametrize(("spoil", "stated"), [(spoil_energy, "is damaged"), (spoil_head, "is damaged")])
def test_damaged_output_is_reported_or_replaced(runs, out, monkeypatch, spoil, stated):
    run_here(monkeypatch, [runs / "a.h5"], out, CampaignOptions(settings=narrow))
    whole = (out / "a.energy.h5").read_bytes()
    spoil(out / "a.energy.h5")
    found, _ = run_here(monkeypatch, [runs / "a.h5"], out, CampaignOptions(settings=narrow))
    assert f"exists and {stated}; choose another folder, or replace the output (overwrite=True)" in found["a.h5"].error
    found, _ = run_here(monkeypatch, [runs / "a.h5"], out, CampaignOptions(settings=narrow, overwrite=True))
    assert outcomes(found) == {"a.h5": "made"}
    assert (out / "a.energy.h5").read_bytes() == whole


def test_unreadable_output_can_be_replaced(runs, out, monkeypatch):
    def stumbles(_):
        raise RuntimeError("Unable to read attribute")

    run_here(monkeypatch, [runs / "a.h5"], out, CampaignOptions(settings=narrow))
    monkeypatch.setattr(existing_output, "file_kind", stumbles)
    found, _ = run_here(monkeypatch, [runs / "a.h5"], out, CampaignOptions(settings=narrow, overwrite=True))
    assert outcomes(found) == {"a.h5": "made"}


def test_strict_applies_to_existing_output(tmp_path, out, monkeypatch):
    measurements = noise(count=2)
    for measurement in measurements:
        measurement.data[:] &= np.uint32(0xFFFFFFFE)
    write_recording(tmp_path / "worn.h5", measurements)
    run_here(monkeypatch, [tmp_path / "worn.h5"], out, CampaignOptions(settings=narrow))
    before = state(out / "worn.energy.h5")
    found, _ = run_here(monkeypatch, [tmp_path / "worn.h5"], out, CampaignOptions(settings=narrow, strict=True))
    assert "stuck at 0: channel 0" in found["worn.h5"].error
    found, _ = run_here(monkeypatch, [tmp_path / "worn.h5"], out, CampaignOptions(settings=narrow))
    assert outcomes(found) == {"worn.h5": "kept"}
    assert state(out / "worn.energy.h5") == before


def test_existing_output_is_verified_with_its_own_plan(runs, out, monkeypatch):
    run_here(monkeypatch, [runs / "a.h5"], out, CampaignOptions(settings=exact))
    before = state(out / "a.energy.h5")
    found, pool = run_here(
        monkeypatch, [runs / "a.h5"], out, CampaignOptions(settings=narrow, explain=True, verify=True)
    )
    assert outcomes(found) == {"a.h5": "kept"}
    assert [task.action for task in pool.given] == ["look", "plan", "check"]
    (sensor,) = found["a.h5"].made["sensors"]
    assert sensor["plan"]["accuracy"]["oversampling"] == 48
    assert sensor["verified"]["error_db"] <= -35.0
    refused = verification.Measured(error_db=-30.0, n_directions=7, peaks=None)
    monkeypatch.setattr(verification, "measure", lambda *_, **__: refused)
    found, _ = run_here(monkeypatch, [runs / "a.h5"], out, CampaignOptions(settings=narrow, verify=True))
    assert "image of sensor eRTIS-7 has an error of -30.0 dB, but the limit is -35 dB" in found["a.h5"].error
    assert state(out / "a.energy.h5") == before
