"""Build the recordings of ``synthetic`` from its scenes, as a part of ``make data``.

``ertis simulate`` turns each ``NAME.toml`` into ``NAME.h5``. ``NAME.json`` lists the reflectors that an image of each
sensor should show, and the SHA-256 of the sensor's samples as little-endian bytes. The samples are the same on every
machine. A recording also names the libraries that wrote it, so SHA256SUMS has the checksum of the repository's file.
"""

import hashlib
import json
import sys
from pathlib import Path

from click.testing import CliRunner
from ertis_cli._examples import words_sha256
from ertis_cli.main import cli

HERE = Path(__file__).parent / "synthetic"
DATE = "1767225600"  # 2026-01-01: fixed, so that recordings do not depend on the day of the build


def build(folder: Path) -> None:
    """Write the recordings, their reflectors and the checksums of all files to ``folder``."""
    runner = CliRunner(env={"SOURCE_DATE_EPOCH": DATE})
    for scene in sorted(HERE.glob("*.toml")):
        target = folder / f"{scene.stem}.h5"
        done = runner.invoke(cli, ["simulate", str(scene), "-o", str(target), "--force", "--json", "--quiet"])
        if done.exit_code:
            sys.exit(done.output)
        reported = json.loads(done.stdout)
        report = {
            "scene": scene.name,
            "seed": reported["seed"],
            "sensors": [
                entry | {"words_sha256": words_sha256(target, entry["sensor"])} for entry in reported["sensors"]
            ],
        }
        target.with_suffix(".json").write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    write_sums(folder)


def write_sums(folder: Path) -> None:
    """Write SHA256SUMS in the format of ``sha256sum --check``."""
    files = sorted(path for path in folder.iterdir() if path.suffix in {".h5", ".json", ".toml"})
    lines = (f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}\n" for path in files)
    (folder / "SHA256SUMS").write_text("".join(lines), encoding="utf-8")


if __name__ == "__main__":
    build(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE)
