"""Speed of sound in air."""

import math

from ertis_numba.settings import Air

__all__ = ["sound_speed_m_s"]

_ZERO_C_K = 273.15
_TRIPLE_POINT_K = 273.16  # of water; ISO 9613-1, annex B
_REFERENCE_PRESSURE_PA = 101_325.0
_DRY_AIR_KG_MOL = 0.028_964_5
_WATER_KG_MOL = 0.018_015_28
_GAS_CONSTANT_J_MOL_K = 8.314_462_618  # CODATA 2018
_DRY_HEAT_RATIO = 1.400
_VAPOUR_HEAT_RATIO = 1.330


def sound_speed_m_s(air: Air) -> float:
    """Return the speed of sound in humid air in m/s.

    An ideal mixture of dry air and water vapour: ``c = sqrt(γ R T / M)``, with the molar mass and
    the heat capacity of the mixture and the saturation pressure of ISO 9613-1, annex B. Dry air at
    0 °C gives 331.3 m/s; humidity adds up to about 0.4 % at room temperature.

    Parameters
    ----------
    air : Air

    Returns
    -------
    float
    """
    kelvin = _ZERO_C_K + air.temperature_c
    saturation = 10.0 ** (4.6151 - 6.8346 * (_TRIPLE_POINT_K / kelvin) ** 1.261)
    vapour = air.humidity_percent / 100 * saturation * _REFERENCE_PRESSURE_PA / air.pressure_pa
    vapour = min(vapour, 1.0)  # hot and thin air is all steam, never more
    molar_mass = (1 - vapour) * _DRY_AIR_KG_MOL + vapour * _WATER_KG_MOL
    # 1 / (γ − 1) is the heat capacity over R, which adds up over the parts of the mixture.
    capacity = (1 - vapour) / (_DRY_HEAT_RATIO - 1) + vapour / (_VAPOUR_HEAT_RATIO - 1)
    return math.sqrt((1 + 1 / capacity) * _GAS_CONSTANT_J_MOL_K * kelvin / molar_mass)
