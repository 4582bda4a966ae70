# mypy: ignore-errors
"""Sums over microphones that a single echo causes in the samples of an image, and their derivatives by its place."""

import math

import numpy as np
from numba import njit

from ertis_numba.kernels._contract.points import LEAST_M, TINY
from ertis_numba.kernels._cpu.pulse_table import pulse_at, unit_at

__all__ = ["predict", "steer"]


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def steer(pulse, beams, row, offset_m, is_focused, given, work):
    """Compute the beams of samples and the correlations of their noise."""
    # `beam` (sample, 5, mic): path relative to that to the maximum, carrier with the gain, and slope / gain.
    tables, positions_m, _, _, range_m, _, _, _, scale = given
    _, noises, beam, _, _, _ = work
    for sample in range(len(row)):
        at_m, here = range_m + offset_m[sample] if is_focused else 0.0, beam[sample]
        _lags_m(positions_m, beams.directions[row[sample]], at_m, here[0])
        for mic in range(len(pulse.weights)):
            here[0, mic] = scale * (2.0 * offset_m[sample] + here[0, mic])
        _carriers(pulse, here)
        here[3:] = 0.0
    _noises(pulse, tables, beam, noises)
    if len(beams.gain):
        for sample in range(len(row)):
            here = beam[sample]
            for mic in range(len(pulse.weights)):
                gain = np.complex128(beams.gain[row[sample], mic])
                carrier, ratio = complex(here[1, mic], here[2, mic]) * gain, beams.slope_s[row[sample], mic] / gain
                here[1, mic], here[2, mic] = carrier.real, carrier.imag
                here[3, mic], here[4, mic] = ratio.real, ratio.imag


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _noises(pulse, tables, beam, out):
    """Compute the correlations of white noise between samples, real and imaginary parts."""
    table, _, rate_1_m = tables
    power = 0.0
    for mic in range(len(pulse.weights)):
        power += pulse.weights[mic] * pulse.weights[mic]
    for one in range(len(out)):
        for other in range(one + 1):
            here, there, real, imag = beam[one], beam[other], 0.0, 0.0
            for mic in range(len(pulse.weights)):
                a, b = pulse_at(table, rate_1_m, here[0, mic] - there[0, mic])
                weight = pulse.weights[mic] * pulse.weights[mic]
                c = weight * (here[1, mic] * there[1, mic] + here[2, mic] * there[2, mic])
                s = weight * (here[2, mic] * there[1, mic] - here[1, mic] * there[2, mic])
                real += a * c - b * s
                imag += a * s + b * c
            out[one, 0, other], out[one, 1, other] = real / power, imag / power


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def predict(pulse, given, work, at):
    """Compute the echo of a place: in each sample its phase and amplitude, and the derivatives of the latter."""
    (table, tilted_hz, rate_1_m), _, _, _, _, _, tilt_s, _, scale = given
    value, _, beam, own, whole, _ = work
    _hear(pulse, given, own, at)
    n_mics, carrier_1_m = len(pulse.weights), scale * pulse.carrier_1_m
    turn_s_m = tilt_s * carrier_1_m + 2.0 * math.pi * scale / pulse.speed_m_s
    for sample in range(len(value)):
        here = beam[sample]
        real = imag = along = across = left = right = up = down = 0.0
        for mic in range(n_mics):
            path_m = here[0, mic] - own[0, mic]
            a, b = pulse_at(table, rate_1_m, path_m)
            p, q = pulse_at(tilted_hz, rate_1_m, path_m)
            cosine = own[1, mic] * here[1, mic] - own[2, mic] * here[2, mic]
            sine = own[1, mic] * here[2, mic] + own[2, mic] * here[1, mic]
            a, b = a * cosine - b * sine, a * sine + b * cosine
            p, q = p * cosine - q * sine, p * sine + q * cosine
            real += a + tilt_s * p + here[3, mic] * p - here[4, mic] * q
            imag += b + tilt_s * q + here[3, mic] * q + here[4, mic] * p
            a, b = carrier_1_m * a + turn_s_m * p, carrier_1_m * b + turn_s_m * q
            along, across = along + a, across + b
            left, right = left + own[3, mic] * a, right + own[3, mic] * b
            up, down = up + own[4, mic] * a, down + own[4, mic] * b
        size = math.sqrt(real * real + imag * imag)
        value[sample, 2] = size / n_mics
        size = max(size, TINY)
        real, imag = real / size, imag / size
        value[sample, 0], value[sample, 1] = real, imag
        whole[sample, 0] = -2.0 * (imag * along - real * across) / n_mics
        whole[sample, 1] = (imag * left - real * right) / n_mics
        whole[sample, 2] = (imag * up - real * down) / n_mics


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _hear(pulse, given, own, at):
    """Compute the path of an echo to each microphone, its weighted carrier, and the derivatives of the path."""
    _, positions_m, _, middle, range_m, axes, _, _, scale = given
    x = middle[0] + at[1] * axes[0, 0] + at[2] * axes[1, 0]
    y = middle[1] + at[1] * axes[0, 1] + at[2] * axes[1, 1]
    z = middle[2] + at[1] * axes[0, 2] + at[2] * axes[1, 2]
    size = math.sqrt(x * x + y * y + z * z)
    x, y, z = x / size, y / size, z / size
    _lags_m(positions_m, (x, y, z), max(range_m + at[0], LEAST_M), own[0])
    for mic in range(len(pulse.weights)):
        own[0, mic] = scale * (2.0 * at[0] + own[0, mic])
    _carriers(pulse, own)
    for mic in range(len(pulse.weights)):
        own[1, mic] *= pulse.weights[mic]
        own[2, mic] *= -pulse.weights[mic]
    for axis in range(2):
        along = axes[axis, 0] * x + axes[axis, 1] * y + axes[axis, 2] * z
        a, b, c = axes[axis, 0] - along * x, axes[axis, 1] - along * y, axes[axis, 2] - along * z
        _project(positions_m, (a / size, b / size, c / size), own[3 + axis])


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _lags_m(positions_m, direction, range_m, out):
    """Compute the paths from a place to microphones minus its range; for a range of 0, those from infinity."""
    _project(positions_m, direction, out)
    px, py, pz = positions_m
    for mic in range(len(out)):
        along_m = out[mic]
        square_m2 = px[mic] * px[mic] + py[mic] * py[mic] + pz[mic] * pz[mic] - 2.0 * range_m * along_m
        near_m = square_m2 / max(math.sqrt(max(range_m * range_m + square_m2, 0.0)) + range_m, TINY)
        out[mic] = near_m if range_m > 0.0 else -along_m


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _carriers(pulse, out):
    """Compute the carriers of paths."""
    path_m, cosine, sine = out[0], out[1], out[2]
    for mic in range(len(path_m)):
        cosine[mic], sine[mic] = unit_at(pulse.carrier_1_m * path_m[mic])


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _project(positions_m, axis, out):
    """Compute the places of microphones along an axis."""
    x, y, z = axis
    px, py, pz = positions_m
    for mic in range(len(out)):
        out[mic] = x * px[mic] + y * py[mic] + z * pz[mic]
