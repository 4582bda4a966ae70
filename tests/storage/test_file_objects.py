"""Files read through file objects: parts of remote files, and errors that name the cause."""

import contextlib
import http.server
import io
import os
import threading

import fsspec
import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.frames import Measurement, Stamp
from ertis_numba.settings import Settings
from ertis_numba.storage import sensor_names

N_MEASUREMENTS = 40


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """Recording of noise, which does not compress: 26 MB."""
    rng, settings = np.random.default_rng(4), Settings()
    n_samples = settings.recording.n_samples
    made = tmp_path_factory.mktemp("remote") / "noise.h5"
    return ertis.write_recording(
        made,
        (
            Measurement(rng.integers(0, 2**32, n_samples, np.uint32), settings, Stamp(sensor="front", sequence=number))
            for number in range(N_MEASUREMENTS)
        ),
        settings=settings,
    )


class Server(http.server.ThreadingHTTPServer):
    """Server of one file by byte ranges, which counts the bytes that it sends."""

    def __init__(self, content):
        self.content, self.n_sent, self.is_down = content, 0, False
        super().__init__(("127.0.0.1", 0), Ranges)
        self.url = f"http://127.0.0.1:{self.server_port}/noise.h5"


class Ranges(http.server.BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def do_HEAD(self):
        self.do_GET()

    def do_GET(self):
        content, wanted = self.server.content, self.headers.get("Range")
        first, last = (wanted or f"bytes=0-{len(content) - 1}").removeprefix("bytes=").split("-")
        body = content[int(first) : int(last) + 1]
        self.send_response(503 if self.server.is_down else 206 if wanted else 200)
        self.send_header("Accept-Ranges", "bytes")
        self.send_header("Content-Range", f"bytes {first}-{int(first) + len(body) - 1}/{len(content)}")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if self.command == "GET":
            self.server.n_sent += len(body)
            self.wfile.write(body)

    def log_message(self, *_):
        """Print nothing."""


@contextlib.contextmanager
def serving(content):
    with Server(content) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def remote(server):
    return fsspec.open(server.url, "rb", cache_type="blockcache", block_size=2**20)


def test_remote_recording_is_read_in_parts(path):
    with serving(path.read_bytes()) as server, ertis.open_recording(path) as local, remote(server) as file:
        assert sensor_names(file) == ("front",)
        with ertis.open_recording(file) as recording:
            assert (recording.path.name, len(recording)) == ("noise.h5", N_MEASUREMENTS)
            n_opened = server.n_sent
            measurement = recording[N_MEASUREMENTS // 2]
            assert np.array_equal(measurement.data, local[N_MEASUREMENTS // 2].data)
            assert measurement.stamp == local[N_MEASUREMENTS // 2].stamp
            assert n_opened < 5e6
            assert server.n_sent - n_opened < 4e6
            assert recording.sha256() == local.sha256()


def test_failing_server_is_not_called_damage(path):
    with serving(path.read_bytes()) as server, remote(server) as file, ertis.open_recording(file) as recording:
        server.is_down = True
        with pytest.raises(Exception, match="503"):
            recording[N_MEASUREMENTS // 2]


def test_lost_connection_is_not_called_damage(path):
    class Losing(io.BytesIO):
        is_lost = False

        def readinto(self, buffer):
            if self.is_lost:
                raise ConnectionResetError(104, "Connection reset by peer")
            return super().readinto(buffer)

    file = Losing(path.read_bytes())
    with ertis.open_recording(file) as recording:
        file.is_lost = True
        with pytest.raises(DataError, match=r"^file object cannot be read \(Connection reset by peer\); check its"):
            recording[N_MEASUREMENTS // 2]


@pytest.mark.parametrize("content", [b"", b"words" * 1000])
def test_other_content_is_refused(content):
    with pytest.raises(DataError, match=r"^file object is not a recording, or is cut short"):
        ertis.open_recording(io.BytesIO(content))


def test_truncated_content_is_refused(path):
    with pytest.raises(DataError, match="is cut short"):
        ertis.open_recording(io.BytesIO(path.read_bytes()[:-100_000]))


def test_pipe_and_text_are_refused(path):
    with contextlib.ExitStack() as stack:
        reading, writing = os.pipe()
        stack.callback(os.close, writing)
        pipe = stack.enter_context(os.fdopen(reading, "rb"))
        text = stack.enter_context(path.open(encoding="latin-1"))
        for file, name in ((pipe, "file object"), (text, "noise.h5")):
            with pytest.raises(DataError, match=f"^{name} is not a binary file that can be read at any place"):
                ertis.open_recording(file)


def test_closed_file_and_other_objects_are_refused(path):
    with path.open("rb") as file:
        pass
    with pytest.raises(DataError, match=r"^noise\.h5 is closed; open it again"):
        ertis.open_recording(file)
    with pytest.raises(ArgumentError, match=r"^path is NoneType; pass a path or a binary file object"):
        ertis.open_recording(None)


def test_path_like_object_is_a_path(path):
    with os.scandir(path.parent) as entries:
        (entry,) = entries
    with ertis.open_recording(entry) as recording:
        assert recording.path == path


def test_timeout_on_opening_is_not_called_damage(path):
    class Late(io.BytesIO):
        def readinto(self, _):
            raise TimeoutError(110, "Connection timed out")

    with pytest.raises(DataError, match=r"^file object cannot be read \(Connection timed out\)"):
        ertis.open_recording(Late(path.read_bytes()))
