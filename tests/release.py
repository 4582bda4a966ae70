"""Build the distributions, and try each of them in empty environments: ``python -m tests.release FOLDER [PAGE]``.

The distributions are built from the last commit. Every trial has an environment of its own, a folder of its own, and
an empty home folder, so that nothing of this repository can help. The table of results states what was tried, and the
command exits with 1 if anything failed. A page with a place for the tables receives them.
"""

import configparser
import os
import re
import shutil
import signal
import subprocess
import sys
import tarfile
import time
import zipfile
from collections import Counter
from collections.abc import Iterator
from importlib.metadata import distributions
from pathlib import Path
from typing import NamedTuple

import click
from ertis_bench import markdown

ROOT = Path(__file__).parents[1]
TYPED_ELSEWHERE = re.compile(r"[A-Z]{3,}\.\w+|FOLDER|RAW|platform|tcp:|ertis (?:doctor|demo|serve|sensors list)")
"""Commands with a reader's own files, and those of the block of the network, which the demo covers."""
USES = {
    "cluster": "import distributed, ertis_numba.campaign",
    "metrics": "import prometheus_client",
    "ros": "import mcap, cyclonedds; from ertis_numba.ros import Participant; Participant(domain=7).close()",
    "rtisdev": "import rtisdev",
    "view": "import viser; from ertis_numba.viewer import Playback",
    "xarray": "import xarray",
}
"""Extras that are tried, and code that needs their packages; CUDA needs a GPU, and the browser is for tests."""
WITH_EXTRA = {
    "ros": "ertis export images.h5 -o images.mcap",
    "xarray": "python -c \"import ertis_numba as e; print(e.open_energyscapes('images.h5')[0].to_xarray().dims)\"",
}
WITHOUT_NUMBA = """
ertis doctor
ertis example reflectors
ertis process reflectors.h5 -o images.h5 --device numpy
ertis peaks images.h5
ertis export images.h5 -o images.ply
ertis plot images.h5 -o picture.png
"""
FOR_AUTHORS = {"test", "docs", "check", "peers", "release"}
"""Extras that only those who work on the package install."""
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
LIMIT_S = 600.0


class Trial(NamedTuple):
    """Distribution, extra, resolution of dependencies and Python of an environment."""

    distribution: str
    python: str
    extra: str = ""
    lowest: bool = False
    numba: bool = True

    @property
    def name(self) -> str:
        kind = f" with extra {self.extra}" if self.extra else "" if self.numba else " without Numba"
        return f"{self.distribution}{kind}, {'lowest' if self.lowest else 'newest'} dependencies, Python {self.python}"


class TrialError(Exception):
    """Step of a trial that failed, with the end of its output."""


def main(folder: Path, page: Path | None = None) -> int:
    """Build, check and try the distributions; return the exit code."""
    _find_interpreters()
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    paths = build(folder)
    failures = [f"FAIL contents: {each}" for each in wrong_contents(paths)]
    rows = ["| tried | result | s from install to picture |", "| --- | --- | ---: |"]
    sizes = ""
    for trial in trials():
        begun_s = time.monotonic()
        try:
            pictured_s = perform(trial, paths[trial.distribution], folder / "trial")
            rows.append(f"| {trial.name} | passed | {pictured_s:.0f} |")
        except (TrialError, subprocess.TimeoutExpired) as error:
            rows.append(f"| {trial.name} | failed | – |")
            failures.append(f"FAIL {trial.name}: {error}")
            click.echo(failures[-1])
        sizes = sizes or size_table(folder / "trial")
        click.echo(f"{rows[-1]}  # {time.monotonic() - begun_s:.0f} s in all")
    missing = " and ".join(f"Python {each}" for each in PYTHONS if not _has(each)) or "none"
    wheel_mb = paths["wheel"].stat().st_size / 1e6
    load = f"{os.cpu_count()} cores, load average {os.getloadavg()[2]:.1f} at the end (other programs included)"
    text = "\n".join((*rows, "", f"Times on {load}. Not tried, because the machine lacked it: {missing}.", ""))
    text += f"\nThe wheel has {wheel_mb:.2f} MB. It installs these packages:\n\n{sizes}"
    click.echo("\n".join(("", text, "", *failures)))
    if page is not None:
        markdown.update(page, "make release", text)
    return 1 if failures else 0


def _find_interpreters() -> None:
    """Put the interpreters of pyenv before its shims, which fail for all versions but the selected one."""
    folders = sorted(Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")).glob("versions/3.*/bin"))
    os.environ["PATH"] = os.pathsep.join([*map(str, folders), os.environ["PATH"]])


def size_table(folder: Path) -> str:
    """Return a table of the packages of a trial's environment, and the size of their files without bytecode."""
    (place,) = folder.glob("venv/lib/python*/site-packages")
    sizes_mb = {
        each.name: sum(path.stat().st_size for file in each.files or () if (path := place / file).suffix != ".pyc")
        / 1e6
        for each in distributions(path=[str(place)])
    }
    rows = sorted(sizes_mb.items(), key=lambda item: -item[1])
    small = [name for name, size_mb in rows if size_mb < 0.5]
    shown = [(name, f"{size_mb:.1f}") for name, size_mb in rows if name not in small]
    rest = (f"{len(small)} others: {', '.join(sorted(small))}", f"{sum(sizes_mb[name] for name in small):.1f}")
    return markdown.table(("package", "MB"), (*shown, rest, ("all", f"{sum(sizes_mb.values()):.1f}")))


def trials() -> Iterator[Trial]:
    """Yield all trials that this machine allows."""
    for python in PYTHONS:
        if _has(python):
            yield Trial("wheel", python)
    yield Trial("sdist", PYTHONS[0])
    yield Trial("wheel", PYTHONS[0], lowest=True)
    yield Trial("wheel", PYTHONS[0], numba=False)
    yield from (Trial("wheel", PYTHONS[0], extra) for extra in USES)


def _has(python: str) -> bool:
    """Return whether this machine has a version of Python."""
    return _uv("python", "find", "--no-python-downloads", python, check=False).returncode == 0


def build(folder: Path) -> dict[str, Path]:
    """Build both distributions of the last commit."""
    source = folder / "source"
    source.mkdir()
    archive = subprocess.run(["git", "archive", "HEAD"], cwd=ROOT, check=True, capture_output=True).stdout
    subprocess.run(["tar", "x"], cwd=source, input=archive, check=True)
    _python("-m", "build", "--outdir", folder, source)
    (wheel,), (sdist,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    _python("-m", "twine", "check", "--strict", wheel, sdist)
    return {"wheel": wheel, "sdist": sdist}


def wrong_contents(paths: dict[str, Path]) -> Iterator[str]:
    """Yield what is twice, missing or superfluous in the distributions."""
    with zipfile.ZipFile(paths["wheel"]) as archive:
        wheel = archive.namelist()
    with tarfile.open(paths["sdist"]) as archive:
        sdist = [name.partition("/")[2] for name in archive.getnames()]
    for kind, names in (("wheel", wheel), ("sdist", sdist)):
        yield from (f"{name} is {count} times in the {kind}" for name, count in Counter(names).items() if count > 1)
        for needed in ("LICENSE", "NOTICE"):
            if not any(Path(name).name == needed for name in names):
                yield f"{needed} is not in the {kind}"
        yield from (f"{name} is in the {kind}" for name in names if re.search(r"__pycache__|\.nb[ic]$|^tests/", name))


def perform(trial: Trial, distribution: Path, folder: Path) -> float:
    """Try one distribution; return the seconds from the start of the installation to the picture of the demo."""
    shutil.rmtree(folder, ignore_errors=True)
    home = folder / "home"
    home.mkdir(parents=True)
    begun_s = time.monotonic()
    _uv("venv", "--python", trial.python, folder / "venv")
    wanted = [f"{distribution}[{trial.extra}]" if trial.extra else str(distribution)]
    if trial.lowest:
        wanted += ["--resolution", "lowest-direct", *_requirements()]
    _uv("pip", "install", "--python", folder / "venv/bin/python", *wanted)
    if not trial.numba:
        _uv("pip", "uninstall", "--python", folder / "venv/bin/python", "numba", "llvmlite")
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "ERTIS", "NUMBA"))}
    environment |= {"HOME": str(home), "MPLBACKEND": "agg", "PATH": f"{folder / 'venv/bin'}:{os.environ['PATH']}"}
    environment.pop("VIRTUAL_ENV", None)
    place = folder / "empty"
    place.mkdir()
    if not trial.numba:
        _typed(WITHOUT_NUMBA, place, environment)
        return time.monotonic() - begun_s
    _typed("ertis doctor\nertis demo", place, environment)
    pictured_s = time.monotonic() - begun_s
    if not (place / "demo" / "image.png").stat().st_size:
        raise TrialError("the demo drew no picture")
    readme = (ROOT / "README.md").read_text("utf-8")
    tour = (ROOT / "docs" / "tutorial" / "tour.md").read_text("utf-8")
    _typed("\n".join(_commands(readme + tour)), place, environment)
    (code,) = re.findall(r"```python\n(.*?)```", readme, re.DOTALL)
    (place / "readme.py").write_text(code, "utf-8")
    _typed("python readme.py", place, environment)
    if trial.extra:
        _typed(f'python -c "{USES[trial.extra]}"\n{WITH_EXTRA.get(trial.extra, "")}', place, environment)
    _uv("pip", "check", "--python", folder / "venv/bin/python")
    return pictured_s


def _commands(text: str) -> Iterator[str]:
    """Yield the commands of a page that need no file of the reader and no real sensor."""
    for line in re.findall(r"^\$ (ertis .*?)(?:\s+#.*)?$", text, re.MULTILINE):
        if not TYPED_ELSEWHERE.search(line):
            yield line


def _requirements() -> list[str]:
    """Return the stated requirements of the package."""
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    return config["options"]["install_requires"].split()


def _typed(script: str, place: Path, environment: dict[str, str]) -> None:
    """Run lines as a shell does, and end whatever they leave running."""
    process = subprocess.Popen(
        ["bash", "-euo", "pipefail", "-c", f"trap 'kill $(jobs -p) 2>/dev/null || true' EXIT\n{script}"],
        cwd=place,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    try:
        output, _ = process.communicate(timeout=LIMIT_S)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    if process.returncode:
        raise TrialError(f"exit code {process.returncode} of {script!r}:\n{output[-2000:]}")


def _python(*words: str | Path) -> None:
    _run([sys.executable, *words])


def _uv(*words: str | Path, check: bool = True) -> subprocess.CompletedProcess[str]:
    return _run([Path(sys.executable).parent / "uv", *words], check=check)


def _run(command: list[str | Path], *, check: bool = True) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=LIMIT_S)
    if check and done.returncode:
        words = " ".join(map(str, command))
        raise TrialError(f"exit code {done.returncode} of {words}:\n{done.stderr[-2000:]}{done.stdout[-1000:]}")
    return done


if __name__ == "__main__":
    sys.exit(main(*(Path(each).absolute() for each in sys.argv[1:])))
