"""Progress bars and tables on a terminal, and plain output elsewhere."""

import io
import json
import re
import subprocess
import sys

import click
import msgspec
import pytest
from click.testing import CliRunner
from ertis_cli import _tables, options
from ertis_cli.main import COMMANDS, cli
from ertis_cli.status import _drawn, _print
from rich.console import Console

from ertis_numba.storage import write_energyscapes
from tests.files import image
from tests.network.test_status import BUSY
from tests.pages import environment
from tests.terminals import Terminal, seen

BAR = """
import signal
import sys
import click
from ertis_cli import options
signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
try:
    with options.progress(range(3), length=3, label="work[ing]", quiet="--quiet" in sys.argv) as shown:
        for item in shown:
            if "--wait" in sys.argv:
                sys.stdin.readline()
            click.echo(f"note {item}: {'long ' * 30}", err=True)
            click.echo(f"result {item}: {'long ' * 30}")
            if "--fail" in sys.argv:
                raise ValueError
except (KeyboardInterrupt, SystemExit, ValueError) as error:
    print("ended", file=sys.stderr)
    sys.exit({KeyboardInterrupt: 130, SystemExit: 143, ValueError: 1}[type(error)])
print("rich" in sys.modules, file=sys.stderr)
"""
NOTES = [f"note {item}: {'long ' * 30}".rstrip() for item in range(3)]
RESULTS = [f"result {item}: {'long ' * 30}".rstrip() for item in range(3)]
TABLE = """
from ertis_cli._tables import TextTable
columns = {"port": "left", "state": "left", "rate_hz": "right", "count": "right"}
rows = [("/dev/serial/by-id/usb-of-a-long-name", "in use", "12.345", "7"), ("[b]", "failed", "-1.0", "123456")]
TextTable(columns, rows, {"failed": "red"}).print()
import sys
print("rich" in sys.modules)
"""
IMPORT = "from ertis_cli.main import main; main()"
COLOUR = re.compile(r"\x1b\[[\d;]*\b(?:3[0-8]|4[0-8]|9\d|10\d)[\d;]*m")


def ends(terminal):
    """End the process with its cursor visible."""
    code, reported = terminal.finish()
    assert terminal.shown.rfind("\x1b[?25h") >= terminal.shown.rfind("\x1b[?25l")
    return code, reported


# ---- bars -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("coloured", [True, False])
def test_progress_bar_shows_progress_and_disappears(tmp_path, coloured):
    with Terminal(BAR, tmp_path, "--wait", piped=True, **({} if coloured else {"NO_COLOR": "1"})) as terminal:
        for done in range(3):
            terminal.until(f"{done}/3")
            terminal.go_on()
        code, reported = ends(terminal)
        assert code == 0
        assert bool(COLOUR.search(terminal.shown)) == coloured
        # Its last picture, before it goes.
        drawn = seen(terminal.shown.rpartition("\x1b[?25h")[0], 100)
        assert any(re.match(r"work\[ing\] ━+ 3/3 +0:00:\d\d +0:00:00 left$", line) for line in drawn)
        # Nothing is left of it but what was told meanwhile.
        assert "".join(terminal.lines) == "".join([*NOTES, "True"])
        assert [line.rstrip() for line in reported.splitlines()] == RESULTS


@pytest.mark.parametrize("columns", [20, 50, 200])
def test_lines_are_printed_whole_above_the_bar(tmp_path, columns):
    with Terminal(BAR, tmp_path, columns=columns) as terminal:
        assert ends(terminal) == (0, None)
        expected = [line for both in zip(NOTES, RESULTS, strict=True) for line in both]
        shown = " ".join("".join(terminal.lines).split())
        assert shown.replace(" ", "") == "".join([*expected, "True"]).replace(" ", "")
        for line in expected:  # which the terminal has broken, if it is broken
            assert line in terminal.shown


@pytest.mark.parametrize(
    ("arguments", "variables"), [(["--quiet"], {}), ([], {"TERM": "dumb"}), ([], {"TERM": "unknown"})]
)
def test_bar_is_omitted_if_unwanted_or_impossible(tmp_path, arguments, variables):
    with Terminal(BAR, tmp_path, *arguments, columns=200, piped=True, **variables) as terminal:
        assert terminal.finish()[0] == 0
        assert "\x1b" not in terminal.shown
        assert terminal.lines == [*NOTES, "False"]


def test_bar_is_omitted_without_a_terminal(tmp_path):
    given = environment(tmp_path) | {"FORCE_COLOR": "1"}
    done = subprocess.run([sys.executable, "-c", BAR], env=given, capture_output=True, text=True, check=True)
    assert [line.rstrip() for line in done.stderr.splitlines()] == [*NOTES, "False"]


def test_error_removes_the_bar(tmp_path):
    with Terminal(BAR, tmp_path, "--fail", columns=200, piped=True) as terminal:
        assert ends(terminal)[0] == 1
        assert "0/3" in terminal.shown
        assert terminal.lines == [NOTES[0], "ended"]


@pytest.mark.parametrize(("key", "code"), [(b"\x03", 130), (None, 143)])
def test_signal_removes_the_bar(tmp_path, key, code):
    with Terminal(BAR, tmp_path, "--wait", columns=200, piped=True) as terminal:
        terminal.until("0/3")
        terminal.go_on()
        terminal.until("1/3")
        if key:
            terminal.press(key)
        else:
            terminal.end()
        assert ends(terminal)[0] == code
        assert terminal.lines == [NOTES[0], "ended"]


# ---- status lines ---------------------------------------------------------------------------------

STATUS = """
import sys
from ertis_cli._progress import StatusLine

line = StatusLine(sys.stderr.write, quiet="--quiet" in sys.argv)
for count in range(3):
    line.draw(f"{count} stored   " + 30 * "x")
    sys.stderr.write(line.above(f"note {count}\\n"))
line.draw("last")
line.clear()
sys.stderr.flush()
"""


@pytest.mark.parametrize("columns", [20, 200])
def test_status_line_fits_its_terminal_and_leaves_only_notes(tmp_path, columns):
    with Terminal(STATUS, tmp_path, columns=columns) as terminal:
        assert terminal.finish()[0] == 0
        assert "2 stored   xxxx" in terminal.shown
        assert terminal.lines == ["note 0", "note 1", "note 2"]


@pytest.mark.parametrize(("arguments", "variables"), [(["--quiet"], {}), ([], {"TERM": "dumb"})])
def test_status_line_is_omitted_if_unwanted_or_impossible(tmp_path, arguments, variables):
    with Terminal(STATUS, tmp_path, *arguments, **variables) as terminal:
        assert terminal.finish()[0] == 0
        assert terminal.shown.split() == ["note", "0", "note", "1", "note", "2"]


# ---- tables ---------------------------------------------------------------------------------------


def test_piped_table_is_plain_text_of_any_width(tmp_path):
    given = environment(tmp_path) | {"FORCE_COLOR": "1", "COLUMNS": "20"}
    done = subprocess.run([sys.executable, "-c", TABLE], env=given, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [
        "port                                  state   rate_hz   count",
        "/dev/serial/by-id/usb-of-a-long-name  in use   12.345       7",
        "[b]                                   failed     -1.0  123456",
        "False",
    ]


@pytest.mark.parametrize("coloured", [True, False])
def test_table_fits_the_terminal(tmp_path, coloured):
    with Terminal(TABLE, tmp_path, **({} if coloured else {"NO_COLOR": "1"})) as terminal:
        assert terminal.finish()[0] == 0
        head, first, second, loaded = terminal.lines
        assert head.split() == ["port", "state", "rate_hz", "count"]
        assert first.split() == ["/dev/serial/by-id/usb-of-a-long-name", "in", "use", "12.345", "7"]
        assert second.split() == ["[b]", "failed", "-1.0", "123456"]
        assert first.index("12.345") + 6 == second.index("-1.0") + 4
        assert loaded == "True"
        assert "\x1b[1m" in terminal.shown  # bold
        assert bool(COLOUR.search(terminal.shown)) == coloured


def test_table_on_a_dumb_terminal_is_plain(tmp_path):
    with Terminal(TABLE, tmp_path, TERM="dumb") as terminal:
        assert terminal.finish()[0] == 0
        assert "\x1b" not in terminal.shown
        assert terminal.lines[-1] == "False"


@pytest.mark.parametrize("columns", [15, 40, 60])
def test_numbers_in_tables_are_never_wrapped(tmp_path, columns):
    with Terminal(TABLE, tmp_path, columns=columns) as terminal:
        assert terminal.finish()[0] == 0
        for number in ("12.345", "7", "-1.0", "123456"):
            assert number in re.sub(r"\x1b\[\d+m", "", terminal.shown).split()
        if columns == 40:  # names are folded then, and headings broken at their words
            assert [line.split() for line in terminal.lines] == [
                ["rate"],
                ["port", "state", "hz", "count"],
                ["/dev/serial/by-i", "in", "use", "12.345", "7"],
                ["d/usb-of-a-long-"],
                ["name"],
                ["[b]", "failed", "-1.0", "123456"],
                ["True"],
            ]


def test_command_prints_the_same_on_a_terminal_and_in_a_pipe(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", [image()])
    piped = CliRunner().invoke(cli, ["peaks", str(path), "--top", "3"]).output
    with Terminal(IMPORT, tmp_path, "peaks", path, "--top", "3", columns=200) as terminal:  # no heading is broken
        assert terminal.finish()[0] == 0
        assert "\n".join(terminal.lines).split() == piped.split()
        assert "\x1b[1m" in terminal.shown


def test_table_without_rows_is_printed():
    assert list(_tables.TextTable({"what": "left", "ms": "right"}, []).lines()) == ["what  ms"]


def test_status_is_neither_wrapped_nor_cut_in_a_pipe(capsys):
    missing = {f"reason {number}": 3 for number in range(60)}
    sensors = {"front": msgspec.structs.replace(BUSY.sensors["front"], missing=missing)}
    _print(msgspec.structs.replace(BUSY, sensors=sensors), "", as_json=False)
    (row,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("front")]
    assert "3 reason 0, " in row
    assert "3 reason 59  " in row


def test_status_fits_a_terminal_of_80_columns():
    screen = io.StringIO()
    Console(file=screen, width=80).print(_drawn(BUSY))
    row = next(line for line in screen.getvalue().splitlines() if line.startswith("front"))
    assert row.split()[1:6] == ["20.0", "41", "40", "37", "2"]
    assert "12.2/40.0" in row


# ---- JSON -----------------------------------------------------------------------------------------


def test_help_describes_json_output():
    context = click.Context(cli, **cli.context_settings)
    about = {}
    for name in COMMANDS:
        command = cli.get_command(context, name)
        members = command.commands.values() if isinstance(command, click.Group) else [command]
        for member in members:
            about |= {f"{name} {member.name}": option.help for option in member.params if "--json" in option.opts}
    assert all("JSON" in text and "stdout" in text for text in about.values())
    for name in ("capture", "listen"):
        assert "one object per line for each" in about[f"{name} {name}"]
    assert "with --watch one per line" in about["sensors status"]
    assert "one per line if there are several" in about["process process"]
    assert "one per line if there are several" in about["info info"]


def test_every_json_line_is_an_object(capsys):
    options.print_json({"text": "two\nlines", "value": 1.0})
    (line,) = capsys.readouterr().out.splitlines()
    assert json.loads(line) == {"text": "two\nlines", "value": 1.0}
