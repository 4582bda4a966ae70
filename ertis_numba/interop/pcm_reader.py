"""Reader of the measurements in PCM files."""

from collections.abc import Iterator, Sequence

import numpy as np

from ertis_numba.base import checks
from ertis_numba.frames import Behaviour, Measurement, Stamp
from ertis_numba.geometry import microphones
from ertis_numba.interop.pcm_cuts import Cuts
from ertis_numba.interop.pcm_files import PcmFile, per_file
from ertis_numba.interop.sample_levels import SampleLevels
from ertis_numba.settings import Settings

__all__ = ["PcmReader"]


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
