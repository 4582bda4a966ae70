"""Commands without what Windows lacks: they work, or refuse in one line."""

import subprocess
import sys
from pathlib import Path

WORK = """\
example reflectors
simulate reflectors.toml --force
info reflectors.h5
verify reflectors.h5
sensors check reflectors.h5
process reflectors.h5 --directions 2d:91
peaks reflectors.energy.h5
compare reflectors.energy.h5
export reflectors.energy.h5 -o points.csv
export reflectors.energy.h5 -o image.mcap
plot reflectors.energy.h5 -o image.png
keys new robot --dir keys
sensors list
serve --help
capture --help"""
REFUSED = """\
sensors emulate reflectors.toml
demo"""


def test_commands_work_on_windows_or_refuse(tmp_path):
    script = Path(__file__).with_name("like_windows.py")
    done = subprocess.run(
        [sys.executable, script],
        input=f"{WORK}\n{REFUSED}\n",
        capture_output=True,
        text=True,
        cwd=tmp_path,
        check=True,
        timeout=300,
    )
    lines = [line.split(" | ") for line in done.stdout.splitlines()]
    assert [line[1] for line in lines] == [*WORK.splitlines(), *REFUSED.splitlines()]
    n_work = len(WORK.splitlines())
    assert [line for line in lines[:n_work] if line[0] != "0"] == []
    for code, _, last in lines[n_work:]:
        assert (code, last) == (
            "1",
            "ertis: error: this system has no pseudo terminals; emulate sensors on Linux or macOS",
        )
