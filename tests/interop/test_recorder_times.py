"""Times and sample rates of recorders' files: metadata, names, options, and contradictions between them."""

import os
import struct
from datetime import UTC, datetime

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

import ertis_numba as ertis
from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.interop.recorder_names import times_in_names
from ertis_numba.settings import Array, Settings

ONE = Settings(array=Array(layout="one", positions_m=((0.0, 0.0, 0.0),)))


def chunk(name, content):
    return name + struct.pack("<I", len(content)) + content + b"\0" * (len(content) % 2)


def write(path, *chunks, rate_hz=250_000, seconds=0.01):
    """Write a mono WAV of 16 bits with more chunks."""
    samples = np.random.default_rng(1).normal(0, 60, round(rate_hz * seconds)).round().astype("<i2").tobytes()
    form = struct.pack("<HHIIHH", 1, 1, rate_hz, 2 * rate_hz, 2, 16)
    body = b"WAVE" + chunk(b"fmt ", form) + chunk(b"data", samples) + b"".join(chunks)
    path.write_bytes(b"RIFF" + struct.pack("<I", len(body)) + body)
    return path


def guano(*lines):
    return chunk(b"guan", "\n".join(("GUANO|Version: 1.0", *lines)).encode())


def comment(text):
    return chunk(b"LIST", b"INFO" + chunk(b"ICMT", text.encode() + b"\0"))


def bext(day, time, reference=0):
    return chunk(b"bext", bytes(320) + f"{day}{time}".encode() + struct.pack("<Q", reference) + bytes(256))


def wamd(*fields):
    return chunk(b"wamd", b"".join(struct.pack("<HI", kind, len(value)) + value for kind, value in fields))


def seconds(text):
    """Seconds since 1970 of a time in UTC."""
    return datetime.fromisoformat(text).replace(tzinfo=UTC).timestamp()


def opened(*paths, **options):
    return ertis.open_pcm(paths, ONE, passive=True, **options)


def times_s(reader):
    return [measurement.stamp.timestamp_ns / 1e9 for measurement in reader]


NAMES = {
    "20240518_042537.WAV": "2024-05-18T04:25:37",  # AudioMoth
    "20240518_042537T.WAV": "2024-05-18T04:25:37",  # AudioMoth, triggered
    "24E144056_20240518_042537.WAV": "2024-05-18T04:25:37",
    "5AFC0B40.WAV": "2018-05-16T10:43:12",  # AudioMoth, old
    "SMU01234_20240518_042537.wav": "2024-05-18T04:25:37",  # Song Meter
    "SM304472_0+1_20181219$100000.wav": "2018-12-19T10:00:00",
    "S4U_20240518_042537_250.wav": "2024-05-18T04:25:37.250",
    "MYOLUC_20240518_042537_000.wav": "2024-05-18T04:25:37",
    "T2024-05-18_04-25-37_0001234.WAV": "2024-05-18T04:25:37",  # Avisoft
    "T0000123_2024-05-18 04-25-37.wav": "2024-05-18T04:25:37",
    "2024-05-18T04_25_37.wav": "2024-05-18T04:25:37",
    "20240518T042537Z.wav": "2024-05-18T04:25:37",
    "20240518T042537+1000_site.wav": "2024-05-17T18:25:37",  # Frontier Labs
    "20240518042537.wav": "2024-05-18T04:25:37",
    "240518_042537.wav": "2024-05-18T04:25:37",  # Zoom
    "1_9999_20240518_042537.wav": "2024-05-18T04:25:37",
    "240518_001.WAV": None,
    "ZOOM0001.WAV": None,
    "M00123.WAV": None,
    "10160435.WAV": None,  # a counter
    "20240518.wav": None,
    "20241318_042537.wav": None,
    "20240518_256199.wav": None,
    "24-05-18_04-25-37.wav": None,
    "mic1.wav": None,
    "DEADBEEF.wav": None,
}


@pytest.mark.parametrize("name", NAMES)
def test_times_in_names_are_found(name):
    (found,) = times_in_names([name])
    stated = NAMES[name]
    assert (found and found.since_1970_ns / 1e9) == (stated and pytest.approx(seconds(stated), abs=1e-6))


def test_hexadecimal_name_without_a_letter_counts_beside_others():
    first, second = times_in_names(["5AFC0B40.WAV", "59384210.WAV"])
    assert second.since_1970_ns == 0x59384210 * 10**9
    assert first.since_1970_ns == 0x5AFC0B40 * 10**9


METADATA = {
    "GUANO with offset": (guano("Timestamp: 2024-05-18T04:25:37.5+02:00"), "2024-05-18T02:25:37.5", "UTC+02:00"),
    "GUANO in UTC": (guano("Timestamp:2024-05-18T04:25:37Z"), "2024-05-18T04:25:37", "UTC"),
    "GUANO, local": (guano("  Timestamp :  2024-05-18 04:25:37"), "2024-05-18T04:25:37", "UTC is assumed"),
    "GUANO, name": (guano("Original Filename: A_20240518_042537.wav"), "2024-05-18T04:25:37", "Original Filename"),
    "AudioMoth": (
        comment("Recorded at 19:17:30 02/03/2023 (UTC) by AudioMoth 24E144085F256C7B at medium gain"),
        "2023-03-02T19:17:30",
        "comment",
    ),
    "AudioMoth in a zone": (
        comment("Recorded at 19:17:30 02/03/2023 (UTC+2) by AudioMoth 24E144085F256C7B"),
        "2023-03-02T17:17:30",
        "UTC+02:00",
    ),
    "AudioMoth in half a zone": (
        comment("Recorded at 19:17:30 02/03/2023 (UTC-3:30) by AudioMoth 24E144085F256C7B"),
        "2023-03-02T22:47:30",
        "UTC-03:30",
    ),
    "AudioMoth by GPS": (
        comment("Recorded at 19:17:30.250 02/03/2023 (UTC) by AudioMoth"),
        "2023-03-02T19:17:30.250",
        "comment",
    ),
    "bext": (bext("2024-05-18", "04:25:37"), "2024-05-18T04:25:37", "bext"),
    "bext, other separators": (bext("2024:05:18", "04-25-37"), "2024-05-18T04:25:37", "bext"),
    "bext with samples": (
        bext("2024-05-18", "04:25:37", round((4 * 3600 + 25 * 60 + 37.25) * 250_000)),
        "2024-05-18T04:25:37.25",
        "bext",
    ),
    "bext with time code": (bext("2024-05-18", "04:25:37", 12), "2024-05-18T04:25:37", "bext"),
    "Wildlife Acoustics": (
        wamd((1, b"SM3"), (5, b"2014-04-02 22:59:14-05:00")),
        "2014-04-03T03:59:14",
        "UTC-05:00",
    ),
    "ICRD": (
        chunk(b"LIST", b"INFO" + chunk(b"ICRD", b"2024-05-18T04:25:37\0")),
        "2024-05-18T04:25:37",
        "date of creation",
    ),
}


@pytest.mark.parametrize("name", METADATA)
def test_times_in_metadata_are_used(tmp_path, name):
    content, stated, words = METADATA[name]
    reader = opened(write(tmp_path / "M00123.WAV", content))
    assert times_s(reader) == [pytest.approx(seconds(stated), abs=1e-6)]
    assert words in reader.notes[0]


UNUSED = {
    "no chunk": (),
    "empty bext": (bext("0000-00-00", "00:00:00"),),
    "no bext": (bext("          ", "        "),),
    "date only": (chunk(b"LIST", b"INFO" + chunk(b"ICRD", b"2024-05-18\0")),),
    "other comment": (comment("Recorded yesterday"),),
    "impossible day": (comment("Recorded at 19:17:30 32/13/2023 (UTC) by AudioMoth"),),
    "bext of year 9999": (bext("9999-12-31", "00:00:00"),),
    "AudioMoth of year 9999": (comment("Recorded at 19:17:30 02/03/9999 (UTC-12) by AudioMoth"),),
    "AudioMoth of year 1": (comment("Recorded at 00:17:30 01/01/0001 (UTC+14) by AudioMoth"),),
    "day of wamd": (wamd((5, b"2014-04-02")),),
}


@pytest.mark.parametrize("name", UNUSED)
def test_unknown_time_is_noted(tmp_path, name):
    reader = opened(write(tmp_path / "M00123.WAV", *UNUSED[name]))
    assert times_s(reader) == [0]
    assert reader.notes == ("M00123.WAV contains no time, so its time is unknown; set start_ns for the first file",)


@pytest.mark.parametrize("time", ["9999-12-31T23:59:59+00:00", "0001-01-01T00:00:00+14:00", "2262-05-01T00:00:00"])
def test_years_of_no_recorder_are_not_used(tmp_path, time):
    reader = opened(write(tmp_path / "20240518_042537.wav", guano(f"Timestamp: {time}")))
    assert times_s(reader) == [seconds("2024-05-18T04:25:37")]
    assert f"20240518_042537.wav: GUANO Timestamp '{time}' was ignored, because it is no time" in reader.notes


def test_invalid_guano_fields_are_noted(tmp_path):
    lines = ("Timestamp: yesterday", "TE: none", "Samplerate: -1")
    notes = " ".join(opened(write(tmp_path / "a.wav", guano(*lines))).notes)
    assert "GUANO Timestamp 'yesterday' was ignored, because it is no time" in notes
    assert "GUANO TE 'none' was ignored, because it is no positive number" in notes
    assert "GUANO Samplerate '-1' was ignored, because it is no positive number" in notes


# ---- several files --------------------------------------------------------------------------------


def test_triggered_files_keep_their_times(tmp_path):
    paths = [write(tmp_path / f"20240518_04{minute}37.WAV") for minute in (25, 26, 40)]
    reader = opened(*paths)
    first = seconds("2024-05-18T04:25:37")
    assert times_s(reader) == [first, first + 60, first + 900]
    (note,) = reader.notes
    assert "times are from file names (2024-05-18 04:25:37 UTC to 2024-05-18 04:40:37 UTC)" in note
    assert "they state no offset, so UTC is assumed" in note


def test_start_of_the_first_file_shifts_all(tmp_path):
    paths = [write(tmp_path / f"20240518_04{minute}37.WAV") for minute in (25, 26)]
    reader = opened(*paths, start_ns=10**18)
    assert times_s(reader) == [1e9, 1e9 + 60]
    assert reader.notes == ("the first file begins at start_ns; the times between files are from file names",)


def test_start_of_each_file_overrides_names(tmp_path):
    paths = [write(tmp_path / f"20240518_04{minute}37.WAV") for minute in (25, 26)]
    reader = opened(*paths, start_ns=[10**18, 10**18 + 5 * 10**9])
    assert times_s(reader) == [1e9, 1e9 + 5]
    assert reader.notes == ()


def test_files_without_times_follow_each_other(tmp_path):
    paths = [write(tmp_path / f"M0012{number}.WAV", seconds=length) for number, length in ((3, 0.5), (4, 0.25))]
    reader = opened(*paths)
    assert times_s(reader) == [0, 0.5]
    assert "neither metadata nor names contain times, so the files are assumed to follow each other" in reader.notes[0]
    assert times_s(opened(*paths, start_ns=10**18)) == [1e9, 1e9 + 0.5]


def test_several_measurements_of_a_file_follow_its_time(tmp_path):
    path = write(tmp_path / "20240518_042537.WAV", seconds=0.3)
    first = seconds("2024-05-18T04:25:37")
    assert times_s(opened(path, length_s=0.1)) == pytest.approx([first, first + 0.1, first + 0.2], abs=1e-6)
    assert times_s(opened(path, skip_s=0.05)) == pytest.approx([first + 0.05], abs=1e-6)
    assert times_s(opened(path, skip_s=0.05, start_ns=10**18)) == [1e9]


def test_names_of_whole_seconds_never_overlap(tmp_path):
    paths = [write(tmp_path / f"T2024-05-18_04-25-37_000000{number}.WAV", seconds=0.25) for number in (1, 2)]
    reader = opened(*paths)
    first = seconds("2024-05-18T04:25:37")
    assert times_s(reader) == pytest.approx([first, first + 0.25], abs=1e-6)
    assert any(
        "times in whole steps of 1 s overlap the previous file by up to 0.25 s; such files begin at the end of the "
        "previous one; use join=True if files with the same time are the microphones" in note
        for note in reader.notes
    )


def test_times_to_the_millisecond_are_not_moved(tmp_path):
    paths = [write(tmp_path / f"20240518_042537_{ms}.WAV", seconds=0.5) for ms in ("000", "200")]
    reader = opened(*paths)
    assert np.diff(times_s(reader)) == pytest.approx([0.2], abs=1e-6)
    assert any("begins 0.3 s before the end of" in note for note in reader.notes)


def test_overlapping_files_are_noted(tmp_path):
    paths = [write(tmp_path / f"20240518_0425{second}.WAV", seconds=5) for second in (37, 39)]
    reader = opened(*paths)
    assert times_s(reader)[1] - times_s(reader)[0] == 2
    assert any("20240518_042539.WAV begins 3 s before the end of 20240518_042537.WAV" in note for note in reader.notes)


def test_contradicting_times_are_noted(tmp_path):
    paths = [
        write(tmp_path / f"20240518_04{minute}37.WAV", guano(f"Timestamp: 2024-05-18T05:{minute}:37+02:00"))
        for minute in (25, 26)
    ]
    reader = opened(*paths)
    assert times_s(reader)[0] == seconds("2024-05-18T03:25:37")
    assert (
        "20240518_042537.WAV (and 1 more): GUANO (2024-05-18 05:25:37 UTC+02:00) and file names (2024-05-18 04:25:37) "
        "differ; that of GUANO is used"
    ) in reader.notes


@pytest.mark.parametrize("name", ["20240518_042537.WAV", "20240518_022537.WAV"])
def test_names_in_the_zone_or_in_utc_agree(tmp_path, name):
    reader = opened(write(tmp_path / name, guano("Timestamp: 2024-05-18T04:25:37+02:00")))
    assert not any("differ" in note for note in reader.notes)


UNSET = "Recorded at 00:00:05 01/01/1970 (UTC) by AudioMoth"


def test_clock_that_was_never_set_yields_to_the_name(tmp_path):
    reader = opened(write(tmp_path / "20240518_042537.WAV", comment(UNSET)))
    assert times_s(reader) == [seconds("2024-05-18T04:25:37")]
    assert "differ; that of file names is used, because a clock of 1970 was not set" in reader.notes[0]


@pytest.mark.parametrize("name", ["M1.WAV", "19700101_000005.WAV", "20000101_000005.WAV"])
def test_clock_that_was_never_set_is_noted(tmp_path, name):
    reader = opened(write(tmp_path / name, *[comment(UNSET)] * (not name.startswith("2000"))))
    assert "so the clock of the recorder was probably not set; use start_ns" in reader.notes[0]


ORDERS = {  # name: notes, None if the order is clear
    "180524_042537.wav": "the date may be 2018-05-24 (year first, as assumed) or 2024-05-18 (day first); use start_ns",
    "240518_042537.wav": "the date may be 2024-05-18 (year first, as assumed) or 2018-05-24 (day first); use start_ns",
    "240538_042537.wav": "contains no time, so its time is unknown",  # no day
    "240531_042537.wav": None,  # not recorded in 2031
    "240524_042537.wav": None,
    "18052024_042537.wav": "contains no time in a known order, so its time is unknown; set start_ns",
    "05-06-2024 04.25.37.wav": "contains no time in a known order, so its time is unknown; set start_ns",
}


@pytest.mark.parametrize("name", ORDERS)
def test_order_of_a_date_is_never_guessed_silently(tmp_path, name):
    path = write(tmp_path / name)
    os.utime(path, (seconds("2026-01-01T00:00:00"),) * 2)
    reader = opened(path)
    assert ORDERS[name] in reader.notes[0] if ORDERS[name] else "date" not in " ".join(reader.notes)


def test_order_of_dates_is_noted_for_folders(tmp_path):
    reader = opened(*(write(tmp_path / f"1805202{year}_042537.wav") for year in "45"))
    assert "nor names contain times in a known order (18052024_042537.wav), so the files" in reader.notes[0]


REFUSED = {
    "backwards": (
        ["20240518_042637.WAV", "20240518_042537.WAV"],
        {},
        DataError,
        r"042537.WAV begins at 2024-05-18 04:25:37 UTC, before 20240518_042637.WAV at 2024-05-18 04:26:37 UTC; list",
    ),
    "clock set back": (
        ["20241027_025900.WAV", "20241027_020100.WAV"],
        {},
        DataError,
        r"set start_ns for each file",
    ),
    "twice": (["a.wav", "b.wav", "a.wav"], {}, ArgumentError, r"a\.wav is listed twice; list each file once"),
    "starts backwards": (["a.wav", "b.wav"], {"start_ns": [10, 5]}, DataError, r"b.wav begins at 1970-01-01"),
    "one without a time": (
        ["20240518_042637.WAV", "b.wav"],
        {},
        DataError,
        r"b.wav contains no time in its metadata or name, but 20240518_042637.WAV does; set start_ns for each file",
    ),
    "too many starts": (
        ["a.wav", "b.wav"],
        {"start_ns": [1, 2, 3]},
        ArgumentError,
        r"start_ns has 3 times for 2 files; set the time of the first file, or that of each",
    ),
    "before 1970": (["19691231_042637.WAV"], {}, DataError, r"states a time before 1970 \(1969-12-31 04:26:37\); set"),
    "expansion": (["a.wav"], {"time_expansion": 1e9}, ArgumentError, r"time_expansion is 1e\+09; use a number from"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_contradicting_files_are_refused(tmp_path, name):
    names, options, error, message = REFUSED[name]
    with pytest.raises(error, match=message):
        opened(*(write(tmp_path / each) for each in names), **options)


# ---- time expansion -------------------------------------------------------------------------------

EXPANDED = {
    "TE": (38_400, ("TE: 10",), {}, 384_000),
    "TE and rate": (38_400, ("TE:10", "Samplerate:384000"), {}, 384_000),
    "rate only": (38_400, ("Samplerate: 384000",), {}, 384_000),
    "rate, and TE of 1": (38_400, ("TE: 1", "Samplerate: 384000"), {}, 384_000),
    "TE of 8": (32_000, ("TE: 8",), {}, 256_000),
    "option": (44_100, (), {"time_expansion": 10}, 441_000),
    "option as metadata": (38_400, ("TE: 10",), {"time_expansion": 10}, 384_000),
    "option against metadata": (38_400, ("TE: 10",), {"time_expansion": 1}, 38_400),
    "resampled": (44_100, ("Samplerate: 384000",), {"time_expansion": 384_000 / 44_100}, 384_000),
}


@pytest.mark.parametrize("name", EXPANDED)
def test_time_expanded_files_have_their_true_rate(tmp_path, name):
    rate_hz, lines, options, true_hz = EXPANDED[name]
    path = write(tmp_path / "a.wav", guano(*lines), rate_hz=rate_hz, seconds=1)
    reader = opened(path, **options)
    assert reader.settings.recording.sample_rate_hz == pytest.approx(true_hz)
    assert any(f"{true_hz} Hz" in note for note in reader.notes)


def test_rate_of_the_header_needs_no_note(tmp_path):
    path = write(tmp_path / "20240518_042537.WAV", guano("TE: 1", "Samplerate: 250000"))
    reader = opened(path)
    assert reader.settings.recording.sample_rate_hz == 250_000
    assert not any("Hz" in note for note in reader.notes)


def test_wildlife_acoustics_time_expansion_is_used(tmp_path):
    path = write(tmp_path / "a.wav", wamd((0x0F, struct.pack("<H", 10))), rate_hz=25_600)
    assert opened(path).settings.recording.sample_rate_hz == 256_000


CONTRADICTIONS = {
    "no whole factor": (("Samplerate: 384000",), r"44100 Hz, .* sample rate of 384000 Hz; .* time_expansion=8.70748"),
    "lower": (("Samplerate: 22050",), r"time_expansion=1 if the header is right"),
    "TE of the true rate": (("TE: 10", "Samplerate: 44100"), r"a time expansion of 10; .*, or time_expansion=10 if"),
}


@pytest.mark.parametrize("name", CONTRADICTIONS)
def test_contradicting_rates_are_refused(tmp_path, name):
    lines, message = CONTRADICTIONS[name]
    with pytest.raises(DataError, match=message):
        opened(write(tmp_path / "a.wav", guano(*lines), rate_hz=44_100))


# ---- folders and command --------------------------------------------------------------------------


def command(*arguments):
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


def test_folder_is_imported_in_the_order_of_times(tmp_path):
    card = tmp_path / "card"
    card.mkdir()
    for name in ("B_20240518_042537.WAV", "A_20240518_042637.wav", "._B_20240518_042537.WAV", "CONFIG.TXT"):
        write(card / name)
    (tmp_path / "one.csv").write_text("0, 0\n")
    done = command("import", "signals", card, "--layout", tmp_path / "one.csv", "--passive")
    assert done.exit_code == 0, done.stderr
    with ertis.open_recording(tmp_path / "card.h5") as recording:
        times = [stamp.timestamp_ns / 1e9 for stamp in recording.stamps()]
    assert times == [seconds("2024-05-18T04:25:37"), seconds("2024-05-18T04:26:37")]


def test_recordings_that_a_folder_leaves_out_are_noted(tmp_path):
    (tmp_path / "Data").mkdir()
    for name in ("a.wav", "Data/b.wav", "._c.flac"):
        write(tmp_path / name)
    (tmp_path / "d.flac").write_bytes(b"fLaC\0\0\0\x22" + bytes(99))
    (tmp_path / "notes.txt").write_text("wind")
    assert opened_folder(tmp_path).notes[0] == (
        f"{tmp_path.name} also contains recordings that were not imported: d.flac, Data/; import them separately"
    )
    assert not any("left out" in note for note in opened_folder(tmp_path / "Data").notes)


def opened_folder(path):
    return ertis.open_pcm(path, ONE, passive=True)


def test_files_of_other_rates_name_the_expansion(tmp_path):
    paths = [write(tmp_path / "a.wav", guano("TE: 10"), rate_hz=25_000), write(tmp_path / "b.wav", rate_hz=25_000)]
    with pytest.raises(DataError, match=r"import each file separately, or use time_expansion if all"):
        opened(*paths)
    assert opened(*paths, time_expansion=10).settings.recording.sample_rate_hz == 250_000
    with pytest.raises(DataError, match=r"b.wav has 48000 Hz, but a.wav has 250000; import each file separately$"):
        opened(paths[0], write(tmp_path / "b.wav", rate_hz=48_000))


def test_import_asks_for_the_call(tmp_path):
    (tmp_path / "one.csv").write_text("0, 0\n")
    arguments = ("import", "signals", write(tmp_path / "a.wav"), "--layout", tmp_path / "one.csv")
    done = command(*arguments)
    assert done.exit_code == 2
    assert "a.wav is unknown; use --passive if none was emitted, otherwise --settings with the call or" in done.stderr
    assert command(*arguments, "--passive").exit_code == 0


def test_folders_with_the_ending_of_wav_are_no_files(tmp_path):
    (tmp_path / "a.wav").mkdir()
    write(tmp_path / "b.wav")
    assert len(opened_folder(tmp_path)) == 1


def test_folder_without_times_has_the_order_of_numbers(tmp_path):
    for number in (2, 10, 1):
        write(tmp_path / f"R_{number}.wav", seconds=0.01 * number)
    assert times_s(opened(tmp_path)) == pytest.approx([0, 0.01, 0.03])


@pytest.mark.parametrize(
    ("made", "named", "message"),
    [
        (
            (),
            ("card",),
            "contains no files to import; choose a folder with .wav files, or with .bin files of RTIS",
        ),
        (("a.wav", "b.bin"), ("card",), "card contains .wav and .bin files; list those of one kind instead"),
        (("Data/a.wav",), ("card",), "contains no files to import; import "),
        (("a.wav",), ("card", "card/a.wav"), "card is a folder; import one folder at a time, or list its files"),
    ],
)
def test_folders_without_files_are_refused(tmp_path, made, named, message):
    (tmp_path / "card" / "Data").mkdir(parents=True)
    for name in made:
        write(tmp_path / "card" / name)
    done = command("import", "signals", *(tmp_path / name for name in named), "--layout", "one.csv", "--passive")
    assert done.exit_code == 2
    assert message in done.stderr


def test_start_may_be_repeated(tmp_path):
    paths = [write(tmp_path / f"{name}.wav") for name in "ab"]
    (tmp_path / "one.csv").write_text("0, 0\n")
    starts = ("--start", "2024-05-18T04:25", "--start", "2024-05-18T04:26")
    done = command("import", "signals", *paths, "--layout", tmp_path / "one.csv", "--passive", *starts, "--json")
    assert done.exit_code == 0, done.stderr
    with ertis.open_recording(tmp_path / "a.h5") as recording:
        first, second = (stamp.timestamp_ns / 1e9 for stamp in recording.stamps())
    assert second - first == 60
