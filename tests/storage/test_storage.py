"""Files preserve recordings and energyscapes, and other programs can read them."""

import tracemalloc
from collections.abc import Sequence

import h5py
import numpy as np
import pytest

from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.frames import Measurement, SequenceGap, Stamp
from ertis_numba.frames.sample_format import sample_format
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Air, Array, Call, Processing, Recording, Settings
from ertis_numba.storage import (
    EnergyscapeWriter,
    RecordingWriter,
    file_kind,
    open_energyscapes,
    open_recording,
    write_energyscapes,
    write_recording,
)
from ertis_numba.storage._gaps import UNKNOWN
from ertis_numba.storage.schema import ENERGYSCAPE, RECORDING
from ertis_numba.storage.variables import create_variables
from tests.files import SMALL, image, line, noise, open_dataset


@pytest.mark.parametrize(
    "settings",
    [SMALL, line(1, 8), line(8, 8), line(16, 16), line(64, 64), line(33, 32), line(70, 16)],
    ids=["32", "1 of 8", "8", "16", "64", "33 in 2 words", "70 in 5 words"],
)
def test_recording_is_read_back_unchanged(tmp_path, settings):
    given = noise(settings)
    path = write_recording(tmp_path / "rec.h5", given, source="noise")
    with open_recording(path) as recording:
        assert len(recording) == len(given)
        for back, measurement in zip(recording, given, strict=True):
            assert back.data.dtype == measurement.data.dtype
            assert np.array_equal(back.data, measurement.data)
            assert back.stamp == measurement.stamp
        assert recording[-1].stamp == given[-1].stamp
        assert recording.attributes["source"] == "noise"
        assert file_kind(path) == "recording"
        changed = recording.settings.replace(array=settings.array)
        assert changed == settings
    assert [item.name for item in tmp_path.iterdir()] == ["rec.h5"]


def test_readers_are_sequences(tmp_path):
    given = noise(count=5)
    with open_recording(write_recording(tmp_path / "rec.h5", given)) as recording:
        assert isinstance(recording, Sequence)
        for part in (slice(0, 3), slice(None), slice(None, None, -2), slice(-2, 99), slice(4, 2)):
            assert [item.stamp for item in recording[part]] == [item.stamp for item in given[part]]
        assert [item.stamp for item in reversed(recording)] == [item.stamp for item in given[::-1]]
    with open_energyscapes(write_energyscapes(tmp_path / "img.h5", [image()] * 3)) as images:
        assert isinstance(images, Sequence)
        assert [np.array_equal(each.amplitude, image().amplitude) for each in images[1:]] == [True, True]


def test_recording_needs_no_other_file(tmp_path):
    layout = tmp_path / "mine.csv"
    layout.write_text("y_mm, z_mm\n0, 0\n4, 0\n8, 1\n")
    settings = SMALL.replace(array=Array(layout=str(layout)))
    words = noise(count=1)[0].data
    write_recording(tmp_path / "rec.h5", [Measurement(words, settings)])
    layout.unlink()
    with open_recording(tmp_path / "rec.h5") as recording:
        image = Pipeline(recording.settings).process(recording[0])
        again = write_recording(tmp_path / "again.h5", recording)
    assert len(image.settings.array.positions_m) == 3
    with open_recording(tmp_path / "again.h5") as recording:  # a copy of a copy drifts by no bit
        assert np.array_equal(Pipeline(recording.settings).process(recording[0]).amplitude, image.amplitude)
    assert again.name == "again.h5"


def test_gaps_sessions_and_air_are_kept(tmp_path):
    warm = SMALL.replace(air=Air(temperature_c=31.25, humidity_percent=80.0))
    words = noise(count=1)[0].data
    runs = [(3, 7), (4, 7), (9, 7), (1, 2**40), (3, 2**40), (4, 0)]
    stamps = [Stamp(sequence=sequence, session_id=session_id) for sequence, session_id in runs]
    write_recording(
        tmp_path / "rec.h5", (Measurement(words, warm if s.sequence == 9 else SMALL, s) for s in stamps), settings=SMALL
    )
    with open_recording(tmp_path / "rec.h5") as recording:
        assert recording.gaps == (SequenceGap("sensor", 5, 8, UNKNOWN, 7), SequenceGap("sensor", 2, 2, UNKNOWN, 2**40))
        assert recording.stamps() == stamps
        assert [m.settings.air for m in recording] == [SMALL.air] * 2 + [warm.air] + [SMALL.air] * 3
        assert recording.settings.air == SMALL.air
    with h5py.File(tmp_path / "rec.h5") as file:
        assert file["sensors/sensor/session_id"][:].tolist() == [session_id for _, session_id in runs]
        assert file["sensors/sensor/gap_session_id"][:].tolist() == [7, 2**40]


def test_columns_continue_beyond_a_chunk(tmp_path):
    short = line(8, 8).replace(recording=Recording(n_samples=16))
    words = np.zeros(16, np.uint8)
    write_recording(tmp_path / "rec.h5", (Measurement(words, short, Stamp(sequence=i)) for i in range(1100)))
    with open_recording(tmp_path / "rec.h5") as recording:
        assert [recording[index].stamp.sequence for index in (0, 511, 512, 1099)] == [0, 511, 512, 1099]


def test_calibration_is_kept(tmp_path):
    settings = line(8, 8)
    array = settings.array.replace(gain=(1.0, 0.5) * 4, delay_s=(0.0, 2e-6) * 4, enabled=(True,) * 7 + (False,))
    write_recording(tmp_path / "rec.h5", noise(settings.replace(array=array), 1))
    with open_recording(tmp_path / "rec.h5") as recording:
        assert recording.settings.array == array
    with h5py.File(tmp_path / "rec.h5") as file:
        group = file["sensors/eRTIS-7"]
        assert group["calibration_gain"][:].tolist() == [1.0, 0.5] * 4
        assert group["calibration_delay"][:].tolist() == [0.0, 2e-6] * 4
        assert group["microphone_enabled"][:].tolist() == [1] * 7 + [0]


def test_xarray_shows_named_axes(tmp_path):
    write_recording(tmp_path / "rec.h5", noise())
    write_energyscapes(tmp_path / "img.h5", [image()])
    with open_dataset(tmp_path / "rec.h5", group="/sensors/eRTIS-7", engine="netcdf4") as data:
        assert data["pdm"].dims == ("time", "sample")
        assert data["pdm"].dtype == np.uint32
        assert data["microphone_position"].dims == ("microphone", "axis")
        assert data["time"].values[0] == np.datetime64(1_700_000_000_123_456_789, "ns")
        assert set(data.variables) == {variable.name for variable in RECORDING}
    with open_dataset(tmp_path / "img.h5", group="/sensors/sensor", engine="netcdf4") as data:
        assert data["amplitude"].dims == ("time", "direction", "range")
        assert {"azimuth", "elevation", "range", "time"} == set(data.coords)
        assert data["range"].attrs["units"] == "m"
        assert set(data.variables) == {variable.name for variable in ENERGYSCAPE}


def test_words_of_wide_arrays_have_their_own_axis(tmp_path):
    write_recording(tmp_path / "rec.h5", noise(line(33, 32)))
    with open_dataset(tmp_path / "rec.h5", group="/sensors/eRTIS-7", engine="netcdf4") as data:
        assert data["pdm"].dims == ("time", "sample", "word")


def test_energyscapes_are_read_back_unchanged(tmp_path):
    given = image()
    write_energyscapes(tmp_path / "img.h5", [given, given.replace(amplitude=given.amplitude * 2)])
    with open_energyscapes(tmp_path / "img.h5") as images:
        assert len(images) == 2
        assert np.array_equal(images[1].amplitude, given.amplitude * 2)
        for field in ("azimuth_rad", "elevation_rad", "range_m"):
            assert np.array_equal(getattr(images[0], field), getattr(given, field))
        assert images[0].settings.processing == given.settings.processing
        assert file_kind(tmp_path / "img.h5") == "energyscape"


def test_half_precision_keeps_three_digits(tmp_path):
    given = image()
    write_energyscapes(tmp_path / "img.h5", [given], dtype="float16")
    with open_energyscapes(tmp_path / "img.h5") as images:
        assert images[0].amplitude.dtype == np.float32
        np.testing.assert_allclose(images[0].amplitude, given.amplitude, rtol=2**-11, atol=2**-25)


def test_energyscape_file_names_its_recording(tmp_path):
    write_recording(tmp_path / "rec.h5", noise())
    with open_recording(tmp_path / "rec.h5") as recording:
        write_energyscapes(tmp_path / "img.h5", [image()], recording=recording)
        identity, digest = recording.uuid, recording.sha256()
    with open_energyscapes(tmp_path / "img.h5") as images:
        assert images.attributes["recording_uuid"] == identity
        assert images.attributes["recording_sha256"] == digest
        assert images.attributes["numpy_version"] == np.__version__


@pytest.mark.parametrize("directions", ["2d:181", "3d:500"])
def test_replay_gives_the_same_bits_for_any_number_of_threads(tmp_path, directions):
    write_recording(tmp_path / "rec.h5", noise())
    amplitudes = []
    with open_recording(tmp_path / "rec.h5") as recording:
        settings = recording.settings.replace(
            processing=Processing(directions=directions, range_m=(0.3, 0.9), elevation_limits_deg=(-30.0, 30.0))
        )
        for threads in (1, 2, 1):
            pipeline = Pipeline(settings, threads=threads)
            write_energyscapes(tmp_path / "img.h5", map(pipeline.process, recording), overwrite=True)
            with h5py.File(tmp_path / "img.h5") as file:
                amplitudes.append(file["sensors/eRTIS-7/amplitude"][:].tobytes())
    assert amplitudes[0] == amplitudes[1] == amplitudes[2]


def test_same_content_gives_the_same_bytes(tmp_path, monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    first = write_recording(tmp_path / "a.h5", noise())
    second = write_recording(tmp_path / "b.h5", noise())
    other = write_recording(tmp_path / "c.h5", noise(seed=2))
    assert first.read_bytes() == second.read_bytes()
    with open_recording(first) as a, open_recording(other) as c:
        assert a.attributes["date_created"] == "2023-11-14T22:13:20Z"
        assert a.uuid != c.uuid


def test_bytes_do_not_depend_on_references_to_columns(tmp_path, monkeypatch):
    """A profiler of threads, such as that of dask, may keep a column open while others are written."""
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    wanted = write_recording(tmp_path / "a.h5", noise()).read_bytes()
    held, write = [], h5py.Dataset.__setitem__

    def write_and_hold(column, place, values):
        write(column, place, values)
        if column.name.endswith("/time"):
            held.append(column)
        elif column.name.endswith("/sync_count"):
            held.clear()

    monkeypatch.setattr(h5py.Dataset, "__setitem__", write_and_hold)
    assert write_recording(tmp_path / "b.h5", noise()).read_bytes() == wanted
    assert held == []


def test_memory_does_not_grow_with_the_recording(tmp_path):
    long = Settings()  # 640 KiB a measurement
    words = noise(long, 1)[0].data

    def copy():
        with open_recording(tmp_path / "rec.h5") as recording:
            write_recording(tmp_path / "copy.h5", recording)

    write_recording(tmp_path / "rec.h5", (Measurement(words, long, Stamp(sequence=i)) for i in range(20)))
    tracemalloc.start()
    try:
        copy()
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 8 * words.nbytes


def write_and_fail(path, error, *, before=None):
    with RecordingWriter(path, overwrite=path.exists()) as writer:
        writer.write(noise(count=1)[0])
        if before:
            before(writer)
        if error:
            raise error


@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError, GeneratorExit])
def test_exception_while_writing_leaves_no_file(tmp_path, error):
    with pytest.raises(error):
        write_and_fail(tmp_path / "rec.h5", error)
    assert not list(tmp_path.iterdir())


def test_failed_replacement_keeps_the_older_file(tmp_path):
    path = write_recording(tmp_path / "rec.h5", noise())
    before = path.read_bytes()
    with pytest.raises(KeyboardInterrupt):
        write_and_fail(path, KeyboardInterrupt)
    assert path.read_bytes() == before
    assert [item.name for item in tmp_path.iterdir()] == ["rec.h5"]


def test_file_that_reads_back_differently_is_refused(tmp_path):
    def flip_on_disk(writer):
        writer._file["sensors/eRTIS-7/pdm"][0, 5] ^= 1  # noqa: SLF001  a fault between memory and disk

    def drop_a_row(writer):
        writer._file["sensors/eRTIS-7/pdm"].resize(0, axis=0)  # noqa: SLF001

    with pytest.raises(DataError, match=r"measurement 0 has CRC-32 .* the file is damaged"):
        write_and_fail(tmp_path / "rec.h5", None, before=flip_on_disk)
    with pytest.raises(DataError, match="reads back with other content than written; check the disk"):
        write_and_fail(tmp_path / "rec.h5", None, before=drop_a_row)
    assert not list(tmp_path.iterdir())


def test_file_created_meanwhile_is_not_replaced(tmp_path):
    with pytest.raises(ArgumentError, match="exists"):
        write_and_fail(tmp_path / "rec.h5", None, before=lambda writer: writer.path.write_text("mine"))
    assert [(item.name, item.read_text()) for item in tmp_path.iterdir()] == [("rec.h5", "mine")]


def spoilt(**settings):
    return [*noise(count=1), *noise(SMALL.replace(**settings), 1)]


@pytest.mark.parametrize(
    ("measurements", "message"),
    [
        ([], "would contain no measurement"),
        (spoilt(array=Array(layout="eRTIS_v2")), "other array settings"),
        (spoilt(call=Call(duration_s=2e-3)), "other call settings"),
        (spoilt(recording=Recording(n_samples=50_000)), "other recording settings"),
        (
            [Measurement(noise()[0].data, SMALL, Stamp(sensor="a/b"))],
            "sensor name 'a/b' cannot name a group in a file",
        ),
        ([Measurement(noise()[0].data[1:], SMALL)], r"measurement 0 has shape \(40959,\); pass shape \(40960,\)"),
        (
            [Measurement(noise()[0].data, SMALL, Stamp(timestamp_uncertainty_ns=2**32))],
            "timestamp_uncertainty_ns is 4294967296",
        ),
        (noise(SMALL.replace(processing=Processing(directions="grid.csv"))), "is the file grid.csv"),
    ],
)
def test_unstorable_measurements_are_refused(tmp_path, measurements, message):
    with pytest.raises(ArgumentError, match=message):
        write_recording(tmp_path / "rec.h5", measurements)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("stamp", "message"),
    [
        (Stamp(sequence=2**63), "sequence is 9223372036854775808; use a whole number from 0"),
        (Stamp(sequence=-1), "sequence is -1; use a whole number from 0"),
        (Stamp(sequence=1.0), "sequence is 1.0; use a whole number"),
        (
            Stamp(timestamp_ns=2**63),
            "timestamp_ns is 9223372036854775808; use a whole number from -9223372036854775808",
        ),
        (Stamp(sync_count=-(2**63) - 1), "sync_count is -9223372036854775809; use"),
        (Stamp(session_id=2**63), "session_id is 9223372036854775808; use"),
    ],
    ids=["sequence", "negative sequence", "half a sequence", "time", "pulse", "session_id"],
)
def test_stamps_beyond_the_file_format_are_refused(tmp_path, stamp, message):
    with pytest.raises(ArgumentError, match=message):
        write_recording(tmp_path / "rec.h5", [Measurement(noise()[0].data, SMALL, stamp)])
    with pytest.raises(ArgumentError, match=message):
        write_energyscapes(tmp_path / "img.h5", [image().replace(stamp=stamp)])
    assert not list(tmp_path.iterdir())


def numbered(*numbers, session_id=0):
    words = noise(count=1)[0].data
    return [Measurement(words, SMALL, Stamp(sequence=number, session_id=session_id)) for number in numbers]


@pytest.mark.parametrize(
    ("numbers", "place"),
    [((0, 0), 1), ((3, 4, 3), 2), ((7, 2, 5, 2), 3), ((7, 2, 5, 7), 3), ((9, 4, 4), 2)],
    ids=["at once", "rising", "falling", "highest", "late"],
)
def test_sequence_numbers_are_unique_within_a_session(tmp_path, numbers, place):
    message = rf"measurement {place} has sequence {numbers[place]} of session 0, like an earlier one; number the"
    with pytest.raises(ArgumentError, match=message):
        write_recording(tmp_path / "rec.h5", numbered(*numbers))
    given = [*numbered(*numbers[:place]), *numbered(*numbers[place:], session_id=1)]
    given += [Measurement(m.data, SMALL, Stamp(sensor="other", sequence=m.stamp.sequence)) for m in given[:place]]
    write_recording(tmp_path / "rec.h5", given)


def test_missing_sequence_numbers_may_arrive_late(tmp_path):
    order = np.random.default_rng(1).permutation(50).tolist()
    path = write_recording(tmp_path / "rec.h5", numbered(*order))
    with open_recording(path) as recording:
        assert [stamp.sequence for stamp in recording.stamps()] == order


PCM_OF = {
    encoding: line(4, 8).replace(recording=Recording(sample_rate_hz=192_000.0, n_samples=64, encoding=encoding))
    for encoding in ("int16", "float32")
}


@pytest.mark.parametrize(
    ("settings", "dtype"),
    [
        (SMALL, "float64"),
        (SMALL, "int32"),
        (SMALL, "uint16"),
        (PCM_OF["int16"], "float32"),
        (PCM_OF["int16"], "int32"),
        (PCM_OF["int16"], "uint8"),
        (PCM_OF["float32"], "float64"),
        (PCM_OF["float32"], "int16"),
    ],
    ids=lambda given: given if isinstance(given, str) else given.recording.encoding,
)
def test_samples_of_another_type_are_refused(tmp_path, settings, dtype):
    words = sample_format(settings)
    message = rf"measurement 0 contains {dtype} samples, but its settings state {words.dtype.name}; convert them"
    with pytest.raises(ArgumentError, match=message):
        write_recording(tmp_path / "rec.h5", [Measurement(np.zeros(words.shape, dtype), settings)])


@pytest.mark.parametrize("settings", [SMALL, *PCM_OF.values()], ids=["pdm", *PCM_OF])
def test_samples_of_another_byte_order_are_stored_equal(tmp_path, settings):
    given = np.ones(sample_format(settings).shape, sample_format(settings).dtype.newbyteorder(">"))
    write_recording(tmp_path / "rec.h5", [Measurement(given, settings)])
    with open_recording(tmp_path / "rec.h5") as recording:
        assert np.array_equal(recording[0].data, given)


@pytest.mark.parametrize("number", [np.nan, -np.inf], ids=str)
def test_nan_and_infinity_are_not_recorded(tmp_path, number):
    settings = PCM_OF["float32"]
    words = np.zeros(sample_format(settings).shape, np.float32)
    words[7, 2] = number
    with pytest.raises(ArgumentError, match=rf"measurement 0 holds {number} at \[7, 2\]; pass finite numbers"):
        write_recording(tmp_path / "rec.h5", [Measurement(words, settings)])


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (image(range_m=np.linspace(0.5, 5.1, 400)), "range_m of an energyscape differs from that of the first"),
        (image(azimuth_deg=np.linspace(-80, 80, 37)), "azimuth_rad of an energyscape differs from that of the first"),
        (image(settings=Settings()), "settings of an energyscape differ from those of the first"),
    ],
)
def test_unstorable_energyscapes_are_refused(tmp_path, other, message):
    with pytest.raises(ArgumentError, match=message):
        write_energyscapes(tmp_path / "img.h5", [image(), other])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("there.h5", "there.h5 exists; choose another name, or replace the file"),
        ("nowhere/rec.h5", "does not exist"),
        ("folder", "folder is a folder; choose the name of a file"),
    ],
)
def test_unwritable_paths_are_refused(tmp_path, name, message):
    (tmp_path / "folder").mkdir()
    (tmp_path / "there.h5").write_text("mine")
    with pytest.raises(ArgumentError, match=message):
        write_recording(tmp_path / name, noise())
    assert (tmp_path / "there.h5").read_text() == "mine"


def test_writer_needs_a_with_statement(tmp_path):
    with pytest.raises(ArgumentError, match="is not open for writing; use the writer in a with statement"):
        RecordingWriter(tmp_path / "rec.h5").write(noise()[0])


def test_energyscape_file_does_not_replace_its_recording(tmp_path):
    path = write_recording(tmp_path / "rec.h5", noise())
    with open_recording(path) as recording, pytest.raises(ArgumentError, match="is the input itself"):
        EnergyscapeWriter(path, recording=recording, overwrite=True)


def test_unknown_dtype_is_refused(tmp_path):
    with pytest.raises(ArgumentError, match="dtype 'float64' is unknown"):
        EnergyscapeWriter(tmp_path / "img.h5", dtype="float64")


def test_image_above_the_chunk_limit_is_refused(tmp_path):
    with h5py.File(tmp_path / "large.h5", "w") as file:
        sizes = {"direction": 1_000_000, "range": 1_178}
        with pytest.raises(ArgumentError, match="amplitude of 1000000 directions × 1178 ranges exceeds the 4 GiB"):
            create_variables(file, ENERGYSCAPE, sizes=sizes, dtypes={"amplitude": "<f4"})
