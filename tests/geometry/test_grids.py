"""Lists of directions: degrees are accepted, and radians refused."""

import numpy as np
import pytest

from ertis_numba.base.errors import ArgumentError
from ertis_numba.geometry import direction_grid
from ertis_numba.settings import Processing


@pytest.mark.parametrize("largest_deg", [*range(5, 185, 5), 360])
@pytest.mark.parametrize("decimals", [4, 6, None])
def test_directions_in_radians_are_refused(tmp_path, largest_deg, decimals):
    azimuth_rad = np.radians(np.linspace(-largest_deg, largest_deg, 61))
    rows = [(azimuth if decimals is None else round(azimuth, decimals), 0.0) for azimuth in azimuth_rad.tolist()]
    (tmp_path / "a.csv").write_text("".join(f"{azimuth!r},{elevation}\n" for azimuth, elevation in rows))
    for directions in (str(tmp_path / "a.csv"), tuple(rows)):
        with pytest.raises(ArgumentError, match=f"are {largest_deg} degrees as radians; write azimuth"):
            direction_grid(Processing(directions=directions))


@pytest.mark.parametrize("limits_deg", [(-2, 2), (-0.5, 1.25), (0, 3.14), (1.57, 1.57), (-90, 90), (0.123, 1.456)])
def test_narrow_grids_in_degrees_are_accepted(limits_deg):
    grid = direction_grid(Processing(directions=tuple((each, 0.0) for each in np.linspace(*limits_deg, 41).tolist())))
    np.testing.assert_allclose(np.degrees([grid.azimuth_rad[0], grid.azimuth_rad[-1]]), limits_deg)
