"""The speed of sound against tabulated values."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ertis_numba.air import sound_speed_m_s
from ertis_numba.settings import Air

airs = st.builds(
    Air,
    temperature_c=st.floats(-40, 60),
    humidity_percent=st.floats(0, 100),
    pressure_pa=st.floats(10_000, 200_000),
)


@pytest.mark.parametrize(("temperature_c", "speed_m_s"), [(-20, 318.9), (0, 331.3), (20, 343.2), (40, 354.7)])
def test_dry_air(temperature_c, speed_m_s):
    assert sound_speed_m_s(Air(temperature_c=temperature_c, humidity_percent=0)) == pytest.approx(speed_m_s, abs=0.1)


def speed_by_cramer_m_s(temperature_c, humidity_percent, pressure_pa=101_325.0, carbon_dioxide=314e-6):
    """Return the fit of O. Cramer, JASA 93 (1993), to real gases at 0 to 30 °C: an independent route."""
    t, p, xc, kelvin = temperature_c, pressure_pa, carbon_dioxide, temperature_c + 273.15
    enhancement = 1.00062 + 3.14e-8 * p + 5.6e-7 * t**2
    saturation_pa = math.exp(1.2811805e-5 * kelvin**2 - 1.9509874e-2 * kelvin + 34.04926034 - 6.3536311e3 / kelvin)
    xw = humidity_percent / 100 * enhancement * saturation_pa / p
    return (
        331.5024
        + 0.603055 * t
        - 0.000528 * t**2
        + (51.471935 + 0.1495874 * t - 0.000782 * t**2) * xw
        + (-1.82e-7 + 3.73e-8 * t - 2.93e-10 * t**2) * p
        + (-85.20931 - 0.228525 * t + 5.91e-5 * t**2) * xc
        - 2.835149 * xw**2
        - 2.15e-13 * p**2
        + 29.179762 * xc**2
        + 0.000486 * xw * p * xc
    )


@pytest.mark.parametrize("temperature_c", [0, 10, 20, 30])
@pytest.mark.parametrize("humidity_percent", [0, 50, 100])
def test_humid_air(temperature_c, humidity_percent):
    air = Air(temperature_c=temperature_c, humidity_percent=humidity_percent)
    assert sound_speed_m_s(air) == pytest.approx(speed_by_cramer_m_s(temperature_c, humidity_percent), rel=5e-4)


def test_humidity_adds_up_to_four_parts_in_a_thousand_at_room_temperature():
    dry, humid = (sound_speed_m_s(Air(humidity_percent=percent)) for percent in (0, 100))
    assert 0.003 < humid / dry - 1 < 0.0045


def test_pressure_does_not_matter_without_humidity():
    thin, thick = (sound_speed_m_s(Air(humidity_percent=0, pressure_pa=pa)) for pa in (20_000, 200_000))
    assert thin == thick


@given(airs)
def test_air_of_any_kind_has_a_sensible_speed(air):
    steam = math.sqrt(1.33 * 461.5 * 333.15)  # the fastest there is: water vapour at 60 °C
    assert 300 < sound_speed_m_s(air) <= steam + 1


@given(airs, st.floats(1, 20))
def test_warmer_air_is_faster(air, warmer_c):
    warm = air.replace(temperature_c=min(air.temperature_c + warmer_c, 60.0), humidity_percent=0.0)
    assert sound_speed_m_s(warm) >= sound_speed_m_s(air.replace(humidity_percent=0.0))
