"""Times of acoustic maps, of their parts, and of the same maps by Acoular, in turns."""

import functools
import time
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np

from ertis_bench.passive._acoular import AcousticMapper
from ertis_bench.passive.agreement import CASES, Case, bins_of
from ertis_bench.passive.sound_signals import N_BLOCK, OWN_RMS, SOURCES, listening, noise
from ertis_numba.frames import Measurement
from ertis_numba.passive import AcousticCamera

__all__ = ["DIRECTIONS", "TIMED", "Taken", "measure", "times_of_parts"]

DIRECTIONS: Final = "3000"

TIMED: Final = CASES | {"hr_clean_sc": Case({"method": "hr_clean_sc"})}
"""Methods whose maps are timed; Acoular has those of ``CASES``."""

_OURS: Final = 10  # runs of this package for one of Acoular, of which the first is not counted
_SLOW_STEP: Final = 23  # bins of Acoular's CLEAN-SC


class Taken(NamedTuple):
    """Time of a call."""

    wall_ms: float
    processor_ms: float

    @classmethod
    def by(cls, call: Callable[[], object]) -> "Taken":
        """Return the time of a call."""
        wall_s, processor_s = time.perf_counter(), time.process_time()
        call()
        return cls(1e3 * (time.perf_counter() - wall_s), 1e3 * (time.process_time() - processor_s))

    @classmethod
    def least(cls, taken: "list[Taken]") -> "Taken":
        """Return the smallest times of several calls."""
        return cls(*np.min(taken, axis=0).tolist())


def measure(*, count: int, seed: int, with_acoular: bool, say: Callable[[str], None]) -> list[dict[str, Any]]:
    """Time maps of each method from float32 signals to third octaves, in turns with Acoular."""
    rows = []
    for name, case in TIMED.items():
        say(f"timing {name}")
        settings = listening(
            processing__directions=DIRECTIONS, **{f"passive__{key}": value for key, value in case.passive.items()}
        )
        heard = noise(settings, SOURCES, own_rms=OWN_RMS, seed=seed)
        with AcousticCamera(settings, "cpu", check=False) as camera:
            row: dict[str, Any] = {"name": name, "bins": len(camera.frequency_hz), "bands": len(camera.band_hz)}
            theirs = _Theirs(camera, heard) if with_acoular and name in CASES else None
            ours: list[Taken] = []
            others: list[Taken] = []
            for _ in range(count + 1):
                ours += [Taken.by(functools.partial(camera.process, heard)) for _ in range(_OURS)][1:]
                if theirs:
                    others.append(theirs.taken())
        row["ours"] = Taken.least(ours)._asdict()
        if others:
            row["acoular"] = Taken.least(others[1:])._asdict()
        rows.append(row)
    return rows


class _Theirs:
    """Map of Acoular, of which CLEAN-SC computes only some of the bins."""

    def __init__(self, camera: AcousticCamera, heard: Measurement) -> None:
        self._mapper, self._samples = AcousticMapper(camera.settings, N_BLOCK), heard.data
        self._centre_hz = np.sqrt(camera.band_hz.prod(axis=1))
        self._bins, self._is_slow = bins_of(camera), camera.settings.passive.method == "clean_sc"

    def taken(self) -> Taken:
        """Return the time of a map, for CLEAN-SC extrapolated from some of the bins."""
        if not self._is_slow:
            return Taken.by(lambda: self._mapper.bands(self._samples, self._centre_hz))
        some = slice(self._bins.start, self._bins.stop, _SLOW_STEP)
        of_matrices = Taken.by(lambda: self._mapper.matrices(self._samples))
        of_some = Taken.by(lambda: self._mapper.powers(self._samples, some))
        n_bins = self._bins.stop - self._bins.start
        factor = n_bins / len(range(n_bins)[::_SLOW_STEP])
        return Taken(*(each + factor * (all_ms - each) for each, all_ms in zip(of_matrices, of_some, strict=True)))


def times_of_parts(*, count: int, seed: int) -> dict[str, dict[str, float]]:
    """Return the times of the parts of a map of delay-and-sum."""
    settings = listening(processing__directions=DIRECTIONS)
    heard = noise(settings, SOURCES, own_rms=OWN_RMS, seed=seed)
    with AcousticCamera(settings, "cpu", check=False) as camera:
        camera.process(heard)
        calls: dict[str, Callable[[], object]] = {
            "signals to cross-spectral matrices": lambda: camera.add(heard),
            "matrices to powers": camera.powers,
            "matrices to map": camera.map,
        }
        taken: dict[str, list[Taken]] = {name: [] for name in calls}
        for _ in range(count):
            for name, call in calls.items():
                taken[name].append(Taken.by(call))
    return {name: Taken.least(each)._asdict() for name, each in taken.items()}
