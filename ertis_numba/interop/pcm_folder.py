"""Folders of WAV files, such as the card of a recorder."""

from pathlib import Path
from typing import Final

from ertis_numba.base.errors import DataError
from ertis_numba.base.file_kinds import kind_of
from ertis_numba.interop.pcm_files import first_stated_times, inspect, natural_order

__all__ = ["is_wav_folder", "left_out", "wav_files"]

_WAV: Final = {".wav", ".wave"}


def is_wav_folder(path: str | Path) -> bool:
    """Return True for a folder with WAV files, unless it contains .bin files of RTIS Dev."""
    try:
        suffixes = {each.suffix.lower() for each in Path(path).iterdir()} if Path(path).is_dir() else set()
    except OSError as error:
        raise DataError(f"{path}: {error.strerror}; choose a readable folder") from error
    return bool(suffixes & _WAV) and ".bin" not in suffixes


def wav_files(folder: Path, *, by_time: bool) -> list[Path]:
    """Return the WAV files by time, or by name with numbers; without hidden ones, which computers add to cards."""
    visible = [
        each
        for each in folder.iterdir()
        if not each.name.startswith(".") and each.suffix.lower() in _WAV and not each.is_dir()
    ]
    paths = sorted(visible, key=lambda path: natural_order(path.name))
    if not by_time:
        return paths
    stated_times = first_stated_times([inspect(path, 1.0) for path in paths])
    times_ns = [time.since_1970_ns for time in stated_times if time is not None]
    if len(times_ns) < len(paths):
        return paths
    return [paths[place] for place in sorted(range(len(paths)), key=times_ns.__getitem__)]


def left_out(folder: Path) -> list[str]:
    """Return the note on recordings in a folder that `wav_files` leaves out: other formats, and inner folders."""
    names = []
    for each in sorted(folder.iterdir(), key=lambda path: natural_order(path.name)):
        if each.name.startswith(".") or each.suffix.lower() in _WAV:
            continue
        if each.is_dir() and is_wav_folder(each):
            names.append(f"{each.name}/")
        elif each.is_file() and (kind := kind_of(each)) and kind.is_sound:
            names.append(each.name)
    if not names:
        return []
    listed = ", ".join(names[:4]) + ", …" * (len(names) > 4)
    return [f"{folder.name} also contains recordings that were not imported: {listed}; import them separately"]
