"""``ertis view``: refusals, output, and its page of the guide."""

import json
import os
import re
import signal
import socket
import threading
import webbrowser

import pytest
from click.testing import CliRunner
from ertis_cli import view
from ertis_cli.main import cli

from ertis_numba.storage import write_energyscapes, write_recording
from ertis_numba.viewer import ViewedScene, Viewer
from ertis_numba.viewer._recordings import MAX_BYTES
from tests.pages import commands_in, path_of, run_code_here, run_here
from tests.publishing import Publisher, image as published
from tests.viewer.test_view_maps import passive_noise
from tests.views import PATIENCE_S, stamped

BIND = socket.socket.bind


@pytest.mark.parametrize(
    ("arguments", "reported"),
    [
        (("missing.h5",), "missing.h5"),
        (
            ("127.0.0.1:5602",),
            "'127.0.0.1:5602' is not a file; for the address of a central node, use tcp://127.0.0.1:5602",
        ),
        (
            ("tcp:127.0.0.1:5602",),
            "'tcp:127.0.0.1:5602' is not a file; for the address of a central node, use tcp://127.0.0.1:5602",
        ),
        (("IMG", "--save-html", "p.png"), "p.png ends in '.png'; choose a name that ends in .html, .htm"),
        (("IMG", "--sensor", "back"), "back"),
        (("IMG", "--decay", "99"), "--decay is 99; use"),
        (("IMG", "--range", "5:1"), "--range runs from 5 to 1"),
        (("IMG", "--key", "viewer"), "--key is for an address; remove it with playback of a file"),
        (("IMG", "--server-key", "key"), "--server-key is for an address"),
        (("IMG", "--threshold", "5"), "--threshold is 5; use a number from -60 to 0"),
        (
            ("IMG", "--save-html", "OTHER"),
            "other.html exists; choose another name, or replace the file (--force)",
        ),
        (("IMG", "--save-html", "IMG", "--force"), "img.h5 is the input itself; choose another name"),
        (("IMG", "--save-html", "p.html", "--duration", "1"), "--duration is for an address or playback of a file"),
        (("IMG", "--save-html", "p.html", "--loop"), "--loop is for playback of a file; remove it with a file"),
        (("IMG", "--save-html", "p.html", "--host", "0.0.0.0"), "--host is for an address or playback of a file"),
        (("IMG", "--save-html", "p.html", "--port", "1"), "--port is for"),
        (("IMG", "--save-html", "p.html", "--no-open"), "--open is for"),
        (("IMG", "--force"), "--force is for --save-html; remove it"),
        (("IMG", "--duration", "0"), "--duration is 0; use a number above 0"),
        (("tcp://0.0.0.0:5602",), "keys"),
        (("tcp://127.0.0.1:5602", "--loop"), "--loop is for playback of a file; remove it with an address"),
        (
            ("tcp://127.0.0.1:5602", "--device", "cpu"),
            "--device is for playback of a file or a file that --save-html",
        ),
    ],
)
def test_unviewable_input_is_refused_in_one_line(tmp_path, arguments, reported):
    path = write_energyscapes(tmp_path / "img.h5", stamped(1))
    (tmp_path / "other.html").touch()
    named = {"IMG": path, "OTHER": tmp_path / "other.html", "p.html": tmp_path / "p.html", "p.png": tmp_path / "p.png"}
    before = {each: each.read_bytes() for each in tmp_path.iterdir()}
    done = CliRunner().invoke(cli, ["view", *(str(named.get(word, word)) for word in arguments)])
    assert done.exit_code != 0
    assert reported in f"{done.stderr} {done.exception}"
    assert {each: each.read_bytes() for each in tmp_path.iterdir()} == before


def test_config_defaults_apply_to_their_commands_only(tmp_path, monkeypatch):
    path = write_energyscapes(tmp_path / "img.h5", stamped(1))
    config = tmp_path / "config.toml"
    config.write_text('[view]\nhost = "0.0.0.0"\nloop = true\n')
    listened = []
    monkeypatch.setattr(socket.socket, "bind", lambda self, address: listened.append(address) or BIND(self, address))
    done = CliRunner().invoke(
        cli, ["--config", str(config), "view", str(path), "--save-html", str(tmp_path / "p.html")]
    )
    assert done.exit_code == 0, (done.stderr, done.exception)
    assert {host for host, *_ in listened} == {"127.0.0.1"}


def test_recording_is_saved_as_a_page(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", stamped(3))
    page = tmp_path / "page.html"
    done = CliRunner().invoke(cli, ["view", str(path), "--save-html", str(page), "--json"])
    assert done.exit_code == 0, (done.stderr, done.exception)
    *notes, last = done.stderr.splitlines()
    assert last == f"{page}: 3 frames of {path}"
    assert [note.partition(",")[0] for note in notes] == ["sensor front has directions at one elevation"]
    assert json.loads(done.stdout) == {"event": "recorded", "source": str(path), "output": str(page), "frames": 3}
    text = page.read_text()
    assert "__VISER_EMBED_DATA__" in text
    assert len(text) > 500_000


def test_live_view_is_saved_as_a_page(tmp_path, monkeypatch):
    page, draw = tmp_path / "page.html", Viewer._draw  # noqa: SLF001  a busy machine draws late

    def draw_and_stop(view, now_s):
        draw(view, now_s)
        if view.shown:
            view.stop()

    monkeypatch.setattr(Viewer, "_draw", draw_and_stop)
    with Publisher() as publisher, publisher.playing([published(number) for number in range(3)]):
        command = f"view {publisher.address} --save-html {page} --duration 200 --port 0 --no-open --json"
        done = CliRunner().invoke(cli, command.split())
    assert done.exit_code == 0, (done.stderr, done.exception)
    viewing, recorded = map(json.loads, done.stdout.splitlines())
    assert (viewing["event"], viewing["source"]) == ("viewing", publisher.address)
    assert (recorded["event"], recorded["output"]) == ("recorded", str(page))
    assert 1 <= recorded["frames"] <= 3
    assert page.stat().st_size > 500_000


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_page_is_not_written(tmp_path, monkeypatch, number):
    path = write_energyscapes(tmp_path / "img.h5", stamped(3))
    page = tmp_path / "page.html"
    draw = ViewedScene.draw

    def interrupted(*arguments):
        os.kill(os.getpid(), number)
        return draw(*arguments)

    monkeypatch.setattr(ViewedScene, "draw", interrupted)
    done = CliRunner().invoke(cli, ["view", str(path), "--save-html", str(page)])
    assert done.exit_code == 128 + number, (done.stderr, done.exception)
    assert "frames of" not in done.stderr
    assert [each.name for each in tmp_path.iterdir()] == ["img.h5"]


def test_interrupt_during_compilation_is_reported(tmp_path, monkeypatch):
    path = write_energyscapes(tmp_path / "img.h5", stamped(3))
    ended = []
    monkeypatch.setattr(os, "_exit", ended.append)

    def compiling(_):
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)  # an echo of the first
        assert ended == []
        monkeypatch.setattr(view, "_TWICE_S", -1.0)
        os.kill(os.getpid(), signal.SIGINT)
        assert ended == [128 + signal.SIGINT]  # at once: an exception would break in the compiler

    monkeypatch.setattr(Viewer, "prepare", compiling)
    done = CliRunner().invoke(cli, ["view", str(path), "--save-html", str(tmp_path / "page.html")])
    assert done.exit_code == 128 + signal.SIGINT, (done.stderr, done.exception)
    assert done.stderr.splitlines()[0] == "ending after this step; press Ctrl-C again to end at once"
    assert [each.name for each in tmp_path.iterdir()] == ["img.h5"]


def test_live_view_without_images_fails(tmp_path):
    page = tmp_path / "page.html"
    with Publisher() as publisher, publisher.playing([]):
        command = f"view {publisher.address} --save-html {page} --duration 0.5 --port 0 --no-open"
        done = CliRunner().invoke(cli, command.split())
    assert done.exit_code == 1
    last = done.stderr.splitlines()[-1]
    reason = f"no image of {publisher.address} was shown; check that sensors send measurements"
    assert last.endswith(f"{page} is not written, because {reason}")
    assert not page.exists()


def test_commands_of_the_page_on_the_view_run(tmp_path):
    write_energyscapes(tmp_path / "IMG.h5", stamped(3))
    text = path_of("view").read_text("utf-8")
    commands = [command for command in commands_in(text) if command.startswith("view ")]
    assert len(commands) == 6
    write_recording(tmp_path / "PASSIVE.h5", passive_noise(1))
    assert run_here(tmp_path, commands_in(text)[0]) == ""  # copies the recording
    with Publisher() as publisher, publisher.playing([]):
        for command in commands:
            words = command.replace("tcp://127.0.0.1:5602", publisher.address)
            if "--save-html" in words:
                run_here(tmp_path, words)
            else:
                reported = json.loads(run_here(tmp_path, f"{words} --port 0 --no-open --json --duration 0.2"))
                assert reported["source"] == words.split()[1]
    assert (tmp_path / "PAGE.html").stat().st_size > 500_000
    cell, code = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert "view of reflectors.h5 at http://127.0.0.1:" in run_code_here(tmp_path, f"{cell}print(view)\nview.close()")
    assert run_code_here(tmp_path, code).startswith("http://127.0.0.1:")


def test_recording_limit_matches_its_documentation():
    reported = f"at most {MAX_BYTES / 1e6:g} MB"
    assert reported in " ".join(CliRunner().invoke(cli, ["view", "--help"]).stdout.split())
    assert reported in " ".join(path_of("view").read_text("utf-8").split())


class InTerminal(webbrowser.GenericBrowser):
    """Browser that runs until somebody ends it."""

    def __init__(self):
        super().__init__("w3m")
        self.came, self.ended = threading.Event(), threading.Event()

    def open(self, url, *_):
        self.url = url
        self.came.set()
        assert self.ended.wait(PATIENCE_S)


def test_slow_browser_does_not_delay_the_view(tmp_path, monkeypatch):
    path = write_energyscapes(tmp_path / "img.h5", stamped(1))
    browser = InTerminal()
    monkeypatch.setattr(webbrowser, "get", lambda: browser)
    done = CliRunner().invoke(cli, ["view", str(path), "--open", "--port", "0", "--duration", "0.1", "--json"])
    assert done.exit_code == 0, (done.stderr, done.exception)
    assert browser.came.wait(PATIENCE_S)
    assert browser.url == json.loads(done.stdout)["url"]
    assert not browser.ended.is_set()
    browser.ended.set()


@pytest.mark.parametrize(
    ("browser", "is_opened"),
    [
        (webbrowser.BackgroundBrowser("xdg-open"), True),
        (webbrowser.Chrome("chromium"), True),
        (webbrowser.BaseBrowser("another system's"), True),
        (webbrowser.GenericBrowser("w3m"), False),
        (webbrowser.Elinks("elinks"), False),
    ],
    ids=["xdg-open", "chromium", "other", "w3m", "elinks"],
)
def test_terminal_browser_is_opened_only_with_open(monkeypatch, browser, is_opened):
    opened = []
    monkeypatch.setattr(webbrowser, "get", lambda: browser)
    monkeypatch.setattr(browser, "open", opened.append)
    view._open("page", asked=False)  # noqa: SLF001  what a terminal is needed for
    assert opened == ["page"] * is_opened
    view._open("page", asked=True)  # noqa: SLF001
    assert opened == ["page"] * (is_opened + 1)


def test_missing_browser_is_not_opened(monkeypatch):
    def get():
        raise webbrowser.Error("could not locate runnable browser")

    monkeypatch.setattr(webbrowser, "get", get)
    view._open("page", asked=True)  # noqa: SLF001  as above
