"""Formats of other programs, recognized by the first bytes of a file, and commands that convert them."""

import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Final

__all__ = ["HDF5_PLACES", "HDF5_SIGNATURE", "FileKind", "kind_of", "markup_of", "problem_of", "quoted"]

_HEAD_BYTES = 4096
HDF5_SIGNATURE: Final = b"\x89HDF\r\n\x1a\n"
HDF5_PLACES: Final = (0, 512, 1024, 2048)
"""Places of the signature of HDF5: behind a block of the user, such as that of MATLAB."""
_PICKLES: Final = {b"\x80\2", b"\x80\3", b"\x80\4", b"\x80\5"}
_KILOBITS: Final = (  # per second, of layer III in MPEG 1 and MPEG 2
    (0, 32, 40, 48, 56, 64, 80, 96, 112, 128, 160, 192, 224, 256, 320),
    (0, 8, 16, 24, 32, 40, 48, 56, 64, 80, 96, 112, 128, 144, 160),
)

_FFMPEG = "convert it with 'ffmpeg -i {file} -c:a pcm_f32le -rf64 auto {target}', and import that"
_SAVE = "save its signals as WAV (in Python: scipy.io.wavfile.write), and import that"
_NUMPY = (
    "save it as WAV (in Python: scipy.io.wavfile.write('{stem}.wav', RATE_HZ, numpy.load('{path}'))), and import that"
)
_UNPACK = "unpack it with '{}', and import its files"
_NO_SIGNALS = "choose the file of the recording"
_IMPORT = "import it with 'ertis import signals {file} --settings FILE.toml'"


@dataclass(frozen=True, slots=True)
class FileKind:
    """Format of a file, with its article (``a WAV file``), and a remedy with ``{file}`` and ``{stem}``."""

    name: str
    remedy: str
    is_wav: bool = False
    is_hdf5: bool = False
    is_text: bool = False

    @property
    def is_sound(self) -> bool:
        """True for formats that are sound and nothing else."""
        return self.is_wav or self.remedy == _FFMPEG


_WAV = FileKind("a WAV file", _IMPORT, is_wav=True)
_MATLAB = FileKind(
    "a MATLAB file",
    "save its signals with audiowrite('{stem}.wav', single(signals), rate_hz, 'BitsPerSample', 32), and import that",
)
_HDF5 = FileKind("an HDF5 file", _IMPORT, is_hdf5=True)
_TEXTS: Final = {
    ".toml": "simulate a scene with 'ertis simulate {file}', and use settings with --settings",
    ".tum": "add these poses to a recording with 'ertis import poses REC.h5 {file}'",
}
"""Remedies for text files by their endings."""
_TEXT = FileKind("a text file", f"choose a recording, or {_SAVE}", is_text=True)


def _packed(name: str, command: str) -> FileKind:
    return FileKind(name, _UNPACK.format(command + " {file}"))


# Each row: first bytes, as place and content, all of which must match.
_MAGICS: Final[tuple[tuple[FileKind, tuple[tuple[int, bytes], ...]], ...]] = (
    *((_WAV, ((0, name), (8, b"WAVE"))) for name in (b"RIFF", b"RIFX", b"RF64", b"BW64")),
    (FileKind("an AVI video", _FFMPEG), ((0, b"RIFF"), (8, b"AVI "))),
    (FileKind("a RIFF file of another form than WAVE", _NO_SIGNALS), ((0, b"RIFF"),)),
    (FileKind("a Sony Wave64 file", _FFMPEG), ((0, bytes.fromhex("726966662e91cf11a5d628db04c10000")),)),
    (FileKind("a FLAC file", _FFMPEG), ((0, b"fLaC"),)),
    (FileKind("an Ogg file", _FFMPEG), ((0, b"OggS"),)),
    (FileKind("an MP3 file", _FFMPEG), ((0, b"ID3"),)),
    (FileKind("an AIFF file", _FFMPEG), ((0, b"FORM"), (8, b"AIFF"))),
    (FileKind("an AIFF-C file", _FFMPEG), ((0, b"FORM"), (8, b"AIFC"))),
    (FileKind("an IFF 8SVX file", _FFMPEG), ((0, b"FORM"), (8, b"8SVX"))),
    (FileKind("a CAF file", _FFMPEG), ((0, b"caff"),)),
    (FileKind("a Sun AU file", _FFMPEG), ((0, b".snd"),)),
    (FileKind("a Sun AU file", _FFMPEG), ((0, b"dns."),)),
    (FileKind("a WavPack file", _FFMPEG), ((0, b"wvpk"),)),
    (FileKind("a Monkey's Audio file", _FFMPEG), ((0, b"MAC "),)),
    (FileKind("a TTA file", _FFMPEG), ((0, b"TTA1"),)),
    (FileKind("a Creative Voice file", _FFMPEG), ((0, b"Creative Voice File"),)),
    (FileKind("a NIST SPHERE file", _FFMPEG), ((0, b"NIST_1A"),)),
    (FileKind("a DSF file", _FFMPEG), ((0, b"DSD "),)),
    (FileKind("a DSDIFF file", _FFMPEG), ((0, b"FRM8"),)),
    *(
        (FileKind("an IRCAM file", _FFMPEG), ((0, bytes.fromhex(mark)),))
        for mark in ("64a30100", "64a30200", "64a30300", "64a30400")
    ),
    (FileKind("a PVF file", _FFMPEG), ((0, b"PVF1\n"),)),
    (FileKind("an AVR file", _FFMPEG), ((0, b"2BIT"),)),
    (FileKind("a FastTracker instrument", _FFMPEG), ((0, b"Extended Instrument: "),)),
    (FileKind("an MP4 file", _FFMPEG), ((4, b"ftyp"),)),
    (FileKind("a Matroska or WebM file", _FFMPEG), ((0, bytes.fromhex("1a45dfa3")),)),
    (FileKind("an ASF or WMA file", _FFMPEG), ((0, bytes.fromhex("3026b2758e66cf11")),)),
    (
        FileKind("a Wildlife Acoustics WAC file", "convert it to WAV with Kaleidoscope, and import that"),
        ((0, b"WAac"),),
    ),
    (_MATLAB, ((0, b"MATLAB 5.0 MAT-file"),)),
    (_MATLAB, ((0, b"MATLAB 7.3 MAT-file"),)),
    *((_HDF5, ((place, HDF5_SIGNATURE),)) for place in HDF5_PLACES),
    (FileKind("an HDF4 file", _SAVE), ((0, bytes.fromhex("0e031301")),)),
    *((FileKind("a NetCDF file", _SAVE), ((0, b"CDF" + bytes([version])),)) for version in (1, 2, 5)),
    (FileKind("a NumPy file", _NUMPY), ((0, b"\x93NUMPY"),)),
    (FileKind("a NumPy archive", _SAVE), ((0, b"PK\3\4"), (-1, b".npy"))),
    (_packed("a ZIP archive", "unzip"), ((0, b"PK\3\4"),)),
    (_packed("an empty ZIP archive", "unzip"), ((0, b"PK\5\6"),)),
    (_packed("a gzip file", "gunzip --keep"), ((0, b"\x1f\x8b\x08"),)),
    (_packed("a bzip2 file", "bunzip2 --keep"), ((0, b"BZh"), (4, b"1AY&SY"))),
    (_packed("an xz file", "unxz --keep"), ((0, b"\xfd7zXZ\0"),)),
    (_packed("a Zstandard file", "unzstd"), ((0, bytes.fromhex("28b52ffd")),)),
    (_packed("an LZ4 file", "unlz4"), ((0, bytes.fromhex("04224d18")),)),
    (_packed("a 7-Zip archive", "7z x"), ((0, bytes.fromhex("377abcaf271c")),)),
    (_packed("a RAR archive", "unrar x"), ((0, b"Rar!\x1a\x07"),)),
    (_packed("a tar archive", "tar xf"), ((257, b"ustar"),)),
    (FileKind("a Parquet file", _SAVE), ((0, b"PAR1"),)),
    (FileKind("an Arrow file", _SAVE), ((0, b"ARROW1"),)),
    (FileKind("a Feather file", _SAVE), ((0, b"FEA1"),)),
    (FileKind("a TDMS file of LabVIEW", _SAVE), ((0, b"TDSm"),)),
    (FileKind("a ROOT file", _SAVE), ((0, b"root"),)),
    (FileKind("a FITS file", _SAVE), ((0, b"SIMPLE  ="),)),
    (FileKind("an EDF file", _SAVE), ((0, b"0       "),)),
    (FileKind("a ROS 1 bag", _SAVE), ((0, b"#ROSBAG"),)),
    (FileKind("an MCAP file", _SAVE), ((0, b"\x89MCAP0\r\n"),)),
    (
        FileKind("an SQLite database", "if it is a journal, seal it with 'ertis import journals {file}'"),
        ((0, b"SQLite format 3\0"),),
    ),
    (FileKind("a PNG image", _NO_SIGNALS), ((0, b"\x89PNG\r\n\x1a\n"),)),
    (FileKind("a JPEG image", _NO_SIGNALS), ((0, b"\xff\xd8\xff"),)),
    (FileKind("a GIF image", _NO_SIGNALS), ((0, b"GIF8"),)),
    (FileKind("a TIFF image", _NO_SIGNALS), ((0, b"II*\0"),)),
    (FileKind("a TIFF image", _NO_SIGNALS), ((0, b"MM\0*"),)),
    (FileKind("a PDF document", _NO_SIGNALS), ((0, b"%PDF"),)),
    (FileKind("a PostScript document", _NO_SIGNALS), ((0, b"%!PS"),)),
    (FileKind("a PLY file", _NO_SIGNALS), ((0, b"ply\n"),)),
    (FileKind("a PCD file", _NO_SIGNALS), ((0, b"# .PCD"),)),
    (FileKind("a LAS file", _NO_SIGNALS), ((0, b"LASF"),)),
    (
        FileKind("a pointer of Git LFS", "fetch the file itself with 'git lfs pull'", is_text=True),
        ((0, b"version https://git-lfs"),),
    ),
    *(
        (FileKind("an HTML page", "download the file itself instead of its page", is_text=True), ((0, mark),))
        for mark in (b"<!DOCTYPE html", b"<!doctype html", b"<html", b"<HTML")
    ),
    (FileKind("a MIDI file", _NO_SIGNALS), ((0, b"MThd"),)),
    (FileKind("a program (ELF)", _NO_SIGNALS), ((0, b"\x7fELF"),)),
    (FileKind("a DICOM file", _NO_SIGNALS), ((128, b"DICM"),)),
    (FileKind("a program (Mach-O)", _NO_SIGNALS), ((0, bytes.fromhex("cffaedfe")),)),
)


def kind_of(path: str | Path) -> FileKind | None:
    """Return the format of a file by its content; None if it is unknown, as for raw words, or cannot be read."""
    try:
        with Path(path).open("rb") as file:
            head = file.read(_HEAD_BYTES)
            last = file.read(1) if file.seek(-1, 2) >= 0 and head else b""
    except OSError:
        return None
    for kind, magic in _MAGICS:
        if all(content in head[30:120] if place < 0 else head.startswith(content, place) for place, content in magic):
            return kind
    checks = (
        (_is_matlab_4(head), _MATLAB),
        (_is_mpeg(head), FileKind("an MP3 or AAC file", _FFMPEG)),
        (head[:2] in _PICKLES and last == b".", FileKind("a Python pickle", _SAVE)),
        (head[:2] == b"MZ" and b"This program" in head, FileKind("a program (Windows)", _NO_SIGNALS)),
        (_is_text(head, is_short=Path(path).suffix.lower() in {*_TEXTS, ".csv", ".txt"}), _TEXT),
    )
    return next((kind for fits, kind in checks if fits), None)


def markup_of(text: str) -> str | None:
    """Return the name of a format of text that is neither a table nor TOML, by its first character; None if unknown."""
    return {"{": "JSON", "<": "XML"}.get(text.lstrip()[:1])


def problem_of(path: str | Path, wanted: str = "a recording") -> str:
    """Return the format of a file and its remedy, as ``is a FLAC file; convert it with …``; empty if unknown."""
    kind, path = kind_of(path), Path(path)
    if kind is None:
        return ""
    if "recording" not in wanted:
        shown = f"; 'ertis info {quoted(path)}' describes this file" if kind.is_hdf5 else ""
        return f"is {kind.name}; choose {wanted}{shown}"
    names = {
        "file": quoted(path),
        "path": str(path),
        "stem": str(path.with_suffix("")),
        "target": quoted(path.with_name(f"{path.stem}_pcm.wav")),
    }
    remedy = _TEXTS.get(path.suffix.lower(), kind.remedy) if kind is _TEXT else kind.remedy
    return f"is {kind.name}; {remedy.format(**names)}"


def quoted(path: Path) -> str:
    """Return a path as an argument of a command within single quotation marks, for any shell."""
    return str(path) if re.fullmatch(r"[\w./\\:@%+=,-]+", str(path)) else f'"{path}"'


def _is_matlab_4(head: bytes) -> bool:
    """Return True for a little-endian matrix with a name."""
    if len(head) < 24:
        return False
    kind, n_rows, n_columns, is_complex, n_bytes = struct.unpack_from("<5i", head)
    name = head[20 : 19 + n_bytes] if 2 <= n_bytes <= 64 else b""
    fits = 0 <= kind < 60 and n_rows > 0 and n_columns > 0 and is_complex in {0, 1}
    return fits and name.isascii() and name.decode().isidentifier() and head[19 + n_bytes] == 0


def _is_mpeg(head: bytes) -> bool:
    """Return True for two consecutive frames of MPEG audio: layer III, or AAC with its own headers."""
    if len(head) < 6 or head[0] != 0xFF:
        return False
    if head[1] in {0xF1, 0xF9}:
        length = (head[3] & 3) << 11 | head[4] << 3 | head[5] >> 5
    elif head[1] in {0xFA, 0xFB, 0xF2, 0xF3} and head[2] >> 4 not in {0, 15} and head[2] >> 2 & 3 != 3:
        is_first = head[1] >= 0xFA
        rate_hz = (44_100, 48_000, 32_000)[head[2] >> 2 & 3] / (1 if is_first else 2)
        kilobits = _KILOBITS[0 if is_first else 1][head[2] >> 4]
        length = int((144 if is_first else 72) * 1000 * kilobits / rate_hz) + (head[2] >> 1 & 1)
    else:
        return False
    return length > 6 and head[length : length + 2] == head[:2]


def _is_text(head: bytes, *, is_short: bool) -> bool:
    """Return True for lines of text in UTF-8 or UTF-16; they are longer than a word of any format, or may be short."""
    if head[:2] in {b"\xff\xfe", b"\xfe\xff"} and head.count(0) * 3 > len(head):
        return True
    try:
        text = head.decode("utf-8-sig", "ignore" if len(head) == _HEAD_BYTES else "strict")
    except UnicodeDecodeError:  # text of an older code page, with few letters outside of ASCII
        text = head.decode("latin-1")
        if sum(each > "~" for each in text) * 10 > len(text):
            return False
    lines = text.split("\n")
    has_lines = len(lines) > 1 or text[:1] in {"{", "[", "<"}
    return (is_short or (has_lines and len(set(text)) > 4)) and all(
        each.isprintable() or each in "\t\r\n\f" for each in text
    )
