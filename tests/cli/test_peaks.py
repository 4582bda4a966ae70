"""``ertis peaks`` with either detector."""

import json
import math

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli import options
from ertis_cli.main import cli

import ertis_numba as ertis
from ertis_numba.analysis.cfar import cfar_peaks
from ertis_numba.storage import open_energyscapes, write_energyscapes
from tests.files import image


def run(*arguments, code=0):
    done = CliRunner().invoke(cli, [str(argument) for argument in arguments])
    assert done.exit_code == code, (done.stderr, done.exception)
    return done


@pytest.fixture
def images(tmp_path):
    given = image()
    amplitude = given.amplitude.copy()
    amplitude[5, 300] = 0.012  # 32 dB below the strongest, 12 dB above the noise
    return write_energyscapes(tmp_path / "img.h5", [given.replace(amplitude=amplitude)])


def test_cfar_finds_weak_reflectors(images):
    found = json.loads(run("peaks", images, "--detector", "cfar", "--json").stdout)["peaks"]
    assert min(peak["level_db"] for peak in found) < -30
    with open_energyscapes(images) as file:
        wanted = cfar_peaks(file[0], false_alarm=1e-4)
        weak = np.degrees(file[0].azimuth_rad[5]), file[0].range_m[300]
    assert [peak["range_m"] for peak in found] == [round(peak.range_m, 6) for peak in wanted]
    assert any(peak["range_m"] == pytest.approx(weak[1], abs=0.02) for peak in found)
    plain = json.loads(run("peaks", images, "--json").stdout)["peaks"]
    assert min(peak["level_db"] for peak in plain) >= -30


def test_cfar_options_change_the_peaks(images):
    limited = json.loads(run("peaks", images, "--detector", "cfar", "--min-level", -20, "--json").stdout)["peaks"]
    assert len(limited) == 1
    counts = [
        len(
            json.loads(run("peaks", images, "--detector", "cfar", "--top", 999, "--false-alarm", p, "--json").stdout)[
                "peaks"
            ]
        )
        for p in (1e-5, 1e-2)
    ]
    assert counts[0] < counts[1]


@pytest.mark.parametrize(
    ("options", "code", "match"),
    [
        ("--false-alarm 1e-3", 2, "--false-alarm needs --detector cfar; add it"),
        ("--detector cfar --truth", 2, "--truth needs --detector peaks; remove --truth or"),
        ("--detector cfar --false-alarm 2", 2, "--false-alarm is 2; use a number from 1e-09 to 0.5"),
    ],
)
def test_peaks_refuses_invalid_input(images, options, code, match):
    assert match in run("peaks", images, *options.split(), code=code).stderr


def test_note_on_interference_holds_for_any_array_and_sound(capsys):
    """Errors of the array mark broadband sources of 32 microphones, too."""
    bearing = ertis.Bearing(
        azimuth_deg=10.0,
        elevation_deg=0.0,
        sideways_deg=0.1,
        upwards_deg=0.1,
        correlation=0.0,
        band_hz=(38e3, 42e3),
        level_dbfs=-40.0,
        snr_db=10.0,
        may_be_interference=True,
    )
    assert options.note_doubts("s", [bearing])
    text = capsys.readouterr().err
    assert "random phases" in text
    assert "tone" not in text
    assert "few microphones" not in text


def test_unknown_directions_of_sources_have_a_note(capsys):
    unknown = ertis.Bearing(
        azimuth_deg=math.nan,
        elevation_deg=math.nan,
        sideways_deg=math.inf,
        upwards_deg=math.inf,
        correlation=0.0,
        band_hz=(38e3, 42e3),
        level_dbfs=-40.0,
        snr_db=10.0,
    )
    assert options.note_doubts("s", [unknown])
    assert "the direction of 1 source is unknown" in capsys.readouterr().err
