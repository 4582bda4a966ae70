"""Data loss under faults: the short form of the one-hour run of `python -m tests.faults reliability --long`."""

import numpy as np
import pytest

from ertis_numba.base.errors import DataError
from ertis_numba.frames import Measurement, Stamp
from ertis_numba.settings import Recording
from ertis_numba.storage import open_recording, write_recording
from tests.faults import captures, reliability
from tests.faults.flips import flips

SHORT = reliability.SHORT
SOURCE = reliability.ONE_SENSOR
SEED = 1


@pytest.fixture
def brief(tmp_path, monkeypatch):
    """Recording of one brief measurement, and captures with its settings: they handle a fifth of the bytes."""
    with open_recording(SOURCE) as recording:
        words, settings = recording[0].data, recording.settings
    settings = settings.replace(
        recording=Recording(n_samples=32_768), processing=settings.processing.replace(range_m=(0.1, 0.5))
    )
    write_recording(tmp_path / "brief.h5", [Measurement(words[:32_768].copy(), settings)])
    (tmp_path / "brief.toml").write_text(settings.to_toml())
    monkeypatch.setenv("ERTIS_CAPTURE_SETTINGS", str(tmp_path / "brief.toml"))
    return tmp_path / "brief.h5"


@pytest.mark.alone
def test_sustained_capture_loses_nothing(tmp_path):
    """One of three attempts must succeed, because a busy machine may pause the capture for a tenth of a second."""
    for attempt in range(3):
        folder = tmp_path / str(attempt)
        folder.mkdir()
        found = captures.sustained(SOURCE, folder, duration_s=SHORT.duration_s, rate_hz=20.0)
        assert found["stored"] > 12 * SHORT.duration_s
        assert found["wrong"] == 0
        if not found["lost"]:
            return
    assert not found["lost"]


@pytest.mark.alone
def test_groups_of_a_sync_chain_are_complete(tmp_path):
    """Shifted samples differ between sensors and measurements, so that mix-ups are visible."""
    with open_recording(SOURCE) as recording:
        words, settings = recording[0].data, recording.settings
    sent = [
        Measurement(np.roll(words, 30 * sensor + index), settings, Stamp(sensor=f"sensor-{sensor}", sequence=index))
        for sensor in range(4)
        for index in range(3)
    ]
    platform = write_recording(tmp_path / "platform.h5", sent)
    found = captures.chain(platform, tmp_path, n_groups=SHORT.n_groups, rate_hz=10.0)
    assert (found["mixed"], found["wrong"]) == (0, 0)
    # The first pulse may arrive during arming, and a busy emulator ignores pulses during a measurement.
    assert SHORT.n_groups / 2 <= found["complete"] <= found["groups"] <= SHORT.n_groups + 2


def test_faults_on_the_line_never_become_measurements():
    found = reliability.wire(SHORT.n_blocks, SEED)
    assert found["spoilt"] > SHORT.n_blocks / 3
    assert found["delivered"] >= found["untouched"] > SHORT.n_blocks / 3
    assert found["untouched_lost"] == found["mixed"] == found["wrong_counter"] == found["twice"] == 0


def test_unplugging_without_later_data_has_no_reconnection_time():
    assert vars(captures)["_waits_s"]([1_000_000_000, 5_000_000_000], [0, 4_000_000_000, 2_500_000_000]) == [1.5]


@pytest.mark.alone  # the limit is a wall-clock time
def test_unplugged_sensor_is_reconnected(tmp_path, brief):
    found = captures.unplugs(brief, tmp_path, seed=SEED, count=SHORT.n_unplugs)
    assert (found["noticed"], found["wrong"]) == (SHORT.n_unplugs, 0)
    assert found["slowest_s"] < 3.0


def test_killed_captures_lose_nothing(tmp_path, brief, monkeypatch):
    monkeypatch.setenv("ERTIS_CAPTURE_CHECK_BITS", "0")  # Each of the captures would load kernels for the check.
    found = captures.kills(brief, tmp_path, seed=SEED, count=SHORT.n_kills)
    assert found["reported"] > 0
    assert (found["lost"], found["wrong"], found["unreadable"], found["left over"]) == (0, 0, 0, 0)


def test_damage_to_files_is_reported(tmp_path):
    found = flips(tmp_path, seed=SEED, count=SHORT.n_flips)
    assert found["tried"] >= SHORT.n_flips
    assert found["noticed"] > SHORT.n_flips / 3
    assert (found["silent"], found["crashed"]) == (0, 0)


def test_full_disk_loses_nothing(tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    with reliability.small_disk(disk) as mounted:
        if mounted is None:
            pytest.skip("only root may mount a small disk")
        found = captures.disk_full(SOURCE, tmp_path, mounted)
    assert found["exit code"] == 1
    assert found["reported"] > 0
    assert (found["lost"], found["wrong"]) == (0, 0)
    assert "free some space" in found["said"]


def test_emulator_that_does_not_start_is_reported(tmp_path):
    with pytest.raises((DataError, OSError)):
        captures.sustained(tmp_path / "none.h5", tmp_path, duration_s=1.0, rate_hz=20.0)
