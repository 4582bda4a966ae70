"""Docstrings of public names: their examples run, and functions document parameters, results and errors."""

import doctest
import functools
import importlib
import inspect
import shutil
from pathlib import Path

import matplotlib as mpl
import pytest

import ertis_numba as ertis
from ertis_numba.frames import MicrophoneSignals

ROOT = Path(__file__).parents[2]
WITHOUT_EXAMPLE = {
    # Exceptions and warnings are caught, not called.
    *(name for name in ertis.__all__ if name.endswith(("Error", "Warning"))),
    # `Pipeline.signals` returns it and has an example.
    "MicrophoneSignals",
    # They need keys or a network. Tests run the examples on the pages of the guide instead.
    *("AllowList", "ClientKeys", "JournalEntry", "KeyPair", "Permission", "ServerKeys"),
}
"""Public names whose docstring has no example, each with its reason."""

DOCUMENTED = [
    ertis.demodulate,
    ertis.matched_filter,
    ertis.beamform,
    ertis.plot,
    ertis.open_energyscapes,
    ertis.write_energyscapes,
    ertis.Pipeline,
    ertis.Pipeline.process,
    ertis.Pipeline.process_batch,
    ertis.Pipeline.process_many,
    ertis.Pipeline.signals,
    ertis.Pipeline.beams,
    ertis.Pipeline.result,
    ertis.Settings,
    ertis.Settings.replace,
    ertis.Settings.load,
    ertis.Settings.updated_from_file,
    ertis.Settings.from_preset,
    ertis.Stamp,
    ertis.Measurement,
    ertis.Measurement.to_xarray,
    ertis.Energyscape,
    ertis.Energyscape.select,
    ertis.Energyscape.replace,
    ertis.Energyscape.to_xarray,
    ertis.Beams,
    ertis.PointCloud,
    ertis.PointCloud.replace,
    ertis.PointCloud.to_structured,
    ertis.Peak,
    ertis.Reflector,
    ertis.Trajectory,
    ertis.OccupancyMap,
    ertis.read_map,
    ertis.write_map,
]


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder with the files of ``ertis example reflectors``."""
    shutil.copy(ROOT / "data" / "synthetic" / "reflectors.h5", tmp_path)
    monkeypatch.chdir(tmp_path)
    mpl.use("Agg")
    return tmp_path


def public():
    """Yield the docstrings of the package that have examples."""
    finder = doctest.DocTestFinder(exclude_empty=True)
    root = Path(ertis.__file__).parent
    for path in sorted(root.rglob("*.py")):
        if ">>> " in path.read_text("utf-8"):
            module = importlib.import_module(".".join(path.relative_to(root.parent).with_suffix("").parts))
            for test in finder.find(module, globs={}):
                if test.examples:
                    yield pytest.param(test, id=test.name.removeprefix("ertis_numba."))


shared_pipeline = functools.cache(ertis.Pipeline)


@pytest.mark.usefixtures("place")
@pytest.mark.parametrize("example", list(public()))
def test_docstring_examples_run(example, monkeypatch):
    if not example.name.startswith(ertis.Pipeline.__module__):
        monkeypatch.setattr(ertis, "Pipeline", shared_pipeline)  # which takes most of the time to build
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE)
    shown = []
    runner.run(example, out=shown.append)
    assert not runner.failures, "".join(shown)


@pytest.mark.parametrize("subject", DOCUMENTED, ids=lambda subject: subject.__qualname__)
def test_public_names_of_the_array_interface_have_examples(subject):
    text = inspect.getdoc(subject)
    assert "Examples\n--------" in text
    if inspect.isclass(subject):
        assert "Attributes\n----------" in text
    elif len(inspect.signature(subject).parameters) > ("self" in inspect.signature(subject).parameters):
        assert "Parameters\n----------" in text
    assert not text.startswith(("What", "Which", "Whether", "How", "From", "See"))


def test_public_names_have_an_example_or_a_reason():
    without = {
        name for name in ertis.__all__ if "Examples\n--------" not in (inspect.getdoc(getattr(ertis, name)) or "")
    }
    assert without == WITHOUT_EXAMPLE


def test_signals_have_a_unit_for_each_attribute():
    text = inspect.getdoc(MicrophoneSignals)
    for name in MicrophoneSignals.__dataclass_fields__:
        assert f"\n{name} : " in text
