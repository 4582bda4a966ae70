"""Processing of measurements, with the functions of the closed module ``rtiscuda``, on the kernels of this package."""

import logging
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ertis_numba import checks
from ertis_numba.errors import ArgumentError, ErtisError
from ertis_numba.rtisdev.fast import FastProcessor
from ertis_numba.rtisdev.processor import Configuration, Processor

__all__ = ["preload", "processing", "unloadall", "unloadone"]

_log = logging.getLogger("ertis_numba")
_processors: dict[str, Processor | FastProcessor] = {}
_turn = threading.Lock()


def preload(  # noqa: PLR0913, PLR0917  as the original has it
    pdm_filter: ArrayLike,
    pre_filter: ArrayLike,
    envelope_filter: ArrayLike,
    post_filter: ArrayLike,
    matched_filter_real: ArrayLike,
    matched_filter_imag: ArrayLike,
    delay_matrix: ArrayLike,
    n_microphones: int,
    n_directions: int,
    n_samples: int,
    pdm_subsample_factor: int,
    beamforming_drop: int,
    envelope_subsample_factor: int,
    first_range: int,
    last_range: int,
    mean_multiplier: float,
    max_multiplier: float,
    name: str,
    pdm_enable: int,  # noqa: ARG001  `processing` states it
    pre_filter_enable: int,
    matched_filter_enable: int,
    beamforming_enable: int,
    post_filter_enable: int,
    envelope_enable: int,
    clean_enable: int,
    disabled_microphones: ArrayLike,
    dmas_order: int,
    coherence_factor_enable: int,
) -> None:
    """Prepare a configuration for `processing`, and replace an earlier one of this name.

    All arguments are those that ``rtisdev`` passes, in its order. `processor.Configuration` describes them.

    Raises
    ------
    ArgumentError
        Shapes or values do not fit together.
    DeviceError
        The device of ERTIS_RTISDEV_DEVICE does not exist.
    """
    with _errors_logged():
        configuration = Configuration(
            pdm_filter=_taps(pdm_filter),
            pre_filter=_taps(pre_filter) if pre_filter_enable else None,
            envelope_filter=_taps(envelope_filter),
            post_filter=_taps(post_filter) if post_filter_enable else None,
            matched_filter=_complex(matched_filter_real, matched_filter_imag) if matched_filter_enable else None,
            delays=np.ascontiguousarray(np.asarray(delay_matrix).T, dtype=np.int32) if beamforming_enable else None,
            n_mics=int(n_microphones),
            n_directions=int(n_directions),
            n_samples=int(n_samples),
            pdm_factor=int(pdm_subsample_factor),
            beamforming_drop=int(beamforming_drop),
            envelope_factor=int(envelope_subsample_factor),
            first_range=int(first_range),
            last_range=int(last_range),
            clean_multipliers=(float(mean_multiplier), float(max_multiplier)) if clean_enable else None,
            has_envelope=bool(envelope_enable),
            disabled=tuple(int(mic) for mic in np.ravel(disabled_microphones) if mic < n_microphones),
            dmas_order=max(1, int(dmas_order)),  # 0 is an earlier kernel of delay-and-sum.
            coherent=bool(coherence_factor_enable),
        )
        processor = _processor(name, configuration)
    with _turn:
        _processors[name] = processor


def processing(data: NDArray[Any], pdm: int, dim1: int, dim2: int, name: str) -> NDArray[np.float32]:
    """Process a measurement.

    Parameters
    ----------
    data : ndarray
        With ``pdm``, the PDM words, (sample,) uint32. Otherwise the result of an earlier stage: signals, (mic, sample),
        or, for a configuration without beamforming, beams, (direction, sample).
    pdm : int
        Not 0 for PDM words.
    dim1, dim2 : int
        Shape of the result.
    name : str
        Configuration that was preloaded.

    Returns
    -------
    (dim1, dim2) float32

    Raises
    ------
    ArgumentError
        Nothing is preloaded under this name, or a shape does not match the configuration.
    """
    with _errors_logged():
        with _turn:
            processor, names = _processors.get(name), list(_processors)
        if processor is None:
            known = ", ".join(map(repr, names)) or "none"
            raise ArgumentError(f"configuration {name!r} is not preloaded; preload it first (preloaded are: {known})")
        result = processor.process(data, pdm=bool(pdm))
        if result.shape != (dim1, dim2):
            raise ArgumentError(
                f"configuration {name!r} gives {result.shape[0]} × {result.shape[1]} numbers, but {dim1} × {dim2} are "
                "wanted; preload settings that match"
            )
        return result


def unloadone(name: str) -> None:
    """Free a configuration; a name that was never preloaded is only reported."""
    with _turn:
        if _processors.pop(name, None) is None:
            _log.warning("configuration %r is not preloaded, so there is nothing to unload", name)


def unloadall() -> None:
    """Free all configurations."""
    with _turn:
        _processors.clear()


def _processor(name: str, configuration: Configuration) -> Processor | FastProcessor:
    """Return the processor that the environment asks for."""
    device = os.environ.get("ERTIS_RTISDEV_DEVICE") or "auto"
    method = os.environ.get("ERTIS_RTISDEV_METHOD") or "exact"
    checks.choice("ERTIS_RTISDEV_METHOD", method, ("exact", "fast"))
    exact = Processor(configuration, device=device)
    if method == "exact":
        return exact
    try:
        fast = FastProcessor(exact, device=device)
    except ArgumentError as error:
        _log.warning("configuration %r uses the exact method, because the fast one cannot: %s", name, error)
        return exact
    _log.warning(
        "configuration %r uses the fast method; before cleaning, its images differ by about %.0f dB from exact ones",
        name,
        fast.difference_db,
    )
    return fast


@contextmanager
def _errors_logged() -> Iterator[None]:
    """Log errors, because ``rtisdev`` shows only some of them."""
    try:
        yield
    except ErtisError as error:
        _log.error("%s", error)
        raise


def _taps(given: ArrayLike) -> NDArray[np.float32]:
    return np.ascontiguousarray(np.ravel(given), dtype=np.float32)


def _complex(real: ArrayLike, imag: ArrayLike) -> NDArray[np.complex64]:
    made = np.asarray(real, dtype=np.float32) + 1j * np.asarray(imag, dtype=np.float32)
    return np.ascontiguousarray(made, dtype=np.complex64)
