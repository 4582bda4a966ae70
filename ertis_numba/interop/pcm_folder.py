"""Folders of WAV files, such as the card of a recorder."""

from pathlib import Path
from typing import Final

from ertis_numba.errors import DataError
from ertis_numba.interop.pcm_files import first_stated_times, inspect, natural_order

__all__ = ["is_wav_folder", "wav_files"]

_WAV: Final = {".wav", ".wave"}


def is_wav_folder(path: str | Path) -> bool:
    """Return True for a folder with WAV files, unless it contains .bin files of RTIS Dev.

    Examples
    --------
    >>> from ertis_numba.interop import is_wav_folder
    >>> is_wav_folder(".")
    False
    """
    try:
        suffixes = {each.suffix.lower() for each in Path(path).iterdir()} if Path(path).is_dir() else set()
    except OSError as error:
        raise DataError(f"{path}: {error.strerror}; give a folder that can be read") from error
    return bool(suffixes & _WAV) and ".bin" not in suffixes


def wav_files(folder: Path, *, by_time: bool) -> list[Path]:
    """Return the WAV files of a folder in the order of their times, otherwise of their names, in which numbers count.

    Hidden files, which computers add to cards, are left out.

    Raises
    ------
    DataError
        A file cannot be read.
    """
    visible = [each for each in folder.iterdir() if not each.name.startswith(".") and each.suffix.lower() in _WAV]
    paths = sorted(visible, key=lambda path: natural_order(path.name))
    if not by_time:
        return paths
    stated_times = first_stated_times([inspect(path, 1.0) for path in paths])
    times_ns = [time.since_1970_ns for time in stated_times if time is not None]
    if len(times_ns) < len(paths):
        return paths
    return [paths[place] for place in sorted(range(len(paths)), key=times_ns.__getitem__)]
