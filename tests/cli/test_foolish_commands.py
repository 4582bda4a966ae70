"""Common mistakes of newcomers on the command line are refused quickly, in one line and with the exit code."""

import shutil
import time
from pathlib import Path

import numpy as np
import pytest
import scipy
from click.testing import CliRunner
from ertis_cli.main import cli

from tests.remedies import strange_options

DATA = Path(__file__).parents[2] / "data" / "synthetic"
TIMEOUT_S = 10.0
MAX_LENGTH = 600

COMMANDS = """
process
process nope.h5
process empty.h5
process text.h5
process torn.h5
process dir
process img.h5
process scene.toml
process rec.h5 -o rec.h5
process rec.h5 -o rec.h5 --force
process rec.h5 -o x.png
process rec.h5 -o no/x.h5
process rec.h5 -o dir
process rec.h5 -o y.h5 --range 5:0
process rec.h5 -o y.h5 --range 0
process rec.h5 -o y.h5 --range a:b
process rec.h5 -o y.h5 --range -1:2
process rec.h5 -o y.h5 --range 900:1000
process rec.h5 -o y.h5 --directions many
process rec.h5 -o y.h5 --directions 2d:0
process rec.h5 -o y.h5 --directions 3d:99999999999
process rec.h5 -o y.h5 --directions nope.csv
process rec.h5 -o y.h5 --method quick
process rec.h5 -o y.h5 --beamformer mvdr
process rec.h5 -o y.h5 --max-error 10
process rec.h5 -o y.h5 --max-error lots
process rec.h5 -o y.h5 --sensor left
process rec.h5 -o y.h5 --without 99
process rec.h5 -o y.h5 --without five
process rec.h5 -o y.h5 --device gpu
process rec.h5 -o y.h5 --threads 0
process rec.h5 -o y.h5 --threads 1000
process rec.h5 -o y.h5 --workers 0
process rec.h5 -o y.h5 --settings nope.toml
process rec.h5 -o y.h5 --settings text.toml
process rec.h5 -o y.h5 --settings other.toml
process rec.h5 -o y.h5 --settings rec.h5
process rec.h5 -o y.h5 --array-weights han
process rec.h5 -o y.h5 --wavefront flat
process rec.h5 -o y.h5 --rnage 1:2
process rec.h5 img.h5
process ünï.h5
process -
proces rec.h5
peaks
peaks rec.h5
peaks img.h5 --top 0
peaks img.h5 --top x
peaks img.h5 --min-level 5
peaks img.h5 -m 7
peaks img.h5 -m -1
peaks img.h5 --sensor nope
peaks img.h5 --false-alarm 3
peaks img.h5 --detector best
peaks dir
compare rec.h5
compare img.h5 --sensor x
compare nope.h5
plot nope.h5
plot dir
plot .
plot img.h5 -o img.h5 --force
plot img.h5 -o a.gif
plot img.h5 -o a.png --kind polarr
plot img.h5 -o a.png --dynamic-range 0
plot img.h5 -o a.png --kind slices --height 99
plot img.h5 -o a.png --kind signals
plot rec.h5 -o a.png --kind signals --microphone 77
plot rec.h5 -o a.png --kind polar --microphone 3
plot nope --kind array -o a.png
plot scene.toml -o a.png
info nope.h5
info dir
info empty.h5
info text.h5
info odd.bin
verify nope.h5
verify torn.h5
verify dir
verify text.h5
simulate nope.toml
simulate rec.h5
simulate text.toml
simulate other.toml
simulate scene.toml -o scene.toml
simulate scene.toml -o s.h5 --count 0
simulate scene.toml -o s.h5 --count 99999999999
simulate scene.toml -o s.h5 --sensor unknown
simulate scene.toml -o s.h5 --tolerance-db -3
simulate scene.toml -o no/s.h5
import signals odd.bin -o o.h5 --layout eRTIS_v3D1 --preset default_25_50
import signals odd.bin -o o.h5 --layout eRTIS_v4 --preset default_25_50
import signals odd.bin -o o.h5
import signals nope.bin -o o.h5 --layout eRTIS_v3D1 --preset default_25_50
import signals rec.h5 -o o.h5 --layout eRTIS_v3D1 --preset default_25_50
import signals odd.bin -o o.h5 --layout eRTIS_v3D1 --preset quick
export img.h5 -o a.xyz
export nope.h5 -o a.ply
export img.h5 -o img.h5
export img.h5 -o a.ply --mounting nope.toml
export img.h5
reference layouts nope
reference layouts nope.csv
reference layouts text.toml
import signals odd.bin -o o.h5 --layout m.csv --preset default_25_50
import signals odd.bin -o o.h5 --layout other.toml --preset default_25_50
import signals text.txt -o o.h5 --layout eRTIS_v3D1
import signals dir -o o.h5 --layout eRTIS_v3D1
import signals rec.wav -o o.h5
import signals rec.wav -o o.h5 --passive
import signals rec.wav -o o.h5 --layout m.csv --preset default_25_50 --passive
sensors check nope.h5
sensors check text.h5
sensors calibrate rec.h5
sensors calibrate rec.h5 -o l.toml --layout m.csv
sensors calibrate rec.h5 -o l.toml --layout eRTIS_v4
sensors calibrate img.h5 -o l.toml
map rec.h5 -o m.h5
map img.h5 -o m.h5 --poses nope.csv
odometry rec.h5 -o p.csv
process rec.h5 -o y.h5 --settings wide.toml
acoustic rec.h5 -o y.h5 --bands 1:2
process rec.h5 -o y.h5 --level
fuse rec.h5 -o y.h5
acoustic rec.h5 -o y.h5 --bands 0:1
process rec.h5 -o y.h5 --layout eRTIS_v2
reference settings nope
example nope
capture
capture --port /dev/nope -o c.h5
capture --port rec.h5 -o c.h5
capture --port /dev/nope
capture --port /dev/nope -o c.h5 -n 0
capture --port /dev/nope -o c.h5 --rate 0
capture --port /dev/nope --to localhost
sensors emulate nope.h5
sensors emulate dir
sensors emulate img.h5
sensors emulate scene.toml --count 0
listen localhost
listen tcp://127.0.0.1:99999
listen tcp://127.0.0.1:9 --product images
listen
sensors status localhost
serve --listen localhost
serve --listen tcp://127.0.0.1:0 --range 5:1
serve --listen tcp://127.0.0.1:0 --key nope
record --listen tcp://127.0.0.1:0
record --listen tcp://nohost.invalid:1 -o r
record --listen tcp://127.0.0.1:0 -o rec.h5
record --listen tcp://127.0.0.1:0 -o r --rotate-size 0
import journals nope
import journals rec.h5
keys new ../x --dir k
keys new
keys show nope --dir k
keys allow nope --dir k
view nope.h5
view dir
view text.h5
view rec.h5 --port 99999
view rec.h5 --save-html a.png
view localhost:5602
view rec.h5 --threshold 5
bench nope
bench paper --count 0
bench paper --update nope.md
bench network --only nope
reference completion tcsh
sensors list --port x
doctor now
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("foolish")
    shutil.copy(DATA / "reflectors.h5", folder / "rec.h5")
    shutil.copy(DATA / "scenes" / "two_facing_sensors.toml", folder / "scene.toml")
    image = [
        "process",
        str(folder / "rec.h5"),
        "-o",
        str(folder / "img.h5"),
        "--directions",
        "2d:31",
        "--range",
        "0.5:2",
    ]
    assert CliRunner().invoke(cli, image).exit_code == 0
    (folder / "empty.h5").write_bytes(b"")
    (folder / "text.h5").write_text("hello")
    (folder / "text.toml").write_text("a = [")
    (folder / "other.toml").write_text("pionts = 3\n")
    (folder / "m.csv").write_text("0,0\n1.2,0\n0,1.2\n")
    (folder / "wide.toml").write_text('[array]\nlayout = "m.csv"\n')
    (folder / "text.txt").write_text("hello")
    scipy.io.wavfile.write(folder / "rec.wav", 192000, np.zeros((9000, 2), np.int16))
    (folder / "odd.bin").write_bytes(b"123")
    (folder / "torn.h5").write_bytes((folder / "rec.h5").read_bytes()[:50_000])
    (folder / "ünï.h5").write_bytes(b"x")
    (folder / "dir").mkdir()
    return folder


@pytest.mark.parametrize("line", COMMANDS.strip().splitlines())
def test_common_command_mistakes_are_refused_in_one_line(line, folder, monkeypatch):
    monkeypatch.chdir(folder)
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    began_s, began_cpu_s = time.monotonic(), time.process_time()
    done = CliRunner().invoke(cli, line.split())
    assert time.process_time() - began_cpu_s < TIMEOUT_S
    assert time.monotonic() - began_s < 10 * TIMEOUT_S  # A busy machine needs longer.
    assert done.exit_code in {1, 2}, (done.stdout, done.stderr)
    assert isinstance(done.exception, SystemExit), done.exception
    (reported,) = done.stderr.strip().splitlines()
    assert reported.startswith("ertis: error: ")
    assert len(reported) < MAX_LENGTH
    typed = {word.partition("=")[0] for word in line.split()}
    assert not strange_options(reported, line.split()[0]) - typed
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before
