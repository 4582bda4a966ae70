"""Search for recordings by name, folder and pattern, and conflicts that are refused before processing."""

import contextlib
from pathlib import Path

import pytest

from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.campaign import Campaign, RecordingFile, find_recordings, output_paths
from ertis_numba.campaign.folder import clear_parts, exclusive_folder
from tests.campaigns import names_in


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("runs/b.h5", "runs/a.h5", "runs/notes.txt", "runs/deep/c.h5", "more/a.h5", "odd[1].h5"):
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).touch()
    return tmp_path


def names(*given):
    return [str(found.path) for found in find_recordings(given)]


def test_files_folders_and_patterns_are_found():
    assert names("runs/b.h5", "more/a.h5") == ["runs/b.h5", "more/a.h5"]
    assert names("runs") == ["runs/a.h5", "runs/b.h5"]
    assert names("runs/*") == ["runs/a.h5", "runs/b.h5", "runs/notes.txt"]
    assert names("runs/**/*.h5") == ["runs/a.h5", "runs/b.h5", "runs/deep/c.h5"]
    assert names("odd[1].h5") == ["odd[1].h5"]


def test_repeated_file_is_processed_once():
    Path("link.h5").symlink_to("runs/b.h5")
    assert names("runs/b.h5", "runs", "runs/../runs/*.h5", "link.h5") == ["runs/b.h5", "runs/a.h5"]


def test_file_is_preferred_to_a_link_to_it():
    Path("runs/0.h5").symlink_to("b.h5")
    assert names("runs") == ["runs/b.h5", "runs/a.h5"]
    assert find_recordings(["runs/0.h5", "runs"])[0] == RecordingFile(Path("runs/b.h5"), named=True)
    assert names("runs/0.h5") == ["runs/0.h5"]


@pytest.mark.parametrize("given", ["runs", "runs/*.h5"])
def test_broken_link_is_reported_when_it_is_opened(given):
    Path("runs/lost.h5").symlink_to("gone.h5")
    Path("runs/round.h5").symlink_to("round.h5")
    assert names(given) == ["runs/a.h5", "runs/b.h5", "runs/lost.h5", "runs/round.h5"]
    assert len(output_paths(find_recordings([given]), Path("out"))) == 4


def test_only_named_files_are_required():
    assert [found.named for found in find_recordings(["runs/b.h5", "runs"])] == [True, False]


def test_missing_file_is_reported_when_it_is_opened():
    assert names("none.h5") == ["none.h5"]


@pytest.mark.parametrize(
    ("given", "stated"),
    [("runs/*.hdf", "no file matches runs/"), ("empty", r"folder empty contains no \*\.h5")],
)
def test_pattern_without_matches_is_refused(given, stated):
    Path("empty").mkdir()
    with pytest.raises(DataError, match=stated):
        find_recordings([given])


def test_each_recording_has_its_own_output():
    assert output_paths(find_recordings(["runs/**/*.h5"]), Path("out")) == [
        Path(f"out/{name}.energy.h5") for name in "abc"
    ]


@pytest.mark.parametrize(
    ("given", "folder", "stated"),
    [
        (["runs/a.h5", "more"], "out", r"runs/a\.h5 and more/a\.h5 would both become out/a\.energy\.h5"),
        (["runs"], "runs/a.h5", r"output runs/a\.h5 is a file, but several recordings need a folder"),
        (["runs"], "none/out", r"output none/out: folder none does not exist"),
    ],
)
def test_conflicts_are_refused_before_processing(place, given, folder, stated):
    with pytest.raises(ArgumentError, match=stated):
        Campaign(find_recordings(given), folder)
    assert names_in(place) == ["more", "odd[1].h5", "runs"]


def test_recordings_are_never_replaced():
    Path("runs/a.energy.h5").touch()
    with pytest.raises(ArgumentError, match=r"would become runs/a\.energy\.h5, which is itself to be processed"):
        output_paths([RecordingFile(Path("runs/a.h5")), RecordingFile(Path("runs/a.energy.h5"))], Path("runs"))


def test_no_workers_are_refused():
    with pytest.raises(ArgumentError, match="workers is 0; use a whole number of at least 1"):
        Campaign(find_recordings(["runs"]), "out", workers=0)


def test_folder_is_locked_for_one_campaign(place):
    with exclusive_folder(place / "out"):
        with pytest.raises(ArgumentError, match="is in use by another campaign"), exclusive_folder(place / "out"):
            pytest.fail("two had the folder")
        with exclusive_folder(place / "other"):
            pass
    with contextlib.ExitStack() as stack:
        stack.enter_context(exclusive_folder(place / "out"))
    assert names_in(place / "out") == []


def test_partial_files_of_other_programs_are_kept(place):
    kept = ["a.energy.h5", "a.energy.h5.12345678", "b.energy.h5.12345678.part", "xa.energy.h5.12345678.part"]
    for name in (*kept, "a.energy.h5.12345678.part", "a.energy.h5.abcdef01.part"):
        (place / "runs" / "deep" / name).touch()
    clear_parts(place / "runs" / "deep", {"a.energy.h5"})
    assert names_in(place / "runs" / "deep") == sorted(["c.h5", *kept])
