"""Launches of every kernel, by the processing chain or, if no chain uses it, directly."""

import functools

import numpy as np

from ertis_numba.chain import planner
from ertis_numba.chain.fast_chain import FastChain
from ertis_numba.settings import Accuracy, Processing, Settings
from ertis_numba.settings.beamformers import ADAPTIVE_COMBINATIONS
from tests.ptx import offline_compilation

ERTIS = Settings.from_preset("default_25_50")
STREAMS = {"precision": "int16", "oversampling": 8, "delay_taps": 2, "beam_taps": 4, "max_error_db": -10.0}
PLANS = {
    # accuracy, processing
    "default": ({}, {}),
    "own beams": ({"beam_taps": 0, "precision": "float32"}, {}),
    "few directions": ({"stopband_attenuation_db": 40.0}, {"directions": "90"}),  # taps of 16 bits
    "deep stop band": ({"stopband_attenuation_db": 100.0, "precision": "float32"}, {}),  # taps of 32 bits
    "int16": ({"precision": "int16", "beam_taps": 0, "delay_taps": 2}, {}),
    "int16, nodes": ({"precision": "int16", "beam_taps": 4}, {}),
    "phase shifts": ({"delay_taps": 0}, {}),
    "near": ({}, {"range_m": (0.3, 1.0)}),  # several focal zones
    **{
        f"{beamformer}, {weighting}": (
            {"precision": "float32"},
            {"beamformer": beamformer, "weighting": weighting, "directions": "90"},
        )
        for beamformer, weighting in ADAPTIVE_COMBINATIONS
    },
    **{
        f"dmas {order}": ({"precision": "float32"}, {"beamformer": "dmas", "dmas_order": order})
        for order in (2, 3, 5, 8)
    },
    **{f"streams of dmas {order}": (STREAMS, {"beamformer": "dmas", "dmas_order": order}) for order in (2, 3, 5, 8)},
    "streams of coherence factor": (STREAMS, {"weighting": "coherence_factor"}),
    "streams of both": (STREAMS, {"beamformer": "dmas", "dmas_order": 5, "weighting": "coherence_factor"}),
    "double capon": ({}, {"beamformer": "capon", "diagonal_loading": 1e-5, "directions": "90"}),
}


@functools.cache
def by_contract():
    """Return all launches by the name of the kernel in the contract."""
    found = {}
    for steps in [*(functools.partial(_chain, *plan) for plan in PLANS.values()), _each]:
        for launch in offline_compilation.recorded(steps):
            found.setdefault(launch.file, []).append(launch)
    return found


def _chain(accuracy, processing, kernels):
    settings = ERTIS.replace(
        processing=Processing(directions="3000", range_m=(0.5, 5.0)).replace(**processing),
        accuracy=Accuracy(**accuracy),
    )
    settings = planner.complete(settings, kernels, threads=1)
    chain = FastChain(settings, kernels, threads=1)
    chain.process(np.zeros((settings.recording.n_samples, 1), np.uint32), chain.new_image())


def _each(kernels):
    """Launch the kernels that no plan uses, and every type of words and taps."""
    channels = np.arange(8, dtype=np.int32)
    signals, spectra = np.zeros((8, 500), np.float32), np.zeros((8, 251), np.complex64)
    for word in (np.uint8, np.uint16, np.uint32, np.uint64):
        words = np.zeros((500, 2), word)
        kernels.unpack_bits(words, channels, signals)
        for taps in (np.int16, np.int32):
            kernels.demodulate_words(words, channels, np.zeros(61, taps), np.float32(1), 10, 0, 50, signals)
    for number in (np.int16, np.float32):
        kernels.unpack_pcm(np.zeros((500, 8), number), channels, np.float32(1), np.float32(0), -5, signals)
    kernels.decimate(signals, np.zeros(61, np.float32), 10, np.zeros((8, 50), np.float32))
    kernels.remove_group_delay(signals, 3, np.zeros((8, 400), np.float32))
    kernels.multiply_spectra(spectra, spectra[0].copy(), np.zeros((8, 500), np.complex64))
    beams = np.zeros((90, 400), np.complex64)
    offsets, weights = np.zeros((90, 8), np.int32), np.zeros((90, 8), np.complex64)
    kernels.delay_and_sum(np.zeros((8, 2, 500), np.complex64), offsets, weights, beams)
    kernels.envelope(beams, 10, np.zeros((90, 40), np.float32))
    sums = np.zeros((90, 400), np.float32)
    kernels.combine_delayed(signals, signals, offsets, 5, 1, 0, sums)
    kernels.rectify_and_decimate(sums, np.zeros(61, np.int16), 0.5, 10, 0, np.zeros((90, 30), np.float32))
    kernels.sum_delayed_int16(np.zeros((4, 8, 200), np.int16), np.zeros(4, np.float32), offsets, sums)
    double, octets = np.zeros((32, 500)), np.arange(32, dtype=np.int32).reshape(4, 8)
    blocks, matrices = np.zeros((8, 6, 129), np.complex64), np.zeros((20, 8, 8), np.complex64)
    kernels.cross_spectra(blocks, 5, matrices)
    steps, bins = np.zeros((8, 90), np.uint32), np.arange(20, dtype=np.uint32)
    powers, hollow = np.zeros((20, 90), np.float32), True
    kernels.steer_power(matrices, steps, bins, powers)
    kernels.steer_vectors(matrices[:, :3].copy(), steps, bins, powers)
    kernels.clean_sources(matrices, steps, bins, powers, hollow, powers)
    kernels.add_paths(
        np.zeros((1, 251), np.complex128),
        np.zeros((5, 8)),
        np.zeros((5, 8, 9)),
        3,
        0.1,
        np.zeros((8, 251), np.complex128),
    )
    kernels.modulate_pdm(
        double,
        octets,
        np.zeros(32, np.uint64),
        np.zeros(32),
        np.zeros((32, 4)),
        np.zeros(8),
        0,
        np.zeros((500, 4), np.uint8),
    )
