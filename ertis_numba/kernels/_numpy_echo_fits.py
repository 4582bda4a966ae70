"""Fits of single echoes in plain NumPy, as a reference for the compiled ones, and where none can be compiled."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ertis_numba.kernels._contract.points import (
    CONVERGED,
    DAMPING,
    DARK,
    LEAST_M,
    MAX_DAMPING,
    MAX_NP,
    MUCH,
    N_ROUNDS,
    N_TRIED,
    N_WIDENED,
    RICE,
    TINY,
    TOO_MUCH,
    WIDE_RAD,
    BeamErrors,
    Complexes,
    Doubles,
    EchoSamples,
    Pulse,
)

__all__ = ["fit_echoes", "pulse_at"]


def fit_echoes(
    pulse: Pulse,
    beams: BeamErrors,
    samples: EchoSamples,
    starts: Doubles,
    axes: Doubles,
    noise: float,
    model: float,
    is_focused: bool,  # noqa: FBT001  As in the compiled kernel.
    scale: float,
    out: Doubles,
) -> None:
    """Fit single echoes to samples of an image."""
    for place in range(len(out)):
        fit = _Fit.of(pulse, beams, samples, place, axes[place], noise, is_focused=is_focused, scale=scale)
        found = [fit.minimum(starts[place, 0], model)]
        if samples.is_coarse[place] or found[0][4] > MUCH * fit.freedom:
            order = np.argsort([fit.misfit(start, model) for start in starts[place, 1:]], kind="stable")[:N_TRIED]
            for start in starts[place, 1 + order]:
                tried = fit.minimum(start, model)
                if not any(_is_same(tried, other) for other in found):
                    found.append(tried)
        best = min(found, key=lambda each: float(each[4]))
        out[place, :21] = _combined(found, best)
        error = model
        for _ in range(N_WIDENED):
            excess = best[4] / fit.freedom
            if not excess > TOO_MUCH:
                break
            error = max(error, 0.3 * noise / math.exp(best[3])) * math.sqrt(excess)
            out[place, :21] = best = fit.minimum(best[:4], error)
        out[place, 21] = error


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """Samples of one place with the inputs of their prediction."""

    pulse: Pulse
    gain: Complexes | None
    slope_s: Complexes | None
    middle: Doubles
    axes: Doubles
    is_used: NDArray[np.bool_]
    amplitude: Doubles
    offset_m: Doubles
    range_m: float
    lags_m: Doubles
    noises: Complexes
    noise: float
    scale: float
    freedom: float
    tilt_s: float

    @classmethod
    def of(
        cls,
        pulse: Pulse,
        beams: BeamErrors,
        samples: EchoSamples,
        place: int,
        axes: Doubles,
        noise: float,
        *,
        is_focused: bool,
        scale: float,
    ) -> "_Fit":
        """Return the fit of one place."""
        row, offset_m, range_m = samples.row[place], samples.offset_m[place], float(samples.range_m[place])
        at_m = range_m + offset_m if is_focused else np.zeros(len(row))
        lags_m = _lags_m(pulse, beams.directions[row], at_m)
        paths_m = scale * (2 * (offset_m[:, None] - offset_m)[..., None] + lags_m[:, None] - lags_m)
        noises = (pulse_at(pulse, paths_m, pulse.table) * _carrier(pulse, paths_m) * pulse.weights).sum(axis=2)
        used = samples.is_used[place]
        return cls(
            pulse=pulse,
            gain=beams.gain[row] if len(beams.gain) else None,
            slope_s=beams.slope_s[row] if len(beams.gain) else None,
            middle=beams.directions[row[0]],
            axes=axes,
            is_used=used,
            amplitude=samples.amplitude[place],
            offset_m=offset_m,
            range_m=range_m,
            lags_m=lags_m,
            noises=noises / np.sum(pulse.weights**2),
            noise=noise,
            scale=scale,
            freedom=max(1.0, used.sum() - (4.0 if axes[1].any() else 3.0)),
            tilt_s=float(samples.tilt_s[place]),
        )

    def minimum(self, start: Doubles, model: float) -> Doubles:
        """Return a minimum of the misfit by the method of Levenberg and Marquardt, with its misfit and covariance."""
        now = np.array(start, np.float64)
        best, slopes, rest = self._misfit(now, model)
        damping = DAMPING
        for _ in range(N_ROUNDS):
            normal = slopes.T @ slopes + self._prior
            step = _solved(normal + np.diag(damping * np.diag(normal) + TINY), slopes.T @ rest)
            if step is None:
                break
            tried, new_slopes, new_rest = self._misfit(now + step, model)
            if tried <= best:
                best, slopes, rest, now = tried, new_slopes, new_rest, now + step
                damping *= 0.1
            else:
                damping *= 10
            size = np.max(step**2 * np.diag(normal))
            if size < CONVERGED**2 * max(1.0, best / self.freedom) or damping > MAX_DAMPING:
                break
        covariance = _solved(slopes.T @ slopes + self._prior + np.diag(np.full(4, TINY)), np.eye(4))
        return np.concatenate([now, [best], np.full(16, np.inf) if covariance is None else covariance.ravel()])

    def misfit(self, at: Doubles, model: float) -> float:
        """Return the sum of the squared residuals in standard deviations."""
        return self._misfit(at, model)[0]

    @property
    def _prior(self) -> Doubles:
        return np.diag([0.0, WIDE_RAD**-2, WIDE_RAD**-2, 0.0])

    def _misfit(self, at: Doubles, model: float) -> tuple[float, Doubles, Doubles]:
        """Return the misfit, and whitened derivatives and residuals: (sample, 4) and (sample,) float64."""
        if not abs(at[3]) < MAX_NP:
            return math.inf, np.zeros((0, 4)), np.zeros(0)
        value, by_place = self._predicted(at)
        value, by_place = value[self.is_used], by_place[self.is_used]
        level, own = math.exp(at[3]), np.maximum(np.abs(value), DARK)
        mean = np.sqrt((level * own) ** 2 + RICE * self.noise**2)
        ratio = level**2 * own / mean
        slopes = np.column_stack([ratio[:, None] * (value.conj()[:, None] * by_place).real / own[:, None], ratio * own])
        unit = value / np.maximum(np.abs(value), TINY)
        noises = self.noises[np.ix_(self.is_used, self.is_used)]
        spread = 0.5 * self.noise**2 * (noises * unit.conj()[:, None] * unit).real
        try:
            root = np.linalg.cholesky(spread + 0.5 * (model * level) ** 2 * np.eye(len(own)))
        except np.linalg.LinAlgError:
            return math.inf, slopes, np.zeros(len(own))
        whole = np.linalg.solve(root, np.column_stack([slopes, self.amplitude[self.is_used] - mean]))
        return float(np.sum(whole[:, 4] ** 2) + at @ self._prior @ at), whole[:, :4], whole[:, 4]

    def _predicted(self, at: Doubles) -> tuple[Complexes, Complexes]:
        """Return means over microphones for an echo, (sample,), and their derivatives: (sample, 3) complex128."""
        pulse = self.pulse
        top = self.middle + at[1:3] @ self.axes
        size = float(np.linalg.norm(top))
        top = top / size
        own_m = _lags_m(pulse, top[None], np.array([max(self.range_m + at[0], LEAST_M)]))
        sides = ((self.axes - np.outer(self.axes @ top, top)) @ pulse.positions_m.T) / size
        path_m = self.scale * (2 * (self.offset_m - at[0])[:, None] + self.lags_m - own_m)
        table, tilted = (pulse_at(pulse, path_m, each) for each in (pulse.table, pulse.tilted_hz))
        table += self.tilt_s * tilted
        change = 1j * (pulse.carrier_1_m * table + 2 * math.pi / pulse.speed_m_s * tilted)
        if self.gain is not None and self.slope_s is not None:
            table, change = table * self.gain + self.slope_s * tilted, change * self.gain
        weight = _carrier(pulse, path_m) * pulse.weights / len(pulse.weights)
        change = self.scale * change * weight
        by_place = np.stack([-2 * change.sum(axis=1), change @ sides[0], change @ sides[1]], axis=1)
        return (table * weight).sum(axis=1), by_place


def _is_same(one: Doubles, other: Doubles) -> bool:
    """Return True if minima differ by less than a tenth of their standard deviations."""
    return bool(((one[:3] - other[:3]) ** 2 <= 0.01 * other[5:20:5][:3]).all())


def _combined(found: list[Doubles], best: Doubles) -> Doubles:
    """Return the lowest minimum, with the spread of all minima in its covariance."""
    shares = np.array([math.exp(0.5 * float(best[4] - each[4])) for each in found])
    away = np.array([each[:4] - best[:4] for each in found])
    spread = (away.T * shares / shares.sum()) @ away
    return np.concatenate([best[:5], best[5:] + spread.ravel()])


def _solved(matrix: Doubles, values: Doubles) -> Doubles | None:
    """Return the solution of a positive system; None if it is not positive."""
    try:
        np.linalg.cholesky(matrix)
        return np.asarray(np.linalg.solve(matrix, values), np.float64)
    except np.linalg.LinAlgError:
        return None


def _lags_m(pulse: Pulse, directions: Doubles, range_m: Doubles) -> Doubles:
    """Return paths from places to microphones minus their ranges; for ranges of 0, those from infinity."""
    along_m = directions @ pulse.positions_m.T
    at_m = range_m[:, None]
    square_m2 = np.sum(pulse.positions_m**2, axis=1) - 2 * at_m * along_m
    near_m = square_m2 / np.maximum(np.sqrt(np.maximum(at_m**2 + square_m2, 0.0)) + at_m, TINY)
    return np.where(at_m > 0, near_m, -along_m)


def _carrier(pulse: Pulse, path_m: Doubles) -> Complexes:
    return np.asarray(np.exp(1j * pulse.carrier_1_m * path_m))


def pulse_at(pulse: Pulse, path_m: Doubles, table: Complexes) -> Complexes:
    """Return values of a table at differences of paths."""
    # They are evenly spaced; `numpy.interp` would search for the place of each.
    place = np.minimum(np.abs(path_m) / pulse.step_m, len(table) - 1.0)
    before = np.minimum(place.astype(np.intp), len(table) - 2)
    found = table[before]
    found += (place - before) * (table[before + 1] - found)
    found.imag[path_m < 0] *= -1
    return np.asarray(found)
