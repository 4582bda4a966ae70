"""Microphone layouts, direction grids and the delays between them.

In the sensor frame, x points forward (boresight), y to azimuth +90°, and z up (elevation +90°). Positions are relative
to the centroid of the enabled microphones.
"""

from ertis_numba.geometry.azimuths import ALONE_RAD, FAR, is_closed, reach_rad, unrolled_rad
from ertis_numba.geometry.delay_matrix import delay_matrix, plane_delays
from ertis_numba.geometry.delays import far_field_delays, spherical_delays, unit_vectors
from ertis_numba.geometry.grids import MAX_DIRECTIONS, PAPER_GRIDS, Grid, direction_grid, grid_count, named_grid
from ertis_numba.geometry.layouts import (
    Layout,
    layout_file,
    load_layout,
    microphones,
    require_plausible_size,
    self_contained,
    storable,
    written_out,
)
from ertis_numba.geometry.levelling import levelled_grid
from ertis_numba.geometry.mountings import mounting
from ertis_numba.geometry.neighbours import azimuth_columns, spacing_rad
from ertis_numba.geometry.observable import (
    HEIGHT_NOTE,
    ObservableAngles,
    direction_note,
    observable_angles,
    require_places,
)
from ertis_numba.geometry.position_files import SENSOR_FRAME
from ertis_numba.geometry.sector import Fan, plan_m, round_step
from ertis_numba.geometry.shipped_layouts import layout_names, layout_text
from ertis_numba.geometry.untrusted_settings import received_settings
from ertis_numba.geometry.weights import array_weights, effective_count

__all__ = [
    "ALONE_RAD",
    "FAR",
    "HEIGHT_NOTE",
    "MAX_DIRECTIONS",
    "PAPER_GRIDS",
    "SENSOR_FRAME",
    "Fan",
    "Grid",
    "Layout",
    "ObservableAngles",
    "array_weights",
    "azimuth_columns",
    "delay_matrix",
    "direction_grid",
    "direction_note",
    "effective_count",
    "far_field_delays",
    "grid_count",
    "is_closed",
    "layout_file",
    "layout_names",
    "layout_text",
    "levelled_grid",
    "load_layout",
    "microphones",
    "mounting",
    "named_grid",
    "observable_angles",
    "plan_m",
    "plane_delays",
    "reach_rad",
    "received_settings",
    "require_places",
    "require_plausible_size",
    "round_step",
    "self_contained",
    "spacing_rad",
    "spherical_delays",
    "storable",
    "unit_vectors",
    "unrolled_rad",
    "written_out",
]
