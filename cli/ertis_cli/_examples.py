"""Examples of the package, and recordings and sound simulated from its scenes: names, descriptions and content."""

import ast
import hashlib
import json
from importlib import resources
from importlib.resources.abc import Traversable
from io import BytesIO
from pathlib import Path, PurePath
from typing import Final

from ertis_cli._config import instead

__all__ = ["content", "description", "examples", "is_written", "named", "stem", "words_sha256"]

_RECORDINGS: Final = "ertis_examples.synthetic"
"""Package with the scenes and checksums of recordings."""

_FOLDERS: Final = (("ertis_examples", ()), (_RECORDINGS, ()), (_RECORDINGS, ("scenes",)))
"""Packages, and folders in them, with examples."""

_SOUND: Final = "echoes"
"""Name of the scene that is also rendered as a WAV file."""

_SUFFIXES: Final = {".toml", ".py", ".rviz", ".yaml"}


def examples() -> dict[str, Traversable]:
    """Return the sources of examples by name: scenes of recordings and WAV files, NAME.json with their checksums."""
    found = {}
    for package, parts in _FOLDERS:
        folder = resources.files(package).joinpath(*parts)
        for item in folder.iterdir():
            name = PurePath(item.name)
            if name.suffix == ".json" and package == _RECORDINGS:
                found[f"{name.stem}.h5"] = folder / f"{name.stem}.toml"
            elif name.suffix in _SUFFIXES and item.name != "__init__.py":
                found[item.name] = item
                if name.stem == _SOUND:
                    found[f"{_SOUND}.wav"] = item
    return dict(sorted(found.items()))


def named(name: str) -> dict[str, Traversable]:
    """Return the source of the example with this name, or without a suffix of all examples of that name."""
    from ertis_numba.base.errors import ArgumentError

    every = examples()
    found = {file: item for file, item in every.items() if name in {file, stem(file)}}
    if not found:
        raise ArgumentError(f"example {name!r} does not exist; {instead(name, {stem(file) for file in every})}")
    return found


def stem(file: str) -> str:
    """Return the name of a file without suffixes."""
    return file.partition(".")[0]


def is_written(path: Path, item: Traversable) -> bool:
    """Return True if a file is the example with its name: a copy of the source, or a recording with equal samples."""
    from ertis_numba.base.errors import ErtisError

    if path.is_symlink() or not path.is_file():
        return False
    if path.suffix != ".h5":
        return path.read_bytes() == content(path, item)
    report = resources.files(_RECORDINGS) / f"{path.stem}.json"
    sensors = json.loads(report.read_text("utf-8"))["sensors"]
    try:
        return all(words_sha256(path, each["sensor"]) == each["words_sha256"] for each in sensors)
    except ErtisError:
        return False


def content(path: Path, item: Traversable) -> bytes:
    """Return the content of an example other than a recording: a copy of its source, or the sound of its scene."""
    if path.suffix != ".wav":
        return item.read_bytes()
    from scipy.io import wavfile

    from ertis_numba.simulation import load_scene
    from ertis_numba.simulation.render import render

    with resources.as_file(item) as scene:
        samples = render(load_scene(scene))
    file = BytesIO()
    wavfile.write(file, round(samples.settings.recording.sample_rate_hz), samples.data)
    return file.getvalue()


def words_sha256(path: Path, sensor: str) -> str:
    """Return the SHA-256 of the concatenated samples of all measurements of a sensor."""
    from ertis_numba.storage import open_recording

    digest = hashlib.sha256()
    with open_recording(path, sensor=sensor) as recording:
        for measurement in recording:
            words = measurement.data
            digest.update(words.astype(words.dtype.newbyteorder("<")).tobytes())
    return digest.hexdigest()


def description(name: str, item: Traversable) -> str:
    """Return the first sentence of a file's own description."""
    suffix = PurePath(name).suffix
    if suffix in {".h5", ".wav"}:
        return f"{'Recording' if suffix == '.h5' else 'Sound'} simulated from {PurePath(name).stem}.toml."
    text = item.read_text("utf-8")
    if suffix == ".py":
        text = ast.get_docstring(ast.parse(text)) or ""
    else:
        lines = text.splitlines()
        count = next((place for place, line in enumerate(lines) if not line.startswith("#")), len(lines))
        text = " ".join(line.removeprefix("#").strip() for line in lines[:count])
    return f"{' '.join(text.split()).partition('. ')[0].rstrip('.')}."
