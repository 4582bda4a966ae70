"""Import of WAV and Acoular files: all sample types, consecutive emissions, and refusals."""

import errno
import itertools
import json
import tracemalloc
import wave

import h5py
import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli
from scipy.io import wavfile

import ertis_numba as ertis
from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.geometry import microphones
from ertis_numba.interop import PcmReader
from ertis_numba.pipeline import Pipeline
from ertis_numba.pipeline.verification import error_db
from ertis_numba.sensor_check import check_recording
from ertis_numba.settings import Array, Call, Processing, Recording, Settings
from ertis_numba.storage import open_recording, write_recording
from tests.rings import PCM, RATE_HZ, RING, heard


@pytest.fixture(scope="module")
def measurement():
    return heard(PCM)


# ---- WAV ------------------------------------------------------------------------------------------


def write_wav(path, numbers, rate_hz=RATE_HZ):
    wavfile.write(path, rate_hz, numbers)
    return path


def numbers(n_samples=3_000, n_channels=8, seed=1):
    return np.clip(0.3 * np.random.default_rng(seed).standard_normal((n_samples, n_channels)), -1, 1 - 2.0**-15)


KINDS = {
    # what is in the file, what the recording has, by how much they may differ
    "8 bits": (lambda x: np.rint(x * 128 + 128).clip(0, 255).astype(np.uint8), "int16", 2.0**-7),
    "16 bits": (lambda x: np.rint(x * 2**15).astype(np.int16), "int16", 2.0**-16),
    "32 bits": (lambda x: np.rint(x * 2.0**31).astype(np.int32), "float32", 2.0**-24),
    "float": (lambda x: x.astype(np.float32), "float32", 2.0**-24),
    "64 bits": (lambda x: (x * 2.0**63 * (1 - 2.0**-30)).astype(np.int64), "float32", 2.0**-24),
    "double": (lambda x: x, "float32", 2.0**-24),
}


@pytest.mark.parametrize("kind", KINDS)
def test_wav_files_of_every_type_are_imported(tmp_path, kind):
    made, encoding, error = KINDS[kind]
    given = numbers()
    reader = ertis.open_pcm(write_wav(tmp_path / "a.wav", made(given)), PCM)
    (measurement,) = reader
    assert reader.settings.recording == Recording(sample_rate_hz=RATE_HZ, n_samples=3_000, encoding=encoding)
    assert np.abs(measurement.data / reader.settings.recording.full_scale - given).max() <= error


def test_wav_of_24_bits_keeps_its_precision(tmp_path):
    given = np.random.default_rng(1).integers(-(2**23), 2**23, (500, 8))
    with wave.open(str(tmp_path / "a.wav"), "wb") as file:
        file.setnchannels(8)
        file.setsampwidth(3)
        file.setframerate(RATE_HZ)
        file.writeframes(b"".join(int(x).to_bytes(3, "little", signed=True) for x in given.ravel()))
    (measurement,) = ertis.open_pcm(tmp_path / "a.wav", PCM.replace(processing=Processing(range_m=(0.1, 0.2))))
    assert (measurement.data * 2.0**23 == given).all()


def test_wav_of_one_channel_is_imported(tmp_path):
    one = PCM.replace(array=Array(layout="one", positions_m=((0.0, 0.0, 0.0),)))
    (measurement,) = ertis.open_pcm(write_wav(tmp_path / "a.wav", numbers()[:, 0].astype(np.float32)), one)
    assert measurement.data.shape == (3_000, 1)
    Pipeline(measurement.settings).process(measurement)


def test_consecutive_emissions_are_split(tmp_path):
    given = (numbers(10_000) * 2**15).astype(np.int16)
    paths = [write_wav(tmp_path / f"{name}.wav", given[: 10_000 - cut]) for name, cut in (("a", 0), ("b", 4_000))]
    reader = ertis.open_pcm(paths, PCM, skip_s=1_000 / RATE_HZ, length_s=2_500 / RATE_HZ)
    measurements = list(reader)
    assert len(reader) == len(measurements) == 5
    assert [item.stamp.sequence for item in measurements] == [0, 1, 2, 3, 4]
    starts = [1_000, 3_500, 6_000, 1_000, 3_500]
    assert all((m.data == given[s : s + 2_500]).all() for m, s in zip(measurements, starts, strict=True))
    assert reader.rest_s == pytest.approx(1_500 / RATE_HZ)


def test_fractional_periods_do_not_drift(tmp_path):
    """100 emissions follow each other after a seventieth of a second; a click marks each."""
    given = np.zeros((RATE_HZ * 100 // 70, 8), np.int16)
    given[np.rint(np.arange(100) * RATE_HZ / 70).astype(int)] = 1_000
    reader = ertis.open_pcm(write_wav(tmp_path / "a.wav", given), PCM, length_s=1 / 70, start_ns=5 * 10**18)
    measurements = list(reader)
    assert len(measurements) == len(reader) >= 99
    assert all(item.data[0, 0] == 1_000 for item in measurements)
    assert measurements[70].stamp.timestamp_ns == 5 * 10**18 + 10**9


def test_disabled_channel_may_contain_nan(tmp_path):
    given = numbers().astype(np.float32)
    given[100:, 3] = np.nan
    settings = PCM.replace(array=RING.replace(enabled=tuple(channel != 3 for channel in range(8))))
    (measurement,) = ertis.open_pcm(write_wav(tmp_path / "a.wav", given), settings)
    assert np.array_equal(measurement.data, np.where(np.isnan(given), 0, given))


def test_files_of_different_lengths_are_one_measurement_each(tmp_path):
    paths = [write_wav(tmp_path / f"{n}.wav", numbers(n)) for n in (6_000, 2_800)]
    reader = ertis.open_pcm(paths, PCM)
    assert [len(item.data) for item in reader] == [2_800, 2_800]
    assert reader.rest_s == pytest.approx(3_200 / RATE_HZ)


def test_large_files_are_not_loaded_into_memory(tmp_path):
    path = write_wav(tmp_path / "a.wav", (numbers(500_000) * 2**15).astype(np.int16))
    next(iter(ertis.open_pcm(path, PCM)))  # loads what reads WAV
    tracemalloc.start()
    try:
        n_samples = sum(len(item.data) for item in ertis.open_pcm(path, PCM, length_s=0.02))
        _, largest = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert n_samples == 499_200
    assert largest < path.stat().st_size / 4


@pytest.mark.parametrize("rate_hz", [110_000, 192_000, 500_000, 1_000_000])
@pytest.mark.parametrize("call", [Call(), Call(start_frequency_hz=8_000.0, stop_frequency_hz=3_000.0)])
def test_imported_ranges_fit_sample_rate_and_call(tmp_path, rate_hz, call):
    """The default step, made for 4.5 MHz, would lose echoes between two ranges."""
    settings = Settings(array=RING, call=call)
    reader = ertis.open_pcm(write_wav(tmp_path / "a.wav", numbers(rate_hz // 50), rate_hz), settings)
    made = reader.settings
    band_hz = call.high_frequency_hz - call.low_frequency_hz
    assert 1.79 * band_hz < made.output_rate_hz < 4 * band_hz
    assert made.processing.range_m == (0.43, 3.0)
    Pipeline(made).process(next(iter(reader)))


def test_given_settings_are_kept(tmp_path):
    path = write_wav(tmp_path / "a.wav", numbers())
    asked = PCM.processing.replace(range_decimation=2, range_m=(0.2, 1.0))
    assert ertis.open_pcm(path, PCM.replace(processing=asked)).settings.processing == asked


def test_recording_without_a_call_needs_no_fitting_call(tmp_path):
    """The default call of 25 to 50 kHz does not fit 44.1 kHz, but nothing was emitted."""
    path = write_wav(tmp_path / "a.wav", numbers(9_000), 44_100)
    (tmp_path / "ring.toml").write_text(PCM.replace(**{"passive.bands_hz": ((2e3, 4e3),)}).to_toml())
    command = ["import", "signals", str(path), "--settings", str(tmp_path / "ring.toml"), "--length", "0.1"]
    refused = CliRunner().invoke(cli, [*command, "-o", str(tmp_path / "refused.h5")])
    assert refused.exit_code == 1
    assert "or --passive if no call was emitted" in refused.stderr
    done = CliRunner().invoke(cli, [*command, "--passive", "-o", str(tmp_path / "rec.h5")])
    assert done.exit_code == 0, done.stderr
    assert "cannot be processed" not in done.stderr
    with open_recording(tmp_path / "rec.h5") as recording:
        assert [stamp.behaviour for stamp in recording.stamps()] == ["passive"] * 2
        with ertis.AcousticCamera(recording.settings, "numpy") as camera:
            found = camera.process(recording[1])
    assert found.band_hz.tolist() == [[2000.0, 4000.0]]
    assert check_recording(tmp_path / "rec.h5").is_fit
    for line in ("acoustic rec.h5 -o maps.h5", "plot rec.h5 -o a.png", "info rec.h5 --health", "sensors check rec.h5"):
        arguments = [str(tmp_path / each) if "." in each else each for each in line.split()]
        done = CliRunner().invoke(cli, arguments)
        assert done.exit_code == 0, (line, done.stderr, done.exception)
    (tmp_path / "active.toml").write_text('processing.mode = "active"')
    files = [str(tmp_path / "rec.h5"), "--settings", str(tmp_path / "active.toml")]
    images = CliRunner().invoke(cli, ["process", *files])
    assert images.exit_code != 0
    assert "use a decimation that leaves more than twice the call's 50000 Hz" in images.stderr


REFUSED = {
    "no file": (lambda folder: folder / "none.wav", {}, "No such file"),
    "other kind": (
        lambda folder: _text(folder / "a.wav"),
        {},
        r"is not a WAV file: it begins with b'noth'; choose a WAV",
    ),
    "cut short": (
        lambda folder: _cut(folder / "a.wav"),
        {},
        r"the fmt chunk at byte 12 has 10 bytes, but needs 16",
    ),
    "channels": (
        lambda folder: write_wav(folder / "a.wav", numbers(n_channels=7)),
        {},
        r"has 7 channels, but array '\w+' has 8; (use a layout with|write )one row for each",
    ),
    "slow": (
        lambda folder: write_wav(folder / "a.wav", numbers(), 44_100),
        {},
        r"sample rate of 44100 Hz, too low for a call up to 50000 Hz; set the emitted call",
    ),
    "skip": (lambda folder: write_wav(folder / "a.wav", numbers()), {"skip_s": 1.0}, r"a shorter skip_s"),
    "length": (lambda folder: write_wav(folder / "a.wav", numbers()), {"length_s": 1.0}, r"length_s"),
    "length of less than a sample": (
        lambda folder: write_wav(folder / "a.wav", numbers()),
        {"length_s": 1e-7},
        r"length_s is 1e-07, less than a sample at 192000 Hz; use a longer length_s",
    ),
    "nan": (
        lambda folder: write_wav(folder / "a.wav", np.where(np.arange(8) == 3, np.nan, numbers()).astype("f4")),
        {},
        r"contains nan at sample 0 of channel 3; replace such samples in the file",
    ),
    "beyond float32": (
        lambda folder: write_wav(folder / "a.wav", np.where(np.arange(8) == 3, 1e300, numbers())),
        {},
        r"contains 1e\+300 at sample 0 of channel 3; scale the samples to at most 3\.403e\+38",
    ),
    "skip for ever": (
        lambda folder: write_wav(folder / "a.wav", numbers()),
        {"skip_s": 1e308},
        r"skip_s is 1e\+308; use",
    ),
    "last for ever": (
        lambda folder: write_wav(folder / "a.wav", numbers()),
        {"length_s": 1e308},
        r"length_s is 1e\+308; use",
    ),
    "starts too late": (
        lambda folder: write_wav(folder / "a.wav", numbers()),
        {"start_ns": 2**70},
        r"start_ns is \d+; use a whole number from 0 to 9223372036854775807",
    ),
    "two rates": (
        lambda folder: [write_wav(folder / "a.wav", numbers()), write_wav(folder / "b.wav", numbers(), 96_000)],
        {},
        r"b.wav has 96000 Hz, but a.wav has 192000; import each file separately",
    ),
    "none": (lambda _: [], {}, "the list of PCM files is empty"),
    "half of it": (
        lambda folder: _changed(folder / "a.wav", lambda content: content[: len(content) // 2]),
        {},
        r"truncated: the data chunk at byte \d+ states 192000 bytes, but the file ends after \d+; copy it again",
    ),
    "no samples": (
        lambda folder: write_wav(folder / "a.wav", np.zeros((0, 8), np.int16)),
        {},
        r"a\.wav has no samples: its data chunk at byte \d+ is empty",
    ),
    "half a frame": (
        lambda folder: _changed(folder / "a.wav", lambda content: _with_data_size(content, 191_996)),
        {},
        r"has 191996 bytes of samples, not a multiple of its frame size, 64 bytes; copy the file again",
    ),
    "no channels": (
        lambda folder: _changed(folder / "a.wav", lambda content: content[:22] + b"\0\0" + content[24:]),
        {},
        r"the fmt chunk at byte 12 states 0 channels and 192000 Hz; save the file again as WAV",
    ),
    "shorter than the call": (
        lambda folder: write_wav(folder / "a.wav", numbers()),
        {"length_s": 1e-3},
        r"has 1 ms, but the call alone lasts 2.5 ms; use a longer length_s,",
    ),
}


def _text(path):
    path.write_text("nothing of the kind")
    return path


def _changed(path, change):
    write_wav(path, numbers().astype(np.float64))
    path.write_bytes(change(path.read_bytes()))
    return path


def _with_data_size(content, size):
    place = content.index(b"data") + 4
    return content[:place] + size.to_bytes(4, "little") + content[place + 4 :]


def _cut(path):
    write_wav(path, numbers())
    path.write_bytes(path.read_bytes()[:30])
    return path


@pytest.mark.parametrize("name", REFUSED)
def test_pcm_import_refuses_invalid_input(tmp_path, name):
    given, options, message = REFUSED[name]
    with pytest.raises((DataError, ArgumentError), match=message):
        list(ertis.open_pcm(given(tmp_path), PCM, **options))


@pytest.mark.parametrize("name", ["a.wav", "a.h5"])
def test_denied_permission_is_named(tmp_path, monkeypatch, name):
    def denied(*_, **__):
        raise PermissionError(errno.EACCES, "Permission denied")

    (tmp_path / name).write_bytes(b"RIFF")
    monkeypatch.setattr(type(tmp_path), "open", denied)
    with pytest.raises(DataError, match=rf"{name}: Permission denied; ask its owner for permission to read it"):
        ertis.open_pcm(tmp_path / name, PCM)


def test_acoular_files_are_read_in_slices(tmp_path):
    path = write_acoular(tmp_path / "a.h5", np.zeros((600_000, 8)), float(RATE_HZ))
    reader = ertis.open_pcm(path, PCM, length_s=0.02)
    tracemalloc.start()
    try:
        assert len(list(itertools.islice(reader, 3))) == 3
        assert tracemalloc.get_traced_memory()[1] < 10_000_000  # of 38 MB
    finally:
        tracemalloc.stop()


def test_wav_without_settings_is_refused(tmp_path):
    with pytest.raises(ArgumentError, match=r"contains no array; add it"):
        ertis.open_pcm(write_wav(tmp_path / "a.wav", numbers()))


# ---- Acoular --------------------------------------------------------------------------------------


def test_exported_signals_are_imported_again(tmp_path):
    """The image of exported signals equals that of the recording, except for the ripple of the low-pass filter."""
    settings = PCM.replace(
        array=RING.replace(gain=(1.0, 2.0) * 4, enabled=(True, True, True, False) * 2),
        recording=Recording(n_samples=70_000),
        processing=PCM.processing.replace(range_decimation=100),
    )
    given = heard(settings)
    ertis.export(tmp_path / "signals.h5", [given], file_format="acoular")
    reader = ertis.open_pcm(tmp_path / "signals.h5")
    (measurement,) = reader
    assert isinstance(reader, PcmReader)
    assert len(microphones(reader.settings.array).enabled) == 6
    assert reader.settings.call == settings.call
    image = Pipeline(reader.settings, max_error_db="fine").process(measurement)
    wanted = Pipeline(settings, max_error_db="fine").process(given)
    assert image.range_m == pytest.approx(wanted.range_m)
    assert error_db(image.amplitude, wanted.amplitude) < -40


def test_acoular_file_without_settings_is_refused(tmp_path):
    given = numbers().astype(np.float32)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["time_data"] = given
        file["time_data"].attrs["sample_freq"] = float(RATE_HZ)
    (measurement,) = ertis.open_pcm(tmp_path / "a.h5", PCM)
    assert np.array_equal(measurement.data, given)
    with pytest.raises(ArgumentError, match="add it"):
        ertis.open_pcm(tmp_path / "a.h5")


@pytest.mark.parametrize("kind", ["int8", "int16", "int32", "float32", "float64"])
def test_acoular_samples_share_one_full_scale(tmp_path, kind):
    given = numbers()
    largest = 1.0 if kind.startswith("f") else -float(np.iinfo(kind).min)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["time_data"] = (np.rint(given * largest).clip(-largest, largest - 1) if largest > 1 else given).astype(
            kind
        )
        file["time_data"].attrs["sample_freq"] = float(RATE_HZ)
    (measurement,) = reader = ertis.open_pcm(tmp_path / "a.h5", PCM)
    signals = measurement.data / reader.settings.recording.full_scale
    assert np.abs(signals - given).max() <= (2.0**-7 if kind == "int8" else 2.0**-15)


def write_acoular(path, given, rate_hz):
    with h5py.File(path, "w") as file:
        file["time_data"] = given
        file["time_data"].attrs["sample_freq"] = rate_hz
    return path


@pytest.mark.parametrize("rate_hz", [np.array([192e3]), np.array([[192_000]]), 192_000], ids=["list", "table", "whole"])
def test_acoular_sample_rate_may_be_an_array_of_one(tmp_path, rate_hz):
    path = write_acoular(tmp_path / "a.h5", numbers().astype(np.float32), rate_hz)
    assert ertis.open_pcm(path, PCM).settings.recording.sample_rate_hz == RATE_HZ


@pytest.mark.parametrize(
    ("rate_hz", "message"),
    [
        (np.nan, r"a\.h5: recording\.sample_rate_hz is nan; use a finite number"),
        (np.inf, r"a\.h5: recording\.sample_rate_hz is inf; use a finite number"),
        (0.0, r"a\.h5: recording\.sample_rate_hz is 0; use a number from 1000 to 1e\+09"),
        (1e308, r"a\.h5: recording\.sample_rate_hz is 1e\+308; use a number"),
        (np.array([1.0, 2.0]), r"a\.h5: sample_freq is \[1\.0, 2\.0\]; store one number, the sample rate in Hz"),
        ("fast", r"sample_freq is not a number; store one number, the sample rate in Hz"),
        (h5py.Empty("f8"), r"sample_freq is not a number; store one"),
    ],
    ids=["nan", "inf", "zero", "huge", "two", "text", "empty"],
)
def test_invalid_sample_rates_are_refused(tmp_path, rate_hz, message):
    path = write_acoular(tmp_path / "a.h5", numbers().astype(np.float32), rate_hz)
    with pytest.raises(DataError, match=message):
        ertis.open_pcm(path, PCM, skip_s=0.001)


@pytest.mark.parametrize("options", [{}, {"skip_s": 0.001}, {"length_s": 0.01}], ids=["all", "skip", "length"])
def test_transposed_acoular_data_are_refused(tmp_path, options):
    path = write_acoular(tmp_path / "a.h5", numbers().astype(np.float32).T, RATE_HZ)
    with pytest.raises(DataError, match=r"a\.h5 has 3000 channels of 8 samples; transpose it"):
        ertis.open_pcm(path, PCM, **options)


def _strange(path, fill):
    with h5py.File(path, "w") as file:
        fill(file)
    return path


STRANGE = {
    # other HDF5 files, and a part of the error
    "no signals": (
        lambda file: file.create_group("b"),
        r"contains no time_data with a sample_freq, but b; save WAV, or",
    ),
    "empty": (lambda _: None, r"contains no time_data with a sample_freq, but nothing"),
    "no rate": (
        lambda file: file.create_dataset("time_data", data=numbers()),
        r"time_data has no attribute sample_freq",
    ),
    "no data": (lambda file: file.create_dataset("time_data", data=h5py.Empty("f4")), r"time_data is empty; save WAV"),
    "link": (lambda file: file.__setitem__("time_data", h5py.ExternalLink("b.h5", "a")), r"time_data is a link into"),
    "complex": (lambda file: _rated(file, numbers().astype(complex)), r"time_data is complex128 of shape \(3000, 8\)"),
    "text": (
        lambda file: _rated(file, [b"a", b"b"]),
        r"time_data is object of shape \(2, 1\); store floating-point or signed",
    ),
}


def _rated(file, values):
    file["time_data"] = values
    file["time_data"].attrs["sample_freq"] = float(RATE_HZ)


@pytest.mark.parametrize("name", STRANGE)
def test_hdf5_without_signals_is_refused_by_its_content(tmp_path, name):
    fill, message = STRANGE[name]
    with pytest.raises(DataError, match=message):
        ertis.open_pcm(_strange(tmp_path / "a.h5", fill), PCM)


def test_recordings_need_no_import(tmp_path, measurement):
    path = write_recording(tmp_path / "rec.h5", [measurement])
    with pytest.raises(DataError, match=r"is a file of this package, which needs no import; use 'ertis process'"):
        ertis.open_pcm(path, PCM)


def _like_pytables(file):
    values = numbers().astype(">f4")
    data = file.create_dataset("time_data", data=values, chunks=(64, 8), maxshape=(None, 8), compression="gzip")
    data.attrs["sample_freq"] = float(RATE_HZ)
    for owner in (file, data):
        owner.attrs["CLASS"] = np.bytes_(b"EARRAY")
        owner.attrs["TITLE"] = h5py.Empty("S1")
        owner.attrs["VERSION"] = "1.1"
    file.create_group("metadata").attrs["TITLE"] = h5py.Empty("S1")


def test_acoular_files_of_pytables_are_imported(tmp_path):
    (measurement,) = ertis.open_pcm(_strange(tmp_path / "a.h5", _like_pytables), PCM)
    assert np.array_equal(measurement.data, numbers().astype(np.float32))


# ---- commands -------------------------------------------------------------------------------------


def command(*arguments):
    done = CliRunner().invoke(cli, [str(argument) for argument in arguments])
    assert done.exit_code == 0, done.output
    return done.stdout


def test_wav_file_is_processed_to_reflectors(tmp_path, measurement):
    write_wav(tmp_path / "echoes.wav", measurement.data)
    (tmp_path / "ring.toml").write_text(PCM.replace(recording=Recording()).to_toml())
    command(
        "import", "signals", tmp_path / "echoes.wav", "--settings", tmp_path / "ring.toml", "-o", tmp_path / "rec.h5"
    )
    command("process", tmp_path / "rec.h5", "-o", tmp_path / "img.h5")
    first, second = json.loads(command("peaks", tmp_path / "img.h5", "--top", "2", "--json"))["peaks"]
    assert first["azimuth_deg"] == pytest.approx(24.0, abs=0.2)
    assert second["range_m"] == pytest.approx(1.6, abs=1e-3)


def test_given_air_overrides_that_of_the_signals(tmp_path, measurement):
    ertis.export(tmp_path / "a.h5", [measurement], file_format="acoular")
    command("import", "signals", tmp_path / "a.h5", "--temperature", 3, "-o", tmp_path / "rec.h5")
    with open_recording(tmp_path / "rec.h5") as recording:
        assert recording.settings.air == PCM.air.replace(temperature_c=3.0)
        assert recording[0].settings.air == recording.settings.air
        assert recording.settings.call == PCM.call


def test_import_reports_times_and_problems(tmp_path):
    write_wav(tmp_path / "a.wav", numbers(6_100).astype(np.float32))
    (tmp_path / "ring.toml").write_text(
        PCM.replace(recording=Recording(), processing=PCM.processing.replace(range_m=(0.5, 50.0))).to_toml()
    )
    arguments = (
        "import",
        "signals",
        tmp_path / "a.wav",
        "--settings",
        tmp_path / "ring.toml",
        "-o",
        tmp_path / "rec.h5",
    )
    more = ("--length", 0.015625, "--start", "2026-05-04T14:30:00.5+0200")
    done = CliRunner().invoke(cli, [str(argument) for argument in (*arguments, *more)])
    assert done.exit_code == 0, done.output
    assert "note: 0.0005208 s at the ends of files were left out" in done.stderr
    note = "note: this recording cannot be processed with its own settings"
    assert f"{note}: processing.range_m ends at 50 m, but the record" in done.stderr
    with open_recording(tmp_path / "rec.h5") as recording:
        times_s = [stamp.timestamp_ns / 1e9 for stamp in recording.stamps()]
    assert times_s == pytest.approx([1_777_897_800.5, 1_777_897_800.515625])


STARTS = {
    "2026-05-04T12:30": 1_777_897_800,
    "2026-05-04T14:30+0200": 1_777_897_800,
    "2026-05-04T12:30:00.5": 1_777_897_800.5,
    "1970-01-01T02:00:00+02:00": 0,
    "2262-04-11T23:47:16": 9_223_372_036,
}


@pytest.mark.parametrize("start", STARTS)
def test_start_time_accepts_minutes_or_finer(tmp_path, start):
    write_wav(tmp_path / "a.wav", numbers().astype(np.float32))
    (tmp_path / "ring.toml").write_text(PCM.replace(recording=Recording()).to_toml())
    command("import", "signals", tmp_path / "a.wav", "--settings", tmp_path / "ring.toml", "--start", start)
    with open_recording(tmp_path / "a.h5") as recording:
        assert recording[0].stamp.timestamp_ns == 10**9 * STARTS[start]


@pytest.mark.parametrize("start", ["2300-01-01T00:00:00", "1970-01-01T00:00:00+02:00", "1969-12-31T23:59"])
def test_unstorable_start_times_are_refused(tmp_path, start):
    write_wav(tmp_path / "a.wav", numbers().astype(np.float32))
    (tmp_path / "ring.toml").write_text(PCM.replace(recording=Recording()).to_toml())
    arguments = [
        "import",
        "signals",
        str(tmp_path / "a.wav"),
        "--settings",
        str(tmp_path / "ring.toml"),
        "--start",
        start,
    ]
    done = CliRunner().invoke(cli, arguments)
    assert done.exit_code == 2
    assert f"'--start': {start[:16]}" in done.stderr
    assert "is outside the range of a recording; use a time from 1970 to 2262" in done.stderr


def test_recording_needs_another_name_than_its_source(tmp_path):
    path = write_acoular(tmp_path / "ac.h5", numbers().astype(np.float32), RATE_HZ)
    done = CliRunner().invoke(cli, ["import", "signals", str(path)])
    assert done.exit_code == 2
    assert f"{path} cannot become a recording of the same name; choose another name with --output" in done.stderr


def test_pcm_options_are_refused_for_pdm(tmp_path):
    (tmp_path / "a.bin").write_bytes(bytes(4 * 65_536))
    for option, value in (("--skip", "1"), ("--length", "1"), ("--start", "2026-05-04T12:30:00")):
        done = CliRunner().invoke(cli, ["import", "signals", str(tmp_path / "a.bin"), option, value])
        assert done.exit_code == 2
        assert f"{option} is for PCM (.wav, .h5), but {tmp_path / 'a.bin'} contains raw words" in done.stderr
