"""High-resolution CLEAN-SC: equal to its equations in float64, and able to separate sources within one main lobe."""

import numpy as np
import pytest
from ertis_bench.passive import separation
from ertis_bench.passive.sound_signals import NoiseSource, listening, noise

from ertis_numba.passive import AcousticCamera
from ertis_numba.passive.high_resolution import HighResolutionClean
from tests.on_device import KERNELS

DEVICES = [name for name in KERNELS if not KERNELS[name].simulated]


def camera_of(device="cpu", *, method="hr_clean_sc", **changes):
    return AcousticCamera(
        listening(processing__directions="2d:181", passive__bands_hz=[[39e3, 41e3]], passive__method=method, **changes),
        device,
        1,
    )


def heard(camera, sources, seed=0):
    """Return noise from azimuths in degrees with RMS values; that of the microphones has an RMS value of 0.01."""
    places = [NoiseSource(azimuth_deg, 0.0, rms) for azimuth_deg, rms in sources]
    return noise(camera.settings, places, own_rms=0.01, seed=seed)


def form(matrix, waves):
    return np.einsum("id,ij,jd->d", waves.conj(), matrix, waves, optimize=True).real


class Reference:
    """Sources of one bin, step by step in float64."""

    def __init__(self, matrix, waves, *, hollow):
        n_mics = len(matrix)
        self.waves, self.hollow = waves, hollow
        self.kept = np.ones((n_mics, n_mics)) - hollow * np.eye(n_mics)
        self.norm = self.kept.sum()
        self.matrix = matrix * self.kept
        self.rest, self.places, self.powers = self.matrix, [], []
        while len(self.places) < 4:
            power = form(self.rest, waves) / self.norm
            if power.max() <= max([0, *(0.01 * each for each in self.powers)]):
                break
            self.places, self.powers = [*self.places, int(power.argmax())], [*self.powers, power.max()]
            self.sweep()
        for _ in range(5):
            before = self.places
            self.sweep()
            if self.places == before:
                break

    def sweep(self):
        """Choose all markers again, and find the components of all sources."""
        self.rest, places, powers = self.matrix, list(self.places), [0.0] * len(self.places)
        for source in np.argsort(-np.array(self.powers), kind="stable"):
            component, power = self.component(self.marker(source))
            shared = power * np.outer(component, component.conj()) * self.kept
            heard_there = form(shared, self.waves) / self.norm
            places[source], powers[source] = int(heard_there.argmax()), heard_there.max()
            self.rest = self.rest - shared
        self.places, self.powers = places, powers

    def marker(self, source):
        """Return the direction within the main lobe where the others have the least share."""
        here = self.waves[:, self.places[source]]
        others = [k for k in range(len(self.places)) if k != source]
        if not others:
            return self.places[source]
        disturbance = np.zeros_like(self.waves)
        for k in others:
            wave = self.waves[:, self.places[k]]
            disturbance += self.powers[k] * np.outer(wave, wave.conj() @ self.waves)
        seen = np.abs(here.conj() @ self.waves) ** 2
        share = (np.abs(disturbance) ** 2).sum(axis=0) / np.maximum(seen, 1e-9)
        share[seen < 0.25 * len(here) ** 2] = np.inf
        return int(share.argmin())

    def component(self, marker):
        weights = self.waves[:, marker] / np.sqrt(self.norm)
        power = max(0.0, (weights.conj() @ self.rest @ weights).real)
        seen = component = self.rest @ weights / (power or 1)
        for _ in range(100 if self.hollow else 0):
            own = np.abs(component) ** 2
            component = (seen + own * weights) / np.sqrt(1 + own.sum() / self.norm)
        return component, power


@pytest.mark.parametrize("hollow", [False, True])
@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("sources", [[(20, 0.1)], [(-3, 0.1), (2, 0.07)], [(10, 0.1), (14.5, 0.05), (-40, 0.1)]])
def test_components_equal_their_equations(device, hollow, sources):
    with camera_of(device) as camera:
        camera.add(heard(camera, sources))
        matrices = camera.cross_spectrum().matrix.astype(complex)
        found, rest = HighResolutionClean(matrices, camera.waves, hollow=hollow)()
        bins, directions = np.arange(len(matrices)), np.arange(len(camera.grid))
        waves = camera.waves.vectors(bins[:, None], directions).transpose(0, 2, 1)
    for k, matrix in enumerate(matrices):
        expected = Reference(matrix, waves[k], hollow=hollow)
        powers = np.zeros(len(directions))
        np.add.at(powers, expected.places, expected.powers)
        assert found[k] == pytest.approx(powers, abs=1e-3 * powers.max())
        assert np.abs(rest[k] - expected.rest).max() < 1e-3 * np.abs(matrix).max()


@pytest.mark.parametrize("weaker_db", [0, 10])
@pytest.mark.parametrize("diagonal_removal", [False, True])
def test_sources_within_one_main_lobe_have_their_directions_and_levels(diagonal_removal, weaker_db):
    sources = [(-3, 0.1), (2, 0.1 * 10 ** (-weaker_db / 20))]
    found = {}
    for method in ("clean_sc", "hr_clean_sc"):
        with camera_of(method=method, passive__diagonal_removal=diagonal_removal) as camera:
            for seed in range(4):
                camera.add(heard(camera, sources, seed))
            found[method], azimuth_deg = camera.map().power[:, 0], np.degrees(camera.grid.azimuth_rad)
    true_deg = [each for each, _ in sources]
    assert separation.are_separated(found["hr_clean_sc"], azimuth_deg, true_deg)
    if not weaker_db:  # a map of delay-and-sum has its maximum between equal sources
        assert not separation.are_separated(found["clean_sc"], azimuth_deg, true_deg)
    for each_deg, rms in sources:
        level_db = 10 * np.log10(found["hr_clean_sc"][np.abs(azimuth_deg - each_deg) <= 2].sum())
        share = 2e3 / (camera.settings.recording.sample_rate_hz / 2)
        assert level_db == pytest.approx(10 * np.log10(rms**2 * share), abs=1.5)


def test_single_source_has_one_maximum():
    with camera_of() as camera:
        camera.add(heard(camera, [(12, 0.1)]))
        power = camera.powers()
    assert np.degrees(camera.grid.azimuth_rad)[power.argmax(axis=1)] == pytest.approx(12)
    assert (np.sort(power, axis=1)[:, -2] < 0.02 * power.max(axis=1)).all()


def test_source_at_60_deg_is_not_split_in_narrow_bins():
    """In wide bins, its sound takes a considerable part of a block to cross the array, and is not coherent."""
    spurious_db = {}
    for spacing_hz in (1000.0, 250.0):
        with camera_of(passive__resolution_hz=spacing_hz) as camera:
            camera.add(heard(camera, [(60, 0.1)]))
            power, off_deg = camera.map().power[:, 0], np.abs(np.degrees(camera.grid.azimuth_rad) - 60)
        spurious_db[spacing_hz] = 10 * np.log10(power[off_deg > 3].max() / power[off_deg < 1.5].sum())
    assert spurious_db[250.0] < -30
    assert spurious_db[250.0] < spurious_db[1000.0] - 10


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_map_without_positive_powers_has_no_sources(value):
    with camera_of() as camera:
        shape = (len(camera.frequency_hz), 32, 32)
        found, _ = HighResolutionClean(np.full(shape, value, complex), camera.waves, hollow=False)()
    assert not found.any()
