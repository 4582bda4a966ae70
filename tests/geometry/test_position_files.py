"""Files of microphone positions as other people and programs write them: read right, questioned or refused."""

import io
import tomllib
import warnings
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli
from numpy.testing import assert_allclose
from scipy.io import wavfile

from ertis_numba import Settings
from ertis_numba.base.errors import ArgumentError, LayoutUnitWarning, SettingsError
from ertis_numba.geometry import load_layout, microphones, require_plausible_size, self_contained, written_out
from ertis_numba.pipeline.accepted_words import AcceptedWords
from ertis_numba.settings import Array

PLACES = np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.5, 1.0, 0.75]])
UNITS_M = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254}


def lines(template, size, *, decimal="."):
    """Rows of a table by a template of number n from 0, number m from 1, and coordinates."""
    rows = (template.format(n=n, m=n + 1, x=x, y=y, z=z) for n, (x, y, z) in enumerate((size * PLACES).tolist()))
    return "".join(f"{row.replace('.', decimal)}\n" for row in rows)


def loaded(folder, text, *, name="mics.csv", encoding="utf-8"):
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode(encoding))
    return load_layout(path)


def require_places(layout, size_m):
    assert_allclose(layout.positions_m, size_m * (PLACES - PLACES.mean(axis=0)), atol=1e-9)


HEADED = {
    "underscores": ("x_{u},y_{u},z_{u}", "{x!r},{y!r},{z!r}"),
    "parentheses": ("x ({u}),y ({u}),z ({u})", "{x!r}, {y!r}, {z!r}"),
    "brackets": ("X[{u}];Y[{u}];Z[{u}]", "{x!r};{y!r};{z!r}"),
    "spaces": ("x [{u}] y [{u}] z [{u}]", "{x!r}   {y!r} {z!r}"),
    "tabs": ("X [{u}]\tY [{u}]\tZ [{u}]", "{x!r}\t{y!r}\t{z!r}"),
    "in": ("x in {u}, y in {u}, z in {u}", "{x!r}, {y!r}, {z!r}"),
    "slash": ("x/{u},y/{u},z/{u}", "{x!r},{y!r},{z!r}"),
    "one unit": ("x,y,z_{u}", "{x!r},{y!r},{z!r}"),
    "index of pandas": (",x_{u},y_{u},z_{u}", "{n},{x!r},{y!r},{z!r}"),
    "index without name": ("Unnamed: 0,x_{u},y_{u},z_{u}", "{n},{x!r},{y!r},{z!r}"),
    "names": ("mic,pos_x_{u},pos_y_{u},pos_z_{u}", "M{m},{x!r},{y!r},{z!r}"),
    "numbers": ("Channel;x_{u};y_{u};z_{u};Comment", "{m};{x!r};{y!r};{z!r};left"),
    "row names of R": ('"x_{u}" "y_{u}" "z_{u}"', '"{m}" {x!r} {y!r} {z!r}'),
    "quoted": ('"z_{u}","y_{u}","x_{u}"', '"{z!r}","{y!r}","{x!r}"'),
    "other order": ("z_{u},x_{u},y_{u},", "{z:.12e},{x:.12e},{y:.12e},"),
    "comment of NumPy": ("# x_{u},y_{u},z_{u}", "{x:.18e},{y:.18e},{z:.18e}"),
    "comment in words": ("# mics of the frame\n# x, y, z in {u}", "{x!r}, {y!r}, {z!r}  # as built"),
    "unit in a comment": ("% all positions in {u}", "{x!r} {y!r} {z!r} % as built"),
    "row of units": ("x,y,z\n[{u}],[{u}],[{u}]", "{x!r},{y!r},{z!r}"),
    "separator of spreadsheets": ("sep=;\nx_{u};y_{u};z_{u}", "{x!r};{y!r};{z!r}"),
}


@pytest.mark.parametrize("unit", UNITS_M)
@pytest.mark.parametrize("size_m", [0.02, 1.2, 20.0])
@pytest.mark.parametrize("name", HEADED)
def test_header_states_axes_and_unit(tmp_path, name, size_m, unit):
    header, row = HEADED[name]
    layout = loaded(tmp_path, header.format(u=unit) + "\n" + lines(row, size_m / UNITS_M[unit]))
    require_places(layout, size_m)
    assert not layout.notes
    assert layout.unit_is_stated
    assert layout.name == "mics"


@pytest.mark.parametrize(
    ("header", "unit"),
    [("x_millimetres,y,z", "mm"), ("x (meters),y,z", "m"), ("X Centimeter,Y,Z", "cm"), ("x (inches),y,z", "in")],
)
def test_units_have_names(tmp_path, header, unit):
    require_places(loaded(tmp_path, f"{header}\n" + lines("{x!r},{y!r},{z!r}", 0.1 / UNITS_M[unit])), 0.1)


@pytest.mark.parametrize(
    ("header", "row", "decimal"),
    [
        ("x_m;y_m;z_m\n", "{x};{y};{z}", ","),
        ("x_m\ty_m\tz_m\n", "{x}\t{y}\t{z}", ","),
        ("x_m y_m z_m\n", "{x} {y} {z}", ","),
        ("# in m\n", "{x:.4f}  {y:.4f}  {z:.4f}", ","),
        ("# in m\n", "{x:.4f},\t{y:.4f},\t{z:.4f}", "."),
        ("# in m\n", "  {x:9.4f}{y:9.4f}{z:9.4f}", "."),
        ("# in m\n", "{n} {x:9.4f}{y:9.4f}{z:9.4f}", "."),
        ("# in m\n", "Mic-{m};{x};{y};{z}", "."),
        (",0,1,2  # in m\n# in m\n", "{n},{x},{y},{z}", "."),
    ],
)
def test_separators_and_decimal_commas_are_recognised(tmp_path, header, row, decimal):
    layout = loaded(tmp_path, header + lines(row, 100.0 if header[0] == "," else 0.1, decimal=decimal))
    require_places(layout, 0.1)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252", "latin-1"])
@pytest.mark.parametrize("ending", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("suffix", ["csv", "tsv", "txt", "CSV"])
def test_encodings_and_line_ends_of_all_systems_are_read(tmp_path, encoding, ending, suffix):
    text = "# Maße des großen Rahmens\nx_m,y_m,z_m\n" + lines("{x},{y},{z}", 1.2)
    require_places(loaded(tmp_path, text.replace("\n", ending), name=f"mics.{suffix}", encoding=encoding), 1.2)


def test_numbers_without_a_unit_are_millimetres_with_a_note(tmp_path):
    layout = loaded(tmp_path, lines("{x},{y},{z}", 42))
    require_places(layout, 0.042)
    assert not layout.unit_is_stated
    (note,) = layout.notes
    assert "states no unit; millimetres are assumed, so the array spans 21 × 42 × 42 mm" in note
    assert not loaded(tmp_path, "5, 6\n").notes  # A single microphone has no size.


@pytest.mark.parametrize("size", [0.02, 0.3, 1.2, 4.0])
@pytest.mark.parametrize("suffix", ["csv", "txt", "npy"])
def test_small_numbers_without_a_unit_are_questioned(tmp_path, size, suffix):
    content = io.BytesIO()
    np.save(content, size * PLACES)
    text = content.getvalue() if suffix == "npy" else lines("{x},{y},{z}", size)
    with pytest.raises(
        ArgumentError, match=rf"states no unit; .* span only .*Are the numbers .*m \({size * 1000:g} mm|m"
    ):
        loaded(tmp_path, text, name=f"mics.{suffix}")


def test_many_dense_microphones_without_a_unit_are_questioned(tmp_path):
    text = "".join(f"0, {0.5 * n}, 0\n" for n in range(40))
    with pytest.raises(ArgumentError, match=r"states no unit; in millimetres, the array would span only 19.5 mm"):
        loaded(tmp_path, text)
    assert loaded(tmp_path, "x_mm,y_mm,z_mm\n" + text).unit_is_stated


def test_unit_in_toml_is_read(tmp_path):
    rows = (1.2 * PLACES).tolist()
    for text in (
        f'unit = "m"\npositions = {rows}',
        f"positions_m = {rows}",
        f"positions_mm = {(1200 * PLACES).tolist()}",
    ):
        layout = loaded(tmp_path, text, name="mics.toml")
        require_places(layout, 1.2)
        assert layout.unit_is_stated


def test_numpy_and_acoular_files_are_read(tmp_path):
    content = io.BytesIO()
    np.save(content, 42 * PLACES[:, 1:])
    assert_allclose(np.ptp(loaded(tmp_path, content.getvalue(), name="a.npy").positions_m, axis=0), [0, 0.042, 0.042])


def acoular(rows, *, declaration='<?xml version="1.1" encoding="utf-8"?>', attributes=""):
    places = "".join(f'<pos Name="Point {n}" x="\t{x}" y="{y} " z="{z}"/>\n' for n, (x, y, z) in enumerate(rows, 1))
    return f'{declaration}<MicArray name="mine"{attributes}>\n{places}</MicArray>'


@pytest.mark.parametrize("depth_m", [0.0, 0.2])
@pytest.mark.parametrize(("right_m", "up_m"), [(0.3, 0.2), (-0.3, 0.2), (0.3, -0.2), (0.0, 0.4)])
def test_acoular_array_locates_sources_where_acoular_has_them(tmp_path, depth_m, right_m, up_m):
    """Acoular's demonstration has its sources at z = -0.3, with x to the right and y up for the observer."""
    rng = np.random.default_rng(1)
    places_m = rng.uniform(-0.4, 0.4, (12, 3)) * [1, 1, depth_m]
    layout = loaded(tmp_path, acoular(places_m), name="mine.xml")
    distances_m = np.linalg.norm(places_m - [right_m, up_m, -1.0], axis=1)
    source_m = np.array([1.0, -right_m, up_m]) - places_m.mean(axis=0) @ [[0, -1, 0], [0, 0, 1], [-1, 0, 0]]
    assert_allclose(np.linalg.norm(layout.positions_m - source_m, axis=1), distances_m, atol=1e-12)
    assert "was turned from the axes of Acoular" in layout.notes[0]
    assert layout.is_flat == (depth_m == 0)


def test_acoular_array_in_y_and_z_is_not_turned(tmp_path):
    layout = loaded(tmp_path, acoular([[0, 0, 0], [0, 1, 0], [0, 0, 1]]), name="mine.xml")
    assert_allclose(np.ptp(layout.positions_m, axis=0), [0, 1, 1])
    assert "lies in y and z, so it faces x" in layout.notes[0]


def test_exported_array_of_acoular_is_read_back(tmp_path):
    from ertis_numba.interop._acoular import _xml  # noqa: PLC0415

    layout = load_layout("eRTIS_v2REC")
    again = loaded(tmp_path, _xml(layout), name="again.xml")
    assert_allclose(again.positions_m, layout.positions_m, atol=1e-12)
    assert not again.notes


def test_array_that_lies_on_the_ground_has_a_note(tmp_path):
    for name, text in (
        ("a.csv", "x_m,y_m,z_m\n0,0,0\n1,0,0\n0,1,0\n"),
        ("a.toml", "positions_m = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]"),
    ):
        assert "lie in a horizontal plane, because x is forward" in loaded(tmp_path, text, name=name).notes[0]


TABLE = lines("{x},{y},{z}", 42)
REFUSED = {
    "empty": ("a.csv", b"", r"a\.csv: the file is empty; choose a readable file or one of eRTIS_v2, eRTIS_v2REC, "),
    "large": ("a.csv", b"1,2\n" * 1_100_000, r"a\.csv: more than 4 MB, too large for a layout"),
    "picture": ("a.csv", b"\x89PNG\r\n\x1a\n\0\0\0\r1", r"a\.csv: the file is binary, not text"),
    "empty xml": ("a.xml", b" \n", r"a\.xml: the file is empty"),
    "header alone": ("a.csv", b"x_m,y_m,z_m\n", r"a\.csv: no positions; write one row per channel"),
    "axes": (
        "a.csv",
        b"x,y\n0,0\n42,0\n",
        r"a\.csv: the header names only x and y, .* or add the missing column",
    ),
    "one axis": ("a.csv", b"y_m\n0\n1\n", r"a\.csv: the header names only y, "),
    "no axis": (
        "a.csv",
        b"a,b,c\n" + TABLE.encode(),
        r"the header \(a, b, c\) names no column x, y or z; name the",
    ),
    "two axes": ("a.csv", b"x,y,y\n" + TABLE.encode(), r"two columns are named y; rename or remove one"),
    "unit": ("a.csv", b"x_ft,y_ft,z_ft\n" + TABLE.encode(), r"column 'x_ft' has the unit ft; use mm, cm, m, in"),
    "mil": ("a.csv", b"x_mil,y_mil,z_mil\n" + TABLE.encode(), r"column 'x_mil' has the unit mil; use mm"),
    "unit in brackets": ("a.csv", b"x (hl),y (hl),z (hl)\n" + TABLE.encode(), r"has the unit hl; use mm, cm, m, in"),
    "settings": ("a.toml", b'[array]\nlayout = "eRTIS_v2"\n', r"a\.toml is a file of settings; load it as settings"),
    "two units": ("a.csv", b"x_m,y_mm,z_m\n" + TABLE.encode(), r"the columns have the units m, mm; use only one unit"),
    "short row": ("a.csv", b"x,y,z\n1,2,3\n1,2\n", r"a\.csv, line 3 has 2 cells, but line 2 has 3; write the same"),
    "short rows": ("a.csv", b"x,y,z\n1,2\n1,2\n", r"a\.csv, line 2 has 2 cells, but the header has 3; write one"),
    "missing": ("a.csv", b"x,y,z\n1,,3\n", r"a\.csv, line 2: y is ''; use a number"),
    "text": ("a.csv", b"x,y,z\n\n1,2,three\n", r"a\.csv, line 3: z is 'three'; use a number"),
    "underscore": ("a.csv", b"x,y,z\n1,2,1_0\n", r"a\.csv, line 2: z is '1_0'; use a number"),
    "NaN": ("a.csv", b"x,y,z\n1,2,3\n1,2,NaN\n", r"a\.csv, line 3: z is NaN; use a finite number"),
    "five columns": ("a.csv", b"1,2,3,4,5\n", r"a\.csv, line 1 has 5 cells; write rows of y, z or x, y, z"),
    "decimal commas": ("a.csv", b"0,021,0,063\n0,5,1,2\n", r"a\.csv, line 1 has 4 cells; write rows of"),
    "index": (
        "a.csv",
        b"0,0,0\n1,42,0\n2,0,42\n",
        r"the first column may be channel numbers or positions along x",
    ),
    "index of savetxt": (
        "a.csv",
        b"0.000e+00,-3.100e+01,7.500e+00\n1.000e+00,4.200e+01,0.000e+00\n2.000e+00,0.000e+00,4.200e+01\n",
        r"the first column may be channel numbers or positions along x; add the header channel,y_mm,z_mm",
    ),
    "index from 1": (
        "a.txt",
        b"1.0 -31 7.5\n2.0 42.0 0\n3.0 0 42.0\n",
        r"the first column may be channel numbers or positions along x",
    ),
    "index at the end": (
        "a.csv",
        b"-31,7.5,0.0\n42.5,0,1.0\n0,42.5,2.0\n",
        r"the third column may be channel numbers or positions along z",
    ),
    "two indices": (
        "a.csv",
        b"0,1.0,-31,7.5\n1,2.0,42.5,0\n2,3.0,0,42.5\n",
        r"the second column may be channel numbers or positions along x",
    ),
    "numbered": (
        "a.csv",
        b"0,1,2\n0.0,0.0,0.0\n0.0,42.0,0.0\n",
        r"line 1: 0, 1, 2 may be column numbers or a pos",
    ),
    "order": ("a.csv", b"mic,y,z\n1,0,0\n3,42,0\n2,0,42\n", r"a\.csv, line 3: mic 3 follows 1; sort the rows by"),
    "gap": (
        "a.csv",
        b"mic,y,z\n1,0,0\n2,42,0\n4,0,42\n",
        r"a\.csv, line 4: mic 4 follows 2; sort the rows .* missing",
    ),
    "copy": ("a.csv", b"1,2\n30,4\n1,2\n", r"channels 0 and 2 have the same position; correct one of them"),
    "small": (
        "a.csv",
        b"y_mm,z_mm\n0,0\n1.2,0\n",
        r"the microphones span 1\.2 mm, less than 2 mm; if the numbers have anot",
    ),
    "wide": (
        "a.csv",
        b"y_m,z_m\n0,0\n42,0\n",
        r"the microphones span 42 m, more than 25 m; .*state the unit in a header",
    ),
    "wide toml": (
        "a.toml",
        b"positions_m = [[0, 0], [42, 0]]",
        r"span 42 m, more than 25 m; .*set their unit, as in unit",
    ),
    "wide xml": (
        "a.xml",
        acoular([[0, 0, 0], [42, 0, 0]]).encode(),
        r"span 42 m, .*convert the positions in the file to met",
    ),
    "metres": (
        "a.toml",
        b"positions_mm = [[0, 0], [1.2, 0]]",
        r"span 1\.2 mm, .*rename the key of the positions to positions",
    ),
    "metres of a large array": (
        "a.toml",
        b"positions_mm = [[1.2, 0], [0.85, 0.85], [0, 1.2], [-1.2, 0]]",
        r"only 0\.919 mm apart; .*rename the key of the positions to positions.*do the same with \"mm\"",
    ),
    "no unit": (
        "a.toml",
        b"positions = [[0, 0], [1.2, 0]]",
        r"positions have no unit; are they millimetres or metres\? Add",
    ),
    "other unit": ("a.toml", b'unit = "m"\npositions_mm = [[0, 0], [1, 0]]', r"rename positions_mm to positions"),
    "unknown unit": (
        "a.toml",
        b'unit = "ft"\npositions = [[0, 0], [1, 0]]',
        r"unit 'ft' is unknown; known are mm, cm, m, in",
    ),
    "both": (
        "a.toml",
        b"positions_mm = [[0, 0]]\npositions = [[0, 0]]",
        r"both positions and positions_mm; remove one",
    ),
    "neither": ("a.toml", b"word_bits = 8", r"`positions_mm` is missing; add it, or `positions` and `unit`"),
    "grid": (
        "a.xml",
        b'<Grid><pos Name="1" x="0" y="0" z="0"/></Grid>',
        r"contains <Grid> instead of <MicArray>; use a file of Acou",
    ),
    "calibration": (
        "a.xml",
        b'<MicArray><pos Name="1" factor="2"/></MicArray>',
        r"<pos> 1: x is ''; use a finite number",
    ),
    "no pos": ("a.xml", b"<MicArray></MicArray>", r"contains no <pos>; add one <pos Name= x= y= z=> per channel"),
    "no xml": ("a.xml", b"1,2,3\n", r"a\.xml: not XML \(.*\); use a file of Acoular with <MicArray>, or a \.csv file"),
    "pickled": ("a.npy", b"nothing", r"a\.npy is no array of NumPy; save the positions with numpy\.save"),
    "matlab": (
        "a.mat",
        b"MATLAB 5.0",
        r"files that end in \.mat cannot be read; save the positions as \.csv with a header",
    ),
    "json": (
        "a.json",
        b"[[1, 2, 3]]",
        r"end in \.json cannot be read; .*in another format: \.toml, \.csv, \.tsv, \.txt, \.npy, \.xml",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_unusable_position_files_are_refused(tmp_path, name):
    file, content, message = REFUSED[name]
    with pytest.raises((ArgumentError, SettingsError), match=message):
        loaded(tmp_path, content, name=file)


def test_numpy_arrays_of_another_shape_are_refused(tmp_path):
    for numbers, message in (
        (PLACES.T, r"contains float64 of shape \(3, 4\); save"),
        (PLACES > 0, r"contains bool of"),
    ):
        content = io.BytesIO()
        np.save(content, numbers)
        with pytest.raises(ArgumentError, match=message):
            loaded(tmp_path, content.getvalue(), name="a.npy")
    np.savez(tmp_path / "a.npz", PLACES)
    with pytest.raises(ArgumentError, match=r"contains several arrays; save numbers of shape"):
        loaded(tmp_path, (tmp_path / "a.npz").read_bytes(), name="a.npy")
    content = io.BytesIO()
    np.save(content, np.where(PLACES == 1, np.nan, PLACES))
    with pytest.raises(ArgumentError, match=r"holds nan at \[1, 1\]; pass finite numbers"):
        loaded(tmp_path, content.getvalue(), name="a.npy")


def test_folder_in_place_of_a_layout_is_refused(tmp_path):
    (tmp_path / "a.csv").mkdir()
    with pytest.raises(ArgumentError, match=r"a\.csv: Is a directory; choose a readable file or one of"):
        load_layout(tmp_path / "a.csv")


@pytest.mark.parametrize(("size", "may_be_metres"), [(16, True), (25, True), (26, False), (300, False)])
def test_numbers_that_may_be_metres_cause_a_warning(tmp_path, size, may_be_metres):
    (tmp_path / "a.csv").write_text(f"0,0\n0,{size}\n{size},0\n")
    if may_be_metres:
        with pytest.warns(LayoutUnitWarning, match=r"millimetres, not metres, are assumed, so the array spans 0 × "):
            load_layout(tmp_path / "a.csv")
    assert len([note for note in noted(tmp_path / "a.csv") if "states no unit" in note]) == 1
    for unit in ("mm", "m"):
        if unit == "mm" or may_be_metres:
            (tmp_path / "a.csv").write_text(f"y_{unit},z_{unit}\n0,0\n0,{size}\n{size},0\n")
            assert not load_layout(tmp_path / "a.csv").notes


def noted(path):
    with warnings.catch_warnings(category=LayoutUnitWarning, action="ignore"):
        return load_layout(path).notes


@pytest.mark.parametrize("size", [5, 12, 14.9])
def test_numbers_of_small_and_of_large_arrays_are_questioned(tmp_path, size):
    (tmp_path / "a.csv").write_text(f"0,0\n0,{size}\n{size},0\n{size},{size}\n")
    with pytest.raises(ArgumentError, match=rf"would span only {size} mm\. Are the numbers cm .* or m \({size} m\)"):
        load_layout(tmp_path / "a.csv")


def test_layouts_prints_files_in_millimetres(tmp_path):
    (tmp_path / "a.csv").write_text("x_m,y_m,z_m\n0,0,0\n0,6,0\n0,0,-3\n")
    (tmp_path / "small.csv").write_text("0,0\n0,20\n20,0\n")
    done = CliRunner().invoke(cli, ["reference", "layouts", str(tmp_path / "a.csv")])
    assert (done.exit_code, done.stderr) == (0, "")
    (tmp_path / "a.toml").write_text(done.stdout)
    assert tomllib.loads(done.stdout)["positions_mm"][1] == [0.0, 4000.0, 1000.0]
    assert np.array_equal(load_layout(tmp_path / "a.toml").positions_m, load_layout(tmp_path / "a.csv").positions_m)
    done = CliRunner().invoke(cli, ["reference", "layouts", str(tmp_path / "small.csv")])
    assert done.stderr.startswith("note: layout ")
    assert done.stderr.count("states no unit") == 1
    assert tomllib.loads(done.stdout)["name"] == "small"


def test_notes_of_a_layout_appear_when_a_recording_is_made(tmp_path, monkeypatch):
    """Later commands with the same settings file repeat none of them."""
    monkeypatch.chdir(tmp_path)
    Path("a.csv").write_text("0,0\n0,20\n20,0\n")
    Path("b.csv").write_text("0,0\n0,20\n30,0\n")
    for name in "ab":
        Path(f"{name}.toml").write_text(
            f'array.layout = "{name}.csv"\nrecording.encoding = "int16"\nrecording.sample_rate_hz = 192000.0\n'
            'recording.n_samples = 3000\nprocessing.directions = "2d:9"\nprocessing.range_m = [0.3, 1.0]\n'
            "processing.range_decimation = 4\n"
        )
    wavfile.write("a.wav", 192000, np.random.default_rng(0).integers(-99, 99, (3000, 3)).astype(np.int16))
    for line, count in {
        "import signals a.wav -o a.h5 --settings a.toml": 1,
        "process a.h5 --settings a.toml --force": 0,
        "process a.h5 --settings b.toml --force": 1,
    }.items():
        done = CliRunner().invoke(cli, line.split())
        assert done.exit_code == 0, done.stderr
        assert done.stderr.count("states no unit") == count, done.stderr


# ---- size relative to the sound ---------------------------------------------------------------------


def of_file(path, **changes):
    return Settings().replace(**{"array.layout": str(path), **changes})


def test_array_below_a_third_of_the_wavelength_is_questioned(tmp_path):
    (tmp_path / "a.csv").write_text("0, 0\n30, 0\n0, 30\n")
    low = {"processing.mode": "passive", "passive.bands_hz": [[1000.0, 2000.0]]}
    require_plausible_size(of_file(tmp_path / "a.csv"))  # 30 mm are 4.4 wavelengths at 50 kHz …
    for use in (require_plausible_size, self_contained, AcceptedWords):  # … and 0.17 at 2 kHz.
        with pytest.raises(
            ArgumentError, match=r"span only 30 mm, less than a third of the wavelength at 2 kHz\. Are the"
        ):
            use(of_file(tmp_path / "a.csv", **low))
    (tmp_path / "a.csv").write_text("y_mm, z_mm\n0, 0\n30, 0\n0, 30\n")
    require_plausible_size(of_file(tmp_path / "a.csv", **low))


def test_array_larger_than_the_record_is_refused():
    array = Array(positions_m=((0.0, 0.0, 0.0), (0.0, 20.0, 0.0), (0.0, 0.0, 20.0)))  # an array of 20 mm in millimetres
    with pytest.raises(
        ArgumentError, match=r"'own array' spans 20 m, but sound travels only 12.5 m in a record of 36.4 ms"
    ):
        AcceptedWords(Settings(array=array))
    require_plausible_size(Settings(array=array).replace("recording.n_samples", 450_000))


# ---- names ------------------------------------------------------------------------------------------


def test_array_given_by_positions_has_a_name_of_its_own(tmp_path):
    rows = [[0.0, 0.02, 0.0], [0.0, -0.02, 0.0]]
    (tmp_path / "mine.toml").write_text(f"[array]\npositions_m = {rows}\n")
    (tmp_path / "named.toml").write_text(f"[array]\nlayout = 'pair'\npositions_m = {rows}\n")
    assert Settings.load(tmp_path / "mine.toml").array.layout == "mine.toml"
    assert Settings().updated_from_file(tmp_path / "mine.toml").array.layout == "mine.toml"
    assert Settings.load(tmp_path / "named.toml").array.layout == "pair"
    assert Array(positions_m=rows).layout == Array().replace(positions_m=rows).layout == "own array"
    assert Settings().replace("array.positions_m", np.array(rows)).array.layout == "own array"
    with pytest.raises(ArgumentError, match=r"positions_m\[1\] has shape \(2,\); pass shape \(3,\)"):
        Array().replace(positions_m=[[0.0, 0.0, 0.0], [0.0, 1.0]])
    assert Array().layout == Settings().array.layout == "eRTIS_v3D1"
    assert Array(layout="pair", positions_m=rows).replace(word_bits=8).layout == "pair"
    shipped = written_out(Array())
    assert shipped.layout == shipped.replace(positions_m=np.array(shipped.positions_m)).layout == "eRTIS_v3D1"
    assert microphones(shipped.replace(positions_m=rows, enabled=None, gain=None, delay_s=None)).name == "own array"


def test_commands_name_an_own_array_by_its_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(1)
    wavfile.write("a.wav", 192_000, rng.normal(0, 900, (19_200, 4)).astype("<i2"))
    wavfile.write("five.wav", 192_000, np.zeros((19_200, 5), "<i2"))
    (tmp_path / "mine.toml").write_text(f"[array]\npositions_m = {(0.04 * PLACES).tolist()}\n")
    done = run("import signals a.wav --settings mine.toml --passive -o a.h5")
    assert done.exit_code == 0, done.stderr
    assert "mine.toml" in run("info a.h5").stdout
    refused = run("import signals five.wav --settings mine.toml --passive -o b.h5")
    assert "array 'mine.toml' has 4; write one row for each of 5 channels in array.positions_m" in refused.stderr
    assert "--layout" not in refused.stderr
    (tmp_path / "mics.csv").write_text(lines("{x},{y},{z}", 42))
    noted = run("import signals a.wav --layout mics.csv --passive -o c.h5")
    assert noted.exit_code == 0
    assert "note: layout mics.csv states no unit; millimetres are assumed" in noted.stderr
    assert not run("import signals a.wav --layout mics.csv --passive -o c.h5 --force --quiet").stderr


def run(command):
    return CliRunner().invoke(cli, command.split())
