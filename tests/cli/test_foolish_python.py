# ruff: noqa: ARG005
"""Common mistakes of newcomers in calls of public functions are refused quickly, in one line."""

import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.io.wavfile

import ertis_numba as ertis
from ertis_numba.storage import open_recording

RECORDING = Path(__file__).parents[2] / "data" / "synthetic" / "reflectors.h5"
PLACES = {"sensor": ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))}
TIMEOUT_S = 10.0
MAX_LENGTH = 500


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    """Valid inputs, from which the invalid calls are made."""
    folder = tmp_path_factory.mktemp("foolish")
    with open_recording(RECORDING) as recording:
        measurement = recording[0]
    recorded = measurement.settings
    settings = recorded.replace(processing=recorded.processing.replace(directions="2d:31", range_m=(0.5, 2.0)))
    measurement = replace(measurement, settings=settings)
    pipeline = ertis.Pipeline(settings, predict=False)
    image = pipeline.process(measurement)
    (folder / "empty.h5").write_bytes(b"")
    (folder / "text.h5").write_text("hello")
    (folder / "dir.h5").mkdir()
    scipy.io.wavfile.write(folder / "a.wav", 48_000, np.zeros((100, 2), np.int16))
    ertis.write_energyscapes(folder / "img.h5", [image])
    closed = open_recording(RECORDING)
    closed.close()
    return SimpleNamespace(
        folder=folder,
        settings=settings,
        recorded=recorded,
        measurement=measurement,
        pipeline=pipeline,
        image=image,
        cloud=ertis.PointExtractor(settings)(image),
        closed=closed,
    )


CALLS = {
    "Odometry(3)": lambda given: ertis.Odometry(3),
    "Odometry(mounting 3)": lambda given: ertis.Odometry({"front": 3}),
    "Odometry(mounting of text)": lambda given: ertis.Odometry({"front": (("a", 0, 0), (0, 0, 0, 1))}),
    "Odometry.add(3)": lambda given: ertis.Odometry(PLACES).add(3),
    "Odometry.add(image)": lambda given: ertis.Odometry(PLACES).add(given.image),
    "Odometry.add(texts)": lambda given: ertis.Odometry(PLACES).add("front"),
    "Odometry.remount(None)": lambda given: ertis.Odometry(PLACES).remount(None),
    "ego_velocity(3)": lambda given: ertis.ego_velocity(3, [given.image], PLACES),
    "ego_velocity(mountings list)": lambda given: ertis.ego_velocity([given.image], [given.image], [1]),
    "compensate_motion(image)": lambda given: ertis.compensate_motion(given.image, (1, 0, 0)),
    "compensate_motion(text)": lambda given: ertis.compensate_motion(given.cloud, "fast"),
    "compensate_motion(yaw text)": lambda given: ertis.compensate_motion(given.cloud, (1, 0, 0), "fast"),
    "Mapper(3)": lambda given: ertis.Mapper(3),
    "Mapper(height 3)": lambda given: ertis.Mapper(PLACES, height_m=3),
    "Mapper.add(pose text)": lambda given: ertis.Mapper(PLACES).add([given.image], (("a", 0, 0), (0, 0, 0, 1))),
    "Mapper.add(pose 3)": lambda given: ertis.Mapper(PLACES).add([given.image], 3),
    "Trajectory(None)": lambda given: ertis.Trajectory(None, None, None),
    "Trajectory(ragged)": lambda given: ertis.Trajectory([[1, 2], [3]], [[0, 0, 0]], [[0, 0, 0, 1]]),
    "Trajectory(source 3)": lambda given: ertis.Trajectory([1], [[0, 0, 0]], [[0, 0, 0, 1]], source=3),
    "Trajectory.at(text)": lambda given: ertis.Trajectory([1], [[0, 0, 0]], [[0, 0, 0, 1]]).at("now"),
    "write_tum(3)": lambda given: ertis.write_tum(given.folder / "t.tum", 3),
    "add_poses(3)": lambda given: ertis.add_poses(RECORDING, 3, output=given.folder / "p.h5"),
    "Pipeline(None)": lambda given: ertis.Pipeline(None),
    "Pipeline(3)": lambda given: ertis.Pipeline(3),
    "Pipeline('nope')": lambda given: ertis.Pipeline("nope"),
    "Pipeline(dir)": lambda given: ertis.Pipeline(given.folder),
    "Pipeline(device gpu)": lambda given: ertis.Pipeline(given.settings, device="gpu"),
    "Pipeline(threads 0)": lambda given: ertis.Pipeline(given.settings, threads=0),
    "Pipeline(threads 'two')": lambda given: ertis.Pipeline(given.settings, threads="two"),
    "Pipeline(max_error 3)": lambda given: ertis.Pipeline(given.settings, max_error_db=3),
    "Pipeline(max_error nan)": lambda given: ertis.Pipeline(given.settings, max_error_db=np.nan),
    "Pipeline(max_error str)": lambda given: ertis.Pipeline(given.settings, max_error_db="lots"),
    "Pipeline(recording file)": lambda given: ertis.Pipeline(RECORDING),
    "process(None)": lambda given: given.pipeline.process(None),
    "process(array)": lambda given: given.pipeline.process(given.measurement.data),
    "process(image)": lambda given: given.pipeline.process(given.image),
    "process(path)": lambda given: given.pipeline.process(RECORDING),
    "process(short)": lambda given: given.pipeline.process(
        replace(given.measurement, data=given.measurement.data[:10])
    ),
    "process(float words)": lambda given: given.pipeline.process(
        replace(given.measurement, data=given.measurement.data.astype(float))
    ),
    "process(2d words)": lambda given: given.pipeline.process(
        replace(given.measurement, data=given.measurement.data.reshape(2, -1))
    ),
    "process list": lambda given: given.pipeline.process([given.measurement]),
    "process_batch(one)": lambda given: given.pipeline.process_batch(given.measurement),
    "process_batch([None])": lambda given: list(given.pipeline.process_batch([None])),
    "Measurement(None)": lambda given: ertis.Measurement(None, given.settings),
    "Measurement(list)": lambda given: ertis.Measurement([1, 2, 3], given.settings),
    "Measurement(settings None)": lambda given: ertis.Measurement(given.measurement.data, None),
    "Measurement(settings str)": lambda given: ertis.Measurement(given.measurement.data, "default_25_50"),
    "Energyscape shapes": lambda given: ertis.Energyscape(
        given.image.amplitude[:5],
        given.image.azimuth_rad,
        given.image.elevation_rad,
        given.image.range_m,
        given.settings,
    ),
    "Energyscape lists": lambda given: ertis.Energyscape([[1]], [0], [0], [1], given.settings),
    "Energyscape nan": lambda given: ertis.find_peaks(
        given.image.replace(amplitude=np.full_like(given.image.amplitude, np.nan))
    ),
    "image.replace energy shape": lambda given: given.image.replace(amplitude=given.image.amplitude.T),
    "image.replace typo": lambda given: given.image.replace(enrgy=given.image.amplitude),
    "image.replace range": lambda given: given.image.replace(range_m=given.image.range_m[:-1]),
    "image.replace azimuth": lambda given: given.image.replace(azimuth_rad=given.image.azimuth_rad[:-1]),
    "cloud.replace position": lambda given: given.cloud.replace(position_m=given.cloud.position_m[:-1]),
    "cloud.replace 2 columns": lambda given: given.cloud.replace(position_m=given.cloud.position_m[:, :2]),
    "cloud.replace energy": lambda given: given.cloud.replace(amplitude=given.cloud.amplitude[:-1]),
    "cloud.replace typo": lambda given: given.cloud.replace(levels=1),
    "cloud.replace uncertainty": lambda given: given.cloud.replace(uncertainty_m=np.zeros((1, 1))),
    "cloud.replace confirmed": lambda given: given.cloud.replace(confirmed=np.zeros(1, bool)),
    "PointCloud wrong": lambda given: ertis.PointCloud(np.zeros((3, 2)), np.zeros(3), given.settings, ertis.Stamp()),
    "PointCloud lists": lambda given: ertis.PointCloud([[0, 0, 0]], [1], given.settings, ertis.Stamp()),
    "find_peaks(None)": lambda given: ertis.find_peaks(None),
    "find_peaks(array)": lambda given: ertis.find_peaks(given.image.amplitude),
    "find_peaks top 0": lambda given: ertis.find_peaks(given.image, top=0),
    "find_peaks top -1": lambda given: ertis.find_peaks(given.image, top=-1),
    "find_peaks top 2.5": lambda given: ertis.find_peaks(given.image, top=2.5),
    "find_peaks top str": lambda given: ertis.find_peaks(given.image, top="all"),
    "find_peaks level +": lambda given: ertis.find_peaks(given.image, min_level_db=30),
    "find_peaks level nan": lambda given: ertis.find_peaks(given.image, min_level_db=np.nan),
    "find_peaks where shape": lambda given: ertis.find_peaks(given.image, where=np.ones(3, bool)),
    "find_peaks where list": lambda given: ertis.find_peaks(given.image, where=[True]),
    "find_peaks where float": lambda given: ertis.find_peaks(given.image, where=np.ones(given.image.amplitude.shape)),
    "find_peaks alarm 2": lambda given: ertis.find_peaks(given.image, false_alarm=2),
    "find_peaks alarm 0": lambda given: ertis.find_peaks(given.image, false_alarm=0),
    "cfar alarm": lambda given: ertis.cfar_peaks(given.image, false_alarm=5),
    "cfar method": lambda given: ertis.cfar_peaks(given.image, method="os"),
    "cfar None": lambda given: ertis.cfar_peaks(None),
    "cfar within": lambda given: ertis.cfar_peaks(given.image, within_db=-3),
    "compare None": lambda given: ertis.compare(given.image, None),
    "compare peaks": lambda given: ertis.compare(given.image, ertis.find_peaks(given.image)),
    "compare swapped": lambda given: ertis.compare([], given.image),
    "compare dicts": lambda given: ertis.compare(given.image, [{"range_m": 1}]),
    "health None": lambda given: ertis.health(None),
    "health image": lambda given: ertis.health(given.image),
    "load_layout nope": lambda given: ertis.load_layout("eRTIS_v3d1"),
    "load_layout None": lambda given: ertis.load_layout(None),
    "load_layout dir": lambda given: ertis.load_layout(given.folder),
    "load_layout h5": lambda given: ertis.load_layout(RECORDING),
    "load_scene nope": lambda given: ertis.load_scene("nope.toml"),
    "load_scene h5": lambda given: ertis.load_scene(RECORDING),
    "load_scene dir": lambda given: ertis.load_scene(given.folder),
    "open_recording nope": lambda given: ertis.open_recording("nope.h5"),
    "open_recording empty": lambda given: ertis.open_recording(given.folder / "empty.h5"),
    "open_recording text": lambda given: ertis.open_recording(given.folder / "text.h5"),
    "open_recording dir": lambda given: ertis.open_recording(given.folder),
    "open_recording dir.h5": lambda given: ertis.open_recording(given.folder / "dir.h5"),
    "open_recording wav": lambda given: ertis.open_recording(given.folder / "a.wav"),
    "open_recording image": lambda given: ertis.open_recording(given.folder / "img.h5"),
    "open_recording sensor": lambda given: ertis.open_recording(RECORDING, sensor="lef"),
    "open_recording None": lambda given: ertis.open_recording(None),
    "open_recording 3": lambda given: ertis.open_recording(3),
    "open_recording list": lambda given: ertis.open_recording([RECORDING]),
    "recording[99]": lambda given: open_recording(RECORDING)[99],
    "recording['a']": lambda given: open_recording(RECORDING)["a"],
    "recording[0.5]": lambda given: open_recording(RECORDING)[0.5],
    "closed[0]": lambda given: given.closed[0],
    "open_energyscapes rec": lambda given: ertis.open_energyscapes(RECORDING),
    "open_energyscapes nope": lambda given: ertis.open_energyscapes("x.h5"),
    "open_pcm h5": lambda given: ertis.open_pcm(RECORDING),
    "open_pcm nope": lambda given: ertis.open_pcm("no.wav"),
    "open_pcm nosettings": lambda given: ertis.open_pcm(given.folder / "a.wav"),
    "open_pcm wrong settings": lambda given: list(ertis.open_pcm(given.folder / "a.wav", given.settings)),
    "open_raw": lambda given: list(ertis.open_raw(given.folder / "text.h5", given.settings)),
    "open_raw none": lambda given: list(ertis.open_raw([], given.settings)),
    "open_rtis_folder": lambda given: ertis.open_rtis_folder(given.folder),
    "open_rtis nope": lambda given: ertis.open_rtis_folder(given.folder / "zzz"),
    "write_recording empty": lambda given: ertis.write_recording(given.folder / "n.h5", []),
    "write_recording exists": lambda given: ertis.write_recording(RECORDING, [given.measurement]),
    "write_recording image": lambda given: ertis.write_recording(given.folder / "n2.h5", [given.image]),
    "write_recording one": lambda given: ertis.write_recording(given.folder / "n3.h5", given.measurement),
    "write_recording nodir": lambda given: ertis.write_recording(given.folder / "no" / "x.h5", [given.measurement]),
    "write_recording None": lambda given: ertis.write_recording(None, [given.measurement]),
    "write_energyscapes rec": lambda given: ertis.write_energyscapes(given.folder / "m.h5", [given.measurement]),
    "write_energyscapes empty": lambda given: ertis.write_energyscapes(given.folder / "m2.h5", []),
    "write_energyscapes one": lambda given: ertis.write_energyscapes(given.folder / "m3.h5", given.image),
    "write_energyscapes dtype": lambda given: ertis.write_energyscapes(
        given.folder / "m4.h5", [given.image], dtype="int8"
    ),
    "export unknown": lambda given: ertis.export(given.folder / "a.xyz", [given.image]),
    "export empty": lambda given: ertis.export(given.folder / "a.ply", []),
    "export one": lambda given: ertis.export(given.folder / "b.ply", given.image),
    "export None": lambda given: ertis.export(given.folder / "c.ply", [None]),
    "export noext": lambda given: ertis.export(given.folder / "d", [given.image]),
    "export path": lambda given: ertis.export(given.folder / "f.ply", RECORDING),
    "plot None": lambda given: ertis.plot(None),
    "plot array": lambda given: ertis.plot(given.image.amplitude),
    "plot range 0": lambda given: ertis.plot(given.image, dynamic_range_db=0),
    "plot range nan": lambda given: ertis.plot(given.image, dynamic_range_db=np.nan),
    "plot theme": lambda given: ertis.plot(given.image, theme="blue"),
    "plot peaks": lambda given: ertis.plot(given.image, peaks=[1, 2]),
    "plot columns": lambda given: ertis.plot(given.image, columns=3),
    "Scene(str)": lambda given: ertis.Scene("x"),
    "Scene count": lambda given: ertis.Scene(count=-1),
    "Scene points": lambda given: ertis.Scene(points=[(1, 2, 3)]),
    "Scene typo": lambda given: ertis.Scene(pionts=()),
    "render None": lambda given: ertis.render(None),
    "render settings": lambda given: ertis.render(given.settings),
    "render sensor": lambda given: ertis.render(ertis.Scene(), sensor="x"),
    "Simulator None": lambda given: ertis.Simulator(None),
    "Settings typo": lambda given: ertis.Settings(procesing=1),
    "preset": lambda given: ertis.Settings.from_preset("default_25_5"),
    "preset None": lambda given: ertis.Settings.from_preset(None),
    "processing range": lambda given: given.settings.replace(
        processing=given.settings.processing.replace(range_m=(5, 0))
    ),
    "range one": lambda given: given.settings.processing.replace(range_m=2),
    "range str": lambda given: given.settings.processing.replace(range_m="0.5:5"),
    "directions huge": lambda given: ertis.Pipeline(
        given.settings.replace(processing=given.settings.processing.replace(directions="3d:100000000"))
    ),
    "settings.replace typo": lambda given: given.settings.replace(proc=1),
    "Subscriber addr": lambda given: ertis.Subscriber("localhost"),
    "Subscriber product": lambda given: ertis.Subscriber("tcp://127.0.0.1:9", products=("images",)),
    "Subscriber None": lambda given: ertis.Subscriber(None),
    "SensorNode": lambda given: ertis.SensorNode("127.0.0.1"),
    "KeyPair": lambda given: ertis.KeyPair("a", "b", "c"),
    "ClientKeys": lambda given: ertis.ClientKeys(None, "x"),
    "Sonar None": lambda given: ertis.SonarDriver(None),
    "Sonar str": lambda given: ertis.SonarDriver("/dev/ttyACM0"),
    "Emulator empty": lambda given: ertis.Emulator([]),
    "Emulator None": lambda given: ertis.Emulator(None),
    "Emulator floats": lambda given: ertis.Emulator([np.zeros(8)]),
    "Setup": lambda given: ertis.Setup(n_samples=-1, pdm_rate_hz=4.5e6, codes=np.zeros(3), dac_rate_hz=450000),
    "PointExtractor None": lambda given: ertis.PointExtractor(None),
    "PointExtractor image": lambda given: ertis.PointExtractor(given.settings)(None),
    "PointExtractor other": lambda given: ertis.PointExtractor(given.recorded)(given.image),
    "PointExtractor top": lambda given: ertis.PointExtractor(given.settings, top=0),
    "Permission": lambda given: ertis.Permission(name="a", public="zz", role="boss"),
    "AllowList": lambda given: ertis.AllowList(keys=(1,)),
}

PYTHON = {
    "load_layout None",
    "open_recording None",
    "open_recording 3",
    "open_recording list",
    "recording[99]",
    "recording['a']",
    "recording[0.5]",
    "write_recording None",
    "Scene(str)",
    "Scene typo",
    "Settings typo",
}
"""Calls that Python itself refuses clearly: unknown arguments, indices, and what is no path."""


@pytest.mark.parametrize("name", CALLS)
def test_common_call_mistakes_are_refused_in_one_line(name, given):
    began_s, began_cpu_s = time.monotonic(), time.process_time()
    with pytest.raises((ertis.ErtisError, TypeError, IndexError)) as refused:
        CALLS[name](given)
    assert time.process_time() - began_cpu_s < TIMEOUT_S
    assert time.monotonic() - began_s < 10 * TIMEOUT_S  # A busy machine needs longer.
    text = str(refused.value)
    assert text
    assert "\n" not in text
    assert len(text) < MAX_LENGTH
    assert isinstance(refused.value, ertis.ErtisError) or name in PYTHON


def test_refused_calls_write_no_file(given):
    assert {path.name for path in given.folder.iterdir()} == {"empty.h5", "text.h5", "dir.h5", "a.wav", "img.h5"}
