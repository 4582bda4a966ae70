"""The page on file formats agrees with the tables in the code."""

import re

import numpy as np
import pytest

from ertis_numba.settings import PRESETS, Settings
from ertis_numba.storage.schema import (
    ACOUSTIC_MAP,
    BEARINGS,
    CONVENTIONS,
    ENERGYSCAPE,
    FORMAT_VERSION,
    OCCUPANCY_MAP,
    OLDEST_VERSION,
    POINTS,
    POSES,
    RECORDING,
    RECORDING_OF_PCM,
    STAMPS,
    TRUTH,
    VERSION_WITHOUT_POSES,
)
from tests.pages import page

PAGE = page("formats")
SHARED = [*STAMPS, *(variable for variable in RECORDING if variable.name == "settings")]
SHARED_NAMES = {variable.name for variable in SHARED}
PCM = next(variable for variable in RECORDING_OF_PCM if variable.name == "pcm")
EITHER = [each for variable in RECORDING for each in ([variable, PCM] if variable.name == "pdm" else [variable])]


def rows(first):
    """Variables of the table that begins with ``first``: name, axes, types, unit."""
    table = PAGE[PAGE.index(f"| `{first}` |") :].split("\n\n", 1)[0]
    for line in table.splitlines():
        name, axes, kinds, unit = (cell.strip() for cell in line.strip("|").split("|")[:4])
        yield name.strip("`"), tuple(filter(None, axes.split(", "))), re.split(", | or ", kinds), unit


@pytest.mark.parametrize(
    ("first", "table"),
    [
        ("time", SHARED),
        ("temperature", [variable for variable in EITHER if variable not in SHARED]),
        ("pose_position", POSES),
        ("scene", TRUTH),
        ("log_odds", OCCUPANCY_MAP),
        ("amplitude", [*(variable for variable in ENERGYSCAPE if variable not in SHARED), *POINTS]),
        ("power", [*(variable for variable in ACOUSTIC_MAP if variable.name not in SHARED_NAMES), *BEARINGS]),
    ],
)
def test_format_tables_match_the_code(first, table):
    reported = list(rows(first))
    assert [row[0] for row in reported] == [variable.name for variable in table]
    for (_, axes, kinds, unit), variable in zip(reported, table, strict=True):
        assert (axes, unit) == (variable.dims, variable.units)
        if variable.dtype:
            assert kinds == ["text" if variable.dtype == "str" else np.dtype(variable.dtype).name]
        else:
            assert kinds == [np.dtype(kind).name for kind in kinds]


def test_format_names_and_versions_match_the_code():
    assert f"`{CONVENTIONS}`" in PAGE
    versions = f"{VERSION_WITHOUT_POSES}; {FORMAT_VERSION} with poses, and for fused files with points"
    assert f"| {versions} | {OLDEST_VERSION} to {FORMAT_VERSION} |" in PAGE


def test_format_presets_match_the_code():
    for preset in PRESETS:
        line = next(line for line in PAGE.splitlines() if f"`{preset}`" in line)
        words = Settings.from_preset(preset).recording.n_samples
        assert f"{words:,}" in line
        assert f"{4 * words:,}" in line
