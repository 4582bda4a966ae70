"""Beams: the sums of the delayed microphone signals, before their envelope."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.angles import DegreesFromRadians
from ertis_numba.frames._energyscape import Energyscape
from ertis_numba.frames._stamp import Stamp
from ertis_numba.settings import Settings

__all__ = ["Beams"]


@dataclass(frozen=True, slots=True, eq=False)
class Beams(DegreesFromRadians):
    """Analytic beam of each direction at each range; its magnitude is the amplitude of the image.

    The properties ``azimuth_deg`` and ``elevation_deg`` are the angles in degrees.

    Attributes
    ----------
    beam : (direction, range) complex64
        Analytic signals with the phase of the echoes, sampled once per range. The real part is the beam as a sound
        signal. Unless ``range_decimation`` is small, its carrier is above half of the sample rate.
    azimuth_rad, elevation_rad : (direction,) float64
        Directions in the sensor frame.
    range_m : (range,) float64
        Half of the sound's path, at the speed of sound in the air of the settings.
    settings : Settings
        Settings of the beams, with their complete plan.
    stamp : Stamp
        Origin of the measurement.

    Raises
    ------
    ArgumentError
        The shapes do not agree.

    Examples
    --------
    >>> import numpy as np
    >>> import ertis_numba as ertis
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     pipeline = ertis.Pipeline(recording.settings)
    ...     beams, image = pipeline.beams(recording[0]), pipeline.process(recording[0])
    >>> bool(np.allclose(beams.envelope().amplitude, image.amplitude, atol=0.02 * image.amplitude.max()))
    True
    """

    beam: NDArray[np.complex64]
    azimuth_rad: NDArray[np.float64]
    elevation_rad: NDArray[np.float64]
    range_m: NDArray[np.float64]
    settings: Settings
    stamp: Stamp = Stamp()

    def __post_init__(self) -> None:
        checks.shape("elevation_rad", self.elevation_rad.shape, self.azimuth_rad.shape)
        checks.shape("beam", self.beam.shape, (*self.azimuth_rad.shape, *self.range_m.shape))

    def envelope(self) -> Energyscape:
        """Return the image of the beams, which is their magnitude."""
        axes = self.azimuth_rad, self.elevation_rad, self.range_m
        return Energyscape(np.abs(self.beam), *axes, self.settings, self.stamp)
