"""Arrays with PCM samples, from scenes to recordings and images."""

import dataclasses

import h5py
import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.journal import Journal
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Accuracy, Call, Recording, Settings
from ertis_numba.settings.beamformers import BEAMFORMERS
from ertis_numba.simulation import Electronics, Point, Scene
from ertis_numba.simulation.render import Simulator
from ertis_numba.storage import RecordingWriter, open_recording, write_recording
from ertis_numba.storage.sealing import seal
from tests import cases
from tests.files import open_dataset
from tests.rings import PCM, POINTS, RATE_HZ, heard, scene_of, sensor_of
from tests.scenes import only


@pytest.fixture(scope="module")
def measurement():
    return heard(PCM)


# ---- the same scene, as numbers and as bits -------------------------------------------------------


@pytest.mark.parametrize("encoding", ["int16", "float32"])
@pytest.mark.parametrize(("rate_hz", "step"), [(125_000.0, 2), (192_000.0, 4), (900_000.0, 18)])
def test_pcm_reflectors_match_the_scene(encoding, rate_hz, step):
    settings = PCM.replace(
        recording=Recording(sample_rate_hz=rate_hz, n_samples=round(rate_hz / 64), encoding=encoding),
        processing=PCM.processing.replace(range_decimation=step),
    )
    peaks = ertis.find_peaks(Pipeline(settings, predict=False).process(heard(settings)), top=2)
    for peak, point in zip(peaks, POINTS, strict=True):
        assert peak.azimuth_deg == pytest.approx(point.azimuth_deg, abs=0.2)
        assert peak.range_m == pytest.approx(point.range_m, abs=1e-3)


def test_linear_sweep_reflectors_match_the_scene():
    settings = PCM.replace(call=Call(modulation="linear"))
    peaks = ertis.find_peaks(Pipeline(settings, predict=False).process(heard(settings)), top=2)
    assert [peak.range_m for peak in peaks] == pytest.approx([point.range_m for point in POINTS], abs=1e-3)
    wrong = ertis.find_peaks(
        Pipeline(PCM, predict=False).process(dataclasses.replace(heard(settings), settings=PCM)), top=1
    )
    assert abs(wrong[0].range_m - POINTS[0].range_m) > 0.02


def test_pcm_image_equals_the_pdm_image():
    """Differences are the modulators' noise and echoes between ranges."""
    fine = PCM.processing.replace(range_decimation=1)
    bits = PCM.replace(recording=Recording(n_samples=70_000), processing=fine.replace(range_decimation=25))
    numbers = PCM.replace(processing=fine)
    of_bits, of_numbers = (
        Pipeline(given, max_error_db="fine", predict=False).process(heard(given)) for given in (bits, numbers)
    )
    levels = [[peak.level_db for peak in ertis.find_peaks(image, top=2)] for image in (of_bits, of_numbers)]
    assert levels[0] == pytest.approx(levels[1], abs=0.1)
    assert of_bits.amplitude.max() == pytest.approx(of_numbers.amplitude.max(), rel=0.01)


def test_pcm_converters_have_noise_and_faults():
    electronics = Electronics(noise_dbfs=-40.0, dead_channels=(2,), stuck_low=(5,), stuck_high=(6,))
    sensor = sensor_of(PCM, electronics=electronics)
    simulator = Simulator(Scene(seed=4, sensors=(sensor,)), plan=only("microphone_noise", "microphone_faults"))
    words = simulator.render().data
    assert words.dtype == np.int16
    assert words.shape == (3_000, 8)
    assert (words[:, 5] == -32_768).all()
    assert (words[:, 6] == 32_767).all()
    rms = np.std(words[:, [0, 1, 2, 3, 4, 7]] / 32_768, axis=0)
    assert rms == pytest.approx(0.01, rel=0.06)
    assert np.abs(np.corrcoef(words[:, [0, 1, 3, 4]].T) - np.eye(4)).max() < 0.1
    assert (simulator.render().data == words).all()


def test_pcm_samples_clip_at_full_scale():
    loud = Point(azimuth_deg=0.0, elevation_deg=0.0, range_m=0.6, strength_db=20.0)
    words = Simulator(scene_of(PCM).replace(points=(loud,))).render().data
    assert (words.min(), words.max()) == (-32_768, 32_767)


# ---- recordings -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["PCM of 16 bits", "PCM, calibrated"])
def test_pcm_recording_keeps_every_sample(tmp_path, name):
    given = cases.noise(cases.CASES[name])
    path = write_recording(tmp_path / "rec.h5", [given])
    with open_recording(path) as recording:
        back = recording[0]
        assert np.array_equal(back.data, given.data)
        assert back.data.dtype == given.data.dtype
        assert recording.settings.recording == given.settings.recording
        image = Pipeline(recording.settings, predict=False).process(back)
    assert np.array_equal(image.amplitude, Pipeline(given.settings, predict=False).process(given).amplitude)


def test_pcm_recording_opens_in_xarray(tmp_path, measurement):
    path = write_recording(tmp_path / "rec.h5", [measurement])
    for engine in ("h5netcdf", "netcdf4"):
        with open_dataset(path, group="/sensors/sensor", engine=engine, decode_timedelta=False) as data:
            assert data["pcm"].dims == ("time", "sample", "microphone")
            assert data["pcm"].attrs["sample_rate_hz"] == RATE_HZ
            assert np.array_equal(data["pcm"][0], measurement.data)
            assert "pdm" not in data


def test_pdm_and_pcm_sensors_share_a_recording(tmp_path, measurement):
    bits = cases.noise(cases.CASES["line of 8"])
    with RecordingWriter(tmp_path / "rec.h5") as writer:
        writer.write(dataclasses.replace(bits, stamp=ertis.Stamp(sensor="bits")))
        writer.write(dataclasses.replace(measurement, stamp=ertis.Stamp(sensor="numbers")))
    for name, given in (("bits", bits), ("numbers", measurement)):
        with open_recording(tmp_path / "rec.h5", sensor=name) as recording:
            assert np.array_equal(recording[0].data, given.data)


def test_recording_with_contradicting_settings_is_refused(tmp_path, measurement):
    path = write_recording(tmp_path / "rec.h5", [measurement])
    with h5py.File(path, "r+") as file:
        group = file["sensors/sensor"]
        text = group["settings"][()].decode().replace('"int16"', '"float32"')
        del group["settings"]
        group.create_dataset("settings", data=np.bytes_(text.encode()))
    with pytest.raises(
        DataError,
        match=r"pcm contains int16, but the settings in the file give float32 \(recording\.encoding 'float32'\)",
    ):
        open_recording(path)


def test_pcm_journal_is_sealed_unchanged(tmp_path, measurement):
    path = tmp_path / "run.h5.journal"
    with Journal.create(path, target=tmp_path / "run.h5") as journal:
        journal.add_sensor("sensor", measurement.settings)
        journal.append([ertis.JournalEntry(measurement, 0)])
    sealed = seal(path)
    with open_recording(sealed.recording) as recording:
        assert np.array_equal(recording[0].data, measurement.data)


def test_pcm_journal_with_nan_is_sealed(tmp_path):
    settings = PCM.replace(recording=PCM.recording.replace(encoding="float32"))
    words = np.zeros((3_000, 8), np.float32)
    words[17, 3] = np.nan
    path = tmp_path / "run.h5.journal"
    with Journal.create(path, target=tmp_path / "run.h5") as journal:
        journal.add_sensor("sensor", settings)
        journal.append([ertis.JournalEntry(ertis.Measurement(words, settings), 0)])
    with open_recording(seal(path).recording) as recording:
        assert np.array_equal(recording[0].data, words, equal_nan=True)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (np.zeros((3_000, 8), np.float32), r"has float32 words of shape \(3000, 8\), but its settings describe int16"),
        (np.zeros((3_000, 7), np.int16), r"shape \(3000, 7\), but its settings describe int16 of shape \(3000, 8\)"),
        (np.zeros(3_000, np.uint32), "has uint32 words"),
    ],
)
def test_samples_of_another_type_are_refused(words, message):
    with pytest.raises(DataError, match=message):
        Pipeline(PCM, predict=False).process(ertis.Measurement(words, PCM))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_pcm_samples_with_nan_are_refused(value):
    settings = PCM.replace(recording=PCM.recording.replace(encoding="float32"))
    words = np.zeros((3_000, 8), np.float32)
    words[17, 3] = value
    with pytest.raises(DataError, match=rf"holds {value} at sample 17 of channel 3; pass finite numbers"):
        Pipeline(settings, predict=False).process(ertis.Measurement(words, settings))


def test_pdm_sensor_refuses_pcm_settings():
    with pytest.raises(ArgumentError, match=r"recording\.encoding is 'int16', but a sensor sends bits; use 'pdm'"):
        ertis.Setup.of(Settings().replace(recording=Recording(n_samples=65_536, encoding="int16")))


# ---- health ---------------------------------------------------------------------------------------


def test_faults_are_found_in_pcm():
    settings = PCM.replace(recording=PCM.recording.replace(n_samples=30_000))
    words = heard(settings).data.astype(np.float64)
    time_s = np.arange(len(words)) / RATE_HZ
    words[:, 1] = 0
    words[:, 2] = -321
    words[:, 3] += 0.2 * 32_768
    words[:, 4] = 32_768 * 1.5 * np.sin(2 * np.pi * 40e3 * time_s)
    words[:, 5] = 30 * np.random.default_rng(1).standard_normal(len(words))
    words[:, 6] += 500 * np.sin(2 * np.pi * 31e3 * time_s)
    given = np.clip(np.rint(words), -32_768, 32_767).astype(np.int16)
    report = ertis.health(ertis.Measurement(given, settings))
    assert report.channels[0].faults == ()
    assert report.channels[1].faults == ("stuck at 0",)
    assert report.channels[2].faults == (f"stuck at {-321 / 32_768:g}",)
    assert "offset" in report.channels[3].faults
    assert "saturated" in report.channels[4].faults
    assert report.channels[5].faults == ("dead",)
    assert report.channels[6].faults == ("idle tone",)
    assert report.channels[6].tone_hz == pytest.approx(31e3, abs=2 * RATE_HZ / 2**11)
    assert report.channels[7].faults == ()


@pytest.mark.parametrize("beamformer", BEAMFORMERS)
@pytest.mark.parametrize("exponent", [-126, -60, 40, 100])
def test_image_is_linear_in_the_samples(beamformer, exponent):
    settings = PCM.replace(
        recording=PCM.recording.replace(encoding="float32"),
        processing=PCM.processing.replace(beamformer=beamformer, directions="2d:31"),
        accuracy=Accuracy(max_error_db=-20.0),
    )
    given = heard(settings)
    scaled = dataclasses.replace(given, data=np.ldexp(given.data, exponent))
    with Pipeline(settings, device="numpy", predict=False) as pipeline:
        wanted, found = (pipeline.process(each).amplitude.astype(np.float64) for each in (given, scaled))
        (again,) = pipeline.process_batch([scaled])
    np.testing.assert_allclose(np.ldexp(found, -exponent), wanted, rtol=1e-3, atol=1e-6 * wanted.max())
    np.testing.assert_array_equal(again.amplitude, found)
    assert len(ertis.find_peaks(again, top=2)) == 2


def test_image_beyond_float32_is_refused():
    given = heard(PCM.replace(recording=PCM.recording.replace(encoding="float32")))
    loudest = np.where(given.data >= 0, np.float32(3.4e38), np.float32(-3.4e38))  # square waves exceed their own peak
    with (
        Pipeline(given.settings, device="numpy", predict=False) as pipeline,
        pytest.raises(
            DataError, match=r"reach 2\^128, so its image exceeds the largest float32, .* divide the samples"
        ),
    ):
        pipeline.process(dataclasses.replace(given, data=loudest))
