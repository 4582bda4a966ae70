"""Commands in an environment without an extra: one line names the extra, and all other commands work."""

import re
from configparser import ConfigParser
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import pytest

from tests.files import noise
from tests.pages import forking
from tests.release import FOR_AUTHORS

ROOT = Path(__file__).parents[2]
NEEDED_BY = {
    "browser": ["{root}/docs/pictures/view.py"],
    "cluster": [
        "process a.h5 b.h5 -o out/ --workers tcp://127.0.0.1:1",
        "serve --listen tcp://127.0.0.1:0 --publish tcp://127.0.0.1:0 --workers tcp://127.0.0.1:1",
    ],
    "cu12": ["process a.h5 -o a.energy.h5 --device cuda"],
    "cu13": ["process a.h5 -o a.energy.h5 --device cuda"],
    "metrics": ["serve --listen tcp://127.0.0.1:0 --publish tcp://127.0.0.1:0 --metrics 127.0.0.1:0"],
    "ros": ["export a.h5 -o a.mcap", "map a.h5 -o a.mcap", "ros a.h5"],
    "rtisdev": ["sensors rtisdev {root}/tests/xarray_script.py"],
    "xarray": ["{root}/tests/xarray_script.py"],
    "view": ["view a.h5 --no-open --port 0", "view a.h5 --save-html a.html", "view tcp://127.0.0.1:1 --no-open"],
}
"""Commands that use what an extra brings; the script of an extra that no command uses."""

NEEDED_ALONE = {"cyclonedds": "ros a.h5"}
"""Commands that use a distribution, where the first one of its extra does not."""

WITHOUT = """
import runpy, sys

class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {blocked!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Blocked())
"""
RUN = (
    WITHOUT
    + """
if {words!r}[0].endswith(".py"):
    runpy.run_path({words!r}[0], run_name="__main__")
else:
    from ertis_cli.__main__ import main
    sys.argv[1:] = {words!r}
    main()
"""
)
HELP = (
    WITHOUT
    + """
from click.testing import CliRunner
from ertis_cli.main import COMMANDS, cli

for name in COMMANDS:
    done = CliRunner().invoke(cli, [name, "--help"])
    assert done.exit_code == 0, (name, done.output)
"""
)


def names_in(requirements):
    """Names of the distributions of lines of requirements."""
    return [re.split(r"[\[<>=;]", line)[0].strip() for line in requirements.split("\n") if line]


def extras():
    """Distributions of each extra that users install; extras may also limit the version of one that all users have."""
    parser = ConfigParser()
    parser.read(ROOT / "setup.cfg")
    always = names_in(parser["options"]["install_requires"])
    return {
        name: [each for each in names_in(lines) if each not in always]
        for name, lines in parser["options.extras_require"].items()
        if name not in FOR_AUTHORS
    }


def modules_of(name):
    """Import names of a distribution; none if it is not installed.

    The names are those of `importlib.metadata.packages_distributions`, which takes a second to read all distributions.
    """
    try:
        found = distribution(name)
    except PackageNotFoundError:
        return []
    declared = (found.read_text("top_level.txt") or "").split()
    files = [file for file in found.files or [] if file.suffix == ".py"]
    return declared or sorted({file.parts[0] if len(file.parts) > 1 else file.stem for file in files})


def cases():
    """Each package of each extra is missing once, and then all packages of the extra together."""
    for name, distributions in extras().items():
        missing = {each: found for each in distributions if (found := modules_of(each))}
        every = [module for each in missing.values() for module in each]
        lines = [(every, line) for line in NEEDED_BY[name]]
        if len(missing) > 1:
            lines += [(found, NEEDED_ALONE.get(each, NEEDED_BY[name][0])) for each, found in missing.items()]
        for blocked, line in lines:
            yield pytest.param(name, blocked, line, id=f"{name}-{'+'.join(blocked)}-{line.split()[0]}")


def files(place):
    """Files of the folder, except Matplotlib's list of fonts."""
    return {path for path in place.rglob("*") if path.is_file() and not path.name.startswith("fontlist")}


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    from ertis_numba.storage import write_recording  # noqa: PLC0415

    folder = tmp_path_factory.mktemp("extras")
    for name in ("a.h5", "b.h5"):
        write_recording(folder / name, noise(count=1))
    return folder


@pytest.fixture(scope="module")
def run_forked(place, tmp_path_factory):
    """Run programs that import none of the packages of extras before they are blocked."""
    blocked = {module for names in extras().values() for each in names for module in modules_of(each)}
    preload = ("numpy", "scipy.fft", "scipy.spatial", "numba", "h5py", "click", "msgspec", "matplotlib.figure")
    with forking(place, tmp_path_factory.mktemp("output"), preload, unloaded=sorted(blocked)) as run_forked:
        yield run_forked


def test_every_extra_has_a_command_that_needs_it():
    assert set(NEEDED_BY) == set(extras())


@pytest.mark.parametrize(("name", "blocked", "line"), [*cases()])
def test_missing_extra_is_named_in_one_line(place, run_forked, name, blocked, line):
    before = files(place)
    code, out, err = run_forked(RUN.format(blocked=blocked, words=line.format(root=ROOT).split()))
    assert code == 1, (out, err)
    lines = err.splitlines()
    assert len(lines) == 1, err
    assert lines[0].startswith("ertis: error: ") or line.startswith("{root}")
    other = "cu12" if name == "cu13" else name
    assert f"ertis-numba[{other}]" in lines[0]
    assert files(place) == before


def test_commands_work_without_extras(run_forked):
    blocked = [module for names in extras().values() for each in names for module in modules_of(each)]
    code, out, err = run_forked(HELP.format(blocked=blocked))
    assert code == 0, (out, err)
    line = "process a.h5 -o {} --force --quiet --device cpu"
    for words in (line.format("images.h5"), "export images.h5 -o cloud.ply", "plot images.h5 -o image.png"):
        code, out, err = run_forked(RUN.format(blocked=blocked, words=words.split()))
        assert code == 0, (words, out, err)
