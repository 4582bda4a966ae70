"""Processing of measurements, with the functions of the closed module ``rtiscuda``, on the kernels of this package."""

import logging
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError, ErtisError
from ertis_numba.interop.rtisdev import arguments
from ertis_numba.interop.rtisdev.fast import FastProcessor
from ertis_numba.interop.rtisdev.processor import Configuration, Processor

__all__ = ["preload", "processing", "unloadall", "unloadone"]

_MAX_MICROPHONES: Final = 32  # A PDM word has a bit for each.
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
    """Prepare or replace a configuration for `processing`; arguments as ``rtisdev`` passes: see `Configuration`."""
    with _errors_logged():
        name = arguments.text("name", name)
        n_mics = arguments.whole("n_microphones", n_microphones, 1, _MAX_MICROPHONES)
        configuration = Configuration(
            pdm_filter=arguments.filter_taps("pdm_filter", pdm_filter),
            pre_filter=arguments.filter_taps("pre_filter", pre_filter) if pre_filter_enable else None,
            envelope_filter=arguments.filter_taps("envelope_filter", envelope_filter),
            post_filter=arguments.filter_taps("post_filter", post_filter) if post_filter_enable else None,
            matched_filter=(
                arguments.spectra(matched_filter_real, matched_filter_imag) if matched_filter_enable else None
            ),
            delays=arguments.delay_matrix(delay_matrix) if beamforming_enable else None,
            n_mics=n_mics,
            n_directions=arguments.whole("n_directions", n_directions, int(bool(beamforming_enable))),
            n_samples=arguments.whole("n_samples", n_samples, 1),
            pdm_factor=arguments.whole("pdm_subsample_factor", pdm_subsample_factor, 1),
            beamforming_drop=arguments.whole("beamforming_drop", beamforming_drop, 0),
            envelope_factor=arguments.whole(
                "envelope_subsample_factor", envelope_subsample_factor, int(bool(envelope_enable))
            ),
            first_range=arguments.whole("first_range", first_range, 0),
            last_range=arguments.whole("last_range", last_range, 0),
            clean_multipliers=(
                (checks.finite("mean_multiplier", mean_multiplier), checks.finite("max_multiplier", max_multiplier))
                if clean_enable
                else None
            ),
            has_envelope=bool(envelope_enable),
            disabled=arguments.disabled(disabled_microphones, n_mics),
            # 0 is an earlier kernel of delay-and-sum.
            dmas_order=max(1, arguments.whole("dmasOrder", dmas_order, 0)),
            coherent=bool(coherence_factor_enable),
        )
        processor = _processor(name, configuration)
    with _turn:
        _processors[name] = processor


def processing(data: NDArray[Any], pdm: int, dim1: int, dim2: int, name: str) -> NDArray[np.float32]:
    """Process a measurement with a preloaded configuration; return (dim1, dim2)."""
    # With `pdm`, `data` are words (sample,) uint32, otherwise signals (mic, sample) or beams (direction, sample).
    with _errors_logged():
        name = arguments.text("name", name)
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
    with _errors_logged():
        name = arguments.text("name", name)
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
        "configuration %r uses the fast method; before cleaning, its images differ from exact ones by about %.0f dB "
        "for loud echoes and %.0f dB for echoes that are 60 dB weaker; images of noise alone differ more",
        name,
        fast.difference_db,
        fast.weak_difference_db,
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
