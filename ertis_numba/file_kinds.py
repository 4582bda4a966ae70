"""Formats of other programs, recognized by the first bytes of a file, and commands that convert them."""

import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Final

__all__ = ["FileKind", "kind_of", "problem_of", "quoted"]

_HEAD_BYTES = 4096
_HDF5_PLACES: Final = (0, 512, 1024, 2048)  # behind a block of the user, such as that of MATLAB
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
_IMPORT = "import it with 'ertis import {file} --settings FILE.toml'"


@dataclass(frozen=True, slots=True)
class FileKind:
    """Format of a file.

    Attributes
    ----------
    name : str
        Format with its article, such as ``a WAV file``.
    remedy : str
        Instruction with ``{file}`` and ``{stem}``.
    is_wav, is_hdf5 : bool
        True for formats that `open_pcm` reads, if their content fits.
    is_text : bool
        True for lines of text.
    """

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
_MATLAB = FileKind("a MATLAB file", "save its signals with audiowrite('{stem}.wav', signals, rate_hz), and import that")
_HDF5 = FileKind("an HDF5 file", _IMPORT, is_hdf5=True)
_TEXT = FileKind("a text file", f"choose a recording, or {_SAVE}", is_text=True)


def _audio(name: str) -> FileKind:
    return FileKind(name, _FFMPEG)


def _data(name: str) -> FileKind:
    return FileKind(name, _SAVE)


def _packed(name: str, command: str) -> FileKind:
    return FileKind(name, _UNPACK.format(command + " {file}"))


def _other(name: str) -> FileKind:
    return FileKind(name, _NO_SIGNALS)


# Each row: first bytes, as place and content, all of which must match.
_MAGICS: Final[tuple[tuple[FileKind, tuple[tuple[int, bytes], ...]], ...]] = (
    *((_WAV, ((0, name), (8, b"WAVE"))) for name in (b"RIFF", b"RIFX", b"RF64", b"BW64")),
    (_audio("an AVI video"), ((0, b"RIFF"), (8, b"AVI "))),
    (_other("a RIFF file of another form than WAVE"), ((0, b"RIFF"),)),
    (_audio("a Sony Wave64 file"), ((0, bytes.fromhex("726966662e91cf11a5d628db04c10000")),)),
    (_audio("a FLAC file"), ((0, b"fLaC"),)),
    (_audio("an Ogg file"), ((0, b"OggS"),)),
    (_audio("an MP3 file"), ((0, b"ID3"),)),
    (_audio("an AIFF file"), ((0, b"FORM"), (8, b"AIFF"))),
    (_audio("an AIFF-C file"), ((0, b"FORM"), (8, b"AIFC"))),
    (_audio("an IFF 8SVX file"), ((0, b"FORM"), (8, b"8SVX"))),
    (_audio("a CAF file"), ((0, b"caff"),)),
    (_audio("a Sun AU file"), ((0, b".snd"),)),
    (_audio("a Sun AU file"), ((0, b"dns."),)),
    (_audio("a WavPack file"), ((0, b"wvpk"),)),
    (_audio("a Monkey's Audio file"), ((0, b"MAC "),)),
    (_audio("a TTA file"), ((0, b"TTA1"),)),
    (_audio("a Creative Voice file"), ((0, b"Creative Voice File"),)),
    (_audio("a NIST SPHERE file"), ((0, b"NIST_1A"),)),
    (_audio("a DSF file"), ((0, b"DSD "),)),
    (_audio("a DSDIFF file"), ((0, b"FRM8"),)),
    *(
        (_audio("an IRCAM file"), ((0, bytes.fromhex(mark)),))
        for mark in ("64a30100", "64a30200", "64a30300", "64a30400")
    ),
    (_audio("a PVF file"), ((0, b"PVF1\n"),)),
    (_audio("an AVR file"), ((0, b"2BIT"),)),
    (_audio("a FastTracker instrument"), ((0, b"Extended Instrument: "),)),
    (_audio("an MP4 file"), ((4, b"ftyp"),)),
    (_audio("a Matroska or WebM file"), ((0, bytes.fromhex("1a45dfa3")),)),
    (_audio("an ASF or WMA file"), ((0, bytes.fromhex("3026b2758e66cf11")),)),
    (
        FileKind("a Wildlife Acoustics WAC file", "convert it to WAV with Kaleidoscope, and import that"),
        ((0, b"WAac"),),
    ),
    (_MATLAB, ((0, b"MATLAB 5.0 MAT-file"),)),
    (_MATLAB, ((0, b"MATLAB 7.3 MAT-file"),)),
    *((_HDF5, ((place, b"\x89HDF\r\n\x1a\n"),)) for place in _HDF5_PLACES),
    (_data("an HDF4 file"), ((0, bytes.fromhex("0e031301")),)),
    *((_data("a NetCDF file"), ((0, b"CDF" + bytes([version])),)) for version in (1, 2, 5)),
    (FileKind("a NumPy file", _NUMPY), ((0, b"\x93NUMPY"),)),
    (_data("a NumPy archive"), ((0, b"PK\3\4"), (-1, b".npy"))),
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
    (_data("a Parquet file"), ((0, b"PAR1"),)),
    (_data("an Arrow file"), ((0, b"ARROW1"),)),
    (_data("a Feather file"), ((0, b"FEA1"),)),
    (_data("a TDMS file of LabVIEW"), ((0, b"TDSm"),)),
    (_data("a ROOT file"), ((0, b"root"),)),
    (_data("a FITS file"), ((0, b"SIMPLE  ="),)),
    (_data("an EDF file"), ((0, b"0       "),)),
    (_data("a ROS 1 bag"), ((0, b"#ROSBAG"),)),
    (_data("an MCAP file"), ((0, b"\x89MCAP0\r\n"),)),
    (
        FileKind("an SQLite database", "if it is a journal, seal it with 'ertis recover {file}'"),
        ((0, b"SQLite format 3\0"),),
    ),
    (_other("a PNG image"), ((0, b"\x89PNG\r\n\x1a\n"),)),
    (_other("a JPEG image"), ((0, b"\xff\xd8\xff"),)),
    (_other("a GIF image"), ((0, b"GIF8"),)),
    (_other("a TIFF image"), ((0, b"II*\0"),)),
    (_other("a TIFF image"), ((0, b"MM\0*"),)),
    (_other("a PDF document"), ((0, b"%PDF"),)),
    (_other("a PostScript document"), ((0, b"%!PS"),)),
    (_other("a PLY file"), ((0, b"ply\n"),)),
    (_other("a PCD file"), ((0, b"# .PCD"),)),
    (_other("a LAS file"), ((0, b"LASF"),)),
    (_other("a MIDI file"), ((0, b"MThd"),)),
    (_other("a program (ELF)"), ((0, b"\x7fELF"),)),
    (_other("a DICOM file"), ((128, b"DICM"),)),
    (_other("a program (Mach-O)"), ((0, bytes.fromhex("cffaedfe")),)),
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
        (_is_mpeg(head), _audio("an MP3 or AAC file")),
        (head[:1] == b"\x80" and head[1:2] in {b"\2", b"\3", b"\4", b"\5"} and last == b".", _data("a Python pickle")),
        (head[:2] == b"MZ" and b"This program" in head, _other("a program (Windows)")),
        (_is_text(head), _TEXT),
    )
    return next((kind for fits, kind in checks if fits), None)


def problem_of(path: str | Path, wanted: str = "a recording") -> str:
    """Return the format of a file and its remedy, as ``is a FLAC file; convert it with …``; empty if unknown.

    Signals can be converted into a recording. If no recording is wanted, the remedy names what is.
    """
    kind, path = kind_of(path), Path(path)
    if kind is None:
        return ""
    if "recording" not in wanted:
        return f"is {kind.name}; choose {wanted}"
    names = {
        "file": quoted(path),
        "path": str(path),
        "stem": str(path.with_suffix("")),
        "target": quoted(path.with_name(f"{path.stem}_pcm.wav")),
    }
    return f"is {kind.name}; {kind.remedy.format(**names)}"


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


def _is_text(head: bytes) -> bool:
    """Return True for lines of text in UTF-8 or UTF-16, longer than a word of any format."""
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
    return has_lines and len(set(text)) > 4 and all(each.isprintable() or each in "\t\r\n\f" for each in text)
