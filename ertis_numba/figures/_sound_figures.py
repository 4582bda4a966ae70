"""Figures of sound and of signals."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from matplotlib.figure import Figure
from matplotlib.image import imread
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.figures import (
    _acoustic,
    _acoustic_signals,
    _signals,
)
from ertis_numba.figures._canvas import canvas_of
from ertis_numba.figures.style import StyleOptions
from ertis_numba.frames import AcousticMap, Measurement

__all__ = ["acoustic_map", "matched_filter", "signals", "spectrogram", "spectrum"]


def signals(
    measurement: Measurement,
    *,
    microphone: int | None = None,
    dynamic_range_db: float = 40.0,
    **look: Unpack[StyleOptions],
) -> Figure:
    """Draw the signals of the microphones over time, and their spectrogram.

    The signals are low-pass filtered and decimated. The spectrogram is the mean over the microphones.

    Parameters
    ----------
    measurement : Measurement
    microphone : int, optional
        Channel of the only microphone to draw; all by default.
    dynamic_range_db, **look
        Range of the colours in dB and the style, as for `plot`.

    Raises
    ------
    ArgumentError
        An argument is invalid, or there is no such microphone.
    """
    checks.instance("measurement", measurement, Measurement, "a recording contains")
    return _signals.draw(canvas_of(dynamic_range_db, look), measurement, microphone=microphone)


def matched_filter(
    measurement: Measurement,
    *,
    microphone: int | None = None,
    dynamic_range_db: float = 40.0,
    **look: Unpack[StyleOptions],
) -> Figure:
    """Draw the matched-filter output of each microphone over range.

    Arguments are those of `signals`.
    """
    checks.instance("measurement", measurement, Measurement, "a recording contains")
    return _signals.draw_echoes(canvas_of(dynamic_range_db, look), measurement, microphone=microphone)


def acoustic_map(
    found: AcousticMap,
    *,
    band_hz: tuple[float, float] | None = None,
    photo: str | Path | None = None,
    photo_fov_deg: tuple[float, float] | None = None,
    dynamic_range_db: float = 20.0,
    **look: Unpack[StyleOptions],
) -> Figure:
    """Draw an acoustic map over azimuth and elevation, or as a line over azimuth if it has one elevation.

    Levels are in dBFS, or in dB re 20 µPa if the sensitivity of the microphones is known. Those of the method ``music``
    are relative to the strongest.

    Parameters
    ----------
    found : AcousticMap
    band_hz : (low, high), optional
        Limits of the centres of the bands to add, in hertz; all bands by default.
    photo : str or Path, optional
        Picture over which the map is drawn, half-transparent. The camera is at the sensor and looks along x.
    photo_fov_deg : (azimuth, elevation), optional
        Horizontal and vertical field of view of the picture in degrees, 1 to 170; needed with ``photo``.
    dynamic_range_db : float, default 20
        Range of the colours in decibels.
    **look
        Style of the figure, as for `plot`.

    Raises
    ------
    ArgumentError
        An argument is invalid, no band lies within the limits, or a map of one elevation is to be drawn on a photo.
    DataError
        The picture cannot be read.
    """
    checks.instance("found", found, AcousticMap, "AcousticCamera.process returns")
    canvas = canvas_of(dynamic_range_db, look)
    if band_hz is not None:
        checks.interval("band_hz", band_hz, 0.0, 1e9)
    if (photo is None) != (photo_fov_deg is None):
        raise ArgumentError("photo and photo_fov_deg belong together; use both or neither")
    if photo is None or photo_fov_deg is None:
        return _acoustic.draw(canvas, found, band_hz=band_hz)
    if isinstance(photo_fov_deg, str) or not isinstance(photo_fov_deg, Sequence) or len(photo_fov_deg) != 2:
        raise ArgumentError(f"photo_fov_deg is {photo_fov_deg!r:.80}; pass the angles of width and height in °")
    for number, each_deg in enumerate(photo_fov_deg):
        checks.between(f"photo_fov_deg[{number}]", each_deg, 1.0, 170.0)
    return _acoustic.draw_on_photo(canvas, found, band_hz=band_hz, photo=_picture(photo), fov_deg=photo_fov_deg)


def _picture(path: str | Path) -> NDArray[Any]:
    try:
        return np.asarray(imread(path))
    except (OSError, ValueError, SyntaxError) as error:  # Errors of the readers of pictures.
        if isinstance(error, OSError) and error.strerror:
            raise DataError(f"photo {path}: {error.strerror}; choose a .png or .jpg") from error
        raise DataError(
            f"photo {path} is not a readable picture; open it in another program, and save it as .png or .jpg"
        ) from error


def spectrum(
    source: AcousticMap | Measurement,
    *,
    direction_deg: tuple[float, float] | None = None,
    dynamic_range_db: float = 40.0,
    **look: Unpack[StyleOptions],
) -> Figure:
    """Draw the level over frequency: of each band of an acoustic map, or of each bin of a measurement.

    Levels are those of `acoustic_map`.

    Parameters
    ----------
    source : AcousticMap or Measurement
    direction_deg : (azimuth, elevation), optional
        Direction in degrees. By default the loudest direction of a map, or the mean of the microphones.
    dynamic_range_db, **look
        Range of the colours in dB and the style, as for `plot`.
    """
    canvas = canvas_of(dynamic_range_db, look)
    if isinstance(source, AcousticMap):
        return _acoustic.draw_bands(canvas, source, direction_deg=direction_deg)
    checks.instance("source", source, Measurement, "a recording contains, or an AcousticMap")
    return _acoustic_signals.draw_spectrum(canvas, source, direction_deg=direction_deg)


def spectrogram(
    measurement: Measurement,
    *,
    direction_deg: tuple[float, float] | None = None,
    dynamic_range_db: float = 40.0,
    **look: Unpack[StyleOptions],
) -> Figure:
    """Draw the level over time and frequency, of the mean of the microphones or of a delay-and-sum beam.

    Levels are those of `acoustic_map`, in bins of about 1 kHz.

    Parameters
    ----------
    measurement : Measurement
    direction_deg : (azimuth, elevation), optional
        Direction of the beam in degrees.
    dynamic_range_db, **look
        Range of the colours in dB and the style, as for `plot`.
    """
    checks.instance("measurement", measurement, Measurement, "a recording contains")
    return _acoustic_signals.draw_spectrogram(
        canvas_of(dynamic_range_db, look), measurement, direction_deg=direction_deg
    )
