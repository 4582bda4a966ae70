"""Headers of WAV files: chunk layouts, encodings, and lengths that differ from the file."""

import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from scipy.io import wavfile

from ertis_numba.base.errors import DataError
from ertis_numba.base.wav import read_wav

RATE_HZ, N_CHANNELS, N_SAMPLES = 96_000, 4, 480
VALUES = np.random.default_rng(1).integers(-9_000, 9_000, (N_SAMPLES, N_CHANNELS)).astype("<i2")
DATA = VALUES.tobytes()
PCM_GUID = bytes.fromhex("0100000000001000800000aa00389b71")


def chunk(name, body=b"", size=None, *, pad=True):
    return name + struct.pack("<I", len(body) if size is None else size) + body + b"\0" * (pad and len(body) % 2)


def form(bits=16, code=1, n_channels=N_CHANNELS, sample_bytes=None, byte_rate=None, more=b""):
    block = n_channels * (sample_bytes or bits // 8)
    rate = RATE_HZ * block if byte_rate is None else byte_rate
    return chunk(b"fmt ", struct.pack("<HHIIHH", code, n_channels, RATE_HZ, rate, block, bits) + more)


def extensible(bits, valid_bits, guid=PCM_GUID):
    return form(bits, 0xFFFE, more=struct.pack("<HHI", 22, valid_bits, 0) + guid)


def riff(*chunks, kind=b"RIFF", size=None):
    body = b"WAVE" + b"".join(chunks)
    return kind + struct.pack("<I", len(body) if size is None else size) + body


def ds64(n_bytes, n_samples=N_SAMPLES, table=b""):
    return chunk(b"ds64", struct.pack("<QQQI", 4096, n_bytes, n_samples, len(table) // 12) + table)


def read(tmp_path, content):
    (tmp_path / "take.wav").write_bytes(content)
    return read_wav(tmp_path / "take.wav")


DATA_CHUNK = chunk(b"data", DATA)
BEXT = chunk(b"bext", bytes(602))
INFO = chunk(b"LIST", b"INFO" + chunk(b"ICMT", b"Recorded at 19:17:30"))
ODD = chunk(b"guan", b"GUANO|Version:1.0\nTE:1\n")
UNPADDED = chunk(b"guan", b"GUANO|Version:1.0\nTE:1\n", pad=False)

FITTING = {
    # chunks whose samples are all read without a note
    "plain": (form(), DATA_CHUNK),
    "18 bytes of format": (form(more=b"\0\0"), DATA_CHUNK),
    "40 bytes of format": (extensible(16, 16), DATA_CHUNK),
    "fact": (form(), chunk(b"fact", struct.pack("<I", N_SAMPLES)), DATA_CHUNK),
    "metadata before": (BEXT, form(), INFO, ODD, DATA_CHUNK),
    "metadata after": (form(), DATA_CHUNK, BEXT, INFO, ODD),
    "odd chunk without its padding, before": (form(), UNPADDED, DATA_CHUNK),
    "odd chunk without its padding, after": (form(), DATA_CHUNK, UNPADDED, INFO),
    "odd chunk without its padding, last": (form(), DATA_CHUNK, UNPADDED),
    "samples before format": (DATA_CHUNK, form()),
    "empty chunks": (chunk(b"JUNK"), form(), chunk(b"PAD "), DATA_CHUNK, chunk(b"cue ")),
    "large junk": (chunk(b"JUNK", bytes(70_000)), form(), DATA_CHUNK),
}


@pytest.mark.parametrize("name", FITTING)
def test_read_wav_accepts_any_order_of_chunks(tmp_path, name):
    wav = read(tmp_path, riff(*FITTING[name]))
    assert np.array_equal(wav.samples[:], VALUES)
    assert (wav.rate_hz, wav.notes) == (RATE_HZ, ())


def test_read_wav_returns_metadata(tmp_path):
    wav = read(tmp_path, riff(form(), INFO, DATA_CHUNK, ODD))
    assert wav.chunks["guan"] == b"GUANO|Version:1.0\nTE:1\n"
    assert wav.chunks["INFO"] == chunk(b"ICMT", b"Recorded at 19:17:30")
    assert "data" not in wav.chunks


WRONG = {
    # content with another length than stated, and a part of the note
    "power cut": (riff(form(), chunk(b"data", DATA, 0), size=0), "at byte 36 states 0 bytes, which means unknown"),
    "ffmpeg": (
        riff(form(), chunk(b"data", DATA, 2**32 - 1), size=2**32 - 1),
        "states 4294967295 bytes, which means unknown",
    ),
    "ffmpeg's difference": (riff(form(), chunk(b"data", DATA, 2**32 - 37), size=2**32 - 1), "which means unknown"),
    "sox": (
        riff(form(), chunk(b"data", DATA, 0x7FFFF000), size=0x7FFFF024),
        "states 2147479552 bytes, which means unknown",
    ),
    "arecord": (
        riff(form(), chunk(b"data", DATA, 2**31), size=2**31 + 36),
        "states 2147483648 bytes, which means unknown",
    ),
    "GStreamer": (riff(form(), chunk(b"data", DATA, 0x7FFF0000)), "states 2147418112 bytes, which means unknown"),
    "unknown, and chunks behind": (riff(form(), chunk(b"data", DATA, 0), INFO, ODD, size=0), "read to the end, 3840"),
    "within a frame": (riff(form(), chunk(b"data", DATA + b"\1\2\3", 0), size=0), "read to the end, 3840 bytes"),
    "RF64 without its lengths": (riff(ds64(0), form(), chunk(b"data", DATA, 2**32 - 1), kind=b"RF64"), "unknown"),
    "RF64 with the lower length": (riff(ds64(7), form(), DATA_CHUNK, kind=b"RF64", size=2**32 - 1), ""),
    "RF64 with a wrong length": (
        riff(ds64(3840), form(), chunk(b"data", DATA, 16), kind=b"RF64"),
        "states 16 bytes, but the file contains 3840",
    ),
    "only RIFF is right": (riff(form(), chunk(b"data", DATA, len(DATA) + 44)), "as the RIFF chunk states"),
    "rest": (riff(form(), DATA_CHUNK) + b"\x01\xff\x80?" * 9, "36 bytes from byte 3884 on belong to no chunk"),
    "zeros": (riff(form(), DATA_CHUNK) + bytes(100_000), "100000 bytes from byte 3884 on belong to no chunk"),
    "fact": (riff(form(), chunk(b"fact", b"\x07\0\0\0"), DATA_CHUNK), "fact chunk at byte 36 states 7 samples"),
    "RIFF": (riff(form(), DATA_CHUNK, size=999), "the RIFF chunk states 999 bytes, but 3876 follow"),
    "bytes per second": (riff(form(byte_rate=12_345), DATA_CHUNK), "states 12345 bytes per second, but 96000 Hz need"),
    "frame": (
        riff(chunk(b"fmt ", struct.pack("<HHIIHH", 1, 4, RATE_HZ, 8 * RATE_HZ, 7, 16)), DATA_CHUNK),
        "states frames of 7 bytes, but its other values need 8",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_read_wav_reads_all_samples_despite_wrong_lengths(tmp_path, name):
    content, note = WRONG[name]
    wav = read(tmp_path, content)
    assert np.array_equal(wav.samples[:], VALUES)
    assert not note or any(note in each for each in wav.notes), wav.notes


def test_read_wav_reads_relatives(tmp_path):
    for kind in (b"RF64", b"BW64"):
        wav = read(tmp_path, riff(ds64(3840), form(), chunk(b"data", DATA, 2**32 - 1), INFO, kind=kind))
        assert np.array_equal(wav.samples[:], VALUES)


REFUSED = {
    "truncated": (
        riff(form(), chunk(b"data", DATA, 9_999), size=10_035),
        r"byte 36 states 9999 bytes, but the file ends after 3840",
    ),
    "long rest": (
        riff(form(), DATA_CHUNK) + b"\x81" * 70_000,
        r"byte 36 states 3840 bytes, but 73840 follow, and no chunk begins at byte 3884; read all of them with 'ffmpeg",
    ),
    "short length": (
        riff(form(), chunk(b"data", DATA, 800)),
        r"byte 36 states 800 bytes, but 3840 follow, and no chunk begins at byte 844; read all of them with 'ffmpeg",
    ),
    "two formats": (
        riff(form(), form(byte_rate=1), DATA_CHUNK),
        r"has different fmt chunks at bytes 12 and 36; save the file again as WAV",
    ),
    "half a frame": (
        riff(form(), chunk(b"data", DATA[:-2])),
        r"has 3838 bytes of samples, not a multiple of .* 8 bytes",
    ),
    "no data": (riff(form(), INFO), r"has no samples: no data chunk follows the chunk 'LIST' at byte 36 of \d+; copy"),
    "no format": (riff(DATA_CHUNK, INFO), r"no fmt chunk follows the chunk 'LIST' at byte 3860"),
    "empty data": (riff(form(), chunk(b"data")), r"its data chunk at byte 36 is empty"),
    "empty data before metadata": (riff(form(), chunk(b"data"), INFO), r"its data chunk at byte 36 is empty"),
    "two data": (
        riff(form(), DATA_CHUNK, DATA_CHUNK),
        r"data chunks at bytes 36 and 3884; keep .* 'sox /.*/take.wav /.*/take_",
    ),
    "two files": (riff(form(), DATA_CHUNK) * 2, r"second WAV file from byte 3884 on; separate them with 'head -c 3884"),
    "beyond": (riff(form(), chunk(b"LIST", b"INFO", 99_999)), r"no data chunk follows the chunk 'LIST' at byte 36"),
    "short format": (
        riff(chunk(b"fmt ", bytes(14)), DATA_CHUNK),
        r"the fmt chunk at byte 12 has 14 bytes, but needs 16",
    ),
    "short extension": (riff(form(code=0xFFFE, more=b"\0\0"), DATA_CHUNK), r"has 18 bytes, but .* needs 40"),
    "no rate": (riff(chunk(b"fmt ", struct.pack("<HHIIHH", 1, 4, 0, 0, 8, 16)), DATA_CHUNK), r"4 channels and 0 Hz"),
    "no bits": (riff(form(bits=0, sample_bytes=2), DATA_CHUNK), r"states 8 bytes for 4 channels of 0 bits"),
    "half float": (riff(form(code=3), DATA_CHUNK), r"states 8 bytes for 4 channels of 16 bits"),
    "A-law": (
        riff(form(8, 6), DATA_CHUNK),
        r"contains A-law \(format 0x0006\), .*'ffmpeg -i /.*/take.wav -c:a pcm_f32le",
    ),
    "ADPCM": (riff(form(4, 0x11, sample_bytes=256), DATA_CHUNK), r"contains IMA ADPCM \(format 0x0011\)"),
    "unknown": (riff(form(code=0x1234), DATA_CHUNK), r"contains samples of an unknown format, 0x1234"),
    "extended µ-law": (riff(extensible(8, 8, b"\7" + PCM_GUID[1:]), DATA_CHUNK), r"contains µ-law \(format 0x0007\)"),
    "unknown GUID": (riff(extensible(16, 16, b"\1" * 16), DATA_CHUNK), r"contains samples of an unknown format"),
    "other form": (b"RIFF\x00\x10\0\0AVI LIST", r"is an AVI video; convert it with"),
    "only a start": (b"RIF", r"is not a WAV file: it begins with b'RIF'"),
    "nothing": (b"", r"is empty; copy the file again, or leave it out"),
    "16 bits in 4 bytes": (
        riff(chunk(b"fmt ", struct.pack("<HHIIHH", 1, 1, RATE_HZ, 2 * RATE_HZ, 4, 16)), DATA_CHUNK),
        r"states frames of 4 bytes, but 1 channels of 16 bits and 192000 bytes per second need 2; save the file again",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_read_wav_refuses_by_chunk_and_byte(tmp_path, name):
    content, message = REFUSED[name]
    with pytest.raises(DataError, match=message):
        read(tmp_path, content)


def test_read_wav_refuses_missing_files(tmp_path):
    with pytest.raises(DataError, match=r"none\.wav: No such file or directory; choose a WAV file"):
        read_wav(tmp_path / "none.wav")


ENCODINGS = {
    # bits, bytes of a sample, valid bits, type of the samples that are read
    "8": (8, 1, 8, "u1"),
    "12 in 16": (12, 2, 12, "<i2"),
    "24": (24, 3, 24, "<i4"),
    "24 in 32": (24, 4, 24, "<i4"),
    "24 in 32, extensible": (32, 4, 24, "<i4"),
    "40": (40, 5, 40, "<i8"),
    "64": (64, 8, 64, "<i8"),
}


@pytest.mark.parametrize("name", ENCODINGS)
def test_read_wav_fills_integers_from_the_top(tmp_path, name):
    bits, sample_bytes, valid_bits, dtype = ENCODINGS[name]
    wide = np.random.default_rng(2).integers(-(2**63), 2**63, (50, 3)) >> (64 - valid_bits) << (64 - valid_bits)
    packed = wide.astype("<i8").view(np.uint8).reshape(50, 3, 8)[..., 8 - sample_bytes :]
    packed = packed ^ 128 if sample_bytes == 1 else packed
    if bits == 32:
        header = form(32, 0xFFFE, 3, more=struct.pack("<HHI", 22, valid_bits, 0) + PCM_GUID)
    else:
        header = form(bits, 1, 3, sample_bytes)
    wav = read(tmp_path, riff(header, chunk(b"data", packed.tobytes())))
    values = wav.samples[10:20]
    assert (wav.samples.shape, wav.samples.dtype, values.dtype) == ((50, 3), dtype, dtype)
    signed = values.astype(np.int64) - 128 if dtype == "u1" else values.astype(np.int64)
    assert np.array_equal(signed << (64 - 8 * values.dtype.itemsize), wide[10:20])
    assert wav.notes == ()


def test_read_wav_notes_samples_in_low_bits(tmp_path):
    values = np.random.default_rng(3).integers(-(2**22), 2**22, (100, 4)).astype("<i4")
    wav = read(tmp_path, riff(extensible(32, 24), chunk(b"data", values.tobytes())))
    assert np.array_equal(wav.samples[:], values)
    assert wav.notes[0].endswith("if levels are 48 dB too low, multiply them by 256")


def test_read_wav_is_fast_for_chains_of_odd_chunks(tmp_path):
    """Each chunk of one byte may be padded or not, so that there are 2 ** 5000 chains."""
    content = riff(form(), chunk(b"data", DATA, 8)) + b"a\1\0\0" * 20_000
    with pytest.raises(DataError, match="no chunk begins"):
        read(tmp_path, content)


def big_wav(path, n_bytes, chunks=b"", stated=None, n_channels=8):
    """Write a sparse file; its last frame is 1, 2, 3, …"""
    last = np.arange(1, n_channels + 1).astype("<i2").tobytes()
    with path.open("wb") as file:
        header = form(n_channels=n_channels)
        file.write(riff(header, size=(n_bytes + 36 + len(chunks)) % 2**32))
        file.write(b"data" + struct.pack("<I", n_bytes % 2**32 if stated is None else stated))
        file.truncate(44 + n_bytes - len(last))
        file.seek(0, 2)
        file.write(last + chunks)


@pytest.mark.parametrize("trailer", [b"", INFO, BEXT + ODD, UNPADDED], ids=["none", "INFO", "bext, guan", "unpadded"])
@pytest.mark.parametrize("n_bytes", [2**32 + 16, 2**32 + 16 * 10**6, 2 * 2**32 + 32])
def test_read_wav_unwraps_lengths_above_4_gib(tmp_path, n_bytes, trailer):
    path = tmp_path / "long.wav"
    big_wav(path, n_bytes, trailer)
    tracemalloc.start()
    try:
        wav = read_wav(path)
        last = wav.samples[n_bytes // 16 - 1 :]
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
        path.unlink()
    assert wav.samples.shape == (n_bytes // 16, 8)
    assert last.tolist() == [[1, 2, 3, 4, 5, 6, 7, 8]]
    assert wav.notes[0] == (
        f"the data chunk at byte 36 states {n_bytes % 2**32} bytes, but the file contains {n_bytes}, which were read"
    )
    assert most < 100e6


def test_read_wav_refuses_lengths_above_4_gib_without_an_end(tmp_path):
    path = tmp_path / "long.wav"
    big_wav(path, 2**32 + 16_000, stated=8_000)
    with pytest.raises(DataError, match=r"byte 36 states 8000 bytes, but 4294983296 follow, and no chunk begins at"):
        read_wav(path)
    path.unlink()


SCIPY = sorted((Path(wavfile.__file__).parent / "tests/data").glob("*.wav"))
SCIPY_REFUSED = {
    "test-44100Hz-le-1ch-4bytes-early-eof-no-data.wav": "no data chunk",
    "test-44100Hz-le-1ch-4bytes-early-eof.wav": "truncated: the data chunk at byte 72 states 17640 bytes",
    "test-44100Hz-le-1ch-4bytes-incomplete-chunk.wav": "no fmt chunk",
    "test-8000Hz-le-1ch-1byte-ulaw.wav": "contains µ-law",
}


@pytest.mark.skipif(not SCIPY, reason="this SciPy comes without its tests")
@pytest.mark.filterwarnings("ignore::scipy.io.wavfile.WavFileWarning")
@pytest.mark.parametrize("path", SCIPY, ids=lambda path: path.stem)
def test_read_wav_agrees_with_scipy(path):
    if path.name in SCIPY_REFUSED:
        with pytest.raises(DataError, match=SCIPY_REFUSED[path.name]):
            read_wav(path)
        return
    wav = read_wav(path)
    if "inconsistent" in path.name:  # SciPy refuses it.
        path = path.with_name("test-8000Hz-le-3ch-5S-24bit.wav")
    rate_hz, values = wavfile.read(path)
    assert wav.rate_hz == rate_hz
    assert np.array_equal(wav.samples[:], values.reshape(len(values), -1))
