"""NaN and infinities, refused by name in every numeric option, and values at the limits, which are accepted."""

import math

import mpmath
import numpy as np
import pytest

from ertis_numba.analysis.detect import find_peaks
from ertis_numba.base.errors import ArgumentError, SettingsError
from ertis_numba.frames import Measurement
from ertis_numba.geometry import direction_grid, load_layout
from ertis_numba.geometry.air import absorption_db_m, sound_speed_m_s
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Air, Array, Processing, Settings
from ertis_numba.simulation import Point
from tests.cases import SHORT
from tests.hard_cases.echoes import echo_words
from tests.hard_cases.forced import EIGHT, image_of
from tests.scenes import scene_of

FULL = Settings(
    array=Array(positions_m=((0.0, 0.0, 0.0), (0.0, 0.01, 0.0)), gain=(1.0, 2.0), delay_s=(0.0, 1e-6), word_bits=8),
    processing=Processing(decimation=20),
)
SECTIONS = Settings.__struct_fields__
NO_NUMBERS = [math.nan, math.inf, -math.inf]
CORNERS = [(temperature_c, humidity) for temperature_c in (-40.0, 0.0, 60.0) for humidity in (0.0, 100.0)]


def is_number(value):
    return isinstance(value, int | float) and not isinstance(value, bool)


def spoiled(value, bad):
    """Yield copies of a number or of nested tuples of numbers, each with one number replaced."""
    if is_number(value):
        yield bad
    elif isinstance(value, tuple):
        for place, part in enumerate(value):
            for copy in spoiled(part, bad):
                yield (*value[:place], copy, *value[place + 1 :])


PLACES = [
    (section, field)
    for section in SECTIONS
    for field in getattr(FULL, section).__struct_fields__
    if any(True for _ in spoiled(getattr(getattr(FULL, section), field), math.nan))
]


def test_tested_places_cover_every_kind_of_number():
    assert len(PLACES) >= 20
    assert {("array", "gain"), ("array", "positions_m"), ("processing", "range_m"), ("air", "pressure_pa")} < {*PLACES}
    assert {section for section, _ in PLACES} == {*SECTIONS}


@pytest.mark.parametrize("bad", NO_NUMBERS)
@pytest.mark.parametrize(("section", "field"), PLACES)
def test_settings_refuse_nan_and_infinity(section, field, bad):
    part = getattr(FULL, section)
    for value in spoiled(getattr(part, field), bad):
        with pytest.raises(
            ArgumentError,
            match=rf"{section}\.{field}.* (is |holds |.){bad}.*; ((pass|use) (a|finite|whole)|choose|known are) ",
        ) as caught:
            part.replace(**{field: value})
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("bad", ["nan", "inf", "-inf"])
@pytest.mark.parametrize(("section", "field"), PLACES)
def test_settings_files_refuse_nan_and_infinity(section, field, bad):
    """TOML has literals for NaN and infinities."""
    if isinstance(getattr(getattr(FULL, section), field), tuple):
        given = str(next(spoiled(getattr(getattr(FULL, section), field), math.nan)))
        given = given.replace("(", "[").replace(")", "]").replace("nan", bad)
    else:
        given = bad
    others = "" if field == "positions_m" or section != "array" else "positions_m = [[0, 0, 0], [0, 0.01, 0]]\n"
    with pytest.raises(SettingsError, match=rf"{section}\.{field}") as caught:
        Settings.from_toml(f"[{section}]\n{others}{field} = {given}\n", "s")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("bad", ["inf", "-inf", "1e999", "nan"])
@pytest.mark.parametrize("suffix", ["csv", "toml"])
def test_layout_files_refuse_nan_and_infinity(tmp_path, bad, suffix):
    path = tmp_path / f"l.{suffix}"
    path.write_text(f"0, 0\n1, {bad}\n" if suffix == "csv" else f"positions_mm = [[0, 0], [1, {bad}]]\n")
    fault = "line 2: z is " if suffix == "csv" else r"positions_mm holds -?(nan|inf) at \[1, 2\]"
    with pytest.raises(ArgumentError, match=rf"l\.{suffix}.*{fault}.*finite"):
        load_layout(path)


@pytest.mark.parametrize("bad", ["inf", "-inf", "nan"])
def test_grids_refuse_nan_and_infinity(tmp_path, bad):
    path = tmp_path / "g.csv"
    path.write_text(f"0, 0\n{bad}, 1\n")
    with pytest.raises(ArgumentError, match=r"g\.csv holds -?(nan|inf) at \[1, 0\]; pass finite numbers"):
        direction_grid(Processing(directions=str(path)))


# ---- values at the limits --------------------------------------------------------------------------


@pytest.mark.parametrize(("temperature_c", "humidity_percent"), CORNERS)
def test_extreme_temperatures_keep_the_range_of_the_echo(temperature_c, humidity_percent):
    """The range is within 0.5 mm at 0.7 m; a constant 343 m/s would put it 8 cm too far at -40 °C."""
    air = Air(temperature_c=temperature_c, humidity_percent=humidity_percent)
    settings = SHORT.replace(air=air, processing=SHORT.processing.replace(directions="2d:91"))
    words = echo_words(settings, azimuth_deg=-10.0, range_m=0.7, level=0.5)
    [peak] = find_peaks(Pipeline(settings).process(Measurement(words, settings)), top=1)
    assert peak.range_m == pytest.approx(0.7, abs=5e-4)
    assert peak.azimuth_deg == pytest.approx(-10, abs=0.2)
    if temperature_c == -40:
        assert peak.range_m * 343.0 / sound_speed_m_s(air) == pytest.approx(0.784, abs=2e-3)


@pytest.mark.parametrize(("temperature_c", "humidity_percent"), CORNERS)
@pytest.mark.parametrize("pressure_pa", [10_000.0, 101_325.0, 200_000.0])
def test_sound_speed_and_absorption_are_exact_to_12_digits(temperature_c, humidity_percent, pressure_pa):
    """The reference has 50 digits. Dry air must not divide by its vapour, and hot thin air must limit its vapour."""
    air = Air(temperature_c=temperature_c, humidity_percent=humidity_percent, pressure_pa=pressure_pa)
    frequency_hz = np.array([1.0, 20e3, 50e3, 80e3, 200e3])
    with mpmath.workdps(50):
        speed_m_s, absorption = true_air(air, frequency_hz)
        assert abs(speed_m_s / sound_speed_m_s(air) - 1) < 1e-12
        for wanted, found in zip(absorption, absorption_db_m(air, frequency_hz), strict=True):
            assert abs(wanted / mpmath.mpf(float(found)) - 1) < 1e-12


def true_air(air, frequency_hz):
    """Speed of sound of the ideal mixture and absorption by ISO 9613-1, equations 3 to 5, in mpmath's precision."""
    number = mpmath.mpf
    kelvin, pressure = number("273.15") + number(air.temperature_c), number(air.pressure_pa) / 101_325
    saturation = number(10) ** (number("4.6151") - number("6.8346") * (number("273.16") / kelvin) ** number("1.261"))
    vapour = min(number(air.humidity_percent) / 100 * saturation / pressure, number(1))
    mass = (1 - vapour) * number("0.0289645") + vapour * number("0.01801528")
    capacity = (1 - vapour) / number("0.4") + vapour / number("0.33")
    speed_m_s = mpmath.sqrt((1 + 1 / capacity) * number("8.314462618") * kelvin / mass)
    warmth, percent = kelvin / number("293.15"), 100 * vapour
    oxygen_hz = pressure * (24 + 40400 * percent * (number("0.02") + percent) / (number("0.391") + percent))
    cold = mpmath.exp(number("-4.170") * (warmth ** (-number(1) / 3) - 1))
    nitrogen_hz = pressure / mpmath.sqrt(warmth) * (9 + 280 * percent * cold)
    absorption = []
    for hz in map(number, frequency_hz):
        oxygen = number("0.01275") * mpmath.exp(-number("2239.1") / kelvin) / (oxygen_hz + hz**2 / oxygen_hz)
        nitrogen = number("0.1068") * mpmath.exp(-number("3352.0") / kelvin) / (nitrogen_hz + hz**2 / nitrogen_hz)
        classical = number("1.84e-11") / pressure * mpmath.sqrt(warmth)
        nepers = hz**2 * (classical + warmth ** number("-2.5") * (oxygen + nitrogen))
        absorption.append(20 / mpmath.log(10) * nepers)
    return speed_m_s, absorption


# ---- through the simulator -------------------------------------------------------------------------


@pytest.mark.parametrize("humidity_percent", [0, 100])
@pytest.mark.parametrize("temperature_c", [-40, 60])
def test_extreme_air_gives_finite_values(temperature_c, humidity_percent):
    air = Air(temperature_c=temperature_c, humidity_percent=humidity_percent)
    scene = scene_of(Point(azimuth_deg=-10, range_m=0.5, strength_db=-20), sensor=EIGHT.replace(air=air))
    [peak] = find_peaks(image_of(scene), top=1)
    assert peak.range_m == pytest.approx(0.5, abs=0.005)
    assert peak.azimuth_deg == pytest.approx(-10, abs=2)


def test_thin_air_gives_finite_values():
    air = Air(temperature_c=60, humidity_percent=100, pressure_pa=10_000)
    assert image_of(scene_of(Point(range_m=0.4), sensor=EIGHT.replace(air=air))).amplitude.max() > 0
