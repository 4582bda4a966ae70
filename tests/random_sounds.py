"""Random arrays, grids, acoustic maps and images, rendered in double precision by NumPy alone."""

import math

import numpy as np

from ertis_numba.frames import AcousticMap, Energyscape
from ertis_numba.geometry import direction_grid, layout_names, load_layout, unit_vectors
from ertis_numba.settings import Array, Passive, Processing, Settings

C_M_S = 343.2
NO_DIAGONAL = ("delay_and_sum", "clean_sc", "hr_clean_sc")  # Others need the powers of single microphones.
METHODS = ("delay_and_sum", "functional", "capon", "music", "clean_sc", "hr_clean_sc")
BEAMFORMERS = (
    ("delay_and_sum", "none"),
    ("delay_and_sum", "coherence_factor"),
    *((f"dmas:{order}", "none") for order in (2, 3, 5, 8)),
    ("capon", "none"),
)


def random_array(rng, largest=32):
    """Positions in metres, (mic, axis), or the name of a layout: discs, clusters, planes, lines, from 2 cm to 3 m."""
    kind = rng.choice(["layout", "disc", "volume", "line", "ring"])
    if kind == "layout":
        return str(rng.choice(layout_names()))
    count, half_m = int(rng.integers(3 if kind != "line" else 2, largest + 1)), 0.5 * 10 ** rng.uniform(-1.7, 0.477)
    turn = np.arange(count) * 2.399963
    if kind == "disc":
        radius = np.sqrt((np.arange(count) + 0.5) / count)
        places = np.stack([0 * turn, radius * np.cos(turn), radius * np.sin(turn)], axis=1)
    elif kind == "ring":
        places = np.stack([0 * turn, np.cos(turn), np.sin(turn)], axis=1)
    elif kind == "line":
        places = np.linspace(-1, 1, count)[:, None] * np.eye(3)[rng.integers(3)]
    else:
        places = rng.uniform(-1, 1, (count, 3))
    return np.round(half_m * places, 6)


def random_directions(rng, most):
    """Settings of directions: a grid with random limits, at times narrow or flat, or a list of directions."""
    count = int(50 * (most / 50) ** rng.uniform(0, 1))
    azimuth, elevation = np.sort(rng.uniform(-180, 180, 2)), np.sort(rng.uniform(-90, 90, 2))
    shape = rng.choice(["free", "narrow", "row", "column", "half", "list", "few"])
    if shape == "narrow":
        azimuth, elevation = (rng.uniform(-60, 60) + np.array([0, size]) for size in rng.uniform(0.5, 25, 2))
    elif shape == "row":
        elevation = elevation[[0, 0]] + np.array([0, 0.01])
    elif shape == "column":
        azimuth = azimuth[[0, 0]] + np.array([0, 0.01])
    elif shape == "half":
        azimuth, elevation = np.array([-90, 90]), np.array([-90, 90])
    elif shape in ("list", "few"):
        n_listed = int(rng.integers(1, 5)) if shape == "few" else min(count, 800)
        listed = np.stack([rng.uniform(-180, 180, n_listed), rng.uniform(-90, 90, n_listed)], axis=1)
        listed = np.concatenate([listed, listed[: n_listed // 9]])  # A list may repeat directions.
        return {"directions": tuple(map(tuple, np.round(listed, 3).tolist()))}
    return {
        "directions": f"{rng.choice(['2d', '3d', '3d'])}:{count}",
        "azimuth_limits_deg": tuple(np.round(azimuth, 3).tolist()),
        "elevation_limits_deg": tuple(np.round(elevation, 3).tolist()),
        "elevation_deg": float(round(rng.choice([0.0, rng.uniform(-85, 85)]), 3)),
    }


def random_sources(rng, directions):
    """Unit vectors of up to three sources: in the grid, near its edge, or anywhere."""
    out = []
    for _ in range(rng.integers(0, 4)):
        towards = directions[rng.integers(len(directions))] + rng.choice([0, 0.02, 3.0]) * rng.standard_normal(3)
        out.append(towards / np.linalg.norm(towards))
    return np.array(out).reshape(-1, 3)


def settings_of(array, directions, **processing):
    chosen = Array(layout=array) if isinstance(array, str) else Array(positions_m=tuple(map(tuple, array.tolist())))
    return Settings(array=chosen, processing=Processing(**directions, **processing))


def positions_m(array):
    if isinstance(array, str):
        layout = load_layout(array)
        return layout.enabled_positions_m
    return array - array.mean(axis=0)


def random_map(seed, most=2000):
    """An acoustic map of one or two bands: of sources, noise, or silence, by a random method."""
    rng = np.random.default_rng([1, seed])
    array, method = random_array(rng), str(rng.choice(METHODS))
    places_m = positions_m(array)
    settings = settings_of(array, random_directions(rng, most))
    order, removed = float(rng.choice([1, 2, 8, 20])), bool(rng.integers(2)) and method in NO_DIAGONAL
    passive = Passive(method=method, functional_order=order, diagonal_removal=removed)
    settings = settings.replace(passive=passive)
    grid = direction_grid(settings.processing)
    directions = unit_vectors(grid.azimuth_rad, grid.elevation_rad)
    sources, noise = random_sources(rng, directions), 10 ** rng.uniform(-6, 0) * rng.choice([0, 1, 1, 1])
    bands = []
    edges_hz = np.sort(10 ** rng.uniform(3, 4.9, 4)).reshape(2, 2)[: rng.integers(1, 3)]
    levels = 10 ** rng.uniform(-3, 0, len(sources))
    for low_hz, high_hz in edges_hz:
        band = 0.0
        for frequency_hz in np.linspace(low_hz, high_hz, 3):
            wave = 2 * math.pi * frequency_hz / C_M_S
            heard = np.exp(1j * wave * places_m @ sources.T) * levels
            own = rng.standard_normal((len(places_m), 40, 2)).view(complex)[..., 0] * noise
            matrix = heard @ heard.conj().T + own @ own.conj().T / 40
            band = band + map_power(np.exp(1j * wave * directions @ places_m.T), matrix, method, order, removed=removed)
        bands.append(band)
    return AcousticMap(
        np.stack(bands, axis=1).astype(np.float32), grid.azimuth_rad, grid.elevation_rad, edges_hz, settings
    )


def map_power(waves, matrix, method, order, *, removed):
    """Power of a matrix for each wave: (direction,) float64."""
    n_mics = len(matrix)
    load = 1e-6 * np.trace(matrix).real / n_mics + 1e-30
    values, vectors = np.linalg.eigh(matrix)
    if method == "functional":
        roots = (vectors * np.maximum(values, 0) ** (1 / order)) @ vectors.conj().T
        return np.maximum(form(waves, roots) / n_mics, 0) ** order / n_mics
    if method == "capon":
        return 1 / np.maximum(form(waves, np.linalg.inv(matrix + load * np.eye(n_mics))), 1e-30)
    if method == "music":
        return 1 / np.maximum(1 - form(waves, vectors[:, -1:] @ vectors[:, -1:].conj().T) / n_mics, 1e-6)
    if method == "delay_and_sum":
        kept = 1 - np.eye(n_mics) if removed else 1.0
        return np.maximum(form(waves, matrix * kept), 0) / (n_mics**2 - n_mics if removed else n_mics**2)
    out, rest = np.zeros(len(waves)), matrix.copy()
    for _ in range(8):
        power = form(waves, rest) / n_mics**2
        place = int(power.argmax())
        if not power[place] > 1e-12:
            break
        sound = rest @ waves[place] / (n_mics * math.sqrt(power[place]))
        rest = rest - np.outer(sound, sound.conj())
        out[place] += power[place]
    return out


def form(waves, matrix):
    return np.einsum("di,di->d", waves.conj() @ matrix, waves).real


def random_image(seed, most=600, n_ranges=None):
    """An image of echoes, noise, or silence, with a random beamformer; by default of up to 19 ranges."""
    rng = np.random.default_rng([2, seed])
    array, (beamformer, weighting) = random_array(rng, largest=12), BEAMFORMERS[rng.integers(len(BEAMFORMERS))]
    places_m = positions_m(array)
    beamformer, _, order = beamformer.partition(":")
    if len(places_m) < int(order or 1):
        beamformer, order = "delay_and_sum", ""
    processing = {"beamformer": beamformer, "weighting": weighting, "method": "fast"}
    if (beamformer, weighting) == ("delay_and_sum", "none"):
        processing["method"] = str(rng.choice(["fast", "paper"]))
    if order:
        processing["dmas_order"] = int(order)
    settings = settings_of(array, random_directions(rng, most), **processing)
    grid = direction_grid(settings.processing)
    directions = unit_vectors(grid.azimuth_rad, grid.elevation_rad)
    range_m = 1.0 + np.arange(n_ranges or int(rng.integers(1, 20))) * float(rng.choice([2e-3, 4e-3]))
    wave_1_m = 2 * math.pi * np.linspace(25e3, 50e3, 12) / C_M_S
    heard = 10 ** rng.uniform(-6, -1) * rng.choice([0, 1, 1]) * complex_normal(rng, len(directions), len(range_m), 1)
    signals = np.repeat(heard, len(places_m), axis=2) + heard.any() * 1e-3 * complex_normal(rng, 1, 1, len(places_m))
    for towards in random_sources(rng, directions):
        away_m = 2 * (range_m[:, None] - rng.choice(range_m) + rng.uniform(-2e-3, 2e-3))
        path_m = away_m - ((directions - towards) @ places_m.T)[:, None]
        signals = signals + rng.uniform(0.1, 1) * np.exp(1j * path_m[..., None] * wave_1_m).mean(axis=3)
    amplitude = combined(signals, beamformer, int(order or 1), weighting)
    return Energyscape(amplitude.astype(np.float32), grid.azimuth_rad, grid.elevation_rad, range_m, settings)


def complex_normal(rng, *shape):
    return rng.standard_normal((*shape, 2)).view(complex)[..., 0]


def combined(signals, beamformer, order, weighting):
    """Amplitude of each bin from the signals of microphones, (direction, range, mic)."""
    n_mics = signals.shape[2]
    beam = np.abs(signals.mean(axis=2))
    power = (np.abs(signals) ** 2).mean(axis=2)
    coherence = np.divide(beam**2, power, out=np.zeros_like(power), where=power > 0)
    if beamformer == "dmas":
        roots = np.abs(signals) ** (1 / order) * np.exp(1j * np.angle(signals))
        sums = [1.0 + 0j, *[0j] * order]
        for mic in range(n_mics):
            for k in range(order, 0, -1):
                sums[k] = sums[k] + sums[k - 1] * roots[..., mic]
        beam = np.abs(sums[order]) / math.comb(n_mics, order)
    elif beamformer == "capon":  # With one snapshot, the loaded matrix has a closed form.
        beam = beam * coherence / (1 + n_mics * (1 - coherence))
    return beam * coherence if weighting == "coherence_factor" else beam
