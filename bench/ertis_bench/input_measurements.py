"""Input measurements for benchmarks."""

import importlib.metadata
from pathlib import Path

import numpy as np

from ertis_numba.frames import Measurement
from ertis_numba.interop import open_raw
from ertis_numba.settings import Settings
from ertis_numba.storage import open_recording

__all__ = ["measurement", "noise", "real"]

_RECORDING = Path(__file__).parents[2] / "data" / "synthetic" / "reflectors.h5"
_DISTRIBUTION = "rtisdev"


def measurement() -> tuple[Measurement, str]:
    """Return a measurement of the default preset, and its description for the report.

    It comes from data/synthetic, or is noise if this package runs outside of the repository.
    """
    if not _RECORDING.exists():
        return noise(Settings.from_preset("default_25_50")), "white noise, seed 1"
    with open_recording(_RECORDING) as recording:
        return recording[0], "data/synthetic/reflectors.h5"


def real() -> tuple[Measurement, str] | None:
    """Return the measurement of a real room in the package rtisdev, and its description; None without the package.

    The package's code is not imported.
    """
    try:
        found = importlib.metadata.distribution(_DISTRIBUTION)
    except importlib.metadata.PackageNotFoundError:
        return None
    raw = Path(str(found.locate_file(f"{_DISTRIBUTION}/simulate.bin")))
    if not raw.exists():
        return None
    (only,) = open_raw(raw, Settings.from_preset("default_25_50"), sensor="eRTIS")
    return only, f"simulate.bin of {_DISTRIBUTION} {found.version}"


def noise(settings: Settings, *, n_words: int = 1) -> Measurement:
    """Return random words of the settings' size."""
    word_type = np.dtype(f"u{settings.array.word_bits // 8}")
    shape = (settings.recording.n_samples, n_words) if n_words > 1 else (settings.recording.n_samples,)
    random = np.random.default_rng(1)
    return Measurement(random.integers(0, np.iinfo(word_type).max, shape, dtype=word_type, endpoint=True), settings)
