"""Images as arrays, settings paths, argument checks, and noise thresholds of peaks."""

import functools
import json

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

import ertis_numba as ertis
from ertis_numba.analysis.noise import medians_of, noise_of, threshold_of
from ertis_numba.simulation import Point
from ertis_numba.simulation.render import Simulator
from tests.hard_cases.forced import EIGHT
from tests.scenes import only, scene_of

SETTINGS = EIGHT.settings()


@functools.cache
def quiet(*points):
    """An image of points without noise."""
    measurement = Simulator(scene_of(*points, sensor=EIGHT), plan=only("spreading")).render()
    return ertis.Pipeline(SETTINGS, predict=False).process(measurement)


def image(*points, noise_dbfs=-60.0, seed=0):
    """An image of points with white noise in every beam."""
    made = quiet(*points)
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(2, *made.amplitude.shape)) * 10 ** (noise_dbfs / 20) / np.sqrt(2)
    return made.replace(amplitude=np.hypot(made.amplitude + noise[0], noise[1]).astype(np.float32))


def test_energyscape_converts_to_an_array():
    shown = image(Point(range_m=0.5))
    assert np.array_equal(np.asarray(shown), shown.amplitude)
    assert np.asarray(shown, dtype=np.float64).dtype == np.float64
    assert np.max(shown) == shown.amplitude.max()


def test_pipeline_accepts_a_settings_path(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(SETTINGS.to_toml(), "utf-8")
    assert ertis.Pipeline(path).settings == ertis.Pipeline(SETTINGS).settings == ertis.Pipeline(str(path)).settings


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda _: ertis.Pipeline(7), "settings is of type int; pass Settings,"),
        (lambda _: ertis.Pipeline(None), "settings is of type NoneType; pass Settings,"),
        (lambda _: ertis.Pipeline("missing.toml"), "missing.toml"),
        (lambda shown: ertis.find_peaks(shown.amplitude), "image is of type ndarray; pass an "),
        (lambda shown: ertis.find_peaks(shown, false_alarm=2), "false_alarm is 2"),
        (lambda shown: shown.replace(amplitude=shown.amplitude[:, 1:]), r"amplitude has shape \(91, \d+\); pass shape"),
        (lambda shown: shown.replace(elevation_rad=np.zeros(3)), r"elevation_rad has shape \(3,\); pass shape \(91,\)"),
        (
            lambda shown: shown.replace(amplitdue=shown.amplitude),
            r"an image has no field 'amplitdue' \(did you mean 'amplitude'\?\); choose from amplitude",
        ),
    ],
)
def test_wrong_argument_types_are_refused_in_one_line(call, message):
    with pytest.raises(ertis.ErtisError, match=message) as caught:
        call(image(Point(range_m=0.5)))
    assert "\n" not in str(caught.value)


def test_find_peaks_with_false_alarm_rejects_noise_only():
    for seed in range(20):
        assert ertis.find_peaks(image(seed=seed), false_alarm=1e-3) == []
        assert len(ertis.find_peaks(image(seed=seed), false_alarm=None)) > 3
    shown = image(Point(range_m=0.5), Point(range_m=0.7, azimuth_deg=30.0))
    peaks = ertis.find_peaks(shown, false_alarm=1e-3, min_level_db=-20)
    assert [round(peak.range_m, 2) for peak in peaks] == [0.5, 0.7]
    assert peaks[0].level_dbfs == pytest.approx(20 * np.log10(shown.amplitude.max()), abs=1)
    assert peaks[1].level_dbfs - peaks[0].level_dbfs == pytest.approx(peaks[1].level_db)


@pytest.mark.parametrize("count", [1, 2, 7, 100])
def test_medians_equal_those_of_numpy(count):
    rows = np.random.default_rng(count).rayleigh(size=(9, count)).astype(np.float32)
    rows[3, 0] = np.nan
    np.testing.assert_array_equal(medians_of(rows), np.median(rows, axis=1))


def test_noise_of_image_is_its_root_mean_square():
    shown = image(noise_dbfs=-40.0)
    assert 20 * np.log10(noise_of(shown)) == pytest.approx(-40, abs=0.3)
    n_bins = shown.amplitude.size
    exceeded = np.mean(shown.amplitude > threshold_of(shown, n_bins * 1e-2 if n_bins * 1e-2 < 1 else 1.0))
    assert exceeded < 1e-3


def test_peaks_command_lists_dbfs_levels_or_nothing_found(tmp_path):
    found, silent = tmp_path / "found.h5", tmp_path / "silent.h5"
    ertis.write_energyscapes(found, [image(Point(range_m=0.5))])
    ertis.write_energyscapes(silent, [image()])
    runner = CliRunner()
    reported = runner.invoke(cli, ["peaks", str(found)])
    columns = reported.stdout.splitlines()[0].split()
    assert columns[-4:] == ["level_dbfs", "angle_sd_deg", "range_sd_m", "level_sd_db"]
    reported = runner.invoke(cli, ["peaks", str(silent)])
    assert (reported.exit_code, reported.stdout, reported.stderr.splitlines()[-1]) == (0, "", "nothing found")
    assert json.loads(runner.invoke(cli, ["peaks", str(silent), "--json"]).stdout)["peaks"] == []
    listed = json.loads(runner.invoke(cli, ["peaks", str(silent), "--all", "--json"]).stdout)["peaks"]
    assert len(listed) > 3
    assert runner.invoke(cli, ["peaks", str(silent), "--all", "--truth"]).exit_code == 2
