# mypy: ignore-errors
"""Fusion of images: places of reflectors by echoes, and the echoes that they cause."""

import math

import numpy as np
from numba import njit

from ertis_numba.kernels._contract.reflectors import (
    AUDIBLE,
    DISTURBING,
    GRAZING,
    LAST_PATH_M,
    LEAST_COSINE,
    NEAREST_M,
    SHIFT,
    SIDE_LOBES,
    SPREAD,
    SPREADING_M,
    TILT,
)

__all__ = [
    "find_arrivals",
    "find_maxima",
    "locate_reflector",
    "match_echoes",
    "overlap_echoes",
    "see_places",
]


@njit(nogil=True, cache=True, error_model="numpy")
def locate_reflector(
    sensor_m, ahead, echoes, echo, emitter, added, information, nearest_m, outlier, n_rounds, position_m, out
):
    """Locate a reflector by the paths and directions of its echoes."""
    normal, right = np.empty((3, 3)), np.empty(3)
    axes, deviation = np.empty((len(echo), 2, 3)), np.empty((len(echo), 2))
    for i in range(len(echo)):
        here = echoes.receiver[echo[i]]
        is_behind = _product(position_m - sensor_m[here], ahead[here]) < 0.0
        for j in range(2):
            deviation[i, j] = echoes.deviation[echo[i], j]
            if len(added):
                deviation[i, j] = np.sqrt(deviation[i, j] ** 2 + added[i, j])
            axes[i, j] = echoes.axes[echo[i], 1 + j]
            if is_behind:
                axes[i, j] -= 2.0 * _product(axes[i, j], ahead[here]) * ahead[here]
    for _ in range(n_rounds):
        normal[:] = 0.0
        right[:] = 0.0
        for i in range(3):
            normal[i, i] = information
        for i in range(len(echo)):
            away_m, back_m = position_m - sensor_m[emitter[i]], position_m - sensor_m[echoes.receiver[echo[i]]]
            from_m, to_m = max(nearest_m, _length(away_m)), max(nearest_m, _length(back_m))
            late = (echoes.path_m[echo[i], emitter[i]] - from_m - to_m) / deviation[i, 0]
            _add_equation((away_m / from_m + back_m / to_m) / deviation[i, 0], late, outlier, normal, right)
            for j in range(2):
                across = axes[i, j] / (to_m * deviation[i, 1])
                _add_equation(across, -_product(across, back_m), outlier, normal, right)
        _invert(normal, out)
        for i in range(3):
            position_m[i] += _product(out[i], right)


@njit(nogil=True, cache=True, error_model="numpy")
def _add_equation(row, residual, outlier, normal, right):
    """Add an equation to the normal equations, with less weight for larger residuals."""
    weight = 1.0 / (1.0 + (residual / outlier) ** 2)
    for i in range(3):
        right[i] += weight * row[i] * residual
        for j in range(3):
            normal[i, j] += weight * row[i] * row[j]


@njit(nogil=True, cache=True, error_model="numpy")
def _product(one, other):
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


@njit(nogil=True, cache=True, error_model="numpy")
def _length(vector):
    return np.sqrt(_product(vector, vector))


@njit(nogil=True, cache=True, error_model="numpy")
def _invert(a, out):
    """Invert a symmetric positive definite matrix by its Cholesky factor, whose errors are small."""
    l00 = np.sqrt(a[0, 0])
    l10, l20 = a[1, 0] / l00, a[2, 0] / l00
    l11 = np.sqrt(a[1, 1] - l10 * l10)
    l21 = (a[2, 1] - l20 * l10) / l11
    l22 = np.sqrt(a[2, 2] - l20 * l20 - l21 * l21)
    i00, i11, i22 = 1.0 / l00, 1.0 / l11, 1.0 / l22
    i10, i21 = -l10 * i00 * i11, -l21 * i11 * i22
    i20 = -(l20 * i00 + l21 * i10) * i22
    out[0, 0] = i00 * i00 + i10 * i10 + i20 * i20
    out[1, 1] = i11 * i11 + i21 * i21
    out[2, 2] = i22 * i22
    out[0, 1] = out[1, 0] = i10 * i11 + i20 * i21
    out[0, 2] = out[2, 0] = i20 * i22
    out[1, 2] = out[2, 1] = i21 * i22


@njit(nogil=True, cache=True, error_model="numpy")
def match_echoes(places, across, reflectivity, extra_m, is_flat, echoes, chosen, gate, alike, found, out):
    """Find the echoes that reflectors at given places explain, by path, direction and power."""
    count, slope_m = 0, np.empty(places.apart_m.shape[1])
    for place in range(len(places.apart_m)):
        apart_m, depth, across_m2 = places.apart_m[place], places.depth[place], _product(across[place], across[place])
        for sensor in range(len(slope_m)):
            slope_m[sensor] = _product(places.toward[place, sensor], across[place])
        for echo in chosen:
            here, power = echoes.receiver[echo], echoes.power[echo]
            is_behind, to_m = depth[here] < 0.0, apart_m[here]
            if is_behind and not is_flat[here]:
                continue
            # For small angles, the chord equals the angle.
            turned = max(0.0, 2.0 - 2.0 * _product(places.seen[place, here], echoes.axes[echo, 0]))
            turned /= across_m2 / (to_m * to_m) + echoes.gate_rad2[echo]
            if not turned < gate:
                continue
            for emitter in range(len(apart_m)):
                late_m = echoes.path_m[echo, emitter] - apart_m[emitter] - to_m
                along_m, beside_m = slope_m[emitter] + slope_m[here], places.beside_m[place, emitter]
                sum_m2 = along_m * along_m + echoes.gate_m2[echo] + (beside_m * beside_m + extra_m * extra_m)
                distance = turned + late_m * late_m / sum_m2
                expected = reflectivity[place] * places.gain[place, here, emitter]
                is_alike = power < alike * expected and (is_behind or alike * power > expected)
                if distance < gate and is_alike:  # False for NaN, where there is no path.
                    if count < len(out):
                        found[0, count], found[1, count], found[2, count] = place, echo, emitter
                        out[count] = distance
                    count += 1
    return count


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"nnan"})
def find_maxima(amplitude, is_near, column, near, beside, out):
    """Compute the highest amplitudes around bins of an image."""
    highest = amplitude[0].copy()
    for d in range(1, len(amplitude)):
        row = amplitude[d]
        for r in range(len(highest)):
            highest[r] = max(highest[r], row[r])
    for place in range(column.shape[0]):
        for b in range(column.shape[1]):
            here = column[place, b]
            out[0, place, b] = out[1, place, b] = 0.0
            for r in range(max(0, here - beside), min(len(highest), here + beside + 1)):
                out[1, place, b] = max(out[1, place, b], highest[r])
            for d in range(len(amplitude)):
                if is_near[place, d]:
                    for r in range(max(0, here - near), min(len(highest), here + near + 1)):
                        out[0, place, b] = max(out[0, place, b], amplitude[d, r])


@njit(nogil=True, cache=True, error_model="numpy")
def find_arrivals(origin_m, sent_m, sensor_m, ahead, is_flat, receiver, direction, path_m, within_m, within_rad, found):
    """Find the echoes that fit sound from given places, by path and direction."""
    count, n_emitters = 0, path_m.shape[1]
    to_m, whole_m = np.empty((len(sensor_m), 3)), np.empty(len(sensor_m))
    for source in range(len(origin_m)):
        for emitter in range(n_emitters):
            for here in range(len(sensor_m)):
                for axis in range(3):
                    to_m[here, axis] = origin_m[source, emitter, axis] - sensor_m[here, axis]
                whole_m[here] = max(_length(to_m[here]), NEAREST_M) + sent_m[source, emitter]
            for echo in range(len(path_m)):
                here = receiver[echo]
                if abs(path_m[echo, emitter] - whole_m[here]) < within_m and _arrives(  # False for NaN.
                    to_m[here], ahead[here], is_flat[here], direction[echo], within_rad
                ):
                    if count < found.shape[1]:
                        found[0, count], found[1, count], found[2, count] = source, emitter, echo
                    count += 1
    return count


@njit(nogil=True, cache=True, error_model="numpy")
def _arrives(to_m, ahead, is_flat, direction, within_rad):
    """Return True if sound from a place appears in a direction."""
    apart_m = max(_length(to_m), NEAREST_M)
    depth = _product(to_m, ahead) / apart_m
    turned = 0.0
    for axis in range(3):
        seen = to_m[axis] / apart_m - 2.0 * min(depth, 0.0) * ahead[axis]
        turned += (seen - direction[axis]) ** 2
    is_near = np.sqrt(turned) < within_rad / max(abs(depth), LEAST_COSINE)  # For small angles, the chord is the angle.
    return is_near and (is_flat or depth > 0.0)


@njit(nogil=True, cache=True, error_model="numpy")
def see_places(place_m, sensors, out):
    """Compute how the sensors of a platform see places."""
    cosine_step = 2.0 / (sensors.patterns.shape[2] - 1)
    for place in range(len(place_m)):
        for sensor in range(len(sensors.sensor_m)):
            toward, ahead = out.toward[place, sensor], sensors.ahead[sensor]
            for axis in range(3):
                toward[axis] = place_m[place, axis] - sensors.sensor_m[sensor, axis]
            apart_m = max(_length(toward), SPREADING_M)
            for axis in range(3):
                toward[axis] /= apart_m
            cosine = _product(toward, ahead)
            twice = 2.0 * min(cosine, 0.0) if sensors.is_flat[sensor] else 0.0
            for axis in range(3):
                out.seen[place, sensor, axis] = toward[axis] - twice * ahead[axis]
            out.apart_m[place, sensor], out.depth[place, sensor] = apart_m, cosine
            out.radiated[place, sensor] = _at(sensors.patterns[0, sensor], cosine, -1.0, cosine_step)
            out.beside_m[place, sensor] = _at(sensors.beside_m[sensor], cosine, -1.0, cosine_step)
        _see_echoes(out.apart_m[place], out.depth[place], sensors, out.gain[place])


@njit(nogil=True, cache=True, error_model="numpy")
def _see_echoes(apart_m, depth, sensors, out):
    """Compute the power of the echoes of one place for all pairs of receiver and emitter."""
    cosine_step, path_step_m = 2.0 / (sensors.patterns.shape[2] - 1), LAST_PATH_M / (sensors.lost.shape[1] - 1)
    for receiver in range(len(out)):
        model = sensors.model[receiver]
        for emitter in range(len(out)):
            out[receiver, emitter] = 0.0
            power = _at(sensors.patterns[max(model, 0), emitter], depth[emitter], -1.0, cosine_step)
            if model >= 0 and power > AUDIBLE:
                there_m, back_m = apart_m[emitter], apart_m[receiver]
                spread = np.exp(_at(sensors.lost[model], there_m + back_m, 0.0, path_step_m)) / (there_m * back_m) ** 2
                out[receiver, emitter] = power * spread


@njit(nogil=True, cache=True, error_model="numpy")
def _at(table, place, first, step):
    """Interpolate in a table of evenly spaced places, and keep its values beyond its ends."""
    between = (place - first) / step
    if not between > 0.0:
        return table[0]
    before = int(min(between, len(table) - 1.0))
    if before == len(table) - 1:
        return table[before]
    return (table[before + 1] - table[before]) / step * (place - (first + before * step)) + table[before]


@njit(nogil=True, cache=True, error_model="numpy")
def overlap_echoes(path_m, power, direction, receiver, heard_m, toward, loudness, is_other, ahead, pulse_m, beam, out):
    """Compute how much the echoes of reflectors disturb others."""
    for echo in range(len(receiver)):
        here, along = receiver[echo], 0.0
        width_m, width = pulse_m[here], beam[here]
        for axis in range(3):
            along += toward[echo, axis] * ahead[here, axis]
        facing = max(along, GRAZING)
        for reflector in range(len(path_m)):
            # A flat array observes directions in its plane, so its beam is wider to the side.
            along = square = 0.0
            for axis in range(3):
                turned = toward[echo, axis] - direction[reflector, here, axis]
                along += turned * ahead[here, axis]
                square += turned * turned
            across = math.sqrt(max(0.0, square - along * along))
            lobe, shift_m = math.exp(-((across / width) ** 2)), SPREAD * width_m * (across / width)
            total = sides = path_m2 = 0.0
            for emitter in range(path_m.shape[2]):
                late_m = abs(heard_m[echo, emitter] - path_m[reflector, here, emitter])
                if not (is_other[echo, reflector, emitter] and late_m >= 0.0):  # False for NaN.
                    continue
                strength = power[reflector, here, emitter] / loudness[echo]
                near, aside = strength * lobe * _pulse(late_m / width_m), 0.0
                if across > width:
                    aside = strength * SIDE_LOBES * _pulse(max(0.0, late_m - shift_m) / width_m)
                near = min(near, 1.0) if near > DISTURBING else 0.0
                aside = min(aside, 1.0) if aside > DISTURBING else 0.0
                if near + aside > 0.0:
                    total += near
                    sides += aside
                    path_m2 += (near + aside) * min(SHIFT * late_m, width_m) ** 2
            angle_rad2 = total * (SHIFT * min(across, width)) ** 2 + sides * (TILT * width) ** 2
            out[0, echo, reflector], out[1, echo, reflector] = total, path_m2
            out[2, echo, reflector] = angle_rad2 / (facing * facing)


@njit(nogil=True, cache=True, error_model="numpy")
def _pulse(widths):
    """Return the power of a compressed pulse with side lobes."""
    square = 1.0 + widths * widths
    root = math.sqrt(square)
    return 1.0 / (square * root * math.sqrt(root))
