"""The recipes of CONTRIBUTING.md: each is performed with a toy, in a copy of the package, and used in a new process."""

import os
import re
import shutil
import subprocess
import sys

import pytest

from tests.pages import ROOT

PAGE = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
COPIED = ("ertis_numba", "cli", "examples", "docs/explanation", "docs/how-to", "docs/reference")
BEFORE_END = "<end>"


def recipe(name):
    """Return the text of a section."""
    return re.search(rf"^## Add {name}\n(.*?)(?=^## |\Z)", PAGE, re.DOTALL | re.MULTILINE)[1]


def steps(name):
    """Return the files of the numbered steps of a section."""
    return re.findall(r"^\d\. \*\*`([\w./-]+)`\*\*", recipe(name), re.MULTILINE)


@pytest.fixture
def copy(tmp_path):
    """Copy the package by links: a file that a recipe changes gets a new content in a new file."""
    for folder in COPIED:
        shutil.copytree(ROOT / folder, tmp_path / folder, copy_function=os.link)
    return tmp_path


def perform(copy, name, toy, changes):
    """Perform the steps of a recipe: insert texts before anchors, or create files."""
    wanted = [path.replace("NAME", toy) for path in steps(name)]
    assert list(changes) == wanted
    for path, change in changes.items():
        file = copy / path
        if isinstance(change, str):
            assert not file.exists()
            file.write_text(change, "utf-8")
            continue
        text = file.read_text("utf-8")
        for anchor, added in change:
            assert anchor == BEFORE_END or text.count(anchor) == 1, (path, anchor)
            text = text + added if anchor == BEFORE_END else text.replace(anchor, added + anchor)
        file.unlink()
        file.write_text(text, "utf-8")


def run(copy, code):
    """Run code with the copy in a new process, without compiled kernels, and return what it prints."""
    paths = os.pathsep.join(map(str, (copy, copy / "cli", ROOT)))
    environment = os.environ | {"PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": "1"}
    code = f"import ertis_numba\nassert ertis_numba.__file__.startswith({str(copy)!r})\n{code}"
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, check=False, capture_output=True, text=True, env=environment, cwd=copy)
    assert done.returncode == 0, done.stderr
    return done.stdout


EFFECT = '''"""Halved amplitude of all echoes."""

import numpy as np

__all__ = ["estimate", "gain"]


def gain(shot, paths, emitter, frequency_hz):
    """Return a half."""
    return np.full((1, 1, 1), 0.5)


def estimate(sight):
    """Return None: the effect changes nothing that counts."""
    return None
'''


def test_effect(copy):
    entry = """        Effect(
            name="halving",
            summary="halved amplitude of all echoes",
            places=("gain",),
            keys=("count",),
            example=_POINT + "count = 2\\n",
        ),
"""
    changes = {
        "ertis_numba/simulation/effects/halving.py": EFFECT,
        "ertis_numba/simulation/effects/__init__.py": [
            ('        Effect(\n            name="absorption",', entry),
        ],
        "docs/explanation/simulator.md": [("| `absorption` |", "| `halving` | 1 / 2 | | never |\n")],
    }
    perform(copy, "an effect of a scene", "halving", changes)
    found = run(
        copy,
        """
import numpy as np
from ertis_numba.simulation.effects import EFFECTS
from tests.scenes import EAR, Scene, ways
from ertis_numba.simulation import Point
scene = Scene(sensors=(EAR,), points=(Point(azimuth_deg=0.0, range_m=0.5),), count=2)
half, whole = (abs(ways(scene, *names)[0].amplitude).max() for names in (("halving",), ()))
print(half / whole, "halving" in EFFECTS)
""",
    )
    assert found.split() == ["0.5", "True"]


BEAMFORMER = '''"""Median of the magnitudes of all microphones."""

import numpy as np
from numba import njit, prange

from ertis_numba.kernels._scalar import magnitude

__all__ = ["combine_median"]


@njit(parallel=True, nogil=True, cache=True)
def combine_median(signals, offsets, weights, out):
    """Return the median of the magnitudes of all microphones."""
    flat = signals.reshape(-1)
    n_mics = offsets.shape[1]
    for direction in prange(len(out)):
        for r in range(out.shape[1]):
            found = np.empty(n_mics, np.float32)
            for mic in range(n_mics):
                y = flat[offsets[direction, mic] + r] * weights[direction, mic]
                found[mic] = magnitude(y.real, y.imag)
            out[direction, r] = np.median(found)
'''
CUDA_BEAMFORMER = '''"""Median of the magnitudes of all microphones; the method is that of the CPU kernel."""

__all__ = ["combine_median"]


def combine_median(signals, offsets, weights, out):
    """Return the median of the magnitudes of all microphones."""
    raise NotImplementedError
'''


def test_beamformer(copy):
    contract = '''class CombineMedian(Protocol):
    """Return the median of the magnitudes ``|y|`` of all microphones."""

    def __call__(self, signals: Complex, offsets: Index, weights: Complex, out: Real) -> None: ...


'''
    twin = '''def combine_median(signals: Complex, offsets: Index, weights: Complex, out: Real) -> None:
    """Return the median of the magnitudes of all microphones."""
    for direction, y in _delayed(signals, offsets, weights, out.shape[1]):
        out[direction] = np.median(np.abs(y), axis=0)


'''
    changes = {
        "ertis_numba/settings/beamformers.py": [
            ('"capon"]\n', '"median", '),
            (
                '        "capon": Beamformer(',
                '        "median": Beamformer(title="median", kernel="combine_median"),\n',
            ),
        ],
        "ertis_numba/kernels/_contract/adaptive.py": [
            ("@dataclass(", contract),
            ("    weight_coherence: WeightCoherence", "    combine_median: CombineMedian\n"),
        ],
        "ertis_numba/kernels/_cpu/combine_median.py": BEAMFORMER,
        "ertis_numba/kernels/_cuda/combine_median.py": CUDA_BEAMFORMER,
        "ertis_numba/kernels/_numpy.py": [("def combine_capon(", twin)],
        "ertis_numba/pipeline/verification/_beamformers.py": [
            ('    "capon": _capon,', '    "median": lambda y, _: np.median(np.abs(y), axis=0),\n'),
        ],
        "docs/explanation/beamformers.md": [("| `capon` | `snapshots`", "| `median` | | tests | no resolution |\n")],
    }
    perform(copy, "a beamformer", "median", changes)
    found = run(
        copy,
        """
import numpy as np
from ertis_cli.process import process
import ertis_numba as ertis
from ertis_numba.kernels._cpu.combine_median import combine_median
from ertis_numba.kernels._numpy import KERNELS
from tests.files import SMALL, noise
(choices,) = [each.type.convert("median", None, None) for each in process.params if each.name == "beamformer"]
rng = np.random.default_rng(1)
signals = (rng.standard_normal((3, 40)) + 1j * rng.standard_normal((3, 40))).astype(np.complex64)
offsets, weights = np.array([[0, 41, 83]], np.int32), np.array([[1, 0.5, 2]], np.complex64)
two = [np.zeros((1, 30), np.float32) for _ in range(2)]
for kernel, out in zip((combine_median.py_func, KERNELS.combine_median), two):
    kernel(signals, offsets, weights, out)
settings = SMALL.replace(**{"processing.beamformer": "median", "processing.directions": "2d:3"})
image = ertis.Pipeline(settings, "numpy").process(noise(settings)[0])
print(choices["beamformer"] == "median", np.allclose(*two, rtol=1e-6), image.amplitude.min() > 0)
""",
    )
    assert found.split() == ["True", "True", "True"]


def test_map_method(copy):
    function = '''def squared(spectrum: CrossSpectrum, waves: Waves, passive: Passive) -> Powers:
    """Return the square of `delay_and_sum`."""
    return delay_and_sum(spectrum, waves, passive) ** 2


'''
    changes = {
        "ertis_numba/settings/map_methods.py": [
            ('"hr_clean_sc"]\n', '"squared", '),
            ('        "clean_sc": MapMethod(', '        "squared": MapMethod(title="square", has_level=False),\n'),
        ],
        "ertis_numba/passive/methods.py": [
            ("METHODS: Final", function),
            ('    "clean_sc": clean_sc,', '    "squared": squared,\n'),
        ],
        "docs/explanation/acoustic-maps.md": [("| `clean_sc` | sum of", "| `squared` | `(v^H C v / M²)²` | |\n")],
    }
    perform(copy, "a method of acoustic maps", "squared", changes)
    found = run(
        copy,
        """
import numpy as np
from click.testing import CliRunner
from ertis_cli.main import cli
import ertis_numba as ertis
from ertis_numba.frames import Stamp
from tests.files import SMALL, noise
import os, tempfile
os.chdir(tempfile.mkdtemp())
settings = SMALL.replace("processing.directions", "2d:9")
ertis.write_recording("rec.h5", noise(settings))
for method in ("delay_and_sum", "squared"):
    line = f"acoustic rec.h5 -o {method}.h5 --method {method} --bands 30000:60000 --device numpy"
    done = CliRunner().invoke(cli, line.split())
    assert done.exit_code == 0, done.output
one, two = (ertis.open_acoustic_maps(f"{name}.h5")[0] for name in ("delay_and_sum", "squared"))
print(one.has_level, two.has_level, two.power.max() > 0, two.loudest()[0].level_dbfs is None)
""",
    )
    assert found.split() == ["True", "False", "True", "True"]


def test_export_format(copy):
    entry = """        "xyz": ExportFormat(
            suffix=".xyz",
            content="points",
            writer=f"{_FILES}:write_xyz",
            fields=("x", "y", "z"),
            options=_POINT_OPTIONS,
            about="as text",
        ),
"""
    writer = '''

def write_xyz(path: Path, table: PointTable) -> None:
    """Write the positions of points as text."""
    np.savetxt(path, np.stack([table.rows[name] for name in "xyz"], axis=1))
'''
    changes = {
        "ertis_numba/interop/export_formats.py": [('        "csv": ExportFormat(', entry)],
        "ertis_numba/interop/_point_files.py": [(BEFORE_END, writer)],
        "docs/how-to/export.md": [("| `csv` | `.csv`", "| `xyz` | `.xyz` | `x`, `y`, `z` | all but positions |\n")],
    }
    perform(copy, "an export format", "xyz", changes)
    found = run(
        copy,
        """
from click.testing import CliRunner
from ertis_cli.main import cli
import ertis_numba as ertis
import numpy as np, os, tempfile
from tests.files import image
os.chdir(tempfile.mkdtemp())
ertis.write_energyscapes("img.h5", [image()])
runner = CliRunner()
assert runner.invoke(cli, "export img.h5 -o points.xyz --top 3".split()).exit_code == 0
refused = runner.invoke(cli, "export img.h5 -o other.xyz --ascii".split())
print(np.loadtxt("points.xyz", ndmin=2).shape, refused.exit_code, ".xyz as text" in runner.invoke(
    cli, ["export", "--help"], terminal_width=500).stdout)
""",
    )
    assert found.split() == ["(1,", "3)", "2", "True"]


def test_product(copy):
    message = '''class Tally(Message, frozen=True, kw_only=True):
    """Number of products so far."""

    routes = (("publisher", "application"),)
    product = "tally"

    number: Count
    dropped: Count
    made: Count


'''
    changes = {
        "ertis_numba/network/product_messages.py": [
            ('"status"]\nPRODUCTS', '"tally", '),
            ("ProductMessage: TypeAlias", message),
            (" | Report\n", " | Tally"),
        ],
        "ertis_numba/network/products.py": [
            ("import ProductMessage\n", "import Tally\nfrom ertis_numba.network.product_messages "),
            (" | Status\n", " | Tally"),
            ("    Group: lambda", "    Tally: lambda _, header, __: header,\n"),
        ],
        "ertis_numba/network/processing/publisher_process.py": [
            (
                '                self._subscribers.offer(QueuedProduct("status",',
                """                tally = Tally(number=0, dropped=0, made=self._reports)
                self._subscribers.offer(QueuedProduct("tally", "", tally))
""",
            ),
            (
                "from ertis_numba.network.processing.subscribers",
                "from ertis_numba.network.product_messages import Tally\n",
            ),
        ],
        "cli/ertis_cli/_product_printer.py": [
            ('    "group": lambda _', '    "tally": lambda _, item: ({"made": item.made}, f"{item.made} made"),\n'),
        ],
        "docs/reference/network-protocol.md": [("| `group` |", "| `tally` | publisher → application | | |\n")],
    }
    perform(copy, "a product", "tally", changes)
    found = run(
        copy,
        """
from types import SimpleNamespace
from click.testing import CliRunner
from ertis_cli.main import cli
from ertis_cli._product_printer import PRINTERS
from ertis_numba.network.messages import decode, encode
from ertis_numba.network.processing import pipe_messages, publisher_process
from ertis_numba.network.products import ProductReader
offered = []
publisher = SimpleNamespace(_reports=4, _status=b"", _subscribers=SimpleNamespace(offer=offered.append))
(process,) = [each for each in vars(publisher_process).values() if hasattr(each, "_obey")]
process._obey(publisher, pipe_messages.StatusNote(status=b""))
(tally,) = [decode(encode(each.header)) for each in offered if each.product == "tally"]
about, text = PRINTERS[tally.product](None, ProductReader().read(tally, []))
print(about["made"], text, "tally" in CliRunner().invoke(cli, ["listen", "--help"]).stdout)
""",
    )
    assert found.split() == ["5", "5", "made", "True"]
