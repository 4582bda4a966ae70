"""Export of the sound of one direction, for ``ertis export --listen``."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from ertis_cli import options

if TYPE_CHECKING:
    from ertis_numba.passive import BeamSound
    from ertis_numba.storage import RecordingReader

__all__ = ["SoundOptions", "export_sound", "require_possible", "sound_options"]

_MAX_SILENCE_S = 600.0
_PEAK = 10 ** (-1 / 20)  # of the file


class SoundOptions(NamedTuple):
    """Options of format wav; ``direction`` is (azimuth, elevation) in degrees."""

    direction: tuple[float, float] | None
    heterodyne_hz: float | None
    expansion: float | None
    with_silence: bool


def sound_options(command: Any) -> Any:
    """Add the options of format wav."""
    for option in (
        click.option(
            "--silence",
            "with_silence",
            is_flag=True,
            help="Fill the time between two measurements with silence; by default, measurements follow each other "
            "without a gap.",
        ),
        click.option(
            "--expand",
            "expansion",
            type=click.FloatRange(1, 1000),
            metavar="N",
            help="Play the sound N times slower, so that its frequencies are N times lower.",
        ),
        click.option(
            "--heterodyne",
            "heterodyne_hz",
            type=click.FloatRange(min=0),
            metavar="HZ",
            help="Shift the sound down by this frequency, and write it with a sample rate of 48 kHz.",
        ),
        click.option(
            "--listen",
            "direction",
            type=options.DIRECTION,
            metavar="AZ,EL",
            help="Direction in ° whose sound is written to a .wav file.",
        ),
    ):
        command = option(command)
    return command


def require_possible(sound: SoundOptions) -> None:
    """Refuse impossible combinations of options."""
    context = click.get_current_context()
    if sound.direction is None:
        raise click.UsageError(
            "a .wav file contains the sound of one direction; choose it with --listen AZ,EL", context
        )
    if sound.heterodyne_hz is not None and sound.expansion is not None:
        raise click.UsageError("--heterodyne and --expand both lower the sound; choose one of them", context)


def export_sound(
    reader: "RecordingReader",
    places: range,
    target: Path,
    sound: SoundOptions,
    *,
    force: bool,
    quiet: bool,
    as_json: bool,
) -> None:
    """Write the sound of one direction in some measurements as WAV, amplified to a peak of -1 dBFS."""
    import numpy as np

    from ertis_numba.base import checks
    from ertis_numba.base.atomic_files import atomic_write, check_target
    from ertis_numba.base.wav import wav_bytes
    from ertis_numba.passive import heterodyned, time_expanded

    check_target(target, overwrite=force, sources=[reader.path])
    heard = _joined(reader, places, sound)
    if sound.heterodyne_hz is not None:
        checks.between("--heterodyne", sound.heterodyne_hz, 0.0, heard.rate_hz / 2)
        heard = heterodyned(heard, sound.heterodyne_hz)
    if sound.expansion is not None:
        heard = time_expanded(heard, sound.expansion)
    peak = float(np.abs(heard.samples).max(initial=0.0))
    gain = _PEAK / peak if peak else 1.0
    with atomic_write(target, overwrite=force) as temporary:
        temporary.write_bytes(wav_bytes(heard.rate_hz, heard.samples * np.float32(gain)))
    gain_db = float(20 * np.log10(gain))
    measurements = options.counted(len(places), "measurement")
    between = "with silence between them" if sound.with_silence else "without the time between them"
    options.say(
        f"{target}: {heard.duration_s:.2f} s of sound from {measurements}, {between}, amplified by {gain_db:.1f} dB",
        quiet=quiet,
    )
    if as_json:
        options.print_json(
            {
                "output": str(target),
                "format": "wav",
                "files": [str(target)],
                "sensors": [reader.sensor],
                "measurements": len(places),
                "duration_s": heard.duration_s,
                "rate_hz": heard.rate_hz,
                "gain_db": gain_db,
            }
        )


def _joined(reader: "RecordingReader", places: range, sound: SoundOptions) -> "BeamSound":
    """Return the sounds of measurements, one after the other."""
    import numpy as np

    from ertis_numba.base.errors import DataError
    from ertis_numba.passive import BeamSound, HeardSignals, listen_to

    parts: list[np.ndarray[Any, np.dtype[np.float32]]] = []
    start_ns: int | None = None
    n_samples = 0
    azimuth_deg, elevation_deg = sound.direction or (0.0, 0.0)
    with HeardSignals(reader.settings) as signals:
        for place in places:
            measurement = reader[place]
            start_ns = measurement.stamp.timestamp_ns if start_ns is None else start_ns
            time_s = (measurement.stamp.timestamp_ns - start_ns) * 1e-9
            late = round(time_s * signals.rate_hz) - n_samples if sound.with_silence else 0
            if late > _MAX_SILENCE_S * signals.rate_hz:
                raise DataError(
                    f"measurement {place} begins {late / signals.rate_hz:.0f} s after the end of the one before it; "
                    "leave out --silence, or choose other measurements (--measurement)"
                )
            heard = listen_to(measurement, azimuth_deg, elevation_deg, signals=signals).samples
            parts += [np.zeros(max(0, late), np.float32), heard]
            n_samples += len(parts[-2]) + len(heard)
        return BeamSound(np.concatenate(parts), signals.rate_hz)
