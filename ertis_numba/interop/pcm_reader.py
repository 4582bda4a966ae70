"""Reader of the measurements in PCM files."""

import math
from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.frames import Behaviour, Measurement, Stamp
from ertis_numba.geometry import microphones
from ertis_numba.interop.pcm_cuts import Cuts
from ertis_numba.interop.pcm_files import PcmFile, per_file
from ertis_numba.settings import Settings

__all__ = ["PcmReader", "SampleLevels"]


_MIN_CLIPPED: Final = 5  # Fewer samples at full scale may be the single peaks of a normalised file.
_TOP: Final = 1 - 2.0**-23  # Largest sample of 24 bits.
_TOP_OF_BYTES: Final = 127 * 256
_LARGE: Final = 4.0  # Floating-point samples above full scale are possible, but not that far.
_SCALES: Final = (2.0**15, 2.0**23, 2.0**31)
_MAX_PASCALS: Final = 200.0  # 140 dB


class PcmReader:
    """Reader of the measurements in PCM files, one file at a time; `open_pcm` creates it.

    Such files contain no SYNC count, so it equals the number of the measurement. 8-bit and 16-bit samples become int16.
    All others become float32, which represents 24-bit and single-precision samples exactly.

    Parameters
    ----------
    files : sequence of PcmFile
    cuts : Cuts
    settings : Settings
    sensor : str
    behaviour : Behaviour
    firsts_ns : sequence of int
        Time of the first measurement of each file.
    without : int or None
        Channel to leave out.
    notes : sequence of str

    Attributes
    ----------
    settings : Settings
        Settings of the measurements, with sample rate, length and encoding of the files.
    """

    def __init__(
        self,
        files: Sequence[PcmFile],
        cuts: Cuts,
        settings: Settings,
        *,
        sensor: str,
        behaviour: Behaviour,
        firsts_ns: Sequence[int],
        without: int | None,
        notes: Sequence[str],
    ) -> None:
        self.settings = settings
        self._files, self._cuts, self._firsts_ns = files, cuts, firsts_ns
        self._sensor = checks.sensor_name(sensor)
        self._behaviour: Behaviour = behaviour
        self._without, self._notes = without, notes
        self._levels: dict[int, SampleLevels] = {}

    def __len__(self) -> int:
        return len(self._cuts)

    def __iter__(self) -> Iterator[Measurement]:
        enabled = microphones(self.settings.array).enabled
        sequence = 0
        parts = zip(self._files, self._cuts.samples, self._cuts.times_s, self._firsts_ns, strict=True)
        for number, (file, starts, times_s, first_ns) in enumerate(parts):
            samples = file.open(without=self._without)
            levels = self._levels[number] = SampleLevels(
                self.settings.recording.full_scale, file.kind, is_wide=file.is_wide
            )
            later_ns = np.rint(1e9 * (times_s - times_s[0])).astype(np.int64)
            for start, time_ns in zip(starts.tolist(), (first_ns + later_ns).tolist(), strict=True):
                stamp = Stamp(
                    sensor=self._sensor,
                    sequence=sequence,
                    sync_count=sequence,
                    timestamp_ns=time_ns,
                    behaviour=self._behaviour,
                )
                words = samples.block(slice(start, start + self._cuts.n_samples), enabled)
                levels.add(words)
                yield Measurement(words, self.settings, stamp)
                sequence += 1

    @property
    def notes(self) -> tuple[str, ...]:
        """Source of the times, assumptions and losses; those about the samples follow once they have been read."""
        levels = [(self._files[number].path, each.note) for number, each in self._levels.items() if each.note]
        return (*self._notes, *self._rest(), *per_file(levels))

    @property
    def rest_s(self) -> float:
        """Total duration of unused samples at the ends of the files, in seconds."""
        return self._cuts.rest_s(self._files)

    def _rest(self) -> list[str]:
        """Return the note on samples that no measurement contains."""
        if not self.rest_s:
            return []
        shortest = min(self._files, key=lambda file: file.n_samples)
        text = f"{self.rest_s:.4g} s at the ends of files were left out"
        if len(self) == len(self._files) and self.rest_s > shortest.duration_s / 2:
            text += (
                f", because {shortest.path.name} lasts only {shortest.duration_s:.4g} s; use length_s for "
                "several measurements per file"
            )
        return [text]


class SampleLevels:
    """Peak and number of full-scale samples of a file; is_wide: 32- or 64-bit integers use all bits."""

    def __init__(self, full_scale: float, kind: np.dtype[Any], *, is_wide: bool) -> None:
        self._top = _TOP_OF_BYTES if kind.itemsize == 1 else _TOP if full_scale == 1 else full_scale - 1
        self._full_scale = full_scale
        self._is_float = kind.kind == "f"
        self._is_wide, self._bits = is_wide, 8 * kind.itemsize
        self._peak = 0.0
        self._uses_lowest_byte = False
        self._n_clipped = np.zeros(0, np.int64)

    def add(self, samples: NDArray[Any]) -> None:
        """Count the samples of a block, (sample, channel)."""
        clipped = np.count_nonzero((samples >= self._top) | (samples <= -self._full_scale), axis=0)
        self._n_clipped = clipped if not self._n_clipped.size else self._n_clipped + clipped
        if samples.size:
            self._peak = max(self._peak, float(samples.max()), -float(samples.min()))
        if self._may_be_narrower and not self._uses_lowest_byte:
            self._uses_lowest_byte = bool((samples.astype(np.float64) * 2.0 ** (self._bits - 1) % 256).any())

    @property
    def _may_be_narrower(self) -> bool:
        """Return True if all samples so far fit 24 bits of a wider type."""
        return self._is_wide and self._peak <= 2.0 ** (24 - self._bits)

    @property
    def note(self) -> str:
        """Note on samples that are zero, clipped or on another scale; empty if there are none."""
        if not self._peak:
            return "all samples are 0; choose another input of the recorder"
        if self._may_be_narrower and self._uses_lowest_byte:
            return self._narrower()
        if self._is_float and self._peak > _LARGE:
            scale = next((each for each in _SCALES if self._peak <= each), self._peak)
            return (
                f"floating-point samples reach {self._peak:.6g}, but their full scale is 1, so levels are up to "
                f"{20 * math.log10(scale):.0f} dB too high; divide the samples by {scale:g}"
                + (
                    ", or if they are pascals, set array.sensitivity_dbfs = 3 for levels in dB re 20 µPa"
                    if self._peak < _MAX_PASCALS
                    else ""
                )
            )
        if self._is_float and self._peak > 1:  # A converter of floating-point samples does not clip at 1.
            return ""
        channels = np.flatnonzero(self._n_clipped >= _MIN_CLIPPED)
        if not len(channels):
            return ""
        named = ", ".join(map(str, channels[:8])) + (", …" if len(channels) > 8 else "")
        return (
            f"{self._n_clipped[channels].sum()} samples of channel{'s' * (len(channels) > 1)} {named} are at full "
            "scale, so they are probably clipped"
        )

    def _narrower(self) -> str:
        """Return the note on integers that fit a smaller type, whose levels are too low if they come from one."""
        peak = self._peak * 2.0 ** (self._bits - 1)
        width = next(bits for bits in (16, 24) if peak <= 2.0 ** (bits - 1))
        unused = self._bits - width
        return (
            f"integers of {self._bits} bits reach only {peak:.6g}, as those of {width} bits do; if they are such, "
            f"levels are {20 * math.log10(2) * unused:.0f} dB too low; multiply the samples by {2**unused}"
        )
