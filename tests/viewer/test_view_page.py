"""The page: access, and saved content."""

import base64
import http.client
import re
import socket
from contextlib import closing
from types import SimpleNamespace
from urllib.parse import urlsplit

import msgspec
import pytest
import viser
import zstandard

from ertis_numba.base.errors import ArgumentError, NetworkError
from ertis_numba.storage import write_energyscapes
from ertis_numba.viewer import Choices, Playback, Viewer, _recordings as recordings, _view as viewing
from ertis_numba.viewer._origins import is_loopback
from ertis_numba.viewer._page import ControlRequest
from tests.views import PATIENCE_S, Client, Source, run_once, spot, stamped, taken, wait_for


def test_occupied_port_is_refused(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", stamped(1))
    with socket.socket() as other, Playback(path) as playback:
        other.bind(("127.0.0.1", 0))
        other.listen()
        with pytest.raises(
            NetworkError, match=r"cannot serve the page at 127\.0\.0\.1:\d+ .*; choose another host or port"
        ):
            Viewer(playback, port=other.getsockname()[1])
    with Playback(path) as playback, pytest.raises(NetworkError, match=r"cannot serve the page at 203\.0\.113\.1"):
        Viewer(playback, host="203.0.113.1", port=0)


def answer(port, origin, host, *, path="/", cookie=None):
    """Answer of the server to a connecting browser: 101 admits it."""
    key = base64.b64encode(bytes(16)).decode()
    headers = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13", "Sec-WebSocket-Key": key}
    headers |= {"Host": host, "Sec-WebSocket-Protocol": f"viser-v{viser.__version__}"}
    with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)) as connection:
        headers |= {} if origin is None else {"Origin": origin}
        connection.request("GET", path, headers=headers | ({} if cookie is None else {"Cookie": cookie}))
        return connection.getresponse().status


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "LOCALHOST", "0.0.0.0"])
def test_pages_of_other_sites_are_refused(host):
    with Viewer(Source(), host=host, port=0) as view:
        url = urlsplit(view.url)
        port, path = url.port, f"/?{url.query}"
        assert view.is_local == (host != "0.0.0.0")
        here = f"127.0.0.1:{port}"
        for origin in (None, f"http://{here}"):
            assert answer(port, origin, here, path=path) == 101
        # Through ssh -L, a browser knows the page by another port.
        assert answer(port, "http://LocalHost:9999", "localhost:9999", path=path) == 101
        assert answer(port, "http://[::1]", "[::1]:80", path=path) == 101
        for origin in ("http://example.org", f"http://{here}.example.org", "http://127.0.0.1", "http://127.0.0.1:9"):
            assert answer(port, origin, here, path=path) == 403, origin
        for origin in ("null", "file://", f"ftp://{here}", "http://[", f"http://{here}x", ""):
            assert answer(port, origin, here, path=path) == 403, origin
        # The name of another site may lead to this machine; nobody opens a page on loopback by it.
        alias = f"example.org:{port}"
        assert answer(port, f"http://{alias}", alias, path=path) == (403 if view.is_local else 101)


def get(url, **headers):
    """Status of a page, and the cookie that it sets."""
    parts = urlsplit(url)
    with closing(http.client.HTTPConnection("127.0.0.1", parts.port, timeout=PATIENCE_S)) as connection:
        connection.request("GET", f"{parts.path}?{parts.query}", headers=headers)
        response = connection.getresponse()
        return response.status, response.getheader("Set-Cookie"), response.read()


def test_page_that_other_machines_reach_needs_its_token():
    with Viewer(Source(), host="0.0.0.0", port=0) as view:
        url = urlsplit(view.url)
        here, bare = f"127.0.0.1:{url.port}", f"http://{url.netloc}/"
        for wrong in ("", "?token=", "?token=x", f"?{url.query[:-1]}", "?token=%C3%A9", "assets"):
            status, cookie, text = get(bare + wrong)
            assert (status, cookie) == (403, None), wrong
            assert b"Open the address that 'ertis view' printed" in text
        status, cookie, _ = get(view.url)
        assert status == 200
        assert {"HttpOnly", "SameSite=Strict"} <= set(cookie.split("; "))
        kept = cookie.split(";")[0]
        assert get(bare, Cookie=kept)[0] == 200
        assert answer(url.port, f"http://{here}", here, cookie=kept) == 101
        for stolen in (None, kept[:-1], kept.partition("=")[0] + "=", "ertis_view=x", "=;;=", kept + "x"):
            assert answer(url.port, f"http://{here}", here, cookie=stolen) == 403, stolen
        assert answer(url.port, "http://example.org", here, cookie=kept) == 403


def test_page_on_loopback_needs_no_token():
    with Viewer(Source(), port=0) as view:
        assert "token" not in view.url
        assert get(view.url)[0] == 200


def test_other_addresses_of_this_machine_are_loopback():
    spelled = ("127.0.0.2", "LocalHost", "::1", "[::1]")
    assert all(is_loopback(host) for host in spelled)
    assert not any(is_loopback(host) for host in ("0.0.0.0", "::", "192.168.1.2", "example.org", "127.example.org"))


def test_failed_saving_is_reported_and_the_view_continues(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", [spot(0, 2.0, timestamp_ns=3 * 10**18)])
    client = Client()
    with Playback(path) as playback, Viewer(playback, port=0) as view:
        orders = [
            ControlRequest("threshold_db", 7.0),
            ControlRequest("points", client=client),
            ControlRequest("picture", client=client),
        ]
        wait_for(lambda: view.run(duration_s=0.05) or view.shown)
        for order in orders:
            view._orders.put(order)  # noqa: SLF001  as a browser does
        run_once(view)
        assert view.choices == Choices()
    ((title, body),) = client.notices
    assert title == "Nothing is saved"
    assert "outside 1970 to 2038" in body
    ((name, content),) = client.files
    assert (name, content[:4]) == ("img.png", b"\x89PNG")


def embedded(page):
    """Data embedded in a page, in the format of viser."""
    packed = base64.b64decode(re.search(r'__VISER_EMBED_DATA__="([^"]+)"', page)[1])
    return zstandard.ZstdDecompressor().decompressobj().decompress(packed[8:])


def times_s(page):
    """Times at which a page draws, and its duration."""
    inner = embedded(page)
    held = msgspec.msgpack.decode(inner[8 : 8 + int.from_bytes(inner[:8], "little")])
    return {time_s for time_s, _ in held["messages"]}, held["durationSeconds"]


def moving(count):
    """Images of a moving reflector, each of which needs 1.4 kB of a recording."""
    return [spot(2 * number, 2.0, sequence=number, timestamp_ns=round(1e18 + number * 5e7)) for number in range(count)]


def test_browser_does_not_end_the_recording_of_another(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", stamped(3, step_s=0.01))
    one, other = Client(1), Client(2)
    with Playback(path) as playback, Viewer(playback, port=0) as view:

        def press(client, name="record"):
            view._orders.put(ControlRequest(name, client=client))  # noqa: SLF001  as a browser does

        press(one)
        wait_for(lambda: run_once(view) or view.shown)
        press(other)
        press(one)
        run_once(view, html=tmp_path / "ours.html")
        assert one.files
        assert view.recorded is not None
        press(other, "leave")  # with its recording
        press(other)
        press(other)
        run_once(view)
        assert not view._page._server._websock_server._record_handles  # noqa: SLF001  nothing is kept for nobody
    assert embedded((tmp_path / "ours.html").read_text())
    ((name, content),) = one.files
    assert name == "img.html"
    assert embedded(content.decode())
    assert len(other.files) == 1


def test_saved_recording_lasts_from_its_start_to_its_end(tmp_path, monkeypatch):
    """It does not start at the age of its first image, and lasts until its end even without new images."""
    source, client = Source(), Client()
    clock = SimpleNamespace(now_s=1000.0, monotonic=lambda: clock.now_s)
    monkeypatch.setattr(viewing, "time", clock)
    with Viewer(source, port=0) as view:

        def come():
            source.waiting = [taken(spot(5 * len(turns), 2.0), time_s=source.clock_s)]

        def press():
            view._orders.put(ControlRequest("record", client=client))  # noqa: SLF001  as a browser does

        turns = [(0.0, come), (7.0, come), (600.0, press), (2.0, come), (3.0, press), (4.0, come), (5.0, view.stop)]
        turns.append((0.0, list))  # the one in which it ends

        def turn():
            after_s, does = turns.pop(0)
            clock.now_s += after_s
            does()
            return []

        source.notes = turn
        view.run(html=tmp_path / "ours.html")
    ((_, content),) = client.files
    assert times_s(content.decode()) == ({0.0, 2.0}, 5.0)
    assert times_s((tmp_path / "ours.html").read_text()) == ({0.0, 7.0, 609.0, 616.0}, 621.0)


def test_browser_recording_does_not_end_that_of_run(tmp_path):
    source, client = Source(), Client()
    source.waiting = [taken(spot(0, 2.0), time_s=source.clock_s)]
    with Viewer(source, port=0) as view:
        view._orders.put(ControlRequest("record", client=client))  # noqa: SLF001  which once ended that of the command
        run_once(view, html=tmp_path / "live.html")
        assert view.recorded == 1
    assert (tmp_path / "live.html").stat().st_size > 500_000


def test_recording_ends_at_its_size_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(recordings, "MAX_BYTES", 20_000)
    path = write_energyscapes(tmp_path / "img.h5", moving(30))
    notes = []
    with Playback(path) as playback, Viewer(playback, port=0, on_note=notes.append) as view:
        view.record(tmp_path / "page.html")
        assert 2 < view.recorded < 29
        assert view.shown == view.recorded
    directions, full = notes
    assert directions.startswith("sensor front has directions at one elevation, 0°, so sound from above or below may")
    assert full == f"{tmp_path / 'page.html'} is full at 0.02 MB: the view up to now is written"
    assert 15_000 < len(embedded((tmp_path / "page.html").read_text())) < 25_000


def test_stopped_playback_leaves_no_page(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", moving(5))
    page = tmp_path / "page.html"
    with Playback(path) as playback, Viewer(playback, port=0) as view:
        show = view._page.show  # noqa: SLF001

        def shown(frame, place):
            show(frame, place)
            if place == 2:
                view.stop()

        view._page.show = shown  # noqa: SLF001
        view.record(page)
        assert view.recorded is None
        assert view.shown == 3
        assert not view._page._server._websock_server._record_handles  # noqa: SLF001  nothing is kept for nobody
    assert [each.name for each in tmp_path.iterdir()] == ["img.h5"]


def test_live_view_without_images_leaves_no_page(tmp_path):
    with Viewer(Source(), port=0) as view:
        view.run(duration_s=0.1, html=tmp_path / "page.html")
        assert view.recorded is None
    assert [*tmp_path.iterdir()] == []


def test_view_continues_after_a_full_recording(tmp_path, monkeypatch):
    monkeypatch.setattr(recordings, "MAX_BYTES", 20_000)
    source, client, notes = Source(), Client(), []
    page = tmp_path / "live.html"
    with Viewer(source, port=0, on_note=notes.append) as view:
        view._orders.put(ControlRequest("record", client=client))  # noqa: SLF001  as a browser does
        sent = []

        def send():
            """Send images until some have been sent after the limit was reached."""
            sent.append(bool(notes and client.notices))
            if sum(sent) > 5:
                view.stop()
            source.clock_s += 0.1
            source.waiting = [taken(spot(len(sent) % 60, 2.0, sequence=len(sent)), time_s=source.clock_s)]
            return []

        source.notes = send
        view.run(duration_s=PATIENCE_S, html=page)
        assert 0 < view.recorded < view.shown
    assert notes == [f"{page} is full at 0.02 MB: the view up to now is written"]
    assert [title for title, _ in client.notices] == ["The HTML recording is full"]
    assert [name for name, _ in client.files] == ["live.html"]


def test_recorded_bytes_are_counted(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", moving(8))
    counted = []
    with Playback(path) as playback, Viewer(playback, port=0) as view:
        recorded = view._recordings  # noqa: SLF001
        add = recorded.add
        recorded.add = lambda *, frames: add(frames=frames) or counted.extend(recorded.n_bytes().values())
        view.record(tmp_path / "page.html")
    assert counted == sorted(counted)
    assert counted[-1] == pytest.approx(len(embedded((tmp_path / "page.html").read_text())), rel=0.15)


@pytest.mark.parametrize("record", [True, False])
def test_playback_is_not_recorded_over_itself(tmp_path, record):
    path = write_energyscapes(tmp_path / "img.h5", stamped(1))
    before = path.read_bytes()
    with (
        Playback(path) as playback,
        Viewer(playback, port=0) as view,
        pytest.raises(ArgumentError, match="is the input itself"),
    ):
        view.record(path, overwrite=True) if record else view.run(duration_s=0.1, html=path, overwrite=True)
    assert path.read_bytes() == before


def test_unwritable_recording_is_reported(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", stamped(1))
    with Playback(path) as playback, Viewer(playback, port=0) as view:
        view._page.show = lambda *_: (tmp_path / "page.html").touch()  # noqa: SLF001  somebody was faster
        with pytest.raises(ArgumentError, match="exists; choose another name"):
            view.record(tmp_path / "page.html")
        assert view.recorded is None


def controls(view):
    return view._page._chosen  # noqa: SLF001


@pytest.mark.parametrize(
    ("window_m", "shown_m", "top_m", "reported"),
    [
        (None, (0.0, 5.0), 5.0, "Range 0–5 m"),
        ((0.6, 1.0), (0.6, 1.0), 5.0, "Range 0.6–1 m"),
        ((10.0, 20.0), (10.0, 20.0), 20.0, "Range 10–20 m"),
    ],
)
def test_range_slider_shows_the_window(window_m, shown_m, top_m, reported):
    source = Source()
    source.waiting = [taken(spot(0, 2.0), time_s=100.0)]
    with Viewer(source, port=0, choices=Choices(range_m=window_m)) as view:
        run_once(view)
        slider = controls(view)["range_m"]
        assert (slider.value, slider.max, slider.label) == (pytest.approx(shown_m), pytest.approx(top_m), reported)
        view._orders.put(ControlRequest("range_m", (1.0, 2.0)))  # noqa: SLF001  as a browser does
        run_once(view)
        assert slider.label == "Range 1–2 m"


def test_invalid_numbers_are_reset(monkeypatch):
    source = Source()
    with Viewer(source, port=0, choices=Choices(threshold_db=-15.0)) as view:
        box = controls(view)["threshold_db"]

        def type_in(number):
            box.value = number
            view._orders.put(ControlRequest("threshold_db", number))  # noqa: SLF001  as a browser does
            run_once(view)
            return box.value, view.choices.threshold_db

        monkeypatch.setattr(viewing, "_TYPED_S", 1000.0)
        assert type_in(5.0) == (5.0, -15.0)  # it may be half of a number
        monkeypatch.setattr(viewing, "_TYPED_S", 0.0)
        assert type_in(-100.0) == (-15.0, -15.0)
        assert type_in(-30.0) == (-30.0, -30.0)
