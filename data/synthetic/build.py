"""Make the recordings of this folder from its scenes: a part of ``make data``.

Each ``NAME.toml`` becomes ``NAME.h5`` by ``ertis simulate``, and ``NAME.json`` holds the reflectors that
an image of each sensor should show and the SHA-256 of its words, as little-endian bytes. The words come out the
same everywhere. A file also names the libraries that wrote it, so its own sum in SHA256SUMS holds for
the file as it is shipped.
"""

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

from ertis_numba import open_recording

HERE = Path(__file__).parent
DATE = "1767225600"  # 2026-01-01: a recording is not to differ by the day it was made


def build(folder: Path) -> None:
    """Write the recordings, their reflectors and the sums of all files to ``folder``."""
    for scene in sorted(HERE.glob("*.toml")):
        target = folder / f"{scene.stem}.h5"
        command = [
            sys.executable,
            "-m",
            "ertis_cli.main",
            "simulate",
            str(scene),
            "-o",
            str(target),
            "--force",
            "--json",
        ]
        environment = os.environ | {"SOURCE_DATE_EPOCH": DATE}
        made = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)  # noqa: S603 - ours
        reported = json.loads(made.stdout)
        report = {
            "scene": scene.name,
            "seed": reported["seed"],
            "sensors": [
                entry | {"words_sha256": words_sha256(target, entry["sensor"])} for entry in reported["sensors"]
            ],
        }
        target.with_suffix(".json").write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    write_sums(folder)


def words_sha256(path: Path, sensor: str) -> str:
    """Return the SHA-256 of the words of all measurements of a sensor, one after the other."""
    digest = hashlib.sha256()
    with open_recording(path, sensor=sensor) as recording:
        for measurement in recording:
            words = measurement.data
            digest.update(words.astype(words.dtype.newbyteorder("<")).tobytes())
    return digest.hexdigest()


def write_sums(folder: Path) -> None:
    """Write SHA256SUMS, in the form that ``sha256sum --check`` reads."""
    files = sorted(path for path in folder.iterdir() if path.suffix in {".h5", ".json", ".toml"})
    lines = (f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}\n" for path in files)
    (folder / "SHA256SUMS").write_text("".join(lines), encoding="utf-8")


if __name__ == "__main__":
    build(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE)
