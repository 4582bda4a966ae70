"""Files with external links or false sizes are refused before their content is read."""

import re

import h5py
import pytest

from ertis_numba.base.errors import DataError, ForeignDataError
from ertis_numba.storage import open_recording, structure
from ertis_numba.storage.verify import verify
from tests.faults.network.hostile_files import hostile_files, write_good

REFUSED = {
    "link: pdm in another file": r"/sensors/front/pdm is a link into the file 'other.h5'; copy the data into one file",
    "link: call out of place": r"/sensors/front/call is a link to '/moved'; copy the data to its place",
    "link: crc32 twice": r"/sensors/front/crc32 has several names in the file",
    "link: /sensors in another file": r"/sensors is a link into the file 'other.h5'",
    "link: /sensors/front out of place": r"/sensors/front is a link to '/moved'",
    "elsewhere: pdm is virtual": r"/sensors/front/pdm lies in other files; copy the data into one file",
    "elsewhere: time in a raw file": r"/sensors/front/time lies in other files",
    "compressed: pdm": r"/sensors/front/pdm is compressed or filtered; write it again without filters",
    "type: sequence of text that grows": r"/sensors/front/sequence holds object, wanted <i8",
    "type: settings of 100 MB each": r"/sensors/front/settings holds .*, wanted text of up to 262144 bytes",
    "type: pdm is a group": r"/sensors/front/pdm is a group, wanted a dataset",
    "rows: 100,000,000 that are not there": r"has \d+ bytes \(shape \(100000000,\)\), but the file holds \d+",
    "rows: 100,000,000 of pdm": r"/sensors/front/pdm has \d+ bytes .*, but the file holds \d+",
    "attribute: 24 MB of sensors/front": r"attribute 'firmware' of /sensors/front has 24000000 bytes; the limit is",
    "attribute: 5,000 of /": r"/ has 50\d\d attributes; the limit is 256",
    "names: 5,000 sensors": r"5001 sensors; the limit is 1024",
    "names: the same rows under 201 names": r"has several names in the file",
    "names: sensor '..'": r"sensor name '..' cannot name a group in a file",
    "settings: text of 262,145 bytes": r"settings holds \|S262145, wanted text of up to 262144 bytes",
    "settings: directions: '/etc/passwd.csv/'": r"processing.directions is '/etc/passwd.csv/', the name of a file",
    "settings: layout: '/etc/passwd.toml'": r"array.layout is '/etc/passwd.toml', the name of a file",
}


@pytest.fixture(scope="module")
def spoiled():
    return {each.name: each for each in hostile_files()}


@pytest.mark.parametrize("name", REFUSED)
def test_hostile_recording_is_refused(tmp_path, spoiled, name):
    path = tmp_path / "bad.h5"
    spoiled[name].make(write_good(tmp_path / "good.h5"), path)
    with pytest.raises(DataError, match=rf"{re.escape(str(path))}.*{REFUSED[name]}"):
        open_recording(path, sensor=None if "'..'" in name else "front").close()


def test_template_of_hostile_files_is_sound(tmp_path):
    assert [report.is_intact for report in verify(write_good(tmp_path / "good.h5"))] == [True]


def test_recording_with_overlapping_variables_is_refused(tmp_path, monkeypatch):
    """Chunks that share one place let a small file claim millions of them."""
    path = write_good(tmp_path / "good.h5")
    monkeypatch.setattr(structure, "stored_bytes", lambda _: 1_000_000)
    with pytest.raises(DataError, match="store more bytes than the file has"):
        open_recording(path)


@pytest.mark.parametrize(
    ("spoil", "reported"),
    [
        (lambda extra: extra.create_dataset("bomb", (1_000_000,), "S100000", chunks=(1,)), "the file holds 0"),
        (lambda extra: extra.attrs.update({f"a{number}": 0 for number in range(300)}), "has 300 attributes"),
    ],
    ids=["unallocated", "attributes"],
)
def test_verify_ignores_other_objects(tmp_path, spoil, reported):
    path = write_good(tmp_path / "good.h5")
    with h5py.File(path, "r+", libver=("v110", "v110")) as file:
        spoil(file.create_group("extra"))
    (report,) = verify(path)
    assert not report.is_intact
    assert reported in report.remark


def test_verify_refuses_objects_in_other_files(tmp_path):
    (tmp_path / "other.raw").write_bytes(bytes(8))
    path = write_good(tmp_path / "good.h5")
    with h5py.File(path, "r+", libver=("v110", "v110")) as file:
        file.create_dataset("extra/far", (8,), "u1", external=[("other.raw", 0, 8)])
    with pytest.raises(ForeignDataError, match="lies in other files"):
        verify(path)
