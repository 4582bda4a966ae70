"""Campaigns over many recordings: outcome of each, and output equal to that of single recordings."""

import errno
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba.campaign import (
    Campaign,
    CampaignOptions,
    RecordingFile,
    campaign,
    existing_output,
    find_recordings,
    task_actions,
)
from ertis_numba.settings import Air
from ertis_numba.storage import open_energyscapes, write_recording
from tests.campaigns import InlinePool, ended, names_in, outcomes, run_here, write_recordings
from tests.files import SMALL, line, noise

pytestmark = pytest.mark.usefixtures("sound_unchecked")

RANGE_M = (0.5, 0.8)
FEW_MICS = line(8, 8)


def narrow(settings):
    return settings.replace(processing=settings.processing.replace(range_m=RANGE_M))


def other(settings):
    return settings.replace(processing=settings.processing.replace(range_m=(0.5, 0.7)))


def exact(settings):
    return narrow(settings).replace(accuracy=settings.accuracy.replace(oversampling=48))


def warm(settings):
    return narrow(settings).replace(air=Air(temperature_c=30.0))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Return a folder of recordings, which tests copy."""
    folder = tmp_path_factory.mktemp("recorded") / "runs"
    write_recordings(folder, settings=FEW_MICS)
    return folder


@pytest.fixture
def runs(recorded, tmp_path, monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")  # otherwise the creation dates would differ
    monkeypatch.chdir(tmp_path)
    return shutil.copytree(recorded, tmp_path / "runs")


@pytest.fixture(scope="module")
def made_once(recorded, tmp_path_factory):
    """Return a folder with the output of all recordings."""
    folder = tmp_path_factory.mktemp("made_once")
    with pytest.MonkeyPatch.context() as patch:
        found, _ = run_here(patch, [recorded], folder, CampaignOptions(settings=narrow))
    assert set(outcomes(found).values()) == {"made"}
    return folder


@pytest.fixture
def made(made_once, out):
    """Put the output of all recordings into the folder of a test."""
    return shutil.copytree(made_once, out)


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out"


def states(folder):
    return {item.name: (item.stat().st_ino, item.stat().st_mtime_ns) for item in folder.iterdir()}


def test_files_equal_those_of_single_recordings(runs, out, monkeypatch):
    found, pool = run_here(monkeypatch, [runs], out, CampaignOptions(settings=narrow))
    assert outcomes(found) == dict.fromkeys(["a.h5", "b.h5", "c.h5", "d.h5"], "made")
    assert [task.arguments["warm"] for task in pool.given if task.action == "plan"] == [True, False]  # one per air
    assert found["a.h5"].made["measurements"] == 3
    for name in "ad":  # at different air temperatures, and d with a plan made for b
        single = out / "single.h5"
        arguments = [str(runs / f"{name}.h5"), "-o", str(single), "--range", "0.5:0.8", "--force"]
        assert CliRunner().invoke(cli, ["process", *arguments]).exit_code == 0
        assert single.read_bytes() == (out / f"{name}.energy.h5").read_bytes()


def test_single_recording_is_reported_like_many(runs, out, monkeypatch):
    monkeypatch.undo()  # This test needs the checks.
    found, _ = run_here(monkeypatch, [runs / "a.h5"], out, CampaignOptions(settings=narrow, explain=True, verify=True))
    arguments = [str(runs / "a.h5"), "--range", "0.5:0.8", "--explain", "--verify", "--json"]
    single = json.loads(CliRunner().invoke(cli, ["process", *arguments]).stdout)
    many = found["a.h5"].made
    place = f"{runs / 'a.h5'}: sensor eRTIS-7"
    on_call, on_line, on_grid = many.pop("warnings")
    assert on_call.startswith(f"{place}: the record contains no sweep above the noise")
    assert on_line.startswith(f"{place} has its microphones on a horizontal line; the elevation is unknown")
    assert on_grid.startswith(f"{place}: directions are 30.0° apart")
    assert single.pop("output") == str(runs / "a.energy.h5")
    assert list(single) == list(many)
    for each in (single, many):
        assert each["verified"] == each["sensors"][0]["verified"]
        assert each["plan"] == each["sensors"][0]["plan"]
    for each in (single, single["sensors"][0], many, many["sensors"][0]):
        assert each.pop("median_ms") > 0
        for measured in ("plan", "verified"):
            assert isinstance(each.pop(measured), dict)  # it contains measured times, which differ
    assert single == many


def test_invalid_plan_is_refused(runs, out, monkeypatch):
    def on_paper(settings):
        return settings.replace(processing=settings.processing.replace(method="paper"))

    found, _ = run_here(monkeypatch, [runs / "a.h5"], out, CampaignOptions(settings=on_paper, explain=True))
    assert "need a plan, but method 'paper' has none; use method 'fast'" in found["a.h5"].error


@pytest.mark.usefixtures("made")
def test_existing_output_is_kept(runs, out, monkeypatch):
    before = states(out)
    (out / "b.energy.h5").unlink()
    found, pool = run_here(monkeypatch, [runs], out, CampaignOptions(settings=narrow, overwrite=True))
    assert outcomes(found) == {"a.h5": "kept", "b.h5": "made", "c.h5": "kept", "d.h5": "kept"}
    assert [task.arguments["path"] for task in pool.given if task.action == "make"] == [str(runs / "b.h5")]
    after = states(out)
    assert {name: after[name] for name in after if name != "b.energy.h5"} == {
        name: before[name] for name in before if name != "b.energy.h5"
    }


@pytest.mark.parametrize(
    ("wanted", "stated"),
    [
        (CampaignOptions(settings=other), r"was made with other settings \(processing\.range_m of sensor eRTIS-7\)"),
        (CampaignOptions(settings=exact), r"was made with other settings \(accuracy\.oversampling of sensor eRTIS-7\)"),
        (CampaignOptions(settings=warm), r"was made with other settings \(air\.temperature_c of sensor eRTIS-7\)"),
        (CampaignOptions(settings=narrow, dtype="float16"), "contains float32, not float16"),
    ],
)
@pytest.mark.usefixtures("made")
def test_differing_output_is_reported_or_replaced(runs, out, monkeypatch, wanted, stated):
    before = states(out)
    found, _ = run_here(monkeypatch, [runs / "a.h5"], out, wanted)
    for event in found.values():
        assert event.outcome == "failed"
        assert f"output {event.output} exists and " in event.error
        assert re.search(stated, event.error)
    assert states(out) == before
    replaced = CampaignOptions(settings=wanted.settings, dtype=wanted.dtype, overwrite=True)
    found, _ = run_here(monkeypatch, [runs / "a.h5"], out, replaced)
    assert set(outcomes(found).values()) == {"made"}
    found, _ = run_here(monkeypatch, [runs / "a.h5"], out, wanted)
    assert set(outcomes(found).values()) == {"kept"}


@pytest.mark.usefixtures("made")
def test_output_of_another_recording_is_reported(runs, out, monkeypatch):
    write_recording(runs / "a.h5", noise(FEW_MICS, count=3, seed=9), overwrite=True)
    found, _ = run_here(monkeypatch, [runs / "a.h5"], out, CampaignOptions(settings=narrow))
    assert "exists and was made from another recording" in found["a.h5"].error


@pytest.mark.usefixtures("made")
def test_output_of_a_copied_recording_is_kept(runs, out, monkeypatch):
    with h5py.File(runs / "a.h5", "r+") as file:
        file.attrs["remark"] = "written to"
    found, _ = run_here(monkeypatch, [runs / "a.h5"], out, CampaignOptions(settings=narrow))
    assert "exists and was made from another file of the same recording" in found["a.h5"].error


@pytest.mark.usefixtures("made")
def test_output_of_another_version_is_reported(runs, out, monkeypatch):
    newer = {"ertis-numba": "99.0"}
    monkeypatch.setattr(existing_output, "software_versions", lambda: newer)
    found, _ = run_here(monkeypatch, [runs / "a.h5"], out, CampaignOptions(settings=narrow))
    assert "exists and was made by ertis-numba 0" in found["a.h5"].error
    assert "this is 99.0" in found["a.h5"].error


@pytest.mark.parametrize("content", [b"", b"mine", None])
def test_foreign_file_is_not_replaced(runs, out, monkeypatch, content):
    out.mkdir()
    recording = content is None
    content = (runs / "b.h5").read_bytes() if recording else content
    (out / "a.energy.h5").write_bytes(content)
    found, _ = run_here(monkeypatch, [runs / "a.h5"], out, CampaignOptions(overwrite=recording))
    stated = "is a recording; choose another folder" if recording else "is not a readable energyscape file"
    assert f"exists and {stated}" in found["a.h5"].error
    assert (out / "a.energy.h5").read_bytes() == content


def test_output_of_a_changed_grid_file_is_reported(runs, out, monkeypatch, tmp_path):
    grid = tmp_path / "grid.csv"

    def by_file(settings):
        return settings.replace(processing=settings.processing.replace(range_m=RANGE_M, directions="grid.csv"))

    grid.write_text("-10,0\n10,0\n")
    run_here(monkeypatch, [runs / "a.h5"], out, CampaignOptions(settings=by_file))
    found, _ = run_here(monkeypatch, [runs / "a.h5"], out, CampaignOptions(settings=by_file))
    assert outcomes(found) == {"a.h5": "kept"}
    grid.write_text("-10,0\n11,0\n")
    found, _ = run_here(monkeypatch, [runs / "a.h5"], out, CampaignOptions(settings=by_file))
    assert "other settings (grid of sensor eRTIS-7)" in found["a.h5"].error


def test_failing_recording_does_not_stop_the_rest(runs, out, monkeypatch):
    with h5py.File(runs / "b.h5", "r+") as file:
        file["sensors/eRTIS-7/pdm"][1, 777] ^= 1 << 5
    (runs / "c.h5").write_bytes((runs / "c.h5").read_bytes()[:50_000])
    found, _ = run_here(monkeypatch, [runs, runs / "none.h5"], out, CampaignOptions(settings=narrow))
    assert outcomes(found) == {"a.h5": "made", "b.h5": "failed", "c.h5": "failed", "d.h5": "made", "none.h5": "failed"}
    assert "b.h5: measurement 1 has CRC-32" in found["b.h5"].error
    assert "c.h5 is cut short or damaged" in found["c.h5"].error
    assert "none.h5: No such file" in found["none.h5"].error
    assert names_in(out) == ["a.energy.h5", "d.energy.h5"]


def test_unreachable_budget_is_reported_per_recording(runs, out, monkeypatch):
    def hopeless(settings):
        return narrow(settings).replace(accuracy=settings.accuracy.replace(max_error_db=-199.0))

    found, pool = run_here(monkeypatch, [runs], out, CampaignOptions(settings=hopeless))
    assert set(outcomes(found).values()) == {"failed"}
    for name, event in found.items():
        assert event.error.startswith(f"{runs / name}: accuracy.max_error_db is -199, but the smallest error")
    assert [task.action for task in pool.given].count("plan") == 2  # each is planned once
    assert names_in(out) == []


def test_energyscape_files_are_skipped_unless_named(runs, out, monkeypatch):
    run_here(monkeypatch, [runs / "a.h5"], runs, CampaignOptions(settings=narrow))  # output beside recordings
    found, _ = run_here(monkeypatch, [runs], runs, CampaignOptions(settings=narrow))
    assert found["a.energy.h5"].outcome == "skipped"
    assert outcomes(found)["a.h5"] == "kept"
    found, _ = run_here(monkeypatch, [runs / "a.energy.h5"], out)
    assert "a.energy.h5 is an energyscape file, wanted a recording" in found["a.energy.h5"].error


def test_sensors_of_a_recording_share_its_output(tmp_path, out, monkeypatch):
    left = (replace(each, stamp=replace(each.stamp, sensor="left")) for each in noise(line(8, 8), count=2, seed=5))
    several = [*noise(count=2), *left]
    write_recording(tmp_path / "two.h5", several)
    found, _ = run_here(monkeypatch, [tmp_path / "two.h5"], out, CampaignOptions(settings=narrow))
    assert [row["sensor"] for row in found["two.h5"].made["sensors"]] == ["eRTIS-7", "left"]
    found, _ = run_here(monkeypatch, [tmp_path / "two.h5"], out, CampaignOptions(settings=narrow, sensor="left"))
    assert "exists and contains sensor eRTIS-7, left, not left" in found["two.h5"].error


def test_faulty_microphones_are_reported_or_refused(tmp_path, out, monkeypatch):
    monkeypatch.undo()  # This test needs the checks.
    measurements = noise(count=2)
    for measurement in measurements:
        measurement.data[:] &= np.uint32(0xFFFFFFFE)
    write_recording(tmp_path / "worn.h5", measurements)
    found, _ = run_here(monkeypatch, [tmp_path / "worn.h5"], out, CampaignOptions(settings=narrow, strict=True))
    assert "stuck at 0: channel 0" in found["worn.h5"].error
    found, _ = run_here(monkeypatch, [tmp_path / "worn.h5"], out, CampaignOptions(settings=narrow))
    assert "stuck at 0: channel 0" in found["worn.h5"].made["warnings"][0]


def test_memory_and_tasks_are_independent_of_the_number_of_recordings(tmp_path, out, monkeypatch):
    most_kept, most_in_hand = [], []
    follow = task_actions.run_task

    def watched(*arguments):
        result = follow(*arguments)
        most_kept.append(len(vars(task_actions)["_idle_pipelines"]))
        return result

    monkeypatch.setattr("tests.campaigns.run_task", watched)
    for number in range(7):  # successive ones differ in air temperature and so need different pipelines
        settings = FEW_MICS.replace(air=Air(temperature_c=float(number % 3)))
        write_recording(tmp_path / f"{number:02}.h5", noise(settings, count=1, seed=number))
    found, pool = run_here(monkeypatch, [tmp_path], out, CampaignOptions(settings=narrow))
    assert set(outcomes(found).values()) == {"made"}
    assert max(most_kept) == 1
    place = {"look": 0, "make": 0}
    for task in pool.given:
        if task.action in place:
            place[task.action] += 1
            most_in_hand.append(place["look"] - place["make"])
    assert max(most_in_hand) <= pool.size + 3


def test_temporary_planning_failure_is_repeated(runs, out, monkeypatch):
    chances = [{"error": "no memory", "by_chance": True}]

    def short_of_memory(do, *arguments):
        return chances.pop() if do == "plan" and chances else task_actions.run_task(do, *arguments)

    monkeypatch.setattr("tests.campaigns.run_task", short_of_memory)
    found, _ = run_here(
        monkeypatch, [runs / "a.h5", runs / "c.h5"], out, CampaignOptions(settings=narrow)
    )  # at the same air temperature
    assert outcomes(found) == {"a.h5": "failed", "c.h5": "made"}
    assert found["a.h5"].error == "no memory"


@pytest.mark.parametrize("error", [MemoryError(), OSError(5, "Input/output error")])
def test_temporary_errors_are_marked(runs, monkeypatch, error):
    def fails(*_, **__):
        raise error

    monkeypatch.setattr(task_actions, "sensor_names", fails)
    reported = task_actions.run_task("look", {"path": str(runs / "a.h5"), "named": True, "sensor": None})
    assert reported == {"error": str(error) or "MemoryError", "by_chance": True}


def test_leftovers_are_searched_only_after_a_worker_died(runs, out, monkeypatch):
    searched = []

    def died_of_c(do, about, *more):
        if do == "make" and about["path"].endswith("c.h5"):
            return {"error": "ended by SIGKILL", "by_chance": True}
        return task_actions.run_task(do, about, *more)

    monkeypatch.setattr("tests.campaigns.run_task", died_of_c)
    monkeypatch.setattr(campaign, "clear_parts", lambda _, names: searched.append(set(names)))
    (runs / "b.h5").write_bytes(b"no recording")
    found, _ = run_here(monkeypatch, [runs], out, CampaignOptions(settings=narrow))
    assert outcomes(found) == {"a.h5": "made", "b.h5": "failed", "c.h5": "failed", "d.h5": "made"}
    assert searched[1:-1] == [{"c.energy.h5"}]  # between the searches before and after the campaign


def test_duplicate_pipeline_of_another_thread_is_closed(monkeypatch):
    existing_output = []

    class Counted:
        def __init__(self, settings, **_):
            self.settings, self.closed = settings, 0
            existing_output.append(self)

        def close(self):
            self.closed += 1

    monkeypatch.setattr(task_actions, "Pipeline", Counted)
    monkeypatch.setattr(task_actions, "_idle_pipelines", {})
    borrow = vars(task_actions)["_pipelines"]
    with borrow([SMALL], "cpu", 1) as (first,), borrow([SMALL], "cpu", 1) as (second,):
        assert first is not second
    with borrow([SMALL], "cpu", 1) as (again,):
        assert [each.closed for each in existing_output] == [again is not each for each in existing_output]


class Watched(InlinePool):
    """Worker pool that records the number of its tasks at each submission and at each new limit."""

    def __init__(self, size):
        super().__init__(size)
        self.limited_at, self.in_hand = [], []

    def limit(self, size):
        super().limit(size)
        if not self.limited_at:
            self.in_hand.clear()
        self.limited_at.append(len(self.tasks))

    def submit(self, task):
        super().submit(task)
        self.in_hand.append(len(self.tasks))


@pytest.mark.parametrize(("workers", "largest"), [(None, 1), (3, 3)])
def test_gpu_runs_one_task_at_a_time(tmp_path, out, monkeypatch, workers, largest):
    """Once a worker reports a GPU, the campaign submits no task until fewer are in progress than the limit."""

    def on_a_gpu(*arguments):
        return {
            name: "cuda" if name == "device" else value for name, value in task_actions.run_task(*arguments).items()
        }

    pool = Watched(3)
    write_recordings(tmp_path / "many", "abcdef", count=1, settings=FEW_MICS)
    monkeypatch.setattr("tests.campaigns.run_task", on_a_gpu)
    monkeypatch.setattr(Campaign, "_pool", lambda _: pool)
    found = ended(
        Campaign(find_recordings([tmp_path / "many"]), out, CampaignOptions(settings=narrow), workers=workers).run()
    )
    assert set(outcomes(found).values()) == {"made"}
    assert max(pool.in_hand) == largest
    assert pool.size == largest
    if workers is None:
        assert pool.limited_at[0] > 1  # otherwise the limit would have no effect


@pytest.mark.parametrize(
    ("wanted", "workers", "count", "found"),
    [
        (CampaignOptions(), None, 9, 4),
        (CampaignOptions(), None, 3, 3),
        (CampaignOptions(), 6, 9, 6),
        (CampaignOptions(threads=2), None, 9, 2),
        (CampaignOptions(threads=9), None, 9, 1),
        (CampaignOptions(device="cuda"), None, 9, 1),
        (CampaignOptions(device="cuda"), 2, 9, 2),
    ],
)
def test_number_of_workers_follows_the_cores(monkeypatch, tmp_path, wanted, workers, count, found):
    monkeypatch.setattr(campaign, "usable_cores", lambda: 4)
    recordings = [RecordingFile(Path(f"{number}.h5")) for number in range(count)]
    assert Campaign(recordings, tmp_path / "out", wanted, workers=workers).workers == found


def test_partial_files_are_removed_before_and_after(runs, out, monkeypatch):
    out.mkdir()
    (out / "a.energy.h5.0123abcd.part").write_bytes(b"half")
    (out / "z.energy.h5.0123abcd.part").write_bytes(b"of another campaign")
    run_here(monkeypatch, [runs / "a.h5"], out, CampaignOptions(settings=narrow))
    assert names_in(out) == ["a.energy.h5", "z.energy.h5.0123abcd.part"]
    with open_energyscapes(out / "a.energy.h5") as images:
        assert len(images) == 3


def test_unwritable_folder_is_reported_with_a_remedy(monkeypatch, tmp_path):
    def refused(*_):
        raise OSError(errno.EROFS, "Read-only file system", str(tmp_path / "a.energy.h5.0123abcd.part"))

    monkeypatch.setitem(vars(task_actions)["_ACTIONS"], "make", refused)
    reported = task_actions.run_task("make", {})
    assert (
        reported["error"]
        == f"{tmp_path / 'a.energy.h5'}: Read-only file system; check the permissions of the file and its "
        "folder, or choose another"
    )
    assert reported["by_chance"]


def test_other_errors_of_settings_end_the_campaign(runs, out, monkeypatch):
    def wrong(_):
        raise KeyError("a mistake in the program")

    with pytest.raises(KeyError, match="a mistake in the program"):
        run_here(monkeypatch, [runs], out, CampaignOptions(settings=wrong))
    assert names_in(out) == []
