"""Coverage of the uncertainties of points.

Single echoes at random positions in noise are detected for several budgets, direction grids and levels.
"""

import math
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ertis_bench import machine
from ertis_bench.machine import sentence
from ertis_bench.markdown import table
from ertis_numba import kernels
from ertis_numba.analysis.detect import find_peaks
from ertis_numba.chain import planner
from ertis_numba.chain.fast_chain import FastChain
from ertis_numba.frames import Energyscape
from ertis_numba.geometry import direction_grid, microphones, unit_vectors
from ertis_numba.geometry.air import absorption_db_m, sound_speed_m_s
from ertis_numba.geometry.waveform import call_at, matched_filter_spectrum
from ertis_numba.settings import Accuracy, Processing, Recording, Settings

__all__ = ["BUDGETS_DB", "FORMS", "GRIDS", "RATIOS", "Trials", "form", "run"]

GRIDS: Final = ("2d:31", "2d:181", "3d:300", "3d:600", "3d:3000")
BUDGETS_DB: Final = (-35.0, -20.0)
RATIOS: Final = (5.0, 30.0, 300.0)
"""Amplitudes of echoes relative to the root mean square of the image's noise."""

_RATE_HZ, _N_SAMPLES = 450_000.0, 4_096
_RANGE_DECIMATION = 10
_AMPLITUDE = 0.01


class Trials:
    """Echoes of points at random positions in noise, as spherical waves in air that absorbs, and their errors."""

    def __init__(self, directions: str, max_error_db: float) -> None:
        self._is_planar = directions.startswith("2d")
        limits_deg = Processing().elevation_limits_deg if self._is_planar else (-50.0, 50.0)
        processing = Processing(
            elevation_limits_deg=limits_deg,
            directions=directions,
            range_m=(0.6, 1.1),
            azimuth_limits_deg=(-70.0, 70.0),
            range_decimation=_RANGE_DECIMATION,
        )
        recording = Recording(sample_rate_hz=_RATE_HZ, n_samples=_N_SAMPLES, encoding="float32")
        settings = Settings(
            recording=recording,
            processing=processing.replace(wavefront="plane"),
            accuracy=Accuracy(max_error_db=max_error_db),
        )
        device = kernels.load("cpu")
        self._settings = planner.complete(settings, device, threads=1)
        self._chain = FastChain(self._settings, device, threads=1)
        self._grid = direction_grid(self._settings.processing)
        self._positions_m = microphones(self._settings.array).enabled_positions_m
        self._speed_m_s = sound_speed_m_s(self._settings.air)
        self._time_s = np.arange(_N_SAMPLES) / _RATE_HZ
        noise = self._image(np.random.default_rng(99).standard_normal((len(self._positions_m), _N_SAMPLES)))
        self._noise = self._image(self._echo(np.array([1.0, 0.0, 0.0]), 0.85)).max() / math.sqrt(np.mean(noise**2))

    def standardised_errors(self, ratio: float, count: int, seed: int) -> NDArray[np.float64]:
        """Return errors along range, across it and of the level, in reported standard deviations: (point, 3)."""
        rng = np.random.default_rng(seed)
        return np.array([self._standardised_error(ratio, rng) for _ in range(count)])

    def _standardised_error(self, ratio: float, rng: np.random.Generator) -> NDArray[np.float64]:
        azimuth_rad = np.radians(rng.uniform(-60, 60, size=1))
        elevation_rad = np.zeros(1) if self._is_planar else np.radians(rng.uniform(-35, 35, size=1))
        range_m = rng.uniform(0.7, 1.0)
        (direction,) = unit_vectors(azimuth_rad, elevation_rad)
        heard = self._echo(direction, range_m)
        amplitudes = self._image(heard + self._noise / ratio * rng.standard_normal(heard.shape))
        grid = self._grid
        image = Energyscape(
            amplitudes.astype(np.float32), grid.azimuth_rad, grid.elevation_rad, self._chain.range_m, self._settings
        )
        (peak,) = find_peaks(image, top=1, false_alarm=None)
        found = unit_vectors(np.array([peak.azimuth_rad]), np.array([peak.elevation_rad]))[0]
        across_rad = float(found @ self._min_resolved(azimuth_rad, elevation_rad))
        level_db = peak.level_dbfs - 20 * math.log10(_AMPLITUDE)
        return np.array(
            [
                (peak.range_m - range_m) / peak.range_sd_m,
                math.degrees(across_rad) / peak.angle_sd_deg,
                level_db / peak.level_sd_db,
            ]
        )

    def _min_resolved(
        self, azimuth_rad: NDArray[np.float64], elevation_rad: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the unit vector across the line of sight along which the array extends least."""
        sideways = unit_vectors(azimuth_rad + math.pi / 2, np.zeros(1))
        if self._is_planar:
            return np.asarray(sideways[0])
        across = np.concatenate([sideways, unit_vectors(azimuth_rad, elevation_rad + math.pi / 2)])
        _, vectors = np.linalg.eigh(np.cov(across @ self._positions_m.T))
        return np.asarray(vectors[:, 0] @ across)

    def _image(self, signals: NDArray[np.float64]) -> NDArray[np.float64]:
        out = self._chain.new_image()
        self._chain.process_signals(_AMPLITUDE * signals, out)
        return out.astype(np.float64)

    def _echo(self, direction: NDArray[np.float64], range_m: float) -> NDArray[np.float64]:
        paths_m = range_m + np.linalg.norm(range_m * direction - self._positions_m, axis=1)
        delays_s = paths_m / self._speed_m_s
        heard = np.array([call_at(self._settings.call, self._time_s - delay_s) for delay_s in delays_s])
        frequency_hz = np.linspace(0, _RATE_HZ / 2, _N_SAMPLES // 2 + 1)
        loss_1_m = absorption_db_m(self._settings.air, frequency_hz) * math.log(10) / 20
        matched = matched_filter_spectrum(self._settings, n_fft=_N_SAMPLES // self._settings.decimation)
        of_call = slice(matched.first_bin, matched.first_bin + len(matched.values))
        level = np.average(np.exp(-2 * range_m * loss_1_m[of_call]), weights=matched.echo_power)
        bins = np.fft.rfft(heard) * np.exp(-paths_m[:, None] * loss_1_m)
        return np.asarray(np.fft.irfft(bins, _N_SAMPLES) / level)


def run(*, count: int, seed: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Measure the share of ``count`` points within their uncertainty, for each grid, budget and level."""
    rows = []
    for directions in GRIDS:
        for budget_db in BUDGETS_DB:
            trials = Trials(directions, budget_db)
            for ratio in RATIOS:
                errors = np.abs(trials.standardised_errors(ratio, count, seed))
                row = {
                    "directions": directions,
                    "budget_db": budget_db,
                    "ratio": ratio,
                    "within": np.mean(errors < 1, axis=0).tolist(),
                    "beyond": np.mean(errors > 4, axis=0).tolist(),
                    "rms": np.sqrt(np.mean(errors**2, axis=0)).tolist(),
                    "largest": np.max(errors, axis=0).tolist(),
                }
                rows.append(row)
                say(f"{directions}, {budget_db:g} dB, {ratio:g}: " + ", ".join(f"{each:.0%}" for each in row["within"]))
    return {"machine": machine.describe(), "count": count, "seed": seed, "rows": rows}


def form(report: dict[str, Any]) -> str:
    """Return the report as Markdown."""
    header = ["grid", "budget", *(f"echo / noise {ratio:g}" for ratio in RATIOS)]
    cells = {(row["directions"], row["budget_db"], row["ratio"]): row for row in report["rows"]}
    lines = [
        [f"`{directions}`", f"{budget_db:g} dB", *(_cell(cells[directions, budget_db, ratio]) for ratio in RATIOS)]
        for directions in GRIDS
        for budget_db in BUDGETS_DB
    ]
    deviation = 100 * math.sqrt(0.6827 * 0.3173 / report["count"])
    return (
        f"{table(header, lines)}\n\nShares of points within one standard deviation: range / direction / level; in "
        f"parentheses, the largest errors in standard deviations. Each cell has {report['count']} points, from seed "
        f"{report['seed']}, so the standard deviation of a share is {deviation:.0f} percentage points. "
        f"{sentence(report['machine'])}"
    )


def _cell(row: dict[str, Any]) -> str:
    shares = " / ".join(f"{within:.0%}" for within in row["within"])
    return f"{shares} ({' / '.join(f'{largest:.1f}' for largest in row['largest'])})"


FORMS = {"points": form}
"""Forms of the table, by the name in its markers."""
