"""Delay-and-sum by mach, the ultrasound beamformer of Forest Neurotech, on this package's analytic signals.

mach interpolates demodulated samples linearly, and restores the phase of the carrier at the delay of each point of the
image. It computes the delays in the same kernel. For the comparison, this package uses spherical waves and eight
samples per range, too. It interpolates between two samples with fitted weights. Its delays come from tables for focal
zones.
"""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_bench import timing
from ertis_bench.gpu_trials.gpu_stages import stages
from ertis_bench.plans import in_words
from ertis_numba import kernels
from ertis_numba.base.errors import DataError
from ertis_numba.chain.fast_chain import FastChain
from ertis_numba.chain.plan_elements import spectrum_of
from ertis_numba.frames import Measurement
from ertis_numba.geometry import direction_grid, microphones, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.pipeline import Pipeline, verification
from ertis_numba.settings import Settings

__all__ = ["FRAMES", "problem", "race", "settings_for"]

_MAX_DIFFERENCE_DB = -25.0  # The budget is -30 dB, and mach adds the error of its linear interpolation.
FRAMES = 16
# mach uses the third axis as depth and scales the aperture with it, so that 0 m would leave no aperture.
_DEPTH_OFFSET_M = 8.0
_F_NUMBER = 0.01


def settings_for(settings: Settings) -> Settings:
    """Return settings with which this package interpolates between as many samples as mach does."""
    accuracy = settings.accuracy.replace(
        max_error_db=-30.0, precision="float32", oversampling=8, delay_taps=2, beam_taps=0
    )
    return settings.replace(accuracy=accuracy, processing=settings.processing.replace(wavefront="spherical"))


def problem(settings: Settings, measurement: Measurement, device: str) -> tuple[dict[str, Any], NDArray[np.float32]]:
    """Return the arguments of ``mach.kernel.beamform`` with NumPy arrays, and this package's image."""
    chain = FastChain(settings, kernels.load(device), threads=1)
    image = chain.new_image()
    words = measurement.data.reshape(settings.recording.n_samples, -1)
    analytic, lead = chain.analytic(words)
    chain.process(words, image)
    speed_m_s, layout = sound_speed_m_s(settings.air), microphones(settings.array)
    n_mics, n_phases, n_outputs = analytic.shape
    rate_hz = settings.output_rate_hz * n_phases
    start_s = 2 * chain.range_m[0] / speed_m_s - lead / settings.output_rate_hz
    samples = np.moveaxis(analytic, 1, 2).reshape(n_mics, n_outputs * n_phases)
    carrier_hz = spectrum_of(settings).centre_hz
    time_s = start_s + np.arange(samples.shape[1]) / rate_hz
    samples = (samples * np.exp(-2j * np.pi * carrier_hz * time_s)).astype(np.complex64)
    grid = direction_grid(settings.processing)
    units = unit_vectors(grid.azimuth_rad, grid.elevation_rad)
    places_m = (units[:, None, :] * chain.range_m[:, None]).reshape(-1, 3)
    chain.close()
    return {
        "channel_data": samples[:, :, None],
        "rx_coords_m": _with_depth_last(layout.enabled_positions_m),
        "scan_coords_m": _with_depth_last(places_m),
        "tx_wave_arrivals_s": (np.tile(chain.range_m, len(units)) / speed_m_s).astype(np.float32),
        "rx_start_s": float(start_s),
        "sampling_freq_hz": float(rate_hz),
        "f_number": _F_NUMBER,
        "sound_speed_m_s": float(speed_m_s),
        "modulation_freq_hz": float(carrier_hz),
        "tukey_alpha": 0.0,
    }, image


def race(settings: Settings, measurement: Measurement, count: int) -> dict[str, Any]:
    """Return times of mach and of this package for delay-and-sum with envelope, entirely on the GPU."""
    import cupy  # noqa: PLC0415 - there with a GPU only
    from mach.kernel import beamform  # noqa: PLC0415 - rarely there

    with Pipeline(settings_for(settings), device="cuda") as pipeline:
        plan = pipeline.settings
    arguments, image = problem(plan, measurement, "cuda")
    here = {name: cupy.asarray(value) if isinstance(value, np.ndarray) else value for name, value in arguments.items()}
    run: Callable[..., Any] = functools.partial(_beamform, cupy, beamform)
    found = cupy.asnumpy(run(here)).reshape(image.shape) / len(arguments["rx_coords_m"])
    difference_db = verification.error_db(found, image)
    if not difference_db <= _MAX_DIFFERENCE_DB:
        raise DataError(
            f"image of mach differs from this package's by {difference_db:.1f} dB; "
            f"the limit is {_MAX_DIFFERENCE_DB:g} dB. The time is not reported, because the results differ"
        )
    many = here | {"channel_data": cupy.ascontiguousarray(cupy.repeat(here["channel_data"], FRAMES, axis=2))}
    times_ms = timing.round_robin(
        {"one": functools.partial(run, here), "many": functools.partial(run, many)}, count=count, burst=count
    )
    median_ms = {name: timing.summary(times)["median_ms"] for name, times in times_ms.items()}
    words = measurement.data.reshape(plan.recording.n_samples, -1)
    ours_ms = stages(plan, words, count=count)["stages_ms"]["delay-and-sum with envelope"]
    return {
        "what": "delay-and-sum with envelope alone",
        "plan": in_words(plan.accuracy),
        "off_db": round(difference_db, 1),
        "theirs_ms": median_ms["one"],
        f"theirs_per_frame_of_{FRAMES}_ms": round(median_ms["many"] / FRAMES, 3),
        "ours_ms": ours_ms,
        "times_faster": round(median_ms["one"] / ours_ms, 2),
    }


def _beamform(cupy: Any, beamform: Callable[..., Any], arguments: dict[str, Any]) -> Any:
    envelope = cupy.abs(beamform(**arguments))
    cupy.cuda.Device().synchronize()
    return envelope


def _with_depth_last(positions_m: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return positions with the forward axis last, as depths."""
    depth_m = np.roll(positions_m, -1, axis=1)
    depth_m[:, 2] += _DEPTH_OFFSET_M
    return depth_m.astype(np.float32)
