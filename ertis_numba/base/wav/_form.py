"""The fmt chunk of a WAV file: encoding, sample rate and sizes."""

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from ertis_numba.base.errors import DataError
from ertis_numba.base.file_kinds import quoted

__all__ = ["Form", "convert", "read_form"]

_PCM, _FLOAT, _EXTENSIBLE = 1, 3, 0xFFFE
_GUID_TAILS: Final = {  # of the first two encodings, after the code: of Microsoft in either byte order, and of B-format
    bytes.fromhex("00001000800000aa00389b71"),
    bytes.fromhex("00000010800000aa00389b71"),
    bytes.fromhex("2107d3118644c8c1ca000000"),
}
_MIN_BYTES = 16
_EXTENSIBLE_BYTES = 40
_FLOAT_SIZES = {4, 8}
_MAX_SAMPLE_BYTES = 8
_ENCODINGS: Final = {
    0x0002: "Microsoft ADPCM",
    0x0006: "A-law",
    0x0007: "µ-law",
    0x0010: "OKI ADPCM",
    0x0011: "IMA ADPCM",
    0x0014: "G.723",
    0x0020: "Yamaha ADPCM",
    0x0031: "GSM 6.10",
    0x0040: "G.721 ADPCM",
    0x0042: "G.723.1",
    **dict.fromkeys((0x0045, 0x0064), "G.726 ADPCM"),
    0x0050: "MPEG layer 1 or 2",
    0x0055: "MP3",
    **dict.fromkeys((0x0092, 0x2000), "Dolby AC-3"),
    **dict.fromkeys((0x00FF, 0x1610, 0xA106), "AAC"),
    **dict.fromkeys(range(0x0160, 0x0164), "Windows Media Audio"),
    0x2001: "DTS",
    **dict.fromkeys((0x566F, 0x674F, 0x6751, 0x6771), "Vorbis"),
    0x5756: "WavPack",
    0x704F: "Opus",
    0xF1AC: "FLAC",
}


@dataclass(frozen=True, slots=True)
class Form:
    """Encoding of the samples, and notes on contradictions in its description."""

    kind: str
    n_channels: int
    rate_hz: int
    sample_bytes: int
    valid_bits: int
    notes: tuple[str, ...] = ()

    @property
    def frame_bytes(self) -> int:
        """Size of one sample of all channels."""
        return self.n_channels * self.sample_bytes


def read_form(content: bytes, order: str, place: int, path: Path) -> Form:
    """Return the encoding in a fmt chunk at byte ``place`` (for errors); ``order`` is ``<`` or ``>``."""
    where = f"{path}: the fmt chunk at byte {place}"
    if len(content) < _MIN_BYTES:
        raise DataError(f"{where} has {len(content)} bytes, but needs {_MIN_BYTES}; copy the file again")
    code, n_channels, rate_hz, byte_rate, frame_bytes, bits = struct.unpack_from(f"{order}HHIIHH", content)
    valid_bits = bits
    if code == _EXTENSIBLE:
        if len(content) < _EXTENSIBLE_BYTES:
            raise DataError(
                f"{where} has {len(content)} bytes, but WAVE_FORMAT_EXTENSIBLE needs {_EXTENSIBLE_BYTES}; save the "
                "file again as WAV"
            )
        valid_bits = struct.unpack_from(f"{order}H", content, 18)[0] or bits
        code = _sub_format(content[24:40], order)
    _require_pcm(code, path)
    if not n_channels or not rate_hz:
        raise DataError(f"{where} states {n_channels} channels and {rate_hz} Hz; save the file again as WAV")
    notes = []
    wanted = -(-bits // 8) * n_channels
    if frame_bytes % n_channels and byte_rate == rate_hz * wanted:
        notes.append(
            f"the fmt chunk at byte {place} states frames of {frame_bytes} bytes, but its other values need "
            f"{wanted}, which was used"
        )
        frame_bytes = wanted
    sample_bytes, rest = divmod(frame_bytes, n_channels)
    if frame_bytes != wanted and byte_rate == rate_hz * wanted:
        raise DataError(
            f"{where} states frames of {frame_bytes} bytes, but {n_channels} channels of {bits} bits and {byte_rate} "
            f"bytes per second need {wanted}; save the file again as WAV"
        )
    fits = sample_bytes in _FLOAT_SIZES if code == _FLOAT else 1 <= sample_bytes <= _MAX_SAMPLE_BYTES
    if rest or not fits or not 1 <= bits <= 8 * sample_bytes:
        raise DataError(
            f"{where} states {frame_bytes} bytes for {n_channels} channels of {bits} bits; save the file again as WAV"
        )
    if byte_rate not in {0, rate_hz * frame_bytes % 2**32}:
        notes.append(
            f"the fmt chunk at byte {place} states {byte_rate} bytes per second, but {rate_hz} Hz need "
            f"{rate_hz * frame_bytes}; the rate of {rate_hz} Hz was used"
        )
    kind = "f" if code == _FLOAT else "i"
    return Form(kind, n_channels, rate_hz, sample_bytes, min(valid_bits, bits), tuple(notes))


def convert(path: Path) -> str:
    """Return the remedy for a file in another encoding: a command."""
    target = path.with_name(f"{path.stem}_pcm.wav")
    return f"convert it with 'ffmpeg -i {quoted(path)} -c:a pcm_f32le {quoted(target)}'"


def _sub_format(guid: bytes, order: str) -> int:
    """Return the encoding in a GUID; 0 if it is not one of the registered ones."""
    code, tail = struct.unpack(f"{order}I", guid[:4])[0], guid[4:]
    # Writers of big-endian files swap the two numbers that follow, or leave them.
    return code if tail in _GUID_TAILS else _EXTENSIBLE


def _require_pcm(code: int, path: Path) -> None:
    """Refuse compressed samples by name."""
    if code in {_PCM, _FLOAT}:
        return
    if code not in _ENCODINGS:
        raise DataError(
            f"{path} contains samples of an unknown format, {code:#06x}, but PCM is needed; save them as PCM with the "
            "program that wrote them"
        )
    raise DataError(f"{path} contains {_ENCODINGS[code]} (format {code:#06x}), but PCM is needed; {convert(path)}")
