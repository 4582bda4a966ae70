"""Bearings of sources: maxima of acoustic maps that noise does not explain, refined by maximum likelihood."""

import functools
import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.constants import FALSE_ALARM
from ertis_numba.chain.interpolation_fit import one_thread
from ertis_numba.frames import Bearing, known_levels
from ertis_numba.geometry import direction_grid, direction_note, microphones, spacing_rad, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.passive.bands import bin_shares
from ertis_numba.passive.camera import AcousticCamera
from ertis_numba.passive.noise_model import NoiseModel
from ertis_numba.passive.scan_extent import ScanMesh, is_level
from ertis_numba.passive.search_grid import search_changes, search_warning
from ertis_numba.passive.source_search import BandSearch, FoundSource, Scan
from ertis_numba.passive.wave_delays import WaveDelays
from ertis_numba.settings import Settings

__all__ = ["BearingFinder", "find_bearings"]

_REACH: Final = 1.5  # Largest distance from a direction of the grid to a maximum, in spacings of the grid.
_MAX_SPACING_RAD: Final = 0.5
_LEAST: Final = 1e-30
_DEAD: Final = 1e-4  # Power relative to the median of the channels, below which a channel hears nothing.


class BearingFinder:
    """Finder of the bearings of sources in the sound that an acoustic camera has heard.

    In each band, directions of the largest likelihood are found one by one, until noise alone explains the loudest one:
    see `exceedance`. Side lobes of a source therefore yield no bearings. docs/explanation/acoustic-maps.md has the
    steps. Electrical crosstalk that is equal in all channels looks like sound straight ahead of a flat array: see
    `Bearing.may_be_crosstalk`. Without passive.focus_m, waves are plane, and the uncertainty contains the error of this
    for sources from 1 m on; nearer ones need it. If a channel hears nothing, 40 dB below the median of all,
    uncertainties are infinite: put it in array.disabled.

    Parameters
    ----------
    camera : AcousticCamera
        Camera whose measurements are searched, in its bands. If its directions are coarser than the beam, or do not
        contain all directions that the array can tell apart, those of `search_changes` are searched instead. The method
        of its maps has no influence.
    false_alarm : float
        Probability that noise alone yields any bearing, 1e-9 to 0.5; 0.001 by default. At twelve microphones or fewer,
        tones with random phases, as of electronics, may also yield bearings, which are then marked: see
        `Bearing.may_be_interference`.
    top : int
        Largest number of bearings in a band; 8 by default.
    min_level_db : float
        Least level relative to the loudest source of the band; -20 by default, because errors of the array leave
        remainders of sources.

    Attributes
    ----------
    warning : str or None
        Warning that bearings may be wrong, because no grid or no length of blocks suffices for the array, or because
        it cannot tell directions apart; None without these.
    direction_note : str or None
        Note on sound that bearings cannot locate, such as sound from behind a flat array, as a predicate of the sensor:
        `ertis_numba.geometry.direction_note`.

    Raises
    ------
    ArgumentError
        An argument is outside its limits.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     camera = ertis.AcousticCamera(recording.settings)
    ...     camera.add(recording[0])
    >>> finder = ertis.BearingFinder(camera, false_alarm=1e-4)
    >>> all(bearing.snr_db > -40 for bearing in finder.find())
    True
    """

    def __init__(
        self, camera: AcousticCamera, *, false_alarm: float = FALSE_ALARM, top: int = 8, min_level_db: float = -20.0
    ) -> None:
        checks.instance("camera", camera, AcousticCamera, "AcousticCamera(settings) makes")
        checks.between("false_alarm", false_alarm, 1e-9, 0.5)
        self._camera, self._top = camera, checks.integer("top", top, 1)
        self._least = 10 ** (checks.between("min_level_db", min_level_db, -200.0, 0.0) / 10)
        self._false_alarm = 1 - (1 - false_alarm) ** (1 / len(camera.band_hz))
        settings = camera.settings.replace(**search_changes(camera.settings))
        self.warning, grid = search_warning(settings), direction_grid(settings.processing)
        self.direction_note = direction_note(settings.array, grid, is_passive=True)
        directions = unit_vectors(grid.azimuth_rad, grid.elevation_rad)
        reach_rad = _REACH * min(spacing_rad(directions), _MAX_SPACING_RAD)
        delays = WaveDelays(settings)
        waves = camera.waves if settings is camera.settings else camera.waves_of(directions)
        scan = Scan(directions, ScanMesh(directions, delays(directions)), reach_rad, is_level(directions))
        self._bins: list[NDArray[np.intp]] = []
        self._searches: list[BandSearch] = []
        for shares in bin_shares(camera.band_hz, camera.frequency_hz).astype(np.float64):
            bins = np.flatnonzero(shares)
            frequency_hz, steer = camera.frequency_hz[bins], functools.partial(waves.steer, bins=bins)
            with one_thread():
                noise = NoiseModel(
                    microphones(settings.array).enabled_positions_m,
                    frequency_hz,
                    spacing_hz=float(camera.frequency_hz[1] - camera.frequency_hz[0]),
                    sound_speed_m_s=sound_speed_m_s(settings.air),
                )
            self._bins.append(bins)
            self._searches.append(BandSearch(scan, frequency_hz, shares[bins], noise, delays, steer))

    def find(self) -> list[Bearing]:
        """Return the bearings of the measurements since the camera's last `reset`, band by band, loudest first.

        Raises
        ------
        DataError
            The camera has no measurement.
        """
        spectrum = self._camera.cross_spectrum()
        out = []
        for bins, search, band_hz in zip(self._bins, self._searches, self._camera.band_hz, strict=True):
            with one_thread():
                sources = search(
                    spectrum.of_bins(bins), false_alarm=self._false_alarm, top=self._top, least=self._least
                )
            heard = np.einsum("bmm->m", spectrum.matrix[bins].real)
            if heard.min() < _DEAD * np.median(heard):
                unknown = np.diag([math.inf, math.inf])
                sources = [source._replace(covariance_rad2=unknown) for source in sources]
            sources.sort(key=lambda source: -source.power)
            out += [_bearing(source, band_hz, self._camera.settings) for source in sources]
        return out


def find_bearings(
    camera: AcousticCamera, *, false_alarm: float = FALSE_ALARM, top: int = 8, min_level_db: float = -20.0
) -> list[Bearing]:
    """Return the bearings of sources in the sound that an acoustic camera has heard, band by band, loudest first.

    Parameters
    ----------
    camera : AcousticCamera
    false_alarm, top, min_level_db
        As for `BearingFinder`, which is faster for many maps.

    Raises
    ------
    ArgumentError
        An argument is outside its limits.
    DataError
        The camera has no measurement.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     camera = ertis.AcousticCamera(recording.settings)
    ...     camera.add(recording[0])
    >>> len(ertis.find_bearings(camera, top=1)) <= len(camera.band_hz)
    True
    """
    return BearingFinder(camera, false_alarm=false_alarm, top=top, min_level_db=min_level_db).find()


def _bearing(source: FoundSource, band_hz: NDArray[np.float64], settings: Settings) -> Bearing:
    x, y, z = source.direction
    sideways, upwards = np.sqrt(np.diag(source.covariance_rad2))
    is_known = 0 < sideways < math.inf and 0 < upwards < math.inf
    correlation = source.covariance_rad2[0, 1] / (sideways * upwards) if is_known else 0.0
    level_dbfs = 10 * math.log10(max(source.power, _LEAST))
    levels = known_levels(settings, math.sqrt(band_hz.prod()), level_dbfs)
    return Bearing(
        azimuth_deg=math.degrees(math.atan2(y, x)),
        elevation_deg=math.degrees(math.asin(max(-1.0, min(1.0, z)))),
        sideways_deg=math.degrees(sideways),
        upwards_deg=math.degrees(upwards),
        correlation=float(correlation),
        band_hz=(float(band_hz[0]), float(band_hz[1])),
        level_dbfs=level_dbfs,
        snr_db=10 * math.log10(max(source.ratio, _LEAST)),
        may_be_crosstalk=source.may_be_crosstalk,
        may_be_interference=source.may_be_interference,
        **{name: levels[name] for name in ("level_db", "source_level_db")},
    )
