"""Error of plane wavefronts relative to spherical ones, and the choice between both."""

from ertis_numba.chain.beam_grid import Aperture
from ertis_numba.chain.error_model import ErrorModel, decibels
from ertis_numba.geometry import direction_grid, microphones, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.settings import Settings
from ertis_numba.settings.beamformers import BEAMFORMERS

__all__ = ["plane_wave_error_db", "with_wavefront"]


def plane_wave_error_db(model: ErrorModel, settings: Settings, range_m: float) -> float:
    """Return the image error of plane wavefronts at one range, in decibels relative to spherical wavefronts."""
    grid = direction_grid(settings.processing)
    positions_m = microphones(settings.array).enabled_positions_m
    aperture = Aperture.of(positions_m, unit_vectors(grid.azimuth_rad, grid.elevation_rad))
    return decibels(model.plane_waves(aperture, range_m, sound_speed_m_s=sound_speed_m_s(settings.air)))


def with_wavefront(settings: Settings, model: ErrorModel) -> Settings:
    """Return settings with spherical wavefronts if plane ones exceed the error budget at the nearest range."""
    processing = settings.processing
    beamformer = BEAMFORMERS[processing.beamformer]
    spherical = (
        processing.method == "fast"
        and not processing.delay_matrix
        and bool(beamformer.streams(*beamformer.values(processing)))
        and plane_wave_error_db(model, settings, processing.range_m[0]) > settings.accuracy.max_error_db
    )
    return settings.replace(processing=processing.replace(wavefront="spherical" if spherical else "plane"))
