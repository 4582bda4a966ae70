"""Acoular's beamformers in the frequency domain, for the same signals and points.

Acoular has no plane waves in these classes, so both focus on points at a finite distance. Its Hann window is symmetric;
an entry in its table of windows adds the periodic window of this package.
"""

import functools
from typing import Any, Final

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError
from ertis_numba.geometry import direction_grid, microphones, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.settings import Settings

__all__ = ["PACKAGE", "AcousticMapper"]

PACKAGE: Final = "acoular"

_CLASSES: Final = {
    "delay_and_sum": "BeamformerBase",
    "functional": "BeamformerFunctional",
    "capon": "BeamformerCapon",
    "music": "BeamformerMusic",
    "clean_sc": "BeamformerCleansc",
}


class AcousticMapper:
    """Powers from each direction by Acoular."""

    def __init__(self, settings: Settings, n_block: int) -> None:
        import acoular  # noqa: PLC0415 - an optional dependency
        from traits.api import Map  # noqa: PLC0415 - a dependency of Acoular

        acoular.config.global_caching = "none"

        class PeriodicSpectra(acoular.PowerSpectra):  # type: ignore[misc]
            """Spectra under a periodic Hann window."""

            window = Map({"Hann": functools.partial(scipy.signal.get_window, "hann")}, default_value="Hann")

        layout, grid = microphones(settings.array), direction_grid(settings.processing)
        if settings.passive.focus_m is None:
            raise ArgumentError("passive.focus_m is None, but Acoular's points need a distance; set focus_m")
        places_m = settings.passive.focus_m * unit_vectors(grid.azimuth_rad, grid.elevation_rad)
        self._acoular, self._spectra, self._n_block = acoular, PeriodicSpectra, n_block
        self._settings = settings
        self._steer = acoular.SteeringVector(
            grid=acoular.ImportGrid(pos=np.ascontiguousarray(places_m.T)),
            mics=acoular.MicGeom(pos_total=np.ascontiguousarray(layout.enabled_positions_m.T)),
            env=acoular.Environment(c=sound_speed_m_s(settings.air)),
            steer_type="classic",
        )

    def powers(self, samples: NDArray[np.float32], bins: slice) -> NDArray[np.float64]:
        """Return the power from each direction: (bin, direction) float64; see `matrices` for ``samples``."""
        return np.asarray(self._beamformer(self._spectra_of(samples)).result[bins], np.float64)

    def bands(self, samples: NDArray[np.float32], centre_hz: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the power from each direction in third octaves, of whole bins: (band, direction) float64."""
        beamformer = self._beamformer(self._spectra_of(samples))
        return np.array([beamformer.synthetic(float(each_hz), 3) for each_hz in centre_hz])

    def matrices(self, samples: NDArray[np.float32]) -> NDArray[np.complex128]:
        """Return the cross-spectral matrices of samples, (sample, mic) float32: (bin, mic, mic) complex128."""
        return np.asarray(self._spectra_of(samples).csm)

    def equalised(self, matrix: NDArray[np.complex64], frequency_hz: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the powers of matrices whose eigenvalues of noise are 1: (bin, direction) float64.

        Acoular's MUSIC weights the eigenvectors of the noise by their eigenvalues, and that of R. Schmidt does not.
        """
        _, vectors = np.linalg.eigh(matrix.astype(np.complex128))
        values = np.ones(matrix.shape[1])
        values[-self._settings.passive.n_sources :] = 2.0
        equal = (vectors * values) @ vectors.conj().transpose(0, 2, 1)
        spectra = self._acoular.PowerSpectraImport(csm=equal, frequencies=frequency_hz)
        return np.asarray(self._beamformer(spectra).result[:], np.float64)

    def _spectra_of(self, samples: NDArray[np.float32]) -> Any:
        source = self._acoular.TimeSamples(data=samples, sample_freq=self._settings.recording.sample_rate_hz)
        return self._spectra(source=source, block_size=self._n_block, overlap="50%", cached=False)

    def _beamformer(self, spectra: Any) -> Any:
        make = getattr(self._acoular, _CLASSES[self._settings.passive.method])
        return make(freq_data=spectra, steer=self._steer, cached=False, **self._traits())

    def _traits(self) -> dict[str, Any]:
        passive = self._settings.passive
        if passive.method == "functional":
            return {"gamma": passive.functional_order}
        if passive.method == "music":
            return {"n": passive.n_sources}
        return {"r_diag": passive.diagonal_removal} if passive.method in ("delay_and_sum", "clean_sc") else {}
