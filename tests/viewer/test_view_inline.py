"""The live view in a cell of a notebook."""

import http.client
import http.server
import logging
import socket
import threading
from contextlib import closing
from urllib.parse import urlsplit

import pytest

import ertis_numba as ertis
from ertis_numba.base.errors import NetworkError, RefusedError
from ertis_numba.storage import write_energyscapes
from tests.notebook.test_notebook_views import Page
from tests.viewer.test_view_browser import browser as browser  # noqa: PLC0414  a fixture
from tests.views import PATIENCE_S, Source, stamped, wait_for


@pytest.fixture
def path(tmp_path):
    return write_energyscapes(tmp_path / "it's.h5", stamped(2))


def fetched(url):
    """Status and text of the page at an address."""
    with closing(http.client.HTTPConnection(urlsplit(url).netloc, timeout=PATIENCE_S)) as connection:
        connection.request("GET", "/")
        answer = connection.getresponse()
        return answer.status, answer.read().decode()


def test_cell_has_a_frame_with_the_page_until_the_view_is_closed(path):
    view = ertis.view(path)
    page = Page(view._repr_html_())
    assert page.tags.count("iframe") == 1
    assert f"src='{view.url}'" in view._repr_html_()
    port = urlsplit(view.url).port
    assert f"ssh -L {port}:127.0.0.1:{port} {socket.gethostname()}" in view._repr_html_()
    assert repr(view) == f"view of it's.h5 at {view.url}"
    status, text = fetched(view.url)
    assert status == 200
    assert "<script" in text
    view.close()
    view.close()
    assert repr(view) == "view of it's.h5 (closed)"
    assert Page(view._repr_html_()).text == repr(view)
    with pytest.raises(ConnectionRefusedError):
        fetched(view.url)


def test_failure_after_the_cell_is_logged(caplog):
    class Refused(Source):
        closed = False

        def take(self):
            raise RefusedError("the key is not allowed")

        def __enter__(self):
            return self

        def __exit__(self, *_):
            self.closed = True

    source = Refused()
    with caplog.at_level(logging.ERROR, "ertis_numba"), ertis.view(source) as view:
        wait_for(lambda: "closed" in repr(view))
    assert caplog.messages == [f"the view of source at {view.url} ended: the key is not allowed"]
    assert source.closed


def test_source_is_closed_if_the_port_is_taken(path):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        source = ertis.viewer.Playback(path)
        with pytest.raises(NetworkError, match="cannot serve the page"):
            ertis.view(source, port=other.getsockname()[1])
    with pytest.raises(ValueError, match="closed"):
        source.at(0)


def test_address_is_that_of_a_central_node():
    with ertis.view("tcp://127.0.0.1:9") as view:
        assert repr(view).startswith("view of tcp://127.0.0.1:9 at http://127.0.0.1:")


def test_frame_in_a_page_of_another_host_shows_the_images(path, browser):
    with ertis.view(path) as view:

        class Cell(http.server.BaseHTTPRequestHandler):
            def do_GET(self):
                self.send_response(200)
                self.end_headers()
                self.wfile.write(view._repr_html_().encode())

            def log_message(self, *_):
                pass

        with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Cell) as server:
            threading.Thread(target=server.serve_forever).start()
            page = browser.new_context(base_url=f"http://127.0.0.1:{server.server_port}").new_page()
            page.goto("/")
            frame = page.frame_locator("iframe")
            frame.locator("[data-name=sequence]", has_text="1").wait_for(timeout=1e3 * PATIENCE_S)
            assert frame.locator("img").first.is_visible()
            page.context.close()
            server.shutdown()
