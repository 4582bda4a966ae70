"""Multichannel PCM recordings of microphone arrays: WAV files, and HDF5 files of Acoular."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.geometry import microphones
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.interop.pcm_cuts import cut_at_emissions, cut_regularly
from ertis_numba.interop.pcm_files import PcmFile, inspect, joined, per_file, require_alike
from ertis_numba.interop.pcm_folder import is_wav_folder, left_out, wav_files
from ertis_numba.interop.pcm_reader import PcmReader
from ertis_numba.interop.recorder_times import file_times
from ertis_numba.settings import Processing, Recording, Settings, fit_ranges, record_range_m

__all__ = ["open_pcm"]

_MAX_EXPANSION: Final = 1000.0


def open_pcm(
    paths: Sequence[str | Path] | str | Path,
    settings: Settings | None = None,
    *,
    sensor: str = "sensor",
    skip_s: float = 0.0,
    length_s: float | None = None,
    start_ns: int | Sequence[int] = (),
    passive: bool = False,
    join: bool = False,
    time_expansion: float | None = None,
    sync_channel: int | None = None,
    whole_range: bool | None = None,
    air: Mapping[str, float] | None = None,
) -> PcmReader:
    """Open files of multichannel PCM: WAV, or Acoular's HDF5 (``time_data`` and its ``sample_freq``).

    PCM needs no demodulation, so the chain begins after it.

    Parameters
    ----------
    paths : path or sequence of paths
        Files with the same sample rate and number of channels, in the order of their times, or a folder of WAV files.
        Channel m is row m of the layout.
    settings : Settings, optional
        Array, call, air, processing and accuracy. Files that `export` wrote contain them. The files determine
        ``recording``. If ``processing.range_decimation`` leaves fewer than 1.8 ranges per second and hertz of the
        call's bandwidth, as the default may, a suitable value replaces it.
    sensor : str
        Name of the sensor.
    skip_s : float
        Start of the first emission in each file, in seconds.
    length_s : float, optional
        Interval between emissions in seconds, for files with several measurements. By default, each file contains one
        measurement, with the length of the shortest file.
    start_ns : int or sequence of int
        Time of the first emission of the first file or of each file, in nanoseconds since 1970-01-01 UTC. Without it,
        times are those in the metadata of recorders (GUANO, Wildlife Acoustics, AudioMoth, Broadcast Wave), otherwise
        those in the names of the files. With one, the times between files are. Files of unknown times follow each other
        without pauses, from time 0 on by default. `PcmReader.notes` states the source.
    passive : bool
        True if no call was emitted. ``processing.mode`` then becomes ``passive``. The call of the settings has no
        meaning, and the sample rate may be too low for it.
    join : bool
        True if each file contains one microphone or some; the channels of the files follow each other.
    time_expansion : float, optional
        Factor by which files play slower than the sound was recorded; by default that in the metadata, otherwise 1.
        The sample rate is that of the header times the factor, and all times count in the recorded sound.
    sync_channel : int, optional
        Channel of the files with the emitted call or the pulses of its trigger, counted from 0. Each measurement then
        begins at the sample nearest to its emission, and the channel is left out of the data. Without ``length_s``,
        a measurement lasts until the next emission.
    whole_range : bool, optional
        True if ``processing.range_m`` becomes what the record contains: ranges whose whole echo begins after the call
        and ends within the record. By default, this replaces only the default ``processing.range_m``.
    air : mapping of str to float, optional
        Values that replace those of the settings, such as ``{"temperature_c": 3.0}``.

    Returns
    -------
    PcmReader
        Iterable of measurements with a length. Its ``notes`` state what was assumed or left out, and after iteration
        also doubtful levels, such as clipping, zeros, or numbers of another scale.

    Raises
    ------
    DataError
        A file is missing, has another format, is shorter than a measurement, or differs from the first in sample rate,
        encoding or channels. The number of channels differs from that of the array, or the sample rate is too low for
        the call that was emitted. Files are not in the order of their times, or only some of them state one. The
        metadata contradict the sample rate.
    ArgumentError
        No file is given, a file is listed twice, a value is invalid, or neither the argument nor the file contains
        settings.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     files = ertis.export("signals.h5", [recording[0]], file_format="acoular", overwrite=True)
    >>> len(ertis.open_pcm("signals.h5"))
    1
    """
    several = [Path(path) for path in ([paths] if isinstance(paths, str | Path) else paths)]
    others: list[str] = []
    if len(several) == 1 and is_wav_folder(several[0]):
        others = left_out(several[0])
        several = wav_files(several[0], by_time=not join)
    if not several:
        raise ArgumentError("the list of PCM files is empty; pass at least one file")
    _require_different(several)
    if time_expansion is not None:
        checks.between("time_expansion", time_expansion, 1 / _MAX_EXPANSION, _MAX_EXPANSION)
    files = [inspect(path, time_expansion) for path in several]
    known = _require_settings(settings, files[0])
    known = known.replace(air=known.air.replace(**(air or {})))
    if join:
        files = [joined(files)]
    require_alike(files)
    _require_channels(files, known, sync_channel)
    if sync_channel is None:
        cuts = cut_regularly(files, skip_s=skip_s, length_s=length_s)
    else:
        _require_emissions(skip_s, passive=passive)
        speed_m_s = sound_speed_m_s(known.air)
        cuts = cut_at_emissions(files, known.call, channel=sync_channel, length_s=length_s, sound_speed_m_s=speed_m_s)
    if passive:
        known = known.replace("processing.mode", "passive")
    recording = Recording(sample_rate_hz=files[0].rate_hz, n_samples=cuts.n_samples, encoding=files[0].encoding)
    fitted, ranges = _fitted(known, recording, files[0], whole_range=whole_range)
    starts_ns = [start_ns] if isinstance(start_ns, int) else list(start_ns)
    firsts_ns, times = file_times(
        files,
        [checks.integer("start_ns", each, 0, 2**63 - 1) for each in starts_ns],
        first_s=[float(times_s[0]) for times_s in cuts.times_s],
    )
    of_files = per_file([(file.path, note) for file in files for note in file.notes])
    return PcmReader(
        files,
        cuts,
        fitted,
        sensor=sensor,
        behaviour="passive" if passive else "unknown",
        firsts_ns=firsts_ns,
        without=sync_channel,
        notes=[*others, *times, *of_files, *([] if fitted.processing.mode == "passive" else cuts.notes), *ranges],
    )


def _require_different(paths: Sequence[Path]) -> None:
    resolved = [path.resolve() for path in paths]
    for number, path in enumerate(resolved):
        if path in resolved[:number]:
            raise ArgumentError(f"{paths[number]} is listed twice; list each file once")


def _require_emissions(skip_s: float, *, passive: bool) -> None:
    """Refuse options that contradict a loopback channel."""
    for name, is_used in (("skip_s", skip_s), ("passive=True", passive)):
        if is_used:
            raise ArgumentError(f"{name} and sync_channel cannot be combined; remove one of them")


def _require_settings(settings: Settings | None, first: PcmFile) -> Settings:
    known = settings or first.settings
    if known is None:
        raise ArgumentError(f"{first.path} contains no array; add it (settings), and the call, if one was emitted")
    return known


def _require_channels(files: Sequence[PcmFile], settings: Settings, sync_channel: int | None) -> None:
    first, layout = files[0], microphones(settings.array)
    wanted = len(layout.enabled)
    if sync_channel is not None:
        checks.integer("sync_channel", sync_channel, 0, first.n_channels - 1)
        if first.n_channels != wanted + 1:
            raise DataError(
                f"{first.path} has {first.n_channels} channels, but array {layout.name!r} and sync_channel need "
                f"{wanted} + 1; use a layout (layout) with one row for each channel except that of sync_channel"
            )
        return
    if first.n_channels == wanted:
        return
    if first.n_samples == wanted:
        raise DataError(f"{first.path} has {first.n_channels} channels of {wanted} samples; transpose it")
    text = f"{first.path} has {first.n_channels} channels, but array {layout.name!r} has {wanted}"
    if len(files) > 1 and sum(file.n_channels for file in files) == wanted:
        raise DataError(
            f"{text}, the total of all {len(files)} files; use join=True if the files are the microphones of "
            "one measurement"
        )
    if settings.array.positions_m is not None:
        raise DataError(f"{text}; write one row for each of {first.n_channels} channels in array.positions_m")
    raise DataError(f"{text}; use a layout with one row for each channel (layout)")


def _fitted(
    settings: Settings, recording: Recording, first: PcmFile, *, whole_range: bool | None
) -> tuple[Settings, list[str]]:
    """Return settings for another recording, with matching ranges, and notes about them."""
    call = settings.call
    if settings.processing.mode == "passive":
        return settings.replace(recording=recording), []
    if recording.sample_rate_hz <= 2 * call.high_frequency_hz:
        raise DataError(
            f"{first.path} has a sample rate of {recording.sample_rate_hz:g} Hz, too low for a call up to "
            f"{call.high_frequency_hz:g} Hz; set the emitted call as [call], record at a higher rate, use "
            "time_expansion if the file plays slower than the sound, or passive=True "
            "if no call was emitted"
        )
    if recording.duration_s <= call.end_s:
        raise DataError(
            f"a measurement of {first.path} has {1e3 * recording.duration_s:.4g} ms, but the call alone lasts "
            f"{1e3 * call.end_s:.4g} ms; use a longer length_s, or a shorter skip_s"
        )
    held_m = record_range_m(recording, call, sound_speed_m_s(settings.air))
    stated_m = settings.processing.range_m
    is_whole = stated_m == Processing().range_m if whole_range is None else whole_range
    processing = fit_ranges(settings.processing, recording, call)
    processing = processing.replace(range_m=held_m if is_whole else stated_m)
    holds = f"{held_m[0]:g}–{held_m[1]:g} m"
    if is_whole:
        note = f"range {holds}, the full window of the record"
    else:
        note = f"range {stated_m[0]:g}–{stated_m[1]:g} m, as in the settings; the record contains {holds}"
    return settings.replace(recording=recording, processing=processing), [note]
